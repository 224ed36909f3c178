"""A journey: when and how fast a train may be where on a line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Annotated, ClassVar

from trainlog.declaration import Declared, Quantity, Table, Text
from trainlog.errors import InputError
from trainlog.units import KMH


@dataclass(frozen=True, slots=True)
class TimingPoint:
    """Windows of time and speed at one position; None where there is no bound.

    Attributes
    ----------
    position : float [m]
    earliest, latest : float or None [s]
        Since the start of the journey.
    lowest_speed, highest_speed : float or None [m/s]
        Both 0 where the train stands.

    Examples
    --------
    >>> point = TimingPoint(5_000.0, earliest=240.0, latest=270.0)
    >>> point.latest - point.earliest
    30.0
    """

    position: Annotated[float, Quantity("m", "m")]
    earliest: Annotated[float | None, Quantity("s", "s")] = None
    latest: Annotated[float | None, Quantity("s", "s")] = None
    lowest_speed: Annotated[float | None, Quantity("km/h", "m/s")] = None
    highest_speed: Annotated[float | None, Quantity("km/h", "m/s")] = None

    def __str__(self) -> str:
        early, late = (
            "" if time is None else f"{round(time) // 60}:{round(time) % 60:02d} min"
            for time in (self.earliest, self.latest)
        )
        words = [f"at {early}" if early == late else f"{early.removesuffix(' min')} to {late}"]
        if not (early and late):
            words = [f"from {early}"] if early else [f"by {late}"] if late else ["at any time"]
        if self.highest_speed == 0.0:
            return f"stands {words[0]}"
        for bound, speed in (("least", self.lowest_speed), ("most", self.highest_speed)):
            if speed:
                words.append(f"at {bound} {KMH * speed:.4g} km/h")
        return ", ".join(words)


@dataclass(frozen=True, eq=False, repr=False)
class Journey(Declared):
    """Timing points of one train on one line.

    Two points at one position are a stop: arrival and departure, the dwell time between them.

    Attributes
    ----------
    name : str
    line : str
        Name of the line, as in its file.
    points : tuple of TimingPoint
        At least departure and arrival, ordered by position; two at one position are a stop:
        arrival, then departure. Where there is no bound: nan in TOML, null in JSON.
    source : str
        Where the data come from.

    Examples
    --------
    >>> at_rest = {"lowest_speed": 0.0, "highest_speed": 0.0}
    >>> start = TimingPoint(0.0, latest=0.0, **at_rest)
    >>> end = TimingPoint(5_000.0, latest=300.0, **at_rest)
    >>> journey = Journey("shuttle", "short", (start, end))
    >>> len(journey.points)
    2
    """

    FORMAT: ClassVar[str] = "trainlog/journey"
    ORDER: ClassVar[tuple[str, ...]] = ("name", "source")

    name: Annotated[str, Text(least=1, usual="Example journey")]
    line: Annotated[str, Text(usual="Example line")]
    points: Annotated[
        tuple[TimingPoint, ...],
        Table(
            key="timing_points",
            usual=(
                TimingPoint(150.0, earliest=0.0, latest=0.0),
                TimingPoint(5_900.0, latest=300.0),
                TimingPoint(5_900.0, earliest=330.0),
                TimingPoint(8_000.0, highest_speed=100.0 / KMH),
                TimingPoint(11_800.0, latest=630.0),
            ),
        ),
    ]
    source: Annotated[
        str, Text(stated="written", usual="template: replace every value by your journey's")
    ] = ""

    def summary(self) -> dict[str, str]:
        """The line, and what is asked for at each place."""
        places = groupby(self.points, lambda point: point.position)
        return {"line": self.line} | {
            f"km {position / 1e3:.3f}": ", then ".join(map(str, points))
            for position, points in places
        }

    def problems(self) -> Iterator[InputError]:
        """What no journey can be, one by one."""
        where = f"journey '{self.name}'"
        if len(self.points) < 2:
            yield InputError(f"{where}: needs at least a departure and an arrival")
            return
        if self.points[0].position < 0.0:
            place = self.points[0].position / 1e3
            yield InputError(f"{where}: begins before the line, at km {place:.3f}")
        for before, point in pairwise(self.points):
            if point.position < before.position:
                yield InputError(
                    f"{where}: timing point at km {point.position / 1e3:.3f} comes after the one"
                    f" at km {before.position / 1e3:.3f}",
                    remedy="order the points by position",
                )
        for point in self.points:
            for what, lower, upper in (
                ("time", point.earliest, point.latest),
                ("speed", point.lowest_speed, point.highest_speed),
            ):
                at = f"{where}: {what} window at km {point.position / 1e3:.3f}"
                if any(bound is not None and bound < 0.0 for bound in (lower, upper)):
                    yield InputError(f"{at} has a negative bound")
                elif lower is not None and upper is not None and lower > upper:
                    yield InputError(f"{at} ends before it begins")
