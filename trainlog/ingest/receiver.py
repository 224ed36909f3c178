"""What a satellite receiver gives that is no measurement: computed fixes, frozen or late speeds.

Each is found by what only a computed value does: a speed that repeats to its last digit while the
train moves, fixes that advance by one and the same step, an integral that runs away from the
positions. Positions are absolute and speeds are not, so that where both are steady it is the speed
that is set aside; a step of the positions alone, with speeds that go on, is the positions' fault.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from estimators.receiver import (
    Delay,
    WheelSpeeds,
    mean_square,
    pairs_at,
    series_of,
)
from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray, robust_std
from trainlog.ingest.clock import Result
from trainlog.ingest.fixes import GATE, STEEPEST, Fixes, slipping_wheels, wheel_ratio
from trainlog.ingest.recording import Table
from trainlog.ingest.spikes import GNSS_SPEED, plane
from trainlog.units import NANOSECONDS

FROZEN_TIME, FROZEN_SAMPLES = 5.0, 4
"""A speed that repeats for so long [s], in so many samples, and three times as long as is usual on
the trip, is frozen."""

MOVING = 2.0
"""Speed [m/s] from which on a repeated value is suspicious: a train may stand for long."""

EXTRAPOLATED_TIME = 5.0
"""Fixes that advance evenly for so long [s] are extrapolated."""

EVEN = 0.02
"""Part of the usual change of a step that is still the same step."""

ROUNDING = 0.03
"""Change of a step [m] that comes of fixes rounded to 1e-7 degrees."""

LEAST_RETURN = 4.0
"""Step [m] with which extrapolated fixes return to the track; a smaller one does no harm."""

LEAST_NOISE = 0.3
"""Usual change of a step [m] from which on even ones before an outage are suspicious."""

LEAST_STD = 1.0
"""Standard deviation [m] of distances between fixes that is not undercut."""

WINDOWS = (4.0, 10.0, 20.0, 40.0, 80.0)
"""Spans over which positions and the integral of the speed are compared [s]."""

STEEPEST_ERROR = 0.1
"""Part of the distance by which the integral of a good speed may be off."""

LATEST = 3.0
"""Delay of a speed [s] for which it is not yet set aside before its delay is known."""

LEAST_CHORDS = ((0.7, 10.0), (0.3, 20.0))
"""Within so long [s] no train, nor tram, turns so sharply that the distance between its fixes is
less than this part of that along the track."""

LEAST_STD = 1.0
"""Standard deviation [m] of distances between fixes that is not undercut."""

WINDOWS = (4.0, 10.0, 20.0, 40.0, 80.0)
"""Spans over which positions and the integral of the speed are compared [s]."""

STEEPEST_ERROR = 0.1
"""Part of the distance by which the integral of a good speed may be off."""

LATEST = 3.0
"""Delay of a speed [s] for which it is not yet set aside before its delay is known."""

LEAST_CHORD, LONGEST_CHORD = 0.3, 20.0
"""Within so long [s] no train turns so sharply that the distance between its fixes is less than
this part of that along the track."""

AGREEING = 0.1
"""Part by which the ways along the fixes and by the speeds may differ while both are right."""

LEAST_COMPARED, FIX_STD = 60, 5.0
"""Fixes from which on they judge speeds, and their standard deviation [m] where none is stated."""

SCALE = 0.2
"""Speeds whose distance is off by this part over the whole trip are in another unit."""

DELAYS = np.arange(-2.0, 12.1, 0.5)
"""Delays of the speed behind the positions that are tried [s]."""

LEAST_DELAY = 0.4
"""A smaller delay [s] is not corrected."""

LEAST_COMMON, LEAST_OF_STEP = 0.05, 0.1
"""A smaller delay of fixes and speeds together [s], or part of the time between speeds, is not
corrected."""

UNKNOWN = Delay(np.nan, np.nan)
"""What a trip does not show."""

SIGNIFICANT, SIGNIFICANT_ALONE = 3.0, 2.0
"""A delay of fewer standard deviations is not corrected; fixes that are earlier than the speeds by
more, and by half the delay, do not share it."""


def frozen(seconds: FloatArray, speed: FloatArray) -> BoolArray:
    """Speeds that repeat the one before for longer than measured ones do, while the train moves.

    Examples
    --------
    >>> import numpy as np
    >>> speed = 20.0 + 0.1 * np.sin(np.arange(60.0))
    >>> speed[20:40] = speed[20]
    >>> np.flatnonzero(frozen(np.arange(60.0), speed))[[0, -1]]
    array([21, 39])
    """
    flags = np.zeros(speed.size, dtype=np.bool_)
    known = np.flatnonzero(np.isfinite(speed))
    if known.size < FROZEN_SAMPLES:
        return flags
    value, time = speed[known], seconds[known]
    first = np.flatnonzero(np.diff(value, prepend=np.nan) != 0.0)
    last = np.append(first[1:], value.size) - 1
    lasted, count = time[last] - time[first], last - first + 1
    moving = value[first] > MOVING
    if not moving.any():
        return flags
    usual = float(np.quantile(lasted[moving], 0.95))
    still = moving & (count >= FROZEN_SAMPLES) & (lasted > max(FROZEN_TIME, 3.0 * usual))
    for begin, end in zip(first[still], last[still], strict=True):
        flags[known[begin + 1 : end + 1]] = True
    return flags


def hold_of(seconds: FloatArray, speed: FloatArray) -> float:
    """For how long a receiver repeats a speed while the train moves [s], on average; at least 1.

    Examples
    --------
    >>> import numpy as np
    >>> hold_of(np.arange(40.0), np.repeat(np.arange(20.0, 30.0), 4))
    3.9
    """
    moving = np.flatnonzero(speed > MOVING)
    if moving.size < FROZEN_SAMPLES:
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
    if known.size < 10:
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
    runs, count = label(even)
    least = max(EXTRAPOLATED_TIME, 2.0 * step)
    for run in _spans(runs, count):
        begin, end = middle[run[0]], middle[run[-1]]
        following = slice(run[-1] + 1, run[-1] + ahead + 2)
        lost = bool(np.any(~near[following])) and usual > LEAST_NOISE
        returns = lost or bool(np.any(change[following] > LEAST_RETURN))
        if returns and run.size > 1 and time[end] - time[begin] + 2.0 * ahead * step >= least:
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
    known = np.flatnonzero(np.isfinite(points))
    if known.size < FROZEN_SAMPLES:
        return flags
    time, point = seconds[known], points[known]
    first = np.flatnonzero(np.diff(point, prepend=np.nan) != 0.0)
    last = np.append(first[1:], point.size) - 1
    for begin, end in zip(first[:-1], last[:-1], strict=True):
        step = time[end + 1] - time[end]
        reach = 0.5 * STEEPEST * step**2 + GATE * np.sqrt(2.0) * std[known[end]]
        if end > begin and abs(point[end + 1] - point[end]) > max(reach, LEAST_RETURN):
            flags[known[begin + 1 : end + 1]] = True
    return flags


def _spans(runs: IntArray, count: int) -> list[IntArray]:
    """Numbers of the members of each run."""
    order = np.argsort(runs, kind="stable")
    edges = np.searchsorted(runs[order], np.arange(1, count + 2))
    return [order[a:b] for a, b in pairwise(edges.tolist())]


def integral(seconds: FloatArray, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Integral of a speed [m] at every sample, and how long it was missing until then [s].

    Across gaps of the speed the integral goes on a line; a gap is longer than 2.5 s and 2.5 steps.

    Examples
    --------
    >>> import numpy as np
    >>> integral(np.array([0.0, 1.0, 2.0]), np.array([4.0, np.nan, 6.0]))
    (array([ 0.,  5., 10.]), array([0., 0., 0.]))
    """
    known = np.flatnonzero(np.isfinite(speed))
    if known.size < 2:
        return np.full(speed.size, np.nan), np.zeros(speed.size)
    time, value = seconds[known], speed[known]
    steps = np.diff(time)
    usual = float(np.median(steps))
    driven = np.concatenate(([0.0], np.cumsum(0.5 * (value[1:] + value[:-1]) * steps)))
    missing = np.concatenate(
        ([0.0], np.cumsum(np.where(steps > max(2.5, 2.5 * usual), steps, 0.0)))
    )
    outside = np.maximum(seconds - time[-1], 0.0) - np.maximum(time[0] - seconds, 0.0)
    return (
        np.interp(seconds, time, driven) + np.where(outside > 0.0, value[-1], value[0]) * outside,
        np.interp(seconds, time, missing) + outside,
    )


