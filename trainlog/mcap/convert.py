"""Logs written anew, piece by piece: as other kinds of file and back, in part, merged, rebuilt."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pandas as pd
from mcap.records import Chunk

from trainlog.errors import InputError, LogError, in_file
from trainlog.formats.files import atomic_write, check_kept, sha256_of
from trainlog.formats.trip_tables import (
    CsvTripIndex,
    FolderWriter,
    MdfWriter,
    TripIndex,
    folder_writer,
    mdf_writer,
    read_mdf_trip,
    read_parquet,
    trip_index,
)
from trainlog.mcap.contents import ChunkPlace, Contents, check_is_mcap, fetched, index_in, scanned
from trainlog.mcap.description import LogDescription, describe
from trainlog.mcap.foreign import frames_of
from trainlog.mcap.reader import check_readable, read_log, step_of, stream_log
from trainlog.mcap.records import (
    POSITIONS_RECORD,
    PROVENANCE_RECORD,
    RECORD_HEAD,
    RECOVERY_RECORD,
    Account,
    Index,
    Source,
    attachment_at,
    checksum,
    fills,
    gone_through,
    nothing_of,
    opened,
)
from trainlog.mcap.tables import topic_channels
from trainlog.mcap.writer import LogWriter, Sink, packed, write_log
from trainlog.topics import EVENTS
from trainlog.trip import Trip, stacked
from trainlog.version import __version__

ROWS = 100_000
"""Rows that are read at a time."""

LOG, MDF = ".mcap", ".mf4"
WRITERS: dict[str, Callable[[Path], AbstractContextManager[LogWriter | FolderWriter | MdfWriter]]]
WRITERS = {
    LOG: LogWriter,
    MDF: mdf_writer,
    ".parquet": lambda folder: folder_writer(folder, TripIndex),
    ".csv": lambda folder: folder_writer(folder, CsvTripIndex),
}
"""What writes a trip, by how the name of a file or folder ends."""


@dataclass(frozen=True)
class Converted:
    """What was written.

    Attributes
    ----------
    rows : Counter of str
        Number of rows by topic.
    left_out : list of str
        What of the source is not in the target although it was asked for, and why.
    """

    rows: Counter[str] = field(default_factory=Counter)
    left_out: list[str] = field(default_factory=list)


def convert(
    source: str | Path,
    target: str | Path,
    *,
    topics: Sequence[str] | None = None,
    time: tuple[Any, Any] | None = None,
    position: tuple[float | None, float | None] | None = None,
    progress: Callable[[int], object] | None = None,
) -> Converted:
    """Write a log, or a part of it, as a log or as Parquet.

    Logs of trainlog and folders of Parquet go through in pieces, however long they are. MCAP files
    of other programs become Parquet with the frames that `frames_of` gives, in memory as a whole.

    Parameters
    ----------
    source : path
        An ``.mcap`` file, or a folder that `write_parquet` made.
    target : path
        Ending in ``.mcap`` or ``.parquet``; written whole or not at all.
    topics : sequence of str, optional
        Default: all.
    time, position : (start, end), optional
        As in `Trip.between` and `Trip.within`.
    progress : callable, optional
        Called with the number of rows after each piece.

    Raises
    ------
    LogError
        If the source cannot be read, not one of its messages can, or nothing of it is in the part
        asked for.
    InputError
        If a file is missing or cannot be written, or the target's kind is unknown.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     target = f"{folder}/trip.parquet"
    ...     done = convert("sample_logs/nonstop.mcap", target, topics=["/gnss/fix"])
    >>> done.rows
    Counter({'/gnss/fix': 5379})
    """
    source, target = Path(source), Path(target)
    if target.suffix not in WRITERS:
        raise InputError(
            "is not the name of a log, a measurement file, or a folder of Parquet or CSV files",
            file=target,
            remedy="end it in .mcap, .mf4, .parquet or .csv",
        )
    check_kept([source], target)
    done = Converted()
    pieces = _pieces(source, target, topics, time, position, done.left_out)
    with WRITERS[target.suffix](target) as writer:
        for piece in pieces:
            writer.add(piece if topics is None else piece.with_step("slice", topics=[*topics]))
            done.rows.update({name: len(frame) for name, frame in piece.topics.items()})
            if progress is not None:
                progress(done.rows.total())
        if not done.rows.total():
            if (topics, time, position) != (None, None, None):
                raise nothing_of(source)
            if done.left_out:
                raise LogError(
                    f"has no message that can be read: {done.left_out[0]}",
                    file=source,
                    remedy=f"see 'trainlog show {source}' for what it holds",
                )
    return done


def span_of(source: str | Path) -> tuple[pd.Timestamp, pd.Timestamp] | None:
    """Times of the first and the last row of a log or a folder; None if it has no rows.

    Examples
    --------
    >>> first, last = span_of("sample_logs/nonstop.mcap")
    >>> first < last
    True
    """
    source = Path(source)
    if source.is_dir() or source.suffix == MDF:
        topics = {each.topic: () for each in trip_index(source).topics} if source.is_dir() else {}
        trip = read_parquet(source, topics) if source.is_dir() else read_mdf_trip(source)
        return (trip.start, trip.end) if any(map(len, trip.topics.values())) else None
    found = describe(source)
    return None if found.first is None or found.last is None else (found.first, found.last)


def _pieces(
    source: Path,
    target: Path,
    topics: Sequence[str] | None,
    time: tuple[Any, Any] | None,
    position: tuple[float | None, float | None] | None,
    left_out: list[str],
) -> Iterator[Trip]:
    """The source in pieces; what it does not give is added to `left_out`."""
    part: dict[str, Any] = {"time": time, "position": position, "rows": ROWS}
    if source.is_dir() or source.suffix == MDF:
        trip = read_parquet(source) if source.is_dir() else read_mdf_trip(source)
        _check_known([*trip], topics, source)
        trip = trip if time is None else trip.between(*time)
        try:
            trip = trip if position is None else trip.within(*position)
        except LogError as error:
            raise LogError(error.problem, file=source, remedy=error.remedy) from error
        chosen = {name: trip[name] for name in trip if topics is None or name in topics}
        return iter([replace(trip, topics=chosen)])
    description = describe(source)
    _check_known(sorted(topic.name for topic in description.topics), topics, source)
    others = description.foreign
    if description.schema_version is None and others:
        if target.suffix == LOG:
            raise InputError(
                f"is a log of another program, with {', '.join(others[:4])}",
                file=source,
                remedy="'trainlog ingest' makes a trip of it, or name a .parquet folder",
            )
        return iter([_foreign(source, description, topics, time, position, left_out)])
    left_out += [f"{name}: no topic of trainlog" for name in others if name in (topics or others)]
    ours = None if topics is None else [name for name in topics if name not in others]
    return stream_log(source, ours, **part)


def _check_known(held: Sequence[str], topics: Sequence[str] | None, source: Path) -> None:
    for name in topics or ():
        if name not in held:
            raise LogError(
                f"has no topic {name}", file=source, remedy=f"it holds {', '.join(held)}"
            )


def _foreign(
    source: Path,
    description: LogDescription,
    topics: Sequence[str] | None,
    time: tuple[Any, Any] | None,
    position: tuple[float | None, float | None] | None,
    left_out: list[str],
) -> Trip:
    """The frames of another program's file, with its times of publishing where they differ."""
    if position is not None:
        raise InputError(
            "is a log of another program: where the train was is not known",
            file=source,
            remedy="'trainlog ingest' makes a trip of it; or choose by time",
        )
    found = frames_of(source, topics)
    left_out += [str(each) for each in found.skipped if each.messages]
    if not found.account.whole:
        left_out.append("; ".join(found.account.lines()))
    left_out += [f"attachment {each.name}: not carried over" for each in description.attachments]
    frames = {}
    for name, frame in found.frames.items():
        # The index is the column "time" of the file.
        frames[name] = frame.rename(columns={"time": "message.time"})
        if not found.publish_times[name].equals(frame.index):
            frames[name] = frames[name].assign(publish_time=found.publish_times[name])
        frames[name].attrs = frame.attrs
    trip = Trip(frames, description.metadata)
    return trip if time is None else trip.between(*time)


