"""Messages of numbers: ``trainlog.*`` and ``foxglove.LocationFix``, as arrays.

A codec knows one channel: it turns columns into message records and records into columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.mcap.fill import FixedRecords
from trainlog.mcap.layout import Layout, Value, layout, varint
from trainlog.mcap.schemas import WireField

Columns = dict[str, Any]
"""Arrays of values by column of the frame."""

_DOUBLE = 1
_LENGTH_DELIMITED = 2
"""Protobuf wire types."""


class Codec(Protocol):
    """What one channel's messages look like."""

    @property
    def layout(self) -> Layout:
        """Where the bytes of a message are."""

    @property
    def names(self) -> list[str]:
        """The columns that a frame of the channel has in full."""

    def encode(self, time: NDArray[np.int64], table: NDArray[np.float64]) -> FixedRecords:
        """The message records of a table: one row a column of `names`, one column a message."""

    def columns(self, rows: NDArray[np.void]) -> Columns | None:
        """The columns that message records hold; None if they do not fit after all."""


@dataclass(frozen=True)
class SampleCodec:
    """A ``trainlog.*`` message: one double a field, several for a field with axles.

    Attributes
    ----------
    layout : Layout
    fields : tuple of WireField
    axles : dict of str to int
        How many values each repeated field has in every message of the channel.
    """

    layout: Layout
    fields: tuple[WireField, ...]
    axles: dict[str, int]

    @property
    def names(self) -> list[str]:
        """The columns that a frame of the channel has in full."""
        return [name for name, _ in self._places()]

    def encode(self, time: NDArray[np.int64], table: NDArray[np.float64]) -> FixedRecords:
        """The message records of a table: one row a column of `names`, one column a message."""
        places = [place for _, place in self._places()]
        return _records(self.layout, table, places, np.empty((len(time), 0), np.uint8), [])

    def _places(self) -> Iterator[tuple[str, int]]:
        """Each column and where its value stands in a record."""
        for field in self.fields:
            if not field.repeated:
                yield field.name, self.layout.place(field.name)
            for axle in range(self.axles.get(field.name, 0)):
                yield f"{field.name}_{axle + 1}", self.layout.place(field.name) + 8 * axle

    def columns(self, rows: NDArray[np.void]) -> Columns:
        """The columns that message records hold."""
        found: Columns = {}
        for field in self.fields:
            if not field.repeated:
                found[field.name] = rows[field.name]
            for axle in range(self.axles.get(field.name, 0)):
                found[f"{field.name}_{axle + 1}"] = rows[field.name][:, axle]
        return found


def sample_codec(channel: int, fields: Sequence[WireField], axles: dict[str, int]) -> SampleCodec:
    """Codec of a ``trainlog.*`` channel from the fields of its message."""
    body: list[bytes | Value] = []
    for field in fields:
        count = axles.get(field.name, 0)
        if not field.repeated:
            body += [varint(field.number << 3 | _DOUBLE), Value(field.name, "<f8")]
        elif count:
            tag = varint(field.number << 3 | _LENGTH_DELIMITED)
            body += [tag + varint(8 * count), Value(field.name, "<f8", count)]
    return SampleCodec(layout(channel, body), tuple(fields), dict(axles))


@dataclass(frozen=True)
class FixCodec:
    """A ``foxglove.LocationFix``: accuracies are the diagonal of the position covariance."""

    layout: Layout

    @property
    def names(self) -> list[str]:
        """The columns that a frame of the channel has in full."""
        return ["latitude", "longitude", "altitude", "horizontal_accuracy", "vertical_accuracy"]

    def encode(self, time: NDArray[np.int64], table: NDArray[np.float64]) -> FixedRecords:
        """The message records of a table: one row a column of `names`, one column a message."""
        with np.errstate(over="ignore", under="ignore"):
            horizontal, vertical = table[3:] ** 2
        words = np.stack([*table[:3], horizontal, horizontal, vertical])
        places = [self.layout.place(name) for name in _FIX_WORDS]
        kind = np.where(np.all(np.isnan(table[3:]), axis=0), _UNKNOWN, _DIAGONAL_KNOWN)
        seconds, nanoseconds = np.divmod(time.astype(np.uint64), np.uint64(10**9))
        octets = np.concatenate(
            [kind.astype(np.uint8)[:, None], _padded_varint(seconds), _padded_varint(nanoseconds)],
            axis=1,
        )
        stamps = (self.layout.place("seconds"), self.layout.place("nanoseconds"))
        octet_places = [self.layout.place("covariance_type")]
        octet_places += [stamp + byte for stamp in stamps for byte in range(5)]
        return _records(self.layout, words, places, octets, octet_places)

    def columns(self, rows: NDArray[np.void]) -> Columns | None:
        """The columns that message records hold; None if the covariance type is a longer varint."""
        kind = rows["covariance_type"]
        if np.any(kind > _KNOWN):
            return None
        found = {name: rows[name] for name in ("latitude", "longitude", "altitude")}
        return found | accuracies(kind, rows["east"], rows["north"], rows["up"])


