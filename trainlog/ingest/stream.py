"""Lines and messages of a recorder as they come, decoded by the readers of recorded files.

A stream may hold JSON objects, rows of a table that a profile describes, NMEA sentences and UBX
messages, mixed; or telegrams of a layout that a profile describes. What arrives is cut into lines
and messages (`Framer`), and what has gathered is decoded at once (`Decoder`), with the units and
time formats of `trainlog.ingest.mapping`.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from trainlog.display import counted
from trainlog.errors import InputError, suggestion
from trainlog.formats.railml import Element
from trainlog.formats.sfera import Documents, SferaJourney
from trainlog.ingest.mapping import LATEST, NANOSECONDS_PER, recording_of, wanted_columns
from trainlog.ingest.messages import (
    NAV_PVT,
    NAV_PVT_HEAD,
    Epochs,
    Messages,
    ReportRows,
    fixes_of_pvt,
    is_of,
)
from trainlog.ingest.profile import ARRIVAL, WORDS, Profile, known_field
from trainlog.ingest.recording import NO_TIME, Cells, Finding, Table
from trainlog.ingest.sources import BLOCK
from trainlog.ingest.telegrams import chosen, columns_of
from trainlog.topics import TOPICS
from trainlog.units import DAY

UBX = b"\xb5\x62"
"""What a UBX message begins with."""

UBX_FRAME = 8
"""Octets of a UBX message beside its payload: mark, class, kind, length, checksum."""

LONGEST_UBX = 4096
"""Payload of a UBX message [bytes] beyond which its length is damaged."""

Numbered = tuple[int, bytes]
"""A line or message with its number in the stream, from 1."""


@dataclass(frozen=True)
class Malformed:
    """A line or message that cannot be used.

    Attributes
    ----------
    row : int
        Its number in the stream.
    text : str
        As it came; octets that are no text in hexadecimal digits.
    reason : str
    """

    row: int
    text: str
    reason: str


class Framer:
    """Cuts a stream of octets into lines, without their ends, and UBX messages."""

    def __init__(self) -> None:
        self._rest = b""

    def cut(self, data: bytes, *, whole: bool = False) -> list[bytes]:
        r"""The lines and messages that are complete.

        Parameters
        ----------
        data : bytes
            What comes next.
        whole : bool
            Whether it ends with the end of a line or message, as a datagram does.

        Examples
        --------
        >>> framer = Framer()
        >>> framer.cut(b"a;1\r\nb;")
        [b'a;1']
        >>> framer.cut(b"2\n"), framer.cut(b"c;3", whole=True)
        ([b'b;2'], [b'c;3'])
        """
        if whole and not self._rest and data.lstrip()[:1] == b"<":
            return [data]  # a document of several lines
        data = self._rest + data
        frames: list[bytes] = []
        at = 0
        while at < len(data):
            mark = data.find(UBX, at)
            if mark != at:
                text = data[at:] if mark < 0 else data[at:mark]
                *lines, rest = text.split(b"\n")
                frames += lines
                at += len(text)
                if mark >= 0 or whole or len(rest) > BLOCK:
                    frames.append(rest)
                else:
                    at -= len(rest)
                    break
                continue
            size = _ubx_size(data[at : at + UBX_FRAME])
            if size is None or at + size > len(data):
                if not whole:
                    break
                size = len(data) - at
            frames.append(data[at : at + size])
            at += size
        self._rest = data[at:]
        return [each for each in (f if f[:2] == UBX else f.rstrip(b"\r") for f in frames) if each]

    def end(self) -> bytes:
        """What is left of a line that did not end; nothing is left then."""
        rest, self._rest = self._rest, b""
        return rest.strip()


def _ubx_size(head: bytes) -> int | None:
    """Length of the UBX message that begins so; None if that is not known yet."""
    if len(head) < 6:
        return None
    length = int.from_bytes(head[4:6], "little")
    return length + UBX_FRAME if length <= LONGEST_UBX else 2


@dataclass
class Decoded:
    """What lines and messages hold.

    Attributes
    ----------
    tables : dict of str to Table
        By the kind of lines; nothing is repaired yet but what the readers repair.
    constants : dict of str to float or str
        As in `Recording`.
    malformed : list of Malformed
    findings : list of Finding
    others : Counter of str
        Messages that are not used, by name.
    numbers : list of int
        The sender's sequence numbers, in order of arrival.
    """

    tables: dict[str, Table] = field(default_factory=dict)
    constants: dict[str, float | str] = field(default_factory=dict)
    malformed: list[Malformed] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    others: Counter[str] = field(default_factory=Counter)
    numbers: list[int] = field(default_factory=list)

    def refuse(self, row: int, data: bytes, reason: str) -> None:
        """Take note of a line that cannot be used."""
        self.malformed.append(Malformed(row, as_it_came(data), reason))

    def count(self, numbers: Iterable[Any]) -> None:
        """Take the sender's sequence numbers; what is no number is none of them."""
        for number in numbers:
            with suppress(TypeError, ValueError):
                self.numbers.append(int(number))


