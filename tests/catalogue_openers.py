"""Processes that open a catalogue of an earlier version, forked from one that imported everything.

The first is killed while it changes the tables. Then several open the catalogue at once.
"""

from __future__ import annotations

import json
import signal
import time
import warnings
from dataclasses import replace

import sqlalchemy as sa
from killed import PATIENCE, Piped

from trainlog.catalogue import database as migration, open_catalogue


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


def run(where: str, openers: int) -> dict[str, object]:
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
