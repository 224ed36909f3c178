"""A table whose names and words stay whole for as long as the page is wide enough."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from io import StringIO
from typing import Any, TypeAlias

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table

from trainlog.display import SPEED_UNITS, in_speed_unit, in_zone
from trainlog.units import JOULES_PER_KWH, KMH

PAGE = 110
"""Columns of a table in a notebook."""

_PADDING = 3
"""Of each column: a space on both sides, and what divides it from the next."""

_SHORTEST = 7
"""Names are not cut to fewer letters."""


@dataclass(frozen=True)
class Quantity:
    """A kind of number: its SI unit, and how people read it.

    Attributes
    ----------
    suffix : str
        The SI unit as keys of JSON end: ``"m_s"`` for m/s; empty for a pure number.
    unit : str
        In which it is shown.
    factor : float
        Of the number shown to the one in SI units.
    digits : int
        Shown after the point.
    """

    suffix: str
    unit: str
    factor: float = 1.0
    digits: int = 1

    def words(self, value: float, *, unit: bool = True) -> str:
        """A value as it is shown.

        Examples
        --------
        >>> SPEED.words(20.0), SHARE.words(0.123), MASS.words(80e3, unit=False)
        ('72.0 km/h', '12.3 %', '80.0')
        """
        number = f"{value * self.factor:,.{self.digits}f}"
        return f"{number} {self.unit}" if unit and self.unit else number


SPEED = Quantity("m_s", "km/h", KMH)
POSITION = Quantity("m", "km", 1e-3, 3)
DURATION = Quantity("s", "s")
MASS = Quantity("kg", "t", 1e-3)
FORCE = Quantity("N", "kN", 1e-3, 2)
POWER = Quantity("W", "kW", 1e-3, 0)
ENERGY = Quantity("J", "kWh", 1.0 / JOULES_PER_KWH, 2)
SHARE = Quantity("", "%", 100.0)
NUMBER = Quantity("", "", 1.0, 0)


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading, its key in JSON, and what its numbers are.

    The unit stands in the heading, or with each number (`each`) where the heading names none. Where
    numbers have bands (`band`), each row has their standard deviation, null where there is none.
    """

    heading: str
    quantity: Quantity | None = None
    key: str = ""
    each: bool = False
    band: bool = False

    @property
    def title(self) -> str:
        """The heading with its unit."""
        named = self.quantity is not None and self.quantity.unit and not self.each
        return f"{self.heading}, {self.quantity.unit}" if named and self.quantity else self.heading

    def in_speed_unit(self, unit: str) -> Column:
        """The column in the unit that is chosen for speeds, if they are."""
        if self.quantity is None or self.quantity.unit != SPEED.unit:
            return self
        digits = self.quantity.digits + (unit == "m/s")
        factor = KMH * SPEED_UNITS[unit]
        return replace(
            self, quantity=replace(self.quantity, unit=unit, factor=factor, digits=digits)
        )

    def words(self, cell: Cell) -> str:
        """A cell as it is shown."""
        if cell is None:
            return "-"
        if isinstance(cell, Said):
            return cell.words
        if isinstance(cell, str) or self.quantity is None:
            return str(cell)
        unit = f" {self.quantity.unit}" if self.each and self.quantity.unit else ""
        if isinstance(cell, Band):
            if not math.isfinite(cell.value):
                return "-"
            factor = self.quantity.factor
            return with_band(cell.value * factor, cell.std * factor, unit)
        return self.quantity.words(cell, unit=self.each) if math.isfinite(cell) else "-"

    def data(self, cell: Cell) -> dict[str, Any]:
        """A cell as JSON has it: numbers in SI units, which end the keys."""
        key = self.key or _key(self.heading)
        suffix = f"_{self.quantity.suffix}" if self.quantity and self.quantity.suffix else ""
        value = cell.value if isinstance(cell, Said | Band) else cell
        found = {f"{key}{suffix}": value}
        if self.band:
            found[f"{key}_std{suffix}"] = cell.std if isinstance(cell, Band) else None
        return found


@dataclass(frozen=True)
class Band:
    """A number with its standard deviation, both in SI units; shown with the 95 % band."""

    value: float
    std: float


@dataclass(frozen=True)
class Said:
    """A number in SI units that is shown in words of its own."""

    value: Any
    words: str


Cell: TypeAlias = "str | float | Band | Said | None"
"""Of a table: words, or a number in SI units."""


