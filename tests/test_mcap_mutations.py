"""Damage of every kind: nothing but our errors, nothing lost in silence, no hang, little memory.

What each damaged file gives is judged in `mcap_judge`; a file that once was judged badly stays in
`data/damaged` and is judged again by every run.
"""

from __future__ import annotations

import json
import os
import warnings
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import pytest
from mcap_judge import most_memory, specimens, time_limit, verdict
from mcap_mutations import mutated

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
    wrong = [each for one in whole for each in verdict(one.data, one, own / "damaged.mcap")]
    before = most_memory()
    for seed in seeds:
        one = whole[seed % len(whole)]
        how, data = mutated(one.data, seed)
        found = verdict(data, one, own / "damaged.mcap", rebuild=seed % REBUILT == 0)
        wrong += [f"seed {seed}, {one.name}, {how}: {each}" for each in found]
    return wrong, most_memory() - before


def test_damaged_files(tmp_path):
    wrong, memory = judged(tmp_path, range(200))
    assert not wrong
    assert memory < FLOOR


@pytest.mark.long
def test_a_hundred_thousand_damaged_files(tmp_path):
    """Each batch in a process that has made no other."""
    batches = [range(first, first + 500) for first in range(10_000, 110_000, 500)]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        results = list(pool.map(partial(judged, tmp_path), batches))
    assert [each for found, _ in results for each in found] == []
    assert max(memory for _, memory in results) < FLOOR


@pytest.mark.parametrize("path", sorted(KEPT.glob("*.mcap")), ids=lambda path: path.stem)
def test_files_that_were_once_judged_badly(path, tmp_path):
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
