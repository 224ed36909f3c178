"""Motion in recorded columns: how far and how fast each says that the train moves.

Every rule that asks whether a column goes with the motion asks it here: the names of the columns,
from which speed on a train stands or moves, the integral of a speed, the fixes in a plane, which
values repeat, the ratio of two columns and how far they usually depart from it, which mass an
effort moves.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from estimators.receiver import integral, pairs_at, series_of
from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray, robust_std
from trainlog.declaration import form_for
from trainlog.ingest.recording import METRES_PER_DEGREE, MOST, Finding, Table
from trainlog.railway.resistance import basis
from trainlog.railway.train import Train
from trainlog.spans import runs_of
from trainlog.trip import Trip, seconds
from trainlog.units import KMH, NANOSECONDS

POSITION, SPEED, GNSS_SPEED = "/train/state.position", "/train/state.speed", "/gnss/motion.speed"
LATITUDE, LONGITUDE = "/gnss/fix.latitude", "/gnss/fix.longitude"
ACCURACY = "/gnss/fix.horizontal_accuracy"
WHEEL_SPEED = "/train/axles.wheel_speed"
EFFORTS = tuple(
    f"/train/controls.{kind}_effort"
    for kind in ("tractive", "dynamic_braking", "pneumatic_braking")
)

STANDING = 0.3
"""Speed [m/s] up to which a train may stand: what sensors of speed show at rest."""

MOVING = 1.0
"""Speed [m/s] from which on a train moves, and ratios of columns mean something: receivers show as
much at rest, and hold a position that stands."""

SPAN, RESTING, CHORD = 5.0, 10.0, 20.0
"""Time [s] over which speeds and accelerations are compared, for which a value repeats that may be
frozen, and between two fixes whose distance is compared with the distance driven."""

SEVERAL, ENOUGH, MANY = 5, 10, 50
"""Samples in a row that are no accident; from which on their median, and how they spread, are
known; from which on what they have in common is."""

ELSEWHERE, STAYED, SHORTEST, FAR = 30.0, 50.0, 300.0, 500.0
"""Distance [m] from which on two places are not the same one; within which a train that never moves
stays; of the shortest way that is a trip, or shows a route; which no error explains, so that line,
unit or direction are wrong."""

STEEPEST = 1.5
"""No train on wheels gains or loses speed faster than this [m/s²]; slipping wheels do."""


ALIKE, SUSPECT = 0.1, 1.15
"""Relative difference up to which two columns say the same; their ratio from which on a unit is
suspected."""

GATE, HOLD = 4.5, 2.5
"""What departs by more than `GATE` standard deviations is off; so are its neighbours, one after the
other, down to `HOLD`."""

LIKELY, SURE = 6.0, 10.0
"""Differences of log-likelihoods from which on the likelier is taken, or is taken to be certain."""

MARGIN = 1.5
"""How many times as fast, or as hard, as is recorded or allowed a train may move, or start and
brake."""

INLIER, HOLDS = 0.3, 0.6
"""Deviation from the median ratio of two columns, as a share of it, up to which a sample has this
ratio; share of the samples from which on the columns do."""

STRAIGHT = 0.97
"""Share of the way by the fix between two fixes that their distance is where they show the distance
driven."""

DRIVES = 0.5
"""Correlation with the acceleration from which on an effort shows the mass that it moves."""

BRAKES = 8.0
"""Standard deviations of a brake's share from which on it shows the mass that it moves."""

ACTS, COASTS = 0.05, 0.1
"""Share of the largest effort from which on it acts; a train that coasts changes its speed by less
than this [m/s²]."""

WRONG_UNIT = 1000.0**0.5
"""A mass off by more than this is nearer to one of N taken for kN than to the right one."""

FIX_STD, SPEED_STD = 5.0, 0.5
"""Standard deviation of a fix in each direction [m], and of a satellite speed [m/s], where the
receiver states none."""

