"""Updates of a fleet that are killed: the parent or a worker at random moments, or at named points.

Those of named points are forked from a process that has imported everything and computed each trip
once. What they pass is patched here, in the process that is killed, and noted in a file that
outlasts it. Between them some results are forgotten, and the code is another in turn, so that there
is always something to compute, to merge and to map. At last two updates end.
"""

import json
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import sqlalchemy as sa
from killed import PATIENCE, Passed, Watched

from analysis.fleet import maps, update, work
from analysis.fleet.analyses import FleetAnalysis, analyses_named, computation_of
from analysis.fleet.update import fleet_status
from trainlog.catalogue import Catalogue, open_catalogue, results
from trainlog.catalogue.database import Database, result_files, results as table, trips
from trainlog.formats import mapfile
from trainlog.formats.files import atomic_write
from trainlog.formats.mapfile import merge_files

POINTS = (
    "asking what is pending",
    "reading and computing a trip",
    "a file of results half written",
    "a file written, its rows not",
    "rows written, not committed",
    "rows committed",
    "a merged file half written",
    "a merged file written, rows name the old ones",
    "rows name the merged file, not committed",
    "rows name the merged file, old ones are there",
    "some old files removed",
    "maps begun anew",
    "a map begun",
    "a trip in a map, not committed",
    "a map committed",
    "trips stated to be in the maps, not committed",
    "trips stated to be in the maps",
    "old maps put aside, the new ones not in their place",
    "new maps in their place, the old ones there",
)

ANALYSES = ("adhesion", "checks")
"""What the updates compute: with the maps, that which passes all points."""

OTHER_CODE = "0123456789abcdef"

STATED = "trips stated to be in the maps"
NOT_COMMITTED = {
    "recording": "rows written, not committed",
    "mapping": "trips stated to be in the maps, not committed",
    "putting": "rows name the merged file, not committed",
}
RENAMED = {
    "old": "old maps put aside, the new ones not in their place",
    "maps.next": "new maps in their place, the old ones there",
}


