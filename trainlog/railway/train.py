"""A train as its file describes it, and the configurations that it was observed in on trips."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.display import as_html, as_text, span
from trainlog.errors import InputError
from trainlog.railway.axle_loads import AxleGeometry, load_transfer
from trainlog.railway.effort import EffortCurve
from trainlog.railway.line import Line
from trainlog.railway.resistance import RunningResistance
from trainlog.units import GRAVITY, KMH

MassModel = Literal["mass_point", "homogeneous_strip"]
AccelerationLimits = Literal["gross", "net"]

POWER_OF_FILE = "train file"
"""Where the power of a configuration is from that no trip showed (`ParameterSet.details`)."""

NOMINAL = "nominal"
"""Configuration of a train as its file describes it."""


@dataclass(frozen=True, slots=True)
class Axles:
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

    count: int = 4
    adhesive_mass: float = 64_000.0
    wheel_radius: float = 0.43
    rotating_mass: float = 2_000.0
    geometry: AxleGeometry | None = None


@dataclass(frozen=True, slots=True)
class Brake:
    """How the friction brake follows its demand: dead time, then a first-order lag [s].

    Examples
    --------
    >>> Brake(dead_time=1.0, lag=0.8)
    Brake(dead_time=1.0, lag=0.8)
    """

    dead_time: float = 0.6
    lag: float = 0.4


@dataclass(frozen=True, slots=True)
class BrakingCurves:
    """ETCS braking data of the train, kept as published.

    Attributes
    ----------
    emergency, service : tuple of (speed [m/s], deceleration [m/s²])
    parameters : dict of str to float
        The remaining published constants by their published names, in the file's units.
    """

    emergency: tuple[tuple[float, float], ...] = ()
    service: tuple[tuple[float, float], ...] = ()
    parameters: dict[str, float] = field(default_factory=dict)


_POSITIVE = (
    "mass",
    "max_tractive_effort",
    "max_traction_power",
    "max_speed",
    "max_acceleration",
    "max_deceleration",
    "efficiency_traction",
)


@dataclass(frozen=True, repr=False)
class Train:
    """A train.

    Attributes
    ----------
    name : str
    mass : float [kg]
        Empty, without the rotating part.
    rotating_mass_factor : float
        Inertia of all rotating parts over the empty mass (rho).
    resistance : RunningResistance
    max_tractive_effort, max_traction_power : float [N], [W]
        At the wheel rims; bounds of the curve where there is one.
    max_dynamic_braking_effort, max_dynamic_braking_power : float [N], [W]
    traction_curve, dynamic_braking_curve : EffortCurve or None
        Efforts over speed at the wheel rims; without a curve the effort is limited by the largest
        effort and the power alone.
    max_pneumatic_braking_effort : float [N]
    max_speed : float [m/s]
    max_acceleration, max_deceleration : float [m/s²]
        What the train's control allows.
    efficiency_traction, efficiency_regeneration : float
        Between the wheel rims and the line.
    max_load : float [kg]
        Heaviest load.
    length : float [m]
    tunnel_resistance : tuple of (cross-section [m²], extra quadratic term [N/(m/s)²])
    axles : Axles
    brake : Brake
    braking_curves : BrakingCurves or None
    mass_model : {"mass_point", "homogeneous_strip"}
        Where the mass is for gradients and curves: at the train's front, or spread evenly over its
        length, so that they are averaged under it; Brünger and Dahlhaus (2014), in *Railway
        Timetabling & Operations*.
    acceleration_limits : {"gross", "net"}
        What `max_acceleration` and `max_deceleration` limit: the effort over the inertia, whatever
        resists; or the train's own acceleration, on a gradient and in a curve, too.
    source : str
    assumed : tuple of str
        Fields that the source does not give: they hold assumptions.

    Examples
    --------
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> train.tractive_effort_limit([0.0, 30.0]).round(-3).tolist()
    [200000.0, 87000.0]
    """

    name: str
    mass: float
    rotating_mass_factor: float
    resistance: RunningResistance
    max_tractive_effort: float
    max_traction_power: float
    max_dynamic_braking_effort: float = 0.0
    max_dynamic_braking_power: float = 0.0
    max_pneumatic_braking_effort: float = 0.0
    max_speed: float = 100.0
    max_acceleration: float = 1.0
    max_deceleration: float = 1.0
    efficiency_traction: float = 1.0
    efficiency_regeneration: float = 0.0
    max_load: float = 0.0
    length: float = 0.0
    tunnel_resistance: tuple[tuple[float, float], ...] = ()
    axles: Axles = Axles()
    brake: Brake = Brake()
    braking_curves: BrakingCurves | None = None
    traction_curve: EffortCurve | None = None
    dynamic_braking_curve: EffortCurve | None = None
    seats: int | None = None
    coaches: int | None = None
    source: str = ""
    assumed: tuple[str, ...] = ()
    mass_model: MassModel = "mass_point"
    acceleration_limits: AccelerationLimits = "gross"

    def __post_init__(self) -> None:
        problems = list(self._problems())
        if problems:
            raise InputError.listing(problems)

    def _problems(self) -> Iterator[InputError]:
        """What no train can be, one by one."""
        where = f"train '{self.name}'"
        faulty = [name for name in _POSITIVE if not getattr(self, name) > 0.0]
        # What is assumed follows from what is given.
        for name in [name for name in faulty if name not in self.assumed] or faulty:
            yield InputError(
                f"{where}: {name} {getattr(self, name)} is not positive",
                remedy="give what this train has",
            )
        for name in (
            "rotating_mass_factor",
            "max_dynamic_braking_effort",
            "max_dynamic_braking_power",
            "max_pneumatic_braking_effort",
            "max_load",
            "length",
        ):
            if not getattr(self, name) >= 0.0:
                yield InputError(
                    f"{where}: {name} {getattr(self, name)} is negative", remedy="give 0 or more"
                )
        for name in ("efficiency_traction", "efficiency_regeneration"):
            share = getattr(self, name)
            if not 0.0 <= share <= 1.0 and (share > 0.0 or name not in _POSITIVE):
                yield InputError(
                    f"{where}: {name} {getattr(self, name)} is not between 0 and 1",
                    remedy="give it as a share, for example 90 %",
                )
        for name, kind in (("mass_model", MassModel), ("acceleration_limits", AccelerationLimits)):
            if getattr(self, name) not in get_args(kind):
                yield InputError(
                    f"{where}: no such {name} '{getattr(self, name)}'",
                    remedy=f"it is one of {', '.join(get_args(kind))}",
                )
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
                remedy="check the signs and units of r0, r1 and r2",
            )

    def __repr__(self) -> str:
        return as_text(f"Train '{self.name}'", self._summary())

    def _repr_html_(self) -> str:
        return as_html(f"Train '{self.name}'", self._summary())

    def _summary(self) -> dict[str, str]:
        r = self.resistance
        return {
            "mass": f"{self.mass / 1e3:.1f} t empty, {self.max_load / 1e3:.1f} t load at most",
            "traction": f"{self.max_tractive_effort / 1e3:.0f} kN,"
            f" {self.max_traction_power / 1e3:.0f} kW" + _points(self.traction_curve),
            "brakes": f"{self.max_dynamic_braking_effort / 1e3:.0f} kN dynamic,"
            f" {self.max_pneumatic_braking_effort / 1e3:.0f} kN pneumatic"
            + _points(self.dynamic_braking_curve),
            "resistance": f"{r.r0:.0f} N + {r.r1:.1f} N/(m/s) v + {r.r2:.2f} N/(m/s)² v²",
            "speed": f"{KMH * self.max_speed:.0f} km/h at most",
            "length": f"{self.length:.1f} m, {self.axles.count} powered axles"
            + ", mass spread over it" * (self.strip_length > 0.0),
        } | ({"assumed": ", ".join(self.assumed)} if self.assumed else {})

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
        >>> from trainlog.formats.train import read_train
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
        >>> from trainlog.formats.train import read_train
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

    def track_force(self, line: Line, position: ArrayLike, mass: float) -> FloatArray:
        """Resistance of the track [N] that does not depend on speed: gradient and curves."""
        return np.asarray(mass * line.track_acceleration(position, self.strip_length))

    def adhesive_weight(self, load: float = 0.0) -> float:
        """Weight on the powered axles [N] with `load` [kg] spread evenly over the train."""
        return GRAVITY * self.axles.adhesive_mass * (1.0 + load / self.mass)

    def load_transfer(self, load: float = 0.0) -> FloatArray | None:
        """`trainlog.railway.axle_loads.load_transfer` with `load` [kg]; None: not known."""
        axles = self.axles
        if axles.geometry is None:
            return None
        adhesive_mass = axles.adhesive_mass * (1.0 + load / self.mass)
        return load_transfer(axles.geometry, axles.count, adhesive_mass)


def _points(curve: EffortCurve | None) -> str:
    """How many points a curve has, in words."""
    return "" if curve is None else f", curve of {curve.speeds.size} speeds"


@dataclass(frozen=True, slots=True)
class Configuration:
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

    name: str
    mass: float
    rotating_mass: float
    resistance: RunningResistance
    max_power: float

    def __post_init__(self) -> None:
        if not (self.mass > 0.0 and self.rotating_mass >= 0.0 and self.max_power > 0.0):
            raise InputError(
                f"configuration '{self.name}': mass and power must be positive,"
                f" got {self.mass} kg and {self.max_power} W"
            )
        speeds = np.linspace(0.0, 60.0, 61)
        drag = self.resistance(speeds)
        if np.any(drag < 0.0):
            at = speeds[int(np.argmax(drag < 0.0))]
            raise InputError(
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
        >>> from trainlog.formats.train import read_train
        >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
        >>> Configuration.of(train, load=8_000.0).inertia
        142200.0
        """
        return Configuration(
            name, train.mass + load, train.rotating_mass, train.resistance, train.max_traction_power
        )


