"""Trips as one Rerun recording, with the layout that shows them.

While a trip is recorded, a thread of its own draws what the recorder has written. Where the viewer
is slower than the recording, or closed, samples are not drawn, and counted: the recording never
waits.
"""

from __future__ import annotations

import hashlib
import os
import queue
import subprocess
import threading
import time
import urllib.parse
import warnings
import webbrowser
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import rerun as rr

from trainlog.display import few
from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.formats.railway import line_of, line_to_bytes
from trainlog.mcap.recorder import Recording
from trainlog.progress import track
from trainlog.railway import Line, TrackConditionMap, Trajectory
from trainlog.replay.drawing import (
    Drawing,
    chart_of,
    draw_line_of,
    draw_trajectory,
    each_second,
    observed,
    top_of,
)
from trainlog.replay.layout import Contents, blueprint, check_view
from trainlog.replay.samples import TRIPS, Clock, largest_pulls
from trainlog.replay.survey import (
    Pieces,
    Survey,
    group_of,
    neighboured,
    pieces_of,
    references,
    survey,
    thinned_trips,
)
from trainlog.replay.viewer import (
    HOST,
    end_viewer,
    free_port,
    has_display,
    start_viewer,
    web_viewer,
)
from trainlog.resampling import POSITION_SOURCES, known_rows, time_distance
from trainlog.topics import GNSS_FIX, TRAIN_CONTROLS, TRAIN_STATE
from trainlog.trip import LINE_ATTACHMENT, Trip, nanoseconds
from trainlog.units import EARTH_RADIUS

_ENDING, _FOOTER = 64, b"RRF2FOOT"
"""What the last bytes of a whole .rrd file hold."""

APPLICATION = "trainlog"
"""Rerun's application id: a layout made for it fits every replay."""


MOST_WHOLE = 16
"""Of more trips a replay is an overview, with their samples thinned, unless asked for otherwise."""


@dataclass(frozen=True)
class ReplayOptions:
    """How trips are shown.

    Attributes
    ----------
    view : str or None
        Which view is shown first: overview, driving, traction, identification, map or recorder.
    reference : int or None
        Number of the trip with which the others are compared by position. Default: the trajectory
        if there is one, else the first trip of each line and direction.
    thinned : bool or None
        Only the overview, with the lowest and the highest speed of each 0.4 s. Default: of more
        than 16 trips.
    tiles : bool
        Places over the tiles of a map that the viewer asks a server for, instead of on a plan.
    line : Line or None
        The line, in its own direction, of trips that carry none.

    Examples
    --------
    >>> import trainlog
    >>> logs = ["sample_logs/nonstop.mcap", "sample_logs/stopping.mcap"]
    >>> options = trainlog.ReplayOptions(view="driving", reference=1)
    >>> trainlog.write_replay([trainlog.read(log) for log in logs], "two.rrd", options=options)
    Replay(trips=('trip-01', 'trip-03'), references=('trip-03',), thinned=False)
    """

    view: str | None = None
    reference: int | None = None
    thinned: bool | None = None
    tiles: bool = False
    line: Line | None = None


@dataclass(frozen=True)
class Replay:
    """What a replay shows.

    Attributes
    ----------
    trips : tuple of str
        Names of the trips, each once.
    references : tuple of str
        With what trips are compared, each line and direction apart; empty if with nothing.
    thinned : bool
        Whether samples were left out.
    """

    trips: tuple[str, ...]
    references: tuple[str, ...]
    thinned: bool


