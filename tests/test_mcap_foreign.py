"""Files of other programs become frames: every encoding, with known values, as far as it reads."""

import json
import struct
import tempfile
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from foreign_logs import COVARIANCE, FIX_1, FIX_2, START, ForeignLog, cdr, cdr_numbers, json_log
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from hypothesis import given, settings, strategies as st
from mcap.reader import make_reader
from mcap_mutations import mutated
from mcap_protobuf.schema import build_file_descriptor_set
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros1.decoder import DecoderFactory as Ros1DecoderFactory
from mcap_ros1.writer import Writer as Ros1Writer
from mcap_ros2.decoder import DecoderFactory
from refusals import refused

from trainlog.errors import InputError, LogError
from trainlog.mcap import frames_of
from trainlog.mcap.foreign import MOST_ELEMENTS
from trainlog.mcap.records import DamageWarning

SHARED = Path(__file__).parents[2] / "shared" / "data" / "foreign_mcap"


def test_ros1_messages_of_the_official_writer_become_columns(tmp_path):
    schema = SimpleNamespace(id=1, name="sensor_msgs/NavSatFix", encoding="ros1msg")
    schema.data = FIX_1.encode()
    factory = Ros1DecoderFactory()
    factory.decoder_for("ros1", schema)
    path = tmp_path / "ros1.mcap"
    with path.open("wb") as stream:
        writer = Ros1Writer(stream)
        for row in range(3):
            message = factory._types[1]()
            message.header.stamp.secs = 1_700_000_000 + row
            message.header.frame_id = "gnss" * row
            message.status.status, message.status.service = -1 if row == 2 else 0, 65_535
            message.latitude, message.longitude = 47.1 + row, -8.25
            message.position_covariance = COVARIANCE
            writer.write_message("/fix", message, START + row * 10**9)
        writer.finish()
    found = frames_of(path)
    frame = found.frames["/fix"]
    assert frame["latitude"].tolist() == [47.1, 48.1, 49.1]
    assert frame["longitude"].tolist() == [-8.25] * 3
    assert [frame[f"position_covariance[{at}]"].iloc[1] for at in range(9)] == COVARIANCE
    assert frame["header.frame_id"].tolist() == ["", "gnss", "gnssgnss"]
    assert frame["header.stamp.secs"].tolist() == [1_700_000_000, 1_700_000_001, 1_700_000_002]
    assert frame["status.status"].tolist() == [0, 0, -1]
    assert frame["status.service"].dtype == np.int64
    assert frame["status.service"].iloc[0] == 65_535
    assert frame.index.tolist() == [
        pd.Timestamp(START + row * 10**9, unit="ns", tz="UTC") for row in range(3)
    ]
    assert found.skipped == ()


def test_flatbuffers_messages_are_listed_with_the_reason():
    found = frames_of(Path(__file__).parent / "data" / "foxglove_flatbuffer.mcap")
    assert found.frames == {}
    reason = "encoding 'flatbuffer' is not decoded (3 messages)"
    listed = {f"/{name}: {reason}" for name in ("fix", "log", "scan", "cloud")}
    assert {str(item) for item in found.skipped} == listed


def test_json_messages_become_columns_of_their_kinds(tmp_path):
    messages = [
        {"v": 1, "on": True, "name": "a", "at": {"km": 1.5}, "big": 2**63, "n": [1, 2]},
        {"v": 2.5, "on": None, "name": "b", "n": [3, 4], "count": 2**53 + 1},
        {"v": 3, "on": False, "at": {"km": 2}, "big": 0, "n": []},
    ]
    path = json_log(tmp_path / "json.mcap", "/things", messages)
    found = frames_of(path)
    frame = found.frames["/things"]
    assert frame["v"].tolist() == [1.0, 2.5, 3.0]
    assert frame["on"].dtype == "boolean"
    assert frame["on"].isna().tolist() == [False, True, False]
    assert frame["count"].dtype == "Int64"
    assert frame["count"].iloc[1] == 2**53 + 1
    assert frame["big"].dtype == "UInt64"
    assert frame["big"].iloc[0] == 2**63
    assert frame["at.km"].iloc[2] == 2.0
    assert frame["n[1]"].isna().tolist() == [False, False, True]
    assert frame["name"].iloc[:2].tolist() == ["a", "b"]
    assert found.skipped == ()


