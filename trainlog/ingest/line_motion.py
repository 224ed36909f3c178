"""The motion along a line from fixes on it: their noise sized, smoothed, what departs set aside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as t_distribution

from estimators.motion import (
    ACCELERATION_TIME,
    LASTING_TIME,
    MotionModel,
    SmoothedMotion,
    smooth_motion,
)
from estimators.receiver import (
    MEDIAN_TO_STD,
    ReceiverNoise,
    mean_square,
    position_noise,
    series_of,
    speed_noise,
    structure,
    white_noise,
)
from trainlog.ingest.fixes import GATE, HOLD, Fixes, held, slipping_wheels
from trainlog.ingest.receiver import integral
from trainlog.ingest.recording import BoolArray, FloatArray
from trainlog.railway.geometry import Track, beside

ComplexArray = NDArray[np.complex128]

GEOMETRY_STD = 2.0
"""Standard deviation of a good line's own geometry [m]."""

DRIFT = 0.1
"""Random walk [m/√s] of the chainage beyond the integral of the speed: curves cut short by the
geometry."""

TURNS = 5
"""Times the fixes are projected and the motion is smoothed."""

WHEEL_TIME = 2.0
"""Time over which the errors of wheel speeds last [s]: creep goes with the effort."""

SLOWEST = 1.0
"""Errors are sized on a train faster than this [m/s]: receivers hold a position that stands."""

SMALLEST_NOISE = 0.3, 0.02
"""Standard deviations that no receiver undercuts: of a position [m], of a speed [m/s]."""

LOST_AFTER = 15.0
"""Steps between measurements further apart than this [s] are an outage."""

OUTAGE_DENSITY = 3.0, 12.0
"""Least and largest spectral density of the acceleration in an outage [m²/s³]."""

SPEED_SPREAD = 0.4, 1.2
"""Least and largest standard deviation of a train's acceleration [m/s²]: trains that rarely
change speed, trams."""


LEAST_FREEDOM = 3.0
"""Least number of independent values that the size of errors is taken to rest on."""

LEAST_CALIBRATED = 30
"""Fixes from which on the band is compared with the distances beside the track."""


