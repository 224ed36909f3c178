"""Recordings matched to their routes in networks, by errors that the matcher does not assume."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from ingest_logs import plain_profile
from refusals import refused
from route_networks import (
    GPX,
    PHONE,
    UBLOX,
    Received,
    balloon,
    bezier,
    doubled,
    drive,
    motion,
    network_of,
    profile_for,
    straight,
    write_csv,
    write_gpx,
    wye,
    y_junction,
)

from trainlog import InputError, LineReference, Network, Station, Trip, report_of, write_network
from trainlog.formats.imports import networks_in
from trainlog.formats.railway import line_of
from trainlog.ingest import Profile, ingest, ingest_each
from trainlog.ingest.live import LiveIngest, LiveOptions
from trainlog.ingest.pipeline import Given
from trainlog.ingest.routes import NetworkRoutes

BEGUN = pd.Timestamp("2026-05-01T06:00:00", tz="UTC")
Y, WYE, BALLOON = y_junction(), wye(), balloon()
RATE_2 = replace(UBLOX, rate=2.0)


def ingested(
    folder: Path, fixes: Received, network: Network, metadata: dict[str, str] | None = None
) -> Trip:
    file = write_csv(folder / "run.csv", fixes)
    return ingest(file, profile_for(fixes), network=network, metadata=metadata)


def legs_of(trip: Trip) -> list[tuple[str, bool]]:
    return [(leg.edge, leg.forward) for leg in line_of(trip).legs]


def errors(trip: Trip, fixes: Received) -> np.ndarray:
    """Distances [m] between the estimated and the true position."""
    estimate = trip["/estimates/state"]
    seconds = (estimate.index - BEGUN).total_seconds().to_numpy()
    true = np.interp(seconds, fixes.seconds, fixes.true_position)
    return np.abs(estimate["position"].to_numpy() - true)


ROUTES = [
    (Y, ("A", "B")),
    (Y, ("C", "A")),
    (Y, ("D", "E", "B")),
    (WYE, ("A", "C")),
    (WYE, ("B", "C")),
    (BALLOON, ("A", "loop@2.0", "A")),
]


@pytest.mark.parametrize(
    ("network", "places", "receiver"),
    [
        pytest.param(*route, receiver, id=f"{' - '.join(route[1])}, {name}")
        for number, route in enumerate(ROUTES)
        for name, receiver in (("ublox", RATE_2), (("gpx", GPX), ("phone", PHONE))[number % 2])
    ],
)
def test_the_route_is_found_and_its_chainage(tmp_path, network, places, receiver):
    route = network.route(*places)
    fixes = drive(route, receiver, np.random.default_rng([7, len(route.legs)]))
    if receiver is GPX:
        trip = ingest(write_gpx(tmp_path / "run.gpx", fixes), network=network)
    else:
        trip = ingested(tmp_path, fixes, network)
    assert legs_of(trip) == [(leg.edge, leg.forward) for leg in route.legs]
    assert trip.metadata["line"] == line_of(trip).name == f"{places[0]} - {places[-1]}"
    assert trip.metadata["network"] == network.name
    assert trip.metadata["direction"] == "forward"
    assert "better than the second-best" in trip.metadata["route_evidence"]
    found = errors(trip, fixes)
    assert np.median(found) < 12.0
    assert np.quantile(found, 0.95) < 40.0


def test_lines_too_close_to_tell_apart_are_refused_with_the_margin(tmp_path):
    network = doubled(4.0)
    fixes = drive(network.route("A", "D"), GPX, np.random.default_rng(5))
    said = "do not determine the route.*(main.*relief|relief.*main)"
    caught = refused(InputError, said, ingested, tmp_path, fixes, network)
    margin = re.search(r"log-likelihood of ([\d.]+) better", caught.problem)
    assert float(margin[1]) < 6.0
    trip = ingested(tmp_path, fixes, network, {"stations": "A,relief@3,D"})
    assert [edge for edge, _ in legs_of(trip)] == ["west", "relief", "east"]
    assert trip.metadata["route_evidence"] == "stated: A, relief@3, D"


@pytest.mark.parametrize("edge", ["main", "relief"])
def test_lines_20_m_apart_are_told_apart(tmp_path, edge):
    network = doubled(20.0)
    fixes = drive(network.route("A", f"{edge}@3", "D"), RATE_2, np.random.default_rng(2))
    trip = ingested(tmp_path, fixes, network)
    assert [name for name, _ in legs_of(trip)] == ["west", edge, "east"]


def test_a_loop_in_a_tunnel_is_not_guessed(tmp_path):
    route = BALLOON.route("A", "loop@2.0", "A")
    loop = (route.legs[1].position - 5.0, route.legs[1].end + 5.0)
    fixes = drive(route, RATE_2, np.random.default_rng(1), tunnels=[loop])
    with pytest.raises(InputError, match=r"do not determine the route.*loop \(against\)"):
        ingested(tmp_path, fixes, BALLOON)


def test_a_trip_that_turns_back_becomes_two(tmp_path):
    route = Y.route("A", "B", "A")
    whole = route.length
    fixes = drive(route, RATE_2, np.random.default_rng(3), stops=(40.0, whole / 2, whole - 40.0))
    file = write_csv(tmp_path / "day.csv", fixes)
    there, back = ingest_each(file, profile_for(fixes), network=Y)
    assert (there.name, back.name) == ("day-01", "day-02")
    assert legs_of(there) == [("stem", True), ("left", True)]
    assert legs_of(back) == [("left", False), ("stem", False)]
    assert abs(there.start - BEGUN) < pd.Timedelta(seconds=60)
    assert (back.start - there["/gnss/fix"].index[-1]).total_seconds() < 5.0


def test_what_lies_off_the_network_is_left_out_and_counted(tmp_path):
    """From a depot 4 km away, by a line that the network has not."""
    whole = network_of(
        [
            ("depot", "X", "A", straight(-4000 + 3000j, 0)),
            *((e.name, e.start, e.end, straight(0, 5000)) for e in Y.edges[:1]),
        ],
        "XAJ",
    )
    fixes = drive(whole.route("X", "J"), RATE_2, np.random.default_rng(4))
    trip = ingested(tmp_path, fixes, Y)
    assert legs_of(trip) == [("stem", True)]
    assert any("off the network" in line for line in report_of(trip).lines())
    assert trip.start - BEGUN > pd.Timedelta(minutes=2)


def test_fixes_elsewhere_too_few_live_or_without_geometries_are_refused(tmp_path):
    fixes = drive(Y.route("A", "B"), GPX, np.random.default_rng(6))
    away = replace(fixes, points=fixes.points + 40_000j)
    refused(InputError, "lie more than 150 m from network 'drawn'", ingested, tmp_path, away, Y)
    few = np.where(np.arange(fixes.points.size) % 250 == 0, fixes.points, np.nan)
    refused(InputError, "too few fixes", ingested, tmp_path, replace(fixes, points=few), Y)
    said = r"no edge of network 'drawn' has a geometry.*--stations"
    refused(InputError, said, ingested, tmp_path, fixes, without_course(Y))
    given, options = Given(network=NetworkRoutes(Y)), LiveOptions()
    said = "found when a trip is over"
    refused(InputError, said, LiveIngest.begun, tmp_path / "x.mcap", given, options)


def test_a_way_that_the_turns_forbid_is_refused(tmp_path):
    open_turns = replace(Y, turns={"J": (("stem", "left"), ("stem", "right"), ("left", "right"))})
    fixes = drive(open_turns.route("B", "J", "C"), GPX, np.random.default_rng(8))
    with pytest.raises(InputError, match=r"follow a route that its turns allow|no trip"):
        list(ingest_each(write_gpx(tmp_path / "b.gpx", fixes), network=Y))


CHAIN = network_of(
    [
        ("west", "A", "P", straight(-5_000, 0)),
        ("bend", "P", "Q", bezier(0, 2_500, 3_000 + 500j, 3_000 + 3_000j)),
        ("north", "Q", "B", straight(3_000 + 3_000j, 3_000 + 9_000j)),
    ],
    "AB",
)
"""Three edges one behind the other, of which the middle is a bend."""


def without_course(network: Network, *names: str, longer: float = 1.0) -> Network:
    """The network without the course of some edges, or of all; these so many times as long."""
    edges = []
    for each in network.edges:
        line = each.line
        if not names or each.name in names:
            stations = tuple(replace(s, position=longer * s.position) for s in line.stations)
            line = replace(line, geometry=None, length=longer * line.length, stations=stations)
        edges.append(replace(each, line=line))
    return replace(network, edges=tuple(edges))


@pytest.mark.parametrize("places", [("A", "B"), ("B", "A")])
def test_an_edge_without_a_course_is_passed_where_the_distance_driven_is_its_length(
    tmp_path, places
):
    route = CHAIN.route(*places)
    fixes = drive(route, RATE_2, np.random.default_rng([11, len(places[0])]))
    trip = ingested(tmp_path, fixes, without_course(CHAIN, "bend"))
    assert legs_of(trip) == [(leg.edge, leg.forward) for leg in route.legs]
    assert re.search(
        r"over bend.* without a geometry by the distance driven", trip.metadata["route_evidence"]
    )
    course = line_of(trip).geometry
    assert "straight over bend, of which none is known" in course.quality
    # The fixes there are not taken for ones on the chord, some 500 m beside the bend.
    (words,) = [each for each in trip.metadata if "of fixes on bend" in each]
    assert int(trip.metadata[words]) > 50
    found = errors(trip, fixes)
    assert np.median(found) < 12.0
    assert np.quantile(found, 0.95) < 60.0


def test_an_edge_without_a_course_is_refused_where_the_distance_is_another_or_unknown(tmp_path):
    route = CHAIN.route("A", "B")
    fixes = drive(route, RATE_2, np.random.default_rng(12))
    with pytest.raises(InputError, match=r"bend without a geometry.* by its speed the train drove"):
        ingested(tmp_path, fixes, without_course(CHAIN, "bend", longer=1.06))
    unknown = drive(route, replace(RATE_2, speed=None), np.random.default_rng(12))
    with pytest.raises(InputError, match="no speed shows how far it drove there"):
        ingested(tmp_path, unknown, without_course(CHAIN, "bend"))


@pytest.mark.parametrize("back", [False, True])
def test_distances_between_stops_show_the_route_of_an_imported_network_without_courses(
    tmp_path, back
):
    """OSRD's network has five tracks between its stations; two of them are as long."""
    path = Path(__file__).parents[1] / ".." / "shared" / "data" / "osrd" / "infras"
    if not path.is_dir():
        pytest.skip("needs ../shared/data/osrd")
    infra = networks_in(path / "small_infra.json")
    network = without_course(infra.networks[0])
    places = ["West_station", "Mid_West_station", "Mid_East_station", "North_East_station"]
    places = places[::-1] if back else places
    route = network.route(*places)
    stops = [station.position for station in route.line.stations if station.name in places]
    file, _ = write_odometer(tmp_path / "run.csv", stops)
    # Parallel tracks of stations are as long: stops alone do not show which was driven.
    with pytest.raises(InputError, match=r"do not determine the route.*--stations A,B"):
        ingest(file, odometer_profile(), network=network)
    trip = ingest(
        file, odometer_profile(), network=network, metadata={"stations": ",".join(places)}
    )
    assert line_of(trip).legs == route.legs
    # On a network of one of them each, they do.
    single = _of_edges(network, {leg.edge for leg in route.legs})
    trip = ingest(file, odometer_profile(), network=single)
    assert [leg.edge for leg in line_of(trip).legs] == [leg.edge for leg in route.legs]
    assert "4 of 4 stops" in trip.metadata["route_evidence"]


