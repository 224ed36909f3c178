"""Windows, their noise and the regression; many trips: common curve, observed set, files."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Any, get_args

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from resistance_trips import LINE, RESISTANCE, changed, constant_speed, recording, trip
from scipy.special import ndtri

from analysis import TripRefusedError, combine, fit, fit_trip, parameter_set
from analysis.charts import draw, draw_all, draw_charts
from analysis.fleet.resistance import fleet_resistance
from analysis.resistance import TripFit, summarised
from analysis.resistance.curve import nearest_physical
from analysis.resistance.logs import AllRefusedError
from analysis.resistance.noise import (
    FLOOR,
    Likelihood,
    NoiseModel,
    NoiseParts,
    Windows,
    build_windows,
    estimate_noise,
)
from analysis.resistance.observed import choose
from analysis.resistance.plot import refused_chart, trips_charts
from analysis.resistance.recording import Reason
from analysis.resistance.regression import LEAST_FORCE, Residuals, diagnosed, fit_windows
from estimators.mixed import mixed_effects
from trainlog.arrays import FloatArray
from trainlog.errors import InputError, LogError, NotIdentifiableError
from trainlog.formats.declared import thing_from_bytes, thing_to_bytes
from trainlog.formats.railway import line_to_bytes, read_parameters, write_parameters
from trainlog.formats.samples import sample
from trainlog.formats.summaries import (
    COLUMNS,
    covariances_of,
    merged,
    parameters_of,
    read_summaries,
    write_summaries,
)
from trainlog.mcap import write_log
from trainlog.railway import Passport, Quantity, RunningResistance, StepProfile, Survey
from trainlog.railway.resistance import basis
from trainlog.railway.train import ParameterSet
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
        found.append(estimate_noise(Likelihood(parts, columns, np.zeros((0, 5)))))
    ratio = np.median(found, axis=0)[:3] / np.array(NOISE)[:3]
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
    only_map = fit.noise._replace(speed=0.0, effort=0.0)
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
        assert (caught.timeline is None) == (reason == "not recorded")
        if caught.timeline is not None and reason in caught.timeline.masks:
            assert caught.timeline.masks[reason].mean() > 0.9
    assert "to determine mass, r0, r1, r2 (condition" in str(caught)
    assert caught.fit is None, "a negative mass adds to no other trip"
    caught = refused(TripRefusedError, "", fit_trip, trip(noise=1.0, seed=1), speeds=(0.5, 44.0))
    assert caught.reason == "excitation"


SPEED = np.linspace(5.0, 35.0, 61)
NODES = basis(np.linspace(5.0, 35.0, 3))


@cache
def whole_fit() -> TripFit:
    return fit_trip(trip(noise=0.03))


def fit_of(name, beta, covariance, train="unit", **changes) -> TripFit:
    """A fit of made-up coefficients."""
    full = np.zeros((4, 4))
    full[:3, :3], full[3, 3] = covariance, 200.0**2
    known = {"mass": 130e3, "freedom": 90, "asked": (5.0, 35.0), "speed_range": (3.0, 34.0)}
    known |= {"noise": {"speed": 0.01}, "windows": {"used": 94, "outlier": 0}, "max_power": None}
    known |= {"survey": np.zeros((4, 4)), "masked": {"braking": 10.0}, "gradients": ""}
    known |= {"passport": None, "identity": ""}
    curve = RunningResistance(*beta.tolist())
    about = {"trip": name, "train": train, "resistance": curve, "covariance": full}
    return replace(whole_fit(), **known | about | changes)


def covariance_of(curve_std: tuple[float, float, float]) -> FloatArray:
    """Covariance of r0, r1, r2 from independent errors [N] of the curve at three speeds."""
    back = np.linalg.inv(NODES)
    return np.asarray(back @ np.diag(np.square(curve_std)) @ back.T)


def drawn(count, spread, curve_std, seed) -> tuple[list[TripFit], FloatArray]:
    """Fits of trips whose curves differ by `spread`, and their true coefficients."""
    generator = np.random.default_rng(seed)
    covariance = covariance_of(curve_std)
    root = np.linalg.cholesky(covariance)
    true = TRUE * (1.0 + spread * generator.standard_normal((count, 3)))
    fits = [
        fit_of(f"trip-{k:03d}", true[k] + root @ generator.standard_normal(3), covariance)
        for k in range(count)
    ]
    return fits, true


def rows(count: int = 6, seed: int = 1) -> pd.DataFrame:
    """Summaries of made-up trips, each with a digest."""
    fits, _ = drawn(count, 0.05, (150.0, 60.0, 100.0), seed)
    digests = {fit.trip: f"{seed:02d}{number:062d}" for number, fit in enumerate(fits)}
    return summarised(fits, digests=digests)


def test_band_of_the_common_curve_covers():
    inside = []
    for seed in range(15):
        fits, _ = drawn(12, 0.06, (200.0, 80.0, 200.0), seed)
        low, high = combine(fits).band(SPEED)
        inside.append(np.all((low < RESISTANCE(SPEED)) & (RESISTANCE(SPEED) < high)))
    assert np.mean(inside) >= 0.92


@settings(max_examples=50)
@given(r0=st.floats(-3000.0, 5000.0), r1=st.floats(-300.0, 300.0), r2=st.floats(1.0, 30.0))
def test_nearest_physical_resistance(r0, r1, r2):
    covariance = covariance_of((300.0, 50.0, 100.0))
    beta = np.array([r0, r1, r2])
    nearest = np.array(nearest_physical(beta, covariance).coefficients)
    assert np.all(nearest >= 0.0)
    if np.all(beta >= 0.0):
        np.testing.assert_allclose(nearest, beta, rtol=1e-6, atol=1e-6)
        return
    weight = np.linalg.inv(covariance)
    distance = (nearest - beta) @ weight @ (nearest - beta)
    for other in np.abs(np.random.default_rng(1).standard_normal((200, 3))) * np.abs(beta):
        assert distance <= (other - beta) @ weight @ (other - beta) * (1.0 + 1e-9)


def test_what_cannot_be_fitted_or_combined_is_refused():
    covariance = covariance_of((50.0, 50.0, 50.0))
    one = fit_of("a", TRUE, covariance)
    other = fit_of("b", TRUE, covariance, train="other")
    refused(NotIdentifiableError, "no trip", combine, [])
    refused(InputError, "given twice", combine, [one, one])
    refused(InputError, "different trains: other, unit", combine, [one, other])
    made = trip()
    refused(LogError, "has no line", fit_trip, replace(made, attachments={}))
    state = made["/train/state"]
    backwards = state.iloc[np.r_[0:100, 50 : len(state)]]
    refused(LogError, "time does not increase", fit_trip, made.with_topic(backwards))


@pytest.mark.usefixtures("unpainted")
def test_logs_to_parameters_pictures_and_summaries(tmp_path):
    trips = [trip(name=f"made-{k}", noise=0.03, seed=k) for k in range(3)]
    trips.append(trip(constant_speed, name="dull", noise=0.03))
    logs = [tmp_path / f"{one.name}.mcap" for one in trips]
    for one, path in zip(trips, logs, strict=True):
        write_log(one, path)
    fits = fit(logs)
    assert [one.trip for one in fits.trips] == ["made-0", "made-1", "made-2"]
    assert list(fits.refused) == ["dull"]
    assert fits.refused["dull"].reason == "condition"
    assert "vary too little" in str(fits.refused["dull"])
    assert all(len(detail["sha256"]) == 64 for detail in fits.parameters.details)
    assert set(fits.parameters.provenance["inputs"]) == {one.name for one in trips}
    off = fits.common.resistance(SPEED) / RESISTANCE(SPEED) - 1.0
    assert np.sqrt(np.mean(off**2)) < 0.02
    write_parameters(fits.parameters, tmp_path / "parameters.json")
    back = read_parameters(tmp_path / "parameters.json")
    assert back.configurations == fits.parameters.configurations
    assert back.details == fits.parameters.details
    draw(fits, tmp_path / "fits.png")
    blind = TripRefusedError("not recorded", "nothing")
    dull = fits.refused["dull"]
    for name, refusal in (("dull", dull), ("blind", blind)):
        draw_charts(refused_chart("dull", refusal), tmp_path / f"{name}.png")
    assert all((tmp_path / f"{name}.png").is_file() for name in ("fits", "dull", "blind"))
    # Known logs are not read again, and nothing changes.
    for name, part in (("a", logs[:1]), ("b", logs[1:])):
        write_summaries(fit(part).summaries, tmp_path / f"{name}.parquet")
    summaries = [tmp_path / "b.parquet", tmp_path / "a.parquet"]
    again = fit([*summaries, *logs])
    assert (again.known, len(again.trips), len(again.refused)) == (4, 0, 0)
    pd.testing.assert_frame_equal(again.summaries, fits.summaries, check_exact=True)
    for each in (again, fit(summaries)):
        assert thing_to_bytes(each.parameters) == thing_to_bytes(fits.parameters)
    assert fits.parameters.cover["refused"] == {"condition": 1}
    # Logs that say nothing are refused together.
    stated = refused(AllRefusedError, "no trip determines .* vary too little", fit, logs[3:])
    assert draw_all(trips_charts((), stated.refused), tmp_path) == [tmp_path / "dull.png"]
    refused(NotIdentifiableError, r"^no log was given; give logs, folders of logs, or", fit, [])


def test_an_assumed_gain_of_the_efforts_does_not_average_out():
    """All trips of one recorder err alike; what each weighed load shows errs anew."""
    fits, _ = drawn(12, 0.02, (60.0, 60.0, 60.0), seed=4)
    unknown = Quantity(np.nan, np.nan, "assumed")
    found = {}
    for source in ("assumed", "estimated"):
        gain = Quantity(1.0, 0.05, source)
        passport = Passport("made", unknown, gain, *4 * [unknown])
        beta = [np.append(fit.beta, fit.mass) for fit in fits]
        added = [0.05**2 * np.outer(each, each) for each in beta]
        widened = [
            replace(fit, passport=passport, covariance=fit.covariance + more)
            for fit, more in zip(fits, added, strict=True)
        ]
        found[source] = combine(widened)
    speed = 20.0
    share = {source: float(one.std(speed) / one.resistance(speed)) for source, one in found.items()}
    assert 0.05 < share["assumed"] < 0.06
    assert share["estimated"] < 0.03
    # Trips do not differ by what they have in common.
    assert found["assumed"].spread(speed) < 1.5 * combine(fits).spread(speed)


def test_trips_on_different_routes_share_the_errors_of_their_edges():
    """Of an edge that all ran over for half of their way half of the errors do not average out."""
    survey = np.zeros((4, 4))
    survey[:3, :3] = covariance_of((200.0, 200.0, 200.0))
    apart = [f'{{"edge {number}": 1.0}}' for number in range(20)]
    half = [f'{{"common": 0.5, "edge {number}": 0.5}}' for number in range(20)]
    whole = ["a digest"] * 20
    variances = []
    for every in (apart, half, whole):
        fits = [
            fit_of(f"{n}", TRUE, covariance_of((300.0, 300.0, 300.0)), survey=survey, gradients=key)
            for n, key in enumerate(every)
        ]
        variances.append(float(combine(fits).std(20.0)) ** 2)
    independent, shared, same = variances
    assert independent < shared < same
    assert shared - independent == pytest.approx(0.5 * (same - independent), rel=0.05)


def test_options_that_state_nothing_are_refused():
    cases: dict[tuple[str, str], tuple[Any, ...]] = {
        ("cover", "must be a fraction above 0 and below 1"): (95.0, 1.0, "95 %"),
        ("most", "must be a whole number .* 1 or more"): (0, 2.5),
        ("speeds", "must be a lowest and a higher, .* in m/s"): ((30.0, 10.0), (5.0, np.nan), 5.0),
        ("speeds", "give the speeds in m/s, not in km/h"): ((40.0, 120.0),),
    }
    for (name, words), values in cases.items():
        for value in values:
            refused(InputError, words, fit, sample("nonstop.mcap"), **{name: value})


DIRECTIONS = np.random.default_rng(99).standard_normal((400, 4))


def features(count: int, seed: int) -> FloatArray:
    """Trips that differ by some per cent in four correlated features."""
    generator = np.random.default_rng(seed)
    mixing = np.array([[1.0, 0.8, 0.0, 0.0], [0.0, 1.0, 0.5, 0.0], [0, 0, 1.0, 0.3], [0, 0, 0, 1]])
    return np.asarray(1.0 + 0.05 * generator.standard_normal((count, 4)) @ mixing)


def bounded(trips: FloatArray, chosen: FloatArray) -> FloatArray:
    """Share of the trips that the worst of the chosen bounds, in each direction."""
    worst = (chosen @ DIRECTIONS.T).max(axis=0)
    return np.asarray(np.mean(trips @ DIRECTIONS.T <= worst, axis=0))


def test_the_worst_case_of_few_bounds_the_stated_share_of_trips_not_yet_seen():
    shares = []
    for seed in range(5):
        trips, others = features(300, seed), features(2000, 100 + seed)
        chosen = choose(trips, 0.95)
        assert chosen.level >= 0.95
        assert chosen.rows.size < 60
        shares.append(bounded(others, trips[chosen.rows]))
        assert chosen.weights.sum() == 300
        assert chosen.weights.min() >= 1
    assert np.mean(shares) > 0.97
    # A single direction of a single draw may fall short; on average none does.
    assert np.mean(shares, axis=0).min() > 0.94


@pytest.mark.parametrize("most", [1, 3, 8])
def test_so_many_at_most_and_the_level_says_what_they_reach(most):
    trips, others = features(300, 2), features(3000, 3)
    chosen = choose(trips, 0.95, most)
    assert 1 <= chosen.rows.size <= most
    assert chosen.level < 0.95
    assert bounded(others, trips[chosen.rows]).min() > chosen.level - 0.06


def test_the_set_differs_as_much_as_the_trips_do():
    """Best estimates are drawn to the mean; the set is spread out again."""
    estimated, spread, true_spread = [], [], []
    for seed in range(8):
        fits, true = drawn(18, 0.07, (900.0, 300.0, 900.0), seed)
        found = parameter_set(fits)
        assert len(found.configurations) == 18
        speed = 35.0
        spread.append(np.std([c.resistance(speed) for c in found.configurations]))
        basis = np.array([1.0, speed, speed**2])
        estimated.append(np.std(combine(fits).betas @ basis))
        true_spread.append(np.std(true @ basis))
    assert np.mean(estimated) < 0.9 * np.mean(true_spread)
    assert np.mean(spread) == pytest.approx(np.mean(true_spread), rel=0.2)


def test_the_set_says_where_each_configuration_comes_from():
    summaries = rows(60, seed=7)
    digests = dict(zip(summaries["trip"], summaries["sha256"], strict=True))
    found = parameter_set(summaries)
    assert len(found.configurations) < 60
    assert found.cover["trips"] == 60
    assert found.cover["level"] >= found.cover["asked"] == 0.95
    assert sum(detail["stands_for"] for detail in found.details) == 60
    assert found.weights == tuple(detail["stands_for"] for detail in found.details)
    for configuration, detail in zip(found.configurations, found.details, strict=True):
        assert detail["configuration"] == detail["trip"] == configuration.name
        assert detail["sha256"] == digests[configuration.name]
        assert detail["std"]["r2"] > 0.0
        assert np.shape(detail["fitted_correlation"]) == (4, 4)
    data = thing_to_bytes(found)
    assert thing_from_bytes(ParameterSet, data).cover == found.cover
    assert thing_to_bytes(parameter_set(summaries.iloc[::-1])) == data
    older = json.loads(data)
    del older["cover"]
    assert thing_from_bytes(ParameterSet, json.dumps(older).encode()).cover == {}


def test_trips_of_one_name_become_configurations_of_two_names():
    both = pd.concat([rows(4, seed=18), rows(4, seed=28)])
    names = [each.name for each in parameter_set(both).configurations]
    assert len(set(names)) == 8
    assert "trip-000 18000000" in names


def test_a_summary_says_what_the_fit_says():
    fits, _ = drawn(3, 0.05, (150.0, 60.0, 100.0), seed=1)
    found = summarised(fits)
    assert list(found) == [column.name for column in COLUMNS]
    np.testing.assert_array_equal(parameters_of(found)[:, :3], [fit.beta for fit in fits])
    stated = ["noise_speed", "masked_braking", "windows", "outliers"]
    assert found.loc[0, stated].tolist() == [0.01, 10.0, 94, 0]
    assert found.loc[0, "speed_scale_source"] == fits[0].scale.source
    assert found.loc[0, ["asked_lowest", "asked_highest"]].tolist() == [5.0, 35.0]
    assert found.loc[0, ["speed_lowest", "speed_highest"]].tolist() == [3.0, 34.0]
    assert found["max_power"].isna().all()
    # The upper triangle is kept; below it a covariance may differ by a last bit.
    whole = [fit.covariance for fit in fits]
    np.testing.assert_allclose(covariances_of(found), whole, rtol=1e-15)
    one, other = combine(fits), combine(found)
    assert one.resistance == other.resistance
    np.testing.assert_array_equal(one.covariances, other.covariances)


@settings(max_examples=12)
@given(order=st.permutations(range(6)), cut=st.integers(1, 5))
def test_order_and_pieces_do_not_matter(order, cut):
    whole = rows()
    shuffled = whole.iloc[order]
    pieces = [shuffled.iloc[:cut], whole, shuffled.iloc[cut:]]
    pd.testing.assert_frame_equal(merged(pieces), whole, check_exact=True)
    fits, _ = drawn(6, 0.05, (150.0, 60.0, 100.0), seed=1)
    for one, other in (
        (combine(whole), combine(shuffled)),
        (combine(fits), combine([fits[k] for k in order])),
    ):
        assert one.resistance == other.resistance
        assert one.trips == other.trips
        np.testing.assert_array_equal(one.covariance, other.covariance)
        np.testing.assert_array_equal(one.betas, other.betas)


def test_summaries_survive_their_file_and_no_other_file_is_read(tmp_path):
    every, path = rows(300), tmp_path / "one.parquet"
    write_summaries(every, path)
    write_summaries(every.iloc[::-1], tmp_path / "other.parquet")
    pd.testing.assert_frame_equal(read_summaries(path), every, check_exact=True)
    data = bytearray(path.read_bytes())
    assert data == (tmp_path / "other.parquet").read_bytes()
    for place in range(2000, len(data) // 2, 400):
        data[place] ^= 0xFF
    path.write_bytes(bytes(data))
    refused(InputError, "damaged", read_summaries, path)
    path.write_bytes(b"PAR1 and nothing more")
    refused(InputError, "not a Parquet file", read_summaries, path)
    rows().to_parquet(path)
    refused(InputError, "not a trainlog/summaries file", read_summaries, path)
    refused(InputError, "does not exist", read_summaries, tmp_path / "missing.parquet")
    refused(InputError, "lacks column 'mass'", write_summaries, rows().drop(columns="mass"), path)
    other = rows().assign(weather="wet")
    refused(InputError, "unknown column 'weather'", write_summaries, other, path)


@pytest.mark.parametrize(
    ("column", "value"),
    [("r1", np.nan), ("mass", -1.0), ("covariance_r0_r0", 0.0), ("covariance_r0_r1", 1e9)],
)
def test_a_row_that_would_spoil_all_trips_is_refused(column, value, tmp_path):
    bad = rows()
    bad.loc[3, column] = value
    said = "'trip-003': numbers that no fit gives"
    refused(InputError, said, write_summaries, bad, tmp_path / "bad.parquet")
    for together in (combine, parameter_set, fleet_resistance):
        refused(InputError, said, together, bad)


def test_variance_between_trips_maximises_the_restricted_likelihood():
    """Nothing near the answer is likelier, prior included."""
    generator = np.random.default_rng(3)
    roots = 0.05 * generator.standard_normal((40, 3, 3))
    variances = roots @ roots.transpose(0, 2, 1) + 1e-4 * np.eye(3)
    noise = np.einsum(
        "kij,kj->ki", np.linalg.cholesky(variances), generator.standard_normal((40, 3))
    )
    values = 1.0 + 0.07 * generator.standard_normal((40, 3)) + noise
    expected, trust = 0.0025 * np.eye(3), 2.0

    def likelihood(between: FloatArray) -> float:
        total = variances + between
        weight = np.linalg.inv(total)
        information = weight.sum(axis=0)
        mean = np.linalg.solve(information, np.einsum("kij,kj->i", weight, values))
        away = values - mean
        fit = np.einsum("ki,kij,kj->", away, weight, away) + np.linalg.slogdet(information)[1]
        fit += np.linalg.slogdet(total)[1].sum()
        prior = np.linalg.slogdet(between)[1] + np.trace(np.linalg.solve(between, expected))
        return float(-0.5 * (fit + trust * prior))

    found = mixed_effects(values, variances, (), expected, trust, tail=np.inf, tolerance=1e-9)
    best = likelihood(found.within)
    for _ in range(200):
        change = 1e-4 * generator.standard_normal((3, 3))
        assert likelihood(found.within + change + change.T) <= best + 1e-9
