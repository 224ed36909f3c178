"""Physical checks of proposed columns: what must hold between them if they are read rightly.

Each check gives a number that the proposal shows. All take values as the file has them; the factor
that they find is the unit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from trainlog.arrays import FloatArray, IntArray
from trainlog.ingest.recording import METRES_PER_DEGREE, NO_TIME
from trainlog.units import NANOSECONDS

WINDOWS = 40
"""Parts of a trip in which two measures of the distance are compared."""

LEAST_WINDOWS = 6
"""Windows with motion that it takes."""

INLIER = 0.3
"""Deviation from the median ratio, as a share of it, up to which a window counts."""

GAP = 30.0
"""Step of time [s] across which nothing is integrated, unless all steps are as long."""

CHORD = 15.0
"""Time [s] between two fixes whose distance is compared with the distance driven."""

HALF_SPAN = 2.5
"""Half of the time [s] over which acceleration is taken."""


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
        Rows that have a time, in its order, one an instant.
    seconds : (n,) array [s]
    """

    order: IntArray
    seconds: FloatArray

    @staticmethod
    def of(time: IntArray) -> Motion:
        """The rows with a time, in its order; times that repeat are spread over their step."""
        known = np.flatnonzero(time != NO_TIME)
        order = known[np.argsort(time[known], kind="stable")]
        seconds = (time[order] - time[order[0]]) / NANOSECONDS
        return Motion(order, _spread(seconds))

    def take(self, values: FloatArray) -> FloatArray:
        """A column in order of time, single values that jump set to NaN."""
        taken = values[self.order].copy()
        known = np.flatnonzero(np.isfinite(taken))
        if known.size > 7:
            smooth = median_filter(taken[known], 7, mode="nearest")
            scale = np.percentile(np.abs(taken[known] - smooth), 99)
            wild = np.abs(taken[known] - smooth) > 20.0 * scale + 1e-9
            wild &= np.abs(taken[known] - smooth) > 0.2 * np.percentile(np.abs(smooth), 99)
            taken[known[wild]] = np.nan
        return taken

    def integral(self, rate: FloatArray) -> FloatArray:
        """The integral of a column over time, gaps left out; NaN-free."""
        known = np.isfinite(rate)
        if np.count_nonzero(known) < 2:
            return np.zeros(self.seconds.size)
        filled = np.interp(self.seconds, self.seconds[known], rate[known])
        step = np.diff(self.seconds)
        usual = float(np.median(step[step > 0])) if np.any(step > 0) else 1.0
        step = np.where(step > max(GAP, 3.0 * usual), 0.0, step)
        return np.concatenate(([0.0], np.cumsum(step * 0.5 * (filled[1:] + filled[:-1]))))

    def derivative(self, values: FloatArray) -> FloatArray:
        """The rate of change of a column over five seconds."""
        known = np.isfinite(values)
        if np.count_nonzero(known) < 2:
            return np.full(values.size, np.nan)
        ends = [
            np.interp(self.seconds + shift, self.seconds[known], values[known])
            for shift in (HALF_SPAN, -HALF_SPAN)
        ]
        return np.asarray((ends[0] - ends[1]) / (2.0 * HALF_SPAN))


def _spread(seconds: FloatArray) -> FloatArray:
    """Times of whole seconds that repeat, spread evenly up to the next."""
    change = np.flatnonzero(np.diff(seconds, prepend=-np.inf) > 0)
    if change.size < 2 or change.size == seconds.size:
        return seconds
    # The last instant's rows lie as far apart as those before.
    usual = float(np.median(np.diff(change)))
    at = np.append(change, change[-1] + max(usual, 1.0))
    instants = np.append(seconds[change], seconds[change[-1]] + np.median(np.diff(seconds[change])))
    return np.asarray(np.interp(np.arange(seconds.size), at, instants))


def distance_ratio(motion: Motion, position: FloatArray, speed: FloatArray) -> Ratio:
    """The change of a distance over the integral of a speed, in windows of the trip.

    Windows in which the distance starts anew, or the speed stands still, do not count.
    """
    # A recorder may count the speed against its own direction.
    forward = speed if np.nanmean(speed) >= 0.0 else -speed
    return _window_ratio(position, motion.integral(forward))