def _of_edges(network: Network, names: set[str]) -> Network:
    """The part of a network that some edges are."""
    edges = tuple(each for each in network.edges if each.name in names)
    ends = {name for each in edges for name in (each.start, each.end)}
    nodes = tuple(node for node in network.nodes if node.name in ends)
    turns = {
        node: tuple(p for p in network.turns.get(node, ()) if set(p) <= names) for node in ends
    }
    turns = {node: pairs for node, pairs in turns.items() if pairs}
    return replace(network, edges=edges, nodes=nodes, turns=turns)


def test_the_command_takes_a_network_as_such_or_as_a_line(tmp_path, shell, works):
    network = tmp_path / "y.network.json"
    write_network(Y, network)
    fixes = drive(Y.route("A", "C"), GPX, np.random.default_rng(1))
    words = ("ingest", write_gpx(tmp_path / "run.gpx", fixes))
    for option in ("--network", "--line"):
        shown = works(*words, option, network, "-o", tmp_path / option[2:])
        assert "route A - C: fixes (" in shown
    both = ("--network", network, "--reverse", "-o", tmp_path / "x")
    code, _, shown = shell(*words, *both)
    assert code == 2
    assert "a network and a direction are given" in shown


def with_stations(network: Network, places: dict[str, list[tuple[str, float]]]) -> Network:
    edges = []
    for each in network.edges:
        more = [Station(*place) for place in places.get(each.name, ())]
        known = sorted((*each.line.stations, *more), key=lambda station: station.position)
        edges.append(replace(each, line=replace(each.line, stations=tuple(known))))
    return replace(network, edges=tuple(edges))


