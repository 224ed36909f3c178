"""Defects of recorders on simulated trips, and what ingest, fit, slip and map make of them.

    python benchmarks/recorded/benchmark_recorded.py [--published ../shared/data/ttobench]
        [--only WORDS] [--workers 2]

Three loaded trips, two of them on wet rail, of each of three trains on three lines are written as a
recorder's CSV, sound and with each defect, ingested, fitted, searched for slip and mapped. A row a
defect:

- made: files that became trips of all; the others were refused, with the reason below the table
- rows: whether every row of every file is kept or counted as dropped
- chainage, speed: median error of ``/estimates/state``, and share of time in its 95 % band
- recorded: median error of the distance in ``/train/state``
- fit: trips fitted of those made, median error of the curve of running resistance, and share of
  speeds at which the true curve lies in the 95 % band
- slip: share of the true slips found, and of those reported that are true
- map: bins with onsets of slip, mean error of the maximum adhesion there, and share in the band
- repaired: the rules that were applied, with their counts over all files

Last, over all defects: exceptions, and bands that hold in fewer than 90 % of their cases.
"""

from __future__ import annotations

import argparse
import multiprocessing
import re
import sys
import traceback
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
from recordings import DEFECTS, PAIRS, driven, line_and_train, spoilt

from analysis.adhesion.condition_map import empty_map, update
from analysis.adhesion.evidence import evidence
from analysis.adhesion.slip import slip
from analysis.resistance import fit_trip
from analysis.truth import curve_error, true_adhesion, truth_of
from estimators.adhesion import SlipDetector
from trainlog.errors import TrainlogError
from trainlog.ingest import ingest_each, report_of
from trainlog.ingest.profile import profile_of
from trainlog.spans import runs_of
from trainlog.trip import Trip

SLIPS = 1.5
"""Largest slip [m/s] from which on a true slip must be found."""

MARGIN = 0.3
"""Slips this close to `SLIPS` [m/s] may be found or not."""


LEAST_COVERAGE = 0.9
"""Share of cases in which a 95 % band must hold."""


@dataclass
class Outcome:
    """What became of the files with one defect."""

    files: int = 0
    made: int = 0
    rows_wrong: int = 0
    repaired: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    crashed: list[str] = field(default_factory=list)
    errors: dict[str, list[float]] = field(default_factory=dict)
    inside: dict[str, list[float]] = field(default_factory=dict)
    slips: list[int] = field(default_factory=lambda: [0, 0, 0, 0])
    seconds: float = 0.0

    def add(self, what: str, error, inside=None) -> None:
        """Count errors and whether bands hold."""
        self.errors.setdefault(what, []).extend(np.atleast_1d(error).tolist())
        if inside is not None:
            self.inside.setdefault(what, []).extend(np.atleast_1d(inside).astype(float).tolist())

    def join(self, other: Outcome) -> None:
        """Add what became of other files."""
        for name in ("files", "made", "rows_wrong", "seconds"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.repaired += other.repaired
        self.refused += other.refused
        self.crashed += other.crashed
        self.slips = [a + b for a, b in zip(self.slips, other.slips, strict=True)]
        for mine, theirs in ((self.errors, other.errors), (self.inside, other.inside)):
            for what, values in theirs.items():
                mine.setdefault(what, []).extend(values)

    def tried(self, what: str, work):
        """The result of some work; None where it was refused, or crashed."""
        try:
            return work()
        except TrainlogError as error:
            reason = re.sub(r"\S*/(trip-\d+)\.csv|'trip-\d+'", "TRIP", str(error))
            self.refused[f"{what}: {re.sub(r'[0-9][0-9.,]*', 'N', reason)}"] += 1
        except Exception as error:  # noqa: BLE001 - what must never happen is counted
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(where.filename).name}:{where.lineno}"
            self.crashed.append(f"{what}: {type(error).__name__} at {place}: {error}")
        return None


