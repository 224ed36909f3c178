"""A page: sections of words, tables, charts and results as one HTML file that needs no network.

Whatever comes from logs and files (names of trips, of stations, of files) is text and is escaped;
a Content-Security-Policy lets only the scripts run that this module writes, by their digest, and
forbids every request. Charts show values under the pointer, as BokehJS draws them; Bokeh is an
extra (``report``).
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from importlib import import_module
from importlib.util import find_spec
from itertools import count, groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    INK,
    NARROW,
    ORANGE,
    PALE,
    PAPER,
    PURPLE,
    RED,
    SKY,
    Cells,
    Chart,
    Curve,
    Panel,
    draw_charts,
    ink_on,
    legend_of,
    rows_of,
)
from trainlog import __version__
from trainlog.arrays import FloatArray
from trainlog.display import as_text
from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.presentation import Presented, WordTable
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
                  text_font_size="8pt",
                  text_color=[ink_on(each) for each in data["colour"]])  # fmt: skip


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


LARGEST = 5_000_000
"""Bytes of a page: more is refused, as mail and browsers of a control centre would."""

STILL = "The charts stand still here, so that the page is not too large to be sent."

COLOURS = {
    "paper": (PAPER, "#16181c"),
    "ink": (INK, "#e6e6e6"),
    "soft": ("#5a5a5a", "#a9adb3"),
    "grey": (GREY, "#8d9197"),
    "pale": (PALE, "#3c4046"),
    "line": ("#e2e2e2", "#2c2f34"),
    "shade": ("#f3f4f6", "#202328"),
    "link": ("#005a92", "#7ab8e6"),
    "blue": (BLUE, "#4aa3df"),
    "orange": (ORANGE, "#f0b840"),
    "green": (GREEN, "#2fc59b"),
    "red": (RED, "#f08a4b"),
    "purple": (PURPLE, "#b794d4"),
    "sky": (SKY, "#8accf5"),
}
"""Colours of the page by name, those of the pictures among them: on a light and a dark screen."""

LIGHT, DARK = ({name: both[screen] for name, both in COLOURS.items()} for screen in (0, 1))

DRAWN = ("ink", "grey", "pale", "blue", "orange", "green", "red", "purple", "sky")
"""Names of the colours that pictures use."""

_STYLE = (Path(__file__).parent / "page.css").read_text(encoding="utf-8")
_SCRIPT = (Path(__file__).parent / "page.js").read_text(encoding="utf-8")


LARGEST_SVG = 700_000
"""Bytes of an SVG, beyond which the picture is a PNG."""


@dataclass(frozen=True)
class Picture:
    """A picture and what it shows, for those who do not see it.

    Attributes
    ----------
    data : bytes
        SVG or PNG.
    alt : str
    caption : str
    """

    data: bytes
    alt: str
    caption: str = ""

    @property
    def is_svg(self) -> bool:
        """Whether it is an SVG."""
        return not self.data.startswith(b"\x89PNG")


def drawn(draw: Callable[[Path], object], alt: str, caption: str = "") -> Picture:
    """What a function draws into the file that it is given.

    Parameters
    ----------
    draw : callable
        Writes a picture to a path, as `draw_charts` does; called with an ``.svg``, and
        again with a ``.png`` if that is large.
    alt : str
        What the picture shows.
    caption : str

    Examples
    --------
    >>> from analysis.charts import new_figure, write_figure
    >>> drawn(lambda path: write_figure(new_figure(2.0, 1.0), path), "nothing").is_svg
    True
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.svg"
        draw(path)
        if path.stat().st_size > LARGEST_SVG:
            path = path.with_suffix(".png")
            draw(path)
        return Picture(path.read_bytes(), alt, caption)


_LONG = re.compile(r"(\d\.\d\d)\d+")


