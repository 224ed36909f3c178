"""Running resistance over inertia from the coasting segments of one trip on a known gradient.

While a train coasts,

    dv/dt = -k a_track(s) - c0 - c1 v - c2 v²,      k = m / (m + m_rot),   c = R / (m + m_rot):

speeds alone show accelerations, never forces. The four parameters are those of the acceleration
form in `analysis.resistance` with gravity in the place of the effort: what the track does to each
kilogramme is what drives the train, and k stands where 1/m stood. Windows, noise model, outliers
and covariance are those of `analysis.resistance`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from analysis.resistance.coasting_detection import SPACING, Segment
from analysis.resistance.curve import DragCurve
from analysis.resistance.motion import Motion
from analysis.resistance.noise import Expected, NoiseParts
from analysis.resistance.recording import Recording, SpeedScale, gradient_pieces, track_slope
from analysis.resistance.regression import WindowFit, fit_windows
from analysis.resistance.windows import WINDOW, WindowPoints, Windows, build_windows
from trainlog.arrays import FloatArray
from trainlog.errors import NotIdentifiableError
from trainlog.railway.line import Line
from trainlog.railway.resistance import LARGEST_STD, RunningResistance, basis
from trainlog.railway.train import Train
from trainlog.spans import runs_of
from trainlog.units import GRAVITY, KMH

FINE = 0.2
"""The train's place is known so often [s]: gradients change between samples of the speed."""

SAMPLES = 5.0
"""Least number of samples of the speed in a window: with fewer, neighbouring ends err alike."""

LEAST_COASTING = 60.0
"""Less coasting than this [s] leaves no residuals to estimate the noise from."""

SHORTEST_RANGE = 3.0
"""Speeds that differ by less than this [m/s] are one speed."""

UNKNOWN_RATIO = (0.945, 0.02)
"""Mass over inertia of any train, and its standard deviation: rotating masses are 3 to 12 % of the
empty mass, less of the loaded one."""

RATIO_STD = 0.005
"""Standard deviation of mass over inertia where the train's file gives the rotating mass."""

FREE_RATIO_STD = 0.2
"""Standard deviation of mass over inertia [1] with which the data are asked for it: free."""

OUTLIER_SEGMENT = 4.0
"""A segment whose windows together are so many standard deviations off was not coasting."""


@dataclass(frozen=True, slots=True)
class MassRatio:
    """Mass over inertia (mass and rotating mass), with where it comes from.

    Attributes
    ----------
    value, std : float
    source : str
        ``"train file"``, ``"any train"``, or ``"data"`` where the recording itself determines it.
    """

    value: float
    std: float
    source: str

    @staticmethod
    def expected(train: Train | None) -> MassRatio:
        """What is known before any data: from the train's file, or of any train."""
        if train is None:
            return MassRatio(*UNKNOWN_RATIO, "any train")
        masses = np.array([train.mass, train.mass + train.max_load])
        ends = masses / (masses + train.rotating_mass)
        std = float(np.hypot(0.5 * (ends[1] - ends[0]), RATIO_STD))
        return MassRatio(float(np.mean(ends)), std, "train file")


