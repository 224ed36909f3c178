"""What could be read of a file, and what could not: the account that every open of a log gives."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

from trainlog.display import counted

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
