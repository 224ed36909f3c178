"""Format ``hexlines``: lines ``time,kind,hex`` of a logger with IMU and GNSS receiver.

The logger of ETH's Railway-Precise-Localization. ``I`` is a sample of the IMU: three angular rates
and three specific forces, 16 bits each, little-endian. ``U`` is a UBX message, ``N`` an NMEA
sentence. Lines of different kinds are out of order. The time counts since the logger was started;
UTC comes from the receiver's UBX-NAV-PVT (or RMC), and is carried back to before the first of them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from trainlog.errors import InputError
from trainlog.extras import load
from trainlog.ingest.mapping import from_parts
from trainlog.ingest.nmea import epochs_of
from trainlog.ingest.profile import FileOptions, Profile
from trainlog.ingest.recording import (
    NO_TIME,
    SHOWN_ROWS,
    BoolArray,
    Finding,
    FloatArray,
    IntArray,
    Messages,
    Raw,
    Recording,
    Table,
)
from trainlog.ingest.tabular import TextFile, open_text

FORCE_PER_BIT = 0.061e-3 * 9.80665
"""Specific force of one bit [m/s²]: 0.061 mg."""

RATE_PER_BIT = np.radians(4.37e-3)
"""Angular rate of one bit [rad/s]: 4.37 millidegrees a second."""

IMU_COLUMNS = tuple(
    f"/imu.{quantity}_{axis}" for quantity in ("angular_rate", "specific_force") for axis in "xyz"
)
"""The six words of a sample, in their order."""

IMU_DIGITS = 4 * len(IMU_COLUMNS)

WINDOW = 60 * 1_000_000_000
"""Time [ns] over which the offset of the logger's clock is taken as constant."""

MAX_OFFSET_CHANGE = 1_000_000_000
"""Change of the offset [ns] from one window to the next beyond which the clock was restarted."""

FIRST_LINE = re.compile(rb"\s*\d+:\d\d:\d\d(\.\d+)?,[IUN],[0-9A-Fa-f]*\r?$")

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


def is_hexlines(head: bytes) -> bool:
    """Whether a file begins with such a line."""
    return bool(FIRST_LINE.match(head.split(b"\n", 1)[0]))


def read_hexlines(path: Path, profile: Profile | None) -> Recording:  # noqa: ARG001
    """Read the lines; what is no whole line, sample or message is counted.

    Raises
    ------
    InputError
        If no message tells the time, the clock was restarted, or most lines are damaged.
    """
    lines = _lines(open_text(path, FileOptions(header=0)))
    imu, cut = _imu(lines)
    messages = Messages()
    gnss, anchors = _ubx(lines, messages)
    sentences = [(lines.row(i), lines.bytes(i).decode("ascii", "replace")) for i in lines.of("N")]
    if gnss is not None:
        messages.others["N sentences, UBX-NAV-PVT tells the same"] += len(sentences)
    elif sentences:
        gnss = epochs_of(((row, text.strip()) for row, text in sentences), messages)
        anchors = _line_anchors(lines, gnss)
    offset = _Offset(*anchors)
    tables = [] if gnss is None else [gnss]
    if imu is not None:
        tables.append(imu.at(offset.utc(imu.time)))
    whole = lines.findings + messages.findings()
    if cut.any():
        rows = lines.rows[cut]
        count = int(cut.sum())
        first = tuple(int(row) for row in np.sort(rows)[:SHOWN_ROWS])
        whole += (Finding("damaged_messages", count, first),)
    raw = Raw("damaged_messages", "", lines.rows[cut], _texts(lines.text, cut))
    return Recording(
        tuple(tables),
        sum(len(table) for table in tables) + int(cut.sum()) + len(lines.raw),
        whole,
        metadata={"clock": "logger, set by GNSS"} | offset.told(),
        not_used={name: count for name, count in sorted(messages.others.items()) if count},
        raw=(*lines.raw, *messages.raw(), *((raw,) if cut.any() else ())),
    )


@dataclass(frozen=True, eq=False)
class _Lines:
    """The lines of a file."""

    time: IntArray
    """Since the logger's start [ns]; `NO_TIME` where it cannot be read."""
    kind: Any
    text: pa.ChunkedArray
    rows: IntArray
    findings: tuple[Finding, ...]
    raw: tuple[Raw, ...]

    def of(self, kind: str) -> list[int]:
        """Which lines are of that kind."""
        return [int(i) for i in np.flatnonzero(self.kind == kind)]

    def row(self, i: Any) -> int:
        return int(self.rows[i])

    def bytes(self, i: Any) -> bytes:
        """What a line holds; nothing if its digits are no bytes."""
        try:
            return bytes.fromhex(self.text[int(i)].as_py() or "")
        except ValueError:
            return b""


