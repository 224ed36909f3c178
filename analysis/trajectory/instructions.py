"""What a trajectory asks a driver to do: a few rows that every configuration can follow.

The rows follow the phases of the certificate: full and partial traction, a speed to hold, coasting,
braking. Which of them each cell belongs to is found at once, by dynamic programming: a change costs
as much as a change of speed that no row states. No row names traction or braking where none of the
configurations drives or brakes; a speed to hold begins and ends where the plan drives or brakes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import pairwise

import numpy as np

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.railway import Line, StepProfile, Trajectory
from trainlog.railway.line import in_km
from trainlog.spans import runs_of
from trainlog.units import KMH

LETTERS = "TPCHB"
"""The phases in a trajectory's certificate."""


class Phase(IntEnum):
    """Control phases of the robust maximum principle; Cunillera et al. (2022), section 3."""

    MAXIMUM_TRACTION = 0
    CRUISING = 1
    COASTING = 2
    PARTIAL_BRAKING = 3
    MAXIMUM_BRAKING = 4

    @property
    def label(self) -> str:
        """The phase in words."""
        return self.name.replace("_", " ").lower()


def phases_by_control(
    traction: FloatArray,
    braking: FloatArray,
    most_traction: FloatArray,
    most_braking: FloatArray,
    band: float = 1e-3,
) -> IntArray:
    """Phase of each cell from the efforts and their limits.

    Parameters
    ----------
    traction, braking, most_traction, most_braking : (n,) array [N]
    band : float
        Part of the limit that counts as nothing, or as all.

    Returns
    -------
    (n,) array of `Phase`. A configuration that brakes against the common traction is classified by
    what remains: less traction is partial traction.
    """
    net = traction - braking
    phase = np.full(traction.shape, int(Phase.COASTING))
    phase[net > band * most_traction] = Phase.CRUISING
    phase[net >= (1.0 - band) * most_traction] = Phase.MAXIMUM_TRACTION
    phase[net < -band * most_braking] = Phase.PARTIAL_BRAKING
    phase[(net < 0.0) & (braking >= (1.0 - band) * most_braking)] = Phase.MAXIMUM_BRAKING
    return phase


def agreement(
    efforts: FloatArray, most: FloatArray, worth: FloatArray, band: float = 1e-3
) -> float:
    """Share of the cells in which an effort is what the maximum principle asks for.

    Parameters
    ----------
    efforts, most : (..., n) array [N]
        The effort and its limit, in the same unit.
    worth : (..., n) array
        Switching function less the level at which the effort begins to pay, its sign such that
        the effort pays where it is positive.
    band : float
        Within this of the level the control is singular, and any effort agrees; part of the limit
        that counts as nothing, or as all.
    """
    full, none = efforts >= (1.0 - band) * most, efforts <= band * most
    return float(np.mean(np.where(worth > band, full, np.where(worth < -band, none, True))))


def phases_of(trajectory: Trajectory, row: int) -> IntArray:
    """Phase of each cell for the configuration in `row`, as the certificate lists them.

    Raises
    ------
    InputError
        If the trajectory does not come from `optimise`.

    Examples
    --------
    >>> from analysis.trajectory.instructions import Phase
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.formats.railway import read_train
    >>> from trainlog.railway import Configuration
    >>> from analysis import OptimiserOptions, TrajectoryProblem, optimise
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> problem = TrajectoryProblem(line, train, [Configuration.of(train)], end=9_613.0)
    >>> trajectory = optimise(problem, OptimiserOptions(cells=60))
    >>> Phase(phases_of(trajectory, 0)[0]).label
    'maximum traction'
    """
    try:
        letters = trajectory.certificate["phases"][row]
    except (KeyError, IndexError):
        raise InputError(
            "the trajectory has no phases", remedy="make it with `trainlog plan`"
        ) from None
    return np.array([LETTERS.index(letter) for letter in letters], dtype=np.int64)


