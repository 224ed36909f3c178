"""The Rerun viewer: opened for a person in a window or in the browser, on this machine alone."""

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
from typing import Any

import rerun as rr

from trainlog.errors import InputError
from trainlog.processes import handled

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
    for number in (signal.SIGTERM, signal.SIGKILL):
        # The wrapper may have ended before the viewer: the group is asked, not the process.
        try:
            os.killpg(process.pid, number)
        except (ProcessLookupError, PermissionError):
            break
        deadline = time.monotonic() + ENDING
        while time.monotonic() < deadline and _group_lives(process):
            time.sleep(0.02)
    process.wait(ENDING)


def _group_lives(process: subprocess.Popen[bytes]) -> bool:
    process.poll()
    try:
        os.killpg(process.pid, 0)
    except (ProcessLookupError, PermissionError):
        return False
    return True


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
