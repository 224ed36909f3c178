"""An MCAP file being written: records one after the other, then the summary that finds them again.

What is written stands in the file in the order of the calls. Nothing here knows trips or topics;
`trainlog.mcap.writer`, the recorder and the repair of damaged files all write through it.
"""

from __future__ import annotations

import struct
import threading
from collections import Counter
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np
import zstandard
from isal.isal_zlib import crc32
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from trainlog.mcap.names import POSITIONS_RECORD
from trainlog.mcap.positions import Entry, Range, encoded

COMPRESSION = zstandard.ZstdCompressionParameters.from_level(
    3, source_size=2**20, hash_log=18, min_match=4, write_content_size=True
)
"""Level 3 of zstd: a tenth smaller than level 1, for a quarter of the speed. Its longer table of
matches, and matches from four bytes on, are worth a hundredth of the size and cost no time."""

_CHUNK_HEAD = struct.Struct("<BQQQQII")
"""Opcode, length, first and last log time, size, checksum, length of the compression's name."""

_INDEX_HEAD = struct.Struct("<BQHI")
"""Opcode, length, channel and length of the entries of a message index."""


@dataclass(frozen=True)
class RawChunk:
    """The content of one chunk before compression.

    Attributes
    ----------
    data : bytes-like
        Message records (and, in files of other programs, schemas and channels).
    start, end : int
        Earliest and latest log time of its messages [ns].
    index : dict of int to (n, 2) uint64 array
        Log time and offset of each message by channel id, for the channels it holds.
    positions : dict of str to (float, float)
        Least and greatest position [m] by topic, for the topics that tell it.
    """

    data: bytes | bytearray | memoryview
    start: int
    end: int
    index: dict[int, NDArray[np.uint64]]
    positions: dict[str, Range] = field(default_factory=dict)


@dataclass(frozen=True)
class PackedChunk:
    """A chunk as it will stand in a file.

    Attributes
    ----------
    compression : str
        ``"zstd"``, ``"lz4"`` or ``""``.
    data : bytes-like
        Its content, compressed.
    size : int
        Length of its content before compression [bytes].
    checksum : int
        CRC-32 of its content before compression; 0 if there is none.
    start, end : int
        Earliest and latest log time of its messages [ns].
    index : dict of int to (n, 2) uint64 array
        Log time and offset of each message by channel id, for the channels it holds.
    positions : dict of str to (float, float)
        Least and greatest position [m] by topic, for the topics that tell it.
    """

    compression: str
    data: bytes | memoryview
    size: int
    checksum: int
    start: int
    end: int
    index: dict[int, NDArray[np.uint64]]
    positions: dict[str, Range] = field(default_factory=dict)


