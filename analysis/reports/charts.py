"""Charts of a report: one description, drawn as a still picture and as one that shows values.

A `Chart` is a few panels over one axis. `as_part` draws it with matplotlib for print and readers
without scripts, and describes it for BokehJS where Bokeh is installed (extra ``report``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray

from analysis.plotting import BLUE, GREY, INK, PALE, dress, km_axis, new_figure, write_figure
from analysis.reports.page import Interactive
from analysis.reports.pictures import PAPER, drawn
from trainlog.arrays import FloatArray, IntArray
from trainlog.railway.kilometres import km_ticks
from trainlog.railway.line import Line
from trainlog.spans import runs_of

MOST_POINTS = 2_500
"""Of a curve in a chart, about: more than there are pixels show nothing more."""

FINE_TICKS = 60
"""Of an axis with the operator's kilometres in a chart that can be enlarged."""

WITHOUT_BOKEH = (
    "The charts stand still here: with the extra report (pip install 'trainlog[report]') they show"
    " values under the pointer and can be enlarged."
)


@dataclass(frozen=True)
class Curve:
    """Values over the chart's axis.

    Attributes
    ----------
    label : str
    x, y : (n,) array
    colour : str
        One of `analysis.plotting`.
    kind : {"line", "step", "area", "points"}
        ``"step"`` holds each value up to the next x, ``"area"`` fills from 0.
    low, high : (n,) array, optional
        Of a band, or of each point; of an area, `low` is where it begins, 0 without. What is not
        known is NaN, and nothing is drawn over it.
    hover : mapping of str to sequence of str
        What is stated of each point under the pointer, by name.
    width : float
        Of the line; points are larger with it, too.
    """

    label: str
    x: FloatArray
    y: FloatArray
    colour: str = BLUE
    kind: Literal["line", "step", "area", "points"] = "line"
    low: FloatArray | None = None
    high: FloatArray | None = None
    hover: Mapping[str, Sequence[str]] = field(default_factory=dict)
    width: float = 1.6


@dataclass(frozen=True)
class Panel:
    """Curves with one ordinate.

    Attributes
    ----------
    y : str
        What it is, with its unit.
    curves : sequence of Curve
    height : float
        Relative to the other panels.
    title : str
    from_zero : bool
        Whether the ordinate begins at zero.
    """

    y: str
    curves: Sequence[Curve]
    height: float = 1.0
    title: str = ""
    from_zero: bool = False


@dataclass(frozen=True)
class Chart:
    """Panels over one axis.

    Attributes
    ----------
    x : str
        What the axis is, with its unit.
    panels : sequence of Panel
    alt : str
        What it shows, for those who do not see it.
    caption : str
    places : sequence of (float, str)
        Stations, marked in all panels and named in the first.
    span : (float, float), optional
        Ends of the axis; default: those of the curves.
    line : Line, optional
        The axis is its chainage [km], labelled with the operator's kilometres if it has them.
    """

    x: str
    panels: Sequence[Panel]
    alt: str
    caption: str = ""
    places: Sequence[tuple[float, str]] = ()
    span: tuple[float, float] | None = None
    line: Line | None = None

    def __post_init__(self) -> None:
        if self.line is not None and self.line.reference is not None:
            object.__setattr__(self, "x", "km")


