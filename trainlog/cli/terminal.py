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

    from trainlog.mcap import Account
    from trainlog.railway import Line, Train
    from trainlog.trip import Trip

WIDTH = 110
"""Columns of output that goes to a file or a pipe, where no terminal tells its width."""

# No markup: in "[m/s²]" and in the names of trips brackets mean themselves.
console = Console(width=None if Console().is_terminal else WIDTH, markup=False)
complaints = Console(stderr=True, markup=False)


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


FACTS = ("trip", "weather", "load", "clock")
"""What can be said of a recorded trip that its file does not tell."""


def pairs(words: list[str]) -> dict[str, str]:
    """Metadata given as ``key=value``."""
    found = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not (key and equals and value):
            raise InputError(f"'{word}' is not of the form key=value", remedy="as in weather=wet")
        if key not in FACTS:
            raise InputError(f"'{key}' is no known fact", remedy=f"known: {', '.join(FACTS)}")
        if key == "weather" and value not in ("dry", "wet"):
            raise InputError(f"weather '{value}' is unknown", remedy="it is dry or wet")
        if key == "load" and not _is_load(value):
            raise InputError(f"load '{value}' is no load", remedy="give it in kg, 0 or more")
        found[key] = value
    return found


def _is_load(word: str) -> bool:
    try:
        return 0.0 <= float(word) < math.inf
    except ValueError:
        return False


def destination(path: Path, suffix: str) -> Path:
    """A file to be written, checked before any work is done."""
    if path.suffix != suffix:
        raise InputError(
            f"is not the name of a {suffix} file", file=path, remedy=f"end it in {suffix}"
        )
    if path.is_dir() or not path.absolute().parent.is_dir():
        what = "is a folder" if path.is_dir() else "cannot be written: its folder does not exist"
        raise InputError(what, file=path, remedy="name a file in a folder that exists")
    return path


def distinct(names: list[str], files: list[Path]) -> None:
    """Refuse files whose results would have the same name, so that none overwrites another."""
    first: dict[str, Path] = {}
    for name, file in zip(names, files, strict=True):
        if name in first:
            raise InputError(
                f"has the same name as {first[name]}, and so would what is made of it",
                file=file,
                remedy="give them in two calls, with different folders",
            )
        first[name] = file


def about(trip: Trip) -> str:
    """One line on a trip."""
    known = trip.metadata
    length = trip.duration
    words = [f"{length / 60.0:.1f} min" if length >= 60.0 else f"{length:.1f} s"]
    words += [known.get("direction", "")]
    words += [f"{known['weather']} rail"] if known.get("weather") else []
    words += [f"load {float(known['load']) / 1e3:.1f} t"] if known.get("load") else []
    words += [f"as {known['configuration']}"] if known.get("configuration") else []
    return f"  {trip.name}: {', '.join(filter(None, words))}"


def complain(message: str) -> None:
    """Tell what is wrong in one line on standard error."""
    told = " ".join(message.split())
    complaints.print(f"trainlog: {told}", markup=False, highlight=False, soft_wrap=True)


def tell_account(log: Path, account: Account, to: Console) -> None:
    """Tell what of a log is readable and what is lost: a line, and one for each loss."""
    to.print(
        f"{log}: {account.sentence}",
        style=None if account.whole else "yellow",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    # The sentence has told already that a recording was not closed.
    for line in account.lines()[1 : 1 + len(account.losses)]:
        to.print(f"  {line}", markup=False, highlight=False, soft_wrap=True)


def wrote(*paths: Path, to: Console = console) -> None:
    """Tell which files were written."""
    for path in paths:
        to.print(f"wrote {path}", highlight=False, markup=False, soft_wrap=True)


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
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as progress:
        yield progress


@contextmanager
def working(what: str) -> Iterator[None]:
    """Show that something is being done."""
    with console.status(f"{what} ..."):
        yield
