"""Problems without a solution are explained with figures, and the figures are right."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from trajectory_cases import (
    FLIRT,
    KMH,
    VIRM6,
    hilly_line,
    level_line,
    observed,
    optimised,
    slippery,
    steps,
)

from analysis.trajectory.convex import NoSolutionError, Relaxation
from analysis.trajectory.feasibility import UnprovenError
from trainlog.errors import InfeasibleError, InputError
from trainlog.railway import Configuration, RunningResistance, TimingPoint

pytestmark = pytest.mark.usefixtures("unrenewed")


def reported(words: str, error: pytest.ExceptionInfo[InfeasibleError]) -> float:
    found = re.search(words, str(error.value))
    assert found is not None, str(error.value)
    return float(found.group(1))


def test_too_little_time_names_the_slowest_and_what_is_missing() -> None:
    with pytest.raises(InfeasibleError, match=r"configuration 'x1\.1' needs at least") as error:
        optimised(hilly_line(), FLIRT, observed(FLIRT, 0.9, 1.0, 1.1), running_time=200.0)
    least = reported(r"at least (\d+\.\d) s", error)
    missing = reported(r"(\d+\.\d) s are missing", error)
    assert least == pytest.approx(200.0 + missing, abs=0.11)
    found = optimised(
        hilly_line(), FLIRT, observed(FLIRT, 0.9, 1.0, 1.1), running_time=1.01 * least
    )
    assert found.certificate["audit"]["passed"]


def test_trains_too_different_for_one_brake_are_refused_whatever_the_time() -> None:
    """No time helps, and the refusal does not ask for more: the relaxation proves it."""
    run = level_line(40_000.0, (0.0, 120.0), (20_000.0, 60.0)), FLIRT, observed(FLIRT, 0.5, 1.5)
    for reserve in (0.1, 1.5):
        with pytest.raises(InfeasibleError, match="whatever the time") as error:
            optimised(*run, braking="common", final_speed=8.0, reserve=reserve, cells=60)
        assert "allow" not in str(error.value)
    found = optimised(*run, final_speed=8.0, reserve=0.1, cells=60)
    assert found.certificate["audit"]["passed"]


def test_a_moment_too_little_is_not_reported_as_nothing() -> None:
    run = hilly_line(), FLIRT, observed(FLIRT, 1.0)
    least = optimised(*run, reserve=0.1, cells=60).certificate["least_time"][0]
    with pytest.raises(InfeasibleError, match=r", 0\.0[34] s are missing"):
        optimised(*run, running_time=least - 0.034)


def test_the_least_time_of_free_traction_cannot_be_met_on_cells() -> None:
    fastest = optimised(hilly_line(), FLIRT, observed(FLIRT, 1.0), reserve=0.0, cells=80)
    alone = fastest.certificate["least_time"][0]
    with pytest.raises(InfeasibleError, match="under one common traction"):
        optimised(
            hilly_line(), FLIRT, observed(FLIRT, 1.0), running_time=alone * (1.0 + 1e-9), cells=80
        )
    # No reserve at all asks for the least time that there is on the cells.
    assert alone < fastest.running_time < 1.005 * alone


def test_common_brakes_cannot_stop_them_all_and_say_how_slow_they_can() -> None:
    options = {"running_time": 1541.0, "initial_speed": 1.0, "braking": "common", "cells": 50}
    configurations = observed(VIRM6, 0.97, 1.0, 1.03)
    with pytest.raises(InfeasibleError, match="with one braking effort for all") as error:
        optimised(level_line(), VIRM6, configurations, final_speed=0.0, **options)  # type: ignore[arg-type]
    assert not isinstance(error.value, UnprovenError)
    reachable = reported(r"the lowest speed found is (\d+\.\d) km/h", error) / KMH
    assert 5.0 < reachable < 10.0
    with pytest.raises(InfeasibleError):
        optimised(level_line(), VIRM6, configurations, final_speed=reachable - 0.3, **options)  # type: ignore[arg-type]
    found = optimised(level_line(), VIRM6, configurations, final_speed=reachable + 0.1, **options)  # type: ignore[arg-type]
    assert found.certificate["audit"]["passed"]
    own = optimised(
        level_line(), VIRM6, configurations, running_time=1541.0, initial_speed=1.0, cells=50
    )
    assert own.speeds[:, -1].max() == 0.0


def test_a_time_that_no_solver_found_is_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The speed at the end is proven out of reach; that more time would help is not."""
    least_time = Relaxation.least_time

    def without_end(relaxation: Relaxation) -> float:
        if relaxation.problem.final > 1.0:
            raise NoSolutionError("user_limit")
        return least_time(relaxation)

    monkeypatch.setattr(Relaxation, "least_time", without_end)
    with pytest.raises(InfeasibleError, match=r"cannot all end at 0\.0 km/h") as error:
        optimised(
            level_line(), VIRM6, observed(VIRM6, 0.97, 1.0, 1.03), running_time=1541.0,
            initial_speed=1.0, final_speed=0.0, braking="common", cells=50,
        )  # fmt: skip
    assert "inf" not in str(error.value)


