"""An MCAP file read at any place, and its records, taken apart with every length checked.

The official package reads records from a stream and trusts their lengths; here a length that
leads out of the file, or a content that does not parse, is a `LogError` at a byte offset.
"""

from __future__ import annotations

import os
import struct
import threading
from array import array
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn, Protocol, TypeVar

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from isal import isal_zlib
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    Metadata,
    Schema,
    Statistics,
)
from numpy.typing import NDArray

from trainlog.arrays import UintArray
from trainlog.display import counted
from trainlog.errors import InputError, LogError
from trainlog.formats.files import refuse_reading

LISTED = 100
"""Losses that are kept one by one with what is made of a log; the others are counted."""


NOT_CLOSED = "the file ends without its closing records"
"""Why a file is not whole that was not closed, if nothing else is wrong with it."""


@dataclass(frozen=True)
class Loss:
    """A stretch of a file that could not be read.

    Attributes
    ----------
    start, end : int
        Its first byte, and the byte behind its last.
    reason : str
        What is wrong there.
    messages : int or None
        How many messages it held; None where nothing in the file says so.
    """

    start: int
    end: int
    reason: str
    messages: int | None = None


@dataclass(frozen=True)
class Unfinished:
    """A live recording that was not closed: its recorder was killed, or lost its power.

    Attributes
    ----------
    last : int or None
        Time of the last sample that is in the file [ns since 1970 UTC]; None if there is none.
    flush : float
        Period after which what was recorded is in the file [s]: the most that is missing.
    """

    last: int | None
    flush: float

    def __str__(self) -> str:
        """What happened, in words."""
        return f"the recording was not closed; {self.missing}"

    @property
    def missing(self) -> str:
        """How much at most is missing, in words."""
        if self.last is None:
            return f"at most {self.flush:g} s are missing"
        second, rest = divmod(self.last, 10**9)
        try:
            text = datetime.fromtimestamp(second, UTC).strftime("%Y-%m-%d %H:%M:%S")
        except (OverflowError, OSError, ValueError):
            text = f"{second} s after 1970,"
        return (
            f"its last sample is of {text}.{rest // 10**6:03d} UTC, "
            f"at most {self.flush:g} s after it are missing"
        )


@dataclass(frozen=True, repr=False)
class Account:
    """What was read of a file, and each stretch that was lost.

    Every byte of the file was read, or is part of one loss. A loss of no bytes stands where
    something is missing, or where what was read contradicts itself.

    Attributes
    ----------
    messages, chunks : int
        That are readable.
    losses : tuple of Loss
        In the order of the file; empty if it is whole.
    unfinished : Unfinished or None
        If the file is a live recording that was not closed.
    expected : int or None
        How many messages the file held, by its statistics; None if these are not readable.
    topics : tuple of (str, int, int)
        Topics of which messages are lost: how many, of how many that the file held, by its
        statistics.
    """

    messages: int
    chunks: int
    losses: tuple[Loss, ...] = ()
    unfinished: Unfinished | None = None
    expected: int | None = None
    topics: tuple[tuple[str, int, int], ...] = ()

    def __repr__(self) -> str:
        return f"Account: {self.sentence}"

    @property
    def whole(self) -> bool:
        """Whether nothing is lost."""
        return not self.losses

    @property
    def bytes_lost(self) -> int:
        """Length of all stretches that could not be read [bytes]."""
        return sum(loss.end - loss.start for loss in self.losses)

    @property
    def messages_lost(self) -> int | None:
        """How many messages were lost; None where nothing in the file says so."""
        if self.expected is not None:
            return max(0, self.expected - self.messages)
        known = all(loss.messages is not None for loss in self.losses)
        return self._counted_lost if known else None

    @property
    def _counted_lost(self) -> int:
        """Messages of the losses that are counted: at least so many are lost."""
        return sum(loss.messages or 0 for loss in self.losses)

    @property
    def only_unclosed(self) -> bool:
        """Whether nothing is wrong but that the file was not closed."""
        ended = self.unfinished is not None or self.losses[-1].reason == NOT_CLOSED
        return ended and self.bytes_lost == 0 and self.messages_lost in (0, None)

    @property
    def sentence(self) -> str:
        """The account in one sentence."""
        if self.whole:
            return f"is whole: {self._readable}"
        readable = f"{counted(self.messages, 'message')} {_are(self.messages)} readable"
        first, *others = self.losses
        if self.only_unclosed:
            missing = f"; {self.unfinished.missing}" if self.unfinished else ""
            return f"was not closed: {readable}{missing}"
        more = f", and {len(others):,} more" if others else ""
        unfinished = f"; {self.unfinished}" if self.unfinished else ""
        return (
            f"is damaged: {readable}{self._lost} "
            f"(byte {first.start:,}: {first.reason}{more}){unfinished}"
        )

    @property
    def _lost(self) -> str:
        """How much is lost, in words."""
        count = self._counted_lost if self.messages_lost is None else self.messages_lost
        parts = [counted(count, "message")] if count else []
        parts += [counted(self.bytes_lost, "byte")] if self.bytes_lost else []
        if not parts:
            return ""
        one = len(parts) == 1 and 1 in (count, self.bytes_lost)
        least = "at least " if count and self.messages_lost is None else ""
        return f", {least}{' and '.join(parts)} {'is' if one else 'are'} lost"

    @property
    def _readable(self) -> str:
        return f"{counted(self.messages, 'message')} in {counted(self.chunks, 'chunk')}"

    def lines(self) -> list[str]:
        """The account in words: what is readable, then one line a loss."""
        shown = [f"{self._readable} {_are(self.messages)} readable"]
        for loss in self.losses:
            held = "" if loss.messages is None else f", {counted(loss.messages, 'message')}"
            size = counted(loss.end - loss.start, "byte")
            shown.append(
                f"lost: bytes {loss.start:,} to {loss.end:,} ({size}{held}): {loss.reason}"
            )
        for topic, lost, all_held in self.topics:
            share = lost / all_held
            shown.append(f"lost of {topic}: {lost:,} of {all_held:,} messages ({share:.1%})")
        if self.unfinished:
            shown.append(str(self.unfinished))
        return shown

    def details(self) -> dict[str, Any]:
        """The account as JSON, for metadata and provenance; `LISTED` losses one by one."""
        return {
            "messages": self.messages,
            "chunks": self.chunks,
            "bytes_lost": self.bytes_lost,
            "messages_lost": self.messages_lost,
            "lost_by_topic": [
                {"topic": topic, "lost": lost, "of": held} for topic, lost, held in self.topics
            ],
            "losses": [asdict(loss) for loss in self.losses[:LISTED]],
            "losses_beyond": max(0, len(self.losses) - LISTED),
            "unfinished": asdict(self.unfinished) if self.unfinished else None,
        }


