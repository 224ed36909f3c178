"""The study of Zhao et al. (2025) reaches what was published, and what its case gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from test_study_tables import check, on_page, tables

from analysis.control import cooperative
from analysis.control.cooperative import CooperativeController, Tuning, adhesion_at, within
from analysis.control.traction import MAXIMA, RailEstimator
from analysis.studies import zhao_2025 as study
from analysis.studies.report import as_markdown
from analysis.studies.zhao_2025 import (
    coefficients,
    demand_on,
    published_table,
    runge_kutta,
    start_table,
    torque_table,
    trip_of,
)
from trainlog.errors import InputError
from trainlog.railway.adhesion import DRY, WET

LOCOMOTIVE = study.PUBLISHED_LOCOMOTIVE


@pytest.fixture(scope="module")
def runs() -> list[list[study.Run]]:
    """As printed, integrated exactly, and with sensible weights: each of all cases."""
    ways = ({"integration": "euler"}, {}, {"preset": study.SENSIBLE})
    return [[study.run(case, **way) for case in study.CASES] for way in ways]


def test_energy_of_the_motors_is_that_of_train_wheels_creep_and_resistance(runs):
    """What the motors put in must be found again; the slip alone could hide a wrong model."""
    for run in (runs[1][2], runs[2][2]):
        locomotive = run.preset.locomotive
        effort = locomotive.effort_per_torque * run.torque[:-1]
        steps = np.diff(run.time)[:, None]
        wheels = 0.5 * (run.wheel_speed[1:] + run.wheel_speed[:-1])
        put_in = float(np.sum(effort * wheels * steps))
        drag = locomotive.resistance(run.speed) * run.speed
        lost = float(np.sum(0.5 * (drag[1:] + drag[:-1]) * steps[:, 0])) + run.slip_work
        kinetic = 0.5 * locomotive.mass * run.speed[-1] ** 2
        turning = 0.5 * locomotive.rotating_mass * float(np.sum(run.wheel_speed[-1] ** 2))
        assert put_in == pytest.approx(kinetic + turning + lost, rel=2e-3)


@pytest.mark.parametrize(("lag", "direction"), [(0.0, 1.0), (0.1, 1.0), (0.1, -1.0)])
def test_sensitivities_are_those_of_finite_differences(lag, direction):
    rng = np.random.default_rng(1)
    for preset in study.PRESETS:
        locomotive, tuning = preset.locomotive, preset.tuning
        how = cooperative.Prediction(0.1, tuning.substeps, lag, direction, float(tuning.exact))
        state = np.concatenate([[20.0], 20.0 + direction * rng.uniform(-0.5, 3.0, 4)])
        begun = 0.3 * np.full(4, locomotive.torque_limit)
        plan = rng.uniform(0.2, 0.8, (5, 4)) * locomotive.torque_limit
        rail = np.tile(coefficients([DRY, WET, DRY, WET]), (10, 1, 1))
        given = rail, locomotive.loads, locomotive.constants, how

        def slip(plan: np.ndarray, *, known=(state, begun, given)) -> np.ndarray:
            state, begun, given = known
            return cooperative.predicted(state, begun, plan, *given, False)[0]

        change = cooperative.predicted(state, begun, plan, *given, True)[1]
        for column in (0, 6, 13, 19):
            moved = np.zeros(20)
            moved[column] = 1.0
            by = moved.reshape(5, 4)
            found = 0.5 * (slip(plan + by) - slip(plan - by))
            np.testing.assert_allclose(change[:, column], found, atol=1e-7, rtol=1e-4)


@pytest.mark.parametrize("peak_slip", [1.2, 0.22, 0.1])
def test_the_prediction_is_the_motion_also_on_steep_creep_curves(peak_slip):
    """Against Runge-Kutta with steps of 0.1 ms, below and around the peak, in both directions."""
    locomotive = study.LOCOMOTIVE_85_T
    curve = steep(peak_slip, 0.25)
    rail = np.tile(curve, (10, 4, 1))
    state = np.array([15.0, 15.0, 15.0 + 0.5 * peak_slip, 15.0, 15.0 + peak_slip])
    bearing = 0.25 * locomotive.loads / locomotive.effort_per_torque
    plan = np.outer([0.5, 0.9, 0.9, 0.8, 0.8], bearing)
    how = cooperative.Prediction(0.1, 4, 0.0, 1.0, 1.0)
    slip, _ = cooperative.predicted(
        state, np.zeros(4), plan, rail, locomotive.loads, locomotive.constants, how, False
    )
    for k in range(10):
        runge_kutta(
            state, plan[min(k, 4)], rail[k], locomotive.loads, locomotive.constants, 1e-4, 1000
        )
        expected = state[1:] - state[0]
        np.testing.assert_allclose(slip[4 * k : 4 * k + 4], expected, atol=0.03 * peak_slip)


@pytest.mark.parametrize(("peak_slip", "axles"), [(0.22, 4), (0.1, 12)])
def test_steep_creep_curves_are_driven_at_their_peak(peak_slip, axles):
    """Dry, then wet, then half of the axles wet: the adhesion in use is what the rail gives."""
    four = study.LOCOMOTIVE_85_T
    locomotive = replace(
        four,
        mass=four.mass / 4 * axles,
        axle_loads=four.axle_loads[:1] * axles,
        total_torque=four.total_torque / 4 * axles,
    )
    controller = CooperativeController(locomotive, Tuning())
    dry, wet = (np.tile(steep(peak_slip, each.peak), (axles, 1)) for each in (DRY, WET))
    half = np.where(np.arange(axles)[:, None] < axles // 2, dry, wet)
    state, used = np.zeros(1 + axles), []
    for rail, maximum in ((dry, 0.2711), (wet, WET.peak), (half, 0.5 * (DRY.peak + WET.peak))):
        for k in range(25):
            demand = demand_on(controller, rail)
            torques = controller.torques(float(state[0]), state[1:], demand)
            steps = round(0.1 / (0.005 * peak_slip))
            runge_kutta(
                state, torques, rail, locomotive.loads, locomotive.constants, 0.1 / steps, steps
            )
            if k > 15:
                used.append(adhesion_at(state[1:] - state[0], rail).mean() / maximum)
    assert controller.unsolved == 0
    assert controller.steps == 75
    np.testing.assert_allclose(used, 1.0, atol=0.01)


def test_programs_that_no_solver_solves_are_counted_and_the_train_is_still_driven(monkeypatch):
    """The plan that only brings each axle to its slip speed drives, and keeps the limits."""
    monkeypatch.setattr(cooperative, "solve", lambda program: (np.full(20, np.nan), -1))
    locomotive, rail, state = study.LOCOMOTIVE_85_T, coefficients([DRY] * 4), np.zeros(5)
    controller = CooperativeController(locomotive, Tuning())
    for _ in range(50):
        torques = controller.torques(float(state[0]), state[1:], demand_on(controller, rail))
        runge_kutta(state, torques, rail, locomotive.loads, locomotive.constants, 0.002, 50)
    assert controller.unsolved == controller.steps == 50
    assert torques.sum() == pytest.approx(28_000.0, rel=0.02)
    assert state[0] > 1.8


def test_wheels_race_without_slip_control():
    run = study.run(study.CASES[0], strategy="no slip control")
    assert run.slip.max() > 20.0


def steep(peak_slip: float, maximum: float) -> np.ndarray:
    """A creep curve with its maximum at a slip speed [m/s]."""
    a = np.log(4.0) / 3.0 / peak_slip
    return np.array([a, 4.0 * a, maximum / (np.exp(-a * peak_slip) - np.exp(-4.0 * a * peak_slip))])


@settings(max_examples=40)
@given(
    st.lists(st.floats(-1e4, 1e4), min_size=20, max_size=20),
    st.lists(st.floats(0.0, 5e3), min_size=4, max_size=4),
    st.floats(0.0, 2e4),
)
def test_torques_are_brought_within_any_limits(plan, limits, total):
    controller = CooperativeController(LOCOMOTIVE)
    demand = demand_on(controller, coefficients([DRY] * 4), limits, total)
    found = within(np.array(plan).reshape(5, 4), demand)
    assert np.all((found >= 0.0) & (found <= demand.limits))
    # Next to the smallest numbers there are, nothing is left to round to.
    smallest = np.finfo(np.float64).tiny
    assert np.all(found.sum(axis=1) <= total * (1.0 + 1e-12) + smallest)


def test_the_page_has_what_the_cases_reach(runs):
    every = [run for way in runs for run in way]
    assumed = study.run(study.CASES[0], integration="euler", first=study.FIRST_TORQUE)
    made = (published_table(), start_table(every[0], assumed), torque_table(every))
    listed, found = on_page("cooperative-adhesion"), tables("\n".join(map(as_markdown, made)))
    assert len(found) == 3
    for title, rows in found.items():
        check(title, listed[title], rows)
    assert trip_of(every[2]).metadata["traction_decisions"] == "300"


def test_the_rail_is_learnt_from_slip_and_adhesion_in_use():
    """A wheel at the peaks of a dry, then of a wet rail; speeds with noise."""
    locomotive, tuning = study.LOCOMOTIVE_85_T, study.SENSIBLE.tuning
    estimator = RailEstimator(locomotive, tuning, 0.05, 0.02)
    rng = np.random.default_rng(1)
    state = np.concatenate([[10.0], np.full(4, 10.0)])
    torques = np.full(4, 6_500.0)
    found = {}
    for k in range(100):
        curve = DRY if k < 50 else WET
        rail = coefficients([curve] * 4)
        wanted = curve.peak_slip - (state[1:] - state[0])
        torques = np.clip(7_200.0 * curve.peak / DRY.peak + 2_000.0 * wanted, 0.0, 8_500.0)
        runge_kutta(state, torques, rail, locomotive.loads, locomotive.constants, 0.002, 50)
        seen = state + np.array([0.05, 0.02, 0.02, 0.02, 0.02]) * rng.standard_normal(5)
        found[k] = estimator.update(float(seen[0]), seen[1:], torques)
    dry, wet = found[49], found[99]
    assert dry.maximum == pytest.approx(DRY.peak, rel=0.15)
    # At one slip speed a steeper rail beyond its peak looks like this one at it: both are possible.
    summed = np.cumsum(estimator._probability.sum(axis=2), axis=1)
    low, high = (MAXIMA[np.argmax(summed >= level, axis=1)] for level in (0.16, 0.84))
    assert np.all((low <= WET.peak) & (wet.maximum <= high) & (WET.peak <= high))


def test_bad_speeds_are_refused():
    controller = CooperativeController(LOCOMOTIVE)
    dry = coefficients([DRY] * 4)
    demand = demand_on(controller, dry)
    refused(InputError, "wheel speeds", controller.torques, 1.0, [1.0, 1.0], demand)
    refused(InputError, "not all numbers", controller.torques, 1.0, [1.0, 1.0, np.nan, 1.0], demand)
    refused(InputError, "unknown", study.run, study.CASES[0], strategy="best")
