"""Drive a scenario, and record it as the train would: its sensors, and the truth beside them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from trainlog import __version__
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InfeasibleError
from trainlog.formats.files import sha256
from trainlog.railway import Trajectory
from trainlog.railway.line import km_words
from trainlog.simulation import sensors as measuring
from trainlog.simulation.drivers import DEPARTURE, PERIOD, Observation
from trainlog.simulation.scenario import LARGEST_LOAD, Scenario
from trainlog.simulation.traction import TractionLoop
from trainlog.topics import EVENTS, REFERENCE, STANDSTILL, TRAIN_AXLES, TRAIN_CONTROLS, TRUTH
from trainlog.trip import LINE_ATTACHMENT, SCENARIO_ATTACHMENT, TRAIN_ATTACHMENT, Trip, frame_of
from trainlog.units import NANOSECONDS

STANDING = 10.0
"""Recorded after the arrival [s]."""

STUCK = 1200.0
"""A train that is not braked and has not moved for so long [s] will not."""

INFO, WARNING = 2, 3
"""Levels of foxglove.Log."""


@dataclass(frozen=True, eq=False)
class Run:
    """What happened, exactly.

    Attributes
    ----------
    seconds : (n,) array [s]
        Since the beginning of the trip.
    samples : (n, columns) array
        See `Plant.columns`.
    demands : (n, 2) array [N]
        Tractive and braking effort asked for.
    traction : TractionLoop, optional
        The traction control and what became of its decisions; None: the plant's own protection.
    """

    seconds: FloatArray
    samples: FloatArray
    demands: FloatArray
    traction: TractionLoop | None = None


def drive(scenario: Scenario) -> Run:
    """Let the driver drive the plant from the first stop to the last.

    Raises
    ------
    InfeasibleError
        If the train does not arrive within three times its planned time, or has not moved for
        `STUCK` though it is not braked, as it is at a stop.
    """
    plant = scenario.plant()
    driver = scenario.driver()
    line, trajectory = scenario.line, scenario.trajectory
    if trajectory is None:
        origin, patience = scenario.stops[0].position, 3.0 * scenario.stops[-1].arrival
    else:
        origin, patience = float(trajectory.positions[0]), 3.0 * trajectory.running_time
    state = plant.at(origin)
    observed = scenario.driver_observation(origin)
    loop = scenario.traction_loop(plant)
    steps = round(PERIOD / plant.parameters.step)
    rate = round(scenario.sensors.rate * PERIOD)
    blocks: list[FloatArray] = []
    demands: list[tuple[float, float]] = []
    acceleration = 0.0
    arrived: float | None = None
    moved, place = 0.0, origin
    position, speed = origin, 0.0
    while True:
        time = len(blocks) * PERIOD
        wanted = driver.demand(observed(Observation(time, position, speed, acceleration)))
        demands.append((wanted.tractive_effort, wanted.braking_effort))
        if arrived is None and driver.finished:
            arrived = time
        if arrived is not None and time >= arrived + STANDING:
            break
        if wanted.braking_effort > 0.0 or abs(position - place) > 1.0:
            moved, place = time, position
        if time > patience + 600.0 or time > moved + STUCK:
            forward = scenario.direction == "forward"
            at = km_words(line, position if forward else line.length - position)
            raise InfeasibleError(
                f"trip '{scenario.name}': the train does not arrive; at {at} after {time:.0f} s",
                remedy="check adhesion, gradients and tractive effort there",
            )
        most = wanted.most_dynamic
        if loop is None:
            blocks.append(
                plant.advance(state, *demands[-1], steps, steps // rate, most_dynamic=most)
            )
        else:
            blocks.append(loop.advance(state, demands[-1], steps, steps // rate, most))
        position, before, speed = state.position, speed, state.speed
        acceleration = (speed - before) / PERIOD
    samples = np.concatenate(blocks)
    return Run(
        np.arange(len(samples)) / scenario.sensors.rate,
        samples,
        np.repeat(np.array(demands[: len(blocks)]), rate, axis=0),
        loop,
    )


def simulate(scenario: Scenario) -> Trip:
    """Drive a scenario and record it as the train's sensors would.

    Raises
    ------
    InputError
        For a train or stops that cannot be.
    InfeasibleError
        If the train does not arrive.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.formats.railway import read_train
    >>> from trainlog.simulation import draw_scenarios
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> trip = simulate(draw_scenarios(line, train, count=1)[0])
    >>> trip.name, round(trip.duration / 60.0, 1)
    ('trip-01', 19.7)
    """
    return recorded(scenario, drive(scenario))


def recorded(scenario: Scenario, run: Run) -> Trip:
    """The trip that the train's recorder would hold, with the truth in ``/truth``."""
    columns = dict(zip(scenario.plant().columns, run.samples.T, strict=True))
    time = scenario.start + np.round(run.seconds * NANOSECONDS).astype(np.int64)
    generator = np.random.default_rng(scenario.seed)
    axles = scenario.train.axles.count
    scale, own = measuring.wheel_scales(axles, scenario.sensors, generator)
    state = measuring.train_state(
        time,
        columns["position"],
        columns["speed"],
        columns["acceleration"],
        scale,
        scenario.sensors,
        generator,
    )
    believed = state["position"].to_numpy()
    fix, motion, changes = measuring.gnss(
        scenario.travelled,
        time,
        columns["position"],
        columns["speed"],
        scenario.sensors,
        generator,
    )
    late = delayed_efforts(columns, run.seconds, scenario.sensors.effort_delay)
    # The ``/train/axles`` topic: speeds and efforts of one instant in one row.
    numbers = range(1, scenario.train.axles.count + 1)
    speeds = np.column_stack([late[f"wheel_speed_{i}"] for i in numbers])
    efforts = np.column_stack([late[f"wheel_effort_{i}"] for i in numbers])
    frames = [
        state,
        controls(scenario, run, late, time, generator),
        frame_of(
            TRAIN_AXLES,
            time,
            {
                "wheel_speed": measuring.measured_speed(speeds, own, scenario.sensors, generator),
                "wheel_effort": measuring.measured_effort(efforts, scenario.sensors, generator),
            },
        ),
        fix,
        motion,
        measuring.environment(scenario.travelled, time, believed, scenario.temperature),
        events(scenario, columns, time, changes, run.traction),
        reference(scenario, run, columns, time),
        truth(columns, time),
    ]
    (line, train), content = scenario.files(), scenario.truth()
    trip = Trip(
        topics={frame.attrs["topic"]: frame for frame in frames if frame is not None},
        metadata=metadata(scenario) | traction_metadata(run.traction),
        attachments={
            LINE_ATTACHMENT: line,
            TRAIN_ATTACHMENT: train,
            SCENARIO_ATTACHMENT: content,
        },
    )
    return trip.with_step(
        "simulate",
        software=f"trainlog {__version__}",
        seed=scenario.seed,
        inputs={
            LINE_ATTACHMENT: sha256(line),
            TRAIN_ATTACHMENT: sha256(train),
            SCENARIO_ATTACHMENT: sha256(content),
        },
    )


