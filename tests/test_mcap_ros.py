"""ROS messages as bytes: as the official writer makes them, broken, forged."""

import struct

import pytest
from foreign_logs import FIX_1, FIX_2, cdr, schema_text
from hypothesis import given, settings, strategies as st
from mcap_ros2._dynamic import serialize_dynamic
from refusals import refused

from trainlog.mcap.foreign import (
    BYTES,
    LONG_ARRAY,
    MOST_ELEMENTS,
    BrokenMessage,
    UndecodableError,
    ros_decoder,
)

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
