"""Reading a trip, or a part of one, from an MCAP file: at once, or piece by piece.

Chunks that cannot hold what is asked for are not read. Where the train was in each chunk is kept in
the metadata record `POSITIONS_RECORD`, see `trainlog.mcap.codec`. A file without the record is read
no differently, only slower.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Metadata

from trainlog.display import few
from trainlog.errors import InputError, LogError, in_file
from trainlog.identity import COLUMNS, TripIdentity, identity_of
from trainlog.mcap.codec import Range, decoded, range_of
from trainlog.mcap.contents import (
    ChunkPlace,
    Contents,
    MisplacedError,
    check_data_section,
    contents_of,
    contents_used,
    report_losses,
    scanned,
)
from trainlog.mcap.records import (
    FORMAT_RECORD,
    MOST_NAMED,
    POSITIONS_RECORD,
    PROVENANCE_RECORD,
    RECORDING_RECORD,
    RECOVERY_RECORD,
    TRIP_RECORD,
    Account,
    DamageWarning,
    Loss,
    Source,
    attachment_at,
    shown,
    unusable,
)
from trainlog.mcap.tables import TopicChannel, Wanted, frames_in, topic_channels
from trainlog.spans import (
    ALWAYS,
    Spans,
    merged_spans,
    overlapping,
    position_limits,
    spans_within,
    time_limits,
)
from trainlog.topics import RECORDED, SCHEMA_VERSION, TOPICS, Topic, column_field
from trainlog.trip import NO_POSITION, POSITION_TOPICS, Trip, nanoseconds


def read_log(
    path: str | Path,
    topics: Topics | None = None,
    *,
    time: tuple[Any, Any] | None = None,
    position: tuple[float | None, float | None] | None = None,
) -> Trip:
    """Read a trip, or a part of one, from an MCAP file.

    Only what is asked for is read: the chunks that hold it are found by the file's index. What is
    read is verified by its checksums; when all is read, the rest of the file is, too. Of a damaged
    file everything that is readable comes back, with a `DamageWarning` that carries the account of
    what is lost; the trip's provenance keeps it.

    Parameters
    ----------
    path : path
    topics : iterable of str, or mapping of str to iterable of str or None, optional
        Topics to read, or the columns to read of each, None for all. Default: all. A topic or
        column that the file does not have is left out.
    time : (start, end), optional
        Span of time, both ends belonging to it: anything that `pandas.Timestamp` takes, in UTC
        unless it has a time zone; None leaves an end open. The same as `Trip.between`.
    position : (start, end), optional
        Stretch of the line [m], None for an open end. The same as `Trip.within`: rows of all
        topics at the times at which the train was there.

    Returns
    -------
    Trip
        With one frame a topic, by log time, and the metadata, provenance and attachments.

    Raises
    ------
    LogError
        If the file is no log, nothing of it is readable, it holds no trip, was written by a newer
        version of trainlog, does not know the train's position if that is asked for, or a topic
        or column is asked for that does not exist.
    InputError
        If there is no such file, or a limit is no time or position.

    Warns
    -----
    DamageWarning
        If something is lost.

    Examples
    --------
    >>> import trainlog
    >>> log = "sample_logs/nonstop.mcap"
    >>> len(trainlog.read(log)["/train/state"])
    11832
    >>> stretch = trainlog.read(log, {"/train/state": ["speed"]}, position=(1000.0, 1100.0))
    >>> len(stretch["/train/state"])
    32
    """
    (trip,) = _trips(path, selection_of(topics, time, position), None)
    return trip


def stream_log(
    path: str | Path,
    topics: Topics | None = None,
    *,
    time: tuple[Any, Any] | None = None,
    position: tuple[float | None, float | None] | None = None,
    rows: int = 1_000_000,
) -> Iterator[Trip]:
    """Read a trip, or a part of one, piece by piece in the order of time.

    The pieces one after the other are what `read_log` gives. The memory in use does not grow with
    the log, unless its chunks overlap in time, as some writers' do: messages wait for their turn.

    Parameters
    ----------
    path, topics, time, position
        As for `read_log`.
    rows : int
        Most rows of a piece, over all topics, but for one that is a single chunk of the log or
        touches chunks that overlap.

    Yields
    ------
    Trip
        With every topic, without rows perhaps, and the metadata, provenance and attachments of the
        whole; the provenance of the last says what is lost. There is at least one. Messages of the
        same instant are in the same piece.

    Raises
    ------
    LogError, InputError
        As `read_log`, when the first piece is asked for; here if `rows` is not positive.

    Warns
    -----
    DamageWarning
        Behind the last piece, if something is lost.

    Examples
    --------
    >>> import trainlog
    >>> pieces = trainlog.stream("sample_logs/nonstop.mcap", ["/train/state"], rows=4000)
    >>> [len(piece["/train/state"]) for piece in pieces]
    [3600, 3600, 3600, 1032]
    """
    if rows < 1:
        raise InputError(f"rows is {rows}", remedy="give the most rows of a piece, at least 1")
    return _trips(path, selection_of(topics, time, position), rows)


def about_log(path: str | Path) -> Trip:
    """Metadata and provenance of a log, from its summary: no topics, no attachments.

    Raises
    ------
    LogError
        If the file is no log, or holds no trip.
    InputError
        If there is no such file.

    Examples
    --------
    >>> about_log("sample_logs/nonstop.mcap").name
    'trip-01'
    """

    def found(contents: Contents) -> Trip:
        metadata = metadata_of(contents)
        _check_version(contents, metadata, topic_channels(contents))
        return Trip({}, metadata.get(TRIP_RECORD, {}), _provenance(metadata, contents))

    with Source(path) as source, in_file(path):
        contents, trip = contents_used(source, found)
    return with_losses(trip, contents)


def identity_of_log(path: str | Path) -> TripIdentity | None:
    """Which drive a log is of; only the column that this takes is read. Errors as `read_log`.

    Examples
    --------
    >>> identity_of_log("sample_logs/nonstop.mcap") == identity_of(
    ...     read_log("sample_logs/nonstop.mcap")
    ... )
    True
    """
    columns: dict[str, list[str]] = {}
    for topic, column, _ in COLUMNS:
        columns.setdefault(topic, []).append(column)
    with warnings.catch_warnings():
        # Whoever reads the trip itself is warned of the damage.
        warnings.simplefilter("ignore", DamageWarning)
        return identity_of(read_log(path, columns))


# ------------------------------------------------------------------------------- the file's part


def with_losses(trip: Trip, contents: Contents) -> Trip:
    """The trip, its provenance saying what of its file is lost, if anything is."""
    if not contents.losses:
        return trip
    return trip.with_step("read damaged log", account=contents.account.details())


def bare_trip(source: Source, contents: Contents) -> Trip:
    """The trip without its topics.

    Raises
    ------
    LogError
        If nothing of the file is readable, it holds no trip, or one of a later version.
    """
    metadata = metadata_of(contents)
    check_readable(contents.account)
    _check_version(contents, metadata, topic_channels(contents))
    return Trip(
        topics={},
        metadata=metadata.get(TRIP_RECORD, {}),
        provenance=_provenance(metadata, contents),
        attachments={each.name: each.data for each in attachments_of(source, contents)},
    )


def attachments_of(source: Source, contents: Contents) -> list[Attachment]:
    """The attachments; those that fail their checksum are dropped from the contents."""
    found = []
    for place in list(contents.attachments):
        try:
            found.append(attachment_at(source, place[0]))
        except LogError as error:
            contents.attachments.remove(place)
            contents.losses.append(Loss(*place, error.problem, messages=0))
    return found


def metadata_of(contents: Contents) -> dict[str, dict[str, str]]:
    """The metadata records of a file by name; records of the same name are joined."""
    found: dict[str, dict[str, str]] = {}
    record: Metadata
    for record in contents.metadata:
        found.setdefault(record.name, {}).update(record.metadata)
    return found


def _provenance(
    metadata: dict[str, dict[str, str]], contents: Contents
) -> tuple[dict[str, Any], ...]:
    """The processing steps of a file's metadata records, oldest first.

    How a recording ended stands behind its last sample, and what was lost when a log was rebuilt in
    a record of its own. Both belong to the trip: whatever is made of it says so, too.
    """
    steps = _steps(metadata, PROVENANCE_RECORD, contents)
    ended = metadata.get(RECORDING_RECORD, {})
    recorded = [number for number, step in enumerate(steps) if step.get("step") == "record"]
    if ended and recorded:
        steps[recorded[-1]] |= ended
    for step in _steps(metadata, RECOVERY_RECORD, contents):
        account = step.get("account")
        if isinstance(account, dict) and account.get("losses"):
            steps.append({"step": "recover"} | step)
    return tuple(steps)


def _steps(
    metadata: dict[str, dict[str, str]], name: str, contents: Contents
) -> list[dict[str, Any]]:
    """The steps in a metadata record; of a damaged file without those that cannot be read."""
    steps = []
    for key, text in sorted(metadata.get(name, {}).items()):
        step = step_of(text)
        if step is not None:
            steps.append(step)
        elif not contents.losses:
            problem = f"step {shown(key)} of the provenance is not a JSON object"
            # Whether the file is damaged shows a scan.
            raise MisplacedError(problem) if contents.indexed else unusable(problem)
    return steps


def step_of(text: str) -> dict[str, Any] | None:
    """A step of the provenance as it stands in a file; None if it is not a JSON object."""
    try:
        step = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return step if isinstance(step, dict) else None


def _check_version(
    contents: Contents, metadata: dict[str, dict[str, str]], channels: list[TopicChannel]
) -> None:
    """Refuse files that hold no trip, and those of a later version."""
    if FORMAT_RECORD not in metadata and not channels:
        held = sorted({shown(channel.topic) for channel in contents.channels.values()})
        raise LogError(
            f"has no topic of trainlog, but {few(held, MOST_NAMED) or 'none at all'}",
            remedy="bring it in (trainlog ingest), or read its tables (trainlog.mcap.frames_of)",
        )
    version = metadata.get(FORMAT_RECORD, {}).get("schema_version", str(SCHEMA_VERSION))
    if not re.fullmatch(r"[0-9]{1,9}", version) or int(version) > SCHEMA_VERSION:
        raise LogError(
            f"follows version {shown(version)} of the table of topics, this trainlog knows "
            f"{SCHEMA_VERSION}",
            remedy="update trainlog",
        )


def check_readable(account: Account) -> None:
    """Refuse a damaged file of which no message is readable."""
    if account.messages or account.whole:
        return
    first = account.losses[0]
    raise LogError(
        f"is damaged and no message of it is readable: {first.reason}",
        place=f"byte {first.start}",
        remedy="copy or record it again",
    )


# ---------------------------------------------------------------------------------- in pieces


def _trips(path: str | Path, selection: Selection, rows: int | None) -> Iterator[Trip]:
    """The part of a log that is asked for: in pieces of so many rows, None: at once."""
    with Source(path) as source, in_file(path):

        def begun(contents: Contents) -> tuple[Trip, Spans]:
            bare = bare_trip(source, contents)
            bare = bare.with_slice(time=selection.time, position=selection.position)
            return bare, spans_of(source, contents, selection)

        def piece(span: tuple[int, int]) -> Trip:
            """The rows of a span of time; all of the file is verified if all is asked for."""
            within = overlapping(spans, np.array([span], dtype=np.int64))
            chunks = chunks_within(contents.chunks, within)
            trip = replace(bare, topics=frames_in(source, contents, chunks, selection.columns))
            if span == ALWAYS and selection.whole:
                check_data_section(source, contents)
            uncut = span == ALWAYS and selection.time is None and selection.position is None
            return with_losses(trip if uncut else trip.cut(within), contents)

        contents, (bare, spans) = contents_used(source, begun)
        for span in [ALWAYS] if rows is None else _parts(contents, spans, selection, rows):
            try:
                yield piece(span)
            except MisplacedError:
                # What was read before stays; a scan finds what of the rest there is.
                contents = scanned(source)
                bare, spans = begun(contents)
                yield piece(span)
        check_readable(contents.account)
    report_losses(path, contents, called_by=3 if rows else 4)


def _parts(
    contents: Contents, spans: Spans, selection: Selection, rows: int
) -> list[tuple[int, int]]:
    """Spans of time [ns] that follow each other, each with at most `rows` rows.

    Each begins where a chunk does, so that few chunks are read twice; one that holds more rows is a
    part of its own.
    """
    borders, taken = [ALWAYS[0]], 0
    chunks = chunks_within(contents.chunks, spans)
    chunks.sort(key=lambda place: place.start)
    counts = _rows(contents, chunks, selection.columns)
    for place, count in zip(chunks, counts, strict=True):
        if taken and taken + count > rows and borders[-1] < place.start <= ALWAYS[1]:
            borders.append(place.start)
            taken = 0
        taken += count
    return list(zip(borders, [*(each - 1 for each in borders[1:]), ALWAYS[1]], strict=True))


def _rows(
    contents: Contents, chunks: Iterable[ChunkPlace], topics: Collection[str] | None
) -> list[int]:
    """How many rows of some topics, or all, each chunk holds."""
    channels = {
        each.channel.id
        for each in topic_channels(contents)
        if topics is None or each.topic.name in topics
    }
    return [
        sum(count for number, count in place.counts.items() if number in channels)
        for place in chunks
    ]


def rows_of_log(path: str | Path, topics: Collection[str] | None = None) -> int:
    """How many rows a log has over some topics, or all, by its summary. Errors as `read_log`.

    Examples
    --------
    >>> rows_of_log("sample_logs/nonstop.mcap", ["/train/state", "/events"])
    11847
    """
    with Source(path) as source, in_file(path):
        contents = contents_of(source)
        return sum(_rows(contents, contents.chunks, topics))


Topics = Iterable[str] | Mapping[str, Iterable[str] | None]
"""Names of topics, or the columns asked for by topic, None for all."""


def position_ranges(
    source: Source, contents: Contents, topic: str
) -> list[tuple[ChunkPlace, Range]]:
    """The chunks in which the train's position is known by a topic, each with its positions.

    Raises
    ------
    LogError
        If messages are not what their channel says.
    MisplacedError
        If something is not as the summary says.
    """
    stored = [
        record.metadata[topic]
        for record in contents.metadata
        if record.name == POSITIONS_RECORD and topic in record.metadata
    ]
    known = {key: each for text in stored for key, each in decoded(text).items()}
    numbers = {each.channel.id for each in topic_channels(contents) if each.topic.name == topic}
    places = [place for place in contents.chunks if not numbers.isdisjoint(place.counts)]
    if any((place.offset, place.start) not in known for place in places):
        for place in places:
            frames = frames_in(source, contents, [place], {topic: frozenset(["position"])})
            known[place.offset, place.start] = range_of(frames[topic]["position"].to_numpy())
    found = [(place, known[place.offset, place.start]) for place in places]
    return [(place, each) for place, each in found if not np.isnan(each[0])]


def spans_in_log(source: Source, contents: Contents, stretch: tuple[float, float]) -> Spans:
    """When the train was on a stretch of the line.

    Raises
    ------
    LogError
        If the log does not know where the train was.
    MisplacedError
        If something is not as the summary says.
    """
    for topic in POSITION_TOPICS:
        spans = _spans_by(source, contents, topic, stretch)
        if spans is not None:
            return spans
    raise LogError("does not know where the train was", remedy=NO_POSITION)


def _spans_by(
    source: Source, contents: Contents, topic: str, stretch: tuple[float, float]
) -> Spans | None:
    """The same by one topic; None if it knows no position."""
    ranges = position_ranges(source, contents, topic)
    if not ranges:
        return None
    overlap = any(one.end > other.start for (one, _), (other, _) in pairwise(ranges))
    chunks = [place for place, _ in ranges] if overlap else _near(ranges, stretch)
    found = frames_in(source, contents, chunks, {topic: frozenset(["position"])})[topic]
    return merged_spans(spans_within(nanoseconds(found), found["position"].to_numpy(), *stretch))


def position_span(source: Source, contents: Contents, topic: str) -> tuple[float, float] | None:
    """Least and greatest position by a topic [m]; None if none. Errors as `position_ranges`."""
    ranges = [each for _, each in position_ranges(source, contents, topic)]
    if not ranges:
        return None
    return min(least for least, _ in ranges), max(most for _, most in ranges)


def _near(
    located: list[tuple[ChunkPlace, Range]], stretch: tuple[float, float]
) -> list[ChunkPlace]:
    """Chunks in which, or between which and the next, the train can have been on a stretch.

    Of two that follow each other and have others between them it was outside of the stretch at the
    end of the first and, on the same side, at the beginning of the second.
    """
    least, greatest = np.array([each for _, each in located]).T
    # Between the last sample of a chunk and the first of the next it was between both.
    joint = (np.minimum(least[1:], least[:-1]) <= stretch[1]) & (
        np.maximum(greatest[1:], greatest[:-1]) >= stretch[0]
    )
    near = (least <= stretch[1]) & (greatest >= stretch[0])
    near[1:] |= joint
    near[:-1] |= joint
    return [located[number][0] for number in np.flatnonzero(near).tolist()]


# --------------------------------------------------------------------------- what is asked for


@dataclass(frozen=True)
class Selection:
    """A part of a log.

    Attributes
    ----------
    columns : Wanted
    time : (Any, Any) or None
        As given; checked.
    position : (float, float) or None
        As given; checked.
    """

    columns: Wanted
    time: tuple[Any, Any] | None
    position: tuple[float | None, float | None] | None

    @property
    def whole(self) -> bool:
        """Whether it leaves out nothing."""
        return self.columns is None and self.time is None and self.position is None

    @property
    def span(self) -> tuple[int, int]:
        """The limits of its time [ns since 1970 UTC]."""
        return ALWAYS if self.time is None else time_limits(*self.time)

    @property
    def stretch(self) -> tuple[float, float]:
        """The position's limits [m]; infinite where open."""
        return position_limits(*(self.position or (None, None)))


