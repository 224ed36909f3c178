"""Physical checks of proposed columns: what must hold between them if they are read rightly.

Each check gives a number that the proposal shows. All take values as the file has them; the factor
that they find is the unit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from estimators.receiver import integral
from trainlog.arrays import FloatArray, IntArray
from trainlog.ingest.mapping import degrees_of
from trainlog.ingest.motion import driven_mass, rate_of
from trainlog.ingest.recording import METRES_PER_DEGREE, NO_TIME
from trainlog.railway.train import Train
from trainlog.units import NANOSECONDS, factor

WINDOWS = 40
"""Parts of a trip in which two measures of the distance are compared."""

LEAST_WINDOWS = 6
"""Windows with motion that it takes."""

INLIER = 0.3
"""Deviation from the median ratio, as a share of it, up to which a window counts."""

CHORD = 15.0
"""Time [s] between two fixes whose distance is compared with the distance driven."""


@dataclass(frozen=True, slots=True)
class Ratio:
    """How one column goes with another.

    Attributes
    ----------
    value : float
        The factor between them.
    agreement : float
        Share of the windows that have this factor, to 30 per cent.
    windows : int
    scatter : float
        Median deviation of the windows from the factor, as a share of it.
    """

    value: float
    agreement: float
    windows: int
    scatter: float = np.nan

    @property
    def holds(self) -> bool:
        """Whether most of the trip has this factor."""
        return self.windows >= LEAST_WINDOWS and self.agreement >= 0.6


@dataclass(frozen=True, eq=False)
class Motion:
    """Times and a speed-like column, in order.

    Attributes
    ----------
    order : (n,) int array
        Rows that have a time, in its order.
    seconds : (n,) array [s]
    """

    order: IntArray
    seconds: FloatArray

    @staticmethod
    def of(time: IntArray) -> Motion:
        """The rows with a time, in its order."""
        known = np.flatnonzero(time != NO_TIME)
        order = known[np.argsort(time[known], kind="stable")]
        return Motion(order, (time[order] - time[order[0]]) / NANOSECONDS)

    def integral(self, rate: FloatArray) -> FloatArray:
        """The integral of a column over time, gaps on a line; 0 without two values."""
        return np.nan_to_num(integral(self.seconds, rate)[0])


def distance_ratio(motion: Motion, position: FloatArray, speed: FloatArray) -> Ratio:
    """The change of a distance over the integral of a speed, in windows of the trip.

    Windows in which the distance starts anew, or the speed stands still, do not count.
    """
    # A recorder may count the speed against its own direction.
    driven = motion.integral(speed if np.nanmean(speed) >= 0.0 else -speed)
    known = np.flatnonzero(np.isfinite(position))
    total = float(np.ptp(driven))
    if known.size < 3 or total <= 0.0:
        return Ratio(np.nan, 0.0, 0)
    # Equal parts of the distance driven.
    marks = np.searchsorted(driven[known], np.linspace(driven[0], driven[-1], WINDOWS + 1))
    marks = np.unique(np.clip(marks, 0, known.size - 1))
    gained = np.diff(driven[known][marks])
    shift = np.diff(position[known][marks])
    usable = gained > 0.2 * total / WINDOWS
    return _ratio_of(shift[usable] / gained[usable], INLIER)


def _ratio_of(ratios: FloatArray, inlier: float) -> Ratio:
    """The usual one of some ratios, and how well they agree; none of fewer than three."""
    if ratios.size < 3:
        return Ratio(np.nan, 0.0, 0)
    middle = float(np.median(ratios))
    off = np.abs(ratios - middle) / max(abs(middle), 1e-12)
    near = (off < inlier) & (middle != 0.0)
    value = float(np.median(ratios[near])) if near.any() else middle
    return Ratio(value, float(np.mean(near)), int(ratios.size), float(np.median(off)))


@dataclass(frozen=True, eq=False)
class Fixes:
    """Distances between fixes about `CHORD` apart, and when.

    Attributes
    ----------
    marks : (n + 1,) array [s]
    chords : (n,) array [m]
    """

    marks: FloatArray
    chords: FloatArray

    @staticmethod
    def of(motion: Motion, latitude: FloatArray, longitude: FloatArray) -> Fixes:
        """The chords of fixes in degrees; none where there are fewer than three."""
        fixed = np.isfinite(latitude) & np.isfinite(longitude)
        nothing = Fixes(np.zeros(1), np.zeros(0))
        if np.count_nonzero(fixed) < 3:
            return nothing
        at = motion.seconds[fixed]
        marks = np.arange(at[0], at[-1], max(CHORD, 2.0 * float(np.median(np.diff(at)))))
        if marks.size < 3:
            return nothing
        scale = METRES_PER_DEGREE * np.cos(np.radians(float(np.median(latitude[fixed]))))
        north = np.interp(marks, at, latitude[fixed]) * METRES_PER_DEGREE
        east = np.interp(marks, at, longitude[fixed]) * scale
        return Fixes(marks, np.hypot(np.diff(north), np.diff(east)))

    @property
    def speed(self) -> float:
        """The highest usual speed [m/s] at which the fixes move, the 95th percentile."""
        if not self.chords.size:
            return np.nan
        return float(np.percentile(self.chords / np.diff(self.marks), 95))

    def ratio(self, motion: Motion, speed: FloatArray) -> Ratio:
        """The chords over the integral of a speed, while the train is fast.

        Curves make a chord shorter, the noise of a standing receiver makes it longer.
        """
        gained = np.diff(np.interp(self.marks, motion.seconds, motion.integral(speed)))
        usable = gained > 0.5 * np.percentile(gained, 90) if gained.size else gained > 0.0
        return _ratio_of(self.chords[usable] / np.maximum(gained[usable], 1e-9), INLIER)


def same_motion(other: FloatArray, speed: FloatArray) -> Ratio:
    """The median factor between two speeds while the train moves."""
    known = np.isfinite(other) & np.isfinite(speed)
    known &= speed > 0.3 * np.nanpercentile(speed, 95)
    if np.count_nonzero(known) < 20:
        return Ratio(np.nan, 0.0, 0)
    return _ratio_of(other[known] / speed[known], 0.1)


SPEED_UNITS = {
    "km/h": 0.0, "m/s": 0.0, "mph": 0.6, "knot": 0.6, "ft/s": 1.6, "cm/s": 1.2, "mm/s": 1.2
}  # fmt: skip
LENGTH_UNITS = {
    "m": 0.0, "km": 0.0, "mile": 0.6, "foot": 0.8, "cm": 0.6, "mm": 0.6, "dm": 0.8, "hm": 0.8
}  # fmt: skip
FORCE_UNITS = {"kN": 0.0, "N": 0.0, "daN": 0.8, "MN": 1.2, "lbf": 1.2, "klbf": 1.2}
"""Units that are tried, with the cost of each where the file states none."""

OVERRULED = 3.0
"""Cost of another unit than the one that the file states."""

AMBIGUOUS = 1.2
"""Difference in cost up to which a reading is an alternative."""

TOLERANCE = 0.05
"""Relative difference of two measures of one distance that is usual (wheel wear, curves)."""

MASSES = (3e4, 2e6)
"""Masses [kg] that trains usually have."""

SPREAD_OF_MASS = 1.6
"""Factor by which the slope of effort over acceleration may miss a known mass (gradients)."""


@dataclass(frozen=True, slots=True)
class Units:
    """Units of one reading; empty for what the file does not have."""

    speed: str = ""
    length: str = ""
    force: str = ""


@dataclass(frozen=True, eq=False)
class Question:
    """What the file has, in its own numbers, and which units it states.

    Attributes
    ----------
    motion : Motion
    speed, position, effort : (n,) array, optional
        In order of time; `effort` drives where it is positive.
    fixes : Fixes, optional
    stated : Units
        Empty where the file states none.
    train : Train, optional
    """

    motion: Motion
    speed: FloatArray | None = None
    position: FloatArray | None = None
    effort: FloatArray | None = None
    fixes: Fixes | None = None
    stated: Units = field(default_factory=Units)
    train: Train | None = None


@dataclass(frozen=True)
class Answer:
    """The cheapest units, and what they rest on.

    Attributes
    ----------
    units : Units
    alternatives : dict of str to tuple of str
        Other units of ``"speed"``, ``"length"`` and ``"force"`` that the data allow as well.
    distance, chords : Ratio
        Of raw distance, and of metres between fixes, over the integral of the raw speed.
    mass : float [kg]
        What the efforts move; NaN where they do not decide.
    correlation : float
        Of effort and acceleration.
    unexplained : tuple of str
        What no units explain: ``"distance"``, ``"fixes"``.
    cost : float
        What the units leave unexplained.
    """

    units: Units
    alternatives: dict[str, tuple[str, ...]]
    distance: Ratio
    chords: Ratio
    mass: float
    correlation: float
    unexplained: tuple[str, ...]
    cost: float = 0.0


_NONE = Ratio(np.nan, 0.0, 0)


@dataclass(frozen=True)
class _Measured:
    """What is measured once, in the file's numbers."""

    fastest: float
    distance: Ratio
    chords: Ratio
    slope: float


