"""A drawn network, and a fleet on it: consistent, any trip on its own, faults in the physics."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import refused

import trainlog
from trainlog import Fleet, InputError, Network, draw_fleet, draw_network, write_fleet
from trainlog.formats.imports import networks_in
from trainlog.formats.railway import line_of, train_of
from trainlog.railway.geometry import plane_curve, to_plane
from trainlog.simulation import Fault, as_recorded, drive, recorded, write_trip
from trainlog.simulation.vehicles import draw_trains
from trainlog.units import DAY, NANOSECONDS
from trainlog.version import code_version_of


@pytest.fixture(scope="module")
def network() -> Network:
    return draw_network(seed=3, lines=10)


@pytest.fixture(scope="module")
def fleet(network: Network) -> Fleet:
    return draw_fleet(network, trains=6, days=4, trips=24, seed=5)


def test_altitude_and_place_of_a_node_are_the_same_by_every_line():
    drawn = draw_network(1)
    assert len(drawn.edges) == 10
    # As many lines as nodes or more: there is a loop.
    assert len(drawn.edges) >= len(drawn.nodes)
    nodes = {node.name: node for node in drawn.nodes}
    altitudes: dict[str, float] = {}
    for edge in drawn.edges:
        line = edge.line
        for name, position in ((edge.start, 0.0), (edge.end, line.length)):
            here = float(line.altitudes(position))
            assert here == pytest.approx(altitudes.setdefault(name, here), abs=1e-6)
            latitude, longitude = line.geometry.at(position)
            node = nodes[name]
            gap = abs(to_plane(latitude, longitude, (node.latitude, node.longitude)))
            assert gap < 0.5


def test_lines_are_plausible_and_their_curves_are_those_of_their_geometry(network):
    for edge in network.edges:
        line = edge.line
        assert np.max(np.abs(line.gradients.values)) <= 25e-3 + 1e-12
        for station in line.stations:
            assert abs(float(line.gradient(station.position - 1.0))) <= 2.5e-3 + 1e-9
        bend = np.maximum(np.abs(line.curvatures.start), np.abs(line.curvatures.end))
        assert np.max(bend) <= 1.0 / 250.0
        # 240 mm of cant and deficiency: 11.8 v²/R.
        grid = np.arange(0.0, line.length, 10.0)
        speeds = 3.6 * line.speed_limit(grid)
        assert np.all(11.8 * speeds**2 * np.abs(line.curvature(grid)) <= 245.0)
        # The course by the coordinates is the plane curve of the curvature.
        positions, points = plane_curve(line.curvatures, line.length)
        origin = (float(line.geometry.latitudes[0]), float(line.geometry.longitudes[0]))
        course = to_plane(*line.geometry.at(positions), origin)
        turned = course * np.exp(1j * np.angle(points[-1] / course[-1]))
        assert np.max(np.abs(turned - points)) < 1.5


def test_trains_start_where_they_ended_and_run_in_both_directions(fleet):
    last: dict[str, str] = {}
    ended: dict[str, int] = {}
    directions: dict[str, set[bool]] = {}
    for number in range(fleet.trips):
        name = fleet.train_of(number).name
        start, end = fleet.places(number)
        assert last.get(name, start) == start
        last[name] = end
        assert fleet.departure(number) >= ended.get(name, 0) + 40 * 60 * NANOSECONDS
        ended[name] = fleet.departure(number)
        line = fleet.route(start, end).line
        assert line.legs
        for leg in line.legs:
            directions.setdefault(leg.edge, set()).add(leg.forward)
    assert any(len(found) == 2 for found in directions.values())
    assert max(len(fleet.route(*fleet.places(n)).line.legs) for n in range(fleet.trips)) > 1


def test_two_trips_at_one_time_meet_the_same_rail_and_weather(fleet):
    start = fleet.departure(0)
    routes = [fleet.route(*fleet.places(number)).line for number in range(fleet.trips)]
    shared = [
        (one, other, a, b)
        for one in routes
        for other in routes
        if one.name != other.name
        for a in one.legs
        for b in other.legs
        if a.edge == b.edge and a.forward != b.forward
    ]
    one, other, a, b = shared[0]
    low = max(min(a.edge_start, a.edge_end), min(b.edge_start, b.edge_end)) + 10.0
    high = min(max(a.edge_start, a.edge_end), max(b.edge_start, b.edge_end)) - 10.0
    # Not at the very edges of its pieces of 10 m, where the side decides.
    places = 10.0 * np.arange(np.ceil(low / 10.0), np.floor(high / 10.0)) + 3.3
    first, second = (fleet._met(line, start)[1] for line in (one, other))
    assert first(a.on_line(places)) == pytest.approx(second(b.on_line(places)), abs=1e-12)
    later = fleet._met(one, start + DAY)[1]
    assert np.any(np.abs(later(a.on_line(places)) - first(a.on_line(places))) > 1e-3)


def test_any_trip_alone_is_the_same_as_in_the_fleet(tmp_path):
    fleet = draw_fleet(draw_network(seed=3, lines=4), trains=3, days=2, trips=2, seed=5)
    made = write_fleet(fleet, tmp_path / "all", jobs=2)
    assert (made.made, made.stuck) == (2, [])
    alone = draw_fleet(draw_network(seed=3, lines=4), trains=3, days=2, trips=2, seed=5)
    (tmp_path / "alone" / alone.train_of(1).name).mkdir(parents=True)
    one = write_trip(alone, 1, tmp_path / "alone")
    place = Path(alone.train_of(1).name) / f"{one.name}.mcap"
    assert (tmp_path / "alone" / place).read_bytes() == (tmp_path / "all" / place).read_bytes()
    code = code_version_of("trainlog.simulation.fleet")
    stated = json.loads((tmp_path / "all" / "fleet.json").read_text("utf-8"))
    assert (stated["software"], stated["code"]) == (f"trainlog {trainlog.__version__}", [code])
    # What was lost is made again, and nothing else; by other code than the rest, which is stated.
    stated["code"] = ["0123456789abcdef"]
    (tmp_path / "all" / "fleet.json").write_text(json.dumps(stated), "utf-8")
    before = (tmp_path / "all" / place).read_bytes()
    (tmp_path / "all" / place).unlink()
    again = write_fleet(fleet, tmp_path / "all", jobs=1)
    assert (again.made, again.kept) == (1, 1)
    assert again.codes == ("0123456789abcdef", code)
    stated = json.loads((tmp_path / "all" / "fleet.json").read_text("utf-8"))
    assert stated["code"] == list(again.codes)
    assert (tmp_path / "all" / place).read_bytes() == before
    with pytest.raises(InputError, match="another fleet"):
        write_fleet(draw_fleet(fleet.network, trains=3, days=2, trips=1, seed=5), tmp_path / "all")
    for log in sorted((tmp_path / "all").glob("*-0*/*.mcap")):
        _check_log(trainlog.read(log), fleet)


def _check_log(trip: trainlog.Trip, fleet: Fleet) -> None:
    """A trip arrives, under the limits, and its metadata do not give its truth away."""
    line = line_of(trip)
    truth = trip["/truth"]
    assert truth["position"].iloc[-1] == pytest.approx(line.length, abs=3.0)
    train = trip.metadata["train"]
    assert train == json.loads(trip.attachments["train.json"])["name"]
    assert trip.metadata["kind"] == train.rpartition("-")[0]
    limit = line.limits_over(train_of(trip).length)(truth["position"].to_numpy())
    assert np.all(truth["speed"].to_numpy() <= limit + 1.0)
    true = json.loads(trip.attachments["scenario.json"])
    hidden = {f"{true[name]:.6g}"[:6] for name in ("r0", "r1", "r2", "rotating_mass", "mass")}
    shown = json.dumps(dict(trip.metadata))
    assert not any(value in shown for value in hidden)
    assert {"r0", "mass", "head_wind", "faults", "wheel_factors"}.isdisjoint(trip.metadata)
    by_edge = json.loads(trip.metadata["weather_by_edge"])
    assert list(by_edge) == list(dict.fromkeys(leg.edge for leg in line.legs))
    assert trip.metadata["weather"] in by_edge.values()
    kinds = next(each for each in fleet.trains if each.name == train)
    assert ("/gnss/fix" in trip) == kinds.recorder.satellites
    assert ("/train/axles" in trip) == kinds.recorder.axles


def _simulated(fleet: Fleet, number: int) -> trainlog.Trip:
    scenario = fleet.scenario(number)
    return as_recorded(recorded(scenario, drive(scenario)), fleet.train_of(number))


def test_faults_show_in_the_physics_from_their_day_on_and_change_nothing_else(network):
    words = [
        "train=flirt-01,dragging-brake=2kN,from=2026-10-03",
        "train=flirt-01,mass=3t,from=2026-10-03",
        "train=flirt-01,wheel-diameter=1%,from=2026-10-03",
        "train=flirt-01,effort-gain=-5%,from=2026-10-03",
        "train=flirt-01,sensor-delay=0.4s,from=2026-10-03",
    ]
    sound = draw_fleet(network, trains=1, days=4, trips=8, seed=5)
    faulty = draw_fleet(
        network, trains=1, days=4, trips=8, seed=5, faults=[Fault.of(each) for each in words]
    )
    assert "flirt-01 dragging brake 2000 N from 2026-10-03" in repr(faulty)
    assert "flirt-01 effort gain -5 % from 2026-10-03" in repr(faulty)
    early = (sound.scenario(0), faulty.scenario(0))
    assert early[0].truth() == early[1].truth()
    number = 6
    before, after = (each.scenario(number) for each in (sound, faulty))
    assert before.maximum_adhesion == after.maximum_adhesion
    assert before.stops == after.stops
    assert before.habits == after.habits
    assert after.mass - before.mass == pytest.approx(3_000.0)
    assert after.resistance.r0 - before.resistance.r0 == pytest.approx(2_000.0, rel=0.1)
    ratios = np.divide(after.sensors.wheel_factors, before.sensors.wheel_factors)
    assert ratios == pytest.approx(1.01, abs=1e-9)

    # Recorded efforts: smaller by the gain, and later by the delay.
    trip = _simulated(faulty, number)
    true = trip["/truth"]
    speed = trip["/train/state"]["speed"].to_numpy()[::10][: len(true)]
    fast = true["speed"].to_numpy() > 15.0
    shown = np.median(speed[fast] / true["speed"].to_numpy()[fast])
    assert shown == pytest.approx(after.sensors.wheel_factors[0], abs=2e-3)
    silent = replace(after.sensors, effort_noise=0.0, effort_resolution=0.0)
    run = drive(after)
    late = recorded(replace(after, sensors=silent), run)["/train/controls"]["tractive_effort"]
    exact = run.samples[:, after.plant().columns.index("tractive_effort")]
    steps = round(10 * silent.effort_delay)
    assert abs(silent.effort_delay - steps / 10.0) < 0.06
    gain = silent.effort_gain
    expected = np.interp(run.seconds - silent.effort_delay, run.seconds, exact)
    assert late.to_numpy() == pytest.approx(gain * expected, abs=1.0)
    assert 0.9 < gain < 0.99


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("train=flirt-01,dragging-brake=2kN", "needs a train, one fault and from"),
        (
            "train=flirt-01,dragging-brake=2,from=2026-10-02",
            "dragging-brake '2' is not a valid force; write it as 2000N or 2kN",
        ),
        ("train=flirt-01,brake=2kN,from=2026-10-02", "'brake=2kN' is not understood"),
        ("train=flirt-01,mass=3t,mass=4t,from=2026-10-02", "given twice"),
        ("train=flirt-01,wheel-diameter=40%,from=2026-10-02", "not between"),
        ("train=flirt-01,sensor-delay=0.3s,from=October", "is not a date"),
        ("train=flirt-01,sensor-delay=-0.3s,from=2026-10-02", "negative"),
        ("train=flirt-01,sensor-delay=0.3s,from=2026-10-02,to=2026-10-02", "before it begins"),
        ("train=flirt-01,sensor-delay=0.3s,from=2026-10-02,share=0%", "on 0% of its trips"),
    ],
)
def test_a_fault_that_cannot_be_read_is_refused_with_the_reason(words, message):
    refused(InputError, message, Fault.of, words)


def test_a_fault_goes_again_and_shows_on_its_share_of_the_trips():
    words = "train=flirt-01,effort-gain=5%,from=2026-10-02,to=2026-10-05"
    healthy, sick, loose = (
        draw_trains(3, 1, [Fault.of(each)] if each else [])[0]
        for each in ("", words, f"{words},share=30%")
    )
    assert healthy.name == "flirt-01"
    times = [pd.Timestamp(2026, 10, day, hour).value for day in range(1, 8) for hour in range(24)]
    gains = np.array(
        [[each.at(time).effort_gain for time in times] for each in (healthy, sick, loose)]
    )
    there = (np.array(times) >= times[24]) & (np.array(times) < times[96])
    assert gains[1] == pytest.approx(gains[0] * np.where(there, 1.05, 1.0))
    shown = gains[2] > 1.01 * gains[0]
    assert not shown[~there].any()
    assert 0.15 < shown[there].mean() < 0.45
    assert [loose.at(time).effort_gain for time in times] == gains[2].tolist()


OSRD = Path(__file__).parents[1] / ".." / "shared" / "data" / "osrd" / "infras"


@pytest.mark.skipif(not OSRD.is_dir(), reason="needs ../shared/data/osrd")
@pytest.mark.parametrize("name", ["tiny_infra", "overlapping_routes"])
def test_a_fleet_runs_on_imported_networks(name):
    """Edges without stations, stations of several tracks, ways in one direction alone."""
    found = networks_in(OSRD / f"{name}.json")
    (network,) = found.networks
    drawn = draw_fleet(network, trains=3, days=1, trips=2, seed=3)
    for route in {route for roster in drawn.rosters for route in roster.routes}:
        assert network.route(*route).length > 0.0
    assert all((drawn.rail(edge.name).spots["length"] > 0.0).all() for edge in network.edges)
    trip = _simulated(drawn, 0)
    assert trip["/truth"]["position"].iloc[-1] > 1_000.0
