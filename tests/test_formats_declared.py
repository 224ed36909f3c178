"""What is written is read back, to the last digits; bad files are refused with their place."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import format_examples as drawn
import numpy as np
import pytest
from contents import put
from format_examples import assert_same
from hypothesis import HealthCheck, given, settings, strategies as st
from map_bytes import opened
from refusals import refused
from simulated_line import level_line, steps

from trainlog import Edge, InputError, Line, LogError, Network, Node, Trip, polach_curve, sample
from trainlog.declaration import NOT_NEGATIVE, Quantity, check_plausible, entries, example, meanings
from trainlog.formats import railway
from trainlog.formats.characteristic import CharacteristicFile
from trainlog.formats.declared import (
    file_content,
    read_thing,
    thing_from_bytes,
    thing_to_bytes,
    write_thing,
)
from trainlog.formats.files import plain, read_bytes, read_json
from trainlog.formats.mapfile import read_map, whole_file, write_map
from trainlog.ingest import ingest, read_profile
from trainlog.railway import (
    Configuration,
    CreepCurve,
    CurvatureProfile,
    RunningResistance,
    Station,
    StepProfile,
    Train,
    Tunnel,
)
from trainlog.railway.condition import ConditionLayer
from trainlog.railway.train import BrakingCurves, Consist, ParameterSet
from trainlog.railway.trajectory import Journey, TimingPoint, Trajectory

pytestmark = pytest.mark.usefixtures("remembered")

quick = settings(max_examples=15)
ROUNDING = 5e-14
"""Values that no number in the file's unit gives exactly keep 14 significant digits."""


SURVIVING: dict[str, tuple[st.SearchStrategy[Any], Callable[..., bytes], Callable[..., Any]]] = {
    "line": (drawn.lines(), railway.line_to_bytes, railway.line_from_bytes),
    "train": (drawn.TRAINS, railway.train_to_bytes, railway.train_from_bytes),
    "consist": (drawn.CONSISTS, thing_to_bytes, partial(thing_from_bytes, Consist)),
    "journey": (drawn.journeys(), thing_to_bytes, partial(thing_from_bytes, Journey)),
    "parameters": (drawn.PARAMETER_SETS, thing_to_bytes, partial(thing_from_bytes, ParameterSet)),
    "trajectory": (drawn.trajectories(), thing_to_bytes, partial(thing_from_bytes, Trajectory)),
}
TOML: dict[str, Callable[..., Any]] = {"line": railway.write_line, "train": railway.write_train}


@pytest.mark.parametrize("kind", SURVIVING)
@quick
@given(data=st.data())
def test_what_is_written_survives_and_results_to_the_last_bit(kind, data, tmp_path):
    strategy, write, read = SURVIVING[kind]
    thing = data.draw(strategy)
    written = write(thing)
    found = read(written)
    assert_same(found, thing, *() if kind in ("parameters", "trajectory") else (ROUNDING,))
    assert write(found) == written
    if kind in TOML:
        TOML[kind](thing, tmp_path / "a.toml")
        again = read((tmp_path / "a.toml").read_bytes(), file="a.toml")
        assert_same(again, thing, ROUNDING)
        assert write(again) == written


@quick
@given(drawn.maps())
def test_the_evidence_of_maps_survives_to_the_last_bit(condition):
    """Any numbers at all: the estimate is not made of them."""
    data = whole_file(condition)
    with opened(data) as file:
        trips = file.trips()
        empty, layers = file.empty, file.summed(trips).evidence
    entries = tuple(row.entry_whole for row in trips)
    assert_same(empty, replace(condition, layers={}, trips=()))
    expected = [json.dumps(trip, sort_keys=True) for trip in plain(condition.trips, "trips")]
    assert sorted(json.dumps(entry, sort_keys=True) for entry in entries) == sorted(expected)
    assert {name: known for name, (known, _) in layers.items()} == {
        name: layer.evidence for name, layer in condition.layers.items()
    }
    again = {name: ConditionLayer.unestimated(known) for name, (known, _) in layers.items()}
    assert whole_file(replace(empty, layers=again, trips=entries)) == data


def test_an_estimate_that_the_evidence_does_not_give_is_not_written(tmp_path):
    track = read_map(sample("CH_StGallen_Wil.map"))
    layer = track.layer("wet")
    other = replace(layer, log_mean=layer.log_mean - 0.01)
    other, words = replace(track, layers={"wet": other}), "estimate of layer 'wet' is not that of"
    refused(InputError, words, write_map, other, tmp_path / "other.map")
    assert not list(tmp_path.iterdir())


def simple_line() -> Line:
    limits = steps((0.0, 90 / 3.6), (400.0, 125 / 3.6))
    return level_line(1000.0, 0.0119, name="L", speed_limits=limits)


def simple_train() -> Train:
    return Train("T", 122e3, 0.1, RunningResistance(2378.88, 61.1, 12.08), 200e3, 2.6e6)


def test_numbers_stand_in_the_file_as_railway_people_write_them(tmp_path):
    railway.write_line(simple_line(), tmp_path / "line.json")
    content = read_json(tmp_path / "line.json")
    assert content["speed_limits"] == {
        "units": {"position": "m", "speed": "km/h"},
        "values": [[0, 90], [400, 125]],
    }
    assert content["gradients"]["values"] == [[0, 11.9]]
    railway.write_train(simple_train(), tmp_path / "train.json")
    content = read_json(tmp_path / "train.json")
    assert content["mass"] == {"value": 122, "unit": "t"}
    assert content["running_resistance"]["r0"] == {"value": 2.37888, "unit": "kN"}


