"""What a replay draws: a trip piece by piece, its line, the track condition, the trajectory.

Rerun's own map asks a server for its tiles. By default the line is therefore drawn as a plan, in
metres east and south of a common origin; a line without coordinates is drawn straight. A timeline
of Rerun counts in whole numbers: kilometres are therefore written out, as blocks under the plots,
and with three decimals beside them for the instant at the cursor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
import rerun as rr

from trainlog.arrays import FloatArray, IntArray
from trainlog.display import is_number
from trainlog.railway import Geometry, Line, TrackConditionMap, Trajectory
from trainlog.railway.condition import (
    ADHESION_BOUNDS,
    ADHESION_COLOURS,
    ConditionLayer,
    PassingSpot,
    adhesion_class,
)
from trainlog.railway.line import StepProfile, in_km, km_words
from trainlog.replay.samples import (
    COLOURS,
    PANELS,
    SPEEDS,
    SPEEDS_SHOWN,
    Clock,
    Colour,
    Curve,
    Instants,
    Panel,
    Pen,
    Samples,
    curves_of,
    from_whole_kilometre,
    legend,
    panels_of,
    path_of,
    phases,
    send_curve,
    send_dots,
    send_rows,
    send_samples,
    send_static,
    with_slip,
)
from trainlog.replay.survey import Reference, Survey, draw_difference
from trainlog.resampling import Nanoseconds, interpolated
from trainlog.topics import EVENTS, GNSS_FIX, REFERENCE
from trainlog.trip import Trip, nanoseconds
from trainlog.units import DAY, EARTH_RADIUS, KMH, NANOSECONDS, PER_MILLE

LEGEND_BELOW = 0.06
"""How far south of a course its legend stands, against its larger side."""


@dataclass(frozen=True)
class Chart:
    """What places are drawn on.

    Attributes
    ----------
    origin : (float, float) [deg]
        Latitude and longitude at which the plan has its zero.
    tiles : bool
        Over the tiles of a map, by latitude and longitude.
    """

    origin: tuple[float, float] = (0.0, 0.0)
    tiles: bool = False

    def plan(self, degrees: FloatArray) -> FloatArray:
        """Metres east and south of the origin, (n, 2), of latitudes and longitudes, (n, 2)."""
        latitude, longitude = self.origin
        north, east = np.radians(np.asarray(degrees, dtype=np.float64) - (latitude, longitude)).T
        scaled = EARTH_RADIUS * np.column_stack((east * np.cos(np.radians(latitude)), -north))
        return np.asarray(scaled)

    def strips(
        self, recording: Any, entity: str, parts: Sequence[FloatArray], colour: Colour, width: float
    ) -> None:
        """Draw lines through latitudes and longitudes, (n, 2) each, for all times."""
        style = {"radii": rr.Radius.ui_points(width), "colors": np.array([colour], dtype=np.uint8)}
        if self.tiles:
            send_static(recording, entity, rr.GeoLineStrings(lat_lon=list(parts), **style))
            return
        planned = [self.plan(part) for part in parts]
        send_static(recording, entity, rr.LineStrips2D(planned, draw_order=0.0, **style))

    def dots(
        self,
        recording: Any,
        entity: str,
        degrees: FloatArray,
        colours: Any,
        radius: float,
        label: str | None = None,
    ) -> None:
        """Draw points, (n, 2), for all times; on the plan with a label."""
        style = {"radii": rr.Radius.ui_points(radius), "colors": colours}
        if self.tiles:
            send_static(recording, entity, rr.GeoPoints(lat_lon=degrees, **style))
            return
        named = {} if label is None else {"labels": [label], "show_labels": True}
        points = rr.Points2D(self.plan(degrees), draw_order=1.0, **style, **named)
        send_static(recording, entity, points)

    def legend(
        self,
        recording: Any,
        entity: str,
        course: FloatArray,
        names: Sequence[str],
        colours: Any,
        radius: float,
    ) -> None:
        """Draw named dots in a row south of a course [deg], (n, 2), for all times.

        Nothing over tiles, where Rerun gives dots no names.
        """
        if self.tiles:
            return
        drawn = self.plan(course)
        low, high = drawn.min(axis=0), drawn.max(axis=0)
        size = max(float(np.max(high - low)), 1.0)
        x = low[0] + size * np.linspace(0.05, 0.85, len(names))
        places = np.column_stack((x, np.full(len(names), high[1] + LEGEND_BELOW * size)))
        points = rr.Points2D(
            places, draw_order=1.0, radii=rr.Radius.ui_points(radius), colors=colours,
            labels=list(names), show_labels=True,
        )  # fmt: skip
        send_static(recording, entity, points)

    def moving(
        self,
        recording: Any,
        entity: str,
        instants: Instants,
        degrees: FloatArray,
        *,
        colour: Colour,
        radius: float,
    ) -> None:
        """Draw a point that moves: where it is at each instant, (n, 2)."""
        style = {"radii": rr.Radius.ui_points(radius), "colors": np.array([colour])}
        kind = rr.GeoPoints if self.tiles else rr.Points2D
        drawn = {} if self.tiles else {"draw_order": 2.0}
        send_static(recording, entity, kind.from_fields(**style, **drawn))
        self.move(recording, entity, instants, degrees)

    def move(self, recording: Any, entity: str, instants: Instants, degrees: FloatArray) -> None:
        """Send further places of a point that moves, (n, 2)."""
        kind = rr.GeoPoints if self.tiles else rr.Points2D
        places = degrees if self.tiles else self.plan(degrees)
        send_rows(recording, entity, instants, lambda rows: kind.columns(positions=places[rows]))

    def laid_out(self, line: Line, backwards: bool) -> Line:
        """A line, as travelled, with coordinates: on a plan a straight one if it has none.

        Parameters
        ----------
        line : Line
            As travelled.
        backwards : bool
            It is travelled against its own direction.
        """
        if line.geometry is not None or self.tiles:
            return line
        latitude, longitude = self.origin
        reach = np.degrees(line.length / (EARTH_RADIUS * np.cos(np.radians(latitude))))
        ends = longitude + np.array([reach, 0.0] if backwards else [0.0, reach])
        straight = Geometry(
            np.array([0.0, line.length]), np.full(2, latitude), ends, "straight: none is known"
        )
        return replace(line, geometry=straight)


def chart_of(lines: Sequence[Line | None], fixes: Sequence[Any], *, tiles: bool = False) -> Chart:
    """A chart that begins at the first line with coordinates, or else at the first known fix.

    Parameters
    ----------
    lines : sequence of Line or None
    fixes : sequence of (time, (n, 2) array [deg]) or None
    tiles : bool
    """
    for line in lines:
        if line is not None and line.geometry is not None:
            geometry = line.geometry
            return Chart((float(geometry.latitudes[0]), float(geometry.longitudes[0])), tiles)
    for known in fixes:
        if known is not None and len(known[1]):
            return Chart((float(known[1][0, 0]), float(known[1][0, 1])), tiles)
    return Chart(tiles=tiles)


LAYERS: dict[str, Colour] = {"dry": (245, 205, 70), "wet": (90, 180, 240)}
"""Colours of the layers of a track-condition map; others are white."""

EXPECTED, SPOT = COLOURS["planned"], COLOURS["limit"]
"""Colours of the expected condition and of passing spots."""

LIKELY = 0.05
"""A spot is drawn if it lies there with this probability at least."""

CLASS_COLOURS = np.array(
    [[int(each[i : i + 2], 16) for i in (1, 3, 5)] for each in ADHESION_COLOURS], dtype=np.uint8
)
"""Of the classes of maximum adhesion: they show on the viewer's dark ground, too."""

