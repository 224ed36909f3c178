"""Damaged files give all that is readable; files of other programs, messages of ROS too, frames."""

from __future__ import annotations

import json
import struct
import tempfile
import tracemalloc
import warnings
import zlib
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from foreign_logs import (
    COVARIANCE,
    FIX_1,
    FIX_2,
    START,
    ForeignLog,
    cdr,
    cdr_numbers,
    json_log,
    schema_text,
)
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from hypothesis import given, settings, strategies as st
from mcap.reader import SeekingReader, make_reader
from mcap.records import ChunkIndex
from mcap_mutations import mutated
from mcap_protobuf.schema import build_file_descriptor_set
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros1.decoder import DecoderFactory as Ros1DecoderFactory
from mcap_ros1.writer import Writer as Ros1Writer
from mcap_ros2._dynamic import serialize_dynamic
from mcap_ros2.decoder import DecoderFactory
from mcap_trips import ATTACHMENTS, assert_same, trip_of
from refusals import refused

from trainlog.errors import InputError, LogError
from trainlog.mcap import DamageWarning, account_of, describe, frames_of, read_log, write_log
from trainlog.mcap.foreign import (
    BYTES,
    LONG_ARRAY,
    MOST_ELEMENTS,
    BrokenMessage,
    UndecodableError,
    ros_decoder,
)
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
        assert refused(LogError, said, read, tmp_path / "trip.mcap").file == tmp_path / "trip.mcap"


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


NAMES = [f"f{number}" for number in range(6)]
NUMBERS = ["bool", "float32", "float64"] + [
    f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)
]


@st.composite
def ros_fields(draw):
    """Lines of a definition, and a value for each field."""
    lines, values = [], {}
    for name in draw(st.lists(st.sampled_from(NAMES), min_size=1, unique=True)):
        kind = draw(st.sampled_from([*NUMBERS, "string"]))
        if kind == "string":
            one = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
        elif kind == "bool":
            one = st.booleans()
        elif kind.startswith("float"):
            one = st.floats(width=int(kind[5:]), allow_nan=False)
        else:
            bits = int(kind.lstrip("uint"))
            low = 0 if kind.startswith("u") else -(2 ** (bits - 1))
            one = st.integers(low, low + 2**bits - 1)
        count = draw(st.sampled_from([None, None, 0, 1, 3, 70]))
        fixed = draw(st.booleans()) and count
        bound = "" if count is None else f"[{count if fixed else ''}]"
        lines.append(f"{kind}{bound} {name}")
        if count is None:
            values[name] = draw(one)
        elif kind in ("uint8", "int8") and not fixed:
            values[name] = BYTES
        elif count > MOST_ELEMENTS:
            values[name] = LONG_ARRAY
        else:
            values[name] = draw(st.lists(one, min_size=count, max_size=count))
    return lines, values


def written(lines, values):
    """The bytes of a message by the official writer; long arrays and blobs are filled up."""
    given_values = dict(values)
    for line, (name, value) in zip(lines, values.items(), strict=True):
        if value is BYTES:
            given_values[name] = [1, 2, 3, 4, 5]
        elif value is LONG_ARRAY:
            given_values[name] = ["" if line.startswith("string") else 0] * 70
    return serialize_dynamic("p/msg/Thing", "\n".join(lines))["p/msg/Thing"](given_values)


@settings(max_examples=15)
@given(ros_fields(), st.integers(0, 3))
def test_ros2_messages_come_back_as_the_official_writer_got_them(drawn, padding):
    lines, values = drawn
    data = written(lines, values)
    decode = ros_decoder("p/msg/Thing", "\n".join(lines).encode(), "ros2")
    assert decode(data + bytes(padding)) == values
    for end in range(len(data)):
        refused(BrokenMessage, "", decode, data[:end])


FIX_DECODERS = [
    ros_decoder("sensor_msgs/NavSatFix", schema.encode(), dialect)
    for schema, dialect in ((FIX_1, "ros1"), (FIX_2, "ros2"))
]


@settings(max_examples=30)
@given(st.binary(max_size=200))
def test_no_bytes_raise_anything_but_a_broken_message(data):
    for decode in FIX_DECODERS:
        for payload in (data, cdr(data)):
            try:
                decode(payload)
            except BrokenMessage as error:
                assert str(error)  # noqa: PT017


