"""Records of constant length: what numpy lays out is what protobuf reads."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given, strategies as st

from trainlog.mcap.codec import Value, descriptor_set, gather, layout, scatter, varint
from trainlog.mcap.records import MESSAGE, opened
from trainlog.mcap.writer import laid_out, parts_of, stream_of
from trainlog.topics import GNSS_FIX, TOPICS, Topic
from trainlog.trip import frame_of

FORM = layout(3, [b"\x09", Value("a", "<f8"), b"\x12\x10", Value("b", "<f8", 2)])


def record_of(topic: Topic, frame: pd.DataFrame) -> bytes:
    """The only record of a frame of one row."""
    return opened(laid_out(parts_of([stream_of(topic, frame, 1)])[0])[0], 0)


def test_the_template_has_the_constants_in_place() -> None:
    assert FORM.size == MESSAGE.size + 1 + 8 + 2 + 16
    opcode, length, channel, *rest = MESSAGE.unpack_from(FORM.template)
    assert (opcode, length, channel, *rest) == (5, FORM.size - 9, 3, 0, 0, 0)
    assert FORM.template[MESSAGE.size :] == b"\x09" + bytes(8) + b"\x12\x10" + bytes(16)


def test_scattered_records_are_gathered_again() -> None:
    rows = FORM.rows(3)
    rows["a"] = [1.0, 2.0, 3.0]
    rows["b"] = [[4.0, 5.0], [6.0, 7.0], [8.0, 9.0]]
    buffer = bytearray(b"\xaa" * 400)
    offsets = np.array([7, 100, 400 - FORM.size])
    scatter(rows, buffer, offsets)
    found = gather(bytes(buffer), offsets[::-1], FORM)
    assert found is not None
    assert found[::-1].view(f"V{FORM.size}").tobytes() == rows.tobytes()
    outside = np.delete(np.frombuffer(buffer, "u1"), (offsets[:, None] + np.arange(FORM.size)))
    assert set(outside) == {0xAA}


@pytest.mark.parametrize(
    "offsets",
    [
        [1],
        [-1],
        [2**63],
        [2**64 - 1],
        [0, 0],
        [0, 10**6],
    ],
)
def test_offsets_that_lead_nowhere_are_refused(offsets: list[int]) -> None:
    kind = np.int64 if min(offsets) < 0 else np.uint64
    assert gather(FORM.template, np.array(offsets, dtype=kind), FORM) is None
    assert gather(FORM.template[:-1], np.array([0]), FORM) is None


def test_every_constant_byte_is_compared() -> None:
    variable = {
        *range(11, MESSAGE.size),
        *range(MESSAGE.size + 1, MESSAGE.size + 9),
        *range(MESSAGE.size + 11, FORM.size),
    }
    for at in range(FORM.size):
        changed = bytearray(FORM.template)
        changed[at] ^= 0x80
        found = gather(bytes(changed), np.array([0]), FORM)
        assert (found is not None) == (at in variable)


@given(st.integers(0, 2**64 - 1))
def test_varints(number: int) -> None:
    value = 0
    for place, byte in enumerate(varint(number)):
        value |= (byte & 0x7F) << 7 * place
    assert value == number
    assert len(varint(number)) == max(1, -(-number.bit_length() // 7))


@pytest.mark.parametrize("time", [0, 1, 10**9 - 1, 10**9, 1_700_000_000 * 10**9 + 5, 2**63 - 1])
def test_padded_time_stamps_are_read_by_protobuf(time: int) -> None:
    data = {"latitude": [47.4], "longitude": [9.4], "horizontal_accuracy": [3.0]}
    record = record_of(GNSS_FIX, frame_of(GNSS_FIX, np.array([time]), data))
    fix = LocationFix.FromString(record[MESSAGE.size :])
    assert fix.timestamp.ToNanoseconds() == time == MESSAGE.unpack_from(record)[4]
    assert (fix.latitude, fix.longitude) == (47.4, 9.4)
    assert np.isnan(fix.altitude)
    assert fix.position_covariance_type == LocationFix.DIAGONAL_KNOWN
    np.testing.assert_array_equal(
        np.reshape(fix.position_covariance, (3, 3)), np.diag([9.0, 9.0, np.nan])
    )


@pytest.mark.parametrize(
    "topic", [t for t in TOPICS.values() if not t.foxglove], ids=lambda topic: topic.message
)
def test_bytes_are_those_that_protobuf_writes(topic: Topic) -> None:
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set(topic)).file:
        pool.Add(file)
    message = GetMessageClass(pool.FindMessageTypeByName(topic.message))
    axles = 20
    values = {
        field.name: np.linspace(1.0, 2.0, axles) + number if field.per_axle else number / 7
        for number, field in enumerate(topic.fields)
    }
    row = {key: np.reshape(each, (1, -1) if np.ndim(each) else 1) for key, each in values.items()}
    frame = frame_of(topic, np.array([5]), row)
    data = record_of(topic, frame)[MESSAGE.size :]
    assert data == message(**values).SerializeToString(deterministic=True)
