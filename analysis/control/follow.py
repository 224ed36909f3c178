"""A driver that follows a robust trajectory by map-based model predictive control.

It knows the trajectory, the line, the train's file, the set of configurations that the train may
be in, and, if there is one, the track-condition map; of the train it sees position, speed and time.
It does not know its own configuration: what it follows is the trajectory of the configuration that
arrives last, which all can keep, and it arrives with that.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from analysis.adhesion.axles import protection_onsets
from analysis.comparison.driven import driven_trip
from analysis.control import prediction
from analysis.control.prediction import TICK, QPSubproblem, TrainEstimate, Weights
from analysis.control.route import (
    NO_MARGIN,
    Margin,
    TrainLimits,
    dynamic_braking,
    effort_limits,
    free_deceleration,
    powered_adhesion,
    route_tables,
    train_limits,
    value,
)
from analysis.trajectory.problem import TrajectoryProblem
from estimators.linear_gaussian import corrected
from estimators.motion import OdometryFilter
from trainlog.arrays import FloatArray
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.presentation import kwh
from trainlog.railway import Line, TrackConditionMap, Train, Trajectory
from trainlog.simulation import Scenario, trajectory_scenarios
from trainlog.simulation.drivers import AT_REST, DEPARTURE, PERIOD, Demand, Observation
from trainlog.simulation.plant import HOLDING
from trainlog.simulation.sensors import Reading, Sensors
from trainlog.trip import Trip
from trainlog.units import NANOSECONDS, clock

STOPPING_TOLERANCE = 0.3
"""A train that stands no more than this short of its stop has arrived [m]."""

ARRIVING = 0.1
"""Speed [m/s] below which the train is held there: it stands within a centimetre."""

SHORTEST = 3
"""Steps of the horizon that remain at the stop."""

SLOW = 1.0
"""Below this speed [m/s] nothing is learnt: brakes fade and grip."""

REVERSAL = 20e3
"""Effort [N] on both sides of a reversal from traction to braking or back."""

GUARD_SIGMAS = 2.0
"""Standard deviations by which a train may be elsewhere, or faster."""

CREEPING, MOVING_UP = 0.3, 10.0
"""Acceleration [m/s²] with which a train moves up that stands short of its stop by this [m]."""


HORIZON, STEP = 20, 1.0
"""Steps of the program, and how long each is [s] when the stop is far; tenths of a second."""

EVERY = 0.5
"""Time from one decision to the next [s]."""

WEIGHTS = Weights(1.0, 2.0, 20.0)


class Follower:
    """Follows a trajectory; a `trainlog.simulation.drivers.Driver`.

    Parameters
    ----------
    trajectory : Trajectory
        From standstill to standstill.
    line : Line
        In the direction of travel.
    train : Train
    condition : TrackConditionMap, optional
        Efforts are kept within the adhesion that it cautiously promises.
    layer : str
        Rail condition to read from the map.
    risk : float, optional
        Probability, for each place and trip, that there is less adhesion than is counted on;
        default: the estimate less standard deviations.
    time : Timestamp, optional
        Of the run: what the map expects then is counted on.
    departure : float [s]
        When it departs; the timetable is that of a departure at `DEPARTURE`.
    margin : Margin
        Where position and speed are known less well than that, at `GUARD_SIGMAS`, the
        guard takes the rest off as well.

    Attributes
    ----------
    unsolved : int
        Decisions at which the program was not solved, and the last plan was kept to.

    Raises
    ------
    InputError
        If the trajectory is of another line or train, leaves the line, does not end at a
        standstill; or the map is of another line.

    Examples
    --------
    >>> import numpy as np
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> trajectory = trainlog.Trajectory(
    ...     line.name, train.name, np.array([0.0, 500.0, 1000.0]),
    ...     (trainlog.Configuration.of(train),),
    ...     np.array([[0.0, 20.0, 0.0]]), np.array([[0.0, 50.0, 100.0]]),
    ...     np.array([53e3, 0.0]), np.array([[0.0, 53e3]]), 100.0,
    ... )
    >>> Follower(trajectory, line, train).unsolved
    0
    """

    def __init__(
        self,
        trajectory: Trajectory,
        line: Line,
        train: Train,
        *,
        condition: TrackConditionMap | None = None,
        layer: str = "wet",
        risk: float | None = None,
        time: pd.Timestamp | None = None,
        departure: float = DEPARTURE,
        margin: Margin = NO_MARGIN,
    ) -> None:
        run = replace(run_of(trajectory, line, train, condition, layer), risk=risk, time=time)
        self.unsolved = 0
        self._limits = train_limits(run)
        self._margin = margin
        self._route = route_tables(run, trajectory, self._limits, self._margin)
        self._arrival = DEPARTURE + float(trajectory.times[trajectory.latest, -1])
        self._departure = departure
        self._release = departure - train.brake.dead_time - 3.0 * train.brake.lag
        self._observer = Observer(self._limits)
        self._factor = 1.0
        self._rows = np.zeros((400, 4))
        self._past = np.zeros(round(train.brake.dead_time / TICK))
        self._friction = 0.0
        self._effort = 0.0
        self._plan = np.zeros(0)
        self._ticks = round(STEP / TICK)
        self._decided = -math.inf
        self._since: tuple[float, float] | None = None
        self._acted: list[float] = []
        self._arrived = False

    @property
    def finished(self) -> bool:
        """Whether the train stands at the trajectory's end."""
        return self._arrived

    @property
    def estimate(self) -> TrainEstimate:
        """What the train was found to be on its way."""
        return self._observer.estimate

    def demand(self, observation: Observation) -> Demand:
        """The efforts wanted now."""
        distance = self._route.end - observation.position
        if observation.speed < ARRIVING and distance <= STOPPING_TOLERANCE:
            self._arrived = True
        if self._arrived or observation.time < self._release:
            return Demand(0.0, HOLDING * self._limits.mass)
        if observation.time < self._departure - 1e-9:
            return Demand()
        last = max(min(EVERY, self._ticks * TICK), PERIOD)
        if observation.time - self._decided > last - 1e-6:
            self._observe(observation)
            self._effort = self._decide(observation)
            self._decided = observation.time
        low, high = prediction.effort_bounds(
            observation.position, observation.speed, observation.position, self._route, self._limits
        )
        effort = min(max(self._effort, low), high)
        place, speed = observation.position, observation.speed
        self._passes(place, speed, effort)
        force = effort * self._limits.inertia
        most = powered_adhesion(place, speed, self._route, self._limits)
        return Demand(max(force, 0.0), max(-force, 0.0), most)

    def _passes(self, position: float, speed: float, effort: float) -> None:
        """Keep account of what the brake will do of its own for the next tick."""
        quick, asked = prediction.split(effort, position, speed, self._route, self._limits)
        waiting = np.append(self._past, asked)
        late, self._past = float(waiting[0]), waiting[1:]
        after = late + (self._friction - late) * math.exp(-PERIOD / self._limits.lag)
        self._acted.append(quick - 0.5 * (self._friction + after))
        self._friction = after

    def _observe(self, seen: Observation) -> None:
        """Learn from what the train did since the last decision."""
        if self._since is not None and self._acted and seen.speed > SLOW:
            limits, (before, speed) = self._limits, self._since
            span = len(self._acted) * PERIOD
            place, mean = 0.5 * (before + seen.position), 0.5 * (speed + seen.speed)
            own = limits.constant, limits.linear, limits.quadratic
            middle = np.array([limits.mass, limits.inertia, *own])
            track = (
                limits.mass / limits.inertia * value(self._route.track, self._route.origin, place)
            )
            self._observer.update(
                acceleration=(seen.speed - speed) / span,
                effort=float(np.mean(self._acted)),
                drag=free_deceleration(place, mean, middle, self._route) - track,
                track=track,
                span=span,
            )
        self._since = seen.position, seen.speed
        self._acted = []

    def program(self, seen: Observation) -> QPSubproblem:
        """The program of a decision at a state; its `inputs` are specific efforts [m/s²].

        The first is held until the next decision; the horizon ends at the stop at the latest.
        """
        limits, route = self._limits, self._route
        estimate = self._observer.estimate
        p, v, lasting = seen.position, seen.speed, estimate._replace(drift=0.0)
        left = self._arrival - seen.time
        self._factor, time, count = prediction.pace_to_arrive(
            left, self._factor, p, v, self._rows, lasting, route, limits
        )
        most = round(STEP / TICK)
        ticks = int(np.clip(math.ceil(time / (HORIZON * TICK) - 1e-9), 1, most))
        n = int(np.clip(math.ceil(time / (ticks * TICK)), SHORTEST, HORIZON))
        target, aim = prediction.sampled(self._rows, count, n, ticks * TICK)
        aim = aim - estimate.drift / estimate.gain
        plan = self._guess(aim, ticks, seen.time)
        states, response, kept, low, high = prediction.linearised(
            p, v, self._friction, self._past, plan, ticks, estimate, route, limits
        )
        hessian, gradient, rows, upper, lower = prediction.condensed(
            states, response, kept, low, high, target, aim, self._effort, WEIGHTS,
            ticks * TICK, estimate, route,
        )  # fmt: skip
        self._ticks = ticks
        return QPSubproblem(hessian, gradient, rows, upper, lower, kept)

    def _decide(self, seen: Observation) -> float:
        """The specific effort [m/s²] until the next decision."""
        if seen.speed < AT_REST and seen.position > self._route.end - MOVING_UP:
            back = prediction.expected_deceleration(
                seen.position, 0.0, self._observer.estimate, self._route, self._limits
            )
            return self._guarded(seen, CREEPING + max(back, 0.0))
        program = self.program(seen)
        change, status = prediction.solve(program)
        if status <= 0:
            self.unsolved += 1
            change = np.zeros(program.inputs.size)
        self._plan = program.inputs + change
        return self._guarded(seen, float(self._plan[0]))

    def _guarded(self, seen: Observation, effort: float) -> float:
        """The effort next to `effort` that is safe until the next decision has taken effect."""
        limits = self._limits
        held = max(round(min(EVERY, self._ticks * TICK) / TICK), 1)
        lead = 2
        here = seen.position, seen.speed, self._route, limits
        if dynamic_braking(*here) < effort_limits(*here)[1]:
            lead += len(self._past) + round(2.0 * limits.lag / TICK)
        beyond = max(GUARD_SIGMAS * seen.position_std - self._margin.position, 0.0)
        speed = seen.speed + max(GUARD_SIGMAS * seen.speed_std - self._margin.speed, 0.0)
        return min(
            float(
                prediction.guarded(
                    place, speed, self._friction, self._past, self._effort, effort,
                    held, held + lead, self._route, limits,
                )
            )
            for place in {seen.position - beyond, seen.position + beyond}
        )  # fmt: skip

    def _guess(self, aim: FloatArray, ticks: int, now: float) -> FloatArray:
        """The last plan at the times of the new one; the reference's efforts without one."""
        if self._plan.size == 0 or now - self._decided > STEP:
            return np.ascontiguousarray(aim)
        middles = now - self._decided + (np.arange(aim.size) + 0.5) * ticks * TICK
        index = (middles / (self._ticks * TICK)).astype(np.int64)
        return self._plan[np.minimum(index, self._plan.size - 1)]


