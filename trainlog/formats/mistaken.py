"""What a file is that was given for another kind of file, and what is done with it instead."""

from __future__ import annotations

import re

LOOKED_AT = 4096
"""So many bytes from the beginning tell what a file is."""

_INGEST = "'trainlog ingest' makes logs of recordings"
_UNPACK = "unpack it first"
_BAG = "'mcap convert', of the MCAP project, makes an MCAP file of it"

_BEGINNINGS = (
    (
        b"PAR1",
        "a Parquet file",
        "'trainlog convert FOLDER.parquet -o trip.mcap' makes a log of a converted one, "
        "'trainlog ingest' of a recording; summaries of a fit are for 'trainlog fit'",
    ),
    (b"RRF", "a recording of the Rerun viewer", "give the logs that it shows"),
    (b"#ROSBAG", "a bag of ROS 1", _BAG),
    (b"SQLite format 3", "an SQLite database, as bags of ROS 2 are", _BAG),
    (b"MDF ", "an MDF file", _INGEST),
    (b"\x1f\x8b", "compressed with gzip", _UNPACK),
    (b"\x28\xb5\x2f\xfd", "compressed with zstd", _UNPACK),
    (b"PK\x03\x04", "a ZIP archive", _UNPACK),
    (b"\x89PNG", "a picture", "give the log that it shows"),
)
_MCAP = b"\x89MCAP"
_FORMAT = re.compile(rb'"format"\s*:\s*"(trainlog/[a-z_-]{1,40})"')


def mistaken_log(start: bytes) -> tuple[str, str]:
    """What a file is that was given for a log and is none, and the remedy.

    Parameters
    ----------
    start : bytes
        The beginning of a file that is no MCAP file; `LOOKED_AT` bytes are enough.

    Returns
    -------
    tuple of str
        What is wrong and the remedy, for a `LogError`.
    """
    if not start:
        return "is empty", "expected a log in the MCAP format"
    for beginning, what, remedy in _BEGINNINGS:
        if start.startswith(beginning):
            return f"is not an MCAP file but {what}", remedy
    if start.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"{", b"["):
        ours = _FORMAT.search(start)
        what = f"a {ours[1].decode()} file" if ours else "a JSON file"
        remedy = "give the logs (.mcap) of the trips themselves" if ours else _INGEST
        return f"is not an MCAP file but {what}", remedy
    if _is_text(start):
        return "is not an MCAP file but text", _INGEST
    return "is not an MCAP file", "expected a log in the MCAP format"


def mistaken_json(start: bytes) -> str | None:
    """What a file is that was given for JSON, from its beginning; None if that does not tell."""
    if start.startswith(_MCAP):
        return "a log (MCAP)"
    return next((what for beginning, what, _ in _BEGINNINGS if start.startswith(beginning)), None)


def _is_text(start: bytes) -> bool:
    """Whether it is text in UTF-8; a character may be cut at the end."""
    try:
        words = start[: max(1, len(start) - 3)].decode()
    except UnicodeDecodeError as error:
        if error.start < len(start) - 8:
            return False
        words = start[: error.start].decode()
    return bool(words) and all(sign.isprintable() or sign in "\t\r\n" for sign in words)
