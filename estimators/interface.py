"""The one interface of all recursive estimators, and how their state is saved and resumed.

An estimator takes samples in (`update`, one or a block), gives at any time its estimate and how far
the data determine it (`result`), forgets (`reset`), and can be stopped and continued later as if
nothing had happened (`state`, `resume`): bit for bit, however the samples were cut into blocks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from trainlog.errors import InputError

FloatArray = NDArray[np.floating[Any]]

CALIBRATED = 0.5
"""Excitation from which a result counts as valid."""


class EstimatorResult(Protocol):
    """Estimate after the samples so far; each estimator adds fields of its own."""

    @property
    def estimate(self) -> FloatArray:
        """Estimated parameters or state, (p,)."""
        ...

    @property
    def covariance(self) -> FloatArray:
        """Of the estimate, (p, p)."""
        ...

    @property
    def valid(self) -> bool:
        """Whether the data, rather than the prior, determine the estimate."""
        ...

    @property
    def excitation(self) -> float:
        """0: nothing was learnt in the direction with least information ... 1: everything."""
        ...

    @property
    def samples(self) -> int:
        """Samples since the last full reset."""
        ...

    @property
    def resets(self) -> int:
        """Resets so far, full and partial."""
        ...


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
        """Everything needed to go on later, bit for bit; plain values that JSON can hold."""
        names = (*self.settings, *COUNTS, *self.memory)
        return saved_state(
            self.kind, self.version, {name: getattr(self, f"_{name}") for name in names}
        )

    @classmethod
    def resume(cls, state: Mapping[str, Any]) -> Self:
        """The estimator that `state` was taken from.

        Raises
        ------
        InputError
            If the state is of another kind or version, incomplete, or holds wrong values.
        """
        check_state(state, cls.kind, cls.version, (*cls.settings, *COUNTS, *cls.memory))
        try:
            estimator = cls(**{name: state[name] for name in cls.settings})
        except (TypeError, ValueError) as error:
            raise _broken(cls.kind, f"its settings are wrong ({error})") from error
        for name in COUNTS:
            setattr(estimator, f"_{name}", count_of(state, name))
        for name in cls.memory:
            fresh = getattr(estimator, f"_{name}")
            setattr(estimator, f"_{name}", array_of(state, name, fresh.shape, fresh.dtype))
        return estimator


COUNTS = ("samples", "resets")
"""What every estimator counts: samples since the last full reset, and resets so far."""


def saved_state(kind: str, version: int, values: Mapping[str, Any]) -> dict[str, Any]:
    """State of an estimator as plain values that JSON can hold.

    Parameters
    ----------
    kind : str
        Format of the state, such as ``"trainlog/rls"``.
    version : int
        Raised when the meaning of a saved state changes.
    values : mapping
        Arrays and numbers; arrays become lists and NaN, which JSON lacks, None.

    Examples
    --------
    >>> import numpy as np
    >>> saved_state("trainlog/example", 1, {"mean": np.array([1.0, np.nan])})
    {'format': 'trainlog/example', 'version': 1, 'mean': [1.0, None]}
    """
    return {"format": kind, "version": version} | {
        name: _plain(value) for name, value in values.items()
    }


def check_state(state: Mapping[str, Any], kind: str, version: int, names: Iterable[str]) -> None:
    """Refuse a saved state that is of another kind or version, or incomplete.

    Raises
    ------
    InputError
        Naming what was found and what is needed.
    """
    if not isinstance(state, Mapping):
        raise _broken(kind, f"is no saved state, but a {type(state).__name__}")
    if state.get("format") != kind or state.get("version") != version:
        raise InputError(
            f"state of an estimator has format {state.get('format')!r}, version"
            f" {state.get('version')!r}; needs {kind!r}, {version}",
            remedy="start the estimator anew",
        )
    missing = [name for name in names if name not in state]
    if missing:
        raise _broken(kind, f"is incomplete, it lacks {', '.join(missing)}")


def array_of(
    state: Mapping[str, Any], name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float64
) -> NDArray[Any]:
    """An array of a saved state, with NaN where it holds None.

    Raises
    ------
    InputError
        If it holds no numbers, or not as many as `shape` needs.
    """
    try:
        array: NDArray[Any] = np.array(state[name], dtype=dtype)
        fits = array.shape == shape or array.size == 0 == np.prod(shape)
    except (TypeError, ValueError, OverflowError) as error:
        raise _broken(state["format"], f"{name} is no array of numbers") from error
    if not fits:
        raise _broken(state["format"], f"{name} has shape {array.shape}, needs {shape}")
    return array.reshape(shape)


def count_of(state: Mapping[str, Any], name: str) -> int:
    """A whole number of a saved state, at least 0; InputError if it is none."""
    value = state[name]
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise _broken(state["format"], f"{name} is no count: {value!r}")
    return value


def _broken(kind: str, problem: str) -> InputError:
    return InputError(f"state of {kind!r}: {problem}", remedy="start the estimator anew")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and np.isnan(value) else value