def metadata(scenario: Scenario) -> dict[str, str]:
    """What is known of the trip, as the log's metadata; the load as the train weighs it."""
    known = {
        "trip": scenario.name,
        "train": scenario.train.name,
        "line": scenario.line.name,
        "direction": scenario.direction,
        "weather": scenario.weather,
        "clock": "UTC, simulated",
        "start": pd.Timestamp(scenario.start, tz="UTC").isoformat(),
        "software": f"trainlog {__version__}",
        "seed": str(scenario.seed),
    }
    if scenario.sensors.load_error is not None:
        largest = scenario.train.max_load or LARGEST_LOAD
        load, std = measuring.weighed_load(scenario.load, largest, scenario.sensors, scenario.seed)
        known |= {"load": f"{load:.0f}", "load_std": f"{std:.0f}"}
    if scenario.trajectory is not None:
        known["configuration"] = scenario.trajectory.configurations[scenario.row].name
    return known | scenario.metadata()


def traction_metadata(loop: TractionLoop | None) -> dict[str, str]:
    """Which traction control drove, and how many of its decisions were not solved."""
    if loop is None:
        return {}
    return {
        "traction_control": loop.control.name,
        "traction_decisions": str(loop.steps),
        "traction_unsolved": str(len(loop.unsolved)),
    }


def delayed_efforts(
    columns: dict[str, FloatArray], seconds: FloatArray, delay: float
) -> dict[str, FloatArray]:
    """The columns, with the efforts of the train and its axles late by `delay` [s]."""
    if delay == 0.0:
        return columns
    return {
        name: np.interp(seconds - delay, seconds, values) if "effort" in name else values
        for name, values in columns.items()
    }


def controls(
    scenario: Scenario,
    run: Run,
    columns: dict[str, FloatArray],
    time: IntArray,
    generator: np.random.Generator,
) -> pd.DataFrame:
    """The ``/train/controls`` topic."""
    train = scenario.train
    service = train.max_deceleration * (scenario.mass + scenario.rotating_mass)
    traction, braking = run.demands.T
    available = train.tractive_effort_limit(columns["speed"])
    lever = np.where(braking > 0.0, -braking / service, traction / available)
    data = {
        name: measuring.measured_effort(columns[name], scenario.sensors, generator)
        for name in ("tractive_effort", "dynamic_braking_effort", "pneumatic_braking_effort")
    }
    return frame_of(
        TRAIN_CONTROLS,
        time,
        {
            "lever": np.round(np.clip(lever, -1.0, 1.0), 3) + 0.0,
            "tractive_effort_demand": np.round(traction, 0),
            "braking_effort_demand": np.round(braking, 0),
            **data,
        },
    )


