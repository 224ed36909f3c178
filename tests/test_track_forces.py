"""What a line and a train's file state of the forces: curve resistance, and where the mass is."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from refusals import refused
from scipy.integrate import solve_ivp
from simulated_line import level_line, steps

from analysis import OptimiserOptions, TrajectoryProblem, optimise
from analysis.control.follow import following_scenarios
from analysis.resistance.coast_down import coast_down
from analysis.resistance.fit import fit_trip
from analysis.resistance.recording import TripRefusedError, track_slope
from analysis.trajectory.audit import audit
from trainlog.arrays import FloatArray
from trainlog.errors import InfeasibleError, InputError
from trainlog.formats.railway import (
    TRAIN_ATTACHMENT,
    line_from_bytes,
    line_to_bytes,
    read_line,
    read_train,
    train_from_bytes,
    train_to_bytes,
)
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.railway import (
    Axles,
    Configuration,
    CurvatureProfile,
    Line,
    RunningResistance,
    StepProfile,
    Train,
    Trajectory,
)
from trainlog.simulation import draw_scenarios, drive, recorded
from trainlog.simulation.dynamics import Step, forces
from trainlog.simulation.plant import Plant
from trainlog.units import GRAVITY

WIL, FLIRT = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))

FREIGHT = Train(
    "freight", 1.2e6, 0.05, RunningResistance(18e3, 100.0, 60.0), 300e3, 4e6, 150e3, 4e6, 800e3,
    28.0, 0.3, 0.3, length=400.0, axles=Axles(8, 170e3),
)  # fmt: skip


def curved(*radii: float, formula: str = "roeckl") -> Line:
    """Arcs of 500 m, joined by straight track and transitions of 100 m."""
    positions, start, end = [0.0], [0.0], [0.0]
    for radius in radii:
        at = positions[-1] + 100.0
        positions += [at, at + 100.0, at + 600.0, at + 700.0]
        start += [0.0, 1.0 / radius, 1.0 / radius, 0.0]
        end += [1.0 / radius, 1.0 / radius, 0.0, 0.0]
    profile = CurvatureProfile(np.array(positions), np.array(start), np.array(end))
    return level_line(positions[-1] + 100.0, curvatures=profile, curve_resistance=formula)


@pytest.mark.parametrize(
    ("formula", "radius", "per_mille"),
    [
        ("proportional", 300.0, 2.0),
        ("roeckl", 705.0, 1.0),
        ("roeckl", 300.0, 650.0 / 245.0),
        ("roeckl", 280.0, 2.0),
        ("roeckl_small_radius", 530.0, 1.0),
    ],
)
def test_curve_resistance_is_that_of_the_formula_in_plan_and_simulation(formula, radius, per_mille):
    line = curved(radius, -radius, formula=formula)
    assert line.track_acceleration([450.0, 1250.0]) == pytest.approx(GRAVITY * per_mille / 1e3)
    plant = Plant.of(line, FLIRT, maximum_adhesion=StepProfile([0.0], [0.3]))
    rail, rows = np.array([0.0, 0.3, 1.0, 1.0, 0.3]), plant.track
    for at in np.linspace(1.0, line.length - 1.0, 60):
        row = rows[np.searchsorted(rows[:, 0], at, side="right") - 1]
        state = np.zeros(3)
        state[0], state[1] = at, 10.0
        now = Step(*[np.zeros(0)] * 10, plant.parameters)._replace(track=row, rail=rail)
        along = forces(state, 10.0, now)[2]
        assert along / FLIRT.mass == pytest.approx(line.track_acceleration(at), abs=1e-7)


def test_files_state_the_choices_and_leave_the_defaults_out():
    refused(InputError, "does not hold for the radius of 50 m at km", curved, 50.0)
    refused(InputError, "no such curve_resistance", curved, 400.0, formula="roeckel")
    for formula in ("roeckl", "proportional"):
        line = replace(WIL, curve_resistance=formula)
        again = line_from_bytes(line_to_bytes(line))
        assert again == line
        assert again.reversed().curve_resistance == formula
    train = replace(FLIRT, mass_model="homogeneous_strip", acceleration_limits="net")
    assert train_from_bytes(train_to_bytes(train)) == train
    assert b"mass_model" not in train_to_bytes(FLIRT)
    assert b"curve_resistance" not in line_to_bytes(WIL)
    refused(InputError, "a homogeneous_strip has a length", replace, train, length=0.0)
    refused(InputError, "no such mass_model 'strip'", replace, train, mass_model="strip")


@pytest.mark.parametrize("formula", ["proportional", "roeckl"])
def test_a_strip_feels_the_mean_of_what_many_masses_under_it_feel(formula):
    line = replace(WIL, curve_resistance=formula)
    fronts = np.random.default_rng(1).uniform(0.0, line.length, 40)
    for length in (58.6, 400.0):
        masses = fronts - length * (np.arange(20_000)[:, None] + 0.5) / 20_000
        mean = line.track_acceleration(masses).mean(axis=0)
        # Before its start the line goes on as it begins.
        np.testing.assert_allclose(line.track_acceleration(fronts, length), mean, atol=3e-6)
        pieces = line.pieces(length)
        row = np.searchsorted(pieces.start, fronts, side="right") - 1
        linear = pieces.sine[row] + pieces.climb[row] * (fronts - pieces.start[row])
        np.testing.assert_allclose(GRAVITY * linear, mean, atol=2e-5)
    change = np.diff([line.track_acceleration(fronts + x, 400.0) for x in (-1.0, 1.0)], axis=0)
    assert track_slope(line, fronts, 400.0).shape == change[0].shape


def test_spikes_of_a_survey_are_averaged_or_refused_with_the_reason():
    """Of 2,531 gradients a few have 244 per mille: a heavy train climbs none of them as a point."""
    edges = np.arange(2_531) * 10.0
    values = 0.004 * np.sin(edges / 4e3)
    for at in (600, 1_300, 2_000):
        values[at : at + 3], values[at + 3 : at + 6] = 0.244, -0.244
    line = level_line(25_310.0, limit=8.0, gradients=StepProfile(edges, values))
    said = r"km 6.0\d\d; .*244 per mille there, but 21 averaged .*strip"
    refused(InfeasibleError, said, optimise, TrajectoryProblem.nominal(line, FREIGHT))
    strip = replace(FREIGHT, mass_model="homogeneous_strip", length=600.0)
    found = optimise(TrajectoryProblem.nominal(line, strip))
    assert found.certificate["certified"]
    assert "homogeneous strip" in found.model


RISES = steps((0.0, -0.03), (700.0, 0.0), (3e3, -0.02), (5e3, 0.03))
HILLS = level_line(6e3, limit=25.0, gradients=RISES)
NET = replace(FLIRT, max_acceleration=0.5, max_deceleration=0.5, acceleration_limits="net")


def own_accelerations(found: Trajectory, train: Train) -> FloatArray:
    """Accelerations of the train at the beginning of each cell [m/s²], by Newton's law."""
    speed, at = found.speeds[0, :-1], found.positions[:-1] + 1e-6
    force = found.tractive_effort + 0.5 * found.tractive_effort_fall - found.braking_effort[0]
    force = force - train.resistance(speed) - train.mass * HILLS.track_acceleration(at)
    return np.asarray(force / Configuration.of(train).inertia)


