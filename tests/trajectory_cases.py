"""Lines and trains for the tests of the trajectories.

The VIRM6 and the level line restate facts of TTOBench v1.5 (BSD-2-Clause).
"""

from dataclasses import replace
from typing import Any

import numpy as np
from simulated_line import level_line as level, steps

from analysis import OptimiserOptions, TrajectoryProblem, optimise, optimise_journey
from analysis.studies.cunillera_2022 import TRAIN
from trainlog.formats.railway import read_train
from trainlog.formats.samples import DEFAULT_TRAIN, sample
from trainlog.railway import CurvatureProfile, Line, RunningResistance, Station, Tunnel
from trainlog.railway.condition import BIN_LENGTH, ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence
from trainlog.railway.train import Axles, Configuration, Train
from trainlog.units import KMH

VIRM6 = replace(TRAIN, efficiency_traction=0.875, efficiency_regeneration=0.7)

FLIRT = read_train(sample(DEFAULT_TRAIN))

FREIGHT = replace(
    FLIRT,
    name="freight",
    mass=920_000.0,
    rotating_mass_factor=0.05,
    resistance=RunningResistance(9_000.0, 150.0, 40.0),
    max_tractive_effort=300_000.0,
    max_traction_power=5_600_000.0,
    max_dynamic_braking_effort=150_000.0,
    max_pneumatic_braking_effort=400_000.0,
    max_speed=100.0 / KMH,
    max_acceleration=0.3,
    max_deceleration=0.4,
    length=500.0,
    axles=Axles(count=8, adhesive_mass=224_000.0),
)


def free_train(pull: float, power: float, brake: float, **changes: Any) -> Train:
    """Nothing resists it; efforts [m/s²] and power [W/kg] over its mass of 100 t."""
    mass = 100e3
    train = Train(
        name="free", mass=mass, rotating_mass_factor=0.0,
        resistance=RunningResistance(0.0, 0.0, 0.0), max_tractive_effort=pull * mass,
        max_traction_power=power * mass, max_pneumatic_braking_effort=brake * mass,
        max_speed=100.0,
    )  # fmt: skip
    return replace(train, **changes)


def optimised(line=None, train=FLIRT, configurations=None, *, cells=500, **question):
    """The optimum of a problem given by its attributes; of a FLIRT on the hilly line by default."""
    configurations = observed(train, 1.0) if configurations is None else configurations
    options = {n: question.pop(n) for n in ("tolerance", "time_limit") if n in question}
    problem = TrajectoryProblem(line or hilly_line(), train, configurations, **question)
    return optimise(problem, OptimiserOptions(cells, **options))


def optimised_journey(line, train, configurations, journey, *, dwell=0.0, cells=500, **question):
    """The optimum of a journey on a line."""
    problem = TrajectoryProblem(line, train, configurations, **question)
    return optimise_journey(problem, journey, OptimiserOptions(cells), dwell=dwell)


def level_line(length: float = 48_531.0, *limits: tuple[float, float], **others: Any) -> Line:
    """TTOBench's reference: level, 140 km/h unless stated otherwise [m, km/h]."""
    permitted = steps(*((s, v / KMH) for s, v in limits or ((0.0, 140.0),)))
    return level(length, speed_limits=permitted, **others)


def hilly_line() -> Line:
    """Eight kilometres with all that a line can have, bends of opposite hand included."""
    length, left, right, last = 8_000.0, 1 / 400, -1 / 350, 1 / 500
    bends = CurvatureProfile(
        np.array([0.0, 700.0, 800.0, 1.5e3, 1.64e3, 2.5e3, 2.6e3, 5.1e3, 5.2e3, 5.9e3]),
        np.array([0.0, 0.0, left, left, right, right, 0.0, 0.0, last, last]),
        np.array([0.0, left, left, right, right, 0.0, 0.0, last, last, 0.0]),
    )
    return Line(
        name="hilly",
        length=length,
        stations=(Station("A", 0.0), Station("B", 5_000.0), Station("C", length)),
        speed_limits=steps(
            (0.0, 90 / KMH), (600.0, 125 / KMH), (3_000.0, 80 / KMH), (4_500.0, 110 / KMH)
        ),
        gradients=steps(
            (0.0, 0.0), (900.0, 0.012), (2_000.0, -0.018), (3_600.0, -0.002), (6_000.0, 0.007)
        ),
        curvatures=bends,
        tunnels=(Tunnel(6_200.0, 900.0, 24.0),),
    )


def observed(train: Train, *factors: float, load: float = 0.0) -> list[Configuration]:
    """Configurations whose running resistance is the train's own times each factor."""
    nominal = Configuration.of(train, load)
    return [
        replace(nominal, name=f"x{factor:g}", resistance=train.resistance.scaled(factor))
        for factor in factors
    ]


def drawn(train: Train, count: int, seed: int = 0, spread: float = 0.1) -> list[Configuration]:
    """Configurations drawn at random: resistance, load and power vary."""
    random = np.random.default_rng(seed)
    return [
        Configuration(
            f"trip {number}",
            train.mass * (1.0 + random.uniform(0.0, spread)),
            train.rotating_mass,
            train.resistance.scaled(1.0 + random.uniform(-spread, spread)),
            train.max_traction_power * (1.0 - random.uniform(0.0, spread)),
        )
        for number in range(count)
    ]


def slippery(line: Line, *spots: tuple[float, float, float]) -> TrackConditionMap:
    """A map that knows 0.30 everywhere but in the spots (from [m], to [m], maximum adhesion)."""
    bins = int(np.ceil(line.length / BIN_LENGTH))
    centres = (np.arange(bins) + 0.5) * BIN_LENGTH
    adhesion = np.full(bins, 0.30)
    for start, end, value in spots:
        adhesion[(centres > start) & (centres < end)] = value
    layer = ConditionLayer(
        log_mean=np.log(adhesion),
        log_std=np.full(bins, 0.05),
        observed=np.ones(bins, dtype=bool),
        evidence=DailyEvidence.none(bins, 3),
    )
    levels = np.array([0.1, 0.2, 0.3])
    return TrackConditionMap(line.name, line.length, BIN_LENGTH, levels, {"wet": layer})
