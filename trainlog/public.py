"""Public names of a package that are imported on first use.

The readers need pandas, the optimiser a solver: ``trainlog --help`` and a script that uses one name
should not wait for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def names_on_first_use(
    package: str, modules: Mapping[str, str]
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """``__all__`` and the module functions ``__getattr__`` and ``__dir__`` of a package.

    Parameters
    ----------
    package : str
        Its name, for messages.
    modules : mapping of str to str
        By module, the names that it defines, separated by spaces; ``public=name`` for one that
        has another name there.

    Examples
    --------
    >>> names, get, listed = names_on_first_use("example", {"math": "root=sqrt pi"})
    >>> names, get("root")(9.0)
    (['pi', 'root'], 3.0)
    """
    places = {}
    for module, words in modules.items():
        for word in words.split():
            name, _, defined = word.partition("=")
            places[name] = (module, defined or name)

    def get(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        module, defined = places[name]
        return getattr(import_module(module), defined)

    names = sorted(places)
    return names, get, lambda: names
