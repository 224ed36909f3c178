"""What a result shows, declared once: its title, its summary, its tables and its sentences.

A class that derives from `Presented` states these, and its ``repr``, its form in a notebook, its
tables in a terminal and in a report, its JSON object with a schema and its CSV follow.

A `Column` states what the numbers of a table are, and where a row has them: they are kept in SI
units and shown in those that people read.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, TypeVar

import numpy as np

from trainlog.arrays import same_values
from trainlog.display import SPEED_UNITS, as_text, cell_of, in_speed_unit, in_zone
from trainlog.errors import InputError
from trainlog.units import JOULES_PER_KWH, KMH

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure
    from rich.console import Console, ConsoleOptions, RenderResult

Row = TypeVar("Row")

MOST_ROWS = 60
"""Of a table in a notebook."""

PADDING, CLOSE = 3, 2
"""Letters that each column of a table in a terminal takes beside its cells, and where that breaks
short cells."""

LONGEST_WORD = 32
"""Letters of a word that is never broken: longer ones are checksums and paths."""

SHORT = 12
"""Letters of a cell, as ``7 / 16``, that is broken only where nothing else can be."""

SHORT_NAME = 14
"""Letters of a row's heading that stand on one line."""

LONG_CELL = 30
"""Letters of a cell that is as wide as a few words, however narrow the screen."""

_NUMBER = re.compile(r"[-+−±]?\d[\d.,\s]*(\s?[^\s\d]{1,8}(\s±.*)?)?")
"""A cell that is read as a number, with its unit."""

LONG_NAME, SHORTEST_NAME = 24, 7
"""Letters to which long names are cut in a narrow terminal: before columns are left out, and where
leaving them out is not enough."""


# ---------------------------------------------------------------------------------- quantities


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

    @property
    def si_unit(self) -> str:
        """The SI unit as frames state it; the last part of the suffix is the denominator.

        Examples
        --------
        >>> [Quantity(suffix, "").si_unit for suffix in ("N", "m_s", "m_s2", "N_s2_m2")]
        ['N', 'm/s', 'm/s^2', 'N*s^2/m^2']
        """
        *above, last = re.sub(r"(\d)", r"^\1", self.suffix).split("_")
        return f"{'*'.join(above)}/{last}" if above else last

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
HOURS = Quantity("s", "h", 1.0 / 3600.0, 1)
MASS = Quantity("kg", "t", 1e-3)
FORCE = Quantity("N", "kN", 1e-3, 2)
POWER = Quantity("W", "kW", 1e-3, 0)
ENERGY = Quantity("J", "kWh", 1.0 / JOULES_PER_KWH, 2)
SHARE = Quantity("", "%", 100.0)
SECOND_WORTH = Quantity("W", "Wh", 1.0 / 3.6e3)
"""Energy for a second of running time."""
NUMBER = Quantity("", "", 1.0, 0)
KILOMETRE = Quantity("km", "", 1.0, 3)
ADHESION = Quantity("", "", 1.0, 3)
PLAIN = Quantity("", "")


@dataclass(frozen=True)
class Band:
    """A number with its standard deviation, both in SI units; shown with the 95 % band."""

    value: float
    std: float


@dataclass(frozen=True)
class Ends:
    """A number with the ends of its 95 % band, all in SI units; NaN where there is no band."""

    value: float
    low: float = math.nan
    high: float = math.nan


@dataclass(frozen=True)
class Said:
    """A number in SI units that is shown in words of its own."""

    value: Any
    words: str


Columns: TypeAlias = dict[str, Callable[[Row], object]]
"""Of a table of words: what the cell of a row says, by heading."""

