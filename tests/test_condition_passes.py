"""Passes over the places of a line, and what a day shows: beside sums written out in full."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from scipy.special import logit
from scipy.stats import multivariate_normal, norm

from estimators.condition_passes import (
    OFTEN,
    WIDE,
    along_line,
    beside,
    blurred,
    diagonals_of,
    emissions,
    over_days,
)

FRESH = np.array([[False, False, True], [False, False, True], [True, True, False]])


@pytest.mark.parametrize("left_out", [(), (1, 2)])
def test_the_pass_along_a_line_adds_up_all_ways_through_it(left_out):
    """Every bin's own likelihood is no part of what the others say of it."""
    rng = np.random.default_rng(1)
    bins, classes, size = 3, 3, 3
    likelihood = rng.uniform(0.1, 1.0, (bins, size))
    share, switch = rng.dirichlet(np.ones(classes)), rng.dirichlet(np.ones(classes), classes)
    start = rng.dirichlet(np.ones(size), classes)
    kernels = rng.dirichlet(np.ones(size), (classes, size))
    kernels[1] = kernels[0]  # the level moves alike in classes between which it is kept
    kernels[2] = np.diag(kernels[2].sum(axis=1))  # not at all: another half band width
    flat = np.isin(np.arange(bins), left_out)
    half, diagonals = diagonals_of(kernels)
    found, cavity, low, moves, held = along_line(
        likelihood, flat, share, start, half, diagonals, switch, FRESH, False
    )
    states = list(product(range(classes), range(size)))
    others, last, changes = np.zeros((bins, size)), np.zeros(bins), np.zeros((classes, classes))
    inside, whole = np.zeros((classes, size)), 0.0
    for way in product(states, repeat=bins):
        prior = share[way[0][0]] * start[way[0]]
        for (c, i), (d, j) in pairwise(way):
            prior *= switch[c, d] * (start[d, j] if FRESH[c, d] else kernels[c, i, j])
        each = np.array([likelihood[b, i] for b, (_, i) in enumerate(way)])
        joint = prior * each.prod()
        whole += joint
        for b, (c, i) in enumerate(way):
            others[b, i] += joint / each[b]
            last[b] += joint * (c == classes - 1)
            inside[c, i] += joint * (b not in left_out)
        for b, ((c, _), (d, _)) in enumerate(pairwise(way)):
            changes[c, d] += joint * (not flat[b] or not flat[b + 1])
    np.testing.assert_allclose(found, np.log(whole), rtol=1e-10)
    np.testing.assert_allclose(cavity, others / others.sum(axis=1, keepdims=True), rtol=1e-10)
    np.testing.assert_allclose(low, last / whole, rtol=1e-10)
    np.testing.assert_allclose(moves, changes / whole, rtol=1e-10)
    np.testing.assert_allclose(held, inside / whole, rtol=1e-10)
    alone = along_line(likelihood, flat, share, start, half, diagonals, switch, FRESH, True)
    assert alone[0] == found
    assert not any(each.any() for each in alone[1:])


LEVELS = np.log([0.05, 0.1, 0.2, 0.3])
SPOT = np.array([0.4, 0.3, 0.1, 0.1])
TRIP_STD, MET, ASTRAY = 0.12, 0.01, 0.3
NEAR = np.array([[0.1, 0.2, 0.3, 0.4]])


def said(count: int, mean: float, scatter: float, error: float) -> tuple[np.ndarray, ...]:
    """What a day with onsets, and nothing used without slip, says of each level."""
    nothing = np.zeros(0, dtype=np.int64)
    return emissions(
        np.array([[count, mean, scatter, error]]), np.zeros(2, dtype=np.int64), nothing,
        np.zeros(0), np.zeros((1, LEVELS.size)), LEVELS, SPOT, TRIP_STD, MET, NEAR,
        np.zeros(1, dtype=np.int64), ASTRAY,
    )  # fmt: skip


def test_one_onset_is_of_the_level_or_wide_of_it_or_astray_or_of_a_spot():
    mean, error = np.log(0.12), 0.02
    plain, short, number = said(1, mean, 0.0, error)
    std, wide = (np.sqrt((factor * TRIP_STD) ** 2 + error) for factor in (1.0, WIDE))
    here = norm.pdf(mean, LEVELS, std)
    own = (1.0 - OFTEN) * here + OFTEN * norm.pdf(mean, LEVELS, wide)
    np.testing.assert_allclose(np.exp(plain[0]), own + ASTRAY * NEAR[0] @ here, rtol=1e-9)
    # A spot bears less than what lasts, or it is not met; of its own, or one of all onsets.
    beyond = 1.0 - np.cumsum(SPOT)
    spot = 1.5 * MET * (np.cumsum(SPOT * here) + beyond * here)
    np.testing.assert_allclose(np.exp(short[0]), spot, rtol=1e-9)
    np.testing.assert_array_equal(number, 1.0)


