"""Messages of numbers: ``trainlog.*`` and ``foxglove.LocationFix``, as arrays.

A codec knows one channel: it turns a frame into message records and records into columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.mcap.layout import LOG_TIME, PUBLISH_TIME, SEQUENCE, Layout, Value, layout, varint
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

    def encode(self, frame: pd.DataFrame) -> NDArray[np.void]:
        """The message records of the frame's rows."""

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

    def encode(self, frame: pd.DataFrame) -> NDArray[np.void]:
        """The message records of the frame's rows."""
        rows = _stamped(self.layout, frame)
        for field in self.fields:
            if not field.repeated:
                rows[field.name] = _doubles(frame, field.name)
            for axle in range(self.axles.get(field.name, 0)):
                rows[field.name][:, axle] = _doubles(frame, f"{field.name}_{axle + 1}")
        return rows

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

    def encode(self, frame: pd.DataFrame) -> NDArray[np.void]:
        """The message records of the frame's rows."""
        rows = _stamped(self.layout, frame)
        for name in ("latitude", "longitude", "altitude"):
            rows[name] = _doubles(frame, name)
        horizontal = _doubles(frame, "horizontal_accuracy")
        vertical = _doubles(frame, "vertical_accuracy")
        with np.errstate(over="ignore", under="ignore"):
            rows["east"] = rows["north"] = horizontal**2
            rows["up"] = vertical**2
        known = ~(np.isnan(horizontal) & np.isnan(vertical))
        rows["covariance_type"] = np.where(known, _DIAGONAL_KNOWN, _UNKNOWN)
        seconds, nanoseconds = np.divmod(rows[LOG_TIME], np.uint64(10**9))
        rows["seconds"] = _padded_varint(seconds)
        rows["nanoseconds"] = _padded_varint(nanoseconds)
        return rows

    def columns(self, rows: NDArray[np.void]) -> Columns | None:
        """The columns that message records hold; None if the covariance type is a longer varint."""
        kind = rows["covariance_type"]
        if np.any(kind > _KNOWN):
            return None
        found = {name: rows[name] for name in ("latitude", "longitude", "altitude")}
        return found | accuracies(kind, rows["east"], rows["north"], rows["up"])


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


def _stamped(form: Layout, frame: pd.DataFrame) -> NDArray[np.void]:
    """Records for the frame's rows with their times and sequence numbers."""
    rows = form.rows(len(frame))
    time = pd.DatetimeIndex(frame.index).as_unit("ns").asi8
    rows[LOG_TIME] = rows[PUBLISH_TIME] = time
    rows[SEQUENCE] = np.arange(len(frame), dtype=np.uint64).astype(np.uint32)
    return rows


def _doubles(frame: pd.DataFrame, column: str) -> NDArray[np.float64]:
    """A column as doubles: NaN where it is absent, and one bit pattern for every NaN.

    Raises
    ------
    LogError
        If the column holds something that is not a number.
    """
    if column not in frame:
        return np.full(len(frame), np.nan)
    try:
        values = frame[column].to_numpy(dtype=np.float64, na_value=np.nan)
    except (TypeError, ValueError) as error:
        raise LogError(
            f"column {column} holds something that is not a number",
            place=frame.attrs.get("topic"),
            remedy="give numbers in SI units, NaN where there is none",
        ) from error
    return np.where(np.isnan(values), np.nan, values)


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
