"""Simulated trips for the identification study, with everything that makes it hard.

A train of Amirhosseini et al. (2024) (350 t, eq. 35 without its slow variation) runs 60 km on
lines and at speeds drawn anew for each trip, holding speed or powering and coasting, braking for
lower limits. Recorded at 10 Hz: speed with 0.03 m/s of noise in steps of 0.01 m/s, effort,
chainage summed up from that speed, and satellites' speed. What the estimator is given is wrong as
in practice: each gradient of the map by 0.5 per mille, each change of gradient by up to 20 m, the
mass by up to 10 %.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from trainlog.arrays import BoolArray, FloatArray
from trainlog.formats.railway import line_to_bytes, train_to_bytes, with_passport
from trainlog.railway import (
    Line,
    Passport,
    Quantity,
    RunningResistance,
    Station,
    StepProfile,
    Train,
)
from trainlog.topics import GNSS_MOTION, TRAIN_CONTROLS, TRAIN_STATE
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip, frame_of
from trainlog.units import GRAVITY, NANOSECONDS

PERIOD = 0.1
"""Between two samples [s]."""


PAPER = RunningResistance(2090.0, 39.0, 0.675)
"""Amirhosseini et al. (2024), eq. (35), without the slow variation."""


@dataclass(frozen=True)
class Study:
    """What is drawn for each trip.

    Attributes
    ----------
    mass : float [kg]
        What the estimator is given; the true one is up to 10 % off.
    resistance : RunningResistance
    max_effort, max_power : float [N], [W]
    length : float [m]
    pieces : (float, float) [m]
        Shortest and longest piece of the gradient profile.
    steepness : float
        Standard deviation of the gradients.
    limits : (float, float) [m]
        Shortest and longest stretch of one speed.
    speeds : (float, float) [m/s]
    coasting : float
        Share of the stretches driven by powering and coasting in turn.
    map_error : float
        Standard deviation of each gradient of the map.
    edge_error : float [m]
        Largest error of the chainage of each change of gradient.
    mass_error : float
        Largest relative error of the mass.
    speed_noise, speed_resolution : float [m/s]
    """

    mass: float = 350e3
    resistance: RunningResistance = PAPER
    max_effort: float = 250e3
    max_power: float = 14e6
    length: float = 60e3
    pieces: tuple[float, float] = (100.0, 200.0)
    steepness: float = 2.5e-3
    limits: tuple[float, float] = (1500.0, 6000.0)
    speeds: tuple[float, float] = (8.0, 58.0)
    coasting: float = 0.3
    map_error: float = 0.5e-3
    edge_error: float = 20.0
    mass_error: float = 0.1
    speed_noise: float = 0.03
    speed_resolution: float = 0.01


PERFECT = replace(Study(), map_error=0.0, edge_error=0.0, mass_error=0.0)
"""Map and mass known; only the speed is noisy."""

CONSTANT = replace(Study(), speeds=(30.0, 30.0), coasting=0.0)
"""One speed throughout: nothing can be identified."""


@dataclass(frozen=True)
class Drawn:
    """One trip as recorded, and what is true of it; (n,) arrays.

    Attributes
    ----------
    time, speed, position, effort, braking : array
        Braking effort is only known to be on or off.
    line : Line
        The estimator's map.
    mass : float [kg]
        The true one.
    true_speed : array [m/s]
    gradients : StepProfile
        The true ones.
    """

    time: FloatArray
    speed: FloatArray
    position: FloatArray
    effort: FloatArray
    braking: FloatArray
    line: Line
    mass: float
    true_speed: FloatArray
    gradients: StepProfile


def draw(study: Study, seed: int) -> Drawn:
    """Draw one trip."""
    generator = np.random.default_rng(seed)
    starts = _edges(generator, study.length, *study.pieces)
    slopes = np.clip(study.steepness * generator.standard_normal(starts.size), -0.012, 0.012)
    limits = _edges(generator, study.length, *study.limits)
    speeds = generator.uniform(*study.speeds, limits.size)
    coasting = generator.uniform(size=limits.size) < study.coasting
    mass = study.mass * (1.0 + study.mass_error * generator.uniform(-1.0, 1.0))
    run = np.empty((100_000, 4))
    r = study.resistance
    count = _drive(
        starts,
        slopes,
        limits,
        speeds,
        coasting,
        study.length,
        mass,
        np.array([r.r0, r.r1, r.r2]),
        study.max_effort,
        study.max_power,
        run,
    )
    _, speed, effort, braking = run[:count].T
    noisy = speed + study.speed_noise * generator.standard_normal(count)
    recorded = np.round(noisy / study.speed_resolution) * study.speed_resolution
    mapped = starts.copy()
    mapped[1:] += study.edge_error * generator.uniform(-1.0, 1.0, starts.size - 1)
    gradients = slopes + study.map_error * generator.standard_normal(slopes.size)
    order = np.argsort(mapped)
    return Drawn(
        time=PERIOD * np.arange(count),
        speed=recorded,
        position=np.concatenate(([0.0], np.cumsum(PERIOD * recorded[:-1]))),
        # Held over the step that follows; the mean of two neighbours is what holds at the sample.
        effort=np.concatenate(([0.0], 0.5 * (effort[1:] + effort[:-1]))),
        braking=braking,
        line=Line(
            "drawn",
            study.length + 100.0,
            (Station("start", 0.0),),
            StepProfile(np.zeros(1), np.array([60.0])),
            StepProfile(mapped[order], gradients[order]),
        ),
        mass=mass,
        true_speed=speed,
        gradients=StepProfile(starts, slopes),
    )


def trip_of(drawn: Drawn, study: Study, seed: int) -> Trip:
    """The trip as a log holds it: nothing in it is true that a train does not know.

    But for its efforts: the study is of the curve, and the bound knows that they are in time and of
    their true size. A passport states it.
    """
    since = np.round(drawn.time * NANOSECONDS).astype(np.int64)
    stamps = np.int64(1_700_000_000_000_000_000) + since
    nothing = np.zeros(drawn.time.size)
    train = Train(
        name="study",
        # The prior of the mass is the mass with half the largest load, give or take all of it.
        mass=0.9 * study.mass,
        max_load=0.2 * study.mass,
        rotating_mass_factor=0.0,
        resistance=study.resistance,
        max_tractive_effort=study.max_effort,
        max_traction_power=study.max_power,
        max_dynamic_braking_effort=0.0,
        max_dynamic_braking_power=0.0,
        max_speed=60.0,
    )
    noise = np.random.default_rng([seed, 1]).standard_normal(drawn.time[::5].size)
    frames = [
        frame_of(TRAIN_STATE, stamps, {"position": drawn.position, "speed": drawn.speed}),
        frame_of(
            TRAIN_CONTROLS,
            stamps,
            {
                "tractive_effort": drawn.effort,
                "dynamic_braking_effort": nothing,
                "pneumatic_braking_effort": drawn.braking,
            },
        ),
        frame_of(
            GNSS_MOTION,
            stamps[::5],
            {"speed": drawn.true_speed[::5] + study.speed_noise * noise},
        ),
    ]
    trip = Trip(
        topics={str(frame.attrs["topic"]): frame for frame in frames},
        metadata={"trip": f"drawn-{seed:04d}", "train": train.name, "direction": "forward"},
        attachments={
            LINE_ATTACHMENT: line_to_bytes(drawn.line),
            TRAIN_ATTACHMENT: train_to_bytes(train),
        },
    )
    return with_exact_efforts(trip)


def with_exact_efforts(trip: Trip) -> Trip:
    """The trip with a passport that states its efforts to be in time and of their true size."""
    unknown = Quantity(np.nan, np.nan, "assumed")
    exact = Quantity(0.0, 1e-4, "estimated"), Quantity(1.0, 1e-6, "estimated")
    return with_passport(trip, Passport(trip.name, *exact, unknown, unknown, unknown, unknown))


def _edges(
    generator: np.random.Generator, length: float, shortest: float, longest: float
) -> FloatArray:
    steps = generator.uniform(shortest, longest, int(length / shortest) + 1)
    edges = np.concatenate(([0.0], np.cumsum(steps)))
    return edges[edges < length - shortest]


@njit(cache=True)
def _drive(
    starts: FloatArray,
    slopes: FloatArray,
    limits: FloatArray,
    speeds: FloatArray,
    coasting: BoolArray,
    length: float,
    mass: float,
    drag: FloatArray,
    max_effort: float,
    max_power: float,
    out: FloatArray,
) -> int:
    """Drive one trip; rows of position, speed, effort and braking effort; returns their number."""
    s, v = 0.0, 0.0
    piece, stretch = 0, 0
    rolling = False
    for k in range(out.shape[0]):
        if s >= length - 50.0:
            return k
        while piece + 1 < starts.size and s >= starts[piece + 1]:
            piece += 1
        while stretch + 1 < limits.size and s >= limits[stretch + 1]:
            stretch += 1
        last = stretch + 1 == limits.size
        target = speeds[stretch]
        following = 3.0 if last else speeds[stretch + 1]
        distance = max((length if last else limits[stretch + 1]) - s, 0.0)
        most = min(max_effort, max_power / max(v, 1.0))
        effort, brake = 0.0, 0.0
        ceiling = np.sqrt(following**2 + distance)
        if (following < target and v > ceiling) or v > target + 2.0:
            brake = 0.6 * mass
        elif coasting[stretch]:
            rolling = v >= target or (rolling and v >= 0.8 * target)
            effort = 0.0 if rolling else 0.8 * most
        else:
            needed = 0.3 * mass * (target - v) + drag[0] + (drag[1] + drag[2] * v) * v
            effort = min(max(needed + mass * GRAVITY * slopes[piece], 0.0), most)
        out[k] = s, v, effort, brake
        for _ in range(10):
            h = PERIOD / 10.0
            while piece + 1 < starts.size and s >= starts[piece + 1]:
                piece += 1
            sine = slopes[piece] / np.sqrt(1.0 + slopes[piece] ** 2)
            net = effort - brake - mass * GRAVITY * sine
            first = (net - drag[0] - (drag[1] + drag[2] * v) * v) / mass
            middle = v + 0.5 * h * first
            slope = (net - drag[0] - (drag[1] + drag[2] * middle) * middle) / mass
            s += h * (v + 0.5 * h * slope)
            v = max(v + h * slope, 0.0)
    return out.shape[0]
