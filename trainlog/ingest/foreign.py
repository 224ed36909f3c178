"""Format ``mcap``: MCAP files of other programs (ROS bags, Foxglove), mapped to our topics.

Messages that say the same everywhere (fixes, IMU, events) need no profile. A profile names any
other field as ``"/topic:path.to.field[0]"``. A message about speed is never taken by itself: a
``geometry_msgs/TwistStamped`` may be what was asked for or what was measured, by satellites or by
the wheels.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError, suggestion
from trainlog.ingest.clock import NO_ACCURACY
from trainlog.ingest.mapping import EARLIEST, LATEST, in_si, read_time, recording_of
from trainlog.ingest.profile import Column, MismatchError, Profile, TimeOptions, default_profile
from trainlog.ingest.recording import (
    NO_TIME,
    SHOWN,
    Cells,
    Finding,
    Raw,
    Recording,
    Table,
    field_of,
)
from trainlog.mcap import ForeignFrames, describe, frames_of
from trainlog.topics import EVENTS, GNSS_FIX, IMU
from trainlog.units import NANOSECONDS

LOG_TIME, PUBLISH_TIME, STAMP = "log_time", "publish_time", "stamp"
"""What [time] of a profile can name besides a path."""

_STAMPS = ("header.stamp", "timestamp", "stamp")
"""Where messages keep their own time."""

_SECONDS, _NANOSECONDS = ("sec", "secs", "seconds"), ("nanosec", "nsecs", "nsec", "nanos")

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


def is_mcap(head: bytes) -> bool:
    """Whether a file begins as MCAP does."""
    return head.startswith(MCAP0_MAGIC)


def read_foreign(path: Path, profile: Profile | None) -> Recording:
    """Read an MCAP file of another program.

    Topics of ours that the profile's [columns] do not name come from messages whose schema is
    known, see `PRESETS`. Rows are counted from 1 in each topic of the file.

    Raises
    ------
    InputError
        If the file is a log of trainlog, nothing in it can be mapped, or it does not fit the
        profile.
    LogError
        If it is no MCAP file.
    """
    described = describe(path)
    if described.schema_version is not None:
        raise InputError(
            "is a log of trainlog, and a trip as it is",
            remedy="give it to the other commands; it need not be brought in",
        )
    options = profile or default_profile()
    presets = {topic.name for topic in described.topics if preset_of(topic.message)}
    named = {_topic(name) for column in options.columns.values() for name in column.names}
    held = Counter[str]()
    for topic in described.topics:
        held[topic.name] += topic.count
    wanted = presets | named | {_plain(name) for name in named}
    found = frames_of(path, topics=wanted & held.keys())
    reader = _Reader(options, found, dict(held))
    reader.read_columns()
    reader.read_presets()
    return reader.recording()


def _topic(source: str) -> str:
    """The topic of ``"/topic:path"``."""
    return source.rpartition(":")[0]


def _plain(name: str) -> str:
    """The topic of ``"/topic (schema)"``, as a topic with several schemas is called."""
    return name.partition(" (")[0]


class _Reader:
    """Tables and findings while the topics of a file are mapped."""

    def __init__(self, profile: Profile, found: ForeignFrames, held: dict[str, int]) -> None:
        self.profile = profile
        self.found = found
        self.held = held
        self.tables: list[Table] = []
        self.findings: list[Finding] = []
        self.raw: list[Raw] = []
        self.constants: dict[str, float | str] = {}
        self.sources: dict[str, list[str]] = {}
        self.rows_read = 0

    def read_columns(self) -> None:
        """Map what the profile names."""
        by_source: dict[str, dict[str, Column]] = {}
        for name, column in self.profile.columns.items():
            if isinstance(column.value, str):
                self.constants[name] = column.value
                continue
            if column.value is not None:
                self.constants[name] = float(in_si(name, column, np.asarray(column.value)))
                continue
            topics = {_topic(source) for source in column.names}
            if len(topics) > 1:
                raise InputError(
                    f'columns."{name}" names fields of several topics',
                    remedy="take all axles of a field from one topic",
                )
            topic = topics.pop()
            if topic not in self.found.frames:
                if column.optional:
                    continue
                raise self._no_topic(column.names[0], topic)
            by_source.setdefault(topic, {})[name] = column
        for topic, columns in by_source.items():
            self._read_source(topic, columns)

    def read_presets(self) -> None:
        """Map what is known by its schema, for the topics of ours that nothing is said of."""
        taken = {field_of(name)[0].name for name in self.profile.columns}
        offers: dict[str, dict[str, Preset]] = {}
        for name, frame in self.found.frames.items():
            preset = preset_of(frame.attrs["schema"])
            if preset is not None and preset[0] not in taken and len(frame):
                offers.setdefault(preset[0], {})[name] = preset[1]
        for ours, presets in offers.items():
            if len(presets) > 1 and ours != EVENTS.name:
                raise InputError(
                    f"{ours} can come from {' or '.join(presets)}",
                    remedy=f"say under [columns] of a profile which fields make {ours}",
                )
            for name, read in presets.items():
                frame, time = self.found.frames[name], self._time(name)
                signals, texts = read(frame)
                rows = np.arange(1, len(frame) + 1, dtype=np.int64)
                self.tables.append(Table(time, rows, signals, texts))
                self.sources.setdefault(ours, []).append(name)
                self.rows_read += len(frame)

    def recording(self) -> Recording:
        """What was mapped; InputError if that is nothing."""
        self._count_skipped()
        if not self.tables:
            listed = ", ".join(list(self.held)[:SHOWN]) or "none at all"
            raise InputError(
                f"holds nothing that can be mapped by itself; its topics: {listed}",
                remedy="give a profile that says which field is what, as in docs/foreign.md",
            )
        used = {_plain(name) for names in self.sources.values() for name in names}
        metadata = {"clock": f"{self._time_name()} of the MCAP file"}
        metadata |= {f"source.{ours}": ", ".join(names) for ours, names in self.sources.items()}
        if not self.found.account.whole:
            metadata["damage"] = "; ".join(self.found.account.lines())
        return Recording(
            tuple(_joined(self.tables)),
            self.rows_read,
            tuple(self.findings),
            self.constants,
            metadata,
            not_used={
                topic: count for topic, count in self.held.items() if topic not in used and count
            },
            raw=tuple(self.raw),
        )

    def _read_source(self, topic: str, columns: dict[str, Column]) -> None:
        """Map the fields of one topic of the file."""
        frame = self.found.frames[topic]
        values: dict[str, Any] = {}
        for name, column in columns.items():
            for source in column.names:
                path = source.rpartition(":")[2]
                series = _values(frame, path)
                if series is not None:
                    values[source] = series
                elif not column.optional:
                    raise MismatchError(
                        f"topic {topic} has no field '{path}' (columns.\"{name}\")",
                        remedy=suggestion(path, [str(each) for each in frame.columns], "fields"),
                    )
        self.rows_read += len(frame)
        for name in columns:
            topics = self.sources.setdefault(field_of(name)[0].name, [])
            topics += [topic] if topic not in topics else []
        if not len(frame) or not values:
            return
        time = self._time(topic)
        table = pa.table(
            {name: pa.Array.from_pandas(series) for name, series in values.items()}
            | {LOG_TIME: pa.array(time, mask=time == NO_TIME)}
        )
        logged = TimeOptions(column=LOG_TIME, format="epoch", unit="ns")
        profile = replace(self.profile, columns=columns, time=logged)
        rows = np.arange(1, len(frame) + 1, dtype=np.int64)
        made = recording_of(Cells(table, rows, rows.size), profile)
        self.tables += made.tables
        self.findings += made.findings
        self.raw += made.raw

    def _count_skipped(self) -> None:
        """Count messages that cannot be decoded."""
        broken = [
            item
            for item in self.found.skipped
            if not item.field and item.topic in self.found.frames and item.messages
        ]
        count = sum(item.messages for item in broken)
        if count:
            note = "; ".join(str(item) for item in broken[:SHOWN])
            self.findings.append(Finding("damaged_messages", count, note=note))
            self.rows_read += count

    def _time_name(self) -> str:
        return self.profile.time.names[0] if self.profile.time else LOG_TIME

    def _time(self, topic: str) -> IntArray:
        """Time of each row of a frame [ns] UTC, as the profile wants it."""
        frame, name = self.found.frames[topic], self._time_name()
        if name == LOG_TIME:
            return _plausible(pd.DatetimeIndex(frame.index).asi8)
        if name == PUBLISH_TIME:
            return _plausible(self.found.publish_times[topic].asi8)
        for path in _STAMPS if name == STAMP else (name,):
            time = _stamp(frame, path)
            if time is not None:
                return time
            if path in frame:
                assert self.profile.time is not None
                table = pa.table({name: pa.Array.from_pandas(frame[path])})
                return read_time(table, self.profile.time, ".")
        raise InputError(
            f"topic {topic} has no time '{name}'",
            remedy=f'set column = "{LOG_TIME}" under [time] of the profile, or a field it has',
        )

    def _no_topic(self, source: str, topic: str) -> InputError:
        if not topic:
            return InputError(
                f"'{source}' does not say which topic it is of",
                remedy='write "/topic:path.to.field"',
            )
        for item in self.found.skipped:
            if item.topic == topic and not item.field:
                return InputError(
                    f"topic {topic} cannot be decoded: {item.reason}",
                    remedy="record it in an encoding that docs/foreign.md lists",
                )
        names = [*self.found.frames, *self.held]
        several = [name for name in self.found.frames if _plain(name) == topic]
        return MismatchError(
            f"no topic '{topic}'" if not several else f"topic {topic} has several schemas",
            remedy=suggestion(topic, dict.fromkeys(several or names), "topics"),
        )


def _values(frame: pd.DataFrame, path: str) -> Any:
    """The column at `path`; of a vector its magnitude; None if there is neither."""
    if path in frame:
        return frame[path]
    axes = [f"{path}.{axis}" for axis in "xyz" if f"{path}.{axis}" in frame]
    if len(axes) < 2 or not all(pd.api.types.is_numeric_dtype(frame[axis]) for axis in axes):
        return None
    parts = [frame[axis].to_numpy(dtype=np.float64, na_value=np.nan) for axis in axes]
    with np.errstate(over="ignore"):
        return pd.Series(np.sqrt(np.sum(np.square(parts), axis=0)))


def _stamp(frame: pd.DataFrame, path: str) -> IntArray | None:
    """Time from seconds and nanoseconds at `path`; None if there are none."""
    for seconds in _SECONDS:
        for nanoseconds in _NANOSECONDS:
            names = f"{path}.{seconds}", f"{path}.{nanoseconds}"
            if not all(name in frame for name in names):
                continue
            whole, rest = (
                frame[name].to_numpy(dtype=np.float64, na_value=np.nan) for name in names
            )
            usable = (np.abs(whole) < 2**33) & (rest >= 0.0) & (rest < NANOSECONDS)
            counted = [np.where(usable, part, 0.0).astype(np.int64) for part in (whole, rest)]
            return _plausible(np.where(usable, counted[0] * 10**9 + counted[1], NO_TIME))
    return None


def _plausible(time: Any) -> IntArray:
    """Time [ns]; a clock that was never set counts as none."""
    return np.where((time >= EARLIEST) & (time < LATEST), time, NO_TIME)


def _joined(tables: list[Table]) -> list[Table]:
    """The tables, those that share a topic of ours merged in the order of time."""
    joined: list[Table] = []
    for table in tables:
        merged = table
        for other in list(joined):
            if _topics(other) & _topics(merged):
                joined.remove(other)
                both = other.then(merged)
                order = np.argsort(both.time, kind="stable")
                merged = replace(both.take(order), samples=both.samples)
        joined.append(merged)
    return joined


def _topics(table: Table) -> set[str]:
    return {field_of(name)[0].name for name in [*table.signals, *table.texts]}


# --------------------------------------------------------------------------------------- presets


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
            _number(frame, "status.status") <= _NO_FIX, NO_ACCURACY, _deviation(horizontal, known)
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
