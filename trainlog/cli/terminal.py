"""What the commands print: on which stream, as text or as one JSON object, or not at all.

A command prints its tables and sentences on `console`, lists its files with `wrote` and its errors
with `print_error`. What becomes of it is decided here: without options it is shown; with
``--json`` the tables and sentences are gathered and printed as one object when the command ends;
with ``--quiet`` only errors are shown. Standard output holds results, standard error the rest.

Computing states its progress by `trainlog.progress`; a bar of it is drawn on standard error, with
what is done of how much, the rate and the remaining time. Where that is no terminal, a line states
it now and then (`SILENCE`).
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, is_dataclass
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from trainlog.display import in_speed_unit, in_zone
from trainlog.errors import MOST_LISTED, TrainlogError
from trainlog.processes import handled
from trainlog.progress import Step, shown_by
from trainlog.units import lasted

if TYPE_CHECKING:
    from rich.progress import Progress, Task

    from trainlog.mcap import Account
    from trainlog.presentation import Presented


WIDTH = 110
"""Columns of output that goes to a file or a pipe, unless ``COLUMNS`` states another width."""


@dataclass
class Output:
    """What one command has printed and written so far.

    Attributes
    ----------
    command : str
        Its words, without those of the user: ``"map update"``.
    as_json, quiet : bool
        Whether it is printed as JSON, and whether only errors are printed.
    parent : Output, optional
        Of the command that runs this one, as the demo does.
    content : dict
        What is stated as JSON: tables by name, and what the command gave.
    notes : list of str
        Sentences beside the tables.
    written : list of Path
        Files, as the command listed them.
    files : list of Path
        Files that took their place on the disk while the command ran.
    finished : callable, optional
        States what was finished so far, where the count of files does not.
    place : str
        How far a command is that runs others: ``"step 2 of 18"``.
    """

    command: str = ""
    as_json: bool = False
    quiet: bool = False
    parent: Output | None = None
    content: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    written: list[Path] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    finished: Callable[[], str] | None = None
    place: str = ""

    def gather(self, part: object) -> None:
        """Keep something printed for the JSON object: a table by its name, a sentence as a note."""
        from trainlog.presentation import WordTable

        if isinstance(part, WordTable):
            self.content.setdefault(part.name, []).extend(part.data)
        else:
            words = " ".join(str(part).split())
            self.notes += [words] if words else []

    def document(self, status: int) -> dict[str, Any]:
        """The object that ``--json`` prints: what every command states, and its own content."""
        common = {"command": self.command, "status": status}
        files = [str(path) for path in self.written]
        notes = [*self.content.get("notes", []), *self.notes]
        return common | self.content | {"notes": notes, "written": files}


_output = Output()
"""Of the command that runs; one that is never printed, where none does."""


def current() -> Output:
    """The output of the command that runs."""
    return _output


class _Console(Console):
    """Standard output: shows what is printed, keeps it for JSON, or drops it.

    Attributes
    ----------
    shown_as : (str, str)
        Unit of speeds and time zone, as the user has set them.
    """

    shown_as: tuple[str, str] = ("km/h", "UTC")

    def print(self, *parts: Any, **options: Any) -> None:
        """Print, as the command was asked to."""
        if _output.as_json:
            for part in parts:
                _output.gather(part)
        elif not _output.quiet:
            unit, zone = self.shown_as  # tables heed them themselves
            shown = [
                in_zone(in_speed_unit(part, unit), zone) if isinstance(part, str) else part
                for part in parts
            ]
            self._take_width()
            super().print(*shown, **{"highlight": False, **options})

    def rule(self, *parts: Any, **options: Any) -> None:
        """Draw a line, where output is for a person."""
        if not (_output.as_json or _output.quiet):
            self._take_width()
            super().rule(*parts, **options)

    def _take_width(self) -> None:
        """Without a terminal as many columns as the environment states now, else `WIDTH`."""
        if not self.is_terminal:
            stated = os.environ.get("COLUMNS", "")
            self.width = int(stated) if stated.isdecimal() and int(stated) else WIDTH


# No markup: in "[m/s²]" and in the names of trips brackets mean themselves.
console = _Console(markup=False)
errors = Console(stderr=True, markup=False, highlight=False)


@contextmanager
def output_of(command: str, *, as_json: bool, quiet: bool) -> Iterator[Output]:
    """The output of a command while it runs; at its end the JSON object is printed.

    Of a command that another one runs the object becomes one of the other's ``steps``. Nothing is
    printed of one that fails before it has found anything.
    """
    global _output
    from trainlog.formats.files import noting_files

    parent = _output if _output.command else None
    as_json = as_json or (parent is not None and parent.as_json)
    quiet = quiet or (parent is not None and parent.quiet)
    output = Output(command, as_json, quiet, parent)
    before, _output = _output, output
    status: int | None = 0
    try:
        with noting_files(output.files):
            yield output
    except BaseException as error:
        # An error without a status ends in one line on standard error: there is no result.
        status = getattr(error, "exit_code", None)
        if not isinstance(status, int):
            status = 130 if isinstance(error, KeyboardInterrupt) else None
        raise
    finally:
        _output = before
        if as_json and (status in (0, 1) or output.content):
            document = output.document(2 if status is None else status)
            if parent is None:
                print(as_json_text(document), flush=True)
            else:
                parent.content.setdefault("steps", []).append(document)


def state(content: Mapping[str, Any]) -> bool:
    """Give a command's result as data; whether it is wanted, so that no table is to be printed.

    Numbers are in SI units, which end their keys: ``length_m``, ``speed_m_s``, ``energy_J``.
    """
    if _output.as_json:
        _output.content.update(content)
    return _output.as_json


def show(
    *results: Presented, also: Sequence[str] = (), picture: Path | None = None, **drawn: Any
) -> None:
    """Print results as their class states: tables and sentences, or data where JSON is wanted.

    Parameters
    ----------
    *results : Presented
    also : sequence of str
        Names of tables that are shown on request.
    picture : path, optional
        Of the first, to be drawn; `drawn` are options of its `plot`.
    """
    if picture is not None:
        from analysis.charts import draw

        draw(results[0], picture, **drawn)
    for result in results:
        if not state(result.data()):
            for part in result.shown(*also):
                console.print(part)
    if picture is not None:
        wrote(picture)


def say(*sentences: object) -> None:
    """Print sentences; where one is too long the terminal breaks it."""
    for each in sentences:
        console.print(each, soft_wrap=True)


def say_wrapped(words: str) -> None:
    """Print words to be read: their lines end between words where a width is known."""
    known = console.is_terminal or os.environ.get("COLUMNS")
    console.print(words, soft_wrap=not known)


def as_json_text(document: Any) -> str:
    """A document as JSON: null for a number that is not finite, paths and days as text."""
    return json.dumps(plain(document), ensure_ascii=False, allow_nan=False, indent=1)


def plain(value: Any) -> Any:
    """A value in JSON's own types.

    Examples
    --------
    >>> plain({"speed_m_s": float("nan"), "log": Path("a.mcap"), "days": (1, 2)})
    {'speed_m_s': None, 'log': 'a.mcap', 'days': [1, 2]}
    """
    if isinstance(value, bool | str | None):
        return value
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(each) for each in value]
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, Path):
        return str(value)
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if hasattr(value, "tolist"):  # of numpy
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, int) else str(value)


def about(known: Mapping[str, str], duration: float | None) -> str:
    """One line on a trip: its metadata, and how long it was [s]."""
    parts = [] if duration is None else [f"{lasted(duration)} recorded"]
    parts += [known.get("direction", "")]
    parts += [f"{known['weather']} rail"] if known.get("weather") else []
    parts += [f"load {float(known['load']) / 1e3:.1f} t"] if known.get("load") else []
    parts += [f"as {known['configuration']}"] if known.get("configuration") else []
    return f"  {known.get('trip', 'unnamed')}: {', '.join(filter(None, parts))}"


def print_error(message: str) -> None:
    """State what is wrong in one line on standard error."""
    line = " ".join(message.split())
    errors.print(f"trainlog: {line}", soft_wrap=True)


def print_problems(error: TrainlogError, *, as_json: bool = False) -> None:
    """State what is wrong: in one line or, if a file has several problems, in one line each.

    As JSON in one object, in one line.
    """
    problems = getattr(error, "problems", ())
    if as_json:
        found = _parts_of(error) | ({"problems": [*map(_parts_of, problems)]} if problems else {})
        print(json.dumps({"status": 2, "error": found}, ensure_ascii=False), file=sys.stderr)
    elif not problems:
        print_error(str(error))
    else:
        print_error(f"{error.file}: {len(problems)} problems")
        shown = [str(problem) for problem in problems[:MOST_LISTED]]
        if len(problems) > MOST_LISTED:
            shown.append(f"and {len(problems) - MOST_LISTED} more")
        for line in shown:
            errors.print(f"  {line}", soft_wrap=True)


def _parts_of(error: TrainlogError) -> dict[str, Any]:
    """An error as data."""
    parts = {name: getattr(error, name) for name in ("problem", "file", "place", "remedy")}
    return {name: plain(part) for name, part in parts.items()}


def print_warning(message: str) -> None:
    """State in one yellow line on standard error what may mislead."""
    if not _output.quiet:
        line = " ".join(f"trainlog: warning: {message}".split())
        errors.print(line, style="yellow", soft_wrap=True)


def print_account(log: Path, account: Account) -> None:
    """List what of a log is readable and what is lost: a line, and one for each loss."""
    style = None if account.whole else "yellow"
    console.print(f"{log}: {account.sentence}", style=style, soft_wrap=True)
    # The sentence states already that a recording was not closed.
    for line in account.lines()[1 : 1 + len(account.losses)]:
        console.print(f"  {line}", soft_wrap=True)


def wrote(*paths: Path) -> None:
    """List the files that were written."""
    _output.written.extend(paths)
    for path in () if _output.as_json else paths:
        console.print(f"wrote {path}", soft_wrap=True)


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
        if self._progress is None and errors.is_terminal and not current().quiet:
            self._progress = _bars()
            self.resume()
        bar = self._progress
        number = None if bar is None else bar.add_task(name, total=total, unit=unit, note="")
        state: dict[str, Any] = {"completed": 0.0, "total": total, "note": ""}
        self._depth += 1

        def step(
            done: float | None = None, total: float | None = None, note: str | None = None
        ) -> None:
            self._check()
            given = {"completed": done, "total": total, "note": note}
            state.update((key, each) for key, each in given.items() if each is not None)
            if bar is not None and number is not None:
                bar.update(number, **state)

        lines = self._depth == 1 and not errors.is_terminal and not current().quiet
        try:
            with _lines(name, unit, state) if lines else nullcontext():
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
            if console.is_terminal:
                console.pop_render_hook()
            self._progress.stop()

    def resume(self) -> None:
        """Draw again."""
        if self._progress is not None:
            self._progress.start()
            # Both streams are one screen: what is printed as a result goes above the bars.
            if console.is_terminal:
                console.push_render_hook(self._progress.live)


SILENCE = 30.0
"""Time [s] after which progress is stated in a line where no bar can be drawn; each further one
comes after twice the time of the one before."""


@contextmanager
def _lines(name: str, unit: str, state: Mapping[str, Any]) -> Iterator[None]:
    """State on standard error how far a task is, now and then."""
    over, began = threading.Event(), time.monotonic()

    def run() -> None:
        silence = SILENCE
        while not over.wait(silence):
            silence *= 2.0
            elapsed, total = time.monotonic() - began, state["total"]
            done = min(elapsed, total or 0.0) if unit == "s" else state["completed"]
            how = f"{amount(done, total, unit)} {pace(elapsed, done, total, unit)}"
            errors.print(" ".join(f"{name}: {how} {state['note']}".split()), soft_wrap=True)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


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
        console=errors,
        transient=True,
        redirect_stdout=console.is_terminal,
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
