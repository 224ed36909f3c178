"""Summaries of objects: a few lines of text for a prompt, and the words that they are made of."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

MOST_LINES = 10
"""Of the text of an object."""


def as_text(title: str, rows: Mapping[str, str]) -> str:
    """A title, and a line per row under it: at most ten lines.

    Examples
    --------
    >>> print(as_text("Line 'A - B'", {"length": "3.0 km", "stations": "2"}))
    Line 'A - B'
      length    3.0 km
      stations  2
    """
    width = max(map(len, rows), default=0)
    lines = [title, *(f"  {name:<{width}}  {said}".rstrip() for name, said in rows.items())]
    if len(lines) > MOST_LINES:
        lines[MOST_LINES - 1 :] = [f"  and {len(lines) - MOST_LINES + 1} more"]
    return "\n".join(lines)


def at_most(share: float, digits: int = 3) -> str:
    """A bound as a percentage, rounded up: what is stated holds. Beyond 100 % there is none.

    Examples
    --------
    >>> at_most(0.000141), at_most(0.000141, 2), at_most(4.3e6)
    ('0.015%', '0.02%', 'no bound found')
    """
    if share > 1.0:
        return "no bound found"
    return f"{math.ceil(round(share * 10 ** (digits + 2), 6)) / 10 ** (digits + 2):.{digits}%}"


def counted(count: int, noun: str) -> str:
    """A number of things, in the singular or the plural.

    Examples
    --------
    >>> counted(1, "trip"), counted(2, "trip"), counted(12345, "row")
    ('1 trip', '2 trips', '12,345 rows')
    """
    return f"{count:,} {noun}{'s' * (count != 1)}"


def few(words: Sequence[str], most: int) -> str:
    """The first of some words, and how many more there are.

    Examples
    --------
    >>> few(["Wil", "Uzwil", "Flawil", "Gossau"], 2), few(["Wil"], 2)
    ('Wil, Uzwil and 2 more', 'Wil')
    """
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(words[:most]) + more


def span(values: ArrayLike, factor: float = 1.0, digits: int = 0) -> str:
    """Least and greatest of some values, as ``60 to 125``, or the one value that they all have.

    Examples
    --------
    >>> span([20.0, 30.0], 3.6)
    '72 to 108'
    """
    known = np.asarray(values, dtype=np.float64)
    low, high = (f"{factor * each + 0.0:.{digits}f}" for each in (known.min(), known.max()))
    return low if low == high else f"{low} to {high}"


def lateness(seconds: float) -> str:
    """How long after the timetable something happens, to a hundredth of a second.

    Examples
    --------
    >>> lateness(-0.0002), lateness(0.034), lateness(-2.0)
    ('on time', '0.03 s late', '2.00 s early')
    """
    if abs(seconds) < 0.005:
        return "on time"
    return f"{abs(seconds):.2f} s {'late' if seconds > 0.0 else 'early'}"


MOST_BRIEF = 6
"""Of many inputs, how many are named."""


def in_brief(value: object, apart: str = ", ") -> str:
    """Inputs and settings in words: of many the first, of records their number, digests by begin.

    What states nothing is left out.

    Examples
    --------
    >>> in_brief({"inputs": {"line.json": "d2ee4f2609b9" * 5 + "d2ee"}, "seed": 7, "at": None})
    'inputs line.json d2ee4f2609b9…, seed 7'
    """
    if isinstance(value, Mapping):
        said = [(name, in_brief(each)) for name, each in value.items()]
        return apart.join(f"{name} {words}" for name, words in said if words)
    if isinstance(value, list | tuple):
        if any(isinstance(each, Mapping) for each in value):
            return str(len(value))
        more = [f"and {len(value) - MOST_BRIEF} more"] * (len(value) > MOST_BRIEF)
        return ", ".join([*map(in_brief, value[:MOST_BRIEF]), *more])
    text = "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return f"{text[:12]}…" if re.fullmatch("[0-9a-f]{64}", text) else text


FORMULA = r"'*[=+\-@\t\r]"
"""Beginning of a text that a spreadsheet takes for a formula, or that `cell_of` has written."""

_FORMULA = re.compile(FORMULA)


def cell_of(text: Any) -> Any:
    """A text as a cell that no spreadsheet takes for a formula: behind an apostrophe.

    Numbers, also those written as texts, stay as they are.

    Examples
    --------
    >>> cell_of("=HYPERLINK(A1)"), cell_of("-5.2"), cell_of("Wil"), cell_of(7.5)
    ("'=HYPERLINK(A1)", '-5.2', 'Wil', 7.5)
    """
    if not isinstance(text, str) or not _FORMULA.match(text) or is_number(text):
        return text
    return f"'{text}"


def text_of_cell(cell: str) -> str:
    """The text of a cell that `cell_of` wrote.

    Examples
    --------
    >>> text_of_cell("'=1+1"), text_of_cell("'s-Hertogenbosch")
    ('=1+1', "'s-Hertogenbosch")
    """
    return cell[1:] if cell[:1] == "'" and _FORMULA.match(cell) else cell


def is_number(text: str) -> bool:
    """Whether a text is a number.

    Examples
    --------
    >>> is_number("-1e3"), is_number("-a")
    (True, False)
    """
    try:
        float(text)
    except ValueError:
        return False
    return True


SPEED_UNITS = {"km/h": 1.0, "m/s": 1.0 / 3.6, "mph": 1000.0 / 1609.344}
"""Units in which speeds can be shown, with what 1 km/h is in them."""

_NUMBER = r"-?\d[\d,]*(?:\.\d+)?"
_SPEEDS = re.compile(rf"(?<![\w.,])({_NUMBER})(?:( to | ± |-)({_NUMBER}))? km/h\b")
_CLOCK = r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d(?::\d\d(?:\.\d+)?)?"
_TIMES = re.compile(rf"({_CLOCK})(?: to ({_CLOCK}))?(?: UTC|Z|\+00:00)\b")


def in_speed_unit(words: str, unit: str) -> str:
    """Words with the speeds in them in another unit than km/h.

    Examples
    --------
    >>> in_speed_unit("from 60 to 125 km/h, hold 80.0 km/h", "mph")
    'from 37 to 78 mph, hold 49.7 mph'
    >>> in_speed_unit("hold 80 km/h", "m/s")
    'hold 22.2 m/s'
    """
    if unit == "km/h":
        return words
    factor = SPEED_UNITS[unit]

    def shown(number: str) -> str:
        digits = len(number.partition(".")[2]) + (unit == "m/s")
        return f"{float(number.replace(',', '')) * factor:,.{digits}f}"

    def converted(found: re.Match[str]) -> str:
        first, between, second = found.groups()
        rest = f"{between}{shown(second)}" if second else ""
        return f"{shown(first)}{rest} {unit}"

    return _SPEEDS.sub(converted, words)


def in_zone(words: str, zone: str) -> str:
    """Words with the times in them, which state that they are UTC, in another zone.

    Examples
    --------
    >>> in_zone("expected at 2024-10-09 06:00 UTC", "Europe/Zurich")
    'expected at 2024-10-09 08:00 CEST'
    >>> in_zone("2024-10-08T00:00:00+00:00", "Europe/Zurich")
    '2024-10-08 02:00:00 CEST'
    """
    if zone == "UTC":
        return words
    from trainlog.spans import zone_of

    there = zone_of(zone)

    def local(time: str) -> tuple[str, str]:
        seconds, point, rest = time.replace("T", " ").partition(".")
        moment = datetime.fromisoformat(seconds).replace(tzinfo=UTC).astimezone(there)
        form = "%Y-%m-%d %H:%M:%S" if seconds.count(":") > 1 else "%Y-%m-%d %H:%M"
        return f"{moment:{form}}{point}{rest}", f"{moment:%Z}"

    def converted(found: re.Match[str]) -> str:
        first, second = found.groups()
        begin, name = local(first)
        if not second:
            return f"{begin} {name}"
        end, last = local(second)
        return f"{begin} to {end} {last}" if name == last else f"{begin} {name} to {end} {last}"

    return _TIMES.sub(converted, words)
