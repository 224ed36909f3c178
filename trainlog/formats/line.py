"""The files of lines and of journeys on them, ``"trainlog/line"`` and ``"trainlog/journey"``.

Their keys follow from the declarations of `Line` and `Journey`; docs/formats.md describes them.
"""

from __future__ import annotations

from pathlib import Path

from trainlog.formats.declared import read_thing, thing_from_bytes, thing_to_bytes, write_thing
from trainlog.formats.network import read_network, route_of_path
from trainlog.formats.samples import DEFAULT_LINE, file_or_sample
from trainlog.railway.journey import Journey
from trainlog.railway.line import Line


def line_from_bytes(data: bytes, *, file: str | Path = "line.json") -> Line:
    """The line in the bytes of a line file; `file` is what errors call it."""
    return thing_from_bytes(Line, data, file)


def line_to_bytes(line: Line) -> bytes:
    """The bytes of the line's file: the same line gives the same bytes."""
    return thing_to_bytes(line)


def read_line(path: str | Path) -> Line:
    """Read a line file, JSON or TOML, or a route of a network; errors as `read_thing`.

    Parameters
    ----------
    path : path
        Of a line file; or ``"sample"``: St.Gallen-Wil; or of a network file, ``#`` and the places
        of a route with commas between them: ``"my.network.json#Wil,Gossau"``, see
        `trainlog.Network.route`.

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
    return read_thing(Line, path)


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
    write_thing(line, path, Line)


def read_journey(path: str | Path) -> Journey:
    """Read a journey file, JSON or TOML; errors as `read_thing`.

    Examples
    --------
    >>> read_journey("absent.journey.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.journey.json: does not exist; check the path
    """
    return read_thing(Journey, path)


def write_journey(journey: Journey, path: str | Path) -> None:
    """Write a journey file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> from trainlog import TimingPoint
    >>> journey = Journey("R 1", "short", (TimingPoint(0.0), TimingPoint(9e3, latest=600.0)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_journey(journey, Path(folder) / "r1.journey.json")
    ...     read_journey(Path(folder) / "r1.journey.json") == journey
    True
    """
    write_thing(journey, path, Journey)
