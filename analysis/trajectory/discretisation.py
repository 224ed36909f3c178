"""A run cut into cells: the grid, and the arrays of the trajectory problem.

The grid is fine where the speed changes and goes through every breakpoint of the line. Space is
the independent variable. Every configuration has its own ``z = v²/2`` at the nodes
between the cells; the controls are constant in a cell, but for traction where it follows the power
as the speed changes: there it is linear. All forces are divided by one reference
inertia, so that efforts are accelerations and energies are in J/kg of that inertia::

    dz/ds = gain (u_f - u_b) - drag0 - drag1 v - drag2 v²,    Cunillera et al. (2022), eq. (2)

with ``gain`` the reference inertia over the configuration's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from analysis.trajectory.problem import TrajectoryProblem
from trainlog.arrays import FloatArray, IntArray
from trainlog.railway import EffortCurve
from trainlog.railway.motion import SUBSTEPS
from trainlog.units import GRAVITY

_SPEED_SHARE = 0.65
"""Share of the cells that goes where the speed changes."""

BRAKING_WEIGHT, REGAINING_WEIGHT = 0.25, 1.3
"""Cells for a loss of speed over those for a gain: constant braking effort is exact in any cell,
but wastes power of a dynamic brake that feeds back. Chosen with `_SPEED_SHARE` for the least gap on
five lines."""

_EXCESS_SHARE = 0.5
"""Share of the cells of a refined mesh that goes where a plan may be improved."""


def graded_mesh(
    breakpoints: FloatArray,
    positions: FloatArray,
    speeds: FloatArray,
    cells: int,
    braking_weight: float = BRAKING_WEIGHT,
) -> FloatArray:
    """Positions of the nodes: some cells even in position, more even in the change of speed.

    Near a standstill cells of equal speed change are short (below 1 m at the start): without them
    the time of the first metres is wrong.

    Parameters
    ----------
    breakpoints : (m,) array [m]
        Nodes that there must be, from the start to the end.
    positions, speeds : (k,) array [m], [m/s]
        The speed envelope.
    cells : int
        How many cells there should be; if the breakpoints alone make nearly as many, a quarter
        of it on top of theirs.
    braking_weight : float
        Cells for a loss of speed over those for a gain.

    Returns
    -------
    (n + 1,) array [m]
    """
    change = np.diff(speeds)
    change = np.where(change > 0.0, change, -braking_weight * change)
    even = np.diff(positions) / (positions[-1] - positions[0])
    share = even
    if change.sum() > 0.0:
        share = (1.0 - _SPEED_SHARE) * even + _SPEED_SHARE * change / change.sum()
    return _even_in(breakpoints, positions, share, cells)


def refined_mesh(
    breakpoints: FloatArray, positions: FloatArray, excess: FloatArray, cells: int
) -> FloatArray:
    """Positions of the nodes: half of the cells as they were, half where a plan may be improved.

    What a plan loses in a cell goes with the cube of its length where controls change steadily;
    so the cube root of it is what cells share evenly.

    Parameters
    ----------
    breakpoints : (m,) array [m]
        As for `graded_mesh`, as `cells`.
    positions : (n + 1,) array [m]
        The mesh of the plan.
    excess : (n,) array
        What the plan loses in each of its cells, in any unit.
    cells : int
    """
    # Where a control changes, and with it the loss, moves to a neighbouring cell.
    around = np.convolve(excess, (0.25, 0.5, 0.25), mode="same")
    root = np.cbrt(around)
    share = np.full(excess.size, 1.0 / excess.size)
    if root.sum() > 0.0:
        share = (1.0 - _EXCESS_SHARE) * share + _EXCESS_SHARE * root / root.sum()
    return _even_in(breakpoints, positions, share, cells)


def _even_in(
    breakpoints: FloatArray, positions: FloatArray, share: FloatArray, cells: int
) -> FloatArray:
    """Nodes through all breakpoints, between which the cells share evenly what `share` is."""
    mass = np.concatenate(([0.0], np.cumsum(share)))
    at = np.interp(breakpoints, positions, mass)
    counts = _allot(np.diff(at), max(cells, breakpoints.size - 1 + cells // 4))
    # Inside an interval the nodes are even in the mass, so the cells grow with the speed.
    inner = [
        np.interp(np.linspace(low, high, count + 1)[1:-1], mass, positions)
        for low, high, count in zip(at[:-1], at[1:], counts, strict=True)
        if count > 1
    ]
    return np.unique(np.concatenate((breakpoints, *inner)))


def _allot(mass: FloatArray, cells: int) -> IntArray:
    """Cells for each interval: proportional to its mass, at least one, `cells` in all."""
    low, high = 0.0, 4.0 * cells / max(float(mass.sum()), 1e-12)
    for _ in range(60):
        middle = 0.5 * (low + high)
        if np.maximum(np.ceil(middle * mass), 1.0).sum() > cells:
            high = middle
        else:
            low = middle
    return np.maximum(np.ceil(low * mass), 1.0).astype(np.int64)


_BULGE_PARTS = 16

_ROUNDED = 1e-12
"""Track acceleration that rounding makes [m/s²]."""

_STANDING = 1e-8
"""``z`` below which a train stands [m²/s²]."""

_HALF_FULL, _NEARLY_FULL = 0.5, 0.95
"""Parts of the power from which traction begins to follow it, and follows it all the way."""

_CREST_SPARE, _ROUNDING = 1.1, 1e-7
"""What is left below the power in a tapered cell, over what its own curve asks for."""


_CURVE_PARTS, _SHORTEST = 32, 1.02
"""Parts of a cell in which a curve of effort is looked at, and times the least of it, that counts
as short, too."""

_LEVEL = 1e-8
"""By which programs leave an effort above a curve's level part, relative."""

