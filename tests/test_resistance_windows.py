"""From samples to windows, the windows' noise, and the regression over them."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from resistance_trips import LINE, RESISTANCE, changed, constant_speed, recording, trip
from scipy.special import ndtri

from analysis.resistance import TripFit, TripRefusedError, fit_trip
from analysis.resistance.noise import (
    FLOOR,
    Likelihood,
    NoiseModel,
    NoiseParts,
    Windows,
    build_windows,
    estimate_noise,
)
from analysis.resistance.recording import Reason
from analysis.resistance.regression import LEAST_FORCE, Residuals, diagnosed, fit_windows
from trainlog.arrays import FloatArray
from trainlog.formats.railway import line_to_bytes
from trainlog.railway import RunningResistance, StepProfile, Survey
from trainlog.railway.resistance import basis
from trainlog.trip import LINE_ATTACHMENT
from trainlog.units import GRAVITY

NOISE = NoiseModel(speed=0.01, gradient=4e-4, position=8.0, effort=0.01)


@settings(max_examples=6)
@given(
    r0=st.floats(500.0, 10_000.0),
    r1=st.floats(0.0, 200.0),
    r2=st.floats(1.0, 30.0),
    mass=st.floats(50e3, 500e3),
)
def test_the_equation_of_motion_holds_in_every_window(r0, r1, r2, mass):
    """Averaged ends and integrals are averaged alike: exact but for the trapezoidal rule."""
    exact = recording(mass=mass, resistance=RunningResistance(r0, r1, r2))
    windows = build_windows(exact)
    theta = np.array([1.0, r0, r1, r2]) / mass
    np.testing.assert_allclose(windows.x @ theta, windows.y, atol=5e-5)


def test_windows_fill_the_usable_stretches_and_nothing_else():
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


@settings(max_examples=5)
@given(
    shortest=st.floats(20.0, 1500.0),
    gaps=st.lists(st.integers(0, 3900), max_size=6),
    seed=st.integers(0, 1000),
)
def test_whitening_turns_the_noise_into_white_noise(shortest, gaps, seed):
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


def test_noise_is_found_as_large_as_it_is():
    windows = rough(build_windows(recording(duration=8000.0)))
    parts = NoiseParts.of(windows, 130e3)
    found = []
    for seed in range(5):
        columns = np.column_stack([windows.x, windows.x @ np.array([1.0, 1e3, 10.0, 1.0]) / 1e5])
        columns[:, -1] += drawn_errors(windows, NOISE, seed)
        found.append(estimate_noise(Likelihood(parts, columns, np.zeros((0, 5)))).sizes)
    ratio = np.median(found, axis=0)[:3] / np.array(NOISE.sizes)[:3]
    assert np.all((ratio > 0.75) & (ratio < 1.35)), ratio


def test_outliers_are_left_out():
    windows = build_windows(recording(noise=0.03))
    spoilt = windows.y.copy()
    spoilt[[100, 400]] += np.array([0.5, -0.8])
    clean, dirty = (fit_windows(w, 120e3, 20e3) for w in (windows, replace(windows, y=spoilt)))
    assert clean.kept.all()
    assert not dirty.kept[[100, 400]].any()
    assert dirty.kept.sum() >= windows.count - 6
    z = (dirty.beta - clean.beta) / np.sqrt(np.diag(dirty.covariance))
    assert np.all(np.abs(z) < 2.0)
    # As points of the curve those that were used are joined, outliers stand one by one.
    points, scale = dirty.points(replace(windows, y=spoilt), dirty.beta[-1]), RESISTANCE(30.0)
    off = points.value - RESISTANCE(points.speed)
    assert np.count_nonzero(~points.used) == np.count_nonzero(~dirty.kept)
    assert np.abs(off[points.used]).max() < 0.1 * scale
    assert np.ptp(off[~points.used]) > 10.0 * scale


@pytest.mark.parametrize(("first", "last", "force"), [(300.0, 420.0, 0.02), (0.0, 500.0, -0.02)])
def test_a_stretch_with_a_force_of_its_own_is_found(first, last, force):
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


def test_a_force_that_surveys_err_by_is_no_stretch():
    windows = build_windows(recording(noise=0.005, seed=4))
    inside = (windows.start >= 300.0) & (windows.end <= 420.0)
    for force, count in ((0.7 * LEAST_FORCE, 0), (1.6 * LEAST_FORCE, 1)):
        dragged = replace(windows, y=windows.y - force * windows.duration * inside)
        assert len(fit_windows(dragged, 130e3, 20e3, search=True).stretches) == count


@pytest.mark.parametrize("name", ["effort_change", "braking", "tunnel"])
def test_what_the_data_do_not_show_of_efforts_and_tunnels_is_in_the_band(name):
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
            assert abs(found.tunnels[0] - 1.0) < 0.7
            assert found.tunnels[1] == pytest.approx(std, rel=0.1)
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.15), z


def test_what_the_survey_brings_in_is_what_its_errors_do():
    """Against least squares with dense matrices, the map's errors propagated one by one."""
    windows = rough(build_windows(recording(duration=1500.0)))
    windows = replace(windows, y=windows.y + drawn_errors(windows, NOISE, seed=4))
    fit = fit_windows(windows, 130e3, 20e3)
    precision = np.linalg.inv(dense(windows, fit.noise))
    x = np.column_stack([windows.x, windows.effort_change, windows.braking])
    prior = np.array([20e3 / 130e3**2, 1.0, 0.1, 0.01, 0.05 / 130e3, 0.02 / 130e3])
    scaled = x * prior
    gain = np.linalg.solve(scaled.T @ precision @ scaled + np.eye(6), scaled.T @ precision)
    gain *= prior[:, None]
    only_map = replace(fit.noise, speed=0.0, effort=0.0)
    found = gain @ dense(windows, only_map) @ gain.T
    mass = fit.beta[3]
    jacobian = np.zeros((4, 6))
    jacobian[:, 0] = -fit.beta * mass
    jacobian[[0, 1, 2], [1, 2, 3]] = mass
    expected = fit.cluster_factor * jacobian @ found @ jacobian.T
    size = np.sqrt(np.diag(fit.covariance))
    np.testing.assert_allclose(
        fit.survey / np.outer(size, size), expected / np.outer(size, size), atol=0.05
    )


