"""How often recordings with satellite fixes are matched to their routes in a network, and how well.

    python benchmarks/fleet/benchmark_routes.py [--trips 240] [--seed 1] [--workers 2]

Trips run over random routes of networks that are drawn (`draw_network`) and made to be difficult
(a junction with a bridge, a triangle, a balloon loop, lines 20 m apart). A receiver errs as no
matcher assumes (`tests/route_networks.py`): errors that wander, a datum shifted by 5 m, outliers,
reflections, frozen fixes, gaps, tunnels. It writes 10 Hz CSV, GPX of 1 Hz without speed, or a
phone's fixes every 11 s. A trip is *right* if every edge and direction is, *refused* if the program
says that the fixes do not determine them, *wrong* otherwise. Errors of chainage are the medians
over trips of each trip's median and 95 per cent quantile.

With ``--close``: lines 8 m apart, where refusing is right as well.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from route_networks import (
    GPX,
    PHONE,
    UBLOX,
    Received,
    Receiver,
    balloon,
    doubled,
    motion,
    profile_for,
    received,
    write_csv,
    write_gpx,
    wye,
    y_junction,
)

from trainlog.errors import TrainlogError
from trainlog.formats.railway import line_of
from trainlog.ingest.pipeline import Given, ingested
from trainlog.ingest.routes import NetworkRoutes
from trainlog.railway.geometry import to_plane
from trainlog.railway.network import Network, Route
from trainlog.simulation.network import draw_network
from trainlog.trip import Trip

KINDS = ("1 Hz GPX", "phone 11 s", "1 Hz GPX", "phone 11 s", "10 Hz CSV")
"""Receivers of the trips, in turn: those of 10 Hz take longest to simulate."""

RECEIVERS = {"10 Hz CSV": UBLOX, "1 Hz GPX": GPX, "phone 11 s": PHONE}
BEGUN = pd.Timestamp("2026-05-01T06:00:00", tz="UTC")


@cache
def networks(close: bool) -> dict[str, Network]:
    if close:
        return {"8 m apart": doubled(8.0), "4 m apart": doubled(4.0)}
    found = {f"drawn {seed}": draw_network(seed, 10) for seed in (1, 2, 3)}
    return found | {
        "junction": y_junction(),
        "triangle": wye(),
        "balloon": balloon(),
        "20 m apart": doubled(20.0),
    }


@cache
def routes_in(name: str, close: bool) -> NetworkRoutes:
    return NetworkRoutes(networks(close)[name])


@dataclass(frozen=True)
class Outcome:
    """What became of a trip."""

    network: str
    receiver: str
    state: str
    median: float
    high: float
    seconds: float
    recorded: float
    words: str


def random_route(network: Network, rng: np.random.Generator) -> Route:
    """Between two stations, sometimes by way of an edge that the shortest would not take."""
    every = network.places.items()
    stations = [name for name, points in every if any(each.station for each in points)]
    while True:
        if len(stations) < 2:
            places = [stations[0], f"{network.edges[-1].name}@1", stations[0]]
        else:
            places = [str(each) for each in rng.choice(stations, 2, replace=False)]
            if rng.random() < 0.4:
                edge = network.edges[int(rng.integers(len(network.edges)))]
                middle = float(edge.line.kilometre(0.5 * edge.line.length)) / 1e3
                places.insert(1, f"{edge.name}@{middle:.4f}")
        try:
            route = network.route(*places)
        except TrainlogError:
            continue
        turns = any(
            a.edge == b.edge and a.forward != b.forward
            for a, b in zip(route.legs[:-1], route.legs[1:], strict=True)
        )
        if not turns and 2_000.0 < route.length < 40_000.0 and route.line.geometry is not None:
            return route


def recorded(route: Route, receiver: Receiver, rng: np.random.Generator) -> Received:
    geometry = route.line.geometry
    origin = (float(geometry.latitudes.mean()), float(geometry.longitudes.mean()))
    points = to_plane(geometry.latitudes, geometry.longitudes, origin)
    length = route.length
    stops = [float(rng.uniform(20.0, 90.0)), *np.sort(rng.uniform(0.1, 0.9, 2)) * length]
    stops.append(length - float(rng.uniform(20.0, 90.0)))
    tunnels = []
    if rng.random() < 0.3:
        for _ in range(int(rng.integers(1, 3))):
            at = float(rng.uniform(0.1, 0.85)) * length
            tunnels.append((at, at + float(rng.uniform(200.0, 1_500.0))))
    drive = motion(stops, rng, receiver.rate)
    found = received((geometry.positions, points), drive, receiver, rng, tunnels)
    return replace(found, origin=origin)


def one(task: tuple[str, str, int, bool]) -> Outcome:
    name, kind, seed, close = task
    rng = np.random.default_rng([seed, len(name), sum(map(ord, name + kind))])
    network, receiver = networks(close)[name], RECEIVERS[kind]
    route = random_route(network, rng)
    fixes = recorded(route, receiver, rng)
    with tempfile.TemporaryDirectory() as folder:
        if kind.endswith("GPX"):
            file, profile = write_gpx(Path(folder) / "run.gpx", fixes), None
        else:
            file, profile = write_csv(Path(folder) / "run.csv", fixes), profile_for(fixes)
        begun = time.perf_counter()
        found = [each for _, each in ingested(file, Given(profile, network=routes_in(name, close)))]
        spent = time.perf_counter() - begun
    state, errors, words = judged(found, route, fixes)
    at = [float(np.quantile(errors, q)) if errors.size else np.nan for q in (0.5, 0.95)]
    return Outcome(name, kind, state, at[0], at[1], spent, float(fixes.seconds[-1]), words)


def judged(
    found: list[Trip | TrainlogError], route: Route, fixes: Received
) -> tuple[str, np.ndarray, str]:
    wanted = [(leg.edge, leg.forward) for leg in route.legs]
    if len(found) == 1 and isinstance(found[0], TrainlogError):
        words = found[0].problem
        return ("refused" if "do not determine" in words else "refused else"), np.empty(0), words
    if len(found) != 1 or not isinstance(found[0], Trip):
        return "wrong", np.empty(0), f"{route} became {len(found)} trips: {found}"
    trip = found[0]
    line = line_of(trip)
    legs = [(leg.edge, leg.forward) for leg in line.legs]
    if legs != wanted:
        return "wrong", np.empty(0), f"{wanted} became {legs}; {trip.metadata['route_evidence']}"
    estimate = trip["/estimates/state"]
    seconds = (estimate.index - BEGUN).total_seconds().to_numpy()
    true = np.interp(seconds, fixes.seconds, fixes.true_position)
    return "right", np.abs(estimate["position"].to_numpy() - true), ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trips", type=int, default=240)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--close", action="store_true")
    options = parser.parse_args()
    names = list(networks(options.close))
    tasks = [
        (names[number % len(names)], KINDS[number // len(names) % len(KINDS)],
         1000 * options.seed + number, options.close)
        for number in range(options.trips)
    ]  # fmt: skip
    with ProcessPoolExecutor(options.workers) as pool:
        found = list[Outcome]()
        for outcome in pool.map(one, tasks):
            found.append(outcome)
            if outcome.state != "right":
                where = f"{outcome.network}, {outcome.receiver}"
                print(f"trip {len(found)}, {outcome.state}: {where}: {outcome.words}", flush=True)
    frame = pd.DataFrame(found)
    for keys in ("network", "receiver"):
        print(table(frame, keys), "\n")
    print(table(frame.assign(all="all"), "all"), "\n")


def table(frame: pd.DataFrame, by: str) -> str:
    rows = []
    for name, part in frame.groupby(by, sort=False):
        states = part["state"].value_counts()
        right = part[part["state"] == "right"]
        usual = part[part["receiver"] == "10 Hz CSV"]
        rows.append(
            {
                by: name,
                "trips": len(part),
                "right": states.get("right", 0),
                "refused": states.get("refused", 0) + states.get("refused else", 0),
                "wrong": states.get("wrong", 0),
                "found [%]": round(100.0 * len(right) / len(part), 1),
                "median [m]": round(right["median"].median(), 1),
                "95 % [m]": round(right["high"].median(), 1),
                "20 min of 10 Hz [s]": round(
                    (1200.0 * usual["seconds"] / usual["recorded"]).median(), 2
                ),
            }
        )
    return pd.DataFrame(rows).to_string(index=False)


if __name__ == "__main__":
    main()
