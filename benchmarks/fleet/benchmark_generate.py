"""How fast a fleet is simulated: processor time a trip by step, size of its logs, memory.

    python benchmarks/fleet/benchmark_generate.py [--trips 60] [--jobs 2]

Trips of all kinds, one after the other in this process, timed by its processor time from the
drawing of the trip to the written log. Then the same fleet by `write_fleet` in several processes,
on the wall.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from trainlog.mcap import write_log
from trainlog.simulation import (
    Fleet,
    as_recorded,
    draw_fleet,
    draw_network,
    drive,
    recorded,
    write_fleet,
)

STEPS = ("draw", "drive", "record", "write")


def timed(fleet: Fleet, number: int, folder: Path) -> tuple[list[float], float, float, int]:
    """Processor time of each step [s], duration [s] and distance [m] of the trip, size [B]."""
    clock = [time.process_time()]
    scenario = fleet.scenario(number)
    clock.append(time.process_time())
    run = drive(scenario)
    clock.append(time.process_time())
    trip = as_recorded(recorded(scenario, run), fleet.train_of(number))
    clock.append(time.process_time())
    log = folder / "trip.mcap"
    write_log(trip, log)
    clock.append(time.process_time())
    steps = np.diff(clock).tolist()
    return steps, trip.duration, scenario.stops[-1].position, log.stat().st_size


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--trips", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--days", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    fleet = draw_fleet(
        draw_network(options.seed), days=options.days, trips=options.trips, seed=options.seed
    )
    begun = time.process_time()
    for edge in fleet.network.edges:
        fleet.rail(edge.name)
    for roster in fleet.rosters:
        for route in roster.routes:
            fleet.route(*route)
    shared = time.process_time() - begun
    rows = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        timed(fleet, 0, Path(folder))  # compiles, or reads what was compiled
        for number in range(options.trips):
            found = timed(fleet, number, Path(folder))
            for kind in (fleet.train_of(number).kind, "all"):
                rows[kind].append([*found[0], *found[1:]])
    print(f"rail, weather and routes of a process, once: {shared:.1f} s")
    print("| kind | trips | min | km | " + " | ".join(f"{step} ms" for step in STEPS), end="")
    print(" | sum ms | times real time | MB |")
    print("|---|" + "---|" * (len(STEPS) + 6))
    for kind in sorted(rows, key=lambda each: (each == "all", each)):
        table = np.array(rows[kind])
        mean = table.mean(axis=0)
        total = table[:, : len(STEPS)].sum(axis=1)
        slowest = np.min(table[:, -3] / total)
        print(
            f"| {kind} | {len(table)} | {mean[-3] / 60.0:.1f} | {mean[-2] / 1e3:.1f} | "
            + " | ".join(f"{1e3 * each:.0f}" for each in mean[: len(STEPS)])
            + f" | {1e3 * total.mean():.0f} | {mean[-3] / total.mean():,.0f}"
            f" (slowest {slowest:,.0f}) | {mean[-1] / 1e6:.2f} |"
        )
    with tempfile.TemporaryDirectory() as folder:
        logs = write_fleet(fleet, folder, options.jobs)
    print(
        f"{options.jobs} processes: {logs.made} trips, {logs.duration / 3600.0:.1f} h,"
        f" {logs.distance / 1e3:.0f} km, {logs.size / 1e9:.3f} GB in {logs.elapsed:.0f} s"
        f" on the wall, {logs.duration / logs.elapsed:,.0f} times real time"
    )
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3
    print(f"largest process of the pool: {children:.0f} MB")


if __name__ == "__main__":
    main()
