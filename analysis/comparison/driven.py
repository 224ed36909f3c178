"""A trip reduced to what a comparison by position needs.

Speed, position and cumulated work on one clock (`analysis.comparison.driven`), stands apart from
the running time.

A sample every `SAMPLING` seconds is kept, and work is cumulated over all samples.

Speed and position where they are not recorded: bridged by what else is, or stated as unknown.

A recorder that hangs, and a value that stays frozen, leave a trip without speed for seconds while
position, wheels or satellites go on. Each of them is tried as the speed of the gap: at the
recorded speed on both sides it must agree with it, and over the gap with the distance; the one that
agrees best is used. A missing position is bridged by the speed. What nothing bridges is not
known: neither is the work there, and a calculation starts anew behind it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import uniform_filter1d

from analysis.adhesion.axles import protection_onsets
from analysis.adhesion.slip import slip
from analysis.view import (
    SHORTEST_STOP,
    STANDING_ESTIMATE,
    Given,
    TripView,
    one_way,
    view_of,
)
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.display import counted
from trainlog.errors import InputError, LogError, TrainlogError
from trainlog.formats.railway import line_of, passport_of, recorded_load
from trainlog.railway import Line, Train, Trajectory
from trainlog.railway.line import in_km, km_words, station_at
from trainlog.railway.passport import Quantity
from trainlog.resampling import (
    GAP_DISTANCE,
    LONGEST_GAP,
    POSITION_SOURCES,
    filled,
    forward_chainage,
    joined,
    planned_time_distance,
)
from trainlog.spans import runs_of
from trainlog.topics import (
    ENVIRONMENT,
    ESTIMATED_STATE,
    EVENTS,
    GNSS_MOTION,
    REFERENCE,
    STANDSTILL,
    TRAIN_AXLES,
    TRAIN_CONTROLS,
    TRAIN_SLIP_PROTECTION,
    TRAIN_STATE,
    TRAIN_SUPPLY,
)
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip, seconds
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
    first, last : float [s]
        The recorded samples on both sides, since the recording began.
    missing : str
    bridge : str
        What stands for it; empty if nothing does.
    """

    first: float
    last: float
    missing: str
    bridge: str = ""

    @property
    def seconds(self) -> float:
        """How long it is [s]."""
        return self.last - self.first

    @property
    def words(self) -> str:
        """In a sentence, without the place."""
        known = f"bridged by {self.bridge}" if self.bridge else "not known there"
        return f"no {self.missing} for {self.seconds:.0f} s, {known}"


def bridged(frame: pd.DataFrame) -> tuple[pd.DataFrame, list[Gap]]:
    """A whole trip with what bridges the gaps of its speed and position, and these gaps.

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
    >>> found, gaps = bridged(frame)
    >>> gaps[0].words, float(found["speed"].iloc[100].round(1))
    ('no speed for 6 s, bridged by position', 10.0)
    """
    time = seconds(frame)
    speed, position = frame[["speed", "position"]].to_numpy(dtype=np.float64).T.copy()
    recorded, known = speed.copy(), np.isfinite(speed)
    gaps = list[Gap]()
    if known.sum() < 2:  # nothing to compare with
        found = dict(_speeds_in(frame, time)).get("position", speed)
        speed, known = np.maximum(found, 0.0), np.ones(time.size, dtype=np.bool_)
    for begin, end in _long_gaps(time, known):
        source, values = _bridge(frame, time, recorded, begin, end)
        if values is not None:
            speed[begin:end] = np.maximum(values, 0.0)
        elif end < time.size and begin > 0:
            ends = (time[begin - 1], time[end]), (recorded[begin - 1], recorded[end])
            speed[begin:end] = np.interp(time[begin:end], *ends)
        gaps.append(Gap(*_sides(time, begin, end), "speed", source))
    unknown = [gap for gap in gaps if not gap.bridge]
    for begin, end in _long_gaps(time, np.isfinite(position)):
        first, last = _sides(time, begin, end)
        apart = all(last <= gap.first or first >= gap.last for gap in unknown)
        own = _position(time, speed, position, begin, end) if apart else None
        if own is not None:
            position[begin:end] = own
        gaps.append(Gap(first, last, "position", "" if own is None else "speed"))
    known = np.isfinite(speed)
    if known.any():  # short gaps
        speed = np.interp(time, time[known], speed[known], left=np.nan, right=np.nan)
    return frame.assign(speed=speed, position=position), gaps


def _sides(time: FloatArray, begin: int, end: int) -> tuple[float, float]:
    """Times [s] of the samples on both sides of those from `begin` to one before `end`."""
    return float(time[max(begin - 1, 0)]), float(time[min(end, time.size - 1)])


def _long_gaps(time: FloatArray, known: BoolArray) -> list[tuple[int, int]]:
    """First sample and one past the last of each gap longer than `SHORT_GAP`."""
    return [each for each in runs_of(~known) if np.diff(_sides(time, *each))[0] > SHORT_GAP]


