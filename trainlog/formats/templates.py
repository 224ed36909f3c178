"""New files, ready to edit: commented templates, and lines from a table of their rows.

Lines, trains and journeys stand in TOML as they do in JSON, with the same keys and units; only TOML
has comments, so that templates are TOML.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.declaration import (
    Column,
    Declared,
    check_plausible,
    content_beside,
    entries,
    example,
    meanings,
)
from trainlog.errors import InputError
from trainlog.formats.declared import built, file_content, write_thing
from trainlog.formats.files import write_bytes
from trainlog.formats.headed import HeadedTable, read_headed
from trainlog.formats.toml import as_toml
from trainlog.railway import Line, Station, StepProfile, Train
from trainlog.railway.journey import Journey
from trainlog.railway.line import CurvatureProfile, Geometry, LineReference

Kind = Literal["line", "train", "journey", "profile"]


def template(kind: Kind, *, line: Line | None = None) -> str:
    """The text of a new file: TOML with comments that is valid as it is.

    Parameters
    ----------
    kind : {"line", "train", "journey", "profile"}
    line : Line, optional
        What a line's file holds, in place of an example.

    Examples
    --------
    >>> print(template("journey")[:59])
    # A journey. Units can be replaced by any of the same kind:
    """
    if kind == "profile":
        return Path(__file__).with_name("profile.toml").read_text("utf-8")
    declared: dict[str, type[Declared]] = {"line": Line, "train": Train, "journey": Journey}
    return template_of(declared[kind], line)


def template_of(kind: type[Declared], thing: Declared | None = None) -> str:
    """The text of a new file of a declared thing, with what its docstring says of each key.

    Parameters
    ----------
    kind : type
    thing : optional
        What the file holds; default: the usual values, and at the end, as comments, those of the
        tables that may be added.
    """
    word, meant = kind.__name__.lower(), meanings(kind)
    head = (
        f"A {word}. Units can be replaced by any of the same kind: kg for t, km for m, m/s for"
        " km/h.\ndocs/formats.md describes every key."
    )
    if word in ("line", "train"):
        other = "train" if word == "line" else "line"
        head += f" Check it:\ntrainlog simulate drive --{word} THIS --{other} sample -o trips"
    notes: dict[str, str] = {}
    for entry in entries(kind):
        words = "\n".join(textwrap.wrap(meant.get(entry.names[0], ""), 96))
        # What is said of several keys stands before the first.
        notes[entry.key] = "" if words in notes.values() else words
    text = as_toml(file_content(thing or example(kind)), {"": head} | notes)
    added = {} if thing is not None else content_beside(kind)
    if not added:
        return text
    lines = as_toml(added, notes).splitlines()
    return (
        text + "\n# What may be added:\n" + "".join(f"# {each}".rstrip() + "\n" for each in lines)
    )


def write_template(
    kind: Kind, path: str | Path, *, table: str | Path | None = None, name: str | None = None
) -> Path:
    """Write a new file to be edited; nothing that exists is overwritten.

    Parameters
    ----------
    kind : {"line", "train", "journey", "profile"}
    path : str or Path
        Ends in .toml; a line that is made from a table may be .json.
    table : str or Path, optional
        CSV of a line's rows; see `read_line_table`.
    name : str, optional
        Of a line from a table; default: the table's.

    Raises
    ------
    InputError
        If the name ends otherwise, the file exists, or the table cannot be used.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.formats.train import read_train
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     read_train(write_template("train", Path(folder) / "mine.train.toml")).name
    'Example unit'
    """
    path = Path(path)
    if table is not None and kind != "line":
        raise InputError(
            f"a {kind} cannot be made from a table",
            remedy=f"'trainlog ingest {table} -o FOLDER' proposes one from the recording"
            if kind == "profile"
            else "leave out the table; it is for a line's chainage, gradients and limits",
        )
    suffixes = (".toml", ".json") if table is not None else (".toml",)
    if path.suffix not in suffixes:
        raise InputError(
            f"is not the name of a {' or '.join(suffixes)} file",
            file=path,
            remedy=f"end it in {suffixes[0]}, which has comments",
        )
    if path.exists():
        raise InputError("exists", file=path, remedy="choose another name, or remove it first")
    line = None if table is None else read_line_table(table)
    if line is not None and name:
        line = replace(line, name=name)
    if line is not None and path.suffix == ".json":
        write_thing(line, path, Line)
    else:
        write_bytes(path, template(kind, line=line).encode())
    return path


# ------------------------------------------------------------------ a line from a table

COLUMNS = {
    "position": (
        "position chainage kilometre kilometer km pk mileage distance s weg strecke station_km"
        " kilometrierung abszisse abscisse"
    ),
    "gradient": "gradient slope grade neigung steigung laengsneigung längsneigung pente déclivité"
    " declivite rampe",
    "limit": "limit speed_limit speed vmax v_max v geschwindigkeit vitesse",
    "station": "station stop stations halt bahnhof haltestelle betriebsstelle gare arrêt arret",
    "radius": "radius radius_of_curve halbmesser bogenradius rayon",
    "latitude": "latitude lat breite breitengrad",
    "longitude": "longitude lon long länge laenge längengrad",
}
"""What people call the columns of a line's table, in English, German and French."""

_NUMBERS = (
    Column("position", "km", "m"),
    Column("gradient", "permil", "1"),
    Column("limit", "km/h", "m/s"),
    Column("radius", "m", "m"),
    Column("latitude", "deg", "deg"),
    Column("longitude", "deg", "deg"),
)
"""Those of numbers, with a unit to suggest."""

