"""What every command has: options of its output, help that reads well, an end by Ctrl-C.

`prepared` goes over the commands of the program; none of them needs to know of it.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from copy import copy
from functools import cache, wraps
from importlib import import_module
from keyword import iskeyword
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup
from typer.models import ArgumentInfo, ParameterInfo

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
from trainlog.formats.samples import SAMPLE
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


class Word(NamedTuple):
    """A word of the program.

    Attributes
    ----------
    module : str
        Of `trainlog.cli`, with a function of the word's name, or the word's commands as ``X_app``.
    panel, help : str
        Where the program's help lists it, and in which words.
    """

    module: str
    panel: str
    help: str


START, FILES, LOOK, LEARN, PLAN = "Start here", "Record", "Look", "Learn", "Plan and drive"

WORDS = {
    "demo": Word(
        "demo", START, "Run the whole chain on St.Gallen-Wil: record, fit, map, plan, replay."
    ),
    "docs": Word("settings", START, "Open the documentation in the browser; it needs no network."),
    "settings": Word("settings", START, "Show or set units, time zone and files of your own."),
    "import": Word(
        "files",
        FILES,
        "Turn lines, trains, journeys and networks of other programs into trainlog's files.",
    ),
    "new": Word(
        "files", FILES, "Begin a line, network, train, journey or profile, or copy the samples."
    ),
    "ingest": Word(
        "ingest",
        FILES,
        "Turn recorded logs into trips; what was repaired is counted and kept in the log.",
    ),
    "record": Word(
        "live",
        FILES,
        "Record what a recorder sends while the train runs: UDP, a pipe, or a file that grows.",
    ),
    "convert": Word(
        "files", FILES, "Write logs anew: as Parquet, CSV or MDF, in part, joined, rebuilt."
    ),
    "show": Word(
        "files", LOOK, "State what a file holds, whatever it is; it is recognised by its content."
    ),
    "compare": Word(
        "look",
        LOOK,
        "Compare trips over a line by position: times, where time was"
        " lost and why, energy, driving.",
    ),
    "replay": Word(
        "look", LOOK, "Show trips in the Rerun viewer, by time and by position; or a part of them."
    ),
    "report": Word(
        "look",
        LOOK,
        "Write a report as one HTML page that needs no network: to send, to read, to print.",
    ),
    "fit": Word("learn", LEARN, "Fit running resistance to trips, or adhesion to measured points."),
    "estimate": Word(
        "learn",
        LEARN,
        "Add estimates to logs: smoothed motion, running resistance, adhesion, slip.",
    ),
    "map": Word("map", LEARN, "The track-condition map: maximum adhesion."),
    "fleet": Word("fleet", LEARN, "The catalogue of a fleet, and what is computed of its trips."),
    "plan": Word(
        "plan",
        PLAN,
        "Find the trajectory of least energy that every observed configuration can follow.",
    ),
    "advice": Word(
        "plan", PLAN, "Write the driver's advice for a whole journey, or add it to a recorded trip."
    ),
    "simulate": Word(
        "simulate", PLAN, "Simulate drivers, trips along a trajectory, days, a fleet."
    ),
    "study": Word(
        "study", PLAN, "Run a published system beside its paper, or the dynamics inside a train."
    ),
}
"""The words of the program, in the order of its help."""

FORMER = {
    "samples": "new samples",
    "info": "show",
    "check": "show --check",
    "recover": "convert",
    "cut": "convert --km",
    "merge": "convert",
    "line": "new line --from",
    "line build": "new line --from",
    "network": "show",
    "network import": "import",
    "network build": "new network --from",
    "network show": "show",
    "network route": "show 'NET#A,B'",
    "network export": "convert NET.network.json -o NET.geojson",
    "coast-down": "fit --method coasting",
    "adhesion": "fit --method adhesion",
    "adhesion fit": "fit --method adhesion",
    "map history": "map show --km 12.3",
    "optimise": "plan",
    "optimize": "plan",
    "driver-advice": "advice",
    "advise": "advice --onto",
    "catalogue": "fleet",
    "catalogue add": "fleet add",
    "catalogue list": "fleet show",
    "catalogue query": "fleet query",
    "catalogue sql": "fleet query",
    "catalogue export": "fleet query -o",
    "catalogue refresh": "fleet refresh",
    "catalogue remove": "fleet remove",
    "fleet status": "fleet show",
    "fleet report": "report CATALOGUE",
    "fleet demo": "demo --fleet",
    "simulate": "simulate drive', 'follow', 'days' or 'fleet",
    "settings show": "settings",
    "settings set": "settings KEY VALUE",
    "settings unset": "settings KEY --unset",
    "settings edit": "settings --edit",
}
"""Former names of commands, and what is called today."""


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
    wanted = Annotated[str | None, typer.Option("--trips", metavar="WHERE", help=TRIPS)]
    added = {"chosen_trips": wanted, "catalogue": CatalogueOption}

    @wraps(callback)
    def command(
        *parts: Any, chosen_trips: str | None = None, catalogue: str | None = None, **rest: Any
    ) -> Any:
        given = rest[logs.name]
        if chosen_trips is not None:
            # Summaries of fits stand for the logs of other fits alone.
            summed_up = TakesSummaries in _notes(logs) and rest.get("method") == "efforts"
            chosen = chosen_summaries if summed_up else chosen_logs
            rest[logs.name] = [*(given or ()), *chosen(chosen_trips, catalogue)]
        elif catalogue is not None:
            raise InputError(
                f"--catalogue {catalogue} is given, but not which of its trips",
                remedy="choose them with --trips \"weather = 'wet'\", or --trips all",
            )
        elif needed and not given:
            raise InputError(
                "no logs are given",
                remedy="name logs or folders, or choose trips of a catalogue with --trips",
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

    inputs = [each.name for each in signature.parameters.values() if _is_input(each)]

    @wraps(callback)
    def command(
        *parts: Any, context: typer.Context, quiet: bool, as_json: bool = False, **rest: Any
    ) -> Any:
        words = context.command_path.partition(" ")[2]
        if own:
            rest["as_json"], as_json = as_json, False
        with output_of(words, as_json=as_json, quiet=quiet) as output, progress_shown() as display:
            if words != "settings":  # which states what is wrong with them itself
                known = read_settings()
                console.shown_as = known.speed, known.zone
            try:
                for name in inputs:
                    _check_exists(rest[name])
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


INPUTS = ("line", "train", "profile", "network", "trajectory", "onto")
"""Options that name a file to be read."""


def _is_input(parameter: inspect.Parameter) -> bool:
    """Whether a parameter names files to be read."""
    argument = any(isinstance(each, ArgumentInfo) for each in _notes(parameter))
    return "Path" in str(parameter.annotation) and (argument or parameter.name in INPUTS)


def _check_exists(given: Any) -> None:
    """Refuse a file that is missing before the packages are imported that would read it.

    Of several files those that are missing say nothing of the others: the command states them.
    """
    paths = given if isinstance(given, list) else [given]
    if len(paths) != 1 or not isinstance(paths[0], Path):
        return
    (path,) = paths
    if not path.exists() and "#" not in path.name and str(path) != SAMPLE:
        raise InputError("does not exist", file=path, remedy="check the path")


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
        """Show the help where nothing else is asked for."""
        if not args and not ctx.resilient_parsing:
            print(ctx.get_help(), end="")
            ctx.exit()
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that is called; of a former name one line states the new one."""
        words = [*ctx.command_path.split()[1:], *args, ""]
        for former in (" ".join(words[:2]), words[0]):
            asked = former not in WORDS or re.match(r"-(?!h$|-help$)", words[1])
            if former in FORMER and asked:
                ctx.fail(f"'{former}' is now 'trainlog {FORMER[former]}'")
        return super().resolve_command(ctx, args)