def phase_letters(phases: IntArray) -> str:
    """The phases as letters, one a cell."""
    return "".join(map(LETTERS.__getitem__, phases.tolist()))


HELD = 2.0 / KMH
"""A speed is held where it stays within this of a whole number of km/h [m/s]."""

NOTICED = 1.0 / KMH
"""Change of speed that the advice states [m/s]."""

_CHANGE = 2.5 / KMH
"""Change of speed that is worth a row of its own, however short it is [m/s]."""

_DRIFT = 0.005
"""Cost of a speed that is held, for each second and each m/s above the planned one [m/s]; twice as
much below it, where the train comes late."""

_PARTIAL, _FULL, _GENTLE, _UNSAID, _IDLE = 0.03, 0.1, 0.02, 0.02, 0.05
"""Cost of a second [m/s]: of partial traction, of full traction where it is partial, of a brake, of
coasting where the plan drives, of a speed that is held where the plan coasts."""

_AHEAD = 8.0
"""A speed that is held is below all limits that begin within this time [s]."""

_NEAR = 8.0 / KMH
"""A limit is stated where a configuration that coasts comes so near to it [m/s]."""

_WHOLE, _EXACT = 1e-2, 1e-9
"""What a whole number of km/h may lack for rounding errors: of a plan, and of a limit."""

_TINY = 1e-3
"""Shorter pieces [m] are none."""

_PHASES = (Phase.MAXIMUM_TRACTION, Phase.CRUISING, Phase.COASTING, Phase.MAXIMUM_BRAKING)
"""What a row may ask for; speeds to hold are numbered after them."""

_HOLD = 4


def _rounded(speed: float, most: float) -> float:
    """The whole km/h nearest to a speed that are not above another one [m/s]."""
    return float(min(np.round(KMH * speed), np.floor(KMH * most + _WHOLE))) / KMH


def rounded_down(speed: float, lacking: float = _WHOLE) -> float:
    """A speed [m/s] in whole km/h: rounded down, unless it lacks no more than `lacking` [km/h].

    Examples
    --------
    >>> round(3.6 * rounded_down(25.2 + 0.25), 3)
    91.0
    """
    return float(np.floor(KMH * speed + lacking)) / KMH


@dataclass(frozen=True, slots=True)
class Cap:
    """A speed [m/s] not to exceed between two positions [m]."""

    speed: float
    start: float
    end: float