def test_two_onsets_are_shared_out_between_the_level_its_neighbours_and_spots():
    """Of both, either the lower one or both were of short spots, or astray; others slipped less."""
    error, borne = 0.02, 3.0
    variance, wide = (((factor * TRIP_STD) ** 2 + error) for factor in (1.0, WIDE))
    tail = np.log([[0.2, 0.4, 0.9, 1.0], [0.1, 0.2, 0.5, 0.8]])
    lower, higher = np.log(0.1), np.log(0.16)
    mean, scatter = 0.5 * (lower + higher), (0.5 * (higher - lower)) ** 2
    # Of the second row; the first one holds what was used without slip alone.
    plain, short, number = emissions(
        np.array([[0.0, 0.0, 0.0, 0.0], [2.0, mean, scatter, error]]), np.array([0, 1, 3]),
        np.array([1, 0, 1]), np.array([2.0, borne - 1.0, 1.0]), tail, LEVELS, SPOT, TRIP_STD, MET,
        NEAR, np.zeros(2, dtype=np.int64), ASTRAY,
    )  # fmt: skip
    np.testing.assert_allclose(plain[0], 2.0 * tail[1])
    assert np.all(short[0] == -np.inf)
    bears = np.exp((borne - 1.0) * tail[0] + tail[1])
    low, middle, high = (norm.pdf(x, LEVELS, np.sqrt(variance)) for x in (lower, mean, higher))
    scattered = norm.pdf(lower, LEVELS, np.sqrt(wide)) * norm.pdf(higher, LEVELS, np.sqrt(wide))
    own = (1.0 - OFTEN) * low * high + OFTEN * scattered
    one_astray, both_astray = ASTRAY * NEAR[0] @ low * high, (ASTRAY * NEAR[0] @ middle) ** 2
    np.testing.assert_allclose(np.exp(plain[1]), bears * (own + one_astray + both_astray))

    def of_spots(density: np.ndarray) -> np.ndarray:
        return np.asarray(np.cumsum(SPOT * density) + (1.0 - np.cumsum(SPOT)) * density)

    trips = borne + 2.0
    one = (MET + 0.5 * MET / trips) * of_spots(low) * high
    both = (MET * of_spots(middle)) ** 2
    both += 0.5 * MET / (0.5 * trips * (trips - 1.0)) * of_spots(low * high)
    np.testing.assert_allclose(np.exp(short[1]), bears * (one + both))
    np.testing.assert_allclose(number[1], (one + 2.0 * both) / (one + both))


def test_the_pass_over_days_adds_up_all_that_may_have_been():
    """A day has no spot, or one of a level below the lasting one, which stays or is drawn anew."""
    rng = np.random.default_rng(2)
    starts, day = np.array([0, 3, 4]), np.array([1.0, 2.0, 7.0, 3.0])
    cells, share, occupied, life = np.array([0, 2]), np.array([0.6, 0.3]), 0.2, 9.0
    plain, short = rng.uniform(-2.0, 0.0, (4, 4)), rng.uniform(-4.0, 0.0, (4, 4))
    message, lasting = rng.uniform(-1.0, 1.0, 4), rng.dirichlet(np.ones(4))
    cavity = rng.dirichlet(np.ones(4), 2)
    given = (starts, day, plain, short, message, cavity, LEVELS, cells, share, occupied, life)
    found, present, lasts, state, turnover, cut = over_days(*given, lasting, True)
    likelihood, turns = np.zeros((2, 4)), np.zeros((2, 4, 4))
    of_spot, of_any, ended = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((2, 4, 2))

    def ways(first: int, last: int, level: int, turned: np.ndarray | None = None) -> float:
        """All that may have been on some days, added up beside their sum."""
        held = [j for j, cell in enumerate(cells) if cell < level]
        none, total = 1.0 - occupied * share[held].sum(), 0.0
        for way in product([-1, *held], repeat=last - first):
            weight, counts = 1.0, np.zeros(4)
            for r, now in enumerate(way, first):
                new = none if now < 0 else occupied * share[now] * np.exp(message[r])
                if r > first:
                    stay, before = np.exp(-(day[r] - day[r - 1]) / life), way[r - first - 1]
                    new = (1.0 - stay) * new + stay * (now == before)
                    kind = 0 if before < 0 else 2
                    counts[kind] += (now < 0) != (before < 0)
                    counts[kind + 1] += life * (1.0 - stay)
                brief = np.exp(short[r, level] + message[r])
                weight *= new
                weight *= np.exp(plain[r, cells[now]]) if now >= 0 else (
                    np.exp(plain[r, level]) + brief
                )  # fmt: skip
            total += weight
            if turned is not None:
                turned += weight * counts
                ended[place, level, way[-1]] += weight * (way[-1] >= 0)
                for r, now in enumerate(way, first):
                    brief = np.exp(short[r, level] + message[r])
                    brief /= brief + np.exp(plain[r, level])
                    of_spot[r, level] += weight * (now >= 0)
                    of_any[r, level] += weight * (brief if now < 0 else 1.0)
        return total

    for place, (first, last) in enumerate(pairwise(starts)):
        for i in range(4):
            likelihood[place, i] = ways(first, last, i, turns[place, i])
    np.testing.assert_allclose(found, np.log(likelihood), rtol=1e-10)
    posterior = cavity / (cavity * likelihood).sum(axis=1, keepdims=True)
    own = np.repeat(posterior, np.diff(starts), axis=0)
    np.testing.assert_allclose(lasts, (own * of_spot).sum(axis=1), rtol=1e-10)
    np.testing.assert_allclose(present, (own * of_any).sum(axis=1), rtol=1e-10)
    np.testing.assert_allclose(state, np.einsum("bi,bij->bj", posterior, ended), rtol=1e-10)
    np.testing.assert_allclose(turnover, np.einsum("bi,bij->j", posterior, turns), rtol=1e-10)
    levels = range(4)
    for r in (1, 2):
        parts = [[ways(*part, i) for i in levels] for part in ((0, r), (r, 3), (0, 3))]
        before, after, whole = np.log(np.array(parts) @ lasting)
        np.testing.assert_allclose(cut[r], before + after - whole, rtol=1e-9)
    assert cut[0] == cut[3] == 0.0
    assert not over_days(*given, lasting, False)[-1].any()


