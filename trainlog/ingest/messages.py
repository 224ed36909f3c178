"""Formats ``nmea``, ``tagged`` and ``sfera``: messages of receivers and of trains.

``nmea``: NMEA 0183 sentences, with or without the logger's time before them. RMC, GGA, GNS, VTG,
GST, GSA and ZDA are used, others are counted. Sentences of the same time of day are one epoch,
which becomes one row; VTG, GST and GSA belong to the epoch they follow. The date comes from RMC or
ZDA, else from the logger's own time; midnight is noticed. Sentences are parsed, and their checksums
verified, by pynmeagps (extra ``recorders``).

``tagged``: lines of several kinds, each with its time and hexadecimal digits. A profile says which
kinds there are: samples of numbers, messages of a u-blox receiver (UBX), or NMEA sentences. Lines
of different kinds may be out of order. Where their time counts since the logger was started, UTC
comes from the receiver's UBX-NAV-PVT (or RMC), and is carried back to before the first of them.

``sfera``: status reports of a train (B2G_StatusReport), beside its journey. Places are locations in
segments: the journey and the segments that it names make positions of them, so that the documents
stand in one archive or file with the reports.
"""

from __future__ import annotations

import datetime
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import itemgetter, xor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.extras import load
from trainlog.formats.files import read_bytes
from trainlog.formats.railml import Element
from trainlog.formats.sfera import Documents, SferaJourney, is_sfera, journeys_of
from trainlog.ingest.mapping import elapsed_time, from_parts, read_time, recording_of, undescribed
from trainlog.ingest.profile import LineOptions, Payload, Profile, TimeOptions
from trainlog.ingest.recording import (
    HORIZONTAL_PER_HDOP,
    MOST,
    NO_TIME,
    Cells,
    Finding,
    Raw,
    Recording,
    Table,
)
from trainlog.ingest.tabular import open_text
from trainlog.topics import SLIP_PROTECTION
from trainlog.units import DAY, KMH, NANOSECONDS

KNOT = 1852.0 / 3600.0
"""Metres a second in one knot."""

COLUMNS = {
    "latitude": "/gnss/fix.latitude",
    "longitude": "/gnss/fix.longitude",
    "altitude": "/gnss/fix.altitude",
    "horizontal_accuracy": "/gnss/fix.horizontal_accuracy",
    "vertical_accuracy": "/gnss/fix.vertical_accuracy",
    "speed": "/gnss/motion.speed",
    "satellites": "/gnss/motion.satellites",
    "pdop": "/gnss/motion.pdop",
}

SENTENCE = re.compile(rb"\$[A-Z]{2}[A-Z]{3},")


@dataclass
class Messages:
    """Messages as they are read: which are damaged, which are of no use, and how many there are.

    Attributes
    ----------
    read : int
        All messages.
    others : Counter
        Messages of kinds that are not used, by name.
    """

    read: int = 0
    others: Counter[str] = field(default_factory=Counter)
    damaged_rows: list[int] = field(default_factory=list)
    damaged_text: list[str] = field(default_factory=list)

    def damaged(self, row: int, text: str) -> None:
        """Count a message that cannot be read."""
        self.damaged_rows.append(int(row))
        self.damaged_text.append(text)

    def findings(self) -> tuple[Finding, ...]:
        """The finding that messages are damaged; none if there are none.

        Raises
        ------
        InputError
            If most of them are.
        """
        count = len(self.damaged_rows)
        if count > MOST * self.read:
            raise InputError(
                f"{count} of {self.read} messages are damaged",
                place=f"row {self.damaged_rows[0]}",
                remedy="copy the file again; is it of this format?",
            )
        return tuple(Finding.met("damaged_messages", np.array(self.damaged_rows)))

    def raw(self) -> tuple[Raw, ...]:
        """The damaged messages as they stood in the file."""
        rows = np.array(self.damaged_rows, dtype=np.int64)
        return Raw.lines("damaged_messages", rows, self.damaged_text)


