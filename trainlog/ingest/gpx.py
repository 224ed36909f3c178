"""Format ``gpx``: GPX 1.0 and 1.1 track logs. Each track is a recording, its segments are not.

Read in one pass by expat, which keeps what readers of waypoints lose: the line of each point, the
speed of GPX 1.0, and the speeds and accuracies that vendors put into extensions. Entities are
refused, so that a small file cannot grow. Points of waypoints and routes are counted as not used.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal
from xml.parsers import expat

import numpy as np
import pyarrow as pa

from trainlog.errors import InputError
from trainlog.formats.files import read_bytes
from trainlog.ingest.mapping import recording_of, states_zone
from trainlog.ingest.profile import PROFILE_FORMAT, Column, Profile, TimeOptions
from trainlog.ingest.recording import (
    HORIZONTAL_PER_HDOP,
    VERTICAL_PER_VDOP,
    Cells,
    Finding,
    Recording,
)

SPELLINGS = {
    "time": "time",
    "ele": "altitude",
    "speed": "speed",
    "sat": "satellites",
    "hdop": "hdop",
    "vdop": "vdop",
    "pdop": "pdop",
    # Of extensions: GPSLogger, OsmAnd, OpenTracks, Basic Air Data.
    "accuracy": "horizontal_accuracy",
    "hacc": "horizontal_accuracy",
    "accuracy_horizontal": "horizontal_accuracy",
    "vacc": "vertical_accuracy",
    "accuracy_vertical": "vertical_accuracy",
    "unix": "unix",
    "unixtime": "unix",
}
"""What an element of a track point, or of its extensions, means; without its namespace."""

COLUMNS = ("latitude", "longitude", *dict.fromkeys(SPELLINGS.values()))

LAYOUT = Profile(
    format=PROFILE_FORMAT,
    version=1,
    name="GPX",
    time=TimeOptions(column="time"),
    columns={
        "/gnss/fix.latitude": Column(column="latitude", unit="deg"),
        "/gnss/fix.longitude": Column(column="longitude", unit="deg"),
        "/gnss/fix.altitude": Column(column="altitude", unit="m", optional=True),
        "/gnss/fix.horizontal_accuracy": Column(
            column="horizontal_accuracy", unit="m", optional=True
        ),
        "/gnss/fix.vertical_accuracy": Column(column="vertical_accuracy", unit="m", optional=True),
        "/gnss/motion.speed": Column(column="speed", unit="m/s", optional=True),
        "/gnss/motion.satellites": Column(column="satellites", optional=True),
        "/gnss/motion.pdop": Column(column="pdop", optional=True),
    },
)
"""What the elements mean, in the words of a profile."""

UNIX = re.compile(r"\d+(\.\d*)?")
"""A count of Unix time."""

MILLISECONDS = 1e11
"""Counts of Unix time beyond this are of milliseconds."""

CUT_OFF = (
    expat.errors.codes[expat.errors.XML_ERROR_NO_ELEMENTS],
    expat.errors.codes[expat.errors.XML_ERROR_UNCLOSED_TOKEN],
    expat.errors.codes[expat.errors.XML_ERROR_PARTIAL_CHAR],
    expat.errors.codes[expat.errors.XML_ERROR_UNCLOSED_CDATA_SECTION],
)
"""What expat reports of a file that ends too early, as a recorder without power leaves it."""


@dataclass
class _Track:
    """A track as it is read."""

    name: str = ""
    segments: int = 0
    rows: list[int] = field(default_factory=list)
    points: list[dict[str, str]] = field(default_factory=list)


@dataclass
class _Reader:
    """What the elements of a file are gathered in; its methods are expat's handlers."""

    parser: Any
    tracks: list[_Track] = field(default_factory=list)
    others: Counter[str] = field(default_factory=Counter)
    unread: Counter[str] = field(default_factory=Counter)
    creator: str = ""
    root: str = ""
    depth: int = 0
    point: dict[str, str] | None = None
    row: int = 0
    text: list[str] | None = None

    def start(self, name: str, attributes: dict[str, str]) -> None:
        local = name.rpartition(":")[2]
        self.depth += 1
        if self.depth == 1:
            self.root, self.creator = local, attributes.get("creator", "")
        elif local == "trk":
            self.tracks.append(_Track())
        elif local == "trkseg" and self.tracks:
            self.tracks[-1].segments += 1
        elif local == "trkpt" and self.tracks:
            self.row = self.parser.CurrentLineNumber
            self.point = {
                "latitude": attributes.get("lat", ""),
                "longitude": attributes.get("lon", ""),
            }
        elif local in ("wpt", "rtept"):
            self.others[local] += 1
        elif self.point is not None or (local == "name" and self.depth == 3 and self.tracks):
            self.text = []

    def end(self, name: str) -> None:
        local = name.rpartition(":")[2]
        self.depth -= 1
        if local == "trkpt" and self.point is not None:
            self.tracks[-1].points.append(self.point)
            self.tracks[-1].rows.append(self.row)
            self.point = None
        elif self.text is not None:
            text = "".join(self.text).strip()
            if self.point is not None and local.lower() in SPELLINGS:
                # A point's own elements come before those of its extensions, and count.
                self.point.setdefault(SPELLINGS[local.lower()], text)
            elif self.point is not None:
                self.unread[local] += bool(text)
            elif self.tracks and not self.tracks[-1].name:
                self.tracks[-1].name = text
        self.text = None

    def characters(self, data: str) -> None:
        if self.text is not None:
            self.text.append(data)

    def entity(self, name: str, *_: Any) -> None:
        raise InputError(
            f"declares the entity '{name}'",
            place=f"line {self.parser.CurrentLineNumber},"
            f" column {self.parser.CurrentColumnNumber + 1}",
            remedy="no recorder writes that; a file that grows while it is read is refused",
        )


