"""The Hamiltonian of the bound of all trajectories, beside all speeds and controls tried out."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from trajectory_cases import FLIRT, FREIGHT, VIRM6, drawn, hilly_line, slippery

from analysis.trajectory import bound
from analysis.trajectory.bound import (
    Costate,
    Dual,
    Hamiltonian,
    Prices,
    Segments,
    _Piece,
    joined,
    reached,
)
from analysis.trajectory.convex import Multipliers
from analysis.trajectory.discretisation import Curves, Plan, Taper, discretise, effort_limits
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.problem import TrajectoryProblem
from analysis.trajectory.rollout import run_together
from trainlog.arrays import FloatArray
from trainlog.railway import EffortCurve

POINTS = 3
TRACTION = EffortCurve(
    np.array([0.0, 10.0, 16.0, 25.0, 60.0]), 1e3 * np.array([200, 180, 90, 80, 30.0])
)
BRAKE = EffortCurve(np.array([0.0, 3.0, 12.0, 60.0]), 1e3 * np.array([0, 150, 120, 40.0]))
CROSSED = replace(FLIRT, traction_curve=TRACTION, dynamic_braking_curve=BRAKE)
CURVED = replace(
    CROSSED, max_traction_power=2e7, max_dynamic_braking_power=2e7, max_acceleration=2.0,
    max_deceleration=2.0,
)  # fmt: skip
"""No other limit is below the curves at some speeds only."""

WEAK = replace(FLIRT, max_dynamic_braking_power=9e5, max_pneumatic_braking_effort=6e4)
STRONG = replace(FLIRT, max_dynamic_braking_power=9e5)
SHORT = replace(STRONG, max_dynamic_braking_effort=6e4)
"""Friction alone does more than the dynamic brake."""

SLIPPERY = slippery(hilly_line(), (900.0, 2_600.0, 0.06))

CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "line": (WEAK, {"objective": "line"}),
    "wheel": (FLIRT, {"objective": "wheel"}),
    "friction": (WEAK, {"objective": "wheel"}),
    "curves": (CURVED, {"objective": "line"}),
    "crossed curves": (CROSSED, {"objective": "line"}),
    "strong friction": (STRONG, {"objective": "line"}),
    "slippery": (FLIRT, {"objective": "line", "condition_map": SLIPPERY}),
    "common": (SHORT, {"objective": "line", "braking": "common"}),
}


@cache
def of(case: str) -> tuple[Hamiltonian, Prices, FloatArray, FloatArray]:
    """A plan of two configurations, any prices, and any two costates with any slopes."""
    train, asked = CASES[case]
    run = TrajectoryProblem(hilly_line(), train, drawn(train, 2, seed=2, spread=0.3), **asked)
    fastest, rng = fastest_run(run), np.random.default_rng(1)
    problem = discretise(run, np.unique([*run.breakpoints, 40.0, 300.0]))
    q, n = problem.shape
    problem = problem.tapered(Taper(rng.uniform(0.0, 0.05, n), np.zeros(n)))
    z = rng.uniform(0.2, 0.8, (q, n + 1)) * 0.5 * fastest.at(problem.positions) ** 2
    braking = rng.uniform(0.0, 0.5, (q, n)) * problem.braking
    traction = rng.uniform(0.1, 0.8, n) * problem.traction
    plan = Plan(z, traction, braking, np.minimum(0.5 * braking, problem.dynamic))
    time, share = rng.uniform(0.5, 6.0, (q, n)), rng.dirichlet(np.ones(q), n).T
    regained = rng.uniform(0.2, 0.5, q) * run.at_line
    dynamic = rng.uniform(0.0, 1.0, (q, n)) * regained[:, None]
    prices = Prices(1.1, regained, time, 0.0, share, dynamic)
    segments = Segments.of(problem, POINTS)
    shape = (2, q, n, POINTS)
    costate, slope = rng.uniform(-0.6, 1.6, shape), rng.uniform(-1e-2, 1e-2, shape)
    return Hamiltonian(problem, plan, fastest, run, segments), prices, costate, slope


def duals(case: str) -> dict[str, Dual]:
    """One costate, with the prices that its limits lead to, and two with any prices."""
    made, prices, costate, slope = of(case)
    rng, nodes = np.random.default_rng(3), np.zeros(0)
    efforts = made.priced(prices, costate[0])
    traction = rng.uniform(-0.5, 1.5, costate[0].shape)
    traction += (prices.traction - traction.sum(axis=0)) / len(traction)
    braking = np.zeros(traction.shape)
    if made.problem.common:
        braking = rng.uniform(-0.5, 0.5, traction.shape)
        braking -= braking.mean(axis=0)
    return {
        "one": Dual(prices, costate[:1], slope[:1], *efforts, nodes),
        "two": Dual(prices, costate, slope, traction, braking, nodes),
    }


def tried(made: Hamiltonian, dual: Dual, each: int, speed: FloatArray) -> list[FloatArray]:
    """The Hamiltonian of each configuration by a costate, at speeds (m, q, n, p).

    Without traction and with the most of it, each with the best of its brakes.
    """
    run, reference, prices = made.problem.run, made.problem.reference, dual.prices
    train, s = run.train, made.segments.positions
    limits = effort_limits(run, s.reshape(-1, 1), run.adhesion_at(s.ravel()))
    most_pull, most, friction, most_dynamic = (
        (value / reference).reshape(-1, *s.shape)
        for value in (limits.traction, limits.braking, limits.friction, limits.dynamic)
    )
    if run.braking == "common":
        most = np.broadcast_to(most.min(axis=0), most.shape)
    tunnel = train.tunnel_coefficient(run.line.tunnel_cross_section(s))
    found = [np.empty(speed.shape), np.empty(speed.shape)]
    for row, own in enumerate(run.configurations):
        v, gain, costate = speed[:, row], reference / own.inertia, dual.costate[each, row]
        drag = own.resistance(v) + own.mass * run.track_acceleration(s) + tunnel * v**2
        pull = np.minimum(most_pull.min(axis=0), own.max_power / reference / v)
        brake = np.minimum(most_dynamic[row], train.max_dynamic_braking_power / reference / v)
        if train.traction_curve is not None:
            part = own.max_power / train.max_traction_power
            pull = np.minimum(pull, train.traction_curve(v / part) / reference)
            brake = np.minimum(brake, train.dynamic_braking_curve(v) / reference)
        # In a corner of what is fed back, and of how much all brakes do besides.
        least = np.full(v.shape, np.inf)
        braked = costate * gain + np.broadcast_to(dual.braking, dual.costate[each].shape)[row]
        for dynamic in (0.0 * brake, brake, np.clip(most[row] - friction[row], 0.0, brake)):
            fed_back = np.minimum(dynamic, most[row])
            for total in (fed_back, np.minimum(most[row], friction[row] + fed_back)):
                least = np.minimum(least, braked * total - prices.regained[row] * fed_back)
        moved = costate * (drag / own.inertia + made.rise[row])
        away = dual.slope[each, row] * (0.5 * v**2 - made.z[row])
        found[0][:, row] = prices.time[row][:, None] / v + least + moved - away
        found[1][:, row] = found[0][:, row] + (dual.traction[row] - costate * gain) * pull
    return found


def speeds_of(made: Hamiltonian, count: int) -> FloatArray:
    """Up to the highest at each point, (m, q, n, p)."""
    parts = (np.geomspace(1e-3, 1.0, count)[:-1], np.linspace(1.0, 60.0, 10 * count) / 60.0)
    return np.maximum(
        np.unique(np.concatenate(parts))[:, None, None, None] * made.highest, bound.LEAST_SPEED
    )


@pytest.mark.parametrize("number", ["one", "two"])
@pytest.mark.parametrize("case", CASES)
def test_the_least_is_that_of_all_speeds_and_controls(case, number):
    """By the costate of the speeds below the plan's, and by that of the speeds above."""
    made, *_ = of(case)
    dual, speed = duals(case)[number], speeds_of(made, 300)
    own = np.full(made.speed.shape, np.inf)
    for each in range(len(dual.costate)):
        value = np.minimum(*tried(made, dual, each, speed))
        if number == "two":
            value[(speed < made.speed) if each else (speed > made.speed)] = np.inf
        at_plan = np.minimum(*tried(made, dual, each, made.speed[None]))[0]
        own = np.minimum(own, np.minimum(value.min(axis=0), at_plan))
    least, found = own.sum(axis=0), made.least(dual)
    assert np.all(found <= least + 1e-9)
    # Less than the least where limits cross between the speeds at which one of them bends.
    assert np.all(found >= least - 0.3)
    train = made.problem.run.train
    crossed = case in ("crossed curves", "common") or (train is WEAK)
    error = (least - found) / (1.0 + np.abs(least))
    assert np.quantile(error, 0.5 if crossed else 0.8) < 1e-3
    assert np.all((error < 1e-3) | crossed)