def write_replay(
    trips: Sequence[Trip | Pieces],
    path: str | Path,
    *,
    trajectory: Trajectory | None = None,
    condition_map: TrackConditionMap | None = None,
    options: ReplayOptions | None = None,
) -> Replay:
    """Write trips, and what is known of their line, as one Rerun recording with its layout.

    The same trips give the same content; Rerun's own row numbers differ from file to file.

    Parameters
    ----------
    trips : sequence of Trip or of functions
        At least one. Topics that are missing or empty are left out. A trip that is longer than
        the memory is a function that gives its pieces in the order of time, as `stream_log` does;
        it is called twice. If it takes ``topics``, as `stream_log` does, less is read of a trip
        that is thinned.
    path : path
        Ends in ``.rrd``; written whole or not at all.
    trajectory : Trajectory, optional
        What it plans is drawn where each trip is.
    condition_map : TrackConditionMap, optional
        Drawn along the line, and under each trip.
    options : ReplayOptions, optional

    Returns
    -------
    Replay
        What is shown, and compared with what.

    Raises
    ------
    InputError
        If there is no trip, the path ends otherwise or cannot be written, trajectory or map are of
        another line, or there is no such view or reference.
    LogError
        If a trip holds no samples, or its pieces cannot be read.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/nonstop.mcap")
    >>> trainlog.write_replay([trip], "nonstop.rrd")
    Replay(trips=('trip-01',), references=(), thinned=False)
    """
    asked = options or ReplayOptions()
    if Path(path).suffix != ".rrd":
        raise InputError("is not the name of a Rerun recording", file=path, remedy="end it in .rrd")
    if not trips:
        raise InputError("there is no trip to replay", file=path, remedy="name at least one log")
    if asked.view is not None:
        check_view(asked.view)
    # Whatever can be refused is refused before anything is drawn.
    sources = [pieces_of(trip) for trip in trips]
    if asked.line is not None:
        sources = [with_line(source, asked.line) for source in sources]
    thinned = len(trips) > MOST_WHOLE if asked.thinned is None else asked.thinned
    if thinned:
        read = list(track(thinned_trips(sources), "reading", "trip", total=len(sources)))
        surveys = [known for known, _ in read]
        sources = [pieces_of(trip) for _, trip in read]
    else:
        surveys = [survey(source) for source in track(sources, "reading", "trip")]
    lines = _lines(surveys, trajectory, condition_map)
    names = _distinct([each.bare.name for each in surveys])
    compared = references(surveys, names, trajectory, asked.reference)
    recording = rr.RecordingStream(
        APPLICATION,
        recording_id=content_id(surveys, trajectory, condition_map),
        send_properties=False,
    )
    chart = chart_of([each.line for each in surveys], [e.fixes for e in surveys], tiles=asked.tiles)
    with atomic_write(path) as temporary, _saved(recording, temporary, path):
        recording.send_recording_name(few(names, 1))
        recording.send_recording_start_time_nanos(surveys[0].clock.start)
        for first in lines:
            draw_line_of(recording, surveys[first], condition_map, chart)
        shown = []
        each = list(zip(sources, surveys, names, strict=True))
        groups = list(map(group_of, surveys))
        for i, (source, known, name) in enumerate(track(each, "drawing", "trip")):
            colour = TRIPS[i % len(TRIPS)]
            brief = thinned and groups.index(groups[i]) < i
            drawing = Drawing(recording, known, name, colour, chart=chart, brief=brief)
            for piece, state in neighboured(source()):
                drawing.add(piece, state)
                # What is not yet written piles up in Rerun's memory.
                recording.flush()
            reference = compared.get(group_of(known))
            if reference is not None and reference.trip != i:
                drawing.compare(reference)
            shown.append(drawing.finish(trajectory, condition_map))
        if trajectory is not None and len(trips) > 1:
            draw_trajectory(recording, trajectory, surveys[0].clock.start)
        planned = None if trajectory is None else trajectory.direction
        contents = Contents(planned, observed(condition_map), chart, top_of(condition_map))
        recording.send_blueprint(blueprint(shown, contents, asked.view))
    stated = tuple(each.name for each in compared.values())
    return Replay(tuple(names), stated, thinned)


def with_line(source: Pieces, line: Line) -> Pieces:
    """A trip with this line if it carries none.

    The pieces raise an InputError where the trip was not on the line.
    """
    attached = line_to_bytes(line)

    def pieces(**asked: Any) -> Iterator[Trip]:
        for piece in source(**asked):
            if LINE_ATTACHMENT in piece.attachments:
                yield piece
                continue
            check_on_line(piece, line)
            yield replace(piece, attachments={**piece.attachments, LINE_ATTACHMENT: attached})

    return pieces


