"""A driver who does what each row of the advice says, and nothing else.

It knows the rows of the CSV, how far it has come and how fast it is; of the plan nothing.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np

from trainlog.railway import Configuration, Line, Train
from trainlog.units import KMH

STEP = 0.25
"""Of the integration [s]."""


class Row:
    """One instruction: its place, and what its words ask for."""

    def __init__(self, row: dict[str, str]) -> None:
        self.km, self.words = float(row["km"]), row["advice"]
        speeds = re.findall(r"(?:to|hold|at most) (\d+) km/h", self.words)
        self.coasts = self.words.startswith("coast")
        at_most = re.search(r"at most (\d+) km/h", self.words)
        self.speed = float(speeds[0]) / KMH if speeds else 0.0
        if self.coasts or self.words.startswith("full traction, at most"):
            self.speed = float(at_most[1]) / KMH if at_most else np.inf
        falls = re.findall(r"falls to (\d+)", self.words)
        self.lowest = float(min(map(int, falls))) / KMH if falls else 0.0
        self.verb = self.words.split()[0]


def rows_of(file: Path) -> list[Row]:
    """What the table says is to be done, in order."""
    with file.open(encoding="utf-8") as table:
        return [Row(row) for row in csv.DictReader(table) if row["event"] == "changes"]


def driven(
    rows: list[Row], line: Line, train: Train, configuration: Configuration
) -> tuple[np.ndarray, np.ndarray, float]:
    """Places [m] and speeds [m/s] of one run after the rows, and when it ends [s]."""
    grid = np.arange(0.0, line.length + 5.0, 5.0)
    track = line.track_acceleration(grid, train.strip_length).tolist()
    area = line.tunnel_cross_section(grid)
    tunnel = train.tunnel_coefficient(area).tolist()
    kilometres = np.array([float(line.kilometre(each)) for each in grid]) / 1e3
    order = np.argsort(kilometres)
    starts = [float(np.interp(row.km, kilometres[order], grid[order])) for row in rows]
    ends = [*starts[1:], line.length]
    resistance, inertia = configuration.resistance, configuration.inertia
    power = configuration.max_power
    most_brake = min(train.max_deceleration, train.max_braking_effort / inertia)
    s = v = time = 0.0
    places, speeds, number = [0.0], [0.0], 0
    while s < line.length - 0.3 and time < 20_000.0:
        while number + 1 < len(rows) and s >= ends[number]:
            number += 1
        row, here = rows[number], min(int(s / 5.0), grid.size - 1)
        drag = resistance.r0 + resistance.r1 * v + (resistance.r2 + tunnel[here]) * v * v
        coasting = -drag / inertia - track[here] * configuration.mass / inertia
        full = min(train.max_tractive_effort, power / max(v, 0.1)) / inertia
        full = min(full, train.max_acceleration) + coasting
        hardest = coasting - most_brake
        wanted = (row.speed - v) / 2.0
        left = max(ends[number] - s, 0.5)
        if row.verb in ("hold", "full"):
            a = min(max(wanted, hardest), full)
        elif row.verb == "coast":
            a = max(min(coasting, wanted), hardest)
            if v < row.lowest - 0.5 / KMH:
                a = max(a, min(full, 0.3))
        elif row.verb == "partial":
            a = min(max((row.speed**2 - v * v) / (2.0 * left), hardest), full)
        else:
            needed = (row.speed**2 - v * v) / (2.0 * left)
            a = max(min(coasting, needed), hardest) if v > row.speed else min(coasting, 0.0)
            if row.speed == 0.0 and v < 1.5:
                a = 0.0
        if v < 0.5 and not (row.verb == "brake" and row.speed == 0.0):
            a = max(a, min(full, 0.3))
        after = max(v + a * STEP, 0.0)
        s, v, time = s + 0.5 * (v + after) * STEP, after, time + STEP
        places.append(s)
        speeds.append(v)
    return np.array(places), np.array(speeds), time
