"""From a result, or a folder of results, to its page: `write_report`."""

from __future__ import annotations

import json
import shlex
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from analysis.charts import BLUE, Chart, Curve, Panel, limit_curve, rows_to_draw, worded
from analysis.comparison.groups import TripCost, compare_groups, trip_cost
from analysis.reports.answers import VERDICTS, Verdict, summary_section, verdict_counts
from analysis.reports.page import WITHOUT_BOKEH, Commands, Page, Part, Section, Warned
from analysis.reports.results import (
    TABLES,
    coast_down_sections,
    fit_sections,
    map_sections,
    study_sections,
    trajectory_sections,
)
from analysis.reports.summary import content_of, copies_in, report, results_in
from analysis.reports.trip import Motion, Zone, recorded_trip, trip_sections
from trainlog import __version__
from trainlog.display import counted, few, in_brief
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.files import check_kind, logs_of, read_bytes, sha256, sha256_of, to_bytes
from trainlog.formats.mapfile import MapFile
from trainlog.formats.railway import line_of
from trainlog.mcap import read_log
from trainlog.presentation import Columns, WordTable, kwh, new_table, word_table
from trainlog.progress import note
from trainlog.railway import Line
from trainlog.railway.line import in_km
from trainlog.trip import Trip
from trainlog.units import KMH, clock

MOST_DETAILED = 4
"""Trips of a folder that are shown one by one; more are a table and one chart."""

MOST_DRAWN = 40
"""Trips whose speeds one chart shows."""


@dataclass(frozen=True)
class ReportOptions:
    """What a report is made with beside the result.

    Attributes
    ----------
    line : path, optional
        Line file of a map or a trajectory whose line is not a sample.
    logs : tuple of path
        Of the trips of a fit: with them residuals are shown.
    zone : Zone
        The clock in which times are stated.

    Examples
    --------
    >>> from analysis.reports.trip import Zone
    >>> ReportOptions(zone=Zone("Europe/Zurich")).zone.name
    'Europe/Zurich'
    """

    line: Path | None = None
    logs: tuple[Path, ...] = ()
    zone: Zone = field(default_factory=Zone)


def write_report(
    source: str | Path, path: str | Path, options: ReportOptions | None = None
) -> Page:
    """Write the report on a result as one HTML page that needs no network.

    Parameters
    ----------
    source : path
        A log, a parameter set, a track-condition map, a trajectory, a coast-down, the folder that
        a study wrote, or a folder of any of them.
    path : path
        HTML file; written whole or not at all. The same inputs give the same bytes.
    options : ReportOptions, optional

    Returns
    -------
    Page
        What was written.

    Raises
    ------
    InputError
        If the source is no result or no path, or the page cannot be written. In a folder a file
        that cannot be read is listed in the report, and stops nothing.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     page = write_report("sample_logs/nonstop.mcap", Path(folder) / "report.html")
    >>> [section.title for section in page.sections[:3]]
    ['Summary', 'Speed and efforts', 'Stops and stations']
    """
    check_kind(source, str, Path)
    page = report_page(Path(source), options or ReportOptions())
    page.write(path)
    return page


def report_page(source: Path, options: ReportOptions) -> Page:
    """The page of a result or a folder; parameters and errors as of `write_report`."""
    if source.is_dir():
        page = _folder_page(source, options)
    else:
        kind = kind_of(source)
        sections = _collected(source, kind, options)
        title = f"{KINDS[kind][0]}: {source.stem}"
        page = Page(title, "", [*sections, _origin([source], options, source)])
    if find_spec("bokeh") is None:
        return replace(page, subtitle=WITHOUT_BOKEH)
    return page


KINDS: dict[str, tuple[str, Callable[[Path, ReportOptions], list[Section]]]] = {
    "parameters": (
        "Running resistance",
        lambda path, options: fit_sections(
            path, [log for each in options.logs for log in logs_of(each)]
        ),
    ),
    "coast-down": ("Coast-down", lambda path, _: coast_down_sections(path)),
    "map": ("Track-condition map", lambda path, options: map_sections(path, options.line)),
    "trajectory": ("Trajectory", lambda path, options: trajectory_sections(path, options.line)),
    "trip": ("Trip", lambda path, options: trip_sections(path, options.zone)),
}
"""Of each kind of result its title, and what makes its sections."""


