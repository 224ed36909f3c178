"""The loop of reading: each message of a layout is touched once, its values go to their columns.

Compiled, and run without the GIL. Loading the compiler takes half a second, so short logs are read
with numpy instead (`trainlog.mcap.tables`).
"""

# The decorators of numba carry no types; it chooses the arguments of an intrinsic.
# mypy: disable-error-code="untyped-decorator, import-untyped"
# ruff: noqa: ARG001

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

_LOG_TIME_AT = 15
"""Where the log time stands in a message record."""


@intrinsic
def _word(context: Any, address: Any) -> Any:
    """The eight bytes at an address, which need not be a multiple of eight."""

    def load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(builder.inttoptr(arguments[0], ir.IntType(64).as_pointer()), align=1)

    return types.uint64(types.uintp), load


@intrinsic
def _double(context: Any, address: Any) -> Any:
    """The double at an address, which need not be a multiple of eight."""

    def load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(builder.inttoptr(arguments[0], ir.DoubleType().as_pointer()), align=1)

    return types.float64(types.uintp), load


@njit(nogil=True, cache=True)
def gather_columns(
    content: NDArray[np.uint8],
    offsets: NDArray[np.uint64],
    size: int,
    constants: NDArray[np.uint64],
    places: NDArray[np.int64],
    time: NDArray[np.uint64],
    columns: NDArray[np.float64],
    rows: NDArray[np.int64],
    start: int,
) -> bool:
    """Take the values of messages to their columns; False if one does not fit the layout.

    Parameters
    ----------
    content : (bytes,) uint8
        Of a chunk, decompressed.
    offsets : (n,) uint64
        Where the message records begin.
    size : int
        Of a record [bytes].
    constants : (k, 3) uint64
        Place in the record, mask and value of words with constant bytes.
    places : (m,) int64
        Where the values stand in a record.
    time : (rows,) uint64
        Takes the log times, from `start` on.
    columns : (columns, rows) float64
        Takes the values, from `start` on.
    rows : (m,) int64
        For each value, its column.
    start : int
    """
    base = content.ctypes.data
    if len(content) < size:
        return len(offsets) == 0
    last = np.uint64(len(content) - size)
    wrong = np.uint64(0)
    for message in range(len(offsets)):
        if offsets[message] > last:
            return False
        address = base + np.int64(offsets[message])
        for number in range(len(constants)):
            word = _word(np.uintp(address + np.int64(constants[number, 0])))
            wrong |= (word & constants[number, 1]) ^ constants[number, 2]
        time[start + message] = _word(np.uintp(address + _LOG_TIME_AT))
        for number in range(len(places)):
            columns[rows[number], start + message] = _double(np.uintp(address + places[number]))
    return bool(wrong == 0)
