"""Files appear whole or not at all; keys are documented; libraries of others are read."""

import errno
import json
import os
import sqlite3
from collections.abc import Callable
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from contents import put
from format_examples import TRAINS, assert_same, effort_curves, journeys, lines
from hypothesis import assume, given, settings, strategies as st
from refusals import refused

import trainlog
from trainlog import DEFAULT_TRAIN, Axles, Edge, Network, Train, read_train, sample, write_train
from trainlog.cli import main as cli
from trainlog.declaration import Declared, entries
from trainlog.errors import InputError
from trainlog.formats import files, osrd, railtoolkit, ttobench
from trainlog.formats.csv_tables import read_effort_curve
from trainlog.formats.declared import parse_toml
from trainlog.formats.imports import import_file
from trainlog.formats.railway import CoastDownResult, DragCurve, Identified, read_journey, read_line
from trainlog.formats.ttobench import JourneyLayout, TrackLayout, TrainLayout
from trainlog.railway import train as trains
from trainlog.railway.evidence import DailyEvidence
from trainlog.railway.line import Geometry, Line, LineReference, Station, Survey
from trainlog.railway.motion import timetable_run
from trainlog.railway.resistance import EffortCurve, RunningResistance
from trainlog.railway.trajectory import Journey, Trajectory
from trainlog.units import GRAVITY


def write_half(target: Path, failure: BaseException) -> None:
    with files.atomic_write(target) as temporary:
        temporary.write_bytes(b"half")
        raise failure


def test_a_written_file_replaces_the_old_one_and_leaves_nothing_else(tmp_path):
    target = put(tmp_path / "a.json", b"old")
    with files.atomic_write(target) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".json"
        temporary.write_bytes(b"new")
        assert target.read_bytes() == b"old"
    assert target.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_failure_leaves_the_old_file_and_no_other(tmp_path, failure):
    target = put(tmp_path / "a.json", b"old")
    refused(failure, "", write_half, target, failure())
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_new_files_get_the_usual_permissions(tmp_path):
    (tmp_path / "plain").touch()
    files.write_bytes(tmp_path / "written", b"x")
    assert (tmp_path / "written").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_link_keeps_pointing_where_it_did(tmp_path):
    (tmp_path / "real.json").write_bytes(b"old")
    link = tmp_path / "link.json"
    try:
        link.symlink_to(tmp_path / "real.json")
    except OSError:
        pytest.skip("this system grants no links")
    files.write_bytes(link, b"new")
    assert link.is_symlink()
    assert (tmp_path / "real.json").read_bytes() == b"new"


def test_a_missing_folder_is_named_and_a_folder_or_device_is_not_written_over(tmp_path):
    said = "its folder does not exist; create its folder first"
    refused(InputError, said, files.write_bytes, tmp_path / "no" / "a.json", b"x")
    said = "exists and is not a file; choose another name"
    refused(InputError, said, files.write_bytes, tmp_path, b"x")
    refused(InputError, said, files.write_bytes, os.devnull, b"x")


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.ENOSPC, "cannot be written: no space left on device; free some space"),
        (errno.EROFS, "cannot be written: read-only file system; choose a folder you may write"),
    ],
)
def test_a_full_disk_is_reported_and_leaves_nothing(tmp_path, number, message):
    with pytest.raises(InputError, match=message):
        write_half(tmp_path / "a.json", OSError(number, os.strerror(number)))
    assert list(tmp_path.iterdir()) == []


def test_an_error_about_another_file_is_not_taken_for_one_about_the_target(tmp_path):
    with pytest.raises(FileNotFoundError), files.atomic_write(tmp_path / "a.json"):
        (tmp_path / "input.csv").read_bytes()
    assert list(tmp_path.iterdir()) == []


def test_sha256_of_a_known_text_and_a_byte_order_mark_that_is_no_mistake(tmp_path):
    assert files.parse_json(b'\xef\xbb\xbf{"a": 1}', file="a.json") == {"a": 1}
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert files.sha256(b"abc") == known
    (tmp_path / "abc").write_bytes(b"abc")
    assert files.sha256_of(tmp_path / "abc") == known


