"""Timetables: how long a train needs at the least, and what is planned for it."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainlog.railway import Line, Station, Train
from trainlog.simulation.drivers import GRID, Stop, braking_ceiling, permitted_speeds

FloatArray = NDArray[np.float64]


@njit(cache=True)
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
    reserve: float = 0.07,
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
