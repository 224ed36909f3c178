"""Values that freeze, on recorded and simulated trips whose true values are known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pandas as pd
import pytest
from ingest_logs import SECOND, START, read_plain

from trainlog import read
from trainlog.ingest import Finding, Table
from trainlog.ingest.profile import Limits, Repair
from trainlog.ingest.rules import repaired

RULES = ("spikes", "frozen", "counter", "position_steps")

TOPICS = (
    "/train/state", "/train/controls", "/train/axles", "/gnss/fix", "/gnss/motion", "/environment",
)  # fmt: skip

SIZES = {"speed": 1.0, "effort": 5e3, "position": 20.0, "latitude": 3e-4}
"""How far a frozen value must be off for it to matter."""


@cache
def sampled(name: str) -> pd.DataFrame:
    """All that a train records, in one table."""
    trip = read(f"sample_logs/{name}.mcap")
    frames = [trip[topic].add_prefix(f"{topic}.") for topic in TOPICS if topic in trip]
    return pd.concat(frames, axis=1)


def coarse(frame: pd.DataFrame) -> pd.DataFrame:
    """Speeds in whole km/h, efforts in whole kN, positions in whole metres."""
    found = frame.copy()
    for name in found.columns:
        if name.endswith("speed") or "wheel_speed" in name:
            found[name] = np.round(3.6 * found[name]) / 3.6
        elif "effort" in name:
            found[name] = np.round(found[name], -3)
        elif name.endswith("position"):
            found[name] = np.round(found[name])
    return found


def judged(frame: pd.DataFrame) -> tuple[Table, list[Finding]]:
    """The frame after all rules, and what those of this page found."""
    columns = {name: frame[name].to_numpy(np.float64) for name in frame.columns}
    rows = np.arange(2, len(frame) + 2)
    table = Table(frame.index.as_unit("ns").asi8, rows, columns)
    kept, found, _ = repaired(table, Limits(), Repair(inconsistent=False, unit_suspected=False))
    return kept, [finding for finding in found if finding.rule in RULES]


def variants(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    rough = coarse(frame)
    satellites = [name for name in frame.columns if name.startswith("/gnss/")]
    return {
        "as it is": frame,
        "coarse": rough,
        "coarse, 1 Hz": rough.iloc[::10],
        "1 Hz": frame.iloc[::10],
        "coarse, no satellites": rough.drop(columns=satellites),
        "coarse, no position": rough.drop(columns=["/train/state.position"]),
        "coarse, the speed alone": rough[["/train/state.speed"]],
        "the speed alone": frame[["/train/state.speed"]],
        "satellites alone": frame[satellites].dropna(how="all"),
    }


@pytest.mark.parametrize("log", ["nonstop", "stopping"])
def test_sound_trips_hold_nothing_frozen(log):
    for name, frame in variants(sampled(log)).items():
        assert judged(frame)[1] == [], name


def exact_trip(cruising: float, *, position: bool = True, step: float = 0.0) -> pd.DataFrame:
    """A train without any noise: it stands, gathers speed, cruises exactly, brakes and stands."""
    rising, cruise = np.arange(0.0, 25.0, 0.05), np.full(round(10 * cruising), 25.0)
    falling = np.arange(25.0, 0.0, -0.07)
    speed = np.concatenate((np.zeros(600), rising, cruise, falling, np.zeros(900)))
    driven = np.concatenate(([0.0], np.cumsum(0.05 * (speed[1:] + speed[:-1]))))
    if step:
        speed = np.round(speed / step) * step
    index = pd.DatetimeIndex(START + np.arange(speed.size) * (SECOND // 10), tz="UTC")
    columns = {"/train/state.speed": speed}
    if position:
        columns["/train/state.position"] = 1e4 + driven
    effort = 60e3 * (np.gradient(driven, 0.1, edge_order=1) > 0.0)
    columns["/train/controls.tractive_effort"] = effort
    columns["/environment.air_temperature"] = np.full(speed.size, 285.0)
    columns["/train/controls.lever"] = np.where(effort > 0.0, 0.7, 0.0)
    return pd.DataFrame(columns, index=index)


@pytest.mark.parametrize("position", [True, False])
@pytest.mark.parametrize(
    ("cruising", "step"), [(20.0, 0.0), (600.0, 0.1), (600.0, 1 / 3.6), (20.0, 5 / 3.6)]
)
def test_a_constant_speed_is_not_frozen(cruising, step, position):
    """Nor are a train at rest, the weather, the lever and a constant effort."""
    assert judged(exact_trip(cruising, position=position, step=step))[1] == []


def freeze(
    frame: pd.DataFrame, column: str, length: float, rng: np.random.Generator
) -> tuple[pd.DataFrame, np.ndarray]:
    """A column, from a place where the train moves on, repeats its value for `length` [s]."""
    seconds = (frame.index - frame.index[0]).total_seconds().to_numpy()
    values = frame[column].to_numpy()
    known = np.isfinite(values)
    speed = next(name for name in ("/train/state.speed", "/gnss/motion.speed") if name in frame)
    free = known & (frame[speed].interpolate().to_numpy() > 5.0)
    free &= (seconds > 10.0) & (seconds < seconds[-1] - length - 5.0)
    if "effort" in column:
        free &= np.abs(values) > 10e3
    begin = rng.choice(np.flatnonzero(free))
    inside = known & (seconds > seconds[begin]) & (seconds <= seconds[begin] + length)
    spoilt = frame.copy()
    for name in {column, column.replace("latitude", "longitude")}:
        spoilt.loc[inside, name] = frame[name].iloc[begin]
    return spoilt, inside


def found_frozen(frame: pd.DataFrame, column: str, length: float, rng: np.random.Generator) -> bool:
    """Whether a frozen stretch is found, and no other column or stretch is touched."""
    spoilt, inside = freeze(frame, column, length, rng)
    kept, found = judged(spoilt)
    absent = np.isnan(kept.signals[column]) & np.isfinite(spoilt[column].to_numpy())
    size = next(SIZES[kind] for kind in SIZES if kind in column.partition(".")[2])
    off = inside & (np.abs(spoilt[column] - frame[column]).to_numpy() > size)
    # What equals the frozen value by chance just beside the stretch belongs to it.
    beside = np.flatnonzero(absent & ~inside)
    assert np.all(spoilt[column].iloc[beside] == spoilt[column][inside].iloc[0])
    touched = {finding.column for finding in found}
    assert touched <= {column, column.replace("latitude", "longitude"), column.rpartition("_")[0]}
    return not off.any() or np.count_nonzero(absent & off) > 0.9 * np.count_nonzero(off)


@pytest.mark.parametrize(
    ("log", "column", "least"),
    [
        ("nonstop", "/train/state.speed", 4),
        ("stopping", "/train/state.speed", 4),
        ("stopping", "/train/axles.wheel_speed_2", 4),
        ("nonstop", "/train/state.position", 4),
        ("stopping", "/gnss/motion.speed", 4),
        # An outage may leave less than 10 s of it.
        ("nonstop", "/gnss/fix.latitude", 3),
        # An effort of few kN is coarser than its noise and may rest.
        ("stopping", "/train/controls.tractive_effort", 3),
    ],
)
def test_frozen_values_are_found(log, column, least):
    rng = np.random.default_rng(4)
    frame = sampled(log)
    lengths = (20.0, 45.0, 120.0, 300.0)
    assert sum(found_frozen(frame, column, each, rng) for each in lengths) >= least


def test_a_speed_frozen_at_rest_is_found_once_the_train_moves(tmp_path):
    """An odometer that stays at 0 while the counter of the distance goes on."""
    seconds = np.arange(600)
    speed = np.clip(0.4 * (seconds - 60.0), 0.0, 20.0)
    position = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))))
    dead = np.where((seconds > 300) & (seconds < 420), 0.0, speed)
    rows = [
        f"{pd.Timestamp(START + int(i) * SECOND, tz='UTC').isoformat()},{v:.2f},{s:.1f}"
        for i, v, s in zip(seconds, dead, position, strict=True)
    ]
    trip = read_plain(tmp_path, rows)
    state = trip["/train/state"]
    assert state["speed"].iloc[302:420].isna().all()
    assert state["speed"].iloc[:60].notna().all()
    assert state["position"].notna().all()