def units_of(question: Question) -> Answer:
    """The units with which speed, distance, fixes and efforts agree best."""
    speed = question.speed
    motion = question.motion
    from_distance = speed is None and question.position is not None
    if from_distance:
        assert question.position is not None
        speed = np.abs(rate_of(motion.seconds, question.position))
    if speed is None:
        return Answer(Units(), {}, _NONE, _NONE, np.nan, 0.0, ())
    known = np.abs(speed[np.isfinite(speed)])
    distance = chords = _NONE
    if question.position is not None and not from_distance:
        distance = distance_ratio(motion, question.position, speed)
    if question.fixes is not None:
        chords = question.fixes.ratio(motion, np.abs(speed))
    driven = None
    if question.effort is not None:
        # Speeds above 1 m/s are used: a raw speed is larger, or almost, in every unit.
        driven = driven_mass(motion.seconds, question.effort, np.abs(speed))
    measured = _Measured(
        float(np.percentile(known, 99.5)) if known.size else np.nan,
        distance,
        chords,
        driven.mass if driven is not None and driven.decides else np.nan,
    )
    costs = {units: _cost(units, question, measured) for units in _tried(question, from_distance)}
    best = min(costs, key=lambda units: costs[units])
    others: dict[str, tuple[str, ...]] = {}
    for kind in ("speed", "length", "force"):
        cheapest: dict[str, float] = {}
        for units, cost in costs.items():
            unit = getattr(units, kind)
            cheapest[unit] = min(cost, cheapest.get(unit, np.inf))
        taken = getattr(best, kind)
        others[kind] = tuple(
            unit
            for unit, cost in sorted(cheapest.items(), key=lambda item: item[1])
            if unit != taken and cost <= costs[best] + AMBIGUOUS
        )
    return Answer(
        best,
        others,
        distance,
        chords,
        measured.slope * _mass_factor(best),
        driven.correlation if driven is not None else 0.0,
        tuple(_unexplained(best, measured)),
        costs[best],
    )


