"""What the results of a simulated fleet state, against the truth that no analysis reads.

    python benchmarks/fleet/judge_fleet.py FOLDER --catalogue WHERE [--part trips|resistance|...]
                                           [--keep FOLDER]

FOLDER is that of `trainlog simulate fleet`, WHERE a catalogue of its trips after `trainlog
fleet update`. The fleet is drawn anew from its seed: trains, faults, rail. Parts:

- ``trips``: what there is, and what became of it by analysis, kind and reason;
- ``resistance``: the true curve of every train, meant over its trips, and of every trip, in the
  95 % bands of fleet and trip;
- ``unlike``: the detection on the trips up to each day: which faults are found, when and as what,
  and alarms on trains that have none;
- ``drift``: wear of wheels;
- ``map``: maximum adhesion that lasts, by edge and layer;
- ``forecast``: each day's forecast from the days before, scored, and that of noon by layer;
- ``energy``: by line and kind, and against the truth of single trips.

Rates have the 95 % band of Clopper and Pearson. Truths of trips are kept in the folder `--keep`.
"""

from __future__ import annotations

import argparse
import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from benchmark_trains import SIGNS, band
from fleet_truth import PARAMETERS, check_rail, curves_of, drawn_again, faults_of
from rich.table import Table

from analysis.fleet.analyses import ANALYSES
from analysis.fleet.maps import maps_folder
from analysis.fleet.resistance import fleet_resistance
from analysis.fleet.trains import MONTH, fleet_trains, joined, trips_of
from analysis.fleet.unlike import FALSE_ALARMS, Finding, UnlikeTrains, unlike_trains
from analysis.network.maps import NetworkMap, network_map
from analysis.resistance.curve import band_factor, curve_std
from analysis.verification.forecasts import rolling_forecast
from analysis.verification.scores import climatology, crps, day_weights, persistence, place_alone
from analysis.verification.scoring import score_network
from analysis.verification.verify import BAND, DRAWS, FIGURES, FORECASTS, Forecaster, time_of
from trainlog.catalogue import Catalogue, open_catalogue
from trainlog.cli.terminal import console
from trainlog.formats.summaries import covariances_of, parameters_of
from trainlog.mcap import read_log
from trainlog.presentation import new_table
from trainlog.railway.condition import AdhesionEstimate, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence
from trainlog.simulation import Fault, Fleet
from trainlog.simulation.fleet import MINUTE
from trainlog.topics import TRUTH
from trainlog.units import DAY, KMH

SPEEDS = np.array([20.0, 60.0, 100.0, 140.0]) / KMH
MOST_REASONS = 4
SHOWN = tuple(each for each in FIGURES if "brier" not in each.name)


@dataclass(frozen=True, eq=False)
class Judged:
    """A fleet, its catalogue and its truth."""

    folder: Path
    catalogue: Catalogue
    fleet: Fleet
    keep: Path | None

    @cached_property
    def trips(self) -> pd.DataFrame:
        """All trips of the catalogue."""
        return self.catalogue.query()

    @cached_property
    def summaries(self) -> pd.DataFrame:
        """Summaries with passports, each trip once, by start."""
        rows = self.catalogue.results("resistance")
        own = self.trips[["key", "train", "kind"]]
        rows = rows.drop(columns=[n for n in ("train", "kind") if n in rows]).merge(own, on="key")
        return joined(rows, self.catalogue.results("passport"))

    @cached_property
    def truths(self) -> pd.DataFrame:
        """True curves of the trips, by key."""
        keep = None if self.keep is None else self.keep / "curves.parquet"
        return curves_of(self.trips, keep)

    @cached_property
    def maps(self) -> NetworkMap:
        """The maps of the edges."""
        return network_map(maps_folder(self.catalogue))


