"""Verifying a log, and rebuilding a damaged one from everything of it that is readable."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
from mcap.records import Attachment

from trainlog.errors import InputError, LogError
from trainlog.formats.files import atomic_write
from trainlog.mcap.account import Account
from trainlog.mcap.chunks import Chunk, packed
from trainlog.mcap.index import (
    AttachmentPlace,
    ChunkPlace,
    Contents,
    attachment_data,
    fetched,
    fetched_index,
)
from trainlog.mcap.reader import step_of, stream_log
from trainlog.mcap.records import (
    POSITIONS_RECORD,
    PROVENANCE_RECORD,
    RECORD_HEAD,
    RECOVERY_RECORD,
    Index,
    Source,
    checksum,
    in_file,
    opened,
    tally,
)
from trainlog.mcap.scan import check_is_mcap, scanned
from trainlog.mcap.tables import topic_channels
from trainlog.mcap.writer import Sink

_ROWS = 100_000
"""Rows read at a time where what was rebuilt is verified."""


def account_of(path: str | Path) -> Account:
    """Read a whole MCAP file, verify every checksum, and say what is readable and what is lost.

    Raises
    ------
    LogError
        If it is not an MCAP file at all.
    InputError
        If there is no such file.

    Examples
    --------
    >>> import trainlog
    >>> trainlog.check("sample_logs/nonstop.mcap")
    Account: is whole: 59,285 messages in 20 chunks
    """
    with Source(path) as source, in_file(path):
        check_is_mcap(source)
        return scanned(source).account


def recover(path: str | Path, output: str | Path) -> Account:
    """Rebuild an MCAP file, whoever wrote it, with everything of it that is readable.

    The result has every message of every complete chunk, all schemas, channels, attachments and
    metadata that are readable, and a complete index. Intact chunks are copied as they are stored.
    The account is kept in the metadata record ``trainlog.recovery``. A whole file gives a file
    that holds the same.

    Parameters
    ----------
    path : path
        The damaged file; it is only read.
    output : path
        The file to write, whole or not at all; another file than `path`.

    Returns
    -------
    Account
        Of the damaged file.

    Raises
    ------
    LogError
        If it is not an MCAP file, nothing of it is readable, or `read_log` would refuse what can be
        rebuilt of a log of trainlog.
    InputError
        If there is no such file, or `output` cannot be written.

    Examples
    --------
    >>> import trainlog
    >>> from pathlib import Path
    >>> data = Path("sample_logs/nonstop.mcap").read_bytes()
    >>> _ = Path("cut.mcap").write_bytes(data[:1_000_000])
    >>> account = recover("cut.mcap", "recovered.mcap")
    >>> account.whole, trainlog.check("recovered.mcap").messages == account.messages
    (False, True)
    """
    with Source(path) as source:
        target = Path(output)
        if target.exists() and target.samefile(path):
            raise InputError(
                "would be overwritten by what is recovered from it",
                file=output,
                remedy="name another file to write to",
            )
        with in_file(path):
            check_is_mcap(source)
            contents = scanned(source)
            account = contents.account
            _check_readable(contents, account)
        with atomic_write(output) as temporary, temporary.open("wb") as stream:
            sink = Sink(stream, profile=contents.profile)
            with in_file(path):
                _rebuild(source, contents, _recoveries(contents, path, source.size), sink)
            sink.finish()
            stream.flush()
            if topic_channels(contents):
                with in_file(path):
                    _check_reads(temporary)
    return account


def _check_reads(path: Path) -> None:
    """Raise a LogError if a rebuilt log of trainlog cannot be read."""
    try:
        for _ in stream_log(path, rows=_ROWS):
            pass
    except LogError as error:
        raise LogError(
            f"what is readable of it makes no log: {error.problem}", remedy=error.remedy
        ) from error


def _check_readable(contents: Contents, account: Account) -> None:
    if account.whole or account.messages or contents.attachments or contents.metadata:
        return
    first = account.losses[0]
    raise LogError(
        f"is damaged and nothing of it is readable: {first.reason}",
        place=f"byte {first.start}",
        remedy="copy it again from where it was recorded",
    )


def _rebuild(source: Source, contents: Contents, steps: dict[str, str], sink: Sink) -> None:
    """Write everything that was found, in the order in which a log has it."""
    sink.declare(*contents.schemas.values(), *contents.channels.values())
    for record in contents.metadata:
        # Chunks have moved; where the train was in each is found without that record, too.
        if record.name not in (RECOVERY_RECORD, POSITIONS_RECORD):
            values = record.metadata
            if record.name == PROVENANCE_RECORD:
                values = {key: text for key, text in values.items() if step_of(text) is not None}
            sink.put_metadata(record.name, values)
    sink.put_metadata(RECOVERY_RECORD, steps)
    for place in contents.attachments:
        sink.put_attachment(_attachment(source, place))
    for chunk in contents.chunks:
        sink.put_chunk(_chunk(source, chunk))


def _recoveries(contents: Contents, path: str | Path, size: int) -> dict[str, str]:
    """What the metadata record is to hold: earlier recoveries, and the present one behind them."""
    steps: dict[str, str] = {}
    for record in contents.metadata:
        if record.name == RECOVERY_RECORD:
            values = record.metadata.items()
            steps |= {key: text for key, text in values if step_of(text) is not None}
    step = {
        "software": "trainlog",
        "file": Path(path).name,
        "size": size,
        "account": contents.account.details(),
    }
    number = 1
    while f"{number:04d}" in steps:
        number += 1
    text = json.dumps(step, ensure_ascii=True, sort_keys=True)
    return steps | {f"{number:04d}": text}


def _attachment(source: Source, place: AttachmentPlace) -> Attachment:
    return Attachment(
        create_time=place.create_time,
        data=attachment_data(source, place),
        log_time=place.log_time,
        media_type=place.media_type,
        name=place.name,
    )


def _chunk(source: Source, place: ChunkPlace) -> Chunk:
    """The chunk as it is stored, or made again without messages that no channel explains."""
    chunk = fetched(source, place)
    content = opened(chunk)
    index = tally(content, _index(source, place), place.offset).index
    kept = {channel: entries for channel, entries in index.items() if channel in place.counts}
    if place.loose or len(kept) < len(index):
        return packed(_only(content, kept))
    return Chunk(
        compression=chunk.compression,
        data=chunk.data,
        size=chunk.size,
        checksum=checksum(content),
        start=place.start,
        end=place.end,
        index=kept,
    )


def _index(source: Source, place: ChunkPlace) -> Index:
    """The message index of a chunk as the file has it; empty if it has none."""
    return fetched_index(source, place, place.counts) if place.indexes else {}


def _only(content: bytes, index: Index) -> Chunk:
    """A chunk of nothing but the messages that the index lists, in the order they had."""
    listed = [
        (int(offset), int(time), channel)
        for channel, entries in index.items()
        for time, offset in entries.tolist()
    ]
    data = bytearray()
    moved: dict[int, list[tuple[int, int]]] = {channel: [] for channel in index}
    for offset, time, channel in sorted(listed):
        (length,) = struct.unpack_from("<Q", content, offset + 1)
        moved[channel].append((time, len(data)))
        data += content[offset : offset + RECORD_HEAD + length]
    return Chunk(
        data,
        min((time for _, time, _ in listed), default=0),
        max((time for _, time, _ in listed), default=0),
        {channel: np.array(pairs, dtype=np.uint64) for channel, pairs in moved.items()},
    )
