"""The driver that follows a trajectory: on time, within limits, at its stop, whatever the train."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from simulated_line import flirt, hilly_line, level_line, steps
from trajectory_cases import slippery

from analysis import Follower, OptimiserOptions, TrajectoryProblem, following_scenarios, optimise
from analysis.comparison.groups import trip_cost
from analysis.control import prediction, route as bounds
from analysis.control.follow import MARGIN, Observer, Odometry, effort_reversals, following_line
from analysis.control.plot import following_charts
from analysis.control.prediction import TICK, TrainEstimate, pace_to_arrive, rollout, sampled
from trainlog import Configuration, InputError, LogError
from trainlog.railway import Brake, EffortCurve, StepProfile, TrackConditionMap, Train, Trajectory
from trainlog.simulation import Locator, drive, simulate, trajectory_scenarios
from trainlog.simulation.drivers import DEPARTURE, Observation
from trainlog.simulation.sensors import Instruments, Reading, Sensors

NEUTRAL = TrainEstimate(1.0, 0.0, 0.0)


@cache
def plan(name: str = "flirt") -> tuple[Train, Trajectory]:
    """A train and its trajectory over the hilly line, for masses and resistances far apart."""
    only_friction = {"max_dynamic_braking_effort": 0.0, "brake": Brake(2.0, 1.5)}
    train = flirt(**({} if name == "flirt" else only_friction))
    configurations = [
        Configuration(
            f"{load} t, r{factor}", train.mass + 1e3 * load, train.rotating_mass,
            train.resistance.scaled(factor), train.max_traction_power,
        )
        for load, factor in ((2, 0.9), (10, 1.0), (18, 1.1))
    ]  # fmt: skip
    return train, optimise(
        TrajectoryProblem(hilly_line(), train, configurations, reserve=0.12),
        OptimiserOptions(cells=200),
    )


LIGHT, HEAVY = "2 t, r0.9", "18 t, r1.1"


@cache
def known(name: str = "flirt") -> tuple[bounds.TrainLimits, bounds.RouteTables]:
    train, trajectory = plan(name)
    run = TrajectoryProblem(hilly_line(), train, trajectory.configurations)
    can = bounds.train_limits(run)
    return can, bounds.route_tables(run, trajectory, can)


def map_of(rail: StepProfile) -> TrackConditionMap:
    """What a map that was learnt well says of a rail."""
    ends = [*rail.positions[1:], np.inf]
    return slippery(hilly_line(), *zip(rail.positions, ends, rail.values, strict=True))


WET = steps(
    (0.0, 0.15), (150.0, 0.09), (400.0, 0.17), (5_500.0, 0.08), (5_700.0, 0.17),
    (10_700.0, 0.1), (10_850.0, 0.15),
)  # fmt: skip
"""A rail with three slippery places: at the start, on a climb, before the stop."""


def driven(name="flirt", rail=None, locates=None, chosen=HEAVY, **options):
    """What a train of a configuration does that follows its plan, on dry rail or a known one."""
    train, trajectory = plan(name)
    if rail is not None:
        options |= {"condition": map_of(rail), "layer": "wet"}
    (scenario,) = trajectory_scenarios(
        trajectory, hilly_line(), train, [chosen],
        lambda: Follower(trajectory, hilly_line(), train, **options), seed=3,
    )  # fmt: skip
    scenario = replace(scenario, maximum_adhesion=rail or steps((0.0, 0.3)))
    scenario = replace(scenario, locates=locates) if locates else scenario
    run = drive(scenario)
    found = dict(zip(scenario.plant().columns, run.samples.T, strict=True))
    moving = np.flatnonzero(found["speed"] > 0.0)
    found["late"] = run.seconds[moving[-1]] - DEPARTURE - trajectory.times[trajectory.latest, -1]
    limit = hilly_line().speed_limit(np.minimum(found["position"], 11_000.0))
    found["over"] = np.max(found["speed"] - limit)
    found["braking"] = found["dynamic_braking_effort"] + found["pneumatic_braking_effort"]
    return found, scenario


def test_a_mass_at_the_end_of_the_set_and_a_brake_that_takes_its_time():
    """Friction brake alone, 2 s of dead time and 1.5 s of lag."""
    found, _ = driven("friction")
    assert abs(found["position"][-1] - hilly_line().length) < 0.3
    assert found["over"] <= 0.0
    # What such a brake is not trusted with costs a little time at every lower limit.
    assert abs(found["late"]) < 3.0


def test_efforts_do_not_alternate_where_a_late_train_pulls_at_its_ceiling():
    """On little adhesion, by its own instruments: only places with a reason reverse the effort."""
    late = {"margin": MARGIN, "departure": DEPARTURE + 60.0}
    found, _ = driven(rail=steps((0.0, 0.07)), locates=Odometry, **late)
    assert effort_reversals(found["tractive_effort"], found["braking"]) <= 5
    assert found["over"] <= 0.0
    assert found["protected_axles"].max() == 0.0


def test_the_log_has_the_reference_and_the_configuration(tmp_path):
    train, trajectory = plan()
    (scenario,) = trajectory_scenarios(
        trajectory, hilly_line(), train, [LIGHT],
        lambda: Follower(trajectory, hilly_line(), train), seed=3,
    )  # fmt: skip
    trip = simulate(scenario)
    reference, truth = trip["/reference"], trip["/truth"]
    assert reference.lateness.iloc[0] == 0.0
    assert abs(reference.lateness.iloc[-1]) < 1.0
    planned = trajectory.speed_at(trajectory.latest, truth.position)
    np.testing.assert_allclose(reference.speed, planned)
    assert trip.metadata["configuration"] == LIGHT
    # The load is weighed: the log does not state it exactly.
    error = float(trip.metadata["load"]) - 2_000.0
    assert 0.0 < abs(error) < 4.0 * float(trip.metadata["load_std"])
    (chart,) = following_charts([trip])
    assert [len(panel.curves) for panel in chart.panels] == [4, 1, 1, 1]
    (back,) = following_charts([replace(trip, metadata=trip.metadata | {"direction": "reverse"})])
    assert back.line.stations[0].name == chart.line.stations[-1].name
    bare = replace(trip, topics={"/events": trip["/events"]})
    refused(LogError, r"'driven-.*' followed no trajectory", following_charts, [bare])
    refused(LogError, "no trip to draw", following_charts, [])


def test_it_waits_for_its_departure_and_holds_the_train_after_its_arrival():
    train, trajectory = plan()
    driver = Follower(trajectory, hilly_line(), train)
    assert driver.demand(Observation(0.0, 0.0, 0.0, 0.0)).braking_effort > 0.0
    assert driver.demand(Observation(DEPARTURE - 0.1, 0.0, 0.0, 0.0)).braking_effort == 0.0
    assert driver.demand(Observation(DEPARTURE, 0.0, 0.0, 0.0)).tractive_effort > 0.0
    assert not driver.finished
    short = Observation(400.0, 10_998.0, 0.0, 0.0)
    assert driver.demand(short).tractive_effort > 0.0  # it moves up
    assert driver.demand(short._replace(position=10_999.9)).braking_effort > 0.0
    assert driver.finished


def test_it_keeps_limits_and_stop_by_what_its_own_instruments_measure():
    observed: list[Observation] = []

    def locates(sensors: Sensors, start: float) -> Locator:
        odometry = Odometry(sensors, start)

        def locate(reading: Reading) -> Observation:
            observed.append(odometry(reading))
            return observed[-1]

        return locate

    found, scenario = driven(rail=WET, locates=locates, margin=MARGIN)
    assert found["over"] <= 0.0
    assert found["protected_axles"].max() == 0.0
    # Comfort: efforts over inertia are within what the train's control allows.
    assert found["acceleration"].max() < scenario.train.max_acceleration
    inertia = scenario.mass + scenario.rotating_mass
    assert found["braking"].max() <= scenario.train.max_deceleration * inertia * 1.001
    assert abs(found["late"]) < 1.5
    assert abs(found["position"][-1] - hilly_line().length) < 1.0
    assert found["speed"][-1] == 0.0
    # And the odometry is as good as it says, which is never the truth.
    count = found["position"].size
    for quantity, least in (("position", 0.005), ("speed", 0.003)):
        seen = np.array([getattr(each, quantity) for each in observed])[:count]
        std = np.array([getattr(each, f"{quantity}_std") for each in observed])[:count]
        moving = found["speed"] > 0.5
        off = np.abs(seen - found[quantity])[moving]
        assert np.mean(off > least) > 0.5
        assert np.mean(off < 3.0 * std[moving]) > 0.97
        assert np.quantile(std[moving], 0.99) < 0.5 * getattr(MARGIN, quantity)


def test_a_wrong_wheel_is_found_out_by_satellites_and_balises():
    line = replace(hilly_line(), tunnels=())
    instruments = Instruments(line, Sensors(outages=0.0), 0.0, 1.01, np.random.default_rng(5))
    odometry = Odometry(Sensors(), 0.0)
    speed, off = 20.0, []
    for k in range(4_000):
        time = 0.1 * k
        a = 0.5 if time < speed / 0.5 else 0.0
        v = min(0.5 * time, speed)
        p = 0.5 * v * time if a > 0.0 else 0.5 * speed**2 / 0.5 + speed * (time - speed / 0.5)
        seen = odometry(instruments.read(time, p, v, a))
        off.append((seen.position - p, seen.speed - v))
    # The wheel itself would be 0.2 m/s and 80 m wrong by now.
    late = np.abs(off[1_500:])
    assert late[:, 0].max() < 2.0
    assert late[:, 1].max() < 0.06


@settings(max_examples=25)
@given(
    name=st.sampled_from(["flirt", "friction"]),
    position=st.floats(200.0, 9_000.0),
    speed=st.floats(12.0, 25.0),
    column=st.integers(0, 7),
    braking=st.booleans(),
)
def test_the_linearisation_is_the_predictions_derivative(name, position, speed, column, braking):
    can, road = known(name)
    past = np.full(20 if name == "friction" else 6, 0.1)
    efforts = np.full(8, -0.3 if braking else 0.2)

    def states(change: float) -> np.ndarray:
        moved = efforts.copy()
        moved[column] += change
        return prediction.linearised(position, speed, 0.1, past, moved, 10, NEUTRAL, road, can)[0]

    response = prediction.linearised(position, speed, 0.1, past, efforts, 10, NEUTRAL, road, can)[1]
    slope = (states(1e-4) - states(-1e-4)) / 2e-4
    # Nodes of the gradient table between both predictions make the derivative jump a little.
    np.testing.assert_allclose(response[:, :, column], slope, atol=2e-2, rtol=1e-2)


def test_a_level_prediction_is_known_in_closed_form():
    """No resistance, level: friction asked for now acts after its dead time, with its lag."""
    can, road = known("friction")
    still = can._replace(constant=0.0, linear=0.0, quadratic=0.0, mass=0.0)
    past, brake = np.zeros(20), 0.5
    given = past, np.full(6, -brake), 10, NEUTRAL, road, still
    states, *_ = prediction.linearised(1_000.0, 20.0, 0.0, *given)
    for k in range(7):
        lasting, lag = max(k - 20 * TICK, 0.0), can.lag
        lost = brake * (lasting - lag * (1.0 - np.exp(-lasting / lag)))
        assert states[k, 1] == pytest.approx(20.0 - lost, abs=2e-3)


def test_friction_brakes_give_what_the_motors_lack_in_adhesion():
    """The motors up to the adhesion of the powered axles, all brakes up to that of all axles."""
    can, road = known()
    p, v = 6_000.0, 8.0
    grip = road.adhesion[0]
    powered, whole = grip * can.on_powered, grip * can.on_all
    assert powered < can.dynamic_power / v < np.inf
    assert whole < can.braking
    assert bounds.dynamic_braking(p, v, road, can) == pytest.approx(powered)
    assert bounds.effort_limits(p, v, road, can)[1] == pytest.approx(whole)
    inertia = can.inertia
    quick, asked = prediction.split(-whole / inertia, p, v, road, can)
    assert (-quick * inertia, asked * inertia) == pytest.approx((powered, whole - powered))
    weak = can._replace(dynamic=0.3 * powered, friction=0.2 * powered)
    assert bounds.effort_limits(p, v, road, weak)[1] == pytest.approx(
        bounds.BLENDING * 0.5 * powered
    )


def test_every_train_of_the_set_can_brake_below_the_ceiling():
    """Run backwards from any place: full braking never fails to keep what lies ahead."""
    can, road = known()
    for start in (900.0, 2_600.0, 4_900.0, 9_600.0, 10_700.0):
        for row in can.corners:
            p, v = float(start), float(np.sqrt(bounds.ceiling_square(start, road)))
            while p < road.end - 0.5 and v > 0.1:
                brake = bounds.effort_limits(p, v, road, can)[1]
                a = -brake / row[1] - prediction.free_deceleration(p, v, row, road)
                if v < np.sqrt(bounds.ceiling_square(p, road)) - 0.05:
                    a = max(a, -0.02)  # no more than is needed
                p, v = p + 0.1 * v, v + 0.1 * a
                assert v <= np.sqrt(bounds.ceiling_square(p, road)) + 0.15


@settings(max_examples=40)
@given(
    position=st.floats(0.0, 10_950.0),
    share=st.floats(0.3, 1.0),
    effort=st.floats(-2.0, 2.0),
    name=st.sampled_from(["flirt", "friction"]),
)
def test_the_guard_keeps_every_train_of_the_set_within_bounds(position, share, effort, name):
    can, road = known(name)
    speed = share * float(np.sqrt(bounds.ceiling_square(position, road)))
    past = np.zeros(20 if name == "friction" else 6)
    found = prediction.guarded(position, speed, 0.0, past, 0.0, effort, 5, 12, road, can)
    low, high = prediction.effort_bounds(position, speed, position, road, can)
    assert low - 1e-12 <= found <= high + 1e-12
    assert found <= max(effort, low) + 1e-12
    hardest = prediction.effort_bounds(position, speed, position + 0.5 * speed, road, can)[0]
    excess, least = (
        prediction.excess_over_ceiling(position, speed, 0.0, past, 0.0, u, 5, 12, road, can)
        for u in (found, hardest)
    )
    assert excess <= least + 2e-9


def test_a_higher_pace_arrives_earlier_and_the_right_one_on_time():
    can, road = known()
    rows = np.zeros((400, 4))
    times = [rollout(f, 3_000.0, 20.0, rows, NEUTRAL, road, can)[0] for f in (0.8, 0.9, 1.0, 1.1)]
    assert all(np.diff(times) < 0.0)
    left = times[2] + 7.0
    factor, time, count = pace_to_arrive(left, 1.0, 3_000.0, 20.0, rows, NEUTRAL, road, can)
    assert 0.8 < factor < 1.0
    assert time == pytest.approx(left, abs=0.03)
    states, efforts = sampled(rows, count, 20, 1.0)
    assert states[0] == pytest.approx([3_000.0, 20.0])
    # The reference is a motion: positions are the integral of the speeds.
    mean = 0.5 * (states[1:, 1] + states[:-1, 1])
    np.testing.assert_allclose(np.diff(states[:, 0]), mean, atol=0.1)
    most = [bounds.ceiling_square(p, road) + 0.05 for p in states[:, 0]]
    assert np.all(states[:, 1] ** 2 <= most)
    assert np.all(efforts * can.inertia <= can.traction)


def test_the_train_is_found_while_it_runs():
    can, _ = known()
    observer = Observer(can)
    rng = np.random.default_rng(2)
    for k in range(1_200):
        effort, drag = (0.6 if k % 200 < 60 else 0.05), 0.06 + 0.02 * np.sin(k / 40.0)
        true = 0.98 * effort - 1.07 * drag
        observer.update(true + 0.01 * rng.normal(), effort, drag, 0.0, 0.5)
    assert observer.estimate.gain == pytest.approx(0.98, abs=0.01)
    assert observer.estimate.drag == pytest.approx(0.07, abs=0.05)


def test_a_train_with_curves_follows_within_them():
    """In traction; its dynamic brake fades at both ends, and the friction brake takes over."""
    pull = EffortCurve(np.array([0.0, 12.0, 20.0, 45.0]), np.array([200e3, 185e3, 105e3, 35e3]))
    fading = EffortCurve(np.array([0.0, 3.0, 15.0, 45.0]), np.array([0.0, 60e3, 120e3, 40e3]))
    train = flirt(traction_curve=pull, dynamic_braking_curve=fading)
    configurations = [
        Configuration(name, train.mass + load, train.rotating_mass, train.resistance, power)
        for name, load, power in (("weak", 9e3, 2.3e6), ("strong", 2e3, 2.6e6))
    ]
    run = TrajectoryProblem(hilly_line(), train, configurations, reserve=0.12)
    trajectory = optimise(run, OptimiserOptions(cells=200))
    limits = bounds.train_limits(run)
    route = bounds.route_tables(run, trajectory, limits)
    for v in (0.0, 2.0, 11.0, 18.0, 30.0):
        most, _ = bounds.effort_limits(3_000.0, v, route, limits)
        assert most <= float(pull(v * 2.6 / 2.3)) * (1.0 + 1e-12)
    weak = following_scenarios(trajectory, hilly_line(), train, seed=4, configurations="weak")
    for trip in map(simulate, weak):
        assert trip.metadata["configuration"] == "weak"
        controls, state = trip["/train/controls"], trip["/truth"]
        speed = np.interp(controls.index.asi8, state.index.asi8, state["speed"].to_numpy())
        # Efforts are measured with noise.
        own = pull(np.maximum(speed - 0.3, 0.0) * 2.6 / 2.3)
        assert np.all(controls["tractive_effort"] <= own * 1.02 + 3e3)
        braking = fading(speed) * 1.05 + 8e3
        assert np.all(controls["dynamic_braking_effort"] <= braking)
        assert abs(trip["/reference"]["lateness"].iloc[-1]) < 2.0


def test_simulated_scenarios_are_the_trips_of_the_command():
    train, line = flirt(), level_line(2_500.0, limit=22.0)
    problem = TrajectoryProblem(line, train, plan()[1].configurations, reserve=0.12)
    trajectory = optimise(problem, OptimiserOptions(cells=60))
    trips = [simulate(each) for each in following_scenarios(trajectory, line, train, seed=3)]
    driven_as = tuple(trip.metadata["configuration"] for trip in trips)
    assert driven_as == trajectory.chosen("hardest")
    assert all(abs(trip["/reference"]["lateness"].iloc[-1]) < 1.5 for trip in trips)
    words = following_line(trips[0], trajectory)
    assert re.fullmatch(
        r"running time [\d:]+ min from departure to arrival, [\d:]+ min planned;"
        r" traction [\d.]+ kWh, [\d.]+ kWh planned; slip protection acted \d+ times?;"
        r" \d reversals? from .* beyond 20 kN, \d in the plan",
        words,
    )
    energies = re.search(r"traction ([\d.]+) kWh, ([\d.]+) kWh planned", words)
    assert float(energies[2]) == pytest.approx(trajectory.certificate["energy"] / 3.6e6, abs=0.006)
    driven_work = [trip_cost(trip).traction / 3.6e6 for trip in trips]
    assert float(energies[1]) == pytest.approx(driven_work[0], abs=0.006)
    # With the motors alone they would brake for longer and pull for 8 % more.
    assert np.mean(driven_work) < 1.02 * float(energies[2])
    with pytest.raises(InputError, match="no configuration 'none'"):
        following_scenarios(trajectory, line, train, configurations="none")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"line": level_line(length=11_000.0)}, "for line 'hilly', not for 'level'; give that"),
        ({"line": replace(level_line(length=5_000.0), name="hilly")}, r"ends at km 11\.000"),
        ({"train": flirt(name="other")}, "made for train 'flirt', not for 'other'"),
        ({"speeds": 1.0}, r"passes its end at km 11\.000 .* final speed of 0"),
        ({"condition": "other"}, "the map is of line 'other'"),
        ({"layer": "dry"}, "no layer 'dry'; layers present: wet"),
        ({"margin": -0.1}, r"speed: -0\.1 is negative"),
    ],
)
def test_what_cannot_be_followed_is_refused(changes, words):
    train, trajectory = plan()
    passing = replace(trajectory, speeds=trajectory.speeds + changes.get("speeds", 0.0))
    known = replace(map_of(WET), line=changes.get("condition", "hilly"))
    with pytest.raises(InputError, match=words):
        Follower(
            passing, changes.get("line", hilly_line()), changes.get("train", train),
            condition=known, layer=changes.get("layer", "wet"),
            margin=bounds.Margin(speed=changes.get("margin", 0.0)),
        )  # fmt: skip
