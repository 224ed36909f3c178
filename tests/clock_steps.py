"""Recordings of simulated trips in eight layouts, whose clock is set while they run.

A pure function of line, layout and step. The motion comes from `simulate`, the errors of the
receiver last half a minute: neither is known to what finds the steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from recorder_files import MTK_HEADER, START, Drive, gpx_text, nmea_lines
from simulated_line import hilly_line

from trainlog import DEFAULT_LINE, DEFAULT_TRAIN, draw_scenarios, read_line, read_train, sample
from trainlog.ingest import Profile, profile_of
from trainlog.railway import Line
from trainlog.simulation import simulate

SECOND = 1_000_000_000
BEGIN = 120.0
"""Time of the trip [s] at which the recordings begin."""

LINES: dict[str, Callable[[], Line]] = {
    "StGallen-Wil": lambda: read_line(sample(DEFAULT_LINE)),
    "Chemnitz-Cranzahl": lambda: read_line(sample("DE_Chemnitz_Cranzahl.line.json")),
    "hilly": hilly_line,
}


@cache
def motion(line: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], speed [m/s] and position [m] of a simulated trip, ten a second."""
    scenario = draw_scenarios(LINES[line](), read_train(sample(DEFAULT_TRAIN)), count=1, seed=11)[0]
    truth = simulate(scenario)["/truth"]
    seconds = (truth.index.as_unit("ns").asi8 - truth.index.as_unit("ns").asi8[0]) / SECOND
    at = np.arange(0.0, seconds[-1], 0.1)
    speed = np.interp(at, seconds, truth["speed"].to_numpy())
    position = np.interp(at, seconds, truth["position"].to_numpy())
    return at, speed, position - position[0]


def lasting(rng: np.random.Generator, size: int, rate: float, std: float) -> np.ndarray:
    """Errors that last for half a minute."""
    keep = np.exp(-1.0 / (30.0 * rate))
    white = rng.normal(0.0, std * np.sqrt(1.0 - keep**2), size)
    out = np.empty(size)
    out[0] = rng.normal(0.0, std)
    for i in range(1, size):
        out[i] = keep * out[i - 1] + white[i]
    return out


def drive(line: str, rate: float, count: int, begin: float = BEGIN) -> Drive:
    """What a receiver gives of the trip, `rate` fixes a second, and when that was."""
    rng = np.random.default_rng(5)
    at, speed, position = motion(line)
    seconds = begin + np.arange(count) / rate
    along = np.interp(seconds, at, position) + lasting(rng, count, rate, 2.0)
    along += rng.normal(0.0, 0.2, count)
    beside = lasting(rng, count, rate, 2.0)
    heading = 0.6 + along / 9e3
    north = np.cumsum(np.diff(along, prepend=along[0]) * np.cos(heading)) + beside
    east = np.cumsum(np.diff(along, prepend=along[0]) * np.sin(heading))
    start = pd.Timestamp("2024-05-01T06:00:00Z").value
    return Drive(
        start + np.round(seconds * SECOND).astype(np.int64),
        np.round(47.4 + north / 111_195.0, 7),
        np.round(9.3 + east / 75_300.0, 7),
        np.round(600.0 + lasting(rng, count, rate, 4.0), 3),
        np.round(np.abs(np.interp(seconds, at, speed) + rng.normal(0.0, 0.1, count)), 3),
        np.round(rng.uniform(0.7, 2.5, count), 1),
        rng.integers(5, 14, count),
    )


Writer = Callable[[Path, Drive, np.ndarray, np.ndarray], None]
"""Writes a drive with the recorder's clock [ns] and the distance that its wheels count [m]."""


@dataclass(frozen=True)
class Layout:
    """How a recorder writes: file name, rows a second, and the text of a drive."""

    name: str
    rate: float
    write: Writer
    profile: dict[str, Any] | None = None


def _parts(time: np.ndarray) -> list[str]:
    return [f"{t.year},{t.month},{t.day},{t.hour},{t.minute},{t.second}" for t in stamps(time)]


def stamps(time: np.ndarray) -> pd.DatetimeIndex:
    return pd.DatetimeIndex(time)


def _mtk(path: Path, run: Drive, clock: np.ndarray, _: np.ndarray) -> None:
    rows = [
        f"{when},{run.satellites[i]},{run.longitude[i]:.7f},{run.latitude[i]:.7f},"
        f"{run.altitude[i]:.3f},{run.speed[i]:.2f},{round(100 * run.hdop[i])}"
        for i, when in enumerate(_parts(clock))
    ]
    path.write_text("\n".join([MTK_HEADER, *rows]) + "\n")


def _ublox(path: Path, run: Drive, clock: np.ndarray, _: np.ndarray) -> None:
    head = "Year,Month,Day,Hour,Minute,Second,nSAT,Lon,Lat,Alt1,Alt2,hAcc,vAcc,speed,speedAcc,PDOP,"
    rows = [
        f"{when},{run.satellites[i]},{round(1e7 * run.longitude[i])},"
        f"{round(1e7 * run.latitude[i])},{round(1e3 * run.altitude[i])},"
        f"{round(1e3 * run.altitude[i])},3000,5000,"
        f"{round(1e3 * run.speed[i])},100,{round(100 * run.hdop[i])},"
        for i, when in enumerate(_parts(clock))
    ]
    path.write_text("\n".join([head, *rows]) + "\n")


