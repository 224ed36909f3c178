"""Infrastructure of OSRD and railML as networks, judged by readings of the files of their own."""

from __future__ import annotations

import heapq
import itertools
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from contents import put
from refusals import refused

from analysis.network.edges import export_network
from trainlog.errors import InputError
from trainlog.formats.declared import thing_to_bytes
from trainlog.formats.imports import ImportOptions, import_file, networks_in
from trainlog.formats.railway import read_line, read_network, write_network
from trainlog.formats.tracks import Infrastructure
from trainlog.railway import Line, Station, StepProfile
from trainlog.railway.network import Network, network_of_lines

RAILML = Path(__file__).parent / "data" / "railml"
"""Small infrastructure written after https://wiki2.railml.org and https://wiki3.railml.org.

Version 2.4: a line with a loop, mileage with a gap, limits by direction, two ways to end a track.
Version 3.2: a switch, locations by share, position and measure, one against its net element.
"""
RAILML_2, RAILML_3, TUNNELS_2, TUNNELS_3 = (
    (RAILML / f"{name}.xml").read_text("utf-8")
    for name in ("valley-2.4", "switch-3.2", "tunnels-2.4", "tunnels-3.2")
)

OSRD = Path(__file__).parents[1] / ".." / "shared" / "data" / "osrd"
INFRAS = ("tiny_infra", "one_line", "nested_switches", "overlapping_routes", "small_infra")

needs_osrd = pytest.mark.skipif(not OSRD.is_dir(), reason="needs ../shared/data/osrd")

CONNECTED = {
    "link": ["A B"],
    "point_switch": ["A B1", "A B2"],
    "crossing": ["A1 B1", "A2 B2"],
    "double_slip_switch": ["A1 B1", "A1 B2", "A2 B1", "A2 B2"],
}
"""By the documentation of OSRD: which ports of a switch a train passes between."""


@cache
def file_of(name: str) -> Any:
    """What a file of OSRD holds; no test changes it."""
    return json.loads((OSRD / "infras" / f"{name}.json").read_text())


class Reading:
    """A file of OSRD, searched and read piece by piece of its track sections, without networks."""

    def __init__(self, name: str) -> None:
        self.file = file_of(name)
        self.tracks = {each["id"]: each for each in self.file["track_sections"]}
        self.onward: dict[tuple[str, str], list[tuple[str, str]]] = {}
        for switch in self.file["switches"]:
            ports = {key: (p["track"], p["endpoint"]) for key, p in switch["ports"].items()}
            for pair in CONNECTED[switch["switch_type"]]:
                one, two = (ports[key] for key in pair.split())
                self.onward.setdefault(one, []).append(two)
                self.onward.setdefault(two, []).append(one)
        self.stations = {
            each["extensions"]["identifier"]["name"]: each["parts"]
            for each in self.file["operational_points"]
        }

    def way(self, start: str, goal: str) -> tuple[float, list[tuple[str, float, float]]] | None:
        """Length of the shortest way, and from where to where it runs on each section."""
        goals = {(part["track"], part["position"]) for part in self.stations[goal]}
        queue: list[Any] = []
        count = itertools.count()
        for part in self.stations[start]:
            for forward in (True, False):
                state = (part["track"], part["position"], forward)
                heapq.heappush(queue, (0.0, next(count), state, []))
        seen = set()
        while queue:
            far, _, (track, at, forward), past = heapq.heappop(queue)
            if track == "":
                return far, past
            if (track, at, forward) in seen:
                continue
            seen.add((track, at, forward))
            length = self.tracks[track]["length"]
            for name, place in goals:
                if name == track and (place >= at if forward else place <= at):
                    reached = [*past, (track, at, place)]
                    key = (far + abs(place - at), next(count), ("", 0.0, True), reached)
                    heapq.heappush(queue, key)
            end = length if forward else 0.0
            for other, endpoint in self.onward.get((track, "END" if forward else "BEGIN"), []):
                state = (other, 0.0, True)
                if endpoint == "END":
                    state = (other, self.tracks[other]["length"], False)
                further = [*past, (track, at, end)]
                heapq.heappush(queue, (far + abs(end - at), next(count), state, further))
        return None

    def at(self, way: list[tuple[str, float, float]], position: float) -> tuple[str, float, int]:
        """Section, position on it, and direction along it, so far from the way's start."""
        for track, start, end in way:
            if position <= abs(end - start):
                sign = 1 if end >= start else -1
                return track, start + sign * position, sign
            position -= abs(end - start)
        raise AssertionError(position)

    def gradient(self, track: str, at: float) -> float:
        found = [s["gradient"] for s in self.tracks[track]["slopes"] if s["begin"] < at < s["end"]]
        return found[-1] / 1000.0 if found else 0.0

    def curvature(self, track: str, at: float) -> float:
        found = [s["radius"] for s in self.tracks[track]["curves"] if s["begin"] < at < s["end"]]
        return 1.0 / found[-1] if found else 0.0

    def limit(self, track: str, at: float, sign: int, category: str | None = None) -> float:
        """Of trains along the section or against it; the lowest of all categories, or of one."""
        other_way = "STOP_TO_START" if sign > 0 else "START_TO_STOP"
        found = []
        for section in self.file["speed_sections"]:
            for each in section["track_ranges"]:
                if each["applicable_directions"] == other_way or each["track"] != track:
                    continue
                if each["begin"] < at < each["end"]:
                    found.append(self.speed(section, category))
        return min(found) if found else self.assumed(category)

    @staticmethod
    def speed(section: dict[str, Any], category: str | None) -> float:
        by_tag, general = section["speed_limit_by_tag"], section["speed_limit"]
        if category is None:
            return min([general, *by_tag.values()])
        return float(by_tag.get(category, general))

    def assumed(self, category: str | None) -> float:
        """The lowest limit of the file, 80 km/h without any."""
        sections = self.file["speed_sections"]
        return min((self.speed(each, category) for each in sections), default=80.0 / 3.6)


