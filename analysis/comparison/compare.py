"""Trips over a line compared by position: times, losses with their causes, energy, driving."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
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
    with_units,
)
from analysis.given import Given, each_given
from trainlog.display import counted, span
from trainlog.errors import InputError, TrainlogError
from trainlog.presentation import (
    DURATION,
    ENERGY,
    MASS,
    NUMBER,
    SHARE,
    SPEED,
    Band,
    Column,
    Presented,
    Said,
    WordTable,
    new_table,
)
from trainlog.railway import Line, ParameterSet, Trajectory
from trainlog.railway.kilometres import in_km
from trainlog.units import KMH, clock

NEARLY_ALL = 0.98
"""Of the longest trip's distance: the reference is chosen among trips that cover so much."""

LISTED = 12
"""Losses that are listed of a direction."""

SMALL = 0.5
"""Time lost [s] below which a loss is not listed."""

WHOLE = replace(DURATION, digits=0)


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

    @property
    def facts(self) -> dict[str, Any]:
        """The trip as a whole, in SI units."""
        common, energy = self.common or (None, None), self.energy
        return {
            "trip": self.name,
            "first": self.trip.covered[0],
            "last": self.trip.covered[1],
            "duration": self.trip.duration,
            "mass": self.trip.mass.value,
            "mass_std": self.trip.mass.std,
            "first_in_common": common[0],
            "last_in_common": common[1],
            "lost": None if self.lost is None else self.lost.total,
            "normalised_traction": None if energy is None else energy.value,
            "normalised_traction_std": None if energy is None else energy.std,
        }

    def sum(self, column: str) -> float:
        """Sum of a column of the table; NaN where a section has none."""
        return float(self.table[column].sum(skipna=False))

    def section_words(self, name: str) -> str:
        """What the trip took in a section, in words."""
        if name not in self.table.index:
            return "-"
        row = self.table.loc[name]
        words = f"{row['running_time']:.0f}"
        words += f" + {row['dwell']:.0f}" * bool(row["dwell"] >= SMALL)
        words += f" + stood {row['stood']:.0f}" * bool(row["stood"] >= SMALL)
        words += f", {row['covered']:.0%} of it" * bool(row["covered"] < 0.98)
        lost = float(self.table["lost"][name]) if "lost" in self.table else math.nan
        return words + (f" ({lost:+.0f})" if math.isfinite(lost) else "")

    def mean(self, column: str) -> float:
        """Mean of a column over the distance; NaN where no section has it."""
        rows, distance = self.table, self.table["last"] - self.table["first"]
        return float((rows[column] * distance).sum(min_count=1) / distance.sum())

    @property
    def off_advised_speed(self) -> float:
        """Root mean square [m/s] of the difference to the speed that it followed."""
        rows, distance = self.table, self.table["last"] - self.table["first"]
        squares = (rows["off_advised_speed"] ** 2 * distance).sum(min_count=1)
        return float(np.sqrt(squares / distance.sum()))


def _normalised(each: ComparedTrip) -> Band | str:
    return "" if each.energy is None else Band(each.energy.value, each.energy.std)


def _excess(each: ComparedTrip) -> Said:
    excess, distance = float(each.table["excess"].max()), each.sum("excess_distance")
    return Said(excess, f"{KMH * excess:.1f} km/h, {distance:.0f} m" if excess else "none")


def _mass(each: ComparedTrip) -> Band | None:
    mass = each.trip.mass
    return Band(mass.value, mass.std) if mass.known else None


