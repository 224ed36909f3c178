"""What a recorder lacks, and what becomes of slip and the track-condition map.

    python benchmarks/map/defects.py [--trips 2] [--seed 5] [--only "load unknown" ...]
    python benchmarks/map/defects.py --characteristics [--trips 6] [--seed 5]

Wet trips of three trains over three lines are simulated with a drive, a creep curve, axle loads and
a load that no analysis assumes; then what a recorder writes is spoilt, one defect a row. Printed
are trips used; slips found (recall) and falsely reported (precision), those within a margin of the
threshold left out; and of the map, in the bins with onsets of slip: how far the maximum adhesion is
off (mean of its logarithm), and the share within the 95 % band. "lowest" is the share of bins in
which the adhesion counted as used without slip exceeds the true maximum by more than 5 %.

With ``--characteristics`` nothing is spoilt: the same trips run on rails of other adhesion
characteristics than the one with which the map was developed, one a row.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from characteristics import eurosprinter

from analysis.adhesion.condition_map import adhesion_map
from analysis.adhesion.slip import SlipAnalysis, slip
from analysis.resistance.passport import estimated_passport
from analysis.truth import true_adhesion, truth_of
from estimators.adhesion import SlipDetector
from trainlog.errors import TrainlogError
from trainlog.formats.railway import read_line, with_passport
from trainlog.formats.samples import sample
from trainlog.formats.ttobench import read_track, read_train as read_foreign_train
from trainlog.railway.adhesion import AdhesionCharacteristic, CreepCurve, polach_curve
from trainlog.railway.passport import Quantity
from trainlog.simulation import Scenario, draw_scenarios, drive, recorded
from trainlog.simulation.plant import Plant
from trainlog.spans import runs_of
from trainlog.trip import Trip

LIBRARY = Path(__file__).resolve().parent / "../../../shared/data/ttobench"
"""TTOBench beside the checkout; another place with ``--library``."""

AXLES, CONTROLS, STATE = "/train/axles", "/train/controls", "/train/state"


@dataclass(frozen=True, eq=False)
class OtherRail(Scenario):
    """A scenario whose rail, drive and axle loads are not those that trainlog assumes.

    Attributes
    ----------
    steeper : float
        How many times less slip than in Zhao et al. (2025) goes with the maximum adhesion.
    threshold, delay : float [m/s], [s]
        Slip speed at which the slip protection acts, and how long it waits.
    """

    steeper: float = 2.5
    threshold: float = 2.4
    delay: float = 0.2

    def plant(self) -> Plant:
        """The train on that rail."""
        found = super().plant()
        rail = found.rail.copy()
        rail[:, 2:4] *= self.steeper  # without effect where there is a characteristic
        generator = np.random.default_rng(self.seed)
        weights = found.parameters.axle_weight * generator.uniform(0.95, 1.05, found.axles)
        weights *= found.weights.sum() / weights.sum()
        parameters = found.parameters._replace(
            slip_threshold=self.threshold,
            slip_delay=self.delay,
            slip_release=0.3 * self.threshold,
            slip_reapply=0.6,
            slip_ramp=0.08,
            motor_lag=0.03 + 0.6 * self.delay,
        )
        return replace(found, parameters=parameters, rail=rail, weights=weights)


@dataclass(frozen=True, eq=False)
class Driven:
    """A trip as the recorder holds it, and its true slip speeds at the axles' samples."""

    trip: Trip
    time: pd.DatetimeIndex
    slip: np.ndarray
    peak_slip: np.ndarray
    """Slip speed of the maximum adhesion there, (n,)."""


def driven(scenario: Scenario) -> Driven:
    plant, run = scenario.plant(), drive(scenario)
    trip = recorded(scenario, run)
    names = plant.columns
    speed = run.samples[:, names.index("speed")]
    wheels = run.samples[:, [i for i, n in enumerate(names) if n.startswith("wheel_speed_")]]
    if scenario.characteristic is not None:
        speeds = np.linspace(0.0, speed.max(), 200)
        best = scenario.characteristic.optimal_slip_speed(speeds)
        peak_slip = np.interp(speed, speeds, best)
    else:
        row = np.searchsorted(plant.rail[:, 0], run.samples[:, 0], side="right") - 1
        a, b = plant.rail[np.maximum(row, 0), 2:4].T
        peak_slip = np.log(b / a) / (b - a)
    metadata = {**trip.metadata, "load": f"{scenario.load:.0f}"}
    return Driven(
        replace(trip, metadata=metadata),
        pd.DatetimeIndex(trip[AXLES].index),
        wheels - speed[:, None],
        peak_slip,
    )


