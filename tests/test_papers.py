"""The page on the papers accounts for every equation, figure and table, and names real code."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDIES = {
    "H": "analysis.studies.hauck_2023",
    "A": "analysis.studies.amirhosseini_2024",
    "C": "analysis.studies.cunillera_2022",
    "Z": "analysis.studies.zhao_2025",
}
NUMBERED = {
    "Hauck et al. (2023)": {"eq.": 11, "figure": 7, "table": 1},
    "Amirhosseini et al. (2024)": {"eq.": 36, "figure": 14, "table": 1},
    "Cunillera et al. (2022)": {"eq.": 10, "figure": 0, "table": 0},
    "Zhao et al. (2025)": {"eq.": 22, "figure": 6, "table": 2},
}
"""How many of each a paper has; its tables in Roman numbers count as well."""

RESULTS = ("as printed", "corrected", "reached", "differs", "not run")


def rows(paper: str) -> list[list[str]]:
    """Cells of a paper's table."""
    text = (DOCS / "papers.md").read_text("utf-8")
    section = text.partition(f"## {paper}\n")[2].partition("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def numbered(entry: str) -> list[tuple[str, int]]:
    """What an entry stands for: ``eqs. (2)-(4)`` for three equations."""
    found = re.fullmatch(r"(eq|figure|table)s?\.? \(?(\d+|I)\)?(?:-\(?(\d+)\)?)?", entry)
    if found is None:
        return []
    kind = "eq." if found[1] == "eq" else found[1]
    first = 1 if found[2] == "I" else int(found[2])
    return [(kind, number) for number in range(first, int(found[3] or first) + 1)]


def named(path: str) -> Any:
    """What a dotted path names; its first letter may abbreviate a study."""
    first, _, rest = path.partition(".")
    parts = f"{STUDIES.get(first, first)}.{rest}".split(".")
    for split in range(len(parts), 0, -1):
        try:
            found = import_module(".".join(parts[:split]))
        except ModuleNotFoundError:
            continue
        for part in parts[split:]:
            found = getattr(found, part)
        return found
    raise AttributeError(path)


@pytest.mark.parametrize("paper", NUMBERED)
def test_every_numbered_part_of_a_paper_is_listed_once(paper: str) -> None:
    listed = [part for row in rows(paper) for part in numbered(row[0])]
    expected = [
        (kind, number) for kind, count in NUMBERED[paper].items() for number in range(1, count + 1)
    ]
    assert sorted(listed) == sorted(expected)
    others = [row[0] for row in rows(paper) if not numbered(row[0])]
    assert all(other.startswith("statement: ") for other in others)
    assert len(others) == len(set(others)) >= 2


@pytest.mark.parametrize("paper", NUMBERED)
def test_every_part_names_code_that_is_there_and_a_result(paper: str) -> None:
    for part, where, result, what in rows(paper):
        named(where.strip("`"))
        assert result in RESULTS, part
        # What is corrected, differs or is not run says why.
        assert what or result in ("as printed", "reached"), part