def _position(
    time: FloatArray, speed: FloatArray, position: FloatArray, begin: int, end: int
) -> FloatArray | None:
    """Positions in a gap by the speed, closed at both ends; None if they do not meet them."""
    if begin == 0 or end == time.size or not np.isfinite(speed[begin - 1 : end + 1]).all():
        return None
    part, moved = slice(begin - 1, end + 1), position[end] - position[begin - 1]
    v, t = speed[part], time[part]
    ran = cumulative_trapezoid(v, t, initial=0.0)
    if not _same_distance(ran[-1], moved):
        return None
    share = ran / ran[-1] if ran[-1] > 0.0 else (t - t[0]) / (t[-1] - t[0])
    return np.asarray((position[begin - 1] + moved * share)[1:-1])


def _same_distance(ran: float, moved: float) -> bool:
    """Whether a speed covers the distance between two positions [m]."""
    return abs(ran - moved) <= SAME_DISTANCE + SAME_DISTANCE_SHARE * abs(moved)


def _bridge(
    frame: pd.DataFrame, time: FloatArray, speed: FloatArray, begin: int, end: int
) -> tuple[str, FloatArray | None]:
    """The speed in a gap that agrees best on both sides, and where it is from; None if none."""
    low, high = _sides(time, begin, end)
    first, last = np.searchsorted(time, [low - NEIGHBOURHOOD - 2.0, high + NEIGHBOURHOOD + 2.0])
    part = slice(int(first), int(last))
    time, speed = time[part], speed[part]
    near = np.isfinite(speed) & (time >= low - NEIGHBOURHOOD) & (time <= high + NEIGHBOURHOOD)
    place = frame["position"].to_numpy(dtype=np.float64)[part]
    found = [
        (*agreeing, name)
        for name, values in _speeds_in(frame.iloc[part], time)
        for agreeing in [_agreeing(time, speed, values, near, place)]
        if agreeing is not None
    ]
    if not found:
        return "", None
    _, values, name = min(found, key=lambda each: each[0])
    return name, values[begin - first : end - first]


