"""The tables on the page of the studies are those that the studies print.

A number on the page may differ from the printed one by two units of its last digit, or by 0.005
per cent. Numbers with an exponent are residuals of a solver: they may differ by a factor of three,
or by 1e-5. ``--renew-golden`` puts the tables that were found into the page.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from analysis.studies.in_train_forces import crest_and_sag, run
from trainlog import read_consist, sample
from trainlog.cli.main import run as command
from trainlog.units import KMH

PAGE = Path(__file__).parents[1] / "docs" / "studies.md"
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
TABLE = re.compile(r"\*\*([^\n]+)\*\*\n\n((?:\|[^\n]*\n)+)")

STUDIES = (
    *("rls-sliding-mode", "robust-minimax", "cooperative-adhesion"),
    *("map-mpc", "map-mpc --as-published"),
)

Rows = list[list[str]]


def tables(text: str) -> dict[str, Rows]:
    """Cells of the tables, by title."""
    return {
        title: [[cell.strip() for cell in line.strip("|").split("|")] for line in body.splitlines()]
        for title, body in TABLE.findall(text)
    }


def section(name: str) -> re.Pattern[str]:
    """The part of the page that holds the tables of a command."""
    return re.compile(rf"(<!-- tables of {re.escape(name)} -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def close(one: str, other: str) -> bool:
    """Whether two printed numbers are the same to the tolerance."""
    a, b = float(one), float(other)
    if "e" in one + other:
        return abs(a - b) <= max(2.0 * min(abs(a), abs(b)), 1e-5)
    digits = min(len(each.partition(".")[2]) for each in (one, other))
    return abs(a - b) <= max(2.01 * 10.0**-digits, 5e-5 * abs(a))


def same(one: str, other: str) -> bool:
    """Whether two cells have the same words, and the same numbers to the tolerance."""
    if NUMBER.sub("#", one) != NUMBER.sub("#", other):
        return False
    return all(map(close, NUMBER.findall(one), NUMBER.findall(other)))


def chosen(title: str, listed: Rows, printed: Rows) -> Rows:
    """The printed rows that the page lists: of the same words, in the same order."""
    rest, found = iter(printed), []
    for row in listed:
        words = [NUMBER.sub("#", cell) for cell in row]
        for other in rest:
            if other[0] == row[0] and [NUMBER.sub("#", cell) for cell in other] == words:
                found.append(other)
                break
        else:
            raise AssertionError(f"{title}: no row like {row} is printed")
    return found


def renewed(page: str, name: str, found: str) -> str:
    """The page with the tables that were found: the rows that it listed, or all."""
    part = section(name).search(page)
    listed = tables(part[2])
    kept = []
    for match in TABLE.finditer(found):
        title = match[1].strip()
        if not listed:
            kept.append(match[0])
        elif title in listed:
            rows = chosen(title, listed[title], tables(match[0])[title])
            lines = ["| " + " | ".join(row) + " |" for row in rows]
            lines[1] = match[2].splitlines()[1]
            kept.append(f"**{title}**\n\n" + "\n".join(lines) + "\n")
    return page[: part.start(2)] + "\n" + "\n".join(kept) + "\n" + page[part.end(2) :]


def on_page(name: str) -> dict[str, Rows]:
    """The tables of a command that the page lists, by title."""
    part = section(name).search(PAGE.read_text(encoding="utf-8"))
    return tables(part[2])


def check(title: str, rows: Rows, now: Rows) -> None:
    """That the page's rows are among those that a study reaches now."""
    for row, other in zip(rows, chosen(title, rows, now), strict=True):
        assert len(row) == len(other), title
        for cell, reached in zip(row, other, strict=True):
            assert same(cell, reached), f"{title}: {row[0]}: {cell} on the page, {reached} now"


@pytest.mark.long
@pytest.mark.usefixtures("unpainted")
@pytest.mark.parametrize("name", STUDIES)
def test_the_page_has_the_tables_that_the_study_prints(name, tmp_path, request):
    """``--renew-golden`` puts them there."""
    assert command(["study", *name.split(), "-o", str(tmp_path)]) == 0
    found = (tmp_path / "tables.md").read_text(encoding="utf-8")
    if request.config.getoption("--renew-golden"):
        page = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(renewed(page, name, found), encoding="utf-8")
        return
    printed, listed = tables(found), on_page(name)
    assert listed
    assert listed.keys() <= printed.keys()
    for title, rows in listed.items():
        check(title, rows, printed[title])


def test_the_page_has_the_forces_of_a_sample_consist():
    consist, speed = read_consist(sample("multiple_unit_8_cars.consist.json")), 120.0
    found = run(consist, crest_and_sag(), speed=speed / KMH)
    emergency = found.forces[found.phase("emergency braking")]
    forces = (found.forces.max(), -found.forces.min(), max(-emergency.min(), 0.0))
    row = f"{speed:.0f} km/h | " + " | ".join(f"{force / 1e3:.0f} kN" for force in forces)
    assert row in PAGE.read_text(encoding="utf-8")
    assert found.residual < 1e-11