@pytest.mark.parametrize(
    ("written", "declared"),
    [
        ('{"value": 1000, "unit": "m"}', '{"value": 1, "unit": "km"}'),
        ("[0, 90],\n      [400, 125]", "[0, 25],\n      [0.4, 34.72222222222222]"),
        ("[0, 11.9]", "[0, 1.19]"),
    ],
)
def test_any_unit_of_the_right_dimension_is_read(written, declared):
    text = railway.line_to_bytes(simple_line()).decode()
    assert written in text
    changed = text.replace(written, declared)
    if "34.7" in declared:
        changed = changed.replace('"m", "speed": "km/h"', '"km", "speed": "m/s"')
    if "1.19" in declared:
        changed = changed.replace("permil", "%")
    assert_same(railway.line_from_bytes(changed.encode()), simple_line(), 1e-15)


def test_what_a_file_cannot_say_is_refused_when_written_and_numpy_numbers_are_numbers():
    endless = ParameterSet("T", (), provenance={"gap": np.inf})
    refused(InputError, r"provenance\.gap: inf cannot be written", thing_to_bytes, endless)
    strange = ParameterSet("T", (), details=[{"a": object()}])
    refused(InputError, r"details\[0\]\.a: a object cannot be written", thing_to_bytes, strange)
    train = replace(simple_train(), braking_curves=BrakingCurves(parameters={"T_new": 1.0}))
    said = "parameter 'T_new' is not known, so its unit is not"
    refused(InputError, said, railway.train_to_bytes, train)
    details = [{"a": np.float64(0.1), "b": np.int64(3), "c": np.array([[1.5]]), "d": (True, None)}]
    found = thing_from_bytes(ParameterSet, thing_to_bytes(ParameterSet("T", (), details=details)))
    assert found.details == [{"a": 0.1, "b": 3, "c": [[1.5]], "d": [True, None]}]


def trip(**metadata: str) -> Trip:
    attachments = {"line.json": railway.line_to_bytes(simple_line())}
    attachments |= {"train.json": railway.train_to_bytes(simple_train())}
    return Trip({}, {"trip": "t1", **metadata}, attachments=attachments)


def test_a_trip_gives_its_line_in_the_direction_of_travel_and_its_train_unjudged():
    train = replace(simple_train(), mass=122.0)
    assert railway.train_from_bytes(railway.train_to_bytes(train)).mass == 122.0
    assert railway.line_of(trip()) == simple_line()
    assert railway.line_of(trip(direction="forward")) == simple_line()
    assert railway.line_of(trip(direction="reverse")) == simple_line().reversed()
    assert railway.train_of(trip()) == simple_train()
    said = r"trip 't1' has no line\.json; attachments present: none"
    refused(LogError, said, railway.line_of, Trip({}, {"trip": "t1"}))
    refused(LogError, "direction is 'backwards'", railway.line_of, trip(direction="backwards"))
    damaged = Trip({}, {"trip": "t1"}, attachments={"train.json": b'{"format": '})
    said = r"^train\.json of trip 't1', line 1, column 12: "
    refused(InputError, said, railway.train_of, damaged)


def test_limits_of_two_directions_raise_the_version_of_lines_and_networks(tmp_path):
    """A trainlog that does not know them states that it is too old, not that a key is misspelt."""
    line = simple_line()
    both = replace(line, speed_limits_reverse=StepProfile([0.0], [20.0]))
    nodes = (Node("A"), Node("B"))
    for one, version in ((line, 1), (both, 2)):
        for name in ("one.line.json", "one.line.toml"):
            railway.write_line(one, tmp_path / name)
            assert railway.read_line(tmp_path / name) == one
        railway.write_network(Network("n", nodes, (Edge("e", one, "A", "B"),)), tmp_path / "n.json")
        (edge,) = railway.read_network(tmp_path / "n.json").edges
        assert edge.line.limits_against == one.limits_against
        for name in ("one.line.json", "n.json"):
            assert read_json(tmp_path / name)["version"] == version
        assert f"version = {version}" in (tmp_path / "one.line.toml").read_text()
    # As in a program that only knows version 1.
    path = tmp_path / "one.line.json"
    path.write_text(path.read_text().replace('"version": 2', '"version": 3'))
    said = r"version 3 is newer than this trainlog knows \(2\)"
    refused(InputError, said, railway.read_line, path)
    path.write_text(path.read_text().replace('"version": 3', '"version": 0'))
    refused(InputError, "expected 1 or 2", railway.read_line, path)


CONFIGURATION = Configuration("a", 1e5, 1e4, RunningResistance(1.0, 2.0, 3.0), 1e6)
SHAPES = ((1, 3), (1, 3), 2, (1, 2))
GOOD: dict[str, Any] = {
    "line": simple_line(),
    "train": simple_train(),
    "consist": read_thing(Consist, sample("amirhosseini_2024_8_wagons.consist.json")),
    "journey": Journey("J", "L", (TimingPoint(0.0, 0.0), TimingPoint(9.0, 5.0, 6.0))),
    "characteristic": CharacteristicFile.of(polach_curve("wet"), {}),
    "parameters": ParameterSet(
        "T", (CONFIGURATION,), common_covariance=np.eye(3), provenance={"a": 1}
    ),
    "trajectory": Trajectory(
        "L", "T", np.array([0.0, 5.0, 9.0]), (CONFIGURATION,), *map(np.ones, SHAPES), 9.0
    ),
}


def good(kind: str) -> Any:
    return json.loads(thing_to_bytes(GOOD[kind]))


def read(kind: str, content: Any) -> Any:
    return thing_from_bytes(type(GOOD[kind]), json.dumps(content).encode(), "f.json")


