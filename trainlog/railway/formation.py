"""A formation: the vehicles of a train as textbooks give them, in per mille of their weight.

Running resistance after Strahl (wagons) and Sauthoff (coaches), and that of the traction unit, as
in Wende, D. (2003), *Fahrdynamik des Schienenverkehrs*, pp. 151-153. All are quadratic in speed, so
that each is a `RunningResistance` with coefficients in newtons.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trainlog.errors import InputError
from trainlog.railway.resistance import RunningResistance
from trainlog.units import GRAVITY, KMH

FloatArray = NDArray[np.float64]

REFERENCE_SPEED = 100.0 / KMH
"""Speed at which the air resistance is given [m/s]."""

HEAD_WIND = 15.0 / KMH
"""Wind that is added to the speed in the air resistance of coaches and traction units [m/s]."""

VehicleType = Literal["traction unit", "multiple unit", "passenger", "freight"]


@dataclass(frozen=True, eq=False)
class EffortCurve:
    """Tractive effort over speed, on lines between its points and constant beyond the last.

    Attributes
    ----------
    speeds : (n,) array [m/s]
        Strictly increasing from 0.
    efforts : (n,) array [N]
        Not negative.
    """

    speeds: FloatArray
    efforts: FloatArray

    def __post_init__(self) -> None:
        if self.speeds.size < 1 or self.speeds.shape != self.efforts.shape:
            raise InputError("tractive effort: needs pairs of speed and effort")
        if self.speeds[0] != 0.0 or np.any(np.diff(self.speeds) <= 0.0):
            raise InputError(
                "tractive effort: speeds do not grow from 0",
                remedy="order the pairs by speed, the first at standstill",
            )
        if not np.all(self.efforts >= 0.0):
            raise InputError("tractive effort: an effort is negative")

    def __call__(self, speed: ArrayLike) -> FloatArray:
        """Largest tractive effort [N] at each speed [m/s]."""
        return np.asarray(np.interp(np.asarray(speed, dtype=np.float64), self.speeds, self.efforts))


@dataclass(frozen=True)
class RollingVehicle:
    """A vehicle of the rolling stock.

    Attributes
    ----------
    name, kind : str
    length : float [m]
    mass, load : float [kg]
        Empty mass, and the heaviest load.
    adhesive_mass : float [kg]
        On the powered axles, empty.
    inertia_factor : float
        Mass with the rotating part over mass.
    basic_resistance, rolling_resistance, air_resistance : float
        Over weight; of a traction unit the first is of its powered, the second of its carrying
        axles, of a coach the second grows with speed. The air's is at 100 km/h.
    max_speed : float [m/s]
    effort : EffortCurve or None
    deceleration : float or None [m/s²]
        Of service braking.
    """

    name: str
    kind: VehicleType
    length: float
    mass: float
    load: float = 0.0
    adhesive_mass: float = 0.0
    inertia_factor: float = 1.06
    basic_resistance: float = 0.0
    rolling_resistance: float = 0.0
    air_resistance: float = 0.0
    max_speed: float = np.inf
    effort: EffortCurve | None = None
    deceleration: float | None = None

    @property
    def powered(self) -> bool:
        """Whether it pulls."""
        return self.kind in ("traction unit", "multiple unit")

    def resistance(self, load: float) -> RunningResistance:
        """Running resistance with `load` [kg] on board; Wende (2003), pp. 151 and 153."""
        if self.powered:
            weight = GRAVITY * self.mass  # published for the unit as it is, whatever it carries
            carrying = self.mass - self.adhesive_mass
            basic = GRAVITY * (
                self.basic_resistance * self.adhesive_mass + self.rolling_resistance * carrying
            )
            return RunningResistance(basic, 0.0, 0.0) + _air(self.air_resistance * weight)
        weight = GRAVITY * (self.mass + load)
        basic = self.basic_resistance * weight
        if self.kind == "freight":  # Strahl: without wind
            air = self.air_resistance * weight / REFERENCE_SPEED**2
            return RunningResistance(basic, 0.0, air)
        rolling = self.rolling_resistance * weight / REFERENCE_SPEED  # Sauthoff
        return RunningResistance(basic, rolling, 0.0) + _air(self.air_resistance * weight)


@dataclass(frozen=True)
class Formation:
    """Vehicles coupled to a train.

    Attributes
    ----------
    name : str
    vehicles : tuple of RollingVehicle
        At least one pulls.
    source : str
    """

    name: str
    vehicles: tuple[RollingVehicle, ...]
    source: str = ""

    def __post_init__(self) -> None:
        if not any(vehicle.powered and vehicle.effort for vehicle in self.vehicles):
            raise InputError(
                f"formation '{self.name}': no vehicle has tractive effort",
                remedy="add a traction unit or a multiple unit with its tractive effort",
            )

    @property
    def length(self) -> float:
        """Of all vehicles [m]."""
        return sum(vehicle.length for vehicle in self.vehicles)

    @property
    def max_speed(self) -> float:
        """Of the slowest vehicle [m/s]."""
        return min(vehicle.max_speed for vehicle in self.vehicles)

    @property
    def passenger(self) -> bool:
        """Whether it carries passengers: it may brake harder."""
        return any(vehicle.kind in ("passenger", "multiple unit") for vehicle in self.vehicles)

    def mass(self, loaded: float = 1.0) -> float:
        """Of all vehicles [kg] with that share of their heaviest load."""
        return sum(vehicle.mass + loaded * vehicle.load for vehicle in self.vehicles)

    def inertia(self, loaded: float = 1.0) -> float:
        """Mass with the rotating part [kg]: the vehicles' factors, weighted by empty mass."""
        empty = self.mass(0.0)
        factor = sum(vehicle.inertia_factor * vehicle.mass for vehicle in self.vehicles) / empty
        return factor * self.mass(loaded)

    def resistance(self, loaded: float = 1.0) -> RunningResistance:
        """Of all vehicles with that share of their heaviest load."""
        return reduce(add, (vehicle.resistance(loaded * vehicle.load) for vehicle in self.vehicles))

    def tractive_effort(self, speed: ArrayLike) -> FloatArray:
        """Of all vehicles that pull [N] at each speed [m/s]."""
        curves = [vehicle.effort for vehicle in self.vehicles if vehicle.powered and vehicle.effort]
        return np.asarray(sum(curve(speed) for curve in curves))

    @property
    def effort_knots(self) -> FloatArray:
        """Speeds [m/s] between which the tractive effort is linear, growing from 0."""
        curves = [vehicle.effort for vehicle in self.vehicles if vehicle.powered and vehicle.effort]
        return np.unique(np.concatenate([curve.speeds for curve in curves]))

    @property
    def deceleration(self) -> float:
        """Of service braking [m/s²]: what the vehicles give, else 0.375 or, for freight, 0.225.

        The defaults are those of Brünger and Dahlhaus (2014), in *Railway Timetabling &
        Operations*, p. 74.
        """
        given = [each.deceleration for each in self.vehicles if each.deceleration is not None]
        if given:
            return min(given)
        return 0.375 if self.passenger else 0.225


def _air(force: float) -> RunningResistance:
    """Air resistance that is `force` [N] at the reference speed, with the head wind."""
    quadratic = force / REFERENCE_SPEED**2
    return RunningResistance(quadratic * HEAD_WIND**2, 2.0 * quadratic * HEAD_WIND, quadratic)
