"""The help of a command, laid out so that it reads well on a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_origin

if TYPE_CHECKING:
    from rich.console import RenderableType

WIDEST_NAME = 30
"""Columns of an option's name and type beside its help; a longer one stands above it."""

SHOWN_TYPES: dict[str, str] = {
    "at": "TIME",
    "before": "DAY",
    "change": "CHANGE",
    "characteristic": "FILE",
    "configurations": "NAMES",
    "electrification": "NAME",
    "end": "TIME",
    "facts": "KEY=VALUE",
    "format": "NAME",
    "formation": "VEHICLES",
    "km": "KM:KM",
    "layer": "CONDITION",
    "load": "LOAD",
    "name": "NAME",
    "start": "TIME",
    "topic": "TOPIC",
    "zone": "ZONE",
}
"""What an option's value is, by the name of its parameter."""


def shown_type(parameter: Any, ctx: Any) -> str:
    """What the value of a parameter is, as help shows it; empty for what is on or off."""
    if getattr(parameter, "is_flag", False) or parameter.param_type_name == "argument":
        return ""
    if parameter.metavar is not None:
        return str(parameter.metavar)
    annotation: Any = getattr(getattr(parameter, "type_descriptor", None), "annotation", None)
    if get_origin(annotation) is list:
        annotation = annotation.__args__[0]
    if annotation is Path:
        return "FOLDER" if (parameter.help or "").startswith("Folder") else "FILE"
    if annotation is int:
        return "N"
    if annotation is str:
        return SHOWN_TYPES.get(parameter.name, "TEXT")
    return str(parameter.display_type(ctx)).strip("<>")


def print_help(command: Any, ctx: Any) -> None:
    """Print the help of a command: usage, what it does, arguments, options."""
    from rich.console import Console
    from rich.padding import Padding
    from rich.text import Text

    console = Console(highlight=False)
    # Braces are typer's, around what is required.
    words = ctx.get_usage().replace("{", "").replace("}", "")
    usage = Text(" ".join(words.split()), style="bold")
    console.print(Text(), Padding(usage, (0, 1)), Text())
    for part in (command.help or "").split("\n\n"):
        console.print(Padding(Text.from_markup(part), (0, 1, 1, 1)))
    parameters = [each for each in command.get_params(ctx) if not getattr(each, "hidden", False)]
    arguments = [each for each in parameters if each.param_type_name == "argument"]
    options = [each for each in parameters if each.param_type_name == "option"]
    for title, group in (("Arguments", arguments), ("Options", options)):
        if group:
            console.print(_panel(title, [described(each, ctx) for each in group]))


def _panel(title: str, rows: Iterable[tuple[str, str]]) -> RenderableType:
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    every = list(rows)
    width = min(max(len(name) for name, _ in every), WIDEST_NAME)
    grid = Table.grid(padding=(0, 2, 0, 0), expand=True)
    grid.add_column(width=width, no_wrap=True)
    grid.add_column(ratio=1, overflow="fold")
    for name, words in every:
        shown = Text.from_markup(words)
        if len(name) <= width:
            grid.add_row(Text(name, style="bold cyan"), shown)
            continue
        # A name that is too long takes two lines: its type stands in the second.
        flag, _, value = name.rpartition(" ")
        if len(flag) <= width and len(value) <= width - 2:
            grid.add_row(Text(f"{flag}\n  {value}", style="bold cyan"), shown)
        else:
            broken = f"{flag}\n  " + value.replace("|", "|\n  ")
            grid.add_row(Text(broken, style="bold cyan"), shown)
    return Panel(grid, title=title, title_align="left", border_style="dim")


def described(parameter: Any, ctx: Any) -> tuple[str, str]:
    """Name and type of a parameter, and its help with what is taken without it."""
    if parameter.param_type_name == "argument":
        name = parameter.display_name_raw + ("..." if parameter.nargs != 1 else "")
    else:
        short = [each for each in parameter.opts if not each.startswith("--")]
        long = [each for each in parameter.opts if each.startswith("--")]
        name = ", ".join([*short, *long, *parameter.secondary_opts])
    name = f"{name} {shown_type(parameter, ctx)}".rstrip()
    words, default = parameter.help or "", parameter.default
    if parameter.required:
        words += " [dim](required)[/dim]"
    elif isinstance(default, str | int | float) and not isinstance(default, bool):
        said = f"{default:g}" if isinstance(default, float) else str(default)
        words += f" [dim](default: {said})[/dim]"
    return name, words.strip()
