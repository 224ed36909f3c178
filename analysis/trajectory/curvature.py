"""The continuous bound by a value function of second order, for one configuration.

The bound by the Hamiltonian is that of a value function that is affine in ``z = v²/2``. Where time
is worth next to nothing a train coasts for kilometres, and the linear resistance makes the
Hamiltonian concave in ``z``: its least value is far from the plan. With any curvature
``kappa(s) >= 0`` about the plan's own ``z`` the function::

    V(s, z) = -lambda(s) z - kappa(s) (z - plan(s))² / 2

is as good a sub-solution of the Hamilton-Jacobi-Bellman equation, and the integral over ``s`` of::

    min over z, u of  c u_f - eta u_d + mu / v + dV/ds + dV/dz dz/ds

as much a bound. The curvature that keeps the plan a minimum satisfies a Riccati equation along the
plan (Bryson and Ho 1975, ch. 6), here with secants instead of second derivatives, for the minimum
is to be a global one. It may end at once anywhere, but set in only where the minimum has some to
spare; where a control is partial there must be none. The least value over ``z`` is that at the ends
of short intervals, less what a function of bounded second derivative sags in between.
"""

from __future__ import annotations

import numpy as np

from analysis.trajectory.hamiltonian import Hamiltonian
from trainlog.arrays import BoolArray, FloatArray
from trainlog.spans import runs_of

_STRENGTHS = (1.0, 0.2)
"""Parts of the curvature by secants that are tried in each stretch, next to none."""

_BESIDE, _NEAR = 0.03, 1.0
"""Part of the plan's ``z`` within which no secant is taken, and the least span of one [m²/s²]."""

_SECANTS = np.concatenate((np.geomspace(1e-3, 0.1, 12), np.linspace(0.12, 1.0, 30)))
"""Parts of the highest speed to which they are taken."""

_SLOWEST, _RATIO = 0.02, 1.04
"""Of the intervals of speeds: the end of the first [m/s], and of all others end over beginning."""

_MARGIN = 1e-3
"""Part of the plan's energy by which an attainable speed is that of more."""


def applies(hamiltonian: Hamiltonian) -> bool:
    """Whether there is a bound by curvature: one configuration, its limits by effort and power."""
    problem = hamiltonian.problem
    curved = problem.curves is not None or problem.dynamic_curves is not None
    return problem.shape[0] == 1 and not (curved or problem.common or problem.drag1[0] < 0.0)


def least_by_stretch(
    hamiltonian: Hamiltonian,
    values: tuple[FloatArray, FloatArray, FloatArray],
    partial: BoolArray,
) -> FloatArray:
    """The least Hamiltonian with the curvature that is best in each stretch, (k, p) [J/(kg m)].

    Parameters
    ----------
    hamiltonian : Hamiltonian
        For which `applies`. Speeds that take more energy than the plan are left out: the bound
        holds for what takes less.
    values : (costate, slope, least)
        At the points, (1, k, p) arrays, and the least Hamiltonian without curvature, (k, p).
    partial : (n,) array of bool
        Cells in which a control is partial or a limit is held.
    """
    costate, slope, least = values
    weights, cell = hamiltonian.segments.weights, hamiltonian.segments.cell
    most = np.maximum(attainable(hamiltonian)[cell, None], hamiltonian.speed)
    hamiltonian = hamiltonian.slower(np.minimum(hamiltonian.highest, most))
    secant = secants(hamiltonian, costate, slope)
    stretch = np.concatenate(([0], np.cumsum(np.diff(partial.astype(np.int64)) != 0)))[cell]
    highest = np.bincount(stretch, (least * weights).sum(axis=1))
    for strength in (0.0, *_STRENGTHS):
        curvature = riccati(hamiltonian, strength * secant, partial)
        found = least_curved(hamiltonian, costate, slope, curvature)
        own = np.bincount(stretch, (found * weights).sum(axis=1))
        least = np.where((own > highest)[stretch][:, None], found, least)
        highest = np.maximum(highest, own)
    return least