def delay_of(seconds: FloatArray, along: FloatArray, speed: FloatArray) -> float:
    """By how much a speed comes later than the positions [s]; 0 where that is not certain.

    The delay with which the positions follow the integral of the speed best, over 10 and 20 s.

    Parameters
    ----------
    seconds, along, speed : (n,) arrays [s], [m], [m/s]
        NaN where absent.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(0.0, 600.0)
    >>> speed = 12.0 + 10.0 * np.sin(time / 20.0)
    >>> along = 12.0 * time - 200.0 * np.cos(time / 20.0)
    >>> delay_of(time, along, np.interp(time - 3.0, time, speed))
    3.0
    """
    driven, missing = integral(seconds, speed)
    fixes = series_of(seconds, along)
    if not np.isfinite(driven).all() or fixes.values.size < 60:
        return 0.0
    known = np.isfinite(speed)
    best = np.full(DELAYS.size, 0.0)
    for number, delay in enumerate(DELAYS):
        at = fixes.seconds + delay
        shifted = np.interp(at, seconds[known], driven[known])
        absent = np.round(np.interp(at, seconds[known], missing[known]), 6)
        inside = (at > seconds[known][0]) & (at < seconds[known][-1])
        for window in (10.0, 20.0):
            first, second = pairs_at(fixes.seconds, window)
            kept = (absent[first] == absent[second]) & inside[first] & inside[second]
            change = (fixes.values - shifted)[second[kept]] - (fixes.values - shifted)[first[kept]]
            if change.size < 40:
                return 0.0
            best[number] += mean_square(change) / window
    least = int(np.argmin(best))
    none = int(np.argmin(np.abs(DELAYS)))
    if best[least] > 0.7 * best[none] or abs(DELAYS[least]) < LEAST_DELAY:
        return 0.0
    return float(DELAYS[least])


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
    unknown = Delay(0.5 * row, row / np.sqrt(12.0)) if row else UNKNOWN
    known = np.isfinite(fixes.speed)
    if fixes.wheel_speed is None or np.count_nonzero(known) < 2:
        return unknown if row else none
    wheels = wheel_speeds(fixes)
    late = wheels.delay_of(fixes.seconds[known], fixes.speed[known])
    if late is not None and late.value > LEAST_COMMON:
        # Late wheels are no slipping ones, so that slip is only seen now.
        on_time = with_late_wheels(fixes, late.value)
        slips = slipping_wheels(on_time, fixes.speed, fixes.speed_std, wheel_ratio(on_time))
        turning = np.isfinite(fixes.wheel_speed)
        known &= np.interp(fixes.seconds, fixes.seconds[turning], slips[turning]) == 0.0
        late = wheels.delay_of(fixes.seconds[known], fixes.speed[known])
    if late is None:
        return unknown
    step = float(np.median(np.diff(fixes.seconds[known])))
    least = max(LEAST_COMMON, LEAST_OF_STEP * min(step, 1.0), SIGNIFICANT * late.std)
    if late.value < least:
        return none
    left = wheels.delay_left(fixes.seconds, chainage, late.value)
    alone = left is not None and left.value < -max(0.5 * late.value, SIGNIFICANT_ALONE * left.std)
    return none if alone else late


