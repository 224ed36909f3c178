"""Whether clocks that were set while they recorded are found, and clean ones left alone.

    python benchmarks/chainage/benchmark_clock.py [--files 100] [--seed 1] [--kind ...]

Kinematic trips of three trains (regional, freight, tram) on three lines (St.Gallen-Wil, a valley
line with loops, a tram's streets) are recorded at 1, 5 and 10 Hz with one of four sets of columns:
the train's speed and distance, the same with fixes, fixes and the receiver's speed, a speed alone.
Receivers err for tens of seconds, are late, hold a place before an outage, and come back from it
late or aside; recorders lose rows, write irregularly and round to whole seconds. Half of the files
have a clock that was set, with or without a gap at that place; the others have real gaps and every
other defect.

For each kind of file:

- moved: files of which rows were re-dated by the rules of the clock
- right: of the set ones with the train's distance, with fixes and with a speed alone, those whose
  time across the place is right to within 0.2 s (0.6 s where rows carry whole seconds or the size
  is known only from the motion, at a gap)
- wrong: share of rows more than 0.5 s off
- suspected: files with steps that are reported and not undone
- cuts: share of the rows of three cuts of each file (halves, middle) whose times differ by more
  than 0.2 s from those in the whole file; cuts that hold the place itself, or no place
"""

from __future__ import annotations

import argparse
import sys
import time as clock_time
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from satellite_trips import PACES, paced, streets, valley
from scipy.signal import lfilter

from trainlog.errors import InputError
from trainlog.formats.railway import read_line
from trainlog.formats.samples import DEFAULT_LINE, sample
from trainlog.ingest.profile import Limits, Repair
from trainlog.ingest.recording import Table
from trainlog.ingest.rules import repaired
from trainlog.railway import Geometry

START = 1_714_543_200_000_000_000
LENGTH = 1_500.0
"""Time that is recorded [s]."""

SIZES = (-20.0, -12.0, -7.4, -1.4, -1.0, -2.0, 1.0, 2.0, 2.6, 17.0, 18.0, 30.0)
"""How far clocks are set [s]."""

COLUMNS = ("distance", "both", "fixes", "speed")

CLEAN = ("gaps", "late after gaps", "stops in gaps", "held at gaps", "lost rows", "irregular",
         "rounded", "late speed", "late blocks")  # fmt: skip
SET = ("set", "set at a gap", "set, defects", "mixed")


@cache
def way(name: str) -> Geometry:
    """The geometry of a line."""
    if name == "valley":
        return valley()
    if name == "streets":
        return streets()
    found = read_line(sample(DEFAULT_LINE)).geometry
    assert found is not None
    return found