class LineMotion:
    """Projecting, sizing the noise, smoothing and setting aside, until they agree."""

    def __init__(
        self,
        track: Track,
        points: ComplexArray,
        fixes: Fixes,
        *,
        gated: bool,
        slip_aware: bool,
        hold: float,
    ) -> None:
        self.hold = hold
        self.track, self.points, self.fixes = track, points, fixes
        self.gated, self.slip_aware = gated, slip_aware
        self.known = np.isfinite(points)
        self.contradicted = np.zeros(points.size, dtype=np.bool_)
        self.chainage = np.full(points.size, np.nan)
        self.misfit = 0.0
        self.position_noise = ReceiverNoise(1.0, 0.0, LASTING_TIME)
        self.speed_noise: ReceiverNoise | None = None

    def run(self, course: FloatArray, fitting: BoolArray, slipping: BoolArray) -> SmoothedMotion:
        """The motion; `course` and `fitting` are the first guess of position and good fixes."""
        seconds = self.fixes.seconds
        self.slipping = slipping
        position, pace = course, np.gradient(course, seconds)
        motion = None
        for turn in range(TURNS):
            chainage, aside = beside(self.track, self.points, position)
            before = self.chainage
            if motion is not None and self.gated:
                fitting = self.known & ~self._departs(chainage, aside, motion)
                self._judge_speeds(motion)
            self.chainage = np.where(fitting, chainage, np.nan)
            if np.count_nonzero(fitting) < 2:
                break
            if turn < 3:
                self._size(np.where(fitting, aside, np.nan), pace, smoothed=motion is not None)
            last = position
            motion = self._smoothed()
            position, pace = motion.position, motion.speed
            ratio = 1.0 - motion.wheel_error
            self.slipping = (
                slipping_wheels(self.fixes, motion.speed, motion.speed_std, ratio) & self.slip_aware
            )
            settled = turn > 1 and np.abs(position - last).max() < 0.1
            if settled and np.array_equal(np.isfinite(before), fitting):
                break
        return self._smoothed() if motion is None else self._calibrated(motion)

    def _size(self, aside: FloatArray, pace: FloatArray, *, smoothed: bool) -> None:
        """Estimate the noise of positions and speeds, and the train's agility, on this trip."""
        seconds, fixes = self.fixes.seconds, self.fixes
        self.relative = _relative_accuracy(fixes.std, aside)
        moving = pace > SLOWEST
        enough = np.count_nonzero(np.isfinite(aside) & moving) > 60
        values = np.where(moving, aside, np.nan) if enough else aside
        series = series_of(seconds, values / self.relative)
        self.position_noise = position_noise(series.seconds, series.values)
        self._size_misfit(series.values, series.seconds)
        of_fix = series_of(seconds, self.chainage)
        self.position_count = np.where(of_fix.owner >= 0, of_fix.count[of_fix.owner], 1)
        speed = np.where(self.contradicted, np.nan, fixes.speed)
        self._size_agility(pace)
        if np.count_nonzero(np.isfinite(speed)) < 20:
            self.speed_noise = None
            return
        shown = series_of(seconds, speed)
        self.speed_count = np.where(shown.owner >= 0, shown.count[shown.owner], 1)
        driven, missing = integral(seconds, speed)
        along = series_of(seconds, self.chainage - driven)
        whole = np.round(np.interp(along.seconds, seconds, missing), 6)
        dense = float(np.median(np.diff(shown.seconds))) < 2.0
        white = np.sqrt(self.hold) * white_noise(shown.values) if dense else 0.0
        found = speed_noise(
            along.seconds,
            along.values,
            whole,
            structure(series.seconds, series.values)[:2],
            max(white, SMALLEST_NOISE[1]),
        )
        # The speeds depart from the motion by no less than their noise.
        apart = mean_square(series_of(seconds, speed - pace).values) if smoothed else 0.0
        lasting = float(np.sqrt(max(apart - found.white**2, found.lasting**2, 0.0)))
        self.speed_noise = ReceiverNoise(found.white, lasting, found.time)

    def _size_misfit(self, aside: FloatArray, seconds: FloatArray) -> None:
        """The line's misfit: what of the distances neither noise nor stated accuracy explains."""
        noise = self.position_noise
        stated = float(np.median(self.fixes.std[self.known]))
        apart = np.minimum(np.diff(seconds, prepend=seconds[0]), noise.time)
        lasting = min(noise.time / max(float(apart.sum()), noise.time), 1.0)
        share = noise.lasting**2 / max(noise.std**2, 1e-12)
        independent = share**2 * lasting + (1.0 - share**2) / max(aside.size, 1)
        total = mean_square(aside)
        explained = max(noise.std, stated) ** 2 * (1.0 + np.sqrt(2.0 * independent))
        self.misfit = float(np.sqrt(max(0.0, total - explained)))
        # What the differences do not show but is no misfit lasts.
        rest = total - self.misfit**2 - noise.std**2
        lasting_std = float(np.sqrt(noise.lasting**2 + max(rest, 0.0)))
        self.position_noise = ReceiverNoise(noise.white, lasting_std, noise.time)
        # A size from few independent values is unsure, the more as errors have heavy tails:
        # Student's t in place of the normal.
        freedom = max(float(apart.sum()) / (4.0 * noise.time), LEAST_FREEDOM)
        self.unsure = float(t_distribution.ppf(0.975, freedom)) / 1.96

    def _size_agility(self, pace: FloatArray) -> None:
        """Standard deviation of the acceleration, from the changes of speed over 10 s."""
        seconds = self.fixes.seconds
        even = np.arange(seconds[0], seconds[-1], 10.0)
        values = np.interp(even, seconds, pace)
        change = np.diff(values)
        share = 10.0 / ACCELERATION_TIME
        per_unit = 2.0 * ACCELERATION_TIME**2 * (share + np.expm1(-share))
        size = float(np.sqrt(np.mean(change**2) / per_unit)) if change.size else 0.0
        self.acceleration_std = float(np.clip(size, *SPEED_SPREAD))
        # Over an outage a train brakes, stands and starts: what counts is how much its speed
        # changes over as long.
        measured = np.isfinite(self.chainage) | np.isfinite(self.fixes.speed)
        if self.fixes.wheel_speed is not None:
            measured |= np.isfinite(self.fixes.wheel_speed)
        apart = _apart(seconds, measured)
        values[np.interp(even, seconds, apart) > LOST_AFTER] = np.nan
        density = [1.0]
        for lag in (1, 2, 4, 8):
            square = (values[lag:] - values[:-lag]) ** 2
            if np.count_nonzero(np.isfinite(square)) > lag:
                density.append(float(np.nanmean(square)) / (10.0 * lag))
        usual = 2.0 * self.acceleration_std**2 * ACCELERATION_TIME
        outage = float(np.clip(max(density), *OUTAGE_DENSITY))
        self.unmeasured = np.where(apart > LOST_AFTER, max(outage / usual, 1.0), 1.0)

    def _calibrated(self, motion: SmoothedMotion) -> SmoothedMotion:
        """The motion with bands as wide as the same smoothing errs beside the track.

        A train on rails does not move across them: distances beside the track, smoothed as if they
        had been driven, should be 0, and so should their rate. Whatever the receiver's errors are
        like, those along the track are like them.
        """
        _, aside = beside(self.track, self.points, motion.position)
        fitting = np.isfinite(self.chainage)
        if np.count_nonzero(fitting) < LEAST_CALIBRATED:
            return motion
        across = self._smoothed(np.where(fitting, aside, np.nan), 0.0)
        rows = np.flatnonzero(fitting & (motion.speed > SLOWEST))
        rows = rows if rows.size >= LEAST_CALIBRATED else np.flatnonzero(fitting)
        return replace(
            motion,
            position_std=_widened(across.position[rows], motion.position_std, rows, self.misfit),
            speed_std=_widened(across.speed[rows], motion.speed_std, rows, 0.0),
        )

    def _smoothed(self, along: FloatArray | None = None, factor: float = 1.0) -> SmoothedMotion:
        """The motion by the chainage, or by other positions and the speeds times a factor."""
        fixes, noise, speeds = self.fixes, self.position_noise, self.speed_noise
        white = np.maximum(noise.white, SMALLEST_NOISE[0]) * np.sqrt(self.position_count)
        speed = np.where(self.contradicted, np.nan, fixes.speed)
        speed_white, speed_lasting = fixes.speed_std, 0.0
        if speeds is not None:
            speed_white = np.maximum(speeds.white, SMALLEST_NOISE[1]) * np.sqrt(self.speed_count)
            speed_lasting = speeds.lasting
        wheels, wheel_std = fixes.wheel_speed, fixes.wheel_speed_std
        if wheels is not None and wheel_std is not None:
            step = float(np.median(np.diff(fixes.seconds[np.isfinite(wheels)])))
            wheels = np.where(self.slipping, np.nan, wheels) * factor
            # White noise of this size carries as much, taken together, as errors that last.
            wheel_std = wheel_std * np.sqrt(max(1.0, 2.0 * WHEEL_TIME / step))
        return smooth_motion(
            fixes.seconds,
            speed * factor,
            speed_white,
            self.chainage if along is None else along,
            white * self.relative,
            lasting_std=np.hypot(self.unsure * noise.lasting * self.relative, GEOMETRY_STD),
            lasting_speed_std=speed_lasting,
            wheel_speed=wheels,
            wheel_speed_std=wheel_std,
            model=MotionModel(
                acceleration_std=self.acceleration_std,
                position_time=noise.time,
                speed_time=LASTING_TIME if speeds is None else speeds.time,
                drift=DRIFT,
                unmeasured=self.unmeasured,
            ),
        )

    def _departs(
        self, chainage: FloatArray, aside: FloatArray, motion: SmoothedMotion
    ) -> BoolArray:
        """Fixes that do not go with the motion, along the line or beside it."""
        usual = MEDIAN_TO_STD * float(np.median(np.abs((aside / self.relative)[self.known])))
        std = np.maximum(usual, SMALLEST_NOISE[0]) * self.relative
        std = np.hypot(std, GEOMETRY_STD)
        along = (chainage - motion.position) / np.hypot(std, motion.position_std)
        departure = np.hypot(along, aside / std)
        departure[_ends(self.track, chainage, std)] = np.inf
        return held(departure, self.fixes.seconds, GATE, HOLD)

    def _judge_speeds(self, motion: SmoothedMotion) -> None:
        """Set aside the speeds that do not go with the motion."""
        noise = self.speed_noise
        if noise is None:
            return
        std = np.hypot(noise.white * np.sqrt(self.speed_count), noise.lasting)
        apart = np.abs(self.fixes.speed - motion.speed)
        departure = apart / np.hypot(std, motion.speed_std)
        self.contradicted = held(departure, self.fixes.seconds, GATE, HOLD)


