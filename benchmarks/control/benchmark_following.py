"""Following a trajectory: trains of a set on dry and on wet rail, and what a decision costs.

    python benchmarks/control/benchmark_following.py

The trajectory is for loads of 0 and 25 t, running resistances 10 % off either way and 92 to 100 %
of the power, on St.Gallen-Wil with the sample map. The driver knows the set, not the train. Beside
it, at states along the way, the same programs by CVXPY and IPOPT (processor time).
"""

from __future__ import annotations

import time
from functools import partial

import numpy as np
from benchmark_tracking import own, peer_cvxpy, peer_ipopt, timed
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from analysis.control.follow import Follower, run_of
from analysis.control.tracking import Program
from analysis.trajectory import optimise
from analysis.trajectory.envelope import fastest_run
from trainlog.formats.condition import read_map
from trainlog.formats.line import read_line
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.formats.train import read_train
from trainlog.railway import Configuration, Line, Train, Trajectory
from trainlog.simulation.drivers import DEPARTURE, Demand, Observation
from trainlog.simulation.scenario import Scenario, drive, trajectory_scenarios
from trainlog.units import KMH

FloatArray = NDArray[np.float64]

MAP = DEFAULT_LINE.replace(".line.", ".map.")
LATE = 40.0


class Watched:
    """A follower whose decisions are timed, and some of whose programs are kept."""

    def __init__(self, follower: Follower) -> None:
        self.follower = follower
        self.spent: list[float] = []
        self.programs: list[Program] = []
        self._program = follower.program
        follower.program = self._kept  # type: ignore[method-assign]

    @property
    def finished(self) -> bool:
        """As the follower says."""
        return self.follower.finished

    def demand(self, observation: Observation) -> Demand:
        """As the follower says; how long it took is kept."""
        self._decided = False
        begun = time.process_time()
        found = self.follower.demand(observation)
        if self._decided:
            self.spent.append(1e3 * (time.process_time() - begun))
        return found

    def _kept(self, observation: Observation) -> Program:
        self._decided = True
        program = self._program(observation)
        if program.levers.size == self.follower.tuning.horizon and len(self.spent) % 50 == 10:
            self.programs.append(program)
        return program


def configurations(train: Train) -> list[Configuration]:
    """Both ends of mass, resistance and power, and the middle."""
    middle = Configuration.of(train, 12_500.0, "middle")
    ends = [
        Configuration(
            f"{load:.0f} t, {factor:.1f} R", train.mass + 1e3 * load, train.rotating_mass,
            train.resistance.scaled(factor), share * train.max_traction_power,
        )
        for load, share in ((0.0, 1.0), (25.0, 0.92))
        for factor in (0.9, 1.1)
    ]  # fmt: skip
    return [middle, *ends]


def columns(scenario: Scenario) -> dict[str, FloatArray]:
    run = drive(scenario)
    found = dict(zip(scenario.plant().columns, run.samples.T, strict=True))
    return found | {"seconds": run.seconds}


def row(scenario: Scenario, line: Line, trajectory: Trajectory) -> tuple[str, ...]:
    found = columns(scenario)
    speed, position = found["speed"], found["position"]
    arrival = float(found["seconds"][np.flatnonzero(speed > 0.0)[-1]]) + 0.1 - DEPARTURE
    limit = line.speed_limit(np.minimum(position, line.length))
    energy = float(np.sum(found["tractive_effort"] * speed)) * 0.1
    planned = trajectory.certificate["wheel_energy"][scenario.row]
    slips = int(np.sum(np.diff((found["protected_axles"] > 0.0).astype(int)) > 0))
    return (
        trajectory.configurations[scenario.row].name,
        scenario.weather,
        f"{arrival - trajectory.times[trajectory.latest, -1]:+.1f} s",
        f"{100.0 * (position[-1] - trajectory.positions[-1]):+.0f} cm",
        f"{energy / planned - 1.0:+.2%}",
        f"{KMH * np.max(speed - limit):+.2f} km/h",
        f"{slips}",
    )


def main() -> None:
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    track, console = read_map(sample(MAP)), Console(width=110)
    trajectory = optimise(line, train, configurations(train), reserve=0.08, condition_map=track)
    titles = ("arrival", "stop", "energy over planned", "speed over the limit", "slips")
    table = Table("train", "rail", *titles, title=f"Following {trajectory.running_time:.1f} s")
    watched: list[Watched] = []

    def make(layer: str | None, departure: float = DEPARTURE) -> Watched:
        known = {} if layer is None else {"condition": track, "layer": layer}
        watched.append(Watched(Follower(trajectory, line, train, departure=departure, **known)))
        return watched[-1]

    for weather, layer in (("dry", "dry"), ("wet", "wet"), ("wet", None)):
        for scenario in trajectory_scenarios(
            trajectory, line, train, trajectory.chosen("all"), partial(make, layer),
            weather=weather,
        ):  # fmt: skip
            name, rail, *rest = row(scenario, line, trajectory)
            table.add_row(name, rail + ("" if layer else ", no map"), *rest)
    table.add_section()
    for scenario in trajectory_scenarios(
        trajectory, line, train, trajectory.chosen("all"), partial(make, "dry", DEPARTURE + LATE)
    ):
        name, rail, *rest = row(scenario, line, trajectory)
        table.add_row(name, f"{rail}, {LATE:.0f} s late", *rest)
    console.print(table)
    least = fastest_run(run_of(trajectory, line, train)).times
    bound = max(0.0, LATE + float(least.max()) - trajectory.running_time)
    console.print(f"least lateness after {LATE:.0f} s: {bound:.1f} s")
    unsolved = sum(each.follower.unsolved for each in watched)
    spent = np.concatenate([each.spent for each in watched])
    table = Table("", "ms, median", "ms, 99 %", "first effort differs by, at most [m/s²]")
    table.add_row(
        f"a decision, {len(spent)} of them, {unsolved} unsolved",
        f"{np.median(spent):.3f}", f"{np.quantile(spent, 0.99):.3f}", "",
    )  # fmt: skip
    programs = watched[0].programs
    answers = [own(each) for each in programs]
    for name, peer, repeats in (
        ("its program alone: DAQP", own, 20),
        ("its program alone: CVXPY with parameters, Clarabel", peer_cvxpy(), 3),
        ("its program alone: CasADi, IPOPT", peer_ipopt(), 3),
    ):
        gap = max(abs(peer(each) - mine) for each, mine in zip(programs, answers, strict=True))
        times = [timed(lambda p=each, f=peer: f(p), repeats) for each in programs]
        table.add_row(
            name, f"{np.median(times):.3f}", f"{np.quantile(times, 0.99):.3f}", f"{gap:.1e}"
        )
    console.print(table)


if __name__ == "__main__":
    main()