def test_what_does_not_become_columns_is_named_and_counted(tmp_path):
    messages = [
        {"fits": 1, "long": [0] * (MOST_ELEMENTS + 1), "kind": 1, "grows": [1]},
        {"fits": 2, "long": [0] * (MOST_ELEMENTS + 1), "kind": "two", "grows": [1, 2]},
        {"fits": 3, "a": {"b": 1}, "a.b": 2},
    ]
    found = frames_of(json_log(tmp_path / "json.mcap", "/things", messages))
    assert list(found.frames["/things"].columns) == ["fits", "a.b"]
    listed = {(item.field, item.messages) for item in found.skipped}
    assert listed == {("long", 2), ("kind", 2), ("grows", 2), ("a.b", 1)}
    assert found.frames["/things"]["a.b"].iloc[2] == 1


def test_a_mislabelled_or_broken_message_costs_only_itself(tmp_path):
    log = ForeignLog(tmp_path / "odd.mcap")
    numbers = ("p/msg/Pair", "ros2msg", b"float64 x\nfloat64 y")
    good = cdr_numbers(1.0, 2.0)
    log.add(log.channel("/mixed", "cdr", numbers), [good, b'{"x": 1}', b"", good[:-1], good])
    log.add(log.channel("/json", "json"), [b'{"x": 1}', b"", b"[1]", b'{"x":', b"\xff", b"3"])
    log.add(log.channel("/json_called_ros", "json", numbers), [b'{"x": 1}'])
    log.add(log.channel("/deep", "json"), [b'{"x":' * 100_000])
    log.add(log.channel("/nested", "json"), [b'{"x":' * 99 + b"1" + b"}" * 99])
    log.add(log.channel("/no_schema", "cdr"), [good])
    log.add(log.channel("/no_descriptor", "protobuf", ("p.X", "protobuf", b"\xff\xff")), [b""] * 2)
    log.add(log.channel("/wrong_kind", "protobuf", numbers), [b""])
    log.add(log.channel("/unknown", "smoke signals", numbers), [b"puff"] * 3)
    log.add(log.channel("/flat", "flatbuffer", ("p.X", "flatbuffer", b"")), [b""])
    log.add(log.channel("/idl", "cdr", ("p/msg/X", "ros2idl", b"module p {};")), [good])
    log.add(log.channel("/undefined", "cdr", ("p/msg/X", "ros2msg", b"Y y")), [good])
    log.add(log.channel("/never", "cdr", numbers), [])
    found = frames_of(log.close())
    assert found.frames["/mixed"]["x"].tolist() == [1.0, 1.0]
    assert found.frames["/json"]["x"].tolist() == [1]
    assert found.frames["/json_called_ros"]["x"].tolist() == [1]
    assert found.frames["/never"].empty
    counts = {}
    for item in found.skipped:
        counts[item.topic] = counts.get(item.topic, 0) + item.messages
        assert item.reason
    once = ("/deep", "/nested", "/no_schema", "/wrong_kind", "/flat", "/idl", "/undefined")
    several = {"/mixed": 3, "/json": 5, "/no_descriptor": 2, "/unknown": 3}
    assert counts == several | dict.fromkeys(once, 1)


def test_fields_that_a_protobuf_schema_does_not_declare_are_counted(tmp_path):
    path = tmp_path / "protobuf.mcap"
    with path.open("wb") as stream:
        writer = ProtobufWriter(stream)
        writer.write_message("/log", Log(message="known"), START)
        fix = LocationFix(latitude=1.0)
        fix.MergeFromString(b"\xa0\x06\x01")
        writer.write_message("/fix", fix, START)
        writer.finish()
    found = frames_of(path)
    assert [(item.topic, item.messages) for item in found.skipped] == [("/fix", 1)]


def test_a_topic_of_two_channels_is_one_frame_in_the_order_of_time(tmp_path):
    log = ForeignLog(tmp_path / "two.mcap")
    schema = ("p/msg/X", "ros2msg", b"float64 x")
    log.add(log.channel("/x", "cdr", schema), [cdr_numbers(0.0), cdr_numbers(1.0)], step=10**9)
    late = log._writer.register_channel("/x", "cdr", 1, {"publisher": "other"})
    log.add(late, [cdr_numbers(2.0), cdr_numbers(3.0)], step=10**8)
    frame = frames_of(log.close()).frames["/x"]
    assert frame["x"].tolist() == [0.0, 2.0, 3.0, 1.0]
    assert frame.index.is_monotonic_increasing


