"""Trips that coast, made from the equation of motion alone, for the tests of the coast-down."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.formats.railway import line_to_bytes
from trainlog.railway import Line, Station, StepProfile
from trainlog.topics import ESTIMATED_STATE, GNSS_MOTION
from trainlog.trip import LINE_ATTACHMENT, Trip, frame_of

RATIO = 0.93
"""Mass over inertia of the train that is driven here."""

STEP = 0.1


def line_of_gradients(values: Sequence[float], each: float = 400.0) -> Line:
    """A line whose gradient changes every `each` metres."""
    length = each * len(values)
    return Line(
        name="made",
        length=length,
        stations=(Station("A", 0.0), Station("B", length)),
        speed_limits=StepProfile(np.zeros(1), np.array([45.0])),
        gradients=StepProfile(each * np.arange(len(values)), np.array(values, dtype=np.float64)),
    )


LEVEL = line_of_gradients([0.0] * 300)
HILLY = line_of_gradients(
    (6e-3 * np.sin(np.arange(300) * 1.7) + 3e-3 * np.cos(np.arange(300) * 0.61)).tolist()
)


def coasting_down(time: FloatArray, start: float, curve: tuple[float, float, float]) -> FloatArray:
    """Speed [m/s] after coasting for `time` [s] on level track, in closed form.

    dv/dt = -(c0 + c1 v + c2 v²), for all three signs of c1² - 4 c0 c2.
    """
    c0, c1, c2 = curve
    discriminant = c1**2 - 4.0 * c0 * c2
    slope = 2.0 * c2 * start + c1
    if abs(discriminant) < 1e-15:
        found = 1.0 / (1.0 / slope + 0.5 * time)
    elif discriminant < 0.0:
        root = np.sqrt(-discriminant)
        found = root * np.tan(np.arctan(slope / root) - 0.5 * root * time)
    else:
        root = np.sqrt(discriminant)
        ratio = (slope - root) / (slope + root) * np.exp(-root * time)
        found = root * (1.0 + ratio) / (1.0 - ratio)
    return np.asarray((found - c1) / (2.0 * c2))


def driven(
    line: Line,
    curve: tuple[float, float, float],
    efforts: Sequence[tuple[float, float]],
    *,
    start: float = 0.0,
    speed: float = 10.0,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Time, position, speed and effort over inertia of a drive, every `STEP`.

    Parameters
    ----------
    efforts : sequence of (duration [s], effort over inertia [m/s²])
        NaN holds the speed that there is.
    """
    grid = line.track_acceleration(np.arange(0.0, line.length + 100.0, 1.0))
    c0, c1, c2 = curve
    rows = []
    v, s, t = speed, start, 0.0
    for duration, wanted in efforts:
        for _ in range(round(duration / STEP)):
            along = RATIO * float(grid[int(s)])
            resisted = along + c0 + (c1 + c2 * v) * v
            effort = resisted if np.isnan(wanted) else wanted
            rows.append((t, s, v, effort))
            middle = v + 0.5 * STEP * (effort - resisted)
            # Edges of gradients are met within a step, as they are by trains.
            ahead = RATIO * float(grid[int(s + STEP * middle)])
            force = effort - 0.5 * (along + ahead) - c0 - (c1 + c2 * middle) * middle
            if np.isnan(wanted):
                force = 0.0
            s += STEP * (v + 0.5 * STEP * force)
            v += STEP * force
            t += STEP
    time, position, reported, effort = np.array(rows).T
    return time, position, reported, effort


def recorded(
    time: FloatArray,
    position: FloatArray,
    speed: FloatArray,
    *,
    line: Line | None = None,
    every: int = 2,
    noise: float = 0.05,
    seed: int = 1,
    name: str = "made",
    direction: str = "forward",
) -> Trip:
    """What a satellite receiver and the chainage made of it would have recorded."""
    generator = np.random.default_rng(seed)
    t, s, v = (array[::every] for array in (time, position, speed))
    stamps = np.int64(1_700_000_000_000_000_000) + np.round(t * 1e9).astype(np.int64)
    measured = np.abs(v + noise * generator.standard_normal(v.size))
    frames = [
        frame_of(GNSS_MOTION, stamps, {"speed": measured}),
        frame_of(ESTIMATED_STATE, stamps, {"position": s}),
    ]
    return Trip(
        topics={frame.attrs["topic"]: frame for frame in frames},
        metadata={"trip": name, "direction": direction},
        attachments={} if line is None else {LINE_ATTACHMENT: line_to_bytes(line)},
    )
