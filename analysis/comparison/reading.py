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

from analysis.comparison.gaps import SHORT_GAP, Bridges, Gap, Silences, bridged, time_in
from analysis.given import Given, trip_of
from trainlog.along_line import POSITION_SOURCES, nanoseconds
from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import LogError
from trainlog.mcap import read_log
from trainlog.mcap.reader import stream_log
from trainlog.resampling import joined_pieces
from trainlog.spans import runs_of
from trainlog.topics import (
    ENVIRONMENT,
    GNSS_MOTION,
    REFERENCE,
    STANDSTILL,
    TRAIN_AXLES,
    TRAIN_CONTROLS,
    TRAIN_SLIP_PROTECTION,
    TRAIN_STATE,
    TRAIN_SUPPLY,
)
from trainlog.trip import Trip, seconds
from trainlog.units import NANOSECONDS

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
    gaps: tuple[Gap, ...] = ()


def described(given: Given) -> Trip:
    """The trip; of a log, its topics without rows."""
    if isinstance(given, Trip):
        return given
    never = (pd.Timestamp(0, tz="UTC"), pd.Timestamp(0, tz="UTC"))
    if Path(given).is_dir():
        return trip_of(given)  # which refuses it
    topics = [*dict(_states()), *COLUMNS, TRAIN_AXLES.name, GNSS_MOTION.name]
    return read_log(given, topics, time=never)


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
        gathered = _gathered(given, chosen, state, None)
        if gathered.lacks:
            bridges = bridged(_around(given, bare, state))
            gathered = _gathered(given, chosen, state, bridges)
        if gathered.rows:
            return gathered.table(state)
    raise LogError(
        f"trip '{bare.name}' knows no chainage",
        place="topics /estimates/state and /train/state",
        remedy="ingest it with its line (--line), which finds the chainage of its fixes",
    )


def _gathered(
    given: Given, chosen: Mapping[str, Iterable[str]], state: str, bridges: Bridges | None
) -> _Gathered:
    watched = (state, *(name for name in (TRAIN_CONTROLS.name,) if name in chosen))
    silences = Silences(watched)
    found = _Gathered(bridges)
    for table in joined_pieces(
        silences.watched(pieces_of(given, chosen)),
        [f"{topic}.{name}" for topic, names in chosen.items() for name in names],
        state,
        max_gap=None,
    ):
        found.add(table)
    found.silent = silences.gaps({state: "sample", TRAIN_CONTROLS.name: "effort"})
    return found


def _around(given: Given, bare: Trip, state: str) -> pd.DataFrame:
    """Speed and position of a whole trip, with what may bridge their gaps."""
    axles = bare.topics.get(TRAIN_AXLES.name, pd.DataFrame())
    wheels = [str(name) for name in axles if str(name).startswith("wheel_speed")]
    chosen: dict[str, list[str]] = {state: ["speed", "position"], TRAIN_AXLES.name: wheels}
    if GNSS_MOTION.name in bare and "speed" in bare[GNSS_MOTION.name]:
        chosen[GNSS_MOTION.name] = ["speed"]
    chosen = {topic: names for topic, names in chosen.items() if names}
    columns = [f"{topic}.{name}" for topic, names in chosen.items() for name in names]
    kept = []
    for table in joined_pieces(pieces_of(given, chosen), columns, state, max_gap=SHORT_GAP):
        ticks = np.floor(nanoseconds(table) / NANOSECONDS / SAMPLING + 1e-6)
        kept.append(table[np.concatenate(([True], np.diff(ticks) > 0.0))[: len(table)]])
    return pd.concat(kept).rename(columns=_short)


def pieces_of(given: Given, columns: Mapping[str, Iterable[str]]) -> Iterable[Trip]:
    """Some columns of a trip; of a log, piece by piece."""
    return [given] if isinstance(given, Trip) else stream_log(given, columns, rows=ROWS)