@cache
def imported(name: str, category: str | None = None) -> Network:
    (network,) = networks_in(OSRD / "infras" / f"{name}.json", category=category).networks
    return network


@needs_osrd
@pytest.mark.parametrize("name", INFRAS)
def test_every_infrastructure_of_osrd_becomes_a_network_with_all_its_track(name, tmp_path):
    (written,) = import_file(OSRD / "infras" / f"{name}.json", tmp_path)
    network = read_network(written.path)
    tracks = file_of(name)["track_sections"]
    assert network.length == pytest.approx(sum(each["length"] for each in tracks))
    assert written.path.read_bytes() == thing_to_bytes(imported(name))
    assert written.path.read_bytes() == thing_to_bytes(network)
    assert all(edge.name in repr(edge.line) for edge in network.edges)


@needs_osrd
@pytest.mark.parametrize("name", ["tiny_infra", "small_infra"])
def test_routes_are_as_long_steep_bent_and_slow_as_the_file_states(name):
    reading, network, draw = Reading(name), imported(name), np.random.default_rng(16)
    found = []
    for start, goal in itertools.permutations(reading.stations, 2):
        way = reading.way(start, goal)
        if way is None:
            refused(InputError, "no route", network.route, start, goal)
            continue
        line = network.route(start, goal).line
        assert line.length == pytest.approx(way[0])
        places = draw.uniform(0.0, way[0], 40)
        at = [reading.at(way[1], place) for place in places.tolist()]
        gradient = [sign * reading.gradient(track, there) for track, there, sign in at]
        curvature = [sign * reading.curvature(track, there) for track, there, sign in at]
        limit = np.array([reading.limit(*each) for each in at])
        assert line.gradient(places) == pytest.approx(np.array(gradient), abs=1e-12)
        assert line.curvature(places) == pytest.approx(np.array(curvature), abs=1e-12)
        assert line.speed_limit(places) == pytest.approx(limit)
        found.append([np.count_nonzero(each) for each in (gradient, curvature, limit < 60.0)])
    assert len(found) >= 2
    assert name == "tiny_infra" or np.sum(found, axis=0).min() > 10


