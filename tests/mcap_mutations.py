"""Damage to MCAP files, drawn from a seed: what disks, networks, crashes and forgers do to them.

`mutated` is a pure function: the same bytes and the same seed give the same damage.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from random import Random

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
HEAD = 9
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
CHUNK_INDEX, ATTACHMENT, STATISTICS, METADATA, DATA_END = 0x08, 0x09, 0x0B, 0x0C, 0x0F
PRIVATE = 0x87

_LIES = (0, 1, 8, 2**8 - 1, 2**16, 2**20, 2**24, 2**31 - 1, 2**32 - 1, 2**40, 2**62, 2**64 - 1)
_BOMB = 2**26
"""Content of a bomb [bytes]: a thousand times the file and more."""


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


def _swap_chunks(random: Random, data: bytes) -> bytes:
    groups = _groups(data)
    if len(groups) < 2:
        return _swap_records(random, data)
    (a, b), (c, d) = sorted(random.sample(groups, 2))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def _swap_records(random: Random, data: bytes) -> bytes:
    found = records_of(data)
    if len(found) < 2:
        return data[:-1]
    one, other = sorted(random.sample(found, 2), key=lambda each: each.start)
    return (
        data[: one.start]
        + data[other.start : other.end]
        + data[one.end : other.start]
        + data[one.start : one.end]
        + data[other.end :]
    )


def _groups(data: bytes) -> list[tuple[int, int]]:
    """Each chunk with the message indexes that follow it."""
    groups: list[tuple[int, int]] = []
    for record in records_of(data):
        if record.opcode == CHUNK:
            groups.append((record.start, record.end))
        elif record.opcode == MESSAGE_INDEX and groups and groups[-1][1] == record.start:
            groups[-1] = (groups[-1][0], record.end)
    return groups


def _forge_record_length(random: Random, data: bytes) -> bytes:
    record = _pick(random, data)
    if record is None:
        return _flip_bits(random, data)
    (length,) = struct.unpack_from("<Q", data, record.start + 1)
    nearby = (length + random.randint(-40, 40)) % 2**64
    others = [each.end - record.start - HEAD for each in records_of(data)]
    swallowing = random.choice([each for each in others if each >= 0] or [0])
    claimed = random.choice((nearby, nearby, swallowing, random.choice(_LIES)))
    return _with(data, record.start + 1, struct.pack("<Q", claimed))


def _forge_inner_length(random: Random, data: bytes) -> bytes:
    """A length or an offset inside a record: of a string, a map, a chunk, an index, an array."""
    record = _pick(random, data)
    if record is None or record.end - record.start < HEAD + 4:
        return _flip_bits(random, data)
    at = random.randrange(record.start + HEAD, min(record.end - 3, record.start + HEAD + 60))
    width = random.choice("IQ") if at + 8 <= record.end else "I"
    (true,) = struct.unpack_from(f"<{width}", data, at)
    claimed = random.choice((true + random.randint(-40, 40), random.choice(_LIES)))
    return _with(data, at, struct.pack(f"<{width}", claimed % 2 ** (32 if width == "I" else 64)))


def _forge_chunk(random: Random, data: bytes) -> bytes:
    """A chunk record whose lengths agree, and swallow what follows or stop short."""
    record = _pick(random, data, CHUNK)
    if record is None:
        return _forge_record_length(random, data)
    (name,) = struct.unpack_from("<I", data, record.start + HEAD + 28)
    inner = record.start + HEAD + 32 + name
    (stored,) = struct.unpack_from("<Q", data, inner)
    ends = [each.end for each in records_of(data) if each.end > record.end]
    grown = random.choice([*(end - record.end for end in ends), random.randint(-stored, 3000)])
    forged = _with(data, record.start + 1, struct.pack("<Q", record.end - record.start - 9 + grown))
    return _with(forged, inner, struct.pack("<Q", stored + grown))


def _forge_uncompressed_size(random: Random, data: bytes) -> bytes:
    record = _pick(random, data, CHUNK)
    if record is None:
        return _forge_record_length(random, data)
    return _with(data, record.start + HEAD + 16, struct.pack("<Q", random.choice(_LIES)))


def _forge_offset(random: Random, data: bytes) -> bytes:
    """An offset in the footer, or in an index of the summary, with the checksum made to fit."""
    found = records_of(data)
    summary = [each for each in found if each.opcode in (0x08, 0x0A, 0x0D, 0x0E)]
    footer = next((each for each in found if each.opcode == FOOTER), None)
    if footer is None:
        return _flip_bits(random, data)
    claimed = struct.pack("<Q", random.choice((random.randrange(len(data)), random.choice(_LIES))))
    if not summary or random.random() < 0.3:
        return _with(data, footer.start + HEAD + random.choice((0, 8)), claimed)
    record = random.choice(summary)
    at = random.randrange(record.start + HEAD, max(record.start + HEAD + 1, record.end - 8))
    forged = _with(data, at, claimed)
    return _summary_sealed(forged) if random.random() < 0.7 else forged


def _forge_statistics(random: Random, data: bytes) -> bytes:
    record = _pick(random, data, STATISTICS)
    if record is None:
        return _flip_bits(random, data)
    at = random.randrange(record.start + HEAD, record.end - 8)
    forged = _with(data, at, struct.pack("<Q", random.choice(_LIES)))
    return _summary_sealed(forged) if random.random() < 0.5 else forged


def _forge_index_entry(random: Random, data: bytes) -> bytes:
    """A time or an offset in a message index."""
    record = _pick(random, data, MESSAGE_INDEX)
    if record is None or record.end - record.start < HEAD + 6 + 16:
        return _flip_bits(random, data)
    at = record.start + HEAD + 6 + 8 * random.randrange((record.end - record.start - 15) // 8)
    other = record.start + HEAD + 6 + 8 * random.randrange((record.end - record.start - 15) // 8)
    value = random.choice((data[other : other + 8], struct.pack("<Q", random.choice(_LIES))))
    return _with(data, at, value)


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


def _bomb(random: Random, data: bytes) -> bytes:
    """A few bytes that hold very much: zeros, or messages; the size declared truly or not."""
    record = _pick(random, data, CHUNK)
    at = random.choice([each.start for each in records_of(data)] or [len(data)])
    message = struct.pack("<BQHIQQ", MESSAGE, 22 + 9, random.randrange(4), 1, 10**18, 10**18)
    content = random.choice((bytes(2**14), (message + bytes(9)) * 400))
    name, stored = random.choice(
        (
            ("zstd", _frame(content, known=True)),
            ("zstd", _frame(content, known=False)),
            ("lz4", _lz4_bomb(content)),
        )
    )
    size = _BOMB // len(content) * len(content)
    claimed = random.choice((size, size, len(content), 2**30, 2**62))
    checksum = random.choice((0, _crc_of_bomb(content)))
    forged = chunk_bytes(name, stored, claimed, checksum, struct.pack("<QQ", 0, 2**62))
    if record is not None and random.random() < 0.5:
        return data[: record.start] + forged + data[record.end :]
    return data[:at] + forged + data[at:]


@cache
def _frame(content: bytes, *, known: bool) -> bytes:
    """A zstd frame of a bomb's length; `known` if it tells that length itself."""
    times = _BOMB // len(content)
    size = times * len(content) if known else -1
    compressor = zstandard.ZstdCompressor(write_content_size=known).compressobj(size=size)
    parts = [compressor.compress(content) for _ in range(times)]
    return b"".join([*parts, compressor.flush()])