def test_net_limits_hold_for_the_trains_own_acceleration_on_hills():
    gross = replace(NET, acceleration_limits="gross")
    options, runs = OptimiserOptions(cells=120), {}
    for train in (gross, NET):
        run = TrajectoryProblem.nominal(HILLS, train, reserve=0.02)
        found = optimise(run, options)
        assert found.certificate["certified"]
        runs[train.acceleration_limits] = (run, found)
        used = own_accelerations(found, train)
        pulls = found.tractive_effort > 1e-3 * found.tractive_effort.max()
        brakes = found.braking_effort[0] > 1e-3 * found.braking_effort.max()
        reached = used[pulls].max(), -used[brakes].min()
        if train is gross:
            # Downhill it gains more than its effort alone gives, uphill it brakes harder.
            assert min(reached) > 0.7
        else:
            assert max(reached) <= 0.5 + 1e-6
            # Braking uses all of it; traction leaves the resistance that grows with the speed.
            assert reached[0] > 0.45
            assert reached[1] > 0.5 - 1e-3
    # The audit of the one finds the other's efforts too large.
    run, found = runs["net"][0], runs["gross"][1]
    checked = audit(
        run, found.positions, found.tractive_effort, 0.5 * found.tractive_effort_fall,
        found.braking_effort,
    )  # fmt: skip
    assert checked.effort[0] > 1.4
    assert checked.braking[0] > 1.4


