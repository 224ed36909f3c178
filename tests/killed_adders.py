"""Adders of one catalogue that are killed: run by the tests in a process of its own.

    python tests/killed_adders.py WHERE RESULTS LOGS ADDERS KILLS

The adders are forked from this process, which has imported everything. Each adds the logs in an
order of its own and records a result of each trip. One after the other is killed at a random
moment and replaced; then one more does the rest. How many were killed while they worked is printed.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
import traceback
from pathlib import Path

import pyarrow as pa

from trainlog.catalogue import ResultOutcome, adding, open_catalogue

adding.BATCH = 3


def work(where: str, results: str | None, logs: list[str], seed: int) -> None:
    """Add the logs in an order of its own, and record a result of each trip."""
    random.Random(seed).shuffle(logs)
    with open_catalogue(where, results=results) as catalogue:
        for at in range(0, len(logs), 4):
            catalogue.add(logs[at : at + 4])
            todo = catalogue.pending("length", "1")
            table = pa.table(
                {"key": todo["key"].tolist(), "length": [len(p) for p in todo["sha256"]]}
            )
            done = [ResultOutcome(row.key, row.sha256, rows=1) for row in todo.itertuples()]
            catalogue.record("length", "1", {}, done, table)


def forked(where: str, results: str | None, logs: list[str], seed: int) -> int:
    """A process that works; its number."""
    number = os.fork()
    if number:
        return number
    status = 1
    try:
        work(where, results, list(logs), seed)
        status = 0
    except BaseException:  # noqa: BLE001 - the child must not go on as the parent
        traceback.print_exc()
    finally:
        os._exit(status)


def main(where: str, results: str, folder: str, adders: int, kills: int) -> int:
    """Kill adders, and let one finish."""
    kept = results or None
    logs = sorted(str(path) for path in Path(folder).rglob("*.mcap"))
    draw = random.Random(7)
    running = [forked(where, kept, logs, seed) for seed in range(adders)]
    killed = failed = 0
    for seed in range(kills):
        time.sleep(draw.uniform(0.0, 0.3))
        victim = running.pop(0)
        os.kill(victim, signal.SIGKILL)
        _, status = os.waitpid(victim, 0)
        killed += os.WIFSIGNALED(status)
        failed += os.WIFEXITED(status) and os.WEXITSTATUS(status) != 0
        running.append(forked(where, kept, logs, adders + seed))
    for number in running:
        _, status = os.waitpid(number, 0)
        failed += not os.WIFEXITED(status) or os.WEXITSTATUS(status) != 0
    work(where, kept, logs, 1000)
    print(killed, failed)
    return 0


if __name__ == "__main__":
    place, folder_of_results, folder_of_logs = sys.argv[1:4]
    sys.exit(main(place, folder_of_results, folder_of_logs, int(sys.argv[4]), int(sys.argv[5])))
