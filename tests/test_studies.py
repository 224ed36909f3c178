"""The studies of papers: their equations and laws, what they reach, and their tables on the page.

A number on the page may differ from the printed one by two units of its last digit, or by 0.005
per cent. Numbers with an exponent are residuals of a solver: they may differ by a factor of three,
or by 1e-5. ``--renew-golden`` puts the tables that were found into the page.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused

from analysis.control import cooperative
from analysis.control.cooperative import CooperativeController, Tuning, adhesion_at, within
from analysis.control.traction import MAXIMA, RailEstimator
from analysis.studies import (
    amirhosseini_2024 as amirhosseini,
    cunillera_2022 as cunillera,
    in_train_forces,
    zhao_2025 as zhao,
)
from analysis.studies.amirhosseini_2024 import SlidingModeController, Target
from analysis.studies.hauck_2023 import run as hauck, simulation as driving
from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN
from analysis.studies.hauck_2023.run import Day
from analysis.studies.report import as_markdown
from analysis.studies.zhao_2025 import coefficients, demand_on, runge_kutta
from analysis.trajectory.discretisation import discretise
from analysis.trajectory.instructions import Phase
from trainlog import InputError, StepProfile, Trajectory, read_consist, sample
from trainlog.cli.main import run as command
from trainlog.mcap import read_log, write_log
from trainlog.railway.adhesion import DRY, WET
from trainlog.units import KMH

PAGE = Path(__file__).parents[1] / "docs" / "studies.md"
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
TABLE = re.compile(r"\*\*([^\n]+)\*\*\n\n((?:\|[^\n]*\n)+)")

STUDIES = (
    *("rls-sliding-mode", "robust-minimax", "cooperative-adhesion"),
    *("map-mpc", "map-mpc --as-published"),
)

Rows = list[list[str]]


def tables(text: str) -> dict[str, Rows]:
    """Cells of the tables, by title."""
    return {
        title: [[cell.strip() for cell in line.strip("|").split("|")] for line in body.splitlines()]
        for title, body in TABLE.findall(text)
    }


def section(name: str) -> re.Pattern[str]:
    """The part of the page that holds the tables of a command."""
    return re.compile(rf"(<!-- tables of {re.escape(name)} -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def close(one: str, other: str) -> bool:
    """Whether two printed numbers are the same to the tolerance."""
    a, b = float(one), float(other)
    if "e" in one + other:
        return abs(a - b) <= max(2.0 * min(abs(a), abs(b)), 1e-5)
    digits = min(len(each.partition(".")[2]) for each in (one, other))
    return abs(a - b) <= max(2.01 * 10.0**-digits, 5e-5 * abs(a))


def same(one: str, other: str) -> bool:
    """Whether two cells have the same words, and the same numbers to the tolerance."""
    if NUMBER.sub("#", one) != NUMBER.sub("#", other):
        return False
    return all(map(close, NUMBER.findall(one), NUMBER.findall(other)))


def chosen(title: str, listed: Rows, printed: Rows) -> Rows:
    """The printed rows that the page lists: of the same words, in the same order."""
    rest, found = iter(printed), []
    for row in listed:
        words = [NUMBER.sub("#", cell) for cell in row]
        for other in rest:
            if other[0] == row[0] and [NUMBER.sub("#", cell) for cell in other] == words:
                found.append(other)
                break
        else:
            raise AssertionError(f"{title}: no row like {row} is printed")
    return found


def renewed(page: str, name: str, found: str) -> str:
    """The page with the tables that were found: the rows that it listed, or all."""
    part = section(name).search(page)
    listed = tables(part[2])
    kept = []
    for match in TABLE.finditer(found):
        title = match[1].strip()
        if not listed:
            kept.append(match[0])
        elif title in listed:
            rows = chosen(title, listed[title], tables(match[0])[title])
            lines = ["| " + " | ".join(row) + " |" for row in rows]
            lines[1] = match[2].splitlines()[1]
            kept.append(f"**{title}**\n\n" + "\n".join(lines) + "\n")
    return page[: part.start(2)] + "\n" + "\n".join(kept) + "\n" + page[part.end(2) :]


def on_page(name: str) -> dict[str, Rows]:
    """The tables of a command that the page lists, by title."""
    part = section(name).search(PAGE.read_text(encoding="utf-8"))
    return tables(part[2])


def check(title: str, rows: Rows, now: Rows) -> None:
    """That the page's rows are among those that a study reaches now."""
    for row, other in zip(rows, chosen(title, rows, now), strict=True):
        assert len(row) == len(other), title
        for cell, reached in zip(row, other, strict=True):
            assert same(cell, reached), f"{title}: {row[0]}: {cell} on the page, {reached} now"


