"""The fastest run: speed envelope and least time of each configuration.

The envelope is the lower of two curves: full traction from the start, and full braking towards
every speed limit and the end, each with the efforts of every instant. It holds for the continuous
controls, on a grid much finer than the trajectory's, so no trajectory is faster. Where one curve
takes over from another inside a cell its time is found in many parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numba import njit

from analysis.trajectory.discretisation import DiscreteProblem, discretise, largest_beside
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.arrays import BoolArray, FloatArray, IntArray, numbered
from trainlog.errors import InfeasibleError
from trainlog.railway.line import km_words
from trainlog.railway.motion import Brakes, Motion, Traction, brake_backwards, effort_at, speed_of
from trainlog.railway.resistance import arrays_of
from trainlog.units import KMH

_LOSS = 0.1
"""Part of its speed that a train at full traction may lose in a cell of the trajectory."""

_STILL, _FIRST = 0.5, np.array([0.02, 0.06, 0.15, 0.3, 0.5, 0.7, 0.85, 0.95])
"""Part of its first acceleration that a train still has at the end of the first cell, else nodes
follow at parts of the highest ``z`` in it."""

_PACES = 16
"""How many top speeds are tried for a running time."""

_CELL = 10.0
"""Longest cell of the envelope's grid [m]."""


@dataclass(frozen=True, eq=False)
class Envelope:
    """The fastest run of each configuration by itself.

    Attributes
    ----------
    positions : (n + 1,) array [m]
    speeds : (q, n + 1) array [m/s]
    elapsed : (q, n + 1) array [s]
        Time since the start.
    pulling : (q, n) array of bool
        Where full traction is on through the whole cell.
    """

    positions: FloatArray
    speeds: FloatArray
    elapsed: FloatArray
    pulling: BoolArray

    @property
    def times(self) -> FloatArray:
        """Least time from start to end, (q,) [s]."""
        return self.elapsed[:, -1]

    def select(self, rows: Sequence[int]) -> Envelope:
        """That of some of the configurations."""
        some = list(rows)
        return Envelope(self.positions, self.speeds[some], self.elapsed[some], self.pulling[some])

    def at(self, positions: FloatArray) -> FloatArray:
        """Speeds at other positions, (q, n + 1) [m/s]."""
        right = np.clip(np.searchsorted(self.positions, positions), 1, self.positions.size - 1)
        left = right - 1
        share = (positions - self.positions[left]) / (self.positions[right] - self.positions[left])
        squares = self.speeds[:, left] ** 2 * (1.0 - share) + self.speeds[:, right] ** 2 * share
        return np.asarray(np.sqrt(np.maximum(squares, 0.0)))

    def split_on_climbs(self, positions: FloatArray) -> FloatArray:
        """A grid with cells split where the slowest loses much of its speed at full traction.

        The slower it is the more its power gives: within long cells it would stall on paper. So it
        would in a first cell in which most of its acceleration is lost.
        """
        row = int(np.argmax(self.times))
        v = np.maximum(self.speeds[row], 1e-3)
        lost = np.where(self.pulling[row], np.maximum(np.log(v[:-1] / v[1:]), 0.0), 0.0)
        total = np.concatenate(([0.0], np.cumsum(lost)))
        parts = np.ceil(np.diff(np.interp(positions, self.positions, total)) / _LOSS)
        inner = [
            np.linspace(positions[k], positions[k + 1], int(parts[k]) + 1)[1:-1]
            for k in np.flatnonzero(parts > 1.0).tolist()
        ]
        first = self.positions <= positions[1]
        z, s = 0.5 * self.speeds[row][first] ** 2, self.positions[first]
        if s.size > 2 and z[0] == 0.0 and self.pulling[row, 0]:
            slopes = np.diff(z) / np.diff(s)
            if slopes.min() < _STILL * slopes[0]:
                inner.append(np.interp(_FIRST * z.max(), np.maximum.accumulate(z), s))
        return np.unique(np.concatenate((positions, *inner)))

    def times_at(self, positions: Sequence[float]) -> FloatArray:
        """Time of the fastest run from the start to other positions, (q, p) [s]."""
        return np.array([np.interp(positions, self.positions, row) for row in self.elapsed])

    def times_behind_slowest(self, positions: FloatArray) -> FloatArray:
        """Time from the start of a run that is nowhere faster than any of these, (p,) [s]."""
        v = self.speeds.min(axis=0)
        each = 2.0 * np.diff(self.positions) / np.maximum(v[1:] + v[:-1], 1e-9)
        total = np.concatenate(([0.0], np.cumsum(each)))
        return np.asarray(np.interp(positions, self.positions, total))


