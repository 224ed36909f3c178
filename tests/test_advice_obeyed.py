"""Whoever obeys every row of the advice keeps the limits and arrives, with any configuration.

The trips are driven by `advised_driver`, which reads nothing but the table.
"""

from __future__ import annotations

import csv
import re
import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from trajectory_cases import (
    FLIRT,
    FREIGHT,
    VIRM6,
    drawn,
    hilly_line,
    level_line,
    observed,
    optimised,
    optimised_journey,
)
from trip_parts import without

from analysis.comparison.compare import compare
from analysis.control.advised import EXACT, AdvisedDriver, Attention, obeyed_trip
from analysis.trajectory.advice import journey_advice, limits_of, write_journey_advice
from analysis.trajectory.instructions import Phase, instructions
from trainlog import Configuration, Line, Train, Trajectory, read_line, sample, trajectory_scenarios
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway.trajectory import Journey, TimingPoint
from trainlog.simulation import drive
from trainlog.units import JOULES_PER_KWH, KMH

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "control"))
from outcome import outcome

STEP = 0.25
"""Of the integration [s]."""


EARLY = 0.3
"""Deceleration from which a driver brakes for a speed not to exceed further on [m/s²]."""

CAP = re.compile(
    r"(\d+) km/h(?: from km ([\d.]+))?(?: to km ([\d.]+))?(?: at km ([\d.]+))?(?=, |$)"
)
"""A speed not to exceed, from one kilometre to another or at one."""


class Row:
    """One instruction: its place, and what its words ask for."""

    def __init__(self, row: dict[str, str]) -> None:
        self.km, self.words = float(row["km"]), row["advice"]
        self.coasts = self.words.startswith("coast")
        words, _, capped = self.words.partition("; at most ")
        speeds = re.findall(r"(?:to|hold|at most) (\d+) km/h", words)
        self.speed = float(speeds[0]) / KMH if speeds and not self.coasts else 0.0
        self.caps = [
            (float(speed) / KMH, float(at or start or -np.inf), float(at or end or np.inf))
            for speed, start, end, at in CAP.findall(capped)
        ]
        turns = re.findall(r"(falls|rises) to (at most )?(\d+)", words)
        self.turns = [(verb, float(speed) / KMH) for verb, _, speed in turns]
        if turns and turns[-1][1]:
            place = float(row["to_km"])
            self.caps.append((self.turns[-1][1], place, place))
        by = re.search(r"by km ([\d.]+)", words)
        self.by = float(by[1]) if by else None
        self.verb = self.words.split()[0]


class Course:
    """How far a driver who coasts has come in the falls and rises that a row states."""

    def __init__(self) -> None:
        self.row: Row | None = None
        self.turn, self.low = 0, False

    def lowest(self, row: Row, v: float) -> float:
        """The speed [m/s] below which it does not fall by the row at this stage."""
        if row is not self.row:
            self.row, self.turn, self.low = row, 0, False
        while self.turn < len(row.turns):
            verb, speed = row.turns[self.turn]
            if self.turn + 1 == len(row.turns):
                return speed if verb == "falls" else 0.0
            following = row.turns[self.turn + 1][1]
            middle = 0.5 * (speed + following)
            if verb == "falls":
                self.low |= v < middle
                if not (self.low and v > middle):
                    return speed
            elif v > middle:
                return 0.0
            self.turn, self.low = self.turn + 1, False
        return 0.0


def rows_of(file: Path) -> list[Row]:
    """What the table says is to be done, in order."""
    with file.open(encoding="utf-8") as table:
        return [Row(row) for row in csv.DictReader(table) if row["event"] == "changes"]