def complaint_of(kind: str, change: Callable[[Any], None]) -> str:
    """The one line with which a changed good file is refused."""
    content = good(kind)
    change(content)
    return str(refused(InputError, "", read, kind, content))


def setting(path: str, value: Any) -> Callable[[Any], None]:
    """A change that sets ``a.b.3.c`` to a value."""

    def change(content: Any) -> None:
        *way, last = [int(part) if part.isdigit() else part for part in path.split(".")]
        for part in way:
            content = content[part]
        content[last] = value

    return change


@pytest.mark.parametrize("kind", GOOD)
def test_another_format_a_newer_version_and_an_unknown_key_are_reported(kind):
    known = 2 if kind == "line" else 1
    for change, said in (
        (setting("format", "trainlog/other"), ", format: is a file of format 'trainlog/other'"),
        (lambda content: content.pop("format"), "it has no key 'format'; bring foreign files in"),
        (setting("version", known + 1), f", version: version {known + 1} is newer than this"),
        (lambda content: content.pop("version"), "states no version of the format"),
        (lambda content: content.clear(), ": is not a trainlog/"),
        (setting("version", True), "version True is not one that"),
        (setting("colour", "red"), ", colour: unknown key 'colour'; correct its spelling or"),
    ):
        complaint = complaint_of(kind, change)
        assert complaint.startswith("f.json")
        assert said in complaint


@pytest.mark.parametrize("kind", GOOD)
def test_no_wrong_value_anywhere_makes_a_traceback(kind):
    """Every value of a good file in turn is replaced by nonsense of another type."""

    def places(content: Any) -> list[tuple[Any, Any]]:
        items = content.items() if isinstance(content, dict) else enumerate(content)
        found = []
        for key, value in list(items):
            found.append((content, key))
            if isinstance(value, dict | list):
                found += places(value)
        return found

    for index in range(len(places(good(kind)))):
        # Three of nine, in turn.
        for nonsense in ("x", None, [], {}, -7, True, 1e308, [[1]], {"value": 1})[index % 3 :: 3]:
            content = good(kind)
            parent, key = places(content)[index]
            parent[key] = nonsense
            try:
                read(kind, content)
            except InputError as error:
                message = str(error)
            else:
                message = "f.json: free text or a number that may be anything"
            assert message.startswith("f.json")
            assert "\n" not in message


RADII = {"position": "m", "radius_at_start": "m", "radius_at_end": "m"}
BENDS = {"units": RADII, "values": [[0, "infinity", 500], [9, 500, 0]]}
DEGREES = {"position": "m", "latitude": "deg", "longitude": "deg"}
TRACK = {"quality": "q", "track": {"units": DEGREES, "values": [[0, 9, 47], [9, 95, 47]]}}
LINE_CASES = [
    ("length.unit", "kg", "f.json, length.unit: unit 'kg' cannot be read as m; declare a unit of"),
    ("length.value", -1, "f.json, length: -1 m is not positive; give more than 0"),
    ("length", {"value": 1}, "f.json, length.unit: 'unit' is missing; add it"),
    ("name", "", "f.json, name: must have at least 1 character"),
    ("speed_limits.values.1", [0, 9], "f.json, speed_limits.values[1]: position 0 m follows 0 m"),
    ("speed_limits.values.0.0", 5, "f.json, speed_limits.values: the first row is not at position"),
    ("stations.values.1.1", 2000, "f.json: line 'L': station at km 2.000 lies before the line's"),
    ("stations.values.0.0", 7, "f.json, stations.values[0][0]: must be a valid string"),
    ("curvatures", BENDS, "f.json, curvatures.values[1]: the radius is 0 m; straight track has"),
    ("geometry", TRACK, "f.json, geometry: a coordinate is beyond 90° of latitude or 180° of lon"),
    ("survey", {"gradient_std": {"value": -0.1, "unit": "permil"}}, "f.json, survey.gradient_std"),
]
TRAIN_CASES = [
    ("mass.value", -122, "f.json, mass: -122 t is not positive; give more than 0"),
    ("efficiency_traction.value", 900, "f.json, efficiency_traction: 900 % is not above 0 and at"),
    ("brake.dead_time.value", -1, "f.json, brake.dead_time: -1 s is negative; give 0 or more"),
    ("running_resistance.r2.value", -9, "f.json, running_resistance: train 'T': running resist"),
    ("axles.count", 0, "f.json, axles.count: 0 is not positive"),
    ("axles.count", 4.5, "f.json, axles.count: must be a valid integer"),
    ("max_speed", 160, "f.json, max_speed: 160 has no unit; give value and unit, for example"),
]
OTHER_CASES = [
    ("characteristic", "polach", None, "f.json: describes 0 characteristics"),
    ("characteristic", "polach.stiffness", 300, "f.json, polach.stiffness: 300 has no unit"),
    ("journey", "timing_points.values.0.1", -1, "f.json: journey 'J': time window at km 0.000 has"),
    ("journey", "timing_points.values.1.2", 4, "f.json: journey 'J': time window at km 0.009 ends"),
    ("journey", "timing_points.values.0.0", 50, "f.json: journey 'J': timing point at km 0.009 co"),
    ("journey", "timing_points.values", [], "f.json: journey 'J': needs at least a departure and"),
    ("parameters", "common_covariance.values.1", [1], "f.json, common_covariance.values: needs 3"),
    ("parameters", "common_covariance.units.r1", "N", "f.json, common_covariance.units: unit 'N'"),
    ("trajectory", "positions.values", [0, 9, 9], "f.json, positions.values[2]: positions must in"),
    ("trajectory", "positions.values", [0, 9], "f.json: trajectory: speeds has shape (1, 3)"),
    ("trajectory", "times.values", [[0, 1, 2], [0]], "f.json, times.values: rows differ in length"),
    ("trajectory", "configurations", [], "f.json, configurations: has too few entries; give at le"),
]