def fastest_run(run: TrajectoryProblem, cruising: float = np.inf) -> Envelope:
    """Speed envelope and least time of each configuration of `run`.

    Parameters
    ----------
    run : TrajectoryProblem
    cruising : float [m/s]
        Speed that is not exceeded.

    Raises
    ------
    InfeasibleError
        If a configuration cannot climb the line, or cannot brake for a limit or for the end.
    """
    return _fastest_on(discretise(run, _fine_grid(run)), cruising)


@lru_cache(maxsize=4)
def closer(run: TrajectoryProblem, fastest: Envelope, rows: tuple[int, ...]) -> Envelope:
    """The fastest run of some on cells split where its speed changes much or a curve ends another.

    Parameters
    ----------
    run : TrajectoryProblem
    fastest : Envelope
        Of all its configurations.
    rows : tuple of int
        Which of them.
    """
    run, some = _part_of(run, rows)
    fastest = fastest.select(some)
    problem = discretise(run, fastest.positions)
    for _ in range(_SPLITS):
        z, s = 0.5 * fastest.speeds**2, fastest.positions
        step, slopes = np.diff(s), np.diff(z, axis=1) / np.diff(s)
        least = np.maximum(np.minimum(z[:, 1:], z[:, :-1]), _LEAST)
        turn = np.abs(np.diff(slopes, axis=1))
        turn = np.maximum(np.pad(turn, ((0, 0), (1, 0))), np.pad(turn, ((0, 0), (0, 1))))
        # Where full traction hardly keeps a limit the order of the slopes in a cell counts.
        uneven = np.ptp(problem.drag0, axis=2) * fastest.pulling
        parts = np.sqrt(np.maximum(0.25 * turn, 0.125 * uneven) * step / least / _TURN).max(axis=0)
        parts = np.maximum(parts, (np.abs(slopes) * step / least).max(axis=0) / _CHANGE)
        parts = np.where(step > _SHORTEST, np.clip(np.ceil(parts), 1, _MOST_PARTS), 1).astype(int)
        if parts.max() == 1:
            break
        cell, number = numbered(parts)
        problem = discretise(run, np.append(s[cell] + number / parts[cell] * step[cell], s[-1]))
        fastest = _fastest_on(problem)
    return fastest.select(range(len(rows)))


def _part_of(run: TrajectoryProblem, rows: tuple[int, ...]) -> tuple[TrajectoryProblem, list[int]]:
    """The run of some configurations under the traction that all have, and which those are."""
    # The lightest has the least traction.
    lightest = int(np.argmin([each.inertia for each in run.configurations]))
    some = [*rows, *{lightest}.difference(rows)]
    return replace(run, configurations=[run.configurations[row] for row in some], weights=()), some


