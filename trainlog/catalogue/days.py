"""Times that a question names: an instant, or a day, which stands for all of it."""

from __future__ import annotations

import re
from typing import Any

import pandas as pd

from trainlog.errors import InputError
from trainlog.spans import utc

_DAY = re.compile(r"\d{4}-\d{2}-\d{2}")


def times_of(text: Any, zone: str | None = None) -> tuple[int, int]:
    """The first and last nanosecond that a time stands for: of a day all of it.

    Parameters
    ----------
    text : anything that `pandas.Timestamp` takes
    zone : str, optional
        Of a time that states none; default UTC.

    Raises
    ------
    InputError
        If it is no time.

    Examples
    --------
    >>> first, last = times_of("2026-10-01")
    >>> (last - first + 1) / 3600e9
    24.0
    >>> times_of("2026-10-25", "Europe/Zurich")[0] == times_of("2026-10-24T22:00Z")[0]
    True
    """
    day = isinstance(text, str) and _DAY.fullmatch(text) is not None
    try:
        stamp = pd.Timestamp(text)
        if stamp.tzinfo is None and zone is not None:
            following = (stamp + pd.Timedelta(days=1)).tz_localize(zone)
            stamp = stamp.tz_localize(zone)
        else:
            following = stamp + pd.Timedelta(days=1)
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(
            f"'{text}' is not a time{f' in the zone {zone!r}' if zone else ''}",
            remedy="write it as 2026-10-01 or 2026-10-01T06:30Z",
        ) from error
    first = int(utc(stamp).value)
    return first, int(utc(following).value) - 1 if day else first
