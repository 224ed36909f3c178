"""What every command has: options of its output, help that reads well, an end by Ctrl-C.

`Command` gives commands these; none of them needs to know of it.
"""

from __future__ import annotations

import inspect
import re
from functools import cache
from importlib import import_module
from keyword import iskeyword
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from trainlog.cli.options import ChosenTrips, chosen_logs, chosen_summaries, typed
from trainlog.cli.terminal import (
    Output,
    ProgressDisplay,
    console,
    output_of,
    print_error,
    progress_shown,
)
from trainlog.display import counted
from trainlog.errors import InputError

INTERRUPTED = 130
"""Exit status after Ctrl-C; typer returns it, too."""

PANELS = {
    "Start here": {"demo": "demo", "docs": "settings", "settings": "settings"},
    "Record": {
        "import": "files",
        "new": "files",
        "ingest": "ingest",
        "record": "ingest",
        "convert": "files",
    },
    "Look": {"show": "files", "compare": "look", "replay": "look", "report": "look"},
    "Learn": {"fit": "learn", "estimate": "learn", "map": "map", "fleet": "fleet"},
    "Plan and drive": {
        "plan": "plan",
        "advice": "plan",
        "sfera": "plan",
        "simulate": "simulate",
        "study": "study",
    },
}
"""The words of the program by the panels of its help, in their order: for each the module of
`trainlog.cli` with a function of the word's name, or the word's commands as ``X_app``."""

WORDS = {word: (panel, module) for panel, words in PANELS.items() for word, module in words.items()}
"""Panel and module of each word."""

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
    "coast-down": "fit coasting",
    "adhesion": "fit adhesion",
    "adhesion fit": "fit adhesion",
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


def _common(
    *,
    trips: str | None = None,
    catalogue: str | None = None,
    json: bool = False,
    quiet: bool = False,
) -> None:
    """The options that commands share: of those that take logs, and of all.

    Parameters
    ----------
    trips : WHERE
        Trips of the catalogue, in addition to logs: "line = 'X' and weather = 'wet'"; or
        all.
    json
        Print only the result, as one JSON object.
    quiet
        Print errors only.
    """


@cache
def _common_options() -> tuple[list[Any], list[Any]]:
    """The options of commands that take logs, and those of all commands."""
    program = typer.Typer(add_completion=False)
    program.command()(typed(_common))
    every = typer.main.get_command(program).params
    return every[:2], every[2:]


DEFAULT = {"fit": "efforts", "compare": "trips"}
"""Of a word with several commands the one that is meant where none of them is named."""

INPUTS = ("line", "train", "profile", "network", "trajectory", "onto", "with_", "journey")
"""Options that name a file to be read."""


def _check_exists(given: Any) -> None:
    """Refuse a file that is missing before the packages are imported that would read it.

    Of several files those that are missing say nothing of the others: the command states them.
    """
    paths = given if isinstance(given, tuple | list) else [given]
    if len(paths) != 1 or not isinstance(paths[0], Path):
        return
    from trainlog.formats.samples import SAMPLE

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
    """What help says of a command and of the values that its options and arguments take."""

    help: str | None

    def __init__(self, **known: Any) -> None:
        super().__init__(**known)
        # Help breaks where the terminal ends, not where the docstring does.
        paragraphs = (self.help or "").split("\n\n")
        self.help = "\n\n".join(" ".join(part.split()) for part in paragraphs)

    def get_params(self, ctx: Any) -> list[Any]:
        """The parameters; the help states no types but those that they are shown with."""
        found: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for each in found:
            each.metavar = each.metavar or ""
            if each.param_type_name == "argument":
                each.display_type_rich = lambda **_: ""
        return found


class Command(_Described, TyperCommand):
    """A command with the options of its output, whose end by Ctrl-C is stated once.

    One that takes logs has options, too, that choose trips of a catalogue in their place.
    """

    def __init__(self, *, params: list[Any], callback: Any, **known: Any) -> None:
        known_types = inspect.signature(callback, eval_str=True).parameters
        of_logs, common = _common_options()
        self._logs: Any = None
        self._needed = False
        for each in params:
            if ChosenTrips in getattr(known_types[each.name].annotation, "__metadata__", ()):
                self._logs, self._needed = each, each.required
                each.help = f"{each.help}{' Or --trips.' * each.required}"
                each.required, common = False, [*of_logs, *common]
        super().__init__(params=[*params, *common], callback=callback, **known)

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        from trainlog.formats.settings import read_settings

        given = ctx.params
        words = ctx.command_path.partition(" ")[2]
        shown = {"as_json": given.pop("json"), "quiet": given.pop("quiet")}
        with output_of(words, **shown) as output, progress_shown() as display:
            if words != "settings":  # which states what is wrong with them itself
                known = read_settings()
                console.shown_as = known.speed, known.zone
            try:
                for each in self.params:
                    if each.param_type_name == "argument" or each.name in INPUTS:
                        _check_exists(given[each.name])
                if self._logs is not None:
                    self._choose_trips(given)
                return super().invoke(ctx)
            except KeyboardInterrupt:
                _state_interruption(output, display)
                raise typer.Exit(INTERRUPTED) from None

    def _choose_trips(self, given: dict[str, Any]) -> None:
        """Give the command the logs of the trips that are chosen beside those that are named."""
        chosen_trips, catalogue = given.pop("trips"), given.pop("catalogue")
        name = self._logs.name
        if chosen_trips is not None:
            # Summaries of fits stand for the logs of other fits alone.
            of_fits = self.name == "efforts"
            chosen = chosen_summaries if of_fits else chosen_logs
            given[name] = (*(given[name] or ()), *chosen(chosen_trips, catalogue))
        elif catalogue is not None:
            raise InputError(
                f"--catalogue {catalogue} is given, but not which of its trips",
                remedy="choose them with --trips \"weather = 'wet'\", or --trips all",
            )
        elif self._needed and not given[name]:
            raise InputError(
                "no logs are given",
                remedy="name logs or folders, or choose trips of a catalogue with --trips",
            )


class Group(_Described, TyperGroup):
    """Commands under one word; the word alone shows their help."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Show the help where nothing else is asked for."""
        if not args and not ctx.resilient_parsing:
            print(ctx.get_help(), end="")
            ctx.exit()
        meant = DEFAULT.get(ctx.info_name)
        if meant and args and args[0] not in self.commands and args[0] not in ("-h", "--help"):
            args = [meant, *args]
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
        self.commands: dict[str, Any] = dict.fromkeys(WORDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002
        """The command of a word, made when it is asked for."""
        if cmd_name in WORDS and self.commands[cmd_name] is None:
            self.commands[cmd_name] = _command(cmd_name)
        return self.commands.get(cmd_name)


@cache
def _command(word: str) -> Any:
    """A command, or the commands under one word, from its module."""
    panel, name = WORDS[word]
    module = import_module(f"trainlog.cli.{name}")
    found = getattr(module, f"{word}_app", None)
    if found is None:
        found = typer.Typer(add_completion=False)
        found.command(word)(typed(getattr(module, f"{word}_" if iskeyword(word) else word)))
    else:
        found.info.cls = Group
        for each in found.registered_commands:
            each.callback = typed(each.callback)
    for each in found.registered_commands:
        each.cls = Command
    made = typer.main.get_command(found)
    made.name = word
    made.rich_help_panel = panel  # type: ignore[attr-defined]
    return made