@dataclass(frozen=True, slots=True)
class Instruction:
    """What to do from one place to the next.

    Attributes
    ----------
    position, end : float [m]
    speed, until : float [m/s]
        Planned at both ends.
    phase : Phase
    hold : bool
        Whether a speed is to be held.
    target : float [m/s]
        Speed to hold, to reach or to brake to; in whole km/h, rounded down.
    lowest, highest : float [m/s]
        Planned between the ends.
    by : float [m]
        Where the target is to be reached.
    course : tuple of float [m/s]
        Speeds between which it rises and falls, from the first to that at the end.
    caps : tuple of Cap
        Speeds not to exceed on the way.
    turns : tuple of float [m]
        Where it has the speeds of its course.
    """

    position: float
    end: float
    speed: float
    until: float
    phase: Phase
    hold: bool
    target: float
    lowest: float
    highest: float
    by: float
    course: tuple[float, ...] = ()
    caps: tuple[Cap, ...] = ()
    turns: tuple[float, ...] = ()

    def words(self, line: Line | None = None) -> str:
        """The instruction as a driver reads it, in the operator's kilometres with the line."""
        to, by = f"{KMH * self.target:.0f} km/h", f"by km {_km(line, self.by)}"
        if self.hold:
            return f"hold {to}"
        if self.phase is Phase.COASTING:
            return f"coast to km {_km(line, self.end)}{self._course()}{self._caps(line)}"
        if self.phase is Phase.MAXIMUM_TRACTION:
            if self.highest - self.until > NOTICED:
                return f"full traction, at most {to}{self._course()}{self._caps(line)}"
            return f"full traction to {to}{self._caps(line)}"
        if self.phase is Phase.CRUISING:
            return f"partial traction to {to} {by}{self._caps(line)}"
        if 0.0 < self.target >= min(self.speed - NOTICED, self.until + NOTICED):
            return f"brake, if faster, to {to} {by}{self._caps(line)}"
        verb = "brake gently" if self.phase is Phase.PARTIAL_BRAKING else "brake"
        words = f"{verb} to {to} {by}" if self.target > 0.0 else f"{verb} to a stand"
        return f"{words}{self._caps(line)}"

    @property
    def stated_until(self) -> float:
        """Speed where it ends, as the words state it [m/s]."""
        slows = self.phase is Phase.MAXIMUM_TRACTION and self.highest - self.until > NOTICED
        free = self.phase is Phase.COASTING or slows or self.words().startswith("brake, if")
        return self._capped(KMH * self.until) / KMH if free and not self.hold else self.target

    @property
    def stated_target(self) -> float:
        """Speed that the words name: the target or, coasting, the speed where it ends [m/s]."""
        return self.stated_until if self.phase is Phase.COASTING else self.target

    def _course(self) -> str:
        """How the speed falls and rises: ``": speed falls to 8 km/h"``."""
        turns = [
            ("falls" if after < before else "rises", self._capped(KMH * after))
            for before, after in pairwise(self.course)
            if abs(after - before) > NOTICED
        ]
        words = [f"{verb} to {speed:.0f}" for verb, speed in turns]
        if words and self._ends_at_cap:
            words[-1] = f"{turns[-1][0]} to at most {turns[-1][1]:.0f}"
        return f": speed {', '.join(words)} km/h" if words else ""

    @property
    def _ends_at_cap(self) -> bool:
        """Whether the speed where it ends is one not to exceed there alone, said by its course."""
        if self.phase is not Phase.COASTING or len(self.course) < 2 or not self.caps:
            return False
        if abs(self.course[-1] - self.course[-2]) <= NOTICED:
            return False
        last = self.caps[-1]
        ends = round(self._capped(KMH * self.until)) == round(KMH * last.speed)
        return ends and last.start == last.end == self.end

    def _capped(self, speed: float) -> float:
        """A speed [km/h] as the caps state it, which are rounded down."""
        caps = (round(KMH * cap.speed) for cap in self.caps)
        return min((cap for cap in caps if 0.0 <= speed - cap < 1.0), default=speed)

    def _caps(self, line: Line | None) -> str:
        """Speeds not to exceed: ``"; at most 90 km/h to km 0.504"``."""
        words = []
        caps = self.caps[:-1] if self._ends_at_cap else self.caps
        for number, cap in enumerate(caps):
            goes_on = any(each.start == cap.end for each in self.caps[number + 1 :])
            place = f" from km {_km(line, cap.start)}" if cap.start > self.position else ""
            if cap.start == cap.end:
                place = f" at km {_km(line, cap.end)}"
            elif cap.end < self.end and not goes_on:
                place += f" to km {_km(line, cap.end)}"
            words.append(f"{KMH * cap.speed:.0f} km/h{place}")
        return f"; at most {', '.join(words)}" if words else ""


def _with_cap(caps: list[Cap], cap: Cap, planned: float, slack: float = 0.0) -> list[Cap]:
    """Speeds not to exceed with one more, unless the one before, no higher, holds for it, too.

    It does not where a configuration is `planned` to be faster [m/s].
    """
    lower = caps and caps[-1].speed <= cap.speed + slack and caps[-1].end >= cap.start
    if lower and planned <= caps[-1].speed + NOTICED:
        return [*caps[:-1], replace(caps[-1], end=cap.end)]
    return [*caps, cap]