FURTHEST = 250.0
"""Median distance of fixes to where the chainage puts them, up to which a trip is on a line [m]."""


def check_on_line(piece: Trip, line: Line) -> None:
    """Refuse a line on which a trip was not, as far as its chainage and fixes can show it.

    Raises
    ------
    InputError
    """
    remedy = "ingest its recording with --line, which finds its chainage"
    known = {source: known_rows(piece, *source) for source in POSITION_SOURCES[:2]}
    found = next((rows for rows in known.values() if rows is not None), None)
    if found is None:
        if any(len(frame) for frame in piece.topics.values()):
            raise InputError(
                f"trip '{piece.name}' has no chainage that could be along '{line.name}'",
                remedy=remedy,
            )
        return
    time, position = found
    if position.max() > line.length + FURTHEST:
        raise InputError(
            f"trip '{piece.name}' reaches {position.max() / 1e3:.3f} km, beyond the end of"
            f" '{line.name}' at {line.length / 1e3:.3f} km",
            remedy=remedy,
        )
    fixes = known_rows(piece, *POSITION_SOURCES[3])
    own = line.travelled(piece.metadata.get("direction"))
    if fixes is None or own.geometry is None:
        return
    latitude, longitude = own.geometry.at(np.interp(fixes[0], time, position))
    north = np.radians(fixes[1] - latitude)
    east = np.radians(fixes[2] - longitude) * np.cos(np.radians(latitude))
    away = EARTH_RADIUS * float(np.median(np.hypot(north, east)))
    if away > FURTHEST:
        raise InputError(
            f"trip '{piece.name}' was {away / 1e3:.1f} km away from where its chainage puts it on"
            f" '{line.name}'",
            remedy=remedy,
        )


@contextmanager
def _saved(recording: rr.RecordingStream, temporary: Path, path: str | Path) -> Iterator[None]:
    """Write a recording to `temporary`, whole; `path` is what errors call it.

    Rerun writes in a thread of its own and does not say what kept it from it.
    """
    recording.save(temporary)
    failure = None
    try:
        yield
        recording.flush()
    except RuntimeError as error:
        failure = error
    finally:
        # The index at the file's end is written when the recording lets go of it.
        recording.disconnect()
    with temporary.open("rb") as written:
        written.seek(max(0, written.seek(0, os.SEEK_END) - _ENDING))
        whole = _FOOTER in written.read()
    if not whole:
        raise InputError(
            "cannot be written to its end: is the disk full?",
            file=path,
            remedy="free some space on the disk, or choose another place, and try again",
        ) from failure
    if failure is not None:
        raise failure


def content_id(
    surveys: Iterable[Survey], trajectory: Trajectory | None, condition: TrackConditionMap | None
) -> str:
    """The recording's id: a digest of all that is drawn, so that the viewer mixes no two."""
    digest = hashlib.sha256()
    given = list(surveys)
    for each in given:
        digest.update(each.digest)
    if trajectory is not None:
        digest.update(trajectory.speeds.tobytes() + trajectory.positions.tobytes())
    for name, layer in sorted(condition.layers.items()) if condition is not None else ():
        digest.update(name.encode() + layer.log_mean.tobytes() + layer.observed.tobytes())
        digest.update(repr(layer.spots).encode())
        for each in given:
            expected = layer.expected(pd.Timestamp(each.clock.start, tz="UTC"))
            digest.update(expected.log_mean.tobytes() + expected.log_std.tobytes())
    return digest.hexdigest()[:32]


def _distinct(names: Sequence[str]) -> list[str]:
    """Names with a number behind each that came before."""
    seen: dict[str, int] = {}
    distinct = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        distinct.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return distinct


def _lines(
    surveys: Sequence[Survey], trajectory: Trajectory | None, condition: TrackConditionMap | None
) -> list[int]:
    """Which is the first trip on each line; refuses trajectory or map of another line."""
    found: dict[str, int] = {}
    for number, each in enumerate(surveys):
        if each.line is None:
            continue
        if trajectory is not None and trajectory.line != each.line.name:
            raise InputError(
                f"the trajectory was made for line '{trajectory.line}', trip '{each.bare.name}'"
                f" ran on '{each.line.name}'",
                remedy="give that line's trajectory, or leave the trip out",
            )
        if condition is not None:
            where = f"trip '{each.bare.name}'"
            condition.check_line(each.line.name, each.line.length, what=where)
        found.setdefault(each.line.name, number)
    return list(found.values())