SMALLEST_NOISE = 0.3, 0.02
"""Standard deviations that nothing undercuts, whatever it states: of a position [m], of a speed
[m/s]."""


LEG, TURN = 15.0, np.radians(60.0)
"""Ways [m] along the fixes between which no track turns by more than the angle: trams' bends have
15 m radius and more."""

FOLLOWED, FOLDED = 0.7, 0.5
"""Fixes show a turn where they move from one to the next, closer than a leg, by this share of the
way; less than the other share of a leg between its ends is a fold, by which errors of fixes are
known from turns."""

HARSH = 4.0
"""Acceleration over a second [m/s²] that no train reaches."""

OFTEN_TURNED, OFTEN_HARSH = 0.04, 0.1
"""Share of the places with such turns, and of the moving seconds with such accelerations, from
which on a recording is not of a train's motion."""

LEAST_SHOWN = 0.2
"""Share of the way on which turns must be shown: at its full speed a train shows none."""


def seconds_of(table: Table) -> FloatArray:
    """Time of each row since the first [s]."""
    return np.asarray((table.time - table.time[0]) / NANOSECONDS)


def speed_of(table: Table, *names: str) -> FloatArray | None:
    """The first of some speeds (the train's, then its receiver's) that is recorded, without sign.

    Examples
    --------
    >>> table = Table(np.arange(2), np.arange(2), {GNSS_SPEED: np.array([3.0, np.nan])})
    >>> speed_of(table)
    array([ 3., nan])
    """
    for name in names or (SPEED, GNSS_SPEED):
        values = table.signals.get(name)
        if values is not None and np.isfinite(values).any():
            return np.abs(values)
    return None


def plane(table: Table) -> ComplexArray | None:
    """Satellite positions in a plane, north + i east [m], NaN where absent; None without any."""
    latitude, longitude = table.signals.get(LATITUDE), table.signals.get(LONGITUDE)
    if latitude is None or longitude is None:
        return None
    fixed = np.isfinite(latitude) & np.isfinite(longitude)
    if not fixed.any():
        return None
    scale = METRES_PER_DEGREE * np.cos(np.radians(float(np.median(latitude[fixed]))))
    places = METRES_PER_DEGREE * latitude + 1j * scale * longitude
    return np.where(fixed, places, np.nan)


def fix_std(table: Table, points: ComplexArray) -> float:
    """Standard deviation of a fix on each axis [m], as the receiver usually states it."""
    accuracy = table.signals.get(ACCURACY, np.full(points.size, np.nan))
    stated = accuracy[np.isfinite(points) & (accuracy > 0.0)]
    return float(np.median(stated)) if stated.size else FIX_STD


def unlike_a_train(tables: Sequence[Table]) -> str:
    """Why a recording does not show a train's motion, in words; empty if it may.

    It never moves, or most of its fixes lie on bends of some metres, or it often accelerates as
    no train does. Recordings without any column of motion are not judged.

    Examples
    --------
    >>> second = np.arange(600)
    >>> still = Table(second * NANOSECONDS, second, {SPEED: np.full(600, 0.1)})
    >>> unlike_a_train([still])
    'the train never moves: 0.4 km/h at most in 599 s'
    >>> run = Table(second * NANOSECONDS, second, {SPEED: np.minimum(0.5 * second, 20.0)})
    >>> unlike_a_train([run])
    ''
    """
    moved = [words for table in tables if len(table) > ENOUGH for words in _moved(table)]
    if moved and all(moved):
        longest = max(float(seconds_of(table)[-1]) for table in tables if len(table))
        return f"the train never moves: {', '.join(dict.fromkeys(moved))} in {longest:.0f} s"
    found = [words for table in tables if len(table) > ENOUGH for words in _not_of_rail(table)]
    return f"not a train's motion: {', '.join(dict.fromkeys(found))}" if found else ""