@dataclass(frozen=True, eq=False)
class Curve(DragCurve):
    """Running resistance over inertia, c(v) = c0 + c1 v + c2 v², with mass over inertia k.

    Attributes
    ----------
    theta : (4,) array
        k, c0 [m/s²], c1 [1/s], c2 [1/m].
    covariance : (4, 4) array
    freedom : float
        Degrees of freedom of the covariance: how well the noise's sizes are known.
    covered : (float, float) [m/s]
        Speeds at which the train coasted.
    supported : (float, float) [m/s] or None
        Those of them at which the curve is known to `LARGEST_STD`; None if it is known nowhere,
        or at one speed only.
    """

    theta: FloatArray
    covariance: FloatArray
    freedom: float
    covered: tuple[float, float]

    @cached_property
    def supported(self) -> tuple[float, float] | None:
        """See above."""
        speed = np.linspace(*self.covered, 121)
        known = self.share(speed) <= LARGEST_STD
        ranges = [(float(speed[first]), float(speed[last - 1])) for first, last in runs_of(known)]
        widest = max(ranges, key=lambda ends: ends[1] - ends[0], default=(0.0, 0.0))
        return widest if widest[1] - widest[0] >= SHORTEST_RANGE else None

    @cached_property
    def resistance(self) -> RunningResistance:  # type: ignore[override]
        """c0, c1 and c2: the deceleration of the coasting train on level track [m/s²]."""
        return RunningResistance.of(self.theta[1:])

    def __call__(self, speed: ArrayLike) -> FloatArray:
        """Deceleration of the coasting train on level track [m/s²] at each speed [m/s]."""
        return self.resistance(speed)

    @property
    def own_covariance(self) -> FloatArray:
        """Of c0, c1 and c2."""
        return self.covariance[1:, 1:]

    @property
    def band_range(self) -> tuple[float, float]:
        """Speeds [m/s] at which the train coasted."""
        return self.covered

    def share(self, speed: ArrayLike) -> FloatArray:
        """Standard deviation over the curve; infinite where the curve is not positive."""
        value = self(speed)
        share = self.std(speed) / np.maximum(value, 1e-12)
        return np.where(value > 0.0, share, np.inf)

    def per_weight(self, speed: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Running resistance over weight and its standard deviation [1]; R / (m g) = c / (k g).

        It needs k, whose uncertainty is in the standard deviation.
        """
        v = np.asarray(speed, dtype=np.float64)
        value = self(v) / self.theta[0] / GRAVITY
        slope = np.concatenate(
            [-(value / self.theta[0])[..., None], basis(v) / (self.theta[0] * GRAVITY)], axis=-1
        )
        variance = np.einsum("...i,ij,...j->...", slope, self.covariance, slope)
        return np.asarray(value), np.asarray(np.sqrt(variance))


@dataclass(frozen=True, eq=False)
class TripCoastDown:
    """Running resistance over inertia as one trip's coasting shows it.

    Attributes
    ----------
    trip : str
    motion : Motion
    curve : Curve
    ratio : MassRatio
        Mass over inertia as the curve has it.
    free : (array (4,), array (4, 4))
        The curve's parameters and covariance from the data alone, mass over inertia free.
    segments : tuple of Segment
        That were used.
    outlier_segments : tuple of Segment
        Found as coasting, and left out because they contradict the others.
    coasted : float [s]
        Time in the segments used.
    windows : dict of str to int
        ``used`` and left out as ``outlier``.
    noise : dict of str to float
        Sizes of the noise: ``speed`` [m/s], ``gradient``, ``position`` [m].
    cluster_factor : float
        What the noise model's variances were multiplied by because neighbouring windows err
        together.
    residual_std : float
        Of the whitened residuals; 1 if the noise is what it is taken for.
    scale : SpeedScale
        What measured speed was divided by.
    source : str
        Topic of the speed.
    points : WindowPoints
    """

    trip: str
    motion: Motion
    curve: Curve
    ratio: MassRatio
    free: tuple[FloatArray, FloatArray]
    segments: tuple[Segment, ...]
    outlier_segments: tuple[Segment, ...]
    coasted: float
    windows: dict[str, int]
    noise: dict[str, float]
    cluster_factor: float
    residual_std: float
    scale: SpeedScale
    source: str
    points: WindowPoints


def fit_segments(
    motion: Motion,
    line: Line,
    segments: tuple[Segment, ...],
    expected: MassRatio,
    strip_length: float = 0.0,
) -> TripCoastDown:
    """Fit the coasting segments of a trip.

    Parameters
    ----------
    motion : Motion
    line : Line
        As travelled.
    segments : tuple of Segment
        In order of time.
    expected : MassRatio
        Mass over inertia before the trip.
    strip_length : float [m]
        Over which gradients and curves are averaged; 0 for a mass point.

    Raises
    ------
    NotIdentifiableError
        If the segments are too short together, or all at one speed.
    """
    outlier_segments: tuple[Segment, ...] = ()
    width = max(WINDOW, SAMPLES * motion.period)
    # How noisy the speed is was seen on the whole trip, not only where it coasts.
    ordinary = Expected.on(line)
    speed_noise = motion.noise * np.sqrt(motion.period / width)
    noise = replace(ordinary, sizes=replace(ordinary.sizes, speed=speed_noise))
    while True:
        windows = build_windows(coasting_recording(motion, line, segments, strip_length), width)
        _check_windows(motion, windows)
        # In the acceleration form k stands in the place of 1/m.
        regression = fit_windows(
            windows, 1.0 / expected.value, FREE_RATIO_STD / expected.value**2, noise
        )
        worst = _outlier_segment(segments, windows, regression)
        if worst is None:
            break
        outlier_segments += (segments[worst],)
        segments = segments[:worst] + segments[worst + 1 :]
    return _result(motion, segments, outlier_segments, windows, regression, expected)


def coasting_recording(
    motion: Motion, line: Line, segments: tuple[Segment, ...], strip_length: float = 0.0
) -> Recording:
    """What the windows of `analysis.resistance` are cut from: gravity drives, nothing brakes."""
    time = fine_clock(motion)
    inside = np.zeros(time.size, dtype=bool)
    for segment in segments:
        inside |= (time >= segment.start) & (time <= segment.end)
    position = np.interp(time, motion.time, np.nan_to_num(motion.position))
    section, nearest = gradient_pieces(line, position)
    nothing = np.zeros(time.size)
    usable = motion.usable & np.isfinite(motion.position)
    between = np.interp(time, motion.time, usable.astype(np.float64))
    speed = np.interp(time, motion.time, motion.speed)
    return Recording(
        time=time,
        speed=speed,
        curve=basis(speed),
        effort=-line.track_acceleration(position, strip_length),
        braking=nothing,
        rotating_momentum=nothing,
        tunnel=nothing,
        track=nothing,
        track_slope=track_slope(line, position, strip_length),
        section=section,
        nearest_edge=nearest,
        # Between two samples both have to be usable.
        usable=inside & (between > 1.0 - 1e-9),
    )


def fine_clock(motion: Motion) -> FloatArray:
    """Times of the samples, and between them if they are far apart: gradients change there."""
    parts = max(round(motion.period / FINE), 1)
    return np.interp(
        np.arange((motion.time.size - 1) * parts + 1) / parts,
        np.arange(motion.time.size),
        motion.time,
    )


def with_ratio(
    theta: FloatArray, covariance: FloatArray, expected: MassRatio
) -> tuple[FloatArray, FloatArray, MassRatio]:
    """Parameters (4,) and covariance (4, 4) once mass over inertia is expected to be something.

    Its source is the data if they determine it better than what was expected.
    """
    gain = covariance[:, 0] / (covariance[0, 0] + expected.std**2)
    updated = theta + gain * (expected.value - theta[0])
    left = covariance - np.outer(gain, covariance[0])
    by_data = covariance[0, 0] < expected.std**2
    source = "data" if by_data else expected.source
    return updated, left, MassRatio(float(updated[0]), float(np.sqrt(left[0, 0])), source)


def _check_windows(motion: Motion, windows: Windows) -> None:
    total = float(windows.duration.sum())
    if total < LEAST_COASTING:
        raise NotIdentifiableError(
            f"trip '{motion.trip}': coasts for {total:.0f} s that can be used,"
            f" {LEAST_COASTING:.0f} s are needed",
            remedy="give a trip that coasts for longer, or more trips",
        )
    reach = float(np.ptp(windows.mean_speed))
    if reach < SHORTEST_RANGE:
        at = float(np.mean(windows.mean_speed))
        raise NotIdentifiableError(
            f"trip '{motion.trip}': coasts at one speed only, {KMH * at:.0f} km/h within"
            f" {KMH * reach:.0f} km/h",
            remedy="give coasting from high speed down to low speed, or several speeds",
        )


def _outlier_segment(
    segments: tuple[Segment, ...], windows: Windows, regression: WindowFit
) -> int | None:
    """The segment that contradicts the others most, if any does beyond chance."""
    if len(segments) < 3:
        return None
    middle = 0.5 * (windows.start + windows.end)[regression.kept]
    starts = np.array([segment.start for segment in segments])
    owner = np.searchsorted(starts, middle, side="right") - 1
    total = np.bincount(owner, regression.residual, minlength=len(segments))
    count = np.maximum(np.bincount(owner, minlength=len(segments)), 1)
    z = np.abs(total) / np.sqrt(count * regression.cluster_factor)
    return int(np.argmax(z)) if z.max() > OUTLIER_SEGMENT else None


def _result(
    motion: Motion,
    segments: tuple[Segment, ...],
    outlier_segments: tuple[Segment, ...],
    windows: Windows,
    regression: WindowFit,
    expected: MassRatio,
) -> TripCoastDown:
    theta, covariance = _acceleration_form(regression)
    covariance = covariance + _misjudged(segments, windows, regression, covariance)
    effect = theta * np.append(1.0, 1.0 - np.arange(theta.size - 1)) * motion.scale.std
    free = theta, covariance + np.outer(effect, effect)
    theta, covariance, ratio = with_ratio(*free, expected)
    used = windows.select(regression.kept)
    covered = (float(used.mean_speed.min()), float(used.mean_speed.max()))
    residual = regression.residual
    return TripCoastDown(
        trip=motion.trip,
        motion=motion,
        curve=Curve(theta, covariance, regression.freedom, covered),
        ratio=ratio,
        free=free,
        segments=segments,
        outlier_segments=outlier_segments,
        coasted=float(sum(segment.duration for segment in segments)),
        windows={"used": used.count, "outlier": int(np.sum(~regression.kept))},
        noise=dict(zip(("speed", "gradient", "position"), regression.noise.sizes[:3], strict=True)),
        cluster_factor=regression.cluster_factor,
        residual_std=float(np.sqrt(residual @ residual / max(residual.size - theta.size, 1))),
        scale=motion.scale,
        source=motion.source,
        points=regression.points(windows),
    )


def _misjudged(
    segments: tuple[Segment, ...], windows: Windows, regression: WindowFit, covariance: FloatArray
) -> FloatArray:
    """Covariance (4, 4) that efforts bring in which were taken for coasting.

    With the probability that a segment was not coasting it carried the nearest level of effort, to
    either side: least squares gives what that does to the parameters.
    """
    used = windows.select(regression.kept)
    starts = np.array([segment.start for segment in segments])
    owner = np.searchsorted(starts, 0.5 * (used.start + used.end), side="right") - 1
    held = used.duration[:, None] * (owner[:, None] == np.arange(len(segments)))
    rows = NoiseParts.of(used, 1.0).whiten(regression.noise, np.column_stack([used.x, held]))
    terms = used.x.shape[1]
    moved = covariance @ rows[:, :terms].T @ rows[:, terms:] / regression.cluster_factor
    doubt = np.array([1.0 - segment.probability for segment in segments])
    return np.asarray((moved * doubt * SPACING**2) @ moved.T)


def _acceleration_form(regression: WindowFit) -> tuple[FloatArray, FloatArray]:
    """Mass over inertia and curve over inertia, with their covariance, from those over the mass."""
    inverse, curve = regression.beta[-1], np.arange(regression.beta.size - 1)
    theta = np.append(1.0, regression.beta[:-1]) / inverse
    jacobian = np.zeros((theta.size, theta.size))
    jacobian[:, -1] = -theta / inverse
    jacobian[1 + curve, curve] = 1.0 / inverse
    return theta, jacobian @ regression.covariance @ jacobian.T