ONE = ("train", "line", "direction")
"""Metadata that logs of one trip agree on."""

STATED = ("load", "load_std", "weather", "configuration")
"""Metadata that are left out where logs disagree."""


@dataclass(frozen=True)
class Merged:
    """What became of the rows of the logs that were merged.

    Attributes
    ----------
    rows : Counter of str
        Written, by topic.
    repeated : Counter of str
        Rows that another log holds as well, by topic: written once.
    left_out : Counter of str
        Rows of other logs than the preferred one where both hold a topic, by topic.
    notes : list of str
        What else the logs do not agree on, a sentence each.
    """

    rows: Counter[str] = field(default_factory=Counter)
    repeated: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


def merge(
    sources: Sequence[str | Path], target: str | Path, *, prefer: str | Path | None = None
) -> Merged:
    """Write logs of one trip as one log, in the order of time; whole or not at all.

    A topic may be in several logs where their times do not overlap (parts of a trip), or where the
    samples are the same. Events of all are kept. The metadata are those of the first log; its
    provenance goes on with a step ``"merge"`` that holds metadata and provenance of all others, and
    the SHA-256 of every log.

    Parameters
    ----------
    sources : sequence of path
        Two logs at least, as `trainlog.write` or `trainlog.record` makes them.
    target : path
        Ends in ``.mcap``.
    prefer : path, optional
        One of the logs: where it holds a topic at the same time as another, it alone counts.

    Raises
    ------
    LogError
        If a log cannot be read, the logs are of different trains, lines or directions, or hold
        different samples of a topic at the same time.
    InputError
        If there are not two logs, or a file is missing or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.mcap.convert import convert
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     parts = [f"{folder}/{name}.mcap" for name in ("first", "second", "whole")]
    ...     for part, time in zip(parts, [(None, "2024-10-07T06:10"), ("2024-10-07T06:10", None)]):
    ...         done = convert("sample_logs/nonstop.mcap", part, time=time)
    ...     merged = merge(parts[:2], parts[2])
    ...     same = read_log(parts[2]) == read_log("sample_logs/nonstop.mcap")
    >>> same, merged.repeated["/train/state"]
    (True, 1)
    """
    paths = [Path(source) for source in sources]
    _check(paths, Path(target), prefer)
    done = Merged()
    for path in paths:
        held = describe(path)
        if held.schema_version is None or held.foreign:
            named = f", with {', '.join(held.foreign[:4])}" if held.foreign else ""
            raise LogError(
                f"is a log of another program{named}",
                file=path,
                remedy="'trainlog ingest' makes a trip of it",
            )
    trips = {path: read_log(path) for path in paths}
    about = _joined([*trips.values()], paths, done.notes)
    first = [] if prefer is None else [Path(prefer)]
    order = [*first, *(path for path in paths if path not in first)]
    frames = _frames({path: trips[path] for path in order}, prefer is not None, done)
    write_log(replace(about, topics=frames), target)
    done.rows.update({name: len(frame) for name, frame in frames.items()})
    return done


