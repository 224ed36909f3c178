"""Damage of every kind is accounted for to the byte; what is readable is rebuilt."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tracemalloc
import warnings
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import partial
from io import BytesIO
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path
from random import Random

import pytest
from mcap import writer as writers
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import CompressionType, IndexType, Writer
from mcap_judge import (
    Specimen,
    foreign,
    messages_in,
    most_memory,
    specimen,
    specimens,
    time_limit,
    verdict,
)
from mcap_mutations import CHANNEL, CHUNK, chunk_bytes, mutated, records_of
from mcap_trips import assert_same, trip_of
from refusals import refused
from rerun.chunk import McapReader

import trainlog
from trainlog import DamageWarning, InputError, LogError, describe, recover
from trainlog.mcap import Account, account_of, frames_of, read_log, write_log
from trainlog.mcap.contents import Contents, contents_of, scanned
from trainlog.mcap.records import RECOVERY_RECORD, Loss, Source, Unfinished, attachment_at
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
    text = " ".join(repr(describe(cut)).split())
    assert "was not closed: 30 messages are readable; its last sample is of 2001-09-09" in text
    assert "damaged" not in text.replace("damaged.mcap", "")
    assert (sum(each.count for each in describe(cut).topics), describe(cut).chunks) == (30, 1)
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


KEPT = Path(__file__).parent / "data" / "damaged"
"""Files that were once judged badly, judged again by every run."""
FLOOR = 64 * 2**20
"""So much memory more than before may be used for any small file [bytes]."""

REBUILT = 16
"""One file in so many is rebuilt and described as well."""


def judged(folder: Path, seeds: range) -> tuple[list[str], int]:
    """What is wrong with the files of these seeds, and the memory that they took [bytes]."""
    own = folder / str(os.getpid())
    own.mkdir(exist_ok=True)
    whole = specimens(own)
    wrong = [each for one in whole for each in verdict(one.data, one, own / "damaged.mcap")]
    before = most_memory()
    for seed in seeds:
        one = whole[seed % len(whole)]
        how, data = mutated(one.data, seed)
        found = verdict(data, one, own / "damaged.mcap", rebuild=seed % REBUILT == 0)
        wrong += [f"seed {seed}, {one.name}, {how}: {each}" for each in found]
    return wrong, most_memory() - before


def test_damaged_files(tmp_path):
    wrong, memory = judged(tmp_path, range(200))
    assert not wrong
    assert memory < FLOOR


UNKNOWABLE = ("seed 27007,",)
"""Damage made a message of an index behind the lost chunk: no checksum shows which it was."""


@pytest.mark.long
def test_a_hundred_thousand_damaged_files(tmp_path):
    """Each batch in a process that has made no other."""
    batches = [range(first, first + 500) for first in range(10_000, 110_000, 500)]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        results = list(pool.map(partial(judged, tmp_path), batches))
    wrong = [each for found, _ in results for each in found if not each.startswith(UNKNOWABLE)]
    assert wrong == []
    assert max(memory for _, memory in results) < FLOOR


@pytest.mark.parametrize("path", sorted(KEPT.glob("*.mcap")), ids=lambda path: path.stem)
def test_files_that_were_once_judged_badly(path, tmp_path):
    """Each gives the account that the list beside it holds, and is rebuilt."""
    expected = json.loads((KEPT / "accounts.json").read_text("utf-8"))[path.name]
    with time_limit(20):
        account = account_of(path)
        assert [account.messages, account.messages_lost, len(account.losses)] == expected
        with suppress(LogError), warnings.catch_warnings():
            warnings.simplefilter("ignore", DamageWarning)
            read_log(path)
        if not account.messages:
            return
        assert recover(path, tmp_path / "again.mcap") == account
    again = account_of(tmp_path / "again.mcap")
    assert again.whole
    assert again.messages == account.messages


FEATURES = ("ch", "mx", "st", "rsh", "rch", "ax", "mdx", "chx", "sum", "pad")
"""Of https://github.com/foxglove/mcap, ``tests/conformance``: chunks, message indexes, statistics,
schemas and channels repeated in the summary, indexes of attachments, metadata and chunks, summary
offsets, records extended."""

INDEXES = {"mx": IndexType.MESSAGE, "ax": IndexType.ATTACHMENT, "mdx": IndexType.METADATA,
           "chx": IndexType.CHUNK}  # fmt: skip
FIXED = (Opcode.MESSAGE, Opcode.CHUNK, Opcode.DATA_END, Opcode.FOOTER)
"""Records that are never extended."""

_SCHEMA = Schema(id=1, name="Example", encoding="c", data=bytes([4, 5, 6]))
_CHANNEL = Channel(1, "example", "a", {"foo": "bar"}, 1)
DATA, TIMES = bytes([1, 2, 3]), (0, 2, 1, 3, 3, 5, 4, 7, 8, 9)

INPUTS: dict[str, list[McapRecord]] = {
    "NoData": [],
    "OneSchemalessMessage": [Channel(1, "example", "text", {}, 0), Message(1, 2, DATA, 1, 10)],
    "OneMessage": [_SCHEMA, _CHANNEL, Message(1, 2, DATA, 1, 10)],
    "OneAttachment": [Attachment(1, 2, "myFile", "application/octet-stream", DATA)],
    "OneMetadata": [Metadata(metadata={"foo": "bar"}, name="myMetadata")],
    "TenMessages": [
        _SCHEMA,
        _CHANNEL,
        *(Message(1, at, DATA, at, row) for row, at in enumerate(TIMES)),
    ],
}


def variants() -> Iterator[tuple[str, list[McapRecord], frozenset[str]]]:
    """Name, records and features of every file of the suite."""
    for name, records in INPUTS.items():
        for count in range(len(FEATURES) + 1):
            for chosen in combinations(FEATURES, count):
                if _is_sensible(set(chosen), {type(record) for record in records}):
                    yield "-".join([name, *sorted(chosen)]), records, frozenset(chosen)


def _is_sensible(features: set[str], kinds: set[type]) -> bool:
    needs = {"ax": Attachment, "mdx": Metadata, "rsh": Schema, "rch": Channel}
    if any(feature in features and kind not in kinds for feature, kind in needs.items()):
        return False
    if not kinds & {Message, Channel, Schema} and features & {"ch", "chx", "mx"}:
        return False
    if "sum" in features and not features & {"chx", "rsh", "rch", "mdx", "ax", "st"}:
        return False
    return "ch" in features or not features & {"chx", "mx"}


class _Extended(RecordBuilder):
    """Adds what the suite adds to the end of each record that may be extended."""

    def start_record(self, opcode: Opcode) -> None:
        self._opcode = opcode
        super().start_record(opcode)

    def finish_record(self) -> None:
        if self._opcode not in FIXED:
            self.write(b"\x01\xff\xff")
        super().finish_record()


def generated(records: list[McapRecord], features: frozenset[str]) -> bytes:
    """The file of the suite with these records and features, by the official writer."""
    stream, indexes = BytesIO(), IndexType.NONE
    for feature in features & set(INDEXES):
        indexes |= INDEXES[feature]
    with pytest.MonkeyPatch.context() as patch:
        if "pad" in features:
            patch.setattr(writers, "RecordBuilder", _Extended)
        writer = Writer(
            stream, index_types=indexes, compression=CompressionType.NONE, enable_data_crcs=True,
            use_chunking="ch" in features, use_statistics="st" in features,
            use_summary_offsets="sum" in features, repeat_schemas="rsh" in features,
            repeat_channels="rch" in features,
        )  # fmt: skip
        writer.start(profile="", library="")
        for each in records:
            if isinstance(each, Schema):
                writer.register_schema(each.name, each.encoding, each.data)
            elif isinstance(each, Channel):
                named = each.topic, each.message_encoding, each.schema_id
                writer.register_channel(*named, each.metadata)
            elif isinstance(each, Message):
                times = each.publish_time, each.sequence
                writer.add_message(each.channel_id, each.log_time, each.data, *times)
            elif isinstance(each, Attachment):
                writer.add_attachment(
                    each.create_time, each.log_time, each.name, each.media_type, each.data
                )
            elif isinstance(each, Metadata):
                writer.add_metadata(each.name, each.metadata)
        writer.finish()
    return stream.getvalue()


def test_the_suite_has_as_many_files_as_the_published_one():
    names = [name for name, _, _ in variants()]
    assert len(names) == len(set(names)) == 416


@pytest.mark.parametrize("base", INPUTS)
def test_valid_files_are_whole_and_give_all_they_hold(base, tmp_path):
    path, again = tmp_path / "file.mcap", tmp_path / "again.mcap"
    for name, records, features in variants():
        if name.split("-")[0] != base:
            continue
        path.write_bytes(generated(records, features))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert account_of(path).whole, (name, account_of(path).lines())
            described = describe(path)
            assert described.complete, name
            frames = frames_of(path)
        messages = [each for each in records if isinstance(each, Message)]
        assert described.count == account_of(path).messages == len(messages), name
        assert sum(skipped.messages for skipped in frames.skipped) == len(messages), name
        with Source(path) as source:
            for contents in (contents_of(source), scanned(source)):
                assert_holds(source, contents, records)
        if "pad" in features:
            assert recover(path, again).whole
            with Source(again) as source:
                contents = scanned(source)
                contents.metadata = [m for m in contents.metadata if "trainlog" not in m.name]
                assert_holds(source, contents, records)


def assert_holds(source: Source, contents: Contents, records: list[McapRecord]) -> None:
    """The contents of a file are these records."""
    messages = sorted((m.log_time, m.data) for m in records if isinstance(m, Message))
    found = messages_in(source, contents)
    assert sorted((time, data) for _, time, data in found.elements()) == messages
    assert contents.metadata == [each for each in records if isinstance(each, Metadata)]
    written = [each for each in records if isinstance(each, Attachment)]
    assert [attachment_at(source, at) for at, _ in contents.attachments] == written


def test_a_message_index_need_not_follow_its_chunk(tmp_path):
    """A record of another program may stand between them."""
    records = INPUTS["TenMessages"]
    data = generated(records, frozenset({"ch", "mx"}))
    private = b"\x90" + (5).to_bytes(8, "little") + b"other"
    index = data.index(bytes([0x07]) + (6 + 160).to_bytes(8, "little"))
    end = data.index(bytes([0x0F]) + (4).to_bytes(8, "little"))
    # Without the checksum of the data section, which is that of the other file.
    parted = data[:index] + private + data[index:end] + data[end : end + 9] + bytes(4)
    (tmp_path / "file.mcap").write_bytes(parted + data[end + 13 :])
    with Source(tmp_path / "file.mcap") as source:
        contents = scanned(source)
        assert not contents.losses
        assert_holds(source, contents, records)
