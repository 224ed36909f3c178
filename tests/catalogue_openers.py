"""Processes that open a catalogue of an earlier version: run by the tests in one of their own.

    python tests/catalogue_openers.py WHERE OPENERS

The processes are forked from this one, which has imported everything. The first is killed while it
changes the tables. Then several open the catalogue at once. As JSON: whether the first was killed,
what the header stated behind it, and the version that each of the others found to migrate.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import replace

import sqlalchemy as sa
from killed import PATIENCE, Forked

from trainlog.catalogue import database as migration, open_catalogue


def forked(work: Callable[[int], object]) -> tuple[Forked, int]:
    """A process that works, and where what it found, and writes into its pipe meanwhile, is read.

    This process keeps no end to write: of one that fails nothing is read, and nobody waits.
    """
    reader, writer = os.pipe()
    process = Forked(lambda: os.write(writer, json.dumps(work(writer)).encode()) and None)
    os.close(writer)
    return process, reader


def migrated(where: str) -> int | None:
    """The version that was brought to the latest on opening."""
    warnings.simplefilter("ignore")
    with open_catalogue(where) as catalogue:
        return catalogue.migrated_from


def paused(where: str, pipe: int) -> None:
    """Open it; stop once the tables are changed, before that is kept."""
    last = migration.STEPS[-1]

    def change(connection: sa.Connection) -> None:
        last.change(connection)
        os.write(pipe, b"changed")
        time.sleep(PATIENCE)

    migration.STEPS = (*migration.STEPS[:-1], replace(last, change=change))
    migrated(where)


def main(where: str, openers: int) -> None:
    """Kill one that migrates, and let the others open it."""
    victim, reader = forked(lambda pipe: paused(where, pipe))
    assert os.read(reader, 7) == b"changed", "the first failed"
    # Another waits meanwhile, and does it once the first is dead.
    running = [forked(lambda _: migrated(where)) for _ in range(openers)]
    time.sleep(0.2)
    victim.send_signal(signal.SIGKILL)
    killed = victim.wait() == -signal.SIGKILL
    found = []
    for process, pipe in running:
        process.wait()
        found.append(json.loads(os.read(pipe, 1000) or b'"failed"'))
    print(json.dumps({"killed": killed, "migrated": found}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
