"""Updaters of one map that are killed, forked from a process that has imported everything."""

import os
import selectors
import signal
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from killed import Piped
from test_traction_map import LINE, part, piece

from analysis.adhesion import condition_map
from analysis.adhesion.condition_map import empty_map, update_map
from trainlog.cli.main import run
from trainlog.formats.mapfile import MapFile, Recording

EMPTY = empty_map(LINE)
SHARED = {900 + n: part(900 + n, 3 * n, 3 * n + 9 + n) for n in range(5)}
SHARED |= {990: piece(990, "wet")}
"""Given to all updaters: recordings of one drive that replace each other, and one of another."""


def recording_of(seed: int) -> Recording:
    """The recording whose trip is named after a seed."""
    return condition_map.recording_of(SHARED.get(seed) or piece(seed, ("dry", "wet")[seed % 2]))


def wait_for(running: Sequence[Piped], lines: int) -> None:
    """Until all updaters together have printed so many lines, or have ended."""
    with selectors.DefaultSelector() as selector:
        for each in running:
            selector.register(each.pipe, selectors.EVENT_READ, each)
        while selector.get_map() and sum(len(each.lines) for each in running) < lines:
            for key, _ in selector.select():
                if not key.data.read():
                    selector.unregister(key.fileobj)


def kill(running: Sequence[Piped], rng: np.random.Generator, within: float) -> int:
    """Kill all, one after the other at random instants; how many had not ended."""
    for each in running:
        time.sleep(float(rng.uniform(0.0, within)))
        os.kill(each.pid, signal.SIGKILL)
    return sum(each.end() == -signal.SIGKILL for each in running)


def append(path: Path, seeds: Sequence[int]) -> None:
    """Add recordings to a map's file, and state each when it is on the disk."""
    with MapFile(path, EMPTY) as file:
        for seed in seeds:
            file.append(recording_of(seed))
            print(seed, flush=True)


def kill_and_append(folder: str, updaters: int, kills: int, each: int) -> dict[str, Any]:
    """Updaters with recordings of their own, and with some that all are given, are killed."""
    own_folder = Path(folder, f"{kills}-kills")
    own_folder.mkdir()
    path, rng = own_folder / "a.map", np.random.default_rng(1)
    stated: list[list[int]] = []
    number = killed = 0
    while killed < kills or not number:
        running = []
        for _ in range(updaters):
            own = list(range(1000 + each * number, 1000 + each * (number + 1)))
            seeds = [*own[:2], *SHARED, *own[2:]]
            running.append(Piped(partial(append, path, seeds), own_folder / f"{number}"))
            number += 1
        if kills:
            wait_for(running, int(rng.integers(updaters * each // 2)))
            killed += kill(running, rng, 0.005)
        else:
            for found in running:
                found.end()
        stated += [[int(line) for line in found.lines] for found in running]
        assert {found.returncode for found in running} <= {0, -signal.SIGKILL}, "an updater failed"
        if path.exists():
            with MapFile(path) as file:
                file.trips()
    assert not any((own_folder / f"{n}").read_text() for n in range(number)), "one complained"
    ended = number - killed
    return {"map": str(path), "killed": killed, "ended": ended, "stated": stated}


def append_by_all(folder: str, updaters: int, *given: Sequence[int]) -> list[dict[str, Any]]:
    """What `kill_and_append` gives for each number of kills and of recordings of each updater."""
    return [kill_and_append(folder, updaters, *each) for each in given]


def kill_and_update(place: str, logs: str, updaters: int, rounds: int) -> list[dict[str, Any]]:
    """Commands that update one map from one folder of logs are killed, then all may end."""
    rng, found, folder = np.random.default_rng(2), [], Path(place)
    # Compiled functions are loaded once, by all updaters together.
    update_map(logs, folder / "first.map")
    for number in range(rounds):
        path = folder / f"killed-{number}.map"
        words = ["map", "update", logs, "--map", str(path)]
        running = [Piped(partial(run, words), folder / f"{number}-{n}") for n in range(updaters)]
        wait_for(running, 1)
        killed = kill(running, rng, 0.05)
        with MapFile(path) as file:
            counted = [row.known.name for row in file.trips() if row.counted]
        texts = [folder / f"{number}+{n}" for n in range(updaters)]
        again = [Piped(partial(run, words), text) for text in texts]
        pairs = zip(again, texts, strict=True)
        ended = [(each.end(), each.lines, text.read_text()) for each, text in pairs]
        stated = [line for each in running for line in each.lines]
        known = {"killed": killed, "stated": stated, "counted": counted, "ended": ended}
        found.append({"map": str(path), **known})
    return found
