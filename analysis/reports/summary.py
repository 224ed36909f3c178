"""What a folder of results holds, summed up: a line for each subject."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from analysis.adhesion.map_state import summary
from analysis.comparison.groups import compare_groups, punctuality
from analysis.resistance.curve import curve_std
from analysis.trajectory.table import section_name
from analysis.truth import SimulatedLogs, Truth, curve_error, map_error
from trainlog.display import counted, lateness, span
from trainlog.errors import InputError, LogError, TrainlogError
from trainlog.formats.files import beginning, is_map, stated_format
from trainlog.formats.mapfile import MapFile, read_map
from trainlog.formats.railway import (
    line_of_plan,
    read_coast_down,
    read_line,
    read_parameters,
    read_trajectory,
)
from trainlog.identity import Known, SameDrive, same_drives
from trainlog.mcap.convert import span_of
from trainlog.mcap.reader import identity_of_log
from trainlog.presentation import (
    Columns,
    Presented,
    WordTable,
    kwh,
    overspeed,
    with_band,
    word_table,
)
from trainlog.railway.condition import TrackConditionMap
from trainlog.railway.train import ParameterSet
from trainlog.railway.trajectory import Trajectory
from trainlog.units import KMH


@dataclass(frozen=True, eq=False, repr=False)
class Report(Presented):
    """What a folder of results holds.

    Attributes
    ----------
    folder : Path
    rows : tuple of (str, str, str)
        Subject, result in words, and where it stands.
    """

    folder: Path
    rows: tuple[tuple[str, str, str], ...]

    @property
    def title(self) -> str:
        """The folder."""
        return f"Results in {self.folder}"

    def summary(self) -> dict[str, str]:
        """Each result."""
        return {row[0]: row[1] for row in self.rows}

    def facts(self) -> dict[str, Any]:
        """The folder, and its results."""
        rows = [dict(zip(("subject", "result", "in"), row, strict=True)) for row in self.rows]
        return {"folder": str(self.folder), "results": rows}

    def tables(self) -> list[WordTable]:
        """A row per result."""
        of: Columns[tuple[str, str, str]] = {
            "": lambda row: row[0],
            "result": lambda row: row[1],
            "in": lambda row: row[2],
        }
        return [word_table(self.title, self.rows, of, name="results")]


def report(folder: str | Path) -> Report:
    """Sum up a folder of results: the fit, the map, the trajectory, the energy saved.

    What was made of simulated trips is judged by their truth, where their logs are in the folder.

    Parameters
    ----------
    folder : path
        As ``trainlog demo`` leaves it: logs in ``trips`` and ``driven``, ``parameters.json``,
        ``wil.map``, ``trajectory.json``; whatever there is of them. Without ``trips`` logs count
        wherever in the folder they are, and one folder deeper. Parameter sets, maps,
        trajectories, results of coast-down and lines may have any names: their format names them.

    Raises
    ------
    InputError
        If the folder holds no results.

    Examples
    --------
    >>> import pathlib, shutil
    >>> pathlib.Path("results").mkdir(exist_ok=True)
    >>> _ = shutil.copy("sample_logs/CH_StGallen_Wil.map", "results/wil.map")
    >>> [row[0] for row in report("results").rows][-1]
    'track condition'
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            "is a file" if folder.exists() else "does not exist",
            file=folder,
            remedy="name the folder that holds the results",
        )
    usual = sorted((folder / "trips").glob("*.mcap"))
    inner = [log for log in folder.glob("*/*.mcap") if not log.parent.name.startswith("driven")]
    logs = usual or [*sorted(folder.glob("*.mcap")), *sorted(inner)]
    simulated, results = SimulatedLogs(logs), results_in(folder)
    rows = [
        _recorded(logs),
        *(_fitted(path, simulated) for path in results.get("parameters", ())),
        *(_coasted(path) for path in results.get("coast-down", ())),
        *(_mapped(path, simulated) for path in results.get("map", ())),
        *(_drawn(path) for path in results.get("line", ())),
        *_planned(results.get("trajectory", ())),
        _saved(folder / "driven", logs),
        _followed(folder),
    ]
    found = [row for row in rows if row is not None]
    if not found:
        raise InputError(
            "has no results",
            file=folder,
            remedy="they are looked for as 'trainlog demo' leaves them: logs in trips/ and driven/,"
            " parameters.json, a map (.map), trajectory.json; or by any other name",
        )
    return Report(folder, tuple(found))


