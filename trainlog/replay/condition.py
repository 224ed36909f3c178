"""The track condition in a replay: lasting and expected maximum adhesion, and passing spots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway import Geometry, Line, TrackConditionMap
from trainlog.railway.condition import (
    ADHESION_BOUNDS,
    ADHESION_COLOURS,
    ConditionLayer,
    PassingSpot,
    adhesion_class,
)
from trainlog.railway.line import km_words
from trainlog.replay.chart import Chart
from trainlog.replay.clock import Clock, Instants, Nanoseconds
from trainlog.replay.curves import COLOURS, Colour
from trainlog.replay.samples import Samples, path_of, send_curve, send_dots
from trainlog.units import DAY, NANOSECONDS

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


def check_line(condition: TrackConditionMap, line: Line, trip: str) -> None:
    """Refuse a track-condition map of another line.

    Raises
    ------
    InputError
    """
    if condition.line != line.name or abs(condition.length - line.length) > condition.bin_length:
        raise InputError(
            f"the track-condition map is of line '{condition.line}', {condition.length:.0f} m;"
            f" trip '{trip}' ran on '{line.name}', {line.length:.0f} m",
            remedy="give the map of that line, or none",
        )