def test_files_that_cannot_be_read_are_named(tmp_path):
    for read in (files.read_bytes, files.read_json, files.sha256_of):
        with pytest.raises(InputError, match=r"gone\.json: does not exist; check the path"):
            read(tmp_path / "gone.json")
        refused(InputError, ": is a folder; name a file in it", read, tmp_path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "a.json: is empty; expected JSON"),
        (b" \n", "a.json: is empty; expected JSON"),
        (b'{"a": [1, 2', "a.json, line 1, column 12: the file ends in the middle: truncated?"),
        (b'{"a": 1,\n "b": "cut he', "a.json, line 2, column 7: the file ends in the middle: trun"),
        (b'{"a": tru', "a.json, line 1, column 7: the file ends in the middle: truncated?; copy"),
        (b'{"a": 1.', "a.json, line 1, column 8: the file ends in the middle: truncated?; copy"),
        (b'{"a": "caf\xc3', "a.json, byte 10: the file ends in the middle: truncated?; copy the"),
        (b'{"a": 1,\n "b": }', "a.json, line 2, column 7: is not JSON: Expecting value"),
        (b'{"a": 1}\n{', "a.json, line 2, column 1: is not JSON: Extra data"),
        (b'{"a": "caf\xe9"}', "a.json, byte 10: is not UTF-8 text"),
        (b"\x89MCAP0\r\n\x01", "a.json, byte 0: is not JSON but a log (MCAP); expected JSON"),
        (b"PAR1\x15\x04\xff", "a.json, byte 6: is not JSON but a Parquet file; expected JSON"),
        (b'{"a": "NaN",\n "b": NaN}', "a.json, line 2, column 7: NaN is not a JSON number"),
        (b"[1, -Infinity]", "a.json, line 1, column 5: -Infinity is not a JSON number"),
        (b'{"a": 1, "b": 2, "a": 3}', "a.json, a: comes twice in one object; remove one of them"),
        (b"[" * 200_000, "a.json: is nested too deeply"),
        (b'{"mass": ' + b"9" * 6_000 + b"}", "a.json: holds a number of thousands of digits"),
    ],
)
def test_text_that_is_not_json_is_refused_with_its_place(data, message):
    caught = refused(InputError, "", files.parse_json, data, file="a.json")
    assert str(caught).startswith(message)
    assert "\n" not in str(caught)


def test_a_folder_for_results_is_made_only_for_results(tmp_path):
    with files.output_folder(tmp_path / "a" / "b"):
        pass
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError), files.output_folder(tmp_path / "a" / "b"):
        files.read_bytes(tmp_path / "gone")
    assert list(tmp_path.iterdir()) == []
    with files.output_folder(tmp_path / "a" / "b") as folder:
        (folder / "note.txt").write_text("x")
    assert (tmp_path / "a" / "b" / "note.txt").exists()
    (tmp_path / "empty").mkdir()
    with files.output_folder(tmp_path / "empty"):
        pass
    assert (tmp_path / "empty").is_dir(), "it was there before"


