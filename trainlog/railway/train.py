"""A train as its file describes it, the configurations it was observed in, and its vehicles."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import reduce
from itertools import groupby
from operator import add, attrgetter
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from trainlog import presentation
from trainlog.arrays import FloatArray
from trainlog.declaration import (
    CONFUSED,
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    POSITIVE_FINITE,
    POSITIVE_SHARE,
    SHARE,
    Column,
    Covariance,
    Declared,
    Ends,
    Form,
    Many,
    Must,
    Named,
    Part,
    Quantity,
    Table,
    Text,
    form_for,
)
from trainlog.display import span
from trainlog.errors import InputError
from trainlog.presentation import FORCE, MASS, POWER, WordTable, new_table
from trainlog.railway.line import Line
from trainlog.railway.resistance import SUFFIXES, TERMS, UNITS, EffortCurve, RunningResistance
from trainlog.units import GRAVITY, KMH

MassModel = Literal["mass_point", "homogeneous_strip"]
AccelerationLimits = Literal["gross", "net"]

POWER_OF_FILE = "train file"
"""Where the power of a configuration is from that no trip showed (`ParameterSet.details`)."""

NOMINAL = "nominal"
"""Configuration of a train as its file describes it."""


MOST_ADHESION, MOST_BRAKING = 1.0, 2.0
"""Effort over the weight on the axles that transmit it: of motors, of the friction brake.