@pytest.mark.long
@pytest.mark.usefixtures("unpainted")
@pytest.mark.parametrize("name", STUDIES)
def test_the_page_has_the_tables_that_the_study_prints(name, tmp_path, request):
    """``--renew-golden`` puts them there."""
    assert command(["study", *name.split(), "-o", str(tmp_path)]) == 0
    found = (tmp_path / "tables.md").read_text(encoding="utf-8")
    if request.config.getoption("--renew-golden"):
        page = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(renewed(page, name, found), encoding="utf-8")
        return
    printed, listed = tables(found), on_page(name)
    assert listed
    assert listed.keys() <= printed.keys()
    for title, rows in listed.items():
        check(title, rows, printed[title])


def test_the_page_has_the_forces_of_a_sample_consist():
    consist, speed = read_consist(sample("multiple_unit_8_cars.consist.json")), 120.0
    found = in_train_forces.run(consist, in_train_forces.crest_and_sag(), speed=speed / KMH)
    emergency = found.forces[found.phase("emergency braking")]
    forces = (found.forces.max(), -found.forces.min(), max(-emergency.min(), 0.0))
    row = f"{speed:.0f} km/h | " + " | ".join(f"{force / 1e3:.0f} kN" for force in forces)
    assert row in PAGE.read_text(encoding="utf-8")
    assert found.residual < 1e-11


# Zhao et al. (2025): cooperative adhesion control.

LOCOMOTIVE = zhao.PUBLISHED_LOCOMOTIVE


@pytest.fixture(scope="module")
def runs() -> list[list[zhao.Run]]:
    """As printed, integrated exactly, and with sensible weights: each of all cases."""
    ways = ({"integration": "euler"}, {}, {"preset": zhao.SENSIBLE})
    return [[zhao.run(case, **way) for case in zhao.CASES] for way in ways]


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
    for preset in zhao.PRESETS:
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
    locomotive = zhao.LOCOMOTIVE_85_T
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
    four = zhao.LOCOMOTIVE_85_T
    mass, torque = (each / 4 * axles for each in (four.mass, four.total_torque))
    loads = four.axle_loads[:1] * axles
    locomotive = replace(four, mass=mass, axle_loads=loads, total_torque=torque)
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
    locomotive, rail, state = zhao.LOCOMOTIVE_85_T, coefficients([DRY] * 4), np.zeros(5)
    controller = CooperativeController(locomotive, Tuning())
    for _ in range(50):
        torques = controller.torques(float(state[0]), state[1:], demand_on(controller, rail))
        runge_kutta(state, torques, rail, locomotive.loads, locomotive.constants, 0.002, 50)
    assert controller.unsolved == controller.steps == 50
    assert torques.sum() == pytest.approx(28_000.0, rel=0.02)
    assert state[0] > 1.8


def test_wheels_race_without_slip_control():
    run = zhao.run(zhao.CASES[0], strategy="no slip control")
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
    assumed = zhao.run(zhao.CASES[0], integration="euler", first=zhao.FIRST_TORQUE)
    made = (zhao.published_table(), zhao.start_table(every[0], assumed), zhao.torque_table(every))
    listed, found = on_page("cooperative-adhesion"), tables("\n".join(map(as_markdown, made)))
    assert len(found) == 3
    for title, rows in found.items():
        check(title, listed[title], rows)
    assert zhao.trip_of(every[2]).metadata["traction_decisions"] == "300"


def test_the_rail_is_learnt_from_slip_and_adhesion_in_use():
    """A wheel at the peaks of a dry, then of a wet rail; speeds with noise."""
    locomotive, tuning = zhao.LOCOMOTIVE_85_T, zhao.SENSIBLE.tuning
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
    refused(InputError, "unknown", zhao.run, zhao.CASES[0], strategy="best")


# Hauck et al. (2023), on its first section; its tables are of the whole line.

MASS = PUBLISHED_TRAIN.light
"""The heavier ones, and the other scenarios, are driven where the tables of the study are made."""
SLIPPERY = StepProfile(np.array([0.0, 60.0, 200.0, 2_700.0]), np.array([0.07, 0.05, 0.09, 0.045]))


