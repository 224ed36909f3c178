"""Memory and time of every command on a log larger than the memory it may take.

The log is a sample trip, repeated in time until the file has the size asked for.

    .venv/bin/python benchmarks/log/benchmark_memory.py --size 1.0 [--only info,convert]
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SAMPLE = Path(__file__).parents[2] / "sample_logs" / "stopping.mcap"
LIMIT = 500.0
"""What a command may take [MB] that reads a log in pieces; what is read whole is marked, too."""


def long_log(path: Path, gigabytes: float) -> None:
    """Write the log and return its size."""
    import pandas as pd

    from trainlog.mcap import LogWriter, read_log
    from trainlog.trip import Trip

    trip = read_log(SAMPLE)
    period = trip.end - trip.start + pd.Timedelta(minutes=10)

    def repeated(target: Path, count: int) -> int:
        with LogWriter(target) as log:
            for number in range(count):
                topics = {}
                for name, frame in trip.topics.items():
                    topics[name] = frame.set_axis(frame.index + number * period, axis=0)
                    topics[name].attrs = frame.attrs
                log.add(Trip(topics, trip.metadata, trip.provenance, trip.attachments))
        return target.stat().st_size

    began = time.perf_counter()
    count = round(gigabytes * 1e9 / (repeated(path, 10) / 10))
    size = repeated(path, count)
    rows = count * sum(map(len, trip.topics.values()))
    took = time.perf_counter() - began
    print(f"{size / 1e9:.2f} GB, {rows:,} rows, written in {took:.0f} s", flush=True)


def commands(log: Path, folder: Path) -> dict[str, list[str]]:
    """What is run, by name; each may use what those before have made."""
    parquet, driven = folder / "long.parquet", SAMPLE
    return {
        "import alone": ["--version"],
        "show": ["show", str(log)],
        "check": ["show", "--check", str(log)],
        "recover": ["convert", str(log), "-o", str(folder / "recovered.mcap")],
        "convert to Parquet": ["convert", str(log), "-o", str(parquet)],
        "convert to a log": ["convert", str(parquet), "-o", str(folder / "again.mcap")],
        "convert a stretch": [
            "convert", str(log), "-o", str(folder / "part.mcap"), "--km", "3.2:7.5",
        ],
        "convert a minute": [
            "convert", str(log), "-o", str(folder / "min.mcap"), "--from", "end-1min",
        ],
        "compare": ["compare", "groups", str(log), "--with", str(driven)],
        "optimise": [
            "plan", str(folder / "parameters.json"), "-o", str(folder / "trajectory.json"),
            "--line", "sample", "--train", "sample", "--running-time", str(log),
        ],
        "fit": ["fit", str(log), "-o", str(folder / "parameters.json")],
        "map update": ["map", "update", str(log), "--map", str(folder / "wil.map")],
        "estimate": ["estimate", str(log), "-o", str(folder / "estimated")],
        "replay a stretch": [
            "replay", str(folder / "min.mcap"), "-o", str(folder / "replay.rrd"),
        ],
        "replay": ["replay", str(log), "-o", str(folder / "long.rrd")],
    }  # fmt: skip


def measured(arguments: list[str]) -> tuple[float, float, float, str]:
    """Peak resident memory [MB], time and processor time [s], and the last words of a command."""
    program = "import sys; from trainlog.cli.main import main; sys.argv[0] = 'trainlog'; main()"
    began = time.perf_counter()
    with tempfile.TemporaryFile() as reported:
        process = subprocess.Popen(
            [sys.executable, "-c", program, *arguments], stdout=reported, stderr=reported
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        took = time.perf_counter() - began
        reported.seek(0)
        words = reported.read().decode(errors="replace").strip().splitlines()
    last = "" if process.returncode == 0 else f"exit {process.returncode}: {' '.join(words[-2:])}"
    return usage.ru_maxrss / 1024.0, took, usage.ru_utime + usage.ru_stime, last


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=float, default=1.0, help="of the log [GB]")
    parser.add_argument("--only", default="", help="commands whose names begin so, by commas")
    parser.add_argument("--folder", type=Path, help="where the files are made; default: temporary")
    parser.add_argument("--make", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.make:
        long_log(given.make, given.size)
        return
    folder = Path(tempfile.mkdtemp(dir=given.folder))
    try:
        log = folder / "long.mcap"
        # Made by a process of its own: what a process has held counts for those it starts, too.
        subprocess.run(
            [sys.executable, __file__, "--make", log, f"--size={given.size}"], check=True
        )
        print(f"{'command':20s} {'peak MB':>8s} {'s':>7s} {'CPU s':>7s}")
        chosen = tuple(filter(None, given.only.split(",")))
        for name, arguments in commands(log, folder).items():
            if chosen and not name.startswith(chosen):
                continue
            peak, took, busy, words = measured(arguments)
            mark = "" if peak < LIMIT else "  over the limit"
            print(
                f"{name:20s} {peak:8.0f} {took:7.1f} {busy:7.1f}{mark}  {words[:300]}", flush=True
            )
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