def as_it_came(data: bytes) -> str:
    """Octets as text; those that are no text in hexadecimal digits."""
    readable = data.decode("utf-8", "replace")
    return readable if readable.isprintable() else data.hex(" ")


class Decoder:
    """Decodes lines and messages in the order of their arrival.

    Parameters
    ----------
    profile : Profile, optional
        Which column, or key of a JSON object, is what; rows of a table need it.
    header : tuple of str, optional
        Names of the columns, where the stream does not begin with them.
    sequence : str
        Column or key that holds the number the sender counts its lines with.
    journey : SferaJourney, optional
        Whose train sends status reports.
    """

    def __init__(
        self,
        profile: Profile | None = None,
        header: tuple[str, ...] | None = None,
        sequence: str = "sequence",
        journey: SferaJourney | None = None,
    ) -> None:
        self._reports = None if journey is None else ReportRows(journey)
        self._profile, self._sequence, self._names = profile, sequence, header
        self._last = NO_TIME  # of a profile whose times have no date
        self._sentences = _Sentences()
        self._needed: set[str] = set()
        self._words: set[str] = set()
        if profile is not None and profile.time is not None:
            needed = [c.names for c in profile.columns.values() if not c.optional]
            self._needed = {*profile.time.names, *(name for names in needed for name in names)}
            aliases = profile.file.aliases
            spelt = [(name, f'"{name}"', *aliases.get(name, ())) for name in self._needed]
            self._words = {spelling.lower() for each in spelt for spelling in each}

    def decode(self, frames: Iterable[Numbered]) -> Decoded:
        """What the next lines and messages hold; an NMEA epoch once the next one has begun."""
        decoded = Decoded()
        kinds: dict[str, list[Numbered]] = {}
        telegrams = self._profile is not None and self._profile.telegram is not None
        for row, data in frames:
            kind = "telegram" if telegrams else _kind(data)
            kinds.setdefault(kind, []).append((row, data))
        readers = {
            "telegram": self._telegrams, "ubx": _ubx, "nmea": self._sentences.take,
            "json": self._json, "row": self._rows, "sfera": self._status,
        }  # fmt: skip
        for kind, read in readers.items():
            if kind in kinds:
                read(kinds[kind], decoded)
        return decoded

    def end(self) -> Decoded:
        """What waits for lines that do not come: the last NMEA epoch."""
        decoded = Decoded()
        self._sentences.give(decoded)
        return decoded

    def _status(self, frames: list[Numbered], decoded: Decoded) -> None:
        """Status reports of SFERA, of the journey's train."""
        kept: list[tuple[int, int, Element]] = []
        for row, data in frames:
            documents = Documents()
            try:
                documents.take("a message", data, journeys=False)
            except InputError as error:
                decoded.refuse(row, data, error.problem)
                continue
            if self._reports is None:
                decoded.refuse(row, data, "XML; status reports need the journey of their train")
                continue
            reports, journey = documents.reports, self._reports.journey
            own = [(time, row, each) for time, each in reports if is_of(each, journey)]
            kept += own
            if not own:
                which = "reports of other trains" if reports else "other messages"
                decoded.others[which] += 1
        if kept and self._reports is not None:
            tables = self._reports.take(kept)
            decoded.tables |= dict(zip(("sfera", "sfera events"), tables, strict=False))

    def _telegrams(self, frames: list[Numbered], decoded: Decoded) -> None:
        profile = self._profile
        options = None if profile is None else profile.telegram
        assert profile is not None
        assert options is not None
        kept = []
        for row, data in frames:
            if len(data) == options.length and data.startswith(options.mark_bytes):
                kept.append((row, data))
            else:
                size = counted(len(data), "byte")
                decoded.refuse(row, data, f"no telegram of the profile's layout: {size}")
        octets = np.frombuffer(b"".join(data for _, data in kept), np.uint8)
        octets = octets.reshape(-1, options.length)
        wanted = chosen(octets, options)
        decoded.others += Counter({"telegrams of other kinds": int(np.count_nonzero(~wanted))})
        octets, kept = octets[wanted], [kept[n] for n in np.flatnonzero(wanted)]
        if not kept:
            return
        if self._sequence in options.columns:
            numbers = columns_of(octets, [self._sequence], options)[self._sequence]
            decoded.count(numbers.to_pylist())
        names = wanted_columns(profile, (*options.columns, ARRIVAL))
        self._read("telegram", kept, columns_of(octets, names, options), profile, decoded)

    def _read(
        self, kind: str, frames: list[Numbered], cells: pa.Table, profile: Profile, decoded: Decoded
    ) -> None:
        """Give the columns of rows their meaning, as the profile states it."""
        rows = np.array([row for row, _ in frames], dtype=np.int64)
        try:
            found = recording_of(Cells(cells, rows, rows.size), profile)
        except InputError as error:
            if len(frames) == 1:
                decoded.refuse(*frames[0], error.problem)
                return
            # One row that does not fit must not cost the others.
            for number, frame in enumerate(frames):
                self._read(kind, [frame], cells.slice(number, 1), profile, decoded)
            return
        (table,) = found.tables
        if profile.time is not None and profile.time.date is not None:
            # A time of day far before the last one is that of the next day.
            early = self._last != NO_TIME and (table.time < self._last - DAY // 2)
            table = table.at(
                np.where(early & (table.time != NO_TIME), table.time + DAY, table.time)
            )
            self._last = max(self._last, int(table.time[-1]))
        before = decoded.tables.get(kind)
        decoded.tables[kind] = table if before is None else before.then(table)
        decoded.constants |= found.constants
        decoded.findings += found.findings

    def _map(
        self,
        kind: str,
        frames: list[Numbered],
        columns: Mapping[str, Sequence[str | None]],
        decoded: Decoded,
    ) -> None:
        """Decode rows whose cells are given by column, as text."""
        profile = self._profile
        assert profile is not None
        if self._last != NO_TIME and profile.time is not None:
            # Times of day count from the day of the last row.
            last = pd.Timestamp(self._last, tz="UTC").tz_convert(profile.time.timezone)
            time = replace(profile.time, date=last.date())
            profile = replace(profile, time=time)
        missing, absent = set(profile.file.missing), (None,) * len(frames)
        cells = {
            name: [None if each in missing else each for each in columns.get(name, absent)]
            for name in wanted_columns(profile, tuple(columns))
        }
        table = pa.table({name: pa.array(each, pa.string()) for name, each in cells.items()})
        self._read(kind, frames, table, profile, decoded)

    def _rows(self, frames: list[Numbered], decoded: Decoded) -> None:
        """Rows of a table, and its header."""
        profile = self._profile
        comment = b"" if profile is None else profile.file.comment.encode()
        kept: list[tuple[Numbered, list[str]]] = []
        for row, data in frames:
            if profile is None:
                reason = "neither JSON, NMEA nor UBX; a row of a table needs a profile"
                decoded.refuse(row, data, reason)
                continue
            if not data.strip() or (comment and data.startswith(comment)):
                continue
            try:
                cells = _cells(data.decode(profile.file.encoding), profile.file.delimiter)
            except (UnicodeDecodeError, csv.Error):
                decoded.refuse(row, data, f"no text in {profile.file.encoding}")
                continue
            if self._take_header(cells, profile):
                continue
            width = len(self._names or ())
            if width and not any(cells[width:]):
                del cells[width:]
            if len(cells) == width:
                kept.append(((row, data), cells))
            else:
                wrong = f"{len(cells)} cells, the header has {width}"
                decoded.refuse(row, data, wrong if width else "a row before the header")
        if kept and self._names is not None:
            values = zip(*(cells for _, cells in kept), strict=True)
            columns = dict(zip(self._names, values, strict=True))
            decoded.count(columns.get(self._sequence, ()))
            self._map("row", [frame for frame, _ in kept], columns, decoded)

    def _take_header(self, cells: list[str], profile: Profile) -> bool:
        """Whether the cells are the names of the columns, which are used from then on."""
        if profile.file.header == 0:
            self._names = self._names or tuple(str(n) for n in range(1, len(cells) + 1))
            return False
        if self._words.isdisjoint([cell.lower() for cell in cells]):
            return False
        names = profile.file.named([cell.strip().strip('"') for cell in cells])
        while names and not names[-1]:
            names = names[:-1]
        if not self._needed <= set(names):
            return False
        self._names = names
        return True

    def _json(self, frames: list[Numbered], decoded: Decoded) -> None:
        """JSON objects: by the keys that a profile names, or of fields of our topics, in SI."""
        objects: list[tuple[Numbered, dict[str, Any]]] = []
        for row, data in frames:
            try:
                value = json.loads(data, parse_constant=lambda _: None)
            except (ValueError, RecursionError) as error:
                decoded.refuse(row, data, f"no JSON: {error}")
                continue
            for each in value if isinstance(value, list) else [value]:
                if isinstance(each, dict):
                    objects.append(((row, data), each))
                else:
                    decoded.refuse(row, data, "no JSON object")
        decoded.count(each.get(self._sequence) for _, each in objects)
        if self._profile is None:
            _samples(objects, self._sequence, decoded)
            return
        needed = {name for column in self._profile.columns.values() for name in column.names}
        used: list[tuple[Numbered, dict[str, str | None]]] = []
        for frame, each in objects:
            flat = dict(_flat(each))
            if needed & flat.keys():
                used.append((frame, flat))
            else:
                decoded.refuse(*frame, "holds none of the keys that the profile names")
        if used:
            every = dict.fromkeys(name for _, flat in used for name in flat)
            columns = {name: [flat.get(name) for _, flat in used] for name in every}
            self._map("json", [frame for frame, _ in used], columns, decoded)


def _kind(data: bytes) -> str:
    """What a line or message is, by how it begins."""
    if data[:2] == UBX:
        return "ubx"
    first = data.lstrip()[:1]
    if first == b"<":
        return "sfera"
    if first in (b"{", b"["):
        return "json"
    if first in (b"$", b"!") or (b"$" in data[:64] and b"*" in data[-4:]):
        return "nmea"
    return "row"


def _cells(line: str, delimiter: str) -> list[str]:
    if '"' not in line:
        return line.split(delimiter)
    return next(csv.reader([line], delimiter=delimiter, strict=True))


def _flat(value: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str | None]]:
    """The values of an object as text, those of objects within by ``"outer.inner"``."""
    for key, each in value.items():
        name = f"{before}{key}"
        if isinstance(each, dict):
            yield from _flat(each, f"{name}.")
        elif isinstance(each, list):
            yield from _flat({str(number): part for number, part in enumerate(each, 1)}, f"{name}.")
        elif each is None or isinstance(each, str):
            yield name, each
        else:
            yield name, str(int(each)) if isinstance(each, bool) else repr(each)


