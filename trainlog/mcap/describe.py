"""What is in a log, told without reading more of it than that takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mcap.records import Channel

from trainlog.errors import LogError
from trainlog.formats.files import sha256
from trainlog.mcap.account import Account
from trainlog.mcap.contents import contents_of
from trainlog.mcap.errors import in_file
from trainlog.mcap.intervals import Rhythm, rhythms
from trainlog.mcap.located import position_span
from trainlog.mcap.names import FORMAT_RECORD, PROVENANCE_RECORD, TRIP_RECORD
from trainlog.mcap.places import Contents
from trainlog.mcap.reader import attachments_of, bare_trip, metadata_of
from trainlog.mcap.schemas import UNIT, axles_of
from trainlog.mcap.source import Source
from trainlog.mcap.stored import MisplacedError
from trainlog.mcap.walk import contents_by_walk
from trainlog.topics import TRAIN_STATE
from trainlog.trip import Trip

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

    Times and gaps come from the message indexes, positions from the file's own record of them:
    messages are decompressed only where a file does not have these. A damaged message is therefore
    not noticed; `account_of` reads and verifies everything.

    Raises
    ------
    LogError
        If it is not an MCAP file at all.
    InputError
        If there is no such file.
    """
    with Source(path) as source, in_file(path):
        contents = contents_of(source)
        refusal = None
        try:
            span = position_span(source, contents, TRAIN_STATE.name)
        except MisplacedError:
            contents = contents_by_walk(source)
            span = position_span(source, contents, TRAIN_STATE.name)
        except LogError as error:
            span, refusal = None, str(error)
        trip, problem = _trip(source, contents)
        records = metadata_of(contents)
        told = rhythms(source, contents)
        topics = tuple(
            _topic(contents, channel, told[number]) for number, channel in contents.channels.items()
        )
        attachments = tuple(
            AttachmentDescription(place.name, place.media_type, place.size, sha256(data))
            for place, data in attachments_of(source, contents)
        )
    account = contents.account
    problem = problem or refusal
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
        position_span=span if trip else None,
        chunks=len(contents.chunks),
        compression=tuple(sorted({chunk.compression for chunk in contents.chunks})),
        stored_size=sum(chunk.stored for chunk in contents.chunks),
        content_size=sum(chunk.size for chunk in contents.chunks),
    )


def _trip(source: Source, contents: Contents) -> tuple[Trip | None, str | None]:
    """The trip without its topics, or the problem that reading the file meets."""
    try:
        return bare_trip(source, contents), None
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


def _topic(contents: Contents, channel: Channel, rhythm: Rhythm) -> TopicDescription:
    schema = contents.schema(channel)
    span = (rhythm.last - rhythm.first) * 1e-9
    median = rhythm.median
    return TopicDescription(
        name=channel.topic,
        message=schema.name if schema else "",
        encoding=channel.message_encoding,
        count=rhythm.count,
        rate=(rhythm.count - 1) / span if span > 0 else np.nan,
        first=_timestamp(rhythm.first) if rhythm.count else None,
        last=_timestamp(rhythm.last) if rhythm.count else None,
        median_interval=median,
        largest_gap=rhythm.largest,
        gaps=rhythm.longer_than(GAP * median),
        units={
            key.removeprefix(UNIT): value
            for key, value in channel.metadata.items()
            if key.startswith(UNIT)
        },
        axles=axles_of(channel),
    )


def _timestamp(time: int) -> pd.Timestamp | None:
    """The time as a time stamp; None beyond those that pandas has."""
    return None if time > pd.Timestamp.max.value else pd.Timestamp(time, tz="UTC")
