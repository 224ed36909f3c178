"""Random problems and known hard ones: answered, and driven by an integrator of its own."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq
from simulated_line import steps
from trajectory_cases import FLIRT, drawn, free_train, hilly_line, level_line, observed, optimised

from analysis.trajectory import active_set
from analysis.trajectory.convex import NoSolutionError
from analysis.trajectory.discretisation import Plan, discretise
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from analysis.trajectory.rollout import rollout
from trainlog.errors import InfeasibleError
from trainlog.formats.ttobench import read_track, read_train
from trainlog.railway import Configuration, RunningResistance, Trajectory
from trainlog.units import KMH

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "trajectory"))
from benchmark_random import problem_of_kind, random_problem
from independent import driven, least_time


def answered(problem: TrajectoryProblem, cells: int = 200) -> Trajectory:
    """The answer, once the independent integrator has nothing against it."""
    found = optimise(problem, OptimiserOptions(cells))
    assert not driven(problem, found).faults(problem, found)
    return found


@pytest.mark.parametrize("number", [1004, 1008])
def test_random_problems_are_answered_and_the_answers_hold(number):
    problem = random_problem(number)
    found = answered(problem)
    exact = least_time(problem, problem.configurations[0])
    assert found.certificate["least_time"][0] == pytest.approx(exact, rel=2e-4)


def test_weak_trains_on_45_per_mille_are_answered():
    """At 1.5 m/s: in long cells they would stand, or lose minutes."""
    problem = random_problem(32)
    few = replace(problem, configurations=problem.configurations[-3:], reserve=1.0)
    assert optimise(few, OptimiserOptions()).certificate["certified"]


def test_one_that_all_but_stands_at_the_end_is_bounded():
    """It might pass the end at 13 km/h as the others do: its costate is not that of a stop."""
    problem = random_problem(9)
    few = replace(problem, configurations=problem.configurations[:4])
    assert optimise(few, OptimiserOptions(200)).certificate["gap"] <= 1e-3


def test_cells_of_a_kilometre_do_not_add_up_to_a_train_that_never_stops():
    """Plan and audit part by 5e-5 m²/s² in a cell: by half a decimetre a second at the end."""
    problem = problem_of_kind(9102)
    answered(replace(problem, configurations=problem.configurations[1:]))


def test_where_an_effort_curve_is_level_rounding_does_not_stop_the_train():
    """A program's effort is 1e-10 above the level part; up to which speed there is none of it."""
    problem = problem_of_kind(9809)
    found = answered(problem, 100)
    assert found.certificate["gap"] < 1e-3
    assert found.times[0, -1] == pytest.approx(found.running_time, abs=0.01)


def test_one_brake_that_all_but_stops_a_train_is_refused_by_no_time_that_nobody_gave():
    """By its fastest run together one would creep for an hour; no reserve was asked for."""
    problem = problem_of_kind(9807)
    few = replace(problem, configurations=problem.configurations[5:7])
    with pytest.raises(InfeasibleError, match="cannot run together"):
        optimise(few, OptimiserOptions(80))


def test_no_linear_resistance_and_much_time():
    """Where a train all but stands on the way, no time of its is infinite times no resistance."""
    train = replace(FLIRT, resistance=RunningResistance(9_000.0, 0.0, 12.0))
    rises = steps((0.0, 0.0), (4_000.0, 0.04), (6_000.0, -0.02), (12_000.0, 0.03))
    line = level_line(20_000.0, (0.0, 80.0), gradients=rises)
    problem = TrajectoryProblem(line, train, observed(train, 1.0, 1.1), reserve=3.5)
    assert answered(problem).certificate["gap"] < 5e-3


def test_a_weak_train_climbs_at_walking_pace():
    """On cells as long as elsewhere it would stall on paper: it gains power as it slows down.

    It has a tenth of a watt per kilogram above what holds it at 1.6 m/s on 40 per mille.
    """
    rises = steps((0.0, 0.0), (1_500.0, 0.04), (1_800.0, -0.01))
    line = level_line(4_000.0, (0.0, 75.0), gradients=rises)
    weak = {"mass": 170e3, "max_tractive_effort": 170e3, "max_traction_power": 120e3}
    train = replace(FLIRT, max_speed=75.0 / KMH, **weak)
    answered(TrajectoryProblem(line, train, observed(train, 0.9, 1.1), reserve=1.0))


def test_a_heavy_train_that_starts_on_a_climb_is_planned_close_to_its_bound():
    """At 2.7 m/s in the first cell of 226 m it would have no more power than it needs."""
    problem = problem_of_kind(9661)
    ahead = replace(problem, end=problem.start + 6_000.0, windows=())
    assert answered(ahead, 60).certificate["gap"] <= 5e-3


@pytest.mark.usefixtures("unrenewed")
def test_a_time_just_above_the_least_is_no_refusal():
    """300 m with 3 W/kg, 0.1 per cent above the least time of its closed form."""
    train = free_train(1.0, 3.0, 1.0)
    line = level_line(300.0, (0, 360))
    problem = TrajectoryProblem(line, train, [Configuration.of(train)])
    least = least_time(problem, problem.configurations[0])
    found = answered(replace(problem, running_time=1.001 * least))
    assert found.certificate["gap"] < 5e-3
    with pytest.raises(InfeasibleError):
        optimise(replace(problem, running_time=0.9999 * least), OptimiserOptions(200))


