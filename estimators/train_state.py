"""Train state while the train runs: position, speed, acceleration and gradient offset.

A Kalman filter with filterpy's face (`predict`, `update`, `x`, `P`, `F`, `Q`, `H`, `R`,
`batch_filter`) over the motion model of `estimators.kalman`. A sample holds what there is of

- the position along the line from satellites, and the satellite speed;
- the acceleration that is expected on the map's gradient: effort less running resistance over
  mass, less the map's part. It exceeds the true one by g times the gradient's offset;
- what an accelerometer tells, less the map's part: it exceeds the true acceleration likewise, and
  by its own bias;
- the speed of each wheel; all of them too large by a common factor.

The gradient offset is the difference between an acceleration that is felt or known and one that
is driven: without effort and accelerometer nothing tells it, and it is not given. Told by the
effort it holds, as a gradient, what is wrong with mass and resistance, too.

An axle that slips is left out: whose speed departs from the expected one by more than it may, or
changes faster than any train, so that all axles slipping together are noticed. It is taken back
when it keeps to the expected speed again, and when nothing else has told a speed for long.
Meanwhile the efforts of its motors are believed less.

References
----------
Bar-Shalom, Y., Li, X. R., Kirubarajan, T. (2001), Estimation with applications to tracking and
navigation, sec. 5.4: consistency and gates. filterpy (R. Labbe): names and conventions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.interface import (
    array_of,
    check_state,
    count_of,
    excitation_of,
    saved_state,
)
from estimators.kalman import (
    ACCELERATION_STD,
    ACCELEROMETER_BIAS_STD,
    GRADIENT_STD,
    NO_POSITION_STD,
    NO_SPEED_STD,
    STATES,
    WHEEL_ERROR_STD,
    motion_model,
    smoothed,
)
from estimators.train_state_recursion import (
    CLOCK,
    SLIP_MEMORY,
    SLIP_TIME,
    SLIPPING,
    SMOOTH,
    SPEED_TIME,
    STEP,
    observe,
    predict,
    run_block,
)
from trainlog.errors import InputError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

STATE_FORMAT = "trainlog/train-state"
STATE_VERSION = 1
"""Raised when the meaning of a saved state changes."""

CHANNELS = ("position", "speed", "expected_acceleration", "specific_force")
"""What a sample holds before the wheel speeds."""

OFFSET_EXCITATION = 1.0 / 3.0
"""Share of its prior's standard deviation that must be removed before an offset is told."""

