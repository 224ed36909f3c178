"""A fleet brought up to date: by one worker, by two, by Dask and by MPI; and once more.

    python benchmarks/fleet/benchmark_update.py [--trips 200] [--logs FOLDER] [--engines one,two]

simulates trips on a drawn network (or takes the logs of a folder), and prints a table: wall time,
processor time of the workers and of the parent, speed against one worker, overhead a trip. Every
engine begins with a catalogue that holds no result. That of ``again`` is the second run of the
last. Workers are warm: kernels are compiled before the first run. At the end it states what a fleet
of a million trips on a hundred computers takes by these figures (docs/fleet.md).
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from analysis.fleet.analyses import ANALYSES
from trainlog.catalogue import open_catalogue

TRAINLOG = [sys.executable, "-m", "trainlog"]
ENGINES = ("one", "two", "dask", "mpi")


def simulated(folder: Path, trips: int) -> None:
    """Trips of a fleet on a drawn network."""
    command = [*TRAINLOG, "simulate", "--network", "drawn", "--count", str(trips), "-o", folder]
    subprocess.run([str(each) for each in command], check=True, stdout=subprocess.DEVNULL)


@contextmanager
def dask(folder: Path) -> Iterator[str]:
    """A scheduler with two workers of one thread; its address."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        port = bound.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    command = [sys.executable, "-m", "dask"]
    with (folder / "dask.log").open("w") as log:
        started = [
            subprocess.Popen(
                [*command, *words, "--no-dashboard"], stdout=log, stderr=log, cwd=folder
            )
            for words in (
                ["scheduler", "--host", "127.0.0.1", "--port", str(port)],
                ["worker", address, "--nworkers", "2", "--nthreads", "1"],
            )
        ]
        try:
            time.sleep(8.0)
            yield address
        finally:
            for process in reversed(started):
                process.terminate()
                process.wait()


def measured(words: list[str]) -> tuple[float, float, dict[str, object]]:
    """Wall time and processor time of a command, all of its children included, and its result."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(words, check=False, stdout=subprocess.PIPE, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - began, spent, json.loads(done.stdout)


def command_of(engine: str, catalogue: Path, folder: Path) -> Iterator[list[str]]:
    """The command of an engine, while what it needs is there."""
    update = ["fleet", "update", "--catalogue", str(catalogue), "--json"]
    if engine == "dask":
        with dask(folder) as address:
            yield [*TRAINLOG, *update, "--scheduler", address]
    elif engine == "mpi":
        mpiexec = Path(sys.executable).with_name("mpiexec")
        found = str(mpiexec) if mpiexec.exists() else shutil.which("mpiexec") or "mpiexec"
        futures = [sys.executable, "-m", "mpi4py.futures", "-m", "trainlog"]
        yield [found, "-n", "3", *futures, *update, "--mpi"]
    else:
        yield [*TRAINLOG, *update, "--workers", {"one": "1", "two": "2"}[engine]]


def size(folder: Path, pattern: str) -> int:
    """Bytes of the files of a folder."""
    return sum(path.stat().st_size for path in folder.rglob(pattern))


def row(
    name: str, trips: int, wall: float, cpu: float, found: dict[str, object], one: float
) -> None:
    """Print a row of the table."""
    work = float(found["worker_seconds_s"])  # type: ignore[arg-type]
    over = 1e3 * (cpu - work) / max(trips, 1)
    against = f"{one / wall:6.2f}" if one else "      "
    rest = f"{over:13.1f}" if work and name != "dask" else " " * 13
    print(f"{name:8} {wall:9.1f} {work:11.1f} {cpu:10.1f} {against:>8} {rest}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trips", type=int, default=200)
    parser.add_argument("--logs", type=Path)
    parser.add_argument("--engines", default=",".join(ENGINES))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs = given.logs or folder / "logs"
        if given.logs is None:
            began = time.perf_counter()
            simulated(logs, given.trips)
            print(f"simulated in {time.perf_counter() - began:.0f} s")
        warm = folder / "warm"
        with open_catalogue(warm) as catalogue:
            catalogue.add(sorted(logs.rglob("*.mcap"))[:2])
        measured([*TRAINLOG, "fleet", "update", "--catalogue", str(warm), "--json"])
        base = folder / "base"
        with open_catalogue(base) as catalogue:
            began = time.perf_counter()
            catalogue.add(logs)
            adding = time.perf_counter() - began
            frame = catalogue.query(columns=["duration"])
        trips, hours = len(frame), float(frame["duration"].sum()) / 3600.0
        read = size(logs, "*.mcap")
        print(f"{trips} trips, {hours:.0f} h, {read / 1e9:.2f} GB; {os.cpu_count()} processors")
        print(f"registered in {adding:.1f} s ({1e3 * adding / trips:.1f} ms a trip)")
        print(f"{'engine':8} {'wall, s':>9} {'workers, s':>11} {'all cpu, s':>10} {'speed-up':>8}"
              f" {'over, ms/trip':>13}")  # fmt: skip
        one, last, work = 0.0, base, 0.0
        for engine in given.engines.split(","):
            last = folder / engine
            shutil.copytree(base, last)
            for words in command_of(engine, last, folder):
                wall, cpu, found = measured(words)
            row(engine, trips, wall, cpu, found, one if engine != "one" else 0.0)
            one = wall if engine == "one" else one
            if not work:
                work = float(found["worker_seconds_s"])
        again = [*TRAINLOG, "fleet", "update", "--catalogue", str(last), "--json"]
        wall, cpu, found = measured(again)
        row("again", trips, wall, cpu, found, 0.0)
        if one:
            print(f"the second run takes {100.0 * wall / one:.2f} % of the first by one worker")
        tables = {each: size(last / "results" / each, "*.parquet") for each in ANALYSES}
        maps = size(last / "maps", "*.map")
        print("tables, bytes a trip: "
              + ", ".join(f"{each} {number / trips:,.0f}" for each, number in tables.items())
              + f"; maps {maps / trips:,.0f}; database"
              f" {size(last, 'catalogue.sqlite') / trips:,.0f}")  # fmt: skip
        print(f"processor time of the analyses: {1e3 * work / trips:.0f} ms a trip,"
              f" {1e3 * work / (3.0 * hours):.0f} ms per 20 minutes of recording")  # fmt: skip
        million, computers, cores = 1e6, 100, 8
        print(f"{million:,.0f} trips on {computers} computers of {cores} processors:"
              f" {million * read / trips / 1e12:.1f} TB read,"
              f" {million * work / trips / computers / cores / 60.0:.0f} min of computing,"
              f" tables of {million * sum(tables.values()) / trips / 1e9:.1f} GB")  # fmt: skip


if __name__ == "__main__":
    main()
