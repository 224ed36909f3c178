"""Names of the metadata records that make an MCAP file a log of trainlog, and error places."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from trainlog.errors import LogError

FORMAT_RECORD = "trainlog.format"
"""Metadata record that says which version of the table of topics the file follows."""

TRIP_RECORD = "trainlog"
"""Metadata record that holds the trip's metadata."""

PROVENANCE_RECORD = "trainlog.provenance"
"""Metadata record that holds one JSON object a processing step, under ``0001``, ``0002`` ..."""


@contextmanager
def in_file(path: str | Path) -> Iterator[None]:
    """Name the file in any LogError that the block raises."""
    try:
        yield
    except LogError as error:
        if error.file is not None:
            raise
        raise LogError(error.problem, file=path, place=error.place, remedy=error.remedy) from error
