"""A consist: vehicles one behind the other, joined by couplers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trainlog.errors import InputError
from trainlog.railway.resistance import RunningResistance

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Coupler:
    """A nonlinear spring and damper between two vehicles; paper 004, eqs. (2)-(4).

    Attributes
    ----------
    stiffness : float [N/m]
        k0, of the linear part.
    nonlinearity : float [1/m²]
        epsilon: positive hardens with the stretch, negative softens.
    damping : float [N/(m/s)]
        b.
    slack : float [m]
        Free travel from the middle to either side before the spring takes up force.
    """

    stiffness: float
    nonlinearity: float = 0.0
    damping: float = 0.0
    slack: float = 0.0

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping", "slack", "nonlinearity"):
            if not np.isfinite(getattr(self, name)):
                raise InputError(f"coupler: {name} must be a finite number")
        if not self.stiffness > 0.0:
            raise InputError(
                f"coupler: stiffness {self.stiffness} N/m is not positive",
                remedy="vehicles that are not coupled are not a consist",
            )
        for name in ("damping", "slack"):
            if getattr(self, name) < 0.0:
                raise InputError(f"coupler: {name} {getattr(self, name)} is negative")

    @property
    def largest_stretch(self) -> float:
        """Stretch [m] up to which the force grows; infinite unless it softens.

        A softening spring ``k0 (1 + eps x²) x`` weakens beyond ``1 / sqrt(3 |eps|)``.
        """
        if self.nonlinearity >= 0.0:
            return np.inf
        return self.slack + 1.0 / float(np.sqrt(-3.0 * self.nonlinearity))

    def force(self, stretch: ArrayLike) -> FloatArray:
        """Spring force [N] at each stretch [m], positive when pulled apart."""
        x = np.asarray(stretch, dtype=np.float64)
        beyond = np.sign(x) * np.maximum(np.abs(x) - self.slack, 0.0)
        return np.asarray(self.stiffness * (1.0 + self.nonlinearity * beyond**2) * beyond)

    def energy(self, stretch: ArrayLike) -> FloatArray:
        """Energy stored in the spring [J] at each stretch [m]."""
        x = np.asarray(stretch, dtype=np.float64)
        beyond = np.maximum(np.abs(x) - self.slack, 0.0)
        return np.asarray(
            0.5 * self.stiffness * beyond**2 * (1.0 + 0.5 * self.nonlinearity * beyond**2)
        )


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A locomotive, a wagon or a coach.

    Attributes
    ----------
    name : str
    mass : float [kg]
        As loaded, without the rotating part.
    length : float [m]
        Over couplers.
    resistance : RunningResistance
        On straight, level, open track.
    rotating_mass : float [kg]
        Inertia of its wheels and motors, as a mass at the wheel rim.
    max_tractive_effort : float [N]
    max_traction_power : float [W]
        At the wheel rims.
    max_braking_effort : float [N]
    """

    name: str
    mass: float
    length: float
    resistance: RunningResistance
    rotating_mass: float = 0.0
    max_tractive_effort: float = 0.0
    max_traction_power: float = np.inf
    max_braking_effort: float = 0.0

    def __post_init__(self) -> None:
        for name in ("mass", "length"):
            if not (getattr(self, name) > 0.0 and np.isfinite(getattr(self, name))):
                raise InputError(
                    f"vehicle '{self.name}': {name} {getattr(self, name)} is not positive"
                )
        for name in ("rotating_mass", "max_tractive_effort", "max_braking_effort"):
            if not getattr(self, name) >= 0.0:
                raise InputError(f"vehicle '{self.name}': {name} {getattr(self, name)} is negative")
        if not self.max_traction_power > 0.0:
            raise InputError(f"vehicle '{self.name}': traction power must be positive")

    @property
    def inertia(self) -> float:
        """Mass with the rotating part [kg]."""
        return self.mass + self.rotating_mass


@dataclass(frozen=True)
class Consist:
    """Vehicles from the front to the rear, and the couplers between them.

    Attributes
    ----------
    name : str
    vehicles : tuple of Vehicle
    couplers : tuple of Coupler
        One fewer than vehicles.
    source : str
    """

    name: str
    vehicles: tuple[Vehicle, ...]
    couplers: tuple[Coupler, ...] = ()
    source: str = ""

    def __post_init__(self) -> None:
        if not self.vehicles:
            raise InputError(f"consist '{self.name}': needs at least one vehicle")
        if len(self.couplers) != len(self.vehicles) - 1:
            raise InputError(
                f"consist '{self.name}': {len(self.vehicles)} vehicles need"
                f" {len(self.vehicles) - 1} couplers, given are {len(self.couplers)}"
            )

    @property
    def mass(self) -> float:
        """Of all vehicles, without the rotating part [kg]."""
        return sum(vehicle.mass for vehicle in self.vehicles)

    @property
    def length(self) -> float:
        """Over couplers [m]."""
        return sum(vehicle.length for vehicle in self.vehicles)

    @property
    def middles(self) -> FloatArray:
        """Distance of each vehicle's middle behind the front of the consist [m], at rest."""
        lengths = np.array([vehicle.length for vehicle in self.vehicles])
        return np.asarray(np.cumsum(lengths) - 0.5 * lengths)

    @property
    def resistance(self) -> RunningResistance:
        """Of all vehicles together."""
        return reduce(add, (vehicle.resistance for vehicle in self.vehicles))
