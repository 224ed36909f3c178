"""What is in a log, told without reading more of it than that takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mcap.records import Channel
from numpy.typing import NDArray

from trainlog.errors import LogError
from trainlog.formats.files import sha256
from trainlog.mcap.account import Account
from trainlog.mcap.channels import UNIT, axles_of
from trainlog.mcap.contents import contents_of
from trainlog.mcap.errors import in_file
from trainlog.mcap.names import FORMAT_RECORD, PROVENANCE_RECORD, TRIP_RECORD
from trainlog.mcap.places import Contents
from trainlog.mcap.reader import attachments_of, metadata_of, trip_of
from trainlog.mcap.selection import selection_of
from trainlog.mcap.source import Source
from trainlog.mcap.stored import MisplacedError, index_in
from trainlog.mcap.walk import contents_by_walk
from trainlog.topics import TRAIN_STATE
from trainlog.trip import Trip

_POSITION = selection_of({TRAIN_STATE.name: ["position"]}, None, None)

GAP = 3.0
"""An interval longer than this many median intervals is a gap."""


@dataclass(frozen=True)
class TopicDescription:
    """One channel of a log.

    Attributes
    ----------
    name, message, encoding : str
        Channel name, name of the schema, encoding of the messages.
    count : int
        Number of messages.
    rate : float
        Mean number of messages a second [Hz]; NaN for fewer than two.
    first, last : Timestamp or None
    median_interval, largest_gap : float
        Time between messages [s]; NaN for fewer than two.
    gaps : int
        Number of intervals longer than `GAP` median intervals.
    units : dict of str to str
        SI unit by field, as the file says.
    axles : dict of str to int
        Number of axles by field, for the fields that have one value for each.
    """

    name: str
    message: str
    encoding: str
    count: int
    rate: float
    first: pd.Timestamp | None
    last: pd.Timestamp | None
    median_interval: float
    largest_gap: float
    gaps: int
    units: dict[str, str]
    axles: dict[str, int]


@dataclass(frozen=True)
class AttachmentDescription:
    """A file that a log carries; `size` in bytes."""

    name: str
    media_type: str
    size: int
    sha256: str


@dataclass(frozen=True)
class LogDescription:
    """What is in a log.

    Attributes
    ----------
    path : Path
    size : int
        Of the file [bytes].
    account : Account
        What is readable and what is lost, as far as that shows without reading the messages;
        `account_of` reads them all.
    problem : str or None
        What is lost first, or why `read_log` refuses the file: foreign, of a later version; None
        if it reads.
    schema_version : str or None
        Version of the table of topics; None in files that trainlog did not write.
    topics : tuple of TopicDescription
    metadata : dict of str to str
        The trip's; in foreign files that of all records, as ``record/key``.
    provenance : tuple of dict
    attachments : tuple of AttachmentDescription
    position_span : tuple of float or None
        Least and greatest position of the train's front [m].
    chunks : int
    compression : tuple of str
        Kinds in use, ``""`` for none.
    stored_size, content_size : int
        Length of the messages as stored and when decompressed [bytes].
    """

    path: Path
    size: int
    account: Account
    problem: str | None
    schema_version: str | None
    topics: tuple[TopicDescription, ...]
    metadata: dict[str, str]
    provenance: tuple[dict[str, Any], ...]
    attachments: tuple[AttachmentDescription, ...]
    position_span: tuple[float, float] | None
    chunks: int
    compression: tuple[str, ...]
    stored_size: int
    content_size: int

    @property
    def complete(self) -> bool:
        """Whether nothing is known to be lost."""
        return self.account.whole

    @property
    def count(self) -> int:
        """Number of messages of all topics."""
        return sum(topic.count for topic in self.topics)

    @property
    def first(self) -> pd.Timestamp | None:
        """Time of the first message of all topics."""
        return min((topic.first for topic in self.topics if topic.first), default=None)

    @property
    def last(self) -> pd.Timestamp | None:
        """Time of the last message of all topics."""
        return max((topic.last for topic in self.topics if topic.last), default=None)


def describe(path: str | Path) -> LogDescription:
    """Tell what is in an MCAP file, whoever wrote it, and what is readable of a damaged one.

    Times and gaps come from the message indexes; of the messages themselves only those that hold
    the train's position are decompressed.

    Raises
    ------
    LogError
        If it is not an MCAP file at all.
    InputError
        If there is no such file.
    """
    with Source(path) as source, in_file(path):
        contents = contents_of(source)
        records = metadata_of(contents)
        try:
            trip, problem = _trip(source, contents)
        except MisplacedError:
            contents = contents_by_walk(source)
            trip, problem = _trip(source, contents)
        topics = _topics(source, contents)
        attachments = tuple(
            AttachmentDescription(place.name, place.media_type, place.size, sha256(data))
            for place, data in attachments_of(source, contents)
        )
    account = contents.account
    if not account.whole:
        first = account.losses[0]
        problem = f"byte {first.start}: {first.reason}"
    return LogDescription(
        path=Path(path),
        size=source.size,
        account=account,
        problem=problem,
        schema_version=records.get(FORMAT_RECORD, {}).get("schema_version"),
        topics=topics,
        metadata=_metadata(records),
        provenance=trip.provenance if trip else (),
        attachments=attachments,
        position_span=_position_span(trip),
        chunks=len(contents.chunks),
        compression=tuple(sorted({chunk.compression for chunk in contents.chunks})),
        stored_size=sum(chunk.stored for chunk in contents.chunks),
        content_size=sum(chunk.size for chunk in contents.chunks),
    )


def _trip(source: Source, contents: Contents) -> tuple[Trip | None, str | None]:
    """The trip with its train state only, or the problem that reading the file meets."""
    try:
        return trip_of(source, contents, _POSITION, threads=1), None
    except MisplacedError:
        raise
    except LogError as error:
        return None, str(error)


def _metadata(records: dict[str, dict[str, str]]) -> dict[str, str]:
    if FORMAT_RECORD in records or TRIP_RECORD in records:
        return records.get(TRIP_RECORD, {})
    return {
        f"{name}/{key}": value
        for name, values in records.items()
        if name != PROVENANCE_RECORD
        for key, value in values.items()
    }


def _position_span(trip: Trip | None) -> tuple[float, float] | None:
    if trip is None or TRAIN_STATE.name not in trip:
        return None
    position = trip[TRAIN_STATE.name]["position"].to_numpy()
    known = position[np.isfinite(position)]
    return (float(known.min()), float(known.max())) if len(known) else None


def _topics(source: Source, contents: Contents) -> tuple[TopicDescription, ...]:
    times: dict[int, list[NDArray[np.uint64]]] = {number: [] for number in contents.channels}
    for place in list(contents.chunks):
        try:
            index = index_in(source, place)
        except LogError as error:
            contents.drop(place, error.problem)
            continue
        for number, entries in index.items():
            # Messages of a channel that is not declared are among the losses.
            if number in times:
                times[number].append(entries[:, 0])
    return tuple(
        _topic(contents, channel, np.sort(np.concatenate(times[number] or [np.empty(0, "<u8")])))
        for number, channel in contents.channels.items()
    )


def _topic(contents: Contents, channel: Channel, time: NDArray[np.uint64]) -> TopicDescription:
    schema = contents.schema(channel)
    interval = np.diff(time).astype(np.float64) * 1e-9
    span = float(interval.sum())
    median = float(np.median(interval)) if len(interval) else np.nan
    return TopicDescription(
        name=channel.topic,
        message=schema.name if schema else "",
        encoding=channel.message_encoding,
        count=len(time),
        rate=len(interval) / span if span > 0 else np.nan,
        first=_timestamp(time[0]) if len(time) else None,
        last=_timestamp(time[-1]) if len(time) else None,
        median_interval=median,
        largest_gap=float(interval.max()) if len(interval) else np.nan,
        gaps=int(np.count_nonzero(interval > GAP * median)),
        units={
            key.removeprefix(UNIT): value
            for key, value in channel.metadata.items()
            if key.startswith(UNIT)
        },
        axles=axles_of(channel),
    )


def _timestamp(time: np.uint64) -> pd.Timestamp | None:
    """The time as a time stamp; None beyond those that pandas has."""
    if time > pd.Timestamp.max.value:
        return None
    return pd.Timestamp(int(time), tz="UTC")
