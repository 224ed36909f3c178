"""A trip as analyses see it: what several of them need of it is computed once, on demand.

An analysis takes a trip at hand, the path of a log, or a `TripView` that others have used before.
A log too long for the memory is parted where the train turned back, where the recording paused, and
at stands: each part is a trip of its own. What is read at once does not grow with the log.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid

from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.display import counted
from trainlog.errors import InputError, LogError
from trainlog.formats.files import check_kind, logs_of
from trainlog.formats.railway import line_of, train_of
from trainlog.identity import COLUMNS, TripIdentity, identity_of
from trainlog.ingest.frozen import without_frozen
from trainlog.ingest.recording import Finding
from trainlog.mcap import DamageWarning, account_of, read_log, stream_log
from trainlog.mcap.contents import checksum_holds, contents_of
from trainlog.mcap.reader import identity_of_log, rows_of_log
from trainlog.mcap.records import Source
from trainlog.railway.line import STATION_REACH, Line, km_words
from trainlog.railway.train import Train
from trainlog.resampling import forward_chainage, interpolated
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

ROWS = 1_000_000
"""Rows over the topics read up to which a log is one trip; the parts of a longer one have at most
so many, too: 28 hours of one topic at 10 Hz."""

PAUSE = 900.0
"""A recording that pauses for so long [s] goes on as another part of a long log."""

PIECE = 200_000
"""Rows of a piece, in which the course of a long log is looked through."""

STRIDE = 64
"""Of so many samples of a long log the time of one is kept."""

SHORTEST_STOP = 5.0
"""A train that stands for less [s] is creeping, not stopping."""

STANDING_ESTIMATE = 0.3
"""Estimated speed [m/s] up to which a train stands: satellites' speeds waver at rest."""

LARGEST_SETBACK, NOTED_SETBACK = 200.0, 2.0
"""Metres by which recorded chainage may run backwards on one run, and that are stated."""

SPIKE, SPIKE_SAMPLES = 50.0, 51
"""A position so far [m] off the median of so many around it, less what the speed explains, is no
position."""

TOPICS = tuple(
    topic.name
    for topic in (
        TRAIN_STATE, TRAIN_CONTROLS, TRAIN_AXLES, TRAIN_SUPPLY, TRAIN_SLIP_PROTECTION,
        GNSS_FIX, GNSS_MOTION, ENVIRONMENT, REFERENCE, EVENTS, ESTIMATED_STATE,
    )
)  # fmt: skip
"""What all analyses together read of a log."""

T = TypeVar("T")


