"""The part of a log that a command is asked for: options, and how their words are read."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trainlog.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from trainlog.trip import Trip

TopicOption = Annotated[
    list[str] | None, typer.Option("--topic", help="Only this topic; may be given several times.")
]
FromOption = Annotated[
    str | None,
    typer.Option(
        "--from",
        help="Only from this time on: 2024-05-01T06:00:00Z, 10s (after the start), end-5min.",
    ),
]
ToOption = Annotated[str | None, typer.Option("--to", help="Only up to this time.")]
KilometreOption = Annotated[
    str | None, typer.Option("--km", help="Only while the train was between: 3.2:7.5, 3.2:, :7.5.")
]

SECONDS = {"ms": 0.001, "s": 1.0, "min": 60.0, "h": 3600.0}

_RELATIVE = re.compile(
    r"(?:(?P<edge>start|end)|(?P<sign>(?:start\+|end-)?)(?P<number>\d+(?:\.\d+)?)(?P<unit>ms|s|min|h))"
)


def times(
    start: str | None,
    end: str | None,
    span: Callable[[], tuple[pd.Timestamp, pd.Timestamp] | None],
) -> tuple[Any, Any] | None:
    """The time asked for; None if all.

    Parameters
    ----------
    start, end : str or None
        A time in ISO 8601, UTC unless it says otherwise, or one relative to the log: ``90s`` or
        ``start+90s`` after its first row, ``end-5min`` before its last.
    span : callable
        Gives the times of the log's first and last row; asked only if a word is relative.

    Raises
    ------
    InputError
        If a word is no time, or relative to a log without rows.
    """
    if start is None and end is None:
        return None
    return _moment(start, span), _moment(end, span)


def stretch(words: str | None) -> tuple[float | None, float | None] | None:
    """The positions asked for [m], from kilometres as ``3.2:7.5``; None if all.

    Raises
    ------
    InputError
        If the words are not of that form.
    """
    if words is None:
        return None
    start, colon, end = words.partition(":")
    try:
        if not colon:
            raise ValueError(words)
        limits = tuple(float(word) * 1000.0 if word.strip() else None for word in (start, end))
        if not all(limit is None or math.isfinite(limit) for limit in limits):
            raise ValueError(words)
    except ValueError as error:
        raise InputError(
            f"'{words}' is no stretch of the line", remedy="write kilometres as 3.2:7.5"
        ) from error
    return limits[0], limits[1]


def _moment(
    word: str | None, span: Callable[[], tuple[pd.Timestamp, pd.Timestamp] | None]
) -> pd.Timestamp | None:
    if word is None:
        return None
    from trainlog.spans import utc

    found = _RELATIVE.fullmatch(word.strip())
    if found is None:
        try:
            return utc(word)
        except InputError as error:
            raise InputError(
                error.problem, remedy="write it as 2024-05-01T06:00:00Z, 10s, or end-5min"
            ) from error
    import pandas as pd

    known = span()
    if known is None:
        raise InputError(f"'{word}' has no meaning: the log has no rows", remedy="leave it out")
    edge = found["edge"] or ("end" if found["sign"] == "end-" else "start")
    from_edge = float(found["number"] or 0.0) * SECONDS[found["unit"] or "s"]
    try:
        distance = pd.Timedelta(round(from_edge * 1e9), "ns")
        return known[1] - distance if edge == "end" else known[0] + distance
    except (OverflowError, pd.errors.OutOfBoundsDatetime, pd.errors.OutOfBoundsTimedelta) as error:
        raise InputError(
            f"'{word}' is further than time stamps reach",
            remedy=f"the log begins {known[0]:%Y-%m-%dT%H:%M:%SZ} and ends "
            f"{known[1]:%Y-%m-%dT%H:%M:%SZ}",
        ) from error


def source_span(source: Path) -> Callable[[], tuple[pd.Timestamp, pd.Timestamp] | None]:
    """What `times` asks for the times of a log's first and last row."""

    def span() -> tuple[pd.Timestamp, pd.Timestamp] | None:
        from trainlog.mcap.convert import span_of

        return span_of(source)

    return span


def part_of(
    log: Path, start: str | None, end: str | None, km: str | None, rows: int
) -> Iterator[Trip]:
    """The part of a log that is asked for, in pieces of at most `rows` rows.

    Raises
    ------
    LogError
        If the log cannot be read, or nothing of it is in that part.
    """
    from trainlog.mcap import stream_log
    from trainlog.mcap.source import nothing_of

    time, position = times(start, end, source_span(log)), stretch(km)
    empty = True
    for piece in stream_log(log, time=time, position=position, rows=rows):
        empty = empty and not any(map(len, piece.topics.values()))
        yield piece
    if empty and (time, position) != (None, None):
        raise nothing_of(log)