def _window_ratio(position: FloatArray, driven: FloatArray) -> Ratio:
    known = np.flatnonzero(np.isfinite(position))
    total = float(np.ptp(driven)) if driven.size else 0.0
    if known.size < 3 or total <= 0.0:
        return Ratio(np.nan, 0.0, 0)
    # Equal parts of the distance driven; as wide as the column's steps need.
    moved = np.abs(np.diff(position[known]))
    steps = moved[moved > 0]
    levels = float(np.sum(steps) / np.median(steps)) if steps.size else 0.0
    count = int(np.clip(levels / 10.0, LEAST_WINDOWS + 2, WINDOWS))
    marks = np.searchsorted(driven[known], np.linspace(driven[0], driven[-1], count + 1))
    marks = np.unique(np.clip(marks, 0, known.size - 1))
    gained = np.diff(driven[known][marks])
    shift = np.diff(position[known][marks])
    usable = gained > 0.2 * total / count
    if np.count_nonzero(usable) < 2:
        return Ratio(np.nan, 0.0, 0)
    gained, shift = gained[usable], shift[usable]
    middle = float(np.median(shift / gained))
    if middle == 0.0:
        return Ratio(0.0, 0.0, gained.size)
    same = np.abs(shift / gained / middle - 1.0) < INLIER
    if not same.any():
        return Ratio(middle, 0.0, gained.size)
    value = float(np.sum(shift[same]) / np.sum(gained[same]))
    scatter = float(np.median(np.abs(shift / gained / value - 1.0)))
    return Ratio(value, float(np.mean(same)), int(gained.size), scatter)


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
        if np.count_nonzero(usable) < 3 or not np.any(gained > 0):
            return Ratio(np.nan, 0.0, 0)
        ratios = self.chords[usable] / gained[usable]
        middle = float(np.median(ratios))
        if middle == 0.0:
            return Ratio(0.0, 0.0, int(ratios.size))
        off = np.abs(ratios / middle - 1.0)
        return Ratio(middle, float(np.mean(off < INLIER)), int(ratios.size), float(np.median(off)))


def same_motion(other: FloatArray, speed: FloatArray) -> Ratio:
    """The median factor between two speeds while the train moves."""
    known = np.isfinite(other) & np.isfinite(speed)
    known &= speed > 0.3 * np.nanpercentile(speed, 95)
    if np.count_nonzero(known) < 20:
        return Ratio(np.nan, 0.0, 0)
    ratios = other[known] / speed[known]
    middle = float(np.median(ratios))
    if middle == 0.0:
        return Ratio(0.0, 0.0, int(ratios.size))
    near = np.abs(ratios / middle - 1.0) < 0.1
    return Ratio(float(np.median(ratios[near])), float(np.mean(near)), int(ratios.size))


@dataclass(frozen=True, slots=True)
class Driven:
    """How an effort goes with the acceleration that follows from it.

    Attributes
    ----------
    mass : float
        Slope of the effort over acceleration, running resistance left free; [kg] where the effort
        is in newtons.
    correlation : float
        Of effort and acceleration while the effort is strong.
    samples : int
    """

    mass: float
    correlation: float
    samples: int

    @property
    def decides(self) -> bool:
        """Whether the effort clearly moves the train."""
        return self.samples >= 30 and abs(self.correlation) >= 0.5


def driven_mass(motion: Motion, effort: FloatArray, speed: FloatArray) -> Driven:
    """The mass that an effort moves: F = m a + r0 + r1 v + r2 v², by least squares.

    Parameters
    ----------
    effort : (n,) array
        In any unit, NaN where absent.
    speed : (n,) array [m/s]
    """
    acceleration = motion.derivative(speed)
    known = np.isfinite(effort) & np.isfinite(speed) & np.isfinite(acceleration) & (speed > 1.0)
    if np.count_nonzero(known) < 30:
        return Driven(np.nan, 0.0, 0)
    force, rate, v = effort[known], acceleration[known], speed[known]
    if np.std(force) == 0.0 or np.std(rate) < 0.02:
        return Driven(np.nan, 0.0, int(force.size))
    correlation = float(np.corrcoef(force, rate)[0, 1])
    columns = np.column_stack([rate, np.ones_like(v), v, v * v])
    columns /= np.max(np.abs(columns), axis=0)
    scale = np.max(np.abs(rate))
    solution = np.linalg.lstsq(columns, force, rcond=None)[0]
    return Driven(float(solution[0] / scale), correlation, int(force.size))


def usual_acceleration(motion: Motion, speed: FloatArray) -> float:
    """The 98th percentile of the size of the acceleration, in the unit of `speed` a second."""
    rate = motion.derivative(speed)
    known = rate[np.isfinite(rate)]
    return float(np.percentile(np.abs(known), 98)) if known.size else np.nan
