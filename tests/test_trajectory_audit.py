"""The audit: it agrees with other integrators, and it catches what is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from trajectory_cases import FLIRT, KMH, level_line, slippery, steps

from analysis.trajectory.audit import Audit, _in_table, _table, audit
from analysis.trajectory.discretisation import inside
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.railway import Configuration, EffortCurve, Line, RunningResistance, TimingPoint, Train
from trainlog.units import GRAVITY

pytestmark = pytest.mark.usefixtures("unrenewed")


TRACTION, BRAKING = 50_000.0, 25_000.0
"""Of a run without resistance: 500 m of traction, 500 m of coasting, 1000 m of braking."""

ARRIVAL_TOLERANCE, SPEED_TOLERANCE, EFFORT_TOLERANCE = 1e-4, 1e-6, 1e-6
POINT_TOLERANCE = 1e-5
END_TOLERANCE, STOPPING_TOLERANCE = 1e-3, 1e-3
"""By which a limit may be exceeded [s], [m/s], relative; at the stop [m/s], [m]."""

SMOOTH = replace(FLIRT, resistance=RunningResistance(0.0, 0.0, 0.0))
LEVEL = level_line(2_000.0)
ONE = Configuration.of(SMOOTH)
FASTEST = float(np.sqrt(2.0 * TRACTION * 500.0 / ONE.inertia))
TIME = (2.0 * 500.0 + 500.0 + 2.0 * 1_000.0) / FASTEST


def known_run(
    train: Train = SMOOTH,
    configuration: Configuration = ONE,
    *,
    traction: float = TRACTION,
    braking: float = BRAKING,
    running_time: float = TIME,
    line: Line = LEVEL,
    **question: object,
) -> tuple[Audit, list[str]]:
    """The audit of a run whose motion is known, and what it does not pass."""
    problem = TrajectoryProblem(line, train, [configuration], sigmas=0.0, **question)
    positions = np.linspace(0.0, 2_000.0, 81)
    pulls, brakes = positions[:-1] < 500.0, positions[:-1] >= 1_000.0
    found = audit(problem, positions, traction * pulls, np.zeros(80), braking * brakes[None])
    return found, found.failures(problem, running_time)


def test_audit_of_a_run_of_constant_efforts_is_known_in_closed_form():
    found, failures = known_run(condition_map=slippery(LEVEL))
    assert failures == []
    assert found.arrival[0] == pytest.approx(TIME, rel=1e-12)
    assert found.end_speed[0] == pytest.approx(0.0, abs=1e-6)
    assert found.shortfall[0] == pytest.approx(0.0, abs=1e-6)
    assert found.overspeed[0] == pytest.approx(FASTEST - 140.0 / 3.6)
    assert found.power[0] == pytest.approx(TRACTION * FASTEST / ONE.max_power)
    assert found.effort[0] == pytest.approx(TRACTION / (SMOOTH.max_acceleration * ONE.inertia))
    assert found.braking[0] == pytest.approx(BRAKING / (SMOOTH.max_deceleration * ONE.inertia))
    shares = (TRACTION / SMOOTH.adhesive_weight(0.0), BRAKING / (GRAVITY * ONE.mass))
    assert found.adhesion[0] == pytest.approx(max(shares) / 0.30)
    assert found.wheel_energy[0] == pytest.approx(TRACTION * 500.0)
    regained = SMOOTH.efficiency_regeneration * BRAKING * 1_000.0
    bought = TRACTION * 500.0 / SMOOTH.efficiency_traction
    assert found.line_energy[0] == pytest.approx(bought - regained)


def test_a_train_that_creeps_for_minutes_arrives_when_it_does():
    """At 5 km/h in cells of 250 m, its mass spread over its length; the truth is scipy's."""
    train = replace(SMOOTH, mass_model="homogeneous_strip")
    creeping = Configuration.of(replace(train, resistance=RunningResistance(1_000.0, 300.0, 10.0)))
    positions = np.arange(0.0, 2_001.0, 250.0)
    rises = steps(*((at, (-1) ** k * 1e-4) for k, at in enumerate(positions[:-1])))
    line = replace(LEVEL, gradients=rises)
    effort, (r0, r1, r2) = float(creeping.resistance(1.389)), creeping.resistance.parabola
    places = np.linspace(0.0, 2_000.0, 20_001)
    slopes = creeping.mass * line.track_acceleration(places, train.strip_length)

    def motion(at, state):
        speed = np.sqrt(2.0 * state[0])
        force = effort - r0 - (r1 + r2 * speed) * speed - np.interp(at, places, slopes)
        return force / creeping.inertia, 1.0 / speed

    start = (0.5 * 1.389**2, 0.0)
    known = solve_ivp(motion, (0.0, 2_000.0), start, "DOP853", rtol=1e-9, max_step=1.0).y[1, -1]
    run, none = TrajectoryProblem(line, train, [creeping], initial_speed=1.389), np.zeros(8)
    found = audit(run, positions, np.full(8, effort), none, none[None])
    assert found.arrival[0] == pytest.approx(known, abs=2e-4)


