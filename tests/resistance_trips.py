"""Trips whose motion is known in closed form, for the tests of the identification."""

import sys
from pathlib import Path

import numpy as np
from simulated_line import level_line

from analysis.resistance.recording import Recording
from trainlog.arrays import FloatArray
from trainlog.formats.railway import line_to_bytes, train_to_bytes
from trainlog.railway import Axles, RunningResistance, Train
from trainlog.railway.resistance import basis
from trainlog.topics import TRAIN_CONTROLS, TRAIN_STATE
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip, frame_of

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "identification"))

from monte_carlo import with_exact_efforts as with_exact_efforts

RESISTANCE = RunningResistance(2400.0, 60.0, 12.0)

TRAIN = Train(
    name="unit",
    mass=120e3,
    rotating_mass_factor=0.1,
    resistance=RESISTANCE,
    max_tractive_effort=200e3,
    max_traction_power=2.6e6,
    max_dynamic_braking_effort=200e3,
    max_dynamic_braking_power=2.6e6,
    max_speed=44.0,
    max_load=20e3,
    axles=Axles(4, 64e3, 0.43, 2000.0),
)

LINE = level_line(80_000.0, limit=35.0)


def varied_speed(time: FloatArray) -> FloatArray:
    """A start, then speeds that go up and down between 5 and 33 m/s."""
    waves = 19.0 + 9.0 * np.sin(time / 45.0) + 5.0 * np.sin(time / 17.0)
    return np.asarray(waves * np.sin(0.5 * np.pi * np.clip(time / 60.0, 0.0, 1.0)))


def constant_speed(time: FloatArray) -> FloatArray:
    """Nothing but 30 m/s."""
    return np.full(time.size, 30.0)


def driven(speed_of, mass, resistance, duration, train):
    """Times every tenth of a second, speeds, and the efforts that they need."""
    time = np.arange(0.0, duration, 0.1)
    acceleration = (speed_of(time + 1e-4) - speed_of(time - 1e-4)) / 2e-4
    speed = speed_of(time)
    return time, speed, (mass + train.rotating_mass) * acceleration + resistance(speed)


def measured(speed: FloatArray, noise: float, seed: int) -> FloatArray:
    return speed + noise * np.random.default_rng(seed).standard_normal(speed.size)


def recording(
    speed_of=varied_speed, *, mass=130e3, resistance=RESISTANCE, duration=1200.0, noise=0.0, seed=0
):
    """An exact recording on a level line, with noise on the speed if wanted."""
    time, speed, effort = driven(speed_of, mass, resistance, duration, TRAIN)
    nothing, shown = np.zeros(time.size), measured(speed, noise, seed)
    groups = (np.cumsum(speed) * 0.1 // 500.0).astype(np.int64)
    none = dict.fromkeys(
        ("braking", "between", "slip_momentum", "tunnel", "track", "track_slope"), nothing
    )
    return Recording(
        time=time,
        speed=shown,
        curve=basis(shown),
        effort=effort,
        rotating_momentum=TRAIN.rotating_mass * speed,
        section=groups,
        nearest_edge=groups,
        usable=speed > 2.0,
        **none,
    )


def trip(speed_of=varied_speed, name="made", train=TRAIN, noise=0.02, seed=0, **motion):
    """A trip on a level line whose recorder shows speed, chainage and efforts."""
    moved = {"mass": 130e3, "resistance": RESISTANCE, "duration": 1200.0, **motion}
    time, speed, effort = driven(speed_of, train=train, **moved)
    position = np.concatenate(([0.0], np.cumsum(0.05 * (speed[1:] + speed[:-1]))))
    stamps = np.int64(1_700_000_000_000_000_000) + np.round(time * 1e9).astype(np.int64)
    shown = np.abs(measured(speed, noise, seed))
    pulls, brakes = np.maximum(effort, 0.0), np.maximum(-effort, 0.0)
    controls = {"tractive_effort_demand": pulls, "tractive_effort": pulls}
    controls |= {"dynamic_braking_effort": brakes, "pneumatic_braking_effort": 0.0 * brakes}
    attached = {LINE_ATTACHMENT: line_to_bytes(LINE), TRAIN_ATTACHMENT: train_to_bytes(train)}
    made = Trip({}, {"trip": name, "train": train.name, "direction": "forward"}, (), attached)
    made = made.with_topic(frame_of(TRAIN_STATE, stamps, {"position": position, "speed": shown}))
    return made.with_topic(frame_of(TRAIN_CONTROLS, stamps, controls))


def changed(original: Trip, topic: str, **columns: object) -> Trip:
    """The trip with columns of one topic replaced."""
    return original.with_topic(original[topic].assign(**columns))
