"""The version of trainlog, for whatever writes down what made it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path

from trainlog.extras import names_for_types

__version__ = "0.1.0"

_SOURCE = Path(__file__).parents[1]
"""Folder that holds our packages."""

_PASSIVE = ("cli", "replay", "simulation", "studies")
"""Folders of code that no recording goes through."""


@cache
def code_version() -> str:
    """First 16 hexadecimal digits of the SHA-256 of the code that recordings go through.

    Between two releases it changes with the code, which `__version__` does not.

    Examples
    --------
    >>> len(code_version())
    16
    """
    files = [
        file
        for folder in (_SOURCE / name for name in ("trainlog", "analysis", "estimators"))
        for file in folder.rglob("*")
        if file.suffix in (".py", ".toml") and file.relative_to(folder).parts[0] not in _PASSIVE
    ]
    return _digest(files)


@cache
def code_version_of(module: str) -> str:
    """First 16 hexadecimal digits of the SHA-256 of a module and of all of ours that it imports.

    Directly or by way of others, at its beginning or within functions, but for imports that only
    type checkers see. A module that imports ``trainlog`` or ``analysis`` as such, and may use any
    of it, stands for all code.

    Parameters
    ----------
    module : str
        ``"analysis.resistance.fit"``.

    Examples
    --------
    >>> code_version_of("trainlog.units") != code_version_of("trainlog.spans")
    True
    """
    modules = _modules_behind(module)
    if modules is None:
        return code_version()
    return _digest(file for name in modules if (file := _file_of(name)) is not None)


def _modules_behind(module: str) -> set[str] | None:
    """A module of ours and all that it imports; None if that may be any."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        file = _file_of(name)
        if name in found or file is None:
            continue
        found.add(name)
        named = set(_imported(name))
        if named & {"trainlog", "analysis"}:
            return None
        parents = name.split(".")[:-1]
        waiting += [".".join(parents[: count + 1]) for count in range(len(parents))]
        waiting += sorted(named - found)
    return found


_TEXT_OR_COMMENT = re.compile(
    r"""(?=[#"'])(?:#[^\n]*|(?P<quotes>\"{3}|'{3})(?:[^\\]|\\.)*?(?P=quotes)"""
    r"""|"(?:[^"\\\n]|\\.)*"|'(?:[^'\\\n]|\\.)*')""",
    re.DOTALL,
)
_FOR_TYPES = re.compile(r"^if TYPE_CHECKING:[ \t]*\n(?:[ \t]+.*\n|[ \t]*\n)*", re.MULTILINE)
_IMPORT = re.compile(r"import\b(?:[ \t]*\([^)]*\)|[^\n;]*)")
_FROM = re.compile(r"(?:\bfrom\b[ \t.\w]*|(?<!\w))$")
_OURS = re.compile(r"\b(?:trainlog|analysis|estimators)\b|^from[ \t]*\.")


def _imports_in(text: str) -> list[ast.stmt]:
    """The imports in a module's text of what may be ours, at its beginning and within functions.

    Where text and comments are taken out, the word ``import`` is in such statements alone: to parse
    these takes a tenth of the time that all of the module takes.
    """
    plain = _FOR_TYPES.sub("", _TEXT_OR_COMMENT.sub("", text).replace("\\\n", " "))
    found = []
    for each in _IMPORT.finditer(plain):
        before = _FROM.search(plain[plain.rfind("\n", 0, each.start()) + 1 : each.start()])
        if before and _OURS.search(statement := before[0] + each[0]):
            found.append(statement)
    return ast.parse("\n".join(found)).body


def _imported(module: str) -> Iterator[str]:
    """The modules of ours that a module imports."""
    file = _file_of(module)
    assert file is not None
    for node in _imports_in(file.read_text("utf-8")):
        if isinstance(node, ast.Import):
            for each in node.names:
                yield from _whole(each.name)
        elif isinstance(node, ast.ImportFrom):
            package = node.module or ""
            if node.level:
                parts = [*module.split("."), *["__init__"] * (file.name == "__init__.py")]
                package = ".".join([*parts[: -node.level], *filter(None, [package])])
            for each in node.names:
                if each.name == "*":
                    yield from _whole(package)
                elif _file_of(f"{package}.{each.name}"):
                    yield from _whole(f"{package}.{each.name}")
                elif each.name in _on_first_use(package):
                    yield _on_first_use(package)[each.name][0]
            if "." in package:
                yield package


def _whole(module: str) -> Iterator[str]:
    """A module, and what it imports on first use, any of which may be used."""
    yield module
    yield from (place for place, _ in _on_first_use(module).values())


@cache
def _on_first_use(package: str) -> dict[str, tuple[str, str]]:
    """The names that `trainlog.extras.names_on_first_use` finds, without importing the package."""
    file = _file_of(package)
    text = "" if file is None or file.name != "__init__.py" else file.read_text("utf-8")
    return names_for_types(text) if "names_on_first_use" in text else {}


def _file_of(module: str) -> Path | None:
    """The file of a module of ours; None if there is none."""
    place = _SOURCE.joinpath(*module.split("."))
    for file in (place.with_suffix(".py"), place / "__init__.py"):
        if file.is_file():
            return file
    return None


def _digest(files: Iterable[Path]) -> str:
    """Of the names and contents of files of ours."""
    total = sha256()
    for file in sorted(files):
        total.update(f"{file.relative_to(_SOURCE).as_posix()}\n".encode())
        total.update(file.read_bytes())
    return total.hexdigest()[:16]
