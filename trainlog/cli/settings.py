"""Start here: a user's settings, and the documentation."""

from __future__ import annotations

import html
import os
import re
import shlex
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from trainlog.cli.terminal import console, say, state, wrote
from trainlog.errors import InputError, similar

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


# --------------------------------------------------------------------- where the documentation is


_PACKAGE = Path(__file__).resolve().parents[1]
_INSTALLED = _PACKAGE / "documentation_pages"
SITES = (_INSTALLED / "site", _PACKAGE.parent / "build" / "site")
"""Where a site may be: inside the installed package, or where ``make docs`` leaves it."""

SOURCES = (_INSTALLED / "source", _PACKAGE.parent / "docs")
"""Where its Markdown may be."""

REMEDY = (
    "this installation has the pages as Markdown only; 'make docs' in a checkout builds the site,"
    " and a wheel made by 'make wheel' holds it"
)
"""What is stated where there is no site."""

_TITLES = {
    ".html": re.compile(r"<h1[^>]*>(.*?)(?:<a class=\"headerlink\"|</h1>)", re.S),
    ".md": re.compile(r"^# (.*)$", re.M),
}


@dataclass(frozen=True)
class Documentation:
    """The documentation of this installation.

    Attributes
    ----------
    folder : path
    built : bool
        Whether it is the site, to be read in a browser; else Markdown.
    """

    folder: Path
    built: bool

    @property
    def suffix(self) -> str:
        """Of the pages' files."""
        return ".html" if self.built else ".md"

    def pages(self) -> dict[str, Path]:
        """Files of the pages by name, such as ``tutorials/planner``."""
        found = sorted(self.folder.rglob(f"*{self.suffix}"))
        names = (path.relative_to(self.folder).with_suffix("").as_posix() for path in found)
        pages = dict(zip(names, found, strict=True))
        # A site holds reports, too, as examples.
        return {
            name: path
            for name, path in pages.items()
            if name != "404" and (not self.built or "md-content" in path.read_text("utf-8"))
        }

    def titles(self) -> Iterator[tuple[str, str]]:
        """Name and title of each page."""
        for name, path in self.pages().items():
            title = _TITLES[self.suffix].search(path.read_text("utf-8"))
            words = re.sub(r"<[^>]*>", "", title[1]) if title else name
            yield name, html.unescape(" ".join(words.split())).replace("`", "")

    def place(self, wanted: str | None = None) -> tuple[Path, str]:
        """File of a page, and the place in it, or "".

        Parameters
        ----------
        wanted : str, optional
            A page's name or the end of one, or a public name of the packages; default: the first
            page.

        Raises
        ------
        InputError
            If there is no such page; names those that are written alike.
        """
        pages = self.pages()
        name = "index" if wanted is None else wanted.removesuffix(self.suffix).strip("/")
        matching = [each for each in pages if each == name or each.endswith(f"/{name}")]
        matching = matching or [each for each in pages if each == f"{name}/index"]
        if matching:
            return pages[min(matching, key=len)], ""
        for dotted in (name, *(f"{package}.{name}" for package in PACKAGES)):
            for page, path in pages.items():
                mark = f'id="{dotted}"' if self.built else f"::: {dotted}\n"
                if page.startswith("reference/") and mark in path.read_text("utf-8"):
                    return path, dotted if self.built else ""
        alike = similar(name, [*pages, *(page.rpartition("/")[2] for page in pages)])
        hint = f"near to it: {', '.join(alike)}; " if alike else ""
        raise InputError(
            f"there is no page '{wanted}'", remedy=f"{hint}'trainlog docs --list' lists all pages"
        )


PACKAGES = ("trainlog", "analysis", "estimators")
"""Whose public names have a place in the reference."""


def documentation() -> Documentation:
    """The documentation of this installation: the site if there is one, else Markdown.

    Raises
    ------
    InputError
        If there is neither.

    Examples
    --------
    >>> found = documentation()
    >>> path, _ = found.place("engineer")
    >>> path.relative_to(found.folder).with_suffix("").as_posix()
    'tutorials/engineer'
    """
    for built, places in ((True, SITES), (False, SOURCES)):
        for folder in places:
            if (folder / ("index.html" if built else "index.md")).is_file():
                return Documentation(folder, built)
    raise InputError(
        "the documentation is missing from this installation",
        file=SOURCES[0],
        remedy="install trainlog again",
    )