def copies_in(logs: Sequence[Path]) -> list[SameDrive]:
    """The logs of drives of which others of the logs are; see `trainlog.identity.same_drives`."""
    known = list[Known]()
    for log in logs:
        identity = None
        with suppress(TrainlogError):
            identity = identity_of_log(log)
        known.append(Known(log.stem, identity, (str(log),)))
    return same_drives(known)


def _recorded(logs: Sequence[Path]) -> tuple[str, str, str] | None:
    if not logs:
        return None
    copies = {each.number for each in copies_in(logs)}
    drives = [log for number, log in enumerate(logs) if number not in copies]
    spans = [span for span in map(span_of, drives) if span is not None]
    hours = sum((end - start).total_seconds() for start, end in spans) / 3600.0
    places = dict.fromkeys(str(log.parent) for log in logs)
    more = f"; {counted(len(copies), 'recording')} more of these drives" if copies else ""
    words = f"{counted(len(drives), 'trip')}, {hours:.1f} h{more}"
    return "recorded", words, ", ".join(places)


def content_of(path: Path) -> str:
    """What a file holds: ``"trip"``, ``"map"``, the format of a file of ours, or "".

    Examples
    --------
    >>> content_of(Path("sample_logs/nonstop.mcap")), content_of(Path("sample_logs/README.md"))
    ('trip', '')
    """
    start = beginning(path)
    if start.startswith(b"\x89MCAP") or path.suffix == ".mcap":
        return "trip"
    if is_map(start) or path.suffix == ".map":
        return "map"
    return stated_format(start).removeprefix("trainlog/")


def results_in(folder: Path) -> dict[str, list[Path]]:
    """The files of a folder by what they hold, in order of name."""
    found = dict[str, list[Path]]()
    for path in sorted(folder.iterdir()):
        # A file that cannot be read says nothing of the others.
        with suppress(TrainlogError):
            if path.is_file():
                found.setdefault(content_of(path), []).append(path)
    return found


def _coasted(path: Path) -> tuple[str, str, str]:
    found = read_coast_down(path)
    words = f"{counted(len(found.trips), 'trip')}, gradient: {found.gradient}"
    if found.curve is not None:
        curve = found.curve
        at = int(np.argmin(np.abs(curve.speeds - np.median(curve.speeds))))
        middle, low, high = (1e3 * each[at] for each in (curve.deceleration, curve.low, curve.high))
        words += (
            f"; {middle:.1f} mm/s² ({low:.1f} to {high:.1f}) of resistance over inertia"
            f" at {KMH * curve.speeds[at]:.0f} km/h"
        )
    return "coast-down", words, str(path)


def _drawn(path: Path) -> tuple[str, str, str]:
    line = read_line(path)
    known = f"; assumed: {', '.join(line.assumed)}" if line.assumed else ""
    return "line", f"{line.name}, {line.length / 1e3:.2f} km{known}", str(path)


def _measured(found: ParameterSet) -> str:
    """Mass, power and resistance of a set, as far as it has them."""
    every = found.configurations
    if not every:
        return ""
    mass, power = (
        span([getattr(each, name) for each in every], 1e-3, digits)
        for name, digits in (("mass", 1), ("max_power", 0))
    )
    words = f"; mass {mass} t, power {power} kW" + " (the train file's)" * bool(found.assumed_power)
    if found.common is None or found.common_covariance is None or found.speed_range[1] <= 0.0:
        return words
    at = float(np.mean(found.speed_range))
    std = float(curve_std(found.common_covariance, at))
    drag = with_band(float(found.common(at)) / 1e3, std / 1e3, " kN")
    return f"{words}, resistance {drag} at {KMH * at:.0f} km/h"


def _fitted(path: Path, simulated: SimulatedLogs) -> tuple[str, str, str]:
    found = read_parameters(path)
    words = counted(len(found.configurations), "configuration") + _measured(found)
    truths = _truths_of(found, simulated)
    pairs = [(c, truths[c.name]) for c in found.configurations if c.name in truths]
    if pairs:
        single = np.median([curve_error(c.resistance, [truth]) for c, truth in pairs])
        words += f"; drag curve off by {single:.1%} for one trip (median)"
    if found.common is not None and pairs and len(pairs) == len(found.configurations):
        together = curve_error(found.common, [truth for _, truth in pairs])
        words += f", {together:.1%} for all together"
    return "running resistance", words, str(path)