def limits_between(limits: StepProfile, first: float, last: float) -> list[Cap]:
    """The limits from one place [m] to another, piece by piece in whole km/h."""
    edges = limits.positions
    inside = edges[(edges > first + _TINY) & (edges < last - _TINY)].tolist()
    return [
        Cap(rounded_down(float(limits(begin + _TINY)), _EXACT), begin, end)
        for begin, end in pairwise([first, *inside, last])
    ]


def _course(speeds: list[float]) -> list[int]:
    """The speeds between which it rises and falls by more than what is held, by their numbers."""
    found, last, way = [0], 0, 0.0
    for number, speed in enumerate(speeds[1:], 1):
        if way * (speed - speeds[last]) > 0.0:
            last = number
        elif abs(speed - speeds[last]) > HELD:
            found += [last] if way else []
            last, way = number, speed - speeds[last]
    found += [last] if way else []
    end = len(speeds) - 1
    return found if speeds[found[-1]] == speeds[end] else [*found, end]


def _km(line: Line | None, position: float) -> str:
    return f"{float(in_km(line, position)):.3f}"


def instructions(trajectory: Trajectory, limits: StepProfile) -> tuple[Instruction, ...]:
    """What a driver is to do from place to place, as a trajectory's certificate has it.

    Speeds are whole km/h, rounded down; they and times are those of the configuration that arrives
    last.

    Parameters
    ----------
    trajectory : Trajectory
    limits : StepProfile [m/s]
        Of the line, in the direction of travel.

    Raises
    ------
    InputError
        If the trajectory does not come from `optimise`.
    """
    plan = _Plan(trajectory, limits)
    chosen = plan.chosen()
    starts = np.flatnonzero(np.diff(chosen, prepend=-1)).tolist()
    ends = [*starts[1:], chosen.size]
    found = list[Instruction]()
    # From the last to the first: each leads to the speed that the next one holds.
    for start, end in zip(reversed(starts), reversed(ends), strict=True):
        after = found[-1] if found else None
        found.append(plan.instruction(start, end, int(chosen[start]), after))
    return tuple(reversed(found))


