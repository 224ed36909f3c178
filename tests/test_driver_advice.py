"""Advice to a driver: phases and energy, stations, times in the clock of the timetable, places."""

import csv
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from trajectory_cases import FLIRT, hilly_line, level_line, observed, optimised, slippery

from analysis import OptimiserOptions, TrajectoryProblem, energy_against_time, journey_advice
from analysis.reports.results import write_driver_advice
from analysis.trajectory.advice import time_of_day, with_advice, with_times
from analysis.trajectory.instructions import LETTERS, Cap, Instruction, Phase, _Plan, instructions
from trainlog import frame_of, read_line, read_trajectory, sample, write_trajectory
from trainlog.errors import InfeasibleError, InputError
from trainlog.formats.railway import line_of_plan, line_to_bytes
from trainlog.formats.samples import DEFAULT_LINE
from trainlog.mcap import read_log, write_log
from trainlog.railway import Configuration, Line, StepProfile, Trajectory
from trainlog.topics import ESTIMATED_STATE
from trainlog.units import KMH

pytestmark = pytest.mark.usefixtures("unrenewed")

DWELL = 45.0


@pytest.fixture(scope="module")
def line() -> Line:
    """Of a name that no file has: its stations and limits are those that plans hold."""
    return replace(read_line(sample(DEFAULT_LINE)), name="elsewhere")


@pytest.fixture(scope="module")
def sections(line: Line) -> tuple[Trajectory, ...]:
    """Against the chainage, from Wil to Uzwil and past Flawil to Gossau; two configurations."""
    loads = [Configuration.of(FLIRT), replace(Configuration.of(FLIRT, 20e3), name="laden")]
    back, asked = line.reversed(), {"reserve": 0.1, "direction": "reverse", "cells": 60}
    ends = [back.stations[number].position for number in (0, 1, 3)]
    found = [optimised(back, FLIRT, loads, start=a, end=b, **asked) for a, b in pairwise(ends)]
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


def test_page_and_table_state_the_same(sections, line, tmp_path, works):
    files = [tmp_path / f"plan-{number}.json" for number in (1, 2)]
    for section, file in zip(sections, files, strict=True):
        write_trajectory(section, file)
        kept = line_of_plan(read_trajectory(file))
        assert line_to_bytes(kept) == line_to_bytes(line.reversed())
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
    assert all(row["permitted_kmh"] for row in rows if row["event"] == "changes")
    assert (rows[0]["station"], rows[-1]["station"]) == ("Wil", "Gossau SG")
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


@pytest.fixture(scope="module")
def hilly() -> Trajectory:
    return optimised(configurations=observed(FLIRT, 0.95, 1.0, 1.05), reserve=0.1, cells=200)


@pytest.fixture(scope="module")
def sampled() -> Trajectory:
    line = read_line(sample(DEFAULT_LINE))
    return optimised(line, FLIRT, [Configuration.of(FLIRT)], reserve=0.1, cells=100)


def test_advice_begins_with_traction_ends_with_braking_and_never_repeats(hilly):
    points = instructions(hilly, hilly_line().speed_limits)
    assert (points[0].position, points[0].phase) == (0.0, Phase.MAXIMUM_TRACTION)
    assert points[-1].phase is Phase.MAXIMUM_BRAKING
    assert points[-1].until == 0.0
    for before, point in pairwise(points):
        assert before.end == point.position
        assert before.words() != point.words()
        assert before.until == point.speed


def test_advice_goes_with_the_chainage_of_satellites(sampled):
    trip = read_log(sample("nonstop.mcap"))
    state = trip["/train/state"]
    known = {"position": state["position"].to_numpy()}
    found = frame_of(ESTIMATED_STATE, pd.DatetimeIndex(state.index), known)
    without = state.assign(position=np.nan)
    without.attrs = state.attrs
    located = with_advice(trip.with_topic(without).with_topic(found), sampled)
    recorded = with_advice(trip, sampled)["/reference"]
    pd.testing.assert_frame_equal(located["/reference"], recorded)


BRAKES = {"H": 30e3, "B": 60e3}


