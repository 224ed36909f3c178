"""A recorder killed at any moment loses what it was given since its last flush, and no more."""

from __future__ import annotations

import os
import signal
import struct
import time
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader
from refusals import refused

import trainlog
from trainlog.errors import LogError
from trainlog.mcap import DamageWarning, read_log

pytestmark = pytest.mark.skipif(
    not hasattr(signal, "SIGKILL"), reason="programs are killed otherwise there"
)

FLUSH, MARGIN = 0.05, 0.5
"""Period of the recording, and how late its thread may come to write on a busy machine [s]."""

START = 1_735_689_600 * 10**9
REPORT = struct.Struct("<dqq")
"""When, how many samples of each topic were given until then, how many of them were written."""


def values_at(number: Any) -> dict[str, dict[str, Any]]:
    """What the sample with this number says: of the train's state, and of its axles."""
    axles = np.stack([np.cos(number + axle) for axle in range(4)], axis=-1)
    state = {"speed": np.sin(number), "position": number * 0.5}
    return {"/train/state": state, "/train/axles": {"wheel_speed": axles}}


def record(path: str, pipe: Connection) -> None:
    """Record samples of two topics, one by one and in blocks, and report it, until killed."""
    with trainlog.record(path, flush=FLUSH, metadata={"trip": "cut short"}) as log:
        number = 0
        while True:
            for _ in range(2):
                block = np.arange(number, number + 20)
                log.write("/train/axles", START + block * 1000, **values_at(block)["/train/axles"])
                for each in block.tolist():
                    log.write("/train/state", START + each * 1000,
                              **values_at(each)["/train/state"])  # fmt: skip
                number += 20
            written = log.account().written
            least = min(written.get(name, 0) for name in values_at(0))
            pipe.send_bytes(REPORT.pack(time.monotonic(), number, least))
            time.sleep(0.004)


def killed(path: Path, after: float) -> tuple[int, int]:
    """Start a recorder and kill it; how many samples the file must hold, and how many it may.

    It must hold what the recorder itself says it has written, and all that it was given longer
    than a flush period, and the margin, ago. A server that has everything loaded starts it.
    """
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    # The server looks for what it loads beforehand where the environment says, and there alone.
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        ensure_running()
    pipe, theirs = context.Pipe(duplex=False)
    process = context.Process(target=record, args=(str(path), theirs), daemon=True)
    process.start()
    theirs.close()
    reports = [REPORT.unpack(pipe.recv_bytes())]
    end = time.monotonic() + after
    while (left := end - time.monotonic()) > 0.0:
        if pipe.poll(left):
            reports.append(REPORT.unpack(pipe.recv_bytes()))
    process.kill()
    moment = time.monotonic()
    try:
        while True:
            reports.append(REPORT.unpack(pipe.recv_bytes()))
    except EOFError:
        process.join()
    old = [given for at, given, _ in reports if at < moment - FLUSH - MARGIN]
    # Behind the last report it may have been given another round.
    return max([written for _, _, written in reports] + old), reports[-1][1] + 40


def check(path: Path, must: int, may: int) -> None:
    """The file holds the first samples, as many as it must, each as it was given."""
    if not must and not officially(path):
        refused(LogError, "no message of it is readable", read_log, path)
        return
    with pytest.warns(DamageWarning) as caught:
        trip = read_log(path)
    account = caught.list[0].message
    assert isinstance(account, DamageWarning)
    counts = {name: len(trip[name]) if name in trip.topics else 0 for name in values_at(0)}
    assert account.account.messages == officially(path) == sum(counts.values())
    assert trip.metadata == {"trip": "cut short"}
    for name, expected in values_at(np.arange(may)).items():
        if not counts[name]:
            continue
        times = trip[name].index.as_unit("ns").asi8
        assert (times == START + np.arange(counts[name]) * 1000).all()
        for field, values in expected.items():
            columns = trip[name].filter(regex=f"^{field}(_[0-9]+)?$").to_numpy()
            np.testing.assert_array_equal(columns, values[: len(times)].reshape(len(times), -1))
    assert must <= min(counts.values()) <= max(counts.values()) <= may


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


@pytest.mark.parametrize("kills", [3, pytest.param(1000, marks=pytest.mark.long)])
def test_recorders_killed_at_many_moments(tmp_path, kills):
    random = Random(kills)
    total = 0
    for number in range(kills):
        path = tmp_path / f"{number}.mcap"
        must, may = killed(path, random.uniform(0.0, 0.9))
        check(path, must, may)
        total += must
        path.unlink()
    assert total > 0