def selection_of(
    topics: Topics | None,
    time: tuple[Any, Any] | None,
    position: tuple[float | None, float | None] | None,
) -> Selection:
    """The part of a log that is asked for, checked.

    Raises
    ------
    LogError
        If there is no such topic or column.
    InputError
        If a limit is no time or no position, or the limits are in the wrong order.
    """
    found = Selection(_columns(topics), _pair("time", time), _pair("position", position))
    _ = found.span, found.stretch  # limits that are none are refused here
    return found


def _pair(name: str, limits: Sequence[Any] | None) -> tuple[Any, Any] | None:
    if limits is None:
        return None
    if isinstance(limits, str) or not hasattr(limits, "__len__") or len(limits) != 2:
        raise InputError(f"{name} is {limits!r}, not two limits", remedy=f"give {name}=(from, to)")
    return limits[0], limits[1]


def _columns(topics: Topics | None) -> Wanted:
    if topics is None:
        return None
    if isinstance(topics, str):
        topics = [topics]
    asked = topics if isinstance(topics, Mapping) else dict.fromkeys(topics)
    for name in asked:
        if name not in TOPICS and not name.startswith(RECORDED):
            raise LogError(f"there is no topic {name}", remedy=f"topics are {', '.join(TOPICS)}")
    return {
        name: None if names is None else _known(TOPICS.get(name), names)
        for name, names in asked.items()
    }


