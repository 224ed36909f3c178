"""ROS messages as bytes: as the official writer makes them, broken, forged."""

import struct

import pytest
from foreign_logs import FIX_1, FIX_2, cdr, schema_text
from hypothesis import given, settings
from hypothesis import strategies as st

from trainlog.mcap.foreign_rows import BYTES, LONG_ARRAY, MOST_ELEMENTS, BrokenMessage
from trainlog.mcap.ros_definitions import NUMBERS, DefinitionError
from trainlog.mcap.ros_wire import decoder

NAMES = [f"f{number}" for number in range(6)]


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
    from mcap_ros2._dynamic import serialize_dynamic

    given_values = {}
    for line, (name, value) in zip(lines, values.items(), strict=True):
        if value is BYTES:
            value = [1, 2, 3, 4, 5]
        elif value is LONG_ARRAY:
            value = ["" if line.startswith("string") else 0] * 70
        given_values[name] = value
    text = "\n".join(lines)
    return serialize_dynamic("p/msg/Thing", text)["p/msg/Thing"](given_values)


def expanded(found):
    """A decoded message with its fixed arrays as lists again."""
    joined = {}
    for path, value in found.items():
        name, _, index = path.partition("[")
        if index:
            joined.setdefault(name, []).append(value)
        else:
            joined[name] = value
    return joined


@settings(max_examples=100, deadline=None)
@given(ros_fields(), st.integers(0, 3))
def test_ros2_messages_come_back_as_the_official_writer_got_them(drawn, padding):
    lines, values = drawn
    data = written(lines, values)
    decode = decoder("p/msg/Thing", "\n".join(lines).encode(), "ros2")
    assert expanded(decode(data + bytes(padding))) == values
    for end in range(len(data)):
        with pytest.raises(BrokenMessage):
            decode(data[:end])


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=200))
def test_no_bytes_raise_anything_but_a_broken_message(data):
    for schema, dialect in ((FIX_1, "ros1"), (FIX_2, "ros2")):
        decode = decoder("sensor_msgs/NavSatFix", schema.encode(), dialect)
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
    decode = decoder("geo/msg/Path", text.encode(), "ros2")
    body = struct.pack("<db7xdb7x", 1.0, 2, 3.0, 4)[:-7]
    body += b"\0" * (-len(body) % 4) + struct.pack("<I", 1)
    body += b"\0" * (-len(body) % 8) + struct.pack("<db", 5.0, 6)
    body += b"\0" * (-len(body) % 4) + struct.pack("<II2s", 1, 2, b"n\0")
    body += b"\0" * (-len(body) % 4) + struct.pack("<I", 0)
    body += struct.pack("<I3s", 3, b"ab\0")
    assert decode(cdr(body)) == {
        "ends[0].x": 1.0,
        "ends[0].y": 2,
        "ends[1].x": 3.0,
        "ends[1].y": 4,
        "way": [{"x": 5.0, "y": 6}],
        "names": ["n"],
        "few": [],
        "one.text": "ab",
    }


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("Thing again", "nested more than 32"),
        ("Other x", "does not define 'Other'"),
        ("float64", "is no field"),
        ("int32 a\nint32 a", "two fields of the same name"),
        ("float64[9999999999] x", "elements"),
        ("float64[0] x", "elements"),
        ("float64[64] a\nrow[64] b\n" + "=" * 80 + "\nMSG: p/row\nfloat64[64] x", "fields"),
        ("import os; os.abort() x", "is no field"),
        ("print() x", "is no field"),
        ("wstring x", "does not define 'wstring'"),
        ("a" * 2_000_000, "bytes"),
        ("int32 x\n" + "=" * 80 + "\nint32 y", "which message"),
    ],
)
def test_definitions_that_make_no_sense_are_refused(text, problem):
    with pytest.raises(DefinitionError, match=problem):
        decoder("p/Thing", text.encode(), "ros1")


def test_forged_lengths_take_neither_memory_nor_time():
    empty = schema_text("Nothing[] x", p__Nothing="")
    for dialect, head in (("ros1", b""), ("ros2", b"\0\1\0\0")):
        for kind in ("string", "float64", "uint8", "p/Nothing"):
            text = empty if kind == "p/Nothing" else f"{kind}[] x"
            decode = decoder("p/Thing", text.encode(), dialect)
            with pytest.raises(BrokenMessage):
                decode(head + struct.pack("<I", 2**32 - 1) + bytes(100))
