"""Driver advice: a trajectory as few points at which to do something else.

Beside a log the advice is its ``/reference`` topic: what the trajectory asks for where the train
is, and how late it is.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.phases import Phase, phases_of
from trainlog import __version__
from trainlog.errors import InputError
from trainlog.formats.files import atomic_write, sha256
from trainlog.formats.trajectory import trajectory_to_bytes
from trainlog.railway import Trajectory
from trainlog.topics import REFERENCE, TRAIN_STATE
from trainlog.trip import Trip, frame_of
from trainlog.units import KMH

FloatArray = NDArray[np.float64]

SHORTEST = 3.0
"""Phases shorter than this are no advice to a driver [s]."""

_BRIEF = 5.0
"""Times the shortest phase, below which one is no advice if it neither brakes nor changes the
speed."""

_SAME = 1.0 / KMH
"""Change of speed that a driver would not notice [m/s]."""

_EVEN = (Phase.CRUISING, Phase.COASTING, Phase.PARTIAL_BRAKING)
"""Phases that a driver does not tell apart while the speed stays: a little effort up or down."""

HELD = 2.0 / KMH
"""Speeds within this of each other are one speed to hold [m/s]."""

HEADER = ("position_m", "time_s", "speed_kmh", "phase", "until_kmh")


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
    """

    position: float
    time: float
    speed: float
    phase: Phase
    until: float

    @property
    def words(self) -> str:
        """The advice as a driver reads it: the phase, or the speed to hold."""
        if self.phase is Phase.CRUISING and abs(self.until - self.speed) <= HELD:
            return f"hold {KMH * self.speed:.0f} km/h"
        return self.phase.label


def slowest_row(trajectory: Trajectory) -> int:
    """The configuration that arrives last; who drives as it does is not late in any other."""
    return int(np.argmax(trajectory.times[:, -1]))


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
        A shorter phase counts as part of the one before it, and so does one that lasts little
        longer and changes nothing: coasting for 5 s while cruising.
    held : float [m/s]
        Neighbouring phases over which the speed stays within this, and none of which is full
        traction or full braking, are one: cruising, to hold that speed.

    Raises
    ------
    InputError
        If the trajectory does not come from `optimise`.
    """
    chosen = slowest_row(trajectory) if row is None else row
    phases, times = phases_of(trajectory, chosen), trajectory.times[chosen]
    starts = np.flatnonzero(np.diff(phases, prepend=-1)).tolist()
    speeds, kept = trajectory.speeds[chosen], list[int]()
    for start, end in zip(starts, [*starts[1:], phases.size], strict=True):
        same = kept and phases[kept[-1]] == phases[start]
        lasts = times[end] - times[start]
        even = phases[start] < Phase.PARTIAL_BRAKING and abs(speeds[end] - speeds[start]) < _SAME
        if not kept or (lasts >= (_BRIEF * shortest if even else shortest) and not same):
            kept.append(start)
    told = _held(speeds, [(start, Phase(phases[start])) for start in kept], held)
    ends = [*(start for start, _ in told[1:]), phases.size]
    return tuple(
        AdvicePoint(
            float(trajectory.positions[start]),
            float(times[start]),
            float(speeds[start]),
            phase,
            float(speeds[end]),
        )
        for (start, phase), end in zip(told, ends, strict=True)
    )


def _held(
    speeds: FloatArray, begun: list[tuple[int, Phase]], held: float
) -> list[tuple[int, Phase]]:
    """Phases, by the node where each begins, with those at one speed made one."""
    told = list[tuple[int, Phase]]()
    ends = [*(start for start, _ in begun[1:]), speeds.size - 1]
    for (start, phase), end in zip(begun, ends, strict=True):
        if told and phase in _EVEN and told[-1][1] in _EVEN:
            first = told[-1][0]
            if np.ptp(speeds[first : end + 1]) <= held:
                told[-1] = first, Phase.CRUISING
                continue
        told.append((start, phase))
    return [each for row, each in enumerate(told) if row == 0 or told[row - 1][1] is not each[1]]


def write_advice(points: tuple[AdvicePoint, ...], path: str | Path) -> None:
    """Write advice points as CSV, whole or not at all."""
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as file,
    ):
        table = csv.writer(file, lineterminator="\n")
        table.writerow(HEADER)
        for point in points:
            speeds = (f"{KMH * speed:.1f}" for speed in (point.speed, point.until))
            speed, until = speeds
            place = (f"{point.position:.1f}", f"{point.time:.1f}")
            table.writerow((*place, speed, point.phase.label, until))


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
    chosen = slowest_row(trajectory) if row is None else row
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
            "tractive_effort": trajectory.tractive_effort[cell],
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