LEGEND = (*(f"< {each:.2f}" for each in ADHESION_BOUNDS), f"≥ {ADHESION_BOUNDS[-1]:.2f}")
"""Their names in the legend."""

COLOURS_IN_WORDS = ", ".join(
    f"{colour} {name}"
    for colour, name in zip(("red", "orange", "yellow", "light blue", "blue"), LEGEND, strict=True)
)

BIN_SIZE, SPOT_WIDTH = 4.0, 5.0
"""Radius of a bin and half width of a spot on the map, in points."""


@dataclass(frozen=True, eq=False)
class Passage:
    """A trip over a line of which a layer of the track condition is known.

    Attributes
    ----------
    clock : Clock
        Of the trip.
    track : TrackConditionMap
    layer : str
    backwards : bool
        The trip runs against the line's own direction, in which the map is counted.
    whole : bool
        Bins that the trip did not reach count, too; they stand at the trip's ends in time.
    """

    clock: Clock
    track: TrackConditionMap
    layer: str
    backwards: bool
    whole: bool

    @property
    def known(self) -> ConditionLayer:
        """The layer."""
        return self.track.layer(self.layer)

    @property
    def time(self) -> pd.Timestamp:
        """When the trip began, UTC."""
        return pd.Timestamp(self.clock.start, tz="UTC")

    @property
    def spots(self) -> list[tuple[PassingSpot, float]]:
        """The spots that lay there then, each with its probability."""
        chances = [(spot, chance_of(spot, self.clock.start)) for spot in self.known.spots]
        return [each for each in chances if each[1] >= LIKELY]


def chance_of(spot: PassingSpot, time: int) -> float:
    """Probability that a spot lay there at a time [ns since 1970 UTC].

    While trips met it, it did; before the first of them nothing is known of it.
    """
    day = time // DAY
    if day <= spot.last:
        return float(day >= spot.first)
    return spot.alive(pd.Timestamp(time, tz="UTC"))


