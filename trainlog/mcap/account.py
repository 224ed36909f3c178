"""What could be read of a file, and what could not: the account that every open of a log gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


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
        How many messages it held; None where nothing in the file tells.
    """

    start: int
    end: int
    reason: str
    messages: int | None = None


@dataclass(frozen=True)
class Account:
    """What was read of a file, and each stretch that was lost.

    Attributes
    ----------
    messages, chunks : int
        That are readable.
    losses : tuple of Loss
        In the order of the file; empty if it is whole.
    """

    messages: int
    chunks: int
    losses: tuple[Loss, ...] = ()

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
        """How many messages were lost; None where nothing in the file tells."""
        counts = [loss.messages for loss in self.losses]
        return None if None in counts else sum(count for count in counts if count is not None)

    def lines(self) -> list[str]:
        """The account in words: what is readable, then one line a loss."""
        shown = [f"{self.messages:,} messages in {self.chunks:,} chunks are readable"]
        for loss in self.losses:
            held = "" if loss.messages is None else f", {loss.messages:,} messages"
            shown.append(
                f"lost: bytes {loss.start:,} to {loss.end:,} ({loss.end - loss.start:,} bytes"
                f"{held}): {loss.reason}"
            )
        return shown

    def details(self) -> dict[str, Any]:
        """The account as JSON, for metadata and provenance."""
        return {
            "messages": self.messages,
            "chunks": self.chunks,
            "bytes_lost": self.bytes_lost,
            "messages_lost": self.messages_lost,
            "losses": [
                {
                    "start": loss.start,
                    "end": loss.end,
                    "reason": loss.reason,
                    "messages": loss.messages,
                }
                for loss in self.losses
            ],
        }


class DamageWarning(UserWarning):
    """A log was read although part of it is lost; `account` tells what.

    Parameters
    ----------
    file : str
        The file's path.
    account : Account
    """

    def __init__(self, file: str, account: Account) -> None:
        self.file = file
        self.account = account
        super().__init__(f"{file}: {'; '.join(account.lines())}")