def following_scenarios(
    trajectory: Trajectory,
    line: Line,
    train: Train,
    *,
    configurations: str = "hardest",
    weather: str = "dry",
    condition_map: TrackConditionMap | None = None,
    risk: float | None = None,
    time: pd.Timestamp | None = None,
    late: float = 0.0,
    seed: int = 1,
) -> list[Scenario]:
    """Trips of simulated trains along a trajectory by map-based model predictive control.

    Each trip is in one configuration, which its driver does not know; position and speed are known
    as far as the train's own instruments measure them. A section of a journey departs when its plan
    has it. `trainlog.simulate` drives a scenario; ``trainlog simulate follow`` drives all.

    Parameters
    ----------
    trajectory : Trajectory
        From standstill to standstill.
    line : Line
        In its own direction.
    train : Train
    configurations : str
        ``"hardest"``, ``"all"``, or names separated by commas; see `Trajectory.chosen`.
    weather : {"dry", "wet"}
        Of the rail, and the layer of the map.
    condition_map : TrackConditionMap, optional
        That the driver knows.
    risk : float, optional
        With which the map is read; see `Follower`.
    time : Timestamp, optional
        Of the run, for which the map is read; see `Follower`.
    late : float [s]
        By which the trains depart late.
    seed : int
        Of rail, sensors and survey.

    Returns
    -------
    list of Scenario
        Their trips have ``/reference``, from which ``lateness`` shows how well the trajectory was
        followed.

    Raises
    ------
    InputError
        If a configuration is unknown, or the trajectory is of another line or train. What
        `Follower` refuses is refused when a scenario is driven.

    Examples
    --------
    >>> from analysis import OptimiserOptions, TrajectoryProblem, optimise
    >>> from trainlog import Configuration, read_line, read_train, simulate
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> alone = [Configuration.of(train)]
    >>> problem = TrajectoryProblem(line, train, alone, end=2_500.0, reserve=0.2)
    >>> trajectory = optimise(problem, OptimiserOptions(cells=80))
    >>> trip = simulate(following_scenarios(trajectory, line, train)[0])
    >>> bool(abs(trip["/reference"]["lateness"].iloc[-1]) < 2.0)
    True
    """
    follows = partial(
        Follower, trajectory, line.travelled(trajectory.direction), train, condition=condition_map,
        layer=weather, risk=risk, time=time, departure=DEPARTURE + late, margin=MARGIN,
    )  # fmt: skip
    departure = float(trajectory.provenance.get("journey", {}).get("departure", 0.0))
    scenarios = trajectory_scenarios(
        trajectory, line, train, trajectory.chosen(configurations), follows, seed=seed,
        weather=weather, locates=Odometry,
    )  # fmt: skip
    return [replace(each, start=each.start + round(NANOSECONDS * departure)) for each in scenarios]


