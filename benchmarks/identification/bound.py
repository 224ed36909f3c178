"""How well any unbiased estimator can do on a drawn trip: the Cramér-Rao bound.

Everything is given: the true pieces of gradient, the true sizes of all errors, the true mass's
range. What is not given is drawn, and normal: one offset for each piece, one shift for each change
of gradient, the noise of each sample. Speed itself is the observation, at every second, and every
stretch between two brakings begins at a speed of its own, so that nothing is shared with the
windows of the product but the equation of motion.

References
----------
Rao, C. R. (1945), Information and the accuracy attainable in the estimation of statistical
parameters, Bulletin of the Calcutta Mathematical Society 37.
"""

from __future__ import annotations

import numpy as np
from monte_carlo import PERIOD, Drawn, Study

from analysis.resistance.recording import LOWEST_SPEED, widened
from trainlog.arrays import FloatArray
from trainlog.units import GRAVITY

BLOCK = 10
"""Samples averaged into one observation."""


def information(trip: Drawn, study: Study) -> FloatArray:
    """Information (3, 3) that a trip holds on r0, r1 and r2, its mass being unknown."""
    usable = ~widened(trip.time, (trip.braking > 0.0) | (trip.true_speed < LOWEST_SPEED))
    edges = np.flatnonzero(np.diff(np.concatenate(([0], usable, [0]))))
    rows = [
        _stretch(trip, study, int(begin), int(end))
        for begin, end in zip(edges[::2], edges[1::2], strict=True)
        if end - begin >= 5 * BLOCK
    ]
    # The speed at which a stretch begins is known to nobody: the mean of each goes.
    design = np.vstack(rows)
    noise = np.hypot(study.speed_noise, study.speed_resolution / np.sqrt(12.0)) / np.sqrt(BLOCK)
    start = np.repeat(np.arange(len(rows)), [len(row) for row in rows])[:, None] == np.arange(
        len(rows)
    )
    design = np.hstack([design, start])
    drawn = design.shape[1] - 4 - len(rows)
    known = np.concatenate([np.zeros(4), np.ones(drawn), np.full(len(rows), 1e-9)])
    total = design.T @ design / noise**2 + np.diag(known)
    theta = total[:4, :4] - total[:4, 4:] @ np.linalg.solve(total[4:, 4:], total[4:, :4])
    theta[0, 0] += 3.0 * (trip.mass / max(study.mass_error, 1e-9)) ** 2
    return _of_coefficients(theta, trip.mass, study)


def _stretch(trip: Drawn, study: Study, begin: int, end: int) -> FloatArray:
    """What each parameter, offset and shift does to the speed of one stretch, a row a block."""
    count = (end - begin) // BLOCK * BLOCK
    part = slice(begin, begin + count)
    speed, starts = trip.true_speed[part], trip.gradients.positions
    pieces = starts.size
    piece = np.searchsorted(starts, trip.position[part], side="right") - 1
    first, last = int(piece[0]), int(piece[-1])
    columns = np.zeros((count, 4 + 2 * pieces - 1))
    columns[:, 0] = np.cumsum(trip.effort[part]) * PERIOD
    for power in range(3):
        columns[:, 1 + power] = -np.cumsum(speed**power) * PERIOD
    inside = piece[:, None] == np.arange(first, last + 1)
    columns[:, 4 + first : 5 + last] = -np.cumsum(inside, axis=0) * (
        PERIOD * GRAVITY * study.map_error
    )
    jumps = np.diff(trip.gradients.values)
    for edge in range(first, last):
        after = int(np.argmax(piece > edge))
        shift = study.edge_error / np.sqrt(3.0) / speed[after]
        columns[after:, 4 + pieces + edge] = GRAVITY * jumps[edge] * shift
    return np.asarray(columns.reshape(count // BLOCK, BLOCK, -1).mean(axis=1))


def _of_coefficients(theta: FloatArray, mass: float, study: Study) -> FloatArray:
    """From (1/m, r0/m, r1/m, r2/m) to r0, r1, r2 with the mass marginalised."""
    r = study.resistance
    jacobian = np.zeros((4, 4))
    jacobian[0, 3] = -1.0 / mass**2
    jacobian[1:, :3] = np.eye(3) / mass
    jacobian[1:, 3] = -np.array([r.r0, r.r1, r.r2]) / mass**2
    full = jacobian.T @ theta @ jacobian
    return np.asarray(full[:3, :3] - np.outer(full[:3, 3], full[3, :3]) / full[3, 3])