def _tried(question: Question, from_distance: bool) -> Iterator[Units]:
    speeds = SPEED_UNITS if question.speed is not None else {"": 0.0}
    lengths = LENGTH_UNITS if question.position is not None else {"": 0.0}
    forces = FORCE_UNITS if question.effort is not None else {"": 0.0}
    for length in lengths:
        for speed in speeds if not from_distance else (f"{length}/s",):
            for force in forces:
                yield Units(speed, length, force)


def _mass_factor(units: Units) -> float:
    """What turns the slope of raw effort over raw acceleration into kilograms."""
    if not units.force or not units.speed:
        return np.nan
    return factor(units.force, "N")[0] / factor(units.speed, "m/s")[0]


def _cost(units: Units, question: Question, measured: _Measured) -> float:
    cost = 0.0
    for kind, usual in (("speed", SPEED_UNITS), ("length", LENGTH_UNITS), ("force", FORCE_UNITS)):
        unit, stated = getattr(units, kind), getattr(question.stated, kind)
        if stated:
            cost += OVERRULED * (unit != stated)
        elif unit in usual:
            cost += usual[unit]
    cost += sum(_off(ratio) for ratio in _mismatches(units, measured).values())
    metres = factor(units.speed, "m/s")[0] if units.speed else np.nan
    cost += _implausible(metres * measured.fastest)
    mass = measured.slope * _mass_factor(units)
    if np.isfinite(mass):
        low, high = MASSES
        if question.train is not None:
            least = question.train.mass * (1.0 + question.train.rotating_mass_factor)
            low, high = least / SPREAD_OF_MASS, (least + question.train.max_load) * SPREAD_OF_MASS
        cost += 3.0 * max(0.0, np.log(low / max(abs(mass), 1e-9)), np.log(abs(mass) / high))
    return float(cost)


def _mismatches(units: Units, measured: _Measured) -> dict[str, float]:
    """Ratios that are one if the units are right."""
    if not units.speed:
        return {}
    speed = factor(units.speed, "m/s")[0]
    found = {}
    if measured.distance.holds and units.length:
        length = factor(units.length, "m")[0]
        found["distance"] = abs(measured.distance.value) * length / speed
    if measured.chords.holds:
        found["fixes"] = measured.chords.value / speed
    return found


def _unexplained(units: Units, measured: _Measured) -> Iterator[str]:
    for name, ratio in _mismatches(units, measured).items():
        if abs(np.log(ratio)) > 3.0 * TOLERANCE:
            yield name


def _off(ratio: float) -> float:
    """Cost of two measures of a distance that differ by a factor."""
    return float(min(12.0, max(0.0, abs(np.log(max(ratio, 1e-12))) - TOLERANCE) / 0.04))


def _implausible(fastest: float) -> float:
    """Cost of a highest speed [m/s]."""
    cost = 0.0
    for bound, charge in ((3.0, 3.0), (9.0, 1.0), (15.0, 0.4)):
        cost += charge * (fastest < bound)
    for bound, charge in ((75.0, 0.7), (100.0, 3.0), (130.0, 5.0)):
        cost += charge * (fastest > bound)
    return cost


