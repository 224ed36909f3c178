"""Networks and their routes: a route's line is what its edges are at each position."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from format_examples import assert_same, lines
from hypothesis import HealthCheck, Phase, given, settings, strategies as st
from refusals import refused

import trainlog
from analysis.fleet.analyses import adhesion
from analysis.network.edges import edge_line, trips_on_edges
from analysis.view import TripView
from trainlog import (
    CurvatureProfile,
    Edge,
    Geometry,
    InputError,
    Leg,
    Line,
    LineReference,
    Network,
    Node,
    Station,
    StepProfile,
    read_line,
    read_network,
    sample,
    write_line,
    write_network,
)
from trainlog.formats.declared import thing_to_bytes
from trainlog.formats.railway import line_of, line_to_bytes, network_from_bytes
from trainlog.railway import Survey

WHOLE = read_line(sample("CH_StGallen_Wil.line.json"))
CASES = settings(
    max_examples=6,
    # Networks of any lines are large: to look for the smallest takes minutes.
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)


def edge(
    name: str, start: str, end: str, length: float = 1e3, gradient: float = 0.0, **others: Any
) -> Edge:
    limits = StepProfile([0.0], [20.0 + 100.0 * abs(gradient)])
    line = Line(name, length, (), limits, StepProfile([0.0], [gradient]), **others)
    return Edge(name, line, start, end)


def y_network(turns: dict[str, tuple[tuple[str, str], ...]] | None = None) -> Network:
    """A trunk from A to the junction J, and two branches to B and C."""
    edges = (
        edge("trunk", "A", "J", 3_000.0, gradient=0.01),
        edge("to B", "J", "B", 2_000.0, gradient=0.02),
        edge("to C", "C", "J", 1_000.0, gradient=-0.005),
    )
    return Network("Y", (*map(Node, "ABC"), Node("J", "junction")), edges, turns or {})


@st.composite
def networks(draw: Callable[..., Any]) -> Network:
    """Connected networks of any lines, with loops and several edges between the same nodes."""
    count = draw(st.integers(2, 4))
    names = [f"n{number}" for number in range(count)]
    pairs = [(names[draw(st.integers(0, i - 1))], names[i]) for i in range(1, count)]
    one = st.sampled_from(names)
    pairs += draw(st.lists(st.tuples(one, one), max_size=2))
    kinds = st.sampled_from(["station", "junction"])
    edges = []
    for number, (start, end) in enumerate(pairs):
        line = draw(lines())
        stop = Station(f"stop {number}", line.length * draw(st.floats(0.3, 0.7)))
        line = replace(line, stations=(stop,), tunnels=line.tunnels[:1])
        edges.append(Edge(f"e{number}", line, start, end))
    return Network("any", tuple(Node(name, draw(kinds)) for name in names), tuple(edges))


@st.composite
def routes(draw: Callable[..., Any]) -> trainlog.Route:
    network = draw(networks())
    stops = [each.line.stations[0].name for each in network.edges]
    place = st.sampled_from([*(node.name for node in network.nodes), *stops])
    several = st.lists(place, min_size=2, max_size=4)
    places = draw(several.filter(lambda names: all(a != b for a, b in pairwise(names))))
    try:
        return network.route(*places)
    except InputError:  # only junctions on the way, where trains do not turn back
        return network.route("n0", "n1")


def inside(leg: Leg, edge_line: Line, line: Line) -> np.ndarray:
    """Positions on a leg that are well off everything that begins or ends."""
    share = np.linspace(0.003, 0.997, 61)
    found = leg.position + leg.length * share
    marks = np.concatenate((line.breakpoints, leg.on_line(edge_line.breakpoints)))
    apart = np.min(np.abs(found[:, None] - marks[None, :]), axis=1)
    return found[apart > 1e-4]


@given(routes())
@CASES
def test_a_route_has_the_values_of_its_edges_at_every_position(route):
    line = route.line
    for leg in line.legs:
        own = route.network.edge(leg.edge).line
        sign = 1.0 if leg.forward else -1.0
        at = inside(leg, own, line)
        there = leg.on_edge(at)
        np.testing.assert_allclose(leg.on_line(there), at, rtol=0.0, atol=1e-6)
        limits = own.speed_limits if leg.forward else own.limits_against
        np.testing.assert_array_equal(line.speed_limit(at), limits(there))
        against = own.limits_against if leg.forward else own.speed_limits
        marks = np.concatenate((line.limits_against.positions, leg.on_line(against.positions)))
        off = np.min(np.abs(at[:, None] - marks[None, :]), axis=1) > 1e-4
        np.testing.assert_array_equal(line.limits_against(at[off]), against(there[off]))
        np.testing.assert_array_equal(line.gradient(at), sign * own.gradient(there))
        np.testing.assert_array_equal(
            line.tunnel_cross_section(at), own.tunnel_cross_section(there)
        )
        bends = sign * own.curvature(there)
        np.testing.assert_allclose(line.curvature(at), bends, rtol=1e-5, atol=1e-9)
        if line.reference is not None and own.reference is not None:
            known = own.kilometre(there)
            np.testing.assert_allclose(line.kilometre(at), known, rtol=1e-6, atol=1e-1)
        if at.size > 1:
            ends = np.sort(leg.on_edge([at[0], at[-1]]))
            whole = own.gradients.mean(ends[:1], ends[1:])
            found = line.gradients.mean(at[:1], at[-1:])
            np.testing.assert_allclose(found, sign * whole, rtol=1e-6, atol=1e-9)
    assert line.length == pytest.approx(sum(leg.length for leg in line.legs))
    assert line.name == route.name
    assert line.stations[0].position == 0.0
    assert line.stations[-1].position == line.length


@given(routes())
@CASES
def test_a_reversed_route_is_the_reversed_line(route):
    back = route.reversed().line
    turned = replace(route.line.reversed(), name=back.name)
    # Tolerances of the comparison leave text and structure to be the same.
    assert [station.name for station in back.stations] == [each.name for each in turned.stations]
    assert [leg.edge for leg in back.legs] == [leg.edge for leg in turned.legs]
    for first, second in zip(back.legs, turned.legs, strict=True):
        assert first.edge_start == second.edge_start
        assert first.position == pytest.approx(second.position, abs=1e-6)
    at = np.linspace(0.0, back.length, 97)
    marks = np.concatenate((back.breakpoints, turned.breakpoints))
    at = at[np.min(np.abs(at[:, None] - marks[None, :]), axis=1) > 1e-4]
    np.testing.assert_array_equal(back.gradient(at), turned.gradient(at))
    np.testing.assert_array_equal(back.speed_limit(at), turned.speed_limit(at))
    np.testing.assert_allclose(back.curvature(at), turned.curvature(at), rtol=1e-5, atol=1e-9)
    # Edges need not agree on the altitude of their node: the first one counts.
    first = back.legs[0]
    own = route.network.edge(first.edge).line
    assert back.altitude == pytest.approx(float(own.altitudes(first.edge_start)), abs=1e-3)


@given(networks())
@CASES
def test_a_network_reads_back_as_it_was_written(network):
    again = network_from_bytes(thing_to_bytes(network))
    assert_same(again, network, 1e-13)
    assert thing_to_bytes(again) == thing_to_bytes(network_from_bytes(thing_to_bytes(again)))


def test_files_as_toml_and_with_lines_beside_them(tmp_path):
    network = Network("one", (Node("St. Gallen"), Node("Wil")), (
        Edge("own", WHOLE, "St. Gallen", "Wil"),))  # fmt: skip
    write_network(network, tmp_path / "one.network.toml")
    assert read_network(tmp_path / "one.network.toml") == network
    write_line(WHOLE, tmp_path / "whole.line.json")
    (tmp_path / "by hand.toml").write_text(
        'format = "trainlog/network"\nversion = 1\nname = "one"\n'
        '[nodes]\nunits = {latitude = "deg", longitude = "deg"}\n'
        'values = [["St. Gallen", "station", nan, nan], ["Wil", "station", 47.46, 9.04]]\n'
        '[[edges]]\nname = "own"\nstart = "St. Gallen"\nend = "Wil"\nfile = "whole.line.json"\n'
    )
    by_hand = read_network(tmp_path / "by hand.toml")
    assert by_hand.edges == network.edges
    assert by_hand.nodes[1].latitude == 47.46
    route = read_line(f"{tmp_path}/by hand.toml#Gossau SG,Wil")
    gossau = next(each for each in WHOLE.stations if each.name == "Gossau SG")
    assert route.length == WHOLE.length - gossau.position
    assert route.legs[0].edge_start == gossau.position
    with pytest.raises(InputError, match=r"absent\.toml"):
        read_line(f"{tmp_path}/absent.toml#Gossau SG,Wil")


def test_a_route_turns_back_at_stations_only():
    turns = {"J": (("trunk", "to B"), ("trunk", "to C"))}
    network = y_network(turns)
    refused(InputError, r"no route from 'B' to 'C'.*turn back", network.route, "B", "C")
    refused(InputError, "no route from 'J' to 'B'", network.route, "C", "J", "B")
    by_a = network.route("B", "A", "C")
    assert [leg.edge for leg in by_a.legs] == ["to B", "trunk", "trunk", "to C"]
    assert [leg.edge for leg in y_network().route("C", "J", "B").legs] == ["to C", "to B"]


def test_kilometres_survey_and_geometry_of_edges_are_kept():
    east = Geometry([0.0, 1_000.0], [47.0, 47.0], [9.0, 9.01], "surveyed")
    west = Geometry([0.0, 2_000.0], [47.0, 47.0], [9.01002, 9.03], "surveyed")
    down = LineReference("850", [0.0], [61_200.0], [60_200.0])
    network = Network("line", (Node("A"), Node("B"), Node("C")), (
        edge("1", "A", "B", geometry=east, reference=down, survey=Survey(1e-4, 500.0)),
        edge("2", "B", "C", 2_000.0, geometry=west, survey=Survey(3e-4, 200.0)),
    ))  # fmt: skip
    line = network.route("A", "C").line
    kilometres = line.kilometre([0.0, 1_000.0 - 1e-6, 1_500.0]).round(3)
    assert kilometres.tolist() == [61_200.0, 60_200.0, 500.0]
    assert line.survey == Survey(3e-4, 500.0)
    assert line.geometry.positions.tolist() == [0.0, 1_000.0, 3_000.0]
    assert line.geometry.longitudes[1] == pytest.approx(9.01001)
    bare = replace(network, edges=(network.edges[0], edge("2", "B", "C", survey=None)))
    assert bare.route("A", "C").line.geometry is None
    assert bare.route("A", "C").line.survey is None
    roeckl = CurvatureProfile([0.0], [1e-3], [1e-3])
    mixed = replace(network, edges=tuple(
        replace(each, line=replace(each.line, curvatures=roeckl, curve_resistance=formula))
        for each, formula in zip(network.edges, ("roeckl", "proportional"), strict=True)
    ))  # fmt: skip
    with pytest.raises(InputError, match="different curve resistances: 'roeckl' on '1'"):
        _ = mixed.route("A", "C").line


def test_a_section_of_a_route_keeps_what_its_legs_are():
    line = y_network().route("A", "B").line
    part = line.section(2_500.0, 4_000.0)
    assert [(leg.edge, leg.edge_start, leg.edge_end) for leg in part.legs] == [
        ("trunk", 2_500.0, 3_000.0),
        ("to B", 0.0, 1_000.0),
    ]
    assert part.legs[1].position == 500.0
    refused(InputError, "is not a part of it", line.section, 4_000.0, 6_000.0)


def test_what_no_network_can_be_is_listed_at_once():
    with pytest.raises(InputError) as caught:
        Network("bad", (Node("A"), Node("A"), Node("B"), Node("X"), Node("Y")), (
            edge("1", "A", "B"), edge("1", "A", "Bb"),
        ), {"B": (("1", "2"),), "C": ()})  # fmt: skip
    for error, node in (
        ("no such kind 'halt'; it is one of station, junction", {"kind": "halt"}),
        ("95 deg is not between -90 and 90 deg", {"latitude": 95.0, "longitude": 8.0}),
        (r"node 'Y' lies at latitude 47\.0 and longitude None", {"latitude": 47.0}),
    ):
        refused(InputError, error, Node, "Y", **node)
    words = str(caught.value)
    for part in (
        "2 nodes have the name 'A'",
        "2 edges have the name '1'",
        "has the end 'Bb', which is not a node; did you mean 'B'",
        "name the edge '2', which does not end there",
        "turns are given at 'C', which is not a node",
    ):
        assert part in words
    with pytest.raises(InputError, match=r"'X' \(1 node\) is not connected to the rest"):
        Network("bad", (Node("A"), Node("B"), Node("X")), (edge("1", "A", "B"),))
    turned = replace(WHOLE, stations=(Station("B", 0.0), Station("A", WHOLE.length)))
    with pytest.raises(InputError, match="exchange its start and end"):
        Network("bad", (Node("A"), Node("B")), (Edge("1", turned, "A", "B"),))
    route = y_network().route("A", "B").line
    with pytest.raises(InputError, match="is a route over 2 edges itself"):
        Network("bad", (Node("A"), Node("B")), (Edge("1", route, "A", "B"),))


def test_places_that_are_not_known_are_refused_with_those_that_are_like_them():
    network = y_network()
    refused(InputError, "has no place 'trunck'", network.route, "A", "trunck")
    refused(InputError, "'x' is not a kilometre", network.route, "A", "trunk@x")
    with pytest.raises(InputError, match=r"has no km 4; its kilometres are 0.000 to 3.000"):
        network.route("A", "trunk@4")
    refused(InputError, "needs two places", network.route, "A")
    named = Network(
        "named", (Node("West_station"), Node("East_station")),
        (Edge("1", WHOLE, "West_station", "East_station"),),
    )  # fmt: skip
    with pytest.raises(InputError, match="has no place 'West'; did you mean 'West_station'"):
        named.route("West", "East_station")


def test_a_route_over_given_edges():
    network = y_network()
    route = network.along([("to B", False), ("to C", False)], start=1_500.0, end=200.0)
    assert route.places == ("to B@1.500", "to C@0.200")
    assert [(leg.edge_start, leg.edge_end) for leg in route.legs] == [(1_500.0, 0.0), (1e3, 200.0)]
    assert network.along([("trunk", True), ("to B", True)]).legs == network.route("A", "B").legs
    # Ends of drawn networks are numpy's numbers.
    part = network.along([("trunk", True)], start=np.float64(0.0), end=np.float64(500.0))
    assert part.length == 500.0
    with pytest.raises(InputError, match="begins at 'J', and 'trunk' ends at 'A'"):
        network.along([("trunk", False), ("to B", True)])
    with pytest.raises(InputError, match="does not run along its chainage"):
        network.along([("trunk", True)], start=2_000.0, end=1_000.0)


def cut_network(west: Edge) -> Network:
    """The sample line's first 10 km, and an edge beyond."""
    nodes = Node("East"), Node("Mid", "junction"), Node("West")
    east = Edge("east", WHOLE.section(0.0, 10_000.0), "East", "Mid")
    return Network("cut", nodes, (east, west))


