"""A small trip over a small line, and how to read a recording back."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader

from trainlog import Geometry, Line, RunningResistance, Station, StepProfile, Trajectory, topics
from trainlog.formats.railway import line_to_bytes
from trainlog.railway import Configuration
from trainlog.railway.condition import ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence
from trainlog.topics import Topic
from trainlog.trip import LINE_ATTACHMENT, Trip, frame_of

START = 1_728_280_800_000_000_000
LENGTH = 2000.0
LINE = Line(
    name="hill",
    length=LENGTH,
    stations=(Station("A", 0.0), Station("B town", LENGTH)),
    speed_limits=StepProfile(np.array([0.0, 1000.0]), np.array([40.0, 30.0])),
    gradients=StepProfile(np.array([0.0, 500.0]), np.array([0.005, -0.01])),
    geometry=Geometry(*np.array([[0.0, LENGTH], [47.0, 47.0], [9.0, 9.02637]]), "made up"),
)


def made_trip(name: str = "up", direction: str = "forward", top: float = 20.0) -> Trip:
    """From end to end of the line: 5 s standing, run-up, steady, braking, 5 s standing; 10 Hz."""
    rise, steady = 20.0, LENGTH / top - 20.0
    knots = np.cumsum([0.0, 5.0, rise, steady, rise, 5.0])
    seconds = np.arange(round(knots[-1] * 10) + 1) / 10
    speed = np.interp(seconds, knots, [0.0, 0.0, top, top, 0.0, 0.0])
    position = np.concatenate(([0.0], np.cumsum(0.05 * (speed[1:] + speed[:-1]))))
    position *= LENGTH / position[-1]
    pulls = (seconds >= 5.0) & (seconds < knots[2])
    brakes = (seconds >= knots[3]) & (seconds < knots[4])
    lever = np.select([pulls, brakes], [0.8, -0.5], 0.0)
    line = LINE if direction == "forward" else LINE.reversed()
    time = START + np.round(seconds * 1e9).astype(np.int64)
    latitude, longitude = line.geometry.at(position)
    pull, brake = 1e5 * np.maximum(lever, 0.0), 1e5 * np.maximum(-lever, 0.0)
    wheels = np.column_stack((speed * 1.01, speed * 0.99))
    slow, known = slice(None, None, 10), np.where(np.arange(seconds.size) % 7 == 3, np.nan, 1.0)
    state = {"position": position, "speed": speed}
    values: dict[Topic, dict[str, object]] = {
        topics.TRAIN_STATE: state,
        topics.TRAIN_CONTROLS: {
            "lever": lever,
            "tractive_effort_demand": pull,
            "braking_effort_demand": brake,
            "tractive_effort": pull,
            "dynamic_braking_effort": 0.8 * brake,
            "pneumatic_braking_effort": 0.2 * brake,
        },
        topics.TRAIN_AXLES: {"wheel_speed": wheels, "wheel_effort": wheels},
        topics.GNSS_FIX: {"latitude": latitude * known, "longitude": longitude * known},
        topics.GNSS_MOTION: {"speed": speed},
        topics.ENVIRONMENT: {n: getattr(line, n)(position) for n in ("speed_limit", "gradient")},
        topics.EVENTS: {"level": [2, 3], "message": ["departure from A", "slip protection"],
                        "name": ["train", ""]},
        topics.ESTIMATED_STATE: {**state, "speed_std": 0.1 + 0.01 * speed},
        topics.ESTIMATED_ADHESION: {
            "slip_speed": wheels - speed[:, None],
            "adhesion": lever[:, None] * [0.1, 0.2],
        },
        topics.ESTIMATED_RESISTANCE: {
            "resistance": 1e3 + 10 * speed[slow],
            "resistance_std": np.full(speed[slow].size, 50),
        },
        topics.REFERENCE: {"speed": 0.9 * speed, "tractive_effort": 0.8 * pull,
                           "braking_effort": brake},
        topics.TRUTH: {"running_resistance": 1e3 + 10 * speed},
        topics.IMU: {"specific_force_z": np.full(len(time), 9.81)},
        topics.TRAIN_VEHICLES: {"speed": np.column_stack((speed, speed))},
        topics.TRAIN_COUPLERS: {"force": 0.4 * (pull - brake)[:, None]},
    }  # fmt: skip
    times = {topics.EVENTS: time[[50, 900]], topics.ESTIMATED_RESISTANCE: time[slow]}
    return Trip(
        {each.name: frame_of(each, times.get(each, time), values[each]) for each in values},
        metadata={"trip": name, "line": "hill", "direction": direction, "weather": "dry"},
        attachments={LINE_ATTACHMENT: line_to_bytes(LINE)},
    ).with_step("made up")


def condition_of() -> TrackConditionMap:
    """Three bins of the line observed when dry, none when wet."""
    bins = 80
    observed = np.isin(np.arange(bins), (10, 11, 60))

    def layer(seen: np.ndarray) -> ConditionLayer:
        log_mean = np.log(np.linspace(0.1, 0.3, bins))
        known = DailyEvidence.none(bins, 1)
        return ConditionLayer(log_mean, np.full(bins, 0.05), seen, evidence=known)

    return TrackConditionMap(
        line="hill",
        length=LENGTH,
        bin_length=25.0,
        levels=np.array([0.1]),
        layers={"dry": layer(observed), "wet": layer(observed & False)},
    )


def trajectory_of() -> Trajectory:
    """Two configurations in four cells."""
    configurations = tuple(
        Configuration(name, mass, 5e3, RunningResistance(2e3, 50.0, 5.0), 1e6)
        for name, mass in (("light", 1e5), ("heavy", 1.2e5))
    )
    return Trajectory(
        line="hill",
        train="T",
        positions=np.linspace(0.0, LENGTH, 5),
        configurations=configurations,
        speeds=np.array([[0.0, 20.0, 22.0, 20.0, 0.0], [0.0, 18.0, 20.0, 18.0, 0.0]]),
        times=np.array([[0.0, 50.0, 74.0, 98.0, 148.0], [0.0, 55.0, 80.0, 105.0, 148.0]]),
        tractive_effort=np.array([8e4, 2e4, 1e4, 0.0]),
        braking_effort=np.array([[0.0, 0.0, 0.0, 8e4], [0.0, 0.0, 0.0, 6e4]]),
        running_time=148.0,
    )


def entities(path: Path) -> dict[str, set[str]]:
    """Entities of a recording and the timelines that they are on; none if they always hold."""
    found: dict[str, set[str]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        if not chunk.entity_path.startswith("/__"):
            found.setdefault(chunk.entity_path, set()).update(chunk.timeline_names)
    return found


def rows(path: Path, entity: str) -> dict[str, np.ndarray]:
    """Time and values of an entity, row by row as they were sent; static entities have none."""
    batches = [
        chunk.to_record_batch()
        for chunk in RrdReader(path).stream().to_chunks()
        if chunk.entity_path == entity and not chunk.is_static
    ]
    if not batches:
        return {}
    table = pa.Table.from_batches(batches)
    names = [name for name in table.column_names if "RowId" not in name]
    return {name: _values(table[name].combine_chunks()) for name in names}


def static(path: Path, entity: str, component: str) -> list[Any]:
    """A component that an entity always has."""
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and chunk.is_static and component in batch.schema.names:
            return batch[component][0].as_py()
    raise KeyError(component)


def _values(array: pa.Array) -> np.ndarray:
    if pa.types.is_temporal(array.type):
        return array.cast(pa.int64()).to_numpy()
    if not pa.types.is_list(array.type):
        return array.to_numpy()
    if pa.types.is_string(array.type.value_type):
        return array.flatten().to_numpy(zero_copy_only=False)
    inner = array.flatten()
    if pa.types.is_fixed_size_list(inner.type):
        inner = inner.flatten()
    return inner.to_numpy(zero_copy_only=False).reshape(len(array), -1)
