"""Trips over a line compared by position: times, losses with their causes, energy, driving.

Sections between stations: what a trip took in each, and what two trips have in common.

Where a trip lost time against a reference, and why: every second has one cause.

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

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Union

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from analysis.comparison import CAUSES
from analysis.comparison.driven import (
    UNKNOWN_TIME,
    DrivenTrip,
    Stand,
    driven_trip,
    in_succession,
    planned_trip,
)
from analysis.comparison.energy import ForceModel, normalised_energy
from analysis.view import Given, TripView, each_given
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.display import counted, span
from trainlog.errors import InputError, LogError, TrainlogError
from trainlog.presentation import (
    DURATION,
    ENERGY,
    MASS,
    NUMBER,
    SHARE,
    SPEED,
    Band,
    Column,
    Presented,
    Quantity,
    Said,
    WordTable,
    new_table,
)
from trainlog.railway import Line, ParameterSet, Train, Trajectory
from trainlog.railway.line import STATION_REACH, in_km, km_words, station_at
from trainlog.railway.network import unused
from trainlog.spans import runs_of
from trainlog.trip import Trip
from trainlog.units import KMH, clock

if TYPE_CHECKING:
    from analysis.trajectory.journey import JourneyPlan

Plan = Union[Trajectory, Sequence[Trajectory], "JourneyPlan"]
"""A trajectory, or those of a journey's sections."""

EXCESS = 1.0 / KMH
"""Speed over the limit [m/s] from which it is stated: less is within what speeds are known to."""

MOVED_WITH = 150.0
"""So far [m] around a station cells move with the place where a train stood there."""

STOPPING_REACH = 50.0
"""A trip that goes so far into a section [m] stopped at the station before it."""


UNITS = {
    "kg": "mass mass_std",
    "m": "first last first_in_common last_in_common excess_distance",
    "s": "running_time stood dwell lateness lost duration time calculated_time time_std",
    "m_s": "excess off_advised_speed speed_rms",
    "J": "traction braking dynamic_braking line work calculated_work work_std"
    " normalised_traction normalised_traction_std",
}
"""Columns of tables of trips and sections, by the SI unit that ends their names in files."""


def with_units(table: pd.DataFrame) -> pd.DataFrame:
    """The table with the SI units of its columns at the ends of their names."""
    units = {name: unit for unit, names in UNITS.items() for name in names.split()}
    named = {name: f"{name}_{units[name]}" for name in table if name in units}
    found = table.rename(columns=named)
    found.attrs["units"] = {named[n]: Quantity(units[n], "").si_unit for n in named}
    return found


@dataclass(frozen=True, eq=False)
class Sections:
    """Consecutive sections of a line.

    Attributes
    ----------
    edges : (n + 1,) array [m]
    ends : tuple of n + 1 str
        Station at each edge, or its kilometre.
    """

    edges: FloatArray
    ends: tuple[str, ...]

    @property
    def names(self) -> list[str]:
        """Of each section: both its ends."""
        return [f"{first} - {last}" for first, last in zip(self.ends, self.ends[1:], strict=False)]

    def of(self, position: ArrayLike) -> IntArray:
        """Number of the section that holds each position [m]."""
        return np.clip(
            np.searchsorted(self.edges, position, side="right") - 1, 0, self.edges.size - 2
        )

    def with_edges(self, nodes: FloatArray, step: float) -> FloatArray:
        """Nodes of cells as long as a step [m], and the edges, without a sliver beside one."""
        apart = np.min(np.abs(nodes[:, None] - self.edges), axis=1) >= 0.2 * step
        return np.unique(np.concatenate((nodes[apart], self.edges)))

    def edge_of(self, stand: Stand) -> int | None:
        """Number of the edge at whose station a train stands; None where it stands in a section."""
        if not stand.station:
            return None
        near = np.flatnonzero(np.abs(self.edges - stand.position) <= 2.0 * STATION_REACH)
        return next((int(edge) for edge in near if self.ends[edge] == stand.station), None)

    def edges_of(self, trip: DrivenTrip) -> FloatArray:
        """The edges, where the trip stood at a station of them at its own place there [m].

        A train that stops short of a station, or beyond it, ends the section before nevertheless.
        """
        own = self.edges.copy()
        for stand in trip.stands:
            edge = self.edge_of(stand)
            if edge is not None and 0 < edge < own.size - 1:
                own[edge] = stand.position
        return np.maximum.accumulate(own)

    def nodes_of(self, trip: DrivenTrip, nodes: FloatArray) -> FloatArray:
        """Nodes of cells, those about a station moved with the place where the trip stood there."""
        found, own = nodes.copy(), self.edges_of(trip)
        for edge in np.flatnonzero(own != self.edges).tolist():
            shift, half = own[edge] - self.edges[edge], 0.5 * np.diff(self.edges)
            reach = min(max(MOVED_WITH, 2.0 * abs(shift)), half[edge - 1], half[edge])
            near = np.maximum(1.0 - np.abs(nodes - self.edges[edge]) / reach, 0.0)
            found += shift * near
        return np.maximum.accumulate(found)


def sections_between(line: Line, first: float, last: float) -> Sections:
    """The line's sections from one position to another.

    Parameters
    ----------
    line : Line
        As travelled.
    first, last : float [m]

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> sections_between(line, 5_000.0, line.length).names
    ['km 5.000 - Gossau SG', 'Gossau SG - Flawil', 'Flawil - Uzwil', 'Uzwil - Wil']
    """
    within = [
        station.position
        for station in line.stations
        if first + STATION_REACH < station.position < last - STATION_REACH
    ]
    edges = np.array([first, *within, last])
    # A station comes twice where two are nearer to each other than trains are to their stops.
    edges = edges[np.concatenate(([True], np.diff(edges) > 0.0))]
    names = [station_at(line, float(edge)) or km_words(line, float(edge)) for edge in edges]
    return Sections(edges, tuple(names))


