"""The file being written: chunks copied from elsewhere, records that come late, failing disks."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import StreamReader

from trainlog.arrays import UintArray
from trainlog.mcap.records import MESSAGE
from trainlog.mcap.writer import Sink, packed

TIMES = [5, 3, 9]


def raw(channel: int = 7, times: list[int] | None = None) -> bytes:
    """Messages of four bytes, as a program might write them: not in the order of time."""
    numbered = enumerate(TIMES if times is None else times)
    return b"".join(MESSAGE.pack(5, 26, channel, n, t, t) + b"data" for n, t in numbered)


def chunk(channel: int = 7) -> tuple[Chunk, dict[int, UintArray]]:
    """A chunk of these messages, and its index."""
    index = [[t, 35 * n] for n, t in enumerate(TIMES)]
    made = packed(raw(channel), min(TIMES), max(TIMES))
    return made, {channel: np.array(index, dtype=np.uint64).reshape(-1, 2)}


def declare(sink: Sink, channel: int = 7) -> None:
    sink.declare(Schema(id=channel, name="a", encoding="", data=b""))
    sink.declare(Channel(channel, f"/{channel}", "raw", {}, channel))


def messages(data: bytes) -> list[tuple[str, int, int]]:
    reader = SeekingReader(BytesIO(data), validate_crcs=True)
    found = [
        (channel.topic, message.sequence, message.log_time)
        for _, channel, message in reader.iter_messages(log_time_order=False)
    ]
    streamed = StreamReader(BytesIO(data), validate_crcs=True).records
    assert sum(type(record).__name__ == "Message" for record in streamed) == len(found)
    return found


class Disk(BytesIO):
    """A disk with so many bytes left, which takes what fits before it fails."""

    space = 10**9

    def write(self, data: bytes) -> int:  # type: ignore[override]
        if not self.space:
            raise OSError(28, "No space left on device")
        written = super().write(bytes(data[: min(self.space, 11)]))
        self.space -= written
        return written


@pytest.mark.parametrize("space", [0, 1, 40, 70, 100])
def test_after_a_failure_the_file_can_still_be_finished(space: int) -> None:
    """Disks take part of what they are given: at each call, and before they are full."""
    disk = Disk()
    sink = Sink(disk)
    declare(sink)
    sink.put_chunk(*chunk())
    before = sink.position
    disk.space = space
    with pytest.raises(OSError, match="No space"):
        sink.put_chunk(*chunk())
    assert sink.position == before
    disk.truncate(sink.position)
    disk.seek(sink.position)
    disk.space = 10**9
    sink.finish()
    assert len(messages(disk.getvalue())) == len(TIMES)
