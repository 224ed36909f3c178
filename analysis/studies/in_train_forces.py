"""What the forces in a train do: a consist over a line, with full and with emergency braking.

The train starts, keeps a speed over the line's gradients, brakes to a stand with full service
braking, starts again, and brakes to a stand in an emergency. Beside it runs the single-particle
train (Amirhosseini et al. (2024), eq. 10) under the same demands.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from analysis.charts import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    RED,
    Cells,
    Chart,
    Curve,
    Label,
    Panel,
    Rule,
    shades,
)
from analysis.studies.report import StudyReport, study_trip
from trainlog.arrays import FloatArray
from trainlog.errors import InfeasibleError, InputError
from trainlog.formats.declared import thing_to_bytes
from trainlog.formats.railway import read_consist, read_line
from trainlog.formats.samples import sample
from trainlog.presentation import WordTable, new_table
from trainlog.railway import Line, Station, StepProfile
from trainlog.railway.train import Consist
from trainlog.simulation.consist import ConsistPlant, ConsistState
from trainlog.topics import ENVIRONMENT, TRAIN_CONTROLS, TRAIN_COUPLERS, TRAIN_STATE, TRAIN_VEHICLES
from trainlog.trip import Trip
from trainlog.units import KMH, PER_MILLE

PERIOD = 0.05
"""Of control and of what is recorded [s]."""

STEP = 0.001
"""Of the integration [s]: what couplers do at the ends of their slack takes short steps."""

BUILD_UP = 10.0
"""In which the driver brings the traction to its full effort [s]."""

PIPE_FALL = 6.0
"""In which the pressure of the train pipe falls to that of full service braking [s]."""

SERVICE_AT, EMERGENCY_AT = 0.55, 0.85
"""Where the brakes are asked for: share of the line."""

HALT = 30.0
"""Between the stop and the next start, and after the last stop [s]."""

BAND = 1.5
"""Below the speed to keep, over which the traction fades [m/s]."""

PATIENCE = 3.0
"""Longest time on the way, over that at the speed to keep."""


@dataclass(frozen=True, eq=False)
class ConsistRun:
    """What a consist of n vehicles did; (m,) arrays with one value a sample unless said otherwise.

    Attributes
    ----------
    consist : Consist
    line : Line
    speed_to_keep : float [m/s]
    time : [s]
    tractive_demand, braking_demand : [N]
        For the whole train.
    positions, speeds : (m, n) array [m], [m/s]
        Of the vehicles' middles.
    tractive_efforts, braking_efforts : (m, n) array [N]
    forces, stretches : (m, n - 1) array [N], [m]
        Of the couplers, positive when pulled apart.
    phases : tuple of (first sample, name)
    alone : (m, 2) array [m], [m/s]
        Way and speed of the single-particle train.
    residual : float
        Energy that is unaccounted for, over all work done.
    """

    consist: Consist
    line: Line
    speed_to_keep: float
    time: FloatArray
    tractive_demand: FloatArray
    braking_demand: FloatArray
    positions: FloatArray
    speeds: FloatArray
    tractive_efforts: FloatArray
    braking_efforts: FloatArray
    forces: FloatArray
    stretches: FloatArray
    phases: tuple[tuple[int, str], ...]
    alone: FloatArray
    residual: float

    @property
    def front(self) -> FloatArray:
        """Chainage of the train's front [m]."""
        return np.asarray(self.positions[:, 0] + 0.5 * self.consist.vehicles[0].length)

    @property
    def way(self) -> FloatArray:
        """Of the centre of mass since the beginning [m]."""
        masses = np.array([vehicle.mass for vehicle in self.consist.vehicles])
        centre = self.positions @ masses / masses.sum()
        return np.asarray(centre - centre[0])

    @property
    def ahead(self) -> FloatArray:
        """Way of the consist less that of the single-particle train [m]."""
        return np.asarray(self.way - self.alone[:, 0])

    def phase(self, name: str) -> slice:
        """The samples of the phase called `name`."""
        starts = [first for first, _ in self.phases] + [self.time.size]
        number = [each for _, each in self.phases].index(name)
        return slice(starts[number], starts[number + 1])


