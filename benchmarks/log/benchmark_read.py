"""How fast logs are read, as ratios beside others in the same run.

    python benchmarks/log/benchmark_read.py [--messages 1000000] [--repeats 5]
    python benchmarks/log/benchmark_read.py --part 1e9      # 1 % of a log of that many bytes
    python benchmarks/log/benchmark_read.py --stream 5e9    # memory while streaming a log

The first compares a topic of ten doubles a message, to a DataFrame, with the official reader and
its protobuf decoder, small-mcap (if it is installed), Rerun's McapReader, Parquet, and with nothing
but decompressing the same chunks. Times are the least of several runs in turns: processor time, and
wall clock beside Parquet and Rerun. Large logs are made in a temporary folder, if there is space,
and removed.
"""

from __future__ import annotations

import argparse
import gc
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import zstandard
from mcap_protobuf.decoder import DecoderFactory
from trips import read_officially, trip_of, write_officially

from trainlog.mcap import LogWriter, describe, read_log, stream_log, write_log
from trainlog.mcap.contents import contents_of, fetched
from trainlog.mcap.records import Source
from trainlog.topics import TRAIN_AXLES, TRAIN_STATE
from trainlog.trip import Trip, frame_of

TOPIC = TRAIN_AXLES.name


def least(
    work: dict[str, Callable[[], object]], repeats: int, clock: Callable[[], float]
) -> dict[str, float]:
    """The least time of each, run in turns."""
    best = dict.fromkeys(work, np.inf)
    for _ in range(repeats):
        for name, run in work.items():
            gc.collect()
            start = clock()
            run()
            best[name] = min(best[name], clock() - start)
    return best


