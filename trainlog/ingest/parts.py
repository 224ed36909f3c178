"""Files that hold several trips: cut by a column that numbers them, by pauses, or by rides.

A pause is a time without rows, or one of standstill, longer than ``limits.pause``. No row is left
out: those of a standstill go to the trips before and behind it. A leap of the clock while the train
moves is no pause, nor is one of more than a year: both are defects of the clock, for
`trainlog.ingest.clock`.

Format ``rides`` is that of the fixes of several devices, cut into trips by a table of rides: a
phone log with a hand-kept list of who rode where, for instance. Each ride that the profile selects
becomes a recording: the fixes of its device from begin to end. What became of every ride is listed
in the attachment ``rides.csv``.
"""

from __future__ import annotations

import io
import re
from collections import Counter
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError, in_file
from trainlog.formats.files import csv_bytes, read_bytes
from trainlog.ingest.mapping import recording_of, undescribed, wanted_columns, words_in
from trainlog.ingest.motion import ENOUGH, POSITION, SHORTEST, STANDING, plane, speed_of
from trainlog.ingest.profile import Profile, RideOptions, TripColumns, problem_of
from trainlog.ingest.recording import (
    NEARLY_ALL,
    NO_TIME,
    Finding,
    Recording,
    Table,
    base_name,
    carried_on,
)
from trainlog.ingest.tabular import open_text
from trainlog.railway.weather import given_condition
from trainlog.topics import RECORDED
from trainlog.units import DAY, NANOSECONDS, to_si

LONGEST_PAUSE = 366 * DAY
"""A longer leap [ns] is that of a clock that was not set."""

CONSTANT = 0.02
"""Relative difference up to which two loads of a trip are the same."""

RIDES_ATTACHMENT = "rides.csv"
"""Attachment that lists what became of every ride."""


def parts_of(recording: Recording, profile: Profile, stem: str) -> list[Recording]:
    """The trips of a recording, each with its number, load and weather among its metadata.

    Parameters
    ----------
    recording : Recording
    profile : Profile
        Its ``[trip.columns]`` name the columns, ``limits.pause`` is the pause [s].
    stem : str
        Before the numbers in the names of the trips.

    Returns
    -------
    list of Recording
        The recording itself, where it holds one trip.
    """
    recording = _oldest_first(recording)
    columns = profile.trip.columns
    if len(recording.tables) != 1 or not len(recording.tables[0]):
        return [recording]
    table = recording.tables[0]
    labels = _labels(recording, columns)
    changes = np.flatnonzero(labels[1:] != labels[:-1]) + 1
    edges = np.concatenate(([0], changes, [labels.size]))
    for first, last in pairwise(edges.tolist()):
        inside = table.take(np.arange(first, last))
        cuts = first + pauses_in(inside, profile.limits.pause)
        edges = np.union1d(edges, cuts)
    spans = list(pairwise(edges.tolist()))
    if len(spans) == 1:
        return [_with_facts(recording, columns, profile.file.decimal, labels)]
    found: list[Recording] = []
    names = _names([str(labels[first]) for first, _ in spans], recording.metadata.get("trip", stem))
    for (first, last), name in zip(spans, names, strict=True):
        rows = np.zeros(len(table), dtype=np.bool_)
        rows[first:last] = True
        part = part_of(recording, rows, {**recording.metadata, "trip": name})
        found.append(_with_facts(part, columns, profile.file.decimal, labels[first:last]))
    return [with_cut_lines(found[0], recording), *found[1:]]


def _oldest_first(recording: Recording) -> Recording:
    """The recording with tables turned round in which the newest row comes first."""
    tables, about = list(recording.tables), recording.about
    for number, table in enumerate(tables):
        steps = np.diff(table.time[table.time != NO_TIME])
        if np.count_nonzero(steps < 0) <= NEARLY_ALL * np.count_nonzero(steps):
            continue
        turned = np.arange(len(table))[::-1]
        tables[number] = table.take(turned)
        if number == 0:
            about = {name: cells[turned] for name, cells in about.items()}
        every = np.ones(len(table), dtype=np.bool_)
        found = table.found("newest_first", every, note="the newest row came first")
        recording = replace(recording, findings=(*recording.findings, *found))
    return replace(recording, tables=tuple(tables), about=about)