_EXPECTED = "give a header such as 'chainage [km];gradient [permil];limit [km/h];station'"


def read_line_table(path: str | Path, *, name: str | None = None) -> Line:
    r"""A line from a CSV table of its rows.

    Each row gives a chainage and what holds from there on; an empty cell leaves what held before. A
    row with a station names it. The last row is the line's end; what it states besides its chainage
    and station does not matter. Chainage that begins elsewhere is counted from the first row.

    Parameters
    ----------
    path : str or Path
        Columns of chainage, gradient and speed limit, and, if known, station, radius of curves (0
        or empty at the first row: straight), latitude and longitude; units in the header.
    name : str, optional
        Of the line; default: that of the file.

    Raises
    ------
    InputError
        With the line of the file and the remedy.

    Examples
    --------
    >>> import tempfile
    >>> header = "chainage [km];gradient [permil];limit [km/h];station\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "A-B.csv"
    ...     _ = path.write_text(header + "0;2,5;80;A\n3,2;;100;\n9;;;B\n")
    ...     line = read_line_table(path)
    >>> line.length, line.gradient(5e3).item(), line.speed_limits.positions.tolist()
    (9000.0, 0.0025, [0.0, 3200.0])
    """
    table = read_headed(path, _EXPECTED)
    kinds = {word: kind for kind, words in COLUMNS.items() for word in words.split()}
    required = ("position", "gradient", "limit")
    table.identify(lambda word: kinds.get(word.replace(" ", "_")), required, others=True)
    known = {each.name: _numbers(table, each) for each in _NUMBERS if each.name in table.columns}
    at = known["position"]
    _check_positions(table, at)
    table.check()
    first, length = float(at[0]), float(at[-1] - at[0])
    called = name or Path(path).stem.removesuffix(".line")
    source = f"table {Path(path).name}"
    reference = None
    if first:
        source += f"; position 0 is km {first / 1e3:.3f} of the table"
        reference = LineReference(called, np.zeros(1), np.array([first]), np.array([at[-1]]))
    position = at - first
    names = table.cells("station", str, "")
    line = built(
        lambda: Line(
            name=called,
            length=length,
            stations=tuple(
                Station(each, float(there))
                for each, there in zip(names, position, strict=True)
                if each
            ),
            speed_limits=_steps(table, position, known, "limit"),
            gradients=_steps(table, position, known, "gradient"),
            curvatures=_curves(position, known),
            geometry=_geometry(table, position, known),
            source=source,
            reference=reference,
        ),
        path,
    )
    built(lambda: check_plausible(line), path)
    return line


def _numbers(table: HeadedTable, column: Column) -> FloatArray:
    """A column in SI, NaN where a cell is empty."""
    number = table.columns[column.name]
    bare, unit = table.bare_name(number), table.units[number]
    if unit is None and (bare.lower() == "km" or column.unit == "deg"):
        unit = column.unit
    if unit is None:
        table.refuse(f"column '{bare}' has no unit", f"write '{bare} [{column.unit}]'")
    return table.quantity(column, unit, required=column.name == "position")


def _check_positions(table: HeadedTable, at: FloatArray) -> None:
    """Note positions that do not increase, unless one is not known."""
    backwards = np.flatnonzero(np.diff(at) <= 0.0)
    if at.size < 2:
        problem, remedy = "has one row", "add a last row with the chainage of the line's end"
        table.note(table.line, problem, remedy)
    elif at.size > 2 and backwards.size == at.size - 1:
        table.note(table.line, "chainage falls from row to row", "reverse the order of the rows")
    else:
        for row in backwards:
            problem = f"chainage {at[row + 1]:.12g} m follows {at[row]:.12g} m"
            table.note(table.rows[row + 1][0], problem, "chainage must increase")


def _steps(
    table: HeadedTable, position: FloatArray, known: Mapping[str, FloatArray], kind: str
) -> StepProfile:
    """What holds from each row on, where it changes; the last row is the line's end."""
    values = known[kind]
    if np.isnan(values[0]):
        remedy = f"give the {kind} that holds from the first row on"
        table.refuse(f"no {kind} at the line's begin", remedy, table.rows[0][0])
    given = np.flatnonzero(np.isfinite(values[:-1]))
    changed = given[np.concatenate(([True], np.diff(values[given]) != 0.0))]
    return StepProfile(position[changed], values[changed])


def _curves(position: FloatArray, known: Mapping[str, FloatArray]) -> CurvatureProfile | None:
    if "radius" not in known:
        return None
    radius = known["radius"][:-1].copy()
    radius[0] = 0.0 if np.isnan(radius[0]) else radius[0]
    given = np.flatnonzero(np.isfinite(radius))
    curvature = np.divide(1.0, radius[given], out=np.zeros(given.size), where=radius[given] != 0.0)
    return CurvatureProfile(position[given], curvature, curvature)


def _geometry(
    table: HeadedTable, position: FloatArray, known: Mapping[str, FloatArray]
) -> Geometry | None:
    if "latitude" not in known or "longitude" not in known:
        return None
    both = np.isfinite(known["latitude"]) & np.isfinite(known["longitude"])
    quality = f"from table {Path(table.path).name}"
    return Geometry(position[both], known["latitude"][both], known["longitude"][both], quality)