def scenarios(
    library: Path, trips: int, seed: int, kind: type[Scenario] = OtherRail, **rail: Any
) -> list[Scenario]:
    pairs = [
        (
            read_track(library / "tracks/CH_StGallen_Wil.json"),
            read_foreign_train(library / "trains/CH_Stadler_FLIRT_TPF.json"),
        ),
        (
            read_line(sample("DE_Chemnitz_Cranzahl.line.json")),
            read_foreign_train(library / "trains/CH_Stadler_KISS_SBB.json"),
        ),
        (
            read_track(library / "tracks/00_reference.json"),
            read_foreign_train(library / "trains/NL_Intercity_VIRM6.json"),
        ),
    ]
    found = []
    for number, (line, train) in enumerate(pairs):
        generator = np.random.default_rng([seed, number])
        drawn = draw_scenarios(line, train, 4 * trips, seed=seed + number)
        for each in [s for s in drawn if s.weather == "wet"][:trips]:
            load = round(train.mass * generator.uniform(0.1, 0.3))
            known = {name: getattr(each, name) for name in each.__dataclass_fields__}
            known |= {"mass": train.mass + load, "name": f"{train.name}-{each.name}"}
            known["habits"] = replace(each.habits, lever=1.0, deceleration=0.65)
            found.append(kind(**{**known, **rail}))
    return found


def with_frame(trip: Trip, topic: str, change: Callable[[pd.DataFrame], pd.DataFrame]) -> Trip:
    before = trip[topic]
    after = change(before.copy())
    after.attrs = before.attrs
    return replace(trip, topics={**trip.topics, topic: after})


def efforts(frame: pd.DataFrame) -> list[str]:
    return [name for name in frame.columns if "effort" in name and "demand" not in name]


def speeds(frame: pd.DataFrame) -> list[str]:
    return [name for name in frame.columns if name.startswith("wheel_speed_")]


def of_efforts(change: Callable[[pd.DataFrame], pd.DataFrame], *topics: str) -> Callable:
    def spoilt(trip: Trip) -> Trip:
        def changed(frame: pd.DataFrame) -> pd.DataFrame:
            names = efforts(frame)
            frame[names] = change(frame[names])
            return frame

        for topic in topics or (AXLES, CONTROLS):
            trip = with_frame(trip, topic, changed)
        return trip

    return spoilt


def late(frame: pd.DataFrame, delay: float) -> pd.DataFrame:
    """Each effort as it was `delay` [s] before."""
    clock = frame.index.asi8 / 1e9
    columns = {n: np.interp(clock - delay, clock, frame[n].to_numpy()) for n in frame}
    return pd.DataFrame(columns, frame.index)


def unknown_load(trip: Trip) -> Trip:
    return replace(trip, metadata={k: v for k, v in trip.metadata.items() if k != "load"})


def only_total(trip: Trip) -> Trip:
    return with_frame(trip, AXLES, lambda frame: frame.drop(columns=efforts(frame)))


def unseen_axles(trip: Trip, every: int) -> Trip:
    """Of each `every` axles one speed is recorded."""

    def changed(frame: pd.DataFrame) -> pd.DataFrame:
        lost = [name for i, name in enumerate(speeds(frame)) if i % every]
        frame[lost] = np.nan
        return frame

    return with_frame(trip, AXLES, changed)


def unknown_delay(trip: Trip, delay: float = 0.3) -> Trip:
    """Efforts that are late, and a passport that knows it to half a second only."""
    known = replace(estimated_passport(trip), effort_delay=Quantity(0.0, 0.25, "assumed"))
    return with_passport(of_efforts(partial(late, delay=delay))(trip), known)


def slower(trip: Trip, every: int) -> Trip:
    topics = (AXLES, CONTROLS, STATE, "/environment")
    for topic in topics:
        trip = with_frame(trip, topic, lambda frame: frame.iloc[::every])
    return trip


def noisy(trip: Trip, std: float) -> Trip:
    generator = np.random.default_rng(0)

    def changed(frame: pd.DataFrame) -> pd.DataFrame:
        names = [name for name in frame.columns if name.startswith(("wheel_speed", "speed"))]
        frame[names] += std * generator.standard_normal((len(frame), len(names)))
        return frame

    return with_frame(with_frame(trip, AXLES, changed), STATE, changed)


