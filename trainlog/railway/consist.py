"""Vehicles one behind the other: a consist joined by couplers, rolling stock as textbooks give it.

A `Consist` has every vehicle as a particle with its own forces. A `RollingVehicle` is given in
per mille of its weight: running resistance after Strahl (wagons) and Sauthoff (coaches), and that
of the traction unit, as in Wende, D. (2003), *Fahrdynamik des Schienenverkehrs*, pp. 151-153. All
are quadratic in speed, so that each is a `RunningResistance` with coefficients in newtons.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import reduce
from itertools import groupby
from operator import add
from typing import Annotated, ClassVar, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.declaration import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    POSITIVE_FINITE,
    Declared,
    Many,
    Part,
    Quantity,
    Text,
)
from trainlog.errors import InputError
from trainlog.presentation import (
    FORCE,
    MASS,
    POWER,
    Column,
    Quantity as Shown,
    WordTable,
    new_table,
)
from trainlog.railway.effort import EffortCurve
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import Brake
from trainlog.units import GRAVITY, KMH

VehicleType = Literal["traction unit", "multiple unit", "passenger", "freight"]

REFERENCE_SPEED = 100.0 / KMH
"""Speed at which the air resistance is given [m/s]."""

HEAD_WIND = 15.0 / KMH
"""Wind that is added to the speed in the air resistance of coaches and traction units [m/s]."""


_NONLINEAR = Quantity("1/m^2", "1/m^2", must=FINITE, stated="required")


@dataclass(frozen=True, slots=True)
class Coupler(Declared):
    """A nonlinear spring and damper between two vehicles; Amirhosseini et al. (2024), eqs. (2)-(4).

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
    buffing_stiffness, buffing_nonlinearity : float or None
        Of the spring that is pushed together, as side buffers are, where it is another than the one
        that is pulled apart.

    Examples
    --------
    >>> coupler = Coupler(stiffness=1e6, slack=0.01)
    >>> coupler.force([-0.02, 0.005, 0.02])
    array([-10000.,      0.,  10000.])
    """

    stiffness: Annotated[float, Quantity("MN/m", "N/m", must=POSITIVE_FINITE)]
    nonlinearity: Annotated[float, _NONLINEAR] = 0.0
    damping: Annotated[
        float, Quantity("kN*s/m", "N/(m/s)", must=NOT_NEGATIVE, stated="required")
    ] = 0.0
    slack: Annotated[float, Quantity("mm", "m", must=NOT_NEGATIVE, stated="required")] = 0.0
    buffing_stiffness: Annotated[float | None, Quantity("MN/m", "N/m", must=POSITIVE_FINITE)] = None
    buffing_nonlinearity: Annotated[float | None, Quantity("1/m^2", "1/m^2", must=FINITE)] = None

    @property
    def draft(self) -> tuple[float, float]:
        """Stiffness [N/m] and nonlinearity [1/m²] of the spring that is pulled apart."""
        return self.stiffness, self.nonlinearity

    @property
    def buff(self) -> tuple[float, float]:
        """Stiffness [N/m] and nonlinearity [1/m²] of the spring that is pushed together."""
        stiffness, nonlinearity = self.buffing_stiffness, self.buffing_nonlinearity
        return (
            self.stiffness if stiffness is None else stiffness,
            self.nonlinearity if nonlinearity is None else nonlinearity,
        )

    @property
    def largest_stretch(self) -> tuple[float, float]:
        """Stretch [m], apart and together, up to which the force grows; infinite unless it softens.

        A softening spring ``k0 (1 + eps x²) x`` weakens beyond ``1 / sqrt(3 |eps|)``.
        """
        apart, together = (
            self.slack + 1.0 / float(np.sqrt(-3.0 * nonlinearity)) if nonlinearity < 0.0 else np.inf
            for _, nonlinearity in (self.draft, self.buff)
        )
        return apart, together

    def force(self, stretch: ArrayLike) -> FloatArray:
        """Spring force [N] at each stretch [m], positive when pulled apart."""
        beyond, stiffness, nonlinearity = self._spring(stretch)
        return np.asarray(stiffness * (1.0 + nonlinearity * beyond**2) * beyond)

    def energy(self, stretch: ArrayLike) -> FloatArray:
        """Energy stored in the spring [J] at each stretch [m]."""
        beyond, stiffness, nonlinearity = self._spring(stretch)
        return np.asarray(0.5 * stiffness * beyond**2 * (1.0 + 0.5 * nonlinearity * beyond**2))

    def _spring(self, stretch: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Stretch beyond the slack, with its sign, and the spring that takes it up."""
        x = np.asarray(stretch, dtype=np.float64)
        beyond = np.sign(x) * np.maximum(np.abs(x) - self.slack, 0.0)
        (k, eps), (k_buff, eps_buff) = self.draft, self.buff
        return beyond, np.where(x < 0.0, k_buff, k), np.where(x < 0.0, eps_buff, eps)


