"""Slip of the powered axles: the train's speed while wheels slip, and a detector with hysteresis.

The momentum that efforts give to a train is known whether its wheels slip or not: what the motors
give and the wheels do not keep goes into the rail,
``M dv/dt = sum(T) - J d(sum w)/dt - brake - resistance``. So ``v - P/M``, with the impulse
``P = ∫(sum T - brake) dt - J sum w``, changes only by the running resistance and the gradient:
slowly, and the more surely the shorter a slip lasts. A linear-Gaussian model describes it as a line
with a wandering slope, smoothed over the trip.

A wheel shows the train's speed as far as its creep is small; its creep grows with the adhesion in
use and lasts, so it is no white noise and weighs little beside a satellite speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimators.interface import Estimator, EstimatorResult
from estimators.linear_gaussian import LinearGaussian, random_walk_slope
from trainlog.arrays import BoolArray, FloatArray
from trainlog.errors import InputError

SLOPE_RATE = 0.005
"""How fast what is not known of the efforts, over mass, may wander [m/s² per s^0.5], where the
friction brake is recorded: errors of resistance, gradient and mass are left."""

SLOPE_RATE_WITHOUT_BRAKE = 0.05
"""The same where the friction brake is not recorded and has to be found as well."""

CREEP_PER_ADHESION = 5.0
"""Creep speed over adhesion in use [m/s] that a wheel without slip may have, on wet rail; Zhao et
al. (2025), eq. (10)."""

CREEP_TIME = 5.0
"""Time over which creep stays the same [s]."""

HOLDING_GATE = 1.0
"""A wheel further than this from the expected train speed [m/s] is left out."""

HOLDING_STDS = 4.0
"""A wheel is left out only beyond this many standard deviations of the expected speed, too."""

UNKNOWN_SLOPE = 0.2
"""Standard deviation of what is not known of the efforts, over mass, at first [m/s²]."""

UNKNOWN_SPEED = 100.0
"""Standard deviation of the speed at first [m/s]."""

SLIP_THRESHOLD = 1.5
"""Slip speed [m/s] above which an axle is taken to slip, when the noise allows."""

NOISE_MULTIPLE = 5.0
"""The threshold is at least this many standard deviations of the slip speed."""

CONFIRMATION = 2
"""Samples in a row above the threshold before an axle is taken to slip."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SlipResult(EstimatorResult):
    """Slip after the samples so far.

    Attributes
    ----------
    estimate : (axles,) array [m/s]
        Slip speed of the last sample; NaN where it was missing.
    covariance : (axles, axles) array [m²/s²]
    slipping : (axles,) bool array
        Whether each axle slips now.
    valid : bool
        Whether every axle was seen often enough to confirm slip, and in the last sample.
    excitation : float
        One less the noise over the threshold where every axle was seen in the last sample, else 0.
    """

    slipping: BoolArray


class SlipDetector(Estimator):
    """Finds whether each axle slips: above the threshold twice running, until below half.

    Parameters
    ----------
    axles : int
    slip_std : float [m/s]
        Standard deviation of the slip speed; the threshold is
        ``max(1.5 m/s, 5 slip_std)``.

    Attributes
    ----------
    threshold : float [m/s]

    Raises
    ------
    InputError
        If there is no axle, or the noise is negative or no number.

    Examples
    --------
    >>> detector = SlipDetector(axles=2, slip_std=0.05)
    >>> detector.update([[0.1, 1.9], [0.0, 2.4]])  # two samples of both axles
    array([[False, False],
           [False,  True]])
    """

    kind, version = "trainlog/slip_detector", 2
    settings = ("axles", "slip_std")
    memory = ("above", "slipping", "seen", "last")

    def __init__(self, axles: int, slip_std: float) -> None:
        if axles < 1 or not 0.0 <= slip_std < np.inf:
            raise InputError(
                f"slip detector: needs axles and a noise of at least 0, got {axles}, {slip_std}"
            )
        self.threshold = max(SLIP_THRESHOLD, NOISE_MULTIPLE * slip_std)
        self._axles, self._slip_std = axles, float(slip_std)
        self.reset()

    def reset(self) -> None:
        """Forget everything: no axle slips."""
        self._above = np.zeros(self._axles, dtype=np.bool_)
        self._slipping = np.zeros(self._axles, dtype=np.bool_)
        self._seen = np.zeros(self._axles, dtype=np.int64)
        self._last = np.full(self._axles, np.nan)
        self._samples = 0
        self._resets += 1

    def update(self, slip_speed: ArrayLike) -> BoolArray:
        """Take one sample or the next samples in.

        Parameters
        ----------
        slip_speed : (n, axles) or (axles,) array [m/s]
            Wheel speed less train speed; NaN changes nothing.

        Returns
        -------
        (n, axles) bool array
            Whether the axle slips, as known at each sample: slip is confirmed one sample after
            the first above the threshold.

        Raises
        ------
        InputError
            If the shape does not fit the axles.
        """
        block = samples_of("slip speed", slip_speed, self._axles)
        found, self._above = _detect(block, self.threshold, self._above, self._slipping)
        if len(block):
            self._slipping = found[-1].copy()
            self._seen += np.count_nonzero(~np.isnan(block), axis=0)
            self._last = block[-1].copy()
            self._samples += len(block)
        return found

    def result(self) -> SlipResult:
        """Slip speed and slip of each axle now."""
        known = not np.any(np.isnan(self._last))
        return SlipResult(
            estimate=self._last.copy(),
            covariance=self._slip_std**2 * np.eye(self._axles),
            slipping=self._slipping.copy(),
            valid=known and bool(np.all(self._seen >= CONFIRMATION)),
            excitation=1.0 - self._slip_std / self.threshold if known else 0.0,
            samples=self._samples,
            resets=self._resets,
        )


