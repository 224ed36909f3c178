"""Errors cross processes: what a worker raises is what its caller meets."""

from __future__ import annotations

import ast
import copy
import importlib
import inspect
import pickle
import re
from pathlib import Path
from typing import Any

import analysis
from trainlog.errors import TrainlogError

CHECKOUT = Path(__file__).parents[1]
GIVEN: dict[str, Any] = {
    "problem": "is wrong",
    "file": "a.mcap",
    "place": "byte 3",
    "remedy": "mend it",
    "reason": "too short",
    "refused": {"run": analysis.TripRefusedError("too short", "only 90 s", place="km 1.0")},
}


def kinds() -> list[type[TrainlogError]]:
    """Every error of the three packages."""
    for package in ("trainlog", "analysis", "estimators"):
        for path in (CHECKOUT / package).rglob("*.py"):
            if re.search(r"^class \w+Error\(", path.read_text("utf-8"), re.MULTILINE):
                module = path.relative_to(CHECKOUT).with_suffix("").parts
                importlib.import_module(".".join(module))
    waiting, seen = [TrainlogError], []
    while waiting:
        kind = waiting.pop()
        seen.append(kind)
        waiting += kind.__subclasses__()
    return seen


def an_error(kind: type[TrainlogError]) -> TrainlogError:
    """Of a kind, with all that its constructor takes."""
    arguments = []
    named = {}
    for name, parameter in inspect.signature(kind).parameters.items():
        if parameter.kind is parameter.KEYWORD_ONLY:
            if name in GIVEN:
                named[name] = GIVEN[name]
        else:
            arguments.append(GIVEN.get(name, name))
    return kind(*arguments, **named)


def test_every_error_survives_pickling_and_copying():
    found = kinds()
    assert len(found) >= 11
    for kind in found:
        error = an_error(kind)
        for again in (pickle.loads(pickle.dumps(error)), copy.copy(error)):
            assert type(again) is kind
            assert str(again) == str(error)
            assert list(vars(again)) == list(vars(error))
            assert again.place == error.place
            assert again.remedy == error.remedy


def test_a_message_is_one_line_whatever_it_names():
    error = TrainlogError("trip 'a\nb' has no speed", file="c\r\nd.mcap", remedy="record it")
    assert str(error) == "c d.mcap: trip 'a b' has no speed; record it"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def without_remedy() -> list[str]:
    """Places where the product raises an `InputError` that states no remedy."""
    return [
        f"{path.relative_to(CHECKOUT)}:{node.lineno}"
        for package in ("trainlog", "analysis")
        for path in sorted((CHECKOUT / package).rglob("*.py"))
        if re.search(r"\b(Input|Log)Error\(", text := path.read_text("utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in ("InputError", "LogError")
        and not any(each.arg in ("remedy", None) for each in node.keywords)
    ]


def test_input_errors_state_a_remedy():
    """Those of a form state in the problem what a value must be; those of studies are few."""
    found = without_remedy()
    forms = [each for each in found if "/studies/" not in each]
    assert len(forms) <= 7, forms
    assert len(found) <= 18
