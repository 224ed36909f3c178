"""Where the train was in each chunk: the index that finds a stretch of the line in a long log.

A metadata record holds it, `POSITIONS_RECORD`: for each topic that tells the train's position, one
entry a chunk that has messages of the topic. An entry is four little-endian words of eight bytes:
where the chunk begins in the file and the log time of its first message, as integers, and the
least and the greatest position, as doubles, NaN if none is known. The entries follow each other,
in base64. A file without the record is read no differently, only slower.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from trainlog.mcap.codec import sample_codec
from trainlog.mcap.schemas import WireField
from trainlog.topics import TOPICS
from trainlog.trip import POSITION_TOPICS

Range = tuple[float, float]
"""Least and greatest position [m]; NaN if none is known."""

Entry = tuple[int, int, float, float]
"""Where a chunk begins, the log time of its first message [ns], its least and greatest position."""

_ENTRY = np.dtype([("offset", "<u8"), ("start", "<u8"), ("least", "<f8"), ("greatest", "<f8")])


def encoded(entries: Sequence[Entry]) -> str:
    """The entries of a topic as text."""
    return base64.b64encode(np.array(entries, dtype=_ENTRY).tobytes()).decode("ascii")


def decoded(text: str) -> dict[tuple[int, int], Range]:
    """The positions by offset and start of the chunk; empty if the text is no such index."""
    try:
        data = base64.b64decode(text, validate=True)
        entries = np.frombuffer(data, dtype=_ENTRY).tolist()
    except (binascii.Error, ValueError):
        return {}
    return {(offset, start): (least, greatest) for offset, start, least, greatest in entries}


def range_in(topic: str, data: NDArray[np.uint8], offsets: NDArray[np.int64]) -> Range | None:
    """The positions of a topic's messages in a chunk that is being written; None if it has none."""
    place = _place(topic)
    if place is None or not len(offsets):
        return None
    windows = np.ndarray((len(data) - 7,), "V8", data, 0, (1,))
    values = windows[offsets + place].view(np.float64)
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)


@cache
def _place(topic: str) -> int | None:
    """Where the position stands in a message as this version writes it; None if it has none."""
    if topic not in POSITION_TOPICS:
        return None
    fields = [
        WireField(item.name, number, item.per_axle)
        for number, item in enumerate(TOPICS[topic].fields, start=1)
    ]
    return sample_codec(1, fields, {}).layout.place("position")
