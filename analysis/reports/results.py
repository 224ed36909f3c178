"""Sections on results: a fit, a map, a trajectory, a coast-down, a study; the driver's advice."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from analysis.adhesion.condition_table import bins_table
from analysis.adhesion.map_difference import map_history
from analysis.adhesion.map_state import line_of_map, map_state, summary
from analysis.charts import BLUE, Chart, Curve, Panel, limit_curve, worded
from analysis.reports.answers import map_words, summary_section
from analysis.reports.page import Page, Part, Picture, Section, Warned
from analysis.resistance.curve import STATED_AT, curve_std
from analysis.resistance.logs import Fits, fit
from analysis.resistance.plot import residual_charts
from analysis.trajectory.advice import (
    OPENING,
    JourneyAdvice,
    driver_table,
    journey_advice,
    stations_table,
    write_journey_advice,
)
from analysis.trajectory.table import trajectory_table
from analysis.verification.scoring import score_rolling
from trainlog import __version__
from trainlog.display import at_most, counted, few, lateness
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.mapfile import read_map
from trainlog.formats.railway import (
    line_of_plan,
    read_coast_down,
    read_line,
    read_parameters,
    read_trajectory,
)
from trainlog.formats.summaries import SUFFIX, covariances_of
from trainlog.presentation import (
    FORCE,
    MASS,
    POWER,
    Band,
    Column,
    facts_table,
    kwh,
    new_table,
    overspeed,
)
from trainlog.progress import note
from trainlog.railway import Line, ParameterSet, RunningResistance, TrackConditionMap, Trajectory
from trainlog.railway.line import in_km
from trainlog.railway.resistance import TERMS
from trainlog.units import KMH, clock

MOST_ROWS = 60
"""Trips that the table of a fit lists one by one."""

HISTORY_DAYS = 6
"""Days for which the history of the lowest place makes the estimate anew."""

TABLES = "tables.md"
"""In the folder of a study: all its tables, as `analysis.studies.report` writes them."""

MOST_PICTURES = 2_400_000
"""Bytes of the pictures of a study that a page takes; the others are named."""


# ------------------------------------------------------------------------------------- a fit


def fit_sections(path: Path, logs: Sequence[Path] = ()) -> list[Section]:
    """What a report shows of an observed parameter set.

    Parameters
    ----------
    path : path
        Parameters file; the summaries that ``trainlog fit`` wrote beside it are used, too.
    logs : sequence of path
        Logs that it was fitted to: with them the residuals are shown.
    """
    found = read_parameters(path)
    kept = path.with_suffix(SUFFIX)
    name, files = ("the logs", list(logs)) if logs else (kept.name, [kept] * kept.exists())
    fits = _fitted_again(found, files) if files else None
    if not isinstance(fits, Fits):
        doubt: Part = (
            f"{kept.name} is not beside it and no logs are given: what each trip showed, and which"
            " were refused, is not known here."
            if fits is None
            else Warned(fits.format(name, path.name))
        )
        shown = found if found.configurations else "The set is empty."
        return [Section("Running resistance", [shown, doubt])]
    rows = fits.drives.to_dict("records")
    each = new_table("Each trip", *DRIVE_COLUMNS).add_rows(rows, MOST_ROWS)
    residuals: list[Part] = [*residual_charts(fits.trips)]
    residuals = residuals or ["Residuals are shown where the logs are given."]
    return [
        _fit_summary(fits, path),
        Section("Running resistance", [fits]),
        Section("Trips of the fit", [each, *residuals], folded=True),
        Section("Observed set", found.shown(), folded=True),
    ]


def _fit_summary(fits: Fits, path: Path) -> Section:
    """The first page of a fit."""
    common = fits.common
    low, high = (each.item() / 1e3 for each in common.band(np.array([STATED_AT])))
    drag = float(common.resistance(STATED_AT)) / 1e3
    refused = fits.drives[fits.drives["refused"] != ""]
    reasons = [f"{name}: {count}" for name, count in refused["refused"].value_counts().items()]
    used = f"{len(common.trips)} of {counted(len(fits.drives), 'trip')} determine the curve"
    said = f"; refused: {', '.join(reasons)}" if reasons else ""
    return summary_section(
        f"{counted(len(fits.drives), 'trip')} of {common.train}",
        used + said,
        "",
        f"running resistance at 80 km/h: {drag:.2f} kN (95 %: {low:.2f} to {high:.2f}), which is"
        f" {drag / 3.6:.2f} kWh per km at the wheel rims",
        [
            f"plan with the observed set: trainlog plan {shlex.quote(path.name)} --line LINE"
            " --train TRAIN -o trajectory.json"
        ],
    )


def _fitted_again(found: ParameterSet, files: Sequence[Path]) -> Fits | str:
    """The fit of logs or summaries that makes a set; or why it does not, as a form of two names."""
    cover, most = found.cover.get("asked"), found.cover.get("most")
    try:
        fits = fit(files, most=most, **({} if cover is None else {"cover": cover}))
    except TrainlogError as error:
        words = str(error).replace("{", "{{").replace("}", "}}")
        return f"Of {{0}}, {{1}} could not be made again: {words}."
    if not _same(fits.parameters, found):
        return "A fit of {0} gives another set than {1} holds; what follows of it is left out."
    return fits


def _same(one: ParameterSet, other: ParameterSet) -> bool:
    """Whether two sets hold the same configurations, to the digits that a file keeps."""
    pairs = list(zip(one.configurations, other.configurations, strict=False))
    return len(one.configurations) == len(other.configurations) and all(
        mine.name == its.name
        and np.isclose(mine.mass, its.mass, rtol=1e-6)
        and np.isclose(float(mine.resistance(20.0)), float(its.resistance(20.0)), rtol=1e-6)
        for mine, its in pairs
    )


def _drag(row: Mapping[str, Any]) -> Band:
    """The running resistance of a trip at 80 km/h; a refused trip may have none."""
    if not np.isfinite([row[name] for name in TERMS]).all():
        return Band(np.nan, np.nan)
    covariance = covariances_of(pd.DataFrame([row]))[0, :-1, :-1]
    drag = RunningResistance.of(row[name] for name in TERMS)
    return Band(float(drag(STATED_AT)), float(curve_std(covariance, STATED_AT)))


DRIVE_COLUMNS = (
    Column("trip"),
    Column("accepted", of=lambda row: "no" if row["refused"] else "yes"),
    Column("mass", MASS, band=True, each=True,
           of=lambda row: Band(row["mass"], row["covariance_mass_mass"] ** 0.5)),
    Column("power", POWER, band=True,
           of=lambda row: Band(row["max_power"], row["max_power_std"])),
    Column("at 80 km/h", FORCE, band=True, of=_drag),
    Column("reason", of=lambda row: row["message"] or row["refused"]),
)  # fmt: skip
"""Of a row of the summaries of a fit."""


# ------------------------------------------------------------------------------------- a map


def map_sections(path: Path, line: Path | None = None) -> list[Section]:
    """What a report shows of a track-condition map.

    Parameters
    ----------
    path : path
        Map file.
    line : path, optional
        Line file, or a log that carries it.
    """
    track = read_map(path)
    course = line_of_map(track, line, path)
    if not track.layers:
        return [Section("Track condition", ["The map has no layer yet: no trip counts in it."])]
    state = map_state(track, None, line=course)
    sections = [
        summary_section(
            f"line {track.line}, {track.length / 1e3:.1f} km: {counted(len(track.trips), 'trip')}",
            [
                f"{each.layer}, {few(trips, 1)}: {said}"
                for each in summary(track)
                for said, trips in each.notes.items()
            ]
            or "no recorder lacked what slip is measured by",
            map_words(bins_table(track, course)),
            "",
            [
                f"plan with it: trainlog plan --map {shlex.quote(path.name)} --set risk=0.05"
                " --line LINE --train TRAIN -o trajectory.json",
                "count in more trips where nothing was observed: trainlog map update LOGS --map"
                f" {shlex.quote(path.name)}",
            ],
        ),
        Section("Track condition", track.charts(line=course)),
        Section("Places, spots and changes", state.shown(), folded=True),
    ]
    note(f"{path.name}: history of the lowest places")
    parts: list[Part] = []
    for name in track.layers:
        lowest = state.lowest[state.lowest["layer"] == name]
        if lowest.empty:
            continue
        row = lowest.nsmallest(1, "expected").iloc[0]
        middle = 0.5 * (float(row["start_m"]) + float(row["end_m"]))
        found = map_history(track, middle, name, line=course, days=HISTORY_DAYS)
        if len(found.known) > 1:
            parts += found.charts()
        parts += found.shown()
    sections.append(
        Section("History of the lowest places", parts or ["No place was observed."], folded=True)
    )
    note(f"{path.name}: verification")
    sections.append(Section("Verification", _verified(track), folded=True))
    return sections


def _verified(track: TrackConditionMap) -> list[Part]:
    """How good the forecasts of each day from the days before alone were."""
    try:
        found = score_rolling(track)
    except InputError as error:
        return [f"Not scored: {error}."]
    return [found]


# ------------------------------------------------------------------------------ a trajectory


def trajectory_sections(path: Path, line: Path | None = None) -> list[Section]:
    """What a report shows of a trajectory.

    Parameters
    ----------
    path : path
        Trajectory file.
    line : path, optional
        Line file; default: the line that the trajectory was planned on.
    """
    trajectory = read_trajectory(path)
    course = line_of_trajectory(trajectory, line)
    parts: list[Part] = [*trajectory.charts(line=course)]
    sections = [Section("Trajectory", parts)]
    if course is None:
        parts.append(
            Warned(f"The file does not hold line '{trajectory.line}': without --line its limits,"
                   " gradients and stations, and the advice, are not shown.")
        )  # fmt: skip
    if course is not None and course.assumed:
        parts.append(Warned(f"Assumed of the line: {course.summary()['assumed']}."))
    if "audit" in trajectory.certificate:
        sections.append(
            Section("Certificate", [*certificate_words(trajectory), *trajectory_table(trajectory)])
        )
    if "phases" in trajectory.certificate and course is not None:
        found = journey_advice([trajectory], course)
        sections.append(Section("Advice to the driver", [driver_table(found)]))
    return sections


def line_of_trajectory(trajectory: Trajectory, given: Path | None) -> Line | None:
    """The line of a trajectory in the direction of travel: as given, or as the file holds it.

    None where the file does not hold it, as those of other programs may not.

    Raises
    ------
    InputError
        If the one that is given is another line, or ends before the trajectory does.
    """
    if given is None:
        return line_of_plan(trajectory)
    line, last = read_line(given), float(trajectory.positions[-1])
    if line.name != trajectory.line or line.length < last - 1.0:
        raise InputError(
            f"is line '{line.name}' of {line.length / 1e3:.3f} km; the trajectory is of"
            f" '{trajectory.line}' to km {last / 1e3:.3f}",
            file=given,
            remedy="give the line that it was planned on",
        )
    return line.travelled(trajectory.direction)


def certificate_words(trajectory: Trajectory) -> list[str]:
    """What the certificate of a trajectory says, in plain words."""
    certificate = trajectory.certificate
    audit, count = certificate["audit"], len(trajectory.configurations)
    which = "the planned configuration" if count == 1 else f"each of the {count} configurations"
    over = overspeed(audit["overspeed"])
    limits = "the permitted speed is kept" if over == "none" else f"the speed is over it by {over}"
    limits = f"{limits} {trajectory.limits_kept}"
    return [
        f"An independent rollout drove {which} along the plan: the latest arrives"
        f" {lateness(audit['lateness'])} in {clock(trajectory.running_time)}, {limits}, and at most"
        f" {audit['power']:.0%} of the power is used.",
        f"The plan takes {kwh(certificate['energy'])} ({trajectory.energy_label}). No trajectory"
        f" that keeps the same time could take less than {kwh(certificate['lower_bound'])}: it is"
        f" at most {at_most(certificate['gap'])} above the best.",
    ]


# ------------------------------------------------------------------- coast-down, line, study


def coast_down_sections(path: Path) -> list[Section]:
    """What a report shows of a coast-down."""
    found = read_coast_down(path)
    parts: list[Part] = [
        facts_table("", {"trips": counted(len(found.trips), "trip"), "gradient": found.gradient})
    ]
    if found.curve is not None or found.pieces:
        parts[:0] = found.charts()
    return [Section("Coast-down", [*parts, *found.shown()])]


def study_sections(folder: Path) -> list[Section]:
    """What a report shows of the folder that a study wrote: its tables and pictures."""
    tables = list(_tables(folder / TABLES))
    sections = [Section("Tables", tables)]
    pictures = list[Part]()
    left_out = list[str]()
    size = 0
    for path in sorted(folder.glob("*.png")):
        data = path.read_bytes()
        size += len(data)
        if size > MOST_PICTURES or not data.startswith(b"\x89PNG"):
            left_out.append(path.name)
            continue
        words = path.stem.replace("-", " ").replace("_", " ")
        pictures.append(Picture(data, f"Picture of the study: {words}.", words))
    if left_out:
        pictures.append(f"Beside the page, for its size: {', '.join(left_out)}.")
    return [*sections, Section("Pictures", pictures)] if pictures else sections


_ROW = re.compile(r"^\|(.*)\|$")


def _tables(path: Path) -> Iterable[Part]:
    """Tables and sentences in Markdown as `analysis.studies.report.as_markdown` writes them."""
    title, rows = "", list[list[str]]()
    for line in [*path.read_text(encoding="utf-8").splitlines(), ""]:
        row = _ROW.match(line)
        if row is not None:
            if not re.fullmatch(r"[-|]+", line):
                rows.append([each.strip() for each in row[1].split("|")])
            continue
        if rows:
            width = max(map(len, rows))
            heads, *others = [each + [""] * (width - len(each)) for each in rows]
            table = new_table(title, *heads)
            table.rows = [tuple(each) for each in others]
            yield table
            title, rows = "", []
        if line.startswith("**") and line.endswith("**"):
            title = line.strip("*")
        elif line.strip():
            yield line.strip()


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
    whole = Page(_title(found), _subtitle(found), _parts(found, files))
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
    return f"{found.train} on {found.line.name}: {times}{since}"


def _parts(found: JourneyAdvice, files: Sequence[Path]) -> list[Section]:
    counts = {len(each.configurations) for each in found.sections}
    if counts == {1}:
        words = "Planned for one configuration of the train: a trip that differs may be late."
    else:
        words = (
            f"Times and speeds are those of the configuration that arrives last, of {max(counts)}"
            " observed ones; the others arrive earlier on the same advice."
        )
    return [
        Section("Stations", [stations_table(found)]),
        Section("Advice", [driver_table(found), " ".join([words, *found.sentences()])]),
        Section("Speed", [_chart(found)]),
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


def _chart(found: JourneyAdvice) -> Chart:
    curves, line = [], found.line
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
    limits = limit_curve(line, float(ends[0]), float(ends[1]))
    return Chart(
        "km in the direction of travel",
        [Panel("km/h", [limits, *curves], 1.2, from_zero=True)],
        line=line,
    )
