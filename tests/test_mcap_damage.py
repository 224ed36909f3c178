"""Damaged files give all that is readable with an account of the rest, or one `LogError`."""

from __future__ import annotations

import struct
import tempfile
import tracemalloc
import warnings
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings, strategies as st
from mcap.data_stream import RecordBuilder
from mcap.reader import SeekingReader
from mcap.records import Chunk
from mcap_trips import assert_same, trip_of
from refusals import refused

from trainlog.errors import LogError
from trainlog.mcap import Account, DamageWarning, account_of, describe, read_log, write_log
from trainlog.mcap.records import Source
from trainlog.topics import EVENTS, GNSS_FIX, TRAIN_AXLES, TRAIN_STATE
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


def read_with_account(path: Path) -> tuple[Trip, Account | None]:
    """The trip, and the account of what is lost if the user was warned."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        trip = read_log(path)
    accounts = [each.message.account for each in caught if isinstance(each.message, DamageWarning)]
    assert len(accounts) == len(caught) <= 1
    for account in accounts:
        assert not account.whole
        rows = sum(len(frame) for frame in trip.topics.values())
        if account.messages != rows:
            # A broken name makes a topic a foreign one, which is no part of the trip.
            foreign = [each for each in describe(path).topics if each.name not in trip.topics]
            rows += sum(each.count for each in foreign)
        assert account.messages == rows
        for loss in account.losses:
            assert 0 <= loss.start <= loss.end <= path.stat().st_size
            assert loss.reason.isprintable()
    return trip, accounts[0] if accounts else None


def small(tmp_path: Path) -> tuple[Trip, bytes]:
    trip = trip_of(rows=12, axles=2, topics=[TRAIN_STATE.name, GNSS_FIX.name, EVENTS.name])
    write_log(trip, tmp_path / "small.mcap")
    return trip, (tmp_path / "small.mcap").read_bytes()


def without_checksums(data: bytes) -> bytearray:
    """The same log as a writer without checksums would leave it."""
    stripped = bytearray(data)
    summary = SeekingReader(BytesIO(data)).get_summary()
    assert summary is not None
    for index in summary.chunk_indexes:
        struct.pack_into("<I", stripped, index.chunk_start_offset + 9 + 24, 0)
    footer = len(data) - 8 - 20
    (summary_start,) = struct.unpack_from("<Q", data, footer)
    struct.pack_into("<I", stripped, summary_start - 4, 0)
    struct.pack_into("<I", stripped, footer + 16, 0)
    return stripped


@pytest.mark.parametrize("claimed", [2**20, 2**29, 2**31, 2**62, 2**64 - 1])
def test_forged_chunk_sizes_do_not_exhaust_the_memory(
    claimed: int, data: bytes, tmp_path: Path
) -> None:
    summary = SeekingReader(BytesIO(data)).get_summary()
    assert summary is not None
    forged = without_checksums(data)
    for index in summary.chunk_indexes:
        struct.pack_into("<Q", forged, index.chunk_start_offset + 9 + 16, claimed)
    (tmp_path / "forged.mcap").write_bytes(forged)
    tracemalloc.start()
    refused(LogError, "no message of it is readable", read_log, tmp_path / "forged.mcap")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 50e6


def test_attachments_are_checked_on_their_own(tmp_path: Path) -> None:
    _, data = small(tmp_path)
    flipped = without_checksums(data)
    flipped[flipped.index(b'{"format": "trainlog/line"}')] ^= 1
    (tmp_path / "flipped.mcap").write_bytes(flipped)
    trip, account = read_with_account(tmp_path / "flipped.mcap")
    assert account is not None
    assert [loss.reason for loss in account.losses] == ["attachment 'line.json' fails its checksum"]
    assert "line.json" not in trip.attachments


def test_statistics_that_contradict_the_indexes_do_not_hide_messages(
    trip: Trip, data: bytes, tmp_path: Path
) -> None:
    """A message index that lists fewer messages than there are is not followed."""
    forged = without_checksums(data)
    at = forged.index(bytes([0x07]), 0)
    summary = SeekingReader(BytesIO(data)).get_summary()
    assert summary is not None
    at = summary.chunk_indexes[0].message_index_offsets[1]
    # The channel's index becomes a private record, which readers pass over.
    forged[at] = 0x87
    (tmp_path / "forged.mcap").write_bytes(forged)
    assert_same(trip, read_log(tmp_path / "forged.mcap"))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"time,speed\n1,2\n", "is not an MCAP file"),
        (b"time,speed\n1,2\n", "but text; 'trainlog ingest' makes logs of recordings"),
        ("Züge\n".encode()[:-4] + b"\xc3", "but text"),
        ("Züge;Größe km/h\n1;2\n".encode("cp1252") * 20, "but text; 'trainlog ingest' makes"),
        (b"PAR1\x15\x04", "but a Parquet file; 'trainlog convert FOLDER.parquet -o"),
        (b' {"format": "trainlog/line"', "but a trainlog/line file; give the logs"),
        (b"[1, 2]", "but a JSON file; 'trainlog ingest'"),
        (b"\x1f\x8b\x08\x00", "but compressed with gzip; unpack it"),
        (b"\x89MCAP", "not an MCAP file; expected a log"),
    ],
)
def test_files_that_are_no_log(content: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / "trip.mcap").write_bytes(content)
    for read in (read_log, describe):
        refused(LogError, said, read, tmp_path / "trip.mcap")


@pytest.mark.parametrize(
    ("conversion", "old", "new"),
    [("CRLF to LF", b"\r\n", b"\n"), ("LF to CRLF", b"\n", b"\r\n")],
)
def test_converted_line_ends_are_named(
    conversion: str, old: bytes, new: bytes, data: bytes, tmp_path: Path
) -> None:
    """As git or a transfer in text mode does it; no byte behind the first is where it was."""
    path = tmp_path / "trip.mcap"
    path.write_bytes(data.replace(old, new))
    for read in (read_log, describe, account_of):
        caught = refused(LogError, f"line ends were converted from {conversion}", read, path)
        assert "binary mode" in caught.remedy
        assert ".gitattributes" in caught.remedy


def test_an_index_that_leads_to_a_message_twice_is_not_followed(
    trip: Trip, data: bytes, tmp_path: Path
) -> None:
    """Reading a part does not verify the whole file: the chunk's own records are asked instead."""
    summary = SeekingReader(BytesIO(data)).get_summary()
    assert summary is not None
    for at in summary.chunk_indexes[0].message_index_offsets.values():
        forged = bytearray(data)
        # The second entry's offset becomes the first one's.
        forged[at + 15 + 24 : at + 15 + 32] = forged[at + 15 + 8 : at + 15 + 16]
        (tmp_path / "forged.mcap").write_bytes(forged)
        for topic, frame in trip.topics.items():
            part = read_log(tmp_path / "forged.mcap", topics=[topic])
            assert frame.equals(part[topic])


