"""Charts of a comparison: speeds, time lost and its causes, energy along the line."""

from __future__ import annotations

import numpy as np

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    Chart,
    Curve,
    Label,
    Panel,
    Rule,
)
from analysis.comparison import CAUSES
from analysis.comparison.calculated import Calculation
from analysis.comparison.compare import ComparedDirection, ComparedTrip, Comparison
from trainlog.display import counted
from trainlog.units import JOULES_PER_KWH, KMH

TRIP_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)

CAUSE_COLOURS = {
    "start": "#5b5b5b",
    "dwell": BLUE,
    "stop": SKY,
    "held": RED,
    "limit": ORANGE,
    "slip": PURPLE,
    "full effort": "#b8860b",
    "slower": "#9a9a9a",
    "faster": GREEN,
    "recording": "#e8c8c8",
}

MOST = 6
"""Trips whose speeds are drawn one by one; of more, those that lost most."""


def all_charts(found: Comparison) -> list[Chart]:
    """The charts of every direction, in order."""
    return [chart for each in found.directions for chart in comparison_charts(each)]


def comparison_charts(found: ComparedDirection) -> list[Chart]:
    """Trips of a direction by position: speed, time lost, energy; and causes of lost time."""
    shown = _shown(found)
    behind = [
        Curve("", each.lost.position / 1e3, each.lost.behind, _colour(row), width=1.3)
        for row, each in enumerate(shown)
        if each.lost is not None
    ]
    work = [
        Curve("", each.trip.position / 1e3, each.trip.drawn_work / JOULES_PER_KWH, _colour(row),
              width=1.3)
        for row, each in enumerate(shown)
        if each.trip.sums.get("traction") is not None
    ]  # fmt: skip
    panels = [
        _speeds(found, shown),
        Panel("behind the\nreference [s]", behind, 0.9, rules=[Rule(0.0)]),
        *([Panel("tractive work\n[kWh]", work, 0.75)] if work else []),
    ]
    reference = "the trajectory" if found.reference.planned else f"'{found.reference.name}'"
    more = f", {len(shown)} of them shown" if len(shown) < len(found.trips) else ""
    edges = (found.sections.edges / 1e3).tolist()
    along = Chart(
        "km in the direction of travel", panels,
        places=list(zip(edges, found.sections.ends, strict=True)),
        span=(edges[0], edges[-1]), line=found.line,
        title=f"{found.line.name}, {found.direction}: {counted(len(found.trips), 'trip')} against"
        f" {reference}{more}",
    )  # fmt: skip
    return [along, _causes(shown)]


def _shown(found: ComparedDirection) -> list[ComparedTrip]:
    """The reference, and the trips that lost most."""
    others = [each for each in found.trips if each.trip is not found.reference]
    others.sort(key=lambda each: 0.0 if each.lost is None else -abs(each.lost.total))
    own = [each for each in found.trips if each.trip is found.reference]
    return [*own, *others[: MOST - len(own)]]


def _colour(row: int) -> str:
    return TRIP_COLOURS[row % len(TRIP_COLOURS)]


def _speeds(found: ComparedDirection, shown: list[ComparedTrip]) -> Panel:
    first, last = found.sections.edges[[0, -1]].tolist()
    place = np.linspace(first, last, 2000)
    limit = KMH * found.reference.permitted(place)
    curves = [Curve("limit", place / 1e3, limit, GREY, "step", width=1.0)]
    if found.reference.planned:
        plan = found.reference
        curves.append(Curve("trajectory", plan.position / 1e3, KMH * plan.speed, INK, dash="--"))
    for row, each in enumerate(shown):
        km, colour = each.trip.position / 1e3, _colour(row)
        curves.append(Curve(each.name, km, KMH * each.trip.drawn_speed, colour, width=1.2))
        lower = each.trip.signals.get("limit")
        if lower is not None:
            below = lower < each.trip.permitted(each.trip.position) - 0.5
            if below.any():
                held = np.where(below, KMH * lower, np.nan)
                words = f"lower limit of {each.name}"
                curves.append(Curve(words, km, held, colour, width=1.8, dash=":"))
    return Panel("speed [km/h]", curves, 1.3, limits=(0.0, 1.15 * float(limit.max())))


