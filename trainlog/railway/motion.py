"""The motion of a train along a line, compiled: cells of constant effort, braking, fastest runs.

``z = v²/2`` follows

    dz/ds = gain (f - b) - drag0 - drag1 v - drag2 v²

with tractive effort f and braking effort b over a reference inertia, and ``gain`` that inertia over
the train's own; Cunillera et al. (2022), eq. (2). Runge-Kutta of order four in a few sub-steps;
``drag0`` is given at their ends and linear between them, as curvature is. The time of a sub-step is
that of constant acceleration, ``2 ds / (v + v')``, which stays finite from standstill and to
standstill, once over the whole and once over its halves, extrapolated to order four.

A fastest run is the lower of two curves: full traction from the start, and full braking towards
every speed limit and the end. That of a timetable takes the acceleration of each step's beginning.
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator, no-any-return"

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from trainlog.arrays import FloatArray, IntArray
from trainlog.railway.line import Line
from trainlog.railway.resistance import NO_CURVE, EffortCurve, arrays_of
from trainlog.railway.train import Train

SUBSTEPS = 4
"""Runge-Kutta sub-steps a cell; the audit takes many more."""

TIMETABLE_STEP = 5.0
"""Step of the running times that timetables are made of [m]."""

SLOWEST = 0.5
"""Speed [m/s] that a timetable counts on where full traction does not overcome the line."""


class Motion(NamedTuple):
    """What resists q trains in n cells, over one reference inertia.

    Attributes
    ----------
    gain : (q,) array
        Reference inertia over the train's.
    drag0 : (q, n, SUBSTEPS + 1) array [m/s²]
        Gradient, curves and constant running resistance at the ends of equal parts of each cell.
    drag1 : (q,) array [1/s]
    drag2 : (q, n) array [1/m]
        With the tunnel's share.
    step : (n,) array [m]
    """

    gain: FloatArray
    drag0: FloatArray
    drag1: FloatArray
    drag2: FloatArray
    step: FloatArray


Cell = tuple[FloatArray, FloatArray, FloatArray, float]
"""What resists q trains in one cell: ``drag0`` as (SUBSTEPS + 1, q) array, ``drag1`` and ``drag2``
as (q,) arrays, and its length."""


class Traction(NamedTuple):
    """Largest tractive effort, over the reference inertia: the least of three limits.

    Attributes
    ----------
    limit : (n,) array [m/s²]
        By machine, comfort and adhesion in each cell.
    power : (q,) array [W/kg]
    speeds : (q, m) array [m/s]
        Points of each train's curve of effort; see `effort_at`.
    efforts : (m,) array [m/s²]
        Of the curves at their points.
    """

    limit: FloatArray
    power: FloatArray
    speeds: FloatArray
    efforts: FloatArray

    @staticmethod
    def of(limit: FloatArray, power: FloatArray, curve: EffortCurve | None = None) -> Traction:
        """Traction of trains whose curves, if any, are the same [m/s²]."""
        speeds, efforts = arrays_of(curve)
        return Traction(limit, power, np.tile(speeds, (power.size, 1)), efforts)


class Brakes(NamedTuple):
    """Largest braking efforts, over the reference inertia.

    Attributes
    ----------
    limit, friction, dynamic : (q, n) array [m/s²]
        Of all brakes together, and of each kind.
    dynamic_power : float [W/kg]
    speeds, efforts : (m,) array [m/s], [m/s²]
        Of the dynamic brake's curve; see `effort_at`.
    """

    limit: FloatArray
    friction: FloatArray
    dynamic: FloatArray
    dynamic_power: float
    speeds: FloatArray = NO_CURVE[0]
    efforts: FloatArray = NO_CURVE[1]


@njit(cache=True, error_model="numpy")
def effort_at(v: float, speeds: FloatArray, efforts: FloatArray) -> float:
    """Effort of a curve at a speed: `EffortCurve`, compiled; a single point is no limit."""
    last = speeds.size - 1
    if last == 0:
        return efforts[0]
    if v >= speeds[last]:
        return efforts[last] * speeds[last] / v
    low, high = 0, last
    while high - low > 1:
        middle = (low + high) // 2
        if v < speeds[middle]:
            high = middle
        else:
            low = middle
    share = (v - speeds[low]) / (speeds[high] - speeds[low])
    return efforts[low] + share * (efforts[high] - efforts[low])


@njit(cache=True, error_model="numpy")
def speed_of(z: float) -> float:
    """Speed [m/s] of ``z = v²/2``; 0 below 0, where a train has stopped."""
    # Without a branch that keeps the processor from doing several at once.
    return float(np.sqrt(2.0 * max(z, 0.0)))


@njit(cache=True, error_model="numpy")
def _slope(z: float, net: float, drag1: float, drag2: float) -> float:
    return float(net - drag1 * speed_of(z) - 2.0 * drag2 * z)


@njit(cache=True, error_model="numpy")
def _after(z: float, first: float, last: float, drag1: float, drag2: float, h: float) -> float:
    """``z`` after `h` [m], the net force changing from `first` to `last`."""
    mean = 0.5 * (first + last)
    k1 = _slope(z, first, drag1, drag2)
    k2 = _slope(z + 0.5 * h * k1, mean, drag1, drag2)
    k3 = _slope(z + 0.5 * h * k2, mean, drag1, drag2)
    k4 = _slope(z + h * k3, last, drag1, drag2)
    return z + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@njit(cache=True, error_model="numpy")
def _seconds(
    z: float, after: float, first: float, last: float, drag: tuple[float, float], h: float
) -> float:
    """Time of these `h` metres; infinite where the train stands."""
    bend = _slope(z, first, *drag) - _slope(after, last, *drag)
    middle = 0.5 * (z + after) + 0.125 * h * bend
    v, v_middle, v_after = speed_of(z), speed_of(middle), speed_of(after)
    whole = 2.0 * h / (v + v_after)
    halves = h / (v + v_middle) + h / (v_middle + v_after) if middle > 0.0 else whole
    return (4.0 * halves - whole) / 3.0 if v + v_after > 0.0 else np.inf


@njit(cache=True, error_model="numpy")
def advance(
    z: float, effort: float, drag0: FloatArray, drag1: float, drag2: float, step: float
) -> tuple[float, float]:
    """``z`` at the end of a cell and the time spent in it [s]; infinite if the train stops."""
    h, drag, time = step / SUBSTEPS, (drag1, drag2), 0.0
    for j in range(SUBSTEPS):
        first, last = effort - drag0[j], effort - drag0[j + 1]
        after = _after(z, first, last, *drag, h)
        time += _seconds(z, after, first, last, drag, h)
        z = after
        if time == np.inf:
            break
    return z, time


@njit(cache=True, error_model="numpy")
def cell_of(motion: Motion, k: int) -> Cell:
    """A cell as all trains meet it, each value beside that of the next train."""
    return motion.drag0[:, k].T.copy(), motion.drag1, motion.drag2[:, k].copy(), motion.step[k]


@njit(cache=True, error_model="numpy")
def advance_all(
    z: FloatArray, effort: FloatArray, cell: Cell, end: FloatArray, time: FloatArray
) -> None:
    """`advance` of all trains, side by side: the processor takes several at once.

    Parameters
    ----------
    z, effort : (q,) array
    cell : Cell
    end, time : (q,) array
        For the result.
    """
    drag0, drag1, drag2, step = cell
    h = step / SUBSTEPS
    end[:], time[:] = z, 0.0
    for j in range(SUBSTEPS):
        begun, ended = drag0[j], drag0[j + 1]
        for a in range(end.size):
            first, last, drag = effort[a] - begun[a], effort[a] - ended[a], (drag1[a], drag2[a])
            after, so_far = _after(end[a], first, last, *drag, h), time[a]
            time[a] = so_far + _seconds(end[a], after, first, last, drag, h)
            end[a] = after if so_far < np.inf else end[a]


@njit(cache=True, error_model="numpy")
def _about(z: float, target: float, both: float, drag1: float, drag2: float, step: float) -> float:
    """The effort that leads from one ``z`` to the other, by the means of a cell."""
    mean = 0.5 * (speed_of(z) + speed_of(target))
    return (target - z) / step + 0.5 * both + drag1 * mean + drag2 * (z + target)


@njit(cache=True, error_model="numpy")
def landing(
    z: float, target: float, drag0: FloatArray, drag1: float, drag2: float, step: float
) -> float:
    """The effort that brings the train from ``z`` to ``target`` over a cell."""
    effort = _about(z, target, drag0[0] + drag0[-1], drag1, drag2, step)
    for _ in range(4):
        reached, _ = advance(z, effort, drag0, drag1, drag2, step)
        effort += (target - reached) / step
    return float(effort)


@njit(cache=True, error_model="numpy")
def landing_all(
    z: FloatArray, target: FloatArray, cell: Cell, rows: IntArray, effort: FloatArray
) -> None:
    """`landing` of the trains of some rows, side by side, into `effort`."""
    drag0, drag1, drag2, step = cell
    some = drag0[:, rows], drag1[rows], drag2[rows], step
    begin, ends = z[rows], target[rows]
    found, reached, time = np.empty(rows.size), np.empty(rows.size), np.empty(rows.size)
    for a in range(rows.size):
        both = some[0][0, a] + some[0][-1, a]
        found[a] = _about(begin[a], ends[a], both, some[1][a], some[2][a], step)
    for _ in range(4):
        advance_all(begin, found, some, reached, time)
        for a in range(rows.size):
            found[a] += (ends[a] - reached[a]) / step
    effort[rows] = found


@njit(cache=True, error_model="numpy")
def traverse(z: FloatArray, effort: FloatArray, motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Each cell on its own, from its first node: where it ends and how long it takes.

    Parameters
    ----------
    z : (q, n + 1) array
    effort : (q, n) array
        Times the gain.
    motion : Motion

    Returns
    -------
    end, time : (q, n) array
    """
    q, n = effort.shape
    end, time, reached, seconds = np.empty((q, n)), np.empty((q, n)), np.empty(q), np.empty(q)
    for k in range(n):
        advance_all(z[:, k], effort[:, k].copy(), cell_of(motion, k), reached, seconds)
        end[:, k], time[:, k] = reached, seconds
    return end, time


