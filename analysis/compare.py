"""What trips cost: running time, distance and energy, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.formats.attached import train_of
from trainlog.railway import Line, Train
from trainlog.resampling import interpolated
from trainlog.trip import Trip, seconds

FloatArray = NDArray[np.float64]

JOULES_PER_KWH = 3.6e6

STANDSTILL = 0.3
"""Speeds below this count as standing [m/s]; wheel-speed noise stays under it."""

SHORTEST_STOP = 5.0
"""A train that stands for less [s] is creeping, not stopping."""


@dataclass(frozen=True, slots=True)
class TripCost:
    """What one trip took.

    Attributes
    ----------
    name, direction : str
    distance : float [m]
    running_time : float [s]
        From the first to the last movement, dwell included.
    stops : int
        Standstills between departure and arrival.
    mass : float [kg]
        Train and load, as the log says.
    traction : float [J]
        Work of the tractive effort at the wheel rims.
    dynamic_braking : float [J]
        Work taken by the dynamic brake at the wheel rims.
    line : float [J]
        Energy drawn from the line less what was fed back, with the train's efficiencies.
    top_speed : float [m/s]
    """

    name: str
    direction: str
    distance: float
    running_time: float
    stops: int
    mass: float
    traction: float
    dynamic_braking: float
    line: float
    top_speed: float


def trip_cost(trip: Trip) -> TripCost:
    """Energy and time of a trip from its recorded efforts and speed.

    Parameters
    ----------
    trip : Trip
        With `/train/state` (or `/estimates/state`) and `/train/controls`.

    Returns
    -------
    TripCost

    Raises
    ------
    LogError
        If the trip has no speed, no efforts, or never moves.
    """
    train = train_of(trip)
    state = trip["/train/state"] if "/train/state" in trip else trip["/estimates/state"]
    controls = trip["/train/controls"]
    index = pd.DatetimeIndex(state.index)
    time = seconds(state)
    speed = state["speed"].to_numpy(dtype=np.float64)
    stands = _standstills(time, speed)
    if stands.size and stands[0, 0] == 0 and stands[0, 1] == time.size:
        raise LogError(f"trip '{trip.name}' never moves: there is no energy to compare")
    departs = bool(stands.size) and stands[0, 0] == 0
    arrives = bool(stands.size) and stands[-1, 1] == time.size
    first = stands[0, 1] if departs else 0
    last = stands[-1, 0] if arrives else time.size - 1

    def work(column: str) -> float:
        effort = interpolated(controls, column, index)
        power = np.nan_to_num(effort * speed)
        return float(np.trapezoid(power, time))

    traction = work("tractive_effort")
    dynamic = work("dynamic_braking_effort")
    position = state["position"].to_numpy(dtype=np.float64)
    return TripCost(
        name=trip.name,
        direction=trip.metadata.get("direction", "forward"),
        distance=float(np.nanmax(position) - np.nanmin(position)),
        running_time=float(time[last] - time[first]),
        stops=len(stands) - int(departs) - int(arrives),
        mass=train.mass + float(trip.metadata.get("load", "0")),
        traction=traction,
        dynamic_braking=dynamic,
        line=line_energy(train, traction, dynamic),
        top_speed=float(np.nanmax(speed)),
    )


def _standstills(time: FloatArray, speed: FloatArray) -> NDArray[np.intp]:
    """First and one-past-last sample of every standstill, (k, 2)."""
    standing = np.concatenate(([False], np.nan_to_num(speed) <= STANDSTILL, [False]))
    edges = np.flatnonzero(np.diff(standing)).reshape(-1, 2)
    lasting = time[edges[:, 1] - 1] - time[edges[:, 0]] >= SHORTEST_STOP
    return np.asarray(edges[lasting])


def line_energy(train: Train, traction: float, dynamic_braking: float) -> float:
    """Energy from the line [J]: traction over its efficiency, less what braking feeds back."""
    return traction / train.efficiency_traction - train.efficiency_regeneration * dynamic_braking


def fastest_nonstop(trips: Sequence[Trip], line: Line) -> float:
    """Shortest running time [s] among the trips that run the whole line forward without a stop.

    Raises
    ------
    LogError
        If there is no such trip.
    """
    forward = [trip for trip in trips if trip.metadata.get("direction", "forward") == "forward"]
    times = [
        cost.running_time
        for cost in map(trip_cost, forward)
        if cost.stops == 0 and cost.distance > 0.98 * line.length
    ]
    if not times:
        raise LogError(
            f"no trip runs the whole line '{line.name}' forward without a stop",
            remedy="give the running time instead",
        )
    return min(times)


@dataclass(frozen=True, slots=True)
class Saving:
    """A driver's trip beside the trip of the same train, equally loaded, on the trajectory.

    Attributes
    ----------
    driver, trajectory : TripCost
    """

    driver: TripCost
    trajectory: TripCost

    @property
    def traction(self) -> float:
        """Tractive work saved at the wheel rims [J]."""
        return self.driver.traction - self.trajectory.traction

    @property
    def line(self) -> float:
        """Energy from the line saved, feeding back included [J]."""
        return self.driver.line - self.trajectory.line


def savings(drivers: Sequence[Trip], followed: Sequence[Trip]) -> tuple[Saving, ...]:
    """Pair drivers' trips with trips that followed a trajectory, configuration by configuration.

    A pair is comparable when the followed trip was driven with the configuration observed on the
    driver's trip (metadata ``configuration``), in the same direction, over the same distance,
    and neither stopped on the way.

    Raises
    ------
    LogError
        If no pair is comparable.
    """
    by_name = {trip.name: trip for trip in drivers}
    pairs = []
    for trip in followed:
        observed = by_name.get(trip.metadata.get("configuration", ""))
        if observed is None:
            continue
        driver, cost = trip_cost(observed), trip_cost(trip)
        if (
            cost.direction == driver.direction
            and cost.stops == driver.stops == 0
            and abs(cost.distance - driver.distance) < 0.02 * cost.distance
        ):
            pairs.append(Saving(driver, cost))
    if not pairs:
        raise LogError(
            "no trip that followed the trajectory has a comparable trip by a driver",
            remedy="needs one non-stop trip of the same configuration, direction and distance",
        )
    return tuple(pairs)
