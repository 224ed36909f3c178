"""A trip reduced to what a comparison by position needs.

Speed, position and cumulated work on one clock (`analysis.comparison.reading`), stands apart from
the running time.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import median_filter

from analysis.adhesion.events import protection_onsets
from analysis.comparison.reading import EFFORTS, Samples, described, samples_of
from analysis.given import Given
from trainlog.along_line import (
    GAP_DISTANCE,
    LONGEST_GAP,
    TimeDistance,
    forward_chainage,
    planned_time_distance,
)
from trainlog.arrays import BoolArray, FloatArray
from trainlog.display import counted
from trainlog.errors import InputError, LogError
from trainlog.formats.railway import line_of, passport_of, recorded_load, train_of
from trainlog.mcap import read_log
from trainlog.railway import Line, Train, Trajectory
from trainlog.railway.kilometres import STATION_REACH, km_words, station_at
from trainlog.railway.passport import Quantity
from trainlog.spans import runs_of
from trainlog.topics import (
    EVENTS,
    STANDSTILL,
    TRAIN_SLIP_PROTECTION,
)
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip
from trainlog.units import NANOSECONDS

SHORTEST_STOP = 5.0
"""A train that stands for less [s] is creeping, not stopping."""

STANDING_ESTIMATE = 0.3
"""Estimated speed [m/s] up to which a train stands: satellites' speeds waver at rest."""

NOTED_SETBACK, LARGEST_SETBACK = 2.0, 200.0
"""Metres by which recorded chainage runs backwards that are stated, and that are refused."""

SPIKE, SPIKE_SAMPLES = 50.0, 51
"""A position so far [m] off the median of so many around it, less what the speed explains, is no
position."""

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
        ``pneumatic_braking`` at the wheel rims and ``supply`` from the line [J], time in motion of
        ``unknown_effort`` or braking [s]; what is not recorded is missing.
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

    def unknown(self, work: str = "traction") -> bool:
        """Whether a work is not known for more than `UNKNOWN_TIME` of the trip."""
        time = self.sums["unknown_effort" if work == "traction" else f"unknown_{work}"]
        return bool(time[-1] - time[0] > UNKNOWN_TIME)

    @property
    def drawn_speed(self) -> FloatArray:
        """Speed [m/s] with breaks (NaN) where it is not known."""
        unknown = self.flags.get("unknown_speed")
        if unknown is None:
            return self.speed
        # The line from a sample to the one behind a gap is no speed.
        return np.where(unknown, np.nan, self.speed)

    @property
    def duration(self) -> float:
        """From departure to arrival, dwell included [s]."""
        return float(self.time[-1])

    @cached_property
    def curve(self) -> TimeDistance:
        """Time-distance curve since departure."""
        nanoseconds = self.departure + np.rint(self.time * NANOSECONDS).astype(np.int64)
        return TimeDistance(self.departure, nanoseconds, self.position)

    @cached_property
    def limit(self) -> FloatArray:
        """Permitted speed [m/s] at each sample: the line's over the train, or a lower recorded."""
        stated = self.permitted(self.position)
        recorded = self.signals.get("limit")
        return stated if recorded is None else np.fmin(stated, recorded)

    def permitted(self, position: ArrayLike) -> FloatArray:
        """Speed limit of the line over the train's length [m/s] at each position [m]."""
        length = 0.0 if self.train is None else self.train.length
        limits = self.line.limits_over(length)(position)
        return np.asarray(limits if self.train is None else np.minimum(limits, self._top))

    @property
    def _top(self) -> float:
        return np.inf if self.train is None else self.train.max_speed

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
        return np.asarray(low + np.clip(share, 0.0, 1.0))

    def at(self, values: FloatArray, position: ArrayLike) -> FloatArray:
        """Values of the samples at each position [m]."""
        return np.interp(self.sample_at(position), np.arange(values.size), values)

    def share_of(self, flag: str, edges: FloatArray) -> FloatArray:
        """Share of the running time of each cell between `edges` (n + 1,) with a flag; (n,)."""
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
    bare = described(given)
    travelled = _line_as_travelled(bare, line)
    train = train_of(bare) if TRAIN_ATTACHMENT in bare.attachments else None
    table = samples_of(given, bare)
    mass, gain = _mass_and_gain(bare, train)
    parts = _Reduction(bare, travelled, train, gain).reduced(table)
    slips = _onsets(given, parts)
    flags = dict(parts.flags)
    if slips is not None and "slip" not in flags:
        since = parts.time - np.append(-np.inf, slips)[np.searchsorted(slips, parts.time, "right")]
        flags["slip"] = since <= SLIP_LASTS
    return replace(parts, mass=mass, slips=slips, flags=flags)


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
    travelled = line.reversed() if trajectory.direction == "reverse" else line
    configuration = trajectory.configurations[row]
    ends = [
        Stand(float(trajectory.positions[end]), 0.0, station_at(travelled, each))
        for end, each in ((0, trajectory.positions[0]), (-1, trajectory.positions[-1]))
        if trajectory.speeds[row, end] <= STANDSTILL
    ]
    tractive = trajectory.tractive_effort_at(curve.position)
    work = np.concatenate(
        ([0.0], np.cumsum(0.5 * (tractive[1:] + tractive[:-1]) * np.diff(curve.position)))
    )
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
        sums={"traction": work, "unknown_effort": np.zeros(work.size)},
        flags={} if train is None else {"coasting": idle},
        planned=True,
    )


