"""The command of a user's settings: shown, set, taken back, edited."""

from __future__ import annotations

import os
import shlex
import subprocess
from typing import Annotated

import typer

from trainlog.cli.terminal import console, state, wrote
from trainlog.errors import InputError

app = typer.Typer()
settings_app = typer.Typer(
    invoke_without_command=True,
    help="Units and time zone that are shown, and files that are taken by default.",
)
app.add_typer(settings_app, name="settings", rich_help_panel="Start here")

KeyArgument = Annotated[str, typer.Argument(help="speed, zone, line, train or results.")]


@settings_app.command("show")
def settings_show() -> None:
    """List all settings, what each one sets, and the file in which they stand.

    Units and zone change what the command line shows; files and --json are in SI units and UTC.

    Example: trainlog settings show
    """
    from trainlog.formats.settings import MEANINGS, read_settings, settings_path
    from trainlog.presentation import new_table

    path, found = settings_path(), read_settings()
    values = {key: getattr(found, key) for key in MEANINGS}
    if state({"file": path, "settings": values}):
        return
    table = new_table("Settings", "key", "value", "sets the")
    for key, meaning in MEANINGS.items():
        table.add_row(key, values[key], meaning)
    there = "" if path.exists() else " (not made yet: all are the defaults)"
    console.print(table, f"in {path}{there}")


@settings_app.command("set")
def settings_set(
    key: KeyArgument,
    value: Annotated[str, typer.Argument(help="What it is set to.")],
) -> None:
    """Set one of the settings; the rest of the file stays as it is.

    Example: trainlog settings set speed mph

    Example: trainlog settings set zone Europe/Zurich
    """
    from trainlog.formats.settings import set_setting

    wrote(set_setting(key, value))


@settings_app.command("unset")
def settings_unset(key: KeyArgument) -> None:
    """Set one of the settings back to its default.

    Example: trainlog settings unset speed
    """
    from trainlog.formats.settings import set_setting

    wrote(set_setting(key, None))


@settings_app.command("edit")
def settings_edit() -> None:
    """Open the file in the editor that VISUAL or EDITOR names, and check it afterwards.

    Example: trainlog settings edit
    """
    from trainlog.formats.settings import read_settings, settings_path

    editor = os.environ.get("VISUAL") or os.environ.get("EDITOR")
    path = settings_path()
    if not editor:
        raise InputError(
            "no editor is named", file=path, remedy="set EDITOR, or use 'trainlog settings set'"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    subprocess.run([*shlex.split(editor), str(path)], check=False)
    read_settings()
    console.print(f"{path} is valid", highlight=False, soft_wrap=True)
