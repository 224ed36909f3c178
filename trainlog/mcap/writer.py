"""Writing MCAP files: messages cut into chunks, records and their summary, whole trips.

The messages of all channels are interleaved by time, cut, laid out and compressed as chunks. `Sink`
writes what it is given in the order of the calls, and knows no trips or topics; `LogWriter`, the
recorder and the repair of damaged files all write through it. Records outside the chunks are those
of the official package.
"""

from __future__ import annotations

import json
import struct
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
import pandas as pd
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
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
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from trainlog.arrays import IntArray, UintArray
from trainlog.errors import InputError, LogError, in_file
from trainlog.formats.files import atomic_write, check_kind, check_written
from trainlog.mcap.codec import (
    SEQUENCE,
    Codec,
    Entry,
    Range,
    channel_of,
    codec_for,
    encode_events,
    encoded,
    range_of,
    scatter,
    schema_of,
    table_of,
)
from trainlog.mcap.records import (
    FORMAT_RECORD,
    POSITIONS_RECORD,
    PROVENANCE_RECORD,
    TRIP_RECORD,
    Index,
    checksum,
)
from trainlog.topics import (
    EVENTS,
    RECORDED,
    SCHEMA_VERSION,
    TOPICS,
    Topic,
    column_field,
    topic_of_frame,
)
from trainlog.trip import POSITION_TOPICS, Trip

PERIOD = 60 * 10**9
"""Longest time that one chunk of a derived file spans [ns]: a minute of a trip is what a damaged
chunk costs at most. With 10 s files are up to a twentieth larger, with no limit up to a hundredth
smaller."""

LARGEST = 2**20
"""Largest chunk before compression [bytes], unless one message is longer."""

COMPRESSION = zstandard.ZstdCompressionParameters.from_level(
    3, source_size=2**20, hash_log=18, min_match=4, write_content_size=True
)
"""Level 3 of zstd: a tenth smaller than level 1, for a quarter of the speed. Its longer table of
matches, and matches from four bytes on, are worth a hundredth of the size and cost no time."""

_SEQUENCE_AT = 11
"""Where the sequence number stands in a message record, before the two times."""


# ------------------------------------------------------------------------------------- messages


@dataclass(frozen=True)
class Stream:
    """One channel and its messages, oldest first.

    Attributes
    ----------
    channel : mcap.records.Channel
    schema : mcap.records.Schema
    time : (n,) int64
        Log time of each message [ns since 1970 UTC], never decreasing.
    table : (columns, n) array
        One row a column of the codec, one column a message. Without a codec one row of objects:
        messages that differ in length, each a record already (bytes).
    codec : Codec or None
        How messages of one length are laid out.
    sequence : (n,) uint32, optional
        Their sequence numbers. Default: for each the number of messages of the channel before its
        chunk, counted from `before`. Counted on within the chunk, they would make a file a
        twentieth larger.
    before : int
        How many messages of the channel came before these.
    """

    channel: Channel
    schema: Schema
    time: IntArray
    table: NDArray[Any]
    codec: Codec | None = None
    sequence: NDArray[np.uint32] | None = None
    before: int = 0

    @cached_property
    def sizes(self) -> IntArray:
        """Length of each message's record [bytes]."""
        if self.codec is not None:
            return np.full(len(self.time), self.codec.layout.size, dtype=np.int64)
        return np.array([len(record) for record in self.table[0]], dtype=np.int64)

    def behind(self, row: int) -> Stream:
        """The messages from `row` on."""
        return replace(
            self,
            time=self.time[row:],
            table=self.table[:, row:],
            sequence=None if self.sequence is None else self.sequence[row:],
            before=self.before + row,
        )

    def then(self, others: Stream) -> Stream:
        """These messages and behind them those of the same channel that follow."""
        if not len(self.time):
            return replace(others, before=self.before)
        if not len(others.time):
            return self
        time = np.concatenate([self.time, others.time])
        return replace(self, time=time, table=np.concatenate([self.table, others.table], axis=1))

    def put(self, rows: slice, data: NDArray[np.uint8], offsets: IntArray) -> UintArray:
        """Lay messages out in a chunk; returns their entries of its message index."""
        time = self.time[rows]
        if self.sequence is None:
            count = (self.before + rows.start) & 0xFFFFFFFF
            sequence = np.full(len(time), count, dtype=np.uint32)
        else:
            sequence = self.sequence[rows]
        if self.codec is not None:
            records = self.codec.encode(time, self.table[:, rows])
            records[SEQUENCE] = sequence
            scatter(records, data.data, offsets)
        else:
            buffer = data.data
            places = zip(offsets.tolist(), sequence.tolist(), time.tolist(), strict=True)
            for record, (at, *head) in zip(self.table[0, rows], places, strict=True):
                buffer[at : at + len(record)] = record
                struct.pack_into("<IQQ", buffer, at + _SEQUENCE_AT, *head, head[1])
        return np.stack([time, offsets], axis=1).view(np.uint64)


