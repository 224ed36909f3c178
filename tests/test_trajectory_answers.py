"""Trajectories against known answers; their audit; problems without a solution are explained."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import solve_ivp
from trajectory_cases import (
    FLIRT,
    KMH,
    VIRM6,
    drawn,
    hilly_line,
    level_line,
    observed,
    optimised,
    slippery,
    steps,
)

from analysis.trajectory import active_set, convex, optimiser
from analysis.trajectory.audit import Audit, _in_table, _table, audit
from analysis.trajectory.convex import NoSolutionError, Relaxation
from analysis.trajectory.discretisation import DiscreteProblem, inside
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.feasibility import UnprovenError
from analysis.trajectory.instructions import Phase, phases_of
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.cli.main import run
from trainlog.errors import InfeasibleError, InputError
from trainlog.formats.samples import sample
from trainlog.railway import (
    Configuration,
    EffortCurve,
    RunningResistance,
    TimingPoint,
    Train,
    Trajectory,
)
from trainlog.units import GRAVITY, JOULES_PER_KWH

pytestmark = pytest.mark.usefixtures("unrenewed")


@pytest.fixture(scope="module")
def reference() -> Trajectory:
    """The field's reference run: 48.5 km level, VIRM6, 1541 s, from 1 to 10 m/s, no losses."""
    return optimised(
        level_line(),
        VIRM6,
        observed(VIRM6, 1.0),
        running_time=1541.0,
        initial_speed=1.0,
        final_speed=10.0,
    )


def test_reference_run_costs_no_more_than_the_best_known(reference):
    per_mass = reference.certificate["energy"] / (1.06 * VIRM6.mass)
    assert per_mass <= 2802.9
    assert per_mass >= 2802.5, "less than every solver and the lower bound found"
    assert 0.0 <= reference.certificate["gap"] <= 5e-4
    assert reference.certificate["audit"]["end_speed"] <= 10.0 + 1e-5


def test_published_pseudospectral_solution():
    """440.141 kWh at the line, efficiency 0.73 both ways, dynamic brake only, from 1 to 1 m/s."""
    train = replace(
        VIRM6,
        max_traction_power=3_129_277.0,
        max_dynamic_braking_effort=213_900.0,
        max_dynamic_braking_power=3_129_277.0,
        max_pneumatic_braking_effort=0.0,
        max_deceleration=10.0,
        efficiency_traction=0.73,
        efficiency_regeneration=0.73,
    )
    line = level_line(48_531.0, (0.0, 140.0), (25_000.0, 100.0), (35_000.0, 140.0))
    found = optimised(
        line, train, observed(train, 1.0),
        running_time=1541.0, initial_speed=1.0, final_speed=1.0, objective="line",
    )  # fmt: skip
    energy = found.certificate["energy"] / JOULES_PER_KWH
    assert abs(energy / 440.141 - 1.0) <= 2e-4
    assert found.certificate["lower_bound"] / JOULES_PER_KWH <= 440.141


def test_cruising_speed_and_braking_speed_are_those_of_optimal_control(reference):
    """On level track: price of time ``V² R'(V)``; braking begins at ``V² R' / (R + V R')``."""
    resistance, phases = VIRM6.resistance, phases_of(reference, 0)
    cells = np.flatnonzero(phases == Phase.CRUISING)[5:-5]
    cruising = float(np.median(reference.speeds[0, cells]))
    slope = resistance.r1 + 2.0 * resistance.r2 * cruising
    price = cruising**2 * slope
    assert reference.certificate["time_price"]["x1"] == pytest.approx(price, rel=1e-3)
    first = int(np.argmax(phases >= Phase.PARTIAL_BRAKING))
    braking = price / (float(resistance(cruising)) + cruising * slope)
    assert reference.speeds[0, first] == pytest.approx(braking, rel=0.01)


def test_phases_come_in_the_order_of_the_textbook(reference):
    phases = phases_of(reference, 0)
    changes = [Phase(p) for p in phases[np.flatnonzero(np.diff(phases, prepend=-1))]]
    main = [p for p in changes if p is not Phase.PARTIAL_BRAKING]
    assert main == [Phase.MAXIMUM_TRACTION, Phase.CRUISING, Phase.COASTING, Phase.MAXIMUM_BRAKING]