CONSIST_CASES = [
    ("vehicles.0.count", 0, "f.json, vehicles[0].count: 0 is not between 1 and 1000"),
    ("vehicles.0.count", 9, "f.json: consist 'train of Amirhosseini et al. (2024), 8 wagons': 9"),
    ("vehicles", [], "f.json, vehicles: has too few entries; give at least 1 item"),
    ("couplers.0.slack.value", -3, "f.json, couplers[0].slack: -3 mm is negative"),
]


@pytest.mark.parametrize(
    ("kind", "path", "value", "message"),
    [
        *(("line", *case) for case in LINE_CASES),
        *(("train", *case) for case in TRAIN_CASES),
        *(("consist", *case) for case in CONSIST_CASES),
        *OTHER_CASES,
    ],
)
def test_nonsense_is_refused_at_its_place(kind, path, value, message):
    complaint = complaint_of(kind, setting(path, value))
    assert complaint.startswith(message), complaint


def test_numbers_that_json_has_not_are_refused():
    data = railway.train_to_bytes(simple_train())
    for number, said in (
        (b"NaN", r"^f\.json, line 6, column 21: NaN is not"),
        (b"1e999", r"^f\.json, mass\.value: is not a finite number"),
    ):
        given = data.replace(b"122", number)
        refused(InputError, said, railway.train_from_bytes, given, file="f.json")


def test_all_that_is_wrong_with_a_line_is_listed_at_once(tmp_path):
    """Keys, types, units, the order of rows, and values that cannot be meant."""
    content = good("line")
    content["colour"] = "red"
    content["length"] = 1000
    content["altitude"] = {"value": 0.4, "unit": "kg"}
    content["speed_limits"]["values"][0][1] = 900
    content["stations"]["values"][0][0] = 7
    path = put(tmp_path / "l.json", json.dumps(content))
    caught = refused(InputError, "", railway.read_line, path)
    places = ["colour", "length", "altitude.unit", "stations.values[0][0]"]
    places += ["speed_limits.values[0][1]"]
    assert [problem.place for problem in caught.each] == places
    assert all(problem.remedy or "must be" in problem.problem for problem in caught.each)
    assert str(caught).startswith(f"{path}: 5 problems: (1) colour: unknown key 'colour'; ")


FAST = {"speed_limits.units.speed": "m/s", "speed_limits.values": [[0, 90], [500, 200]]}
STEEP = {"gradients.units.gradient": "%", "gradients.values": [[0, 12]]}
SAMPLES = {"train": "CH_Stadler_FLIRT_TPF.train.json", "line": "CH_StGallen_Wil.line.json"}


def of(value: float, unit: str) -> dict[str, Any]:
    return {"value": value, "unit": unit}


def whole(kind: str) -> Any:
    return json.loads(read_bytes(sample(SAMPLES[kind])))


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        ("train", {"mass": of(122, "kg")}, "mass: 0.122 t is not plausible: trains have 5 to 200"),
        ("train", {"max_load": of(8.5, "kg")}, "max_load: 0.0085 t is not plausible"),
        ("train", {"max_speed": of(1600, "km/h")}, "max_speed: 1600 km/h is not plausible: trains"),
        ("train", {"max_tractive_effort": of(200, "N")}, "max_tractive_effort: 0.2 kN is not pla"),
        ("train", {"max_traction_power": of(2600, "W")}, "max_traction_power: 2.6 kW is not plaus"),
        ("train", {"length": of(58_600, "m")}, "length: 58600 m is not plausible: trains have 5"),
        ("train", {"rotating_mass_factor": of(6, "1")}, "rotating_mass_factor: 600 % is not plaus"),
        ("train", {"max_pneumatic_braking_effort": of(9e3, "kN")}, "effort: 9000 kN is not"),
        ("train", {"axles.wheel_radius": of(430, "m")}, "430 m is not plausible: wheels have"),
        ("train", {"axles.adhesive_mass": of(64, "kg")}, "were t meant"),
        ("train", {"axles.adhesive_mass": of(150, "t")}, "more than the train's mass of 122 t"),
        ("train", {"axles.count": 64}, "axles.adhesive_mass: 1.125 t is not plausible: an axle"),
        ("train", {"brake.lag": of(400, "s")}, "400 s is not plausible"),
        ("train", {"running_resistance.r0": of(2378, "kN")}, "were N meant"),
        ("train", {"running_resistance.r2": of(0.93, "kN/(km/h)^2")}, "per mille is not"),
        ("train", {"max_tractive_effort": of(800, "kN")}, "1.13 times the weight on the power"),
        ("line", {"speed_limits.values.0.1": 900}, "900 km/h is not plausible: speed limits are"),
        ("line", {"gradients.units.gradient": "1"}, "steeper than 200 per mille"),
        ("line", {"length.unit": "km"}, "a line of 2.95561e+07 m: not plausible; were km"),
        ("line", {"altitude.value": 68_000}, "68000 m is not plausible: railways lie between"),
        ("line", FAST, "720 km/h is not plausible"),
        # Rise over the whole line of St.Gallen-Wil stays small: a long ramp does not.
        ("line", STEEP, "were per mille meant where the unit states '%'"),
    ],
)
def test_what_cannot_be_meant_is_refused(kind, changes, message, tmp_path):
    content = whole(kind)
    for path, value in changes.items():
        setting(path, value)(content)
    path = put(tmp_path / "t.json", json.dumps(content))
    caught = refused(InputError, re.escape(message), read_thing, type(GOOD[kind]), path)
    assert caught.file == path
    assert all(problem.remedy for problem in caught.each)
    assert kind == "line" or str(caught).count("plausible") <= 1


