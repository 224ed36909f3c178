"""The figures of the product beside those of an earlier revision: what a simplification moved.

    python benchmarks/structure/benchmark_frozen.py [--part PART ...] [--renew]

A simplification must leave the figures equal. Each part computes some, as lines of text; the
numbers in them are compared with those in ``frozen.json``, to the tolerance stated for the part,
and every line that differs is printed, as it was and as it is. ``--renew`` stores them instead.

Parts:

- files: hashes of the samples, of the tests' stored logs, and of the samples written anew
- passports: delay, ratio of effort to mass and gain of two trips, as recorded and with efforts that
  are late or wrong in size
- plans: worst-case energy and gaps of the problems of ``benchmark_random`` that take little time
- identification: ``benchmark_identification`` on 40 trips
- recorded: ``benchmark_recorded`` on five defects
- trains: ``benchmark_trains``, faults with a channel missing and drift, on drawn trains
- map: ``by_trips`` on the three lines, 20 trips
- names: commands with their numbers of options, and public names
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from trainlog.errors import TrainlogError
from trainlog.formats.files import atomic_write

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = ROOT / "benchmarks"
STORED = Path(__file__).with_name("frozen.json")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
TIMES = re.compile(r"processor time|^\d+ s$|s a file; \d+ s in all|\d+ s in all")
LEFT_OUT = {1, 9, 14, 21, 24, 26, 34, 37, 42, 48, 57}
"""Problems whose search depends on a time limit, or takes long."""


def files() -> Iterator[str]:
    """Hash of each file, and of each written anew."""
    from trainlog.formats.railway import read_line, read_train, write_line, write_train

    folders = (ROOT / "sample_logs", ROOT / "tests" / "data")
    for path in sorted(each for folder in folders for each in folder.rglob("*")):
        if path.is_file() and path.suffix in (".mcap", ".json", ".map", ".parquet", ".sql"):
            yield f"{path.relative_to(ROOT)} {_hash(path)}"
    again: dict[str, tuple[Callable, Callable]] = {
        ".line.json": (read_line, write_line),
        ".train.json": (read_train, write_train),
    }
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted((ROOT / "sample_logs").iterdir()):
            for ending, (read, write) in again.items():
                if path.name.endswith(ending):
                    write(read(path), Path(folder) / path.name)
                    yield f"{path.name} written anew {_hash(Path(folder) / path.name)}"


def _hash(path: Path) -> str:
    return "sha256:" + hashlib.sha256(path.read_bytes()).hexdigest()


def passports() -> Iterator[str]:
    """Of two trips whose efforts are recorded late, or wrong in size."""
    from analysis.resistance.passport import estimated_passport, with_effort_delay
    from trainlog import read, sample

    for name in ("nonstop", "stopping"):
        trip = read(sample(f"{name}.mcap"))
        for late, gain in ((0.0, 1.0), (0.7, 1.0), (1.4, 1.05), (-0.3, 0.9)):
            moved = with_effort_delay(trip, -late)
            controls = moved["/train/controls"].copy()
            efforts = [column for column in controls.columns if "effort" in column]
            controls[efforts] *= gain
            controls.attrs = moved["/train/controls"].attrs
            found = estimated_passport(moved.with_topic(controls))
            parts = (found.effort_delay, found.motion_delay, found.effort_over_mass)
            values = ", ".join(f"{each.value:.4f} {each.std:.4f}" for each in parts)
            yield f"{name}, {late:+.1f} s, times {gain}: {values}"


def plans() -> Iterator[str]:
    """Energy and gap of each random problem; or that it is refused."""
    sys.path.insert(0, str(BENCHMARKS / "trajectory"))
    from benchmark_random import random_problem

    from analysis.trajectory.optimiser import optimise

    for number in (each for each in range(60) if each not in LEFT_OUT):
        try:
            found = optimise(random_problem(number)).certificate
        except TrainlogError as refused:
            yield f"problem-{number}: refused, {type(refused).__name__}"
            continue
        gap = 100.0 * float(found["gap"])
        certified = "certified" if found["certified"] else "not certified"
        yield f"problem-{number}: {found['energy'] / 3.6e6:.5f} kWh, gap {gap:.2f} %, {certified}"


def _printed(script: str, *options: str) -> Iterator[str]:
    """The lines that a benchmark prints, without times."""
    command = [sys.executable, str(BENCHMARKS / script), *options]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    if not ended.stdout:
        raise SystemExit(f"{script} printed nothing: {ended.stderr[-2000:]}")
    for line in ended.stdout.splitlines():
        if line.strip() and not TIMES.search(line):
            yield " ".join(line.split())


def identification() -> Iterator[str]:
    """Errors and coverage of fitted curves."""
    return _printed("identification/benchmark_identification.py", "--trips", "40")


def recorded() -> Iterator[str]:
    """Accuracy of ingested recordings with defects."""
    defects = "none|clock set back by 2 s, whole|wraps at 10 km|5 Hz|efforts 0.2 s late"
    return _printed("recorded/benchmark_recorded.py", "--only", defects)


def trains() -> Iterator[str]:
    """Faults and drift found on drawn fleets."""
    for part in ("missing", "drift"):
        yield from _printed("fleet/benchmark_trains.py", "--part", part, "--seeds", "1")


def maps() -> Iterator[str]:
    """Error and coverage of the map by number of trips."""
    return _printed("map/by_trips.py", "--seeds", "1", "--trips", "20")


def names() -> Iterator[str]:
    """Commands and public names."""
    import typer

    from trainlog.cli.main import app

    def below(group: Any, words: str) -> Iterator[str]:
        context = typer.Context(group)
        for name in sorted(group.list_commands(context)):
            each = group.get_command(context, name)
            if hasattr(each, "list_commands"):
                yield from below(each, f"{words}{name} ")
            else:
                yield f"command {words}{name}: {len(each.params)} options"

    yield from below(typer.main.get_command(app), "")
    for package in ("trainlog", "analysis", "estimators"):
        for name in importlib.import_module(package).__all__:
            yield f"name {package}.{name}"


PARTS: dict[str, tuple[Callable[[], Iterator[str]], float]] = {
    "files": (files, 0.0),
    "passports": (passports, 1e-3),
    "plans": (plans, 1e-4),
    "identification": (identification, 0.02),
    "recorded": (recorded, 0.02),
    "trains": (trains, 0.02),
    "map": (maps, 0.02),
    "names": (names, 0.0),
}
"""What is computed, and how far its numbers may differ: a share of the value."""


def equal(was: str, now: str, tolerance: float) -> bool:
    """Whether two lines say the same, their numbers to the tolerance and a unit of the last digit.

    >>> equal("error 1.302 m", "error 1.303 m", 0.0), equal("error 1.3 m", "error 1.5 m", 0.02)
    (True, False)
    """
    if NUMBER.sub("#", was) != NUMBER.sub("#", now):
        return False
    for old, new in zip(NUMBER.findall(was), NUMBER.findall(now), strict=True):
        last = 10.0 ** -len(old.partition("e")[0].partition(".")[2]) if "." in old else 0.0
        if abs(float(new) - float(old)) > tolerance * abs(float(old)) + 1.001 * last:
            return False
    return True


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--renew", action="store_true", help="store the figures")
    options = parser.parse_args()
    stored = json.loads(STORED.read_text("utf-8")) if STORED.exists() else {}
    moved = 0
    for part in options.part:
        compute, tolerance = PARTS[part]
        lines = list(compute())
        if options.renew:
            stored[part] = lines
            with atomic_write(STORED) as path:
                path.write_text(json.dumps(stored, indent=1, ensure_ascii=False) + "\n", "utf-8")
            print(f"{part}: {len(lines)} lines stored", flush=True)
            continue
        was = stored[part]
        if tolerance > 0.0 and len(lines) == len(was):
            pairs = list(zip(was, lines, strict=True))
            off = [f"  was {a}\n  is  {b}" for a, b in pairs if not equal(a, b, tolerance)]
        else:
            off = [f"  was {each}" for each in was if each not in lines]
            off += [f"  is  {each}" for each in lines if each not in was]
        moved += len(off)
        print(f"{part}: {len(lines)} lines, {len(off)} moved", *off, sep="\n", flush=True)
    return int(moved > 0)


if __name__ == "__main__":
    sys.exit(main())