def judged(pair: int, words: str, published: Path) -> Outcome:
    """Everything of one defect on one line."""
    found = Outcome()
    line, train = line_and_train(pair, published)
    track, pieces, truths = empty_map(line), [], []
    for number, (scenario, run, original) in enumerate(driven(pair, published)):
        made = spoilt(words, original, scenario.load, seed=10 * pair + number)
        found.files += 1
        with TemporaryDirectory() as folder:
            path = Path(folder) / f"{scenario.name}.csv"
            made.written(path)
            begin = perf_counter()
            trips = found.tried(
                "ingest",
                lambda path=path, made=made: list(
                    ingest_each(path, profile_of(made.profile), line=line, train=train)
                ),
            )
            found.seconds += perf_counter() - begin
        if not trips:
            continue
        found.made += 1
        (trip,) = trips
        report = report_of(trip)
        found.repaired.update(report.counts)
        found.rows_wrong += report.rows_read != len(made.table)
        ahead = clock_ahead(trip, original, made.clocks)
        judge_state(found, trip, original, ahead)
        fit = found.tried("fit", lambda trip=trip: fit_trip(trip))
        truth = truth_of(original)
        if fit is not None:
            true = truth.resistance(truth.speeds)
            low, high = fit.band(truth.speeds)
            error = curve_error(fit.resistance, [truth])
            found.add("fit", error, np.mean((low <= true) & (true <= high)))
        slips = found.tried("slip", lambda trip=trip: slip(trip))
        if slips is not None:
            judge_slip(found, slips, scenario, run, ahead)
            piece = found.tried("map", lambda trip=trip: evidence(trip, track))
            if piece is not None:
                pieces.append(piece)
                truths.append(truth)
    if pieces:
        judge_map(found, track, pieces, truths)
    return found


def clock_ahead(trip: Trip, original: Trip, clocks: tuple[float, ...]) -> int:
    """By how much the trip's clock is ahead [ns]: the nearest of those it may be."""
    off = trip.start.as_unit("ns").value - original.start.as_unit("ns").value
    return min((round(1e9 * each) for each in clocks), key=lambda each: abs(off - each))


def judge_state(found: Outcome, trip: Trip, original: Trip, ahead: int) -> None:
    """Errors of chainage and speed against the truth, once a second."""
    truth = original["/truth"]
    clock = truth.index.as_unit("ns").asi8 + ahead
    for topic, names in (
        ("/estimates/state", {"chainage": "position", "speed": "speed"}),
        ("/train/state", {"recorded": "position"}),
    ):
        if topic not in trip:
            continue
        frame = trip[topic]
        at = frame.index.as_unit("ns").asi8
        even = np.arange(at[0], at[-1], 1_000_000_000)
        outside = (even < clock[0] - 5e9) | (even > clock[-1] + 5e9)
        for what, name in names.items():
            if name not in frame or frame[name].notna().sum() < 2:
                continue
            known = frame[name].notna().to_numpy()
            value = np.interp(even - at[0], at[known] - at[0], frame[name].to_numpy()[known])
            true = np.interp(even - at[0], clock - at[0], truth[name].to_numpy())
            # An instant at which there was no trip is no place of the trip.
            error = np.where(outside, np.inf, np.abs(value - true))
            inside = None
            if f"{name}_std" in frame:
                std = np.interp(even - at[0], at - at[0], frame[f"{name}_std"].to_numpy())
                inside = error < 1.96 * std
            found.add(what, error, inside)


def judge_slip(found: Outcome, slips, scenario, run, ahead: int) -> None:
    """True slips found and missed, reported slips that are true and false, by time and axle."""
    names = scenario.plant().columns
    speed = run.samples[:, names.index("speed")]
    wheels = run.samples[:, [i for i, n in enumerate(names) if n.startswith("wheel_speed_")]]
    true = np.abs(wheels - speed[:, None])
    clock = scenario.start + ahead + np.round(run.seconds * 1e9).astype(np.int64)
    at = slips.time.as_unit("ns").asi8
    flags = SlipDetector(true.shape[1], 0.0).update(wheels - speed[:, None])
    for axle in range(slips.slipping.shape[1]):
        if np.isnan(slips.slip_speed[:, axle]).all():
            continue
        size, reported = true[:, axle], slips.slipping[:, axle]
        for a, b in runs_of(flags[:, axle]):
            if size[a:b].max() > SLIPS + MARGIN:
                seen = (at >= clock[a] - 10**9) & (at <= clock[b - 1] + 10**9)
                found.slips[0] += 1
                found.slips[1] += not reported[seen].any()
        for a, b in runs_of(reported):
            during = (clock >= at[a] - 10**9) & (clock <= at[b - 1] + 10**9)
            found.slips[2] += 1
            found.slips[3] += not (during.any() and size[during].max() > 0.3)


