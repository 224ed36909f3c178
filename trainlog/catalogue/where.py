"""Expressions that choose trips, as ``train = 'RABe 526' and duration > '20 min'``.

The text is parsed by sqlglot and built anew, piece by piece, of what is allowed: columns, literals,
comparisons and the functions listed here. Literals are handed to the database beside the statement.
What a piece means does not depend on the database: times are whole numbers, the calendar is
computed with these, and texts are compared byte by byte.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

import sqlalchemy as sa
import sqlglot
from sqlglot import exp

from trainlog.catalogue.database import TRIP_COLUMNS, on_line, trip_edges, trips
from trainlog.errors import InputError
from trainlog.spans import times_of
from trainlog.units import DAY, DISTANCE, KILOMETRE, MASS, NUMBER, TIME

_MEASURES = {
    "": NUMBER,
    "s": replace(TIME, usual="", examples="'20 min' or '1.5 h'"),
    "m": replace(DISTANCE, usual="", examples="'12.5 km' or '800 m'"),
    "km": replace(KILOMETRE, examples="12.5 or '12.5 km'"),
    "kg": replace(MASS, usual="", examples="'15 t' or '15000 kg'"),
}
"""How the number that a column is compared with is read, by the column's unit."""

FUNCTIONS = {
    "year": "year(start), in UTC",
    "month": "month(start), 1 to 12",
    "weekday": "weekday(start), 1 is Monday",
    "hour": "hour(start), 0 to 23",
    "label": "label('configuration'), a fact that the log states",
    "topic": "topic('/train/axles'), the number of its messages",
    "passport": "passport('effort_gain'), a value of the passport",
}
"""Functions of expressions, each as it is written."""

_HOLDERS = {"label": "labels", "topic": "topics", "passport": "passport"}
"""Columns of JSON by the function that asks for one of the values that they hold."""

_COLUMNS = {each.name: each for each in TRIP_COLUMNS}
_AS_JSON = {
    f"{each.name}_{each.unit}": each for each in TRIP_COLUMNS if each.unit in ("s", "m", "kg")
} | {"from_km": _COLUMNS["km_from"], "to_km": _COLUMNS["km_to"]}
"""Columns by the keys that ``fleet query --json`` gives them."""

_WORDS = [each.name for each in TRIP_COLUMNS if each.kind != "json"]

_INDEXED = {"start", "train", "key", "sha256"}
"""Columns by which few trips are found without looking at the others."""

_MOST_LETTERS = 10_000
"""Of an expression."""

_COMPARISONS: dict[type[exp.Expression], Callable[[Any, Any], Any]] = {
    exp.EQ: operator.eq,
    exp.NEQ: operator.ne,
    exp.LT: operator.lt,
    exp.LTE: operator.le,
    exp.GT: operator.gt,
    exp.GTE: operator.ge,
}


@dataclass(frozen=True)
class _Value:
    """A piece of an expression that has a value: its kind and unit, and what the database sees."""

    kind: str
    unit: str
    element: Any
    words: str


def condition_of(text: str, zone: str | None = None) -> sa.ColumnElement[bool]:
    """The condition that an expression states, for a statement on the table of trips.

    Parameters
    ----------
    text : str
    zone : str, optional
        Time zone of times that state none; default UTC.

    Raises
    ------
    InputError
        If it is not understood or not allowed; names the place, what is known and the remedy.

    Examples
    --------
    >>> str(condition_of("weather = 'wet'"))
    'trips.weather = :weather_1'
    >>> condition_of("wether = 'wet'")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: expression "wether = 'wet'", column 1: 'wether' is not a column...
    """
    found: sa.ColumnElement[bool] = _Compiler(text, zone).condition()
    return found


def asked_by(text: str) -> list[tuple[str, str]]:
    """Columns, each with a text that an expression asks it to equal, or with a key, in its order.

    Keys are those of ``label('x')`` and ``passport('x')``.

    Examples
    --------
    >>> asked_by("weather = 'wet' and train in ('a', 'b') and label('season') = 'summer'")
    [('weather', 'wet'), ('train', 'a'), ('train', 'b'), ('labels', 'season')]
    """
    compiler = _Compiler(text, None)
    compiler.condition()
    return compiler.asked


