"""A page: sections of words, tables, charts and results as one HTML file that needs no network.

Whatever comes from logs and files (names of trips, of stations, of files) is text and is escaped;
a Content-Security-Policy lets only the scripts run that this module writes, by their digest, and
forbids every request.
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
from itertools import count, groupby
from pathlib import Path
from typing import Any

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    PAPER,
    PURPLE,
    RED,
    SKY,
    Chart,
    draw_charts,
    legend_of,
    rows_of,
)
from analysis.reports.charts import item_of
from trainlog import __version__
from trainlog.display import as_text
from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.presentation import Presented, WordTable

LARGEST = 5_000_000
"""Bytes of a page: more is refused, as mail and browsers of a control centre would."""

STILL = "The charts stand still here, so that the page is not too large to be sent."

LIGHT = {
    "paper": PAPER,
    "ink": INK,
    "soft": "#5a5a5a",
    "grey": GREY,
    "pale": PALE,
    "line": "#e2e2e2",
    "shade": "#f3f4f6",
    "link": "#005a92",
    "blue": BLUE,
    "orange": ORANGE,
    "green": GREEN,
    "red": RED,
    "purple": PURPLE,
    "sky": SKY,
}
"""Colours of the page by name, those of the pictures among them."""

DARK = {
    "paper": "#16181c",
    "ink": "#e6e6e6",
    "soft": "#a9adb3",
    "grey": "#8d9197",
    "pale": "#3c4046",
    "line": "#2c2f34",
    "shade": "#202328",
    "link": "#7ab8e6",
    "blue": "#4aa3df",
    "orange": "#f0b840",
    "green": "#2fc59b",
    "red": "#f08a4b",
    "purple": "#b794d4",
    "sky": "#8accf5",
}
"""The same where the reader's screen is dark."""

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
        digests = " ".join(f"'sha256-{_digest(script)}'" for script in scripts)
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


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


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
