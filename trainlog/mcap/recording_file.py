"""The file of a live recording: begun, added to and ended so that it is readable at any moment."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path

from mcap.records import Channel, Schema

from trainlog.errors import InputError
from trainlog.formats.files import writing_error
from trainlog.mcap.chunks import Stream, plan_of
from trainlog.mcap.facts import attachment_of
from trainlog.mcap.names import RECORDING_RECORD
from trainlog.mcap.sink import Sink, packed

_UNBOUNDED = 2**62
"""A period [ns] that no chunk of a recording reaches: it is cut by its flushes."""


class RecordingFile:
    """The file of a recording, which did not exist before.

    Parameters
    ----------
    path : Path
    declared : (mcap.records.Schema, mcap.records.Channel)
        The channel that every recording has.
    described : dict of str to dict
        Its metadata records by name.
    attachments : dict of str to bytes
    sync : bool
        Whether each flush waits until the disk has it.

    Raises
    ------
    InputError
        If the file exists or cannot be made.
    """

    def __init__(
        self,
        path: Path,
        declared: tuple[Schema, Channel],
        described: dict[str, dict[str, str]],
        attachments: dict[str, bytes],
        *,
        sync: bool,
    ) -> None:
        self._path, self._sync = path, sync
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError as error:
            remedy = "choose another name; a recording never overwrites a file"
            raise InputError("exists already", file=path, remedy=remedy) from error
        except OSError as error:
            raise writing_error(path, error) from error
        try:
            self._sink = Sink(self._file)
            self._declare(*declared)
            for name, values in described.items():
                self._sink.put_metadata(name, values)
            for name, content in sorted(attachments.items()):
                self._sink.put_attachment(attachment_of(name, content, 0))
        except OSError as error:
            self._file.close()
            path.unlink(missing_ok=True)
            raise writing_error(path, error) from error

    def _declare(self, schema: Schema, channel: Channel) -> None:
        self._sink.declare(schema)
        self._sink.declare(channel)

    def put(self, streams: list[Stream]) -> Iterator[dict[str, int]]:
        """Write streams as chunks; for each chunk that is in the file, its messages by topic.

        Raises
        ------
        OSError
            If they cannot be written, or the file is no longer at its place.
        """
        for stream in streams:
            self._declare(stream.schema, stream.channel)
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
        """Close the file: with its summary if there is room for it, else behind its last chunk.

        Parameters
        ----------
        closed : dict of str to str
            What the closing metadata say.
        failed : bool
            Whether the last write failed, and may have left a part of a record.

        Raises
        ------
        OSError
            If there is no summary.
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
