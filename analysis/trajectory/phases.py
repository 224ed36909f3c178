"""Driving phases of a trajectory, and the advice to a driver that they amount to.

Phases are those of optimal train control, one for each cell. Advice is a trajectory as few points
at which to do something else; beside a log it is the ``/reference`` topic: what the trajectory asks
for where the train is, and how late it is.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import groupby
from pathlib import Path

import numpy as np

from trainlog import __version__
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.formats.files import atomic_write, sha256
from trainlog.formats.trajectory import trajectory_to_bytes
from trainlog.railway import Trajectory
from trainlog.topics import REFERENCE, TRAIN_STATE
from trainlog.trip import Trip, frame_of
from trainlog.units import KMH


class Phase(IntEnum):
    """Control phases of the robust maximum principle; Cunillera et al. (2022), section 3."""

    MAXIMUM_TRACTION = 0
    CRUISING = 1
    COASTING = 2
    PARTIAL_BRAKING = 3
    MAXIMUM_BRAKING = 4

    @property
    def letter(self) -> str:
        """The phase as one letter, as a trajectory's certificate lists it."""
        return "TPCHB"[self]

    @property
    def label(self) -> str:
        """The phase in words."""
        return self.name.replace("_", " ").lower()


_LETTERS = np.array([phase.letter for phase in Phase], dtype="S1")


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


def phases_by_switching(switching: FloatArray, band: float = 1e-3) -> IntArray:
    """Phase of each cell from the switching function ``sum of lambda_v / v``.

    Within `band` of 1 or of 0 the control is singular: cruising by partial traction or braking.
    """
    phase = np.full(switching.shape, int(Phase.COASTING))
    phase[switching > 1.0 - band] = Phase.CRUISING
    phase[switching > 1.0 + band] = Phase.MAXIMUM_TRACTION
    phase[switching < band] = Phase.PARTIAL_BRAKING
    phase[switching < -band] = Phase.MAXIMUM_BRAKING
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
    >>> from analysis.trajectory.phases import Phase
    >>> from trainlog.formats.line import read_line
    >>> from trainlog.formats.train import read_train
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
            "the trajectory carries no phases", remedy="make it with `trainlog plan`"
        ) from None
    codes = {phase.letter: int(phase) for phase in Phase}
    return np.array([codes[letter] for letter in letters], dtype=np.int64)


def phase_letters(phases: IntArray) -> str:
    """The phases as letters, one a cell."""
    return _LETTERS[phases].tobytes().decode("ascii")


SHORTEST = 3.0
"""Phases shorter than this are no advice to a driver [s]."""

_BRIEF = 5.0
"""Times the shortest phase, below which one is no advice if it neither brakes nor changes the
speed."""

_SAME = 1.0 / KMH
"""Change of speed that a driver would not notice [m/s]."""

_OTHER = 4.0 / KMH
"""Change of speed that is advice to a driver, however short it is [m/s]."""

_EVEN = (Phase.CRUISING, Phase.COASTING, Phase.PARTIAL_BRAKING)
"""Phases that are one to a driver while the speed stays: a little effort up or down."""

HELD = 2.0 / KMH
"""Speeds within this of each other are one speed to hold [m/s]."""

_STEADY = 20.0
"""Time from which a speed that stays within a longer phase is one to hold [s]."""

HEADER = (
    "position_m",
    "time_s",
    "speed_kmh",
    "phase",
    "until_kmh",
    "to_m",
    "target_kmh",
    "lowest_kmh",
    "highest_kmh",
    "permitted_kmh",
)


_WHOLE = 1e-2
"""What a whole number of km/h may lack for rounding errors."""


def rounded_down(speed: float) -> float:
    """A speed [m/s] in whole km/h, never more than it is.

    Examples
    --------
    >>> round(3.6 * rounded_down(25.2 + 0.25), 3)
    91.0
    """
    return float(np.floor(KMH * speed + _WHOLE)) / KMH


@dataclass(frozen=True, slots=True)
class AdvicePoint:
    """Where a phase begins.

    Attributes
    ----------
    position : float [m]
    time : float [s]
        Since departure.
    speed : float [m/s]
        Where the phase begins.
    phase : Phase
    until : float [m/s]
        Speed at which it ends.
    hold : bool
        Whether the speed stays.
    end : float [m]
        Where the next one begins.
    target : float [m/s]
        Speed to hold, to reach or to brake to, and not to exceed; in whole km/h, rounded down.
    lowest, highest : float [m/s]
        Speeds of the configuration until then.
    permitted : float or None [m/s]
        Lowest permitted speed until then; None without the line.
    capped : bool
        Whether coasting alone might exceed the target.
    course : tuple of float [m/s]
        Speeds between which it rises and falls, from the first to that at the end.
    """

    position: float
    time: float
    speed: float
    phase: Phase
    until: float
    hold: bool = False
    end: float = np.nan
    target: float = np.nan
    lowest: float = np.nan
    highest: float = np.nan
    permitted: float | None = None
    capped: bool = False
    course: tuple[float, ...] = ()

    @property
    def words(self) -> str:
        """The advice as a driver reads it: the phase, or the speed to hold."""
        if self.hold:
            return f"hold {KMH * self.target:.0f} km/h"
        return "partial traction" if self.phase is Phase.CRUISING else self.phase.label