class DamageWarning(UserWarning):
    """A log was read although part of it is lost; `account` says what.

    Parameters
    ----------
    file : str
        The file's path.
    account : Account

    Examples
    --------
    >>> import warnings
    >>> import trainlog
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", DamageWarning)  # a damaged log is then an error
    ...     trip = trainlog.read("sample_logs/nonstop.mcap")
    """

    def __init__(self, file: str, account: Account) -> None:
        self.file = file
        self.account = account
        super().__init__(
            f"{file}: {account.sentence}; 'trainlog show --check' lists what is lost, "
            "'trainlog convert' rebuilds the file"
        )


def _are(number: int) -> str:
    return "is" if number == 1 else "are"


MESSAGE = struct.Struct("<BQHIQQ")
"""Head of a message record: opcode, length, channel, sequence, log time, publish time."""


RECORD_HEAD = 9
"""Bytes of opcode and length before the content of any record."""


_LONGEST = 60
"""Texts from a file are cut to this many characters in a message."""


def damaged(offset: int, problem: str) -> LogError:
    """The error that says at which byte a file is damaged."""
    return LogError(problem, place=f"byte {offset}", remedy="copy or record it again")


def unusable(problem: str) -> LogError:
    """The error for something that whoever wrote the file has got wrong."""
    return LogError(problem, remedy="write it again with a program that keeps to the format")


def nothing_of(path: str | Path) -> LogError:
    """The error for a part that was asked for and holds nothing."""
    return LogError(
        "holds nothing of the part asked for",
        file=path,
        remedy=f"see 'trainlog show {path}' for its topics, times and positions",
    )


MOST_NAMED = 8
"""Topics that an error names."""


def shown(text: str) -> str:
    """A text from a file, for a message: on one line, of bounded length, in quotes."""
    cut = text if len(text) <= _LONGEST else f"{text[:_LONGEST]} …"
    return repr(cut)