def test_a_folder_for_results_has_not_the_name_of_a_file(tmp_path):
    with (
        pytest.raises(InputError, match=r"trip\.mcap: is the name of a \.mcap file.*name a folder"),
        files.output_folder(tmp_path / "trip.mcap"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "trip.mcap").mkdir()
    with files.output_folder(tmp_path / "trip.mcap") as folder:
        assert folder.is_dir()


ALIKE = ("Line", "Journey", "Train", "Consist", "Trajectory")
WRITERS = {f"write_{kind.lower()}": kind for kind in ALIKE} | {
    "write": "Trip", "write_parquet": "Trip", "write_map": "TrackConditionMap",
    "write_parameters": "ParameterSet",
}  # fmt: skip


@pytest.mark.parametrize(("name", "kind"), WRITERS.items())
def test_what_a_file_cannot_hold_is_named(name, kind, tmp_path):
    write, path = getattr(trainlog, name), tmp_path / "file"
    remedy = f"was given where a {kind} is expected; give the {kind} first, then the path"
    refused(InputError, rf"3 \(int\) {remedy}", write, 3, path)
    refused(InputError, rf"^'a.mcap' \(str\) {remedy}", write, "a.mcap", path)
    refused(InputError, rf"^a list {remedy}", write, [], path)
    assert not path.exists()


def test_toml_that_its_parser_gives_up_is_refused():
    deep = b"x = " + b"[" * 5_000 + b"]" * 5_000
    said = "a.toml: is nested too deeply; expected TOML"
    refused(InputError, said, parse_toml, deep, file="a.toml")
    said = "a.toml: holds a number of thousands of digits; expected TOML"
    refused(InputError, said, parse_toml, b"x = " + b"9" * 6_000, file="a.toml")


TEXT = (Path(__file__).parents[1] / "docs" / "formats.md").read_text("utf-8")
SECTIONS: list[tuple[str, tuple[type, ...]]] = [
    ("## Line", (Line, Survey, Geometry, LineReference)),
    ("## Network", (Network, Edge)),
    ("## Train", (Train, Axles, trains.AxleGeometry, trains.Brake, trains.BrakingCurves)),
    ("## Consist", (trains.Consist, trains.ConsistBrake, trains.Vehicle, trains.Coupler)),
    ("## Journey", (Journey,)),
    ("## Parameters", (trains.ParameterSet, trains.Configuration, RunningResistance)),
    ("## Trajectory", (Trajectory,)),
    ("## Coast-down", (CoastDownResult, Identified, DragCurve)),
]


@pytest.mark.parametrize(("title", "models"), SECTIONS, ids=[title for title, _ in SECTIONS])
def test_every_key_is_described(title, models):
    section = TEXT.split(f"{title}\n")[1].split("\n## ")[0]
    assert issubclass(models[0], Declared)
    assert f"`{models[0].FORMAT}`" in TEXT
    assert (2 if title in ("## Line", "## Network") else 1) == models[0].VERSION
    for model in models:
        for entry in entries(model):
            assert f"`{entry.key}`" in section, entry.key
            if issubclass(model, Declared) and model.FORMAT:
                assert (f"*`{entry.key}`*" in section) is not entry.required, entry.key
    if title == "## Train":
        assert all(f"`{name}`" in section for name in trains.BRAKING_PARAMETERS)


def test_every_table_and_column_of_a_map_is_described():
    section = TEXT.split("## Track-condition map\n")[1].split("\n## ")[0]
    database = sqlite3.connect(sample("CH_StGallen_Wil.map"))
    tables = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
    assert len(tables) == 6
    for (table,) in tables:
        assert f"`{table}`" in section, table
        for _, column, *_others in database.execute(f"PRAGMA table_info({table})"):
            assert f"`{column}`" in section, (table, column)
    for (key,) in database.execute("SELECT key FROM header"):
        assert f"`{key}`" in section, key
    for name in (each.name for each in fields(DailyEvidence)):
        assert f"`{name}`" in section, name


LIBRARY = Path(__file__).parents[2] / "shared" / "data" / "ttobench"
FILES = sorted(LIBRARY.glob("*/*.json"))
needs_library = pytest.mark.skipif(not FILES, reason="the TTOBench library is not here")
quick = settings(max_examples=15)

UNITS = {"position": "km", "velocity": "m/s"}
LOADED = {"units": {"load": "%"}, "values": [[0, 1]]}
TRACK: dict[str, Any] = {
    "metadata": {"id": "T", "library version": "TTOBench v1.5", "created by": "A"},
    "stops": {"unit": "km", "values": [0, 1.5, 4]},
    "speed limits": {"units": UNITS, "values": [[0, 20], [2, 25.5]]},
    "curvatures": {
        "units": {"position": "m", "radius at start": "km", "radius at end": "m"},
        "values": [[0, "infinity", 500], [50, 0.5, -400]],
    },
    "ETCS braking data": {"Kt_int": {"unit": "-", "value": 1.15}},
}
TRAIN: dict[str, Any] = {
    "metadata": {"id": "V", "library version": "TTOBench v1.5"},
    "mass": {"unit": "t", "value": 100},
    "max traction power": {"unit": "MW", "value": 2},
    "max reg braking power": {"unit": "W", "value": 1e6},
    "max traction force": {"unit": "N", "value": 150e3},
    "max reg braking force": {"unit": "kN", "value": 100},
    "max speed": {"unit": "m/s", "value": 40},
    "rolling resistance r0": {"unit": "N", "value": 2000},
    "rolling resistance r1": {"unit": "N/(m/s)", "value": 60},
    "rolling resistance r2": {"unit": "kN/(m/s)^2", "value": 0.012},
    "num seats": {"unit": "-", "value": 1},
}


def written(tmp_path: Path, content: Any) -> Path:
    return put(tmp_path / "file.json", json.dumps(content))


@needs_library
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_file_is_read_written_back_unchanged_and_converted(file, tmp_path):
    kind = ttobench.detect(file)
    assert file.parent.name == f"{kind}s"
    found = ttobench.import_file(file)
    copy = tmp_path / file.name
    write: Callable[[Any, Path], None] = getattr(ttobench, f"write_{kind}")
    write(found, copy)
    assert json.loads(copy.read_bytes()) == json.loads(file.read_bytes())
    target = import_file(file, tmp_path)[0].path
    suffix = {"track": "line"}.get(kind, kind)
    assert target.name == f"{file.stem}.{suffix}.json"
    reader: Any = {"line": read_line, "train": read_train, "journey": read_journey}[suffix]
    assert reader(target) == found


def test_declared_units_are_honoured(tmp_path):
    line = ttobench.read_track(written(tmp_path, TRACK))
    assert line.length == 4000.0
    assert [station.name for station in line.stations] == ["km 0.000", "km 1.500", "km 4.000"]
    assert line.speed_limits.positions.tolist() == [0.0, 2000.0]
    assert line.speed_limits.values.tolist() == [20.0, 25.5]
    assert line.gradient(np.array([0.0, 4000.0])).tolist() == [0.0, 0.0]
    assert line.curvatures.start.tolist() == [0.0, 1 / 500]
    assert line.curvatures.end.tolist() == [1 / 500, -1 / 400]
    assert line.braking_parameters == {"Kt_int": 1.15}
    train = ttobench.read_train(written(tmp_path, TRAIN))
    assert (train.mass, train.max_traction_power, train.max_speed) == (100e3, 2e6, 40.0)
    assert train.resistance.r2 == 12.0
    assert train.rotating_mass_factor == 0.0
    assert train.seats == 1
    assert "rotating_mass_factor" in train.assumed


def changed(content: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    copy = json.loads(json.dumps(content))
    *way, last = [int(part) if part.isdigit() else part for part in path.split("/")]
    target = copy
    for part in way:
        target = target[part]
    target[last] = value
    return copy


@pytest.mark.parametrize(
    ("content", "path", "value", "message"),
    [
        (TRACK, "cant", 1, ", cant: unknown key 'cant'; correct its spelling or remove it"),
        (TRACK, "metadata/version", "1", ", metadata.version: unknown key 'version'; did you mean"),
        (TRACK, "ETCS braking data/Kv", 1, ", ETCS braking data.Kv: unknown key 'Kv'; correct"),
        (TRACK, "stops/unit", "s", ", stops.unit: unit 's' cannot be read as m; declare a unit"),
        (TRACK, "stops/values", [0, 2, 2], ", stops.values[2]: stop at 2000 m follows stop at"),
        (TRACK, "stops/values", [1, 2], ", stops.values: needs at least two stops, the first at 0"),
        (TRACK, "speed limits/values/1/1", 0, ": line 'T': speed limit at km 2.000 is not positi"),
        (TRACK, "speed limits/values/1/0", 0, ", speed limits.values[1]: position 0 m follows 0 m"),
        (TRACK, "curvatures/values/0/1", "inf", ", curvatures.values[0][1]: must be a finite nu"),
        (TRAIN, "mass/value", 0, ", mass: 0 kg is not positive"),
        (TRAIN, "rho", {"unit": "-", "value": -1}, ", rho: the rotating parts would weigh -1"),
        (TRAIN, "mass/unit", "m", ", mass.unit: unit 'm' cannot be read as kg"),
        (TRAIN, "rho", {"unit": "-", "value": 1.06}, ", rho: the rotating parts would weigh 1.06"),
        (TRAIN, "num seats", {"unit": "-", "value": 1.5}, ", num seats: 1.5 is not a count; give"),
        (TRAIN, "efficiency traction", LOADED, ": 4 problems: (1) efficiency traction.units: unkn"),
    ],
)
def test_nonsense_is_refused_at_its_place(content, path, value, message, tmp_path):
    file = written(tmp_path, changed(content, path, value))
    caught = refused(InputError, "", ttobench.import_file, file)
    assert str(caught).startswith(f"{file}{message}")
    assert "\n" not in str(caught)


def test_files_of_no_kind_or_of_another_kind_are_reported(tmp_path):
    journey = {"metadata": {"id": "J", "library version": "1"}, "timing points": {}}
    for read, content, said in (
        (ttobench.detect, {"a": 1}, "is neither a track nor a train nor a journey"),
        (ttobench.detect, [1], "is neither a track nor a train nor a journey"),
        (ttobench.detect, {"format": "trainlog/line"}, "is a trainlog/line file already; use it"),
        (ttobench.read_track, TRAIN, "is a TTOBench train, expected a track"),
        (ttobench.read_journey, journey, r"timing points\.units: 'units' is missing"),
    ):
        refused(InputError, said, read, written(tmp_path, content))


@quick
@given(lines())
def test_lines_survive_but_for_names_and_coordinates(line):
    ends = (Station("km 0.000", 0.0), Station(f"km {line.length / 1e3:.3f}", line.length))
    lost = dict.fromkeys(("geometry", "survey", "reference", "speed_limits_reverse"))
    plain = replace(line, stations=ends, source="", **lost)
    assert_same(TrackLayout.of(plain).thing(), plain, 5e-14)


@quick
@given(TRAINS)
def test_trains_survive_but_for_what_the_layout_has_not(train):
    # The layout takes a rotating mass of the whole train's for a factor of the wrong kind.
    assume(train.rotating_mass_factor < 1.0)
    unknown = ("max_load", "axles", "brake")
    lost = dict.fromkeys(("traction_curve", "dynamic_braking_curve"))
    plain = replace(train, assumed=unknown, source="", length=train.length + 1.0, **lost)
    found = TrainLayout.of(plain).thing()
    kept = {name: getattr(found, name) for name in unknown}
    assert_same(found, replace(plain, **kept), 5e-14)


@quick
@given(journeys())
def test_journeys_survive(journey):
    plain = replace(journey, source="")
    assert_same(JourneyLayout.of(plain).thing(), plain, 5e-14)


def test_what_the_layout_cannot_say_is_refused(tmp_path):
    line = ttobench.read_track(written(tmp_path, TRACK))
    short, copy = replace(line, stations=line.stations[:-1]), tmp_path / "copy.json"
    refused(InputError, "not begin and end at a station", ttobench.write_track, short, copy)
    train = ttobench.read_train(written(tmp_path, TRAIN))
    odd = replace(train, braking_curves=trains.BrakingCurves(parameters={"T_new": 1.0}))
    refused(InputError, "'T_new' is not known to TTOBench", ttobench.write_train, odd, copy)
    assert not copy.exists()


def test_what_an_export_leaves_out_is_listed(tmp_path):
    """Another curve resistance or another mass model changes energies by per cents."""
    line = ttobench.read_track(written(tmp_path, TRACK))
    assert ttobench.write_track(line, tmp_path / "copy.json") == []
    roeckl = replace(line, curve_resistance="roeckl")
    (words,) = ttobench.write_track(roeckl, tmp_path / "copy.json")
    assert "curve resistance 'roeckl'" in words
    train = ttobench.read_train(written(tmp_path, TRAIN))
    assert ttobench.write_train(train, tmp_path / "copy.json") == []
    strip = replace(train, mass_model="homogeneous_strip", length=75.0, acceleration_limits="net")
    words = ", ".join(ttobench.write_train(strip, tmp_path / "copy.json"))
    assert "mass model 'homogeneous_strip'" in words
    assert "acceleration limits 'net'" in words


DATA = Path(__file__).parents[2] / "shared" / "data"
SHARED = pytest.mark.skipif(not DATA.is_dir(), reason="the shared data are not here")

CASES = [*product(("local", "freight", "longdistance"), ("const", "slope", "speed"))]

CURVE = EffortCurve(np.array([0.0, 10.0, 30.0]), np.array([100e3, 80e3, 20e3]))
UNIT = railtoolkit.RollingVehicle(
    name="unit",
    vehicle_type="multiple unit",
    length=40.0,
    mass=60e3,
    mass_traction=40e3,
    rotation_mass=1.1,
    base_resistance=0.003,
    rolling_resistance=0.0015,
    air_resistance=0.004,
    effort=CURVE,
)

WAGON = railtoolkit.RollingVehicle(
    name="wagon", vehicle_type="freight", length=19.0, mass=25e3, load_limit=59e3,
    base_resistance=0.0014, air_resistance=0.0039,
)  # fmt: skip


def train_of(file: str, loaded: float = 1.0) -> Train:
    """The train of one of the files of TrainRuns, loaded to a share."""
    ((_, train, _),) = railtoolkit.read_any(DATA / "trainruns" / "trains" / f"{file}.yaml", loaded)
    assert isinstance(train, Train)
    return train


def shortest_time(line: Line, train: Train, step: float) -> float:
    """Running time [s] at full effort, in steps of about so many metres."""
    hardest = {"deceleration": train.max_deceleration, "lever": 1.0}
    return timetable_run(line, train, 0.0, line.length, **hardest, step=step).running_time


@SHARED
@pytest.mark.parametrize(("train", "path"), CASES)
def test_running_times_of_trainruns(train, path):
    line = railtoolkit.read_running_paths(DATA / "trainruns" / "paths" / f"{path}.yaml")[path]
    snapshot = (DATA / "trainruns" / "snapshots" / f"{train}_{path}.csv").read_text()
    expected, given = float(snapshot.split()[1]), train_of(train)
    # With the step of 20 m that TrainRuns takes.
    assert shortest_time(line, given, 20.0) == pytest.approx(expected, rel=2e-3)
    # Its steps begin with their acceleration and so gain a little: the limit lies higher.
    assert 0.0 < shortest_time(line, given, 0.5) / expected - 1.0 < 6e-3


@SHARED
@pytest.mark.parametrize(
    "file", sorted((DATA / "railtoolkit_schema" / "test").glob("*/invalid/*.yaml")), ids=str
)
def test_every_invalid_case_is_refused_with_what_is_wrong(file):
    kind = "rolling_stock" if "rolling-stock" in file.parts else "running_paths"
    read = getattr(railtoolkit, f"read_{kind}")
    missing = file.stem.removesuffix("_missing").rpartition("_")[2]
    expected = {
        "formation_empty": "trains[0].formation",
        "vehicle_type": "vehicles[0].vehicle_type",
        "minimal": "neither trains nor vehicles",
        "not_unique_CS": "two sections begin at 0 m",
        "missing_sections": "'characteristic_sections' is missing",
        "not_null_speed": "is not positive",
        "not_unique_path": "path '1' comes twice",
        "no_two_items_section": "at least 2 items",
        "incomplete_section": "neither speed nor resistance",
    }.get(file.stem, f"'{missing}' is missing")
    refusal = refused(InputError, "", read, file)
    assert expected in str(refusal)
    assert file.name in str(refusal)


@SHARED
def test_every_valid_case_is_read():
    folder = DATA / "railtoolkit_schema"
    for file in sorted((folder / "test" / "rolling-stock" / "valid").glob("*.yaml")):
        railtoolkit.read_rolling_stock(file)
    for file in sorted((folder / "test" / "running-path" / "valid").glob("*.yaml")):
        assert railtoolkit.read_running_paths(file)
    vehicles, formations = railtoolkit.read_rolling_stock(folder / "rolling-stock.example.yaml")
    assert railtoolkit.coupled(*formations["RB50-1"], 0.0).mass == 2 * 68e3
    assert vehicles["BR642"].a_braking == -0.4253
    line = railtoolkit.read_running_paths(folder / "running-path.example.yaml")["example"]
    assert line.speed_limit(0.0) == pytest.approx(160 / 3.6)
    assert line.gradient(2_500.0) == pytest.approx(2e-3)
    refused(InputError, "a share of 1.5 of the load is not between 0 and 1", train_of, "local", 1.5)


def test_strahl_and_sauthoff_say_what_wende_prints():
    speed = np.linspace(0.0, 50.0, 11)
    strahl = GRAVITY * 84e3 * (1.4 + 3.9 * (3.6 * speed / 100.0) ** 2) / 1e3
    assert WAGON.resistance(59e3)(speed) == pytest.approx(strahl)
    coach = railtoolkit.RollingVehicle(
        name="coach",
        vehicle_type="passenger",
        length=26.8,
        mass=50e3,
        load_limit=20e3,
        base_resistance=0.002,
        rolling_resistance=0.000715,
        air_resistance=0.00364,
    )
    sauthoff = 2.0 + 0.715 * 3.6 * speed / 100.0 + 3.64 * ((3.6 * speed + 15.0) / 100.0) ** 2
    assert coach.resistance(0.0)(speed) == pytest.approx(GRAVITY * 50e3 * sauthoff / 1e3)
    air = 4.0 * ((3.6 * speed + 15.0) / 100.0) ** 2
    expected = GRAVITY * (3.0 * 40e3 + 1.5 * 20e3 + air * 60e3) / 1e3
    assert UNIT.resistance(0.0)(speed) == pytest.approx(expected)


def test_a_formation_adds_its_vehicles_up():
    wagon = replace(WAGON, speed_limit=27.0)
    units = (UNIT, wagon, wagon)
    empty, half = (railtoolkit.coupled("train", units, share) for share in (0.0, 0.5))
    assert empty.length == 78.0
    assert empty.mass == 110e3
    assert half.mass == 169e3
    assert empty.max_speed == 27.0
    assert empty.mass + empty.rotating_mass == pytest.approx(60e3 * 1.1 + 50e3 * 1.06)
    assert empty.tractive_effort_limit(20.0) == pytest.approx(50e3)
    assert empty.max_deceleration == 0.375
    refused(InputError, "no vehicle has tractive effort", railtoolkit.coupled, "wagons", (wagon,))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: [1", "is not YAML.*line 1|is not YAML"),
        ("", "is not a running path of railtoolkit"),
        ("schema: x", "is not a running path"),
        (
            "schema: https://railtoolkit.org/schema/running-path.json\nschema_version: '1999.01'",
            "version '1999.01' is not known",
        ),
        ("\x00\x01", "is not YAML"),
        ("[" * 1_000, "is not YAML"),
    ],
)
def test_other_files_are_refused(tmp_path, text, words):
    refused(InputError, words, railtoolkit.read_running_paths, put(tmp_path / "odd.yaml", text))


STOCK = """
schema: https://railtoolkit.org/schema/rolling-stock.json
schema_version: "2022.05"
vehicles:
"""
LOCOMOTIVE = (
    STOCK + "  - {id: V90, name: V90, vehicle_type: traction unit, length: 14, mass: 80,"
    " mass_traction: 80, speed_limit: 80, rotation_mass: 1.09, base_resistance: 2.2,"
    " air_resistance: 10, tractive_effort: [[0, 180000], [20, 100000], [80, 25000]]}\n"
)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("v90.yaml", "--formation", "V90, 3 Fals"), "no vehicle 'Fals' in the files given"),
        (("v90.yaml", "--formation", "V90, 0 V90"), "no vehicle 'V90' in the files"),
        (("v90.yaml", "--set", "curve-resistance=roeckl"), "is not a line: curve resistance"),
        (("path.yaml", "--set", "mass-model=mass_point"), "is not a train: mass model cannot go"),
        (("train.yaml",), "the vehicles of train 'ore' are not in the file.*--formation 'V90, F'"),
    ],
    ids=lambda given: " ".join(given) if isinstance(given, tuple) else "",
)
def test_what_an_import_cannot_use_is_refused(words, message, tmp_path):
    (tmp_path / "v90.yaml").write_text(LOCOMOTIVE)
    (tmp_path / "train.yaml").write_text(
        STOCK.replace("vehicles:", "trains: [{id: ore, name: ore, formation: [V90, F]}]")
    )
    rows = (f"      - {{position: {at}, speed: 80}}\n" for at in (0, 900))
    (tmp_path / "path.yaml").write_text(
        "schema: https://railtoolkit.org/schema/running-path.json\nschema_version: '2024.07'\n"
        f"paths:\n  - id: here\n    characteristic_sections:\n{''.join(rows)}"
    )
    with pytest.raises(InputError, match=message):
        cli.run(["import", str(tmp_path / words[0]), *words[1:], "-o", str(tmp_path / "out")])
    assert not list(tmp_path.glob("out/*"))