@cache
def driven(line: str, train: str, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, position and speed of a drive, ten a second."""
    length = min(float(way(line).positions[-1]), 40_000.0)
    return paced(length, PACES[train], seed)


@dataclass(frozen=True)
class Made:
    """A recording, and when each of its rows was recorded [s]."""

    table: Table
    truth: np.ndarray
    place: int | None
    """Row before which the clock was set; None if it was not."""
    known: bool
    """Whether the size follows from the rows themselves, as there is no gap."""


def lasting(rng: np.random.Generator, seconds: np.ndarray, std: float, memory: float) -> np.ndarray:
    """Errors that last, on an even grid of a second, two-sided exponential innovations."""
    count = int(seconds[-1]) + 3
    keep = np.exp(-1.0 / memory)
    white = rng.laplace(0.0, std * np.sqrt((1.0 - keep**2) / 2.0), count)
    white[0] = rng.laplace(0.0, std / np.sqrt(2.0))
    return np.interp(seconds, np.arange(count), lfilter([1.0], [1.0, -keep], white))


def made(kind: str, seed: int) -> Made:
    """A recording of a kind."""
    rng = np.random.default_rng(1_000_003 * seed + sum(map(ord, kind)))
    line = ("wil", "valley", "streets")[seed % 3]
    train = "tram" if line == "streets" else ("regional", "freight")[seed // 3 % 2]
    at, position, speed = driven(line, train, seed % 7)
    rate = (1.0, 5.0, 10.0)[seed // 2 % 3]
    columns = COLUMNS[seed % len(COLUMNS)]
    begin = rng.uniform(0.0, max(at[-1] - LENGTH, 1.0))
    seconds = begin + np.arange(0.0, min(LENGTH, at[-1] - begin), 1.0 / rate)
    keep = np.ones(seconds.size, dtype=bool)
    late = np.zeros(seconds.size)
    moving = np.flatnonzero(np.interp(seconds, at, speed) > 4.0)
    stops = np.flatnonzero(np.interp(seconds, at, speed) < 0.2)

    def lose(first: int, length: float) -> int:
        """Lose rows from one on; the first after them."""
        keep[first : first + max(1, round(length * rate))] = False
        return min(first + max(1, round(length * rate)), seconds.size - 1)

    def gap(length: float, *, behind: bool = False) -> None:
        after = lose(int(rng.choice(moving)), length)
        if behind:
            # The receiver begins with where it last was, and catches up.
            since = seconds - seconds[after]
            size, lasts = rng.uniform(1.0, min(4.0, length)), rng.uniform(4.0, 20.0)
            late[:] = np.maximum(late, np.where(since >= 0.0, size * (1.0 - since / lasts), 0.0))

    jitter = 0.0
    place: int | None = None
    size, known, mixed = 0.0, True, False
    if kind == "gaps":
        for _ in range(rng.integers(1, 5)):
            gap(float(np.exp(rng.uniform(np.log(2.0), np.log(60.0)))))
    elif kind == "late after gaps":
        for _ in range(rng.integers(1, 4)):
            gap(float(rng.uniform(2.0, 12.0)), behind=True)
    elif kind == "held at gaps":
        # Under a roof a receiver goes on at a speed that was, or stays, until it sees the sky.
        for _ in range(rng.integers(2, 6)):
            first = int(rng.choice(moving))
            blind = seconds[first] - rng.uniform(3.0, 20.0)
            lose(first, rng.uniform(2.0, 12.0))
            pace = rng.choice([0.0, rng.uniform(0.3, 0.9)])
            since = (seconds - blind) * ((seconds >= blind) & (seconds < seconds[first]))
            late[:] = np.maximum(late, since * (1.0 - pace))
    elif kind == "stops in gaps" and stops.size:
        for _ in range(2):
            first = max(int(rng.choice(stops)) - int(rng.uniform(5.0, 30.0) * rate), 1)
            lose(first, rng.uniform(10.0, 90.0))
    elif kind in ("lost rows", "set, defects"):
        keep &= rng.uniform(size=seconds.size) > rng.uniform(0.002, 0.03)
        for _ in range(rng.integers(1, 6)):
            lose(int(rng.integers(1, seconds.size - 1)), rng.uniform(0.5, 3.0))
    elif kind == "irregular":
        jitter = rng.uniform(0.05, 0.35) / rate
    elif kind == "rounded":
        # A phone's fixes come a little more or less often than once a second.
        seconds = begin + np.arange(seconds.size) * rng.uniform(0.97, 1.03) / rate
        seconds = seconds[seconds < at[-1]]
        keep, late = keep[: seconds.size], late[: seconds.size]
    if kind in ("late speed", "set, defects"):
        late += rng.uniform(0.5, 3.0)
    if kind in SET:
        size = float(SIZES[seed % len(SIZES)])
        inner = moving[(moving > 0.15 * seconds.size) & (moving < 0.85 * seconds.size)]
        first = int(rng.choice(inner if inner.size else moving))
        known = kind != "set at a gap"
        length = float(np.exp(rng.uniform(np.log(2.0), np.log(30.0))))
        place = first if known else lose(first, length)
        keep[place - 3 : place] |= known
        keep[place : place + 3] = True
        mixed = kind == "mixed"

    truth = seconds + jitter * rng.uniform(-1.0, 1.0, seconds.size)
    shown = truth.copy()
    if place is not None:
        new = np.arange(seconds.size) >= place
        if mixed:
            lasts = int(rng.uniform(10.0, 30.0) * rate)
            inside = np.arange(seconds.size) < place + lasts
            new &= ~inside | (np.arange(seconds.size) % 2 == 0)
        shown = truth - size * ~new
    true_place = np.interp(truth, at, position)
    signals: dict[str, np.ndarray] = {}
    if columns != "fixes":
        lag = late if kind == "late speed" and seed % 2 else np.zeros(truth.size)
        seen = np.interp(truth - lag, at, speed) * rng.uniform(0.985, 1.015)
        seen += lasting(rng, seconds - seconds[0], 0.05, 40.0)
        signals["/train/state.speed"] = np.round(np.maximum(seen, 0.0), 2)
    if columns in ("distance", "both"):
        scale = rng.uniform(0.985, 1.015)
        step = float(rng.choice([0.1, 1.0, 5.0]))
        signals["/train/state.position"] = (
            np.round(scale * (true_place - true_place[0]) / step) * step
        )
    if columns in ("both", "fixes"):
        geometry = way(line)
        behind = np.interp(truth - late, at, position)
        latitude, longitude = geometry.at(np.clip(behind, 0.0, geometry.positions[-1]))
        metre = np.degrees(1.0 / 6_371_000.0)
        noise = rng.uniform(1.0, 5.0)
        north, east = (lasting(rng, seconds - seconds[0], noise, 25.0) for _ in range(2))
        signals["/gnss/fix.latitude"] = latitude + metre * north
        signals["/gnss/fix.longitude"] = longitude + metre * east / np.cos(np.radians(latitude))
        doppler = np.interp(truth - late, at, speed) + lasting(rng, seconds - seconds[0], 0.15, 8.0)
        signals["/gnss/motion.speed"] = np.round(np.maximum(doppler, 0.0), 2)
    order = np.flatnonzero(keep)
    if kind == "late blocks":
        first = int(rng.integers(order.size // 4, order.size // 2))
        count = int(rng.uniform(2.0, 12.0) * rate)
        block, rest = order[first : first + count], order[first + count : first + 3 * count]
        order = np.concatenate([order[:first], rest, block, order[first + 3 * count :]])
    if (seed % 5 == 4 and rate > 1.0) or (kind == "rounded" and rate == 1.0):
        shown = np.floor(shown + 1e-6)
    stamps = START + np.round(shown * 1e9).astype(np.int64)
    table = Table(
        stamps[order],
        np.arange(order.size),
        {name: values[order] for name, values in signals.items()},
    )
    where = None if place is None else int(np.searchsorted(order, place))
    return Made(table, truth[order], where, known)


def seconds_of(table: Table) -> tuple[np.ndarray, np.ndarray, set[str]]:
    """Rows that are kept, their times [s], and the rules that were met."""
    kept, findings, _ = repaired(table, Limits(), Repair())
    return kept.rows, (kept.time - START) / 1e9, {finding.rule for finding in findings}


def judged(case: Made) -> tuple[bool, bool, float, bool, float, float]:
    """Moved, right, share of rows wrong, suspected, rows of cuts that differ, rows of cuts."""
    rows, seconds, rules = seconds_of(case.table)
    error = seconds - case.truth[rows]
    # Whole seconds are rebuilt to a fraction that nobody knows.
    whole = not np.any(case.table.time % 1_000_000_000)
    error = error - (np.median(error[-200:]) if whole else 0.0)
    right = False
    if case.place is not None:
        before = np.median(error[(rows >= case.place - 40) & (rows < case.place - 2)])
        after = np.median(error[(rows > case.place + 2) & (rows <= case.place + 40)])
        tolerance = 0.2 if case.known and not whole else 0.6
        if not case.known:
            # A gap's own length is known from the motion alone.
            speed = max(float(np.nanmedian(_speed(case)[case.place - 5 : case.place + 5])), 1.0)
            tolerance = max(tolerance, 10.0 / speed)
        right = abs(after - before) <= tolerance
    differ = total = 0.0
    count = len(case.table)
    for low, high in ((0, count // 2), (count // 2, count), (count // 4, 3 * count // 4)):
        margin = count // 20
        inside = case.place is None or low + margin < case.place < high - margin
        if not inside:
            continue
        try:
            part, at, _ = seconds_of(case.table.take(np.arange(low, high)))
        except InputError:
            differ, total = differ + (high - low), total + (high - low)
            continue
        both, first, second = np.intersect1d(rows, part, return_indices=True)
        differ += np.count_nonzero(np.abs(seconds[first] - at[second]) > 0.2)
        total += both.size
    wrong = float(np.mean(np.abs(error) > (1.0 if whole else 0.5)))
    return "clock_step" in rules, right, wrong, "clock_step_suspected" in rules, differ, total


def _speed(case: Made) -> np.ndarray:
    signals = case.table.signals
    return signals.get("/train/state.speed", signals.get("/gnss/motion.speed"))  # type: ignore[return-value]


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--files", type=int, default=100, help="clean ones, and as many set ones")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", nargs="*", default=[*CLEAN, *SET])
    parser.add_argument("--verbose", action="store_true")
    args = parser.parse_args()
    print(f"{'kind':<16} files moved {'right':>28} wrong[%] suspected refused cuts[%]  ms a file")
    for kind in args.kind:
        count = args.files // (len(CLEAN) if kind in CLEAN else len(SET))
        results, columns, refused, took = [], [], 0, 0.0
        for seed in range(args.seed * 1_000, args.seed * 1_000 + count):
            case = made(kind, seed)
            began = clock_time.process_time()
            try:
                found = judged(case)
            except InputError as error:
                refused += 1
                if args.verbose:
                    print(f"  {seed} {kind}: refused: {error}")
                continue
            took += clock_time.process_time() - began
            results.append(found)
            columns.append(COLUMNS[seed % len(COLUMNS)])
            bad = found[2] > 0.01 or (found[0] if kind in CLEAN else not found[1])
            if args.verbose and (bad or found[3] or found[4]):
                size = SIZES[seed % len(SIZES)] if kind in SET else 0.0
                names = COLUMNS[seed % len(COLUMNS)]
                rate = (1, 5, 10)[seed // 2 % 3]
                made_of = f"{size:+g} s, {names}, {rate} Hz, whole {seed % 5 == 4}"
                print(f"  {seed} {kind} {made_of}: {found}")
        values = np.array(results, dtype=float).reshape(-1, 6)
        moved, _, wrong, suspected, differ, total = values.sum(axis=0)
        known_by = np.array(columns)
        right = "/".join(
            f"{values[which, 1].sum():.0f} of {np.count_nonzero(which)}"
            for which in (np.isin(known_by, COLUMNS[:2]), known_by == "fixes", known_by == "speed")
        )
        print(
            f"{kind:<16} {count:5d} {moved:5.0f} {right if kind in SET else '':>28}"
            f" {100.0 * wrong / max(len(results), 1):8.2f} {suspected:9.0f} {refused:7d}"
            f" {100.0 * differ / max(total, 1.0):7.2f} {1e3 * took / max(len(results), 1):9.0f}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
