"""Pictures of a recording, taken by a Rerun viewer without a window."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from PIL import Image
from rerun.experimental import ViewerClient

from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.replay.viewer import (
    HOST,
    STARTING,
    end_viewer,
    free_port,
    offline,
    start_viewer,
)
from trainlog.units import NANOSECONDS

SETTLING = 8.0
"""How long it takes to draw everything and to let its greetings fade [s]."""

MENU = 36
"""Height of the viewer's own menu, which is not part of a picture [points]."""

REDRAWING = 1.5
"""How long it takes to draw another view or instant [s]."""


def take_picture(
    recording: str | Path,
    image: str | Path,
    *,
    size: tuple[int, int] = (1600, 1000),
    view: str | None = None,
    timeline: str | None = None,
    at: int | None = None,
    layout: str | Path | None = None,
    settle: float = SETTLING,
) -> list[str]:
    """Show a recording in a viewer without a window and save what it shows.

    Parameters
    ----------
    recording : path
        A recording, or a log for Rerun to read itself.
    image : path
        PNG, written whole or not at all.
    size : (int, int)
        Width and height in pixels.
    view : str, optional
        One of the replay's named views, instead of the one that it opens with.
    timeline : str, optional
        To show instead of the layout's own.
    at : int, optional
        Where on that timeline: nanoseconds or, on the position timeline, metres. Default: its
        middle.
    layout : path, optional
        Instead of the recording's own, see `trainlog.replay.layout`.
    settle : float [s]
        From when the recording is loaded to when its picture is taken.

    Returns
    -------
    list of str
        Names of the panels of all views.

    Raises
    ------
    InputError
        If there is no such recording, it cannot be shown, has no such view or timeline, or the
        picture cannot be written.

    Examples
    --------
    >>> import trainlog
    >>> panels = trainlog.take_picture("nonstop.rrd", "nonstop.png")  # doctest: +SKIP
    """
    with headless_viewer(recording, size=size, layout=layout, settle=settle) as viewer:
        if view is not None:
            viewer.show(view)
        viewer.set_time(timeline, at)
        viewer.picture(image)
        return viewer.panels()


class HeadlessViewer:
    """A viewer without a window that shows a recording; see `headless_viewer`.

    Parameters
    ----------
    client : rerun.experimental.ViewerClient
    settle : float [s]
        How long the viewer has to draw, first; `REDRAWING` after each change.
    """

    def __init__(self, client: ViewerClient, settle: float) -> None:
        self.client = client
        self._ready = time.monotonic() + settle

    def views(self) -> list[str]:
        """Names of the replay's views, as they are chosen by."""
        tabs = _tabs(self.client.get_blueprint("recording").blueprint)
        return [] if tabs is None else list(tabs[1])

    def show(self, view: str) -> None:
        """Show a named view.

        Raises
        ------
        InputError
            If the recording has none of that name.
        """
        blueprint = self.client.get_blueprint("recording").blueprint
        tabs = _tabs(blueprint)
        known = {} if tabs is None else tabs[1]
        if tabs is None or view not in known:
            raise InputError(
                f"the recording has no view '{view}'", remedy=f"it has: {', '.join(known) or 'one'}"
            )
        blueprint[tabs[0]]["ContainerBlueprint"]["active_tab"] = known[view]
        self.client.set_blueprint(blueprint, "recording")
        self._wait()

    def set_time(self, timeline: str | None = None, at: int | None = None) -> None:
        """Put the cursor at an instant [ns], or a position [m], of a timeline.

        Without one in its middle, of the timeline that is shown if none is named.

        Raises
        ------
        InputError
            If the recording has no such timeline.
        """
        state = self.client.get_state()
        known = {each.name: each for one in state.recordings for each in one.timelines}
        if timeline is None:
            timeline = next(one.current_timeline for one in state.recordings if one.timelines)
        if timeline not in known:
            raise InputError(
                f"the recording has no timeline '{timeline}'", remedy=f"it has: {', '.join(known)}"
            )
        kind = known[timeline].time_type
        place = (known[timeline].start + known[timeline].end) // 2 if at is None else at
        shown: Any = place if kind == "sequence" else place / NANOSECONDS
        self.client.set_time(timeline, play_state="paused", **{kind: shown})
        self._wait()

    def picture(self, image: str | Path) -> None:
        """Save what the viewer shows, below its menu, as PNG, whole or not at all."""
        time.sleep(max(0.0, self._ready - time.monotonic()))
        with atomic_write(image) as temporary:
            self.client.save_screenshot(str(temporary.resolve()))
            with Image.open(temporary) as window:
                shown = window.crop((0, MENU, *window.size)).convert("RGB")
            shown.save(temporary)

    def panels(self) -> list[str]:
        """Names of the panels of all views."""
        return sorted(view.name for view in self.client.get_state().views)

    def _wait(self) -> None:
        self._ready = max(self._ready, time.monotonic() + REDRAWING)


