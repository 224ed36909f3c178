"""The driver's advice for a journey as a page to print."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from analysis.charts import BLUE, Chart, Curve, Panel, limit_curve, worded
from analysis.reports.page import Page, Part, Section, Warned
from analysis.reports.results import line_of_trajectory
from analysis.trajectory.advice import (
    OPENING,
    JourneyAdvice,
    driver_table,
    journey_advice,
    stations_table,
    write_journey_advice,
)
from trainlog import __version__
from trainlog.errors import InputError
from trainlog.formats.railway import read_trajectory
from trainlog.railway import Line
from trainlog.railway.line import in_km
from trainlog.units import KMH, clock


def write_driver_advice(
    files: Sequence[Path],
    page: str | Path,
    table: str | Path,
    *,
    line: Path | None = None,
    start: float | None = None,
    dwell: float = 0.0,
) -> JourneyAdvice:
    """Write the advice for a journey as an HTML page and as CSV.

    Parameters
    ----------
    files : sequence of path
        Trajectory files of its sections.
    page, table : path
        The HTML and the CSV file, each written whole or not at all.
    line : path, optional
        Line file; default: the line that they were planned on.
    start : float [s], optional
        Time of day of the first departure.
    dwell : float [s]
        Standing time at the stops, of sections that do not know when they depart.

    Raises
    ------
    InputError
        If a file is no trajectory, they are not sections of one journey, or where the table goes
        there is another one.
    """
    _check_table(Path(table))
    sections = [read_trajectory(path) for path in files]
    last = max(sections, key=lambda each: float(each.positions[-1]))
    course = line_of_trajectory(last, line)
    found = journey_advice(sections, course, start=start, dwell=dwell)
    whole = Page(_title(found), _subtitle(found), _parts(found, course, files))
    whole.write(page)
    write_journey_advice(found, table)
    return found


def _check_table(table: Path) -> None:
    """Refuse to overwrite a table that is no advice."""
    if not table.exists():
        return
    with table.open("rb") as file:
        begins = file.readline(1000).decode("utf-8", "replace").strip()
    if not begins.startswith(OPENING):
        raise InputError(
            "exists, and is not a table of advice",
            file=table,
            remedy="give the page another name: the table takes it",
        )


def _title(found: JourneyAdvice) -> str:
    ends = [found.rows[0], found.rows[-1]]
    names = [each.station or f"km {each.km:.3f}" for each in ends]
    return f"Driver's advice: {names[0]} to {names[1]}"


def _subtitle(found: JourneyAdvice) -> str:
    first, last = found.rows[0], found.rows[-1]
    lasts = clock((last.timetable or last.time) - first.time)
    times = f"departs {found.time(first.time)}, arrives {found.time(last.timetable)}, {lasts}"
    since = "" if found.start is not None else "; times count from the departure"
    return f"{found.train} on {found.line}: {times}{since}"


def _parts(found: JourneyAdvice, line: Line | None, files: Sequence[Path]) -> list[Section]:
    doubts: list[Part] = []
    if line is None:
        words = f"The plans do not hold line '{found.line}': give it, for limits and stations."
        doubts = [Warned(words)]
    counts = {len(each.configurations) for each in found.sections}
    if counts == {1}:
        words = "Planned for one configuration of the train: a trip that differs may be late."
    else:
        words = (
            f"Times and speeds are those of the configuration that arrives last, of {max(counts)}"
            " observed ones; the others arrive earlier on the same advice."
        )
    return [
        Section("Stations", [*doubts, stations_table(found)]),
        Section("Advice", [driver_table(found), " ".join([words, *found.sentences()])]),
        Section("Speed", [_chart(found, line)]),
        Section(
            "Made of",
            [
                "Plans: " + ", ".join(path.name for path in files) + ". The permitted speed holds"
                " everywhere, whatever the advice; the plan keeps it"
                f" {found.sections[0].limits_kept}. The report of a plan (trainlog report) states"
                " what it was made of.",
                f"This page: {_command(found, files)}; trainlog {__version__}.",
            ],
        ),
    ]


def _command(found: JourneyAdvice, files: Sequence[Path]) -> str:
    names = " ".join(shlex.quote(path.name) for path in files)
    start = "" if found.start is None else f" --departure {found.time(0.0)}"
    return f"trainlog advice {names}{start} -o advice.html"


def _chart(found: JourneyAdvice, line: Line | None) -> Chart:
    curves = []
    for section, departure in zip(found.sections, found.departures.tolist(), strict=True):
        row = section.latest
        km, speed = section.positions / 1e3, KMH * section.speeds[row]
        hover = {
            "km": worded("{:.3f}", in_km(line, section.positions)),
            "time": [found.time(departure + each) for each in section.times[row].tolist()],
            "speed": worded("{:.0f} km/h", speed),
        }
        curves.append(Curve("planned speed", km, speed, BLUE, hover=hover))
    ends = np.array([found.rows[0].position, found.rows[-1].position])
    limits = [] if line is None else [limit_curve(line, float(ends[0]), float(ends[1]))]
    return Chart(
        "km in the direction of travel",
        [Panel("km/h", [*limits, *curves], 1.2, from_zero=True)],
        line=line,
    )
