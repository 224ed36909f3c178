"""The motion along a line from fixes on it: their noise sized, smoothed, what departs set aside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import t as t_distribution

from estimators.motion import (
    ACCELERATION_TIME,
    LASTING_TIME,
    MotionModel,
    SmoothedMotion,
    smooth_motion,
)
from estimators.receiver import (
    ReceiverNoise,
    mean_square,
    position_noise,
    series_of,
    speed_noise,
    structure,
    white_noise,
)
from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray, robust_std
from trainlog.ingest.fixes import GATE, HOLD, Fixes, held, slipping_wheels
from trainlog.ingest.receiver import integral
from trainlog.railway.geometry import Track, beside

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

UNSEEN_SPREAD, UNSEEN_DENSITY = 0.6, 6.0
"""The least of both where no speed was measured."""

LOST_AFTER = 15.0
"""Steps between measurements further apart than this [s] are an outage."""

OUTAGE_DENSITY = 3.0, 12.0
"""Least and largest spectral density of the acceleration in an outage [m²/s³]."""

SPEED_SPREAD = 0.4, 1.2
"""Least and largest standard deviation of a train's acceleration [m/s²]: trains that rarely
change speed, trams."""


SPARSE = 2.5
"""Fixes further apart than this [s] are rare."""

LEAST_PREDICTED, FOLDS, PREDICTED = 8, 4, 10.0
"""Fixes from which on they are left out and predicted, in so many parts, each in stretches of so
long [s] or a fix."""

LATE_SHARE = 0.5
"""Part of that noise that no averaging removes: fixes that come late err to one side."""

MOST_ALONG = 500.0
"""Largest noise along the line alone [m]."""

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
        self.along_std = 0.0
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
            if turn < 3:
                self._size_along(
                    np.where(np.abs(aside) < GATE * self._usual(aside), chainage, np.nan)
                )
            motion = self._smoothed()
            position, pace = motion.position, motion.speed
            ratio = 1.0 - motion.wheel_error
            self.slipping = (
                slipping_wheels(self.fixes, motion.speed, motion.speed_std, ratio) & self.slip_aware
            )
            settled = turn > 1 and np.abs(position - last).max() < 0.1
            if settled and np.array_equal(np.isfinite(before), fitting):
                break
        found = self._smoothed() if motion is None else self._calibrated(motion)
        late = LATE_SHARE * self.along_std
        return replace(
            found,
            position_std=np.hypot(found.position_std, late),
            speed_std=np.hypot(found.speed_std, late / LASTING_TIME),
        )

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

    def _size_along(self, chainage: FloatArray) -> None:
        """Noise along the line alone, from fixes that are left out and predicted by the others.

        A fix that comes late, as phones replay them, lies on the line, behind the train: what
        departs beside the line does not show it. Only where fixes are rare or come without a speed;
        else the integral of the speed shows it.
        """
        seconds = self.fixes.seconds
        known = np.flatnonzero(np.isfinite(chainage))
        spacing = float(np.median(np.diff(seconds[known]))) if known.size > 1 else 0.0
        if known.size < LEAST_PREDICTED or (spacing < SPARSE and self.speed_noise is not None):
            return
        _, first = np.unique(np.floor(seconds / max(0.5 * spacing, 1.0)), return_index=True)
        rows = np.unique(np.concatenate([first, known])) if spacing >= 1.0 else first
        seen = np.isfinite(chainage[rows]) & (np.isfinite(self.chainage[rows]))
        judged = np.isfinite(chainage[rows])
        number = np.floor(seconds[rows] / max(PREDICTED, 1.01 * spacing)).astype(np.int64) % FOLDS
        own = self._position_std()[rows]
        for _ in range(4):
            error, std = np.full(rows.size, np.nan), np.ones(rows.size)
            for fold in range(FOLDS):
                out = number == fold
                given = np.where(seen & ~out, chainage[rows], np.nan)
                if np.count_nonzero(np.isfinite(given)) < 4:
                    continue
                motion = self._smoothed(given, rows=rows)
                asked = out & judged
                error[asked] = (chainage[rows] - motion.position)[asked]
                std[asked] = np.hypot(motion.position_std, np.hypot(own, self.along_std))[asked]
            found = np.isfinite(error)
            if np.count_nonzero(found) < LEAST_PREDICTED:
                return
            ratio = float(np.quantile(np.abs(error[found]) / std[found], 0.95)) / 1.96
            if ratio < 1.05:
                return
            usual = np.median(np.hypot(own, self.along_std)[found])
            self.along_std = float(np.hypot(self.along_std, usual * np.sqrt(ratio**2 - 1.0)))
            self.along_std = min(self.along_std, MOST_ALONG)

    def _position_std(self) -> FloatArray:
        """Standard deviation of each fix [m]."""
        noise = self.position_noise
        white = np.hypot(noise.white, SMALLEST_NOISE[0]) * np.sqrt(self.position_count)
        return np.asarray(np.hypot(white, noise.lasting) * self.relative)

    def _usual(self, aside: FloatArray) -> FloatArray:
        """Usual distance of each fix beside the line, as a standard deviation [m]."""
        size = robust_std((aside / self.relative)[self.known])
        return np.hypot(max(size, SMALLEST_NOISE[0]) * self.relative, GEOMETRY_STD)

    def _size_agility(self, pace: FloatArray) -> None:
        """Standard deviation of the acceleration, from the changes of speed over 10 s."""
        seconds = self.fixes.seconds
        even = np.arange(seconds[0], seconds[-1], 10.0)
        values = np.interp(even, seconds, pace)
        change = np.diff(values)
        share = 10.0 / ACCELERATION_TIME
        per_unit = 2.0 * ACCELERATION_TIME**2 * (share + np.expm1(-share))
        size = float(np.sqrt(np.mean(change**2) / per_unit)) if change.size else 0.0
        least, most = SPEED_SPREAD
        densities = OUTAGE_DENSITY
        if np.count_nonzero(np.isfinite(self.fixes.speed)) < 20:
            # Smoothed positions hide how hard a train brakes: any train then.
            least, densities = UNSEEN_SPREAD, (UNSEEN_DENSITY, OUTAGE_DENSITY[1])
        self.acceleration_std = float(np.clip(size, least, most))
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
        outage = float(np.clip(max(density), *densities))
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

    def _smoothed(
        self,
        along: FloatArray | None = None,
        factor: float = 1.0,
        rows: IntArray | slice = slice(None),
    ) -> SmoothedMotion:
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
            wheels = (np.where(self.slipping, np.nan, wheels) * factor)[rows]
            # White noise of this size carries as much, taken together, as errors that last.
            wheel_std = (wheel_std * np.sqrt(max(1.0, 2.0 * WHEEL_TIME / step)))[rows]
        lasting = self.unsure * noise.lasting * self.relative
        return smooth_motion(
            fixes.seconds[rows],
            speed[rows] * factor,
            speed_white[rows],
            self.chainage[rows] if along is None else along,
            np.hypot(white * self.relative, self.along_std)[rows],
            lasting_std=np.hypot(lasting, GEOMETRY_STD)[rows],
            lasting_speed_std=speed_lasting,
            wheel_speed=wheels,
            wheel_speed_std=wheel_std,
            model=MotionModel(
                acceleration_std=self.acceleration_std,
                position_time=noise.time,
                speed_time=LASTING_TIME if speeds is None else speeds.time,
                drift=DRIFT,
                unmeasured=self.unmeasured[rows],
            ),
        )

    def _departs(
        self, chainage: FloatArray, aside: FloatArray, motion: SmoothedMotion
    ) -> BoolArray:
        """Fixes that do not go with the motion, along the line or beside it."""
        std = self._usual(aside)
        spread = np.sqrt(std**2 + motion.position_std**2 + self.along_std**2)
        along = (chainage - motion.position) / spread
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


def _widened(error: FloatArray, std: FloatArray, rows: IntArray, besides: float) -> FloatArray:
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
        size = max(robust_std(scaled), 1e-6)
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
