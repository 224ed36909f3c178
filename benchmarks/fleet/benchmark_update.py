"""A fleet brought up to date: by one worker, by two, by Dask and by MPI; and once more.

    python benchmarks/fleet/benchmark_update.py [--trips 60,200] [--logs FOLDER] [--engines one,two]

simulates trips on a drawn network (or takes the logs of a folder), and prints a table for each
number of trips. Every engine begins with a catalogue that holds no result; kernels are compiled
before. ``here`` is `--workers 0`: all in one process. Columns:

- wall: of the whole command; computing: of it from the first batch's beginning to the last one's
  end; idle: time therein in which workers had nothing to do, all together; else: the rest, from the
  start of Python to the first batch, and from the last to the end of the command;
- cpu: processor time of the command and of all workers, of Dask's scheduler, too;
- speed-up: against the faster of ``here`` and ``one``, of the whole command and of computing alone;
- start: processor time until the first trip and for what is done once, found from an update of two
  trips by the same engine;
- over: processor time beyond that and beyond the pure functions, a trip. These are measured in the
  same run: the same trips in one process, after three others.

Workers of Dask have computed two trips before. ``again``
is the second run of the last engine. At the end it states what a fleet of a million trips on a
hundred computers takes by these figures (docs/fleet.md).
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
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from analysis.fleet.analyses import ANALYSES
from trainlog.catalogue import open_catalogue

TRAINLOG = [sys.executable, "-m", "trainlog"]
ENGINES = ("here", "one", "two", "dask", "mpi")
WARM = 3
"""Trips before the pure functions are timed."""
MILLION, COMPUTERS, CORES = 1e6, 100, 8
TICKS = os.sysconf("SC_CLK_TCK")


def simulated(folder: Path, trips: int) -> None:
    """Trips of a fleet on a drawn network."""
    command = [*TRAINLOG, "simulate", "fleet", "drawn", "--count", str(trips), "-o", folder]
    subprocess.run([str(each) for each in command], check=True, stdout=subprocess.DEVNULL)


# ------------------------------------------------------------------------------ processor time


class Processes:
    """Processor time of processes and of all that they start, also of what nobody waits for."""

    def __init__(self, roots: Sequence[int]) -> None:
        self._roots, self._seen = list(roots), dict[int, float]()
        self._before = 0.0
        self._ended = threading.Event()
        self._look(walk=True)
        self._before = sum(self._seen.values())
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Processes:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._look(walk=True)

    def add(self, root: int) -> None:
        """Watch another process."""
        self._roots.append(root)

    @property
    def seconds(self) -> float:
        """Processor time since it began [s]."""
        return sum(self._seen.values()) - self._before

    def _watch(self) -> None:
        count = 0
        while not self._ended.wait(0.1):
            self._look(walk=count % 10 == 0)  # looking for new processes takes milliseconds
            count += 1

    def _look(self, *, walk: bool) -> None:
        found = self._tree() if walk else list(self._seen)
        for pid in found:
            with suppress(OSError, ValueError, IndexError):
                words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
                self._seen[pid] = (int(words[11]) + int(words[12])) / TICKS

    def _tree(self) -> list[int]:
        children: dict[int, list[int]] = {}
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                with suppress(OSError, IndexError):
                    stat = (entry / "stat").read_text().rpartition(")")[2].split()
                    children.setdefault(int(stat[1]), []).append(int(entry.name))
        found, waiting = list(self._seen), list(self._roots)
        while waiting:
            pid = waiting.pop()
            found.append(pid)
            waiting += children.get(pid, [])
        return sorted(set(found))


PURE = """
import json, sys, time
from analysis.fleet.analyses import analyses_named
from analysis.fleet.work import Batch, Job, computed, load_analyses, one_thread
one_thread()
load_analyses()
analyses, spent = analyses_named(), {}
jobs = [Job(*each, tuple(range(len(analyses)))) for each in json.load(sys.stdin)]
for number, job in enumerate(jobs[:WARM] + jobs):
    began = time.process_time()
    computed(Batch((job,), analyses))
    spent[job.key] = time.process_time() - began
