"""The page on the papers names code that is there, and why a result differs."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

STUDIES = {
    "H": "analysis.studies.hauck_2023",
    "A": "analysis.studies.amirhosseini_2024",
    "C": "analysis.studies.cunillera_2022",
    "Z": "analysis.studies.zhao_2025",
}
RESULTS = ("as printed", "corrected", "reached", "differs", "not run")


def is_there(path: str) -> bool:
    """Whether a dotted path names something; its first letter may abbreviate a study."""
    first, _, rest = path.partition(".")
    parts = f"{STUDIES.get(first, first)}.{rest}".split(".")
    for split in range(len(parts), 0, -1):
        try:
            found: object = import_module(".".join(parts[:split]))
        except ModuleNotFoundError:
            continue
        for part in parts[split:]:
            found = getattr(found, part, None)
        return found is not None
    return False


def test_every_part_of_a_paper_names_code_that_is_there_and_a_result() -> None:
    text = (Path(__file__).parents[1] / "docs" / "papers.md").read_text("utf-8")
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| ")]
    parts = [[cell.strip() for cell in row] for row in rows if len(row) == 4 and "`" in row[1]]
    assert len(parts) > 60
    for part, where, result, why in parts:
        assert is_there(where.strip("`")), part
        assert result in RESULTS, part
        assert why or result in ("as printed", "reached"), part
