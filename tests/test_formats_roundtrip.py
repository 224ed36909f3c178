"""What is written is read back: lines and trains to the last digits, results to the last bit."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from format_examples import (
    CONSISTS,
    PARAMETER_SETS,
    TRAINS,
    assert_same,
    journeys,
    lines,
    maps,
    trajectories,
)
from hypothesis import given, settings, strategies as st
from map_bytes import opened
from refusals import refused
from simulated_line import level_line, steps

from trainlog.errors import InputError, LogError
from trainlog.formats.declared import thing_from_bytes, thing_to_bytes
from trainlog.formats.files import plain, read_json
from trainlog.formats.mapfile import read_map, whole_file, write_map
from trainlog.formats.railway import (
    line_from_bytes,
    line_of,
    line_to_bytes,
    read_line,
    read_network,
    train_from_bytes,
    train_of,
    train_to_bytes,
    write_line,
    write_network,
    write_train,
)
from trainlog.formats.samples import sample
from trainlog.railway import Line, ParameterSet, RunningResistance, StepProfile, Train, Trajectory
from trainlog.railway.condition import ConditionLayer
from trainlog.railway.network import Edge, Network, Node
from trainlog.railway.train import Consist
from trainlog.railway.trajectory import Journey
from trainlog.trip import Trip

pytestmark = pytest.mark.usefixtures("remembered")

quick = settings(max_examples=15)
ROUNDING = 5e-14
"""Values that no number in the file's unit gives exactly keep 14 significant digits."""


SURVIVING: dict[str, tuple[st.SearchStrategy[Any], Callable[..., bytes], Callable[..., Any]]] = {
    "line": (lines(), line_to_bytes, line_from_bytes),
    "train": (TRAINS, train_to_bytes, train_from_bytes),
    "consist": (CONSISTS, thing_to_bytes, partial(thing_from_bytes, Consist)),
    "journey": (journeys(), thing_to_bytes, partial(thing_from_bytes, Journey)),
    "parameters": (PARAMETER_SETS, thing_to_bytes, partial(thing_from_bytes, ParameterSet)),
    "trajectory": (trajectories(), thing_to_bytes, partial(thing_from_bytes, Trajectory)),
}
TOML: dict[str, Callable[..., Any]] = {"line": write_line, "train": write_train}


@pytest.mark.parametrize("kind", SURVIVING)
@quick
@given(data=st.data())
def test_what_is_written_survives_and_results_to_the_last_bit(kind, data, tmp_path):
    drawn, write, read = SURVIVING[kind]
    thing = data.draw(drawn)
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
@given(maps())
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
    with pytest.raises(InputError, match="estimate of layer 'wet' is not that of its evidence"):
        write_map(replace(track, layers={"wet": other}), tmp_path / "other.map")
    assert not list(tmp_path.iterdir())


def simple_line() -> Line:
    limits = steps((0.0, 90 / 3.6), (400.0, 125 / 3.6))
    return level_line(1000.0, 0.0119, name="L", speed_limits=limits)


def simple_train() -> Train:
    return Train("T", 122e3, 0.1, RunningResistance(2378.88, 61.1, 12.08), 200e3, 2.6e6)


def test_numbers_stand_in_the_file_as_railway_people_write_them(tmp_path):
    write_line(simple_line(), tmp_path / "line.json")
    content = read_json(tmp_path / "line.json")
    assert content["speed_limits"] == {
        "units": {"position": "m", "speed": "km/h"},
        "values": [[0, 90], [400, 125]],
    }
    assert content["gradients"]["values"] == [[0, 11.9]]
    write_train(simple_train(), tmp_path / "train.json")
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
    text = line_to_bytes(simple_line()).decode()
    assert written in text
    changed = text.replace(written, declared)
    if "34.7" in declared:
        changed = changed.replace('"m", "speed": "km/h"', '"km", "speed": "m/s"')
    if "1.19" in declared:
        changed = changed.replace("permil", "%")
    assert_same(line_from_bytes(changed.encode()), simple_line(), 1e-15)


def test_what_json_cannot_say_is_refused_when_written():
    with pytest.raises(InputError, match=r"provenance\.gap: inf cannot be written"):
        thing_to_bytes(ParameterSet("T", (), provenance={"gap": np.inf}))
    with pytest.raises(InputError, match=r"details\[0\]\.a: a object cannot be written"):
        thing_to_bytes(ParameterSet("T", (), details=[{"a": object()}]))


def test_numpy_numbers_in_details_are_written_as_numbers():
    details = [{"a": np.float64(0.1), "b": np.int64(3), "c": np.array([[1.5]]), "d": (True, None)}]
    found = thing_from_bytes(ParameterSet, thing_to_bytes(ParameterSet("T", (), details=details)))
    assert found.details == [{"a": 0.1, "b": 3, "c": [[1.5]], "d": [True, None]}]


def trip(**metadata: str) -> Trip:
    attachments = {
        "line.json": line_to_bytes(simple_line()),
        "train.json": train_to_bytes(simple_train()),
    }
    return Trip({}, {"trip": "t1", **metadata}, attachments=attachments)


def test_a_trip_gives_its_line_in_the_direction_of_travel():
    assert line_of(trip()) == simple_line()
    assert line_of(trip(direction="forward")) == simple_line()
    assert line_of(trip(direction="reverse")) == simple_line().reversed()
    assert train_of(trip()) == simple_train()


def test_a_trip_without_line_or_with_a_damaged_one_is_refused():
    with pytest.raises(LogError, match=r"trip 't1' has no line\.json; attachments present: none"):
        line_of(Trip({}, {"trip": "t1"}))
    refused(LogError, "direction is 'backwards'", line_of, trip(direction="backwards"))
    damaged = Trip({}, {"trip": "t1"}, attachments={"train.json": b'{"format": '})
    refused(InputError, r"^train\.json of trip 't1', line 1, column 12: ", train_of, damaged)


def test_limits_of_two_directions_raise_the_version_of_lines_and_networks(tmp_path):
    """A trainlog that does not know them states that it is too old, not that a key is misspelt."""
    line = simple_line()
    both = replace(line, speed_limits_reverse=StepProfile([0.0], [20.0]))
    nodes = (Node("A"), Node("B"))
    for one, version in ((line, 1), (both, 2)):
        for name in ("one.line.json", "one.line.toml"):
            write_line(one, tmp_path / name)
            assert read_line(tmp_path / name) == one
        write_network(Network("n", nodes, (Edge("e", one, "A", "B"),)), tmp_path / "n.json")
        assert read_network(tmp_path / "n.json").edges[0].line.limits_against == one.limits_against
        for name in ("one.line.json", "n.json"):
            assert read_json(tmp_path / name)["version"] == version
        assert f"version = {version}" in (tmp_path / "one.line.toml").read_text()
    # As in a program that only knows version 1.
    path = tmp_path / "one.line.json"
    path.write_text(path.read_text().replace('"version": 2', '"version": 3'))
    refused(InputError, r"version 3 is newer than this trainlog knows \(2\)", read_line, path)
    path.write_text(path.read_text().replace('"version": 3', '"version": 0'))
    refused(InputError, "expected 1 or 2", read_line, path)
