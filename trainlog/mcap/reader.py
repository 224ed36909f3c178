"""Reading a trip, or a part of one, from an MCAP file."""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from isal import isal_zlib
from mcap.records import Metadata

from trainlog.errors import LogError
from trainlog.mcap.account import Account, DamageWarning, Loss
from trainlog.mcap.contents import contents_of
from trainlog.mcap.errors import in_file, shown, unusable
from trainlog.mcap.filling import frames_in, topic_channels
from trainlog.mcap.located import spans_in_log
from trainlog.mcap.names import (
    FORMAT_RECORD,
    PROVENANCE_RECORD,
    RECORDING_RECORD,
    RECOVERY_RECORD,
    TRIP_RECORD,
)
from trainlog.mcap.places import AttachmentPlace, Contents
from trainlog.mcap.selection import Selection, Topics, chunks_within, selection_of
from trainlog.mcap.source import Source
from trainlog.mcap.stored import MisplacedError, attachment_data
from trainlog.mcap.tables import TopicChannel
from trainlog.mcap.walk import contents_by_walk
from trainlog.mcap.workers import threads_of
from trainlog.spans import Spans
from trainlog.topics import SCHEMA_VERSION
from trainlog.trip import Trip

_PIECE = 2**22
"""Read at once for the checksum of the data section [bytes]."""

_MOST_NAMED = 8
"""Topics of a foreign file that an error names."""


def read_log(
    path: str | Path,
    topics: Topics | None = None,
    *,
    time: tuple[Any, Any] | None = None,
    position: tuple[float | None, float | None] | None = None,
    threads: int | None = None,
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
    threads : int, optional
        Default: one a processor, at most four.

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
    """
    selection = selection_of(topics, time, position)
    with Source(path) as source, in_file(path):
        contents = contents_of(source)
        try:
            trip = trip_of(source, contents, selection, threads_of(threads))
        except MisplacedError:
            # The summary is not to be trusted, or a chunk is damaged: a walk tells what there is.
            contents = contents_by_walk(source)
            trip = trip_of(source, contents, selection, threads_of(threads))
        check_readable(contents.account)
    report_losses(path, contents)
    return with_losses(trip, contents)


def report_losses(path: str | Path, contents: Contents) -> None:
    """Warn of what is lost of a file with a `DamageWarning` at the line that called trainlog."""
    if contents.losses:
        # From here over the public function to its caller.
        warnings.warn(DamageWarning(str(path), contents.account), stacklevel=3)


def with_losses(trip: Trip, contents: Contents) -> Trip:
    """The trip, its provenance telling what of its file is lost, if anything is."""
    if not contents.losses:
        return trip
    return trip.with_step("read damaged log", account=contents.account.details())


def trip_of(source: Source, contents: Contents, selection: Selection, threads: int) -> Trip:
    """The part of a trip that is asked for; what turns out damaged is dropped from `contents`.

    Raises
    ------
    LogError
        As `read_log`.
    MisplacedError
        If something is not as the summary says by which `contents` was found.
    """
    trip = bare_trip(source, contents)
    spans = spans_of(source, contents, selection, threads)
    chunks = chunks_within(contents.chunks, spans)
    trip = replace(trip, topics=frames_in(source, contents, chunks, selection.columns, threads))
    if selection.whole:
        check_data_section(source, contents)
        return trip
    if selection.time is not None or selection.position is not None:
        trip = trip.cut(spans)
    return trip.with_slice(time=selection.time, position=selection.position)


def spans_of(source: Source, contents: Contents, selection: Selection, threads: int) -> Spans:
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
    spans = spans_in_log(source, contents, selection.stretch, threads)
    spans = spans[(spans[:, 1] >= first) & (spans[:, 0] <= last)]
    return np.clip(spans, first, last)


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
        provenance=_provenance(metadata),
        attachments={place.name: data for place, data in attachments_of(source, contents)},
    )


def check_data_section(source: Source, contents: Contents) -> None:
    """Verify what is outside of the chunks and attachments, each of which has its own checksum.

    Raises
    ------
    MisplacedError
        If it fails, or an attachment has, and the contents were found by the summary; a walk
        tells more.
    """
    if contents.data_section is None or not contents.indexed:
        return
    if contents.losses:
        raise MisplacedError(contents.losses[0].reason, place=f"byte {contents.losses[0].start}")
    end, expected = contents.data_section
    checksum = 0
    for at in range(0, end if expected else 0, _PIECE):
        checksum = isal_zlib.crc32(source.read(at, min(_PIECE, end - at)), checksum)
    if checksum != expected:
        raise MisplacedError("the data section fails its checksum", place=f"byte {end}")


def attachments_of(source: Source, contents: Contents) -> list[tuple[AttachmentPlace, bytes]]:
    """Each attachment with its content; those that fail their checksum are dropped."""
    found = []
    for place in list(contents.attachments):
        try:
            found.append((place, attachment_data(source, place)))
        except LogError as error:
            contents.attachments.remove(place)
            end = place.offset + place.length
            contents.losses.append(Loss(place.offset, end, error.problem, messages=0))
    return found


def metadata_of(contents: Contents) -> dict[str, dict[str, str]]:
    """The metadata records of a file by name; records of the same name are joined."""
    found: dict[str, dict[str, str]] = {}
    record: Metadata
    for record in contents.metadata:
        found.setdefault(record.name, {}).update(record.metadata)
    return found


def _provenance(metadata: dict[str, dict[str, str]]) -> tuple[dict[str, Any], ...]:
    """The processing steps that a file's metadata records tell, oldest first.

    How a recording ended is told behind its last sample, and what was lost when a log was rebuilt
    in a record of its own. Both belong to the trip: whatever is made of it says so, too.
    """
    steps = _steps(metadata, PROVENANCE_RECORD)
    ended = metadata.get(RECORDING_RECORD, {})
    recorded = [number for number, step in enumerate(steps) if step.get("step") == "record"]
    if ended and recorded:
        steps[recorded[-1]] |= ended
    for step in _steps(metadata, RECOVERY_RECORD):
        account = step.get("account")
        if isinstance(account, dict) and account.get("losses"):
            steps.append({"step": "recover"} | step)
    return tuple(steps)


def _steps(metadata: dict[str, dict[str, str]], name: str) -> list[dict[str, Any]]:
    steps = []
    for key, text in sorted(metadata.get(name, {}).items()):
        try:
            step = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise unusable(f"step {shown(key)} of the provenance is not JSON") from error
        if not isinstance(step, dict):
            raise unusable(f"step {shown(key)} of the provenance is not an object")
        steps.append(step)
    return steps


def _check_version(
    contents: Contents, metadata: dict[str, dict[str, str]], channels: list[TopicChannel]
) -> None:
    """Refuse files that hold no trip, and those of a later version."""
    if FORMAT_RECORD not in metadata and not channels:
        held = sorted({shown(channel.topic) for channel in contents.channels.values()})
        raise LogError(
            f"holds no topic of trainlog, but {', '.join(held[:_MOST_NAMED]) or 'none at all'}"
            + (f" and {len(held) - _MOST_NAMED} more" if len(held) > _MOST_NAMED else ""),
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
