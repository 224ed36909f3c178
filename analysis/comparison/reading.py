"""What a comparison reads of a trip: speed, position and work on one clock.

Long logs are read in pieces, and only the columns that are used; of each piece a sample every
`SAMPLING` seconds is kept, and work is cumulated over all samples.

Speed and position where they are not recorded: bridged by what else is, or stated as unknown.

A recorder that hangs, and a value that stays frozen, leave a trip without speed for seconds while
position, wheels or satellites go on. Each of them is tried as the speed of the gap: at the
recorded speed on both sides it must agree with it, and over the gap with the distance; the one that
agrees best is used. A missing position is bridged by the speed. What nothing bridges is not
known: neither is the work there, and a calculation starts anew behind it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.ndimage import uniform_filter1d

from analysis.given import Given, trip_of
from trainlog.along_line import GAP_DISTANCE, POSITION_SOURCES, nanoseconds
from trainlog.arrays import BoolArray, FloatArray, IntArray
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

SHORT_GAP = 2.0
"""Up to such a gap [s] a value is on the line between its neighbours."""

NEIGHBOURHOOD = 10.0
"""On both sides of a gap [s], where what may bridge it is compared with the recorded speed."""

SAME_SPEED, SAME_SPEED_SHARE = 0.5, 0.03
"""Another speed is the same up to so many m/s (RMS), and this share of it."""

SAME_DISTANCE, SAME_DISTANCE_SHARE = 5.0, 0.02
"""A bridge covers the recorded distance up to so many metres, and this share of it."""

SCALE = 0.1
"""Another speed differs from the recorded one by at most this share, by which it is corrected."""

STEEPEST = 3.0
"""Faster changes within a second [m/s] are those of a position that was corrected, or of slip."""

SILENCE = 10.0
"""Rows further apart than so many usual steps, and `SHORT_GAP`, have a gap between them."""


@dataclass(frozen=True, slots=True)
class Gap:
    """A stretch of time in which something is not recorded.

    Attributes
    ----------
    first, last : int [ns since 1970 UTC]
        The recorded samples on both sides.
    missing : str
    bridge : str
        What stands for it; empty if nothing does.
    """

    first: int
    last: int
    missing: str
    bridge: str = ""

    @property
    def seconds(self) -> float:
        """How long it is [s]."""
        return (self.last - self.first) / NANOSECONDS

    @property
    def words(self) -> str:
        """In a sentence, without the place."""
        known = f"bridged by {self.bridge}" if self.bridge else "not known there"
        return f"no {self.missing} for {self.seconds:.0f} s, {known}"


@dataclass(frozen=True, eq=False)
class Bridges:
    """Speed and position of a trip with its gaps bridged.

    Attributes
    ----------
    time : (n,) int array [ns since 1970 UTC]
    speed, position : (n,) array [m/s], [m]
    gaps : tuple of Gap
    """

    time: IntArray
    speed: FloatArray
    position: FloatArray
    gaps: tuple[Gap, ...]

    def fill(self, frame: pd.DataFrame) -> pd.DataFrame:
        """The frame with missing speeds and, in bridged gaps, positions."""
        now = nanoseconds(frame)
        found = {}
        for name, values in (("speed", self.speed), ("position", self.position)):
            own = frame[name].to_numpy(dtype=np.float64).copy()
            lacks = np.flatnonzero(~np.isfinite(own))
            known = np.isfinite(values)
            if lacks.size and known.any():
                there = np.interp(now[lacks] - self.time[0], self.time - self.time[0], values)
                if name == "speed":
                    first, last = self.time[known][[0, -1]]
                    inner = np.interp(
                        now[lacks] - self.time[0], self.time[known] - self.time[0], values[known]
                    )
                    there = np.where((now[lacks] >= first) & (now[lacks] <= last), inner, np.nan)
                own[lacks] = there
            found[name] = own
        return frame.assign(**found)


def bridged(frame: pd.DataFrame) -> Bridges:
    """Speed and position of a whole trip, with what bridges their gaps.

    Parameters
    ----------
    frame : DataFrame
        By time: ``speed`` [m/s], ``position`` [m] and, where recorded, ``wheel_speed_1`` ... and
        ``gnss_speed`` [m/s]; NaN where they are not known.

    Examples
    --------
    A train that accelerates, without speed for 6 s:

    >>> time = np.arange(0.0, 40.0, 0.2)
    >>> speed = np.where(abs(time - 20.0) < 3.0, np.nan, 0.5 * time)
    >>> index = pd.DatetimeIndex(pd.to_datetime(np.rint(time * 1e9), utc=True))
    >>> frame = pd.DataFrame({"speed": speed, "position": 0.25 * time**2}, index=index)
    >>> found = bridged(frame)
    >>> found.gaps[0].words, float(found.speed[100].round(1))
    ('no speed for 6 s, bridged by position', 10.0)
    """
    stamps = nanoseconds(frame)
    time = (stamps - stamps[0]) / NANOSECONDS
    speed = frame["speed"].to_numpy(dtype=np.float64).copy()
    position = frame["position"].to_numpy(dtype=np.float64).copy()
    recorded, known = speed.copy(), np.isfinite(speed)
    gaps = []
    if known.sum() < 2:  # nothing to compare with
        speed, known = _from_position(frame, time, speed), np.ones(time.size, dtype=np.bool_)
    for begin, end in _long_gaps(time, known):
        bridge = _Opening(frame, time, recorded, begin, end).bridge()
        source, values = ("", None) if bridge is None else bridge
        if values is not None:
            speed[begin:end] = np.maximum(values, 0.0)
        elif end < time.size and begin > 0:
            ends = (time[begin - 1], time[end]), (recorded[begin - 1], recorded[end])
            speed[begin:end] = np.interp(time[begin:end], *ends)
        gaps.append(Gap(*_sides(stamps, begin, end), "speed", source))
    unknown = [(gap.first, gap.last) for gap in gaps if not gap.bridge]
    for begin, end in _long_gaps(time, np.isfinite(position)):
        sides = _sides(stamps, begin, end)
        apart = all(sides[1] <= first or sides[0] >= last for first, last in unknown)
        own = _position(time, speed, position, begin, end) if apart else None
        if own is not None:
            position[begin:end] = own
        gaps.append(Gap(*sides, "position", "" if own is None else "speed"))
    return Bridges(stamps, speed, position, tuple(gaps))


def _from_position(frame: pd.DataFrame, time: FloatArray, speed: FloatArray) -> FloatArray:
    found = dict(_speeds_in(frame, time)).get("position", speed)
    return np.maximum(found, 0.0)


def _long_gaps(time: FloatArray, known: BoolArray) -> list[tuple[int, int]]:
    """First sample and one past the last of each gap longer than `SHORT_GAP`."""
    last = time.size - 1
    return [
        (begin, end)
        for begin, end in runs_of(~known)
        if time[min(end, last)] - time[max(begin - 1, 0)] > SHORT_GAP
    ]


def _sides(stamps: IntArray, begin: int, end: int) -> tuple[int, int]:
    return int(stamps[max(begin - 1, 0)]), int(stamps[min(end, stamps.size - 1)])


def _position(
    time: FloatArray, speed: FloatArray, position: FloatArray, begin: int, end: int
) -> FloatArray | None:
    """Positions in a gap by the speed, closed at both ends; None if they do not meet them."""
    if begin == 0 or end == time.size or not np.isfinite(speed[begin - 1 : end + 1]).all():
        return None
    part, moved = slice(begin - 1, end + 1), position[end] - position[begin - 1]
    v, t = speed[part], time[part]
    ran = np.concatenate(([0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))))
    if abs(ran[-1] - moved) > SAME_DISTANCE + SAME_DISTANCE_SHARE * moved:
        return None
    share = ran / ran[-1] if ran[-1] > 0.0 else (t - t[0]) / (t[-1] - t[0])
    return np.asarray((position[begin - 1] + moved * share)[1:-1])


@dataclass(frozen=True, eq=False)
class _Opening:
    """A gap of the speed with what is recorded around it."""

    frame: pd.DataFrame
    time: FloatArray
    speed: FloatArray
    begin: int
    end: int

    def bridge(self) -> tuple[str, FloatArray] | None:
        """The speed that agrees best on both sides, and where it is from."""
        low, high = self.time[max(self.begin - 1, 0)], self.time[min(self.end, self.time.size - 1)]
        first, last = np.searchsorted(
            self.time, [low - NEIGHBOURHOOD - 2.0, high + NEIGHBOURHOOD + 2.0]
        )
        part = slice(int(first), int(last))
        time, speed = self.time[part], self.speed[part]
        inside = np.zeros(time.size, dtype=np.bool_)
        inside[self.begin - first : self.end - first] = True
        near = np.isfinite(speed) & (time >= low - NEIGHBOURHOOD) & (time <= high + NEIGHBOURHOOD)
        place = self.frame["position"].to_numpy(dtype=np.float64)[part]
        best: tuple[float, str, FloatArray] | None = None
        for name, values in _speeds_in(self.frame.iloc[part], time):
            found = _agreeing(time, speed, values, near, place)
            if found is not None and (best is None or found[0] < best[0]):
                best = (found[0], name, found[1][inside])
        return None if best is None else best[1:]


def _speeds_in(frame: pd.DataFrame, time: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Other speeds of a trip: of wheels, satellites, and the change of its position."""
    wheels = [name for name in frame.columns if name.startswith("wheel_speed")]
    if wheels:
        values = frame[wheels].to_numpy(dtype=np.float64)
        some = np.isfinite(values).any(axis=1)
        found = np.full(time.size, np.nan)
        found[some] = np.nanmedian(values[some], axis=1)
        yield "wheel speeds", found
    if "gnss_speed" in frame:
        yield "satellites' speed", frame["gnss_speed"].to_numpy(dtype=np.float64)
    position = frame["position"].to_numpy(dtype=np.float64)
    known = np.isfinite(position)
    if known.sum() > 2 and np.diff(time[known]).max() <= SHORT_GAP:
        low, high = np.maximum(time - 1.0, time[0]), np.minimum(time + 1.0, time[-1])
        ahead, behind = (np.interp(each, time[known], position[known]) for each in (high, low))
        change = (ahead - behind) / (high - low)
        width = max(1, round(SHORT_GAP / float(np.median(np.diff(time)))))
        # Chainage is often recorded in whole metres.
        yield "position", uniform_filter1d(change, width, mode="nearest")


