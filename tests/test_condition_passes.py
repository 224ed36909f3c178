"""Passes, spots and changes of a line's condition: sums written out in full, drawn truths."""

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, strategies as st
from pandas import Timestamp
from refusals import refused
from scipy.special import logit
from scipy.stats import multivariate_normal, norm
from simulated_line import flirt, level_line
from trajectory_cases import observed

from analysis.adhesion.condition_map import LEVELS, SETTINGS, empty_map
from analysis.adhesion.map_state import (
    demonstrated_adhesion,
    risk_of_run,
    typical_adhesion,
    usable_adhesion,
)
from analysis.trajectory.problem import TrajectoryProblem
from analysis.verification.forecasts import rolling_forecast
from estimators import condition_passes as passes
from trainlog.condition import estimated, layer_before
from trainlog.errors import InputError
from trainlog.railway.condition import AdhesionEstimate, ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence

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
    half, diagonals = passes.diagonals_of(kernels)
    found, cavity, low, moves, held = passes.along_line(
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
    alone = passes.along_line(likelihood, flat, share, start, half, diagonals, switch, FRESH, True)
    assert alone[0] == found
    assert not any(each.any() for each in alone[1:])


STEPS = np.log([0.05, 0.1, 0.2, 0.3])
SPOT = np.array([0.4, 0.3, 0.1, 0.1])
TRIP_STD, MET, ASTRAY = 0.12, 0.01, 0.3
NEAR = np.array([[0.1, 0.2, 0.3, 0.4]])


def said(count: int, mean: float, scatter: float, error: float) -> tuple[np.ndarray, ...]:
    """What a day with onsets, and nothing used without slip, says of each level."""
    nothing = np.zeros(0, dtype=np.int64)
    return passes.emissions(
        np.array([[count, mean, scatter, error]]), np.zeros(2, dtype=np.int64), nothing,
        np.zeros(0), np.zeros((1, STEPS.size)), STEPS, SPOT, TRIP_STD, MET, NEAR,
        np.zeros(1, dtype=np.int64), ASTRAY,
    )  # fmt: skip


def test_one_onset_is_of_the_level_or_wide_of_it_or_astray_or_of_a_spot():
    mean, error = np.log(0.12), 0.02
    plain, short, number = said(1, mean, 0.0, error)
    std, wide = (np.sqrt((factor * TRIP_STD) ** 2 + error) for factor in (1.0, passes.WIDE))
    here = norm.pdf(mean, STEPS, std)
    own = (1.0 - passes.OFTEN) * here + passes.OFTEN * norm.pdf(mean, STEPS, wide)
    np.testing.assert_allclose(np.exp(plain[0]), own + ASTRAY * NEAR[0] @ here, rtol=1e-9)
    # A spot bears less than what lasts, or it is not met; of its own, or one of all onsets.
    beyond = 1.0 - np.cumsum(SPOT)
    spot = 1.5 * MET * (np.cumsum(SPOT * here) + beyond * here)
    np.testing.assert_allclose(np.exp(short[0]), spot, rtol=1e-9)
    np.testing.assert_array_equal(number, 1.0)


def test_two_onsets_are_shared_out_between_the_level_its_neighbours_and_spots():
    """Of both, either the lower one or both were of short spots, or astray; others slipped less."""
    error, borne = 0.02, 3.0
    variance, wide = (((factor * TRIP_STD) ** 2 + error) for factor in (1.0, passes.WIDE))
    tail = np.log([[0.2, 0.4, 0.9, 1.0], [0.1, 0.2, 0.5, 0.8]])
    lower, higher = np.log(0.1), np.log(0.16)
    mean, scatter = 0.5 * (lower + higher), (0.5 * (higher - lower)) ** 2
    # Of the second row; the first one holds what was used without slip alone.
    plain, short, number = passes.emissions(
        np.array([[0.0, 0.0, 0.0, 0.0], [2.0, mean, scatter, error]]), np.array([0, 1, 3]),
        np.array([1, 0, 1]), np.array([2.0, borne - 1.0, 1.0]), tail, STEPS, SPOT, TRIP_STD, MET,
        NEAR, np.zeros(2, dtype=np.int64), ASTRAY,
    )  # fmt: skip
    np.testing.assert_allclose(plain[0], 2.0 * tail[1])
    assert np.all(short[0] == -np.inf)
    bears = np.exp((borne - 1.0) * tail[0] + tail[1])
    low, middle, high = (norm.pdf(x, STEPS, np.sqrt(variance)) for x in (lower, mean, higher))
    scattered = norm.pdf(lower, STEPS, np.sqrt(wide)) * norm.pdf(higher, STEPS, np.sqrt(wide))
    own = (1.0 - passes.OFTEN) * low * high + passes.OFTEN * scattered
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
    given = (starts, day, plain, short, message, cavity, STEPS, cells, share, occupied, life)
    found, present, lasts, state, turnover, cut = passes.over_days(*given, lasting, True)
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
    assert not passes.over_days(*given, lasting, False)[-1].any()


def test_neighbours_of_a_day_say_what_all_their_states_added_up_say():
    """Each side of a row is a chain of its own; levels that are alike speak for one spot."""
    day, place = np.array([5, 4, 5, 5, 4]), np.array([9, 3, 7, 4, 2])
    order = np.lexsort((place, day))
    odds, prior = np.array([0.4, -0.3, 1.1, 2.0, 0.7]), np.array([0.1, 0.2, 0.3, 0.05, 0.15])
    level, noise = np.log([0.07, np.nan, 0.05, 0.08, 0.1]), np.array([0.02, 0.1, 0.03, 0.01, 0.02])
    keep, mean, std = 0.8, np.log(0.06), 0.3
    found = passes.beside(order, day, place, odds, prior, level, noise, keep, mean, std)

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
    for row, own in enumerate(probability):
        kernel = norm.pdf(cells[:, None], cells, std[row])
        kernel /= kernel.sum(axis=0)
        found = passes.blurred(probability, std, step)[row]
        np.testing.assert_allclose(found, kernel @ own, rtol=1e-4)


LINE = level_line(2_500.0)
BINS = 100
DAY = 20_000
OF_TRIP = 0.12  # with which the evidence is weighted


def met(day, place, level, borne, bins=3, std=0.03):
    """A trip with onsets at `level` in a few bins; everywhere else it used `borne` without slip."""
    weight, logs = np.zeros(BINS), np.zeros(BINS)
    slipped = slice(place, place + bins)
    weight[slipped] = 1.0 / (OF_TRIP**2 + std**2)
    logs[slipped] = weight[slipped] * np.log(level)
    used = np.zeros((BINS, LEVELS.size))
    used[:, int(np.searchsorted(LEVELS, borne))] = weight == 0.0
    return DailyEvidence.of_bins(day, weight > 0.0, weight, logs, used)


def calm(day: int, borne: float) -> DailyEvidence:
    return met(day, 0, 0.1, borne, bins=0)


def layer_of(pieces: list[DailyEvidence]) -> ConditionLayer:
    known = ConditionLayer.unestimated(DailyEvidence.total(pieces))
    return estimated(replace(empty_map(LINE), layers={"wet": known})).layer("wet")


def day(number: int) -> pd.Timestamp:
    return pd.Timestamp(0, tz="UTC") + pd.Timedelta(days=DAY + number, hours=6)


class TestWhatPasses:
    def test_a_spot_has_its_place_and_days_and_is_not_the_lasting_condition(self):
        """Thirty days of trips that bear 0.15; on the last three a spot of 0.07 in three bins."""
        pieces = [calm(DAY + number, 0.15) for number in range(27)]
        visited = layer_of(pieces + [met(DAY + n, 40, 0.07, 0.15) for n in range(27, 30)])
        assert np.all(visited.quantile(0.5)[40:43] > 0.14)
        # Yesterday counts, last month hardly.
        assert visited.expected(day(30)).below(0.1)[41] > 0.3
        assert visited.expected(day(75)).below(0.1)[41] < 0.1
        assert visited.expected(day(30)).below(0.1)[80] < 0.1
        (spot,) = visited.spots
        assert (spot.start, spot.end) == (1000.0, 1075.0)
        assert (spot.first - DAY, spot.last - DAY) == (27, 29)
        assert spot.low < 0.07 < spot.high
        assert spot.alive(day(30)) > 10.0 * spot.alive(day(75))

    def test_a_place_that_is_always_low_is_lasting(self):
        layer = layer_of([met(DAY + number, 40, 0.08, 0.15) for number in range(0, 30, 3)])
        assert np.all(np.abs(layer.log_mean[40:43] - np.log(0.08)) < 0.1)
        assert layer.spots == ()
        assert layer.changes == ()


class TestChanges:
    @pytest.mark.parametrize(("before", "after"), [(0.08, 0.16), (0.16, 0.08)])
    def test_a_change_is_dated_and_not_averaged_away(self, before, after):
        """Slip at one level for twenty days, then at another: ground, or grown over."""
        pieces = [met(DAY + number, 38, before, 0.06, bins=6) for number in range(0, 40, 2)]
        pieces += [met(DAY + number, 38, after, 0.06, bins=6) for number in range(40, 56, 2)]
        layer = layer_of(pieces)
        (change,) = layer.changes
        assert abs(change.day - DAY - 40) <= 2
        assert change.earliest <= change.day <= change.latest
        assert change.before == pytest.approx(before, rel=0.1)
        assert change.after == pytest.approx(after, rel=0.1)
        assert change.significance > 3.0
        assert np.all(np.abs(layer.log_mean[38:44] - np.log(after)) < 1.96 * layer.log_std[38:44])


def test_what_one_day_alone_showed_may_have_passed():
    normal = [met(DAY + n, 4 + 12 * n, 0.16, 0.05, bins=8) for n in range(7)]
    once = layer_of([*normal, *(met(DAY + 3, 90, 0.08, 0.05) for _ in range(6))])
    assert once.quantile(0.5)[91] < 0.1
    assert once.quantile(0.975)[91] > 0.14, "a spot of that day is in the band, too"
    often = [met(DAY + 3 * n, 90, 0.08, 0.05) for n in range(6)]
    assert layer_of([*normal, *often]).quantile(0.975)[91] < 0.11


@pytest.mark.parametrize("place_from", [pytest.param(None, marks=pytest.mark.long), 7])
def test_levels_stay_at_those_of_the_onsets_however_many_calm_trips(place_from):
    """A spread between trips that grows must not lift levels above all onsets; last days first."""
    pieces = []
    for number in range(16):
        pieces += [calm(DAY + number, 0.13), met(DAY + number, 20 + 3 * number, 0.16, 0.13)]
        if place_from is not None and number >= place_from:
            pieces.append(met(DAY + number, 10, 0.07, 0.13))
    known = ConditionLayer.unestimated(DailyEvidence.total(pieces))
    track = replace(empty_map(LINE), layers={"wet": known})
    forecast = rolling_forecast(track)
    for number in (15, 8):
        whole, found = layer_before(track, DAY + number, "wet"), forecast("wet", day(number))
        level = whole.quantile(0.5)[20:]
        assert np.all((level > 0.145) & (level < 0.18)), number
        assert found.quantile(0.5).tobytes() == whole.expected(day(number)).quantile(0.5).tobytes()
        assert whole.model["trip_std"].value < 0.12


def test_without_evidence_parameters_are_assumed_and_with_it_estimated():
    """Levels of places and trips are drawn with numbers that the map does not know."""
    generator = np.random.default_rng(4)
    places = np.log(0.2) + 0.1 * generator.standard_normal(BINS)
    pieces = []
    for number in range(30):
        weight = np.zeros(BINS)
        seen = generator.uniform(size=BINS) < 0.5
        weight[seen] = 1.0 / (OF_TRIP**2 + 0.03**2)
        logs = weight * (places + 0.06 * generator.standard_normal(BINS))
        none = np.zeros((BINS, LEVELS.size))
        pieces.append(DailyEvidence.of_bins(DAY + number, seen, weight, logs, none))
    model = layer_of(pieces).model
    trip = model["trip_std"]
    assert trip.source == "estimated"
    assert trip.value == pytest.approx(0.05, abs=0.015)
    assert model["mean"].value == pytest.approx(np.log(0.2), abs=0.1)
    assert model["spot_life"].source == "assumed"
    empty = layer_of([calm(DAY, 0.02)]).model
    assert {each.source for each in empty.values()} == {"assumed"}


@pytest.mark.parametrize("length", [300.0, 1_000.0, 2_500.0])
def test_bins_longer_than_a_slippery_place_have_the_level_of_their_onsets(length):
    """Of ten bins one was met at 0.06, the others at 0.12, on each of twenty days."""
    levels = np.where(np.arange(10) == 2, 0.06, 0.12)
    weight, unused = np.full(10, 1.0 / OF_TRIP**2), np.zeros((10, LEVELS.size))
    pieces = [
        DailyEvidence.of_bins(DAY + n, weight > 0.0, weight, weight * np.log(levels), unused)
        for n in range(20)
    ]
    known = ConditionLayer.unestimated(DailyEvidence.total(pieces))
    line = level_line(10.0 * length)
    found = estimated(replace(empty_map(line, length), layers={"wet": known})).layer("wet")
    assert found.quantile(0.5) == pytest.approx(levels, rel=0.1)
    assert found.model["slippery_length"].value > 0.0


FEW_LEVELS = np.array([0.04, 0.06, 0.08, 0.10])
FEW_BINS = 40


def made(seen=None, demonstrated=None):
    """A map with estimates of 10 per cent where seen, and trips that bore levels."""
    observed, mean = np.zeros(FEW_BINS, bool), np.zeros(FEW_BINS)
    censored = np.zeros((FEW_BINS, FEW_LEVELS.size))
    for index, adhesion in (seen or {}).items():
        observed[index], mean[index] = True, np.log(adhesion)
    for place, trips in (demonstrated or {}).items():
        censored[place] = trips
    nothing = np.zeros(FEW_BINS)
    known = DailyEvidence.of_bins(0, nothing, nothing, nothing, censored)
    layer = ConditionLayer(mean, np.full(FEW_BINS, 0.1), observed, evidence=known)
    about = "line", 25.0 * FEW_BINS, 25.0, FEW_LEVELS
    return TrackConditionMap(*about, {"wet": layer}, settings=dict(SETTINGS))


def test_each_bin_is_seen_demonstrated_or_assumed():
    track = made({3: 0.07}, {(8, 3): 4.0, (9, 0): 4.0})
    found = usable_adhesion(track, "wet", assumed=0.05)
    assert np.flatnonzero(found.seen).tolist() == [3]
    assert np.flatnonzero(found.demonstrated).tolist() == [8]
    assert np.all(found.seen.astype(int) + found.demonstrated + found.assumed == 1)
    assert found.values[3] == pytest.approx(0.07 * np.exp(-0.1))
    assert np.all(found.values[found.assumed] == 0.05)
    assert found.profile(210.0) == found.values[8] > 0.05


@given(st.lists(st.integers(0, 5), min_size=4, max_size=4), st.floats(0.0, 3.0), st.integers(0, 3))
def test_no_more_than_demonstrated_counts_and_trips_take_nothing_away(trips, sigmas, further):
    demonstrated = {(5, k): float(count) for k, count in enumerate(trips)}
    before = demonstrated_adhesion(made(demonstrated=demonstrated), "wet", sigmas)[5]
    highest = max((FEW_LEVELS[k] for k, count in enumerate(trips) if count), default=0.0)
    assert before <= highest
    demonstrated[5, further] += 1.0
    assert demonstrated_adhesion(made(demonstrated=demonstrated), "wet", sigmas)[5] >= before


@pytest.mark.parametrize(
    ("settings", "assumed", "words"),
    [(SETTINGS, 0.0, "above 0 and at most 1, not 0"), ({}, 0.05, "lacks the setting 'trip_std'")],
)
def test_what_cannot_be_counted_on_is_refused(settings, assumed, words):
    track = replace(made(), settings=settings)
    refused(InputError, words, usable_adhesion, track, "wet", assumed=assumed)


def test_a_risk_is_the_share_of_trips_that_find_less_at_a_place():
    track = made({3: 0.07, 9: 0.1})
    generator = np.random.default_rng(1)
    for risk in (0.05, 0.2):
        found = usable_adhesion(track, "wet", risk=risk)
        assert np.flatnonzero(found.seen).tolist() == [3, 9]
        met = 0.07 * np.exp(0.1 * generator.standard_normal(20_000))
        assert np.mean(met < found.values[3]) == pytest.approx(risk, abs=0.01)
    # What was demonstrated is read with the same caution, and so is what is typical.
    bold, careful = (
        usable_adhesion(made({3: 0.07}, {(8, 3): 4.0}), "wet", risk=risk, assumed=0.01)
        for risk in (0.3, 0.01)
    )
    assert careful.values[8] < bold.values[8] < 0.1
    typical = [typical_adhesion(track, "wet", risk=risk) for risk in (0.01, 0.05, 0.5)]
    assert typical == sorted(typical)
    for risk in (0.0, 1.0, -0.1, np.nan):
        with pytest.raises(InputError, match="a risk must be between 0 and 1"):
            usable_adhesion(track, "wet", risk=risk)


def test_a_risk_is_read_for_the_time_of_the_run():
    class Fading(ConditionLayer):
        """Expects half of the adhesion until a time."""

        def expected(self, time: Timestamp | None = None) -> AdhesionEstimate:
            worse = time is None or time < Timestamp("2026-11-22", tz="UTC")
            mean = self.log_mean - (np.log(2.0) if worse else 0.0)
            return AdhesionEstimate(mean, self.log_std, self.observed)

    known = made({3: 0.07})
    layer = known.layer("wet")
    fading = Fading(layer.log_mean, layer.log_std, layer.observed, evidence=layer.evidence)
    track = replace(known, layers={"wet": fading})
    early, late = Timestamp("2026-11-21T06:00Z"), Timestamp("2026-11-23T06:00Z")
    for options in ({"risk": 0.05}, {"sigmas": 1.0}):
        found = [usable_adhesion(track, "wet", time=each, **options) for each in (early, late)]
        assert found[1].values[3] == pytest.approx(2.0 * found[0].values[3])
    # Without a time a risk is that right after the last evidence; deviations are of what lasts.
    assert usable_adhesion(track, "wet", risk=0.05).values[3] < 0.04
    assert usable_adhesion(track, "wet", sigmas=1.0).values[3] > 0.06
    line = replace(level_line(track.length), name=track.line)
    options = {"end": 1_000.0, "condition_map": track, "risk": 0.05}
    cells = np.linspace(0.0, 1_000.0, FEW_BINS + 1)
    runs = [
        TrajectoryProblem(line, flirt(), observed(flirt(), 1.0), time=time, **options)
        for time in (early, late)
    ]
    assert runs[1].adhesion(cells)[3] == pytest.approx(2.0 * runs[0].adhesion(cells)[3])


@pytest.mark.parametrize("together", [0.0, 0.5, 0.95])
def test_the_risk_of_a_run_lies_between_its_bounds_however_places_hang_together(together):
    generator = np.random.default_rng(2)
    places = np.arange(10, 200, 20)
    rail = AdhesionEstimate(np.full(200, np.log(0.1)), np.full(200, 0.15), np.ones(200, bool))
    demand = np.zeros(200)
    demand[places] = rail.quantile(0.05)[0] * np.linspace(0.9, 1.0, places.size)
    least, most = risk_of_run(rail, demand, 25.0, 100.0)
    shared, own = generator.standard_normal((50_000, 1)), generator.standard_normal((50_000, 10))
    deviation = np.sqrt(together) * shared + np.sqrt(1.0 - together) * own
    met = 0.1 * np.exp(0.15 * deviation)
    failed = np.mean(np.any(met < demand[places], axis=1))
    assert least - 0.003 <= failed <= most + 0.003
    assert least == pytest.approx(0.05)
    assert risk_of_run(rail, np.zeros(200), 25.0, 100.0) == (0.0, 0.0)
