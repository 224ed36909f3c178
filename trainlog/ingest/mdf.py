"""Format ``mdf``: measurement files of ASAM MDF, read by asammdf (extra ``recorders``).

A profile says which channel is what, as it does for the columns of a CSV; a channel of a name that
several groups have is written ``"2:Speed"``, with the number of its group. A column without a unit
takes the channel's own. Groups with clocks of their own become tables of their own, but for those
that hold fields of the same topic: these share a table with the instants of all.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from trainlog.arrays import IntArray
from trainlog.errors import InputError, suggestion
from trainlog.extras import load
from trainlog.formats.trip_tables import called
from trainlog.ingest.mapping import EARLIEST, LATEST, recording_of
from trainlog.ingest.profile import WORDS, Column, MismatchError, Profile
from trainlog.ingest.recording import NO_TIME, Cells, Recording, field_of, together
from trainlog.topics import RECORDED
from trainlog.units import NANOSECONDS, factor, si_unit

UNITS = {
    "°C": "degC",
    "C": "degC",
    "°": "deg",
    "°/s": "deg/s",
    "g": "standard_gravity",
    "m/s2": "m/s^2",
    "m/s²": "m/s^2",
    "kmh": "km/h",
    "km/std": "km/h",
}
"""How measurement files spell units that `trainlog.units` spells otherwise."""

LONGEST = 1e8
"""Time since the start [s], three years, beyond which it is no time."""

Place = tuple[int, int]
"""Number of a group, and of a channel in it."""


def is_mdf(head: bytes) -> bool:
    """Whether a file begins as MDF does; also if it was not finished."""
    return head.startswith((b"MDF     ", b"UnFinMF "))


def read_mdf(path: Path, profile: Profile | None) -> Recording:
    """Read the channels that `profile` maps.

    Raises
    ------
    InputError
        If there is no profile, asammdf is not installed or cannot read the file, a channel is
        missing, or its unit cannot be read.
    """
    if profile is None or not profile.columns:
        raise InputError(
            "is a measurement file whose channels may mean anything",
            file=path,
            remedy="give a profile that says which channel is what; docs/ingest.md has an example",
        )
    with _open(path) as mdf:
        start = _start(mdf, profile, path)
        places = _places(mdf, profile, path)
        every = {
            (group, index): channel.name
            for group, held in enumerate(mdf.groups)
            for index, channel in enumerate(held.channels)
            if mdf.masters_db.get(group) != index
        }
        found = [_recording(mdf, profile, part, start, path) for part in _parts(profile, places)]
    mapped = {place for channels in places.values() for place in channels}
    left = [name for place, name in every.items() if place not in mapped]
    others = f"channels that the profile does not map: {', '.join(left)}"
    return together(found, metadata={"clock": "MDF"}, not_used={others: len(left)} if left else {})


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    """The file as asammdf gives it."""
    library = load("asammdf")
    try:
        stream = path.open("rb")
    except OSError as error:
        raise InputError(
            (error.strerror or str(error)).lower(), file=path, remedy="check the path"
        ) from error
    with stream:
        mdf = called(path, lambda: library.MDF(stream))
        try:
            yield mdf
        finally:
            mdf.close()


def _start(mdf: Any, profile: Profile, path: Path) -> int:
    """Instant of the file's time 0 [ns]."""
    given = profile.time.start if profile.time is not None else None
    start = pd.Timestamp(mdf.header.start_time if given is None else given)
    start = start.tz_localize("UTC") if start.tzinfo is None else start
    if not EARLIEST <= start.value < LATEST:
        raise InputError(
            f"states that it was started at {start}",
            file=path,
            remedy="give the start: [time] column = 'time', format = 'elapsed', start = ...",
        )
    return int(start.value)


def _places(mdf: Any, profile: Profile, path: Path) -> dict[str, list[Place]]:
    """Where the channels of each field are."""
    found: dict[str, list[Place]] = {}
    for name, column in profile.columns.items():
        if column.value is not None:
            continue
        places = [_place(mdf, channel, column.optional, path) for channel in column.names]
        if None not in places:
            found[name] = [place for place in places if place is not None]
    if not found:
        raise InputError("holds none of the channels", file=path, remedy="check [columns]")
    return found


def _place(mdf: Any, channel: str, optional: bool, path: Path) -> Place | None:
    number, mark, plain = channel.partition(":")
    known = mdf.channels_db
    if mark and number.isdigit() and channel not in known:
        among = [place for place in known.get(plain, ()) if place[0] == int(number)]
    else:
        among = list(known.get(channel, ()))
    if len(among) == 1:
        return int(among[0][0]), int(among[0][1])
    if among:
        shown = " or ".join(f"'{group}:{plain or channel}'" for group, _ in among)
        raise InputError(
            f"channel '{channel}' is in {len(among)} groups", file=path, remedy=f"write {shown}"
        )
    if optional:
        return None
    raise MismatchError(
        f"no channel '{channel}'", file=path, remedy=suggestion(channel, known, "channels")
    )


_Part = dict[str, list[Place]]
"""Fields that share a table, and where their channels are."""


def _parts(profile: Profile, places: dict[str, list[Place]]) -> list[_Part]:
    """Fields by table: those of a group together, and those of a topic."""
    parts: list[tuple[set[str], _Part]] = []
    for name, channels in places.items():
        keys = {field_of(name)[0].name, *(f"group {group}" for group, _ in channels)}
        mine = {name: channels}
        apart = []
        for known, fields in parts:
            if known & keys:
                keys |= known
                mine = fields | mine
            else:
                apart.append((known, fields))
        parts = [*apart, (keys, mine)]
    return [
        {name: fields[name] for name in profile.columns if name in fields} for _, fields in parts
    ]


