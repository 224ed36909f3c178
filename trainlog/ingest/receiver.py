"""Satellite fixes, satellite speeds and wheel speeds of a trip, and what of them is no measurement.

Fixes that a receiver holds or computes, speeds that it repeats or that come late, wheels that slip:
each is found by what only it does. A held fix repeats to its last digit while the train moves,
computed ones advance by one and the same step, the integral of a wrong speed runs away from the
positions. Positions are absolute and speeds are not, so that where both are steady it is the speed
that is set aside; a step of the positions alone, with speeds that go on, is the positions' fault.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from numba import njit

from estimators.matching import LONGEST_LINK
from estimators.receiver import (
    DELAY_TURNS,
    Delay,
    WheelSpeeds,
    integral,
    mean_square,
    pairs_at,
    series_of,
)
from estimators.receiver_states import SPACING, Lateness, lateness, receiver_states
from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray, numbered, robust_std
from trainlog.ingest.clock import Result
from trainlog.ingest.motion import (
    ALIKE,
    CHORD,
    ELSEWHERE,
    ENOUGH,
    FIX_STD,
    GATE,
    GNSS_SPEED,
    LATITUDE,
    LONGITUDE,
    MANY,
    MOVING,
    RESTING,
    SEVERAL,
    SMALLEST_NOISE,
    SPAN,
    SPEED,
    SPEED_STD,
    STANDING,
    STEEPEST,
    agreement,
    covered,
    fix_std,
    held,
    plane,
    repeats,
    seconds_of,
    speed_of,
)
from trainlog.ingest.recording import NEARLY_ALL, Finding, Table
from trainlog.spans import runs_of
from trainlog.trip import Trip
from trainlog.units import NANOSECONDS

ODOMETER_STD = 0.1
"""Standard deviation of the speed from the wheels [m/s]."""

EVEN, ROUNDING = 0.02, 0.03
"""Part of the usual change of a step that is still the same step, and the change [m] that comes of
fixes rounded to 1e-7 degrees."""

LEAST_RETURN = 4.0
"""Step [m] with which extrapolated fixes return to the track; a smaller one does no harm."""

WINDOWS = SPAN, RESTING, CHORD, 80.0
"""Spans over which positions and the integral of the speed are compared [s]."""

LEAST_CHORD = 0.7
"""Within `RESTING` no train, nor tram, turns so sharply that the distance between its fixes is less
than this part of that along the track."""

LOSS_DENSITY = 1.6
"""Spectral density of a train's acceleration [m²/s³]: how unsure an unmeasured speed becomes."""

OLDEST, REPLAYED = 12.0, 3
"""Age [s] up to which fixes may be late throughout, and from which on they are old ones; age from
which on a fix of a receiver that is not late throughout is an old one."""

CORNER_STDS = 10.0
"""Least distance [m], and in standard deviations of a fix, between the corners of the path of the
fixes: closer ones follow its errors."""

LONGEST_STEP = 3.0
"""Usual steps between fixes that are no outage."""

LEAST_DELAY = 0.05
"""A smaller delay [s] is not corrected."""

SIGNIFICANT, NOTHING = 3.0, 2.0
"""A delay of fewer standard deviations is not corrected; a speed, or a difference, of fewer may be
none."""


@dataclass(frozen=True, eq=False)
class Fixes:
    """Satellite fixes and speeds on one clock; all (n,) arrays, NaN where absent.

    Attributes
    ----------
    index : DatetimeIndex
    seconds : array [s]
        Since the first row.
    latitude, longitude : array [deg]
    std : array [m]
        Of each horizontal axis.
    speed, speed_std : array [m/s]
    wheel_speed, wheel_speed_std : array [m/s] or None
    row_time : float [s]
        Between the rows of a table that held each fix for several rows, of which the first is
        kept: it may be late by as much. 0 where fixes were not held.
    """

    index: pd.DatetimeIndex
    seconds: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    std: FloatArray
    speed: FloatArray
    speed_std: FloatArray
    wheel_speed: FloatArray | None = None
    wheel_speed_std: FloatArray | None = None
    row_time: float = 0.0

    @property
    def wheels(self) -> WheelSpeeds:
        """The wheels' speeds where they are known."""
        speed = np.full(self.seconds.size, np.nan) if self.wheel_speed is None else self.wheel_speed
        known = np.isfinite(speed)
        return WheelSpeeds(self.seconds[known], speed[known])

    def with_late_wheels(self, delay: float) -> Fixes:
        """The same with wheels as late as the satellites [s]: all on the satellites' clock."""
        if self.wheel_speed is None:
            return self
        late = self.wheels.at(self.seconds - delay)
        return replace(self, wheel_speed=np.where(np.isfinite(self.wheel_speed), late, np.nan))

    @property
    def any_speed(self) -> FloatArray:
        """The satellite speed, else the wheels' [m/s]; NaN without either."""
        if self.wheel_speed is None:
            return self.speed
        return np.where(np.isfinite(self.speed), self.speed, self.wheel_speed)