def inline(picture: Picture, prefix: str) -> str:
    """A picture as an element of a page; `prefix` makes the identifiers in it its own."""
    alt = escape(picture.alt, quote=True)
    if not picture.is_svg:
        data = base64.b64encode(picture.data).decode()
        return f'<img alt="{alt}" src="data:image/png;base64,{data}">'
    text = picture.data.decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", text, flags=re.S)
    text = re.sub(r'\bid="', f'id="{prefix}', text)
    text = re.sub(r'href="#', f'href="#{prefix}', text)
    text = re.sub(r"url\(#", f"url(#{prefix}", text)
    text = re.sub(r'^<svg ([^>]*?)width="[^"]*"', r"<svg \1", text)
    text = re.sub(r'^<svg ([^>]*?)height="[^"]*"', r"<svg \1", text)
    # To a hundredth of a point: more is not seen, and is half of the file.
    text = re.sub(r' d="[^"]*"', lambda path: _LONG.sub(r"\1", path[0]), text)
    for name in ("paper", *DRAWN):
        text = text.replace(f": {LIGHT[name]}", f": var(--{name})")
    text = re.sub(r"\s*\n\s*", "\n", text)
    return text.replace("<svg ", f'<svg role="img" aria-label="{alt}" ', 1)


# ------------------------------------------------------------------------------------ the page


@dataclass(frozen=True)
class Still:
    """Charts of many curves as one picture that does not answer the pointer."""

    charts: Sequence[Chart]


@dataclass(frozen=True)
class Commands:
    """Commands as they are typed."""

    lines: tuple[str, ...]


@dataclass(frozen=True)
class Warned:
    """A sentence that a reader must not overlook."""

    words: str


Part = Any
"""A str, WordTable, Chart, Still, Picture, Commands, Warned, Section; or a result (`Presented`), of
which charts, tables and sentences follow.

A chart answers the pointer; where no script runs, and in print, its picture stands. Charts beside
each other (`Chart.beside`) follow one another.
"""


@dataclass(frozen=True, repr=False)
class Section:
    """A heading and what stands under it.

    Attributes
    ----------
    title : str
    parts : sequence of Part
    whole_page : bool
        Whether it begins on a new page in print.
    folded : bool
        Whether a reader opens it; in print it is open.
    """

    title: str
    parts: Sequence[Part]
    whole_page: bool = False
    folded: bool = False

    def __repr__(self) -> str:
        return f"Section {self.title!r} of {len(self.parts)} parts"