def driven(
    rows: list[Row], line: Line, train: Train, configuration: Configuration
) -> tuple[np.ndarray, np.ndarray, float]:
    """Places [m] and speeds [m/s] of one run after the rows, and when it ends [s]."""
    grid = np.arange(0.0, line.length + 5.0, 5.0)
    track = line.track_acceleration(grid, train.strip_length).tolist()
    area = line.tunnel_cross_section(grid)
    tunnel = train.tunnel_coefficient(area).tolist()
    kilometres = np.array([float(line.kilometre(each)) for each in grid]) / 1e3
    order = np.argsort(kilometres)
    starts = [float(np.interp(row.km, kilometres[order], grid[order])) for row in rows]
    ends = [*starts[1:], line.length]
    by = [
        end if row.by is None else float(np.interp(row.by, kilometres[order], grid[order]))
        for row, end in zip(rows, ends, strict=True)
    ]
    way = 1.0 if kilometres[-1] > kilometres[0] else -1.0

    def ahead(s: float, row: Row) -> list[tuple[float, float, float]]:
        """Speeds not to exceed, and how far it is to where they hold and no longer hold."""
        here = float(np.interp(s, grid, kilometres))
        return [(v, 1e3 * way * (a - here), 1e3 * way * (b - here)) for v, a, b in row.caps]

    resistance, inertia = configuration.resistance, configuration.inertia
    power = configuration.max_power
    most_brake = min(train.max_deceleration, train.max_braking_effort / inertia)
    course = Course()
    s = v = time = 0.0
    places, speeds, number = [0.0], [0.0], 0
    while s < line.length - 0.3 and time < 20_000.0:
        while number + 1 < len(rows) and s >= ends[number]:
            number += 1
        row, here = rows[number], min(int(s / 5.0), grid.size - 1)
        drag = resistance.r0 + resistance.r1 * v + (resistance.r2 + tunnel[here]) * v * v
        coasting = -drag / inertia - track[here] * configuration.mass / inertia
        full = min(train.max_tractive_effort, power / max(v, 0.1)) / inertia
        full = min(full, train.max_acceleration) + coasting
        hardest = coasting - most_brake
        wanted = (row.speed - v) / 2.0
        left = max(by[number] - s, 0.5)
        if row.verb in ("hold", "full"):
            a = min(max(wanted, hardest), full)
        elif row.verb == "coast":
            a = coasting
            if v < course.lowest(row, v) - 0.5 / KMH:
                a = max(a, min(full, 0.3))
        elif row.verb == "partial":
            a = min(max((row.speed**2 - v * v) / (2.0 * left), hardest), full)
        else:
            needed = (row.speed**2 - v * v) / (2.0 * left)
            # Who is to brake if faster lets the train roll up to that speed.
            rolls = max(wanted, 0.0) if "if faster" in row.words else 0.0
            a = max(min(coasting, needed), hardest) if v > row.speed else min(coasting, rolls)
            if row.speed == 0.0 and v < 1.5:
                a = 0.0
        if row.verb != "hold":
            a = min(a, max(_below(ahead(s, row), v), hardest))
        if v < 0.5 and not (row.verb == "brake" and row.speed == 0.0):
            a = max(a, min(full, 0.3))
        # A step ends where a row does.
        step = min(STEP, max((ends[number] - s) / max(v, 1.0), 0.01))
        after = max(v + a * step, 0.0)
        s, v, time = s + 0.5 * (v + after) * step, after, time + step
        places.append(s)
        speeds.append(v)
    return np.array(places), np.array(speeds), time


def _below(caps: list[tuple[float, float, float]], v: float) -> float:
    """The highest acceleration that keeps below speeds not to exceed."""
    most = np.inf
    for speed, start, end in caps:
        if start <= 0.0 <= end:
            most = min(most, (speed - v) / 2.0)
        elif start > 0.0 and v > speed:
            needed = (speed**2 - v**2) / (2.0 * start)
            most = min(most, needed) if needed < -EARLY else most
    return most


ALLOWED = 0.5 / KMH
"""Speed over the limit that is counted as none [m/s]."""

LATE, SECONDS = 0.02, 10.0
"""How late a trip that obeys rounded speeds may be: a part of its time, and some seconds."""

TRAINS = {"flirt": FLIRT, "virm": VIRM6, "freight": FREIGHT}


