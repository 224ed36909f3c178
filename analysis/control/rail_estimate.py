"""What a traction controller knows of the rail under each axle: from a map, and learnt under way.

Zhao et al. (2025) take the rail for known. `RailEstimator` learns it from slip speeds and adhesion
in use: a hidden Markov model of the creep curve, of its maximum and of how its slip speeds are
stretched against those of `trainlog.railway.adhesion.creep_coefficients`. A map gives the maximum
that is likely before a wheel is there (`map_prior`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from analysis.control.cooperative import MultiMotorLocomotive, Tuning, adhesion_at
from estimators.adhesion import AdhesionObserver
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway.adhesion import creep_coefficients

MAXIMA = np.geomspace(0.03, 0.45, 48)
"""Maximum adhesion that is thought of."""

STRETCHES = 2.0 ** np.arange(-5.0, 1.01, 0.375)
"""Slip speeds of a rail over those of its like of the same maximum: measured curves peak at a tenth
of the slip speeds of the paper's, and before."""

STRETCH_STD = 1.0
"""Of the logarithm of the stretch, before anything is measured."""

SLIPS = np.geomspace(0.05, 8.0, 80)
"""Slip speeds of which one is sought [m/s]."""

MAP_SPREAD = 0.15
"""Of the logarithm of the maximum on one trip about the map's: passing spots, other wheels."""

OTHER_RAIL = 0.2
"""Probability that the rail is not as the map has it: any maximum is then as likely."""

GRID_STEP = float(np.log(MAXIMA[1] / MAXIMA[0]))

WANDERING = 0.01, 0.005
"""How far the logarithm of the maximum wanders: by way [1/m^0.5], and by time [1/s^0.5]. A rail
differs from place to place, and hardly while a train creeps over it: an estimate that wanders by
time alone follows the slip speed down at a slow start, ever further below the peak."""

ADHESION_RATE = 0.5
"""How fast adhesion in use may wander, for the observer [1/s^0.5]: a wheel meets a wet rail at
once."""

CHANGES = 0.04, 0.05
"""How often the rail is expected to become another one altogether: by way [1/m], by time [1/s]."""

MODEL_STD = 0.005, 0.05
"""Of what a creep curve gives: absolute, and relative to adhesion."""

FARTHEST = 300.0
"""Curves so many times e less likely than the likeliest have no probability."""

UNLIKELY = 1e-6
"""Curves of less probability do not count for the slip speed that is sought."""


@dataclass(frozen=True)
class RailEstimate:
    """What is known of the rail under each axle.

    Attributes
    ----------
    maximum : (n,) array
        Maximum adhesion, median.
    reference : (n,) array [m/s]
        Slip speed at which most adhesion is expected, whatever the rail may be.
    rail : (n, 3) array
        Mean creep curves, for the prediction.
    """

    maximum: FloatArray
    reference: FloatArray
    rail: FloatArray


