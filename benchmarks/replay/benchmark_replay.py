"""Time and memory of drawing long trips: one in full, and many over each other by position.

    python benchmarks/replay/benchmark_replay.py [--count 50] [--folder /tmp/long-trips]

Writes logs of trips of an hour, 12 axles at 100 Hz (about 90 MB each), into a folder that is
removed afterwards. States processor time, wall-clock time, and the largest memory so far.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from long_trips import write_long_trips

from trainlog.cli.options import part_of
from trainlog.replay import ReplayOptions, write_replay

PIECE = 200_000


def measured(name: str, work: Callable[[], object]) -> None:
    """Run it once and print what it took."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"{name}: {processor:.1f} s of processor time, {wall:.1f} s, {memory:.0f} MB", flush=True)


def main() -> None:
    """Make the logs, draw them, remove them."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--count", type=int, default=50)
    arguments.add_argument("--folder", type=Path)
    given = arguments.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp(prefix="long-trips-"))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        logs = write_long_trips(folder, given.count)
        size = sum(log.stat().st_size for log in logs)
        print(f"{len(logs)} logs, {size / 1e9:.1f} GB")
        whole = [partial(part_of, log, None, None, None, PIECE) for log in logs]
        part = [partial(part_of, log, None, None, "30:32", PIECE) for log in logs]
        target, full = folder / "replay.rrd", ReplayOptions(thinned=False)
        measured("one trip in full", lambda: write_replay(whole[:1], target))
        measured(f"{len(logs)} trips, thinned", lambda: write_replay(whole, target))
        print(f"  {target.stat().st_size / 1e6:.0f} MB")
        ten = part[:10]
        measured(
            f"2 km of {len(ten)} trips in full", lambda: write_replay(ten, target, options=full)
        )
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
