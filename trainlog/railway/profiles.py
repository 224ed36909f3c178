"""What a line has along its chainage: pieces of one value, curvature, the operator's kilometres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.declaration import INFINITY, Column, Declared, Text
from trainlog.display import counted
from trainlog.errors import InputError

TINY = 1e-6
"""Pieces that are shorter [m] do not come of a cut: positions are rounded to less."""


def hold_as_arrays(profile: object, *names: str) -> None:
    """Turn fields of a frozen dataclass into arrays, so that lists can be given."""
    for name in names:
        try:
            values = np.asarray(getattr(profile, name), dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(f"{type(profile).__name__}: {name} must be numbers") from None
        object.__setattr__(profile, name, values)


POSITION = Column("position", "m", "m", from_start=True)
"""The first column of tables along a line."""


def _radius(end: str) -> Column:
    """The column of the radii at one end of each element."""
    return Column(f"radius_at_{end}", "m", "m", INFINITY, inverse=True)


@dataclass(frozen=True, slots=True, eq=False)
class StepProfile(Declared):
    """A piecewise constant quantity: each value holds from its position to the next.

    Attributes
    ----------
    positions : (n,) array [m]
        Strictly increasing, the first is 0.
    values : (n,) array

    Examples
    --------
    >>> limits = StepProfile([0.0, 500.0], [20.0, 30.0])
    >>> limits([100.0, 500.0, 900.0])
    array([20., 30., 30.])
    """

    positions: FloatArray
    values: FloatArray

    def __post_init__(self) -> None:
        hold_as_arrays(self, "positions", "values")
        check_positions("profile", self.positions, self.values)

    def __repr__(self) -> str:
        low, high = float(self.values.min()), float(self.values.max())
        return f"StepProfile of {counted(self.values.size, 'step')}, {low:g} to {high:g}"

    def __call__(self, position: ArrayLike) -> FloatArray:
        """Value at each position; ends are extended."""
        index = np.searchsorted(self.positions, np.asarray(position), side="right") - 1
        return np.asarray(self.values[np.maximum(index, 0)])

    def reversed(self, length: float, sign: float = 1.0) -> StepProfile:
        """The profile seen from the other end of a line of `length` [m]."""
        ends = np.append(self.positions[1:], length)
        return StepProfile((length - ends)[::-1].copy(), sign * self.values[::-1])

    def between(self, start: float, end: float) -> StepProfile:
        """The profile from `start` to `end` [m], counted from `start`.

        Examples
        --------
        >>> part = StepProfile([0.0, 500.0], [20.0, 30.0]).between(400.0, 900.0)
        >>> part.positions.tolist(), part.values.tolist()
        ([0.0, 100.0], [20.0, 30.0])
        """
        kept = (self.positions > start + TINY) & (self.positions < end - TINY)
        first = max(int(np.searchsorted(self.positions, start + TINY, side="right")) - 1, 0)
        return StepProfile(
            np.concatenate(([0.0], self.positions[kept] - start)),
            np.concatenate(([self.values[first]], self.values[kept])),
        )

    def mean(self, start: FloatArray, end: FloatArray) -> FloatArray:
        """Mean value over each interval from `start` to `end` [m], (m,) arrays, start < end.

        Examples
        --------
        >>> import numpy as np
        >>> profile = StepProfile(np.array([0.0, 100.0]), np.array([20.0, 30.0]))
        >>> profile.mean(np.array([50.0]), np.array([150.0])).tolist()
        [25.0]
        """
        edges = np.append(self.positions, np.inf)
        widths = np.diff(edges[:-1])
        integral = np.concatenate(([0.0], np.cumsum(self.values[:-1] * widths)))

        def antiderivative(s: FloatArray) -> FloatArray:
            index = np.maximum(np.searchsorted(self.positions, s, side="right") - 1, 0)
            return np.asarray(integral[index] + self.values[index] * (s - self.positions[index]))

        return np.asarray((antiderivative(end) - antiderivative(start)) / (end - start))


@dataclass(frozen=True, slots=True, eq=False)
class CurvatureProfile(Declared):
    """Signed track curvature: circular arcs and, between them, linear transitions.

    Positive curvature bends to the right in the direction of travel.

    Attributes
    ----------
    positions : (n,) array [m]
        Start of each element; strictly increasing, the first is 0.
    start, end : (n,) array [1/m]
        Curvature at the start and at the end of each element.

    Examples
    --------
    >>> curve = CurvatureProfile([0.0, 100.0, 200.0], [0.0, 0.0, 2e-3], [0.0, 2e-3, 2e-3])
    >>> curve.at([50.0, 150.0, 250.0], 300.0)
    array([0.   , 0.001, 0.002])
    """

    positions: Annotated[FloatArray, POSITION]
    start: Annotated[FloatArray, _radius("start")]
    end: Annotated[FloatArray, _radius("end")]

    def __post_init__(self) -> None:
        hold_as_arrays(self, "positions", "start", "end")
        check_positions("curvature", self.positions, self.start)
        check_positions("curvature", self.positions, self.end)

    def __repr__(self) -> str:
        sharpest = float(max(np.abs(self.start).max(), np.abs(self.end).max()))
        radius = f"radius {1.0 / sharpest:.0f} m at least" if sharpest else "straight"
        return f"CurvatureProfile of {counted(self.start.size, 'element')}, {radius}"

    def at(self, position: ArrayLike, length: float) -> FloatArray:
        """Curvature [1/m] at each position of a line of `length` [m]."""
        return _between(self.positions, self.start, self.end, position, length)

    def reversed(self, length: float) -> CurvatureProfile:
        """The profile seen from the other end: a left-hand bend becomes a right-hand one."""
        ends = np.append(self.positions[1:], length)
        return CurvatureProfile((length - ends)[::-1].copy(), -self.end[::-1], -self.start[::-1])

    def between(self, start: float, end: float, length: float) -> CurvatureProfile:
        """The curvature from `start` to `end` [m] of a line of `length` [m]."""
        return CurvatureProfile(*_cut((self.positions, self.start, self.end), (start, end), length))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LineReference(Declared):
    """How the operator of a line calls it and counts its kilometres.

    Kilometres may run against the chainage, and jump where the line was rebuilt.

    Attributes
    ----------
    name : str
        Of the line, often a number.
    positions : (n,) array [m]
        Chainage at which each piece starts; strictly increasing, the first is 0.
    start, end : (n,) array [m]
        The operator's kilometre at the start and at the end of each piece, in metres.

    Examples
    --------
    A line counted downwards from km 61.2, with a jump:

    >>> reference = LineReference("850", [0.0, 500.0], [61_200.0, 60_500.0], [60_700.0, 60_000.0])
    >>> reference.at([0.0, 250.0, 750.0], 1_000.0)
    array([61200., 60950., 60250.])
    """

    name: Annotated[str, Text(least=1)]
    positions: Annotated[
        FloatArray, Column("position", "m", "m", table="kilometres", from_start=True)
    ]
    start: Annotated[FloatArray, Column("km_at_start", "km", "m", table="kilometres")]
    end: Annotated[FloatArray, Column("km_at_end", "km", "m", table="kilometres")]

    def __post_init__(self) -> None:
        hold_as_arrays(self, "positions", "start", "end")
        check_positions("kilometres", self.positions, self.start)
        check_positions("kilometres", self.positions, self.end)

    def at(self, position: ArrayLike, length: float) -> FloatArray:
        """The operator's kilometre, in metres, at each position of a line of `length` [m]."""
        return _between(self.positions, self.start, self.end, position, length)

    def reversed(self, length: float) -> LineReference:
        """The same kilometres seen from the other end."""
        ends = np.append(self.positions[1:], length)
        return LineReference(
            self.name, (length - ends)[::-1].copy(), self.end[::-1], self.start[::-1]
        )

    def between(self, start: float, end: float, length: float) -> LineReference:
        """The kilometres from `start` to `end` [m] of a line of `length` [m]."""
        pieces = (self.positions, self.start, self.end)
        return LineReference(self.name, *_cut(pieces, (start, end), length))


