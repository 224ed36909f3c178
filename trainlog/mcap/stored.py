"""Finding and fetching the parts of a file: record heads, chunks, message indexes, attachments."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace

from isal import isal_zlib
from mcap.opcode import Opcode

from trainlog.errors import LogError
from trainlog.mcap.codec import RECORD_HEAD
from trainlog.mcap.errors import damaged, shown
from trainlog.mcap.places import AttachmentPlace, ChunkPlace
from trainlog.mcap.records import (
    Index,
    StoredChunk,
    index_of,
    largest_chunk,
    opened,
    stored_chunk,
    stored_index,
)
from trainlog.mcap.source import Source

_WINDOW = 4096
"""Read at once while going from record to record [bytes]; most heads are far apart."""

_CHUNK_HEAD = struct.Struct("<QQQII")
_LONGEST_HEAD = 65_536
"""Longer names and media types of attachments are not believed [bytes]."""


class MisplacedError(LogError):
    """Something is not where the summary says; a walk over the file may find it."""


def heads(source: Source, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Offset, opcode and length of the content of each record from `start` to `end` of a file.

    Raises
    ------
    LogError
        Where a record leads beyond `end`.
    """
    at, base, window = start, start, b""
    while at < end:
        if at + RECORD_HEAD > end:
            raise damaged(at, "the file ends inside a record")
        if not base <= at <= base + len(window) - RECORD_HEAD:
            base, window = at, source.read(at, _WINDOW)
        opcode, length = struct.unpack_from("<BQ", window, at - base)
        if length > end - at - RECORD_HEAD:
            raise damaged(
                at,
                f"a record of {length:,} bytes begins and only {end - at - RECORD_HEAD:,} follow",
            )
        if opcode == 0:
            raise damaged(at, "there is no record with opcode 0")
        yield at, opcode, length
        at += RECORD_HEAD + length


def chunk_place(source: Source, offset: int, length: int) -> ChunkPlace:
    """Where the parts of the chunk stand whose record of `length` bytes begins at `offset`.

    Its message indexes are not known yet.

    Raises
    ------
    LogError
        If the record is no chunk.
    """
    head = source.read(offset + RECORD_HEAD, min(length - RECORD_HEAD, _CHUNK_HEAD.size + 64))
    try:
        start, end, size, _, width = _CHUNK_HEAD.unpack_from(head)
        at = _CHUNK_HEAD.size + width
        compression = str(head[_CHUNK_HEAD.size : at], "utf-8")
        (stored,) = struct.unpack_from("<Q", head, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise damaged(offset, "the chunk record cannot be read") from error
    if RECORD_HEAD + at + 8 + stored != length:
        raise damaged(offset, "the chunk's length contradicts its record's")
    behind = offset + length
    return ChunkPlace(
        offset, length, compression, behind - stored, stored, size, start, end, {}, behind, {}
    )


def loose_place(start: int, end: int) -> ChunkPlace:
    """A run of messages outside of chunks, as if it were a chunk that is not compressed."""
    return ChunkPlace(start, end - start, "", start, end - start, end - start, 0, 0, {}, end, {})


def fetched(source: Source, place: ChunkPlace) -> StoredChunk:
    """The chunk that stands there.

    Raises
    ------
    MisplacedError
        If there is no such chunk.
    """
    if place.loose:
        data = memoryview(source.read(place.offset, place.length))
        return StoredChunk(place.offset, "", data, place.size, checksum=0)
    record = memoryview(source.read(place.offset, place.length))
    opcode, length = struct.unpack_from("<BQ", record)
    if (opcode, length) == (Opcode.CHUNK, place.length - RECORD_HEAD):
        try:
            chunk = stored_chunk(record[RECORD_HEAD:], place.offset)
        except LogError as error:
            raise MisplacedError(error.problem, place=error.place, remedy=error.remedy) from error
        if (chunk.compression, chunk.size) == (place.compression, place.size):
            return replace(chunk, limit=largest_chunk(source.size))
    raise MisplacedError(
        "the chunk is not where the summary says",
        place=f"byte {place.offset}",
        remedy="copy or record it again",
    )


def fetched_index(source: Source, place: ChunkPlace, channels: Iterable[int]) -> Index:
    """The message index of those of the channels that the chunk holds.

    Raises
    ------
    LogError
        If it cannot be read, or lists another number of messages than it should.
    """
    found: Index = {}
    wanted = [channel for channel in channels if channel in place.indexes]
    if not wanted:
        return found
    first = min(place.indexes[channel] for channel in wanted)
    last = max(
        place.indexes[channel] + RECORD_HEAD + 6 + 16 * place.counts[channel] for channel in wanted
    )
    stored = memoryview(source.read(first, last - first))
    for channel in wanted:
        at = place.indexes[channel]
        expected = 6 + 16 * place.counts[channel]
        content = stored[at - first + RECORD_HEAD :][:expected]
        head = bytes(stored[at - first :][:RECORD_HEAD])
        listed, entries = stored_index(content, at)
        if head != struct.pack("<BQ", Opcode.MESSAGE_INDEX, expected) or listed != channel:
            raise damaged(at, "the message index record cannot be read")
        if len(entries):
            found[channel] = entries
    return found


def index_in(source: Source, place: ChunkPlace) -> Index:
    """The message index of all channels of a chunk: as stored, or else from the chunk's records.

    Raises
    ------
    LogError
        If neither can be read.
    """
    if place.indexes:
        with suppress(LogError):
            return fetched_index(source, place, place.counts)
    index = index_of(opened(fetched(source, place), check=True), place.offset)
    return {channel: entries for channel, entries in index.items() if channel in place.counts}


def attachment_place(source: Source, offset: int, length: int) -> AttachmentPlace:
    """Where the attachment's content stands whose record of `length` bytes begins at `offset`.

    Raises
    ------
    LogError
        If the record is no attachment.
    """
    stop = offset + length - 4
    texts = []
    head = source.read(offset + RECORD_HEAD, min(length - RECORD_HEAD, _LONGEST_HEAD))
    try:
        log_time, create_time = struct.unpack_from("<QQ", head)
        at = 16
        for _ in range(2):
            (width,) = struct.unpack_from("<I", head, at)
            at += 4 + width
            texts.append(str(head[at - width : at], "utf-8"))
        (size,) = struct.unpack_from("<Q", head, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise damaged(offset, "the attachment record cannot be read") from error
    data = offset + RECORD_HEAD + at + 8
    if data + size != stop:
        raise damaged(offset, "the attachment's length contradicts its record's")
    return AttachmentPlace(offset, length, texts[0], texts[1], log_time, create_time, data, size)


def attachment_data(source: Source, place: AttachmentPlace) -> bytes:
    """The content of an attachment, checked.

    Raises
    ------
    LogError
        If it fails its checksum.
    """
    content = source.read(place.offset + RECORD_HEAD, place.length - RECORD_HEAD)
    checksum = int.from_bytes(content[-4:], "little")
    if checksum and isal_zlib.crc32(memoryview(content)[:-4]) != checksum:
        raise damaged(place.offset, f"attachment {shown(place.name)} fails its checksum")
    return content[-4 - place.size : -4]