def kind_of(path: Path) -> str:
    """Which kind of result a file is.

    Raises
    ------
    InputError
        If it is none, or cannot be read.

    Examples
    --------
    >>> kind_of(Path("sample_logs/nonstop.mcap"))
    'trip'
    >>> kind_of(Path("sample_logs/README.md"))  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: sample_logs/README.md: is not a result...
    """
    what = content_of(path)
    if what in KINDS:
        return what
    raise InputError(
        f"is not a result for a report{f' but a {what} file' if what else ''}",
        file=path,
        remedy="give a log (.mcap), parameter set, map, trajectory, coast-down, or a folder",
    )


def _collected(path: Path, kind: str, options: ReportOptions) -> list[Section]:
    """The sections of a file, and what was warned of while they were made."""
    note(path.name)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        sections = KINDS[kind][1](path, options)
    stated = [each.message for each in caught if issubclass(each.category, UserWarning)]
    for message in stated:
        warnings.warn(message, stacklevel=2)
    said = dict.fromkeys(map(str, stated))
    if not said or not sections:
        return sections
    first, *others = sections
    return [Section(first.title, [*map(Warned, said), *first.parts]), *others]


# ------------------------------------------------------------------------------------ folders


def _folder_page(folder: Path, options: ReportOptions) -> Page:
    if (folder / TABLES).is_file():
        sections = study_sections(folder)
        files = [folder / TABLES, *sorted(folder.glob("*.mcap"))]
        return Page(f"Study: {folder.name}", "", [*sections, _origin(files, options, folder)])
    inner = sorted(path for path in folder.iterdir() if path.is_dir())
    studies = [path for path in inner if (path / TABLES).is_file()]
    every = {
        _name(path, folder): tuple(sorted(path.glob("*.mcap")))
        for path in (folder, *inner)
        if path not in studies
    }
    groups = {name: logs for name, logs in every.items() if logs}
    sections, problems, used = list[Section](), dict[str, str](), list[Path]()
    driven, results = list[_Driven](), results_in(folder)
    apart = [each for each in KINDS if each != "trip"]
    for kind, path in ((each, path) for each in apart for path in results.get(each, ())):
        name, own = path.name, options
        if kind == "parameters" and not options.logs:
            # The logs in ``trips`` are what it was fitted to.
            own = replace(options, logs=groups.get("trips", ()))
        try:
            parts = _collected(path, kind, own)
        except TrainlogError as error:
            problems[name] = _reason(error, path)
            continue
        used.append(path)
        sections.append(Section(f"{KINDS[kind][0]}: {name}", parts, whole_page=True))
    detailed = sum(map(len, groups.values())) <= MOST_DETAILED
    for group, logs in groups.items():
        section = _trips(group, logs, folder, options, (problems, driven), detailed=detailed)
        if section is not None:
            used += [log for log in logs if _name(log, folder) not in problems]
            sections.append(section)
    for study in studies:
        note(study.name)
        parts = study_sections(study)
        sections.append(Section(f"Study: {_name(study, folder)}", parts, whole_page=True))
        used.append(study / TABLES)
    if not sections:
        what = "; ".join(f"{name}: {words}" for name, words in problems.items())
        raise InputError(
            "has no result that can be read" + (f" ({what})" if what else ""),
            file=folder,
            remedy="logs (.mcap), parameter sets, maps, trajectories, coast-downs and studies are"
            " shown, in the folder and in those in it",
        )
    summary = _folder_summary(folder, driven)
    first = replace(summary, parts=[*_bad(problems), *summary.parts, *_saved(groups)])
    stated = tuple(f"{name}: {words}" for name, words in problems.items())
    shown = [first, *sections, _origin(used, options, folder)]
    return Page(f"Results: {folder.resolve().name}", "", shown, stated)


def _name(path: Path, folder: Path) -> str:
    if not path.is_relative_to(folder):
        return path.name
    relative = path.relative_to(folder)
    return str(relative) if relative.parts else "trips"


