"""Code, messages and documentation speak in the field's terms, without metaphors."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[1]

AVOIDED = {
    r"told|tells|tell": "a program states, reports or lists",
    r"rooms?|doors?|house": "a package is a package, an entry point an entry point",
    r"makes? no sense": "a value must be positive, finite, ...",
    r"papers? 00\d": "a paper is cited by author and year",
}

MEANT = (
    *("stream.tell", "doors and passengers", "doors, left", "door {i}", "door 0", "/train/doors"),
    *("The doors.", "doors are released", "doors released", 'Panel("doors"', '"Doors"'),
    "brake pressures, doors",
)
"""Where such a word is the right one: a position in a file, the doors of a train."""


@cache
def files() -> dict[Path, str]:
    """Texts by path."""
    folders = "trainlog", "analysis", "estimators", "benchmarks", "docs", "sample_logs", "tests"
    patterns = "*.md", "docs/**/*.md", *(f"{folder}/**/*.py" for folder in folders)
    found = [path for pattern in patterns for path in CHECKOUT.glob(pattern)]
    kept = sorted(path for path in found if path.name != Path(__file__).name)
    return {path: path.read_text("utf-8") for path in kept}


@pytest.mark.parametrize("words", AVOIDED)
def test_no_private_words(words):
    assert len(files()) > 300
    pattern = re.compile(rf"\b(?:{words})\b", re.IGNORECASE)
    lines = [
        f"{path.relative_to(CHECKOUT)}:{number}: {line.strip()}"
        for path, text in files().items()
        if pattern.search(text)
        for number, line in enumerate(text.splitlines(), 1)
        if pattern.search(line) and not any(each in line for each in MEANT)
    ]
    assert not lines, f"{AVOIDED[words]}:\n" + "\n".join(lines)