def _with_phases(letters: str, speeds: Sequence[float]) -> Trajectory:
    """A trajectory of given phases, 20 s a cell; speeds in km/h at the nodes."""
    n, speed = len(letters), np.array(speeds) / 3.6
    efforts = [
        np.array([sizes.get(each, 0.0) for each in letters])
        for sizes in ({"T": 60e3, "P": 10e3}, BRAKES)
    ]
    return Trajectory(
        "L", "T", 300.0 * np.arange(n + 1), (Configuration.of(FLIRT),), speed[None],
        20.0 * np.arange(n + 1)[None], efforts[0], efforts[1][None], 20.0 * n,
        certificate={"phases": [letters]},
    )  # fmt: skip


def _of_two(letters: str, others: str, speeds: list[float], more: list[float]) -> Trajectory:
    """A plan of one configuration, and another that is so much faster at each place [km/h]."""
    plan, phases = _with_phases(letters, [*speeds, 0.0]), [letters, others]
    every = np.column_stack((np.array([speeds, np.add(speeds, more)]) / 3.6, np.zeros(2)))
    one = plan.configurations[0]
    return replace(
        plan, configurations=(one, replace(one, name="faster")), speeds=every,
        times=np.stack((plan.times[0], plan.times[0] - 1e-3)), certificate={"phases": phases},
        braking_effort=np.array([[BRAKES.get(x, 0.0) for x in each] for each in phases]),
    )  # fmt: skip


FREE = StepProfile(np.array([0.0]), np.array([200.0 / 3.6]))  # no limit that a train reaches [m/s]


def words_of(trajectory: Trajectory, limits: StepProfile = FREE) -> list[str]:
    return [each.words() for each in instructions(trajectory, limits)]


def test_at_one_speed_the_advice_is_to_hold_it():
    speeds = [0, 100, 100.5, 101, 100.2, 101.1, 100.5, 60, 0]
    assert words_of(_with_phases("TPHPCPCB", speeds)) == [
        "full traction to 101 km/h",
        "hold 101 km/h",
        "coast to km 2.100: speed falls to 60 km/h",
        "brake to a stand",
    ]
    # Coasting or braking for a moment while cruising is no advice.
    for letter in "CH":
        phases = "P" * 50 + letter + "P" * 49
        assert words_of(_with_phases(phases, [72.0] * 101)) == ["hold 72 km/h"]
    # A dip between two equal speeds is coasting all the same.
    dip = instructions(_with_phases("TPCCPB", [0, 100, 100, 80, 100, 100, 0]), FREE)
    assert [LETTERS[each.phase] for each in dip] == list("TPCPB")
    assert dip[2].course == pytest.approx(np.array([100.0, 80.0, 100.0]) / 3.6)


def test_a_speed_held_within_a_longer_phase_is_advice_until_the_brake():
    """Braking downhill at one speed, then to a lower one: two speeds to hold, and a brake."""
    speeds = [0, 99, 100, 100, 100, 100, 85, 80, 80.5, 80, 60, 0]
    assert words_of(_with_phases("TPPPPHHPPCB", speeds)) == [
        "full traction to 100 km/h",
        "hold 100 km/h",
        "brake gently to 80 km/h by km 2.100",
        "hold 80 km/h",
        "coast to km 3.000: speed falls to 60 km/h",
        "brake to a stand",
    ]
    # Partial traction at a falling speed is no speed to hold.
    falling = words_of(_with_phases("TPPPCB", [0, 100, 100, 100, 80, 60, 0]))
    assert falling[1:3] == ["hold 100 km/h", "partial traction to 80 km/h by km 1.200"]


def test_a_short_full_brake_to_a_lower_speed_is_advice():
    given = _with_phases("TPBPB", [0, 115, 115, 105, 105, 0])
    times = np.array([0.0, 60.0, 120.0, 122.5, 200.0, 240.0])[None]
    assert words_of(replace(given, times=times)) == [
        "full traction to 115 km/h", "hold 115 km/h", "brake to 105 km/h by km 0.900",
        "hold 105 km/h", "brake to a stand",
    ]  # fmt: skip