class RailEstimator:
    """Creep curve under each axle, learnt sample by sample.

    The force between wheel and rail comes from `estimators.adhesion.AdhesionObserver`. What it
    says together with the slip speed is compared with many creep curves; on its way the rail
    wanders a little, and at times becomes any other. Far below the peak the maximum is known
    by little but the rise of the curves.

    The reference is where most adhesion is expected over all curves that are still possible, not
    the peak of the likeliest one: beyond the peak of a rail that is unlike its maximum suggests,
    both a rail that gives little and a steep one explain what is seen, and only less slip decides.

    Parameters
    ----------
    locomotive : MultiMotorLocomotive
    tuning : Tuning
    speed_std, wheel_speed_std : float [m/s]
        Noise of the train speed and of the wheel speeds.
    """

    def __init__(
        self,
        locomotive: MultiMotorLocomotive,
        tuning: Tuning,
        speed_std: float,
        wheel_speed_std: float,
    ) -> None:
        self._locomotive, self._period = locomotive, tuning.period
        load = float(locomotive.loads.mean())
        self._observer = AdhesionObserver(
            locomotive.axles, locomotive.rotating_mass, wheel_speed_std, ADHESION_RATE * load
        )
        # Slip is the mean of two samples, so its noise is that of one over the root of two.
        self._slip_variance = 0.5 * (speed_std**2 + wheel_speed_std**2)
        curves = np.repeat(creep_coefficients(MAXIMA)[:, None], STRETCHES.size, axis=1)
        curves[..., :2] /= STRETCHES[:, None]
        self._curves = curves.reshape(-1, 3)
        self._expected = adhesion_at(SLIPS, self._curves[:, None])
        likely = np.exp(-0.5 * (np.log(STRETCHES) / STRETCH_STD) ** 2)
        self._stretches = likely / likely.sum()
        self._prior = self._joint(np.full((locomotive.axles, MAXIMA.size), 1.0 / MAXIMA.size))
        self._probability = self._prior.copy()
        self._slip: FloatArray | None = None
        self._mapped: FloatArray | None = None
        self._time = 0.0

    def _joint(self, maxima: FloatArray) -> FloatArray:
        """Probability of maximum and stretch from that of the maximum, (n, maxima, stretches)."""
        return np.ascontiguousarray(maxima[:, :, None] * self._stretches)

    def expect(self, log_mean: ArrayLike, log_std: ArrayLike) -> None:
        """Take over what a map makes likely where the axles are now.

        What was learnt is kept relative to the map: where its maximum rises, that of the rail is
        expected to rise.

        Parameters
        ----------
        log_mean, log_std : (n,) arrays
            Of the logarithm of the maximum adhesion.
        """
        mean = np.asarray(log_mean, dtype=np.float64)
        if self._mapped is None:
            self._probability = self._joint(map_prior(mean, log_std))
        else:
            moved = (mean - self._mapped) / GRID_STEP
            if np.any(moved):
                shift_maxima(self._probability, moved)
        if self._mapped is None or np.any(mean != self._mapped):
            self._prior = self._joint(map_prior(mean, log_std))
        self._mapped = mean.copy()

    def forget(self) -> None:
        """Begin anew from the map, as after coasting, when nothing is learnt of the rail."""
        self._observer.reset()
        self._probability = self._prior.copy()
        self._slip, self._time = None, 0.0

    def update(
        self,
        speed: float,
        wheel_speeds: ArrayLike,
        torques: ArrayLike,
        direction: float = 1.0,
    ) -> RailEstimate:
        """Take a sample in.

        Parameters
        ----------
        speed : float [m/s]
            Of the train.
        wheel_speeds : (n,) array [m/s]
        torques : (n,) array [N m]
            At work now, changing evenly since the last sample; positive also in braking.
        direction : float
            -1 in braking.

        Raises
        ------
        InputError
            If shapes do not fit.
        """
        wheels = np.asarray(wheel_speeds, dtype=np.float64)
        effort = direction * self._locomotive.effort_per_torque * np.asarray(torques, dtype=float)
        slip, last = direction * (wheels - speed), self._slip
        force = self._observer.update(self._time, wheels, effort)
        adhesion = direction * force.force[-1] / self._locomotive.loads
        if last is not None:
            noise = force.std[-1] / self._locomotive.loads
            bayes_update(
                self._probability, self._prior, self._moves(speed), self._curves,
                0.5 * (slip + last), adhesion, noise, self._slip_variance,
            )  # fmt: skip
        self._slip, self._time = slip, self._time + self._period
        return self.estimate()

    def _moves(self, speed: float) -> tuple[float, float]:
        """Probabilities that the maximum is the next one of the grid, and that it is any other."""
        way = abs(float(speed)) * self._period
        variance = WANDERING[0] ** 2 * way + WANDERING[1] ** 2 * self._period
        changed = CHANGES[0] * way + CHANGES[1] * self._period
        return min(0.5 * variance / GRID_STEP**2, 0.25), min(changed, 0.5)

    def estimate(self) -> RailEstimate:
        """What is known now."""
        summed = np.cumsum(self._probability.sum(axis=2), axis=1)
        middle = MAXIMA[np.minimum((summed < 0.5).sum(axis=1), MAXIMA.size - 1)]
        flat = self._probability.reshape(self._locomotive.axles, -1)
        reference = SLIPS[highest_mean(flat, self._expected)]
        # The likeliest curve jumps from sample to sample, and the torques with it.
        rail = creep_coefficients(np.exp(self._probability.sum(axis=2) @ np.log(MAXIMA)))
        rail[:, :2] /= np.exp(self._probability.sum(axis=1) @ np.log(STRETCHES))[:, None]
        return RailEstimate(middle, reference, rail)