@dataclass(frozen=True, slots=True)
class _Piece:
    """A phase between two nodes, or a speed that is held there."""

    start: int
    phase: Phase
    end: int
    hold: bool = False


def advice(
    trajectory: Trajectory,
    row: int | None = None,
    *,
    shortest: float = SHORTEST,
    held: float = HELD,
) -> tuple[AdvicePoint, ...]:
    """The phases of a trajectory, as points at which they begin.

    Parameters
    ----------
    trajectory : Trajectory
    row : int, optional
        Configuration; the one that arrives last without it.
    shortest : float [s]
        A shorter phase counts as part of the one before it, unless the speed changes by 4 km/h in
        it; and so does one that lasts little longer and changes nothing: coasting for 5 s while
        cruising.
    held : float [m/s]
        Where the speed stays within this, and there is neither full traction nor full braking,
        all is one: cruising, to hold that speed. With 0 every phase is listed as it is.

    Raises
    ------
    InputError
        If the trajectory does not come from `optimise`.

    Examples
    --------
    >>> from trainlog.formats.line import read_line
    >>> from trainlog.formats.train import read_train
    >>> from trainlog.railway import Configuration
    >>> from analysis import OptimiserOptions, TrajectoryProblem, optimise
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> problem = TrajectoryProblem(line, train, [Configuration.of(train)], end=9_613.0)
    >>> trajectory = optimise(problem, OptimiserOptions(cells=60))
    >>> first, *_, last = advice(trajectory)
    >>> first.words, last.words
    ('maximum traction', 'maximum braking')
    """
    chosen = trajectory.latest if row is None else row
    phases, times = phases_of(trajectory, chosen), trajectory.times[chosen]
    starts = np.flatnonzero(np.diff(phases, prepend=-1)).tolist()
    speeds, kept = trajectory.speeds[chosen], list[int]()
    for start, end in zip(starts, [*starts[1:], phases.size], strict=True):
        same = kept and phases[kept[-1]] == phases[start]
        lasts, change = times[end] - times[start], abs(speeds[end] - speeds[start])
        even = phases[start] < Phase.PARTIAL_BRAKING and change < _SAME
        long = lasts >= (_BRIEF * shortest if even else shortest) or change >= _OTHER
        if not kept or (long and not same):
            kept.append(start)
    pieces = _held(speeds, times, [(start, Phase(phases[start])) for start in kept], held)
    ends = [*(piece.start for piece in pieces[1:]), phases.size]
    return tuple(
        _point(trajectory, chosen, piece, end) for piece, end in zip(pieces, ends, strict=True)
    )


def _point(trajectory: Trajectory, row: int, piece: _Piece, end: int) -> AdvicePoint:
    """Where a piece begins, and what happens up to the node `end`."""
    places, times, speeds = trajectory.positions, trajectory.times[row], trajectory.speeds[row]
    start, inside = piece.start, speeds[piece.start : end + 1]
    until = float(speeds[end])
    steady = float(min(inside[0], np.median(inside)))
    highest = float(inside.max())
    target = steady if piece.hold else until if piece.phase > Phase.MAXIMUM_TRACTION else highest
    return AdvicePoint(
        float(places[start]),
        float(times[start]),
        float(speeds[start]),
        piece.phase,
        until,
        piece.hold,
        float(places[end]),
        rounded_down(target) if target > 0.0 else 0.0,
        float(inside.min()),
        highest,
    )


def _held(
    speeds: FloatArray, times: FloatArray, begun: list[tuple[int, Phase]], held: float
) -> list[_Piece]:
    """Phases, by the node where each begins; where the speed stays they are one: cruising."""
    pieces = list[_Piece]()
    ends = [*(start for start, _ in begun[1:]), speeds.size - 1]
    spans = [_Piece(*each, end) for each, end in zip(begun, ends, strict=True)]
    for even, group in groupby(spans, key=lambda piece: piece.phase in _EVEN):
        run = list(group)
        first, last = run[0].start, run[-1].end
        if even and held > 0.0:
            working = np.zeros(speeds.size - 1, dtype=bool)
            for piece in run:
                working[piece.start : piece.end] = piece.phase is not Phase.COASTING
            whole = [_Piece(first, Phase.CRUISING, last, hold=True)]
            same = working.any() and np.ptp(speeds[first : last + 1]) <= held
            holds = whole if same else _holds(speeds, times, working, held, first, last)
            run = _beside(run, holds)
        pieces += run
    kept = pieces[:1]
    for piece in pieces[1:]:
        before, brief = kept[-1], held > 0.0 and not piece.hold
        brief = brief and times[piece.end] - times[piece.start] < SHORTEST
        alike = piece.phase is before.phase and not (piece.hold or before.hold)
        if alike or (brief and abs(speeds[piece.end] - speeds[piece.start]) < _OTHER):
            continue
        if brief and before.phase is Phase.PARTIAL_BRAKING < piece.phase:
            piece = replace(piece, start=kept.pop().start)
            if kept and kept[-1].phase is piece.phase:
                continue
        kept.append(piece)
    return kept


