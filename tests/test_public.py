"""The public names: what users import, and nothing deeper."""

from __future__ import annotations

import builtins
import doctest
import importlib
import inspect
import subprocess
import symtable
import sys
from typing import Any

import pytest

PACKAGES = ("trainlog", "analysis")
HEAVY = ("pandas", "cvxpy", "rerun", "numba")


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_name_is_there_documented_and_has_an_example(name):
    package = importlib.import_module(name)
    assert set(package.__all__) <= set(dir(package))
    public = {each: getattr(package, each) for each in package.__all__}
    assert [each for each, it in public.items() if not it.__doc__] == []
    assert [each for each, it in public.items() if callable(it) and ">>> " not in it.__doc__] == []


def test_importing_the_packages_loads_neither_pandas_nor_a_solver():
    code = f"import sys, {', '.join(PACKAGES)}; print([m for m in {HEAVY} if m in sys.modules])"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"


def public_examples() -> list[Any]:
    """Name and docstring of every public name, and of its public methods."""
    found = []
    for package in (*PACKAGES, "estimators"):
        for name in importlib.import_module(package).__all__:
            each = getattr(importlib.import_module(package), name)
            found.append((f"{package}.{name}", each.__doc__ or ""))
            if isinstance(each, type):
                methods = {key: it for key, it in vars(each).items() if not key.startswith("_")}
                docs = {
                    key: it.__doc__ or "" for key, it in methods.items() if hasattr(it, "__doc__")
                }
                found += [(f"{package}.{name}.{key}", text) for key, text in docs.items()]
    return [(name, text) for name, text in found if ">>> " in text]


def test_examples_use_only_public_names_and_what_they_import():
    """What a reader of the reference can type: no names of the module that defines it."""
    examples = public_examples()
    assert len(examples) > 100
    wrong = {}
    for name, text in examples:
        parts = doctest.DocTestParser().get_examples(inspect.cleandoc(text))
        code = symtable.symtable("".join(each.source for each in parts), name, "exec")
        known = {*vars(builtins), *importlib.import_module(name.split(".")[0]).__all__}
        used = {
            symbol.get_name()
            for table in (code, *code.get_children())
            for symbol in table.get_symbols()
            if symbol.is_referenced() and symbol.is_global()
        }
        bound = {each.get_name() for each in code.get_symbols() if each.is_assigned()}
        bound |= {each.get_name() for each in code.get_symbols() if each.is_imported()}
        unknown = used - known - bound
        if unknown:
            wrong[name] = unknown
    assert wrong == {}
