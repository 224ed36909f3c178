"""Damage to MCAP files, drawn from a seed: what disks, networks, crashes and copies do to them.

`mutated` is a pure function: the same bytes and the same seed give the same damage.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from random import Random

MAGIC = b"\x89MCAP0\r\n"
HEAD = 9
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
CHUNK_INDEX, ATTACHMENT, STATISTICS, METADATA, DATA_END = 0x08, 0x09, 0x0B, 0x0C, 0x0F
PRIVATE = 0x87


@dataclass(frozen=True)
class Record:
    """A record of a file: its opcode, its first byte and the byte behind its last."""

    opcode: int
    start: int
    end: int


def records_of(data: bytes) -> list[Record]:
    """The records of a whole file, or those before its cut end."""
    found = []
    at = len(MAGIC)
    while at + HEAD <= len(data) and data[at : at + len(MAGIC)] != MAGIC:
        opcode, length = struct.unpack_from("<BQ", data, at)
        if at + HEAD + length > len(data):
            break
        found.append(Record(opcode, at, at + HEAD + length))
        at = found[-1].end
    return found


def chunk_bytes(compression: str, stored: bytes, size: int, checksum: int, time: bytes) -> bytes:
    """A chunk record; `time` is its first and last time as it stands in the file."""
    name = compression.encode()
    content = time + struct.pack("<QII", size, checksum, len(name)) + name
    content += struct.pack("<Q", len(stored)) + stored
    return struct.pack("<BQ", CHUNK, len(content)) + content


def _piece(random: Random, data: bytes, longest: int) -> tuple[int, int]:
    start = random.randrange(len(data))
    return start, min(len(data), start + random.randint(1, longest))


def _pick(random: Random, data: bytes, *opcodes: int) -> Record | None:
    """One of the file's records, each kind equally likely; None if it has none."""
    found = [each for each in records_of(data) if not opcodes or each.opcode in opcodes]
    if not found:
        return None
    opcode = random.choice(sorted({each.opcode for each in found}))
    return random.choice([each for each in found if each.opcode == opcode])


def _cut(random: Random, data: bytes) -> bytes:
    return data[: random.randrange(len(data))]


def _cut_at_record(random: Random, data: bytes) -> bytes:
    record = _pick(random, data)
    return data[: record.end] if record else data[:-1]


def _lost_front(random: Random, data: bytes) -> bytes:
    return MAGIC + data[random.randrange(len(MAGIC), len(data)) :]


def _flip_bits(random: Random, data: bytes) -> bytes:
    flipped = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 8, 64))):
        flipped[random.randrange(len(data))] ^= 1 << random.randrange(8)
    return bytes(flipped)


def _flip_in_head(random: Random, data: bytes) -> bytes:
    """One bit in the first bytes of a record, where opcode and lengths are."""
    record = _pick(random, data)
    if record is None:
        return _flip_bits(random, data)
    at = random.randrange(record.start, min(record.end, record.start + 60))
    flipped = bytearray(data)
    flipped[at] ^= 1 << random.randrange(8)
    return bytes(flipped)


def _zero_page(random: Random, data: bytes) -> bytes:
    page = random.choice((16, 512, 4096))
    start = random.randrange(len(data)) // page * page
    return data[:start] + bytes(min(page, len(data) - start)) + data[start + page :]


def _noise_page(random: Random, data: bytes) -> bytes:
    start, end = _piece(random, data, 2048)
    return data[:start] + random.randbytes(end - start) + data[end:]


def _zero_tail(random: Random, data: bytes) -> bytes:
    """A file system after a loss of power: the length is right, the last pages were not written."""
    start = random.randrange(len(MAGIC), len(data))
    return data[:start] + bytes(len(data) - start)


def _insert_noise(random: Random, data: bytes) -> bytes:
    start, _ = _piece(random, data, 1)
    return data[:start] + random.randbytes(random.randint(1, 600)) + data[start:]


def _insert_own(random: Random, data: bytes) -> bytes:
    """A piece of the file again, somewhere else in it."""
    start, end = _piece(random, data, 3000)
    at = random.randrange(len(data))
    return data[:at] + data[start:end] + data[at:]


def _remove_piece(random: Random, data: bytes) -> bytes:
    start, end = _piece(random, data, 2000)
    return data[:start] + data[end:]


def _remove_record(random: Random, data: bytes) -> bytes:
    record = _pick(random, data)
    return data[: record.start] + data[record.end :] if record else data[:-1]