def _recording(mdf: Any, profile: Profile, part: _Part, start: int, path: Path) -> Recording:
    """The recording of the channels of one table."""
    signals: dict[str, Any] = {}
    columns: dict[str, Column] = {
        name: column for name, column in profile.columns.items() if column.value is not None
    }
    for name, places in part.items():
        column = profile.columns[name]
        read = _selected(mdf, places, name in WORDS, path)
        channels = tuple(f"{group}:{index}" for group, index in places)
        signals |= dict(zip(channels, read, strict=True))
        columns[name] = _with_unit(name, column, read[0], channels, path)
    groups = sorted({group for places in part.values() for group, _ in places})
    clocks = {group: _clock(signals, group, start) for group in groups}
    time, rows = _instants(clocks)
    table = pa.table(
        {
            key: _cells(signal, rows[int(key.split(":")[0])], time.size, path)
            for key, signal in signals.items()
        }
    )
    cells = Cells(table, np.arange(1, time.size + 1, dtype=np.int64), time.size)
    mapped = replace(profile, columns=columns, time=None)
    found = recording_of(cells, mapped, path, time)
    # A channel has no value between its own instants: that is no empty cell.
    findings = (
        found.findings
        if len(groups) == 1
        else tuple(finding for finding in found.findings if finding.rule != "empty")
    )
    return replace(found, findings=findings)


def _selected(mdf: Any, places: list[Place], words: bool, path: Path) -> list[Any]:
    """The channels at some places; the numbers of a code, unless it is words that are wanted."""
    wanted = [(None, group, index) for group, index in places]
    return list(called(path, lambda: mdf.select(wanted, ignore_value2text_conversions=not words)))


def _clock(signals: dict[str, Any], group: int, start: int) -> IntArray:
    """Time of a group's samples [ns]; `NO_TIME` where the file holds none."""
    key = next(key for key in signals if key.startswith(f"{group}:"))
    seconds = np.asarray(signals[key].timestamps, dtype=np.float64)
    sane = np.abs(seconds) < LONGEST  # False for NaN
    since = np.round(np.where(sane, seconds, 0.0) * NANOSECONDS).astype(np.int64)
    return np.where(sane, start + since, NO_TIME)


def _instants(clocks: dict[int, IntArray]) -> tuple[IntArray, dict[int, IntArray]]:
    """The instants of a table [ns], and at which of them the samples of each group stand."""
    if len(clocks) == 1:
        ((group, time),) = clocks.items()
        return time, {group: np.arange(time.size, dtype=np.int64)}
    if all(np.all(np.diff(time) > 0) for time in clocks.values()):
        union = np.unique(np.concatenate(list(clocks.values())))
        return union, {group: np.searchsorted(union, time) for group, time in clocks.items()}
    # A clock that stands or runs back: every sample is kept, the rules of repair do the rest.
    every = np.concatenate(list(clocks.values()))
    order = np.argsort(every, kind="stable")
    place = np.empty(every.size, dtype=np.int64)
    place[order] = np.arange(every.size)
    edges = np.cumsum([0, *(time.size for time in clocks.values())])
    return every[order], {
        group: place[a:b] for group, a, b in zip(clocks, edges[:-1], edges[1:], strict=True)
    }


def _cells(signal: Any, rows: IntArray, count: int, path: Path) -> pa.Array:
    """The samples of a channel, put at their instants."""
    samples = np.asarray(signal.samples)
    if samples.ndim != 1 or samples.dtype.fields is not None:
        raise InputError(
            f"channel '{signal.name}' holds {samples.ndim}-dimensional samples",
            file=path,
            remedy="map a channel with one value a sample",
        )
    absent = np.ones(count, dtype=np.bool_)
    absent[rows] = False
    if signal.invalidation_bits is not None:
        absent[rows] = np.asarray(signal.invalidation_bits, dtype=np.bool_)
    if samples.dtype.kind in "SUO":
        text = np.full(count, "", dtype=object)
        text[rows] = [
            word.decode(signal.encoding or "utf-8", "replace") if isinstance(word, bytes) else word
            for word in samples
        ]
        return pa.array(text, pa.string(), mask=absent)
    values = np.zeros(count, dtype=np.float64)
    values[rows] = samples
    return pa.array(values, pa.float64(), mask=absent)


def _with_unit(
    name: str, column: Column, signal: Any, channels: tuple[str, ...], path: Path
) -> Column:
    """The column by the places of its channels, in the channel's own unit if it names none."""
    unit = column.unit
    item = column.field(name)
    if unit is None and name.startswith(RECORDED):
        unit = str(signal.unit or "").strip()
        unit = UNITS.get(unit, unit)
        si_unit(unit)
    elif unit is None and item.unit not in ("", "1"):
        stated = str(signal.unit or "").strip()
        unit = UNITS.get(stated, stated)
        try:
            factor(unit or "1", item.unit)
        except InputError as error:
            raise InputError(
                f"channel '{signal.name}' has the unit '{stated}',"
                f" which does not convert to {item.unit}",
                file=path,
                place=f"field {name}",
                remedy="give its unit in the profile",
            ) from error
    places: dict[str, Any] = {"columns": channels} if column.columns else {"column": channels[0]}
    return replace(column, unit=unit, optional=False, **places)
