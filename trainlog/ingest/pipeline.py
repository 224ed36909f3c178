"""From a recorded file to a trip: read, repair, name, estimate."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from trainlog import __version__
from trainlog.errors import InputError
from trainlog.formats.files import read_bytes, sha256, sha256_of
from trainlog.formats.line import line_to_bytes
from trainlog.formats.train import train_to_bytes
from trainlog.ingest.estimates import estimated_state
from trainlog.ingest.profile import Limits, Profile, TripOptions, parse_profile
from trainlog.ingest.recording import Finding, IntArray, Recording, Table, field_of
from trainlog.ingest.registry import format_of
from trainlog.ingest.report import Report
from trainlog.ingest.rules import refuse_switched_off, repaired
from trainlog.ingest.values import LIMITS
from trainlog.railway.line import Line
from trainlog.railway.train import Train
from trainlog.topics import EVENTS, TOPICS
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip, frame_of
from trainlog.units import from_si

PROFILE_ATTACHMENT = "profile.toml"
"""Attachment that holds the profile a recording was read with."""

SPEED_MARGIN = 1.5
"""Speeds beyond this multiple of what line and train allow are impossible."""

Direction = Literal["forward", "reverse"]


def ingest(
    path: str | Path,
    *,
    profile: str | Path | Profile | None = None,
    format: str | None = None,
    line: Line | None = None,
    train: Train | None = None,
    direction: Direction | None = None,
    metadata: Mapping[str, str] | None = None,
) -> Trip:
    """Turn a recorded file into a trip; what had to be repaired is counted, see `report_of`.

    Parameters
    ----------
    path : path
        The recorded file.
    profile : path or Profile, optional
        How the recorder writes; needed for formats of any layout (CSV, Parquet).
    format : str, optional
        Name of a registered format; default: what the profile says, else detected.
    line, train : Line, Train, optional
        Where and with what it was driven; they are attached to the trip. With the line's geometry
        satellite fixes become chainage in ``/estimates/state``.
    direction : {"forward", "reverse"}, optional
        Along the line as given; default: what the profile says, else forward.
    metadata : mapping of str to str, optional
        Further metadata, stronger than the profile's.

    Returns
    -------
    Trip
        In SI units, time in UTC; metadata and the provenance step ``"ingest"`` tell what was
        read, kept and repaired.

    Raises
    ------
    InputError
        If the file cannot be used, with row and column where they are known and a remedy.
    """
    source = Path(path)
    rules, profile_data = _profile(profile)
    chosen = format_of(source, format or (rules.file.format if rules else None))
    try:
        recording = chosen.read(source, rules)
        trip, report = _trip(recording, rules or _default_profile(), line, train, direction)
    except InputError as error:
        if error.file is not None:
            raise
        raise InputError(
            error.problem, file=source, place=error.place, remedy=error.remedy
        ) from error
    named = {"trip": source.stem} | trip.metadata | dict(metadata or {}) | report.metadata()
    attachments = dict(trip.attachments)
    inputs = {source.name: sha256_of(source)}
    if profile_data is not None:
        attachments[PROFILE_ATTACHMENT] = profile_data
        inputs[PROFILE_ATTACHMENT] = sha256(profile_data)
    inputs |= {
        name: sha256(attachments[name])
        for name in (LINE_ATTACHMENT, TRAIN_ATTACHMENT)
        if name in attachments
    }
    return Trip(trip.topics, named, (), attachments).with_step(
        "ingest",
        software=f"trainlog {__version__}",
        format=chosen.name,
        profile=rules.name if rules else None,
        inputs=inputs,
        report=report.details(),
    )


def _profile(profile: str | Path | Profile | None) -> tuple[Profile | None, bytes | None]:
    """The profile and the bytes that stand for it in the trip."""
    if profile is None:
        return None, None
    if isinstance(profile, Profile):
        return profile, profile.model_dump_json(indent=1, exclude_defaults=True).encode()
    data = read_bytes(profile)
    return parse_profile(data, file=profile), data


def _default_profile() -> Profile:
    return Profile(format="trainlog/recorder-profile", version=1, name="none")


def _trip(
    recording: Recording,
    profile: Profile,
    line: Line | None,
    train: Train | None,
    direction: Direction | None,
) -> tuple[Trip, Report]:
    """The trip, without what is known of its files, and the report."""
    refuse_switched_off(recording.findings, profile.repair)
    findings = list(recording.findings)
    limits = _limits(profile.limits, line, train)
    tables: list[Table] = []
    for table in recording.tables:
        kept, found = repaired(table, limits, profile.repair)
        tables.append(_from_start(kept, profile.trip))
        findings += found
    way = direction or profile.trip.direction or "forward"
    travelled = line.reversed() if line is not None and way == "reverse" else line
    topics = _frames(tables, recording.constants)
    trip = Trip(topics, _metadata(recording, profile, line, train, way))
    estimate = estimated_state(trip, travelled, profile)
    findings += estimate.findings
    if estimate.frame is not None:
        trip = trip.with_topic(estimate.frame)
    trip.metadata.update(estimate.metadata)
    trip.metadata["start"] = trip.start.isoformat()
    if line is not None:
        trip.attachments[LINE_ATTACHMENT] = line_to_bytes(line)
    if train is not None:
        trip.attachments[TRAIN_ATTACHMENT] = train_to_bytes(train)
    kept_rows = sum(len(table) for table in tables)
    report = Report(recording.rows_read, kept_rows, _joined(findings), profile.repair.switched_off)
    return trip, report


def _joined(findings: list[Finding]) -> tuple[Finding, ...]:
    """Findings of the same rule and column as one: the axles of a field, several tables."""
    joined: dict[tuple[str, str], Finding] = {}
    for finding in findings:
        key = (finding.rule, finding.column)
        before = joined.get(key)
        if before is None:
            joined[key] = finding
        else:
            rows = tuple(sorted({*before.rows, *finding.rows})[:5])
            note = before.note or finding.note
            joined[key] = Finding(*key[:1], before.count + finding.count, rows, key[1], note)
    return tuple(joined.values())


def _limits(limits: Limits, line: Line | None, train: Train | None) -> Limits:
    """The profile's limits; speeds bounded by what line and train allow where it says nothing."""
    allowed = [float(line.speed_limit(line.breakpoints).max())] if line is not None else []
    allowed += [train.max_speed] if train is not None else []
    if not allowed:
        return limits
    fastest = SPEED_MARGIN * min(allowed)
    bounded = {
        name: LIMITS[name].model_copy(update={"max": fastest})
        for name in ("/train/state.speed", "/gnss/motion.speed")
    }
    return limits.model_copy(update={"columns": bounded | limits.columns})


