"""Files appear whole or not at all, and say where they cannot be read."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from contents import put
from refusals import refused

import trainlog
from trainlog.errors import InputError
from trainlog.formats.declared import parse_toml
from trainlog.formats.files import (
    atomic_write,
    output_folder,
    parse_json,
    read_bytes,
    read_json,
    sha256,
    sha256_of,
    write_bytes,
)


def write_half(target: Path, failure: BaseException) -> None:
    with atomic_write(target) as temporary:
        temporary.write_bytes(b"half")
        raise failure


def test_a_written_file_replaces_the_old_one_and_leaves_nothing_else(tmp_path):
    target = put(tmp_path / "a.json", b"old")
    with atomic_write(target) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".json"
        temporary.write_bytes(b"new")
        assert target.read_bytes() == b"old"
    assert target.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_failure_leaves_the_old_file_and_no_other(tmp_path, failure):
    target = put(tmp_path / "a.json", b"old")
    refused(failure, "", write_half, target, failure())
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_new_files_get_the_usual_permissions(tmp_path):
    (tmp_path / "plain").touch()
    write_bytes(tmp_path / "written", b"x")
    assert (tmp_path / "written").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_link_keeps_pointing_where_it_did(tmp_path):
    (tmp_path / "real.json").write_bytes(b"old")
    link = tmp_path / "link.json"
    try:
        link.symlink_to(tmp_path / "real.json")
    except OSError:
        pytest.skip("this system grants no links")
    write_bytes(link, b"new")
    assert link.is_symlink()
    assert (tmp_path / "real.json").read_bytes() == b"new"


def test_a_missing_folder_is_named_with_its_remedy(tmp_path):
    with pytest.raises(InputError, match="its folder does not exist; create its folder first"):
        write_bytes(tmp_path / "no" / "a.json", b"x")


def test_a_folder_or_device_is_not_written_over(tmp_path):
    with pytest.raises(InputError, match="exists and is not a file; choose another name"):
        write_bytes(tmp_path, b"x")
    refused(InputError, "exists and is not a file", write_bytes, os.devnull, b"x")


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.ENOSPC, "cannot be written: no space left on device; free some space"),
        (errno.EROFS, "cannot be written: read-only file system; choose a folder you may write"),
    ],
)
def test_a_full_disk_is_reported_and_leaves_nothing(tmp_path, number, message):
    with pytest.raises(InputError, match=message):
        write_half(tmp_path / "a.json", OSError(number, os.strerror(number)))
    assert list(tmp_path.iterdir()) == []


def test_an_error_about_another_file_is_not_taken_for_one_about_the_target(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "a.json"):
        (tmp_path / "input.csv").read_bytes()
    assert list(tmp_path.iterdir()) == []


def test_sha256_of_a_known_text(tmp_path):
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert sha256(b"abc") == known
    (tmp_path / "abc").write_bytes(b"abc")
    assert sha256_of(tmp_path / "abc") == known


def test_files_that_cannot_be_read_are_named(tmp_path):
    for read in (read_bytes, read_json, sha256_of):
        with pytest.raises(InputError, match=r"gone\.json: does not exist; check the path"):
            read(tmp_path / "gone.json")
        refused(InputError, ": is a folder; name a file in it", read, tmp_path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "a.json: is empty; expected JSON"),
        (b" \n", "a.json: is empty; expected JSON"),
        (b'{"a": [1, 2', "a.json, line 1, column 12: the file ends in the middle: truncated?"),
        (b'{"a": 1,\n "b": "cut he', "a.json, line 2, column 7: the file ends in the middle: trun"),
        (b'{"a": tru', "a.json, line 1, column 7: the file ends in the middle: truncated?; copy"),
        (b'{"a": 1.', "a.json, line 1, column 8: the file ends in the middle: truncated?; copy"),
        (b'{"a": "caf\xc3', "a.json, byte 10: the file ends in the middle: truncated?; copy the"),
        (b'{"a": 1,\n "b": }', "a.json, line 2, column 7: is not JSON: Expecting value"),
        (b'{"a": 1}\n{', "a.json, line 2, column 1: is not JSON: Extra data"),
        (b'{"a": "caf\xe9"}', "a.json, byte 10: is not UTF-8 text"),
        (b"\x89MCAP0\r\n\x01", "a.json, byte 0: is not JSON but a log (MCAP); expected JSON"),
        (b"PAR1\x15\x04\xff", "a.json, byte 6: is not JSON but a Parquet file; expected JSON"),
        (b'{"a": "NaN",\n "b": NaN}', "a.json, line 2, column 7: NaN is not a JSON number"),
        (b"[1, -Infinity]", "a.json, line 1, column 5: -Infinity is not a JSON number"),
        (b'{"a": 1, "b": 2, "a": 3}', "a.json, a: comes twice in one object; remove one of them"),
        (b"[" * 200_000, "a.json: is nested too deeply"),
        (b'{"mass": ' + b"9" * 6_000 + b"}", "a.json: holds a number of thousands of digits"),
    ],
)
def test_text_that_is_not_json_is_refused_with_its_place(data, message):
    caught = refused(InputError, "", parse_json, data, file="a.json")
    assert str(caught).startswith(message)
    assert "\n" not in str(caught)


def test_a_folder_for_results_is_made_only_for_results(tmp_path):
    with output_folder(tmp_path / "a" / "b"):
        pass
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError), output_folder(tmp_path / "a" / "b"):
        read_bytes(tmp_path / "gone")
    assert list(tmp_path.iterdir()) == []
    with output_folder(tmp_path / "a" / "b") as folder:
        (folder / "note.txt").write_text("x")
    assert (tmp_path / "a" / "b" / "note.txt").exists()
    (tmp_path / "empty").mkdir()
    with output_folder(tmp_path / "empty"):
        pass
    assert (tmp_path / "empty").is_dir(), "it was there before"


def test_a_folder_for_results_has_not_the_name_of_a_file(tmp_path):
    with (
        pytest.raises(InputError, match=r"trip\.mcap: is the name of a \.mcap file.*name a folder"),
        output_folder(tmp_path / "trip.mcap"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "trip.mcap").mkdir()
    with output_folder(tmp_path / "trip.mcap") as folder:
        assert folder.is_dir()


def test_a_byte_order_mark_is_no_mistake():
    assert parse_json(b'\xef\xbb\xbf{"a": 1}', file="a.json") == {"a": 1}


ALIKE = ("Line", "Journey", "Train", "Consist", "Trajectory")
WRITERS = {f"write_{kind.lower()}": kind for kind in ALIKE} | {
    "write": "Trip", "write_parquet": "Trip", "write_map": "TrackConditionMap",
    "write_parameters": "ParameterSet",
}  # fmt: skip


@pytest.mark.parametrize(("name", "kind"), WRITERS.items())
def test_what_a_file_cannot_hold_is_named(name, kind, tmp_path):
    write, path = getattr(trainlog, name), tmp_path / "file"
    remedy = f"was given where a {kind} is expected; give the {kind} first, then the path"
    refused(InputError, rf"3 \(int\) {remedy}", write, 3, path)
    refused(InputError, rf"^'a.mcap' \(str\) {remedy}", write, "a.mcap", path)
    refused(InputError, rf"^a list {remedy}", write, [], path)
    assert not path.exists()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"x = " + b"[" * 5_000 + b"]" * 5_000, "a.toml: is nested too deeply; expected TOML"),
        (b"x = " + b"9" * 6_000, "a.toml: holds a number of thousands of digits; expected TOML"),
    ],
)
def test_toml_that_its_parser_gives_up_is_refused(data, message):
    assert str(refused(InputError, "", parse_toml, data, file="a.toml")).startswith(message)