@pytest.fixture(scope="module", autouse=True)
def fewer_nodes() -> Iterator[None]:
    """References of half the nodes, which are solved sooner."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.studies.hauck_2023.reference.NODE_SPACING", 6.0)
        yield


@pytest.fixture(scope="module")
def known(fewer_nodes: None) -> hauck.Setup:
    prepared = hauck.prepared(seed=1, sections=1)
    return replace(prepared, rails={**prepared.rails, "bad": SLIPPERY})


@pytest.fixture(scope="module")
def outcomes(known: hauck.Setup) -> dict[str, hauck.Outcome]:
    return {each.name: hauck.outcome(known, each, MASS) for each in hauck.SCENARIOS[:2]}


@pytest.fixture(scope="module")
def days(known: hauck.Setup, tmp_path_factory: pytest.TempPathFactory) -> list[Day]:
    folder = tmp_path_factory.mktemp("days")
    each = hauck.day_by_day(known.plan, [SLIPPERY, SLIPPERY], [70e3, 85e3], folder, seed=1)
    first = next(each)
    # It is yielded while the second is still to be driven.
    assert [day.number for day in first] == [1]
    assert sorted(folder.iterdir()) == sorted(first[0].logs)
    (both,) = each
    assert both[0] is first[0]
    return both


def test_constraints_and_stops_are_kept_and_only_without_the_map_axles_skid(outcomes):
    for each in outcomes.values():
        found = each.informed
        assert found.worst.max() <= 1e-6
        assert found.unsolved == found.slip_events == found.protections == 0
        assert np.abs(found.stop_error).max() < 0.3
    blind = outcomes["weather turns bad"].blind
    assert blind.slip_events > 0
    assert blind.skid_energy > 0.0
    assert blind.worst[1] > 0.0


def test_the_second_day_beats_the_first_in_slip_and_is_punctual(days):
    first, second = days
    assert first.slip_events > 0
    assert second.slip_events == 0
    assert second.skid_energy == 0.0
    assert second.slip_energy < first.slip_energy
    assert second.late.min() > -1.5
    assert second.late.max() < 0.5
    assert len(second.track.trips) == 2


def test_a_section_that_the_rail_forbids_in_its_time_is_late_by_the_least(known, monkeypatch):
    """Its arrival is put off before it is solved; the second day solves such a section."""
    monkeypatch.setattr(hauck, "reference", lambda made: replace(known.plan[0], section=made))
    icy = StepProfile(np.zeros(1), np.array([0.04]))
    asked = known.plan[0].section.destination.arrival
    arrival = hauck.replanned(known.plan, icy)[0].section.destination.arrival
    assert arrival > asked + 5.0
    bound = hauck.least_lateness([driving.with_map(known.plan, icy)[0].section], MASS, 0.0)[0]
    assert arrival - asked > bound


def test_a_run_is_logged_with_its_levers_reference_and_truth(outcomes, tmp_path):
    found = outcomes["good track"].informed
    write_log(driving.trip_of(found, "dry", 1), tmp_path / "trip.mcap")
    again = read_log(tmp_path / "trip.mcap")
    assert np.array_equal(again["/train/controls"]["lever"], np.round(found.lever, 4))
    np.testing.assert_array_equal(again["/truth"]["position"], found.position)
    assert np.abs(again["/reference"]["lateness"]).max() < 5.0
    assert again.metadata["weather"] == "dry"
    write_log(driving.trip_of(found, "dry", 1), tmp_path / "twice.mcap")
    assert (tmp_path / "twice.mcap").read_bytes() == (tmp_path / "trip.mcap").read_bytes()


def test_as_published_a_late_train_takes_the_bounds_of_where_it_ought_to_be(known):
    """On time the published controller keeps eq. (7) but for a guard's share; late it does not."""
    on_time, _, late, _ = hauck.SCENARIOS
    good = hauck.outcome(known, on_time, 78_200.0, published=True)
    assert good.blind is None
    assert np.abs(good.informed.position_error).max() <= 5.0
    assert np.abs(good.informed.speed_error).max() < 3.0
    assert good.informed.worst.max() < 0.05
    other = hauck.outcome(known, late, 78_200.0, published=True)
    found = other.informed
    assert found.worst[0] > 0.5
    assert found.late[0] < 1.0
    table = hauck.difference_table([good, other])
    assert table.heads[-1] == "78.2 t"


# Amirhosseini et al. (2024): recursive least squares with sliding-mode control.


def test_the_scalar_estimator_reaches_the_published_figures():
    run = amirhosseini.run(next(each for each in amirhosseini.VARIANTS if each.name == "scalar"))
    position, speed, stop = run.figures
    assert 0.78 <= position <= 0.84
    assert 0.215 <= speed <= 0.23
    assert stop <= 0.005
    assert amirhosseini.trip_of(run, seed=1).provenance[-1]["variant"] == "scalar"


