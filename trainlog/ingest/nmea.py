"""Format ``nmea``: text logs of NMEA 0183 sentences, with or without the logger's time before them.

RMC, GGA, GNS, VTG, GST, GSA and ZDA are used, others are counted. Sentences of the same time of day
are one epoch, which becomes one row; VTG, GST and GSA belong to the epoch they follow. The date
comes from RMC or ZDA, else from the logger's own time; midnight is noticed. Sentences are parsed,
and their checksums verified, by pynmeagps (extra ``recorders``).
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable, Iterable
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.extras import load
from trainlog.formats.files import read_bytes
from trainlog.ingest.profile import Profile
from trainlog.ingest.recording import HORIZONTAL_PER_HDOP, NO_TIME, Messages, Recording, Table
from trainlog.units import DAY, KMH

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
    lines: list[tuple[int, str, str]] = []
    nothing: list[int] = []
    for row, line in enumerate(text.splitlines(), start=1):
        prefix, mark, sentence = line.partition("$")
        if mark:
            lines.append((row, prefix, mark + sentence.rstrip()))
        elif line.strip():
            nothing.append(row)
    messages = Messages()
    epochs = Epochs()
    for row, prefix, sentence in lines:
        epochs.take(row, prefix, sentence, messages)
    if nothing:
        messages.others["lines without a sentence"] = len(nothing)
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


class Epochs:
    """The epochs that sentences make, gathered one sentence after the other."""

    def __init__(self) -> None:
        self.parse = load("pynmeagps").NMEAReader.parse
        self.rows: list[int] = []
        self.of_day: list[datetime.time] = []
        self.prefixes: list[str] = []
        self.dates: list[datetime.date | None] = []
        self.values: list[dict[str, float]] = []
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
            if not self.of_day or of_day != self.of_day[-1]:
                self._begin(row, prefix, of_day)
        elif not self.of_day:
            messages.others[f"NMEA {kind} before the first time"] += 1
            return
        date = _date(kind, parsed)
        if date is not None:
            self.dates[-1] = date
        for name, value in _values(kind, parsed).items():
            if np.isfinite(value):
                self.values[-1].setdefault(name, value)

    def split(self, count: int) -> tuple[Epochs, Epochs]:
        """The first epochs, and those behind them."""
        parts = Epochs(), Epochs()
        for part, kept in zip(parts, (slice(count), slice(count, None)), strict=True):
            for name in ("rows", "of_day", "prefixes", "dates", "values"):
                setattr(part, name, getattr(self, name)[kept])
        return parts

    def _begin(self, row: int, prefix: str, of_day: datetime.time) -> None:
        self.rows.append(row)
        self.prefixes.append(prefix)
        self.of_day.append(of_day)
        self.dates.append(None)
        self.values.append({})

    def table(self) -> Table:
        """The epochs as a table.

        Raises
        ------
        InputError
            If there are none, or no date is known.
        """
        if not self.rows:
            raise InputError(
                "has no RMC, GGA or GNS sentence with a time",
                remedy="have the receiver write them, and give its log",
            )
        columns = {
            name: np.array([found.get(name, np.nan) for found in self.values])
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
        return Table(self._time(), np.array(self.rows, dtype=np.int64), signals)

    def metadata(self) -> dict[str, str]:
        """Metadata of how values were come by."""
        if not self.from_dop:
            return {}
        return {"horizontal_accuracy": f"{HORIZONTAL_PER_HDOP:g} m times HDOP"}

    def _time(self) -> IntArray:
        """UTC of the epochs [ns]: the date that their sentences give, or that of those around."""
        of_day = np.array([_nanoseconds(time) for time in self.of_day], dtype=np.int64)
        step = np.diff(of_day, prepend=of_day[:1])
        day = np.cumsum((step < -DAY // 2).astype(np.int64) - (step > DAY // 2))
        dated = np.array(
            [NO_TIME if date is None else pd.Timestamp(date).value for date in self.dates]
        )
        if np.all(dated == NO_TIME):
            dated = self._logged_dates()
        known = dated != NO_TIME
        if not known.any():
            raise InputError(
                "gives the time of day, but no date",
                place=f"row {self.rows[0]}",
                remedy="have the receiver write RMC or ZDA too",
            )
        base = dated[known] - day[known] * DAY
        dates, counts = np.unique(base, return_counts=True)
        date = np.where(known, dated, dates[np.argmax(counts)] + day * DAY)
        return np.asarray(date + of_day)

    def _logged_dates(self) -> IntArray:
        """Dates [ns] that the logger wrote before the sentences; `NO_TIME` where it wrote none."""
        words = pd.Series(self.prefixes).str.strip(" ,;:\t[]")
        stamps = pd.to_datetime(
            words.where(words.str.contains("-", regex=False)),
            format="ISO8601",
            utc=True,
            errors="coerce",
        )
        of_day = np.array([_nanoseconds(time) for time in self.of_day], dtype=np.int64)
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


def epochs_of(sentences: Iterable[tuple[int, str]], messages: Messages) -> Table:
    """The epochs of sentences without a logger's time, each with its row."""
    epochs = Epochs()
    for row, sentence in sentences:
        epochs.take(row, "", sentence, messages)
    return epochs.table()
