"""From a recorded file to a trip: read, repair, name, estimate."""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from trainlog import __version__
from trainlog.declaration import content_of
from trainlog.errors import InputError, TrainlogError, in_file
from trainlog.formats.files import read_bytes, sha256, sha256_of
from trainlog.formats.railway import line_to_bytes, train_to_bytes
from trainlog.identity import source_of
from trainlog.ingest.chainage import (
    TWO_TRIPS,
    AgainstLineError,
    Estimate,
    estimated_state,
    position_offset,
)
from trainlog.ingest.matching import placed
from trainlog.ingest.motion import (
    FAR,
    GNSS_SPEED,
    MARGIN,
    POSITION,
    SPEED,
    suspect_efforts,
    unlike_a_train,
)
from trainlog.ingest.parts import parts_of
from trainlog.ingest.profile import (
    Limit,
    Limits,
    MismatchError,
    Profile,
    Quantity,
    TripOptions,
    default_profile,
    own_topics,
    parse_profile,
)
from trainlog.ingest.receiver import judged_alone
from trainlog.ingest.recording import (
    REPAIRS_ATTACHMENT,
    SHOWN_ROWS,
    Finding,
    Recording,
    Repairs,
    Report,
    Table,
    field_of,
    frames,
)
from trainlog.ingest.registry import Format, format_called, format_of, is_registered, own_profile
from trainlog.ingest.routes import (
    NETWORK_INPUT,
    NetworkRoutes,
    OnRoute,
    on_numbered_lines,
    routed,
    routes_of,
)
from trainlog.ingest.rules import changes, refuse_switched_off, repaired
from trainlog.progress import note
from trainlog.railway.line import Line, km_words
from trainlog.railway.network import Network
from trainlog.railway.train import Train, check_load
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip
from trainlog.version import code_version

PROFILE_ATTACHMENT = "profile.toml"
"""Attachment that holds the profile file a recording was read with."""

PROFILE_OBJECT_ATTACHMENT = "profile.json"
"""The same, where the profile was no file but a `Profile`."""

Direction = Literal["forward", "reverse"]

FALLS = "; the recorded distance falls: if these are the line's kilometres, give --reverse"
"""Said beside a direction that is assumed."""


