"""Trips compared with each other and with what a model calculates: what was lost where, and why."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from refusals import refused
from trip_parts import without

from analysis import compare, fit_trip, slip, with_estimates
from analysis.comparison.calculated import calculate, judged_together, together_words
from analysis.comparison.compare import ComparedTrip
from analysis.comparison.driven import driven_trip
from analysis.comparison.groups import compare_groups, punctuality, trip_cost
from trainlog import InputError, LogError, TrainlogError, draw_scenarios, simulate, topics as schema
from trainlog.formats.railway import line_to_bytes, read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.mcap import read_log, write_log
from trainlog.railway import Line, ParameterSet, RunningResistance, StepProfile, Train, Trajectory
from trainlog.railway.train import Configuration
from trainlog.simulation.drivers import Habits, Stop, plan
from trainlog.simulation.scenario import Scenario
from trainlog.spans import runs_of
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip, frame_of

pytestmark = pytest.mark.usefixtures("remembered")

LINE = read_line(sample(DEFAULT_LINE))
TRAIN = read_train(sample(DEFAULT_TRAIN))


@cache
def stopping() -> Trip:
    return read_log(sample("stopping.mcap"))


@cache
def nonstop() -> Trip:
    return read_log(sample("nonstop.mcap"))


def altered(whole: Trip, change: Callable[[pd.DataFrame], pd.DataFrame], **metadata: str) -> Trip:
    """A copy of a trip with all its topics changed alike."""
    topics = {name: change(frame) for name, frame in whole.topics.items()}
    return replace(whole, topics=topics, metadata={**whole.metadata, **metadata})


def test_a_trip_beside_itself_loses_nothing_anywhere():
    day = pd.Timedelta("1D")
    later = altered(stopping(), lambda frame: frame.set_axis(frame.index + day))
    found = compare([stopping(), later], stopping())
    again = found.trip("trip-03 (2)")
    assert again.lost.total == 0.0
    assert again.lost.losses.empty
    assert (again.lost.behind == 0.0).all()
    assert (again.table["lost"] == 0.0).all()
    assert again.energy.value == again.trip.sums["traction"][-1]


def test_the_same_drive_given_twice_counts_once_and_is_stated():
    copy = altered(stopping(), lambda frame: frame, trip="copy")
    found = compare([stopping(), copy])
    assert [each.name for each in found.directions[0].trips] == ["trip-03"]
    assert "trip 'copy' is the same drive as 'trip-03': counted once" in found.left_out


def test_thirty_seconds_longer_at_a_station_are_lost_there_by_dwell():
    state = stopping()["/train/state"]
    stands = runs_of(state["speed"].to_numpy() <= 0.1)
    begin, end = next(each for each in stands if each[0] > 1000 and each[1] - each[0] > 100)
    middle = state.index[(begin + end) // 2]  # of the first stand on the way

    def later(frame: pd.DataFrame) -> pd.DataFrame:
        shift = 30.0 * (frame.index > middle)
        return frame.set_axis(frame.index + pd.to_timedelta(shift, unit="s"), axis=0)

    late = altered(stopping(), later, trip="late")
    losses = compare([stopping(), late], stopping()).trip("late").lost.losses
    assert losses[["cause", "place"]].values.tolist() == [["dwell", "at Gossau SG"]]
    assert losses["lost"][0] == pytest.approx(30.0, abs=0.11)
    by_day = compare([stopping(), late], late, by_time_of_day=True).trip("trip-03").lost
    assert by_day.behind[0] == 0.0
    early = compare([stopping(), late], late).trip("trip-03").lost
    assert early.losses["words"][0] == "shorter dwell"
    assert early.total == pytest.approx(-30.0, abs=0.11)


def test_a_stop_at_which_the_reference_ends_is_no_stop_more():
    first, last = (pd.Timestamp(f"2024-10-07T08:{each}Z") for each in ("06:57", "10:50"))

    def part(frame: pd.DataFrame) -> pd.DataFrame:
        """Gossau SG to Flawil, 5 % slower."""
        frame = frame[(frame.index >= first) & (frame.index <= last)]
        slow = frame.set_axis(first + 1.05 * (frame.index - first), axis=0)
        return slow.assign(speed=slow["speed"] / 1.05) if "speed" in slow else slow

    slower = altered(stopping(), part, trip="slower")
    lost = compare([stopping()], slower).trip("trip-03").lost
    assert lost.total < -5.0
    assert "stop" not in lost.by_cause()


def test_losses_add_up_to_the_difference_and_to_the_sections():
    found = compare([stopping(), nonstop()])
    trip = found.trip("trip-03")
    difference = driven_trip(stopping()).duration - driven_trip(nonstop()).duration
    assert trip.lost.total == pytest.approx(difference, abs=1e-9)
    parts = trip.lost.losses["lost"].sum()
    assert parts == pytest.approx(trip.lost.total, abs=1e-9)
    assert trip.table["lost"].sum() == pytest.approx(difference, abs=1e-9)
    assert trip.lost.behind[-1] == pytest.approx(difference, abs=1e-6)
    times = trip.table[["running_time", "dwell", "stood"]].sum().sum()
    assert times == pytest.approx(driven_trip(stopping()).duration, abs=0.2)
    # Three stops of some 42 s, and slowing down and starting for each.
    assert trip.lost.by_cause()["stop"] > 200.0


@pytest.mark.parametrize("forward", [1, 2])
def test_a_trip_is_not_compared_with_itself_beside_others(forward):
    back = altered(nonstop(), lambda frame: frame, direction="reverse", trip="back")
    trips = [back, *(stopping(), nonstop())[:forward]]
    if forward == 1:
        refused(InputError, "ran in opposite directions: .* give another trip", compare, trips)
        return
    found = compare(trips)
    assert [each.direction for each in found.directions] == ["forward"]
    assert "trip 'back' is the only one that ran reverse" in found.left_out[0]
    assert len(compare(back).directions) == 1


def test_a_gap_in_the_recording_is_stated_and_loses_no_time():
    first, last = (stopping().start + pd.Timedelta(each) for each in ("150s", "190s"))

    def gap(frame: pd.DataFrame) -> pd.DataFrame:
        inside = (frame.index > first) & (frame.index < last)
        return frame[~inside] if len(frame) > 2000 else frame

    holed = altered(stopping(), gap, trip="holed")
    found = compare([stopping(), holed], stopping()).trip("holed")
    assert found.lost.total == pytest.approx(0.0, abs=0.1)
    assert any("no position for 40 s" in note for note in found.trip.notes)
    # What is in the gap is not known: it is not taken for slow or fast driving.
    assert set(found.lost.by_cause()) <= {"recording"}
    # Work in the gap would be a guess between two efforts: it is not stated. Other work is.
    assert found.table["traction"].isna().tolist() == [True, False, False, False]
    own = compare(stopping()).trip("trip-03").table["traction"]
    np.testing.assert_allclose(found.table["traction"][1:], own[1:], rtol=1e-3)


@pytest.mark.parametrize(("first", "last"), [(1500, 1600), (1500, 1700), (1000, 3000)])
def test_energy_is_stated_where_it_is_recorded_with_the_share_that_is_missing(first, last):
    controls = stopping()["/train/controls"].copy()
    controls.iloc[first:last, controls.columns.get_loc("tractive_effort")] = np.nan
    holed = altered(stopping().with_topic(controls), lambda frame: frame, trip="holed")
    found = compare([holed, nonstop()], nonstop())
    each, whole = found.trip("holed"), driven_trip(stopping())
    ends = (controls.index[[first, last]].as_unit("ns").asi8 - whole.departure) / 1e9
    moving = np.interp(ends, whole.time, whole.running)
    energy, share = each.recorded_energy("traction")
    assert share == pytest.approx(np.ptp(moving) / whole.running[-1], abs=0.02)
    assert 0.0 < energy < whole.sums["traction"][-1]
    if last < 2000:
        assert each.table["traction"].isna().tolist() == [True, False, False, False]
    row = found.directions[0].trips_table().rows[0]
    assert any(f"{share:.1%} missing" in str(cell) for cell in row)
    # The picture has a break there.
    work = each.trip.drawn_work
    assert np.isnan(work).any()
    assert not np.isnan(whole.drawn_work).any()


def moved(trip: Trip, by: Callable[[np.ndarray], np.ndarray], name: str) -> Trip:
    state = trip["/train/state"]
    found = trip.with_topic(state.assign(position=by(state["position"].to_numpy())))
    return replace(found, metadata={**trip.metadata, "trip": name})


def spiked() -> Trip:
    return moved(stopping(), lambda s: np.where(np.arange(s.size) % 4001 == 4000, 0.0, s), "spike")


def test_chainage_that_is_set_back_costs_no_time_and_is_stated():
    back = moved(stopping(), lambda s: s - 12.0 * (s > 4_000.0), "back")
    found = compare([stopping(), back], stopping()).trip("back")
    # Twelve metres at 30 m/s, and as many in front of the stops.
    assert abs(found.lost.total) < 0.5
    assert any("chainage set back at km 3.99" in note or "km 4.00" in note
               for note in found.trip.notes)  # fmt: skip
    found = compare([stopping(), spiked()], stopping()).trip("spike")
    assert abs(found.lost.total) < 0.2
    assert any("3 samples far off left out" in note for note in found.trip.notes)


def test_a_counter_that_starts_anew_is_left_out_with_the_reason():
    anew = moved(stopping(), lambda s: np.where(s > 14_476.0, s - 14_476.0, s), "anew")
    found = compare([stopping(), nonstop(), anew])
    assert len(found.directions[0].trips) == 2
    assert "trip 'anew' runs backwards by" in found.left_out[0]
    refused(InputError, r"no trip can be compared: .*runs backwards", compare, anew)


@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_chainage_that_falls_beside_a_speed_is_refused_by_every_analysis(direction):
    falling = moved(stopping(), lambda s: s.max() - s, "falling")
    falling = replace(falling, metadata={**falling.metadata, "direction": direction})
    for analysed in (driven_trip, slip, fit_trip, with_estimates):
        said = "runs backwards by .* position must grow in the direction of travel"
        refused(TrainlogError, said, analysed, falling)
    # Spikes do not run backwards.
    assert len(slip(spiked()).events) > 10


# What was done to a driver who always drives as fast as his habits allow is the truth.

HABITS = Habits(coasting=0.0, margin=0.7, lever=0.9)


def scenario(line: Line = LINE, name: str = "free", **changes: object) -> Scenario:
    drawn = draw_scenarios(line, TRAIN, 1, seed=8)[0]
    stops = plan(line, TRAIN, (LINE.stations[0], LINE.stations[-1]), reserve=-0.2)
    dry = StepProfile([0.0], [0.45])
    return replace(drawn, name=name, stops=stops, habits=HABITS, maximum_adhesion=dry, **changes)


@cache
def free() -> Trip:
    return simulate(scenario())


def test_a_temporary_limit_costs_what_it_costs():
    limits = LINE.speed_limits
    before, rest = limits.positions < 11_000.0, limits.positions > 12_500.0
    at, permitted = limits.positions, limits.values
    places = np.concatenate((at[before], [11_000.0, 12_500.0], at[rest]))
    values = np.concatenate((permitted[before], [60 / 3.6, limits(12_500.0)], permitted[rest]))
    lower = StepProfile(places, values)
    slowed = simulate(scenario(replace(LINE, speed_limits=lower), "slowed"))
    attached = {**slowed.attachments, LINE_ATTACHMENT: line_to_bytes(LINE)}
    found = compare([free(), replace(slowed, attachments=attached)], free()).trip("slowed")
    truth = driven_trip(slowed).duration - driven_trip(free()).duration
    assert truth > 30.0
    assert found.lost.total == pytest.approx(truth, abs=1e-6)
    assert found.lost.by_cause()["limit"] == pytest.approx(truth, abs=2.0)
    assert found.table["excess"].max() == 0.0


def test_a_signal_at_stop_costs_the_stand_and_the_way_to_and_from_it():
    ends = scenario().stops
    signal = Stop("signal", 11_500.0, 300.0, 330.0)
    held = simulate(replace(scenario(name="held"), stops=(ends[0], signal, ends[1])))
    found = compare([free(), held], free()).trip("held")
    truth = driven_trip(held).duration - driven_trip(free()).duration
    assert truth > 70.0
    assert found.lost.by_cause()["held"] == pytest.approx(truth, abs=3.0)
    assert found.table["stood"].max() > 25.0
    assert found.table["dwell"].sum() == 0.0


def test_poor_adhesion_costs_what_it_costs():
    poor = StepProfile([0.0, 900.0], [0.06, 0.45])
    slipped = simulate(replace(scenario(name="slipped"), maximum_adhesion=poor))
    found = compare([free(), slipped], free()).trip("slipped")
    truth = driven_trip(slipped).duration - driven_trip(free()).duration
    assert truth > 5.0
    assert found.lost.by_cause()["slip"] == pytest.approx(truth, abs=0.15 * truth)
    assert found.table["slips"].iloc[0] > 0
    assert found.table["slips"].iloc[1:].sum() == 0


def test_energies_of_unlike_loads_are_alike_at_one_load():
    """The same driver with another load and another driver's time; truth: drive it so."""
    heavy = replace(scenario(name="heavy"), mass=TRAIN.mass + 24_000.0)
    light = replace(scenario(name="light"), mass=TRAIN.mass + 1_000.0)
    trips = [simulate(each) for each in (heavy, light)]
    heavier = compare(trips, trips[1]).trip("heavy")
    found, recorded = heavier.energy, heavier.trip.sums["traction"][-1]
    truth = driven_trip(trips[1]).sums["traction"][-1]
    assert recorded > 1.02 * truth
    assert abs(found.value - truth) < 1.96 * found.std
    assert abs(found.value - truth) < 0.5 * (recorded - truth)
    assert found.std < 0.03 * truth


