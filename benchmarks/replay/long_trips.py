"""Trips of an hour for the replay's benchmarks: 12 axles at 100 Hz, ten million scalars each."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trainlog.formats.railway import line_to_bytes
from trainlog.mcap import write_log
from trainlog.railway import Geometry, Line, Station, StepProfile
from trainlog.topics import (
    ENVIRONMENT,
    GNSS_FIX,
    GNSS_MOTION,
    TRAIN_AXLES,
    TRAIN_CONTROLS,
    TRAIN_STATE,
)
from trainlog.trip import LINE_ATTACHMENT, Trip, frame_of

START = 1_790_000_000 * 10**9
DAY = 86_400 * 10**9
RATE, SECONDS, AXLES = 100, 3600, 12
STATIONS = 12
LENGTH = 90_000.0

LINE = Line(
    name="main line",
    length=LENGTH,
    stations=tuple(
        Station(f"Station {i + 1}", float(at))
        for i, at in enumerate(np.linspace(0.0, LENGTH, STATIONS))
    ),
    speed_limits=StepProfile(np.array([0.0, 30e3, 60e3]), np.array([40.0, 35.0, 40.0])),
    gradients=StepProfile(np.array([0.0, 20e3, 50e3]), np.array([0.004, -0.008, 0.002])),
    geometry=Geometry(
        np.linspace(0.0, LENGTH, 200),
        47.0 + 0.05 * np.sin(np.linspace(0.0, 6.0, 200)),
        np.linspace(8.0, 9.1, 200),
        "made up",
    ),
)


def long_trip(seed: int) -> Trip:
    """An hour from end to end, calling at every station; drivers and dwell times differ."""
    random = np.random.default_rng(seed)
    seconds = np.arange(SECONDS * RATE) / RATE
    period = SECONDS / (STATIONS - 1)
    phase = (seconds + random.uniform(-4.0, 4.0)) % period
    dwell = random.uniform(20.0, 40.0)
    shape = np.clip(np.minimum((phase - dwell) / 60.0, (period - phase) / 40.0), 0.0, 1.0)
    speed = shape * (1.0 + 0.03 * np.sin(seconds / random.uniform(50.0, 90.0)))
    position = np.cumsum(speed)
    scale = (LENGTH - 1.0) / position[-1]
    speed, position = speed * scale * RATE, position * scale
    acceleration = np.gradient(speed, 1.0 / RATE)
    force = 2e5 * acceleration + 5e3 + 8.0 * speed**2
    pull, brake = np.maximum(force, 0.0) * (speed > 0.0), np.maximum(-force, 0.0)
    noise = random.normal(0.0, 0.05, (seconds.size, AXLES))
    wheels = speed[:, None] + noise
    efforts = (force / AXLES)[:, None] + 100.0 * noise
    time = START + seed * DAY + np.round(seconds * 1e9).astype(np.int64)
    rare = slice(None, None, RATE)
    latitude, longitude = LINE.geometry.at(position[rare])
    return Trip(
        {
            frame.attrs["topic"]: frame
            for frame in (
                frame_of(TRAIN_STATE, time, {"position": position, "speed": np.round(speed, 3)}),
                frame_of(
                    TRAIN_CONTROLS,
                    time,
                    {
                        "lever": np.sign(force) * (np.abs(force) > 1e4),
                        "tractive_effort": np.round(pull),
                        "dynamic_braking_effort": np.round(brake),
                        "pneumatic_braking_effort": 0.0 * brake,
                    },
                ),
                frame_of(TRAIN_AXLES, time, {"wheel_speed": wheels, "wheel_effort": efforts}),
                frame_of(GNSS_FIX, time[rare], {"latitude": latitude, "longitude": longitude}),
                frame_of(GNSS_MOTION, time[rare], {"speed": speed[rare]}),
                frame_of(
                    ENVIRONMENT,
                    time[rare],
                    {
                        "speed_limit": LINE.speed_limit(position[rare]),
                        "gradient": LINE.gradient(position[rare]),
                    },
                ),
            )
        },
        metadata={"trip": f"run-{seed + 1:02d}", "line": LINE.name, "direction": "forward"},
        attachments={LINE_ATTACHMENT: line_to_bytes(LINE)},
    )


def write_long_trips(folder: Path, count: int) -> list[Path]:
    """Logs of `count` trips on as many days, written into a folder."""
    paths = []
    for seed in range(count):
        paths.append(folder / f"run-{seed + 1:02d}.mcap")
        write_log(long_trip(seed), paths[-1])
    return paths