def _moved(table: Table) -> Iterator[str]:
    """Of each column of motion how little it moves, in words; empty if it moves."""
    speed, fixes = speed_of(table), plane(table)
    position = table.signals.get(POSITION)
    if speed is not None:
        most = float(np.nanpercentile(speed, 99.0))
        yield f"{KMH * most:.1f} km/h at most" if most < MOVING else ""
    for words, places in (("distance", position), ("fixes", fixes)):
        known = np.zeros(0) if places is None else places[np.isfinite(places)]
        if known.size > 0:
            middle = np.median(known.real) + 1j * np.median(known.imag)
            away = float(np.percentile(np.abs(known - middle), 99.0))
            yield f"{words} within {away:.0f} m" if away < STAYED else ""


def _not_of_rail(table: Table) -> Iterator[str]:
    """What of a table's motion no train shows."""
    time, speed, fixes = seconds_of(table), speed_of(table), plane(table)
    if speed is None:
        return
    known = np.flatnonzero(np.isfinite(speed))
    blocks = series_of(time[known], speed[known], 1.0)
    first, second = pairs_at(blocks.seconds, 1.0)
    if first.size >= ENOUGH:
        change = np.abs(blocks.values[second] - blocks.values[first])
        rate = change / (blocks.seconds[second] - blocks.seconds[first])
        moving = np.maximum(blocks.values[second], blocks.values[first]) > MOVING
        harsh = moving & (rate > HARSH)
        share = float(harsh.sum()) / max(float(moving.sum()), ENOUGH)
        if share > OFTEN_HARSH:
            yield (
                f"accelerates by more than {HARSH:g} m/s² in {share:.0%} of the seconds in motion,"
                f" up to {rate.max():.0f} m/s²"
            )
    if fixes is None:
        return
    # What stands shows noise.
    path = integral(time, np.where(speed < MOVING, 0.0, speed))[0]
    fixed = series_of(path, np.where(np.isfinite(path), fixes, np.nan), 2.0)
    way, points = fixed.seconds, fixed.values
    if way.size < ENOUGH:
        return
    at = np.arange(way[0] + LEG, way[-1] - LEG, LEG / 3.0)
    before, here, after = (np.interp(at + by, way, points) for by in (-LEG, 0.0, LEG))
    one, other = here - before, after - here
    shortest = np.minimum(np.abs(one), np.abs(other))
    # Fixes that are held, or late, move less from one to the next, too.
    steps = np.diff(way, prepend=way[0])
    strides = np.minimum(np.abs(np.diff(points, prepend=points[0])), steps)
    followed = np.cumsum(np.where(steps < LEG, strides, 0.0))
    shown = np.interp(at + LEG, way, followed) - np.interp(at - LEG, way, followed)
    shown = shown > FOLLOWED * 2.0 * LEG
    folded = shown & (shortest < FOLDED * LEG)
    turned = shown & ~folded & (np.abs(np.angle(other * np.conj(one))) > TURN)
    places, turns, folds = (np.count_nonzero(each) for each in (shown, turned, folded))
    if places < max(LEAST_SHOWN * at.size, ENOUGH):
        return
    if turns - folds > OFTEN_TURNED * places or folds > MOST * places:
        yield (
            f"turns by more than {np.degrees(TURN):.0f}° within {2.0 * LEG:.0f} m at"
            f" {(turns + folds) / places:.0%} of its way: bends of a few metres"
        )


class Agreement(NamedTuple):
    """How one column goes with another: their median ratio, and what is left of it.

    Attributes
    ----------
    ratio : float
    std : float
        Robust standard deviation of the first less the ratio times the other.
    share : float
        Part of the samples that have this ratio, to 30 per cent.
    """

    ratio: float
    std: float
    share: float = 1.0

    @property
    def holds(self) -> bool:
        """Whether most samples have this ratio, as those in two units do."""
        return self.share >= HOLDS


