"""What trips have in common that is not the train: the errors of the line they ran over.

A line is surveyed once. Trips over the same line in the same direction meet the same errors of its
gradients, and their mean keeps them, however many trips there are. How alike they are from trip to
trip hangs on how each was driven; they are taken for wholly alike in one direction, and for
independent between directions, though there they cancel in part: the band of the mean is rather
too wide than too narrow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def shared_variance(weights: FloatArray, survey: FloatArray, line: NDArray[np.int64]) -> FloatArray:
    """What shared errors add to the variance of a weighted mean, (3, 3).

    With e_i = D_i u_l, where D_i D_i' is the part of trip i's variance that its line l brings in,
    and u_l is common to the trips over l: the sum over pairs of different trips of
    ``W_i D_i D_j' W_j'``.

    Parameters
    ----------
    weights : (k, 3, 3) array
        Of each trip in the mean; they sum up to one.
    survey : (k, 3, 3) array
        Of each trip's variance the part that errors of its line bring in.
    line : (k,) int array
        Number of the line and direction that the trip ran over.
    """
    values, vectors = np.linalg.eigh(survey)
    lengths = np.sqrt(np.maximum(values, 0.0))
    # The symmetric root: of two trips that differ, the errors are as alike as they can be.
    effect = weights @ ((vectors * lengths[:, None, :]) @ vectors.transpose(0, 2, 1))
    order = np.argsort(line, kind="stable")
    first = np.flatnonzero(np.diff(line[order], prepend=-1))
    together = np.add.reduceat(effect[order], first, axis=0)
    return np.asarray(
        np.einsum("kij,klj->il", together, together) - np.einsum("kij,klj->il", effect, effect)
    )