@pytest.mark.parametrize("factor", [0.1, 0.3, 3.0, 10.0])
def test_trains_of_other_sizes_are_plausible(tmp_path, factor):
    """A railcar of 12 t and a freight train of 1,200 t, all figures in proportion."""
    content = whole("train")
    scaled = [content[name] for name in content if name.startswith("max_")]
    scaled = [each for each in scaled if each["unit"] in ("kN", "MW", "kW", "t")]
    for part in (*scaled, *content["running_resistance"].values()):
        part["value"] *= factor
    for part in (content["mass"], content["axles"]["adhesive_mass"]):
        part["value"] *= factor
    content["axles"]["count"] = max(1, round(4 * factor))
    path = put(tmp_path / "t.json", json.dumps(content))
    assert railway.read_train(path).mass == pytest.approx(122e3 * factor)


PLAUSIBLE = (0.5, 60, "stops take")
DWELL = Quantity("s", "s", PLAUSIBLE, must=NOT_NEGATIVE, usual=3.0, shown="stops: {} at least")


@dataclass(frozen=True, eq=False, repr=False)
class DwellTrain(Train):
    """A train that states its shortest stop.

    Attributes
    ----------
    least_dwell : float [s]
        Shortest stop at a station.
    """

    least_dwell: Annotated[float, DWELL] = 0.0


def dwell_train(**changes: Any) -> DwellTrain:
    flirt = railway.read_train(sample("CH_Stadler_FLIRT_TPF.train.json"))
    known = {each.name: getattr(flirt, each.name) for each in fields(Train)}
    return DwellTrain(**known | changes)


@pytest.mark.parametrize("name", ["dwell.train.json", "dwell.train.toml"])
def test_a_new_field_is_written_and_read(tmp_path, name):
    train = dwell_train(least_dwell=2.5)
    write_thing(train, tmp_path / name, DwellTrain)
    assert file_content(train)["least_dwell"] == {"value": 2.5, "unit": "s"}
    assert read_thing(DwellTrain, tmp_path / name) == train
    assert read_thing(DwellTrain, tmp_path / name) != dwell_train(least_dwell=2.0)


@pytest.mark.parametrize(
    ("value", "unit", "message"),
    [
        (-1, "s", "least_dwell: -1 s is negative; give 0 or more"),
        (4, "m", "least_dwell.unit: unit 'm' cannot be read as s"),
        (400, "s", "least_dwell: 400 s is not plausible: stops take 0.5 to 60 s; check the value"),
        ("x", "s", "least_dwell.value: must be a valid number"),
    ],
)
def test_the_new_field_is_checked(tmp_path, value, unit, message):
    content = file_content(dwell_train()) | {"least_dwell": {"value": value, "unit": unit}}
    path = put(tmp_path / "dwell.train.json", json.dumps(content))
    caught = refused(InputError, "", read_thing, DwellTrain, path)
    assert str(caught).startswith(f"{path}, {message}")
    # What is assumed is not judged.
    refused(InputError, "stops take", check_plausible, dwell_train(least_dwell=100.0))
    check_plausible(dwell_train(least_dwell=100.0, assumed=("least_dwell",)))


@pytest.mark.parametrize("kind", [Train, Line])
def test_each_field_of_a_docstring_is_a_field(kind):
    named = {name for entry in entries(kind) for name in entry.names}
    assert set(meanings(kind)) <= named


def test_a_network_in_place_of_a_line_asks_for_a_route(tmp_path):
    file = put(tmp_path / "small.network.json", '{"format": "trainlog/network", "version": 1}')
    refused(InputError, r"name a route of the network: '.*json#FROM,TO'", railway.read_line, file)
    refused(InputError, "check which file is meant", railway.read_train, file)


ADDED = """
import sys
from dataclasses import replace
from pathlib import Path

from trainlog import topics
from trainlog.topics import Bounds, Drawn, Field, Recorded

added = Field(
    "oil_flow", "m^3/s", "flow of the transformer's oil", usual="l/min",
    bounds=Bounds(0.0, 0.02), recorded=Recorded("oelstrom oil", plausible=(0.0, 0.01)),
    drawn=Drawn("oil", "oil of the transformer", "terrain"),
)
topic = topics.TRAIN_SUPPLY
topics.TRAIN_SUPPLY = replace(topic, fields=(*topic.fields, added))
topics.TOPICS[topic.name] = topics.TRAIN_SUPPLY

import trainlog
from trainlog.formats.samples import sample
from trainlog.ingest import ingest, propose_profile
from trainlog.replay.samples import curves_of, panels_of

sys.path.insert(0, sys.argv[2])
from topic_table import topics_table

folder = Path(sys.argv[1])
lines = sample("recorder.csv").read_text("utf-8").splitlines()[:1500]
lines[0] += ";Ölstrom [l/min]"
lines[1:] = [f"{line};{90 + at % 7},0" for at, line in enumerate(lines[1:])]
lines[800] = lines[800].rpartition(";")[0] + ";5000,0"  # beyond its bounds
path = folder / "oil.csv"
path.write_text("\\n".join(lines) + "\\n", "utf-8")

profile = propose_profile(path).profile
column = profile.columns["/train/supply.oil_flow"]
assert (column.names, column.unit) == (("Ölstrom [l/min]",), "l/min"), column
trip = ingest(path, profile)
flow = trip["/train/supply"]["oil_flow"]
assert abs(flow.iloc[0] * 60e3 - 90.0) < 1e-9, flow
assert flow.max() < 0.02, flow
assert trip.metadata["repair.out_of_limits./train/supply.oil_flow"] == "1", trip.metadata

trainlog.write(trip, folder / "oil.mcap")
assert trainlog.read(folder / "oil.mcap")["/train/supply"].equals(trip["/train/supply"])
trainlog.write_parquet(trip, folder / "oil")
assert trainlog.read_parquet(folder / "oil")["/train/supply"].equals(trip["/train/supply"])

(curve,) = [curve for curve in curves_of(trip) if curve.entity == "oil"]
assert round(curve.scales[0]) == 60_000 and not curve.held
assert [panel.title for panel in panels_of(trip) if panel.entity == "oil"] == ["Oil [l/min]"]
assert "| `oil_flow` | m^3/s |" in topics_table() and "0 to 1200 l/min" in topics_table()
"""