# ------------------------------------------------------------------------ while a trip is recorded

WAITING = 20
"""Flushes of the recorder that may wait to be drawn."""

REFRESH = 1.0
"""How often what depends on the trip so far is drawn anew [s]."""

PATIENCE = 5.0
"""How long the viewer may take for what it was sent before it is called slow [s]."""

STATES = 1000
"""Samples of the train's state that are kept for what is compared with them."""

CLOSING = 10.0
"""How long drawing may go on when the recording ends [s]."""


@contextmanager
def live_replay(
    recording: Recording, to: Literal["window", "web"] | str | Path | None = None
) -> Iterator[LiveReplay]:
    """Draw a trip in the Rerun viewer as it is recorded, in the layout of a replay.

    The viewer listens on this machine alone, sends no usage data and asks for nothing on the
    network. What it cannot draw in time, or after it was closed, is counted; the log has it all.

    Parameters
    ----------
    recording : Recording
        Made by `trainlog.record`; its flush period is the delay with which samples are drawn.
    to : {"window", "web"} or path, optional
        A window, a page in the browser, or an ``.rrd`` file. Default: a window where there is a
        display, else a page.

    Yields
    ------
    LiveReplay
        States where the viewer is, and what was not drawn.

    Raises
    ------
    InputError
        If a window is asked for where there is no display, or the viewer does not start.

    Examples
    --------
    >>> import trainlog
    >>> start = 1_700_000_000 * 10**9
    >>> with (
    ...     trainlog.record("drawn.mcap", flush=0.1) as recording,
    ...     trainlog.live_replay(recording, "drawn.rrd") as drawing,
    ... ):
    ...     for second in range(5):
    ...         recording.write("/train/state", start + second * 10**9, speed=second)
    >>> drawing.drawn, drawing.dropped
    (5, 0)
    """
    drawing = LiveReplay(recording.path)
    with ExitStack() as stack:
        stack.enter_context(drawing.shown(to))
        recording.observe(drawing.take)
        yield drawing
        recording.flush()


