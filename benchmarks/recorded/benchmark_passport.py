"""How far the passport of a trip is from the truth, in units of what it states.

    python benchmarks/recorded/benchmark_passport.py [--published ../shared/data/ttobench]
        [--trips 40] [--workers 2]

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

from analysis.passports import estimated_passport
from analysis.resistance import fit_trip
from trainlog.errors import TrainlogError
from trainlog.railway import RunningResistance
from trainlog.simulation import Sensors, draw_scenarios, simulate
from trainlog.simulation.sensors import correlated
from trainlog.trip import Trip, seconds

RATES = (1, 2, 5, 10, 100)
"""Samples a second of the recorded trips."""

EFFORTS = ("tractive_effort", "dynamic_braking_effort", "pneumatic_braking_effort")


def changed(trip: Trip, topic: str, columns: dict[str, np.ndarray], every: int) -> Trip:
    """The trip with other values in a topic, and only every so many rows of it."""
    frame = trip[topic]
    found = frame.assign(**columns).iloc[every - 1 :: every]
    found.attrs = frame.attrs
    return trip.with_topic(found)


def recorded(trip: Trip, rate: int, gain: float, delay: float, rng: np.random.Generator) -> Trip:
    """What a recorder with these defects keeps of a trip."""
    state, controls, axles = (trip[f"/train/{name}"] for name in ("state", "controls", "axles"))
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
    late = {
        name: np.interp(time - delay, time, slow * frame[name].to_numpy())
        for frame, names in (
            (controls, EFFORTS),
            (axles, [f"wheel_effort_{i + 1}" for i in range(len(wheels))]),
        )
        for name in names
    }
    trip = changed(trip, "/train/controls", {n: late[n] for n in EFFORTS}, every)
    trip = changed(
        trip, "/train/axles", wheels | {n: v for n, v in late.items() if n[:5] == "wheel"}, every
    )
    return changed(trip, "/train/state", speeds, every)


def judged(task: tuple[int, Path]) -> list[tuple[str, float, float, bool]]:
    """(quantity, error, stated standard deviation, estimated) of one trip."""
    seed, published = task
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
    rows = [("seconds", perf_counter() - begin, np.nan, True)]
    true = {
        "effort_delay": delay,
        "effort_gain": gain,
        "effort_over_mass": gain * scenario.mass / train.mass,
        "load": load,
    }
    for name, value in true.items():
        each = getattr(found, name)
        group = f"{rate:3d} Hz" if name in ("effort_delay", "effort_over_mass") else known
        rows.append((f"{name}, {group}", each.value - value, each.std, each.source == "estimated"))
    rows.append(
        (
            "axle_effort_ratio",
            found.axle_effort_ratio.value - 1.0,
            found.axle_effort_ratio.std,
            True,
        )
    )
    try:
        fit = fit_trip(trip)
    except TrainlogError as error:
        return [
            *rows,
            (f"fit, {rate:3d} Hz", np.nan, np.nan, False),
            (f"refused: {getattr(error, 'reason', error)}", np.nan, np.nan, False),
        ]
    speeds = np.linspace(*fit.asked, 30)
    error = fit.resistance(speeds) - curve(speeds)
    low, high = fit.band(speeds)
    worst = np.max(np.maximum(low - curve(speeds), curve(speeds) - high))
    relative = float(np.sqrt(np.mean((error / curve(speeds)) ** 2)))
    width = float(np.mean(high - low) / np.mean(curve(speeds)) / 3.92)
    # In its band as a whole or not: written as an error of none or of ten standard deviations.
    rows += [
        (f"fit, {rate:3d} Hz", relative, width * (1e3 if worst <= 0 else 1e-3), True),
        (f"fit, {known}", relative, width * (1e3 if worst <= 0 else 1e-3), True),
        ("fit width", width, np.nan, True),
        (f"mass of the fit, {known}", fit.mass - scenario.mass, fit.mass_std, True),
    ]
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--published", type=Path, default=Path("../shared/data/ttobench"))
    parser.add_argument("--trips", type=int, default=60)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    found: dict[str, list[tuple[float, float, bool]]] = defaultdict(list)
    with ProcessPoolExecutor(options.workers) as pool:
        for rows in pool.map(judged, [(k, options.published) for k in range(options.trips)]):
            for name, error, std, estimated in rows:
                found[name].append((error, std, estimated))
    print(
        f"{'quantity':32} {'trips':>5} {'given':>6} {'estim.':>6} {'median':>9} {'std':>9} {'rms/std':>8} {'in band':>8}"
    )
    for name in sorted(found):
        error, std, estimated = (
            np.array(column, dtype=float) for column in zip(*found[name], strict=True)
        )
        given = np.isfinite(error)
        if not given.any():
            print(f"{name:32} {error.size:5d}")
            continue
        over = error[given] / std[given]
        inside = np.mean(np.abs(over) < 1.96) if np.isfinite(over).any() else np.nan
        print(
            f"{name:32} {error.size:5d} {given.mean():6.2f} {estimated.mean():6.2f}"
            f" {np.median(np.abs(error[given])):9.4g} {np.median(std[given]):9.4g}"
            f" {np.sqrt(np.mean(over**2)):8.2f} {inside:8.2f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