def agreement(one: FloatArray, other: FloatArray, moving: BoolArray) -> Agreement | None:
    """The ratio of two columns over samples in which the train moves; None of fewer than `ENOUGH`.

    Parameters
    ----------
    one, other : (n,) array
        In the same unit; NaN where absent.
    moving : (n,) bool array

    Examples
    --------
    >>> speed = np.linspace(3.0, 20.0, 50)
    >>> found = agreement(1.944 * speed, speed, speed > MOVING)
    >>> round(found.ratio, 3), found.holds
    (1.944, True)
    """
    both = moving & np.isfinite(one) & np.isfinite(other)
    if np.count_nonzero(both) < ENOUGH:
        return None
    each = one[both] / other[both]
    ratio = float(np.median(each))
    share = float(np.mean(np.abs(each - ratio) <= INLIER * abs(ratio)))
    return Agreement(ratio, robust_std(one[both] - ratio * other[both]), share)


def rate_of(seconds: FloatArray, values: FloatArray) -> FloatArray:
    """The rate of change of a column over five seconds; NaN without two values."""
    known = np.isfinite(values)
    if np.count_nonzero(known) < 2:
        return np.full(values.size, np.nan)
    after, before = (
        np.interp(seconds + by, seconds[known], values[known]) for by in (0.5 * SPAN, -0.5 * SPAN)
    )
    return np.asarray((after - before) / SPAN)


class DrivenMass(NamedTuple):
    """How an effort goes with the acceleration that follows from it.

    Attributes
    ----------
    mass : float
        Slope of the effort over acceleration, running resistance left free; [kg] where the effort
        is in newtons. NaN if the train does not move, or accelerate.
    correlation : float
        Of effort and acceleration.
    seconds : float [s]
        In motion that are used, of each sample at most one.
    alone : bool
        Whether the effort has one sign only, so that something else acts besides: then only
        seconds in which it acts, or the train coasts, are used.
    """

    mass: float
    correlation: float
    seconds: float
    alone: bool = False

    @property
    def decides(self) -> bool:
        """Whether the effort clearly moves the train."""
        return self.seconds >= MANY and abs(self.correlation) >= DRIVES


def driven_mass(seconds: FloatArray, effort: FloatArray, speed: FloatArray) -> DrivenMass:
    """The mass that an effort moves: F = m a + R(v), by least squares.

    A traction without the braking is that of the seconds in which it acts, or the train coasts.

    Parameters
    ----------
    seconds : (n,) array [s]
    effort : (n,) array
        In any unit, NaN where absent.
    speed : (n,) array [m/s]

    Examples
    --------
    >>> time = np.arange(0.0, 200.0)
    >>> speed = 10.0 + 8.0 * np.sin(time / 20.0)
    >>> found = driven_mass(time, 60e3 * np.cos(time / 20.0), speed)
    >>> round(found.mass / 1e3), round(found.correlation, 2)
    (152, 1.0)
    """
    rate = rate_of(seconds, speed)
    known = np.isfinite(effort) & np.isfinite(speed) & np.isfinite(rate) & (speed > MOVING)
    size = np.abs(effort[known])
    acts = size > ACTS * np.max(size, initial=0.0)
    alone = np.unique(np.sign(effort[known][acts])).size == 1
    if alone:
        known[known] = acts | (np.abs(rate[known]) < COASTS)
    lasted = float(np.sum(np.minimum(np.diff(seconds, append=seconds[-1]), 1.0)[known]))
    force, rate, v = effort[known], rate[known], speed[known]
    if lasted < MANY or np.std(force) == 0.0 or np.std(rate) < 0.02:
        return DrivenMass(np.nan, 0.0, lasted, alone)
    columns = np.column_stack([rate, basis(v)])
    scale = np.max(np.abs(columns), axis=0)
    solution = np.linalg.lstsq(columns / scale, force, rcond=None)[0]
    correlation = float(np.corrcoef(force, rate)[0, 1])
    return DrivenMass(float(solution[0] / scale[0]), correlation, lasted, alone)


