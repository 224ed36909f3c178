"""Following a trajectory: trains of a set on dry and on wet rail, and what a decision costs.

    python benchmarks/control/benchmark_following.py

The trajectory is for loads of 0 and 25 t, running resistances 10 % off either way and 92 to 100 %
of the power, on St.Gallen-Wil with the sample map. The driver knows the set, not the train. Each
train runs twice: with a driver who sees its true motion, and with one who knows of it what its own
instruments measure. Beside them, at states along the way, the same programs by CVXPY and IPOPT
(processor time).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from benchmark_tracking import own, peer_cvxpy, peer_ipopt, timed
from outcome import outcome
from rich.console import Console
from rich.table import Table

from analysis.control.follow import HORIZON, MARGIN, Follower, Odometry, run_of
from analysis.control.prediction import QPSubproblem
from analysis.control.route import Margin
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.arrays import FloatArray
from trainlog.formats.mapfile import read_map
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.railway import Configuration, Line, TrackConditionMap, Train, Trajectory
from trainlog.simulation import Scenario, drive, trajectory_scenarios
from trainlog.simulation.drivers import DEPARTURE, Demand, Observation
from trainlog.simulation.recording import Run
from trainlog.simulation.sensors import Reading, Sensors
from trainlog.units import KMH

MAP = DEFAULT_LINE.replace(".line.json", ".map")
LATE = 40.0
FORMATS = ("{:+.1f} s", "{:+.0f} cm", "{:+.1f} %", "{:+.2f} km/h", "{:.0f}")


@dataclass(frozen=True)
class Case:
    """Rail, what is known of it, and lateness [s]; whether every train is listed."""

    weather: str
    mapped: bool = True
    late: float = 0.0
    listed: bool = False

    def __str__(self) -> str:
        late = f", {self.late:.0f} s late" if self.late else ""
        return self.weather + ("" if self.mapped else ", no map") + late


CASES = (
    Case("dry", listed=True), Case("wet", listed=True),
    Case("dry", mapped=False), Case("wet", mapped=False), Case("dry", late=LATE),
)  # fmt: skip


class Watched:
    """A follower whose decisions are timed, and some of whose programs are kept."""

    def __init__(self, follower: Follower) -> None:
        self.follower = follower
        self.spent: list[float] = []
        self.programs: list[QPSubproblem] = []
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

    def _kept(self, observation: Observation) -> QPSubproblem:
        self._decided = True
        program = self._program(observation)
        if program.inputs.size == HORIZON and len(self.spent) % 50 == 10:
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


class KeptOdometry:
    """An odometry whose observations are kept."""

    def __init__(self, sensors: Sensors, start: float) -> None:
        self._odometry = Odometry(sensors, start)
        self.seen: list[Observation] = []

    def __call__(self, reading: Reading) -> Observation:
        """As the odometry says."""
        self.seen.append(self._odometry(reading))
        return self.seen[-1]


def motion(scenario: Scenario, run: Run) -> dict[str, FloatArray]:
    """The true motion by name."""
    return dict(zip(scenario.plant().columns, run.samples.T, strict=True))


def figures(scenario: Scenario, run: Run) -> FloatArray:
    """Lateness [s], stop [cm], energy over planned [%], over the limit [km/h], slips."""
    found = outcome(scenario, run)
    stop, energy = 100.0 * found.off_stop, 100.0 * found.excess_work
    return np.array([found.late, stop, energy, KMH * found.overspeed, found.slips])


def both(exact: FloatArray, measured: FloatArray) -> list[str]:
    """Cells of a table: seeing the true motion, and by its own instruments."""
    return [
        f"{form.format(one)} | {form.format(other)}"
        for form, one, other in zip(FORMATS, exact, measured, strict=True)
    ]


def worst(rows: list[FloatArray]) -> FloatArray:
    """Of several trains: latest, furthest off, dearest, fastest, and most slips."""
    table = np.array(rows)
    furthest = table[np.argmax(np.abs(table[:, 1])), 1]
    top = table.max(axis=0)
    return np.array([top[0], furthest, *top[2:]])


@dataclass
class Trips:
    """All trips of the benchmark, and what was kept of them."""

    trajectory: Trajectory
    line: Line
    train: Train
    track: TrackConditionMap
    watched: list[Watched] = field(default_factory=list)
    heard: list[KeptOdometry] = field(default_factory=list)
    moved: list[dict[str, FloatArray]] = field(default_factory=list)

    def driver(self, case: Case, margin: Margin) -> Watched:
        """A driver of one trip."""
        follower = Follower(
            self.trajectory, self.line, self.train,
            condition=self.track if case.mapped else None, layer=case.weather,
            departure=DEPARTURE + case.late, margin=margin,
        )  # fmt: skip
        self.watched.append(Watched(follower))
        return self.watched[-1]

    def odometry(self, sensors: Sensors, start: float) -> KeptOdometry:
        """By what a driver sees where he is."""
        self.heard.append(KeptOdometry(sensors, start))
        return self.heard[-1]

    def scenarios(self, case: Case, margin: Margin) -> list[Scenario]:
        """A trip in each configuration."""
        return trajectory_scenarios(
            self.trajectory, self.line, self.train, self.trajectory.chosen("all"),
            partial(self.driver, case, margin), weather=case.weather,
        )  # fmt: skip

    def add_rows(self, table: Table, case: Case) -> None:
        """Drive a case by the true motion and by instruments."""
        rows: tuple[list[FloatArray], list[FloatArray]] = ([], [])
        by_truth, by_itself = self.scenarios(case, Margin()), self.scenarios(case, MARGIN)
        for exact, measured in zip(by_truth, by_itself, strict=True):
            rows[0].append(figures(exact, drive(exact)))
            run = drive(replace(measured, locates=self.odometry))
            self.moved.append(motion(measured, run))
            rows[1].append(figures(measured, run))
            if case.listed:
                name = self.trajectory.configurations[exact.row].name
                table.add_row(name, str(case), *both(rows[0][-1], rows[1][-1]))
        table.add_row("worst of five", str(case), *both(worst(rows[0]), worst(rows[1])))
        means = [f"{np.mean([row[2] for row in each]):+.1f} %" for each in rows]
        table.add_row("mean of five", str(case), "", "", " | ".join(means))
        table.add_section()

    def known(self) -> Table:
        """How far what odometries observed was from the truth."""
        table = Table("by its own instruments", "RMS", "at most", "within 1.96 std", "std at most")
        for name, unit in (("position", "m"), ("speed", "m/s")):
            off, std = [], []
            for heard, found in zip(self.heard, self.moved, strict=True):
                moving = found["speed"] > 0.5
                observed = heard.seen[: moving.size]
                seen = np.array([getattr(each, name) for each in observed])
                off.append(np.abs(seen - found[name])[moving])
                std.append(np.array([getattr(each, f"{name}_std") for each in observed])[moving])
            error, spread = np.concatenate(off), np.concatenate(std)
            table.add_row(
                f"{name}, {unit}", f"{np.sqrt(np.mean(error**2)):.3f}", f"{error.max():.2f}",
                f"{np.mean(error < 1.96 * spread):.3f}", f"{spread.max():.3f}",
            )  # fmt: skip
        return table


def decisions(watched: list[Watched]) -> Table:
    """What a decision costs, and its program by others."""
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
    return table


def main() -> None:
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    track, console = read_map(sample(MAP)), Console(width=140)
    trajectory = optimise(
        TrajectoryProblem(line, train, configurations(train), reserve=0.08, condition_map=track)
    )
    titles = ("arrival", "stop", "energy over planned", "speed over the limit", "slips")
    table = Table(
        "train", "rail", *titles,
        title=f"Following {trajectory.running_time:.1f} s; true motion seen | own instruments",
    )  # fmt: skip
    trips = Trips(trajectory, line, train, track)
    for case in CASES:
        trips.add_rows(table, case)
    console.print(table)
    console.print(trips.known())
    least = fastest_run(run_of(trajectory, line, train)).times
    bound = max(0.0, LATE + float(least.max()) - trajectory.running_time)
    console.print(f"least lateness after {LATE:.0f} s: {bound:.1f} s")
    console.print(decisions(trips.watched))


if __name__ == "__main__":
    main()
