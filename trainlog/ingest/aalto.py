"""Format ``aalto``: phone fixes with a hand-kept log of rides (Aalto public-transport dataset).

``device_data.csv`` holds the fixes of several phones, ``manual_log.csv`` beside it the rides of
those who carried them. Each ride by rail (line types SUBWAY, TRAM, TRAIN) becomes a recording: the
fixes of its phone from departure to arrival. Both files tell local time. The fixes have no speed.
What became of every ride by rail is told in the attachment ``rides.csv``.
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from trainlog.errors import InputError
from trainlog.formats.files import read_bytes
from trainlog.ingest.recording import Recording, Table

FIXES, RIDES = "device_data.csv", "manual_log.csv"

TIMEZONE = "Europe/Helsinki"

RAIL = ("SUBWAY", "TRAM", "TRAIN")
"""Line types that run on rails."""

RIDES_ATTACHMENT = "rides.csv"
"""Attachment that tells what became of every ride by rail."""

RADIUS_68 = 1.51
"""Android's accuracy is the radius that holds 68 % of the fixes: 1.51 standard deviations of each
axis where both are normal and alike."""

LEAST_MOVEMENT = 200.0
"""Distance [m] between the furthest fixes of a ride below which the phone told no movement."""

METRES_PER_DEGREE = 111_195.0

NEEDED = {
    FIXES: ("time", "device_id", "lat", "lng", "accuracy"),
    RIDES: (
        "device_id",
        "line_type",
        "line_name",
        "vehicle_dep_time",
        "vehicle_dep_stop",
        "vehicle_arr_time",
        "vehicle_arr_stop",
    ),
}
"""Columns of the two files that are used."""


def is_aalto(head: bytes) -> bool:
    """Whether a file begins as one of the two does."""
    first = head.split(b"\n", 1)[0].decode("latin-1").replace('"', "")
    names = [name.strip() for name in first.removeprefix("ï»¿").split(",")]
    return any(set(needed) <= set(names) for needed in NEEDED.values())


def read_aalto(path: Path, profile: object) -> list[Recording]:  # noqa: ARG001
    """Read both files, whichever of them is given, and take out the rides by rail.

    Raises
    ------
    InputError
        If the other file is not beside it, a column is missing, or no ride became a recording.
    """
    fixes, rides = (_table(path.with_name(name), path) for name in (FIXES, RIDES))
    fixes["ns"] = _utc(fixes["time"])
    fixes["row"] = np.arange(2, len(fixes) + 2)
    account = _account(rides, fixes)
    used = account[account["fate"] == ""]
    if not len(used):
        raise InputError(
            f"none of {len(account)} rides by rail has fixes that move",
            file=path,
            remedy="are the two files of the same day?",
        )
    told = {
        "rides not by rail": int(len(rides) - len(account)),
        **{
            f"rides by rail: {fate}": int(count)
            for fate, count in account["fate"].value_counts(sort=False).items()
            if fate
        },
    }
    attached = {RIDES_ATTACHMENT: _told(account)}
    other = path.with_name(RIDES if path.name == FIXES else FIXES)
    return [_recording(ride, fixes, told, attached, other) for ride in used.itertuples(index=False)]


def _table(path: Path, given: Path) -> pd.DataFrame:
    """One of the two files as text, its names without blanks around them."""
    if not path.is_file():
        raise InputError(
            f"needs {path.name} beside it", file=given, remedy="copy both files into one folder"
        )
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
    for name in NEEDED[path.name]:
        if name not in table.columns:
            raise InputError(
                f"no column '{name}'", file=path, place="row 1", remedy="give it as published"
            )
    return table


def _utc(local: pd.Series[Any]) -> Any:
    """UTC of local times; NaT where there is none, or where it cannot be read."""
    naive = pd.to_datetime(local, format="ISO8601", errors="coerce")
    aware = naive.dt.tz_localize(TIMEZONE, ambiguous="NaT", nonexistent="NaT")
    return aware.dt.tz_convert("UTC").astype("datetime64[ns, UTC]")


def _account(rides: pd.DataFrame, fixes: pd.DataFrame) -> pd.DataFrame:
    """The rides by rail: when, whose, which fixes, and why it is no recording, if it is none."""
    table = rides.assign(
        ride=np.arange(1, len(rides) + 1),
        departure=_utc(rides["vehicle_dep_time"]),
        arrival=_utc(rides["vehicle_arr_time"]),
        kind=rides["line_type"].str.strip().str.upper(),
    )
    table = table[table["kind"].isin(RAIL)].copy()
    # A passenger sits in one vehicle: a ride ends where the next of the same phone begins.
    table = table.sort_values(["device_id", "departure", "ride"], kind="stable")
    following = table.groupby("device_id")["departure"].shift(-1)
    table["overlaps"] = (following < table["arrival"]).to_numpy()
    table["end"] = table["arrival"].where(~table["overlaps"], following)
    table = table.sort_values("ride")
    known = set(fixes["device_id"])
    counts, fates = [], []
    for ride in table.itertuples(index=False):
        mine = _of(ride, fixes)
        counts.append(len(mine))
        fates.append(_fate(ride, mine, known))
    table["fixes"], table["fate"] = counts, fates
    return table


def _of(ride: Any, fixes: pd.DataFrame) -> pd.DataFrame:
    """The fixes of a ride's phone while it lasted."""
    inside = (fixes["ns"] >= ride.departure) & (fixes["ns"] <= ride.end)
    if ride.overlaps:
        inside &= fixes["ns"] < ride.end
    mine: pd.DataFrame = fixes[inside & (fixes["device_id"] == ride.device_id)]
    return mine


