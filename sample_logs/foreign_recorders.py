"""What foreign recorders would have written of a simulated trip, with the defects they have.

Two files that users bring: a vehicle recorder's CSV, and the CSV of a u-blox GNSS receiver. They
exist to try the ingest on; the same trip and seed give the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import LogError
from trainlog.formats.files import write_bytes
from trainlog.topics import GNSS_FIX, GNSS_MOTION, TRAIN_AXLES, TRAIN_CONTROLS, TRAIN_STATE
from trainlog.trip import Trip
from trainlog.units import KMH, NANOSECONDS

LOCAL_TIME = "Europe/Zurich"
"""The vehicle recorder's clock; the file does not say so."""

OVERFLOW = 655.35
"""What the vehicle recorder writes for a speed it could not read [km/h]."""

GEOID_HEIGHT = 47.9
"""Height of the sea level above the ellipsoid around St.Gallen [m]."""

UBLOX_HEADER = (
    "Year,Month,Day,Hour,Minute,Second,nSAT,Lon,Lat,Alt1,Alt2,hAcc,vAcc,speed,speedAcc,PDOP,"
)


@dataclass(frozen=True, slots=True)
class Defects:
    """How many defects a recorder's file has.

    Attributes
    ----------
    rows : int
        Lines below the header.
    duplicates : int
        Lines written twice.
    backwards : int
        Lines whose time is before that of the line above.
    missing : int
        Lines without a speed.
    outliers : int
        Lines with a speed that cannot be.
    gaps : int
        Places where at least a second is missing.
    """

    rows: int
    duplicates: int
    backwards: int
    missing: int
    outliers: int
    gaps: int


def write_recorder_csv(trip: Trip, path: str | Path, seed: int = 1) -> Defects:
    """Write what a vehicle's own recorder keeps of a trip.

    Semicolons between the columns, decimal commas, local time without its offset, km/h, kN, the
    lever in per cent, braking efforts negative. A few lines come twice or in the wrong order, some
    have no speed or an impossible one, and 4 s are missing.

    Parameters
    ----------
    trip : Trip
        With the on-board topics.
    path : path
    seed : int
        Of the defects.

    Raises
    ------
    LogError
        If the trip lacks an on-board topic or is shorter than a minute.
    """
    state, controls, axles = (
        trip[topic.name] for topic in (TRAIN_STATE, TRAIN_CONTROLS, TRAIN_AXLES)
    )
    if len(state) < 600:
        raise LogError(
            f"trip '{trip.name}' is too short for a recorder's file with gaps",
            remedy="simulate a longer trip",
        )
    local = pd.DatetimeIndex(state.index).tz_convert(LOCAL_TIME)
    columns = {
        "Date": local.strftime("%d.%m.%Y"),
        "Time": local.strftime("%H:%M:%S.%f").str[:-3],
        "Distance_m": state["position"].round(1),
        "V_kmh": (state["speed"] * KMH).round(2),
        "Lever_pct": (controls["lever"] * 100.0).round(1),
        "F_traction_kN": (controls["tractive_effort"] / 1e3).round(1),
        "F_ebrake_kN": (0.0 - controls["dynamic_braking_effort"] / 1e3).round(1),
        "F_airbrake_kN": (0.0 - controls["pneumatic_braking_effort"] / 1e3).round(1),
    }
    for name in axles.columns:
        axle = name.rpartition("_")[2]
        if name.startswith("wheel_speed"):
            columns[f"V_axle{axle}_kmh"] = (axles[name] * KMH).round(2)
        else:
            columns[f"F_axle{axle}_kN"] = (axles[name] / 1e3).round(1)
    table = pd.DataFrame({name: np.asarray(values) for name, values in columns.items()})
    return _spoilt(table, np.random.default_rng(seed), Path(path))