def wheel_speeds(fixes: Fixes) -> WheelSpeeds:
    """The wheels' speeds where they are known."""
    speed = np.full(fixes.seconds.size, np.nan) if fixes.wheel_speed is None else fixes.wheel_speed
    known = np.isfinite(speed)
    return WheelSpeeds(fixes.seconds[known], speed[known])


def with_late_wheels(fixes: Fixes, delay: float) -> Fixes:
    """Fixes whose wheel speeds are as late as the satellites' [s]: all on the satellites' clock."""
    if fixes.wheel_speed is None:
        return fixes
    late = wheel_speeds(fixes).at(fixes.seconds - delay)
    return replace(fixes, wheel_speed=np.where(np.isfinite(fixes.wheel_speed), late, np.nan))


def scale_of(seconds: FloatArray, points: ComplexArray, speed: FloatArray) -> float:
    """Distance by the speeds over the distance between fixes, the median over 20 s; NaN if unknown.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(0.0, 300.0)
    >>> scale_of(time, 20.0 * time + 0j, np.full(300, 38.9)).__round__(2)
    1.94
    """
    driven, missing = integral(seconds, speed)
    fixes = series_of(seconds, points)
    if not np.isfinite(driven).all() or fixes.values.size < 20:
        return float("nan")
    along = np.interp(fixes.seconds, seconds, driven)
    absent = np.interp(fixes.seconds, seconds, missing)
    first, second = pairs_at(fixes.seconds, 20.0)
    chord = np.abs(fixes.values[second] - fixes.values[first])
    whole = (np.abs(absent[second] - absent[first]) < 1e-6) & (chord > 60.0)
    if np.count_nonzero(whole) < 10:
        return float("nan")
    return float(np.median((along[second] - along[first])[whole] / chord[whole]))