def _fate(ride: Any, fixes: pd.DataFrame, known: set[str]) -> str:
    """Why a ride is no recording; empty if it is one."""
    if pd.isna(ride.departure) or pd.isna(ride.arrival):
        return "departure or arrival is missing"
    if ride.end <= ride.departure:
        return "ends before it begins"
    if ride.device_id not in known:
        return "the phone has no fixes"
    if fixes["ns"].nunique() < 2:
        return "fewer than two fixes"
    north, east = _metres(fixes)
    if np.hypot(np.ptp(north), np.ptp(east)) < LEAST_MOVEMENT:
        return "the fixes do not move"
    return ""


def _metres(fixes: pd.DataFrame) -> tuple[Any, Any]:
    latitude = pd.to_numeric(fixes["lat"], errors="coerce").to_numpy(dtype=float)
    longitude = pd.to_numeric(fixes["lng"], errors="coerce").to_numpy(dtype=float)
    east = METRES_PER_DEGREE * np.cos(np.radians(np.nanmedian(latitude)))
    return METRES_PER_DEGREE * latitude, east * longitude


def _name(ride: Any) -> str:
    words = f"ride {ride.ride:03d} {ride.kind} {ride.line_name}".lower()
    return re.sub(r"[^a-z0-9]+", "-", words).strip("-")


def _told(account: pd.DataFrame) -> bytes:
    """What became of every ride by rail, as CSV."""
    shown = pd.DataFrame(
        {
            "ride": account["ride"],
            "device": account["device_id"],
            "kind": account["kind"],
            "line": account["line_name"],
            "departure": account["vehicle_dep_time"],
            "from": account["vehicle_dep_stop"],
            "arrival": account["vehicle_arr_time"],
            "to": account["vehicle_arr_stop"],
            "overlaps_next": account["overlaps"].astype(int),
            "fixes": account["fixes"],
            "trip": ["" if ride.fate else _name(ride) for ride in account.itertuples(index=False)],
            "why_not": account["fate"],
        }
    )
    return shown.to_csv(index=False, lineterminator="\n").encode()


def _recording(
    ride: Any, fixes: pd.DataFrame, told: dict[str, int], attached: dict[str, bytes], other: Path
) -> Recording:
    mine = _of(ride, fixes)
    signals = {
        "/gnss/fix.latitude": mine["lat"],
        "/gnss/fix.longitude": mine["lng"],
        "/gnss/fix.horizontal_accuracy": mine["accuracy"],
    }
    values = {
        name: pd.to_numeric(column, errors="coerce").to_numpy(dtype=np.float64)
        for name, column in signals.items()
    }
    values["/gnss/fix.horizontal_accuracy"] = values["/gnss/fix.horizontal_accuracy"] / RADIUS_68
    time = pd.DatetimeIndex(mine["ns"]).as_unit("ns").asi8
    table = Table(np.asarray(time), mine["row"].to_numpy(dtype=np.int64), values)
    metadata = {
        "trip": _name(ride),
        "clock": f"phone, {TIMEZONE}",
        "device": str(ride.device_id),
        "vehicle": str(ride.kind).lower(),
        "service": str(ride.line_name),
        "from": str(ride.vehicle_dep_stop),
        "to": str(ride.vehicle_arr_stop),
        "departure": ride.departure.isoformat(),
        "arrival": ride.arrival.isoformat(),
    }
    if ride.overlaps:
        metadata["cut_at"] = ride.end.isoformat()
    metadata = {name: text for name, text in metadata.items() if text}
    return Recording((table,), len(table), (), {}, metadata, told, (other,), attached)
