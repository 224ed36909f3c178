"""The study of Amirhosseini et al. (2024) reaches what the paper published."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from test_study_tables import check, on_page, tables

from analysis.studies.amirhosseini_2024 import simulation as study
from analysis.studies.amirhosseini_2024.run import (
    claims_table,
    coefficients_table,
    effort_sway,
    eight_wagons_table,
    errors_table,
    settling,
    study_charts,
    trip_of,
)
from analysis.studies.amirhosseini_2024.simulation import SlidingModeController, Target
from analysis.studies.report import StudyReport, as_markdown
from trainlog.cli import terminal
from trainlog.errors import InputError
from trainlog.mcap import read_log, write_log

BY_NAME = {variant.name: variant for variant in study.VARIANTS}


class Runs(dict[str, study.Run]):
    """Runs of the variants by name, each made when it is asked for."""

    def __missing__(self, name: str) -> study.Run:
        self[name] = study.run(BY_NAME[name])
        return self[name]


@pytest.fixture(scope="module")
def runs() -> Runs:
    return Runs()


@pytest.fixture(scope="module")
def every_run(runs: Runs) -> dict[str, study.Run]:
    return {name: runs[name] for name in BY_NAME}


@pytest.fixture(scope="module")
def every_wagon_pulls() -> study.Run:
    return study.run(BY_NAME["scalar"], train=study.eight_wagons())


@pytest.fixture(scope="module")
def first_pulls() -> study.Run:
    return study.run(BY_NAME["scalar"], train=study.eight_wagons(first_pulls=True))


def test_the_profile_has_the_speed_the_distance_and_the_time_of_the_paper() -> None:
    time = np.linspace(0.0, 1_200.0, 120_001)
    speeds = np.array([study.target(now).speed for now in time])
    positions = np.array([study.target(now).position for now in time])
    assert speeds.max() == 83.0
    assert positions[-1] == 74_700.0
    travelled = np.sum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(time))
    assert travelled == pytest.approx(74_700.0, rel=1e-9)


def test_the_scalar_estimator_reaches_the_published_figures(runs: dict[str, study.Run]) -> None:
    position, speed, stop = runs["scalar"].figures
    assert 0.78 <= position <= 0.84
    assert 0.215 <= speed <= 0.23
    assert stop <= 0.005


@pytest.mark.long
def test_the_spatial_reset_stays_close_wherever_the_edges_fall(runs: dict[str, study.Run]) -> None:
    none, *others = study.edge_shifts(2)
    assert none == 0.0
    variant = BY_NAME["spatial reset"]
    shifted = [
        runs["spatial reset"],
        *(study.run(variant, track=study.line(float(s))) for s in others),
    ]
    position, speed, _ = study.worst(shifted)
    assert position <= 0.20
    assert speed <= 0.067


@pytest.mark.long
def test_what_the_paper_states_in_words_holds(runs: dict[str, study.Run]) -> None:
    scalar, spatial = runs["scalar"], runs["spatial reset"]
    assert 5.0 < settling(scalar) < 30.0
    off, steps = np.abs(scalar.estimate - scalar.resistance), np.diff(scalar.slope_force)
    assert abs(int(np.argmax(off)) - int(np.argmax(np.abs(steps)))) <= 1
    assert np.abs(np.diff(scalar.effort)).max() < np.abs(np.diff(spatial.effort)).max()
    assert effort_sway(scalar) > 1.5 * effort_sway(spatial)
    obstructed = study.run(BY_NAME["scalar"], track=study.line(curved_tunnel=True))
    assert obstructed.figures == pytest.approx(scalar.figures, rel=1e-3)
    ((title, rows),) = tables(as_markdown(claims_table(runs, obstructed))).items()
    check(title, on_page("rls-sliding-mode")[title], rows)


def test_additional_resistance_by_hand_and_by_the_product() -> None:
    """Eq. (6): a curve of 400 m weighs as 1.5 per mille, a tunnel of 3 km as 0.39."""
    assert study.additional_resistance(1e3, 0.01) == pytest.approx(98.1)
    assert study.additional_resistance(1e3, 0.0, radius=400.0) == pytest.approx(14.715)
    assert study.additional_resistance(1e3, 0.0, tunnel=3_000.0) == pytest.approx(3.8259)
    way = study.line(curved_tunnel=True).gradients
    assert way(31e3) - study.line().gradients(31e3) == pytest.approx(0.00189)
    assert way(34e3) == study.line().gradients(34e3)


@pytest.mark.long
def test_softening_couplers_pull_a_little_more(first_pulls: study.Run) -> None:
    """The worst case of eq. (4), epsilon below 0: the same draft at more stretch."""
    train = study.eight_wagons(first_pulls=True, softening=True)
    hard, soft = first_pulls, study.run(BY_NAME["scalar"], train=train)
    assert soft.coupler_forces.max() > hard.coupler_forces.max()
    assert soft.figures == pytest.approx(hard.figures, rel=1e-3)
    coupler = soft.train.couplers[0]
    assert coupler.nonlinearity == -200.0
    assert soft.coupler_forces.max() < float(coupler.force(0.9 / np.sqrt(600.0)))


@pytest.mark.long
def test_with_measured_speed_keeping_a1_and_a2_is_what_helps() -> None:
    full, part = (
        study.run(BY_NAME[name], noise=study.SPEED_NOISE)
        for name in ("spatial reset", "partial reset")
    )
    assert part.figures[0] < 0.3 * full.figures[0]


@pytest.mark.long
@pytest.mark.usefixtures("unpainted")
def test_eight_wagons_are_controlled_as_closely_as_one_particle(
    every_run: dict[str, study.Run],
    every_wagon_pulls: study.Run,
    first_pulls: study.Run,
    tmp_path: Path,
) -> None:
    """An edge that passes under 200 m of train is met more gently than one under a point."""
    runs, every, first = every_run, every_wagon_pulls, first_pulls
    for run in (every, first):
        position, speed, stop = run.figures
        assert position < runs["scalar"].figures[0]
        # The first wagon also swings in its coupler.
        assert speed < 1.01 * runs["scalar"].figures[1]
        assert stop <= 0.01
    # Where each wagon pulls itself, the couplers carry only what the edges make.
    assert np.abs(every.coupler_forces).max() < 40e3 < first.coupler_forces.max()
    # A first wagon that pulls 43.75 of 350 t itself passes on seven eighths of its effort.
    calm = (first.time > 60.0) & (first.time < 100.0)
    passed_on = first.coupler_forces[calm, 0] / first.effort[calm]
    assert passed_on == pytest.approx(7.0 / 8.0, abs=0.01)
    log = trip_of(first, seed=1)
    assert log["/train/couplers"].shape[1] == 7
    made = as_markdown(eight_wagons_table(runs, [every, first]))
    ((title, rows),) = tables(made).items()
    check(title, on_page("rls-sliding-mode")[title][: len(rows)], rows)
    pictures = study_charts(runs)
    StudyReport(tmp_path, terminal.console).draw(pictures)
    assert all((tmp_path / name).exists() for name in pictures)


@pytest.mark.long
def test_the_page_has_the_errors_that_the_estimators_reach(
    every_run: dict[str, study.Run],
) -> None:
    runs = every_run
    shifted = {name: [run] for name, run in runs.items()}
    ((title, rows),) = tables(as_markdown(errors_table(runs, runs, shifted))).items()
    listed = on_page("rls-sliding-mode")[title]
    check(title, [row[:3] for row in listed], [row[:3] for row in rows])
    ((title, rows),) = tables(as_markdown(coefficients_table(runs, runs))).items()
    exact = [
        [row for row in each if row[1] == "exact"]
        for each in (on_page("rls-sliding-mode")[title], rows)
    ]
    assert len(exact[0]) == 3
    check(title, *exact)


def test_the_slope_acts_from_the_front_to_the_rear(every_wagon_pulls: study.Run) -> None:
    run = every_wagon_pulls
    halfway = int(np.argmin(np.abs(run.position - 42_100.0)))
    share = (run.position[halfway] - 42_000.0) / 200.0
    expected = study.MASS * 9.81 * (share * 0.020 - (1.0 - share) * 0.007)
    assert run.slope_force[halfway] == pytest.approx(expected, rel=2e-3)


def test_a_run_becomes_a_log(runs: dict[str, study.Run], tmp_path: Path) -> None:
    run = runs["spatial reset"]
    trip = trip_of(run, seed=1)
    write_log(trip, tmp_path / "run.mcap")
    again = read_log(tmp_path / "run.mcap")
    np.testing.assert_array_equal(again["/truth"]["position"], run.position)
    np.testing.assert_array_equal(again["/estimates/running_resistance"]["r1"], run.theta[:, 1])
    work = np.sum(
        again["/train/controls"]["tractive_effort"].to_numpy()[:-1] * np.diff(run.position)
    )
    assert work > 1e9
    assert again.provenance[-1]["variant"] == "spatial reset"


def test_on_the_sliding_surface_the_error_decays_as_designed() -> None:
    """With exact knowledge s stays 0, and a position error decays with lambda."""
    controller = SlidingModeController(100e3, switching_effort=0.0)
    position, speed = 10.0, 20.0 - 0.5 * 10.0  # s = 0: the speed error is -lambda times the error
    step = 1e-3
    for k in range(4_000):
        goal = Target(20.0 * k * step, 20.0, 0.0)
        effort = controller.effort(position, speed, goal, resistance=5e3)
        speed += step * (effort - 5e3) / 100e3
        position += step * speed
    assert position - 20.0 * 4.0 == pytest.approx(10.0 * np.exp(-2.0), rel=2e-3)


@pytest.mark.parametrize(
    ("field", "value"),
    [("mass", 0.0), ("convergence", -1.0), ("boundary_layer", 0.0), ("switching_effort", -1.0)],
)
def test_a_controller_that_cannot_be_is_refused(field: str, value: float) -> None:
    refused(InputError, field, SlidingModeController, **{"mass": 1e5} | {field: value})


def test_switching_draws_back_to_the_surface_within_the_effort_limit() -> None:
    controller = SlidingModeController(100e3)
    goal = Target(0.0, 0.0, 0.0)
    assert controller.effort(100.0, 10.0, goal, 0.0) == -250e3
    assert controller.effort(-100.0, -10.0, goal, 0.0) == 250e3
    within = controller.effort(2.0, 0.0, goal, 0.0)
    assert within == pytest.approx(-180e3 * 0.5 * 2.0 / 5.0)
