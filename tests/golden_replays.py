"""The golden replays: every estimator and analysis, over the sample logs.

A replay takes a trip and gives its figures by name, numbers or arrays of them. A new estimator or
analysis adds one entry to `REPLAYS`; `pytest tests/test_golden.py --renew-golden` stores its
reference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

import trainlog
from analysis.adhesion.condition_map import empty_map, update
from analysis.adhesion.evidence import evidence_of
from analysis.adhesion.slip import slip
from analysis.comparison.groups import trip_cost
from analysis.estimates import with_estimates
from analysis.resistance.coast_down import coast_down
from analysis.resistance.fit import fit_trip
from analysis.resistance.recording import Prepared, prepare
from analysis.view import view_of
from estimators.adhesion import AdhesionObserver
from estimators.interface import EstimatorResult
from estimators.odometry import OdometryFilter
from estimators.rls import RecursiveLeastSquares, edges_crossed, record_with_resets
from estimators.slip import SlipDetector
from trainlog.arrays import FloatArray
from trainlog.formats.railway import line_of, train_of
from trainlog.formats.samples import folder
from trainlog.trip import Trip, seconds

Figures = Mapping[str, ArrayLike]

LOGS = ("nonstop", "stopping")


@dataclass(frozen=True)
class Replay:
    """What is run over a trip, and how far its figures may differ from the reference.

    Attributes
    ----------
    run : function
    tolerance : float
        Share of the largest value in a column of a figure.
    """

    run: Callable[[Trip], Figures]
    tolerance: float = 1e-6


@cache
def trip_of(name: str) -> Trip:
    return trainlog.read(folder() / f"{name}.mcap")


def prepared(trip: Trip) -> Prepared:
    return prepare(view_of(trip))


def reported(result: EstimatorResult) -> dict[str, ArrayLike]:
    """The figures that every estimator has."""
    return {
        "estimate": result.estimate,
        "covariance": result.covariance,
        "valid": result.valid,
        "excitation": result.excitation,
        "samples": result.samples,
        "resets": result.resets,
    }


def least_squares(trip: Trip) -> Figures:
    """Forces that resist, reset in part where the gradient changes."""
    ready, train = prepared(trip), train_of(trip)
    use = ready.usable
    inertia = train.mass + train.rotating_mass
    acceleration = np.gradient(ready.smooth, ready.time)
    force = ready.effort - inertia * acceleration - train.mass * ready.track
    rows = np.column_stack([np.ones(force.size), ready.smooth, ready.smooth**2])
    estimator = RecursiveLeastSquares(
        [1e4, 300.0, 10.0], forgetting=0.9999, random_walk_std=[1.0, 1e-3, 1e-5]
    )
    estimates, _ = record_with_resets(
        estimator,
        edges_crossed(line_of(trip).gradients.positions, ready.position)[use],
        rows[use],
        force[use],
        1e6,
        parameters=[0],
    )
    return {"course": estimates} | reported(estimator.result())


def odometry(trip: Trip) -> Figures:
    """From the speeds of wheels and satellites, which are lost for a minute."""
    state, motion = trip["/train/state"], trip["/gnss/motion"]
    time, instants = seconds(state), seconds(motion, trip["/train/state"].index[0])
    seen = np.full(time.size, np.nan)
    seen[np.clip(np.searchsorted(time, instants), 0, time.size - 1)] = motion["speed"]
    seen[(time > 300.0) & (time < 360.0)] = np.nan
    estimator = OdometryFilter()
    course = [
        estimator.update(now, wheel_speed=wheel, satellite_speed=satellite)
        for now, wheel, satellite in zip(time, state["speed"], seen, strict=True)
    ]
    every = course[::100]
    return {
        "course": np.array([each.estimate for each in every]),
        "std": np.array([[each.position_std, each.speed_std] for each in every]),
    } | reported(course[-1])


def wheels(trip: Trip) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time, wheel speeds and wheel efforts of the powered axles."""
    axles = trip["/train/axles"]
    speed, effort = (axles.filter(regex=name).to_numpy() for name in ("_speed_", "_effort_"))
    return seconds(axles), speed, effort


def slip_detector(trip: Trip) -> Figures:
    _, speed, _ = wheels(trip)
    detector = SlipDetector(speed.shape[1], 0.05)
    slipping = detector.update(speed - np.nanmin(speed, axis=1, keepdims=True))
    return {"slipping": np.sum(slipping, axis=0)} | reported(detector.result())


def adhesion_observer(trip: Trip) -> Figures:
    time, speed, effort = wheels(trip)
    train = train_of(trip)
    weight = train.adhesive_weight(0.0) / train.axles.count
    observer = AdhesionObserver(speed.shape[1], train.axles.rotating_mass, 0.03, 0.12 * weight)
    found = observer.update(time, speed, effort)
    return {"force": found.force, "std": found.std} | reported(observer.result())


def estimates(trip: Trip) -> Figures:
    """Smoothed motion, running resistance in its course, adhesion and slip as topics."""
    result, refusals = with_estimates(trip)
    topics = [topic for topic in result.topics if topic.startswith("/estimates/")]
    columns = {
        f"{topic}.{name}": values.to_numpy(np.float64)
        for topic in topics
        for name, values in result[topic].items()
    }
    return {"refusals": len(refusals)} | columns


def fit(trip: Trip) -> Figures:
    found = fit_trip(trip)
    curve = found.resistance
    speeds = np.linspace(*found.asked, 7)
    return {
        "curve": curve(speeds),
        "band": np.array([found.band(speed) for speed in speeds.tolist()]),
        "mass": found.mass,
        "std": np.sqrt(np.diag(found.covariance)),
        "condition": found.condition,
        "windows": list(found.windows.values()),
        "masked": list(found.masked.values()),
    }


def slip_events(trip: Trip) -> Figures:
    found = slip(trip)
    columns = ("axle", "position", "speed", "peak_slip", "adhesion", "adhesion_std", "measured")
    return {name: found.events[name].to_numpy(np.float64) for name in columns} | {
        "wheel_factor": found.wheel_factor,
        "speed_of_train": found.speed,
    }


def map_update(trip: Trip) -> Figures:
    empty = empty_map(line_of(trip))
    track, _ = update(empty, [evidence_of(slip(trip), empty, "dry")])
    layer = track.layers["dry"]
    return {
        "maximum_adhesion": np.exp(layer.log_mean),
        "log_std": layer.log_std,
        "observed": layer.observed,
        "events": layer.events,
    }


def cost(trip: Trip) -> Figures:
    reported = asdict(trip_cost(trip))
    return {name: value for name, value in reported.items() if isinstance(value, int | float)}


def coasting(trip: Trip) -> Figures:
    found = coast_down([trip])
    powers = np.linspace(*found.curve.covered, 7)[:, None] ** np.arange(3)
    return {
        "curve": powers @ found.curve.theta[1:],
        "std": np.sqrt(np.diag(found.curve.covariance)),
        "covered": found.curve.covered,
        "ratio": found.ratio.value,
        "evidence": found.evidence,
    }


REPLAYS: dict[str, Replay] = {
    "least squares": Replay(least_squares),
    "odometry": Replay(odometry),
    "slip detector": Replay(slip_detector),
    "adhesion observer": Replay(adhesion_observer),
    "estimates": Replay(estimates, 1e-4),
    "fit": Replay(fit, 1e-3),
    "coast-down": Replay(coasting, 1e-3),
    "slip events": Replay(slip_events, 1e-4),
    "map update": Replay(map_update, 1e-4),
    "cost": Replay(cost),
}
"""By name; fits choose among samples, which a rounding may decide otherwise elsewhere."""