json.dump(spent, sys.stdout)
""".replace("WARM", str(WARM))


def pure(catalogue: Path) -> dict[str, float]:
    """Processor time of the pure functions of each trip [s], in one process after warm-up."""
    with open_catalogue(catalogue) as opened:
        waiting = opened.pending("none")
        jobs = waiting[["key", "sha256", "path"]].to_numpy().tolist()
    given = json.dumps(jobs)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", PURE], input=given, stdout=subprocess.PIPE, text=True, check=True,
        env=environment,
    )  # fmt: skip
    return {str(key): float(value) for key, value in json.loads(done.stdout).items()}


# ------------------------------------------------------------------------------------- engines


@contextmanager
def dask(folder: Path) -> Iterator[tuple[str, list[int]]]:
    """A scheduler with two workers of one thread that have loaded the analyses: address, pids."""
    from analysis.fleet.engine import Dask
    from trainlog.errors import InputError

    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        port = bound.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    load = ["--preload", "analysis.fleet.worker"]
    with (folder / "dask.log").open("w") as log:
        started = [
            subprocess.Popen(
                [sys.executable, "-m", "dask", *words, "--no-dashboard"],
                stdout=log, stderr=log, cwd=folder,
            )
            for words in (
                ["scheduler", "--host", "127.0.0.1", "--port", str(port)],
                ["worker", address, "--nworkers", "2", "--nthreads", "1", *load],
            )
        ]  # fmt: skip
        try:
            until = time.monotonic() + 120.0
            while time.monotonic() < until:
                with suppress(InputError), Dask(address) as engine:
                    if engine.workers == 2:
                        break
                time.sleep(0.5)
            yield address, [each.pid for each in started]
        finally:
            for process in reversed(started):
                process.terminate()
                process.wait()


@dataclass
class Run:
    """What an update took."""

    wall: float
    cpu: float
    found: dict[str, Any] = field(default_factory=dict)

    @property
    def computing(self) -> float:
        """From the first batch to the last [s]."""
        return float(self.found["computing_s"])


def measured(words: list[str], others: Sequence[int] = ()) -> Run:
    """A command, and the processor time of it, of all that it starts and of other processes."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with Processes(others) as processes:
        command = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        processes.add(command.pid)
        output = command.communicate()[0]
        wall = time.perf_counter() - began
    seen = processes.seconds - processes._seen.get(command.pid, 0.0)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    own = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    # What the command waited for is in `own`; MPI's processes are, those of a fork server are not.
    waited = "mpi4py.futures" in words
    return Run(wall, own if waited else own + seen, json.loads(output))


@contextmanager
def command_of(engine: str, folder: Path) -> Iterator[tuple[list[str], list[int]]]:
    """The command of an engine, but for the catalogue, while what it needs is there."""
    update = ["fleet", "update", "--json"]
    if engine == "dask":
        with dask(folder) as (address, pids):
            yield [*TRAINLOG, *update, "--scheduler", address], pids
    elif engine == "mpi":
        mpiexec = Path(sys.executable).with_name("mpiexec")
        found = str(mpiexec) if mpiexec.exists() else shutil.which("mpiexec") or "mpiexec"
        futures = [sys.executable, "-m", "mpi4py.futures", "-m", "trainlog"]
        yield [found, "-n", "3", *futures, *update, "--mpi"], []
    else:
        workers = {"here": "0", "one": "1", "two": "2"}[engine]
        yield [*TRAINLOG, *update, "--workers", workers], []


# -------------------------------------------------------------------------------------- tables


def size(folder: Path, pattern: str) -> int:
    """Bytes of the files of a folder."""
    return sum(path.stat().st_size for path in folder.rglob(pattern))


def fresh(folder: Path, name: str, logs: Sequence[Path]) -> Path:
    """A catalogue of these logs that holds no result."""
    place = folder / name
    with open_catalogue(place) as catalogue:
        catalogue.add(logs)
    return place


