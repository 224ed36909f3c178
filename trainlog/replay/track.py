"""What a trip's line adds to it: limit and gradient, sections and kilometres, and where it is.

A timeline of Rerun counts in whole numbers. Kilometres are therefore written out: as blocks under
the plots, and with three decimals beside them for the instant at the cursor.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
import rerun as rr

from trainlog.arrays import FloatArray, IntArray
from trainlog.railway import Line
from trainlog.railway.line import StepProfile, in_km
from trainlog.replay.clock import Clock, Instants, Nanoseconds, nanoseconds
from trainlog.replay.curves import COLOURS, Colour
from trainlog.replay.samples import (
    Samples,
    from_whole_kilometre,
    send_curve,
    send_rows,
    send_static,
)
from trainlog.resampling import interpolated
from trainlog.topics import ESTIMATED_STATE, GNSS_MOTION, REFERENCE, TRAIN_STATE
from trainlog.trip import Trip
from trainlog.units import KMH, NANOSECONDS, PER_MILLE

SPEEDS: tuple[str, ...] = (TRAIN_STATE.name, GNSS_MOTION.name, ESTIMATED_STATE.name)
"""Topics with a trip's own speed, that which is shown first."""

BLOCKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Lengths of the blocks of the kilometre lane [km]."""

MOST_BLOCKS = 15
"""More have no place for their kilometres under a plot."""

SHORTEST_NAMED = 0.7
"""Share of its length from which a block has space for its kilometre."""

KILOMETRE_STEP = 10.0
"""How finely the operator's kilometre is sampled [m]."""

KILOMETRES: tuple[Colour, Colour] = (70, 75, 90), (105, 110, 125)
SECTIONS: tuple[Colour, Colour] = (50, 85, 125), (75, 120, 170)
"""Colours of neighbouring blocks."""


def draw_profile(
    recording: Any, root: str, line: Line, clock: Clock, known: frozenset[str] | set[str]
) -> set[str]:
    """Draw the limit and the gradient of a line under a trip that does not record them itself.

    Parameters
    ----------
    recording : rerun.RecordingStream
    root : str
        Path of the trip.
    line : Line
        As travelled.
    clock : Clock
    known : set of str
        Entities that are drawn already.

    Returns
    -------
    set of str
        Entities that were drawn.
    """
    drawn = set()
    profiles: list[tuple[str, StepProfile, float, str, Colour]] = [
        ("speed/limit", line.speed_limits, KMH, "limit", COLOURS["limit"]),
        ("gradient", line.gradients, PER_MILLE, "gradient", COLOURS["terrain"]),
    ]
    for entity, profile, scale, name, colour in profiles:
        if entity in known or clock.position.size == 0 or clock.covered[0] == clock.covered[1]:
            continue
        first, last = clock.covered
        changes = profile.positions[(profile.positions > first) & (profile.positions < last)]
        places = np.concatenate(([first], changes, [last]))
        instants = passages(clock, places)
        values = scale * profile(np.append(places[:-1], places[-2]))
        send_curve(
            *(recording, f"{root}/{entity}", instants, Samples(instants.time, values[:, None])),
            names=[f"{name} of the line"],
            colours=[colour],
            held=True,
        )
        drawn.add(entity)
    return drawn


def passages(clock: Clock, position: FloatArray) -> Instants:
    """When the train reached each position [m]; those outside of the trip at its ends."""
    inside = np.clip(position, *clock.covered)
    time = clock.start + np.rint(clock.arrival_at(inside) * NANOSECONDS).astype(np.int64)
    return Instants(clock.start, time, position)


def draw_lanes(recording: Any, root: str, line: Line | None, clock: Clock) -> set[str]:
    """Draw between which stations and kilometres a trip was, as lanes of blocks.

    Returns
    -------
    set of str
        Entities that were drawn.
    """
    if clock.position.size == 0 or clock.covered[0] == clock.covered[1]:
        return set()
    drawn = {"kilometre"}
    places, names = _kilometre_blocks(line, *clock.covered)
    _send_lane(recording, f"{root}/kilometre", passages(clock, places), names, KILOMETRES)
    if line is not None and len(line.stations) > 1:
        sections, titles = _section_blocks(line, *clock.covered)
        _send_lane(recording, f"{root}/section", passages(clock, sections), titles, SECTIONS)
        drawn.add("section")
    return drawn


def _kilometre_blocks(line: Line | None, first: float, last: float) -> tuple[FloatArray, list[str]]:
    fit = [each for each in BLOCKS if (last - first) / (1e3 * each) <= MOST_BLOCKS]
    length = fit[0] if fit else BLOCKS[-1]
    places = np.append(np.arange(first, last, KILOMETRE_STEP), last)
    kilometre = in_km(line, places)
    number = np.floor(kilometre / length + 1e-9)
    begins = np.concatenate(([0], np.flatnonzero(np.diff(number)) + 1))
    names = [f"km {round(kilometre[i], 1):g}" for i in begins]
    # What the trip has of its first block may be too short for its kilometre.
    ends = np.append(places[begins[1:]], last)
    if ends[0] - first < SHORTEST_NAMED * 1e3 * length and len(names) > 1:
        names[0] = ""
    return places[begins], names


def _section_blocks(line: Line, first: float, last: float) -> tuple[FloatArray, list[str]]:
    stations = sorted(line.stations, key=lambda station: station.position)
    places = np.array([station.position for station in stations])
    row = section_of(places, np.array([first]))[0]
    end = section_of(places, np.array([last - 1e-6]))[0]
    rows = np.arange(row, end + 1)
    names = section_names(line)
    return np.maximum(places[np.maximum(rows, 0)], first), [names[each + 1] for each in rows]


