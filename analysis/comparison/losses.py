"""Where a trip lost time against a reference, and why: every second has one cause.

The running time (without stands) of both trips is compared in cells of some metres, the stands by
station. What is attributed to what:

1. A difference of dwell at a station where both stop is ``dwell``; where only one stops it is
   ``stop``; a stand off the stations is ``held``. The difference of departure is ``start``, where
   trips are compared by the time of day.
2. Cells in which a position is missing, or was corrected by a jump, are ``recording``.
3. The stretch of an event has the event's cause. Events are: a stop that only one of the trips
   makes (``stop``); a stand off a station, or a crawl below half of the speed that limit and
   the other trip allow, after braking (``held``); a lower limit than the other trip's that binds
   (``limit``); slip (``slip``). A stretch reaches back to where the train began to slow down for it
   (not for slip), and on to where it has the other trip's speed again or gains no more. Where
   stretches overlap, ``stop`` and ``held`` come before ``limit``, that before ``slip``.
4. Elsewhere a slower train that gave all the effort it had is ``full effort`` (load, power or
   wind); any other is ``slower``, a faster one ``faster``.

Time that the reference lost in one of these ways is gained: the same cause, with a negative sign.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from analysis.comparison.driven import DrivenTrip, Stand
from analysis.comparison.sections import (
    CommonRange,
    Sections,
    counted_stands,
    running_times,
)
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.railway.kilometres import STATION_REACH
from trainlog.spans import runs_of

CELL = 10.0
"""Length of the cells [m]."""

SAME_SPEED = 0.3
"""Speeds this near to each other [m/s] are the same."""

REVERSAL = 0.5
"""Fall of the speed below its highest [m/s] at which a train gains, or gives up, speed no more."""

LIMIT_STEP = 0.5
"""Limits differ from here on [m/s]."""

CRAWL_SHARE = 0.5
"""Of what limit and the other trip allow: below it a train that was braked crawls."""

CRAWL_REACH = 500.0
"""So near to a stop [m] low speeds belong to the stop."""

SMOOTHED = 100.0
"""Over so many metres to either side it is decided whether a train was slower or faster."""

RECOVERY = 15_000.0
"""Longest stretch behind an event [m] that is attributed to it."""

ROUNDING = 1e-9
"""Seconds that are none."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Time lost against the reference by one cause in one section or at one station.

    Attributes
    ----------
    seconds : float [s]
        Negative where time was gained.
    cause : str
        One of `CAUSES`.
    place : str
        Section, or ``"at"`` a station.
    section : int
        Number of the section; of a station that of the section before it.
    first, last : float [m]
        Where it was lost.
    """

    seconds: float
    cause: str
    place: str
    section: int
    first: float
    last: float

    @property
    def words(self) -> str:
        """The cause in words."""
        return (CAUSES if self.seconds >= 0.0 else GAINED)[self.cause]


@dataclass(frozen=True, eq=False)
class Lost:
    """Time lost by a trip against its reference.

    Attributes
    ----------
    total : float [s]
        Sum of all losses.
    losses : tuple of Loss
        Those that cost most first.
    position : (n + 1,) array [m]
        Nodes of the cells.
    behind : (n + 1,) array [s]
        Time lost up to each node, stands included.
    """

    total: float
    losses: tuple[Loss, ...]
    position: FloatArray
    behind: FloatArray

    def by_cause(self) -> dict[str, float]:
        """Seconds by cause, the largest first."""
        found: dict[str, float] = {}
        for loss in self.losses:
            found[loss.cause] = found.get(loss.cause, 0.0) + loss.seconds
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def by_section(self, count: int) -> FloatArray:
        """Seconds of each of `count` sections, with the station where it ends."""
        found = np.zeros(count)
        for loss in self.losses:
            found[min(max(loss.section, 0), count - 1)] += loss.seconds
        return found


@dataclass(frozen=True, eq=False)
class _Cells:
    """One of two trips in the cells of their common range; arrays (n,)."""

    trip: DrivenTrip
    nodes: FloatArray
    running: FloatArray
    speed: FloatArray
    limit: FloatArray
    slip: BoolArray
    full: BoolArray
    stands: list[Stand]

    @staticmethod
    def of(trip: DrivenTrip, nodes: FloatArray, common: CommonRange) -> _Cells:
        middle = 0.5 * (nodes[1:] + nodes[:-1])
        none = np.zeros(middle.size, dtype=np.bool_)

        def often(flag: str, share: float) -> BoolArray:
            if flag not in trip.flags:
                return none
            return np.asarray(trip.share_of(flag, nodes) > share)

        return _Cells(
            trip,
            nodes,
            np.diff(running_times(trip, nodes, common)),
            trip.at(trip.speed, middle),
            _limit(trip, middle),
            often("slip", 0.2),
            often("full_effort", 0.5),
            counted_stands(trip, common),
        )

    @property
    def ends(self) -> list[Stand]:
        """Stands at which the trip itself begins or ends."""
        return [each for each in self.trip.stands if each.duration == 0.0]


def _limit(trip: DrivenTrip, position: FloatArray) -> FloatArray:
    """Permitted speed at each position [m/s]; a recorded limit that is lower counts."""
    stated = trip.permitted(position)
    if "limit" not in trip.signals:
        return stated
    row = np.clip(np.rint(trip.sample_at(position)).astype(np.int64), 0, trip.time.size - 1)
    return np.fmin(stated, trip.signals["limit"][row])


def lost_time(
    trip: DrivenTrip,
    reference: DrivenTrip,
    common: CommonRange,
    sections: Sections,
    *,
    by_time_of_day: bool = False,
) -> Lost:
    """Where and why a trip lost time against a reference.

    Parameters
    ----------
    trip, reference : DrivenTrip
    common : CommonRange
    sections : Sections
        Of the common range.
    by_time_of_day : bool
        The difference of departure counts, by the time of day.

    Returns
    -------
    Lost
        The losses sum up to the total, those of a section to what was lost in it.
    """
    nodes = _nodes(common, sections)
    mine, other = _Cells.of(trip, nodes, common), _Cells.of(reference, nodes, common)
    lost = mine.running - other.running
    causes = _causes(mine, other, lost)
    losses = [*_of_cells(lost, causes, nodes, sections), *_of_stands(mine, other, sections)]
    started = 0.0
    if by_time_of_day:
        started = _later_start(trip, reference, common)
        place = f"at {sections.ends[0]}"
        losses.append(Loss(started, "start", place, 0, common.first, common.first))
    total = float(sum(each.seconds for each in losses))
    losses = [each for each in losses if abs(each.seconds) > ROUNDING]
    behind = started + np.concatenate(([0.0], np.cumsum(lost)))
    for stands, sign in ((mine.stands, 1.0), (other.stands, -1.0)):
        for stand in stands:
            behind = behind + sign * stand.duration * (nodes > min(stand.position, nodes[-2]))
    ordered = sorted(losses, key=lambda each: (-each.seconds, each.first, each.cause))
    return Lost(total, tuple(ordered), nodes, behind)


def _nodes(common: CommonRange, sections: Sections) -> FloatArray:
    """Nodes of the cells: multiples of `CELL`, and the edges of the sections."""
    inner = CELL * np.arange(np.ceil(common.first / CELL), np.floor(common.last / CELL) + 1.0)
    # No sliver of a cell beside an edge.
    apart = np.min(np.abs(inner[:, None] - sections.edges), axis=1) >= 0.2 * CELL
    return np.unique(np.concatenate((inner[apart], sections.edges)))


def _later_start(trip: DrivenTrip, reference: DrivenTrip, common: CommonRange) -> float:
    """By how much the trip is later at the first common position, by the time of day [s]."""
    day = 86_400.0
    times = [
        each.departure / 1e9 + (0.0 if common.starts else float(each.at(each.time, common.first)))
        for each in (trip, reference)
    ]
    return float((times[0] - times[1] + 0.5 * day) % day - 0.5 * day)


def _of_stands(mine: _Cells, other: _Cells, sections: Sections) -> list[Loss]:
    """Differences of dwell, by station, and stands off the stations."""
    found = []
    for edge, name in enumerate(sections.ends):
        at = [[s for s in each.stands if sections.edge_of(s) == edge] for each in (mine, other)]
        dwell = [sum(stand.duration for stand in stands) for stands in at]
        ends = [any(sections.edge_of(s) == edge for s in each.ends) for each in (mine, other)]
        both = all(stands or end for stands, end in zip(at, ends, strict=True))
        where = float(np.mean([stand.position for stands in at for stand in stands] or [0.0]))
        cause = "dwell" if both else "stop"
        section = max(edge - 1, 0)
        found.append(Loss(dwell[0] - dwell[1], cause, f"at {name}", section, where, where))
    for each, sign in ((mine, 1.0), (other, -1.0)):
        for stand in each.stands:
            if sections.edge_of(stand) is None:
                number = sections.of(stand.position)
                seconds, where = sign * stand.duration, stand.position
                cause = "stop" if stand.station else "held"
                found.append(Loss(seconds, cause, sections.names[number], number, where, where))
    return found


def _of_cells(
    lost: FloatArray, causes: IntArray, nodes: FloatArray, sections: Sections
) -> list[Loss]:
    """Running time lost by section and cause."""
    section = np.clip(
        np.searchsorted(sections.edges, nodes[:-1], side="right") - 1, 0, sections.edges.size - 2
    )
    names = list(CAUSES)
    found = []
    for number, cause in sorted(set(zip(section.tolist(), causes.tolist(), strict=True))):
        cells = np.flatnonzero((section == number) & (causes == cause))
        found.append(
            Loss(
                float(lost[cells].sum()),
                names[cause],
                sections.names[number],
                int(number),
                float(nodes[cells[0]]),
                float(nodes[cells[-1] + 1]),
            )
        )
    return found


def _causes(mine: _Cells, other: _Cells, lost: FloatArray) -> IntArray:
    """Number of the cause of each cell, in the order of `CAUSES`."""
    number = {name: row for row, name in enumerate(CAUSES)}
    slower = _smoothed(lost) > 0.0
    causes = np.where(slower, number["slower"], number["faster"])
    causes[slower & mine.full] = number["full effort"]
    causes[~slower & other.full] = number["full effort"]
    for kind in ("slip", "limit", "held", "stop"):
        for each, against in ((other, mine), (mine, other)):
            for first, last in _events(kind, each, against):
                causes[_stretch(first, last, each, against, back=kind != "slip")] = number[kind]
    for each in (mine, other):
        if "doubtful" in each.trip.flags:
            edges = mine.nodes
            places = each.trip.position[each.trip.flags["doubtful"]]
            before = each.trip.position[np.flatnonzero(each.trip.flags["doubtful"]) - 1]
            for low, high in zip(before.tolist(), places.tolist(), strict=True):
                causes[(edges[1:] > low) & (edges[:-1] < high)] = number["recording"]
    return causes.astype(np.int64)


def _smoothed(lost: FloatArray) -> FloatArray:
    width = 2 * round(SMOOTHED / CELL) + 1
    if lost.size < width:
        return np.full(lost.size, lost.mean())
    return np.convolve(np.pad(lost, width // 2, mode="edge"), np.ones(width) / width, mode="valid")


def _events(kind: str, mine: _Cells, other: _Cells) -> Iterable[tuple[int, int]]:
    """First and last cell of each event of one trip that the other does not have."""
    if kind == "slip":
        return _runs(mine.slip & ~other.slip & (mine.speed < other.speed - SAME_SPEED))
    if kind == "limit":
        lower = mine.limit < other.limit - LIMIT_STEP
        return _runs(lower & (other.speed > mine.limit - LIMIT_STEP))
    stations = kind == "stop"
    found = [
        (cell, cell)
        for stand in (*mine.stands, *(mine.ends if stations else ()))
        if bool(stand.station) == stations and not _stands_near(other, stand)
        for cell in [_cell(mine, stand.position)]
        if cell is not None
    ]
    return found if stations else [*found, *_crawls(mine, other)]


def _runs(flags: BoolArray) -> list[tuple[int, int]]:
    return [(begin, end - 1) for begin, end in runs_of(flags)]


def _stands_near(cells: _Cells, stand: Stand) -> bool:
    """Whether a trip stands where the other does."""
    every = (*cells.stands, *cells.ends)
    return any(
        abs(each.position - stand.position) <= STATION_REACH
        or (stand.station and each.station == stand.station)
        for each in every
    )


def _cell(cells: _Cells, position: float) -> int | None:
    """Number of the cell at a position; None outside of them all."""
    low, high = cells.nodes[[0, -1]]
    if not low - STATION_REACH <= position <= high + STATION_REACH:
        return None
    found = int(np.searchsorted(cells.nodes, position, side="right")) - 1
    return min(max(found, 0), cells.nodes.size - 2)


def _crawls(mine: _Cells, other: _Cells) -> list[tuple[int, int]]:
    """Stretches on which a train that was braked crawls, away from stops and lower limits."""
    middle = 0.5 * (mine.nodes[1:] + mine.nodes[:-1])
    allowed = np.minimum(mine.limit, other.speed)
    slow = mine.speed < CRAWL_SHARE * allowed
    for stand in (*mine.stands, *mine.ends, *other.stands, *other.ends):
        slow &= np.abs(middle - stand.position) > CRAWL_REACH
    for first, last in _events("limit", mine, other):  # it is braked for a limit
        slow[_stretch(first, last, mine, other, back=True)] = False
    found = []
    for first, last in _runs(slow):
        before = mine.speed[max(0, first - round(1500.0 / CELL)) : first + 1]
        lowest = float(mine.speed[first : last + 1].min())
        # It came faster and was slowed down, and it is no start from a stop.
        if before.size and before.max() > 2.0 * lowest and lowest < before[-1]:
            found.append((first, last))
    return found


def _stretch(first: int, last: int, mine: _Cells, other: _Cells, *, back: bool) -> slice:
    """Cells that an event from `first` to `last` costs time in: slowing down, and recovering."""
    speed, against = mine.speed, other.speed
    begin, top = first, speed[first]
    for cell in range(first - 1, -1, -1) if back else ():
        if speed[cell] > top:
            begin, top = cell, speed[cell]
        if speed[cell] < top - REVERSAL or speed[cell] >= against[cell] - SAME_SPEED:
            break
    end, top = last, speed[last]
    most = min(speed.size, last + 1 + round(RECOVERY / CELL))
    for cell in range(last + 1, most):
        if speed[cell] > top:
            end, top = cell, speed[cell]
        if speed[cell] < top - REVERSAL or speed[cell] >= against[cell] - SAME_SPEED:
            break
    risen = np.flatnonzero(speed[last : end + 1] >= top - REVERSAL)
    return slice(begin, last + int(risen[0]) + 1)


CAUSES = {
    "start": "later start",
    "dwell": "longer dwell",
    "stop": "stop that the reference does not make",
    "held": "held: braked to a stand or a crawl off a station",
    "limit": "lower speed limit",
    "slip": "slip: limited by adhesion",
    "full effort": "slower at full effort: load, power or wind",
    "slower": "slower than needed",
    "faster": "faster",
    "recording": "position missing or corrected",
}
"""Each cause in words."""

GAINED = {
    "start": "earlier start",
    "dwell": "shorter dwell",
    "stop": "the reference stops here",
    "held": "the reference was held",
    "limit": "the reference had a lower limit",
    "slip": "the reference slipped",
    "full effort": "the reference was slower at full effort",
    "slower": "slower than needed",
    "faster": "faster",
    "recording": "position missing or corrected",
}
"""The same where time was gained."""

LOST = tuple(cause for cause in CAUSES if cause not in ("start", "dwell", "stop"))
"""Causes of lost time against the shortest run that makes the same stops."""
