"""The Rerun viewer: opened for a person in a window or in the browser, on this machine alone.

Without a window it takes pictures of a recording.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.parse
import urllib.request
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import rerun as rr
from PIL import Image
from rerun.experimental import ViewerClient

from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.processes import handled
from trainlog.units import NANOSECONDS

HOST = "127.0.0.1"
"""Rerun would else listen on every network."""

NOWHERE = f"http://{HOST}:9"
"""The discard port of this machine, at which nothing listens."""

STARTING = 60.0
"""How long a viewer may take until it shows a recording [s]."""

ENDING = 10.0
"""How long a viewer may take until it has ended, after which it is killed [s]."""


def open_viewer(path: str | Path) -> str:
    """Open a recording in the Rerun viewer if there is a display, and state what was done.

    The viewer goes on when this process ends, sends no usage data, asks for nothing on the network,
    and listens on this machine alone.

    Returns
    -------
    str
        For the user: that the viewer opens, or how to open the recording elsewhere.

    Raises
    ------
    InputError
        If there is no such file.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/nonstop.mcap")
    >>> _ = trainlog.write_replay([trip], "nonstop.rrd")
    >>> print(trainlog.open_viewer("nonstop.rrd"))  # doctest: +SKIP
    The Rerun viewer opens with /home/me/nonstop.rrd
    """
    recording = _existing(path)
    if not has_display():
        return (
            f"No display here; the replay is {recording}. Where there is one:"
            f" pip install rerun-sdk=={rr.__version__}, then: rerun {recording.name}"
        )
    subprocess.run(
        viewer_command("--detach-process", "--port", "auto", str(recording)),
        env=offline(os.environ),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    return f"The Rerun viewer opens with {recording}"


def run_viewer(
    path: str | Path,
    *,
    web: bool = False,
    tiles: bool = False,
    state: Callable[[str], None] = print,
) -> None:
    """Show a recording in the Rerun viewer until it is closed or Ctrl-C ends it.

    As `open_viewer`, but the viewer ends with the call, with all processes that belong to it.

    Parameters
    ----------
    path : path
    web : bool
        In the browser instead of a window; it needs a display only to open the page by itself.
    tiles : bool
        Let the viewer ask for the tiles of a map, see `ReplayOptions`, and so for newer releases.
    state : callable
        Takes a line for the user: where the page is, and how to end.

    Raises
    ------
    InputError
        If there is no such file, or no display for a window.

    Examples
    --------
    >>> import trainlog
    >>> trainlog.run_viewer("nonstop.rrd", web=True)  # doctest: +SKIP
    http://127.0.0.1:43519/ shows nonstop.rrd; Ctrl-C ends it
    """
    recording = _existing(path)
    if not web:
        check_display()
    with interruptible(), suppress(KeyboardInterrupt):
        if web:
            with web_viewer(recording, tiles=tiles) as (address, process):
                state(f"{address} shows {recording.name}; Ctrl-C ends it")
                if has_display():
                    webbrowser.open(address)
                process.wait()
        else:
            with _running("--port", "auto", str(recording), tiles=tiles) as process:
                state(f"the Rerun viewer shows {recording.name}; close it, or press Ctrl-C here")
                process.wait()
        if process.returncode:
            raise InputError(
                f"the Rerun viewer ended with status {process.returncode}",
                file=recording,
                remedy="show it in a browser with --web, or save it with -o replay.rrd",
            )


def check_display() -> None:
    """Refuse to open a window where there is no display.

    Raises
    ------
    InputError
    """
    if not has_display():
        raise InputError(
            "there is no display here to open a window on",
            remedy="show it in a browser with --web, take a picture with -o out.png, or save it"
            " with -o replay.rrd",
        )


def has_display(environment: Mapping[str, str] | None = None, platform: str = sys.platform) -> bool:
    """Whether a window can be opened on a display.

    On Windows and macOS always, unless this is a remote shell or a continuous integration run;
    elsewhere where X11 or Wayland say so.
    """
    variables = os.environ if environment is None else environment
    if variables.get("CI"):
        return False
    if platform in ("win32", "cygwin", "darwin"):
        return not variables.get("SSH_CONNECTION")
    return bool(variables.get("DISPLAY") or variables.get("WAYLAND_DISPLAY"))


def offline(environment: Mapping[str, str], *, tiles: bool = False) -> dict[str, str]:
    """The environment for a viewer that asks for nothing on the network, whatever its settings.

    Rerun sends no usage data from continuous integration, which it knows by ``CI``. Whether a newer
    version is released it asks all the same, through the proxy that is named: here none. So it asks
    for the tiles of a map; with `tiles` the proxy stays as it is.
    """
    if tiles:
        return {**environment, "CI": "true"}
    proxies = dict.fromkeys(("http_proxy", "https_proxy", "all_proxy"), NOWHERE)
    direct = {"no_proxy": f"{HOST},localhost"}
    named = {**proxies, **direct}
    named |= {name.upper(): value for name, value in named.items()}
    return {**environment, **named, "CI": "true"}


def start_viewer(
    *arguments: str,
    environment: Mapping[str, str] | None = None,
    stdin: Any = subprocess.DEVNULL,
    output: Any = subprocess.DEVNULL,
) -> subprocess.Popen[bytes]:
    """Start a viewer in a process group of its own, which asks for nothing on the network."""
    return subprocess.Popen(
        viewer_command(*arguments),
        env=environment or offline(os.environ),
        stdin=stdin,
        stdout=output,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


def viewer_command(*arguments: str) -> list[str]:
    """The command that starts the viewer of the installed Rerun, on this machine alone."""
    return [sys.executable, "-m", "rerun_cli", "--bind", HOST, *arguments]


def end_viewer(process: subprocess.Popen[bytes]) -> None:
    """End a viewer with the wrapper that started it."""
    if sys.platform == "win32":
        command = ["taskkill", "/PID", str(process.pid), "/T", "/F"]
        subprocess.run(command, capture_output=True, check=False)
        process.wait(ENDING)
        return
    # The wrapper may have ended before the viewer: the group is asked, not the process.
    with suppress(ProcessLookupError, PermissionError):
        for number in (signal.SIGTERM, signal.SIGKILL):
            os.killpg(process.pid, number)
            deadline = time.monotonic() + ENDING
            while time.monotonic() < deadline:
                process.poll()
                os.killpg(process.pid, 0)
                time.sleep(0.02)
    process.wait(ENDING)


def free_port() -> int:
    """A port of this machine at which nothing listens."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def _existing(path: str | Path) -> Path:
    recording = Path(path).resolve()
    if not recording.is_file():
        raise InputError("does not exist", file=path, remedy="write it with write_replay")
    return recording