def table_of(
    folder: Path, engines: Sequence[str], base: Path, few: Path, spent: float, trips: int
) -> Path:
    """Print the table of a number of trips; the catalogue of the last engine."""
    print(f"\n{trips} trips; pure functions {spent:.1f} s of processor time,"
          f" {1e3 * spent / trips:.0f} ms a trip")  # fmt: skip
    heads = ("wall, s", "computing", "idle", "else", "cpu, s", "speed-up", "computing",
             "start, cpu s", "over, ms/trip")  # fmt: skip
    print(" " * 6, " ".join(f"{head:>{max(8, len(head))}}" for head in heads))
    last, baseline = base, list[Run]()
    for engine in engines:
        last = folder / f"{engine}-{trips}"
        first = folder / f"{engine}-{trips}-few"
        shutil.copytree(base, last)
        shutil.copytree(few, first)
        with command_of(engine, folder) as (words, pids):
            if engine == "dask":  # its workers run on: they are measured as they are from then on
                shutil.copytree(few, before := folder / f"{engine}-{trips}-before")
                measured([*words, "--catalogue", str(before)], pids)
            small = measured([*words, "--catalogue", str(first)], pids)
            run = measured([*words, "--catalogue", str(last)], pids)
        if engine in ("here", "one"):
            baseline.append(run)
        start = small.cpu - 2.0 * spent / trips
        over = run.cpu - start - spent
        against = min((each.wall for each in baseline), default=0.0) / run.wall
        alone = min((each.computing for each in baseline), default=0.0) / run.computing
        print(f"{engine:6} {run.wall:8.1f} {run.computing:9.1f} {run.found['idle_s']:8.1f}"
              f" {run.wall - run.computing:8.1f} {run.cpu:8.1f} {against:8.2f} {alone:9.2f}"
              f" {start:12.1f} {1e3 * over / max(trips - 2, 1):13.1f}", flush=True)  # fmt: skip
    again = measured([*TRAINLOG, "fleet", "update", "--catalogue", str(last), "--json"])
    one = min((each.wall for each in baseline), default=0.0)
    share = f", {100.0 * again.wall / one:.2f} % of one worker's first run" if one else ""
    print(f"again  {again.wall:8.1f}{'':28} {again.cpu:8.1f}   nothing new{share}")
    return last


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trips", default="60,200")
    parser.add_argument("--logs", type=Path)
    parser.add_argument("--engines", default=",".join(ENGINES))
    given = parser.parse_args()
    counts = sorted({int(each) for each in given.trips.split(",")})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs = given.logs or folder / "logs"
        if given.logs is None:
            began = time.perf_counter()
            simulated(logs, counts[-1])
            print(f"simulated in {time.perf_counter() - began:.0f} s")
        found = sorted(logs.rglob("*.mcap"))[: counts[-1]]
        # Shorter tables take their trips evenly from all.
        chosen = {
            count: [found[number * len(found) // count] for number in range(min(count, len(found)))]
            for count in counts
        }
        warm = fresh(folder, "warm", found[:2])
        measured([*TRAINLOG, "fleet", "update", "--catalogue", str(warm), "--json"])
        few = fresh(folder, "few", found[:2])
        began = time.perf_counter()
        bases = {count: fresh(folder, f"base-{count}", each) for count, each in chosen.items()}
        adding = (time.perf_counter() - began) / sum(map(len, chosen.values()))
        print(f"{os.cpu_count()} processors; registered in {1e3 * adding:.1f} ms a trip")
        of_trip = pure(bases[counts[-1]])
        engines = given.engines.split(",")
        for base in bases.values():
            with open_catalogue(base) as catalogue:
                frame = catalogue.query(columns=["key", "duration"])
            spent = sum(of_trip[key] for key in frame["key"])
            last = table_of(folder, engines, base, few, spent, len(frame))
        summary(last, found, frame["duration"].sum() / 3600.0, spent, len(frame))


def summary(last: Path, logs: Sequence[Path], hours: float, spent: float, trips: int) -> None:
    """What the largest table states of a trip, and of a million."""
    read = sum(path.stat().st_size for path in logs)
    tables = {name: size(last / "results" / name, "*.parquet") for name in ANALYSES}
    maps = size(last / "maps", "*.map")
    print(f"\n{trips} trips, {hours:.0f} h, {read / 1e6 / trips:.2f} MB a trip; bytes a trip: "
          + ", ".join(f"{each} {number / trips:,.0f}" for each, number in tables.items())
          + f"; maps {maps / trips:,.0f}; database"
          f" {size(last, 'catalogue.sqlite') / trips:,.0f}")  # fmt: skip
    print(f"processor time of the analyses: {1e3 * spent / trips:.0f} ms a trip,"
          f" {1e3 * spent / (3.0 * hours):.0f} ms per 20 minutes of recording")  # fmt: skip
    print(f"{MILLION:,.0f} trips on {COMPUTERS} computers of {CORES} processors:"
          f" {MILLION * read / trips / 1e12:.1f} TB read,"
          f" {MILLION * spent / trips / COMPUTERS / CORES / 60.0:.0f} min of computing,"
          f" tables of {MILLION * sum(tables.values()) / trips / 1e9:.1f} GB")  # fmt: skip


if __name__ == "__main__":
    main()