class Source:
    """A file open for reading at any place, by one thread; small pieces by a window that is kept.

    It is a context manager that closes the file.

    Parameters
    ----------
    path : path

    Attributes
    ----------
    path : Path
    size : int
        Length of the file when it was opened [bytes].

    Raises
    ------
    InputError
        If it is missing, not a regular file, or may not be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._start, self._window = 0, b""
        try:
            if self.path.exists() and not (self.path.is_file() or self.path.is_dir()):
                # Opening a pipe would wait for its other end.
                remedy = "copy it to a file first"
                raise InputError("is not a regular file", file=path, remedy=remedy)
            self._file = self.path.open("rb", buffering=0)
        except (OSError, ValueError) as error:
            self._refuse(error)
        self.size = os.fstat(self._file.fileno()).st_size

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, offset: int, length: int) -> bytes:
        """The bytes from `offset`, as many as `length` or the end of the file allow.

        Raises
        ------
        InputError
            If the file cannot be read any more, or has become shorter than it was.
        """
        length = max(0, min(length, self.size - offset))
        within = offset - self._start
        if not 0 <= within <= len(self._window) - length:
            if length > _WINDOW:
                return self._read(offset, length)
            self._start, within = offset, 0
            self._window = self._read(offset, min(_WINDOW, self.size - offset))
        return self._window[within : within + length]

    def _read(self, offset: int, length: int) -> bytes:
        parts = []
        while length > 0:
            try:
                self._file.seek(offset)
                part = self._file.read(length)
            except (OSError, ValueError) as error:
                self._refuse(error)
            if not part:
                raise InputError(
                    "became shorter while it was read",
                    file=self.path,
                    place=f"byte {offset}",
                    remedy="read it when no other program changes it",
                )
            parts.append(part)
            offset += len(part)
            length -= len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def head(self, at: int) -> tuple[int, int]:
        """Opcode and end of the record at `at`; a LogError if none can stand there."""
        return record_head(self.read, at, self.size)

    def checksum(self, start: int, end: int) -> int:
        """CRC-32 of the file from `start` to `end`."""
        found = 0
        for at in range(start, end, _PIECE):
            found = checksum(self.read(at, min(_PIECE, end - at)), found)
        return found

    def _refuse(self, error: OSError | ValueError) -> NoReturn:
        if isinstance(error, OSError):
            refuse_reading(self.path, error)
        raise InputError(
            f"cannot be read: {error}", file=self.path, remedy="check the path"
        ) from error


# -------------------------------------------------------------------------------------- records

FORMAT_RECORD = "trainlog.format"
"""Metadata record that says which version of the table of topics the file follows."""

TRIP_RECORD = "trainlog"
"""Metadata record that holds the trip's metadata."""

RECORDING_RECORD = "trainlog.recording"
"""Metadata record of a live recording: ``flush`` is the period [s] after which what it was given is
in the file, so the most that a crash costs. A second one, at the end, says how it ended."""

PROVENANCE_RECORD = "trainlog.provenance"
"""Metadata record that holds one JSON object a processing step, under ``0001``, ``0002`` ..."""

RECOVERY_RECORD = "trainlog.recovery"
"""Metadata record of a recovered file: one JSON object a recovery, under ``0001``, ``0002`` ...,
with the account of what was lost."""

POSITIONS_RECORD = "trainlog.positions"
"""Metadata record that holds the positions in each chunk, see `trainlog.mcap.codec`."""

Index = dict[int, UintArray]
"""Log time and offset in the chunk, shape (n, 2), of the messages by channel id."""

KINDS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.STATISTICS: Statistics,
    Opcode.DATA_END: DataEnd,
    Opcode.FOOTER: Footer,
}
"""Records of which the content is used, but for chunks, their indexes and attachments."""

DECLARATIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
"""What explains messages."""

_LARGEST_CHUNK = 2**30
"""Larger chunks are refused: a damaged length must not exhaust the memory [bytes]."""

_HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("time", "<u8")]
)
"""What is compared of a message with its index."""

_WINDOW = 2**16
"""Kept of a file that is read in small pieces [bytes]."""

_PIECE = 2**22
"""Read at once for a checksum [bytes]."""

_ATTACHMENT_NUMBERS = 32
"""Bytes of an attachment before its checksum, but for its texts and its content."""

_RECORD_HEAD = struct.Struct("<BQ")

Read = Callable[[int, int], bytes]
"""What gives the bytes at an offset, as many as a length."""

_R_co = TypeVar("_R_co", covariant=True)


class _Readable(Protocol[_R_co]):
    """A record class of the mcap package."""

    def read(self, stream: ReadDataStream) -> _R_co: ...