@needs_osrd
@pytest.mark.parametrize("category", [None, "none", "E32C", "HLP", "MA100"])
@pytest.mark.parametrize("name", INFRAS)
def test_limits_are_those_of_the_direction_and_of_the_category_of_the_train(name, category):
    reading = Reading(name)
    tags = {tag for each in reading.file["speed_sections"] for tag in each["speed_limit_by_tag"]}
    if category not in (None, "none", *tags):
        with pytest.raises(InputError, match=f"no speed limits of the category '{category}'"):
            imported(name, category)
        return
    draw, compared, differ = np.random.default_rng(5), 0, 0
    for edge in imported(name, category).edges:
        if edge.name not in reading.tracks:
            continue
        line, back = edge.line, edge.line.reversed()
        places = draw.uniform(0.0, line.length, 25)
        along, against = (
            np.array([reading.limit(edge.name, at, sign, category) for at in places.tolist()])
            for sign in (1, -1)
        )
        assert line.speed_limit(places) == pytest.approx(along)
        assert back.speed_limit(line.length - places) == pytest.approx(against)
        compared += 25
        differ += int(np.count_nonzero(along != against))
    assert compared >= 25 or name == "one_line"
    # Of the five, nested_switches alone has limits of one direction.
    assert (differ > 40) is (name == "nested_switches")


def switch(name: str, kind: str, **ports: str) -> dict[str, Any]:
    """A switch whose ports are at ends of tracks, as in ``"a END"``."""
    ends = {
        port: dict(zip(("track", "endpoint"), at.split(), strict=True))
        for port, at in ports.items()
    }
    return {"id": name, "switch_type": kind, "ports": ends}


BRANCH = switch("s", "point_switch", A="a END", B1="b BEGIN", B2="c BEGIN")
LINK = switch("t", "link", A="a END", B="gone BEGIN")
TRACKS = [
    {"id": name, "length": length, "slopes": [], "curves": []}
    for name, length in (("a", 1000.0), ("b", 500.0), ("c", 700.0))
]


def point(name: str, track: str, position: float) -> dict[str, Any]:
    return {"id": name, "parts": [{"track": track, "position": position}]}


def read_small(tmp_path: Path, **changes: Any) -> Infrastructure:
    """Two sections and a branch, as railjson, but for the changes."""
    path = tmp_path / "small.json"
    infra = {"version": "3.4.12", "track_sections": TRACKS, "switches": [BRANCH]}
    path.write_text(json.dumps(infra | changes))
    return networks_in(path)


def test_a_track_that_returns_to_its_switch_is_two_edges(tmp_path):
    loop = switch("s", "point_switch", A="a END", B1="b BEGIN", B2="b END")
    points = [point("p", "a", 400.0), point("q", "b", 100.0)]
    (network,), *_ = read_small(
        tmp_path, switches=[loop], track_sections=TRACKS[:2], operational_points=points
    )
    # It turns back at station q; sent through a place that is none, it goes round the loop.
    assert network.route("p", "q", "p").length == pytest.approx(2 * 700.0)
    assert network.route("p", "b/1@0.2", "p").length == pytest.approx(600.0 + 500.0 + 600.0)
    assert all(edge.start != edge.end for edge in network.edges)


def test_what_a_network_does_not_hold_of_osrd_may_be_of_any_kind(tmp_path):
    named = point("x", "a", 400.0) | {"extensions": {"identifier": True}}
    found = read_small(tmp_path, routes=-5.5, signals=None, operational_points=[named])
    assert found.left_out == ["routes of the interlocking: 1"]
    edges = found.networks[0].edges
    assert [station.name for edge in edges for station in edge.line.stations] == ["x"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"switches": [BRANCH | {"switch_type": "magic"}]}, "type 'magic'"),
        (
            {"switches": [BRANCH, LINK]},
            r"switches\[1\].ports.A: the END of track section 'a' is at switch 't'",
        ),
        (
            {"operational_points": [point("x", "gone", 1.0)]},
            r"operational_points\[0\].parts\[0\]: refers to the track section 'gone'",
        ),
        ({"operational_points": [point("x", "a", 1200.0)]}, "1000 m long"),
        ({"track_sections": [TRACKS[0]] * 2}, "comes twice"),
        ({"track_sections": []}, "track_sections: has too few entries"),
    ],
)
def test_infrastructure_of_osrd_that_contradicts_itself_is_refused(changes, words, tmp_path):
    refused(InputError, words, read_small, tmp_path, **changes)


def railml(text: str, tmp_path: Path) -> Infrastructure:
    return networks_in(put(tmp_path / "given.xml", text))


