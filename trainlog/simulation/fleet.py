"""A fleet: trains on rosters over a network, through days of weather, each trip on its own.

Whatever is shared is drawn once from the seed: the network's rail and weather by edge, what the
files say wrongly of gradients, the trains, and the rosters. A trip is drawn from the seed and its
number alone, so that any of them can be made again, in any order and in any process.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from trainlog.display import as_text, counted
from trainlog.errors import InfeasibleError, InputError
from trainlog.formats.csv_tables import write_weather
from trainlog.formats.files import made_folder, read_bytes, write_bytes
from trainlog.formats.railway import line_to_bytes, train_to_bytes, write_network, write_train
from trainlog.mcap import write_log
from trainlog.processes import in_processes
from trainlog.progress import task
from trainlog.railway import Line, Network, StepProfile
from trainlog.railway.geometry import to_plane
from trainlog.railway.motion import timetable_run
from trainlog.railway.weather import WEATHER_BY_EDGE
from trainlog.simulation.drivers import Stop
from trainlog.simulation.plant import Plant
from trainlog.simulation.rail import (
    HOUR,
    WARM_UP,
    Rail,
    RailState,
    draw_weather,
    local_weather,
    midnight,
)
from trainlog.simulation.recording import drive, recorded
from trainlog.simulation.scenario import Scenario, drawn_habits, survey_error
from trainlog.simulation.vehicles import (
    Condition,
    Fault,
    FleetTrain,
    draw_trains,
    resistance_of_trip,
)
from trainlog.topics import TRUTH
from trainlog.trip import Trip
from trainlog.units import DAY, MINUTE
from trainlog.version import __version__, code_version_of

START = "2026-10-01"
"""First day, where none is given."""

FIRST_DEPARTURE, SERVICE = 5 * HOUR, 18 * HOUR
"""Since midnight, and how long trains run each day [ns]."""

TURNAROUND = 45 * MINUTE
"""From one departure of a train to its next, at least [ns]."""

TRIPS_A_DAY = 4
"""Of each train, where nothing else is asked for."""

SHORTEST, LONGEST = 8e3, 25e3
"""Length of the routes of a roster, where the network has such [m]."""

PARTNERS = 3
"""Destinations that a train shuttles to from its hub."""

MOST_PAIRS = 500
"""Pairs of stations that rosters are chosen from."""

SKIPPED = {"flirt": 0.15, "kiss": 0.35, "traxx": 0.5}
"""How often a train of a kind runs through a station on its way."""

RESERVES = (0.05, 0.08, 0.11)
"""Of a timetable, over the shortest running times."""

WIND, HEIGHT = 1.3, -6.5e-3
"""Typical wind speed beside a train [m/s], and change of temperature with altitude [K/m]."""


class Roster(NamedTuple):
    """Routes that a train runs one after the other, over and over; and back, if there is a way."""

    routes: tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False, repr=False)
class FleetScenario(Scenario):
    """A trip of a fleet's train over a route; see `Scenario`.

    Attributes
    ----------
    vehicle : FleetTrain
    condition : Condition
        Of the vehicle on that day.
    route : RouteGround
    head_wind : float [m/s]
    conditions : dict of str to str
        Rail condition of each edge of the route at the departure.
    """

    vehicle: FleetTrain | None = None
    condition: Condition | None = None
    route: RouteGround | None = None
    head_wind: float = 0.0
    conditions: dict[str, str] = field(default_factory=dict)

    @property
    def load(self) -> float:
        """Mass above that of the empty train as it is [kg]: by that air springs are tared."""
        return super().load if self.condition is None else self.mass - self.condition.mass

    @property
    def ground(self) -> Line:
        """The line in the direction of travel as it truly lies."""
        return super().ground if self.route is None else self.route.ground

    def plant(self) -> Plant:
        """The train on its line, with its own brakes."""
        if self.vehicle is None:
            return super().plant()
        own = replace(self.train, brake=self.vehicle.brake)
        return super().plant_of(own)

    def files(self) -> tuple[bytes, bytes]:
        """The files of line and train that the log carries."""
        if self.route is None:
            return super().files()
        return self.route.content, train_to_bytes(self.train)

    def metadata(self) -> dict[str, str]:
        """What the log states beside what every simulated trip does."""
        if self.vehicle is None:
            return {}
        stated = json.dumps(self.conditions, ensure_ascii=False)
        return {"kind": self.vehicle.kind, WEATHER_BY_EDGE: stated}

    def truth(self) -> bytes:
        """The truth of the trip as JSON, in short; see `Scenario.truth`."""
        if self.vehicle is None or self.condition is None:
            return super().truth()
        adhesion = self.maximum_adhesion
        content: dict[str, Any] = {
            "format": "trainlog/scenario",
            "version": 1,
            "name": self.name,
            "line": self.line.name,
            "train": self.train.name,
            "kind": self.vehicle.kind,
            "direction": self.direction,
            "weather": self.weather,
            "seed": self.seed,
            "mass": self.mass,
            "load": self.mass - self.condition.mass,
            "rotating_mass": self.rotating_mass,
            **self.resistance.terms,
            "head_wind": self.head_wind,
            "max_power": self.max_power,
            "maximum_adhesion": {
                "direction": "forward",
                "positions": np.round(adhesion.positions, 2).tolist(),
                "values": np.round(adhesion.values, 4).tolist(),
            },
            "sensors": self.sensors.known(),
        }
        return (json.dumps(content, ensure_ascii=False, separators=(",", ":")) + "\n").encode()


@dataclass(frozen=True, eq=False)
class RouteGround:
    """A route as trains meet it, made once a process.

    Attributes
    ----------
    line : Line
        As its file says.
    ground : Line
        As it truly lies.
    content : bytes
        Of the line's file.
    """

    line: Line
    ground: Line
    content: bytes

    @cached_property
    def course(self) -> complex:
        """Direction from its start to its end: east + i north, of unit length."""
        geometry = self.line.geometry
        if geometry is None:
            return 1.0 + 0.0j
        start = (float(geometry.latitudes[0]), float(geometry.longitudes[0]))
        end = complex(to_plane(geometry.latitudes[-1], geometry.longitudes[-1], start).item())
        return end / abs(end) if end else 1.0 + 0.0j

    @cached_property
    def shortest_times(self) -> dict[tuple[str, float, float], float]:
        """Shortest running times found so far [s], by kind, start and end."""
        return {}


@dataclass(frozen=True, eq=False, repr=False)
class Fleet:
    """Trains on rosters over a network.

    Attributes
    ----------
    network : Network
    trains : tuple of FleetTrain
    rosters : tuple of Roster
        Train `n` has the one of the number `n` modulo their count.
    start : int [ns since 1970 UTC]
        Midnight of the first day.
    days, trips : int
    seed : int

    Examples
    --------
    >>> from trainlog.simulation.network import draw_network
    >>> fleet = draw_fleet(draw_network(seed=1, lines=3), trains=2, days=2, trips=6)
    >>> scenario = fleet.scenario(3)
    >>> scenario.train.name, scenario.name
    ('kiss-01', 'kiss-01-2026-10-01-2002')
    """

    network: Network
    trains: tuple[FleetTrain, ...]
    rosters: tuple[Roster, ...]
    start: int
    days: int
    trips: int
    seed: int

    def __repr__(self) -> str:
        first = pd.Timestamp(self.start, tz="UTC")
        rows = {
            "network": f"{self.network.name}, {counted(len(self.network.edges), 'edge')}",
            "trains": ", ".join(each.name for each in self.trains[:4])
            + f" ... ({len(self.trains)})" * (len(self.trains) > 4),
            "days": f"{self.days}, from {first:%Y-%m-%d}",
            "trips": f"{self.trips}",
            "faults": "; ".join(fault.words for each in self.trains for fault in each.faults)
            or "none",
        }
        return as_text(f"Fleet, seed {self.seed}", rows)

    def __getstate__(self) -> dict[str, Any]:
        """What was drawn of it meanwhile is drawn again elsewhere."""
        names = ("network", "trains", "rosters", "start", "days", "trips", "seed")
        return {name: getattr(self, name) for name in names}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)

    def scenarios(self) -> Iterator[FleetScenario]:
        """All trips, one by one."""
        return (self.scenario(number) for number in range(self.trips))

    def train_of(self, number: int) -> FleetTrain:
        """The train of a trip."""
        return self.trains[number % len(self.trains)]

    def departure(self, number: int) -> int:
        """When a trip begins [ns since 1970 UTC], on a whole minute."""
        turn, train = divmod(number, len(self.trains))
        count = -(-(self.trips - train) // len(self.trains))
        spacing = self.days * SERVICE / count
        own = np.random.default_rng([self.seed, 41, number])
        free = min(max(spacing - TURNAROUND, 0.0), 2.0 * SERVICE)
        since = turn * spacing + 0.5 * free * (train / len(self.trains) + own.uniform())
        day, within = divmod(since, SERVICE)
        return self.start + int(day) * DAY + FIRST_DEPARTURE + MINUTE * int(within / MINUTE)

    def name(self, number: int) -> str:
        """Of a trip: train, day and departure."""
        when = pd.Timestamp(self.departure(number), tz="UTC")
        return f"{self.train_of(number).name}-{when:%Y-%m-%d-%H%M}"

    def places(self, number: int) -> tuple[str, str]:
        """Where a trip begins and ends."""
        turn, train = divmod(number, len(self.trains))
        routes = self.rosters[train % len(self.rosters)].routes
        # Trains of one roster do not begin it together.
        return routes[(turn + 2 * (train // len(self.rosters))) % len(routes)]

    def rail(self, edge: str) -> Rail:
        """The rail of an edge through the days, under its own weather."""
        known: dict[str, Rail] = self._rails
        if edge not in known:
            number = [each.name for each in self.network.edges].index(edge)
            line = self.network.edge(edge).line
            own = np.random.default_rng([self.seed, 51, number])
            region, east = self._region
            lag = 0
            if line.geometry is not None and east[1] > east[0]:
                share = (line.geometry.longitudes[0] - east[0]) / (east[1] - east[0])
                lag = round(2.0 * float(share))
            middle = float(line.altitudes(0.5 * line.length))
            weather = local_weather(region, lag, HEIGHT * (middle - 500.0), own)
            known[edge] = Rail.draw(
                line, self.days, self.start, int(own.integers(2**31)), weather=weather
            )
        return known[edge]

    @cached_property
    def _rails(self) -> dict[str, Rail]:
        return {}

    @cached_property
    def _routes(self) -> dict[tuple[str, str], RouteGround]:
        return {}

    @cached_property
    def _surveys(self) -> dict[str, StepProfile]:
        """What the file of each edge says wrongly of its gradients."""
        return {
            edge.name: survey_error(edge.line, self.seed + 1000 * number)
            for number, edge in enumerate(self.network.edges)
        }

    @cached_property
    def _region(self) -> tuple[Any, tuple[float, float]]:
        """Weather of the region, and its western and eastern limit [deg]."""
        hours = 24 * (WARM_UP + self.days + 1)
        drawn = draw_weather(
            self.start - WARM_UP * DAY, hours, np.random.default_rng([self.seed, 50])
        )
        known = [node.longitude for node in self.network.nodes if node.longitude is not None]
        return drawn, (min(known, default=0.0), max(known, default=0.0))

    def route(self, start: str, end: str) -> RouteGround:
        """The route between two stations, made once."""
        if (start, end) not in self._routes:
            line = self.network.route(start, end).line
            errors = along(line, self._surveys.__getitem__, reverse_sign=-1.0)
            positions = np.union1d(line.gradients.positions, errors.positions)
            true = StepProfile(positions, line.gradients(positions) + errors(positions))
            self._routes[start, end] = RouteGround(
                line, replace(line, gradients=true), line_to_bytes(line)
            )
        return self._routes[start, end]

    def scenario(self, number: int) -> FleetScenario:
        """A trip by its number alone.

        Raises
        ------
        InputError
            If the fleet has no such trip.
        """
        if not 0 <= number < self.trips:
            raise InputError(
                f"the fleet has no trip {number}", remedy=f"its trips are 0 to {self.trips - 1}"
            )
        own = np.random.default_rng([self.seed, 40, number])
        vehicle, start = self.train_of(number), self.departure(number)
        condition = vehicle.at(start)
        route = self.route(*self.places(number))
        line = route.line
        state, adhesion, conditions = self._met(line, start)
        temperature = state.weather.temperature
        temperature = 283.0 if not np.isfinite(temperature) else float(temperature)
        # Where the air moves beside the train: east + i north [m/s].
        day = np.random.default_rng([self.seed, 33, start // DAY])
        speed = WIND * day.weibull(2.0)
        prevailing = speed * np.exp(1j * day.uniform(0.0, 2.0 * np.pi))
        gusts = 0.25 * own.standard_normal(2)
        wind = complex(prevailing + gusts[0] + 1j * gusts[1])
        head = -float((wind * np.conj(route.course)).real)
        load = self._load(vehicle, start, own)
        recorder = vehicle.recorder
        return FleetScenario(
            name=self.name(number),
            line=line,
            train=vehicle.train,
            direction="forward",
            weather=state.weather.condition,
            mass=condition.mass + load,
            rotating_mass=vehicle.rotating_mass,
            resistance=resistance_of_trip(condition.resistance, temperature, head, own),
            max_power=vehicle.max_power,
            maximum_adhesion=adhesion,
            stops=self._stops(vehicle, route, own),
            habits=drawn_habits(own, wet=state.weather.condition != "dry"),
            sensors=replace(
                recorder.sensors,
                wheel_factors=condition.wheel_factors,
                effort_gain=condition.effort_gain,
                effort_delay=condition.effort_delay,
            ),
            seed=int(own.integers(2**31)),
            start=start,
            temperature=temperature,
            state=state,
            vehicle=vehicle,
            condition=condition,
            route=route,
            head_wind=head,
            conditions=conditions,
        )

    def _met(self, line: Line, start: int) -> tuple[RailState, StepProfile, dict[str, str]]:
        """The rail of a route at a time: what there is of each edge's then, and its condition."""
        rails = {leg.edge: self.rail(leg.edge) for leg in line.legs}
        states = {edge: rail.state(start) for edge, rail in rails.items()}
        # Trips of one minute meet the same rail, whatever their routes.
        minute = start // MINUTE
        profiles = {edge: rail.profile(start, minute, states[edge]) for edge, rail in rails.items()}
        longest = max(line.legs, key=lambda leg: leg.length).edge
        spots = []
        for leg in line.legs:
            there = states[leg.edge].spots
            ends = (there["start"].to_numpy(), (there["start"] + there["length"]).to_numpy())
            first, last = np.sort([leg.on_line(end) for end in ends], axis=0)
            kept = (last > leg.position) & (first < leg.end)
            spots.append(there[kept].assign(start=first[kept], edge=leg.edge))
        state = RailState(
            along(line, lambda edge: states[edge].lasting),
            states[longest].weather,
            pd.concat(spots, ignore_index=True),
        )
        conditions = {edge: each.weather.condition for edge, each in states.items()}
        return state, along(line, profiles.__getitem__), conditions

    def _load(self, vehicle: FleetTrain, time: int, generator: np.random.Generator) -> float:
        """Passengers on board [kg]: many in the morning and the evening."""
        hour = (time % DAY) / HOUR
        busy = np.exp(-(((hour - 7.5) / 1.2) ** 2)) + np.exp(-(((hour - 17.3) / 1.6) ** 2))
        # The epoch was a Thursday.
        weekend = (time // DAY + 3) % 7 >= 5
        share = (0.12 + 0.5 * float(busy) * (0.3 if weekend else 1.0)) * generator.uniform(0.5, 1.5)
        return float(np.round(vehicle.train.max_load * min(share, 1.0), -2))

    def _stops(
        self, vehicle: FleetTrain, route: RouteGround, generator: np.random.Generator
    ) -> tuple[Stop, ...]:
        """The timetable of a trip: where it calls, and when."""
        line = route.line
        inner = line.stations[1:-1]
        kept = generator.uniform(size=len(inner)) >= SKIPPED.get(vehicle.kind, 0.2)
        calls = [station for station, calling in zip(inner, kept, strict=True) if calling]
        reserve = float(generator.choice(RESERVES))
        stops = [Stop(line.stations[0].name, line.stations[0].position, 0.0, 15.0)]
        for station in (*calls, line.stations[-1]):
            key = (vehicle.kind, stops[-1].position, station.position)
            if key not in route.shortest_times:
                route.shortest_times[key] = timetable_run(
                    line, vehicle.train, *key[1:]
                ).running_time
            shortest = route.shortest_times[key]
            arrival = stops[-1].departure + 6.0 * np.ceil(shortest * (1.0 + reserve) / 6.0)
            stops.append(
                Stop(station.name, station.position, float(arrival), float(arrival) + 42.0)
            )
        return tuple(stops)

    def truth(self) -> dict[str, Any]:
        """What no analysis may read: the trains as they truly are, and how the fleet was drawn."""
        return {
            "format": "trainlog/fleet",
            "version": 1,
            "network": self.network.name,
            "seed": self.seed,
            "start": pd.Timestamp(self.start, tz="UTC").isoformat(),
            "days": self.days,
            "trips": self.trips,
            "trains": [each.truth() for each in self.trains],
            "rosters": [[list(route) for route in each.routes] for each in self.rosters],
        }


def along(
    line: Line, profile: Callable[[str], StepProfile], reverse_sign: float = 1.0
) -> StepProfile:
    """Profiles of the edges of a route, joined along it.

    Parameters
    ----------
    line : Line
        Of a route.
    profile : callable
        Gives the profile of an edge along its own chainage.
    reverse_sign : float
        By which values are multiplied on edges travelled against their chainage.
    """
    parts = []
    for leg in line.legs:
        first, last = sorted((leg.edge_start, leg.edge_end))
        part = profile(leg.edge).between(first, last)
        part = part if leg.forward else part.reversed(last - first, reverse_sign)
        parts.append((leg.position, part))
    return StepProfile.joined(parts)


def draw_fleet(
    network: Network,
    trains: int = 20,
    days: int = 30,
    trips: int | None = None,
    seed: int = 1,
    faults: Sequence[Fault] = (),
    start: str | int | pd.Timestamp = START,
) -> Fleet:
    """Draw a fleet; the same seed draws the same one, and faults change nothing else.

    Parameters
    ----------
    network : Network
        With stations, and with at least one pair of them that a route joins.
    trains, days : int
    trips : int, optional
        Of all trains together, evenly over the days; default: `TRIPS_A_DAY` of each train.
    seed : int
    faults : sequence of Fault
    start : date
        The first day (UTC).

    Raises
    ------
    InputError
        If there are too many trips for the days, no route, or a fault is that of no train or
        begins after the last day.

    Examples
    --------
    >>> import trainlog
    >>> network = trainlog.draw_network(seed=1, lines=3)
    >>> fault = trainlog.TrainFault.of("train=flirt-01,dragging-brake=2kN,from=2026-10-02")
    >>> fleet = draw_fleet(network, trains=3, days=3, trips=12, faults=[fault])
    >>> before, after = (fleet.trains[0].at(fleet.departure(n)).resistance.r0 for n in (0, 6))
    >>> bool(1_900.0 < after - before < 2_100.0)
    True
    """
    if days < 1:
        raise InputError(f"cannot draw {days} days", remedy="give 1 day or more")
    count = TRIPS_A_DAY * trains * days if trips is None else trips
    if count < 1:
        raise InputError(f"cannot draw {count} trips", remedy="give 1 or more")
    most = int(SERVICE // TURNAROUND)
    if count > most * trains * days:
        raise InputError(
            f"{count} trips are more than {most} a day of each train",
            remedy="give more days or more trains",
        )
    vehicles = draw_trains(trains, seed, faults)
    rosters = _rosters(network, seed)
    fleet = Fleet(network, vehicles, rosters, midnight(start), days, count, seed)
    end = pd.Timestamp(fleet.start + (days - 1) * DAY, tz="UTC")
    for fault in (each for vehicle in vehicles for each in vehicle.faults):
        if fault.start >= fleet.start + days * DAY:
            raise InputError(
                f"fault '{fault.words}' takes effect in no trip: the last day is {end:%Y-%m-%d}",
                remedy="give an earlier day, or more days",
            )
    return fleet


def _rosters(network: Network, seed: int) -> tuple[Roster, ...]:
    """Hubs with their destinations, until every edge that can be reached is run over."""
    generator = np.random.default_rng([seed, 42])
    stations = {
        name: len(points)
        for name, points in network.places.items()
        if any(point.station for point in points)
    }
    single = [name for name, tracks in stations.items() if tracks == 1]
    names = single if len(single) > 1 else list(stations)
    pairs = [(a, b) for a in range(len(names)) for b in range(a + 1, len(names))]
    chosen = generator.permutation(len(pairs))[:MOST_PAIRS]
    known: list[tuple[str, str, float, frozenset[str]]] = []
    joined: set[tuple[str, str]] = set()
    for a, b in (pairs[number] for number in sorted(chosen)):
        found = []
        for start, end in ((names[a], names[b]), (names[b], names[a])):
            with suppress(InputError):
                route = network.route(start, end)
                # Some interlockings have routes in one direction alone.
                if len({leg.edge for leg in route.legs}) == len(route.legs):
                    found.append(route)
                    joined.add((start, end))
        if found:
            edges = frozenset(leg.edge for route in found for leg in route.legs)
            known.append((names[a], names[b], max(route.length for route in found), edges))
    if not known:
        raise InputError(
            f"network '{network.name}' has no two stations that a route joins",
            remedy="'trainlog show' of the network lists its stations and directions",
        )
    fitting = [each for each in known if SHORTEST <= each[2] <= LONGEST]
    if not fitting:
        fitting = sorted(known, key=lambda each: abs(each[2] - SHORTEST))[:12]
    missing = set().union(*(each[3] for each in fitting))
    rosters: list[Roster] = []
    hubs = [names[number] for number in generator.permutation(len(names))]
    while missing or len(rosters) < min(5, len(hubs)):
        best: tuple[int, str, list[tuple[str, frozenset[str]]]] | None = None
        for hub in hubs:
            left = set(missing)
            partners: list[tuple[str, frozenset[str]]] = []
            around = [(b if a == hub else a, edges) for a, b, _, edges in fitting if hub in (a, b)]
            while around and len(partners) < PARTNERS:
                most = max(range(len(around)), key=lambda n: len(around[n][1] & left))
                if not around[most][1] & left:
                    most = int(generator.integers(len(around)))
                partners.append(around.pop(most))
                left -= partners[-1][1]
            gain = len(missing) - len(left)
            if partners and (best is None or gain > best[0]):
                best = (gain, hub, partners)
        if best is None:
            break
        _, hub, partners = best
        hubs.remove(hub)
        for _, edges in partners:
            missing -= edges
        both = [route for name, _ in partners for route in ((hub, name), (name, hub))]
        rosters.append(Roster(tuple(route for route in both if route in joined)))
    return tuple(rosters)


def as_recorded(trip: Trip, vehicle: FleetTrain) -> Trip:
    """A simulated trip as the recorder of its train holds it: what it lacks is left out.

    The truth beside it is kept once a second.
    """
    recorder = vehicle.recorder
    topics = dict(trip.topics)
    without = []
    if not recorder.satellites:
        without += ["/gnss/fix", "/gnss/motion"]
        events = topics["/events"]
        topics["/events"] = _like(events[events["name"] != "gnss"], events)
    if not recorder.axles:
        without.append("/train/axles")
    topics = {name: frame for name, frame in topics.items() if name not in without}
    if TRUTH.name in topics:
        every = recorder.sensors.rate
        topics[TRUTH.name] = _like(topics[TRUTH.name].iloc[::every], topics[TRUTH.name])
    if not recorder.acceleration:
        state = topics["/train/state"]
        topics["/train/state"] = _without(state, ["acceleration"])
    if not recorder.demands:
        controls = topics["/train/controls"]
        topics["/train/controls"] = _without(
            controls, ["lever", "tractive_effort_demand", "braking_effort_demand"]
        )
    return replace(trip, topics=topics)


def _without(frame: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """A topic's frame without some columns."""
    kept = frame.drop(columns=columns)
    units = {name: unit for name, unit in frame.attrs["units"].items() if name not in columns}
    kept.attrs = frame.attrs | {"units": units}
    return kept


def _like(rows: pd.DataFrame, frame: pd.DataFrame) -> pd.DataFrame:
    """Rows of a topic's frame as its frame."""
    rows.attrs = dict(frame.attrs)
    return rows


TRUTH_FILE = "fleet.json"
"""What the fleet truly is; no analysis reads it."""

NETWORK_FILE = "network.network.json"

BATCH = 10
"""Trips that a process is given at once."""


class Made(NamedTuple):
    """What became of one trip.

    Attributes
    ----------
    number : int
    name : str
    duration, distance : float [s], [m]
    size : int [B]
    reason : str
        Why there is no log; empty: there is.
    """

    number: int
    name: str
    duration: float = 0.0
    distance: float = 0.0
    size: int = 0
    reason: str = ""


@dataclass
class FleetLogs:
    """What was made of a fleet.

    Attributes
    ----------
    made, kept : int
        Logs made now, and those that there were.
    stuck : list of Made
        Trips that did not arrive, with the reason.
    duration, distance : float [s], [m]
        Of the trips made.
    size : int [B]
    elapsed : float [s]
        On the wall.
    codes : tuple of str
        Versions of the code that made the logs, those of earlier runs first.
    """

    made: int = 0
    kept: int = 0
    stuck: list[Made] = field(default_factory=list)
    duration: float = 0.0
    distance: float = 0.0
    size: int = 0
    elapsed: float = 0.0
    codes: tuple[str, ...] = ()

    def add(self, each: Made) -> None:
        """Count what became of a trip."""
        if each.reason:
            self.stuck.append(each)
            return
        self.made += 1
        self.duration += each.duration
        self.distance += each.distance
        self.size += each.size


def log_path(folder: str | Path, fleet: Fleet, number: int) -> Path:
    """The log of a trip: in the folder of its train."""
    return Path(folder) / fleet.train_of(number).name / f"{fleet.name(number)}.mcap"


def write_trip(fleet: Fleet, number: int, folder: str | Path) -> Made:
    """Drive one trip and write its log.

    A train that does not arrive leaves none.
    """
    scenario = fleet.scenario(number)
    try:
        run = drive(scenario)
    except InfeasibleError as error:
        return Made(number, scenario.name, reason=str(error))
    trip = as_recorded(recorded(scenario, run), fleet.train_of(number))
    path = log_path(folder, fleet, number)
    write_log(trip, path)
    distance = scenario.stops[-1].position - scenario.stops[0].position
    return Made(number, scenario.name, trip.duration, distance, path.stat().st_size)


def write_fleet(fleet: Fleet, folder: str | Path, jobs: int | None = None) -> FleetLogs:
    """Write all logs of a fleet, and beside them network, trains, weather and truth.

    Logs that are there already are kept: an interrupted run goes on where it ended. The bytes do
    not depend on `jobs`.

    Parameters
    ----------
    fleet : Fleet
    folder : path
    jobs : int, optional
        Processes; default: one a processor.

    Raises
    ------
    InputError
        If the folder holds another fleet, or cannot be written to.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.simulation import draw_fleet, draw_network
    >>> fleet = draw_fleet(draw_network(seed=1, lines=3), trains=2, days=1, trips=2)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     first = write_fleet(fleet, folder, jobs=1)
    ...     second = write_fleet(fleet, folder, jobs=1)
    >>> first.made, second.made, second.kept
    (2, 0, 2)
    """
    begun = time.perf_counter()
    jobs = (os.cpu_count() or 1) if jobs is None else jobs
    if jobs < 1:
        raise InputError(f"cannot work in {jobs} processes", remedy="give 1 or more")
    target = made_folder(folder)
    earlier = _write_beside(fleet, target)
    found = FleetLogs()
    missing = []
    for number in range(fleet.trips):
        if log_path(target, fleet, number).exists():
            found.kept += 1
        else:
            missing.append(number)
    found.codes = tuple(earlier) if not missing else _state_code(target, earlier)
    batches = [missing[at : at + BATCH] for at in range(0, len(missing), BATCH)]
    done = 0
    with task("driving", total=len(missing), unit="trip") as step:
        for made in in_processes(_write_trips, (fleet, target), batches, jobs):
            for each in made:
                found.add(each)
                done += 1
                step(done, note=each.name)
    found.elapsed = time.perf_counter() - begun
    return found


def _write_beside(fleet: Fleet, folder: Path) -> list[str]:
    """Network, trains, weather and truth; refused where the folder holds those of another fleet.

    Returns
    -------
    list of str
        Versions of the code that logs in the folder were made by.
    """
    truth = json.loads(json.dumps(fleet.truth()))
    place = folder / TRUTH_FILE
    known = _stated(place) if place.exists() else {}
    if known and {name: known.get(name) for name in truth} != truth:
        raise InputError(
            "the folder holds another fleet",
            file=place,
            remedy="name another folder, or repeat the same seed, trains, days, trips and faults",
        )
    for each in fleet.trains:
        own = made_folder(folder / each.name)
        for left_over in own.glob(".*.mcap"):
            # Of a process that was killed while it wrote.
            left_over.unlink(missing_ok=True)
    if known:
        return list(known.get("code", ["not stated"]))
    write_network(fleet.network, folder / NETWORK_FILE)
    for each in fleet.trains:
        write_train(each.train, made_folder(folder / "trains") / f"{each.name}.train.json")
    for edge in fleet.network.edges:
        name = edge.name.replace("/", "_")
        write_weather(fleet.rail(edge.name).table, made_folder(folder / "weather") / f"{name}.csv")
    _write_truth(place, truth | {"software": f"trainlog {__version__}", "code": []})
    return []


def _stated(place: Path) -> dict[str, Any]:
    """The truth beside the logs of a folder; empty where it is none."""
    try:
        found = json.loads(read_bytes(place))
    except ValueError:
        found = None
    return found if isinstance(found, dict) else {"format": ""}


def _write_truth(place: Path, truth: dict[str, Any]) -> None:
    write_bytes(place, (json.dumps(truth, indent=1, ensure_ascii=False) + "\n").encode())


def _state_code(folder: Path, earlier: list[str]) -> tuple[str, ...]:
    """State beside the logs, before any is made, that the present code makes some of them."""
    code = code_version_of(__name__)
    if code not in earlier:
        place = folder / TRUTH_FILE
        truth = _stated(place)
        _write_truth(
            place, truth | {"software": f"trainlog {__version__}", "code": [*earlier, code]}
        )
        return (*earlier, code)
    return tuple(earlier)


def _write_trips(given: tuple[Fleet, Path], numbers: list[int]) -> list[Made]:
    fleet, folder = given
    return [write_trip(fleet, number, folder) for number in numbers]
