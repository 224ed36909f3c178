"""A page: sections of words, tables and pictures as one HTML file that needs no network.

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import count
from pathlib import Path
from typing import Any

from analysis.reports.pictures import DARK, DRAWN, LIGHT, Picture, inline
from trainlog import __version__
from trainlog.display import as_text
from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.presentation import WordTable

LARGEST = 5_000_000
"""Bytes of a page: more is refused, as mail and browsers of a control centre would."""

STILL = "The charts stand still here, so that the page is not too large to be sent."

_STYLE = (Path(__file__).parent / "page.css").read_text(encoding="utf-8")
_SCRIPT = (Path(__file__).parent / "page.js").read_text(encoding="utf-8")


@dataclass(frozen=True)
class Interactive:
    """A picture that answers the pointer; where no script runs, and in print, its picture stands.

    Attributes
    ----------
    picture : Picture
    item : mapping or None
        What BokehJS draws (``bokeh.embed.json_item``); None where Bokeh is not installed.
    title : str
    legend : tuple of (str, str, str)
        Names, colours and kinds of what is drawn.
    """

    picture: Picture
    item: Mapping[str, Any] | None
    title: str = ""
    legend: tuple[tuple[str, str, str], ...] = ()


@dataclass(frozen=True)
class Beside:
    """Charts beside each other as long as the screen has space, else below each other."""

    parts: tuple[Interactive, ...]


@dataclass(frozen=True)
class Commands:
    """Commands as they are typed."""

    lines: tuple[str, ...]


@dataclass(frozen=True)
class Warned:
    """A sentence that a reader must not overlook."""

    words: str


Part = Any
"""A str, WordTable, Picture, Interactive, Beside, Commands, Warned or Section."""


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
        writer = _Writer(interactive)
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

    def __init__(self, interactive: bool) -> None:
        self._interactive_too = interactive
        self.items = list[dict[str, Any]]()
        self._pictures = self._sections = 0

    def section(self, section: Section, level: int) -> str:
        anchor = ""
        if level == 2:
            self._sections += 1
            anchor = f' id="{_anchor(self._sections)}"'
        kind = ' class="new-page"' if section.whole_page else ""
        body = "".join(self.part(each, level) for each in section.parts)
        heading = f"<h{level}>{escape(section.title)}</h{level}>"
        if section.folded:
            # The place to which the contents lead is inside: going there opens it.
            inner = f'<div{anchor} class="inner">\n{body}</div>'
            body = f"<details>\n<summary>{heading}</summary>\n{inner}</details>"
            return f"<section{kind}>{body}</section>\n"
        return f"<section{anchor}{kind}>\n{heading}\n{body}</section>\n"

    def part(self, part: Part, level: int) -> str:
        if isinstance(part, Section):
            return self.section(part, min(level + 1, 6))
        if isinstance(part, WordTable):
            return part.html()
        if isinstance(part, Interactive):
            return self._interactive(part)
        if isinstance(part, Beside):
            legend = dict.fromkeys(key for each in part.parts for key in each.legend)
            parts = (replace(each, legend=()) for each in part.parts)
            row = "".join(map(self._interactive, parts))
            return f'<div class="row">{_keys(tuple(legend))}<div class="beside">{row}</div></div>\n'
        if isinstance(part, Picture):
            return self._figure(self._drawn(part), part.caption)
        if isinstance(part, Commands):
            return f"<pre><code>{escape(chr(10).join(part.lines))}</code></pre>\n"
        if isinstance(part, Warned):
            return f'<p class="warning" role="note">{escape(part.words)}</p>\n'
        return f"<p>{escape(str(part))}</p>\n"

    def _drawn(self, picture: Picture) -> str:
        self._pictures += 1
        return inline(picture, f"p{self._pictures}-")

    @staticmethod
    def _figure(drawn: str, caption: str) -> str:
        words = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
        return f"<figure>{drawn}{words}</figure>\n"

    def _interactive(self, part: Interactive) -> str:
        still = self._drawn(part.picture)
        if part.item is None or not self._interactive_too:
            return self._figure(still, part.picture.caption)
        target = f"plot-{len(self.items) + 1}"
        item = _renumbered(part.item, f"{target}-")
        self.items.append({**item, "target_id": target})
        label = escape(part.picture.alt, quote=True)
        return self._figure(
            f'<div class="still">{still}</div>'
            f'<div class="plot">{_heading(part)}'
            f'<div id="{target}" role="img" aria-label="{label}"></div></div>',
            part.picture.caption,
        )


def _heading(part: Interactive) -> str:
    """Title and legend of a chart; a name in the legend hides what it names."""
    return (
        f'<p class="title">{escape(part.title).replace(chr(10), "<br>")}</p>' if part.title else ""
    ) + _keys(part.legend)


def _keys(legend: Sequence[tuple[str, str, str]]) -> str:
    names = {value: name for name, value in LIGHT.items()}
    keys = "".join(
        f'<button type="button" class="key {kind}" data-name="{escape(name, quote=True)}"'
        f' style="--key: {f"var(--{names[colour]})" if colour in names else colour}">'
        f"{escape(name)}</button>"
        for name, colour, kind in legend
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
