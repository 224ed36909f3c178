"""Advice to a driver for a whole journey: stations, times in the clock of the timetable, places."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from refusals import refused

from analysis.reports.results import write_driver_advice
from analysis.trajectory.advice import journey_advice, time_of_day, with_times
from analysis.trajectory.instructions import Cap, Instruction, Phase
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from trainlog.errors import InputError
from trainlog.formats.railway import (
    line_of_plan,
    line_to_bytes,
    read_line,
    read_train,
    read_trajectory,
    write_trajectory,
)
from trainlog.formats.samples import sample
from trainlog.railway import Configuration, Line, Trajectory

pytestmark = pytest.mark.usefixtures("unrenewed")

DWELL = 45.0


@pytest.fixture(scope="module")
def line() -> Line:
    return read_line(sample("CH_StGallen_Wil.line.json"))


@pytest.fixture(scope="module")
def sections(line: Line) -> tuple[Trajectory, ...]:
    """Against the chainage, from Wil to Uzwil and past Flawil to Gossau; two configurations."""
    train = read_train(sample("CH_Stadler_FLIRT_TPF.train.json"))
    back = line.reversed()
    ends = [back.stations[number].position for number in (0, 1, 3)]
    found = [
        optimise(
            TrajectoryProblem(
                back,
                train,
                [Configuration.of(train), replace(Configuration.of(train, 20e3), name="laden")],
                start=start,
                end=end,
                reserve=0.1,
                direction="reverse",
            ),
            OptimiserOptions(cells=60),
        )
        for start, end in pairwise(ends)
    ]
    starts = [0.0, found[0].running_time + DWELL]
    return with_times(found, starts, "S1")


def test_the_rows_are_a_timetable_in_the_clock_that_is_asked_for(sections, line):
    found = journey_advice(sections[::-1], line.reversed(), start=time_of_day("23:58"))
    assert [(row.event, row.station) for row in found.rows if row.event != "changes"] == [
        ("departs", "Wil"),
        ("arrives", "Uzwil"),
        ("departs", "Uzwil"),
        ("passes", "Flawil"),
        ("arrives", "Gossau SG"),
    ]
    times = [row.time for row in found.rows]
    assert times == sorted(times)
    assert found.time(times[0]) == "23:58:00"
    # Past midnight the clock begins anew.
    assert found.time(times[-1]).startswith("00:1")
    departs = [row.time for row in found.rows if row.event == "departs"]
    arrives = [row.timetable for row in found.rows if row.event == "arrives"]
    assert departs[1] - (arrives[0] or 0.0) == pytest.approx(DWELL)
    # Nobody is later than the timetable.
    for row in found.rows:
        assert row.timetable is None or row.time <= row.timetable + 0.1


def test_places_are_the_operators_and_named_in_the_direction_of_travel(sections, line):
    back = line.reversed()
    found = journey_advice(sections, back)
    stations = np.array([each.position for each in back.stations])
    for row in found.rows:
        assert row.place.startswith("at ") == (np.abs(stations - row.position).min() < 50.0)
        assert row.km == pytest.approx(float(back.kilometre(row.position)) / 1e3)
        before = re.fullmatch(r"([\d.]+) km (before|after) (.+)", row.place)
        if before is None:
            continue
        station = next(each for each in back.stations if each.name == before[3])
        ahead = station.position - row.position
        assert (ahead > 0.0) == (before[2] == "before")
        assert abs(ahead) / 1e3 == pytest.approx(float(before[1]), abs=0.051)


def test_the_advice_is_what_the_plan_does(sections, line):
    found = journey_advice(sections, line.reversed())
    for section, departure in zip(sections, found.departures.tolist(), strict=True):
        row = section.latest
        inside = [
            each
            for each in found.rows
            if each.event in ("changes", "passes")
            and section.positions[0] <= each.position < section.positions[-1]
        ]
        assert len(inside) > 2
        for each in inside:
            time = departure + np.interp(each.position, section.positions, section.times[row])
            assert each.time == pytest.approx(time)
            speed = np.interp(each.position, section.positions, section.speeds[row])
            assert each.speed == pytest.approx(speed)
        assert inside[0].words.startswith("full traction to")
        assert inside[-1].words == "brake to a stand"


def test_a_coast_does_not_end_above_the_speed_that_it_allows():
    ends, allowed = 115.6 / 3.6, 115.0 / 3.6
    coast = Instruction(
        42_000.0, 44_798.0, 34.0, ends, Phase.COASTING, False, ends, ends, 34.0,
        44_798.0, (34.0, ends), (Cap(allowed, 44_798.0, 44_798.0),),
    )  # fmt: skip
    words = "coast to km 44.798: speed falls to at most 115 km/h"
    assert coast.words() == words
    assert "falls to 116 km/h" in replace(coast, caps=()).words()


def test_page_and_table_state_the_same(sections, tmp_path, works):
    files = [tmp_path / f"plan-{number}.json" for number in (1, 2)]
    for section, file in zip(sections, files, strict=True):
        write_trajectory(section, file)
    output = tmp_path / "advice.html"
    words = ("advice", *files, "--departure", "07:12", "-o", output)
    printed = works(*words)
    with output.with_suffix(".csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        *("event", "km", "station", "place", "time", "seconds", "timetable", "speed_kmh"),
        *("permitted_kmh", "advice", "target_kmh", "to_km", "lowest_kmh", "highest_kmh"),
    ]
    text = output.read_text("utf-8")
    for row in rows:
        assert row["time"] in text
        assert row["km"] in text
        assert row["advice"] in text or row["event"] == "passes"
        assert row["time"] in printed
        stated = re.search(
            r"(?:hold|(?:falls|rises) to(?: at most)?|traction to|brake to) (\d+) km/h$",
            row["advice"],
        )
        assert stated is None or row["target_kmh"] == stated[1]
    assert sum(row["advice"].startswith("coast") for row in rows) > 1
    assert rows[0]["station"] == "Wil"
    assert rows[0]["time"] == "07:12:00"
    first = output.read_bytes()
    works(*words)
    assert output.read_bytes() == first


def test_sections_that_do_not_follow_each_other_are_refused(sections, line, tmp_path):
    back = line.reversed()
    refused(InputError, "the next begins at km", journey_advice, [sections[0], sections[0]], back)
    other = replace(sections[1], train="another")
    refused(InputError, "are not of one journey", journey_advice, [sections[0], other], back)
    early = with_times(sections, [0.0, 10.0], "S1")
    refused(InputError, "departs before the one before arrives", journey_advice, early, back)
    for word in ("25:00", "7", "07:61", "noon"):
        refused(InputError, "is not a valid time of day", time_of_day, word)
    (tmp_path / "plan.json").write_text('{"format": "trainlog/line"}')
    with pytest.raises(InputError, match=r"plan\.json"):
        write_driver_advice([tmp_path / "plan.json"], tmp_path / "a.html", tmp_path / "a.csv")
    assert [each.name for each in tmp_path.iterdir()] == ["plan.json"]


def test_sections_planned_one_by_one_stand_as_long_as_is_asked_for(sections, line, tmp_path):
    unaware = [replace(each, provenance={}) for each in sections]
    found = journey_advice(unaware, line.reversed(), dwell=60.0)
    assert found.departures[1] == pytest.approx(sections[0].running_time + 60.0)
    refused(InputError, r"does not hold its line .*--line", journey_advice, unaware)
    # A file keeps when its section departs.
    write_trajectory(sections[1], tmp_path / "plan.json")
    kept = read_trajectory(tmp_path / "plan.json").provenance["journey"]["departure"]
    assert kept == pytest.approx(sections[0].running_time + DWELL)


def test_a_plan_on_any_line_knows_its_stations_and_limits_without_the_lines_file(
    sections, line, tmp_path, shell
):
    """Of a line that is not among the samples."""
    named = replace(line.reversed(), name="elsewhere")
    train = read_train(sample("CH_Stadler_FLIRT_TPF.train.json"))
    problem = TrajectoryProblem(
        named, train, [Configuration.of(train)], end=9_469.4, direction="reverse"
    )
    plan = optimise(problem, OptimiserOptions(cells=60))
    write_trajectory(plan, tmp_path / "plan.json")
    kept = line_of_plan(read_trajectory(tmp_path / "plan.json"))
    assert line_to_bytes(kept) == line_to_bytes(named)
    words = ("advice", tmp_path / "plan.json", "-o", tmp_path / "advice.html")
    assert shell(*words)[0] == 0
    with (tmp_path / "advice.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert (rows[0]["station"], rows[-1]["station"]) == ("Wil", "Uzwil")
    assert all(row["permitted_kmh"] for row in rows if row["event"] == "changes")


def test_the_table_of_another_command_is_not_overwritten(sections, tmp_path):
    plan, table = tmp_path / "plan.json", tmp_path / "plan.csv"
    write_trajectory(sections[0], plan)
    table.write_text("km,speed\n0.0,0.0\n")
    before = table.read_bytes()
    with pytest.raises(InputError, match=r"plan\.csv.*is not a table of advice"):
        write_driver_advice([plan], tmp_path / "plan.html", table)
    assert table.read_bytes() == before
    assert not (tmp_path / "plan.html").exists()
    for _ in range(2):
        write_driver_advice([plan], tmp_path / "advice.html", tmp_path / "advice.csv")
