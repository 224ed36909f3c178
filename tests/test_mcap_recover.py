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
from mcap_mutations import CHANNEL, CHUNK, chunk_bytes, records_of
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


def spans_of(data: bytes, opcode: int = CHUNK) -> list[tuple[int, int]]:
    """Each record's first byte, and the byte behind it."""
    return [(each.start, each.end) for each in records_of(data) if each.opcode == opcode]


def zeroed(data: bytes, start: int, end: int) -> bytes:
    return data[:start] + bytes(end - start) + data[end:]


# ---------------------------------------------------------------------------------- the account


def test_what_is_lost_is_stated_by_topic(whole, tmp_path):
    """Each of the three chunks holds a third of both topics."""
    account = account_of(put(tmp_path, zeroed(whole.data, *spans_of(whole.data)[1])))
    assert account.topics == ((EVENTS.name, 20, 60), (TRAIN_STATE.name, 20, 60))
    assert f"lost of {EVENTS.name}: 20 of 60 messages (33.3%)" in account.lines()
    assert {"topic": TRAIN_STATE.name, "lost": 20, "of": 60} in account.details()["lost_by_topic"]
    assert account_of(put(tmp_path, whole.data)).topics == ()


@pytest.mark.parametrize("name", [b"acceleration", TRAIN_STATE.name.encode(), b"TrainState"])
@pytest.mark.parametrize("first", [True, False])
def test_of_two_copies_of_a_declaration_the_one_that_is_right_counts(name, first, whole, tmp_path):
    """Neither part of the file holds its checksum: each has lost something else as well."""
    data = bytearray(zeroed(whole.data, *spans_of(whole.data)[1]))
    data[-12] ^= 1  # of the summary's own checksum
    at = data.find(name) if first else data.rfind(name, 0, data.rfind(b"meaning."))
    data[at] ^= 2
    with pytest.warns(DamageWarning):
        trip = read_log(put(tmp_path, bytes(data)))
    written = whole.trip.topics[TRAIN_STATE.name]
    assert trip.topics[TRAIN_STATE.name].equals(written.drop(written.index[20:40]))


def test_random_byte_flips_are_accounted_for_to_the_message(tmp_path):
    """What comes back was written, and the account knows how many messages do not.

    Messages outside of chunks have no checksum of their own: which one it is, nothing says.
    """
    for number, one in enumerate(specimens(tmp_path)):
        random = Random(number)
        for _ in range(40):
            data = bytearray(one.data)
            data[random.randrange(len(data))] ^= random.randrange(1, 256)
            with Source(put(tmp_path, bytes(data))) as source:
                contents = scanned(source)
                found = Counter(message[1:] for message in messages_in(source, contents).elements())
            account = contents.account
            assert not account.whole
            if one.groups:
                assert found <= Counter(message[1:] for message in one.messages.elements())
                assert account.messages == found.total()
                assert account.messages_lost == one.messages.total() - found.total()


@pytest.mark.parametrize(
    ("damaged", "messages", "lost", "said"),
    [
        # Without two chunks, and with one twice.
        (
            lambda data, _: data[: spans_of(data)[0][0]] + data[spans_of(data)[2][0] :],
            *(40, 80, "80 messages are lost"),
        ),
        (
            lambda data, _: data[: spans_of(data)[1][1]] + data[spans_of(data)[1][0] :],
            *(120, 0, "comes again"),
        ),
        (lambda data, _: data + data, 120, 0, "one file ends here"),
        # Channel numbers of the other file mean other topics: its messages are not taken for these.
        (lambda data, other: other + data, 120, 20, "declared otherwise elsewhere"),
        # A channel that is lost comes from the summary.
        (lambda data, _: zeroed(data, *spans_of(data, CHANNEL)[0]), 120, 0, ""),
    ],
)
def test_what_is_there_twice_or_not_at_all_is_counted_once(
    damaged, messages, lost, said, whole, tmp_path
):
    write_log(trip_of(rows=20, topics=[EVENTS.name]), tmp_path / "other.mcap")
    path = put(tmp_path, damaged(whole.data, (tmp_path / "other.mcap").read_bytes()))
    account = account_of(path)
    assert (account.messages, account.messages_lost) == (messages, lost)
    assert said in " ".join([account.sentence, *account.lines()])
    if lost == 0:
        with pytest.warns(DamageWarning):
            assert_same(whole.trip, read_log(path))


def test_a_recording_that_was_not_closed(tmp_path):
    """The account has the last sample, and the most that can be missing."""
    path = tmp_path / "live.mcap"
    with trainlog.record(path, flush=0.5) as log:
        for row in range(30):
            log.write(TRAIN_STATE.name, 10**18 + row * 10**8, speed=1.0 * row)
    cut = put(tmp_path, path.read_bytes()[: spans_of(path.read_bytes())[-1][1]])
    account = account_of(cut)
    assert account.unfinished == Unfinished(10**18 + 29 * 10**8, 0.5)
    assert "at most 0.5 s after it are missing" in account.sentence
    with pytest.warns(DamageWarning, match=r"last sample is of 2001-09-09 01:46:42.900 UTC"):
        read_log(cut)
    recover(cut, tmp_path / "again.mcap")
    assert account_of(tmp_path / "again.mcap").whole
    assert account_of(path).unfinished is None
    lacking = Account(30, 1, (Loss(900, 900, "the end is missing", 0),), Unfinished(None, 0.5))
    assert lacking.sentence == "was not closed: 30 messages are readable; at most 0.5 s are missing"
    torn = Account(1, 1, (Loss(899, 900, "cut", None),), Unfinished(None, 0.5))
    assert torn.sentence.startswith("is damaged: 1 message is readable, 1 byte is lost")


# --------------------------------------------------------------------------------- bounded effort


