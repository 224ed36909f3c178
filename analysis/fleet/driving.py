"""Times, energy and losses of a trip on each edge that it ran over."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from analysis.comparison import LOST
from analysis.comparison.compare import (
    STOPPING_REACH,
    CommonRange,
    Sections,
    lost_time,
    section_table,
)
from analysis.comparison.driven import DrivenTrip, Stand, driven_trip
from analysis.network.edges import edges_of
from analysis.view import TripView
from trainlog.arrays import FloatArray
from trainlog.errors import LogError
from trainlog.formats.railway import largest_load
from trainlog.railway.line import STATION_REACH
from trainlog.railway.motion import timetable_run
from trainlog.units import NANOSECONDS

SHORTEST_RUN = 500.0
"""Two stops nearer to each other than this [m] are one: the train was moved up."""

SERVICE_DECELERATION, FULL_LEVER = 0.6, 1.0
"""Deceleration [m/s²] and share of the effort of the shortest run that losses are counted from."""


def driven_edges(trip: TripView) -> list[Mapping[str, Any]]:
    """What a trip took on each stretch of an edge; rows with the names of `DRIVING`.

    Raises
    ------
    LogError
        If the trip has no chainage, never moves, or runs back and forth.
    """
    driven = driven_trip(trip)
    every = edges_of(trip.line, backwards=trip.backwards)
    low, high = driven.covered
    # Those of which it ran over more than stopping at their end takes.
    stretches = sorted(
        (
            (edge.name, stretch)
            for edge in every
            for stretch in edge.stretches
            if min(high, stretch.last) - max(low, stretch.first) > STOPPING_REACH
        ),
        key=lambda each: each[1].first,
    )
    borders = np.array([stretch.first for _, stretch in stretches[1:]])
    edges = np.concatenate(([low], borders, [high]))
    sections = Sections(edges, tuple(f"edge {number}" for number in range(edges.size)))
    table = section_table(driven, sections)
    if len(table) != len(stretches) or not stretches:
        raise LogError(
            f"trip '{trip.name}' moves by {high - low:.0f} m only: there is nothing to compare",
            remedy="leave it out",
        )
    lost, shortest = _losses(trip, sections)
    rows: list[Mapping[str, Any]] = []
    for number, (name, stretch) in enumerate(stretches):
        own = table.iloc[number]
        begin, end = float(own["first"]), float(own["last"])
        places = stretch.on_edge([begin, end])
        # A stand at the end of a section counts for it, not for the section behind it.
        ends = edges[number : number + 2] + STATION_REACH
        ends[0] = -np.inf if number == 0 else ends[0]
        ends[1] = np.inf if number + 2 == edges.size else ends[1]
        stands = [each for each in driven.stands if ends[0] < each.position <= ends[1]]
        dwell = [each for each in stands if each.station and each.duration > 0.0]
        rows.append(
            {
                "trip": trip.name,
                "edge": name,
                "direction": "reverse" if stretch.backwards else "forward",
                "first": float(places[0]),
                "last": float(places[1]),
                "entered": driven.departure
                + round(float(driven.at(driven.time, begin)) * NANOSECONDS),
                "distance": end - begin,
                "running_time": float(own["running_time"]),
                "dwell": sum(each.duration for each in dwell),
                "held": sum(each.duration for each in stands if not each.station),
                "stops": len(dwell),
                "line_energy": float(own["line"]),
                "line_energy_source": _source(driven, float(own["line"])),
                "mass": driven.mass.value,
                "mass_std": driven.mass.std,
                "shortest_time": shortest[number],
                **{name: float(own[name]) for name in _FROM_SECTIONS},
                **lost[number],
            }
        )
    return rows


_FROM_SECTIONS = (
    "traction", "dynamic_braking", "braking", "coasting", "excess", "excess_distance", "slips",
)  # fmt: skip


def _source(driven: DrivenTrip, energy: float) -> str:
    if not np.isfinite(energy):
        return ""
    return "recorded" if "supply" in driven.sums else "efficiencies"


def _losses(trip: TripView, sections: Sections) -> tuple[list[dict[str, float]], list[float]]:
    """Time lost in each section by cause, and the shortest running time; NaN where not known."""
    count = sections.edges.size - 1
    unknown = dict.fromkeys(LOST.values(), float("nan"))
    driven = driven_trip(trip)
    reference = shortest_trip(driven)
    if reference is None:
        return [unknown] * count, [float("nan")] * count
    common = CommonRange(*driven.covered, starts=True, ends=True)
    lost = lost_time(driven, reference, common, sections)
    none = dict.fromkeys(unknown, 0.0) | ({} if "slip" in driven.flags else {"lost_slip": np.nan})
    rows = [dict(none) for _ in range(count)]
    for section, cause, seconds in lost.losses[["section", "cause", "lost"]].to_numpy().tolist():
        if cause in LOST:
            rows[section][LOST[cause]] += seconds
    times = np.diff(reference.at(reference.running, sections.edges))
    return rows, times.tolist()


def shortest_trip(driven: DrivenTrip) -> DrivenTrip | None:
    """The shortest run by the train's file that makes the stops of a trip at stations.

    Full effort, service braking, the limits that the line's file states; the mass as known of the
    trip, else half of the largest load.

    Returns
    -------
    DrivenTrip or None
        None where no train is known, or the trip does not begin and end with a stand: a part
        of a recording.

    Examples
    --------
    >>> from analysis.comparison.driven import driven_trip
    >>> trip = driven_trip("sample_logs/stopping.mcap")
    >>> shortest = shortest_trip(trip)
    >>> bool(0.8 < shortest.running[-1] / trip.running[-1] < 1.0)
    True
    """
    train = driven.train
    low, high = driven.covered
    ends = [each.position for each in driven.stands]
    if train is None or len(ends) < 2 or max(ends[0] - low, high - ends[-1]) > STOPPING_REACH:
        return None
    inner = [each for each in driven.stands if each.station and each.duration > 0.0]
    stops = [low]
    for stand in inner:
        if stand.position - stops[-1] >= SHORTEST_RUN and high - stand.position >= SHORTEST_RUN:
            stops.append(stand.position)
    stops.append(high)
    load = driven.mass.value - train.mass if driven.mass.known else 0.5 * largest_load(train)
    position, speed, running = list[FloatArray](), list[FloatArray](), list[FloatArray]()
    for first, last in pairwise(stops):
        run = timetable_run(
            driven.line,
            train,
            first,
            last,
            deceleration=SERVICE_DECELERATION,
            lever=FULL_LEVER,
            load=max(load, 0.0),
        )
        position.append(run.positions)
        speed.append(run.speeds)
        running.append(run.times + (running[-1][-1] if running else 0.0))
    times = np.concatenate(running)
    stands = [Stand(low, 0.0, ""), *inner, Stand(high, 0.0, "")]
    return DrivenTrip(
        name="shortest run",
        direction=driven.direction,
        line=driven.line,
        train=train,
        mass=driven.mass,
        departure=driven.departure,
        time=times,
        running=times,
        position=np.concatenate(position),
        speed=np.concatenate(speed),
        stands=tuple(stands),
        distance=high - low,
        planned=True,
    )