def count_placed(trip: Trip) -> int:
    """How many of a trip's fixes have a place: both coordinates."""
    if "/gnss/fix" not in trip:
        return 0
    return int(trip["/gnss/fix"][["latitude", "longitude"]].notna().all(axis=1).sum())


def fixes_of(trip: Trip) -> Fixes:
    """Fixes, satellite speeds and wheel speeds of a trip on one clock, rows in its outages too.

    Parameters
    ----------
    trip : Trip
        With ``/gnss/fix``.

    Examples
    --------
    >>> from trainlog.ingest import ingest
    >>> fixes = fixes_of(ingest("sample_logs/gnss.csv"))
    >>> fixes.seconds.size >= 6847
    True
    """
    frame = trip["/gnss/fix"]
    if "/gnss/motion" in trip:
        frame = frame.join(trip["/gnss/motion"], how="outer")
    frame, row_time = _first_of_held(frame)
    index = pd.DatetimeIndex(frame.index)
    wheels = None
    if "/train/state" in trip:
        wheels = trip["/train/state"]["speed"].loc[index[0] : index[-1]]
        wheels = wheels if wheels.count() > 1 else None
    if wheels is not None:
        index = index.union(pd.DatetimeIndex(wheels.index))
    index = _with_outages(index)
    frame = frame.reindex(index)
    absent = np.full(len(frame), np.nan)
    columns = {name: frame[name].to_numpy(np.float64) for name in frame.columns}
    half = np.isnan(columns["latitude"] + columns["longitude"])
    accuracy = columns["horizontal_accuracy"]
    stated = columns.get("speed_accuracy", absent)
    speed_std = np.maximum(np.where(stated > 0.0, stated, SPEED_STD), SMALLEST_NOISE[1])
    speed = columns.get("speed", absent)
    usual = pd.Series(speed, index).rolling(f"{SPAN:g}s", center=True).median().to_numpy()
    # The size of a speed never averages to 0: the train is taken to stand.
    stands = (np.minimum(speed, usual) < NOTHING * speed_std) & (speed < GATE * speed_std)
    turning = None
    if wheels is not None:
        turning = np.asarray(wheels.reindex(index), dtype=np.float64)
    return Fixes(
        index=index,
        seconds=np.asarray((index.asi8 - index.asi8[0]) / NANOSECONDS),
        latitude=np.where(half, np.nan, columns["latitude"]),
        longitude=np.where(half, np.nan, columns["longitude"]),
        std=np.where(accuracy > 0.0, accuracy, FIX_STD),
        speed=np.where(stands, 0.0, speed),
        speed_std=speed_std,
        wheel_speed=turning,
        wheel_speed_std=None if turning is None else np.full(turning.size, ODOMETER_STD),
        row_time=row_time,
    )


def _first_of_held(frame: pd.DataFrame) -> tuple[pd.DataFrame, float]:
    """Fixes and speeds without those that only repeat the fix before; the time between rows [s]."""
    time = pd.DatetimeIndex(frame.index).asi8
    coordinates = [frame[name].to_numpy(np.float64) for name in ("latitude", "longitude")]
    repeated, row_time = held_fixes(np.asarray((time - time[0]) / NANOSECONDS), *coordinates)
    if not repeated.any():
        return frame, 0.0
    frame = frame.copy()
    if "speed" in frame:
        again = frame["speed"].to_numpy() == frame["speed"].shift().to_numpy()
        frame.loc[repeated & again, "speed"] = np.nan
    frame.loc[repeated, ["latitude", "longitude"]] = np.nan
    return frame, row_time