def _agreeing(
    time: FloatArray, speed: FloatArray, values: FloatArray, near: BoolArray, place: FloatArray
) -> tuple[float, FloatArray] | None:
    """Another speed, corrected to the recorded one, and how far it is off; None if it is not it."""
    known = np.isfinite(values)
    both = near & known
    gap = np.flatnonzero(~np.isfinite(speed) & ~near)
    if both.sum() < 5 or known.sum() < 2 or not gap.size:
        return None
    window = time[known]
    if np.diff(window).max() > SHORT_GAP:
        return None
    values = np.interp(time, window, values[known])
    square = float(values[both] @ values[both])
    factor = float(speed[both] @ values[both]) / square if square > 4.0 * both.sum() else 1.0
    if abs(factor - 1.0) > SCALE:
        return None
    values = factor * values
    off = float(np.sqrt(np.mean((values[both] - speed[both]) ** 2)))
    if off > SAME_SPEED + SAME_SPEED_SHARE * float(np.mean(speed[both])):
        return None
    second = np.interp(time + 1.0, time, values) - values
    begin, end = max(gap[0] - 1, 0), min(gap[-1] + 1, time.size - 1)
    if np.abs(second[begin : end + 1]).max() > STEEPEST:
        return None
    moved = place[end] - place[begin]
    steps = 0.5 * (values[begin + 1 : end + 1] + values[begin:end])
    ran = float(steps @ np.diff(time[begin : end + 1]))
    if np.isfinite(moved) and abs(ran - moved) > SAME_DISTANCE + SAME_DISTANCE_SHARE * abs(moved):
        return None
    return off, values


