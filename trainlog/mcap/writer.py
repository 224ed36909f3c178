"""Writing a trip as an MCAP file."""

from __future__ import annotations

import json
from pathlib import Path

from mcap.records import Attachment, Metadata

from trainlog.errors import LogError
from trainlog.formats.files import atomic_write
from trainlog.mcap.chunks import Stream, chunks
from trainlog.mcap.errors import in_file
from trainlog.mcap.names import FORMAT_RECORD, PROVENANCE_RECORD, TRIP_RECORD
from trainlog.mcap.sink import Sink, packed
from trainlog.mcap.streams import streams_of
from trainlog.topics import SCHEMA_VERSION
from trainlog.trip import Trip


def write_log(trip: Trip, path: str | Path) -> None:
    """Write a trip as an MCAP file, whole or not at all.

    The same trip gives the same bytes. Absent columns and NaN are written as NaN, which reads as
    absent.

    Raises
    ------
    LogError
        If the trip cannot be written: a topic or column that the table does not have, times that
        run backwards, metadata that are not text.
    InputError
        If `path` cannot be written.
    """
    with in_file(path):
        streams = streams_of(trip)
        described = _metadata(trip)
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        _write(streams, described, trip.attachments, Sink(stream))


def _write(
    streams: list[Stream], described: list[Metadata], attachments: dict[str, bytes], sink: Sink
) -> None:
    """The whole file. What explains it comes first, so that a cut file still has it."""
    for stream in streams:
        sink.declare(stream.schema)
    for stream in streams:
        sink.declare(stream.channel)
    for record in described:
        sink.put_metadata(record.name, record.metadata)
    start = min((int(stream.time[0]) for stream in streams if len(stream.time)), default=0)
    for name, content in sorted(attachments.items()):
        sink.put_attachment(attachment_of(name, content, start))
    for chunk in chunks(streams):
        sink.put_chunk(packed(chunk))
    sink.finish()


def attachment_of(name: str, content: bytes, time: int) -> Attachment:
    """The attachment record of a file carried along since `time` [ns]."""
    media = "application/json" if name.endswith(".json") else "application/octet-stream"
    return Attachment(create_time=0, log_time=time, name=name, media_type=media, data=content)


def _metadata(trip: Trip) -> list[Metadata]:
    """The metadata records of a trip."""
    described = {
        FORMAT_RECORD: {"schema_version": str(SCHEMA_VERSION)},
        TRIP_RECORD: dict(sorted(trip.metadata.items())),
        PROVENANCE_RECORD: {
            f"{number:04d}": _json(step, number)
            for number, step in enumerate(trip.provenance, start=1)
        },
    }
    for values in described.values():
        for key, value in values.items():
            _check_text(key, value)
    for name in trip.attachments:
        _check_text(name, name)
    return [Metadata(name=name, metadata=values) for name, values in described.items()]


def _json(step: object, number: int) -> str:
    try:
        return json.dumps(step, ensure_ascii=False, allow_nan=False, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise LogError(
            f"step {number} of the provenance is not JSON: {error}",
            remedy="use text, finite numbers, lists and dictionaries with text keys",
        ) from error


def _check_text(key: object, value: object) -> None:
    if not isinstance(key, str) or not isinstance(value, str):
        raise LogError(
            f"metadata {key!r} is {value!r}, not text", remedy="turn it into text with str()"
        )
    try:
        f"{key}{value}".encode()
    except UnicodeEncodeError as error:
        raise LogError(
            f"metadata {key!r} cannot be written as UTF-8", remedy="remove the broken characters"
        ) from error
