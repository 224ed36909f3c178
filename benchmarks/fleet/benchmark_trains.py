"""What a fleet shows of its trains, against what is true.

    python benchmarks/fleet/benchmark_trains.py [--part PART]

Parts: bands, axles, creep, faults, passing, missing, false-alarms, drift.

Bands, axles and faults: trains of three kinds on three lines, simulated, recorded by their sensors
and fitted (`simulated_trains`). False alarms, missing channels and drift: tables drawn from the
errors of such fits, with other tails and effects than the estimator takes for true
(`drawn_trains`). A fault begins after 30 trips (40 where drawn); "seen within" counts the trips
from then on. Rates have the 95 % band of Clopper and Pearson.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
import pandas as pd
from drawn_trains import Fault, drawn_fleet
from scipy.stats import beta
from simulated_trains import FAULTS, KINDS, RAILS, Task, healthy, rows_of

from analysis.fleet.resistance import fleet_resistance
from analysis.fleet.trains import FleetTrains, fleet_trains
from analysis.resistance.curve import band_factor, curve_std
from trainlog.formats.summaries import covariances_of, parameters_of
from trainlog.railway.resistance import basis
from trainlog.units import KMH

POOL = Path(__file__).parents[2] / "tests" / "data" / "fleet_trips.parquet"
SPEEDS = np.linspace(5.0, 34.0, 30)
SINCE = 30


def band(count: int, of: int) -> str:
    """A share in per cent with its 95 % band."""
    low = beta.ppf(0.025, count, of - count + 1) if count else 0.0
    high = beta.ppf(0.975, count + 1, of - count) if count < of else 1.0
    return f"{100.0 * count / of:5.1f} % ({100.0 * low:.1f} to {100.0 * high:.1f} %)"


def inside(rows: pd.DataFrame) -> dict[str, list[bool]]:
    """Whether each train's true curve, with what its kind's days add, lies in its band."""
    found: dict[str, list[bool]] = defaultdict(list)
    names = ("r0", "r1", "r2")
    for kind in fleet_resistance(rows):
        mine = rows[rows["kind"] == kind.kind]
        days = [np.median(mine[f"true_{name}"] / mine[f"own_{name}"]) for name in names]
        for one in kind.trains:
            own = mine[mine["train"] == one.train].iloc[0]
            own = [own[f"own_{name}"] * day for name, day in zip(names, days, strict=True)]
            true = np.polyval(own[::-1], SPEEDS)
            low, high = one.band(SPEEDS)
            found[kind.kind].append(bool(np.all((low <= true) & (true <= high))))
    return found


def bands(fleets: list[pd.DataFrame], drawn: int) -> None:
    """Share of true curves inside the 95 % band, by trips of the train."""
    pool = pd.read_parquet(POOL)
    print("share of trains whose true curve lies in the 95 % band, whole from 18 to 122 km/h")
    for trips in (1, 3, 10, 30):
        for name, given in (
            ("simulated", [part for fleet in fleets for part in _parts(fleet, trips)]),
            ("drawn", [drawn_fleet(pool, 900 + n, trains=10, trips=trips) for n in range(drawn)]),
        ):
            together: dict[str, list[bool]] = defaultdict(list)
            for rows in given:
                for kind, held in inside(rows).items():
                    together[kind] += held
            text = ", ".join(f"{k} {band(sum(h), len(h))}" for k, h in sorted(together.items()))
            print(f"  {trips:2d} trips, {name:9s}: {text}", flush=True)


def _parts(fleet: pd.DataFrame, trips: int) -> list[pd.DataFrame]:
    """Disjoint stretches of a fleet with so many trips of each train."""
    last = int(fleet["number"].max()) + 1
    firsts = range(0, last - trips + 1, max(trips, 5))
    return [fleet[(fleet["number"] >= n) & (fleet["number"] < n + trips)] for n in firsts]


def axles(rows: pd.DataFrame) -> None:
    """Trips of trains that record no axles, so that slip and creep are not seen: single and all."""
    used = rows[rows["refused"] == ""].reset_index(drop=True)
    estimates, covariances = parameters_of(used)[:, :3], covariances_of(used)[:, :3, :3]
    true = used[["true_r0", "true_r1", "true_r2"]].to_numpy(np.float64)
    apart = (estimates - true) @ basis(SPEEDS).T
    held = np.zeros(len(used), dtype=bool)
    for n, (highest, freedom) in enumerate(
        used[["asked_highest", "freedom"]].itertuples(index=False)
    ):
        factor = band_factor(covariances[n], (0.0, highest), freedom)
        below = highest >= SPEEDS
        held[n] = np.all(
            np.abs(apart[n]) <= factor * curve_std(covariances[n], SPEEDS), where=below
        )
    print("no axles recorded: whole true curve of single trips in the 95 % band, mean error")
    share = apart / (true @ basis(SPEEDS).T)
    for kind in KINDS:
        mine = (used["kind"] == kind).to_numpy()
        count = int(mine.sum())
        errors = ", ".join(
            f"{100.0 * share[mine, at].mean():+.1f} ±"
            f" {196.0 * share[mine, at].std(ddof=1) / np.sqrt(count):.1f} %"
            f" at {KMH * SPEEDS[at]:.0f} km/h"
            for at in (0, 9, 19)
        )
        print(f"  {kind:6s} {band(int(held[mine].sum()), count)} of {count}; {errors}", flush=True)
    for kind, inside_band in inside(rows).items():
        print(
            f"  trains, {kind}: {sum(inside_band)} of {len(inside_band)} in the band of the fleet"
        )


def creep(rows: pd.DataFrame) -> None:
    """Delays of trains that record no axles, on rails whose creep curves have other forms."""
    shown = rows[rows["effort_delay_source"] == "estimated"]
    print("no axles recorded: true delay in its 95 % band; without the lead by creep; mean error")
    for (rail, kind), mine in shown.groupby(["rail", "kind"]):
        error = mine["effort_delay"] - mine["true_effort_delay"]
        std, lead_std = mine["effort_delay_std"], mine["creep_lead_std"]
        held = np.abs(error) < 1.96 * std
        own = np.sqrt(np.maximum(std**2 - lead_std**2, 0.0))
        before = np.abs(error - mine["creep_lead"]) < 1.96 * own
        print(
            f"  {rail or 'slip speed':10s} {kind:6s} {band(int(held.sum()), len(mine))};"
            f" {int(before.sum())} of {len(mine)}; {error.mean():+.3f} s, before"
            f" {(error - mine['creep_lead']).mean():+.3f} s; band ± {1.96 * std.median():.3f} s",
            flush=True,
        )


class Score:
    """Findings of one fault."""

    def __init__(self) -> None:
        self.within: list[float] = []
        self.named: list[str] = []
        self.sizes: list[bool] = []

    def add(self, found: FleetTrains, train: str, what: str, size: float) -> None:
        """What was found on a train that has a fault."""
        findings = found.of(train)
        if not findings:
            self.within.append(np.inf)
            self.named.append("missed")
            return
        first = findings[0]
        others = {each.what for each in first.explanation.others}
        self.within.append(first.trips)
        right = first.what == what
        self.named.append(
            "right"
            if right and not others
            else "among"
            if what in {first.what, *others}
            else "wrong"
        )
        if right:
            cause = first.explanation.cause
            self.sizes.append(abs(cause.size - size) < 1.96 * cause.std)

    def line(self) -> str:
        """A row of the table."""
        n = len(self.within)
        within = np.array(self.within)
        share = {each: self.named.count(each) for each in ("right", "among", "wrong", "missed")}
        seen = ", ".join(f"{np.sum(within <= k)}" for k in (3, 5, 10))
        held = f"{sum(self.sizes)} of {len(self.sizes)}"
        return (
            f"{n:4d} | {seen} | {share['right']}, {share['among']}, {share['wrong']},"
            f" {share['missed']} | {held}"
        )


SIGNS = {"wheel diameter": -1.0}
"""A speed that is recorded too high is that of wheels smaller than believed."""


def faults(fleets: list[pd.DataFrame], broken: list[pd.DataFrame]) -> None:
    """Each fault put on trains of every kind."""
    names = list(FAULTS)
    scores: dict[tuple[str, str], Score] = defaultdict(Score)
    false = 0
    for fleet, bad in zip(fleets, broken, strict=True):
        for turn in range(len(names)):
            rows, put = fleet, {}
            for place, kind in enumerate(KINDS):
                for number in range(4):
                    train, what = f"{kind}-{number + 1:02d}", names[(number + turn + place) % 5]
                    mine = bad[(bad["train"] == train) & (bad["fault"] == what)]
                    later = (rows["train"] == train) & (rows["number"] >= SINCE)
                    rows, put[train] = pd.concat([rows[~later], mine]), what
            found = fleet_trains(rows)
            false += sum(each.train not in put for each in found.unlike.findings)
            for train, what in put.items():
                size = SIGNS.get(what, 1.0) * FAULTS[what]
                scores[what, train.partition("-")[0]].add(found, train, what, size)
    _print(scores, "simulated")
    print(f"  alarms on the other trains: {false}")


def _print(scores: dict[tuple[str, str], Score], title: str) -> None:
    print(f"{title}: fault, kind: trains | seen within 3, 5, 10 trips | named right, among others,")
    print("  wrong, missed | sizes in their 95 % band")
    for (what, kind), score in sorted(scores.items()):
        print(f"  {what:15s} {kind:6s} {score.line()}", flush=True)


def missing(seeds: int) -> None:
    """The same faults where a channel is missing on all trains."""
    pool = pd.read_parquet(POOL)
    given = tuple(Fault(what, size, n, 40) for n, (what, size) in enumerate(FAULTS.items()))
    for channel in ("nothing", "load", "reference", "passport"):
        scores: dict[tuple[str, str], Score] = defaultdict(Score)
        false = 0
        for seed in range(seeds):
            rows = drawn_fleet(pool, 700 + seed, trains=8, trips=70, faults=given)
            if channel in ("load", "passport"):
                rows["load_source"] = rows["effort_gain_source"] = "assumed"
            if channel == "reference":
                rows["speed_scale_source"] = "nothing"
            if channel == "passport":
                rows["effort_over_mass_source"] = rows["effort_delay_source"] = "assumed"
            found = fleet_trains(rows)
            for number, (what, size) in enumerate(FAULTS.items(), start=1):
                for kind in KINDS:
                    scores[what, "all"].add(found, f"{kind}-{number:02d}", what, size)
            false += sum(int(each.train[-2:]) > len(FAULTS) for each in found.unlike.findings)
        _print(scores, f"drawn, missing: {channel}")
        print(f"  alarms on the other trains: {false}")


def passing(seeds: int) -> None:
    """The same faults that go again after some trips, or come on a share of the trips."""
    pool = pd.read_parquet(POOL)
    for title, end, share in (
        ("of 8 trips", 48, 1.0),
        ("of 20 trips", 60, 1.0),
        ("on half of the trips", None, 0.5),
        ("on 30 % of the trips", None, 0.3),
    ):
        given = tuple(Fault(w, s, n, 40, end, share) for n, (w, s) in enumerate(FAULTS.items()))
        scores: dict[tuple[str, str], Score] = defaultdict(Score)
        gone, off, false = 0, list[float](), 0
        for seed in range(seeds):
            rows = drawn_fleet(pool, 800 + seed, trains=8, trips=100, faults=given)
            found = fleet_trains(rows)
            for number, (what, size) in enumerate(FAULTS.items(), start=1):
                for kind in KINDS:
                    train = f"{kind}-{number:02d}"
                    scores[what, "all"].add(found, train, what, size)
                    for each in found.of(train)[:1]:
                        off.append(each.share - share)
                        lasted = int(each.lasts(rows["start"][rows["train"] == train]).sum())
                        gone += end is not None and abs(lasted - (end - 40)) <= 2
            false += sum(int(each.train[-2:]) > len(FAULTS) for each in found.unlike.findings)
        _print(scores, f"drawn, {title}")
        said = f"end within two trips: {gone}; " if end else ""
        print(
            f"  {said}stated share off by {np.median(np.abs(off)):.2f}; alarms on others: {false}"
        )


def false_alarms(seeds: int) -> None:
    """Findings on healthy fleets."""
    pool = pd.read_parquet(POOL)
    for title, options in (
        ("two trips a day", {"trips_a_day": 2.0, "trips": 120}),
        ("six trips a day", {"trips_a_day": 6.0, "trips": 180}),
    ):
        alarms, months = 0, 0.0
        for seed in range(seeds):
            found = fleet_trains(drawn_fleet(pool, 100 + seed, trains=10, **options)).unlike
            alarms, months = alarms + len(found.findings), months + found.train_months
            for each in found.findings:
                print("   ", each)
        print(
            f"  {title}: {alarms} alarms in {months:.0f} months of healthy trains,"
            f" {band(alarms, round(months))}; stated at most 1 %",
            flush=True,
        )


def drift(seeds: int) -> None:
    """Wear of wheels, a share a month, found over the months that trips span."""
    pool = pd.read_parquet(POOL)
    for months in (2, 4, 12):
        held = []
        for seed in range(seeds):
            trips = round(months * 30.44 * 0.7)
            rows = drawn_fleet(pool, 500 + seed, trains=6, trips=trips, trips_a_day=0.7, wear=0.0)
            since = (rows["start"] - rows["start"].min()) / pd.Timedelta(days=30.4375)
            rows.loc[rows["train"].str.endswith("01"), "speed_scale"] += 0.0004 * since
            worn = [
                each
                for each in fleet_trains(rows).drift
                if each.channel == "speed scale" and each.train.endswith("-01")
            ]
            held += [each.band[0] < 0.0004 < each.band[1] for each in worn]
        print(
            f"  wear of 0.04 % a month over {months} months: true trend in the 95 % band"
            f" {band(sum(held), len(held))}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", default="all")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--trips", type=int, default=20, help="of a kind on a rail, part creep")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder for simulated trips, used again")
    arguments = parser.parse_args()
    wanted = arguments.part

    def simulated(name: str, tasks: list[Task]) -> pd.DataFrame:
        path = None if arguments.keep is None else arguments.keep / f"{name}.parquet"
        if path is not None and path.exists():
            return pd.read_parquet(path)
        rows = rows_of(tasks, arguments.jobs)
        if path is not None:
            rows.to_parquet(path)
        return rows

    if wanted in ("all", "bands", "faults"):
        fleets = [simulated("h1", healthy(1, 10, 40))]
        if wanted in ("all", "bands"):
            bands(fleets, arguments.seeds)
    if wanted in ("all", "axles"):
        tasks = [
            Task(2, kind, train, trip, missing="axles")
            for kind in KINDS
            for train in range(4)
            for trip in range(10)
        ]
        axles(simulated("a2", tasks))
    if wanted in ("all", "creep"):
        tasks = [
            Task(11, kind, trip % 4, 7 * trip, missing="axles", rail=rail)
            for rail in RAILS
            for kind in KINDS
            for trip in range(arguments.trips)
        ]
        creep(simulated("c11", tasks))
    if wanted in ("all", "faults"):
        tasks = [
            Task(1, kind, number, SINCE + trip, fault=fault)
            for fault in FAULTS
            for kind in KINDS
            for number in range(4)
            for trip in range(10)
        ]
        faults(fleets, [simulated("f1", tasks)])
    if wanted in ("all", "passing"):
        passing(max(arguments.seeds // 2, 1))
    if wanted in ("all", "missing"):
        missing(max(arguments.seeds // 2, 1))
    if wanted in ("all", "false-alarms"):
        false_alarms(arguments.seeds)
    if wanted in ("all", "drift"):
        drift(max(arguments.seeds // 2, 1))


if __name__ == "__main__":
    main()
