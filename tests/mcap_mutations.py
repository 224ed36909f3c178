"""Damage to MCAP files, drawn from a seed: what disks, networks, crashes and copies do to them.

`mutated` is a pure function: the same bytes and the same seed give the same damage.
"""

import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import astuple, dataclass
from functools import partial
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


def _pick(random: Random, data: bytes, *opcodes: int) -> Record:
    """One of the file's records, each kind equally likely."""
    found = [each for each in records_of(data) if not opcodes or each.opcode in opcodes]
    opcode = random.choice(sorted({each.opcode for each in found}))
    return random.choice([each for each in found if each.opcode == opcode])


def _put(data: bytes, start: int, end: int, value: bytes = b"") -> bytes:
    """The file with other bytes in the place of some."""
    return data[:start] + value + data[end:]


def _flip_bits(random: Random, data: bytes) -> bytes:
    flipped = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 8, 64))):
        flipped[random.randrange(len(data))] ^= 1 << random.randrange(8)
    return bytes(flipped)


def _flip_in_head(random: Random, data: bytes) -> bytes:
    """One bit in the first bytes of a record, where opcode and lengths are."""
    record = _pick(random, data)
    at = random.randrange(record.start, min(record.end, record.start + 60))
    return _put(data, at, at + 1, bytes([data[at] ^ 1 << random.randrange(8)]))


def _forged_length(random: Random, data: bytes) -> bytes:
    at, most = _pick(random, data).start + 1, random.choice((2**64, len(data)))
    return _put(data, at, at + 8, struct.pack("<Q", random.randrange(most)))


def _zero_page(random: Random, data: bytes) -> bytes:
    page = random.choice((16, 512, 4096))
    start = random.randrange(len(data)) // page * page
    return _put(data, start, start + page, bytes(min(page, len(data) - start)))


def _noise_page(random: Random, data: bytes) -> bytes:
    start, end = _piece(random, data, 2048)
    return _put(data, start, end, random.randbytes(end - start))


def _own_bytes(random: Random, data: bytes) -> bytes:
    """A piece of the file again, somewhere else in it."""
    (start, end), at = _piece(random, data, 3000), random.randrange(len(data))
    return _put(data, at, at, data[start:end])


def _repeat_record(random: Random, data: bytes) -> bytes:
    record = _pick(random, data)
    at = random.choice([record.end, *(each.start for each in records_of(data))])
    return _put(data, at, at, data[record.start : record.end])


def _repeat_chunk(random: Random, data: bytes) -> bytes:
    """A chunk with its message indexes again, behind itself or at the end of the data."""
    groups: list[tuple[int, int]] = []
    for record in records_of(data):
        if record.opcode == CHUNK:
            groups.append((record.start, record.end))
        elif record.opcode == MESSAGE_INDEX and groups and groups[-1][1] == record.start:
            groups[-1] = (groups[-1][0], record.end)
    if not groups:
        return _repeat_record(random, data)
    start, end = random.choice(groups)
    at = random.choice((end, groups[-1][1]))
    return _put(data, at, at, data[start:end])


def _change_opcode(random: Random, data: bytes, *, hidden: bool) -> bytes:
    """Of a record, which becomes a private one where it is hidden: readers pass over it."""
    record = _pick(random, data)
    opcode = record.opcode | 0x80 if hidden else random.choice((random.randrange(17), PRIVATE))
    return _put(data, record.start, record.start + 1, bytes([opcode]))


def _checksum(random: Random, data: bytes, *, absent: bool) -> bytes:
    """Of a chunk, an attachment, the data section or the summary: wrong, or not computed."""
    record = _pick(random, data, CHUNK, ATTACHMENT, DATA_END, FOOTER)
    at = record.start + HEAD + 24 if record.opcode == CHUNK else record.end - 4
    return _put(data, at, at + 4, bytes(4) if absent else random.randbytes(4))


def _inside(random: Random, data: bytes) -> int:
    return random.randrange(len(MAGIC), len(data))


MUTATIONS: dict[str, Callable[[Random, bytes], bytes]] = {
    "cut": lambda random, data: data[: random.randrange(len(data))],
    "cut at a record": lambda random, data: data[: _pick(random, data).end],
    "front lost": lambda random, data: MAGIC + data[_inside(random, data) :],
    "bits flipped": _flip_bits,
    "bit flipped in a head": _flip_in_head,
    "length forged": _forged_length,
    "page zeroed": _zero_page,
    "page of noise": _noise_page,
    # A file system after a loss of power: the length is right, the last pages were not written.
    "tail zeroed": lambda random, data: data[: _inside(random, data)].ljust(len(data), b"\0"),
    "noise inserted": lambda random, data: _put(
        data, *[random.randrange(len(data))] * 2, random.randbytes(random.randint(1, 600))
    ),
    "own bytes inserted": _own_bytes,
    "piece removed": lambda random, data: _put(data, *_piece(random, data, 2000)),
    "record removed": lambda random, data: _put(data, *astuple(_pick(random, data))[1:]),
    "record repeated": _repeat_record,
    "chunk repeated": _repeat_chunk,
    "record hidden": partial(_change_opcode, hidden=True),
    "opcode changed": partial(_change_opcode, hidden=False),
    "checksum wrong": partial(_checksum, absent=False),
    "checksum absent": partial(_checksum, absent=True),
    # Whole, or its end lost; and the file behind its own beginning.
    "file twice": lambda random, data: (
        data + data[: random.choice((len(data), random.randrange(len(data))))]
    ),
    "torn and joined": lambda random, data: data[: _inside(random, data)] + data,
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
