"""Fits of simulated trips against their truth: FLIRT on St.Gallen-Wil, twelve trips a seed.

    python benchmarks/identification/benchmark_simulated.py [--seeds 5] [--trips 12]

Errors are relative, root mean square from 5 m/s to the line speed. Under "curve" is the share of
trips whose true curve lies inside the 95 % band at every one of these speeds, under "speed" the
share of speeds within 1.96 standard deviations. The variants show what the fit lives on.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from analysis.resistance import TripFit, combine, fit_trip, parameter_set
from trainlog.arrays import FloatArray
from trainlog.errors import NotIdentifiableError
from trainlog.formats.railway import line_to_bytes, read_line, read_train
from trainlog.formats.samples import sample
from trainlog.railway import Line, StepProfile
from trainlog.railway.resistance import basis
from trainlog.simulation import Scenario, draw_scenarios, simulate
from trainlog.trip import LINE_ATTACHMENT, Trip

Change = Callable[[Trip], Trip]


def unchanged(trip: Trip) -> Trip:
    return trip


def without(*topics: str) -> Change:
    return lambda trip: replace(
        trip, topics={name: frame for name, frame in trip.topics.items() if name not in topics}
    )


def controls_changed(**columns: float) -> Change:
    """Controls of which columns are multiplied."""

    def change(trip: Trip) -> Trip:
        frame = trip["/train/controls"]
        found = frame.assign(**{name: factor * frame[name] for name, factor in columns.items()})
        found.attrs = frame.attrs
        return trip.with_topic(found)

    return change


def mapped(line: Line) -> Change:
    """Another map: each gradient 0.5 per mille off, each change of gradient up to 20 m."""
    generator = np.random.default_rng(1)
    edges = line.gradients.positions.copy()
    free = 0.45 * np.minimum(np.diff(edges), np.append(np.diff(edges)[1:], 1e3))
    edges[1:] += generator.uniform(-1.0, 1.0, free.size) * np.minimum(20.0, free)
    slopes = line.gradients.values + 0.5e-3 * generator.standard_normal(edges.size)
    data = line_to_bytes(replace(line, gradients=StepProfile(edges, slopes)))
    return lambda trip: replace(trip, attachments={**trip.attachments, LINE_ATTACHMENT: data})


class Judge:
    """Collects fits of one variant and what was true."""

    def __init__(self, top: float) -> None:
        self.speed = np.linspace(5.0, top, 61)
        self.basis = basis(self.speed)
        self.errors: list[float] = []
        self.whole: list[bool] = []
        self.single: list[float] = []
        self.coefficients: list[FloatArray] = []
        self.together: list[float] = []
        self.configurations: list[float] = []
        self.power: list[float] = []
        self.reasons: list[str] = []

    def series(self, scenarios: list[Scenario], trips: list[Trip]) -> None:
        """Fit one series of trips, apart and together."""
        fits: list[TripFit] = []
        true: list[FloatArray] = []
        for scenario, trip in zip(scenarios, trips, strict=True):
            r = scenario.resistance
            try:
                fit = fit_trip(trip)
            except NotIdentifiableError as error:
                self.reasons.append(str(error))
                continue
            fits.append(fit)
            true.append(np.array([r.r0, r.r1, r.r2]))
            self.trip(fit, true[-1], scenario.mass)
            if fit.max_power is not None:
                self.power.append(100.0 * (fit.max_power / scenario.max_power - 1.0))
        if not fits:
            return
        mean = self.basis @ np.mean(true, axis=0)
        self.together.append(self.relative(combine(fits).resistance(self.speed), mean))
        chosen = parameter_set(fits, cover=1.0).configurations
        self.configurations += [
            self.relative(one.resistance(self.speed), self.basis @ beta)
            for one, beta in zip(chosen, true, strict=True)
        ]

    def trip(self, fit: TripFit, beta: FloatArray, mass: float) -> None:
        """Judge one fit."""
        curve = self.basis @ beta
        low, high = fit.band(self.speed)
        self.errors.append(self.relative(fit.resistance(self.speed), curve))
        self.whole.append(bool(np.all((low <= curve) & (curve <= high))))
        z = np.abs(fit.resistance(self.speed) - curve) / fit.std(self.speed)
        self.single.append(float(np.mean(z < 1.96)))
        deviation = np.sqrt(np.diag(fit.covariance))
        self.coefficients.append(np.abs(np.append(fit.beta - beta, fit.mass - mass)) / deviation)

    @staticmethod
    def relative(curve: FloatArray, true: FloatArray) -> float:
        """Relative error, root mean square [%]."""
        return float(100.0 * np.sqrt(np.mean((curve / true - 1.0) ** 2)))

    def line(self) -> str:
        """One row of the table."""
        if not self.errors:
            return f"all {len(self.reasons)} refused"
        inside = np.mean(np.array(self.coefficients) < 1.96, axis=0)
        return (
            f"{np.median(self.errors):7.2f}{np.quantile(self.errors, 0.9):7.2f}"
            f"{np.max(self.errors):7.2f}{np.median(self.configurations):8.2f}"
            f"{np.max(self.together):8.2f}{np.mean(self.whole):8.2f}{np.mean(self.single):8.3f}  "
            + " ".join(f"{share:.2f}" for share in inside)
            + f"{len(self.reasons):6d}/{len(self.reasons) + len(self.errors)}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--trips", type=int, default=12)
    arguments = parser.parse_args()
    line = read_line(sample("CH_StGallen_Wil.line.json"))
    train = read_train(sample("CH_Stadler_FLIRT_TPF.train.json"))
    top = float(line.speed_limits.values.max())
    variants: dict[str, Change] = {
        "as recorded": unchanged,
        "without satellites": without("/gnss/motion"),
        "without wheel speeds": without("/train/axles"),
        "brake effort 3 % too large": controls_changed(dynamic_braking_effort=1.03),
        "brakes not recorded": controls_changed(
            dynamic_braking_effort=np.nan, pneumatic_braking_effort=np.nan
        ),
        "map 0.5 per mille, 20 m off": mapped(line),
    }
    judges = {name: Judge(top) for name in variants}
    fitting = 0.0
    for seed in range(1, arguments.seeds + 1):
        scenarios = draw_scenarios(line, train, arguments.trips, seed)
        trips = [simulate(scenario) for scenario in scenarios]
        for name, change in variants.items():
            began = time.perf_counter()
            judges[name].series(scenarios, [change(trip) for trip in trips])
            fitting += time.perf_counter() - began
    print(
        f"{'':28s}{'error of one trip [%]':>21s}{'config.':>8s}{'all':>8s}  share in the 95 % band"
    )
    print(
        f"{'':28s}{'median':>7s}{'90 %':>7s}{'max':>7s}{'median':>8s}{'max':>8s}"
        f"{'curve':>8s}{'speed':>8s}  r0   r1   r2   mass  refused"
    )
    for name, judge in judges.items():
        print(f"{name:28s}{judge.line()}")
    for reason in judges["as recorded"].reasons:
        print(f"refused: {reason}")
    power = np.array(judges["as recorded"].power)
    if power.size:
        print(f"power limit found on {power.size} trips, at most {np.abs(power).max():.2f} % off")
    count = len(variants) * arguments.seeds * arguments.trips
    print(f"{fitting / count:.2f} s a fit")


if __name__ == "__main__":
    main()
