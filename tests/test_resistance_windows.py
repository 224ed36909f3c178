"""From samples to windows, the windows' noise, and the regression over them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from resistance_trips import RESISTANCE, recording
from scipy.special import ndtri

from analysis.resistance.noise import FLOOR, Likelihood, NoiseModel, NoiseParts, estimate_noise
from analysis.resistance.regression import (
    BRAKE_SCALE_STD,
    DELAY_STD,
    LEAST_FORCE,
    condition_number,
    fit_windows,
)
from analysis.resistance.windows import Windows, build_windows
from trainlog.arrays import FloatArray
from trainlog.railway import RunningResistance
from trainlog.railway.resistance import OVER_MASS_STD
from trainlog.units import GRAVITY

NOISE = NoiseModel(speed=0.01, gradient=4e-4, position=8.0, effort=0.01)


@settings(max_examples=10)
@given(
    r0=st.floats(500.0, 10_000.0),
    r1=st.floats(0.0, 200.0),
    r2=st.floats(1.0, 30.0),
    mass=st.floats(50e3, 500e3),
)
def test_the_equation_of_motion_holds_in_every_window(
    r0: float, r1: float, r2: float, mass: float
) -> None:
    """Averaged ends and integrals are averaged alike: exact but for the trapezoidal rule."""
    exact = recording(mass=mass, resistance=RunningResistance(r0, r1, r2))
    windows = build_windows(exact)
    theta = np.array([1.0, r0, r1, r2]) / mass
    np.testing.assert_allclose(windows.x @ theta, windows.y, atol=5e-5)


def test_windows_fill_the_usable_stretches_and_nothing_else() -> None:
    made = recording(duration=300.0)
    usable = (made.time > 50.0) & ((made.time < 120.0) | (made.time > 127.0)) & (made.time < 150.0)
    usable &= ~((made.time > 140.0) & (made.time < 142.0))
    windows = build_windows(replace(made, usable=usable))
    # 50-120 s, 127-140 s and 142-150 s, less half a window at either side.
    assert windows.count == 68 + 11 + 6
    assert windows.duration.min() >= 1.0
    assert windows.duration.max() < 1.2
    for start, end in zip(windows.start, windows.end, strict=True):
        inside = (made.time >= start - 0.5) & (made.time <= end + 0.5)
        assert usable[inside].all()
    np.testing.assert_allclose(windows.start[1:68], windows.end[:67])


def dense(windows: Windows, noise: NoiseModel, mass: float = 130e3) -> FloatArray:
    """Covariance of the windows, cause by cause, as a full matrix."""
    gradient = GRAVITY * noise.gradient * windows.sections.toarray()
    position = noise.position * windows.edges.toarray()
    full = gradient @ gradient.T + position @ position.T
    full += np.diag(2.0 * noise.speed**2 + noise.effort**2 * windows.effort_square / mass**2)
    full += FLOOR**2 * np.eye(windows.count)
    joined = np.flatnonzero(windows.start[1:] - windows.end[:-1] < 1e-6)
    full[joined, joined + 1] -= noise.speed**2
    full[joined + 1, joined] -= noise.speed**2
    return np.asarray(full)


def rough(windows: Windows) -> Windows:
    """Windows whose position errors matter: a change of gradient of 5 per mille every 500 m."""
    edges = windows.sections.copy()
    edges.data = np.where(edges.data > 0.0, 0.05 / 25.0, 0.0)
    return replace(windows, edges=edges)


def test_covariance_is_that_of_generalised_least_squares() -> None:
    """Written out: full matrices, and what the parameters do to mass and resistance by steps."""
    made = recording(noise=0.02, seed=5)
    found = fit_windows(windows := rough(build_windows(made)), 130e3, 20e3)
    used = windows.select(found.kept)
    regressors = np.column_stack([used.x, used.effort_change, used.braking])
    spread = np.array([20e3 / 130e3**2, *OVER_MASS_STD, DELAY_STD / 130e3, BRAKE_SCALE_STD / 130e3])
    size = np.where(np.any(regressors != 0.0, axis=0), np.linalg.norm(regressors, axis=0), 1.0)
    precision = (regressors / size).T @ np.linalg.solve(
        dense(used, found.noise), regressors / size
    ) + np.diag(1.0 / (spread * size) ** 2)
    covariance = np.linalg.inv(precision) / np.outer(size, size)
    theta = np.array([1.0, *found.beta[:3], 0.0, 0.0]) / found.beta[3]

    def physical(at: FloatArray) -> FloatArray:
        return np.array([*at[1:4], 1.0]) / at[0]

    steps = 1e-5 * np.diag(np.abs(theta) + 1e-12)
    slopes = np.column_stack(
        [(physical(theta + step) - physical(theta - step)) / (2.0 * step.sum()) for step in steps]
    )
    expected = found.cluster_factor * slopes @ covariance @ slopes.T
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=2e-3
    )


@settings(max_examples=8)
@given(
    shortest=st.floats(20.0, 1500.0),
    gaps=st.lists(st.integers(0, 3900), max_size=6),
    seed=st.integers(0, 1000),
)
def test_whitening_turns_the_noise_into_white_noise(
    shortest: float, gaps: list[int], seed: int
) -> None:
    """Whatever pieces a window crosses, however long they last, wherever it is interrupted."""
    made = recording(duration=400.0)
    generator = np.random.default_rng(seed)
    edges = np.cumsum(generator.uniform(shortest, 2.0 * shortest, 500))
    position = 0.1 * np.cumsum(made.speed)
    usable = made.usable.copy()
    for gap in gaps:
        usable[gap : gap + 30] = False
    pieces = replace(
        made,
        usable=usable,
        section=np.searchsorted(edges, position),
        nearest_edge=np.searchsorted(0.5 * (edges[1:] + edges[:-1]), position),
        track_slope=1e-3 * np.exp(-((position % 500.0 - 250.0) ** 2) / 200.0),
    )
    windows = build_windows(pieces)
    factor = np.linalg.cholesky(dense(windows, NOISE))
    whitened = NoiseParts.of(windows, 130e3).whiten(NOISE, factor)
    np.testing.assert_allclose(whitened, np.eye(windows.count), atol=1e-9)


def drawn_errors(windows: Windows, noise: NoiseModel, seed: int, mass: float = 130e3) -> FloatArray:
    """Errors of the windows, drawn cause by cause; the windows are one stretch."""
    draw = np.random.default_rng(seed).standard_normal
    errors = GRAVITY * noise.gradient * (windows.sections @ draw(windows.sections.shape[1]))
    errors += noise.position * (windows.edges @ draw(windows.edges.shape[1]))
    errors += noise.speed * np.diff(draw(windows.count + 1))
    errors += noise.effort * np.sqrt(windows.effort_square) / mass * draw(windows.count)
    return np.asarray(errors)


def test_noise_is_found_as_large_as_it_is() -> None:
    windows = rough(build_windows(recording(duration=8000.0)))
    parts = NoiseParts.of(windows, 130e3)
    found = []
    for seed in range(5):
        columns = np.column_stack([windows.x, windows.x @ np.array([1.0, 1e3, 10.0, 1.0]) / 1e5])
        columns[:, -1] += drawn_errors(windows, NOISE, seed)
        found.append(estimate_noise(Likelihood(parts, columns, np.zeros((0, 5)))).sizes)
    ratio = np.median(found, axis=0)[:3] / np.array(NOISE.sizes)[:3]
    assert np.all((ratio > 0.75) & (ratio < 1.35)), ratio


def test_regression_finds_the_truth_within_its_deviation() -> None:
    z = []
    truth = np.array([RESISTANCE.r0, RESISTANCE.r1, RESISTANCE.r2, 130e3])
    for seed in range(12):
        fit = fit_windows(build_windows(recording(noise=0.03, seed=seed)), 120e3, 20e3)
        z.append((fit.beta - truth) / np.sqrt(np.diag(fit.covariance)))
    assert np.all(np.abs(np.mean(z, axis=0)) < 4.0 / np.sqrt(12.0))
    assert np.all(np.std(z, axis=0) < 1.4)
    assert np.all(np.std(z, axis=0) > 0.4)


def test_outliers_are_left_out() -> None:
    windows = build_windows(recording(noise=0.03))
    spoilt = windows.y.copy()
    spoilt[[100, 400]] += np.array([0.5, -0.8])
    clean, dirty = (fit_windows(w, 120e3, 20e3) for w in (windows, replace(windows, y=spoilt)))
    assert clean.kept.all()
    assert not dirty.kept[[100, 400]].any()
    assert dirty.kept.sum() >= windows.count - 6
    z = (dirty.beta - clean.beta) / np.sqrt(np.diag(dirty.covariance))
    assert np.all(np.abs(z) < 2.0)


@pytest.mark.parametrize(
    ("first", "last", "force"),
    [
        (300.0, 420.0, 0.02),
        (0.0, 500.0, -0.02),
    ],
)
def test_a_stretch_with_a_force_of_its_own_is_found(
    first: float, last: float, force: float
) -> None:
    """Over mass, of a part of 20 min. A long one may be the right part: the band holds both."""
    windows = build_windows(recording(noise=0.02, seed=4))
    inside = (windows.start >= first) & (windows.end <= last)
    dragged = replace(windows, y=windows.y - force * windows.duration * inside)
    clean, found = (fit_windows(each, 130e3, 20e3, search=True) for each in (windows, dragged))
    assert clean.stretches == ()
    (only,) = found.stretches
    assert (only.start, only.end) == (pytest.approx(first, abs=12.0), pytest.approx(last, abs=12.0))
    duration = windows.duration
    assert only.share == pytest.approx(duration[inside].sum() / duration.sum(), abs=0.02)
    assert only.ambiguous == (last - first > 300.0)
    assert abs(only.force - force * 130e3) < 3.0 * only.std
    assert only.std < 0.1 * abs(only.force)
    truth = np.array([RESISTANCE.r0, RESISTANCE.r1, RESISTANCE.r2, 130e3])
    half = 0.5 * only.force * only.ambiguous
    z = (found.beta - half * (np.arange(4) == 0) - truth) / np.sqrt(np.diag(clean.covariance))
    assert np.all(np.abs(z) < 4.0), z
    low = found.beta[0] - 2.0 * np.sqrt(found.covariance[0, 0])
    high = found.beta[0] + 2.0 * np.sqrt(found.covariance[0, 0])
    assert low < min(truth[0], truth[0] + 2.0 * half)
    assert max(truth[0], truth[0] + 2.0 * half) < high
    if only.ambiguous:
        own = found.covariance[0, 0] - half**2
        assert 0.5 < own / clean.covariance[0, 0] < 3.0
    # What is known already is not looked for again, and leads to the same.
    again = fit_windows(dragged, 130e3, 20e3, stretches=found.stretches)
    np.testing.assert_allclose(again.beta, found.beta)


def test_a_force_that_surveys_err_by_is_no_stretch() -> None:
    windows = build_windows(recording(noise=0.005, seed=4))
    inside = (windows.start >= 300.0) & (windows.end <= 420.0)
    for force, count in ((0.7 * LEAST_FORCE, 0), (1.6 * LEAST_FORCE, 1)):
        dragged = replace(windows, y=windows.y - force * windows.duration * inside)
        assert len(fit_windows(dragged, 130e3, 20e3, search=True).stretches) == count


def test_errors_that_stay_for_kilometres_widen_the_covariance() -> None:
    """A slowly changing head wind is not in the noise model; the clusters see it."""
    calm = build_windows(recording(noise=0.03))
    gusts = 0.003 * np.sin(np.arange(calm.count) / 60.0)
    windy = replace(calm, y=calm.y + gusts)
    first, second = (fit_windows(w, 120e3, 20e3) for w in (calm, windy))
    assert np.sqrt(second.covariance[0, 0]) > 2.0 * np.sqrt(first.covariance[0, 0])


def test_delay_and_brake_scale_do_not_spoil_the_fit() -> None:
    """Efforts recorded 0.1 s late, the brake's 3 % too large."""
    made = recording(noise=0.03, seed=5)
    braking = np.maximum(-made.effort, 0.0)
    wrong = made.effort - 0.03 * braking
    late = np.interp(made.time - 0.1, made.time, wrong)
    fit = fit_windows(
        build_windows(replace(made, effort=late, braking=1.03 * braking)),
        120e3,
        20e3,
    )
    truth = np.array([RESISTANCE.r0, RESISTANCE.r1, RESISTANCE.r2, 130e3])
    z = (fit.beta - truth) / np.sqrt(np.diag(fit.covariance))
    assert np.all(np.abs(z) < 3.0), z
    assert fit.delay == pytest.approx(0.1, abs=0.03)
    assert fit.brake_scale == pytest.approx(1.03, abs=0.01)