def _apart(seconds: FloatArray, measured: BoolArray) -> FloatArray:
    """Time between the measurements on both sides of each step [s]."""
    at = np.flatnonzero(measured)
    if not at.size:
        return np.full(seconds.size, np.inf)
    after = np.searchsorted(at, np.arange(seconds.size))
    later = seconds[at[np.minimum(after, at.size - 1)]]
    return np.asarray(later - seconds[at[np.maximum(after - 1, 0)]])


def _widened(
    error: FloatArray, std: FloatArray, rows: NDArray[np.int64], besides: float
) -> FloatArray:
    """Standard deviations that hold 95 % of the errors in the given rows; never smaller ones."""
    stated = np.hypot(std[rows], besides)
    factor = float(np.quantile(np.abs(error) / stated, 0.95)) / 1.96
    more = max(factor**2 - 1.0, 0.0) * float(np.median(stated)) ** 2
    return np.asarray(np.sqrt(std**2 + more))


def _relative_accuracy(stated: FloatArray, aside: FloatArray) -> FloatArray:
    """What the stated accuracies say of the fixes beside each other, with a median of 1.

    A power of them, 0, 1/2 or 1: that under which the distances beside the track are likeliest.
    """
    used = np.isfinite(aside)
    unit = stated / float(np.median(stated[used]))
    best, chosen = np.inf, 0.0
    for power in (0.0, 0.5, 1.0):
        scaled = np.abs(aside[used]) / unit[used] ** power
        size = max(MEDIAN_TO_STD * float(np.median(scaled)), 1e-6)
        # Negative log-likelihood of Laplace's distribution, whose tails are heavy.
        value = np.log(size) + float(np.mean(power * np.log(unit[used]) + scaled / size))
        if value < best - 0.01:
            best, chosen = value, power
    return np.asarray(unit**chosen)


def _ends(track: Track, chainage: FloatArray, std: FloatArray) -> BoolArray:
    """Fixes beyond the ends of the track, by more than their own error."""
    margin = GATE * std
    return np.asarray(
        (chainage < track.positions[0] - margin) | (chainage > track.positions[-1] + margin)
    )
