"""Message records laid out straight into the chunk that they belong to.

A chunk is filled once: template and values of each message go to where the message stands among
those of the other topics. The loops are compiled, see `trainlog.mcap.laying`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

SEQUENCE_AT = 11
"""Where the sequence number stands in a message record, before the two times."""

_R = TypeVar("_R", bound="Records")


class Records(Protocol):
    """The messages of one channel, without their times and sequence numbers."""

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Length of each record [bytes]."""

    def part(self: _R, rows: slice) -> _R:
        """Some of the records."""

    def then(self: _R, others: _R) -> _R:
        """These records and behind them the others."""

    def put(
        self,
        data: NDArray[np.uint8],
        offsets: NDArray[np.int64],
        time: NDArray[np.int64],
        sequence: NDArray[np.uint32],
    ) -> None:
        """Lay the records out at `offsets` of a chunk."""


@dataclass(frozen=True)
class FixedRecords:
    """Records of one length, as values that go into copies of a template.

    Attributes
    ----------
    template : (size,) uint8
    words : (k, n) float64
        Values of eight bytes. Every NaN is written with the same bits.
    word_places : (k,) int64
        Where each stands in a record.
    octets : (n, m) uint8
        Values of one byte.
    octet_places : (m,) int64
    """

    template: NDArray[np.uint8]
    words: NDArray[np.float64]
    word_places: NDArray[np.int64]
    octets: NDArray[np.uint8]
    octet_places: NDArray[np.int64]

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Length of each record [bytes]."""
        return np.full(len(self.octets), len(self.template), dtype=np.int64)

    def part(self, rows: slice) -> FixedRecords:
        """Some of the records."""
        return replace(self, words=self.words[:, rows], octets=self.octets[rows])

    def then(self, others: FixedRecords) -> FixedRecords:
        """These records and behind them the others."""
        return replace(
            self,
            words=np.concatenate([self.words, others.words], axis=1),
            octets=np.concatenate([self.octets, others.octets]),
        )

    def put(
        self,
        data: NDArray[np.uint8],
        offsets: NDArray[np.int64],
        time: NDArray[np.int64],
        sequence: NDArray[np.uint32],
    ) -> None:
        """Lay the records out at `offsets` of a chunk."""
        # Loading the compiler takes longer than reading a short log, which needs it not.
        from trainlog.mcap.laying import fill

        words = self.words.view(np.uint64)
        fill(data, offsets, time, sequence, self.template, words, self.word_places)
        for column, place in enumerate(self.octet_places.tolist()):
            data[offsets + place] = self.octets[:, column]


@dataclass(frozen=True)
class ListedRecords:
    """Records that differ in length, each laid out already."""

    records: list[bytes]

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Length of each record [bytes]."""
        return np.array([len(record) for record in self.records], dtype=np.int64)

    def part(self, rows: slice) -> ListedRecords:
        """Some of the records."""
        return ListedRecords(self.records[rows])

    def then(self, others: ListedRecords) -> ListedRecords:
        """These records and behind them the others."""
        return ListedRecords(self.records + others.records)

    def put(
        self,
        data: NDArray[np.uint8],
        offsets: NDArray[np.int64],
        time: NDArray[np.int64],
        sequence: NDArray[np.uint32],
    ) -> None:
        """Lay the records out at `offsets` of a chunk."""
        buffer = data.data
        heads = zip(offsets.tolist(), sequence.tolist(), time.tolist(), strict=True)
        for record, (at, number, moment) in zip(self.records, heads, strict=True):
            buffer[at : at + len(record)] = record
            struct.pack_into("<IQQ", buffer, at + SEQUENCE_AT, number, moment, moment)