def _speeds_in(frame: pd.DataFrame, time: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Other speeds of a trip: of wheels, satellites, and the change of its position."""
    wheels = frame.filter(regex="^wheel_speed")
    if wheels.size:
        yield "wheel speeds", wheels.median(axis=1).to_numpy(dtype=np.float64)
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
    known, gap = np.isfinite(values), np.flatnonzero(~np.isfinite(speed))
    both = near & known
    if both.sum() < 5 or np.diff(time[known]).max() > SHORT_GAP:
        return None
    values = np.interp(time, time[known], values[known])
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
    return None if np.isfinite(moved) and not _same_distance(ran, moved) else (off, values)


def silent_rows(time: FloatArray) -> IntArray:
    """Rows behind which a topic, by its times [s], has none for far longer than usual."""
    steps = np.diff(time)
    usual = float(np.median(steps)) if steps.size else 0.0
    return np.flatnonzero(steps > max(SHORT_GAP, SILENCE * usual))


def _silences(trip: Trip, topic: str, missing: str, origin: pd.Timestamp) -> list[Gap]:
    """Stretches in which a topic has no rows, and what is missing then."""
    time = seconds(trip[topic], origin)
    rows = silent_rows(time)
    ends = zip(time[rows].tolist(), time[rows + 1].tolist(), strict=True)
    return [Gap(*each, missing) for each in ends]


SAMPLING = 0.1
"""Least time between two samples that are kept [s]; work is summed over all of them."""

EFFORTS = {
    "tractive_effort": "traction",
    "dynamic_braking_effort": "dynamic_braking",
    "pneumatic_braking_effort": "pneumatic_braking",
}
"""Columns of efforts, and the works of them."""

COLUMNS: dict[str, tuple[str, ...]] = {
    TRAIN_CONTROLS.name: (*EFFORTS, "tractive_effort_demand", "lever"),
    ENVIRONMENT.name: ("speed_limit", "head_wind"),
    REFERENCE.name: ("speed", "lateness"),
    TRAIN_SLIP_PROTECTION.name: ("active",),
    TRAIN_SUPPLY.name: ("line_voltage", "line_current"),
}
"""What is taken beside speed and position, where it is recorded."""

TOPICS = (
    ESTIMATED_STATE.name, TRAIN_STATE.name, *COLUMNS, TRAIN_AXLES.name, GNSS_MOTION.name,
    EVENTS.name,
)  # fmt: skip
"""What is read of a log."""


JUMP = 20.0
"""Metres by which a position advances more than the speed explains: it was corrected."""

FULL_EFFORT, FULL_LEVER = 0.97, 0.99
"""Share of the train's largest effort, and lever position, from which all there is was used."""

COASTING_SHARE = 0.01
"""Of the largest tractive effort: with less effort of either sign the train coasts."""

UNKNOWN_TIME = 1.0
"""Time without a recorded effort [s] from which the energy of a section is not stated."""

LISTED_GAPS = 6
"""Gaps of a recording that are listed one by one."""

SLIP_LASTS = 2.0
"""Time after an onset [s] that counts as slip where only onsets are recorded."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Thinned samples of a trip; works are cumulated over all samples."""

    trip: str
    origin: int
    estimated: bool
    time: FloatArray
    values: dict[str, FloatArray]
    sums: dict[str, FloatArray]
    gaps: tuple[Gap, ...] = ()
    notes: tuple[str, ...] = ()

    @cached_property
    def speed(self) -> FloatArray:
        """Recorded speed; where it is not known, between its neighbours."""
        time, speed = self.time, self.values["speed"]
        known = np.isfinite(speed)
        if known.sum() < 2:
            position = forward_chainage(self.values["position"])
            return np.nan_to_num(np.gradient(position, time))
        return np.interp(time, time[known], np.maximum(speed[known], 0.0))

    def stands(self, position: FloatArray) -> list[tuple[int, int]]:
        """First and last sample of each stand that lasts."""
        time = self.time
        slow = self.speed <= (STANDING_ESTIMATE if self.estimated else STANDSTILL)
        merged: list[tuple[int, int]] = []
        for begin, end in runs_of(slow):
            near = merged and position[begin] - position[merged[-1][1]] < 2.0
            if near and time[begin] - time[merged[-1][1]] < SHORTEST_STOP:
                begin = merged.pop()[0]
            merged.append((begin, end - 1))
        return [each for each in merged if time[each[1]] - time[each[0]] >= SHORTEST_STOP]

    def doubtful(self, recorded: FloatArray, line: Line) -> tuple[BoolArray, list[str]]:
        """Samples before which a position is missing or jumps, and what they are."""
        step, moved = np.diff(self.time), np.diff(recorded)
        gap = (step > LONGEST_GAP) & (moved > GAP_DISTANCE)
        expected = 0.5 * (self.speed[1:] + self.speed[:-1]) * step
        jump = ~gap & (np.abs(moved - expected) > JUMP + 0.2 * expected)
        notes = [
            f"no position for {step[row]:.0f} s before {km_words(line, float(recorded[row + 1]))}"
            for row in np.flatnonzero(gap)[:3].tolist()
        ] + [
            f"chainage jumps by {moved[row] - expected[row]:+.0f} m at"
            f" {km_words(line, float(recorded[row + 1]))}"
            for row in np.flatnonzero(jump)[:3].tolist()
        ]
        return np.concatenate(([False], gap | jump)), notes

    def gap_notes(self, position: FloatArray, line: Line) -> list[str]:
        """What was not recorded for longer while the train moved, and what stands for it."""
        found = []
        for gap in self.gaps:
            place = np.interp([gap.first, gap.last], self.time, position)
            silent = gap.missing == "sample" and gap.seconds > LONGEST_GAP  # stated as no position
            if place[1] - place[0] > GAP_DISTANCE and not silent:
                first, last = in_km(line, place).tolist()
                found.append(f"{gap.words}: km {first:.3f} to {last:.3f}")
        rest = len(found) - LISTED_GAPS
        return found[:LISTED_GAPS] + ([f"and {counted(rest, 'more gap')}"] if rest > 0 else [])

    def unknown_speed(self) -> BoolArray:
        """Samples before which the speed is neither recorded nor bridged."""
        time, found = self.time, np.zeros(self.time.size, dtype=np.bool_)
        for gap in self.gaps:
            if not gap.bridge and gap.missing in ("speed", "sample"):
                found |= (time > gap.first) & (time <= gap.last + 1e-6)
        return found

    def flags(self, train: Train | None) -> dict[str, BoolArray]:
        """What the train did at each sample."""
        values, speed, found = self.values, self.speed, dict[str, BoolArray]()
        active = values.get("active")
        if active is not None and np.isfinite(active).any():
            found["slip"] = np.nan_to_num(active) > 0.0
        effort = values.get("tractive_effort")
        if effort is None or not np.isfinite(effort).any():
            return found
        effort = np.nan_to_num(effort)
        braking = [np.nan_to_num(values[name]) for name in [*EFFORTS][1:] if name in values]
        largest = float(np.max(effort)) if train is None else train.max_tractive_effort
        idle = np.maximum.reduce([np.abs(effort), *map(np.abs, braking)]) < COASTING_SHARE * largest
        found["coasting"] = idle & (speed > 1.0)
        full = np.nan_to_num(values.get("lever", np.zeros(effort.size))) >= FULL_LEVER
        if "tractive_effort_demand" in values:
            full |= (np.nan_to_num(values["tractive_effort_demand"]) > 1.02 * effort) & ~idle
        if train is not None:
            full |= effort >= FULL_EFFORT * train.tractive_effort_limit(speed)
        found["full_effort"] = full & (effort > 0.0)
        return found


def samples_of(trip: Trip) -> Samples:
    """Speed, position and what else is recorded, on the clock of the position."""
    if TRAIN_CONTROLS.name in trip:
        controls = trip[TRAIN_CONTROLS.name]
        columns, time = [each for each in EFFORTS if each in controls], seconds(controls)
        known = {each: filled(time, controls[each].to_numpy(), SHORT_GAP) for each in columns}
        trip = trip.with_topic(controls.assign(**known))
    present = [
        f"{topic}.{name}"
        for topic, names in COLUMNS.items()
        for name in names
        if topic in trip and name in trip[topic]
    ]
    for state, *_ in POSITION_SOURCES[:2]:
        if state in trip and "position" in trip[state]:
            columns = [f"{state}.speed", f"{state}.position", *present]
            frame = joined(trip, columns, state, max_gap=None).rename(columns=_short)
            if np.isfinite(frame["position"]).any():
                return _thinned(trip, state, frame)
    raise LogError(
        f"trip '{trip.name}' has no chainage",
        place="topics /estimates/state and /train/state",
        remedy="ingest it with its line (--line), which finds the chainage of its fixes",
    )


def _around(trip: Trip, state: str) -> pd.DataFrame:
    """Speed and position of a trip, with what may bridge their gaps."""
    columns = [f"{state}.speed", f"{state}.position"]
    axles = trip.topics.get(TRAIN_AXLES.name, pd.DataFrame())
    columns += [f"{TRAIN_AXLES.name}.{n}" for n in axles if str(n).startswith("wheel_speed")]
    if GNSS_MOTION.name in trip and "speed" in trip[GNSS_MOTION.name]:
        columns.append(f"{GNSS_MOTION.name}.speed")
    return joined(trip, columns, state, max_gap=SHORT_GAP).rename(columns=_short)


def _thinned(trip: Trip, state: str, frame: pd.DataFrame) -> Samples:
    """A sample every `SAMPLING` seconds; rows without position count for the works alone."""
    origin, gaps = pd.Timestamp(frame.index[0]), list[Gap]()
    if frame[["speed", "position"]].isna().any(axis=None):
        filled, gaps = bridged(_around(trip, state))
        frame = frame.assign(speed=filled["speed"], position=filled["position"])
    gaps += _silences(trip, state, "sample", origin)
    if TRAIN_CONTROLS.name in trip:
        gaps += _silences(trip, TRAIN_CONTROLS.name, "effort", origin)
    time = seconds(frame, origin)
    kept = np.flatnonzero(np.isfinite(frame["position"].to_numpy()))
    # The first sample of each tick.
    kept = kept[np.diff(np.floor(time[kept] / SAMPLING + 1e-6), prepend=-np.inf) > 0.0]
    works = _integrals(frame, time)
    notes = _seldom_notes(trip, state, frame, time, works)
    sums = {name: values[kept] for name, values in works.items()}
    columns = {name: frame[name].to_numpy(dtype=np.float64)[kept] for name in frame.columns}
    time = time[kept]
    unknown = [each for each in gaps if not each.bridge and each.missing != "position"]
    position = columns["position"]
    silent = np.zeros(time.size)
    for gap in unknown:
        low, high = np.interp([gap.first, gap.last], time, position)
        if high - low > GAP_DISTANCE:
            silent = silent + np.clip(time, gap.first, gap.last) - gap.first
    for name in (f"unknown_{work}" for work in EFFORTS.values()):
        if name in sums:
            sums[name] = sums[name] + silent
    known = np.isfinite(columns.get("tractive_effort", np.zeros(0)))
    if known.size and 0.5 <= known.mean() < 1.0:  # recorded otherwise
        gaps += [Gap(*_sides(time, *each), "effort") for each in _long_gaps(time, known)]
    estimated = state != TRAIN_STATE.name
    start = int(origin.as_unit("ns").value)
    return Samples(trip.name, start, estimated, time, columns, sums, tuple(gaps), notes)


def _seldom_notes(
    trip: Trip, state: str, frame: pd.DataFrame, time: FloatArray, works: dict[str, FloatArray]
) -> tuple[str, ...]:
    """How well the energy is known where speed or efforts are recorded seldom."""
    topics = [each for each in (state, TRAIN_CONTROLS.name) if len(trip.topics.get(each, ())) > 1]
    step = max((float(np.median(np.diff(seconds(trip[each])))) for each in topics), default=0.0)
    whole = works["traction"][-1] if "traction" in works else 0.0
    if step <= SHORT_GAP or not whole:
        return ()
    every = min(round(step * (time.size - 1) / np.ptp(time)), time.size // 3)
    if not every:
        return ()
    # With half and a third of the samples the energy differs by more than with all it is wrong.
    fewer = [slice(first * every, None, n * every) for n in (2, 3) for first in range(n)]
    found = [_integrals(frame.iloc[part], time[part])["traction"][-1] for part in fewer]
    off = float(np.max(np.abs(np.array(found) / whole - 1.0)))
    return (f"speed or efforts every {step:.3g} s: energy within ± {max(off, 0.01):.0%}",)


def _short(name: str) -> str:
    """Name of a column without its topic, unless two topics have it."""
    topic, _, column = name.rpartition(".")
    kind = {REFERENCE.name: "reference_", GNSS_MOTION.name: "gnss_"}.get(topic, "")
    return f"{kind}{column}"


def _integrals(frame: pd.DataFrame, time: FloatArray) -> dict[str, FloatArray]:
    """Work since the frame's first row by the trapezoidal rule, and time without efforts."""
    speed = np.nan_to_num(frame["speed"].to_numpy())
    powers = {EFFORTS[name]: frame[name].to_numpy() * speed for name in EFFORTS if name in frame}
    if "line_voltage" in frame and "line_current" in frame:
        powers["supply"] = frame["line_voltage"].to_numpy() * frame["line_current"].to_numpy()
    found: dict[str, FloatArray] = {}
    for name, power in powers.items():
        lacks = ~np.isfinite(power) & ((speed > STANDSTILL) | (name == "supply"))
        for key, values in ((name, np.nan_to_num(power)), (f"unknown_{name}", lacks.astype(float))):
            found[key] = cumulative_trapezoid(values, time, initial=0.0)
    return found


UNKNOWN = Quantity(float("nan"), float("nan"), "assumed", "nothing states it")


@dataclass(frozen=True, slots=True)
class Stand:
    """The train at rest for at least `SHORTEST_STOP`.

    Attributes
    ----------
    position : float [m]
    duration : float [s]
        0 of the stand before the first departure and of that after the last arrival: how long a
        recording goes on there says nothing of the trip.
    station : str
        Empty off a station.
    """

    position: float
    duration: float
    station: str


@dataclass(frozen=True, eq=False)
class DrivenTrip:
    """A trip, or a plan, from its first departure to its last arrival; arrays (n,).

    Attributes
    ----------
    name, direction : str
    line : Line
        As travelled.
    train : Train or None
    mass : Quantity [kg]
        Of the loaded train; not known where nothing states the load.
    departure : int [ns since 1970 UTC]
    time : array [s]
        Since departure.
    running : array [s]
        The same without the time of the stands.
    position : array [m]
        Non-decreasing, in the direction of travel.
    speed : array [m/s]
    stands : tuple of Stand
        In order of position, those at both ends with a duration of 0.
    distance : float [m]
        Between the lowest and the highest position recorded.
    sums : dict of str to array
        Cumulated since the recording began: work ``traction``, ``dynamic_braking``,
        ``pneumatic_braking`` at the wheel rims, ``supply`` from the line as recorded, and ``line``:
        that, or what follows from the train's efficiencies [J]; time in motion of
        ``unknown_traction`` and the like [s]; what is not recorded is missing.
    flags : dict of str to bool array
        ``coasting``, ``full_effort``, ``slip``, ``doubtful`` (position), ``unknown_speed``
        (neither recorded nor bridged before the sample); what is not recorded is missing.
    signals : dict of str to array
        ``limit``, ``head_wind`` [m/s] as recorded, ``reference_speed`` [m/s], ``lateness`` [s].
    slips : array [s] or None
        When the slip protection began to act, since departure; None where that is not recorded.
    gain : Quantity
        Recorded over true effort by the stored passport, by which works are corrected.
    notes : tuple of str
        What was repaired, or cannot be known.
    planned : bool
        A trajectory, not a recording.
    """

    name: str
    direction: str
    line: Line
    train: Train | None
    mass: Quantity
    departure: int
    time: FloatArray
    running: FloatArray
    position: FloatArray
    speed: FloatArray
    stands: tuple[Stand, ...]
    distance: float
    sums: dict[str, FloatArray] = field(default_factory=dict)
    flags: dict[str, BoolArray] = field(default_factory=dict)
    signals: dict[str, FloatArray] = field(default_factory=dict)
    slips: FloatArray | None = None
    gain: Quantity = UNKNOWN
    notes: tuple[str, ...] = ()
    planned: bool = False

    @property
    def covered(self) -> tuple[float, float]:
        """First and last position [m]."""
        return float(self.position[0]), float(self.position[-1])

    def same_drive(self, other: DrivenTrip) -> bool:
        """Whether two are of the same recording."""
        mine, its = ((each.time, each.position, each.speed) for each in (self, other))
        return (self.direction, self.departure) == (other.direction, other.departure) and all(
            map(np.array_equal, mine, its)
        )

    def unknown(self, work: str = "traction") -> bool:
        """Whether a work is not known for more than `UNKNOWN_TIME` of the trip."""
        return bool(np.ptp(self.sums[f"unknown_{work}"]) > UNKNOWN_TIME)

    def work(self, name: str) -> float:
        """A work of the whole trip [J]; 0 where it is not recorded, NaN where a part is unknown."""
        if name not in self.sums:
            return 0.0
        return float("nan") if self.unknown(name) else float(self.sums[name][-1])

    @property
    def drawn_speed(self) -> FloatArray:
        """Speed [m/s] with breaks (NaN) where it is not known."""
        # The line from a sample to the one behind a gap is no speed.
        return np.where(self.flags.get("unknown_speed", False), np.nan, self.speed)

    @property
    def drawn_work(self) -> FloatArray:
        """Tractive work [J] with breaks (NaN) where no efforts are recorded."""
        unknown = self.sums["unknown_traction"]
        return np.where(np.diff(unknown, prepend=unknown[0]) > 0.0, np.nan, self.sums["traction"])

    @property
    def duration(self) -> float:
        """From departure to arrival, dwell included [s]."""
        return float(self.time[-1])

    def limit_at(self, position: ArrayLike) -> FloatArray:
        """Permitted speed [m/s] at each position; a recorded limit that is lower counts."""
        stated, recorded = self.permitted(position), self.signals.get("limit")
        if recorded is None:
            return stated
        return np.fmin(stated, recorded[np.rint(self.sample_at(position)).astype(np.int64)])

    def permitted(self, position: ArrayLike) -> FloatArray:
        """Speed limit of the line over the train's length [m/s] at each position [m]."""
        train = self.train
        length, most = (0.0, np.inf) if train is None else (train.length, train.max_speed)
        return np.minimum(self.line.limits_over(length)(position), most)

    def sample_at(self, position: ArrayLike) -> FloatArray:
        """Number of the sample, with its fraction, at which each position is reached.

        Positions outside are those of the nearer end.
        """
        s = np.clip(np.asarray(position, dtype=np.float64), *self.covered)
        high = np.clip(np.searchsorted(self.position, s, side="left"), 1, self.position.size - 1)
        low = high - 1
        step = self.position[high] - self.position[low]
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(step > 0.0, (s - self.position[low]) / step, 1.0)
        found = low + np.clip(share, 0.0, 1.0)
        # A position that is recorded in steps is reached before the train stands at its end.
        found = np.where(s >= self.position[-1], self.position.size - 1.0, found)
        return np.asarray(np.where(s <= self.position[0], 0.0, found))

    def at(self, values: FloatArray, position: ArrayLike) -> FloatArray:
        """Values of the samples at each position [m]."""
        return np.interp(self.sample_at(position), np.arange(values.size), values)

    def share_of(self, flag: str, edges: FloatArray) -> FloatArray:
        """Share of the running time of each cell between `edges` (n + 1,) with a flag; (n,).

        None where the flag is not recorded.
        """
        if flag not in self.flags:
            return np.zeros(edges.size - 1)
        step = np.diff(self.running, prepend=0.0)
        part = np.diff(self.at(np.cumsum(step * self.flags[flag]), edges))
        whole = np.diff(self.at(self.running, edges))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(whole > 0.0, part / whole, 0.0)


def driven_trip(given: Given, line: Line | None = None) -> DrivenTrip:
    """What a comparison needs of a trip.

    Parameters
    ----------
    given : Trip or path of a log
    line : Line, optional
        In its own direction; default: the one that the trip carries.

    Raises
    ------
    LogError
        If the trip has no chainage, never moves, or runs back and forth.
    InputError
        If neither the trip nor the caller knows the line, or the trip is of another.

    Examples
    --------
    >>> trip = driven_trip("sample_logs/stopping.mcap")
    >>> [(stand.station, round(stand.duration)) for stand in trip.stands][:2]
    [('St.Gallen', 0), ('Gossau SG', 42)]
    """
    view = view_of(given, TOPICS)
    if line is None:
        return view.once(_driven)
    return _driven(view, line)


def _driven(view: TripView, line: Line | None = None) -> DrivenTrip:
    trip = view.trip
    travelled = _line_as_travelled(trip, line)
    train = view.train if TRAIN_ATTACHMENT in trip.attachments else None
    parts = _reduced(trip, travelled, train)
    slips, onsets, flags = None, protection_onsets(trip), dict(parts.flags)
    if onsets is not None:
        slips = (np.asarray(onsets, dtype=np.int64) - parts.departure) / NANOSECONDS
        slips = slips[(slips >= 0.0) & (slips <= parts.duration)]
        since = parts.time - np.append(-np.inf, slips)[np.searchsorted(slips, parts.time, "right")]
        flags.setdefault("slip", since <= SLIP_LASTS)
    elif "slip" not in flags:
        flags |= _slipping(view, parts)
    return replace(parts, slips=slips, flags=flags)


def _slipping(view: TripView, parts: DrivenTrip) -> dict[str, BoolArray]:
    """Samples up to which a powered axle slipped, by its wheel speed; nothing where none shows."""
    if TRAIN_AXLES.name not in view.trip or parts.train is None:
        return {}
    try:
        found = slip(view)
    except TrainlogError:
        return {}
    seconds = (found.time.asi8 - parts.departure) / NANOSECONDS
    total = np.concatenate(([0], np.cumsum(found.slipping.any(axis=1))))
    until = total[np.searchsorted(seconds, parts.time, side="right")]
    return {"slip": np.diff(until, prepend=until[0]) > 0}


def planned_trip(trajectory: Trajectory, line: Line, train: Train | None = None) -> DrivenTrip:
    """A trajectory in the form of a trip: that of the configuration which arrives last.

    Parameters
    ----------
    trajectory : Trajectory
    line : Line
        In its own direction.
    train : Train, optional
    """
    row = trajectory.latest
    curve = planned_time_distance(trajectory, row)
    travelled = line.travelled(trajectory.direction)
    configuration = trajectory.configurations[row]
    ends = [
        Stand(float(trajectory.positions[end]), 0.0, station_at(travelled, each))
        for end, each in ((0, trajectory.positions[0]), (-1, trajectory.positions[-1]))
        if trajectory.speeds[row, end] <= STANDSTILL
    ]
    tractive = trajectory.tractive_effort_at(curve.position)
    each_cell = trajectory.tractive_effort * np.diff(trajectory.positions)
    work = np.interp(curve.position, trajectory.positions, np.append(0.0, np.cumsum(each_cell)))
    braking = trajectory.braking_effort[row, trajectory.cell_of(curve.position)]
    none = COASTING_SHARE * (np.inf if train is None else train.max_tractive_effort)
    idle = (np.abs(tractive) < none) & (braking < none)
    return DrivenTrip(
        name="trajectory",
        direction=trajectory.direction,
        line=travelled,
        train=train,
        mass=Quantity(configuration.mass, 0.0, "recorded"),
        departure=0,
        time=curve.seconds,
        running=curve.seconds,
        position=curve.position,
        speed=trajectory.speed_at(row, curve.position),
        stands=tuple(ends),
        distance=float(np.ptp(trajectory.positions)),
        sums={"traction": work, "unknown_traction": np.zeros(work.size)},
        flags={} if train is None else {"coasting": idle},
        planned=True,
    )


def in_succession(sections: Sequence[DrivenTrip], dwells: Sequence[float]) -> DrivenTrip:
    """Runs from stop to stop as one trip that stands between them.

    Parameters
    ----------
    sections : sequence of m DrivenTrip
        Of one train, in order; each begins where the one before ends.
    dwells : sequence of m - 1 float [s]
    """
    first, stands = sections[0], list(sections[0].stands)
    for dwell, each in zip(dwells, sections[1:], strict=True):
        stands[-1:] = [replace(stands[-1], duration=dwell), *each.stands[1:]]
    moving = np.cumsum([0.0, *(each.running[-1] for each in sections[:-1])])
    departures = np.cumsum([0.0, *(each.time[-1] for each in sections[:-1])])
    departures += np.cumsum([0.0, *dwells])

    def together(name: str, before: FloatArray | None = None) -> FloatArray:
        offsets = np.zeros(len(sections)) if before is None else before
        parts = zip(sections, offsets, strict=True)
        return np.concatenate([getattr(each, name) + offset for each, offset in parts])

    def of_all(name: str) -> dict[str, Any]:
        held = [getattr(each, name) for each in sections]
        names = [key for key in held[0] if all(key in each for each in held)]
        return {key: np.concatenate([each[key] for each in held]) for key in names}

    sums, begins = of_all("sums"), np.cumsum([each.time.size for each in sections])[:-1]
    for values in sums.values():
        # Each section counts from its own beginning.
        for node in begins.tolist():
            values[node:] += values[node - 1] - values[node]
    return replace(
        first,
        time=together("time", departures),
        running=together("running", moving),
        position=np.maximum.accumulate(together("position")),
        speed=together("speed"),
        stands=tuple(stands),
        distance=sum(each.distance for each in sections),
        sums=sums,
        flags=of_all("flags"),
        signals=of_all("signals"),
        slips=(
            None if any(each.slips is None for each in sections) else together("slips", departures)
        ),
        notes=tuple(dict.fromkeys(note for each in sections for note in each.notes)),
    )


def _line_as_travelled(bare: Trip, line: Line | None) -> Line:
    """The line in the direction of travel: the given one, or the trip's own."""
    if line is None:
        if LINE_ATTACHMENT not in bare.attachments:
            raise InputError(
                f"trip '{bare.name}' has no line",
                remedy="give it with --line (line= in Python)",
            )
        return line_of(bare)
    named = bare.metadata.get("line")
    if named and named != line.name:
        raise InputError(
            f"trip '{bare.name}' ran on line '{named}', not on '{line.name}'",
            remedy="leave it out, or give the line it ran on",
        )
    return line.travelled(bare.metadata.get("direction"))


def _reduced(trip: Trip, line: Line, train: Train | None) -> DrivenTrip:
    """From samples to the motion between first departure and last arrival."""
    table, (mass, gain) = samples_of(trip), _mass_and_gain(trip, train)
    if table.time.size < 2:
        raise LogError(
            f"trip '{trip.name}' has one sample with a chainage: that shows no motion",
            remedy="leave it out",
        )
    recorded, position, notes = one_way(
        trip.name, line, table.time, table.speed, table.values["position"]
    )
    stands = table.stands(position)
    first, last = 0, table.time.size - 1
    if stands and stands[0][0] == 0:
        first = min(stands[0][1] + 1, last)
    if stands and stands[-1][1] == last:
        last = stands[-1][0]
    if first >= last:
        raise LogError(
            f"trip '{trip.name}' never moves: there is nothing to compare",
            remedy="leave it out",
        )
    rest, step, listed = np.zeros(table.time.size), np.diff(table.time), list[Stand]()
    for begin, end in stands:
        where, lasts = float(position[begin]), 0.0
        if first <= begin and end <= last:
            rest[begin + 1 : end + 1] = step[begin:end]
            lasts = float(table.time[end] - table.time[begin])
        listed.append(Stand(where, lasts, station_at(line, where)))
    kept = slice(first, last + 1)
    time = table.time[kept] - table.time[first]
    standing = np.cumsum(rest[kept])
    doubtful, more = table.doubtful(recorded, line)
    more += table.gap_notes(position, line)
    flags = table.flags(train) | {"doubtful": doubtful, "unknown_speed": table.unknown_speed()}
    factor = gain.value if gain.known else 1.0
    sums = {
        name: values[kept] / (1.0 if "supply" in name or "unk" in name else factor)
        for name, values in table.sums.items()
    }
    works, most = EFFORTS.values(), 0.5 * (time[-1] - standing[-1])
    unknown = [work for work in works if work in sums and sums[f"unknown_{work}"][-1] > most]
    if "traction" in unknown:
        unknown = list(works)
        flags = {name: flag for name, flag in flags.items() if name in _OF_MOTION}
    sums = {n: v for n, v in sums.items() if n.removeprefix("unknown_") not in unknown}
    sums |= _from_line(sums, train)
    return DrivenTrip(
        name=trip.name,
        direction=trip.metadata.get("direction", "forward"),
        line=line,
        train=train,
        mass=mass,
        departure=table.origin + round(float(table.time[first]) * NANOSECONDS),
        time=time,
        running=time - standing,
        position=position[kept],
        speed=table.speed[kept],
        stands=tuple(listed),
        distance=float(np.ptp(recorded)),
        sums=sums,
        flags={name: flag[kept] for name, flag in flags.items()},
        signals={
            name: table.values[column][kept]
            for name, column in _SIGNALS.items()
            if column in table.values and np.isfinite(table.values[column]).any()
        },
        gain=gain,
        notes=(*table.notes, *notes, *more),
    )


Energy = TypeVar("Energy", float, FloatArray)


def line_energy(train: Train, traction: Energy, dynamic_braking: Energy) -> Energy:
    """Energy from the line [J]: traction over its efficiency, less what braking feeds back."""
    return traction / train.efficiency_traction - train.efficiency_regeneration * dynamic_braking


def _from_line(sums: Mapping[str, FloatArray], train: Train | None) -> dict[str, FloatArray]:
    """Energy from the line, recorded or by the train's efficiencies, and time without it."""
    if "supply" in sums:
        return {"line": sums["supply"], "unknown_line": sums["unknown_supply"]}
    if "traction" not in sums or train is None:
        return {}
    none = np.zeros(sums["traction"].size)
    unknown = sums["unknown_traction"], sums.get("unknown_dynamic_braking", none)
    energy = line_energy(train, sums["traction"], sums.get("dynamic_braking", none))
    return {"line": energy, "unknown_line": np.maximum(*unknown)}


_OF_MOTION = ("slip", "doubtful", "unknown_speed")
"""Flags that do not rest on efforts."""

_SIGNALS = {
    "limit": "speed_limit",
    "head_wind": "head_wind",
    "reference_speed": "reference_speed",
    "lateness": "reference_lateness",
}


def _mass_and_gain(bare: Trip, train: Train | None) -> tuple[Quantity, Quantity]:
    """Mass of the loaded train [kg], and the gain of its recorded efforts, as far as known."""
    stored = passport_of(bare)
    gain = UNKNOWN if stored is None else stored.effort_gain
    if stored is not None and stored.mass.known:
        return stored.mass, gain
    load = None if train is None else recorded_load(bare, train)
    if load is None or train is None:
        return UNKNOWN, gain
    return Quantity(train.mass + load.value, load.std, load.source), gain