def _fastest_on(problem: DiscreteProblem, cruising: float = np.inf) -> Envelope:
    run = problem.run
    traction, motion = Traction.of(problem.traction, problem.power), motion_of(problem)
    if problem.curves is not None:
        # As published, not as plans keep to it: no trajectory is faster.
        traction = Traction(problem.traction, problem.power, *problem.curves.own_arrays)
    middles = problem.positions[:-1] + 0.5 * problem.step
    limits = 0.5 * np.minimum(run.permitted_speed(middles), cruising) ** 2
    # What a cell's constant efforts would have the speed rise above its ends does not count here.
    ceiling = np.minimum(problem.ceiling + largest_beside(problem.bulge), 0.5 * cruising**2)
    brakes = _brakes_of(problem)
    ends = problem.initial, problem.final
    curve, z, seconds = fastest_below(ceiling, limits, ends, traction, brakes, motion)
    _check_brakes(run, problem, curve)
    stands = (z[:, 1:-1] <= 0.0) & (curve[:, 1:-1] > 0.0)
    for a in np.flatnonzero(stands.any(axis=1)).tolist():
        raise InfeasibleError(
            f"configuration '{run.configurations[a].name}' comes to a stand at"
            f" {km_words(run.line, problem.positions[np.argmax(stands[a])])}: full traction"
            " does not overcome the line there",
            remedy="less load, more adhesion, or a run that begins elsewhere"
            + run.steepness(float(problem.positions[np.argmax(stands[a])])),
        )
    elapsed = np.column_stack((np.zeros(z.shape[0]), np.cumsum(seconds, axis=1)))
    pulling = z[:, 1:] < curve[:, 1:]
    return Envelope(problem.positions, np.sqrt(2.0 * z), elapsed, pulling)


@dataclass(frozen=True, eq=False)
class Floor:
    """Speeds below which no trajectory in time is, for each configuration.

    Attributes
    ----------
    positions : (m,) array [m]
    z : (q, m) array [m²/s²]
        The least there.
    slopes : (q, m - 1) array [m/s²]
        By which ``z`` rises at most towards the next position.
    """

    positions: FloatArray
    z: FloatArray
    slopes: FloatArray

    def at(self, positions: FloatArray) -> FloatArray:
        """Speeds at other positions, (q, ...) [m/s]: what is lower cannot reach the next one."""
        place = positions.ravel()
        right = np.clip(np.searchsorted(self.positions, place), 1, self.positions.size - 1)
        z = self.z[:, right]
        lower = z - self.slopes[:, right - 1] * (self.positions[right] - place)
        # The slopes hold down to half the speed.
        found = np.sqrt(2.0 * np.where(lower >= 0.25 * z, np.maximum(lower, 0.0), 0.0))
        return np.asarray(found.reshape(-1, *positions.shape))


_FLOORS = 600
"""Places at which the least speeds are found, even in time."""

_IN_HAND, _INEXACT = (1.01, 0.05), 2e-4
"""Times what a run has in hand and seconds more, and part of the time, that it may lose."""


@lru_cache(maxsize=4)
def floor_of(
    run: TrajectoryProblem, fastest: Envelope, rows: tuple[int, ...], running_time: float
) -> Floor:
    """The least speeds of some of the configurations that still keep the running time.

    Whoever passes a place at a speed was no faster before than by full braking to it, and is no
    faster behind than by full traction from it. What that costs beyond the fastest run is no more
    than what is in hand.

    Parameters
    ----------
    run : TrajectoryProblem
    fastest : Envelope
        Of all its configurations.
    rows : tuple of int
        Which of them.
    running_time : float [s]
    """
    part, _ = _part_of(run, rows)
    problem = discretise(part, fastest.positions).select(range(len(rows)))
    traction, motion = Traction.of(problem.traction, problem.power), motion_of(problem)
    if problem.curves is not None:
        traction = Traction(problem.traction, problem.power, *problem.curves.own_arrays)
    speeds, elapsed = fastest.speeds[list(rows)], fastest.elapsed[list(rows)]
    in_hand = _IN_HAND[0] * np.maximum(running_time - elapsed[:, -1], 0.0) + _IN_HAND[1]
    in_hand += _INEXACT * running_time
    seconds = elapsed[int(np.argmax(elapsed[:, -1]))]
    even = np.linspace(0.0, seconds[-1], _FLOORS)
    nodes = np.unique(np.append(np.searchsorted(seconds, even), seconds.size - 1))
    z = slowest_within(0.5 * speeds**2, nodes, in_hand, traction, _brakes_of(problem), motion)
    half = 0.5 * np.sqrt(2.0 * np.maximum(z[:, 1:], 1e-9))
    pull = np.maximum.reduceat(problem.traction, nodes[:-1])
    down = np.maximum.reduceat(np.maximum(-problem.drag0.min(axis=2), 0.0), nodes[:-1], axis=1)
    most = np.minimum(pull, problem.power[:, None] / half)
    return Floor(fastest.positions[nodes], z, problem.gain[:, None] * most + down)


