"""How near chainage and speed from satellite fixes come to the truth of simulated trips.

    python benchmarks/chainage/benchmark_chainage.py [--seeds 4] [--line FILE ...]

Trips are driven in simulation on lines with geometry, in both directions; a receiver then errs in a
known way: noise, white or lasting for half a minute; outages of 60 s; reflections that put it tens
of metres off for tens of seconds at the stations. Each line of the table is one such receiver.
Errors are taken every second from the first to the last fix, within outages too. Beside the
estimate stands what is done without one: each fix to the nearest place of the line, straight lines
between them, speed as differences of chainage.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.ingest.chainage import estimated_state
from trainlog.ingest.profile import Profile
from trainlog.railway.geometry import nearest_on, track_of
from trainlog.simulation import draw_scenarios, simulate
from trainlog.simulation.sensors import correlated
from trainlog.topics import GNSS_FIX, GNSS_MOTION, TRAIN_STATE
from trainlog.trip import Trip, frame_of
from trainlog.units import NANOSECONDS

PROFILE = Profile(format="trainlog/recorder-profile", version=1, name="none")


@dataclass(frozen=True)
class Receiver:
    """How a receiver errs, and whether the wheels' speed is recorded beside it."""

    name: str
    rate: float = 1.0
    noise: float = 3.0
    lasting: float = 0.0
    speed_noise: float | None = 0.2
    outages: int = 4
    bursts: int = 4
    wheels: bool = False


RECEIVERS = (
    Receiver("white noise, no outage", outages=0, bursts=0),
    Receiver("1 Hz"),
    Receiver("5 Hz", rate=5.0),
    Receiver("1 Hz, wheels", wheels=True),
    Receiver("5 Hz, wheels", rate=5.0, wheels=True),
    Receiver("1 Hz, lasting 30 s", lasting=30.0),
    Receiver("5 Hz, lasting 30 s", rate=5.0, lasting=30.0),
    Receiver("1 Hz, lasting 30 s, wheels", lasting=30.0, wheels=True),
    Receiver("1 Hz, lasting, no outage", lasting=30.0, outages=0, bursts=0),
    Receiver("1 Hz, no speed", speed_noise=None),
)


@dataclass(frozen=True)
class Truth:
    """Time [ns], chainage [m] and speed [m/s] of a trip on a line as travelled."""

    line: object
    nanoseconds: np.ndarray
    position: np.ndarray
    speed: np.ndarray

    def at(self, nanoseconds):
        """Position and speed at each time."""
        elapsed = (self.nanoseconds - self.nanoseconds[0]) / NANOSECONDS
        asked = (nanoseconds - self.nanoseconds[0]) / NANOSECONDS
        return np.interp(asked, elapsed, self.position), np.interp(asked, elapsed, self.speed)


@cache
def driven(path: Path, seed: int) -> Truth:
    line, train = read_line(path), read_train(sample(DEFAULT_TRAIN))
    scenario = replace(
        draw_scenarios(line, train, 1, seed)[0], direction=("forward", "reverse")[seed % 2]
    )
    truth = simulate(scenario)["/truth"]
    return Truth(
        line.reversed() if seed % 2 else line,
        truth.index.as_unit("ns").asi8,
        truth["position"].to_numpy(),
        truth["speed"].to_numpy(),
    )


def received(truth: Truth, receiver: Receiver, seed: int) -> Trip:
    """What the receiver makes of a trip."""
    generator = np.random.default_rng(seed)
    period = round(NANOSECONDS / receiver.rate)
    ticks = np.arange(truth.nanoseconds[0], truth.nanoseconds[-1], period)
    seconds = (ticks - ticks[0]) / NANOSECONDS
    position, speed = truth.at(ticks)
    if receiver.lasting:
        error = [
            correlated(ticks.size, 1.0 / receiver.rate, receiver.lasting, generator) for _ in "en"
        ]
        error = error[0] + 1j * error[1]
    else:
        error = generator.standard_normal(ticks.size) + 1j * generator.standard_normal(ticks.size)
    error = receiver.noise * error
    stands = np.flatnonzero(speed < 0.1)
    for _ in range(receiver.bursts):
        begin = seconds[generator.choice(stands)] - generator.uniform(0.0, 20.0)
        hit = (seconds > begin) & (seconds < begin + generator.uniform(10.0, 40.0))
        size = generator.uniform(15.0, 60.0)
        error[hit] += size * np.exp(2j * np.pi * generator.uniform())
    latitude, longitude = truth.line.geometry.at(position)
    metre = np.degrees(1.0 / 6_371_000.0)
    seen = np.ones(ticks.size, dtype=bool)
    for begin in generator.uniform(60.0, seconds[-1] - 120.0, receiver.outages):
        seen &= (seconds < begin) | (seconds > begin + 60.0)
    topics = [
        frame_of(
            GNSS_FIX,
            ticks[seen],
            {
                "latitude": (latitude + error.imag * metre)[seen],
                "longitude": (longitude + error.real * metre / np.cos(np.radians(latitude)))[seen],
                "horizontal_accuracy": np.full(seen.sum(), receiver.noise),
            },
        )
    ]
    if receiver.speed_noise is not None:
        noisy = np.abs(speed + receiver.speed_noise * generator.standard_normal(ticks.size))
        accuracy = np.full(seen.sum(), receiver.speed_noise)
        topics.append(
            frame_of(GNSS_MOTION, ticks[seen], {"speed": noisy[seen], "speed_accuracy": accuracy})
        )
    if receiver.wheels:
        topics.append(wheels(truth, generator))
    return Trip({topic.attrs["topic"]: topic for topic in topics}, {"trip": "t"})