def test_braking_is_advised_only_where_a_configuration_brakes():
    """One coasts below a limit that the other has to brake for; further on both coast below one."""
    speeds, more = [0.0, 100.0, 92.0, 88.0, 80.0, 70.0], [0.0, 0.0, 8.0, 2.0, 4.0, 5.0]
    plan = _of_two("TCCCCB", "TCBCCB", speeds, more)
    limits = StepProfile(np.array([0.0, 900.0, 1_200.0]), np.array([120.0, 90.0, 85.0]) / 3.6)
    assert words_of(plan, limits) == [
        "full traction to 100 km/h",
        "coast to km 0.600: speed falls to 92 km/h; at most 100 km/h at km 0.600",
        "brake, if faster, to 90 km/h by km 0.900",
        "coast to km 1.500: speed falls to 70 km/h; at most 85 km/h from km 1.200, 75 km/h at km"
        " 1.500",
        "brake to a stand",
    ]


def test_a_speed_is_held_only_where_the_plan_drives_or_brakes():
    """Downhill one brakes for a limit below which the other coasts: nobody is to drive."""
    speeds = [0.0, 104.0, 107.0, 109.6, 109.7, 109.8, 109.9, 110.0, 110.0, 60.0]
    more = [0.0, 0.0, 1.0, 0.3, 0.3, 0.2, 0.1, 0.0, 0.0, 0.0]
    plan = _of_two("TCCCCCPPCB", "TCCHHHPPCB", speeds, more)
    line = level_line(3_000.0, (0.0, 120.0), (600.0, 110.0))
    assert words_of(plan, line.speed_limits)[:4] == [
        "full traction to 104 km/h",
        "coast to km 0.900: speed rises to 110 km/h",
        "brake, if faster, to 110 km/h by km 1.800",
        "hold 110 km/h",
    ]


def test_the_speed_that_is_held_is_not_below_the_one_planned_longest():
    """A row less is not worth six seconds."""
    plan = _with_phases("TPP" + "P" * 11 + "B", [0, 62.0, 63.0, *[65.0] * 12, 0])
    held = [each for each in instructions(plan, level_line(4_500.0).speed_limits) if each.hold]
    assert 3.6 * held[-1].target == pytest.approx(65.0)


STEPS = {"T": (-9, 40), "P": (-2, 4), "C": (-9, 5), "H": (-8, 1), "B": (-40, -5)}
"""By how much the speed changes in a cell of each phase [km/h]."""


@st.composite
def drawn_plans(draw: st.DrawFn) -> tuple[Trajectory, StepProfile]:
    """A plan of two configurations, of which one may brake where the other coasts, and limits."""
    letters, speeds, more, others = "T", [0.0, draw(st.floats(40.0, 90.0))], [0.0, 0.0], "T"
    for letter in draw(st.lists(st.sampled_from("TPPCCCHB"), min_size=3, max_size=14)):
        after = speeds[-1] + draw(st.floats(*STEPS[letter]))
        if 20.0 < after < 140.0:
            letters, speeds = letters + letter, [*speeds, after]
            more.append(min(draw(st.sampled_from([0.0, 0.5, 3.0, 9.0])), more[-1] + 5.0))
            others += "B" if letter == "C" and more[-1] < more[-2] - 2.0 else letter
    pieces = np.cumsum([draw(st.booleans()) for _ in letters] + [True])
    slack = draw(st.lists(st.sampled_from([0.0, 0.3, 4.0, 60.0]), min_size=16, max_size=16))
    plan = _of_two(letters + "B", others + "B", speeds, more)
    fastest = np.maximum(plan.speeds[1, 1:], plan.speeds[1, :-1])
    values = [fastest[pieces == each].max() + slack[each] / 3.6 for each in np.unique(pieces)]
    starts = np.flatnonzero(np.diff(pieces, prepend=-1))
    return plan, StepProfile(plan.positions[starts], np.array(values))


@settings(max_examples=200)
@given(drawn_plans())
def test_rows_say_what_any_plan_does(drawn):
    _check_rows(*drawn)