class WordTable(Table):
    """A table that narrows its columns where that costs least.

    Headings are broken between their words first, then the rows but for the names in the first
    column, then those; inside words only where the page is narrower than the longest. Rich narrows
    the widest columns until all are alike, and so folds names inside words.

    Attributes
    ----------
    name : str
        In JSON.
    forms : tuple of Column
        What its numbers are; empty for a table of words.
    """

    name: str = ""
    forms: tuple[Column, ...] = ()
    _rows: list[tuple[Cell, ...]]

    def add_cells(self, *cells: Cell) -> None:
        """Add a row of numbers in SI units and of words, a cell a column."""
        self._rows.append(cells)
        self.add_row(*(form.words(cell) for form, cell in zip(self.forms, cells, strict=True)))

    @property
    def data(self) -> list[dict[str, Any]] | None:
        """The rows as data, where the cells are more than words; else None."""
        if not self.forms:
            return None
        return [
            {
                key: value
                for form, cell in zip(self.forms, row, strict=True)
                for key, value in form.data(cell).items()
            }
            for row in self._rows
        ]

    def _shown_as(self, unit: str, zone: str) -> WordTable:
        """The table with speeds and times as the console's user has set; the rest as it is."""

        def words(cell: object) -> str:
            return in_zone(in_speed_unit(str(cell), unit), zone)

        forms = [each.in_speed_unit(unit) for each in self.forms]
        heads = [each.title for each in forms] or [str(each.header) for each in self.columns]
        shown = new_table(words(self.title or ""), *heads, show_header=self.show_header)
        shown.caption_justify = self.caption_justify
        shown.caption = None if self.caption is None else words(self.caption)
        cells = zip(*(column.cells for column in self.columns), strict=True)
        for number, (row, printed) in enumerate(zip(self.rows, cells, strict=True)):
            if forms:
                given = zip(forms, self._rows[number], strict=True)
                printed = tuple(form.words(cell) for form, cell in given)
            shown.add_row(*map(words, printed), end_section=row.end_section)
        return shown

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Give every column the least it needs, and a like part of what else it asks for."""
        unit, zone = getattr(console, "shown_as", ("km/h", "UTC"))
        shown = self if (unit, zone) == ("km/h", "UTC") else self._shown_as(unit, zone)
        yield from shown._laid_out(console, options)

    def _laid_out(self, console: Console, options: ConsoleOptions) -> RenderResult:
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
        if least is None and (cut := self._cut(words, width)) is not None:
            yield from cut._laid_out(console, options)
            return
        more = 0 if least is None else sum(wishes) - sum(least)
        for number, column in enumerate(self.columns):
            column.width = None
            if least is not None and sum(wishes) > width:
                part = (width - sum(least)) * (wishes[number] - least[number]) // more
                column.width = least[number] + part
        yield from super().__rich_console__(console, options)

    def _cut(self, words: list[int], width: int) -> WordTable | None:
        """The table with the longest names cut in their middles; None where that is not enough.

        Columns of numbers are left whole: a number that is cut is another one.
        """
        named = [n for n, form in enumerate(self.forms) if form.quantity is None]
        least = list(words)
        while sum(least) > width:
            widest = max(named, key=lambda number: least[number], default=None)
            if widest is None or least[widest] <= _SHORTEST:
                return None
            least[widest] -= 1
        heads = [str(each.header) for each in self.columns]
        cut = new_table(str(self.title or ""), *heads, show_header=self.show_header)
        cut.caption, cut.caption_justify = self.caption, self.caption_justify
        columns = [
            [_shortened(str(cell), least[number] if number in named else None)
             for cell in column.cells]
            for number, column in enumerate(self.columns)
        ]  # fmt: skip
        for row, cells in zip(self.rows, zip(*columns, strict=True), strict=True):
            cut.add_row(*cells, end_section=row.end_section)
        return cut


def _shortened(cell: str, most: int | None) -> str:
    """A cell whose words have so many letters at most; the middles of others are left out."""
    if most is None:
        return cell
    end = (most - 1) // 2
    return " ".join(
        word if len(word) <= most else f"{word[: most - 1 - end]}…{word[-end:]}"
        for word in cell.split(" ")
    )


def new_table(title: str, *columns: str | Column, name: str = "", **options: Any) -> WordTable:
    """An empty table in the common form.

    Parameters
    ----------
    title : str
    *columns : str or Column
        Headings, of a table of words; or columns that state what their numbers are, whose rows are
        added with `WordTable.add_cells`, and which is data, too.
    name : str
        In JSON; default: the first words of the title.
    **options
        Of `rich.table.Table`.

    Examples
    --------
    >>> table = new_table("Trips", Column("trip"), Column("top speed", SPEED), name="trips")
    >>> table.add_cells("a", 20.0)
    >>> records(table)
    [{'trip': 'a', 'top_speed_m_s': 20.0}]
    """
    table = WordTable(
        title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, **options
    )
    table.name, table._rows = name, []
    if any(isinstance(each, Column) for each in columns):
        table.forms = tuple(Column(each) if isinstance(each, str) else each for each in columns)
    for each in columns:
        table.add_column(each if isinstance(each, str) else each.title, overflow="fold")
    return table


def name_of(table: Table) -> str:
    """The name of a table in JSON: given, or of its title's first words, or its first heading."""
    title = str(table.title or "").split(" of ")[0]
    heading = str(table.columns[0].header) if table.columns else ""
    return getattr(table, "name", "") or _key(title) or _key(heading) or "rows"


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
    """An energy [J] in kilowatt hours; a dash for one that is not known."""
    return "-" if energy != energy else f"{energy / JOULES_PER_KWH:.2f} kWh"


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