def test_energy_from_the_line_is_what_voltage_and_current_recorded():
    """A supply at 15 kV, whose current is drawn at 80 %, and one that fails for a while."""
    controls, state = stopping()["/train/controls"], stopping()["/train/state"]
    power = controls["tractive_effort"].to_numpy() * state["speed"].to_numpy() / 0.8
    time = state.index.as_unit("ns").asi8
    fed = {"line_voltage": np.full(power.size, 15e3), "line_current": power / 15e3}
    supply = frame_of(schema.TRAIN_SUPPLY, time, fed)
    drawn = float(np.sum(0.5 * (power[1:] + power[:-1]) * np.diff(time) * 1e-9))
    found = compare(stopping().with_topic(supply)).trip("trip-03").table
    assert found["line"].sum() == pytest.approx(drawn, rel=1e-3)
    by_file = compare(stopping()).trip("trip-03").table
    assert by_file["line"].sum() < 0.99 * found["line"].sum()
    failed = supply.copy()
    failed.iloc[1500:1700, failed.columns.get_loc("line_current")] = np.nan
    table = compare(stopping().with_topic(failed)).trip("trip-03").table
    assert table["line"].isna().tolist() == [True, False, False, False]


def test_a_trajectory_is_a_reference_whose_times_and_work_are_its_own():
    """Half a minute of acceleration, three of 20 m/s, half of braking: everything is known."""
    mass, metres = 150_000.0, 14_476.0
    nodes = np.array([0.0, 300.0, metres - 300.0, metres])
    configuration = Configuration("plan", mass, 0.0, TRAIN.resistance, TRAIN.max_traction_power)
    duration = 30.0 + (metres - 600.0) / 20.0 + 30.0
    speeds, times = [[0.0, 20.0, 20.0, 0.0]], [[0.0, 30.0, duration - 30.0, duration]]
    efforts = np.array([100e3, 12e3, 0.0]), np.array([[0.0, 0.0, 100e3]])
    course = np.array(speeds), np.array(times), *efforts, duration
    plan = Trajectory(LINE.name, TRAIN.name, nodes, (configuration,), *course)
    found = compare([stopping(), nonstop()], plan)
    (direction,) = found.directions
    assert direction.reference.planned
    reference = direction.reference
    assert reference.duration == pytest.approx(duration, abs=0.1)
    rows = direction.trips_table().rows
    assert [row[0] for row in rows] == ["trip-03", "trip-01", "trajectory"]
    assert rows[-1][6].value == pytest.approx(reference.sums["traction"][-1], rel=1e-6)
    assert reference.sums["traction"][-1] == pytest.approx(100e3 * 300 + 12e3 * 13_876.0)
    for name in ("trip-03", "trip-01"):
        lost = found.trip(name).lost
        assert found.trip(name).common == pytest.approx((0.0, metres), abs=20.0)
        assert lost.losses["lost"].sum() == pytest.approx(lost.total, abs=1e-9)
    # To Flawil and no further: what the trip took until it arrived there, less the plan's time.
    own = driven_trip(stopping())
    until = float(own.time[np.searchsorted(own.position, metres - 20.0)])
    assert found.trip("trip-03").lost.total == pytest.approx(until - duration, abs=15.0)


