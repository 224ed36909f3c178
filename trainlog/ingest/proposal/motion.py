"""Units of speed, distance, fixes and efforts: those with which the columns obey mechanics.

Every reading is a set of units. Its cost adds what the units leave unexplained: the integral of the
speed against the distance and against the distances between fixes, accelerations and speeds that no
train has, the mass that the efforts move; and a charge for leaving the unit that the file states,
or a usual one. The cheapest reading is taken, those almost as cheap are stated as alternatives.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.ingest.proposal.checks import (
    Fixes,
    Motion,
    Ratio,
    distance_ratio,
    driven_mass,
    usual_acceleration,
)
from trainlog.railway.train import Train
from trainlog.units import factor

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
    acceleration: float
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
        speed = np.abs(motion.derivative(question.position))
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
        driven = driven_mass(motion, question.effort, np.abs(speed))
    measured = _Measured(
        float(np.percentile(known, 99.5)) if known.size else np.nan,
        usual_acceleration(motion, speed),
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
    cost += _implausible(metres * measured.fastest, metres * measured.acceleration)
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


def _implausible(fastest: float, acceleration: float) -> float:
    """Cost of a highest speed [m/s] and a usual strongest acceleration [m/s²]."""
    cost = 0.0
    for bound, charge in ((3.0, 3.0), (9.0, 1.0), (15.0, 0.4)):
        cost += charge * (fastest < bound)
    for bound, charge in ((75.0, 0.7), (100.0, 3.0), (130.0, 5.0)):
        cost += charge * (fastest > bound)
    for bound, charge in ((0.04, 1.0), (0.2, 0.4)):
        cost += charge * (acceleration < bound)
    for bound, charge in ((1.5, 1.2), (2.0, 2.5), (3.0, 3.0)):
        cost += charge * (acceleration > bound)
    return cost