def contradicted(
    seconds: FloatArray, places: NDArray[Any], speed: FloatArray, std: float
) -> BoolArray:
    """Speeds whose integral departs from the positions over some window.

    Parameters
    ----------
    seconds : (n,) array [s]
    places : (n,) array [m]
        Chainage, or, as complex points of the plane, where no line is known: then a speed is only
        found to be too low for the distance between its fixes, or far too high.
    speed : (n,) array [m/s]
    std : float [m]
        Of a position.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(0.0, 400.0)
    >>> speed = np.full(400, 20.0)
    >>> speed[100:200] = 12.0
    >>> found = np.flatnonzero(contradicted(time, 20.0 * time, speed, std=3.0))
    >>> bool(90 <= found[0] <= 105), bool(195 <= found[-1] <= 210)
    (True, True)
    """
    flags = np.zeros(seconds.size, dtype=np.bool_)
    driven, missing = integral(seconds, speed)
    fixes = series_of(seconds, places)
    if not np.isfinite(driven).all() or fixes.values.size < 10:
        return flags
    time = fixes.seconds
    along = np.interp(time, seconds, driven)
    absent = np.round(np.interp(time, seconds, missing), 6)
    known = np.isfinite(speed)
    pace = np.interp(time, seconds[known], speed[known])
    broken = np.cumsum(_breaks(time, fixes.values, along, std))
    bad = np.zeros(time.size + 1, dtype=np.int64)
    for window in WINDOWS:
        first, second = pairs_at(time, window)
        marked = np.cumsum(bad[:-1] > 0)
        whole = (absent[first] == absent[second]) & (broken[first] == broken[second])
        whole &= marked[first] == marked[second]
        first, second = first[whole], second[whole]
        by_speed = along[second] - along[first]
        moved = fixes.values[second] - fixes.values[first]
        noise = GATE * np.sqrt(2.0) * std + STEEPEST_ERROR * np.abs(by_speed)
        if np.iscomplexobj(moved):
            chord = np.abs(moved)
            # As well as they usually agree over so long: what lasts is the same at both ends.
            driving = by_speed > MOVING * window
            usual = robust_std((chord - by_speed)[driving]) if driving.any() else std
            least = GATE * max(usual, LEAST_STD) + STEEPEST_ERROR * np.abs(by_speed)
            noise = np.minimum(noise, least)
            late = np.minimum(np.abs(pace[second] - pace[first]), STEEPEST * window)
            late *= LATEST
            wrong = chord - by_speed > noise + late
            for share, longest in LEAST_CHORDS:
                if window <= longest:
                    wrong |= share * by_speed - chord > noise + late
        else:
            wrong = np.abs(moved - by_speed) > noise
        count = np.zeros(time.size + 1, dtype=np.int64)
        np.add.at(count, first[wrong], 1)
        np.add.at(count, second[wrong] + 1, -1)
        bad[:-1] += np.cumsum(count)[:-1] > 0
    if not bad.any():
        return flags
    inside = np.interp(seconds, time, (bad[:-1] > 0).astype(np.float64)) >= 0.5
    return np.asarray(inside & np.isfinite(speed))


def _breaks(time: FloatArray, places: NDArray[Any], along: FloatArray, std: float) -> BoolArray:
    """Where the positions step while the speed goes on: before which value."""
    steps = np.diff(time, prepend=time[0] - 1.0)
    change = np.diff(places, prepend=places[0])
    by_speed = np.diff(along, prepend=along[0])
    apart = np.abs(change - by_speed)
    if np.iscomplexobj(places):
        apart = np.abs(np.abs(change) - by_speed)
    close = steps < 3.0
    usual = robust_std(apart[close]) if close.any() else std
    far = close & (apart > max(GATE * usual, std))
    # A speed that is wrong is wrong step after step; a position steps once.
    runs, count = label(far)
    size = np.bincount(runs, minlength=count + 1)
    return np.asarray(far & (size[runs] <= 2))


