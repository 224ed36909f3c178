"""What a fit needs of a trip: windows, and what was masked.

A log too long for the memory is read in parts; the windows of all of them make one fit. A run of
usable samples that is not at its end where a part ends is carried on to the next one, so that the
windows are those of the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.resistance.power import LimitedSamples, limited_samples
from analysis.resistance.recording import Prepared, SpeedScale, prepare
from analysis.resistance.refusal import Timeline
from analysis.resistance.windows import Recording, Windows, build_windows
from trainlog.railway.line import Line
from trainlog.railway.train import Train
from trainlog.spans import ALWAYS
from trainlog.trip import Trip

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a trip, made ready.

    Attributes
    ----------
    recording : Recording
    limited : LimitedSamples
    masked : dict of str to float [s]
    duration : float [s]
    timeline : Timeline
    """

    recording: Recording
    limited: LimitedSamples
    masked: dict[str, float]
    duration: float
    timeline: Timeline


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a fit needs of a trip.

    Attributes
    ----------
    windows : Windows
    limited : LimitedSamples
    masked : dict of str to float [s]
        Time masked, by reason; reasons may overlap.
    duration : float [s]
    timeline : Timeline
    """

    windows: Windows
    limited: LimitedSamples
    masked: dict[str, float]
    duration: float
    timeline: Timeline

    @staticmethod
    def of(parts: Iterable[Part]) -> Evidence:
        """The evidence of a trip; its parts, one at least, in the order of time."""
        windows: list[Windows] = []
        limited: list[LimitedSamples] = []
        lines: list[Timeline] = []
        masked: dict[str, float] = {}
        duration = 0.0
        open_run: Recording | None = None
        for part in parts:
            closed, open_run = _parted(part.recording, open_run)
            windows.append(build_windows(closed))
            limited.append(part.limited)
            lines.append(part.timeline)
            masked = {reason: masked.get(reason, 0.0) + t for reason, t in part.masked.items()}
            duration += part.duration
        if open_run is not None:
            windows.append(build_windows(open_run))
        return Evidence(
            Windows.joined(windows),
            LimitedSamples.joined(limited),
            masked,
            duration,
            _at_a_glance(lines),
        )


def part_of(
    trip: Trip,
    line: Line,
    train: Train,
    scale: SpeedScale,
    origin: pd.Timestamp,
    span: tuple[int, int] = ALWAYS,
) -> Part:
    """The part of a trip in `span` [ns]; samples around it are given too if there are any.

    Parameters
    ----------
    trip : Trip
        See `prepare`.
    line, train
    scale : SpeedScale
        Of the whole trip.
    origin : Timestamp
        From which times count.
    span : (int, int) [ns since 1970 UTC]
        First and last instant of the part.
    """
    prepared = prepare(trip, line, train, scale, origin)
    inside = within(prepared.index, span)
    step = np.gradient(prepared.recording.time)
    return Part(
        recording=_mapped(lambda values: values[inside], prepared.recording),
        limited=limited_samples(trip, prepared, inside),
        masked={
            reason: float(np.sum(step[mask & inside])) for reason, mask in prepared.masks.items()
        },
        duration=float(np.sum(step[inside])),
        timeline=_timeline(prepared, inside),
    )


def within(index: pd.DatetimeIndex, span: tuple[int, int]) -> BoolArray:
    """Which instants lie in a span [ns]."""
    stamps = index.as_unit("ns").asi8
    return np.asarray((stamps >= span[0]) & (stamps <= span[1]))


def _mapped(change: Callable[..., Any], *recordings: Recording) -> Recording:
    """A recording whose arrays are made of those of others."""
    names = [item.name for item in fields(Recording)]
    return Recording(*(change(*(getattr(one, name) for one in recordings)) for name in names))


def _parted(recording: Recording, before: Recording | None) -> tuple[Recording, Recording | None]:
    """A part with the run that came before it, less the run that is still open at its end."""
    if before is not None:
        recording = _mapped(lambda *two: np.concatenate(two), before, recording)
    usable = recording.usable
    if not usable.size or not usable[-1]:
        return recording, None
    stops = np.flatnonzero(~usable)
    first = int(stops[-1]) + 1 if stops.size else 0
    return (
        _mapped(lambda values: values[:first], recording),
        _mapped(lambda values: values[first:], recording),
    )


def _timeline(prepared: Prepared, inside: BoolArray) -> Timeline:
    rows = np.flatnonzero(inside)
    time = prepared.recording.time[rows]
    if not rows.size:
        return Timeline(time, time, time, dict.fromkeys(prepared.masks, rows > 0))
    first = np.flatnonzero(np.diff(np.floor(time), prepend=-np.inf) > 0)
    masks = {
        reason: np.logical_or.reduceat(mask[rows], first) for reason, mask in prepared.masks.items()
    }
    kept = rows[first]
    return Timeline(time[first], prepared.speed[kept], prepared.position[kept], masks)


def _at_a_glance(lines: Sequence[Timeline]) -> Timeline:
    return Timeline(
        time=np.concatenate([line.time for line in lines]),
        speed=np.concatenate([line.speed for line in lines]),
        position=np.concatenate([line.position for line in lines]),
        masks={
            reason: np.concatenate([line.masks[reason] for line in lines])
            for reason in lines[0].masks
        },
    )
