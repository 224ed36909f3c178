"""From a result, or a folder of results, to its page: `write_report`."""

from __future__ import annotations

import json
import re
import shlex
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from analysis.charts import (
    BLUE,
    Chart,
    Curve,
    Panel,
    limit_curve,
    rows_to_draw,
    worded,
)
from analysis.comparison.groups import TripCost, compare_groups, trip_cost
from analysis.reports.answers import VERDICTS, Verdict, summary_section, verdict_counts
from analysis.reports.charts import WITHOUT_BOKEH
from analysis.reports.page import Commands, Page, Part, Section, Warned
from analysis.reports.results import (
    TABLES,
    coast_down_sections,
    fit_sections,
    map_sections,
    study_sections,
    trajectory_sections,
)
from analysis.reports.summary import copies_in, report
from analysis.reports.trip import Motion, Zone, recorded_trip, trip_sections
from trainlog import __version__
from trainlog.display import counted
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.files import (
    beginning,
    check_kind,
    is_map,
    logs_of,
    read_bytes,
    sha256,
    sha256_of,
    stated_format,
    to_bytes,
)
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

_SHOWN = ("parameters", "trajectory", "coast-down")
"""Formats of JSON files that a report shows."""


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
        title = f"{_TITLES[kind]}: {source.stem}"
        page = Page(title, "", [*sections, _origin([source], options, source)])
    if find_spec("bokeh") is None:
        return replace(page, subtitle=WITHOUT_BOKEH)
    return page


_TITLES = {
    "trip": "Trip",
    "map": "Track-condition map",
    "parameters": "Running resistance",
    "trajectory": "Trajectory",
    "coast-down": "Coast-down",
}


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
    trainlog.errors.InputError: sample_logs/README.md: is no result...
    """
    start = beginning(path)
    if start.startswith(b"\x89MCAP") or path.suffix == ".mcap":
        return "trip"
    if is_map(start) or path.suffix == ".map":
        return "map"
    what = stated_format(start).removeprefix("trainlog/")
    if what in _SHOWN:
        return what
    raise InputError(
        f"is no result that a report shows{f' but a {what} file' if what else ''}",
        file=path,
        remedy="give a log (.mcap), parameter set, map, trajectory, coast-down, or a folder",
    )


def _sections_of(path: Path, kind: str, options: ReportOptions) -> list[Section]:
    if kind == "trip":
        return trip_sections(path, options.zone)
    if kind == "map":
        return map_sections(path, options.line)
    if kind == "parameters":
        logs = [log for each in options.logs for log in logs_of(each)]
        return fit_sections(path, logs)
    if kind == "trajectory":
        return trajectory_sections(path, options.line)
    return coast_down_sections(path)


def _collected(path: Path, kind: str, options: ReportOptions) -> list[Section]:
    """The sections of a file, and what was warned of while they were made."""
    note(path.name)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        sections = _sections_of(path, kind, options)
    said = dict.fromkeys(
        str(each.message) for each in caught if issubclass(each.category, UserWarning)
    )
    for each in caught:
        if issubclass(each.category, UserWarning):
            warnings.warn(each.message, stacklevel=2)
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
    found = _Folder.of(folder)
    sections, problems, used = list[Section](), dict[str, str](), list[Path]()
    driven = list[_Driven]()
    for kind, path in found.results:
        name = _name(path, folder)
        try:
            own = _own_options(kind, found, options)
            parts = _collected(path, kind, own)
        except TrainlogError as error:
            problems[name] = _reason(error, path)
            continue
        used.append(path)
        sections.append(Section(f"{_TITLES[kind]}: {name}", parts, whole_page=True))
    detailed = sum(map(len, found.logs.values())) <= MOST_DETAILED
    for group, logs in found.logs.items():
        section = _trips(group, logs, folder, options, (problems, driven), detailed=detailed)
        if section is not None:
            used += [log for log in logs if _name(log, folder) not in problems]
            sections.append(section)
    for study in found.studies:
        note(study.name)
        parts = study_sections(study)
        sections.append(Section(f"Study: {_name(study, folder)}", parts, whole_page=True))
        used.append(study / TABLES)
    if not sections:
        what = "; ".join(f"{name}: {words}" for name, words in problems.items())
        raise InputError(
            "holds no result that can be read" + (f" ({what})" if what else ""),
            file=folder,
            remedy="logs (.mcap), parameter sets, maps, trajectories, coast-downs and studies are"
            " shown, in the folder and in those in it",
        )
    summary = _folder_summary(folder, driven)
    first = replace(summary, parts=[*_bad(problems), *summary.parts, *_saved(found)])
    every = [first, *sections, _origin(used, options, folder)]
    stated = tuple(f"{name}: {words}" for name, words in problems.items())
    return Page(f"Results: {folder.resolve().name}", "", every, stated)


@dataclass(frozen=True)
class _Folder:
    """What a folder holds that a report shows: results, logs by their folder, studies."""

    results: tuple[tuple[str, Path], ...]
    logs: Mapping[str, tuple[Path, ...]]
    studies: tuple[Path, ...]

    @staticmethod
    def of(folder: Path) -> _Folder:
        inner = sorted(path for path in folder.iterdir() if path.is_dir())
        studies = tuple(path for path in inner if (path / TABLES).is_file())
        plain = [path for path in (folder, *inner) if path not in studies]
        results = []
        for kind in ("parameters", "coast-down", "map", "trajectory"):
            files = [
                each for path in plain[:1] for each in sorted(path.iterdir()) if each.is_file()
            ]
            results += [(kind, path) for path in files if _kind_or_none(path) == kind]
        logs = {_name(path, folder): tuple(sorted(path.glob("*.mcap"))) for path in plain}
        return _Folder(tuple(results), {name: each for name, each in logs.items() if each}, studies)


def _kind_or_none(path: Path) -> str | None:
    try:
        return kind_of(path)
    except TrainlogError:
        return None


def _name(path: Path, folder: Path) -> str:
    if not path.is_relative_to(folder):
        return path.name
    relative = path.relative_to(folder)
    return str(relative) if relative.parts else "trips"


def _own_options(kind: str, found: _Folder, options: ReportOptions) -> ReportOptions:
    """For a fit the logs in ``trips`` are what it was fitted to, unless others are given."""
    if kind != "parameters" or options.logs or "trips" not in found.logs:
        return options
    return ReportOptions(options.line, found.logs["trips"], options.zone)


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


def _saved(found: _Folder) -> list[Part]:
    """Drivers' trips against those that followed, where there are both."""
    if not {"trips", "driven"} <= set(found.logs):
        return []
    note("comparison")
    try:
        return [*compare_groups(found.logs["trips"], found.logs["driven"]).shown()]
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
    name = shlex.quote(source.resolve().name)
    folder = source if source.is_dir() else source.parent
    return origin(files, folder, f"trainlog report {name}{given} -o report.html")


