"""A trip in the Rerun viewer while it is recorded.

A thread of its own draws what the recorder has written. Where the viewer is slower than the
recording, or closed, samples are not drawn, and counted: the recording never waits.
"""

from __future__ import annotations

import queue
import subprocess
import threading
import time
import urllib.parse
import warnings
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import rerun as rr

from trainlog.errors import InputError
from trainlog.formats.railway import line_of
from trainlog.mcap.recorder import Recording
from trainlog.replay.drawing import Drawing, chart_of, draw_line_of, each_second
from trainlog.replay.layout import Contents, blueprint
from trainlog.replay.recording import APPLICATION
from trainlog.replay.samples import TRIPS, Clock, largest_pulls
from trainlog.replay.survey import Survey
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