@njit(cache=True, error_model="numpy")
def brake_backwards(
    ceiling: FloatArray, final: float, traction: FloatArray, brakes: Brakes, motion: Motion
) -> FloatArray:
    """Full braking backwards from the end, below every ceiling: the highest ``z`` at each node.

    The brake's power counts at the higher speed, that of the cell's first node.

    Parameters
    ----------
    ceiling : (q, n + 1) array [m²/s²]
    final : float [m²/s²]
        ``z`` at the end.
    traction : (n,) array [m/s²]
        Common traction that is braked against.
    brakes : Brakes
    motion : Motion

    Returns
    -------
    (q, n + 1) array [m²/s²]
    """
    gain, drag1 = motion.gain, motion.drag1
    q, n = motion.drag2.shape
    curve, z, effort = np.empty((q, n + 1)), np.empty(q), np.empty(q)
    curve[:, n] = y = np.minimum(final, ceiling[:, n])
    for k in range(n - 1, -1, -1):
        resists, _, square, length = cell_of(motion, k)
        h = length / SUBSTEPS
        z[:], effort[:] = y, -1.0
        for _ in range(6):
            same = True
            for a in range(q):
                by_power = brakes.dynamic_power / max(speed_of(z[a]), 1e-6)
                if brakes.speeds.size > 1:
                    for each in (z[a], y[a]):
                        by_power = min(
                            by_power, effort_at(speed_of(each), brakes.speeds, brakes.efforts)
                        )
                dynamic = min(brakes.dynamic[a, k], by_power)
                limit = min(brakes.limit[a, k], brakes.friction[a, k] + dynamic)
                same &= limit == effort[a]
                effort[a] = limit
            if same:
                break
            z[:] = y
            # Motion backwards along the line: the same equation with the sign of ds turned.
            for j in range(SUBSTEPS, 0, -1):
                near, far = resists[j], resists[j - 1]
                for a in range(q):
                    net = gain[a] * (effort[a] - traction[k])
                    first, last = net + near[a], net + far[a]
                    z[a] = _after(z[a], first, last, -drag1[a], -square[a], h)
        for a in range(q):
            curve[a, k] = y[a] = max(min(z[a], ceiling[a, k]), 0.0)
    return curve


