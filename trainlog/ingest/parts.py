"""Files that hold several trips: cut by a column that numbers them, and by pauses.

A pause is a time without rows, or one of standstill, longer than ``limits.pause``. No row is left
out: those of a standstill go to the trips before and behind it. A leap of the clock while the train
moves is no pause, nor is one of more than a year: both are defects of the clock, for
`trainlog.ingest.clock`.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from itertools import groupby, pairwise

import numpy as np
from numpy.typing import NDArray

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.ingest.motion import ENOUGH, POSITION, SHORTEST, STANDING, speed_of
from trainlog.ingest.profile import Profile, TripColumns, problem_of
from trainlog.ingest.recording import NEARLY_ALL, NO_TIME, Finding, Recording, Table, base_name
from trainlog.railway.weather import given_condition
from trainlog.topics import RECORDED
from trainlog.units import DAY, NANOSECONDS, to_si

LONGEST_PAUSE = 366 * DAY
"""A longer leap [ns] is that of a clock that was not set."""

CONSTANT = 0.02
"""Relative difference up to which two loads of a trip are the same."""


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
    edges = _edges(labels)
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
    count = len(recording.tables[0])
    words = recording.about.get(columns.number or "")
    if words is None:
        return np.full(count, "", dtype=np.object_)
    filled = words != ""
    if not filled.any():
        return words
    last = np.maximum.accumulate(np.where(filled, np.arange(count), -1))
    return np.asarray(words[np.where(last < 0, int(np.argmax(filled)), last)])


def _edges(labels: NDArray[np.object_]) -> IntArray:
    """Where the blocks of equal labels begin, and the end."""
    changes = np.flatnonzero(labels[1:] != labels[:-1]) + 1
    return np.concatenate(([0], changes, [labels.size])).astype(np.int64)


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