def crest_and_sag() -> Line:
    """Twelve kilometres: level, 8 per mille up, 10 down, 10 up, level."""
    return Line(
        name="crest and sag",
        length=12_000.0,
        stations=(Station("start", 0.0), Station("end", 12_000.0)),
        speed_limits=StepProfile(np.zeros(1), np.array([160.0 / KMH])),
        gradients=StepProfile(
            np.array([0.0, 1_500.0, 3_000.0, 4_200.0, 5_400.0]),
            np.array([0.0, 8.0, -10.0, 10.0, 0.0]) / 1e3,
        ),
        source="made up to show what a crest and a sag do to a train",
    )


def run(consist: Consist, line: Line, *, speed: float) -> ConsistRun:
    """Drive a consist over a line.

    Parameters
    ----------
    consist : Consist
        Of two vehicles or more.
    line : Line
        As travelled; from its beginning.
    speed : float [m/s]
        To keep; the line's lowest speed limit if that is less.

    Raises
    ------
    InputError
        If there is no coupler, no traction or no brake, or the line is shorter than six trains.
    InfeasibleError
        If the train does not get over the line.
    """
    _check(consist, line, speed)
    kept = min(speed, float(line.speed_limits.values.min()))
    plant = ConsistPlant(consist, line, step=STEP)
    one = ConsistPlant(consist.as_one(), line, step=STEP)
    # The whole train stands on the line.
    state, alone = plant.at(consist.length), one.at(consist.length)
    begin, origin = plant.energy(state), float(alone.positions[0])
    driver = _Driver(consist, line, kept)
    rows: list[tuple[float, ...]] = []
    seen: list[FloatArray] = []
    steps = round(PERIOD / STEP)
    while not driver.finished:
        pull, brake = driver.demand(state, len(rows))
        rows.append((state.time, pull, brake, alone.positions[0] - origin, alone.speeds[0]))
        seen.append(np.stack((state.positions, state.speeds, state.braking_effort)))
        plant.advance(state, pull, brake, steps)
        one.advance(alone, pull, brake, steps)
    table, motion = np.array(rows), np.stack(seen)
    positions, speeds = motion[:, 0], motion[:, 1]
    return ConsistRun(
        consist=consist,
        line=line,
        speed_to_keep=kept,
        time=table[:, 0],
        tractive_demand=table[:, 1],
        braking_demand=table[:, 2],
        positions=positions,
        speeds=speeds,
        tractive_efforts=_tractive(consist, table[:, 1], speeds),
        braking_efforts=motion[:, 2],
        forces=plant.forces_between(positions, speeds),
        stretches=plant.stretches_between(positions),
        phases=tuple(driver.phases),
        alone=table[:, 3:],
        residual=_residual(plant, state, begin),
    )