@pytest.mark.usefixtures("unrenewed")
@pytest.mark.parametrize(
    ("name", "train", "reserve"),
    [
        ("hilly", "flirt", 0.04),
        ("hilly", "freight", 0.12),
        pytest.param("CH_StGallen_Wil", "virm", 0.04, marks=pytest.mark.long),
        pytest.param("CH_StGallen_Wil", "flirt", 0.4, marks=pytest.mark.long),
        ("DE_Chemnitz_Cranzahl", "virm", 0.12),
    ],
)
def test_no_row_leads_over_a_limit(name, train, reserve, tmp_path):
    line = hilly_line() if name == "hilly" else read_line(sample(f"{name}.line.json"))
    driver = TRAINS[train]
    configurations = [*observed(driver, 0.85, 1.15), *drawn(driver, 2, seed=3)]
    plan = optimised(line, driver, configurations, reserve=reserve, cells=100)
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


def test_speeds_are_rounded_down_and_beside_what_is_permitted():
    """57 mph are 91.7 km/h: the speed to hold is 91, and 90 where that is the limit ahead."""
    limits = (0.0, 120.0), (5_000.0, 57 * 1.609344), (8_000.0, 130.0)
    line = level_line(12_000.0, *limits, name="miles")
    plan = optimised(line, FLIRT, observed(FLIRT, 1.0, 1.1), reserve=0.03, cells=100)
    found = journey_advice([plan], line)
    changes = [row for row in found.rows if row.instruction is not None]
    limits = line.speed_limits([row.position for row in changes])
    assert [row.permitted for row in changes] == pytest.approx(limits)
    assert "brake to 91 km/h by km 5.000" in [row.words for row in found.rows]


LINE = hilly_line()


@cache
def plan_of(name: str, reserve: float = 0.1) -> Trajectory:
    train = TRAINS[name]
    configurations = [*observed(train, 0.85, 1.15), *drawn(train, 1, seed=3)]
    return optimised(LINE, train, configurations, reserve=reserve, cells=60)


def outcomes(plan: Trajectory, train: Train, attention: Attention, seed: int = 1) -> FloatArray:
    """Lateness [s], energy over planned, over the limit [m/s], off the stop [m], of each."""
    follows = partial(AdvisedDriver, plan, LINE, train, attention=attention, seed=seed)
    scenarios = trajectory_scenarios(plan, LINE, train, plan.chosen("all"), follows)
    return np.array([outcome(each, drive(each))[:4] for each in scenarios])


@cache
def to_the_letter(train: str, reserve: float = 0.1) -> FloatArray:
    return outcomes(plan_of(train, reserve), TRAINS[train], EXACT)


@pytest.mark.parametrize(("train", "reserve"), [("flirt", 0.1), ("freight", 0.3)])
def test_who_obeys_to_the_letter_keeps_limits_time_and_stop(train, reserve):
    """With brakes that take their time, which the plan does not know."""
    plan = plan_of(train, reserve)
    late, energy, over, stop = to_the_letter(train, reserve).T
    assert np.all(over < 2.0 / KMH)
    assert np.all(late < 0.1 * plan.running_time)  # freight slips at its start
    assert np.all(np.abs(stop) < 0.3)
    assert np.all(energy < 0.03)


def test_who_coasts_over_hills_and_dips_does_not_drive_for_a_speed_of_the_next_one():
    """For 17 km over four hills; between two of them it is faster than it will be on the next."""
    line, train = read_line(sample("CH_StGallen_Wil.line.json")), TRAINS["freight"]
    plan = optimised(line, train, observed(train, 1.15), reserve=0.4, cells=200)
    row = next(each for each in instructions(plan, limits_of(plan, line)) if len(each.course) > 6)
    assert row.phase is Phase.COASTING
    assert row.end - row.position > 15e3
    np.testing.assert_allclose(
        np.interp(row.turns, plan.positions, plan.speeds[0]), row.course, atol=1e-6
    )
    follows = partial(AdvisedDriver, plan, line, train)
    (scenario,) = trajectory_scenarios(plan, line, train, plan.chosen("all"), follows)
    late, energy = outcome(scenario, drive(scenario))[:2]
    assert -0.02 * plan.running_time < late < 0.03 * plan.running_time
    assert abs(energy) < 0.05


