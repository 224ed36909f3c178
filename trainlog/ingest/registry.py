"""Which formats can be ingested: the built-in ones and those that other packages register.

A package registers a format by an entry point of the group ``trainlog.ingest``, which names a
function ``read(path, profile)`` that gives a `Recording` or a sequence of them, or a `Format` that
can also recognise its files.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Literal

from trainlog.errors import InputError
from trainlog.ingest.aalto import is_aalto, read_aalto
from trainlog.ingest.foreign import is_mcap, read_foreign
from trainlog.ingest.gpx import is_gpx, read_gpx
from trainlog.ingest.hexlines import is_hexlines, read_hexlines
from trainlog.ingest.mdf import is_mdf, read_mdf
from trainlog.ingest.mtk import is_mtk, read_mtk
from trainlog.ingest.nmea import is_nmea, read_nmea
from trainlog.ingest.profile import Profile, suggestion
from trainlog.ingest.recording import Recording
from trainlog.ingest.tabular import is_delimited, is_parquet, read_delimited, read_parquet
from trainlog.ingest.ublox import is_ublox, read_ublox

GROUP = "trainlog.ingest"
"""Group of entry points."""

HEAD = 65_536
"""Bytes of a file that a format may look at to recognise it."""

Reader = Callable[[Path, Profile | None], Recording | Sequence[Recording]]


def never(head: bytes) -> bool:  # noqa: ARG001
    """Recognise nothing: for formats that have to be asked for by name."""
    return False


@dataclass(frozen=True, slots=True)
class Format:
    """A recorded format.

    Attributes
    ----------
    name : str
    read : callable
        ``read(path, profile)`` gives what the file holds: a `Recording`, or a sequence of them.
    recognises : callable
        ``recognises(head) -> bool``, given the first 64 KiB of a file.
    layout : {"profile", "own"}
        Where it is told what the columns mean: in [time] and [columns] of a profile, or by the
        format itself, which then has no use for those sections; the report tells if they are given.
    """

    name: str
    read: Reader
    recognises: Callable[[bytes], bool] = never
    layout: Literal["profile", "own"] = "profile"


BUILT_IN = (
    Format("aalto", read_aalto, is_aalto, "own"),
    Format("mtk", read_mtk, is_mtk, "own"),
    Format("ublox", read_ublox, is_ublox, "own"),
    Format("gpx", read_gpx, is_gpx, "own"),
    Format("mcap", read_foreign, is_mcap),
    Format("nmea", read_nmea, is_nmea, "own"),
    Format("hexlines", read_hexlines, is_hexlines, "own"),
    Format("parquet", read_parquet, is_parquet),
    Format("mdf", read_mdf, is_mdf),
    # Last: any text may be a CSV.
    Format("csv", read_delimited, is_delimited),
)


@cache
def formats() -> dict[str, Format]:
    """Every format by name; registered ones come first, so that they are asked first.

    Raises
    ------
    InputError
        If a registered format cannot be loaded.
    """
    found: dict[str, Format] = {}
    for entry in entry_points(group=GROUP):
        try:
            loaded = entry.load()
        except Exception as error:
            raise InputError(
                f"format '{entry.name}' cannot be loaded from {entry.value}: {error}",
                remedy="repair or remove the package that registers it",
            ) from error
        found[entry.name] = loaded if isinstance(loaded, Format) else Format(entry.name, loaded)
    return found | {item.name: item for item in BUILT_IN if item.name not in found}


def format_of(path: Path, name: str | None) -> Format:
    """The format called `name`, or the first one that recognises the file.

    Raises
    ------
    InputError
        If there is no format of that name, the file cannot be read, or no format recognises it.
    """
    known = formats()
    if name is not None:
        if name not in known:
            raise InputError(f"no format '{name}'", remedy=suggestion(name, known, "formats"))
        return known[name]
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD)
    except OSError as error:
        reason = "is a folder" if path.is_dir() else (error.strerror or str(error)).lower()
        raise InputError(
            reason if path.exists() else "does not exist", file=path, remedy="check the path"
        ) from error
    if not head:
        raise InputError("is empty", file=path, remedy="was the recorder stopped at once?")
    for candidate in known.values():
        if candidate.recognises(head):
            return candidate
    raise InputError(
        f"is of no format that trainlog knows; it begins with {head[:8].hex(' ')}",
        file=path,
        remedy=f"formats: {', '.join(known)}; name one if you know better",
    )