def draw_condition(recording: Any, passage: Passage, paths: Mapping[str, str]) -> set[str]:
    """Draw a condition under a trip: each piece of the line when the train was there.

    Parameters
    ----------
    recording : rerun.RecordingStream
    passage : Passage
    paths : mapping of str to str
        Where the lasting condition (``map``), that expected at the time of the trip (``expected``)
        and the passing spots that lay there (``spots``) are drawn.

    Returns
    -------
    set of str
        Those of which there was anything to draw.
    """
    known, track = passage.known, passage.track
    edges = np.arange(track.bins + 1, dtype=np.float64) * track.bin_length
    bins, lasting = (edges[:-1], edges[1:]), known.maximum_adhesion
    expected = known.expected(passage.time)
    # Half of what lies between the quantiles that are one deviation off in a normal distribution.
    low, high = (expected.quantile(share) for share in (0.158655, 0.841345))
    spots = [spot for spot, _ in passage.spots]
    spans = [(s.start, s.end, s.adhesion, (s.high - s.low) / (2.0 * 1.96)) for s in spots]
    levels = {
        "map": (
            LAYERS.get(passage.layer, COLOURS["true"]),
            *bins,
            lasting,
            lasting * known.log_std,
        ),
        "expected": (EXPECTED, *bins, expected.maximum_adhesion, 0.5 * (high - low)),
        "spots": (SPOT, *np.array(spans, dtype=np.float64).reshape(-1, 4).T),
    }
    return {
        name
        for name, (colour, *level) in levels.items()
        if _draw(recording, paths[name], passage, level, f"{name}, {passage.layer}", colour)
    }


def _draw(
    recording: Any,
    entity: str,
    passage: Passage,
    level: Sequence[FloatArray],
    name: str,
    colour: Colour,
) -> bool:
    """Draw starts, ends [m], maximum adhesion and its deviation, counted along the line."""
    start, end, value, std = level
    if passage.backwards:
        length = passage.track.length
        start, end, value, std = length - end[::-1], length - start[::-1], value[::-1], std[::-1]
    clock, reached = passage.clock, passage.clock.position
    shown = np.isfinite(value)
    if not passage.whole and reached.size:
        shown &= (end > reached[0]) & (start < reached[-1])
    if reached.size == 0 or not shown.any():
        return False
    start, end, value, std = start[shown], end[shown], value[shown], std[shown]
    # A piece of the line: a level line from its start to its end, then a break. A dot in its
    # middle is what can be seen of it when the whole line is shown.
    ends = np.column_stack((start, end, end)).ravel()
    blank = np.full(value.size, np.nan)
    time = _passing(clock, ends)
    send_curve(
        recording,
        f"{entity}/bins",
        Instants(clock.start, time, ends),
        Samples(
            time,
            np.column_stack((value, value, blank)).reshape(-1, 1),
            np.column_stack((std, std, blank)).reshape(-1, 1) ** 2,
        ),
        names=[name],
        colours=[colour],
    )
    middle = 0.5 * (start + end)
    send_dots(
        recording,
        f"{entity}/dots",
        Instants(clock.start, _passing(clock, middle), middle),
        value,
        name=name,
        colour=colour,
    )
    return True


def _passing(clock: Clock, position: FloatArray) -> Nanoseconds:
    """When the train was at each position [ns]."""
    seconds = np.interp(position, clock.position, (clock.time - clock.start) / NANOSECONDS)
    return clock.start + np.round(seconds * NANOSECONDS).astype(np.int64)


def draw_spots_on_map(
    recording: Any, entity: str, line: Line, passage: Passage, chart: Chart
) -> None:
    """Draw the spots that lay there when a trip began as pieces of the line.

    Nothing without coordinates. The name of a spot states where it is, when it was last met and
    how likely it lay there.

    Parameters
    ----------
    line : Line
        As the trip met it.
    passage : Passage
    chart : Chart
    """
    if line.geometry is None:
        return
    own = line.reversed() if passage.backwards else line
    assert own.geometry is not None
    for spot, chance in passage.spots:
        name = f"{km_words(own, spot.start)}, {np.datetime64(spot.last, 'D')}, {chance:.0%}"
        places = np.column_stack(own.geometry.at(np.linspace(spot.start, spot.end, 5)))
        path = f"{entity}{path_of(name)}"
        chart.strips(recording, path, [places], SPOT, SPOT_WIDTH)


def draw_bins_on_map(
    recording: Any, line: str, geometry: Geometry, passage: Passage, chart: Chart
) -> None:
    """Draw the observed bins of a layer as dots in the colours of their classes, with a legend.

    Rerun has no legend for places: on the plan it is a row of named dots beside the line. Over
    tiles, where dots have no names, the title of the view names the colours.

    Parameters
    ----------
    line : str
    geometry : Geometry
        Of the line in its own direction.
    chart : Chart
    """
    track = passage.track
    adhesion = passage.known.maximum_adhesion
    seen = np.isfinite(adhesion)
    if not seen.any():
        return
    root = path_of("lines", line, "condition", passage.layer)
    places = np.column_stack(geometry.at(track.centres[seen]))
    chart.dots(recording, root, places, CLASS_COLOURS[adhesion_class(adhesion[seen])], BIN_SIZE)
    course = np.column_stack((geometry.latitudes, geometry.longitudes))
    chart.legend(recording, f"{root}/legend", course, LEGEND, CLASS_COLOURS, BIN_SIZE)


def observed(condition: TrackConditionMap | None) -> list[str]:
    """Layers that have something to show."""
    layers = {} if condition is None else condition.layers
    return [name for name, layer in layers.items() if layer.observed.any()]


def top_of(condition: TrackConditionMap | None) -> float:
    """Upper end of an axis over nearly all bands of a map, in tenths."""
    highest = 0.0
    for name in observed(condition):
        assert condition is not None
        layer = condition.layers[name]
        upper = layer.maximum_adhesion * (1.0 + 2.0 * layer.log_std)
        highest = max(highest, float(np.nanquantile(upper, 0.95)))
    return max(0.4, 0.1 * float(np.ceil(10.0 * highest)))


BLOCKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Lengths of the blocks of the kilometre lane [km]."""

MOST_BLOCKS = 15
"""More have no place for their kilometres under a plot."""

SHORTEST_NAMED = 0.7
"""Share of its length from which a block has space for its kilometre."""

KILOMETRE_STEP = 10.0
"""How finely the operator's kilometre is sampled [m]."""

KILOMETRES: tuple[Colour, Colour] = (70, 75, 90), (105, 110, 125)
SECTIONS: tuple[Colour, Colour] = (50, 85, 125), (75, 120, 170)
"""Colours of neighbouring blocks."""


def draw_profile(
    recording: Any, root: str, line: Line, clock: Clock, known: frozenset[str] | set[str]
) -> set[str]:
    """Draw the limit and the gradient of a line under a trip that does not record them itself.

    Parameters
    ----------
    recording : rerun.RecordingStream
    root : str
        Path of the trip.
    line : Line
        As travelled.
    clock : Clock
    known : set of str
        Entities that are drawn already.

    Returns
    -------
    set of str
        Entities that were drawn.
    """
    drawn = set()
    profiles: list[tuple[str, StepProfile, float, str, Colour]] = [
        ("speed/limit", line.speed_limits, KMH, "limit", COLOURS["limit"]),
        ("gradient", line.gradients, PER_MILLE, "gradient", COLOURS["terrain"]),
    ]
    for entity, profile, scale, name, colour in profiles:
        if entity in known or clock.position.size == 0 or clock.covered[0] == clock.covered[1]:
            continue
        first, last = clock.covered
        changes = profile.positions[(profile.positions > first) & (profile.positions < last)]
        places = np.concatenate(([first], changes, [last]))
        instants = passages(clock, places)
        values = scale * profile(np.append(places[:-1], places[-2]))
        send_curve(
            *(recording, f"{root}/{entity}", instants, Samples(instants.time, values[:, None])),
            names=[f"{name} of the line"],
            colours=[colour],
            held=True,
        )
        drawn.add(entity)
    return drawn


def passages(clock: Clock, position: FloatArray) -> Instants:
    """When the train reached each position [m]; those outside of the trip at its ends."""
    inside = np.clip(position, *clock.covered)
    time = clock.start + np.rint(clock.arrival_at(inside) * NANOSECONDS).astype(np.int64)
    return Instants(clock.start, time, position)


def draw_lanes(recording: Any, root: str, line: Line | None, clock: Clock) -> set[str]:
    """Draw between which stations and kilometres a trip was, as lanes of blocks.

    Returns
    -------
    set of str
        Entities that were drawn.
    """
    if clock.position.size == 0 or clock.covered[0] == clock.covered[1]:
        return set()
    drawn = {"kilometre"}
    places, names = _kilometre_blocks(line, *clock.covered)
    _send_lane(recording, f"{root}/kilometre", passages(clock, places), names, KILOMETRES)
    if line is not None and len(line.stations) > 1:
        first, last = clock.covered
        stations = np.sort([station.position for station in line.stations])
        row, end = section_of(stations, np.array([first, last - 1e-6]))
        rows = np.arange(row, end + 1)
        titles = section_names(line)
        names = [titles[each + 1] for each in rows]
        sections = np.maximum(stations[np.maximum(rows, 0)], first)
        _send_lane(recording, f"{root}/section", passages(clock, sections), names, SECTIONS)
        drawn.add("section")
    return drawn


def _kilometre_blocks(line: Line | None, first: float, last: float) -> tuple[FloatArray, list[str]]:
    fit = [each for each in BLOCKS if (last - first) / (1e3 * each) <= MOST_BLOCKS]
    length = fit[0] if fit else BLOCKS[-1]
    places = np.append(np.arange(first, last, KILOMETRE_STEP), last)
    kilometre = in_km(line, places)
    number = np.floor(kilometre / length + 1e-9)
    begins = np.concatenate(([0], np.flatnonzero(np.diff(number)) + 1))
    names = [f"km {round(kilometre[i], 1):g}" for i in begins]
    # What the trip has of its first block may be too short for its kilometre.
    ends = np.append(places[begins[1:]], last)
    if ends[0] - first < SHORTEST_NAMED * 1e3 * length and len(names) > 1:
        names[0] = ""
    return places[begins], names


def section_names(line: Line) -> list[str]:
    """Names of the sections, from that before the first station to that behind the last."""
    names = [each.name for each in sorted(line.stations, key=lambda station: station.position)]
    inner = [f"{one} – {other}" for one, other in pairwise(names)]
    return [f"before {names[0]}", *inner, f"after {names[-1]}"]


def section_of(stations: FloatArray, position: FloatArray) -> IntArray:
    """Number of the section of each position: -1 before the first station."""
    found = np.searchsorted(stations, position, side="right") - 1
    # A train that stands at its last station is still in the section that leads to it.
    at_end = (found == stations.size - 1) & (position <= stations[-1] + 1.0)
    return np.asarray(np.where(at_end, found - 1, found), dtype=np.int64)


