"""Public names of a package that are imported on first use.

The readers need pandas, the optimiser a solver: ``trainlog --help`` and a script that uses one name
should not wait for all of them. A package imports its public names under ``if TYPE_CHECKING:``, as
type checkers read it, and gives them out when they are asked for.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from trainlog.extras import naming_missing


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
    ('AdhesionObserver', 'estimators.slip')
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