Cell: TypeAlias = "str | float | Band | Ends | Said | None"
"""Of a table: words, or a number in SI units."""


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading, its key in JSON, and what its numbers are.

    The unit stands in the heading, or with each number (`each`) where the heading names none. Where
    numbers have bands (`band`), each row has their standard deviation, null where there is none.

    Attributes
    ----------
    heading : str
    quantity : Quantity, optional
    key : str
        Default: the heading in small letters.
    each, band : bool
    of : callable or str, optional
        The cell of a row (`WordTable.add_rows`): what it returns of the row, or the row's attribute
        or entry of that name. Default: `key`.
    rank : int
        In a narrow terminal columns of a higher rank are left out first, of one rank the last.
    """

    heading: str
    quantity: Quantity | None = None
    key: str = ""
    each: bool = False
    band: bool = False
    of: Callable[[Any], Cell] | str | None = None
    rank: int = 0

    @property
    def name(self) -> str:
        """Key without the unit."""
        return self.key or as_key(self.heading)

    @property
    def title(self) -> str:
        """The heading with its unit."""
        named = self.quantity is not None and self.quantity.unit and not self.each
        return f"{self.heading}, {self.quantity.unit}" if named and self.quantity else self.heading

    def cell(self, row: Any) -> Cell:
        """The cell of a row."""
        if callable(self.of):
            return self.of(row)
        name = self.of or self.name
        found: Cell = row[name] if isinstance(row, Mapping) else getattr(row, name)
        return found

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
        """A cell as it is shown.

        Examples
        --------
        >>> Column("adhesion", ADHESION).words(Ends(0.15, 0.1, 0.2))
        '0.150 (0.100 to 0.200)'
        """
        if cell is None:
            return "-"
        if isinstance(cell, Said):
            return cell.words
        if isinstance(cell, str) or self.quantity is None:
            return str(cell)
        unit = f" {self.quantity.unit}" if self.each and self.quantity.unit else ""
        if isinstance(cell, Band | Ends) and not math.isfinite(cell.value):
            return "-"
        if isinstance(cell, Band):
            factor = self.quantity.factor
            return with_band(cell.value * factor, cell.std * factor, unit)
        if isinstance(cell, Ends):
            value, low, high = (
                self.quantity.words(each, unit=False) for each in (cell.value, cell.low, cell.high)
            )
            return f"{value}{unit}" if math.isnan(cell.low) else f"{value} ({low} to {high}){unit}"
        return self.quantity.words(cell, unit=self.each) if math.isfinite(cell) else "-"

    def data(self, cell: Cell) -> dict[str, Any]:
        """A cell as JSON has it: numbers in SI units, which end the keys."""
        suffix = f"_{self.quantity.suffix}" if self.quantity and self.quantity.suffix else ""
        value = cell.value if isinstance(cell, Said | Band | Ends) else cell
        found = {f"{self.name}{suffix}": value}
        if self.band:
            found[f"{self.name}_std{suffix}"] = cell.std if isinstance(cell, Band) else None
        if isinstance(cell, Ends):
            found |= {f"{self.name}_low{suffix}": cell.low, f"{self.name}_high{suffix}": cell.high}
        return found


def as_key(heading: str) -> str:
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


# -------------------------------------------------------------------------------------- tables


@dataclass(eq=False, repr=False)
class WordTable:
    """A table: what its columns are, and a row of cells each.

    In a terminal that is too narrow for the words of all columns the least important columns are
    left out, and named under the table.

    Attributes
    ----------
    title : str
    forms : tuple of Column
    name : str
        In JSON; default: the first words of the title, or the first heading.
    plain : bool
        Whether its cells are words alone; else they are numbers in SI units, too.
    show_header : bool
    caption : str, optional
        Stands under the table.
    frame : DataFrame, optional
        What the rows are taken from: JSON and CSV have all of its columns.
    usual : bool
        Whether it is shown without being asked for.
    rows : list of tuple of Cell
    ends : set of int
        Rows behind which a part of the table ends.
    """

    title: str
    forms: tuple[Column, ...]
    name: str = ""
    plain: bool = False
    show_header: bool = True
    caption: str | None = None
    frame: pd.DataFrame | None = None
    usual: bool = True
    rows: list[tuple[Cell, ...]] = field(default_factory=list)
    ends: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        title = self.title.split(" of ")[0]
        first = as_key(self.forms[0].heading) if self.forms else ""
        self.name = self.name or as_key(title) or first or "rows"

    def __repr__(self) -> str:
        return f"Table {self.title!r}: {len(self.rows)} rows of {', '.join(self.heads)}"

    def add_cells(self, *cells: Cell) -> None:
        """Add a row of numbers in SI units and of words, a cell a column."""
        if len(cells) != len(self.forms):
            raise ValueError(f"{len(cells)} cells in a row of {len(self.forms)} columns")
        self.rows.append(cells)

    def add_row(self, *cells: Cell) -> None:
        """Add a row whose last cells may be left out."""
        self.add_cells(*cells, *[""] * (len(self.forms) - len(cells)))

    def add_rows(self, rows: Iterable[Any], most: int | None = None) -> WordTable:
        """Add a row for each of some things: its cells are as the columns state (`Column.of`).

        Of more than `most` the others are counted under the table.
        """
        every = list(rows)
        for row in every[:most]:
            self.add_cells(*(form.cell(row) for form in self.forms))
        if most is not None and len(every) > most:
            self.caption = f"{len(every) - most:,} more"
        return self

    def add_section(self) -> None:
        """End a part of the table behind the last row."""
        self.ends.add(len(self.rows) - 1)

    @property
    def heads(self) -> list[str]:
        """The headings, with units."""
        return [form.title for form in self.forms]

    @property
    def words(self) -> list[list[str]]:
        """The rows as they are shown."""
        return [
            [form.words(cell) for form, cell in zip(self.forms, row, strict=True)]
            for row in self.rows
        ]

    @property
    def data(self) -> list[dict[str, Any]]:
        """The rows as JSON has them, by the keys of the columns."""
        if self.frame is not None:
            return plain_rows(self.frame)
        if self.plain:
            keys = [form.name or f"column_{n}" for n, form in enumerate(self.forms, 1)]
            return [
                {key: " ".join(cell.split()) for key, cell in zip(keys, row, strict=True)}
                for row in self.words
            ]
        return [
            {
                key: value
                for form, cell in zip(self.forms, row, strict=True)
                for key, value in form.data(cell).items()
            }
            for row in self.rows
        ]

    def shown_as(self, unit: str, zone: str) -> WordTable:
        """The table in words, with speeds in another unit and times in another zone."""

        def words(cell: str) -> str:
            return in_zone(in_speed_unit(cell, unit), zone)

        forms = [each.in_speed_unit(unit) for each in self.forms]
        shown = replace(self, forms=tuple(forms))
        heads = tuple(replace(each, heading=words(each.title), each=True) for each in forms)
        rows: list[tuple[Cell, ...]] = [
            tuple(Said(None, words(cell)) for cell in row) for row in shown.words
        ]
        caption = words(self.caption or "")
        return replace(self, title=words(self.title), forms=heads, rows=rows, caption=caption)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The table as wide as its words ask for, or as the page allows."""
        unit, zone = getattr(console, "shown_as", ("km/h", "UTC"))
        shown = self if (unit, zone) == ("km/h", "UTC") else self.shown_as(unit, zone)
        yield from shown._laid_out(console, options.max_width)

    def _laid_out(self, console: Console, width: int) -> RenderResult:
        """Give every column the least it needs, and a like part of what else it asks for.

        Headings are broken between their words first, then long cells but for the names in the
        first column, then those, then short cells, which are mostly numbers. Where that is not
        enough long names are cut in their middles, and columns are left out; inside words only a
        page is broken that is narrower than a name.
        """
        from rich.box import SIMPLE_HEAD
        from rich.table import Table
        from rich.text import Text

        heads, rows = self.heads, self.words
        kept = list(range(len(heads)))
        least = [self._longest([heads[n], *(row[n] for row in rows)]) for n in kept]

        def over() -> int:
            return sum(least[n] for n in kept) + PADDING * len(kept) + 1 - width

        self._cut(least, kept, over, LONG_NAME)
        order = sorted(kept[1:], key=lambda n: (self.forms[n].rank, n))
        while over() > 0 and order:
            kept.remove(order.pop())
        self._cut(least, kept, over, SHORTEST_NAME)
        if not self.plain:
            rows = [[_shortened(cell, least[n]) for n, cell in enumerate(row)] for row in rows]
        widths, close = self._widths(
            [heads[n] for n in kept], [[row[n] for n in kept] for row in rows], width
        )
        table = Table(
            box=SIMPLE_HEAD, show_header=self.show_header, padding=(0, 1, 0, int(not close))
        )

        def literal(words: str, style: str = "") -> Text:
            """Words of files, in which brackets and colons mean themselves."""
            return console.render_str(words, style=style, markup=False, emoji=False)

        for n, each in zip(kept, widths, strict=True):
            table.add_column(literal(heads[n]), overflow="fold", width=each)
        for number, row in enumerate(rows):
            table.add_row(*(literal(row[n]) for n in kept), end_section=number in self.ends)
        if self.title:
            yield literal(self.title, "bold")
        yield table
        if self.caption:
            yield literal(self.caption)
        if len(kept) < len(heads):
            left = [heads[n].replace("\n", " ") or "unnamed" for n in range(len(heads))]
            names = ", ".join(left[n] for n in range(len(heads)) if n not in kept)
            yield Text(f"  not shown in {width} columns: {names}", style="dim")

    def _cut(
        self, least: list[int], kept: list[int], over: Callable[[], int], shortest: int
    ) -> None:
        """Take letters of the longest names while the table is too wide.

        Columns of numbers are left whole: a number that is cut is another one.
        """
        if self.plain:
            return
        named = [n for n in kept if self.forms[n].quantity is None]
        while over() > 0:
            widest = max(named, key=lambda n: least[n], default=None)
            if widest is None or least[widest] <= shortest:
                return
            least[widest] -= 1

    def _longest(self, texts: Sequence[str]) -> int:
        """Letters of the longest word; of a table of words one that is as long is broken."""
        from rich.cells import cell_len

        longest = max((cell_len(word) for text in texts for word in text.split()), default=0)
        return min(longest, LONGEST_WORD) if self.plain else longest

    def _widths(
        self, heads: list[str], rows: list[list[str]], width: int
    ) -> tuple[list[int | None], bool]:
        """Of each column, None where all that it asks for is there; whether they stand closer."""
        columns = [[row[n] for row in rows] for n in range(len(heads))]
        words = [self._longest([head, *cells]) for head, cells in zip(heads, columns, strict=True)]
        whole = [
            max([word, *map(_longest_line, cells)])
            for word, cells in zip(words, columns, strict=True)
        ]
        wishes = [max(_longest_line(head), row) for head, row in zip(heads, whole, strict=True)]
        lines = [[len(line) for cell in cells for line in cell.split("\n")] for cells in columns]
        short = [
            max([word, *(length for length in each if length <= SHORT)])
            for word, each in zip(words, lines, strict=True)
        ]
        space = width - PADDING * len(heads) - 1
        if sum(wishes) <= space:
            return [None] * len(heads), False
        leasts = [whole, [*whole[:1], *short[1:]], short]
        least = next((each for each in leasts if sum(each) <= space), None)
        if close := least is None:
            space = width - CLOSE * len(heads) - 1
            leasts = [*leasts[1:], [*whole[:1], *words[1:]], words]
            least = next((each for each in leasts if sum(each) <= space), None)
        if least is None:
            return [None] * len(heads), close
        # Of short cells those that would be broken most are whole first.
        for n in sorted(range(len(heads)), key=lambda n: words[n] - short[n]):
            if short[n] - least[n] <= space - sum(least):
                least = [*least[:n], max(short[n], least[n]), *least[n + 1 :]]
        more, spare = sum(wishes) - sum(least), space - sum(least)
        return [
            given + spare * (wish - given) // max(more, 1)
            for given, wish in zip(least, wishes, strict=True)
        ], close

    def _repr_html_(self) -> str:
        """The table as HTML, as a notebook shows it."""
        more = len(self.rows) - MOST_ROWS
        return self.html(MOST_ROWS, " style='text-align:left'") + (
            f"<p>and {more:,} more rows</p>" if more > 0 else ""
        )

    def html(self, most: int | None = None, style: str = "") -> str:
        """The table as HTML, its first column as headings of the rows.

        Parameters
        ----------
        most : int, optional
            Rows that are shown; default: all.
        style : str
            Attribute of each cell.
        """
        title = f"<caption{style}>{escape(self.title)}</caption>" if self.title else ""
        heads = (
            f'<th scope="col"{style}>{escape(" ".join(each.split()))}</th>' for each in self.heads
        )
        head = f"<thead><tr>{''.join(heads)}</tr></thead>" if self.show_header else ""
        rows = []
        for number, (first, *others) in enumerate(self.words[:most]):
            kind = ' class="end"' if number in self.ends else ""
            # A short name, of a train for one, is not broken at its hyphen.
            name = ' class="name"' if "-" in first and len(first) <= SHORT_NAME else ""
            cells = "".join(f"<td{_kind(cell)}{style}>{_cell(cell)}</td>" for cell in others)
            row = f'<th scope="row"{name}{style}>{_cell(first)}</th>{cells}'
            rows.append(f"<tr{kind}>{row}</tr>")
        below = f'<p class="below">{escape(self.caption)}</p>' if self.caption else ""
        return (
            f'<div class="table"><table>{title}{head}<tbody>{"".join(rows)}</tbody></table></div>'
            f"{below}\n"
        )

    def schema(self) -> dict[str, Any]:
        """JSON Schema of the rows."""
        rows = self.data
        if not rows and not self.plain and self.frame is None:
            rows = [{key: None for form in self.forms for key in form.data(None)}]
        keys = list(dict.fromkeys(key for row in rows for key in row))
        held = {key: [row[key] for row in rows if key in row] for key in keys}
        properties = {
            key: _schema_of(next((one for one in values if one is not None), None))
            for key, values in held.items()
        }
        return {"type": "array", "items": {"type": "object", "properties": properties}}

    def to_csv(self) -> str:
        """The rows as CSV: numbers in SI units, which end the names of the columns."""
        rows = self.data
        names = list(dict.fromkeys(key for row in rows for key in row))
        text = StringIO()
        writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: cell_of(value) for key, value in row.items()} for row in rows)
        return text.getvalue()

    def to_frame(self) -> pd.DataFrame:
        """The rows as a frame, with the SI units of its columns in ``attrs["units"]``."""
        import pandas as pd

        if self.frame is not None and "units" in self.frame.attrs:
            return self.frame
        found = pd.DataFrame(self.data)
        found.attrs["units"] = {
            key: form.quantity.si_unit
            for form in self.forms
            if form.quantity is not None and form.quantity.suffix
            for key in form.data(None)
        }
        return found


