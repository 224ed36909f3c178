"""The loops of writing: records laid out in a chunk, and messages put in order.

Compiled, and run without the GIL, so that threads fill several chunks at a time.
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator"

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

_SEQUENCE_AT, _LOG_TIME_AT, _PUBLISH_TIME_AT = 11, 15, 23
"""Where they stand in a message record."""

# Unsigned throughout: a signed index is first compared with zero, which keeps the eight bytes of a
# word from being stored at once.
_U = np.uint64


@njit(nogil=True, cache=True, inline="always")
def _store(data: NDArray[np.uint8], at: np.uint64, word: np.uint64) -> None:
    data[at] = np.uint8(word)
    data[at + _U(1)] = np.uint8(word >> _U(8))
    data[at + _U(2)] = np.uint8(word >> _U(16))
    data[at + _U(3)] = np.uint8(word >> _U(24))
    data[at + _U(4)] = np.uint8(word >> _U(32))
    data[at + _U(5)] = np.uint8(word >> _U(40))
    data[at + _U(6)] = np.uint8(word >> _U(48))
    data[at + _U(7)] = np.uint8(word >> _U(56))


@njit(nogil=True, cache=True)
def fill(
    data: NDArray[np.uint8],
    offsets: NDArray[np.int64],
    time: NDArray[np.int64],
    sequence: NDArray[np.uint32],
    template: NDArray[np.uint8],
    words: NDArray[np.uint64],
    places: NDArray[np.int64],
) -> None:
    """Lay records out at `offsets` of a chunk; see `trainlog.mcap.fill.FixedRecords`."""
    magnitude, infinity, nan = _U(2**63 - 1), _U(0x7FF << 52), _U(0x7FF8 << 48)
    for row in range(offsets.size):
        at = _U(offsets[row])
        for byte in range(template.size):
            data[at + _U(byte)] = template[byte]
        # Eight bytes, of which the log time takes back four.
        _store(data, at + _U(_SEQUENCE_AT), _U(sequence[row]))
        _store(data, at + _U(_LOG_TIME_AT), _U(time[row]))
        _store(data, at + _U(_PUBLISH_TIME_AT), _U(time[row]))
        for column in range(places.size):
            word = words[column, row]
            if word & magnitude > infinity:
                word = nan
            _store(data, at + _U(places[column]), word)


@njit(nogil=True, cache=True)
def interleave(
    time: NDArray[np.int64],
    sizes: NDArray[np.int64],
    starts: NDArray[np.int64],
    period: int,
    largest: int,
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """The order of the messages of several streams, cut into chunks.

    Messages stand in the order of time, those of the same time in the order of the streams. A
    chunk is closed before the message that would make it longer than `largest`, and before the
    one that lies `period` behind its first.

    Parameters
    ----------
    time : (n,) int64
        Of the streams one after the other, each never decreasing [ns].
    sizes : (n,) int64
        Length of each message's record [bytes].
    starts : (streams + 1,) int64
        Where each stream begins, and n.
    period : int
        [ns]
    largest : int
        [bytes]

    Returns
    -------
    chunk : (n,) int32
        Number of the chunk that each message belongs to.
    offset : (n,) int64
        Where it stands in there.
    """
    heads = starts[:-1].copy()
    chunk = np.empty(time.size, np.int32)
    offset = np.empty(time.size, np.int64)
    number, filled, opened = -1, largest, np.int64(0)
    for _ in range(time.size):
        following, earliest = -1, np.int64(2**63 - 1)
        for stream in range(heads.size):
            head = heads[stream]
            if head < starts[stream + 1] and (following < 0 or time[head] < earliest):
                following, earliest = stream, time[head]
        row = heads[following]
        heads[following] += 1
        if number < 0 or filled + sizes[row] > largest or earliest - opened >= period:
            number, filled, opened = number + 1, 0, earliest
        chunk[row], offset[row] = number, filled
        filled += sizes[row]
    return chunk, offset
