"""A train whose driving lever scales one curve of effort, as Hauck et al. (2023) have it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trainlog.errors import InputError
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import Axles, Train
from trainlog.units import GRAVITY

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LeverTrain:
    """``m dv/dt = -F_r(v) + F_train(v) u``, the lever u in [-1, 1]; eq. (1) to (3).

    Attributes
    ----------
    name : str
    mass : float [kg]
        Empty, the least of eq. (6).
    max_load : float [kg]
    air_density : float [kg/m³]
    drag_coefficient : float
    frontal_area : float [m²]
    rolling_coefficient : float
        c_R, rolling resistance over weight.
    k1, k2, k3 : float [N], [s/m], [N]
        Of the effort at full lever, ``F_train(v) = k1 exp(-k2 v) + k3``, traction and braking.
    max_acceleration : float [m/s²]
        a_max of eq. (4), comfort in traction and in braking.
    max_speed : float [m/s]
    source : str

    Raises
    ------
    InputError
        If a value is negative, or one that must be positive is not.
    """

    name: str
    mass: float
    max_load: float
    air_density: float
    drag_coefficient: float
    frontal_area: float
    rolling_coefficient: float
    k1: float
    k2: float
    k3: float
    max_acceleration: float = 1.0
    max_speed: float = 120.0 / 3.6
    source: str = ""

    def __post_init__(self) -> None:
        where = f"train '{self.name}'"
        for name in ("mass", "k3", "max_acceleration", "max_speed"):
            if not (getattr(self, name) > 0.0 and np.isfinite(getattr(self, name))):
                raise InputError(f"{where}: {name} {getattr(self, name)} is not positive")
        for name in ("max_load", "k1", "k2"):
            if not (getattr(self, name) >= 0.0 and np.isfinite(getattr(self, name))):
                raise InputError(f"{where}: {name} {getattr(self, name)} is negative")
        for name in ("air_density", "drag_coefficient", "frontal_area", "rolling_coefficient"):
            if not (getattr(self, name) >= 0.0 and np.isfinite(getattr(self, name))):
                raise InputError(
                    f"{where}: {name} {getattr(self, name)} is negative",
                    remedy="running resistance never drives a train; check sign and unit",
                )

    @property
    def max_mass(self) -> float:
        """Loaded, the greatest of eq. (6) [kg]."""
        return self.mass + self.max_load

    @property
    def drag(self) -> float:
        """``1/2 rho c A`` [N/(m/s)²]."""
        return 0.5 * self.air_density * self.drag_coefficient * self.frontal_area

    def full_effort(self, speed: ArrayLike) -> FloatArray:
        """Effort of the full lever, F_train [N], at each speed [m/s]."""
        return np.asarray(self.k1 * np.exp(-self.k2 * np.asarray(speed, dtype=float)) + self.k3)

    def resistance(self, mass: float) -> RunningResistance:
        """Running resistance on level track at a mass [kg], eq. (2) without wind."""
        return RunningResistance(self.rolling_coefficient * mass * GRAVITY, 0.0, self.drag)

    def check_mass(self, mass: float) -> None:
        """Refuse a mass [kg] that the train cannot have.

        Raises
        ------
        InputError
        """
        if not self.mass <= mass <= self.max_mass:
            raise InputError(
                f"train '{self.name}' cannot weigh {mass / 1e3:g} t",
                remedy=f"it weighs {self.mass / 1e3:g} t empty and {self.max_mass / 1e3:g} t full",
            )

    def on_axles(self, axles: int = 6, rotating_mass: float = 800.0) -> Train:
        """The same train with driven and braked axles, for simulation.

        Eq. (5) lets the whole weight count as adhesive, so all axles are driven, and the dynamic
        brake gives all of the effort. Power is the most that the lever's curve asks for.

        Parameters
        ----------
        axles : int
        rotating_mass : float [kg]
            Of each axle.
        """
        speeds = np.linspace(0.0, self.max_speed, 400)
        power = float(np.max(speeds * self.full_effort(speeds)))
        effort = self.k1 + self.k3
        return Train(
            name=self.name,
            mass=self.mass,
            rotating_mass_factor=axles * rotating_mass / self.mass,
            resistance=self.resistance(self.mass),
            max_tractive_effort=effort,
            max_traction_power=power,
            max_dynamic_braking_effort=effort,
            max_dynamic_braking_power=power,
            max_speed=self.max_speed,
            max_acceleration=self.max_acceleration,
            max_deceleration=self.max_acceleration,
            max_load=self.max_load,
            axles=Axles(count=axles, adhesive_mass=self.mass, rotating_mass=rotating_mass),
            source=self.source,
            assumed=("axles", "rotating_mass_factor", "max_speed"),
        )


PUBLISHED_TRAIN = LeverTrain(
    name="train of Hauck et al. (2023)",
    mass=68_200.0,
    max_load=20_500.0,
    air_density=1.2041,
    drag_coefficient=0.85,
    frontal_area=10.0,
    rolling_coefficient=0.002,
    k1=1.516e5,
    k2=0.1147,
    k3=1.564e4,
    source="Hauck et al. (2023), Table I; a_max is not published, 1 m/s² chosen",
)
"""Table I, with density and drag coefficient in their places."""

NOMINAL_MASS = 78_200.0
"""What the paper's controller takes the train to weigh [kg]."""
