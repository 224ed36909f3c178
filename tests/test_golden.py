"""Golden replays: estimators and analyses give over the sample logs what they gave before.

The references are renewed by ``pytest tests/test_golden.py --renew-golden``; the difference is
reviewed like code.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from golden_replays import LOGS, REPLAYS, Replay, trip_of
from numpy.typing import ArrayLike

from trainlog.errors import TrainlogError

pytestmark = pytest.mark.usefixtures("remembered")

GOLDEN = Path(__file__).parent / "data" / "golden"

SAMPLES = 9
"""Rows of a long figure that are kept, from the first to the last."""

DIGITS = 10

ZERO = 1e-9
"""Share of the largest value of a figure that counts as nothing in any of its columns."""

Reference = dict[str, object]


def path_of(name: str, log: str) -> Path:
    return GOLDEN / f"{name.replace(' ', '_')}.{log}.json"


def replayed(replay: Replay, log: str) -> Reference:
    """A digest of each figure, or why it is refused."""
    try:
        figures = replay.run(trip_of(log))
    except TrainlogError as error:
        return {"refused": re.sub(r"[0-9.]+", "#", str(error))}
    return {name: digest(values) for name, values in figures.items()}


def digest(values: ArrayLike) -> dict[str, object]:
    """Shape, how many are unknown, and by column the largest and the mean size; some rows."""
    array = np.asarray(values, dtype=np.float64)
    few = array.ndim == 0 or (array.ndim == 1 and array.size <= SAMPLES)
    # A few numbers side by side, an estimate say, are columns of their own.
    rows = array.reshape(1, -1) if few else array.reshape(len(array), -1)
    chosen = np.unique(np.linspace(0, max(len(rows) - 1, 0), min(SAMPLES, len(rows))).astype(int))
    size = np.where(np.isfinite(rows), np.abs(rows), 0.0)
    return {
        "shape": list(array.shape),
        "unknown": int(np.count_nonzero(~np.isfinite(array))),
        "largest": [rounded(value) for value in size.max(axis=0, initial=0.0)],
        "mean": [rounded(value) for value in size.sum(axis=0) / max(len(rows), 1)],
        "rows": [[rounded(value) for value in row] for row in rows[chosen]],
    }


def rounded(value: float) -> float | None:
    """To `DIGITS` digits, which JSON holds exactly; None where unknown."""
    return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None


def differences(found: Reference, golden: Reference, tolerance: float) -> list[str]:
    """What of a replay is not what it was, in a line each."""
    if "refused" in found or "refused" in golden:
        was, now = (each.get("refused", "answered") for each in (golden, found))
        return [] if was == now else [f"was: {was}; is: {now}"]
    lines = [f"{name}: only in one of the two" for name in sorted(set(found) ^ set(golden))]
    for name in sorted(set(found) & set(golden)):
        now, was = found[name], golden[name]
        assert isinstance(now, dict)
        assert isinstance(was, dict)
        lines += [
            f"{name}: {part} was {was[part]}, is {now[part]}"
            for part in ("shape", "unknown")
            if now[part] != was[part]
        ]
        if now["shape"] != was["shape"]:
            continue
        largest = np.array(was["largest"])
        allowed = tolerance * np.maximum(largest, ZERO * largest.max(initial=1e-300))
        for part in ("largest", "mean", "rows"):
            new, old = (np.array(each[part], dtype=np.float64) for each in (now, was))
            off = np.where(np.isnan(new) & np.isnan(old), 0.0, np.abs(new - old)) / allowed
            if not np.all(off <= 1.0):
                worst = tolerance * float(np.max(off))
                lines.append(f"{name}: {part} differ by {worst:.1e} of the largest")
    return lines


@pytest.mark.parametrize("log", LOGS)
@pytest.mark.parametrize("name", REPLAYS)
def test_replay_gives_what_it_gave(name: str, log: str, request: pytest.FixtureRequest) -> None:
    replay, path = REPLAYS[name], path_of(name, log)
    found = replayed(replay, log)
    if request.config.getoption("--renew-golden"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", "utf-8")
    assert path.exists(), f"no reference: pytest {Path(__file__).name} --renew-golden"
    changed = differences(found, json.loads(path.read_text("utf-8")), replay.tolerance)
    assert not changed, "; ".join(changed) + "; if it is meant: --renew-golden"


def test_every_reference_belongs_to_a_replay() -> None:
    wanted = {path_of(name, log) for name in REPLAYS for log in LOGS}
    assert set(GOLDEN.glob("*.json")) == wanted


def test_a_change_beyond_the_tolerance_is_told() -> None:
    golden: Reference = {"force": digest([1.0, 2.0, np.nan])}
    assert differences({"force": digest([1.0, 2.0 + 1e-7, np.nan])}, golden, 1e-6) == []
    (line,) = differences({"force": digest([1.0 + 1e-4, 2.0, np.nan])}, golden, 1e-6)[-1:]
    assert "rows differ by 1.0e-04 of the largest" in line
    assert "unknown was 1, is 0" in differences({"force": digest([1.0, 2.0, 3.0])}, golden, 1e-6)[0]
    assert differences({}, golden, 1e-6) == ["force: only in one of the two"]
    assert differences({"refused": "why"}, golden, 1e-6) == ["was: answered; is: why"]