def _holds(
    speeds: FloatArray,
    times: FloatArray,
    working: BoolArray,
    held: float,
    first: int,
    last: int,
) -> list[_Piece]:
    """Where one speed is held between two nodes: the longest such stretch, and so on beside it.

    None begins or ends in coasting.
    """
    longest, begin, end = _STEADY, first, first
    for start in (first + np.flatnonzero(working[first:last])).tolist():
        ahead = speeds[start : last + 1]
        beyond = np.maximum.accumulate(ahead) - np.minimum.accumulate(ahead) > held
        reach = start + (int(np.argmax(beyond)) - 1 if beyond.any() else ahead.size - 1)
        reach = start + int(np.flatnonzero(working[start:reach]).max(initial=-1)) + 1
        if times[reach] - times[start] >= longest:
            longest, begin, end = float(times[reach] - times[start]), start, reach
    if end == begin:
        return []
    return [
        *_holds(speeds, times, working, held, first, begin),
        _Piece(begin, Phase.CRUISING, end, hold=True),
        *_holds(speeds, times, working, held, end, last),
    ]


def _beside(run: list[_Piece], holds: list[_Piece]) -> list[_Piece]:
    """Speeds held, and what is left of a run's phases before, between and after them."""
    found, left = list(holds), run[0].start
    for stop, resume in [*((hold.start, hold.end) for hold in holds), (run[-1].end, run[-1].end)]:
        for piece in run:
            start, end = max(piece.start, left), min(piece.end, stop)
            if start < end:
                found.append(_Piece(start, piece.phase, end))
        left = resume
    return sorted(found, key=lambda piece: piece.start)


def write_advice(points: tuple[AdvicePoint, ...], path: str | Path) -> None:
    """Write advice points as CSV, whole or not at all."""
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as file,
    ):
        table = csv.writer(file, lineterminator="\n")
        table.writerow(HEADER)
        for point in points:
            place = (f"{point.position:.1f}", f"{point.time:.1f}")
            speeds = (point.until, point.target, point.lowest, point.highest, point.permitted)
            until, *others = ("" if each is None else f"{KMH * each:.1f}" for each in speeds)
            speed, phase = f"{KMH * point.speed:.1f}", point.phase.label
            table.writerow((*place, speed, phase, until, f"{point.end:.1f}", *others))


def with_advice(trip: Trip, trajectory: Trajectory, row: int | None = None) -> Trip:
    """A trip with what the trajectory advises beside it, as its ``/reference`` topic.

    Parameters
    ----------
    trip : Trip
        With the train's position; its clock starts with the first movement inside the trajectory.
    trajectory : Trajectory
    row : int, optional
        Configuration; the one that arrives last without it.

    Raises
    ------
    InputError
        If trip and trajectory are of different lines or directions, the trip is never where the
        trajectory is, or it followed a trajectory already.
    """
    name, line = trip.name, trip.metadata.get("line", trajectory.line)
    way = trip.metadata.get("direction", "forward")
    if line != trajectory.line or way != trajectory.direction:
        raise InputError(
            f"the trajectory is for line '{trajectory.line}' {trajectory.direction},"
            f" trip '{name}' ran on '{line}' {way}",
            remedy="give the trajectory of that line and direction",
        )
    if REFERENCE.name in trip:
        raise InputError(f"trip '{name}' carries a reference already: it followed a trajectory")
    chosen = trajectory.latest if row is None else row
    state = trip[TRAIN_STATE.name]
    position = state["position"].to_numpy(dtype=np.float64)
    first, last = trajectory.positions[[0, -1]]
    inside = np.isfinite(position) & (position >= first) & (position <= last)
    if not inside.any():
        raise InputError(
            f"trip '{name}' is never between km {first / 1e3:.3f} and km {last / 1e3:.3f}",
            remedy="give a trip over the trajectory's section",
        )
    index, position = state.index[inside], position[inside]
    seconds = (index - index[0]).total_seconds().to_numpy()
    moved = np.flatnonzero(position > position[0] + 1.0)
    departed = float(seconds[max(int(moved[0]) - 1, 0)]) if moved.size else 0.0
    planned = np.interp(position, trajectory.positions, trajectory.times[chosen])
    cell = trajectory.cell_of(position)
    frame = frame_of(
        REFERENCE,
        index,
        {
            "speed": trajectory.speed_at(chosen, position),
            "tractive_effort": trajectory.tractive_effort_at(position),
            "braking_effort": trajectory.braking_effort[chosen, cell],
            "lateness": seconds - departed + float(planned[0]) - planned,
        },
    )
    return trip.with_topic(frame).with_step(
        "advise",
        software=f"trainlog {__version__}",
        configuration=trajectory.configurations[chosen].name,
        inputs={"trajectory": sha256(trajectory_to_bytes(trajectory))},
    )