@dataclass(frozen=True, repr=False)
class Page:
    """What a report shows.

    Attributes
    ----------
    title, subtitle : str
    sections : sequence of Section
    problems : tuple of str
        Files that could not be shown, and why; the sections list them, too.
    """

    title: str
    subtitle: str
    sections: Sequence[Section]
    problems: tuple[str, ...] = ()
    _drawn: dict[int, tuple[object, Picture]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def __repr__(self) -> str:
        return as_text(
            f"Report '{self.title}'",
            {
                "sections": ", ".join(section.title for section in self.sections) or "none",
                "problems": str(len(self.problems) or "none"),
            },
        )

    def to_html(self, *, interactive: bool = True) -> str:
        """The page; the same content gives the same bytes.

        Without `interactive` the charts are still pictures.

        Examples
        --------
        >>> page = Page("Trip <1>", "", [Section("Stops", ["none"])])
        >>> "Trip &lt;1&gt;" in page.to_html() and "<1>" not in page.to_html()
        True
        """
        writer = _Writer(interactive, self._drawn)
        body = "".join(writer.section(each, 2) for each in self.sections)
        scripts = [_bokeh_script(), _SCRIPT] if writer.items else []
        plots = "".join(
            f'<script type="application/json" data-plot>{_as_script(item)}</script>\n'
            for item in writer.items
        )
        code = "".join(f"<script>{script}</script>\n" for script in scripts)
        sums = [base64.b64encode(hashlib.sha256(each.encode()).digest()) for each in scripts]
        digests = " ".join(f"'sha256-{each.decode()}'" for each in sums)
        policy = (
            "default-src 'none'; img-src data:; style-src 'unsafe-inline';"
            f" script-src {digests or chr(39) + 'none' + chr(39)};"
            " base-uri 'none'; form-action 'none'"
        )
        style = _STYLE.replace("/*LIGHT*/", _variables(LIGHT)).replace("/*DARK*/", _variables(DARK))
        subtitle = f'<p class="subtitle">{escape(self.subtitle)}</p>' if self.subtitle else ""
        colours = escape(json.dumps({name: LIGHT[name] for name in ("paper", *DRAWN)}), quote=True)
        return (
            f'<!DOCTYPE html>\n<html lang="en" data-colours="{colours}">\n'
            '<head>\n<meta charset="utf-8">\n'
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            '<meta name="color-scheme" content="light dark">\n'
            f'<meta name="generator" content="trainlog {escape(__version__)}">\n'
            f'<title>{escape(self.title)}</title>\n<link rel="icon" href="data:,">\n'
            f"<style>{style}</style>\n</head>\n<body>\n"
            f"<header><h1>{escape(self.title)}</h1>{subtitle}</header>\n"
            f"{self._contents()}<main>\n{body}</main>\n"
            f"<footer>Made by trainlog {escape(__version__)}; needs no network.</footer>\n"
            f"{plots}{code}</body>\n</html>\n"
        )

    def write(self, path: str | Path) -> None:
        """Write the page, whole or not at all.

        Raises
        ------
        InputError
            If it is larger than `LARGEST`, or cannot be written.
        """
        data = self.to_html().encode()
        if len(data) > LARGEST:
            words = " ".join(filter(None, [self.subtitle, STILL]))
            data = replace(self, subtitle=words).to_html(interactive=False).encode()
        if len(data) > LARGEST:
            raise InputError(
                f"the report would have {len(data) / 1e6:.1f} MB, over {LARGEST / 1e6:.0f} MB",
                file=path,
                remedy="report on fewer results, such as one trip",
            )
        with atomic_write(path) as temporary:
            temporary.write_bytes(data)

    def _contents(self) -> str:
        if len(self.sections) < 3:
            return ""
        links = "".join(
            f'<li><a href="#{_anchor(number)}">{escape(each.title)}</a></li>'
            for number, each in enumerate(self.sections, start=1)
        )
        return f'<nav aria-label="Contents"><ol>{links}</ol></nav>\n'


def _anchor(number: int) -> str:
    return f"section-{number}"


class _Writer:
    """Parts as HTML; numbers sections and pictures, and keeps what BokehJS is to draw."""

    def __init__(self, interactive: bool, drawn: dict[int, tuple[object, Picture]]) -> None:
        self._interactive, self._known = interactive, drawn
        self.items = list[dict[str, Any]]()
        self._pictures = self._sections = 0

    def section(self, section: Section, level: int) -> str:
        anchor = ""
        if level == 2:
            self._sections += 1
            anchor = f' id="{_anchor(self._sections)}"'
        kind = ' class="new-page"' if section.whole_page else ""
        body = self.parts(section.parts, level)
        heading = f"<h{level}>{escape(section.title)}</h{level}>"
        if section.folded:
            # The place to which the contents lead is inside: going there opens it.
            inner = f'<div{anchor} class="inner">\n{body}</div>'
            body = f"<details>\n<summary>{heading}</summary>\n{inner}</details>"
            return f"<section{kind}>{body}</section>\n"
        return f"<section{anchor}{kind}>\n{heading}\n{body}</section>\n"

    def parts(self, parts: Sequence[Part], level: int) -> str:
        """Parts one after the other, charts row by row."""
        found = list[str]()
        for charts, group in groupby(parts, lambda each: isinstance(each, Chart)):
            alike = [*group]
            found += (
                map(self._row, rows_of(alike))
                if charts
                else [self.part(each, level) for each in alike]
            )
        return "".join(found)

    def part(self, part: Part, level: int) -> str:
        """A part that is no chart."""
        if isinstance(part, Section):
            return self.section(part, min(level + 1, 6))
        if isinstance(part, Presented):
            return self.parts([*(part.charts() if part.charts_by else ()), *part.shown()], level)
        if isinstance(part, WordTable):
            return part.html()
        if isinstance(part, Still):
            words = " ".join(each.alt for each in part.charts)
            return self._figure(self._inline(self._picture(part, part.charts, words)), "")
        if isinstance(part, Picture):
            return self._figure(self._inline(part), part.caption)
        if isinstance(part, Commands):
            return f"<pre><code>{escape(chr(10).join(part.lines))}</code></pre>\n"
        if isinstance(part, Warned):
            return f'<p class="warning" role="note">{escape(part.words)}</p>\n'
        return f"<p>{escape(str(part))}</p>\n"

    def _picture(
        self, key: object, charts: Sequence[Chart], alt: str, caption: str = ""
    ) -> Picture:
        """Charts as a picture, drawn once."""
        if id(key) not in self._known:
            picture = drawn(lambda path: draw_charts(charts, path), alt, caption)
            self._known[id(key)] = key, picture
        return self._known[id(key)][1]

    def _inline(self, picture: Picture) -> str:
        self._pictures += 1
        return inline(picture, f"p{self._pictures}-")

    @staticmethod
    def _figure(drawn: str, caption: str) -> str:
        words = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
        return f"<figure>{drawn}{words}</figure>\n"

    def _row(self, charts: Sequence[Chart]) -> str:
        """Charts beside each other as long as the screen has space, else below each other."""
        if len(charts) == 1:
            return self._chart(charts[0], _keys(legend_of(charts[0])))
        keys = _keys(key for each in charts for key in legend_of(each))
        row = "".join(self._chart(each, "") for each in charts)
        return f'<div class="row">{keys}<div class="beside">{row}</div></div>\n'

    def _chart(self, chart: Chart, keys: str) -> str:
        still = self._inline(self._picture(chart, [chart], chart.alt, chart.caption))
        item = item_of(chart) if self._interactive else None
        if item is None:
            return self._figure(still, chart.caption)
        target = f"plot-{len(self.items) + 1}"
        self.items.append({**_renumbered(item, f"{target}-"), "target_id": target})
        label, title = escape(chart.alt, quote=True), escape(chart.title).replace("\n", "<br>")
        title = f'<p class="title">{title}</p>' if title else ""
        return self._figure(
            f'<div class="still">{still}</div><div class="plot">{title}{keys}'
            f'<div id="{target}" role="img" aria-label="{label}"></div></div>',
            chart.caption,
        )


def _keys(legend: Iterable[tuple[str, str, str]]) -> str:
    """A legend, each name once; a name hides what it names."""
    names = {value: name for name, value in LIGHT.items()}
    keys = "".join(
        f'<button type="button" class="key {kind}" data-name="{escape(name, quote=True)}"'
        f' style="--key: {f"var(--{names[colour]})" if colour in names else colour}">'
        f"{escape(name)}</button>"
        for name, colour, kind in dict.fromkeys(legend)
    )
    return f'<div class="keys">{keys}</div>' if keys else ""


def _variables(colours: Mapping[str, str]) -> str:
    return " ".join(f"--{name}: {value};" for name, value in colours.items())


def _as_script(item: Mapping[str, Any]) -> str:
    """JSON that ends no script element, whatever text is in it."""
    text = json.dumps(item, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def _bokeh_script() -> str:
    from trainlog.extras import load

    folder = Path(load("bokeh").__file__).parent
    return (folder / "server" / "static" / "js" / "bokeh.min.js").read_text(encoding="utf-8")


_ID = re.compile(r"p\d+|[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
"""Identifiers of models, by Bokeh's counter in this process, and of documents and subplots."""


def _renumbered(item: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """The same with identifiers that count from one, in their order: the same for the same item."""
    known: dict[str, str] = {}
    numbers = count(1)

    def new(word: str) -> str:
        if word not in known:
            known[word] = f"{prefix}{next(numbers)}"
        return known[word]

    def walk(value: Any) -> Any:
        if isinstance(value, dict):
            return {
                key: new(each)
                if key in ("id", "root_id") and isinstance(each, str) and _ID.fullmatch(each)
                else walk(each)
                for key, each in value.items()
            }
        if isinstance(value, list | tuple):
            return [walk(each) for each in value]
        if isinstance(value, float) and not math.isfinite(value):
            sign = "-" if value < 0.0 else "+"
            return {"type": "number", "value": "nan" if math.isnan(value) else f"{sign}inf"}
        return value

    renumbered: dict[str, Any] = walk(dict(item))
    return renumbered