def test_a_cell_of_millimetres_far_along_the_line_has_the_gradient_of_its_own_side():
    change = 93_036.8
    line = replace(level_line(100_000.0), gradients=steps((0.0, 0.02), (change, -0.01)))
    positions = np.array([93_000.0, change - 0.004, change, change + 0.002, 93_100.0])
    found = line.track_acceleration(inside(positions, 16))
    assert np.ptp(found, axis=1).tolist() == [0.0] * 4
    assert found[1, 0] > 0.0 > found[2, 0]


def test_a_train_whose_effort_just_balances_its_resistance_does_not_start():
    still = RunningResistance(2_000.0, 0.0, 0.0)
    held = replace(ONE, resistance=still)
    run = TrajectoryProblem(LEVEL, SMOOTH, [held])
    positions, none = np.linspace(0.0, 2_000.0, 81), np.zeros(80)
    found = audit(run, positions, np.full(80, 2_000.0), none, none[None])
    assert found.shortfall[0] == pytest.approx(2_000.0)
    assert any("stops short" in each for each in found.failures(run, 1e6))


def test_an_effort_of_a_table_is_that_of_the_curve():
    """Between all of its rows, in the first of them as in the last, and beyond."""
    curve = EffortCurve(np.array([0.0, 4.0, 9.0, 20.0]), np.array([9e4, 8e4, 3e4, 2e4]))
    for speed in (0.5, 3.9, 4.0, 6.0, 12.0, 20.0, 31.0):
        known = np.interp(speed, curve.speeds, curve.efforts) * min(1.0, 20.0 / speed)
        assert _in_table(speed, curve.speeds, curve.efforts) == pytest.approx(known)
    assert _in_table(0.7, *_table(None)) == np.inf


def test_energy_that_the_dynamic_brake_cannot_take_is_not_fed_back():
    """By its power; by its effort; by the adhesion of the powered axles."""
    bought = TRACTION * 500.0 / SMOOTH.efficiency_traction
    weak = replace(SMOOTH, max_dynamic_braking_effort=0.4 * BRAKING)
    found, _ = known_run(weak)
    assert (bought - found.line_energy[0]) == pytest.approx(
        0.4 * SMOOTH.efficiency_regeneration * BRAKING * 1_000.0
    )
    # All of the rail but half of what the powered axles would need.
    half = 0.5 * BRAKING / SMOOTH.adhesive_weight(0.0)
    found, _ = known_run(condition_map=slippery(LEVEL, (1_000.0, 2_000.0, half)))
    assert (bought - found.line_energy[0]) == pytest.approx(
        0.5 * SMOOTH.efficiency_regeneration * BRAKING * 1_000.0
    )
    # Power is short from the fastest to half of it, in three quarters of the way.
    power = BRAKING * 0.5 * FASTEST
    found, _ = known_run(replace(SMOOTH, max_dynamic_braking_power=power))
    square = np.linspace(FASTEST**2, 0.0, 200_001)
    taken = np.minimum(BRAKING, power / np.sqrt(np.maximum(square, 1e-9))).mean()
    assert (bought - found.line_energy[0]) == pytest.approx(
        SMOOTH.efficiency_regeneration * taken * 1_000.0, rel=2e-3
    )


def test_an_overspeed_where_a_lower_limit_ends_is_reported():
    """The train accelerates beyond the limit in its last metre alone."""
    limit = KMH * (FASTEST * np.sqrt(0.8) - 3.0 * SPEED_TOLERANCE)
    line = level_line(2_000.0, (0.0, limit), (400.0, 140.0))
    found, failures = known_run(line=line)
    assert found.overspeed[0] == pytest.approx(3.0 * SPEED_TOLERANCE, rel=1e-3)
    assert len(failures) == 1
    assert "exceeds the permitted speed" in failures[0]


def test_the_distance_to_the_end_of_a_train_that_stops_early_is_known():
    found, failures = known_run(braking=1.25 * BRAKING)
    assert found.shortfall[0] == pytest.approx(200.0, rel=1e-9)
    assert any("stops short by [m] 200" in failure for failure in failures)


