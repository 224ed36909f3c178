"""Peak memory of a catalogue and of the analyses of a fleet over logs of any length.

    python benchmarks/fleet/benchmark_long_logs.py [--sizes 0.1,1,10] [--folder FOLDER]

writes logs of so many GB as a recorder that never stops makes them: the sample trips one after the
other, ten minutes apart, accelerations at 1 kHz, axles at 200 Hz, everything else as it was
recorded. Nothing but a trip is in memory while they are written. Each is registered and computed by
the commands ``trainlog fleet add`` and ``trainlog fleet update``, each in a process of its own:
largest memory (resident), processor time, parts. The logs are deleted afterwards.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

import trainlog
from trainlog.catalogue import open_catalogue
from trainlog.mcap import LogWriter
from trainlog.topics import IMU, TRAIN_AXLES, TRAIN_STATE, TRUTH
from trainlog.trip import Trip
from trainlog.units import NANOSECONDS

SAMPLES = ("sample_logs/nonstop.mcap", "sample_logs/stopping.mcap")

ACCELERATIONS = 1000.0
"""Rate of the accelerations [Hz]."""

AXLES = 200.0
"""Rate of the axles [Hz]."""

BETWEEN = pd.Timedelta(minutes=10)
"""Between two trips."""

VIBRATION = 0.5
"""Standard deviation of each acceleration about that of the train [m/s²]."""


LAUNCH = """
import os, sys
pid = os.posix_spawn(sys.argv[1], sys.argv[1:], os.environ)
_, status, used = os.wait4(pid, 0)
print(used.ru_maxrss, used.ru_utime + used.ru_stime, file=sys.stderr)
sys.exit(os.waitstatus_to_exitcode(status))
"""


class Measured(NamedTuple):
    """A command that was run: largest memory [bytes], processor time [s]."""

    memory: float
    seconds: float


def written(path: Path, size: float, axles: float = AXLES, seed: int = 1) -> float:
    """A log of at least so many bytes, with axles at a rate [Hz]; the hours that it holds."""
    rng = np.random.default_rng(seed)
    whole = [trainlog.read(log) for log in SAMPLES]
    shared = set.intersection(*(set(trip.topics) for trip in whole)) - {TRUTH.name}
    first, at, number = whole[0], whole[0].start, 0
    with LogWriter(path) as log:
        while number < 2 or _size(path) < size:
            trip = whole[number % len(whole)]
            topics = {name: trip[name] for name in sorted(shared)}
            topics[TRAIN_AXLES.name] = _finer(topics[TRAIN_AXLES.name], axles, rng)
            topics[IMU.name] = _accelerations(trip[TRAIN_STATE.name], rng)
            moved = {name: _later(frame, at - trip.start) for name, frame in topics.items()}
            log.add(Trip(moved, first.metadata, first.provenance, first.attachments))
            at += trip.end - trip.start + BETWEEN
            number += 1
    return float((at - first.start) / pd.Timedelta(hours=1))


def _size(path: Path) -> int:
    """Of the file that takes the place of a log once it is whole."""
    return max((each.stat().st_size for each in path.parent.glob(f".{path.stem}-*")), default=0)


def _clock(frame: pd.DataFrame, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Instants of a rate in the time of a frame, and its own [ns]."""
    own = pd.DatetimeIndex(frame.index).as_unit("ns").asi8
    return np.arange(own[0], own[-1], round(NANOSECONDS / rate)), own


def _finer(frame: pd.DataFrame, rate: float, rng: np.random.Generator) -> pd.DataFrame:
    """The same course at a higher rate, each value with the noise of a sensor of 12 bits."""
    clock, own = _clock(frame, rate)
    columns = {}
    for name in frame:
        values = frame[name].to_numpy(np.float64)
        step = max(float(np.nanmax(np.abs(values))), 1.0) / 4096.0
        columns[name] = np.interp(clock, own, values) + rng.normal(0.0, step / 4.0, clock.size)
    return _framed(columns, clock, frame)


def _accelerations(state: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """What an inertial unit in a car records: the train's acceleration, gravity, vibration."""
    clock, own = _clock(state, ACCELERATIONS)
    columns = {each.name: rng.normal(0.0, VIBRATION, clock.size) for each in IMU.fields}
    columns["specific_force_x"] += np.interp(clock, own, state["acceleration"].to_numpy())
    columns["specific_force_z"] += 9.81
    found = _framed(columns, clock, state)
    found.attrs = {"topic": IMU.name, "units": {each.name: each.unit for each in IMU.fields}}
    return found


def _framed(columns: dict[str, np.ndarray], clock: np.ndarray, like: pd.DataFrame) -> pd.DataFrame:
    index = pd.DatetimeIndex(clock, tz="UTC", name=like.index.name)
    found = pd.DataFrame(columns, index=index)
    found.attrs = like.attrs
    return found


def _later(frame: pd.DataFrame, by: pd.Timedelta) -> pd.DataFrame:
    moved = frame.set_axis(frame.index + by)
    moved.attrs = frame.attrs
    return moved


def measured(*words: str) -> Measured:
    """Run a command of trainlog; its largest memory and processor time.

    By a process between that holds nothing: to the system the largest memory of a process begins
    with that of the one that started it.
    """
    command = [sys.executable, "-c", LAUNCH, sys.executable, "-m", "trainlog", *words]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=True)
    memory, seconds = done.stderr.split()[-2:]
    return Measured(1024.0 * float(memory), float(seconds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", default="0.1,1,10")
    parser.add_argument("--folder", help="where the logs are written; default: a temporary folder")
    parser.add_argument("--axles", type=float, default=AXLES, help="rate of the axles [Hz]")
    given = parser.parse_args()
    print(
        f"{'log, MB':>10} {'hours':>6} {'parts':>6} {'add, MB':>8} {'add, s':>7}"
        f" {'update, MB':>11} {'update, s':>10} {'written, s':>11}  states"
    )
    for size in (float(each) for each in given.sizes.split(",")):
        with tempfile.TemporaryDirectory(dir=given.folder) as name:
            path, catalogue = Path(name) / "long.mcap", str(Path(name) / "catalogue")
            began = time.process_time()
            hours = written(path, 1e9 * size, given.axles)
            wrote = time.process_time() - began
            at = ("--catalogue", catalogue)
            added = measured("fleet", "add", str(path), *at)
            updated = measured("fleet", "update", "--workers", "0", *at)
            with open_catalogue(catalogue) as opened:
                known = opened.computations()["analysis"].tolist()
                known.remove("maps")
                states = {each: opened.outcomes(each)["state"].iloc[0] for each in sorted(known)}
                parts = len(opened.results("checks"))
            print(
                f"{path.stat().st_size / 1e6:10.0f} {hours:6.1f} {parts:6d}"
                f" {added.memory / 1e6:8.0f} {added.seconds:7.1f} {updated.memory / 1e6:11.0f}"
                f" {updated.seconds:10.1f} {wrote:11.1f}  {states}",
                flush=True,
            )


if __name__ == "__main__":
    main()
