"""The fastest run: speed envelope and least time of each configuration.

The envelope is the lower of two curves: full traction from the start, and full braking towards
every speed limit and the end. It holds for the continuous controls, on a grid much finer than the
trajectory's, so no trajectory is faster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.discretisation import DiscreteProblem, discretise
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.errors import InfeasibleError
from trainlog.railway.effort import arrays_of
from trainlog.railway.motion import (
    Brakes,
    Motion,
    Traction,
    brake_backwards,
    in_parts,
    pull_forwards,
    speed_of,
)
from trainlog.units import KMH

FloatArray = NDArray[np.float64]

_CELL = 10.0
"""Longest cell of the envelope's grid [m]."""


@dataclass(frozen=True, eq=False)
class Envelope:
    """The fastest run of each configuration by itself.

    Attributes
    ----------
    positions : (n + 1,) array [m]
    speeds : (q, n + 1) array [m/s]
    times : (q,) array [s]
        Least time from start to end.
    """

    positions: FloatArray
    speeds: FloatArray
    times: FloatArray

    def at(self, positions: FloatArray) -> FloatArray:
        """Speeds at other positions, (q, n + 1) [m/s]."""
        right = np.clip(np.searchsorted(self.positions, positions), 1, self.positions.size - 1)
        left = right - 1
        share = (positions - self.positions[left]) / (self.positions[right] - self.positions[left])
        squares = self.speeds[:, left] ** 2 * (1.0 - share) + self.speeds[:, right] ** 2 * share
        return np.asarray(np.sqrt(np.maximum(squares, 0.0)))

    def times_at(self, positions: Sequence[float]) -> FloatArray:
        """Time of the fastest run from the start to other positions, (q, p) [s]."""
        mean = 0.5 * (self.speeds[:, :-1] + self.speeds[:, 1:])
        times = np.cumsum(np.diff(self.positions) / mean, axis=1)
        times = np.column_stack((np.zeros(times.shape[0]), times))
        return np.array([np.interp(positions, self.positions, row) for row in times])


def fastest_run(run: TrajectoryProblem) -> Envelope:
    """Speed envelope and least time of each configuration of `run`.

    Raises
    ------
    InfeasibleError
        If a configuration cannot climb the line, or cannot brake for a limit or for the end.
    """
    problem = discretise(run, _fine_grid(run))
    curve = braking_curves(problem)
    low = np.argmin(curve, axis=1)
    for a, configuration in enumerate(run.configurations):
        # A curve that reaches 0 before its end: the slope is too steep.
        if curve[a, low[a]] <= 0.0 and low[a] < curve.shape[1] - 1:
            raise InfeasibleError(
                f"configuration '{configuration.name}' cannot brake on the slope at"
                f" km {problem.positions[low[a]] / 1e3:.3f}",
                remedy="check its mass, the gradient there and the braking effort",
            )
        if problem.initial > curve[a, 0] * (1.0 + 1e-9) + 1e-9:
            raise InfeasibleError(
                f"configuration '{configuration.name}' starts at"
                f" {KMH * run.initial_speed:.1f} km/h and cannot brake in time: at most"
                f" {KMH * float(speed_of(curve[a, 0])):.1f} km/h",
                remedy="begin the run slower or end it faster",
            )
    traction, motion = Traction.of(problem.traction, problem.power), _motion_of(problem)
    if problem.curves is not None:
        # As published, not as plans keep to it: no trajectory is faster.
        traction = Traction(problem.traction, problem.power, *problem.curves.own_arrays)
    z, stalled = in_parts(
        problem.shape[0],
        lambda part: pull_forwards(
            curve[part], problem.initial, traction.rows(part), motion.rows(part)
        ),
    )
    for a, configuration in enumerate(run.configurations):
        if stalled[a] >= 0:
            raise InfeasibleError(
                f"configuration '{configuration.name}' comes to a stand at"
                f" km {problem.positions[stalled[a]] / 1e3:.3f}: full traction does not overcome"
                " the line there",
                remedy="less load, more adhesion, or a run that begins elsewhere",
            )
    speeds = np.sqrt(2.0 * z)
    times = (2.0 * problem.step / (speeds[:, :-1] + speeds[:, 1:])).sum(axis=1)
    return Envelope(problem.positions, speeds, times)


def braking_curves(problem: DiscreteProblem, traction: FloatArray | None = None) -> FloatArray:
    """Highest ``z`` at each node from which every limit ahead can still be kept.

    Parameters
    ----------
    traction : (n,) array, optional [m/s²]
        A common traction that is applied whatever a configuration does: it has to brake against
        it, and to stay slow enough for its power.

    Returns
    -------
    (q, n + 1) array
    """
    ceiling = np.tile(problem.ceiling, (problem.shape[0], 1))
    if traction is None:
        traction = np.zeros(problem.shape[1])
    else:
        usable = problem.power[:, None] * (1.0 - problem.taper.crest)
        for nodes, above in (
            (slice(0, -1), problem.taper.fall),
            (slice(1, None), -problem.taper.fall),
        ):
            fastest = usable / np.maximum(traction + above, 1e-9)
            if problem.curves is not None:
                by_curve = problem.curves.speed_at((traction + above) / (1.0 - problem.taper.crest))
                fastest = np.minimum(fastest, by_curve)
            highest = np.maximum(0.5 * fastest**2 - problem.bulge, 0.0)
            ceiling[:, nodes] = np.minimum(ceiling[:, nodes], highest)
    curves = problem.dynamic_curves
    brakes = Brakes(
        problem.braking, problem.friction, problem.dynamic, problem.dynamic_power,
        *arrays_of(None if curves is None else curves.kept),
    )  # fmt: skip
    motion = _motion_of(problem)
    return in_parts(
        problem.shape[0],
        lambda part: (
            brake_backwards(
                ceiling[part], problem.final, traction, brakes.rows(part), motion.rows(part)
            ),
        ),
    )[0]


def _motion_of(problem: DiscreteProblem) -> Motion:
    return Motion(problem.gain, problem.drag0, problem.drag1, problem.drag2, problem.step)


def _fine_grid(run: TrajectoryProblem) -> FloatArray:
    """The breakpoints, cells of 10 m, and cells that shrink towards both ends."""
    edges = run.breakpoints
    ramp = 0.02 * 1.25 ** np.arange(32)
    ramp = ramp[ramp < 0.25 * (run.end - run.start)]
    even = np.linspace(run.start, run.end, int(np.ceil((run.end - run.start) / _CELL)) + 1)
    points = np.unique(np.concatenate((even, run.start + ramp, run.end - ramp)))
    # A grid point beside a breakpoint gives way to it.
    gap = np.abs(points - edges[np.searchsorted(edges, points).clip(0, edges.size - 1)])
    below = np.abs(points - edges[(np.searchsorted(edges, points) - 1).clip(0)])
    return np.unique(np.concatenate((edges, points[np.minimum(gap, below) > 5e-3])))