def _truths_of(found: ParameterSet, simulated: SimulatedLogs) -> dict[str, Truth]:
    """The truth of a set's configurations by their names, as far as their logs are known."""
    truths = {}
    for detail in found.details:
        truth = simulated.truth(str(detail.get("sha256") or ""))
        if truth is not None and truth.train == found.train and "configuration" in detail:
            truths[str(detail["configuration"])] = truth
    return truths


def _mapped(path: Path, simulated: SimulatedLogs) -> tuple[str, str, str]:
    track = read_map(path)
    layers = summary(track)
    events = sum(layer.events for layer in layers)
    words = f"{counted(events, 'onset')} of slip measured, " + ", ".join(
        f"{layer.observed_length / 1e3:.1f} km {layer.layer}" for layer in layers
    )
    words += " observed" if layers else ""
    truths = _truths_of_map(path, track, simulated) if events else []
    if truths:
        error, bins = map_error(track, truths)
        words += f"; maximum adhesion off by {error:.3f} RMS in {counted(bins, 'bin')} with events"
    return "track condition", words, str(path)


def _truths_of_map(path: Path, track: TrackConditionMap, simulated: SimulatedLogs) -> list[Truth]:
    """The truth of the trips of those layers with events of which that of all trips is known."""
    by_layer: dict[str, list[Truth | None]] = {}
    with MapFile(path) as file:
        for row in file.trips():
            if row.counted:
                known = row.known
                by_layer.setdefault(row.layer, []).append(
                    simulated.truth(known.digest, known.identity)
                )
    return [
        truth
        for layer, truths in by_layer.items()
        if track.layer(layer).events.any()
        and all(t is not None and (t.line, t.weather) == (track.line, layer) for t in truths)
        for truth in truths
        if truth is not None
    ]


def _planned(files: Sequence[Path]) -> Iterator[tuple[str, str, str]]:
    """Each trajectory by itself, and the total of the sections of each journey."""
    journeys: dict[str, list[Trajectory]] = {}
    for path in files:
        trajectory = read_trajectory(path)
        certificate = trajectory.certificate
        audit = certificate["audit"]
        energy = (
            f"{trajectory.energy_label} {kwh(certificate['energy'])} over"
            f" {counted(len(trajectory.configurations), 'configuration')}"
            f" in {trajectory.running_time:.0f} s"
        )
        proof = (
            f"{trajectory.optimality}, latest arrival {lateness(audit['lateness'])},"
            f" speed over the limit: {overspeed(audit['overspeed'])} {trajectory.limits_kept}"
        )
        name = ""
        if "journey" in trajectory.provenance:
            name = f" {section_name(trajectory, line_of_plan(trajectory))}"
            journeys.setdefault(trajectory.provenance["journey"]["name"], []).append(trajectory)
        yield f"trajectory{name}", energy, str(path)
        yield f"certificate{name}", proof, ""
    for sections in journeys.values():
        departures = [each.provenance["journey"]["departure"] for each in sections]
        arrivals = [at + each.running_time for at, each in zip(departures, sections, strict=True)]
        energy = kwh(sum(each.certificate["energy"] for each in sections))
        lasts = f"{max(arrivals) - min(departures):.0f} s with the stops"
        yield "journey", f"{counted(len(sections), 'section')}, {energy} in all, {lasts}", ""


def _saved(folder: Path, logs: Sequence[Path]) -> tuple[str, str, str] | None:
    followed = sorted(folder.glob("*.mcap"))
    if not (followed and logs):
        return None
    try:
        found = compare_groups(logs, followed)
    except LogError as refused:
        return "energy saved", f"not compared: {refused.problem}", str(folder)
    words = f"{found.saved_words} on {counted(len(found.pairs), 'trip')} ({found.times_words})"
    return "energy saved", words, str(folder)


def _followed(folder: Path) -> tuple[str, str, str] | None:
    """How punctual the trips on the trajectory were, with the map and without."""
    words = []
    for name, how in (("driven", "with the map"), ("driven-blind", "without")):
        logs = sorted((folder / name).glob("*.mcap"))
        if logs:
            try:
                found = punctuality(logs)
            except LogError as refused:
                words.append(f"{how} not summed up: {refused.problem}")
                continue
            acts = "not recorded" if found.slips is None else counted(found.slips, "time")
            words.append(
                f"{how} at most {abs(found.late):.1f} s from the trajectory on arrival, slip"
                f" protection on {counted(found.trips, 'trip')}: {acts}"
            )
    return ("following", "; ".join(words), str(folder / "driven")) if words else None