def section_names(line: Line) -> list[str]:
    """Names of the sections, from that before the first station to that behind the last."""
    names = [each.name for each in sorted(line.stations, key=lambda station: station.position)]
    inner = [f"{one} – {other}" for one, other in pairwise(names)]
    return [f"before {names[0]}", *inner, f"after {names[-1]}"]


def section_of(stations: FloatArray, position: FloatArray) -> IntArray:
    """Number of the section of each position: -1 before the first station."""
    found = np.searchsorted(stations, position, side="right") - 1
    # A train that stands at its last station is still in the section that leads to it.
    at_end = (found == stations.size - 1) & (position <= stations[-1] + 1.0)
    return np.asarray(np.where(at_end, found - 1, found), dtype=np.int64)


def _send_lane(
    recording: Any,
    entity: str,
    instants: Instants,
    names: list[str],
    colours: tuple[Colour, Colour],
) -> None:
    values = list(dict.fromkeys(names))
    shades = np.array([colours[i % 2] for i in range(len(values))], dtype=np.uint8)
    send_static(recording, entity, rr.StateConfiguration(values=values, colors=shades))
    send_rows(recording, entity, instants, lambda rows: rr.StateChange.columns(state=names[rows]))


class Whereabouts:
    """Writes where a trip is, and how fast, for each of its seconds.

    Parameters
    ----------
    recording : rerun.RecordingStream
    entity : str
    line : Line or None
        As travelled.
    clock : Clock
    """

    def __init__(self, recording: Any, entity: str, line: Line | None, clock: Clock) -> None:
        self._recording = recording
        self._entity = entity
        self._line = line
        self._clock = clock
        self._last = -1

    def add(self, piece: Trip) -> bool:
        """Write the seconds of the next piece; whether there were any."""
        found = speed_of(piece)
        if found is None or self._clock.time.size == 0:
            return False
        time, speed = found
        second, first = np.unique(time // NANOSECONDS, return_index=True)
        # A second that began in the piece before is written already.
        first, begun = first[second > self._last], self._last >= 0
        self._last = int(second[-1])
        instants = self._clock.instants(time[first])
        late = lateness_of(piece, time[first])
        texts = self.texts(instants.position, speed[first], late)
        if not begun and instants.position.size:
            begins, text = from_whole_kilometre(instants), texts[0].partition("\n")[0]
            if begins.position[0] < begins.position[1]:
                instants, texts = begins, [f"{text}\n\nThe trip begins there.", *texts]
        if not begun:
            style = rr.TextDocument.from_fields(media_type="text/markdown")
            send_static(self._recording, self._entity, style)
        send_rows(
            *(self._recording, self._entity, instants),
            lambda rows: rr.TextDocument.columns(text=texts[rows]),
        )
        return True

    def texts(
        self, position: FloatArray, speed: FloatArray, late: FloatArray | None = None
    ) -> list[str]:
        """What is written at each position [m], speed [m/s] and lateness [s]; Markdown."""
        line = self._line
        columns = [
            [f"# km {each:.3f}" for each in in_km(line, position).tolist()],
            [
                "## speed not known" if np.isnan(each) else f"## {each:.1f} km/h"
                for each in (KMH * speed).tolist()
            ],
        ]
        if late is not None:
            columns.append(
                ["" if np.isnan(each) else signed_lateness(each) for each in late.tolist()]
            )
        if line is not None:
            inside = np.clip(position, 0.0, line.length)
            limits, slopes = KMH * line.speed_limit(inside), PER_MILLE * line.gradient(inside)
            columns.append(
                [
                    f"limit {limit:.0f} km/h, gradient {slope:+.1f} ‰"
                    for limit, slope in zip(limits.tolist(), slopes.tolist(), strict=True)
                ]
            )
            if len(line.stations) > 1:
                stations = np.sort([each.position for each in line.stations])
                titles = section_names(line)
                columns.append([titles[row + 1] for row in section_of(stations, position).tolist()])
        return ["\n\n".join(filter(None, each)) for each in zip(*columns, strict=True)]


def signed_lateness(seconds: float) -> str:
    """Lateness with its sign, and what the sign means.

    Examples
    --------
    >>> signed_lateness(12.34), signed_lateness(-3.0), signed_lateness(0.02)
    ('+12.3 s, late', '-3.0 s, early', '0.0 s, on time')
    """
    rounded = round(seconds, 1)
    if rounded == 0.0:
        return "0.0 s, on time"
    return f"{rounded:+.1f} s, {'late' if rounded > 0.0 else 'early'}"


def lateness_of(piece: Trip, time: Nanoseconds) -> FloatArray | None:
    """Lateness [s] against the trajectory that a trip followed, at each time; None without one."""
    frame = piece.topics.get(REFERENCE.name)
    if frame is None or frame.empty or "lateness" not in frame:
        return None
    return interpolated(frame, "lateness", pd.to_datetime(time, utc=True), 2.0)


def speed_of(piece: Trip) -> tuple[Nanoseconds, FloatArray] | None:
    """Time and speed [m/s] of the trip's own speed; None without one."""
    for name in SPEEDS:
        if name in piece and "speed" in piece[name] and len(piece[name]):
            frame: pd.DataFrame = piece[name]
            speed = frame["speed"].to_numpy(dtype=np.float64)
            if np.isfinite(speed).any():
                return nanoseconds(frame), speed
    return None