@settings(max_examples=20)
@given(st.lists(st.tuples(st.integers(0, 210_000), st.integers(0, 100_000)), max_size=12))
def test_any_part_of_a_file_is_read_as_it_stands(parts: list[tuple[int, int]]) -> None:
    """Small pieces come by a window that is kept, large ones do not."""
    data = np.random.default_rng(6).bytes(200_000)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "file").write_bytes(data)
        with Source(Path(folder) / "file") as source:
            for offset, length in parts:
                assert source.read(offset, length) == data[offset : offset + length]
                assert source.read(offset, length % 99) == data[offset : offset + length % 99]
            assert source.checksum(7, 190_000) == zlib.crc32(data[7:190_000])


TRIES = (30, pytest.param(500, marks=pytest.mark.long))
"""How often bytes of a log are changed."""


_T = TypeVar("_T")


def outcome(read: Callable[[Path], _T], path: Path) -> _T | LogError:
    """What reading gives: a result, or the one kind of error that it may raise, in one line."""
    try:
        return read(path)
    except LogError as error:
        found = error
    assert found.file == path
    assert found.remedy
    assert str(found).isprintable()
    return found


@pytest.mark.parametrize("count", TRIES)
def test_uncompressed_messages_with_broken_bytes(tmp_path: Path, count: int) -> None:
    """Damage inside a chunk that is not compressed reaches the message parsers."""
    _, data = small(tmp_path)
    start, end, content = only_chunk(data)
    plain = without_checksums(data)
    chunk = record(Chunk("", content, 0, 0, 0, len(content)))
    random = np.random.default_rng(5)
    path = tmp_path / "flipped.mcap"
    noticed = 0
    for _ in range(count):
        flipped = bytearray(chunk)
        flipped[random.integers(len(chunk) - len(content), len(chunk))] = random.integers(256)
        path.write_bytes(with_summary_moved(plain, start, end, bytes(flipped)))
        found = outcome(read_with_account, path)
        noticed += isinstance(found, LogError) or found[1] is not None
    assert noticed > count // 10


def only_chunk(data: bytes) -> tuple[int, int, bytes]:
    """Start, end and decompressed content of the chunk of a log that has one."""
    summary = SeekingReader(BytesIO(data)).get_summary()
    assert summary is not None
    (index,) = summary.chunk_indexes
    end = index.chunk_start_offset + index.chunk_length
    content = zstandard.decompress(data[end - index.compressed_size : end])
    return index.chunk_start_offset, end, content


def record(chunk: Chunk) -> bytes:
    builder = RecordBuilder()
    chunk.write(builder)
    return builder.end()


def with_summary_moved(data: bytes, start: int, end: int, chunk: bytes) -> bytes:
    """The file with another chunk in this place, its footer pointing right again."""
    moved = bytearray(data[:start] + chunk + data[end:])
    shift = len(chunk) - (end - start)
    footer = len(moved) - 8 - 20
    for at in (footer, footer + 8):
        (offset,) = struct.unpack_from("<Q", moved, at)
        struct.pack_into("<Q", moved, at, offset + shift)
    return bytes(moved)


CLAIMED = (0xFFFFFFFF, 0x7FFFFFFF, 0x00FFFFFF, 0)


@pytest.mark.parametrize("opcode", [0x03, 0x04, 0x06, 0x07, 0x09, 0x0B, 0x0C])
def test_forged_record_lengths(opcode: int, tmp_path: Path) -> None:
    """A length field of each kind of record claims more than there is."""
    _, data = small(tmp_path)
    at = 8
    while data[at] != opcode:
        (length,) = struct.unpack_from("<Q", data, at + 1)
        at += 9 + length
    (length,) = struct.unpack_from("<Q", data, at + 1)
    plain = without_checksums(data)
    for place in range(at + 1, at + 9 + min(length, 20) - 3):
        # Within the record one claim at each place, in turn; at its own length all of them.
        for claimed in CLAIMED if place < at + 9 else (CLAIMED[place % len(CLAIMED)],):
            forged = bytearray(plain)
            struct.pack_into("<I", forged, place, claimed)
            (tmp_path / "forged.mcap").write_bytes(forged)
            outcome(read_with_account, tmp_path / "forged.mcap")