CHARACTERISTICS: dict[str, AdhesionCharacteristic | str | None] = {
    "Zhao et al. (2025)": None,
    "Polach (2005), dry": polach_curve("dry"),
    "Polach (2005), wet": polach_curve("wet"),
    "Polach, wet, friction falls to 0.7": replace(polach_curve("wet"), friction_ratio=0.7),
    "Polach, wet, friction falls to 0.2": replace(polach_curve("wet"), friction_ratio=0.2),
    "Ishikawa-Kawamura, peak at 2.2 %": CreepCurve(2.46, 203.0, 0.325, 0.325, "creepage"),
    "Eurosprinter 1, flat beyond 1 %": "1",
    "Eurosprinter 2, peak at 1.6 %": "2",
}
"""Rails on which the same trips run; a number is CONTACT's curve of the Eurosprinter."""


def characteristic_rows(options: argparse.Namespace) -> None:
    """Print a row for each characteristic, with the drive that is assumed and with another."""
    for kind, words in ((Scenario, "drive as assumed"), (OtherRail, "another drive, other loads")):
        print(words)
        for name, curve in CHARACTERISTICS.items():
            rail = eurosprinter(curve).table() if isinstance(curve, str) else curve
            known: dict[str, Any] = {"characteristic": rail}
            if kind is OtherRail:
                known["steeper"] = 1.0
            total = Counts()
            grouped: dict[str, list[Driven]] = {}
            for scenario in scenarios(options.library, options.trips, options.seed, kind, **known):
                grouped.setdefault(scenario.train.name, []).append(driven(scenario))
            for train, each in grouped.items():
                found = row_of(each, lambda trip: trip)
                if options.each:
                    print(f"    {train:30s}{found.row()}", flush=True)
                total += found
            print(f"{name:34s}{total.row()}", flush=True)


DEFECTS: dict[str, Callable[[Trip], Trip]] = {
    "clean, load stated": lambda trip: trip,
    "load unknown": unknown_load,
    "axle efforts empty": of_efforts(lambda values: values * np.nan, AXLES),
    "axle efforts zero": of_efforts(lambda values: values * 0.0, AXLES),
    "efforts 0.2 s late": of_efforts(partial(late, delay=0.2)),
    "efforts 0.5 s late": of_efforts(partial(late, delay=0.5)),
    "efforts 0.3 s late, unknown": unknown_delay,
    "efforts + 10 %": of_efforts(lambda values: values * 1.1),
    "only total effort": only_total,
    "one speed a bogie": partial(unseen_axles, every=2),
    "2 Hz": partial(slower, every=5),
    "1 Hz": partial(slower, every=10),
    "speed noise 0.3 m/s": partial(noisy, std=0.3),
    "axle efforts + 25 %": of_efforts(lambda values: values * 1.25, AXLES),
    "load, delay and gain": lambda trip: of_efforts(lambda v: late(v, 0.3) * 0.9)(
        unknown_load(trip)
    ),
}


@dataclass
class Counts:
    """What is counted and summed of trips and maps."""

    trips: int = 0
    refused: int = 0
    true: int = 0
    missed: int = 0
    reported: int = 0
    false: int = 0
    bins: int = 0
    bias: float = 0.0
    square: float = 0.0
    off: float = 0.0
    """Sum of squared errors of the maximum adhesion itself."""
    inside: int = 0
    bounded: int = 0
    beyond: int = 0
    seconds: float = 0.0

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            *(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True))
        )

    def row(self) -> str:
        """Below `HEADER`."""
        recall = 1.0 - self.missed / max(self.true, 1)
        precision = 1.0 - self.false / self.reported if self.reported else np.nan
        n = max(self.bins, 1)
        adhesion = (
            f"{self.bias / n:+7.3f}  {np.sqrt(self.square / n):6.3f}  {np.sqrt(self.off / n):6.4f}"
            f"  {self.inside / n:7.3f}"
            if self.bins
            else "      -       -       -        -"
        )
        return (
            f"{self.trips:4d}  {self.refused:4d}  {self.true:6d}  {recall:6.3f}  {precision:9.3f}"
            f"  {self.bins:5d}  {adhesion}  {self.beyond / max(self.bounded, 1):6.3f}"
            f"  {1e3 * self.seconds / max(self.trips, 1):6.0f}"
        )


HEADER = (
    f"{'':34s}used  none   slips  recall  precision   bins  bias ln  RMS ln     RMS  in band"
    "  lowest  ms/trip"
)


