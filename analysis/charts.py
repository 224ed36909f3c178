"""Charts: each picture is described once, and drawn still here, interactive in a report.

A `Chart` is a few panels over one axis; a result declares its charts, and its ``plot()`` draws them
(`trainlog.presentation`). Colours, sizes and how a figure is written are here, too: one look for
all.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from trainlog.formats.files import atomic_write
from trainlog.presentation import Presented
from trainlog.railway.line import Line, StepProfile, km_ticks
from trainlog.units import KMH, PER_MILLE

BLUE, ORANGE, GREEN = "#0072b2", "#e69f00", "#009e73"
RED, PURPLE, SKY = "#d55e00", "#8e5ea2", "#56b4e9"
"""Colours that colour-blind readers can distinguish (Okabe and Ito)."""

INK, GREY, PALE = "#222222", "#7f7f7f", "#d0d0d0"
"""Text and lines; data in the background; grids."""

PAPER = "#ffffff"

ON_PALE = "#1a1a1a"
"""Text on a coloured ground, which stays what it is where a page turns dark."""

DOTS_PER_INCH = 150

WIDTH = 11.0
"""Of a figure [inch]."""

LEAST_WIDTH = 5.0
"""Of a figure of a narrow chart alone [inch]."""

LETTERS = 130
"""That have space in a line over the whole width of a figure."""

NARROW = 0.5
"""Share of a figure's width below which a chart has its legend inside."""

LEGEND_LINE = 0.08
"""Share of a panel of height 1 that a line of such a legend takes."""

MOST_POINTS = 2_500
"""Of a curve in a chart, about: more than there are pixels show nothing more."""


# -------------------------------------------------------------------------------- what is drawn


