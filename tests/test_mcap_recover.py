"""A damaged log is accounted for to the byte, and rebuilt with everything that is readable."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tracemalloc
from collections import Counter
from io import BytesIO
from pathlib import Path
from random import Random

import pytest
from mcap.reader import SeekingReader
from mcap.writer import CompressionType
from mcap_judge import Specimen, foreign, messages_in, specimen, specimens, time_limit
from mcap_mutations import CHUNK, MESSAGE, chunk_bytes, records_of
from mcap_trips import assert_same, trip_of
from refusals import refused
from rerun.chunk import McapReader

import trainlog
from trainlog.errors import InputError, LogError
from trainlog.mcap import Account, DamageWarning, account_of, describe, read_log, recover, write_log
from trainlog.mcap.contents import scanned
from trainlog.mcap.records import RECOVERY_RECORD, Loss, Source, Unfinished
from trainlog.topics import EVENTS, TRAIN_STATE


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Specimen:
    """A log of 120 messages in three chunks."""
    return specimens(tmp_path_factory.mktemp("whole"))[0]


def put(tmp_path: Path, data: bytes) -> Path:
    (tmp_path / "damaged.mcap").write_bytes(data)
    return tmp_path / "damaged.mcap"


def chunk_groups(data: bytes) -> list[tuple[int, int]]:
    """Each chunk's first byte, and the byte behind it."""
    return [(each.start, each.end) for each in records_of(data) if each.opcode == CHUNK]


# ---------------------------------------------------------------------------------- the account


def assert_cuts(one: Specimen, path: Path, step: int = 1) -> None:
    """Cut at every `step`-th byte: all messages of every complete chunk, and one account."""
    ends = [record.end for record in records_of(one.data) if record.opcode in (CHUNK, MESSAGE)]
    counts = [messages.total() for _, messages in one.groups] or [1] * len(ends)
    path.write_bytes(one.data)
    with path.open("r+b") as file:
        for length in range(len(one.data) - 1, 7, -step):
            file.truncate(length)
            account = account_of(path)
            expected = sum(count for count, end in zip(counts, ends, strict=True) if end <= length)
            undeclared = [loss for loss in account.losses if "nowhere declared" in loss.reason]
            assert account.messages + sum(loss.messages or 0 for loss in undeclared) == expected
            assert not (undeclared and one.trip)
            assert not account.whole
            assert account.losses[-1].end == length


def test_a_log_cut_anywhere_gives_its_whole_chunks(tmp_path: Path) -> None:
    trip = trip_of(rows=30, topics=[TRAIN_STATE.name])
    frame = trip[TRAIN_STATE.name]
    frame.index = frame.index[0] + (frame.index - frame.index[0]) * 60
    trip.attachments.clear()
    write_log(trip, tmp_path / "small.mcap")
    small = specimen("small", (tmp_path / "small.mcap").read_bytes(), trip)
    assert len(small.groups) == 3
    assert_cuts(small, tmp_path / "cut.mcap", step=3)
    for length in range(8):
        (tmp_path / "cut.mcap").write_bytes(small.data[:length])
        refused(LogError, "", account_of, tmp_path / "cut.mcap")


@pytest.mark.parametrize("number", [0, 3, 5])
def test_logs_cut_here_and_there(number: int, tmp_path: Path) -> None:
    """Of trainlog, of another program with its schemas in the chunks, and without chunks."""
    assert_cuts(specimens(tmp_path)[number], tmp_path / "cut.mcap", step=29)


@pytest.mark.long
@pytest.mark.parametrize("number", range(6))
def test_all_logs_cut_at_every_byte(number: int, tmp_path: Path) -> None:
    assert_cuts(specimens(tmp_path)[number], tmp_path / "cut.mcap")


def test_what_is_lost_is_stated_by_topic(whole: Specimen, tmp_path: Path) -> None:
    """Each of the three chunks holds a third of both topics."""
    start, end = chunk_groups(whole.data)[1]
    data = whole.data[:start] + bytes(end - start) + whole.data[end:]
    account = account_of(put(tmp_path, data))
    assert account.topics == ((EVENTS.name, 20, 60), (TRAIN_STATE.name, 20, 60))
    assert f"lost of {EVENTS.name}: 20 of 60 messages (33.3%)" in account.lines()
    assert {"topic": TRAIN_STATE.name, "lost": 20, "of": 60} in account.details()["lost_by_topic"]
    assert account_of(put(tmp_path, whole.data)).topics == ()