TOOLS = Path(__file__).parents[1] / "docs" / "tools"


def test_a_new_field_is_one_entry(tmp_path):
    words = [sys.executable, "-c", ADDED, str(tmp_path), str(TOOLS)]
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr


tables = settings(max_examples=20, suppress_health_check=list(HealthCheck))


@pytest.mark.parametrize("kind", [Line, Train, Journey])
def test_a_template_is_valid_as_it_is(tmp_path, kind):
    name = kind.__name__.lower()
    path = railway.write_template(name, tmp_path / "mine.toml")
    assert_same(getattr(railway, f"read_{name}")(path), example(kind), ROUNDING)
    text = path.read_text("utf-8")
    assert text.startswith("# A ")
    assert text.count("\n#") > 2


@pytest.mark.parametrize("kind", ["line", "train"])
def test_what_a_template_offers_besides_is_valid_too(tmp_path, kind):
    """Without their marks, the keys in comments at the end are read."""
    offered = railway.template(kind).split("\n# What may be added:\n")[1]
    plain = "\n".join(line.removeprefix("# ") for line in offered.splitlines() if line != "#")
    path = tmp_path / "whole.toml"
    path.write_text(railway.template(kind).split("\n# What may")[0] + "\n" + plain, "utf-8")
    found = railway.read_line(path) if kind == "line" else railway.read_train(path)
    if isinstance(found, Line):
        assert found.curvature(1000.0) == pytest.approx(1.0 / 500.0)
        assert found.tunnels[0].cross_section == 45.0
    else:
        assert found.tunnel_resistance[0][0] == 45.0


@pytest.mark.parametrize("kind", [Line, Train, Journey])
def test_every_key_of_a_template_is_explained(kind):
    """A name, a speed and a number of seats explain themselves."""
    meant = meanings(kind)
    unsaid = {name for entry in entries(kind) for name in entry.names if not meant.get(name)}
    assert unsaid <= {"name", "max_speed", "seats", "coaches", "braking_curves"}


def test_the_profiles_template_reads_what_it_describes(tmp_path):
    """Its optional columns may be missing, the others not."""
    path = railway.write_template("profile", tmp_path / "mine.profile.toml")
    profile = read_profile(path)
    rows = [f"01.05.2024 08:00:{i:02d}.0;{0.02 * i:.2f};72;{50 - 2 * i}" for i in range(40)]
    cells = [row.replace(";0.", ";0,") for row in rows]
    trip = ingest(put(tmp_path / "run.csv", ["Time;Distance;Speed;Effort", *cells]), profile)
    assert trip["/train/state"]["speed"].iloc[0] == pytest.approx(20.0)
    assert trip["/train/controls"]["dynamic_braking_effort"].iloc[-1] == 28_000.0
    assert trip.start.isoformat() == "2024-05-01T06:00:00+00:00"


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("train", "mine.json", r"mine\.json: is not the name of a \.toml file"),
        ("profile", "mine.csv", r"mine\.csv: is not the name of a \.toml file"),
        ("line", "there.toml", r"there\.toml: exists; choose another name"),
    ],
)
def test_nothing_is_overwritten(tmp_path, kind, name, message):
    (tmp_path / "there.toml").write_text("edited")
    refused(InputError, message, railway.write_template, kind, tmp_path / name)
    assert (tmp_path / "there.toml").read_text() == "edited"


def test_a_train_is_not_made_from_a_table(tmp_path):
    with pytest.raises(InputError, match="a train cannot be made from a table"):
        railway.write_template("train", tmp_path / "a.toml", table=tmp_path / "b.csv")
    with pytest.raises(InputError, match=r"'trainlog ingest .*b\.csv -o FOLDER' proposes one"):
        railway.write_template("profile", tmp_path / "a.toml", table=tmp_path / "b.csv")