def braked_masses(
    seconds: FloatArray, efforts: Sequence[FloatArray], speed: FloatArray, mass: float
) -> list[float]:
    """The mass [kg] that each brake moves, beside traction and the other; NaN if none is shown.

    By least squares of T - m a = R(v) + k1 B1 + k2 B2: the mass that a brake moves is m / k.

    Parameters
    ----------
    seconds : (n,) array [s]
    efforts : sequence of (n,) array
        Traction and two brakes, in any units, NaN where absent.
    speed : (n,) array [m/s]
    mass : float [kg]
        Of the train.
    """
    rate, (traction, *brakes) = rate_of(seconds, speed), map(np.nan_to_num, efforts)
    known = np.isfinite(speed) & np.isfinite(rate) & (speed > MOVING)
    columns = np.column_stack([*brakes, basis(speed)])[known]
    largest = np.max(np.abs(columns), axis=0, initial=0.0)
    scale = np.where(largest > 0.0, largest, 1.0)
    left = (traction - mass * rate)[known]
    solution = np.linalg.lstsq(columns / scale, left, rcond=None)[0]
    rest = left - columns / scale @ solution
    spread = np.diag(np.linalg.pinv((columns / scale).T @ (columns / scale))) * (
        rest @ rest / max(rest.size, 1)
    )
    # A brake that never acts shows nothing.
    sure = (np.abs(solution) > BRAKES * np.sqrt(np.abs(spread))) & (largest > 0.0)
    shown = np.divide(mass * scale, solution, out=np.full(scale.size, np.nan), where=sure)
    return [float(each) for each in shown[: len(brakes)]]


def suspect_efforts(trip: Trip, train: Train | None = None) -> Iterator[Finding]:
    """Efforts that cannot explain the motion by a factor that a wrong unit has.

    Parameters
    ----------
    trip : Trip
        Without ``/train/state`` or ``/train/controls``, or samples in both, nothing is found.
    train : Train, optional
        Without it any mass that a train can have explains them.
    """
    if not {"/train/state", "/train/controls"} <= trip.topics.keys():
        return
    state, controls = trip["/train/state"], trip["/train/controls"]
    if state.empty or controls.empty:
        return
    time = seconds(controls, pd.DatetimeIndex(state.index)[0])
    speed = np.interp(time, seconds(state), state["speed"].to_numpy(np.float64))
    form = form_for(Train, "mass")
    efforts = [controls[name.rpartition(".")[2]].to_numpy(np.float64) for name in EFFORTS]
    driven = driven_mass(time, efforts[0], np.abs(speed))
    masses = [driven.mass if driven.decides else np.nan]
    # A brake alone may be a small part of what brakes: only the train's own mass judges it.
    if train is not None:
        masses += braked_masses(time, efforts, np.abs(speed), train.mass)
    for name, effort, mass in zip(EFFORTS, efforts, masses, strict=False):
        if not mass > 0.0:
            continue
        if train is not None:
            factor = mass / train.mass
            wrong = not 1.0 / WRONG_UNIT <= factor <= WRONG_UNIT
            expected = f"the train's file has {form.words(train.mass)}"
        else:
            problem = next(form.implausible(mass, ""), None)
            wrong, factor = problem is not None, mass / form.usual
            expected = "" if problem is None else problem.problem.partition(": ")[2]
        if wrong:
            unit = "kN" if factor < 1.0 else "N"
            note = (
                f"up to {np.nanmax(effort) / 1e3:.3g} kN would move {mass / 1e3:.3g} t as fast,"
                f" {expected}: declare unit {unit} for its column in the profile"
            )
            yield Finding("unit_suspected", 1, (), name, note)