def effort_reversals(tractive: ArrayLike, braking: ArrayLike) -> int:
    """How often efforts go from traction to braking or back, beyond `REVERSAL` on both sides.

    Parameters
    ----------
    tractive, braking : (n,) array_like [N]
        Asked for, in the order of time.

    Examples
    --------
    >>> effort_reversals([50e3, 10e3, 0.0, 0.0, 30e3], [0.0, 0.0, 15e3, 60e3, 0.0])
    2
    """
    net = np.nan_to_num(np.asarray(tractive) - np.asarray(braking))
    signs = np.sign(net[np.abs(net) > REVERSAL])
    return int(np.count_nonzero(np.diff(signs)))


def following_line(trip: Trip, trajectory: Trajectory) -> str:
    """How a trip follows, in words: running time, energy, slip protection, reversals of effort.

    The running time is that from departure to arrival, as a plan has it, without what is recorded
    before and after. Efforts count while the train moves.
    """
    moving = trip["/train/state"]["speed"].to_numpy() > 0.0
    counts = []
    for topic, end in (("/train/controls", "_demand"), ("/reference", "")):
        tractive, braking = (
            trip[topic][f"{kind}_effort{end}"].to_numpy()[moving]
            for kind in ("tractive", "braking")
        )
        counts.append(effort_reversals(tractive, braking))
    driven, planned = counts
    onsets = protection_onsets(trip)
    acted = "is not recorded" if onsets is None else f"acted {counted(len(onsets), 'time')}"
    run, planned_time = driven_trip(trip), float(trajectory.running_time)
    work = float(trajectory.tractive_effort @ np.diff(trajectory.positions))
    return (
        f"running time {clock(run.duration)} from departure to arrival, {clock(planned_time)}"
        f" planned; traction {kwh(run.work('traction'))}, {kwh(work)} planned; slip protection"
        f" {acted}; {counted(driven, 'reversal')} from traction to braking or back beyond"
        f" {REVERSAL / 1e3:g} kN, {planned} in the plan"
    )


