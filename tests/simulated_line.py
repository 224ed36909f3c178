"""A small line and a train for the tests of the simulation: nothing read from disk."""

from __future__ import annotations

import numpy as np

from trainlog.railway import (
    Axles,
    Brake,
    Configuration,
    CurvatureProfile,
    Geometry,
    Line,
    RunningResistance,
    Station,
    StepProfile,
    Train,
    Trajectory,
    Tunnel,
)
from trainlog.units import KMH


def steps(*pairs: tuple[float, float]) -> StepProfile:
    positions, values = zip(*pairs, strict=True)
    return StepProfile(np.array(positions, dtype=float), np.array(values, dtype=float))


def level_line(length: float = 100_000.0, gradient: float = 0.0, limit: float = 60.0) -> Line:
    return Line(
        name="level",
        length=length,
        stations=(Station("A", 0.0), Station("B", length)),
        speed_limits=steps((0.0, limit)),
        gradients=steps((0.0, gradient)),
    )


def hilly_line() -> Line:
    """Eleven kilometres with all that a line can have."""
    length = 11_000.0
    nodes = np.linspace(0.0, length, 200)
    return Line(
        name="hilly",
        length=length,
        stations=(
            Station("Aach", 0.0),
            Station("Berg", 3_900.0),
            Station("Chur", 7_050.0),
            Station("Dorf", length),
        ),
        speed_limits=steps(
            (0.0, 80 / KMH),
            (400.0, 120 / KMH),
            (3_200.0, 90 / KMH),
            (5_000.0, 125 / KMH),
            (9_800.0, 70 / KMH),
        ),
        gradients=steps(
            (0.0, 0.003), (900.0, -0.012), (2_500.0, 0.0), (4_300.0, 0.016), (7_800.0, -0.008)
        ),
        curvatures=CurvatureProfile(
            np.array([0.0, 1_000.0, 1_100.0, 1_900.0, 2_000.0, 6_000.0]),
            np.array([0.0, 0.0, 1 / 800, 1 / 800, 0.0, -1 / 1_500]),
            np.array([0.0, 1 / 800, 1 / 800, 0.0, 0.0, -1 / 1_500]),
        ),
        tunnels=(Tunnel(2_200.0, 600.0, 24.0),),
        altitude=500.0,
        geometry=Geometry(nodes, 47.0 + 0.0 * nodes, 9.0 + nodes / 76_000.0, "made up"),
    )


def flirt(**changes: object) -> Train:
    """Nearly the FLIRT of the samples."""
    known: dict[str, object] = {
        "name": "flirt",
        "mass": 122_000.0,
        "rotating_mass_factor": 0.1,
        "resistance": RunningResistance(2_380.0, 61.0, 12.1),
        "max_tractive_effort": 200e3,
        "max_traction_power": 2.6e6,
        "max_dynamic_braking_effort": 200e3,
        "max_dynamic_braking_power": 2.6e6,
        "max_pneumatic_braking_effort": 1.22e6,
        "max_speed": 160 / KMH,
        "max_acceleration": 1.1,
        "max_deceleration": 1.1,
        "max_load": 20_000.0,
        "length": 58.6,
        "tunnel_resistance": ((24.0, 15.2), (40.0, 7.2)),
        "axles": Axles(),
        "brake": Brake(),
    }
    return Train(**{**known, **changes})  # type: ignore[arg-type]


def trajectory_of(line: Line, train: Train, factors: tuple[float, ...]) -> Trajectory:
    """A trajectory to follow: power, coasting, and a brake of its own for each configuration."""
    nodes = np.concatenate((np.arange(0.0, 20.0, 1.0), np.arange(20.0, line.length + 1.0, 10.0)))
    width = np.diff(nodes)
    middle = 0.5 * (nodes[1:] + nodes[:-1])
    ceiling = line.speed_limit(nodes) - 1.0
    energy = ceiling**2 + 2.0 * 0.5 * nodes
    energy[-1] = 2.0 * 0.5 * nodes[-1]
    ceiling = np.sqrt(
        np.maximum(np.minimum.accumulate(energy[::-1])[::-1] - 2.0 * 0.5 * nodes, 0.0)
    )
    configurations = tuple(
        Configuration(
            f"r{factor:g}",
            train.mass + 8_000.0,
            train.rotating_mass,
            train.resistance.scaled(factor),
            train.max_traction_power,
        )
        for factor in factors
    )
    track = line.track_acceleration(middle)
    traction = np.zeros(width.size)
    speeds = np.zeros((len(factors), nodes.size))
    braking = np.zeros((len(factors), width.size))
    middling = configurations[len(factors) // 2]
    for k in range(width.size):
        v = speeds[len(factors) // 2, k]
        spare = ceiling[k + 1] ** 2 - v**2
        drag = float(middling.resistance(v)) + middling.mass * track[k]
        wanted = middling.inertia * spare / (2.0 * width[k]) + drag
        limit = min(120e3, 0.9 * train.max_traction_power / max(v, 1.0))
        traction[k] = min(max(wanted, 0.0), limit)
        for row, c in enumerate(configurations):
            u = speeds[row, k]
            drag = float(c.resistance(u)) + c.mass * track[k]
            square = u**2 + 2.0 * width[k] * (traction[k] - drag) / c.inertia
            excess = max(square - ceiling[k + 1] ** 2, 0.0)
            braking[row, k] = 0.5 * c.inertia * excess / width[k]
            speeds[row, k + 1] = np.sqrt(max(square - excess, 0.01 if k < width.size - 1 else 0.0))
    times = np.concatenate(
        (
            np.zeros((len(factors), 1)),
            np.cumsum(2.0 * width / (speeds[:, 1:] + speeds[:, :-1]), axis=1),
        ),
        axis=1,
    )
    return Trajectory(
        line=line.name,
        train=train.name,
        positions=nodes,
        configurations=configurations,
        speeds=speeds,
        times=times,
        tractive_effort=traction,
        braking_effort=braking,
        running_time=float(times[:, -1].max()),
    )