@njit(cache=True, error_model="numpy")
def pull_forwards(
    ceiling: FloatArray, traction: Traction, drag0: FloatArray, drag1: float, drag2: FloatArray,
    step: FloatArray, least: float,
) -> FloatArray:  # fmt: skip
    """Full traction of one train from standstill, below a ceiling: ``z`` at each node.

    Each cell takes the acceleration of its beginning.

    Parameters
    ----------
    ceiling : (n + 1,) array [m²/s²]
    traction : Traction
    drag0, drag2, step : (n,) array [m/s²], [1/m], [m]
    drag1 : float [1/s]
    least : float [m²/s²]
        ``z`` that is kept where traction does not overcome the line.
    """
    z = np.zeros(ceiling.size)
    for k in range(step.size):
        v = speed_of(z[k])
        effort = min(traction.limit[k], traction.power[0] / v) if v > 0.0 else traction.limit[k]
        effort = min(effort, effort_at(v, traction.speeds[0], traction.efforts))
        reached = z[k] + step[k] * (effort - drag0[k] - drag1 * v - 2.0 * drag2[k] * z[k])
        z[k + 1] = max(min(max(reached, least), ceiling[k + 1]), 0.0)
    return z


def braking_curve(positions: FloatArray, limits: FloatArray, deceleration: float) -> FloatArray:
    """Highest speed at each position from which every limit ahead is kept at one deceleration.

    Parameters
    ----------
    positions : (n,) array [m]
    limits : (n,) array [m/s]
    deceleration : float [m/s²]

    Returns
    -------
    (n,) array [m/s]

    Examples
    --------
    >>> braking_curve(np.array([0.0, 100.0, 200.0]), np.array([30.0, 30.0, 0.0]), 0.5).round(3)
    array([14.142, 10.   ,  0.   ])
    """
    energy = limits**2 + 2.0 * deceleration * positions
    reachable = np.minimum.accumulate(energy[::-1])[::-1] - 2.0 * deceleration * positions
    return np.asarray(np.sqrt(np.maximum(reachable, 0.0)))


