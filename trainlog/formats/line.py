"""The formats of lines and of journeys on them, ``"trainlog/line"`` and ``"trainlog/journey"``.

docs/formats.md describes their keys.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from trainlog.formats.files import check_written, read_bytes, write_bytes
from trainlog.formats.linefile import LineFile
from trainlog.formats.network import read_network, route_of_path
from trainlog.formats.samples import DEFAULT_LINE, file_or_sample
from trainlog.formats.schema import MISSING, Column, File, Table, built
from trainlog.railway.journey import Journey, TimingPoint
from trainlog.railway.line import Line


def line_from_bytes(data: bytes, *, file: str | Path = "line.json") -> Line:
    """The line in the bytes of a line file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a line file, naming the place and the remedy.

    Examples
    --------
    >>> line_from_bytes(read_bytes("sample_logs/CH_StGallen_Wil.line.json")).stations[0].position
    0.0
    >>> line_from_bytes(b"{}")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: line.json: is not a trainlog/line file: it has no key...
    """
    return built(LineFile.from_bytes(data, file).line, file)


def line_to_bytes(line: Line) -> bytes:
    """The bytes of the line's file: the same line gives the same bytes.

    Examples
    --------
    >>> path = Path("sample_logs/CH_StGallen_Wil.line.json")
    >>> line_to_bytes(read_line(path)) == path.read_bytes()
    True
    """
    return LineFile.of(line).to_bytes()


def line_content(line: Line) -> dict[str, Any]:
    """What stands in a line's file, as plain values.

    Examples
    --------
    >>> line_content(read_line("sample_logs/CH_StGallen_Wil.line.json"))["length"]
    {'value': 29556.1, 'unit': 'm'}
    """
    return LineFile.of(line).file_content()


def read_line(path: str | Path) -> Line:
    """Read a line file, JSON or TOML, or a route of a network.

    Parameters
    ----------
    path : path
        Of a line file; or ``"sample"``: St.Gallen-Wil; or of a network file, ``#`` and the places
        of a route with commas between them: ``"my.network.json#Wil,Gossau"``, see
        `trainlog.Network.route`.

    Raises
    ------
    InputError
        As `line_from_bytes`, if the file cannot be read, or if values cannot be meant: limits of
        1,000 km/h. All that is wrong is listed at once.

    Examples
    --------
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> line.name, line.length
    ('CH_StGallen_Wil', 29556.1)
    """
    path = file_or_sample(path, DEFAULT_LINE)
    wanted = route_of_path(path)
    if wanted is not None:
        return read_network(wanted[0]).route(*wanted[1]).line
    line: Line = LineFile.read(read_bytes(path), path)
    return line


def write_line(line: Line, path: str | Path) -> None:
    """Write a line file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_line(line, Path(folder) / "copy.line.json")
    ...     read_line(Path(folder) / "copy.line.json").name
    'CH_StGallen_Wil'
    """
    check_written(line, Line)
    write_bytes(path, LineFile.of(line).bytes_for(path))


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

    def content(self) -> Journey:
        return self.journey()

    def journey(self) -> Journey:
        """The journey that the file describes."""
        return Journey(self.name, self.line, timing_points(self.timing_points), self.source)

    @staticmethod
    def of(journey: Journey) -> _JourneyFile:
        """The file that describes a journey."""
        return _JourneyFile.holding(journey, timing_points=timing_columns(journey.points))


def timing_points(table: tuple[Any, ...]) -> tuple[TimingPoint, ...]:
    """Timing points from the columns of their table, NaN where there is no bound."""
    rows = np.column_stack(table)
    return tuple(
        TimingPoint(row[0], *(None if np.isnan(bound) else bound for bound in row[1:]))
        for row in rows.tolist()
    )


def timing_columns(points: tuple[TimingPoint, ...]) -> tuple[list[float], ...]:
    """The columns of the table of timing points, NaN where there is no bound."""
    names = TimingPoint.__dataclass_fields__
    cells = ([getattr(point, name) for point in points] for name in names)
    return tuple([np.nan if cell is None else cell for cell in column] for column in cells)


def journey_from_bytes(data: bytes, *, file: str | Path = "journey.json") -> Journey:
    """The journey in the bytes of a journey file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a journey file, naming the place and the remedy.

    Examples
    --------
    >>> journey = Journey("R 1", "short", (TimingPoint(0.0), TimingPoint(9e3, latest=600.0)))
    >>> journey_from_bytes(journey_to_bytes(journey)).points[1].latest
    600.0
    """
    return built(_JourneyFile.from_bytes(data, file).journey, file)


def journey_to_bytes(journey: Journey) -> bytes:
    """The bytes of the journey's file: the same journey gives the same bytes.

    Examples
    --------
    >>> journey = Journey("R 1", "short", (TimingPoint(0.0), TimingPoint(9e3, latest=600.0)))
    >>> len(journey_to_bytes(journey).splitlines()) > 5
    True
    """
    return _JourneyFile.of(journey).to_bytes()


def journey_content(journey: Journey) -> dict[str, Any]:
    """What stands in a journey's file, as plain values.

    Examples
    --------
    >>> journey = Journey("R 1", "short", (TimingPoint(0.0), TimingPoint(9e3, latest=600.0)))
    >>> journey_content(journey)["timing_points"]["values"][1]
    [9000, None, 600, None, None]
    """
    return _JourneyFile.of(journey).file_content()


def read_journey(path: str | Path) -> Journey:
    """Read a journey file, JSON or TOML.

    Raises
    ------
    InputError
        As `journey_from_bytes`, and if the file cannot be read.

    Examples
    --------
    >>> read_journey("absent.journey.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.journey.json: does not exist; check the path
    """
    journey: Journey = _JourneyFile.read(read_bytes(path), path)
    return journey


def write_journey(journey: Journey, path: str | Path) -> None:
    """Write a journey file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> journey = Journey("R 1", "short", (TimingPoint(0.0), TimingPoint(9e3, latest=600.0)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_journey(journey, Path(folder) / "r1.journey.json")
    ...     read_journey(Path(folder) / "r1.journey.json") == journey
    True
    """
    check_written(journey, Journey)
    write_bytes(path, _JourneyFile.of(journey).bytes_for(path))
