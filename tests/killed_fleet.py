"""Updates of a fleet that are killed: the parent or a worker, at random moments."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
import sqlalchemy as sa
from killed import PATIENCE

from analysis.fleet.update import fleet_status
from trainlog.catalogue import open_catalogue
from trainlog.catalogue.database import results, trips
from trainlog.formats.mapfile import merge_files


def workers(process: psutil.Process) -> list[psutil.Process]:
    """Processes that compute: those of the fork server, or the server itself before the first."""
    servers = [each for each in process.children() if "forkserver" in " ".join(each.cmdline())]
    return [each for server in servers for each in server.children()] or servers


def kill_at_random(catalogue, kills, seed, analyses):
    """Update until nothing is pending, killing at random moments; what was done.

    Each moment is that at which some results more are recorded, and up to half a second later:
    however slow the computer is, what is killed has begun. Of eight kills four are of a worker,
    three of the parent, one Ctrl-C. The number asked for is that of SIGKILL.
    """
    chance = random.Random(seed)
    done = {"parent": 0, "worker": 0, "interrupt": 0, "orphans": 0}
    command = [sys.executable, "-m", "trainlog", "fleet", "update", "--catalogue", catalogue]
    command += ["--workers", "2", "--batch", "1", *(f"--analysis={each}" for each in analyses)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    while done["parent"] + done["worker"] < kills:
        process = psutil.Popen(command, **quiet)
        while process.poll() is None:
            wanted = recorded(catalogue) + chance.randint(0, 4)
            with suppress(psutil.Error):
                while process.poll() is None:
                    if recorded(catalogue) >= wanted and workers(process):
                        break
                    time.sleep(0.1)
                time.sleep(chance.uniform(0.0, 0.5))
                every = process.children(recursive=True)
                kind = chance.choice([*["worker"] * 4, *["parent"] * 3, "interrupt"])
                if kind == "worker":
                    chance.choice(workers(process)).kill()
                    done[kind] += 1
                    continue
                process.send_signal(signal.SIGKILL if kind == "parent" else signal.SIGINT)
                status = process.wait(PATIENCE)
                done[kind] += kind == "interrupt" or status == -signal.SIGKILL
                done["orphans"] += len(psutil.wait_procs(every, PATIENCE)[1])
        with open_catalogue(catalogue) as opened:
            if not fleet_status(opened, analyses).pending:
                break
    return done


def recorded(catalogue: str) -> int:
    return sum(count for _, count in rows_by_trip(catalogue))


def rows_by_trip(catalogue: str) -> list[tuple[str, int]]:
    with open_catalogue(catalogue) as opened, opened.reading() as connection:
        asked = sa.select(trips.c.key, sa.func.count(results.c.computation)).join(
            results, results.c.trip == trips.c.id
        )
        rows = connection.execute(asked.group_by(trips.c.key).order_by(trips.c.key)).all()
    return [(str(row[0]), int(row[1])) for row in rows]


def kept(folder: Path) -> dict[str, bytes]:
    """Files of results, and maps in the form in which the same recordings give the same bytes."""
    found = {
        str(path.relative_to(folder / "results")): path.read_bytes()
        for path in sorted(folder.rglob("results/**/*.parquet"))
    }
    return found | maps_in(folder / "maps")


def maps_in(folder: Path) -> dict[str, bytes]:
    found = {}
    for path in sorted(folder.glob("*.map")):
        whole = path.with_suffix(".whole")
        merge_files([path], whole)
        found[path.name] = whole.read_bytes()
        whole.unlink()
    return found


def grow_old(results_folder: Path) -> None:
    for path in results_folder.rglob("*.parquet"):
        os.utime(path, (0, 0))
