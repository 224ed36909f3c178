"""A program that records until it is killed, and reports meanwhile what it has recorded.

It is started by a server that has everything loaded, so that it begins in milliseconds.
"""

from __future__ import annotations

import os
import struct
import time
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.forkserver import ensure_running
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np

import trainlog

FLUSH = 0.05
"""Period of the recording [s]."""

START = 1_735_689_600 * 10**9
REPORT = struct.Struct("<dqq")
"""When, how many samples of each topic were given until then, how many of them were written."""


def values_at(number: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the sample with this number says: of the train's state, and of its axles."""
    state = {"speed": np.sin(number), "position": number * 0.5}
    axles = {"wheel_speed": np.stack([np.cos(number + axle) for axle in range(4)], axis=-1)}
    return state, axles


def run(path: str, pipe: Connection) -> None:
    """Record samples of two topics, one by one and in blocks, until killed."""
    with trainlog.record(path, flush=FLUSH, metadata={"trip": "cut short"}) as log:
        number = 0
        while True:
            for _ in range(2):
                block = np.arange(number, number + 20)
                _, axles = values_at(block)
                log.write("/train/axles", START + block * 1000, **axles)
                for each in block.tolist():
                    state, _ = values_at(each)
                    log.write("/train/state", START + each * 1000, **state)
                number += 20
            now = time.monotonic()
            written = log.account().written
            least = min((written.get(n, 0) for n in ("/train/axles", "/train/state")), default=0)
            pipe.send_bytes(REPORT.pack(now, number, least))
            time.sleep(0.004)


def started(path: Path) -> tuple[BaseProcess, Connection]:
    """The program under way, and the end of the pipe that receives its reports."""
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    # The server looks for what it loads beforehand where the environment says, and there alone.
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(Path(__file__).parent), before]))
    try:
        ensure_running()
    finally:
        del os.environ["PYTHONPATH"]
        if before is not None:
            os.environ["PYTHONPATH"] = before
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=run, args=(str(path), theirs), daemon=True)
    process.start()
    theirs.close()
    return process, ours
