"""Format ``parquet``: a Parquet table of any layout, described by a profile."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from trainlog.errors import InputError
from trainlog.formats.files import read_bytes
from trainlog.ingest.mapping import recording_of, wanted_columns
from trainlog.ingest.profile import Profile, suggestion
from trainlog.ingest.recording import Recording
from trainlog.ingest.textfile import Cells

MAGIC = b"PAR1"


def is_parquet(head: bytes) -> bool:
    """Whether a file begins as Parquet does."""
    return head.startswith(MAGIC)


def read_parquet(path: Path, profile: Profile | None) -> Recording:
    """Read a Parquet table as `profile` describes it; its rows count from 1.

    Raises
    ------
    InputError
        If there is no profile, the file is damaged, or does not fit the profile.
    """
    if profile is None:
        raise InputError(
            "is a Parquet table of a layout that trainlog does not know",
            file=path,
            remedy="give a profile that says which column is what; docs/ingest.md has an example",
        )
    data = pa.BufferReader(read_bytes(path))
    try:
        names = tuple(pa.parquet.read_schema(data).names)
        wanted = list(dict.fromkeys(wanted_columns(profile, names, path)))
        for name in wanted:
            if name not in names:
                raise InputError(
                    f"no column '{name}'", file=path, remedy=suggestion(name, names, "columns")
                )
        data.seek(0)
        table = pa.parquet.read_table(data, columns=wanted)
    except (pa.ArrowException, OSError) as error:
        raise InputError(
            f"is no Parquet table that can be read: {_first_line(error)}",
            file=path,
            remedy="copy the file again; was the recorder stopped while writing?",
        ) from error
    if not table.num_rows:
        raise InputError("holds no row of data", file=path, remedy="record again")
    rows = np.arange(1, table.num_rows + 1, dtype=np.int64)
    return recording_of(Cells(table, rows, rows.size), profile, path)


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:120]