def test_seven_hours_are_kept_to_the_millisecond():
    """The times of thousands of metres at walking pace add up; none is refused for the last one."""
    rises = steps((0.0, 0.004), (9_000.0, -0.006), (30_000.0, 0.005))
    limits = (0.0, 30.0), (2_000.0, 8.0), (55_000.0, 30.0)
    line = level_line(60_000.0, *limits, gradients=rises)
    problem = TrajectoryProblem(line, FLIRT, observed(FLIRT, 1.0), reserve=0.0)
    found = answered(problem)
    assert found.running_time > 24_000.0
    assert found.certificate["gap"] < 5e-3


def way_and_time(effort: float, power: float, speed: float) -> tuple[float, float]:
    """From standstill to a speed: constant effort, then constant power."""
    first = min(speed, power / effort)
    return (
        first**2 / (2.0 * effort) + (speed**3 - first**3) / (3.0 * power),
        first / effort + (speed**2 - first**2) / (2.0 * power),
    )


@pytest.mark.parametrize("length", [300.0, 3_000.0])
@pytest.mark.parametrize(("effort", "power"), [(1.0, 3.0), (0.8, 12.0), (0.2, 1.5)])
@pytest.mark.parametrize(("brake", "brake_power"), [(0.6, 1e3), (0.9, 4.0)])
def test_least_time_of_power_and_brake_alone(length, effort, power, brake, brake_power):
    """Accelerating to one speed and braking at once, no limit and no resistance: a closed form."""
    pull, stop = (effort, power), (brake, brake_power)
    peak = brentq(
        lambda v: way_and_time(*pull, v)[0] + way_and_time(*stop, v)[0] - length, 0.1, 99.0
    )
    exact = way_and_time(*pull, peak)[1] + way_and_time(*stop, peak)[1]
    own = free_train(effort, power, 0.0, max_acceleration=10.0, max_deceleration=10.0)
    brakes = {"max_dynamic_braking_effort": brake, "max_dynamic_braking_power": brake_power}
    own = replace(own, **{name: own.mass * each for name, each in brakes.items()})
    run = TrajectoryProblem(level_line(length, (0, 360)), own, [Configuration.of(own)])
    assert fastest_run(run).times[0] == pytest.approx(exact, rel=2e-5)


def test_least_time_with_gradients_bends_and_a_tunnel():
    """Against DOP853, which finds the instants at which one curve takes over from another."""
    short = replace(hilly_line(), tunnels=())
    for line in (hilly_line(), short):
        run = TrajectoryProblem(line, FLIRT, observed(FLIRT, 0.9, 1.2))
        exact = [least_time(run, each) for each in run.configurations]
        np.testing.assert_allclose(fastest_run(run).times, exact, rtol=2e-5)


LIBRARY = Path(__file__).parents[2] / "shared" / "data" / "ttobench"
TRACKS = sorted(path.stem for path in (LIBRARY / "tracks").glob("*.json"))

published = pytest.mark.skipif(not LIBRARY.exists(), reason=f"{LIBRARY} is not here")


@published
@pytest.mark.parametrize("track", ["CH_Stadelhofen_Altstetten", "00_var_gradient_plus_10"])
def test_short_and_steep_tracks_with_three_configurations(track):
    line = read_track(LIBRARY / "tracks" / f"{track}.json")
    train = read_train(LIBRARY / "trains" / "CH_Stadler_FLIRT_TPF.json")
    found = optimised(line, train, drawn(train, 3, seed=8, spread=0.05), reserve=0.1)
    assert found.certificate["gap"] <= 2e-3


@pytest.mark.long
@published
@pytest.mark.parametrize("track", TRACKS or ["none"])
@pytest.mark.parametrize("objective", ["wheel", "line"])
def test_whole_library(track, objective):
    line = read_track(LIBRARY / "tracks" / f"{track}.json")
    for path in sorted((LIBRARY / "trains").glob("*.json")):
        train = read_train(path)
        for reserve in (0.02, 0.05, 0.1, 0.3):
            found = optimised(
                line, train, [Configuration.of(train)], reserve=reserve,
                objective=objective,
            )  # fmt: skip
            certificate = found.certificate
            assert certificate["audit"]["passed"], path.stem
            assert -1e-6 <= certificate["gap"] <= 2e-3, (path.stem, reserve, certificate["gap"])
            # Three programs on each of the coarse cells, the first ones and three laid anew.
            assert len(certificate["solver"]["statuses"]) <= 15


def test_trains_that_only_brake_are_answered():
    """Steeply down with all the time there is: no traction, so no part of it is regained."""
    answered(problem_of_kind(9858), 500)


def test_one_whose_brakes_are_not_found_leaves_those_of_the_others_as_they_are(monkeypatch):
    """Each regains most by itself under the traction that all have."""
    configurations = drawn(FLIRT, 3, seed=2, spread=0.3)
    run = TrajectoryProblem(hilly_line(), FLIRT, configurations, objective="line", reserve=0.2)
    found = optimise(run, OptimiserOptions(100))
    problem = discretise(run, found.positions)
    unit = problem.reference
    planned = Plan(
        0.5 * found.speeds**2, found.tractive_effort / unit, found.braking_effort / unit,
        np.zeros(problem.shape),
    )  # fmt: skip
    late = rollout(problem, planned.traction, None)
    every = active_set._best_responses(problem, late, found.running_time)
    solve = active_set.minimise

    def fails(part, *rest, **options):
        if part.run.configurations[0].name == configurations[1].name:
            raise NoSolutionError("infeasible")
        return solve(part, *rest, **options)

    monkeypatch.setattr(active_set, "minimise", fails)
    some = active_set._best_responses(problem, late, found.running_time)
    work = [plan.dynamic @ problem.step for plan in (late, every, some)]
    assert np.all(work[1] > work[0])
    assert work[2][1] == pytest.approx(work[0][1], rel=1e-2)
    np.testing.assert_array_equal(work[2][[0, 2]], work[1][[0, 2]])
