"""A recorder's own quantities and the passport of a trip: what is kept and estimated."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from ingest_logs import plain_profile, write
from refusals import refused
from rerun.chunk import RrdReader
from trip_parts import without

import trainlog
from analysis.resistance import fit_trip
from analysis.resistance.passport import (
    _speed_noise,
    estimated_passport,
    ratio_of_speeds,
    shared_delay_std,
    with_effort_delay,
)
from trainlog.errors import InputError, LogError, TrainlogError
from trainlog.formats.declared import thing_from_bytes, thing_to_bytes
from trainlog.formats.railway import passport_of
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.ingest import ingest, report_of
from trainlog.mcap.convert import convert
from trainlog.railway import Passport, Quantity
from trainlog.railway.adhesion import polach_curve
from trainlog.simulation import draw_scenarios, simulate
from trainlog.topics import RECORDED, Field, recorded_topic
from trainlog.trip import Trip, frame_of

START = 1_700_000_000 * 10**9
PANTOGRAPH = recorded_topic(
    "/recorded/pantograph",
    [Field("contact_force", "N", "of the strip"), Field("raised", "1", "whether up", "previous")],
)
WORDS = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)


def made(rows: int = 40) -> Trip:
    time = START + np.arange(rows) * 10**9
    driven = {"position": 20.0 * np.arange(rows), "speed": np.full(rows, 20.0)}
    state = frame_of(trainlog.topics.TRAIN_STATE, time, driven)
    pressed = {"contact_force": 70.0 + np.arange(rows), "raised": 1.0 * (np.arange(rows) > 8)}
    own = frame_of(PANTOGRAPH, time, pressed)
    return Trip({"/train/state": state, PANTOGRAPH.name: own}, {"trip": "own"})


@given(
    st.dictionaries(
        st.lists(WORDS, min_size=1, max_size=2).map(lambda words: RECORDED + "/".join(words)),
        st.dictionaries(
            WORDS, st.tuples(st.sampled_from(["Pa", "1", "V", "m^2/s"]), st.text(max_size=9))
        ).filter(bool),
        min_size=1,
        max_size=3,
    ),
    st.integers(0, 5),
)
@settings(max_examples=15)
def test_whatever_a_recorder_has_reads_back_as_it_was(tmp_path_factory, described, rows):
    time = START + np.arange(rows) * 10**8
    topics = [
        recorded_topic(name, [Field(field, *each) for field, each in fields.items()])
        for name, fields in described.items()
    ]
    frames = {}
    for topic in sorted(topics, key=lambda each: each.name):
        data = {field.name: np.arange(rows) / 7.0 for field in topic.fields}
        frames[topic.name] = frame_of(topic, time, data)
    trip = Trip(frames, {"trip": "any"})
    folder = tmp_path_factory.mktemp("own")
    trainlog.write(trip, folder / "a.mcap")
    trainlog.write_parquet(trip, folder / "a.parquet")
    for back in (trainlog.read(folder / "a.mcap"), trainlog.read_parquet(folder / "a.parquet")):
        assert list(back) == list(trip)
        for name, frame in frames.items():
            assert back[name].equals(frame)
            assert back[name].attrs == frame.attrs


def test_cut_converted_recovered_and_streamed_it_stays(tmp_path):
    trip = made()
    trainlog.write(trip, tmp_path / "whole.mcap")
    part = trainlog.read(tmp_path / "whole.mcap", position=(200.0, 400.0))
    assert part[PANTOGRAPH.name]["contact_force"].tolist() == [80.0 + k for k in range(11)]
    alone = trainlog.read(tmp_path / "whole.mcap", {PANTOGRAPH.name: ["raised"]})
    assert list(alone[PANTOGRAPH.name]) == ["raised"]
    convert(tmp_path / "whole.mcap", tmp_path / "whole.parquet")
    convert(tmp_path / "whole.parquet", tmp_path / "again.mcap")
    assert (
        trainlog.read(tmp_path / "again.mcap")[PANTOGRAPH.name].attrs == part[PANTOGRAPH.name].attrs
    )
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "whole.mcap").read_bytes()[:-400])
    trainlog.recover(tmp_path / "cut.mcap", tmp_path / "recovered.mcap")
    for name in ("again.mcap", "recovered.mcap"):
        found = trainlog.read(tmp_path / name)[PANTOGRAPH.name]
        assert found.equals(trip[PANTOGRAPH.name])
    pieces = list(trainlog.stream(tmp_path / "whole.mcap", rows=16))
    assert sum(len(piece[PANTOGRAPH.name]) for piece in pieces) == 40


def test_the_replay_draws_a_plot_a_unit(tmp_path):
    trainlog.write_replay([made()], tmp_path / "own.rrd")
    store = RrdReader(tmp_path / "own.rrd").stream().collect()
    entities = {str(chunk.entity_path) for chunk in store.stream().to_chunks()}
    assert "/trips/own/recorded_1/pantograph/contact_force" in entities
    assert "/trips/own/recorded_2/pantograph/raised" in entities


def test_a_profile_keeps_any_column_in_si(tmp_path):
    rows = [f"2024-05-01T06:00:{i:02d}Z,{60 + i},{300 + i},{25.1},{i % 2},x{i}" for i in range(30)]
    columns = {
        "/train/state.speed": {"column": "v", "unit": "km/h"},
        "/train/supply.line_voltage": {"column": "U", "unit": "kV"},
        "/recorded/motor.temperature": {"column": "T", "unit": "degF", "meaning": "coil"},
        "/recorded/motor.pump": {"column": "pump", "between": "previous"},
    }
    trip = ingest(
        write(tmp_path / "run.csv", rows, "t,v,T,U,pump,note"), plain_profile(columns=columns)
    )
    motor = trip["/recorded/motor"]
    assert motor.attrs["units"] == {"temperature": "K", "pump": "1"}
    assert motor.attrs["meanings"]["temperature"] == "coil"
    assert motor.attrs["interpolation"]["pump"] == "previous"
    assert motor["temperature"].iloc[0] == pytest.approx((300.0 + 459.67) / 1.8)
    assert trip["/train/supply"]["line_voltage"].iloc[0] == 25_100.0
    assert report_of(trip).not_used == {"columns that the profile does not map: note": 1}


def test_names_units_and_descriptions_that_cannot_be_are_refused(tmp_path):
    for name, fields in (
        ("/recorded/Oil", ["a"]),
        ("/recorded/", ["a"]),
        ("/train/oil", ["a"]),
        ("/recorded/oil", ["Ölstand"]),
        ("/recorded/oil", ["a", "a"]),
        ("/recorded/oil", []),
    ):
        listed = [Field(field, "1", "") for field in fields]
        refused(InputError, "recorded/", recorded_topic, name, listed)
    for topic, column, said in (
        ("/recorded/oil.level", {"unit": "thumbs"}, "unit 'thumbs' is not known"),
        ("/train/state.speed", {"unit": "m/s", "meaning": "speed"},
         "meaning and between are for topics below /recorded/"),
    ):  # fmt: skip
        refused(InputError, said, plain_profile, columns={topic: {"column": "x", **column}})
    bare = made()
    bare[PANTOGRAPH.name].attrs = {"topic": PANTOGRAPH.name}
    refused(LogError, "does not describe its columns", trainlog.write, bare, tmp_path / "bare.mcap")


def test_a_recording_under_way_takes_what_was_declared(tmp_path):
    with trainlog.record(tmp_path / "live.mcap") as recording:
        with pytest.raises(TrainlogError, match="has not been declared"):
            recording.write(PANTOGRAPH.name, START, contact_force=70.0)
        recording.declare(PANTOGRAPH)
        for second in range(5):
            recording.write(PANTOGRAPH.name, START + second * 10**9, contact_force=70.0 + second)
        refused(LogError, "in use already", recording.declare, PANTOGRAPH)
    found = trainlog.read(tmp_path / "live.mcap")[PANTOGRAPH.name]
    assert found["contact_force"].tolist() == [70.0, 71.0, 72.0, 73.0, 74.0]
    assert found["raised"].isna().all()
    assert found.attrs["meanings"]["contact_force"] == "of the strip"


@pytest.fixture(scope="module")
def stopping() -> Trip:
    return trainlog.read("sample_logs/stopping.mcap")


def test_late_efforts_with_a_wrong_gain_are_found(stopping):
    clean = estimated_passport(stopping)
    controls = stopping["/train/controls"]
    efforts = {name: 1.1 * controls[name] for name in controls if name.endswith("_effort")}
    scaled = stopping.with_topic(controls.assign(**efforts))
    defect = estimated_passport(with_effort_delay(scaled, -0.33))
    assert defect.effort_delay.source == defect.effort_gain.source == "estimated"
    assert defect.effort_delay.value - clean.effort_delay.value == pytest.approx(0.33, abs=0.03)
    assert defect.effort_gain.value / clean.effort_gain.value == pytest.approx(1.1, abs=0.01)
    assert any("0.33 s late" in each or "0.34 s late" in each for each in defect.findings)
    stated = f"recorded efforts are {defect.effort_gain.value:.3f} times the true ones"
    assert any(each.startswith(stated) for each in defect.findings)
    assert defect.mass.value == pytest.approx(clean.mass.value)


def test_a_stated_load_that_the_motion_contradicts_is_stated_by_the_fit():
    trip = trainlog.read("sample_logs/nonstop.mcap")
    true = float(trip.metadata["load"])
    for error in (-15e3, 0.0, 15e3):
        stated = replace(trip, metadata={**trip.metadata, "load": f"{true + error:.0f}"})
        notes = [each for each in fit_trip(stated).notes if "stated load" in each]
        assert len(notes) == (error != 0.0)
        if notes:
            assert f"the stated load of {(true + error) / 1e3:.1f} t" in notes[0]
            found = re.search(r"a load of ([\d.]+) t would explain", notes[0])
            assert found
            assert float(found[1]) == pytest.approx(true / 1e3, abs=2.0)


def test_creep_of_unrecorded_wheels_is_in_the_band_of_the_delay():
    line, train = sample(DEFAULT_LINE), sample(DEFAULT_TRAIN)
    drawn = draw_scenarios(trainlog.read_line(line), trainlog.read_train(train), 2, seed=4)[1]
    trip = simulate(replace(drawn, characteristic=polach_curve("wet")))
    blind = without(trip, "/train/axles")
    seen, found = estimated_passport(trip), estimated_passport(blind)

    low, high = found.effort_delay.band
    assert low < 0.0 < high  # the efforts are recorded in time
    assert seen.creep_lead == Quantity(0.0, 0.0, "recorded")
    assert found.creep_lead.value > 0.0
    assert 0.0 < shared_delay_std(found) < found.creep_lead.std < found.effort_delay.std < 0.06
    assert found.motion_delay.value < seen.motion_delay.value  # what the motion shows is early
    assert thing_from_bytes(Passport, thing_to_bytes(found)).creep_lead == found.creep_lead


def test_without_a_recorded_load_gain_and_load_share_their_uncertainty(stopping):
    known = {key: value for key, value in stopping.metadata.items() if key != "load"}
    found = estimated_passport(replace(stopping, metadata=known))
    weighed = estimated_passport(stopping)

    assert found.load.source == "assumed"
    assert found.load.std > 3.0 * weighed.load.std
    assert found.effort_gain.std > 2.0 * weighed.effort_gain.std
    # The rotating parts' share of the inertia is that at half of the largest load.
    assert found.effort_over_mass.value == pytest.approx(weighed.effort_over_mass.value, rel=0.005)
    assert abs(found.effort_over_mass.value - weighed.effort_over_mass.value) < (
        1.96 * found.effort_over_mass.std
    )
    assert found.load.band[0] < weighed.load.value < found.load.band[1]
    assert any(each.startswith("no load recorded") for each in found.findings)


def test_ingest_stores_the_passport_and_info_shows_it(tmp_path, works):
    recording, profile = sample("recorder.csv"), sample("recorder.profile.toml")
    command = ("ingest", recording, "-o", tmp_path, "--profile", profile)
    command += ("--line", sample(DEFAULT_LINE), "--train", sample(DEFAULT_TRAIN))
    log, estimated = tmp_path / "recorder.mcap", tmp_path / "estimated"

    works(*command)
    found = passport_of(trainlog.read(log))
    assert found.effort_delay.source == "estimated"
    assert "no load recorded" in "; ".join(found.findings)
    made = log.stat().st_mtime_ns
    works(*command)
    assert log.stat().st_mtime_ns == made, "what was made before is not made again"

    assert "Passport of trip" in works("show", log)
    works("estimate", log, "-o", estimated)
    assert passport_of(trainlog.read(estimated / log.name)) == found


@pytest.mark.parametrize(("step", "noise"), [(1.0 / 3.6, 0.0), (0.1 / 3.6, 0.03)])
def test_wheel_factors_of_rounded_speeds_are_within_their_bands(stopping, step, noise):
    """Other wheels on the true motion of a trip, displayed in steps of up to 1 km/h."""
    speed = stopping["/truth"]["speed"].to_numpy()
    speed = speed[speed > 3.0]
    generator = np.random.default_rng(3)
    inside, errors = [], []
    for _ in range(60):
        begin = generator.integers(0, speed.size // 2)
        true = speed[begin : begin + speed.size // 2]
        of_wheel, of_train = 1.0 + 0.003 * generator.standard_normal(2)
        wheel, train = (
            np.round((factor * true + noise * generator.standard_normal(true.size)) / step) * step
            for factor in (of_wheel, of_train)
        )
        ratio, std = ratio_of_speeds(wheel, train)
        errors.append(ratio - of_wheel / of_train)
        inside.append(abs(errors[-1]) < 1.96 * std + 1e-7)
    assert np.mean(inside) > 0.9
    assert np.sqrt(np.mean(np.square(errors))) < 1e-4 + 0.005 * step


def test_a_state_of_few_samples_gives_a_passport_that_states_what_it_lacks(stopping):
    state, axles = stopping["/train/state"], stopping["/train/axles"]
    for samples in (0, 2):
        short = estimated_passport(stopping.with_topic(state.iloc[:samples]))
        assert short.effort_delay.source == short.effort_gain.source == "assumed", samples
    without_efforts = stopping.with_topic(stopping["/train/controls"].iloc[:0])
    assert estimated_passport(without_efforts).effort_gain.source == "assumed"
    known = estimated_passport(stopping.with_topic(axles.iloc[:2]))
    assert known.summary()["wheel factors"] == ", ".join(4 * ["not known"])


@pytest.mark.parametrize("repeated", [2, 14_140])
def test_samples_of_one_time_show_no_noise(stopping, repeated):
    state = stopping["/train/state"]
    first = np.repeat(state.index[::repeated], repeated)[: len(state)]
    noise = _speed_noise(stopping.with_topic(state.set_axis(first)))["/train/state.speed"]
    once = _speed_noise(stopping.with_topic(state.iloc[::repeated]))["/train/state.speed"]
    np.testing.assert_equal((noise.value, noise.source), (once.value, once.source))
