"""Measured against calculated: a right model agrees within its band, a wrong one is named."""

import json
import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from refusals import refused
from trip_parts import without

from analysis.comparison.calculated import calculate, judged_together, together_words
from analysis.comparison.compare import ComparedTrip, compare
from analysis.comparison.driven import driven_trip
from analysis.comparison.groups import trip_cost
from analysis.resistance import fit_trip
from trainlog.errors import InputError, LogError
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.mcap import read_log, write_log
from trainlog.railway import Configuration, ParameterSet, RunningResistance, Train
from trainlog.simulation import draw_scenarios, simulate
from trainlog.simulation.scenario import Scenario
from trainlog.trip import Trip

pytestmark = pytest.mark.usefixtures("remembered")

TRAIN = read_train(sample(DEFAULT_TRAIN))
OWN = TRAIN.resistance


@cache
def scenario() -> Scenario:
    return draw_scenarios(read_line(sample(DEFAULT_LINE)), TRAIN, 3, seed=11)[2]


@cache
def driven() -> Trip:
    """Its resistance, load and gradients are drawn: they are not those of the files."""
    return simulate(scenario())


def true_work(trip: Trip) -> float:
    """Of the recorded efforts over the true way [J]."""
    speed, effort = trip["/truth"]["speed"], trip["/train/controls"]["tractive_effort"]
    return float((effort.to_numpy() * speed.to_numpy()).sum() * 0.1)


def test_the_true_model_calculates_the_true_work_and_time():
    mass, own, power = scenario().mass, scenario().resistance, TRAIN.max_traction_power
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
    if not recorded:
        own = scenario().resistance
        more = own.r2 * WIND**2, 2.0 * own.r2 * WIND
        against = RunningResistance(own.r0 + more[0], own.r1 + more[1], own.r2)
        return simulate(replace(scenario(), resistance=against))
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
    truth = scenario().resistance(25.0)
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
    unrecorded = ["pneumatic_braking_effort", "dynamic_braking_effort"]
    whole = read_log(sample("stopping.mcap"))
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
def whole() -> Trip:
    return read_log(sample("stopping.mcap"))


@cache
def compared_whole() -> ComparedTrip:
    return compare(whole()).trip("trip-03")


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
    trip = without(interrupted(whole(), *lost, first=first), *topics)
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
    trip = without(interrupted(whole(), *lost, first=600.0), *topics)
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
    trip = interrupted(whole(), CONTROLS, "dynamic_braking_effort", first=600.0)
    found = compare(trip).trip("trip-03")
    assert found.recorded_energy("traction")[1] == pytest.approx(0.0, abs=1e-9)
    share = 20.0 / found.trip.running[-1]
    assert found.recorded_energy("line")[1] == pytest.approx(share, rel=0.02)


def test_a_trip_with_position_alone_has_its_speed_from_there():
    trip = whole().with_topic(whole()["/train/state"].assign(speed=np.nan))
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