def test_more_configurations_never_cost_less():
    configurations = drawn(FLIRT, 6, seed=3)
    certificates = [
        optimised(configurations=configurations[:count], running_time=460.0, cells=120).certificate
        for count in (1, 2, 6)
    ]
    energies = np.array([each["energy"] for each in certificates])
    bounds = np.array([each["lower_bound"] for each in certificates])
    # Equal answers differ by no more than the gap of the one for fewer.
    assert np.all(energies[1:] >= bounds[:-1])
    assert max(each["gap"] for each in certificates) < 2e-3
    assert np.all(np.diff(energies) >= -1e-4 * energies[0])
    assert energies[-1] > energies[0]


def test_the_least_time_together_is_hardly_above_that_of_the_slowest():
    """Those who can run ahead brake: at a speed below the slowest one's none takes its power."""
    line = level_line(20_000.0, gradients=steps((0.0, 0.015)))
    train = replace(FLIRT, max_traction_power=0.25 * FLIRT.max_traction_power)
    runs = [Configuration.of(train, load, f"{load:g} kg") for load in (0.0, 12e3)]
    alone = fastest_run(TrajectoryProblem(line, train, runs)).times.max()
    found = optimised(line, train, runs, reserve=0.0, cells=100)
    assert alone <= found.running_time <= 1.005 * alone
    assert found.certificate["gap"] < 0.01


def test_lossless_train_gets_its_kinetic_energy_back():
    """Without resistance and losses, and with a brake that returns all, nothing is spent."""
    train: Train = replace(
        VIRM6,
        resistance=RunningResistance(0.0, 0.0, 0.0),
        max_dynamic_braking_effort=500_000.0,
        max_dynamic_braking_power=1e8,
        efficiency_traction=1.0,
        efficiency_regeneration=1.0,
    )
    found = optimised(
        level_line(10_000.0, (0.0, 100.0)), train, observed(train, 1.0),
        reserve=0.1, objective="line", cells=150,
    )  # fmt: skip
    top = 0.5 * 1.06 * train.mass * float(found.speeds.max()) ** 2
    assert abs(found.certificate["line_energy"][0]) <= 1e-4 * top


def test_traction_is_even_enough_to_be_driven():
    """No cell pulls alone between two that do not, but where full traction ends within a cell."""
    runs = [
        optimised(configurations=observed(FLIRT, *spread), reserve=0.10, objective=objective)
        for spread in ((1.0,), (0.97, 1.0, 1.05))
        for objective in ("wheel", "line")
    ]
    for plan in runs:
        effort = plan.tractive_effort
        alone = effort[1:-1] - np.maximum(effort[2:], effort[:-2])
        assert np.count_nonzero(alone > 0.05 * effort.max()) <= 1


TRACTION, BRAKING = 50_000.0, 25_000.0
"""Of a plan without resistance: 500 m of traction, 500 m of coasting, 1000 m of braking."""

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
    train=SMOOTH, configuration=ONE, *, braking=BRAKING, running_time=TIME, line=LEVEL, **question
) -> tuple[Audit, list[str]]:
    """The audit of a run whose motion is known, and what it does not pass."""
    problem = TrajectoryProblem(line, train, [configuration], sigmas=0.0, **question)
    positions = np.linspace(0.0, 2_000.0, 81)
    pulls, brakes = positions[:-1] < 500.0, positions[:-1] >= 1_000.0
    found = audit(problem, positions, TRACTION * pulls, np.zeros(80), braking * brakes[None])
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
    line = level_line(100_000.0, gradients=steps((0.0, 0.02), (change, -0.01)))
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
        ("exceeds the brake", of(max_dynamic_braking_power=power / over, **no_friction)),
        ("exceeds the adhesion", slips(0.0, 500.0, grip[0])),
        ("exceeds the adhesion", slips(1_000.0, 2_000.0, grip[1])),
    ]
    for words, changes in cases:
        _, failures = known_run(**changes)
        assert len(failures) == reported, (words, failures)
        assert all(words in each for each in failures)


def reported(words: str, error: pytest.ExceptionInfo[InfeasibleError]) -> float:
    found = re.search(words, str(error.value))
    assert found is not None, str(error.value)
    return float(found.group(1))


def test_too_little_time_names_the_slowest_and_a_time_that_is_accepted():
    asked = (hilly_line(), FLIRT, observed(FLIRT, 0.9, 1.0, 1.1))
    least = fastest_run(TrajectoryProblem(*asked)).times.max()
    named = set()
    for share in (0.5, 1.0 + 1e-7):
        with pytest.raises(InfeasibleError, match=r"configuration 'x1\.1'") as error:
            optimised(*asked, running_time=share * least, cells=40)
        named.add(error.value.remedy or "")
        needed, missing = (
            reported(words, error)
            for words in (r"at least (\d+\.\d) s", r"(\d+\.\d) s are missing")
        )
        assert needed == pytest.approx(share * least + missing, abs=0.11)
    (remedy,) = named
    time = re.fullmatch(r"allow at least (\d+) s", remedy)
    assert time
    found = optimised(*asked, running_time=float(time[1]), cells=40)
    assert found.certificate["audit"]["lateness"] <= 1e-4


