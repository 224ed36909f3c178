"""Simulated trips of Hauck et al. (2023), section 4: a train that knows the rail ahead.

References are made for the good rail and the nominal mass; the controller knows the map of the
rail that it meets, or none at all; the train is simulated axle by axle, with a mass that the
controller does not know.

`PublishedController` is that of eqs. (9) to (11): once a second a dense quadratic program in the
levers of the next 20 s, linearised about the reference by time. `MapController` is
`analysis.control.follow.Follower` on the same reference and map: it linearises about the
prediction from the measured state, learns of its train, and has a guard between two programs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from analysis.control.cooperative import adhesion_at, peak_slips
from analysis.control.follow import Follower
from analysis.control.prediction import (
    QPSubproblem,
    solve,
    speed_rows,
    terminal_weight,
    tracking_cost,
)
from analysis.control.route import AHEAD
from analysis.studies.hauck_2023.model import (
    NOMINAL_MASS,
    TOP_SPEED,
    LeverTrain,
    Tables,
    constraints,
    full_effort,
    lever_bounds,
)
from analysis.studies.hauck_2023.reference import (
    NO_LIMIT,
    SAMPLING,
    STOPPING_TOLERANCE,
    Reference,
    sections_of,
    smoothed_line,
)
from analysis.studies.report import START
from trainlog import __version__
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InfeasibleError
from trainlog.railway import Configuration, Line, StepProfile, TrackConditionMap, Train, Trajectory
from trainlog.railway.adhesion import creep_coefficients
from trainlog.railway.condition import BIN_LENGTH, ConditionLayer
from trainlog.railway.evidence import DailyEvidence
from trainlog.railway.resistance import EffortCurve
from trainlog.simulation import Run as Samples, Scenario, recorded
from trainlog.simulation.drivers import DEPARTURE, PERIOD, Observation, Stop
from trainlog.simulation.plant import Drive, Plant
from trainlog.simulation.recording import STANDING
from trainlog.topics import REFERENCE, TRAIN_CONTROLS
from trainlog.trip import Trip, frame_of
from trainlog.units import GRAVITY, NANOSECONDS

HORIZON, LEVER_WEIGHT = 20, 0.01
"""N and R of eq. (11); Q is the unit matrix."""

SHORTEST = 6
"""Steps of the horizon that remain at the stop."""

BELOW = 0.02
"""The program stays this far below the ceiling [m/s]."""


HOLDING_SPEED, SOONER = 0.5, 0.3
"""Below this speed [m/s] a train at its stop is left to the holding brake, which stops it by so
much sooner [m]."""


class Controller(Protocol):
    """Follows one reference."""

    @property
    def unsolved(self) -> int:
        """Steps at which the program was not solved, and the plan was kept."""
        ...

    def lever(self, time: float, position: float, speed: float) -> float:
        """The lever for the next `PERIOD`.

        Parameters
        ----------
        time : float [s]
            From the departure of the timetable.
        position, speed : float [m], [m/s]
            As measured.
        """
        ...


class PublishedController:
    """Eqs. (9) to (11) and section IV of the paper, and no more; a `Controller`."""

    def __init__(self, reference: Reference, due: float | None = None) -> None:
        del due  # it follows the reference, whatever the timetable asks
        self.unsolved = 0
        self._reference = reference
        self._held, self._until = 0.0, 0
        rows = reference.sampled()
        # The lever is held for a second: that of its middle stands for it.
        rows[:, 2] = [reference.at((k + 0.5) * SAMPLING)[2] for k in range(len(rows))]
        rest = np.tile([rows[-1, 0], 0.0, 0.0], (HORIZON + SHORTEST + 1, 1))
        rows[-1, 1:] = 0.0
        self._rows = np.concatenate([rows, rest])

    def lever(self, time: float, position: float, speed: float) -> float:
        """See `Controller`; a lever is held for a second."""
        if self._until == 0:
            program = self.program(time, position, speed)
            change, status = solve(program)
            self.unsolved += status <= 0
            self._held = float(program.inputs[0] + (change[0] if status > 0 else 0.0))
            self._until = round(SAMPLING / PERIOD)
        self._until -= 1
        return self._held

    def program(self, time: float, position: float, speed: float) -> QPSubproblem:
        """The program (11) at a state; the horizon shrinks at the stop."""
        section = self._reference.section
        last = int(np.ceil(self._reference.duration / SAMPLING))
        at = min(max(round(time / SAMPLING), 0), last)
        n = int(np.clip(last - at, SHORTEST, HORIZON))
        states, levers = self._rows[at : at + n + 1, :2], self._rows[at : at + n, 2]
        deviation = np.array([position, speed]) - states[0]
        return condensed(states, levers, deviation, section.tables, section.driving_train)


def condensed(
    states: FloatArray, levers: FloatArray, deviation: FloatArray, t: Tables, c: LeverTrain
) -> QPSubproblem:
    """The program (11) in the changes of the lever alone.

    Parameters
    ----------
    states, levers : (n + 1, 2), (n,) arrays
        Of the reference, about which the motion is linearised.
    deviation : (2,) array
        Of the measured state from the first of them.
    """
    n, (p, v) = levers.size, states.T
    a, b = sampled_system(p[:-1], v[:-1], levers, t, c)
    free, response = np.zeros((n + 1, 2)), np.zeros((n + 1, 2, n))
    free[0] = deviation
    for k in range(n):
        free[k + 1], response[k + 1] = a[k] @ free[k], a[k] @ response[k]
        response[k + 1, :, k] += b[k]
    share = 0.25 * np.arange(5)[:, None]
    places, speeds = (each[:-1] + share * np.diff(each) for each in (p, v))
    ahead = t.at(t.adhesion, places + AHEAD * speeds)
    grip = np.minimum(t.at(t.adhesion, places), ahead)
    low, high = lever_bounds(speeds, t.at(t.sine, places), grip, c)
    least, most = np.maximum(low.max(axis=0), -1.0), np.minimum(high.min(axis=0), 1.0)
    terminal = terminal_weight(a[-1], b[-1], 1.0, LEVER_WEIGHT)
    hessian, gradient = tracking_cost(response, free, np.zeros(n), terminal, 1.0, LEVER_WEIGHT)
    squares = t.at(t.ceiling, p) - 2.0 * v * BELOW
    rows, upper, lower = speed_rows(
        least - levers, most - levers, response, states, free, squares, t.slope(t.ceiling, p)
    )
    return QPSubproblem(hessian, gradient, rows, upper, lower, levers)


def sampled_system(
    p: FloatArray, v: FloatArray, u: FloatArray, t: Tables, c: LeverTrain
) -> tuple[FloatArray, FloatArray]:
    """Eqs. (9) and (10) about n states and levers: (n, 2, 2) and (n, 2) arrays.

    By the exponential of ``[[A, b], [0, 0]] SAMPLING``.
    """
    system, full = np.zeros((p.size, 3, 3)), full_effort(v, c)
    system[:, 0, 1] = 1.0
    system[:, 1, 0] = -GRAVITY * t.slope(t.sine, p)
    system[:, 1, 1] = -(2.0 * c.drag * v + c.k2 * (full - c.k3) * u) / NOMINAL_MASS
    system[:, 1, 2] = full / NOMINAL_MASS
    found = expm(SAMPLING * system)
    return found[:, :2, :2].copy(), found[:, :2, 2].copy()


class MapController:
    """The product's controller on a reference and its map; a `Controller`.

    It knows neither the mass nor the rotating mass. Where the section's map is `NO_LIMIT` it has
    none, and takes the rail for dry.

    Parameters
    ----------
    reference : Reference
    due : float, optional [s]
        From the departure of the timetable to the arrival; default: that of the reference, which
        may have been put off.
    """

    def __init__(self, reference: Reference, due: float | None = None) -> None:
        section = reference.section
        self._train, self._stop = section.train, section.destination.position
        line, train = smoothed_line(section.line), driven_train(section.driving_train)
        known = section.maximum_adhesion is not NO_LIMIT
        self._driver = Follower(
            trajectory_of(reference, line, train, reference.duration if due is None else due),
            line,
            train,
            condition=map_of(line, section.maximum_adhesion) if known else None,
            layer="wet" if known else "dry",
        )

    @property
    def unsolved(self) -> int:
        """See `Controller`."""
        return self._driver.unsolved

    def lever(self, time: float, position: float, speed: float) -> float:
        """See `Controller`."""
        wanted = self._driver.demand(Observation(time + DEPARTURE, position, speed, 0.0))
        at_stop = speed < HOLDING_SPEED and abs(position - self._stop) < STOPPING_TOLERANCE
        if self._driver.finished or at_stop:
            return 0.0
        effort = wanted.tractive_effort - wanted.braking_effort
        # Between two points the curve of effort lies above the lever's, by up to 0.01 per cent.
        return min(max(effort / float(self._train.full_effort(speed)), -1.0), 1.0)


def driven_train(c: LeverTrain) -> Train:
    """The train with the curve of its lever, and comfort as a limit of its own acceleration."""
    speeds = np.linspace(0.0, TOP_SPEED, 120)
    curve = EffortCurve(speeds, c.full_effort(speeds))
    return replace(
        c.on_axles(), traction_curve=curve, dynamic_braking_curve=curve, acceleration_limits="net"
    )


def trajectory_of(reference: Reference, line: Line, train: Train, due: float) -> Trajectory:
    """A reference for both ends of the mass, stretched to arrive when it is due [s].

    It ends `SOONER` beyond the stop.
    """
    c, fine = reference.section.train, reference.fine
    ahead = np.diff(np.maximum.accumulate(fine[:, 0]), prepend=-np.inf) > 1e-6
    ahead &= fine[:, 0] < reference.positions[-1] - 1e-3
    position, speed, lever = fine[ahead].T
    time = np.linspace(0.0, due, len(fine))[ahead]
    effort, both = lever * c.full_effort(speed), np.ones((2, 1))
    speed[0] = 0.0
    masses = {"light": (c.light, 0.0), "heavy": (c.heavy, train.rotating_mass)}
    return Trajectory(
        line.name,
        train.name,
        np.append(position, reference.positions[-1] + SOONER),
        tuple(
            Configuration(name, mass, rotating, c.resistance(mass), train.max_traction_power)
            for name, (mass, rotating) in masses.items()
        ),
        both * np.append(speed, 0.0),
        both * np.append(time, due),
        np.maximum(effort, 0.0),
        both * np.maximum(-effort, 0.0),
        due,
    )


def map_of(line: Line, rail: StepProfile) -> TrackConditionMap:
    """A map that knows a rail exactly."""
    found = TrackConditionMap(line.name, line.length, BIN_LENGTH, np.array([0.1, 0.2, 0.3]), {})
    none = DailyEvidence.none(found.bins, found.levels.size)
    found.layers["wet"] = ConditionLayer(
        log_mean=np.log(rail(found.centres)),
        log_std=np.full(found.bins, 1e-9),
        observed=np.ones(found.bins, dtype=bool),
        evidence=none,
    )
    return found


# ------------------------------------------------------------------------------------------- trips

STEP = 0.005
"""Of the integration [s]."""

SHORTEST_DWELL = 20.0
"""Of a train that is late [s]."""

SHORT_OF_STOP = 30.0
"""A train that stands before its stop so long after its arrival was due has arrived there [s]."""

DRIVE = Drive(braking_fade_speed=0.05, holding_speed=HOLDING_SPEED)
"""The dynamic brake works down to where the holding brake is applied."""

AXLE_ADHESION = np.array([0.97, 0.98, 0.99, 1.01, 1.02, 1.03])
"""Of the six axles over the rail's: each cleans it for the next."""