def _gpx(path: Path, run: Drive, clock: np.ndarray, _: np.ndarray) -> None:
    path.write_text(gpx_text(Drive(clock, *(getattr(run, n) for n in list(vars(run))[1:]))))


def _nmea(path: Path, run: Drive, clock: np.ndarray, _: np.ndarray) -> None:
    at = Drive(clock, *(getattr(run, n) for n in list(vars(run))[1:]))
    path.write_text("\r\n".join(nmea_lines(at, ("RMC", "GGA"))) + "\r\n")


def _state(pattern: str, *, fractions: bool) -> Writer:
    def write(path: Path, run: Drive, clock: np.ndarray, distance: np.ndarray) -> None:
        text = stamps(clock).strftime(pattern)
        if fractions:
            text = [t[:-3] for t in text]
        rows = [f"{t},{v:.2f},{s:.1f}" for t, v, s in zip(text, run.speed, distance, strict=True)]
        path.write_text("\n".join(["t,v,s", *rows]) + "\n")

    return write


def distance(line: str, run: Drive) -> np.ndarray:
    """Distance [m] that wheels count whose diameter is known to four per mille."""
    at, _, position = motion(line)
    return 1.004 * np.interp((run.time - START) / SECOND, at, position)


def _elapsed(path: Path, run: Drive, clock: np.ndarray, distance: np.ndarray) -> None:
    rows = [
        f"{round((t - START) / 1e6)},{3.6 * v:.2f},{s:.1f}"
        for t, v, s in zip(clock, run.speed, distance, strict=True)
    ]
    path.write_text("\n".join(["t,v,s", *rows]) + "\n")


def _parquet(path: Path, run: Drive, clock: np.ndarray, distance: np.ndarray) -> None:
    pd.DataFrame({"t": stamps(clock).tz_localize("UTC"), "v": run.speed, "s": distance}).to_parquet(
        path
    )


def table_profile(time: dict[str, Any], speed: str = "m/s", **file: Any) -> dict[str, Any]:
    return {
        "format": "trainlog/recorder-profile",
        "version": 1,
        "name": "clock",
        "file": file,
        "time": {"column": "t"} | time,
        "columns": {
            "/train/state.speed": {"column": "v", "unit": speed},
            "/train/state.position": {"column": "s", "unit": "m"},
        },
    }


LAYOUTS = (
    Layout("mtk.csv", 10.0, _mtk),
    Layout("ublox.csv", 5.0, _ublox),
    Layout("log.nmea", 5.0, _nmea),
    Layout("log.gpx", 1.0, _gpx),
    Layout("whole.csv", 5.0, _state("%Y-%m-%dT%H:%M:%SZ", fractions=False), table_profile({})),
    Layout("fine.csv", 10.0, _state("%Y-%m-%dT%H:%M:%S.%f", fractions=True), table_profile({})),
    Layout(
        "elapsed.csv",
        2.0,
        _elapsed,
        table_profile({"format": "elapsed", "unit": "ms", "start": "2024-05-01T06:00:00Z"}, "km/h"),
    ),
    Layout("table.parquet", 10.0, _parquet, table_profile({}, format="parquet")),
)

STEPS = {"back": -2, "forward": 3, "mixed": -2, "back 1": -1, "back 17": -17, "forward 1": 1,
         "mixed 1": -1, "back 20": -20, "back 7.4": -7.4, "forward 2.6": 2.6,
         "forward 30": 30}  # fmt: skip
"""By how many seconds the clock is set; where it is mixed, both are written for 20 s."""


@dataclass(frozen=True)
class Case:
    """A recording whose clock was set."""

    path: Path
    profile: Profile | None
    truth: np.ndarray
    """When each row was recorded [ns], by the clock of most rows, in that order."""
    period: float


def recorded(
    folder: Path,
    line: str,
    layout: Layout,
    step: str | None,
    *,
    count: float = 400.0,
    lost: int = 0,
) -> Case:
    """Write a recording of `count` seconds whose clock was set after a third of it.

    Halfway `lost` seconds are not recorded.
    """
    rows = int(count * layout.rate)
    run = drive(line, layout.rate, rows)
    middle = np.arange(rows) - rows // 2
    run = run.take(np.flatnonzero((middle < 0) | (middle >= lost * layout.rate)))
    clock = run.time.copy()
    if step is not None:
        # Neither at a whole second, nor at the end of a block.
        at = int(0.37 * rows) + (2 if layout.rate > 2.0 else 0)
        new = np.arange(rows) >= at
        if step.startswith("mixed"):
            late = np.arange(rows) < at + 20 * layout.rate
            new &= ~late | (np.arange(rows) % 2 == 0)
        # The clock after the step is right.
        clock[~new] -= round(STEPS[step] * SECOND)
    path = folder / layout.name
    layout.write(path, run, clock, distance(line, run))
    profile = None if layout.profile is None else profile_of(layout.profile)
    return Case(path, profile, run.time, 1.0 / layout.rate)


def error_of(time: np.ndarray, case: Case) -> float:
    """Largest error of the times [s] of 99 % of the rows; infinite if rows are missing."""
    if abs(time.size - case.truth.size) > 0.005 * case.truth.size:
        return np.inf
    shortest = min(time.size, case.truth.size)
    return float(np.quantile(np.abs(time[:shortest] - case.truth[:shortest]) / SECOND, 0.99))