def records(read: Read, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Offset, opcode and end of each record from `at` to `end`.

    Raises
    ------
    LogError
        Where a record leads beyond `end`.
    """
    while at < end:
        opcode, behind = record_head(read, at, end)
        yield at, opcode, behind
        at = behind


def record_head(read: Read, at: int, end: int) -> tuple[int, int]:
    """Opcode and end of the record at byte `at`.

    Raises
    ------
    LogError
        If none can stand there, before `end`.
    """
    rest = end - at - RECORD_HEAD
    if rest < 0:
        raise damaged(at, "the file ends inside a record")
    opcode, length = _RECORD_HEAD.unpack(read(at, RECORD_HEAD))
    if opcode == 0:
        raise damaged(at, "there is no record with opcode 0")
    if length > rest:
        raise damaged(at, f"a record of {length:,} bytes begins and only {rest:,} bytes follow")
    return opcode, at + RECORD_HEAD + length


class _Content:
    """The content of a record as a stream: no more is read than its fields say, none beyond it."""

    def __init__(self, read: Read, at: int, end: int) -> None:
        self.at, self._end, self._first = at, end, at
        self._read = read
        self._held = read(at, min(end - at, _WINDOW))

    def read(self, length: int) -> bytes:
        at, self.at = self.at, self.at + length
        if self.at > self._end:
            raise EndOfFile
        found = self._held[at - self._first : self.at - self._first]
        return found if len(found) == length else self._read(at, length)


def parsed(kind: _Readable[_R_co], read: Read, at: int, end: int, *, exact: bool = False) -> _R_co:
    """The record from `at` to `end`, as a class of the mcap package.

    What is behind its fields belongs to a later version of the format, and is passed over.

    Parameters
    ----------
    kind : class
    read : callable
    at, end : int
    exact : bool
        Whether nothing may be behind its fields.

    Raises
    ------
    LogError
        If the content does not parse.
    """
    content = _Content(read, at + RECORD_HEAD, end)
    try:
        found = kind.read(ReadDataStream(content))
        if exact and content.at < end:
            raise EndOfFile
    except (McapError, struct.error, ValueError, OverflowError, MemoryError) as error:
        name = getattr(kind, "__name__", "record").lower()
        raise damaged(at, f"the {name} record cannot be read") from error
    return found


def chunk_at(source: Source, at: int) -> Chunk:
    """The chunk whose record begins at byte `at` of a file.

    Raises
    ------
    LogError
        If there is none; what a damaged length claims is not read.
    """
    opcode, end = source.head(at)
    if opcode != Opcode.CHUNK:
        raise damaged(at, "there is no chunk")
    chunk: Chunk = parsed(Chunk, source.read, at, end, exact=True)
    if chunk.uncompressed_size > _LARGEST_CHUNK:
        raise damaged(at, f"a chunk claims to hold {chunk.uncompressed_size:,} bytes")
    return chunk


def attachment_at(source: Source, at: int) -> Attachment:
    """The attachment whose record begins at byte `at` of a file, its checksum verified.

    Raises
    ------
    LogError
        If there is none, or it fails its checksum.
    """
    found: Attachment = parsed(Attachment, source.read, at, source.head(at)[1], exact=True)
    texts = f"{found.name}{found.media_type}".encode()
    start = at + RECORD_HEAD
    end = start + _ATTACHMENT_NUMBERS + len(texts) + len(found.data)
    expected = int.from_bytes(source.read(end, 4), "little")
    if expected not in (0, source.checksum(start, end)):
        raise damaged(at, f"attachment {shown(found.name)} fails its checksum")
    return found


def opened(chunk: Chunk, offset: int) -> bytes:
    """The content of the chunk at `offset` of a file, decompressed, its checksum verified.

    Raises
    ------
    LogError
        If it cannot be decompressed, has another length than declared, or fails its checksum.
    """
    try:
        content = _decompressed(chunk)
    except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError) as error:
        raise damaged(offset, "a chunk cannot be decompressed") from error
    if content is None:
        raise LogError(
            f"a chunk is compressed as {shown(chunk.compression)}",
            place=f"byte {offset}",
            remedy="compress it with zstd or lz4",
        )
    if len(content) != chunk.uncompressed_size:
        raise damaged(offset, "a chunk has another length than it declares")
    if chunk.uncompressed_crc not in (0, checksum(content)):
        raise damaged(offset, "a chunk fails its checksum")
    return content


class _Decompressor(threading.local):
    """One decompressor a thread: setting one up takes as long as a small chunk."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdDecompressor()


_decompressor = _Decompressor()


def _decompressed(chunk: Chunk) -> bytes | None:
    """The content; None if the compression is not known."""
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        declared = zstandard.get_frame_parameters(chunk.data).content_size
        unknown = (zstandard.CONTENTSIZE_UNKNOWN, zstandard.CONTENTSIZE_ERROR)
        if declared not in (size, *unknown):
            raise ValueError("content size")
        return _decompressor.zstd.decompress(
            chunk.data, max_output_size=size, allow_extra_data=False
        )
    if chunk.compression == "lz4":
        # One byte more than declared shows that there is more.
        decompressor = lz4.frame.LZ4FrameDecompressor()
        content: bytes = decompressor.decompress(chunk.data, size + 1)
        if not decompressor.eof or decompressor.unused_data:
            raise ValueError("length")
        return content
    return bytes(chunk.data) if chunk.compression == "" else None


def stored_index(source: Source, at: int) -> tuple[int, UintArray, int]:
    """Channel and entries of the message index record that begins at byte `at`, and its end."""
    opcode, end = source.head(at)
    content = source.read(at + RECORD_HEAD, end - at - RECORD_HEAD)
    if opcode == Opcode.MESSAGE_INDEX and len(content) >= 6:
        channel, length = struct.unpack_from("<HI", content)
        if length <= len(content) - 6 and length % 16 == 0:
            entries = np.frombuffer(content, dtype="<u8", offset=6, count=length // 8)
            return channel, entries.reshape(-1, 2), end
    raise damaged(at, "the message index record cannot be read")


def gone_through(content: bytes, offset: int) -> tuple[Index, list[Schema | Channel]]:
    """The message index of a chunk, and its schemas and channels, found in its records.

    Parameters
    ----------
    content : bytes
        The chunk's content, decompressed.
    offset : int
        Where the chunk stands in the file, for errors.

    Raises
    ------
    LogError
        If the content is not one record after the other.
    """

    def read(at: int, length: int) -> bytes:
        return content[at : at + length]

    entries: dict[int, array[int]] = {}
    declared = []
    try:
        for at, opcode, behind in records(read, 0, len(content)):
            if opcode == Opcode.MESSAGE:
                _, length, channel, _, time, _ = MESSAGE.unpack_from(content, at)
                if length < MESSAGE.size - RECORD_HEAD:
                    raise damaged(at, "a message is shorter than it can be")
                if channel not in entries:
                    entries[channel] = array("Q")
                entries[channel].extend((time, at))
            elif opcode in DECLARATIONS:
                declared.append(parsed(KINDS[opcode], read, at, behind))
    except (LogError, struct.error) as error:
        raise damaged(offset, "a chunk does not hold one record after the other") from error
    index = {
        channel: np.frombuffer(pairs, dtype=np.uint64).reshape(-1, 2)
        for channel, pairs in entries.items()
    }
    return index, declared


def windows(buffer: bytes | bytearray | memoryview, size: int) -> NDArray[np.void]:
    """Every window of `size` bytes: indexing it copies whole messages, wherever they start."""
    return np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer, 0, (1,))


def fills(content: bytes, index: Index) -> bool:
    """Whether the messages that an index lists follow each other and fill a chunk's content."""
    if not index:
        return False
    channel = np.concatenate([np.full(len(each), number) for number, each in index.items()])
    time, start = np.concatenate(list(index.values())).T
    order = np.argsort(start, kind="stable")
    channel, time, start = channel[order], time[order], start[order]
    if not len(start) or start[0] or int(start[-1]) > len(content) - MESSAGE.size:
        return False
    rows = windows(content, _HEAD.itemsize)[start.astype(np.int64)].view(_HEAD)
    return bool(
        np.array_equal(start + rows["length"] + RECORD_HEAD, np.append(start[1:], len(content)))
        and np.all(rows["length"] >= MESSAGE.size - RECORD_HEAD)
        and np.all(rows["opcode"] == Opcode.MESSAGE)
        and np.array_equal(rows["channel"], channel)
        and np.array_equal(rows["time"], time)
    )


def message_data(content: bytes, offset: int, channel: int) -> tuple[int, bytes] | None:
    """Log time and data of the message at `offset` of a chunk; None if there is none."""
    if offset + MESSAGE.size > len(content):
        return None
    opcode, length, found, _, time, _ = MESSAGE.unpack_from(content, offset)
    end = offset + RECORD_HEAD + length
    if (
        opcode != Opcode.MESSAGE
        or found != channel
        or not offset + MESSAGE.size <= end <= len(content)
    ):
        return None
    return time, content[offset + MESSAGE.size : end]


_VECTOR = np.zeros(64)


def checksum(data: bytes | bytearray | memoryview, before: int = 0) -> int:
    """CRC-32 of data, continued from that of what stands before.

    On Intel's processors the function of isal leaves the upper halves of the vector registers in
    use. All of Python is then slower, building a tuple by three times, until a function clears them
    as those of numpy do.

    Examples
    --------
    >>> checksum(b"789", checksum(b"123456")) == checksum(b"123456789") == 0xCBF43926
    True
    """
    found: int = isal_zlib.crc32(data, before)
    np.add(_VECTOR, _VECTOR, out=_VECTOR)
    return found
