"""How a replay opens: in a window, in the browser, as a picture; and that nothing stays behind."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from killed import PATIENCE
from replay_trips import made_trip

from trainlog.formats.samples import sample
from trainlog.replay import write_replay
from trainlog.replay.viewer import NOWHERE, offline, web_viewer

direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("open") / "replay.rrd"
    write_replay([made_trip()], path)
    return path


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