def trip(name: str = "t", effort: float = 50_000.0, stop: bool = False, **metadata: str) -> Trip:
    """Stands 10 s, runs 600 s at 20 m/s (with a stop of 20 s on demand), stands 10 s."""
    speed = np.concatenate((np.zeros(100), np.full(6000, 20.0), np.zeros(100)))
    if stop:
        speed[3000:3200] = 0.0
    time = np.arange(speed.size) * 100_000_000
    position = np.concatenate(([0.0], np.cumsum(speed[:-1]) * 0.1))
    running = speed > 0.0
    efforts = {"tractive_effort": effort * running, "dynamic_braking_effort": 1e4 * running}
    state = frame_of(schema.TRAIN_STATE, time, {"speed": speed, "position": position})
    controls = frame_of(schema.TRAIN_CONTROLS, time, efforts)
    files = {LINE_ATTACHMENT: DEFAULT_LINE, TRAIN_ATTACHMENT: DEFAULT_TRAIN}
    return Trip(
        {"/train/state": state, "/train/controls": controls},
        {"trip": name, "direction": "forward", "load": "10000", **metadata},
        attachments={name: sample(file).read_bytes() for name, file in files.items()},
    )


@pytest.mark.parametrize("every", [5, 10])
def test_efforts_of_which_single_samples_are_missing_are_bridged(every):
    controls = stopping()["/train/controls"].copy()
    lost = np.arange(len(controls)) % every == 0
    lost = lost if every == 5 else ~lost
    controls.loc[lost, "tractive_effort"] = np.nan
    whole, found = (driven_trip(each) for each in (stopping(), stopping().with_topic(controls)))
    assert found.work("traction") == pytest.approx(whole.work("traction"), rel=1e-3)
    assert not found.notes


