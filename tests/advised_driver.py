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


EARLY = 0.3
"""Deceleration from which a driver brakes for a speed not to exceed further on [m/s²]."""

CAP = re.compile(
    r"(\d+) km/h(?: from km ([\d.]+))?(?: to km ([\d.]+))?(?: at km ([\d.]+))?(?=, |$)"
)
"""A speed not to exceed, from one kilometre to another or at one."""


class Row:
    """One instruction: its place, and what its words ask for."""

    def __init__(self, row: dict[str, str]) -> None:
        self.km, self.words = float(row["km"]), row["advice"]
        self.coasts = self.words.startswith("coast")
        words, _, capped = self.words.partition("; at most ")
        speeds = re.findall(r"(?:to|hold|at most) (\d+) km/h", words)
        self.speed = float(speeds[0]) / KMH if speeds and not self.coasts else 0.0
        self.caps = [
            (float(speed) / KMH, float(at or start or -np.inf), float(at or end or np.inf))
            for speed, start, end, at in CAP.findall(capped)
        ]
        turns = re.findall(r"(falls|rises) to (at most )?(\d+)", words)
        self.turns = [(verb, float(speed) / KMH) for verb, _, speed in turns]
        if turns and turns[-1][1]:
            place = float(row["to_km"])
            self.caps.append((self.turns[-1][1], place, place))
        by = re.search(r"by km ([\d.]+)", words)
        self.by = float(by[1]) if by else None
        self.verb = self.words.split()[0]


class Course:
    """How far a driver who coasts has come in the falls and rises that a row states."""

    def __init__(self) -> None:
        self.row: Row | None = None
        self.turn, self.low = 0, False

    def lowest(self, row: Row, v: float) -> float:
        """The speed [m/s] below which it does not fall by the row at this stage."""
        if row is not self.row:
            self.row, self.turn, self.low = row, 0, False
        while self.turn < len(row.turns):
            verb, speed = row.turns[self.turn]
            if self.turn + 1 == len(row.turns):
                return speed if verb == "falls" else 0.0
            following = row.turns[self.turn + 1][1]
            middle = 0.5 * (speed + following)
            if verb == "falls":
                self.low |= v < middle
                if not (self.low and v > middle):
                    return speed
            elif v > middle:
                return 0.0
            self.turn, self.low = self.turn + 1, False
        return 0.0


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
    by = [
        end if row.by is None else float(np.interp(row.by, kilometres[order], grid[order]))
        for row, end in zip(rows, ends, strict=True)
    ]
    way = 1.0 if kilometres[-1] > kilometres[0] else -1.0

    def ahead(s: float, row: Row) -> list[tuple[float, float, float]]:
        """Speeds not to exceed, and how far it is to where they hold and no longer hold."""
        here = float(np.interp(s, grid, kilometres))
        return [(v, 1e3 * way * (a - here), 1e3 * way * (b - here)) for v, a, b in row.caps]

    resistance, inertia = configuration.resistance, configuration.inertia
    power = configuration.max_power
    most_brake = min(train.max_deceleration, train.max_braking_effort / inertia)
    course = Course()
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
        left = max(by[number] - s, 0.5)
        if row.verb in ("hold", "full"):
            a = min(max(wanted, hardest), full)
        elif row.verb == "coast":
            a = coasting
            if v < course.lowest(row, v) - 0.5 / KMH:
                a = max(a, min(full, 0.3))
        elif row.verb == "partial":
            a = min(max((row.speed**2 - v * v) / (2.0 * left), hardest), full)
        else:
            needed = (row.speed**2 - v * v) / (2.0 * left)
            # Who is to brake if faster lets the train roll up to that speed.
            rolls = max(wanted, 0.0) if "if faster" in row.words else 0.0
            a = max(min(coasting, needed), hardest) if v > row.speed else min(coasting, rolls)
            if row.speed == 0.0 and v < 1.5:
                a = 0.0
        if row.verb != "hold":
            a = min(a, max(_below(ahead(s, row), v), hardest))
        if v < 0.5 and not (row.verb == "brake" and row.speed == 0.0):
            a = max(a, min(full, 0.3))
        # A step ends where a row does.
        step = min(STEP, max((ends[number] - s) / max(v, 1.0), 0.01))
        after = max(v + a * step, 0.0)
        s, v, time = s + 0.5 * (v + after) * step, after, time + step
        places.append(s)
        speeds.append(v)
    return np.array(places), np.array(speeds), time


def _below(caps: list[tuple[float, float, float]], v: float) -> float:
    """The highest acceleration that keeps below speeds not to exceed."""
    most = np.inf
    for speed, start, end in caps:
        if start <= 0.0 <= end:
            most = min(most, (speed - v) / 2.0)
        elif start > 0.0 and v > speed:
            needed = (speed**2 - v**2) / (2.0 * start)
            most = min(most, needed) if needed < -EARLY else most
    return most
