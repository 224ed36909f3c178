"""The bars on a terminal's standard error that show how far long work is.

Computing states its progress by `trainlog.progress`; here a bar of it is drawn, with what is done
of how much, the rate and the remaining time. Nothing is drawn where standard error is no terminal.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from trainlog.cli import terminal
from trainlog.processes import handled
from trainlog.progress import Step, shown_by

if TYPE_CHECKING:
    from rich.progress import Progress, Task


class ProgressDisplay:
    """The bars of one command; a listener of `trainlog.progress`.

    Attributes
    ----------
    outermost : str
        How far the outermost task was when it was broken off, in words; empty if it has no parts to
        be counted.
    """

    def __init__(self, check: Callable[[], None]) -> None:
        self._check = check
        self._progress: Progress | None = None
        self._depth = 0
        self.outermost = ""

    @contextmanager
    def show(self, name: str, total: float | None, unit: str) -> Iterator[Step]:
        """Show a task while it is worked on."""
        if self._progress is None and terminal.errors.is_terminal and not terminal.current().quiet:
            self._progress = _bars()
            self.resume()
        bar = self._progress
        number = None if bar is None else bar.add_task(name, total=total, unit=unit, note="")
        state: dict[str, Any] = {"completed": 0.0, "total": total}
        self._depth += 1

        def step(
            done: float | None = None, total: float | None = None, note: str | None = None
        ) -> None:
            self._check()
            given = {"completed": done, "total": total, "note": note}
            state.update((key, each) for key, each in given.items() if each is not None)
            if bar is not None and number is not None:
                bar.update(number, **state)

        try:
            yield step
        except BaseException:
            if self._depth == 1 and len(unit) > 1 and (state["total"] or 0.0) > 1.0:
                done = amount(state["completed"], state["total"], unit)
                self.outermost = f"{name}: {done} finished"
            raise
        finally:
            self._depth -= 1
            if bar is not None and number is not None:
                bar.remove_task(number)

    def pause(self) -> None:
        """Draw nothing while the user is asked, or at the end."""
        if self._progress is not None and self._progress.live.is_started:
            if terminal.console.is_terminal:
                terminal.console.pop_render_hook()
            self._progress.stop()

    def resume(self) -> None:
        """Draw again."""
        if self._progress is not None:
            self._progress.start()
            # Both streams are one screen: what is printed as a result goes above the bars.
            if terminal.console.is_terminal:
                terminal.console.push_render_hook(self._progress.live)


def _bars() -> Progress:
    """Bars with amount, rate and remaining time."""
    from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
    from rich.table import Column
    from rich.text import Text

    class Pace(ProgressColumn):
        max_refresh = 0.5

        def render(self, task: Task) -> Text:
            unit, elapsed = task.fields["unit"], task.elapsed or 0.0
            if unit == "s":  # of a time limit what is done is the time that is over
                task.completed = min(elapsed, task.total or 0.0)
            done, total = task.completed, task.total
            return Text(f"{amount(done, total, unit)} {pace(elapsed, done, total, unit)}")

    one_line = Column(no_wrap=True, overflow="ellipsis")
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        Pace(table_column=Column(no_wrap=True)),
        TextColumn("{task.fields[note]}", style="dim", markup=False, table_column=one_line),
        console=terminal.errors,
        transient=True,
        redirect_stdout=terminal.console.is_terminal,
    )


def amount(done: float, total: float | None, unit: str) -> str:
    """How much is done, of how much.

    Examples
    --------
    >>> amount(3, 12, "trip"), amount(1, None, "trip"), amount(2.5e6, 9.1e6, "B")
    ('3 of 12 trips', '1 trip', '2.5 MB of 9.1 MB')
    >>> amount(0, None, "trip"), amount(1500, 4000, "m"), amount(1, 1, "log")
    ('', '1,500 of 4,000 m', '1 of 1 log')
    """
    from rich.filesize import decimal

    if not done and total is None:
        return ""
    said = " of ".join(
        decimal(round(each)) if unit == "B" else f"{each:,.0f}"
        for each in (done, total)
        if each is not None
    )
    plural = "s" if len(unit) > 2 and (done if total is None else total) != 1 else ""
    return said if unit == "B" else f"{said} {unit}{plural}".rstrip()


def pace(elapsed: float, done: float, total: float | None, unit: str) -> str:
    """How fast it goes, and how long it still takes; how long it has taken where that is unknown.

    Examples
    --------
    >>> pace(12.0, 30e6, 90e6, "B"), pace(80.0, 4, None, "trip"), pace(75.0, 0, 4, "trip")
    ('2.5 MB/s, 0:00:24 left', '3.0 trips a minute, 0:01:20', '0:01:15')
    """
    speed = done / elapsed if elapsed else 0.0
    known = bool(speed and unit)
    rate = (
        amount(speed, None, unit) + "/s" if unit == "B" else f"{60 * speed:,.1f} {unit}s a minute"
    )
    left = known and total is not None
    seconds = max(total - done, 0.0) / speed if left and total is not None else elapsed
    words = f"{timedelta(seconds=round(seconds))}{' left' if left else ''}"
    return f"{rate}, {words}" if known and unit != "s" else words


_display: ProgressDisplay | None = None


@contextmanager
def progress_shown() -> Iterator[ProgressDisplay]:
    """Show the progress of what runs in the block; a command within another uses the same bars."""
    global _display
    if _display is not None:
        yield _display
        return
    with interruption() as check:
        _display = ProgressDisplay(check)
        try:
            with shown_by(_display.show):
                yield _display
            check()
        finally:
            _display.pause()
            _display = None


@contextmanager
def paused() -> Iterator[None]:
    """No bars while the user is asked."""
    if _display is not None:
        _display.pause()
    try:
        yield
    finally:
        if _display is not None:
            _display.resume()


@contextmanager
def interruption() -> Iterator[Callable[[], None]]:
    """Ctrl-C in long work: what is yielded raises it again where a library's callback lost it."""
    pressed = False

    def press(*_: object) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt

    with handled(press, signal.SIGINT):
        yield check
