"""The train-state filter on simulated trips: errors against the truth, and its speed.

    python benchmarks/estimators/benchmark_train_state.py [--trips 8] [--picture slip.png]

A FLIRT on eleven hilly kilometres with a tunnel, dry and wet; on wet rail all powered axles slip
together for an eighth of the time. The map's gradients are wrong by 1.5 per mille every 500 m.
Satellites are lost in the tunnel and at random; "60 s lost" takes them away for another minute
of every four. "All wheels" is filterpy's KalmanFilter over the same model, which believes every
wheel as far as its creep allows: the peer without slip-awareness, and the peer in speed. In
brackets stands the share of samples within 1.96 standard deviations.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from estimators.kalman import STATES
from estimators.train_state import TrainStateFilter, TrainStates
from estimators.train_state_recursion import CREEP, CREEP_FLOOR, CREEP_TIME
from trainlog.railway import StepProfile
from trainlog.resampling import interpolated
from trainlog.simulation import Scenario, draw_scenarios, drive, recorded
from trainlog.simulation.sensors import correlated
from trainlog.units import KMH

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from simulated_world import flirt, hilly_line

FloatArray = NDArray[np.float64]
AXLES = 4
START = 50
"""First samples that are not judged."""


@dataclass(frozen=True, eq=False)
class Driven:
    """A trip's measurements on one clock, and what was true.

    ``truth`` (n, 4) is position, speed, acceleration and gradient offset; ``slip`` (n, axles) the
    wheels' speeds less the train's.
    """

    time: FloatArray
    position: FloatArray
    speed: FloatArray
    expected: FloatArray
    wheels: FloatArray
    truth: FloatArray
    slip: FloatArray

    def z(self, *left_out: str, lost: float = 0.0) -> FloatArray:
        """Measurements, some of them left out, satellites for `lost` of every 240 s."""
        seen = self.time % 240.0 >= lost
        return TrainStateFilter(AXLES).measurements(
            self.time,
            position=np.where(seen & ("satellites" not in left_out), self.position, np.nan),
            speed=np.where(seen & ("satellites" not in left_out), self.speed, np.nan),
            expected_acceleration=np.nan if "efforts" in left_out else self.expected,
            wheel_speed=np.nan if "wheels" in left_out else self.wheels,
        )


def driven(scenario: Scenario, seed: int) -> Driven:
    """Drive and measure."""
    generator = np.random.default_rng(seed)
    edges = np.arange(0.0, scenario.line.length, 500.0)
    wrong = StepProfile(edges, 1.5e-3 * generator.standard_normal(edges.size))
    scenario = replace(scenario, survey_error=wrong)
    run = drive(scenario)
    trip, names = recorded(scenario, run), scenario.plant().columns
    position, speed = (run.samples[:, names.index(name)] for name in ("position", "speed"))
    index = pd.DatetimeIndex(trip["/train/axles"].index)
    wheels = trip["/train/axles"].filter(like="wheel_speed").to_numpy(np.float64)
    motion = trip["/gnss/motion"]
    at = index.get_indexer(
        pd.DatetimeIndex(motion.index), method="nearest", tolerance=pd.Timedelta("50ms")
    )
    satellite = np.full(len(index), np.nan)
    satellite[at[at >= 0]] = motion["speed"].to_numpy()[at >= 0]
    count = len(index)
    chainage = position + 0.5 * generator.standard_normal(count)
    chainage += 2.5 * correlated(count, 0.1, 30.0, generator)
    line, mass = scenario.travelled, scenario.mass
    own = trip["/train/state"]["position"].to_numpy(np.float64)
    middle = np.nanmedian(wheels, axis=1)
    traction, *brakes = (
        interpolated(trip["/train/controls"], name, index)
        for name in ("tractive_effort", "dynamic_braking_effort", "pneumatic_braking_effort")
    )
    train = scenario.train
    drag = train.resistance(middle) + train.track_force(line, own, mass)
    drag += train.tunnel_coefficient(line.tunnel_cross_section(own)) * middle**2
    expected = (traction - sum(brakes) - drag) / (mass + scenario.rotating_mass)
    offset = scenario.ground.gradient(position) - line.gradient(position)
    return Driven(
        time=run.seconds,
        position=np.where(np.isfinite(satellite), chainage, np.nan),
        speed=satellite,
        expected=np.where(middle > 1.0, expected, np.nan),
        wheels=wheels,
        truth=np.column_stack([position, speed, np.gradient(speed, run.seconds), offset]),
        slip=run.samples[:, [names.index(f"wheel_speed_{i + 1}") for i in range(AXLES)]]
        - speed[:, None],
    )


def new(trip: Driven) -> TrainStateFilter:
    return TrainStateFilter(AXLES, position=float(trip.truth[0, 0]), position_std=1.0)


def filtered(trip: Driven, z: FloatArray) -> TrainStates:
    return new(trip).update(z, trip.time)


def smooth(trip: Driven, z: FloatArray) -> TrainStates:
    return new(trip).smooth(z, trip.time)


def all_wheels(trip: Driven, z: FloatArray) -> TrainStates:
    """The same model by filterpy: every wheel holds, with the noise of creep at 0.3 m/s²."""
    model = new(trip)
    peer = KalmanFilter(dim_x=STATES, dim_z=z.shape[1])
    peer.x, peer.P = model.x[:, None], model.P
    model.predict(0.1)
    peer.F, peer.Q, noise = model.F, model.Q, np.diag(model.R).copy()
    lasting = (CREEP_FLOOR + 0.3 * CREEP) ** 2 * AXLES * 2.0 * CREEP_TIME / 0.1
    means, covariances = np.empty((len(z), STATES)), np.empty((len(z), STATES, STATES))
    for k, row in enumerate(z):
        if k > 0:
            peer.predict()
        known = ~np.isnan(row)
        shown = np.zeros((row.size, STATES))
        shown[0, [0, 4]], shown[1, 1] = (1.0, 2.5), 1.0
        shown[2, [2, 3]], shown[3, [2, 3, 6]] = (1.0, 9.81), (1.0, 9.81, 1.0)
        noise[4:] = 0.03**2 + lasting * np.minimum(np.nan_to_num(row[4:]) ** 2, 1.0)
        shown[4:, 1], shown[4:, 5] = 1.0, np.nan_to_num(row[4:])
        peer.dim_z = int(known.sum())
        if peer.dim_z:
            peer.update(row[known][:, None], R=np.diag(noise[known]), H=shown[known])
        means[k], covariances[k] = peer.x[:, 0], peer.P
    return TrainStates(means, covariances, np.zeros((len(z), AXLES), dtype=bool))


def row(name: str, trips: list[Driven], method: object, *left_out: str, lost: float = 0.0) -> None:
    """Print errors and coverage of one method with some of the measurements."""
    errors, stds, slips, told, true = [], [], [], [], []
    for trip in trips:
        states = method(trip, trip.z(*left_out, lost=lost))  # type: ignore[operator]
        error = states.means[:, :4] - trip.truth
        error[:, 3] = states.gradient_offset - trip.truth[:, 3]
        errors.append(error[START:])
        stds.append(states.std[START:])
        slips.append(error[np.any(np.abs(trip.slip) > 1.5, axis=1), 1])
        told.append(states.slipping)
        true.append(np.abs(trip.slip) > 1.5)
    error, std = np.concatenate(errors), np.concatenate(stds)
    known = np.isfinite(error)
    inside = np.abs(np.where(known, error, 0.0)) < 1.96 * std
    cells = []
    for column, (scale, digits) in enumerate(((1.0, 2), (1.0, 3), (1.0, 3), (1e3, 2))):
        use = known[:, column]
        if not use.any():
            cells.append("        -    ")
            continue
        size = scale * np.sqrt(np.mean(error[use, column] ** 2))
        cells.append(f"{size:8.{digits}f} ({np.mean(inside[use, column]):.2f})")
    slip = np.sqrt(np.mean(np.concatenate(slips) ** 2))
    flags, truly = np.concatenate(told), np.concatenate(true)
    recall = np.mean(flags[truly])
    print(f"{name:34s}" + "".join(f"{cell:>16s}" for cell in cells) + f"{slip:9.2f}{recall:9.2f}")


def speeds(trip: Driven) -> None:
    """Samples a second, against filterpy in the same run."""
    z = trip.z()
    filtered(trip, z)
    smooth(trip, z)
    found = {}
    for name, method, repeats in (("compiled", filtered, 5), ("filterpy", all_wheels, 1)):
        times = []
        for _ in range(repeats):
            began = time.process_time()
            method(trip, z)
            times.append(time.process_time() - began)
        found[name] = len(z) / min(times)
    print(
        f"\nsamples a second: compiled {found['compiled']:.0f}, filterpy {found['filterpy']:.0f}:"
    )
    print(f"{found['compiled'] / found['filterpy']:.0f} times as many")


def picture(trip: Driven, path: Path) -> None:
    """One trip through slip and outage."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    z = trip.z(lost=60.0)
    states, peer = filtered(trip, z), all_wheels(trip, z)
    figure, axes = plt.subplots(4, 1, figsize=(11, 11), sharex=True, layout="constrained")
    t = trip.time
    axes[0].plot(t, KMH * trip.wheels, color="0.75", lw=0.6)
    axes[0].plot(t, KMH * z[:, 1], ".", ms=2, color="tab:green", label="satellites")
    axes[0].plot(t, KMH * trip.truth[:, 1], "k", lw=2, label="true")
    axes[0].plot(t, KMH * peer.means[:, 1], color="tab:red", lw=0.8, label="all wheels believed")
    axes[0].plot(t, KMH * states.means[:, 1], color="tab:blue", lw=1.2, label="slip-aware")
    axes[0].set_ylabel("speed [km/h]; wheels grey")
    axes[0].legend(loc="upper right", ncols=4)
    for column, what, scale, axis in (
        (1, "speed [km/h]", KMH, axes[1]),
        (0, "position [m]", 1, axes[2]),
    ):
        std = 1.96 * scale * states.std[:, column]
        axis.fill_between(t, -std, std, color="tab:blue", alpha=0.25, lw=0, label="95 % band")
        for found, colour in ((peer, "tab:red"), (states, "tab:blue")):
            axis.plot(
                t, scale * (found.means[:, column] - trip.truth[:, column]), color=colour, lw=0.9
            )
        axis.set_ylabel(f"error of the {what}")
    axes[1].set_ylim(-15, 15)
    axes[2].set_ylim(-60, 60)
    for axis in axes[:3]:
        axis.fill_between(
            t, 0, 1, where=np.isnan(z[:, 1]) & (t % 0.2 < 0.05) | (t % 240 < 60), color="0.9",
            transform=axis.get_xaxis_transform(), lw=0, zorder=0,
        )  # fmt: skip
    axes[3].plot(t, 1e3 * trip.truth[:, 3], "k", lw=1.5, label="true")
    axes[3].plot(t, 1e3 * states.gradient_offset, color="tab:blue", label="filter")
    later = smooth(trip, z)
    axes[3].plot(t, 1e3 * later.gradient_offset, color="tab:orange", label="smoother")
    axes[3].set_ylabel("gradient offset [per mille]")
    axes[3].set_xlabel("time [s]; grey: no satellites")
    axes[3].legend(loc="upper right", ncols=3)
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trips", type=int, default=8)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    scenarios = draw_scenarios(hilly_line(), flirt(), options.trips, seed=1)
    trips = [driven(scenario, seed) for seed, scenario in enumerate(scenarios)]
    print(f"{'RMS error (within 1.96 std)':34s}{'position m':>16s}{'speed m/s':>16s}", end="")
    print(f"{'acceler. m/s²':>16s}{'offset ‰':>16s}{'in slip':>9s}{'recall':>9s}")
    row("everything", trips, filtered)
    row("everything, all wheels", trips, all_wheels)
    row("everything, smoothed", trips, smooth)
    row("no efforts", trips, filtered, "efforts")
    row("60 s lost", trips, filtered, lost=60.0)
    row("60 s lost, all wheels", trips, all_wheels, lost=60.0)
    row("60 s lost, smoothed", trips, smooth, lost=60.0)
    row("satellites only", trips, filtered, "wheels", "efforts")
    row("wheels and efforts", trips, filtered, "satellites")
    row("wheels and efforts, all wheels", trips, all_wheels, "satellites")
    row("wheels only", trips, filtered, "satellites", "efforts")
    row("wheels only, all wheels", trips, all_wheels, "satellites", "efforts")
    dry = [trip for trip in trips if np.mean(np.abs(trip.slip) > 1.5) < 0.02]
    row(f"wheels only, {len(dry)} dry trips", dry, filtered, "satellites", "efforts")
    offset = np.concatenate([trip.truth[:, 3] for trip in trips])
    print(f"rms of the true offset: {1e3 * np.sqrt(np.mean(offset**2)):.2f} ‰")
    speeds(trips[0])
    if options.picture:
        picture(trips[2], options.picture)


if __name__ == "__main__":
    main()