class _Driver:
    """Starts, keeps the speed, brakes, halts, starts again, and brakes in an emergency."""

    def __init__(self, consist: Consist, line: Line, speed: float) -> None:
        self.phases: list[tuple[int, str]] = [(0, "start and run")]
        self.finished = False
        self._consist, self._line, self._speed = consist, line, speed
        self._pull = self._brake = 0.0
        self._since = 0.0

    def demand(self, state: ConsistState, row: int) -> tuple[float, float]:
        """Tractive and braking effort [N] until the next sample."""
        consist, phase = self._consist, self.phases[-1][1]
        position, speed = float(state.positions[0]), float(state.speeds[0])
        if phase in ("start and run", "start again"):
            again = phase == "start again"
            self._brake = 0.0
            share = min(max((self._speed - speed) / BAND, 0.0), 1.0)
            most = consist.max_tractive_effort
            self._pull = min(share * most, self._pull + most * PERIOD / BUILD_UP)
            if position > (EMERGENCY_AT if again else SERVICE_AT) * self._line.length:
                self._next("emergency braking" if again else "full service braking", state, row)
        if self.phases[-1][1] in ("full service braking", "emergency braking"):
            sudden = self.phases[-1][1] == "emergency braking"
            fall = consist.max_braking_effort * (1.0 if sudden else PERIOD / PIPE_FALL)
            self._pull = 0.0
            self._brake = min(self._brake + fall, consist.max_braking_effort)
            if np.all(state.speeds == 0.0):
                self._next("end" if sudden else "halt", state, row)
        elif phase in ("halt", "end") and state.time > self._since + HALT:
            self.finished = phase == "end"
            if not self.finished:
                self._next("start again", state, row)
        patience = PATIENCE * self._line.length / self._speed + 4.0 * HALT
        if state.time > patience or speed < -1.0:
            raise InfeasibleError(
                f"consist '{consist.name}' does not get over line '{self._line.name}': at km"
                f" {position / 1e3:.3f} after {state.time:.0f} s",
                remedy="a lighter train, more traction or an easier line",
            )
        return self._pull, self._brake

    def _next(self, phase: str, state: ConsistState, row: int) -> None:
        self.phases.append((row, phase))
        self._since = state.time


def _check(consist: Consist, line: Line, speed: float) -> None:
    """Refuse what cannot be driven."""
    if len(consist.vehicles) < 2:
        raise InputError(
            f"consist '{consist.name}' is a single particle: there are no forces in it",
            remedy="choose one of two vehicles or more",
        )
    for what, effort in (
        ("traction", consist.max_tractive_effort),
        ("brake", consist.max_braking_effort),
    ):
        if not effort > 0.0:
            raise InputError(f"consist '{consist.name}' has no {what}")
    if not speed > 0.0:
        raise InputError(f"the speed to keep must be positive, not {speed * KMH:g} km/h")
    if line.length < 6.0 * consist.length:
        raise InputError(
            f"line '{line.name}' of {line.length:.0f} m is too short for a train of"
            f" {consist.length:.0f} m",
            remedy="choose one of at least six times the train's length",
        )


def _tractive(consist: Consist, demand: FloatArray, speeds: FloatArray) -> FloatArray:
    """Tractive effort of each vehicle at work [N], within its power; (m, n) array."""
    most = np.array([vehicle.max_tractive_effort for vehicle in consist.vehicles])
    power = np.array([vehicle.max_traction_power for vehicle in consist.vehicles])
    return np.minimum(np.outer(demand, most / most.sum()), power / np.maximum(speeds, 1e-3))


def _residual(plant: ConsistPlant, state: ConsistState, before: float) -> float:
    works = state.works
    gained = works["traction"] - sum(work for name, work in works.items() if name != "traction")
    total = sum(abs(work) for work in works.values())
    return abs(plant.energy(state) - before - gained) / total


# ------------------------------------------------------------------ as a log, a picture and tables


def forces_tables(run: ConsistRun) -> tuple[WordTable, WordTable]:
    """The largest forces of each coupler, phase by phase, and what they mean for the trip."""
    names = [name for _, name in run.phases if name not in ("halt", "end")]
    table = new_table(
        "In-train forces, kN: largest in draft / in buff", "coupler", "whole run", *names
    )
    for coupler, forces in enumerate(run.forces.T / 1e3, start=1):
        parts = (forces, *(forces[run.phase(name)] for name in names))
        table.add_row(str(coupler), *(_extremes(part) for part in parts))
    summary = new_table("In-train forces: where, and beside a single particle", "", "")
    draft = np.unravel_index(np.argmax(run.forces), run.forces.shape)
    buff = np.unravel_index(np.argmin(run.forces), run.forces.shape)
    for what, (row, which) in (("largest draft", draft), ("largest buff", buff)):
        summary.add_row(
            what,
            f"{abs(run.forces[row, which]) / 1e3:.0f} kN in coupler {which + 1} at"
            f" km {run.front[row] / 1e3:.3f}, {run.time[row]:.1f} s,"
            f" {run.speeds[row, 0] * KMH:.0f} km/h",
        )
    summary.add_row("energy unaccounted for", f"{run.residual:.1e} of all work done")
    summary.add_row("beside one particle", _beside(run))
    return table, summary


