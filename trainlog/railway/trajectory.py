"""A trajectory: what a train should do along the line, for every configuration it may be in."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trainlog.errors import InputError
from trainlog.railway.configuration import Configuration

FloatArray = NDArray[np.float64]

_ENERGY = {
    "wheel": "worst-case energy at the wheel rims",
    "line": "worst-case energy from the line",
    "expected": "expected energy from the line",
}
"""What an objective of the optimisation counts."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A robust trajectory between two stops.

    The braking effort is constant in each cell between two neighbouring positions, the tractive
    effort linear: where it takes all the power it falls as the speed rises.

    Attributes
    ----------
    line, train : str
    positions : (n + 1,) array [m]
    configurations : tuple of q Configuration
    speeds : (q, n + 1) array [m/s]
    times : (q, n + 1) array [s]
        Since departure.
    tractive_effort : (n,) array [N]
        The same for every configuration; its mean in each cell.
    braking_effort : (q, n) array [N]
        Equal rows where braking is common too.
    running_time : float [s]
        What the timetable allows.
    tractive_effort_fall : (n,) array [N]
        Tractive effort where the cell begins less that where it ends; empty stands for none.
    direction : {"forward", "reverse"}
        Of travel against the line file's chainage; `positions` grow in the direction of travel.
    certificate : dict
        Audit, lower bound and gap of the optimisation, and how it was obtained.
    provenance : dict
    """

    line: str
    train: str
    positions: FloatArray
    configurations: tuple[Configuration, ...]
    speeds: FloatArray
    times: FloatArray
    tractive_effort: FloatArray
    braking_effort: FloatArray
    running_time: float
    tractive_effort_fall: FloatArray = field(default_factory=lambda: np.zeros(0))
    direction: Literal["forward", "reverse"] = "forward"
    certificate: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.direction not in ("forward", "reverse"):
            raise InputError(f"trajectory: direction '{self.direction}' is unknown")
        q, n = len(self.configurations), self.positions.size - 1
        if self.tractive_effort_fall.size == 0:
            object.__setattr__(self, "tractive_effort_fall", np.zeros(n))
        expected = {
            "speeds": (q, n + 1),
            "times": (q, n + 1),
            "tractive_effort": (n,),
            "tractive_effort_fall": (n,),
            "braking_effort": (q, n),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise InputError(
                    f"trajectory: {name} has shape {getattr(self, name).shape}, needs {shape}"
                )

    def check(self, line: str, train: str) -> None:
        """Refuse to be used on another line or for another train.

        Raises
        ------
        InputError
            If line or train have other names than those it was made for.
        """
        for what, mine, other in (("line", self.line, line), ("train", self.train, train)):
            if mine != other:
                raise InputError(
                    f"the trajectory was made for {what} '{mine}', not for '{other}'",
                    remedy=f"give that {what}, or optimise for this one",
                )

    def index_of(self, configuration: str) -> int:
        """Row of the configuration called `configuration`.

        Raises
        ------
        InputError
            If the trajectory was not made for it.
        """
        for index, candidate in enumerate(self.configurations):
            if candidate.name == configuration:
                return index
        names = ", ".join(candidate.name for candidate in self.configurations)
        raise InputError(
            f"trajectory has no configuration '{configuration}'", remedy=f"it has: {names}"
        )

    def chosen(self, selection: str = "hardest") -> tuple[str, ...]:
        """Names of some configurations.

        Parameters
        ----------
        selection : str
            ``"all"``; names separated by commas; or ``"hardest"``: the largest and the smallest
            running resistance and the smallest power, all for the mass to be moved.

        Raises
        ------
        InputError
            If the trajectory was not made for a configuration so named.
        """
        every = self.configurations
        if selection == "all":
            return tuple(configuration.name for configuration in every)
        if selection != "hardest":
            names = (name.strip() for name in selection.split(","))
            return tuple(every[self.index_of(name)].name for name in names)
        cruising = float(np.max(self.speeds))
        drag = [float(c.resistance(cruising)) / c.inertia for c in every]
        power = [c.max_power / c.inertia for c in every]
        rows = (int(np.argmax(drag)), int(np.argmin(drag)), int(np.argmin(power)))
        return tuple(every[row].name for row in dict.fromkeys(rows))

    @property
    def objective(self) -> str:
        """What was minimised: ``"wheel"``, ``"line"`` or ``"expected"``."""
        return str(self.provenance.get("settings", {}).get("objective", "wheel"))

    @property
    def energy_label(self) -> str:
        """What the ``energy`` of the certificate is, and where it is taken, in words."""
        return _ENERGY.get(self.objective, "energy")

    @property
    def latest(self) -> int:
        """Row of the configuration that arrives last: its speeds all others can keep, too."""
        return int(np.argmax(self.times[:, -1]))

    def cell_of(self, position: ArrayLike) -> NDArray[np.int64]:
        """Index of the cell that holds each position [m]; ends are extended."""
        index = np.searchsorted(self.positions, np.asarray(position), side="right") - 1
        return np.asarray(np.clip(index, 0, self.positions.size - 2), dtype=np.int64)

    def tractive_effort_at(self, position: ArrayLike) -> FloatArray:
        """Tractive effort [N] at each position [m]."""
        cell, place = self.cell_of(position), np.asarray(position, dtype=np.float64)
        step = self.positions[cell + 1] - self.positions[cell]
        share = np.clip((place - self.positions[cell]) / step, 0.0, 1.0)
        return self.tractive_effort[cell] + self.tractive_effort_fall[cell] * (0.5 - share)

    def speed_at(self, row: int, position: ArrayLike) -> FloatArray:
        """Reference speed [m/s] of configuration `row` at each position [m].

        Between nodes the speed squared is linear in position, as constant effort makes it.
        """
        squared = np.interp(
            np.asarray(position, dtype=np.float64), self.positions, self.speeds[row] ** 2
        )
        return np.asarray(np.sqrt(squared))
