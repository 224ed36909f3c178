"""What the commands print: on which stream, as text or as one JSON object, or not at all.

A command prints its tables and sentences on `console`, lists its files with `wrote` and its errors
with `print_error`. What becomes of it is decided here: without options it is shown; with
``--json`` the tables and sentences are gathered and printed as one object when the command ends;
with ``--quiet`` only errors are shown. Standard output holds results, standard error the rest.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, is_dataclass
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from trainlog.display import in_speed_unit, in_zone
from trainlog.errors import MOST_LISTED, TrainlogError
from trainlog.units import clock

if TYPE_CHECKING:
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
    parts = []
    if duration is not None:
        parts = [
            f"{clock(duration)} recorded" if duration >= 60.0 else f"{duration:.1f} s recorded"
        ]
    parts += [known.get("direction", "")]
    parts += [f"{known['weather']} rail"] if known.get("weather") else []
    parts += [f"load {float(known['load']) / 1e3:.1f} t"] if known.get("load") else []
    parts += [f"as {known['configuration']}"] if known.get("configuration") else []
    return f"  {known.get('trip', 'unnamed')}: {', '.join(filter(None, parts))}"


def print_error(message: str) -> None:
    """State what is wrong in one line on standard error."""
    line = " ".join(message.split())
    errors.print(f"trainlog: {line}", soft_wrap=True)


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
        errors.print(f"  {line}", soft_wrap=True)


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
