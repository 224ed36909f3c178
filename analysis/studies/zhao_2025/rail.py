"""What a controller knows of the rail under each axle: learnt under way, mapped or assumed.

Zhao et al. (2025) take the rail for known. `RailEstimator` learns it from slip speeds and adhesion
in use: a hidden Markov model of the creep curve, of its maximum and of how its slip speeds are
stretched against those of `trainlog.railway.adhesion.creep_coefficients`. A map gives it ahead:
`rail_ahead`. Speeds are then measured with noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.control.cooperative import Tuning, coefficients
from analysis.control.multi_motor import MultiMotorLocomotive
from analysis.studies.zhao_2025.simulation import (
    AXLES,
    CASES,
    SCARCE,
    SENSIBLE,
    AssumedRail,
    Case,
    KnownRail,
    Measurement,
    Noise,
    Preset,
    RailSource,
    Run,
    creep_maximum,
    run,
)
from estimators.adhesion import AdhesionObserver
from trainlog.errors import InputError
from trainlog.railway import StepProfile
from trainlog.railway.adhesion import DRY, WET, CreepCurve, creep_coefficients

FloatArray = NDArray[np.float64]

MAXIMA = np.geomspace(0.03, 0.45, 48)
"""Maximum adhesion that is thought of."""

STRETCHES = 2.0 ** np.arange(-2.5, 1.01, 0.25)
"""Slip speeds of a rail over those of its like of the same maximum."""

STRETCH_STD = 0.5
"""Of the logarithm of the stretch, before anything is measured."""

SLIPS = np.linspace(0.05, 8.0, 160)
"""Slip speeds of which one is sought [m/s]."""

DIFFUSION = 0.05
"""Share of the probability that moves to each neighbouring maximum from sample to sample."""

ADHESION_RATE = 0.5
"""How fast adhesion in use may wander, for the observer [1/s^0.5]: a wheel meets a wet rail at
once."""

CHANGE_RATE = 0.5
"""How often the rail is expected to become another one altogether [1/s]."""

MODEL_STD = 0.005, 0.05
"""Of what a creep curve gives: absolute, and relative to adhesion."""

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
    both a rail that gives little and a steep one explain what is seen, and only less slip decides.

    Parameters
    ----------
    locomotive : MultiMotorLocomotive
    tuning : Tuning
    speed_std, wheel_speed_std : float [m/s]
        Noise of the train speed and of the wheel speeds.

    Raises
    ------
    InputError
        If a noise is negative.
    """

    def __init__(
        self,
        locomotive: MultiMotorLocomotive,
        tuning: Tuning,
        speed_std: float,
        wheel_speed_std: float,
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
        self._probability = np.tile(self._prior, (locomotive.axles, 1, 1))
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
            self._bayes_update(0.5 * (slip + last), adhesion, noise)
        self._slip, self._time = slip, self._time + self._period
        return self._estimate(adhesion)

    def _bayes_update(self, slip: FloatArray, adhesion: FloatArray, noise: FloatArray) -> None:
        """Bayes' rule on the grid: the rail's diffusion, then the measurement's likelihood."""
        ends = self._probability[:, :1], self._probability, self._probability[:, -1:]
        padded = np.concatenate(ends, axis=1)
        probability = (1.0 - 2.0 * DIFFUSION) * self._probability
        probability += DIFFUSION * (padded[:, :-2] + padded[:, 2:])
        change = CHANGE_RATE * self._period
        probability = (1.0 - change) * probability + change * self._prior
        expected = _creep(slip[:, None], self._curves)
        slope = (_creep(slip[:, None] + SLOPE_STEP, self._curves) - expected) / SLOPE_STEP
        absolute, relative = MODEL_STD
        variance = (
            noise[:, None] ** 2 + absolute**2 + (relative * expected) ** 2
            + slope**2 * self._slip_variance
        )  # fmt: skip
        logarithm = -0.5 * ((adhesion[:, None] - expected) ** 2 / variance + np.log(variance))
        logarithm -= logarithm.max(axis=1, keepdims=True)
        probability = probability * np.exp(logarithm).reshape(probability.shape)
        self._probability = probability / probability.sum(axis=(1, 2), keepdims=True)

    def _estimate(self, adhesion: FloatArray) -> RailEstimate:
        summed = np.cumsum(self._probability.sum(axis=2), axis=1)
        low, middle, high = (
            MAXIMA[np.minimum((summed < level).sum(axis=1), MAXIMA.size - 1)]
            for level in (0.16, 0.5, 0.84)
        )
        flat = self._probability.reshape(adhesion.size, -1)
        reference = SLIPS[np.argmax(flat @ self._expected, axis=1)]
        # The likeliest curve jumps from sample to sample, and the torques with it.
        rail = creep_coefficients(np.exp(self._probability.sum(axis=2) @ np.log(MAXIMA)))
        rail[:, :2] /= np.exp(self._probability.sum(axis=1) @ np.log(STRETCHES))[:, None]
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


# ---- from where the rail is known ----------------------------------------------------------------

MEASURED = Noise(speed=0.05, wheel_speed=0.02)
"""A radar or satellites for the train speed, a pulse encoder for each wheel [m/s]."""

LEAVES = Case(
    number=5,
    name="leaves on the rail, here and there",
    wet=(),
    fails=False,
    published="",
    places=StepProfile(
        np.array([0.0, 25.0, 37.0, 60.0, 66.0, 90.0, 115.0, 140.0, 152.0]),
        np.array([DRY.peak, 0.10, DRY.peak, 0.08, DRY.peak, 0.12, DRY.peak, 0.08, DRY.peak]),
    ),
)
"""Patches of which some are shorter than the locomotive; not of the paper."""


STEEP = replace(
    CASES[2],
    number=6,
    name="axles 3 and 4 dry, another wet, dry",
    published="",
    wet_curve=CreepCurve(a=0.8, b=3.5, c=0.2935, d=0.2935),
)
"""Case 3 on a wet rail whose peak lies at 0.55 m/s instead of 3 m/s; not of the paper."""


@dataclass
class LearntRail:
    """The rail is learnt while driving."""

    estimator: RailEstimator

    def rail(self, measured: Measurement) -> AssumedRail:
        """What was learnt up to the sample."""
        found = self.estimator.update(measured.speed, measured.wheel_speeds, measured.torques)
        return AssumedRail(found.rail, found.maximum, found.reference)


@dataclass(frozen=True)
class MappedRail:
    """A map gives the maximum adhesion ahead."""

    maximum_adhesion: StepProfile
    preset: Preset

    def rail(self, measured: Measurement) -> AssumedRail:
        """The map's rail over the horizon."""
        tuning = self.preset.tuning
        ahead = rail_ahead(self.maximum_adhesion, measured.position, measured.speed, AXLES, tuning)
        return AssumedRail(ahead, creep_maximum(*ahead[0].T))


@dataclass(frozen=True)
class UniformRail:
    """The rail is taken for one and the same everywhere."""

    curve: CreepCurve

    def rail(self, measured: Measurement) -> AssumedRail:
        """That rail under every axle."""
        del measured
        return AssumedRail(coefficients([self.curve] * 4), np.full(4, self.curve.peak))


def mapped(case: Case, preset: Preset) -> RailSource:
    """The rail of a case from a map.

    Raises
    ------
    InputError
        If the rail of the case changes with time: no map holds that.
    """
    if case.places is None:
        raise InputError(f"case {case.number}: its rail changes with time, no map holds that")
    return MappedRail(case.places, preset)


RAIL_SOURCES: dict[str, Callable[[Case, Preset], RailSource]] = {
    "known": lambda case, _: KnownRail(case),
    "map": mapped,
    "learnt": lambda _, preset: LearntRail(
        RailEstimator(preset.locomotive, preset.tuning, MEASURED.speed, MEASURED.wheel_speed)
    ),
    "taken for dry": lambda *_: UniformRail(DRY),
    "taken for wet": lambda *_: UniformRail(WET),
}
"""From where a controller may know the rail, by name."""

UNKNOWN = (CASES[0], CASES[1], LEAVES, STEEP)
"""Cases in which the rail is not known."""

ASKED = (SENSIBLE.locomotive.total_torque, SCARCE)
"""Of all motors together [N m]."""


def by_knowledge(name: str, seed: int) -> list[Run | None]:
    """The cases with 85 t and speeds that are measured, by what is known of the rail.

    Parameters
    ----------
    name : str
        One of `RAIL_SOURCES`.
    seed : int
        Of the noise.

    Returns
    -------
    list of Run or None
        None where no map can hold the rail.
    """
    return [driven(name, case, total, seed) for total in ASKED for case in UNKNOWN]


def driven(name: str, case: Case, total: float, seed: int) -> Run | None:
    """One run with 85 t and one way to know the rail; see `by_knowledge`."""
    if name == "map" and case.places is None:
        return None
    known = RAIL_SOURCES[name](case, SENSIBLE)
    return run(case, SENSIBLE, total, knowledge=known, noise=MEASURED, seed=seed)