def test_tracks_of_railml_2_connect_as_its_switches_state(tmp_path):
    (network,), *_ = railml(RAILML_2, tmp_path)
    assert network.name == "valley"
    assert network.length == pytest.approx(4_000.0 + 2_050.0 + 1_500.0)
    assert network.route("Anfang", "Cham").length == pytest.approx(5_000.0)
    assert [leg.edge for leg in network.route("Cham", "loop@1.5").legs] == ["main/3+onward", "loop"]
    refused(InputError, "no route", network.route, "main/2@13.8", "loop@0.1")


def test_kilometres_of_railml_that_do_not_fit_their_track_are_stated(tmp_path):
    words = "tracks whose kilometres do not fit their length, as stated: 1"
    assert words not in railml(RAILML_2, tmp_path).assumed
    for stated, wrong in (("16200.0", "1000000.0"), ("12000.0", "-500.0")):
        text = RAILML_2.replace(f'absPos="{stated}"', f'absPos="{wrong}"')
        assert words in railml(text, tmp_path).assumed


def test_a_route_of_railml_2_has_its_gradients_curves_limits_and_kilometres(tmp_path):
    (network,), *_ = railml(RAILML_2, tmp_path)
    line = network.route("Anfang", "Cham").line
    # Track 'main' from its pos 500 on: position s is pos s + 500; 'onward' from 3500 on.
    assert (1e3 * line.gradient([100.0, 400.0, 1_600.0, 1_800.0, 4_000.0])).round(9).tolist() == [
        0.0, 12.5, 12.5, -4.0, 3.0,
    ]  # fmt: skip
    radius = 1.0 / line.curvature([900.0, 1_000.0, 1_300.0])
    assert radius.round(3).tolist() == [500.0, 500.0, -400.0]
    # In the middle of the clothoid from straight track to 500 m.
    assert 1.0 / line.curvature(750.0) == pytest.approx(1_000.0)
    # Up 40 km/h for freight trains, the lowest; down 100 km/h as far as 2600, 60 from there.
    places = np.array([100.0, 1_900.0, 2_050.0, 2_150.0, 3_400.0, 3_600.0])
    limits = 3.6 * line.speed_limit(places)
    assert limits.round(6).tolist() == [40.0, 40.0, 40.0, 40.0, 40.0, 100.0]
    down = 3.6 * network.route("Cham", "Anfang").line.speed_limit(5_000.0 - places)
    assert down.round(6).tolist() == [60.0, 60.0, 60.0, 100.0, 100.0, 100.0]
    for_all = networks_in(tmp_path / "given.xml", category="none")
    # Up 80 km/h, 120 from 2500 on.
    up = 3.6 * for_all.networks[0].route("Anfang", "Cham").line.speed_limit(places)
    assert up.round(6).tolist() == [80.0, 80.0, 120.0, 120.0, 120.0, 100.0]
    # The mileage jumps from 13.500 to 13.700 at pos 1500.
    assert line.kilometre([0.0, 999.0, 1_001.0, 5_000.0]).tolist() == [
        12_500.0, 13_499.0, 13_701.0, 17_700.0,
    ]  # fmt: skip
    assert line.reference.name == "valley line"
    assert [station.name for station in line.stations] == ["Anfang", "Brugg", "Cham"]
    course = network.route("Anfang", "Brugg").line.geometry
    assert course.at([1_500.0])[0] == pytest.approx(47.0179854, abs=1e-6)
    back = network.route("Cham", "Anfang").line
    s = np.linspace(10.0, 4_990.0, 60)
    assert np.allclose(back.gradient(5_000.0 - s), -line.gradient(s))


def test_net_elements_of_railml_3_connect_as_its_relations_state(tmp_path):
    (network,), left_out, assumed = railml(RAILML_3, tmp_path)
    assert {edge.name: edge.line.length for edge in network.edges} == {
        "ne_a": 2_000.0, "ne_b": 1_500.0, "ne_c": 1_550.0,
    }  # fmt: skip
    assert {node.name for node in network.nodes} == {"ne_a begin", "77W1", "stop b", "ne_c end"}
    # ne_b joins with its end: 'Neu' lies at 300 m of it, at 1200 m of ne_c.
    assert network.route("Alt", "ne_b@0.3").length == pytest.approx(1_800.0 + 1_200.0)
    assert network.route("Alt", "ne_c@1.2").length == pytest.approx(1_800.0 + 1_200.0)
    refused(InputError, "no route", network.route, "ne_b@0.3", "ne_c@1.2")
    assert {
        "temporary speed sections: 1",
        "signalsIS: 1",
        "net elements of other levels, collections, or without a length: 1",
    } <= set(left_out)
    assert any(each.startswith("level where no gradients are stated: 1.550 km") for each in assumed)


