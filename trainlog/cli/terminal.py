"""What the commands write to: consoles, progress, and the lines that all of them print."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from trainlog.errors import MOST_LISTED, TrainlogError

if TYPE_CHECKING:
    from rich.progress import Progress

    from trainlog.mcap import Account

WIDTH = 110
"""Columns of output that goes to a file or a pipe, where there is no terminal with a width."""

# No markup: in "[m/s²]" and in the names of trips brackets mean themselves.
console = Console(width=None if Console().is_terminal else WIDTH, markup=False)
errors = Console(stderr=True, markup=False)


def about(known: Mapping[str, str], duration: float | None) -> str:
    """One line on a trip: its metadata, and how long it was [s]."""
    parts = []
    if duration is not None:
        parts = [f"{duration / 60.0:.1f} min" if duration >= 60.0 else f"{duration:.1f} s"]
    parts += [known.get("direction", "")]
    parts += [f"{known['weather']} rail"] if known.get("weather") else []
    parts += [f"load {float(known['load']) / 1e3:.1f} t"] if known.get("load") else []
    parts += [f"as {known['configuration']}"] if known.get("configuration") else []
    return f"  {known.get('trip', 'unnamed')}: {', '.join(filter(None, parts))}"


def print_error(message: str) -> None:
    """State what is wrong in one line on standard error."""
    line = " ".join(message.split())
    errors.print(f"trainlog: {line}", markup=False, highlight=False, soft_wrap=True)


def print_problems(error: TrainlogError) -> None:
    """State what is wrong: in one line or, if a file has several problems, in one line each."""
    problems = getattr(error, "problems", ())
    if not problems:
        print_error(str(error))
        return
    print_error(f"{error.file}: {len(problems)} problems")
    shown = [str(problem) for problem in problems[:MOST_LISTED]]
    if len(problems) > MOST_LISTED:
        shown.append(f"and {len(problems) - MOST_LISTED} more")
    for line in shown:
        errors.print(f"  {line}", markup=False, highlight=False, soft_wrap=True)


def print_account(log: Path, account: Account, to: Console) -> None:
    """List what of a log is readable and what is lost: a line, and one for each loss."""
    to.print(
        f"{log}: {account.sentence}",
        style=None if account.whole else "yellow",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    # The sentence states already that a recording was not closed.
    for line in account.lines()[1 : 1 + len(account.losses)]:
        to.print(f"  {line}", markup=False, highlight=False, soft_wrap=True)


def wrote(*paths: Path, to: Console = console) -> None:
    """List the files that were written."""
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
def interruption() -> Iterator[Callable[[], None]]:
    """Ctrl-C in long work: what is yielded raises it again where a library's callback lost it."""
    pressed = False

    def press(number: int, frame: object) -> None:  # noqa: ARG001
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield check
        return
    before = signal.signal(signal.SIGINT, press)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def working(what: str) -> Iterator[None]:
    """Show that something is being done."""
    with console.status(f"{what} ..."):
        yield