def secants(hamiltonian: Hamiltonian, costate: FloatArray, slope: FloatArray) -> FloatArray:
    """Twice what the Hamiltonian rises above the plan's at most, over the square of the way there.

    The least over all speeds and all points of each cell, (n,) [1/(m²/s²) per m]: negative where
    another speed has less than the plan's.
    """
    cell, z = hamiltonian.segments.cell, hamiltonian.of_motion[0]

    def value(speed: FloatArray) -> FloatArray:
        a, b, c, constant = hamiltonian.along(costate, speed)
        return np.asarray(a / speed + b * speed + (c - 0.5 * slope) * speed**2 + constant)

    own = value(np.sqrt(2.0 * np.maximum(z, 1e-6)))
    least = np.full(z.shape, np.inf)
    for part in _SECANTS.tolist():
        speed = part * hamiltonian.highest
        away = 0.5 * speed**2 - z
        found = 2.0 * (value(speed) - own) / np.maximum(away**2, _NEAR)
        least = np.where(np.abs(away) > _BESIDE * z, np.minimum(least, found), least)
    found = np.full(hamiltonian.problem.shape[1], np.inf)
    np.minimum.at(found, cell, least[0].min(axis=1))
    return found


def attainable(hamiltonian: Hamiltonian) -> FloatArray:
    """Speeds in each cell above which a run takes more energy than the plan, (n,) [m/s].

    A run has the kinetic energy of one that coasts at most, and all that the plan takes. What is
    lost on the way goes with the speed, which is that of coasting at least.
    """
    problem, plan, prices = hamiltonian.problem, hamiltonian.plan, hamiltonian.prices
    gain, linear, square = problem.gain[0], problem.drag1[0], 2.0 * problem.drag2[0]
    steps, first = problem.step.tolist(), problem.mean_drag0[0].tolist()
    most, least = problem.drag0[0].max(axis=1).tolist(), problem.drag0[0].min(axis=1).tolist()
    found, coasting = np.empty(len(steps)), problem.initial
    for cell, step in enumerate(steps):
        lost = linear * np.sqrt(2.0 * max(coasting, 0.0)) + square[cell] * max(coasting, 0.0)
        low = max(coasting - step * (max(most[cell], 0.0) + lost), 0.0)
        found[cell] = coasting + step * max(-least[cell], 0.0)
        coasting -= step * (first[cell] + linear * np.sqrt(2.0 * low) + square[cell] * low)
    # No more is fed back than what coasting and traction leave for the brake.
    regained = float(prices.regained[0])
    energy = prices.traction * float((plan.traction * problem.step).sum())
    energy -= regained * float((plan.dynamic[0] * problem.step).sum())
    left = prices.traction - regained
    if left <= _MARGIN:
        return np.full(found.shape, np.inf)
    pulled = (gain * energy + regained * coasting) / left
    return np.asarray(np.sqrt(2.0 * np.maximum(found + pulled + _MARGIN * abs(pulled), 0.0)))


