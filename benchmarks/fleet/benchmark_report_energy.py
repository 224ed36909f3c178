"""How well trains run by plans made with what each way of logging has taught.

    python benchmarks/fleet/benchmark_report_energy.py FOLDER CATALOGUE [...]
        [--rail leaves] [--reserve 0.08] [-o FIGURES.csv]

FOLDER is that of `trainlog simulate fleet`, each CATALOGUE one of `benchmark_reports.py`. A plan is
made for each train on a route of its own trips: with the resistance of its train file and no map
(nothing is learned, as from status reports), with the resistance that each catalogue states of the
train (without a fit: that of the file), and with that and the catalogue's map. All have the same
running time: a reserve over the least that the true resistance and the first catalogue's map allow.
A train with the true resistance then follows each plan in the simulator on the lasting adhesion of
the rail; loads are known. The follower keeps to the map of its plan, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from fleet_truth import PARAMETERS, drawn_again
from judge_fleet import Judged, printed

from analysis.control.follow import Follower
from analysis.fleet.resistance import fleet_resistance
from analysis.network.maps import map_along
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.optimiser import OptimiserOptions, optimise
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.catalogue import open_catalogue
from trainlog.errors import TrainlogError
from trainlog.formats.railway import line_of, train_of
from trainlog.mcap import read_log
from trainlog.railway import (
    Configuration,
    Line,
    RunningResistance,
    StepProfile,
    TrackConditionMap,
    Train,
)
from trainlog.simulation import drive, trajectory_scenarios
from trainlog.simulation.drivers import DEPARTURE
from trainlog.simulation.fleet import along

RISK = 0.05
"""With which a map is read: of less adhesion than is counted on, per place and trip."""

SLIP = 3.0
"""Slip protection takes effort off wheels this much faster or slower than the train [m/s]."""


@dataclass(frozen=True)
class Known:
    """What a plan is made with.

    Attributes
    ----------
    resistance : RunningResistance
    maps : mapping of str to TrackConditionMap, optional
        By edge.
    """

    resistance: RunningResistance
    maps: Mapping[str, TrackConditionMap] | None = None


def learned(given: Judged) -> dict[str, RunningResistance]:
    """The resistance of each train that a catalogue has trips of."""
    try:
        found = fleet_resistance(given.summaries)
    except TrainlogError:  # no trip determines it
        return {}
    return {one.train: one.resistance for kind in found for one in kind.trains}


def planned(problem: TrajectoryProblem, known: Known, rail: str) -> TrajectoryProblem:
    """The problem as who knows this puts it."""
    if known.maps is None:
        return problem
    track = map_along(problem.line, known.maps)
    return replace(problem, condition_map=track, layer=rail, risk=RISK)


def driven(problem: TrajectoryProblem, true: Configuration, rail: StepProfile) -> dict[str, float]:
    """What comes of a plan that a true train follows on a true rail."""
    line, train = problem.line, problem.train
    (believed,) = problem.configurations
    plan = optimise(problem, OptimiserOptions(cells=300))

    def follows() -> Follower:
        track = problem.condition_map
        return Follower(plan, line, train, condition=track, layer=problem.layer, risk=problem.risk)

    (scenario,) = trajectory_scenarios(plan, line, train, [believed.name], follows)
    scenario = replace(
        scenario, mass=true.mass, rotating_mass=true.rotating_mass, resistance=true.resistance,
        maximum_adhesion=rail,
    )  # fmt: skip
    run = drive(scenario)
    moved = dict(zip(scenario.plant().columns, run.samples.T, strict=True))
    wheels = np.array([each for name, each in moved.items() if name.startswith("wheel_speed")])
    slips = np.abs(wheels - moved["speed"]).max(axis=0) > SLIP
    step = float(run.seconds[1] - run.seconds[0])
    arrival = float(run.seconds[np.flatnonzero(moved["speed"] > 0.0)[-1]]) + step - DEPARTURE
    return {
        "work": float(np.sum(moved["tractive_effort"] * moved["speed"])) * step,
        "late": arrival - float(plan.times[0, -1]),
        "overrun": float(moved["position"][-1]) - float(plan.positions[-1]),
        "slip": float(np.sum(slips)) * step,
        "planned": float(plan.times[0, -1]),
    }


def compared(
    line: Line,
    train: Train,
    true: RunningResistance,
    ways: Mapping[str, Known],
    rail: StepProfile,
    condition: str,
    reserve: float,
) -> list[dict[str, object]]:
    """Work, lateness, overrun and slip by what is known."""
    base = Configuration.of(train, 0.5 * train.max_load)
    loaded = replace(base, resistance=true)
    asked = TrajectoryProblem(line, train, [loaded], reserve=reserve)
    best = next(known for known in ways.values() if known.maps is not None)
    least = float(fastest_run(planned(asked, best, condition)).times.max())
    rows = list[dict[str, object]]()
    for name, known in ways.items():
        own = replace(
            asked, configurations=[replace(base, resistance=known.resistance)],
            running_time=(1.0 + reserve) * least,
        )  # fmt: skip
        row: dict[str, object] = {"way": name, "least": least}
        try:
            row |= driven(planned(own, known, condition), loaded, rail)
        except TrainlogError as error:
            row["refused"] = str(error)
        rows.append(row)
    return rows


def main() -> None:
    """The command at the top."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("catalogues", type=Path, nargs="+")
    parser.add_argument("--rail", default="leaves", help="rail condition: dry, wet, leaves, frost")
    parser.add_argument("--reserve", type=float, default=0.08)
    parser.add_argument("-o", "--output", type=Path, help="figures by train and way (.csv)")
    options = parser.parse_args()
    fleet = drawn_again(options.folder)
    taught: dict[str, tuple[dict[str, RunningResistance], Mapping[str, TrackConditionMap]]] = {}
    truths: dict[str, RunningResistance] = {}
    for where in options.catalogues:
        with open_catalogue(str(where)) as catalogue:
            given = Judged(options.folder, catalogue, fleet, where / "truths.parquet")
            taught[where.name.removeprefix("catalogue-")] = learned(given), given.maps.maps
            for train, part in given.trips.groupby("train"):
                mean = given.truths.loc[part["key"], list(PARAMETERS)].mean()
                truths[str(train)] = RunningResistance(*mean.to_numpy(np.float64))
    rows = list[dict[str, object]]()
    for name, true in truths.items():
        trip = read_log(min((options.folder / name).glob("*.mcap")), topics=[])
        line, train = line_of(trip), train_of(trip)
        rail = along(line, lambda edge: fleet.rail(edge).lasting(options.rail, fleet.start))
        ways = {"nothing": Known(train.resistance)}
        for where, (resistances, maps) in taught.items():
            own = resistances.get(name, train.resistance)
            if name in resistances:
                ways[f"{where}, resistance"] = Known(own)
            ways[f"{where}, map"] = Known(own, maps)
        found = compared(line, train, true, ways, rail, options.rail, options.reserve)
        rows += [{"train": name, **row} for row in found]
        print(pd.DataFrame(rows[-len(found) :]).to_string(), flush=True)
    frame = pd.DataFrame(rows)
    if options.output is not None:
        frame.to_csv(options.output, index=False)
    kwh = 3.6e6
    printed(
        f"what comes of plans, rail: {options.rail}",
        ("plan made with", "trains", "traction", "late, most", "overrun, most", "slip, mean"),
        [
            (
                str(way),
                str(part["work"].notna().sum()),
                f"{part['work'].sum() / kwh:.1f} kWh",
                f"{part['late'].max():+.1f} s",
                f"{part['overrun'].max():+.1f} m",
                f"{part['slip'].mean():.1f} s",
            )
            for way, part in frame.groupby("way", sort=False)
        ],
    )


if __name__ == "__main__":
    main()
