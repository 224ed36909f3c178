"""What a trajectory has to keep to: limits, adhesion, stops, brakes, the file it is written to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
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
)

from trainlog.errors import InputError
from trainlog.formats.railway import read_trajectory, write_trajectory
from trainlog.railway import Configuration, Line, TrackConditionMap, Trajectory


@pytest.fixture(scope="module")
def set_of_twelve() -> Trajectory:
    return optimised(hilly_line(), FLIRT, drawn(FLIRT, 12, seed=1), reserve=0.1, cells=250)


@pytest.mark.usefixtures("unrenewed")
def test_every_configuration_keeps_the_limits(set_of_twelve: Trajectory) -> None:
    line, found = hilly_line(), set_of_twelve
    middle = 0.5 * (found.positions[1:] + found.positions[:-1])
    limit = line.speed_limit(middle)
    assert np.all(found.speeds[:, 1:] <= limit + 1e-5)
    assert np.all(found.speeds[:, :-1] <= limit + 1e-5)


def test_power_is_kept_at_both_ends_of_every_cell(set_of_twelve: Trajectory) -> None:
    found = set_of_twelve
    power = np.array([[c.max_power] for c in found.configurations])
    most, half = power * (1.0 + 1e-6), 0.5 * found.tractive_effort_fall
    assert np.all((found.tractive_effort + half) * found.speeds[:, :-1] <= most)
    assert np.all((found.tractive_effort - half) * found.speeds[:, 1:] <= most)


def test_all_the_power_is_used_inside_the_cells() -> None:
    """Traction that is constant in a cell would waste half of what the speed gains there."""
    train = Configuration.of(FLIRT)
    found = optimised(hilly_line(), FLIRT, [train], reserve=0.05, cells=120, tolerance=np.inf)
    middle = 0.5 * (found.positions[1:] + found.positions[:-1])
    speed = np.interp(middle, found.positions, found.speeds[0] ** 2) ** 0.5
    used = found.tractive_effort_at(middle) * speed / train.max_power
    gains = np.diff(found.speeds[0]) / np.maximum(found.speeds[0, :-1], 1.0)
    pulling = (used > 0.99) & (gains > 0.015)
    assert pulling.sum() >= 20
    assert used[pulling].max() <= 1.0
    assert np.all(1.0 - used[pulling] < 0.02 * gains[pulling])


def test_runs_from_standstill_to_standstill(set_of_twelve: Trajectory) -> None:
    found = set_of_twelve
    assert np.all(found.speeds[:, [0, -1]] == 0.0)
    assert np.all(np.isfinite(found.times))
    assert np.diff(found.positions)[0] < 1.0
    assert -5e-3 <= found.times[:, -1].max() - found.running_time <= 1e-4


def test_times_are_those_of_constant_acceleration(set_of_twelve: Trajectory) -> None:
    found = set_of_twelve
    step = np.diff(found.positions)
    times = 2.0 * step / (found.speeds[:, 1:] + found.speeds[:, :-1])
    assert np.diff(found.times, axis=1) == pytest.approx(times, rel=2e-3)


def test_few_configurations_decide(set_of_twelve: Trajectory) -> None:
    found = set_of_twelve
    active = found.certificate["active"]
    assert 1 <= len(active) <= 5
    alone = optimised(
        hilly_line(),
        FLIRT,
        [c for c in found.configurations if c.name in active],
        running_time=found.running_time,
        cells=250,
    )
    # Limits that all share, as the comfort of the lightest, are left out here: never costlier.
    assert alone.certificate["energy"] <= found.certificate["energy"] * (1.0 + 2e-5)
    assert found.certificate["gap"] <= 2e-3


def test_thirty_configurations_are_all_audited() -> None:
    found = optimised(hilly_line(), FLIRT, drawn(FLIRT, 30, seed=7), reserve=0.1, cells=200)
    assert len(found.certificate["audit"]["arrival"]) == 30
    assert found.certificate["audit"]["passed"]
    assert found.certificate["gap"] <= 2e-3
    assert len(found.certificate["phases"]) == 30
    assert {len(letters) for letters in found.certificate["phases"]} == {found.positions.size - 1}


def test_the_map_limits_the_efforts_where_it_was_observed() -> None:
    line = level_line(8_000.0, (0.0, 100.0))
    condition = slippery(line, (0.0, 400.0, 0.10), (7_800.0, 8_000.0, 0.06))
    found = optimised(
        line, FLIRT, observed(FLIRT, 1.0), running_time=420.0, condition_map=condition, cells=200
    )
    starting = found.positions[:-1] < 350.0
    cautious = 0.10 * np.exp(-0.1)
    assert found.tractive_effort[starting].max() == pytest.approx(
        cautious * FLIRT.adhesive_weight(), rel=1e-6
    )
    assert found.certificate["audit"]["adhesion"] <= 1.0 + 1e-6
    free = optimised(line, FLIRT, observed(FLIRT, 1.0), running_time=420.0, cells=200)
    assert free.certificate["energy"] < found.certificate["energy"]
    nothing = np.zeros(condition.bins, dtype=bool)
    blind = replace(condition, layers={"wet": replace(condition.layers["wet"], observed=nothing)})
    unaware = optimised(
        line, FLIRT, observed(FLIRT, 1.0), running_time=420.0, condition_map=blind, cells=200
    )
    assert np.array_equal(unaware.tractive_effort, free.tractive_effort)


def test_the_map_is_not_read_more_boldly_than_required() -> None:
    line = level_line(6_000.0, (0.0, 100.0))
    condition = slippery(line, (0.0, 400.0, 0.10))
    starts = [
        optimised(
            line, FLIRT, observed(FLIRT, 1.0), running_time=360.0, condition_map=condition,
            sigmas=sigmas, cells=120,
        ).tractive_effort[0]
        for sigmas in (0.0, 2.0, 4.0)
    ]  # fmt: skip
    assert starts[0] > starts[1] > starts[2]


def test_a_section_between_two_stations() -> None:
    line = hilly_line()
    found = optimised(
        line, FLIRT, observed(FLIRT, 1.0), start=line.stations[0].position,
        end=line.stations[1].position, cells=150,
    )  # fmt: skip
    assert found.positions[0] == 0.0
    assert found.positions[-1] == 5_000.0
    assert found.speeds[0, -1] == 0.0


def test_the_whole_train_keeps_the_limit_when_it_is_required_to() -> None:
    line = hilly_line()
    found = optimised(
        line, FLIRT, observed(FLIRT, 1.0), reserve=0.05, protected_length=FLIRT.length, cells=200
    )
    # Its tail is still in the lower limit for a train's length.
    behind = np.linspace(4_500.0, 4_500.0 + FLIRT.length, 50)
    assert found.speed_at(0, behind).max() <= 80.0 / KMH + 1e-5
    front = optimised(line, FLIRT, observed(FLIRT, 1.0), reserve=0.05, cells=200)
    assert front.certificate["least_time"][0] < found.certificate["least_time"][0]


def test_common_and_own_brakes_agree_for_one_configuration() -> None:
    options = {"running_time": 1541.0, "initial_speed": 1.0, "final_speed": 10.0, "cells": 150}
    energies = [
        optimised(level_line(), VIRM6, observed(VIRM6, 1.0), braking=braking, **options)  # type: ignore[arg-type]
        .certificate["energy"]
        for braking in ("recourse", "common")
    ]  # fmt: skip
    assert energies[0] == pytest.approx(energies[1], rel=1e-6)


def test_common_brakes_are_common_and_cost_no_less() -> None:
    options = {"running_time": 1541.0, "initial_speed": 1.0, "final_speed": 15.0, "cells": 150}
    configurations = observed(VIRM6, 0.97, 1.0, 1.03)
    common = optimised(level_line(), VIRM6, configurations, braking="common", **options)  # type: ignore[arg-type]
    own = optimised(level_line(), VIRM6, configurations, **options)  # type: ignore[arg-type]
    assert np.array_equal(common.braking_effort[0], common.braking_effort[2])
    assert np.all(common.speeds[:, -1] <= 15.0 + 1e-5)
    assert common.certificate["energy"] >= own.certificate["energy"] * (1.0 - 1e-6)


@pytest.mark.usefixtures("unrenewed")
def test_same_question_same_answer(tmp_path: Path) -> None:
    for name in ("a.json", "b.json"):
        found = optimised(hilly_line(), FLIRT, drawn(FLIRT, 3, seed=2), cells=100)
        write_trajectory(found, tmp_path / name)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    again = read_trajectory(tmp_path / "a.json")
    assert np.array_equal(again.speeds, found.speeds)
    assert again.certificate["gap"] == found.certificate["gap"]


def unreadable(line: Line) -> TrackConditionMap:
    """A map that marks a bin as observed and has no value there."""
    condition = slippery(line)
    layer = condition.layers["wet"]
    log_mean = layer.log_mean.copy()
    log_mean[5] = np.nan
    return replace(condition, layers={"wet": replace(layer, log_mean=log_mean)})


def test_a_limit_below_walking_pace_is_refused_before_any_solver_runs() -> None:
    line = level_line(8_000.0, (0.0, 80.0), (3_000.0, 0.04), (4_000.0, 80.0))
    with pytest.raises(InputError, match=r"0\.04 km/h permitted at km 3\.000 is not a speed"):
        optimised(line, FLIRT, observed(FLIRT, 1.0))


def test_expected_energy_is_least_for_the_weights_that_are_given() -> None:
    options = {"reserve": 0.1, "cells": 120}
    configurations = observed(FLIRT, 0.9, 1.0, 1.1)
    found = {
        weights: optimised(
            hilly_line(), FLIRT, configurations, objective="expected", weights=weights, **options
        )  # type: ignore[arg-type]
        for weights in ((), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    }
    energies = {key: np.array(each.certificate["line_energy"]) for key, each in found.items()}
    for weights, answer in found.items():
        share = np.array(weights or np.ones(3)) / (sum(weights) or 3.0)
        least = share @ energies[weights]
        assert answer.certificate["energy"] == pytest.approx(least)
        assert all(share @ other >= least * (1.0 - 1e-6) for other in energies.values())
        assert answer.certificate["gap"] <= 2e-3
        assert answer.certificate["audit"]["passed"]
    worst = optimised(hilly_line(), FLIRT, configurations, objective="line", **options)  # type: ignore[arg-type]
    assert worst.certificate["energy"] <= energies[()].max() * (1.0 + 1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"configurations": []}, "no parameter configuration"),
        ({"configurations": observed(FLIRT, 1.0, 1.0)}, "two configurations are called 'x1'"),
        ({"start": 5_000.0, "end": 4_000.0}, "is not a section"),
        ({"end": 9_000.0}, "is not a section"),
        ({"initial_speed": -1.0}, "must be finite and not negative"),
        ({"initial_speed": 30.0}, "above the 90.0 km/h permitted"),
        ({"braking": "none"}, "no such braking 'none'"),
        ({"objective": "time"}, "objective 'time'"),
        ({"cells": 3}, "must have 20 to 20000 cells, not 3; give"),
        ({"cells": 10**8}, "must have 20 to 20000 cells"),
        ({"reserve": -0.1}, "the reserve must be 0 to 500%, not -10%"),
        ({"reserve": 7.0}, "the reserve must be 0 to 500%, not 700%"),
        ({"reserve": np.nan}, "the reserve must be 0 to 500%, not nan%"),
        ({"running_time": np.nan}, "running time must be above 0 and finite, not nan s"),
        ({"running_time": np.inf}, "running time must be above 0 and finite, not inf s"),
        ({"running_time": -5.0}, "not -5.0 s; give the timetable's"),
        ({"condition_map": slippery(level_line(5_000.0))}, "is of line '"),
        (
            {"condition_map": replace(slippery(hilly_line()), length=5_000.0)},
            "belongs to a line of 5.000 km",
        ),
        ({"condition_map": slippery(hilly_line()), "layer": "icy"}, "no layer 'icy'"),
        (
            {"condition_map": slippery(hilly_line()), "sigmas": np.nan},
            "map must be 0 or more, not nan",
        ),
        (
            {"condition_map": slippery(hilly_line()), "sigmas": -2.0},
            "map must be 0 or more, not -2.0",
        ),
        ({"condition_map": unreadable(hilly_line())}, r"has no adhesion at km 0\.\d+, which it"),
        ({"protected_length": -1.0}, "the protected length must be 0 or more, not -1.0 m"),
        ({"running_time": 1e9}, r"is 3\.\d+e\+06 times the least, .*let it wait at a station"),
        ({"objective": "expected", "weights": [1.0, 2.0]}, "2 weights for 1 configuration"),
        ({"objective": "expected", "weights": [-1.0]}, "must be 0 or more, not -1"),
        ({"objective": "expected", "weights": [0.0]}, "the weights add up to 0"),
    ],
)
def test_bad_input_is_refused(changes: dict[str, object], words: str) -> None:
    question: dict[str, object] = {"configurations": observed(FLIRT, 1.0), **changes}
    refused(InputError, words, optimised, hilly_line(), FLIRT, **question)
