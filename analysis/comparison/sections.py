"""Sections between stations: what a trip took in each, and what two trips have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.comparison.driven import UNKNOWN_TIME, DrivenTrip, Stand
from trainlog.arrays import FloatArray
from trainlog.presentation import Quantity
from trainlog.railway import Line
from trainlog.railway.kilometres import STATION_REACH, km_words, station_at
from trainlog.units import KMH

EXCESS = 1.0 / KMH
"""Speed over the limit [m/s] from which it is stated: less is within what speeds are known to."""

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

    def of(self, position: float) -> int:
        """Number of the section that holds a position [m]."""
        found = int(np.searchsorted(self.edges, position, side="right")) - 1
        return min(max(found, 0), self.edges.size - 2)

    def edge_of(self, stand: Stand) -> int | None:
        """Number of the edge at whose station a train stands; None where it stands in a section."""
        if not stand.station:
            return None
        near = np.flatnonzero(np.abs(self.edges - stand.position) <= 2.0 * STATION_REACH)
        return next((int(edge) for edge in near if self.ends[edge] == stand.station), None)


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
    [41.5, 43.8, 41.2, 0.0]
    """
    low = np.clip(sections.edges[:-1], *trip.covered)
    high = np.clip(sections.edges[1:], *trip.covered)
    ran = np.flatnonzero(high - low > STOPPING_REACH)
    low, high = low[ran], high[ran]
    if ran.size and abs(trip.covered[0] - low[0]) <= STOPPING_REACH:
        low[0] = trip.covered[0]
    if ran.size and abs(trip.covered[1] - high[-1]) <= STOPPING_REACH:
        high[-1] = trip.covered[1]
    index = pd.Index([sections.names[row] for row in ran], name="section")
    whole = sections.edges[ran + 1] - sections.edges[ran]
    stood, dwell = np.zeros(ran.size), np.zeros(ran.size)
    rows = {int(section): row for row, section in enumerate(ran)}
    for stand in trip.stands:
        edge = sections.edge_of(stand)
        row = rows.get(sections.of(stand.position) if edge is None else edge - 1)
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


def _energies(trip: DrivenTrip, between: object) -> dict[str, FloatArray]:
    """Work at the wheels and energy from the line of each section [J]."""
    assert callable(between)
    count = between(trip.running).size
    unknown = np.full(count, np.nan)
    sums = trip.sums
    found = dict.fromkeys(("traction", "braking", "dynamic_braking", "line"), unknown)
    if "traction" in sums:
        gaps = between(sums["unknown_effort"]) > UNKNOWN_TIME
        brakes = {
            name: np.where(
                between(sums[f"unknown_{name}"]) > UNKNOWN_TIME, np.nan, between(sums[name])
            )
            for name in ("dynamic_braking", "pneumatic_braking")
            if name in sums
        }
        found["traction"] = np.where(gaps, np.nan, between(sums["traction"]))
        if "dynamic_braking" in sums:
            found["dynamic_braking"] = brakes["dynamic_braking"]
        if len(brakes) == 2:
            found["braking"] = np.sum(list(brakes.values()), axis=0)
    if "supply" in sums:
        gaps = between(sums["unknown_supply"]) > UNKNOWN_TIME
        found["line"] = np.where(gaps, np.nan, between(sums["supply"]))
    elif trip.train is not None and "traction" in sums:
        fed_back = found["dynamic_braking"] if "dynamic_braking" in sums else 0.0
        found["line"] = (
            found["traction"] / trip.train.efficiency_traction
            - trip.train.efficiency_regeneration * fed_back
        )
    return found


def _driving(trip: DrivenTrip, low: FloatArray, high: FloatArray) -> dict[str, FloatArray]:
    """Coasting, excess speed, slip and how well advice was followed, by section."""
    step = np.diff(trip.position, prepend=trip.position[0])
    over = trip.speed - trip.limit
    number = np.searchsorted(high, trip.position, side="left")
    inside = (number < high.size) & (trip.position >= low[0])
    bins = np.where(inside, number, high.size)

    def summed(values: FloatArray) -> FloatArray:
        sums = np.bincount(bins, weights=values, minlength=high.size + 1)
        return np.asarray(sums[: high.size], dtype=np.float64)

    unknown = np.full(high.size, np.nan)
    found = {
        "coasting": unknown,
        "slips": unknown,
        "off_advised_speed": unknown,
        "lateness": unknown,
    }
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
        kept = (row < high.size) & (places >= low[0])
        found["slips"] = np.bincount(row[kept], minlength=high.size)[: high.size].astype(float)
    if "reference_speed" in trip.signals:
        off = trip.speed - trip.signals["reference_speed"]
        known = np.isfinite(off)
        squares = summed(np.where(known, step * np.nan_to_num(off) ** 2, 0.0))
        found["off_advised_speed"] = np.sqrt(squares / np.maximum(summed(step * known), 1e-9))
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
    starts = all(_stands_at(each, 0) for each in both) and _near(trip, reference, 0)
    ends = all(_stands_at(each, -1) for each in both) and _near(trip, reference, -1)
    return CommonRange(first, last, starts, ends)


def _stands_at(trip: DrivenTrip, end: int) -> bool:
    """Whether the trip begins or ends with a stand."""
    return bool(trip.stands) and abs(trip.stands[end].position - trip.covered[end]) < 1.0


def _near(trip: DrivenTrip, reference: DrivenTrip, end: int) -> bool:
    return abs(trip.covered[end] - reference.covered[end]) <= STATION_REACH


def running_times(trip: DrivenTrip, nodes: FloatArray, common: CommonRange) -> FloatArray:
    """Time without stands [s] at which a trip reaches each node of a common range."""
    found = trip.at(trip.running, nodes)
    if common.starts:
        found[0] = 0.0
    if common.ends:
        found[-1] = trip.running[-1]
    return np.asarray(found)


def counted_stands(trip: DrivenTrip, common: CommonRange) -> list[Stand]:
    """Stands in a common range; at an end where only one of two trips ends they do not count."""
    low = common.first if common.starts else common.first + STATION_REACH
    high = common.last if common.ends else common.last - STATION_REACH
    if common.starts:
        low = -np.inf
    if common.ends:
        high = np.inf
    return [each for each in trip.stands if low < each.position < high]
