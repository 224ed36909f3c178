"""Packages that only an extra installs, such as the viewer and the solvers.

Reading and writing logs, identification and maps need none of them.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
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
    "mpi4py": "mpi",
    "networkx": "fleet",
    "piqp": "plan",
    "psycopg": "postgresql",
    "pynmeagps": "recorders",
    "pyogrio": "gis",
    "pyubx2": "recorders",
    "rerun": "replay",
    "rosbags": "recorders",
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
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise _missing(module) from error


def _missing(module: str) -> MissingExtraError:
    return MissingExtraError(
        f"this needs the package {module}, which is not installed",
        remedy=f"pip install 'trainlog[{EXTRAS[module]}]'",
    )