def is_nmea(head: bytes) -> bool:
    """Whether a file begins with lines that hold NMEA sentences."""
    lines = [line for line in head.split(b"\n", 12)[:12] if line.strip()]
    found = sum(bool(SENTENCE.search(line)) for line in lines)
    return bool(lines) and found >= max(1, len(lines) - 3) and b"\0" not in head[:512]


def read_nmea(path: Path, profile: Profile | None) -> Recording:  # noqa: ARG001
    """Read a text log of NMEA sentences.

    Raises
    ------
    InputError
        If it holds no sentence that gives a position or a speed, no date, or most are damaged.
    """
    text = read_bytes(path).rstrip(b"\0").decode("ascii", "replace")
    messages, epochs = Messages(), Epochs()
    for row, line in enumerate(text.splitlines(), start=1):
        prefix, mark, sentence = line.partition("$")
        if mark:
            epochs.take(row, prefix, mark + sentence.rstrip(), messages)
        elif line.strip():
            messages.others["lines without a sentence"] += 1
    damaged = messages.findings()
    table = epochs.table()
    return Recording(
        (table,),
        len(table),
        damaged,
        metadata={"clock": "GNSS, UTC"} | epochs.metadata(),
        not_used=dict(sorted(messages.others.items())),
        raw=messages.raw(),
    )


@dataclass
class Epoch:
    """What sentences of one time of day say, and what stands before the first of them."""

    row: int
    prefix: str
    of_day: datetime.time
    date: datetime.date | None = None
    values: dict[str, float] = field(default_factory=dict)