def _reason(error: TrainlogError, path: Path) -> str:
    """Why a file could not be shown, without the folder it stands in."""
    return str(error).replace(str(path), path.name)


def _bad(problems: Mapping[str, str]) -> Iterator[Part]:
    if not problems:
        return
    yield Warned(f"{counted(len(problems), 'file')} could not be shown; the rest is not affected.")
    of: Columns[tuple[str, str]] = {"file": lambda row: row[0], "reason": lambda row: row[1]}
    yield word_table("Not shown", problems.items(), of)


ANSWERS = {
    "recorded": "driven",
    "line": "driven",
    "track condition": "slippery",
    "following": "driven",
}
"""Of which question of the first page each result of `report` answers one; others are the cost."""


@dataclass(frozen=True)
class _Driven:
    """A trip of a folder: its name there, what it took if that is known, and its verdict."""

    name: str
    trip: str
    begins: str
    cost: TripCost | None
    verdict: Verdict
    axles: bool
    """Whether wheel speeds are recorded, which show slip."""

    def cell(self, of: Callable[[TripCost], str]) -> str:
        """What is stated of its cost."""
        return "not known" if self.cost is None else of(self.cost)


def _named(words: Sequence[str]) -> list[str]:
    """As many as are named, and how many more there are."""
    more = len(words) - _MOST_NAMED
    return [*words[:_MOST_NAMED], *[f"and {more} more"] * (more > 0)]


def _folder_summary(folder: Path, trips: Sequence[_Driven]) -> Section:
    """The first page of a folder: its results, and the verdicts on its recordings, by name."""
    note("summary")
    said: dict[str, list[str]] = {"driven": [], "slippery": [], "cost": []}
    # Files that cannot be read are listed below.
    with suppress(TrainlogError):
        for subject, words, _ in report(folder).rows:
            said[ANSWERS.get(subject, "cost")].append(f"{subject}: {words}")
    # What was driven after a trajectory is compared with the rest below.
    costs = [
        each.cost for each in trips if each.cost is not None and not each.name.startswith("driven")
    ]
    recording = [verdict_counts(each.verdict.level for each in trips)]
    worst = sorted((each for each in trips if each.verdict.level), key=lambda e: -e.verdict.level)
    recording += _named([f"{each.name}: {each.verdict}" for each in worst])
    bad = [each.name for each in trips if each.verdict.level == len(VERDICTS) - 1]
    steps = [f"record anew, or do not use: {', '.join(_named(bad))}"] * bool(bad)
    if trips and not (said["slippery"] or said["cost"]):
        steps += [f"fit the running resistance of all: trainlog fit {folder} -o parameters.json"]
        slip = [f"add their slip to a map: trainlog map update {folder} --map LINE.map"]
        steps += slip * any(each.axles for each in trips)
    slipping = [each for each in costs if each.slips]
    if slipping:
        most = max(slipping, key=lambda each: each.slips or 0)
        said["slippery"].append(
            f"slip protection acted on {len(slipping)} of {counted(len(costs), 'trip')}, most often"
            f" on {most.name}: {counted(most.slips or 0, 'time')}"
        )
    for words, energies in (
        ("of traction at the wheel rims", [each.traction for each in costs]),
        ("from the line", [each.line for each in costs]),
    ):
        known = [each for each in energies if each == each]
        if known:
            unknown = f"; not known of {len(energies) - len(known)}" * (len(known) < len(energies))
            said["cost"].append(
                f"{kwh(min(known))} to {kwh(max(known))} a trip {words}, {kwh(sum(known))} in all"
                f"{unknown}"
            )
    return summary_section(said["driven"], recording, said["slippery"], said["cost"], steps)


def _saved(groups: Mapping[str, Sequence[Path]]) -> list[Part]:
    """Drivers' trips against those that followed, where there are both."""
    if not {"trips", "driven"} <= set(groups):
        return []
    note("comparison")
    try:
        return [*compare_groups(groups["trips"], groups["driven"]).shown()]
    except TrainlogError as error:
        return [f"Trips and followed trips were not compared: {error}."]


