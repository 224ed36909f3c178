"""Start here: a user's settings, and the documentation."""

from __future__ import annotations

import os
import shlex
import subprocess
from typing import TYPE_CHECKING

from trainlog.cli.terminal import console, say, state, wrote
from trainlog.errors import InputError

if TYPE_CHECKING:
    from trainlog.formats.settings import Settings


def settings(
    key: str | None = None, value: str | None = None, /, *, unset: bool = False, edit: bool = False
) -> None:
    """Show or change your units, time zone and default files.

    Without a KEY all settings and their file are listed. Units and time zone change what the
    command line shows; files and --json are in SI units and UTC.

    Example: trainlog settings

    Example: trainlog settings speed mph

    Example: trainlog settings speed --unset

    Parameters
    ----------
    key : KEY
        speed, zone, line, train, results or catalogue; default: show all.
    value : VALUE
        New value of KEY.
    unset
        Reset KEY to its default.
    edit
        Open the file in the editor that VISUAL or EDITOR names, and check it.
    """
    from trainlog.formats.settings import read_settings, set_setting

    if edit:
        _edit()
    elif unset or value is not None:
        if key is None or (unset and value is not None):
            raise InputError(
                "--unset takes the key alone", remedy="write 'trainlog settings speed --unset'"
            )
        wrote(set_setting(key, value))
    else:
        _show(key, read_settings())


def _show(key: str | None, found: Settings) -> None:
    """List the settings, or one of them."""
    from trainlog.formats.settings import MEANINGS, settings_path
    from trainlog.presentation import new_table

    path = settings_path()
    if key is not None and key not in MEANINGS:
        raise InputError(f"'{key}' is not a setting", remedy=f"known: {', '.join(MEANINGS)}")
    values = {name: getattr(found, name) for name in MEANINGS if key in (None, name)}
    if not state({"file": path, "settings": values}):
        table = new_table("Settings", "key", "value", "sets the")
        for name, value in values.items():
            table.add_row(name, value, MEANINGS[name])
        there = "" if path.exists() else " (not made yet: all are the defaults)"
        console.print(table, f"in {path}{there}")


def _edit() -> None:
    from trainlog.formats.settings import read_settings, settings_path

    editor = os.environ.get("VISUAL") or os.environ.get("EDITOR")
    path = settings_path()
    if not editor:
        raise InputError(
            "no editor is named",
            file=path,
            remedy="set EDITOR, or use 'trainlog settings KEY VALUE'",
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    subprocess.run([*shlex.split(editor), str(path)], check=False)
    read_settings()
    say(f"{path} is valid")


def docs(page: str | None = None, /, *, list_: bool = False, path: bool = False) -> None:
    """Open the documentation in the browser; needs no network.

    Without a display the path is printed.

    Example: trainlog docs tutorials/engineer

    Parameters
    ----------
    page : PAGE
        Page, such as replay or tutorials/planner, or a public name, such as analysis.fit; default:
        the first page.
    list_
        List all pages.
    path
        Only print the path.
    """
    from trainlog.documentation import REMEDY, documentation

    found = documentation()
    if list_:
        from trainlog.presentation import new_table

        table = new_table("Pages", "page", "title")
        for row in found.titles():
            table.add_row(*row)
        console.print(table)
        return
    file, anchor = found.place(page)
    uri = file.as_uri() + (f"#{anchor}" if anchor else "")
    if state({"page": file, "uri": uri, "built": found.built}):
        return
    if path or not (found.built and _opened(uri)):
        say(uri if anchor else file)
    if not found.built:
        say(f"  {REMEDY}")


def _opened(uri: str) -> bool:
    """Whether a browser shows the page."""
    import webbrowser

    from trainlog.replay.viewer import has_display

    return has_display() and webbrowser.open(uri)
