"""Slip of the powered axles, sample by sample: a detector with hysteresis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from estimators.interface import array_of, check_state, count_of, number_of, saved_state
from trainlog.errors import InputError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

STATE_KIND, STATE_VERSION = "trainlog/slip_detector", 1
"""Of a saved state; the version is raised when its meaning changes."""

SLIP_THRESHOLD = 1.5
"""Slip speed [m/s] above which an axle is said to slip, when the noise allows."""

NOISE_MULTIPLE = 5.0
"""The threshold is at least this many standard deviations of the slip speed."""

CONFIRMATION = 2
"""Samples in a row above the threshold before an axle is said to slip."""


@dataclass(frozen=True, eq=False)
class SlipResult:
    """What the detector knows after the samples so far.

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
    samples, resets : int
        Samples since the last reset; resets so far.
    """

    estimate: FloatArray
    covariance: FloatArray
    slipping: BoolArray
    valid: bool
    excitation: float
    samples: int
    resets: int


class SlipDetector:
    """Says of each axle whether it slips: above the threshold twice running, until below half.

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
    """

    def __init__(self, axles: int, slip_std: float) -> None:
        if axles < 1 or not 0.0 <= slip_std < np.inf:
            raise InputError(
                f"slip detector: needs axles and a noise of at least 0, got {axles}, {slip_std}"
            )
        self.threshold = max(SLIP_THRESHOLD, NOISE_MULTIPLE * slip_std)
        self._axles, self._slip_std = axles, float(slip_std)
        self._resets = -1
        self.reset()

    def reset(self) -> None:
        """Forget everything: no axle slips."""
        self._above = np.zeros(self._axles, dtype=np.int64)
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
        told: BoolArray = _detect(block, self.threshold, CONFIRMATION, self._above, self._slipping)
        if len(block):
            self._seen += np.count_nonzero(~np.isnan(block), axis=0)
            self._last = block[-1].copy()
            self._samples += len(block)
        return told

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

    def state(self) -> dict[str, Any]:
        """Everything needed to go on later, bit for bit; plain values that JSON can hold."""
        return saved_state(
            STATE_KIND,
            STATE_VERSION,
            {name: getattr(self, f"_{name}") for name in (*_SETTINGS, *_ARRAYS)},
        )

    @classmethod
    def resume(cls, state: Mapping[str, Any]) -> Self:
        """The detector that `state` was taken from.

        Raises
        ------
        InputError
            If the state is of another kind or version, or incomplete.
        """
        check_state(state, STATE_KIND, STATE_VERSION, (*_SETTINGS, *_ARRAYS))
        detector = cls(count_of(state, "axles"), number_of(state, "slip_std"))
        detector._samples = count_of(state, "samples")
        detector._resets = count_of(state, "resets")
        for name, dtype in _ARRAYS.items():
            setattr(detector, f"_{name}", array_of(state, name, (detector._axles,), dtype))
        return detector


_SETTINGS = ("axles", "slip_std", "samples", "resets")
_ARRAYS = {"above": np.int64, "slipping": np.bool_, "seen": np.int64, "last": np.float64}


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


@njit(cache=True)
def _detect(slip, threshold, confirmation, above, slipping):  # type: ignore[no-untyped-def]
    out = np.zeros(slip.shape, dtype=np.bool_)
    for axle in range(slip.shape[1]):
        for k in range(slip.shape[0]):
            size = abs(slip[k, axle])
            if size > threshold:
                above[axle] += 1
                if above[axle] >= confirmation:
                    slipping[axle] = True
            elif not np.isnan(size):
                above[axle] = 0
                if size < 0.5 * threshold:
                    slipping[axle] = False
            out[k, axle] = slipping[axle]
    return out
