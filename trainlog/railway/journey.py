"""A journey: when and how fast a train may be where on a line."""

from __future__ import annotations

from dataclasses import dataclass

from trainlog.errors import InputError


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

    position: float
    earliest: float | None = None
    latest: float | None = None
    lowest_speed: float | None = None
    highest_speed: float | None = None


@dataclass(frozen=True)
class Journey:
    """Timing points of one train on one line.

    Two points at one position are a stop: arrival and departure, the dwell time between them.

    Attributes
    ----------
    name : str
    line : str
        Name of the line.
    points : tuple of TimingPoint
        At least departure and arrival, ordered by position.
    source : str

    Examples
    --------
    >>> at_rest = {"lowest_speed": 0.0, "highest_speed": 0.0}
    >>> start = TimingPoint(0.0, latest=0.0, **at_rest)
    >>> end = TimingPoint(5_000.0, latest=300.0, **at_rest)
    >>> journey = Journey("shuttle", "short", (start, end))
    >>> len(journey.points)
    2
    """

    name: str
    line: str
    points: tuple[TimingPoint, ...]
    source: str = ""

    def __post_init__(self) -> None:
        where = f"journey '{self.name}'"
        if len(self.points) < 2:
            raise InputError(f"{where}: needs at least a departure and an arrival")
        if self.points[0].position < 0.0:
            place = self.points[0].position / 1e3
            raise InputError(f"{where}: begins before the line, at km {place:.3f}")
        for before, point in zip(self.points, self.points[1:], strict=False):
            if point.position < before.position:
                raise InputError(
                    f"{where}: timing point at km {point.position / 1e3:.3f} comes after the one"
                    f" at km {before.position / 1e3:.3f}",
                    remedy="order the points by position",
                )
        for point in self.points:
            _check_window(where, point, "time", point.earliest, point.latest)
            _check_window(where, point, "speed", point.lowest_speed, point.highest_speed)


def _check_window(
    where: str, point: TimingPoint, what: str, lower: float | None, upper: float | None
) -> None:
    at = f"{where}: {what} window at km {point.position / 1e3:.3f}"
    if any(bound is not None and bound < 0.0 for bound in (lower, upper)):
        raise InputError(f"{at} has a negative bound")
    if lower is not None and upper is not None and lower > upper:
        raise InputError(f"{at} ends before it begins")