class _Gathered:
    """Sums a trip that comes in pieces, and keeps a sample every `SAMPLING` seconds."""

    def __init__(self, bridges: Bridges | None = None) -> None:
        self.rows = 0
        self.lacks = False
        self.silent: list[Gap] = []
        self._bridges = bridges
        self._origin: pd.Timestamp | None = None
        self._kept: list[pd.DataFrame] = []
        self._last: pd.DataFrame | None = None
        self._totals = pd.Series(dtype=np.float64)

    def add(self, table: pd.DataFrame) -> None:
        """Add rows; those without position count for the works alone."""
        frame = table.rename(columns=_short)
        if frame.empty:
            return
        if self._bridges is not None:
            frame = self._bridges.fill(frame)
        self.lacks |= bool(frame[["speed", "position"]].isna().any(axis=None))
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
        merged = merged[np.isfinite(merged["position"].to_numpy())]
        if merged.empty:
            return
        ticks = np.floor(merged["time"].to_numpy() / SAMPLING + 1e-6)
        first = np.concatenate(([True], np.diff(ticks) > 0.0))
        self.rows += int(first.sum())
        self._kept.append(merged[first])

    def table(self, state: str) -> Samples:
        """What was gathered."""
        if self._origin is None or not self._kept:
            raise LogError("no samples")
        whole = pd.concat(self._kept, ignore_index=True)
        # One row each: the first of a piece may repeat the tick of the one before.
        whole = whole[np.diff(whole["time"].to_numpy(), prepend=-1.0) > 0.0]
        columns = {name: whole[name].to_numpy(dtype=np.float64) for name in whole.columns}
        sums = {name[1:]: columns.pop(name) for name in list(columns) if name.startswith("∫")}
        origin = int(self._origin.as_unit("ns").value)
        time = columns.pop("time")
        gaps = (*(() if self._bridges is None else self._bridges.gaps), *self.silent)
        stamps = origin + np.rint(time * NANOSECONDS).astype(np.int64)
        if "unknown_effort" in sums:
            unknown = [each for each in gaps if not each.bridge and each.missing != "position"]
            silent = time_in(unknown, stamps, columns["position"])
            for name in ("unknown_effort", "unknown_dynamic_braking", "unknown_pneumatic_braking"):
                if name in sums:
                    sums[name] = sums[name] + silent
        gaps = (*gaps, *_without(columns.get("tractive_effort"), stamps))
        return Samples(origin, state != TRAIN_STATE.name, time, columns, sums, gaps)


def _without(effort: FloatArray | None, stamps: IntArray) -> list[Gap]:
    """Gaps of an effort that is recorded otherwise."""
    lacks = np.zeros(0, dtype=np.bool_) if effort is None else ~np.isfinite(effort)
    if not lacks.any() or lacks.mean() > 0.5:
        return []
    last = stamps.size - 1
    found = [
        Gap(int(stamps[max(begin - 1, 0)]), int(stamps[min(end, last)]), "effort")
        for begin, end in runs_of(lacks)
    ]
    return [gap for gap in found if gap.seconds > SHORT_GAP]


def _short(name: str) -> str:
    """Name of a column without its topic, unless two topics have it."""
    topic, _, column = name.rpartition(".")
    kind = {REFERENCE.name: "reference_", GNSS_MOTION.name: "gnss_"}.get(topic, "")
    return f"{kind}{column}"


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
            lacks = (~np.isfinite(values) & (speed > STANDSTILL)).astype(np.float64)
            name = "effort" if effort == "tractive_effort" else _WORKS[effort]
            found[f"∫unknown_{name}"] = integral(lacks)
    if "line_voltage" in frame and "line_current" in frame:
        power = frame["line_voltage"].to_numpy() * frame["line_current"].to_numpy()
        found["∫supply"] = integral(np.nan_to_num(power))
        found["∫unknown_supply"] = integral((~np.isfinite(power)).astype(np.float64))
    return pd.DataFrame(found, index=frame.index)