INNER = {
    "stem": [("A1", 1_400.0), ("A2", 3_700.0)],
    "left": [("B1", 1_900.0)],
    "right": [("C1", 2_600.0)],
}


def write_odometer(
    path: Path, stops: list[float], more: Callable[[np.ndarray], dict[str, object]] | None = None
) -> tuple[Path, np.ndarray]:
    """A table of time, position and speed, the counter 0.4 per cent off; the true positions."""
    seconds, position, speed = motion(stops, np.random.default_rng(9), 2.0)
    time = BEGUN + pd.to_timedelta(seconds, unit="s")
    columns: dict[str, object] = {
        "time": time.strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
        "position": 1.004 * (position - position[0]),
        "speed": speed,
    }
    pd.DataFrame(columns | (more(position) if more else {})).to_csv(path, index=False)
    return path, position


def odometer_profile(**columns: str) -> Profile:
    mapped = {
        f"/train/state.{name}": {"column": name, "unit": unit}
        for name, unit in (("position", "m"), ("speed", "m/s"))
    }
    return plain_profile(time={"column": "time"}, columns=mapped, trip={"columns": columns})


def test_without_fixes_the_distances_between_stops_show_the_route(tmp_path):
    network = with_stations(Y, INNER)
    route = network.route("A", "C")
    stops = [0.0, 1_400.0, 3_700.0, 5_000.0 + 2_600.0, route.length]
    file, position = write_odometer(tmp_path / "run.csv", stops)
    trip = ingest(file, odometer_profile(), network=network)
    assert legs_of(trip) == [("stem", True), ("right", True)]
    assert "5 of 5 stops" in trip.metadata["route_evidence"]
    assert np.abs(trip["/train/state"]["position"].to_numpy() - position).max() < 60.0
    file, _ = write_odometer(tmp_path / "two.csv", [0.0, route.length])
    refused(InputError, "2 stops show no route", ingest, file, odometer_profile(), network=network)
    file, _ = write_odometer(tmp_path / "other.csv", [0.0, 2_000.0, 5_200.0, 5_800.0])
    with pytest.raises(InputError, match="no stations of network 'drawn' lie as far apart"):
        ingest(file, odometer_profile(), network=network)