class LiveReplay:
    """A trip being drawn while it is recorded; made by `live_replay`.

    Attributes
    ----------
    where : str
        Where it is shown, for the user.
    drawn, dropped : int
        Samples that were drawn, and that were not.
    problem : str
        Why nothing more is drawn; empty while it is.
    """

    def __init__(self, log: Path) -> None:
        self.where, self.problem = "", ""
        self.drawn = self.dropped = 0
        self._log = log
        self._waiting: queue.Queue[Trip | None] = queue.Queue(WAITING)
        self._stream: Any = None
        self._viewer: subprocess.Popen[bytes] | None = None
        self._trip: _GrowingTrip | None = None

    def take(self, piece: Trip) -> None:
        """Have samples drawn, unless too many wait already."""
        if self.problem:
            self._drop(piece)
            return
        try:
            self._waiting.put_nowait(piece)
        except queue.Full:
            self._drop(piece)

    def sentences(self) -> list[str]:
        """What was not drawn, and why."""
        found = [f"drawing ended: {self.problem}"] if self.problem else []
        if self.dropped:
            found.append(f"{self.dropped:,} samples were not drawn; the log holds them")
        return found

    @contextmanager
    def shown(self, to: Literal["window", "web"] | str | Path | None) -> Iterator[None]:
        """Start the viewer and draw until the block ends."""
        chosen = to or ("window" if has_display() else "web")
        self._stream = rr.RecordingStream(APPLICATION, send_properties=False)
        self._stream.send_recording_name(self._log.stem)
        with ExitStack() as stack:
            if chosen == "window":
                stack.enter_context(self._window())
            elif chosen == "web":
                stack.enter_context(self._page())
            else:
                self._stream.save(Path(chosen))
                self.where = f"drawn into {chosen}"
            thread = threading.Thread(target=self._run, name="trainlog.live_replay", daemon=True)
            thread.start()
            try:
                yield
            finally:
                with suppress(queue.Full):
                    self._waiting.put(None, timeout=CLOSING)
                thread.join(CLOSING)
                if thread.is_alive():
                    self.problem = self.problem or "the viewer is too slow"
                while not self._waiting.empty():
                    rest = self._waiting.get_nowait()
                    if rest is not None:
                        self._drop(rest)
                self._stream.disconnect()

    @contextmanager
    def _window(self) -> Iterator[None]:
        if not has_display():
            raise InputError(
                "there is no display here to open a window on", remedy="draw to the browser"
            )
        port = free_port()
        self._viewer = start_viewer("--hide-welcome-screen", "--port", str(port))
        self._stream.connect_grpc(f"rerun+http://{HOST}:{port}/proxy")
        self.where = "the Rerun viewer shows the trip as it is recorded; it stays open"
        try:
            yield
        except BaseException:
            end_viewer(self._viewer)
            raise

    @contextmanager
    def _page(self) -> Iterator[None]:
        with web_viewer(None) as (address, process):
            self._viewer = process
            query = urllib.parse.parse_qs(urllib.parse.urlsplit(address).query)
            self._stream.connect_grpc(query["url"][0])
            self.where = f"{address} shows the trip as it is recorded"
            if has_display():
                webbrowser.open(address)
            yield

    def _run(self) -> None:
        """Draw what comes, and now and then what depends on the trip so far."""
        refreshed = time.monotonic()
        while True:
            try:
                piece = self._waiting.get(timeout=REFRESH)
            except queue.Empty:
                continue
            try:
                if piece is not None:
                    self._draw(piece)
                late = time.monotonic() - refreshed > REFRESH
                if self._trip is not None and (piece is None or late or self._trip.new):
                    self._trip.refresh()
                    refreshed = time.monotonic()
                self._stream.flush(timeout_sec=PATIENCE)
            except Exception as error:  # noqa: BLE001 - drawing must not end the recording
                self._fail(str(error).splitlines()[0] if str(error) else repr(error))
            if piece is None or self.problem:
                return
            if self._viewer is not None and self._viewer.poll() is not None:
                self._fail("the viewer was closed")
                return

    def _draw(self, piece: Trip) -> None:
        if self._trip is None:
            self._trip = _GrowingTrip(self._stream, piece, self._log.stem)
        self._trip.add(piece)
        self.drawn += sum(map(len, piece.topics.values()))

    def _fail(self, problem: str) -> None:
        self.problem = problem
        warnings.warn(f"{self._log.name} is recorded, but no longer drawn: {problem}", stacklevel=1)

    def _drop(self, piece: Trip) -> None:
        self.dropped += sum(map(len, piece.topics.values()))


class GrowingClock(Clock):
    """The clock of a trip that is still recorded."""

    def __init__(self, start: int) -> None:
        super().__init__(start, np.empty(0, np.int64), np.empty(0))
        object.__setattr__(self, "_source", None)
        object.__setattr__(self, "_last", None)

    def grow(self, piece: Trip) -> None:
        """Go on with the positions of a piece, or with the distance that it gives."""
        source: tuple[str, ...] | None = getattr(self, "_source", None)
        for candidate in POSITION_SOURCES if source is None else (source,):
            rows = known_rows(piece, *candidate)
            if rows is not None:
                object.__setattr__(self, "_source", candidate)
                self._append(candidate, rows)
                return

    def _append(self, source: tuple[str, ...], rows: tuple[Any, ...]) -> None:
        last = getattr(self, "_last", None)
        object.__setattr__(self, "_last", tuple(column[-1:] for column in rows))
        behind = float(self.position[-1]) if self.position.size else 0.0
        recorded = source[1:] == ("position",)
        if last is not None and not recorded:
            rows = tuple(np.concatenate(each) for each in zip(last, rows, strict=True))
        curve = time_distance(self.start, {source: rows})
        position = np.maximum(curve.position, behind) if recorded else curve.position + behind
        grown = np.concatenate((self.time, curve.time)), np.concatenate((self.position, position))
        order = np.argsort(grown[0], kind="stable")
        object.__setattr__(self, "time", grown[0][order])
        object.__setattr__(self, "position", np.maximum.accumulate(grown[1][order]))

    def since(self, time: int) -> Clock:
        """What came after an instant [ns]."""
        first = max(int(np.searchsorted(self.time, time, side="left")) - 1, 0)
        return Clock(self.start, self.time[first:], self.position[first:])