def scale_of(seconds: FloatArray, points: ComplexArray, speed: FloatArray) -> float:
    """Distance by a speed over that between fixes, over 20 s; NaN if unknown, or no one factor.

    Parameters
    ----------
    seconds, speed : (n,) array [s], [m/s]
    points : (n,) complex array [m]
        Fixes in a plane, NaN where absent.

    Examples
    --------
    >>> time = np.arange(0.0, 300.0)
    >>> scale_of(time, 20.0 * time + 0j, np.full(300, 38.9)).__round__(2)
    1.94
    """
    fixes = series_of(seconds, points)
    driven, missing = (np.interp(fixes.seconds, seconds, each) for each in integral(seconds, speed))
    first, second = pairs_at(fixes.seconds, CHORD)
    chord = np.abs(fixes.values[second] - fixes.values[first])
    by_speed = driven[second] - driven[first]
    whole = np.abs(missing[second] - missing[first]) < 1e-6
    # What turns goes further than its chord.
    middle = np.searchsorted(fixes.seconds, 0.5 * (fixes.seconds[first] + fixes.seconds[second]))
    halves = fixes.values[[first, middle, second]]
    whole &= chord > STRAIGHT * np.abs(np.diff(halves, axis=0)).sum(axis=0)
    moving = np.minimum(chord, by_speed) > CHORD * MOVING
    found = agreement(by_speed, chord, whole & moving)
    return found.ratio if found is not None and found.holds else np.nan


class Repeats(NamedTuple):
    """Stretches in which a column repeats one value, of one sample or more; (k,) arrays.

    Attributes
    ----------
    known : (n,) int array
        Samples that have a value.
    first, last : int arrays
        Numbers among the known samples.
    """

    known: IntArray
    first: IntArray
    last: IntArray

    @property
    def samples(self) -> IntArray:
        """How many samples each has."""
        return self.last - self.first + 1


def repeats(values: FloatArray | ComplexArray, breaks: IntArray | None = None) -> Repeats:
    """The stretches in which a column repeats one value.

    Parameters
    ----------
    values : (n,) array
        NaN where absent; absent values take no part.
    breaks : int array, optional
        Numbers among the known samples behind which a stretch ends besides.

    Examples
    --------
    >>> found = repeats(np.array([1.0, 1.0, np.nan, 2.0]))
    >>> found.first, found.last
    (array([0, 2]), array([1, 2]))
    """
    known = np.flatnonzero(np.isfinite(values))
    column = values if known.size == values.size else values[known]
    ends = np.flatnonzero(column[1:] != column[:-1])
    if breaks is not None and breaks.size:
        ends = np.union1d(ends, breaks)
    last = np.append(ends, known.size - 1) if known.size else ends
    return Repeats(known, np.concatenate(([0], ends + 1))[: last.size], last)


def covered(first: IntArray, beyond: IntArray, size: int) -> BoolArray:
    """Which of `size` samples lie in any of some stretches, each from `first` to before `beyond`.

    Examples
    --------
    >>> covered(np.array([1]), np.array([3]), 4)
    array([False,  True,  True, False])
    """
    change = np.zeros(size + 1, dtype=np.int64)
    np.add.at(change, np.clip(first, 0, size), 1)
    np.add.at(change, np.clip(beyond, 0, size), -1)
    return np.asarray(np.cumsum(change)[:size] > 0)


def held(
    departure: FloatArray, seconds: FloatArray, gate: float = GATE, hold: float = HOLD
) -> BoolArray:
    """Samples of runs above `hold` that somewhere exceed `gate`: a switch with hysteresis.

    Parameters
    ----------
    departure : (n,) array
        In standard deviations; NaN where absent.
    seconds : (n,) array [s]
    gate, hold : float

    Returns
    -------
    (n,) bool array
    """
    known = np.flatnonzero(np.isfinite(seconds) & ~np.isnan(departure))
    part = departure[known]
    first, beyond = np.array(runs_of(part > hold), dtype=np.int64).reshape(-1, 2).T
    off = np.zeros(departure.size, dtype=np.bool_)
    if first.size:
        # What lies between the runs is below both.
        far = np.maximum.reduceat(part, first) > gate
        off[known] = covered(first[far], beyond[far], known.size)
    return off