def _cut(
    pieces: tuple[FloatArray, FloatArray, FloatArray], span: tuple[float, float], length: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, value at start and at end of the pieces within a span, counted from its start."""
    positions, first, last = pieces
    start, end = span
    ends = np.append(positions[1:], max(length, float(positions[-1])))
    kept = (ends > start + TINY) & (positions < end - TINY)
    positions, ends, first, last = positions[kept], ends[kept], first[kept], last[kept]
    width, change = np.maximum(ends - positions, 1e-9), last - first
    begin = first + np.maximum(start - positions, 0.0) / width * change
    finish = np.where(ends <= end, last, first + (end - positions) / width * change)
    cut = positions - start
    cut[0] = 0.0
    return cut, begin, finish


def _between(
    positions: FloatArray, start: FloatArray, end: FloatArray, at: ArrayLike, length: float
) -> FloatArray:
    """What varies in a straight line from `start` to `end` of each piece, at some positions."""
    s = np.asarray(at, dtype=np.float64)
    index = np.maximum(np.searchsorted(positions, s, side="right") - 1, 0)
    ends = np.append(positions[1:], max(length, positions[-1]))
    width = np.maximum(ends - positions, 1e-9)
    share = np.clip((s - positions[index]) / width[index], 0.0, 1.0)
    return np.asarray(start[index] + share * (end[index] - start[index]))


def check_positions(what: str, positions: FloatArray, values: FloatArray) -> None:
    """Refuse profiles that are empty, ragged, not finite or out of order."""
    if positions.ndim != 1 or positions.size == 0 or positions.shape != values.shape:
        raise InputError(f"{what}: needs as many positions as values, and at least one")
    if not (np.all(np.isfinite(positions)) and np.all(np.isfinite(values))):
        raise InputError(f"{what}: positions and values must be finite numbers")
    if positions[0] != 0.0:
        raise InputError(f"{what}: must begin at position 0, begins at {positions[0]} m")
    if np.any(np.diff(positions) <= 0.0):
        at = positions[1:][np.diff(positions) <= 0.0][0]
        raise InputError(f"{what}: positions must increase, they do not at {at} m")