@pytest.mark.parametrize("name", ["effort_change", "braking", "tunnel"])
def test_what_the_data_do_not_show_of_efforts_and_tunnels_is_in_the_band(name: str) -> None:
    """Where it looks like a coefficient of the curve, that errs by all of it, as often as stated.

    Efforts are late by half a sample at 10 Hz, brakes wrong by 2 %, tunnels resist by 0.3 to 1.7
    times of what is expected.
    """
    place, size, std = {
        "effort_change": (0, 40e3, 0.05),
        "braking": (0, -100e3, 0.02),
        "tunnel": (2, 4.0, 0.7),
    }[name]
    exact, mass = build_windows(recording(mass=150e3, duration=900.0)), 150e3
    # Efforts that rise all the time, a brake that is always on, or one long tunnel.
    column = -size * exact.x[:, 1 + place]
    truth = np.append(RESISTANCE.coefficients, mass)
    z = []
    for seed, deviate in enumerate(ndtri((np.arange(16) + 0.5) / 16.0)):
        noise = np.random.default_rng(seed).standard_normal(exact.count + 1)
        sign = -1.0 if name == "tunnel" else 1.0
        wrong = deviate * std * column * sign
        made = replace(exact, **{name: column}, y=exact.y + wrong / mass + 0.01 * np.diff(noise))
        found = fit_windows(made, 140e3, 20e3)
        error = found.beta - truth
        z.append(error[place] / np.sqrt(found.covariance[place, place]))
        if name == "tunnel":
            assert found.tunnels is not None
            assert abs(found.tunnels[0] - 1.0) < 0.7
            assert found.tunnels[1] == pytest.approx(std, rel=0.1)
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.15), z


