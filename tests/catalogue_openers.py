"""Processes that open a catalogue of an earlier version: run by the tests in one of their own.

    python tests/catalogue_openers.py WHERE OPENERS

The processes are forked from this one, which has imported everything. The first is killed while it
changes the tables. Then several open the catalogue at once. As JSON: whether the first was killed,
what the header stated behind it, and the version that each of the others found to migrate.
"""

from __future__ import annotations

import json
import signal
import sys
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


def main(where: str, openers: int) -> None:
    """Kill one that migrates, and let the others open it."""
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
    print(json.dumps({"killed": killed, "migrated": found}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