def _line_as_travelled(bare: Trip, line: Line | None) -> Line:
    """The line in the direction of travel: the given one, or the trip's own."""
    if line is None:
        if LINE_ATTACHMENT not in bare.attachments:
            raise InputError(
                f"trip '{bare.name}' carries no line",
                remedy="give it with --line (line= in Python)",
            )
        return line_of(bare)
    named = bare.metadata.get("line")
    if named and named != line.name:
        raise InputError(
            f"trip '{bare.name}' ran on line '{named}', not on '{line.name}'",
            remedy="leave it out, or give the line it ran on",
        )
    return line.reversed() if bare.metadata.get("direction") == "reverse" else line


@dataclass(frozen=True, eq=False)
class _Reduction:
    """From thinned samples to a trip between its first departure and last arrival."""

    bare: Trip
    line: Line
    train: Train | None
    gain: Quantity

    def reduced(self, table: Samples) -> DrivenTrip:
        speed = self._speed(table)
        recorded, spikes = self._without_spikes(table, speed)
        position, notes = self._chainage(recorded)
        stands = self._stands(table, position, speed)
        first, last = 0, table.time.size - 1
        if stands and stands[0][0] == 0:
            first = min(stands[0][1] + 1, last)
        if stands and stands[-1][1] == last:
            last = stands[-1][0]
        if first >= last:
            raise LogError(
                f"trip '{self.bare.name}' never moves: there is nothing to compare",
                remedy="leave it out",
            )
        rest = np.zeros(table.time.size)
        step = np.diff(table.time)
        listed = []
        for begin, end in stands:
            if begin >= first and end <= last and begin < end:
                rest[begin + 1 : end + 1] = step[begin:end]
            inside = first <= begin and end <= last
            where = float(position[begin])
            listed.append(
                Stand(
                    where,
                    float(table.time[end] - table.time[begin]) if inside else 0.0,
                    station_at(self.line, where),
                )
            )
        kept = slice(first, last + 1)
        time = table.time[kept] - table.time[first]
        standing = np.cumsum(rest[kept])
        doubtful, more = self._doubtful(table, recorded, speed)
        more += self._gap_notes(table, position)
        flags = self._flags(table, speed) | {"doubtful": doubtful, "unknown_speed": _within(table)}
        gain = self.gain.value if self.gain.known else 1.0
        sums = {
            name: values[kept] / (1.0 if "supply" in name or "unk" in name else gain)
            for name, values in table.sums.items()
        }
        if "traction" in sums and sums["unknown_effort"][-1] > 0.5 * (time[-1] - standing[-1]):
            sums = {name: values for name, values in sums.items() if "supply" in name}
            flags = {name: flag for name, flag in flags.items() if name in _OF_MOTION}
        for name in ("dynamic_braking", "pneumatic_braking"):
            if name in sums and sums[f"unknown_{name}"][-1] > 0.5 * (time[-1] - standing[-1]):
                del sums[name]
        return DrivenTrip(
            name=self.bare.name,
            direction=self.bare.metadata.get("direction", "forward"),
            line=self.line,
            train=self.train,
            mass=UNKNOWN,
            departure=table.origin + round(float(table.time[first]) * NANOSECONDS),
            time=time,
            running=time - standing,
            position=position[kept],
            speed=speed[kept],
            stands=tuple(listed),
            distance=float(np.ptp(recorded)),
            sums=sums,
            flags={name: flag[kept] for name, flag in flags.items()},
            signals={
                name: table.values[column][kept]
                for name, column in _SIGNALS.items()
                if column in table.values and np.isfinite(table.values[column]).any()
            },
            gain=self.gain,
            notes=(*spikes, *notes, *more),
        )

    def _chainage(self, recorded: FloatArray) -> tuple[FloatArray, list[str]]:
        """Non-decreasing chainage, and what had to be moved for it."""
        position = forward_chainage(recorded)
        moved = np.abs(position - np.maximum(recorded, 0.0))
        worst = int(np.argmax(moved))
        if moved[worst] > LARGEST_SETBACK:
            raise LogError(
                f"trip '{self.bare.name}' runs backwards by {2.0 * moved[worst]:.0f} m",
                place=km_words(self.line, float(recorded[worst])),
                remedy="cut it into trips of one direction (trainlog convert --from --to), or"
                " ingest it again with its line: a counter that starts anew is repaired there",
            )
        notes = []
        if moved[worst] > NOTED_SETBACK:
            notes.append(
                f"chainage set back at {km_words(self.line, float(recorded[worst]))}:"
                f" moved by up to {moved[worst]:.1f} m"
            )
        beyond = float(position[-1] - self.line.length)
        if beyond > STATION_REACH:
            notes.append(
                f"ends {beyond:.0f} m beyond the line's end: chainage or line may be wrong"
            )
        return position, notes

    def _without_spikes(self, table: Samples, speed: FloatArray) -> tuple[FloatArray, list[str]]:
        """Chainage without samples far off their neighbours, and how many there were."""
        recorded = table.values["position"]
        steps = 0.5 * (speed[1:] + speed[:-1]) * np.diff(table.time)
        run = np.concatenate(([0.0], np.cumsum(steps)))
        offset = recorded - run
        usual = median_filter(offset, SPIKE_SAMPLES, mode="reflect")
        spikes = np.abs(offset - usual) > SPIKE
        if not spikes.any():
            return recorded, []
        where = float(run[spikes][0] + usual[spikes][0])
        note = f"chainage: {counted(int(spikes.sum()), 'sample')} far off left out"
        return np.where(spikes, run + usual, recorded), [
            f"{note}, first at {km_words(self.line, where)}"
        ]

    def _speed(self, table: Samples) -> FloatArray:
        """Recorded speed; where it is not known, between its neighbours."""
        speed = table.values["speed"]
        known = np.isfinite(speed)
        if known.sum() < 2:
            position = forward_chainage(table.values["position"])
            return np.nan_to_num(np.gradient(position, table.time))
        return np.interp(table.time, table.time[known], np.maximum(speed[known], 0.0))

    def _stands(
        self, table: Samples, position: FloatArray, speed: FloatArray
    ) -> list[tuple[int, int]]:
        """First and last sample of each stand that lasts."""
        slow = speed <= (STANDING_ESTIMATE if table.estimated else STANDSTILL)
        merged: list[tuple[int, int]] = []
        for begin, end in runs_of(slow):
            near = merged and position[begin] - position[merged[-1][1]] < 2.0
            if near and table.time[begin] - table.time[merged[-1][1]] < SHORTEST_STOP:
                merged[-1] = (merged[-1][0], end - 1)
            else:
                merged.append((begin, end - 1))
        return [
            each for each in merged if table.time[each[1]] - table.time[each[0]] >= SHORTEST_STOP
        ]

    def _doubtful(
        self, table: Samples, recorded: FloatArray, speed: FloatArray
    ) -> tuple[BoolArray, list[str]]:
        """Samples before which a position is missing or jumps, and what they are."""
        step, moved = np.diff(table.time), np.diff(recorded)
        gap = (step > LONGEST_GAP) & (moved > GAP_DISTANCE)
        expected = 0.5 * (speed[1:] + speed[:-1]) * step
        jump = ~gap & (np.abs(moved - expected) > JUMP + 0.2 * expected)
        notes = [
            f"no position for {step[row]:.0f} s before"
            f" {km_words(self.line, float(recorded[row + 1]))}"
            for row in np.flatnonzero(gap)[:3].tolist()
        ] + [
            f"chainage jumps by {moved[row] - expected[row]:+.0f} m at"
            f" {km_words(self.line, float(recorded[row + 1]))}"
            for row in np.flatnonzero(jump)[:3].tolist()
        ]
        return np.concatenate(([False], gap | jump)), notes

    def _gap_notes(self, table: Samples, position: FloatArray) -> list[str]:
        """What was not recorded for longer while the train moved, and what stands for it."""
        found = []
        for gap in table.gaps:
            times = (np.array([gap.first, gap.last]) - table.origin) / NANOSECONDS
            place = np.interp(times, table.time, position)
            silent = gap.missing == "sample" and gap.seconds > LONGEST_GAP  # stated as no position
            if place[1] - place[0] > GAP_DISTANCE and not silent:
                found.append(f"{gap.words}: km {place[0] / 1e3:.3f} to {place[1] / 1e3:.3f}")
        rest = len(found) - LISTED_GAPS
        return found[:LISTED_GAPS] + ([f"and {counted(rest, 'more gap')}"] if rest > 0 else [])

    def _flags(self, table: Samples, speed: FloatArray) -> dict[str, BoolArray]:
        """What the train did at each sample."""
        values, found = table.values, dict[str, BoolArray]()
        active = values.get("active")
        if active is not None and np.isfinite(active).any():
            found["slip"] = np.nan_to_num(active) > 0.0
        effort = values.get("tractive_effort")
        if effort is None or not np.isfinite(effort).any():
            return found
        effort = np.nan_to_num(effort)
        braking = [np.nan_to_num(values[name]) for name in EFFORTS[1:] if name in values]
        largest = float(np.max(effort)) if self.train is None else self.train.max_tractive_effort
        idle = np.maximum.reduce([np.abs(effort), *map(np.abs, braking)]) < COASTING_SHARE * largest
        found["coasting"] = idle & (speed > 1.0)
        full = np.nan_to_num(values.get("lever", np.zeros(effort.size))) >= FULL_LEVER
        if "tractive_effort_demand" in values:
            full |= (np.nan_to_num(values["tractive_effort_demand"]) > 1.02 * effort) & ~idle
        if self.train is not None:
            full |= effort >= FULL_EFFORT * self.train.tractive_effort_limit(speed)
        found["full_effort"] = full & (effort > 0.0)
        return found


def _within(table: Samples) -> BoolArray:
    """Samples before which the speed is neither recorded nor bridged."""
    found = np.zeros(table.time.size, dtype=np.bool_)
    for gap in table.gaps:
        if not gap.bridge and gap.missing in ("speed", "sample"):
            first, last = (np.array([gap.first, gap.last]) - table.origin) / NANOSECONDS
            found |= (table.time > first) & (table.time <= last + 1e-6)
    return found


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


def _onsets(given: Given, trip: DrivenTrip) -> FloatArray | None:
    """When slip protection began to act [s since departure]; None where it is not recorded."""
    topics = [EVENTS.name, TRAIN_SLIP_PROTECTION.name]
    onsets = protection_onsets(given if isinstance(given, Trip) else read_log(given, topics))
    if onsets is None:
        return None
    when = (np.asarray(onsets, dtype=np.int64) - trip.departure) / NANOSECONDS
    return when[(when >= 0.0) & (when <= trip.duration)]