def _known(topic: Topic | None, names: Iterable[str]) -> frozenset[str]:
    """The names, of which a topic of the table must have each; what others have the log knows."""
    names = frozenset([names] if isinstance(names, str) else names)
    if topic is None:
        return names
    for name in sorted(names):
        try:
            column_field(topic, name)
        except KeyError:
            raise LogError(
                f"{topic.name} has no column {name}",
                remedy=f"its fields are {', '.join(item.name for item in topic.fields)}; a field "
                "with one value for each axle has columns such as wheel_speed_1",
            ) from None
    return names


def chunks_within(chunks: Iterable[ChunkPlace], spans: Spans) -> list[ChunkPlace]:
    """The chunks that can hold messages in any of the spans of time."""
    listed, highest = list(chunks), ALWAYS[1]
    ends = [(min(place.start, highest), min(place.end, highest)) for place in listed]
    first, last = np.array(ends, dtype=np.int64).reshape(-1, 2).T
    # The first span that ends at or after the chunk's start must begin before its end.
    begins = np.append(spans[:, 0], highest)[np.searchsorted(spans[:, 1], first)]
    held = (np.searchsorted(spans[:, 1], first) < len(spans)) & (begins <= last)
    return [listed[index] for index in np.flatnonzero(held)]


def spans_of(source: Source, contents: Contents, selection: Selection) -> Spans:
    """The spans of time that are asked for.

    Raises
    ------
    LogError
        If a stretch of the line is asked for and the log does not know where the train was.
    MisplacedError
        As `trip_of`.
    """
    first, last = selection.span
    if selection.position is None:
        return np.array([[first, last]], dtype=np.int64)
    spans = spans_in_log(source, contents, selection.stretch)
    return overlapping(spans, np.array([[first, last]], dtype=np.int64))