FLIRT = read_train(sample(DEFAULT_TRAIN))


@given(effort_curves(1.0))
def test_its_approximations_bound_it(curve):
    fastest = 1.3 * float(curve.speeds[-1]) + 1.0
    v = np.unique(np.concatenate((np.linspace(0.0, fastest, 500), curve.speeds)))
    top = curve.efforts.max()
    below, dipless = curve.without_rise(v), curve.without_dip(v)
    assert np.all(below <= curve(v) + 1e-9 * top)
    assert np.all(np.diff(below) <= 1e-9 * top)
    assert np.all(dipless <= curve(v) + 1e-9 * top)
    slopes = np.diff(dipless)
    rising = np.flatnonzero(slopes > 1e-9 * top)
    assert rising.size == 0 or np.all(slopes[: rising[-1]] >= -1e-9 * top)
    _, offsets, powers = curve.tangents(fastest)
    with np.errstate(divide="ignore", invalid="ignore"):
        above = np.where(powers > 0.0, offsets + powers / v[1:, None], offsets).min(axis=1)
    assert np.all(powers >= 0.0)
    assert np.all(above >= curve(v[1:]) - 1e-9 * top)


@given(effort_curves(1.0), st.floats(0.01, 1.0))
def test_the_speed_at_an_effort_is_the_highest_that_gives_it(curve, share):
    falling = curve.without_rise
    effort = share * float(falling.efforts[0])
    speed = float(falling.speed_at(effort))
    assert falling(speed) == pytest.approx(effort, rel=1e-9)
    assert np.all(falling(speed * 1.001 + np.linspace(1e-3, 50.0, 50)) <= effort * (1.0 + 1e-9))


