"""Every file of MCAP's conformance suite is valid: nothing is called damaged, nothing is missed."""

from __future__ import annotations

import warnings
from io import BytesIO
from pathlib import Path

import pytest
from mcap.records import Attachment, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap_conformance import INPUTS, generated, variants
from mcap_judge import messages_in

from trainlog.mcap import account_of, describe, frames_of, recover
from trainlog.mcap.contents import contents_of, scanned
from trainlog.mcap.records import Source, attachment_at


def test_the_suite_has_all_its_files() -> None:
    """As many as the published suite, each read by the official reader."""
    names = [name for name, _, _ in variants()]
    assert len(names) == len(set(names)) == 416
    for name, records, features in variants():
        stream = BytesIO(generated(records, features))
        found = list(StreamReader(stream, validate_crcs=True).records)
        messages = [each for each in found if isinstance(each, Message)]
        assert messages == [each for each in records if isinstance(each, Message)], name


@pytest.mark.parametrize("base", INPUTS)
def test_valid_files_are_whole_and_give_all_they_hold(base: str, tmp_path: Path) -> None:
    path = tmp_path / "file.mcap"
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


def assert_holds(source: Source, contents, records: list[McapRecord]) -> None:
    """The contents of a file are these records."""
    messages = sorted((m.log_time, m.data) for m in records if isinstance(m, Message))
    found = messages_in(source, contents)
    assert sorted((time, data) for _, time, data in found.elements()) == messages
    assert contents.metadata == [each for each in records if isinstance(each, Metadata)]
    written = [each for each in records if isinstance(each, Attachment)]
    assert [attachment_at(source, at) for at, _ in contents.attachments] == written


@pytest.mark.parametrize("base", INPUTS)
def test_recovered_files_hold_the_same(base: str, tmp_path: Path) -> None:
    path, again = tmp_path / "file.mcap", tmp_path / "again.mcap"
    for name, records, features in variants():
        if name.split("-")[0] != base or "pad" not in features:
            continue
        path.write_bytes(generated(records, features))
        assert recover(path, again).whole
        with Source(again) as source:
            contents = scanned(source)
            contents.metadata = [each for each in contents.metadata if "trainlog" not in each.name]
            assert_holds(source, contents, records)


def test_a_message_index_need_not_follow_its_chunk(tmp_path: Path) -> None:
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