@pytest.mark.parametrize("topic", ["/train/state", "/train/controls"])
def test_the_energy_of_a_trip_that_is_recorded_seldom_has_a_stated_band(topic):
    frame, whole = stopping()[topic], driven_trip(stopping()).work("traction")
    for seconds in (1, 3, 5, 10):
        found = driven_trip(stopping().with_topic(frame.iloc[:: 10 * seconds]))
        said = f"speed or efforts every {seconds} s: energy within ± "
        bands = [float(n.removeprefix(said)[:-1]) / 100.0 for n in found.notes if said in n]
        assert len(bands) == (seconds > 1)
        assert found.work("traction") == pytest.approx(whole, rel=max([0.001, *bands]))
    assert bands[0] < 0.2


def test_efforts_that_are_missing_everywhere_for_some_seconds_are_stated():
    controls = stopping()["/train/controls"].copy()
    lost = np.arange(len(controls)) % 150 < 30
    controls.loc[lost, "tractive_effort"] = np.nan
    found = compare(stopping().with_topic(controls))
    trip = found.trip("trip-03")
    assert trip.facts["traction"] is None
    missing = float(np.ptp(trip.trip.sums["unknown_traction"]))
    assert 200.0 < missing < 0.5 * trip.trip.duration
    said = f"trip-03: no effort for {missing:.0f} s in all sections together: the energy of none is"
    assert said in found._repr_html_()


def test_work_is_effort_times_distance():
    cost = trip_cost(trip())
    assert cost.distance == pytest.approx(12_000.0)
    assert cost.traction == pytest.approx(50_000.0 * 12_000.0, rel=1e-3)
    assert cost.dynamic_braking == pytest.approx(10_000.0 * 12_000.0, rel=1e-3)
    # The FLIRT's efficiencies are 90 % both ways.
    assert cost.line == pytest.approx(cost.traction / 0.9 - 0.9 * cost.dynamic_braking)
    assert cost.mass == 132_000.0


def test_trips_too_short_to_compare_are_refused_or_left_out_with_the_reason():
    state = trip()["/train/state"]
    refused(LogError, "never moves", trip_cost, trip().with_topic(state.assign(speed=0.0)))
    refused(LogError, "one sample with a chainage", trip_cost, trip().with_topic(state.iloc[:1]))
    rests = trip("rests").with_topic(state.assign(position=5_000.0))
    refused(InputError, "goes on by 0 m of chainage: too short to compare", compare, rests)
    found = compare([rests, trip()])
    assert [each.trip.name for each in found.directions[0].trips] == ["t"]
    assert "'rests' goes on by 0 m" in found.left_out[0]


