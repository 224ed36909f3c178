"""Charts of a line built from satellite fixes: its course, curvature, gradient and support."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from analysis.charts import BLUE, GREY, ORANGE, RED, SKY, Chart, Curve, Panel
from analysis.geometry.centre_line import CentreLine
from trainlog.arrays import FloatArray
from trainlog.display import counted
from trainlog.railway.geometry import to_plane
from trainlog.trip import Trip
from trainlog.units import PER_MILLE


def centre_line_charts(centre_line: CentreLine, *, trips: Sequence[Trip] = ()) -> list[Chart]:
    """A surveyed line: plan with the fixes, curvature and gradient with their bands, support.

    Parameters
    ----------
    centre_line : CentreLine
    trips : sequence of Trip
        That it was made from: their fixes are drawn.
    """
    km = centre_line.position / 1e3
    known = np.where(centre_line.support > 0, 1e3, np.nan)
    panels = [
        _banded("curvature [1/km]", km, known * centre_line.curvature,
                known * centre_line.curvature_std, "Curvature, to the right positive; 95 % band"),
    ]  # fmt: skip
    heights = centre_line.heights
    if heights is not None:
        known = np.where(heights.known, PER_MILLE, np.nan)
        panels.append(
            _banded("gradient [‰]", heights.position / 1e3, known * heights.gradient,
                    known * heights.gradient_std,
                    "Gradient over 500 m, from the trips' altitudes; 95 % band")
        )  # fmt: skip
    support = Curve("", km, centre_line.support, SKY, "area")
    panels.append(Panel("trips", [support], 0.5, from_zero=True))
    refused = f", {len(centre_line.refused)} refused" if centre_line.refused else ""
    title = (
        f"{centre_line.length / 1e3:.3f} km from {counted(len(centre_line.used), 'trip')}{refused},"
        f" {centre_line.fixes} fixes, {centre_line.rejected} of them set aside"
    )
    return [_plan(centre_line, trips, title), Chart("chainage [km]", panels)]


def _plan(centre_line: CentreLine, trips: Sequence[Trip], title: str) -> Chart:
    origin = (float(centre_line.latitude.mean()), float(centre_line.longitude.mean()))

    def curve(
        label: str, place: tuple[FloatArray, ...], colour: str, width: float, kind: Any = "line"
    ) -> Curve:
        points = to_plane(place[0], place[1], origin) / 1e3
        return Curve(label, points.real, points.imag, colour, kind, width=width)

    fixes = [trip["/gnss/fix"] for trip in trips if trip.name in centre_line.used]
    place = (centre_line.latitude, centre_line.longitude)
    curves = [
        curve("fixes",
              (fix["latitude"].to_numpy(), fix["longitude"].to_numpy()), GREY, 0.8, "points")
        for fix in fixes
    ] + [curve("line", place, BLUE, 1.2)]  # fmt: skip
    for start, end in centre_line.unsupported:
        bridged = (centre_line.position >= start) & (centre_line.position <= end)
        part = tuple(each[bridged] for each in place)
        curves.append(curve("no fixes", part, RED, 2.5))
    curves.append(curve("km 0", tuple(each[:1] for each in place), ORANGE, 3.5, "points"))
    return Chart("east [km]", [Panel("north [km]", curves, 1.7)], title=title, equal=True)


def _banded(y: str, x: FloatArray, values: FloatArray, std: FloatArray, title: str) -> Panel:
    reach = 1.96 * std
    return Panel(y, [Curve("", x, values, BLUE, "line", values - reach, values + reach, width=0.9)],
                 title=title)  # fmt: skip