def paced_envelope(run: TrajectoryProblem, running_time: float) -> Envelope | None:
    """Runs of all configurations at one top speed, the lowest that keeps the time, with one power.

    Under the power of the weakest all can follow the slowest, those that could be faster by
    braking: with traction in common too, a feasible run, but for what a grid takes from it.

    Returns
    -------
    Envelope or None
        None if not even the fastest such run is in time.
    """
    run = _with_one_power(run)
    slow = max(run.initial_speed, 0.5 * (run.end - run.start) / running_time)
    fast = max(slow, float(run.train.max_speed))
    try:
        found = fastest_run(run)
    except InfeasibleError:
        return None
    if found.times.max() > running_time:
        return None
    for _ in range(_PACES):
        middle = 0.5 * (slow + fast)
        trial = fastest_run(run, middle)
        if trial.times.max() > running_time:
            slow = middle
        else:
            fast, found = middle, trial
    return found


def least_paced_time(run: TrajectoryProblem) -> float:
    """Time of the fastest run of all behind the slowest, with one power [s]; infinite if none."""
    try:
        found = fastest_run(_with_one_power(run))
    except InfeasibleError:
        return np.inf
    return float(found.times_behind_slowest(found.positions[-1:])[0])


def _with_one_power(run: TrajectoryProblem) -> TrajectoryProblem:
    """All configurations with the power of the weakest."""
    weakest = min(configuration.max_power for configuration in run.configurations)
    alike = [replace(each, max_power=weakest) for each in run.configurations]
    return replace(run, configurations=alike)


def _check_brakes(run: TrajectoryProblem, problem: DiscreteProblem, curve: FloatArray) -> None:
    """Refuse a slope on which a configuration cannot brake, and a start that is too fast."""
    low = np.argmin(curve, axis=1)
    for a, configuration in enumerate(run.configurations):
        # A curve that reaches 0 before its end: the slope is too steep.
        if curve[a, low[a]] <= 0.0 and low[a] < curve.shape[1] - 1:
            raise InfeasibleError(
                f"configuration '{configuration.name}' cannot brake on the slope at"
                f" {km_words(run.line, problem.positions[low[a]])}",
                remedy="check its mass, the gradient there and the braking effort"
                + run.steepness(float(problem.positions[low[a]])),
            )
        if problem.initial > curve[a, 0] * (1.0 + 1e-9) + 1e-9:
            raise InfeasibleError(
                f"configuration '{configuration.name}' starts at"
                f" {KMH * run.initial_speed:.1f} km/h and cannot brake in time: at most"
                f" {KMH * float(speed_of(curve[a, 0])):.1f} km/h",
                remedy="begin the run slower or end it faster",
            )


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
    brakes = _brakes_of(replace(problem, braking=problem.usable_braking))
    motion = motion_of(problem)
    curve: FloatArray = brake_backwards(ceiling, problem.final, traction, brakes, motion)
    return curve


def motion_of(problem: DiscreteProblem) -> Motion:
    """What resists the configurations of a problem."""
    return Motion(problem.gain, problem.drag0, problem.drag1, problem.drag2, problem.step)


def _brakes_of(problem: DiscreteProblem) -> Brakes:
    curves = problem.dynamic_curves
    return Brakes(
        problem.braking, problem.friction, problem.dynamic, problem.dynamic_power,
        *arrays_of(None if curves is None else curves.kept),
    )  # fmt: skip


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


_SPLITS, _MOST_PARTS = 3, 8
"""How often the cells of a closer run are split, and into how many parts at most."""

_TURN, _CHANGE, _LEAST = 1e-5, 0.1, 1e-4
"""By what part of its ``z`` a run may leave the line between two nodes, and by what part it may
change in a cell; and the least ``z`` that counts [m²/s²]."""

