"""How fast one thread records live, and what is lost, beside others' writers used sample by sample.

    python benchmarks/log/benchmark_record.py [--samples 500000] [--rate 100000] [--seconds 5]

First as many samples as a thread can give, one call each: of three numbers, and of five axles.
The others' writers are used as their documentation does, one protobuf object and one call a
sample; they write within the call, and a program that is killed keeps what fills their chunks.
Then samples at a given rate for some seconds: the share of one processor that recording takes, how
long the slowest call took, and what was lost.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from mcap.writer import Writer
from small_mcap import McapWriter
from trips import START, message_of

import trainlog
from trainlog.mcap.codec import descriptor_set
from trainlog.topics import TRAIN_AXLES, TRAIN_STATE, Topic

VALUES: dict[str, tuple[Topic, dict[str, object]]] = {
    "three numbers": (TRAIN_STATE, {"speed": 21.25, "position": 1204.5, "acceleration": -0.125}),
    "five axles": (TRAIN_AXLES, {"wheel_speed": [1.5] * 5, "wheel_effort": [2500.0] * 5}),
}


def with_trainlog(topic: Topic, values: dict[str, object], samples: int, path: Path) -> None:
    with trainlog.record(path, queue=2**28) as log:
        write, name = log.write, topic.name
        for number in range(samples):
            write(name, START + number * 10**4, **values)
    assert log.account().written == {name: samples}


def with_official(topic: Topic, values: dict[str, object], samples: int, path: Path) -> None:
    message = message_of(topic)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(topic.message, "protobuf", descriptor_set(topic))
        channel = writer.register_channel(topic.name, "protobuf", schema)
        for number in range(samples):
            at = START + number * 10**4
            writer.add_message(channel, at, message(**values).SerializeToString(), at, number)
        writer.finish()


def with_small(topic: Topic, values: dict[str, object], samples: int, path: Path) -> None:
    message = message_of(topic)
    with path.open("wb") as stream:
        writer = McapWriter(stream, zstd_level=3)
        writer.start()
        writer.add_schema(1, topic.message, "protobuf", descriptor_set(topic))
        writer.add_channel(1, topic.name, "protobuf", 1)
        for number in range(samples):
            at = START + number * 10**4
            writer.add_message(1, at, message(**values).SerializeToString(), at, number)
        writer.finish()


RECORDERS: dict[str, Callable[[Topic, dict[str, object], int, Path], None]] = {
    "trainlog": with_trainlog,
    "official writer": with_official,
    "small-mcap": with_small,
}


def race(samples: int, folder: Path) -> None:
    """As many samples as one thread can give; the faster of three runs, in turns."""
    for case, (topic, values) in VALUES.items():
        seconds = dict.fromkeys(RECORDERS, float("inf"))
        processor = dict.fromkeys(RECORDERS, float("inf"))
        for turn in range(3):
            for name, write in RECORDERS.items():
                begin, used = time.perf_counter(), time.process_time()
                write(topic, values, samples, folder / f"{topic.message}-{name}-{turn}")
                seconds[name] = min(seconds[name], time.perf_counter() - begin)
                processor[name] = min(processor[name], time.process_time() - used)
        print(f"{case}, {samples:,} samples, closing the file included")
        for name, taken in seconds.items():
            ratio = seconds["official writer"] / taken
            cost = processor[name] / samples * 1e6
            print(
                f"  {name:16} {samples / taken:10,.0f} samples/s, ratio {ratio:4.1f}, "
                f"{cost:5.2f} µs of a processor each"
            )


def steady(rate: int, seconds: float, path: Path) -> None:
    """Samples at a rate, a hundredth of a second's at a time, as from a bus."""
    _, values = VALUES["three numbers"]
    given, slowest = 0, 0.0
    with trainlog.record(path) as log:
        begin, processor = time.perf_counter(), time.process_time()
        while given < rate * seconds:
            for _ in range(rate // 100):
                before = time.perf_counter()
                log.write(TRAIN_STATE.name, START + given * 10**4, **values)
                slowest = max(slowest, time.perf_counter() - before)
                given += 1
            time.sleep(max(0.0, begin + given / rate - time.perf_counter()))
        taken, used = time.perf_counter() - begin, time.process_time() - processor
    account = log.account()
    print(
        f"{rate:,} samples/s asked for, {given / taken:,.0f} given for {taken:.1f} s: "
        f"{used / taken:.0%} of a processor, slowest call {slowest * 1e3:.1f} ms, "
        f"lost {sum(account.dropped.values())}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=500_000)
    parser.add_argument("--rate", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        race(options.samples, Path(folder))
        steady(options.rate, options.seconds, Path(folder) / "steady.mcap")


if __name__ == "__main__":
    main()