def _send_lane(
    recording: Any,
    entity: str,
    instants: Instants,
    names: list[str],
    colours: tuple[Colour, Colour],
) -> None:
    values = list(dict.fromkeys(names))
    shades = np.array([colours[i % 2] for i in range(len(values))], dtype=np.uint8)
    send_static(recording, entity, rr.StateConfiguration(values=values, colors=shades))
    send_rows(recording, entity, instants, lambda rows: rr.StateChange.columns(state=names[rows]))


class Whereabouts:
    """Writes where a trip is, and how fast, for each of its seconds.

    Parameters
    ----------
    recording : rerun.RecordingStream
    entity : str
    line : Line or None
        As travelled.
    clock : Clock
    """

    def __init__(self, recording: Any, entity: str, line: Line | None, clock: Clock) -> None:
        self._recording = recording
        self._entity = entity
        self._line = line
        self._clock = clock
        self._last = -1

    def add(self, piece: Trip) -> bool:
        """Write the seconds of the next piece; whether there were any."""
        found = speed_of(piece)
        if found is None or self._clock.time.size == 0:
            return False
        time, speed = found
        second, first = np.unique(time // NANOSECONDS, return_index=True)
        # A second that began in the piece before is written already.
        first, begun = first[second > self._last], self._last >= 0
        self._last = int(second[-1])
        instants = self._clock.instants(time[first])
        late = lateness_of(piece, time[first])
        texts = self.texts(instants.position, speed[first], late)
        if not begun and instants.position.size:
            begins, text = from_whole_kilometre(instants), texts[0].partition("\n")[0]
            if begins.position[0] < begins.position[1]:
                instants, texts = begins, [f"{text}\n\nThe trip begins there.", *texts]
        if not begun:
            style = rr.TextDocument.from_fields(media_type="text/markdown")
            send_static(self._recording, self._entity, style)
        send_rows(
            *(self._recording, self._entity, instants),
            lambda rows: rr.TextDocument.columns(text=texts[rows]),
        )
        return True

    def texts(
        self, position: FloatArray, speed: FloatArray, late: FloatArray | None = None
    ) -> list[str]:
        """What is written at each position [m], speed [m/s] and lateness [s]; Markdown."""
        line = self._line
        columns = [
            [f"# km {each:.3f}" for each in in_km(line, position).tolist()],
            [
                "## speed not known" if np.isnan(each) else f"## {each:.1f} km/h"
                for each in (KMH * speed).tolist()
            ],
        ]
        if late is not None:
            columns.append(
                ["" if np.isnan(each) else signed_lateness(each) for each in late.tolist()]
            )
        if line is not None:
            inside = np.clip(position, 0.0, line.length)
            limits, slopes = KMH * line.speed_limit(inside), PER_MILLE * line.gradient(inside)
            columns.append(
                [
                    f"limit {limit:.0f} km/h, gradient {slope:+.1f} ‰"
                    for limit, slope in zip(limits.tolist(), slopes.tolist(), strict=True)
                ]
            )
            if len(line.stations) > 1:
                stations = np.sort([each.position for each in line.stations])
                titles = section_names(line)
                columns.append([titles[row + 1] for row in section_of(stations, position).tolist()])
        return ["\n\n".join(filter(None, each)) for each in zip(*columns, strict=True)]


def signed_lateness(seconds: float) -> str:
    """Lateness with its sign, and what the sign means.

    Examples
    --------
    >>> signed_lateness(12.34), signed_lateness(-3.0), signed_lateness(0.02)
    ('+12.3 s, late', '-3.0 s, early', '0.0 s, on time')
    """
    rounded = round(seconds, 1)
    if rounded == 0.0:
        return "0.0 s, on time"
    return f"{rounded:+.1f} s, {'late' if rounded > 0.0 else 'early'}"


def lateness_of(piece: Trip, time: Nanoseconds) -> FloatArray | None:
    """Lateness [s] against the trajectory that a trip followed, at each time; None without one."""
    frame = piece.topics.get(REFERENCE.name)
    if frame is None or frame.empty or "lateness" not in frame:
        return None
    return interpolated(frame, "lateness", pd.to_datetime(time, utc=True), 2.0)


def speed_of(piece: Trip) -> tuple[Nanoseconds, FloatArray] | None:
    """Time and speed [m/s] of the trip's own speed; None without one."""
    for name in SPEEDS:
        if name in piece and "speed" in piece[name] and len(piece[name]):
            frame: pd.DataFrame = piece[name]
            speed = frame["speed"].to_numpy(dtype=np.float64)
            if np.isfinite(speed).any():
                return nanoseconds(frame), speed
    return None


TRACK: Colour = (95, 100, 115)
STATION: Colour = (160, 160, 160)
OUTAGE = 15_000_000_000
"""How long fixes are missing until the line along them is interrupted [ns]."""

TRACK_WIDTH, STATION_SIZE = 2.5, 6.0
"""Half width of the track and radius of a station on the map, in points."""


def draw_line(recording: Any, line: Line, chart: Chart) -> None:
    """Draw a line in its own direction on the chart; nothing without coordinates."""
    geometry = line.geometry
    if geometry is None:
        return
    track = np.column_stack((geometry.latitudes, geometry.longitudes))
    chart.strips(recording, path_of("lines", line.name, "track"), [track], TRACK, TRACK_WIDTH)
    for station in line.stations:
        place = np.column_stack(geometry.at(np.array([station.position])))
        entity = path_of("lines", line.name, "stations", station.name)
        chart.dots(recording, entity, place, np.array([STATION]), STATION_SIZE, station.name)


def fixed_path(time: Nanoseconds, fixes: FloatArray) -> list[FloatArray]:
    """The line along fixes [deg], (n, 2), taken at `time` [ns], in parts between outages."""
    chosen = each_second(time)
    outages = np.flatnonzero(np.diff(time[chosen]) > OUTAGE) + 1
    return [part for part in np.split(fixes[chosen], outages) if len(part) > 1]


def each_second(time: Nanoseconds) -> IntArray:
    """Index of the first instant [ns] of each second: often enough to see a train move."""
    return np.asarray(np.unique(time // NANOSECONDS, return_index=True)[1])


def draw_trajectory(recording: Any, trajectory: Trajectory, start: int) -> None:
    """Draw a trajectory as if it departed at `start` [ns since 1970 UTC]."""
    seconds = trajectory.times.mean(axis=0)
    time = start + np.round(seconds * NANOSECONDS).astype(np.int64)
    slowest, fastest = trajectory.speeds.min(axis=0), trajectory.speeds.max(axis=0)
    instants = Instants(start, time, trajectory.positions)
    _send_span(recording, path_of("trajectory", "speed"), instants, slowest, fastest)


def draw_plan(recording: Any, entity: str, clock: Clock, trajectory: Trajectory) -> bool:
    """Draw what a trajectory plans where a trip is at each instant, whenever that is.

    Returns
    -------
    bool
        Whether the trip was where the trajectory is.
    """
    first, last = trajectory.positions[[0, -1]]
    inside = (clock.position >= first) & (clock.position <= last)
    if not inside.any():
        return False
    instants = clock.instants(clock.time[inside])
    rows = range(len(trajectory.configurations))
    speeds = np.stack([trajectory.speed_at(row, instants.position) for row in rows])
    _send_span(recording, entity, instants, speeds.min(axis=0), speeds.max(axis=0))
    return True


def _send_span(
    recording: Any, entity: str, instants: Instants, slowest: FloatArray, fastest: FloatArray
) -> None:
    """Send the middle between two speeds [m/s] as a line, with a band that reaches to both."""
    middle, half = 0.5 * KMH * (slowest + fastest), 0.5 * KMH * (fastest - slowest)
    send_curve(
        recording,
        entity,
        instants,
        Samples(instants.time, middle[:, None], half[:, None] ** 2),
        names=["trajectory"],
        colours=[COLOURS["planned"]],
    )


PHASES: dict[str, Colour] = {
    "traction": (45, 140, 75),
    "coasting": (95, 100, 120),
    "braking": (185, 85, 45),
    "standstill": (45, 45, 50),
}
"""Driving phases and their colours."""

PHASE_LETTERS = {phase: phase[0].upper() for phase in PHASES}
"""What stands in the blocks of the driving phases: many are too short for their names."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What of a trip there is to show.

    Attributes
    ----------
    name : str
    root : str
        Its entities lie below this path.
    direction : str
    line : str
        Path of its line's entities; empty without a line.
    colour : Colour
        On the chart and where trips lie over each other.
    entities : frozenset of str
        Paths below `root` that hold data.
    layer : str
        Layer of the track-condition map under it; empty without one.
    tops : dict of str to float
        Upper end of each panel's axis, in its unit.
    extent : (2, 2) array [deg] or None
        Least and greatest latitude, least and greatest longitude; None without coordinates.
    panels : tuple of Panel
        The plots that it can have.
    brief : bool
        It has no views of its own: it is thinned, and lies over others.
    reference : str
        With what it is compared; empty if with nothing.
    """

    name: str
    root: str
    direction: str
    line: str
    colour: Colour
    entities: frozenset[str]
    layer: str
    tops: dict[str, float]
    extent: FloatArray | None
    panels: tuple[Panel, ...] = PANELS
    brief: bool = False
    reference: str = ""

    def shows(self, panel: str) -> bool:
        """Whether there is anything below the panel's entity."""
        return any(entity.partition("/")[0] == panel for entity in self.entities)


LEVELS = {1: "DEBUG", 2: "INFO", 3: "WARN", 4: "ERROR", 5: "CRITICAL"}
"""Levels of foxglove.Log and their names in Rerun."""

KEYS = ("train", "line", "direction", "load", "weather", "start")
"""Keys of a trip's metadata that are listed first."""

SMALL, LARGE = 5.0, 9.0
"""Radius of a satellite fix and of a train on the map, in points."""

HEADROOM = 1.1
"""Top of a plot over nearly all of its values."""


class Drawing:
    """One trip below its own path, of which the pieces come in the order of time.

    Parameters
    ----------
    recording : rerun.RecordingStream
    known : Survey
    name : str
        Of the trip, among the others.
    colour : Colour
    chart : Chart, optional
        The one of all trips. Default: one for this trip.
    brief : bool
        Without what is shown of a trip alone: particulars, lanes, where it was each second.
    """

    def __init__(
        self,
        recording: Any,
        known: Survey,
        name: str,
        colour: Colour,
        *,
        chart: Chart | None = None,
        brief: bool = False,
    ) -> None:
        self._recording = recording
        self._known = known
        self._name = name
        self._colour = colour
        self._chart = chart or chart_of([known.line], [known.fixes])
        self._brief = brief
        self._root = path_of("trips", name)
        self._curves = curves_of(known.bare)
        self._pens = {curve.entity: Pen(curve) for curve in self._curves}
        self._entities: set[str] = set()
        self._phase = self._reference = ""
        self._where = Whereabouts(recording, f"{self._root}/cursor", known.line, known.clock)

    def add(self, piece: Trip, state: pd.DataFrame | None) -> None:
        """Draw the next piece; `state` as `neighboured` gives it."""
        drawn = with_slip(piece, state)
        for curve in self._curves:
            if not self._brief or curve.entity in SPEEDS_SHOWN:
                self._add_curve(curve, drawn)
        self._add_phases(piece, state)
        self._add_events(piece)
        self._add_fixes(piece)
        if not self._brief and self._where.add(piece):
            self._entities.add("cursor")

    def compare(self, reference: Reference) -> None:
        """Draw how far the trip is behind a reference along the line, and how much faster."""
        drawn = draw_difference(
            self._recording, self._root, self._name, self._colour, self._known, reference
        )
        self._entities |= drawn
        self._reference = reference.name if drawn else ""

    def finish(self, trajectory: Trajectory | None, condition: TrackConditionMap | None) -> Shown:
        """Draw what is known of the trip as a whole; return what there is to show."""
        known, root, bare = self._known, self._root, self._known.bare
        # A trip that followed a trajectory carries it as its reference, in its own configuration.
        planned = None if REFERENCE.name in bare else trajectory
        if planned is not None and _backwards(bare) != (planned.direction == "reverse"):
            planned = None
        if planned is not None and draw_plan(
            self._recording, f"{root}/speed/trajectory", known.clock, planned
        ):
            self._entities.add("speed/trajectory")
        layer = "" if known.line is None else _layer(bare, condition)
        if layer and condition is not None:
            passage = Passage(known.clock, condition, layer, _backwards(bare), whole=False)
            paths = {name: f"{root}/adhesion/{name}" for name in ("map", "expected", "spots")}
            found = draw_condition(self._recording, passage, paths)
            self._entities |= {f"adhesion/{name}" for name in found}
            if known.line is not None:
                entity, line = f"{root}/place/spots", self._laid_out(known.line)
                draw_spots_on_map(self._recording, entity, line, passage, self._chart)
        extent = self._draw_places()
        if not self._brief:
            if known.line is not None:
                drawn = (self._recording, root, known.line, known.clock, self._entities)
                self._entities |= draw_profile(*drawn)
            self._entities |= draw_lanes(self._recording, root, known.line, known.clock)
            about = rr.TextDocument(_about(bare, self._name), media_type="text/markdown")
            send_static(self._recording, f"{root}/about", about)
            self._entities.add("about")
        tops: dict[str, float] = {}
        for curve in self._curves:
            if curve.entity in self._known.tops:
                top = HEADROOM * self._known.tops[curve.entity]
                tops[curve.panel] = max(tops.get(curve.panel, 0.0), top)
        return Shown(
            name=self._name,
            root=root,
            direction=bare.metadata.get("direction", "forward"),
            line="" if known.line is None else path_of("lines", known.line.name),
            colour=self._colour,
            entities=frozenset(self._entities),
            layer=layer,
            tops=tops,
            extent=extent,
            panels=panels_of(bare),
            brief=self._brief,
            reference=self._reference,
        )

    def _laid_out(self, line: Line) -> Line:
        return self._chart.laid_out(line, _backwards(self._known.bare))

    def so_far(self, known: Survey) -> Shown:
        """What there is to show of a trip that is still recorded; draws `known`, its last part."""
        before, entities, self._known = self._known, set(self._entities), known
        try:
            return self.finish(None, None)
        finally:
            self._known, self._entities = before, entities

    def _add_curve(self, curve: Curve, piece: Trip) -> None:
        points = self._pens[curve.entity].samples(piece)
        if points is None:
            return
        entity = f"{self._root}/{curve.entity}"
        instants = self._known.clock.instants(points.time)
        if curve.entity in self._entities:
            send_samples(self._recording, entity, instants, points)
            return
        names, colours = legend(curve, points.ordinates.shape[1])
        send_curve(
            *(self._recording, entity, instants, points),
            names=names,
            colours=colours,
            width=curve.width,
            held=curve.held,
        )
        self._entities.add(curve.entity)

    def _add_phases(self, piece: Trip, state: pd.DataFrame | None) -> None:
        found = phases(piece, state, self._known.pulls)
        if found is None:
            return
        time, phase = found
        entity = f"{self._root}/phase"
        if "phase" not in self._entities:
            colours = np.array(list(PHASES.values()), dtype=np.uint8)
            letters = [PHASE_LETTERS[phase] for phase in PHASES]
            style = rr.StateConfiguration(values=list(PHASES), labels=letters, colors=colours)
            send_static(self._recording, entity, style)
        elif phase[0] == self._phase:
            time, phase = time[1:], phase[1:]
        if time.size:
            self._phase = str(phase[-1])
        send_rows(
            self._recording,
            entity,
            self._known.clock.instants(time),
            lambda rows: rr.StateChange.columns(state=phase[rows].tolist()),
        )
        self._entities.add("phase")

    def _add_events(self, piece: Trip) -> None:
        if EVENTS.name not in piece or piece[EVENTS.name].empty:
            return
        frame = piece[EVENTS.name]
        texts = [
            f"{name}: {message}" if name else message
            for name, message in zip(frame["name"], frame["message"], strict=True)
        ]
        levels = [LEVELS.get(level, "INFO") for level in frame["level"]]
        send_rows(
            self._recording,
            f"{self._root}/events",
            self._known.clock.instants(nanoseconds(frame)),
            lambda rows: rr.TextLog.columns(text=texts[rows], level=levels[rows]),
        )
        self._entities.add("events")

    def _add_fixes(self, piece: Trip) -> None:
        if GNSS_FIX.name not in piece:
            return
        frame = piece[GNSS_FIX.name]
        fixes = frame[["latitude", "longitude"]].to_numpy(dtype=np.float64)
        known = np.all(np.isfinite(fixes), axis=1)
        if not known.any():
            return
        instants = self._known.clock.instants(nanoseconds(frame)[known])
        entity = f"{self._root}/place/satellites"
        drawn = (self._recording, entity, instants, fixes[known])
        if "place/satellites" in self._entities:
            self._chart.move(*drawn)
            return
        self._chart.moving(*drawn, colour=COLOURS["satellites"], radius=SMALL)
        self._entities.add("place/satellites")

    def _draw_places(self) -> FloatArray | None:
        """The train on its line on the map; and the map's extent.

        Where the line has no coordinates, the line along the fixes stands for it.
        """
        known, extent = self._known, None
        geometry = None if known.line is None else self._laid_out(known.line).geometry
        if known.fixes is not None:
            time, fixes = known.fixes
            extent = np.quantile(fixes, (0.01, 0.99), axis=0).T
            path = fixed_path(time, fixes) if geometry is None else []
            if path:
                entity = f"{self._root}/place/path"
                self._chart.strips(self._recording, entity, path, TRACK, TRACK_WIDTH)
                self._entities.add("place/path")
        if geometry is None:
            return extent
        if known.clock.time.size:
            instants = known.clock.instants(known.clock.time[each_second(known.clock.time)])
            places = np.column_stack(geometry.at(instants.position))
            entity = f"{self._root}/place/train"
            self._chart.moving(
                *(self._recording, entity, instants, places), colour=self._colour, radius=LARGE
            )
            self._entities.add("place/train")
        track = np.column_stack((geometry.latitudes, geometry.longitudes))
        return np.column_stack((track.min(axis=0), track.max(axis=0)))


def draw_line_of(
    recording: Any, known: Survey, condition: TrackConditionMap | None, chart: Chart
) -> None:
    """Draw the line of a trip, if it has one, and its condition when that trip was there."""
    line, backwards = known.line, _backwards(known.bare)
    if line is None:
        return
    own = chart.laid_out(line.reversed() if backwards else line, backwards=False)
    draw_line(recording, own, chart)
    if condition is None:
        return
    for layer in observed(condition):
        passage = Passage(known.clock, condition, layer, backwards, whole=True)
        if own.geometry is not None:
            draw_bins_on_map(recording, own.name, own.geometry, passage, chart)
        path = path_of("lines", line.name, "maximum_adhesion", layer)
        paths = {"map": path} | {name: f"{path}/{name}" for name in ("expected", "spots")}
        draw_condition(recording, passage, paths)


def _backwards(trip: Trip) -> bool:
    return trip.metadata.get("direction") == "reverse"


def _layer(trip: Trip, condition: TrackConditionMap | None) -> str:
    """The layer of the map for the trip's weather, the first if that is not known; else empty."""
    layers = observed(condition)
    if "weather" in trip.metadata:
        return trip.metadata["weather"] if trip.metadata["weather"] in layers else ""
    return layers[0] if layers else ""


def _about(trip: Trip, name: str) -> str:
    """What is known of the trip, as Markdown."""
    keys = sorted(
        trip.metadata, key=lambda key: (KEYS.index(key) if key in KEYS else len(KEYS), key)
    )
    # A list, not a table: next to one long value a table's columns leave the narrow panel.
    shown, load = dict(trip.metadata), trip.metadata.get("load", "")
    if is_number(load):
        shown["load"] = f"{float(load) / 1e3:.1f} t"
    rows = [f"- **{key}**: {shown[key]}" for key in keys if key != "trip"]
    steps = [f"{i}. {step['step']}" for i, step in enumerate(trip.provenance, start=1)]
    parts = [f"### {name}", "\n".join(rows), *(["Made by", "\n".join(steps)] if steps else [])]
    return "\n\n".join(part for part in parts if part) + "\n"
