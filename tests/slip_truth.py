"""Simulated trips with what no sensor shows: when the wheels truly slipped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.adhesion.slip import SlipAnalysis, slip
from estimators.slip import SlipDetector
from trainlog.simulation import Scenario, drive, recorded
from trainlog.spans import runs_of
from trainlog.trip import Trip

FloatArray = NDArray[np.float64]


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
