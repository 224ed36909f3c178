"""A trip: frames by topic, metadata, provenance and the files it was made from.

A `Trip` is what the packages of trainlog hand to each other. It is plain data: one pandas DataFrame
a topic, indexed by UTC time in nanoseconds, in SI units, with the units in ``frame.attrs``.
Bringing topics onto one clock is in `trainlog.resampling`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray, IntArray
from trainlog.display import counted
from trainlog.errors import LogError, NotRecordedError
from trainlog.presentation import Presented, WordTable, facts_table
from trainlog.spans import Spans, in_spans, position_limits, spans_within, time_limits, utc
from trainlog.topics import Topic, attributes, column_field
from trainlog.units import NANOSECONDS, clock
from trainlog.version import __version__

POSITION_TOPICS = ("/estimates/state", "/train/state")
"""Where a trip's position is found: the first of these topics in which any position is known."""

RECORDED_BRAKE = "recorded_brake"
"""Metadata: what the recorded dynamic brake may be, where its column does not state it."""

LINE_ATTACHMENT = "line.json"
"""Attachment that holds the line the trip was driven on, in trainlog's line format."""

TRAIN_ATTACHMENT = "train.json"
"""Attachment that holds the train, in trainlog's train format."""

PASSPORT_ATTACHMENT = "passport.json"
"""Attachment that holds what was found of the trip's recorder and of its load."""

SCENARIO_ATTACHMENT = "scenario.json"
"""Attachment that holds the truth of a simulated trip."""

NO_POSITION = f"it needs a position in {' or '.join(POSITION_TOPICS)}; slice it by time"
"""What to do about a trip that cannot be sliced by position."""


MOST_SHOWN = 6
"""Topics in the summary of a trip, the rest of them in one line."""


