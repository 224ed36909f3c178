"""Timetables: what a driver knows of the route, and when he is due where."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainlog.errors import InputError
from trainlog.railway import Line, Station, Train

FloatArray = NDArray[np.float64]

GRID = 5.0
"""Spacing of a driver's route knowledge [m]."""


@dataclass(frozen=True, slots=True)
class Stop:
    """A timetabled stop.

    Attributes
    ----------
    station : str
    position : float [m]
        Where the train's front comes to stand.
    arrival, departure : float [s]
        Since the beginning of the trip.
    """

    station: str
    position: float
    arrival: float
    departure: float


def check_stops(line: Line, stops: tuple[Stop, ...]) -> None:
    """Refuse stops that no train can make.

    Raises
    ------
    InputError
        If there are fewer than two, one lies beyond the line, or they are out of order.
    """
    if len(stops) < 2:
        raise InputError(f"line '{line.name}': a trip needs two stops at least")
    for stop in stops:
        if not 0.0 <= stop.position <= line.length:
            raise InputError(
                f"line '{line.name}': stop '{stop.station}' at km {stop.position / 1e3:.3f} lies"
                f" beyond the line's end at km {line.length / 1e3:.3f}"
            )
        if stop.departure < stop.arrival:
            raise InputError(f"stop '{stop.station}': departure is before arrival")
    for first, second in pairwise(stops):
        if second.position <= first.position or second.arrival <= first.departure:
            raise InputError(
                f"stops '{first.station}' and '{second.station}' are not in the order of travel"
            )


def permitted_speeds(line: Line, train_length: float, grid: FloatArray) -> FloatArray:
    """Permitted speed [m/s] for a whole train, whose rear must also have passed a restriction."""
    starts, values = line.speed_limits.positions, line.speed_limits.values
    ends = np.append(starts[1:], np.inf)
    allowed = np.full(grid.shape, np.inf)
    for start, end, value in zip(starts, ends, values, strict=True):
        under = (grid >= start) & (grid - train_length < end)
        allowed[under] = np.minimum(allowed[under], value)
    return allowed


def braking_ceiling(grid: FloatArray, limits: FloatArray, deceleration: float) -> FloatArray:
    """Highest speed [m/s] at each grid point from which every limit ahead can be kept."""
    energy = limits**2 + 2.0 * deceleration * grid
    reachable = np.minimum.accumulate(energy[::-1])[::-1] - 2.0 * deceleration * grid
    return np.asarray(np.sqrt(np.maximum(reachable, 0.0)))


@njit(cache=True)  # type: ignore[untyped-decorator]
def fastest_speeds(
    ceiling: FloatArray,
    slope: FloatArray,
    spacing: float,
    effort: float,
    power: float,
    resistance: FloatArray,
    mass: float,
    inertia: float,
) -> FloatArray:
    """Speeds [m/s] at grid points when a train starts at rest and always runs as fast as it can.

    Parameters
    ----------
    ceiling : (n,) array [m/s]
        Braking for what lies ahead already in it.
    slope : (n,) array [m/s²]
        Deceleration by the track.
    resistance : (3,) array
        r0, r1, r2.
    """
    speeds = np.zeros(ceiling.size)
    for k in range(ceiling.size - 1):
        v = speeds[k]
        pull = min(effort, power / max(v, 0.1))
        drag = resistance[0] + (resistance[1] + resistance[2] * v) * v
        gain = (pull - drag - mass * slope[k]) / inertia
        speeds[k + 1] = min(math.sqrt(max(v * v + 2.0 * gain * spacing, 0.25)), ceiling[k + 1])
    return speeds


def running_time(
    line: Line,
    train: Train,
    start: float,
    end: float,
    *,
    deceleration: float = 0.6,
    lever: float = 0.8,
    load: float = 0.0,
) -> float:
    """Shortest time [s] from standing at `start` to standing at `end` [m].

    Parameters
    ----------
    deceleration : float [m/s²]
        Of service braking.
    lever : float
        Share of the tractive effort used.
    load : float [kg]
    """
    grid = np.linspace(start, end, max(int((end - start) / GRID), 2) + 1)
    limits = np.minimum(permitted_speeds(line, train.length, grid), train.max_speed)
    limits[-1] = 0.0
    mass = train.mass + load
    drag = train.resistance
    speeds = fastest_speeds(
        braking_ceiling(grid, limits, deceleration),
        line.track_acceleration(grid),
        float(grid[1] - grid[0]),
        lever * train.max_tractive_effort,
        lever * train.max_traction_power,
        np.array([drag.r0, drag.r1, drag.r2]),
        mass,
        mass + train.rotating_mass,
    )
    return float(np.sum(2.0 * np.diff(grid) / (speeds[1:] + speeds[:-1])))


def plan(
    line: Line,
    train: Train,
    stations: tuple[Station, ...],
    *,
    reserve: float = 0.1,
    dwell: float = 42.0,
    first_departure: float = 15.0,
) -> tuple[Stop, ...]:
    """A timetable: shortest running times with a reserve, rounded up to tenths of a minute.

    Parameters
    ----------
    line : Line
        As travelled.
    stations : tuple of Station
        Where the train stops, both ends included.
    reserve : float
        Added to the shortest running time, as a share of it.
    dwell : float [s]
        Planned at each stop between the ends.
    first_departure : float [s]
        After the beginning of the trip.
    """
    stops = [Stop(stations[0].name, stations[0].position, 0.0, first_departure)]
    for station in stations[1:]:
        shortest = running_time(line, train, stops[-1].position, station.position)
        arrival = stops[-1].departure + 6.0 * math.ceil(shortest * (1.0 + reserve) / 6.0)
        stops.append(Stop(station.name, station.position, arrival, arrival + dwell))
    return tuple(stops)