def section_table(trip: DrivenTrip, sections: Sections) -> pd.DataFrame:
    """What a trip took in each section; NaN where it is not recorded.

    Parameters
    ----------
    trip : DrivenTrip
    sections : Sections
        Sections that the trip did not run through are left out; of the others the part it ran.

    Returns
    -------
    DataFrame
        Indexed by section, in SI units: ``first``, ``last`` [m], ``covered`` (share of the
        section), ``running_time`` [s] without stands, ``stood`` [s] in the section off its
        stations, ``dwell`` [s] at the station where it ends, ``traction``, ``braking`` (all
        brakes), ``dynamic_braking`` [J] at the wheel rims, ``line`` [J], ``coasting`` (share of
        the distance), ``excess`` [m/s] largest, ``excess_distance`` [m], ``slips`` (number),
        ``off_advised_speed`` [m/s] from the speed that it followed, ``lateness`` [s] at its end.

    Examples
    --------
    >>> from analysis.comparison.driven import driven_trip
    >>> trip = driven_trip("sample_logs/stopping.mcap")
    >>> found = section_table(trip, sections_between(trip.line, *trip.covered))
    >>> found["dwell"].round(1).tolist()
    [41.5, 44.7, 41.2, 0.0]
    """
    edges = sections.edges_of(trip)
    low, high = np.clip(edges[:-1], *trip.covered), np.clip(edges[1:], *trip.covered)
    ran = np.flatnonzero(high - low > STOPPING_REACH)
    low, high = low[ran], high[ran]
    if ran.size and abs(trip.covered[0] - low[0]) <= STOPPING_REACH:
        low[0] = trip.covered[0]
    if ran.size and abs(trip.covered[1] - high[-1]) <= STOPPING_REACH:
        high[-1] = trip.covered[1]
    index = pd.Index([sections.names[row] for row in ran], name="section")
    whole = edges[ran + 1] - edges[ran]
    stood, dwell = np.zeros(ran.size), np.zeros(ran.size)
    rows = {int(section): row for row, section in enumerate(ran)}
    for stand in trip.stands:
        edge = sections.edge_of(stand)
        row = rows.get(int(sections.of(stand.position)) if edge is None else edge - 1)
        if row is not None:
            (stood if edge is None else dwell)[row] += stand.duration

    def between(values: FloatArray) -> FloatArray:
        return np.asarray(trip.at(values, high) - trip.at(values, low))

    found = {
        "first": low,
        "last": high,
        "covered": (high - low) / whole,
        "running_time": between(trip.running),
        "stood": stood,
        "dwell": dwell,
        **_energies(trip, between),
        **_driving(trip, low, high),
    }
    return pd.DataFrame(found, index=index)


def _energies(
    trip: DrivenTrip, between: Callable[[FloatArray], FloatArray]
) -> dict[str, FloatArray]:
    """Work at the wheels and energy from the line of each section [J]."""
    sums = trip.sums

    def known(name: str) -> FloatArray:
        if name not in sums:
            return np.nan * between(trip.running)
        gaps = between(sums[f"unknown_{name}"]) > UNKNOWN_TIME
        return np.where(gaps, np.nan, between(sums[name]))

    dynamic = known("dynamic_braking")
    return {
        "traction": known("traction"),
        "braking": dynamic + known("pneumatic_braking"),
        "dynamic_braking": dynamic,
        "line": known("line"),
    }


TO_THE_LETTER = "advice obeyed"
"""Name of the drive of who follows a plan's advice without reaction and error."""

ADVISED_BAND = 3.0 / KMH
"""A speed so near to the one advised keeps to the advice [m/s]."""


def _driving(trip: DrivenTrip, low: FloatArray, high: FloatArray) -> dict[str, FloatArray]:
    """Coasting, excess speed, slip and how well advice was followed, by section."""
    step = np.diff(trip.position, prepend=trip.position[0])
    over = trip.speed - trip.limit_at(trip.position)
    number = np.searchsorted(high, trip.position, side="left")
    start = np.min(low, initial=np.inf)
    inside = (number < high.size) & (trip.position >= start)
    bins = np.where(inside, number, high.size)

    def summed(values: FloatArray) -> FloatArray:
        sums = np.bincount(bins, weights=values, minlength=high.size + 1)
        return np.asarray(sums[: high.size], dtype=np.float64)

    names = ("coasting", "slips", "off_advised_speed", "within_advice", "lateness")
    found = dict.fromkeys(names, np.full(high.size, np.nan))
    distance = np.maximum(summed(step), 1e-9)
    if "coasting" in trip.flags:
        found["coasting"] = summed(step * trip.flags["coasting"]) / distance
    largest = np.full(high.size + 1, -np.inf)
    np.maximum.at(largest, bins, over)
    excess = np.where(largest[: high.size] > EXCESS, largest[: high.size], 0.0)
    found |= {"excess": excess, "excess_distance": summed(step * (over > EXCESS))}
    if trip.slips is not None:
        places = np.interp(trip.slips, trip.time, trip.position)
        row = np.searchsorted(high, places, side="left")
        kept = (row < high.size) & (places >= start)
        found["slips"] = np.bincount(row[kept], minlength=high.size)[: high.size].astype(float)
    if "reference_speed" in trip.signals:
        off = trip.speed - trip.signals["reference_speed"]
        known = np.isfinite(off)
        squares = summed(np.where(known, step * np.nan_to_num(off) ** 2, 0.0))
        found["off_advised_speed"] = np.sqrt(squares / np.maximum(summed(step * known), 1e-9))
        moving = np.diff(trip.running, prepend=trip.running[0]) * known
        near = np.where(known, np.abs(off) <= ADVISED_BAND, False)
        found["within_advice"] = summed(moving * near) / np.maximum(summed(moving), 1e-9)
    if "lateness" in trip.signals:
        found["lateness"] = trip.at(trip.signals["lateness"], high)
    return found