def _trips(
    group: str,
    logs: Sequence[Path],
    folder: Path,
    options: ReportOptions,
    found: tuple[dict[str, str], list[_Driven]],
    *,
    detailed: bool,
) -> Section | None:
    """The logs of a folder: each by itself, or of many a table and one chart.

    Problems by name, and the trips, are added to those that are `found`.
    """
    problems, every = found
    shown, trips = list[Part](), list[_Driven]()
    curves, lines = list[Curve](), dict[str, Line]()
    for log in logs:
        note(_name(log, folder))
        try:
            _, view, judged = recorded_trip(log)
            trip = view.trip
            if detailed:
                shown.append(Section(f"Trip: {log.stem}", _collected(log, "trip", options)))
            elif curve := _speed_curve(trip, lines):
                curves.append(curve)
        except TrainlogError as error:
            problems[_name(log, folder)] = _reason(error, log)
            continue
        try:
            cost: TripCost | None = trip_cost(view)
        except TrainlogError:
            cost = None
        begins = options.zone.date(trip.start) if any(map(len, trip.topics.values())) else ""
        axles = "/train/axles" in trip.topics
        trips.append(_Driven(_name(log, folder), trip.name, begins, cost, judged, axles))
    every += trips
    if curves:
        shown.append(_overlaid(group, curves[:MOST_DRAWN], lines))
    if trips and not detailed:
        words = f"One of them in full: trainlog report {group}/{logs[0].name} -o trip.html"
        shown += [_trips_table(trips, options.zone), words]
    if shown:
        shown += [f"{each.sentence}." for each in copies_in(logs)]
    title = "Trips" if group == "trips" else f"Trips: {group}"
    return Section(title, shown, whole_page=True) if shown else None


def _trips_table(trips: Sequence[_Driven], zone: Zone) -> WordTable:
    """A row of each trip; columns in which nothing stands are left out."""
    of: Columns[_Driven] = {
        "trip": lambda each: each.trip,
        f"from ({zone.name})": lambda each: each.begins,
        "running time": lambda each: each.cell(lambda cost: clock(cost.running_time)),
        "distance": lambda each: each.cell(lambda cost: f"{cost.distance / 1e3:.1f} km"),
        "stops": lambda each: each.cell(lambda cost: str(cost.stops)),
        "traction": lambda each: each.cell(lambda cost: kwh(cost.traction)),
        "from the line": lambda each: each.cell(lambda cost: kwh(cost.line)),
        "slip protection": lambda each: each.cell(
            lambda cost: "not recorded" if cost.slips is None else str(cost.slips)
        ),
        "off the trajectory": lambda each: each.cell(
            lambda cost: "" if cost.late is None else f"{cost.late:+.1f} s"
        ),
        "recording": lambda each: VERDICTS[each.verdict.level],
    }
    late = any(each.cost is not None and each.cost.late is not None for each in trips)
    return word_table("", trips, {k: v for k, v in of.items() if late or k != "off the trajectory"})


def _speed_curve(trip: Trip, lines: dict[str, Line]) -> Curve | None:
    """The speed of a trip over km; its line is added to `lines`."""
    motion = Motion.of(trip)
    line: Line | None = None
    with suppress(TrainlogError):
        line = line_of(trip)
        lines.setdefault(f"{line.name} {trip.metadata.get('direction', 'forward')}", line)
    if not motion.position.size:
        return None
    rows = rows_to_draw(motion.speed, most=300)
    x, y = motion.position[rows] / 1e3, KMH * motion.speed[rows]
    hover = {
        "trip": [trip.name] * rows.size,
        "km": worded("{:.3f}", in_km(line, motion.position[rows])),
        "speed": worded("{:.1f} km/h", y),
    }
    return Curve("each trip", x, y, BLUE, "line", hover=hover, width=0.8)


