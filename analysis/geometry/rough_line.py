"""The rough course of a line, put together from points of trips along it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.spatial import cKDTree

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

NEAR = 60.0
"""A fix so near to the rough line tells nothing new of where it goes [m]."""

GAP = 100.0
"""Points of the rough line further apart than this [m] have a gap between them."""


def rough_line(sequences: list[ComplexArray]) -> ComplexArray:
    """The longest sequence of points, with what others have in its gaps and beyond its ends.

    Parameters
    ----------
    sequences : list of complex arrays [m]
        Points of the plane along each trip, one trip in one direction or the other.

    Returns
    -------
    (n,) complex array [m]
        In the direction of the longest, without points at which it would turn back on itself.
    """
    lengths = [float(np.sum(np.minimum(np.abs(np.diff(s)), GAP))) for s in sequences]
    order = np.argsort(lengths)[::-1]
    line = sequences[int(order[0])]
    for number in order[1:]:
        sequence = sequences[int(number)]
        for begin, end in _strangers(line, sequence):
            line = _with_piece(line, sequence, begin, end)
    return _unfolded(line)


def _unfolded(line: ComplexArray) -> ComplexArray:
    """The points without those at which the line would turn back on itself: strayed fixes."""
    while line.size > 3:
        steps = np.diff(line)
        back = (np.conj(steps[:-1]) * steps[1:]).real < 0.0
        if not back.any():
            break
        line = line[np.concatenate(([True], ~back, [True]))]
    return line


def _strangers(line: ComplexArray, sequence: ComplexArray) -> list[tuple[int, int]]:
    """Runs of a sequence that the line does not pass by, as (first, one past the last)."""
    apart, _ = cKDTree(_pairs(line)).query(_pairs(sequence))
    runs, count = label(apart > NEAR)
    spans = [np.flatnonzero(runs == k + 1) for k in range(count)]
    return [(int(span[0]), int(span[-1]) + 1) for span in spans if span.size > 2]


def _with_piece(line: ComplexArray, sequence: ComplexArray, begin: int, end: int) -> ComplexArray:
    """The line with a piece of another sequence, if it fills a gap or goes on beyond an end."""
    tree = cKDTree(_pairs(line))
    piece, last = sequence[begin:end], line.size - 1
    before = int(tree.query(_pairs(sequence[begin - 1 : begin]))[1][0]) if begin else None
    after = int(tree.query(_pairs(sequence[end : end + 1]))[1][0]) if end < sequence.size else None
    if before is not None and after is not None:
        low, high = sorted((before, after))
        inner = np.abs(np.diff(line[low : high + 1]))
        if inner.size and inner.max() > GAP and high - low <= 5:
            part = piece if before < after else piece[::-1]
            return np.concatenate([line[: low + 1], part, line[high:]])
        return line
    for anchor, outward in ((before, piece), (after, piece[::-1])):
        if anchor is None:
            continue
        if anchor >= last - 2 and _goes_on(line, outward):
            return np.concatenate([line, outward])
        if anchor <= 2 and _goes_on(line[::-1], outward):
            return np.concatenate([outward[::-1], line])
    return line


def _goes_on(line: ComplexArray, further: ComplexArray) -> bool:
    """Whether points beyond the end of a line lie within 60° of ahead: no train turns at once."""
    heading, ahead = line[-1] - line[max(line.size - 6, 0)], further[2] - line[-1]
    return bool((np.conj(heading) * ahead).real > 0.5 * np.abs(heading) * np.abs(ahead))


def _pairs(points: ComplexArray) -> FloatArray:
    return np.column_stack([points.real, points.imag])
