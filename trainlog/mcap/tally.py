"""What a chunk holds, counted by its records and not by what its indexes say."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.mcap.codec import MESSAGE, RECORD_HEAD
from trainlog.mcap.records import Index, gone_through, records

_HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("time", "<u8")]
)
_LEAST = MESSAGE.size - RECORD_HEAD


@dataclass(frozen=True)
class Tally:
    """What a chunk holds.

    Attributes
    ----------
    index : dict of int to (n, 2) uint64 array
        Log time and offset of each message by channel id.
    listed : bool
        Whether the index that was given lists every message, and nothing else.
    start, end : int
        Earliest and latest log time [ns]; zero without messages.
    declared : tuple of (int, memoryview)
        Opcode and content of the schemas and channels among the records.
    """

    index: Index
    listed: bool
    start: int
    end: int
    declared: tuple[tuple[int, memoryview], ...]

    @property
    def counts(self) -> dict[int, int]:
        """Number of messages by channel id."""
        return {channel: len(entries) for channel, entries in self.index.items()}


def tally(content: bytes, given: Index, offset: int) -> Tally:
    """Count what a chunk holds.

    Parameters
    ----------
    content : bytes
        The chunk's content, decompressed.
    given : Index
        Its message indexes as the file has them; may be empty or wrong.
    offset : int
        Where the chunk stands in the file, for errors.

    Raises
    ------
    LogError
        If the content is not one record after the other.
    """
    given = {channel: entries for channel, entries in given.items() if len(entries)}
    with suppress(LogError):
        declared = _others(content, given) if given else None
        if declared is not None:
            return _summed(given, declared, listed=True)
    index, declared = gone_through(content, offset)
    return _summed(index, declared, listed=not index and not given)


def _summed(index: Index, declared: list[tuple[int, memoryview]], *, listed: bool) -> Tally:
    start = min((int(entries[:, 0].min()) for entries in index.values()), default=0)
    end = max((int(entries[:, 0].max()) for entries in index.values()), default=0)
    return Tally(index, listed, start, end, tuple(declared))


def _others(content: bytes, given: Index) -> list[tuple[int, memoryview]] | None:
    """The records besides the messages that the index lists; None if it is not exact.

    It is exact if the messages that it lists, and other records between them, fill the chunk.
    """
    channel = np.concatenate([np.full(len(each), number) for number, each in given.items()])
    time, start = np.concatenate(list(given.values())).T
    if int(start.max()) > len(content) - MESSAGE.size:
        return None
    order = np.argsort(start, kind="stable")
    channel, time, start = channel[order], time[order], start[order].astype(np.int64)
    rows = _heads(content)[start].view(_HEAD)
    length = rows["length"]
    if (
        np.any(length > len(content))
        or np.any(length < _LEAST)
        or np.any(rows["opcode"] != Opcode.MESSAGE)
        or np.any(rows["channel"] != channel)
        or np.any(rows["time"] != time)
    ):
        return None
    end = start + RECORD_HEAD + length.astype(np.int64)
    ends = np.concatenate([[0], end])
    starts = np.concatenate([start, [len(content)]])
    if np.any(ends > starts):
        return None
    found = []
    view = memoryview(content)
    for gap in np.flatnonzero(ends < starts).tolist():
        for _, opcode, body in records(view[int(ends[gap]) : int(starts[gap])]):
            if opcode == Opcode.MESSAGE:
                return None
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                found.append((opcode, body))
    return found


def _heads(content: bytes) -> NDArray[np.void]:
    """Every window of the content that is as long as a message's head."""
    size = _HEAD.itemsize
    return np.ndarray((len(content) - size + 1,), f"V{size}", content, 0, (1,))