def _repeat_record(random: Random, data: bytes) -> bytes:
    record = _pick(random, data)
    if record is None:
        return data[:-1]
    whole = data[record.start : record.end]
    at = random.choice([record.end, *(each.start for each in records_of(data))])
    return data[:at] + whole + data[at:]


def _repeat_chunk(random: Random, data: bytes) -> bytes:
    """A chunk with its message indexes again, behind itself or at the end of the data."""
    groups = _groups(data)
    if not groups:
        return _repeat_record(random, data)
    start, end = random.choice(groups)
    at = random.choice((end, groups[-1][1]))
    return data[:at] + data[start:end] + data[at:]


def _groups(data: bytes) -> list[tuple[int, int]]:
    """Each chunk with the message indexes that follow it."""
    groups: list[tuple[int, int]] = []
    for record in records_of(data):
        if record.opcode == CHUNK:
            groups.append((record.start, record.end))
        elif record.opcode == MESSAGE_INDEX and groups and groups[-1][1] == record.start:
            groups[-1] = (groups[-1][0], record.end)
    return groups


def _hide_record(random: Random, data: bytes) -> bytes:
    """A record becomes a private one, which readers pass over."""
    record = _pick(random, data)
    if record is None:
        return _flip_bits(random, data)
    return _with(data, record.start, bytes([record.opcode | 0x80]))


def _change_opcode(random: Random, data: bytes) -> bytes:
    record = _pick(random, data)
    if record is None:
        return _flip_bits(random, data)
    return _with(data, record.start, bytes([random.choice((random.randrange(17), PRIVATE))]))


def _wrong_checksum(random: Random, data: bytes) -> bytes:
    """Of a chunk, an attachment, the data section or the summary."""
    record = _pick(random, data, CHUNK, ATTACHMENT, DATA_END, FOOTER)
    if record is None:
        return _flip_bits(random, data)
    at = record.start + HEAD + 24 if record.opcode == CHUNK else record.end - 4
    return _with(data, at, random.randbytes(4))


def _no_checksum(random: Random, data: bytes) -> bytes:
    """As writers leave it that do not compute one. Nothing else is damaged."""
    record = _pick(random, data, CHUNK, ATTACHMENT, DATA_END, FOOTER)
    if record is None:
        return _cut(random, data)
    at = record.start + HEAD + 24 if record.opcode == CHUNK else record.end - 4
    return _with(data, at, bytes(4))


def _twice(random: Random, data: bytes) -> bytes:
    """The file behind itself, whole or its end lost."""
    return data + data[: random.choice((len(data), random.randrange(len(data))))]


def _torn_and_joined(random: Random, data: bytes) -> bytes:
    """The beginning of the file and, behind it, the whole file."""
    return data[: random.randrange(len(MAGIC), len(data))] + data


def _with(data: bytes, at: int, value: bytes) -> bytes:
    """The file with these bytes at this place, as long as before."""
    return (data[:at] + value + data[at + len(value) :])[: len(data)]


MUTATIONS: dict[str, Callable[[Random, bytes], bytes]] = {
    "cut": _cut,
    "cut at a record": _cut_at_record,
    "front lost": _lost_front,
    "bits flipped": _flip_bits,
    "bit flipped in a head": _flip_in_head,
    "page zeroed": _zero_page,
    "page of noise": _noise_page,
    "tail zeroed": _zero_tail,
    "noise inserted": _insert_noise,
    "own bytes inserted": _insert_own,
    "piece removed": _remove_piece,
    "record removed": _remove_record,
    "record repeated": _repeat_record,
    "chunk repeated": _repeat_chunk,
    "record hidden": _hide_record,
    "opcode changed": _change_opcode,
    "checksum wrong": _wrong_checksum,
    "checksum absent": _no_checksum,
    "file twice": _twice,
    "torn and joined": _torn_and_joined,
}

_ALONE = {"checksum absent", "record repeated", "chunk repeated"}
"""Without a checksum further damage could not be noticed; and of what comes twice, damaged each
time otherwise, nothing says that it is the same."""


def mutated(data: bytes, seed: int) -> tuple[str, bytes]:
    """The file damaged once, or up to three times, as the seed decides; and how, in words."""
    random = Random(seed)
    chosen = [random.choice(list(MUTATIONS))]
    if chosen[0] not in _ALONE:
        more = [name for name in MUTATIONS if name not in _ALONE]
        chosen += random.choices(more, k=random.choice((0, 0, 0, 1, 2)))
    for name in chosen:
        # What was damaged before may have nothing left that this could be done to.
        with suppress(struct.error, ValueError, IndexError):
            data = MUTATIONS[name](random, data) if len(data) > len(MAGIC) else data
    return ", ".join(chosen), data