def _kind(cell: str) -> str:
    if _NUMBER.fullmatch(cell.strip()):
        return ' class="number"'
    return ' class="words"' if len(cell) > LONG_CELL else ""


def _cell(cell: str) -> str:
    return escape(cell).replace("\n", "<br>")


def _longest_line(text: str) -> int:
    from rich.cells import cell_len

    return max(map(cell_len, text.split("\n")), default=0)


def _shortened(cell: str, most: int) -> str:
    """A cell whose words have so many letters at most; the middles of others are left out."""
    end = (most - 1) // 2
    return re.sub(
        rf"\S{{{most + 1},}}", lambda found: f"{found[0][: most - 1 - end]}…{found[0][-end:]}", cell
    )


def new_table(
    title: str,
    *columns: str | Column,
    name: str = "",
    show_header: bool = True,
    caption: str | None = None,
    frame: pd.DataFrame | None = None,
    usual: bool = True,
) -> WordTable:
    """An empty table.

    Parameters
    ----------
    title : str
    *columns : str or Column
        Headings, of a table of words; or columns that state what their numbers are, and which is
        data, too.
    name : str
        In JSON; default: the first words of the title.
    show_header, caption, frame, usual
        See `WordTable`.

    Examples
    --------
    >>> table = new_table("Trips", Column("trip"), Column("top speed", SPEED), name="trips")
    >>> table.add_cells("a", 20.0)
    >>> table.data
    [{'trip': 'a', 'top_speed_m_s': 20.0}]
    >>> print(table.to_csv())
    trip,top_speed_m_s
    a,20.0
    <BLANKLINE>
    """
    return WordTable(
        title,
        tuple(Column(each) if isinstance(each, str) else each for each in columns),
        name,
        plain=not any(isinstance(each, Column) for each in columns),
        show_header=show_header,
        caption=caption,
        frame=frame,
        usual=usual,
    )


