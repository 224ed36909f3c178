"""Damage of every kind: nothing but our errors, nothing lost in silence, no hang, little memory.

What each damaged file gives is judged in `mcap_judge`; a file that once was judged badly stays in
`data/damaged` and is judged again by every run.
"""

from __future__ import annotations

import json
import os
import time
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import pytest
from mcap_judge import most_memory, specimens, time_limit, verdict
from mcap_mutations import MUTATIONS, mutated

from trainlog.errors import LogError
from trainlog.mcap import account_of, read_log, recover
from trainlog.mcap.records import DamageWarning

KEPT = Path(__file__).parent / "data" / "damaged"
FLOOR = 64 * 2**20
"""So much memory more than before may be used for any small file [bytes]."""

REBUILT = 16
"""One file in so many is rebuilt and described as well."""


def judged(folder: Path, seeds: range) -> tuple[list[str], int]:
    """What is wrong with the files of these seeds, and the memory that they took [bytes]."""
    own = folder / str(os.getpid())
    own.mkdir(exist_ok=True)
    whole = specimens(own)
    for each in whole:
        verdict(each.data, each, own / "damaged.mcap")
    before = most_memory()
    wrong = []
    for seed in seeds:
        one = whole[seed % len(whole)]
        how, data = mutated(one.data, seed)
        found = verdict(data, one, own / "damaged.mcap", rebuild=seed % REBUILT == 0)
        wrong += [f"seed {seed}, {one.name}, {how}: {each}" for each in found]
    return wrong, most_memory() - before


@pytest.mark.parametrize(
    "part", [0, *(pytest.param(part, marks=pytest.mark.long) for part in range(1, 5))]
)
def test_damaged_files(part: int, tmp_path: Path) -> None:
    """The 200 files of every run, and 2,000 more."""
    wrong, memory = judged(tmp_path, range(part * 500, part * 500 + (500 if part else 200)))
    assert not wrong
    assert memory < FLOOR


@pytest.mark.long
def test_a_hundred_thousand_damaged_files(tmp_path: Path) -> None:
    """Run with ``pytest -m long -s`` to see the figures."""
    count, batch = 100_000, 500
    start = time.perf_counter()
    batches = [range(first, first + batch) for first in range(10_000, 10_000 + count, batch)]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        results = list(pool.map(partial(judged, tmp_path), batches))
    wrong = [each for found, _ in results for each in found]
    memory = max(most for _, most in results)
    print(
        f"\n{count:,} damaged files in {time.perf_counter() - start:.0f} s, "
        f"{len(wrong)} judged wrong, {memory / 2**20:.0f} MiB of memory more than for whole files"
    )
    for each in wrong[:50]:
        print(each)
    assert not wrong
    assert memory < FLOOR


def test_every_kind_of_damage_is_drawn() -> None:
    drawn: Counter[str] = Counter()
    data = b"\x89MCAP0\r\n" + bytes(100)
    for seed in range(2000):
        how, _ = mutated(data, seed)
        drawn.update(how.split(", "))
    assert set(drawn) == set(MUTATIONS)


@pytest.mark.parametrize("path", sorted(KEPT.glob("*.mcap")), ids=lambda path: path.stem)
def test_files_that_were_once_judged_badly(path: Path, tmp_path: Path) -> None:
    """Each gives the account that the list beside it holds, and is rebuilt."""
    expected = json.loads((KEPT / "accounts.json").read_text("utf-8"))[path.name]
    with time_limit(20):
        account = account_of(path)
        assert [account.messages, account.messages_lost, len(account.losses)] == expected
        with suppress(LogError), warnings.catch_warnings():
            warnings.simplefilter("ignore", DamageWarning)
            read_log(path)
        if not account.messages:
            return
        assert recover(path, tmp_path / "again.mcap") == account
    again = account_of(tmp_path / "again.mcap")
    assert again.whole
    assert again.messages == account.messages
