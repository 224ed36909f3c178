"""Trips as analyses take them: at hand, in logs, or in folders of logs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from trainlog.errors import InputError
from trainlog.formats.files import check_kind, logs_of
from trainlog.mcap import read_log
from trainlog.trip import Trip

Given = Trip | str | Path
"""A trip, the path of a log, or that of a folder of logs."""

_ONE = (Trip, str, Path)


def each_given(trips: Given | Iterable[Given]) -> Iterator[Trip | Path]:
    """Trips and paths of files, one after the other; a folder stands for its logs, by name.

    Raises
    ------
    InputError
        If a folder holds no log, or something is neither a trip nor a path.

    Examples
    --------
    >>> [path.name for path in each_given("sample_logs")]
    ['nonstop.mcap', 'stopping.mcap']
    """
    for given in trips if isinstance(trips, Iterable) and not isinstance(trips, _ONE) else [trips]:
        check_kind(given, *_ONE)
        if isinstance(given, Trip):
            yield given
            continue
        yield from logs_of(Path(given))


def trip_of(given: Given, topics: Sequence[str] | None = None) -> Trip:
    """The trip at hand, or that of a log.

    Parameters
    ----------
    given : Trip or path
    topics : sequence of str, optional
        What is read of a log; default: everything.

    Raises
    ------
    InputError
        If it is neither a trip nor a path, or the path is that of a folder.
    LogError
        If the file is not a log.

    Examples
    --------
    >>> trip_of("sample_logs/nonstop.mcap", ["/train/state"]).name
    'trip-01'
    """
    check_kind(given, *_ONE)
    if isinstance(given, Trip):
        return given
    if Path(given).is_dir():
        raise InputError("is a folder; one trip is expected", file=given, remedy="give one log")
    return read_log(given, topics)