Plan = tuple[Reference, ...]


@dataclass(frozen=True, eq=False)
class Run:
    """One simulated trip; (n,) arrays with one value a sample unless said otherwise.

    Attributes
    ----------
    name : str
    line : Line
    train : LeverTrain
    stops : tuple of Stop
    rail : StepProfile
        Maximum adhesion that the train met.
    mass : float [kg]
        True; the controller did not know it.
    delay : float [s]
        Of the first departure.
    time : [s]
    samples : (n, columns) array
        See `Plant.columns`.
    columns : tuple of str
    lever : [1]
        Of the controller; 0 at the stations.
    demands : (n, 2) array [N]
    target : (n, 3) array [m], [m/s], [N]
        Of the reference by the timetable: position, speed, and effort, negative in braking.
    section : (n,) int array
        Which section the train is on or waits for.
    arrivals, departures, places : (k,) arrays [s], [s], [m]
        Of each stop, as they were; the first arrival is 0.
    slip_energy : float [J]
        Work of all wheels against the rail.
    unsolved : int
        Steps at which the program of the controller was not solved.
    """

    name: str
    line: Line
    train: LeverTrain
    stops: tuple[Stop, ...]
    rail: StepProfile
    mass: float
    delay: float
    time: FloatArray
    samples: FloatArray
    columns: tuple[str, ...]
    lever: FloatArray
    demands: FloatArray
    target: FloatArray
    section: IntArray
    arrivals: FloatArray
    departures: FloatArray
    places: FloatArray
    slip_energy: float
    unsolved: int

    def column(self, name: str) -> FloatArray:
        """One column of the samples."""
        return np.asarray(self.samples[:, self.columns.index(name)])

    @property
    def position(self) -> FloatArray:
        """[m]."""
        return self.column("position")

    @property
    def speed(self) -> FloatArray:
        """[m/s]."""
        return self.column("speed")

    @property
    def position_error(self) -> FloatArray:
        """Position less the reference's by the timetable [m]."""
        return np.asarray(self.position - self.target[:, 0])

    @property
    def speed_error(self) -> FloatArray:
        """Speed less the reference's by the timetable [m/s]."""
        return np.asarray(self.speed - self.target[:, 1])

    @property
    def late(self) -> FloatArray:
        """Arrivals after the timetable's [s], of the stops but the first."""
        planned = np.array([stop.arrival for stop in self.stops[1:]])
        return np.asarray(self.arrivals[1:] - planned)

    @property
    def stop_error(self) -> FloatArray:
        """Where the train stood beyond its stops [m]."""
        return np.asarray(self.places[1:] - [stop.position for stop in self.stops[1:]])

    @cached_property
    def constraints(self) -> FloatArray:
        """Eq. (7) at every sample under way; (n, 4) array, NaN at the stations.

        See `analysis.studies.hauck_2023.model.constraints`, with the rail that the train met and
        without any reserve.
        """
        slope, limit = smoothed_line(self.line).gradient(self.position), self.line.speed_limit
        found = constraints(
            self.speed, self.lever, slope / np.hypot(1.0, slope), self.rail(self.position),
            limit(self.position), self.train,
        )  # fmt: skip
        return np.where((self.speed > 0.0)[:, None], found, np.nan)

    @property
    def worst(self) -> FloatArray:
        """Largest of each column of `constraints`."""
        return np.asarray(np.nanmax(self.constraints, axis=0))

    @cached_property
    def slip_speed(self) -> FloatArray:
        """Wheel speeds less the train's [m/s]; (n, axles) array."""
        wheels = [name for name in self.columns if name.startswith("wheel_speed")]
        return np.column_stack([self.column(name) for name in wheels]) - self.speed[:, None]

    @cached_property
    def _curves(self) -> FloatArray:
        """Creep curves under the train, as the plant has them; (n, 1, 3)."""
        return creep_coefficients(self.rail(self.position))[:, None]

    @cached_property
    def slipping(self) -> BoolArray:
        """Whether each axle skids or slides: beyond the peak of its creep curve; (n, axles)."""
        return np.asarray(np.abs(self.slip_speed) > peak_slips(self._curves))

    @property
    def slip_events(self) -> int:
        """How often an axle began to skid or slide."""
        begun = np.diff(self.slipping.astype(np.int8), axis=0, prepend=0) > 0
        return int(np.count_nonzero(begun))

    @cached_property
    def skid_energy(self) -> float:
        """Of `slip_energy` what axles beyond the peak of their creep curve do [J], sampled."""
        slip = np.abs(self.slip_speed)
        weight = GRAVITY * self.mass / slip.shape[1]
        force = weight * AXLE_ADHESION * adhesion_at(slip, self._curves)
        return float(np.sum(np.where(self.slipping, force * slip, 0.0)) * PERIOD)

    @property
    def protections(self) -> int:
        """How often the slip protection of the drive took hold of an axle."""
        active = self.column("protected_axles")
        return int(np.maximum(np.diff(active, prepend=0.0), 0.0).sum())