def test_the_stops_on_a_line_without_stations_have_no_names_and_efforts_may_be_unknown():
    found = compare(without(stopping(), "/train/controls"))
    assert found.trip("trip-03").table["traction"].isna().all()
    assert "no efforts are recorded" in found._repr_html_()
    bare = line_to_bytes(replace(LINE, stations=()))
    stops = replace(trip(stop=True), attachments={**trip().attachments, LINE_ATTACHMENT: bare})
    assert [each.station for each in driven_trip(stops).stands] == ["", "", ""]
    assert trip_cost(stops).stops == 1


def test_slip_protection_that_is_not_recorded_is_not_zero():
    """A flag counts where there is one, else events; without both, how often is not known."""
    silent = followed("departure from A", "arrival at B", late=0.1)
    assert trip_cost(silent).slips is None
    assert punctuality([silent, followed("slip protection active", late=0.1)]).slips is None
    mapped = replace(silent, metadata={**silent.metadata, "slip_protection": "events"})
    assert trip_cost(mapped).slips == 0
    active = np.array([0.0, 2.0, 1.0, np.nan, 1.0, 0.0, 1.0])
    flags = frame_of(schema.TRAIN_SLIP_PROTECTION, np.arange(7) * 1_000_000_000, {"active": active})
    assert trip_cost(silent.with_topic(flags)).slips == 2


def followed(*messages: str, late: float) -> Trip:
    """A trip that followed a trajectory, with events."""
    seconds, name = np.arange(6) * 1_000_000_000, np.full(len(messages), "drive", dtype=object)
    words = {"message": np.array(messages, dtype=object), "name": name}
    events = {"level": np.full(len(messages), 3), **words}
    stated = frame_of(schema.EVENTS, seconds[: len(messages)], events)
    lateness = {"lateness": np.linspace(0.0, late, 6)}
    return trip().with_topic(stated).with_topic(frame_of(schema.REFERENCE, seconds, lateness))


def test_nothing_comparable_is_reported():
    backwards = replace(trip("a"), metadata={**trip("a").metadata, "direction": "reverse"})
    followed = [trip("driven-a", configuration="a"), trip("driven-c", configuration="c")]
    stopped = [trip(name, stop=True) for name in "abc"]
    for drivers, nearest in (
        ([], "there is no trip of the configuration that 'driven-a' drove with"),
        ([backwards], "'a' ran reverse, 'driven-a' forward"),
        (stopped[:1], "'a' ran 11.6 km, 'driven-a' 12.0 km"),
        (stopped[::2], "'a' ran 11.6 km, 'driven-a' 12.0 km"),
    ):
        words = f"comparable trip by a driver: {nearest}; needs one non-stop trip"
        refused(LogError, words, compare_groups, drivers, followed)
    groups = [backwards, stopped[1]], [*followed, trip("driven-b", stop=True, configuration="b")]
    words = "driver: 'b' stopped 1x and 'driven-b' stopped 1x; needs"
    refused(LogError, words, compare_groups, *groups)


def test_a_plan_for_the_nominal_train_is_compared_by_train_and_says_so():
    drivers = [trip("a", 60_000.0, load="20000"), trip("b", stop=True)]
    found = compare_groups(drivers, [trip("driven", 40_000.0, configuration="nominal")])
    (pair,) = found.pairs
    assert (pair.driver.name, pair.trajectory.name) == ("a", "driven")
    assert found.remarks == (
        "'driven' followed a plan for the train of its file, at 132.0 t; 'a' ran at 142.0 t",
    )
    assert found.remarks[0] in found.notes[0]
    other = trip("other")
    content = other.attachments[TRAIN_ATTACHMENT].replace(b"CH_Stadler_FLIRT_TPF", b"another")
    other = replace(other, attachments={**other.attachments, TRAIN_ATTACHMENT: content})
    followed = [trip("driven", configuration="nominal")]
    words = "no trip of the train that 'driven' drove with"
    refused(LogError, words, compare_groups, [other], followed)


def test_a_trip_of_the_name_is_of_the_same_train_and_line():
    """Trips are called trip-01 on every line: only one of the train and the line compares."""
    driven = trip("driven-a", 40_000.0, configuration="a")
    attached = trip("a").attachments
    for attachment, name in (
        (TRAIN_ATTACHMENT, b"CH_Stadler_FLIRT_TPF"),
        (LINE_ATTACHMENT, b"CH_StGallen_Wil"),
    ):
        content = attached[attachment].replace(name, b"another")
        other = replace(trip("a"), attachments={**attached, attachment: content})
        words = "no trip of the configuration that 'driven-a' drove"
        refused(LogError, words, compare_groups, [other], [driven])
        assert compare_groups([other, trip("a")], [driven]).pairs[0].driver.name == "a"
    words = "2 trips are called 'a', the configuration of 'driven-a'"
    refused(LogError, words, compare_groups, [trip("a"), trip("a", stop=True)], [driven])


