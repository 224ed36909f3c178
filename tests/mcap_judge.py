"""Whether what trainlog makes of a damaged log is right: judged against what was written."""

import resource
import signal
import struct
import sys
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from mcap_mutations import CHANNEL, CHUNK, HEAD, MAGIC, SCHEMA, records_of
from mcap_trips import trip_of

from trainlog import DamageWarning, LogError, TrainlogError, Trip, describe, recover
from trainlog.mcap import account_of, read_log, write_log
from trainlog.mcap.contents import check_is_mcap, contents_of, fetched, index_in, scanned
from trainlog.mcap.records import Account, Source, message_data, opened
from trainlog.topics import EVENTS, GNSS_FIX, TRAIN_STATE

Message = tuple[str, int, bytes]  # topic, log time and data

_TWICE = ("comes again", "one file ends here", "without its chunk")
"""What an account says of files in which something comes twice."""

LONGEST = 20  # no reading of a small file may take more time of the processor [s]


@dataclass(frozen=True)
class Specimen:
    """A whole log and what is in it."""

    name: str
    data: bytes
    messages: Counter[Message]
    groups: list[tuple[bytes, Counter[Message]]] = field(repr=False)  # each chunk's record
    declarations: list[bytes] = field(repr=False)  # its schema and channel records
    trip: Trip | None = None  # none if it is not one of trainlog's


def specimen(name: str, data: bytes, trip: Trip | None = None) -> Specimen:
    """The specimen that a whole file is, by what the official reader finds in it."""
    records = records_of(data)
    channels = {channel.id: channel.topic for channel in _summary(data).channels.values()}
    groups = []
    for record in records:
        if record.opcode == CHUNK:
            alone = MAGIC + data[record.start : record.end]
            groups.append((data[record.start : record.end], _streamed(alone, channels)))
    declarations = [data[r.start : r.end] for r in records if r.opcode in (SCHEMA, CHANNEL)]
    return Specimen(name, data, _streamed(data, channels), groups, declarations, trip)


def _summary(data: bytes):
    return SeekingReader(BytesIO(data)).get_summary()


def _streamed(data: bytes, channels: dict[int, str]) -> Counter[Message]:
    found: Counter[Message] = Counter()
    stream = StreamReader(BytesIO(data)).records
    while True:
        try:
            record = next(stream)
        except (StopIteration, McapError):
            return found
        if type(record).__name__ == "Message":
            found[channels[record.channel_id], record.log_time, record.data] += 1


@cache
def specimens(folder: Path) -> tuple[Specimen, ...]:
    """Logs of trainlog and of other programs, 3 to 30 kB, in every way in which files are cut."""
    made = []
    path = folder / "whole.mcap"
    for name, rows, topics in (
        ("three chunks", 60, [TRAIN_STATE.name, EVENTS.name]),
        ("one chunk", 12, [TRAIN_STATE.name, GNSS_FIX.name, EVENTS.name]),
    ):
        trip = trip_of(rows=rows, axles=2, topics=topics)
        for frame in trip.topics.values():
            # Far enough apart for a chunk every twenty rows.
            frame.index = frame.index[0] + (frame.index - frame.index[0]) * 30
        write_log(trip, path)
        made.append(specimen(name, path.read_bytes(), trip))
    made += [
        specimen("zstd", foreign(CompressionType.ZSTD)),
        specimen("lz4", foreign(CompressionType.LZ4)),
        specimen("not compressed", foreign(CompressionType.NONE)),
        specimen("without chunks", foreign(CompressionType.NONE, chunks=False)),
    ]
    return tuple(made)


