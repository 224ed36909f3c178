"""Recorded files for the tests of ingest: clean ones, and clean ones damaged in a known way."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from hypothesis import strategies as st

from trainlog.ingest import Profile, profile_of

START = pd.Timestamp("2024-05-01T06:00:00Z").value
SECOND = 1_000_000_000

HEAD = {"format": "trainlog/recorder-profile", "version": 1, "name": "plain"}
PLAIN = {
    **HEAD,
    "time": {"column": "t"},
    "columns": {
        "/train/state.speed": {"column": "v", "unit": "m/s"},
        "/train/state.position": {"column": "s", "unit": "m"},
    },
}
"""A profile for the files that `write` writes."""


def plain_profile(**sections: object) -> Profile:
    """`PLAIN` with sections added or replaced."""
    return profile_of({**PLAIN, **sections})


def profile(columns: object, **sections: object) -> Profile:
    """A profile of these columns, by field, and other sections."""
    return profile_of({**HEAD, "columns": columns, **sections})


def plain_text(rows: list[str], header: str = "t,v,s") -> str:
    return "\n".join([header, *rows]) + "\n"


def plain_rows(count: int = 20, step: float = 1.0) -> list[str]:
    """Rows of a train that gathers speed."""
    run = clean_run(count, step)
    return run.rows()


def write(path: Path, rows: list[str], header: str = "t,v,s") -> Path:
    path.write_text(plain_text(rows, header), "utf-8")
    return path


@dataclass(frozen=True)
class Run:
    """A clean run: what the recorder should have written."""

    time: np.ndarray
    speed: np.ndarray
    position: np.ndarray

    def rows(self) -> list[str]:
        stamps = pd.DatetimeIndex(self.time, tz="UTC").strftime("%Y-%m-%dT%H:%M:%S.%fZ")
        return [
            f"{t},{v:.3f},{s:.2f}"
            for t, v, s in zip(stamps, self.speed, self.position, strict=True)
        ]


def clean_run(count: int, step: float, phase: float = 0.3) -> Run:
    """Speed between 10 and 30 m/s, changing by at most 0.8 m/s²."""
    seconds = np.arange(count) * step
    speed = 20.0 + 10.0 * np.sin(0.08 * seconds + phase)
    position = 20.0 * seconds + 125.0 * (np.cos(phase) - np.cos(0.08 * seconds + phase))
    time = START + np.round((seconds + 0.05) * SECOND).astype(np.int64)
    return Run(time, np.round(speed, 3), np.round(position, 2))


@dataclass
class Damaged:
    """A damaged file and what was done to it."""

    run: Run
    rows: list[str]
    doubled: int = 0
    swapped: int = 0
    empty: int = 0
    text: int = 0
    truncated: int = 0
    wild: set[int] = field(default_factory=set)
    lost: set[int] = field(default_factory=set)
    blank: set[int] = field(default_factory=set)


@st.composite
def damaged_runs(draw: st.DrawFn) -> Damaged:
    """A run of 60 to 150 rows, of which every fourth at most is damaged, each in one way."""
    step = draw(st.sampled_from([0.1, 0.5, 1.0]))
    run = clean_run(draw(st.integers(60, 150)), step, draw(st.floats(0.0, 3.0)))
    rows = [[row] for row in run.rows()]
    found = Damaged(run, [])
    places = range(4, len(rows) - 4, 4)
    kinds = ("fine", "fine", "double", "swap", "empty", "text", "wild", "truncate")
    for place in places:
        kind = draw(st.sampled_from(kinds))
        stamp, speed, position = rows[place][0].split(",")
        if kind == "double":
            rows[place] *= 2
            found.doubled += 1
        elif kind == "swap":
            rows[place], rows[place + 1] = rows[place + 1], rows[place]
            found.swapped += 1
        elif kind == "empty":
            rows[place] = [f"{stamp},{draw(st.sampled_from(['', 'nan', 'NaN', '-']))},{position}"]
            found.empty += 1
            found.blank.add(place)
        elif kind == "text":
            word = draw(st.sampled_from(["error", "1.2.3", "12 m/s", "#VALUE!", "inf"]))
            rows[place] = [f"{stamp},{word},{position}"]
            found.text += 1
            found.blank.add(place)
        elif kind == "wild":
            size = draw(st.floats(35.0, 500.0)) * draw(st.sampled_from([-1.0, 1.0]))
            rows[place] = [f"{stamp},{float(speed) + size:.3f},{position}"]
            found.wild.add(place)
        elif kind == "truncate":
            rows[place] = [stamp]
            found.truncated += 1
            found.lost.add(place)
    found.rows = [row for pair in rows for row in pair]
    return found


UBLOX_HEADER = (
    "Year,Month,Day,Hour,Minute,Second,nSAT,Lon,Lat,Alt1,Alt2,hAcc,vAcc,speed,speedAcc,PDOP,"
)


@dataclass(frozen=True)
class Ublox:
    """Rows of a u-blox file as numbers, before they are written."""

    seconds: np.ndarray
    """Whole second that each row is labelled with, since `START`."""
    true: np.ndarray
    """True time of each row [s]."""
    speed: np.ndarray

    def _distance(self) -> np.ndarray:
        """The integral of `speed` [m]."""
        return 20.0 * self.true + 50.0 * (1.0 - np.cos(0.1 * self.true))

    def text(self, before: list[str] | None = None) -> str:
        stamps = pd.DatetimeIndex(START + self.seconds * SECOND, tz="UTC")
        rows = [
            f"{t.year},{t.month},{t.day},{t.hour},{t.minute},{t.second},9,"
            f"{93_000_000 + round(1e7 * d / 75_300.0)},{474_000_000 + 10 * i},"
            f"500000,452100,2500,4000,{round(1e3 * v)},80,160,"
            for i, (t, v, d) in enumerate(zip(stamps, self.speed, self._distance(), strict=True))
        ]
        return "\n".join([UBLOX_HEADER, *(before or []), *rows]) + "\n"


def ublox(seconds: np.ndarray, true: np.ndarray) -> Ublox:
    return Ublox(seconds.astype(np.int64), true, 20.0 + 5.0 * np.sin(0.1 * true))