def _check(paths: list[Path], target: Path, prefer: str | Path | None) -> None:
    if len(paths) < 2:
        raise InputError("one log cannot be merged", remedy="name two logs at least")
    if target.suffix != ".mcap":
        raise InputError("is not the name of a log", file=target, remedy="end it in .mcap")
    for number, path in enumerate(paths):
        if path in paths[:number]:
            raise InputError("is given twice", file=path, remedy="name each log once")
    check_kept(paths, target)
    if prefer is not None and Path(prefer) not in paths:
        raise InputError(f"'{prefer}' is not one of the logs", remedy="prefer one of those named")


def _joined(trips: list[Trip], paths: list[Path], notes: list[str]) -> Trip:
    """Metadata, provenance and attachments of the merged log."""
    metadata = dict(trips[0].metadata)
    for path, trip in zip(paths[1:], trips[1:], strict=True):
        for key in ONE:
            ours, theirs = metadata.get(key), trip.metadata.get(key)
            if ours is not None and theirs is not None and ours != theirs:
                raise LogError(
                    f"states {key} '{theirs}', {paths[0]} states '{ours}'",
                    file=path,
                    remedy="merge logs of one trip",
                )
        for key, value in trip.metadata.items():
            metadata.setdefault(key, value)
    for key in STATED:
        values = {trip.metadata[key] for trip in trips if key in trip.metadata}
        if len(values) > 1:
            del metadata[key]
            notes.append(f"{key} is left out, the logs state {' and '.join(sorted(values))}")
    attachments: dict[str, bytes] = {}
    for path, trip in zip(paths, trips, strict=True):
        for name, content in trip.attachments.items():
            if attachments.setdefault(name, content) != content:
                attachments[f"{path.stem}/{name}"] = content
                notes.append(f"attachment {name} of {path} differs: kept as {path.stem}/{name}")
    step: dict[str, Any] = {
        "software": f"trainlog {__version__}",
        "inputs": {str(number): sha256_of(path) for number, path in enumerate(paths, start=1)},
        "others": [
            {"file": path.name, "metadata": trip.metadata, "provenance": [*trip.provenance]}
            for path, trip in zip(paths[1:], trips[1:], strict=True)
        ],
    }
    return Trip({}, metadata, trips[0].provenance, attachments).with_step("merge", **step)


