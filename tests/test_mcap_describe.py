"""What `describe` finds in a log, and how it is shown."""

from __future__ import annotations

import hashlib
from io import StringIO

import pytest
from mcap_mutations import CHUNK, records_of
from mcap_trips import ATTACHMENTS, METADATA, PROVENANCE, trip_of
from rich.console import Console

import trainlog
from trainlog.mcap import LogDescription, describe, write_log
from trainlog.topics import TOPICS, TRAIN_STATE
from trainlog.trip import Trip


def printed(description: LogDescription) -> str:
    console = Console(file=StringIO(), width=140)
    console.print(*description.shown())
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


def test_everything_in_a_log_is_found(tmp_path):
    trip, path = trip_of(rows=120, axles=3), tmp_path / "trip.mcap"
    write_log(trip, path)
    found = describe(path)
    assert (found.path, found.size, found.problem) == (path, path.stat().st_size, None)
    assert found.complete
    assert found.schema_version == "1"
    assert (found.metadata, found.provenance) == (METADATA, PROVENANCE)
    assert [(a.name, a.size, a.sha256) for a in found.attachments] == [
        (name, len(content), hashlib.sha256(content).hexdigest())
        for name, content in sorted(ATTACHMENTS.items())
    ]
    assert [topic.name for topic in found.topics] == list(trip.topics)
    for topic in found.topics:
        frame = trip[topic.name]
        assert (topic.message, topic.encoding) == (TOPICS[topic.name].message, "protobuf")
        assert (topic.count, topic.gaps) == (120, 0)
        stated = [topic.rate, topic.median_interval, topic.largest_gap]
        assert stated == pytest.approx([10.0, 0.1, 0.1])
        assert (topic.first, topic.last) == (frame.index[0], frame.index[-1])
        assert topic.units == {field.name: field.unit for field in TOPICS[topic.name].fields}
        per_axle = [field.name for field in TOPICS[topic.name].fields if field.per_axle]
        assert topic.axles == dict.fromkeys(per_axle, 3)
    assert (found.first, found.last) == (trip.start, trip.end)
    assert found.count == 120 * len(TOPICS)
    position = trip[TRAIN_STATE.name]["position"]
    assert found.position_span == (position.min(), position.max())
    first, last = position.min() / 1e3, position.max() / 1e3
    assert f"position  km {first:.3f} to km {last:.3f}" in repr(found)
    assert (found.chunks, found.compression) == (1, ("zstd",))
    assert 0 < found.stored_size < found.content_size


def test_texts_of_a_file_are_neither_markup_nor_commands(tmp_path):
    metadata = {"trip": "[red]night[/red]", "note": "a\x1b[2Jb\nc", "long": "x" * 500}
    write_log(Trip({}, metadata), tmp_path / "trip.mcap")
    text = printed(describe(tmp_path / "trip.mcap"))
    assert "[red]night[/red]" in text
    assert "\x1b" not in text
    assert "x" * 500 not in text.replace("\n", "").replace(" ", "")


def test_a_damaged_log_is_described_as_far_as_it_goes(tmp_path):
    trip = trip_of(rows=300, step=6 * 10**8)
    write_log(trip, tmp_path / "cut.mcap")
    data = (tmp_path / "cut.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    found = describe(tmp_path / "cut.mcap")
    assert not found.complete
    assert str(found.problem).startswith("byte ")
    assert (found.metadata, found.provenance) == (METADATA, PROVENANCE)
    assert 0 < found.count < 300 * len(TOPICS)
    kept = trip[TRAIN_STATE.name].iloc[: found.topics[0].count]["position"]
    assert found.position_span == (kept.min(), kept.max())
    assert "damaged" in printed(found)


def test_a_recording_that_was_not_closed_is_not_called_damaged(tmp_path):
    path = tmp_path / "live.mcap"
    with trainlog.record(path, flush=0.5) as log:
        log.write(TRAIN_STATE.name, 10**18, speed=1.0)
    data = path.read_bytes()
    end = next(each.end for each in reversed(records_of(data)) if each.opcode == CHUNK)
    path.write_bytes(data[:end])
    text = " ".join(printed(describe(path)).split())
    assert "was not closed: 1 message is readable; its last sample is of 2001-09-09" in text
    assert "damaged" not in text
    assert "1 in 1 chunk," in text