def test_a_table_becomes_a_line(tmp_path):
    path = put(
        tmp_path / "A-B.csv",
        """\
# surveyed 2019
Kilometrierung [km];Neigung [‰];Vmax [km/h];Bahnhof;Radius [m];Breite [deg];Länge [deg]
12,3;0;60;Aach;;47,40;9,30
12,9;;120;;;;
13,8;8,5;;;500;47,41;9,31
15,0;8,5;;Berg;0;;
17,3;-5;80;;-800;47,42;9,33
24,3;;;Chur;;47,44;9,43
""",
    )
    line = railway.read_line_table(path)
    assert (line.name, line.length) == ("A-B", 12_000.0)
    assert line.source == "table A-B.csv; position 0 is km 12.300 of the table"
    assert [s.name for s in line.stations] == ["Aach", "Berg", "Chur"]
    assert [s.position for s in line.stations] == pytest.approx([0.0, 2_700.0, 12_000.0])
    np.testing.assert_allclose(line.speed_limits.positions, [0.0, 600.0, 5_000.0])
    np.testing.assert_allclose(line.speed_limits.values * 3.6, [60, 120, 80])
    np.testing.assert_allclose(line.gradients.positions, [0.0, 1_500.0, 5_000.0])
    np.testing.assert_allclose(line.gradients.values, [0.0, 0.0085, -0.005])
    np.testing.assert_allclose(line.curvature([1_000.0, 2_000.0, 3_000.0, 6_000.0]),
                               [0.0, 1 / 500, 0.0, -1 / 800])  # fmt: skip
    assert line.geometry.latitudes.tolist() == [47.40, 47.41, 47.42, 47.44]
    np.testing.assert_allclose(line.kilometre([0.0, 2_700.0, 12_000.0]) / 1e3, [12.3, 15.0, 24.3])
    assert line.reversed().kilometre(0.0) == pytest.approx(24_300.0)


def test_a_table_whose_kilometres_fall(tmp_path):
    """The same rows with rising and with falling kilometres give the same line."""
    rows, made = ("0;60;A;", ";80;;500", "-25;;;0", ";50;B;"), []
    for kilometres in ((200, 201, 203, 204), (204, 203, 201, 200)):
        cells = [f"{km};{rest}" for km, rest in zip(kilometres, rows, strict=True)]
        head = "km;gradient [permil];limit [km/h];station;radius [m]"
        path = put(tmp_path / "table.csv", [head, *cells])
        made.append(railway.read_line_table(path, name="A-B"))
    rising, falling = made
    assert falling.length == 4_000.0
    assert falling.kilometre([0.0, 1_000.0, 4_000.0]).tolist() == [204e3, 203e3, 200e3]
    at = np.linspace(0.0, 4_000.0, 41)
    for of in (Line.gradient, Line.speed_limit, Line.curvature):
        np.testing.assert_array_equal(of(falling, at), of(rising, at))
    assert falling.stations == rising.stations


@given(st.lists(st.integers(1, 5_000), min_size=1, max_size=30), st.data())
@tables
def test_a_written_table_gives_the_line_again(tmp_path, steps, data):
    """Values hold until the next that is given, whatever cells are empty."""
    at = np.concatenate(([0], 20 + np.cumsum(steps)))
    empty = [data.draw(st.booleans()) and i > 0 for i in range(at.size)]
    limits = [data.draw(st.integers(20, 300)) for _ in at]
    slopes = [data.draw(st.integers(-400, 400)) / 10 for _ in at]
    rows = [
        f"{s / 1000:.3f}\t{'' if no else slope}\t{'' if no else limit}"
        for s, slope, limit, no in zip(at, slopes, limits, empty, strict=True)
    ]
    rows[-1] = f"{at[-1] / 1000:.3f}"
    path = put(tmp_path / "A-B.csv", ["km\tgradient [permil]\tlimit [km/h]", *rows])
    line = railway.read_line_table(path)
    held = slopes[0], limits[0]
    for row in range(at.size - 1):
        held = held if empty[row] else (slopes[row], limits[row])
        middle = 0.5 * (at[row] + at[row + 1])
        assert line.gradient(middle) == pytest.approx(held[0] / 1e3, abs=1e-12)
        assert line.speed_limit(middle) == pytest.approx(held[1] / 3.6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"A-B\.csv: is empty"),
        ("km;limit [km/h]\n0;80\n", r"no column of the gradient; give a header such as 'chainage"),
        ("km;limit\n0;80\n", "no column of the gradient"),
        ("a;b\n0;80\n", r"3 problems: \(1\) line 1: no column of the position; .*\(3\) line 1: no"),
        ("s;gradient [permil];limit [km/h]\n0;1;80\n9;1;80\n", "line 1: column 's' has no unit"),
        ("km;gradient;limit [km/h]\n0;1;80\n9;1;80\n", "'gradient' has no unit; write 'gradient"),
        ("km;gradient [km];limit [km/h]\n0;1;80\n9;1;80\n", r"line 1: column 'gradient': unit"),
        ("km;km [m];gradient [permil];limit [km/h]\n0;0;1;80\n", "are both of the position"),
        ("km;gradient [permil];limit [km/h]\n", "has no row"),
        ("km;gradient [permil];limit [km/h]\n0;1;80\n", "has one row; add a last row"),
        ("km;gradient [permil];limit [km/h]\n0;1;80\n;1;80\n9;;\n", "line 3: has no position"),
        (
            "km;gradient [permil];limit [km/h]\n9;1;80\n5;1;80\n6;;\n0;;\n",
            "line 4: chainage 6000 m follows 5000 m; chainage must fall",
        ),
        (
            "km;gradient [permil];limit [km/h]\n0;1;80\n5;x;80\n4;y;90\n9;;\n",
            r"3 problems: \(1\) line 3, column 'gradient': 'x' is.*\(3\) line 4: chainage 4000",
        ),
        (
            "km;gradient [permil];limit [km/h]\n0;1;80\n5;;80\n4;;90\n3;;90\n9;;\n",
            r"2 problems: \(1\) line 4: chainage 4000 m follows 5000 m; .*\(2\) line 5",
        ),
        ("km;gradient [permil];limit [km/h]\n0;;80\n9;1;80\n", "line 2: no gradient at the line's"),
        ("km;gradient [%];limit [km/h]\n0;25;80\n9;;\n", "steeper than 200 per mille"),
        ("km;gradient [permil];limit [km/h]\n0;5;800\n9;;\n", "800 km/h is not plausible"),
        ("km;gradient [permil];limit [km/h]\n0;5;80;7\n9;;\n", "has 4 cells, the header has 3"),
    ],
)
def test_tables_that_are_no_line(tmp_path, text, message):
    path = put(tmp_path / "A-B.csv", text)
    caught = refused(InputError, message, railway.read_line_table, path)
    assert str(caught).startswith(str(path))
    assert "\n" not in str(caught)