def with_map(plan: Plan, rail: StepProfile) -> Plan:
    """The same references under another map: what the controller takes the rail for."""
    first = plan[0].section
    stops = (first.origin, *(each.section.destination for each in plan))
    sections = sections_of(first.line, first.train, rail, stops)
    return tuple(
        replace(each, section=section) for each, section in zip(plan, sections, strict=True)
    )


def run(
    name: str,
    plan: Plan,
    rail: StepProfile,
    mass: float,
    *,
    delay: float = 0.0,
    published: bool = False,
    timetable: Sequence[Stop] | None = None,
) -> Run:
    """Drive a timetable once.

    Parameters
    ----------
    name : str
    plan : tuple of Reference
        What the controller knows: references, and in their sections the map.
    rail : StepProfile
        Maximum adhesion as it is.
    mass : float [kg]
        True one.
    delay : float [s]
        Of the first departure.
    published : bool
        By the controller of the paper; default: by the product's.
    timetable : sequence of Stop, optional
        What is hurried for where the references were put off; default: their own stops.

    Raises
    ------
    InputError
        If the train cannot have the mass.
    InfeasibleError
        If it does not arrive.
    """
    sections = [each.section for each in plan]
    line, train = sections[0].line, sections[0].train
    train.check_mass(mass)
    axles = train.on_axles()
    plant = Plant.of(
        smoothed_line(line), axles, mass=mass, resistance=train.resistance(mass),
        maximum_adhesion=rail, axle_adhesion=AXLE_ADHESION, drive=DRIVE, step=STEP,
    )  # fmt: skip
    stops = tuple(timetable or (sections[0].origin, *(each.destination for each in sections)))
    recorder = _Recorder(plant, sections[0].origin.position)
    arrivals, departures, places = [0.0], [], [sections[0].origin.position]
    unsolved = 0
    for number, reference in enumerate(plan):
        begins = reference.section.origin.departure
        due = stops[number].departure + (delay if number == 0 else 0.0)
        leaves = due if number == 0 else max(due, np.ceil(arrivals[-1] + SHORTEST_DWELL))
        while recorder.now < leaves - 0.5 * PERIOD:
            recorder.stand(reference, number)
        departures.append(recorder.now)
        kind = PublishedController if published else MapController
        controller = kind(reference, stops[number + 1].arrival - begins)
        _drive_section(recorder, reference, controller, number)
        unsolved += controller.unsolved
        arrivals.append(recorder.now)
        places.append(recorder.state.position)
    departures.append(np.inf)
    for _ in range(round(STANDING / PERIOD)):
        recorder.stand(plan[-1], len(plan) - 1)
    rows = np.array(recorder.rows, dtype=np.float64)
    return Run(
        name=name,
        line=line,
        train=train,
        stops=stops,
        rail=rail,
        mass=mass,
        delay=delay,
        time=np.arange(len(rows), dtype=np.float64) * PERIOD,
        samples=np.concatenate(recorder.samples),
        columns=plant.columns,
        lever=rows[:, 0],
        demands=rows[:, 1:3],
        target=rows[:, 3:6],
        section=rows[:, 6].astype(np.int64),
        arrivals=np.array(arrivals, dtype=np.float64),
        departures=np.array(departures, dtype=np.float64),
        places=np.array(places, dtype=np.float64),
        slip_energy=recorder.state.works["slip"],
        unsolved=unsolved,
    )


