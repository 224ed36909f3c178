"""The file being written: chunks copied from elsewhere, records that come late, failing disks."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, Schema
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


def test_chunks_may_be_copied_as_they_are() -> None:
    """Uncompressed here, as some programs write them; the index goes along."""
    stream = BytesIO()
    sink = Sink(stream, profile="ros2")
    declare(sink)
    sink.put_chunk(Chunk("", raw(), 9, 3, 0, len(raw())), chunk()[1])
    sink.put_chunk(packed(raw(times=[2, 4]), 2, 4), {})
    sink.put_attachment(Attachment(1, 2, "notes", "text/plain", b"words"))
    sink.put_metadata("facts", {"a": "b"})
    sink.finish()
    assert sink.position == len(stream.getvalue())
    assert [time for _, _, time in messages(stream.getvalue())] == [5, 3, 9, 2, 4]
    reader = SeekingReader(BytesIO(stream.getvalue()))
    assert reader.get_header().profile == "ros2"
    summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    # A chunk without an index is counted nowhere; its span in time is its own affair.
    assert summary.statistics.channel_message_counts == {7: 3}
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (3, 9)
    assert [index.compression for index in summary.chunk_indexes] == ["", "zstd"]
    (attachment,) = reader.iter_attachments()
    assert (attachment.create_time, attachment.log_time, attachment.data) == (1, 2, b"words")


def test_channels_may_come_between_chunks_and_are_written_once() -> None:
    stream = BytesIO()
    sink = Sink(stream)
    declare(sink)
    sink.put_chunk(*chunk())
    declare(sink, 8)
    at = sink.position
    declare(sink, 8)
    assert sink.position == at
    sink.put_chunk(*chunk(8))
    sink.finish()
    topics = [topic for topic, _, _ in messages(stream.getvalue())]
    assert topics == ["/7"] * 3 + ["/8"] * 3


def test_an_empty_file_is_whole() -> None:
    stream = BytesIO()
    Sink(stream).finish()
    assert messages(stream.getvalue()) == []


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


def test_the_official_index_of_a_chunk(tmp_path: Path) -> None:
    """Entries stand behind their chunk as the format says."""
    stream = BytesIO()
    sink = Sink(stream)
    declare(sink)
    sink.put_chunk(*chunk())
    end = sink.position
    entries = stream.getvalue()[end - 48 :]
    assert list(struct.iter_unpack("<QQ", entries)) == [(5, 0), (3, 35), (9, 70)]
