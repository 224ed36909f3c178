"""What a comparison reads of a trip: speed, position and work on one clock.

Long logs are read in pieces, and only the columns that are used; of each piece a sample every
`SAMPLING` seconds is kept, and work is cumulated over all samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.given import Given, trip_of
from trainlog.along_line import POSITION_SOURCES
from trainlog.errors import LogError
from trainlog.mcap import read_log
from trainlog.mcap.reader import stream_log
from trainlog.resampling import joined_pieces
from trainlog.topics import (
    ENVIRONMENT,
    REFERENCE,
    TRAIN_CONTROLS,
    TRAIN_SLIP_PROTECTION,
    TRAIN_STATE,
    TRAIN_SUPPLY,
)
from trainlog.trip import Trip, seconds

FloatArray = NDArray[np.float64]

SAMPLING = 0.1
"""Least time between two samples that are kept [s]; work is summed over all of them."""

ROWS = 250_000
"""Rows of a piece."""

_WORKS = {
    "tractive_effort": "traction",
    "dynamic_braking_effort": "dynamic_braking",
    "pneumatic_braking_effort": "pneumatic_braking",
}
EFFORTS = tuple(_WORKS)

COLUMNS: dict[str, tuple[str, ...]] = {
    TRAIN_CONTROLS.name: (*EFFORTS, "tractive_effort_demand", "lever"),
    ENVIRONMENT.name: ("speed_limit", "head_wind"),
    REFERENCE.name: ("speed", "lateness"),
    TRAIN_SLIP_PROTECTION.name: ("active",),
    TRAIN_SUPPLY.name: ("line_voltage", "line_current"),
}
"""What is read beside speed and position, where it is recorded."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Thinned samples; works are cumulated over all samples."""

    origin: int
    estimated: bool
    time: FloatArray
    values: dict[str, FloatArray]
    sums: dict[str, FloatArray]


def described(given: Given) -> Trip:
    """The trip; of a log, its topics without rows."""
    if isinstance(given, Trip):
        return given
    never = (pd.Timestamp(0, tz="UTC"), pd.Timestamp(0, tz="UTC"))
    if Path(given).is_dir():
        return trip_of(given)  # which refuses it
    return read_log(given, [*dict(_states()), *COLUMNS], time=never)


def _states() -> list[tuple[str, str]]:
    return [(source[0], source[1]) for source in POSITION_SOURCES[:2]]


def samples_of(given: Given, bare: Trip) -> Samples:
    """Speed, position and what else is recorded, on the clock of the position."""
    present = {
        topic: [name for name in names if name in bare[topic]]
        for topic, names in COLUMNS.items()
        if topic in bare
    }
    present = {topic: names for topic, names in present.items() if names}
    for state, _ in _states():
        if state not in bare or "position" not in bare[state]:
            continue
        chosen: dict[str, Iterable[str]] = {state: ["speed", "position"], **present}
        gathered = _Gathered()
        for table in joined_pieces(
            pieces_of(given, chosen),
            [f"{topic}.{name}" for topic, names in chosen.items() for name in names],
            state,
            max_gap=None,
        ):
            gathered.add(table)
        if gathered.rows:
            return gathered.table(state)
    raise LogError(
        f"trip '{bare.name}' knows no chainage",
        place="topics /estimates/state and /train/state",
        remedy="ingest it with its line (--line), which finds the chainage of its fixes",
    )


def pieces_of(given: Given, columns: Mapping[str, Iterable[str]]) -> Iterable[Trip]:
    """Some columns of a trip; of a log, piece by piece."""
    return [given] if isinstance(given, Trip) else stream_log(given, columns, rows=ROWS)


class _Gathered:
    """Sums a trip that comes in pieces, and keeps a sample every `SAMPLING` seconds."""

    def __init__(self) -> None:
        self.rows = 0
        self._origin: pd.Timestamp | None = None
        self._kept: list[pd.DataFrame] = []
        self._last: pd.DataFrame | None = None
        self._totals = pd.Series(dtype=np.float64)

    def add(self, table: pd.DataFrame) -> None:
        """Add rows; those without speed or position are passed over."""
        names = {name: _short(name) for name in table.columns}
        frame = table.rename(columns=names)
        known = np.isfinite(frame["position"].to_numpy())
        frame = frame[known]
        if frame.empty:
            return
        if self._origin is None:
            self._origin = pd.Timestamp(frame.index[0])
        time = seconds(frame, self._origin)
        frame = frame.reset_index(drop=True).assign(time=time)
        if self._last is not None:
            frame = pd.concat([self._last, frame], ignore_index=True)
        sums = _integrals(frame)
        if self._last is not None:
            sums = sums.iloc[1:] + self._totals
            frame = frame.iloc[1:]
        self._last, self._totals = frame.iloc[-1:], sums.iloc[-1]
        merged = pd.concat([frame, sums], axis=1)
        ticks = np.floor(merged["time"].to_numpy() / SAMPLING + 1e-6)
        first = np.concatenate(([True], np.diff(ticks) > 0.0))
        self.rows += int(first.sum())
        self._kept.append(merged[first])

    def table(self, state: str) -> Samples:
        """What was gathered."""
        if self._origin is None:
            raise LogError("no samples")
        whole = pd.concat(self._kept, ignore_index=True)
        # One row each: the first of a piece may repeat the tick of the one before.
        whole = whole[np.diff(whole["time"].to_numpy(), prepend=-1.0) > 0.0]
        columns = {name: whole[name].to_numpy(dtype=np.float64) for name in whole.columns}
        sums = {name[1:]: columns.pop(name) for name in list(columns) if name.startswith("∫")}
        origin = int(self._origin.as_unit("ns").value)
        return Samples(origin, state != TRAIN_STATE.name, columns.pop("time"), columns, sums)


def _short(name: str) -> str:
    """Name of a column without its topic, unless two topics have it."""
    topic, _, column = name.rpartition(".")
    return f"reference_{column}" if topic == REFERENCE.name else column


def _integrals(frame: pd.DataFrame) -> pd.DataFrame:
    """Work since the frame's first row by the trapezoidal rule, and time without efforts."""
    time, speed = frame["time"].to_numpy(), np.nan_to_num(frame["speed"].to_numpy())
    found: dict[str, FloatArray] = {}

    def integral(values: FloatArray) -> FloatArray:
        steps = 0.5 * (values[1:] + values[:-1]) * np.diff(time)
        return np.concatenate(([0.0], np.cumsum(steps)))

    for effort in EFFORTS:
        if effort in frame:
            values = frame[effort].to_numpy(dtype=np.float64)
            found[f"∫{_WORKS[effort]}"] = integral(np.nan_to_num(values) * speed)
            if effort == "tractive_effort":
                found["∫unknown_effort"] = integral((~np.isfinite(values)).astype(np.float64))
    if "line_voltage" in frame and "line_current" in frame:
        power = frame["line_voltage"].to_numpy() * frame["line_current"].to_numpy()
        found["∫supply"] = integral(np.nan_to_num(power))
        found["∫unknown_supply"] = integral((~np.isfinite(power)).astype(np.float64))
    return pd.DataFrame(found, index=frame.index)
