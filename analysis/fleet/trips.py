"""Trips as analyses of a fleet take them: a log is read once, whatever is computed from it.

A log that is too long for the memory is parted where the train turned back, where the recording
paused, and at stands; each part is a trip of its own to the analyses. What is read at once
does not grow with the log.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd

from analysis.adhesion.slip import SlipAnalysis, slip
from analysis.comparison.driven import (
    LARGEST_SETBACK,
    SHORTEST_STOP,
    STANDING_ESTIMATE,
    DrivenTrip,
    driven_trip,
)
from analysis.given import Given
from analysis.resistance.passport import passport
from trainlog.arrays import BoolArray, IntArray
from trainlog.errors import LogError
from trainlog.formats.railway import line_of, train_of
from trainlog.identity import TripIdentity, identity_of
from trainlog.mcap import DamageWarning, account_of, read_log, stream_log
from trainlog.mcap.contents import checksum_holds, contents_of
from trainlog.mcap.reader import rows_of_log
from trainlog.mcap.records import Source
from trainlog.railway.line import Line
from trainlog.railway.passport import Passport
from trainlog.railway.train import Train
from trainlog.spans import ALWAYS, runs_of
from trainlog.topics import (
    ENVIRONMENT,
    ESTIMATED_STATE,
    EVENTS,
    GNSS_FIX,
    GNSS_MOTION,
    REFERENCE,
    STANDSTILL,
    TRAIN_AXLES,
    TRAIN_CONTROLS,
    TRAIN_SLIP_PROTECTION,
    TRAIN_STATE,
    TRAIN_SUPPLY,
)
from trainlog.trip import POSITION_TOPICS, Trip
from trainlog.units import NANOSECONDS

TOPICS = tuple(
    topic.name
    for topic in (
        TRAIN_STATE, TRAIN_CONTROLS, TRAIN_AXLES, TRAIN_SUPPLY, TRAIN_SLIP_PROTECTION,
        GNSS_FIX, GNSS_MOTION, ENVIRONMENT, REFERENCE, EVENTS, ESTIMATED_STATE,
    )
)  # fmt: skip
"""What is read of each log."""

ROWS = 500_000
"""Rows over all these topics up to which a log is one trip; the parts of a longer one have at most
so many, too."""

PAUSE = 900.0
"""A recording that pauses for so long [s] goes on as another part of a long log."""

PIECE = 200_000
"""Rows of a piece, in which the course of a long log is looked through."""


@dataclass(eq=False)
class FleetTrip:
    """A trip with what several analyses need of it; each is made once, when it is first asked for.

    Attributes
    ----------
    trip : Trip
        With the topics `TOPICS`. That of a part of a long log has its number in the name.
    sha256 : str
        Of the log; empty where there is none, and of a part.
    number, count : int
        Which part of how many, from 1.
    damage : str
        What of the log is lost; empty if it is whole.
    """

    trip: Trip
    sha256: str = ""
    number: int = 1
    count: int = 1
    damage: str = ""

    @property
    def name(self) -> str:
        """Of the trip."""
        return self.trip.name

    @cached_property
    def line(self) -> Line:
        """As travelled."""
        return line_of(self.trip)

    @cached_property
    def own_line(self) -> Line:
        """In its own direction."""
        return self.line.reversed() if self.backwards else self.line

    @property
    def backwards(self) -> bool:
        """Whether the trip runs against the chainage of its line."""
        return self.trip.metadata.get("direction") == "reverse"

    @cached_property
    def train(self) -> Train:
        """Empty."""
        return train_of(self.trip)

    @cached_property
    def passport(self) -> Passport:
        """As stored with the trip, or estimated."""
        return passport(self.trip)

    @cached_property
    def slip(self) -> SlipAnalysis:
        """Slip of the axles, by the passport."""
        return slip(self.trip, self.passport)

    @cached_property
    def driven(self) -> DrivenTrip:
        """The trip by position."""
        return driven_trip(self.trip)

    @cached_property
    def identity(self) -> TripIdentity | None:
        """Which drive it is."""
        return identity_of(self.trip)


def fleet_trips(given: Given, sha256: str = "", *, rows: int = ROWS) -> Iterator[FleetTrip]:
    """The trip of a log; of a log too long for the memory its parts, one after the other.

    Parameters
    ----------
    given : Trip or path
    sha256 : str
        Of the log.
    rows : int
        Rows over all topics from which on a log is parted.

    Yields
    ------
    FleetTrip
        One at least.

    Raises
    ------
    LogError, InputError
        As `trainlog.mcap.read_log`.

    Examples
    --------
    >>> [trip.name for trip in fleet_trips("sample_logs/stopping.mcap")]
    ['trip-03']
    >>> [trip.name for trip in fleet_trips("sample_logs/stopping.mcap", rows=40_000)]
    ['trip-03 (1 of 2)', 'trip-03 (2 of 2)']
    """
    if isinstance(given, Trip):
        yield FleetTrip(given, sha256)
        return
    path = Path(given)
    held = rows_of_log(path, TOPICS)
    if held <= rows:
        trip, damage = _read(path, None)
        yield FleetTrip(trip, sha256, damage=damage)
        return
    spans = parts_of(path, held, rows)
    count = len(spans)
    for number, span in enumerate(spans, start=1):
        trip, damage = _read(path, span)
        named = trip.metadata | {"trip": f"{trip.name} ({number} of {count})"}
        yield FleetTrip(replace(trip, metadata=named), "", number, count, damage)


def _read(path: Path, span: tuple[int, int] | None) -> tuple[Trip, str]:
    """A log, or the part of it in a span of time, and what of the log is lost."""
    time = None
    if span is not None:
        first, last = span
        time = (
            None if first == ALWAYS[0] else pd.Timestamp(first, tz="UTC"),
            None if last == ALWAYS[1] else pd.Timestamp(last, tz="UTC"),
        )
    damage = ""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # One thread: the trips of a fleet are what is shared out between processors.
        trip = read_log(path, TOPICS, time=time, threads=1)
    for each in caught:
        if isinstance(each.message, DamageWarning):
            damage = each.message.account.sentence
        else:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    if span is None and not damage:
        with Source(path) as source:
            if not checksum_holds(source, contents_of(source)):
                damage = account_of(path).sentence
    return trip, damage


@dataclass
class _Course:
    """Where a long log may be parted, as its samples are looked through.

    Attributes
    ----------
    samples : int
        So far.
    turns, stands : list of (int, int)
        Sample and time [ns] at which it must be parted, and may be.
    clock : list of int arrays [ns]
        Time of every `STRIDE`-th sample.
    """

    samples: int = 0
    turns: list[tuple[int, int]] = field(default_factory=list)
    stands: list[tuple[int, int]] = field(default_factory=list)
    clock: list[IntArray] = field(default_factory=list)
    _last: int | None = None
    _reached: float = -np.inf
    _stood: int | None = None

    def add(self, frame: pd.DataFrame, standing: float) -> None:
        """Look through the next samples; up to a speed [m/s] the train stands."""
        time = pd.DatetimeIndex(frame.index).as_unit("ns").asi8
        self.clock.append(time[-self.samples % STRIDE :: STRIDE])
        before = time[:1] if self._last is None else np.array([self._last])
        paused = np.diff(np.concatenate((before, time))) > PAUSE * NANOSECONDS
        cuts = [*np.flatnonzero(paused).tolist(), *self._turned(frame["position"], paused)]
        self.turns += [(self.samples + row, int(time[row])) for row in sorted(set(cuts))]
        self._stands(time, frame["speed"].to_numpy(np.float64) <= standing)
        self.samples += time.size
        self._last = int(time[-1])

    def _turned(self, position: pd.Series, paused: BoolArray) -> list[int]:
        """Rows from which on the train runs the line anew."""
        values = position.to_numpy(np.float64)
        found, start = [], 0
        fresh = np.flatnonzero(paused).tolist()
        while start < values.size:
            end = next((row for row in fresh if row > start), values.size)
            if start in fresh:
                self._reached = -np.inf
            part = values[start:end]
            reached = np.fmax.accumulate(np.concatenate(([self._reached], part)))[1:]
            back = np.flatnonzero(reached - part > 2.0 * LARGEST_SETBACK)
            if not back.size:
                self._reached = float(reached[-1])
                start = end
                continue
            start += int(back[0])
            found.append(start)
            self._reached = -np.inf
            fresh = [row for row in fresh if row > start]
        return found

    def _stands(self, time: IntArray, slow: BoolArray) -> None:
        """Note the middle of each stand; one that goes on in the next piece is noted there."""
        for begin, end in runs_of(slow):
            first = self._stood if begin == 0 and self._stood is not None else int(time[begin])
            self._stood = first if end == time.size else None
            middle = (first + int(time[end - 1])) // 2
            if end < time.size and time[end - 1] - first > SHORTEST_STOP * NANOSECONDS:
                self.stands.append((self.samples + (begin + end) // 2, middle))
        if slow.size and not slow[-1]:
            self._stood = None


STRIDE = 64
"""Of so many samples of a long log the time of one is kept."""


def parts_of(path: Path, held: int, rows: int) -> list[tuple[int, int]]:
    """Spans of time [ns] in which a long log is read: they share no instant and leave none out.

    Parameters
    ----------
    path : Path
    held : int
        Rows that the log holds.
    rows : int
        Most rows of a part.

    Raises
    ------
    LogError
        If it knows no position, and cannot be parted therefore.
    """
    course, topic = _Course(), ""
    chosen = {name: ["speed", "position"] for name in POSITION_TOPICS}
    for piece in stream_log(path, chosen, rows=PIECE):
        known = [name for name in POSITION_TOPICS if name in piece and len(piece[name])]
        topic = topic or next((n for n in known if piece[n]["position"].notna().any()), "")
        if topic and topic in known:
            course.add(piece[topic], STANDSTILL if topic == TRAIN_STATE.name else STANDING_ESTIMATE)
    if not topic:
        raise LogError(
            f"is too long to be read at once ({held:,} rows) and knows no position",
            file=path,
            remedy="cut it into trips (trainlog convert), or ingest it again with its line",
        )
    clock = np.concatenate(course.clock)
    most = max(1, int(rows * course.samples / held))
    cuts: list[int] = []
    turns = [(0, ALWAYS[0]), *course.turns, (course.samples, ALWAYS[1])]
    for (begin, start), (end, _) in pairwise(turns):
        cuts += [start] if start != ALWAYS[0] else []
        while end - begin > most:
            near = [each for each in course.stands if begin + most // 5 < each[0] <= begin + most]
            sample = begin + most
            begin, time = near[-1] if near else (sample, int(clock[sample // STRIDE]))
            cuts.append(time)
    edges = [ALWAYS[0], *sorted(set(cuts)), ALWAYS[1]]
    last = len(edges) - 2
    return [
        (first, second - 1 if number < last else second)
        for number, (first, second) in enumerate(pairwise(edges))
    ]
