"""Writing a trip as an MCAP file."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from trainlog.errors import LogError
from trainlog.formats.files import atomic_write
from trainlog.mcap.chunks import Plan, Stream, plan_of
from trainlog.mcap.errors import in_file
from trainlog.mcap.facts import attachment_of, metadata_records
from trainlog.mcap.names import PROVENANCE_RECORD
from trainlog.mcap.sink import PackedChunk, Sink, packed
from trainlog.mcap.streams import stream_of, topics_of
from trainlog.mcap.workers import threads_of
from trainlog.trip import Trip


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
        If `path` cannot be written.
    """
    with LogWriter(path, threads=threads, sync=sync) as log:
        log.add(trip)


class LogWriter:
    """A log written piece by piece, for trips larger than the memory; whole or not at all.

        with LogWriter("long.mcap") as log:
            for piece in pieces:
                log.add(piece)

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
        for stream in self._pending.values():
            self._sink.declare(stream.schema)
            self._sink.declare(stream.channel)
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

    def _packed(self, plan: Plan, chunks: int) -> Iterator[PackedChunk]:
        """The first chunks of a plan, in order, however many threads make them."""
        if self._threads == 1 or chunks < 2:
            yield from (packed(plan.chunk(number)) for number in range(chunks))
            return
        waiting: deque[Future[PackedChunk]] = deque()
        for number in range(chunks):
            waiting.append(self._pool.submit(_made, plan, number))
            if len(waiting) > 2 * self._threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()

    def _opened(self, file: BinaryIO) -> Sink:
        """The file begun: what explains it comes first, so that a cut file still has it."""
        sink = Sink(file)
        streams = self._pending.values()
        for stream in streams:
            sink.declare(stream.schema)
        for stream in streams:
            sink.declare(stream.channel)
        for name, values in (self._described or {}).items():
            sink.put_metadata(name, values)
        start = min((int(each.time[0]) for each in streams if len(each.time)), default=0)
        for name, content in sorted(self._attachments.items()):
            sink.put_attachment(attachment_of(name, content, start))
        return sink


def _made(plan: Plan, number: int) -> PackedChunk:
    return packed(plan.chunk(number))