def printed(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A table on the terminal."""
    table: Table = new_table(title, *columns)
    for row in rows:
        table.add_row(*(str(each) for each in row))
    console.print(table)


# ------------------------------------------------------------------------------------------ trips


def judge_trips(given: Judged) -> None:
    """Trips by kind, and what became of them."""
    trips = given.trips
    sizes = {path: Path(path).stat().st_size for path in trips["path"].dropna()}
    rows = []
    for kind, part in [*trips.groupby("kind"), ("all", trips)]:
        size = sum(sizes[path] for path in part["path"].dropna())
        rows.append(
            (
                kind,
                part["train"].nunique(),
                f"{len(part):,}",
                f"{part['duration'].sum() / 3600.0:,.0f}",
                f"{part['distance'].sum() / 1e3:,.0f}",
                f"{size / 1e9:.2f}",
            )
        )
    made = f"{given.fleet.trips:,} simulated, {len(trips):,} in the catalogue"
    printed(f"trips: {made}", ("kind", "trains", "trips", "h", "km", "GB"), rows)
    rows, why = [], []
    for name in ANALYSES:
        found = given.catalogue.outcomes(name)
        for kind, part in [*found.groupby("kind"), ("all", found)]:
            count = part["state"].value_counts()
            states = [f"{count.get(state, 0):,}" for state in ("done", "refused", "failed")]
            rows.append((name, kind, *states, f"{part['seconds'].mean() * 1e3:.0f}"))
        bad = found[found["state"] != "done"]
        reasons = bad["reason"].map(plain_reason)
        for reason, mine in bad.groupby(reasons, sort=False):
            kinds = ", ".join(f"{n} {kind}" for kind, n in mine["kind"].value_counts().items())
            why.append((len(mine), name, mine["state"].iloc[0], kinds, reason))
    printed(
        "what became of them, and processor time a trip",
        ("analysis", "kind", "done", "refused", "failed", "ms"),
        rows,
    )
    why.sort(key=lambda row: -row[0])
    printed(
        "reasons",
        ("analysis", "state", "kinds", "reason"),
        (row[1:] for row in why[: MOST_REASONS * len(ANALYSES)]),
    )


def plain_reason(text: str) -> str:
    """A reason without the names and figures of the trip."""
    text = re.sub(r"'[^']*'", "'...'", text.split(": ", 1)[-1] if ".mcap: " in text else text)
    return re.sub(r"\d[\d.,]*", "#", text)[:160]


# ------------------------------------------------------------------------------------- resistance


def judge_resistance(given: Judged) -> None:
    """Curves of trains and of trips against the truth."""
    faults = faults_of(given.fleet)
    begun = time.perf_counter()
    found = fleet_resistance(given.summaries)
    taken = time.perf_counter() - begun
    whole: dict[str, list[bool]] = defaultdict(list)
    at: dict[str, list[np.ndarray]] = defaultdict(list)
    rows = []
    for kind in found:
        for one in kind.trains:
            keys = kind.rows.loc[kind.rows["train"] == one.train, "key"]
            true = given.truths.loc[keys, list(PARAMETERS)].mean().to_numpy(np.float64)
            inside, errors, reach = compared(one, true)
            faulty = one.train in faults
            if not faulty:
                for name in (kind.kind, "all"):
                    whole[name].append(bool(np.all(inside)))
                    at[name].append(inside[:-1])
            words = f"{faults[one.train].kind}" if faulty else ""
            errors_text = [
                f"{100 * e:+.1f} ± {100 * r:.1f}" for e, r in zip(errors, reach, strict=True)
            ]
            held = "yes" if np.all(inside) else "NO"
            rows.append((one.train, one.trips, *errors_text, held, words))
    names = tuple(f"{KMH * speed:.0f} km/h" for speed in SPEEDS)
    printed(
        f"running resistance of trains, error and 95 % band in % ({taken:.0f} s)",
        ("train", "trips", *names, "whole in band", "fault"),
        rows,
    )
    rows = [
        (kind, band(sum(held), len(held)), *(f"{100 * s:.0f} %" for s in np.mean(at[kind], axis=0)))
        for kind, held in whole.items()
    ]
    printed(
        "true curve of healthy trains in the 95 % band of the fleet",
        ("kind", "whole", *names),
        rows,
    )
    single_trips(given, faults)


def compared(one, true: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether a true curve lies in a train's band at `SPEEDS` and everywhere, error and reach."""
    speeds = np.append(SPEEDS, np.linspace(5.0, one.asked[1], 60))
    value, (low, high) = np.polyval(true[::-1], speeds), one.band(speeds)
    inside = (low <= value) & (value <= high)
    error = (one.resistance(speeds) - value) / value
    reach = 0.5 * (high - low) / value
    few = SPEEDS.size
    return np.append(inside[:few], inside[few:].all()), error[:few], reach[:few]


def single_trips(given: Judged, faults: dict[str, Fault]) -> None:
    """Curves of single trips in the bands that they state."""
    used = given.summaries[given.summaries["refused"] == ""].reset_index(drop=True)
    estimates, covariances = parameters_of(used)[:, :3], covariances_of(used)[:, :3, :3]
    truths = given.truths.loc[used["key"], list(PARAMETERS)].to_numpy(np.float64)
    inside, error = np.zeros(len(used), dtype=bool), np.zeros(len(used))
    for n, (highest, freedom) in enumerate(
        used[["asked_highest", "freedom"]].itertuples(index=False)
    ):
        speeds = np.linspace(5.0, highest, 40)
        factor = band_factor(covariances[n], (0.0, highest), freedom)
        true = np.polyval(truths[n][::-1], speeds)
        apart = np.polyval(estimates[n][::-1], speeds) - true
        inside[n] = np.all(np.abs(apart) <= factor * curve_std(covariances[n], speeds))
        error[n] = np.sqrt(np.mean((apart / true) ** 2))
    start = used["start"].astype("int64").to_numpy()
    healthy = np.array(
        [
            train not in faults or when < faults[train].start
            for train, when in zip(used["train"], start, strict=True)
        ]
    )
    kinds = used["kind"].to_numpy(str)
    groups = [(kind, healthy & (kinds == kind)) for kind in np.unique(kinds)]
    groups.append(("all", healthy))
    for train, fault in faults.items():
        mine = ~healthy & (used["train"] == train).to_numpy()
        groups.append((f"{train}, {fault.kind}", mine))
    rows = []
    for name, mine in groups:
        if mine.any():
            held, count = int(inside[mine].sum()), int(mine.sum())
            sizes = (f"{100 * np.quantile(error[mine], q):.1f} %" for q in (0.5, 0.95))
            rows.append((name, count, band(held, count), *sizes))
    printed(
        "whole true curve of single trips in their 95 % band, RMS error",
        ("kind", "trips", "in band", "median", "95 % below"),
        rows,
    )


# ----------------------------------------------------------------------------------------- unlike


def unlike_of(rows: pd.DataFrame) -> UnlikeTrains:
    """What is found on these trips."""
    return unlike_trains([(kind, trips_of(kind, rows)) for kind in fleet_resistance(rows)])


def judge_unlike(given: Judged, every: int) -> None:
    """The detection at the end of each day."""
    rows, faults = given.summaries, faults_of(given.fleet)
    start = given.fleet.start
    first = 2 if every == 1 else every
    last = int((rows["start"].max().value - start) // DAY) + 1
    seen: dict[str, tuple[int, Finding]] = {}
    false: dict[tuple[str, str], tuple[int, Finding]] = {}
    real: dict[tuple[str, str], tuple[int, Finding]] = {}
    found, months = UnlikeTrains((), (), FALSE_ALARMS, 0.0), 0.0
    for day in [*range(first, last, every), last]:
        now = pd.Timestamp(start + day * DAY, tz="UTC")
        found = unlike_of(rows[rows["start"] < now])
        for each in found.findings:
            fault = faults.get(each.train)
            if fault is not None and each.noticed.value >= fault.start:
                seen.setdefault(each.train, (day, each))
            else:
                name = (each.train, each.what)
                (real if wheels_changed(given.fleet, each) else false).setdefault(name, (day, each))
    healthy = [train.name for train in given.fleet.trains if train.name not in faults]
    months = len(healthy) * (last * DAY) / (30.0 * DAY)
    table = [fault_row(given, rows, fault, seen, found) for fault in faults.values()]
    printed(
        f"faults, detection at the end of each {'day' if every == 1 else f'{every} days'}",
        ("train", "fault", "found", "trips since", "first named", "at the end", "true", "in band"),
        table,
    )
    own = {train for train, _ in false if train in healthy}
    share = band(len(own), max(round(months), len(own), 1))
    printed(
        f"alarms on healthy trains: {len(own)} in {months:.1f} train-months, {share};"
        f" stated: at most {found.rate:.0%} a month",
        ("train", "day", "finding"),
        [(train, day, str(each)) for (train, _), (day, each) in false.items()],
    )
    printed(
        "found and true, though no fault: diameters were read, or wheels turned",
        ("train", "day", "finding", "true"),
        [
            (train, day, str(each), f"{-100.0 * wheel_step(given.fleet, each):+.2f} %")
            for (train, _), (day, each) in real.items()
        ],
    )
    steps = largest_steps(given.fleet)
    console.print(f"  largest steps of believed over true diameter in a day, no fault: {steps}")
    limits = [each for each in found.limits if each.train in faults]
    printed(
        "smallest change that is seen in five trips, nine times in ten; from the start on",
        ("train", "channel", "change", "constant", ""),
        [
            (each.train, each.channel, f"{each.change:.3g} {each.unit}", f"{each.constant:.3g}",
             each.reason)
            for each in limits
        ],
    )  # fmt: skip


def wheel_step(fleet: Fleet, found: Finding) -> float:
    """Believed over true diameter after a finding's beginning over that a day before, less 1."""
    train = next(each for each in fleet.trains if each.name == found.train)
    after, before = (train.at(found.since.value - n * DAY).wheel_factors[0] for n in (0, 1))
    return after / before - 1.0


def wheels_changed(fleet: Fleet, found: Finding) -> bool:
    """Whether a finding is a true change of the diameters."""
    cause, step = found.explanation.cause, wheel_step(fleet, found)
    right = abs(cause.size + step) < 1.96 * cause.std
    return found.what == "wheel diameter" and abs(step) > 1e-3 and right


def largest_steps(fleet: Fleet, count: int = 5) -> str:
    """The largest steps from noon to noon on trains without a fault of their wheels."""
    found = []
    for train in fleet.trains:
        if any(fault.kind == "wheel diameter" for fault in train.faults):
            continue
        noons = [fleet.start + day * DAY + DAY // 2 for day in range(fleet.days)]
        steps = np.diff(np.log([train.at(noon).wheel_factors[0] for noon in noons]))
        day = int(np.argmax(np.abs(steps)))
        found.append(
            (abs(steps[day]), f"{train.name} {100.0 * steps[day]:+.2f} % to day {day + 2}")
        )
    return ", ".join(words for _, words in sorted(found, reverse=True)[:count])


def fault_row(
    given: Judged,
    rows: pd.DataFrame,
    fault: Fault,
    seen: dict[str, tuple[int, Finding]],
    found: UnlikeTrains,
) -> tuple[object, ...]:
    """What became of a fault."""
    size = true_size(given.fleet, fault)
    true = f"{size / 1e3:.1f} kN" if fault.kind == "dragging brake" else f"{size:.3g}"
    ends = [each for each in found.findings if each.train == fault.train]
    latest = next((e for e in ends if e.what == fault.kind), ends[-1] if ends else None)
    at_end, held = "-", "-"
    if latest is not None:
        cause = latest.explanation.cause
        at_end = f"{latest.explanation}, since {latest.since:%m-%d %H:%M}"
        if cause.what == fault.kind:
            held = "yes" if abs(cause.size - size) < 1.96 * cause.std else "NO"
    if fault.train not in seen:
        return fault.train, fault.kind, "NO", "-", "-", at_end, true, held
    day, first = seen[fault.train]
    own = rows.loc[rows["train"] == fault.train, "start"]
    own = own[own.astype("int64") >= fault.start]
    noticed = int((own <= first.noticed).sum())
    until = int((own < pd.Timestamp(given.fleet.start + day * DAY, tz="UTC")).sum())
    others = {each.what for each in first.explanation.others}
    named = "right" if first.what == fault.kind else first.what
    if fault.kind in others:
        named += ", among others"
    elif first.what == fault.kind and others:
        named += f", or {', '.join(sorted(others))}"
    return fault.train, fault.kind, f"day {day}", f"{noticed} ({until})", named, at_end, true, held


def true_size(fleet: Fleet, fault: Fault) -> float:
    """The size of a fault in the measure of the findings."""
    if fault.kind == "mass":
        train = next(each for each in fleet.trains if each.name == fault.train)
        return fault.size / train.train.mass
    return SIGNS.get(fault.kind, 1.0) * fault.size


# ------------------------------------------------------------------------------------------ drift


def judge_drift(given: Judged) -> None:
    """Wear of wheels as the speed scale shows it."""
    found = fleet_trains(given.summaries).drift
    wear = {each.name: each for each in given.fleet.trains}
    rows, reasons = [], defaultdict(int)
    for each in found:
        if each.channel != "speed scale" or not each.train:
            continue
        if not np.isfinite(each.trend):
            reasons[each.reason] += 1
            continue
        train = wear[each.train]
        distance = train.wear["daily_distance"] * MONTH
        diameter = 2.0 * train.train.axles.wheel_radius
        own = train.wear["diameter_per_distance"] * distance / diameter
        low, high = each.band
        held = "yes" if low <= own <= high else "NO"
        rows.append((each.train, f"{1e6 * own:.0f}", f"{1e6 * low:.0f} to {1e6 * high:.0f}", held))
    printed(
        "wear of wheels, millionths of the speed scale a month",
        ("train", "true", "95 % band", "in band"),
        rows,
    )
    for reason, count in reasons.items():
        console.print(f"  {count} trains: no trend: {reason}")
    rest = [each for each in found if each.drifts and each.channel != "speed scale"]
    for each in rest:
        console.print(f"  drifts: {each}")


# -------------------------------------------------------------------------------------------- map


class Held:
    """Bins, their errors, and how many are in their band."""

    def __init__(self) -> None:
        self.errors: list[np.ndarray] = []
        self.inside: list[np.ndarray] = []

    def add(self, estimate: AdhesionEstimate, true: np.ndarray, chosen: np.ndarray) -> None:
        """Bins of an edge."""
        low, high = estimate.quantile(0.025), estimate.quantile(0.975)
        self.errors.append((np.exp(estimate.log_mean) - true)[chosen])
        self.inside.append(((low <= true) & (true <= high))[chosen])

    def words(self) -> str:
        """Bins, root mean square error and share in the band."""
        errors = np.concatenate(self.errors) if self.errors else np.zeros(0)
        if errors.size == 0:
            return "-"
        share = np.mean(np.concatenate(self.inside))
        return f"{errors.size} {np.sqrt(np.mean(errors**2)):.4f} / {share:.1%}"


def judge_map(given: Judged) -> None:
    """Lasting maximum adhesion by edge and layer, and by the trips and days that show it."""
    apart = check_rail(given.fleet, given.trips)
    console.print(f"maximum adhesion of logs drawn anew: the same to {apart:.1e}")
    edges: dict[str, dict[str, Held]] = defaultdict(lambda: defaultdict(Held))
    by_trips: dict[str, dict[str, Held]] = defaultdict(lambda: defaultdict(Held))
    for edge, track in given.maps.maps.items():
        rail = given.fleet.rail(edge)
        for name, layer in track.layers.items():
            # Directions that differ have layers of their own; the drawn rail is one for both.
            condition = name.partition(" ")[0]
            true = rail.lasting(condition, given.fleet.start)(track.centres)
            trips = layer.evidence.by_bin("trips")
            bins_of_days = layer.evidence.bin[layer.evidence.trips > 0.0]
            days = np.bincount(bins_of_days, minlength=track.bins)
            for row in (edge, "all"):
                for column in (name, "all"):
                    edges[row][column].add(layer, true, trips > 0)
            for words, chosen in (
                ("of one trip", trips == 1),
                ("of one day", days == 1),
                ("of one day, of several trips", (days == 1) & (trips > 1)),
                ("of ten or more", trips >= 10),
                ("without onsets", (trips == 0) & layer.observed),
            ):
                for column in (name, "all"):
                    by_trips[words][column].add(layer, true, chosen)
    layers = given.maps.layers
    printed(
        "lasting maximum adhesion in bins with onsets: bins, RMS error / in the 95 % band",
        ("edge", *layers, "all"),
        [
            (row, *(cells[each].words() for each in (*layers, "all")))
            for row, cells in sorted(edges.items(), key=lambda item: item[0] == "all")
        ],
    )
    printed(
        "the same, all edges",
        ("bins with onsets", *layers, "all"),
        [
            (row, *(cells[each].words() for each in (*layers, "all")))
            for row, cells in by_trips.items()
        ],
    )


def judge_forecast(given: Judged) -> None:
    """Each day's forecast, scored as by `trainlog map score --rolling`, and against the truth."""
    begun = time.process_time()
    forecasters = {edge: rolling_forecast(track) for edge, track in given.maps.maps.items()}
    whole, edges = score_network(given.maps, None, None, forecasters)
    names = [name for name in whole.layers if name != "all"]
    printed(
        f"each day's forecast from the days before, {len(edges)} edges (95 % band by day;"
        f" {time.process_time() - begun:.0f} s of processor time)",
        ("", *names, "all"),
        [
            (row.heading, *(row.words(row.cell(whole.layers[name])) for name in (*names, "all")))
            for row in SHOWN
        ],
    )
    gains = [
        (
            edge,
            each.layers["all"].onsets,
            *(
                f"{each.layers['all'].log_score('onsets', over=name).value:+.2f}"
                for name in FORECASTS[1:]
            ),
            f"{each.layers['all'].onsets_in_band.value:.1%}",
        )
        for edge, each in edges.items()
    ]
    columns = (
        "edge", "onsets", "over the prior", "over persistence", "over the place alone",
        "onsets in band",
    )  # fmt: skip
    printed("log score of onsets by edge [nat]", columns, gains)
    for note in whole.notes:
        console.print(f"  {note}")
    against_rail(given, forecasters)


def against_rail(given: Judged, forecasters: dict[str, Forecaster]) -> None:
    """Each day's forecast against the true maximum adhesion at noon, in all bins it is known in."""
    parts: list[dict[str, object]] = []
    for edge, track in given.maps.maps.items():
        rail = given.fleet.rail(edge)
        every = DailyEvidence.total(layer.evidence for layer in track.layers.values())
        for day in track.days[1:].tolist():
            noon = time_of(day)
            name = rail.weather(noon.value).condition
            expected = forecasters[edge](name, noon) if name in track.layers else None
            if expected is None or not expected.observed.any():
                continue
            met = rail.profile(noon.value, noon.value // MINUTE)(track.centres)
            parts.append(
                {"day": day, "layer": name} | errors_of(track, name, day, every, expected, met)
            )
    table = pd.DataFrame(parts)
    rows = []
    for name, part in [*table.groupby("layer"), ("all", table)]:
        days = part.drop(columns="layer").groupby("day").sum()
        weights = np.vstack((np.ones(len(days)), day_weights(len(days), DRAWS)))
        sums = {column: weights @ days[column].to_numpy() for column in days}
        cells = [f"{sums['forecast'][0] / sums['bins'][0]:.4f}"]
        for other in FORECASTS[1:]:
            skill = 1.0 - sums["forecast"] / sums[other]
            low, high = np.quantile(skill[1:], BAND)
            cells.append(f"{skill[0]:+.2f} ({low:+.2f}, {high:+.2f})")
        held = sums["inside"] / sums["bins"]
        low, high = np.quantile(held[1:], BAND)
        cells.append(f"{held[0]:.1%} ({low:.1%}, {high:.1%})")
        rows.append((name, len(days), int(sums["bins"][0]), *cells))
    columns = ("rail", "days", "bins", "CRPS", "skill over the prior", "over persistence",
               "over the place alone", "in the 95 % band")  # fmt: skip
    printed("forecast against the true maximum at noon (95 % band by day)", columns, rows)


def errors_of(
    track: TrackConditionMap,
    layer: str,
    day: int,
    every: DailyEvidence,
    expected: AdhesionEstimate,
    met: np.ndarray,
) -> dict[str, float]:
    """Sums over the bins that are known: CRPS of each forecast, and bins in the 95 % band."""
    known = np.flatnonzero(expected.observed)
    earlier = track.layer(layer).evidence.between(-1, day - 1)
    others = {
        "forecast": expected,
        "prior": climatology(track, layer),
        "persistence": persistence(track, layer, earlier),
        "place": place_alone(track, layer, every.between(-1, day - 1)),
    }
    low, high = (expected.quantile(share)[known] for share in BAND)
    inside = float(np.count_nonzero((low <= met[known]) & (met[known] <= high)))
    sums = {name: float(crps(e.at_bins(known), met[known]).sum()) for name, e in others.items()}
    return sums | {"bins": float(known.size), "inside": inside}


# ----------------------------------------------------------------------------------------- energy


def judge_energy(given: Judged, count: int) -> None:
    """Work and energy by line and kind, and that of single trips against the truth."""
    table = given.catalogue.results("driving")
    own = given.trips[["key", "train", "kind"]]
    table = table.drop(columns=[n for n in ("train", "kind") if n in table]).merge(own, on="key")
    kinds = sorted(table["kind"].unique())
    rows = []
    for edge, part in [*table.groupby("edge"), ("all", table)]:
        cells = []
        for kind in kinds:
            mine = part[part["kind"] == kind]
            distance = mine["distance"].sum() / 1e3
            if not distance:
                cells.append("-")
                continue
            sums = mine[["traction", "dynamic_braking", "line_energy"]].sum() / 3.6e6
            cells.append(" ".join(f"{each / distance:.2f}" for each in sums))
        rows.append((edge, *cells))
    printed(
        "kWh a km: traction and dynamic brake at the wheel, from the line less fed back",
        ("edge", *kinds),
        rows,
    )
    mass = [table.loc[table["kind"] == kind, "mass"].mean() / 1e3 for kind in kinds]
    console.print(
        "  mass: " + ", ".join(f"{k} {m:.0f} t" for k, m in zip(kinds, mass, strict=True))
    )
    against_truth(given, table, count)


def against_truth(given: Judged, table: pd.DataFrame, count: int) -> None:
    """Work of traction of single trips over the true work.

    The true work is that of the motors: of slipping wheels it has what slip takes, too.
    """
    sums = table.groupby("key")[["traction"]].sum(min_count=1)
    chosen = given.trips[given.trips["key"].isin(sums.index) & given.trips["path"].notna()]
    chosen = chosen.iloc[:: max(len(chosen) // count, 1)]
    vehicles = {each.name: each for each in given.fleet.trains}
    ratios: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for key, train, kind, path, start, weather in chosen[
        ["key", "train", "kind", "path", "start", "weather"]
    ].itertuples(index=False):
        true = read_log(path, topics=[TRUTH.name])[TRUTH.name]["energy"].iloc[-1]
        condition = vehicles[train].at(pd.Timestamp(start).value)
        gain = condition.effort_gain * condition.wheel_factors[0]
        ratio = float(sums.loc[key, "traction"] / true)
        rail = "dry rail" if weather == "dry" else "other rail"
        for name in (f"{kind}, {rail}", f"all, {rail}"):
            ratios[name].append((ratio, ratio / gain))
    rows = []
    for name, found in sorted(ratios.items(), key=lambda item: (item[0][:3] == "all", item[0])):
        raw, known = np.array(found).T
        rows.append(
            (
                name,
                len(found),
                f"{100 * (np.median(raw) - 1):+.2f} %",
                f"{100 * np.sqrt(np.mean((raw - 1) ** 2)):.2f} %",
                f"{100 * np.abs(raw - 1).max():.2f} %",
                f"{100 * np.sqrt(np.mean((known - 1) ** 2)):.2f} %",
            )
        )
    printed(
        "work of traction of single trips over the true work",
        ("kind", "trips", "median", "RMS", "largest", "RMS without the recorder's errors"),
        rows,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--catalogue", required=True)
    parser.add_argument("--keep", type=Path, help="folder for truths of trips, used again")
    parser.add_argument("--every", type=int, default=1, help="days between two detections")
    parser.add_argument("--trips", type=int, default=60, help="whose energy is compared")
    parts = ("trips", "resistance", "unlike", "drift", "map", "forecast", "energy")
    parser.add_argument("--part", choices=("all", *parts), nargs="+", default=["all"])
    options = parser.parse_args()
    work: dict[str, Callable[[Judged], None]] = {
        "trips": judge_trips,
        "resistance": judge_resistance,
        "unlike": lambda given: judge_unlike(given, options.every),
        "drift": judge_drift,
        "map": judge_map,
        "forecast": judge_forecast,
        "energy": lambda given: judge_energy(given, options.trips),
    }
    with open_catalogue(options.catalogue) as catalogue:
        given = Judged(options.folder, catalogue, drawn_again(options.folder), options.keep)
        for part in parts if "all" in options.part else options.part:
            work[part](given)


if __name__ == "__main__":
    main()