def test_tapered_traction_is_audited_where_it_is_highest():
    """Traction that falls or rises by a tenth about its mean in each cell, from 1 m/s."""
    positions, taper = np.linspace(0.0, 2_000.0, 81), np.zeros(80)
    taper[:20] = 0.1 * TRACTION
    pulls, brakes = TRACTION * (positions[:-1] < 500.0), BRAKING * (positions[:-1] >= 1_000.0)
    problem = TrajectoryProblem(
        LEVEL, SMOOTH, [ONE], sigmas=0.0, condition_map=slippery(LEVEL, (0.0, 500.0, 0.2))
    )
    for sign in (1.0, -1.0):
        found = audit(problem, positions, pulls, sign * taper, brakes[None])
        most = SMOOTH.max_acceleration * ONE.inertia
        assert found.effort[0] == pytest.approx(1.1 * TRACTION / most)
        weight = 0.2 * SMOOTH.adhesive_weight(0.0)
        assert found.adhesion[0] == pytest.approx(1.1 * TRACTION / weight)
        # At the end of the last cell at the highest speed, or where that cell begins.
        before = FASTEST * np.sqrt(475.0 / 500.0)
        used = 0.9 * FASTEST if sign > 0.0 else 1.1 * FASTEST
        assert found.power[0] * ONE.max_power == pytest.approx(
            TRACTION * max(used, 1.1 * before if sign > 0.0 else 0.0)
        )
        # The mean of each cell's effort decides how fast it ends.
        assert found.speeds[0, 20] == pytest.approx(FASTEST)


@pytest.mark.parametrize(("excess", "reported"), [(3.0, 1), (0.3, 0)])
def test_what_is_beyond_a_limit_by_more_than_its_tolerance_is_reported(excess, reported):
    """Each limit is set so that the known run is beyond it by `excess` times its tolerance."""
    over = 1.0 + excess * EFFORT_TOLERANCE
    passing = 2.0 * 500.0 / FASTEST + 250.0 / FASTEST  # at 750 m, coasting
    speed, at_point = (FASTEST - excess * each for each in (SPEED_TOLERANCE, POINT_TOLERANCE))
    late, square = excess * ARRIVAL_TOLERANCE, excess * END_TOLERANCE

    def at(**bound: float) -> dict[str, object]:
        return {"windows": [TimingPoint(750.0, **bound)]}

    def of(**changes: float) -> dict[str, object]:
        return {"train": replace(SMOOTH, **changes)}

    def slips(first: float, last: float, used: float) -> dict[str, object]:
        return {"condition_map": slippery(LEVEL, (first, last, used / over))}

    grip = TRACTION / SMOOTH.adhesive_weight(0.0), BRAKING / (GRAVITY * ONE.mass)
    gentler = BRAKING - 0.5 * ONE.inertia * square**2 / 1_000.0
    short = BRAKING * 1_000.0 / (1_000.0 - excess * STOPPING_TOLERANCE)
    weak, power = replace(ONE, max_power=TRACTION * FASTEST / over), BRAKING * FASTEST
    no_friction = {"max_pneumatic_braking_effort": 0.0}
    cases: list[tuple[str, dict[str, object]]] = [
        ("arrives late", {"running_time": TIME - late}),
        ("passes too early", at(earliest=passing + late)),
        ("passes too late", at(latest=passing - late)),
        ("too slowly or too fast", at(highest_speed=at_point)),
        ("too slowly or too fast", at(lowest_speed=2.0 * FASTEST - at_point)),
        ("stops short", {"braking": short}),
        ("too fast at the end", {"braking": gentler}),
        ("exceeds the permitted speed", of(max_speed=speed)),
        ("exceeds the power", {"configuration": weak}),
        ("exceeds the traction", of(max_tractive_effort=TRACTION / over)),
        ("exceeds the traction", of(max_acceleration=TRACTION / ONE.inertia / over)),
        ("exceeds the brake", of(max_deceleration=BRAKING / ONE.inertia / over)),
        ("exceeds the brake", of(max_dynamic_braking_effort=BRAKING / over, **no_friction)),
        (
            "exceeds the brake",
            of(max_dynamic_braking_power=power / over, **no_friction),
        ),
        ("exceeds the adhesion", slips(0.0, 500.0, grip[0])),
        ("exceeds the adhesion", slips(1_000.0, 2_000.0, grip[1])),
    ]
    for words, changes in cases:
        _, failures = known_run(**changes)
        assert len(failures) == reported, (words, failures)
        assert all(words in each for each in failures)
