"""A small line and a train for the tests of the simulation: nothing read from disk."""

from dataclasses import replace

import numpy as np

from trainlog import Axles, Brake, CurvatureProfile, Train
from trainlog.railway import Geometry, Line, RunningResistance, Station, StepProfile, Tunnel
from trainlog.units import KMH


def steps(*pairs: tuple[float, float]) -> StepProfile:
    positions, values = zip(*pairs, strict=True)
    return StepProfile(np.array(positions, dtype=float), np.array(values, dtype=float))


def level_line(length=100_000.0, gradient=0.0, limit=60.0, **others):
    ends = Station("A", 0.0), Station("B", length)
    level = Line("level", length, ends, steps((0.0, limit)), steps((0.0, gradient)))
    return replace(level, **others)


def hilly_line() -> Line:
    """Eleven kilometres with all that a line can have."""
    length = 11_000.0
    nodes = np.linspace(0.0, length, 200)
    limits = (0.0, 80), (400.0, 120), (3_200.0, 90), (5_000.0, 125), (9_800.0, 70)
    return Line(
        name="hilly",
        length=length,
        stations=tuple(
            map(Station, ("Aach", "Berg", "Chur", "Dorf"), (0.0, 3_900.0, 7_050.0, length))
        ),
        speed_limits=steps(*((at, v / KMH) for at, v in limits)),
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