def run_of(
    trajectory: Trajectory,
    line: Line,
    train: Train,
    condition: TrackConditionMap | None = None,
    layer: str = "wet",
) -> TrajectoryProblem:
    """The run that a trajectory was made for, with a map of now.

    Raises
    ------
    InputError
        See `Follower`.
    """
    trajectory.check_run(line, train)
    start, end = float(trajectory.positions[0]), float(trajectory.positions[-1])
    if np.any(trajectory.speeds[:, -1] > 0.1):
        raise InputError(
            f"the trajectory passes its end at km {end / 1e3:.3f} and does not stop there",
            remedy="plan it with a final speed of 0",
        )
    return TrajectoryProblem(
        line, train, trajectory.configurations, start=start, end=min(end, line.length),
        condition_map=condition, layer=layer,
        protected_length=trajectory.protected_length,
        direction=trajectory.direction,
    )  # fmt: skip


NOISE = 0.02
"""Of an acceleration between two decisions [m/s²]."""

UNSURE = 0.05
"""Of an effort that acted, over the effort: drives lag, and wheels slip a little."""

DRIFT, DRIFT_LASTS = 0.015, 15.0
"""What nothing explains: standard deviation [m/s²], and how long it lasts [s]."""

LEAST_SPREAD = 0.02
"""The set is taken to be no narrower than this, relative."""

