"""Charts of a report as BokehJS draws them: they show values under the pointer.

Bokeh is an extra (``report``).
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.charts import (
    GREY,
    INK,
    NARROW,
    PALE,
    PAPER,
    Cells,
    Chart,
    Curve,
    Panel,
)
from trainlog.arrays import FloatArray
from trainlog.spans import runs_of

FINE_TICKS = 60
"""Of an axis with the operator's kilometres in a chart that can be enlarged."""

MILLISECONDS = 86_400_000.0
"""In a day, in which BokehJS counts dates."""

MARKS = {"x": "x", "+": "cross", "^": "triangle", "v": "inverted_triangle", "s": "square",
         "|": "dash", "_": "dash"}  # fmt: skip
"""Marks of points: matplotlib's, and BokehJS's; others are circles."""

DASHES = {"--": "dashed", ":": "dotted", "-.": "dotdash"}

WITHOUT_BOKEH = (
    "The charts stand still here: with the extra report (pip install 'trainlog[report]') they show"
    " values under the pointer and can be enlarged."
)


def item_of(chart: Chart) -> dict[str, Any] | None:
    """What BokehJS draws (``bokeh.embed.json_item``); None of a chart that stands still.

    Those do where Bokeh is not installed, and whose units are as long on the ordinate as on the
    axis: BokehJS would draw them longer on one of them.
    """
    if chart.equal or not find_spec("bokeh"):
        return None
    from bokeh.embed import json_item
    from bokeh.layouts import column

    models: Any = import_module("bokeh.models")
    low, high = (each * _scale(chart) for each in chart.ends)
    shared = models.Range1d(low, high, bounds="auto")
    ruler = models.Span(dimension="height", line_color=GREY, line_dash="dashed")
    plots = []
    panels = chart.marked
    for panel in panels:
        ends = {"first": panel is panels[0], "last": panel is panels[-1]}
        plot = _plot(chart, panel, shared, **ends)
        plot.add_tools(models.CrosshairTool(overlay=ruler))
        plots.append(plot)
    layout = column(*plots, sizing_mode="stretch_width")
    item: dict[str, Any] = dict(json_item(layout))
    return {name: item[name] for name in ("root_id", "doc", "version")}


def _scale(chart: Chart) -> float:
    return MILLISECONDS if chart.dates else 1.0


def _plot(chart: Chart, panel: Panel, shared: Any, *, first: bool, last: bool) -> Any:
    models: Any = import_module("bokeh.models")
    figure: Any = import_module("bokeh.plotting").figure

    narrow = chart.width < NARROW
    plot = figure(
        height=round(60 + 170 * panel.height), sizing_mode="stretch_width", x_range=shared,
        tools="xpan,xwheel_zoom,xbox_zoom,reset,save", active_drag="xbox_zoom", active_scroll=None,
        toolbar_location="right" if first and not narrow else None,
        title=_plain(panel.title) or None,
        background_fill_color=PAPER, border_fill_color=PAPER, outline_line_color=PALE,
        border_line_color=None,
        output_backend="canvas", min_border_left=40 if narrow else 64,
        **({"x_axis_type": "datetime"} if chart.dates else {}),
    )  # fmt: skip
    if plot.title is not None:
        plot.title.update(text_color=INK, text_font_size="10pt", text_font_style="normal")
    plot.toolbar.logo = None
    plot.xaxis.axis_label, plot.yaxis.axis_label = chart.x if last else None, panel.y or None
    for axis in (*plot.xaxis, *plot.yaxis):
        axis.update(
            axis_label_text_color=INK, major_label_text_color=INK, axis_line_color=GREY,
            major_tick_line_color=GREY, minor_tick_line_color=None,
            axis_label_text_font_style="normal",
        )  # fmt: skip
    for grid in (*plot.xgrid, *plot.ygrid):
        grid.grid_line_color = PALE
    if narrow:
        plot.xaxis.ticker.desired_num_ticks = 3
    _label_axes(plot, chart, panel)
    scale = _scale(chart)
    for span in panel.spans:
        ends = ({"bottom": span.start, "top": span.end} if span.across else
                {"left": span.start * scale, "right": span.end * scale})  # fmt: skip
        shade = models.BoxAnnotation(
            **ends,
            fill_color=span.colour,
            fill_alpha=span.opacity,
            line_color=None,
            level="underlay",
        )
        plot.add_layout(shade)
    for each in panel.curves:
        if isinstance(each, Cells):
            _add_cells(plot, each)
        else:
            _add(plot, each, scale)
    _limit(plot, panel)
    _annotate(plot, panel, scale)
    return plot