@contextmanager
def _running(*arguments: str, tiles: bool = False) -> Iterator[subprocess.Popen[bytes]]:
    """A viewer that ends with the block."""
    process = start_viewer(*arguments, environment=offline(os.environ, tiles=tiles))
    try:
        yield process
    finally:
        end_viewer(process)


@contextmanager
def interruptible() -> Iterator[None]:
    """A request to end this process (SIGTERM, SIGHUP) ends it as Ctrl-C does: nothing is left."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    # A shell that starts a command in the background has it ignore Ctrl-C; a viewer is ended so.
    names = ("SIGINT", "SIGTERM", "SIGHUP")
    with handled(interrupt, *(getattr(signal, name) for name in names if hasattr(signal, name))):
        yield


# ----------------------------------------------------------------------------------- in a browser

PAGE = ("/", "/index.html", "/re_viewer.js", "/re_viewer_bg.wasm", "/favicon.ico")
"""What the viewer's page consists of."""

POLICY = (
    "default-src 'self' blob: data:; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:;"
    " style-src 'self' 'unsafe-inline'; connect-src 'self' blob: data: {data}"
)
"""Content security policy of the page: the browser asks nobody but this machine.

Rerun's page would else fetch fonts, release notes and examples, and send usage data.
"""


TILES = "https://tile.openstreetmap.org"
"""Where Rerun's map has its tiles from."""


@contextmanager
def web_viewer(
    recording: Path | None, *, tiles: bool = False
) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Serve a recording to a browser on this machine; its address, and the process behind it.

    Without a recording what is sent to the address that the query of the page names is shown. With
    `tiles` the page may fetch those of a map, too.
    """
    web, data = free_port(), free_port()
    source, stream = f"http://{HOST}:{web}", f"http://{HOST}:{data}"
    arguments = ("--serve-web", "--web-viewer-port", str(web), "--port", str(data))
    files = [] if recording is None else [str(recording)]
    with _running(*arguments, *files) as process:
        _wait_for(source, process, recording)
        policy = POLICY.format(data=f"{stream} {TILES}" if tiles else stream)
        server = ThreadingHTTPServer((HOST, 0), _page_handler(source, policy))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        query = urllib.parse.urlencode({"url": f"rerun+{stream}/proxy", "persist": "false"})
        try:
            yield f"http://{HOST}:{server.server_address[1]}/?{query}", process
        finally:
            server.shutdown()
            server.server_close()


def _wait_for(source: str, process: subprocess.Popen[bytes], recording: Path | None) -> None:
    deadline = time.monotonic() + STARTING
    while time.monotonic() < deadline and process.poll() is None:
        try:
            with _direct.open(f"{source}/", timeout=5.0):
                return
        except OSError:
            time.sleep(0.1)
    raise InputError(
        "the Rerun viewer does not serve it",
        file=recording,
        remedy="save it with -o replay.rrd and try: rerun --serve-web replay.rrd",
    )


_direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
"""Asks this machine without whatever proxy the user has."""


def _page_handler(source: str, policy: str) -> type[BaseHTTPRequestHandler]:
    """Passes on Rerun's page with a policy that keeps the browser on this machine."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            name = urllib.parse.urlsplit(self.path).path
            if name not in PAGE:
                self.send_error(404)
                return
            with _direct.open(source + name, timeout=STARTING) as answer:
                content = answer.read()
                kind = answer.headers.get("Content-Type", "application/octet-stream")
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Content-Security-Policy", policy)
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *words: Any) -> None:
            """Nothing: what the page fetches is of no interest to the user."""

    return Handler


# ------------------------------------------------------------------------ pictures of a recording


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
    given, port = _existing(recording), free_port()
    files, fed = [str(given)], Path(os.devnull)
    if layout is not None and given.suffix == ".mcap":
        # A layout that is named beside a log is not applied to it; one that is fed in is.
        files, fed = [str(given), "-"], Path(layout)
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
                yield HeadlessViewer(_connected(process, port, given, log), settle)
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
    lines = log.read_text("utf-8", "replace").splitlines()
    reasons = [line.strip() for line in lines if "graphics adapter" in line or "panicked" in line]
    raise InputError(
        f"the Rerun viewer does not show it{f': {reasons[-1]}' if reasons else ''}",
        file=recording,
        remedy="it needs a Vulkan driver, in software too (Debian: mesa-vulkan-drivers)",
    )