def _frames(trips: dict[Path, Trip], preferring: bool, done: Merged) -> dict[str, pd.DataFrame]:
    """The frames of all logs; where these overlap, those of the first of `trips`."""
    names = dict.fromkeys(name for trip in trips.values() for name in trip)
    found = {}
    for name in names:
        parts: list[tuple[Path, pd.DataFrame]] = []
        for path, trip in trips.items():
            if name in trip:
                kept = trip[name]
                for before in parts:
                    kept = _apart(name, before, (path, kept), preferring, done)
                parts.append((path, kept))
        filled = [frame for _, frame in parts if len(frame)]
        found[name] = stacked(filled or [parts[0][1]])
        if len(filled) > 1:
            found[name] = found[name].iloc[found[name].index.argsort(kind="stable")]
    return found


def _apart(
    name: str,
    first: tuple[Path, pd.DataFrame],
    second: tuple[Path, pd.DataFrame],
    preferring: bool,
    done: Merged,
) -> pd.DataFrame:
    """The rows of the second log without those of the time that both hold."""
    (path, before), (other, frame) = first, second
    if before.empty or frame.empty:
        return frame
    start = max(before.index[0], frame.index[0])
    end = min(before.index[-1], frame.index[-1])
    if name == EVENTS.name:
        twice = pd.MultiIndex.from_frame(frame.reset_index()).isin(
            pd.MultiIndex.from_frame(before.reset_index())
        )
        done.repeated[name] += int(twice.sum())
        return frame[~twice]
    theirs = (frame.index >= start) & (frame.index <= end)
    ours = (before.index >= start) & (before.index <= end)
    if not theirs.any():
        return frame
    if before[ours].equals(frame[theirs]):
        done.repeated[name] += int(theirs.sum())
    elif preferring:
        done.left_out[name] += int(theirs.sum())
    else:
        raise LogError(
            f"holds other samples of {name} than {path} from {start:%Y-%m-%dT%H:%M:%S} to"
            f" {end:%H:%M:%S}",
            file=other,
            remedy=f"prefer one of the logs, as --prefer {path}, or cut the topic or the time out"
            " of one with 'trainlog convert'",
        )
    rest: pd.DataFrame = frame[~theirs]
    return rest


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
        check_kept([Path(path)], Path(output))
        with in_file(path):
            check_is_mcap(source)
            contents = scanned(source)
            account = contents.account
            if not contents.attachments:
                check_readable(account)
        with atomic_write(output) as temporary, temporary.open("wb") as stream:
            sink = Sink(stream, profile=contents.profile)
            with in_file(path):
                _rebuild(source, contents, _recoveries(contents, path, source.size), sink)
            sink.finish()
            stream.flush()
            if topic_channels(contents):
                try:
                    for _ in stream_log(temporary, rows=ROWS):
                        pass
                except LogError as error:
                    raise LogError(
                        f"what is readable of it makes no log: {error.problem}",
                        file=path,
                        remedy=error.remedy,
                    ) from error
    return account


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
    for at, _ in contents.attachments:
        sink.put_attachment(attachment_at(source, at))
    for chunk in contents.chunks:
        sink.put_chunk(*_chunk(source, chunk))


def _recoveries(contents: Contents, path: str | Path, size: int) -> dict[str, str]:
    """What the metadata record is to hold: earlier recoveries, and the present one behind them."""
    steps = {
        key: text
        for record in contents.metadata
        if record.name == RECOVERY_RECORD
        for key, text in record.metadata.items()
        if step_of(text) is not None
    }
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


def _chunk(source: Source, place: ChunkPlace) -> tuple[Chunk, Index]:
    """The chunk as it is stored, or without messages that no channel explains, and its index."""
    chunk = fetched(source, place)
    content = opened(chunk, place.offset)
    index = index_in(source, place)
    if not fills(content, index):
        index, _ = gone_through(content, place.offset)
    kept = {channel: entries for channel, entries in index.items() if channel in place.counts}
    if place.loose or len(kept) < len(index):
        # Nothing but the messages that the index lists, in the order they had.
        view = memoryview(content)
        data = b"".join(
            view[at : at + RECORD_HEAD + int.from_bytes(view[at + 1 : at + RECORD_HEAD], "little")]
            for at in sorted(int(at) for entries in kept.values() for at in entries[:, 1])
        )
        seconds = [time for entries in kept.values() for time in entries[:, 0].tolist()]
        index, _ = gone_through(data, 0)
        return packed(data, min(seconds, default=0), max(seconds, default=0)), index
    times = {"message_start_time": place.start, "message_end_time": place.end}
    return replace(chunk, **times, uncompressed_crc=checksum(content)), kept
