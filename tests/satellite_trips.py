"""Trips of a satellite receiver along any curve of the plane, with the truth beside them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from trainlog.railway import Geometry
from trainlog.railway.geometry import from_plane
from trainlog.topics import GNSS_FIX, GNSS_MOTION, TRAIN_STATE
from trainlog.trip import Trip, frame_of

ORIGIN = (47.0, 9.0)
START = pd.Timestamp("2024-05-01T06:00:00Z").value


def curve_of(curvature: np.ndarray, step: float = 5.0, heading: float = 0.3) -> Geometry:
    """The geometry of a track whose curvature [1/m], to the left, is given every `step` [m]."""
    turned = heading + np.concatenate(([0.0], np.cumsum(curvature * step)))
    middle = 0.5 * (turned[1:] + turned[:-1])
    points = np.concatenate(([0.0], np.cumsum(step * np.exp(1j * middle))))
    latitude, longitude = from_plane(points, ORIGIN)
    return Geometry(step * np.arange(points.size), latitude, longitude, "made up")


def winding(length: float = 12_000.0) -> Geometry:
    """Bends of 400 m and straights."""
    s = np.arange(0.0, length, 5.0)
    return curve_of(np.clip(3.0 * np.sin(s / 450.0), -1.0, 1.0) / 400.0)


def hairpin(apart: float = 12.0) -> Geometry:
    """Two kilometres out, and back beside the way that it came, as up a valley's side."""
    radius = 150.0
    s = np.arange(0.0, 2 * 2_000.0 + np.pi * radius + 800.0, 5.0)
    curvature = np.zeros(s.size)
    # A loop wider than the tracks are apart: out a little, round, and back in.
    swing = 2.0 * np.arccos(1.0 - (radius - apart / 2.0) / (2.0 * radius))
    part = radius * swing / 2.0
    edges = 2_000.0 + np.cumsum([0.0, part, part * 2 + np.pi * radius, part])
    curvature[(s >= edges[0]) & (s < edges[1])] = -1.0 / radius
    curvature[(s >= edges[1]) & (s < edges[2])] = 1.0 / radius
    curvature[(s >= edges[2]) & (s < edges[3])] = -1.0 / radius
    return curve_of(curvature)


def spiral() -> Geometry:
    """A line that crosses over itself and runs on beside where it was."""
    s = np.arange(0.0, 9_000.0, 5.0)
    curvature = np.where((s > 2_000.0) & (s < 2_000.0 + 2.0 * np.pi * 300.0), 1.0 / 300.0, 0.0)
    again = (s > 5_000.0) & (s < 5_000.0 + 2.0 * np.pi * 310.0)
    return curve_of(np.where(again, 1.0 / 310.0, curvature))


@dataclass(frozen=True)
class Receiver:
    """How a receiver errs."""

    rate: float = 1.0
    noise: float = 3.0
    lasting: bool = False
    speed_noise: float = 0.2
    outages: tuple[tuple[float, float], ...] = ()
    bursts: tuple[tuple[float, float, complex], ...] = ()
    wheels: bool = False


def motion(length: float, top: float = 25.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], position [m] and speed [m/s] of a run with a stop of 40 s in the middle."""
    half = np.linspace(0.0, length / 2.0, 4_000)
    pace = np.sqrt(np.minimum(2.0 * 0.5 * half, 2.0 * 0.6 * (half[-1] - half)))
    pace = np.maximum(np.minimum(pace, top), 0.15)
    took = np.concatenate(([0.0], np.cumsum(np.diff(half) * 2.0 / (pace[1:] + pace[:-1]))))
    time = np.concatenate(([0.0], 20.0 + took, 60.0 + took[-1] + took, [80.0 + 2.0 * took[-1]]))
    way = np.concatenate(([0.0], half, length / 2.0 + half, [length]))
    even = np.arange(0.0, time[-1], 0.1)
    position = np.interp(even, time, way)
    return even, position, np.gradient(position, even)


def drive(
    geometry: Geometry, receiver: Receiver, seed: int = 1, *, reverse: bool = False
) -> tuple[Trip, pd.DataFrame]:
    """A trip over the whole geometry, and its true position [m] and speed [m/s].

    Position grows in the direction of travel; `reverse` runs the geometry from its end.
    """
    generator = np.random.default_rng(seed)
    length = float(geometry.positions[-1])
    way = geometry.reversed(length) if reverse else geometry
    time, position, speed = motion(length, top=20.0 + seed % 4 * 3.0)
    every = round(10.0 / receiver.rate)
    t, s, v = time[::every], position[::every], speed[::every]
    error = generator.standard_normal(t.size) + 1j * generator.standard_normal(t.size)
    if receiver.lasting:
        keep = np.exp(-1.0 / receiver.rate / 30.0)
        for k in range(1, t.size):
            error[k] = keep * error[k - 1] + np.sqrt(1.0 - keep**2) * error[k]
    error = receiver.noise * error
    for begin, end, size in receiver.bursts:
        error[(t >= begin) & (t < end)] += size
    latitude, longitude = way.at(s)
    metre = np.degrees(1.0 / 6_371_000.0)
    seen = np.ones(t.size, dtype=bool)
    for begin, end in receiver.outages:
        seen &= (t < begin) | (t >= end)
    stamps = START + (t[seen] * 1e9).astype(np.int64)
    ones = np.ones(stamps.size)
    fix = frame_of(
        GNSS_FIX,
        stamps,
        {
            "latitude": (latitude + error.imag * metre)[seen],
            "longitude": (longitude + error.real * metre / np.cos(np.radians(latitude)))[seen],
            "horizontal_accuracy": receiver.noise * ones,
        },
    )
    noisy = np.abs(v + receiver.speed_noise * generator.standard_normal(t.size))[seen]
    doppler = frame_of(
        GNSS_MOTION, stamps, {"speed": noisy, "speed_accuracy": receiver.speed_noise * ones}
    )
    topics = {"/gnss/fix": fix, "/gnss/motion": doppler}
    index = pd.DatetimeIndex(START + (time * 1e9).astype(np.int64), tz="UTC")
    if receiver.wheels:
        stated = np.maximum(1.008 * speed + 0.05 * generator.standard_normal(time.size), 0.0)
        stated = np.where(speed > 0.0, stated, 0.0)
        topics["/train/state"] = frame_of(TRAIN_STATE, index, {"speed": stated})
    name = f"trip-{seed:02d}"
    return Trip(topics, {"trip": name}), pd.DataFrame(
        {"position": position, "speed": speed}, index=index
    )


def errors(estimate: pd.DataFrame, truth: pd.DataFrame, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors of an estimate every second, and its standard deviations."""
    index = estimate.index.as_unit("ns").asi8
    even = np.arange(index[0], index[-1], 1_000_000_000)
    at = (even - index[0]) / 1e9
    stated = [
        np.interp(at, (index - index[0]) / 1e9, estimate[column])
        for column in (name, f"{name}_std")
    ]
    known = (truth.index.as_unit("ns").asi8 - index[0]) / 1e9
    return stated[0] - np.interp(at, known, truth[name]), stated[1]
