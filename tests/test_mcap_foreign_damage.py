"""Damaged files of other programs: what is readable comes, the rest is listed."""

import struct
import tempfile
import warnings
from pathlib import Path

import pytest
from foreign_logs import COVARIANCE, FIX_1, FIX_2, ForeignLog, cdr, json_log
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from hypothesis import given, settings, strategies as st
from mcap_mutations import mutated
from mcap_protobuf.schema import build_file_descriptor_set

from trainlog.errors import LogError
from trainlog.mcap import frames_of
from trainlog.mcap.records import DamageWarning


def test_of_a_damaged_file_what_is_readable_comes(tmp_path):
    path = json_log(tmp_path / "json.mcap", "/things", [{"x": row} for row in range(30_000)])
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.warns(DamageWarning) as caught:
        found = frames_of(path)
    rows = len(found.frames["/things"])
    assert 0 < rows < 30_000
    assert found.frames["/things"]["x"].tolist() == list(range(rows))
    assert caught[0].message.account.messages == rows


def every_encoding(path):
    """A file with messages of every encoding, in several chunks."""
    log = ForeignLog(path)
    fix = struct.pack("<IIII4sbH3d9dB", 1, 2, 3, 4, b"gnss", 0, 1, 47.0, 8.0, 1.0, *COVARIANCE, 2)
    ros1 = ("sensor_msgs/NavSatFix", "ros1msg", FIX_1.encode())
    log.add(log.channel("/ros1", "ros1", ros1), [fix] * 30)
    ros2 = ("p/msg/Pair", "ros2msg", b"float64 x\nstring[] y")
    words = struct.pack("<dII2s", 1.0, 1, 2, b"a\0")
    log.add(log.channel("/ros2", "cdr", ros2), [cdr(words)] * 30)
    descriptors = build_file_descriptor_set(LocationFix).SerializeToString()
    protobuf = ("foxglove.LocationFix", "protobuf", descriptors)
    position = LocationFix(latitude=47.0, position_covariance=COVARIANCE).SerializeToString()
    log.add(log.channel("/protobuf", "protobuf", protobuf), [position] * 30)
    log.add(log.channel("/json", "json"), [b'{"a": [{"b": 1}, {"b": "c"}]}'] * 30)
    return log.close().read_bytes()


@pytest.mark.parametrize("seeds", [48, pytest.param(20_000, marks=pytest.mark.long)])
def test_mutated_files_raise_nothing_but_our_errors(tmp_path, seeds):
    whole, path = every_encoding(tmp_path / "all.mcap"), tmp_path / "mutated.mcap"
    outcomes = []
    for seed in range(seeds):
        kind, data = mutated(whole, seed)
        path.write_bytes(data)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                found = frames_of(path)
            except LogError:
                continue
            except BaseException as error:
                raise AssertionError(f"seed {seed} ({kind})") from error
        assert all(item.category is DamageWarning for item in caught), (seed, kind)
        outcomes.append(bool(caught or found.skipped or not found.account.whole))
        if not outcomes[-1] and data == whole:
            assert [len(frame) for frame in found.frames.values()] == [30] * 4
    assert sum(outcomes) > seeds // 4, "most are read in part, and this is stated"


@settings(max_examples=25)
@given(st.data())
def test_mutated_schemas_and_messages_cost_only_themselves(data):
    """Damage inside of messages and schemas, where no checksum of the file shows it."""
    descriptors = build_file_descriptor_set(LocationFix).SerializeToString()
    position = LocationFix(latitude=47.0, position_covariance=COVARIANCE).SerializeToString()
    kinds = {
        "ros1": ("ros1msg", FIX_1.encode(), bytes(120)),
        "cdr": ("ros2msg", FIX_2.encode(), cdr(bytes(130))),
        "protobuf": ("protobuf", descriptors, position),
    }
    encoding = data.draw(st.sampled_from(sorted(kinds)))
    schema_encoding, schema, message = kinds[encoding]

    def damage(content):
        at = data.draw(st.integers(0, len(content) - 1))
        change = data.draw(st.binary(max_size=4))
        return content[:at] + change + content[at + data.draw(st.integers(0, 4)) :]

    name = "foxglove.LocationFix" if encoding == "protobuf" else "sensor_msgs/NavSatFix"
    with tempfile.TemporaryDirectory() as folder:
        log = ForeignLog(Path(folder) / "odd.mcap")
        channel = log.channel("/x", encoding, (name, schema_encoding, damage(schema)))
        log.add(channel, [message, damage(message)])
        found = frames_of(log.close())
    rows = sum(len(frame) for frame in found.frames.values())
    assert rows + sum(item.messages for item in found.skipped if not item.field) == 2
