"""Maximum adhesion along a track, in the layout of TTOBench's files.

The library has no such file; this one is laid out as its tracks are: metadata, then tables with
declared units whose rows hold from their position to the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from trainlog.arrays import FloatArray
from trainlog.formats.files import read_json, to_bytes, write_bytes
from trainlog.formats.schema import MISSING, Column, Quantity, Table, checked, dumped
from trainlog.formats.ttobench import Layout, Metadata

_COLUMNS = (
    "maximum adhesion",
    "lower bound",
    "upper bound",
    "expected adhesion",
    "expected lower bound",
    "expected upper bound",
)
_Sections = Annotated[
    tuple[Any, ...],
    Table((Column("position", "m", "m"), *(Column(n, "-", "1", MISSING) for n in _COLUMNS))),
]


@dataclass(frozen=True, eq=False)
class AdhesionSections:
    """Maximum adhesion by section of a track, in one rail condition.

    Attributes
    ----------
    track, layer : str
    length : float [m]
        Of the track; the last section ends there.
    expected_at : str
        Time of the expected adhesion, ISO 8601; empty if none.
    source : str
    values : tuple of seven (n,) arrays
        Start of the section [m]; lasting maximum adhesion and the ends of its 95 % band; the
        expected one and those of its band. NaN where nothing was observed.
    """

    track: str
    layer: str
    length: float
    expected_at: str
    source: str
    values: tuple[FloatArray, ...]


class _AdhesionLayout(Layout):
    metadata: Metadata
    rail_condition: str = Field(min_length=1)
    length: Annotated[float, Quantity("m", "m")]
    expected_at: str = ""
    adhesion: _Sections


def write_adhesion(sections: AdhesionSections, path: str | Path) -> None:
    """Write maximum adhesion by section, whole or not at all.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> start, known = np.array([0.0, 500.0]), np.array([np.nan, 0.12])
    >>> given = AdhesionSections("A-B", "wet", 900.0, "", "by hand", (start, *[known] * 6))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_adhesion(given, Path(folder) / "wet.json")
    ...     read_adhesion(Path(folder) / "wet.json").values[1]
    array([ nan, 0.12])
    """
    layout = _AdhesionLayout.filled(
        metadata=Metadata.of(f"{sections.track} {sections.layer}", sections.source, sections.track),
        rail_condition=sections.layer,
        length=sections.length,
        expected_at=sections.expected_at,
        adhesion=sections.values,
    )
    write_bytes(path, to_bytes(dumped(layout)))


def read_adhesion(path: str | Path) -> AdhesionSections:
    """Read maximum adhesion by section, as `write_adhesion` writes it.

    Raises
    ------
    InputError
        If the file cannot be read, or is not of this layout; names the place.

    Examples
    --------
    >>> read_adhesion("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    found = checked(_AdhesionLayout, read_json(path), path)
    return AdhesionSections(
        track=found.metadata.associated_track or found.metadata.id,
        layer=found.rail_condition,
        length=found.length,
        expected_at=found.expected_at,
        source=found.metadata.source,
        values=found.adhesion,
    )