def riccati(
    hamiltonian: Hamiltonian, secant: FloatArray, partial: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Curvature at the beginning and the end of each cell, (n,) arrays [1/(m²/s²)].

    Over each stretch without partial controls integrated backwards from none, and no more than what
    grows from none where the stretch begins.

    Parameters
    ----------
    hamiltonian : Hamiltonian
    secant : (n,) array
        See `secants`.
    partial : (n,) array of bool
    """
    problem, plan = hamiltonian.problem, hamiltonian.plan
    v = np.sqrt(plan.z[0, 1:] + plan.z[0, :-1])
    fastest = np.sqrt(2.0 * np.minimum(problem.ceiling[:-1], problem.ceiling[1:]))
    drag = 2.0 * problem.drag1[0] / (v + fastest) + 2.0 * problem.drag2[0]
    kept, needed = 1.0 + 2.0 * problem.step * drag, -problem.step * secant
    begin, end = np.zeros(v.size), np.zeros(v.size)
    for first, beyond in runs_of(~partial):
        backward, forward = np.zeros(beyond - first + 1), np.zeros(beyond - first + 1)
        if first == 0:
            forward[0] = np.inf  # where a run begins its speed is given
        for cell in range(beyond - 1, first - 1, -1):
            back = (backward[cell + 1 - first] + needed[cell]) / kept[cell]
            backward[cell - first] = max(back, 0.0)
        for cell in range(first, beyond):
            grown = forward[cell - first] * kept[cell] - needed[cell]
            forward[cell + 1 - first] = max(grown, 0.0)
        found = np.minimum(backward, forward)
        begin[first:beyond], end[first:beyond] = found[:-1], found[1:]
    return begin, end


def least_curved(
    hamiltonian: Hamiltonian,
    costate: FloatArray,
    slope: FloatArray,
    curvature: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """The least Hamiltonian with a curvature at the nodes, (k, p) [J/(kg m)]."""
    problem, segments = hamiltonian.problem, hamiltonian.segments
    cell, at = segments.cell, segments.positions
    part = (at - problem.positions[cell, None]) / problem.step[cell, None]
    begin, end = curvature
    rise = ((end - begin) / problem.step)[cell, None]
    kappa = begin[cell, None] + rise * problem.step[cell, None] * part
    z, change = hamiltonian.of_motion

    def costates(speed: FloatArray) -> FloatArray:
        return np.asarray(costate + kappa * (0.5 * speed**2 - z))

    def value(speed: FloatArray, middle: FloatArray) -> FloatArray:
        away = 0.5 * speed**2 - z
        a, b, c, constant = hamiltonian.along(costate + kappa * away, middle)
        # What traction is worth at the limit is in all four.
        own = a / speed + b * speed + (c - 0.5 * slope) * speed**2 + constant
        return np.asarray(own - 0.5 * rise * away**2 + kappa * away * change)

    gain, highest = problem.gain[0], hamiltonian.highest
    linear, square = problem.drag1[0], hamiltonian.drag2
    low = np.minimum(np.full(highest.shape, _SLOWEST), highest)
    least = _standing(hamiltonian, (costate, slope), (kappa, rise), (z, change), low)
    lowest = costates(np.zeros(highest.shape))
    while np.any(low < highest):
        high = np.minimum(_RATIO * low, highest)
        middle = 0.5 * (low + high)
        bend = 3.0 * hamiltonian.time / low**5 + np.maximum(-rise, 0.0)
        bend = bend + 2.0 * kappa * (linear / low + 2.0 * square + gain * problem.power[0] / low**3)
        bend = bend + np.maximum(-lowest, 0.0) * linear / low**3
        sag = bend * (0.5 * (high**2 - low**2)) ** 2 / 8.0
        both = np.minimum(value(low, middle), value(high, middle)) - sag
        least = np.where(high > low, np.minimum(least, both), least)
        low = high
    return np.asarray(least[0])


def _standing(
    hamiltonian: Hamiltonian,
    affine: tuple[FloatArray, FloatArray],
    curved: tuple[FloatArray, FloatArray],
    plan: tuple[FloatArray, FloatArray],
    speed: FloatArray,
) -> FloatArray:
    """What the Hamiltonian is not below from standstill up to low speeds: term by term."""
    (costate, slope), (kappa, rise), (z, change) = affine, curved, plan
    top = 0.5 * speed**2
    ends = np.stack((costate - kappa * z, costate + kappa * (top - z)))
    first, problem = hamiltonian.drag0, hamiltonian.problem
    last = first + problem.drag1[0] * speed + hamiltonian.drag2 * speed**2
    drag = np.minimum(ends * first, ends * last).min(axis=0)
    pull = np.maximum(ends * problem.gain[0] - hamiltonian.prices.traction, 0.0).max(axis=0)
    brake = np.maximum(-ends * problem.gain[0], 0.0).max(axis=0) + hamiltonian.regained
    away = np.maximum(z**2, (top - z) ** 2)
    own = hamiltonian.time / speed + drag - np.maximum(slope, 0.0) * top
    own = own - pull * hamiltonian.traction - brake * hamiltonian.braking
    own = own - 0.5 * np.maximum(rise, 0.0) * away
    return np.asarray(own + np.minimum(-kappa * z * change, kappa * (top - z) * change))