def _tabs(blueprint: dict[str, Any]) -> tuple[str, dict[str, str]] | None:
    """The root of the layout and its tabs by their names in small letters; None if it has none."""
    root = "/container/" + blueprint["/viewport"]["ViewportBlueprint"]["root_container"]
    known = blueprint.get(root, {}).get("ContainerBlueprint", {})
    if known.get("container_kind") != "Tabs":
        return None
    names = {}
    contents = known["contents"]
    # Rerun writes a list of one as what is in it.
    for tab in [contents] if isinstance(contents, str) else contents:
        about = blueprint.get(f"/{tab}", {}).get("ContainerBlueprint", {})
        names[str(about.get("display_name", tab)).lower()] = tab
    return root, names


@contextmanager
def headless_viewer(
    recording: str | Path,
    *,
    size: tuple[int, int] = (1600, 1000),
    layout: str | Path | None = None,
    settle: float = SETTLING,
) -> Iterator[HeadlessViewer]:
    """A viewer without a window that has loaded a recording; it ends with the block.

    One viewer takes the pictures of several views and instants.

    Parameters
    ----------
    recording, size, layout, settle
        As for `take_picture`.

    Raises
    ------
    InputError
        If there is no such recording, or it cannot be shown.

    Examples
    --------
    >>> from trainlog.replay import headless_viewer
    >>> with headless_viewer("nonstop.rrd") as viewer:  # doctest: +SKIP
    ...     for view in viewer.views():
    ...         viewer.show(view)
    ...         viewer.picture(f"{view}.png")
    """
    if not Path(recording).is_file():
        raise InputError("does not exist", file=recording, remedy="write it with write_replay")
    with _headless(Path(recording).resolve(), size, layout) as client:
        yield HeadlessViewer(client, settle)


@contextmanager
def _headless(
    recording: Path, size: tuple[int, int], layout: str | Path | None
) -> Iterator[ViewerClient]:
    """A client of a viewer that has loaded the recording; the viewer ends with the block."""
    port = free_port()
    files, fed = [str(recording)], Path(os.devnull)
    if layout is not None and recording.suffix == ".mcap":
        # A layout that is named beside a log is not applied to it; one that is fed in is.
        files, fed = [str(recording), "-"], Path(layout)
    elif layout is not None:
        files.append(str(layout))
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        log = Path(folder) / "log"
        window = f"{size[0]}x{size[1] + MENU}"
        with log.open("wb") as output, fed.open("rb") as source:
            process = start_viewer(
                *("--headless", "--hide-welcome-screen", "--window-size", window),
                *("--port", str(port), *files),
                environment=offline({"XDG_RUNTIME_DIR": folder, **os.environ}),
                stdin=source,
                output=output,
            )
            try:
                yield _connected(process, port, recording, log)
            finally:
                end_viewer(process)


def _connected(process: subprocess.Popen[bytes], port: int, recording: Path, log: Path) -> Any:
    deadline = time.monotonic() + STARTING
    while time.monotonic() < deadline and process.poll() is None:
        try:
            viewer = ViewerClient(f"rerun+http://{HOST}:{port}/proxy")
            state = viewer.get_state()
        except (RuntimeError, ConnectionError, OSError, ValueError):
            time.sleep(0.25)
            continue
        loaded = any(each.timelines for each in state.recordings)
        if loaded and state.views and not state.loading:
            return viewer
        time.sleep(0.25)
    raise InputError(
        f"the Rerun viewer does not show it{_last_words(log)}",
        file=recording,
        remedy="it needs a Vulkan driver, in software too (Debian: mesa-vulkan-drivers)",
    )


def _last_words(log: Path) -> str:
    """Why the viewer gave up, if it said so."""
    lines = log.read_text("utf-8", "replace").splitlines()
    reasons = [line.strip() for line in lines if "graphics adapter" in line or "panicked" in line]
    return f": {reasons[-1]}" if reasons else ""