def test_locations_of_railml_3_are_shares_positions_measures_and_directions(tmp_path):
    (network,), *_ = railml(RAILML_3, tmp_path)
    main, other = network.edge("ne_a").line, network.edge("ne_b").line
    # 10 per mille for 0.9 of it, an arc to -4, whose mean is 3.
    assert (1e3 * main.gradient([1_000.0, 1_850.0, 1_950.0])).round(9).tolist() == [10.0, 3.0, -4.0]
    # On ne_b the location runs against the element.
    assert other.gradient(700.0) == pytest.approx(0.004)
    assert main.curvature(500.0) == 0.0
    assert 1.0 / main.curvature(1_100.0) == pytest.approx(-1_200.0)
    assert 1.0 / main.curvature(1_700.0) == pytest.approx(-600.0)
    assert main.kilometre(500.0) == pytest.approx(10_500.0)
    assert main.reference.name == "line 77"
    assert main.geometry.at([1_000.0])[0] == pytest.approx(47.0089927)
    # 60 km/h of a speed profile, but none for all trains.
    assert other.assumed == ()
    assert 3.6 * other.speed_limit(100.0) == pytest.approx(60.0)
    loop = network.edge("ne_c").line
    assert 3.6 * loop.speed_limit(100.0) == pytest.approx(40.0)
    # Its 40 km/h hold along it alone; against it the file states nothing.
    assert loop.assumed == ("gradients", "speed_limits")


def test_tunnels_of_railml_2_lie_on_their_tracks_and_bridges_are_counted(tmp_path):
    text = RAILML_2.replace("<levelCrossings>", f"{TUNNELS_2}<levelCrossings>")
    (network,), left_out, assumed = railml(text, tmp_path)
    line = network.route("main/1@12", "Cham").line
    places = [850.0, 950.0, 1_340.0, 1_400.0, 3_790.0, 3_900.0, 4_050.0]
    # From pos 900 to 1350, over the switch at 1000; from 3800 to the track's end at 4000.
    assert line.tunnel_cross_section(places).tolist() == [0.0, 46.0, 46.0, 0.0, 0.0, 50.0, 0.0]
    assert {"tunnels without a length: 1", "bridges: 1"} <= set(left_out)
    assert "tunnels that reach beyond their track, cut off there: 1" in left_out
    assert "tunnels whose cross-section is not stated, taken as 50 m²: 1" in assumed
    unknown = [each.name for each in network.edges if "tunnel_cross_sections" in each.line.assumed]
    assert unknown == ["main/3+onward"]


def test_tunnels_of_railml_3_are_crossings_over_the_track(tmp_path):
    text = RAILML_3.replace("<switchesIS>", f"{TUNNELS_3}<switchesIS>")
    (network,), left_out, assumed = railml(text, tmp_path)
    line = network.route("ne_a@10", "ne_b@0.3").line
    assert line.tunnel_cross_section([1_490.0, 1_510.0, 2_290.0, 2_310.0]).tolist() == [
        0.0, 72.5, 72.5, 0.0,
    ]  # fmt: skip
    assert network.edge("ne_c").line.tunnel_cross_section([50.0, 200.0]).tolist() == [0.0, 50.0]
    assert {
        "overCrossings that are not tunnels: 1",
        "tunnels without a stretch of track: 1",
        "underCrossings: 1",
    } <= set(left_out)
    assert "tunnels whose cross-section is not stated, taken as 50 m²: 1" in assumed


