"""What is sent to a recording, in slices that write and draw fast."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import rerun as rr

from trainlog.replay.clock import FloatArray, Instants
from trainlog.replay.curves import Colour
from trainlog.replay.samples import Samples

ROWS = 10_000
"""Rows a chunk: larger ones are slower to write and to draw."""


def path_of(*parts: str) -> str:
    """Entity path of these parts, whatever characters they hold."""
    return str(rr.new_entity_path(list(parts)))


def send_static(recording: Any, entity: str, what: Any) -> None:
    """Log something that holds at all times and places."""
    recording.log(entity, what, static=True, strict=True)


def send_rows(
    recording: Any,
    entity: str,
    instants: Instants,
    columns: Callable[[slice], Any],
) -> None:
    """Send the rows of an entity; `columns` makes Rerun's columns of a slice of them."""
    for first in range(0, len(instants), ROWS):
        rows = slice(first, first + ROWS)
        recording.send_columns(entity, instants.columns(rows), columns(rows), strict=True)


def send_curve(
    recording: Any,
    entity: str,
    instants: Instants,
    points: Samples,
    *,
    names: list[str],
    colours: list[Colour],
    width: float = 1.5,
    held: bool = False,
) -> None:
    """Send the points of a curve and how it is drawn: lines, or with variances bands as well."""
    instants, points = _from_whole_kilometre(instants, points)
    style = {
        "names": names,
        "colors": np.array(colours, dtype=np.uint8),
        "widths": [width] * len(names),
        "interpolation_mode": "StepAfter" if held else "Linear",
        # Seen from afar Rerun shows the mean of neighbouring samples: a limit that was never in
        # force on either side of each change, and slips that never were as high.
        "aggregation_policy": "Off" if held else "MinMax",
    }
    style_of = rr.SeriesLines if points.variances is None else rr.Measurements.from_fields
    send_static(recording, entity, style_of(**style))
    send_samples(recording, entity, instants, points)


def send_samples(recording: Any, entity: str, instants: Instants, points: Samples) -> None:
    """Send further points of a curve."""
    variances = points.variances
    if variances is None:
        send_rows(
            recording,
            entity,
            instants,
            lambda rows: rr.Scalars.columns(scalars=_rows(points.ordinates[rows])),
        )
        return
    send_rows(
        recording,
        entity,
        instants,
        lambda rows: rr.Measurements.columns(
            values=_rows(points.ordinates[rows]), variances=_rows(variances[rows])
        ),
    )


def send_dots(
    recording: Any,
    entity: str,
    instants: Instants,
    values: FloatArray,
    *,
    name: str,
    colour: Colour,
) -> None:
    """Send values, (n,), that are drawn as dots in a plot."""
    style = rr.SeriesPoints(names=name, colors=np.array([colour]), marker_sizes=3.0)
    send_static(recording, entity, style)
    send_rows(recording, entity, instants, lambda rows: rr.Scalars.columns(scalars=values[rows]))


def send_points(
    recording: Any,
    entity: str,
    instants: Instants,
    degrees: FloatArray,
    *,
    colour: Colour,
    radius: float,
) -> None:
    """Send a moving point on the map: latitude and longitude [deg], (n, 2)."""
    send_static(
        recording,
        entity,
        rr.GeoPoints.from_fields(radii=rr.Radius.ui_points(radius), colors=np.array([colour])),
    )
    send_places(recording, entity, instants, degrees)


def send_places(recording: Any, entity: str, instants: Instants, degrees: FloatArray) -> None:
    """Send further places of a point: latitude and longitude [deg], (n, 2)."""
    send_rows(
        recording, entity, instants, lambda rows: rr.GeoPoints.columns(positions=degrees[rows])
    )


def _from_whole_kilometre(instants: Instants, points: Samples) -> tuple[Instants, Samples]:
    """The same with an unknown value at the whole kilometre before the first sample.

    Rerun counts a plot's ticks from its first sample: they fall on whole kilometres with it.
    """
    first = np.floor(instants.position.min() / 1e3) * 1e3
    variances = points.variances
    return (
        Instants(
            instants.start,
            np.insert(instants.time, 0, instants.time[0]),
            np.insert(instants.position, 0, first),
        ),
        Samples(
            np.insert(points.time, 0, points.time[0]),
            np.insert(points.ordinates, 0, np.nan, axis=0),
            None if variances is None else np.insert(variances, 0, np.nan, axis=0),
        ),
    )


def _rows(block: FloatArray) -> FloatArray:
    """A block as Rerun partitions it: one column flat, several as they are."""
    return np.ascontiguousarray(block[:, 0] if block.shape[1] == 1 else block)