def test_trips_that_followed_nothing_are_named_with_their_file():
    path = sample("nonstop.mcap")
    words = "trip 'trip-01' did not follow a trajectory; give trips recorded by"
    caught = refused(LogError, words, compare_groups, path, path)
    assert caught.file == path
    for followed, words in (
        ([trip("b"), trip("c")], "'b' did not follow a trajectory, nor did 1 other;"),
        ([], "no trip that followed a trajectory was given"),
    ):
        refused(LogError, words, compare_groups, [trip("a")], followed)


def test_groups_are_compared_by_their_mean_and_spread_and_pairs_of_one_configuration():
    drivers = [trip("a", effort=60_000.0), trip("b", effort=50_000.0), trip("d", stop=True)]
    followed = [trip(f"driven-{name}", 40_000.0, configuration=name) for name in "abcd"]
    groups = compare_groups(drivers, followed)
    assert [pair.driver.name for pair in groups.pairs] == ["a", "b"]
    saved = [pair.traction for pair in groups.pairs]
    assert saved == pytest.approx([20_000.0 * 12_000.0, 10_000.0 * 12_000.0], rel=1e-3)
    assert "27.3% at the wheel rims (100.00 kWh of 366.67 kWh), 32.0% from" in groups.saved_words
    driver, own, saved = groups.tables()[0].words[-1][1:4]
    # 50 kN and 60 kN over 12 km are 167 and 200 kWh, 40 kN are 133 kWh.
    assert driver.startswith("183.33 kWh ± 23.57 kWh, 600 ± 0 s")
    assert own.startswith("133.33 kWh ± 0.00 kWh")
    assert saved == "50.00 kWh ± 23.57 kWh"


OWN = TRAIN.resistance


@cache
def drawn_scenario() -> Scenario:
    return draw_scenarios(read_line(sample(DEFAULT_LINE)), TRAIN, 3, seed=11)[2]


@cache
def driven() -> Trip:
    """Its resistance, load and gradients are drawn: they are not those of the files."""
    return simulate(drawn_scenario())


def true_work(trip: Trip) -> float:
    """Of the recorded efforts over the true way [J]."""
    speed, effort = trip["/truth"]["speed"], trip["/train/controls"]["tractive_effort"]
    return float((effort.to_numpy() * speed.to_numpy()).sum() * 0.1)


def test_the_true_model_calculates_the_true_work_and_time():
    """A set of the one true configuration; its band is that of gradients, load and efforts."""
    mass, own, power = drawn_scenario().mass, drawn_scenario().resistance, TRAIN.max_traction_power
    true = Configuration("true", mass, TRAIN.rotating_mass, own, power)
    covariance = np.diag(np.array([OWN.r0, OWN.r1, OWN.r2]) * 0.005) ** 2
    sure = ParameterSet(TRAIN.name, (true, true), own, covariance, (0.0, 40.0))
    found = calculate(driven(), sure, wind_std=3.0)
    assert found.outside == []
    assert found.total("calculated_work") == pytest.approx(true_work(driven()), rel=0.01)
    assert 1.96 * found.total("work_std") < 0.3 * true_work(driven())
    calm = calculate(driven(), sure, wind_std=0.0)
    assert calm.outside == []
    assert calm.total("time_std") < 0.6 * found.total("time_std")


def wrong_file(name: str) -> Train:
    return replace(TRAIN, resistance=replace(OWN, **{name: 4.0 * getattr(OWN, name)}))


WIND = 6.0


@cache
def windy(recorded: bool) -> Trip:
    """The same trip against a head wind, of which a recorder may keep what it measures."""
    if not recorded:
        own = drawn_scenario().resistance
        more = own.r2 * WIND**2, 2.0 * own.r2 * WIND
        against = RunningResistance(own.r0 + more[0], own.r1 + more[1], own.r2)
        return simulate(replace(drawn_scenario(), resistance=against))
    trip = windy(False)
    frame = trip["/environment"]
    rng = np.random.default_rng(5)
    changed = frame.assign(head_wind=WIND - 0.6 + 1.5 * rng.standard_normal(len(frame)))
    changed.attrs = frame.attrs
    return trip.with_topic(changed)


def test_a_wind_is_no_error_of_the_file_and_recorded_makes_bands_narrower_and_times_truer():
    unknown, known = (calculate(windy(recorded), TRAIN) for recorded in (False, True))
    assert unknown.diagnosis.wrong == known.diagnosis.wrong == ()
    assert unknown.outside == known.outside == []
    assert "head wind not recorded" in unknown._repr_html_()
    assert known.total("time_std") < 0.6 * unknown.total("time_std")
    off = [abs(each.total("calculated_time") - each.total("time")) for each in (unknown, known)]
    assert off[1] < 0.4 * off[0]
    fits = [fit_trip(windy(recorded)).resistance for recorded in (False, True)]
    truth = drawn_scenario().resistance(25.0)
    assert abs(fits[1](25.0) - truth) < 0.4 * abs(fits[0](25.0) - truth)


@pytest.mark.parametrize("name", ["r0", "r2"])
def test_a_coefficient_that_is_four_times_too_large_is_named(name):
    found = calculate(driven(), wrong_file(name), wind_std=3.0)
    (named,) = found.diagnosis.wrong
    assert named.name == name
    assert named.factor - 1.96 * named.factor_std < 4.0 < named.factor + 2.5 * named.factor_std
    assert len(found.outside) == len(found.table)
    assert found.explained["running resistance"] > 0.9