LINE = level_line(
    1000.0,
    name="test",
    speed_limits=steps((0.0, 20.0), (400.0, 30.0)),
    gradients=steps((0.0, 0.01), (250.0, -0.02), (500.0, 0.0)),
    curvatures=CurvatureProfile(
        np.array([0.0, 100.0, 200.0]), np.array([0.0, 0.0, 0.002]), np.array([0.0, 0.002, 0.002])
    ),
    tunnels=(Tunnel(300.0, 200.0, 40.0),),
    altitude=500.0,
)

TRAIN = Train(
    name="test",
    mass=100_000.0,
    rotating_mass_factor=0.1,
    resistance=RunningResistance(2000.0, 50.0, 10.0),
    max_tractive_effort=200e3,
    max_traction_power=2e6,
    tunnel_resistance=((24.0, 15.0), (40.0, 7.0)),
)


def test_the_axles_of_a_train_are_not_shown_as_its_length():
    rows = dict(line.split(maxsplit=1) for line in str(TRAIN).splitlines()[1:])
    assert rows["axles"] == "4 powered axles"
    assert "length" not in rows


def test_profiles_take_lists_and_refuse_what_is_no_number():
    made = StepProfile([0.0, 400.0], [20.0, 30.0])
    assert made == LINE.speed_limits
    refused(InputError, "values must be numbers", StepProfile, [0.0], ["fast"])


@pytest.mark.parametrize(
    ("quantity", "at", "expected"),
    [
        # A step holds from its position to the next.
        (LINE.speed_limit, [0.0, 399.9, 400.0, 999.0], [20, 20, 30, 30]),
        (LINE.altitudes, [0.0, 250.0, 400.0, 1000.0], [500, 502.5, 499.5, 497.5]),
        # Linear in transitions and constant in arcs.
        (LINE.curvature, [50.0, 150.0, 600.0], [0.0, 0.001, 0.002]),
        (LINE.track_acceleration, [10.0, 600.0], [0.0981 / np.hypot(1.0, 0.01), 9.81 * 0.0012]),
        (TRAIN.tunnel_coefficient, [24.0, 30.0, 40.0, 0.0], [15.0, 11.0, 7.0, 0.0]),
        (TRAIN.tractive_effort_limit, [0.0, 5.0, 20.0], [200e3, 200e3, 100e3]),
    ],
)
def test_quantities_are_those_that_a_hand_calculation_gives(quantity, at, expected):
    np.testing.assert_allclose(quantity(at), expected)


@given(st.floats(0.001, 999.9))
def test_the_reversed_line_is_the_same_line(position):
    other = LINE.reversed()
    if np.min(np.abs(LINE.breakpoints - position)) < 1e-6:
        return
    there = LINE.length - position
    assert other.speed_limit(there) == LINE.speed_limit(position)
    assert other.gradient(there) == -LINE.gradient(position)
    assert other.curvature(there) == pytest.approx(-LINE.curvature(position), abs=1e-15)
    assert other.tunnel_cross_section(there) == LINE.tunnel_cross_section(position)
    assert other.altitudes(there) == pytest.approx(LINE.altitudes(position))


def test_nonsensical_lines_and_trains_are_refused_with_the_place():
    line = partial(level_line, 1000.0)
    for words, changes in (
        (
            r"speed limit at km 0\.400 is not positive",
            {"speed_limits": ((0.0, 20.0), (400.0, 0.0))},
        ),
        ("steeper than 200 per mille", {"gradients": ((0.0, 11.9),)}),
        ("beyond the line's end", {"speed_limits": ((0.0, 20.0), (1500.0, 30.0))}),
    ):
        refused(InputError, words, line, **{name: steps(*rows) for name, rows in changes.items()})
    # Just the steepest gradient stays one where its mean over a distance is rounded up.
    line(gradients=steps((0.0, 0.06), (66.3, -0.2)))
    refused(InputError, "not in the order", line, stations=(Station("B", 900.0), Station("A", 0.0)))
    refused(InputError, "leaves the line", line, tunnels=(Tunnel(900.0, 200.0, 40.0),))
    for length, section in ((-200.0, 40.0), (0.0, 40.0), (200.0, 0.0), (200.0, np.nan)):
        refused(InputError, "is not positive and finite", Tunnel, 300.0, length, section)
    said = r"values\[2\]: position 5 m follows 10 m; positions must increase"
    refused(InputError, said, StepProfile, np.array([0.0, 10.0, 5.0]), np.zeros(3))
    refused(InputError, "finite", StepProfile, np.array([0.0]), np.array([np.nan]))
    # Curves that do not rise from zero, and resistance that is negative at some speed.
    for curve in ((1.2, 0.54, 1.0, 1.0), (0.5, 1.2, 1.0, 0.9), (-0.1, 1.0, 1.0, 1.0)):
        refused(InputError, "creep curve", CreepCurve, *curve)
    negative = RunningResistance(1000.0, -200.0, 0.1)
    said = "running resistance is negative at"
    refused(InputError, said, Configuration, "c", 1e5, 1e4, negative, 1e6)