def judge_map(found: Outcome, track, pieces, truths) -> None:
    """Errors of the maximum adhesion in the bins with onsets of slip."""
    outcome = found.tried("map", lambda: update(track, pieces)[0])
    if outcome is None:
        return
    for name, layer in outcome.layers.items():
        seen = layer.events > 0
        true = true_adhesion(outcome, name, truths)
        score = np.abs(layer.log_mean - np.log(true)) / layer.log_std
        found.add("map", (layer.maximum_adhesion - true)[seen], (score < 1.96)[seen])


def work(task: tuple[int, str, Path]) -> tuple[str, Outcome]:
    return task[1], judged(*task)


def cells(words: str, found: Outcome) -> list[str]:
    """A row of the table."""

    def state(what: str, digits: int) -> str:
        if what not in found.errors:
            return "-"
        text = f"{np.median(found.errors[what]):.{digits}f}"
        return text + (f" {np.mean(found.inside[what]):.2f}" if what in found.inside else "")

    fits = found.errors.get("fit", [])
    fit = f"{len(fits)}/{found.made}"
    if fits:
        fit += f" {np.median(fits):.1%} {np.mean(found.inside['fit']):.2f}"
    true, missed, reported, false = found.slips
    bins = found.errors.get("map", [])
    return [
        words,
        f"{found.made}/{found.files}",
        "all" if not found.rows_wrong else f"{found.rows_wrong} wrong",
        state("chainage", 1),
        state("speed", 2),
        state("recorded", 1),
        fit,
        (f"{1 - missed / true:.3f}" if true else "-")
        + (f" {1 - false / reported:.3f}" if reported else " -"),
        f"{len(bins)} {np.mean(bins):+.4f} {np.mean(found.inside['map']):.2f}" if bins else "-",
        ", ".join(f"{rule} {count}" for rule, count in sorted(found.repaired.items())),
    ]


HEADER = [
    "defect", "made", "rows", "chainage m", "speed m/s", "recorded m", "fit", "slip", "map",
    "repaired",
]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--published", type=Path, default=Path("../shared/data/ttobench"))
    parser.add_argument(
        "--only", default="", help="defects whose words hold one of these, parted by |"
    )
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    published = options.published.resolve()
    pairs = range(len(PAIRS) if published.exists() else 1)
    if len(pairs) < len(PAIRS):
        print(f"{published} is missing: only {PAIRS[0]} is tried")
    chosen = [w for w in DEFECTS if any(part in w for part in options.only.split("|"))]
    tasks = [(pair, words, published) for pair in pairs for words in chosen]
    found = {words: Outcome() for words in chosen}
    begin = perf_counter()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.workers, mp_context=context) as pool:
        for words, outcome in pool.map(work, tasks):
            found[words].join(outcome)
            print(".", end="", file=sys.stderr, flush=True)
    rows = [HEADER, *(cells(words, outcome) for words, outcome in found.items())]
    widths = [max(len(row[i]) for row in rows) for i in range(len(HEADER))]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)))
    print()
    for words, outcome in found.items():
        for reason, count in outcome.refused.items():
            print(f"{words}: refused {count} times: {reason}")
        for crash in outcome.crashed:
            print(f"{words}: EXCEPTION {crash}")
    return totals(found, perf_counter() - begin)


def totals(found: dict[str, Outcome], seconds: float) -> int:
    """What the table comes to; 1 where an exception was raised or rows are not accounted for."""
    print()
    for what in ("chainage", "speed", "fit", "map"):
        inside = [value for outcome in found.values() for value in outcome.inside.get(what, [])]
        failing = [
            words
            for words, outcome in found.items()
            if outcome.inside.get(what) and np.mean(outcome.inside[what]) < LEAST_COVERAGE
        ]
        if inside:
            print(
                f"{what}: {np.mean(inside):.3f} in the 95 % band over all defects; below 0.9 in"
                f" {len(failing)} of {len(found)}" + (f": {'; '.join(failing)}" if failing else "")
            )
    crashed = sum(len(outcome.crashed) for outcome in found.values())
    wrong = sum(outcome.rows_wrong for outcome in found.values())
    spent = sum(outcome.seconds for outcome in found.values())
    files = sum(outcome.files for outcome in found.values())
    print(
        f"exceptions: {crashed}; files with rows not accounted for: {wrong}; ingest"
        f" {spent / max(files, 1):.2f} s a file; {seconds:.0f} s in all"
    )
    return int(crashed > 0 or wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
