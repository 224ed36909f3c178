"""MCAP files as other programs write them, made with the official writers."""

import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mcap.writer import Writer

START = 1_700_000_000 * 10**9  # time of the first message [ns]

SEPARATOR = "=" * 80 + "\n"

HEADER_1 = "uint32 seq\ntime stamp\nstring frame_id\n"
HEADER_2 = "builtin_interfaces/Time stamp\nstring frame_id\n"
TIME_2 = "int32 sec\nuint32 nanosec\n"

STATUS = """\
# Navigation Satellite fix status
int8 STATUS_NO_FIX = -1
int8 STATUS_FIX = 0
int8 status
uint16 SERVICE_GPS = 1
uint16 service
"""

NAV_SAT_FIX = """\
# Header specifies ROS time and frame of reference
{header} header
{status} status
float64 latitude   # [degrees]. Positive is north of equator
float64 longitude
float64 altitude
float64[9] position_covariance
uint8 COVARIANCE_TYPE_UNKNOWN = 0
uint8 position_covariance_type
"""

VECTOR = "float64 x\nfloat64 y\nfloat64 z\n"

IMU = """\
{header} header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
"""


def schema_text(main: str, **others: str) -> str:
    """A definition with those of the messages that it holds; ``__`` stands for ``/``."""
    parts = [f"MSG: {name.replace('__', '/')}\n{text}" for name, text in others.items()]
    return SEPARATOR.join(f"{part.rstrip()}\n" for part in [main, *parts])


COVARIANCE = [4.0, 0.5, 0.0, 0.5, 9.0, 0.0, 0.0, 0.0, 25.0]

MAIN_1 = NAV_SAT_FIX.format(header="Header", status="NavSatStatus")
FIX_1 = schema_text(MAIN_1, std_msgs__Header=HEADER_1, sensor_msgs__NavSatStatus=STATUS)
MAIN_2 = NAV_SAT_FIX.format(header="std_msgs/Header", status="sensor_msgs/NavSatStatus")
STAMPED = {"std_msgs__Header": HEADER_2, "builtin_interfaces__Time": TIME_2}
FIX_2 = schema_text(MAIN_2, **STAMPED, sensor_msgs__NavSatStatus=STATUS)
TURNED = {"geometry_msgs__Quaternion": f"{VECTOR}float64 w\n", "geometry_msgs__Vector3": VECTOR}
IMU_2 = schema_text(IMU.format(header="std_msgs/Header"), std_msgs__Header=HEADER_2, **TURNED)


class ForeignLog:
    """An MCAP file whose schemas, channels and messages are whatever a test says."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stream = path.open("wb")
        self._writer = Writer(self._stream)
        self._writer.start(profile="", library="test")

    def channel(self, topic, message_encoding, schema=None):
        """Declare a channel; `schema` is its name, encoding and data."""
        schema_id = 0 if schema is None else self._writer.register_schema(*schema)
        return self._writer.register_channel(topic, message_encoding, schema_id)

    def add(self, channel: int, messages: Iterable[bytes], step: int = 10**8) -> None:
        """Add messages, the first at `START`."""
        for row, data in enumerate(messages):
            time = START + row * step
            self._writer.add_message(channel, time, data, time + 1000, row)

    def close(self) -> Path:
        """Finish the file."""
        self._writer.finish()
        self._stream.close()
        return self.path


def json_log(path: Path, topic: str, messages: list[Any], schema: str = "example.Thing") -> Path:
    """A file with one topic of JSON messages."""
    log = ForeignLog(path)
    described = (schema, "jsonschema", b'{"type": "object"}')
    log.add(
        log.channel(topic, "json", described),
        (item if isinstance(item, bytes) else json.dumps(item).encode() for item in messages),
    )
    return log.close()


def cdr(body: bytes) -> bytes:
    """A little-endian CDR message of this content."""
    return b"\x00\x01\x00\x00" + body


def cdr_numbers(*values: float) -> bytes:
    """A CDR message of doubles."""
    return cdr(struct.pack(f"<{len(values)}d", *values))
