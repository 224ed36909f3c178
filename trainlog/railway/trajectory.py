"""A journey: when and how fast a train may be where. A trajectory: what it should do there.

A trajectory states this for every configuration that the train may be in.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray, IntArray
from trainlog.declaration import Array, Declared, Form, Many, Quantity, Table, Text
from trainlog.display import at_most, lateness, span
from trainlog.errors import InputError
from trainlog.presentation import WordTable, frame_table
from trainlog.railway.line import Line
from trainlog.railway.train import Configuration, Train
from trainlog.units import JOULES_PER_KWH, KMH, clock


@dataclass(frozen=True, slots=True)
class TimingPoint:
    """Windows of time and speed at one position; None where there is no bound.

    Attributes
    ----------
    position : float [m]
    earliest, latest : float or None [s]
        Since the start of the journey.
    lowest_speed, highest_speed : float or None [m/s]
        Both 0 where the train stands.

    Examples
    --------
    >>> point = TimingPoint(5_000.0, earliest=240.0, latest=270.0)
    >>> point.latest - point.earliest
    30.0
    """

    position: Annotated[float, Quantity("m", "m")]
    earliest: Annotated[float | None, Quantity("s", "s")] = None
    latest: Annotated[float | None, Quantity("s", "s")] = None
    lowest_speed: Annotated[float | None, Quantity("km/h", "m/s")] = None
    highest_speed: Annotated[float | None, Quantity("km/h", "m/s")] = None

    def __str__(self) -> str:
        early, late = (
            "" if time is None else f"{round(time) // 60}:{round(time) % 60:02d} min"
            for time in (self.earliest, self.latest)
        )
        words = [f"at {early}" if early == late else f"{early.removesuffix(' min')} to {late}"]
        if not (early and late):
            words = [f"from {early}"] if early else [f"by {late}"] if late else ["at any time"]
        if self.highest_speed == 0.0:
            return f"stands {words[0]}"
        for bound, speed in (("least", self.lowest_speed), ("most", self.highest_speed)):
            if speed:
                words.append(f"at {bound} {KMH * speed:.4g} km/h")
        return ", ".join(words)


@dataclass(frozen=True, eq=False, repr=False)
class Journey(Declared):
    """Timing points of one train on one line.

    Two points at one position are a stop: arrival and departure, the dwell time between them.

    Attributes
    ----------
    name : str
    line : str
        Name of the line, as in its file.
    points : tuple of TimingPoint
        At least departure and arrival, ordered by position; two at one position are a stop:
        arrival, then departure. Where there is no bound: nan in TOML, null in JSON.
    source : str
        Where the data come from.

    Examples
    --------
    >>> at_rest = {"lowest_speed": 0.0, "highest_speed": 0.0}
    >>> start = TimingPoint(0.0, latest=0.0, **at_rest)
    >>> end = TimingPoint(5_000.0, latest=300.0, **at_rest)
    >>> journey = Journey("shuttle", "short", (start, end))
    >>> len(journey.points)
    2
    """

    FORMAT: ClassVar[str] = "trainlog/journey"
    ORDER: ClassVar[tuple[str, ...]] = ("name", "source")

    name: Annotated[str, Text(least=1, usual="Example journey")]
    line: Annotated[str, Text(usual="Example line")]
    points: Annotated[
        tuple[TimingPoint, ...],
        Table(
            key="timing_points",
            usual=(
                TimingPoint(150.0, earliest=0.0, latest=0.0),
                TimingPoint(5_900.0, latest=300.0),
                TimingPoint(5_900.0, earliest=330.0),
                TimingPoint(8_000.0, highest_speed=100.0 / KMH),
                TimingPoint(11_800.0, latest=630.0),
            ),
        ),
    ]
    source: Annotated[
        str, Text(stated="written", usual="template: replace every value by your journey's")
    ] = ""

    def summary(self) -> dict[str, str]:
        """The line, and what is asked for at each place."""
        places = groupby(self.points, lambda point: point.position)
        return {"line": self.line} | {
            f"km {position / 1e3:.3f}": ", then ".join(map(str, points))
            for position, points in places
        }

    def problems(self) -> Iterator[InputError]:
        """What no journey can be, one by one."""
        where = f"journey '{self.name}'"
        if len(self.points) < 2:
            yield InputError(
                f"{where}: needs at least a departure and an arrival",
                remedy="give two timing points or more",
            )
            return
        if self.points[0].position < 0.0:
            place = self.points[0].position / 1e3
            yield InputError(
                f"{where}: begins before the line, at km {place:.3f}",
                remedy="give positions on the line",
            )
        for before, point in pairwise(self.points):
            if point.position < before.position:
                yield InputError(
                    f"{where}: timing point at km {point.position / 1e3:.3f} comes after the one"
                    f" at km {before.position / 1e3:.3f}",
                    remedy="order the points by position",
                )
        for point in self.points:
            for what, lower, upper in (
                ("time", point.earliest, point.latest),
                ("speed", point.lowest_speed, point.highest_speed),
            ):
                at = f"{where}: {what} window at km {point.position / 1e3:.3f}"
                if any(bound is not None and bound < 0.0 for bound in (lower, upper)):
                    yield InputError(
                        f"{at} has a negative bound", remedy="give times since the departure"
                    )
                elif lower is not None and upper is not None and lower > upper:
                    yield InputError(f"{at} ends before it begins", remedy="exchange its bounds")


_ROUNDING = 1e-6
"""What a solver's zero may fall short of zero [N], [m/s]."""