@dataclass(eq=False)
class Silences:
    """Stretches in which topics have no rows, watched while a trip is read in pieces."""

    topics: tuple[str, ...]
    _last: dict[str, int] = field(default_factory=dict)
    _steps: dict[str, list[int]] = field(default_factory=dict)
    _usual: dict[str, float] = field(default_factory=dict)
    _long: dict[str, list[tuple[int, int]]] = field(default_factory=dict)

    def watched(self, pieces: Iterable[Trip]) -> Iterator[Trip]:
        """The pieces as they are."""
        for piece in pieces:
            for name in self.topics:
                if name in piece and len(piece[name]):
                    self._watch(name, nanoseconds(piece[name]))
            yield piece

    def _watch(self, name: str, stamps: IntArray) -> None:
        before = self._last.get(name)
        whole = stamps if before is None else np.concatenate(([before], stamps))
        self._last[name] = int(stamps[-1])
        steps = np.diff(whole)
        if not steps.size:
            return
        self._usual.setdefault(name, float(np.median(steps)) / NANOSECONDS)
        long = np.flatnonzero(steps > SHORT_GAP * NANOSECONDS)
        found = self._long.setdefault(name, [])
        found += [(int(whole[row]), int(whole[row + 1])) for row in long.tolist()]

    def gaps(self, names: dict[str, str]) -> list[Gap]:
        """Gaps of each topic; `names` gives what is missing then."""
        return [
            Gap(first, last, names[topic])
            for topic, spans in self._long.items()
            for first, last in spans
            if last - first > SILENCE * self._usual[topic] * NANOSECONDS
        ]


def time_in(gaps: Iterable[Gap], stamps: IntArray, position: FloatArray) -> FloatArray:
    """Time [s] in gaps until each stamp; those in which the train did not move do not count."""
    found = np.zeros(stamps.size)
    for gap in gaps:
        low, high = np.interp(
            np.array([gap.first, gap.last]) - stamps[0], stamps - stamps[0], position
        )
        if high - low > GAP_DISTANCE:
            inside = (np.clip(stamps, gap.first, gap.last) - gap.first) / NANOSECONDS
            found = found + inside
    return found


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