def test_nested_messages_and_arrays_of_them():
    text = schema_text(
        "Point[2] ends\nPoint[] way\nstring[] names\nfloat32[<=3] few\nwide/Name one\nint8 last=7",
        geo__Point="float64 x\nint8 y -3\nint8 Y=5\n",
        wide__Name="string<=5 text\n",
    )
    decode = ros_decoder("geo/msg/Path", text.encode(), "ros2")
    body = struct.pack("<db7xdb7x", 1.0, 2, 3.0, 4)[:-7]
    body += b"\0" * (-len(body) % 4) + struct.pack("<I", 1)
    body += b"\0" * (-len(body) % 8) + struct.pack("<db", 5.0, 6)
    body += b"\0" * (-len(body) % 4) + struct.pack("<II2s", 1, 2, b"n\0")
    body += b"\0" * (-len(body) % 4) + struct.pack("<I", 0)
    body += struct.pack("<I3s", 3, b"ab\0")
    assert decode(cdr(body)) == {
        "ends": [{"x": 1.0, "y": 2}, {"x": 3.0, "y": 4}],
        "way": [{"x": 5.0, "y": 6}],
        "names": ["n"],
        "few": [],
        "one": {"text": "ab"},
    }


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("Thing again", "contains itself"),
        ("Other x", "does not define 'Other'"),
        ("float64", "is not a field"),
        ("int32 a\nint32 a", "two fields of the same name"),
        ("float64[9999999999] x", "elements"),
        ("float64[0] x", "elements"),
        ("float64[64] a\nrow[64] b\n" + "=" * 80 + "\nMSG: p/row\nfloat64[64] x", "fields"),
        ("import os; os.abort() x", "is not a field"),
        ("print() x", "is not a field"),
        ("wstring x", "does not define 'wstring'"),
        ("a" * 2_000_000, "bytes"),
        ("int32 x\n" + "=" * 80 + "\nint32 y", "which message"),
    ],
)
def test_definitions_that_cannot_be_read_are_refused(text, problem):
    refused(UndecodableError, problem, ros_decoder, "p/Thing", text.encode(), "ros1")
    for name in ("p/Thing\nimport os", "1/2", "p.Thing", "", "a/b/c/d"):
        refused(UndecodableError, "", ros_decoder, name, b"int8 x", "ros1")


def test_forged_lengths_take_neither_memory_nor_time():
    for dialect, head in (("ros1", b""), ("ros2", b"\0\1\0\0")):
        for kind in ("string", "float64", "uint8", "p/Flag"):
            text = schema_text(f"{kind}[] x", p__Flag="bool on")
            decode = ros_decoder("p/Thing", text.encode(), dialect)
            refused(BrokenMessage, "", decode, head + struct.pack("<I", 2**32 - 1) + bytes(100))


def test_messages_that_would_fill_the_memory_as_objects_are_not_decoded():
    empty = schema_text("Nothing[] x", p__Nothing="").encode()
    with pytest.raises(UndecodableError, match="array of messages without content"):
        ros_decoder("p/Thing", empty, "ros1")
    # In ROS 2 such a message is one byte long.
    assert ros_decoder("p/Thing", empty, "ros2")(cdr(struct.pack("<I2s", 2, b"ab"))) == {
        "x": [{}, {}]
    }
    decode = ros_decoder("p/Thing", schema_text("Flag[] x", p__Flag="bool on").encode(), "ros1")
    count = 2**23
    refused(BrokenMessage, "can hold more than", decode, struct.pack("<I", count) + bytes(count))
    blob = ros_decoder("p/Thing", b"uint8[] x\nuint8 y", "ros1")
    assert blob(struct.pack("<I", count) + bytes(count) + b"\7") == {"x": BYTES, "y": 7}


def test_definitions_as_they_are_found_in_files():
    text = (
        "# a comment\r\nHeader header\r\nstring MODE=fast # not\r\nint8 last=7\r\n"
        "float64 from 2.5\r\nbyte class\r\nchar letter\r\nduration[1] lasts\r\n"
        "=====\r\nMSG: std_msgs/Header\r\nuint32 seq\r\ntime stamp\r\nstring frame_id\r\n"
    )
    decode = ros_decoder("p/Thing", text.encode(), "ros1")
    body = struct.pack("<IIII3sdbBii", 1, 2, 3, 3, b"abc", 4.0, -5, 250, 6, 7)
    stamp = {"secs": 2, "nsecs": 3}
    assert decode(body) == {
        "header": {"seq": 1, "stamp": stamp, "frame_id": "abc"},
        "from": 4.0,
        "class": -5,
        "letter": 250,
        "lasts": [{"secs": 6, "nsecs": 7}],
    }
