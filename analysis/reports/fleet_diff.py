"""The report on what changed between two versions over a fleet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from analysis.charts import BLUE, GREY, RED, Chart, Curve, Panel, Rule, Span
from analysis.fleet.diff import JUDGED, FleetDiff
from analysis.reports.page import Page, Part, Section, Warned
from trainlog.formats.files import csv_bytes, made_folder, write_bytes

PAGE, TABLES = "diff.html", ("moved", "means", "estimates", "verdicts", "places", "words")
"""What `write_diff` writes into a folder: the page, and these tables as CSV."""

SECTIONS = {
    "verdicts": "Given by one side alone",
    "places": "Track-condition map",
    "moved": "Single trips",
    "estimates": "Every estimate",
    "words": "Texts",
}
"""Of the page, by the table that each shows."""

MOST_DRAWN = 24
"""Means of one picture."""


def write_diff(found: FleetDiff, folder: str | Path) -> list[Path]:
    """Write the report and all tables of a difference into a folder; the files.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    target = made_folder(Path(folder))
    written = []
    for name in TABLES:
        frame: pd.DataFrame = getattr(found, name)
        path = target / f"{name}.csv"
        write_bytes(path, csv_bytes(frame))
        written.append(path)
    diff_page(found).write(target / PAGE)
    return [target / PAGE, *written]


def diff_page(found: FleetDiff) -> Page:
    """The page of a difference."""
    said = f"Of {found.second} against {found.first}: {found.sentence}"
    tables = {each.name: each for each in found.tables(100, changed=False)}
    first: list[Part] = [Warned(said) if found.beyond else said, tables["analyses"]]
    sections = [Section("What changed", first)]
    if len(found.systematic):
        sections.append(Section("Means over trips", [_shifts(found), tables["means"]]))
    for name, title in SECTIONS.items():
        if tables[name].rows or name == "estimates":
            sections.append(Section(title, [tables[name]]))
    sections.append(Section("How differences are judged", list(_JUDGED)))
    return Page(f"Fleet: {found.second} against {found.first}", "", sections)


_JUDGED = (
    "Both sides saw the same trips with the same noise: where nothing changed an estimate is the"
    " same to the bit. A difference is within rounding up to a millionth of the value or a"
    " thousandth of its standard deviation; beyond the band where it exceeds 1.96 of the smaller of"
    " the two standard deviations.",
    JUDGED,
    "Means are weighted by the precision of each trip. The shift has the standard error that its"
    " own scatter over the trips gives, in which the noise that both sides share is not contained;"
    " it is systematic at a false discovery rate of 5 per cent among all means (Benjamini and"
    " Hochberg, 1995), and beyond the band where it exceeds that of the first side's mean.",
)


def _shifts(found: FleetDiff) -> Chart:
    """Shifts of means in units of their bands."""
    rows = found.systematic[np.isfinite(found.systematic["bands"])].head(MOST_DRAWN)
    names = [
        f"{row.estimate}, {'all trips' if row.of == 'all trips' else row.name}"
        for row in rows.itertuples(index=False)
    ]
    value = np.sign(rows["shift"].to_numpy(np.float64)) * rows["bands"].to_numpy(np.float64)
    reach = rows["shift_std"].to_numpy(np.float64) / rows["value_std"].to_numpy(np.float64)
    points, at = list[Curve](), np.arange(len(rows))
    for beyond, colour, words in ((True, RED, "beyond"), (False, BLUE, "within")):
        chosen = rows["beyond"].to_numpy(bool) == beyond
        if chosen.any():
            points.append(
                Curve(f"systematic, {words}", value[chosen], at[chosen], colour, "points",
                      (value - reach)[chosen], (value + reach)[chosen],
                      {"": [names[row] for row in at[chosen]]}, 2.0, across=True)
            )  # fmt: skip
    largest = 1.1 * float(np.max(np.abs(value) + reach, initial=1.0))
    panel = Panel(
        "", points, 0.3 + 0.1 * len(rows), rows=names, rules=[Rule(0.0, upright=True)],
        spans=[Span(-1.0, 1.0, GREY, "within the band", 0.18)],
    )  # fmt: skip
    return Chart(
        "shift over the half width of the band",
        [panel],
        caption="Bars: 95 % band of the shift on the same trips.",
        span=(-largest, largest),
    )