def _from_start(table: Table, options: TripOptions) -> Table:
    """The table with its position counted so that the first is the profile's start position."""
    position = table.signals.get("/train/state.position")
    if options.start_position is None or position is None or not np.isfinite(position).any():
        return table
    first = position[np.isfinite(position)][0]
    moved = position - first + options.start_position.si("m")
    return Table(
        table.time, table.rows, {**table.signals, "/train/state.position": moved}, table.texts
    )


def _frames(tables: list[Table], constants: dict[str, float | str]) -> dict[str, pd.DataFrame]:
    """One frame a topic, in the order of the table of topics; rows that hold nothing left out."""
    found: dict[str, pd.DataFrame] = {}
    for name, topic in TOPICS.items():
        fixed = {
            field_of(key)[1]: value
            for key, value in constants.items()
            if field_of(key)[0].name == name
        }
        for table in tables:
            values = _of_topic(table.signals, name)
            texts = _of_topic(table.texts, name)
            present = np.zeros(len(table), dtype=np.bool_)
            for column in values.values():
                present |= np.isfinite(column)
            if texts:
                present = np.logical_or.reduce([words != "" for words in texts.values()])
            if not present.any():
                continue
            data: dict[str, Any] = {**values, **texts}
            data = {key: column[present] for key, column in data.items()}
            if name == EVENTS.name:
                level = np.nan_to_num(data.get("level", np.full(present.sum(), 2.0)), nan=2.0)
                data["level"] = level.astype(np.int64)
            constant = {key: np.full(present.sum(), value) for key, value in fixed.items()}
            found[name] = frame_of(topic, _index(table.time[present]), {**constant, **data})
        if fixed and name not in found:
            ends = np.array([min(t.time[0] for t in tables), max(t.time[-1] for t in tables)])
            found[name] = frame_of(
                topic, _index(ends), {key: np.full(2, value) for key, value in fixed.items()}
            )
    return found


def _index(time: IntArray) -> pd.DatetimeIndex:
    return pd.DatetimeIndex(time.view("datetime64[ns]"), tz="UTC")


def _of_topic(columns: Mapping[str, Any], topic: str) -> dict[str, Any]:
    return {
        field_of(name)[1]: values
        for name, values in columns.items()
        if field_of(name)[0].name == topic
    }


def _metadata(
    recording: Recording, profile: Profile, line: Line | None, train: Train | None, way: str
) -> dict[str, str]:
    """What is known of the trip but for its files and its report."""
    options = profile.trip
    known = {
        "train": _agreed("train", options.train, train.name if train else None),
        "line": _agreed("line", options.line, line.name if line else None),
        "direction": way,
        "load": _load(options, train),
        "weather": options.weather,
        "clock": options.clock or recording.metadata.get("clock"),
        "software": f"trainlog {__version__}",
        "trip": options.name,
    }
    told = {key: value for key, value in known.items() if value is not None}
    return {**recording.metadata, **profile.metadata, **told}


def _agreed(what: str, told: str | None, given: str | None) -> str | None:
    if told is not None and given is not None and told != given:
        raise InputError(
            f"the profile says {what} '{told}', given is '{given}'",
            remedy=f"give the {what} that was recorded, or correct {what} under [trip]",
        )
    return given or told


def _load(options: TripOptions, train: Train | None) -> str | None:
    """Load [kg] as metadata: given, or the mass less that of the empty train."""
    if options.load is not None:
        load = options.load.si("kg")
    elif options.mass is None:
        return None
    elif train is None:
        raise InputError(
            "the profile gives the mass, but the load needs the empty train's mass too",
            remedy="give the train, or load instead of mass under [trip]",
        )
    else:
        load = options.mass.si("kg") - train.mass
    empty = train.mass if train is not None else np.inf
    if load < 0.0 or load > empty:
        raise InputError(
            f"load {load:.0f} kg is not plausible for a train of {empty:.0f} kg",
            remedy="check value and unit of load or mass under [trip]",
        )
    return f"{float(from_si(load, 'kg', 'kg')):.0f}"