@dataclass(frozen=True, repr=False)
class ParameterSet:
    """The observed set of configurations of a train, and the fit of all its trips together.

    Attributes
    ----------
    train : str
    configurations : tuple of Configuration
    common : RunningResistance or None
        All trips together.
    common_covariance : (3, 3) array or None
        Of ``(r0, r1, r2)`` of `common`.
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

    train: str
    configurations: tuple[Configuration, ...]
    common: RunningResistance | None = None
    common_covariance: FloatArray | None = None
    speed_range: tuple[float, float] = (0.0, 0.0)
    details: list[dict[str, Any]] = field(default_factory=list)
    provenance: dict[str, Any] = field(default_factory=dict)
    cover: dict[str, Any] = field(default_factory=dict)

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
        >>> ParameterSet(train.name, (Configuration.of(train),), details=noted).assumed_power
        "no trip shows its power: the train file's 2600 kW is taken"
        """
        sources = {each.get("max_power") for each in self.details if each.get("accepted")}
        if sources != {POWER_OF_FILE}:
            return ""
        powers = span([each.max_power for each in self.configurations], 1e-3)
        return f"no trip shows its power: the train file's {powers} kW is taken"

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

    def __repr__(self) -> str:
        return as_text(f"Parameter set of train '{self.train}'", self._summary())

    def _repr_html_(self) -> str:
        return as_html(f"Parameter set of train '{self.train}'", self._summary())

    def _summary(self) -> dict[str, str]:
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
            r = self.common
            rows["together"] = f"{r.r0:.0f} N + {r.r1:.1f} N/(m/s) v + {r.r2:.2f} N/(m/s)² v²"
        return rows