def _lines(text: TextFile) -> _Lines:
    cells = text.cells(["1", "2", "3"])
    table = cells.table.combine_chunks()
    kind = pc.fill_null(table["2"], "").to_numpy()
    return _Lines(
        _since_start(table["1"]),
        kind.astype("U1"),
        pc.fill_null(table["3"], ""),
        cells.rows,
        cells.findings,
        cells.raw,
    )


def _since_start(text: pa.ChunkedArray) -> IntArray:
    """Time since start [ns] from ``HH:MM:SS.ffffff``."""
    digits = _characters(text, 15)
    if digits is not None and np.all(digits[:, [2, 5]] == ord(":")):
        numbers = digits[:, [0, 1, 3, 4, 6, 7, 9, 10, 11, 12, 13, 14]].astype(np.int64) - ord("0")
        if numbers.min(initial=0) >= 0 and numbers.max(initial=0) <= 9:
            weights = (36_000, 3_600, 600, 60, 10, 1)
            seconds = numbers[:, :6] @ np.array(weights)
            micro = numbers[:, 6:] @ 10 ** np.arange(5, -1, -1)
            return np.asarray((seconds * 1_000_000 + micro) * 1_000)
    found = pd.TimedeltaIndex(pd.to_timedelta(text.to_pandas(), errors="coerce")).as_unit("ns")
    return np.where(found.isna(), NO_TIME, found.asi8)


def _characters(text: pa.ChunkedArray, width: int) -> Any:
    """Texts of equal width as an (n, width) array of characters; None if they are not."""
    array = text.combine_chunks() if isinstance(text, pa.ChunkedArray) else text
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays(array.chunks) if array.num_chunks else pa.array([], pa.string())
    lengths = pc.binary_length(array)
    if not len(array) or array.null_count or not pc.all(pc.equal(lengths, width)).as_py():
        return None
    start = np.frombuffer(array.buffers()[1], np.int32)[array.offset]
    data = np.frombuffer(array.buffers()[2], np.uint8)
    return data[start : start + width * len(array)].reshape(-1, width)


NIBBLES = np.full(256, 255, dtype=np.uint8)
for _digit in range(16):
    NIBBLES[ord(f"{_digit:x}")] = NIBBLES[ord(f"{_digit:X}")] = _digit


def _imu(lines: _Lines) -> tuple[Table | None, BoolArray]:
    """The samples of the IMU at the logger's time, and which of their lines are no samples."""
    mine = lines.kind == "I"
    known = mine | (lines.kind == "U") | (lines.kind == "N")
    if not mine.any():
        return None, ~known
    whole = mine & (pc.binary_length(lines.text).to_numpy() == IMU_DIGITS)
    digits = _characters(lines.text.filter(pa.array(whole)), IMU_DIGITS)
    if digits is None:
        return None, ~known | mine
    nibbles = NIBBLES[digits]
    good = nibbles.max(axis=1) < 16
    whole[np.flatnonzero(whole)[~good]] = False
    nibbles = nibbles[good]
    octets = (nibbles[:, ::2] << 4) | nibbles[:, 1::2]
    words = np.ascontiguousarray(octets).view("<i2").astype(np.float64)
    scales = np.repeat([RATE_PER_BIT, FORCE_PER_BIT], 3)
    signals = {name: words[:, i] * scales[i] for i, name in enumerate(IMU_COLUMNS)}
    return Table(lines.time[whole], lines.rows[whole], signals), (mine & ~whole) | ~known


def _texts(text: pa.ChunkedArray, mask: BoolArray) -> Any:
    return np.asarray(text.filter(pa.array(mask)).to_pylist(), dtype=np.object_)


def _ubx(lines: _Lines, messages: Messages) -> tuple[Table | None, tuple[IntArray, IntArray]]:
    """The fixes of UBX-NAV-PVT, and times of the logger with the UTC that they tell."""
    mine = lines.kind == "U"
    none = np.zeros(0, dtype=np.int64)
    messages.read += int(np.count_nonzero(mine))
    place, pvt = _nav_pvt(lines, mine)
    whole = np.zeros(mine.size, dtype=np.bool_)
    whole[place] = True
    _count_others(lines, mine & ~whole, messages)
    if not place.size:
        return None, (none, none)
    time = _pvt_time(pvt)
    known = (time != NO_TIME) & (lines.time[place] != NO_TIME)
    anchors = lines.time[place][known], time[known]
    return Table(time, lines.rows[place], _pvt_signals(pvt)), anchors