@pytest.mark.parametrize(
    ("text", "old", "new", "words"),
    [
        (RAILML_2, 'ref="c2b"', 'ref="gone"', r"line \d+, connection 'c1a': refers to the"),
        (RAILML_2, 'id="c3b" ref="c1e"', 'id="c3b" ref="c1a"', "must refer to each other"),
        (RAILML_2, 'ocpRef="ocpC"', 'ocpRef="x"', "refers to the ocp 'x'"),
        (RAILML_2, 'slope="12.5"', 'slope="steep"', "gradientChange 'g2': slope 'steep' is not"),
        (RAILML_2, 'id="g3" pos="2200.0"', 'id="g3" pos="9000"', "pos 9000 is not on track 'main'"),
        (RAILML_2, 'slope="12.5"', 'slope="1250"', "steeper than 200 per mille"),
        (RAILML_2, 'version="2.4"', 'version="1.1"', "is not railML 2 or 3"),
        (RAILML_2, "</railml>", "", r"line \d+, column \d+: is not XML"),
        (RAILML_2, "<railml ", '<!DOCTYPE r [<!ENTITY a "b">]>\n<railml ', "declares the entity"),
        (RAILML_2, "<tracks>", "<tracks/><others>", "is not XML"),
        (RAILML_3, '<elementB ref="ne_c"/>', '<elementB ref="ne_x"/>', "the net element 'ne_x'"),
        (RAILML_3, 'intrinsicCoord="0.2"', 'intrinsicCoord="2"', "is not from 0 to 1"),
        (RAILML_3, 'measure="11200"', 'measure="99"', "measure 99 is not on its net element"),
        (RAILML_3, "<topology>", "<topology2>", "is not XML"),
    ],
)
def test_railml_that_is_damaged_or_dangling_is_refused_with_its_place(
    text, old, new, words, tmp_path
):
    assert old in text
    refused(InputError, words, railml, text.replace(old, new, 1), tmp_path)


def plain(name: str, *stations: tuple[str, float], gradient: float = 0.0) -> Line:
    places = tuple(Station(*each) for each in stations)
    limits, gradients = StepProfile([0.0], [30.0]), StepProfile([0.0], [gradient])
    return Line(name, stations[-1][1], places, limits, gradients)


def test_lines_join_where_they_share_stations_and_a_shared_track_counts_once():
    main = plain("main", ("A", 0.0), ("B", 4e3), ("C", 9e3))
    branch = plain("branch", ("A", 0.0), ("B", 4e3), ("D", 6e3))
    back = plain("short", ("C", 0.0), ("D", 3e3), gradient=0.01)
    network, notes = network_of_lines("all", [main, branch, back])
    edges = {edge.name: (edge.start, edge.end) for edge in network.edges}
    assert edges == {
        "main A - B": ("A", "B"), "main B - C": ("B", "C"), "branch B - D": ("B", "D"),
        "short": ("C", "D"),
    }  # fmt: skip
    assert "'branch A - B' is the track of 'main A - B', which stays" in notes
    assert network.route("A", "D").length == pytest.approx(6e3)
    assert network.route("C", "D").line.gradient(100.0) == pytest.approx(0.01)


@needs_osrd
def test_a_planner_imports_a_network_shows_routes_and_exports_it(tmp_path, works):
    names = ("small_infra.network.json", "r.line.json", "s.geojson")
    net, route, places = (tmp_path / name for name in names)
    assert "signals: 106" in works("import", OSRD / "infras" / "small_infra.json", "-o", tmp_path)
    shown = works("show", net, "--json", "--picture", tmp_path / "s.png")
    assert (tmp_path / "s.png").stat().st_size > 10_000
    edges = {each["edge"]: each for each in json.loads(shown)["edges"]}
    assert edges["TA6"]["length_m"] == 10_000.0
    assert edges["TA6"]["rise_m"] == pytest.approx(4.2)
    words = ["North_East_station", "West_station"]
    where = f"{net}#{','.join(words)}"
    assert "45.800 km" in works("show", where)
    assert "45.800 km" in works("new", "line", "--from", where, "-o", route)
    assert read_line(route) == read_network(net).route(*words).line
    assert read_line(where).legs == read_line(route).legs
    assert "left out without coordinates: edge 'TA3'" in works("convert", net, "-o", places)
    features = json.loads(places.read_text())["features"]
    kinds = [each["properties"]["kind"] for each in features]
    assert kinds.count("node") == len(read_network(net).nodes)
    for each in features:
        points = each["geometry"]["coordinates"]
        for x, y in points if each["geometry"]["type"] == "LineString" else [points]:
            assert -0.5 < x < 0.5
            assert 49.0 < y < 50.0