Published friction brakes of 10 m/s² stand for "whatever the rail transmits".
"""

MOST_BESIDE = 10.0
"""Times the stated largest effort, that a curve of effort reaches at most, and its inverse."""

_EFFORT, _BRAKING = (1, 5e3, "trains have"), (0.1, 5e3, "trains have")
"""Plausible efforts of motors [kN]."""

_SPECIFIC_POWER = Quantity("W/kg", "W/kg", (0.02, 300, "trains have"))
"""Traction power over the mass."""

_RESISTANCE_OVER_WEIGHT = Quantity(
    "permil",
    "1",
    (0.2, 300, "the running resistance of trains is, over their weight,"),
    (*CONFUSED["kN"], (1.0 / KMH, "was the speed in its coefficients m/s, not km/h")),
)
"""At the highest speed."""

_DELAY = Quantity("s", "s", (0, 120, "brakes answer after"), must=NOT_NEGATIVE, stated="required")
"""Dead time and lag of a friction brake."""


LEAST_LOAD = 0.05
"""Share of its static load that an axle keeps at least: a wheel does not lift off."""


TWO_OR_MORE = Must("is less than 2", "a bogie has two axles at least", low=2.0)
ONE_OR_TWO = Must("is not 1 or 2", "a vehicle has one or two powered bogies", low=1.0, high=2.0)


def _length(low: float, high: float, whose: str, must: Must = NOT_NEGATIVE) -> Quantity:
    """A length [m] with its plausible range."""
    return Quantity("m", "m", (low, high, whose), must=must)


@dataclass(frozen=True, slots=True)
class AxleGeometry(Declared):
    """Where the powered axles of a train stand, and how high the forces act on their vehicles.

    The axles are counted from the front in the direction of travel. A vehicle of one powered bogie
    has it at the outer end of the train: leading in the first half of them, trailing in the second.

    Attributes
    ----------
    wheelbase : float [m]
        Between the first and the last axle of a bogie.
    pivot_distance : float [m]
        Between the two bogies of a vehicle.
    link_height : float [m]
        Of the link that pulls the body, above the rail; low links transfer less load.
    coupler_height, centre_height : float [m]
        Of the couplers, and of the vehicle's centre of gravity.
    axles_per_bogie : int
    powered_bogies : int
        Of each powered vehicle, 1 or 2.

    Raises
    ------
    InputError
        If a length is not positive, or the counts cannot be.

    Examples
    --------
    >>> AxleGeometry(2.7, 9.0, 0.6, 1.0, 1.6).axles_per_bogie
    2
    """

    wheelbase: Annotated[float, _length(1, 6, "bogies have", POSITIVE)]
    pivot_distance: Annotated[float, _length(3, 25, "vehicles have", POSITIVE)]
    link_height: Annotated[float, _length(0.05, 2, "bodies are pulled at")]
    coupler_height: Annotated[float, _length(0.3, 2, "couplers are at")]
    centre_height: Annotated[float, _length(0.5, 3, "vehicles have their mass at")]
    axles_per_bogie: Annotated[int, Form(must=TWO_OR_MORE, stated="written")] = 2
    powered_bogies: Annotated[int, Form(must=ONE_OR_TWO, stated="written")] = 2

    def vehicles(self, axles: int) -> int:
        """Number of powered vehicles that `axles` powered axles make.

        Raises
        ------
        InputError
            If they do not fill whole vehicles.

        Examples
        --------
        >>> AxleGeometry(2.7, 9.0, 0.6, 1.0, 1.6).vehicles(8)
        2
        """
        each = self.axles_per_bogie * self.powered_bogies
        if axles % each:
            raise InputError(
                f"{axles} powered axles are not whole vehicles of {self.powered_bogies} powered"
                f" bogies with {self.axles_per_bogie} axles",
                remedy="correct count, axles_per_bogie or powered_bogies",
            )
        return axles // each


def load_transfer(geometry: AxleGeometry, axles: int, adhesive_mass: float) -> FloatArray:
    """Change of the axle loads for each newton at an axle, and for the specific force.

    A vehicle is pulled at the rails and held back at its couplers and its centre of gravity,
    higher up. The moment lifts its leading axles and presses on its trailing ones. Bogie by bogie,
    the force on its axles acts on the body at the height of the link between them, which tilts the
    bogie; and the body tilts by what its couplers and its own inertia and weight downhill make of
    the rest. The loads follow from the equilibrium of moments of bogies and body, as in textbooks
    of running dynamics (Wende, D. (2003), Fahrdynamik des Schienenverkehrs; Steimel, A. (2014),
    Electric traction)::

        bogie of force F_B:   dQ_i = -h_z F_B x_i / sum x_j²
        body of force F:      dQ   = -+((h_K - h_z) F + (h_S - h_K) m_v (a + g sin alpha)) / L

    a bogie and an end, positive at the trailing one. ``x_i`` is an axle's distance ahead of the
    bogie's middle, ``L`` the distance of the pivots, ``h_z``, ``h_K``, ``h_S`` the heights of
    link, coupler and centre of gravity, ``m_v`` the vehicle's mass. ``a + g sin alpha`` is what an
    accelerometer along the track shows: on a gradient that a train climbs steadily, all of it is
    the gradient.

    Parameters
    ----------
    geometry : AxleGeometry
    axles : int
        Powered axles of the train.
    adhesive_mass : float [kg]
        That rests on all of them, loaded.

    Returns
    -------
    (axles, axles + 1) array [1], [kg]
        Row i: how the load of axle i [N] changes with the forces between rail and axles [N],
        positive in traction, and, in the last column, with ``a + g sin alpha`` [m/s²].

    Raises
    ------
    InputError
        If the axles do not fill whole vehicles.

    Examples
    --------
    A locomotive of four axles that pulls with 60 kN at each: the leading axle loses most.

    >>> transfer = load_transfer(AxleGeometry(2.7, 9.0, 0.6, 1.0, 1.6), 4, 84e3)
    >>> (transfer[:, :4] @ np.full(4, 60e3) / 1e3).round(1).tolist()
    [-32.0, 21.3, -21.3, 32.0]
    """
    g, vehicles = geometry, geometry.vehicles(axles)
    m, bogies = g.axles_per_bogie, g.powered_bogies
    mass = adhesive_mass / vehicles * (2 / bogies)
    ahead = np.linspace(0.5, -0.5, m) * g.wheelbase
    tilt = -np.outer(ahead / np.sum(ahead**2), np.full(m, g.link_height))
    transfer = np.zeros((axles, axles + 1))
    for vehicle in range(vehicles):
        body = slice(vehicle * m * bogies, (vehicle + 1) * m * bogies)
        for bogie in range(bogies):
            rows = slice(body.start + bogie * m, body.start + (bogie + 1) * m)
            leads = bogie == 0 if bogies == 2 else vehicle < vehicles / 2
            share = (-1.0 if leads else 1.0) / (g.pivot_distance * m)
            transfer[rows, body] += share * (g.coupler_height - g.link_height)
            transfer[rows, -1] = share * (g.centre_height - g.coupler_height) * mass
            transfer[rows, rows] += tilt
    return transfer


def axle_loads(
    transfer: FloatArray, static: ArrayLike, forces: ArrayLike, specific_force: ArrayLike
) -> FloatArray:
    """Loads of the axles [N], at least `LEAST_LOAD` of the static ones.

    Parameters
    ----------
    transfer : (axles, axles + 1) array
        Of `load_transfer`.
    static : float or (axles,) array [N]
        Loads of the train at rest on the level.
    forces : (..., axles) array [N]
        Between rail and axles, positive in traction.
    specific_force : (...) array [m/s²]
        Acceleration and what the gradient takes: ``a + g sin alpha``.

    Examples
    --------
    >>> transfer = load_transfer(AxleGeometry(2.7, 9.0, 0.6, 1.0, 1.6), 4, 84e3)
    >>> loads = axle_loads(transfer, 206e3, np.full(4, 60e3), 0.3)
    >>> (loads / 1e3).round(1).tolist(), round(float(loads.sum()) / 1e3)
    ([173.2, 226.5, 185.5, 238.8], 824)
    """
    pull, force = np.asarray(forces, dtype=np.float64), np.asarray(specific_force)
    changed = np.asarray(static) + pull @ transfer[:, :-1].T + force[..., None] * transfer[:, -1]
    return np.asarray(np.maximum(changed, LEAST_LOAD * np.asarray(static)))


@dataclass(frozen=True, slots=True)
class Axles(Declared):
    """The powered axles.

    Attributes
    ----------
    count : int
    adhesive_mass : float [kg]
        Mass that rests on all powered axles together, empty train.
    wheel_radius : float [m]
    rotating_mass : float [kg]
        Inertia of one powered axle with its motor, over the wheel radius squared.
    geometry : AxleGeometry, optional
        What the load transfer between the axles follows from; None: not known.

    Examples
    --------
    >>> axles = Axles(count=2, adhesive_mass=32_000.0)
    >>> axles.adhesive_mass / axles.count
    16000.0
    """

    count: Annotated[int, Form(must=POSITIVE, stated="required")] = 4
    adhesive_mass: Annotated[float, Quantity("t", "kg", must=POSITIVE, stated="required")] = 64e3
    wheel_radius: Annotated[
        float,
        Quantity(
            "m", "m", (0.15, 1.3, "wheels have a radius of"), must=POSITIVE, stated="required"
        ),
    ] = 0.43
    rotating_mass: Annotated[
        float, Quantity("t", "kg", (5e-3, 20, "a powered axle has"), stated="required")
    ] = 2_000.0
    geometry: AxleGeometry | None = None

    def __str__(self) -> str:
        return f"{self.count} powered axles"

    @classmethod
    def implausible(cls, values: Mapping[str, Any]) -> Iterator[InputError]:
        """What of the values of a file [SI] cannot be meant together."""
        if "adhesive_mass" in values and "count" in values:
            each = values["adhesive_mass"] / values["count"]
            yield from _AXLE_LOAD.implausible(each, "adhesive_mass")


_AXLE_LOAD = Quantity("t", "kg", (2, 40, "an axle carries"))
"""Mass on one powered axle."""


@dataclass(frozen=True, slots=True)
class Brake(Declared):
    """How the friction brake follows its demand: dead time, then a first-order lag [s].

    Examples
    --------
    >>> Brake(dead_time=1.0, lag=0.8)
    Brake(dead_time=1.0, lag=0.8)
    """

    dead_time: Annotated[float, _DELAY] = 0.6
    lag: Annotated[float, _DELAY] = 0.4


BRAKING_PARAMETERS = {
    "K_dry_rst": Quantity("1", "1"),
    "K_wet_rst": Quantity("1", "1"),
    "T_traction": Quantity("s", "s"),
    "T_be": Quantity("s", "s"),
    "v_uncertainty": Quantity("%", "%"),
    "T_bs": Quantity("s", "s"),
}
"""ETCS braking parameters of a train by their published names, in their published units."""

DecelerationCurve = Annotated[
    tuple[tuple[float, float], ...],
    Table((Column("speed", "km/h", "m/s"), Column("deceleration", "m/s^2", "m/s^2"))),
]
"""Pairs of speed [m/s] and deceleration [m/s²]."""


@dataclass(frozen=True, slots=True)
class BrakingCurves:
    """ETCS braking data of the train, kept as published.

    Attributes
    ----------
    emergency, service : tuple of (speed [m/s], deceleration [m/s²])
    parameters : dict of str to float
        The remaining published constants by their published names, in the file's units.
    """

    emergency: DecelerationCurve = ()
    service: DecelerationCurve = ()
    parameters: Annotated[dict[str, float], Named(BRAKING_PARAMETERS)] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, repr=False)
class Train(Declared):
    """A train.

    Units can be replaced by any of the same kind: kg for t, m/s for km/h.

    Attributes
    ----------
    name : str
    mass : float [kg]
        Empty, without the rotating part.
    rotating_mass_factor : float
        Inertia of all rotating parts over the empty mass (rho).
    resistance : RunningResistance
        r0 + r1 v + r2 v^2 on straight, level, open track.
    max_tractive_effort, max_traction_power : float [N], [W]
        At the wheel rims; bounds of the curve where there is one.
    max_dynamic_braking_effort, max_dynamic_braking_power : float [N], [W]
        Of the motors; 0 if there is no such brake.
    traction_curve, dynamic_braking_curve : EffortCurve or None
        Efforts over speed at the wheel rims; without a curve the effort is limited by the largest
        effort and the power alone.
    max_pneumatic_braking_effort : float [N]
        Of the friction brake.
    max_speed : float [m/s]
    max_acceleration, max_deceleration : float [m/s²]
        What the train's control allows.
    efficiency_traction, efficiency_regeneration : float
        Between the wheel rims and the line (or the tank).
    max_load : float [kg]
        Heaviest load of passengers or freight.
    length : float [m]
        Gradients are averaged over it where `mass_model` is "homogeneous_strip".
    tunnel_resistance : tuple of (cross-section [m²], extra quadratic term [N/(m/s)²])
        Added to r2, by the tunnel's cross-section.
    axles : Axles
        The powered axles: the mass on all of them together, the rotating mass of one.
    brake : Brake
        The friction brake follows its demand after a dead time, then with a lag.
    braking_curves : BrakingCurves or None
        ETCS braking data as published.
    mass_model : {"mass_point", "homogeneous_strip"}
        Where the mass is for gradients and curves: at the train's front, or spread evenly over its
        length, so that they are averaged under it; Brünger and Dahlhaus (2014), in *Railway
        Timetabling & Operations*.
    acceleration_limits : {"gross", "net"}
        What `max_acceleration` and `max_deceleration` limit: the effort over the inertia, whatever
        resists; or the train's own acceleration, on a gradient and in a curve, too.
    source : str
        Where the data come from.
    assumed : tuple of str
        Fields that the source does not give: they hold assumptions.

    Examples
    --------
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> train.tractive_effort_limit([0.0, 30.0]).round(-3).tolist()
    [200000.0, 87000.0]
    """

    FORMAT: ClassVar[str] = "trainlog/train"
    ORDER: ClassVar[tuple[str, ...]] = (
        "name", "source", "assumed", "mass", "rotating_mass_factor", "length", "max_load", "seats",
        "coaches", "running_resistance", "tunnel_resistance", "max_speed", "max_acceleration",
        "max_deceleration",
    )  # fmt: skip

    name: Annotated[str, Text(least=1, usual="Example unit")]
    mass: Annotated[
        float,
        Quantity(
            "t", "kg", (5, 2e4, "trains have"), must=POSITIVE, usual=120e3, shown="mass: {} empty"
        ),
    ]
    rotating_mass_factor: Annotated[
        float, Quantity("%", "1", (0.1, 60, "rotating parts add"), must=NOT_NEGATIVE, usual=0.08)
    ]
    resistance: Annotated[
        RunningResistance,
        Part(
            key="running_resistance",
            usual=RunningResistance(2_300.0, 61.2, 12.0),
            shown="resistance",
        ),
    ]
    max_tractive_effort: Annotated[
        float, Quantity("kN", "N", _EFFORT, must=POSITIVE, usual=200e3, shown="traction")
    ]
    max_traction_power: Annotated[
        float,
        Quantity("kW", "W", (10, 1e5, "trains have"), must=POSITIVE, usual=2.6e6, shown="traction"),
    ]
    max_dynamic_braking_effort: Annotated[
        float,
        Quantity(
            "kN", "N", _BRAKING, must=NOT_NEGATIVE, stated="required", usual=150e3,
            shown="brakes: {} dynamic",
        ),
    ] = 0.0  # fmt: skip
    max_dynamic_braking_power: Annotated[
        float,
        Quantity(
            "kW", "W", (1, 2e5, "trains have"), must=NOT_NEGATIVE, stated="required", usual=2.6e6
        ),
    ] = 0.0
    max_pneumatic_braking_effort: Annotated[
        float,
        Quantity(
            "kN", "N", (0.1, 5e4, "trains have"), must=NOT_NEGATIVE, stated="required",
            usual=200e3, shown="brakes: {} pneumatic",
        ),
    ] = 0.0  # fmt: skip
    max_speed: Annotated[
        float,
        Quantity(
            "km/h", "m/s", (5, 650, "trains run"), must=POSITIVE, stated="required",
            usual=160.0 / KMH, shown="speed: {} at most",
        ),
    ] = 100.0  # fmt: skip
    max_acceleration: Annotated[
        float,
        Quantity(
            "m/s^2", "m/s^2", (0.005, 4, "trains reach"), must=POSITIVE, stated="required",
            usual=1.0, shown="acceleration: {} at most",
        ),
    ] = 1.0  # fmt: skip
    max_deceleration: Annotated[
        float,
        Quantity(
            "m/s^2", "m/s^2", (0.02, 6, "trains reach"), must=POSITIVE, stated="required",
            usual=1.0, shown="acceleration: {} braking",
        ),
    ] = 1.0  # fmt: skip
    efficiency_traction: Annotated[
        float, Quantity("%", "1", must=POSITIVE_SHARE, stated="required", usual=0.87)
    ] = 1.0
    efficiency_regeneration: Annotated[
        float, Quantity("%", "1", must=SHARE, stated="required", usual=0.8)
    ] = 0.0
    max_load: Annotated[
        float,
        Quantity(
            "t", "kg", (0.05, 2e4, "trains carry"), must=NOT_NEGATIVE, usual=20e3,
            shown="mass: {} load at most",
        ),
    ] = 0.0  # fmt: skip
    length: Annotated[
        float,
        Quantity("m", "m", (5, 8e3, "trains have"), must=NOT_NEGATIVE, usual=75.0, shown="length"),
    ] = 0.0
    tunnel_resistance: Annotated[
        tuple[tuple[float, float], ...],
        Table(
            (
                Column("cross_section", "m^2", "m^2"),
                Column("coefficient", "kN/(km/h)^2", "N/(m/s)^2"),
            ),
            usual=((45.0, 5.184),),
        ),
    ] = ()
    axles: Annotated[
        Axles,
        Part(stated="required", usual=Axles(4, 68_000.0, 0.43, 1_500.0), shown="axles"),
    ] = Axles()
    brake: Annotated[Brake, Part(stated="required", usual=Brake(0.6, 0.5))] = Brake()
    braking_curves: BrakingCurves | None = None
    traction_curve: Annotated[
        EffortCurve | None,
        Table(
            usual=EffortCurve(
                [0.0, 13.0, 100.0 / KMH, 160.0 / KMH], [200e3, 200e3, 93.6e3, 58.5e3]
            ),
            shown="traction: curve of {} speeds",
        ),
    ] = None
    dynamic_braking_curve: Annotated[
        EffortCurve | None,
        Table(
            usual=EffortCurve(
                np.array([0.0, 8.0, 62.4, 160.0]) / KMH, np.array([0.0, 150e3, 150e3, 58.5e3])
            ),
            shown="brakes: curve of {} speeds",
        ),
    ] = None
    seats: Annotated[int | None, Form(must=POSITIVE)] = None
    coaches: Annotated[int | None, Form(must=POSITIVE)] = None
    source: Annotated[
        str, Text(stated="written", usual="template: replace every value by your train's")
    ] = ""
    assumed: Annotated[tuple[str, ...], Many(shown="assumed")] = ()
    mass_model: MassModel = "mass_point"
    acceleration_limits: AccelerationLimits = "gross"

    def problems(self) -> Iterator[InputError]:
        """What no train can be, besides fields beyond their bounds, one by one."""
        where = f"train '{self.name}'"
        if self.mass_model == "homogeneous_strip" and self.length == 0.0:
            yield InputError(
                f"{where}: a homogeneous_strip has a length, and none is given",
                remedy="give 'length', or the mass_model 'mass_point'",
            )
        try:
            if self.axles.geometry is not None:
                self.axles.geometry.vehicles(self.axles.count)
        except InputError as error:
            yield InputError(
                f"{where}: {error.problem}", place="axles.geometry", remedy=error.remedy
            )
        if self.traction_curve is not None and not self.traction_curve.efforts[0] > 0.0:
            yield InputError(
                f"{where}: has no tractive effort at standstill",
                place="traction_curve",
                remedy="give the effort at 0 km/h",
            )
        speeds = np.linspace(0.0, self.max_speed, 101)
        negative = self.resistance(speeds) < 0.0
        if np.any(negative):
            yield InputError(
                f"{where}: running resistance is negative at"
                f" {KMH * speeds[np.argmax(negative)]:.0f} km/h",
                place="running_resistance",
                remedy=f"check the signs and units of {', '.join(TERMS[:-1])} and {TERMS[-1]}",
            )

    @classmethod
    def implausible(cls, values: Mapping[str, Any]) -> Iterator[InputError]:
        """What of the values of a file [SI] cannot be meant together."""
        for name, stated in (
            ("traction_curve", "max_tractive_effort"),
            ("dynamic_braking_curve", "max_dynamic_braking_effort"),
        ):
            curve, effort = values.get(name), values.get(stated) or 0.0
            if curve is None:
                continue
            top = float(np.max(curve.efforts))
            if effort > 0.0 and not effort / MOST_BESIDE <= top <= effort * MOST_BESIDE:
                yield InputError(
                    f"its largest effort, {top / 1e3:.6g} kN, contradicts {stated},"
                    f" {effort / 1e3:.6g} kN",
                    place=name,
                    remedy="check the units of both (N or kN)",
                )
            yield from form_for(cls, "max_speed").implausible(float(np.max(curve.speeds)), name)
        mass = values.get("mass") or 0.0
        if mass > 0.0:
            yield from _against_mass(values, mass)

    @property
    def strip_length(self) -> float:
        """Length over which gradients and curves are averaged [m]; 0 for a mass point."""
        return self.length if self.mass_model == "homogeneous_strip" else 0.0

    @property
    def rotating_mass(self) -> float:
        """Inertia of the rotating parts, as a mass [kg]; the load does not change it."""
        return self.rotating_mass_factor * self.mass

    @property
    def max_braking_effort(self) -> float:
        """Dynamic and friction brake together [N]."""
        return self.max_dynamic_braking_effort + self.max_pneumatic_braking_effort

    def tractive_effort_limit(self, speed: ArrayLike, power: float | None = None) -> FloatArray:
        """Largest tractive effort [N] at each speed [m/s]: of the curve, the motors, the power.

        Parameters
        ----------
        speed : array [m/s]
        power : float, optional [W]
            Of a configuration, instead of the train's; the curve is stretched with it.

        Examples
        --------
        >>> from trainlog.formats.railway import read_train
        >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
        >>> train.tractive_effort_limit([0.0, 26.0]).tolist()
        [200000.0, 100000.0]
        """
        power = self.max_traction_power if power is None else power
        v = np.maximum(np.asarray(speed, dtype=np.float64), 1e-9)
        limit = np.asarray(np.minimum(self.max_tractive_effort, power / v))
        curve = self.traction_curve_with(power)
        return limit if curve is None else np.minimum(limit, curve(speed))

    def dynamic_braking_effort_limit(self, speed: ArrayLike) -> FloatArray:
        """Largest effort of the dynamic brake [N] at each speed [m/s].

        Examples
        --------
        >>> from trainlog.formats.railway import read_train
        >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
        >>> train.dynamic_braking_effort_limit([10.0, 26.0]).tolist()
        [200000.0, 100000.0]
        """
        v = np.maximum(np.asarray(speed, dtype=np.float64), 1e-9)
        limit = np.minimum(self.max_dynamic_braking_effort, self.max_dynamic_braking_power / v)
        curve = self.dynamic_braking_curve
        return np.asarray(limit if curve is None else np.minimum(limit, curve(speed)))

    def traction_curve_with(self, power: float) -> EffortCurve | None:
        """The curve of a configuration of this train that has a power [W] of its own.

        A train that has a share of the power reaches each effort up to that share of the speed:
        where power alone limits the effort this is ``power / v``.
        """
        curve = self.traction_curve
        return None if curve is None else curve.stretched(power / self.max_traction_power)

    def tunnel_coefficient(self, cross_section: ArrayLike) -> FloatArray:
        """Extra quadratic resistance [N/(m/s)²] in a tunnel of each cross-section [m²].

        Between published cross-sections it is interpolated in the inverse of the section, and
        extrapolated to 0 for the open (section 0).
        """
        section = np.asarray(cross_section, dtype=np.float64)
        if not self.tunnel_resistance:
            return np.zeros(section.shape)
        known = np.array(sorted(self.tunnel_resistance))
        inverse = 1.0 / np.maximum(section, 1e-9)
        found = np.interp(
            inverse,
            np.concatenate(([0.0], 1.0 / known[::-1, 0])),
            np.concatenate(([0.0], known[::-1, 1])),
        )
        return np.where(section > 0.0, found, 0.0)

    def unknown_tunnels(self, line: Line, start: float = 0.0, end: float = np.inf) -> list[str]:
        """That tunnels between two positions [m] add no resistance, where the train states none."""
        ends = [(each.position, each.position + each.length) for each in line.tunnels]
        length = sum(max(min(last, end) - max(first, start), 0.0) for first, last in ends)
        if self.tunnel_resistance or not length:
            return []
        return [
            f"{length / 1e3:.1f} km of tunnels add no resistance: the train file has no"
            " tunnel_resistance; 'trainlog fit' of trips through them states it"
        ]

    def track_force(self, line: Line, position: ArrayLike, mass: float) -> FloatArray:
        """Resistance of the track [N] that does not depend on speed: gradient and curves."""
        return np.asarray(mass * line.track_acceleration(position, self.strip_length))

    def adhesive_weight(self, load: float = 0.0) -> float:
        """Weight on the powered axles [N] with `load` [kg] spread evenly over the train."""
        return GRAVITY * self.axles.adhesive_mass * (1.0 + load / self.mass)

    def load_transfer(self, load: float = 0.0) -> FloatArray | None:
        """`load_transfer` with `load` [kg]; None: not known."""
        axles = self.axles
        if axles.geometry is None:
            return None
        adhesive_mass = axles.adhesive_mass * (1.0 + load / self.mass)
        return load_transfer(axles.geometry, axles.count, adhesive_mass)


def _against_mass(values: Mapping[str, Any], mass: float) -> Iterator[InputError]:
    """What does not go with a plausible mass [kg]."""
    axles, speed = values.get("axles"), values.get("max_speed") or 0.0
    adhesive = mass if axles is None else axles.adhesive_mass
    if adhesive > 1.001 * mass:
        yield InputError(
            f"{adhesive / 1e3:.6g} t on the powered axles are more than the train's mass of"
            f" {mass / 1e3:.6g} t",
            place="axles.adhesive_mass",
            remedy="give what rests on all powered axles together, train empty",
        )
    for name, share, carried, carrier in (
        ("max_tractive_effort", MOST_ADHESION, adhesive, "the powered axles"),
        ("max_dynamic_braking_effort", MOST_ADHESION, adhesive, "the powered axles"),
        ("max_pneumatic_braking_effort", MOST_BRAKING, mass, "the train"),
    ):
        effort, weight = values.get(name) or 0.0, GRAVITY * carried
        if effort > share * weight > 0.0:
            yield InputError(
                f"{effort / 1e3:.6g} kN is not plausible: it is {effort / weight:.3g} times the"
                f" weight on {carrier}, {weight / 1e3:.6g} kN",
                place=name,
                remedy="check the effort, the mass and their units (N or kN, kg or t)",
            )
    power = (values.get("max_traction_power") or 0.0) / mass
    yield from _SPECIFIC_POWER.implausible(power, "max_traction_power")
    if values.get("resistance") is not None and speed > 0.0:
        over_weight = float(values["resistance"](speed)) / (GRAVITY * mass)
        yield from _RESISTANCE_OVER_WEIGHT.implausible(over_weight, "running_resistance")


MOST_LOAD = 1.5
"""Times the mass of the empty train, that a load reaches at most where the train states no more."""


def check_load(load: float, train: Train | None = None) -> None:
    """Refuse a load [kg] that cannot be meant: of any train, or of the one that is known.

    Raises
    ------
    InputError
        That names the load, what is plausible, and the likely cause.

    Examples
    --------
    >>> check_load(11_700.0)
    >>> check_load(11.7)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: load: 0.0117 t is not plausible: trains carry 0.05 to 20000 t; ...
    """
    form = form_for(Train, "max_load")
    for problem in form.implausible(load, "load"):
        raise problem
    most = np.inf if train is None else max(MOST_LOAD * train.mass, train.max_load)
    if not 0.0 <= load <= most:
        against = f" for a train of {form.words(train.mass)}" if train is not None else ""
        raise InputError(
            f"load {form.words(load)} is not plausible{against}",
            remedy="is it the mass of the loaded train, or is its unit another than kg?",
        )


@dataclass(frozen=True, slots=True)
class Configuration(Declared):
    """One observed parameter configuration alpha of a train; Cunillera et al. (2022).

    Attributes
    ----------
    name : str
        Usually the trip it was observed on.
    mass : float [kg]
        Loaded, without the rotating part.
    rotating_mass : float [kg]
    resistance : RunningResistance
    max_power : float [W]
        Traction power at the wheel rims.

    Examples
    --------
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> loaded = Configuration.of(train, load=10_000.0, name="loaded")
    >>> loaded.mass - train.mass, loaded.inertia > loaded.mass
    (10000.0, True)
    """

    ORDER: ClassVar[tuple[str, ...]] = ("name", "mass", "rotating_mass", "max_power")

    name: str
    mass: Annotated[float, Quantity("kg", "kg", must=POSITIVE)]
    rotating_mass: Annotated[float, Quantity("kg", "kg", must=NOT_NEGATIVE)]
    resistance: Annotated[RunningResistance, Part(key="running_resistance", in_si=True)]
    max_power: Annotated[float, Quantity("W", "W", must=POSITIVE)]

    def problems(self) -> Iterator[InputError]:
        """A running resistance that no train has."""
        speeds = np.linspace(0.0, 60.0, 61)
        drag = self.resistance(speeds)
        if np.any(drag < 0.0):
            at = speeds[int(np.argmax(drag < 0.0))]
            yield InputError(
                f"configuration '{self.name}': running resistance is negative at"
                f" {KMH * at:.0f} km/h",
                remedy="a fit outside its supported speed range; fit again with more speeds",
            )

    @property
    def inertia(self) -> float:
        """Mass that resists acceleration [kg]."""
        return self.mass + self.rotating_mass

    @staticmethod
    def of(train: Train, load: float = 0.0, name: str = NOMINAL) -> Configuration:
        """The configuration that the train's own file describes, with `load` [kg].

        Examples
        --------
        >>> from trainlog.formats.railway import read_train
        >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
        >>> Configuration.of(train, load=8_000.0).inertia
        142200.0

        Raises
        ------
        InputError
            If the load is negative.
        """
        problem = form_for(Train, "max_load").refused(load, "load")
        if problem is not None:
            raise problem
        return Configuration(
            name, train.mass + load, train.rotating_mass, train.resistance, train.max_traction_power
        )


CONFIGURATION_COLUMNS = (
    presentation.Column("configuration", of="name"),
    presentation.Column("mass", MASS, each=True),
    presentation.Column("power", POWER, each=True, of="max_power"),
    *(
        presentation.Column(
            f"{name}, {unit.replace('^2', '²')}",
            presentation.Quantity(suffix, "", 1.0, digits),
            key=name,
            of=attrgetter(f"resistance.{name}"),
        )
        for digits, (name, unit, suffix) in enumerate(zip(TERMS, UNITS, SUFFIXES, strict=True))
    ),
    presentation.Column(
        "at 80 km/h",
        FORCE,
        key="resistance_at_80_km_h",
        of=lambda each: float(each.resistance(80.0 / KMH)),
    ),
)
"""Of a `Configuration`."""


@dataclass(frozen=True, eq=False, repr=False)
class ParameterSet(Declared):
    """The observed set of configurations of a train, and the fit of all its trips together.

    Attributes
    ----------
    train : str
    configurations : tuple of Configuration
    common : RunningResistance or None
        All trips together.
    common_covariance : (3, 3) array or None
        Of the coefficients of `common`.
    speed_range : (float, float) [m/s]
        Speeds that the data support.
    details : list of dict
        One entry a configuration: the trip it was observed on and the SHA-256 of its log, how many
        trips it stands for, standard deviations, condition; and refusals.
    cover : dict
        Share of trips whose running times and energies the set bounds: ``asked`` for, and
        ``level`` reached; ``trips`` fitted, and ``refused`` by reason. Empty if it was not said.

    Examples
    --------
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> empty, full = (Configuration.of(train, load, f"{load:.0f} kg") for load in (0.0, 2e4))
    >>> found = ParameterSet(train.name, (empty, full))
    >>> [each.name for each in found.configurations]
    ['0 kg', '20000 kg']
    """

    charts_by: ClassVar[str] = "analysis.resistance.plot:set_charts"
    FORMAT: ClassVar[str] = "trainlog/parameters"
    ORDER: ClassVar[tuple[str, ...]] = ("train", "speed_range")

    train: str
    configurations: tuple[Configuration, ...]
    common: Annotated[RunningResistance | None, Part(in_si=True)] = None
    common_covariance: Annotated[
        FloatArray | None,
        Covariance(tuple(zip(TERMS, UNITS, strict=True))),
    ] = None
    speed_range: Annotated[tuple[float, float], Ends(Quantity("m/s", "m/s"), stated="required")] = (
        0.0,
        0.0,
    )
    details: Annotated[list[dict[str, Any]], Many(stated="written")] = field(default_factory=list)
    provenance: Annotated[dict[str, Any], Form(stated="written")] = field(default_factory=dict)
    cover: Annotated[dict[str, Any], Form(stated="written")] = field(default_factory=dict)

    @property
    def weights(self) -> tuple[float, ...]:
        """How many trips each configuration stands for; empty where that was not noted."""
        known = {str(each.get("configuration")): each.get("stands_for") for each in self.details}
        found = [known.get(each.name) for each in self.configurations]
        if not all(isinstance(count, (int, float)) for count in found):
            return ()
        return tuple(float(count) for count in found if count is not None)

    @property
    def assumed_power(self) -> str:
        """The sentence that no trip shows the power; empty where one does, or nothing is noted.

        Examples
        --------
        >>> from trainlog.railway.train import POWER_OF_FILE
        >>> import trainlog
        >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
        >>> noted = [{"accepted": True, "max_power": POWER_OF_FILE}]
        >>> found = ParameterSet(train.name, (Configuration.of(train),), details=noted)
        >>> found.assumed_power  # doctest: +ELLIPSIS
        'no trip shows its full power; 2600 kW from the train file (a recorded lever or...'
        """
        sources = {each.get("max_power") for each in self.details if each.get("accepted")}
        if sources != {POWER_OF_FILE}:
            return ""
        powers = span([each.max_power for each in self.configurations], 1e-3)
        return (
            f"no trip shows its full power; {powers} kW from the train file (a recorded lever or"
            " effort demand shows it)"
        )

    def check_train(self, train: str) -> None:
        """Refuse to be used for another train.

        Raises
        ------
        InputError
            If the set was observed on a train of another name.
        """
        if self.train != train:
            raise InputError(
                f"the parameter set was observed on train '{self.train}', not on '{train}'",
                remedy="give that train, or fit its own logs",
            )

    @property
    def title(self) -> str:
        """The train."""
        return f"Parameter set of train '{self.train}'"

    def tables(self) -> list[WordTable]:
        """A row per configuration."""
        return [
            new_table(self.title, *CONFIGURATION_COLUMNS, name="configurations").add_rows(
                self.configurations
            )
        ]

    def summary(self) -> dict[str, str]:
        """Configurations, their spread, and all trips together."""
        every = self.configurations
        rows = {"configurations": str(len(every))}
        if every:
            rows["mass"] = f"{span([c.mass for c in every], 1e-3, 1)} t"
            rows["power"] = f"{span([c.max_power for c in every], 1e-3)} kW"
            speeds = self.speed_range if self.speed_range[1] > 0.0 else (20.0, 20.0)
            at = 0.5 * (speeds[0] + speeds[1])
            drag = [float(c.resistance(at)) for c in every]
            rows["resistance"] = f"{span(drag, 1e-3, 2)} kN at {KMH * at:.0f} km/h"
        if self.common is not None:
            rows["together"] = str(self.common)
        return rows


# ------------------------------------------------------------------ vehicles


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

LENGTH = presentation.Quantity("m", "m")
STIFFNESS = presentation.Quantity("N_m", "MN/m", 1e-6)
DAMPING = presentation.Quantity("N_s_m", "kN s/m", 1e-3)
SLACK = presentation.Quantity("m", "mm", 1e3)


def _runs(things: Iterable[Thing]) -> list[tuple[str, Thing]]:
    """Each thing that differs from the one before, with the numbers of its equals."""
    found, first = [], 1
    for thing, group in groupby(things):
        last = first + len(list(group)) - 1
        found.append((f"{first}" if first == last else f"{first} to {last}", thing))
        first = last + 1
    return found


VEHICLES = (
    presentation.Column("number", of=lambda row: row[0]),
    presentation.Column("vehicle", of=lambda row: row[1].name),
    presentation.Column("mass", MASS, of=lambda row: row[1].mass),
    presentation.Column("length", LENGTH, of=lambda row: row[1].length),
    presentation.Column("traction", FORCE, of=lambda row: row[1].max_tractive_effort or None),
    presentation.Column(
        "power",
        POWER,
        of=lambda row: row[1].max_traction_power if row[1].max_tractive_effort else None,
    ),
    presentation.Column("braking", FORCE, of=lambda row: row[1].max_braking_effort or None),
)
"""Of the table of vehicles, by their numbers."""

COUPLERS = (
    presentation.Column("number", of=lambda row: row[0]),
    presentation.Column("draft", STIFFNESS, of=lambda row: row[1].draft[0]),
    presentation.Column("1/m²", key="draft_progressive_per_m2", of=lambda row: row[1].draft[1]),
    presentation.Column("buff", STIFFNESS, of=lambda row: row[1].buff[0]),
    presentation.Column("1/m²", key="buff_progressive_per_m2", of=lambda row: row[1].buff[1]),
    presentation.Column("damping", DAMPING, of=lambda row: row[1].damping),
    presentation.Column("slack", SLACK, of=lambda row: row[1].slack),
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
            yield InputError(
                f"consist '{self.name}': needs at least one vehicle",
                remedy="list its vehicles from the front to the rear",
            )
        elif len(self.couplers) != len(self.vehicles) - 1:
            yield InputError(
                f"consist '{self.name}': {len(self.vehicles)} vehicles need"
                f" {len(self.vehicles) - 1} couplers, given are {len(self.couplers)}",
                remedy="give one coupler between two vehicles",
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
