"""Processes on one catalogue that are killed, forked from one that has imported everything.

Adders add logs, each in its own order, and record a result of each trip; they are killed one after
the other and replaced, then one does the rest. Of openers the first is killed migrating the tables.
"""

import json
import random
import signal
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import sqlalchemy as sa
from killed import PATIENCE, Passed, Piped, Watched

from trainlog.catalogue import database as migration, open_catalogue, registration, results
from trainlog.catalogue.database import Database
from trainlog.catalogue.results import Computation, ResultOutcome

LENGTH = Computation("length", "1")

POINTS = (
    "a log looked at",
    "logs registered, not committed",
    "logs registered",
    "a file written, its rows not",
    "rows written, not committed",
    "rows committed",
)

registration.BATCH = 3


def work(where: str, kept: str | None, logs: list[str], seed: int) -> None:
    """Add the logs in an order of its own, and record a result of each trip."""
    random.Random(seed).shuffle(logs)
    with open_catalogue(where, results=kept) as catalogue:
        for at in range(0, len(logs), 4):
            catalogue.add(logs[at : at + 4])
            todo = catalogue.pending(LENGTH)
            table = pa.table({"key": list(todo["key"]), "length": [*map(len, todo["sha256"])]})
            done = [ResultOutcome(row.key, row.sha256, rows=1) for row in todo.itertuples()]
            catalogue.record(LENGTH, done, table)


def watch(passed: Passed) -> None:
    recording = [False]

    inner_record, inner_writing = results.Computed.record, Database.writing

    def record(*given: Any) -> int:
        recording[0] = True
        found = inner_record(*given)
        recording[0] = False
        passed.at("rows committed")
        return found

    @contextmanager
    def writing(self: Database) -> Iterator[Any]:
        with inner_writing(self) as connection:
            yield connection
            passed.at(f"{'rows written' if recording[0] else 'logs registered'}, not committed")
        if not recording[0]:
            passed.at("logs registered")

    passed.note(registration, "read_file", "a log looked at")
    passed.note(results, "write_table", "a file written, its rows not")
    results.Computed.record = record  # type: ignore[method-assign,assignment]
    Database.writing = writing  # type: ignore[method-assign,assignment]


def run(where: str, kept: str | None, folder: str, adders: int, kills: int) -> dict[str, Any]:
    """Kill adders, and let one finish; how many were killed or failed, and where kills fell."""
    logs = sorted(str(path) for path in Path(folder).rglob("*.mcap"))
    draw = random.Random(7)
    fell: Counter[str] = Counter()
    failed = 0
    with tempfile.TemporaryDirectory() as notes:

        def removed_and_added(seed: int) -> None:
            """Take some trips out, so that there is something to add; then work."""
            with open_catalogue(where, results=kept) as catalogue:
                if len(catalogue) and seed >= adders:
                    catalogue.remove(f"key >= '{'2468ac'[seed % 6]}'")
            work(where, kept, list(logs), seed)

        def begun(seed: int) -> Watched:
            point = POINTS[seed // 2 % len(POINTS)]
            order = (point, draw.randint(1, 4)) if seed % 2 else None
            work = partial(removed_and_added, seed)
            return Watched(Path(notes), POINTS, watch, work, order)

        running = [begun(seed) for seed in range(adders)]
        seed = adders
        while sum(fell.values()) < kills and seed < 10 * kills:
            victim = running.pop(0)
            if victim.passed.order is None:
                victim.kill_after(draw.randint(1, 30), draw.uniform(0.0, 0.02))
            status = victim.wait()
            if status == -signal.SIGKILL:
                fell[victim.passed.last or "begun"] += 1
            failed += status > 0
            running.append(begun(seed))
            seed += 1
        for each in running:
            failed += each.wait() > 0
    work(where, kept, logs, 1000)
    return {"killed": sum(fell.values()), "failed": failed, "fell": fell}


def migrated(where: str) -> int | None:
    """The version that was brought to the latest on opening."""
    warnings.simplefilter("ignore")
    with open_catalogue(where) as catalogue:
        return catalogue.migrated_from


def paused(where: str) -> None:
    """Open it; stop once the tables are changed, before that is kept."""
    last = migration.STEPS[-1]

    def change(connection: sa.Connection) -> None:
        last.change(connection)
        print("changed", flush=True)
        time.sleep(PATIENCE)

    migration.STEPS = (*migration.STEPS[:-1], replace(last, change=change))
    migrated(where)


def opened(where: str, openers: int) -> dict[str, object]:
    """Whether one that migrates was killed, and the version that each other found to migrate."""
    victim = Piped(lambda: paused(where))
    assert victim.read(), "the first failed"
    # Another waits meanwhile, and does it once the first is dead.
    running = [Piped(lambda: print(json.dumps(migrated(where)))) for _ in range(openers)]
    time.sleep(0.2)
    victim.send_signal(signal.SIGKILL)
    killed = victim.end() == -signal.SIGKILL
    found = []
    for each in running:
        each.end()
        found.append(json.loads(each.lines[-1] if each.lines else '"failed"'))
    return {"killed": killed, "migrated": found}
