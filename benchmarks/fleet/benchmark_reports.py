"""How much of a fleet's map and resistance is left where trains report less than they record.

    python benchmarks/fleet/benchmark_reports.py FOLDER -o OUT [--only NAME ...] [--jobs 2]

FOLDER is that of `trainlog simulate fleet`, such as ``drawn:3 --trains 12 --days 30 --count 360``.
Its logs are reduced to what a train might send, each variant goes through ``fleet add`` and ``fleet
update`` in a catalogue of its own in OUT, and is judged by `judge_fleet`.

- ``full``: as recorded, 5 to 10 Hz;
- ``1 s``, ``5 s``: all topics, at most a row in so many seconds;
- ``5 s, no axles``: without the speeds of axles; slip protection is noted as an event;
- ``5 s, no efforts``: without levers and efforts, too: what status reports of SFERA hold, position,
  speed, and slip as a flag.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import pandas as pd
from judge_fleet import (
    Judged,
    drawn_again,
    judge_forecast,
    judge_map,
    judge_resistance,
    judge_trips,
)

import trainlog
from trainlog.catalogue import open_catalogue
from trainlog.cli.main import run
from trainlog.cli.terminal import console
from trainlog.processes import in_processes
from trainlog.topics import SLIP_PROTECTION
from trainlog.trip import Trip

AXLES, CONTROLS, STATE, EVENTS = "/train/axles", "/train/controls", "/train/state", "/events"

VARIANTS: dict[str, tuple[float, tuple[str, ...]]] = {
    "full": (0.0, ()),
    "1 s": (1.0, ()),
    "5 s": (5.0, ()),
    "5 s, no axles": (5.0, (AXLES,)),
    "5 s, no efforts": (5.0, (AXLES, CONTROLS, "/gnss/fix", "/gnss/motion", "/environment")),
}
"""Seconds between rows, and topics that are not sent."""


def reduced(trip: Trip, every: float, without: tuple[str, ...]) -> Trip:
    """What a train reports of a trip."""
    frames = dict[str, pd.DataFrame]()
    for name in trip:
        if name in without:
            continue
        frame = trip[name]
        if name == EVENTS:
            kept = (frame["name"] == SLIP_PROTECTION) | frame["message"].str.startswith(
                SLIP_PROTECTION
            )
            frames[name] = frame[kept] if without else frame
        elif every:
            ticks = (frame.index - trip.start) // pd.Timedelta(seconds=every)
            frames[name] = frame[~ticks.duplicated()]
        else:
            frames[name] = frame
    return Trip(frames, trip.metadata, trip.provenance, trip.attachments)


def _write(given: tuple[float, tuple[str, ...]], logs: list[tuple[Path, Path]]) -> int:
    every, without = given
    for source, target in logs:
        target.parent.mkdir(parents=True, exist_ok=True)
        trainlog.write(reduced(trainlog.read(source), every, without), target)
    return len(logs)


def variant(folder: Path, out: Path, name: str, jobs: int) -> Path:
    """The logs of one variant, made if need be."""
    every, without = VARIANTS[name]
    if not every:
        return folder
    target = out / name.replace(" ", "-").replace(",", "")
    pairs = [(log, target / log.relative_to(folder)) for log in sorted(folder.rglob("*.mcap"))]
    pairs = [pair for pair in pairs if not pair[1].exists()]
    parts = [pairs[at : at + 12] for at in range(0, len(pairs), 12)]
    for _ in in_processes(_write, (every, without), parts, jobs):
        pass
    return target


def judged(folder: Path, logs: Path, where: Path, jobs: int) -> None:
    """Update a catalogue of the logs, and print what it comes to."""
    began = time.perf_counter()
    for words in (
        ["fleet", "add", str(logs), "--catalogue", str(where), "--quiet"],
        ["fleet", "update", "--catalogue", str(where), "--quiet", "--workers", str(jobs)],
    ):
        run(words)
    console.print(f"  updated in {time.perf_counter() - began:.0f} s")
    with open_catalogue(str(where)) as catalogue:
        given = Judged(folder, catalogue, drawn_again(folder), where / "truths.parquet")
        for judge in (judge_trips, judge_resistance, judge_map, judge_forecast):
            try:
                judge(given)
            except Exception as error:  # noqa: BLE001 - with too little nothing can be judged
                console.print(f"  {judge.__name__}: nothing to judge ({error})")


def main() -> None:
    """The command at the top."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--only", nargs="+", choices=tuple(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        console.print(f"\n=== {name}")
        logs = variant(options.folder, options.output, name, options.jobs)
        size = sum(log.stat().st_size for log in logs.rglob("*.mcap")) / 1e6
        console.print(f"  {size:.0f} MB of logs")
        where = options.output / f"catalogue-{logs.name}"
        judged(options.folder, logs, where, options.jobs)


if __name__ == "__main__":
    main()