@dataclass(frozen=True, eq=False, repr=False)
class Trip(Presented):
    """One train trip.

    It is a mapping of topics: ``trip["/train/state"]`` is a frame, ``in`` asks for a topic, a loop
    goes over the topics' names, ``len`` counts them. Two trips are equal if their metadata and
    their frames are (times, columns, values and units; NaN equals NaN), whatever they were made
    from.

    Attributes
    ----------
    topics : dict of str to DataFrame
        Frames by topic name; see `trainlog.topics`.
    metadata : dict of str to str
        What is known of the trip: ``trip``, ``train``, ``line``, ``direction``, ``load`` [kg],
        ``weather``, ``clock``, ``start``, ``software``, ``seed`` ... (docs/log.md lists them).
    provenance : tuple of dict
        One entry a processing step, oldest first; each names the step, the software and the
        SHA-256 of every input.
    attachments : dict of str to bytes
        Files carried along, such as the line and the train.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/stopping.mcap")
    >>> "/train/state" in trip
    True
    >>> list(trip)[:2]
    ['/train/state', '/train/controls']
    >>> trip["/train/state"].attrs["units"]["speed"]
    'm/s'
    >>> trip == trip.between(trip.start, trip.end)
    True
    """

    charts_by: ClassVar[str] = "analysis.reports.trip:trip_charts"

    topics: dict[str, pd.DataFrame]
    metadata: dict[str, str] = field(default_factory=dict)
    provenance: tuple[dict[str, Any], ...] = ()
    attachments: dict[str, bytes] = field(default_factory=dict)

    def __getitem__(self, topic: str) -> pd.DataFrame:
        """The frame of `topic`.

        Raises
        ------
        NotRecordedError
            If the trip has no such topic.
        """
        try:
            return self.topics[topic]
        except KeyError:
            present = ", ".join(self.topics) or "none"
            error = NotRecordedError(
                f"trip '{self.name}' has no topic {topic}", remedy=f"topics loaded: {present}"
            )
            error.topic = topic
            raise error from None

    def __contains__(self, topic: object) -> bool:
        return topic in self.topics

    def __iter__(self) -> Iterator[str]:
        return iter(self.topics)

    def __len__(self) -> int:
        return len(self.topics)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trip):
            return NotImplemented
        return (
            self.metadata == other.metadata
            and self.topics.keys() == other.topics.keys()
            and all(
                frame.equals(other.topics[name])
                and frame.attrs.get("units") == other.topics[name].attrs.get("units")
                for name, frame in self.topics.items()
            )
        )

    @property
    def title(self) -> str:
        """Name, train, line and direction."""
        known = self.metadata
        words = [known.get("train", ""), f"on {known['line']}" if known.get("line") else ""]
        words += [known.get("direction", "")]
        return ", ".join([f"Trip '{self.name}'", *filter(None, words)])

    def tables(self) -> list[WordTable]:
        """The summary, with every topic."""
        return [facts_table(self.title, self.summary(most=len(self)))]

    def summary(self, most: int = MOST_SHOWN) -> dict[str, str]:
        """When it was and how far it went, and the rows and rate of each topic."""
        rows = {}
        if any(len(frame) for frame in self.topics.values()):
            words = [self.start.strftime("%Y-%m-%d %H:%M:%S UTC"), clock(self.duration)]
            with suppress(LogError):  # how far it went may not be known
                position = self.located()["position"].dropna()
                words.append(f"{float(abs(position.iloc[-1] - position.iloc[0])) / 1e3:.1f} km")
            rows["when"] = ", ".join(words)
        frames = sorted(self.topics.items(), key=lambda item: -len(item[1]))
        for name, frame in frames[:most] if len(frames) > most + 1 else frames:
            columns = counted(len(frame.columns), "column")
            rows[name] = f"{counted(len(frame), 'row')}{_rate(frame)}, {columns}"
        if len(frames) > most + 1:
            rows[f"{len(frames) - most} more"] = ", ".join(name for name, _ in frames[most:])
        return rows or {"topics": "none"}

    @property
    def name(self) -> str:
        """Name of the trip, or ``"unnamed"``."""
        return self.metadata.get("trip", "unnamed")

    @property
    def start(self) -> pd.Timestamp:
        """Time of the first sample of any topic."""
        return pd.Timestamp(min(frame.index[0] for frame in self._filled()))

    @property
    def end(self) -> pd.Timestamp:
        """Time of the last sample of any topic."""
        return pd.Timestamp(max(frame.index[-1] for frame in self._filled()))

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float((self.end - self.start).total_seconds())

    def with_topic(self, frame: pd.DataFrame) -> Trip:
        """A copy of the trip in which `frame` (made by `frame_of`) is added or replaced.

        Examples
        --------
        >>> import trainlog
        >>> trip = trainlog.read("sample_logs/stopping.mcap")
        >>> slower = trip["/train/state"].iloc[::10]
        >>> len(trip.with_topic(slower)["/train/state"])
        1414
        """
        return replace(self, topics={**self.topics, frame.attrs["topic"]: frame})

    def with_step(self, step: str, **details: Any) -> Trip:
        """A copy of the trip with one more entry of provenance."""
        return replace(self, provenance=(*self.provenance, {"step": step, **details}))

    def between(self, start: Any = None, end: Any = None) -> Trip:
        """The part of the trip from one time to another, both ends belonging to it.

        Every topic stays, with the rows in that time, none perhaps. Metadata and attachments are
        those of the whole trip; the provenance has a step more.

        Parameters
        ----------
        start, end : anything that `pandas.Timestamp` takes, optional
            Without a time zone it is UTC; None leaves that end open.

        Raises
        ------
        InputError
            If an end is no time, or the start is after the end.

        Examples
        --------
        >>> import trainlog
        >>> trip = trainlog.read("sample_logs/stopping.mcap")
        >>> trip.between("2024-10-07T08:01", "2024-10-07T08:02").duration
        60.0
        """
        spans = np.array([time_limits(start, end)], dtype=np.int64)
        return self.cut(spans).with_slice(time=(start, end))

    def within(self, start: float | None = None, end: float | None = None) -> Trip:
        """The part of the trip in which the train was between two positions.

        All topics, events too, are cut to the same times: those at which the position, on a line
        between its known samples, was from `start` to `end`, both belonging to it. A train that
        goes back and forth gives several such spans of time. Before the first known position and
        after the last there is none. The position is that of the first of `POSITION_TOPICS` that
        knows any. For the rest see `between`.

        Parameters
        ----------
        start, end : float [m], optional
            Chainage as the trip counts it; None leaves that end open.

        Raises
        ------
        InputError
            If an end is not a number, or the start is behind the end.
        LogError
            If the trip has no position.

        Examples
        --------
        >>> import trainlog
        >>> trip = trainlog.read("sample_logs/stopping.mcap")
        >>> state = trip.within(3_200.0, 7_500.0)["/train/state"]
        >>> float(state.position.min()), float(state.position.max())
        (3200.27, 7497.89)
        """
        limits = position_limits(start, end)
        state = self.located()
        time = nanoseconds(state)
        position = state["position"].to_numpy(dtype=np.float64)
        spans = spans_within(time, position, *limits)
        return self.cut(spans).with_slice(position=(start, end))

    def cut(self, spans: Spans) -> Trip:
        """The rows of all topics in the spans of time; the provenance stays as it is."""
        cut = {}
        for name, frame in self.topics.items():
            kept = frame[in_spans(nanoseconds(frame), spans)]
            kept.attrs = frame.attrs
            cut[name] = kept
        return replace(self, topics=cut)

    def with_slice(
        self,
        *,
        time: tuple[Any, Any] | None = None,
        position: tuple[float | None, float | None] | None = None,
    ) -> Trip:
        """The trip with the provenance that `between` or `within` these limits adds."""
        trip = self
        if time is not None:
            limits = [None if each is None else utc(each).isoformat() for each in time]
            trip = trip.with_step("slice", software=_SOFTWARE, time=limits)
        if position is not None:
            # An end at infinity is open, too; JSON has no word for it.
            ends = [None if each is None or np.isinf(each) else float(each) for each in position]
            trip = trip.with_step("slice", software=_SOFTWARE, position=ends)
        return trip

    def located(self) -> pd.DataFrame:
        """The frame that knows where the train was: of the first of `POSITION_TOPICS` that does.

        Raises
        ------
        LogError
            If the trip has no position.
        """
        for name in POSITION_TOPICS:
            frame = self.topics.get(name)
            if frame is not None and "position" in frame and frame["position"].notna().any():
                return frame
        raise LogError(f"trip '{self.name}' does not know where the train was", remedy=NO_POSITION)

    def _filled(self) -> list[pd.DataFrame]:
        frames = [frame for frame in self.topics.values() if len(frame)]
        if not frames:
            raise LogError(
                f"trip '{self.name}' has no samples",
                remedy="record it again, or choose a longer span of time",
            )
        return frames