TRUE = np.array(RESISTANCE.coefficients)


def on_wrong_map(length: float, survey: Survey | None, seed: int) -> TripFit:
    """A level trip whose line's file has elements of 100 m, equally wrong over each `length`."""
    starts = np.arange(0.0, LINE.length, 100.0)
    errors = 2e-4 * np.random.default_rng(seed).standard_normal(starts.size)
    gradients = StepProfile(starts, errors[(starts // length).astype(np.int64)])
    line = line_to_bytes(replace(LINE, gradients=gradients, survey=survey))
    made = trip(seed=seed)
    return fit_trip(replace(made, attachments={**made.attachments, LINE_ATTACHMENT: line}))


def distance(fit: TripFit) -> float:
    """Mean square of r0, r1 and r2 less their true values, in the metric of the covariance."""
    off = fit.beta - TRUE
    return float(off @ np.linalg.solve(fit.covariance[:3, :3], off)) / 3.0


def test_errors_that_reach_over_several_elements_are_reported_by_the_lines_file():
    stated = [on_wrong_map(1000.0, Survey(2e-4, 1000.0), seed) for seed in range(4)]
    unstated = [on_wrong_map(1000.0, None, seed) for seed in range(4)]
    assert np.mean([distance(fit) for fit in stated]) < 1.3
    assert np.median([fit.noise["gradient"] for fit in stated]) == pytest.approx(2e-4, rel=0.2)
    curve = basis(20.0) @ TRUE
    better, worse = (
        np.sqrt(np.mean([(fit.resistance(20.0) - curve) ** 2 for fit in fits]))
        for fits in (stated, unstated)
    )
    assert better < 0.85 * worse


def residuals(value: FloatArray, speed: FloatArray | None = None) -> Residuals:
    time = np.arange(value.size, dtype=np.float64)
    return Residuals(time, 20.0 * time, np.sin(time) if speed is None else speed, value)


def test_probabilities_of_good_residuals_are_spread_evenly():
    """Of few windows, too: half of the trips have less than one half."""
    found = [
        diagnosed(residuals(np.random.default_rng(seed).standard_normal(40))) for seed in range(500)
    ]
    for name in ("independence", "flatness"):
        below = np.mean([getattr(each, name) < 0.5 for each in found])
        assert below == pytest.approx(0.5, abs=0.07), name


def test_each_defect_is_reported():
    noise = np.random.default_rng(1).standard_normal(300)
    wind = np.convolve(noise, np.ones(5) / np.sqrt(5.0), mode="same")
    assert "err together" in " ".join(diagnosed(residuals(wind)).doubts)
    assert "misjudged" in " ".join(diagnosed(residuals(2.0 * noise)).doubts)
    spiky = noise.copy()
    spiky[::60] += 7.0
    assert "not normal" in " ".join(diagnosed(residuals(spiky)).doubts)
    speed = np.linspace(5.0, 35.0, 300)
    tilted = noise + (speed - 20.0) / 15.0
    for size in (1.0, 0.05):  # whatever the noise is taken for
        found = diagnosed(residuals(size * tilted, speed))
        assert "change with speed" in " ".join(found.doubts)
    nothing = diagnosed(residuals(np.zeros(20), np.full(20, 9.0)))
    assert (nothing.normality, nothing.flatness, nothing.independence) == (1.0, 1.0, 1.0)


def test_refusals_say_why_in_a_word_and_show_where():
    made = trip(noise=0.03)
    every_two_seconds = {name: frame.iloc[::20] for name, frame in made.topics.items()}
    cases = {
        "not recorded": changed(made, "/train/controls", tractive_effort=np.nan),
        "gap": replace(made, topics=every_two_seconds),
        "braking": changed(made, "/train/controls", pneumatic_braking_effort=30e3),
        "standstill": trip(lambda time: np.zeros(time.size), noise=0.0, duration=600.0),
        "too short": trip(duration=150.0),
        "condition": trip(constant_speed, noise=0.03),
    }
    for reason, bad in cases.items():
        caught = refused(TripRefusedError, "", fit_trip, bad)
        assert caught.reason == reason
        assert reason in get_args(Reason)
        timeline = caught.timeline
        if reason == "not recorded":
            assert timeline is None
            continue
        if reason in timeline.masks:
            assert timeline.masks[reason].mean() > 0.9
    caught = refused(TripRefusedError, "", fit_trip, trip(noise=1.0, seed=1), speeds=(0.5, 44.0))
    assert caught.reason == "excitation"
