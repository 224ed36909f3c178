"""How fast trips are written and read, beside the official mcap package with protobuf.

    python benchmarks/log/benchmark_log.py [--messages 500000] [--repeats 5]

Both write the same messages, zstd-compressed, and both read them into columns. The figures are
medians of several runs in turns; the official package is run fewer times because it is slow.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from trainlog.mcap import read_log, write_log
from trainlog.mcap.schemas import descriptor_set
from trainlog.topics import TRAIN_AXLES, TRAIN_CONTROLS, TRAIN_STATE, Topic
from trainlog.trip import Trip, frame_of

AXLES = 5
START = 1_700_000_000 * 10**9


def trip_of(topics: list[Topic], messages: int) -> Trip:
    """A trip of smooth signals with sensor noise, 100 Hz a topic."""
    random = np.random.default_rng(1)
    rows = messages // len(topics)
    at = START + np.arange(rows) * 10**7
    frames = {}
    for topic in topics:
        shape = {field.name: (rows, AXLES) if field.per_axle else (rows,) for field in topic.fields}
        data = {
            name: np.round(20 + np.cumsum(random.normal(0, 0.01, size), axis=0), 3)
            for name, size in shape.items()
        }
        frames[topic.name] = frame_of(topic, at, data)
    return Trip(frames)


def write_officially(trip: Trip, path: Path) -> None:
    """The same messages with the official writer, one protobuf object each."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        batches = []
        for name, frame in trip.topics.items():
            topic = next(t for t in (TRAIN_STATE, TRAIN_CONTROLS, TRAIN_AXLES) if t.name == name)
            data = descriptor_set(topic)
            schema = writer.register_schema(topic.message, "protobuf", data)
            channel = writer.register_channel(name, "protobuf", schema)
            pool = DescriptorPool()
            for file in FileDescriptorSet.FromString(data).file:
                pool.Add(file)
            message = GetMessageClass(pool.FindMessageTypeByName(topic.message))
            values = [
                frame.filter(
                    regex=f"^{field.name}_[0-9]+$" if field.per_axle else f"^{field.name}$"
                )
                .to_numpy()
                .tolist()
                for field in topic.fields
            ]
            scalars = [not field.per_axle for field in topic.fields]
            names = [field.name for field in topic.fields]
            times = frame.index.as_unit("ns").asi8.tolist()
            batches.append((channel, message, names, scalars, zip(times, *values, strict=True)))
        for rows in zip(*(batch[-1] for batch in batches), strict=True):
            for (channel, message, names, scalars, _), (at, *row) in zip(
                batches, rows, strict=True
            ):
                fields = {
                    name: value[0] if scalar else value
                    for name, scalar, value in zip(names, scalars, row, strict=True)
                }
                writer.add_message(channel, at, message(**fields).SerializeToString(), at)
        writer.finish()


def read_officially(path: Path) -> int:
    """The same columns with the official reader and decoder."""
    columns: dict[str, list[float]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            columns.setdefault(channel.topic, []).append(message.log_time)
            for field in decoded.DESCRIPTOR.fields:
                columns.setdefault(channel.topic + field.name, []).append(
                    getattr(decoded, field.name)
                )
    return len(columns)


def timed(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def compared(trip: Trip, folder: Path, repeats: int) -> None:
    """Time both in turns and print one line a verb."""
    ours, official = folder / "trainlog.mcap", folder / "official.mcap"
    seconds: dict[str, list[float]] = {"write": [], "read": [], "slow write": [], "slow read": []}
    for turn in range(repeats):
        seconds["write"].append(timed(lambda: write_log(trip, ours)))
        seconds["read"].append(timed(lambda: read_log(ours)))
        if turn < 1 + repeats // 2:
            seconds["slow write"].append(timed(lambda: write_officially(trip, official)))
            seconds["slow read"].append(timed(lambda: read_officially(official)))
    count = sum(len(frame) for frame in trip.topics.values())
    size, slow_size = ours.stat().st_size / 1e6, official.stat().st_size / 1e6
    for verb in ("write", "read"):
        mine, theirs = median(seconds[verb]), median(seconds[f"slow {verb}"])
        print(
            f"  {verb:5} {count / mine / 1e6:6.2f} M/s, official {count / theirs / 1e6:6.3f} M/s, "
            f"ratio {theirs / mine:6.1f}"
        )
    print(f"  size  {size:6.1f} MB, official {slow_size:.1f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=500_000)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    cases = {
        "one topic, ten values a message": [TRAIN_AXLES],
        "three topics interleaved": [TRAIN_STATE, TRAIN_CONTROLS, TRAIN_AXLES],
    }
    with tempfile.TemporaryDirectory() as folder:
        for case, topics in cases.items():
            print(f"{case}, {options.messages:,} messages")
            compared(trip_of(topics, options.messages), Path(folder), options.repeats)


if __name__ == "__main__":
    main()