def is_gpx(head: bytes) -> bool:
    """Whether a file begins as GPX does: XML whose first element is ``gpx``."""
    plain = head.replace(b"\0", b"") if head[:2] in (b"\xff\xfe", b"\xfe\xff") else head
    text = plain.removeprefix(b"\xef\xbb\xbf").lstrip(b"\xff\xfe \t\r\n")
    return text.startswith(b"<") and b"<gpx" in text[:4096]


def read_gpx(path: Path, profile: Profile | None) -> list[Recording]:  # noqa: ARG001
    """Read the tracks of a GPX file, in their order; tracks without points are not handed over.

    Raises
    ------
    InputError
        If it is no XML, with line and column; declares entities; or holds no track with points.
    """
    reader, cut = _parsed(read_bytes(path))
    filled = [track for track in reader.tracks if track.points]
    if not filled:
        others = ", ".join(f"{count} {kind}" for kind, count in reader.others.items())
        raise InputError(
            f"has no track point{f', but {others}' if others else ''}",
            remedy="give the track that was recorded, not waypoints or a planned route",
        )
    not_used = {f"points <{kind}>": count for kind, count in sorted(reader.others.items())}
    read = sorted(reader.unread.items())
    not_used |= {f"<{name}> of track points": count for name, count in read if count}
    if len(filled) < len(reader.tracks):
        not_used["tracks without points"] = len(reader.tracks) - len(filled)
    found: list[Recording] = []
    for number, track in enumerate(filled, start=1):
        several = f"{path.stem}-{number}" if len(filled) > 1 else ""
        cut_here = cut if number == len(filled) else 0
        found.append(_recording(track, several, cut_here, reader.creator, not_used))
    return found


def _parsed(data: bytes) -> tuple[_Reader, int]:
    """What a file holds, and the line at which it is cut off, 0 if it is whole."""
    parser = expat.ParserCreate()
    parser.buffer_text = True
    reader = _Reader(parser)
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.characters
    parser.EntityDeclHandler = reader.entity
    cut = 0
    # A power cut leaves zeros where there was no time for data; the last character of little-endian
    # UTF-16 ends in a zero of its own.
    plain = data.rstrip(b"\0")
    if data[:2] == b"\xff\xfe":
        plain += b"\0" * (len(plain) % 2)
    try:
        parser.Parse(plain, True)
    except expat.ExpatError as error:
        if error.code not in CUT_OFF or not any(track.points for track in reader.tracks):
            raise InputError(
                f"is not XML: {expat.ErrorString(error.code)}",
                place=f"line {error.lineno}, column {error.offset + 1}",
                remedy="copy the file again, or correct it there or just before",
            ) from error
        cut = error.lineno
    if reader.root != "gpx":
        raise InputError(
            f"is XML, but its first element is <{reader.root}>", remedy="give a GPX file"
        )
    return reader, cut


def _clock(track: _Track) -> tuple[str, Profile]:
    """Which clock a track's times are of, and how they are read.

    GPX asks for UTC. Where no time says so, a count of Unix time beside it is believed first.
    """
    times = [point.get("time", "") for point in track.points]
    if any(map(states_zone, times)) or not any(times):
        return "GNSS, UTC", LAYOUT
    counts = [point.get("unix", "") for point in track.points]
    if not all(UNIX.fullmatch(count) for count in counts):
        return "GNSS, no zone stated, taken as UTC", LAYOUT
    unit: Literal["s", "ms"] = "ms" if float(counts[0]) > MILLISECONDS else "s"
    options = TimeOptions(column="unix", format="epoch", unit=unit)
    clock = "Unix time, beside times that state no zone"
    return clock, replace(LAYOUT, time=options)


def _recording(
    track: _Track, trip: str, cut: int, creator: str, not_used: dict[str, int]
) -> Recording:
    columns = {
        name: pa.array([point.get(name) or None for point in track.points], pa.string())
        for name in COLUMNS
    }
    clock, layout = _clock(track)
    metadata = {"clock": clock, "segments": str(track.segments)}
    metadata |= {
        key: value for key, value in (("track", track.name), ("recorder", creator)) if value
    }
    for accuracy, dop, metres in (
        ("horizontal_accuracy", "hdop", HORIZONTAL_PER_HDOP),
        ("vertical_accuracy", "vdop", VERTICAL_PER_VDOP),
    ):
        if columns[accuracy].null_count == len(track.points) > columns[dop].null_count:
            name = f"/gnss/fix.{accuracy}"
            scaled = Column(column=dop, unit="m", scale=metres)
            layout = replace(layout, columns=layout.columns | {name: scaled})
            metadata[accuracy] = f"{metres:g} m times {dop.upper()}"
    present = {
        name: column
        for name, column in columns.items()
        if column.null_count < len(column) or name in ("time", "latitude", "longitude")
    }
    rows = np.array(track.rows, dtype=np.int64)
    lost = (Finding("truncated_rows", 1, (cut,)),) if cut else ()
    cells = Cells(pa.table(present), rows, rows.size + len(lost), lost)
    found = recording_of(cells, layout)
    named = {"trip": trip} if trip else {}
    return replace(found, metadata=metadata | named, not_used=dict(not_used))
