"""The command line in a real terminal: progress is seen there, and Ctrl-C ends everything."""

import os
import pty
import re
import select
import struct
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from killed import PATIENCE

from trainlog.cli import terminal
from trainlog.mcap import account_of
from trainlog.progress import task

fcntl = pytest.importorskip("fcntl", reason="pseudo-terminals are those of POSIX")
import termios  # noqa: E402

CONTROL_C = b"\x03"


@dataclass
class Seen:
    """What a person saw of a command."""

    status: int
    text: str
    group: int

    @property
    def words(self) -> str:
        """Words as they were printed, without colours and what moves the cursor."""
        return " ".join(re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", self.text).split())


def typed(words: list[str | Path], folder: Path, *, until: str = "", columns: int = 100) -> Seen:
    """Run a command in a terminal; Ctrl-C is pressed as soon as `until` is seen on it."""
    process, terminal = pty.fork()
    if process == 0:  # the child
        os.chdir(folder)
        os.environ.pop("NO_COLOR", None)
        os.environ["TERM"] = "xterm-256color"
        os.execv(sys.executable, [sys.executable, "-m", "trainlog", *map(str, words)])
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
    seen, pressed, end = b"", not until, time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if select.select([terminal], [], [], 0.1)[0]:
            try:
                part = os.read(terminal, 65536)
            except OSError:  # the terminal is closed: the command has ended
                break
            if not part:
                break
            seen += part
        if not pressed and until in seen.decode("utf-8", "ignore"):
            os.write(terminal, CONTROL_C)
            pressed = True
    status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    os.close(terminal)
    assert pressed, seen.decode("utf-8", "ignore")
    return Seen(status, seen.decode("utf-8", "ignore"), process)


@pytest.mark.long
def test_ctrl_c_ends_the_demo_as_a_whole_and_states_what_was_finished_once(tmp_path):
    seen = typed(["demo", "-o", "results"], tmp_path, until="trip-02:")
    assert seen.status == 130
    assert seen.words.count("interrupted") == 1
    found = re.search(
        r"interrupted at step 2 of \d+ of the demo: driving: (\d+) of 12 trips finished;"
        r" (\d+) files written",
        seen.words,
    )
    assert found is not None, seen.words
    logs = sorted((tmp_path / "results" / "trips").iterdir())
    assert len(logs) == int(found[2]) >= 2
    assert 0 <= int(found[2]) - int(found[1]) <= 1
    assert all(log.suffix == ".mcap" and account_of(log).whole for log in logs)
    assert "trainlog ingest" not in seen.words
    assert "Traceback" not in seen.text
    with pytest.raises(ProcessLookupError):  # no process of the command is left
        os.killpg(seen.group, 0)


def test_progress_shows_rate_and_remaining_time_and_leaves_nothing(tmp_path):
    words = "simulate drive --line=sample --train=sample --count=2 -o trips"
    seen = typed(words.split(), tmp_path)
    assert seen.status == 0
    assert re.search(r"1 of 2 trips", seen.words)
    assert re.search(r"trips a (minute|second)", seen.words)
    assert re.search(r"\d:\d\d left", seen.words)
    # What stays on the screen is behind the last erased line.
    assert seen.text.rstrip().rsplit("\x1b[2K", 1)[-1].count("driving") == 0


def test_progress_is_stated_in_lines_where_no_bar_can_be_drawn(monkeypatch, capsys):
    monkeypatch.setattr(terminal, "SILENCE", 0.02)
    with terminal.progress_shown(), task("driving", total=2, unit="trip") as step:
        step(1, note="trip-01")
        time.sleep(0.2)
    said = capsys.readouterr().err.splitlines()
    # After 0.02, 0.06 and 0.14 s.
    assert 1 <= len(said) <= 3
    assert re.fullmatch(r"driving: 1 of 2 trips .* left trip-01", said[0])