class _GrowingTrip:
    """A trip that is drawn piece by piece, of which the end is not known.

    Attributes
    ----------
    new : bool
        Whether there is something to show that the layout does not know yet.
    """

    def __init__(self, stream: Any, first: Trip, name: str) -> None:
        self._stream, self._name = stream, first.metadata.get("trip", name)
        self._clock = GrowingClock(int(first.start.as_unit("ns").value))
        line = line_of(first) if LINE_ATTACHMENT in first.attachments else None
        self._known = Survey(_bare(first), line, self._clock, {}, np.zeros(3), None, b"")
        self._chart = chart_of([line], [])
        self._drawing = self._drawn()
        self._state: pd.DataFrame | None = None
        self._fixes: list[tuple[Any, Any]] = []
        self._refreshed = self._clock.start
        self._laid_out: Any = None
        self.new = True
        stream.send_recording_start_time_nanos(self._clock.start)
        draw_line_of(stream, self._known, None, self._chart)

    def _drawn(self) -> Drawing:
        return Drawing(self._stream, self._known, self._name, TRIPS[0], chart=self._chart)

    def add(self, piece: Trip) -> None:
        """Draw the next samples."""
        added = {name: frame for name, frame in piece.topics.items() if len(frame)}
        held = self._known.bare.topics
        if not set(added) <= set(held):
            topics = {**held, **_bare(piece).topics}
            self._known = replace(self._known, bare=replace(self._known.bare, topics=topics))
            self._drawing = self._drawn()
            self.new = True
        self._clock.grow(piece)
        if TRAIN_CONTROLS.name in added:
            pulls = largest_pulls(added[TRAIN_CONTROLS.name])
            np.maximum(self._known.pulls, pulls, out=self._known.pulls)
        if GNSS_FIX.name in added:
            frame = added[GNSS_FIX.name]
            fixes = frame[["latitude", "longitude"]].to_numpy(dtype=np.float64)
            known = np.isfinite(fixes).all(axis=1)
            chosen = np.flatnonzero(known)[each_second(nanoseconds(frame)[known])]
            if chosen.size and not self._fixes:
                self._chart = chart_of(
                    [self._known.line], [(nanoseconds(frame)[chosen], fixes[chosen])]
                )
                self._drawing, self.new = self._drawn(), True
            if chosen.size:
                self._fixes.append((nanoseconds(frame)[chosen], fixes[chosen]))
        state = added.get(TRAIN_STATE.name)
        both = [part for part in (self._state, state) if part is not None]
        joined = pd.concat(both) if len(both) > 1 else both[0] if both else None
        if joined is not None:
            # A flush may come between the state of some instants and the wheels' speeds of them.
            self._state = joined.iloc[-STATES:]
        self._drawing.add(replace(piece, topics=added), joined)

    def refresh(self) -> None:
        """Draw what depends on the trip so far; lay out anew where there is more to show."""
        fixes = None
        if self._fixes:
            times, places = zip(*self._fixes, strict=True)
            fixes = np.concatenate(times), np.concatenate(places)
        recent = replace(self._known, clock=self._clock.since(self._refreshed), fixes=fixes)
        shown = self._drawing.so_far(recent)
        if self._clock.time.size:
            self._refreshed = int(self._clock.time[-1])
        layout = (shown.entities, tuple(panel.entity for panel in shown.panels))
        if layout != self._laid_out:
            self._laid_out = layout
            contents = Contents(chart=self._chart, live=True)
            self._stream.send_blueprint(blueprint([shown], contents))
        self.new = False


def _bare(piece: Trip) -> Trip:
    topics = {name: frame.iloc[:0] for name, frame in piece.topics.items() if len(frame)}
    return replace(piece, topics=topics)
