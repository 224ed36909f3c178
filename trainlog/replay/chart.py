"""The line from above: drawn to scale without a network, or over the tiles of a map.

Rerun's own map asks a server for its tiles. By default the line is therefore drawn as a plan, in
metres east and south of a common origin; a line without coordinates is drawn straight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import rerun as rr

from trainlog.arrays import FloatArray
from trainlog.railway import Geometry, Line
from trainlog.replay.clock import Instants
from trainlog.replay.curves import Colour
from trainlog.replay.samples import send_rows, send_static
from trainlog.units import EARTH_RADIUS

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
        self,
        recording: Any,
        entity: str,
        parts: Sequence[FloatArray],
        colour: Colour,
        width: float,
    ) -> None:
        """Draw lines through latitudes and longitudes, (n, 2) each, for all times."""
        style = {
            "radii": rr.Radius.ui_points(width),
            "colors": np.array([colour], dtype=np.uint8),
        }
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