def test_a_train_that_is_a_strip_is_identified_as_one():
    strip = replace(FLIRT, length=300.0, mass_model="homogeneous_strip")
    scenario = draw_scenarios(WIL, strip, count=1, seed=11)[0]
    trip = recorded(scenario, drive(scenario))
    speeds = np.linspace(10.0, 35.0, 26)
    fit = fit_trip(trip)
    assert fit.resistance(speeds) == pytest.approx(scenario.resistance(speeds), rel=0.03)
    point = train_to_bytes(replace(strip, mass_model="mass_point"))
    mistaken = replace(trip, attachments={**trip.attachments, TRAIN_ATTACHMENT: point})
    refused(TripRefusedError, "is uncertain by|than elsewhere", fit_trip, mistaken)
    # Without its efforts, from how it coasts.
    true = scenario.resistance(speeds) / (scenario.mass + scenario.rotating_mass)
    errors = [coast_down([each]).curve(speeds) / true - 1.0 for each in (trip, mistaken)]
    strip_error, point_error = (float(np.sqrt(np.mean(each**2))) for each in errors)
    assert 2.0 * strip_error < point_error


def test_a_plan_for_a_strip_is_what_an_integrator_of_its_own_drives():
    """Slow freight on rolling gradients: mean gradient from the heights of front and rear."""
    generator = np.random.default_rng(4)
    edges = np.concatenate(([0.0], np.sort(generator.uniform(0.0, 12e3, 40))))
    values = np.concatenate(([0.0], 0.006 * generator.standard_normal(40)))
    line = level_line(12e3, limit=9.0, gradients=StepProfile(edges, values))
    train = replace(FREIGHT, mass_model="homogeneous_strip")
    found = optimise(TrajectoryProblem.nominal(line, train))
    assert found.certificate["gap"] < 5e-4
    known = np.concatenate(([-1e3], edges, [12e3]))
    sines = np.concatenate(([0.0], values / np.hypot(1.0, values)))
    heights = np.concatenate(([0.0], np.cumsum(sines * np.diff(known))))
    inertia, traction = Configuration.of(train).inertia, found.tractive_effort_at

    def slope(s: float, z: FloatArray, braking: float) -> FloatArray:
        held = train.resistance(np.sqrt(2.0 * np.maximum(z, 0.0)))
        rise = np.diff(np.interp([s - train.length, s], known, heights))[0] / train.length
        force = float(traction(s)) - braking - train.mass * GRAVITY * rise
        return np.asarray((force - held) / inertia)

    z, highest, reached = 0.0, 0.0, [0.0]
    for k, (begin, end) in enumerate(pairwise(found.positions.tolist())):
        inside = np.linspace(begin, end, 5).clip(begin + 1e-9, end - 1e-9)
        solved = solve_ivp(
            slope, (inside[0], inside[-1]), [z], "DOP853", inside, rtol=1e-9, atol=1e-9,
            args=(found.braking_effort[0, k],),
        )  # fmt: skip
        z = float(solved.y[0, -1])
        highest = max(highest, float(solved.y.max()))
        reached.append(z)
    assert np.sqrt(2.0 * highest) <= 9.0 + 1e-5
    np.testing.assert_allclose(reached, 0.5 * found.speeds[0] ** 2, atol=2e-3)


def test_a_plan_is_followed_with_the_forces_that_it_was_planned_with():
    strip = replace(FLIRT, mass_model="homogeneous_strip")
    found = optimise(TrajectoryProblem.nominal(WIL, strip, end=6e3), OptimiserOptions(cells=60))
    found.check_run(WIL, strip)
    said = r"mass_model 'homogeneous_strip', train .* 'mass_point'"
    refused(InputError, said, following_scenarios, found, WIL, FLIRT)
    bends, said = replace(WIL, curve_resistance="roeckl"), "'proportional', line .* 'roeckl'"
    refused(InputError, said, following_scenarios, found, bends, strip)