@dataclass(frozen=True, slots=True)
class Vehicle(Declared):
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

    Examples
    --------
    >>> from trainlog.railway import RunningResistance
    >>> resistance = RunningResistance(900.0, 0.0, 4.0)
    >>> wagon = Vehicle("wagon", 80_000.0, 14.0, resistance, rotating_mass=2_000.0)
    >>> wagon.inertia
    82000.0
    """

    ORDER: ClassVar[tuple[str, ...]] = ("name", "mass", "rotating_mass")

    name: Annotated[str, Text(least=1)]
    mass: Annotated[float, Quantity("t", "kg", must=POSITIVE_FINITE)]
    length: Annotated[float, Quantity("m", "m", must=POSITIVE_FINITE)]
    resistance: Annotated[RunningResistance, Part(key="running_resistance")]
    rotating_mass: Annotated[float, Quantity("t", "kg", must=NOT_NEGATIVE, stated="required")] = 0.0
    max_tractive_effort: Annotated[float, Quantity("kN", "N", must=NOT_NEGATIVE)] = 0.0
    max_traction_power: Annotated[float, Quantity("kW", "W", must=POSITIVE)] = np.inf
    max_braking_effort: Annotated[float, Quantity("kN", "N", must=NOT_NEGATIVE)] = 0.0

    def __str__(self) -> str:
        return self.name

    @property
    def inertia(self) -> float:
        """Mass with the rotating part [kg]."""
        return self.mass + self.rotating_mass


@dataclass(frozen=True, slots=True)
class ConsistBrake(Brake):
    """Dead time and lag [s] of every vehicle's brake, and how its demand reaches the vehicle.

    Attributes
    ----------
    propagation : float [m/s]
        How fast the demand travels from the front along the train pipe; infinite where it is
        electric.

    Examples
    --------
    >>> ConsistBrake(dead_time=1.0, lag=0.8, propagation=280.0).propagation
    280.0
    """

    propagation: Annotated[float, Quantity("m/s", "m/s", must=POSITIVE)] = np.inf


Thing = TypeVar("Thing", Vehicle, Coupler)

LENGTH = Shown("m", "m")
STIFFNESS = Shown("N_m", "MN/m", 1e-6)
DAMPING = Shown("N_s_m", "kN s/m", 1e-3)
SLACK = Shown("m", "mm", 1e3)


def _runs(things: Iterable[Thing]) -> list[tuple[str, Thing]]:
    """Each thing that differs from the one before, with the numbers of its equals."""
    found, first = [], 1
    for thing, group in groupby(things):
        last = first + len(list(group)) - 1
        found.append((f"{first}" if first == last else f"{first} to {last}", thing))
        first = last + 1
    return found


VEHICLES = (
    Column("number", of=lambda row: row[0]),
    Column("vehicle", of=lambda row: row[1].name),
    Column("mass", MASS, of=lambda row: row[1].mass),
    Column("length", LENGTH, of=lambda row: row[1].length),
    Column("traction", FORCE, of=lambda row: row[1].max_tractive_effort or None),
    Column(
        "power",
        POWER,
        of=lambda row: row[1].max_traction_power if row[1].max_tractive_effort else None,
    ),
    Column("braking", FORCE, of=lambda row: row[1].max_braking_effort or None),
)
"""Of the table of vehicles, by their numbers."""

COUPLERS = (
    Column("number", of=lambda row: row[0]),
    Column("draft", STIFFNESS, of=lambda row: row[1].draft[0]),
    Column("1/m²", key="draft_progressive_per_m2", of=lambda row: row[1].draft[1]),
    Column("buff", STIFFNESS, of=lambda row: row[1].buff[0]),
    Column("1/m²", key="buff_progressive_per_m2", of=lambda row: row[1].buff[1]),
    Column("damping", DAMPING, of=lambda row: row[1].damping),
    Column("slack", SLACK, of=lambda row: row[1].slack),
)
"""Of the table of couplers."""


@dataclass(frozen=True, eq=False, repr=False)
class Consist(Declared):
    """Vehicles from the front to the rear, and the couplers between them.

    Attributes
    ----------
    name : str
    vehicles : tuple of Vehicle
    couplers : tuple of Coupler
        One fewer than vehicles.
    brake : ConsistBrake
        Amirhosseini et al. (2024), eq. (1).
    source : str
    assumed : tuple of str
        Fields that the source does not give: they hold assumptions.

    Examples
    --------
    >>> import trainlog
    >>> consist = trainlog.read_consist("sample_logs/freight_24_wagons.consist.json")
    >>> len(consist.vehicles) - len(consist.couplers)
    1
    >>> consist.as_one().mass == consist.mass
    True
    """

    FORMAT: ClassVar[str] = "trainlog/consist"
    ORDER: ClassVar[tuple[str, ...]] = ("name", "source", "assumed", "brake")

    name: Annotated[str, Text(least=1)]
    vehicles: Annotated[tuple[Vehicle, ...], Many(least=1, runs=True)]
    couplers: Annotated[tuple[Coupler, ...], Many(stated="required", runs=True)] = ()
    brake: Annotated[ConsistBrake, Part(stated="required")] = ConsistBrake()
    source: Annotated[str, Text(stated="written")] = ""
    assumed: tuple[str, ...] = ()

    def problems(self) -> Iterator[InputError]:
        """What no consist can be, besides fields beyond their bounds."""
        if not self.vehicles:
            yield InputError(f"consist '{self.name}': needs at least one vehicle")
        elif len(self.couplers) != len(self.vehicles) - 1:
            yield InputError(
                f"consist '{self.name}': {len(self.vehicles)} vehicles need"
                f" {len(self.vehicles) - 1} couplers, given are {len(self.couplers)}"
            )

    def summary(self) -> dict[str, str]:
        """Vehicles, and what they have together."""
        counts = Counter(vehicle.name for vehicle in self.vehicles)
        vehicles = ", ".join(f"{count} x {name}" for name, count in counts.items())
        rotating = sum(vehicle.rotating_mass for vehicle in self.vehicles)
        brake, at = self.brake, self.resistance(np.array([50.0, 100.0]) / KMH) / 1e3
        return {
            "vehicles": f"{vehicles}; {self.length:.1f} m over couplers",
            "mass": f"{self.mass / 1e3:.1f} t, rotating part {rotating / 1e3:.1f} t",
            "efforts": f"{self.max_tractive_effort / 1e3:.0f} kN tractive,"
            f" {self.max_braking_effort / 1e3:.0f} kN braking",
            "brake": f"dead time {brake.dead_time:g} s at the front and"
            f" {self.dead_times.max():.3g} s at the rear, lag {brake.lag:g} s",
            "resistance": f"{at[0]:.1f} kN at 50 km/h, {at[1]:.1f} kN at 100 km/h",
        }

    def tables(self) -> list[WordTable]:
        """What it is, its vehicles and its couplers; equal ones together."""
        vehicles = new_table("Vehicles", *VEHICLES, name="vehicles").add_rows(_runs(self.vehicles))
        couplers = new_table("Couplers", *COUPLERS, name="couplers").add_rows(_runs(self.couplers))
        return [*super().tables(), vehicles, couplers]

    @property
    def notes(self) -> list[str]:
        """Source, and what is assumed."""
        source = [f"source: {self.source}"] if self.source else []
        return [*source, *(f"assumed: {each}" for each in self.assumed)]

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
    def dead_times(self) -> FloatArray:
        """Of each vehicle's brake [s]: its own, and what the demand takes from the front to it."""
        return np.asarray(self.brake.dead_time + self.middles / self.brake.propagation)

    def as_one(self) -> Consist:
        """The single-particle model (10): one vehicle with all masses, resistances and efforts.

        Its brake answers after the mean dead time, weighted by the braking efforts.
        """
        pulling = [vehicle for vehicle in self.vehicles if vehicle.max_tractive_effort > 0.0]
        weights = np.array([vehicle.max_braking_effort for vehicle in self.vehicles])
        weights = weights if weights.any() else np.ones(weights.size)
        vehicle = Vehicle(
            self.name,
            mass=self.mass,
            length=self.length,
            resistance=self.resistance,
            rotating_mass=sum(vehicle.rotating_mass for vehicle in self.vehicles),
            max_tractive_effort=self.max_tractive_effort,
            max_traction_power=sum(each.max_traction_power for each in pulling) or np.inf,
            max_braking_effort=self.max_braking_effort,
        )
        late = float(np.average(self.dead_times, weights=weights))
        brake = ConsistBrake(late, self.brake.lag)
        return Consist(f"{self.name}, as one", (vehicle,), brake=brake, source=self.source)

    @property
    def max_tractive_effort(self) -> float:
        """Of all vehicles together [N]."""
        return sum(vehicle.max_tractive_effort for vehicle in self.vehicles)

    @property
    def max_braking_effort(self) -> float:
        """Of all vehicles together [N]."""
        return sum(vehicle.max_braking_effort for vehicle in self.vehicles)

    @property
    def resistance(self) -> RunningResistance:
        """Of all vehicles together."""
        return reduce(add, (vehicle.resistance for vehicle in self.vehicles))


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


def _air(force: float) -> RunningResistance:
    """Air resistance that is `force` [N] at the reference speed, with the head wind."""
    quadratic = force / REFERENCE_SPEED**2
    return RunningResistance(quadratic * HEAD_WIND**2, 2.0 * quadratic * HEAD_WIND, quadratic)
