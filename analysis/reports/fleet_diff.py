"""The report on what changed between two versions over a fleet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from analysis.charts import BLUE, GREY, INK, RED, dress, legend, new_figure, write_figure
from analysis.fleet.diff import FleetDiff
from analysis.fleet.diff_judgement import REACH
from analysis.fleet.diff_table import (
    JUDGED,
    counts_table,
    estimates_table,
    means_table,
    moved_table,
    places_table,
    sentence,
    verdicts_table,
    words_table,
)
from analysis.reports.page import Page, Part, Section, Warned
from analysis.reports.pictures import Picture, drawn
from trainlog.formats.files import made_folder, write_bytes

PAGE, TABLES = "diff.html", ("moved", "means", "estimates", "verdicts", "places", "words")
"""What `write_diff` writes into a folder: the page, and these tables as CSV."""

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
        write_bytes(path, frame.to_csv(index=False).encode())
        written.append(path)
    diff_page(found).write(target / PAGE)
    return [target / PAGE, *written]


def diff_page(found: FleetDiff) -> Page:
    """The page of a difference."""
    said = f"Of {found.second} against {found.first}: {sentence(found)}."
    first: list[Part] = [Warned(said) if found.beyond else said, counts_table(found)]
    sections = [Section("What changed", first)]
    if len(found.means) and found.means["systematic"].any():
        sections.append(Section("Means over trips", [_shifts(found), means_table(found, 60)]))
    if len(found.verdicts):
        sections.append(Section("Given by one side alone", [verdicts_table(found, 200)]))
    if len(found.places):
        sections.append(Section("Track-condition map", [places_table(found, 100)]))
    if len(found.moved):
        sections.append(Section("Single trips", [moved_table(found, 100)]))
    sections.append(Section("Every estimate", [estimates_table(found, changed=False)]))
    if len(found.words):
        sections.append(Section("Texts", [words_table(found, 100)]))
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


def _shifts(found: FleetDiff) -> Picture:
    """Shifts of means in units of their bands."""
    rows = found.means[found.means["systematic"] & np.isfinite(found.means["bands"])]
    rows = rows.head(MOST_DRAWN).iloc[::-1]

    def draw(path: Path) -> None:
        figure = new_figure(9.0, 0.9 + 0.24 * len(rows))
        axes = dress(figure.subplots(), x="shift over the half width of the band", y="")
        labels = [
            f"{row.estimate}, {'all trips' if row.of == 'all trips' else row.name}"
            for row in rows.itertuples(index=False)
        ]
        sign = np.sign(rows["shift"].to_numpy(np.float64))
        value = sign * rows["bands"].to_numpy(np.float64)
        std = rows["shift_std"].to_numpy(np.float64) / (
            REACH * rows["value_std"].to_numpy(np.float64)
        )
        at = np.arange(len(rows))
        axes.axvspan(-1.0, 1.0, color=GREY, alpha=0.18, linewidth=0.0, label="within the band")
        axes.axvline(0.0, color=INK, linewidth=0.8)
        for beyond, colour, words in ((True, RED, "beyond"), (False, BLUE, "within")):
            chosen = rows["beyond"].to_numpy(bool) == beyond
            if chosen.any():
                axes.errorbar(
                    value[chosen], at[chosen], xerr=REACH * std[chosen], fmt="o", markersize=4.0,
                    color=colour, elinewidth=1.0, label=f"systematic, {words}",
                )  # fmt: skip
        axes.set_yticks(at, labels)
        largest = float(np.max(np.abs(value), initial=1.0))
        if largest > 20.0:
            axes.set_xscale("symlog", linthresh=1.0)
        legend(axes, "lower right")
        write_figure(figure, path)

    return drawn(
        draw,
        "Shifts of the means of estimates between the two sides, in half widths of their bands.",
        "Bars: 95 % band of the shift on the same trips.",
    )
