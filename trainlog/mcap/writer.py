"""Writing a trip as an MCAP file."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from trainlog.errors import LogError
from trainlog.formats.files import atomic_write
from trainlog.mcap.chunks import RawChunk, Stream, chunks
from trainlog.mcap.errors import in_file
from trainlog.mcap.names import FORMAT_RECORD, PROVENANCE_RECORD, TRIP_RECORD
from trainlog.mcap.streams import streams_of
from trainlog.topics import SCHEMA_VERSION
from trainlog.trip import Trip

COMPRESSION_LEVEL = 3
"""Of zstd: a tenth smaller than level 1, for a quarter of the speed."""


def write_log(trip: Trip, path: str | Path) -> None:
    """Write a trip as an MCAP file, whole or not at all.

    The same trip gives the same bytes. Absent columns and NaN are written as NaN, which reads as
    absent.

    Raises
    ------
    LogError
        If the trip cannot be written: a topic or column that the table does not have, times that
        run backwards, metadata that are not text.
    InputError
        If `path` cannot be written.
    """
    with in_file(path):
        streams = streams_of(trip)
        described = _metadata(trip)
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        _write(streams, described, trip.attachments, _Sink(stream))


class _Sink:
    """A file being written: where it stands, and the checksum of what was written."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.position = 0
        self.checksum = 0

    def put(self, data: bytes | bytearray) -> int:
        """Write `data`; returns where it starts."""
        start = self.position
        self._stream.write(data)
        self.position += len(data)
        self.checksum = zlib.crc32(data, self.checksum)
        return start


def _write(
    streams: list[Stream], described: list[Metadata], attachments: dict[str, bytes], sink: _Sink
) -> None:
    """The whole file. What explains it comes first, so that a cut file still has it."""
    sink.put(MCAP0_MAGIC + _bytes(Header(profile="", library="trainlog")))
    declared: list[McapRecord] = [stream.schema for stream in streams]
    declared += [stream.channel for stream in streams]
    for record in declared:
        sink.put(_bytes(record))
    start = min((int(stream.time[0]) for stream in streams if len(stream.time)), default=0)
    end = max((int(stream.time[-1]) for stream in streams if len(stream.time)), default=0)
    metadata_indexes = [_put_metadata(record, sink) for record in described]
    attachment_indexes = [
        _put_attachment(name, data, start, sink) for name, data in sorted(attachments.items())
    ]
    compress = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL).compress
    chunk_indexes = [_put_chunk(chunk, compress, sink) for chunk in chunks(streams)]
    sink.put(_bytes(DataEnd(data_section_crc=sink.checksum)))
    statistics = Statistics(
        attachment_count=len(attachment_indexes),
        channel_count=len(streams),
        channel_message_counts={
            stream.channel.id: len(stream.time) for stream in streams if len(stream.time)
        },
        chunk_count=len(chunk_indexes),
        message_count=sum(len(stream.time) for stream in streams),
        message_end_time=end,
        message_start_time=start,
        metadata_count=len(metadata_indexes),
        schema_count=len(streams),
    )
    _put_summary(
        [*declared, statistics, *chunk_indexes, *attachment_indexes, *metadata_indexes], sink
    )


def _put_metadata(record: Metadata, sink: _Sink) -> MetadataIndex:
    data = _bytes(record)
    return MetadataIndex(offset=sink.put(data), length=len(data), name=record.name)


def _put_attachment(name: str, content: bytes, time: int, sink: _Sink) -> AttachmentIndex:
    media = "application/json" if name.endswith(".json") else "application/octet-stream"
    data = _bytes(
        Attachment(create_time=0, log_time=time, name=name, media_type=media, data=content)
    )
    return AttachmentIndex(
        offset=sink.put(data),
        length=len(data),
        log_time=time,
        create_time=0,
        data_size=len(content),
        name=name,
        media_type=media,
    )


def _put_chunk(raw: RawChunk, compress: Callable[[bytearray], bytes], sink: _Sink) -> ChunkIndex:
    """Write a chunk and the message indexes that belong behind it."""
    chunk = Chunk(
        compression="zstd",
        data=compress(raw.data),
        message_end_time=raw.end,
        message_start_time=raw.start,
        uncompressed_crc=zlib.crc32(raw.data),
        uncompressed_size=len(raw.data),
    )
    data = _bytes(chunk)
    start = sink.put(data)
    offsets = {}
    for channel, entries in raw.index.items():
        # A MessageIndex record; its class of the mcap package takes a Python tuple a message.
        listed = entries.astype("<u8").tobytes()
        head = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(listed), channel, len(listed))
        offsets[channel] = sink.put(head + listed)
    return ChunkIndex(
        chunk_length=len(data),
        chunk_start_offset=start,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_end_time=raw.end,
        message_index_length=sink.position - start - len(data),
        message_index_offsets=offsets,
        message_start_time=raw.start,
        uncompressed_size=len(raw.data),
    )


def _put_summary(records: list[McapRecord], sink: _Sink) -> None:
    """Write the summary section, the offsets of its groups, and the footer with its checksum."""
    start = sink.position
    sink.checksum = 0
    groups = []
    for _, group in groupby(records, key=type):
        data = b"".join(_bytes(record) for record in group)
        groups.append(SummaryOffset(data[0], sink.put(data), len(data)))
    offsets_start = sink.position
    for offset in groups:
        sink.put(_bytes(offset))
    opening = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offsets_start)
    checksum = zlib.crc32(opening, sink.checksum)
    sink.put(_bytes(Footer(start, offsets_start, checksum)) + MCAP0_MAGIC)


def _metadata(trip: Trip) -> list[Metadata]:
    """The metadata records of a trip."""
    described = {
        FORMAT_RECORD: {"schema_version": str(SCHEMA_VERSION)},
        TRIP_RECORD: dict(sorted(trip.metadata.items())),
        PROVENANCE_RECORD: {
            f"{number:04d}": _json(step, number)
            for number, step in enumerate(trip.provenance, start=1)
        },
    }
    for values in described.values():
        for key, value in values.items():
            _check_text(key, value)
    for name in trip.attachments:
        _check_text(name, name)
    return [Metadata(name=name, metadata=values) for name, values in described.items()]


def _json(step: object, number: int) -> str:
    try:
        return json.dumps(step, ensure_ascii=False, allow_nan=False, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise LogError(
            f"step {number} of the provenance is not JSON: {error}",
            remedy="use text, finite numbers, lists and dictionaries with text keys",
        ) from error


def _check_text(key: object, value: object) -> None:
    if not isinstance(key, str) or not isinstance(value, str):
        raise LogError(
            f"metadata {key!r} is {value!r}, not text", remedy="turn it into text with str()"
        )
    try:
        f"{key}{value}".encode()
    except UnicodeEncodeError as error:
        raise LogError(
            f"metadata {key!r} cannot be written as UTF-8", remedy="remove the broken characters"
        ) from error


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data