def _spoilt(table: pd.DataFrame, generator: np.random.Generator, path: Path) -> Defects:
    """Give the vehicle recorder's table its defects and write it."""
    count = len(table)
    lost = int(generator.integers(count // 3, 2 * count // 3))
    usable = np.concatenate((np.arange(20, lost - 3, 3), np.arange(lost + 60, count - 20, 3)))
    places = generator.permutation(usable)
    missing, outliers, twice, swapped = np.split(places[:40], [20, 25, 37])
    speed = table["V_kmh"].to_numpy(copy=True)
    speed[missing] = np.nan
    speed[outliers] = OVERFLOW
    table = table.assign(V_kmh=speed)
    order = np.arange(count, dtype=np.float64)
    order[swapped], order[swapped + 1] = order[swapped + 1].copy(), order[swapped].copy()
    order[lost : lost + 42] = np.nan
    rows = np.concatenate([order, order[twice]])
    rank = np.concatenate([np.arange(count), twice + 0.5])
    rows = rows[np.argsort(rank)]
    rows = rows[~np.isnan(rows)].astype(np.int64)
    text = table.iloc[rows].to_csv(sep=";", decimal=",", index=False, lineterminator="\r\n")
    write_bytes(path, text.encode("latin-1"))
    written = speed[rows]
    step = np.diff(rows)
    return Defects(
        rows=len(rows),
        duplicates=int(np.sum(step == 0)),
        backwards=int(np.sum(step < 0)),
        missing=int(np.sum(np.isnan(written))),
        outliers=int(np.sum(written == OVERFLOW)),
        gaps=int(np.sum(step >= 10)),
    )


def write_ublox_csv(trip: Trip, path: str | Path, seed: int = 1) -> Defects:
    """Write what a u-blox receiver's logger keeps of a trip.

    Five lines a second that give whole seconds only, a comma at the end of each line, longitude
    and latitude in 1e-7 degrees, heights and accuracies in mm, speed in mm/s, PDOP times 100; some
    single speeds are 80 m/s.

    Parameters
    ----------
    trip : Trip
        With satellite fixes.
    path : path
    seed : int
        Of the outliers.

    Raises
    ------
    LogError
        If the trip has no satellite fixes, as on a line whose place on the earth is not known.
    """
    fix, motion = trip[GNSS_FIX.name], trip[GNSS_MOTION.name]
    time = pd.DatetimeIndex(fix.index)
    speed = np.round(motion["speed"].to_numpy() * 1e3)
    generator = np.random.default_rng(seed)
    outliers = generator.choice(len(time), size=max(len(time) // 2000, 1), replace=False)
    speed[outliers] = 80_000.0 + np.round(2_000.0 * generator.standard_normal(outliers.size))
    columns = [
        time.year,
        time.month,
        time.day,
        time.hour,
        time.minute,
        time.second,
        motion["satellites"],
        fix["longitude"] * 1e7,
        fix["latitude"] * 1e7,
        (fix["altitude"] + GEOID_HEIGHT) * 1e3,
        fix["altitude"] * 1e3,
        fix["horizontal_accuracy"] * 1e3,
        fix["vertical_accuracy"] * 1e3,
        speed,
        motion["speed_accuracy"] * 1e3,
        motion["pdop"] * 100.0,
    ]
    whole = [_whole(np.asarray(column, dtype=np.float64)) for column in columns]
    table = pd.DataFrame({**dict(enumerate(whole)), len(whole): ""})
    text = UBLOX_HEADER + "\n" + table.to_csv(header=False, index=False, lineterminator="\n")
    write_bytes(path, text.encode("ascii"))
    return Defects(
        rows=len(table),
        duplicates=0,
        backwards=0,
        missing=0,
        outliers=int(outliers.size),
        gaps=int(np.sum(np.diff(time.as_unit("ns").asi8) >= NANOSECONDS)),
    )


def _whole(values: FloatArray) -> IntArray:
    return np.round(values).astype(np.int64)