def slips_of(
    each: Driven, found: SlipAnalysis, seen: np.ndarray, *, low: bool, margin: float = 0.3
) -> Counts:
    """Slips beyond 1.5 m/s; with `low` those beyond the slip of the maximum adhesion."""
    counts = Counts()
    if low:
        # Certainly beyond the maximum; certainly short of it.
        size = np.abs(each.slip) / each.peak_slip[:, None]
        truly, high, never = size > 1.0, 1.3, 0.7
    else:
        size = np.abs(each.slip)
        truly = SlipDetector(each.slip.shape[1], 0.0).update(each.slip)
        high, never = 1.5 + margin, 1.5 - margin
    events = found.events
    for axle in np.flatnonzero(seen):
        own = events[events["axle"] == axle + 1]
        starts, ends = (pd.DatetimeIndex(own[n]).asi8 for n in ("start", "release"))
        clock = each.time.asi8
        reach = int(1e9)
        for a, b in runs_of(truly[:, axle]):
            if size[a:b, axle].max() > high:
                counts.true += 1
                met = (starts <= clock[b - 1] + reach // 2) & (ends >= clock[a] - reach // 2)
                counts.missed += not met.any()
        for start, end in zip(starts, ends, strict=True):
            a, b = np.searchsorted(clock, [start - reach // 2, end + reach // 2])
            counts.reported += 1
            counts.false += bool(size[a : b + 1, axle].max() < never)
    return counts


def seen_axles(trip: Trip) -> np.ndarray:
    """Whether the speed of each axle is recorded, (axles,)."""
    frame = trip[AXLES]
    return frame[speeds(frame)].notna().any().to_numpy()


def row_of(each: list[Driven], spoil: Callable[[Trip], Trip], *, low: bool = False) -> Counts:
    """The figures of one train on one line."""
    counts, used = Counts(), []
    for one in each:
        trip = spoil(one.trip)
        begun = time.perf_counter()
        try:
            found = slip(trip)
        except TrainlogError as error:
            counts.refused += 1
            reasons.setdefault(str(error), None)
            continue
        counts.seconds += time.perf_counter() - begun
        counts.trips += 1
        counts += slips_of(one, found, seen_axles(trip), low=low)
        used.append(trip)
    if used:
        counts += map_of(used)
    return counts


reasons: dict[str, None] = {}


def map_of(trips: list[Trip]) -> Counts:
    counts = Counts()
    try:
        track = adhesion_map(trips).track
    except TrainlogError as error:
        reasons.setdefault(str(error), None)
        return counts
    truths = [truth_of(trip) for trip in trips]
    for name, layer in track.layers.items():
        true = true_adhesion(track, name, truths)
        seen = layer.events > 0
        error = (layer.log_mean - np.log(true))[seen]
        counts.bins += error.size
        counts.bias += error.sum()
        counts.square += np.sum(error**2)
        counts.off += np.sum((np.exp(layer.log_mean) - true)[seen] ** 2)
        counts.inside += np.count_nonzero(np.abs(error) < 1.96 * layer.log_std[seen])
        level = np.max(np.where(layer.evidence.censored > 0.0, track.levels, 0.0), axis=1)
        shown = (level > 0.0) & ~seen
        counts.bounded += np.count_nonzero(shown)
        counts.beyond += np.count_nonzero((level > 1.05 * true)[shown])
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trips", type=int, default=2, help="of each train")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--only", nargs="+", default=[*DEFECTS, "slip below 1.5 m/s"])
    parser.add_argument("--library", type=Path, default=LIBRARY)
    parser.add_argument("--characteristics", action="store_true", help="other rails instead")
    parser.add_argument("--each", action="store_true", help="a row for each train, too")
    options = parser.parse_args()
    if options.characteristics:
        print(HEADER, flush=True)
        characteristic_rows(options)
        for reason in reasons:
            print(f"  refused: {reason}")
        return
    grouped: dict[tuple[str, bool], list[Driven]] = {}
    for low in (False, True):
        rail = {"steeper": 7.0, "threshold": 0.6, "delay": 0.0} if low else {}
        if low and "slip below 1.5 m/s" not in options.only:
            continue
        for scenario in scenarios(options.library, options.trips, options.seed, **rail):
            grouped.setdefault((scenario.train.name, low), []).append(driven(scenario))
    print(HEADER, flush=True)
    for name in options.only:
        total = Counts()
        for (train, low), each in grouped.items():
            if low != (name == "slip below 1.5 m/s"):
                continue
            found = row_of(each, DEFECTS.get(name, lambda trip: trip), low=low)
            if options.each:
                print(f"    {train:30s}{found.row()}", flush=True)
            total += found
        print(f"{name:34s}{total.row()}", flush=True)
    for reason in reasons:
        print(f"  refused: {reason}")


if __name__ == "__main__":
    main()
