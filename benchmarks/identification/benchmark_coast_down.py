"""Coast-down of simulated trips without efforts against their truth, beside a usual way to do it.

    python benchmarks/identification/benchmark_coast_down.py [--seeds 1] [--trips 20]

FLIRT on St.Gallen-Wil, drivers who coast now and then and hold their speed otherwise; loads,
resistances, drivers differ from trip to trip, the map's gradients are 0.1 per mille off. Error is
that of the curve over inertia against the mean of the true ones, root mean square over the speeds
that the result supports; "in band" the share of results whose whole true curve lies in the 95 %
band. Recall is the time found of all coasting of 8 s and more, precision the time without effort of
all that was found; in brackets with less than 0.005 m/s² of effort.

The peer fits the closed form of coasting down (scipy's least_squares, one curve, a free initial
speed and the mean gradient for each segment) to the speeds of the same segments.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_array

from analysis.resistance.coast_down import CoastDown, TripCoastDown, coast_down
from trainlog.arrays import BoolArray, FloatArray
from trainlog.errors import NotIdentifiableError
from trainlog.formats.railway import line_of, read_line, read_train
from trainlog.formats.samples import sample
from trainlog.simulation import Scenario, draw_scenarios, simulate
from trainlog.topics import GNSS_MOTION
from trainlog.trip import Trip, frame_of, seconds

Trips = list[tuple[Scenario, Trip]]

RATIO = 0.917
"""Mass over inertia that the peer is given: that of the half-loaded train."""


def wheels(trip: Trip, _: int) -> Trip:
    """As recorded, without the efforts."""
    kept = ("/train/state", "/gnss/motion", "/truth", "/train/controls")
    return replace(trip, topics={name: trip[name] for name in kept})


def satellites(rate: int) -> Callable[[Trip, int], Trip]:
    """No speed but a receiver's, so many a second, noise 0.08 m/s."""

    def change(trip: Trip, seed: int) -> Trip:
        truth = trip["/truth"].iloc[:: 10 // rate]
        noise = 0.08 * np.random.default_rng(seed).standard_normal(len(truth))
        speed = np.round(np.abs(truth["speed"].to_numpy() + noise), 3)
        motion = frame_of(GNSS_MOTION, truth.index, {"speed": speed})
        state = trip["/train/state"].assign(speed=np.nan)
        state.attrs = trip["/train/state"].attrs
        topics = {name: trip[name] for name in ("/truth", "/train/controls")}
        return replace(trip, topics={**topics, "/gnss/motion": motion, "/train/state": state})

    return change


def true_curve(scenario: Scenario, speed: FloatArray) -> FloatArray:
    return scenario.resistance(speed) / (scenario.mass + scenario.rotating_mass)


def davis(at: FloatArray, start: FloatArray, curve: FloatArray) -> FloatArray:
    """Speed after coasting for `at`, dv/dt = -(c0 + c1 v + c2 v²), whatever the discriminant.

    `curve` (3, n) is c0, c1, c2 of each sample.
    """
    c0, c1, c2 = curve
    root = np.sqrt((c1**2 - 4.0 * c0 * c2).astype(np.complex128)) + 1e-12
    y, turn = 2.0 * c2 * start + c1, np.tanh(0.5 * root * at)
    return np.asarray(((root * (y + root * turn) / (root + y * turn)).real - c1) / (2.0 * c2))


def averaged(values: FloatArray, count: int) -> FloatArray:
    """Means of so many neighbouring samples each."""
    return np.asarray(values[: values.size // count * count].reshape(-1, count).mean(axis=1))


def peer(fits: tuple[TripCoastDown, ...], trips: Trips) -> FloatArray:
    """c0, c1, c2 of the closed form that fits the speeds of all segments best, a mean each second.

    Each residual knows c0, c1, c2 and its own segment's first speed only: a sparse Jacobian.
    """
    lines = {scenario.name: line_of(trip) for scenario, trip in trips}
    times, speeds, slopes = [], [], []
    for fit in fits:
        motion = fit.motion
        each = max(round(1.0 / motion.period), 1)
        for segment in fit.segments:
            inside = (motion.time >= segment.start) & (motion.time <= segment.end)
            inside &= motion.usable
            if np.count_nonzero(inside) < 5 * each:
                continue
            place = motion.position[inside]
            slopes.append(RATIO * float(np.mean(lines[fit.trip].track_acceleration(place))))
            times.append(averaged(motion.time[inside] - segment.start, each))
            speeds.append(averaged(motion.speed[inside], each))
    owner = np.repeat(np.arange(len(times)), [time_.size for time_ in times])
    at, speed = np.concatenate(times), np.concatenate(speeds)
    slope = np.array(slopes)[owner]
    units = np.array([1e-2, 1e-3, 1e-4])

    def residual(p: FloatArray) -> FloatArray:
        curve = np.repeat((p[:3] * units)[:, None], at.size, axis=1)
        curve[0] += slope
        return speed - davis(at, p[3:][owner], curve)

    knows = lil_array((at.size, 3 + len(times)), dtype=np.int8)
    knows[:, :3] = 1
    knows[np.arange(at.size), 3 + owner] = 1
    first = np.concatenate(([1.4, 0.5, 0.5], [values[0] for values in speeds]))
    low = np.concatenate(([0.0, 0.0, 1e-3], np.zeros(len(times))))
    found = least_squares(
        residual,
        first,
        bounds=(low, np.inf),
        jac_sparsity=knows,
        x_scale="jac",
        loss="soft_l1",
        f_scale=0.1,
        max_nfev=60,
    )
    return np.asarray(found.x[:3] * units)


@dataclass
class Tally:
    """Results of one variant and number of trips."""

    errors: list[float] = field(default_factory=list)
    inside: list[bool] = field(default_factory=list)
    peers: list[float] = field(default_factory=list)
    found: FloatArray = field(default_factory=lambda: np.zeros(5))
    refused: int = 0
    seconds: float = 0.0

    def add(self, trips: Trips) -> None:
        """Judge one series."""
        began = time.process_time()
        try:
            result = coast_down([trip for _, trip in trips])
        except NotIdentifiableError:
            self.refused += 1
            return
        finally:
            self.seconds += time.process_time() - began
        assert result.curve.supported is not None
        speed = np.linspace(*result.curve.supported, 41)
        names = {fit.trip for fit in result.trips}
        used = [(scenario, trip) for scenario, trip in trips if scenario.name in names]
        true = np.mean([true_curve(scenario, speed) for scenario, _ in used], axis=0)
        low, high = result.curve.band(speed)
        self.errors.append(rms(result.curve(speed), true))
        self.inside.append(bool(np.all((low <= true) & (true <= high))))
        c = peer(result.trips, used)
        self.peers.append(rms(c[0] + (c[1] + c[2] * speed) * speed, true))
        self.detected(result, used)

    def detected(self, result: CoastDown, trips: Trips) -> None:
        """Count time that coasted and was found, coasted, was found and had no, little effort."""
        by_name = {fit.trip: fit for fit in result.trips}
        for scenario, trip in trips:
            fit, controls = by_name[scenario.name], trip["/train/controls"]
            at = seconds(controls, fit.motion.start)
            columns = ("tractive_effort", "dynamic_braking_effort", "pneumatic_braking_effort")
            pull, *brakes = (controls[name].to_numpy() for name in columns)
            effort = np.abs(pull - sum(brakes)) / (scenario.mass + scenario.rotating_mass)
            coasting = (effort < 1e-3) & (trip["/truth"]["speed"].to_numpy() > 5.0)
            marked = np.zeros(at.size, dtype=bool)
            for segment in fit.segments:
                marked |= (at >= segment.start) & (at <= segment.end)
            lasting = runs(coasting, at, 8.0)
            self.found += [
                np.sum(marked & lasting),
                np.sum(lasting),
                np.sum(marked & coasting),
                np.sum(marked & (effort < 5e-3)),
                np.sum(marked),
            ]

    def line(self) -> str:
        """One row of the table."""
        total = self.refused + len(self.errors)
        if not self.errors:
            return f"all {total} refused"
        found, long, right, little, marked = self.found
        return (
            f"{np.median(self.errors):8.2f}{np.max(self.errors):8.2f}{np.mean(self.inside):9.2f}"
            f"{np.median(self.peers):9.2f}{np.max(self.peers):8.2f}{found / long:9.2f}"
            f"{right / marked:8.2f} ({little / marked:.2f}){self.refused:6d}/{total}"
            f"{self.seconds / total:8.2f}"
        )


def rms(found: FloatArray, true: FloatArray) -> float:
    """Relative error, root mean square [%]."""
    return float(100.0 * np.sqrt(np.mean((found / true - 1.0) ** 2)))


def runs(mask: BoolArray, at: FloatArray, least: float) -> BoolArray:
    """The mask without its runs shorter than `least` [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(np.int8), [0]))))
    kept = np.zeros(mask.size, dtype=bool)
    for first, last in zip(edges[::2], edges[1::2] - 1, strict=True):
        kept[first : last + 1] = at[last] - at[first] >= least
    return kept


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--trips", type=int, default=20)
    arguments = parser.parse_args()
    line = read_line(sample("CH_StGallen_Wil.line.json"))
    train = read_train(sample("CH_Stadler_FLIRT_TPF.train.json"))
    variants = {
        "wheels, 10 Hz": wheels,
        "satellites, 10 Hz": satellites(10),
        "satellites, 5 Hz": satellites(5),
        "satellites, 1 Hz": satellites(1),
    }
    sizes = [size for size in (1, 5, 20) if size <= arguments.trips]
    tallies = {(name, size): Tally() for name in variants for size in sizes}
    for seed in range(1, arguments.seeds + 1):
        drawn = draw_scenarios(line, train, arguments.trips, seed)
        trips = [simulate(scenario) for scenario in drawn]
        for name, change in variants.items():
            changed = [
                (scenario, change(trip, number))
                for number, (scenario, trip) in enumerate(zip(drawn, trips, strict=True))
            ]
            for size in sizes:
                for first in range(0, arguments.trips - size + 1, size):
                    tallies[name, size].add(changed[first : first + size])
    print(f"{'':31s}{'error [%]':>16s}{'in':>9s}{'peer [%]':>17s}{'':>9s}")
    print(
        f"{'':25s}{'trips':>6s}{'median':>8s}{'max':>8s}{'band':>9s}{'median':>9s}{'max':>8s}"
        f"{'recall':>9s}{'precision':>15s}{'refused':>9s}{'CPU s':>8s}"
    )
    for (name, size), tally in tallies.items():
        print(f"{name:25s}{size:6d}{tally.line()}")


if __name__ == "__main__":
    main()