@pytest.mark.parametrize(
    ("speeds", "efforts", "words"),
    [
        ([0.0], [1.0], "two at least"),
        ([0.0, np.nan], [1.0, 1.0], "not a finite number"),
        ([0.0, 2.0], [1.0, np.inf], "not a finite number"),
        ([0.0, 3.0, 2.0], [1.0, 1.0, 1.0], "do not grow from 0"),
        ([0.0, 2.0], [1.0, -1.0], "negative"),
    ],
)
def test_curves_that_cannot_be_are_refused(speeds, efforts, words):
    refusal = refused(InputError, words, EffortCurve, np.array(speeds), np.array(efforts))
    assert refusal.remedy


def test_the_least_of_curve_effort_and_power_counts():
    train = replace(FLIRT, traction_curve=CURVE, max_tractive_effort=90e3, max_traction_power=9e5)
    # By the largest effort, by the curve, by the power, by the curve.
    limits = train.tractive_effort_limit([0.0, 10.0, 15.0, 30.0])
    assert limits == pytest.approx([90e3, 80e3, 60e3, 20e3])
    braking = replace(FLIRT, dynamic_braking_curve=CURVE)
    assert braking.dynamic_braking_effort_limit([5.0, 30.0]).tolist() == [90e3, 20e3]


def test_a_curve_without_effort_at_standstill_is_refused():
    with pytest.raises(InputError, match="no tractive effort at standstill"):
        replace(FLIRT, traction_curve=EffortCurve(np.array([0.0, 9.0]), np.array([0.0, 1.0])))
    fading = EffortCurve(np.array([0.0, 3.0, 40.0]), np.array([0.0, 9e4, 2e4]))
    assert replace(FLIRT, dynamic_braking_curve=fading).dynamic_braking_effort_limit(0.0) == 0.0


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_a_curve_in_another_unit_than_it_states_is_refused(factor, tmp_path):
    curve = EffortCurve(CURVE.speeds, factor * CURVE.efforts)
    write_train(replace(FLIRT, traction_curve=curve), tmp_path / "odd.train.json")
    with pytest.raises(InputError, match=r"traction_curve: its largest effort.*contradicts"):
        read_train(tmp_path / "odd.train.json")