def time_of(value: Any) -> int:
    """A time [ns UTC] as JSON gives it: ISO 8601, or a number since 1970 in s, ms, us or ns.

    Raises
    ------
    ValueError
        If it is no time after 1980.

    Examples
    --------
    >>> time_of("2024-05-01T06:00:00.5Z") == time_of(1714543200.5) == time_of(1714543200500)
    True
    """
    found: Any = pd.NaT
    if isinstance(value, str):
        found = pd.to_datetime(value, utc=True, errors="coerce", format="ISO8601")
    elif isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value):
        units = NANOSECONDS_PER.values()
        unit = next((unit for unit in units if abs(value) * unit < LATEST), 1)
        whole, rest = divmod(value, 1)
        # A number of seconds since 1970 is known to the microsecond.
        found = pd.Timestamp(int(whole) * unit + int(round(rest * unit, -3)), tz="UTC")
    if found is pd.NaT or found.year < 1980:
        raise ValueError(f"time {value!r} is not a time; write ISO 8601, or a number since 1970")
    return int(found.as_unit("ns").value)


def _samples(
    objects: list[tuple[Numbered, dict[str, Any]]], sequence: str, decoded: Decoded
) -> None:
    """Decode objects whose keys are fields of our topics."""
    groups: dict[str, list[tuple[int, int, dict[str, Any]]]] = {}
    for (row, data), each in objects:
        try:
            time, values = _sample(each, sequence)
        except (ValueError, TypeError, OverflowError) as error:
            decoded.refuse(row, data, str(error))
            continue
        topics = " ".join(sorted({name.rpartition(".")[0] for name in values}))
        groups.setdefault(f"json {topics}", []).append((row, time, values))
    decoded.tables |= {kind: _table_of(samples) for kind, samples in groups.items()}


