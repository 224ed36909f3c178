"""The bars on a terminal's standard error that show how far long work is.

Computing states its progress by `trainlog.progress`; here a bar of it is drawn, with what is done
of how much, the rate and the remaining time. Nothing is drawn where standard error is no terminal.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from trainlog.cli import terminal
from trainlog.progress import Step, shown_by

if TYPE_CHECKING:
    from rich.progress import Progress, Task

_BYTES = ((1e9, "GB"), (1e6, "MB"), (1e3, "kB"))


class ProgressDisplay:
    """The bars of one command; a listener of `trainlog.progress`.

    Attributes
    ----------
    outermost : str
        How far the outermost task is, in words; empty if it has no parts to be counted.
    """

    def __init__(self, check: Callable[[], None]) -> None:
        self._check = check
        self._progress: Progress | None = None
        self._depth = 0
        self.outermost = ""

    @contextmanager
    def show(self, name: str, total: float | None, unit: str) -> Iterator[Step]:
        """Show a task while it is worked on."""
        bar = self._started()
        number = None if bar is None else bar.add_task(name, total=total, unit=unit, note="")
        known, outer = total, self._depth == 0
        self._depth += 1
        self._state(outer, name, 0.0, known, unit)

        def step(
            done: float | None = None, total: float | None = None, note: str | None = None
        ) -> None:
            nonlocal known
            self._check()
            known = known if total is None else total
            if done is not None:
                self._state(outer, name, done, known, unit)
            if bar is not None and number is not None:
                bar.update(number, completed=done, total=known)
                if note is not None:
                    bar.update(number, note=note)

        try:
            yield step
            if outer:
                self.outermost = ""
        finally:
            self._depth -= 1
            if bar is not None and number is not None:
                bar.remove_task(number)

    def _state(self, outer: bool, name: str, done: float, total: float | None, unit: str) -> None:
        if outer:
            countable = unit and unit not in ("B", "s", "m") and total is not None and total > 1
            of = f"{done:.0f} of {total:.0f} {unit}s" if countable else ""
            self.outermost = f"{name}: {of} finished" if of else ""

    def _started(self) -> Progress | None:
        """The bars, drawn from the first task on; None where there is no terminal."""
        if self._progress is None and terminal.errors.is_terminal and not terminal.current().quiet:
            self._progress = _bars()
            self.resume()
        return self._progress

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

    class Elapsed(BarColumn):
        def render(self, task: Task) -> Any:
            if task.fields["unit"] == "s":  # of a time limit what is done is the time that is over
                task.completed = min(task.elapsed or 0.0, task.total or 0.0)
            return super().render(task)

    class Amount(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(amount(task.completed, task.total, task.fields["unit"]))

    class Pace(ProgressColumn):
        max_refresh = 0.5

        def render(self, task: Task) -> Text:
            return Text(
                pace(task.elapsed, task.completed, task.total, task.fields["unit"]), style="dim"
            )

    columns: list[Any] = [
        TextColumn("{task.description}", markup=False),
        Elapsed(bar_width=20),
        Amount(table_column=Column(no_wrap=True)),
        Pace(table_column=Column(no_wrap=True)),
        TextColumn(
            "{task.fields[note]}",
            style="dim",
            markup=False,
            table_column=Column(no_wrap=True, overflow="ellipsis"),
        ),
    ]
    return Progress(
        *columns,
        console=terminal.errors,
        transient=True,
        redirect_stdout=terminal.console.is_terminal,
    )


def amount(done: float, total: float | None, unit: str) -> str:
    """How much is done, of how much.

    Examples
    --------
    >>> amount(3, 12, "trip"), amount(1, None, "trip"), amount(2.5e6, 9.1e6, "B")
    ('3 of 12 trips', '1 trip', '2.5 of 9.1 MB')
    >>> amount(0, None, "trip"), amount(1500, 4000, "m"), amount(1, 1, "log")
    ('', '1,500 of 4,000 m', '1 of 1 log')
    """
    if not done and total is None:
        return ""
    if unit == "B":
        most = max(done, total or 0.0)
        scale, name = next((each for each in _BYTES if most >= each[0]), (1.0, "B"))
        digits = 0 if scale == 1.0 else 1
        said = [f"{each / scale:,.{digits}f}" for each in (done, total) if each is not None]
        return f"{' of '.join(said)} {name}"
    said = [f"{each:,.0f}" for each in (done, total) if each is not None]
    last = done if total is None else total
    plural = "s" if len(unit) > 2 and last != 1 else ""
    return f"{' of '.join(said)} {unit}{plural}".rstrip()


def pace(elapsed: float | None, done: float, total: float | None, unit: str) -> str:
    """How fast it goes, and how long it still takes; how long it has taken where that is unknown.

    Examples
    --------
    >>> pace(12.0, 30e6, 90e6, "B"), pace(80.0, 4, None, "trip"), pace(75.0, 0, 4, "trip")
    ('2.5 MB/s, 0:24 left', '3.0 trips a minute, 1:20', '1:15')
    """
    if not elapsed:
        return ""
    if unit == "s":
        return _minutes(elapsed) if total is None else f"{_minutes(max(total - elapsed, 0.0))} left"
    speed = done / elapsed
    parts = []
    if speed and unit:
        parts = [f"{amount(speed, None, unit)}/s"] if unit in ("B", "m") else [_often(speed, unit)]
    if speed and total is not None and unit:
        parts.append(f"{_minutes(max(total - done, 0.0) / speed)} left")
    else:
        parts.append(_minutes(elapsed))
    return ", ".join(parts)


def _often(speed: float, unit: str) -> str:
    of, name = (speed, "second") if speed >= 1.0 else (60.0 * speed, "minute")
    return f"{of:,.1f} {unit}s a {name}"


def _minutes(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


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