class Words(Group):
    """The words of the program; the module of a word is imported when it is called."""

    def __init__(self, **known: Any) -> None:
        super().__init__(**known)
        self.commands = _Modules()

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002
        """The words, in the order of the help."""
        return list(WORDS)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help; no module of a command is imported for it."""
        self.commands = {
            word: TyperCommand(word, help=each.help, rich_help_panel=each.panel)
            for word, each in WORDS.items()
        }
        super().format_help(ctx, formatter)


class _Modules(dict[str, Any]):
    """Commands by their words, each made when it is asked for."""

    def __init__(self) -> None:
        super().__init__(dict.fromkeys(WORDS))

    def __getitem__(self, word: str) -> Any:
        if super().__getitem__(word) is None:
            self[word] = _command(word)
        return super().__getitem__(word)

    def get(self, word: str, default: Any = None) -> Any:
        return self[word] if word in WORDS else default

    def items(self) -> Any:
        return [(word, self[word]) for word in self]


@cache
def _command(word: str) -> Any:
    """A command, or the commands under one word, from its module."""
    module = import_module(f"trainlog.cli.{WORDS[word].module}")
    found = getattr(module, f"{word}_app", None)
    if found is None:
        found = typer.Typer(add_completion=False)
        found.command(word)(getattr(module, f"{word}_" if iskeyword(word) else word))
    else:
        found.info.cls = Group
    prepared(found)
    made = typer.main.get_command(found)
    made.name = word
    return made
