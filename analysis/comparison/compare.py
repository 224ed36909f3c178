"""Trips over a line compared by position: times, losses with their causes, energy, driving."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from analysis.comparison.driven import DrivenTrip, driven_trip, planned_trip
from analysis.comparison.energy import ForceModel, Normalised, normalised_energy
from analysis.comparison.losses import Lost, lost_time
from analysis.comparison.sections import (
    Sections,
    common_range,
    section_table,
    sections_between,
)
from analysis.given import Given, each_given
from trainlog.display import counted
from trainlog.errors import InputError, TrainlogError
from trainlog.presentation import Presented, WordTable
from trainlog.railway import Line, ParameterSet, Trajectory
from trainlog.units import clock

NEARLY_ALL = 0.98
"""Of the longest trip's distance: the reference is chosen among trips that cover so much."""


@dataclass(frozen=True, eq=False)
class ComparedTrip:
    """One trip beside the reference of its direction.

    Attributes
    ----------
    trip : DrivenTrip
    table : DataFrame
        What it took in each section; see `analysis.comparison.sections.section_table`. Where it
        has a reference, ``lost`` [s] in the section with the station where it ends.
    lost : Lost or None
        None of the reference itself, and of a trip that has less than a kilometre in common with
        it.
    common : (float, float) or None [m]
        What it has in common with the reference.
    energy : Normalised or None
        Tractive work at the reference's load and running time; None where efforts, loads or
        resistance are not known, or the trips have only a part in common.
    """

    trip: DrivenTrip
    table: pd.DataFrame
    lost: Lost | None
    common: tuple[float, float] | None
    energy: Normalised | None = None

    @property
    def name(self) -> str:
        """Of the trip."""
        return self.trip.name


@dataclass(frozen=True, eq=False)
class ComparedDirection:
    """Trips in one direction of a line.

    Attributes
    ----------
    direction : {"forward", "reverse"}
    line : Line
        As travelled.
    sections : Sections
        Over all that any of the trips covers.
    reference : DrivenTrip
    trips : tuple of ComparedTrip
        The reference is among them unless it is a trajectory.
    model : str
        By which energies are normalised; empty if they are not.
    """

    direction: str
    line: Line
    sections: Sections
    reference: DrivenTrip
    trips: tuple[ComparedTrip, ...]
    model: str = ""

    def losses(self) -> pd.DataFrame:
        """Time lost by trip, place and cause; the largest first, in SI units."""
        rows = [
            {
                "trip": each.name,
                "lost": loss.seconds,
                "cause": loss.cause,
                "place": loss.place,
                "first": loss.first,
                "last": loss.last,
            }
            for each in self.trips
            if each.lost is not None
            for loss in each.lost.losses
        ]
        columns = ["trip", "lost", "cause", "place", "first", "last"]
        found = pd.DataFrame(rows, columns=columns)
        return found.sort_values("lost", ascending=False, kind="stable", ignore_index=True)


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Presented):
    """Trips over a line, compared by position.

    Attributes
    ----------
    directions : tuple of ComparedDirection
        Directions are kept apart.
    left_out : tuple of str
        Trips that could not be compared, with the reason.
    """

    charts_by: ClassVar[str] = "analysis.comparison.plot:all_charts"

    directions: tuple[ComparedDirection, ...]
    left_out: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """How many trips were compared on which line."""
        trips = sum(len(each.trips) for each in self.directions)
        return f"Comparison of {counted(trips, 'trip')} on {self.directions[0].line.name}"

    def facts(self) -> dict[str, Any]:
        """Directions with sections, trips and losses."""
        from analysis.comparison.table import direction_facts

        return {
            "line": self.directions[0].line.name,
            "directions": [direction_facts(each) for each in self.directions],
            "left_out": list(self.left_out),
        }

    def tables(self) -> list[WordTable]:
        """Of each direction by itself: trips, sections, losses, how it was driven."""
        from analysis.comparison.table import direction_tables

        return [table for each in self.directions for table in direction_tables(each)]

    @property
    def notes(self) -> list[str]:
        """What a reader of the tables must know."""
        from analysis.comparison.table import notes

        every = [note for each in self.directions for note in notes(each)]
        return every + [f"left out: {reason}" for reason in self.left_out]

    def summary(self) -> dict[str, str]:
        """Each direction."""
        rows = {}
        for each in self.directions:
            compared = [trip for trip in each.trips if trip.lost is not None]
            rows[each.direction] = f"{counted(len(each.trips), 'trip')}, reference" + (
                f" '{each.reference.name}', {clock(each.reference.duration)}"
            )
            for trip in compared[:4]:
                assert trip.lost is not None
                parts = sorted(trip.lost.by_cause().items(), key=lambda part: -abs(part[1]))
                causes = [f"{cause} {s:+.0f} s" for cause, s in parts[:3]]
                rows[f"  {trip.name}"] = f"{trip.lost.total:+.1f} s: {', '.join(causes)}"
        if self.left_out:
            rows["left out"] = counted(len(self.left_out), "trip")
        return rows

    def trip(self, name: str) -> ComparedTrip:
        """The compared trip of a name.

        Raises
        ------
        InputError
            If there is none.
        """
        found = [trip for each in self.directions for trip in each.trips if trip.name == name]
        if not found:
            known = ", ".join(trip.name for each in self.directions for trip in each.trips)
            raise InputError(f"no trip '{name}' was compared", remedy=f"there are {known}")
        return found[0]


