"""Physical checks of proposed columns: in which units speed, distance, fixes and efforts agree.

All take values as the file has them; the factor that they find is the unit. A reading costs as much
as it leaves unexplained, in numbers that the proposal shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from estimators.receiver import integral
from trainlog.arrays import FloatArray
from trainlog.ingest.mapping import in_si
from trainlog.ingest.motion import (
    ALIKE,
    CHORD,
    HOLDS,
    INLIER,
    LATITUDE,
    LONGITUDE,
    SEVERAL,
    DrivenMass,
    driven_mass,
    rate_of,
)
from trainlog.ingest.profile import Column
from trainlog.ingest.recording import METRES_PER_DEGREE
from trainlog.railway.train import Train
from trainlog.units import factor

WINDOWS = 40
"""Parts of a trip in which two measures of the distance are compared."""


class Ratio(NamedTuple):
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

    value: float = np.nan
    agreement: float = 0.0
    windows: int = 0
    scatter: float = np.nan

    @staticmethod
    def of(ratios: FloatArray, inlier: float = INLIER) -> Ratio:
        """The usual one of some ratios, and how well they agree; none of fewer than three."""
        if ratios.size < 3:
            return Ratio()
        middle = float(np.median(ratios))
        off = np.abs(ratios - middle) / max(abs(middle), 1e-12)
        near = (off < inlier) & (middle != 0.0)
        value = float(np.median(ratios[near])) if near.any() else middle
        return Ratio(value, float(np.mean(near)), int(ratios.size), float(np.median(off)))

    @property
    def holds(self) -> bool:
        """Whether most of the trip has this factor."""
        return self.windows >= SEVERAL and self.agreement >= HOLDS

    @property
    def exact(self) -> bool:
        """Whether all of the trip has it, as only a column and its own integral have."""
        return self.agreement > 0.95 and self.scatter < 0.02


def distance_ratio(seconds: FloatArray, position: FloatArray, speed: FloatArray) -> Ratio:
    """The change of a distance over the integral of a speed, in windows of the trip.

    Windows in which the distance starts anew, or the speed stands still, do not count.
    """
    # A recorder may count the speed against its own direction.
    driven = np.nan_to_num(integral(seconds, speed if np.nanmean(speed) >= 0.0 else -speed)[0])
    known = np.flatnonzero(np.isfinite(position))
    total = float(np.ptp(driven))
    if known.size < 3 or total <= 0.0:
        return Ratio()
    # Equal parts of the distance driven.
    marks = np.searchsorted(driven[known], np.linspace(driven[0], driven[-1], WINDOWS + 1))
    marks = known[np.unique(np.clip(marks, 0, known.size - 1))]
    gained, shift = np.diff(driven[marks]), np.diff(position[marks])
    usable = gained > 0.2 * total / WINDOWS
    return Ratio.of(shift[usable] / gained[usable])


def same_motion(other: FloatArray, speed: FloatArray) -> Ratio:
    """The median factor between two speeds while the train moves."""
    known = np.isfinite(other) & np.isfinite(speed)
    known &= speed > 0.3 * np.nanpercentile(speed, 95)
    return Ratio.of(other[known] / speed[known], ALIKE)


class Fixes(NamedTuple):
    """Distances [m] between fixes about `CHORD` apart, and when [s]; (n,) and (n + 1,) arrays."""

    marks: FloatArray
    chords: FloatArray

    @staticmethod
    def of(seconds: FloatArray, latitude: FloatArray, longitude: FloatArray) -> Fixes:
        """The chords of fixes in degrees; none where there are fewer than three."""
        fixed = np.isfinite(latitude) & np.isfinite(longitude)
        at = seconds[fixed]
        if at.size < 3:
            return Fixes(np.zeros(1), np.zeros(0))
        marks = np.arange(at[0], at[-1], max(CHORD, 2.0 * float(np.median(np.diff(at)))))
        middle = np.radians(float(np.median(latitude[fixed])))
        north, east = (np.interp(marks, at, each[fixed]) for each in (latitude, longitude))
        degrees = np.hypot(np.diff(north), np.cos(middle) * np.diff(east))
        return Fixes(marks, METRES_PER_DEGREE * degrees)

    @property
    def speed(self) -> float:
        """The highest usual speed [m/s] at which the fixes move, the 95th percentile."""
        if not self.chords.size:
            return np.nan
        return float(np.percentile(self.chords / np.diff(self.marks), 95))

    def speeds(self, seconds: FloatArray) -> FloatArray | None:
        """How fast the fixes move at some times [m/s]; None of fewer than two chords."""
        if self.chords.size < 2:
            return None
        middle = 0.5 * (self.marks[1:] + self.marks[:-1])
        return np.interp(seconds, middle, self.chords / np.diff(self.marks))

    def ratio(self, seconds: FloatArray, speed: FloatArray) -> Ratio:
        """The chords over the integral of a speed, while the train is fast.

        Curves make a chord shorter, the noise of a standing receiver makes it longer.
        """
        driven = np.nan_to_num(integral(seconds, np.abs(speed))[0])
        gained = np.diff(np.interp(self.marks, seconds, driven))
        usable = gained > 0.5 * np.percentile(gained, 90) if gained.size else gained > 0.0
        return Ratio.of(self.chords[usable] / np.maximum(gained[usable], 1e-9))


UNITS: dict[str, dict[str, float]] = {
    "length": {
        "m": 0.0, "km": 0.0, "mile": 0.6, "foot": 0.8, "cm": 0.6, "mm": 0.6, "dm": 0.8, "hm": 0.8
    },
    "speed": {
        "km/h": 0.0, "m/s": 0.0, "mph": 0.6, "knot": 0.6, "ft/s": 1.6, "cm/s": 1.2, "mm/s": 1.2
    },
    "force": {"kN": 0.0, "N": 0.0, "daN": 0.8, "MN": 1.2, "lbf": 1.2, "klbf": 1.2},
}  # fmt: skip
"""Units that are tried, with the cost of each where the file states none."""

IMPERIAL = ("mile", "foot", "mph", "ft/s", "lbf", "klbf")

SI = {"length": "m", "speed": "m/s", "force": "N"}

OVERRULED = 3.0
"""Cost of another unit than the one that the file states, and of what no train does."""

AMBIGUOUS = 1.2
"""Difference in cost up to which a reading is an alternative."""

TOLERANCE = 0.05
"""Relative difference of two measures of one distance that is usual (wheel wear, curves)."""

MASSES, SPREAD_OF_MASS = (3e4, 2e6), 1.6
"""Masses [kg] that trains usually have, and the factor by which the slope of effort over
acceleration may miss a known one (gradients)."""

SPEEDS = {3.0: OVERRULED, 9.0: 1.0, 15.0: 0.4}, {75.0: 0.7, 100.0: OVERRULED, 130.0: 5.0}
"""Cost of a highest speed [m/s] below, and above each of these."""


class Answer(NamedTuple):
    """The cheapest units, and what they rest on.

    Attributes
    ----------
    units : dict of str to str
        Of ``"length"``, ``"speed"`` and ``"force"``, as far as the file has them.
    others : dict of str to list of str
        Other units of each that the data allow as well.
    distance, chords : Ratio
        Of raw distance, and of metres between fixes, over the integral of the raw speed.
    driven : DrivenMass
        What the efforts move [kg].
    unexplained : dict of str to float
        What no units explain, ``"distance"`` or ``"fixes"``, and how many times the integral of the
        speed it is.
    cost : float
        What the units leave unexplained.
    """

    units: dict[str, str]
    others: dict[str, list[str]]
    distance: Ratio = Ratio()
    chords: Ratio = Ratio()
    driven: DrivenMass = DrivenMass(np.nan, 0.0, 0.0)
    unexplained: Mapping[str, float] = MappingProxyType({})
    cost: float = 0.0

    def si(self, kind: str) -> float:
        """SI units in one of the unit of a kind."""
        return factor(self.units[kind], SI[kind])[0]


def units_of(
    seconds: FloatArray,
    given: Mapping[str, FloatArray],
    stated: Mapping[str, str] | None = None,
    fixes: Fixes | None = None,
    train: Train | None = None,
) -> Answer:
    """The units with which speed, distance, fixes and efforts agree best.

    Parameters
    ----------
    seconds : (n,) array [s]
    given : dict of str to (n,) array
        ``"length"``, ``"speed"`` and ``"force"``, in the file's own numbers; the force drives
        where it is positive.
    stated : dict of str to str
        Units that the file states, by the same names; empty where it states none.
    fixes : Fixes, optional
    train : Train, optional
        Whose mass the force must accelerate; default: any train's.
    """
    by_distance = "speed" not in given and "length" in given
    speed = rate_of(seconds, given["length"]) if by_distance else given.get("speed")
    if speed is None:
        return Answer({}, {})
    known = np.abs(speed[np.isfinite(speed)])
    fastest = float(np.percentile(known, 99.5)) if known.size else np.nan
    distance = chords = Ratio()
    if "length" in given and not by_distance:
        distance = distance_ratio(seconds, given["length"], speed)
    if fixes is not None:
        chords = fixes.ratio(seconds, speed)
    driven = DrivenMass(np.nan, 0.0, 0.0)
    if "force" in given:
        # Speeds above 1 m/s are used: a raw speed is larger, or almost, in every unit.
        driven = driven_mass(seconds, given["force"], np.abs(speed))
    low, high = MASSES
    if train is not None:
        low = train.mass * (1.0 + train.rotating_mass_factor) / SPREAD_OF_MASS
        high = (SPREAD_OF_MASS * low + train.max_load) * SPREAD_OF_MASS

    def judged(units: dict[str, str]) -> Answer:
        size = {kind: factor(unit, SI[kind])[0] for kind, unit in units.items()}
        ratios = {}
        if distance.holds:
            ratios["distance"] = abs(distance.value) * size["length"] / size["speed"]
        if chords.holds:
            ratios["fixes"] = chords.value / size["speed"]
        off = {name: abs(math.log(max(ratio, 1e-12))) for name, ratio in ratios.items()}
        mass = driven.mass * size.get("force", np.nan) / size["speed"] if driven.decides else np.nan
        cost = sum(min(12.0, max(0.0, each - TOLERANCE) / 0.04) for each in off.values())
        usual = [0.0]
        for kind, unit in units.items():
            own = (stated or {}).get(kind)
            charge = OVERRULED * (unit != own) if own else UNITS[kind].get(unit, 0.0)
            if not own and unit in IMPERIAL:
                usual.append(charge)
            else:
                cost += charge
        # Who measures in miles also measures in mph and pounds: that is one choice.
        cost += max(usual)
        cost += too_slow(size["speed"] * fastest) + too_fast(size["speed"] * fastest)
        if math.isfinite(mass) and mass:
            far = max(math.log(low / abs(mass)), math.log(abs(mass) / high))
            cost += OVERRULED * max(0.0, far)
        wrong = {name: ratios[name] for name in ratios if off[name] > 3.0 * TOLERANCE}
        moved = driven._replace(mass=mass)
        return Answer(units, {}, distance, chords, moved, wrong, float(cost))

    kinds = [kind for kind in UNITS if kind in given]
    tried = [
        dict(zip(kinds, each, strict=True)) for each in product(*(UNITS[kind] for kind in kinds))
    ]
    if by_distance:
        tried = [{**units, "speed": f"{units['length']}/s"} for units in tried]
    answers = sorted(map(judged, tried), key=lambda each: each.cost)
    # Pounds that nothing states go with a speed, or a distance alone, in imperial units.
    pace = "length" if by_distance else "speed"
    metric = {u for u in UNITS["force"] if u not in IMPERIAL} | {(stated or {}).get("force")}
    best = next(
        each
        for each in answers
        if each.units.get("force", "N") in metric or each.units[pace] in IMPERIAL
    )
    for kind, taken in best.units.items():
        close = [each.units[kind] for each in answers if each.cost <= best.cost + AMBIGUOUS]
        best.others[kind] = [unit for unit in dict.fromkeys(close) if unit != taken]
    return best


def too_slow(fastest: float) -> float:
    """Cost of a highest speed [m/s] that is a low one for a train."""
    return sum(charge for bound, charge in SPEEDS[0].items() if fastest < bound)


def too_fast(fastest: float) -> float:
    """Cost of a highest speed [m/s] that is a high one for a train."""
    return sum(charge for bound, charge in SPEEDS[1].items() if fastest > bound)


SCALES: dict[str, tuple[dict[str, Any], float]] = {
    "degrees": ({}, 0.0),
    "1e-7 degrees": ({"scale": 1e-7}, 0.0),
    "1e-6 degrees": ({"scale": 1e-6}, 0.0),
    "1e-5 degrees": ({"scale": 1e-5}, 1.0),
    "degrees and minutes": ({"notation": "degrees_minutes"}, 0.0),
    "radians": ({"unit": "rad"}, 1.5),
    "seconds of arc": ({"scale": 1.0 / 3600.0}, 4.0),
    "milliseconds of arc": ({"scale": 1.0 / 3.6e6}, 4.0),
    "semicircles": ({"scale": 180.0 / 2.0**31}, 4.0),
}
"""How recorders write latitude and longitude, as a profile states it, with the cost of each."""

SWAPPED = 1.5
"""Cost of taking latitude for longitude against the columns' names."""