def part_of(recording: Recording, rows: BoolArray, metadata: dict[str, str]) -> Recording:
    """The recording of some rows of a table, with what was met in their cells.

    Cut lines, which are no rows, are not in it; see `with_cut_lines`.
    """
    part = recording.tables[0].take(rows)
    raw = tuple(
        item.take(mine)
        for item in recording.raw
        if item.column and (mine := np.isin(item.rows, part.rows)).any()
    )
    findings: list[Finding] = []
    met = {finding.column for finding in recording.findings if finding.column}
    for name, values in part.signals.items():
        column = name if name.startswith(RECORDED) else base_name(name)
        if column not in met:
            continue
        absent = np.isnan(values)
        garbled = [item.rows for item in raw if item.column == name]
        words = np.isin(part.rows, garbled[0]) if garbled else np.zeros_like(absent)
        findings += part.found("empty", absent & ~words, column)
        findings += part.found("not_a_number", absent & words, column)
    about = {name: words[rows] for name, words in recording.about.items()}
    return replace(
        recording, tables=(part,), rows_read=len(part), findings=tuple(findings), raw=raw,
        metadata=metadata, about=about,
    )  # fmt: skip


def with_cut_lines(part: Recording, every: Recording) -> Recording:
    """The part with the lines that are no rows: they belong to no part, and count once."""
    cut = tuple(finding for finding in every.findings if not finding.column)
    return replace(
        part,
        rows_read=part.rows_read + every.rows_read - len(every.tables[0]),
        findings=(*cut, *part.findings),
        raw=(*(item for item in every.raw if not item.column), *part.raw),
    )


def _labels(recording: Recording, columns: TripColumns) -> NDArray[np.object_]:
    """The number of the trip in every row; an empty cell has that of the row before."""
    words = recording.about.get(columns.number or "")
    if words is None:
        return np.full(len(recording.tables[0]), "", dtype=np.object_)
    labels = carried_on(words)
    labels[labels == ""] = words[np.argmax(words != "")]
    return labels


def _names(labels: list[str], stem: str) -> list[str]:
    """A name for each part: of its number, else counted."""
    total, seen, names = Counter(labels), Counter[str](), list[str]()
    for label in labels:
        seen[label] += 1
        own = re.sub(r"[^\w.+-]+", "_", label).strip("_")
        counted = [f"{seen[label]:02d}"] if total[label] > 1 or not own else []
        names.append("-".join([stem, *([own] if own else []), *counted]))
    return names


def pauses_in(table: Table, pause: float) -> IntArray:
    """Rows before which a pause of more than `pause` [s] parts two trips.

    Parameters
    ----------
    table : Table
        Of `n` rows in the order of the file.
    pause : float [s]

    Returns
    -------
    (k,) int64 array
    """
    known = np.flatnonzero(table.time != NO_TIME)
    if known.size < 2 * ENOUGH:
        return np.zeros(0, dtype=np.int64)
    time, speed = table.time[known], speed_of(table)
    longest = int(pause * NANOSECONDS)
    steps = np.diff(time)
    leaps = np.flatnonzero(np.abs(steps) > longest) + 1
    edges = np.concatenate(([0], leaps, [known.size]))
    # A few rows between two leaps are a defect of the clock.
    groups = [(int(first), int(last)) for first, last in pairwise(edges) if last - first >= ENOUGH]
    cuts = []
    for (_, end), (begin, _) in pairwise(groups):
        step = int(time[begin]) - int(time[end - 1])
        stands = speed is None or (
            _stands(speed[: known[end - 1] + 1][::-1]) and _stands(speed[known[begin] :])
        )
        if longest < step < LONGEST_PAUSE and stands:
            cuts.append(int(known[begin]))
    if speed is not None:
        cuts += _standstills(time, speed[known], known, longest)
    return _that_move(table, speed, sorted(set(cuts)))


def _stands(speed: FloatArray) -> bool:
    """Whether the first speeds that are known are those of a train that stands."""
    first = speed[np.isfinite(speed)][:3]
    return not first.size or bool(np.median(first) <= STANDING)


