"""A log's file, read at any place without being loaded, and the errors that name a place in it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import NoReturn

from trainlog.errors import InputError, LogError
from trainlog.formats.files import refuse_reading

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


class Source:
    """A file open for reading at any place, from several threads at once.

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
        try:
            # Opening a pipe would wait for its other end.
            regular = not self.path.exists() or self.path.is_file() or self.path.is_dir()
            self._file = self.path.open("rb", buffering=0) if regular else None
        except (OSError, ValueError) as error:
            self._refuse(error)
        if self._file is None:
            raise InputError("is not a regular file", file=path, remedy="copy it to a file first")
        self._lock = threading.Lock()
        self.size = os.fstat(self._file.fileno()).st_size

    def __enter__(self) -> Source:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()

    def read(self, offset: int, length: int) -> bytes:
        """The bytes from `offset`, as many as `length` or the end of the file allow.

        Raises
        ------
        InputError
            If the file cannot be read any more, or has become shorter than it was.
        """
        length = max(0, min(length, self.size - offset))
        parts = []
        while length:
            try:
                part = self._read(offset, length)
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

    def _read(self, offset: int, length: int) -> bytes:
        assert self._file is not None
        if hasattr(os, "pread"):
            return os.pread(self._file.fileno(), length, offset)
        with self._lock:
            self._file.seek(offset)
            return self._file.read(length) or b""

    def _refuse(self, error: OSError | ValueError) -> NoReturn:
        if isinstance(error, OSError):
            refuse_reading(self.path, error)
        raise InputError(
            f"cannot be read: {error}", file=self.path, remedy="check the path"
        ) from error


def threads_of(threads: int | None) -> int:
    """How many threads work: as many as asked for, or one a processor, at most four.

    Raises
    ------
    InputError
        If that is no whole number from 1 on.
    """
    if threads is None:
        return min(4, os.cpu_count() or 1)
    if not isinstance(threads, int) or threads < 1:
        raise InputError(f"threads is {threads}", remedy="give a whole number from 1 on")
    return threads
