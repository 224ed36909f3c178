"""Times that a question names: an instant, or a day, which stands for all of it."""

from __future__ import annotations

import re
from typing import Any

import pandas as pd

from trainlog.errors import InputError
from trainlog.spans import check_zone, stamp_of, utc

_DAY = re.compile(r"\d{4}-\d{2}-\d{2}|\d{8}")


def times_of(text: Any, zone: str | None = None) -> tuple[int, int]:
    """The first and last nanosecond that a time stands for: of a day all of it.

    Parameters
    ----------
    text : str, or anything that `pandas.Timestamp` takes
        A text as 2026-10-01 or 2026-10-01T06:30Z, see `trainlog.spans.stamp_of`.
    zone : str, optional
        Of a time that states none; default UTC.

    Raises
    ------
    InputError
        If it is no time, the zone is unknown, or the time is skipped or comes twice there.

    Examples
    --------
    >>> first, last = times_of("2026-10-01")
    >>> (last - first + 1) / 3600e9
    24.0
    >>> times_of("2026-10-25", "Europe/Zurich")[0] == times_of("2026-10-24T22:00Z")[0]
    True
    """
    day = isinstance(text, str) and _DAY.fullmatch(text.strip()) is not None
    if zone is not None:
        check_zone(zone)
    stamp = stamp_of(text)
    try:
        if stamp.tzinfo is None and zone is not None:
            following = (stamp + pd.Timedelta(days=1)).tz_localize(zone)
            stamp = stamp.tz_localize(zone)
        else:
            following = stamp + pd.Timedelta(days=1)
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(
            f"'{text}' is not one time in the zone '{zone}'" if zone else f"'{text}' is not a time",
            remedy="write it as 2026-10-01T06:30Z, or with another offset",
        ) from error
    first = int(utc(stamp).value)
    return first, int(utc(following).value) - 1 if day else first
