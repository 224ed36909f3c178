"""The viewer: when it opens, its options, and what it shows."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from killed import PATIENCE
from PIL import Image
from refusals import refused
from replay_trips import condition_of, made_trip, trajectory_of

from trainlog import InputError, Trip, frame_of, sample
from trainlog.mcap import write_log
from trainlog.replay import run_viewer, viewer, write_replay
from trainlog.replay.layout import DRAWN, scalars, write_layout
from trainlog.replay.viewer import (
    NOWHERE,
    HeadlessViewer,
    has_display,
    headless_viewer,
    offline,
    open_viewer,
    take_picture,
    web_viewer,
)
from trainlog.topics import TOPICS

SETTLE, SIZE = 2.5, (900, 750)
ENOUGH = 100
"""Pixels that are drawn in a panel in which anything is drawn."""
NO_GRAPHICS = "No graphics adapter", "Failed to get render context"


@pytest.fixture(scope="module")
def trip() -> Trip:
    """A trip with every topic whose fields are drawn."""
    found = made_trip()
    time = found["/train/state"].index
    for topic in DRAWN:
        if topic.name not in found:
            values = {field.name: np.arange(len(time)) + 0.5 for field in topic.fields}
            found = found.with_topic(frame_of(topic, time, values))
    return found


@pytest.fixture(scope="module")
def recording(trip: Trip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("viewer") / "replay.rrd"
    write_replay([trip], path, trajectory=trajectory_of(), condition_map=condition_of())
    return path


@pytest.fixture(scope="module")
def log(trip: Trip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "hill-up.mcap"
    write_log(trip, path)
    return path


@pytest.mark.parametrize(
    ("platform", "variables", "display"),
    [
        ("linux", {"DISPLAY": ":0"}, True),
        ("linux", {"WAYLAND_DISPLAY": "wayland-0"}, True),
        ("linux", {}, False),
        ("linux", {"DISPLAY": ""}, False),
        ("linux", {"DISPLAY": "localhost:10.0", "SSH_CONNECTION": "a b c d"}, True),
        ("darwin", {}, True),
        ("darwin", {"SSH_CONNECTION": "a b c d"}, False),
        ("win32", {}, True),
        ("linux", {"DISPLAY": ":0", "CI": "true"}, False),
    ],
)
def test_where_a_window_can_be_opened(platform, variables, display):
    assert has_display(variables, platform) is display


@pytest.mark.parametrize("display", [True, False])
def test_the_viewer_listens_on_this_machine_alone_and_sends_no_usage_data(
    display, recording, tmp_path, monkeypatch
):
    """Without a display it states how to open the file, or what else there is."""
    calls: list[tuple[Any, Any]] = []
    monkeypatch.setattr(viewer, "has_display", lambda: display)
    monkeypatch.setattr(
        viewer.subprocess, "run", lambda command, **options: calls.append((command, options))
    )
    stated = open_viewer(recording)
    assert str(recording) in stated
    if not display:
        assert calls == []
        assert "rerun replay.rrd" in stated
        refused(InputError, r"no display .*--web.*-o out.png.*-o", run_viewer, recording)
        return
    ((command, options),) = calls
    assert command[:3] == [sys.executable, "-m", "rerun_cli"]
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert str(recording) in command
    assert options["env"]["CI"]
    for call in (open_viewer, lambda path: take_picture(path, tmp_path / "none.png")):
        refused(InputError, "does not exist", call, tmp_path / "none.rrd")


@pytest.fixture(scope="module")
def shown(recording: Path) -> Iterator[HeadlessViewer]:
    """One viewer for the pictures of all views; skips where nothing can be drawn."""
    try:
        with headless_viewer(recording, size=SIZE, settle=SETTLE) as viewer:
            yield viewer
    except InputError as error:
        if not any(words in str(error) for words in NO_GRAPHICS):
            raise
        pytest.skip(str(error))


VIEWS = ["overview", "driving", "traction", "identification", "map", "recorder"]


@pytest.mark.long
def test_every_view_is_drawn(shown, tmp_path):
    for view in shown.views():
        shown.show(view)
        for _ in range(10):  # a busy machine may need longer
            shown.picture(tmp_path / "view.png")
            with Image.open(tmp_path / "view.png") as picture:
                pixels = np.asarray(picture.convert("RGB"), dtype=int)
            found = (np.ptp(pixels, axis=2) > 40).sum()  # axes, grids and text are grey
            if found > ENOUGH:
                break
            time.sleep(0.5)
        assert found > ENOUGH, view


def test_a_picture_of_a_view_is_taken_whole_or_not_at_all(shown, tmp_path):
    assert shown.views() == VIEWS
    shown.show("driving")
    shown.picture(tmp_path / "driving.png")
    with Image.open(tmp_path / "driving.png") as picture:
        assert picture.size == SIZE
        pixels = np.asarray(picture.convert("RGB"), dtype=int)
    # The colours of the limit, the wheels' speed, traction, and the reference.
    for colour in ((235, 90, 90), (90, 180, 240), (90, 205, 120), (190, 140, 255)):
        near = np.abs(pixels - colour).sum(axis=2) < 40
        assert near.sum() > 50, colour
    refused(InputError, r"no view 'mileage'.*overview, driving", shown.show, "mileage")
    refused(InputError, r"no timeline 'mileage'.*position_m", shown.set_time, "mileage", 0)
    assert [path.name for path in tmp_path.iterdir()] == ["driving.png"]


def test_rerun_takes_the_fields_out_of_a_log(trip, log):
    for topic in DRAWN:
        frame = trip[topic.name]
        for field in topic.fields:
            names = [n for n in frame if re.fullmatch(rf"{field.name}(_\d+)?", n)]
            chunks = scalars(log, topic.name, field.name).to_chunks()
            assert {chunk.entity_path for chunk in chunks} == {f"{topic.name}/{field.name}"}
            records = [chunk.to_record_batch()["Scalars:scalars"].flatten() for chunk in chunks]
            values = np.concatenate([each.to_numpy(zero_copy_only=False) for each in records])
            np.testing.assert_array_equal(values, frame[names].to_numpy().ravel())
    for name, other in (("/train/state", "mood"), ("/events", "message"), ("/no", "speed")):
        refused(InputError, f"no field {other} of topic {name}", scalars, log, name, other)


@pytest.mark.usefixtures("shown")
def test_a_log_opens_as_it_is_with_its_layout(log, tmp_path):
    layout = tmp_path / "hill-up.rbl"
    write_layout(layout, log.stem)
    for settle in (0.5, SETTLE, 6 * SETTLE):  # a busy machine may need longer
        names = set(take_picture(log, tmp_path / "log.png", layout=layout, settle=settle))
        if len(names) > 1:
            break
    assert {"speed [m/s]", "position [m]", "Satellite fix", "Events"} <= names


def test_the_layout_names_every_field_of_the_log(tmp_path):
    path = tmp_path / "trainlog.rbl"
    write_layout(path, "trainlog")
    content = path.read_bytes()
    assert content[:4] == b"RRF2"
    refused(InputError, r"end it in \.rbl", write_layout, tmp_path / "trainlog.txt", "trainlog")
    assert {topic.name for topic in DRAWN} == set(TOPICS) - {"/gnss/fix", "/events"}


direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def listening(port: int) -> set[str]:
    """Addresses of this machine at which anyone listens on a port, from the kernel's table."""
    found = set()
    for name in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(name).read_text().splitlines()[1:]:
            local, _, state = line.split()[1:4]
            address, _, number = local.partition(":")
            if state == "0A" and int(number, 16) == port:
                found.add(address)
    return found