def _sample(each: dict[str, Any], sequence: str) -> tuple[int, dict[str, Any]]:
    """Time and values of a JSON object, by column; `NO_TIME` where it states no time."""
    topic = each.get("topic", "")
    if topic and topic not in TOPICS:
        raise ValueError(f"no topic {topic!r}; {suggestion(str(topic), TOPICS)}")
    values: dict[str, Any] = {}
    for key, value in each.items():
        if key not in ("time", "topic") and (key != sequence or topic.endswith(key)):
            values |= _values(key if key.startswith("/") else f"{topic}.{key}", value)
    if not values:
        raise ValueError("has no values")
    return (time_of(each["time"]) if "time" in each else NO_TIME), values


def _values(name: str, value: Any) -> dict[str, Any]:
    """The columns that a value fills: one, or one for each axle."""
    several = _several(name)
    if name in WORDS:
        return {name: str(value)}
    if value is None:
        return {}
    if isinstance(value, list) != several:
        wanted = "a list, one number an axle" if several else "one number"
        raise ValueError(f"{name} must be {wanted}")
    parts = value if several else [value]
    if any(isinstance(part, str) for part in parts):
        raise ValueError(f"{name} is {value!r}, no number")
    names = [f"{name}_{axle}" for axle in range(1, len(parts) + 1)] if several else [name]
    return {
        each: np.nan if part is None else float(part)
        for each, part in zip(names, parts, strict=True)
    }