class _Recorder:
    """The plant under way, and what is recorded of it."""

    def __init__(self, plant: Plant, position: float) -> None:
        self.plant = plant
        self.state = plant.at(position)
        self.samples: list[FloatArray] = []
        self.rows: list[tuple[float, ...]] = []

    @property
    def now(self) -> float:
        """[s]."""
        return PERIOD * len(self.rows)

    def advance(self, reference: Reference, number: int, lever: float) -> None:
        """One period with the lever held: the effort follows the curve as the speed changes."""
        full_effort = reference.section.train.full_effort
        effort = lever * float(full_effort(self.state.speed))
        demand = max(effort, 0.0), max(-effort, 0.0)
        position, speed, aim = reference.at(self.now - reference.section.origin.departure)
        planned = aim * float(full_effort(speed))
        self.rows.append((lever, *demand, position, speed, planned, number))
        steps = round(PERIOD / STEP)
        self.samples.append(self.plant.advance(self.state, *demand, steps, steps))

    def stand(self, reference: Reference, number: int) -> None:
        """One period at a station: the holding brake is applied."""
        self.advance(reference, number, 0.0)


def _drive_section(
    recorder: _Recorder, reference: Reference, controller: Controller, number: int
) -> None:
    section = reference.section
    begun, stop = recorder.now, section.destination.position
    patience = 3.0 * section.duration + 600.0
    while True:
        state = recorder.state
        time = recorder.now - section.origin.departure
        recorder.advance(reference, number, controller.lever(time, state.position, state.speed))
        if state.speed == 0.0 and (
            state.position > stop - STOPPING_TOLERANCE or time > reference.duration + SHORT_OF_STOP
        ):
            return
        if recorder.now - begun > patience:
            raise InfeasibleError(
                f"{section.name}: the train does not arrive; at km {state.position / 1e3:.3f}"
                f" after {patience:.0f} s",
                remedy="check adhesion and gradients there",
            )