SCALES: dict[str, tuple[float, float]] = {
    "degrees": (1.0, 0.0),
    "1e-7 degrees": (1e-7, 0.0),
    "1e-6 degrees": (1e-6, 0.0),
    "1e-5 degrees": (1e-5, 1.0),
    "degrees and minutes": (np.nan, 0.0),
    "radians": (180.0 / np.pi, 1.5),
    "seconds of arc": (1.0 / 3600.0, 4.0),
    "milliseconds of arc": (1.0 / 3.6e6, 4.0),
    "semicircles": (180.0 / 2.0**31, 4.0),
}
"""Scales of latitude and longitude [degrees], with the cost of each."""

SWAPPED = 1.5
"""Cost of taking latitude for longitude against the columns' names."""

FASTEST = 110.0
"""Speed [m/s] beyond which fixes do not belong to one train."""


@dataclass(frozen=True, eq=False)
class Position:
    """Latitude and longitude as they are read.

    Attributes
    ----------
    latitude, longitude : str
        Columns.
    scale : str
        One of `SCALES`.
    fixes : Fixes
    speed : float [m/s]
        At which the fixes move.
    swapped : bool
        Whether the names of the columns say the opposite.
    cost : float
        What the reading leaves unexplained.
    """

    latitude: str
    longitude: str
    scale: str
    fixes: Fixes
    speed: float
    swapped: bool
    cost: float

    @property
    def words(self) -> str:
        """The reading in words."""
        return f"{self.scale}, latitude and longitude {'swapped' if self.swapped else 'as named'}"


def in_degrees(scale: str) -> Callable[[FloatArray], FloatArray]:
    """What turns numbers of a scale into degrees."""
    if scale == "degrees and minutes":
        return degrees_of
    size = SCALES[scale][0]
    return lambda values: values * size


def positions_of(
    motion: Motion,
    columns: tuple[tuple[str, FloatArray], tuple[str, FloatArray]],
    speed: FloatArray | None,
) -> list[Position]:
    """The scales and orders of two columns that are possible, the likeliest first.

    Parameters
    ----------
    columns : ((name, values), (name, values))
        What the names say are latitude and longitude.
    speed : (n,) array, optional
        A speed in any unit.
    """
    found: list[Position] = []
    for swapped in (False, True):
        (north, first), (east, second) = columns if not swapped else columns[::-1]
        for scale, (_, charge) in SCALES.items():
            latitude, longitude = (in_degrees(scale)(values) for values in (first, second))
            if not _possible(scale, first, second, latitude, longitude):
                continue
            fixes = Fixes.of(motion, latitude, longitude)
            cost = charge + SWAPPED * swapped + _fixes_cost(motion, fixes, speed)
            found.append(Position(north, east, scale, fixes, fixes.speed, swapped, cost))
    return sorted(found, key=lambda each: each.cost)


def _possible(
    scale: str,
    first: FloatArray,
    second: FloatArray,
    latitude: FloatArray,
    longitude: FloatArray,
) -> bool:
    known = np.isfinite(first) & np.isfinite(second)
    # Rows without a fix hold zeros.
    known &= (first != 0.0) | (second != 0.0)
    if not known.any():
        return False
    counted = scale.startswith("1e-") or scale in ("semicircles", "milliseconds of arc")
    if counted and not all(
        np.all(each[known] == np.round(each[known])) for each in (first, second)
    ):
        return False
    if scale == "degrees and minutes":
        minutes = np.concatenate([np.abs(first[known]) % 100.0, np.abs(second[known]) % 100.0])
        if float(np.max(minutes)) >= 60.001 or float(np.median(np.abs(first[known]))) < 100.0:
            return False
    north = float(np.percentile(np.abs(latitude[known]), 99))
    east = float(np.percentile(np.abs(longitude[known]), 99))
    return north <= 90.0 and east <= 180.0


def _fixes_cost(motion: Motion, fixes: Fixes, speed: FloatArray | None) -> float:
    """What the motion of the fixes leaves unexplained, whatever the unit of the speed."""
    cost = 0.0
    fastest = fixes.speed
    if not np.isfinite(fastest):
        return 0.0
    for bound, charge in ((0.1, 4.0), (1.0, 3.0), (5.0, 0.8)):
        cost += charge * (fastest < bound)
    for bound, charge in ((100.0, 2.0), (200.0, 1.0)):
        cost += charge * (fastest > bound)
    if speed is None:
        return cost
    ratio = fixes.ratio(motion, np.abs(speed))
    if np.isfinite(ratio.value) and ratio.windows >= 5:
        cost += 15.0 * min(ratio.scatter, 1.0)
    return cost