LARGEST_SPEED_STD = 2.0
"""Standard deviation of the speed [m/s] beyond which it is not valid."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """How good the measurements are; standard deviations of white noise unless told otherwise.

    Attributes
    ----------
    position, lasting_position : float [m]
        White part, and a part that lasts for half a minute.
    speed : float [m/s]
        Of satellites.
    expected_acceleration, specific_force : float [m/s²]
    wheel : float [m/s]
        Creep comes on top of it.
    """

    position: float = 0.5
    lasting_position: float = 2.5
    speed: float = 0.1
    expected_acceleration: float = 0.03
    specific_force: float = 0.03
    wheel: float = 0.03


@dataclass(frozen=True, eq=False)
class TrainStateResult:
    """What is known of the train now.

    Attributes
    ----------
    estimate : (4,) array
        Position [m], speed [m/s], acceleration [m/s²], gradient offset [1]; NaN what cannot be
        told.
    covariance : (4, 4) array
    valid : bool
        Whether measurements tell the speed, to `LARGEST_SPEED_STD`.
    excitation : float
        Share of the prior's standard deviation of speed and acceleration that they removed, in
        the direction that they tell least about.
    samples, resets : int
        Since the last full reset; resets so far, those by which it found back included.
    slipping : (axles,) bool array
        Now.
    left_out : (4 + axles,) int array
        How often each measurement was left out.
    reasons : tuple of str
        Why what is NaN cannot be told.
    """

    estimate: FloatArray
    covariance: FloatArray
    valid: bool
    excitation: float
    samples: int
    resets: int
    slipping: BoolArray
    left_out: NDArray[np.int64]
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class TrainStates:
    """The train's state at each sample.

    Attributes
    ----------
    means, covariances : (n, 7), (n, 7, 7) array
        The whole state; see `estimators.kalman.STATES`.
    slipping : (n, axles) bool array
        Axles that were left out.
    """

    means: FloatArray
    covariances: FloatArray
    slipping: BoolArray

    @property
    def std(self) -> FloatArray:
        """Standard deviation of position, speed, acceleration and gradient offset, (n, 4)."""
        variances = np.diagonal(self.covariances, axis1=1, axis2=2)[:, :4]
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))

    @property
    def gradient_offset(self) -> FloatArray:
        """True gradient less that of the map, (n,); NaN where nothing tells it."""
        told = self.std[:, 3] < (1.0 - OFFSET_EXCITATION) * GRADIENT_STD
        return np.where(told, self.means[:, 3], np.nan)


class TrainStateFilter:
    """Kalman filter of a train's motion that leaves slipping axles out.

    Parameters
    ----------
    axles : int
        Wheel speeds in a sample.
    noise : Measurement, optional
    position, position_std : float [m]
        Known beforehand; default: nothing.

    Attributes
    ----------
    x, P : (7,), (7, 7) array
        State and covariance: position, speed, acceleration, gradient offset, and three errors of
        measurements that last (`estimators.kalman.STATES`).
    F, Q : (7, 7) array
        Transition and process noise of the last step.
    H, R : (4 + axles, 7), (4 + axles, 4 + axles) array
        What the last sample showed of the state, and the variances of its noise as used.
    z : (4 + axles,) array
        The last sample as used: NaN what was missing or left out.

    Raises
    ------
    InputError
        If there are fewer than no axles or a standard deviation is not positive.
    """

    def __init__(
        self,
        axles: int,
        noise: Measurement | None = None,
        *,
        position: float = 0.0,
        position_std: float = NO_POSITION_STD,
    ) -> None:
        noise = noise or Measurement()
        deviations = [getattr(noise, name) for name in noise.__slots__]
        if axles < 0 or not all(0.0 < each < np.inf for each in (*deviations, position_std)):
            raise InputError(
                "train state: needs no fewer than 0 axles and positive standard deviations"
            )
        self._axles = axles
        self._variances = np.square(
            [noise.position, noise.speed, noise.expected_acceleration, noise.specific_force]
            + axles * [noise.wheel]
        )
        self._lasting = np.array(noise.lasting_position)
        self._prior = np.array([position, position_std])
        self._resets = -1
        self.reset()

    def reset(self) -> None:
        """Forget everything but what was known beforehand."""
        self._mean = np.zeros(STATES)
        self._mean[0] = self._prior[0]
        self._covariance = np.diag(np.square(_prior_std(float(self._prior[1]))))
        self._wheels = np.zeros((self._axles, 4))
        self._wheels[:, SMOOTH] = np.nan
        self._clocks = np.array([np.nan, 0.0, 0.0, SLIP_MEMORY, 0.0, 0.0, 0.0])
        self._left_out = np.zeros(len(CHANNELS) + self._axles, dtype=np.int64)
        self._counts = np.zeros(2, dtype=np.int64)
        self._resets += 1
        self.F, self.Q = np.eye(STATES), np.zeros((STATES, STATES))
        self.H = np.zeros((self._left_out.size, STATES))
        self.R = np.diag(self._variances)
        self.z = np.full(self._left_out.size, np.nan)

    @property
    def x(self) -> FloatArray:
        """State, (7,)."""
        return self._mean.copy()

    @property
    def P(self) -> FloatArray:  # noqa: N802 - filterpy's name
        """Covariance of the state, (7, 7)."""
        return self._covariance.copy()

    def measurements(
        self,
        time: ArrayLike,
        *,
        position: ArrayLike = np.nan,
        speed: ArrayLike = np.nan,
        expected_acceleration: ArrayLike = np.nan,
        specific_force: ArrayLike = np.nan,
        wheel_speed: ArrayLike = np.nan,
    ) -> FloatArray:
        """Samples as `update` takes them, (n, 4 + axles), NaN where nothing was measured.

        Parameters
        ----------
        time : (n,) array [s]
        position : (n,) array [m]
            Along the line, from satellites.
        speed : (n,) array [m/s]
            From satellites.
        expected_acceleration : (n,) array [m/s²]
            Effort less running resistance over mass, less the gradient's part by the map.
        specific_force : (n,) array [m/s²]
            What an accelerometer along the train shows, less g times the map's gradient.
        wheel_speed : (n, axles) array [m/s]
        """
        count = np.size(time)
        z = np.empty((count, len(CHANNELS) + self._axles))
        columns = (position, speed, expected_acceleration, specific_force)
        try:
            for column, values in enumerate(columns):
                z[:, column] = np.asarray(values, dtype=np.float64)
            z[:, len(CHANNELS) :] = np.asarray(wheel_speed, dtype=np.float64)
        except ValueError as error:
            raise InputError(
                f"train state: measurements do not fit {count} times and {self._axles} axles:"
                f" {error}"
            ) from None
        z[~np.isfinite(z)] = np.nan
        return z

    def predict(self, step: float) -> None:
        """Move the state `step` [s] ahead; `F` and `Q` are those of the step."""
        if not step >= 0.0:
            raise InputError(f"train state: cannot predict by {step} s")
        transition, noise = motion_model(np.array([float(step)]))
        self.F, self.Q = transition[0], noise[0]
        predict(self._mean, self._covariance, self.F, self.Q)
        self._clocks[: SLIP_TIME + 1] += step
        self._clocks[STEP] += step

    def update(
        self, z: ArrayLike, time: ArrayLike | None = None, variances: ArrayLike | None = None
    ) -> TrainStates:
        """Take in one sample, or a block of them.

        Parameters
        ----------
        z : (4 + axles,) or (n, 4 + axles) array
            As `measurements` makes them.
        time : float or (n,) array [s], optional
            Of each sample, increasing, also from call to call; the state is predicted to there.
            Without it a sample belongs to the time that `predict` has reached.
        variances : (4 + axles,) or (n, 4 + axles) array, optional
            Of the white noise where it differs from sample to sample; NaN where it does not.

        Returns
        -------
        TrainStates
            After each sample.

        Raises
        ------
        InputError
            If shapes do not fit, time does not increase, or a variance is not positive.
        """
        return self._run(z, time, variances)[0]

    def batch_filter(
        self, zs: ArrayLike, time: ArrayLike, variances: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """`update` by a block, returning what filterpy's does.

        Returns
        -------
        means, covariances : (n, 7), (n, 7, 7) array
            After each sample.
        means_p, covariances_p : (n, 7), (n, 7, 7) array
            Before it.
        """
        mean, covariance = self.x, self.P
        states, _, which, (transition, noise) = self._run(zs, time, variances)
        means = np.concatenate((mean[None], states.means[:-1]))
        covariances = np.concatenate((covariance[None], states.covariances[:-1]))
        means_p = np.einsum("nij,nj->ni", transition[which], means)
        covariances_p = np.einsum(
            "nij,njk,nlk->nil", transition[which], covariances, transition[which], optimize=True
        )
        return states.means, states.covariances, means_p, covariances_p + noise[which]

    def smooth(
        self, z: ArrayLike, time: ArrayLike, variances: ArrayLike | None = None
    ) -> TrainStates:
        """The states given all samples, earlier and later ones: for use offline.

        What the filter leaves out on its way is left out. The filter itself goes on as after
        `update`. Parameters and errors are those of `update`.
        """
        mean, covariance = self.x, self.P
        states, used, which, (transition, noise) = self._run(z, time, variances)
        observed = np.zeros((*used[0].shape, STATES))
        observe(observed, used[0], float(self._lasting))
        means, covariances = smoothed(which, transition, noise, observed, *used, mean, covariance)
        return TrainStates(means, covariances, states.slipping)

    def result(self) -> TrainStateResult:
        """The state now, with its covariance, and why what is missing is missing."""
        prior = np.square(_prior_std(float(self._prior[1])))
        estimate, covariance = self._mean[:4].copy(), self._covariance[:4, :4].copy()
        excitation = excitation_of(covariance[1:3, 1:3], np.diag(prior[1:3]))
        reasons = []
        if covariance[0, 0] > (0.5 * NO_POSITION_STD) ** 2:
            estimate[0] = np.nan
            reasons.append("position: none was measured, nor is a beginning known")
        std = np.sqrt(np.diag(covariance))
        if std[1] > LARGEST_SPEED_STD:
            estimate[1:3] = np.nan
            reasons.append(
                f"speed and acceleration: no speed that can be trusted was measured for"
                f" {self._clocks[SPEED_TIME]:.0f} s"
            )
        if std[3] > (1.0 - OFFSET_EXCITATION) * GRADIENT_STD:
            estimate[3] = np.nan
            reasons.append(
                "gradient offset: it takes an expected acceleration or an accelerometer, and a"
                " speed; no wheel must slip meanwhile"
            )
        return TrainStateResult(
            estimate=estimate,
            covariance=covariance,
            valid=bool(std[1] <= LARGEST_SPEED_STD),
            excitation=excitation,
            samples=int(self._counts[0]),
            resets=self._resets + int(self._counts[1]),
            slipping=self._wheels[:, SLIPPING] > 0.0,
            left_out=self._left_out.copy(),
            reasons=tuple(reasons),
        )

    def state(self) -> dict[str, Any]:
        """Everything needed to go on later, bit for bit; plain values that JSON can hold."""
        return saved_state(
            STATE_FORMAT,
            STATE_VERSION,
            {"axles": self._axles, "resets": self._resets}
            | {name: getattr(self, f"_{name}") for name in _shapes(0)},
        )

    @classmethod
    def resume(cls, state: Mapping[str, Any]) -> TrainStateFilter:
        """The filter that `state` was taken from.

        Raises
        ------
        InputError
            If the state is of another kind or version, or incomplete.
        """
        check_state(state, STATE_FORMAT, STATE_VERSION, ("axles", "resets", *_shapes(0)))
        estimator = cls(count_of(state, "axles"))
        for name, (shape, dtype) in _shapes(estimator._axles).items():
            setattr(estimator, f"_{name}", array_of(state, name, shape, dtype))
        estimator._resets = count_of(state, "resets")
        return estimator

    def _run(
        self, z: ArrayLike, time: ArrayLike | None, variances: ArrayLike | None
    ) -> tuple[
        TrainStates,
        tuple[FloatArray, FloatArray],
        NDArray[np.int64],
        tuple[FloatArray, FloatArray],
    ]:
        """States, measurements and variances as used, and the model with its number by sample."""
        rows, noise = self._checked(z, variances)
        steps = self._steps(time, len(rows))
        unique, which = np.unique(steps, return_inverse=True)
        model = motion_model(unique)
        used, used_noise = rows.copy(), noise.copy()
        means = np.empty((len(rows), STATES))
        covariances = np.empty((len(rows), STATES, STATES))
        slipping = np.zeros((len(rows), self._axles), dtype=np.bool_)
        run_block(
            which, steps, *model, used, used_noise, float(self._lasting), self._mean,
            self._covariance, self._wheels, self._clocks, self._left_out, self._counts,
            means, covariances, slipping,
        )  # fmt: skip
        if len(rows):
            if time is not None:
                self.F, self.Q = model[0][which[-1]].copy(), model[1][which[-1]].copy()
                self._clocks[CLOCK] = np.atleast_1d(np.asarray(time, dtype=np.float64))[-1]
            self.H = np.zeros((rows.shape[1], STATES))
            observe(self.H[None], used[-1:], float(self._lasting))
            self.R = np.diag(used_noise[-1])
            self.z = used[-1].copy()
        return TrainStates(means, covariances, slipping), (used, used_noise), which, model

    def _checked(self, z: ArrayLike, variances: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
        rows = np.atleast_2d(np.array(z, dtype=np.float64))
        width = len(CHANNELS) + self._axles
        if rows.ndim != 2 or rows.shape[1] != width:
            raise InputError(
                f"train state: a sample holds {width} measurements, got shape {np.shape(z)}"
            )
        if np.any(np.isinf(rows)):
            raise InputError("train state: a measurement is infinite", remedy="NaN means missing")
        if variances is None:
            return rows, np.tile(self._variances, (len(rows), 1))
        try:
            given = np.broadcast_to(np.asarray(variances, dtype=np.float64), rows.shape)
        except ValueError:
            raise InputError(
                f"train state: variances of shape {np.shape(variances)} do not fit measurements of"
                f" shape {rows.shape}"
            ) from None
        if np.any(given <= 0.0) or np.any(np.isinf(given)):
            raise InputError("train state: a variance is not positive")
        return rows, np.where(np.isnan(given), self._variances, given)

    def _steps(self, time: ArrayLike | None, count: int) -> FloatArray:
        if time is None:
            if count != 1:
                raise InputError("train state: a block of samples needs the time of each")
            return np.zeros(1)
        clock = np.atleast_1d(np.asarray(time, dtype=np.float64))
        if clock.shape != (count,) or not np.all(np.isfinite(clock)):
            raise InputError(f"train state: needs {count} finite times, got shape {clock.shape}")
        last = self._clocks[CLOCK]
        steps = np.diff(clock, prepend=clock[:1] if np.isnan(last) else last)
        wrong = steps <= 0.0
        wrong[:1] &= not np.isnan(last)
        if np.any(wrong):
            raise InputError(
                "train state: time must increase",
                place=f"sample {int(np.argmax(wrong))}",
                remedy="sort the samples",
            )
        # Equal steps differ in the last digits; a nanosecond is nothing.
        return np.round(steps, 9)


def _prior_std(position_std: float) -> FloatArray:
    return np.array(
        [
            position_std, NO_SPEED_STD, ACCELERATION_STD, GRADIENT_STD,
            1.0, WHEEL_ERROR_STD, ACCELEROMETER_BIAS_STD,
        ]
    )  # fmt: skip


def _shapes(axles: int) -> dict[str, tuple[tuple[int, ...], type]]:
    """Arrays of a saved state."""
    channels = len(CHANNELS) + axles
    return {
        "variances": ((channels,), np.float64),
        "lasting": ((), np.float64),
        "prior": ((2,), np.float64),
        "mean": ((STATES,), np.float64),
        "covariance": ((STATES, STATES), np.float64),
        "wheels": ((axles, 4), np.float64),
        "clocks": ((7,), np.float64),
        "left_out": ((channels,), np.int64),
        "counts": ((2,), np.int64),
    }