def test_stops_that_two_routes_have_are_not_guessed(tmp_path):
    """Stations lie alike on both lines behind the junction."""
    alike = {"stem": INNER["stem"], "left": [("B1", 1_900.0)], "right": [("C1", 1_920.0)]}
    network = with_stations(Y, alike)
    file, _ = write_odometer(tmp_path / "run.csv", [0.0, 1_400.0, 3_700.0, 5_000.0 + 1_910.0])
    with pytest.raises(InputError, match=r"do not determine the route.*6 is needed"):
        ingest(file, odometer_profile(), network=network)


def test_kilometres_of_numbered_lines_show_the_route(tmp_path):
    """Line 850 counts up, line 851 down from the junction: the kilometre jumps there."""
    length = Y.edge("left").line.length
    known = {
        "stem": LineReference("850", [0.0], [12_000.0], [17_000.0]),
        "left": LineReference("851", [0.0], [61_000.0], [61_000.0 - length]),
        "right": LineReference("852", [0.0], [0.0], [Y.edge("right").line.length]),
    }
    edges = tuple(
        replace(e, line=replace(e.line, reference=known.get(e.name), geometry=None))
        for e in Y.edges
    )
    network = replace(Y, edges=edges)

    def cells(position: np.ndarray) -> dict[str, object]:
        behind = position > 5_000.0
        return {
            "position": np.where(behind, 66_000.0 - position, 12_000.0 + position).round(-1),
            "line": np.where(behind, "851", "850"),
        }

    stops = [300.0, 3_000.0, 5_000.0 + length - 200.0]
    file, position = write_odometer(tmp_path / "run.csv", stops, cells)
    trip = ingest(file, odometer_profile(line="line"), network=network)
    assert legs_of(trip) == [("stem", True), ("left", True)]
    assert "kilometres of 2 line(s)" in trip.metadata["route_evidence"]
    assert np.nanmax(np.abs(trip["/train/state"]["position"].to_numpy() - position)) < 30.0

    def unknown(position: np.ndarray) -> dict[str, object]:
        return {"position": 12_000.0 + position, "line": np.full(position.size, "777")}

    file, _ = write_odometer(tmp_path / "no.csv", stops, unknown)
    with pytest.raises(InputError, match="has no line '777'"):
        ingest(file, odometer_profile(line="line"), network=network)


def test_a_column_of_stations_states_the_route(tmp_path):
    network = with_stations(Y, INNER)

    def cells(position: np.ndarray) -> dict[str, object]:
        names = np.array(["A", "", "A2", "C"])
        return {"stop": names[np.searchsorted([100.0, 3_700.0, 9_000.0], position)]}

    length = network.route("A", "C").length
    file, _ = write_odometer(tmp_path / "run.csv", [0.0, 3_700.0, length], cells)
    trip = ingest(file, odometer_profile(stations="stop"), network=network)
    assert legs_of(trip) == [("stem", True), ("right", True)]
    assert trip.metadata["route_evidence"] == "stated: A, A2, C"
    bare = odometer_profile()
    file, _ = write_odometer(tmp_path / "moving.csv", [0.0, 3_700.0, length])
    table = pd.read_csv(file)
    table[table["speed"] > 5.0].to_csv(file, index=False)
    refused(InputError, r"nothing shows its route.*no fixes", ingest, file, bare, network=network)