def map_prior(log_mean: ArrayLike, log_std: ArrayLike) -> FloatArray:
    """Probability of each of `MAXIMA` where a map gives the maximum adhesion, (n, maxima).

    Parameters
    ----------
    log_mean, log_std : (n,) arrays
        Of its logarithm.

    Raises
    ------
    InputError
        If a mean is no number, or a deviation is negative.

    Examples
    --------
    >>> likely = map_prior([np.log(0.15)], [0.1])
    >>> bool(abs(MAXIMA[likely[0].argmax()] - 0.15) < 0.005), round(float(likely.sum()), 6)
    (True, 1.0)
    """
    mean = np.atleast_1d(np.asarray(log_mean, dtype=np.float64))
    std = np.atleast_1d(np.asarray(log_std, dtype=np.float64))
    if not (np.all(np.isfinite(mean)) and np.all(std >= 0.0)):
        raise InputError(
            "rail estimator: the map gives no number for a maximum adhesion",
            remedy="update the map with trips on this line",
        )
    spread = np.hypot(np.where(np.isfinite(std), std, 10.0), MAP_SPREAD)[:, None]
    found = np.exp(-0.5 * ((np.log(MAXIMA) - mean[:, None]) / spread) ** 2) + 1e-300
    found /= found.sum(axis=1, keepdims=True)
    return np.asarray((1.0 - OTHER_RAIL) * found + OTHER_RAIL / MAXIMA.size)


@njit(cache=True)
def shift_maxima(probability, moved):  # type: ignore[no-untyped-def]
    """Move the probability of each axle along the maxima by so many steps of their grid."""
    axles, size, stretches = probability.shape
    before = np.empty(size)
    for i in range(axles):
        if moved[i] == 0.0:
            continue
        for k in range(stretches):
            for m in range(size):
                before[m] = probability[i, m, k]
                probability[i, m, k] = 0.0
            for m in range(size):
                to = min(max(m + moved[i], 0.0), size - 1.0)
                low = int(to)
                part = to - low
                probability[i, low, k] += (1.0 - part) * before[m]
                probability[i, min(low + 1, size - 1), k] += part * before[m]


@njit(cache=True)
def bayes_update(probability, prior, moves, curves, slip, adhesion, noise, slip_variance):  # type: ignore[no-untyped-def]
    """Bayes' rule on the grid, in place: the rail's diffusion, then the measurement's likelihood.

    Parameters
    ----------
    probability, prior : (n, maxima, stretches) arrays
    moves : tuple of float
        Probabilities that the maximum is each neighbouring one, and that it is any other.
    curves : (maxima * stretches, 3) array
    slip, adhesion, noise : (n,) arrays
        Slip speed [m/s], adhesion in use and its standard deviation.
    slip_variance : float [m²/s²]
    """
    axles, size, stretches = probability.shape
    absolute, relative = MODEL_STD
    near, change = moves
    missed, spread = np.empty((size, stretches)), np.empty((size, stretches))
    for i in range(axles):
        x = abs(slip[i])
        sign = 1.0 if slip[i] >= 0.0 else -1.0
        least = np.inf
        for m in range(size):
            for k in range(stretches):
                a, b, c = curves[m * stretches + k]
                one, other = c * np.exp(-a * x), c * np.exp(-b * x)
                expected, slope = sign * (one - other), b * other - a * one
                variance = (
                    noise[i] ** 2 + absolute**2 + (relative * expected) ** 2
                    + slope * slope * slip_variance
                )  # fmt: skip
                error = adhesion[i] - expected
                missed[m, k], spread[m, k] = 0.5 * error * error / variance, np.sqrt(variance)
                least = min(least, missed[m, k])
        total = 0.0
        for k in range(stretches):
            before = probability[i, 0, k]
            for m in range(size):
                here, after = probability[i, m, k], probability[i, min(m + 1, size - 1), k]
                mixed = (1.0 - 2.0 * near) * here + near * (before + after)
                mixed = (1.0 - change) * mixed + change * prior[i, m, k]
                before = here
                beyond = missed[m, k] - least
                likely = np.exp(-beyond) / spread[m, k] if beyond < FARTHEST else 0.0
                probability[i, m, k] = mixed * likely
                total += probability[i, m, k]
        for m in range(size):
            for k in range(stretches):
                probability[i, m, k] /= total


@njit(cache=True)
def highest_mean(probability, curves):  # type: ignore[no-untyped-def]
    """Where the mean of many curves under the probability of each is highest, (n,) indices.

    Most have none; and the product of the matrices would be given to threads, which on a machine
    with other work wait longer than they compute.
    """
    axles, count = probability.shape
    found = np.empty(axles, dtype=np.int64)
    mean = np.empty(curves.shape[1])
    for i in range(axles):
        mean[:] = 0.0
        for k in range(count):
            p = probability[i, k]
            if p > UNLIKELY:
                for j in range(mean.size):
                    mean[j] += p * curves[k, j]
        found[i] = np.argmax(mean)
    return found
