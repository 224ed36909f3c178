"""Messages that other programs publish and that say the same everywhere: fixes, IMU, events.

A message about speed is not among them: a ``geometry_msgs/TwistStamped`` may be what was asked for
or what was measured, by satellites or by the wheels. A profile says which.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.ingest.clock import NO_ACCURACY
from trainlog.ingest.recording import BoolArray, FloatArray, Table
from trainlog.topics import EVENTS, GNSS_FIX, IMU

Reading = tuple[dict[str, FloatArray], dict[str, NDArray[np.object_]]]
"""Signals and texts as in a `Table`."""

Preset = Callable[[pd.DataFrame], Reading]

_NO_FIX = -1
"""sensor_msgs/NavSatStatus: unable to fix position."""

_COVARIANCE_UNKNOWN = 0
"""Of sensor_msgs/NavSatFix and foxglove.LocationFix."""

_LEVELS = {
    "foxglove": {level: level for level in range(6)},
    "ros1": {1: 1, 2: 2, 4: 3, 8: 4, 16: 5},
    "ros2": {10: 1, 20: 2, 30: 3, 40: 4, 50: 5},
}
"""Levels of events, as ours, which are foxglove.Log's."""


def _number(frame: pd.DataFrame, path: str) -> FloatArray:
    """A column as numbers, NaN where it has none."""
    if path not in frame:
        return np.full(len(frame), np.nan)
    column = frame[path]
    if not pd.api.types.is_numeric_dtype(column.dtype):
        return np.full(len(frame), np.nan)
    return column.to_numpy(dtype=np.float64, na_value=np.nan)


def _fix(frame: pd.DataFrame) -> Reading:
    kind = _number(frame, "position_covariance_type")
    east, north, up = (_number(frame, f"position_covariance[{at}]") for at in (0, 4, 8))
    known = kind != _COVARIANCE_UNKNOWN
    with np.errstate(over="ignore", invalid="ignore"):
        horizontal = (east + north) / 2.0
    signals = {
        "latitude": _number(frame, "latitude"),
        "longitude": _number(frame, "longitude"),
        "altitude": _number(frame, "altitude"),
        # A receiver that says that it has no position has the accuracy that means so.
        "horizontal_accuracy": np.where(
            _number(frame, "status.status") <= _NO_FIX,
            NO_ACCURACY,
            _deviation(horizontal, known),
        ),
        "vertical_accuracy": _deviation(up, known),
    }
    return {f"{GNSS_FIX.name}.{name}": values for name, values in signals.items()}, {}


def _deviation(variance: FloatArray, known: BoolArray) -> FloatArray:
    """Standard deviation; a variance that is negative or not known has none."""
    usable = known & (variance >= 0.0)
    return np.where(usable, np.sqrt(np.where(usable, variance, 0.0)), np.nan)


def _imu(frame: pd.DataFrame) -> Reading:
    signals = {}
    for ours, theirs in (
        ("specific_force", "linear_acceleration"),
        ("angular_rate", "angular_velocity"),
    ):
        # A first covariance of -1 says that the sensor does not measure this at all.
        absent = _number(frame, f"{theirs}_covariance[0]") == -1.0
        for axis in "xyz":
            values = _number(frame, f"{theirs}.{axis}")
            signals[f"{IMU.name}.{ours}_{axis}"] = np.where(absent, np.nan, values)
    return signals, {}


def _events(levels: str, message: str) -> Preset:
    def read(frame: pd.DataFrame) -> Reading:
        known = _LEVELS[levels]
        level = np.array([float(known.get(each, 0)) for each in _number(frame, "level").tolist()])
        texts = {"message": _words(frame, message), "name": _words(frame, "name")}
        return (
            {f"{EVENTS.name}.level": level},
            {f"{EVENTS.name}.{name}": words for name, words in texts.items()},
        )

    return read


def _words(frame: pd.DataFrame, path: str) -> NDArray[np.object_]:
    column: Any = frame.get(path)
    if column is None:
        return np.full(len(frame), "", dtype=np.object_)
    return np.array(["" if pd.isna(text) else str(text) for text in column], dtype=np.object_)


PRESETS: dict[str, tuple[str, Preset]] = {
    "sensor_msgs/NavSatFix": (GNSS_FIX.name, _fix),
    "foxglove.LocationFix": (GNSS_FIX.name, _fix),
    "foxglove_msgs/LocationFix": (GNSS_FIX.name, _fix),
    "sensor_msgs/Imu": (IMU.name, _imu),
    "rosgraph_msgs/Log": (EVENTS.name, _events("ros1", "msg")),
    "rcl_interfaces/Log": (EVENTS.name, _events("ros2", "msg")),
    "foxglove.Log": (EVENTS.name, _events("foxglove", "message")),
    "foxglove_msgs/Log": (EVENTS.name, _events("foxglove", "message")),
}
"""Our topic, and how its columns are found, by the schema's name without ``/msg/``."""


def preset_of(schema: str) -> tuple[str, Preset] | None:
    """Our topic for a schema, and how its columns are found; None if it says nothing for sure."""
    return PRESETS.get(schema.replace("/msg/", "/"))


def table_of(time: Any, frame: pd.DataFrame, read: Preset) -> Table:
    """The table that a preset makes of a frame, its rows counted from 1."""
    signals, texts = read(frame)
    return Table(time, np.arange(1, len(frame) + 1, dtype=np.int64), signals, texts)
