"""The runs of `analysis.studies.hauck_2023.run` as trips, with sensors, truth and reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.studies.hauck_2023.run import Run
from trainlog import __version__
from trainlog.simulation import Run as Samples
from trainlog.simulation import Scenario, recorded
from trainlog.topics import REFERENCE, TRAIN_CONTROLS
from trainlog.trip import Trip, frame_of

FloatArray = NDArray[np.float64]

START = 1_735_689_600 * 10**9
"""When the runs begin [ns]: 2025-01-01, so that the same run gives the same bytes."""


def trip_of(run: Run, weather: str, seed: int, start: int = START) -> Trip:
    """The log of one run, as the train's sensors would have it.

    Parameters
    ----------
    run : Run
    weather : str
        Name of the rail's condition, the layer of a track-condition map.
    seed : int
        Of the sensors' noise.
    start : int [ns]
        When the run begins, since 1970 UTC.
    """
    train = run.train.on_axles()
    scenario = Scenario(
        name=run.name.replace(" ", "-").replace(",", ""),
        line=run.line,
        train=train,
        direction="forward",
        weather=weather,
        mass=run.mass,
        rotating_mass=train.rotating_mass,
        resistance=run.train.resistance(run.mass),
        max_power=train.max_traction_power,
        maximum_adhesion=run.rail,
        stops=run.stops,
        seed=seed,
        start=start,
    )
    trip = recorded(scenario, Samples(run.time, run.samples, run.demands))
    controls = trip[TRAIN_CONTROLS.name].copy()
    controls["lever"] = np.round(run.lever, 4) + 0.0
    time = start + np.round(run.time * 1e9).astype(np.int64)
    effort = run.target[:, 2]
    followed: dict[str, ArrayLike] = {
        "speed": run.target[:, 1],
        "tractive_effort": np.maximum(effort, 0.0),
        "braking_effort": np.maximum(-effort, 0.0),
        "lateness": lateness(run),
    }
    reference = frame_of(REFERENCE, time, followed)
    return (
        trip.with_topic(controls)
        .with_topic(reference)
        .with_step(
            "study map-mpc",
            software=f"trainlog {__version__}",
            run=run.name,
            mass=run.mass,
            delay=run.delay,
        )
    )


def lateness(run: Run) -> FloatArray:
    """How late the train is where it is [s], by the reference of its section.

    It begins with the planned departure and keeps its last value after the arrival.
    """
    late = np.zeros(run.time.size)
    for number, origin in enumerate(run.stops[:-1]):
        on = run.section == number
        planned = on & (run.time >= origin.departure)
        positions, first = np.unique(run.target[planned, 0], return_index=True)
        due = np.interp(run.position[on], positions, run.time[planned][first])
        late[on] = np.clip(run.time[on], origin.departure, run.arrivals[number + 1]) - due
    return late