class _Compiler:
    """Builds the condition of one expression."""

    def __init__(self, text: str, zone: str | None) -> None:
        self.text = text
        self.zone = zone
        self.few = False
        self.asked: list[tuple[str, str]] = []

    def condition(self) -> Any:
        if len(self.text) > _MOST_LETTERS:
            raise self.refused(
                "is longer than 10,000 letters", None, "ask for fewer values at once"
            )
        if not self.text.strip():
            raise self.refused("is empty", None, "leave it out, or write one as weather = 'wet'")
        try:
            # In brackets, so that a column may have the name of a statement, as `load` has.
            parsed = sqlglot.parse(f"({self.text})")
            if len(parsed) != 1 or not isinstance(parsed[0], exp.Paren):
                raise self.refused("is more than one expression", None, "join them by and")
            named = {each.name.lower() for each in parsed[0].find_all(exp.Column)}
            self.few = bool(named & _INDEXED)
            return self.truth(parsed[0].this)
        except sqlglot.errors.SqlglotError as error:
            raise self.unparsed(error) from error
        except RecursionError:
            raise self.refused(
                "is nested too deeply", None, "write it with fewer brackets"
            ) from None

    # -------------------------------------------------------------------------- what is true

    def truth(self, node: Any) -> Any:
        if isinstance(node, exp.Paren):
            return self.truth(node.this)
        if isinstance(node, exp.Not):
            return sa.not_(self.truth(node.this))
        if isinstance(node, exp.And | exp.Or):
            join = sa.and_ if isinstance(node, exp.And) else sa.or_
            return join(*(self.truth(each) for each in node.flatten()))
        if type(node) in _COMPARISONS:
            return self.comparison(type(node), node.this, node.expression)
        if isinstance(node, exp.Between):
            low = self.comparison(exp.GTE, node.this, node.args["low"])
            return sa.and_(low, self.comparison(exp.LTE, node.this, node.args["high"]))
        if isinstance(node, exp.In) and node.expressions:
            return sa.or_(*(self.comparison(exp.EQ, node.this, each) for each in node.expressions))
        if isinstance(node, exp.Like):
            return self.like(node)
        if isinstance(node, exp.Is):
            return self.unknown(node)
        if isinstance(node, exp.Column | exp.Literal | exp.Func | exp.Neg):
            raise self.refused(
                f"'{_words(node)}' is compared with nothing", node, "compare it, as in = 'wet'"
            )
        raise self.forbidden(node)

    def comparison(self, kind: Any, left: Any, right: Any) -> Any:
        """A comparison; a literal is read as the other side asks."""
        if kind is exp.NEQ:
            return sa.not_(self.comparison(exp.EQ, left, right))
        if _is_literal(left):
            raise self.refused("begins with a literal", left, "write the column first")
        value, compare = self.value(left), _COMPARISONS[kind]
        if not _is_literal(right):
            other = self.value(right)
            if (value.kind, value.unit) != (other.kind, other.unit):
                raise self.refused(
                    f"'{value.words}' and '{other.words}' are not of one kind",
                    right,
                    "compare times with times, lengths with lengths",
                )
            return compare(value.element, other.element)
        if value.kind == "time":
            return self.at_time(kind, value, right)
        if value.kind != "text":
            return compare(value.element, self.number_of(right, value))
        text = self.text_of(right, value)
        if kind is exp.EQ:
            self.asked += [(value.words, text)] * (value.words in _COLUMNS)
            return self.on_any(value, lambda column: column == text)
        return compare(value.element, text)

    def on_any(self, value: _Value, test: Callable[[Any], Any]) -> Any:
        """Whether a test holds for a text; of a line, for any of those that the trip ran over."""
        found = test(value.element)
        return found if value.words != "line" else on_line(found, test(trip_edges.c.edge), self.few)

    def like(self, node: Any) -> Any:
        value = self.value(node.this)
        if value.kind != "text" or not _is_literal(node.expression):
            raise self.refused(
                "like compares a text with a pattern", node, "as in train like 'RABe%'"
            )
        pattern = self.text_of(node.expression, value)
        if pattern.endswith("\\") and not pattern.endswith("\\\\"):
            raise self.refused("the pattern ends in a backslash", node.expression, "write it twice")
        return self.on_any(value, lambda column: column.like(pattern, escape="\\"))

    def unknown(self, node: Any) -> Any:
        negated = isinstance(node.expression, exp.Not)
        if not isinstance(node.expression.this if negated else node.expression, exp.Null):
            raise self.refused(
                "is must be followed by null or not null", node, "write = for equality"
            )
        element = self.value(node.this).element
        return element.is_not(None) if negated else element.is_(None)

    def at_time(self, kind: Any, value: _Value, node: Any) -> Any:
        """A comparison with a time; a day stands for all of it."""
        try:
            first, last = times_of(self.text_of(node, value).strip(), self.zone)
        except InputError as error:
            remedy = "write it as '2026-10-01' or '2026-10-01T06:30Z'"
            raise self.refused(error.problem, node, remedy) from error
        if kind is exp.EQ:
            return value.element.between(first, last)
        return _COMPARISONS[kind](value.element, first if kind in (exp.LT, exp.GTE) else last)

    # ---------------------------------------------------------------------- what has a value

    def value(self, node: Any) -> _Value:
        if isinstance(node, exp.Paren):
            return self.value(node.this)
        if isinstance(node, exp.Column):
            return self.column(node)
        if isinstance(node, exp.Anonymous):
            return self.function(str(node.this).lower(), node, node.expressions)
        if isinstance(node, exp.Func):
            given = [each for each in node.args.values() if isinstance(each, exp.Expression)]
            return self.function(str(node.sql_name()).lower(), node, given)
        raise self.forbidden(node)

    def column(self, node: Any) -> _Value:
        if not isinstance(node.this, exp.Identifier) or node.args.get("table") is not None:
            raise self.forbidden(node)
        name = node.this.this
        column = _COLUMNS.get(name) or _COLUMNS.get(name.lower()) or _AS_JSON.get(name)
        if column is None:
            close = get_close_matches(name.lower(), _WORDS, n=1)
            meant = f"did you mean '{close[0]}'? " if close else ""
            text = f"a text stands in '...'; {meant}" if node.this.quoted else meant
            raise self.refused(
                f"'{name}' is not a column", node, f"{text}columns: {', '.join(_WORDS)}"
            )
        if column.kind == "json":
            written = next(word for word, held in _HOLDERS.items() if held == column.name)
            raise self.refused(
                f"'{name}' holds several values", node, f"ask for one: {FUNCTIONS[written]}"
            )
        kind = "number" if column.kind == "count" else column.kind
        return _Value(kind, column.unit, trips.c[column.name], column.name)

    def function(self, name: str, node: Any, given: Sequence[Any]) -> _Value:
        name = {"day_of_week": "weekday", "dayofweek": "weekday"}.get(name, name)
        if name not in FUNCTIONS:
            known = f"known: {', '.join(FUNCTIONS.values())}"
            raise self.refused(f"the function {name}() is not allowed", node, known)
        usage = f"as in {FUNCTIONS[name]}"
        if len(given) != 1:
            raise self.refused(f"{name}() takes one value", node, usage)
        inner = given[0]
        if name in _HOLDERS:
            if not (isinstance(inner, exp.Literal) and inner.is_string) or '"' in inner.this:
                raise self.refused(f"{name}() takes a name in '...'", inner, usage)
            return self.held(name, inner.this)
        while isinstance(inner, exp.Cast | exp.Paren | exp.TsOrDsToDate):
            inner = inner.this
        value = self.value(inner)
        if value.kind != "time":
            raise self.refused(f"{name}() takes a time", node, usage)
        return _Value("number", "", _calendar(name, value.element), f"{name}({value.words})")

    def held(self, name: str, key: str) -> _Value:
        """One of the values that a column of JSON holds."""
        words, inside = f"{name}('{key}')", trips.c[_HOLDERS[name]][key]
        if name == "topic":
            return _Value("number", "", sa.func.coalesce(inside.as_integer(), 0), words)
        self.asked.append((_HOLDERS[name], key))
        if name == "label":
            return _Value("text", "", inside.as_string(), words)
        return _Value("number", "", inside.as_float(), words)

    # -------------------------------------------------------------------------------- literals

    def text_of(self, node: Any, value: _Value) -> str:
        if not (isinstance(node, exp.Literal) and node.is_string):
            shown = _words(node)
            remedy = (
                "write 'is null'"
                if isinstance(node, exp.Null)
                else f"write it in quotes: '{shown}'"
            )
            what = "a time" if value.kind == "time" else "a text"
            raise self.refused(f"'{value.words}' is {what}, not {shown}", node, remedy)
        return str(node.this)

    def number_of(self, node: Any, value: _Value) -> float | int:
        negative = isinstance(node, exp.Neg)
        literal = node.this if negative else node
        if not isinstance(literal, exp.Literal):
            raise self.refused(
                f"'{value.words}' is a number, not {_words(node)}", node, "write 'is null'"
            )
        text = "-" * negative + str(literal.this)
        if not value.unit and re.fullmatch(r"[-+]?\d{1,17}", text):
            return int(text)
        try:
            return _MEASURES[value.unit].read(text, value.words)
        except InputError as error:
            raise self.refused(error.problem, node, error.remedy or "") from error

    # -------------------------------------------------------------------------------- refusals

    def forbidden(self, node: Any) -> InputError:
        return self.refused(
            f"'{_words(node)}' is not allowed in an expression",
            node,
            "compare columns with values by = <> < <= > >= in, like, between, is null; join by"
            f" and, or, not; columns: {', '.join(_WORDS)}",
        )

    def unparsed(self, error: Any) -> InputError:
        details = (getattr(error, "errors", None) or [{}])[0]
        token = str(details.get("highlight") or "")
        column = max(1, int(details["col"]) - len(token)) if details.get("col") else None
        column = None if column is None or column > len(self.text) else column
        where = ": it is not complete" if column is None or not token else f" at {token!r}"
        remedy = f"write it as train = 'X' and weather = 'wet'; columns: {', '.join(_WORDS)}"
        return self.refused(f"is not understood{where}", None, remedy, column)

    def refused(
        self, problem: str, node: Any, remedy: str, column: int | None = None
    ) -> InputError:
        """That the expression is refused, naming the place of a piece of it."""
        if isinstance(node, exp.Expression):
            starts = (each.meta.get("start") for each in node.walk())
            column = min((each for each in starts if isinstance(each, int)), default=None)
        shown = self.text if len(self.text) <= 200 else f"{self.text[:200]}..."
        where = f'expression "{shown}"' + (f", column {column}" if column is not None else "")
        return InputError(problem, place=where, remedy=remedy)


def _is_literal(node: Any) -> bool:
    inner = node.this if isinstance(node, exp.Neg) else node
    return isinstance(inner, exp.Literal) or isinstance(node, exp.Null | exp.Boolean)


def _words(node: Any) -> str:
    return node.sql()[:60] if isinstance(node, exp.Expression) else str(node)[:60]


def _calendar(name: str, time: Any) -> Any:
    """Year, month, weekday or hour of a time in UTC, by whole numbers alone.

    After Hinnant (2013), "chrono-compatible low-level date algorithms": days are counted in eras of
    400 years that begin on the first of March.
    """
    if name == "hour":
        return (time // 3_600_000_000_000) % 24
    days = time // DAY
    if name == "weekday":
        return (days + 3) % 7 + 1
    shifted = days + 719_468
    era = shifted // 146_097
    day = shifted - era * 146_097
    year = (day - day // 1460 + day // 36_524 - day // 146_096) // 365
    of_year = day - (365 * year + year // 4 - year // 100)
    month = (5 * of_year + 2) // 153
    early = sa.case((month < 10, 0), else_=1)
    if name == "month":
        return month + 3 - 12 * early
    return year + era * 400 + early