def word_table(
    title: str,
    rows: Iterable[Row],
    columns: Columns[Row],
    *,
    name: str = "",
    most: int | None = None,
) -> WordTable:
    """A table of words: a row for each of some things, and for each heading what its cell says.

    Of more than `most` rows the others are counted under the table.

    Examples
    --------
    >>> speeds = {"trip": lambda each: each[0], "km/h": lambda each: f"{each[1]:.0f}"}
    >>> word_table("Speeds", [("a", 80.0), ("b", 64.2)], speeds).words
    [['a', '80'], ['b', '64']]
    """
    forms = [
        Column(heading, of=lambda row, cell=cell: str(cell(row)))  # type: ignore[misc]
        for heading, cell in columns.items()
    ]
    return replace(new_table(title, *forms, name=name).add_rows(rows, most), plain=True)


def frame_table(name: str, frame: pd.DataFrame) -> WordTable:
    """A frame that is a part of a result as data alone."""
    return new_table("", *(Column(str(each)) for each in frame.columns), name=name, frame=frame)


def facts_table(title: str, rows: Mapping[str, str], name: str = "summary") -> WordTable:
    """A table of a fact a row: its name, and its words."""
    of = {"quantity": lambda row: row[0], "value": lambda row: row[1]}
    return replace(word_table(title, rows.items(), of, name=name), show_header=False)


