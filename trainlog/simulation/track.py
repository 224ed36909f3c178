"""The track as the compiled dynamics read it: one row a piece between two breakpoints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainlog.railway import Line

FloatArray = NDArray[np.float64]


class Pieces(NamedTuple):
    """Pieces of a line in which gradient and tunnel are constant; (n,) arrays.

    Attributes
    ----------
    start, width : [m]
    sine : of the gradient's angle
    curvature, bend : [1/m], [1/m²]
        At the start, and its change along the piece.
    """

    start: FloatArray
    width: FloatArray
    sine: FloatArray
    curvature: FloatArray
    bend: FloatArray


def pieces(line: Line) -> Pieces:
    """The pieces of `line`, as travelled."""
    start = line.breakpoints
    start = start[start < line.length]
    width = np.diff(np.append(start, line.length))
    inside = start + 1e-6 * width
    nearly = start + (1.0 - 1e-6) * width
    slope = line.gradient(start)
    curvature = line.curvature(inside)
    bend = (line.curvature(nearly) - curvature) / (nearly - inside)
    return Pieces(start, width, slope / np.hypot(1.0, slope), curvature, bend)