def _overlaid(group: str, curves: Sequence[Curve], lines: Mapping[str, Line]) -> Part:
    """Speeds of trips over km; limits and stations where all are of one line and direction."""
    line = next(iter(lines.values())) if len(lines) == 1 else None
    ends = [float(each) for curve in curves for each in (np.min(curve.x), np.max(curve.x))]
    limits = [] if line is None else [limit_curve(line, 1e3 * min(ends), 1e3 * max(ends))]
    title = f"{counted(len(curves), 'trip')} in {group}"
    panels = [Panel("km/h", [*limits, *curves], 1.6, title, from_zero=True)]
    return Chart("km in the direction of travel", panels, line=line)


# --------------------------------------------------------------------------------- provenance


def _origin(files: Sequence[Path], options: ReportOptions, source: Path) -> Section:
    """The provenance of a report, with the command that made it."""
    given = "".join(
        f" {name} {shlex.quote(str(value))}"
        for name, value in (
            *(("--logs", each.name) for each in options.logs),
            ("--line", options.line.name if options.line else None),
            ("--zone", options.zone.name if options.zone.name != "UTC" else None),
        )
        if value
    )
    note("provenance")
    folder = source if source.is_dir() else source.parent
    table = new_table("Files shown", "file", "bytes", "SHA-256")
    steps = new_table("What they were made of", "file", "step", "software", "inputs and settings")
    made_by: dict[str, list[str]] = {}
    for number, path in enumerate(files):
        name = _name(path, folder)
        table.add_row(name, f"{path.stat().st_size}", sha256_of(path))
        for step in _steps(path):
            what = str(step.get("step", ""))
            made_by.setdefault(what, []).append(name)
            if number < MOST_TRACED:
                about = {key: each for key, each in step.items() if key not in UNLISTED}
                steps.add_row(name, what, str(step.get("software", "")), in_brief(about, "\n"))
    if len(files) > MOST_TRACED:
        steps.caption = f"{len(files) - MOST_TRACED} more files; 'trainlog show' states theirs"
    commands = [
        _COMMANDS[name].format(few(names, 1))
        for name, names in made_by.items()
        if name in _COMMANDS
    ]
    name = shlex.quote(source.resolve().name)
    commands.append(f"trainlog report {name}{given} -o report.html")
    parts: list[Part] = [table, *([steps] if steps.rows else [])]
    parts.append("Commands, without the options that the files do not state:")
    parts.append(Commands(tuple(commands)))
    parts.append(f"This page: trainlog {__version__}; SI units inside, km, km/h, ‰ and kWh shown.")
    return Section("Provenance", parts, whole_page=True, folded=True)


_COMMANDS = {
    "simulate": "trainlog simulate drive --line LINE --train TRAIN -o FOLDER  # {}",
    "ingest": "trainlog ingest RECORDING -o FOLDER  # {}",
    "estimate": "trainlog estimate LOG -o FOLDER  # {}",
    "fit": "trainlog fit LOGS -o {}",
    "coast-down": "trainlog fit coasting LOGS -o {}",
    "plan": "trainlog plan PARAMETERS --line LINE --train TRAIN -o {}",
    "advise": "trainlog advice TRAJECTORY --onto LOG -o {}",
    "map update": "trainlog map update LOGS --map {}",
}
"""Command of each step of provenance."""


def _steps(path: Path) -> list[Mapping[str, Any]]:
    """The steps of provenance that a file states."""
    try:
        kind = kind_of(path)
        if kind == "trip":
            return list(read_log(path, []).provenance)
        if kind == "map":
            with MapFile(path) as file:
                trips = [row.known.name for row in file.trips()]
            return [{"step": "map update", "trips": trips}]
        stated = json.loads(read_bytes(path)).get("provenance", {})
    except (TrainlogError, ValueError):
        return []
    if isinstance(stated, dict) and isinstance(stated.get("line"), dict):
        stated = stated | {"line": sha256(to_bytes(stated["line"]))}
    made_by = {"trajectory": "plan", "parameters": "fit"}.get(kind, kind)
    return [{"step": made_by, **stated}] if isinstance(stated, dict) and stated else []


_MOST_NAMED = 6

MOST_TRACED = 12
"""Files whose steps of provenance are listed one by one."""


UNLISTED = ("step", "software", "report")
"""Of a step of provenance."""