def _nav_pvt(lines: _Lines, mine: BoolArray) -> tuple[IntArray, Any]:
    """Which lines are whole UBX-NAV-PVT messages, and these as records."""
    lengths = pc.binary_length(lines.text).to_numpy()
    place = np.flatnonzero(mine & (lengths == 2 * NAV_PVT.itemsize))
    wanted = np.zeros(mine.size, dtype=np.bool_)
    wanted[place] = True
    digits = _characters(lines.text.filter(pa.array(wanted)), 2 * NAV_PVT.itemsize)
    if digits is None:
        return place[:0], np.zeros(0, dtype=NAV_PVT)
    nibbles = NIBBLES[digits]
    octets = (nibbles[:, ::2] << 4) | nibbles[:, 1::2]
    # The checksum is Fletcher's, over all but the mark and itself.
    first = np.cumsum(octets[:, 2:-2], axis=1, dtype=np.int64)
    second = first.sum(axis=1)
    good = nibbles.max(axis=1) < 16
    good &= np.all(octets[:, : len(NAV_PVT_HEAD)] == np.frombuffer(NAV_PVT_HEAD, np.uint8), axis=1)
    good &= (first[:, -1] % 256 == octets[:, -2]) & (second % 256 == octets[:, -1])
    return place[good], np.ascontiguousarray(octets[good]).view(NAV_PVT)[:, 0]


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
            messages.damaged(lines.row(i), lines.text[int(i)].as_py())
        else:
            messages.others[f"UBX {message.identity}"] += 1


def _pvt_time(pvt: Any) -> IntArray:
    """UTC of UBX-NAV-PVT [ns]; `NO_TIME` if the receiver does not vouch for it."""
    parts = [pvt[name].astype(np.float64) for name in ("year", "month", "day", "hour", "minute")]
    minute = from_parts([*parts, np.zeros(len(pvt))])
    vouched = (pvt["valid"] & DATE_AND_TIME == DATE_AND_TIME) & (minute != NO_TIME)
    # The second may be 60, the nanoseconds are negative where it was rounded up.
    second = pvt["second"].astype(np.int64) * 1_000_000_000 + pvt["nano"]
    return np.where(vouched, minute + second, NO_TIME)


def _pvt_signals(pvt: Any) -> dict[str, FloatArray]:
    fixed = np.isin(pvt["fix_type"], FIX) & (pvt["flags"] & FIX_OK != 0)
    return {
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


def _line_anchors(lines: _Lines, gnss: Table) -> tuple[IntArray, IntArray]:
    """Times of the logger with the UTC of the epochs whose first sentence stands there."""
    at = np.searchsorted(lines.rows, gnss.rows)
    known = (gnss.time != NO_TIME) & (lines.time[at] != NO_TIME)
    return lines.time[at][known], gnss.time[known]


class _Offset:
    """UTC less the logger's time, as the receiver's messages tell it."""

    def __init__(self, logger: IntArray, utc: IntArray) -> None:
        if not logger.size:
            raise InputError(
                "no message tells the time: the lines' own clock only counts since the start",
                remedy="have the receiver send UBX-NAV-PVT, or RMC, and record until it has a fix",
            )
        order = np.argsort(utc, kind="stable")
        clock, told = logger[order], utc[order]
        offset = told - clock
        window = (told - told[0]) // WINDOW
        edges = np.flatnonzero(np.diff(window, prepend=-1))
        ends = np.append(edges[1:], clock.size)
        pairs = list(zip(edges, ends, strict=True))
        self.base = int(np.median(offset))
        self.clock = np.array([np.median(clock[a:b]) for a, b in pairs])
        self.offset = np.array([np.median(offset[a:b] - self.base) for a, b in pairs])
        self.count = logger.size
        leaps = np.abs(np.diff(self.offset)) > MAX_OFFSET_CHANGE
        if leaps.any():
            raise InputError(
                f"the logger's clock was restarted: it leaps by"
                f" {np.abs(np.diff(self.offset)).max() / 1e9:.0f} s against the receiver's",
                remedy="split the file where the logger was started again",
            )

    def utc(self, time: IntArray) -> IntArray:
        """UTC [ns] of times of the logger, carried on beyond the first and the last message."""
        known = time != NO_TIME
        drift = np.interp(np.where(known, time, 0), self.clock, self.offset)
        return np.where(known, time + self.base + np.round(drift).astype(np.int64), NO_TIME)

    def told(self) -> dict[str, str]:
        """Metadata of how the clock was set."""
        return {"clock.anchors": str(self.count)}
