"""What a walk over a file found, and what of it counts: the account is made here.

Files that were joined, summaries that contradict the data, channels that nothing declares, messages
that come twice: what is left is each message once, and a `Loss` for everything else.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from isal import isal_zlib
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Schema

from trainlog.mcap.account import Loss
from trainlog.mcap.codec import RECORD_HEAD
from trainlog.mcap.places import ChunkPlace, Contents
from trainlog.mcap.records import parsed
from trainlog.mcap.schemas import descriptor_set
from trainlog.mcap.source import Source
from trainlog.topics import TOPICS

_PIECE = 2**22
"""Read at once for a checksum [bytes]."""


@dataclass
class Section:
    """What one file declares: where files were joined there are several."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkPlace] = field(default_factory=list)

    def add(self, other: Section) -> None:
        """Take over what only the other declares."""
        self.schemas = other.schemas | self.schemas
        self.channels = other.channels | self.channels

    def declare(self, opcode: int, content: memoryview, at: int) -> None:
        """Add a schema or channel record; of several with the same number the first counts."""
        if opcode == Opcode.SCHEMA:
            schema = parsed(Schema, content, at)
            self.schemas.setdefault(schema.id, schema)
        else:
            channel = parsed(Channel, content, at)
            self.channels.setdefault(channel.id, channel)