def test_additional_resistance_by_hand_and_by_the_product():
    """Eq. (6): a curve of 400 m weighs as 1.5 per mille, a tunnel of 3 km as 0.39."""
    assert amirhosseini.additional_resistance(1e3, 0.01) == pytest.approx(98.1)
    assert amirhosseini.additional_resistance(1e3, 0.0, radius=400.0) == pytest.approx(14.715)
    assert amirhosseini.additional_resistance(1e3, 0.0, tunnel=3_000.0) == pytest.approx(3.8259)
    way = amirhosseini.line(curved_tunnel=True).gradients
    assert way(31e3) - amirhosseini.line().gradients(31e3) == pytest.approx(0.00189)
    assert way(34e3) == amirhosseini.line().gradients(34e3)


def test_on_the_sliding_surface_the_error_decays_as_designed():
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


def test_switching_draws_back_to_the_surface_within_the_effort_limit():
    controller = SlidingModeController(100e3)
    goal = Target(0.0, 0.0, 0.0)
    assert controller.effort(100.0, 10.0, goal, 0.0) == -250e3
    assert controller.effort(-100.0, -10.0, goal, 0.0) == 250e3
    within = controller.effort(2.0, 0.0, goal, 0.0)
    assert within == pytest.approx(-180e3 * 0.5 * 2.0 / 5.0)


# Cunillera et al. (2022): robust minimax trajectories.

CELLS = 160
"""A third of the study's, which the long tests have."""
LEVEL, DOWNHILL, CHOSEN = cunillera.level(), cunillera.downhill(), cunillera.configurations()


@cache
def answer(name: str) -> Trajectory:
    """The trajectory of one of the study's questions."""
    return cunillera.solved(*cunillera.questions(LEVEL, DOWNHILL, CHOSEN)[name], cells=CELLS)


def per_mass(found: Trajectory) -> float:
    return float(found.certificate["energy"]) / CHOSEN[0].inertia


def test_energy_is_the_same_for_all_and_every_constraint_holds_as_printed():
    """Eqs. (2) to (4) integrated in v and t, where the optimiser has v²/2 alone."""
    found = answer("level-common")
    driven = cunillera.driven(LEVEL, found, CHOSEN)
    assert np.ptp(driven.energy) == 0.0
    assert driven.energy[0] == pytest.approx(per_mass(found), rel=1e-9)
    assert driven.speeds == pytest.approx(found.speeds, abs=1e-6)
    assert driven.times == pytest.approx(found.times, abs=1e-3)
    problem = discretise(LEVEL.run(CHOSEN, "common"), found.positions)
    assert max(cunillera.as_printed(problem, found, driven).values()) <= 1e-4


def test_all_five_phases_occur_and_the_sum_of_the_costates_gives_them():
    seen = set()
    for name in ("level-common", "downhill-common", "level-recourse", "downhill-recourse"):
        seen |= cunillera.phase_durations(answer(name)).keys()
        assert min(answer(name).certificate["agreement"].values()) >= 0.99
        assert cunillera.phases_agree(answer(name)) >= 0.95
    assert seen == set(Phase)
    assert Phase.PARTIAL_BRAKING not in cunillera.phase_durations(answer("level-common"))


@pytest.mark.parametrize("name", ["level-nominal", "level-common", "level-recourse"])
def test_the_multiplier_of_the_time_is_that_of_steady_cruising(name):
    cruise = cunillera.cruise(answer(name))
    assert cruise.price == pytest.approx(cruise.analytic, rel=5e-5)
    if name == "level-nominal":
        resistance = cunillera.TRAIN.resistance
        slope = resistance.r1 + 2.0 * resistance.r2 * cruise.speed
        alone = cruise.speed**2 * slope / CHOSEN[1].inertia
        assert cruise.price == pytest.approx(alone, rel=1e-3)


def test_robustness_costs_little_and_saves_the_timetable():
    alone = {each.name: per_mass(answer(f"level-{each.name}")) for each in CHOSEN}
    common, recourse = (per_mass(answer(f"level-{name}")) for name in ("common", "recourse"))
    assert alone["easy"] < alone["nominal"] < alone["hard"] <= recourse * (1.0 + 1e-6)
    assert recourse < common, "one brake for all is less than a brake each"
    assert common < 1.03 * alone["nominal"]
    nominal = answer("level-nominal")
    for braking in ("common", "recourse"):
        late = cunillera.driven(LEVEL, nominal, CHOSEN, braking=braking).times[:, -1] - 1541.0
        assert late[0] < -10.0
        assert abs(late[1]) < 0.1
        assert late[2] > 10.0
    ends = cunillera.driven(LEVEL, nominal, CHOSEN).speeds[:, -1]
    assert ends[0] > LEVEL.final_speed + 1.0
    robust = cunillera.driven(LEVEL, answer("level-common"), CHOSEN)
    assert robust.times[:, -1].max() <= 1541.0 + 1e-3
    assert robust.speeds[:, -1].max() <= LEVEL.final_speed + 1e-5