def compare(
    trips: Given | Iterable[Given],
    reference: Given | Trajectory | None = None,
    *,
    line: Line | None = None,
    model: ParameterSet | None = None,
    by_time_of_day: bool = False,
) -> Comparison:
    """Compare trips over a line by position.

    Parameters
    ----------
    trips : Trip, path, or iterable of them
        Stopping or not, recorded or simulated, of any part of the line.
    reference : Trip, path or Trajectory, optional
        Default, for each direction: the fastest of the trips that cover nearly all that any of
        them covers.
    line : Line, optional
        In its own direction; default: the line that the first trip carries.
    model : ParameterSet, optional
        By whose running resistance energies are normalised; default: the train's file.
    by_time_of_day : bool
        A later departure counts as time lost, by the time of day.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If no trip can be compared.

    Examples
    --------
    >>> found = compare("sample_logs")
    >>> found.trip("trip-03").lost.by_cause()["stop"] > 200.0
    True
    >>> stopping = found.trip("trip-03")
    >>> round(float(stopping.table["lost"].sum()) - stopping.lost.total, 6)
    0.0
    """
    driven, left_out = _driven(trips, line)
    if not driven:
        raise InputError(
            f"no trip can be compared: {left_out[0]}"
            if left_out
            else "there is no trip to compare",
            remedy="give logs with speed and chainage on one line",
        )
    line = _own(driven[0]) if line is None else line
    of_line = [each for each in driven if each.line.name == line.name]
    left_out += [
        f"trip '{each.name}' ran on line '{each.line.name}', not on '{line.name}'"
        for each in driven
        if each.line.name != line.name
    ]
    stated = None if reference is None else _reference(reference, line, of_line)
    directions = []
    for direction in ("forward", "reverse"):
        same = [each for each in of_line if each.direction == direction]
        if not same:
            continue
        chosen = stated if stated is not None and stated.direction == direction else _fastest(same)
        if stated is not None and not stated.planned and stated.direction == direction:
            # A reference that is not among the trips is shown beside them.
            same = same if any(_same(each, stated) for each in same) else [stated, *same]
            chosen = next((each for each in same if _same(each, stated)), stated)
        directions.append(_direction(direction, same, chosen, model, by_time_of_day))
    return Comparison(tuple(directions), tuple(left_out))


def _driven(
    trips: Given | Iterable[Given], line: Line | None
) -> tuple[list[DrivenTrip], list[str]]:
    """Trips that can be compared, and why others cannot."""
    found, left_out = list[DrivenTrip](), list[str]()
    for given in each_given(trips):
        try:
            trip = driven_trip(given, line)
            again = next((each for each in found if _same(each, trip)), None)
            if again is None:
                found.append(trip)
            else:
                left_out.append(
                    f"trip '{trip.name}' is the same drive as '{again.name}': counted once"
                )
        except TrainlogError as error:
            where = f"{given}: " if isinstance(given, Path) and error.file is None else ""
            left_out.append(where + str(error))
    names = [each.name for each in found]
    return [_renamed(each, names[:number]) for number, each in enumerate(found)], left_out


