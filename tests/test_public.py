"""The public names: what users import, and nothing deeper."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGES = ("trainlog", "analysis")
HEAVY = ("pandas", "cvxpy", "rerun", "numba")


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_name_is_there_and_documented(name: str) -> None:
    package = importlib.import_module(name)
    assert set(package.__all__) <= set(dir(package))
    assert [each for each in package.__all__ if not getattr(package, each).__doc__] == []


@pytest.mark.parametrize("name", PACKAGES)
def test_type_checkers_see_the_same_names(name: str) -> None:
    package = importlib.import_module(name)
    tree = ast.parse(Path(str(package.__file__)).read_text("utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        seen |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
    assert sorted(seen) == package.__all__
    for public, (module, defined) in seen.items():
        assert getattr(package, public) is getattr(importlib.import_module(str(module)), defined)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'trainlog' has no attribute 'raed'"):
        _ = importlib.import_module("trainlog").raed


def test_importing_the_packages_loads_neither_pandas_nor_a_solver() -> None:
    code = f"import sys, {', '.join(PACKAGES)}; print([m for m in {HEAVY} if m in sys.modules])"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_function_and_class_has_an_example(name: str) -> None:
    package = importlib.import_module(name)
    public = {each: getattr(package, each) for each in package.__all__}
    without = [each for each, it in public.items() if callable(it) and ">>> " not in it.__doc__]
    assert without == []


def test_objects_print_in_at_most_ten_lines() -> None:
    trainlog = importlib.import_module("trainlog")
    line = trainlog.read_line(trainlog.sample(trainlog.DEFAULT_LINE))
    train = trainlog.read_train(trainlog.sample(trainlog.DEFAULT_TRAIN))
    (scenario,) = trainlog.draw_scenarios(line, train, 1, seed=3)
    trip = trainlog.read(trainlog.sample("nonstop.mcap"))
    shown = (scenario, line, train, trip, line.geometry, line.gradients, line.curvatures)
    for each in shown:
        assert len(repr(each).splitlines()) <= 10
        assert len(repr(each)) < 800, type(each)
    assert repr(line.gradients) == "StepProfile of 153 steps, -0.0154 to 0.0159"
