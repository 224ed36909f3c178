"""The options of all commands, listed on the page of the command line: made from the commands.

python docs/tools/options.py docs/command-line.md
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from trainlog.cli.main import app

BEGIN, END = "<!-- options -->", "<!-- end of options -->"

COMMON = {"--json", "--quiet", "--help", "--trips", "--catalogue"}
"""Options of every command, or of every command that takes logs."""


def commands(group: Any = None, words: str = "") -> Iterator[tuple[str, Any]]:
    """All commands by their words."""
    group = group or typer.main.get_command(app)
    context = typer.Context(group)
    for word in group.list_commands(context):
        command = group.get_command(context, word)
        name = f"{words} {word}".strip()
        if isinstance(command, TyperGroup):
            yield from commands(command, name)
        else:
            yield name, command


def context_of(name: str, command: Any) -> typer.Context:
    """The context in which a command is described, as the program has it."""
    return typer.Context(command, info_name=name, help_option_names=["-h", "--help"])


def own_options(name: str, command: Any) -> list[Any]:
    """The options that are a command's own."""
    every = command.get_params(context_of(name, command))
    return [
        each for each in every if each.param_type_name == "option" and not COMMON & set(each.opts)
    ]


SHARED = 2
"""Commands with the same option in the same words from which on it is stated once, above them."""


def parameters(name: str, command: Any) -> list[tuple[str, str]]:
    """Arguments and own options of a command as they are written, and what they are."""
    context = context_of(name, command)
    arguments = [each for each in command.get_params(context) if each.param_type_name == "argument"]
    rows = [
        (each.display_name_raw + "..." * (each.nargs != 1), f"{each.help}{required}")
        for each in arguments
        for required in [" [required]" * each.required]
    ]
    rows += [each.get_help_record(context) for each in own_options(name, command)]
    return [(_plain(what), _plain(words)) for what, words in rows]


def listed() -> str:
    """Options that several commands share; then each command with what it does and its own."""
    every = {name: parameters(name, command) for name, command in commands()}
    counts = Counter(row for rows in every.values() for row in dict.fromkeys(rows))
    shared: dict[str, tuple[str, str]] = {}
    for row, count in counts.most_common():
        if count >= SHARED:
            shared.setdefault(row[0], row)
    parts = ["### Of several commands", "\n".join(map(_line, shared.values()))]
    for name, command in commands():
        first = (command.help or "").partition("\n")[0]
        lines = [_line(row) for row in every[name] if shared.get(row[0]) != row]
        names = [f"`{row[0]}`" for row in every[name] if shared.get(row[0]) == row]
        if names:
            lines.append(f"- as above: {', '.join(names)}")
        parts += [f"### {name}", first, "\n".join(lines)]
    return "\n\n".join(part for part in parts if part)


def _line(row: tuple[str, str]) -> str:
    return f"- `{row[0]}`: {row[1]}"


def _plain(text: str) -> str:
    return re.sub(r"\[/?bold\]", "", " ".join(text.split()))


def with_options(page: str) -> str:
    """The page with the options as they are now."""
    before, after = page.partition(BEGIN)[0], page.partition(END)[2]
    return f"{before}{BEGIN}\n\n{listed()}\n\n{END}{after}"


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(with_options(path.read_text("utf-8")), "utf-8")