def _standstills(time: IntArray, speed: FloatArray, known: IntArray, longest: int) -> list[int]:
    """The rows in the middle of standstills that last too long."""
    moves = np.flatnonzero(speed > STANDING)
    if moves.size < 2:
        return []
    found = []
    lasts = np.diff(time[moves])
    still = np.flatnonzero((np.diff(moves) > 2) & (lasts > longest) & (lasts < LONGEST_PAUSE))
    for before, after in zip(moves[still].tolist(), moves[still + 1].tolist(), strict=True):
        inside = time[before : after + 1]
        if np.any(np.abs(np.diff(inside)) > longest):
            continue  # a time without rows, which is cut where it is
        middle = int(np.searchsorted(inside, (int(inside[0]) + int(inside[-1])) // 2))
        found.append(int(known[before + max(middle, 1)]))
    return found


def _that_move(table: Table, speed: FloatArray | None, cuts: list[int]) -> IntArray:
    """Of the cuts those that leave a trip on both sides: a part without motion is none."""
    kept: list[int] = []
    start = 0
    for cut in cuts:
        if _moves(table, speed, start, cut):
            kept.append(cut)
            start = cut
    while kept and not _moves(table, speed, kept[-1], len(table)):
        kept.pop()
    return np.array(kept, dtype=np.int64)


def _moves(table: Table, speed: FloatArray | None, first: int, last: int) -> bool:
    position = table.signals.get(POSITION)
    if position is not None and np.isfinite(position[first:last]).any():
        inside = position[first:last]
        low, high = np.nanpercentile(inside, [1.0, 99.0])
        if high - low >= SHORTEST:
            return True
    if speed is None:
        return position is None
    inside = speed[first:last]
    inside = inside[np.isfinite(inside)]
    return bool(inside.size and np.percentile(inside, 95.0) > 4.0 * STANDING)


def _with_facts(
    part: Recording, columns: TripColumns, decimal: str, labels: NDArray[np.object_]
) -> Recording:
    """The part with the number, the load and the weather that its columns state."""
    facts, not_used = dict(part.metadata), dict(part.not_used)
    if labels.size and labels[0]:
        facts["trip_number"] = str(labels[0])
    load = columns.load
    if load is not None and load.column in part.about:
        words = part.about[load.column]
        values = _values(words, decimal)
        if values.size and float(np.ptp(values)) <= CONSTANT * float(np.abs(values).max()):
            facts["load"] = f"{float(to_si(np.median(values), load.unit, 'kg')):.0f}"
        elif values.size:
            span = f"{values.min():g} to {values.max():g} {load.unit}"
            not_used[f"load '{load.column}', which changes within the trip ({span})"] = 1
    weather = columns.weather
    if weather is not None and weather.column in part.about:
        stated = sorted({word for word in part.about[weather.column] if word})
        meant = {weather.words.get(word, word.lower()) for word in stated}
        problems = {
            word: problem_of(given_condition, word) for word in meant - {*weather.words.values()}
        }
        if unknown := [word for word in stated if problems.get(word.lower())]:
            what = f"weather '{weather.column}': {problems[unknown[0].lower()]}"
            not_used[f"{what}; state what {unknown[0]} means under its words"] = 1
        elif len(meant) == 1:
            facts["weather"] = meant.pop()
        elif meant:
            shown = ", ".join(stated[:3])
            not_used[f"weather '{weather.column}', which changes within the trip ({shown})"] = 1
    if columns.stations is not None and columns.stations in part.about:
        cells = [str(word).strip() for word in part.about[columns.stations]]
        passed = [word for word, _ in groupby(word for word in cells if word)]
        if passed:
            facts["stations"] = ", ".join(passed)
    return replace(part, metadata=facts, not_used=not_used)


def _values(words: NDArray[np.object_], decimal: str) -> FloatArray:
    """The numbers among the cells."""
    found = []
    for word in np.unique(words.astype(str)):
        try:
            found.append(float(word.replace(decimal, ".")))
        except ValueError:
            continue
    values = np.array(found)
    return np.asarray(values[np.isfinite(values)])


# ------------------------------------------------------------------ a table of rides


@dataclass(frozen=True)
class _Ride:
    """A ride of the table.

    Attributes
    ----------
    number : int
        Its place in the table, from 1 on.
    begin, end : int [ns]
        As the table gives them, in UTC; `NO_TIME` where one is missing.
    last : int [ns]
        The end, or where the next ride of the same device begins before it.
    cells : dict of str to str
        Its row in the table.
    """

    number: int
    device: str
    begin: int
    end: int
    last: int
    cells: dict[str, str]

    @property
    def overlaps(self) -> bool:
        """Whether the next ride of the same device begins before this one ends."""
        return bool(self.last < self.end)

    def name(self, options: RideOptions) -> str:
        words = " ".join(self.cells[column].strip() for column in options.name)
        return re.sub(r"[^a-z0-9]+", "-", f"ride {self.number:03d} {words}".lower()).strip("-")


def read_rides(path: Path, profile: Profile | None) -> list[Recording]:
    """Read both files, whichever of them is given, and take out the rides.

    Raises
    ------
    InputError
        If the profile does not describe the rides, the other file is not beside the given one, a
        column is missing, or no ride became a recording.
    """
    if profile is None or profile.rides is None or profile.time is None:
        raise undescribed(
            "holds the fixes of several devices, which no profile cuts into rides",
            "with [time] and [rides]",
        )
    options = profile.rides
    places = [path.with_name(name) for name in (options.fixes, options.table)]
    for place in places:
        if not place.is_file():
            raise InputError(
                f"needs {place.name} beside it", remedy="copy both files into one folder"
            )
    with in_file(places[1]):
        table = _table(places[1], options)
    rides = _selected(table, options, profile.time.timezone)
    with in_file(places[0]):
        text = open_text(places[0], profile.file)
        cells = text.cells([*wanted_columns(profile, text.names), options.device])
        fixes, device = recording_of(cells, profile), words_in(cells.table[options.device])
    found: list[Recording] = []
    reasons: list[str] = []
    counts: list[int] = []
    other = places[1] if path.name == options.fixes else places[0]
    for ride in rides:
        mine = _during(ride, fixes.tables[0], device)
        part = fixes.tables[0].take(mine)
        counts.append(len(part))
        reasons.append(_reason_left_out(ride, part, known=ride.device in device, options=options))
        if not reasons[-1]:
            found.append(replace(_recording(ride, part, fixes, options), inputs=(other,)))
    what = f"rides {options.selection}".strip()
    if not found:
        raise InputError(
            f"none of {len(rides)} {what} has fixes that move",
            remedy="are the two files of the same day?",
        )
    lost = Counter(f"{what}: {reason}" for reason in reasons if reason)
    not_used = {f"rides not {options.selection}".strip(): len(table) - len(rides)} | dict(lost)
    attached = {RIDES_ATTACHMENT: _listed(rides, counts, reasons, options)}
    found[0] = with_cut_lines(found[0], fixes)
    return [replace(item, not_used=not_used, attachments=attached) for item in found]


def _table(path: Path, options: RideOptions) -> pd.DataFrame:
    """The table of rides as text, its names without blanks around them; cells may hold lines."""
    try:
        table = pd.read_csv(
            io.BytesIO(read_bytes(path)), dtype=str, keep_default_na=False, skipinitialspace=True
        )
    except (ValueError, pd.errors.ParserError) as error:
        raise InputError(
            f"cannot be split into rows and cells: {str(error).splitlines()[0]}",
            remedy="give the file as published",
        ) from error
    table.columns = table.columns.str.strip()
    for name in options.columns:
        if name not in table.columns:
            raise InputError(f"no column '{name}'", place="row 1", remedy="give it as published")
    return table


def _selected(table: pd.DataFrame, options: RideOptions, timezone: str) -> list[_Ride]:
    """The rides that the profile selects, in the order of the table."""
    chosen = np.ones(len(table), dtype=np.bool_)
    for name, words in options.only.items():
        wanted = [word.upper() for word in words]
        chosen &= table[name].str.strip().str.upper().isin(wanted).to_numpy()
    device = table[options.device].str.strip().to_numpy(dtype=object)[chosen]
    begin, end = (_utc(table[name], timezone)[chosen] for name in (options.begin, options.end))
    # A passenger sits in one vehicle: a ride ends where the next of the same device begins.
    last = end.copy()
    order = np.lexsort((begin, device.astype(str)))
    order = order[begin[order] != NO_TIME]
    before, after = order[:-1], order[1:]
    cut = (device[before] == device[after]) & (begin[after] < end[before])
    last[before[cut]] = begin[after[cut]]
    cells = table.loc[chosen, list(options.columns)].to_dict("records")
    return [
        _Ride(
            int(number) + 1,
            str(device[i]),
            int(begin[i]),
            int(end[i]),
            int(last[i]),
            {str(name): str(cell) for name, cell in cells[i].items()},
        )
        for i, number in enumerate(np.flatnonzero(chosen))
    ]


def _utc(local: pd.Series[str], timezone: str) -> IntArray:
    """UTC of local times [ns]; `NO_TIME` where there is none, or where it cannot be read."""
    naive = pd.to_datetime(local, format="ISO8601", errors="coerce")
    aware = pd.DatetimeIndex(naive).tz_localize(timezone, ambiguous="NaT", nonexistent="NaT")
    return np.asarray(aware.as_unit("ns").asi8)


def _iso(time: int) -> str:
    return pd.Timestamp(time, tz="UTC").isoformat()


def _during(ride: _Ride, fixes: Table, device: NDArray[np.object_]) -> BoolArray:
    """Which fixes are those of a ride's device while it lasted."""
    if NO_TIME in (ride.begin, ride.last):
        return np.zeros(len(fixes), dtype=np.bool_)
    inside = (fixes.time != NO_TIME) & (fixes.time >= ride.begin)
    inside &= fixes.time < ride.last if ride.overlaps else fixes.time <= ride.last
    return np.asarray(inside & (device == ride.device))


def _reason_left_out(ride: _Ride, fixes: Table, *, known: bool, options: RideOptions) -> str:
    """Why a ride is no recording; empty if it is one."""
    if NO_TIME in (ride.begin, ride.end):
        return "departure or arrival is missing"
    if ride.last <= ride.begin:
        return "ends before it begins"
    if not known:
        return "the phone has no fixes"
    if np.unique(fixes.time).size < 2:
        return "fewer than two fixes"
    points, least = plane(fixes), options.least_movement
    fixed = np.zeros(1) if points is None else points[np.isfinite(points)]
    diagonal = np.hypot(np.ptp(fixed.real), np.ptp(fixed.imag))
    if least is not None and diagonal < least.si("m"):
        return "the fixes do not move"
    return ""


def _recording(ride: _Ride, fixes: Table, every: Recording, options: RideOptions) -> Recording:
    """The recording of a ride, with what was met in its cells."""
    metadata = {key: ride.cells[column].strip() for key, column in options.metadata.items()}
    # Words by which rides are selected may be in capitals or not.
    selecting = [key for key, column in options.metadata.items() if column in options.only]
    metadata |= {key: metadata[key].lower() for key in selecting}
    metadata |= {
        "trip": ride.name(options),
        "device": ride.device,
        "departure": _iso(ride.begin),
        "arrival": _iso(ride.end),
    }
    if ride.overlaps:
        metadata["cut_at"] = _iso(ride.last)
    known = {key: text for key, text in metadata.items() if text}
    return part_of(every, np.isin(every.tables[0].rows, fixes.rows), known)


def _listed(
    rides: list[_Ride], counts: list[int], reasons: list[str], options: RideOptions
) -> bytes:
    """What became of every ride, as CSV."""
    shown = pd.DataFrame(
        [
            {
                "ride": ride.number,
                "device": ride.device,
                **{key: ride.cells[column] for key, column in options.metadata.items()},
                "departure": ride.cells[options.begin],
                "arrival": ride.cells[options.end],
                "overlaps_next": int(ride.overlaps),
                "fixes": count,
                "trip": "" if reason else ride.name(options),
                "why_not": reason,
            }
            for ride, count, reason in zip(rides, counts, reasons, strict=True)
        ]
    )
    return csv_bytes(shown)