def rows_to_draw(*curves: ArrayLike, most: int = MOST_POINTS) -> IntArray:
    """Rows that show what all rows show: of each short stretch the least and greatest values.

    Parameters
    ----------
    *curves : (n,) arrays
    most : int
        So many rows are wanted, about.

    Examples
    --------
    >>> peak = np.zeros(100_000)
    >>> peak[70_001] = 1.0
    >>> rows = rows_to_draw(peak)
    >>> rows.size < 5_000, 70_001 in rows
    (True, True)
    """
    every = [np.asarray(each, dtype=np.float64) for each in curves]
    n = every[0].size if every else 0
    if n <= most:
        return np.arange(n)
    wide = -(-n * 2 * len(every) // most)
    stretches = n // wide
    begins = wide * np.arange(stretches)
    kept = [np.array([0, n - 1])]
    for each in every:
        block = each[: stretches * wide].reshape(stretches, wide)
        kept.append(begins + np.argmin(np.where(np.isnan(block), np.inf, block), axis=1))
        kept.append(begins + np.argmax(np.where(np.isnan(block), -np.inf, block), axis=1))
    kept.append(np.arange(stretches * wide, n))
    return np.unique(np.concatenate(kept))


def as_part(chart: Chart) -> Interactive:
    """The chart as a part of a page; without Bokeh its still picture alone."""
    still = drawn(lambda path: draw_chart(chart, path), chart.alt, chart.caption)
    return Interactive(still, _item(chart) if find_spec("bokeh") else None)


# ---------------------------------------------------------------------------------------- still


def draw_chart(chart: Chart, path: str | Path) -> None:
    """Draw a chart as SVG or PNG."""
    heights = [panel.height for panel in chart.panels]
    figure = new_figure(11.0, 0.6 + 2.4 * sum(heights))
    places = np.atleast_1d(
        figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    ).tolist()
    for axes, panel in zip(places, chart.panels, strict=True):
        for curve in panel.curves:
            _draw(axes, curve)
        for place, _ in chart.places:
            axes.axvline(place, color=PALE, linewidth=0.9, zorder=0)
        dress(axes, x="", y=panel.y, title=panel.title)
        if panel.from_zero:
            axes.set_ylim(bottom=0.0)
        if any(curve.label for curve in panel.curves):
            axes.legend(
                fontsize=8, frameon=False, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0)
            )
    km_axis(places[-1], chart.line, chart.x)
    span = _span(chart)
    places[-1].set_xlim(*span)
    _name_places(places[0], chart, span)
    figure.align_ylabels(places)
    write_figure(figure, path)


def _draw(axes: Axes, curve: Curve) -> None:
    if curve.kind == "points" and curve.low is not None and curve.high is not None:
        axes.vlines(curve.x, curve.low, curve.high, color=curve.colour, linewidth=1.0)
    elif curve.low is not None and curve.high is not None:
        axes.fill_between(
            curve.x, curve.low, curve.high, color=curve.colour, alpha=0.22, linewidth=0,
            step="post" if curve.kind == "step" else None,
        )  # fmt: skip
    style: dict[str, Any] = {
        "color": curve.colour,
        "linewidth": curve.width,
        "label": curve.label or None,
    }
    if curve.kind == "step":
        axes.step(curve.x, curve.y, where="post", **style)
    elif curve.kind == "area":
        base = 0.0 if curve.low is None else curve.low
        axes.fill_between(curve.x, base, curve.y, color=curve.colour, alpha=0.6, linewidth=0,
                          label=curve.label or None)  # fmt: skip
    elif curve.kind == "points":
        size = 2.0 * curve.width
        axes.plot(curve.x, curve.y, "o", color=curve.colour, markersize=size, label=curve.label)
    else:
        axes.plot(curve.x, curve.y, **style)


