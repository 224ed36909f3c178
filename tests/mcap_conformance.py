"""The files of MCAP's conformance suite, made by its published definition.

The suite (https://github.com/foxglove/mcap, ``tests/conformance``) writes six small sets of records
in every combination of ten features of the format; all files are valid.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from itertools import combinations
from typing import cast

from mcap.data_stream import RecordBuilder
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
PADDING = b"\x01\xff\xff"
"""What the suite adds to the end of each record that may be extended."""

FIXED = (Message, Chunk, DataEnd, Footer)
"""Records that are never extended."""

FEATURES = ("ch", "mx", "st", "rsh", "rch", "ax", "mdx", "chx", "sum", "pad")
"""Chunks, message indexes, statistics, schemas and channels repeated in the summary, indexes of
attachments, metadata and chunks, summary offsets, records extended."""

_SCHEMA = Schema(id=1, name="Example", encoding="c", data=bytes([4, 5, 6]))
_CHANNEL = Channel(
    id=1, topic="example", schema_id=1, message_encoding="a", metadata={"foo": "bar"}
)
_SCHEMALESS = Channel(id=1, topic="example", schema_id=0, message_encoding="text", metadata={})


def _message(log_time: int, publish_time: int, sequence: int) -> Message:
    return Message(
        channel_id=1,
        sequence=sequence,
        log_time=log_time,
        publish_time=publish_time,
        data=bytes([1, 2, 3]),
    )


INPUTS: dict[str, list[McapRecord]] = {
    "NoData": [],
    "OneSchemalessMessage": [_SCHEMALESS, _message(2, 1, 10)],
    "OneMessage": [_SCHEMA, _CHANNEL, _message(2, 1, 10)],
    "OneAttachment": [
        Attachment(
            name="myFile",
            media_type="application/octet-stream",
            log_time=2,
            create_time=1,
            data=bytes([1, 2, 3]),
        )
    ],
    "OneMetadata": [Metadata(name="myMetadata", metadata={"foo": "bar"})],
    "TenMessages": [
        _SCHEMA,
        _CHANNEL,
        *(_message(at, at, row) for row, at in enumerate([0, 2, 1, 3, 3, 5, 4, 7, 8, 9])),
    ],
}


def variants() -> Iterator[tuple[str, list[McapRecord], frozenset[str]]]:
    """Name, records and features of every file of the suite."""
    for name, records in INPUTS.items():
        for count in range(len(FEATURES) + 1):
            for chosen in combinations(FEATURES, count):
                features = frozenset(chosen)
                if _is_sensible(features, records):
                    yield "-".join([name, *sorted(features)]), records, features


def _is_sensible(features: frozenset[str], records: list[McapRecord]) -> bool:
    kinds = {type(record) for record in records}
    needs = {"ax": Attachment, "mdx": Metadata, "rsh": Schema, "rch": Channel}
    if any(feature in features and kind not in kinds for feature, kind in needs.items()):
        return False
    if not kinds & {Message, Channel, Schema} and features & {"ch", "chx", "mx"}:
        return False
    if "sum" in features and not features & {"chx", "rsh", "rch", "mdx", "ax", "st"}:
        return False
    return "ch" in features or not features & {"chx", "mx"}


@dataclass
class _File:
    """A file while it is made."""

    features: frozenset[str]
    stream: BytesIO = field(default_factory=BytesIO)

    def put(self, record: McapRecord) -> tuple[int, int]:
        """Write a record, extended if the file's are; returns its place and length."""
        data = record_bytes(record)
        if "pad" in self.features and not isinstance(record, FIXED):
            (length,) = struct.unpack_from("<Q", data, 1)
            data = data[:1] + struct.pack("<Q", length + len(PADDING)) + data[9:] + PADDING
        start = self.stream.tell()
        self.stream.write(data)
        return start, len(data)

    def group(self, records: list[McapRecord]) -> list[SummaryOffset]:
        """Write records of the summary; the summary offset that leads to them, if there are any."""
        if not records:
            return []
        start = self.stream.tell()
        opcode = record_bytes(records[0])[0]
        for record in records:
            self.put(record)
        return [SummaryOffset(opcode, start, self.stream.tell() - start)]


