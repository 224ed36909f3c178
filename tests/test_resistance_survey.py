"""Errors of the surveyed line: what they bring into a fit, and into many trips that share them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from resistance_trips import LINE, recording, trip
from test_resistance_together import SPEED, TRUE, covariance_of, fit_of
from test_resistance_windows import NOISE, dense, drawn_errors, rough

from analysis.resistance import TripFit, combine, fit_trip, summarised
from analysis.resistance.noise import NoiseModel
from analysis.resistance.regression import fit_windows
from analysis.resistance.windows import build_windows
from trainlog.formats.railway import line_to_bytes
from trainlog.formats.summaries import read_summaries, surveys_of, write_summaries
from trainlog.railway import StepProfile, Survey
from trainlog.railway.resistance import basis
from trainlog.trip import LINE_ATTACHMENT


def test_what_the_survey_brings_in_is_what_its_errors_do() -> None:
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


@pytest.mark.parametrize(
    "noise",
    [
        pytest.param(NoiseModel(0.01, 5e-4, 8.0, 0.01), marks=pytest.mark.long),
        pytest.param(NoiseModel(0.03, 1e-4, 1.0, 0.01), marks=pytest.mark.long),
    ],
)
def test_a_covariance_scatters_as_its_degrees_of_freedom_say(noise: NoiseModel) -> None:
    """The logarithm of a variance known from n draws has the variance 2/n."""
    windows = rough(build_windows(recording(duration=1500.0)))
    sizes, freedom = [], []
    for seed in range(40):
        wrong = replace(windows, y=windows.y + drawn_errors(windows, noise, seed))
        fit = fit_windows(wrong, 130e3, 20e3)
        sizes.append(np.linalg.slogdet(fit.covariance / fit.cluster_factor)[1] / 4.0)
        freedom.append(fit.freedom)
    assert 0.6 < np.median(freedom) * np.var(sizes) / 2.0 < 1.6
    assert max(freedom) < 0.2 * windows.count


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


def test_errors_that_reach_over_several_elements_are_reported_by_the_lines_file() -> None:
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


def over_one_line(count: int, seed: int, gradients: tuple[str, ...]) -> list[TripFit]:
    """Trips that hardly differ, over a line whose errors are most of what is uncertain."""
    generator = np.random.default_rng(seed)
    own, survey = covariance_of((60.0, 30.0, 60.0)), covariance_of((150.0, 80.0, 150.0))
    full = np.zeros((4, 4))
    full[:3, :3] = survey
    errors = {
        name: np.linalg.cholesky(survey) @ generator.standard_normal(3)
        for name in sorted(set(gradients))
    }
    root = np.linalg.cholesky(own)
    fits = []
    for k in range(count):
        line = gradients[k % len(gradients)]
        beta = TRUE * (1.0 + 0.02 * generator.standard_normal(3)) + errors[line]
        beta = beta + root @ generator.standard_normal(3)
        fits.append(fit_of(f"trip-{k:03d}", beta, own + survey, gradients=line, survey=full))
    return fits


@pytest.mark.parametrize(
    "gradients", [pytest.param(("there",), marks=pytest.mark.long), ("there", "back")]
)
def test_the_common_band_covers_whatever_the_lines_errors_are(gradients: tuple[str, ...]) -> None:
    inside, without = [], []
    true = basis(SPEED) @ TRUE
    for seed in range(20):
        fits = over_one_line(20, seed, gradients)
        low, high = combine(fits).band(SPEED)
        inside.append(np.all((low < true) & (true < high)))
        if seed < 10:
            low, high = combine([replace(fit, gradients="") for fit in fits]).band(SPEED)
            without.append(np.all((low < true) & (true < high)))
    # Of twenty, of which 95 % hold, two may miss.
    assert np.mean(inside) >= 0.9
    assert np.mean(without) < 0.85


def test_the_mean_is_no_better_known_than_the_line() -> None:
    """A thousand trips in one direction leave the line's errors as they are."""
    fits = over_one_line(1000, 2, ("there",))
    survey = np.sqrt(np.einsum("ki,ij,kj->k", basis(SPEED), fits[0].survey[:3, :3], basis(SPEED)))
    std = combine(fits).std(SPEED)
    assert np.all((std > 0.95 * survey) & (std < 1.1 * survey))


def test_summaries_tell_what_trips_share(tmp_path: Path) -> None:
    fits = over_one_line(6, 3, ("there", "back"))
    rows = summarised(fits)
    write_summaries(rows, tmp_path / "rows.parquet")
    back = read_summaries(tmp_path / "rows.parquet")
    np.testing.assert_allclose(surveys_of(back), [f.survey[:3, :3] for f in fits], rtol=1e-12)
    np.testing.assert_array_equal(combine(back).covariance, combine(fits).covariance)
