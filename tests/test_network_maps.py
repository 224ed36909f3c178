"""Maps of a network: what trips on routes show counts on the edges that they ran over."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from fleet_trips import later
from refusals import refused

import trainlog
from analysis import view
from analysis.adhesion.condition_map import empty_map_of, update_map
from analysis.adhesion.evidence import Evidence
from analysis.network.edges import EdgeOfLine
from analysis.network.maps import (
    LogOnEdges,
    NetworkMap,
    edge_map_path,
    forecasts_of_network,
    map_along,
    network_map,
    update_network_map,
)
from analysis.reports.fleet import condition_parts, known_maps
from analysis.verification.scoring import score_network, score_network_on
from trainlog import Edge, InputError, Line, LogError, Network, Node, read_line, sample
from trainlog.arrays import same_values
from trainlog.formats.files import sha256_of
from trainlog.formats.railway import line_to_bytes

WHOLE = read_line(sample("CH_StGallen_Wil.line.json")).section(0.0, 16_000.0)
CUT = 10_000.0
"""A whole number of bins, so that edges have the bins of the whole line."""

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds")


def network() -> Network:
    """The sample line as two edges, the second counted the other way."""
    nodes = Node("East"), Node("Mid", "junction"), Node("West")
    east = Edge("east", WHOLE.section(0.0, CUT), "East", "Mid")
    west = Edge("west/old", WHOLE.section(CUT, WHOLE.length).reversed(), "West", "Mid")
    return Network("cut", nodes, (east, west))


def on_line(name: str, line: Line, path: Path, days: float = 0.0) -> Path:
    """A sample log near the cut, as if driven on another line, days later."""
    trip = trainlog.read(sample(name)).within(7_500.0, 15_000.0)
    named = {"line": line.name, "trip": path.stem, "weather": "wet"}
    attached = {**trip.attachments, "line.json": line_to_bytes(line)}
    moved = replace(trip, metadata=trip.metadata | named, attachments=attached)
    trainlog.write(later(moved, pd.Timedelta(days=days)), path)
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("network")
    route = network().route("East", "West").line
    for number in range(3):
        on_line("stopping.mcap", route, folder / f"day-{number}.mcap", days=float(number))
    return folder


@pytest.fixture(scope="module")
def maps(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps") / "maps"
    update_network_map(logs, folder, network())
    return folder


def test_a_trip_on_a_route_counts_on_its_edges_as_it_does_on_its_line(logs, maps, tmp_path):
    update_map(logs, tmp_path / "route.map")
    route = trainlog.read_map(tmp_path / "route.map").layer("wet").evidence
    found = network_map(maps)
    assert found.network == network()
    east, west = (found.maps[name].layer("wet").evidence for name in ("east", "west/old"))
    bins = int(CUT / 25.0)
    np.testing.assert_array_equal(route.by_bin("events")[:bins], east.by_bin("events"))
    # Bins of the edge that is counted the other way begin at its own end.
    lasts = west.by_bin("events")[::-1]
    assert lasts.sum() == route.by_bin("events")[bins:].sum() > 0
    np.testing.assert_allclose(east.by_bin("weighted_log"), route.by_bin("weighted_log")[:bins])
    assert found.maps["west/old"].trips[0]["trip"] == "day-0@west/old"
    # The weather that the log recorded is kept as on a line.
    for track in (trainlog.read_map(tmp_path / "route.map"), *found.maps.values()):
        kept = [trip["weather"] for trip in track.trips]
        assert [each["temperature_source"] for each in kept] == ["log"] * 3


def test_the_map_along_a_route_has_places_and_directions_right(maps):
    found = network_map(maps)
    there = found.along(network().route("East", "West").line).layer("wet")
    back = found.along(network().route("West", "East").line).layer("wet")
    east = found.maps["east"].layer("wet")
    bins = int(CUT / 25.0)
    np.testing.assert_array_equal(there.events[:bins], east.events)
    at = np.flatnonzero(there.events)
    mirrored = (WHOLE.length - (at + 0.5) * 25.0) // 25.0
    seen = np.flatnonzero(back.events)
    assert np.abs(np.sort(mirrored) - seen).max() <= 1.0
    assert there.events.sum() == back.events.sum()
    only = map_along(network().route("East", "West").line, {"east": found.maps["east"]})
    assert not only.layer("wet").observed[bins + 40 :].any()
    refused(InputError, "no map of an edge of line 'CH_StGallen_Wil'", found.along, WHOLE)


def test_a_second_update_adds_nothing_and_an_interrupted_one_is_finished(logs, maps, tmp_path):
    again = update_network_map(logs, maps)
    assert (len(again.added), len(again.of("held"))) == (0, 3)
    assert (again.trips, again.days) == (3, 3), "a trip over two edges is one trip"
    # Killed between the edges of a trip, an update leaves a folder like this one.
    folder = tmp_path / "killed"
    update_network_map(logs / "day-0.mcap", folder, network())
    edge_map_path(folder, "west/old").unlink()
    finished = update_network_map(logs, folder)
    assert len(finished.added) == 3
    one, other = network_map(folder).maps, network_map(maps).maps
    assert one.keys() == other.keys()
    for name, track in one.items():
        assert track.layer("wet").evidence == other[name].layer("wet").evidence
        assert [each["sha256"] for each in track.trips] == [
            each["sha256"] for each in other[name].trips
        ]


@pytest.mark.parametrize(
    ("edge", "stem", "earlier"),
    [
        ("Zürich HB: 3", "Zürich HB_ 3 e7a72f45", "Z%C3%BCrich HB%3A 3"),
        ("Sursee", "Sursee", "Sursee"),
    ],
)
def test_an_edge_has_one_map_by_whatever_it_is_written(edge, stem, earlier, tmp_path):
    """The map of a fleet and that of given logs had names of their own."""
    line = replace(WHOLE, name=edge)
    log = on_line("nonstop.mcap", line, tmp_path / "trip.mcap")
    folder = tmp_path / "maps"
    folder.mkdir()
    old, new = folder / f"{earlier}.map", folder / f"{stem}.map"
    assert edge_map_path(folder, edge) == new
    update_map(log, old)
    assert edge_map_path(folder, edge) == old
    assert update_network_map(log, folder).of("held")
    assert [each.name for each in folder.glob("*.map")] == [old.name]
    if old == new:
        return
    shutil.copy(old, new)
    parts = " ".join(map(str, condition_parts(known_maps(folder))))
    assert f"edge '{edge}' has two maps, '{old.name}' and '{new.name}'" in parts
    for reading in (
        lambda: network_map(folder),
        lambda: edge_map_path(folder, edge),
        lambda: update_network_map(log, folder),
    ):
        refused(InputError, r"has two maps, .* 'trainlog map merge'", reading)


def test_trips_on_ordinary_lines_go_to_the_edge_of_their_name(tmp_path):
    update_network_map(sample("nonstop.mcap"), tmp_path / "maps")
    assert list(network_map(tmp_path / "maps").maps) == ["CH_StGallen_Wil"]
    found = update_network_map(sample("nonstop.mcap"), tmp_path / "other", network())
    assert "has no edge 'CH_StGallen_Wil'" in found.refused[0].reason
    given = sample("nonstop.mcap"), tmp_path / "other", replace(network(), source="else")
    refused(InputError, "differs from the 'cut' given", update_network_map, *given)
    refused(InputError, "has no track-condition maps", network_map, tmp_path / "other")


def test_forecasts_and_scores_of_all_edges(maps):
    found = network_map(maps)
    whole, edges = score_network(found)
    assert set(edges) == {"east", "west/old"}
    onsets = sum(each.layers["all"].onsets + each.layers["all"].unknown_onsets
                 for each in edges.values())  # fmt: skip
    pooled = whole.layers["all"]
    assert pooled.onsets + pooled.unknown_onsets == onsets > 0
    assert pooled.days.size == 2
    # The same trip on three days: the day before foresees the next better than the prior.
    assert pooled.log_score("onsets", over="prior").value > 0.0
    when, forecasts = forecasts_of_network(found)
    assert set(forecasts) == {"east.csv", "west_old dfa56536.csv"}
    assert when.date() > pd.Timestamp("2024-10-07").date()
    early = pd.Timestamp("2024-10-08T00:00Z")
    assert sum(len(track.trips) for track in found.known_before(early).maps.values()) == 2
    before = pd.Timestamp("2020-01-01T00:00Z")
    said = "no edge has evidence of a day before 2020"
    refused(InputError, said, forecasts_of_network, found, before)
    none = NetworkMap(maps, None, {})
    refused(InputError, "no edge has evidence of two days", score_network, none)


def test_maps_are_scored_on_later_trips_edge_by_edge(maps, logs):
    found = network_map(maps)
    early = found.known_before(pd.Timestamp("2024-10-08T00:00Z"))
    every = sorted(logs.glob("*.mcap"))
    whole, edges = score_network_on(early, every)
    held = {each["sha256"] for track in early.maps.values() for each in track.trips}
    later = [path for path in every if sha256_of(path) not in held]
    assert later, "some trip must be later"
    alone, _ = score_network_on(early, later)
    assert same_values(whole.layers["all"].details(), alone.layers["all"].details())
    assert {each.trip for each in whole.left_out} == {"day-0@east", "day-0@west/old"}
    assert whole.layers["all"].onsets == sum(each.layers["all"].onsets for each in edges.values())
    # What ran on an edge without a map is stated, and the other edges are scored.
    name = next(iter(edges))
    partial, rest = score_network_on(replace(early, maps={name: early.maps[name]}), later[:1])
    assert set(rest) == {name}
    assert any("has no map" in words for words in partial.limits)
    refused(InputError, "no later trip on an edge with a map", score_network_on, found, every[:1])


def test_a_log_too_long_for_the_memory_is_one_trip_on_each_of_its_edges(logs, monkeypatch):
    for name, value in (("ROWS", 1_000), ("PAUSE", 20.0)):
        monkeypatch.setattr(view, name, value)
    given = LogOnEdges(logs / "day-0.mcap", network())
    assert len(given.pieces) > 2
    found = [
        given.evidence_on(edge, empty_map_of(edge.name, edge.length), None, None, "")
        for edge in given.edges
    ]
    assert [each.trip for each in found] == ["day-0@east", "day-0@west/old"]


@pytest.mark.usefixtures("unpainted")
def test_commands_take_a_folder_of_maps(maps, tmp_path, works):
    picture = tmp_path / "network.png"
    assert "west/old" in works("map", "show", maps, "--picture", picture)
    assert picture.is_file()
    works("map", "forecast", maps, "-o", tmp_path / "forecast")
    assert sorted(path.name for path in (tmp_path / "forecast").iterdir()) == [
        "east.csv",
        "west_old dfa56536.csv",
    ]
    shown = works("map", "score", maps, "--rolling")
    assert "network cut" in shown
    assert "west/old" in shown


def test_a_trip_refused_on_one_edge_is_scored_on_the_others(maps, logs, monkeypatch):
    found = network_map(maps)
    early = found.known_before(pd.Timestamp("2024-10-08T00:00Z"))
    every = sorted(logs.glob("*.mcap"))[1:]
    first = LogOnEdges(every[-1], found.network).edges[0].name
    whole, edges = score_network_on(early, every)
    evidence_on = LogOnEdges.evidence_on

    def refusing(given: LogOnEdges, edge: EdgeOfLine, *rest: Any) -> Evidence:
        if edge.name == first:
            raise LogError(f"trip '{given.trip.name}' was not recorded on edge '{edge.name}'")
        return evidence_on(given, edge, *rest)

    monkeypatch.setattr(LogOnEdges, "evidence_on", refusing)
    partial, rest = score_network_on(early, every)
    assert set(rest) == set(edges) - {first}
    for name, score in rest.items():
        assert same_values(score.layers["all"].details(), edges[name].layers["all"].details())
    assert len(partial.refused) == len(every) > len(whole.refused)
    assert all(words.startswith(f"edge '{first}': ") for words in partial.refused)