def record_bytes(record: McapRecord) -> bytes:
    """A record as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return cast(bytes, builder.end())


def generated(records: list[McapRecord], features: frozenset[str]) -> bytes:
    """The file of the suite with these records and features."""
    file = _File(features)
    file.stream.write(MAGIC)
    file.put(Header(profile="", library=""))
    attachments: list[McapRecord] = []
    metadata: list[McapRecord] = []
    inside = []
    for record in records:
        if isinstance(record, Attachment):
            start, length = file.put(record)
            attachments.append(
                AttachmentIndex(
                    offset=start,
                    length=length,
                    log_time=record.log_time,
                    create_time=record.create_time,
                    data_size=len(record.data),
                    name=record.name,
                    media_type=record.media_type,
                )
            )
        elif isinstance(record, Metadata):
            start, length = file.put(record)
            metadata.append(MetadataIndex(offset=start, length=length, name=record.name))
        elif "ch" in features:
            inside.append(record)
        else:
            file.put(record)
    chunks: list[McapRecord] = [_put_chunk(file, inside)] if "ch" in features else []
    file.put(DataEnd(data_section_crc=zlib.crc32(file.stream.getvalue())))
    _put_summary(
        file,
        {
            "rsh": [each for each in records if isinstance(each, Schema)],
            "rch": [each for each in records if isinstance(each, Channel)],
            "st": [_statistics(records, features)],
            "mdx": metadata,
            "ax": attachments,
            "chx": chunks,
        },
    )
    return file.stream.getvalue()


def _put_chunk(file: _File, inside: list[McapRecord]) -> ChunkIndex:
    """Write all schemas, channels and messages as one chunk, with its message indexes."""
    content = bytearray()
    index: dict[int, list[tuple[int, int]]] = {}
    times = []
    for record in inside:
        if isinstance(record, Channel):
            index.setdefault(record.id, [])
        if isinstance(record, Message):
            index.setdefault(record.channel_id, []).append((record.log_time, len(content)))
            times.append(record.log_time)
        content += record_bytes(record)
    first, last = min(times, default=0), max(times, default=0)
    chunk = Chunk(
        compression="",
        data=bytes(content),
        message_start_time=first,
        message_end_time=last,
        uncompressed_crc=zlib.crc32(content),
        uncompressed_size=len(content),
    )
    start, length = file.put(chunk)
    offsets = {}
    if "mx" in file.features:
        for channel, entries in index.items():
            offsets[channel] = file.put(MessageIndex(channel, entries))[0]
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=start,
        compression="",
        compressed_size=len(content),
        message_end_time=last,
        message_index_length=file.stream.tell() - start - length,
        message_index_offsets=offsets,
        message_start_time=first,
        uncompressed_size=len(content),
    )


def _statistics(records: list[McapRecord], features: frozenset[str]) -> Statistics:
    messages = [each for each in records if isinstance(each, Message)]
    times = [each.log_time for each in messages]
    return Statistics(
        attachment_count=sum(isinstance(each, Attachment) for each in records),
        channel_count=sum(isinstance(each, Channel) for each in records),
        channel_message_counts={1: len(messages)} if messages else {},
        chunk_count=int("ch" in features),
        message_count=len(messages),
        message_end_time=max(times, default=0),
        message_start_time=min(times, default=0),
        metadata_count=sum(isinstance(each, Metadata) for each in records),
        schema_count=sum(isinstance(each, Schema) for each in records),
    )


def _put_summary(file: _File, groups: dict[str, list[McapRecord]]) -> None:
    """Write those groups of the summary that the file has, their offsets, and the footer."""
    start = file.stream.tell()
    offsets: list[SummaryOffset] = []
    for feature, group in groups.items():
        if feature in file.features:
            offsets += file.group(group)
    behind = file.stream.tell()
    if "sum" in file.features:
        for offset in offsets:
            file.put(offset)
    first = start if behind > start else 0
    second = behind if "sum" in file.features else 0
    head = struct.pack("<BQQQ", 2, 20, first, second)
    checksum = zlib.crc32(file.stream.getvalue()[start:] + head)
    file.put(Footer(first, second, checksum))
    file.stream.write(MAGIC)
