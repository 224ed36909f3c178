"""What is known of an unknown table while its columns are placed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from trainlog.arrays import FloatArray
from trainlog.ingest.profile import TripColumns
from trainlog.ingest.proposal.layout import Layout, Reading
from trainlog.ingest.proposal.motion import (
    Motion,
)
from trainlog.ingest.proposal.times import Clock
from trainlog.ingest.proposal.vocabulary import Meaning, dimension_of
from trainlog.railway.train import Train


@dataclass(frozen=True, slots=True)
class Proposed:
    """A field of our topics, and what it is read from, as in `trainlog.ingest.profile.Column`.

    Attributes
    ----------
    field : str
    columns : tuple of str
    unit : str
    scale, offset : float
    part : {"all", "positive", "negative"}
    sign : {1, -1}
    notation : {"number", "degrees_minutes"}
    meaning : str
        Of a field of a topic of the recorder's own.
    why, check, alternative : str
        What the name and the unit say, what physics says in numbers, and another reading.
    """

    field: str
    columns: tuple[str, ...]
    unit: str
    scale: float = 1.0
    offset: float = 0.0
    part: Literal["all", "positive", "negative"] = "all"
    sign: Literal[1, -1] = 1
    notation: Literal["number", "degrees_minutes"] = "number"
    meaning: str = ""
    why: str = ""
    check: str = ""
    alternative: str = ""


@dataclass(frozen=True)
class TripFacts:
    """The columns that state facts of each trip, and what they rest on."""

    columns: TripColumns = field(default_factory=TripColumns)
    readings: tuple[Reading, ...] = ()


@dataclass
class Work:
    """What is known so far of a table.

    Attributes
    ----------
    layout, clock, meanings, train
        What is given.
    motion : Motion
    numbers : dict of str to (n,) array
        Columns of numbers, in order of time.
    names : dict of str to list of str
        Columns by role.
    left : dict of str to str
        Columns that are not used, and why.
    proposed : dict of str to Proposed
        By field.
    speed : (n,) array, optional [m/s]
        The train's, that others are compared with.
    speed_open : str
        Why what is scaled by it is open, if its own unit is.
    rivals : dict of str to list of str
        Columns of the same role as one that is used, and as well named.
    trips : TripFacts
        Columns that state facts of each trip.
    """

    layout: Layout
    clock: Clock
    meanings: dict[str, Meaning]
    train: Train | None
    motion: Motion
    numbers: dict[str, FloatArray]
    names: dict[str, list[str]]
    left: dict[str, str]
    proposed: dict[str, Proposed] = field(default_factory=dict)
    readings: list[Reading] = field(default_factory=list)
    speed: FloatArray | None = None
    speed_open: str = ""
    rivals: dict[str, list[str]] = field(default_factory=dict)
    trips: TripFacts = field(default_factory=TripFacts)

    def first(self, role: str) -> str | None:
        """The column of a role; the others of that role are not used."""
        names = self.names.get(role, [])
        for other in names[1:]:
            self.left[other] = f"a second column for {role}; '{names[0]}' is used"
            if self.meanings[other].coverage >= 0.9 * self.meanings[names[0]].coverage:
                self.rivals.setdefault(names[0], []).append(other)
        del names[1:]
        return names[0] if names else None

    def stated(self, name: str | None, dimension: str) -> str:
        """The unit of that kind that the file states for a column; empty if none."""
        unit = self.meanings[name].unit if name is not None else None
        return unit if unit is not None and dimension_of(unit) == dimension else ""

    def place(
        self, field: str, columns: tuple[str, ...], unit: str, scale: float = 1.0, **more: Any
    ) -> None:
        """Propose a field, as `Proposed`; another column of its name is an alternative."""
        proposed = Proposed(field, columns, unit, scale, **more)
        rivals = [f"'{name}'" for name in self.rivals.get(proposed.columns[0], [])]
        if rivals and not any(rival in proposed.alternative for rival in rivals):
            other = said(proposed.alternative, " or ".join(rivals))
            proposed = replace(proposed, alternative=other)
        self.proposed[proposed.field] = proposed


def unit_reason(stated: str, taken: str, others: tuple[str, ...]) -> tuple[str, str]:
    """Why a unit was taken, and the alternative."""
    if stated and stated == taken:
        return f"the file states {stated}", ""
    if stated:
        return (
            f"the file states {stated}, which contradicts the other columns",
            f"{stated}, as the file states",
        )
    return "no known unit is stated; this one agrees with the other columns", " or ".join(
        others[:2]
    )


def said(*parts: str) -> str:
    """Parts of a sentence that are not empty, joined."""
    return "; ".join(filter(None, parts))