def _span(chart: Chart) -> tuple[float, float]:
    if chart.span is not None:
        return chart.span
    ends = [curve.x[np.isfinite(curve.x)] for panel in chart.panels for curve in panel.curves]
    every = np.concatenate([each for each in ends if each.size] or [np.array([0.0, 1.0])])
    low, high = float(every.min()), float(every.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _name_places(axes: Axes, chart: Chart, span: tuple[float, float]) -> None:
    """Names of stations at the top of an axes, upright where they would overlap."""
    for place, name, angle in _named(chart, span):
        share = (place - span[0]) / (span[1] - span[0])
        side = (
            "left" if share < 0.05 and not angle else "right" if angle or share > 0.95 else "center"
        )
        axes.text(
            place, 0.985, _short(name), fontsize=8, color=GREY, va="top", ha=side, rotation=angle,
            rotation_mode="default", transform=axes.get_xaxis_transform(), clip_on=True,
        )  # fmt: skip


def _named(chart: Chart, span: tuple[float, float]) -> Iterator[tuple[float, str, int]]:
    width = span[1] - span[0]
    low, high = span[0] - 0.005 * width, span[1] + 0.005 * width
    within = [each for each in chart.places if low <= each[0] <= high]
    close = any(
        after[0] - before[0] < 0.011 * width * max(len(_short(before[1])), len(_short(after[1])))
        for before, after in pairwise(within)
    )
    for place, name in within:
        yield min(max(place, span[0]), span[1]), name, 90 if close else 0


def _short(name: str) -> str:
    """A name as it fits into a picture, where dollar signs are no mathematics."""
    cut = name if len(name) <= 24 else f"{name[:23]}…"
    return cut.replace("$", r"\$")


# ---------------------------------------------------------------------------------- interactive


def _item(chart: Chart) -> dict[str, Any]:
    """What BokehJS draws."""
    from bokeh.embed import json_item
    from bokeh.layouts import column

    models: Any = import_module("bokeh.models")

    shared = models.Range1d(*_span(chart), bounds="auto")
    ruler = models.Span(dimension="height", line_color=GREY, line_dash="dashed")
    plots = []
    for number, panel in enumerate(chart.panels):
        plot = _plot(chart, panel, shared, first=number == 0, last=panel is chart.panels[-1])
        plot.add_tools(models.CrosshairTool(overlay=ruler))
        plots.append(plot)
    layout = column(*plots, sizing_mode="stretch_width")
    item: dict[str, Any] = dict(json_item(layout))
    return {name: item[name] for name in ("root_id", "doc", "version")}


def _plot(chart: Chart, panel: Panel, shared: Any, *, first: bool, last: bool) -> Any:
    models: Any = import_module("bokeh.models")
    figure: Any = import_module("bokeh.plotting").figure

    plot = figure(
        height=round(60 + 170 * panel.height), sizing_mode="stretch_width", x_range=shared,
        tools="xpan,xwheel_zoom,xbox_zoom,reset,save", active_drag="xbox_zoom", active_scroll=None,
        toolbar_location="right" if first else None, title=_plain(panel.title) or None,
        background_fill_color=PAPER, border_fill_color=PAPER, outline_line_color=PALE,
        output_backend="canvas", min_border_left=64,
    )  # fmt: skip
    if plot.title is not None:
        plot.title.update(text_color=INK, text_font_size="10pt", text_font_style="normal")
    plot.toolbar.logo = None
    plot.xaxis.axis_label, plot.yaxis.axis_label = chart.x if last else None, panel.y
    for axis in (*plot.xaxis, *plot.yaxis):
        axis.update(
            axis_label_text_color=INK, major_label_text_color=INK, axis_line_color=GREY,
            major_tick_line_color=GREY, minor_tick_line_color=None,
            axis_label_text_font_style="normal",
        )  # fmt: skip
    for grid in (*plot.xgrid, *plot.ygrid):
        grid.grid_line_color = PALE
    _label_kilometres(plot, chart)
    for curve in panel.curves:
        _add(plot, curve)
    if panel.from_zero:
        plot.y_range.start = 0.0
    for place, _ in chart.places:
        plot.add_layout(models.Span(location=place, dimension="height", line_color=PALE))
    if first:
        low, high = _span(chart)
        for place, name, angle in _named(chart, (low, high)):
            last_one = place > low + 0.93 * (high - low) and not angle
            label = models.Label(
                x=place, y=2.0, x_units="data", y_units="screen", text=_plain(name),
                text_color=GREY, text_font_size="8pt", angle=np.deg2rad(angle).item(),
                x_offset=-3 if last_one else 3, text_align="right" if last_one else "left",
            )  # fmt: skip
            plot.add_layout(label)
    for each in plot.legend:
        each.update(
            label_text_color=INK, label_text_font_size="8pt", background_fill_color=None,
            border_line_color=None, orientation="horizontal", padding=0, click_policy="hide",
        )  # fmt: skip
        plot.add_layout(each, "above")
    return plot


def _label_kilometres(plot: Any, chart: Chart) -> None:
    """Ticks at the operator's kilometres; when enlarged, those between as far as they fit."""
    if chart.line is None or chart.line.reference is None:
        return
    models: Any = import_module("bokeh.models")
    low, high = (1e3 * each for each in _span(chart))
    coarse, _ = km_ticks(chart.line, low, high)
    fine, labels = km_ticks(chart.line, low, high, FINE_TICKS)
    places = (fine / 1e3).tolist()
    plot.xaxis.ticker = models.FixedTicker(ticks=places)
    plot.xaxis.major_label_overrides = dict(zip(places, labels, strict=True))
    plot.xaxis.major_label_policy = models.NoOverlap(min_distance=40)
    plot.xgrid.ticker = models.FixedTicker(ticks=(coarse / 1e3).tolist())


def _plain(text: str) -> str:
    """Text that BokehJS takes for text: between dollar signs it would look for mathematics."""
    return text.replace("$", "＄").replace(r"\[", "[").replace(r"\(", "(")


def _add(plot: Any, curve: Curve) -> None:
    """A curve with its band; where a value is not known both end, and begin again behind it."""
    models: Any = import_module("bokeh.models")
    data: dict[str, Any] = {"x": _single(curve.x), "y": _single(curve.y)}
    names = {f"h{number}": name for number, name in enumerate(curve.hover)}
    data |= {key: list(curve.hover[name]) for key, name in names.items()}
    source = models.ColumnDataSource(data)
    colour = {"line_color": curve.colour}
    style: dict[str, Any] = {"legend_label": _plain(curve.label)} if curve.label else {}
    if curve.kind == "area":
        base = np.zeros_like(curve.y) if curve.low is None else curve.low
        _fill(plot, curve, base, curve.y, 0.6, **style)
    elif curve.low is not None and curve.high is not None:
        if curve.kind == "points":
            ends = {"x0": data["x"], "y0": _single(curve.low), "y1": _single(curve.high)}
            plot.segment("x0", "y0", "x0", "y1", source=models.ColumnDataSource(ends), **colour)
        else:
            _fill(plot, curve, curve.low, curve.high, 0.22)
    if curve.kind == "step":
        shown = plot.step(
            "x", "y", source=source, mode="after", line_width=curve.width, **colour, **style
        )
    elif curve.kind == "points":
        shown = plot.scatter(
            "x", "y", source=source, size=3.2 * curve.width, fill_color=curve.colour,
            **colour, **style,
        )  # fmt: skip
    elif curve.kind == "line":
        shown = plot.line("x", "y", source=source, line_width=curve.width, **colour, **style)
    else:
        return
    if names:
        tips = [(_plain(name), f"@{key}") for key, name in names.items()]
        mode = "mouse" if curve.kind == "points" else "vline"
        hover = models.HoverTool(
            renderers=[shown], tooltips=tips, mode=mode, line_policy="nearest", visible=False
        )
        plot.add_tools(hover)


def _fill(
    plot: Any, curve: Curve, low: FloatArray, high: FloatArray, opacity: float, **style: Any
) -> None:
    """Fill between two curves, apart on either side of what is not known: BokehJS would join it."""
    known = np.isfinite(low) & np.isfinite(high)
    for begin, end in runs_of(known):
        part = slice(begin, end)
        filled = plot.varea_step if curve.kind == "step" else plot.varea
        mode = {"step_mode": "after"} if curve.kind == "step" else {}
        filled(
            _single(curve.x[part]), _single(low[part]), _single(high[part]),
            fill_color=curve.colour, fill_alpha=opacity, **mode, **style,
        )  # fmt: skip


def _single(values: FloatArray) -> NDArray[np.float32]:
    """Values as a screen shows them; half the bytes."""
    return np.asarray(values, dtype=np.float32)
