"""Packages that only an extra installs, such as those that compute, the viewer and the solvers.

Logs are read, written, checked, shown and converted without any of them.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from trainlog.errors import MissingExtraError

EXTRAS = {
    "asammdf": "recorders",
    "bokeh": "report",
    "casadi": "plan",
    "clarabel": "plan",
    "cvxpy": "plan",
    "daqp": "plan",
    "distributed": "dask",
    "dpkt": "recorders",
    "duckdb": "fleet",
    "filterpy": "learn",
    "matplotlib": "learn",
    "mpi4py": "mpi",
    "networkx": "fleet",
    "numba": "learn",
    "paho": "mqtt",
    "piqp": "plan",
    "psycopg": "postgresql",
    "pynmeagps": "recorders",
    "pyogrio": "gis",
    "pyubx2": "recorders",
    "rerun": "replay",
    "rosbags": "recorders",
    "scipy": "learn",
    "sqlalchemy": "fleet",
    "sqlglot": "fleet",
}
"""Which extra of trainlog installs a module."""


def require(*modules: str) -> None:
    """Check that modules are installed, without importing them.

    Parameters
    ----------
    *modules : str
        Keys of `EXTRAS`.

    Raises
    ------
    MissingExtraError
        If one is not installed; the message names the command that installs it.

    Examples
    --------
    >>> require("rerun")
    """
    for module in modules:
        if find_spec(module) is None:
            raise _missing(module)


@contextmanager
def naming_missing() -> Iterator[None]:
    """A module of an extra that is missing for what is imported in here is named with its extra.

    Raises
    ------
    MissingExtraError
        In place of the ModuleNotFoundError.

    Examples
    --------
    >>> with naming_missing():  # doctest: +ELLIPSIS
    ...     raise ModuleNotFoundError("No module named 'scipy'", name="scipy.sparse")
    Traceback (most recent call last):
    trainlog.errors.MissingExtraError: this needs the package scipy, which is not installed; ...
    """
    try:
        yield
    except ModuleNotFoundError as error:
        module = str(error.name).partition(".")[0]
        if module not in EXTRAS:
            raise
        raise _missing(module) from error


def load(module: str) -> Any:
    """Import a module of an extra.

    Raises
    ------
    MissingExtraError
        If it is not installed; the message names the command that installs it.

    Examples
    --------
    >>> load("rerun").__name__
    'rerun'
    """
    with naming_missing():
        return import_module(module)


def _missing(module: str) -> MissingExtraError:
    return MissingExtraError(
        f"this needs the package {module}, which is not installed",
        remedy=f"pip install 'trainlog[{EXTRAS[module]}]'",
    )


def names_for_types(text: str) -> dict[str, tuple[str, str]]:
    r"""Module and name there of each name that a module's text defines for type checkers alone.

    Names that are assigned to another one stand for it.

    Examples
    --------
    >>> names_for_types("if TYPE_CHECKING:\n    from math import sqrt, pi as pi\n    root = sqrt")
    {'pi': ('math', 'pi'), 'root': ('math', 'sqrt')}
    """
    found: dict[str, tuple[str, str]] = {}
    for block in ast.parse(text).body:
        if not (isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"):
            continue
        for node in block.body:
            if isinstance(node, ast.ImportFrom):
                found |= {each.name: (str(node.module), each.name) for each in node.names}
            elif isinstance(node, ast.Assign):
                found[ast.unparse(node.targets[0])] = found.pop(ast.unparse(node.value))
    return found


def names_on_first_use(
    package: str, file: str
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """``__all__`` and the module functions ``__getattr__`` and ``__dir__`` of a package.

    Parameters
    ----------
    package, file : str
        Its ``__name__`` and ``__file__``; see `names_for_types`.

    Examples
    --------
    >>> import estimators
    >>> names, get, listed = names_on_first_use("estimators", estimators.__file__)
    >>> names[0], get("SlipDetector").__module__
    ('AdhesionObserver', 'estimators.adhesion')
    """
    places = names_for_types(Path(file).read_text("utf-8"))

    def get(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        module, defined = places[name]
        with naming_missing():
            return getattr(import_module(module), defined)

    names = sorted(places)
    return names, get, lambda: names