def topics_of(trip: Trip) -> list[Topic]:
    """The topics that a trip has frames of, in the order of the table.

    Raises
    ------
    LogError
        If the table does not have one of them.
    """
    others = sorted(name for name in trip.topics if name not in TOPICS)
    own = [known_topic(name, trip.topics[name]) for name in others]
    return [topic for topic in TOPICS.values() if topic.name in trip.topics] + own


def known_topic(name: str, frame: pd.DataFrame | None = None) -> Topic:
    """The topic called `name`, which a recorder's own `frame` describes.

    Raises
    ------
    LogError
        If the table does not have it, and it is no topic of a recorder's own with a frame.
    """
    if name in TOPICS:
        return TOPICS[name]
    if frame is None or not name.startswith(RECORDED):
        remedy = f"topics are {', '.join(TOPICS)}, and a recorder's own below {RECORDED}"
        raise LogError(f"there is no topic {name}", remedy=remedy)
    try:
        return topic_of_frame({**frame.attrs, "topic": name})
    except KeyError:
        raise LogError(
            f"the frame of {name} does not describe its columns",
            remedy="build it with trainlog.trip.frame_of and trainlog.recorded_topic",
        ) from None
    except InputError as error:
        raise LogError(error.problem, remedy=error.remedy) from error


def stream_of(topic: Topic, frame: pd.DataFrame, number: int) -> Stream:
    """The stream of one frame; channel and schema are both called `number`.

    Raises
    ------
    LogError
        If the frame does not fit the table of topics, or its times run backwards.
    """
    time = _time(topic, frame)
    axles = _axles(topic, frame)
    channel, schema = channel_of(topic, number, number, axles), schema_of(topic, number)
    if topic is EVENTS:
        records = np.empty((1, len(frame)), dtype=object)
        records[0, :] = encode_events(number, frame)
        return Stream(channel, schema, time, records)
    codec = codec_for(topic, number, axles)
    return Stream(channel, schema, time, table_of(frame, codec.names), codec)


def _time(topic: Topic, frame: pd.DataFrame) -> IntArray:
    """The frame's times [ns since 1970 UTC], checked."""
    index = frame.index
    if not isinstance(index, pd.DatetimeIndex) or index.tz is None:
        raise LogError(
            f"{topic.name} is not indexed by time with a time zone",
            remedy="build the frame with trainlog.trip.frame_of",
        )
    time = index.as_unit("ns").asi8
    if np.any(time < 0):
        row = int(np.argmax(time < 0))
        raise LogError(
            f"{topic.name} has no time, or one before 1970",
            place=f"row {row}",
            remedy="give every row its time",
        )
    if np.any(np.diff(time) < 0):
        row = int(np.argmax(np.diff(time) < 0)) + 1
        raise LogError(
            f"time of {topic.name} runs backwards to {index[row].isoformat()}",
            place=f"row {row}",
            remedy="sort the rows by time",
        )
    return time


def _axles(topic: Topic, frame: pd.DataFrame) -> dict[str, int]:
    """How many axles each field of the topic has in the frame, all columns checked."""
    if not frame.columns.is_unique:
        raise LogError(f"{topic.name} has a column twice", remedy="remove one of them")
    found: dict[str, set[int]] = {field.name: set() for field in topic.fields if field.per_axle}
    for column in map(str, frame.columns):
        try:
            field = column_field(topic, column)
        except KeyError:
            raise LogError(
                f"{topic.name} has no field for column {column}",
                remedy=f"its fields are {', '.join(field.name for field in topic.fields)}",
            ) from None
        if field.per_axle:
            found[field.name].add(int(column.rpartition("_")[2]))
    for name, numbers in found.items():
        if numbers != set(range(1, len(numbers) + 1)):
            raise LogError(
                f"{topic.name} has {name} for the axles {sorted(numbers)} only",
                remedy="number the axles from 1 without gaps",
            )
    return {name: len(numbers) for name, numbers in found.items()}