def test_the_viewer_is_given_no_way_to_the_network():
    made = offline({"HTTPS_PROXY": "http://proxy.example", "HOME": "/home/me"})
    assert {made[name] for name in ("https_proxy", "HTTPS_PROXY", "http_proxy")} == {NOWHERE}
    assert "127.0.0.1" in made["no_proxy"]
    assert made["CI"] == "true"
    assert made["HOME"] == "/home/me"
    assert offline({"HTTPS_PROXY": "p"}, tiles=True) == {"HTTPS_PROXY": "p", "CI": "true"}


def test_a_page_in_the_browser_reaches_this_machine_alone(recording):
    with web_viewer(recording) as (address, process):
        with direct.open(address) as answer:
            policy = answer.headers["Content-Security-Policy"]
            page = answer.read()
        assert b"re_viewer" in page
        assert re.search(r"connect-src 'self' blob: data: http://127\.0\.0\.1:\d+$", policy)
        assert set(re.findall(r"https?://([^:/\s]+)", policy)) == {"127.0.0.1"}
        with direct.open(address.partition("?")[0] + "re_viewer.js") as answer:
            assert len(answer.read()) > 10_000
        with pytest.raises(urllib.error.HTTPError, match="404"):
            direct.open(address.partition("?")[0] + "etc/passwd").close()
        data = int(re.search(r"http://127\.0\.0\.1:(\d+)$", policy)[1])
        own = int(re.search(r"127\.0\.0\.1:(\d+)/", address)[1])
        if Path("/proc/net/tcp").exists():
            assert listening(data) == listening(own) == {"0100007F"}
    assert process.poll() is not None


@pytest.mark.skipif(not Path("/proc").exists(), reason="needs a list of processes")
def test_ctrl_c_ends_the_viewer_and_leaves_nothing(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-m", "trainlog", "replay", str(sample("nonstop.mcap")), "--web"],
        env={**os.environ, "DISPLAY": "", "WAYLAND_DISPLAY": "", "TMPDIR": str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        line = process.stdout.readline()
        assert line.startswith("http://127.0.0.1:")
        assert viewers_of(tmp_path)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0
    assert viewers_of(tmp_path) == []
    assert not list(tmp_path.iterdir())


def viewers_of(folder: Path) -> list[str]:
    """Command lines of the processes that name a file of a folder."""
    found = []
    for each in Path("/proc").iterdir():
        try:
            command = (each / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        except (OSError, UnicodeDecodeError):
            continue
        if each.name.isdigit() and str(folder) in command:
            found.append(command)
    return found
