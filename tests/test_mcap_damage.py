"""Damaged files give all that is readable with an account of the rest, or one `LogError`."""

from __future__ import annotations

import struct
import tempfile
import tracemalloc
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from mcap.reader import SeekingReader
from mcap.records import ChunkIndex
from mcap_mutations import records_of
from mcap_trips import ATTACHMENTS, assert_same, trip_of
from refusals import refused

from trainlog.errors import LogError
from trainlog.mcap import DamageWarning, account_of, describe, read_log, write_log
from trainlog.mcap.records import Source
from trainlog.topics import EVENTS, TRAIN_AXLES, TRAIN_STATE
from trainlog.trip import Trip


@pytest.fixture(scope="module")
def trip() -> Trip:
    # Three minutes: three chunks.
    topics = [TRAIN_STATE.name, TRAIN_AXLES.name, EVENTS.name]
    return trip_of(rows=300, topics=topics, step=6 * 10**8)


@pytest.fixture(scope="module")
def data(trip: Trip, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "trip.mcap"
    write_log(trip, path)
    return path.read_bytes()


def chunks_of(data: bytes) -> list[ChunkIndex]:
    summary = SeekingReader(BytesIO(data)).get_summary()
    return summary.chunk_indexes


def without_checksums(data: bytes) -> bytearray:
    """The same log as a writer without checksums would leave it."""
    stripped = bytearray(data)
    for index in chunks_of(data):
        struct.pack_into("<I", stripped, index.chunk_start_offset + 9 + 24, 0)
    footer = len(data) - 8 - 20
    (summary_start,) = struct.unpack_from("<Q", data, footer)
    struct.pack_into("<I", stripped, summary_start - 4, 0)
    struct.pack_into("<I", stripped, footer + 16, 0)
    return stripped


@pytest.mark.parametrize("claimed", [2**29, 2**64 - 1])
def test_forged_chunk_sizes_do_not_exhaust_the_memory(claimed, data, tmp_path):
    forged = without_checksums(data)
    for index in chunks_of(data):
        struct.pack_into("<Q", forged, index.chunk_start_offset + 9 + 16, claimed)
    (tmp_path / "forged.mcap").write_bytes(forged)
    tracemalloc.start()
    refused(LogError, "no message of it is readable", read_log, tmp_path / "forged.mcap")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 50e6


def test_attachments_are_checked_on_their_own(trip, data, tmp_path):
    flipped = without_checksums(data)
    flipped[flipped.index(ATTACHMENTS["line.json"])] ^= 1
    (tmp_path / "flipped.mcap").write_bytes(flipped)
    with pytest.warns(DamageWarning) as caught:
        found = read_log(tmp_path / "flipped.mcap")
    (loss,) = caught[0].message.account.losses
    assert loss.reason == "attachment 'line.json' fails its checksum"
    assert found.attachments == {"notes": ATTACHMENTS["notes"]}
    assert found.topics.keys() == trip.topics.keys()


def test_an_index_that_contradicts_its_chunk_is_not_followed(trip, data, tmp_path):
    """It lists too few messages, or one twice: the chunk's own records are asked instead."""
    path = tmp_path / "forged.mcap"
    offsets = chunks_of(data)[0].message_index_offsets
    forged = without_checksums(data)
    # The channel's index becomes a private record, which readers pass over.
    forged[offsets[1]] = 0x87
    path.write_bytes(forged)
    assert_same(trip, read_log(path))
    for at in offsets.values():
        forged = bytearray(data)
        # The second entry's offset becomes the first one's.
        forged[at + 15 + 24 : at + 15 + 32] = forged[at + 15 + 8 : at + 15 + 16]
        path.write_bytes(forged)
        for topic, frame in trip.topics.items():
            assert frame.equals(read_log(path, topics=[topic])[topic])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"time,speed\n1,2\n", "is not an MCAP file but text; 'trainlog ingest' makes logs of"),
        ("Züge\n".encode()[:-4] + b"\xc3", "but text"),
        ("Züge;Größe km/h\n1;2\n".encode("cp1252") * 20, "but text; 'trainlog ingest' makes"),
        (b"PAR1\x15\x04", "but a Parquet file; 'trainlog convert FOLDER.parquet -o"),
        (b' {"format": "trainlog/line"', "but a trainlog/line file; give the logs"),
        (b"[1, 2]", "but a JSON file; 'trainlog ingest'"),
        (b"\x1f\x8b\x08\x00", "but compressed with gzip; unpack it"),
        (b"\x89MCAP", "not an MCAP file; expected a log"),
    ],
)
def test_files_that_are_no_log(content, said, tmp_path):
    (tmp_path / "trip.mcap").write_bytes(content)
    for read in (read_log, describe):
        refused(LogError, said, read, tmp_path / "trip.mcap")


@pytest.mark.parametrize(
    ("conversion", "old", "new"), [("CRLF to LF", b"\r\n", b"\n"), ("LF to CRLF", b"\n", b"\r\n")]
)
def test_converted_line_ends_are_named(conversion, old, new, data, tmp_path):
    """As git or a transfer in text mode does it; no byte behind the first is where it was."""
    path = tmp_path / "trip.mcap"
    path.write_bytes(data.replace(old, new))
    for read in (read_log, describe, account_of):
        caught = refused(LogError, f"line ends were converted from {conversion}", read, path)
        assert "binary mode" in str(caught.remedy)
        assert ".gitattributes" in str(caught.remedy)


@settings(max_examples=20)
@given(st.lists(st.tuples(st.integers(0, 210_000), st.integers(0, 100_000)), max_size=12))
def test_any_part_of_a_file_is_read_as_it_stands(parts):
    """Small pieces come by a window that is kept, large ones do not."""
    data = np.random.default_rng(6).bytes(200_000)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "file").write_bytes(data)
        with Source(Path(folder) / "file") as source:
            for offset, length in parts:
                assert source.read(offset, length) == data[offset : offset + length]
                assert source.read(offset, length % 99) == data[offset : offset + length % 99]
            assert source.checksum(7, 190_000) == zlib.crc32(data[7:190_000])


@pytest.mark.filterwarnings("ignore::trainlog.mcap.DamageWarning")
@settings(max_examples=25)
@given(drawn=st.data())
def test_forged_lengths_and_cuts_cost_rows_and_change_none(trip, data, tmp_path, drawn):
    """A record whose length is any number, in a log that ends at any byte."""
    record = drawn.draw(st.sampled_from(records_of(data)))
    forged = bytearray(data)
    length = drawn.draw(st.integers(0, 2**64 - 1) | st.integers(0, len(data)))
    struct.pack_into("<Q", forged, record.start + 1, length)
    path = tmp_path / "forged.mcap"
    path.write_bytes(forged[: drawn.draw(st.just(len(data)) | st.integers(0, len(data)))])
    try:
        found, named = read_log(path).topics, path
    except LogError as error:
        found, named = {}, error.file
    assert named == path
    for name, frame in found.items():
        assert frame.equals(trip[name].loc[frame.index, list(frame)])
