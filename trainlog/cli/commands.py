"""What every command has: options of its output, help that reads well, an end by Ctrl-C.

`prepared` goes over the commands of the program; none of them needs to know of it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from copy import copy
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.models import ParameterInfo

from trainlog.cli.help import print_help, shown_type
from trainlog.cli.options import (
    CatalogueOption,
    ChosenTrips,
    TakesSummaries,
    chosen_logs,
    chosen_summaries,
)
from trainlog.cli.progress_bar import ProgressDisplay, progress_shown
from trainlog.cli.terminal import Output, console, output_of, print_error
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.formats.settings import read_settings

if TYPE_CHECKING:
    from typer.models import CommandInfo, TyperInfo

INTERRUPTED = 130
"""Exit status after Ctrl-C; typer returns it, too."""

JSON = Annotated[
    bool, typer.Option("--json", help="Print the result as one JSON object, and nothing else.")
]
QUIET = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]

TRIPS = (
    "Trips of the catalogue, beside logs that are named: \"line = 'X' and weather = 'wet'\"; or"
    " all."
)

STATUSES = {
    0: "done",
    1: "done in part, or something was found: a file that could not be used beside others that"
    " could, damage, a significant change",
    2: "nothing was done: the command, a file or an option cannot be used; one line states why and"
    " what to do",
    INTERRUPTED: "interrupted by Ctrl-C; one line states what was finished",
}
"""Exit statuses of all commands, with what they mean."""


def end_in_part(failed: int, of: int) -> None:
    """End a command some of whose inputs failed: status 1, or 2 if all of them did."""
    if failed:
        raise typer.Exit(2 if failed == of else 1)


def prepared(panel: typer.Typer) -> None:
    """Give all commands of a program their common options, and lay out their help."""
    documented: list[CommandInfo | TyperInfo] = [*panel.registered_commands]
    if panel.registered_callback is not None:
        documented.append(panel.registered_callback)
    for known in documented:
        text = inspect.getdoc(known.callback) if known.callback else None
        if text and not known.help:
            # Help breaks where the terminal ends, not where the docstring does.
            known.help = "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))
    for command in panel.registered_commands:
        command.cls = Command
        if command.callback is not None:
            command.callback = _with_trips(command.callback)
        if command.callback is not None:
            command.callback = _with_output(command.callback)
    for group in panel.registered_groups:
        group.cls = Group
        if group.typer_instance is not None:
            group.typer_instance.info.cls = Group
            prepared(group.typer_instance)


def _with_trips(callback: Callable[..., Any]) -> Callable[..., Any]:
    """A command that takes logs with the options that choose trips of a catalogue instead."""
    signature = inspect.signature(callback, eval_str=True)
    marked = [each for each in signature.parameters.values() if ChosenTrips in _notes(each)]
    if not marked:
        return callback
    (logs,) = marked
    needed = logs.default is inspect.Parameter.empty
    known = copy(next(each for each in _notes(logs) if isinstance(each, ParameterInfo)))
    if needed:
        known.help = f"{known.help} Or --trips."
    optional = logs.replace(annotation=Annotated[list[Path] | None, known], default=None)
    # A command may have a flag of that name, which lists the trips of a map.
    option = "--trips" if "trips" not in signature.parameters else "--chosen"
    wanted = Annotated[str | None, typer.Option(option, metavar="WHERE", help=TRIPS)]
    added = {"chosen_trips": wanted, "catalogue": CatalogueOption}

    @wraps(callback)
    def command(
        *parts: Any, chosen_trips: str | None = None, catalogue: str | None = None, **rest: Any
    ) -> Any:
        given = rest[logs.name]
        if chosen_trips is not None:
            chosen = chosen_summaries if TakesSummaries in _notes(logs) else chosen_logs
            rest[logs.name] = [*(given or ()), *chosen(chosen_trips, catalogue)]
        elif catalogue is not None:
            raise InputError(
                f"--catalogue {catalogue} is given, but not which of its trips",
                remedy=f"choose them with {option} \"weather = 'wet'\", or {option} all",
            )
        elif needed and not given:
            raise InputError(
                "no logs are given",
                remedy=f"name logs or folders, or choose trips of a catalogue with {option}",
            )
        return callback(*parts, **rest)

    kept = [optional if each is logs else each for each in signature.parameters.values()]
    kept += [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
        for name, annotation in added.items()
    ]
    command.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in kept]
    )
    command.__annotations__ = {each.name: each.annotation for each in kept}
    del command.__wrapped__  # its signature is not what is asked for
    return command


def _notes(parameter: inspect.Parameter) -> tuple[Any, ...]:
    """What the annotation of a parameter says beside its type."""
    annotation = parameter.annotation
    return getattr(annotation, "__metadata__", ())


def _with_output(callback: Callable[..., Any]) -> Callable[..., Any]:
    """A command with the options of its output, whose end by Ctrl-C is stated once."""
    signature = inspect.signature(callback, eval_str=True)
    own = "as_json" in signature.parameters  # it prints JSON itself
    given = {} if own else {"as_json": JSON}
    added = [
        inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=annotation
        )
        for name, annotation in {**given, "quiet": QUIET}.items()
    ]

    @wraps(callback)
    def command(
        *parts: Any, context: typer.Context, quiet: bool, as_json: bool = False, **rest: Any
    ) -> Any:
        words = context.command_path.partition(" ")[2]
        if own:
            rest["as_json"], as_json = as_json, False
        with output_of(words, as_json=as_json, quiet=quiet) as output, progress_shown() as display:
            if words.partition(" ")[0] != "settings":  # which states what is wrong with them itself
                known = read_settings()
                console.shown_as = known.speed, known.zone
            try:
                return callback(*parts, **rest)
            except KeyboardInterrupt:
                _state_interruption(output, display)
                raise typer.Exit(INTERRUPTED) from None

    asked = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    parameters = [*signature.parameters.values(), *added, asked]
    command.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]
    )
    command.__annotations__ = {each.name: each.annotation for each in parameters}
    del command.__wrapped__  # its signature is not what is asked for
    return command


def _state_interruption(output: Output, display: ProgressDisplay) -> None:
    """State in one line that a command was interrupted, where, and what it had finished."""
    display.pause()
    outer = output.parent.place if output.parent is not None else ""
    if output.finished is not None:
        finished = output.finished()
    else:
        kept = [path for path in dict.fromkeys(output.files) if path.exists()]
        finished = f"{counted(len(kept), 'file')} written" if kept else "nothing was written"
    said = "; ".join(filter(None, (display.outermost, finished)))
    print_error(f"interrupted{outer and f' at {outer}'}: {said}")


class _Described:
    """What help says of the values that options and arguments take."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The parameters, with types in words of the field; what is on or off has none."""
        found: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for each in found:
            if each.param_type_name == "argument" and each.metavar is None:
                each.metavar = each.name.upper()
            shown = shown_type(each, ctx)
            each.display_type_rich = lambda shown=shown, **_: shown
        return found


class Command(_Described, TyperCommand):
    """A command whose help speaks of files, kilometres and seconds."""

    def format_help(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002
        """Print the help."""
        print_help(self, ctx)


class Group(_Described, TyperGroup):
    """Commands under one word; the word alone shows their help."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Show the help where nothing else is asked for, or what the group shows by itself."""
        if self.invoke_without_command and (not args or args[0] in ("--json", "--quiet", "-q")):
            args = ["show", *args]
        if not args and not ctx.resilient_parsing:
            print(ctx.get_help(), end="")
            ctx.exit()
        return super().parse_args(ctx, args)