@pytest.mark.parametrize(
    "text",
    [
        "speed [km/h],effort [kN]\n0,100\n36,80\n108,20\n",
        "v [km/h];F_Zug [kN]\n0;100,0\n36;80\n108;20\n\n",
        "# measured\nspeed (m/s)\teffort (N)\n0\t100000\n10\t80000\n30\t20000\n",
        "\ufeffspeed [km/h];effort [kN];;\n0;100;;\n36;80;;\n108;20;;\n",
    ],
)
def test_curves_are_read_from_csv(text, tmp_path):
    found = read_effort_curve(put(tmp_path / "curve.csv", text))
    assert found.speeds == pytest.approx(CURVE.speeds)
    assert found.efforts == pytest.approx(CURVE.efforts)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("speed;effort\n0;1\n", "column 'speed' has no unit"),
        ("speed [km/h];effort [kN];more [N]\n0;1;2\n", "has 3 columns"),
        ("speed [km/h];effort [kN]\n0;1\nx;2\n", "line 3, column 'speed': 'x' is not a number"),
        ("speed [km/h];effort [kN]\n0;100\n0;90\n", "speeds do not grow"),
        ("speed [km/h];effort [t]\n0;100\n9;90\n", "unit"),
        ("speed [km/h];effort [kN]\n", "two at least"),
    ],
)
def test_bad_csv_is_refused_with_the_place(text, words, tmp_path):
    refusal = refused(InputError, words, read_effort_curve, put(tmp_path / "curve.csv", text))
    assert refusal.remedy
    assert "curve.csv" in str(refusal)