def test_a_person_is_further_off_than_who_obeys_to_the_letter():
    plan = plan_of("flirt")
    exact = to_the_letter("flirt")
    persons = [outcomes(plan, FLIRT, Attention(), seed) for seed in range(2)]
    late, _, over, stop = np.concatenate(persons).T
    assert np.std([each[:, 0] for each in persons], axis=0).max() > 1.0
    assert exact[:, 2].max() < over.max() < 8.0 / KMH
    assert np.all(np.abs(stop) < 0.3)
    assert np.all(late < 0.1 * plan.running_time)


def test_a_trip_is_compared_with_its_advice():
    """Energies of the trip, of the plan and of the advice stand in one table."""
    plan = plan_of("flirt")
    trip = obeyed_trip(plan, LINE, FLIRT)
    found = compare(trip, plan)
    (direction,) = found.directions
    table = next(each for each in found.tables() if each.name == "trips")
    assert [row[0] for row in table.rows] == ["driven-x1.15", "trajectory", "advice obeyed"]
    letter = direction.obeyed.sums["traction"][-1]
    planned = plan.certificate["wheel_energy"][plan.latest]
    assert letter == pytest.approx(planned, rel=0.1)
    assert abs(letter - direction.trips[0].sum("traction")) < 0.2 * JOULES_PER_KWH
    assert direction.trips[0].within_advice > 0.6
    # A log that holds no advice is compared with the speeds of the plan, here of another one.
    bare = without(trip, "/reference")
    other = compare(bare, plan_of("flirt", 0.5)).directions[0].trips[0]
    assert other.within_advice < 0.5 * direction.trips[0].within_advice
    # Where a plan gives no advice the rest is compared.
    nameless = compare(trip, replace(plan, certificate={}))
    assert nameless.directions[0].obeyed is None
    (note,) = [each for each in nameless.notes if "advice obeyed" in each]
    assert note.startswith("left out: advice obeyed: ")
    assert nameless.facts()["left_out"] == (note.removeprefix("left out: "),)


def test_a_trip_is_compared_with_the_plan_of_its_whole_journey():
    """Times and work of the plan are those of its sections, and it stands between them."""
    stops = [
        TimingPoint(each.position, lowest_speed=0.0, highest_speed=0.0) for each in LINE.stations
    ]
    stops[0] = replace(stops[0], earliest=0.0, latest=0.0)
    journey = Journey("stopping", LINE.name, tuple(stops))
    loads = observed(FLIRT, 1.0, 1.1)
    plan = optimised_journey(LINE, FLIRT, loads, journey, dwell=40.0, cells=100, reserve=0.1)
    first, second = (obeyed_trip(each, LINE, FLIRT) for each in plan.sections)
    for reference in (plan, plan.sections[::-1]):
        found = compare([first, second], reference)
        (direction,) = found.directions
        whole = direction.reference
        assert whole.duration == pytest.approx(plan.running_time, abs=0.1)
        assert [(each.station, each.duration) for each in whole.stands] == [
            ("A", 0.0), ("B", pytest.approx(40.0, abs=0.1)), ("C", 0.0)
        ]  # fmt: skip
        work = sum(each.certificate["wheel_energy"][each.latest] for each in plan.sections)
        assert whole.sums["traction"][-1] == pytest.approx(work, rel=1e-6)
        assert whole.running[-1] == pytest.approx(whole.duration - 40.0, abs=0.1)
        assert direction.obeyed.covered[1] == pytest.approx(LINE.length, abs=5.0)
        assert direction.obeyed.sums["traction"][-1] == pytest.approx(work, rel=0.1)
        slips = [each.trip.slips.size for each in direction.trips]
        assert direction.obeyed.slips.size == sum(slips)
        assert [each.within_advice > 0.6 for each in direction.trips] == [True, True]
        # Each trip drove one section: it lost what the advice of that section loses.
        for trip, section in zip(direction.trips, plan.sections, strict=True):
            late = trip.trip.duration - section.times[section.latest, -1]
            assert trip.lost.total == pytest.approx(late, abs=3.0)
    refused(InputError, "no trajectory was given", compare, first, [])
