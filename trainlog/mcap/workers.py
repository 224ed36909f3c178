"""How many threads read and write a log."""

from __future__ import annotations

import os

from trainlog.errors import InputError


def threads_of(threads: int | None) -> int:
    """How many threads work: as many as asked for, or one a processor, at most four.

    Raises
    ------
    InputError
        If that is no whole number from 1 on.
    """
    if threads is None:
        return min(4, os.cpu_count() or 1)
    if not isinstance(threads, int) or threads < 1:
        raise InputError(f"threads is {threads}", remedy="give a whole number from 1 on")
    return threads
