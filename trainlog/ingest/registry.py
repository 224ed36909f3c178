"""Which formats can be ingested: general readers, profiles of recorders, and registered ones.

A general reader is a `Format`. A layout of one recorder is a profile with a section [detect] on one
of them: those in the folder ``profiles`` are formats of their own. A user's profiles stand in the
folder that the environment variable `FOLDER` names; they are recognised as if given.

A package registers a format by an entry point of the group ``trainlog.ingest``, which names a
function ``read(path, profile)`` that gives a `Recording` or a sequence of them, a `Format` that can
also recognise its files, or a `Profile`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Literal

from trainlog.errors import InputError, suggestion
from trainlog.formats.files import head_of, refuse_workbook
from trainlog.ingest.foreign import is_mcap, read_foreign
from trainlog.ingest.gpx import is_gpx, read_gpx
from trainlog.ingest.messages import is_nmea, is_reports, read_nmea, read_reports, read_tagged
from trainlog.ingest.parts import read_rides
from trainlog.ingest.profile import Profile, read_profile
from trainlog.ingest.recording import Recording
from trainlog.ingest.tabular import (
    is_delimited,
    is_mdf,
    is_parquet,
    read_delimited,
    read_mdf,
    read_parquet,
)
from trainlog.ingest.telegrams import is_capture, read_telegrams
from trainlog.mcap.contents import converted_line_ends

GROUP = "trainlog.ingest"
"""Group of entry points."""

FOLDER = "TRAINLOG_PROFILES"
"""Environment variable with the path of a folder of profiles."""

Reader = Callable[[Path, Profile | None], Recording | Sequence[Recording]]


def never(head: bytes) -> bool:  # noqa: ARG001
    """Recognise nothing: for formats that have to be named."""
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
        What says which column is what: [time] and [columns] of a profile, or the format itself,
        which then has no use for those sections; the report states if they are given.
    profile : Profile, optional
        Whose [trip], [metadata], [limits] and [repair] hold where the user gives none.

    Examples
    --------
    >>> from trainlog.ingest import formats
    >>> formats()["gpx"].recognises(b'<?xml version="1.0"?><gpx version="1.1">')
    True
    """

    name: str
    read: Reader
    recognises: Callable[[bytes], bool] = never
    layout: Literal["profile", "own"] = "profile"
    profile: Profile | None = None


GENERAL = (
    Format("gpx", read_gpx, is_gpx, "own"),
    Format("mcap", read_foreign, is_mcap),
    Format("nmea", read_nmea, is_nmea, "own"),
    Format("sfera", read_reports, is_reports, "own"),
    Format("parquet", read_parquet, is_parquet),
    Format("mdf", read_mdf, is_mdf),
    Format("tagged", read_tagged),
    Format("rides", read_rides),
    Format("telegrams", read_telegrams, is_capture),
    # Last: any text may be a CSV.
    Format("csv", read_delimited, is_delimited),
)
"""The general readers, in the order in which they are tried."""


def format_by_profile(name: str, profile: Profile) -> Format:
    """The format of a profile's recorder, on the general reader that it names.

    Of a profile that the user gives beside it [trip], [metadata], [limits] and [repair] are used,
    in place of its own.

    Raises
    ------
    InputError
        If there is no such reader.

    Examples
    --------
    >>> profile = read_profile(Path(__file__).with_name("profiles") / "ublox.toml")
    >>> format_by_profile("mine", profile).recognises(b"Year,Month,Day,Hour,Minute,Second,nSAT")
    True
    """
    general = {item.name: item for item in GENERAL}
    chosen = profile.file.format or "csv"
    if chosen not in general:
        raise InputError(
            f"profile '{profile.name}': no general format '{chosen}'",
            place="file.format",
            remedy=suggestion(chosen, general, "formats"),
        )
    reader = general[chosen]
    known = dict(profile.stated)
    if profile.clock is not None:
        known["clock"] = profile.clock

    def read(path: Path, _: Profile | None) -> Sequence[Recording]:
        found = reader.read(path, profile)
        recordings = (found,) if isinstance(found, Recording) else found
        return [replace(item, metadata=known | item.metadata) for item in recordings]

    return Format(name, read, profile.recognises, "own", profile)


def own_profile(path: Path) -> Path | None:
    """The first profile of the user's folder that recognises a file; None if there is none.

    Raises
    ------
    InputError
        If there is no such folder, or a profile in it does not fit.
    """
    folder = os.environ.get(FOLDER)
    if not folder:
        return None
    if not Path(folder).is_dir():
        raise InputError(
            "is not a folder",
            file=folder,
            remedy=f"set {FOLDER} to a folder of profiles, or unset it",
        )
    head = head_of(path)
    candidates = sorted(Path(folder).glob("*.toml"))
    return next((each for each in candidates if read_profile(each).recognises(head)), None)


@cache
def formats() -> dict[str, Format]:
    """Every format by name; registered ones come first, and are tried first.

    Raises
    ------
    InputError
        If a registered format cannot be loaded.

    Examples
    --------
    >>> "gpx" in formats() and "ublox" in formats()
    True
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
        if isinstance(loaded, Profile):
            loaded = format_by_profile(entry.name, loaded)
        found[entry.name] = loaded if isinstance(loaded, Format) else Format(entry.name, loaded)
    built_in = [
        format_by_profile(path.stem, read_profile(path))
        for path in sorted(Path(__file__).with_name("profiles").glob("*.toml"))
    ]
    return found | {item.name: item for item in (*built_in, *GENERAL) if item.name not in found}


def is_registered(item: Format) -> bool:
    """Whether a format comes from another package, or replaces one of ours."""
    return item.name in {entry.name for entry in entry_points(group=GROUP)}


def format_called(name: str) -> Format:
    """The format of that name; InputError if there is none."""
    known = formats()
    if name not in known:
        raise InputError(f"no format '{name}'", remedy=suggestion(name, known, "formats"))
    return known[name]


def format_of(path: Path, name: str | None) -> Format:
    """The format called `name`, or the first one that recognises the file.

    Raises
    ------
    InputError
        If there is no format of that name, the file cannot be read, or no format recognises it.
    """
    if name is not None:
        return format_called(name)
    known = formats()
    head = head_of(path)
    refuse_workbook(head, path)
    for candidate in known.values():
        if candidate.recognises(head):
            return candidate
    converted = converted_line_ends(head)
    if converted is not None:
        raise InputError(converted[0], file=path, place="byte 0", remedy=converted[1])
    raise InputError(
        f"is of no format that trainlog knows; it begins with {head[:8].hex(' ')}",
        file=path,
        remedy=f"formats: {', '.join(known)}; name one (--format, format=) if you know better",
    )