def samples_of(what: str, values: ArrayLike, axles: int) -> FloatArray:
    """Samples of every axle, (n, axles), from a block or one sample; InputError if they do not fit.

    `what` is named in the message.
    """
    block = np.ascontiguousarray(values, dtype=np.float64)
    if block.shape == (axles,):
        block = block[None, :]
    if block.ndim != 2 or block.shape[1] != axles:
        raise InputError(f"{what}: needs shape (samples, {axles}), got {block.shape}")
    return block


def _detect(
    slip: FloatArray, threshold: float, above: BoolArray, slipping: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """Slip of each axle at each sample, (n, axles), and whether it was above the threshold last."""
    found, above = np.empty(slip.shape, dtype=np.bool_), above.copy()
    for axle in range(slip.shape[1]):
        known = np.flatnonzero(~np.isnan(slip[:, axle]))
        size = np.abs(slip[known, axle])
        high = np.concatenate((above[axle : axle + 1], size > threshold))
        begins, ends = high[1:] & high[:-1], size < 0.5 * threshold
        # The last beginning or end before each sample decides; before the first it is as it was.
        changes = np.concatenate(([0], known[begins | ends] + 1))
        states = np.concatenate((slipping[axle : axle + 1], begins[begins | ends]))
        at = np.searchsorted(changes, np.arange(1, len(slip) + 1), side="right") - 1
        found[:, axle] = states[at]
        above[axle] = high[-1]
    return found, above


@dataclass(frozen=True, slots=True)
class TrainSpeed:
    """Speed over ground and its standard deviation, (n,) arrays [m/s]."""

    speed: FloatArray
    std: FloatArray


def impulse(
    time: FloatArray,
    wheel_speed: FloatArray,
    wheel_effort: FloatArray,
    other_effort: FloatArray,
    rotating_mass: float,
) -> FloatArray:
    """Momentum that the efforts gave to the train since the first sample, less the axles' own.

    Parameters
    ----------
    time : (n,) array [s]
    wheel_speed, wheel_effort : (n, axles) array [m/s], [N]
        Without NaN.
    other_effort : (n,) array [N]
        Efforts on the train besides, negative in braking.
    rotating_mass : float [kg]
        Of one axle.

    Returns
    -------
    (n,) array [N s]

    Examples
    --------
    Half of the effort goes into the rail, half turns the wheel faster:

    >>> import numpy as np
    >>> impulse(np.array([0.0, 2.0]), np.array([[10.0], [14.0]]), np.full((2, 1), 8e3),
    ...         np.zeros(2), rotating_mass=2e3)
    array([   0., 8000.])
    """
    effort = wheel_effort.sum(axis=1) + other_effort
    given = np.concatenate(([0.0], np.cumsum(0.5 * (effort[1:] + effort[:-1]) * np.diff(time))))
    kept = rotating_mass * (wheel_speed - wheel_speed[0]).sum(axis=1)
    return np.asarray(given - kept)


def train_speed(
    time: FloatArray,
    wheel_speed: FloatArray,
    adhesion: FloatArray,
    wheel_std: float,
    gained: FloatArray,
    reference: FloatArray,
    reference_std: FloatArray,
    slope_rate: float = SLOPE_RATE,
) -> TrainSpeed:
    """Smoothed train speed.

    Parameters
    ----------
    time : (n,) array [s]
    wheel_speed : (n, axles) array [m/s]
        Corrected for the wheel diameters; NaN where missing.
    adhesion : (n, axles) array
        In use.
    wheel_std : float [m/s]
    gained : (n,) array [m/s]
        `impulse` over the train's mass.
    reference, reference_std : (n,) array [m/s]
        Satellite speed at the samples where there is one, else NaN.
    slope_rate : float [m/s^1.5]
        `SLOPE_RATE` or `SLOPE_RATE_WITHOUT_BRAKE`.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(0.0, 20.0, 0.1)  # s
    >>> speed = 5.0 + 0.3 * time  # m/s; both wheels slip for 2 s
    >>> wheels = np.column_stack([speed, speed]) + 3.0 * ((time > 8.0) & (time < 10.0))[:, None]
    >>> unknown = np.full(time.size, np.nan)
    >>> found = train_speed(time, wheels, 0.02 * np.ones(wheels.shape), 0.03, 0.3 * time,
    ...                     unknown, unknown)
    >>> print(f"{np.abs(found.speed - speed).max():.3f} m/s")
    0.000 m/s
    """
    if time.size == 0:
        return TrainSpeed(np.empty(0), np.empty(0))
    steps = np.diff(time, prepend=time[0])
    sampling = float(np.median(steps[1:])) if time.size > 1 else 1.0
    creep = wheel_std + CREEP_PER_ADHESION * np.abs(adhesion)
    known = np.column_stack([reference, wheel_speed]) - gained[:, None]
    variances = np.column_stack([reference_std, creep * np.sqrt(max(CREEP_TIME / sampling, 1.0))])
    variances **= 2
    known[np.isnan(variances)] = np.nan
    gate = np.tile([HOLDING_GATE, HOLDING_STDS], (known.shape[1], 1))
    gate[0] = np.inf
    row = np.tile([1.0, 0.0], (1, known.shape[1], 1))
    model = LinearGaussian(*random_walk_slope(steps, slope_rate), row, gate=gate)
    start = np.diag([UNKNOWN_SPEED**2, UNKNOWN_SLOPE**2])
    found = model.smooth(known, variances, np.zeros(2), start)
    return TrainSpeed(found.means[:, 0] + gained, found.std[:, 0])