def _with_outages(index: pd.DatetimeIndex) -> pd.DatetimeIndex:
    """The times, and further ones in the gaps between them, a usual step and at most 1 s apart."""
    time = index.as_unit("ns").asi8
    steps = np.diff(time)
    usual = min(int(np.median(steps)), NANOSECONDS)
    lost = np.flatnonzero((steps > 2 * usual) & (steps <= LONGEST_LINK * NANOSECONDS))
    count = -(-steps[lost] // usual)
    gap, number = numbered(count)
    extra = time[lost][gap] + (number * (steps[lost] / count)[gap]).astype(np.int64)
    return pd.DatetimeIndex(np.union1d(time, extra), tz="UTC", name=index.name)


# ------------------------------------------------------------------ held and computed values


def held_fixes(
    seconds: FloatArray, latitude: FloatArray, longitude: FloatArray
) -> tuple[BoolArray, float]:
    """Fixes that a table with more rows than the receiver had fixes repeats, and its row time [s].

    None, and 0 s, unless most fixes are held equally long. What is held longer, as at a standstill,
    is left.

    Examples
    --------
    >>> import numpy as np
    >>> fix = np.repeat(np.arange(40.0), 5)
    >>> repeated, row = held_fixes(np.arange(200) / 5.0, fix, fix)
    >>> np.flatnonzero(repeated)[:5], row
    (array([ 6,  7,  8,  9, 11]), 0.2)
    """
    flags = np.zeros(seconds.size, dtype=np.bool_)
    found = repeats(latitude + 1j * longitude)
    time, begins = seconds[found.known], found.first[1:]
    lasted = np.diff(time[begins])
    if lasted.size < 2 * ENOUGH:
        return flags, 0.0
    row, usual = float(np.median(np.diff(time))), float(np.median(lasted))
    even = np.mean(np.abs(lasted - usual) < 1.1 * row)
    moved = [np.diff(each[found.known])[begins - 1] != 0.0 for each in (latitude, longitude)]
    if usual < 1.9 * row or min(even, np.mean(moved[0] & moved[1])) < NEARLY_ALL:
        return flags, 0.0
    short = np.flatnonzero(lasted < usual + 1.1 * row) + 1
    again = covered(found.first[short] + 1, found.last[short] + 1, found.known.size)
    flags[found.known] = again
    return flags, round(row, 6)


def hold_of(seconds: FloatArray, speed: FloatArray) -> float:
    """For how long a receiver repeats a speed while the train moves [s], on average; at least 1.

    Examples
    --------
    >>> import numpy as np
    >>> hold_of(np.arange(40.0), np.repeat(np.arange(20.0, 30.0), 4))
    3.9
    """
    moving = np.flatnonzero(speed > MOVING)
    if moving.size < SEVERAL:
        return 1.0
    steps = np.diff(seconds[moving])
    together = steps < 3.0 * float(np.median(steps))
    changes = np.count_nonzero(np.diff(speed[moving])[together])
    return max(float(steps[together].sum()) / float(changes + 1), 1.0)


def extrapolated(seconds: FloatArray, points: ComplexArray) -> BoolArray:
    """Fixes that advance by one and the same step: computed from earlier ones, not measured.

    Only where the fixes then step back to the track, or end: an even advance that goes on smoothly
    was a good one.

    Examples
    --------
    >>> import numpy as np
    >>> noise = np.random.default_rng(1).standard_normal(60)
    >>> points = 20.0 * np.arange(60) + 1j * noise
    >>> points[30:50] = points[30] + 18.0 * np.arange(20)
    >>> np.flatnonzero(extrapolated(np.arange(60.0), points))[[0, -1]]
    array([31, 49])
    """
    flags = np.zeros(points.size, dtype=np.bool_)
    known = np.flatnonzero(np.isfinite(points))
    if known.size < ENOUGH:
        return flags
    time, point = seconds[known], points[known]
    step = max(float(np.median(np.diff(time))), 0.0)
    ahead = max(round(1.0 / step), 1) if step > 0.0 else 1
    middle = np.arange(ahead, known.size - ahead)
    before, after = point[middle - ahead], point[middle + ahead]
    span = time[middle + ahead] - time[middle - ahead]
    share = (time[middle] - time[middle - ahead]) / span
    change = np.abs(point[middle] - before - share * (after - before))
    near = span < 3.0 * ahead * step
    moving = np.abs(after - before) / span > MOVING
    usual = float(np.median(change[near & moving])) if np.any(near & moving) else 0.0
    even = near & moving & (change < max(EVEN * usual, min(ROUNDING, 0.3 * usual)))
    least = max(RESTING, 2.0 * step)
    for first, beyond in runs_of(even):
        begin, end = middle[first], middle[beyond - 1]
        following = slice(beyond, beyond + ahead + 1)
        returns = bool(np.any(~near[following] | (change[following] > LEAST_RETURN)))
        if returns and end > begin and time[end] - time[begin] + 2.0 * ahead * step >= least:
            flags[known[begin : end + ahead + 1]] = True
    return flags


def kept_on(seconds: FloatArray, points: ComplexArray, std: FloatArray) -> BoolArray:
    """Fixes that a receiver repeats to the last digit while the train moves on.

    It does where the next other fix lies further away than a train that stood could be.

    Examples
    --------
    >>> import numpy as np
    >>> points = 20.0 * np.arange(60.0) + 0j
    >>> points[20:35] = points[20]
    >>> np.flatnonzero(kept_on(np.arange(60.0), points, np.full(60, 3.0)))[[0, -1]]
    array([21, 34])
    """
    flags = np.zeros(points.size, dtype=np.bool_)
    found = repeats(points)
    time, point, end = seconds[found.known], points[found.known], found.last[:-1]
    step = time[end + 1] - time[end]
    reach = 0.5 * STEEPEST * step**2 + GATE * np.sqrt(2.0) * std[found.known[end]]
    far = np.abs(point[end + 1] - point[end]) > reach
    flags[found.known] = covered(found.first[:-1][far] + 1, end[far] + 1, found.known.size)
    return flags


# ------------------------------------------------------------------ speeds against positions


def delay_behind(speeds: WheelSpeeds, seconds: FloatArray, along: FloatArray) -> float:
    """By how much speeds come later than positions [s]; 0 where that is not certain.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(0.0, 600.0)
    >>> speed = 12.0 + 10.0 * np.sin((time - 3.0) / 20.0)
    >>> along = 12.0 * time - 200.0 * np.cos(time / 20.0)
    >>> round(delay_behind(WheelSpeeds(time, speed), time, along), 1)
    3.0
    """
    delay = 0.0
    for _ in range(DELAY_TURNS):
        left = speeds.delay_left(seconds, along, -delay)
        if left is None or not -1.0 < delay - left.value < OLDEST:
            return 0.0
        delay -= left.value
        if abs(left.value) < 0.02:
            return delay if delay > max(LEAST_DELAY, SIGNIFICANT * left.std) else 0.0
    return 0.0


def contradicted(
    seconds: FloatArray, places: ComplexArray, speed: FloatArray, std: float
) -> BoolArray:
    """Speeds that are too low for the distance between their fixes, or far too high.

    Parameters
    ----------
    seconds : (n,) array [s]
    places : (n,) complex array [m]
        In a plane.
    speed : (n,) array [m/s]
    std : float [m]
        Of a position.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(0.0, 400.0)
    >>> speed = np.full(400, 20.0)
    >>> speed[100:200] = 12.0
    >>> found = np.flatnonzero(contradicted(time, 20.0 * time + 0j, speed, std=3.0))
    >>> bool(90 <= found[0] <= 105), bool(195 <= found[-1] <= 210)
    (True, True)
    """
    flags = np.zeros(seconds.size, dtype=np.bool_)
    driven, missing = integral(seconds, speed)
    fixes = series_of(seconds, places)
    if not np.isfinite(driven).all() or fixes.values.size < ENOUGH:
        return flags
    time = fixes.seconds
    along = np.interp(time, seconds, driven)
    absent = np.round(np.interp(time, seconds, missing), 6)
    known = np.isfinite(speed)
    pace = np.interp(time, seconds[known], speed[known])
    broken = np.cumsum(_breaks(time, fixes.values, along, std))
    bad = np.zeros(time.size, dtype=np.bool_)
    for window in WINDOWS:
        first, second = pairs_at(time, window)
        marked = np.cumsum(bad)
        whole = (absent[first] == absent[second]) & (broken[first] == broken[second])
        whole &= marked[first] == marked[second]
        first, second = first[whole], second[whole]
        by_speed = along[second] - along[first]
        moved = fixes.values[second] - fixes.values[first]
        chord = np.abs(moved)
        # As well as they usually agree over so long: what lasts is the same at both ends.
        driving = by_speed > MOVING * window
        usual = robust_std((chord - by_speed)[driving]) if driving.any() else std
        size = min(np.sqrt(2.0) * std, usual)
        noise = GATE * size + ALIKE * np.abs(by_speed)
        # Speeds may be a second late.
        noise += np.minimum(np.abs(pace[second] - pace[first]), STEEPEST * window)
        wrong = chord - by_speed > noise
        if window <= RESTING:
            wrong |= LEAST_CHORD * by_speed - chord > noise
        bad |= covered(first[wrong], second[wrong] + 1, time.size)
    if not bad.any():
        return flags
    inside = np.interp(seconds, time, bad) >= 0.5
    return np.asarray(inside & np.isfinite(speed))


def _breaks(time: FloatArray, places: ComplexArray, along: FloatArray, std: float) -> BoolArray:
    """Where the positions step while the speed goes on: before which value."""
    steps = np.diff(time, prepend=time[0] - 1.0)
    by_speed = np.diff(along, prepend=along[0])
    apart = np.abs(np.abs(np.diff(places, prepend=places[0])) - by_speed)
    close = steps < 3.0
    usual = robust_std(apart[close]) if close.any() else std
    far = close & (apart > max(GATE * usual, std))
    # A speed that is wrong is wrong step after step; a position steps once.
    first, beyond = np.array(runs_of(far), dtype=np.int64).reshape(-1, 2).T
    once = beyond - first <= 2
    return covered(first[once], beyond[once], time.size)


def judged_alone(table: Table) -> Result:
    """What fixes and a speed say of each other where no line is known.

    Old fixes are counted and stay; satellite speeds that the others contradict are taken away.
    """
    old, findings = old_fixes(table)
    others = table.without(LATITUDE, old).without(LONGITUDE, old) if old.any() else table
    wrong, contradictions = contradicted_speeds(others)
    kept = table.without(GNSS_SPEED, wrong) if wrong.any() else table
    return kept, [*contradictions, *findings]


def contradicted_speeds(table: Table) -> tuple[BoolArray, list[Finding]]:
    """Satellite speeds that the fixes contradict, where no line is known.

    Where they contradict each other, the way along the fixes, from the last one before to the first
    one after, decides: if it is as long as the speeds say, the receiver held or replayed its place,
    and they stay.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(0.0, 400.0)
    >>> speed = np.full(400, 20.0)
    >>> speed[100:200] = 3.0
    >>> signals = {
    ...     "/gnss/fix.latitude": np.full(400, 47.0),
    ...     "/gnss/fix.longitude": 9.0 + 20.0 * time / 75_800.0,
    ...     "/gnss/motion.speed": speed,
    ... }
    >>> table = Table((1e9 * time).astype(np.int64), np.arange(400), signals)
    >>> wrong, found = contradicted_speeds(table)
    >>> bool(abs(wrong.sum() - 100) < 15)
    True
    """
    none = np.zeros(len(table), dtype=np.bool_)
    points, speed = plane(table), table.signals.get(GNSS_SPEED)
    if points is None or speed is None:
        return none, []
    known = np.isfinite(points)
    if np.count_nonzero(known) < MANY or np.count_nonzero(np.isfinite(speed)) < 2:
        return none, []
    seconds = seconds_of(table)
    std = np.sqrt(2.0) * fix_std(table, points)
    doubtful = contradicted(seconds, points, speed, std)
    if not doubtful.any():
        return none, []
    driven, _ = integral(seconds, speed)
    fixes = series_of(seconds, points)
    way = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(fixes.values)))))
    wrong = np.zeros(speed.size, dtype=np.bool_)
    for first, beyond in runs_of(doubtful | ~np.isfinite(speed)):
        before, after = np.searchsorted(fixes.seconds, seconds[[first, beyond - 1]])
        ends = np.array([max(before - 1, 0), min(after, way.size - 1)])
        by_fixes = way[ends[1]] - way[ends[0]]
        by_speed = float(np.ptp(np.interp(fixes.seconds[ends], seconds, driven)))
        if abs(by_fixes - by_speed) > ALIKE * max(by_fixes, by_speed) + GATE * std:
            wrong[first:beyond] = True
    wrong &= doubtful
    return wrong, table.found("contradicted", wrong, GNSS_SPEED, "by the way along the fixes")