@dataclass(frozen=True, slots=True)
class CommonRange:
    """Where two trips can be compared.

    Attributes
    ----------
    first, last : float [m]
    starts, ends : bool
        Both depart at `first` and arrive at `last`: there each is at its own end, though one stood
        some metres further on.
    """

    first: float
    last: float
    starts: bool
    ends: bool


def common_range(trip: DrivenTrip, reference: DrivenTrip) -> CommonRange | None:
    """What two trips over a line have in common; None where that is less than a kilometre."""
    first = max(trip.covered[0], reference.covered[0])
    last = min(trip.covered[1], reference.covered[1])
    if last - first < 1000.0:
        return None
    both = (trip, reference)
    return CommonRange(first, last, starts=_stand_at(both, 0), ends=_stand_at(both, -1))


def _stand_at(both: Sequence[DrivenTrip], end: int) -> bool:
    """Whether trips begin, or end, with a stand at the same place."""
    places = [each.covered[end] for each in both]
    stand = all(
        each.stands and abs(each.stands[end].position - place) < 1.0
        for each, place in zip(both, places, strict=True)
    )
    return stand and abs(places[0] - places[1]) <= STATION_REACH


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


@dataclass(frozen=True, eq=False)
class Lost:
    """Time lost by a trip against its reference.

    Attributes
    ----------
    total : float [s]
        Sum of all losses.
    losses : DataFrame
        Those that cost most first: ``lost`` [s], negative where time was gained; ``cause``, one of
        `CAUSES`, and ``words`` for it; ``place``, a section or ``"at"`` a station; ``section``, of
        a station that before it; ``first``, ``last`` [m], where it was lost.
    position : (n + 1,) array [m]
        Nodes of the cells.
    behind : (n + 1,) array [s]
        Time lost up to each node, stands included.
    """

    total: float
    losses: pd.DataFrame
    position: FloatArray
    behind: FloatArray

    def by_cause(self) -> dict[str, float]:
        """Seconds by cause, the largest first."""
        sums = self.losses.groupby("cause", sort=False)["lost"].sum()
        return {str(cause): float(s) for cause, s in sums.sort_values(ascending=False).items()}

    def largest(self) -> list[tuple[str, float]]:
        """The three causes with most seconds, either way."""
        every = [(cause, s) for cause, s in self.by_cause().items() if abs(s) >= SMALL]
        return sorted(every, key=lambda each: -abs(each[1]))[:3]

    def by_section(self, count: int) -> FloatArray:
        """Seconds of each of `count` sections, with the station where it ends."""
        section = self.losses["section"].to_numpy(np.int64)
        seconds = self.losses["lost"].to_numpy(np.float64)
        return np.bincount(section.clip(0, count - 1), seconds, count).astype(np.float64)


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
    doubtful: BoolArray
    stands: list[Stand]

    @staticmethod
    def of(trip: DrivenTrip, nodes: FloatArray, common: CommonRange) -> _Cells:
        middle = 0.5 * (nodes[1:] + nodes[:-1])
        doubtful = trip.flags.get("doubtful", np.zeros(trip.time.size))
        # Time without stands [s] at which a trip reaches each node of a common range.
        found = trip.at(trip.running, nodes)
        if common.starts:
            found[0] = 0.0
        if common.ends:
            found[-1] = trip.running[-1]
        low = -np.inf if common.starts else common.first + STATION_REACH
        high = np.inf if common.ends else common.last - STATION_REACH
        return _Cells(
            trip,
            nodes,
            np.diff(found),
            trip.at(trip.speed, middle),
            trip.limit_at(middle),
            trip.share_of("slip", nodes) > 0.2,
            trip.share_of("full_effort", nodes) > 0.5,
            np.diff(trip.at(np.cumsum(doubtful, dtype=np.float64), nodes))
            > 0.0,  # also of a jump while the train stands
            [each for each in trip.stands if low < each.position < high],
        )

    @property
    def ends(self) -> list[Stand]:
        """Stands at which the trip itself begins or ends."""
        return [each for each in self.trip.stands if each.duration == 0.0]

    @property
    def halts(self) -> list[Stand]:
        """Stands that count, and those at its ends."""
        return [*self.stands, *self.ends]


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
    mine, other = (
        _Cells.of(each, sections.nodes_of(each, nodes), common) for each in (trip, reference)
    )
    lost = mine.running - other.running
    causes = _causes(mine, other, lost)
    rows, started = _of_stands(mine, other, sections), 0.0
    if by_time_of_day:
        started = _later_start(trip, reference, common)
        rows.append((started, "start", f"at {sections.ends[0]}", 0, common.first, common.first))
    losses = pd.DataFrame(rows, columns=["lost", "cause", "place", "section", "first", "last"])
    # Running time lost by section and cause.
    first, last = nodes[:-1], nodes[1:]
    section = sections.of(first)
    cells = pd.DataFrame(
        {"lost": lost, "cause": causes, "section": section, "first": first, "last": last}
    )
    found = cells.groupby(["section", "cause"], as_index=False).agg(
        lost=("lost", "sum"), first=("first", "min"), last=("last", "max")
    )
    losses = pd.concat(
        [found.assign(place=np.array(sections.names, dtype=object)[found["section"]]), losses]
    )
    total = float(losses["lost"].sum())
    losses = losses[losses["lost"].abs() > ROUNDING]
    losses = losses.sort_values(
        ["lost", "first", "cause"], ascending=[False, True, True], ignore_index=True
    )
    losses["words"] = [CAUSES[cause][s < 0.0] for s, cause in losses[["lost", "cause"]].to_numpy()]
    behind = started + np.concatenate(([0.0], np.cumsum(lost)))
    for each, sign in ((mine, 1.0), (other, -1.0)):
        for stand in each.stands:
            beyond = each.nodes > min(stand.position, each.nodes[-2])
            behind = behind + sign * stand.duration * beyond
    return Lost(total, losses, nodes, behind)


def _nodes(common: CommonRange, sections: Sections) -> FloatArray:
    """Nodes of the cells: multiples of `CELL`, and the edges of the sections."""
    inner = CELL * np.arange(np.ceil(common.first / CELL), np.floor(common.last / CELL) + 1.0)
    return sections.with_edges(inner, CELL)


