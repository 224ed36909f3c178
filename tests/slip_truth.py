"""Simulated trips with what no sensor shows: when the wheels truly slipped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from analysis.adhesion.slip import SlipAnalysis, slip
from estimators.slip import SlipDetector
from trainlog.arrays import FloatArray
from trainlog.simulation import Scenario, drive, recorded
from trainlog.simulation.recording import Run
from trainlog.spans import runs_of
from trainlog.trip import Trip


@dataclass(frozen=True, eq=False)
class Seen:
    """A trip, its analysis, and the true train speed and slip speeds at the axles' samples."""

    scenario: Scenario
    trip: Trip
    found: SlipAnalysis
    speed: FloatArray
    slip: FloatArray


def seen(scenario: Scenario) -> Seen:
    run = drive(scenario)
    trip = recorded(scenario, run)
    names = scenario.plant().columns
    speed = run.samples[:, names.index("speed")]
    wheels = run.samples[:, [i for i, n in enumerate(names) if n.startswith("wheel_speed_")]]
    return Seen(scenario, trip, slip(trip), speed, wheels - speed[:, None])


@dataclass
class Score:
    """Slips reported and true; those within 0.15 m/s of the threshold may be either."""

    true: int = 0
    missed: int = 0
    reported: int = 0
    false: int = 0

    def count(self, each: Seen, margin: float = 0.15) -> None:
        truly = SlipDetector(each.slip.shape[1], 0.0).update(each.slip)
        for axle in range(each.slip.shape[1]):
            size, reported = np.abs(each.slip[:, axle]), each.found.slipping[:, axle]
            for a, b in runs_of(truly[:, axle]):
                if size[a:b].max() > 1.5 + margin:
                    self.true += 1
                    self.missed += not reported[a:b].any()
            for a, b in runs_of(reported):
                self.reported += 1
                self.false += bool(size[max(a - 1, 0) : b + 1].max() < 1.5 - margin)

    @property
    def recall(self) -> float:
        return 1.0 - self.missed / max(self.true, 1)

    @property
    def precision(self) -> float:
        return 1.0 - self.false / max(self.reported, 1)


def onset_errors(each: Seen) -> FloatArray:
    """Error of the adhesion at the onsets that measured it, against the truth at their places."""
    events = each.found.events[each.found.events["measured"]]
    truth = each.scenario.maximum_adhesion(events["position"].to_numpy())
    return np.asarray(events["adhesion"].to_numpy() - truth)


FINE = 200
"""Samples a second of the truth about the heat of a slip."""


@dataclass(frozen=True, eq=False)
class Fine:
    """A trip at the sensors' own rate, and the true slip power of each axle [W] at `FINE` Hz.

    The force between wheel and rail is what is left of the motor's effort when the wheel has been
    turned faster, so that it does not depend on the plant's law of adhesion.
    """

    scenario: Scenario
    trip: Trip
    power: FloatArray

    @staticmethod
    def of(scenario: Scenario) -> Fine:
        every = FINE // scenario.sensors.rate
        run = drive(replace(scenario, sensors=replace(scenario.sensors, rate=FINE)))
        coarse = Run(run.seconds[::every], run.samples[::every], run.demands[::every])
        power = slip_power(scenario, run.seconds, run.samples)
        return Fine(scenario, recorded(scenario, coarse), power)

    def heats(self, spoilt: Callable[[Trip], Trip] = lambda trip: trip) -> pd.DataFrame:
        """Energy, its standard deviation and the truth of each event of the trip as recorded."""
        found = slip(spoilt(self.trip))
        events = found.events.copy()
        begin = pd.DatetimeIndex(self.trip["/train/axles"].index)[0]
        last, start, onset = (
            np.round((events[name] - begin).dt.total_seconds().to_numpy() * FINE).astype(int)
            for name in ("release", "start", "onset")
        )
        first = np.minimum(start, onset)
        events["truth"] = [
            np.trapezoid(self.power[a : b + 1, axle - 1], dx=1.0 / FINE)
            for a, b, axle in zip(first, last, events["axle"], strict=True)
        ]
        return events


def slip_power(scenario: Scenario, seconds: FloatArray, samples: FloatArray) -> FloatArray:
    """Force between wheel and rail times slip speed [W], (n, axles)."""
    names = scenario.plant().columns
    wheels, efforts = (
        samples[:, [i for i, name in enumerate(names) if name.startswith(kind)]]
        for kind in ("wheel_speed_", "wheel_effort_")
    )
    force = efforts - scenario.train.axles.rotating_mass * np.gradient(wheels, seconds, axis=0)
    return np.asarray(force * (wheels - samples[:, [names.index("speed")]]))