def _moving(speed: FloatArray) -> BoolArray:
    """Whether the train is moving: from `STANDSTILL` on until it stands still again, (n,)."""
    # A train that settles on its springs as the brake grips has not departed.
    state = np.where(speed > STANDSTILL, 1, np.where(speed > 0.0, 0, -1))
    last = np.maximum.accumulate(np.where(state != 0, np.arange(speed.size), 0))
    return np.asarray(state[last] > 0)


def events(
    scenario: Scenario,
    columns: dict[str, FloatArray],
    time: IntArray,
    changes: list[tuple[int, str]],
    loop: TractionLoop | None = None,
) -> pd.DataFrame:
    """The ``/events`` topic: departures, arrivals, slip protection, satellites."""
    found = [(when, WARNING if "lost" in text else INFO, text, "gnss") for when, text in changes]
    moving = _moving(columns["speed"])
    for edge in np.flatnonzero(np.diff(moving.astype(np.int8))) + 1:
        where = place(scenario, float(columns["position"][edge]))
        text = f"departure from {where}" if moving[edge] else f"arrival at {where}"
        found.append((int(time[edge]), INFO, text, "train"))
    active = columns["protected_axles"] > 0.0
    for edge in np.flatnonzero(np.diff(active.astype(np.int8)) > 0) + 1:
        how = "traction" if columns["tractive_effort"][edge] > 0.0 else "braking"
        found.append((int(time[edge]), WARNING, f"slip protection active in {how}", "drive"))
    found += unsolved_events(scenario, loop)
    found.sort(key=lambda event: event[0])
    when, level, message, name = zip(*found, strict=True) if found else ((), (), (), ())
    return frame_of(
        EVENTS,
        np.array(when, dtype=np.int64),
        {
            "level": np.array(level, dtype=np.int64),
            "message": np.array(message, dtype=object),
            "name": np.array(name, dtype=object),
        },
    )


def unsolved_events(
    scenario: Scenario, loop: TractionLoop | None
) -> list[tuple[int, int, str, str]]:
    """One event for each run of decisions that a traction control did not solve."""
    if loop is None or not loop.unsolved:
        return []
    when = np.array(loop.unsolved)
    first = np.flatnonzero(np.diff(when, prepend=-np.inf) > 1.5 * loop.control.period)
    counts = np.diff(first, append=when.size)
    starts = scenario.start + np.round(when[first] * NANOSECONDS).astype(np.int64)
    return [
        (int(start), WARNING, f"traction control unsolved, {count} decisions", "drive")
        for start, count in zip(starts, counts, strict=True)
    ]


def place(scenario: Scenario, position: float) -> str:
    """The station at a position, or the kilometre."""
    for station in scenario.travelled.stations:
        if abs(station.position - position) < 50.0:
            return station.name
    return f"km {position / 1e3:.3f}"


def reference(
    scenario: Scenario, run: Run, columns: dict[str, FloatArray], time: IntArray
) -> pd.DataFrame | None:
    """The ``/reference`` topic; None when no trajectory is followed.

    It is the trajectory of the configuration that arrives last: all others keep it, too.
    The lateness begins with the departure and keeps its last value after the arrival.
    """
    trajectory = scenario.trajectory
    if trajectory is None:
        return None
    last_moving = np.flatnonzero(columns["speed"] > 0.0)[-1]
    under_way = np.clip(run.seconds, DEPARTURE, run.seconds[last_moving]) - DEPARTURE
    return reference_frame(trajectory, trajectory.latest, time, columns["position"], under_way)


def reference_frame(
    trajectory: Trajectory, row: int, time: Any, position: FloatArray, elapsed: FloatArray
) -> pd.DataFrame:
    """The ``/reference`` topic of a trip: what a trajectory asks for where the train is.

    Parameters
    ----------
    trajectory : Trajectory
    row : int
        Configuration.
    time : (n,) array or index
        Of the rows.
    position : (n,) array [m]
    elapsed : (n,) array [s]
        Since the departure by the trajectory.
    """
    planned = np.interp(position, trajectory.positions, trajectory.times[row])
    columns = {
        "speed": trajectory.speed_at(row, position),
        "tractive_effort": trajectory.tractive_effort_at(position),
        "braking_effort": trajectory.braking_effort[row, trajectory.cell_of(position)],
        "lateness": elapsed - planned,
    }
    return frame_of(REFERENCE, time, columns)


def truth(columns: dict[str, FloatArray], time: IntArray) -> pd.DataFrame:
    """The ``/truth`` topic."""
    names = (
        "position",
        "speed",
        "acceleration",
        "running_resistance",
        "maximum_adhesion",
        "energy",
    )
    return frame_of(TRUTH, time, {name: columns[name] for name in names})