@pytest.mark.parametrize("alike", [0.0, 0.6, -0.8])
def test_condition_number_of_columns_at_an_angle(alike: float) -> None:
    across = np.sqrt(1.0 - alike**2)
    x = np.array([[1.0, alike, 0.0], [0.0, across, 0.0], [0.0, 0.0, 1.0]]) * [2.0, 30.0, 0.1]
    expected = np.sqrt((1.0 + abs(alike)) / (1.0 - abs(alike)))
    assert condition_number(x) == pytest.approx(expected)
    assert condition_number(x[:, [0, 1, 0]]) > 1e12
    assert condition_number(x * [1.0, 0.0, 1.0]) == np.inf


def test_a_wrong_momentum_of_wheels_that_slip_is_not_taken_for_noise_of_the_speed() -> None:
    """They run up every ten seconds of traction; their momentum is not there at all."""
    known = recording(noise=0.02, seed=3)
    phase = known.time % 10.0
    wrong = 20e3 * np.clip(np.minimum(phase, 3.0 - phase), 0.0, 1.0) * (known.effort > 20e3)
    stated = replace(known, rotating_momentum=known.rotating_momentum + wrong)
    right, taken, stated_so = (
        fit_windows(build_windows(each), 130e3, 20e3).noise.speed
        for each in (known, stated, replace(stated, slip_momentum=wrong))
    )
    assert taken > 4.0 * right
    assert stated_so == pytest.approx(right, rel=0.1)