def plain_rows(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows in JSON's own types; None where nothing is known."""
    columns: dict[str, list[Any]] = {}
    for name, column in rows.items():
        values = column.dt.strftime("%Y-%m-%d") if column.dtype.kind == "M" else column
        known = column.notna().tolist()
        columns[str(name)] = [
            value if there else None
            for value, there in zip(values.tolist(), known, strict=True)
        ]  # fmt: skip
    return [
        dict(zip(columns, each, strict=True)) for each in zip(*columns.values(), strict=True)
    ]  # fmt: skip


def _schema_of(value: Any) -> dict[str, Any]:
    """JSON Schema of a value and others of its kind; null stands for what is not known."""
    if value is None:
        return {}
    if isinstance(value, bool | np.bool_):
        return {"type": ["boolean", "null"]}
    if isinstance(value, int | float | np.number):
        return {"type": ["number", "null"]}
    if isinstance(value, Mapping):
        return {"type": ["object", "null"]}
    if isinstance(value, list | tuple | np.ndarray):
        return {"type": ["array", "null"]}
    return {"type": ["string", "null"]}


# ------------------------------------------------------------------------------------- results


class Presented:
    """A result that states what it shows; all its forms follow.

    A class gives its `title`, and some of `summary`, `facts`, `tables`, `sentence` and `notes`, and
    names the function that makes its charts (`charts_by`): these are described in the package
    `analysis`, which stands above the data that they show, and is imported when it is first called.
    Of a dataclass that derives from it ``repr`` and ``eq`` are off.

    Attributes
    ----------
    charts_by : str
        As ``"module:function"``; the function takes the result and options of its own, and returns
        charts (`analysis.charts.Chart`). Empty where there is no picture.

    Examples
    --------
    >>> @dataclass(eq=False, repr=False)
    ... class Run(Presented):
    ...     speed: float
    ...
    ...     @property
    ...     def title(self) -> str:
    ...         return "A run"
    ...
    ...     def summary(self) -> dict[str, str]:
    ...         return {"speed": SPEED.words(self.speed)}
    ...
    ...     def facts(self) -> dict[str, float]:
    ...         return {"speed_m_s": self.speed}
    >>> Run(20.0)
    A run
      speed  72.0 km/h
    >>> Run(20.0).data()
    {'speed_m_s': 20.0, 'notes': []}
    >>> Run(20.0) == Run(20.0)
    True
    """

    __slots__ = ()

    charts_by: ClassVar[str] = ""

    @property
    def title(self) -> str:
        """One line."""
        raise NotImplementedError

    def summary(self) -> Mapping[str, str]:
        """The few facts that a prompt shows, in words, by name."""
        return {}

    def facts(self) -> Mapping[str, Any]:
        """What JSON states beside the tables, by key: numbers in SI units, which end the keys."""
        return {}

    def tables(self) -> Sequence[WordTable]:
        """What a terminal, a notebook and a report show; default: the summary."""
        rows = self.summary()
        return [facts_table(self.title, rows)] if rows else []

    @property
    def sentence(self) -> str:
        """What came out, if one sentence states it."""
        return ""

    @property
    def notes(self) -> Sequence[str]:
        """Sentences beside the tables."""
        return ()

    # What follows from these.

    def charts(self, **options: Any) -> Sequence[Any]:
        """The charts of this result; further `options` as of the function `charts_by`.

        Raises
        ------
        InputError
            If there is no picture of such a result.
        """
        if not self.charts_by:
            raise InputError(
                f"{type(self).__name__} has no plot", remedy="print it, or use its attributes"
            )
        module, _, name = self.charts_by.partition(":")
        charts: Sequence[Any] = getattr(import_module(module), name)(self, **options)
        return charts

    def plot(self, **options: Any) -> Figure:
        """Draw this result.

        Parameters
        ----------
        **options
            As of the function `charts_by`.

        Returns
        -------
        matplotlib.figure.Figure
            A notebook shows it; ``figure.savefig("picture.png")`` writes it.
        """
        figure: Figure = import_module("analysis.charts").figure_of(self.charts(**options))
        return figure

    def __repr__(self) -> str:
        return as_text(self.title, self.summary())

    def _repr_html_(self) -> str:
        parts = self.shown()
        tables = [each for each in parts if isinstance(each, WordTable)]
        rows = self.summary()
        if rows and not (tables and tables[0].name == "summary"):
            parts = [facts_table("", rows), *parts]
        parts = [
            replace(each, title="")
            if isinstance(each, WordTable) and each.title == self.title
            else each
            for each in parts
        ]
        shown = "".join(
            each._repr_html_() if isinstance(each, WordTable) else f"<p>{escape(each)}</p>"
            for each in parts
        )
        return f"<div><b>{escape(self.title)}</b>{shown}</div>"

    def __eq__(self, other: object) -> bool:
        return same_values(self, other) if type(other) is type(self) else NotImplemented

    __hash__ = None  # type: ignore[assignment]

    def shown(self, *also: str) -> list[WordTable | str]:
        """What a terminal shows: the tables that have rows, and the sentences beside them.

        Parameters
        ----------
        *also : str
            Names of tables that are shown on request.
        """
        every = [each for each in self.tables() if each.usual or each.name in also]
        tables = [each for each in every if each.rows]
        return [*tables, *self.sentences()]

    def sentences(self) -> list[str]:
        """What is stated beside the tables; default: what came out, and the notes."""
        return [*filter(None, (self.sentence, *self.notes))]

    def data(self) -> dict[str, Any]:
        """The result as JSON has it: its facts, the rows of its tables by name, its sentences.

        Of a result that states facts, tables of words alone say no more than these.
        """
        facts = self.facts()
        found = dict(facts)
        for table in self.tables():
            if not (table.name in facts or (facts and table.plain)):
                found.setdefault(table.name, []).extend(table.data)
        said = {"sentence": self.sentence} if self.sentence else {}
        return found | said | {"notes": list(self.notes)}

    def schema(self) -> dict[str, Any]:
        """JSON Schema of `data`."""
        facts = self.facts()
        tables = {each.name: each.schema() for each in self.tables() if each.name not in facts}
        properties = {
            key: tables.get(key) or _schema_of(value) for key, value in self.data().items()
        }
        return {"type": "object", "properties": properties, "required": sorted(properties)}

    def to_frame(self, name: str = "") -> pd.DataFrame:
        """One of the tables, unless it is named the first that holds more than words.

        The SI units of its columns are in ``attrs["units"]``.
        """
        import pandas as pd

        frames = [each.to_frame() for each in self._tables_named(name)]
        if len(frames) == 1:
            return frames[0]
        found = pd.concat(frames, ignore_index=True)
        found.attrs = frames[0].attrs
        return found

    def to_csv(self, path: str | Path | None = None, name: str = "") -> str:
        """One of the tables as CSV, as `to_frame` chooses it; written if a path is given."""
        text = self._tables_named(name)[0].to_csv()
        if path is not None:
            Path(path).write_text(text, encoding="utf-8")
        return text

    def _tables_named(self, name: str) -> list[WordTable]:
        tables = self.tables()
        numbers = [each for each in tables if not each.plain] or tables
        found = [each for each in tables if name == each.name] if name else numbers
        if not found:
            names = ", ".join(each.name for each in tables) or "none"
            raise KeyError(f"{type(self).__name__} has no table '{name}'; it has {names}")
        return [each for each in found if each.name == found[0].name]
