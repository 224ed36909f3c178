"""The journey format, ``"trainlog/journey"``; docs/formats.md describes its keys."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from trainlog.formats.files import read_bytes, write_bytes
from trainlog.formats.quantities import MISSING, Column, Table
from trainlog.formats.schema import File, built
from trainlog.railway.journey import Journey, TimingPoint

_Points = Annotated[
    tuple[Any, ...],
    Table(
        (
            Column("position", "m", "m"),
            Column("earliest", "s", "s", MISSING),
            Column("latest", "s", "s", MISSING),
            Column("lowest_speed", "km/h", "m/s", MISSING),
            Column("highest_speed", "km/h", "m/s", MISSING),
        )
    ),
]


class _JourneyFile(File):
    FORMAT: ClassVar[str] = "trainlog/journey"

    name: str = Field(min_length=1)
    source: str = ""
    line: str
    timing_points: _Points

    def journey(self) -> Journey:
        """The journey that the file describes."""
        return Journey(self.name, self.line, points(self.timing_points), self.source)

    @staticmethod
    def of(journey: Journey) -> _JourneyFile:
        """The file that describes a journey."""
        return _JourneyFile.model_construct(
            name=journey.name,
            source=journey.source,
            line=journey.line,
            timing_points=columns(journey.points),
        )


def points(table: tuple[Any, ...]) -> tuple[TimingPoint, ...]:
    """Timing points from the columns of their table, NaN where there is no bound."""
    rows = np.column_stack(table)
    return tuple(
        TimingPoint(row[0], *(None if np.isnan(bound) else bound for bound in row[1:]))
        for row in rows.tolist()
    )


def columns(timing_points: tuple[TimingPoint, ...]) -> tuple[list[float], ...]:
    """The columns of the table of timing points, NaN where there is no bound."""
    names = TimingPoint.__dataclass_fields__
    cells = ([getattr(point, name) for point in timing_points] for name in names)
    return tuple([np.nan if cell is None else cell for cell in column] for column in cells)


def journey_from_bytes(data: bytes, *, file: str | Path = "journey.json") -> Journey:
    """The journey in the bytes of a journey file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a journey file, naming the place and the remedy.
    """
    return built(_JourneyFile.from_bytes(data, file).journey, file)


def journey_to_bytes(journey: Journey) -> bytes:
    """The bytes of the journey's file: the same journey gives the same bytes."""
    return _JourneyFile.of(journey).to_bytes()


def read_journey(path: str | Path) -> Journey:
    """Read a journey file; errors as `journey_from_bytes`, and if the file cannot be read."""
    return journey_from_bytes(read_bytes(path), file=path)


def write_journey(journey: Journey, path: str | Path) -> None:
    """Write a journey file, whole or not at all."""
    write_bytes(path, journey_to_bytes(journey))