def test_merged_windows_are_the_sums_of_their_parts() -> None:
    made = recording(duration=300.0)
    usable = (made.time > 50.0) & ((made.time < 120.0) | (made.time > 127.0)) & (made.time < 150.0)
    windows = build_windows(replace(made, usable=usable))
    merged = windows.merged()
    # Seven and three: none reaches over the gap, the last of each stretch is what is left.
    assert merged.count == 7 + 3
    assert np.all(merged.duration < 10.4)
    for name in ("y", "x", "braking", "effort_change", "effort_square", "duration"):
        np.testing.assert_allclose(
            np.sum(getattr(merged, name), axis=0), np.sum(getattr(windows, name), axis=0)
        )
    assert np.isin(merged.end, windows.end).all()
    assert windows.select(np.zeros(windows.count, dtype=bool)).merged().count == 0


def test_exact_data_give_the_exact_answer() -> None:
    fit = fit_windows(build_windows(recording()), 120e3, 20e3)
    truth = np.array([RESISTANCE.r0, RESISTANCE.r1, RESISTANCE.r2, 130e3])
    np.testing.assert_allclose(fit.beta, truth, rtol=2e-3)


def test_points_lie_on_the_curve_where_brakes_are_recorded_too_large() -> None:
    """Those that were used, and none of the two outliers, which stand by themselves."""
    made = recording()
    braking = np.maximum(-made.effort, 0.0)
    wrong = replace(made, effort=made.effort - 0.05 * braking, braking=1.05 * braking)
    windows = build_windows(wrong)
    spoilt = windows.y.copy()
    spoilt[[100, 400]] += np.array([0.5, -0.8])
    windows = replace(windows, y=spoilt)
    found = fit_windows(windows, 120e3, 20e3)
    points = found.points(windows, found.beta[-1])
    speed, value, used = points.speed, points.value, points.used
    assert used.sum() == speed.size - np.count_nonzero(~found.kept)
    assert np.count_nonzero(~found.kept) >= 2
    np.testing.assert_allclose(value[used], RESISTANCE(speed[used]), atol=0.02 * RESISTANCE(30.0))
    assert np.ptp(value[~used]) > 10.0 * RESISTANCE(30.0)
