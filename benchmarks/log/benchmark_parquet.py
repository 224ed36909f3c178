"""A trip as a folder of Parquet files beside the log and beside what pandas writes by itself.

    python benchmarks/log/benchmark_parquet.py [--messages 500000] [--repeats 5]

All hold the same frames, zstd level 3. Each is run in turns with the others and its fastest run
counts, in processor time, which threads do not shorten.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pandas as pd
from trips import CASES, trip_of

from trainlog.formats.samples import folder
from trainlog.formats.trip_tables import read_parquet, write_parquet
from trainlog.mcap import read_log, write_log
from trainlog.topics import TRAIN_AXLES
from trainlog.trip import Trip

COLUMN = "wheel_speed_1"


def write_plain(trip: Trip, target: Path) -> None:
    """As pandas does by itself, one file a topic."""
    target.mkdir()
    for name, frame in trip.topics.items():
        file = target / f"{name.strip('/').replace('/', '_')}.parquet"
        frame.to_parquet(file, compression="zstd", compression_level=3)


def read_plain(target: Path) -> None:
    for file in target.iterdir():
        pd.read_parquet(file)


def read_plain_column(target: Path) -> None:
    pd.read_parquet(target / "train_axles.parquet", columns=[COLUMN])


KINDS: dict[str, tuple[Callable[[Trip, Path], None], ...]] = {
    "log": (
        write_log,
        lambda _, path: read_log(path),
        lambda _, path: read_log(path, {TRAIN_AXLES.name: [COLUMN]}),
    ),
    "Parquet of trainlog": (
        write_parquet,
        lambda _, path: read_parquet(path),
        lambda _, path: read_parquet(path, {TRAIN_AXLES.name: [COLUMN]}),
    ),
    "Parquet of pandas": (
        write_plain,
        lambda _, path: read_plain(path),
        lambda _, path: read_plain_column(path),
    ),
}


def size_of(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def compared(name: str, trip: Trip, repeats: int) -> None:
    rows = sum(map(len, trip.topics.values()))
    best = {kind: [float("inf")] * 3 for kind in KINDS}
    size = {}
    with tempfile.TemporaryDirectory() as place:
        for _ in range(repeats):
            for number, (kind, steps) in enumerate(KINDS.items()):
                path = Path(place) / ("log.mcap" if kind == "log" else f"{number}.parquet")
                if path.is_dir():
                    shutil.rmtree(path)
                for step, run in enumerate(steps):
                    began = time.process_time()
                    run(trip, path)
                    best[kind][step] = min(best[kind][step], time.process_time() - began)
                size[kind] = size_of(path)
    print(f"\n{name}: {rows:,} rows; millions of rows a second of processor time")
    print(f"{'':22s} {'MB':>7s} {'of log':>7s} {'write':>7s} {'read':>7s} {'one column':>11s}")
    for kind in KINDS:
        write, read, column = (rows / seconds / 1e6 for seconds in best[kind])
        share = size[kind] / size["log"]
        print(
            f"{kind:22s} {size[kind] / 1e6:7.2f} {share:6.0%}"
            f" {write:7.2f} {read:7.2f} {column:11.1f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=500_000)
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args()
    for name, topics in CASES.items():
        compared(name, trip_of(topics, given.messages), given.repeats)
    compared("sample trip", read_log(folder() / "stopping.mcap"), given.repeats)


if __name__ == "__main__":
    main()
