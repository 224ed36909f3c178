"""The errors of the log: where a file is damaged, what in it cannot be used."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from trainlog.errors import LogError

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
        remedy=f"see 'trainlog info {path}' for its topics, times and positions",
    )


def shown(text: str) -> str:
    """A text from a file, for a message: on one line, of bounded length, in quotes."""
    cut = text if len(text) <= _LONGEST else f"{text[:_LONGEST]} …"
    return repr(cut)


@contextmanager
def in_file(path: str | Path) -> Iterator[None]:
    """Name the file in any LogError that the block raises."""
    try:
        yield
    except LogError as error:
        raise LogError(error.problem, file=path, place=error.place, remedy=error.remedy) from error