def test_a_slope_too_steep_for_the_load() -> None:
    line = replace(level_line(5_000.0), gradients=steps((0.0, 0.0), (2_000.0, 0.15)))
    with pytest.raises(InfeasibleError, match=r"comes to a stand at km 2\.\d+: full traction"):
        optimised(line, FLIRT, observed(FLIRT, 1.0, load=400_000.0))


def test_a_slope_too_steep_for_the_brake() -> None:
    line = replace(level_line(5_000.0), gradients=steps((0.0, 0.0), (2_000.0, -0.19)))
    with pytest.raises(InfeasibleError, match="cannot brake on the slope"):
        optimised(line, FLIRT, observed(FLIRT, 1.0))


def test_a_rail_too_slippery_to_climb() -> None:
    line = replace(level_line(5_000.0), gradients=steps((0.0, 0.03)))
    with pytest.raises(InfeasibleError, match="comes to a stand"):
        optimised(
            line, FLIRT, observed(FLIRT, 1.0),
            condition_map=slippery(line, (0.0, 5_000.0, 0.03)),
        )  # fmt: skip


def test_a_start_too_fast_to_stop() -> None:
    with pytest.raises(
        InfeasibleError, match=r"starts at 72\.0 km/h and cannot brake in time"
    ) as e:
        optimised(level_line(1_000.0), FLIRT, observed(FLIRT, 1.0), start=900.0, initial_speed=20.0)
    limit = reported(r"at most (\d+\.\d) km/h", e) / KMH
    assert limit == pytest.approx((2.0 * 1.1 * 100.0) ** 0.5, rel=0.03)


def test_too_little_time_names_the_section_and_what_holds_the_train_back() -> None:
    """On an even line under a low limit it is the limit; without one it is the power."""
    slow, fast = level_line(20_000.0, (0.0, 60.0)), level_line(20_000.0, (0.0, 900.0))
    train = replace(FLIRT, max_speed=900.0 / KMH)
    for line, words in (
        (slow, "9\\d % of the time at the limits or the train's own top speed"),
        (fast, "at full power"),
    ):
        with pytest.raises(InfeasibleError, match=words) as error:
            optimised(line, train, observed(train, 1.0), running_time=100.0)
        assert "from km 0.000 (A) to km 20.000 (B)" in str(error.value)
        assert "100.0 s (1:40 min)" in str(error.value)


def test_a_slippery_rail_is_named_where_it_holds_the_train_back() -> None:
    line = level_line(5_000.0, (0.0, 140.0))
    with pytest.raises(InfeasibleError, match=r"\d+ % (of the time )?at the adhesion of the map"):
        optimised(
            line, FLIRT, observed(FLIRT, 1.0), running_time=100.0,
            condition_map=slippery(line, (0.0, 5_000.0, 0.05)),
        )  # fmt: skip


def test_two_windows_that_cannot_both_be_kept_are_reported_together() -> None:
    windows = [TimingPoint(3_000.0, earliest=200.0), TimingPoint(6_000.0, latest=230.0)]
    with pytest.raises(
        InfeasibleError, match=r"needs at least \d+\.\d s from km 3\.000 to km 6\.000"
    ):
        optimised(hilly_line(), FLIRT, observed(FLIRT, 1.0), running_time=450.0, windows=windows)


def test_a_speed_above_the_limit_at_a_passing_point_names_the_limit() -> None:
    windows = [TimingPoint(4_000.0, lowest_speed=30.0)]
    with pytest.raises(InfeasibleError, match=r"the limit is the 80 km/h permitted there"):
        optimised(hilly_line(), FLIRT, observed(FLIRT, 1.0), running_time=450.0, windows=windows)


def test_a_resistance_that_falls_with_the_speed_is_refused() -> None:
    own = FLIRT.resistance
    for resistance, name in (
        (RunningResistance(own.r0, -100.0, 30.0), "r1 = -100"),
        (RunningResistance(own.r0, 200.0, -0.5), "r2 = -0.5"),
    ):
        odd = replace(Configuration.of(FLIRT, name="odd"), resistance=resistance)
        with pytest.raises(InputError, match=f"'odd' has a negative part, {name}"):
            optimised(hilly_line(), FLIRT, [odd])


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ((1.0,), "1 weight for 2 configurations"),
        ((1.0, -1.0), "configuration 'x1.1' must be 0 or more, not -1"),
        ((0.0, 0.0), "the weights add up to 0"),
        ((1.0, float("nan")), "configuration 'x1.1' must be 0 or more, not nan"),
    ],
)
def test_weights_that_are_none_are_refused(weights: tuple[float, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        optimised(
            hilly_line(), FLIRT, observed(FLIRT, 1.0, 1.1), weights=weights, objective="expected"
        )


def test_a_timetable_that_would_make_it_stand_on_the_way_is_refused() -> None:
    with pytest.raises(InputError, match=r"is 2\d\.\d times the least, .* from km 0\.000 \(A\)"):
        optimised(hilly_line(), FLIRT, observed(FLIRT, 1.0), running_time=8_000.0)