@dataclass(frozen=True, eq=False)
class Curve:
    """Values over the chart's axis.

    Attributes
    ----------
    label : str
    x, y : (n,) array
    colour : str
        One of this module.
    kind : {"line", "step", "area", "points", "bars"}
        ``"step"`` holds each value up to the next x; ``"area"`` and ``"bars"`` begin at 0.
    low, high : (n,) array, optional
        Of a band, or of each point; of an area or bars, `low` is where it begins, 0 without. What
        is not known is NaN, and nothing is drawn over it.
    hover : mapping of str to sequence of str
        What is stated of each point under the pointer, by name.
    width : float
        Of the line; points are larger with it, too. Of bars: on their axis.
    dash : str
        As of matplotlib: ``"--"``, ``":"``; empty for none.
    opacity : float
    mark : str
        Of points, as of matplotlib.
    across : bool
        Points and bars lie: `x` is the value, with `low` and `high`, and `y` the row.
    """

    label: str
    x: ArrayLike
    y: ArrayLike
    colour: str = BLUE
    kind: Literal["line", "step", "area", "points", "bars"] = "line"
    low: ArrayLike | None = None
    high: ArrayLike | None = None
    hover: Mapping[str, Sequence[str]] = field(default_factory=dict)
    width: float = 1.6
    dash: str = ""
    opacity: float = 1.0
    mark: str = "o"
    across: bool = False

    def __post_init__(self) -> None:
        for name in ("x", "y", "low", "high"):
            values = getattr(self, name)
            if values is not None:
                object.__setattr__(self, name, np.asarray(values, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class Cells:
    """Coloured cells between edges on both axes.

    Attributes
    ----------
    x : (n + 1,) array
    y : (m + 1,) array
    colours : (m, n) array of str
        As ``#rrggbb``; empty where there is none.
    names : mapping of str to str
        Colours that the legend names, by name.
    words : (m, n) array of str, optional
        What is written in each.
    hover : mapping of str to sequence of str
        What is stated of each under the pointer, row by row.
    """

    x: ArrayLike
    y: ArrayLike
    colours: NDArray[np.str_]
    names: Mapping[str, str] = field(default_factory=dict)
    words: NDArray[np.str_] | None = None
    hover: Mapping[str, Sequence[str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Span:
    """A shaded part of the axis, over the height of the panel; or of the ordinate, if it lies."""

    start: float
    end: float
    colour: str = PALE
    label: str = ""
    opacity: float = 0.45
    across: bool = False


@dataclass(frozen=True)
class Rule:
    """A straight line: at a level of the ordinate, or upright at a place of the axis."""

    at: float
    colour: str = INK
    label: str = ""
    upright: bool = False
    dash: str = ""
    width: float = 0.8


@dataclass(frozen=True)
class Label:
    """Words at a place; without a `y` at the top of the panel.

    Attributes
    ----------
    x : float
    words : str
    y : float, optional
    colour : str
    upright : bool
    side : {"left", "center", "right"}
        Which part of the words stands at `x`.
    size : float
    """

    x: float
    words: str
    y: float | None = None
    colour: str = INK
    upright: bool = False
    side: Literal["left", "center", "right"] = "center"
    size: float = 7.0


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves with one ordinate.

    Attributes
    ----------
    y : str
        What it is, with its unit.
    curves : sequence of Curve or Cells
    height : float
        Relative to the other panels.
    title : str
    from_zero : bool
        Whether the ordinate begins at zero.
    limits : (float, float), optional
        Ends of the ordinate.
    spans, rules, labels
    rows : sequence of str
        Names of 0, 1, 2 ... on the ordinate, from the top down.
    bare : bool
        Without ordinate and grid.
    """

    y: str
    curves: Sequence[Curve | Cells]
    height: float = 1.0
    title: str = ""
    from_zero: bool = False
    limits: tuple[float, float] | None = None
    spans: Sequence[Span] = ()
    rules: Sequence[Rule] = ()
    labels: Sequence[Label] = ()
    rows: Sequence[str] = ()
    bare: bool = False


@dataclass(frozen=True, eq=False)
class Chart:
    """Panels over one axis.

    Attributes
    ----------
    x : str
        What the axis is, with its unit.
    panels : sequence of Panel
    caption : str
    places : sequence of (float, str), optional
        Marked in all panels and named in the first; default: the stations of the line.
    span : (float, float), optional
        Ends of the axis; default: those of the curves.
    line : Line, optional
        The axis is its chainage [km], labelled with the operator's kilometres if it has them.
    title : str
    beside : bool
        Whether it stands at the right of the chart before it, where there is space.
    width : float
        Relative to the charts beside it.
    ticks : sequence of (float, str)
        Named places of the axis; default: numbers.
    dates : bool
        The axis has days since 1970.
    second : (str, float, float), optional
        A second scale above: its label, and factor and summand that make its values of the axis's.
    equal : bool
        A unit is as long on the ordinate as on the axis.
    """

    x: str
    panels: Sequence[Panel]
    caption: str = ""
    places: Sequence[tuple[float, str]] | None = None
    span: tuple[float, float] | None = None
    line: Line | None = None
    title: str = ""
    beside: bool = False
    width: float = 1.0
    ticks: Sequence[tuple[float, str]] = ()
    dates: bool = False
    second: tuple[str, float, float] | None = None
    equal: bool = False

    def __post_init__(self) -> None:
        if self.line is not None and self.line.reference is not None:
            object.__setattr__(self, "x", "km")

    @property
    def marked(self) -> list[Panel]:
        """The panels with the places marked in all of them, and named in the first."""
        places = self.places
        if places is None:
            stations = () if self.line is None else self.line.stations
            places = [(each.position / 1e3, each.name) for each in stations]
        low, high = self.ends
        width = high - low
        within = [
            (min(max(at, low), high), _short(name))
            for at, name in places
            if low - 0.005 * width <= at <= high + 0.005 * width
        ]
        # Upright where they would else overlap.
        close = any(
            after - at < 0.011 * width * max(len(name), len(other))
            for (at, name), (after, other) in pairwise(within)
        )
        names = list[Label]()
        for at, name in within:
            label = Label(at, name, None, GREY, close, "center", 8.0)
            if close or at > low + 0.95 * width:
                label = replace(label, side="right")
            elif at < low + 0.05 * width:
                label = replace(label, side="left")
            names.append(label)
        rules = [Rule(at, PALE, upright=True, width=0.9) for at, _ in within]
        return [
            replace(
                panel,
                rules=[*rules, *panel.rules],
                labels=[*panel.labels, *names] if number == 0 else panel.labels,
            )
            for number, panel in enumerate(self.panels)
        ]

    def kilometres(self, most: int = 10) -> list[tuple[float, str]]:
        """Ticks at the operator's kilometres, about so many; none where the line has none."""
        if self.line is None or self.line.reference is None:
            return []
        low, high = self.ends
        places, names = km_ticks(self.line, 1e3 * low, 1e3 * high, most)
        return list(zip((places / 1e3).tolist(), names, strict=True))

    @property
    def alt(self) -> str:
        """What it shows, for those who do not see it: titles, axes and the legend."""
        shown = ", ".join(filter(None, (each.title or each.y for each in self.panels)))
        over = f"{shown} over {self.x}" if shown and self.x else shown
        named = ", ".join(name for name, *_ in legend_of(self))
        return ". ".join(" ".join(each.split()) for each in (self.title, over, named) if each)

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the axis."""
        if self.span is not None:
            return self.span
        every = [
            np.add.outer((-0.5 * curve.width, 0.5 * curve.width), curve.x)
            if isinstance(curve, Curve) and curve.kind == "bars" and not curve.across
            else np.asarray(curve.x)
            for panel in self.panels
            for curve in panel.curves
        ]
        found = [each[np.isfinite(each)] for each in every]
        joined = np.concatenate([each for each in found if each.size] or [np.array([0.0, 1.0])])
        low, high = float(joined.min()), float(joined.max())
        return (low, high) if high > low else (low - 0.5, high + 0.5)


def limit_curve(line: Line, start: float, end: float) -> Curve:
    """The permitted speed between two positions [m]."""
    return _profile(line, line.speed_limits, KMH, "permitted speed", INK, (start, end))


def gradient_panel(line: Line, start: float, end: float) -> Panel:
    """The gradient between two positions [m]."""
    gradient = _profile(line, line.gradients, PER_MILLE, "", GREY, (start, end))
    return Panel("gradient, ‰", [gradient], 0.5)


def line_charts(line: Line) -> list[Chart]:
    """Limits and gradients of a line."""
    ends, against = (0.0, line.length), line.speed_limits_reverse
    limits = [_profile(line, line.speed_limits, KMH, "permitted speed", INK, ends)]
    if against is not None:
        limits.append(_profile(line, against, KMH, "against the chainage", ORANGE, ends))
    return [
        Chart(
            "km", [Panel("km/h", limits, 1.0, from_zero=True), gradient_panel(line, *ends)],
            line=line, title=line.name,
        )
    ]  # fmt: skip


def _profile(
    line: Line,
    profile: StepProfile,
    factor: float,
    label: str,
    colour: str,
    ends: tuple[float, float],
) -> Curve:
    start, end = max(ends[0], 0.0), min(ends[1], line.length)
    inner = profile.positions[(profile.positions > start) & (profile.positions < end)]
    edges = np.concatenate(([start], inner, [end]))
    values = factor * profile(edges)
    values[-1] = values[-2]
    return Curve(label, edges / 1e3, values, colour, "step", width=1.1)


def rows_to_draw(*curves: ArrayLike, most: int = MOST_POINTS) -> NDArray[np.int64]:
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


def worded(form: str, *values: ArrayLike) -> list[str]:
    """Values in words, as `Curve.hover` has them.

    Examples
    --------
    >>> worded("{:.1f} to {:.1f} kN", [1.0, 2.0], [1.5, 2.5])
    ['1.0 to 1.5 kN', '2.0 to 2.5 kN']
    """
    columns = [np.asarray(each, dtype=np.float64).tolist() for each in values]
    return [form.format(*each) for each in zip(*columns, strict=True)]


def days_of(moments: pd.Series) -> NDArray[np.float64]:
    """Days since 1970 in UTC, as a chart over dates has them."""
    instants = pd.DatetimeIndex(pd.to_datetime(moments, utc=True)).as_unit("s")
    return instants.asi8.astype(np.float64) / 86_400.0


def shades(values: ArrayLike, colours: str, span: tuple[float, float]) -> NDArray[np.str_]:
    """Colours of values in a colour map of matplotlib; empty where a value is not known.

    Examples
    --------
    >>> shades([[0.0, np.nan]], "viridis", (0.0, 1.0)).tolist()
    [['#440154', '']]
    """
    known = np.asarray(values, dtype=np.float64)
    share = np.clip((known - span[0]) / (span[1] - span[0]), 0.0, 1.0)
    found = [
        to_hex(colormaps[colours](each)) if np.isfinite(each) else "" for each in share.ravel()
    ]
    return np.array(found, dtype=np.str_).reshape(known.shape)


def legend_of(chart: Chart) -> Iterator[tuple[str, str, str]]:
    """What a legend names, each once: name, colour, and how it is drawn."""
    found = dict[str, tuple[str, str]]()
    for panel in chart.panels:
        for each in panel.curves:
            if isinstance(each, Cells):
                found |= {name: (colour, "area") for name, colour in each.names.items()}
            elif each.label:
                found.setdefault(each.label, (each.colour, each.kind))
        for span in panel.spans:
            found |= {span.label: (span.colour, "area")} if span.label else {}
        for rule in panel.rules:
            found |= {rule.label: (rule.colour, "line")} if rule.label else {}
    for name, (colour, kind) in found.items():
        yield name, colour, kind


def rows_of(charts: Sequence[Chart]) -> list[list[Chart]]:
    """Charts row by row: those that stand beside each other."""
    rows = list[list[Chart]]()
    for chart in charts:
        if chart.beside and rows:
            rows[-1].append(chart)
        else:
            rows.append([chart])
    return rows


# ------------------------------------------------------------------------------------ a figure


class Drawing(Figure):
    """A figure that a notebook shows, whatever backend it has."""

    def _repr_png_(self) -> bytes:
        from io import BytesIO

        with BytesIO() as file:
            self.savefig(file, format="png", dpi=100)
            return file.getvalue()


def new_figure(width: float = 9.0, height: float = 5.0) -> Figure:
    """An empty figure of `width` by `height` [inch] on an Agg canvas; needs no display."""
    figure = Drawing(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def dress(axes: Axes, *, x: str, y: str, title: str = "") -> Axes:
    """Label an axes and give it the common look."""
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    if title:
        axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.grid(visible=True, color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GREY)
    axes.tick_params(colors=INK, labelsize=9)
    return axes


def write_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, or as SVG if the path ends so: whole or not at all.

    The same figure gives the same bytes. An SVG has no background, so that it stands on a page of
    any colour.
    """
    with atomic_write(path) as temporary:
        if Path(path).suffix == ".svg":
            with rc_context({"svg.hashsalt": "trainlog"}):
                about = {"Date": None, "Creator": None}
                figure.savefig(temporary, format="svg", transparent=True, metadata=about)
            return
        figure.savefig(temporary, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None})


# ----------------------------------------------------------------------------- charts, standing


def figure_of(charts: Chart | Sequence[Chart]) -> Figure:
    """Charts as one figure: below each other, and beside each other where they say so.

    Examples
    --------
    >>> chart = Chart("km", [Panel("km/h", [Curve("speed", [0.0, 1.0], [0.0, 80.0])])])
    >>> figure_of(chart).axes[0].get_ylabel()
    'km/h'
    """
    rows = rows_of([charts] if isinstance(charts, Chart) else charts)
    alone = len(rows) == 1 and len(rows[0]) == 1
    share = max(rows[0][0].width, LEAST_WIDTH / WIDTH) if alone else 1.0
    rows = [[_wrapped(chart, share * chart.width / _widths(row)) for chart in row] for row in rows]
    heights = [max(_height(chart) for chart in row) for row in rows]
    figure = new_figure(WIDTH * share, sum(heights))
    parts: list[Any] = [figure]
    if not alone:
        parts = figure.subfigures(len(rows), 1, height_ratios=heights, squeeze=False)[:, 0].tolist()
    for row, part in zip(rows, parts, strict=True):
        inner: list[Any] = [part]
        if len(row) > 1:
            inner = part.subfigures(1, len(row), width_ratios=[each.width for each in row])
        lines = max(each.title.count("\n") for each in row)
        known = set[str]()
        for chart, place in zip(row, inner, strict=True):
            place.set_facecolor("none" if place is not figure else "white")
            _draw_chart(place, chart, share * chart.width / _widths(row), known)
            if chart.title:
                # Titles of one height: the charts of a row stand on one level.
                words = chart.title + "\n" * (lines - chart.title.count("\n"))
                size = 11.0 if len(row) == 1 else 10.0
                place.suptitle(words, x=0.01, ha="left", fontsize=size, color=INK)
    return figure


def draw(result: Presented, path: str | Path, **options: Any) -> None:
    """Write the picture of a result, PNG or SVG; `options` as of its `plot`."""
    write_figure(result.plot(**options), path)


def draw_charts(charts: Chart | Sequence[Chart], path: str | Path) -> None:
    """Draw charts as one picture, SVG or PNG."""
    write_figure(figure_of(charts), path)


def draw_all(pictures: Mapping[str, Sequence[Chart]], folder: Path) -> list[Path]:
    """Draw charts into a folder, by the names of their files; returns the files."""
    for name, charts in pictures.items():
        draw_charts(charts, folder / name)
    return [folder / name for name in pictures]


def _widths(row: Sequence[Chart]) -> float:
    return sum(each.width for each in row)


def _wrapped(chart: Chart, share: float) -> Chart:
    """With a title as wide as the chart, which takes a share of the figure."""
    most = round(LETTERS * share)
    lines = [part for line in chart.title.splitlines() for part in textwrap.wrap(line, most)]
    return replace(chart, title="\n".join(lines))


def _height(chart: Chart) -> float:
    """Of a chart [inch]."""
    titles = 0.2 * (chart.title.count("\n") + 1) * bool(chart.title)
    return 0.6 + titles + 2.4 * sum(panel.height for panel in chart.panels)


def _draw_chart(figure: Figure | SubFigure, chart: Chart, share: float, known: set[str]) -> None:
    """Draw a chart; its legend leaves out the names that are known from charts beside it."""
    heights = [panel.height for panel in chart.panels]
    places = np.atleast_1d(
        figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    ).tolist()
    for axes, panel in zip(places, chart.marked, strict=True):
        _draw_panel(axes, panel)
        _draw_legend(axes, panel, share, known, chart.second is None)
    last: Axes = places[-1]
    last.set_xlabel(chart.x, color=INK)
    # Of equal scales the limits give way, or the frame where the data's are fixed.
    fixed = chart.span is not None or chart.panels[-1].limits is not None
    last.set_xlim(*chart.ends, auto=chart.equal and not fixed)
    if not chart.x and all(panel.bare for panel in chart.panels):
        last.xaxis.set_visible(False)
        last.spines["bottom"].set_visible(False)
    if ticks := chart.ticks or chart.kilometres():
        close = sum(len(name) for _, name in ticks) > 90 * chart.width
        last.set_xticks(*zip(*ticks, strict=True), rotation=40 if close else 0,
                        ha="right" if close else "center", fontsize=8)  # fmt: skip
    if chart.dates:
        locator = AutoDateLocator(minticks=3, maxticks=9)  # type: ignore[no-untyped-call]
        last.xaxis.set_major_locator(locator)
        last.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    if chart.second is not None:
        label, factor, summand = chart.second
        scale = places[0].secondary_xaxis(
            "top", functions=(lambda x: factor * x + summand, lambda y: (y - summand) / factor)
        )
        scale.set_xlabel(label, fontsize=9, color=GREY)
        scale.tick_params(labelsize=8, colors=GREY)
        scale.spines["top"].set_color(GREY)
    if chart.equal:
        last.set_aspect("equal", adjustable="box" if fixed else "datalim")
    figure.align_ylabels(places)


def _draw_panel(axes: Axes, panel: Panel) -> None:
    for span in panel.spans:
        shade = axes.axhspan if span.across else axes.axvspan
        shade(span.start, span.end, color=span.colour, alpha=span.opacity, linewidth=0,
              label=span.label or None)  # fmt: skip
    for each in panel.curves:
        if isinstance(each, Cells):
            _draw_cells(axes, each)
        else:
            _draw_curve(axes, each)
    for rule in panel.rules:
        line = axes.axvline if rule.upright else axes.axhline
        line(rule.at, color=rule.colour, linewidth=rule.width, linestyle=rule.dash or "-",
             label=rule.label or None, zorder=0 if rule.colour == PALE else 2)  # fmt: skip
    dress(axes, x="", y=panel.y, title=panel.title)
    if panel.rows:
        axes.set_yticks(range(len(panel.rows)), [_short(each) for each in panel.rows], fontsize=7)
        axes.set_ylim(len(panel.rows) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")
    if panel.from_zero:
        axes.set_ylim(bottom=0.0)
    if panel.limits is not None:
        axes.set_ylim(*panel.limits)
    if panel.bare:
        axes.set_yticks([])
        axes.grid(visible=False)
        axes.spines["left"].set_visible(False)
    for label in panel.labels:
        _write(axes, label)


def _write(axes: Axes, label: Label) -> None:
    at_top = label.y is None
    axes.text(
        label.x, 0.98 if label.y is None else label.y, _plain(label.words), color=label.colour,
        fontsize=label.size, ha=label.side, va="top" if at_top else "center",
        rotation=90 if label.upright else 0, clip_on=True,
        transform=axes.get_xaxis_transform() if at_top else axes.transData,
    )  # fmt: skip


def _draw_legend(axes: Axes, panel: Panel, share: float, known: set[str], above: bool) -> None:
    """What is drawn, each name once: above the panel on the right if free, or in it."""
    handles, names = axes.get_legend_handles_labels()
    cells = [each for each in panel.curves if isinstance(each, Cells)]
    entries = dict(zip(names, handles, strict=True))
    entries |= {
        name: Patch(color=colour, linewidth=0)
        for each in cells
        for name, colour in each.names.items()
    }
    narrow = share < NARROW
    if narrow:
        entries = {name: handle for name, handle in entries.items() if name not in known}
        known.update(entries)
    if not entries:
        return
    # Above the panel there is space for its title and so many letters.
    letters = len(panel.title) + sum(len(name) + 6 for name in [*entries][: 9 if cells else 4])
    inside = narrow or (letters > LETTERS * share and not cells)
    place: dict[str, Any] = {"loc": "best", "fontsize": 7 if narrow else 8}
    if above and not inside:
        place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": 9 if cells else 4,
                 "fontsize": 8}  # fmt: skip
    elif narrow and panel.limits is not None:
        # Over what is drawn within fixed limits stands the legend, in space of its own.
        low, high = panel.limits
        taken = min(LEGEND_LINE * len(entries) / panel.height, 0.6)
        axes.set_ylim(low, low + (high - low) / (1.0 - taken))
        place["loc"] = "upper right"
    axes.legend(entries.values(), entries.keys(), frameon=False, **place)


def _draw_cells(axes: Axes, cells: Cells) -> None:
    colours = np.asarray(cells.colours)
    shown = np.zeros((*colours.shape, 4))
    for place in zip(*np.nonzero(colours != ""), strict=True):
        text = str(colours[place])
        shown[place] = [*(int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5)), 1.0]
    axes.pcolormesh(cells.x, cells.y, shown, rasterized=colours.size > 4_000, linewidth=0)
    if cells.words is not None:
        x, y = (0.5 * (each[1:] + each[:-1]) for each in map(np.asarray, (cells.x, cells.y)))
        for row, column in np.ndindex(colours.shape):
            axes.text(x[column], y[row], str(cells.words[row, column]), ha="center", va="center",
                      fontsize=8, color=ink_on(str(colours[row, column])))  # fmt: skip


def ink_on(colour: str) -> str:
    """The colour of words on a cell of a colour, #rrggbb.

    Examples
    --------
    >>> ink_on("#67001f"), ink_on("#f7f7f7") == ON_PALE
    ('white', True)
    """
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return "white" if 0.3 * red + 0.59 * green + 0.11 * blue < 127.5 else ON_PALE


def _draw_curve(axes: Axes, curve: Curve) -> None:
    values: Any = curve.x, curve.y, curve.low, curve.high
    x, y, low, high = values
    style: dict[str, Any] = {
        "color": curve.colour,
        "alpha": curve.opacity,
        "label": curve.label or None,
    }
    dashed: dict[str, Any] = {"linewidth": curve.width, "linestyle": curve.dash or "-"}
    if low is not None and high is not None and curve.kind != "bars":
        if curve.kind == "points":
            between = axes.hlines if curve.across else axes.vlines
            between(y if curve.across else x, low, high, color=curve.colour, linewidth=1.0,
                    alpha=min(curve.opacity, 0.8))  # fmt: skip
        else:
            axes.fill_between(
                x, low, high, color=curve.colour, alpha=0.22, linewidth=0,
                step="post" if curve.kind == "step" else None,
            )  # fmt: skip
    if curve.kind == "step":
        axes.step(x, y, where="post", **style, **dashed)
    elif curve.kind == "area":
        base = 0.0 if low is None else low
        axes.fill_between(x, base, y, **(style | {"alpha": 0.6 * curve.opacity}), linewidth=0)
    elif curve.kind == "points":
        axes.plot(x, y, linestyle="", marker=curve.mark, **style, markersize=2.0 * curve.width,
                  markeredgewidth=0.0 if curve.mark in "o.^vs" else 1.0)  # fmt: skip
    elif curve.kind == "bars" and curve.across:
        base = np.zeros_like(x) if low is None else low
        axes.barh(y, x - base, curve.width, left=base, linewidth=0, **style)
    elif curve.kind == "bars":
        base = np.zeros_like(y) if low is None else low
        axes.bar(x, y - base, curve.width, bottom=base, linewidth=0, **style)
    else:
        axes.plot(x, y, **style, **dashed)


def _short(name: str) -> str:
    """A name as it fits into a picture, less the middle of a long one: the ends differ."""
    return _plain(name if len(name) <= 30 else f"{name[:14]}…{name[-15:]}")


def _plain(words: str) -> str:
    """Words where dollar signs are no mathematics."""
    return words.replace("$", r"\$")