def test_a_mass_that_is_ten_per_cent_off_is_named_with_the_efforts():
    rotating = TRAIN.rotating_mass_factor / 0.9
    lighter = replace(TRAIN, mass=0.9 * TRAIN.mass, rotating_mass_factor=rotating)
    found = calculate(driven(), lighter)
    (named,) = found.diagnosis.wrong
    assert (named.name, named.alternatives) == ("mass", ("recorded efforts",))
    assert named.factor == pytest.approx(0.9, abs=0.03)
    assert found.explained["mass or gain of efforts"] > 0.8


def test_without_a_recorded_load_a_mass_is_not_named_and_the_band_is_wide():
    metadata = {k: v for k, v in driven().metadata.items() if not k.startswith("load")}
    unknown = calculate(replace(driven(), metadata=metadata), TRAIN)
    known = calculate(driven(), TRAIN)
    assert unknown.diagnosis.wrong == ()
    assert unknown.outside == []
    assert unknown.total("work_std") > 1.05 * known.total("work_std")


def test_without_efforts_the_energy_is_calculated_with_a_band_that_holds_the_truth():
    found = calculate(without(driven(), "/train/controls", "/train/axles"), TRAIN, wind_std=3.0)
    assert not found.inputs.efforts
    assert found.table["work"].isna().all()
    energy = true_work(driven())
    off = found.total("calculated_work") - energy
    assert abs(off) < 1.96 * found.total("work_std") < 0.2 * energy
    assert found.diagnosis.not_judged


def test_a_trip_too_short_to_calculate_is_refused():
    short, least = driven().within(0.0, 15.0), driven().within(0.0, 22.0)
    refused(LogError, r"runs \d+\.\d m only; give one of at least 20 m", calculate, short, TRAIN)
    assert len(calculate(least, TRAIN).table) == 1


def test_efforts_that_are_missing_everywhere_explain_nothing():
    controls = driven()["/train/controls"].copy()
    kept = np.arange(len(controls)) % 90 >= 30
    controls["tractive_effort"] = controls["tractive_effort"].where(kept)
    found = calculate(driven().with_topic(controls), TRAIN)
    assert (found.explained, found.residual) == ({}, 0.0)
    assert found.plot().axes
    assert found.summary()["tractive work"] == "not determined"


def test_brakes_that_are_not_recorded_are_no_error_of_the_model():
    """Without them the model seemed to need half of the work, and was contradicted."""
    unrecorded = ["pneumatic_braking_effort", "dynamic_braking_effort"]
    whole = stopping()
    controls = whole["/train/controls"].assign(**dict.fromkeys(unrecorded, np.nan))
    trip = replace(whole, topics={**whole.topics, "/train/controls": controls})
    found, complete = calculate(trip, TRAIN), calculate(whole, TRAIN)
    assert found.outside == []
    work = complete.total("calculated_work")
    assert found.total("calculated_work") == pytest.approx(work, rel=0.01)
    (note,) = found.notes
    assert "friction brake is not recorded" in note
    assert complete.notes == ()
    # A model that is wrong still shows between the brakings.
    assert [each.name for each in calculate(trip, wrong_file("r2")).diagnosis.wrong] == ["r2"]


@pytest.mark.usefixtures("unpainted")
def test_a_trip_that_is_refused_does_not_stop_the_others(tmp_path, shell):
    good, short = sample("stopping.mcap"), tmp_path / "short.mcap"
    write_log(driven().within(0.0, 15.0), short)
    words = ("compare", "calculated", short, good, "--model", sample(DEFAULT_TRAIN))
    status, shown, complaint = shell(*words, "--json")
    assert (status, len(json.loads(shown)["trips"])) == (1, 1)
    assert complaint.startswith(f"trainlog: {short}: trip 'trip-03' runs ")
    other = tmp_path / "stopping.mcap"
    shutil.copy(good, other)
    status, _, complaint = shell(*words, other, "--picture", tmp_path / "p.png")
    assert (status, list(tmp_path.glob("*.png"))) == (2, [])
    assert f"{other}: has the same name as {good}" in complaint


def test_trips_together_contradict_what_one_leaves_open():
    logs = [sample("stopping.mcap"), sample("nonstop.mcap")]
    trips = [calculate(log, wrong_file("r2")) for log in logs]
    together = judged_together(trips)
    assert [each.name for each in together.wrong] == ["r2"]
    assert together.judged_trips == 2
    stds = [each.diagnosis.wrong[0].factor_std for each in trips]
    assert together.wrong[0].factor_std < max(stds)
    refused(InputError, "one train", judged_together, [])


@cache
def compared_whole() -> ComparedTrip:
    return compare(stopping()).trip("trip-03")


def interrupted(trip: Trip, topic: str, *columns: str, first: float) -> Trip:
    frame = trip[topic]
    since = (frame.index - trip["/train/state"].index[0]).total_seconds().to_numpy()
    inside = (since > first) & (since < first + 20.0)
    changed = frame.copy() if columns else frame[~inside]
    for column in columns:
        changed.loc[inside, column] = np.nan
    return trip.with_topic(changed)


STATE, CONTROLS, AXLES, MOTION = "/train/state", "/train/controls", "/train/axles", "/gnss/motion"


