"""Writing MCAP files: records one after the other, the summary that finds them, whole trips.

`Sink` writes what it is given in the order of the calls, and knows no trips or topics; `LogWriter`,
the recorder and the repair of damaged files all write through it. Records outside the chunks are
those of the official package.
"""

from __future__ import annotations

import errno
import json
import os
import struct
import sys
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np
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

from trainlog.errors import InputError, LogError
from trainlog.formats.files import atomic_write, check_kind, check_written, writing_error
from trainlog.mcap.chunks import Chunk, Plan, Stream, packed, plan_of, stream_of, topics_of
from trainlog.mcap.records import (
    FORMAT_RECORD,
    POSITIONS_RECORD,
    PROVENANCE_RECORD,
    RECORDING_RECORD,
    TRIP_RECORD,
    checksum,
    in_file,
    threads_of,
)
from trainlog.mcap.selection import Entry, encoded
from trainlog.topics import SCHEMA_VERSION
from trainlog.trip import Trip

_UNBOUNDED = 2**62
"""A period [ns] that no chunk of a recording reaches: it is cut by its flushes."""

_CHUNK_HEAD = struct.Struct("<BQQQQII")
"""Opcode, length, first and last log time, size, checksum, length of the compression's name."""

_INDEX_HEAD = struct.Struct("<BQHI")
"""Opcode, length, channel and length of the entries of a message index."""


def write_log(
    trip: Trip, path: str | Path, *, threads: int | None = None, sync: bool = False
) -> None:
    """Write a trip as an MCAP file, whole or not at all.

    The same trip gives the same bytes. Absent columns and NaN are written as NaN, which reads as
    absent.

    Parameters
    ----------
    trip : Trip
    path : path
    threads : int, optional
        That lay out and compress. Default: one a processor, at most four.
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
    with LogWriter(path, threads=threads, sync=sync) as log:
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
    threads, sync
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

    def __init__(self, path: str | Path, *, threads: int | None = None, sync: bool = False) -> None:
        self._path = path
        self._threads = threads_of(threads)
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
            self._pool = opening.enter_context(ThreadPoolExecutor(self._threads))
            self._resources = opening.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                if self._described is None:
                    self.add(Trip({}))
                self._write(last=True)
        except BaseException:
            self._resources.__exit__(*sys.exc_info())
            raise
        self._resources.__exit__(kind, error, trace)

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
        plan = plan_of(list(self._pending.values()))
        if self._sink is None and (len(plan) or last):
            self._sink = self._opened(self._file)
        if self._sink is None:
            return
        self._sink.declare(*_declared(self._pending.values()))
        full = len(plan) if last else max(0, len(plan) - 1)
        for chunk in self._packed(plan, full):
            self._sink.put_chunk(chunk)
        if full:
            self._pending = dict(zip(self._pending, plan.behind(full), strict=True))
        if last:
            first = (self._described or {}).get(PROVENANCE_RECORD, {})
            later = {key: step for key, step in self._steps.items() if first.get(key) != step}
            if later:
                self._sink.put_metadata(PROVENANCE_RECORD, later)
            self._sink.finish()

    def _packed(self, plan: Plan, chunks: int) -> Iterator[Chunk]:
        """The first chunks of a plan, in order, however many threads make them."""
        if self._threads == 1 or chunks < 2:
            yield from (packed(plan.chunk(number)) for number in range(chunks))
            return
        waiting: deque[Future[Chunk]] = deque()
        for number in range(chunks):
            waiting.append(self._pool.submit(lambda each: packed(plan.chunk(each)), number))
            if len(waiting) > 2 * self._threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()

    def _opened(self, file: BinaryIO) -> Sink:
        """The file begun: what explains it comes first, so that a cut file still has it."""
        streams = self._pending.values()
        start = min((int(each.time[0]) for each in streams if len(each.time)), default=0)
        sink = Sink(file)
        declared = [*(each.schema for each in streams), *(each.channel for each in streams)]
        sink.explain(declared, self._described or {}, self._attachments, start)
        return sink


def _declared(streams: Iterable[Stream]) -> Iterator[Schema | Channel]:
    """The schema and the channel of each stream."""
    for stream in streams:
        yield from (stream.schema, stream.channel)


class RecordingFile:
    """The file of a recording, readable at any moment; InputError if it exists or cannot be made.

    Parameters
    ----------
    path : Path
    sync : bool
        Whether each `put` waits until the disk has it.
    """

    def __init__(self, path: Path, sync: bool) -> None:
        self._path, self._sync = path, sync
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError as error:
            remedy = "choose another name; a recording never overwrites a file"
            raise InputError("exists already", file=path, remedy=remedy) from error
        except OSError as error:
            raise writing_error(path, error) from error

    def begin(
        self,
        declared: tuple[Schema, Channel],
        described: dict[str, dict[str, str]],
        attachments: dict[str, bytes],
    ) -> None:
        """Write what explains the recording; InputError, and no file, if it cannot be written."""
        try:
            self._sink = Sink(self._file)
            self._sink.explain(declared, described, attachments, 0)
        except OSError as error:
            self._file.close()
            self._path.unlink(missing_ok=True)
            raise writing_error(self._path, error) from error

    def put(self, streams: list[Stream]) -> Iterator[dict[str, int]]:
        """Write streams as chunks; for each chunk that is in the file, its messages by topic.

        Raises
        ------
        OSError
            If they cannot be written, or the file is no longer at its place.
        """
        self._sink.declare(*_declared(streams))
        topics = {stream.channel.id: stream.channel.topic for stream in streams}
        plan = plan_of(streams, period=_UNBOUNDED)
        for number in range(len(plan)):
            chunk = packed(plan.chunk(number))
            self._sink.put_chunk(chunk)
            yield {topics[channel]: len(entries) for channel, entries in chunk.index.items()}
        if self._sync:
            os.fsync(self._file.fileno())
        here, there = os.fstat(self._file.fileno()), self._path.stat()
        if (here.st_dev, here.st_ino) != (there.st_dev, there.st_ino):
            raise FileNotFoundError(errno.ENOENT, "another file has taken its place")

    def end(self, closed: dict[str, str], *, failed: bool) -> None:
        """Close the file: with its summary if there is space for it, else behind its last chunk.

        `closed` is what the closing metadata state; `failed` whether the last write failed, and may
        have left a part of a record. OSError if there is no summary.
        """
        try:
            if failed:
                self._cut()
            self._sink.put_metadata(RECORDING_RECORD, closed)
            self._sink.finish()
            if self._sync:
                os.fsync(self._file.fileno())
        except OSError:
            self._cut()
            raise
        finally:
            self._file.close()

    def _cut(self) -> None:
        """Take away the part of a record that a failed write may have left."""
        self._file.truncate(self._sink.position)
        self._file.seek(self._sink.position)


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
        self._span: tuple[int, int] | None = None
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

    def put_chunk(self, chunk: Chunk) -> None:
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
            self._checksum = checksum(part, self._checksum)
        return start


def record_bytes(record: McapRecord) -> bytes:
    """A record as it stands in a file, opcode and length included."""
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data