@cache
def _lz4_bomb(content: bytes) -> bytes:
    compressor = lz4.frame.LZ4FrameCompressor()
    parts = [compressor.begin()]
    parts += [compressor.compress(content) for _ in range(_BOMB // len(content))]
    return b"".join([*parts, compressor.flush()])


@cache
def _crc_of_bomb(content: bytes) -> int:
    checksum = 0
    for _ in range(_BOMB // len(content)):
        checksum = zlib.crc32(content, checksum)
    return checksum


def _twice(random: Random, data: bytes) -> bytes:
    """The file behind itself, whole or its end lost."""
    return data + data[: random.choice((len(data), random.randrange(len(data))))]


def _torn_and_joined(random: Random, data: bytes) -> bytes:
    """The beginning of the file and, behind it, the whole file."""
    return data[: random.randrange(len(MAGIC), len(data))] + data


def _with(data: bytes, at: int, value: bytes) -> bytes:
    """The file with these bytes at this place, as long as before."""
    return (data[:at] + value + data[at + len(value) :])[: len(data)]


def _summary_sealed(data: bytes) -> bytes:
    """The file with the checksum of its summary computed again."""
    found = records_of(data)
    footer = next((each for each in found if each.opcode == FOOTER), None)
    end = next((each for each in found if each.opcode == DATA_END), None)
    if footer is None or end is None:
        return data
    checksum = zlib.crc32(data[end.end : footer.end - 4])
    return _with(data, footer.end - 4, struct.pack("<I", checksum))


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
    "chunks swapped": _swap_chunks,
    "records swapped": _swap_records,
    "record length forged": _forge_record_length,
    "inner length forged": _forge_inner_length,
    "chunk lengths forged": _forge_chunk,
    "content size forged": _forge_uncompressed_size,
    "offset forged": _forge_offset,
    "statistics forged": _forge_statistics,
    "index entry forged": _forge_index_entry,
    "record hidden": _hide_record,
    "opcode changed": _change_opcode,
    "checksum wrong": _wrong_checksum,
    "checksum absent": _no_checksum,
    "bomb": _bomb,
    "file twice": _twice,
    "torn and joined": _torn_and_joined,
}

_ALONE = {"checksum absent", "statistics forged", "offset forged"}
"""Forgeries that remove or renew a checksum: further damage behind them could not be told."""


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