def trip_of(run: Run, weather: str, seed: int, start: int = START) -> Trip:
    """The log of one run, as the train's sensors would have it.

    Parameters
    ----------
    run : Run
    weather : str
        Name of the rail's condition, the layer of a track-condition map.
    seed : int
        Of the sensors' noise.
    start : int [ns]
        When the run begins, since 1970 UTC.
    """
    train = run.train.on_axles()
    scenario = Scenario(
        name=run.name.replace(" ", "-").replace(",", ""),
        line=run.line,
        train=train,
        direction="forward",
        weather=weather,
        mass=run.mass,
        rotating_mass=train.rotating_mass,
        resistance=run.train.resistance(run.mass),
        max_power=train.max_traction_power,
        maximum_adhesion=run.rail,
        stops=run.stops,
        seed=seed,
        start=start,
    )
    trip = recorded(scenario, Samples(run.time, run.samples, run.demands))
    controls = trip[TRAIN_CONTROLS.name].copy()
    controls["lever"] = np.round(run.lever, 4) + 0.0
    time = start + np.round(run.time * NANOSECONDS).astype(np.int64)
    effort = run.target[:, 2]
    followed: dict[str, ArrayLike] = {
        "speed": run.target[:, 1],
        "tractive_effort": np.maximum(effort, 0.0),
        "braking_effort": np.maximum(-effort, 0.0),
        "lateness": lateness(run),
    }
    reference = frame_of(REFERENCE, time, followed)
    return (
        trip.with_topic(controls)
        .with_topic(reference)
        .with_step(
            "study map-mpc",
            software=f"trainlog {__version__}",
            run=run.name,
            mass=run.mass,
            delay=run.delay,
        )
    )


def lateness(run: Run) -> FloatArray:
    """How late the train is where it is [s], by the reference of its section.

    It begins with the planned departure and keeps its last value after the arrival.
    """
    late = np.zeros(run.time.size)
    for number, origin in enumerate(run.stops[:-1]):
        on = run.section == number
        planned = on & (run.time >= origin.departure)
        positions, first = np.unique(run.target[planned, 0], return_index=True)
        due = np.interp(run.position[on], positions, run.time[planned][first])
        late[on] = np.clip(run.time[on], origin.departure, run.arrivals[number + 1]) - due
    return late
