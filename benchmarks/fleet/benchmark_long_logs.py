"""Peak memory of the analyses of a fleet over logs of any length.

    python benchmarks/fleet/benchmark_long_logs.py [--sizes 0.1,1,10]

writes logs of so many GB, the sample trips one after the other as a recorder that never stops
records them, and computes all analyses of each in a process of its own: largest memory (resident),
parts, processor time. The logs are deleted afterwards.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import pandas as pd

import trainlog
from trainlog.mcap import LogWriter
from trainlog.trip import Trip

SAMPLES = ("sample_logs/nonstop.mcap", "sample_logs/stopping.mcap")

MEASURE = """
import json, resource, sys
from analysis.fleet.analyses import analyses_named
from analysis.fleet.work import Batch, Job, begin_worker, computed
from trainlog.formats.files import sha256_of

begin_worker(watched=False)
analyses = analyses_named()
found = computed(Batch((Job("k", sha256_of(sys.argv[1]), sys.argv[1], tuple(range(5))),), analyses))
print(json.dumps({
    "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    "parts": found.tables[0].num_rows,
    "states": [each[0].state for each in found.outcomes],
    "seconds": found.seconds,
}))
"""


def written(path: Path, size: float) -> None:
    """A log of so many bytes: the sample trips again and again, a quarter of an hour apart."""
    trips = [trainlog.read(log) for log in SAMPLES]
    trips = [replace(t, topics={n: f for n, f in t.topics.items() if n != "/truth"}) for t in trips]
    topics = {name for trip in trips for name in trip.topics}
    at = trips[0].start
    each = sum(Path(log).stat().st_size for log in SAMPLES) / len(SAMPLES)
    with LogWriter(path) as log:
        for number in range(math.ceil(size / each)):
            trip = trips[number % 2]
            log.add(_later(trip, at - trip.start, topics, trips[0]))
            at += trip.end - trip.start + pd.Timedelta(minutes=10)


def _later(trip: Trip, by: pd.Timedelta, topics: set[str], first: Trip) -> Trip:
    moved = {}
    for name in topics & set(trip.topics):
        frame = trip[name]
        moved[name] = frame.set_axis(frame.index + by)
        moved[name].attrs = frame.attrs
    return Trip(moved, first.metadata, first.provenance, first.attachments)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", default="0.1,1,10")
    sizes = [float(each) for each in parser.parse_args().sizes.split(",")]
    print(f"{'log, MB':>10} {'parts':>6} {'memory, MB':>11} {'processor, s':>13}")
    with tempfile.TemporaryDirectory() as name:
        for size in sizes:
            path = Path(name) / "long.mcap"
            written(path, 1e9 * size)
            done = subprocess.run(
                [sys.executable, "-c", MEASURE, str(path)],
                check=True,
                stdout=subprocess.PIPE,
                text=True,
            )
            found = json.loads(done.stdout)
            print(
                f"{path.stat().st_size / 1e6:10.0f} {found['parts']:6d}"
                f" {found['memory'] / 1e6:11.0f} {found['seconds']:13.1f}  {found['states']}",
                flush=True,
            )
            path.unlink()


if __name__ == "__main__":
    main()
