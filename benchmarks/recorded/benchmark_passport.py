"""How far the passport of a trip is from the truth, in units of what it states.

    python benchmarks/recorded/benchmark_passport.py [--published ../shared/data/ttobench]
        [--trips 60] [--workers 2] [--passport-only]

Trips of three trains on three lines whose running resistance is up to 20 % off the train's file,
with noise that lasts (speeds, efforts), efforts that are late by 0 to 1 s and wrong by up to 10 %,
any load, recorded at 1 to 100 Hz, the load weighed or not. A row a quantity and rate: trips in
which it is given, how often it is estimated, median error, root mean square of the error over the
stated standard deviation, and share in the 95 % band. Last the same for the curve of running
resistance and the mass that `fit_trip` gives of these trips.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
from recordings import PAIRS, line_and_train

from analysis.resistance import fit_trip
from analysis.resistance.passport import estimated_passport
from trainlog.errors import TrainlogError
from trainlog.railway import RunningResistance
from trainlog.simulation import Sensors, draw_scenarios, simulate
from trainlog.simulation.sensors import correlated
from trainlog.trip import Trip, seconds

RATES = (1, 2, 5, 10, 100)
"""Samples a second of the recorded trips."""

Row = tuple[str, float, float, bool, float]
"""Quantity, error, stated standard deviation, whether it was estimated, whether the band holds."""


def changed(trip: Trip, topic: str, columns: dict[str, np.ndarray], every: int) -> Trip:
    """The trip with other values in a topic, and only every so many rows of it."""
    frame = trip[topic]
    found = frame.assign(**columns).iloc[every - 1 :: every]
    found.attrs = frame.attrs
    return trip.with_topic(found)


def recorded(trip: Trip, rate: int, gain: float, delay: float, rng: np.random.Generator) -> Trip:
    """What a recorder with these defects keeps of a trip."""
    state, axles = trip["/train/state"], trip["/train/axles"]
    time = seconds(state)
    period, count = float(np.median(np.diff(time))), len(state)
    every = round(1.0 / (rate * period))
    moving = state["speed"].to_numpy() > 0.0

    def lasting(std: float, memory: float) -> np.ndarray:
        return std * correlated(count, period, memory, rng)

    speeds = {"speed": state["speed"] + moving * lasting(rng.uniform(0.0, 0.05), 1.0)}
    wheels = {
        name: axles[name] + moving * lasting(0.03, 2.0)
        for name in axles.columns
        if name.startswith("wheel_speed")
    }
    slow = gain * (1.0 + lasting(0.01, 30.0))

    def late(topic: str, *begins: str) -> dict[str, np.ndarray]:
        frame = trip[topic]
        names = [n for n in frame.columns if n.startswith(begins) and not n.endswith("demand")]
        return {n: np.interp(time - delay, time, slow * frame[n].to_numpy()) for n in names}

    efforts = late("/train/controls", "tractive", "dynamic", "pneumatic")
    found = changed(trip, "/train/controls", efforts, every)
    found = changed(found, "/train/axles", wheels | late("/train/axles", "wheel_effort"), every)
    return changed(found, "/train/state", speeds, every)


def row(name: str, error: float, std: float = np.nan, estimated: bool = True) -> Row:
    return name, error, std, estimated, float(abs(error) < 1.96 * std)


def judged(task: tuple[int, Path, bool]) -> list[Row]:
    """What one trip shows."""
    seed, published, alone = task
    rng = np.random.default_rng([seed, 41])
    line, train = line_and_train(seed % len(PAIRS), published)
    rate = RATES[(seed // 3) % len(RATES)]
    weighed = bool((seed // 15) % 2)
    sensors = Sensors(rate=max(rate, 10), load_error=0.025 if weighed else None)
    scenario = draw_scenarios(line, train, 8, seed=1000 + seed, sensors=sensors)[seed % 8]
    factor = rng.uniform(0.8, 1.2, 3)
    nominal = train.resistance
    curve = RunningResistance(*(np.array([nominal.r0, nominal.r1, nominal.r2]) * factor).tolist())
    load = rng.uniform(0.0, train.max_load or 0.2 * train.mass)
    scenario = replace(scenario, mass=train.mass + load, resistance=curve)
    gain, delay = rng.uniform(0.9, 1.1), rng.uniform(0.0, 1.0)
    trip = recorded(simulate(scenario), rate, gain, delay, rng)
    known = "weighed" if weighed else "load unknown"
    begin = perf_counter()
    found = estimated_passport(trip)
    rows = [row("seconds", perf_counter() - begin)]
    true = {
        "effort_delay": delay,
        "effort_gain": gain,
        "effort_over_mass": gain * scenario.mass / train.mass,
        "load": load,
    }
    for name, value in true.items():
        each = getattr(found, name)
        group = f"{rate:3d} Hz" if name in ("effort_delay", "effort_over_mass") else known
        error = each.value - value
        rows.append(row(f"{name}, {group}", error, each.std, each.source == "estimated"))
    ratio = found.axle_effort_ratio
    rows.append(row("axle_effort_ratio", ratio.value - 1.0, ratio.std))
    if alone:
        return rows
    try:
        fit = fit_trip(trip)
    except TrainlogError as error:
        reason = getattr(error, "reason", "error")
        return [*rows, row(f"fit refused: {reason}", np.nan), row(f"fit, {rate:3d} Hz", np.nan)]
    speeds = np.linspace(*fit.asked, 30)
    true_curve = curve(speeds)
    low, high = fit.band(speeds)
    whole = float(np.all((low <= true_curve) & (true_curve <= high)))
    error = float(np.sqrt(np.mean((fit.resistance(speeds) / true_curve - 1.0) ** 2)))
    std = float(np.mean(fit.std(speeds) / true_curve))
    rows += [(f"fit, {name}", error, std, True, whole) for name in (f"{rate:3d} Hz", known)]
    for k, name in enumerate(("r0", "r1", "r2")):
        off = float(fit.beta[k] - (curve.r0, curve.r1, curve.r2)[k])
        rows.append(row(f"fit: {name}", off, float(np.sqrt(fit.covariance[k, k]))))
    return [*rows, row(f"fit: mass, {known}", fit.mass - scenario.mass, fit.mass_std)]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--published", type=Path, default=Path("../shared/data/ttobench"))
    parser.add_argument("--trips", type=int, default=60)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--passport-only", action="store_true", help="do not fit the trips")
    options = parser.parse_args()
    found: dict[str, list[tuple[float, float, bool, float]]] = defaultdict(list)
    with ProcessPoolExecutor(options.workers) as pool:
        tasks = [(k, options.published, options.passport_only) for k in range(options.trips)]
        for rows in pool.map(judged, tasks):
            for name, *values in rows:
                found[name].append(tuple(values))
    heading = ("trips", "given", "estim.", "median", "std", "rms/std", "in band")
    print(f"{'quantity':32}" + "".join(f"{word:>10}" for word in heading))
    for name in sorted(found):
        error, std, estimated, inside = np.array(found[name], dtype=float).T
        given = np.isfinite(error)
        cells = [error.size, given.mean(), estimated.mean(), *(4 * [np.nan])]
        if given.any():
            over = np.sqrt(np.mean((error[given] / std[given]) ** 2))
            cells[3:] = np.median(np.abs(error[given])), np.median(std[given]), over, 0.0
            cells[6] = inside[given].mean() if np.isfinite(over) else np.nan
        print(f"{name:32}" + "".join("-".rjust(10) if np.isnan(c) else f"{c:10.4g}" for c in cells))
    return 0


if __name__ == "__main__":
    sys.exit(main())