def _beside(run: ConsistRun) -> str:
    """Where and when the single-particle train is under the same demands."""
    stops = []
    for name in ("full service braking", "emergency braking"):
        during = run.phase(name)
        first = during.start
        distance = run.way[during.stop] - run.way[first]
        alone = run.alone[during.stop :, 0][0] - run.alone[first, 0]
        stops.append(f"{name} {distance:.1f} m, {alone:.1f} m as one")
    first = run.phase("full service braking").start
    delay = run.time[first] - float(np.interp(run.way[first], run.alone[:, 0], run.time))
    furthest = float(run.ahead[np.argmax(np.abs(run.ahead))])
    return (
        f"{'later' if delay > 0.0 else 'earlier'} by {abs(delay):.2f} s at the first braking; at"
        f" most {abs(furthest):.2f} m {'ahead' if furthest > 0.0 else 'behind'}; {'; '.join(stops)}"
    )


def _extremes(forces: FloatArray) -> str:
    draft, buff = np.maximum([forces.max(), -forces.min()], 0.0) + 0.0  # no -0
    return f"{draft:.0f} / {buff:.0f}"


COLUMNS = 1_200
"""Instants of the forces along the train; of those in between the largest force is shown."""


def run_charts(run: ConsistRun) -> list[Chart]:
    """Speed and gradient, forces along the train, envelope, single particle."""
    gradient = run.line.gradient(np.minimum(run.front, run.line.length)) * PER_MILLE
    speeds = [
        Curve("first vehicle", run.time, KMH * run.speeds[:, 0]),
        Curve("last vehicle", run.time, KMH * run.speeds[:, -1], ORANGE, width=0.8),
    ]
    begins = [(float(run.time[first]), name) for first, name in run.phases]
    ahead = Curve("", run.time, run.ahead, PURPLE)
    over_time = Chart(
        "time [s]",
        [
            Panel("km/h", speeds, 1.3, limits=(0.0, 1.7 * KMH * float(run.speeds.max())),
                  rules=[Rule(at, GREY, upright=True, width=0.6) for at, _ in begins],
                  labels=[Label(at, f" {name}", upright=True, side="left") for at, name in begins]),
            Panel("‰", [Curve("", run.time, gradient, GREY, "step")], 0.5,
                  "Gradient under the front"),
            _forces(run),
            Panel("m", [ahead], 0.7,
                  "Way of the consist less that of a single particle under the same demands"),
        ],
        span=(0.0, float(run.time[-1])), title=f"{run.consist.name} on {run.line.name}",
    )  # fmt: skip
    return [over_time, _envelope(run)]


def _forces(run: ConsistRun) -> Panel:
    """Couplers from the front (top) to the rear, over time."""
    edges = np.linspace(0, run.time.size, min(COLUMNS, run.time.size) + 1).astype(int)
    high = np.maximum.reduceat(run.forces, edges[:-1], axis=0)
    low = np.minimum.reduceat(run.forces, edges[:-1], axis=0)
    shown = np.where(high >= -low, high, low) / 1e3
    most = max(float(np.abs(shown).max()), 1e-3)
    times = np.append(run.time, 2.0 * run.time[-1] - run.time[-2])[edges]
    count = run.forces.shape[1]
    levels = most * np.linspace(-1.0, 1.0, 5)
    names = {
        f"{level:.0f} kN": str(shades([level], "RdBu_r", (-most, most))[0]) for level in levels
    }
    cells = Cells(
        times, np.arange(count + 1) + 0.5, shades(shown.T, "RdBu_r", (-most, most)), names
    )
    title = "In-train force: draft red, buff blue"
    return Panel("coupler, from the front", [cells], 1.5, title, limits=(count + 0.5, 0.5))


