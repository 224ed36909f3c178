"""How fast trips are written, and how large, beside the official writer, small-mcap and Parquet.

    python benchmarks/log/benchmark_write.py [--messages 500000] [--repeats 7]

All write the same values, zstd level 3. Each is run in turns with the others and its fastest run
counts, in wall clock and in processor time; the writers that make one object a message are run
fewer times because they are slow. The last table writes the sample trips again with the official
writer: other topics, events and attachments included.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from mcap.reader import make_reader
from mcap.writer import Writer
from trips import CASES, trip_of, write_officially, write_small

from trainlog.formats.samples import folder
from trainlog.mcap import read_log, write_log
from trainlog.trip import Trip

Write = Callable[[Trip, Path], None]


@dataclass
class Fastest:
    """The fastest of several runs [s], and the size of the file [bytes]."""

    wall: float = float("inf")
    processor: float = float("inf")
    size: int = 0

    def run(self, write: Write, trip: Trip, path: Path) -> None:
        """Run once more."""
        wall, processor = time.perf_counter(), time.process_time()
        write(trip, path)
        self.wall = min(self.wall, time.perf_counter() - wall)
        self.processor = min(self.processor, time.process_time() - processor)
        self.size = sum(each.stat().st_size for each in path.parent.glob(f"{path.name}*"))


def write_parquet(byte_stream_split: bool) -> Write:
    """One Parquet file a topic, zstd level 3."""

    def write(trip: Trip, path: Path) -> None:
        for number, frame in enumerate(trip.topics.values()):
            table = pa.Table.from_pandas(frame.reset_index(), preserve_index=False)
            pq.write_table(
                table,
                path.with_name(f"{path.name}{number}"),
                compression="zstd",
                compression_level=3,
                use_dictionary=not byte_stream_split,
                use_byte_stream_split=byte_stream_split,
            )

    return write


WRITERS: dict[str, tuple[Write, bool]] = {
    "official writer": (write_officially, True),
    "small-mcap": (write_small, True),
    "trainlog": (write_log, False),
    "the same, fsync": (lambda trip, path: write_log(trip, path, sync=True), False),
    "Parquet": (write_parquet(byte_stream_split=False), False),
    "Parquet, byte-stream-split": (write_parquet(byte_stream_split=True), False),
}
"""Each writer, and whether it is slow."""


def compare(trip: Trip, scratch: Path, repeats: int) -> None:
    """Time all writers in turns and print a line each."""
    found = {name: Fastest() for name in WRITERS}
    for turn in range(repeats):
        for number, (name, (write, slow)) in enumerate(WRITERS.items()):
            if not slow or turn < 1 + repeats // 3:
                found[name].run(write, trip, scratch / f"{number}.log")
    count = sum(len(frame) for frame in trip.topics.values())
    official = found["official writer"]
    print(f"  {'':26} {'M msg/s':>8} {'ratio':>6} {'by processor time':>18} {'MB':>7} {'size':>7}")
    for name, each in found.items():
        print(
            f"  {name:26} {count / each.wall / 1e6:8.2f} {official.wall / each.wall:6.1f}"
            f" {official.processor / each.processor:18.1f} {each.size / 1e6:7.2f}"
            f" {each.size / official.size:7.4f}"
        )


def rewritten_officially(source: Path, target: Path) -> None:
    """The same messages, metadata and attachments of a log, with the official writer."""
    with source.open("rb") as stream, target.open("wb") as output:
        reader, writer = make_reader(stream), Writer(output)
        writer.start()
        numbers: dict[int, int] = {}
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        for each in reader.iter_attachments():
            writer.add_attachment(
                each.create_time, each.log_time, each.name, each.media_type, each.data
            )
        for schema, channel, message in reader.iter_messages():
            if channel.id not in numbers and schema is not None:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, dict(channel.metadata)
                )
            writer.add_message(
                numbers[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=500_000)
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        for case, topics in CASES.items():
            print(f"{case}, {options.messages:,} messages")
            compare(trip_of(topics, options.messages), scratch, options.repeats)
        print("sample trips, bytes")
        for sample in ("nonstop", "stopping"):
            write_log(read_log(folder() / f"{sample}.mcap"), scratch / "ours.mcap")
            rewritten_officially(scratch / "ours.mcap", scratch / "official.mcap")
            ours, official = ((scratch / f"{n}.mcap").stat().st_size for n in ("ours", "official"))
            print(f"  {sample:10} {ours:,}, official writer {official:,}, {ours / official:.4f}")


if __name__ == "__main__":
    main()