def compared(messages: int, repeats: int, folder: Path) -> None:
    """One topic to columns, beside others."""
    trip = trip_of([TRAIN_AXLES], messages)
    ours, official, parquet = folder / "ours.mcap", folder / "theirs.mcap", folder / "it.parquet"
    write_log(trip, ours)
    few = Trip({TOPIC: trip[TOPIC].iloc[: max(1, messages // 10)]})
    write_officially(few, official)
    pq.write_table(pa.Table.from_pandas(trip[TOPIC]), parquet, compression="zstd")
    with Source(ours) as source:
        stored = [fetched(source, place) for place in contents_of(source).chunks]
    zstd = zstandard.ZstdDecompressor()

    def decompress() -> None:
        for chunk in stored:
            zstd.decompress(chunk.data)

    # A tenth of the messages is enough for those that take one at a time.
    slow: dict[str, Callable[[], object]] = {"official": lambda: read_officially(official)}
    if (small := small_mcap(official)) is not None:
        slow["small-mcap"] = small
    fast: dict[str, Callable[[], object]] = {
        "trainlog, the topic": lambda: read_log(ours, [TOPIC]),
        "trainlog, the whole log": lambda: read_log(ours),
        "decompress": decompress,
    }
    fast["trainlog, the topic"]()  # loads what is compiled
    seconds = {
        name: each * 10 for name, each in least(slow, min(2, repeats), time.process_time).items()
    }
    seconds |= least(fast, repeats, time.process_time)
    wall = least(
        {
            "trainlog": lambda: read_log(ours, [TOPIC]),
            "Parquet": lambda: pd.read_parquet(parquet),
            "Rerun": lambda: rerun(ours),
        },
        repeats,
        time.perf_counter,
    )
    print(f"{messages:,} messages of ten doubles, processor time, M messages/s")
    for name, each in seconds.items():
        print(
            f"  {name:24} {messages / each / 1e6:7.3f}   {seconds['official'] / each:6.1f} x "
            f"official   {seconds['decompress'] / each:5.2f} of decompressing"
        )
    print("wall clock, M messages/s")
    for name, each in wall.items():
        print(f"  {name:24} {messages / each / 1e6:7.3f}   {wall['trainlog'] / each:6.2f} x")


def small_mcap(path: Path) -> Callable[[], object] | None:
    """The same with small-mcap and the protobuf decoder."""
    try:
        from small_mcap import read_message_decoded
    except ImportError:
        return None

    def read() -> int:
        columns: dict[str, list[float]] = {}
        with path.open("rb") as stream:
            for message in read_message_decoded(stream, decoder_factories=[DecoderFactory()]):
                decoded = message.decoded_message
                for field in decoded.DESCRIPTOR.fields:
                    columns.setdefault(field.name, []).append(getattr(decoded, field.name))
        return len(columns)

    return read


def rerun(path: Path) -> int:
    """The same with Rerun, to Arrow."""
    from rerun.chunk import McapReader

    return sum(1 for _ in McapReader(path).stream())


def pieces(size: float) -> Iterator[Trip]:
    """A long trip at 100 Hz, until its log has about `size` bytes."""
    random = np.random.default_rng(3)
    rows, at, position, made = 200_000, 1_700_000_000 * 10**9, 0.0, 0.0
    while made < size:
        instants = at + np.arange(rows) * 10**7
        speed = 20 + np.cumsum(random.normal(0, 0.005, rows))
        travelled = position + np.cumsum(speed) * 0.01
        axles = {
            name: np.round(20 + np.cumsum(random.normal(0, 0.01, (rows, 5)), axis=0), 3)
            for name in ("wheel_speed", "wheel_effort")
        }
        state = {"position": travelled, "speed": speed, "acceleration": random.normal(size=rows)}
        yield Trip(
            {
                TRAIN_STATE.name: frame_of(TRAIN_STATE, instants, state),
                TOPIC: frame_of(TRAIN_AXLES, instants, axles),
            },
            {"trip": "long"},
        )
        at, position = int(instants[-1]) + 10**7, float(travelled[-1])
        made += rows * 106.0


def long_log(size: float, folder: Path) -> Path:
    """A log of about `size` bytes."""
    free = shutil.disk_usage(folder).free
    if free < 1.5 * size + 2e9:
        raise SystemExit(f"only {free / 1e9:.1f} GB are free in {folder}")
    path = folder / "long.mcap"
    with LogWriter(path) as log:
        for piece in pieces(size):
            log.add(piece)
    print(f"a log of {path.stat().st_size / 1e9:.2f} GB")
    return path


def part(size: float, repeats: int, folder: Path) -> None:
    """1 % of a log by time and by position, and its description, beside the whole."""
    path = long_log(size, folder)
    found = describe(path)
    assert found.first is not None
    assert found.last is not None
    assert found.position_span is not None
    first = found.first + 0.5 * (found.last - found.first)
    span = (first, first + 0.01 * (found.last - found.first))
    start = found.position_span[0] + 0.5 * (found.position_span[1] - found.position_span[0])
    stretch = (start, start + 0.01 * (found.position_span[1] - found.position_span[0]))
    held = {
        "by time": sum(len(f) for f in read_log(path, time=span).topics.values()),
        "by position": sum(len(f) for f in read_log(path, position=stretch).topics.values()),
    }
    seconds = least(
        {
            "whole": lambda: read_log(path),
            "by time": lambda: read_log(path, time=span),
            "by position": lambda: read_log(path, position=stretch),
            "describe": lambda: describe(path),
        },
        repeats,
        time.perf_counter,
    )
    for name, each in seconds.items():
        share = f", {held[name] / found.count:.2%} of the messages" if name in held else ""
        print(f"  {name:12} {each:7.3f} s, {each / seconds['whole']:.2%} of the whole{share}")


def stream(size: float, folder: Path) -> None:
    """The most memory that a process takes which streams a log, and its description."""
    path = long_log(size, folder)
    for verb in ("stream", "describe"):
        begun = time.perf_counter()
        done = subprocess.run(
            [sys.executable, __file__, "--only", verb, str(path)],
            capture_output=True,
            text=True,
            check=True,
        )
        print(f"  {done.stdout.strip()}, {time.perf_counter() - begun:.1f} s")


def only(verb: str, path: str) -> None:
    """Do one thing and print the most memory that it took."""
    if verb == "describe":
        count = describe(path).count
    else:
        count = sum(len(frame) for trip in stream_log(path) for frame in trip.topics.values())
    status = Path("/proc/self/status")
    if status.exists():
        # Of this process alone: the other figure begins with that of the process that started it.
        peak = int(status.read_text().partition("VmHWM:")[2].split()[0]) * 1024
    else:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(f"{verb}: {count:,} messages, at most {peak / 1e6:.0f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--part", type=float, metavar="BYTES")
    parser.add_argument("--stream", type=float, metavar="BYTES")
    parser.add_argument("--only", nargs=2, metavar=("VERB", "LOG"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        only(*options.only)
        return
    with tempfile.TemporaryDirectory() as folder:
        if options.part:
            part(options.part, options.repeats, Path(folder))
        elif options.stream:
            stream(options.stream, Path(folder))
        else:
            compared(options.messages, options.repeats, Path(folder))


if __name__ == "__main__":
    main()
