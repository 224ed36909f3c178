"""TTOBench's library is read whole and written back with the same values in the same units."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from contents import put
from format_examples import TRAINS, assert_same, journeys, lines
from hypothesis import assume, given, settings
from refusals import refused

from trainlog.errors import InputError
from trainlog.formats import ttobench
from trainlog.formats.imports import import_file
from trainlog.formats.railway import read_journey, read_line, read_train
from trainlog.formats.ttobench import JourneyLayout, TrackLayout, TrainLayout
from trainlog.railway import BrakingCurves, Station

LIBRARY = Path(__file__).parents[2] / "shared" / "data" / "ttobench"
FILES = sorted(LIBRARY.glob("*/*.json"))
needs_library = pytest.mark.skipif(not FILES, reason="the TTOBench library is not here")
quick = settings(max_examples=15)

TRACK: dict[str, Any] = {
    "metadata": {"id": "T", "library version": "TTOBench v1.5", "created by": "A"},
    "stops": {"unit": "km", "values": [0, 1.5, 4]},
    "speed limits": {
        "units": {"position": "km", "velocity": "m/s"},
        "values": [[0, 20], [2, 25.5]],
    },
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
        (
            TRAIN,
            "rho",
            {"unit": "-", "value": -1},
            ", rho: the rotating parts would weigh -1 ",
        ),
        (TRAIN, "mass/unit", "m", ", mass.unit: unit 'm' cannot be read as kg"),
        (TRAIN, "rho", {"unit": "-", "value": 1.06}, ", rho: the rotating parts would weigh 1.06"),
        (TRAIN, "num seats", {"unit": "-", "value": 1.5}, ", num seats: 1.5 is not a count; give"),
        (
            TRAIN,
            "efficiency traction",
            {"units": {"load": "%"}, "values": [[0, 1]]},
            ": 4 problems: (1) efficiency traction.units: unknown key 'units'; did you mean",
        ),
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
    odd = replace(train, braking_curves=BrakingCurves(parameters={"T_new": 1.0}))
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