@dataclass(eq=False)
class TripView:
    """A trip with what several analyses need of it; each is made once, when it is first asked for.

    The trip must not change while its view is in use.

    Attributes
    ----------
    trip : Trip
        That of a part of a long log has its number in the name.
    path : Path or None
        Of the log.
    sha256 : str
        Of the log; empty where it is not known, and of a part.
    number, count : int
        Which part of how many, from 1.
    damage : str
        What of the log is lost, where that was looked for; empty if it is whole.

    Examples
    --------
    >>> view = view_of("sample_logs/nonstop.mcap")
    >>> view.name, view.train.name, view.line is view.line
    ('trip-01', 'CH_Stadler_FLIRT_TPF', True)
    """

    trip: Trip
    path: Path | None = None
    sha256: str = ""
    number: int = 1
    count: int = 1
    damage: str = ""
    _made: dict[Callable[[TripView], Any], Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Refuse infinite numbers: an analysis would take them for measured ones."""
        for topic, frame in self.trip.topics.items():
            for column, values in frame.select_dtypes("number").items():
                if infinite := int(np.isinf(values.to_numpy()).sum()):
                    raise LogError(
                        f"trip '{self.name}' holds {counted(infinite, 'infinite number')}",
                        file=self.path,
                        place=f"{topic}, column {column}",
                        remedy="give NaN where nothing is known",
                    )

    def once(self, make: Callable[[TripView], T]) -> T:
        """What a function makes of the view, computed when it is first asked for.

        What it refuses it refuses each time.
        """
        if make not in self._made:
            self._made[make] = make(self)
        return cast("T", self._made[make])

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
    def identity(self) -> TripIdentity | None:
        """Which drive it is, by all that is recorded of it."""
        topic, column, _ = COLUMNS[0]
        frame = self.trip.topics.get(topic)
        known = frame is not None and column in frame and bool(frame[column].notna().any())
        whole = self.path is None or self.count > 1 or known
        return identity_of(self.trip) if whole else identity_of_log(cast("Path", self.path))

    @cached_property
    def located(self) -> Trip:
        """The trip, as `with_chainage` has it."""
        return with_chainage(self.trip)

    @cached_property
    def unfrozen(self) -> tuple[Trip, list[Finding]]:
        """The trip without values that its recorder repeated while the train moved, and these."""
        return without_frozen(self.trip)


def with_chainage(trip: Trip) -> Trip:
    """A trip whose recorded speeds have the estimated chainage, where none is recorded.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/nonstop.mcap")
    >>> with_chainage(trip) is trip
    True
    """
    state = trip.topics.get(TRAIN_STATE.name)
    estimated = trip.topics.get(ESTIMATED_STATE.name)
    if state is None or estimated is None or state["position"].notna().any():
        return trip
    if not estimated["position"].notna().any():
        return trip
    position = interpolated(estimated, "position", pd.DatetimeIndex(state.index))
    return trip.with_topic(state.assign(position=position))


def one_way(
    trip: str, line: Line | None, time: FloatArray, speed: FloatArray, recorded: FloatArray
) -> tuple[FloatArray, FloatArray, list[str]]:
    """Recorded chainage without spikes, the nearest that never falls, and notes on both.

    Parameters
    ----------
    trip : str
    line : Line or None
        As travelled.
    time, speed, recorded : (n,) array [s], [m/s], [m]
        All of them known.

    Raises
    ------
    LogError
        If the chainage runs backwards by more than `LARGEST_SETBACK`.
    """
    from scipy.ndimage import median_filter

    notes = list[str]()
    run = cumulative_trapezoid(speed, time, initial=0.0)
    usual = run + median_filter(recorded - run, SPIKE_SAMPLES, mode="reflect")
    spikes = np.abs(recorded - usual) > SPIKE
    if spikes.any():
        place = km_words(line, float(usual[spikes][0]))
        samples = counted(int(spikes.sum()), "sample")
        notes.append(f"chainage: {samples} far off left out, first at {place}")
        recorded = np.where(spikes, usual, recorded)
    position = forward_chainage(recorded)
    moved = np.abs(position - np.maximum(recorded, 0.0))
    worst = int(np.argmax(moved))
    place = km_words(line, float(recorded[worst]))
    if moved[worst] > LARGEST_SETBACK:
        raise LogError(
            f"trip '{trip}' runs backwards by {2.0 * moved[worst]:.0f} m",
            place=place,
            remedy="position must grow in the direction of travel: cut it into trips of one"
            " direction (trainlog convert --from --to), or ingest it again with its line",
        )
    if moved[worst] > NOTED_SETBACK:
        notes.append(f"chainage set back at {place}: moved by up to {moved[worst]:.1f} m")
    beyond = 0.0 if line is None else float(position[-1] - line.length)
    if beyond > STATION_REACH:
        notes.append(f"ends {beyond:.0f} m beyond the line's end: chainage or line may be wrong")
    return recorded, position, notes


Given = Trip | TripView | str | Path
"""A trip, its view, the path of a log, or that of a folder of logs."""

_ONE = (Trip, TripView, str, Path)


def each_given(trips: Given | Iterable[Given]) -> Iterator[Trip | TripView | Path]:
    """Trips and paths of files, one after the other; a folder stands for its logs, by name.

    Raises
    ------
    InputError
        If a folder holds no log, or something is neither a trip nor a path.

    Examples
    --------
    >>> [path.name for path in each_given("sample_logs")]
    ['nonstop.mcap', 'stopping.mcap']
    """
    for given in trips if isinstance(trips, Iterable) and not isinstance(trips, _ONE) else [trips]:
        check_kind(given, *_ONE)
        if isinstance(given, Trip | TripView):
            yield given
            continue
        yield from logs_of(Path(given))


def view_of(given: Given, topics: Sequence[str] | None = None) -> TripView:
    """The view of a trip, read whole where it is a log.

    Parameters
    ----------
    given : Trip, TripView or path
    topics : sequence of str, optional
        What is read of a log; default: everything.

    Raises
    ------
    InputError
        If it is neither a trip nor a path, or the path is that of a folder.
    LogError
        If the file is not a log, or the trip holds infinite numbers.

    Examples
    --------
    >>> view_of("sample_logs/nonstop.mcap", ["/train/state"]).name
    'trip-01'
    """
    check_kind(given, *_ONE)
    if isinstance(given, TripView):
        return given
    if isinstance(given, Trip):
        return TripView(given)
    if Path(given).is_dir():
        raise InputError("is a folder; one trip is expected", file=given, remedy="give one log")
    return TripView(read_log(given, topics), Path(given))


def trip_of(given: Given, topics: Sequence[str] | None = None) -> Trip:
    """The trip of `view_of`, with its errors.

    Examples
    --------
    >>> trip_of("sample_logs/nonstop.mcap", ["/train/state"]).name
    'trip-01'
    """
    return view_of(given, topics).trip


def views_of(
    given: Given,
    topics: Sequence[str] | None = None,
    *,
    sha256: str = "",
    rows: int | None = None,
    checked: bool = False,
) -> Iterator[TripView]:
    """The view of a trip; of a log too long for the memory those of its parts, one by one.

    Parameters
    ----------
    given : Trip, TripView or path
    topics : sequence of str, optional
        What is read of a log; default: everything.
    sha256 : str
        Of the log.
    rows : int, optional
        Rows over these topics from which on a log is parted; default: `ROWS`.
    checked : bool
        Whether it is looked for what of the log is lost: `TripView.damage` states it instead of
        a warning.

    Yields
    ------
    TripView
        One at least.

    Raises
    ------
    LogError, InputError
        As `trainlog.mcap.read_log`.

    Examples
    --------
    >>> [view.name for view in views_of("sample_logs/stopping.mcap")]
    ['trip-03']
    >>> [view.name for view in views_of("sample_logs/stopping.mcap", rows=60_000)]
    ['trip-03 (1 of 2)', 'trip-03 (2 of 2)']
    """
    if not isinstance(given, str | Path):
        yield view_of(given)
        return
    path, most = Path(given), ROWS if rows is None else rows
    held = rows_of_log(path, topics)
    if held <= most:
        trip, damage = _read(path, topics, None, checked)
        yield TripView(trip, path, sha256, damage=damage)
        return
    spans = parts_of(path, held, most)
    count = len(spans)
    for number, span in enumerate(spans, start=1):
        trip, damage = _read(path, topics, span, checked)
        named = trip.metadata | {"trip": f"{trip.name} ({number} of {count})"}
        yield TripView(replace(trip, metadata=named), path, "", number, count, damage)


def _read(
    path: Path, topics: Sequence[str] | None, span: tuple[int, int] | None, checked: bool
) -> tuple[Trip, str]:
    """A log, or the part of it in a span of time, and what of the log is lost."""
    time = None
    if span is not None:
        first, last = span
        time = (
            None if first == ALWAYS[0] else pd.Timestamp(first, tz="UTC"),
            None if last == ALWAYS[1] else pd.Timestamp(last, tz="UTC"),
        )
    if not checked:
        return read_log(path, topics, time=time), ""
    damage = ""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        trip = read_log(path, topics, time=time)
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
    _way: int = 0
    _low: float = np.inf
    _high: float = -np.inf
    _before: float = np.nan
    _furthest: tuple[int, int] = (0, 0)
    _stood: int | None = None

    def add(self, frame: pd.DataFrame, standing: float) -> None:
        """Look through the next samples; up to a speed [m/s] the train stands."""
        time = pd.DatetimeIndex(frame.index).as_unit("ns").asi8
        self.clock.append(time[-self.samples % STRIDE :: STRIDE])
        before = time[:1] if self._last is None else np.array([self._last])
        paused = np.flatnonzero(np.diff(np.concatenate((before, time))) > PAUSE * NANOSECONDS)
        cuts = [(self.samples + row, int(time[row])) for row in paused.tolist()]
        borders = [0, *paused.tolist(), time.size]
        for first, last in pairwise(borders):
            if first in paused:
                self._begin()
            cuts += self._turned(time[first:last], frame["position"].iloc[first:last], first)
        self.turns += sorted(set(cuts))
        self._stands(time, frame["speed"].to_numpy(np.float64) <= standing)
        self.samples += time.size
        self._last = int(time[-1])

    def _begin(self) -> None:
        """A part begins: its direction is not known."""
        self._way, self._low, self._high = 0, np.inf, -np.inf

    def _turned(self, time: IntArray, position: pd.Series, offset: int) -> list[tuple[int, int]]:
        """Samples from which on the train runs back, or the line anew, with their times.

        Where it turned they are the furthest that it came; where the chainage jumped, behind the
        jump.
        """
        values, found, start = position.to_numpy(np.float64), list[tuple[int, int]](), 0
        far = 2.0 * LARGEST_SETBACK
        earlier = np.concatenate(([self._before], values[:-1]))
        while start < values.size:
            part = values[start:]
            low = np.fmin.accumulate(np.concatenate(([self._low], part)))[1:]
            high = np.fmax.accumulate(np.concatenate(([self._high], part)))[1:]
            risen, fallen = part - low > far, high - part > far
            moved = np.flatnonzero({0: risen | fallen, 1: fallen, -1: risen}[self._way])
            stop = int(moved[0]) if moved.size else part.size
            furthest = part[:stop] == (high if self._way > 0 else low)[:stop]
            if self._way and furthest.any():
                last = start + int(np.flatnonzero(furthest)[-1])
                self._furthest = (self.samples + offset + last, int(time[last]))
            if not moved.size:
                self._low, self._high = float(low[-1]), float(high[-1])
                break
            start += stop
            here = self.samples + offset + start, int(time[start])
            if self._way == 0:
                self._way, self._furthest = (1 if risen[stop] else -1), here
            else:
                jumped = abs(values[start] - earlier[start]) > far
                found.append(here if jumped else self._furthest)
                self._begin()
            self._low = self._high = float(values[start])
        known = values[np.isfinite(values)]
        self._before = float(known[-1]) if known.size else self._before
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
        If it knows neither position nor speed, and cannot be parted therefore.
    """
    course = _course_of(path, held)
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


def _course_of(path: Path, held: int) -> _Course:
    """The course of a long log by its position, else by its speed alone."""
    by_position = [(name, ("position", "speed")) for name in POSITION_TOPICS]
    by_speed = [(each.name, ("speed",)) for each in (TRAIN_STATE, GNSS_MOTION)]
    for topic, columns in (*by_position, *by_speed):
        course, known = _Course(), False
        for piece in stream_log(path, {topic: columns}, rows=PIECE):
            if topic in piece and len(piece[topic]):
                frame = piece[topic].reindex(columns=["position", "speed"])
                known = known or bool(frame[columns[0]].notna().any())
                course.add(frame, STANDSTILL if topic == TRAIN_STATE.name else STANDING_ESTIMATE)
        if known:
            return course
    raise LogError(
        f"is too long to be read at once ({held:,} rows) and knows neither position nor speed",
        file=path,
        remedy="cut it into trips (trainlog convert), or ingest it again with its line",
    )