# --------------------------------------------------------------------------------------- chunks


class _Compressor(threading.local):
    """One compressor a thread: its tables are a megabyte, and are set up once."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdCompressor(compression_params=COMPRESSION)


_compressor = _Compressor()


def packed(content: bytes | memoryview, start: int, end: int) -> Chunk:
    """A chunk, compressed. Runs in any thread, mostly without the GIL.

    Parameters
    ----------
    content : bytes-like
        Its messages.
    start, end : int
        Earliest and latest log time of these [ns].
    """
    data = _compressor.zstd.compress(content)
    return Chunk("zstd", data, end, start, checksum(content), len(content))


Ranges = dict[str, Range]
"""Least and greatest position [m] by topic."""


Part = tuple[Stream, slice, IntArray]
"""A part of a chunk: a stream, its rows, and where each stands in the chunk [bytes]."""


def parts_of(
    streams: Sequence[Stream], period: int = PERIOD, largest: int = LARGEST
) -> list[list[Part]]:
    """The streams' messages in the order of time, cut into chunks that do not overlap.

    Messages of the same time keep the order of the streams. A chunk is closed before the message
    that would make it longer than `largest`, and before the one that lies `period` behind its
    first.

    Parameters
    ----------
    streams : sequence of Stream
    period : int
        Longest time that a chunk spans [ns].
    largest : int
        Largest chunk [bytes], unless one message is longer.

    Returns
    -------
    list of list of Part
        The parts of each chunk.
    """
    if not any(len(stream.time) for stream in streams):
        return []
    time = np.concatenate([stream.time for stream in streams])
    sizes = np.concatenate([stream.sizes for stream in streams])
    order = np.argsort(time, kind="stable") if len(streams) > 1 else np.arange(time.size)
    ends = np.cumsum(sizes[order])
    starts = ends - sizes[order]
    firsts = _cuts(time[order], ends, period, largest)
    counts = np.diff(firsts)
    chunk, offset = np.empty_like(order), np.empty_like(ends)
    chunk[order] = np.repeat(np.arange(counts.size), counts)
    offset[order] = starts - np.repeat(starts[firsts[:-1]], counts)
    found: list[list[Part]] = [[] for _ in counts]
    begin = 0
    for stream in streams:
        own = slice(begin, begin := begin + len(stream.time))
        rows = np.searchsorted(chunk[own], np.arange(counts.size + 1)).tolist()
        for parts, first, end in zip(found, rows, rows[1:], strict=False):
            if first < end:
                parts.append((stream, slice(first, end), offset[own][first:end]))
    return found


def laid_out(parts: Sequence[Part]) -> tuple[Chunk, Index, Ranges]:
    """A chunk of some parts, its message index, and the positions in it by topic."""
    size = sum(int(stream.sizes[rows].sum()) for stream, rows, _ in parts)
    data = np.empty(size, dtype=np.uint8)
    index = {stream.channel.id: stream.put(rows, data, offsets) for stream, rows, offsets in parts}
    start = min(int(stream.time[rows.start]) for stream, rows, _ in parts)
    end = max(int(stream.time[rows.stop - 1]) for stream, rows, _ in parts)
    positions = {
        stream.channel.topic: range_of(stream.table[stream.codec.names.index("position"), rows])
        for stream, rows, _ in parts
        if stream.codec is not None and stream.channel.topic in POSITION_TOPICS
    }
    return packed(data.data, start, end), index, positions


def _cuts(time: IntArray, ends: IntArray, period: int, largest: int) -> IntArray:
    """The first message of each chunk, and their number; `ends` is the sum of the lengths."""
    cuts = [0]
    while cuts[-1] < time.size:
        first = cuts[-1]
        before = int(ends[first - 1]) if first else 0
        full = int(np.searchsorted(ends, before + largest, side="right"))
        late = int(np.searchsorted(time, min(int(time[first]) + period, 2**63 - 1), side="left"))
        cuts.append(max(first + 1, min(full, late if late > first else time.size)))
    return np.array(cuts)


_INDEX_HEAD = struct.Struct("<BQHI")
"""Opcode, length, channel and length of the entries of a message index."""


def write_log(trip: Trip, path: str | Path, *, sync: bool = False) -> None:
    """Write a trip as an MCAP file, whole or not at all.

    The same trip gives the same bytes. Absent columns and NaN are written as NaN, which reads as
    absent.

    Parameters
    ----------
    trip : Trip
    path : path
    sync : bool
        Whether to wait until the disk has it: the file then outlasts a power cut, not only the end
        of this program.

    Raises
    ------
    LogError
        If the trip cannot be written: a topic or column that the table does not have, times that
        run backwards, metadata that are not text.
    InputError
        If what is given is no trip, or `path` cannot be written.

    Examples
    --------
    >>> import trainlog
    >>> import tempfile
    >>> from trainlog.mcap import read_log
    >>> trip = read_log("sample_logs/nonstop.mcap")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     trainlog.write(trip, f"{folder}/again.mcap")
    ...     again = read_log(f"{folder}/again.mcap")
    >>> again["/train/state"].equals(trip["/train/state"])
    True
    """
    check_written(trip, Trip)
    with LogWriter(path, sync=sync) as log:
        log.add(trip)


class LogWriter:
    """A log written piece by piece, for trips larger than the memory; whole or not at all.

    The pieces follow each other in time. Metadata and attachments are those of the first, the
    provenance is that of the last, which knows what was lost on the way. When the block ends the
    file takes its place; when it fails there is no file, and an older one stays as it was. The
    bytes are those that `write_log` gives for the whole trip, if all its topics are in the first
    piece, no two pieces share an instant and the provenance of all is the same.

    Parameters
    ----------
    path : path
    sync
        As for `write_log`.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.mcap import describe, stream_log
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with LogWriter(f"{folder}/long.mcap") as log:
    ...         for piece in stream_log("sample_logs/nonstop.mcap", rows=10_000):
    ...             log.add(piece)
    ...     made = describe(f"{folder}/long.mcap").account.messages
    >>> made == describe("sample_logs/nonstop.mcap").account.messages
    True
    """

    def __init__(self, path: str | Path, *, sync: bool = False) -> None:
        self._path = path
        self._resources = ExitStack()
        self._place = atomic_write(path, sync=sync)
        self._sink: Sink | None = None
        self._described: dict[str, dict[str, str]] | None = None
        self._steps: dict[str, str] = {}
        self._attachments: dict[str, bytes] = {}
        self._pending: dict[str, Stream] = {}
        self._end = 0

    def __enter__(self) -> LogWriter:
        with ExitStack() as opening:
            temporary = opening.enter_context(self._place)
            self._file = opening.enter_context(temporary.open("wb"))
            self._resources = opening.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._resources:
            if error is not None:
                raise error
            if self._described is None:
                self.add(Trip({}))
            self._write(last=True)

    def add(self, piece: Trip) -> None:
        """Write the next piece.

        Raises
        ------
        LogError
            If it cannot be written, see `write_log`; if it begins before the piece before it ends,
            or has another number of axles.
        InputError
            If the file cannot be written.
        """
        check_kind(piece, Trip)
        with in_file(self._path):
            described = metadata_records(piece)
            if self._described is None:
                self._described = described
                self._attachments = piece.attachments
            self._steps = described[PROVENANCE_RECORD]
            streams = self._checked(piece)
        for name, stream in streams.items():
            held = self._pending.get(name)
            self._pending[name] = stream if held is None else held.then(stream)
        self._end = max([self._end, *(int(s.time[-1]) for s in streams.values() if len(s.time))])
        self._write(last=False)

    def _checked(self, piece: Trip) -> dict[str, Stream]:
        """The piece's streams, with the channels that their topics have in the file."""
        streams: dict[str, Stream] = {}
        for topic in topics_of(piece):
            held = self._pending.get(topic.name)
            number = len(self._pending.keys() | streams.keys()) + 1
            stream = stream_of(topic, piece.topics[topic.name], held.channel.id if held else number)
            if held and held.channel != stream.channel:
                raise LogError(
                    f"{topic.name} has another number of axles than in the piece before",
                    remedy="give every piece the same columns",
                )
            streams[topic.name] = stream
        starts = [int(stream.time[0]) for stream in streams.values() if len(stream.time)]
        if starts and min(starts) < self._end:
            raise LogError(
                "a piece begins before the one before it ends",
                remedy="add the pieces in the order of time",
            )
        return streams

    def _write(self, *, last: bool) -> None:
        """Write the chunks that are full; if these are the last messages, all."""
        chunks = parts_of(list(self._pending.values()))
        if self._sink is None and (chunks or last):
            # What explains the file comes first, so that a cut file still has it.
            streams = self._pending.values()
            start = min((int(each.time[0]) for each in streams if len(each.time)), default=0)
            self._sink = Sink(self._file)
            explained = [*(each.schema for each in streams), *(each.channel for each in streams)]
            self._sink.explain(explained, self._described or {}, self._attachments, start)
        if self._sink is None:
            return
        self._sink.declare(*declared(self._pending.values()))
        full = len(chunks) if last else len(chunks) - 1
        for parts in chunks[:full]:
            self._sink.put_chunk(*laid_out(parts))
        if full > 0:
            left = {stream.channel.topic: rows.start for stream, rows, _ in chunks[-1]}
            self._pending = {
                name: stream.behind(left.get(name, len(stream.time)))
                for name, stream in self._pending.items()
            }
        if last:
            first = (self._described or {}).get(PROVENANCE_RECORD, {})
            later = {key: step for key, step in self._steps.items() if first.get(key) != step}
            if later:
                self._sink.put_metadata(PROVENANCE_RECORD, later)
            self._sink.finish()