class Unmeasured(NamedTuple):
    """A speed at every row [m/s], and the variance of its integral where it was not measured."""

    pace: FloatArray
    unsure: FloatArray


def unmeasured(seconds: FloatArray, speed: FloatArray) -> Unmeasured:
    """A speed on a line between its samples, and how unsure its integral is by that [m²]."""
    time, measured = seconds[np.isfinite(speed)], speed[np.isfinite(speed)]
    # How unsteady this train's speed is between two that were measured.
    bend = mean_square(np.diff(measured, 2)) / (2.0 * np.median(np.diff(time, prepend=time[0])))
    lost = _lost(seconds, time, min(LOSS_DENSITY, 2.0 * bend))
    return Unmeasured(np.interp(seconds, time, measured), lost)


def _lost(seconds: FloatArray, time: FloatArray, density: float) -> FloatArray:
    """How unsure the integral of a speed is that was only measured at some times [m²]."""
    step = np.diff(time, prepend=time[0])
    # Beyond the ends the speed is known at one side only.
    outside = seconds - np.clip(seconds, time[0], time[-1])
    within = np.interp(seconds, time, np.cumsum(step**3 / 12.0))
    return np.asarray(density * (within + outside**3 / 3.0))


def late_throughout(
    seconds: FloatArray,
    along: FloatArray,
    driven: FloatArray,
    age: IntArray,
    std: FloatArray,
    speed: Unmeasured,
) -> Lateness | None:
    """By how much fixes are late throughout, at every row; None if they are not.

    Parameters
    ----------
    along, driven : (n,) array [m]
        Of the fixes, and the integral of the speed.
    age : (n,) array [s]
        Of each fix, if the receiver is not late throughout: one that is shows an age sooner or
        later.
    std : (n,) array [m]
    """
    short, moving = age <= OLDEST, np.isfinite(along) & (speed.pace > MOVING)
    aged = float(np.mean((short & (age > 0))[moving])) if moving.any() else 0.0
    seen = series_of(seconds, np.where(short, along - driven, np.nan), SPACING)
    parts = (np.interp(seen.seconds, seconds, each) for each in (*speed, std))
    late = lateness(seen.seconds, seen.values, *parts, evident=aged > 0.5)
    if late is None:
        return None
    return Lateness(*(np.interp(seconds, seen.seconds, each) for each in late))


