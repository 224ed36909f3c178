"""Frames of topics from the repaired tables of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from trainlog.arrays import BoolArray, IntArray
from trainlog.ingest.recording import Table, field_of
from trainlog.topics import EVENTS, TOPICS, Topic
from trainlog.trip import frame_of

INFO = 2.0
"""Level of an event whose column gives none."""


def frames(
    tables: list[Table], constants: dict[str, float | str], own: Mapping[str, Topic]
) -> dict[str, pd.DataFrame]:
    """One frame a topic, in the order of the table of topics; behind them the recorder's `own`.

    A row without a value of a topic is no row of its frame. A constant fills the rows of its
    topic; where the topic has nothing else, it stands at both ends of the trip.
    """
    found: dict[str, pd.DataFrame] = {}
    for name, topic in {**TOPICS, **own}.items():
        fixed = _of_topic(constants, name)
        for table in tables:
            frame = _frame(topic, table, fixed)
            if frame is not None:
                found[name] = frame
        if fixed and name not in found:
            ends = np.array([min(t.time[0] for t in tables), max(t.time[-1] for t in tables)])
            found[name] = frame_of(topic, _index(ends), _filled(fixed, 2))
    return found


def _frame(topic: Topic, table: Table, fixed: dict[str, Any]) -> pd.DataFrame | None:
    """The frame of a topic that a table gives; None if it has no value of it."""
    signals = _of_topic(table.signals, topic.name)
    texts = _of_topic(table.texts, topic.name)
    present = _any([np.isfinite(values) for values in signals.values()], len(table))
    if texts:
        present = _any([words != "" for words in texts.values()], len(table))
    if not present.any():
        return None
    data = {name: column[present] for name, column in {**signals, **texts}.items()}
    count = int(present.sum())
    if topic is EVENTS:
        level = np.nan_to_num(data.get("level", np.full(count, INFO)), nan=INFO)
        data["level"] = level.astype(np.int64)
    return frame_of(topic, _index(table.time[present]), {**_filled(fixed, count), **data})


def _any(masks: list[BoolArray], count: int) -> BoolArray:
    return np.logical_or.reduce(masks) if masks else np.zeros(count, dtype=np.bool_)


def _filled(fixed: dict[str, Any], count: int) -> dict[str, Any]:
    return {name: np.full(count, value) for name, value in fixed.items()}


def _index(time: IntArray) -> pd.DatetimeIndex:
    return pd.DatetimeIndex(time.view("datetime64[ns]"), tz="UTC")


def _of_topic(columns: Mapping[str, Any], topic: str) -> dict[str, Any]:
    """The entries of one topic, by column instead of by ``"/topic.column"``."""
    located = {name: field_of(name) for name in columns}
    return {
        column: columns[name] for name, (owner, column, _) in located.items() if owner.name == topic
    }
