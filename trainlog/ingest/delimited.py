"""Format ``csv``: delimited text of any layout, described by a profile."""

from __future__ import annotations

from pathlib import Path

from trainlog.errors import InputError
from trainlog.ingest.mapping import recording_of, wanted_columns
from trainlog.ingest.profile import Profile
from trainlog.ingest.recording import Recording
from trainlog.ingest.textfile import open_text


def is_delimited(head: bytes) -> bool:
    """Whether a file may be delimited text: no zero bytes, or the byte order mark of UTF-16."""
    return head[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" not in head.rstrip(b"\0")


def read_delimited(path: Path, profile: Profile | None) -> Recording:
    """Read delimited text as `profile` describes it.

    Raises
    ------
    InputError
        If there is no profile, or the file does not fit it.
    """
    if profile is None:
        raise InputError(
            "is text of a layout that trainlog does not know",
            file=path,
            remedy="give a profile that says which column is what; docs/ingest.md has an example",
        )
    text = open_text(path, profile.file)
    cells = text.cells(wanted_columns(profile, text.names, path))
    return recording_of(cells, profile, path)
