"""Updates of a fleet that are killed: the parent or a worker, at random moments.

    python tests/killed_fleet.py CATALOGUE KILLS UNDISTURBED

This kills the command with two workers, where the command is forked from a process that has loaded
everything and computed each trip once, and its workers from the command: a start takes milliseconds
in place of seconds, and what is killed is what shares out, hands on, records, merges and maps.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from killed import PATIENCE, Forked

from trainlog.catalogue import open_catalogue
from trainlog.catalogue.database import results, trips
from trainlog.formats.mapfile import merge_files


def started(catalogue: str, *options: str) -> subprocess.Popen[bytes]:
    """A process that updates a catalogue."""
    command = [sys.executable, "-m", "trainlog", "fleet", "update", "--catalogue", catalogue]
    return subprocess.Popen(
        [*command, *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def forked(catalogue: str, *options: str) -> Forked:
    """A command forked from this process, whose workers are forked from it."""

    def update() -> int:
        from analysis.fleet import engine
        from trainlog.cli.main import run

        signal.signal(signal.SIGINT, signal.default_int_handler)
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        engine.multiprocessing = SimpleNamespace(  # type: ignore[attr-defined]
            get_all_start_methods=lambda: ["fork"],
            get_context=lambda _: multiprocessing.get_context("fork"),
        )
        return run(["fleet", "update", "--catalogue", catalogue, *options])

    return Forked(update)


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
    """Those of them that compute: forked from the fork server, or from the process itself."""
    server = [each for each in descendants(pid) if b"forkserver" in command_of(each)]
    forked = [each for each in _children(pid) if command_of(each) == command_of(pid)]
    return [each for each in server if each not in _children(pid)] or server or forked


def _children(pid: int) -> list[int]:
    return [each for each in descendants(pid) if _parent(each) == pid]


def _parent(pid: int) -> int:
    with suppress(OSError):
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    return 0


def command_of(pid: int) -> bytes:
    """The command line of a process."""
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
    catalogue: str,
    kills: int,
    seed: int,
    *options: str,
    within: float = 0.5,
    each: int = 20,
    start: Callable[..., Any] = started,
) -> dict[str, int]:
    """Update until nothing is pending, killing at random moments; what was done.

    Each moment is that at which some results more are recorded, up to `each`, and up to `within`
    [s] later: however slow the computer is, what is killed has begun. Of eight kills four are of a
    worker, three of the parent, one Ctrl-C. The number asked for is that of SIGKILL.
    """
    chance = random.Random(seed)
    done = {"parent": 0, "worker": 0, "interrupt": 0, "runs": 0, "orphans": 0}
    while done["parent"] + done["worker"] < kills:
        process = start(catalogue, *options)
        done["runs"] += 1
        while process.poll() is None:
            wanted = recorded(catalogue) + chance.randint(0, each)
            while process.poll() is None:
                if recorded(catalogue) >= wanted and workers(process.pid):
                    break
                time.sleep(0.1)
            time.sleep(chance.uniform(0.0, within))
            if process.poll() is not None:
                break
            every = descendants(process.pid)
            kind = chance.choice([*["worker"] * 4, *["parent"] * 3, "interrupt"])
            if kind == "worker":
                busy = alive(workers(process.pid))
                if busy:
                    with suppress(ProcessLookupError):
                        os.kill(chance.choice(busy), signal.SIGKILL)
                        done[kind] += 1
                continue
            process.send_signal(signal.SIGKILL if kind == "parent" else signal.SIGINT)
            status = process.wait(PATIENCE)
            done[kind] += kind == "interrupt" or status == -signal.SIGKILL
            if not all_end(every):
                done["orphans"] += len(alive(every))
        if not pending(catalogue):
            break
    return done


def recorded(catalogue: str) -> int:
    """Rows of results."""
    import sqlalchemy as sa

    with open_catalogue(catalogue) as opened, opened.reading() as connection:
        count = sa.select(sa.func.count()).select_from(results)
        return int(connection.execute(count).scalar_one())


def forget_all(catalogue: str, where: str | None = None) -> None:
    """Make the results of all analyses pending again."""
    from analysis.fleet.analyses import ANALYSES, computation_of

    with open_catalogue(catalogue) as opened:
        for each in ANALYSES.values():
            states = ("done", "refused", "failed")
            opened.forget(computation_of(each), where=where, states=states)


def pending(catalogue: str) -> int:
    """Trips for which an analysis is pending."""
    from analysis.fleet.update import fleet_status

    with open_catalogue(catalogue) as opened:
        return fleet_status(opened).pending


def rows_by_trip(catalogue: str) -> list[tuple[str, int]]:
    """How many rows of results each trip has, of all analyses."""
    import sqlalchemy as sa

    with open_catalogue(catalogue) as opened, opened.reading() as connection:
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


def grow_old(results_folder: Path) -> None:
    """Let files of results seem to be of yesterday."""
    for path in results_folder.rglob("*.parquet"):
        os.utime(path, (0, 0))


def contents(folder: Path) -> dict[str, bytes]:
    """The files of results that the catalogue names, by their place."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*.parquet"))
    }


def main() -> None:
    """Kill until so many were killed, and print what was done, and what became of the results.

    Each time that all was computed, files of results and maps are compared with those of an update
    that was not disturbed, and what was computed is forgotten.
    """
    from killed_points import remember

    from analysis.fleet import work
    from analysis.fleet.maps import maps_folder
    from analysis.fleet.update import UpdateOptions, update_fleet

    catalogue, kills, undisturbed = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])
    work.one_thread()
    work.load_analyses()
    remember()
    known = work._of_trip

    def slowly(*given: Any) -> Any:
        time.sleep(0.1)
        return known(*given)

    work._of_trip = slowly
    wanted = contents(undisturbed / "results") | maps_in(undisturbed / "maps")
    done = dict.fromkeys(("parent", "worker", "interrupt", "runs", "orphans"), 0)
    rounds = {"compared": 0, "same": 0, "once": 0}
    with open_catalogue(catalogue) as opened:
        here, maps = UpdateOptions(workers=0, retry=True), maps_folder(opened)
        update_fleet(opened, None, here)  # what is compiled and imported is loaded once
    while (left := kills - done["parent"] - done["worker"]) > 0:
        forget_all(catalogue)
        shutil.rmtree(maps)
        found = kill_at_random(
            catalogue, left, rounds["compared"], "--workers", "2", "--batch", "1",
            within=0.4, each=8, start=forked,
        )  # fmt: skip
        done = {name: done[name] + found[name] for name in done}
        with open_catalogue(catalogue) as opened:
            update_fleet(opened, None, here)
            grow_old(opened.results_folder)
            update_fleet(opened, None, here)
            now = contents(opened.results_folder) | maps_in(maps)
        rounds["compared"] += 1
        rounds["same"] += now == wanted
        rounds["once"] += len({count for _, count in rows_by_trip(catalogue)}) == 1
        (maps.parent / "kills.json").write_text(json.dumps({**done, **rounds}))
    print(json.dumps({**done, **rounds}))


if __name__ == "__main__":
    main()
