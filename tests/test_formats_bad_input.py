"""Bad files are refused in one line that names the file, the place and what is wrong."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from contents import put
from refusals import refused
from test_formats_roundtrip import simple_line, simple_train

from trainlog.errors import InputError
from trainlog.formats.declared import read_thing, thing_from_bytes, thing_to_bytes
from trainlog.formats.files import read_bytes
from trainlog.formats.railway import read_line, read_train, train_from_bytes, train_to_bytes
from trainlog.formats.samples import sample
from trainlog.railway import (
    BrakingCurves,
    Configuration,
    ParameterSet,
    RunningResistance,
    Trajectory,
)
from trainlog.railway.train import Consist
from trainlog.railway.trajectory import Journey, TimingPoint

CONFIGURATION = Configuration("a", 1e5, 1e4, RunningResistance(1.0, 2.0, 3.0), 1e6)
GOOD: dict[str, Any] = {
    "line": simple_line(),
    "train": simple_train(),
    "consist": read_thing(Consist, sample("amirhosseini_2024_8_wagons.consist.json")),
    "journey": Journey("J", "L", (TimingPoint(0.0, 0.0), TimingPoint(9.0, 5.0, 6.0))),
    "parameters": ParameterSet(
        "T", (CONFIGURATION,), common_covariance=np.eye(3), provenance={"a": 1}
    ),
    "trajectory": Trajectory(
        "L",
        "T",
        np.array([0.0, 5.0, 9.0]),
        (CONFIGURATION,),
        np.ones((1, 3)),
        np.ones((1, 3)),
        np.ones(2),
        np.ones((1, 2)),
        9.0,
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


LINE_CASES = [
    ("length.unit", "kg", "f.json, length.unit: unit 'kg' cannot be read as m; declare a unit of"),
    ("length.value", -1, "f.json, length: -1 m is not positive; give more than 0"),
    ("length", {"value": 1}, "f.json, length.unit: 'unit' is missing; add it"),
    ("name", "", "f.json, name: must have at least 1 character"),
    ("speed_limits.values.1", [0, 9], "f.json, speed_limits.values[1]: position 0 m follows 0 m"),
    ("speed_limits.values.0.0", 5, "f.json, speed_limits.values: the first row is not at position"),
    ("stations.values.1.1", 2000, "f.json: line 'L': station at km 2.000 lies before the line's"),
    ("stations.values.0.0", 7, "f.json, stations.values[0][0]: must be a valid string"),
    (
        "curvatures",
        {
            "units": {"position": "m", "radius_at_start": "m", "radius_at_end": "m"},
            "values": [[0, "infinity", 500], [9, 500, 0]],
        },
        "f.json, curvatures.values[1]: the radius is 0 m; straight track has the radius 'infinity'",
    ),
    (
        "geometry",
        {
            "quality": "q",
            "track": {
                "units": {"position": "m", "latitude": "deg", "longitude": "deg"},
                "values": [[0, 9, 47], [9, 95, 47]],
            },
        },
        "f.json, geometry: a coordinate is beyond 90° of latitude or 180° of longitude; give degr",
    ),
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
    data = train_to_bytes(simple_train())
    for number, said in (
        (b"NaN", r"^f\.json, line 6, column 21: NaN is not"),
        (b"1e999", r"^f\.json, mass\.value: is not a finite number"),
    ):
        refused(InputError, said, train_from_bytes, data.replace(b"122", number), file="f.json")


def test_unknown_braking_parameters_are_not_dropped_when_written():
    train = replace(simple_train(), braking_curves=BrakingCurves(parameters={"T_new": 1.0}))
    with pytest.raises(InputError, match="parameter 'T_new' is not known, so its unit is not"):
        train_to_bytes(train)


def test_all_that_is_wrong_with_a_line_is_listed_at_once(tmp_path):
    """Keys, types, units, the order of rows, and values that cannot be meant."""
    content = good("line")
    content["colour"] = "red"
    content["length"] = 1000
    content["altitude"] = {"value": 0.4, "unit": "kg"}
    content["speed_limits"]["values"][0][1] = 900
    content["stations"]["values"][0][0] = 7
    path = put(tmp_path / "l.json", json.dumps(content))
    caught = refused(InputError, "", read_line, path)
    assert [problem.place for problem in caught.each] == [
        "colour",
        "length",
        "altitude.unit",
        "stations.values[0][0]",
        "speed_limits.values[0][1]",
    ]
    assert all(problem.remedy or "must be" in problem.problem for problem in caught.each)
    assert str(caught).startswith(f"{path}: 5 problems: (1) colour: unknown key 'colour'; ")


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
        (
            "train",
            {"length": of(58_600, "m")},
            "length: 58600 m is not plausible: trains have 5 to",
        ),
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
        (
            "line",
            {"speed_limits.units.speed": "m/s", "speed_limits.values": [[0, 90], [500, 200]]},
            "720 km/h is not plausible",
        ),
        # Rise over the whole line of St.Gallen-Wil stays small: a long ramp does not.
        (
            "line",
            {"gradients.units.gradient": "%", "gradients.values": [[0, 12]]},
            "were per mille meant where the unit states '%'",
        ),
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
    assert read_train(path).mass == pytest.approx(122e3 * factor)


def test_logs_are_not_judged():
    """What a log was recorded with can be read, whatever it states."""
    train = replace(simple_train(), mass=122.0)
    assert train_from_bytes(train_to_bytes(train)).mass == 122.0