def _envelope(run: ConsistRun) -> Chart:
    """Largest draft and buff of each coupler, and where they come from."""
    numbers = np.arange(1, run.forces.shape[1] + 1)
    draft, buff = run.forces.max(axis=0) / 1e3, run.forces.min(axis=0) / 1e3
    curves = [
        Curve("draft, whole run", numbers, np.maximum(draft, 0.0), RED, "bars", width=0.8),
        Curve("buff, whole run", numbers, np.minimum(buff, 0.0), BLUE, "bars", width=0.8),
    ]
    for name, mark in (("full service braking", "o"), ("emergency braking", "s")):
        during = run.forces[run.phase(name)].min(axis=0) / 1e3
        curves += [
            Curve("", numbers, during, INK, width=0.8),
            Curve(f"least in {name}", numbers, during, INK, "points", width=1.7, mark=mark),
        ]
    panel = Panel("kN", curves, 1.1, "Largest forces of each coupler", rules=[Rule(0.0, GREY)])
    return Chart("coupler, from the front", [panel])


DEFAULT_CONSIST = "freight_24_wagons.consist.json"
"""The sample that is run where none is named."""

CONSIST_ATTACHMENT = "consist.json"
"""The consist that a trip was simulated with."""


@dataclass(frozen=True)
class ConsistOptions:
    """What is driven.

    Attributes
    ----------
    consist, line : Path, optional
        Files; default: the freight train of the samples, and `crest_and_sag`.
    speed : float [m/s]
        To keep.
    """

    consist: Path | None = None
    line: Path | None = None
    speed: float = 80.0 / KMH


def main(report: StudyReport, options: ConsistOptions) -> None:
    """Drive a consist, write the run as a log, draw it and print its forces."""
    source = options.consist or sample(DEFAULT_CONSIST)
    train = read_consist(source)
    line = crest_and_sag() if options.line is None else read_line(options.line)
    for _ in report.track([train], f"driving {train.name}"):
        found = run(train, line, speed=options.speed)
    name = source.name.removesuffix(".json").removesuffix(".consist")
    report.log(consist_trip(found), name)
    report.draw({f"{name}.png": run_charts(found)})
    report.show(*forces_tables(found))


def consist_trip(run: ConsistRun) -> Trip:
    """The log of a consist's run: vehicles and couplers one by one, and the train as a whole."""
    consist, line = run.consist, run.line
    front = np.minimum(run.front, line.length)
    return study_trip(
        consist.name,
        consist.name,
        line,
        run.time,
        {
            TRAIN_STATE: {"position": run.front, "speed": run.speeds[:, 0]},
            TRAIN_CONTROLS: {
                "tractive_effort_demand": run.tractive_demand,
                "braking_effort_demand": run.braking_demand,
                "tractive_effort": run.tractive_efforts.sum(axis=1),
                "dynamic_braking_effort": 0.0,
                "pneumatic_braking_effort": run.braking_efforts.sum(axis=1),
            },
            TRAIN_VEHICLES: {
                "chainage": run.positions,
                "speed": run.speeds,
                "tractive_effort": run.tractive_efforts,
                "braking_effort": run.braking_efforts,
            },
            TRAIN_COUPLERS: {"force": run.forces, "stretch": run.stretches},
            ENVIRONMENT: {"gradient": line.gradient(front), "speed_limit": line.speed_limit(front)},
        },
        ("study consist", {"speed": run.speed_to_keep, "integration_step": STEP}),
        events=[(float(run.time[first]), name, "driver") for first, name in run.phases],
        attachments={CONSIST_ATTACHMENT: thing_to_bytes(consist)},
    )
