"""The Rerun viewer: opened for a person, or asked for a picture without a screen."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import rerun as rr
from rerun.experimental import ViewerClient

from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.units import NANOSECONDS

HOST = "127.0.0.1"
"""Rerun would else listen on every network."""

STARTING = 60.0
"""How long a viewer may take until it shows a recording [s]."""

SETTLING = 6.0
"""How long it takes to draw everything and to let its greetings fade [s]."""


def open_viewer(path: str | Path) -> str:
    """Open a recording in the Rerun viewer if there is a display, and state what was done.

    The viewer goes on when this process ends, sends no usage data, and listens on this machine
    alone.

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
    >>> trainlog.write_replay([trip], "nonstop.rrd")
    >>> print(trainlog.open_viewer("nonstop.rrd"))  # doctest: +SKIP
    The Rerun viewer opens with /home/me/nonstop.rrd
    """
    recording = Path(path).resolve()
    if not recording.is_file():
        raise InputError("does not exist", file=path, remedy="write it with write_replay")
    if not has_display():
        return (
            f"No display here; the replay is {recording}. Where there is one:"
            f" pip install rerun-sdk=={rr.__version__}, then: rerun {recording.name}"
        )
    subprocess.run(
        _command("--detach-process", "--port", "auto", str(recording)),
        env=quiet(os.environ),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    return f"The Rerun viewer opens with {recording}"


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


def quiet(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment for a viewer that sends no usage data, whatever its own settings say.

    Rerun sends none from continuous integration, which it knows by this variable.
    """
    return {**environment, "CI": "true"}


def take_picture(
    recording: str | Path,
    image: str | Path,
    *,
    size: tuple[int, int] = (1600, 1000),
    timeline: str | None = None,
    at: int = 0,
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
    timeline : str, optional
        To show instead of the layout's own.
    at : int
        Where on that timeline: nanoseconds or, on the position timeline, millimetres.
    layout : path, optional
        Instead of the recording's own, see `trainlog.replay.layout`.
    settle : float [s]
        From when the recording is loaded to when its picture is taken.

    Returns
    -------
    list of str
        Names of the views that are shown.

    Raises
    ------
    InputError
        If there is no such recording, it cannot be shown, or the picture not be written.

    Examples
    --------
    >>> import trainlog
    >>> views = trainlog.take_picture("nonstop.rrd", "nonstop.png")  # doctest: +SKIP
    """
    if not Path(recording).is_file():
        raise InputError("does not exist", file=recording, remedy="write it with write_replay")
    with _headless(Path(recording).resolve(), size, layout) as viewer:
        if timeline is not None:
            _set_time(viewer, timeline, at)
        time.sleep(settle)
        with atomic_write(image) as temporary:
            viewer.save_screenshot(str(temporary.resolve()))
        return sorted(view.name for view in viewer.get_state().views)


@contextmanager
def _headless(
    recording: Path, size: tuple[int, int], layout: str | Path | None
) -> Iterator[ViewerClient]:
    """A client of a viewer that has loaded the recording; the viewer ends with the block."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        port = probe.getsockname()[1]
    files, fed = [str(recording)], Path(os.devnull)
    if layout is not None and recording.suffix == ".mcap":
        # A layout that is named beside a log is not applied to it; one that is fed in is.
        files, fed = [str(recording), "-"], Path(layout)
    elif layout is not None:
        files.append(str(layout))
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        log = Path(folder) / "log"
        window = f"{size[0]}x{size[1]}"
        with log.open("wb") as output, fed.open("rb") as source:
            process = subprocess.Popen(
                _command(
                    *("--headless", "--hide-welcome-screen", "--window-size", window),
                    *("--port", str(port), *files),
                ),
                env=quiet({"XDG_RUNTIME_DIR": folder, **os.environ}),
                stdin=source,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                yield _connected(process, port, recording, log)
            finally:
                _end(process)


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


def _set_time(viewer: Any, timeline: str, at: int) -> None:
    state = viewer.get_state()
    kinds = {each.name: each.time_type for one in state.recordings for each in one.timelines}
    if timeline not in kinds:
        raise InputError(
            f"the recording has no timeline '{timeline}'", remedy=f"it has: {', '.join(kinds)}"
        )
    kind = kinds[timeline]
    shown = at if kind == "sequence" else at / NANOSECONDS
    viewer.set_time(timeline, play_state="paused", **{kind: shown})


def _command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "rerun_cli", "--bind", HOST, *arguments]


def _last_words(log: Path) -> str:
    """Why the viewer gave up, if it said so."""
    lines = log.read_text("utf-8", "replace").splitlines()
    reasons = [line.strip() for line in lines if "graphics adapter" in line or "panicked" in line]
    return f": {reasons[-1]}" if reasons else ""


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the viewer with the wrapper that started it."""
    if sys.platform == "win32":
        command = ["taskkill", "/PID", str(process.pid), "/T", "/F"]
        subprocess.run(command, capture_output=True, check=False)
    elif process.poll() is None:
        os.killpg(process.pid, signal.SIGTERM)
    process.wait(10.0)