class Epochs:
    """The epochs that sentences make, gathered one sentence after the other."""

    def __init__(self, found: Sequence[Epoch] = ()) -> None:
        self.parse = load("pynmeagps").NMEAReader.parse
        self.found = list(found)
        self.from_dop = False

    def take(self, row: int, prefix: str, sentence: str, messages: Messages) -> None:
        """Add a sentence to its epoch; what cannot be parsed is counted as damaged."""
        messages.read += 1
        if not _whole(sentence):
            messages.damaged(row, sentence)
            return
        if sentence[3:6] not in SENTENCES:
            messages.others[f"NMEA {sentence[1:].partition(',')[0]}"] += 1
            return
        try:
            parsed = self.parse(f"{sentence}\r\n".encode("ascii", "replace"), validate=1)
        except Exception:  # noqa: BLE001 - the parser raises whatever a cell leads it to
            messages.damaged(row, sentence)
            return
        kind = parsed.msgID
        of_day = getattr(parsed, "time", None)
        if kind in TIMED:
            if not isinstance(of_day, datetime.time):
                messages.others[f"NMEA {kind} without a time"] += 1
                return
            if not self.found or of_day != self.found[-1].of_day:
                self.found.append(Epoch(row, prefix, of_day))
        elif not self.found:
            messages.others[f"NMEA {kind} before the first time"] += 1
            return
        epoch = self.found[-1]
        epoch.date = _date(kind, parsed) or epoch.date
        for name, value in _values(kind, parsed).items():
            if np.isfinite(value):
                epoch.values.setdefault(name, value)

    def table(self) -> Table:
        """The epochs as a table.

        Raises
        ------
        InputError
            If there are none, or no date is known.
        """
        if not self.found:
            raise InputError(
                "has no RMC, GGA or GNS sentence with a time",
                remedy="have the receiver write them, and give its log",
            )
        columns = {
            name: np.array([epoch.values.get(name, np.nan) for epoch in self.found])
            for name in (*COLUMNS, "hdop", "fixed")
        }
        # What a receiver without a fix repeats is no position.
        lost = columns.pop("fixed") == 0.0
        for name in ("latitude", "longitude"):
            columns[name] = np.where(lost, np.nan, columns[name])
        hdop = columns.pop("hdop")
        if not np.isfinite(columns["horizontal_accuracy"]).any() and np.isfinite(hdop).any():
            self.from_dop = True
            columns["horizontal_accuracy"] = HORIZONTAL_PER_HDOP * hdop
        signals: dict[str, FloatArray] = {
            COLUMNS[name]: values for name, values in columns.items() if np.isfinite(values).any()
        }
        rows = np.array([epoch.row for epoch in self.found], dtype=np.int64)
        return Table(self._time(), rows, signals)

    def metadata(self) -> dict[str, str]:
        """Metadata of how values were come by."""
        if not self.from_dop:
            return {}
        return {"horizontal_accuracy": f"{HORIZONTAL_PER_HDOP:g} m times HDOP"}

    def _time(self) -> IntArray:
        """UTC of the epochs [ns]: the date that their sentences give, or that of those around."""
        of_day = np.array([_nanoseconds(epoch.of_day) for epoch in self.found], dtype=np.int64)
        step = np.diff(of_day, prepend=of_day[:1])
        day = np.cumsum((step < -DAY // 2).astype(np.int64) - (step > DAY // 2))
        dates = [epoch.date for epoch in self.found]
        dated = np.array([NO_TIME if day is None else pd.Timestamp(day).value for day in dates])
        if np.all(dated == NO_TIME):
            dated = self._logged_dates(of_day)
        known = dated != NO_TIME
        if not known.any():
            raise InputError(
                "gives the time of day, but no date",
                place=f"row {self.found[0].row}",
                remedy="have the receiver write RMC or ZDA too",
            )
        base = dated[known] - day[known] * DAY
        usual, counts = np.unique(base, return_counts=True)
        date = np.where(known, dated, usual[np.argmax(counts)] + day * DAY)
        return np.asarray(date + of_day)

    def _logged_dates(self, of_day: IntArray) -> IntArray:
        """Dates [ns] that the logger wrote before the sentences; `NO_TIME` where it wrote none."""
        words = pd.Series([epoch.prefix for epoch in self.found]).str.strip(" ,;:\t[]")
        stamps = pd.to_datetime(
            words.where(words.str.contains("-", regex=False)),
            format="ISO8601",
            utc=True,
            errors="coerce",
        )
        logged = pd.DatetimeIndex(stamps).as_unit("ns").asi8
        # The logger's clock may be beside the receiver's, also across midnight.
        near = np.round((logged - of_day) / DAY).astype(np.int64) * DAY
        return np.where(pd.isna(stamps), NO_TIME, near)


def _whole(sentence: str) -> bool:
    """Whether a sentence ends with the checksum of what stands before it."""
    body, mark, checksum = sentence[1:].rpartition("*")
    if not (mark and body.isascii() and body.isprintable()):
        return False  # the exclusive or does not see the same wrong byte twice
    return f"{reduce(xor, body.encode(), 0):02X}" == checksum.upper()


def _nanoseconds(time: datetime.time) -> int:
    seconds = (time.hour * 60 + time.minute) * 60 + time.second
    return (seconds * 1_000_000 + time.microsecond) * 1_000


def _date(kind: str, parsed: Any) -> datetime.date | None:
    """The date that a sentence gives."""
    if kind == "RMC":
        date = getattr(parsed, "date", None)
        return date if isinstance(date, datetime.date) else None
    if kind == "ZDA":
        try:
            return datetime.date(int(parsed.year), int(parsed.month), int(parsed.day))
        except (TypeError, ValueError):
            return None
    return None


_PLACE = {"latitude": "lat", "longitude": "lon"}
_FIX = {**_PLACE, "altitude": "alt", "satellites": "numSV", "hdop": "HDOP"}

SENTENCES = {
    "RMC": {**_PLACE, "knots": "spd"},
    "GGA": _FIX,
    "GNS": _FIX,
    "VTG": {"kmh": "sogk", "knots": "sogn"},
    "GST": {"north": "stdLat", "east": "stdLong", "vertical_accuracy": "stdAlt"},
    "GSA": {"pdop": "PDOP"},
    "ZDA": {},
}
"""Sentences that are used: values by the names that pynmeagps gives them."""

_HAS_FIX: dict[str, Callable[[Any], bool]] = {
    "RMC": lambda parsed: parsed.status == "A",
    "GGA": lambda parsed: parsed.quality != 0,
    "GNS": lambda parsed: bool(set(str(parsed.posMode)) - {"N"}),
}
"""Whether a sentence with a position says that the receiver has a fix."""


def _values(kind: str, parsed: Any) -> dict[str, float]:
    """The values of a sentence, in SI units."""
    found = {}
    for ours, theirs in SENTENCES[kind].items():
        value = getattr(parsed, theirs, "")
        if isinstance(value, int | float):
            found[ours] = float(value)
    if kind in _HAS_FIX:
        found["fixed"] = float(_HAS_FIX[kind](parsed))
    for unit, size in (("knots", KNOT), ("kmh", 1.0 / KMH)):
        if unit in found:
            found["speed"] = found.pop(unit) * size
    if kind == "GST":
        north, east = found.pop("north", np.nan), found.pop("east", np.nan)
        found["horizontal_accuracy"] = float(np.sqrt(0.5 * (north**2 + east**2)))
    return found


TIMED = ("RMC", "GGA", "GNS", "ZDA", "GST")
"""Those of them that give the time of day."""


# ------------------------------------------------------------------ lines of several kinds


WINDOW = 60 * NANOSECONDS
"""Time [ns] over which the offset of the logger's clock is taken as constant."""

MAX_OFFSET_CHANGE = NANOSECONDS
"""Change of the offset [ns] from one window to the next beyond which the clock was restarted."""

FIX = (2, 3, 4)
"""Fix types of UBX-NAV-PVT that are a position: 2D, 3D, and 3D with dead reckoning."""

FIX_OK, DATE_AND_TIME = 0x01, 0x03
"""Bits of `flags` (fix within limits) and of `valid` (date and time are known)."""

NAV_PVT_HEAD = b"\xb5\x62\x01\x07\x5c\x00"
"""Mark, class, kind and length of UBX-NAV-PVT."""

NAV_PVT_FIELDS = {
    "year": ("<u2", 4),
    "month": ("u1", 6),
    "day": ("u1", 7),
    "hour": ("u1", 8),
    "minute": ("u1", 9),
    "second": ("u1", 10),
    "valid": ("u1", 11),
    "nano": ("<i4", 16),
    "fix_type": ("u1", 20),
    "flags": ("u1", 21),
    "satellites": ("u1", 23),
    "longitude": ("<i4", 24),
    "latitude": ("<i4", 28),
    "altitude": ("<i4", 36),
    "horizontal_accuracy": ("<u4", 40),
    "vertical_accuracy": ("<u4", 44),
    "speed": ("<i4", 60),
    "speed_accuracy": ("<u4", 68),
    "pdop": ("<u2", 76),
}
"""Fields of UBX-NAV-PVT that are used, and where they stand in it."""

NAV_PVT = np.dtype(
    {
        "names": list(NAV_PVT_FIELDS),
        "formats": [kind for kind, _ in NAV_PVT_FIELDS.values()],
        "offsets": [len(NAV_PVT_HEAD) + offset for _, offset in NAV_PVT_FIELDS.values()],
        "itemsize": 100,
    }
)
"""The whole message, with mark and checksum."""

Anchors = tuple[IntArray, IntArray]
"""Times of the logger [ns], and the UTC [ns] that messages give for them."""


def read_tagged(path: Path, profile: Profile | None) -> Recording:
    """Read the lines; what is no whole line, sample or message is counted.

    Raises
    ------
    InputError
        If the profile does not describe the lines, no message gives the time, the clock was
        restarted, or most lines are damaged.
    """
    if profile is None or profile.lines is None or profile.time is None:
        raise undescribed(
            "holds lines of several kinds, which no profile describes", "with [time] and [lines]"
        )
    lines = _lines(path, profile, profile.time, profile.lines)
    kinds = profile.lines.kinds
    numbers = [
        _samples(lines, kind, payload, profile)
        for kind, payload in kinds.items()
        if payload.dtype is not None
    ]
    messages = Messages()
    gnss, anchors = _receiver(lines, kinds, messages)
    tables = [table for item, _ in numbers if item is not None for table in item.tables]
    metadata: dict[str, str] = {}
    if profile.time.start == "messages":
        offset = _Offset(*anchors)
        tables = [table.at(offset.utc(table.time)) for table in tables]
        metadata["clock.anchors"] = str(offset.count)
    damaged = ~np.isin(lines.kind, list(kinds))
    for _, cut in numbers:
        damaged |= cut
    constants: dict[str, float | str] = {}
    for item, _ in numbers:
        constants |= item.constants if item is not None else {}
    return Recording(
        tuple(([] if gnss is None else [gnss]) + tables),
        sum(map(len, tables)) + (0 if gnss is None else len(gnss)) + int(damaged.sum()) + lines.cut,
        (
            *lines.cells.findings,
            *messages.findings(),
            *Finding.met("damaged_messages", lines.rows[damaged]),
        ),
        constants,
        metadata,
        {name: count for name, count in sorted(messages.others.items()) if count},
        raw=(
            *lines.cells.raw,
            *messages.raw(),
            *Raw.lines("damaged_messages", lines.rows[damaged], lines.text(damaged)),
        ),
    )


@dataclass(frozen=True, eq=False)
class _Lines:
    """The lines of a file."""

    cells: Cells
    time: IntArray
    """As the lines give it [ns]; `NO_TIME` where it cannot be read."""
    kind: NDArray[np.object_]
    payload: pa.ChunkedArray

    @property
    def rows(self) -> IntArray:
        return self.cells.rows

    @property
    def cut(self) -> int:
        """Lines that could not be split into cells."""
        return self.cells.rows_read - self.rows.size

    def octets(self, mine: BoolArray, size: int) -> tuple[IntArray, NDArray[np.uint8]]:
        """Which of the lines hold `size` octets and no others, and these (n, size)."""
        digits = pc.match_substring_regex(self.payload, r"^[0-9A-Fa-f]*$").to_numpy()
        whole = mine & digits & (pc.binary_length(self.payload).to_numpy() == 2 * size)
        text = "".join(self.text(whole))
        octets = np.frombuffer(bytes.fromhex(text), dtype=np.uint8).reshape(-1, size)
        return np.flatnonzero(whole), octets

    def text(self, chosen: BoolArray) -> list[str]:
        """What some of the lines hold, as it stands there."""
        found: list[str] = self.payload.filter(pa.array(chosen)).to_pylist()
        return found

    def bytes(self, place: Any) -> bytes:
        """What a line holds; nothing if its digits are no octets."""
        try:
            return bytes.fromhex(self.payload[int(place)].as_py())
        except ValueError:
            return b""


def _lines(path: Path, profile: Profile, time: TimeOptions, options: LineOptions) -> _Lines:
    cells = open_text(path, profile.file).cells([*time.names, options.kind, options.payload])
    table = cells.table
    if time.start == "messages":
        stamps = elapsed_time(table[time.names[0]], time, profile.file.decimal)
    else:
        stamps = read_time(table, time, profile.file.decimal)
    kind = pc.fill_null(table[options.kind], "").to_numpy()
    return _Lines(cells, stamps, kind, pc.fill_null(table[options.payload], ""))


def _samples(
    lines: _Lines, kind: str, payload: Payload, profile: Profile
) -> tuple[Recording | None, BoolArray]:
    """The numbers in the lines of a kind, and which of these lines hold no whole sample."""
    mine = lines.kind == kind
    dtype = np.dtype(payload.type)
    place, octets = lines.octets(mine, payload.count * dtype.itemsize)
    cut = mine.copy()
    cut[place] = False
    names = [f"{kind}.{number}" for number in range(1, payload.count + 1)]
    columns = {
        name: column
        for name, column in profile.columns.items()
        if column.value is not None or (column.names and set(column.names) <= set(names))
    }
    if not place.size or not columns:
        return None, cut
    values = np.ascontiguousarray(octets).view(dtype)
    table = pa.table({name: values[:, i].astype(np.float64) for i, name in enumerate(names)})
    cells = Cells(table, lines.rows[place], place.size)
    mapped = replace(profile, columns=columns, time=None)
    return recording_of(cells, mapped, lines.time[place]), cut


def _receiver(
    lines: _Lines, kinds: dict[str, Payload], messages: Messages
) -> tuple[Table | None, Anchors]:
    """The fixes of UBX-NAV-PVT or, without any, of NMEA sentences; and the UTC they give."""
    ubx, sentences = (
        np.isin(lines.kind, [kind for kind, payload in kinds.items() if payload.type == what])
        for what in ("ubx", "nmea")
    )
    nmea = np.flatnonzero(sentences)
    gnss, anchors = _ubx(lines, ubx, messages)
    if gnss is not None:
        messages.others["NMEA sentences, repeating UBX-NAV-PVT"] += nmea.size
    elif nmea.size:
        epochs = Epochs()
        for i in nmea:
            sentence = lines.bytes(i).decode("ascii", "replace").strip()
            epochs.take(int(lines.rows[i]), "", sentence, messages)
        gnss = epochs.table()
        at = np.searchsorted(lines.rows, gnss.rows)
        known = (gnss.time != NO_TIME) & (lines.time[at] != NO_TIME)
        anchors = lines.time[at][known], gnss.time[known]
    return gnss, anchors


def _ubx(lines: _Lines, mine: BoolArray, messages: Messages) -> tuple[Table | None, Anchors]:
    """The fixes of UBX-NAV-PVT, and times of the logger with the UTC that they give."""
    messages.read += int(np.count_nonzero(mine))
    place, octets = lines.octets(mine, NAV_PVT.itemsize)
    # The checksum is Fletcher's, over all but the mark and itself.
    first = np.cumsum(octets[:, 2:-2], axis=1, dtype=np.int64)
    second = first.sum(axis=1)
    good = np.all(octets[:, : len(NAV_PVT_HEAD)] == np.frombuffer(NAV_PVT_HEAD, np.uint8), axis=1)
    good &= (first[:, -1] % 256 == octets[:, -2]) & (second % 256 == octets[:, -1])
    place, pvt = place[good], np.ascontiguousarray(octets[good]).view(NAV_PVT).reshape(-1)
    others = mine.copy()
    others[place] = False
    _count_others(lines, others, messages)
    if not place.size:
        none = np.zeros(0, dtype=np.int64)
        return None, (none, none)
    table = fixes_of_pvt(pvt, lines.rows[place])
    known = (table.time != NO_TIME) & (lines.time[place] != NO_TIME)
    return table, (lines.time[place][known], table.time[known])


def fixes_of_pvt(pvt: Any, rows: IntArray) -> Table:
    """The table of whole UBX-NAV-PVT messages, records of `NAV_PVT`, from these rows."""
    parts = [pvt[name].astype(np.float64) for name in ("year", "month", "day", "hour", "minute")]
    minute = from_parts([*parts, np.zeros(len(pvt))])
    valid = (pvt["valid"] & DATE_AND_TIME == DATE_AND_TIME) & (minute != NO_TIME)
    # The second may be 60, the nanoseconds are negative where it was rounded up.
    second = pvt["second"].astype(np.int64) * NANOSECONDS + pvt["nano"]
    fixed = np.isin(pvt["fix_type"], FIX) & (pvt["flags"] & FIX_OK != 0)
    signals = {
        "/gnss/fix.latitude": np.where(fixed, pvt["latitude"] / 1e7, np.nan),
        "/gnss/fix.longitude": np.where(fixed, pvt["longitude"] / 1e7, np.nan),
        "/gnss/fix.altitude": pvt["altitude"] / 1e3,
        "/gnss/fix.horizontal_accuracy": pvt["horizontal_accuracy"] / 1e3,
        "/gnss/fix.vertical_accuracy": pvt["vertical_accuracy"] / 1e3,
        "/gnss/motion.speed": pvt["speed"] / 1e3,
        "/gnss/motion.speed_accuracy": pvt["speed_accuracy"] / 1e3,
        "/gnss/motion.satellites": pvt["satellites"].astype(np.float64),
        "/gnss/motion.pdop": pvt["pdop"] / 1e2,
    }
    return Table(np.where(valid, minute + second, NO_TIME), rows, signals)


def _count_others(lines: _Lines, others: BoolArray, messages: Messages) -> None:
    """Count the messages that are not used by their names, and those that are damaged."""
    places = np.flatnonzero(others)
    if not places.size:
        return
    parse = load("pyubx2").UBXReader.parse
    for i in places:
        try:
            message = parse(lines.bytes(i))
        except Exception:  # noqa: BLE001 - the parser raises whatever a byte leads it to
            message = None
        if message is None:
            messages.damaged(int(lines.rows[i]), lines.payload[int(i)].as_py())
        else:
            messages.others[f"UBX {message.identity}"] += 1


class _Offset:
    """UTC less the logger's time, as the receiver's messages give it."""

    def __init__(self, logger: IntArray, utc: IntArray) -> None:
        if not logger.size:
            raise InputError(
                "no message gives the time: the lines' own clock only counts since the start",
                remedy="have the receiver send UBX-NAV-PVT, or RMC, and record until it has a fix",
            )
        order = np.argsort(utc, kind="stable")
        clock, known = logger[order], utc[order]
        offset = known - clock
        window = (known - known[0]) // WINDOW
        edges = np.flatnonzero(np.diff(window, prepend=-1))
        pairs = list(zip(edges, np.append(edges[1:], clock.size), strict=True))
        self.base = int(np.median(offset))
        self.clock = np.array([np.median(clock[a:b]) for a, b in pairs])
        self.offset = np.array([np.median(offset[a:b] - self.base) for a, b in pairs])
        self.count = logger.size
        leaps = np.abs(np.diff(self.offset))
        if np.any(leaps > MAX_OFFSET_CHANGE):
            raise InputError(
                f"the logger's clock was restarted: it leaps by {leaps.max() / NANOSECONDS:.0f} s"
                " against the receiver's",
                remedy="split the file where the logger was started again",
            )

    def utc(self, time: IntArray) -> IntArray:
        """UTC [ns] of times of the logger, carried on beyond the first and the last message."""
        known = time != NO_TIME
        drift = np.interp(np.where(known, time, 0), self.clock, self.offset)
        return np.where(known, time + self.base + np.round(drift).astype(np.int64), NO_TIME)


# ----------------------------------------------------------------------- status reports of trains


USED = {"TrainIdentification", "PositionSpeed", "JP_InUse"}
"""Parts of a report that are used; others are counted."""


def is_reports(head: bytes) -> bool:
    """Whether a file that begins so may hold status reports: XML of SFERA, or an archive of XML.

    Examples
    --------
    >>> is_reports(b"<SFERA_B2G_EventMessage>"), is_reports(b"<gpx>")
    (True, False)
    """
    archive = head.startswith(b"PK\x03\x04") and b".xml" in head[30:286].lower()
    return archive or (head.lstrip()[:1] == b"<" and is_sfera(head))


def read_reports(path: Path, profile: Profile | None = None) -> list[Recording]:  # noqa: ARG001
    """The recordings of an archive's trains: one a journey with status reports.

    Raises
    ------
    InputError
        If there is no report, or none of the journeys knows where one was.
    """
    documents = Documents.of(path)
    holds = any(name == str(path) for name, _ in documents.journeys.values())
    if path.suffix.lower() != ".zip" and not holds:
        raise InputError(
            "has no journey, which the places of reports refer to",
            remedy="pack the journey, its segments and the reports into one zip archive",
        )
    if not documents.reports:
        raise InputError(
            "has no status report (B2G_StatusReport)",
            remedy="give the reports with their journey and its segments, as one zip archive",
        )
    found = []
    for journey in journeys_of(documents):
        own = [(time, each) for time, each in documents.reports if is_of(each, journey)]
        if own:
            found.append(_recording(own, journey, documents))
    if not found:
        raise InputError(
            "holds status reports, but not the journey of their train",
            remedy="add its JourneyProfile and the SegmentProfiles that it names",
        )
    return found


def is_of(report: Element, journey: SferaJourney) -> bool:
    """Whether a report is of a journey's train; one that names no train is."""
    own = report.first("TrainIdentification")
    train = journey.profile.first("TrainIdentification")
    return own is None or (train is not None and _words(own) == _words(train))


def _words(element: Element) -> list[tuple[str, str]]:
    return [(each.tag, each.content.strip()) for each in element.every() if each.content.strip()]


def _recording(
    own: list[tuple[int, Element]], journey: SferaJourney, documents: Documents
) -> Recording:
    timed = sorted(((time, each.line, each) for time, each in own), key=itemgetter(0))
    tables = ReportRows(journey).take(timed)
    reports, others = [each for _, each in own], len(documents.reports) - len(own)
    unused = Counter(
        part.tag for report in reports for part in report.children if part.tag not in USED
    )
    version = journey.profile.text("JP_Version")
    stated = [each.first("JP_InUse") for each in reports]
    apart = sum(each is not None and each.text("JP_Version", version) != version for each in stated)
    unused |= Counter({"reports of other trains": others} if others else {})
    unused |= Counter({f"reports by another version than {version}": apart} if apart else {})
    placeless = int(np.isnan(tables[0].signals["/train/state.position"]).sum())
    findings = [
        Finding("damaged_messages", placeless, (), "", "reports without a place"),
        Finding("damaged_messages", documents.damaged, (), "", "reports that cannot be read"),
    ]
    metadata = {"line": journey.line.name, "journey": journey.name}
    if unused:
        metadata["not_used"] = ", ".join(f"{tag} ({count})" for tag, count in unused.items())
    return Recording(
        tuple(tables), len(reports), tuple(each for each in findings if each.count),
        metadata=metadata,
    )  # fmt: skip


class ReportRows:
    """Status reports of one train as rows: its motion, and an event where slip begins.

    Parameters
    ----------
    journey : SferaJourney
        Whose segments the reports name.
    """

    def __init__(self, journey: SferaJourney) -> None:
        self.journey = journey
        self._last, self._slipping = 0.0, 0.0

    def take(self, reports: Sequence[tuple[int, int, Element]]) -> list[Table]:
        """The rows of the next reports: motion; and events, if there are any.

        Parameters
        ----------
        reports : sequence of (time [ns], number of the row, report)
        """
        found = [self._values(each) for _, _, each in reports]
        position, speed, slips = np.array(found).reshape(-1, 3).T
        time, row = np.array([(at, number) for at, number, _ in reports], dtype=np.int64).T
        motion = {"/train/state.position": position, "/train/state.speed": speed}
        tables = [Table(time, row, motion)]
        begins = np.diff(slips, prepend=self._slipping) > 0.0
        self._slipping = float(slips[-1])
        if begins.any():
            words = np.full(int(begins.sum()), SLIP_PROTECTION, dtype=np.object_)
            said = np.full(words.size, "slip or slide reported", dtype=np.object_)
            texts = {"/events.message": said, "/events.name": words}
            tables.append(Table(time[begins], row[begins], {}, texts))
        return tables

    def _values(self, report: Element) -> tuple[float, float, float]:
        """Position [m], speed [m/s], and whether wheels slip."""
        where, position, speed = report.first("PositionSpeed"), np.nan, np.nan
        if where is not None:
            position = self.journey.position(where, self._last)
            speed = where.number("speed", np.nan) / KMH
            self._last = position if np.isfinite(position) else self._last
        return position, speed, float(report.text("slipSlideReported") in ("true", "1"))