def declared(streams: Iterable[Stream]) -> Iterator[Schema | Channel]:
    """The schema and the channel of each stream."""
    for stream in streams:
        yield from (stream.schema, stream.channel)


def metadata_records(trip: Trip) -> dict[str, dict[str, str]]:
    """The metadata records that explain a trip, by name.

    Raises
    ------
    LogError
        If they or the names of the attachments cannot be written.
    """
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
    return described


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
            f"metadata {key!r} cannot be written as UTF-8",
            remedy="remove the broken characters, or name the trip otherwise",
        ) from error


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
        self._positions: dict[str, list[Entry]] = {}
        self._put(MCAP0_MAGIC + record_bytes(Header(profile=profile, library="trainlog")))

    def explain(
        self,
        declared: Iterable[Schema | Channel],
        described: dict[str, dict[str, str]],
        attachments: dict[str, bytes],
        time: int,
    ) -> None:
        """Write what explains a trip: schemas and channels, metadata, files carried along."""
        self.declare(*declared)
        for name, values in described.items():
            self.put_metadata(name, values)
        for name, data in sorted(attachments.items()):
            media = "application/json" if name.endswith(".json") else "application/octet-stream"
            self.put_attachment(Attachment(0, time, name, media, data))

    def declare(self, *records: Schema | Channel) -> None:
        """Write schemas and channels; each once, however often it is declared."""
        for record in records:
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

    def put_chunk(self, chunk: Chunk, index: Index, positions: Ranges | None = None) -> None:
        """Write a chunk, just compressed or taken from another file, and its message indexes."""
        parts: list[bytes | memoryview] = [record_bytes(chunk)]
        start, length = self.position, len(parts[0])
        at, offsets = start + length, {}
        for channel, entries in index.items():
            # A MessageIndex record; its class of the mcap package takes a Python tuple a message.
            listed = np.ascontiguousarray(entries, dtype="<u8").reshape(-1).view(np.uint8).data
            size = len(listed)
            parts += [_INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size), listed]
            offsets[channel] = at
            at += _INDEX_HEAD.size + size
        self._put(*parts)
        self._chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=at - start - length,
                message_index_offsets=offsets,
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self._counts.update({channel: len(entries) for channel, entries in index.items()})
        for topic, span in (positions or {}).items():
            self._positions.setdefault(topic, []).append((start, chunk.message_start_time, *span))

    def finish(self) -> None:
        """Write the end of the data, the summary and the footer. The stream stays open."""
        if self._positions:
            ranges = {topic: encoded(entries) for topic, entries in sorted(self._positions.items())}
            self.put_metadata(POSITIONS_RECORD, ranges)
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
        found = checksum(summary + offsets + opening)
        footer = record_bytes(Footer(start, behind, found))
        self._put(end, summary, offsets, footer, MCAP0_MAGIC)

    def _summary(self) -> list[list[McapRecord]]:
        """The records of the summary, by kind."""
        filled = [each for each in self._chunks if each.message_index_offsets]
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(sorted(self._counts.items())),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_end_time=max((each.message_end_time for each in filled), default=0),
            message_start_time=min((each.message_start_time for each in filled), default=0),
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
            self._checksum = checksum(part, self._checksum)
        return start


def record_bytes(record: McapRecord) -> bytes:
    """A record as it stands in a file, opcode and length included."""
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data