def way_along(points: ComplexArray, std: float) -> FloatArray | None:
    """How far along their own path fixes lie [m], NaN where absent; None without a path.

    Examples
    --------
    >>> import numpy as np
    >>> way_along(np.array([0j, 40.0, np.nan, 60.0, 80.0, 80.0 + 40.0j]), 1.0)
    array([  0.,  40.,  nan,  60.,  80., 120.])
    """
    known = np.flatnonzero(np.isfinite(points))
    place, corners = points[known], [0]
    least = max(ELSEWHERE, CORNER_STDS * std)
    for number in range(1, known.size):
        if abs(place[number] - place[corners[-1]]) > least:
            corners.append(number)
    if len(corners) < 2:
        return None
    legs = np.diff(place[corners])
    length = np.abs(legs)
    way = np.concatenate(([0.0], np.cumsum(length)))
    leg = np.searchsorted(corners, np.arange(known.size), side="right") - 1
    leg = np.minimum(leg, legs.size - 1)
    from_corner = (place - place[corners][leg]) * np.conj(legs / length)[leg]
    found = np.full(points.size, np.nan)
    found[known] = way[leg] + from_corner.real
    return found


def old_fixes(table: Table) -> tuple[BoolArray, list[Finding]]:
    """Fixes that show where the train was earlier, by a speed and the way along the fixes alone.

    Replayed ones after an outage, until the receiver is at once where the train is; or all, of a
    receiver that is late throughout. Where no line is known they are counted, and stay.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(0.0, 900.0)
    >>> speed = 12.0 + 8.0 * np.sin(time / 40.0)
    >>> driven = 12.0 * time - 320.0 * np.cos(time / 40.0)
    >>> signals = {
    ...     "/gnss/fix.latitude": np.full(900, 47.0),
    ...     "/gnss/fix.longitude": 9.0 + np.interp(time - 5.0, time, driven) / 75_834.0,
    ...     "/gnss/motion.speed": speed,
    ... }
    >>> table = Table((1e9 * time).astype(np.int64), np.arange(900), signals)
    >>> [each.note for each in old_fixes(table)[1]]
    ['late by 5.2 s in the mean, by the speeds']
    """
    points, speed = plane(table), speed_of(table, GNSS_SPEED, SPEED)
    none = np.zeros(len(table), dtype=np.bool_)
    if points is None or speed is None:
        return none, []
    seconds, std = seconds_of(table), fix_std(table, points)
    along = way_along(points, std)
    driven, missing = integral(seconds, speed)
    fixed = np.flatnonzero(np.isfinite(points))
    if along is None or fixed.size < MANY or not np.isfinite(driven).all():
        return none, []
    if 2.0 * missing[-1] > seconds[-1]:
        # Where most of the speed is missing it says nothing of the fixes.
        return none, []
    measured, stds = unmeasured(seconds, speed), np.full(seconds.size, std)
    # The way through an outage is not known: it bends.
    apart, way = np.diff(seconds[fixed]), np.diff(driven[fixed])
    bent = np.zeros(seconds.size)
    bent[fixed[1:]] = np.where(apart > LONGEST_STEP * np.median(apart), way, 0.0) ** 2
    measured = Unmeasured(measured.pace, measured.unsure + np.cumsum(bent))
    found = receiver_states(seconds, along, stds, driven, measured.unsure)
    late = late_throughout(seconds, along, driven, found.age, stds, measured)
    if late is not None:
        known = np.isfinite(points)
        mean = np.mean(late.value[known & (measured.pace > MOVING)])
        note = f"late by {mean:.1f} s in the mean, by the speeds"
        return known, table.found("contradicted", known, "/gnss/fix", note)
    age = np.where(np.isfinite(points), found.age, np.nan)
    behind = driven - np.interp(seconds - found.age, seconds, driven)
    old = held(age, seconds, OLDEST, REPLAYED - 0.5) & (behind > GATE * std)
    note = f"replayed by the receiver, up to {found.age[old].max(initial=0)} s old by the speeds"
    return old, table.found("off_line", old, "/gnss/fix", note)