@SHARED
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mass": -1}, "mass"),
        ({"gamma": None}, "gamma"),
        ({"rolling_resistance": {"type": "davis", "A": 1}}, r"rolling_resistance\.B"),
        ({"effort_curves": {"default_mode": "x", "modes": {}}}, "modes"),
    ],
)
def test_bad_rolling_stock_is_refused_with_the_place(changes, words, tmp_path):
    known = json.loads((DATA / "osrd/rolling_stocks/electric_rolling_stock.json").read_text())
    (tmp_path / "stock.json").write_text(json.dumps(known | changes))
    refused(InputError, words, osrd.read_train, tmp_path / "stock.json")


@SHARED
@pytest.mark.parametrize("name", ["electric", "fast", "short_slow"])
def test_the_trains_of_osrd_are_imported(name, tmp_path):
    path = DATA / "osrd" / "rolling_stocks" / f"{name}_rolling_stock.json"
    (written,) = import_file(path, tmp_path)
    train = read_train(written.path)
    published = json.loads(path.read_text())
    curves = published["effort_curves"]
    table = curves["modes"][curves["default_mode"]]["default_curve"]
    assert train.traction_curve.speeds == pytest.approx(table["speeds"], rel=1e-13)
    assert train.traction_curve.efforts == pytest.approx(table["max_efforts"], rel=1e-13)
    assert train.tractive_effort_limit(0.0) == pytest.approx(table["max_efforts"][0])
    assert (train.mass, train.length) == (published["mass"], published["length"])
    assert any("startup_acceleration" in each for each in written.dropped)


@SHARED
def test_the_traction_units_of_railtoolkit_are_imported(tmp_path):
    folder = DATA / "rolling_stock"
    for path in (*folder.glob("traction-unit/*.yaml"), *folder.glob("multiple-unit/*.yaml")):
        vehicles, _ = railtoolkit.read_rolling_stock(path)
        (vehicle,) = vehicles.values()
        (written,) = import_file(path, tmp_path)
        train = read_train(written.path)
        v = np.linspace(0.0, train.max_speed, 77)
        assert train.tractive_effort_limit(v) == pytest.approx(vehicle.effort(v), rel=1e-9)
        assert train.resistance(20.0) == pytest.approx(vehicle.resistance(0.0)(20.0))
    with pytest.raises(InputError, match="no train in it has tractive effort"):
        import_file(folder / "freight-wagon" / "Facs124.yaml", tmp_path)