SURPRISE = 5.0
"""Standard deviations from which on a sample shows nothing of the train: wheels may slip."""


class Observer:
    """Finds gain, drag and drift (see `analysis.control.prediction`) from what the train does.

    Parameters
    ----------
    limits : TrainLimits
        The observed set, from whose spread it starts.
    """

    def __init__(self, limits: TrainLimits) -> None:
        inertias, drags = limits.corners[:, 1], limits.corners[:, 2:] @ (1.0, 20.0, 400.0)
        spreads = [np.ptp(values) / values.sum() * values.size for values in (inertias, drags)]
        gain, drag = (0.5 * max(float(spread), LEAST_SPREAD) for spread in spreads)
        self._mean = np.array([1.0, 0.0, 0.0])
        self._covariance = np.diag([gain**2, drag**2, DRIFT**2])

    @property
    def estimate(self) -> TrainEstimate:
        """What the train is estimated to be now."""
        return TrainEstimate(*self._mean.tolist())

    def update(
        self, acceleration: float, effort: float, drag: float, track: float, span: float
    ) -> None:
        """Take in what happened since the last decision.

        Parameters
        ----------
        acceleration : float [m/s²]
            Mean since then.
        effort : float [m/s²]
            Specific effort that acted, without gain.
        drag : float [m/s²]
            Running resistance of the middle of the set, over its inertia.
        track : float [m/s²]
            Deceleration by gradient and curves.
        span : float [s]
        """
        keep = float(np.exp(-span / DRIFT_LASTS))
        fade = np.array([1.0, 1.0, keep])
        self._mean = fade * self._mean
        self._covariance = fade[:, None] * self._covariance * fade
        self._covariance[2, 2] += (1.0 - keep**2) * DRIFT**2
        row = np.array([effort, -drag, 1.0])
        value, noise = acceleration + drag + track, NOISE**2 + (UNSURE * effort) ** 2
        shared, surprise = self._covariance @ row, value - float(row @ self._mean)
        variance = float(row @ shared) + noise
        gain, reach = shared * (1.0 / variance), SURPRISE * math.sqrt(variance)
        if abs(surprise) > reach:
            # Wheels that slip show nothing of the train: what they show is drift, up to a limit.
            gain[:2], surprise = 0.0, math.copysign(reach, surprise)
        self._mean, self._covariance = corrected(
            self._mean, self._covariance, row, surprise, noise, gain
        )


MARGIN = Margin(position=2.0, speed=0.05)
"""For a controller that sees the train by `Odometry`: twice what its standard deviations come to
on most of the way, `balise_spacing` apart."""


class Odometry:
    """Position and speed of a train while it runs, by `estimators.motion`.

    Parameters
    ----------
    sensors : Sensors
        How good the instruments are.
    start : float [m]
        Where the train is taken to stand, to 10 m; the balise beneath it corrects that.
    """

    def __init__(self, sensors: Sensors, start: float) -> None:
        quantised = math.sqrt(1.0 / 12.0)
        self._filter = OdometryFilter(
            start,
            acceleration_noise=math.hypot(
                sensors.acceleration_noise, quantised * sensors.acceleration_resolution
            ),
            wheel_noise=math.hypot(sensors.speed_noise, quantised * sensors.speed_resolution),
            satellite_noise=sensors.gnss_speed_noise,
            balise_noise=sensors.balise_error,
        )

    def __call__(self, reading: Reading) -> Observation:
        """The train's motion after one more sample."""
        seen = self._filter.update(
            reading.time,
            reading.acceleration,
            reading.wheel_speed,
            reading.satellite_speed,
            reading.balise,
        )
        return Observation(
            reading.time,
            seen.position,
            seen.speed,
            reading.acceleration - float(seen.estimate[2]),
            position_std=seen.position_std,
            speed_std=seen.speed_std,
        )