_BESIDE = 0.05
"""Part of the speed within which a knot of a curve is next to it."""


@dataclass(frozen=True, eq=False)
class Taper:
    """Traction that is linear in a cell, where it follows the power as the speed changes.

    Attributes
    ----------
    fall : (n,) array [m/s²]
        By how much it is above its mean where the cell begins, and below where it ends.
    crest : (n,) array
        By what part it has to stay below the power at both ends, since that is curved between.
    """

    fall: FloatArray
    crest: FloatArray


@dataclass(frozen=True, eq=False)
class DiscreteProblem:
    """The arrays of a run, cut into n cells, for q configurations; per unit reference inertia.

    Attributes
    ----------
    positions : (n + 1,) array [m]
    step : (n,) array [m]
    reference : float [kg]
        The reference inertia.
    gain : (q,) array
        Reference inertia over the configuration's.
    drag0 : (q, n, SUBSTEPS + 1) array [m/s²]
        Gradient, curves and constant running resistance at the ends of equal parts of each cell.
    drag1 : (q,) array [1/s]
    drag2 : (q, n) array [1/m]
        With the tunnel's share.
    ceiling : (n + 1,) array [m²/s²]
        Largest permitted ``z`` at the nodes, so that the limit holds between them too.
    bulge : (n,) array [m²/s²]
        By how much ``z`` can rise above both ends of a cell inside it.
    traction : (n,) array [m/s²]
        Largest common tractive effort; eq. (6) with comfort and adhesion.
    power : (q,) array [W/kg]
        Largest tractive effort times speed; eq. (5).
    curves, dynamic_curves : Curves or None
        Of traction and of the dynamic brake over speed, where the train has them.
    taper : Taper
        Of the common traction; `drag0` holds it, so that the motion is that of the cells' means.
    braking : (q, n) array [m/s²]
        Largest braking effort, all brakes together; eq. (7) with comfort and adhesion.
    friction, dynamic : (q, n) array [m/s²]
        What each kind of brake can do.
    dynamic_power : float [W/kg]
    weights : (q,) array
        Of the configurations in the expected energy; they add up to 1.
    initial, final : float [m²/s²]
        ``z`` at the start, and the most it may be at the end; eq. (8).
    floor : (n + 1,) array [m²/s²]
        Least ``z`` at the nodes; above 0 only where the train must pass fast enough.
    passed : (p,) array of int
        Nodes of the passing points.
    earliest, latest : (p,) array [s]
        When they may be passed; infinite where there is no bound.
    """

    run: TrajectoryProblem
    positions: FloatArray
    step: FloatArray
    reference: float
    gain: FloatArray
    drag0: FloatArray
    drag1: FloatArray
    drag2: FloatArray
    ceiling: FloatArray
    bulge: FloatArray
    traction: FloatArray
    power: FloatArray
    taper: Taper
    braking: FloatArray
    friction: FloatArray
    dynamic: FloatArray
    dynamic_power: float
    initial: float
    final: float
    floor: FloatArray
    passed: IntArray
    earliest: FloatArray
    latest: FloatArray
    weights: FloatArray
    curves: Curves | None = None
    dynamic_curves: Curves | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Number of configurations and of cells."""
        return self.drag2.shape[0], self.drag2.shape[1]

    @property
    def mean_drag0(self) -> FloatArray:
        """Mean of `drag0` over each cell, (q, n) [m/s²]."""
        ends = 0.5 * (self.drag0[:, :, 0] + self.drag0[:, :, -1])
        return np.asarray((self.drag0[:, :, 1:-1].sum(axis=2) + ends) / SUBSTEPS)

    @property
    def common(self) -> bool:
        """Whether all configurations share one braking effort."""
        return self.run.braking == "common"

    @property
    def final_ceiling(self) -> float:
        """Largest permitted ``z`` at the end [m²/s²]: the asked speed or the limit there."""
        return min(self.final, float(self.ceiling[-1]))

    def traction_by_power(self, z: FloatArray) -> FloatArray:
        """Largest mean traction that each configuration's power allows, (q, n) [m/s²].

        Parameters
        ----------
        z : (q, n + 1) array [m²/s²]
        """
        speed = np.sqrt(2.0 * (z[:, :-1] + self.bulge)), np.sqrt(2.0 * (z[:, 1:] + self.bulge))
        begin, end = (self.traction_at(v, 1.0 - self.taper.crest) for v in speed)
        return np.asarray(np.minimum(begin - self.taper.fall, end + self.taper.fall))

    def traction_at(self, speed: FloatArray, part: FloatArray | float = 1.0) -> FloatArray:
        """A part of the traction that power and curve allow at speeds, (..., q, n) [m/s²]."""
        found = self.power[:, None] * part / np.maximum(speed, 1e-6)
        if self.curves is not None:
            found = np.minimum(found, part * self.curves.at(speed))
        return np.asarray(found)

    def dynamic_by_speed(self, z: FloatArray, spare: float = 0.0) -> FloatArray:
        """What power and curve leave of the dynamic brake all through each cell, (q, n) [m/s²].

        Parameters
        ----------
        z : (q, n + 1) array [m²/s²]
        spare : float [m²/s²]
            Added to the higher end's.
        """
        begin, end = z[:, :-1], z[:, 1:]
        fastest = np.sqrt(2.0 * (np.maximum(begin, end) + self.bulge + spare))
        found = self.dynamic_power / np.maximum(fastest, 1e-6)
        if self.dynamic_curves is not None:
            slowest = np.sqrt(2.0 * np.maximum(np.minimum(begin, end), 0.0))
            for speed in (fastest, slowest):
                found = np.minimum(found, self.dynamic_curves.at(speed))
        return np.asarray(found)

    @property
    def usable_braking(self) -> FloatArray:
        """What each brake may do at most: a common one what the weakest of all can, (q, n)."""
        if not self.common:
            return self.braking
        return np.broadcast_to(self.braking.min(axis=0), self.braking.shape)

    def most_braking(self, z: FloatArray, spare: float = 0.0) -> FloatArray:
        """The most that all brakes together can do all through each cell, (q, n) [m/s²].

        Parameters as for `dynamic_by_speed`.
        """
        dynamic = np.minimum(self.dynamic, self.dynamic_by_speed(z, spare))
        return np.asarray(np.minimum(self.braking, self.friction + dynamic))

    def tapered(self, taper: Taper) -> DiscreteProblem:
        """The same problem with the common traction tapered so; this one must not be."""
        profile = 1.0 - 2.0 * np.linspace(0.0, 1.0, SUBSTEPS + 1)
        drag0 = np.multiply.outer(-self.gain, taper.fall[:, None] * profile)
        drag0 += self.drag0
        # A configuration that gains speed and loses it in such a cell is fastest inside.
        rise = 0.25 * self.gain.max() * np.maximum(taper.fall, 0.0) * self.step
        ceiling = self.ceiling - largest_beside(rise)
        ceiling = np.maximum(ceiling, np.minimum(self.floor, self.ceiling))
        ceiling[0] = max(ceiling[0], self.initial)
        return replace(self, drag0=drag0, taper=taper, ceiling=ceiling)

    def select(self, rows: Sequence[int]) -> DiscreteProblem:
        """The same problem for some of the configurations; common limits stay those of all.

        In an expected energy each stands for those that are left out and nearest to it.
        """
        chosen = list(rows)
        arrays: dict[str, Any] = {
            name: getattr(self, name)[chosen]
            for name in (
                "gain", "drag0", "drag1", "drag2", "power", "braking", "friction", "dynamic",
                "weights"
            )
        }  # fmt: skip
        if self.run.objective == "expected":
            arrays["weights"] = np.bincount(self.nearest(chosen), self.weights, len(chosen))
        configurations = tuple(self.run.configurations[row] for row in chosen)
        run = replace(self.run, configurations=configurations, weights=())
        if self.curves is not None:
            arrays["curves"] = self.curves.select(chosen)
        if self.dynamic_curves is not None:
            arrays["dynamic_curves"] = self.dynamic_curves.select(chosen)
        return replace(self, run=run, **arrays)

    def nearest(self, rows: Sequence[int]) -> IntArray:
        """For each configuration, the number among `rows` of the one most like it, (q,)."""
        own = self.alike
        return np.asarray(np.argmin(((own[:, None] - own[list(rows)]) ** 2).sum(axis=2), axis=1))

    @property
    def alike(self) -> FloatArray:
        """Inertia and resistance of each configuration, over the mean of both, (q, 2)."""
        speed = np.sqrt(2.0 * max(float(self.ceiling.max()), 1.0)) / 2.0
        drag = self.drag0[:, :, 0].mean(axis=1) - (self.drag0[:, :, 0].mean(axis=1)).min()
        drag = drag + self.drag1 * speed + self.drag2.mean(axis=1) * speed**2
        found = np.column_stack((1.0 / self.gain, drag / self.gain))
        return np.asarray(found / found.mean(axis=0))


@dataclass(frozen=True, eq=False)
class Plan:
    """A trajectory in the making: all controls and where they lead.

    Attributes
    ----------
    z : (q, n + 1) array [m²/s²]
    traction : (n,) array [m/s²]
        Per unit reference inertia, as the efforts below.
    braking, dynamic : (q, n) array [m/s²]
        All brakes together, and the dynamic brake's part in it.
    """

    z: FloatArray
    traction: FloatArray
    braking: FloatArray
    dynamic: FloatArray

    def select(self, rows: Sequence[int]) -> Plan:
        """The same plan for some of the configurations."""
        chosen = list(rows)
        return Plan(self.z[chosen], self.traction, self.braking[chosen], self.dynamic[chosen])

    def put(self, rows: Any, other: Plan, others: Any = slice(None)) -> None:
        """Have `rows` drive as the rows `others` of another plan of the same traction, in place."""
        self.z[rows], self.braking[rows] = other.z[others], other.braking[others]
        self.dynamic[rows] = other.dynamic[others]

    def joined(self, other: Plan) -> Plan:
        """With the configurations of another plan of the same traction behind its own."""
        return Plan(
            np.concatenate((self.z, other.z)),
            self.traction,
            np.concatenate((self.braking, other.braking)),
            np.concatenate((self.dynamic, other.dynamic)),
        )


def most_efforts(problem: DiscreteProblem, plan: Plan) -> tuple[FloatArray, FloatArray]:
    """The most that common traction, (n,), and each brake, (q, n), can do in cells [m/s²]."""
    by_effort = problem.traction - np.abs(problem.taper.fall)
    pull = np.minimum(by_effort, problem.traction_by_power(plan.z + 1e-9).min(axis=0))
    brake = problem.most_braking(plan.z, 1e-9)
    if problem.common:
        brake = np.broadcast_to(brake.min(axis=0), brake.shape)
    return np.asarray(pull), np.asarray(brake)


def taper_along(problem: DiscreteProblem, plan: Plan) -> Taper:
    """Traction tapered where a plan pulls with all the power of a configuration.

    Traction that is constant in a cell wastes the power of its slower part; what is lost is
    proportional to the length of the cells. On the chord of ``power / v`` it goes with the square.
    """
    speed = np.sqrt(2.0 * np.maximum(plan.z, _STANDING))
    ends = plan.z[:, :-1] + problem.bulge, plan.z[:, 1:] + problem.bulge
    each = [problem.traction_at(np.sqrt(2.0 * np.maximum(z, _STANDING))) for z in ends]
    begin, end = (np.minimum(efforts.min(axis=0), problem.traction) for efforts in each)
    mean = 0.5 * (begin + end)
    # Between half and nearly all of it by degrees: else a cell in which traction ends would be
    # tapered in every other iteration.
    share = (plan.traction / mean - _HALF_FULL) / (_NEARLY_FULL - _HALF_FULL)
    fall = 0.5 * (begin - end) * np.clip(share, 0.0, 1.0)
    # How far the chord rises above the curve inside the cells, for whoever has just the power for
    # both ends. The speed is higher there than between the ends as the net effort falls with it.
    shares = np.linspace(0.0, 1.0, 2 * SUBSTEPS + 1)[1:-1, None]
    drag = 0.5 * problem.drag1[:, None] / np.maximum(speed[:, :-1], 1e-3) + problem.drag2
    lift = problem.gain[:, None] * fall + drag * np.diff(plan.z, axis=1)
    lift = np.max(np.maximum(lift, 0.0) / np.maximum(plan.z[:, :-1], _STANDING), axis=0)
    lift = lift * problem.step * shares * (1.0 - shares)
    left = (mean - fall) / (mean + fall)
    used = (1.0 - shares * (1.0 - left)) * np.sqrt(1.0 - shares + shares / left**2 + lift)
    if problem.curves is not None:
        used = np.maximum(1.0, _used_inside(problem, plan, each, fall))
    crest = _CREST_SPARE * (used.max(axis=0) - 1.0) + _ROUNDING
    crest = np.where(fall != 0.0, np.minimum(crest, 0.5), 0.0)
    return Taper(fall * (1.0 - crest), crest)


def _used_inside(
    problem: DiscreteProblem, plan: Plan, ends: Sequence[FloatArray], fall: FloatArray
) -> FloatArray:
    """Traction on the chord between its limits at the ends of a cell, over the limit inside.

    Of the configurations that are nearly the shortest of it; (parts, n).
    """
    shares = np.linspace(0.0, 1.0, _CURVE_PARTS + 1)[1:-1, None, None]
    begin, end = plan.z[:, :-1], plan.z[:, 1:]
    mean = 0.5 * (np.sqrt(2.0 * begin) + np.sqrt(2.0 * end))
    drag = problem.drag1[:, None] / np.maximum(mean, 1e-3) + 2.0 * problem.drag2
    bend = np.maximum(problem.gain[:, None] * fall + 0.5 * drag * (end - begin), 0.0)
    z = begin + shares * (end - begin) + shares * (1.0 - shares) * bend * problem.step
    limit = problem.traction_at(np.sqrt(2.0 * np.maximum(z + problem.bulge, _STANDING)))
    chord = np.minimum(ends[0] + shares * (ends[1] - ends[0]), problem.traction)
    near = (ends[0] < _SHORTEST * ends[0].min(axis=0)) | (ends[1] < _SHORTEST * ends[1].min(axis=0))
    return np.asarray(np.where(near, chord / limit, 0.0).max(axis=1))


def largest_beside(cells: FloatArray) -> FloatArray:
    """The larger value of the two cells beside each node, (n + 1,); at least 0 at both ends."""
    return np.asarray(np.maximum(np.append(cells, 0.0), np.insert(cells, 0, 0.0)))


def inside(positions: FloatArray, parts: int) -> FloatArray:
    """Positions [m] of the ends of equal parts of each cell, (n, parts + 1).

    The outermost lie slightly inside the cell, on its own side of whatever changes at a node.
    """
    step, shares = np.diff(positions)[:, None], np.linspace(0.0, 1.0, parts + 1)
    # In a cell of millimetres a part of its length is less than the rounding of a position.
    edge = np.minimum(np.maximum(1e-9, 4.0 * np.spacing(positions[1:, None]) / step), 0.5)
    return np.asarray(positions[:-1, None] + step * np.clip(shares, edge, 1.0 - edge))


def discretise(run: TrajectoryProblem, positions: FloatArray) -> DiscreteProblem:
    """Cut `run` into cells between `positions`.

    Parameters
    ----------
    positions : (n + 1,) array [m]
        From the run's start to its end, through all of its breakpoints; a coarse grid may leave out
        those of the line, and has the mean of what they separate.
    """
    train, step = run.train, np.diff(positions)
    middle = positions[:-1] + 0.5 * step
    masses = np.array([c.mass for c in run.configurations])[:, None]
    inertia = np.array([c.inertia for c in run.configurations])
    reference = float(inertia.max())
    gain = reference / inertia
    weights = np.array(run.weights or np.ones(len(run.configurations)))

    track, bulge = _track(run, positions)
    coefficients = np.array([each.resistance.parabola for each in run.configurations])
    tunnel = train.tunnel_coefficient(run.line.tunnel_cross_section(middle))
    limit = run.permitted_speed(middle)
    lowest = np.minimum(np.append(limit, np.inf), np.insert(limit, 0, np.inf))
    # Between its ends a cell's speed rises above them where the track's force changes in the cell.
    ceiling = 0.5 * lowest**2 - largest_beside(bulge)
    ceiling[0] = max(ceiling[0], 0.5 * run.initial_speed**2)
    passed = np.searchsorted(positions, [point.position for point in run.windows])
    floor = np.zeros(positions.size)
    for node, point in zip(passed.tolist(), run.windows, strict=True):
        if point.highest_speed is not None:
            ceiling[node] = min(ceiling[node], 0.5 * point.highest_speed**2)
        floor[node] = 0.5 * (point.lowest_speed or 0.0) ** 2
    drag0 = np.multiply.outer(masses[:, 0] / inertia, track)
    drag0 += (coefficients[:, 0] / inertia)[:, None, None]
    efforts = effort_limits(run, inside(positions, SUBSTEPS), run.adhesion(positions))
    power, fastest = np.array([c.max_power for c in run.configurations]), run.train.max_speed
    own, braking = train.traction_curve, train.dynamic_braking_curve
    return DiscreteProblem(
        run=run,
        positions=positions,
        step=step,
        reference=reference,
        gain=gain,
        drag0=drag0,
        drag1=coefficients[:, 1] / inertia,
        drag2=(coefficients[:, 2:] + tunnel) / inertia[:, None],
        ceiling=ceiling,
        bulge=bulge,
        traction=efforts.traction.min(axis=0) / reference,
        power=power / reference,
        taper=Taper(np.zeros(step.size), np.zeros(step.size)),
        braking=efforts.braking / reference,
        friction=efforts.friction / reference,
        dynamic=efforts.dynamic / reference,
        dynamic_power=train.max_dynamic_braking_power / reference,
        initial=0.5 * run.initial_speed**2,
        final=0.5 * run.final_speed**2,
        floor=floor,
        passed=passed.astype(np.int64),
        earliest=_bounds([point.earliest for point in run.windows], -np.inf),
        latest=_bounds([point.latest for point in run.windows], np.inf),
        weights=weights / weights.sum(),
        curves=Curves.of(
            None if own is None else own.over(reference), power / train.max_traction_power, fastest
        ),
        dynamic_curves=Curves.of(
            None if braking is None else braking.over(reference),
            np.ones(power.size),
            fastest,
            brake=True,
        ),
    )


def _bounds(values: Sequence[float | None], without: float) -> FloatArray:
    return np.array([without if value is None else value for value in values], dtype=np.float64)


def _track(run: TrajectoryProblem, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Track acceleration at the ends of equal parts of each cell, and the bulge that it makes."""
    if np.isin(run.breakpoints, positions).all():
        values = _track_inside(run, positions)
        linear = _linear_in_parts(values[:, :: _BULGE_PARTS // (2 * SUBSTEPS)])
        return linear, _bulge(values, np.diff(positions))
    step = np.diff(positions)
    middles = positions[:-1, None] + step[:, None] * (np.arange(_BULGE_PARTS) + 0.5) / _BULGE_PARTS
    mean = run.track_acceleration(middles).mean(axis=1, keepdims=True)
    return np.repeat(mean, SUBSTEPS + 1, axis=1), np.zeros(step.size)


def _track_inside(run: TrajectoryProblem, positions: FloatArray) -> FloatArray:
    """Track acceleration at the ends of equal parts of each cell; in most it does not change."""
    points = inside(positions, _BULGE_PARTS)
    few = run.track_acceleration(points[:, :: _BULGE_PARTS // 2])
    values, changes = np.repeat(few[:, :1], points.shape[1], axis=1), np.ptp(few, axis=1) > 0.0
    values[changes] = run.track_acceleration(points[changes])
    return values


def _linear_in_parts(values: FloatArray) -> FloatArray:
    """Track acceleration at the ends of equal parts of each cell, its mean over the cell exact.

    In a transition curve the resistance is linear for one formula only.
    """
    ends, middles = values[:, ::2], values[:, 1::2]
    # Simpson's rule over the parts less the trapezoids.
    missing = 2.0 / 3.0 * (middles - 0.5 * (ends[:, :-1] + ends[:, 1:])).mean(axis=1)
    return np.asarray(ends + np.where(np.abs(missing) > _ROUNDED, missing, 0.0)[:, None])


def _bulge(track: FloatArray, step: FloatArray) -> FloatArray:
    """By how much ``z`` can rise above both ends inside a cell of changing curvature, (n,)."""
    bulge, some = np.zeros(step.size), np.ptp(track, axis=1) > 1e-9
    parts = 0.5 * (track[some, :-1] + track[some, 1:])
    spared = np.cumsum(parts.mean(axis=1, keepdims=True) - parts, axis=1).max(axis=1)
    bulge[some] = np.maximum(spared, 0.0) * step[some] / _BULGE_PARTS
    return bulge


@dataclass(frozen=True, eq=False)
class EffortLimits:
    """Largest efforts [N] of each configuration in each cell, power apart; (q, n) arrays."""

    traction: FloatArray
    braking: FloatArray
    friction: FloatArray
    dynamic: FloatArray


def effort_limits(run: TrajectoryProblem, places: FloatArray, adhesion: FloatArray) -> EffortLimits:
    """Efforts that machine, comfort and adhesion allow at all of some places together.

    Parameters
    ----------
    places : (n, m) array [m]
    adhesion : (n,) array

    Notes
    -----
    Traction and the dynamic brake act on the powered axles, all brakes together on every axle. A
    limit of the train's own acceleration is what the effort leaves against gradient, curves and the
    constant part of the resistance; one of its deceleration counts all resistance at the highest
    speed from which it can stop so, so that neither is exceeded at any speed.
    """
    train = run.train
    cells = adhesion.size
    if np.all(adhesion == adhesion[0]):
        adhesion = adhesion[:1]
    mass = np.array([[c.mass] for c in run.configurations])
    inertia = np.array([[c.inertia] for c in run.configurations])
    adhesive = np.array([[train.adhesive_weight(c.mass - train.mass)] for c in run.configurations])
    on_powered, on_all = adhesion * adhesive, adhesion * GRAVITY * mass

    def least(*limits: FloatArray | float) -> FloatArray:
        lowest = np.minimum.reduce(np.broadcast_arrays(*limits))
        return np.ascontiguousarray(np.broadcast_to(lowest, (len(run.configurations), cells)))

    pull, comfort = train.max_acceleration * inertia, train.max_deceleration * inertia
    if train.acceleration_limits == "net":
        track, middle = run.track_acceleration(places), places.mean(axis=1)
        speed = run.highest_speed(places).max(axis=1)
        tunnel = train.tunnel_coefficient(run.line.tunnel_cross_section(middle)) * speed**2
        drag = np.array([c.resistance(speed) + tunnel for c in run.configurations])
        starting = np.array([[float(c.resistance(0.0))] for c in run.configurations])
        pull = np.maximum(pull + starting + mass * track.min(axis=1), 0.0)
        comfort = np.maximum(comfort - drag - mass * track.max(axis=1), 0.0)
    return EffortLimits(
        traction=least(train.max_tractive_effort, pull, on_powered),
        braking=least(train.max_braking_effort, comfort, on_all),
        friction=least(train.max_pneumatic_braking_effort, comfort, on_all),
        dynamic=least(train.max_dynamic_braking_effort, comfort, on_powered),
    )


_STEEPNESS = (0.0, 0.2, 0.34, 0.5, 0.7, 0.85, 1.0, 1.25, 1.6, 2.2, 3.0, 4.0, 6.0, 9.0)
"""Powers of bounds over that of the effort at their speed: the lowest bound there is the best."""

SPARE = 0.1
"""By which a cell's mean speed may exceed the mean of its ends [m/s]."""

_SPAN = 0.25
"""Of speeds, at whose ends a curve and its bounds are compared [m/s]."""


class Bounds(NamedTuple):
    """``effort <= offset + power / v + slope v + square v²/2`` at every speed; arrays of one shape.

    Attributes
    ----------
    offset, power, slope, square : array [m/s²], [W/kg], [1/s], [1/m]
    """

    offset: FloatArray
    power: FloatArray
    slope: FloatArray
    square: FloatArray

    def at(self, speed: FloatArray) -> FloatArray:
        """The bound at speeds [m/s²]."""
        found = self.offset + self.power / speed + self.slope * speed
        return np.asarray(found + 0.5 * self.square * speed**2)

    def raised(self, by: FloatArray) -> Bounds:
        """The bound, so much higher [m/s²]."""
        return self._replace(offset=self.offset + by)


@dataclass(frozen=True, eq=False)
class Curves:
    """One curve of effort for q configurations, per unit reference inertia.

    Attributes
    ----------
    own : EffortCurve
        As published.
    kept : EffortCurve
        The curve below it that plans keep to.
    share : (q,) array
        Of the speeds, by which the curve is that of each configuration.
    offsets, powers, begins : (m,) array [m/s²], [W/kg], [m/s]
        Tangents from above without slope, and the lowest speed of each one's side.
    fastest : float [m/s]
        Up to which the bounds hold.
    """

    own: EffortCurve
    kept: EffortCurve
    share: FloatArray
    offsets: FloatArray
    powers: FloatArray
    begins: FloatArray
    fastest: float

    @staticmethod
    def of(
        curve: EffortCurve | None, share: FloatArray, fastest: float, *, brake: bool = False
    ) -> Curves | None:
        """Of a curve [m/s²] up to the fastest speed [m/s]; None without one."""
        if curve is None:
            return None
        fastest = fastest / float(share.min())
        begins, offsets, powers = curve.tangents(fastest)
        kept = curve.without_dip if brake else curve.without_rise
        return Curves(curve, kept, share, offsets, powers, begins, fastest)

    def select(self, rows: Sequence[int]) -> Curves:
        """Those of some of the configurations."""
        return replace(self, share=self.share[list(rows)])

    def kept_to(self, part: float) -> Curves:
        """With plans that keep to this part of the efforts."""
        return replace(self, kept=EffortCurve(self.kept.speeds, part * self.kept.efforts))

    @property
    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Speeds of each configuration's curve that plans keep to, (q, m), and efforts, (m,)."""
        return self.share[:, None] * self.kept.speeds, self.kept.efforts

    @property
    def own_arrays(self) -> tuple[FloatArray, FloatArray]:
        """The same of the curves as published."""
        return self.share[:, None] * self.own.speeds, self.own.efforts

    def at(self, speed: FloatArray) -> FloatArray:
        """Effort of each configuration at its speeds [m/s], (..., q, n) [m/s²]."""
        return self.kept(speed / self.share[:, None])

    def speed_at(self, effort: FloatArray) -> FloatArray:
        """Highest speed [m/s] at which each configuration has efforts, (q, n).

        Where the curve is level an effort that is above it by rounding is one of the level.
        """
        return self.kept.speed_at(effort * (1.0 - _LEVEL)) * self.share[:, None]

    def lines(self, row: int, speed: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Lines above a configuration's curve near speeds, (n,): effort there, and slope.

        The curve's own piece; and next to a knot where it bends down the piece beyond it, infinite
        elsewhere: a step across the knot would leave the curve.
        """
        share, speeds, efforts = float(self.share[row]), self.kept.speeds, self.kept.efforts
        v = speed / share
        found = [(self.kept(v), self.kept.slope(v) / share)]
        if speeds.size > 2:
            slopes = np.diff(efforts) / np.diff(speeds)
            knot = np.searchsorted(0.5 * (speeds[1:-2] + speeds[2:-1]), v)
            before, after, away = slopes[knot], slopes[knot + 1], v - speeds[knot + 1]
            slope = np.where(away < 0.0, after, before)
            beside = (after < before) & (np.abs(away) < _BESIDE * v)
            value = np.where(beside, efforts[knot + 1] + slope * away, np.inf)
            found.append((value, slope / share))
        return found

    def bounds(
        self,
        row: int,
        speed: FloatArray,
        fastest: FloatArray | float = np.inf,
    ) -> Bounds:
        """Upper bounds of a configuration's effort at speeds up to the fastest, low at given ones.

        Parameters
        ----------
        row : int
        speed : (n,) array [m/s]
            Where each bound is to be low; above 0.
        fastest : (n,) array [m/s]
            Speeds that the configuration cannot exceed.
        """
        share = float(self.share[row])
        v = speed / share
        reach = np.minimum(np.broadcast_to(fastest, v.shape) / share, self.fastest)
        effort, fall = self.kept(v), self.kept.slope(v)
        best = self._tangent(v)
        lowest = best.at(v)
        none = np.zeros(v.size)
        for steepness, alone in product(_STEEPNESS, (False, True)):
            bend = steepness * np.maximum(effort, -fall * v)
            power, slope = bend * v, none if alone else fall + bend / v
            rising = slope > 0.0
            found = Bounds(
                none, power, np.where(rising, 0.0, slope), np.where(rising, slope / v, 0.0)
            )
            found = found.raised(effort - found.at(v))
            # The mean speed of a cell may be above that of its ends.
            found = found.raised(
                self._excess(found, reach) + SPARE * np.where(rising, found.square * v, 0.0)
            )
            value = found.at(v)
            better = value < lowest
            lowest = np.where(better, value, lowest)
            best = Bounds(*(np.where(better, *pair) for pair in zip(found, best, strict=True)))
        return Bounds(best.offset, best.power * share, best.slope / share, best.square / share**2)

    def _excess(self, bound: Bounds, reach: FloatArray) -> FloatArray:
        """By how much the curve is above bounds at most, up to the speeds `reach`, (n,) [m/s²].

        At the ends of short spans, and what it can rise above them in between.
        """
        offset, power, slope, square = (each[:, None] for each in bound)
        knots = self.own.speeds[self.own.speeds < self.fastest]
        v = np.unique(np.concatenate((knots, np.arange(0.0, self.fastest, _SPAN), [self.fastest])))
        low, high = v[1:-1], v[2:]
        f = self.own(v)
        above = f[1:] - offset - power / v[1:] - slope * v[1:] - 0.5 * square * v[1:] ** 2
        bend = 2.0 * power / low**3 + np.maximum(square, 0.0)
        between = np.maximum(above[:, :-1], above[:, 1:]) + 0.125 * bend * (high - low) ** 2
        between = np.where(low < reach[:, None], between, -np.inf)
        first = v[1]
        start = f[:2].max() - offset - power / first
        start = start - np.minimum(slope, 0.0) * first - 0.5 * np.minimum(square, 0.0) * first**2
        return np.asarray(np.maximum(np.maximum(between.max(axis=1), start[:, 0]), 0.0))

    def _tangent(self, v: FloatArray) -> Bounds:
        """The bound by power alone that is lowest at speeds of the curve."""
        at = np.searchsorted(-self.begins, -v)
        at = np.clip(at, 0, self.begins.size - 1)
        none = np.zeros(v.size)
        return Bounds(self.offsets[at], self.powers[at], none, none)
