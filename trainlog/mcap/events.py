"""Events: ``foxglove.Log`` messages, whose texts differ in length."""

from __future__ import annotations

import numpy as np
import pandas as pd
from foxglove_schemas_protobuf.Log_pb2 import Log
from mcap.opcode import Opcode

from trainlog.errors import LogError
from trainlog.mcap.layout import MESSAGE, RECORD_HEAD

HIGHEST_LEVEL = 5
"""foxglove.Log.FATAL."""


def encode_events(channel: int, frame: pd.DataFrame) -> list[bytes]:
    """The message records of an event frame's rows, their sequence numbers zero.

    Raises
    ------
    LogError
        If a level is none of foxglove.Log's, or a text cannot be written as UTF-8.
    """
    times = pd.DatetimeIndex(frame.index).as_unit("ns").asi8.tolist()
    texts = zip(_texts(frame, "message"), _texts(frame, "name"), strict=True)
    return [
        event_record(channel, time, level, message, name)
        for time, level, (message, name) in zip(times, _levels(frame), texts, strict=True)
    ]


def event_record(channel: int, time: int, level: int, message: str, name: str) -> bytes:
    """The message record of one event, its sequence number zero."""
    log = Log(level=Log.Level.ValueType(level), message=message, name=name)
    log.timestamp.seconds, log.timestamp.nanos = divmod(time, 10**9)
    data = log.SerializeToString(deterministic=True)
    length = MESSAGE.size - RECORD_HEAD + len(data)
    return MESSAGE.pack(Opcode.MESSAGE, length, channel, 0, time, time) + data


def _levels(frame: pd.DataFrame) -> list[int]:
    if "level" not in frame:
        return [int(Log.UNKNOWN)] * len(frame)
    levels = frame["level"].to_numpy(dtype=np.float64, na_value=np.nan)
    wrong = np.flatnonzero(~np.isin(levels, range(HIGHEST_LEVEL + 1)))
    if len(wrong):
        raise LogError(
            f"{frame['level'].iloc[wrong[0]]} is not a level of an event",
            place=f"row {wrong[0]}, column level",
            remedy=f"give a whole number from 0 to {HIGHEST_LEVEL}",
        )
    return [int(level) for level in levels]


def _texts(frame: pd.DataFrame, column: str) -> list[str]:
    if column not in frame:
        return [""] * len(frame)
    texts = ["" if pd.isna(text) else str(text) for text in frame[column]]
    for row, text in enumerate(texts):
        try:
            text.encode()
        except UnicodeEncodeError as error:
            raise LogError(
                "the text cannot be written as UTF-8",
                place=f"row {row}, column {column}",
                remedy="remove the broken characters",
            ) from error
    return texts
