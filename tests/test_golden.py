"""Golden replays: estimators and analyses give over the sample logs what they gave before.

A replay takes a trip and gives its figures by name. A new analysis adds one entry to `REPLAYS`;
``pytest tests/test_golden.py --renew-golden`` stores its reference, reviewed like code.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from same_values import first_difference

import trainlog
from analysis import coast_down, fit_trip, slip, with_estimates
from analysis.adhesion.condition_map import empty_map, update
from analysis.adhesion.evidence import evidence_of
from analysis.comparison.groups import trip_cost
from trainlog import TrainlogError, Trip
from trainlog.formats.railway import line_of
from trainlog.formats.samples import folder

Figures = Mapping[str, ArrayLike]

LOGS = ("nonstop", "stopping")


@cache
def trip_of(name: str) -> Trip:
    return trainlog.read(folder() / f"{name}.mcap")


def estimates(trip: Trip) -> Figures:
    """Smoothed motion, running resistance in its course, adhesion and slip as topics."""
    result, refusals = with_estimates(trip)
    topics = [topic for topic in result.topics if topic.startswith("/estimates/")]
    found: Figures = {"refusals": len(refusals)}
    for topic in topics:
        found |= {f"{topic}.{name}": x.to_numpy(np.float64) for name, x in result[topic].items()}
    return found


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
    known = {name: getattr(layer, name) for name in ("log_std", "observed", "events")}
    return {"maximum_adhesion": np.exp(layer.log_mean), **known}


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


REPLAYS: dict[str, tuple[Callable[[Trip], Figures], float]] = {
    "estimates": (estimates, 1e-4),
    "fit": (fit, 1e-3),
    "coast-down": (coasting, 1e-3),
    "slip events": (slip_events, 1e-4),
    "map update": (map_update, 1e-4),
    "cost": (cost, 1e-6),
}
"""By name, with the share of the largest value in a column by which a figure may differ; fits
choose among samples, which a rounding may decide otherwise elsewhere."""


GOLDEN = Path(__file__).parent / "data" / "golden"

SAMPLES = 9  # rows of a long figure that are kept, from the first to the last

ZERO = 1e-9  # share of the largest value of a figure that counts as nothing in any of its columns


def path_of(name: str, log: str) -> Path:
    return GOLDEN / f"{name.replace(' ', '_')}.{log}.json"


def digest(values: ArrayLike) -> dict[str, object]:
    """Shape, how many are unknown, and of each column largest and mean size and some rows."""
    array = np.asarray(values, dtype=np.float64)
    few = array.ndim == 0 or (array.ndim == 1 and array.size <= SAMPLES)
    # A few numbers side by side, an estimate say, are columns of their own.
    rows = array.reshape(1, -1) if few else array.reshape(len(array), -1)
    known = np.where(np.isfinite(rows), rows, 0.0)
    known[np.abs(known) <= ZERO * np.abs(known).max(initial=0.0)] = 0.0
    chosen = np.unique(np.linspace(0, max(len(rows) - 1, 0), min(SAMPLES, len(rows))).astype(int))
    size = np.abs(known)
    kept = np.vstack([size.max(axis=0, initial=0.0), size.sum(axis=0) / len(rows), known[chosen]])
    return {
        "shape": list(array.shape),
        "unknown": int(np.count_nonzero(~np.isfinite(array))),
        "columns": [[float(f"{value:.10g}") for value in column] for column in kept.T],
    }


@pytest.mark.usefixtures("remembered")
@pytest.mark.parametrize("log", LOGS)
@pytest.mark.parametrize("name", REPLAYS)
def test_replay_gives_what_it_gave(name, log, request, tmp_path):
    """A digest of each figure, or why it is refused."""
    renew, path = request.config.getoption("--renew-golden"), path_of(name, log)
    made = path if renew else tmp_path / path.name
    run, tolerance = REPLAYS[name]
    try:
        found = {name: digest(values) for name, values in run(trip_of(log)).items()}
    except TrainlogError as error:
        found = {"refused": re.sub(r"[0-9.]+", "#", str(error))}
    made.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", "utf-8")
    assert path.exists(), f"no reference: pytest {Path(__file__).name} --renew-golden"
    changed = first_difference(made, path, tolerance)
    assert not changed, f"{changed}; if it is meant: --renew-golden"


def test_every_reference_belongs_to_a_replay():
    wanted = {path_of(name, log) for name in REPLAYS for log in LOGS}
    assert set(GOLDEN.glob("*.json")) == wanted