def ingest(
    path: str | Path,
    profile: str | Path | Profile | None = None,
    *,
    format: str | None = None,
    line: Line | None = None,
    train: Train | None = None,
    direction: Direction | None = None,
    metadata: Mapping[str, str] | None = None,
    network: Network | NetworkRoutes | None = None,
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
        Along the line as given; default: what the profile says, else as the fixes run, else
        forward.
    metadata : mapping of str to str, optional
        Further metadata, stronger than the profile's; ``stations``: places of the route with
        commas between them.
    network : Network, optional
        In place of a line: the route is found in it, and its line attached to the trip.

    Returns
    -------
    Trip
        In SI units, time in UTC; metadata and the provenance step ``"ingest"`` state what was
        read, kept and repaired.

    Raises
    ------
    InputError
        If the file cannot be used, with row and column where they are known and a remedy; or if
        it holds several recordings, see `ingest_each`.

    Examples
    --------
    >>> import trainlog
    >>> from trainlog.ingest import report_of
    >>> profile = "sample_logs/recorder.profile.toml"
    >>> trip = trainlog.read_recording("sample_logs/recorder.csv", profile=profile)
    >>> list(trip.topics)
    ['/train/state', '/train/controls', '/train/axles']
    >>> report_of(trip).lines()[0]
    '14103 rows read, 14091 kept, 12 dropped'
    """
    given = Given(profile, format, line, train, direction, metadata, routes_of(network))
    source, jobs = _jobs(path, given)
    if len(jobs) > 1:
        names = [job.name for job in jobs]
        shown = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        raise InputError(
            f"holds {len(names)} recordings: {shown}",
            file=source.path,
            remedy="take them one by one with ingest_each, or with the command trainlog ingest",
        )
    return _finished(source, jobs[0], given)


def ingest_each(
    path: str | Path,
    profile: str | Path | Profile | None = None,
    *,
    format: str | None = None,
    line: Line | None = None,
    train: Train | None = None,
    direction: Direction | None = None,
    metadata: Mapping[str, str] | None = None,
    network: Network | NetworkRoutes | None = None,
) -> Iterator[Trip]:
    """Turn every recording of a file into a trip: the rides of a phone log, the tracks of a GPX.

    Parameters are those of `ingest`. Recordings that cannot be used do not keep the others from
    becoming trips; they are reported when all others have been handed over.

    Yields
    ------
    Trip
        In the order of the file. Where there are several, each is named after its recording.

    Raises
    ------
    InputError
        If the file cannot be used, or, after the last trip, if some of its recordings cannot.

    Examples
    --------
    >>> [trip.name for trip in ingest_each("sample_logs/gnss.csv")]
    ['gnss']
    """
    count, refused = 0, list[TrainlogError]()
    given = Given(profile, format, line, train, direction, metadata, routes_of(network))
    for _, outcome in ingested(path, given):
        count += 1
        if isinstance(outcome, Trip):
            yield outcome
        else:
            refused.append(outcome)
    if len(refused) == 1 and count == 1:
        raise refused[0]
    if refused:
        raise InputError(
            f"{len(refused)} of {count} recordings became no trip, the first: {refused[0].problem}",
            file=path,
            place=refused[0].place,
            remedy=refused[0].remedy,
        )


@dataclass(frozen=True, eq=False)
class Given:
    """What is given beside a recorded file; the attributes are the parameters of `ingest`."""

    profile: str | Path | Profile | None = None
    format: str | None = None
    line: Line | None = None
    train: Train | None = None
    direction: Direction | None = None
    metadata: Mapping[str, str] | None = None
    network: NetworkRoutes | None = None

    def __post_init__(self) -> None:
        if self.network is not None and (self.line is not None or self.direction is not None):
            what = "line" if self.line is not None else "direction"
            raise InputError(
                f"a network and a {what} are given: a trip has the line, and the direction, of its"
                " route",
                remedy=f"leave out the {what}, or the network",
            )

    @property
    def options(self) -> dict[str, Any]:
        """What the provenance of a trip keeps of it; files are among its inputs."""
        known: dict[str, Any] = {"direction": self.direction, "metadata": dict(self.metadata or {})}
        if self.network is not None and self.network.stations:
            known["stations"] = list(self.network.stations)
        return known


def check_given(given: Given) -> None:
    """Refuse a profile or the name of a format that no file could be read with.

    Raises
    ------
    InputError
    """
    profile_of(given.profile)
    if given.format is not None:
        format_called(given.format)


def ingested(path: str | Path, given: Given) -> Iterator[tuple[str, Trip | TrainlogError]]:
    """Every recording of a file by name, as a trip or as the reason why it becomes none.

    A file of one recording gives one entry, whose name is empty.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    source, jobs = _jobs(path, given)
    for job in jobs:
        name = job.name if len(jobs) > 1 else ""
        note(f"repairing {name or source.path.name}")
        try:
            yield name, _finished(source, job, given)
        except TrainlogError as error:
            yield name, error


@dataclass(frozen=True, eq=False)
class _Job:
    """A recording that becomes a trip, with its route in a network, or why it has none."""

    recording: Recording
    route: OnRoute | TrainlogError | None = None

    @property
    def name(self) -> str:
        return self.recording.metadata.get("trip", "")


def _jobs(path: str | Path, given: Given) -> tuple[_Source, list[_Job]]:
    """What a file holds, cut where routes end.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    source = _opened(path, given.profile, given.format)
    if given.network is None:
        return source, [_Job(recording) for recording in source.recordings]
    jobs = list[_Job]()
    for recording in source.recordings:
        note(f"looking for the route of {recording.metadata.get('trip') or source.path.name}")
        try:
            jobs += _routed(source, recording, given)
        except TrainlogError as error:
            jobs.append(_Job(recording, error))
    return replace(source, recordings=tuple(job.recording for job in jobs)), jobs


def _routed(source: _Source, recording: Recording, given: Given) -> list[_Job]:
    """The parts of a recording, each with its route.

    Raises
    ------
    InputError
        If nothing shows a route.
    """
    assert given.network is not None
    profile = source.profile or source.chosen.profile or default_profile()
    numbered = on_numbered_lines(given.network, recording, profile.trip.columns.line)
    if numbered is not None:
        return [_Job(*numbered)]
    limits = bounded_limits(profile.limits, None, given.train)
    least = 2 if len(recording.tables) == 1 else 0
    tables = [repaired(each, limits, profile.repair, least)[0] for each in recording.tables]
    trip = Trip(_topics(recording, profile, tables), {})
    stem = recording.metadata.get("trip", source.path.stem)
    found = routed(given.network, recording, tables, trip, given.metadata or {}, stem)
    return [_Job(*each) for each in found]


def fingerprint(path: Path, given: Given) -> dict[str, Any] | None:
    """What a trip of this file would state of its making, found without reading rows.

    Returns
    -------
    dict or None
        The entries ``software``, ``code``, ``format``, ``options`` of the provenance step
        ``"ingest"``, and of ``inputs`` those that are known: the file, the profile, line and
        train. None if the format comes from another package, whose version is not known.

    Raises
    ------
    InputError
        If the file cannot be read, or is of no known format.
    """
    _, rules, carried, chosen = _chosen(path, given.profile, given.format)
    if is_registered(chosen):
        return None
    return _making(chosen, rules, given, [path], carried | attachments_of(given.line, given.train))


def _making(
    chosen: Format,
    rules: Profile | None,
    given: Given,
    files: Sequence[Path],
    attachments: Mapping[str, bytes],
) -> dict[str, Any]:
    """How a trip is made of files, as its provenance states it."""
    digests = {file.name: sha256_of(file) for file in files}
    digests |= {name: sha256(data) for name, data in attachments.items()}
    if given.network is not None:
        # The route's line follows from the network and the recording.
        digests.pop(LINE_ATTACHMENT, None)
        digests[NETWORK_INPUT] = given.network.sha256
    return {
        "software": f"trainlog {__version__}",
        "code": code_version(),
        "format": chosen.name,
        "profile": rules.name if rules else None,
        "options": given.options,
        "inputs": digests,
    }


@dataclass(frozen=True, eq=False)
class _Source:
    """A recorded file that has been read, and how."""

    path: Path
    chosen: Format
    profile: Profile | None
    carried: dict[str, bytes]
    recordings: tuple[Recording, ...]


def _opened(path: str | Path, profile: str | Path | Profile | None, format: str | None) -> _Source:
    """Read what a file holds.

    Raises
    ------
    InputError
        If it cannot be read as its format, or holds no recording.
    """
    source = Path(path)
    profile, rules, carried, chosen = _chosen(source, profile, format)
    with in_file(source):
        try:
            read = chosen.read(source, rules)
        except MismatchError as error:
            if profile is None or isinstance(profile, Profile):
                raise
            remedy = "; ".join(filter(None, [error.remedy, f"correct the profile {profile}"]))
            raise InputError(error.problem, place=error.place, remedy=remedy) from error
    recordings = (read,) if isinstance(read, Recording) else tuple(read)
    options = rules or chosen.profile or default_profile()
    recordings = tuple(
        part for recording in recordings for part in parts_of(recording, options, source.stem)
    )
    if not recordings:
        raise InputError(
            "has no recording", file=source, remedy="was the recorder stopped at once?"
        )
    if chosen.layout == "own" and rules is not None:
        idle = {"[time]": int(rules.time is not None), "[columns]": len(rules.columns)}
        unused = {
            f"{section} of the profile, format '{chosen.name}' has its own": count
            for section, count in idle.items()
            if count
        }
        recordings = tuple(replace(item, not_used=item.not_used | unused) for item in recordings)
    return _Source(source, chosen, rules, carried, recordings)


def _chosen(
    path: Path, profile: str | Path | Profile | None, format: str | None
) -> tuple[str | Path | Profile | None, Profile | None, dict[str, bytes], Format]:
    """The profile as given or the user's own, read, its attachment, and the format of a file."""
    if profile is None and format is None:
        profile = own_profile(path)
    rules, carried = profile_of(profile)
    chosen = format_of(path, format or (rules.file.format if rules else None))
    return profile, rules, carried, chosen


def _finished(source: _Source, job: _Job, given: Given) -> Trip:
    """The trip of a recording, with what is known of its files."""
    recording, metadata = job.recording, given.metadata or {}
    line, direction, facts = given.line, given.direction, dict[str, str]()
    with in_file(source.path):
        if isinstance(job.route, TrainlogError):
            raise job.route
        if job.route is not None:
            line, direction, facts = job.route.line, "forward", job.route.metadata
        profile = source.profile or source.chosen.profile or default_profile()
        start = facts.pop("start_position", None)
        profile = _with_start(profile, metadata.get("start_position", start))
        trip, report, raw = _trip(recording, profile, line, given.train, direction)
        if job.route is not None:
            trip.metadata.pop("direction_evidence", None)  # the route's, not the line's
        if line is not None:
            _check_on_line(trip, line)
        stated = {**trip.metadata, **metadata}.get("load")
        if stated is not None:
            _check_stated_load(stated, given.train)
    named = {"trip": source.path.stem} | trip.metadata | facts | dict(metadata) | report.metadata()
    which: dict[str, Any] = {}
    if len(source.recordings) > 1:
        which["recording"] = named["trip"] = recording.metadata["trip"]
        which["recordings"] = len(source.recordings)
    attachments = source.carried | trip.attachments
    files = source.path, *recording.inputs
    making = _making(source.chosen, source.profile, given, files, attachments)
    digests = [making["inputs"][file.name] for file in files]
    return Trip(trip.topics, named, (), attachments | recording.attachments | raw).with_step(
        "ingest",
        **making,
        source=source_of(digests, which.get("recording", "")),
        report=report.details(),
        **which,
    )


def _check_on_line(trip: Trip, line: Line) -> None:
    """Refuse a line that the recorded positions run out of."""
    for topic in ("/train/state", "/estimates/state"):
        if topic not in trip:
            continue
        low, high = trip[topic]["position"].agg(["min", "max"])
        ends = (-low, low, 0.0, "begins"), (high - line.length, high, line.length, "ends")
        for beyond, furthest, end, words in ends:
            if not beyond > FAR:
                continue
            reached = f"km {furthest / 1e3:.3f}"
            if line.reference is not None:
                reached = f"{beyond / 1e3:.3f} km further"
            raise InputError(
                f"positions reach {reached}, line '{line.name}' {words} at {km_words(line, end)}",
                remedy="give the line it was driven on, or check the unit of the position; if the"
                " counter starts elsewhere than the line, give start_position under [trip] of the"
                " profile, or --set start_position=0.2km (or =stations: where the stops match)",
            )


def _with_start(profile: Profile, stated: str | None) -> Profile:
    """The profile with the start position [m] that is given, or ``"stations"``."""
    if stated is None:
        return profile
    start: Quantity | Literal["stations"] = "stations"
    if stated != "stations":
        start = Quantity(value=float(stated), unit="m")
    return replace(profile, trip=replace(profile.trip, start_position=start))


def _check_stated_load(stated: str, train: Train | None) -> None:
    """Refuse a load [kg] among the metadata that cannot be meant."""
    try:
        load = float(stated)
    except ValueError:
        load = np.nan
    if not np.isfinite(load):
        raise InputError(f"load '{stated}' is not a valid load", remedy="give it in kg, 0 or more")
    check_load(load, train)


def profile_of(profile: str | Path | Profile | None) -> tuple[Profile | None, dict[str, bytes]]:
    """The profile, and the attachment that carries it along."""
    if profile is None:
        return None, {}
    if isinstance(profile, Profile):
        content = content_of(profile)
        text = json.dumps(content, ensure_ascii=False, indent=1, default=_written_moment)
        return profile, {PROFILE_OBJECT_ATTACHMENT: text.encode()}
    data = read_bytes(profile)
    return parse_profile(data, file=profile), {PROFILE_ATTACHMENT: data}


def _written_moment(moment: datetime.date) -> str:
    return moment.isoformat().replace("+00:00", "Z")


def _trip(
    recording: Recording,
    profile: Profile,
    line: Line | None,
    train: Train | None,
    direction: Direction | None,
) -> tuple[Trip, Report, dict[str, bytes]]:
    """The trip, without what is known of its files, the report, and the raw values."""
    refuse_switched_off(recording.findings, profile.repair)
    findings = list(recording.findings)
    limits = bounded_limits(profile.limits, line, train)
    tables: list[Table] = []
    least = 2 if len(recording.tables) == 1 else 0
    repairs = Repairs()
    repairs.add(0, recording.raw)
    for number, table in enumerate(recording.tables):
        kept, found, changed = repaired(table, limits, profile.repair, least)
        if (line is None or line.geometry is None) and profile.repair.contradicted:
            judged, beside = judged_alone(kept)
            changed += changes("contradicted", kept, judged)
            kept, found = judged, found + beside
        repairs.add(number, changed)
        tables.append(_from_start(kept, profile.trip.start_position))
        findings += found
    trip = Trip(_topics(recording, profile, tables), {})
    stated = direction or profile.trip.direction
    place = None
    if line is not None and "/gnss/fix" not in trip and len(tables) == 1:
        by_stations = profile.trip.start_position == "stations"
        place = placed(tables[0], line, train, stated, by_stations=by_stations)
        if by_stations and place.start is not None:
            tables[0] = _from_start(tables[0], Quantity(value=place.start, unit="m"))
            trip = Trip(_topics(recording, profile, tables), {})
        if stated and place.direction not in ("", stated):
            note_of = f"'{stated}' is stated, but {place.evidence}"
            findings.append(Finding("direction", 1, (), "", note_of))
        driven: Direction = "reverse" if place.direction == "reverse" else "forward"
        stated = stated or driven
    heading, estimate = _estimated(trip, line, recording, profile, stated)
    findings += estimate.findings
    if estimate.frame is not None and profile.repair.position_offset:
        before = list(tables)
        for number, table in enumerate(before):
            tables[number], found = position_offset(table, estimate.frame)
            repairs.add(number, changes("position_offset", table, tables[number]))
            findings += found
        if any(new is not old for new, old in zip(tables, before, strict=True)):
            trip = Trip(_topics(recording, profile, tables), {})
    if profile.repair.unit_suspected:
        findings += suspect_efforts(trip, train)
    if estimate.frame is not None:
        trip = trip.with_topic(estimate.frame)
    trip.metadata.update(metadata_of(recording, profile, line, train, heading))
    trip.metadata.update(estimate.metadata)
    if place is not None:
        falls = POSITION in profile.columns and profile.columns[POSITION].sign == -1
        against = line is not None and line.kilometre(0.0) < line.kilometre(line.length)
        trip.metadata["direction_evidence"] = place.evidence + FALLS * bool(
            falls and against and "assumed" in place.evidence
        )
    doubtful = unlike_a_train(tables)
    if doubtful:
        trip.metadata["motion_evidence"] = doubtful
    trip.metadata["start"] = trip.start.isoformat()
    trip.attachments.update(attachments_of(line, train))
    kept_rows = sum(len(table) for table in tables)
    report = Report(
        recording.rows_read,
        kept_rows,
        _joined(findings),
        profile.repair.switched_off,
        recording.not_used,
        len(repairs),
        repairs.beyond,
    )
    raw = {REPAIRS_ATTACHMENT: repairs.to_bytes()} if len(repairs) else {}
    return trip, report, raw


def _topics(recording: Recording, profile: Profile, tables: list[Table]) -> dict[str, pd.DataFrame]:
    """The frames of the repaired tables.

    Raises
    ------
    InputError
        If nothing is left.
    """
    topics = frames(
        [table for table in tables if len(table)], recording.constants, own_topics(profile.columns)
    )
    if not topics:
        raise InputError(
            f"nothing is left of {recording.rows_read} rows after repair",
            remedy="look at [limits] and at the units of the columns in the profile",
        )
    return topics


def _estimated(
    trip: Trip, line: Line | None, recording: Recording, profile: Profile, stated: Direction | None
) -> tuple[Direction, Estimate]:
    """The direction of a trip and its estimated state; fixes give a direction that none states."""
    travelled = line.reversed() if line is not None and stated == "reverse" else line
    try:
        return stated or "forward", estimated_state(trip, travelled, profile, recording.unplaced)
    except AgainstLineError:
        if line is None or stated is not None or not profile.repair.direction:
            raise
    try:
        estimate = estimated_state(trip, line.reversed(), profile, recording.unplaced)
    except AgainstLineError as error:
        raise InputError(
            "the fixes run along the line in both directions",
            remedy=TWO_TRIPS,
        ) from error
    found = Finding(
        "direction", 1, (), "", "'reverse': the fixes run so, and no direction is given"
    )
    return "reverse", replace(estimate, findings=(found, *estimate.findings))


def _joined(findings: list[Finding]) -> tuple[Finding, ...]:
    """Findings of the same rule and column as one: the axles of a field, several tables."""
    joined: dict[tuple[str, str], Finding] = {}
    for finding in findings:
        key = (finding.rule, finding.column)
        before = joined.get(key)
        if before is None:
            joined[key] = finding
        else:
            rows = tuple(sorted({*before.rows, *finding.rows})[:SHOWN_ROWS])
            note = before.note or finding.note
            joined[key] = Finding(*key[:1], before.count + finding.count, rows, key[1], note)
    return tuple(joined.values())


def bounded_limits(limits: Limits, line: Line | None, train: Train | None) -> Limits:
    """The profile's limits; speeds bounded by what line and train allow where it gives none.

    The line's direction in which the train may run faster counts: which one it ran in is found
    from the speeds that are kept.
    """
    allowed = [line.highest_limit] if line is not None else []
    allowed += [train.max_speed] if train is not None else []
    if not allowed:
        return limits
    fastest = MARGIN * min(allowed)
    bounded = {}
    for name in (SPEED, GNSS_SPEED):
        item = field_of(name)[2]
        usual = item.bounds
        bounded[name] = Limit(
            unit=item.unit, min=usual.low, max=fastest, rate=usual.rate, tolerance=usual.tolerance
        )
    return replace(limits, columns=bounded | limits.columns)


def _from_start(table: Table, start: Quantity | str | None) -> Table:
    """The table with its position counted so that the first is the profile's start position."""
    position = table.signals.get(POSITION)
    if not isinstance(start, Quantity) or position is None or not np.isfinite(position).any():
        return table
    first = position[np.isfinite(position)][0]
    moved = position - first + start.si("m")
    return replace(table, signals={**table.signals, POSITION: moved})


def attachments_of(line: Line | None, train: Train | None) -> dict[str, bytes]:
    """The attachments that carry line and train along."""
    found = {}
    if line is not None:
        found[LINE_ATTACHMENT] = line_to_bytes(line)
    if train is not None:
        found[TRAIN_ATTACHMENT] = train_to_bytes(train)
    return found


def metadata_of(
    recording: Recording, profile: Profile, line: Line | None, train: Train | None, heading: str
) -> dict[str, str]:
    """What is known of the trip but for its files and its report."""
    options = profile.trip
    own = recording.metadata.get("line") if "journey" in recording.metadata else None
    if own is not None and line is not None and line.name != own:
        raise InputError(
            f"its positions count along the journey's line '{own}', given is '{line.name}'",
            remedy="leave the line out, or give that of the journey",
        )
    known = {
        "train": _agreed("train", options.train, train.name if train else None),
        "line": _agreed("line", options.line, line.name if line else None),
        "direction": heading,
        "load": _load(options, train),
        "weather": options.weather,
        "clock": profile.clock or recording.metadata.get("clock"),
        "software": f"trainlog {__version__}",
        "trip": options.name,
    }
    stated = {key: value for key, value in known.items() if value is not None}
    messages = profile.columns.get("/events.message")
    if messages is not None and messages.slip_protection:
        stated["slip_protection"] = "events"
    return {**recording.metadata, **profile.stated, **stated}


def _agreed(what: str, stated: str | None, given: str | None) -> str | None:
    if stated is not None and given is not None and stated != given:
        raise InputError(
            f"the profile states {what} '{stated}', given is '{given}'",
            remedy=f"give the {what} that was recorded, or correct {what} under [trip]",
        )
    return given or stated


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
    check_load(load, train)
    return f"{load:.0f}"