def origin(files: Sequence[Path], folder: Path, command: str) -> Section:
    """Files with their digests, what they were made of, and the commands, of which one is given."""
    note("provenance")
    table = new_table("Files shown", "file", "bytes", "SHA-256")
    heads = ("file", "step", "software", "input or setting", "value")
    steps = new_table("What they were made of", *heads)
    made_by: dict[str, list[str]] = {}
    for number, path in enumerate(files):
        table.add_row(_name(path, folder), f"{path.stat().st_size}", sha256_of(path))
        for step in _steps(path):
            name = str(step.get("step", ""))
            made_by.setdefault(name, []).append(_name(path, folder))
            about = (_name(path, folder), name, str(step.get("software", "")))
            settings = _settings({k: v for k, v in step.items() if k not in UNLISTED})
            for setting in (settings or [("", "")]) if number < MOST_TRACED else ():
                steps.add_row(*about, *setting)
                about = ("", "", "")
    if len(files) > MOST_TRACED:
        steps.caption = f"{len(files) - MOST_TRACED} more files; 'trainlog show' states theirs"
    commands = [
        _COMMANDS[name].format(_some(made)) for name, made in made_by.items() if name in _COMMANDS
    ]
    commands.append(command)
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
    "optimise": "trainlog plan PARAMETERS --line LINE --train TRAIN -o {}",
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


def _some(names: Sequence[str]) -> str:
    return names[0] + (f" and {len(names) - 1} more" if len(names) > 1 else "")


UNLISTED = ("step", "software", "report")
"""Of a step of provenance."""


def _settings(step: Mapping[str, Any], of: str = "") -> list[tuple[str, str]]:
    """Names and values of inputs and settings; of many in one the first, digests by their begin."""
    rows = list[tuple[str, str]]()
    for name, value in step.items():
        if isinstance(value, Mapping):
            inner = _settings(value, f"{of}{name}, ")
            rows += inner[:_MOST_NAMED]
            more = len(inner) - _MOST_NAMED
            rows += [(f"{of}{name}", f"and {more} more")] * (more > 0)
        elif isinstance(value, list | tuple):
            words = [_brief(each) for each in value[:_MOST_NAMED]]
            more = len(value) - _MOST_NAMED
            rows.append((f"{of}{name}", ", ".join(words) + f" and {more} more" * (more > 0)))
        elif value is not None:
            rows.append((f"{of}{name}", _brief(value)))
    return rows


def _brief(value: object) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    if re.fullmatch(r"[0-9a-f]{64}", text):
        return f"{text[:12]}…"
    return text if len(text) <= 80 else f"{text[:79]}…"