_FIX_WORDS = ("latitude", "longitude", "altitude", "east", "north", "up")
"""The doubles of a position, in the order in which `FixCodec.encode` gives them."""

_UNKNOWN, _DIAGONAL_KNOWN, _KNOWN = 0, 2, 3
"""Values of LocationFix.PositionCovarianceType."""


def fix_codec(channel: int) -> FixCodec:
    """Codec of a ``foxglove.LocationFix`` channel.

    The time stamp's two varints are padded to five bytes, enough for the year 2262; protobuf reads
    them like shorter ones.
    """
    zeros = bytes(8 * 3)
    body: list[bytes | Value] = [
        b"\x09",
        Value("latitude", "<f8"),
        b"\x11",
        Value("longitude", "<f8"),
        b"\x19",
        Value("altitude", "<f8"),
        b"\x22" + varint(8 * 9),
        Value("east", "<f8"),
        zeros,
        Value("north", "<f8"),
        zeros,
        Value("up", "<f8"),
        b"\x28",
        Value("covariance_type", "<u1"),
        b"\x32\x0c\x08",
        Value("seconds", "<u1", 5),
        b"\x10",
        Value("nanoseconds", "<u1", 5),
    ]
    return FixCodec(layout(channel, body))


def table_of(frame: pd.DataFrame, names: Sequence[str]) -> NDArray[np.float64]:
    """The frame's columns `names` as the rows of a table; NaN where a column is absent.

    Raises
    ------
    LogError
        If a column holds something that is not a number.
    """
    if list(frame.columns) == list(names) and bool((frame.dtypes == np.float64).all()):
        # The frame's own memory, as pandas keeps columns of one kind.
        return np.ascontiguousarray(frame.to_numpy().T)
    table = np.full((len(names), len(frame)), np.nan)
    for row, name in zip(table, names, strict=True):
        if name in frame:
            row[:] = _doubles(frame, name)
    return table


def _doubles(frame: pd.DataFrame, column: str) -> NDArray[np.float64]:
    try:
        return frame[column].to_numpy(dtype=np.float64, na_value=np.nan)
    except (TypeError, ValueError) as error:
        raise LogError(
            f"column {column} holds something that is not a number",
            place=frame.attrs.get("topic"),
            remedy="give numbers in SI units, NaN where there is none",
        ) from error


def _records(
    form: Layout,
    words: NDArray[np.float64],
    places: list[int],
    octets: NDArray[np.uint8],
    octet_places: list[int],
) -> FixedRecords:
    return FixedRecords(
        np.frombuffer(form.template, dtype=np.uint8),
        words,
        np.array(places, dtype=np.int64),
        octets,
        np.array(octet_places, dtype=np.int64),
    )


def accuracies(
    kind: NDArray[Any], east: NDArray[Any], north: NDArray[Any], up: NDArray[Any]
) -> Columns:
    """Standard deviations [m] from the covariance's diagonal [m²], NaN where it is not known."""
    with np.errstate(invalid="ignore", over="ignore"):
        horizontal = np.where(kind == _UNKNOWN, np.nan, np.sqrt((east + north) / 2))
        vertical = np.where(kind == _UNKNOWN, np.nan, np.sqrt(up))
    return {"horizontal_accuracy": horizontal, "vertical_accuracy": vertical}


def _padded_varint(numbers: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Each number as a varint of exactly five bytes."""
    shifted = numbers[:, None] >> np.arange(0, 35, 7, dtype=np.uint64)
    more = np.array([0x80, 0x80, 0x80, 0x80, 0], dtype=np.uint64)
    return (shifted & np.uint64(0x7F) | more).astype(np.uint8)