DRIVING = (
    Column("trip", of="name"),
    Column("mass", MASS, band=True, of=_mass),
    Column("coasting", replace(SHARE, digits=0), of=lambda each: each.mean("coasting")),
    Column("excess speed", SPEED, each=True, of=_excess),
    Column("slips", NUMBER, of=lambda each: float(each.table["slips"].sum(min_count=1))),
    Column("off advised speed\n(RMS)", SPEED, key="off_advised_speed"),
    Column("late at the end", DURATION, of=lambda each: float(each.table["lateness"].iloc[-1])),
    Column("braked", ENERGY, of=lambda each: each.sum("braking")),
)
"""How a trip was driven: coasting, excess speed, slip, how well advice was kept."""


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

    @property
    def name(self) -> str:
        """Line and direction."""
        return f"{self.line.name}, {self.direction}"

    def losses(self) -> pd.DataFrame:
        """Time lost by trip, place and cause; the largest first, in SI units."""
        rows = [
            (each.name, loss.seconds, loss.cause, loss.place, loss.first, loss.last, loss.words)
            for each in self.trips
            if each.lost is not None
            for loss in each.lost.losses
        ]
        columns = ["trip", "lost", "cause", "place", "first", "last", "words"]
        found = pd.DataFrame(rows, columns=columns)
        return found.sort_values("lost", ascending=False, kind="stable", ignore_index=True)

    def tables(self) -> list[WordTable]:
        """Trips, sections, losses, how it was driven."""
        found = [self.trips_table(), self.sections_table()]
        if any(trip.lost is not None and trip.lost.losses for trip in self.trips):
            found.append(self.losses_table())
        driven = [each.table[["coasting", "slips", "off_advised_speed"]] for each in self.trips]
        if pd.concat(driven).notna().any(axis=None):
            title = f"{self.name}: how it was driven"
            found.append(new_table(title, *DRIVING, name="driving").add_rows(self.trips))
        return found

    def _data(self, frame: pd.DataFrame) -> pd.DataFrame:
        return with_units(frame.assign(direction=self.direction))

    def _km(self, first: float, last: float) -> str:
        short = last - first < 100.0
        return span(in_km(self.line, [first, first if short else last]), digits=1)

    def trips_table(self) -> WordTable:
        """Each trip as a whole: part of the line, times, energy, time lost by cause."""
        planned = "the trajectory" if self.reference.planned else f"'{self.reference.name}'"
        return new_table(
            f"{self.name}: trips; time lost against {planned}",
            Column("trip", of="name"),
            Column("km", of=lambda each: self._km(*each.trip.covered)),
            Column("running", of=lambda each: clock(each.sum("running_time"))),
            Column("dwell", WHOLE, of=lambda each: each.sum("dwell") + each.sum("stood")),
            Column(
                "lost", of=lambda each: "" if each.lost is None else f"{each.lost.total:+.1f} s"
            ),
            Column("most of it", of=self._causes),
            Column("wheels", ENERGY, of=lambda each: each.sum("traction")),
            Column("line", ENERGY, of=lambda each: each.sum("line")),
            Column("wheels at reference's\nload and time", ENERGY, of=_normalised),
            name="trips",
            frame=self._data(pd.DataFrame([each.facts for each in self.trips])),
        ).add_rows(self.trips)

    def _causes(self, each: ComparedTrip) -> str:
        if each.lost is None or each.common is None:
            own = each.trip is self.reference
            return "reference" if own else "nothing in common with the reference"
        causes = [(cause, s) for cause, s in each.lost.by_cause().items() if abs(s) >= SMALL]
        largest = sorted(causes, key=lambda cause: -abs(cause[1]))[:3]
        low, high = each.trip.covered
        parted = each.common[0] > low + 200.0 or each.common[1] < high - 200.0
        part = f" (km {self._km(*each.common)})" if parted else ""
        return ", ".join(f"{cause} {s:+.0f}" for cause, s in largest) + part

    def sections_table(self) -> WordTable:
        """Running time by section, and dwell at the station behind it, side by side."""
        title = (
            f"{self.name}: running time by section + dwell at its end (+ stood on the way) [s];"
            " in brackets lost"
        )
        rows = [each.table.assign(trip=each.name).reset_index() for each in self.trips]
        table = new_table(
            title,
            Column("section"),
            Column("km"),
            *(Column(each.name) for each in self.trips),
            name="sections",
            frame=self._data(pd.concat(rows, ignore_index=True)),
        )
        places = in_km(self.line, self.sections.edges[:-1])
        for name, km in zip(self.sections.names, places, strict=True):
            table.add_cells(name, f"{km:.1f}", *(each.section_words(name) for each in self.trips))
        return table

    def losses_table(self) -> WordTable:
        """Where most time was lost, and why; then where most was gained."""
        every = self.losses()
        large = every[every["lost"].abs() >= SMALL]
        lost, gained = large[large["lost"] > 0.0], large[large["lost"] < 0.0]
        shown = pd.concat([lost.head(LISTED), gained.tail(max(1, LISTED // 4)).iloc[::-1]])
        return new_table(
            f"{self.name}: where time was lost, {min(LISTED, len(lost))} of {len(lost)} places;"
            f" gained in {len(gained)}",
            Column("lost [s]", of=lambda row: f"{row['lost']:+.1f}"),
            Column("trip"),
            Column("place"),
            Column("km", of=lambda row: self._km(row["first"], row["last"])),
            Column("cause", of="words"),
            name="losses",
            frame=self._data(every),
        ).add_rows(shown.to_dict("records"))

    @property
    def notes(self) -> list[str]:
        """What a reader of the tables must know, in sentences."""
        every = [f"{each.name}: {note}" for each in self.trips for note in each.trip.notes]
        if self.model:
            every.append(
                f"Tractive energy at the load and running time of '{self.reference.name}', by the"
                f" running resistance of the {self.model}; ± is half the 95 % band."
            )
        if any((each.table["excess"] > 0.0).any() for each in self.trips):
            every.append(
                "Excess speed is over the limit under the whole train; plans keep the limit at the"
                " train's front unless made with --set protect=train."
            )
        unknown = [each.name for each in self.trips if "traction" not in each.trip.sums]
        if unknown:
            names = ", ".join(unknown)
            every.append(f"no efforts are recorded: the energy of {names} is not known")
        elif not all("supply" in each.trip.sums for each in self.trips):
            every.append(
                "Energy from the line follows from the train's efficiencies where no current"
                " is recorded."
            )
        return every


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
        """Line, and the reference of each direction."""
        return {
            "line": self.directions[0].line.name,
            "references": {each.direction: each.reference.name for each in self.directions},
            "left_out": self.left_out,
        }

    def tables(self) -> list[WordTable]:
        """Of each direction by itself: trips, sections, losses, how it was driven."""
        return [table for each in self.directions for table in each.tables()]

    @property
    def notes(self) -> list[str]:
        """What a reader of the tables must know."""
        every = [note for each in self.directions for note in each.notes]
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
    # A section of the common range lies in one of the table, of which it may be a part.
    inner = 0.5 * (shared.edges[1:] + shared.edges[:-1])
    row = np.searchsorted(table["last"], inner)
    within = inner >= np.append(table["first"], np.inf)[row]
    count, seconds = (
        np.bincount(row[within], weights, minlength=len(table))
        for weights in (None, lost.by_section(inner.size)[within])
    )
    return np.where(count > 0, seconds, np.nan)