def common_delay(fixes: Fixes, chainage: FloatArray) -> Delay:
    """By how much fixes and satellite speeds together come later than the wheels' speed.

    The speeds give the delay, which the fixes must not contradict; 0 s where there is no wheel
    speed, where the fixes are not late, or where the delay is no larger than its standard deviation
    explains; NaN where the train changes its speed too little to show one. Of fixes held over
    rows, half the time between rows in place of what is not known.

    Parameters
    ----------
    fixes : Fixes
        Their speeds without those that are set aside.
    chainage : (n,) array [m]
        Of the fixes that fit, NaN for others.
    """
    none = Delay(0.0, 0.0)
    # A table whose rows hold fixes asks for them at any time after they came.
    row = fixes.row_time
    unknown = Delay(0.5 * row, row / np.sqrt(12.0)) if row else Delay(np.nan, np.nan)
    known = np.isfinite(fixes.speed)
    if fixes.wheel_speed is None or np.count_nonzero(known) < 2:
        return unknown if row else none
    wheels = fixes.wheels
    late = wheels.delay_of(fixes.seconds[known], fixes.speed[known])
    if late is not None and late.value > LEAST_DELAY:
        # Late wheels are no slipping ones, so that slip is only seen now.
        on_time = fixes.with_late_wheels(late.value)
        slips = slipping_wheels(on_time, fixes.speed, fixes.speed_std, wheel_ratio(on_time))
        turning = np.isfinite(fixes.wheel_speed)
        known &= np.interp(fixes.seconds, fixes.seconds[turning], slips[turning]) == 0.0
        late = wheels.delay_of(fixes.seconds[known], fixes.speed[known])
    if late is None:
        return unknown
    if late.value < max(LEAST_DELAY, SIGNIFICANT * late.std):
        return none
    left = wheels.delay_left(fixes.seconds, chainage, late.value)
    alone = left is not None and left.value < -max(0.5 * late.value, NOTHING * left.std)
    return none if alone else late


