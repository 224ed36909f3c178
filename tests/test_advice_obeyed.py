"""Whoever obeys every row of the advice keeps the limits and arrives, with any configuration.

The trips are driven by `advised_driver`, which reads nothing but the table.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from advised_driver import driven, rows_of
from trajectory_cases import (
    FLIRT,
    FREIGHT,
    VIRM6,
    drawn,
    hilly_line,
    level_line,
    observed,
    optimised,
)

from analysis.trajectory.advice import journey_advice, limits_of, write_journey_advice
from analysis.trajectory.instructions import Phase
from trainlog.formats.railway import read_line
from trainlog.formats.samples import sample
from trainlog.railway import Configuration, Line, Train
from trainlog.units import KMH

ALLOWED = 0.5 / KMH
"""Speed over the limit that is counted as none [m/s]."""

LATE, SECONDS = 0.02, 10.0
"""How late a trip that obeys rounded speeds may be: a part of its time, and some seconds."""

TRAINS = {"flirt": FLIRT, "virm": VIRM6, "freight": FREIGHT}


def _line(name: str) -> Line:
    return hilly_line() if name == "hilly" else read_line(sample(f"{name}.line.json"))


def _configurations(train: Train) -> list[Configuration]:
    return [*observed(train, 0.85, 1.15), *drawn(train, 2, seed=3)]


LINES, RESERVES = ("hilly", "CH_StGallen_Wil", "DE_Chemnitz_Cranzahl"), (0.04, 0.12, 0.4)


def _cases() -> Iterator[Any]:
    """Every line, train and reserve; each pair of them once by default."""
    for line, name in enumerate(LINES):
        for number, train in enumerate(TRAINS):
            for row, reserve in enumerate(RESERVES):
                marks = () if (line + number + row) % 3 == 0 else pytest.mark.long
                yield pytest.param(name, train, reserve, marks=marks)


@pytest.mark.usefixtures("unrenewed")
@pytest.mark.parametrize(("name", "train", "reserve"), list(_cases()))
def test_no_row_leads_over_a_limit(name: str, train: str, reserve: float, tmp_path: Path) -> None:
    line, driver = _line(name), TRAINS[train]
    plan = optimised(line, driver, _configurations(driver), reserve=reserve, cells=100)
    write_journey_advice(journey_advice([plan], line), tmp_path / "advice.csv")
    rows = rows_of(tmp_path / "advice.csv")
    limits = limits_of(plan, line)
    for configuration in plan.configurations:
        places, speeds, time = driven(rows, line, driver, configuration)
        permitted = np.minimum(limits(places), driver.max_speed)
        over = speeds - permitted
        worst = int(np.argmax(over))
        words = f"{configuration.name}: {KMH * over[worst]:.2f} km/h over at {places[worst]:.0f} m"
        assert over[worst] <= ALLOWED, words
        assert abs(places[-1] - line.length) < 5.0
        assert speeds[-1] < 2.0, f"{configuration.name} comes to the stop at {speeds[-1]:.1f} m/s"
        assert time <= (1.0 + LATE) * plan.running_time + SECONDS, f"{time} {plan.running_time}"


def test_without_the_rows_that_brake_for_limits_they_are_exceeded(tmp_path: Path) -> None:
    """The driver of these tests sees no limit: what keeps it below are the rows alone."""
    line = hilly_line()
    plan = optimised(line, FLIRT, observed(FLIRT, 1.0, 1.1), reserve=0.04, cells=150)
    write_journey_advice(journey_advice([plan], line), tmp_path / "advice.csv")
    rows = rows_of(tmp_path / "advice.csv")
    assert any(row.words == "brake to 80 km/h by km 3.000" for row in rows)
    careless = [row for row in rows if "by km" not in row.words]
    places, speeds, _ = driven(careless, line, FLIRT, plan.configurations[0])
    over = speeds - line.speed_limits(places)
    assert over[(places > 3_000.0) & (places < 3_200.0)].max() > 10.0 * ALLOWED


def test_speeds_are_whole_rounded_down_and_below_each_limit_of_the_row() -> None:
    """57 mph are 91.7 km/h: the speed to hold is 91, and 90 where that is the limit ahead."""
    line = replace(
        level_line(12_000.0, (0.0, 120.0), (5_000.0, 57 * 1.609344), (8_000.0, 130.0)),
        name="miles",
    )
    plan = optimised(line, FLIRT, observed(FLIRT, 1.0, 1.1), reserve=0.03, cells=100)
    found = journey_advice([plan], line)
    for row in found.rows:
        point = row.instruction
        if point is None:
            continue
        assert KMH * point.target == pytest.approx(round(KMH * point.target), abs=1e-6)
        places = np.linspace(point.position, point.end - 1e-3, 200)
        limits = line.speed_limits(places)
        assert row.permitted == pytest.approx(limits[0])
        if point.phase is Phase.COASTING:
            continue
        # The target, and what is stated beside it of limits on the way.
        most = np.full(200, point.target)
        for cap in point.caps:
            inside = (places >= cap.start) & (places <= cap.end)
            most[inside] = np.minimum(most[inside], cap.speed)
        assert np.all(most <= limits + 1e-3) or point.phase > Phase.COASTING
    words = [row.words for row in found.rows]
    assert "brake to 91 km/h by km 5.000" in words