def test_a_topic_of_two_schemas_is_two_frames(tmp_path):
    log = ForeignLog(tmp_path / "two.mcap")
    log.add(log.channel("/x", "cdr", ("p/msg/A", "ros2msg", b"float64 x")), [cdr_numbers(1.0)])
    log.add(log.channel("/x", "cdr", ("p/msg/A", "ros2msg", b"float64 z")), [cdr_numbers(2.0)])
    log.add(log.channel("/x", "json"), [b'{"y": "text"}'])
    frames = frames_of(log.close()).frames
    assert list(frames) == ["/x (p/msg/A)", "/x (p/msg/A) 2", "/x (json)"]
    assert frames["/x (p/msg/A) 2"]["z"].tolist() == [2.0]


def test_names_made_up_message_by_message_do_not_fill_the_memory(tmp_path):
    messages = [{f"name {row} {n}": n for n in range(100)} for row in range(100)]
    found = frames_of(json_log(tmp_path / "many.mcap", "/many", messages))
    columns = found.frames["/many"].shape[1]
    assert columns == 2_000
    assert sum(item.messages for item in found.skipped) == 100 * 100 - columns


def test_a_message_beyond_all_size_is_not_decoded(tmp_path, monkeypatch):
    monkeypatch.setattr("trainlog.mcap.foreign.LARGEST", 2**20)
    huge = {"x": np.random.default_rng(1).bytes(600_000).hex()}
    found = frames_of(json_log(tmp_path / "huge.mcap", "/huge", [huge, {"x": "b"}]))
    assert found.frames["/huge"]["x"].tolist() == ["b"]
    assert [item.reason for item in found.skipped] == ["it has more than 1 MiB"]


def test_no_mcap_file_and_no_such_topic(tmp_path):
    (tmp_path / "no.mcap").write_bytes(b"speed;position")
    refused(LogError, "is not an MCAP file", frames_of, tmp_path / "no.mcap")
    refused(InputError, "", frames_of, tmp_path / "missing.mcap")
    path = json_log(tmp_path / "json.mcap", "/things", [{}])
    refused(LogError, "topics are '/things'", frames_of, path, topics=["/thing"])


@pytest.mark.skipif(not SHARED.exists(), reason="the shared data is not here")
def test_the_files_that_rosbag2_wrote_read_as_the_official_decoder_reads_them():
    compared = 0
    for path in SHARED.glob("*.mcap"):
        frames = frames_of(path).frames
        rows = dict.fromkeys(frames, 0)
        with path.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            for _, channel, _, message in reader.iter_decoded_messages():
                row = frames[channel.topic].iloc[rows[channel.topic]]
                rows[channel.topic] += 1
                for column, value in row.items():
                    if "char" in column:
                        continue  # unsigned in ROS 2, signed in that decoder
                    there = message
                    for part in column.replace("]", "").replace("[", ".").split("."):
                        there = there[int(part)] if part.isdigit() else getattr(there, part)
                    assert value == there, (path.name, column)
                    compared += 1
    assert compared > 1_000


def test_json_numbers_beyond_every_type(tmp_path):
    messages = [b'{"x": 1e999}', json.dumps({"x": 10**400}).encode(), b'{"x": NaN}']
    frame = frames_of(json_log(tmp_path / "n.mcap", "/n", messages)).frames["/n"]
    np.testing.assert_array_equal(frame["x"], [np.inf, np.inf, np.nan])


@settings(max_examples=20)
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
        lambda inner: (
            st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
        ),
        max_leaves=12,
    )
)
def test_any_json_is_read_or_counted(value):
    with tempfile.TemporaryDirectory() as folder:
        found = frames_of(json_log(Path(folder) / "any.mcap", "/any", [value, {"v": value}]))
    broken = [item for item in found.skipped if not item.field and "object" in item.reason]
    assert len(found.frames["/any"]) + sum(item.messages for item in broken) == 2


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
