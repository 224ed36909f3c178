"""Format ``rides``: the fixes of several devices, cut into trips by a table of rides.

A phone log with a hand-kept list of who rode where, for instance. Each ride that the profile
selects becomes a recording: the fixes of its device from begin to end. What became of every ride is
listed in the attachment ``rides.csv``.
"""

from __future__ import annotations

import io
import re
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from numpy.typing import NDArray

from trainlog.arrays import BoolArray, IntArray
from trainlog.errors import InputError
from trainlog.formats.files import csv_bytes, read_bytes
from trainlog.ingest.mapping import recording_of, wanted_columns
from trainlog.ingest.parts import part_of, with_cut_lines
from trainlog.ingest.profile import Profile, RideOptions
from trainlog.ingest.recording import METRES_PER_DEGREE, NO_TIME, Recording, Table
from trainlog.ingest.tabular import open_text

RIDES_ATTACHMENT = "rides.csv"
"""Attachment that lists what became of every ride."""


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
        raise InputError(
            "holds the fixes of several devices, which no profile cuts into rides",
            file=path,
            remedy="give a profile with [time] and [rides]; docs/ingest.md has an example",
        )
    options = profile.rides
    places = [path.with_name(name) for name in (options.fixes, options.table)]
    for place in places:
        if not place.is_file():
            raise InputError(
                f"needs {place.name} beside it", file=path, remedy="copy both files into one folder"
            )
    table = _table(places[1], options)
    rides = _selected(table, options, profile.time.timezone)
    fixes, device = _fixes(places[0], profile, options)
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
            file=path,
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
            file=path,
            remedy="give the file as published",
        ) from error
    table.columns = table.columns.str.strip()
    for name in options.columns:
        if name not in table.columns:
            raise InputError(
                f"no column '{name}'", file=path, place="row 1", remedy="give it as published"
            )
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


def _fixes(
    path: Path, profile: Profile, options: RideOptions
) -> tuple[Recording, NDArray[np.object_]]:
    """All fixes as one recording, and whose they are."""
    text = open_text(path, profile.file)
    cells = text.cells([*wanted_columns(profile, text.names, path), options.device])
    device = pc.fill_null(pc.utf8_trim_whitespace(cells.table[options.device]), "")
    return recording_of(cells, profile, path), np.asarray(device.to_pylist(), dtype=np.object_)


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
    least = options.least_movement
    if least is not None and _movement(fixes) < least.si("m"):
        return "the fixes do not move"
    return ""


def _movement(fixes: Table) -> float:
    """Diagonal [m] of the rectangle that holds the fixes; NaN if any of them has no place."""
    latitude = fixes.signals["/gnss/fix.latitude"]
    longitude = fixes.signals["/gnss/fix.longitude"]
    east = np.cos(np.radians(np.median(latitude))) * np.ptp(longitude)
    return float(METRES_PER_DEGREE * np.hypot(np.ptp(latitude), east))


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