@cache
def _several(name: str) -> bool:
    """Whether a field has a value for each axle, and no number of one in its name."""
    base, _, number = name.rpartition("_")
    return known_field(base if number.isdigit() else name).per_axle and not number.isdigit()


def _table_of(samples: list[tuple[int, int, dict[str, Any]]]) -> Table:
    rows, time, values = zip(*samples, strict=True)
    columns = {
        name: [each.get(name, "" if name in WORDS else np.nan) for each in values]
        for name in dict.fromkeys(name for each in values for name in each)
    }
    return Table(
        np.array(time, dtype=np.int64),
        np.array(rows, dtype=np.int64),
        {name: np.array(each) for name, each in columns.items() if name not in WORDS},
        {name: np.array(columns[name], dtype=np.object_) for name in WORDS if name in columns},
    )


# --------------------------------------------------------------------------------- UBX and NMEA


def _ubx(frames: list[Numbered], decoded: Decoded) -> None:
    """The fixes of UBX-NAV-PVT; other messages are counted, damaged ones are malformed."""
    fixes: list[Numbered] = []
    for row, data in frames:
        body, sums = np.frombuffer(data[2:-2], np.uint8), data[-2:]
        first = np.cumsum(body, dtype=np.int64)
        whole = len(data) >= UBX_FRAME and len(data) == _ubx_size(data[:UBX_FRAME])
        if not whole or bytes((int(first[-1]) % 256, int(first.sum()) % 256)) != sums:
            decoded.refuse(row, data, "a UBX message whose length or checksum is wrong")
        elif data.startswith(NAV_PVT_HEAD):
            fixes.append((row, data))
        else:
            decoded.others[f"UBX {data[2]:02x} {data[3]:02x}"] += 1
    if fixes:
        octets = np.frombuffer(b"".join(data for _, data in fixes), NAV_PVT)
        decoded.tables["ubx"] = fixes_of_pvt(octets, np.array([row for row, _ in fixes]))


class _Sentences:
    """NMEA sentences as they come: an epoch is whole when the next one begins."""

    def __init__(self) -> None:
        self._epochs: Epochs | None = None
        self._last = NO_TIME

    def take(self, frames: list[Numbered], decoded: Decoded) -> None:
        self._epochs = self._epochs or Epochs()
        messages = Messages()
        data = dict(frames)
        for row, line in frames:
            prefix, mark, sentence = line.decode("ascii", "replace").partition("$")
            self._epochs.take(row, prefix, mark + sentence.rstrip(), messages)
        for row in messages.damaged_rows:
            decoded.refuse(row, data[row], "an NMEA sentence whose checksum or cells are wrong")
        decoded.others += messages.others
        self.give(decoded, waiting=1)

    def give(self, decoded: Decoded, waiting: int = 0) -> None:
        """Give the epochs but for the last ones, which may not be whole yet."""
        if self._epochs is None or len(self._epochs.found) <= waiting:
            return
        whole = len(self._epochs.found) - waiting
        found, self._epochs.found = self._epochs.found[:whole], self._epochs.found[whole:]
        epochs, first = Epochs(found), found[0]
        if self._last != NO_TIME and all(epoch.date is None for epoch in found):
            last = pd.Timestamp(self._last, tz="UTC")
            minute = first.of_day.hour * 60 + first.of_day.minute
            later = minute < (last.hour * 60 + last.minute) - 720
            first.date = (last + pd.Timedelta(days=int(later))).date()
        try:
            table = epochs.table()
        except InputError as error:
            for epoch in found:
                decoded.refuse(epoch.row, b"", error.problem)
            return
        self._last = int(table.time[-1])
        decoded.tables["nmea"] = table
