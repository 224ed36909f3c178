"""Where the parts of an MCAP file stand: what is known of a log before its messages are read."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.records import Channel, Metadata, Schema, Statistics

from trainlog.mcap.account import Account, Loss, Unfinished
from trainlog.mcap.names import RECORDING_RECORD


class ChunkPlace(NamedTuple):
    """Where a chunk stands, or a run of messages outside of chunks as if it were one.

    Attributes
    ----------
    offset, length : int
        Where its record begins, and the record's length with its head [bytes].
    compression : str
    data, stored : int
        Where its content as stored begins, and the content's length [bytes].
    size : int
        Length of its content when decompressed, as the record says [bytes].
    start, end : int
        Log time of its first and last message, as the record says [ns]; zero if nothing tells.
    indexes : dict of int to int
        Where the message index of each channel stands in the file; empty if they have to be found
        by going through the chunk's records.
    behind : int
        Where the next record begins that is not one of its message indexes.
    counts : dict of int to int
        Number of messages by channel id.
    """

    offset: int
    length: int
    compression: str
    data: int
    stored: int
    size: int
    start: int
    end: int
    indexes: dict[int, int]
    behind: int
    counts: dict[int, int]

    @property
    def loose(self) -> bool:
        """Whether it is a run of messages outside of chunks."""
        return self.data == self.offset

    @property
    def messages(self) -> int:
        """Number of messages of all channels."""
        return sum(self.counts.values())


class AttachmentPlace(NamedTuple):
    """Where an attachment stands; `data` and `size` tell of its content.

    Attributes
    ----------
    offset, length : int
        Where its record begins, and the record's length with its head [bytes].
    name, media_type : str
    log_time, create_time : int
        [ns since 1970 UTC]
    data, size : int
        Where its content begins, and the content's length [bytes].
    """

    offset: int
    length: int
    name: str
    media_type: str
    log_time: int
    create_time: int
    data: int
    size: int


@dataclass
class Contents:
    """What an MCAP file holds, as far as it can be read.

    Attributes
    ----------
    schemas, channels : dict by id
    metadata : list of mcap.records.Metadata
    attachments : list of AttachmentPlace
    chunks : list of ChunkPlace
        In the order of the file.
    statistics : mcap.records.Statistics or None
        As the file has it.
    data_section : (int, int) or None
        Where the data section ends, and its CRC-32, 0 if the file does not have it; None if the
        file ends without one.
    indexed : bool
        Whether all this comes from the summary, not from a walk over the file.
    losses : list of Loss
        What could not be read so far.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[AttachmentPlace] = field(default_factory=list)
    chunks: list[ChunkPlace] = field(default_factory=list)
    statistics: Statistics | None = None
    data_section: tuple[int, int] | None = None
    indexed: bool = False
    losses: list[Loss] = field(default_factory=list)

    def counts(self) -> Counter[int]:
        """Number of messages by channel id."""
        counted: Counter[int] = Counter()
        for chunk in self.chunks:
            counted.update(chunk.counts)
        return counted

    def schema(self, channel: Channel) -> Schema | None:
        """The schema of a channel, if it has one."""
        return self.schemas.get(channel.schema_id)

    def drop(self, chunk: ChunkPlace, reason: str) -> None:
        """Leave out a chunk that turned out to be damaged."""
        self.chunks.remove(chunk)
        self.losses.append(Loss(chunk.offset, chunk.behind, reason, chunk.messages))

    @property
    def account(self) -> Account:
        """What is readable and what is lost, as far as it is known by now."""
        losses = sorted(self.losses, key=lambda loss: (loss.start, loss.end))
        unfinished = self._unfinished() if losses else None
        return Account(self.counts().total(), len(self.chunks), tuple(losses), unfinished)

    def _unfinished(self) -> Unfinished | None:
        """How a live recording ended that was not closed; None if this is none."""
        flush = None
        for record in self.metadata:
            if record.name == RECORDING_RECORD:
                if "closed" in record.metadata:
                    return None
                flush = record.metadata.get("flush", flush)
        try:
            period = float(flush or "nan")
        except ValueError:
            return None
        last = max((chunk.end for chunk in self.chunks if chunk.counts), default=None)
        return Unfinished(last, period) if period >= 0 else None