@pytest.mark.parametrize("case", CASES)
def test_together_no_traction_is_more_than_the_speeds_of_all_allow(case):
    """The least over pairs of speeds, each with the traction that is the most for both."""
    made, prices, costate, _ = of(case)
    dual = duals(case)["one"]
    least = made.least(dual)
    raised = made.raised(least, dual)
    speed = speeds_of(made, 60)
    free, _ = tried(made, dual, 0, speed)
    # As if all that traction is worth were each configuration's own.
    own = costate[0] * made.gain
    worth = np.maximum(own.sum(axis=0) - prices.traction, 0.0)
    _, limited = tried(made, replace(dual, traction=own - worth), 0, speed)
    by_both = np.full(least.shape, np.inf)
    for each, pulled in zip(free[:, 0], (limited - free)[:, 0], strict=True):
        pair = each + free[:, 1] + np.maximum(pulled, (limited - free)[:, 1])
        by_both = np.minimum(by_both, pair.min(axis=0))
    assert np.all(raised >= least)
    assert np.all(raised <= by_both + 1e-9 * (1.0 + np.abs(by_both)))
    missed, before = by_both - raised, by_both - least
    higher = before > 0.05
    assert higher.sum() > 0.1 * higher.size
    assert np.median(missed[higher] / before[higher]) < 0.25


