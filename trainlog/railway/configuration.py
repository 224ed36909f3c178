"""Parameter configurations: what one train was observed to be on one trip."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trainlog.display import as_html, as_text, span
from trainlog.errors import InputError
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import Train
from trainlog.units import KMH


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
                f" {3.6 * at:.0f} km/h",
                remedy="a fit outside its supported speed range; fit again with more speeds",
            )

    @property
    def inertia(self) -> float:
        """Mass that resists acceleration [kg]."""
        return self.mass + self.rotating_mass

    @staticmethod
    def of(train: Train, load: float = 0.0, name: str = "nominal") -> Configuration:
        """The configuration that the train's own file describes, with `load` [kg]."""
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
    """

    train: str
    configurations: tuple[Configuration, ...]
    common: RunningResistance | None = None
    common_covariance: NDArray[np.float64] | None = None
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
