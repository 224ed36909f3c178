"""What a trip along a trajectory came to, by its true motion: for benchmarks and tests."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trainlog.simulation import Scenario
from trainlog.simulation.drivers import DEPARTURE, PERIOD
from trainlog.simulation.recording import Run


class Outcome(NamedTuple):
    """What a trip along a trajectory came to, by its true motion.

    Attributes
    ----------
    late : float [s]
        At its arrival, behind the timetable.
    excess_work : float
        At the wheels, over that planned for its configuration; relative.
    overspeed : float [m/s]
        Over the line's limits, at most; negative where it stays below.
    off_stop : float [m]
        Beyond the stop.
    slips : int
        How often the slip protection acted.
    """

    late: float
    excess_work: float
    overspeed: float
    off_stop: float
    slips: int


def outcome(scenario: Scenario, run: Run) -> Outcome:
    """What a trip along a trajectory came to; see `trainlog.simulation.drive`."""
    plan, line = scenario.trajectory, scenario.travelled
    assert plan is not None
    found = dict(zip(scenario.plant().columns, run.samples.T, strict=True))
    speed, position = found["speed"], found["position"]
    arrival = float(run.seconds[np.flatnonzero(speed > 0.0)[-1]]) + PERIOD - DEPARTURE
    work = float(found["tractive_effort"] @ speed) * PERIOD
    limit = line.speed_limit(np.minimum(position, line.length))
    return Outcome(
        arrival - plan.running_time,
        work / plan.certificate["wheel_energy"][scenario.row] - 1.0,
        float(np.max(speed - limit)),
        float(position[-1] - plan.positions[-1]),
        int(np.sum(np.diff((found["protected_axles"] > 0.0).astype(int)) > 0)),
    )