def watch(passed: Passed) -> None:
    doing = ["asking"]

    def around(owner, name, then=lambda *_: "", while_doing=lambda *_: doing[-1]):
        """What goes on during calls of a function, and the point behind each, if it is one."""
        inner = getattr(owner, name)

        def outer(*given: Any, **named: Any) -> Any:
            doing.append(while_doing(*given))
            try:
                found = inner(*given, **named)
            finally:
                doing.pop()
            if point := then(found, *given):
                passed.at(point)
            return found

        setattr(owner, name, outer)

    def write_bytes(path: Path, data: bytes) -> None:
        merging = doing[-1] == "merging"
        with atomic_write(path) as temporary, temporary.open("wb") as stream:
            stream.write(data[: len(data) // 2])
            stream.flush()
            passed.at(f"a {'merged ' * merging}file {'of results ' * (not merging)}half written")
            stream.write(data[len(data) // 2 :])

    inner_writing = Database.writing

    @contextmanager
    def writing(self: Database) -> Iterator[Any]:
        with inner_writing(self) as connection:
            yield connection
            if doing[-1] in NOT_COMMITTED:
                passed.at(NOT_COMMITTED[doing[-1]])

    def of_map(of: Any) -> bool:
        return bool(of.analysis == maps.MAPS)

    results.write_bytes = write_bytes
    Database.writing = writing  # type: ignore[method-assign,assignment]
    passed.note(update._Update, "prepare", "asking what is pending", after=False)
    passed.note(work, "_of_trip", "reading and computing a trip", after=False)
    around(
        results.Computed, "record",
        lambda _, self, of, *more: STATED if of_map(of) else "rows committed",
        lambda self, of, *more: "mapping" if of_map(of) else "recording",
    )  # fmt: skip
    around(results.Computed, "compact", while_doing=lambda *_: "merging")
    merged = "a merged file written, rows name the old ones"
    around(
        results, "write_table",
        lambda *_: merged if doing[-1] == "merging" else "a file written, its rows not",
    )  # fmt: skip
    put = "rows name the merged file, old ones are there"
    around(results, "_put", lambda found, *_: put if found else "", lambda *_: "putting")
    removed = lambda path: path.suffix == ".parquet" and doing[-1] == "merging"  # noqa: E731
    around(
        pathlib.Path, "unlink",
        lambda _, path, *more: "some old files removed" if removed(path) else "",
    )  # fmt: skip
    around(
        pathlib.Path, "rename",
        lambda _, path, to: RENAMED.get("old" if Path(to).name == "maps.old" else path.name, ""),
    )  # fmt: skip
    passed.note(maps._Maps, "_folder", "maps begun anew")
    passed.note(mapfile, "begin", "a map begun")
    passed.note(mapfile.MapFile, "_append", "a trip in a map, not committed")
    passed.note(mapfile.MapFile, "append_all", "a map committed")


def remember() -> None:
    """Compute each trip once: what is killed here is what reads, records, merges and maps."""
    inner, known = work._of_trip, {}

    def outer(job: work.Job, analyses: Sequence[FleetAnalysis]) -> dict[int, Any]:
        missing = [n for n in job.analyses if (job.key, analyses[n].name) not in known]
        if missing:
            found = inner(job._replace(analyses=tuple(missing)), analyses)
            known.update({(job.key, analyses[n].name): each for n, each in found.items()})
        return {n: known[job.key, analyses[n].name] for n in job.analyses}

    work._of_trip = outer


def updated(where: str, code: str, seed: int | None = None) -> None:
    """Update, by the present code or as if by other; with a seed, forget some results before."""
    if code:
        update.computation_of = lambda each: replace(computation_of(each), code=code)
    with open_catalogue(where, create=False) as catalogue:
        if seed is not None:
            draw = random.Random(seed)
            chosen = f"key >= '{draw.choice('9abcdef')}'"
            anew = draw.random() < 0.5
            for analysis in analyses_named(ANALYSES):
                about = update.computation_of(analysis)
                if catalogue.standing(about)["pending"]:
                    continue
                if anew:
                    forget_whole(catalogue, analysis)
                elif sum(catalogue.standing(about, where=chosen).values()):
                    catalogue.forget(about, where=chosen, states=results.STATES)
            if draw.random() < 0.5:
                with catalogue.alone(maps.MAPS):
                    shutil.rmtree(maps.maps_folder(catalogue), ignore_errors=True)
        update.update_fleet(catalogue, ANALYSES, update.UpdateOptions(workers=0, batch=2))


def forget_whole(catalogue: Catalogue, analysis: FleetAnalysis) -> None:
    """Forget the results of both codes, and remove their files.

    All trips give the same merged file each time, and one that is there is not written again: it
    would never be found half written. Nobody names a file during a transaction that writes.
    """
    own = computation_of(analysis)
    for each in (own, replace(own, code=OTHER_CODE)):
        catalogue.forget(each, states=results.STATES)
    with catalogue.writing() as connection:
        used = sa.exists().where(table.c.file == result_files.c.id)
        named = set(connection.execute(sa.select(result_files.c.name).where(used)).scalars())
        for path in (catalogue.results_folder / analysis.name).glob("[!.]*.parquet"):
            if path.name not in named:
                path.unlink()


def run(where, kept, logs, each, at_random, together):
    """Kill updates at each point so many times, then at random, so many at once."""
    folder = Path(kept).parent
    folder.mkdir(parents=True, exist_ok=True)
    with open_catalogue(where, results=kept if "://" in where else None) as catalogue:
        catalogue.add(logs)
    work.one_thread()
    work.load_analyses()
    remember()
    updated(where, "", 1)  # what is imported and compiled is loaded once, for all that follow
    draw, forked = random.Random(together), partial(Watched, folder, POINTS, watch)
    fell: dict[str, Counter[str]] = {"named": Counter(), "random": Counter(), "beside": Counter()}
    points = [point for point in POINTS for _ in range(each)]
    draw.shuffle(points)
    runs, missed, waiting = 0, "", [*points, *[""] * at_random]
    while waiting:
        point = waiting.pop(0)
        runs += 1
        code, seed = draw.choice(["", OTHER_CODE]), draw.randrange(10**6)
        # Where it did not come so often to the point, the next is killed the first time there.
        order = (point, 1 if point == missed else draw.randint(1, 3)) if point else None
        missed = ""
        first = forked(partial(updated, where, code, seed), order)
        beside = partial(updated, where, code)
        others = [forked(beside) for _ in range(together - 1)]
        if order is None:
            first.kill_after(draw.randint(1, 60), draw.uniform(0.0, 0.05))
        status = first.wait()
        if status == -signal.SIGKILL:
            fell["named" if point else "random"][first.passed.last] += 1
        elif status == 0:
            waiting.insert(0, point)  # it did not come there
            missed = point
        else:
            raise AssertionError(f"an update failed at: {first.passed.last}")
        for other in others:
            if draw.random() < 0.5:
                other.kill_after(other.passed.total + draw.randint(0, 10), 0.0)
            status = other.wait()
            if status == -signal.SIGKILL:
                fell["beside"][other.passed.last] += 1
            elif status:
                raise AssertionError(f"an update beside failed at: {other.passed.last}")
        (folder / "fell.json").write_text(json.dumps({"runs": runs, "left": len(waiting), **fell}))
        if runs > 10 * (each * len(POINTS) + at_random + 1):
            raise AssertionError(f"never come to: {sorted(set(waiting))}")
    for code in (OTHER_CODE, ""):
        if forked(partial(updated, where, code)).wait():
            raise AssertionError("the last update failed")
    return {"runs": {"all": runs}, **fell}


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
    """How many rows of results each trip has, of all analyses."""
    with open_catalogue(catalogue) as opened, opened.reading() as connection:
        asked = sa.select(trips.c.key, sa.func.count(table.c.computation)).join(
            table, table.c.trip == trips.c.id
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
    """The maps of a folder, as their recordings give them."""
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
