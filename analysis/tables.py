"""A table whose names and words stay whole for as long as the page is wide enough."""

from __future__ import annotations

import math
import re
from io import StringIO
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table

from trainlog.units import JOULES_PER_KWH, KMH

PAGE = 110
"""Columns of a table in a notebook."""

_PADDING = 3
"""Of each column: a space on both sides, and what divides it from the next."""


class WordTable(Table):
    """A table that narrows its columns where that costs least.

    Headings are broken between their words first, then the rows but for the names in the first
    column, then those; inside words only where the page is narrower than the longest. Rich narrows
    the widest columns until all are alike, and so folds names inside words.

    Attributes
    ----------
    name : str
        In JSON.
    data : list of dict, optional
        Its rows as data, where its cells are more than words.
    """

    name: str = ""
    data: list[dict[str, Any]] | None = None

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Give every column the least it needs, and a like part of what else it asks for."""
        wide = options.update(max_width=10_000)
        headings = [Measurement.get(console, wide, each.header) for each in self.columns]
        rows = [
            [Measurement.get(console, wide, cell) for cell in each.cells] for each in self.columns
        ]
        words = [
            max(each.minimum for each in (heading, *cells))
            for heading, cells in zip(headings, rows, strict=True)
        ]
        whole = [
            max(word, *(each.maximum for each in cells), 0)
            for word, cells in zip(words, rows, strict=True)
        ]
        wishes = [max(each.maximum, row) for each, row in zip(headings, whole, strict=True)]
        width = options.max_width - _PADDING * len(words) - 1
        leasts = (whole, [*whole[:1], *words[1:]], words)
        least = next((each for each in leasts if sum(each) <= width), None)
        more = 0 if least is None else sum(wishes) - sum(least)
        for number, column in enumerate(self.columns):
            column.width = None
            if least is not None and sum(wishes) > width:
                part = (width - sum(least)) * (wishes[number] - least[number]) // more
                column.width = least[number] + part
        yield from super().__rich_console__(console, options)


def new_table(title: str, *columns: str, **options: Any) -> Table:
    """An empty table in the common form."""
    table = WordTable(
        title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, **options
    )
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def name_of(table: Table) -> str:
    """The name of a table in JSON: the one it was given, or its title's first words."""
    given = getattr(table, "name", "")
    return given or _key(str(table.title or "rows").split(" of ")[0])


def records(table: Table) -> list[dict[str, Any]]:
    """The rows of a table as data, by the keys of its columns."""
    if isinstance(table, WordTable) and table.data is not None:
        return table.data
    keys = [_key(str(column.header)) or f"column_{n}" for n, column in enumerate(table.columns, 1)]
    cells = [[_words(cell) for cell in column.cells] for column in table.columns]
    return [dict(zip(keys, row, strict=True)) for row in zip(*cells, strict=True)]


def _words(cell: RenderableType) -> str:
    return " ".join(str(cell).split())


def _key(heading: str) -> str:
    """A heading as a key: ``"rail condition"`` is ``rail_condition``."""
    return re.sub(r"\W+", "_", heading.strip().lower()).strip("_")


def with_band(value: float, std: float, unit: str = "") -> str:
    """A value with its 95 % band, to the digits that the band leaves meaningful."""
    reach = 1.96 * std
    digits = max(0, 1 - math.floor(math.log10(reach))) if reach > 0.0 else 1
    return f"{value:.{digits}f} ± {reach:.{digits}f}{unit}"


def kwh(energy: float) -> str:
    """An energy [J] in kilowatt hours."""
    return f"{energy / JOULES_PER_KWH:.2f} kWh"


def overspeed(speed: float) -> str:
    """A speed over the limit [m/s] in words; what a person does not see is none."""
    return f"{KMH * speed:.1f} km/h" if KMH * speed >= 0.05 else "none"


def as_page(*parts: RenderableType) -> str:
    """Tables and words as HTML, as a notebook shows them."""
    console = Console(record=True, file=StringIO(), width=PAGE, markup=False, highlight=False)
    console.print(*parts, sep="\n")
    return console.export_html(
        inline_styles=True, code_format="<pre style='line-height:1.2'>{code}</pre>"
    )