def test_trains_too_different_for_one_brake_are_refused_whatever_the_time():
    """No time helps, and the refusal does not ask for more: the relaxation proves it."""
    run = level_line(40_000.0, (0.0, 120.0), (20_000.0, 60.0)), FLIRT, observed(FLIRT, 0.5, 1.5)
    for reserve in (0.1, 1.5):
        with pytest.raises(InfeasibleError, match="whatever the time") as error:
            optimised(*run, braking="common", final_speed=8.0, reserve=reserve, cells=60)
        assert "allow" not in str(error.value)
    found = optimised(*run, final_speed=8.0, reserve=0.1, cells=60)
    assert found.certificate["audit"]["passed"]


COMMON = (level_line(), VIRM6, observed(VIRM6, 0.97, 1.0, 1.03))
OPTIONS = {"running_time": 1541.0, "initial_speed": 1.0, "braking": "common", "cells": 50}


def test_common_brakes_cannot_stop_them_all_and_say_how_slow_they_can():
    with pytest.raises(InfeasibleError, match="with one braking effort for all") as error:
        optimised(*COMMON, **OPTIONS)
    assert not isinstance(error.value, UnprovenError)
    reachable = reported(r"the lowest speed found is (\d+\.\d) km/h", error) / KMH
    assert 5.0 < reachable < 10.0
    refused(InfeasibleError, "", optimised, *COMMON, final_speed=reachable - 0.3, **OPTIONS)
    found = optimised(*COMMON, final_speed=reachable + 0.1, **OPTIONS)
    assert found.certificate["audit"]["passed"]


@pytest.mark.parametrize("settles", ["nowhere", "at the stop"])
def test_a_common_brake_that_ends_too_fast_is_a_proof_where_solvers_do_not_settle(
    settles, monkeypatch
):
    """Asked for a stop the relaxation has no inside; left to end as it may it never stops.

    That more time would help is not proven: none is asked for.
    """
    least_time = Relaxation.least_time

    def unsettled(relaxation: Relaxation) -> float:
        if settles == "nowhere" or relaxation.problem.final > 1.0:
            raise NoSolutionError("infeasible_inaccurate")
        return least_time(relaxation)

    monkeypatch.setattr(Relaxation, "least_time", unsettled)
    with pytest.raises(InfeasibleError, match=r"cannot all end at 0\.0 km/h") as error:
        optimised(*COMMON, **OPTIONS)
    assert not isinstance(error.value, UnprovenError)
    assert "inf" not in str(error.value)


def test_a_start_too_fast_to_stop():
    said = r"starts at 72\.0 km/h and cannot brake in time"
    with pytest.raises(InfeasibleError, match=said) as error:
        optimised(level_line(1_000.0), FLIRT, observed(FLIRT, 1.0), start=900.0, initial_speed=20.0)
    limit = reported(r"at most (\d+\.\d) km/h", error) / KMH
    assert limit == pytest.approx((2.0 * 1.1 * 100.0) ** 0.5, rel=0.03)


SLOPES = {
    change: level_line(5_000.0, gradients=steps((0.0, 0.0), (2_000.0, change)))
    for change in (0.15, -0.19)
}
SLIPPERY = level_line(5_000.0, gradients=steps((0.0, 0.03)))
FAST = level_line(20_000.0, (0.0, 900.0))


def timed(*windows: TimingPoint) -> dict[str, object]:
    """A run in 450 s over the hilly line, past points with bounds."""
    return {"line": hilly_line(), "running_time": 450.0, "windows": windows}