@pytest.mark.parametrize(
    ("lost", "topics", "first", "words"),
    [
        ((STATE, "speed"), (), 25.0, "no speed for 20 s, bridged by"),
        ((STATE, "speed"), (AXLES, MOTION), 600.0, "no speed for 20 s, bridged by position"),
        ((STATE, "position"), (), 600.0, "no position for 20 s, bridged by speed"),
        ((STATE, "speed", "position"), (MOTION,), 150.0, "no speed for 20 s, bridged by wheel sp"),
        ((STATE, "speed", "position"), (AXLES,), 25.0, "no speed for 20 s, bridged by satellites'"),
    ],
)
def test_work_over_a_bridged_gap_is_that_of_the_true_motion(lost, topics, first, words):
    trip = without(interrupted(stopping(), *lost, first=first), *topics)
    found, own = compare(trip).trip("trip-03"), compared_whole()
    assert found.trip.sums["traction"][-1] == pytest.approx(true_work(trip), rel=0.01)
    np.testing.assert_allclose(found.table["traction"], own.table["traction"], rtol=0.01)
    np.testing.assert_allclose(found.table["running_time"], own.table["running_time"], atol=0.5)
    assert any(words in note for note in found.trip.notes)
    assert not found.trip.flags["unknown_speed"].any()


@pytest.mark.parametrize(
    ("lost", "topics", "words"),
    [
        ((STATE, "speed", "position"), (AXLES, MOTION), "no speed for 20 s, not known there"),
        ((CONTROLS,), (), "no effort for 20 s, not known there"),
        ((CONTROLS, "tractive_effort"), (), "no effort for 20 s, not known there"),
    ],
)
def test_work_over_a_gap_that_nothing_bridges_is_not_stated(lost, topics, words):
    trip = without(interrupted(stopping(), *lost, first=600.0), *topics)
    cost = trip_cost(trip)
    assert np.isnan(cost.traction)
    assert cost.unknown
    assert np.isnan(cost.line)
    compared = compare(trip)
    found, own = compared.trip("trip-03"), compared_whole()
    work, known = found.table["traction"], own.table["traction"]
    lacks = work.isna().to_numpy()
    assert lacks.sum() == 1
    np.testing.assert_allclose(work[~lacks], known[~lacks], rtol=2e-3)
    assert words in compared._repr_html_()


def test_energy_from_the_line_lacks_what_lacks_of_traction_or_brake():
    trip = interrupted(stopping(), CONTROLS, "dynamic_braking_effort", first=600.0)
    found = compare(trip).trip("trip-03")
    assert found.recorded_energy("traction")[1] == pytest.approx(0.0, abs=1e-9)
    share = 20.0 / found.trip.running[-1]
    assert found.recorded_energy("line")[1] == pytest.approx(share, rel=0.02)


def test_a_trip_with_position_alone_has_its_speed_from_there():
    trip = stopping().with_topic(stopping()["/train/state"].assign(speed=np.nan))
    assert trip_cost(trip).traction == pytest.approx(true_work(trip), rel=0.01)


@pytest.mark.parametrize("bridged", [True, False])
def test_a_calculation_starts_anew_behind_a_gap(bridged):
    trip = interrupted(driven(), "/train/state", "speed", first=200.0)
    if not bridged:
        trip = interrupted(trip, "/train/state", "position", first=200.0)
        trip = without(trip, "/train/axles", "/gnss/motion")
    found, own = calculate(trip, TRAIN), calculate(driven(), TRAIN)
    sums = driven_trip(trip).unknown()
    assert sums is not bridged
    if bridged:
        assert found.total("work") == pytest.approx(own.total("work"), rel=0.01)
        work = own.total("calculated_work")
        assert found.total("calculated_work") == pytest.approx(work, rel=0.01)
        assert np.nanmax(np.abs(found.calculated_speed - own.calculated_speed)) < 1.0
    else:
        lacks = found.table["work"].isna()
        assert lacks.sum() == 1
        assert (found.table["calculated_work"].isna() == lacks).all()
        assert np.isnan(found.speed).sum() > np.isnan(own.speed).sum()
        behind = np.flatnonzero(np.isnan(found.speed[100:]))[-1]
        assert behind > 0
    np.testing.assert_allclose(
        found.table["time"], compare(trip).directions[0].trips[0].table["running_time"], atol=1e-6
    )
    off = found.table["calculated_time"] - own.table["calculated_time"]
    assert off.abs().max() < 3.0
    assert f"{trip.name}: no speed for 20 s" in found._repr_html_()


def test_what_a_model_does_not_determine_is_said_so_and_a_drive_given_twice_is_judged_once():
    found = calculate(driven(), TRAIN)
    assert judged_together([found, replace(found, notes=("copy",))]).judged_trips == 1
    assert "1 given twice, counted once" in together_words([found, found], found.diagnosis)
    first = found.table.index[0]
    table = found.table.copy()
    table.loc[first, "time_determined"] = False
    vague = replace(found, table=table)._repr_html_()
    assert "not determined" in vague
    assert f"does not determine the running time of {first}" in vague
    assert replace(found, table=table).summary()["running time"] == "not determined"
    stopping = calculate(sample("stopping.mcap"), TRAIN)
    table = stopping.table.copy()
    table["time_determined"] = table.index != table.index[0]
    part = replace(stopping, table=table).summary()["running time"]
    assert part.endswith(f" s measured on {len(table) - 1} of {len(table)} sections")
    # A resistance twelve times the train's stops it before the section ends.
    heavy = replace(TRAIN, resistance=OWN.scaled(12.0))
    assert calculate(driven(), heavy).not_determined["running time"]