def without_contradicted(table: Table) -> Result:
    """Take away satellite speeds that the fixes contradict, where no line is known.

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
    >>> kept, found = without_contradicted(table)
    >>> bool(abs(np.isnan(kept.signals["/gnss/motion.speed"]).sum() - 100) < 15)
    True
    """
    points, speed = plane(table), table.signals.get(GNSS_SPEED)
    if points is None or speed is None:
        return table, []
    known = np.isfinite(points)
    if np.count_nonzero(known) < LEAST_COMPARED or np.count_nonzero(np.isfinite(speed)) < 2:
        return table, []
    seconds = (table.time - table.time[0]) / NANOSECONDS
    accuracy = table.signals.get("/gnss/fix.horizontal_accuracy", np.full(speed.size, np.nan))
    stated = accuracy[known & (accuracy > 0.0)]
    std = np.sqrt(2.0) * (float(np.median(stated)) if stated.size else FIX_STD)
    doubtful = contradicted(seconds, points, speed, std)
    if not doubtful.any():
        return table, []
    driven, _ = integral(seconds, speed)
    fixes = series_of(seconds, points)
    way = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(fixes.values)))))
    wrong = np.zeros(speed.size, dtype=np.bool_)
    runs, count = label(doubtful | ~np.isfinite(speed))
    for run in _spans(runs, count):
        if not doubtful[run].any():
            continue
        before, after = np.searchsorted(fixes.seconds, seconds[run[[0, -1]]])
        ends = np.array([max(before - 1, 0), min(after, way.size - 1)])
        by_fixes = way[ends[1]] - way[ends[0]]
        by_speed = float(np.ptp(np.interp(fixes.seconds[ends], seconds, driven)))
        if abs(by_fixes - by_speed) > AGREEING * max(by_fixes, by_speed) + GATE * std:
            wrong[run] = True
    wrong &= doubtful
    found = table.found("contradicted", wrong, GNSS_SPEED, "by the way along the fixes")
    return (table.without(GNSS_SPEED, wrong) if wrong.any() else table), found


class Speeds:
    """The satellite speeds of a trip, and which of them are used.

    Before the chainage is known: frozen ones, those of extrapolated fixes, and those that do not go
    with the distances between the fixes are set aside. `compare` then puts late ones back and sets
    aside those that do not go with the chainage.
    """

    def __init__(
        self, fixes: Fixes, points: ComplexArray | None = None, computed: BoolArray | None = None
    ) -> None:
        self.seconds, self.used = fixes.seconds, fixes.speed.copy()
        self.aside = np.zeros(fixes.speed.size, dtype=np.bool_)
        self.delay = 0.0
        self.common = Delay(0.0, 0.0)
        self.hold = hold_of(fixes.seconds, fixes.speed)
        self._counts: dict[str, int] = {}
        if points is None or computed is None or np.count_nonzero(np.isfinite(self.used)) < 2:
            return
        self._without("extrapolated", computed)
        self._without("frozen", frozen(self.seconds, self.used))
        scale = scale_of(self.seconds, points, self.used)
        if not 1.0 / (1.0 + SCALE) < scale < 1.0 + SCALE and np.isfinite(scale):
            self._without(f"{scale:.2f} times what positions show", np.isfinite(self.used))
            return

    def compare(self, chainage: FloatArray, std: float) -> None:
        """Judge the speeds by the chainage of the fixes that fit, NaN for others."""
        if np.count_nonzero(np.isfinite(self.used)) < 2:
            return
        self.delay = delay_of(self.seconds, chainage, self.used)
        if self.delay:
            known = np.flatnonzero(np.isfinite(self.used))
            at = self.seconds + self.delay
            put_back = np.interp(at, self.seconds[known], self.used[known])
            _, missing = integral(self.seconds, self.used)
            whole = np.interp(at, self.seconds, missing) - missing < 1e-6
            inside = (at <= self.seconds[known[-1]]) & whole & np.isfinite(self.used)
            self.used = np.where(inside, put_back, np.nan)
        self._without("contradicted", contradicted(self.seconds, chainage, self.used, std))

    def words(self, further: int) -> str:
        """Why speeds are not used."""
        counts = dict(self._counts)
        if further:
            counts["contradicted"] = counts.get("contradicted", 0) + further
        found = [f"{count} {reason}" for reason, count in counts.items()]
        if self.delay:
            found.append(f"all {self.delay:g} s late")
        if self.common.value > 0.0:
            late, std = self.common.value, self.common.std
            found.append(f"with the fixes {late:.2f} s (standard deviation {std:.2f} s) late")
        return ", ".join(found)

    def _without(self, reason: str, flags: BoolArray) -> None:
        flags = flags & np.isfinite(self.used)
        if flags.any():
            self._counts[reason] = self._counts.get(reason, 0) + int(np.count_nonzero(flags))
        self.aside |= flags
        self.used = np.where(flags, np.nan, self.used)
