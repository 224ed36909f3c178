"""Shortest running times of formations with a tractive-effort curve."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainlog.errors import InfeasibleError, InputError
from trainlog.railway import Line
from trainlog.railway.formation import Formation
from trainlog.simulation.drivers import braking_ceiling
from trainlog.units import GRAVITY

FloatArray = NDArray[np.float64]


COARSEST = 0.005
"""Change of the running time by half the step, relative, beyond which a step is too coarse."""


@dataclass(frozen=True, eq=False)
class ShortestRun:
    """A run at full effort; (n,) arrays.

    Attributes
    ----------
    positions, speeds, times : [m], [m/s], [s]
    """

    positions: FloatArray
    speeds: FloatArray
    times: FloatArray

    @property
    def running_time(self) -> float:
        """From standing at the start to standing at the end [s]."""
        return float(self.times[-1])


def shortest_run(
    line: Line, formation: Formation, *, loaded: float = 1.0, step: float = 1.0
) -> ShortestRun:
    """Run a formation from one end of the line to the other as fast as it can.

    Full effort, permitted speeds kept with the whole length of the train, constant deceleration
    in braking. In each step the acceleration is that of its beginning, as in TrainRuns.jl, whose
    own step is 20 m; the result converges with the step.

    Parameters
    ----------
    line : Line
        As travelled.
    formation : Formation
    loaded : float
        Share of the heaviest load that is on board.
    step : float [m]
        Longest step.

    Raises
    ------
    InputError
        If the step or the share makes no sense, or the step is too coarse: half of it would change
        the running time by more than `COARSEST`.
    InfeasibleError
        If the formation cannot start, or comes to a stand on the line.
    """
    if not (step > 0.0 and np.isfinite(step)):
        raise InputError(f"a step of {step} m makes no sense")
    if not 0.0 <= loaded <= 1.0:
        raise InputError(f"a share of {loaded} of the load makes no sense", remedy="give 0 to 1")
    run, finer = (_run_with(line, formation, loaded, each) for each in (step, 0.5 * step))
    change = abs(finer.running_time / run.running_time - 1.0)
    if change > COARSEST:
        raise InputError(
            f"step of {step:g} m is too coarse for formation '{formation.name}': half of it changes"
            f" the running time by {100.0 * change:.1f} %",
            remedy=f"use at most {step * COARSEST / change:.0f} m",
        )
    return run


def _run_with(line: Line, formation: Formation, loaded: float, step: float) -> ShortestRun:
    """The run with one step."""
    mass = formation.mass(loaded)
    positions = _grid(line, formation.length, step)
    limits = np.minimum(line.limits_over(formation.length)(positions), formation.max_speed)
    limits[-1] = 0.0
    ceiling = braking_ceiling(positions, limits, formation.deceleration)
    knots = np.unique(
        np.concatenate(
            [each.effort.speeds for each in formation.vehicles if each.powered and each.effort]
        )
    )
    drag = formation.resistance(loaded)
    # Per mille of railways are force over weight.
    slope = GRAVITY * mass * line.gradient(positions[:-1])
    speeds, stalled = _run(
        positions, ceiling, slope, knots, formation.tractive_effort(knots),
        np.array([drag.r0, drag.r1, drag.r2]), formation.inertia(loaded),
    )  # fmt: skip
    if stalled >= 0:
        raise InfeasibleError(
            f"formation '{formation.name}' comes to a stand at km {positions[stalled] / 1e3:.3f}:"
            " full effort does not overcome the line there",
            remedy="less load, or another traction unit",
        )
    times = np.concatenate(
        ([0.0], np.cumsum(2.0 * np.diff(positions) / (speeds[1:] + speeds[:-1])))
    )
    return ShortestRun(positions, speeds, times)


def _grid(line: Line, length: float, step: float) -> FloatArray:
    """Breakpoints of the line, where the rear passes a change of speed, and steps between them."""
    changes = np.concatenate(
        (line.breakpoints, line.speed_limits.positions + length, [line.length])
    )
    edges = np.unique(changes[(changes >= 0.0) & (changes <= line.length)])
    pieces = [
        low + np.arange(max(int(np.ceil((high - low) / step - 1e-9)), 1)) * step
        for low, high in pairwise(edges.tolist())
    ]
    return np.append(np.concatenate(pieces), line.length)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _run(
    positions: FloatArray,
    ceiling: FloatArray,
    slope: FloatArray,
    knots: FloatArray,
    efforts: FloatArray,
    drag: FloatArray,
    inertia: float,
) -> tuple[FloatArray, int]:
    """Speeds at the positions, and the place where the train stalls or -1."""
    speeds = np.zeros(positions.size)
    k = 0
    for at in range(positions.size - 1):
        v = speeds[at]
        while k > 0 and v < knots[k]:
            k -= 1
        while k + 1 < knots.size and v >= knots[k + 1]:
            k += 1
        pull = efforts[k]
        if k + 1 < knots.size:
            share = (v - knots[k]) / (knots[k + 1] - knots[k])
            pull += share * (efforts[k + 1] - efforts[k])
        force = pull - drag[0] - (drag[1] + drag[2] * v) * v - slope[at]
        square = v * v + 2.0 * (force / inertia) * (positions[at + 1] - positions[at])
        if square <= 0.0:
            return speeds, at
        speeds[at + 1] = min(np.sqrt(square), ceiling[at + 1])
    return speeds, -1