@pytest.mark.parametrize(
    ("letters", "speeds", "more", "limits"),
    [
        ("TTTTTTTB", [40] * 6 + [41], {4: 3.0}, {0.0: 43.0, 1500.0: 40.0, 1800.0: 41.0}),
        ("T" * 10 + "CCCCB", [40] * 14, {11: 0.5, 13: 0.5, 14: 3.0}, {0.0: 40.5, 3600.0: 43.0}),
        (
            "TTTTTCTTTB", [66, 66, 66, 91, 131, 136, 136, 136, 136], {6: 3.0},
            {0.0: 139.0, 2100.0: 136.0},
        ),
        ("TCCCB", [40, 39, 39, 39], {3: 0.5}, {0.0: 40.0, 1200.0: 39.0}),
    ],
    ids=["a lower limit later", "a higher limit later", "a limit ahead", "rises after a fall"],
)  # fmt: skip
def test_a_speed_not_to_exceed_is_below_no_configuration(letters, speeds, more, limits):
    speeds = [0.0, *map(float, speeds)]
    plan = _of_two(letters, letters, speeds, [more.get(k, 0.0) for k in range(len(speeds))])
    _check_rows(plan, StepProfile(np.array([*limits]), np.array([*limits.values()]) / KMH))


def _check_rows(plan: Trajectory, limits: StepProfile) -> None:
    places, speeds, top = plan.positions, plan.speeds[0], 1.0 / KMH
    phases = np.array([["TPCHB".index(x) for x in each] for each in plan.certificate["phases"]])
    rows = instructions(plan, limits)
    assert (rows[0].position, rows[-1].end) == (0.0, places[-1])
    for row, after in zip(rows, [*rows[1:], None], strict=True):
        first, last = np.searchsorted(places, [row.position, row.end]).tolist()
        own, inside = phases[:, first:last], speeds[first : last + 1]
        assert after is None or (row.end, row.until) == (after.position, after.speed)
        assert (row.speed, row.until) == (inside[0], inside[-1])
        assert (row.lowest, row.highest) == (inside.min(), inside.max())
        assert abs(3.6 * row.target - round(3.6 * row.target)) < 1e-6
        if row.hold:
            assert row.stated_until == row.stated_target == row.target
            assert np.all(np.abs(inside - row.target) <= 2.0 * top + 1e-9)
            assert row.target <= limits(places[first:last]).min() + 0.01
            assert row.caps == ()
            continue
        drives, brakes = row.phase <= Phase.CRUISING, row.phase > Phase.COASTING
        assert not drives or np.all(own[0] <= Phase.CRUISING)
        assert not brakes or np.all((own >= Phase.PARTIAL_BRAKING).any(axis=0))
        assert row.phase is not Phase.MAXIMUM_TRACTION or own[0].min() == 0
        assert (row.phase is Phase.PARTIAL_BRAKING) == (brakes and own[0].max() == 3)
        # It leads to a speed that is held, or to one of the plan: of who brakes.
        slows = row.phase is Phase.MAXIMUM_TRACTION and row.highest - row.until > top
        alone = brakes and own[0].max() < Phase.PARTIAL_BRAKING
        goal = row.highest if slows else plan.speeds[1, last] if alone else row.until
        if after is not None and after.hold and not slows and row.phase is not Phase.COASTING:
            assert row.target == after.target
        else:
            most = goal if not drives else min(goal + 0.5 * top, limits(row.end - 1e-3))
            assert min(goal, most) - top < row.target + 1e-6 <= most + 0.01
        if row.phase is Phase.COASTING or slows:
            capped = {each.speed for each in row.caps if each.speed > row.until - top}
            assert min(abs(row.stated_until - each) for each in {row.until, *capped}) < 1e-9
            assert row.until - top < row.stated_until < row.until + 1e-9
        assert row.by == row.end if not brakes else row.position < row.by <= row.end
        turns = np.diff(row.course)
        assert (row.course[0], row.course[-1]) == (row.speed, row.until)
        assert row.lowest <= min(row.course) <= max(row.course) <= row.highest
        assert np.all(turns[1:-1] * turns[:-2] < 0.0)
        assert row.highest - max(row.course) <= 2.0 * top + 1e-9
        # No configuration is asked to be slower than it is planned, or led over a limit.
        stated = np.full(places.size, np.inf)
        for cap in row.caps:
            assert row.position <= cap.start <= cap.end <= row.end
            some = (places >= cap.start) & (places <= cap.end)
            assert plan.speeds[:, some].max() <= cap.speed + top + 1e-9
            stated[some] = np.minimum(stated[some], cap.speed)
        for cell in range(first, last - 1):
            here, after = float(limits(places[cell] + 1.0)), plan.speeds[1, cell + 1]
            near, rises = after > here - 8.0 * top, after > plan.speeds[1, cell] + 0.2 * top
            coasts = row.phase is Phase.COASTING and places[cell + 1] not in limits.positions
            if near and ((coasts and rises) or (drives and here < row.target - top)):
                assert stated[cell + 1] <= here + 1e-9


