"""A recorder killed at any moment loses what it was given since its last flush, and no more."""

from __future__ import annotations

import os
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random

import numpy as np
import pytest
from crashing_recorder import FLUSH, REPORT, START, started, values_at
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader
from refusals import refused

from trainlog.errors import LogError
from trainlog.mcap import DamageWarning, read_log

pytestmark = pytest.mark.skipif(
    not hasattr(signal, "SIGKILL"), reason="programs are killed otherwise there"
)

MARGIN = 0.5
"""How late the recorder's thread may come to write on a busy machine [s]."""


def killed(path: Path, after: float) -> tuple[int, int]:
    """Start a recorder and kill it; how many samples the file must hold, and how many it may.

    It must hold what the recorder itself says it has written, and all that it was given longer
    than a flush period, and the margin, ago.
    """
    process, pipe = started(path)
    reports = [REPORT.unpack(pipe.recv_bytes())]
    end = time.monotonic() + after
    while time.monotonic() < end:
        if pipe.poll(max(0.0, end - time.monotonic())):
            reports.append(REPORT.unpack(pipe.recv_bytes()))
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    moment = time.monotonic()
    reports += rest(pipe)
    process.join()
    process.close()
    old = [given for at, given, _ in reports if at < moment - FLUSH - MARGIN]
    # Behind the last report it may have been given another round.
    return max([written for _, _, written in reports] + old), reports[-1][1] + 40


def rest(pipe: Connection) -> list[tuple[float, int, int]]:
    found = []
    try:
        while True:
            found.append(REPORT.unpack(pipe.recv_bytes()))
    except EOFError:
        return found


def check(path: Path, must: int, may: int) -> None:
    """The file holds the first samples, as many as it must, each as it was given."""
    if not must and not officially(path):
        refused(LogError, "no message of it is readable", read_log, path)
        return
    with pytest.warns(DamageWarning) as caught:
        trip = read_log(path)
    account = caught.list[0].message
    assert isinstance(account, DamageWarning)
    assert account.account.messages == sum(len(frame) for frame in trip.topics.values())
    assert trip.metadata == {"trip": "cut short"}
    counts = {"/train/state": 0, "/train/axles": 0}
    for name, expected in zip(counts, values_at(np.arange(may)), strict=True):
        if name not in trip.topics:
            continue
        frame = trip[name]
        count = counts[name] = len(frame)
        assert count <= may
        assert (frame.index.as_unit("ns").asi8 == START + np.arange(count) * 1000).all()
        for field, values in expected.items():
            columns = frame.filter(regex=f"^{field}(_[0-9]+)?$").to_numpy()
            np.testing.assert_array_equal(columns, values[:count].reshape(count, -1))
    assert min(counts.values()) >= must
    assert officially(path) == sum(counts.values())


def officially(path: Path) -> int:
    """How many messages the official reader finds before the end of what was written."""
    count = 0
    with path.open("rb") as stream:
        try:
            for record in StreamReader(stream, validate_crcs=True).records:
                count += type(record).__name__ == "Message"
        except McapError:
            pass
    return count


def kill_often(folder: Path, kills: int, longest: float) -> int:
    """Kill recorders; returns how many samples had to be there, over all files."""
    random = Random(kills)
    total = 0
    for number in range(kills):
        path = folder / f"{number}.mcap"
        must, may = killed(path, random.uniform(0.0, longest))
        check(path, must, may)
        total += must
        path.unlink()
    return total


@pytest.mark.parametrize("moments", [3, pytest.param(25, marks=pytest.mark.long)])
def test_recorders_killed_at_many_moments(tmp_path: Path, moments: int) -> None:
    assert kill_often(tmp_path, moments, longest=0.8) > 0


@pytest.mark.long
def test_recorders_killed_at_1000_moments(tmp_path: Path) -> None:
    assert kill_often(tmp_path, 1000, longest=0.9) > 0
