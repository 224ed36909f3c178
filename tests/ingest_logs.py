"""Recorded files for the tests of ingest: clean ones, and clean ones damaged in a known way."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from hypothesis import strategies as st
from recorder_files import SECOND, START, Drive, ublox_text

from trainlog import Trip
from trainlog.ingest import Profile, ingest, profile_of

HEAD = {"format": "trainlog/recorder-profile", "version": 1, "name": "plain"}
PLAIN = {
    **HEAD,
    "time": {"column": "t"},
    "columns": {
        "/train/state.speed": {"column": "v", "unit": "m/s"},
        "/train/state.position": {"column": "s", "unit": "m"},
    },
}  # A profile for the files that `write` writes


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


def read_plain(folder: Path, rows: list[str], **sections: object) -> Trip:
    """The trip of rows, by the plain profile with sections added or replaced."""
    return ingest(write(folder / "run.csv", rows), profile=plain_profile(**sections))


@dataclass(frozen=True)
class Run:
    """A clean run: what the recorder should have written."""

    time: np.ndarray
    speed: np.ndarray
    position: np.ndarray

    def rows(self) -> list[str]:
        stamps = pd.DatetimeIndex(self.time, tz="UTC").strftime("%Y-%m-%dT%H:%M:%S.%fZ")
        columns = zip(stamps, self.speed, self.position, strict=True)
        return [f"{t},{v:.3f},{s:.2f}" for t, v, s in columns]


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


def ublox(seconds: np.ndarray, true: np.ndarray, before: list[str] | None = None) -> str:
    """A u-blox file whose rows are labelled with whole seconds, and were measured at true times."""
    ones = np.ones(true.size)
    way = 20.0 * true + 50.0 * (1.0 - np.cos(0.1 * true))
    run = Drive(
        START + seconds.astype(np.int64) * SECOND, 47.4 + 1e-6 * np.arange(true.size),
        9.3 + way / 75_300.0, 452.1 * ones, 20.0 + 5.0 * np.sin(0.1 * true), 1.6 * ones,
        np.full(true.size, 9),
    )  # fmt: skip
    return ublox_text(run, before or [])