def test_the_same_track_in_two_files_keeps_the_limits_of_both_directions():
    """As an operator has them: one file a direction, whose limits differ."""
    main = plain("there", ("A", 0.0), ("B", 4e3), ("C", 9e3), gradient=0.004)
    own = StepProfile([0.0, 1e3], [30.0, 20.0])
    back = replace(main.reversed(), name="back", speed_limits=own)
    # Measured anew, 3 m longer.
    back = replace(back, length=9_003.0, stations=(*back.stations[:-1], Station("A", 9_003.0)))
    network, notes = network_of_lines("both", [main, back])
    notes = [note for note in notes if "takes over" in note]
    # From B to A `back` has 20 m/s all along, from C to B 30 m/s over its first kilometre.
    assert len(notes) == len(network.edges) == 2
    assert "its speed limits for the other direction" in notes[0]
    there, again = (network.route(*ends).line for ends in (("A", "C"), ("C", "A")))
    assert there.speed_limit([100.0, 8_500.0]).tolist() == [30.0, 30.0]
    assert again.speed_limit([100.0, 990.0, 1_010.0, 8_900.0]).tolist() == [30.0, 30.0, 20.0, 20.0]
    # The same limits in both files are one profile; those that are assumed, or that the first
    # file states otherwise itself, are not taken over.
    alike = replace(main.reversed(), name="back")
    own_way = replace(main, speed_limits_reverse=StepProfile([0.0], [10.0]))
    for first, second, limit, words in (
        (main, alike, None, "stays"),
        (main, replace(back, assumed=("speed_limits",)), None, "stays"),
        (own_way, back, 10.0, "with its own speed limits of the other direction, which differ"),
        (main, replace(main, name="again", speed_limits=own), None, "are not used"),
    ):
        network, notes = network_of_lines("both", [first, second])
        limits = [edge.line.speed_limits_reverse for edge in network.edges]
        assert [None if x is None else x.values.tolist() for x in limits] == [
            None if limit is None else [limit]
        ] * 2
        assert any(note.endswith(words) for note in notes)


def test_a_network_without_coordinates_is_not_exported(tmp_path):
    network, _ = network_of_lines("one", [plain("a", ("A", 0.0), ("B", 1e3))])
    refused(InputError, "has coordinates", export_network, network, tmp_path / "a.geojson")
    write_network(network, tmp_path / "a.network.json")
    assert list(tmp_path.iterdir()) == [tmp_path / "a.network.json"]


@needs_osrd
def test_track_without_gradients_is_level_as_a_fact_where_that_is_stated(tmp_path):
    source = OSRD / "infras" / "overlapping_routes.json"
    for name in ("assumed", "known"):
        (tmp_path / name).mkdir()
    (assumed,) = import_file(source, tmp_path / "assumed")
    (known,) = import_file(source, tmp_path / "known", ImportOptions(gradients_known=True))
    (words,) = [each for each in assumed.assumed if each.startswith("level where")]
    assert known.assumed == [each for each in assumed.assumed if each != words]
    before, after = read_network(assumed.path), read_network(known.path)
    assert "gradients" in before.assumed
    assert "gradients" not in after.assumed
    assert not any(each.line.gradients.values.any() for each in after.edges)


def test_a_switch_type_of_the_file_states_which_ports_connect(tmp_path):
    kind = {
        "id": "odd",
        "ports": ["A", "B1", "B2"],
        "groups": {"one": [{"src": "B1", "dst": "B2"}], "two": [{"src": "A", "dst": "B1"}]},
    }
    odd = BRANCH | {"switch_type": "odd"}
    (network,), *_ = read_small(tmp_path, switches=[odd], extended_switch_types=[kind])
    assert network.route("b@0.4", "c@0.5").length == pytest.approx(900.0)
    refused(InputError, "no route", network.route, "a@0.4", "c@0.5")


def test_gradients_that_contradict_each_other_are_counted_and_the_later_holds(tmp_path):
    slopes = [
        {"gradient": 5.0, "begin": 0.0, "end": 600.0},
        {"gradient": -2.0, "begin": 500.0, "end": 1200.0},
    ]
    tracks = [TRACKS[0] | {"slopes": slopes}, *TRACKS[1:]]
    (network,), left_out, assumed = read_small(tmp_path, track_sections=tracks)
    line = network.edge("a").line
    assert line.gradient([250.0, 550.0, 900.0]).tolist() == [0.005, -0.002, -0.002]
    assert "tracks with gradients that contradict each other, the later taken: 1" in assumed
    assert "gradients that reach beyond their track, cut off there: 1" in left_out
