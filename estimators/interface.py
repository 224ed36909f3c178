"""The one interface of all recursive estimators, and how their state is saved and resumed.

An estimator takes samples in (`update`, one or a block), gives at any time its estimate and how far
the data determine it (`result`), forgets (`reset`), and can be stopped and continued later as if
nothing had happened (`state`, `resume`): bit for bit, however the samples were cut into blocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from trainlog.errors import InputError

FloatArray = NDArray[np.floating[Any]]

CALIBRATED = 0.5
"""Excitation from which a result counts as valid."""

COUNTS = ("samples", "resets")
"""What every estimator counts: samples since the last full reset, and resets so far."""


@dataclass(frozen=True, eq=False, kw_only=True)
class EstimatorResult:
    """Estimate after the samples so far; each estimator says more of it, and adds its own.

    Attributes
    ----------
    estimate, covariance : (p,), (p, p) array
        Estimated parameters or state.
    valid : bool
        Whether the data, rather than the prior, determine the estimate.
    excitation : float
        0: nothing was learnt in the direction with least information ... 1: everything.
    samples, resets : int
        Samples since the last full reset; resets so far, full and partial.
    """

    estimate: FloatArray
    covariance: FloatArray
    valid: bool
    excitation: float
    samples: int
    resets: int


class Estimator:
    """What every recursive estimator can do.

    A subclass lists in `settings` the parameters of its constructor and in `memory` the arrays that
    change while it learns; it keeps each as an attribute of that name with a leading underscore,
    beside the counts ``_samples`` and ``_resets``. The rest follows from them.
    """

    kind: ClassVar[str]
    """Format of a saved state, such as ``"trainlog/rls"``."""

    version: ClassVar[int]
    """Of a saved state; raised when its meaning changes."""

    settings: ClassVar[tuple[str, ...]]
    memory: ClassVar[tuple[str, ...]]
    _samples: int
    _resets: int = -1

    def reset(self) -> None:
        """Forget what was learnt."""
        raise NotImplementedError

    def update(self, *args: Any, **kwargs: Any) -> Any:
        """Learn from one sample or from a block of them; the parameters are the estimator's own."""
        raise NotImplementedError

    def result(self) -> EstimatorResult:
        """Estimate, covariance and validity now."""
        raise NotImplementedError

    def state(self) -> dict[str, Any]:
        """Everything needed to go on later, bit for bit; plain values that JSON can hold.

        Arrays become lists and NaN, which JSON lacks, None.
        """
        names = (*self.settings, *COUNTS, *self.memory)
        values = {name: _plain(getattr(self, f"_{name}")) for name in names}
        return {"format": self.kind, "version": self.version} | values

    @classmethod
    def resume(cls, state: Mapping[str, Any]) -> Self:
        """The estimator that `state` was taken from.

        Raises
        ------
        InputError
            If the state is of another kind or version, incomplete, or holds wrong values.
        """
        problem = "is not a saved state"
        try:
            stated = state["format"], state["version"]
            if stated != (cls.kind, cls.version):
                problem = f"has format {stated[0]!r}, version {stated[1]!r}"
                raise ValueError(f"needs version {cls.version}")
            problem = "is incomplete, or holds a wrong value"
            estimator = cls(**{name: state[name] for name in cls.settings})
            for name in COUNTS:
                if isinstance(state[name], bool) or not 0 <= state[name] == int(state[name]):
                    raise ValueError(f"{name} is not a count: {state[name]!r}")
                setattr(estimator, f"_{name}", int(state[name]))
            for name in cls.memory:
                fresh = getattr(estimator, f"_{name}")
                array = np.array(state[name], dtype=fresh.dtype)
                if array.shape != fresh.shape:
                    raise ValueError(f"{name} has shape {array.shape}, needs {fresh.shape}")
                setattr(estimator, f"_{name}", array)
        except (TypeError, ValueError, LookupError, OverflowError) as error:
            raise InputError(
                f"state of {cls.kind!r}: {problem} ({error})", remedy="start the estimator anew"
            ) from error
        return estimator


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and np.isnan(value) else value