def _limit(plot: Any, panel: Panel) -> None:
    if panel.from_zero:
        plot.y_range.start = 0.0
    if panel.limits is not None:
        plot.y_range.start, plot.y_range.end = panel.limits
    if panel.rows:
        plot.y_range.start, plot.y_range.end = len(panel.rows) - 0.4, -0.6
    if panel.bare:
        plot.yaxis.visible = False
        plot.ygrid.visible = False


def _annotate(plot: Any, panel: Panel, scale: float) -> None:
    """Lines and labels."""
    models: Any = import_module("bokeh.models")
    for rule in panel.rules:
        plot.add_layout(
            models.Span(
                location=rule.at * (scale if rule.upright else 1.0), line_color=rule.colour,
                dimension="height" if rule.upright else "width", line_width=rule.width,
                line_dash=DASHES.get(rule.dash, "solid"),
            )
        )  # fmt: skip
    for label in panel.labels:
        # Where the ordinate's end is known what has no ordinate stands at the top, else below.
        at_top = label.y is None and panel.limits is not None
        at: dict[str, Any] = {"y": label.y}
        if label.y is None:
            at = {"y": panel.limits[1]} if panel.limits else {"y": 2.0, "y_units": "screen"}
        across = "top" if at_top else "bottom" if label.y is None else "middle"
        plot.add_layout(
            models.Label(
                x=label.x * scale, text=_plain(label.words), text_color=label.colour, **at,
                angle=float(np.pi / 2.0) if label.upright else 0.0, text_font_size="8pt",
                text_align=("right" if at_top else "left") if label.upright else label.side,
                text_baseline="middle" if label.upright else across,
            )
        )  # fmt: skip


def _label_axes(plot: Any, chart: Chart, panel: Panel) -> None:
    """Named ticks, and those at the operator's kilometres: enlarged, as many as fit."""
    models: Any = import_module("bokeh.models")
    if panel.rows:
        plot.yaxis.ticker = models.FixedTicker(ticks=list(range(len(panel.rows))))
        names = {number: _plain(name) for number, name in enumerate(panel.rows)}
        plot.yaxis.major_label_overrides = names
    if coarse := chart.kilometres():
        plot.xgrid.ticker = models.FixedTicker(ticks=[place for place, _ in coarse])
    if ticks := chart.ticks or chart.kilometres(FINE_TICKS):
        plot.xaxis.ticker = models.FixedTicker(ticks=[place for place, _ in ticks])
        plot.xaxis.major_label_overrides = {place: _plain(name) for place, name in ticks}
        plot.xaxis.major_label_policy = models.NoOverlap(min_distance=40 if coarse else 4)


def _plain(text: str) -> str:
    """Text that BokehJS takes for text: between dollar signs it would look for mathematics."""
    return text.replace("$", "＄").replace(r"\[", "[").replace(r"\(", "(")