def _later_start(trip: DrivenTrip, reference: DrivenTrip, common: CommonRange) -> float:
    """By how much the trip is later at the first common position, by the time of day [s]."""
    day = 86_400.0
    times = [
        each.departure / 1e9 + (0.0 if common.starts else float(each.at(each.time, common.first)))
        for each in (trip, reference)
    ]
    return float((times[0] - times[1] + 0.5 * day) % day - 0.5 * day)


def _of_stands(mine: _Cells, other: _Cells, sections: Sections) -> list[tuple[object, ...]]:
    """Differences of dwell, by station, and stands off the stations: rows of the losses."""
    found: list[tuple[object, ...]] = []
    for edge, name in enumerate(sections.ends):
        at = [[s for s in each.stands if sections.edge_of(s) == edge] for each in (mine, other)]
        dwell = [sum(stand.duration for stand in stands) for stands in at]
        ends = [any(sections.edge_of(s) == edge for s in each.ends) for each in (mine, other)]
        both = all(stands or end for stands, end in zip(at, ends, strict=True))
        where = float(np.mean([stand.position for stands in at for stand in stands] or [0.0]))
        cause = "dwell" if both else "stop"
        section = max(edge - 1, 0)
        found.append((dwell[0] - dwell[1], cause, f"at {name}", section, where, where))
    for each, sign in ((mine, 1.0), (other, -1.0)):
        for stand in each.stands:
            if sections.edge_of(stand) is None:
                number = int(sections.of(stand.position))
                seconds, where = sign * stand.duration, stand.position
                cause = "stop" if stand.station else "held"
                found.append((seconds, cause, sections.names[number], number, where, where))
    return found


def _causes(mine: _Cells, other: _Cells, lost: FloatArray) -> NDArray[np.object_]:
    """The cause of each cell, one of `CAUSES`."""
    slower = _smoothed(lost) > 0.0
    causes = np.where(slower, "slower", "faster").astype(object)
    causes[slower & mine.full] = "full effort"
    causes[~slower & other.full] = "full effort"
    for kind in ("slip", "limit", "held", "stop"):
        for each, against in ((other, mine), (mine, other)):
            for event in _events(kind, each, against):
                causes[_stretch(event, each, against, back=kind != "slip")] = kind
    causes[mine.doubtful | other.doubtful] = "recording"
    return causes