@pytest.mark.parametrize("case", CASES)
def test_the_costate_changes_as_the_least_does_with_the_speed(case):
    """The adjoint equation: with its slopes the Hamiltonian is level about the plan's speeds."""
    made, prices, costate, _ = of(case)
    dual, step = duals(case)["one"], 1e-4
    level = replace(dual, slope=np.zeros_like(dual.slope))
    around = np.stack([made.speed - step, made.speed + step])
    rise = np.minimum(*tried(made, level, 0, around))
    expected = (rise[1] - rise[0]) / (2.0 * step) / made.speed
    np.testing.assert_allclose(made.slopes(prices, costate[0]), expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("case", CASES)
def test_a_plan_costs_what_its_efforts_and_its_time_are_worth(case):
    made, prices, _, _ = of(case)
    problem, plan = made.problem, made.plan
    place, fall = made.segments.place, problem.taper.fall[:, None]
    total = prices.traction * (plan.traction[:, None] + fall - 2.0 * fall * place)
    for row in range(problem.shape[0]):
        total = total + prices.time[row][:, None] / made.speed[row]
        total = total - prices.regained[row] * plan.dynamic[row][:, None]
    np.testing.assert_allclose(made.of_plan(prices), total, rtol=1e-10)


@pytest.mark.parametrize("case", CASES)
def test_prices_of_common_efforts_add_up_to_what_they_cost(case):
    """Each configuration has the share of its limit, and one brake for all costs nothing more."""
    made, prices, costate, _ = of(case)
    traction, braking = made.priced(prices, costate[0])
    np.testing.assert_allclose(traction.sum(axis=0), prices.traction)
    np.testing.assert_allclose(braking.sum(axis=0), 0.0, atol=1e-12)
    own = costate[0] * made.gain
    worth = own.sum(axis=0) - prices.traction
    np.testing.assert_allclose(own - traction, prices.share[:, :, None] * worth, atol=1e-12)


@pytest.mark.parametrize("train", [FLIRT, VIRM6, FREIGHT], ids=lambda train: train.name)
def test_inside_its_cells_a_plan_has_the_speeds_that_its_efforts_lead_to(train):
    """In long cells, with bends that begin and end in them, and traction that falls; by DOP853."""
    run = TrajectoryProblem(hilly_line(), train, drawn(train, 2, seed=2, spread=0.3))
    fastest, positions = fastest_run(run), np.union1d(run.breakpoints, [10.0, 50.0, 200.0, 400.0])
    problem, plan = run_together(discretise(run, positions), fastest.at(positions))
    made = Hamiltonian(problem, plan, fastest, run, Segments.of(problem, 4))
    line, fall, step = run.line, problem.taper.fall, problem.step
    for row, each in enumerate(run.configurations):
        for cell in range(1, step.size - 1):

            def force(s, z, row=row, each=each, cell=cell):
                place = (s - positions[cell]) / step[cell]
                pull = plan.traction[cell] + fall[cell] * (1.0 - 2.0 * place)
                v, where = np.sqrt(2.0 * z), np.array([s])
                drag = each.resistance(v) + each.mass * run.track_acceleration(where)
                drag += run.train.tunnel_coefficient(line.tunnel_cross_section(where)) * v**2
                return problem.reference * (pull - plan.braking[row, cell]) / each.inertia - (
                    drag / each.inertia
                )

            span, at = positions[cell : cell + 2], made.segments.positions[cell]
            begin = [plan.z[row, cell]]
            found = solve_ivp(force, span, begin, "DOP853", at, rtol=1e-9, max_step=step[cell] / 8)
            v = np.sqrt(2.0 * found.y[0])
            np.testing.assert_allclose(made.speed[row, cell], v, rtol=3e-4)
            change = np.ravel([force(*pair) for pair in zip(at, found.y[0], strict=True)])
            assert np.abs(made.rise[row, cell] - change).max() < 2e-3


def test_what_traction_is_worth_at_its_limit_is_shared_by_whose_power_limits_it():
    """By all alike where the effort limits it; so is what is fed back, by the multipliers."""
    problem = of("line")[0].problem
    q, n = problem.shape
    none, power = np.zeros((q, n)), np.array([[0.75], [0.25]]) * np.linspace(0.5, 2.0, n)
    power[:, : n // 2] = 0.0
    of_times = np.zeros((q, 0))
    made = Multipliers(none, np.ones(q), of_times, of_times, power, none, np.array([3.0, 1.0]))
    prices = Prices.of(problem, made, 100.0)
    np.testing.assert_allclose(prices.share[:, n // 2 :], np.tile([[0.75], [0.25]], n - n // 2))
    np.testing.assert_allclose(prices.share[:, : n // 2], 0.5)
    regained = problem.run.train.efficiency_regeneration * np.array([0.75, 0.25])
    np.testing.assert_allclose(prices.regained, regained)
    assert prices.traction == 1.0 / problem.run.train.efficiency_traction
    assert prices.allowed == 200.0


def test_quadrature_is_exact_for_what_time_and_costate_are_made_of():
    """Polynomials; and the root of the way from a standstill and to one."""
    made, *_ = of("line")
    segments, length = made.segments, made.problem.step
    inner = slice(1, -1)
    for power in range(2 * POINTS):
        whole = (segments.weights * segments.place**power).sum(axis=1)[inner]
        np.testing.assert_allclose(whole, length[inner] / (power + 1.0))
    for power in range(POINTS):
        so_far = segments.gathered(segments.place**power) / length[:, None]
        np.testing.assert_allclose(
            so_far[inner], segments.place[inner] ** (power + 1) / (power + 1)
        )
    start, end = segments.place[0], 1.0 - segments.place[-1]
    for weights, way, whole in (
        (segments.weights[0], start, length[0]),
        (segments.weights[-1], end, length[-1]),
    ):
        np.testing.assert_allclose(weights @ way**-0.5, 2.0 * whole)
    np.testing.assert_allclose(
        segments.positions, made.problem.positions[:-1, None] + length[:, None] * segments.place
    )


@pytest.mark.parametrize("even", [True, False])
def test_a_costate_joins_its_ends(even):
    made, prices, (costate, _), _ = of("line")
    begin, end = costate[:, :, 0], costate[:, :, -1]
    line = Costate(made.segments, begin, end, np.full(begin.shape, even))
    values, slopes = line.along(made, prices)
    segments, inner = made.segments, slice(1, -1)
    np.testing.assert_allclose(
        (slopes * segments.weights).sum(axis=2), end - begin, rtol=1e-9, atol=1e-9
    )
    # The slopes of its values, and where it is not even those of the adjoint equation but for one
    # constant in each cell.
    powers = np.arange(POINTS)
    fit = np.linalg.inv(segments.place[:, :, None] ** powers)
    own = np.einsum("nkp,qnp->qnk", fit, slopes)[:, inner, None, :]
    place = segments.place[inner][:, :, None] ** (powers + 1) / (powers + 1)
    rise = (own * place).sum(axis=3) * segments.length[inner][:, None]
    np.testing.assert_allclose(values[:, inner], begin[:, inner, None] + rise, rtol=1e-9, atol=1e-9)
    straight = begin[:, :, None] + (end - begin)[:, :, None] * segments.place
    if even:
        np.testing.assert_allclose(values, straight)
    else:
        apart = slopes - made.slopes(prices, straight)
        assert np.ptp(apart, axis=2).max() < 1e-9 * np.abs(slopes).max()


@pytest.mark.parametrize("case", CASES)
def test_on_each_stretch_the_better_costate_counts(case):
    """Two that are the same in every third cell: the best of all ways to put them together."""
    made, prices, (costate, _), (slope, _) = of(case)
    n, random = costate.shape[1], np.random.default_rng(4)
    same = np.arange(n) % 3 == 2
    other = np.where(same[:, None], costate, costate + random.uniform(-0.1, 0.1, costate.shape))
    at_nodes = random.uniform(-0.5, 0.5, n + 1)
    # A node between two cells that are the same is, too.
    at_others = at_nodes + random.uniform(-40.0, 40.0, n + 1) * ~(
        np.append(same, True) & np.insert(same, 0, True)
    )
    one, two = (
        Dual(prices, each[None], slope[None], *made.priced(prices, each), nodes)
        for each, nodes in ((costate, at_nodes), (other, at_others))
    )
    least, weights = (made.least(one), made.least(two)), made.segments.weights

    def value(dual: Dual, lowest: FloatArray) -> float:
        return float((lowest * weights).sum() + dual.at_nodes.sum())

    dual, found = joined(weights, one, two, least)
    best = value(one, least[0])
    for begin in range(0, n, 3):
        cells, nodes = slice(begin, begin + 2), slice(begin, min(begin + 3, n + 1))
        gain = ((least[1] - least[0]) * weights)[cells].sum()
        best += max(float(gain + (at_others - at_nodes)[nodes].sum()), 0.0)
    assert value(dual, found) == pytest.approx(best)
    assert value(dual, found) > max(value(one, least[0]), value(two, least[1]))
    np.testing.assert_allclose(found, made.least(dual))


def test_no_finer_run_is_faster_than_what_is_reached():
    """The envelope on its own cells, thinned out, bounds those between; and not by much."""
    run = TrajectoryProblem(hilly_line(), FLIRT, drawn(FLIRT, 2, seed=2))
    fine = fastest_run(run)
    kept = np.unique(
        [
            *range(0, fine.positions.size, 2),
            *np.flatnonzero(np.isin(fine.positions, run.breakpoints)),
        ]
    )
    coarse = replace(
        fine, positions=fine.positions[kept], speeds=fine.speeds[:, kept],
        elapsed=fine.elapsed[:, kept], pulling=fine.pulling[:, kept[:-1]],
    )  # fmt: skip
    found = reached(coarse, fine.positions)
    assert np.all(found >= fine.speeds)
    assert np.median(found - fine.speeds) < 0.02
    any_run = replace(
        coarse, positions=np.arange(5.0), speeds=np.array([[0.0, 3.0, 3.5, 2.0, 1.0]])
    )
    at_nodes = reached(any_run, any_run.positions)
    np.testing.assert_allclose(at_nodes, any_run.speeds, rtol=3e-4, atol=2e-6)


@pytest.mark.parametrize("signs", [(1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (0, 1), (-1, 0)])
def test_what_a_cell_costs_is_bounded_whatever_the_sizes_of_its_terms(signs):
    rng = np.random.default_rng(5)
    a, b, c = 10.0 ** rng.uniform(-2.0, 1.5, (3, 400)) * [[signs[0]], [1.0], [signs[1] * 0.01]]
    b *= rng.choice([-1.0, 1.0], 400)
    low = rng.uniform(0.3, 10.0, 400)
    high = low + rng.uniform(0.1, 30.0, 400)
    v = low + (high - low) * np.linspace(0.0, 1.0, 4_001)[:, None]
    least = (a / v + b * v + c * v**2).min(axis=0)
    found = bound._least(a, b, c, (low, high), rng.uniform(low, high))
    assert np.all(found <= least + 1e-9 * np.maximum(np.abs(least), 1.0))
    assert np.max(least - found) < 1e-4


@pytest.mark.parametrize("curve", [TRACTION, BRAKE], ids=["traction", "brake"])
def test_an_effort_is_the_lowest_of_its_limits_at_each_speed(curve):
    """Beyond the curve's last point, too, where it goes on at the power of that."""
    share = np.array([1.0, 0.8])
    own = EffortCurve(curve.speeds, curve.efforts / 1e5)
    curves = Curves.of(own, share, 100.0)
    speed = np.tile(np.linspace(0.3, 1.6 * own.speeds[-1], 400)[:, None], (2, 1, 1))
    speed = speed.reshape(2, 400, 1)
    for effort, power in ((1.3, 18.0), (5.0, 1e3), (0.4, 1e3), (5.0, 12.0)):
        limits = np.full(speed.shape, effort), np.full(speed.shape, power)
        plain = _Piece.of(*limits, None, speed).at(speed)
        np.testing.assert_allclose(plain, np.minimum(effort, power / speed))
        expected = np.minimum(plain, own(speed / share[:, None, None]))
        np.testing.assert_allclose(_Piece.of(*limits, curves, speed).at(speed), expected)


def test_between_two_nodes_a_run_may_turn_from_one_slope_to_the_other():
    """By hand: slopes of 6, 4, 1, -2 and -5 of half the square of the speed, over 1 m each."""
    z = np.array([1.0, 7.0, 11.0, 12.0, 10.0, 5.0])
    run = replace(
        fastest_run(of("line")[0].problem.run),
        positions=np.arange(6.0),
        speeds=np.sqrt(2.0 * z)[None],
    )
    found = reached(run, np.arange(5) + 0.5)[0]
    np.testing.assert_allclose(0.5 * found**2, [4.5, 10.25, 13.0, 12.5, 8.25], rtol=1e-3)
