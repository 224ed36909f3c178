"""Updates of a fleet that are killed: the parent or a worker, at random moments."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from trainlog.catalogue import open_catalogue
from trainlog.catalogue.schema import results, trips
from trainlog.formats.mapmerge import merge_files

PATIENCE = 60.0


def started(catalogue: str, *options: str) -> subprocess.Popen[bytes]:
    """A process that updates a catalogue."""
    command = [sys.executable, "-m", "trainlog", "fleet", "update", "--catalogue", catalogue]
    return subprocess.Popen(
        [*command, *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def descendants(pid: int) -> list[int]:
    """Processes that a process started, directly or not."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                children.setdefault(parent, []).append(int(entry.name))
    found, waiting = [], [pid]
    while waiting:
        one = waiting.pop()
        found += children.get(one, [])
        waiting += children.get(one, [])
    return found


def workers(pid: int) -> list[int]:
    """Those of them that compute: forked from the fork server, or started anew."""
    server = [each for each in descendants(pid) if b"forkserver" in _command(each)]
    return [each for each in server if each not in _children(pid)] or server


def _children(pid: int) -> list[int]:
    return [each for each in descendants(pid) if _parent(each) == pid]


def _parent(pid: int) -> int:
    with suppress(OSError):
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    return 0


def _command(pid: int) -> bytes:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    return b""


def alive(pids: list[int]) -> list[int]:
    """Processes that still run; what has ended and waits for its parent does not."""
    found = []
    for pid in pids:
        with suppress(OSError):
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
            found += [] if state in "ZX" else [pid]
    return found


def all_end(pids: list[int], patience: float = PATIENCE) -> bool:
    """Whether processes end within a time."""
    until = time.monotonic() + patience
    while alive(pids) and time.monotonic() < until:
        time.sleep(0.05)
    return not alive(pids)


def kill_at_random(
    catalogue: str, kills: int, seed: int, *options: str, within: float = 0.5, each: int = 20
) -> dict[str, int]:
    """Update until nothing is pending, killing at random moments; what was done.

    Each moment is that at which some results more are recorded, up to `each`, and up to `within`
    [s] later: however slow the computer is, what is killed has begun. Of eight kills six are of a
    worker, one of the parent, one Ctrl-C.
    """
    chance = random.Random(seed)
    done = {"parent": 0, "worker": 0, "interrupt": 0, "runs": 0, "orphans": 0}
    while sum(done[kind] for kind in ("parent", "worker", "interrupt")) < kills:
        process = started(catalogue, *options)
        done["runs"] += 1
        while process.poll() is None:
            wanted = recorded(catalogue) + chance.randint(0, each)
            while process.poll() is None:
                if workers(process.pid) and recorded(catalogue) >= wanted:
                    break
                time.sleep(0.05)
            time.sleep(chance.uniform(0.0, within))
            if process.poll() is not None:
                break
            every = descendants(process.pid)
            kind = chance.choice([*["worker"] * 6, "parent", "interrupt"])
            if kind == "worker":
                busy = workers(process.pid)
                if busy:
                    with suppress(ProcessLookupError):
                        os.kill(chance.choice(busy), signal.SIGKILL)
                        done[kind] += 1
                continue
            process.send_signal(signal.SIGKILL if kind == "parent" else signal.SIGINT)
            process.wait(PATIENCE)
            done[kind] += 1
            if not all_end(every):
                done["orphans"] += len(alive(every))
        if not pending(catalogue):
            break
    return done


def recorded(catalogue: str) -> int:
    """Rows of results."""
    import sqlalchemy as sa

    with open_catalogue(catalogue) as opened, opened._database.reading() as connection:
        count = sa.select(sa.func.count()).select_from(results)
        return int(connection.execute(count).scalar_one())


def forget_all(catalogue: str, where: str | None = None) -> None:
    """Make the results of all analyses pending again."""
    from analysis.fleet.analyses import ANALYSES
    from analysis.fleet.codes import code_of

    with open_catalogue(catalogue) as opened:
        for each in ANALYSES.values():
            about = (each.name, code_of(each), each.parameters)
            opened.forget(*about, where=where, states=("done", "refused", "failed"))


def pending(catalogue: str) -> int:
    """Trips for which an analysis is pending."""
    from analysis.fleet.update import fleet_status

    with open_catalogue(catalogue) as opened:
        return fleet_status(opened).pending


def rows_by_trip(catalogue: str) -> list[tuple[str, int]]:
    """How many rows of results each trip has, of all analyses."""
    import sqlalchemy as sa

    with open_catalogue(catalogue) as opened, opened._database.reading() as connection:
        asked = sa.select(trips.c.key, sa.func.count(results.c.computation)).join(
            results, results.c.trip == trips.c.id
        )
        rows = connection.execute(asked.group_by(trips.c.key).order_by(trips.c.key)).all()
    return [(str(row[0]), int(row[1])) for row in rows]


def maps_in(folder: Path) -> dict[str, bytes]:
    """The maps of a folder, in the form in which the same recordings give the same bytes."""
    found = {}
    for path in sorted(folder.glob("*.map")):
        whole = path.with_suffix(".whole")
        merge_files([path], whole)
        found[path.name] = whole.read_bytes()
        whole.unlink()
    return found


def contents(folder: Path) -> dict[str, bytes]:
    """The files of results that the catalogue names, by their place."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*.parquet"))
    }
