"""Profiles: what they may say, and one clear line for each mistake."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
from contents import put
from ingest_logs import PLAIN, clean_run, plain_profile, write
from refusals import refused

from analysis.adhesion.axles import protection_onsets
from trainlog.errors import InputError
from trainlog.ingest import ingest, pipeline, profile_of, read_profile
from trainlog.ingest.profile import Quantity
from trainlog.ingest.recording import Table
from trainlog.mcap import read_log, write_log
from trainlog.railway import RunningResistance, Train
from trainlog.units import NANOSECONDS

TRAIN = Train("small", 100_000.0, 0.1, RunningResistance(2e3, 50.0, 8.0), 200e3, 2e6)

HEAD = 'format = "trainlog/recorder-profile"\nversion = 1\nname = "x"\n'


SPEED, WHEELS, MESSAGE = "/train/state.speed", "/train/axles.wheel_speed", "/events.message"
AT_SPEED = f'columns."{SPEED}"'


def column_of(field: str, stated: str) -> str:
    return f"{HEAD}[columns]\n'{field}' = {{{stated}}}"


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ("", "is not a recorder profile: format is None; begin the file with format ="),
        ("format = 'trainlog/line'", "is not a recorder profile: format is 'trainlog/line'"),
        ("format = ", r"is not TOML: Invalid value \(at end of document\)"),
        (HEAD.replace("1", "2"), "version: must be 1"),
        (HEAD.replace("name", "names"), "(names: unknown key 'names'|name: key 'name' is missing)"),
        (HEAD + "[time]\ncolunm = 't'", "time.colunm: unknown key 'colunm'.*did you mean 'column'"),
        (HEAD + "[time]\nformat = 'iso'", "time: needs either column or columns"),
        (HEAD + "[time]\ncolumn = 't'\nformat = 'parts'", "format 'parts' needs 6 columns"),
        (HEAD + "[time]\ncolumn = 't'\nformat = 'isoo'", "format 'isoo' is not one of 'iso'"),
        (HEAD + "[time]\ncolumn = 't'\nformat = 'elapsed'", "'elapsed' and start"),
        (HEAD + "[time]\ncolumn = 't'\ntimezone = 'Mars'", "'Mars' is not a time zone"),
        (HEAD + "[time]\ncolumn = 't'\ndate = 2024-05-01", "date is for a pattern"),
        (HEAD + "[file]\ndelimiter = ';;'", "file.delimiter: must have at most 1"),
        (HEAD + "[file]\ndelimiter = ','\ndecimal = ','", "delimiter and decimal are both ','"),
        (column_of("/train/sate.speed", "column='v', unit='m/s'"), "unknown field '/train/sate.sp"),
        (column_of("/train/state.sped", "column='v', unit='m/s'"), "topic /train/state has no"),
        (column_of(SPEED, "column='v', unit='kg'"), f"{AT_SPEED}: unit 'kg' cannot be read as m/s"),
        (column_of(SPEED, "column='v'"), f"{AT_SPEED} needs a unit; for example unit = 'm/s'"),
        (column_of(SPEED, "colum='v', unit='m/s'"), f"{AT_SPEED}.colum: unknown key 'colum'; did"),
        (column_of(SPEED, "unit='m/s'"), "needs one of column, columns and value"),
        (column_of(SPEED, "columns=['v', 'w'], unit='m/s'"), f"{AT_SPEED} needs one column"),
        (column_of(WHEELS, "column='v', unit='m/s'"), f'"{WHEELS}" needs columns, one an axle'),
        (column_of(SPEED, "column='v', unit='m/s', sign=2"), f"{AT_SPEED}.sign: must be 1 or -1"),
        (
            column_of(SPEED, "column='v', unit='m/s', scale=nan"),
            "scale: is not a finite number; give one",
        ),
        (column_of(MESSAGE, "value=3"), f'columns."{MESSAGE}" needs a text'),
        (column_of(MESSAGE, "column='x', unit='m'"), f'columns."{MESSAGE}" has no unit'),
        (HEAD + "[trip]\nload = {value=3, unit='m'}", "load: unit 'm' cannot be read as kg"),
        *(
            (HEAD + stated, f"{place}: rail condition 'trocken' is not known; known: dry, wet")
            for place, stated in {
                "trip.weather": "[trip]\nweather = 'trocken'",
                "metadata": "[metadata]\nweather = 'trocken'",
                "trip.columns.weather.words.a": "[trip.columns.weather]\ncolumn='W'\n"
                "words={a='trocken'}",
            }.items()
        ),
        (
            HEAD + "[trip]\nload = {value=3, unit='t'}\nmass = {value=3, unit='t'}",
            "trip: give load or mass, not both",
        ),
        (
            HEAD + "[lines]\nkind='1'\npayload='2'\nkinds={I={typ='<i2'}}",
            "lines.kinds.I.typ: unknown key 'typ'; did you mean 'type'",
        ),
        (HEAD + "[repair]\nspike = false", "unknown key 'spike'; did you mean 'spikes'"),
        (
            f"{HEAD}[limits.columns]\n'{SPEED}' = {{unit='kg', max=3}}",
            f"{SPEED}: unit 'kg' cannot be read as m/s",
        ),
        (HEAD + "[trip]\nmass={value=122,unit='kg'}", "trip: mass: 0.122 t is not"),
        (column_of(WHEELS, "columns=['', ''], unit='m/s'"), "names no column"),
        (column_of("/events.name", "column='n', slip_protection=['WSP']"), f'for "{MESSAGE}"'),
        (b"name = 'caf\xe9'", "is not UTF-8 text"),
        (None, "mine.profile.toml: does not exist"),
    ],
)
def test_each_mistake_gives_one_line_with_file_place_and_remedy(tmp_path, toml, message):
    path = tmp_path / "mine.profile.toml"
    if toml is not None:
        path.write_bytes(toml if isinstance(toml, bytes) else toml.encode())
    caught = refused(InputError, message.replace("[", r"\["), read_profile, path)
    assert str(caught).startswith(str(path))
    assert "\n" not in str(caught)


def test_profiles_for_tables_need_time_and_columns(tmp_path):
    rows = write(tmp_path / "run.csv", clean_run(5, 1.0).rows())
    for section in ("time", "columns"):
        content = copy.deepcopy(PLAIN)
        del content[section]
        with pytest.raises(InputError, match=rf"profile 'plain' has no \[{section}\] section"):
            ingest(rows, profile=profile_of(content))


def column(tmp_path: Path, cells: list[str], **options: object) -> np.ndarray:
    """Lever [1] from cells in per cent, however written."""
    rows = [f"2024-05-01T06:00:{i:02d}.5Z;{cell}" for i, cell in enumerate(cells)]
    path = write(tmp_path / "run.csv", rows, "t;x")
    name = str(options.pop("name", "/train/controls.lever"))
    profile = plain_profile(
        file={"delimiter": ";", **options.pop("file", {})},
        columns={name: {"column": "x", **options}},
    )
    topic, _, field = name.partition(".")
    return ingest(path, profile=profile)[topic][field].to_numpy()


def test_scale_offset_part_and_sign_come_before_the_unit(tmp_path):
    raw = ["0", "50", "100", "-100"]
    for options, expected in (
        ({}, [0.0, 0.5, 1.0, -1.0]),
        ({"sign": -1}, [0.0, -0.5, -1.0, 1.0]),
        ({"scale": 0.5, "offset": 10}, [0.1, 0.35, 0.6, -0.4]),
        ({"part": "positive"}, [0.0, 0.5, 1.0, 0.0]),
        ({"part": "negative"}, [0.0, 0.0, 0.0, 1.0]),
    ):
        np.testing.assert_array_equal(column(tmp_path, raw, unit="%", **options), expected)


def test_decimal_commas_and_cells_of_ones_own(tmp_path):
    file = {"decimal": ",", "missing": ["out"]}
    found = column(tmp_path, ["12,5", "out", " 7,25 ", "+3"], unit="%", file=file)
    # A row that says nothing of a topic is no row of its frame.
    np.testing.assert_array_equal(found, [0.125, 0.0725, 0.03])


def test_constants_fill_their_topic_or_stand_at_both_ends(tmp_path):
    path = write(tmp_path / "run.csv", clean_run(20, 1.0).rows())
    columns = {
        **PLAIN["columns"],
        "/train/state.acceleration": {"value": 0.25, "unit": "m/s^2"},
        "/train/controls.lever": {"column": "a", "unit": "1", "optional": True},
        "/environment.air_temperature": {"value": 12.0, "unit": "degC"},
    }
    trip = ingest(path, profile=plain_profile(columns=columns))
    assert trip["/train/state"]["acceleration"].tolist() == [0.25] * 20
    assert "/train/controls" not in trip, "an optional column that is absent"
    air = trip["/environment"]
    assert air["air_temperature"].tolist() == [285.15] * 2
    assert [air.index[0], air.index[-1]] == [trip.start, trip.end]


def test_mass_becomes_load_and_position_gets_its_start(tmp_path):
    path = write(tmp_path / "run.csv", clean_run(20, 1.0).rows())
    trip_options = {
        "mass": {"value": 112, "unit": "t"},
        "start_position": {"value": 3.5, "unit": "km"},
        "weather": "new:grease",
        "line": "L",
        "direction": "reverse",
    }
    trip = ingest(path, profile=plain_profile(trip=trip_options), train=TRAIN)
    known = {"load": "12000", "train": "small", "direction": "reverse", "weather": "grease"}
    assert {name: trip.metadata[name] for name in known} == known
    stated = plain_profile(metadata={"weather": "new:grease"})
    assert ingest(path, profile=stated).metadata["weather"] == "grease"
    assert trip["/train/state"]["position"].iloc[0] == 3500.0
    for options, train, said in (
        (trip_options, None, "the load needs the empty train's mass"),
        ({"mass": {"value": 9, "unit": "t"}}, TRAIN, "load -91 t is not plausible"),
        ({"train": "other"}, TRAIN, "the profile states train 'other', given is 'small'"),
    ):
        refused(InputError, said, ingest, path, plain_profile(trip=options), train=train)


def test_a_start_position_moves_the_kilometres_alone():
    """The rows keep the numbers that they have in the file, by which a part is cut out of it."""
    place, rows = "/train/state.position", np.arange(9)
    table = Table(rows * NANOSECONDS, rows, {place: 10.0 * rows}).take(np.array([2, 5, 7]))
    moved = pipeline._from_start(table, Quantity(value=1.0, unit="km"))
    assert moved.signals[place].tolist() == [1_000.0, 1_030.0, 1_050.0]
    assert moved.samples.tolist() == [2, 5, 7]


def test_speed_and_a_start_make_an_estimated_position(tmp_path):
    run = clean_run(300, 0.1)
    rows = [row.rpartition(",")[0] for row in run.rows()]
    columns = {"/train/state.speed": {"column": "v", "unit": "m/s"}}
    profile = plain_profile(columns=columns, trip={"start_position": {"value": 1.0, "unit": "km"}})
    trip = ingest(write(tmp_path / "run.csv", rows, "t,v"), profile=profile)
    estimate = trip["/estimates/state"]
    truth = 1000.0 + run.position - run.position[0]
    error = estimate["position"] - truth
    assert np.abs(error).max() < 0.5
    assert np.all(np.abs(error) < 4.0 * estimate["position_std"] + 0.02)
    assert np.all(np.diff(estimate["position"]) >= 0.0)


def test_what_a_recorder_calls_slip_protection_is_named_so(tmp_path):
    words = ["", "GLEITSCHUTZ aktiv", "Tür zu", "wsp on axle 3"]
    rows = [f"2024-05-01T06:00:0{i}Z,{20 + i},{word}" for i, word in enumerate(words)]
    path = put(tmp_path / "run.csv", ["t,v,Meldung", *rows])
    columns = {
        "/train/state.speed": {"column": "v", "unit": "m/s"},
        "/events.message": {"column": "Meldung", "slip_protection": ["Gleitschutz", "WSP"]},
        "/events.name": {"value": "recorder"},
    }
    trip = ingest(path, profile=plain_profile(columns=columns, time={"column": "t"}))
    events = trip["/events"]
    named = events.loc[events["name"] == "slip protection", "message"]
    assert named.tolist() == [words[1], words[3]]
    assert events.loc[events["message"] == "Tür zu", "name"].tolist() == ["recorder"]
    onsets = protection_onsets(trip)
    assert len(onsets) == 2


def test_an_axle_that_is_not_recorded_keeps_its_number(tmp_path):
    """One speed a bogie: those of axles 1 and 3, also in the log."""
    rows = [f"2024-05-01T06:00:{i:02d}Z,{10 + i},{11 + i}" for i in range(20)]
    path = put(tmp_path / "run.csv", ["t,front,rear", *rows])
    columns = {
        "/train/axles.wheel_speed": {"columns": ["front", "", "rear", ""], "unit": "m/s"},
        "/train/state.speed": {"column": "front", "unit": "m/s"},
    }
    trip = ingest(path, profile=plain_profile(columns=columns, time={"column": "t"}))
    write_log(trip, tmp_path / "run.mcap")
    axles = read_log(tmp_path / "run.mcap")["/train/axles"]
    assert [n for n in axles if axles[n].notna().any()] == ["wheel_speed_1", "wheel_speed_3"]
    assert axles["wheel_speed_3"].tolist() == [11.0 + i for i in range(20)]