# ------------------------------------------------------------------ wheels


def wheel_ratio(fixes: Fixes) -> float:
    """Speed over the ground for a wheel speed of 1: the median where both are known, else 1."""
    if fixes.wheel_speed is None:
        return 1.0
    satellite = _bridged(fixes.seconds, fixes.speed)
    moving = (fixes.wheel_speed > MOVING) & (satellite > MOVING)
    found = agreement(satellite, fixes.wheel_speed, moving)
    return 1.0 if found is None else found.ratio


def slipping_wheels(
    fixes: Fixes, speed: FloatArray, speed_std: FloatArray, ratio: float
) -> BoolArray:
    """Wheel speeds away from a speed over the ground, or changing faster than a train can.

    Parameters
    ----------
    fixes : Fixes
    speed, speed_std : (n,) array [m/s]
        Over the ground, NaN where not known.
    ratio : float
        Speed over the ground for a wheel speed of 1.

    Returns
    -------
    (n,) bool array
    """
    if fixes.wheel_speed is None or fixes.wheel_speed_std is None:
        return np.zeros(fixes.seconds.size, dtype=np.bool_)
    apart = np.abs(fixes.wheel_speed * ratio - _bridged(fixes.seconds, speed))
    spread = np.hypot(fixes.wheel_speed_std, _bridged(fixes.seconds, speed_std))
    unit = np.maximum(spread, STANDING / GATE)
    slipping = held(apart / unit, fixes.seconds)
    known = np.flatnonzero(np.isfinite(fixes.wheel_speed))
    speeds, time = fixes.wheel_speed[known], fixes.seconds[known]
    back = np.ascontiguousarray(speeds[::-1])  # one layout, one compiled version
    spans = (_feasible(time, speeds), _feasible(-time[::-1], back)[::-1])
    unit = np.maximum(fixes.wheel_speed_std[known], STANDING / GATE)
    for feasible in spans:
        slipping[known] |= held(np.abs(speeds - feasible) / unit, time)
    # Between the rise and the fall of a slip the wheels turn at a steady speed.
    flagged = np.flatnonzero(slipping)
    short = np.diff(fixes.seconds[flagged]) < SPAN
    slipping |= covered(flagged[:-1][short], flagged[1:][short], slipping.size)
    return np.asarray(slipping & np.isfinite(fixes.wheel_speed))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _feasible(time: FloatArray, speed: FloatArray) -> FloatArray:
    """Speed that follows the given one no faster than a train can."""
    feasible = speed.copy()
    for i in range(1, speed.size):
        most = STEEPEST * (time[i] - time[i - 1])
        feasible[i] = min(max(speed[i], feasible[i - 1] - most), feasible[i - 1] + most)
    return feasible


