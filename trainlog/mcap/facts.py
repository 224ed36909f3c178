"""What explains a trip in its file: metadata, provenance, attachments."""

from __future__ import annotations

import json

from mcap.records import Attachment

from trainlog.errors import LogError
from trainlog.mcap.names import FORMAT_RECORD, PROVENANCE_RECORD, TRIP_RECORD
from trainlog.topics import SCHEMA_VERSION
from trainlog.trip import Trip


def attachment_of(name: str, content: bytes, time: int) -> Attachment:
    """The attachment record of a file carried along since `time` [ns]."""
    media = "application/json" if name.endswith(".json") else "application/octet-stream"
    return Attachment(create_time=0, log_time=time, name=name, media_type=media, data=content)


def metadata_records(trip: Trip) -> dict[str, dict[str, str]]:
    """The metadata records that explain a trip, by name.

    Raises
    ------
    LogError
        If they or the names of the attachments cannot be written.
    """
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
    return described


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
            f"metadata {key!r} cannot be written as UTF-8",
            remedy="remove the broken characters, or name the trip otherwise",
        ) from error
