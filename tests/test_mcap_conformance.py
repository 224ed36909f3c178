"""Every file of MCAP's conformance suite is valid: nothing is called damaged, nothing is missed.

The suite (https://github.com/foxglove/mcap, ``tests/conformance``) writes six small sets of records
in every combination of ten features of the format.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from io import BytesIO
from itertools import combinations

import pytest
from mcap import writer as official
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import CompressionType, IndexType, Writer
from mcap_judge import messages_in

from trainlog.mcap import account_of, describe, frames_of, recover
from trainlog.mcap.contents import Contents, contents_of, scanned
from trainlog.mcap.records import Source, attachment_at

FEATURES = ("ch", "mx", "st", "rsh", "rch", "ax", "mdx", "chx", "sum", "pad")
"""Chunks, message indexes, statistics, schemas and channels repeated in the summary, indexes of
attachments, metadata and chunks, summary offsets, records extended."""

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
            patch.setattr(official, "RecordBuilder", _Extended)
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