@dataclass
class Findings:
    """What was found so far.

    Attributes
    ----------
    source : Source
    verified : int
        Up to where the file is as it was written, by the checksum of its data section.
    contents : Contents
        Metadata, attachments and statistics; the rest once it is settled.
    losses : list of Loss
        In the order of the file.
    sections : list of Section
        One for each of the files that were joined.
    summary : Section
        What the summary of the last of them declares.
    listed : list of mcap.records.ChunkIndex
    data_end, footer : (int, record) or None
        Where it stands, and what it says.
    closed : bool
        Whether the file ends behind its footer.
    chunked : bool
        Whether the file keeps its messages in chunks.
    failures : list of (int, int, int)
        Place, number of messages and `_key` of each channel in chunks that failed.
    indexed : set of int
        The keys of those in chunks that did not.
    """

    source: Source
    verified: int
    contents: Contents = field(default_factory=Contents)
    losses: list[Loss] = field(default_factory=list)
    sections: list[Section] = field(default_factory=lambda: [Section()])
    summary: Section = field(default_factory=Section)
    listed: list[ChunkIndex] = field(default_factory=list)
    data_end: tuple[int, DataEnd] | None = None
    footer: tuple[int, Footer] | None = None
    closed: bool = False
    chunked: bool = False
    failures: list[tuple[int, int, int]] = field(default_factory=list)
    indexed: set[int] = field(default_factory=set)

    def join(self, at: int, end: int) -> None:
        """Another file begins here: the end of the one before, if it has one, closes nothing."""
        closing = self.data_end or self.footer
        start = at if closing is None else closing[0]
        section = self.sections[-1]
        section.chunks = [
            each for each in section.chunks if not (each.loose and each.offset > start)
        ]
        start = max([start, *(each.behind for each in section.chunks)])
        while self.losses and self.losses[-1].start >= start:
            self.losses.pop()
        self.lose(start, end, "one file ends here and another begins", 0)
        self.sections[-1].add(self.summary)
        self.sections.append(Section())
        self.contents.statistics = self.data_end = self.footer = None
        self.closed = False
        self.summary, self.listed = Section(), []

    def lose(self, start: int, end: int, reason: str, messages: int | None) -> None:
        """Note a loss; one that adjoins the last continues it."""
        last = self.losses[-1] if self.losses else None
        if last is not None and last.end == start and last.start < last.end and start < end:
            known = last.messages is not None and messages is not None
            both = (last.messages or 0) + (messages or 0) if known else None
            self.losses[-1] = Loss(last.start, end, last.reason, both)
        else:
            self.losses.append(Loss(start, end, reason, messages))

    def settled(self) -> Contents:
        """What was found, each channel as it is declared, each message counted once."""
        found = self.contents
        self._settle_failures()
        self._check_end()
        trusted = self._check_summary()
        if self.data_end is not None:
            found.data_section = (self.data_end[0], self.data_end[1].data_section_crc)
        self._define(trusted)
        self._count(trusted)
        found.losses = self.losses
        return found

    def _settle_failures(self) -> None:
        """Take back the messages of chunks that failed and came once more, unharmed."""
        for offset, messages, key in self.failures:
            if key not in self.indexed:
                # Of what failed several times, the first stands for all.
                self.indexed.add(key)
            else:
                for number, loss in enumerate(self.losses):
                    if loss.start <= offset < loss.end and loss.messages is not None:
                        self.losses[number] = replace(loss, messages=loss.messages - messages)
        if self.chunked:
            self._drop_astray()

    def _drop_astray(self) -> None:
        """Leave out messages outside of the chunks of a damaged file that keeps them in chunks.

        They are pieces of broken chunks, and nothing vouches for them.
        """
        size = self.source.size
        end, closing = self.data_end or (size, None)
        fails = closing is not None and closing.data_section_crc and end > self.verified
        harmed = bool(self.losses) or not self.closed or fails
        for section in self.sections:
            kept = []
            for chunk in section.chunks:
                doubtful = chunk.behind > self.verified and (harmed or chunk.offset > end)
                if chunk.loose and doubtful:
                    reason = "messages outside of the chunks that the file has"
                    self._insert(Loss(chunk.offset, chunk.behind, reason))
                else:
                    kept.append(chunk)
            section.chunks = kept
        losses, self.losses = self.losses, []
        for loss in losses:
            self.lose(loss.start, loss.end, loss.reason, loss.messages)

    def _check_end(self) -> None:
        size = self.source.size
        last = self.losses[-1] if self.losses else None
        reached = last is not None and last.end == size and last.messages is None
        if not self.closed and not reached:
            self.lose(size, size, "the file ends without its closing records", None)
        elif self.closed and self.data_end is None and not self.losses:
            at = self.footer[0] if self.footer else size
            self.lose(at, at, "the data section has no end", 0)
        self._settle_summary()
        if self.data_end is not None and self.data_end[1].data_section_crc:
            end = self.data_end[0]
            damage = any(loss.start <= end for loss in self.losses)
            if not damage and checksum_of(self.source, 0, end) != self.data_end[1].data_section_crc:
                reason = "a record outside of the chunks, or their order, fails the checksum"
                self._insert(Loss(end, end, reason))

    def _settle_summary(self) -> None:
        """Say that what is lost behind the data section held no messages."""
        if self.data_end is None or len(self.sections) > 1:
            return
        end = self.data_end[0]
        if not any(chunk.offset > end for chunk in self.sections[0].chunks):
            self.losses = [
                replace(loss, messages=0) if loss.start > end else loss for loss in self.losses
            ]

    def _check_summary(self) -> bool:
        """Whether the summary is as it was written; a Loss is noted if not."""
        if self.footer is None or self.data_end is None or not self.closed:
            return False
        at, footer = self.footer
        start = self.data_end[0] + RECORD_HEAD + 4
        if at < start:
            return False
        inside = any(loss.end > start for loss in self.losses)
        expected = footer.summary_crc
        if expected and checksum_of(self.source, start, at + RECORD_HEAD + 16) != expected:
            if not inside:
                self._lose_summary("the summary fails its checksum")
            return False
        if self.losses or start == at or not expected:
            return not inside
        places = {_told(chunk) for chunk in self.sections[-1].chunks if not chunk.loose}
        listed = {_listed(each) for each in self.listed}
        statistics = self.contents.statistics
        held = sum(chunk.messages for chunk in self.sections[-1].chunks)
        if footer.summary_start != start or (listed and listed != places):
            self._lose_summary("the summary does not tell where its records and the chunks are")
            return False
        if self.verified and statistics is not None and statistics.message_count != held:
            self._lose_summary(
                f"the summary counts {statistics.message_count:,} messages and there are {held:,}"
            )
            return False
        return True

    def _lose_summary(self, reason: str) -> None:
        if self.footer is None or self.data_end is None:
            return
        start = self.data_end[0] + RECORD_HEAD + 4
        mixed = any(chunk.behind > start for chunk in self.sections[-1].chunks)
        self._insert(Loss(start, start if mixed else self.footer[0], reason, 0))

    def _insert(self, loss: Loss) -> None:
        self.losses.append(loss)
        self.losses.sort(key=lambda each: (each.start, each.end))

    def _define(self, trusted: bool) -> None:
        """Schemas and channels: of the summary if that is trusted, else of the sections."""
        found, sections = self.contents, self.sections
        for number, schema in self.summary.schemas.items():
            # Of two copies that nothing verifies, the one that says what the table of topics says.
            if not trusted and number in sections[-1].schemas and _of_the_table(schema):
                sections[-1].schemas[number] = schema
        order = [self.summary, *sections] if trusted else [*sections, self.summary]
        for each in order:
            for number, schema in each.schemas.items():
                found.schemas.setdefault(number, schema)
            for number, channel in each.channels.items():
                found.channels.setdefault(number, channel)
        lost = [
            number
            for number, channel in found.channels.items()
            if channel.schema_id and channel.schema_id not in found.schemas
        ]
        for number in lost:
            del found.channels[number]
        for section in sections:
            whole = section is sections[-1] and trusted
            other = set() if whole else self._misdeclared(section)
            self._keep(section, other)

    def _misdeclared(self, section: Section) -> set[int]:
        """Channels that the section declares otherwise than they will be read."""
        found = self.contents
        return {
            number
            for number, channel in section.channels.items()
            if channel != found.channels.get(number)
            or (
                channel.schema_id in section.schemas
                and section.schemas[channel.schema_id] != found.schemas.get(channel.schema_id)
            )
        }

    def _keep(self, section: Section, other: set[int]) -> None:
        """Keep a section's chunks, without messages that no channel, or another one, explains."""
        found = self.contents
        for chunk in section.chunks:
            unknown = {
                number: count
                for number, count in chunk.counts.items()
                if number not in found.channels or number in other
            }
            for number, count in unknown.items():
                elsewhere = number in other and number in found.channels
                what = "declared otherwise elsewhere" if elsewhere else "nowhere declared"
                reason = f"{count:,} messages of channel {number}, which is {what}"
                self._insert(Loss(chunk.offset, chunk.offset, reason, count))
            if unknown:
                kept = {n: count for n, count in chunk.counts.items() if n not in unknown}
                chunk = chunk._replace(
                    counts=kept, indexes={n: at for n, at in chunk.indexes.items() if n in kept}
                )
            found.chunks.append(chunk)

    def _count(self, trusted: bool) -> None:
        """Tell how many messages a loss held where the statistics leave one answer."""
        statistics = self.contents.statistics
        if not (trusted and statistics) or len(self.sections) > 1:
            return
        missing = max(0, statistics.message_count - self.contents.counts().total())
        if sum(loss.messages or 0 for loss in self.losses) > missing:
            # What comes twice, or the indexes of a chunk that failed, tell too many.
            self.losses = [replace(loss, messages=None) for loss in self.losses]
        known = sum(loss.messages or 0 for loss in self.losses)
        unknown = [number for number, loss in enumerate(self.losses) if loss.messages is None]
        if missing == known or len(unknown) == 1:
            for number in unknown:
                self.losses[number] = replace(self.losses[number], messages=missing - known)


_Told = tuple[int, int, str, int, int, int, int]
"""What a chunk index says of a chunk: place, lengths, compression, times."""


def _told(chunk: ChunkPlace) -> _Told:
    return (
        chunk.offset,
        chunk.length,
        chunk.compression,
        chunk.stored,
        chunk.size,
        chunk.start,
        chunk.end,
    )


def _listed(index: ChunkIndex) -> _Told:
    return (
        index.chunk_start_offset,
        index.chunk_length,
        index.compression,
        index.compressed_size,
        index.uncompressed_size,
        index.message_start_time,
        index.message_end_time,
    )


def _of_the_table(schema: Schema) -> bool:
    """Whether a schema is the one that trainlog writes for a topic."""
    topics = [topic for topic in TOPICS.values() if topic.message == schema.name]
    return any(descriptor_set(topic) == schema.data for topic in topics)


def checksum_of(source: Source, start: int, end: int) -> int:
    """CRC-32 of the file from `start` to `end`."""
    found = 0
    for at in range(start, end, _PIECE):
        found = isal_zlib.crc32(source.read(at, min(_PIECE, end - at)), found)
    return found
