"""Running resistance and mass while the train runs: an extended Kalman filter.

The equation of motion of a train of mass m whose rotating parts weigh M_r more,

    (m + M_r) dv/dt = F - m (a_track(s) + d) - r0 - r1 v - r2 v²,

is divided by m, so that with ``q = m_0/m`` it is linear in all that is unknown but the speed. The
state is the speed v, the grade offset d of the piece of the gradient profile that the train is on
(what the map tells wrongly there, as a deceleration), q, and r0/m, r1/m, r2/m in units of like
size. The measured speed is the only measurement: it is never differenced.

- A new piece of the gradient profile has a new, random offset: d returns to its prior there.
- Changes of gradient lie some metres from where the map puts them. What that adds to the speed is
  noise of the motion, as large as the change is steep and the train slow, while it passes.
- Where the force is not known (friction braking, slip), nothing but the speed is estimated.

The covariance is kept as ``U D Uᵀ``, with the speed first and the offset second. Then the motion
touches the first row of U only, and noise of the speed is added to the first entry of D: both
exactly, so that the covariance stays positive definite whatever the data.

References
----------
Bierman, G. J. (1977), Factorization Methods for Discrete Sequential Estimation, ch. V: the
measurement update. Jazwinski, A. H. (1970), Stochastic Processes and Filtering Theory, ch. 8: the
extended filter. Paper 004, eqs. (2), (21): the equation of motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.interface import (
    CALIBRATED,
    array_of,
    check_state,
    count_of,
    saved_state,
)
from estimators.running_resistance_recursion import UNIT_SPEED, run_block
from trainlog.errors import InputError
from trainlog.railway.resistance import RunningResistance
from trainlog.units import GRAVITY

FloatArray = NDArray[np.float64]

STATE_FORMAT = "trainlog/running-resistance"
STATE_VERSION = 1
"""Raised when the meaning of a saved state changes."""

NO_SPEED_STD = 50.0
"""Standard deviation of the speed [m/s] before the first sample."""

LARGEST_STD = 0.10
"""Standard deviation of the curve, over the curve, beyond which it is not valid."""


@dataclass(frozen=True, eq=False)
class RunningResistanceResult:
    """What is known after the samples so far.

    Attributes
    ----------
    estimate : (4,) array
        r0 [N], r1 [N/(m/s)], r2 [N/(m/s)²] and mass [kg].
    covariance : (4, 4) array
    valid : bool
        Whether the data tell the curve to a tenth of itself at all speeds asked for.
    excitation : float
        Share of the curve's standard deviation before the first sample that the data removed, at
        the speed asked for that they tell least about.
    curve_share : float
        Largest standard deviation of the curve over the curve, at the speeds asked for.
    speed, grade_offset : float [m/s], [1]
        Now; the offset is true gradient less that of the map.
    samples, left_out, resets : int
        Samples since the last full reset, those of them that were left out as outliers, and full
        resets so far.
    """

    estimate: FloatArray
    covariance: FloatArray
    valid: bool
    excitation: float
    curve_share: float
    speed: float
    grade_offset: float
    samples: int
    left_out: int
    resets: int

    @property
    def resistance(self) -> RunningResistance:
        """The curve."""
        return RunningResistance(*self.estimate[:3].tolist())


@dataclass(frozen=True, eq=False)
class RunningResistanceTrack:
    """What was known after each sample.

    Attributes
    ----------
    estimate : (n, 4) array
        r0 [N], r1 [N/(m/s)], r2 [N/(m/s)²] and mass [kg].
    resistance, resistance_std : (n,) array [N]
        Of the curve at the present speed.
    grade_offset : (n,) array [1]
    innovation, innovation_std : (n,) array [m/s]
        Measured less expected speed; NaN where none was measured.
    """

    estimate: FloatArray
    resistance: FloatArray
    resistance_std: FloatArray
    grade_offset: FloatArray
    innovation: FloatArray
    innovation_std: FloatArray


class RunningResistanceFilter:
    """Extended Kalman filter over speed, grade offset, mass and running resistance.

    Parameters
    ----------
    mass, mass_std : float [kg]
        Loaded, without the rotating part; what is known beforehand.
    resistance : RunningResistance
        What is known beforehand, of the train's file, say.
    resistance_std : (3,) array, optional
        Of r0, r1, r2; default as large as `resistance` itself: a weak prior.
    speeds : (float, float) [m/s]
        Between which the curve is asked for.
    rotating_mass : float [kg]
    speed_std : float [m/s]
        White noise of the measured speed, its resolution included.
    gradient_std : float
        Of the map's gradient on one piece of the profile.
    chainage_std : float [m]
        Of the place of a change of gradient.
    reach : float [m]
        To either side of the train over which the samples' `track_slope` was taken.

    Attributes
    ----------
    x : (6,) array
        Speed [m/s], grade offset as a deceleration [m/s²], expected mass over mass, and r0/m,
        r1/m, r2/m [m/s²] at `UNIT_SPEED`.
    P : (6, 6) array
        Its covariance.

    Raises
    ------
    InputError
        If a parameter is not positive.
    """

    def __init__(
        self,
        mass: float,
        mass_std: float,
        resistance: RunningResistance,
        resistance_std: ArrayLike | None = None,
        *,
        speeds: tuple[float, float],
        rotating_mass: float = 0.0,
        speed_std: float = 0.03,
        gradient_std: float = 0.5e-3,
        chainage_std: float = 10.0,
        reach: float = 10.0,
    ) -> None:
        drag = np.array([resistance.r0, resistance.r1, resistance.r2], dtype=np.float64)
        spread = np.abs(drag) if resistance_std is None else np.asarray(resistance_std, np.float64)
        if spread.shape != (3,):
            raise InputError("running resistance: needs a standard deviation of r0, r1 and r2 each")
        settings = np.array(
            [mass, mass_std, rotating_mass, speed_std, gradient_std, chainage_std, reach, *speeds],
            dtype=np.float64,
        )
        _check(settings, spread)
        self._settings = settings
        scale = UNIT_SPEED ** np.arange(3) / mass
        self._prior_mean = np.concatenate(([0.0, 0.0, 1.0], drag * scale))
        self._prior_std = np.concatenate(
            ([NO_SPEED_STD, GRAVITY * gradient_std, mass_std / mass], spread * scale)
        )
        self._resets = -1
        self.reset()

    def reset(self) -> None:
        """Forget all: mass and coefficients return to what is known beforehand."""
        self._mean = self._prior_mean.copy()
        self._upper = np.eye(6)
        self._diagonal = self._prior_std**2
        # Time, effort, track and its slope, section, usability and times left out in a row of the
        # last sample.
        self._last = np.array([np.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        self._counts = np.zeros(2, dtype=np.int64)
        self._resets += 1

    @property
    def x(self) -> FloatArray:
        """The state, (6,)."""
        return self._mean.copy()

    @property
    def P(self) -> FloatArray:  # noqa: N802 - filterpy's name
        """Its covariance, (6, 6)."""
        covariance: FloatArray = (self._upper * self._diagonal) @ self._upper.T
        return covariance

    def update(
        self,
        time: ArrayLike,
        speed: ArrayLike,
        effort: ArrayLike,
        track: ArrayLike,
        track_slope: ArrayLike = 0.0,
        section: ArrayLike = 0,
        usable: ArrayLike = True,
    ) -> None:
        """Learn from one sample or from a block of them.

        Parameters
        ----------
        time : (n,) array or float [s]
            Increasing, also from call to call.
        speed : (n,) array [m/s]
            Measured, true to scale; NaN where there is none.
        effort : (n,) array [N]
            Traction less braking less what tunnels add to the resistance.
        track : (n,) array [m/s²]
            Deceleration by gradient and curves as the map has it.
        track_slope : (n,) array [m/s² per m]
            How it changes with chainage, over `reach` to either side.
        section : (n,) int array
            Which piece of the gradient profile the train is on.
        usable : (n,) bool array
            False where the force is not known.

        Raises
        ------
        InputError
            If shapes do not fit, time does not increase, or a force that is called usable is not
            finite.
        """
        self._run(time, speed, effort, track, track_slope, section, usable, np.empty((0, 9)))

    def record(
        self,
        time: ArrayLike,
        speed: ArrayLike,
        effort: ArrayLike,
        track: ArrayLike,
        track_slope: ArrayLike = 0.0,
        section: ArrayLike = 0,
        usable: ArrayLike = True,
    ) -> RunningResistanceTrack:
        """`update`, telling what was known after each sample.

        Parameters and errors are those of `update`.
        """
        kept = np.empty((np.size(time), 9))
        self._run(time, speed, effort, track, track_slope, section, usable, kept)
        return RunningResistanceTrack(
            estimate=kept[:, :4].copy(),
            resistance=kept[:, 4].copy(),
            resistance_std=kept[:, 5].copy(),
            grade_offset=kept[:, 6].copy(),
            innovation=kept[:, 7].copy(),
            innovation_std=kept[:, 8].copy(),
        )

    def result(self) -> RunningResistanceResult:
        """The estimate with its covariance, validity and excitation."""
        estimate, covariance = _physical(self._mean, self.P, self._settings[0])
        _, prior = _physical(self._prior_mean, np.diag(self._prior_std**2), self._settings[0])
        speed = np.linspace(float(self._settings[7]), float(self._settings[8]), 41)
        powers = speed[:, None] ** np.arange(3)
        curve, std = powers @ estimate[:3], _curve_std(covariance, powers)
        share = float(np.max(np.where(curve > 0.0, std / np.maximum(curve, 1e-300), np.inf)))
        excitation = float(np.clip(1.0 - np.max(std / _curve_std(prior, powers)), 0.0, 1.0))
        return RunningResistanceResult(
            estimate=estimate,
            covariance=covariance,
            valid=bool(share <= LARGEST_STD and excitation >= CALIBRATED),
            excitation=excitation,
            curve_share=share,
            speed=float(self._mean[0]),
            grade_offset=float(self._mean[1] / GRAVITY),
            samples=int(self._counts[0]),
            left_out=int(self._counts[1]),
            resets=self._resets,
        )

    def state(self) -> dict[str, Any]:
        """Everything needed to go on later, bit for bit; plain values that JSON can hold."""
        return saved_state(
            STATE_FORMAT,
            STATE_VERSION,
            {"resets": self._resets, "counts": self._counts.tolist()}
            | {name: getattr(self, f"_{name}") for name in _SHAPES},
        )

    @classmethod
    def resume(cls, state: Mapping[str, Any]) -> RunningResistanceFilter:
        """The estimator that `state` was taken from.

        Raises
        ------
        InputError
            If the state is of another kind or version, or incomplete.
        """
        check_state(state, STATE_FORMAT, STATE_VERSION, ("resets", "counts", *_SHAPES))
        estimator = object.__new__(cls)
        for name, shape in _SHAPES.items():
            setattr(estimator, f"_{name}", array_of(state, name, shape))
        estimator._counts = array_of(state, "counts", (2,), np.int64)
        estimator._resets = count_of(state, "resets")
        return estimator

    def _run(
        self,
        time: ArrayLike,
        speed: ArrayLike,
        effort: ArrayLike,
        track: ArrayLike,
        track_slope: ArrayLike,
        section: ArrayLike,
        usable: ArrayLike,
        kept: FloatArray,
    ) -> None:
        clock = np.atleast_1d(np.asarray(time, dtype=np.float64))
        given = {
            "speed": speed, "effort": effort, "track": track, "track_slope": track_slope,
            "section": section, "usable": usable,
        }  # fmt: skip
        rows = np.empty((clock.size, 7))
        rows[:, 0] = clock
        for column, (name, values) in enumerate(given.items(), start=1):
            try:
                rows[:, column] = np.asarray(values, dtype=np.float64)
            except ValueError:
                raise InputError(
                    f"running resistance: {name} of shape {np.shape(values)} does not fit"
                    f" {clock.size} times"
                ) from None
        self._check_rows(rows)
        run_block(
            rows, self._settings, self._prior_std, self._mean, self._upper, self._diagonal,
            self._last, self._counts, kept,
        )  # fmt: skip

    def _check_rows(self, rows: FloatArray) -> None:
        if not rows.size:
            return
        before = rows[0, 0] - 1.0 if np.isnan(self._last[0]) else self._last[0]
        wrong = ~(np.diff(rows[:, 0], prepend=before) > 0.0)
        if np.any(wrong):
            raise InputError(
                "running resistance: time must increase",
                place=f"row {int(np.argmax(wrong))}",
                remedy="sort the samples",
            )
        unknown = (rows[:, 6] > 0.0) & ~np.isfinite(rows[:, 2:5].sum(axis=1))
        if np.any(unknown) or not np.all(np.isfinite(rows[:, 5:])):
            raise InputError(
                "running resistance: effort or track is not known where it is called usable",
                place=f"row {int(np.argmax(unknown))}",
                remedy="mark the sample as not usable",
            )


_SHAPES: dict[str, tuple[int, ...]] = {
    "settings": (9,),
    "prior_mean": (6,),
    "prior_std": (6,),
    "mean": (6,),
    "upper": (6, 6),
    "diagonal": (6,),
    "last": (7,),
}


def _check(settings: FloatArray, spread: FloatArray) -> None:
    names = "mass, mass_std, rotating_mass, speed_std, gradient_std, chainage_std, reach"
    lowest = np.array([0.0, 0.0, -1e-300, 0.0, 0.0, -1e-300, 0.0])
    for name, value, bound in zip(names.split(", "), settings, lowest, strict=False):
        if not (value > bound and np.isfinite(value)):
            raise InputError(f"running resistance: {name} {value:g} is not positive")
    if not (np.all(spread > 0.0) and np.all(np.isfinite(spread))):
        raise InputError(
            "running resistance: the standard deviations of r0, r1 and r2 must be positive",
            remedy="give resistance_std where a coefficient is 0",
        )
    if not 0.0 <= settings[7] < settings[8] < np.inf:
        raise InputError(
            f"running resistance: speeds from {settings[7]:g} to {settings[8]:g} m/s are no range"
        )


def _physical(
    mean: FloatArray, covariance: FloatArray, expected_mass: float
) -> tuple[FloatArray, FloatArray]:
    """r0, r1, r2 and mass (4,) of a state, with their covariance."""
    scale = np.append(UNIT_SPEED ** -np.arange(3.0), 1.0)
    mass = expected_mass / mean[2]
    estimate = mass * scale * np.append(mean[3:], 1.0)
    jacobian = np.zeros((4, 6))
    jacobian[range(3), range(3, 6)] = mass * scale[:3]
    jacobian[:, 2] = -estimate / mean[2]
    return estimate, jacobian @ covariance @ jacobian.T


def _curve_std(covariance: FloatArray, powers: FloatArray) -> FloatArray:
    """Standard deviation [N] of the curve at speeds of which ``powers`` are 1, v and v²."""
    return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", powers, covariance[:3, :3], powers)))