@given(drawn_plans())
def test_no_other_rows_leave_less_unsaid(drawn):
    plan = _Plan(*drawn)
    costs, chosen, change = plan._costs(), plan.chosen(), 2.5 / 3.6
    least = costs[:, 0]
    for column in costs[:, 1:].T:
        least = np.minimum(least, least.min() + change) + column
    own = costs[chosen, np.arange(chosen.size)].sum() + change * np.count_nonzero(np.diff(chosen))
    assert own == pytest.approx(least.min())


def test_a_trip_with_the_advice_beside_it_can_be_kept_and_replayed(sampled, tmp_path):
    trip = read_log(sample("nonstop.mcap"))
    write_log(with_advice(trip, sampled), tmp_path / "advised.mcap")
    advised = read_log(tmp_path / "advised.mcap")
    frame = advised["/reference"]
    position = advised["/train/state"]["position"].reindex(frame.index).to_numpy()
    assert frame["speed"].to_numpy() == pytest.approx(sampled.speed_at(0, position))
    # At its end a trip is as late as it took longer than the trajectory allows.
    seconds = (frame.index[-1] - frame.index[0]).total_seconds()
    assert frame["lateness"].iloc[-1] == pytest.approx(seconds - sampled.running_time, abs=60.0)
    assert advised.provenance[-1]["step"] == "advise"
    refused(InputError, "carries a reference already", with_advice, advised, sampled)
    with pytest.raises(InputError, match=r"is for line 'CH_StGallen_Wil' reverse, trip '.*forward"):
        with_advice(trip, replace(sampled, direction="reverse"))
    beyond = replace(sampled, positions=sampled.positions + 1e6)
    refused(InputError, r"is never between km 1000\.000 and", with_advice, trip, beyond)


def test_the_slope_of_the_front_is_the_price_of_a_second():
    problem = TrajectoryProblem(hilly_line(), FLIRT, observed(FLIRT, 1.0, 1.05))
    front = energy_against_time(problem, (0.2, 0.05, 0.1, 0.15), OptimiserOptions(80))
    assert np.all(np.diff(front.times) > 0.0)
    assert np.all(np.diff(front.energies) < 0.0)
    assert all(run.certificate["lower_bound"] <= run.certificate["energy"] for run in front.runs)
    slopes = -np.diff(front.energies) / np.diff(front.times)
    # The front is convex: each secant lies between the prices at its ends.
    assert np.all(slopes <= 1.01 * front.prices[:-1])
    assert np.all(slopes >= 0.99 * front.prices[1:])


def test_a_front_of_nothing_is_refused():
    problem = TrajectoryProblem(hilly_line(), FLIRT, observed(FLIRT, 1.0))
    refused(InputError, "no reserves", energy_against_time, problem, ())
    with pytest.raises(InfeasibleError, match="under one common traction"):
        energy_against_time(problem, (1e-7,), OptimiserOptions(40))


def test_against_the_chainage_the_map_is_read_backwards():
    line = hilly_line()
    condition = slippery(line, (7_000.0, 8_000.0, 0.08))
    configurations = tuple(observed(FLIRT, 1.0))
    asked = {"condition_map": condition, "direction": "reverse"}
    run = TrajectoryProblem(line.reversed(), FLIRT, configurations, **asked)
    forward = TrajectoryProblem(line, FLIRT, configurations, condition_map=condition)
    points = np.linspace(0.0, line.length, 401)
    assert run.adhesion_at(points) == pytest.approx(forward.adhesion_at(line.length - points))
    assert run.adhesion(points) == pytest.approx(forward.adhesion(line.length - points[::-1])[::-1])
    found = optimised(line.reversed(), FLIRT, configurations, **asked, reserve=0.15, cells=150)
    assert found.direction == "reverse"
    assert found.certificate["audit"]["adhesion"] <= 1.0 + 1e-6
    # It starts where the rail is slippery.
    least = 0.08 * np.exp(-0.1) * FLIRT.adhesive_weight()
    assert found.tractive_effort[0] == pytest.approx(least, rel=1e-6)
