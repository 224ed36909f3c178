"""The version of trainlog, for whatever writes down what made it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path

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
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        file = _file_of(name)
        if name in found or file is None:
            continue
        found.add(name)
        text = _FOR_TYPES.sub("", file.read_text("utf-8"))
        named = set(_imported(text))
        if named & {"trainlog", "analysis"}:
            return code_version()
        parents = name.split(".")[:-1]
        waiting += [".".join(parents[: count + 1]) for count in range(len(parents))]
        waiting += sorted(named - found)
    return _digest(file for name in found if (file := _file_of(name)) is not None)


_FOR_TYPES = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+.*\n|\n)*", re.MULTILINE)
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+((?:trainlog|analysis|estimators)[\w.]*)[ \t]+import[ \t]+"
    r"(\([^)]*\)|[^\n#]*)|import[ \t]+((?:trainlog|analysis|estimators)[\w.]*)[ \t]*(?:as|$))",
    re.MULTILINE,
)


def _imported(text: str) -> Iterator[str]:
    """The modules of ours that a module's text imports."""
    for package, names, whole in _IMPORT.findall(text):
        if whole:
            yield whole
            continue
        for part in names.strip("()").split(","):
            name = part.split("#")[0].split(" as ")[0].strip()
            if name and _file_of(f"{package}.{name}"):
                yield f"{package}.{name}"
            elif name:
                yield from _defining(package, name)
        if "." in package:
            yield package


def _defining(package: str, name: str) -> Iterator[str]:
    """The module that defines a public name of a package that is imported on first use."""
    for module, words in _on_first_use(package).items():
        if name in (word.partition("=")[0] for word in words.split()):
            yield module


@cache
def _on_first_use(package: str) -> dict[str, str]:
    """What a package passes to `trainlog.public.names_on_first_use`, read without importing it."""
    file = _file_of(package)
    text = "" if file is None or file.name != "__init__.py" else file.read_text("utf-8")
    if "names_on_first_use" not in text:
        return {}
    tree = ast.parse(text)
    named = {
        target.id: node.value
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    found: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "names_on_first_use":
            given = node.args[1]
            found |= ast.literal_eval(named[given.id] if isinstance(given, ast.Name) else given)
    return found


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