def test_neighbours_of_a_day_say_what_all_their_states_added_up_say():
    """Each side of a row is a chain of its own; levels that are alike speak for one spot."""
    day, place = np.array([5, 4, 5, 5, 4]), np.array([9, 3, 7, 4, 2])
    order = np.lexsort((place, day))
    odds, prior = np.array([0.4, -0.3, 1.1, 2.0, 0.7]), np.array([0.1, 0.2, 0.3, 0.05, 0.15])
    level, noise = np.log([0.07, np.nan, 0.05, 0.08, 0.1]), np.array([0.02, 0.1, 0.03, 0.01, 0.02])
    keep, mean, std = 0.8, np.log(0.06), 0.3
    found = beside(order, day, place, odds, prior, level, noise, keep, mean, std)

    def alike(r: int, other: int, tie: float) -> float:
        if np.isnan(level[r] + level[other]):
            return 1.0
        own, common = std**2 + noise[[r, other]], tie * std**2
        pair = np.diag(own - common) + common
        joint = multivariate_normal.pdf(level[[r, other]], [mean, mean], pair)
        return float(joint / norm.pdf(level[[r, other]], mean, np.sqrt(own)).prod())

    def said(chain: list[int]) -> float:
        """Log odds that a chain gives its last row, whose own evidence is no part of it."""
        total = np.zeros(2)
        for states in product((0, 1), repeat=len(chain)):
            weight = prior[chain[0]] if states[0] else 1.0 - prior[chain[0]]
            for (one, at), (two, to) in pairwise(zip(states, chain, strict=True)):
                tie = keep ** abs(place[at] - place[to])
                moved = (1.0 - tie) * (prior[to] if two else 1.0 - prior[to]) + tie * (one == two)
                weight *= moved * np.exp(one * odds[at])
                weight *= alike(at, to, tie) if one and two else 1.0
            total[states[-1]] += weight
        return float(np.log(total[1] / total[0]) - logit(prior[chain[-1]]))

    np.testing.assert_allclose(found[4], said([1, 4]))
    np.testing.assert_allclose(found[1], said([4, 1]))
    np.testing.assert_allclose(found[3], said([0, 2, 3]))
    np.testing.assert_allclose(found[2], said([3, 2]) + said([0, 2]))
    np.testing.assert_allclose(found[0], said([3, 2, 0]))


def test_a_normal_error_blurs_each_cell_over_those_of_the_grid():
    probability = np.random.default_rng(3).dirichlet(np.ones(9), 2)
    std, step = np.array([0.02, 0.3]), 0.1
    cells = step * np.arange(9)
    for row, given in enumerate(probability):
        kernel = norm.pdf(cells[:, None], cells, std[row])
        kernel /= kernel.sum(axis=0)
        found = blurred(probability, std, step)[row]
        np.testing.assert_allclose(found, kernel @ given, rtol=1e-4)