def _bridged(seconds: FloatArray, values: FloatArray) -> FloatArray:
    """Values at every row, on a line between those at most 2 s apart; NaN elsewhere."""
    known = np.flatnonzero(np.isfinite(values))
    if not known.size:
        return np.full(seconds.size, np.nan)
    time = seconds[known]
    following = np.clip(np.searchsorted(time, seconds), 0, time.size - 1)
    preceding = np.maximum(np.searchsorted(time, seconds, side="right") - 1, 0)
    near = np.maximum(time[following] - seconds, seconds - time[preceding]) <= 2.0
    return np.where(near, np.interp(seconds, time, values[known]), np.nan)


class Driven(NamedTuple):
    """The distance driven by the measured speeds; (n,) arrays.

    Attributes
    ----------
    distance, variance : array [m], [m²]
        Since the first speed, negative before it; NaN, and 0, where no two speeds are known.
    slipping : bool array
        Wheel speeds that are not trusted.
    """

    distance: FloatArray
    variance: FloatArray
    slipping: BoolArray


def distance_driven(fixes: Fixes, *, slip_aware: bool = True) -> Driven:
    """The distance driven by the satellite speed, else by the wheels'; see `integral`."""
    ratio, speed, std = wheel_ratio(fixes), fixes.speed, fixes.speed_std
    slipping = slipping_wheels(fixes, speed, std, ratio) & slip_aware
    if fixes.wheel_speed is not None and fixes.wheel_speed_std is not None:
        wheels = np.where(slipping, np.nan, fixes.wheel_speed * ratio)
        std = np.where(np.isfinite(speed), std, fixes.wheel_speed_std)
        speed = np.where(np.isfinite(speed), speed, wheels)
    seconds, known = fixes.seconds, np.isfinite(speed)
    driven, _ = integral(seconds, speed)
    if not np.isfinite(driven).any():
        return Driven(driven, np.zeros(speed.size), slipping)
    time = seconds[known]
    steps = np.diff(time, prepend=time[0])
    measured = np.interp(seconds, time, np.cumsum((std[known] * steps) ** 2))
    return Driven(driven, measured + _lost(seconds, time, LOSS_DENSITY), slipping)
