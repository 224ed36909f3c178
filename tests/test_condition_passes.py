"""Passes over the places of a line, and what a day shows: beside sums written out in full."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
from scipy.stats import norm

from estimators.condition_passes import OFTEN, WIDE, along_line, diagonals_of, emissions

FRESH = np.array([[False, False, True], [False, False, True], [True, True, False]])


def test_the_pass_along_a_line_adds_up_all_ways_through_it() -> None:
    """Every bin's own likelihood is no part of what the others say of it."""
    rng = np.random.default_rng(1)
    bins, classes, size = 3, 3, 3
    likelihood = rng.uniform(0.1, 1.0, (bins, size))
    share, switch = rng.dirichlet(np.ones(classes)), rng.dirichlet(np.ones(classes), classes)
    start = rng.dirichlet(np.ones(size), classes)
    kernels = rng.dirichlet(np.ones(size), (classes, size))
    kernels[1] = kernels[0]  # the level moves alike in classes between which it is kept
    flat = np.zeros(bins, dtype=np.bool_)
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
            inside[c, i] += joint
        for (c, _), (d, _) in pairwise(way):
            changes[c, d] += joint
    np.testing.assert_allclose(found, np.log(whole), rtol=1e-10)
    np.testing.assert_allclose(cavity, others / others.sum(axis=1, keepdims=True), rtol=1e-10)
    np.testing.assert_allclose(low, last / whole, rtol=1e-10)
    np.testing.assert_allclose(moves, changes / whole, rtol=1e-10)
    np.testing.assert_allclose(held, inside / whole, rtol=1e-10)


LEVELS = np.log([0.05, 0.1, 0.2, 0.3])
SPOT = np.array([0.4, 0.3, 0.1, 0.1])
TRIP_STD, MET, ASTRAY = 0.12, 0.01, 0.3
NEAR = np.array([[0.1, 0.2, 0.3, 0.4]])


def said(count: int, mean: float, scatter: float, error: float) -> tuple[np.ndarray, ...]:
    """What a day with onsets, and nothing used without slip, says of each level."""
    nothing = np.zeros(0, dtype=np.int64)
    return emissions(  # type: ignore[no-any-return]
        np.array([[count, mean, scatter, error]]), np.zeros(2, dtype=np.int64), nothing,
        np.zeros(0), np.zeros((1, LEVELS.size)), LEVELS, SPOT, TRIP_STD, MET, NEAR,
        np.zeros(1, dtype=np.int64), ASTRAY,
    )  # fmt: skip


def test_one_onset_is_of_the_level_or_wide_of_it_or_astray_or_of_a_spot() -> None:
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


def test_as_many_onsets_are_of_short_spots_as_the_level_does_not_explain() -> None:
    _, _, number = said(2, np.log(0.06), 0.001, 0.0)
    assert number[0, -1] > 1.99  # both are far below
    _, _, number = said(2, np.log(np.sqrt(0.06 * 0.3)), (0.5 * np.log(0.06 / 0.3)) ** 2, 0.0)
    assert number[0, -1] < 1.1  # one is of the level itself
