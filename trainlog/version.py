"""The version of trainlog, for whatever writes down what made it."""

from __future__ import annotations

from functools import cache
from hashlib import sha256
from pathlib import Path

__version__ = "0.1.0"

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
    package = Path(__file__).parent
    files = [
        file
        for folder in (package, package.with_name("analysis"), package.with_name("estimators"))
        for file in folder.rglob("*")
        if file.suffix in (".py", ".toml") and file.relative_to(folder).parts[0] not in _PASSIVE
    ]
    total = sha256()
    for file in sorted(files):
        total.update(f"{file.relative_to(package.parent).as_posix()}\n".encode())
        total.update(file.read_bytes())
    return total.hexdigest()[:16]
