"""Pictures of a page: what the commands draw, as SVG in the colours of the page, or as PNG."""

from __future__ import annotations

import base64
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from pathlib import Path

from analysis.charts import BLUE, GREEN, GREY, INK, ORANGE, PALE, PURPLE, RED, SKY

PAPER = "#ffffff"

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