class _Plan:
    """The phases and speeds of one configuration, and where any of them brakes."""

    def __init__(self, trajectory: Trajectory, limits: StepProfile) -> None:
        self.trajectory, self.limits, row = trajectory, limits, trajectory.latest
        self.places, self.times = trajectory.positions, trajectory.times[row]
        self.speeds, self.highest = trajectory.speeds[row], trajectory.speeds.max(axis=0)
        every = np.array([phases_of(trajectory, each) for each in range(len(trajectory.speeds))])
        self.phases = every[row]
        self.brakes = np.any(every >= Phase.PARTIAL_BRAKING, axis=0)
        top = float(trajectory.speeds.max())
        fast = np.minimum(trajectory.speeds[:, 1:], trajectory.speeds[:, :-1]) > top - NOTICED
        held = (every == Phase.CRUISING) | (every == Phase.PARTIAL_BRAKING)
        if np.any(fast & held):
            # A speed that is held below the limits is the train's own top speed.
            self.limits = StepProfile(
                limits.positions, np.minimum(limits.values, max(top, rounded_down(top)))
            )
        inertia = np.array([each.inertia for each in trajectory.configurations])[:, None]
        braking = trajectory.braking_effort / inertia
        self.net = np.abs(trajectory.tractive_effort / inertia[row] - braking[row])
        self.braking = braking.max(axis=0)
        self.applied = self._applied(every, braking * np.diff(trajectory.times, axis=1))
        faster = KMH * np.array([self.speeds.min(), self.speeds.max()])
        self.whole = np.arange(max(np.floor(faster[0]) - 1.0, 1.0), faster[1] + 2.0) / KMH

    def _applied(self, phases: IntArray, lost: FloatArray) -> BoolArray:
        """Cells of brake applications that take more off a speed than is noticed, (q, n) each."""
        found = np.zeros(lost.shape[1], dtype=np.bool_)
        for each, slowed in zip(phases >= Phase.PARTIAL_BRAKING, lost, strict=True):
            for start, past in runs_of(each):
                found[start:past] |= slowed[start:past].sum() > NOTICED
        return np.asarray(found & (self.phases > Phase.CRUISING))

    def chosen(self) -> IntArray:
        """Label of each cell: a place in `_PHASES`, then one for each speed to hold."""
        costs = self._costs()
        count = costs.shape[1]
        total, before = costs[:, 0].copy(), np.zeros(costs.shape, dtype=np.int64)
        stay = np.arange(costs.shape[0])
        for cell in range(1, count):
            best = int(np.argmin(total))
            least = total[best] + _CHANGE
            change = total > least
            before[:, cell] = np.where(change, best, stay)
            total = np.where(change, least, total) + costs[:, cell]
        found = np.empty(count, dtype=np.int64)
        found[-1] = int(np.argmin(total))
        for cell in range(count - 1, 0, -1):
            found[cell - 1] = before[found[cell], cell]
        return found

    def _costs(self) -> FloatArray:
        """What each label, (s, n), leaves unsaid of the speed in each cell [m/s]."""
        seconds, phases = np.diff(self.times), self.phases
        change, rise = self.net * seconds, np.maximum(np.diff(self.speeds), 0.0)
        drives, full = phases <= Phase.CRUISING, phases == Phase.MAXIMUM_TRACTION
        own, hard = phases >= Phase.PARTIAL_BRAKING, phases == Phase.MAXIMUM_BRAKING
        others = np.where(self.brakes, self.braking, 0.0) * seconds
        rows = [
            np.where(full, 0.0, np.where(drives, _FULL * seconds, np.inf)),
            np.where(full, 10.0 * _PARTIAL, np.where(drives, _PARTIAL, np.inf)) * seconds,
            np.where(
                self.applied,
                np.inf,
                np.where(drives, change + _UNSAID * seconds, np.where(own, change, others)),
            ),
            np.where(self.brakes, np.where(hard, 0.0, _GENTLE * seconds) + rise, np.inf),
        ]
        faster = self.speeds - self.whole[:, None]
        worst = np.maximum(np.abs(faster[:, 1:]), np.abs(faster[:, :-1]))
        beside = np.maximum(-faster, 2.0 * faster)
        mean = 0.5 * (beside[:, 1:] + beside[:, :-1])
        most = self._limit(self.places[:-1], self.places[1:] + 1e-3)
        possible = (worst <= HELD) & (self.whole[:, None] <= most + _WHOLE / KMH)
        # Where the plan coasts, a driver who holds a speed would drive.
        idle = np.where(phases == Phase.COASTING, others + _IDLE * seconds, 0.0)
        # What a brake takes off a speed that is held is worth a row from what is noticed on.
        fall = np.maximum(self.speeds[:-1] - self.speeds[1:], 0.0)
        idle += np.where(self.applied, _CHANGE / NOTICED * fall, 0.0)
        return np.vstack([*rows, np.where(possible, _DRIFT * mean * seconds + idle, np.inf)])

    def _limit(self, start: FloatArray, end: FloatArray) -> FloatArray:
        """Lowest limit between places [m/s]."""
        first = self.limits.element_at(start + 1e-6).tolist()
        last = self.limits.element_at(end - 1e-6).tolist()
        spans = zip(first, last, strict=True)
        return np.array([self.limits.values[a : b + 1].min() for a, b in spans], np.float64)

    def instruction(
        self, start: int, end: int, label: int, after: Instruction | None
    ) -> Instruction:
        """The row of one label from the node `start` to the node `end`."""
        speed, until = float(self.speeds[start]), float(self.speeds[end])
        inside, fastest = self.speeds[start : end + 1], float(self.highest[end])
        hold = label >= _HOLD
        phase = Phase.CRUISING if hold else _PHASES[label]
        follows = after.target if after is not None and after.hold else None
        target = until
        if hold:
            target = float(self.whole[label - _HOLD])
        elif phase is Phase.MAXIMUM_BRAKING:
            own = self.phases[start:end]
            if not np.any(own >= Phase.PARTIAL_BRAKING):
                target = fastest
            elif not np.any(own == Phase.MAXIMUM_BRAKING):
                phase = Phase.PARTIAL_BRAKING
        elif phase is Phase.MAXIMUM_TRACTION and inside.max() - until > NOTICED:
            target, follows = float(inside.max()), None
        drives = phase <= Phase.CRUISING and not hold
        most = target
        if follows is not None and not hold and phase is not Phase.COASTING:
            target = most = follows
        elif drives:
            most = float(self._limit(self.places[[end - 1]], self.places[[end]])[0])
        course = _course(inside.tolist())
        found = Instruction(
            float(self.places[start]),
            float(self.places[end]),
            speed,
            until,
            phase,
            hold,
            _rounded(target, most),
            float(inside.min()),
            float(inside.max()),
            self._by(start, end, target) if phase > Phase.COASTING else float(self.places[end]),
            tuple(inside[course].tolist()),
            turns=tuple(self.places[start : end + 1][course].tolist()),
        )
        return replace(found, caps=tuple(self._caps(found, after, fastest)))

    def _by(self, start: int, end: int, target: float) -> float:
        """Where a limit asks first for the speed that a brake leads to; else where it ends [m]."""
        first, last = self.places[[start, end]].tolist()
        pieces = limits_between(self.limits, first, last)[1:]
        return min((p.start for p in pieces if p.speed < target + NOTICED), default=last)

    def _caps(self, row: Instruction, after: Instruction | None, fastest: float) -> list[Cap]:
        """Speeds that a configuration may come near on the way, other than the target.

        At its end the fastest of them has the speed `fastest` [m/s].
        """
        if row.hold:
            return []
        drives, coasts = row.phase <= Phase.CRUISING, row.phase is Phase.COASTING
        found, before = list[Cap](), 0.0 if coasts else np.inf
        for piece in limits_between(self.limits, row.position, row.end):
            first, last = np.searchsorted(self.places, [piece.start, piece.end])
            speeds = self.trajectory.speeds[:, first : last + 1]
            near = speeds.max() > piece.speed - _NEAR
            risen = speeds[:, :-1] - np.minimum.accumulate(speeds[:, :-1], axis=1)
            rises = np.any(risen > 0.1 * NOTICED)
            begins = piece.start == row.position and not coasts
            if drives and near and piece.speed < row.target - _WHOLE:
                # From where none is planned to be faster up to there.
                here = slice(int(np.searchsorted(self.places, row.position)), int(first))
                slow = self.highest[here] <= piece.speed + NOTICED
                free = here.stop - int(np.argmin(slow[::-1])) if not slow.all() else here.start
                found.append(replace(piece, start=float(self.places[free])))
            elif (
                near
                and not (drives or begins)
                and piece.start < row.by
                and (rises or before > piece.speed)
            ):
                found = _with_cap(found, piece, float(speeds.max()))
            before = piece.speed
        if coasts:
            past = np.array([row.end + _AHEAD * row.until])
            soon = float(self._limit(np.array([row.end]), past)[0])
            brakes = after is not None and after.phase > Phase.COASTING
            least = row.until if brakes else min(row.until, soon - 2.0 * NOTICED)
            if fastest > least + NOTICED:
                most, ahead = rounded_down(fastest), rounded_down(soon)
                if not brakes and fastest <= ahead + NOTICED:
                    most = min(most, ahead)
                end = Cap(most, row.end, row.end)
                # Within what is noticed of the speed up to there, it is said by that.
                slack = 0.0 if brakes else NOTICED + _WHOLE / KMH
                found = _with_cap(found, end, fastest, slack)
        return found