_SOFTWARE = f"trainlog {__version__}"


def _rate(frame: pd.DataFrame) -> str:
    """The usual rate of a topic, in words; nothing where there is none."""
    step = np.diff(nanoseconds(frame))
    usual = float(np.median(step)) if step.size > 1 else 0.0
    regular = usual > 0.0 and np.mean(np.abs(step - usual) < 0.1 * usual) > 0.5
    return f" at {NANOSECONDS / usual:.3g} Hz" if regular else ""


def stacked(frames: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Frames of one topic below each other, with the attributes of the first."""
    if len(frames) == 1:
        return frames[0]
    found = pd.concat(frames)
    found.attrs = frames[0].attrs
    return found


def frame_of(
    topic: Topic, time: ArrayLike | pd.DatetimeIndex, data: dict[str, ArrayLike]
) -> pd.DataFrame:
    """Build a topic's frame, with its units.

    Parameters
    ----------
    topic : Topic
    time : (n,) int64 nanoseconds since 1970 UTC, or DatetimeIndex
    data : dict of str to (n,) array
        Columns in SI units. A field ``per_axle`` may be given as one (n, axles) array. Fields that
        are left out are NaN: absent, not zero.

    Raises
    ------
    KeyError
        If a column does not belong to the topic.

    Examples
    --------
    >>> from trainlog.topics import TRAIN_STATE
    >>> frame = frame_of(TRAIN_STATE, [0, 1_000_000_000], {"speed": [3.0, 4.0]})
    >>> frame["speed"].tolist(), frame.attrs["units"]["speed"]
    ([3.0, 4.0], 'm/s')
    """
    if not isinstance(time, pd.DatetimeIndex):
        nanoseconds = np.asarray(time, dtype=np.int64).astype("datetime64[ns]")
        time = pd.DatetimeIndex(nanoseconds, tz="UTC")
    index = time.as_unit("ns")
    index.name = "time"
    given: dict[str, ArrayLike] = {}
    for name, values in data.items():
        array = np.asarray(values)
        if array.ndim == 2:
            given |= {f"{name}_{axle + 1}": array[:, axle] for axle in range(array.shape[1])}
        else:
            given[name] = values
    for name in given:
        column_field(topic, name)
    ordered: dict[str, Any] = {}
    for item in topic.fields:
        if item.per_axle:
            prefix = f"{item.name}_"
            axles = sorted(
                (n for n in given if n.startswith(prefix) and n[len(prefix) :].isdigit()),
                key=lambda n: int(n[len(prefix) :]),
            )
            ordered |= {name: given[name] for name in axles}
        elif item.name in given:
            ordered[item.name] = given[item.name]
        elif item.unit:
            ordered[item.name] = np.full(len(index), np.nan)
        else:
            ordered[item.name] = (
                np.zeros(len(index), dtype=np.int64) if item.name == "level" else ""
            )
    frame = pd.DataFrame(ordered, index=index)
    frame.attrs = attributes(topic, frame.columns)
    return frame


def seconds(frame: pd.DataFrame, origin: pd.Timestamp | None = None) -> FloatArray:
    """Time of each row [s] since `origin` (default: the first row).

    Examples
    --------
    >>> from trainlog.topics import TRAIN_STATE
    >>> seconds(frame_of(TRAIN_STATE, [0, 500_000_000], {"speed": [3.0, 4.0]}))
    array([0. , 0.5])
    """
    time = nanoseconds(frame)
    if not time.size:
        return np.empty(0)
    start = time[0] if origin is None else origin.as_unit("ns").value
    return np.asarray((time - start) / NANOSECONDS)


def nanoseconds(frame: pd.DataFrame) -> IntArray:
    """Time of each row [ns since 1970 UTC].

    Examples
    --------
    >>> from trainlog.topics import TRAIN_STATE
    >>> nanoseconds(frame_of(TRAIN_STATE, [0, 500_000_000], {"speed": [3.0, 4.0]})).tolist()
    [0, 500000000]
    """
    return np.asarray(pd.DatetimeIndex(frame.index).as_unit("ns").asi8)
