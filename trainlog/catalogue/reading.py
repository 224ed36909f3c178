"""What the catalogue asks of a log, found without reading more of it than that takes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from trainlog.errors import InputError, LogError, TrainlogError
from trainlog.formats.files import sha256_of
from trainlog.formats.railway import travelled_line
from trainlog.identity import COLUMNS, TripIdentity, identity_of
from trainlog.mcap.contents import Contents, MisplacedError, check_data_section, contents_used
from trainlog.mcap.reader import (
    bare_trip,
    check_readable,
    position_span,
)
from trainlog.mcap.records import Source, in_file
from trainlog.mcap.tables import frames_in
from trainlog.railway.line import Line, in_km
from trainlog.trip import LINE_ATTACHMENT, PASSPORT_ATTACHMENT, POSITION_TOPICS, Trip
from trainlog.units import NANOSECONDS

_OWN = ("trip", "train", "kind", "line", "direction", "weather", "load", "software", "start")
"""Metadata that has a column; the rest are labels."""


@dataclass(frozen=True)
class LogEntry:
    """What the catalogue keeps of a trip.

    Attributes
    ----------
    values : dict
        By column of `TRIP_COLUMNS`, as the database holds it; without ``key``, ``sha256`` and
        ``added``.
    edges : tuple of (str, float, float, str)
        Lines that it ran over: name, kilometres from and to, direction.
    identity : TripIdentity or None
    """

    values: dict[str, Any]
    edges: tuple[tuple[str, float | None, float | None, str], ...] = ()
    identity: TripIdentity | None = None

    @property
    def key(self) -> str:
        """Digest of what was recorded; empty where that is not known."""
        found = self.identity
        if found is None:
            return ""
        content = f"{found.start.value} {found.end.value} {found.samples} ".encode()
        return sha256(content + found.blocks.astype("<u8").tobytes()).hexdigest()[:32]


@dataclass(frozen=True)
class FileEntry:
    """A file that was looked at: its content, and the trip in it or why it is none.

    Attributes
    ----------
    path : str
    sha256 : str
        Empty if it cannot be read.
    size : int or None
        [bytes]
    changed : int or None
        When it was written last [ns since 1970].
    entry : LogEntry or None
    reason : str
        Why it holds no trip.
    """

    path: str
    sha256: str
    size: int | None = None
    changed: int | None = None
    entry: LogEntry | None = None
    reason: str = field(default="", compare=False)


def read_file(path: str | Path) -> FileEntry:
    """A file as the catalogue registers it; one that cannot be used with the reason.

    A file that is written meanwhile is refused: nothing is known of its content.
    """
    name = str(path)
    try:
        before = Path(path).stat()
        digest = sha256_of(path)
        entry, reason = None, ""
        try:
            entry = read_entry(path)
        except TrainlogError as error:
            reason = _bare(error, name)
        after = Path(path).stat()
    except TrainlogError as error:
        return FileEntry(name, "", reason=_bare(error, name))
    except OSError as error:
        return FileEntry(name, "", reason=error.strerror or str(error))
    if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
        return FileEntry(name, "", reason="is being written; add it when that is done")
    return FileEntry(name, digest, after.st_size, after.st_mtime_ns, entry, reason)


def read_entry(path: str | Path) -> LogEntry:
    """What the catalogue keeps of a log: from its summary, and of the samples one column.

    Of a log whose checksum over all records does not hold, every record is read: what is lost is
    known then.

    Raises
    ------
    LogError
        If it is no log, holds no trip or no sample, or nothing of it is readable.
    InputError
        If there is no such file.

    Examples
    --------
    >>> entry = read_entry("sample_logs/nonstop.mcap")
    >>> entry.values["train"], entry.values["duration"], entry.values["messages"]
    ('CH_Stadler_FLIRT_TPF', 1183.1, 59285)
    """
    with Source(path) as source, in_file(path):
        contents, (trip, span) = contents_used(source, lambda found: _read(source, found))
        check_readable(contents.account)
        if not contents.account.messages:
            raise LogError("has no samples", remedy="leave it out: nothing was recorded")
    return _entry(trip, span, contents)


def _read(source: Source, contents: Contents) -> tuple[Trip, tuple[float, float] | None]:
    """The trip with the column that identifies it alone, and the positions between it was."""
    check_data_section(source, contents)
    trip = bare_trip(source, contents)
    present = {channel.topic for channel in contents.channels.values()}
    frames: dict[str, Any] = {}
    for topic, column, _ in COLUMNS:
        if topic not in present:
            continue
        chunks = list(contents.chunks)
        found = frames_in(source, contents, chunks, {topic: frozenset([column])}).get(topic)
        if found is not None and column in found and found[column].notna().any():
            frames = {topic: found}
            break
    span = None
    for topic in POSITION_TOPICS:
        try:
            span = span or (position_span(source, contents, topic) if topic in present else None)
        except MisplacedError:
            raise
        except LogError:
            continue
    return Trip(frames, trip.metadata, trip.provenance, trip.attachments), span


def _entry(trip: Trip, span: tuple[float, float] | None, contents: Contents) -> LogEntry:
    known, account = trip.metadata, contents.account
    counts = contents.counts()
    topics: dict[str, int] = {}
    for number, count in counts.items():
        topic = contents.channels[number].topic
        topics[topic] = topics.get(topic, 0) + count
    filled = [chunk for chunk in contents.chunks if chunk.counts]
    start = min(chunk.start for chunk in filled)
    end = max(chunk.end for chunk in filled)
    data = trip.attachments.get(LINE_ATTACHMENT)
    line = None
    with suppress(TrainlogError):
        line = None if data is None else travelled_line(data, known.get("direction") == "reverse")
    identity = identity_of(trip)
    km = _km(line, span)
    values = {
        "name": trip.name,
        "train": known.get("train"),
        "kind": known.get("kind"),
        "line": known.get("line") or (line.name if line is not None else None),
        "direction": known.get("direction"),
        "start": start,
        "end": end,
        "duration": (end - start) / NANOSECONDS,
        "distance": None if span is None else span[1] - span[0],
        "km_from": km[0],
        "km_to": km[1],
        "weather": known.get("weather"),
        "load": _number(known.get("load")),
        "labels": {key: value for key, value in sorted(known.items()) if key not in _OWN},
        "topics": dict(sorted(topics.items())),
        "passport": _passport(trip),
        "quality": "whole" if account.whole else "unclosed" if account.only_unclosed else "damaged",
        "damage": "" if account.whole else account.sentence,
        "repairs": sum(
            int(value)
            for key, value in known.items()
            if key.startswith("repair.") and value.isdecimal()
        ),
        "samples": 0 if identity is None else identity.samples,
        "messages": account.messages,
        "software": known.get("software"),
    }
    return LogEntry(values, _edges(values, line, span), identity)


def _km(line: Line | None, span: tuple[float, float] | None) -> tuple[float | None, float | None]:
    """The kilometres of a stretch [m], increasing."""
    if span is None:
        return None, None
    with suppress(InputError):
        found = np.sort(in_km(line, np.asarray(span)))
        return round(float(found[0]), 6), round(float(found[1]), 6)
    return None, None


def _edges(
    values: Mapping[str, Any], line: Line | None, span: tuple[float, float] | None
) -> tuple[tuple[str, float | None, float | None, str], ...]:
    """The lines that a trip ran over: those of its route, as far as it drove, or its line."""
    if line is not None and line.legs:
        parts = [each if span is None else each.between(*span) for each in line.legs]
        return tuple(
            (
                leg.edge,
                min(leg.edge_start, leg.edge_end) / 1e3,
                max(leg.edge_start, leg.edge_end) / 1e3,
                "forward" if leg.forward else "reverse",
            )
            for leg in parts
            if leg is not None
        )
    if not values["line"]:
        return ()
    direction = str(values["direction"] or "forward")
    return ((str(values["line"]), values["km_from"], values["km_to"], direction),)


def _passport(trip: Trip) -> dict[str, float]:
    """The value of each quantity of the passport that is known."""
    data = trip.attachments.get(PASSPORT_ATTACHMENT)
    found: dict[str, float] = {}
    if data is None:
        return found
    with suppress(ValueError, RecursionError):
        document = json.loads(data)
        if isinstance(document, dict):
            for name, quantity in sorted(document.items()):
                value = quantity.get("value") if isinstance(quantity, dict) else None
                if isinstance(value, int | float) and math.isfinite(value):
                    found[name] = float(value)
    return found


def _bare(error: TrainlogError, path: str) -> str:
    """An error without the name of the file, which stands beside it."""
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path}, ")


def _number(text: str | None) -> float | None:
    """A number of the metadata; None if it is none."""
    with suppress(TypeError, ValueError):
        value = float(text or "")
        return value if math.isfinite(value) else None
    return None