def test_random_byte_flips_are_accounted_for_to_the_message(tmp_path: Path) -> None:
    """200 flips: what comes back was written, and the account knows how many messages do not."""
    accounted = 0
    for number, one in enumerate(specimens(tmp_path)):
        if not one.groups:
            continue
        random = Random(number)
        for _ in range(40):
            data = bytearray(one.data)
            data[random.randrange(len(data))] ^= random.randrange(1, 256)
            path = put(tmp_path, bytes(data))
            with Source(path) as source:
                contents = scanned(source)
                found = Counter(message[1:] for message in messages_in(source, contents).elements())
            account = contents.account
            assert not account.whole
            assert found <= Counter(message[1:] for message in one.messages.elements())
            assert account.messages == found.total()
            assert account.messages_lost == one.messages.total() - found.total()
            accounted += 1
    assert accounted == 200


def test_a_flipped_byte_of_a_log_without_chunks_is_reported(tmp_path: Path) -> None:
    """Messages outside of chunks have no checksum of their own: which one it is, nothing says."""
    one = specimens(tmp_path)[5]
    random = Random(5)
    for _ in range(84):
        data = bytearray(one.data)
        data[random.randrange(len(data))] ^= random.randrange(1, 256)
        assert not account_of(put(tmp_path, bytes(data))).whole


def test_statistics_count_what_is_lost_with_its_chunks(whole: Specimen, tmp_path: Path) -> None:
    """Two chunks and their indexes are gone, and the summary's offsets are wrong."""
    groups = chunk_groups(whole.data)
    account = account_of(put(tmp_path, whole.data[: groups[0][0]] + whole.data[groups[2][0] :]))
    assert (account.messages, account.messages_lost, account.expected) == (40, 80, 120)
    assert "80 messages are lost" in account.sentence


def test_a_chunk_that_comes_twice_is_counted_once(whole: Specimen, tmp_path: Path) -> None:
    start, end = chunk_groups(whole.data)[1]
    path = put(tmp_path, whole.data[:end] + whole.data[start:])
    account = account_of(path)
    assert (account.messages, account.messages_lost) == (120, 0)
    assert any("comes again" in loss.reason for loss in account.losses)


def test_a_file_joined_to_itself_is_read_once(whole: Specimen, tmp_path: Path) -> None:
    with pytest.warns(DamageWarning) as caught:
        trip = read_log(put(tmp_path, whole.data + whole.data))
    assert whole.trip is not None
    assert_same(whole.trip, trip)
    assert caught[0].message.account.messages == 120


def test_two_trips_joined_are_not_read_as_one(whole: Specimen, tmp_path: Path) -> None:
    """Channel numbers of the other file mean other topics: its messages are not taken for these."""
    other = trip_of(rows=20, topics=[EVENTS.name])
    write_log(other, tmp_path / "other.mcap")
    data = (tmp_path / "other.mcap").read_bytes() + whole.data
    account = account_of(put(tmp_path, data))
    assert account.messages == 120
    assert account.messages_lost == 20
    assert any("declared otherwise elsewhere" in loss.reason for loss in account.losses)


def test_lost_channels_come_from_the_summary(whole: Specimen, tmp_path: Path) -> None:
    records = records_of(whole.data)
    first = next(each for each in records if each.opcode == 0x04)
    data = whole.data[: first.start] + bytes(first.end - first.start) + whole.data[first.end :]
    with pytest.warns(DamageWarning):
        trip = read_log(put(tmp_path, data))
    assert whole.trip is not None
    assert_same(whole.trip, trip)


def test_a_recording_that_was_not_closed(tmp_path: Path) -> None:
    """The account has the last sample, and the most that can be missing."""
    path = tmp_path / "live.mcap"
    with trainlog.record(path, flush=0.5) as log:
        for row in range(30):
            log.write(TRAIN_STATE.name, 10**18 + row * 10**8, speed=1.0 * row)
    end = chunk_groups(path.read_bytes())[-1][1]
    cut = put(tmp_path, path.read_bytes()[:end])
    account = account_of(cut)
    assert account.unfinished == Unfinished(10**18 + 29 * 10**8, 0.5)
    assert "at most 0.5 s after it are missing" in account.sentence
    with pytest.warns(DamageWarning, match="last sample is of 2001-09-09 01:46:42.900 UTC"):
        read_log(cut)
    recover(cut, tmp_path / "again.mcap")
    assert account_of(tmp_path / "again.mcap").whole
    assert account_of(path).unfinished is None