_ENERGY = {
    "wheel": "worst-case energy at the wheel rims",
    "line": "worst-case energy from the line",
    "expected": "expected energy from the line",
}
"""What an objective of the optimisation counts."""


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Declared):
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

    Examples
    --------
    >>> import numpy as np
    >>> from trainlog.formats.railway import read_train
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> trajectory = Trajectory(
    ...     "line", train.name, np.array([0.0, 500.0, 1000.0]), (Configuration.of(train),),
    ...     np.array([[0.0, 20.0, 0.0]]), np.array([[0.0, 50.0, 100.0]]),
    ...     np.array([53e3, 0.0]), np.array([[0.0, 53e3]]), 100.0,
    ... )
    >>> trajectory
    Trajectory of CH_Stadler_FLIRT_TPF on line, km 0.000 to km 1.000
      running time    1:40 min
      configurations  nominal
      speed           at most 72 km/h
      cells           2
    >>> trajectory.speed_at(0, 250.0).round(2)
    np.float64(14.14)
    """

    charts_by: ClassVar[str] = "analysis.trajectory.plot:trajectory_charts"

    FORMAT: ClassVar[str] = "trainlog/trajectory"
    ORDER: ClassVar[tuple[str, ...]] = (
        "line", "train", "direction", "running_time", "configurations", "positions",
        "tractive_effort", "tractive_effort_fall", "braking_effort", "speeds", "times",
    )  # fmt: skip

    line: str
    train: str
    positions: Annotated[FloatArray, Array("m")]
    configurations: Annotated[tuple[Configuration, ...], Many(least=1)]
    speeds: Annotated[FloatArray, Array("m/s", dimensions=2)]
    times: Annotated[FloatArray, Array("s", dimensions=2)]
    tractive_effort: Annotated[FloatArray, Array("N")]
    braking_effort: Annotated[FloatArray, Array("N", dimensions=2)]
    running_time: Annotated[float, Quantity("s", "s")]
    tractive_effort_fall: Annotated[FloatArray, Array("N", stated="written")] = field(
        default_factory=lambda: np.zeros(0)
    )
    direction: Annotated[Literal["forward", "reverse"], Form(stated="written")] = "forward"
    certificate: Annotated[dict[str, Any], Form(stated="written")] = field(default_factory=dict)
    provenance: Annotated[dict[str, Any], Form(stated="written")] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.tractive_effort_fall.size == 0:
            object.__setattr__(self, "tractive_effort_fall", np.zeros(self.positions.size - 1))
        super().__post_init__()

    def problems(self) -> Iterator[InputError]:
        """What no train can do."""
        q, n = len(self.configurations), self.positions.size - 1
        shapes = {"speeds": (q, n + 1), "times": (q, n + 1), "tractive_effort": (n,)}
        shapes |= {"tractive_effort_fall": (n,), "braking_effort": (q, n)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                yield InputError(
                    f"trajectory: {name} has shape {getattr(self, name).shape}, needs {shape}",
                    remedy="give one value per position",
                )
                return
        row = np.append(np.flatnonzero(np.diff(self.positions) <= 0.0) + 1, 0)[0]
        if row or n < 1:
            place = f"positions.values[{row}]"
            yield InputError("positions must increase", place=place, remedy="give at least two")
        for name in ("tractive_effort", "braking_effort", "speeds"):
            if np.any(getattr(self, name) < -_ROUNDING):
                place = f"{name}.values"
                yield InputError("must not be negative", place=place, remedy="correct it")
        fall = 0.5 * np.abs(self.tractive_effort_fall)
        for cell in np.flatnonzero(fall > self.tractive_effort + _ROUNDING)[:1]:
            yield InputError(
                "the tractive effort must not fall below zero within a cell",
                place=f"tractive_effort_fall.values[{cell}]",
                remedy="correct it",
            )

    @property
    def title(self) -> str:
        """Train, line and part of it."""
        first, last = self.positions[[0, -1]] / 1e3
        against = " against the chainage" * (self.direction == "reverse")
        return (
            f"Trajectory of {self.train} on {self.line}{against}, km {first:.3f} to km {last:.3f}"
        )

    def summary(self) -> dict[str, str]:
        """Time, configurations, speed and energy."""
        names, certificate = [each.name for each in self.configurations], self.certificate
        listed = ", ".join(names[:3]) + f" ... ({len(names)})" * (len(names) > 3)
        rows = {"running time": clock(self.running_time), "configurations": listed}
        if self.planned_for:
            rows["planned for"] = self.planned_for
        if "energy" in certificate:
            rows["energy"] = (
                f"{certificate['energy'] / JOULES_PER_KWH:.2f} kWh, {self.energy_label};"
                f" {self.optimality}"
            )
        if "audit" in certificate:
            rows["audit"] = (
                f"passed, latest arrival {lateness(certificate['audit']['lateness'])},"
                f" last {certificate['hardest']}"
            )
        fastest = KMH * self.speeds.max(axis=1)
        return rows | {
            "speed": f"at most {span(fastest)} km/h",
            "cells": f"{self.positions.size - 1}",
        }

    def tables(self) -> list[WordTable]:
        """The summary; speed, time and efforts of each configuration where each cell begins."""
        import pandas as pd

        q, n = self.braking_effort.shape
        cells = pd.DataFrame(
            {
                "configuration": np.repeat([each.name for each in self.configurations], n),
                "position_m": np.tile(self.positions[:-1], q),
                "time_s": self.times[:, :-1].ravel(),
                "speed_m_s": self.speeds[:, :-1].ravel(),
                "tractive_effort_N": np.tile(self.tractive_effort, q),
                "tractive_effort_fall_N": np.tile(self.tractive_effort_fall, q),
                "braking_effort_N": self.braking_effort.ravel(),
            }
        )
        units = ("m", "s", "m/s", "N", "N", "N")
        cells.attrs["units"] = dict(zip(cells.columns[1:], units, strict=True))
        return [*super().tables(), frame_table("cells", cells)]

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
                    remedy=f"give that {what}, or plan for this one",
                )

    def check_run(self, line: Line, train: Train) -> None:
        """Refuse files of another line or train, or with other forces than it was planned with.

        Raises
        ------
        InputError
            If line or train have other names, the line is shorter, or the curve resistance of the
            line, or the mass model or the limits of acceleration of the train are others.
        """
        self.check(line.name, train.name)
        settings = self.provenance.get("settings", {})
        for what, name, thing in (
            ("line", "curve_resistance", line),
            ("train", "mass_model", train),
            ("train", "acceleration_limits", train),
        ):
            planned, stated = settings.get(name), getattr(thing, name)
            if planned not in (None, stated):
                raise InputError(
                    f"the trajectory was planned with the {name} '{planned}', {what}"
                    f" '{thing.name}' states '{stated}'",
                    remedy=f"give the {what} that it was planned with, or plan for this one",
                )
        end = float(self.positions[-1])
        if end > line.length + 1.0:
            raise InputError(
                f"trajectory ends at km {end / 1e3:.3f}, line '{line.name}' at"
                f" km {line.length / 1e3:.3f}",
                remedy="give the line that the trajectory was made for",
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
    def planned_for(self) -> str:
        """Observed configurations or the train's file, in words; empty where it is not noted."""
        return str(self.provenance.get("settings", {}).get("planned_for", ""))

    @property
    def model(self) -> str:
        """What is stated of the forces: curve resistance, mass and limits of acceleration."""
        settings = self.provenance.get("settings", {})
        names = ("curve_resistance", "mass_model", "acceleration_limits")
        curves, mass, limits = (settings.get(name) for name in names)
        if curves is None:
            return ""
        words = f"curve resistance {curves}, {mass}, {limits} acceleration limits"
        return words.replace("_", " ")

    @property
    def protected_length(self) -> float:
        """Length of the train over which its speed limits are kept [m]; 0: at its front alone."""
        return float(self.provenance.get("settings", {}).get("protected_length", 0.0))

    @property
    def limits_kept(self) -> str:
        """Where the train keeps the speed limits, in words."""
        length = self.protected_length
        return f"over {length:.0f} m of train" if length else "at the train's front"

    @property
    def energy_label(self) -> str:
        """What the ``energy`` of the certificate is, and where it is taken, in words."""
        return _ENERGY.get(self.objective, "energy")

    @property
    def optimality(self) -> str:
        """How far the energy of the certificate is from the least possible at most, in words."""
        gap = self.certificate["gap"]
        words = f"at most {at_most(gap)} above the theoretical minimum"
        return at_most(gap) if gap > 1.0 else words

    @property
    def latest(self) -> int:
        """Row of the configuration that arrives last: its speeds all others can keep, too."""
        return int(np.argmax(self.times[:, -1]))

    def cell_of(self, position: ArrayLike) -> IntArray:
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
