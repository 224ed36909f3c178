"""Arrays and facts in a few bytes: exact, and the same bytes for the same values."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trainlog.arrays import FloatArray, IntArray

_WHOLE = ("u1", "i1", "<u2", "<i2", "<i4", "<i8")
"""Types in which whole numbers are kept: the first that holds them all."""

_EXACT = 2.0**53
"""Up to here doubles hold every whole number."""

_KINDS = {"i": np.int64, "u": np.int64, "f": np.float64, "b": np.bool_}
_LENGTH = struct.Struct("<I")
_Kept = tuple[str, str, NDArray[Any]]
"""How the numbers of an array are kept, and these."""


def pack(facts: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Facts, and arrays of whole numbers, truth values or doubles.

    First come four bytes with the length of what follows, little-endian: JSON with the `facts`, and
    of each of the ``arrays`` its name, its type (``i``, ``f``, ``b``), its shape, the type of the
    numbers kept, and how: ``all``, ``steps`` (each less the one before) or ``one`` that all are.
    Behind it the numbers themselves, one array after the other.

    Examples
    --------
    >>> data = pack({"bins": 4}, {"bin": np.array([0, 1, 3]), "weight": np.array([0.5, 2.0, 1.0])})
    >>> facts, arrays = unpack(data)
    >>> facts, arrays["bin"], arrays["weight"]
    ({'bins': 4}, array([0, 1, 3]), array([0.5, 2. , 1. ]))
    """
    listed, kept = [], []
    for name, array in arrays.items():
        form, how, values = _least(array)
        listed.append([name, array.dtype.kind, list(array.shape), form, how])
        kept.append(values.tobytes())
    content = {"arrays": listed, "facts": dict(facts)}
    head = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    return b"".join([_LENGTH.pack(len(head)), head, *kept])


def unpack(data: bytes) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Facts and arrays, the latter of int64, float64 or bool.

    Raises
    ------
    ValueError
        If the data are none that `pack` made.
    """
    arrays: dict[str, NDArray[Any]] = {}
    try:
        (length,) = _LENGTH.unpack_from(data)
        start = _LENGTH.size + length
        content = json.loads(data[_LENGTH.size : start])
        for name, kind, shape, form, how in content["arrays"]:
            size = math.prod(shape)
            kept = np.frombuffer(data, form, min(size, 1) if how == "one" else size, start)
            start += kept.nbytes
            values: NDArray[Any] = kept.astype(_KINDS[kind])
            if how == "one":
                values = np.repeat(values, size)
            arrays[name] = (np.cumsum(values) if how == "steps" else values).reshape(shape)
        return content["facts"], arrays
    except (KeyError, TypeError, struct.error) as error:
        raise ValueError(str(error)) from error


def unpack_joined(
    many: Sequence[bytes],
) -> tuple[list[dict[str, Any]], dict[str, NDArray[Any]]]:
    """Facts of each, and their arrays, one behind the other.

    Raises
    ------
    ValueError
        If they are none that `pack` made, or of different arrays.

    Examples
    --------
    >>> many = [pack({"trip": n}, {"bin": np.arange(2) + 7 * n}) for n in range(3)]
    >>> facts, arrays = unpack_joined(many)
    >>> facts[1], arrays["bin"]
    ({'trip': 1}, array([ 0,  1,  7,  8, 14, 15]))
    """
    facts, arrays = zip(*map(unpack, many), strict=True)
    if any(each.keys() != arrays[0].keys() for each in arrays):
        raise ValueError("their arrays differ")
    return list(facts), {n: np.concatenate([each[n] for each in arrays]) for n in arrays[0]}


def _least(array: NDArray[Any]) -> _Kept:
    """Type of the numbers kept, how they are kept, and these, in the fewest bytes."""
    flat = np.ascontiguousarray(array).ravel()
    if flat.dtype.kind == "f" and not _are_whole(flat):
        same = flat.size > 0 and bool(np.all(flat.view(np.int64) == flat.view(np.int64)[0]))
        return "<f8", "one" if same else "all", flat[:1] if same else flat
    whole = flat.astype(np.int64)
    if whole.size and np.all(whole == whole[0]):
        return _form(whole[:1]), "one", whole[:1].astype(_form(whole[:1]))
    steps = np.diff(whole, prepend=0)
    chosen = min(
        ("all", whole), ("steps", steps), key=lambda each: np.dtype(_form(each[1])).itemsize
    )
    form = _form(chosen[1])
    return form, chosen[0], chosen[1].astype(form)


def _are_whole(values: FloatArray) -> bool:
    """Whether int64 holds them as exactly; minus zero has no whole number."""
    return bool(
        np.all(np.abs(values) < _EXACT)
        and np.all(np.rint(values) == values)
        and not np.any(np.signbit(values) & (values == 0.0))
    )


def _form(values: IntArray) -> str:
    if not values.size:
        return _WHOLE[0]
    low, high = int(values.min()), int(values.max())
    return next(form for form in _WHOLE if np.iinfo(form).min <= low and high <= np.iinfo(form).max)