def wheels(truth: Truth, generator):
    """Speed from the wheels at 10 Hz: a wrong diameter, noise, and slip every few minutes."""
    ticks = np.arange(truth.nanoseconds[0], truth.nanoseconds[-1], 100_000_000)
    _, speed = truth.at(ticks)
    measured = speed * (1.0 + 0.005 * generator.standard_normal())
    for begin in generator.uniform(0, ticks.size, int(ticks.size / 2000)).astype(int):
        slip = np.interp(np.arange(60), [0, 10, 50, 60], [0.0, 0.15, 0.15, 0.0])
        measured[begin : begin + 60] *= 1.0 + slip[: measured[begin : begin + 60].size]
    measured = np.where(
        speed > 0.0, measured + 0.05 * generator.standard_normal(measured.size), 0.0
    )
    return frame_of(TRAIN_STATE, ticks, {"speed": np.maximum(measured, 0.0)})


def errors(path: Path, receiver: Receiver, seed: int):
    """Errors of the estimate and of the naive way every second, with what they cost."""
    truth = driven(path, seed)
    trip = received(truth, receiver, seed)
    start = time.process_time()
    estimate = estimated_state(trip, truth.line, PROFILE)
    spent = time.process_time() - start
    frame = estimate.frame
    index = frame.index.as_unit("ns").asi8
    ticks = np.arange(index[0], index[-1], NANOSECONDS)
    position, speed = truth.at(ticks)

    def measured(times, values):
        return np.interp((ticks - ticks[0]) / NANOSECONDS, (times - ticks[0]) / NANOSECONDS, values)

    fix = trip["/gnss/fix"]
    track = track_of(truth.line.geometry)
    near, _ = nearest_on(
        track, track.plane(fix["latitude"].to_numpy(), fix["longitude"].to_numpy())
    )
    times = fix.index.as_unit("ns").asi8
    naive = measured(times, near)
    raw = measured(times[1:], np.diff(near) / np.diff(times / NANOSECONDS))
    return {
        "position": measured(index, frame["position"]) - position,
        "position_std": measured(index, frame["position_std"]),
        "speed": measured(index, frame["speed"]) - speed,
        "speed_std": measured(index, frame["speed_std"]),
        "naive": naive - position,
        "raw": raw - speed,
        "spent": np.array([spent]),
        "misfit": np.array([float(estimate.metadata["line.misfit"])]),
    }


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def inside(found, name):
    return np.mean(np.abs(found[name]) <= 1.96 * found[f"{name}_std"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--line", type=Path, nargs="*", default=[sample(DEFAULT_LINE)])
    options = parser.parse_args()
    for path in options.line:
        print(f"\n{read_line(path).name}, {options.seeds} trips, both directions")
        print(
            f"{'':28s} {'position [m]':>24s}   {'speed [m/s]':>17s}   nearest  differences"
            "\n"
            f"{'receiver':28s} {'RMS':>6s} {'worst':>6s} {'95 %':>6s} {'band':>5s}"
            f"   {'RMS':>5s} {'95 %':>5s} {'band':>5s}   {'RMS [m]':>7s}  {'RMS [m/s]':>11s}"
            "  misfit   CPU [s]"
        )
        for receiver in RECEIVERS:
            single = [errors(path, receiver, seed) for seed in range(1, options.seeds + 1)]
            found = {name: np.concatenate([one[name] for one in single]) for name in single[0]}
            print(
                f"{receiver.name:28s} {rms(found['position']):6.2f}"
                f" {max(rms(one['position']) for one in single):6.2f}"
                f" {np.quantile(np.abs(found['position']), 0.95):6.2f}"
                f" {inside(found, 'position'):5.1%}"
                f"   {rms(found['speed']):5.2f} {np.quantile(np.abs(found['speed']), 0.95):5.2f}"
                f" {inside(found, 'speed'):5.1%}   {rms(found['naive']):7.1f}"
                f"  {rms(found['raw']):11.1f}  {found['misfit'].max():6.1f}"
                f"  {found['spent'].mean():8.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
