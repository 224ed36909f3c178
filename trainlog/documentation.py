"""Where the documentation is: the site that was built, or the Markdown that it is built from."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from trainlog.errors import InputError, similar

_PACKAGE = Path(__file__).resolve().parent
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
