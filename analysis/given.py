"""Trips as analyses take them: at hand, in logs, or in folders of logs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from trainlog.errors import InputError
from trainlog.trip import Trip

Given = Trip | str | Path
"""A trip, the path of a log, or that of a folder of logs."""


def each_given(trips: Given | Iterable[Given]) -> Iterator[Trip | Path]:
    """Trips and paths of files, one after the other; a folder stands for its logs, by name.

    Raises
    ------
    InputError
        If a folder holds no log.

    Examples
    --------
    >>> [path.name for path in each_given("sample_logs")]
    ['nonstop.mcap', 'stopping.mcap']
    """
    for given in [trips] if isinstance(trips, Trip | str | Path) else trips:
        if isinstance(given, Trip):
            yield given
            continue
        path = Path(given)
        inside = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        if not inside:
            raise InputError(
                "the folder holds no logs (*.mcap)",
                file=path,
                remedy="name another folder, or make logs of recordings with 'trainlog ingest'",
            )
        yield from inside