@dataclass(frozen=True, eq=False)
class FastestRun:
    """A run as fast as traction, limits and brakes allow; (n,) arrays.

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


def timetable_run(
    line: Line,
    train: Train,
    start: float,
    end: float,
    *,
    deceleration: float = 0.6,
    lever: float = 0.8,
    load: float = 0.0,
    step: float = TIMETABLE_STEP,
) -> FastestRun:
    """The run of the shortest time from standing at `start` to standing at `end` [m].

    Permitted speeds are kept with the whole length of the train, braking has a constant
    deceleration. Each step takes the acceleration of its beginning, as in TrainRuns.jl, whose own
    step is 20 m; the result converges with the step.

    Parameters
    ----------
    line : Line
        As travelled.
    train : Train
    start, end : float [m]
    deceleration : float [m/s²]
        Of service braking.
    lever : float
        Share of the tractive effort used.
    load : float [kg]
    step : float [m]
        About.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.formats.railway import read_train
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> round(timetable_run(line, train, 0.0, line.length).running_time)
    1009
    """
    positions = np.linspace(start, end, max(int((end - start) / step), 2) + 1)
    limits = np.minimum(line.limits_over(train.length)(positions), train.max_speed)
    limits[-1] = 0.0
    mass = train.mass + load
    inertia = mass + train.rotating_mass
    curve, resistance = train.traction_curve, train.resistance
    traction = Traction.of(
        np.full(positions.size - 1, lever * train.max_tractive_effort / inertia),
        np.array([lever * train.max_traction_power / inertia]),
        None if curve is None else curve.over(inertia / lever),
    )
    track = line.track_acceleration(positions[:-1], train.strip_length)
    constant, linear, quadratic = resistance.parabola
    drag0 = (constant + mass * track) / inertia
    ceiling = 0.5 * braking_curve(positions, limits, deceleration) ** 2
    resisting = (drag0, linear / inertia, np.full(drag0.size, quadratic / inertia))
    z = pull_forwards(ceiling, traction, *resisting, np.diff(positions), 0.5 * SLOWEST**2)
    speeds = np.sqrt(2.0 * z)
    spent = np.cumsum(2.0 * np.diff(positions) / (speeds[1:] + speeds[:-1]))
    return FastestRun(positions, speeds, np.concatenate(([0.0], spent)))