def _causes(shown: list[ComparedTrip]) -> Chart:
    """Seconds lost and gained by each trip, stacked by cause."""
    compared = [(each.name, each.lost) for each in shown if each.lost is not None]
    ends = {True: np.zeros(len(compared)), False: np.zeros(len(compared))}
    bars, rows = list[Curve](), np.arange(len(compared))
    for cause in CAUSES:
        lost = np.array([each.by_cause().get(cause, 0.0) for _, each in compared])
        for positive in (True, False):
            some = (np.abs(lost) >= 0.05) & ((lost > 0.0) == positive)
            if some.any():
                base = ends[positive].copy()
                ends[positive] = base + np.where(some, lost, 0.0)
                bars.append(
                    Curve(cause, ends[positive][some], rows[some], CAUSE_COLOURS[cause], "bars",
                          base[some], width=0.62, across=True)
                )  # fmt: skip
    labels = [
        Label(float(end), f"  {each.total:+.0f} s", float(row), side="left", size=8.0)
        for row, (_, each), end in zip(rows, compared, ends[True], strict=True)
    ]
    low, high = min(0.0, *ends[False], 0.0), max(0.0, *ends[True], 1.0)
    margin = 0.12 * (high - low)
    return Chart(
        "lost [s] (left of 0: gained)",
        [
            Panel("", bars, 0.5 + 0.12 * len(compared), rows=[name for name, _ in compared],
                  rules=[Rule(0.0, upright=True)], labels=labels)
        ],
        span=(low - margin, high + margin),
    )  # fmt: skip


def calculation_charts(found: Calculation) -> list[Chart]:
    """Measured and calculated speed along the line, their difference, and the works."""
    place = found.position / 1e3
    speeds = [Curve("measured", place, KMH * found.speed, INK, width=1.4)]
    off = list[Curve]()
    if found.inputs.efforts:
        middle, reach = KMH * found.calculated_speed, 1.96 * KMH * found.speed_std
        label = "calculated with the recorded efforts"
        low, high, less = middle - reach, middle + reach, KMH * found.speed
        speeds.append(Curve(label, place, middle, BLUE, "line", low, high, width=1.2, dash="--"))
        off.append(
            Curve("95 % band", place, middle - less, BLUE, "line", low - less, high - less)
        )  # fmt: skip
    along = Chart(
        "km in the direction of travel",
        [
            Panel("speed [km/h]", speeds, 1.3, from_zero=True),
            Panel("calculated less\nmeasured [km/h]", off, 0.8, rules=[Rule(0.0)]),
        ],
        line=found.line,
        title=f"Trip '{found.trip}' against the {found.model}: {found.words}",
    )
    rows = np.arange(len(found.table), dtype=np.float64)
    measured, expected, std = (
        found.table[name].to_numpy() / JOULES_PER_KWH
        for name in ("work", "calculated_work", "work_std")
    )
    ends = expected - 1.96 * std, expected + 1.96 * std
    bars = [Curve("calculated, 95 % band", rows + 0.18, expected, ORANGE, "bars", width=0.34)]
    if found.inputs.efforts:
        bars.insert(0, Curve("measured", rows - 0.18, measured, GREY, "bars", width=0.34))
    bars.append(Curve("", rows + 0.18, expected, INK, "points", *ends, width=0.5))
    top = 1.3 * float(np.nanmax(np.append(ends[1], measured), initial=0.0)) or 1.0
    works = Chart(
        "", [Panel("tractive work [kWh]", bars, 0.8, limits=(0.0, top))],
        ticks=[(float(row), str(name)) for row, name in zip(rows, found.table.index, strict=True)],
        span=(-0.6, rows.size - 0.4),
    )  # fmt: skip
    return [along, works]
