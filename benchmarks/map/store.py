"""The map's file as a service: time of an update, of 10,000 trips, several processes, kills.

    python benchmarks/map/store.py [--trips 10000] [--kills 100]

- One update with one trip of an hour on a line of 100 km: the function, reading the log included,
  and the whole process.
- Two files with half of the trips each are merged, and the map of all is added up from its file.
  As the peer, what a folder of Parquet costs with pandas: each trip's rows read and grouped anew.
- Five processes add trips to one file and are killed at random instants; every trip that one
  had acknowledged must be there once.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import fields, replace
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import pandas as pd

from analysis import update_map
from analysis.adhesion.condition_map import LEVELS, empty_map
from trainlog.formats.mapfile import MapFile, Recording, merge_files
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.mcap import write_log
from trainlog.railway import Line, Station, StepProfile
from trainlog.railway.evidence import DailyEvidence
from trainlog.simulation import draw_scenarios, simulate

LENGTH = 100_000.0
DAYS = 100


def line_of_100_km() -> Line:
    """A level line with a station every 12.5 km: calling everywhere takes about an hour."""
    return replace(
        read_line(sample(DEFAULT_LINE)),
        name="100 km",
        length=LENGTH,
        stations=tuple(Station(f"S{n}", LENGTH * n / 8) for n in range(9)),
        speed_limits=StepProfile(np.array([0.0]), np.array([140.0 / 3.6])),
        gradients=StepProfile(np.array([0.0]), np.array([0.0])),
        curvatures=None,
        tunnels=(),
        geometry=None,
    )


def drawn(number: int, bins: int) -> Recording:
    """A trip that used some level in each bin and slipped in some, as analysed trips do."""
    rng = np.random.default_rng(number)
    events = (rng.uniform(size=bins) < 0.02) * rng.integers(1, 4, bins)
    weight = np.where(events > 0, np.round(rng.uniform(20.0, 60.0, bins) * 2**20) / 2**20, 0.0)
    logs = np.round(weight * np.log(rng.uniform(0.08, 0.3, bins)) * 2**20) / 2**20
    used = np.zeros((bins, LEVELS.size))
    level = np.clip(np.cumsum(rng.integers(-1, 2, bins)) + 8, 0, 25)
    used[np.arange(bins), level] = (events == 0) & (rng.uniform(size=bins) < 0.8)
    square = np.round(logs**2 / np.where(weight > 0.0, weight, 1.0) * 2**20) / 2**20
    day = 20_000 + number % DAYS
    piece = DailyEvidence.of_bins(day, events, weight, logs, used, weighted_square=square)
    entry = {"trip": f"t{number}", "sha256": f"{number:064x}", "layer": "wet", "identity": ""}
    return Recording("wet", entry, evidence={"wet": piece})


def one_update(folder: Path) -> None:
    """Time of one update with one trip."""
    line, train = line_of_100_km(), read_train(sample(DEFAULT_TRAIN))
    logs = []
    for scenario in draw_scenarios(line, train, 4, seed=1)[2:]:
        trip = simulate(scenario)
        logs.append(folder / f"{scenario.name}.mcap")
        write_log(trip, logs[-1])
        axles = trip["/train/axles"].index
        minutes = (axles[-1] - axles[0]).total_seconds() / 60.0
        print(f"{scenario.name}: {minutes:.0f} min, {logs[-1].stat().st_size / 1e6:.1f} MB")
    path = folder / "one.map"
    update_map(logs[0], path)
    times = []
    for number in range(5):
        copy = folder / f"copy-{number}.map"
        copy.write_bytes(path.read_bytes())
        begin, used = perf_counter(), process_time()
        assert len(update_map(logs[1], copy).added) == 1
        times.append((perf_counter() - begin, process_time() - used))
    (wall, processor), load = np.min(times, axis=0), os.getloadavg()[0]
    print(f"update with one trip, function: {wall:.2f} s, processor {processor:.2f} s")
    print(f"(load of the machine: {load:.1f} on {os.cpu_count()} processors)")
    words = [sys.executable, "-m", "trainlog", "map", "update", str(logs[1]), "--map", str(path)]
    for what in ("one new trip", "nothing new"):
        begin = perf_counter()
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        print(f"update with {what}, whole process: {perf_counter() - begin:.2f} s")


def many_trips(folder: Path, count: int) -> None:
    """Time to merge the files of many trips, and to add up what they hold."""
    empty = empty_map(line_of_100_km())
    recordings = [drawn(number, empty.bins) for number in range(count)]
    frames = folder / "frames"
    frames.mkdir()
    begin = perf_counter()
    for half in (0, 1):
        with MapFile(folder / f"{half}.map", empty) as file:
            file._database.execute("PRAGMA synchronous = OFF")
            for each in recordings[half::2]:
                file.append(each)
    each = (perf_counter() - begin) / count
    print(f"{count} trips appended: {1e3 * each:.1f} ms each without waiting for the disk")
    merging, adding = [], []
    for number in range(5):
        both = folder / f"both-{number}.map"
        begin, used = perf_counter(), process_time()
        merge_files([folder / "0.map", folder / "1.map"], both)
        merging.append((process_time() - used, perf_counter() - begin))
        begin, used = perf_counter(), process_time()
        with MapFile(both) as file:
            total = file.summed(file.trips()).evidence["wet"][0]
        adding.append((process_time() - used, perf_counter() - begin))
    together = sorted(one[0] + other[0] for one, other in zip(merging, adding, strict=True))
    print(
        f"two files of {count // 2} trips merged into one of"
        f" {(folder / 'both-0.map').stat().st_size / 1e6:.0f} MB:"
        f" processor {min(merging)[0]:.2f} s, {min(merging)[1]:.2f} s"
    )
    print(
        f"all added up from the file, {total.used_day.size} rows:"
        f" processor {min(adding)[0]:.2f} s, {min(adding)[1]:.2f} s"
    )
    print(f"both, processor, least and median of 5: {together[0]:.2f} s, {together[2]:.2f} s")
    part = recordings[: min(count, 1000)]
    for number, one in enumerate(part):
        used = (one.evidence or {})["wet"]
        names = [name.name for name in fields(used) if name.name.startswith("used_")]
        frame = pd.DataFrame({name: getattr(used, name) for name in names})
        frame.to_parquet(frames / f"{number}.parquet")
    begin = perf_counter()
    every = pd.concat([pd.read_parquet(path) for path in sorted(frames.iterdir())])
    every.groupby(["used_day", "used_bin", "used_level"]).sum()
    passed = (perf_counter() - begin) * count / len(part)
    print(f"peer: pandas {pd.__version__} on a folder of Parquet, {len(part)} trips timed:"
          f" {passed:.1f} s for {count}")  # fmt: skip


def killed(folder: Path, kills: int) -> None:
    """Processes killed at random instants."""
    sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
    from killed import in_own_process
    from test_map_service import check_killed

    begin = perf_counter()
    found, _ = in_own_process("killed_updaters.kill_and_append", folder, 5, kills, 20)
    check_killed(found, kills)
    print(f"5 updaters at once, {kills} kills, {perf_counter() - begin:.0f} s: every acknowledged"
          " trip is in the map once, none twice, the file readable after each")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--trips", type=int, default=10_000)
    parser.add_argument("--kills", type=int, default=100)
    options = parser.parse_args()
    chosen = ((one_update, ()), (many_trips, (options.trips,)), (killed, (options.kills,)))
    for work, given in chosen:
        if not given or given[0]:
            with tempfile.TemporaryDirectory() as folder:
                work(Path(folder), *given)


if __name__ == "__main__":
    main()