def _add(plot: Any, curve: Curve, scale: float) -> None:
    """A curve with its band; where a value is not known both end, and begin again behind it."""
    models: Any = import_module("bokeh.models")
    x, y = _single(np.asarray(curve.x) * scale, wide=scale > 1.0), _single(curve.y)
    data: dict[str, Any] = {"x": x, "y": y}
    names = {f"h{number}": name for number, name in enumerate(curve.hover)}
    data |= {key: list(curve.hover[name]) for key, name in names.items()}
    source = models.ColumnDataSource(data)
    colour = {"line_color": curve.colour, "line_alpha": curve.opacity}
    filled = {"fill_color": curve.colour, "fill_alpha": curve.opacity, "line_color": None}
    style: dict[str, Any] = {"name": curve.label} if curve.label else {}
    low, high = (None if each is None else np.asarray(each) for each in (curve.low, curve.high))
    if curve.kind == "area":
        base = np.zeros_like(curve.y) if low is None else low
        _fill(plot, curve, (x, base, np.asarray(curve.y)), 0.6 * curve.opacity, **style)
    elif low is not None and high is not None and curve.kind == "points":
        a, b = _single(low), _single(high)
        ends = ({"x0": a, "x1": b, "y0": y, "y1": y} if curve.across else
                {"x0": x, "x1": x, "y0": a, "y1": b})  # fmt: skip
        plot.segment("x0", "y0", "x1", "y1", source=models.ColumnDataSource(ends), **colour)
    elif low is not None and high is not None and curve.kind != "bars":
        _fill(plot, curve, (x, low, high), 0.22)
    if curve.kind == "bars":
        base = np.zeros_like(np.asarray(curve.x if curve.across else curve.y))
        source.data["base"] = _single(base if low is None else low)
        shown = (
            plot.hbar("y", curve.width, "x", left="base", source=source, **filled, **style)
            if curve.across
            else plot.vbar("x", curve.width * scale, "y", bottom="base", source=source, **filled,
                           **style)
        )  # fmt: skip
    elif curve.kind == "points":
        shown = plot.scatter(
            "x", "y", source=source, size=3.2 * curve.width, fill_color=curve.colour,
            fill_alpha=curve.opacity, marker=MARKS.get(curve.mark, "circle"), **colour, **style,
            **({"angle": float(np.pi / 2.0)} if curve.mark == "|" else {}),
        )  # fmt: skip
    elif curve.kind in ("line", "step"):
        line = {"line_width": curve.width, "line_dash": DASHES.get(curve.dash, "solid")}
        draw = plot.step if curve.kind == "step" else plot.line
        mode = {"mode": "after"} if curve.kind == "step" else {}
        shown = draw("x", "y", source=source, **mode, **line, **colour, **style)
    else:
        return
    _explain(plot, shown, names, "vline" if curve.kind in ("line", "step") else "mouse")


def _explain(plot: Any, shown: Any, names: dict[str, str], mode: str) -> None:
    """What is stated under the pointer."""
    if not names:
        return
    models: Any = import_module("bokeh.models")
    tips = [(_plain(name), f"@{key}") for key, name in names.items()]
    plot.add_tools(
        models.HoverTool(
            renderers=[shown], tooltips=tips, mode=mode, line_policy="nearest", visible=False
        )
    )


def _add_cells(plot: Any, cells: Cells) -> None:
    models: Any = import_module("bokeh.models")
    x, y = (np.asarray(each, dtype=np.float64) for each in (cells.x, cells.y))
    rows, columns = np.nonzero(np.asarray(cells.colours) != "")
    names = {f"h{number}": name for number, name in enumerate(cells.hover)}
    places = (rows * cells.colours.shape[1] + columns).tolist()
    data: dict[str, Any] = {
        "left": _single(x[columns]), "right": _single(x[columns + 1]),
        "bottom": _single(y[rows]), "top": _single(y[rows + 1]),
        "colour": np.asarray(cells.colours)[rows, columns].tolist(),
    }  # fmt: skip
    data |= {key: [cells.hover[name][place] for place in places] for key, name in names.items()}
    source = models.ColumnDataSource(data)
    # With lines of their own colour no seam shows between neighbours.
    shown = plot.quad("left", "right", "bottom", "top", source=source, fill_color="colour",
                      line_color="colour", line_width=0.8)  # fmt: skip
    _explain(plot, shown, names, "mouse")
    if cells.words is not None:
        words = np.asarray(cells.words)[rows, columns].tolist()
        middle = (0.5 * (x[columns] + x[columns + 1]), 0.5 * (y[rows] + y[rows + 1]))
        plot.text(*middle, text=words, text_align="center", text_baseline="middle",
                  text_font_size="8pt", text_color="#1a1a1a")  # fmt: skip


def _fill(
    plot: Any,
    curve: Curve,
    band: tuple[FloatArray, FloatArray, FloatArray],
    opacity: float,
    **style: Any,
) -> None:
    """Fill between two curves, apart on either side of what is not known: BokehJS would join it."""
    x, low, high = band
    known = np.isfinite(low) & np.isfinite(high)
    for begin, end in runs_of(known):
        part = slice(begin, end)
        filled = plot.varea_step if curve.kind == "step" else plot.varea
        mode = {"step_mode": "after"} if curve.kind == "step" else {}
        filled(
            x[part], _single(low[part]), _single(high[part]),
            fill_color=curve.colour, fill_alpha=opacity, **mode, **style,
        )  # fmt: skip


def _single(values: Any, *, wide: bool = False) -> NDArray[Any]:
    """Values as a screen shows them: half the bytes; instants need them all."""
    return np.asarray(values, dtype=np.float64 if wide else np.float32)