def _smoothed(lost: FloatArray) -> FloatArray:
    width = 2 * round(SMOOTHED / CELL) + 1
    if lost.size < width:
        return np.full(lost.size, lost.mean())
    return np.convolve(np.pad(lost, width // 2, mode="edge"), np.ones(width) / width, mode="valid")


def _events(kind: str, mine: _Cells, other: _Cells) -> Iterable[tuple[int, int]]:
    """First cell and one past the last of each event that the other trip does not have."""
    if kind == "slip":
        return runs_of(mine.slip & ~other.slip & (mine.speed < other.speed - SAME_SPEED))
    if kind == "limit":
        lower = mine.limit < other.limit - LIMIT_STEP
        return runs_of(lower & (other.speed > mine.limit - LIMIT_STEP))
    stations = kind == "stop"
    found = [
        (cell, cell + 1)
        for stand in (mine.halts if stations else mine.stands)
        if bool(stand.station) == stations
        and not any(
            abs(each.position - stand.position) <= STATION_REACH
            or (stand.station and each.station == stand.station)
            for each in other.trip.stands
        )
        for cell in [_cell(mine, stand.position)]
        if cell is not None
    ]
    return found if stations else [*found, *_crawls(mine, other)]


def _cell(cells: _Cells, position: float) -> int | None:
    """Number of the cell at a position; None outside of them all."""
    low, high = cells.nodes[[0, -1]]
    if not low - STATION_REACH <= position <= high + STATION_REACH:
        return None
    return int(Sections(cells.nodes, ()).of(position))


def _crawls(mine: _Cells, other: _Cells) -> list[tuple[int, int]]:
    """Stretches on which a train that was braked crawls, away from stops and lower limits."""
    middle = 0.5 * (mine.nodes[1:] + mine.nodes[:-1])
    allowed = np.minimum(mine.limit, other.speed)
    slow = mine.speed < CRAWL_SHARE * allowed
    for stand in (*mine.halts, *other.halts):
        slow &= np.abs(middle - stand.position) > CRAWL_REACH
    for event in _events("limit", mine, other):  # it is braked for a limit
        slow[_stretch(event, mine, other, back=True)] = False
    found = []
    for begin, end in runs_of(slow):
        before = mine.speed[max(0, begin - round(1500.0 / CELL)) : begin + 1]
        lowest = float(mine.speed[begin:end].min())
        # It came faster and was slowed down, and it is no start from a stop.
        if before.max() > 2.0 * lowest and lowest < before[-1]:
            found.append((begin, end))
    return found


def _stretch(event: tuple[int, int], mine: _Cells, other: _Cells, *, back: bool) -> slice:
    """Cells in which an event costs time: slowing down for it, and recovering."""
    first, last = event[0], event[1] - 1
    begin = first - _gaining(mine.speed[first::-1], other.speed[first::-1]) if back else first
    behind = slice(last, last + 1 + round(RECOVERY / CELL))
    speed = mine.speed[behind]
    top = speed[_gaining(speed, other.speed[behind])]
    return slice(begin, last + int(np.argmax(speed >= top - REVERSAL)) + 1)


def _gaining(speed: FloatArray, against: FloatArray) -> int:
    """How many cells from the first one a speed is at its highest, until it is the other's."""
    over = (speed < np.maximum.accumulate(speed) - REVERSAL) | (speed >= against - SAME_SPEED)
    over[0] = False
    until = int(np.argmax(over)) if over.any() else speed.size
    return int(np.argmax(speed[: until + 1]))


NEARLY_ALL = 0.98
"""Of the longest trip's distance: the reference is chosen among trips that cover so much."""

LISTED = 12
"""Losses that are listed of a direction."""

SMALL = 0.5
"""Time lost [s] below which a loss is not listed."""

WHOLE = replace(DURATION, digits=0)


@dataclass(frozen=True, eq=False)
class ComparedTrip:
    """One trip beside the reference of its direction.

    Attributes
    ----------
    trip : DrivenTrip
    table : DataFrame
        What it took in each section; see `analysis.comparison.compare.section_table`. Where it
        has a reference, ``lost`` [s] in the section with the station where it ends.
    lost : Lost or None
        None of the reference itself, and of a trip that has less than a kilometre in common with
        it.
    common : (float, float) or None [m]
        What it has in common with the reference.
    energy : Band or None [J]
        Tractive work at the reference's load and running time; None where efforts, loads or
        resistance are not known, or the trips have only a part in common.
    """

    trip: DrivenTrip
    table: pd.DataFrame
    lost: Lost | None
    common: tuple[float, float] | None
    energy: Band | None = None

    @staticmethod
    def alone(trip: DrivenTrip, sections: Sections) -> ComparedTrip:
        """A trip that is compared with none: a reference, or beside one."""
        return ComparedTrip(trip, section_table(trip, sections), None, trip.covered)

    @property
    def name(self) -> str:
        """Of the trip."""
        return self.trip.name

    @property
    def facts(self) -> dict[str, Any]:
        """The trip as a whole, in SI units."""
        common, energy = self.common or (None, None), self.energy
        traction, missing = self.recorded_energy("traction")
        return {
            "trip": self.name,
            "first": self.trip.covered[0],
            "last": self.trip.covered[1],
            "duration": self.trip.duration,
            "mass": self.trip.mass.value,
            "mass_std": self.trip.mass.std,
            "first_in_common": common[0],
            "last_in_common": common[1],
            "lost": None if self.lost is None else self.lost.total,
            "traction": traction,
            "share_without_efforts": missing,
            "normalised_traction": None if energy is None else energy.value,
            "normalised_traction_std": None if energy is None else energy.std,
        }

    def sum(self, column: str) -> float:
        """Sum of a column of the table; NaN where a section has none."""
        return float(self.table[column].sum(skipna=False))

    def recorded_energy(self, column: str) -> tuple[float | None, float | None]:
        """Energy ``traction`` or ``line`` [J] where it is recorded, and what share is missing.

        The share is of the running time; None where none is recorded.
        """
        sums, whole = self.trip.sums, self.sum(column)
        if column not in sums or self.table[column].dropna().empty:
            return None, None
        missing = float(np.ptp(sums[f"unknown_{column}"]) / self.trip.running[-1])
        return whole if math.isfinite(whole) else float(sums[column][-1]), missing

    def section_words(self, name: str) -> str:
        """What the trip took in a section, in words."""
        if name not in self.table.index:
            return "-"
        row = self.table.loc[name]
        words = f"{row['running_time']:.0f}"
        words += f" + {row['dwell']:.0f}" * bool(row["dwell"] >= SMALL)
        words += f" + stood {row['stood']:.0f}" * bool(row["stood"] >= SMALL)
        words += f", {row['covered']:.0%} of it" * bool(row["covered"] < 0.98)
        lost = float(self.table["lost"][name]) if "lost" in self.table else math.nan
        return words + (f" ({lost:+.0f})" if math.isfinite(lost) else "")

    def mean(self, column: str) -> float:
        """Mean of a column over the distance; NaN where no section has it."""
        return self._mean(self.table[column], self.table["last"] - self.table["first"])

    @property
    def off_advised_speed(self) -> float:
        """Root mean square [m/s] of the difference to the speed that it followed."""
        distance = self.table["last"] - self.table["first"]
        return float(np.sqrt(self._mean(self.table["off_advised_speed"] ** 2, distance)))

    @property
    def within_advice(self) -> float:
        """Share of the time in motion within `ADVISED_BAND` of the speed that it followed."""
        near, running = self.table["within_advice"], self.table["running_time"]
        return self._mean(near, running.where(near.notna()))

    @staticmethod
    def _mean(values: pd.Series, weights: pd.Series) -> float:
        return float((values * weights).sum(min_count=1) / weights.sum())


def _late_at_the_end(table: pd.DataFrame) -> float:
    """The last section's lateness [s]; NaN where the trip ran through none."""
    return float(table["lateness"].iloc[-1]) if len(table) else np.nan


def _energy(each: ComparedTrip, column: str) -> Said:
    value, missing = each.recorded_energy(column)
    if value is None or missing is None:
        return Said(None, "")
    part = "" if math.isfinite(each.sum(column)) else f", {missing:.1%} missing"
    return Said(value, f"{ENERGY.words(value, unit=False)}{part}")


def _excess(each: ComparedTrip) -> Said:
    excess, distance = float(each.table["excess"].max()), each.sum("excess_distance")
    return Said(excess, f"{KMH * excess:.1f} km/h, {distance:.0f} m" if excess else "none")


def _mass(each: ComparedTrip) -> Band | None:
    mass = each.trip.mass
    return Band(mass.value, mass.std) if mass.known else None


DRIVING = (
    Column("trip", of="name"),
    Column("mass", MASS, band=True, of=_mass),
    Column("coasting", replace(SHARE, digits=0), of=lambda each: each.mean("coasting")),
    Column("excess speed", SPEED, each=True, of=_excess),
    Column("slips", NUMBER, of=lambda each: float(each.table["slips"].sum(min_count=1))),
    Column("off advised speed\n(RMS)", SPEED, key="off_advised_speed"),
    Column(
        f"within {KMH * ADVISED_BAND:.0f} km/h\nof it",
        replace(SHARE, digits=0),
        key="within_advice",
        of=lambda each: each.within_advice,
    ),
    Column("late at the end", DURATION, of=lambda each: _late_at_the_end(each.table)),
    Column("braked", ENERGY, of=lambda each: each.sum("braking")),
)
"""How a trip was driven: coasting, excess speed, slip, how well advice was kept."""


@dataclass(frozen=True, eq=False)
class ComparedDirection:
    """Trips in one direction of a line.

    Attributes
    ----------
    direction : {"forward", "reverse"}
    line : Line
        As travelled.
    sections : Sections
        Over all that any of the trips covers.
    reference : DrivenTrip
    trips : tuple of ComparedTrip
        The reference is among them unless it is a trajectory.
    model : str
        By which energies are normalised; empty if they are not.
    obeyed : DrivenTrip or None
        Where the reference is a trajectory: the trip of a driver who follows its advice to the
        letter, in the same configuration.
    """

    direction: str
    line: Line
    sections: Sections
    reference: DrivenTrip
    trips: tuple[ComparedTrip, ...]
    model: str = ""
    obeyed: DrivenTrip | None = None

    @property
    def name(self) -> str:
        """Line and direction."""
        return f"{self.line.name}, {self.direction}"

    def losses(self) -> pd.DataFrame:
        """Time lost by trip, place and cause; the largest first, in SI units."""
        columns = ["trip", "lost", "cause", "place", "first", "last", "words"]
        every = [
            each.lost.losses.assign(trip=each.name) for each in self.trips if each.lost is not None
        ]
        found = pd.concat(every)[columns] if every else pd.DataFrame(columns=columns)
        return found.sort_values("lost", ascending=False, kind="stable", ignore_index=True)

    def tables(self) -> list[WordTable]:
        """Trips, sections, losses, how it was driven."""
        found = [self.trips_table(), self.sections_table()]
        if any(trip.lost is not None and len(trip.lost.losses) for trip in self.trips):
            found.append(self.losses_table())
        driven = [each.table[["coasting", "slips", "off_advised_speed"]] for each in self.trips]
        if pd.concat(driven).notna().any(axis=None):
            title = f"{self.name}: how it was driven"
            found.append(new_table(title, *DRIVING, name="driving").add_rows(self.trips))
        return found

    def _data(self, frame: pd.DataFrame) -> pd.DataFrame:
        return with_units(frame.assign(direction=self.direction))

    def _km(self, first: float, last: float) -> str:
        short = last - first < 100.0
        return span(in_km(self.line, [first, first if short else last]), digits=1)

    def trips_table(self) -> WordTable:
        """Each trip as a whole: part of the line, times, energy, time lost by cause."""
        planned = "the trajectory" if self.reference.planned else f"'{self.reference.name}'"
        plans = (self.reference, self.obeyed) if self.reference.planned else ()
        beside = [ComparedTrip.alone(each, self.sections) for each in plans if each is not None]
        rows = [*self.trips, *beside]
        return new_table(
            f"{self.name}: trips; time lost against {planned}",
            Column("trip", of="name"),
            Column("km", of=lambda each: self._km(*each.trip.covered)),
            Column("running", of=lambda each: clock(each.sum("running_time"))),
            Column("dwell", WHOLE, of=lambda each: each.sum("dwell") + each.sum("stood")),
            Column(
                "lost", of=lambda each: "" if each.lost is None else f"{each.lost.total:+.1f} s"
            ),
            Column("most of it", of=self._causes),
            Column("wheels", ENERGY, of=lambda each: _energy(each, "traction")),
            Column("line", ENERGY, of=lambda each: _energy(each, "line")),
            Column(
                "wheels at reference's\nload and time", ENERGY, of=lambda each: each.energy or ""
            ),
            name="trips",
            frame=self._data(pd.DataFrame([each.facts for each in rows])),
        ).add_rows(rows)

    def _causes(self, each: ComparedTrip) -> str:
        if each.lost is None or each.common is None:
            if each.trip is self.obeyed:
                return ""
            own = each.trip is self.reference
            return "reference" if own else "nothing in common with the reference"
        low, high = each.trip.covered
        parted = each.common[0] > low + 200.0 or each.common[1] < high - 200.0
        part = f" (km {self._km(*each.common)})" if parted else ""
        return ", ".join(f"{cause} {s:+.0f}" for cause, s in each.lost.largest()) + part

    def sections_table(self) -> WordTable:
        """Running time by section, and dwell at the station behind it, side by side."""
        title = (
            f"{self.name}: running time by section + dwell at its end (+ stood on the way) [s];"
            " in brackets lost"
        )
        rows = [each.table.assign(trip=each.name).reset_index() for each in self.trips]
        table = new_table(
            title,
            Column("section"),
            Column("km"),
            *(Column(each.name) for each in self.trips),
            name="sections",
            frame=self._data(pd.concat(rows, ignore_index=True)),
        )
        places = in_km(self.line, self.sections.edges[:-1])
        for name, km in zip(self.sections.names, places, strict=True):
            table.add_cells(name, f"{km:.1f}", *(each.section_words(name) for each in self.trips))
        return table

    def losses_table(self) -> WordTable:
        """Where most time was lost, and why; then where most was gained."""
        every = self.losses()
        large = every[every["lost"].abs() >= SMALL]
        lost, gained = large[large["lost"] > 0.0], large[large["lost"] < 0.0]
        shown = pd.concat([lost.head(LISTED), gained.tail(max(1, LISTED // 4)).iloc[::-1]])
        return new_table(
            f"{self.name}: where time was lost, {min(LISTED, len(lost))} of {len(lost)} places;"
            f" gained in {len(gained)}",
            Column("lost [s]", of=lambda row: f"{row['lost']:+.1f}"),
            Column("trip"),
            Column("place"),
            Column("km", of=lambda row: self._km(row["first"], row["last"])),
            Column("cause", of="words"),
            name="losses",
            frame=self._data(every),
        ).add_rows(shown.to_dict("records"))

    @property
    def notes(self) -> list[str]:
        """What a reader of the tables must know, in sentences."""
        every = [f"{each.name}: {note}" for each in self.trips for note in each.trip.notes]
        if self.model:
            every.append(
                f"Tractive energy at the load and running time of '{self.reference.name}', by the"
                f" running resistance of the {self.model}; ± is half the 95 % band."
            )
        if any((each.table["excess"] > 0.0).any() for each in self.trips):
            every.append(
                "Excess speed is over the limit under the whole train; plans keep the limit at the"
                " train's front unless made with --set protect=train."
            )
        for each in self.trips:
            missing = each.trip.sums.get("unknown_traction", np.zeros(1))
            if np.ptp(missing) > UNKNOWN_TIME and each.recorded_energy("traction")[0] is None:
                every.append(
                    f"{each.name}: no effort for {np.ptp(missing):.0f} s in all sections together:"
                    " the energy of none is known"
                )
        unknown = [each.name for each in self.trips if "traction" not in each.trip.sums]
        if unknown:
            names = ", ".join(unknown)
            every.append(f"no efforts are recorded: the energy of {names} is not known")
        elif not all("supply" in each.trip.sums for each in self.trips):
            every.append(
                "Energy from the line follows from the train's efficiencies where no current"
                " is recorded."
            )
        return every


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Presented):
    """Trips over a line, compared by position.

    Attributes
    ----------
    directions : tuple of ComparedDirection
        Directions are kept apart.
    left_out : tuple of str
        Trips that could not be compared, with the reason.
    """

    charts_by: ClassVar[str] = "analysis.comparison.plot:all_charts"

    directions: tuple[ComparedDirection, ...]
    left_out: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """How many trips were compared on which line."""
        trips = sum(len(each.trips) for each in self.directions)
        return f"Comparison of {counted(trips, 'trip')} on {self.directions[0].line.name}"

    def facts(self) -> dict[str, Any]:
        """Line, and the reference of each direction."""
        return {
            "line": self.directions[0].line.name,
            "references": {each.direction: each.reference.name for each in self.directions},
            "left_out": self.left_out,
        }

    def tables(self) -> list[WordTable]:
        """Of each direction by itself: trips, sections, losses, how it was driven."""
        return [table for each in self.directions for table in each.tables()]

    @property
    def notes(self) -> list[str]:
        """What a reader of the tables must know."""
        every = [note for each in self.directions for note in each.notes]
        return every + [f"left out: {reason}" for reason in self.left_out]

    def summary(self) -> dict[str, str]:
        """Each direction."""
        rows = {}
        for each in self.directions:
            rows[each.direction] = f"{counted(len(each.trips), 'trip')}, reference" + (
                f" '{each.reference.name}', {clock(each.reference.duration)}"
            )
            lost = [(trip.name, trip.lost) for trip in each.trips if trip.lost is not None]
            for name, found in lost[:4]:
                causes = [f"{cause} {s:+.0f} s" for cause, s in found.largest()]
                rows[f"  {name}"] = f"{found.total:+.1f} s: {', '.join(causes)}"
        if self.left_out:
            rows["left out"] = str(len(self.left_out))
        return rows

    def trip(self, name: str) -> ComparedTrip:
        """The compared trip of a name.

        Raises
        ------
        InputError
            If there is none.
        """
        found = [trip for each in self.directions for trip in each.trips if trip.name == name]
        if not found:
            known = ", ".join(trip.name for each in self.directions for trip in each.trips)
            raise InputError(f"no trip '{name}' was compared", remedy=f"there are {known}")
        return found[0]


def compare(
    trips: Given | Iterable[Given],
    reference: Given | Plan | None = None,
    *,
    line: Line | None = None,
    model: ParameterSet | None = None,
    by_time_of_day: bool = False,
) -> Comparison:
    """Compare trips over a line by position.

    Parameters
    ----------
    trips : Trip, path, or iterable of them
        Stopping or not, recorded or simulated, of any part of the line.
    reference : Trip, path, Trajectory or JourneyPlan, optional
        Or the trajectories of a journey's sections, from stop to stop. Default, for each direction:
        the fastest of the trips that cover nearly all that any of them covers.
    line : Line, optional
        In its own direction; default: the line that the first trip carries.
    model : ParameterSet, optional
        By whose running resistance energies are normalised; default: the train's file.
    by_time_of_day : bool
        A later departure counts as time lost, by the time of day.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If no trip can be compared.

    Examples
    --------
    >>> found = compare("sample_logs")
    >>> found.trip("trip-03").lost.by_cause()["stop"] > 200.0
    True
    >>> stopping = found.trip("trip-03")
    >>> round(float(stopping.table["lost"].sum()) - stopping.lost.total, 6)
    0.0
    """
    driven, left_out = _driven(trips, line)
    if not driven:
        raise InputError(
            f"no trip can be compared: {left_out[0]}"
            if left_out
            else "there is no trip to compare",
            remedy="give logs with speed and chainage on one line",
        )
    line = driven[0].line.travelled(driven[0].direction) if line is None else line
    of_line = [each for each in driven if each.line.name == line.name]
    left_out += [
        f"trip '{each.name}' ran on line '{each.line.name}', not on '{line.name}'"
        for each in driven
        if each.line.name != line.name
    ]
    stated = obeyed = None
    if reference is not None and not isinstance(reference, Trip | TripView | str | Path):
        plans, dwells = _sections(reference)
        train = next((each.train for each in of_line if each.train is not None), None)
        for each in plans:
            each.check(line.name, each.train if train is None else train.name)
        stated = in_succession([planned_trip(each, line, train) for each in plans], dwells)
        try:
            obeyed = in_succession([_obeyed(each, line, train) for each in plans], dwells)
        except TrainlogError as error:
            left_out.append(f"{TO_THE_LETTER}: {error}")
    elif reference is not None:
        stated = _comparable(reference, line)
    directions, alone = list[ComparedDirection](), list[str]()
    both = len({each.direction for each in of_line}) > 1
    for direction in ("forward", "reverse"):
        same = [each for each in of_line if each.direction == direction]
        if not same:
            continue
        own = stated if stated is not None and stated.direction == direction else None
        chosen = own or _fastest(same)
        if own is not None and not own.planned:
            chosen = next((each for each in same if each.same_drive(own)), own)
            # A reference that is not among the trips is shown beside them.
            same = same if chosen in same else [chosen, *same]
        if both and same == [chosen]:
            alone.append(
                f"trip '{chosen.name}' is the only one that ran {direction}: there is nothing to"
                " compare it with"
            )
            continue
        followed = None if own is None else obeyed
        directions.append(_direction(direction, same, chosen, model, by_time_of_day, followed))
    if not directions:
        raise InputError(
            f"the trips ran in opposite directions: {alone[0]}",
            remedy="give another trip of its direction, or a reference",
        )
    return Comparison(tuple(directions), (*left_out, *alone))


def _driven(
    trips: Given | Iterable[Given], line: Line | None
) -> tuple[list[DrivenTrip], list[str]]:
    """Trips that can be compared, and why others cannot."""
    found, left_out = list[DrivenTrip](), list[str]()
    for given in each_given(trips):
        try:
            trip = _comparable(given, line)
            again = next((each for each in found if each.same_drive(trip)), None)
            if again is None:
                found.append(trip)
            else:
                left_out.append(
                    f"trip '{trip.name}' is the same drive as '{again.name}': counted once"
                )
        except TrainlogError as error:
            where = f"{given}: " if isinstance(given, Path) and error.file is None else ""
            left_out.append(where + str(error))
    taken = set[str]()
    return [replace(each, name=unused(each.name, taken)) for each in found], left_out


def _comparable(given: Given, line: Line | None) -> DrivenTrip:
    """The trip, if it went farther than a stop at a station does."""
    trip = driven_trip(given, line)
    run = trip.covered[1] - trip.covered[0]
    if run <= STOPPING_REACH:
        raise LogError(
            f"trip '{trip.name}' goes on by {run:.0f} m of chainage: too short to compare",
            remedy="leave it out",
        )
    return trip


def _sections(plan: Plan) -> tuple[Sequence[Trajectory], list[float]]:
    """The sections of a plan in order, and how long it stands between them [s]."""
    if isinstance(plan, Trajectory):
        return [plan], []
    # The solvers' extra is needed for plans alone.
    from analysis.trajectory.advice import journey_advice

    found = journey_advice(plan if isinstance(plan, Sequence) else plan.sections)
    sections = found.sections
    dwells = np.diff(found.departures) - [each.running_time for each in sections[:-1]]
    return sections, dwells.tolist()


def _obeyed(plan: Trajectory, line: Line, train: Train | None) -> DrivenTrip:
    """The trip by the advice of a plan to the letter.

    Raises
    ------
    TrainlogError
        If no trip states its train, the plan gives no advice, or nobody can drive by it.
    """
    # The solvers' extra is needed for plans alone.
    from analysis.control.advised import obeyed_trip

    if train is None:
        raise InputError("no trip states its train", remedy="give a log that holds its train")
    return replace(driven_trip(obeyed_trip(plan, line, train), line), name=TO_THE_LETTER)


def _fastest(trips: Sequence[DrivenTrip]) -> DrivenTrip:
    longest = max(float(np.ptp(each.covered)) for each in trips)
    whole = [each for each in trips if np.ptp(each.covered) >= NEARLY_ALL * longest]
    return min(whole, key=lambda each: each.duration)


def _direction(
    direction: str,
    trips: Sequence[DrivenTrip],
    reference: DrivenTrip,
    model: ParameterSet | None,
    by_time_of_day: bool,
    obeyed: DrivenTrip | None,
) -> ComparedDirection:
    line = trips[0].line
    if reference.planned:
        trips = [_advised(each, reference) for each in trips]
    every = [*trips, reference]
    low = min(each.covered[0] for each in every)
    high = max(each.covered[1] for each in every)
    sections = sections_between(line, low, high)
    train = reference.train
    forces = None if train is None else ForceModel.of(train, reference.line, model)
    compared = [
        _compared(trip, reference, sections, forces, by_time_of_day)
        if trip is not reference
        else ComparedTrip.alone(trip, sections)
        for trip in trips
    ]
    used = any(each.energy is not None for each in compared)
    name = forces.name if forces is not None and used else ""
    return ComparedDirection(direction, line, sections, reference, tuple(compared), name, obeyed)


def _advised(trip: DrivenTrip, plan: DrivenTrip) -> DrivenTrip:
    """The trip with the speed that it followed; that of the plan where none is recorded."""
    if "reference_speed" in trip.signals:
        return trip
    speed = np.interp(trip.position, plan.position, plan.speed, np.nan, np.nan)
    return replace(trip, signals={**trip.signals, "reference_speed": speed})


def _compared(
    trip: DrivenTrip,
    reference: DrivenTrip,
    sections: Sections,
    forces: ForceModel | None,
    by_time_of_day: bool,
) -> ComparedTrip:
    table = section_table(trip, sections)
    common = common_range(trip, reference)
    if common is None:
        return ComparedTrip(trip, table, None, None)
    shared = sections_between(trip.line, common.first, common.last)
    lost = lost_time(trip, reference, common, shared, by_time_of_day=by_time_of_day)
    # Time lost in the rows of a trip's table; NaN in sections that are not in common.
    # A section of the common range lies in one of the table, of which it may be a part.
    inner = 0.5 * (shared.edges[1:] + shared.edges[:-1])
    row = np.searchsorted(table["last"], inner)
    within = inner >= np.append(table["first"], np.inf)[row]
    count, seconds = (
        np.bincount(row[within], weights, minlength=len(table))
        for weights in (None, lost.by_section(inner.size)[within])
    )
    table = table.assign(lost=np.where(count > 0, seconds, np.nan))
    whole = common.starts and common.ends
    energy = normalised_energy(trip, reference, forces) if whole and forces is not None else None
    return ComparedTrip(trip, table, lost, (common.first, common.last), energy)