def test_evidence_counts_for_the_condition_of_each_edge(tmp_path):
    west = WHOLE.section(10_000.0, WHOLE.length)
    network = cut_network(Edge("west", west, "Mid", "West"))
    trip = trainlog.read(sample("stopping.mcap"))
    line = line_to_bytes(network.route("East", "West").line)
    trip = replace(trip, attachments={**trip.attachments, "line.json": line})
    metadata = trip.metadata | {"weather": "dry", "weather_by_edge": '{"east": "wet"}'}
    trainlog.write(replace(trip, metadata=metadata), tmp_path / "trip.mcap")
    rows = adhesion(TripView(trainlog.read(tmp_path / "trip.mcap")))
    assert dict(zip(rows["edge"], rows["layer"], strict=True)) == {"east": "wet", "west": "dry"}
    metadata["weather_by_edge"] = "wet"
    trainlog.write(replace(trip, metadata=metadata), tmp_path / "trip.mcap")
    with pytest.raises(InputError, match="is not a JSON object of rail conditions"):
        adhesion(TripView(trainlog.read(tmp_path / "trip.mcap")))


def test_a_trip_on_a_route_is_trips_on_its_edges(tmp_path):
    # The second edge is travelled against its chainage.
    west = WHOLE.section(10_000.0, WHOLE.length).reversed()
    network = cut_network(Edge("west", west, "West", "Mid"))
    route = network.route("East", "West").line
    trip = trainlog.read(sample("nonstop.mcap"))
    on_route = replace(trip, attachments={**trip.attachments, "line.json": line_to_bytes(route)})
    parts = trips_on_edges(on_route)
    assert [part.name for part in parts] == ["trip-01@east", "trip-01@west"]
    assert [part.metadata["direction"] for part in parts] == ["forward", "reverse"]
    rows = sum(len(part["/train/state"]) for part in parts)
    assert rows == len(trip["/train/state"])
    stated = on_route.metadata | {"weather": "dry", "weather_by_edge": '{"west": "wet"}'}
    apart = trips_on_edges(replace(on_route, metadata=stated))
    assert [part.metadata["weather"] for part in apart] == ["dry", "wet"]
    wrong = replace(on_route, metadata=stated | {"weather_by_edge": "wet"})
    refused(InputError, "is not a JSON object of rail conditions", trips_on_edges, wrong)
    for part, share in zip(parts, (0, 1), strict=True):
        state = part["/train/state"]
        at, line = state.position.to_numpy(), line_of(part)
        travelled = trip["/train/state"].position.loc[state.index].to_numpy()
        np.testing.assert_allclose(line.gradient(at), WHOLE.gradient(travelled), atol=2e-3)
        assert np.mean(line.gradient(at) == WHOLE.gradient(travelled)) > 0.99
        given = trips_on_edges(on_route, network)[share]
        assert line_of(given).gradients == network.edges[share].line.gradients or share
    leg = network.route("West", "Mid").line.section(2_000.0, 5_000.0)
    known = edge_line(leg, leg.legs[0])
    assert known.length == network.edges[1].line.length
    at = np.linspace(2_001.0, 4_999.0, 50)
    np.testing.assert_array_equal(known.gradient(at), network.edges[1].line.gradient(at))
    with pytest.raises(InputError, match=r"is 10000\.0 m long"):
        trips_on_edges(on_route, Network("other", network.nodes[:2], (
            Edge("east", WHOLE.section(0.0, 10_000.0), "East", "Mid"),
            Edge("west", WHOLE.section(0.0, 10_000.0), "East", "Mid"))))  # fmt: skip