_SHORTEST = 0.01
"""Length of a cell that is split no further [m]."""

_HELD = 1e-5
"""Part of a limit's ``z`` within which a train is held by it through a cell."""

_PARTS = 64
"""Parts of a cell in which one curve takes over from another."""

_LEAST_Z = 1e-300
"""``z`` at which a train stands: one speed is not 0, so that a power can be over it."""

_Cell = tuple[float, float, float, float, float, float, float, float]
"""Full effort in a cell: its limit, the part that does not fall with the speed, the most and the
power of the other part; the gain; and what adds to the slope of ``z``, by itself, times the speed
and times its square."""


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _slope(z: float, cell: _Cell, speeds: FloatArray | None, efforts: FloatArray) -> float:
    """Slope of ``z`` at full effort, along the line in traction and backwards in braking."""
    limit, steady, other, power, gain, drag0, drag1, drag2 = cell
    # Without a branch that keeps the processor from doing several at once.
    v = np.sqrt(2.0 * max(z, _LEAST_Z))
    effort = min(other, power / v)
    if speeds is not None:
        effort = min(effort, effort_at(v, speeds, efforts))
    effort = min(limit, steady + effort)
    return float(gain * effort + drag0 + drag1 * v + drag2 * v * v)


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _after(
    z: float, h: float, cell: _Cell, speeds: FloatArray | None, efforts: FloatArray
) -> float:
    """``z`` after `h` metres at full effort: Runge-Kutta of order four."""
    k1 = _slope(z, cell, speeds, efforts)
    k2 = _slope(z + 0.5 * h * k1, cell, speeds, efforts)
    k3 = _slope(z + 0.5 * h * k2, cell, speeds, efforts)
    k4 = _slope(z + h * k3, cell, speeds, efforts)
    return float(z + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4))


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _through(
    z: FloatArray, h: float, cells: tuple[FloatArray, ...], speeds: FloatArray,
    efforts: FloatArray, least: float, middle: FloatArray, after: FloatArray,
) -> None:  # fmt: skip
    """``z`` of each configuration after half a cell of `h` metres, at least so much, and after it.

    Parameters
    ----------
    cells : tuple of (q,) array
        As a `_Cell` each.
    speeds, efforts : (q, m), (m,) array
        Of a curve of effort; a single point is no limit.
    """
    limit, steady, other, power, gain, drag0, drag1, drag2 = cells
    if efforts.size > 1:
        for a in range(z.size):
            cell = (
                limit[a], steady[a], other[a], power[a], gain[a], drag0[a], drag1[a], drag2[a]
            )  # fmt: skip
            middle[a] = max(_after(z[a], 0.5 * h, cell, speeds[a], efforts), least)
            after[a] = _after(middle[a], 0.5 * h, cell, speeds[a], efforts)
    else:
        for a in range(z.size):
            cell = (
                limit[a], steady[a], other[a], power[a], gain[a], drag0[a], drag1[a], drag2[a]
            )  # fmt: skip
            middle[a] = max(_after(z[a], 0.5 * h, cell, None, efforts), least)
            after[a] = _after(middle[a], 0.5 * h, cell, None, efforts)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _time_through(z: float, middle: float, after: float, h: float) -> float:
    """Time of a cell by the speeds at its ends and in its middle, extrapolated to order four."""
    v, v_middle, v_after = speed_of(z), speed_of(middle), speed_of(after)
    if v + v_after <= 0.0 or v_middle <= 0.0:
        return np.inf
    whole = 2.0 * h / (v + v_after)
    halves = h / (v + v_middle) + h / (v_middle + v_after)
    return float((4.0 * halves - whole) / 3.0)


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _mean(drag0: FloatArray) -> float:
    """Mean over a cell of what is given at the ends of equal parts."""
    inner = 0.0
    for j in range(1, drag0.size - 1):
        inner += drag0[j]
    return float((0.5 * (drag0[0] + drag0[-1]) + inner) / (drag0.size - 1))


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _pull_at(traction: Traction, motion: Motion, own: FloatArray, a: int, k: int) -> _Cell:
    """Full traction of a configuration in a cell."""
    return (
        traction.limit[k], 0.0, np.inf, traction.power[a], motion.gain[a], -own[k, a],
        -motion.drag1[a], -motion.drag2[a, k],
    )  # fmt: skip


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _brake_at(brakes: Brakes, motion: Motion, own: FloatArray, a: int, k: int) -> _Cell:
    """Full braking of a configuration in a cell."""
    return (
        brakes.limit[a, k], brakes.friction[a, k], brakes.dynamic[a, k], brakes.dynamic_power,
        motion.gain[a], own[k, a], motion.drag1[a], motion.drag2[a, k],
    )  # fmt: skip


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def fastest_below(
    ceiling: FloatArray, limits: FloatArray, ends: tuple[float, float], traction: Traction,
    brakes: Brakes, motion: Motion,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Full braking backwards from the end, then full traction from the start below that curve.

    Parameters
    ----------
    ceiling : (n + 1,) array [m²/s²]
        Largest permitted ``z`` at the nodes.
    limits : (n,) array [m²/s²]
        The same inside the cells.
    ends : (float, float) [m²/s²]
        ``z`` at the start, and the most at the end.
    traction : Traction
    brakes : Brakes
    motion : Motion

    Returns
    -------
    curve, z : (q, n + 1) array [m²/s²]
        Of the braking, and of the run; 0 from where on it cannot go on.
    times : (q, n) array [s]
        In each cell.
    """
    gain, drag0, drag1, drag2, step = motion
    q, n = drag2.shape
    curve, z, times = np.empty((q, n + 1)), np.empty((q, n + 1)), np.empty((q, n))
    ahead, behind = np.empty(_PARTS + 1), np.empty(_PARTS + 1)
    middle, after, own = np.empty(q), np.empty(q), np.empty((n, q))
    limit, friction, dynamic, square = (
        brakes.limit.T.copy(), brakes.friction.T.copy(), brakes.dynamic.T.copy(), drag2.T.copy()
    )  # fmt: skip
    for a in range(q):
        for k in range(n):
            own[k, a] = _mean(drag0[a, k])
    track, linear, quadratic, pulled = -own, -drag1, -square, np.empty(q)
    none, without, dynamic_power = np.zeros(q), np.full(q, np.inf), np.full(q, brakes.dynamic_power)
    brake_speeds = np.repeat(brakes.speeds, q).reshape(-1, q).T.copy()
    y = np.full(q, min(ends[1], ceiling[n]))
    curve[:, n] = y
    for k in range(n - 1, -1, -1):
        cells = limit[k], friction[k], dynamic[k], dynamic_power, gain, own[k], drag1, square[k]
        _through(y, step[k], cells, brake_speeds, brakes.efforts, -np.inf, middle, after)
        for a in range(q):
            z_after, y[a] = y[a], max(min(after[a], ceiling[k]), 0.0)
            if z_after >= ceiling[k] and y[a] < ceiling[k]:
                # Where the brake slows a train at the ceiling it does so all through the cell.
                brake = _brake_at(brakes, motion, own, a, k)
                if _slope(ceiling[k], brake, brakes.speeds, brakes.efforts) > 0.0:
                    y[a] = ceiling[k]
            curve[a, k] = y[a]
    for a in range(q):
        y[a] = z[a, 0] = min(ends[0], curve[a, 0])
    for k in range(n):
        h, highest = step[k], limits[k]
        pulled[:] = traction.limit[k]
        cells = pulled, none, without, traction.power, gain, track[k], linear, quadratic[k]
        _through(y, h, cells, traction.speeds, traction.efforts, 0.0, middle, after)
        for a in range(q):
            begin, target = y[a], curve[a, k + 1]
            y[a] = z[a, k + 1] = target
            held = min(begin, target) >= highest * (1.0 - _HELD)
            pull = _pull_at(traction, motion, own, a, k)
            speeds, efforts = traction.speeds[a], traction.efforts
            if held and begin >= target and _slope(begin, pull, speeds, efforts) > 0.0:
                times[a, k] = 2.0 * h / (speed_of(begin) + speed_of(target))
                continue
            if after[a] <= target:
                y[a] = z[a, k + 1] = max(after[a], 0.0)
                times[a, k] = _time_through(begin, middle[a], after[a], h)
                continue
            if held:
                times[a, k] = 2.0 * h / (speed_of(begin) + speed_of(target))
                continue
            brake = _brake_at(brakes, motion, own, a, k)
            between = _after(target, 0.5 * h, brake, brakes.speeds, brakes.efforts)
            if begin == _after(between, 0.5 * h, brake, brakes.speeds, brakes.efforts):
                times[a, k] = _time_through(begin, between, target, h)
                continue
            ahead[0], behind[_PARTS] = begin, target
            part = h / _PARTS
            for j in range(_PARTS):
                gained = _after(ahead[j], part, pull, speeds, efforts)
                before = _after(behind[_PARTS - j], part, brake, brakes.speeds, brakes.efforts)
                ahead[j + 1], behind[_PARTS - j - 1] = min(gained, highest), min(before, highest)
            spent = 0.0
            for j in range(_PARTS):
                v = speed_of(min(ahead[j], behind[j]))
                spent += 2.0 * part / (v + speed_of(min(ahead[j + 1], behind[j + 1])))
            times[a, k] = spent
    return curve, z, times


_TRIALS = 7
"""Speeds that are tried at a place, each in the middle of what is left."""


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def slowest_within(
    z: FloatArray, nodes: IntArray, in_hand: FloatArray, traction: Traction, brakes: Brakes,
    motion: Motion,
) -> FloatArray:  # fmt: skip
    """Least ``z`` at some nodes of runs that lose no more than `in_hand` over the fastest.

    Parameters
    ----------
    z : (q, n + 1) array [m²/s²]
        Of the fastest runs.
    nodes : (m,) array of int
    in_hand : (q,) array [s]
    traction : Traction
    brakes : Brakes
    motion : Motion

    Returns
    -------
    (q, m) array [m²/s²]
    """
    q, n = motion.drag2.shape
    step, speeds, efforts = motion.step, brakes.speeds, brakes.efforts
    found, own = np.zeros((q, nodes.size)), np.empty((n, q))
    for a in range(q):
        for k in range(n):
            own[k, a] = _mean(motion.drag0[a, k])
        for place in range(nodes.size):
            node, low, high = nodes[place], 0.0, 1.0
            for _ in range(_TRIALS):
                part = 0.5 * (low + high)
                lost, y, k = 0.0, part * z[a, node], node
                while k < n and y < z[a, k] and lost <= in_hand[a]:
                    pull = _pull_at(traction, motion, own, a, k)
                    after = _after(y, step[k], pull, traction.speeds[a], traction.efforts)
                    lost += _lost(y, after, z[a, k], z[a, k + 1], step[k])
                    y, k = after, k + 1
                y, k = part * z[a, node], node
                while k > 0 and y < z[a, k] and lost <= in_hand[a]:
                    brake = _brake_at(brakes, motion, own, a, k - 1)
                    before = _after(y, step[k - 1], brake, speeds, efforts)
                    lost += _lost(before, y, z[a, k - 1], z[a, k], step[k - 1])
                    y, k = before, k - 1
                if lost > in_hand[a]:
                    low = part
                else:
                    high = part
            found[a, place] = low * z[a, node]
    return found


@njit(cache=True)  # type: ignore[untyped-decorator]
def _lost(z: float, after: float, fast: float, fast_after: float, h: float) -> float:
    """Time that a cell takes longer than at the fastest; infinite for one that stands."""
    total = speed_of(min(z, fast)) + speed_of(min(after, fast_after))
    if total <= 0.0:
        return np.inf
    return float(2.0 * h / total - 2.0 * h / (speed_of(fast) + speed_of(fast_after)))