class _Compressor(threading.local):
    """One compressor a thread: its tables are a megabyte, and are set up once."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdCompressor(compression_params=COMPRESSION)


_compressor = _Compressor()


def packed(raw: RawChunk) -> PackedChunk:
    """The chunk compressed, with its checksum. Runs in any thread, mostly without the GIL."""
    return PackedChunk(
        "zstd",
        _compressor.zstd.compress(raw.data),
        len(raw.data),
        crc32(raw.data),
        raw.start,
        raw.end,
        raw.index,
        raw.positions,
    )


class Sink:
    """An MCAP file being written.

    Each call writes one record, a chunk together with its message indexes. A call that fails with
    an OSError changes nothing here: after truncating the file to `position`, it can be gone on
    with or finished.

    Parameters
    ----------
    stream : binary file
        Written from where it stands; need not seek.
    profile : str
        Of the header; ``""`` unless another program's file is rebuilt.

    Attributes
    ----------
    position : int
        How many bytes are written.
    """

    def __init__(self, stream: BinaryIO, profile: str = "") -> None:
        self._stream = stream
        self.position = 0
        self._checksum = 0
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunks: list[ChunkIndex] = []
        self._counts: Counter[int] = Counter()
        self._span: tuple[int, int] | None = None
        self._positions: dict[str, list[Entry]] = {}
        self._put(MCAP0_MAGIC + record_bytes(Header(profile=profile, library="trainlog")))

    def declare(self, record: Schema | Channel) -> None:
        """Write a schema or a channel; once, however often it is declared."""
        known: dict[int, Schema] | dict[int, Channel]
        known = self._schemas if isinstance(record, Schema) else self._channels
        if record.id not in known:
            self._put(record_bytes(record))
            known[record.id] = record

    def put_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record."""
        data = record_bytes(Metadata(name=name, metadata=values))
        start = self._put(data)
        self._metadata.append(MetadataIndex(offset=start, length=len(data), name=name))

    def put_attachment(self, attachment: Attachment) -> None:
        """Write an attachment, with its checksum."""
        data = record_bytes(attachment)
        start = self._put(data)
        self._attachments.append(
            AttachmentIndex(
                offset=start,
                length=len(data),
                log_time=attachment.log_time,
                create_time=attachment.create_time,
                data_size=len(attachment.data),
                name=attachment.name,
                media_type=attachment.media_type,
            )
        )

    def put_chunk(self, chunk: PackedChunk) -> None:
        """Write a chunk, just compressed or taken from another file, and its message indexes."""
        name = chunk.compression.encode()
        length = _CHUNK_HEAD.size - 9 + len(name) + 8 + len(chunk.data)
        head = _CHUNK_HEAD.pack(
            Opcode.CHUNK, length, chunk.start, chunk.end, chunk.size, chunk.checksum, len(name)
        )
        parts = [head + name + struct.pack("<Q", len(chunk.data)), chunk.data]
        at = self.position + 9 + length
        offsets = {}
        for channel, entries in chunk.index.items():
            # A MessageIndex record; its class of the mcap package takes a Python tuple a message.
            listed = np.ascontiguousarray(entries, dtype="<u8").reshape(-1).view(np.uint8).data
            size = len(listed)
            parts += [_INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size), listed]
            offsets[channel] = at
            at += _INDEX_HEAD.size + size
        start = self._put(*parts)
        self._chunks.append(
            ChunkIndex(
                chunk_length=9 + length,
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.end,
                message_index_length=self.position - start - 9 - length,
                message_index_offsets=offsets,
                message_start_time=chunk.start,
                uncompressed_size=chunk.size,
            )
        )
        self._counts.update({channel: len(entries) for channel, entries in chunk.index.items()})
        for topic, (least, greatest) in chunk.positions.items():
            self._positions.setdefault(topic, []).append((start, chunk.start, least, greatest))
        if chunk.index:
            first, last = self._span or (chunk.start, chunk.end)
            self._span = min(first, chunk.start), max(last, chunk.end)

    def finish(self) -> None:
        """Write the end of the data, the summary and the footer. The stream stays open."""
        if self._positions:
            told = {topic: encoded(entries) for topic, entries in sorted(self._positions.items())}
            self.put_metadata(POSITIONS_RECORD, told)
        end = record_bytes(DataEnd(data_section_crc=self._checksum))
        start = self.position + len(end)
        summary, offsets = bytearray(), bytearray()
        for group in self._summary():
            if group:
                data = b"".join(map(record_bytes, group))
                place = SummaryOffset(data[0], start + len(summary), len(data))
                offsets += record_bytes(place)
                summary += data
        behind = start + len(summary)
        opening = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, behind)
        checksum = crc32(summary + offsets + opening)
        footer = record_bytes(Footer(start, behind, checksum))
        self._put(end, summary, offsets, footer, MCAP0_MAGIC)

    def _summary(self) -> list[list[McapRecord]]:
        """The records of the summary, by kind."""
        first, last = self._span or (0, 0)
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(sorted(self._counts.items())),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_end_time=last,
            message_start_time=first,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        return [
            [*self._schemas.values()],
            [*self._channels.values()],
            [statistics],
            [*self._chunks],
            [*self._attachments],
            [*self._metadata],
        ]

    def _put(self, *parts: bytes | bytearray | memoryview) -> int:
        """Write the parts, all or an OSError; returns where they start."""
        for part in parts:
            left = memoryview(part)
            while len(left):
                left = left[self._stream.write(left) :]
        start = self.position
        for part in parts:
            self.position += len(part)
            self._checksum = crc32(part, self._checksum)
        return start


def record_bytes(record: McapRecord) -> bytes:
    """A record as it stands in a file, opcode and length included."""
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data
