"""How fast messages of other programs become a frame, beside the official decoders.

    python benchmarks/log/benchmark_foreign.py [--messages 50000] [--repeats 5]

The same position, ``sensor_msgs/NavSatFix`` or ``foxglove.LocationFix``, in each encoding. The
official side decodes every message and stops there; ours ends with the columns of a frame. The
figures are the least processor time of several runs.
"""

from __future__ import annotations

import argparse
import io
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from mcap.decoder import DecoderFactory
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_protobuf.schema import build_file_descriptor_set
from mcap_ros1.decoder import DecoderFactory as Ros1Decoders
from mcap_ros2.decoder import DecoderFactory as Ros2Decoders
from mcap_ros2.writer import Writer as Ros2Writer

from trainlog.mcap import frames_of

START = 1_700_000_000 * 10**9

STATUS = "int8 status\nuint16 service\n"
BODY = """\
float64 latitude
float64 longitude
float64 altitude
float64[9] position_covariance
uint8 position_covariance_type
"""
SEPARATOR = "=" * 80 + "\n"
ROS1 = (
    f"Header header\nNavSatStatus status\n{BODY}{SEPARATOR}MSG: std_msgs/Header\nuint32 seq\n"
    f"time stamp\nstring frame_id\n{SEPARATOR}MSG: sensor_msgs/NavSatStatus\n{STATUS}"
)
ROS2 = (
    f"std_msgs/Header header\nsensor_msgs/NavSatStatus status\n{BODY}{SEPARATOR}"
    f"MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{SEPARATOR}"
    f"MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n{SEPARATOR}"
    f"MSG: sensor_msgs/NavSatStatus\n{STATUS}"
)
POSITION = {"latitude": 47.1, "longitude": 8.3, "altitude": 411.0}
COVARIANCE = [4.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 9.0]
FIX = {
    "header": {"stamp": {"sec": 1_700_000_000, "nanosec": 5}, "frame_id": "gnss"},
    "status": {"status": 0, "service": 1},
    **POSITION,
    "position_covariance": COVARIANCE,
    "position_covariance_type": 2,
}


def write(path: Path, message: str, schema: tuple[str, str, bytes], data: bytes, n: int) -> None:
    """A file with the same message `n` times."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/fix", message, writer.register_schema(*schema))
        for row in range(n):
            writer.add_message(channel, START + row, data, START + row)
        writer.finish()


def write_ros2(path: Path, n: int) -> None:
    """ROS 2, by the official writer."""
    with path.open("wb") as stream:
        writer = Ros2Writer(stream)
        schema = writer.register_msgdef("sensor_msgs/msg/NavSatFix", ROS2)
        for row in range(n):
            writer.write_message("/fix", schema, FIX, START + row)
        writer.finish()


def write_ros1(path: Path, n: int) -> None:
    """ROS 1, serialised by the class that the official decoder makes."""
    decode = Ros1Decoders().decoder_for(
        "ros1", Schema(id=1, name="sensor_msgs/NavSatFix", encoding="ros1msg", data=ROS1.encode())
    )
    assert decode is not None
    message = decode(bytes(16 + 3 + 24 + 72 + 1))
    message.header.frame_id = "gnss"
    message.position_covariance = COVARIANCE
    buffer = io.BytesIO()
    message.serialize(buffer)
    schema = ("sensor_msgs/NavSatFix", "ros1msg", ROS1.encode())
    write(path, "ros1", schema, buffer.getvalue(), n)


def write_protobuf(path: Path, n: int) -> None:
    """``foxglove.LocationFix``."""
    fix = LocationFix(**POSITION, position_covariance=COVARIANCE, frame_id="gnss")
    fix.timestamp.seconds = 1_700_000_000
    descriptors = build_file_descriptor_set(LocationFix).SerializeToString()
    schema = ("foxglove.LocationFix", "protobuf", descriptors)
    write(path, "protobuf", schema, fix.SerializeToString(), n)


def write_json(path: Path, n: int) -> None:
    """The same as JSON."""
    schema = ("sensor_msgs/NavSatFix", "jsonschema", b"{}")
    write(path, "json", schema, json.dumps(FIX).encode(), n)


def decode_officially(path: Path, factory: DecoderFactory | None) -> None:
    """Decode every message and keep none."""
    with path.open("rb") as stream:
        if factory is None:
            for _, _, message in make_reader(stream).iter_messages():
                json.loads(message.data)
        else:
            for _ in make_reader(stream, decoder_factories=[factory]).iter_decoded_messages():
                pass


def fastest(run: Callable[[], object], repeats: int) -> float:
    """Least processor time of several runs [s]."""
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=50_000)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    cases = (
        ("ROS 2", write_ros2, Ros2Decoders),
        ("ROS 1", write_ros1, Ros1Decoders),
        ("protobuf", write_protobuf, ProtobufDecoders),
        ("JSON", write_json, lambda: None),
    )
    print(f"{options.messages:,} messages, thousands a second")
    print(f"{'':10}{'to a frame':>12}{'official':>12}{'ratio':>8}")
    with tempfile.TemporaryDirectory() as folder:
        for name, make, factory in cases:
            path = Path(folder) / f"{name}.mcap"
            make(path, options.messages)
            found = frames_of(path)
            assert len(found.frames["/fix"]) == options.messages
            assert not found.skipped
            ours = options.messages / fastest(lambda p=path: frames_of(p), options.repeats)
            theirs = options.messages / fastest(
                lambda p=path, f=factory: decode_officially(p, f()), options.repeats
            )
            print(f"{name:10}{ours / 1e3:12.1f}{theirs / 1e3:12.1f}{ours / theirs:8.2f}")


if __name__ == "__main__":
    main()
