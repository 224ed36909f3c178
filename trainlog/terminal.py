"""What the commands share: consoles, progress, the logs and files they are given."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from trainlog.errors import InputError

if TYPE_CHECKING:
    from rich.progress import Progress

    from trainlog.railway import Line, Train
    from trainlog.trip import Trip

WIDTH = 110
"""Columns of output that goes to a file or a pipe, where no terminal tells its width."""

console = Console(width=None if Console().is_terminal else WIDTH)
complaints = Console(stderr=True)


def line_and_train(line: Path | None, train: Path | None) -> tuple[Line, Train]:
    """Line and train from the files named, or the embedded ones."""
    from trainlog.formats.line import read_line
    from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
    from trainlog.formats.train import read_train

    return read_line(line or sample(DEFAULT_LINE)), read_train(train or sample(DEFAULT_TRAIN))


def logs_in(paths: list[Path]) -> list[Path]:
    """The logs named, and those in the folders named, in order of name."""
    found: list[Path] = []
    for path in paths:
        inside = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        if not inside:
            raise InputError("the folder holds no logs (*.mcap)", file=path)
        found += inside
    return found


def read_trips(paths: list[Path]) -> list[Trip]:
    """All trips in the logs and folders named."""
    from trainlog.mcap import read_log

    with progress_bar() as progress:
        return [read_log(log) for log in progress.track(logs_in(paths), description="reading")]


def pairs(words: list[str]) -> dict[str, str]:
    """Metadata given as ``key=value``."""
    found = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not (key and equals and value):
            raise InputError(f"'{word}' is not of the form key=value", remedy="as in weather=wet")
        if key == "load" and not _is_number(value):
            raise InputError(f"load '{value}' is not a number", remedy="give it in kg")
        found[key] = value
    return found


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def about(trip: Trip) -> str:
    """One line on a trip."""
    known = trip.metadata
    words = [f"{trip.duration / 60.0:.1f} min", known.get("direction", "")]
    words += [f"{known['weather']} rail"] if known.get("weather") else []
    words += [f"load {float(known['load']) / 1e3:.1f} t"] if known.get("load") else []
    words += [f"as {known['configuration']}"] if known.get("configuration") else []
    return f"  {trip.name}: {', '.join(filter(None, words))}"


def wrote(*paths: Path) -> None:
    """Tell which files were written."""
    for path in paths:
        console.print(f"wrote {path}", highlight=False, soft_wrap=True)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Show how far a loop is, and leave nothing behind."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns: list[Any] = [
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    ]
    with Progress(*columns, console=console, transient=True) as progress:
        yield progress


@contextmanager
def working(what: str) -> Iterator[None]:
    """Show that something is being done."""
    with console.status(f"{what} ..."):
        yield
