"""One section of a timetable, as the map-based controllers see it: from stop to stop."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from analysis.control.route import GRID
from analysis.studies.hauck_2023 import model as model
from analysis.studies.hauck_2023.model import NOMINAL_MASS, TOP_SPEED, LeverTrain, Tables
from trainlog.arrays import FloatArray
from trainlog.errors import InfeasibleError, InputError
from trainlog.railway import Line, StepProfile
from trainlog.simulation.drivers import Stop, check_stops

SMOOTHING = 25.0
"""The gradient under the train is that of the track this far before and behind it [m]."""


@dataclass(frozen=True, slots=True)
class Reserves:
    """How much of the map is used; the rest is for what no model knows.

    Attributes
    ----------
    adhesion : float
        Share of the map's maximum adhesion: the first axle finds the rail least clean.
    brake : float
        Share of the brake that the envelope counts on.
    speed : float [m/s]
        Kept below every speed limit: efforts follow their demand with a lag.
    lever, comfort : float
        Share of the lever and of a_max: a heavier train needs more of both than a reference does.
    """

    adhesion: float = 0.95
    brake: float = 0.99
    speed: float = 0.04
    lever: float = 1.0
    comfort: float = 0.99

    def __post_init__(self) -> None:
        for name in ("adhesion", "brake", "lever", "comfort"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InputError(
                    f"the share of the {name} must be above 0 and at most 1, not"
                    f" {getattr(self, name)}"
                )


DRIVING = Reserves()
"""Of a train under way."""

NONE = Reserves(adhesion=1.0, brake=1.0, speed=0.0, lever=1.0, comfort=1.0)
"""Of a bound."""

PLANNING = Reserves(adhesion=0.7, brake=0.7, speed=0.4, lever=0.7, comfort=0.75)
"""Of a reference, so that a controller may deviate from it."""

STOPPING_TOLERANCE = 0.5
"""epsilon_1 of eq. (8): how far beyond its stop a train may stand [m]."""

FASTEST_RISE = 1.5
"""No train gains speed faster than this [m/s²]."""

RUNNING_ON = 100.0
"""How far the tables reach beyond both ends of a section [m]."""

NO_LIMIT = StepProfile(np.zeros(1), np.array([0.999]))
"""What a controller assumes that knows no map: that the rail holds anything."""


@dataclass(frozen=True, eq=False)
class Section:
    """A train's way from one stop to the next, and what may be asked of it there.

    Attributes
    ----------
    origin, destination : Stop
    line : Line
    train : LeverTrain
    maximum_adhesion : StepProfile
        As the map has it.
    tables : Tables
        Of a train under way; its ceiling is that of the mass that brakes worst.
    planned : Tables
        Of its reference: less of everything, and the ceiling of the speed limits alone, smoothed.
    stopping : (n,) array [m²/s²]
        Square of the speed from which a reference stops at the destination, on the grid of
        `planned`.
    planning : Reserves
    """

    origin: Stop
    destination: Stop
    line: Line
    train: LeverTrain
    maximum_adhesion: StepProfile
    tables: Tables
    planned: Tables
    stopping: FloatArray
    planning: Reserves

    @property
    def name(self) -> str:
        """Both ends."""
        return f"{self.origin.station} - {self.destination.station}"

    @property
    def duration(self) -> float:
        """What the timetable allows [s]."""
        return self.destination.arrival - self.origin.departure

    @property
    def planning_train(self) -> LeverTrain:
        """The train with the lever and the comfort that a reference uses."""
        return _reserved(self.train, self.planning)

    @property
    def driving_train(self) -> LeverTrain:
        """The train with the comfort that is used under way."""
        return _reserved(self.train, DRIVING)


def section_of(
    line: Line,
    train: LeverTrain,
    maximum_adhesion: StepProfile,
    origin: Stop,
    destination: Stop,
    planning: Reserves = PLANNING,
) -> Section:
    """Prepare one section.

    Parameters
    ----------
    line : Line
        As travelled.
    train : LeverTrain
    maximum_adhesion : StepProfile
        By position.
    origin, destination : Stop
    planning : Reserves

    Raises
    ------
    InputError
        If the stops are not in the order of travel, or an adhesion is not between 0 and 1.
    """
    check_stops(line, (origin, destination))
    _check(line, maximum_adhesion)
    rail, start, stop = maximum_adhesion, origin.position, destination.position
    planned = _tables(line, rail, start, stop, planning)
    driven = _tables(line, rail, start, stop + STOPPING_TOLERANCE, DRIVING, 0.0)
    at_stop = planned.origin + GRID * np.arange(planned.sine.size) >= stop
    stopping = planned._replace(ceiling=np.where(at_stop, 0.0, TOP_SPEED**2))
    limited = _braked(planned, planning, train).ceiling
    return Section(
        origin,
        destination,
        line,
        train,
        rail,
        _braked(driven, DRIVING, train),
        planned._replace(adhesion=_smoothed(planned.adhesion), ceiling=_smoothed(limited)),
        _braked(stopping, planning, train).ceiling,
        planning,
    )


def _tables(
    line: Line, rail: StepProfile, start: float, stop: float, reserves: Reserves,
    last: float = np.inf,
) -> Tables:  # fmt: skip
    """Tables from a place on with a node at `stop` [m], beyond which the speed is `last` [m/s].

    The ceiling does not allow for braking.
    """
    before = int(np.ceil((stop - start + RUNNING_ON) / GRID))
    nodes = stop + GRID * np.arange(-before, RUNNING_ON / GRID + 1.0)
    slope = line.gradients.mean(nodes - SMOOTHING, nodes + SMOOTHING)
    limit = np.minimum(_lowest(line.speed_limits, nodes), TOP_SPEED)
    squares = np.maximum(limit - reserves.speed, 0.0) ** 2
    squares = np.where(nodes >= stop, np.minimum(squares, last**2), squares)
    return Tables(
        float(nodes[0]),
        np.asarray(slope / np.hypot(1.0, slope)),
        reserves.adhesion * _lowest(rail, nodes),
        model.limited_rise(squares, FASTEST_RISE),
    )


def sections_of(
    line: Line, train: LeverTrain, maximum_adhesion: StepProfile, stops: tuple[Stop, ...]
) -> tuple[Section, ...]:
    """All sections of a timetable.

    Raises
    ------
    InputError
        As `section_of`.
    """
    check_stops(line, stops)
    return tuple(
        section_of(line, train, maximum_adhesion, origin, destination)
        for origin, destination in pairwise(stops)
    )


@dataclass(frozen=True, eq=False)
class FastRun:
    """A run as fast as allowed, by position; (n,) arrays.

    Attributes
    ----------
    positions, speeds, times, levers : [m], [m/s], [s], [1]
    """

    positions: FloatArray
    speeds: FloatArray
    times: FloatArray
    levers: FloatArray

    @property
    def duration(self) -> float:
        """From rest to rest [s]."""
        return float(self.times[-1])


def fastest(
    section: Section, mass: float = NOMINAL_MASS, most: float = np.inf, step: float = 1.0
) -> FastRun:
    """The fastest run of a section that a reference could be.

    Parameters
    ----------
    section : Section
    mass : float [kg]
    most : float [m/s]
        Speed that is never exceeded.
    step : float [m]

    Raises
    ------
    InfeasibleError
        If the train comes to a stand on the way.
    """
    section.train.check_mass(mass)
    t = section.planned
    allowed = t._replace(ceiling=np.minimum(t.ceiling, section.stopping))
    return _fastest(section, allowed, section.planning_train, mass, most, step)


def fastest_unweighed(
    section: Section, mass: float = NOMINAL_MASS, rotating_mass: float = 0.0
) -> FastRun:
    """The fastest run of any driver who does not know the mass: (7) holds for every mass of (6).

    A bound, without any reserve: adhesion, brake, comfort and limits in full, no lag, and a lever
    that changes at every metre. The motion and the brake are those of the true mass, as if it had
    been guessed right.

    Parameters
    ----------
    section : Section
    mass : float [kg]
    rotating_mass : float [kg]
        What rotating parts add to the mass of the motion.

    Raises
    ------
    InputError
        If the train cannot have the mass.
    InfeasibleError
        If it comes to a stand on the way.
    """
    section.train.check_mass(mass)
    stop = section.destination.position + STOPPING_TOLERANCE
    start, inertia, c = section.origin.position, 1.0 + rotating_mass / mass, section.train
    t = _tables(section.line, section.maximum_adhesion, start, stop, NONE, 0.0)
    ceiling = model.braking_envelope(t.ceiling, t.sine, t.adhesion, 1.0, mass, mass, inertia, c)
    return _fastest(section, t._replace(ceiling=ceiling), c, mass, np.inf, 1.0, inertia)


def _fastest(
    section: Section, t: Tables, c: LeverTrain, mass: float, most: float, step: float,
    inertia: float = 1.0,
) -> FastRun:  # fmt: skip
    start, end = section.origin.position, section.destination.position
    run = FastRun(*model.fastest_run(start, end, step, most, mass, inertia, t, c))
    if run.positions[-1] < end - 1e-6:
        place = float(run.positions[-1])
        raise InfeasibleError(
            f"{section.name}: a train of {mass / 1e3:g} t comes to a stand at km"
            f" {place / 1e3:.3f}, on {1e3 * t.at(t.sine, place):.1f} per mille with a maximum"
            f" adhesion of {t.at(t.adhesion, place):.3f}",
            remedy="less load, or a better rail",
        )
    return run


def check_timetable(sections: tuple[Section, ...], mass: float = NOMINAL_MASS) -> None:
    """Refuse a timetable that cannot be kept, before any solver runs.

    Raises
    ------
    InfeasibleError
        Names the first section whose time is below the least, and by how much.
    """
    for section in sections:
        least = fastest(section, mass).duration
        if section.duration < least:
            raise InfeasibleError(
                f"{section.name}: the timetable allows {section.duration:.0f} s, a train of"
                f" {mass / 1e3:g} t needs {least:.1f} s at least",
                remedy=f"arrive {least - section.duration:.0f} s later or more",
            )


def smoothed_line(track: Line) -> Line:
    """The line under a train of 40 m: gradients averaged over its length, in short steps."""
    starts: FloatArray = GRID * np.arange(np.ceil(track.length / GRID), dtype=np.float64)
    middles = starts + 0.5 * GRID
    mean = track.gradients.mean(middles - SMOOTHING, middles + SMOOTHING)
    return replace(track, gradients=StepProfile(starts, mean))


def _lowest(profile: StepProfile, nodes: FloatArray) -> FloatArray:
    """The lowest value of a profile within one step of the grid around each node."""
    fine = nodes[:, None] + np.linspace(-GRID, GRID, 21)
    lowest = profile(fine).min(axis=1)
    # A step between two of the samples is met by the value on its other side.
    inside = np.searchsorted(nodes, profile.positions[1:])
    for i, lower in zip(inside, np.minimum(profile.values[1:], profile.values[:-1]), strict=True):
        for j in (i - 1, i):
            if 0 <= j < nodes.size:
                lowest[j] = min(lowest[j], lower)
    return np.asarray(lowest)


def _braked(t: Tables, reserves: Reserves, train: LeverTrain) -> Tables:
    """Tables with the ceiling from which all that lies ahead can be kept."""
    c, grip = _reserved(train, reserves), _around(t.adhesion)
    return t._replace(
        ceiling=model.braking_envelope(
            t.ceiling, t.sine, grip, reserves.brake, c.light, c.heavy, 1.0, c
        )
    )


def _reserved(train: LeverTrain, reserves: Reserves) -> LeverTrain:
    return train._replace(lever=reserves.lever, comfort=reserves.comfort * train.comfort)


def _around(adhesion: FloatArray) -> FloatArray:
    """The least within 40 m: a lever is held for a second, and looks ahead."""
    from scipy.ndimage import minimum_filter1d

    return np.asarray(minimum_filter1d(adhesion, 17, mode="nearest"))


def _smoothed(squares: FloatArray) -> FloatArray:
    """Never above `squares`, with its corners rounded over 20 m."""
    from scipy.ndimage import minimum_filter1d, uniform_filter1d

    return np.asarray(uniform_filter1d(minimum_filter1d(squares, 5, mode="nearest"), 5))


def _check(line: Line, maximum_adhesion: StepProfile) -> None:
    values = maximum_adhesion.values
    wrong = (values <= 0.0) | (values >= 1.0)
    if np.any(wrong):
        at = float(maximum_adhesion.positions[int(np.argmax(wrong))])
        raise InputError(
            f"line '{line.name}': maximum adhesion {values[wrong][0]} at km {at / 1e3:.3f} is not"
            " between 0 and 1"
        )