# --------------------------------------------------------------------------------- bounded effort


@pytest.mark.parametrize("compression", [pytest.param("", marks=pytest.mark.long), "zstd"])
def test_chunks_inside_of_each_other_take_bounded_time(compression: str, tmp_path: Path) -> None:
    """Each claims everything that follows; to try them all would take hours."""
    size = 4_000_000
    head = len(chunk_bytes(compression, b"", 0, 1, bytes(16)))
    data = bytearray(b"\x89MCAP0\r\n")
    while len(data) + head <= size:
        stored = size - len(data) - head
        data += chunk_bytes(compression, b"", stored, 1, bytes(16))[: head - 8]
        data += stored.to_bytes(8, "little")
    for at in range(8, size - head, head):
        data[at + 1 : at + 9] = (size - at - 9).to_bytes(8, "little")
    with time_limit(60):
        assert account_of(put(tmp_path, bytes(data[:size]))).messages == 0


def test_nonsense_takes_bounded_time(tmp_path: Path) -> None:
    head = b"\x89MCAP0\r\n"
    for unit in (b"\x05\x16" + bytes(7), b"\x0c\x08" + bytes(15), b"\x06" + bytes(8), bytes(9)):
        data = head + b"\x00" + unit * (500_000 // len(unit)) + head
        with time_limit(60):
            account_of(put(tmp_path, data))


def test_recovery_of_a_large_log_stays_small_in_memory(tmp_path: Path) -> None:
    """Neither the file nor its messages are held: a chunk at a time is."""
    path = tmp_path / "large.mcap"
    write_log(trip_of(rows=40_000, topics=[TRAIN_STATE.name]), path)
    data = path.read_bytes()
    start, end = chunk_groups(data)[1]
    path.write_bytes(data[:start] + bytes(end - start) + data[end:] + data[len(data) // 2 :])
    del data
    tracemalloc.start()
    recover(path, tmp_path / "again.mcap")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20e6


# ---------------------------------------------------------------------------------------- recovery


def official(path: Path) -> list[tuple[str, int, int, bytes]]:
    """All messages, by the official reader with its checks."""
    reader = SeekingReader(BytesIO(path.read_bytes()), validate_crcs=True)
    return [
        (channel.topic, message.log_time, message.sequence, message.data)
        for _, channel, message in reader.iter_messages()
    ]


def test_a_recovered_log_opens_everywhere(whole: Specimen, tmp_path: Path) -> None:
    start, end = chunk_groups(whole.data)[1]
    cut = whole.data[: start + 50] + bytes(end - start - 60) + whole.data[end - 10 : -30]
    path, output = put(tmp_path, cut), tmp_path / "again.mcap"
    account = recover(path, output)
    assert account == account_of(path)
    assert (account.messages, account.messages_lost) == (80, 40)
    assert len(official(output)) == 80
    assert read_log(output).metadata == whole.trip.metadata  # no warning
    assert describe(output).count == 80
    rows = sum(chunk.to_record_batch().num_rows for chunk in McapReader(output).stream())
    assert rows > 0
    checked = subprocess.run(
        [shutil.which("rerun", path=Path(sys.executable).parent), "mcap", "check", output],
        capture_output=True,
        env={**os.environ, "NO_COLOR": "1"},
        check=False,
    )
    assert checked.returncode == 0, checked.stderr


def test_the_account_stays_with_the_recovered_log(whole: Specimen, tmp_path: Path) -> None:
    path = put(tmp_path, whole.data[:-100])
    account = recover(path, tmp_path / "once.mcap")
    recover(tmp_path / "once.mcap", tmp_path / "twice.mcap")
    with Source(tmp_path / "twice.mcap") as source:
        metadata = {each.name: each.metadata for each in scanned(source).metadata}
    steps = {key: json.loads(text) for key, text in metadata[RECOVERY_RECORD].items()}
    assert list(steps) == ["0001", "0002"]
    assert steps["0001"]["account"] == json.loads(json.dumps(account.details()))
    assert steps["0001"]["file"] == "damaged.mcap"
    assert steps["0002"]["account"]["losses"] == []


@pytest.mark.parametrize("number", range(6))
def test_a_whole_log_stays_as_it_is(number: int, tmp_path: Path) -> None:
    one = specimens(tmp_path)[number]
    path, output = put(tmp_path, one.data), tmp_path / "again.mcap"
    assert recover(path, output).whole
    assert official(output) == official(path)
    assert account_of(output).whole
    if one.trip is not None:
        assert_same(one.trip, read_log(output))


def test_intact_chunks_are_copied_as_they_are_stored(whole: Specimen, tmp_path: Path) -> None:
    recover(put(tmp_path, whole.data[:-10]), tmp_path / "again.mcap")
    recovered = (tmp_path / "again.mcap").read_bytes()
    for start, end in chunk_groups(whole.data):
        assert whole.data[start:end] in recovered


def test_other_programs_logs_are_recovered_with_profile_and_attachments(tmp_path: Path) -> None:
    one = specimen("lz4", foreign(CompressionType.LZ4))
    # The declarations stand in the first chunk and in the summary; the cut takes the latter.
    recover(put(tmp_path, one.data[:-500]), tmp_path / "again.mcap")
    reader = SeekingReader(BytesIO((tmp_path / "again.mcap").read_bytes()), validate_crcs=True)
    assert reader.get_header().profile == "other"
    assert [each.name for each in reader.iter_attachments()] == ["notes.txt"]
    assert {each.name for each in reader.iter_metadata()} == {"about", RECOVERY_RECORD}
    assert len(official(tmp_path / "again.mcap")) == 60


def test_messages_of_undeclared_channels_are_left_out_and_counted(tmp_path: Path) -> None:
    one = specimen("zstd", foreign(CompressionType.ZSTD))
    start, end = chunk_groups(one.data)[0]
    # Without the first chunk and the summary nothing declares the channels.
    data = one.data[:start] + one.data[end : one.data.index(b"jsonschema") - 40]
    path = put(tmp_path, data)
    account = account_of(path)
    assert account.messages == 0
    assert sum(loss.messages or 0 for loss in account.losses) >= 49


def test_the_input_is_never_overwritten(whole: Specimen, tmp_path: Path) -> None:
    path = put(tmp_path, whole.data[:-10])
    (tmp_path / "link.mcap").symlink_to(path)
    for output in (path, tmp_path / "link.mcap"):
        refused(InputError, "would be overwritten", recover, path, output)
    assert path.read_bytes() == whole.data[:-10]


def test_what_cannot_be_recovered_is_refused(tmp_path: Path) -> None:
    for data in (b"", b"time,speed\n1,2\n", b"\x89MCAP0\r\n" + bytes(100)):
        refused(LogError, "", recover, put(tmp_path, data), tmp_path / "again.mcap")
        assert not (tmp_path / "again.mcap").exists()


def test_what_is_recovered_can_be_read(whole: Specimen, tmp_path: Path) -> None:
    """Text of the provenance is zeroed: the step is left out, and the rest is a log."""
    at = whole.data.index(b'"step": "fit"')
    data = whole.data[:at] + bytes(10) + whole.data[at + 10 :]
    path = put(tmp_path, data)
    with pytest.warns(DamageWarning):
        damaged = read_log(path)
    recover(path, tmp_path / "again.mcap")
    again = read_log(tmp_path / "again.mcap")
    assert [step["step"] for step in again.provenance][:1] == ["simulate"]
    assert "fit" not in [step["step"] for step in again.provenance]
    assert sum(map(len, again.topics.values())) == sum(map(len, damaged.topics.values())) == 120


def test_what_could_not_be_read_is_not_written(whole: Specimen, tmp_path: Path) -> None:
    """All copies of a channel declare a unit that the table of topics does not have."""
    data = whole.data[:-100].replace(b"m/s^2", b"m/s^3")
    with pytest.raises(LogError, match="what is readable of it makes no log") as caught:
        recover(put(tmp_path, data), tmp_path / "again.mcap")
    assert caught.value.file == tmp_path / "damaged.mcap"
    assert not (tmp_path / "again.mcap").exists()


# --------------------------------------------------------------------------------- command line


def test_a_recording_that_lacks_only_its_end_is_not_called_damaged() -> None:
    lacking = Account(30, 1, (Loss(900, 900, "the end is missing", 0),), Unfinished(None, 0.5))
    assert lacking.sentence == "was not closed: 30 messages are readable; at most 0.5 s are missing"
    torn = Account(1, 1, (Loss(899, 900, "cut", None),), Unfinished(None, 0.5))
    assert torn.sentence.startswith("is damaged: 1 message is readable, 1 byte is lost")
