"""What a controller knows of the rail under each axle while it drives.

`RailEstimator` learns it from slip speeds and adhesion in use: a hidden Markov model of the creep
curve, of its maximum and of how its slip speeds are stretched against those of
`trainlog.railway.adhesion.creep_coefficients`. A map of the rail tells it ahead: `rail_ahead`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.studies.zhao_2025.controller import Locomotive, Tuning
from estimators.adhesion import AdhesionObserver
from trainlog.errors import InputError
from trainlog.railway import StepProfile
from trainlog.railway.adhesion import creep_coefficients

FloatArray = NDArray[np.float64]

MAXIMA = np.geomspace(0.03, 0.45, 48)
"""Maximum adhesion that is thought of."""

STRETCHES = 2.0 ** np.arange(-2.5, 1.01, 0.25)
"""Slip speeds of a rail over those of its like of the same maximum."""

STRETCH_STD = 0.5
"""Of the logarithm of the stretch, before anything is seen."""

SLIPS = np.linspace(0.05, 8.0, 160)
"""Slip speeds of which one is sought [m/s]."""

WANDER = 0.05
"""Share of the belief that moves to each neighbouring maximum from sample to sample."""

ADHESION_RATE = 0.5
"""How fast adhesion in use may wander, for the observer [1/s^0.5]: a wheel meets a wet rail at
once."""

CHANGE_RATE = 0.5
"""How often the rail is expected to become another one altogether [1/s]."""

MODEL_STD = 0.005, 0.05
"""Of what a creep curve tells: absolute, and relative to adhesion."""

SLOPE_STEP = 1e-3
"""For the slope of a creep curve [m/s]."""


@dataclass(frozen=True)
class RailEstimate:
    """What is known of the rail under each axle.

    Attributes
    ----------
    maximum : (n,) array
        Maximum adhesion, median.
    low, high : (n,) arrays
        Between which it lies with a probability of 0.68.
    reference : (n,) array [m/s]
        Slip speed at which most adhesion is expected, whatever the rail may be.
    rail : (n, 3) array
        Mean creep curves, for the prediction; see `CooperativeController.demand`.
    adhesion : (n,) array
        In use.
    """

    maximum: FloatArray
    low: FloatArray
    high: FloatArray
    reference: FloatArray
    rail: FloatArray
    adhesion: FloatArray


class RailEstimator:
    """Creep curve under each axle, learnt sample by sample.

    The force between wheel and rail comes from `estimators.adhesion.AdhesionObserver`. What it
    says together with the slip speed is compared with many creep curves; from sample to sample the
    rail wanders a little, and at times becomes any other. Far below the peak the maximum is known
    by little but the rise of the curves: `low` and `high` are then far apart.

    The reference is where most adhesion is expected over all curves that are still possible, not
    the peak of the likeliest one: beyond the peak of a rail that is unlike its maximum suggests,
    both a rail that gives little and a steep one explain what is seen, and only less slip tells.

    Parameters
    ----------
    locomotive : Locomotive
    tuning : Tuning
    speed_std, wheel_speed_std : float [m/s]
        Noise of the train speed and of the wheel speeds.

    Raises
    ------
    InputError
        If a noise is negative.
    """

    def __init__(
        self, locomotive: Locomotive, tuning: Tuning, speed_std: float, wheel_speed_std: float
    ) -> None:
        if not speed_std >= 0.0:
            raise InputError(f"rail estimator: noise of the speed {speed_std} m/s is negative")
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
        self._expected = _creep(SLIPS, self._curves[:, None])
        likely = np.exp(-0.5 * (np.log(STRETCHES) / STRETCH_STD) ** 2)
        self._prior = np.tile(likely / (MAXIMA.size * likely.sum()), (MAXIMA.size, 1))
        self._belief = np.tile(self._prior, (locomotive.axles, 1, 1))
        self._slip: FloatArray | None = None
        self._time = 0.0

    def update(self, speed: float, wheel_speeds: ArrayLike, torques: ArrayLike) -> RailEstimate:
        """Take a sample in.

        Parameters
        ----------
        speed : float [m/s]
            Of the train.
        wheel_speeds : (n,) array [m/s]
        torques : (n,) array [N m]
            At work since the last sample.

        Raises
        ------
        InputError
            If shapes do not fit.
        """
        wheels = np.asarray(wheel_speeds, dtype=np.float64)
        effort = self._locomotive.effort_per_torque * np.asarray(torques, dtype=np.float64)
        slip, last = wheels - speed, self._slip
        if last is not None:
            # The torque is held between two samples, which the observer takes for linear.
            start = self._time - self._period * (1.0 - 1e-6)
            self._observer.update(start, np.full(wheels.size, np.nan), effort)
        force = self._observer.update(self._time, wheels, effort)
        adhesion = force.force[-1] / self._locomotive.loads
        if last is not None:
            noise = force.std[-1] / self._locomotive.loads
            self._weigh(0.5 * (slip + last), adhesion, noise)
        self._slip, self._time = slip, self._time + self._period
        return self._estimate(adhesion)

    def _weigh(self, slip: FloatArray, adhesion: FloatArray, noise: FloatArray) -> None:
        """Let the rail wander, then weigh every curve by what was seen."""
        ends = self._belief[:, :1], self._belief, self._belief[:, -1:]
        padded = np.concatenate(ends, axis=1)
        belief = (1.0 - 2.0 * WANDER) * self._belief
        belief += WANDER * (padded[:, :-2] + padded[:, 2:])
        change = CHANGE_RATE * self._period
        belief = (1.0 - change) * belief + change * self._prior
        told = _creep(slip[:, None], self._curves)
        slope = (_creep(slip[:, None] + SLOPE_STEP, self._curves) - told) / SLOPE_STEP
        absolute, relative = MODEL_STD
        variance = (
            noise[:, None] ** 2 + absolute**2 + (relative * told) ** 2
            + slope**2 * self._slip_variance
        )  # fmt: skip
        logarithm = -0.5 * ((adhesion[:, None] - told) ** 2 / variance + np.log(variance))
        logarithm -= logarithm.max(axis=1, keepdims=True)
        belief = belief * np.exp(logarithm).reshape(belief.shape)
        self._belief = belief / belief.sum(axis=(1, 2), keepdims=True)

    def _estimate(self, adhesion: FloatArray) -> RailEstimate:
        summed = np.cumsum(self._belief.sum(axis=2), axis=1)
        low, middle, high = (
            MAXIMA[np.minimum((summed < level).sum(axis=1), MAXIMA.size - 1)]
            for level in (0.16, 0.5, 0.84)
        )
        flat = self._belief.reshape(adhesion.size, -1)
        reference = SLIPS[np.argmax(flat @ self._expected, axis=1)]
        # The likeliest curve jumps from sample to sample, and the torques with it.
        rail = creep_coefficients(np.exp(self._belief.sum(axis=2) @ np.log(MAXIMA)))
        rail[:, :2] /= np.exp(self._belief.sum(axis=1) @ np.log(STRETCHES))[:, None]
        return RailEstimate(middle, low, high, reference, rail, adhesion)


def rail_ahead(
    maximum_adhesion: StepProfile, position: float, speed: float, axles: ArrayLike, tuning: Tuning
) -> FloatArray:
    """Creep curves under each axle over the horizon, from a map; (horizon, n, 3) array.

    Parameters
    ----------
    maximum_adhesion : StepProfile
        By chainage in the direction of travel.
    position, speed : float [m], [m/s]
        Of the train's front.
    axles : (n,) array [m]
        How far behind the front each axle is.
    tuning : Tuning
    """
    middles = tuning.period * (np.arange(tuning.horizon) + 0.5)
    places = position + speed * middles[:, None] - np.asarray(axles, dtype=np.float64)
    return creep_coefficients(maximum_adhesion(np.maximum(places, 0.0)))


def _creep(slip: FloatArray, curves: FloatArray) -> FloatArray:
    """Adhesion at slip speeds [m/s] on curves that broadcast with them."""
    a, b, c = np.moveaxis(curves, -1, 0)
    size = np.abs(slip)
    return np.asarray(np.sign(slip) * c * (np.exp(-a * size) - np.exp(-b * size)))