@pytest.mark.parametrize(
    ("question", "words"),
    [
        (
            {"line": SLOPES[0.15], "configurations": observed(FLIRT, 1.0, load=400_000.0)},
            r"comes to a stand at km 2\.\d+: full traction",
        ),
        ({"line": SLOPES[-0.19]}, "cannot brake on the slope"),
        (
            {"line": SLIPPERY, "condition_map": slippery(SLIPPERY, (0.0, 5_000.0, 0.03))},
            "comes to a stand",
        ),
        (
            {"line": level_line(5_000.0), "running_time": 100.0}
            | {"condition_map": slippery(level_line(5_000.0), (0.0, 5_000.0, 0.05))},
            r"\d+ % (of the time )?at the adhesion of the map",
        ),
        (
            {"line": level_line(20_000.0, (0.0, 60.0)), "running_time": 100.0},
            "9\\d % of the time at the limits or the train's own top speed",
        ),
        (
            {"line": FAST, "running_time": 100.0, "train": replace(FLIRT, max_speed=900.0 / KMH)},
            r"100\.0 s \(1:40 min\) .* from km 0\.000 \(A\) to km 20\.000 \(B\).*at full power",
        ),
        (
            timed(TimingPoint(3e3, earliest=200.0), TimingPoint(6e3, latest=230.0)),
            r"needs at least \d+\.\d s from km 3\.000 to km 6\.000",
        ),
        (timed(TimingPoint(4e3, lowest_speed=30.0)), r"the limit is the 80 km/h permitted there"),
        (
            timed(TimingPoint(6e3, latest=150.0)),
            r"after \d+\.\d s at the earliest, .* window closes",
        ),
        (timed(TimingPoint(6e3, earliest=440.0)), r"needs at least \d+\.\d s from km 6\.000"),
        (timed(TimingPoint(6e3, lowest_speed=40.0)), r"km/h at most, 144\.0 km/h are required"),
    ],
)
def test_the_reason_and_its_place_are_named(question, words):
    asked = {"train": FLIRT, "configurations": observed(FLIRT, 1.0), "cells": 60} | question
    refused(InfeasibleError, words, optimised, **asked)


@pytest.mark.parametrize(("r1", "r2", "name"), [(-100.0, 30.0, "r1 = -100"), (2e2, -0.5, "r2 = -")])
def test_a_resistance_that_falls_with_the_speed_is_refused(r1, r2, name):
    resistance = RunningResistance(FLIRT.resistance.r0, r1, r2)
    odd = replace(Configuration.of(FLIRT, name="odd"), resistance=resistance)
    refused(InputError, f"'odd' has a negative part, {name}", optimised, hilly_line(), FLIRT, [odd])


def test_a_solver_that_breaks_off_reports_no_settings_of_its_own(monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise cp.SolverError("Try another solver, or solve with verbose=True")

    monkeypatch.setattr(cp.Problem, "solve", broken)
    monkeypatch.setattr(convex, "_by_piqp", lambda *_, **__: None)
    monkeypatch.setattr(active_set, "descend", lambda *_: None)
    monkeypatch.setattr(optimiser, "_paced", lambda *_: None)
    with pytest.raises(InfeasibleError, match="beyond the solver's arithmetic") as refusal:
        optimised(reserve=0.1, cells=40)
    assert "verbose" not in str(refusal.value)


def test_a_refusal_without_a_proof_names_a_time_and_remains_one(monkeypatch):
    def not_found(*_: Any) -> None:
        raise UnprovenError("no trajectory was found")

    asked = (hilly_line(), FLIRT, observed(FLIRT, 0.9, 1.1))
    least = fastest_run(TrajectoryProblem(*asked)).times.max()
    monkeypatch.setattr(optimiser, "_audited", not_found)
    words = "no trajectory was found; allow at least 308 s"
    refused(UnprovenError, words, optimised, *asked, running_time=1.0001 * least, cells=40)


def test_limits_for_a_train_without_length_are_refused(tmp_path):
    content = json.loads(sample("CH_Stadler_FLIRT_TPF.train.json").read_text("utf-8"))
    del content["length"]
    (tmp_path / "short.train.json").write_text(json.dumps(content))
    arguments = ["plan", "--train", str(tmp_path / "short.train.json"), "--set", "protect=train"]
    arguments += ["--line", "sample"]
    with pytest.raises(InputError, match="not known; state its length in the train's file"):
        run([*arguments, "-o", str(tmp_path / "a.json")])


@pytest.mark.parametrize("braking", ["common", "recourse"])
def test_a_search_that_the_time_limit_ends_is_refused_without_a_proof(braking, monkeypatch):
    """A common brake cannot stop them all; and under one common traction no reserve is left.

    No finer grid is tried then: each would take longer than the last.
    """
    grids = list[int]()

    def seen(problem: DiscreteProblem, *given: Any) -> Any:
        grids.append(problem.shape[1])
        return active_set.searched(problem, *given)

    monkeypatch.setattr(optimiser, "searched", seen)
    question = {**OPTIONS, "time_limit": 1e-6}
    if braking == "recourse":
        question |= {"running_time": None, "reserve": 1e-9, "braking": braking}
    words = "none was proven impossible: the relaxation is stopped by the time limit"
    refused(InfeasibleError, words, optimised, *COMMON, **question)
    assert max(grids) == grids[0]