def foreign(compression: CompressionType, *, chunks: bool = True) -> bytes:
    """A log as another program writes it: JSON, schemas in the chunks, own sequence numbers."""
    stream = BytesIO()
    writer = Writer(
        stream, chunk_size=1000, compression=compression, use_chunking=chunks, enable_data_crcs=True
    )
    writer.start(profile="other", library="other 1")
    random = np.random.default_rng(8)
    numbers = []
    for topic in ("/pose", "/state", "/log"):
        schema = writer.register_schema(f"pkg{topic}", "jsonschema", b'{"type": "object"}')
        numbers.append(writer.register_channel(topic, "json", schema, {"unit": "m"}))
    writer.add_attachment(10, 5, "notes.txt", "text/plain", b"by hand " * 20)
    for row in range(60):
        data = b'{"x": %d, "y": "%s"}' % (row, random.bytes(10).hex().encode())
        time = 10**18 + row * 10**8
        writer.add_message(numbers[row % 3], time, data, time, sequence=row // 3)
    writer.add_metadata("about", {"place": "here", "who": "other"})
    writer.finish()
    return stream.getvalue()


class Hang(BaseException):
    """A file took longer than any file may."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `Hang` after so much time of the processor, however busy it is with others [s]."""

    def stop(*_: object) -> None:
        raise Hang

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def most_memory() -> int:
    """The most memory that this process has had so far [bytes]."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


def verdict(data: bytes, whole: Specimen, path: Path, *, rebuild: bool = True) -> list[str]:
    """What is wrong with how trainlog reads these bytes, the damaged form of a whole log.

    They are put at `path`; what is rebuilt of them is ``recovered.mcap`` beside it.
    """
    path.write_bytes(data)
    wrong: list[str] = []
    try:
        with time_limit(LONGEST), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            wrong += _judged(data, whole, path, rebuild=rebuild)
    except Hang:
        return ["takes too long"]
    except BaseException as error:  # noqa: BLE001
        frames = traceback.extract_tb(error.__traceback__)
        place = " < ".join(f"{each.name}:{each.lineno}" for each in frames[:-4:-1])
        return [f"raises {type(error).__name__}: {error} ({place})"]
    others = (each.message for each in caught if not isinstance(each.message, DamageWarning))
    return [*wrong, *(f"warns: {each}" for each in others)]


def _judged(data: bytes, whole: Specimen, path: Path, *, rebuild: bool) -> Iterator[str]:
    try:
        with Source(path) as source:
            check_is_mcap(source)
            contents = scanned(source)
            account, in_scan = contents.account, messages_in(source, contents)
            if account.whole and messages_in(source, contents_of(source)) != in_scan:
                yield "the index gives other messages than the scan"
    except LogError:
        if any(chunk in data for chunk, _ in whole.groups):
            yield "a file that holds whole chunks is refused"
        for read in (read_log, describe, account_of):
            try:
                read(path)
            except TrainlogError:
                continue
            yield f"{read.__name__} reads what the scan refuses"
        return
    yield from _account(data, account)
    yield from _messages(data, whole, in_scan, account)
    yield from _trip(path, whole, account)
    if rebuild:
        if account_of(path) != account:
            yield "account_of gives another account than the scan"
        if account.whole and not describe(path).complete:
            yield "describe calls a whole file incomplete"
        yield from _recovered(path, in_scan, account)


def messages_in(source: Source, contents) -> Counter[Message]:
    """Every message that the contents of a file lead to."""
    found: Counter[Message] = Counter()
    for place in contents.chunks:
        content = opened(fetched(source, place), place.offset)
        for channel, entries in index_in(source, place).items():
            if channel not in place.counts:
                continue
            topic = contents.channels[channel].topic
            for offset in entries[:, 1].tolist():
                message = message_data(content, offset, channel)
                found[topic, message[0], message[1]] += 1
    return found


def _account(data: bytes, account: Account) -> Iterator[str]:
    """Every byte is read, or part of one loss."""
    kept, at = bytearray(), 0
    for loss in account.losses:
        if not at <= loss.start <= loss.end <= len(data):
            yield f"the loss {loss} overlaps another one, or is not in the file"
            return
        kept += data[at : loss.start]
        at = loss.end
    kept += data[at:]
    at = len(MAGIC) if not account.losses or account.losses[0].start > 0 else 0
    while at < len(kept):
        if kept[at:] == MAGIC:
            return
        if at + HEAD > len(kept):
            break
        opcode, length = struct.unpack_from("<BQ", kept, at)
        at += HEAD + length
        if not opcode or at > len(kept):
            break
    if at != len(kept):
        yield "bytes that are said to be read are no records"


def _messages(data, whole, found, account):
    """What comes back was written, and everything that can come back does."""
    if found.total() != account.messages:
        yield f"{found.total()} messages come back, the account says {account.messages}"
    if account.whole and found != whole.messages:
        yield "other messages come back than were written, and nothing is said to be lost"
    if whole.groups:
        written, read = whole.messages, found
        if not account.whole:
            # Channels have no checksum of their own: a name can be damaged, as the account says.
            written, read = _nameless(written), _nameless(read)
        if not read <= written:
            yield "messages come back that were not written, or twice"
        if account.messages_lost is not None:
            accounted = account.messages + account.messages_lost
            # Of what comes twice, damaged otherwise each time, nothing says that it is the same.
            twice = any(word in loss.reason for loss in account.losses for word in _TWICE)
            if accounted > whole.messages.total() and not twice and read != written:
                yield f"{accounted} messages are accounted for, not {whole.messages.total()}"
    reasons = " ".join(loss.reason for loss in account.losses)
    if "declared" not in reasons and all(each in data for each in whole.declarations):
        for chunk, messages in whole.groups:
            if chunk in data and not _nameless(messages) <= _nameless(found):
                yield "a whole chunk does not come back"


def _nameless(messages: Counter[Message]) -> Counter[tuple[int, bytes]]:
    """The messages without their topics."""
    found: Counter[tuple[int, bytes]] = Counter()
    for (_, time, data), count in messages.items():
        found[time, data] += count
    return found


def _trip(path: Path, whole: Specimen, account: Account) -> Iterator[str]:
    """Reading the trip gives rows that were written; all of them, or a warning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            trip = read_log(path)
        except TrainlogError as error:
            if whole.trip is not None and account.whole:
                yield f"read_log refuses a whole file: {error}"
            return
    others = [each.message for each in caught if not isinstance(each.message, DamageWarning)]
    if others:
        yield f"read_log warns: {others}"
    if whole.trip is None:
        return
    said = [each.message.account for each in caught if isinstance(each.message, DamageWarning)]
    if said and said[0].messages != account.messages:
        yield f"read_log says {said[0].messages} are readable, account_of {account.messages}"
    if said and not all(each in path.read_bytes() for each in whole.declarations):
        # A schema of which no copy is whole gives its columns other names.
        return
    for name, frame in whole.trip.topics.items():
        written = _rows(frame)
        read = _rows(trip.topics[name]) if name in trip.topics else Counter()
        if not read <= written:
            yield f"read_log gives rows of {name} that were not written"
        if not said and read != written:
            yield f"read_log gives {read.total()} of {written.total()} rows of {name} in silence"


def _rows(frame: pd.DataFrame) -> Counter[tuple[int, tuple[object, ...]]]:
    """The frame's rows, comparable to the last bit."""
    columns = [
        frame[name].to_numpy().view(np.int64) if frame[name].dtype == np.float64 else frame[name]
        for name in frame.columns
    ]
    rows = zip(*columns, strict=True)
    return Counter(zip(pd.DatetimeIndex(frame.index).asi8.tolist(), rows, strict=True))


def _reads(path: Path) -> bool:
    """Whether a damaged log gives a trip."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DamageWarning)
        try:
            read_log(path)
        except TrainlogError:
            return False
    return True


def _recovered(path: Path, in_scan: Counter[Message], account: Account) -> Iterator[str]:
    """What is rebuilt is whole, by the official reader's checks, and holds the same."""
    output = path.with_name("recovered.mcap")
    output.unlink(missing_ok=True)
    try:
        recovered = recover(path, output)
    except LogError as error:
        if account.messages and _reads(path):
            yield f"recover refuses a file with messages: {error}"
        return
    if recovered != account:
        yield "recover accounts otherwise than account_of"
    again = account_of(output)
    if not again.whole or again.messages != account.messages:
        yield f"what is rebuilt is not whole: {again}"
    data = output.read_bytes()
    channels = {channel.id: channel.topic for channel in _summary(data).channels.values()}
    found: Counter[Message] = Counter()
    for _, channel, message in SeekingReader(BytesIO(data), validate_crcs=True).iter_messages():
        found[channels[channel.id], message.log_time, message.data] += 1
    if found != in_scan:
        yield "the official reader finds other messages in what is rebuilt"
