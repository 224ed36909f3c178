"""Format ``telegrams``: records of a fixed layout, as train control systems send them.

A profile declares the layout under [telegram]. The records come from a file of one after the other,
from a capture of UDP datagrams (pcap, pcapng), or live by UDP; each becomes a row, each declared
field a column, which [time] and [columns] use like those of a table.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from trainlog.arrays import BoolArray, IntArray
from trainlog.errors import InputError
from trainlog.extras import load
from trainlog.formats.files import read_bytes
from trainlog.ingest.mapping import recording_of, undescribed, wanted_columns
from trainlog.ingest.profile import ARRIVAL, Profile, TelegramField, TelegramOptions
from trainlog.ingest.recording import Cells, Finding, Raw, Recording

PCAPNG = b"\x0a\x0d\x0d\x0a"

CAPTURES = (
    b"\xa1\xb2\xc3\xd4",
    b"\xd4\xc3\xb2\xa1",
    b"\xa1\xb2\x3c\x4d",
    b"\x4d\x3c\xb2\xa1",
    PCAPNG,
)
"""How captures begin: pcap in microseconds and nanoseconds, in either byte order, and pcapng."""

PCAP_HEAD, PACKET_HEAD = 24, 16
"""Bytes before the first packet, and before each packet, of a pcap file."""


def is_capture(head: bytes) -> bool:
    """Whether a file begins as a capture of network packets does."""
    return head.startswith(CAPTURES)


def read_telegrams(path: Path, profile: Profile | None) -> Recording:
    """Read telegrams as `profile` describes them; those that are no whole telegram are counted.

    Raises
    ------
    InputError
        If the profile does not describe telegrams, the file holds none of its length, or a capture
        is damaged before its first packet.
    MissingExtraError
        If the file is a capture and the package that reads it is not installed.
    """
    if profile is None or profile.telegram is None:
        raise undescribed(
            "holds binary telegrams, whose layout no profile describes", "with [telegram]"
        )
    options = profile.telegram
    data = read_bytes(path)
    not_used: Counter[str] = Counter()
    if is_capture(data):
        octets, rows, arrival, findings, raw = _captured(data, options, not_used)
    else:
        octets, rows, findings, raw = _of_file(data, options)
        arrival = None
        if ARRIVAL in profile.sources:
            raise InputError(
                f"states no time of arrival: column '{ARRIVAL}' is of captures and live telegrams",
                remedy="name the telegram's own time under [time] of the profile",
            )
    if not len(octets):
        raise InputError(
            f"has no telegram of {options.length} bytes",
            remedy="check length under [telegram] of the profile",
        )
    wanted = chosen(octets, options)
    left = int(np.count_nonzero(~wanted))
    if left:
        not_used["telegrams of other kinds"] += left
    if not wanted.any():
        raise InputError(
            f"none of {len(octets):,} telegrams is of the kind that the profile states",
            remedy="check where under [telegram] of the profile",
        )
    octets, rows = octets[wanted], rows[wanted]
    arrival = None if arrival is None else arrival[wanted]
    names = (*options.columns, ARRIVAL)
    table = columns_of(octets, wanted_columns(profile, names), options, arrival)
    cells = Cells(table, rows, len(rows) + sum(each.count for each in findings), findings, raw)
    found = recording_of(cells, profile, columns=options.columns)
    return replace(found, not_used=found.not_used | dict(not_used))


def _of_file(
    data: bytes, options: TelegramOptions
) -> tuple[np.ndarray, IntArray, tuple[Finding, ...], tuple[Raw, ...]]:
    """The telegrams of a file, one after the other; what is no whole one is a finding."""
    starts = _starts(data, options)
    whole = np.ndarray(
        (max(len(data) - options.length + 1, 0), options.length), np.uint8, data, 0, (1, 1)
    )
    octets = whole[starts]
    rows = np.arange(1, len(starts) + 1, dtype=np.int64)
    ends = starts + options.length
    begins, stops = np.append(0, ends), np.append(starts, len(data))
    between = np.flatnonzero(stops > begins)
    lost = [data[a:b].hex(" ") for a, b in zip(begins[between], stops[between], strict=True)]
    behind = np.maximum(between, 1).astype(np.int64)
    return octets, rows, *_cut(behind, lost)


def _cut(rows: IntArray, text: list[str]) -> tuple[tuple[Finding, ...], tuple[Raw, ...]]:
    """That what stands behind these rows is no whole telegram."""
    found = Finding.met("truncated_rows", rows)
    return tuple(found), Raw.lines("truncated_rows", rows, text)


def _starts(data: bytes, options: TelegramOptions) -> IntArray:
    """Where telegrams begin [bytes]: one behind the other or, with a mark, wherever it stands."""
    length, mark = options.length, options.mark_bytes
    count = len(data) // length
    starts = np.arange(count, dtype=np.int64) * length
    if not mark:
        return starts
    if all(data[at : at + len(mark)] == mark for at in starts.tolist()) and not len(data) % length:
        return starts
    found, at = [], data.find(mark)
    while 0 <= at <= len(data) - length:
        # One that is not followed by the next at once may lack octets itself.
        behind = data[at + length : at + length + len(mark)]
        whole = mark.startswith(behind)
        found += [at] * whole
        at = data.find(mark, at + (length if whole else 1))
    return np.array(found, dtype=np.int64)


def _captured(
    data: bytes, options: TelegramOptions, not_used: Counter[str]
) -> tuple[np.ndarray, IntArray, IntArray, tuple[Finding, ...], tuple[Raw, ...]]:
    """The telegrams of a capture with their times of arrival [ns UTC]."""
    payloads, times, rows = list[bytes](), list[int](), list[int]()
    odd = Counter[int]()
    packets, damage = _packets(data)
    for number, (time, payload, port) in enumerate(packets, start=1):
        if payload is None:
            not_used["packets that are not UDP datagrams"] += 1
        elif options.port is not None and port != options.port:
            not_used[f"datagrams to port {port}"] += 1
        elif len(payload) != options.length:
            odd[len(payload)] += 1
        else:
            payloads.append(payload)
            times.append(time)
            rows.append(number)
    for length, count in odd.items():
        not_used[f"datagrams of {length} bytes"] += count
    octets = np.frombuffer(b"".join(payloads), np.uint8).reshape(-1, options.length)
    numbers, at = np.array(rows, dtype=np.int64), np.array(times, dtype=np.int64)
    behind = np.array([len(packets) + 1] * bool(damage), dtype=np.int64)
    return octets, numbers, at, *_cut(behind, [damage] * bool(damage))


def _packets(data: bytes) -> tuple[list[tuple[int, bytes | None, int]], str]:
    """Time of arrival [ns], UDP payload and port of each packet; and how the capture is cut."""
    from io import BytesIO

    pcap = load("dpkt").pcap
    found: list[tuple[int, bytes | None, int]] = []
    size = PCAP_HEAD
    try:
        reader = pcap.UniversalReader(BytesIO(data))
        link = reader.datalink()
        for seconds, packet in reader:
            time = round(seconds * 1e6) * 1000
            size += PACKET_HEAD + len(packet)
            found.append((time, *_datagram(packet, link)))
    except Exception as error:
        if not found:
            raise InputError(
                f"is a capture that cannot be read: {error or type(error).__name__}",
                remedy="capture again; pcap and pcapng are read",
            ) from error
        size = 0
    whole = data.startswith(PCAPNG) and size > 0
    return found, "" if whole or size == len(data) else f"cut off behind packet {len(found)}"


def _datagram(packet: bytes, link: int) -> tuple[bytes | None, int]:
    """UDP payload and destination port of a packet; None where it holds no whole datagram."""
    dpkt = load("dpkt")
    layers = {
        dpkt.pcap.DLT_EN10MB: dpkt.ethernet.Ethernet,
        dpkt.pcap.DLT_LINUX_SLL: dpkt.sll.SLL,
        dpkt.pcap.DLT_LINUX_SLL2: dpkt.sll2.SLL2,
        dpkt.pcap.DLT_NULL: dpkt.loopback.Loopback,
    }
    try:
        if link in layers:
            network = layers[link](packet).data
        else:
            network = (dpkt.ip6.IP6 if packet[:1] and packet[0] >> 4 == 6 else dpkt.ip.IP)(packet)
        datagram = network.data
        if isinstance(datagram, dpkt.udp.UDP) and datagram.ulen == len(datagram.data) + 8:
            return bytes(datagram.data), int(datagram.dport)
    except (dpkt.dpkt.UnpackError, AttributeError, struct.error, IndexError):
        pass
    return None, 0


def chosen(octets: np.ndarray, options: TelegramOptions) -> BoolArray:
    """Which telegrams are of the kind that the profile states under ``where``."""
    wanted = np.ones(len(octets), dtype=np.bool_)
    for name, value in options.where.items():
        wanted &= field_values(octets, options.fields[name], options)[:, 0] == value
    return wanted


def field_values(octets: np.ndarray, field: TelegramField, options: TelegramOptions) -> np.ndarray:
    """Numbers of a field, shape (telegrams, count), as they stand in the telegrams.

    Parameters
    ----------
    octets : (n, length) uint8 array
    field : TelegramField
    options : TelegramOptions

    Examples
    --------
    >>> options = TelegramOptions(length=3, fields={"v": TelegramField(offset=1, type="uint16")})
    >>> octets = np.array([[9, 1, 2]], np.uint8)
    >>> field_values(octets, options.fields["v"], options).tolist()
    [[513]]
    """
    kind = field.dtype(options.byte_order)
    part = octets[:, field.offset : field.offset + kind.itemsize * field.count]
    values = np.ascontiguousarray(part).view(kind)
    if field.bit is None:
        return values
    shifted: np.ndarray = (values >> kind.type(field.bit)) & kind.type(2**field.bits - 1)
    return shifted


def columns_of(
    octets: np.ndarray,
    wanted: Iterable[str],
    options: TelegramOptions,
    arrival: IntArray | None = None,
) -> pa.Table:
    """The columns called `wanted`: numbers, or the words that stand for them.

    Parameters
    ----------
    octets : (n, length) uint8 array
    wanted : iterable of str
    options : TelegramOptions
    arrival : (n,) int64 array [ns UTC], optional
        Of the column that is called so; without it that column is empty.
    """
    columns: dict[str, Any] = {}
    for name in wanted:
        if name == ARRIVAL:
            columns[name] = pa.array(arrival) if arrival is not None else pa.nulls(len(octets))
            continue
        field, place = options.field_called(name)
        values = field_values(octets, field, options)[:, place]
        if field.words:
            words = [field.words.get(str(value)) for value in values.tolist()]
            columns[name] = pa.array(words, pa.string())
            continue
        native = values.astype(values.dtype.newbyteorder("="))
        columns[name] = pa.array(native, mask=np.isin(native, field.missing))
    return pa.table(columns)


class TelegramFramer:
    """Cuts a stream of octets into telegrams; a datagram is one, whatever its length."""

    def __init__(self, length: int) -> None:
        self._length, self._rest = length, b""

    def cut(self, data: bytes, *, whole: bool = False) -> list[bytes]:
        """The telegrams that are complete; `whole`: the data are a datagram.

        Examples
        --------
        >>> framer = TelegramFramer(2)
        >>> framer.cut(b"abc"), framer.cut(b"d"), framer.cut(b"x", whole=True)
        ([b'ab'], [b'cd'], [b'x'])
        """
        if whole:
            return [data]
        data = self._rest + data
        end = len(data) - len(data) % self._length
        self._rest = data[end:]
        return [data[at : at + self._length] for at in range(0, end, self._length)]

    def end(self) -> bytes:
        """What is left of a telegram that did not end; nothing is left then."""
        rest, self._rest = self._rest, b""
        return rest