def test_chunks_inside_of_each_other_take_bounded_time(tmp_path):
    """Each claims everything that follows; to try them all would take hours."""
    size = 4_000_000
    head = len(chunk_bytes("zstd", b"", 0, 1, bytes(16)))
    data = bytearray(b"\x89MCAP0\r\n")
    while len(data) + head <= size:
        stored = size - len(data) - head
        data += chunk_bytes("zstd", b"", stored, 1, bytes(16))[: head - 8]
        data += stored.to_bytes(8, "little")
    for at in range(8, size - head, head):
        data[at + 1 : at + 9] = (size - at - 9).to_bytes(8, "little")
    with time_limit(60):
        assert account_of(put(tmp_path, bytes(data[:size]))).messages == 0


def test_nonsense_takes_bounded_time(tmp_path):
    head = b"\x89MCAP0\r\n"
    for unit in (b"\x05\x16" + bytes(7), b"\x0c\x08" + bytes(15), b"\x06" + bytes(8), bytes(9)):
        data = head + b"\x00" + unit * (500_000 // len(unit)) + head
        with time_limit(60):
            account_of(put(tmp_path, data))


def test_recovery_of_a_large_log_stays_small_in_memory(tmp_path):
    """Neither the file nor its messages are held: a chunk at a time is."""
    path = tmp_path / "large.mcap"
    write_log(trip_of(rows=40_000, topics=[TRAIN_STATE.name]), path)
    data = path.read_bytes()
    path.write_bytes(zeroed(data, *spans_of(data)[1]) + data[len(data) // 2 :])
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


def test_a_recovered_log_opens_everywhere(whole, tmp_path):
    start, end = spans_of(whole.data)[1]
    path, output = put(tmp_path, zeroed(whole.data, start + 50, end - 10)[:-30]), tmp_path / "again"
    account = recover(path, output)
    assert account == account_of(path)
    assert (account.messages, account.messages_lost) == (80, 40)
    assert len(official(output)) == 80
    assert read_log(output).metadata == whole.trip.metadata  # no warning
    assert describe(output).count == 80
    for place in (spans_of(whole.data)[0], spans_of(whole.data)[2]):
        assert whole.data[slice(*place)] in output.read_bytes(), "copied as it is stored"
    assert sum(chunk.to_record_batch().num_rows for chunk in McapReader(output).stream()) > 0
    checked = subprocess.run(
        [shutil.which("rerun", path=Path(sys.executable).parent), "mcap", "check", output],
        capture_output=True,
        env={**os.environ, "NO_COLOR": "1"},
        check=False,
    )
    assert checked.returncode == 0, checked.stderr


def test_the_account_stays_with_the_recovered_log(whole, tmp_path):
    account = recover(put(tmp_path, whole.data[:-100]), tmp_path / "once.mcap")
    recover(tmp_path / "once.mcap", tmp_path / "twice.mcap")
    with Source(tmp_path / "twice.mcap") as source:
        metadata = {each.name: each.metadata for each in scanned(source).metadata}
    steps = {key: json.loads(text) for key, text in metadata[RECOVERY_RECORD].items()}
    assert list(steps) == ["0001", "0002"]
    assert steps["0001"]["account"] == json.loads(json.dumps(account.details()))
    assert steps["0001"]["file"] == "damaged.mcap"
    assert steps["0002"]["account"]["losses"] == []


def test_other_programs_logs_are_recovered_with_profile_and_attachments(tmp_path):
    one = specimen("lz4", foreign(CompressionType.LZ4))
    # The declarations stand in the first chunk and in the summary; the cut takes the latter.
    recover(put(tmp_path, one.data[:-500]), tmp_path / "again.mcap")
    reader = SeekingReader(BytesIO((tmp_path / "again.mcap").read_bytes()), validate_crcs=True)
    assert reader.get_header().profile == "other"
    assert [each.name for each in reader.iter_attachments()] == ["notes.txt"]
    assert {each.name for each in reader.iter_metadata()} == {"about", RECOVERY_RECORD}
    assert len(official(tmp_path / "again.mcap")) == 60


def test_what_cannot_be_recovered_is_refused_and_the_input_never_overwritten(whole, tmp_path):
    again = tmp_path / "again.mcap"
    # At last, all copies of a channel declare a unit that the table of topics does not have.
    other_unit = whole.data[:-100].replace(b"m/s^2", b"m/s^3")
    for data, said in (
        (b"", ""),
        (b"time,speed\n1,2\n", ""),
        (b"\x89MCAP0\r\n" + bytes(100), ""),
        (other_unit, "what is readable of it makes no log"),
    ):
        caught = refused(LogError, said, recover, put(tmp_path, data), again)
        assert caught.file == tmp_path / "damaged.mcap"
        assert not again.exists()
    path = put(tmp_path, whole.data[:-10])
    (tmp_path / "link.mcap").symlink_to(path)
    for output in (path, tmp_path / "link.mcap"):
        refused(InputError, "would be overwritten", recover, path, output)
    assert path.read_bytes() == whole.data[:-10]


def test_what_is_recovered_can_be_read(whole, tmp_path):
    """Text of the provenance is zeroed: the step is left out, and the rest is a log."""
    at = whole.data.index(b'"step": "fit"')
    path = put(tmp_path, zeroed(whole.data, at, at + 10))
    with pytest.warns(DamageWarning):
        damaged = read_log(path)
    recover(path, tmp_path / "again.mcap")
    again = read_log(tmp_path / "again.mcap")
    assert [step["step"] for step in again.provenance][:1] == ["simulate"]
    assert "fit" not in [step["step"] for step in again.provenance]
    assert sum(map(len, again.topics.values())) == sum(map(len, damaged.topics.values())) == 120