class Position(NamedTuple):
    """Latitude and longitude as they are read.

    Attributes
    ----------
    latitude, longitude : Column
    words : str
        One of `SCALES`.
    fixes : Fixes
    swapped : bool
        Whether the names of the columns say the opposite.
    cost : float
        What the reading leaves unexplained.
    """

    latitude: Column
    longitude: Column
    words: str
    fixes: Fixes
    swapped: bool
    cost: float


def positions_of(
    seconds: FloatArray, columns: list[tuple[str, FloatArray]], speed: FloatArray | None
) -> list[Position]:
    """The scales and orders of two columns that are possible, the likeliest first.

    Parameters
    ----------
    seconds : (n,) array [s]
    columns : list of (name, (n,) array)
        What the names say are latitude and longitude.
    speed : (n,) array, optional
        A speed in any unit.
    """
    found: list[Position] = []
    raw = np.abs(np.array([values for _, values in columns]))
    raw = raw[:, np.isfinite(raw).all(axis=0)]
    if not raw.size:
        return []
    for words, (how, charge) in SCALES.items():
        if how.get("scale", 1.0) <= 1e-5 and np.any(raw != np.round(raw)):
            continue
        if "notation" in how and (np.max(raw % 100.0) >= 60.001 or np.median(raw) < 100.0):
            continue
        for swapped in (False, True):
            ordered = zip((LATITUDE, LONGITUDE), columns[:: -1 if swapped else 1], strict=True)
            read = [
                (
                    column := Column(column=name, **{"unit": "deg", **how}),
                    in_si(field, column, each),
                )
                for field, (name, each) in ordered
            ]
            (latitude, north), (longitude, east) = read
            if any(
                np.nanpercentile(np.abs(each), 99) > top
                for each, top in ((north, 90.0), (east, 180.0))
            ):
                continue
            fixes = Fixes.of(seconds, north, east)
            # Several devices in one file leap: that is refused, and shows no other scale.
            cost = charge + SWAPPED * swapped + too_slow(fixes.speed)
            ratio = Ratio() if speed is None else fixes.ratio(seconds, speed)
            if ratio.windows >= SEVERAL:
                cost += 15.0 * min(ratio.scatter, 1.0)
            found.append(Position(latitude, longitude, words, fixes, swapped, cost))
    return sorted(found, key=lambda each: each.cost)
