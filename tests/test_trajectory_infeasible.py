"""Problems without a solution are explained with figures, and the figures are right."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from trajectory_world import FLIRT, KMH, VIRM6, hilly_line, level_line, observed, slippery, steps

from analysis.trajectory import optimise
from trainlog.errors import InfeasibleError


def told(words: str, error: pytest.ExceptionInfo[InfeasibleError]) -> float:
    found = re.search(words, str(error.value))
    assert found is not None, str(error.value)
    return float(found.group(1))


def test_too_little_time_names_the_slowest_and_what_is_missing() -> None:
    with pytest.raises(InfeasibleError, match=r"configuration 'x1\.1' needs at least") as error:
        optimise(hilly_line(), FLIRT, observed(FLIRT, 0.9, 1.0, 1.1), running_time=200.0)
    least = told(r"at least (\d+\.\d) s", error)
    missing = told(r"(\d+\.\d) s are missing", error)
    assert least == pytest.approx(200.0 + missing, abs=0.11)
    found = optimise(hilly_line(), FLIRT, observed(FLIRT, 0.9, 1.0, 1.1), running_time=1.01 * least)
    assert found.certificate["audit"]["passed"]


def test_the_least_time_cannot_be_met_on_cells_and_is_told_from_the_relaxation() -> None:
    with pytest.raises(InfeasibleError, match="under one common traction") as error:
        optimise(hilly_line(), FLIRT, observed(FLIRT, 1.0), reserve=0.0, cells=200)
    least = told(r"at least (\d+\.\d) s", error)
    found = optimise(
        hilly_line(), FLIRT, observed(FLIRT, 1.0), running_time=1.004 * least, cells=200
    )
    assert found.certificate["least_time"][0] < least + 0.1


def test_common_brakes_cannot_stop_them_all_and_say_how_slow_they_can() -> None:
    options = {"running_time": 1541.0, "initial_speed": 1.0, "braking": "common", "cells": 150}
    configurations = observed(VIRM6, 0.97, 1.0, 1.03)
    with pytest.raises(InfeasibleError, match="with one braking effort for all") as error:
        optimise(level_line(), VIRM6, configurations, final_speed=0.0, **options)  # type: ignore[arg-type]
    reachable = told(r"cannot all end below (\d+\.\d) km/h", error) / KMH
    assert 5.0 < reachable < 10.0
    with pytest.raises(InfeasibleError):
        optimise(level_line(), VIRM6, configurations, final_speed=reachable - 0.3, **options)  # type: ignore[arg-type]
    found = optimise(level_line(), VIRM6, configurations, final_speed=reachable + 0.1, **options)  # type: ignore[arg-type]
    assert found.certificate["audit"]["passed"]
    own = optimise(
        level_line(), VIRM6, configurations, running_time=1541.0, initial_speed=1.0, cells=150
    )
    assert own.speeds[:, -1].max() == 0.0


def test_a_slope_too_steep_for_the_load() -> None:
    line = replace(level_line(5_000.0), gradients=steps((0.0, 0.0), (2_000.0, 0.15)))
    with pytest.raises(InfeasibleError, match=r"comes to a stand at km 2\.\d+: full traction"):
        optimise(line, FLIRT, observed(FLIRT, 1.0, load=400_000.0))


def test_a_slope_too_steep_for_the_brake() -> None:
    line = replace(level_line(5_000.0), gradients=steps((0.0, 0.0), (2_000.0, -0.19)))
    with pytest.raises(InfeasibleError, match="cannot brake on the slope"):
        optimise(line, FLIRT, observed(FLIRT, 1.0))


def test_a_rail_too_slippery_to_climb() -> None:
    line = replace(level_line(5_000.0), gradients=steps((0.0, 0.03)))
    with pytest.raises(InfeasibleError, match="comes to a stand"):
        optimise(
            line, FLIRT, observed(FLIRT, 1.0),
            condition_map=slippery(line, (0.0, 5_000.0, 0.03)),
        )  # fmt: skip


def test_a_start_too_fast_to_stop() -> None:
    with pytest.raises(
        InfeasibleError, match=r"starts at 72\.0 km/h and cannot brake in time"
    ) as e:
        optimise(level_line(1_000.0), FLIRT, observed(FLIRT, 1.0), start=900.0, initial_speed=20.0)
    limit = told(r"at most (\d+\.\d) km/h", e) / KMH
    assert limit == pytest.approx((2.0 * 1.1 * 100.0) ** 0.5, rel=0.03)
