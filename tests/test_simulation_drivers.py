"""Drivers keep limits, stop where they should, and are roughly on time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from simulated_line import flirt, hilly_line, level_line, steps

from trainlog.errors import InfeasibleError, InputError
from trainlog.railway.motion import timetable_run
from trainlog.simulation import Run, Scenario, draw_scenarios, drive
from trainlog.simulation.drivers import Habits, Stop, TimetableDriver, plan


def journey(line=None, adhesion: float = 0.3, **changes: object) -> Scenario:
    line = line or hilly_line()
    train = flirt()
    known: dict[str, object] = {
        "name": "journey",
        "line": line,
        "train": train,
        "direction": "forward",
        "weather": "dry",
        "mass": train.mass + 10_000.0,
        "rotating_mass": train.rotating_mass,
        "resistance": train.resistance,
        "max_power": train.max_traction_power,
        "maximum_adhesion": steps((0.0, adhesion)),
        "stops": plan(line, train, line.stations),
    }
    return Scenario(**{**known, **changes})  # type: ignore[arg-type]


def columns(scenario: Scenario, run: Run) -> dict[str, np.ndarray]:
    return dict(zip(scenario.plant().columns, run.samples.T, strict=True))


def stands(found: dict[str, np.ndarray]) -> np.ndarray:
    """Positions at which the train stood."""
    return np.unique(found["position"][found["speed"] == 0.0])


@settings(max_examples=8)
@given(
    lever=st.floats(0.4, 1.0),
    margin=st.floats(0.2, 1.5),
    deceleration=st.floats(0.4, 0.8),
    reaction=st.floats(0.2, 1.2),
    coasting=st.floats(0.0, 4.0),
    load=st.floats(0.0, 20_000.0),
)
def test_timetable_driver_keeps_limits_and_stops(
    lever: float, margin: float, deceleration: float, reaction: float, coasting: float, load: float
) -> None:
    habits = Habits(
        lever=lever,
        margin=margin,
        deceleration=deceleration,
        reaction=reaction,
        coasting=coasting,
    )
    scenario = journey(habits=habits, mass=122_000.0 + load)
    found = columns(scenario, drive(scenario))
    limit = scenario.line.limits_over(scenario.train.length)(found["position"])
    assert np.max(found["speed"] - limit) <= 1.0 / 3.6
    wanted = [station.position for station in scenario.line.stations]
    np.testing.assert_allclose(stands(found), wanted, atol=1.5)


def test_timetable_driver_waits_and_is_roughly_on_time() -> None:
    scenario = journey()
    run = drive(scenario)
    found = columns(scenario, run)
    for stop in scenario.stops[1:-1]:
        standing = run.seconds[
            (found["speed"] == 0.0) & (np.abs(found["position"] - stop.position) < 2.0)
        ]
        assert standing[-1] - standing[0] >= scenario.habits.dwell
        assert standing[-1] >= stop.departure - 0.2
        assert abs(standing[0] - stop.arrival) < 40.0


def test_a_train_that_cannot_climb_is_refused() -> None:
    line = replace(hilly_line(), gradients=steps((0.0, 0.0), (3_000.0, 0.06)))
    refused(InfeasibleError, "does not arrive; at km 3", drive, journey(line, adhesion=0.05))


def test_running_time_of_a_level_run() -> None:
    """Constant acceleration, cruising and braking in closed form."""
    train = replace(flirt(), max_traction_power=1e9, max_tractive_effort=100e3, length=0.0)
    train = replace(train, resistance=type(train.resistance)(0.0, 0.0, 0.0))
    line = level_line(length=10_000.0, limit=25.0)
    a, b = 100e3 / (train.mass + train.rotating_mass), 0.5
    expected = 25.0 / a + 25.0 / b + (10_000.0 - 25.0**2 / (2 * a) - 25.0**2 / (2 * b)) / 25.0
    found = timetable_run(line, train, 0.0, 10_000.0, deceleration=b, lever=1.0).running_time
    assert found == pytest.approx(expected, rel=2e-3)


@given(
    starts=st.lists(st.floats(0.1, 11e3), min_size=1, max_size=6, unique=True),
    length=st.floats(0.1, 700.0),
)
def test_a_restriction_ends_where_the_rear_has_passed_it(
    starts: list[float], length: float
) -> None:
    edges = [0.0, *sorted(starts)]
    speeds = [20.0 + 3.0 * (k * 7 % 5) for k in range(len(edges))]
    line = replace(level_line(length=12e3), speed_limits=steps(*zip(edges, speeds, strict=True)))
    found = line.limits_over(length)
    for front in np.linspace(1.0, 11.9e3, 37):
        if min(abs(front - np.array([*edges, *(e + length for e in edges)]))) > 1e-6:
            under = np.linspace(max(front - length, 0.0), front, 2000)
            places = np.append(under, [e for e in edges if front - length < e <= front])
            assert found(front) == line.speed_limit(places).min()


@pytest.mark.parametrize(
    ("stops", "message"),
    [
        ((Stop("A", 0.0, 0.0, 5.0),), "two stops at least"),
        ((Stop("A", 0.0, 0.0, 5.0), Stop("Z", 12e3, 500.0, 500.0)), "'Z' at km 12.000 lies"),
        ((Stop("A", 0.0, 0.0, 5.0), Stop("B", 4e3, 300.0, 200.0)), "departure is before arrival"),
        ((Stop("A", 4e3, 0.0, 5.0), Stop("B", 0.0, 300.0, 300.0)), "order of travel"),
        ((Stop("A", 0.0, 0.0, 90.0), Stop("B", 4e3, 80.0, 100.0)), "order of travel"),
    ],
)
def test_impossible_stops_are_refused(stops: tuple[Stop, ...], message: str) -> None:
    refused(InputError, message, TimetableDriver, hilly_line(), flirt(), stops)


def test_a_train_that_cannot_brake_is_not_driven() -> None:
    train = replace(flirt(), max_dynamic_braking_effort=0.0, max_pneumatic_braking_effort=0.0)
    refused(InputError, "has no brake", draw_scenarios, hilly_line(), train, count=1)