def _renamed(trip: DrivenTrip, before: Sequence[str]) -> DrivenTrip:
    """The trip, with a number behind a name that came before."""
    from dataclasses import replace

    count = before.count(trip.name)
    return trip if count == 0 else replace(trip, name=f"{trip.name} ({count + 1})")


def _own(trip: DrivenTrip) -> Line:
    return trip.line.reversed() if trip.direction == "reverse" else trip.line


def _reference(given: Given | Trajectory, line: Line, trips: Sequence[DrivenTrip]) -> DrivenTrip:
    if not isinstance(given, Trajectory):
        return driven_trip(given, line)
    train = next((each.train for each in trips if each.train is not None), None)
    given.check(line.name, given.train if train is None else train.name)
    return planned_trip(given, line, train)


def _same(trip: DrivenTrip, other: DrivenTrip) -> bool:
    """Whether two are of the same recording."""
    return (
        (trip.direction, trip.departure) == (other.direction, other.departure)
        and np.array_equal(trip.time, other.time)
        and np.array_equal(trip.position, other.position)
        and np.array_equal(trip.speed, other.speed)
    )


def _fastest(trips: Sequence[DrivenTrip]) -> DrivenTrip:
    lengths = [each.covered[1] - each.covered[0] for each in trips]
    whole = [
        each
        for each, length in zip(trips, lengths, strict=True)
        if length >= NEARLY_ALL * max(lengths)
    ]
    return min(whole, key=lambda each: each.duration)


def _direction(
    direction: str,
    trips: Sequence[DrivenTrip],
    reference: DrivenTrip,
    model: ParameterSet | None,
    by_time_of_day: bool,
) -> ComparedDirection:
    line = trips[0].line
    every = [*trips, reference]
    low = min(each.covered[0] for each in every)
    high = max(each.covered[1] for each in every)
    sections = sections_between(line, low, high)
    forces = ForceModel.of(reference, model)
    compared = [
        _compared(trip, reference, sections, forces, by_time_of_day)
        if trip is not reference
        else ComparedTrip(trip, section_table(trip, sections), None, trip.covered)
        for trip in trips
    ]
    used = forces is not None and any(each.energy is not None for each in compared)
    name = forces.name if used and forces is not None else ""
    return ComparedDirection(direction, line, sections, reference, tuple(compared), name)


def _compared(
    trip: DrivenTrip,
    reference: DrivenTrip,
    sections: Sections,
    forces: ForceModel | None,
    by_time_of_day: bool,
) -> ComparedTrip:
    table = section_table(trip, sections)
    common = common_range(trip, reference)
    if common is None:
        return ComparedTrip(trip, table, None, None)
    shared = sections_between(trip.line, common.first, common.last)
    lost = lost_time(trip, reference, common, shared, by_time_of_day=by_time_of_day)
    table = table.assign(lost=_lost_in(table, shared, lost))
    whole = common.starts and common.ends
    energy = normalised_energy(trip, reference, forces) if whole and forces is not None else None
    return ComparedTrip(trip, table, lost, (common.first, common.last), energy)


def _lost_in(table: pd.DataFrame, shared: Sections, lost: Lost) -> Any:
    """Time lost in the rows of a trip's table; NaN in sections that are not in common."""
    seconds = lost.by_section(shared.edges.size - 1)
    middle = 0.5 * (table["first"] + table["last"]).to_numpy()
    found = np.full(len(table), np.nan)
    for row in range(len(table)):
        # A section of the common range lies in one of the table, of which it may be a part.
        inner = 0.5 * (shared.edges[1:] + shared.edges[:-1])
        within = (inner >= table["first"].iloc[row]) & (inner <= table["last"].iloc[row])
        if within.any():
            found[row] = seconds[within].sum()
    return np.where(np.isfinite(middle), found, np.nan)
