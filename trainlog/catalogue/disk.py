"""Files that the catalogue registers: found in folders, read by several processes, in batches."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from trainlog.catalogue.registration import FileOutcome, parts
from trainlog.display import as_text, counted
from trainlog.errors import InputError

if TYPE_CHECKING:
    from trainlog.catalogue.reading import FileEntry

BATCH = 200
"""Files that are registered in one transaction."""

_SECONDS = 2.0
"""After which what was read is registered [s]: what is interrupted loses no more."""

_WORTH_PROCESSES = 200
"""Files from which on starting processes is worth it."""


@dataclass(frozen=True, repr=False)
class Refreshed:
    """How a catalogue compares with the disk.

    Attributes
    ----------
    same : int
        Files as they were.
    vanished, moved, changed : tuple of str
        Paths of files that are not there, of those that were found in another place, and of those
        whose content is another.
    back : int
        Files that had vanished and are there again.
    outcomes : tuple of FileOutcome
        Of what was read.
    """

    same: int
    vanished: tuple[str, ...] = ()
    moved: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    back: int = 0
    outcomes: tuple[FileOutcome, ...] = ()

    def __repr__(self) -> str:
        return as_text(f"Refreshed: {self.sentence}", {})

    @property
    def sentence(self) -> str:
        """All of it in a line."""
        words = [f"{counted(self.same, 'file')} as they were"]
        words += [f"{len(self.vanished)} vanished"] if self.vanished else []
        words += [f"{len(self.moved)} moved"] if self.moved else []
        words += [f"{len(self.changed)} changed"] if self.changed else []
        words += [f"{self.back} back"] if self.back else []
        return ", ".join(words)


def read_files(paths: Sequence[str], jobs: int = 1) -> Iterator[FileEntry]:
    """Files as the catalogue registers them, read by several processes where there are many."""
    from trainlog.catalogue.reading import read_file

    if jobs < 2 or len(paths) < _WORTH_PROCESSES:
        yield from map(read_file, paths)
        return
    done = 0
    with suppress(BrokenProcessPool):
        context = get_context("spawn")
        with ProcessPoolExecutor(jobs, context, _leave_interruption) as executor:
            try:
                for part in parts(paths):
                    for entry in executor.map(read_file, part, chunksize=8):
                        yield entry
                        done += 1
            except (GeneratorExit, KeyboardInterrupt):
                executor.shutdown(wait=False, cancel_futures=True)
                raise
    # A process that was killed, for want of memory perhaps, leaves the rest to this one.
    yield from map(read_file, paths[done:])


def _leave_interruption() -> None:
    """Leave Ctrl-C to the process that registers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def batches(entries: Iterable[FileEntry]) -> Iterator[list[FileEntry]]:
    """Entries in batches: as many as a transaction takes, or those of some seconds."""
    batch: list[FileEntry] = []
    begun = time.monotonic()
    for entry in entries:
        batch.append(entry)
        if len(batch) == BATCH or time.monotonic() - begun > _SECONDS:
            yield batch
            batch, begun = [], time.monotonic()
    if batch:
        yield batch


def logs_below(paths: Iterable[str | Path]) -> list[str]:
    """The logs named and those in folders, however deep, each once.

    Raises
    ------
    InputError
        If a path does not exist, or there is no log.
    """
    found: dict[str, None] = {}
    for path in paths:
        given = os.path.abspath(Path(path).expanduser())  # noqa: PTH100
        if not Path(given).exists():
            raise InputError("does not exist", file=path, remedy="check the path")
        for each in _below(given) if Path(given).is_dir() else (given,):
            found[each] = None
    if not found:
        raise InputError(
            "no log (*.mcap) was found",
            remedy="name logs or folders, or make logs of recordings with 'trainlog ingest'",
        )
    return list(found)


def _below(folder: str) -> Iterator[str]:
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            if name.endswith(".mcap") and not name.startswith("."):
                yield str(Path(place) / name)
