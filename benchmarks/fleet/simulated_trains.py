"""Trains of three kinds on three lines, healthy or with a fault, simulated, recorded and fitted.

What is true of them is not what the estimator takes for true: trains differ by Laplace's
distribution, each in its own coefficients; trips by another one, serially correlated as weather
is, and one in fifteen by far more; wheels wear, winter adds to the mechanical part, converters and
delays differ from train to train.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd

from analysis.resistance import fit_trip
from analysis.resistance.combination import summarised
from analysis.resistance.passport import estimated_passport
from analysis.resistance.recording import TripRefusedError
from trainlog.formats.railway import train_to_bytes, with_passport
from trainlog.formats.ttobench import read_track, read_train
from trainlog.railway import Line, RunningResistance, Train
from trainlog.railway.adhesion import CreepCurve, polach_curve
from trainlog.simulation import draw_scenarios, sensors as measuring, simulate
from trainlog.simulation.scenario import Scenario, survey_error
from trainlog.trip import TRAIN_ATTACHMENT, Trip

DATA = Path(__file__).parents[3] / "shared" / "data" / "ttobench"
KINDS = {
    "flirt": "CH_Stadler_FLIRT_TPF",
    "kiss": "CH_Stadler_KISS_SBB",
    "virm": "NL_Intercity_VIRM6",
}
LINES = ("CH_StGallen_Wil", "CH_Stadelhofen_Altstetten", "00_var_gradient_minusplus_6")
START = pd.Timestamp("2025-10-01T06:00:00Z")
TRIPS_A_DAY = 2
QUANTITIES = (
    "effort_delay",
    "creep_lead",
    "effort_gain",
    "effort_over_mass",
    "mass",
    "load",
    "axle_effort_ratio",
)

RAILS = {
    "": None,
    "soft": CreepCurve(a=4.0, b=40.0, c=0.4, d=0.4, variable="creepage"),
    "Polach": polach_curve("wet"),
}
"""Forms of the creep curve: the simulation's own over slip speed, and two over creepage."""

FAULTS = {
    "dragging brake": 2000.0,
    "mass": 0.05,
    "wheel diameter": 0.01,
    "effort gain": 0.05,
    "sensor delay": 0.3,
}


@dataclass(frozen=True)
class Vehicle:
    """What is true of one train of a kind, beside what its file says."""

    name: str
    kind: str
    resistance: tuple[float, float, float]
    wheels: float
    axles: tuple[float, ...]
    gain: float
    delay: float
    mass: float
    wear: float


@dataclass(frozen=True)
class Task:
    """One trip: of a train, by number, with a fault or none, a channel that is missing, a rail."""

    seed: int
    kind: str
    train: int
    trip: int
    fault: str = ""
    missing: str = ""
    rail: str = ""


@cache
def line_of(name: str) -> Line:
    return read_track(DATA / "tracks" / f"{name}.json")


@cache
def train_of(kind: str) -> Train:
    return read_train(DATA / "trains" / f"{KINDS[kind]}.json")


def vehicle(seed: int, kind: str, number: int) -> Vehicle:
    """Train `number` of a kind in the fleet of a seed."""
    generator = np.random.default_rng([seed, 71, list(KINDS).index(kind), number])
    factors = 1.0 + np.clip(generator.laplace(0.0, 0.035, 3), -0.2, 0.2)
    axles = train_of(kind).axles.count
    return Vehicle(
        name=f"{kind}-{number + 1:02d}",
        kind=kind,
        resistance=(float(factors[0]), float(factors[1]), float(factors[2])),
        wheels=float(generator.uniform(-0.004, 0.004)),
        axles=tuple(generator.normal(0.0, 0.001, axles).tolist()),
        gain=1.0 + float(generator.normal(0.0, 0.012)),
        delay=float(generator.uniform(0.0, 0.15)),
        mass=1.0 + float(generator.normal(0.0, 0.004)),
        wear=float(generator.uniform(0.0, 0.0006)),
    )


def scenario_of(task: Task) -> tuple[Scenario, Vehicle, float]:
    """The drawn scenario, its train, and the months since the start of the fleet."""
    truth = vehicle(task.seed, task.kind, task.train)
    known = train_of(task.kind)
    generator = np.random.default_rng(
        [task.seed, 72, list(KINDS).index(task.kind), task.train, task.trip]
    )
    # A train changes lines every few days, as rosters do.
    roster = np.random.default_rng([task.seed, 73, task.train, task.trip // 6])
    line = line_of(LINES[int(roster.choice(3, p=(0.5, 0.2, 0.3)))])
    drawn = draw_scenarios(line, known, 8, int(generator.integers(2**31)))[task.trip % 8]
    start = START + pd.Timedelta(days=task.trip // TRIPS_A_DAY, hours=9 * (task.trip % TRIPS_A_DAY))
    months = task.trip / TRIPS_A_DAY / 30.44
    spread = generator.laplace(0.0, 0.02, 3) + _weather(task)
    if generator.uniform() < 1.0 / 15.0:
        spread += generator.uniform(-0.15, 0.25)
    winter = np.array([0.04, 0.0, 0.02]) * np.sin(2.0 * np.pi * (months - 1.0) / 12.0)
    nominal = known.resistance
    r0, r1, r2 = (
        coefficient * own * (1.0 + max(each, -0.3) + cold)
        for coefficient, own, each, cold in zip(
            (nominal.r0, nominal.r1, nominal.r2), truth.resistance, spread, winter, strict=True
        )
    )
    brake = FAULTS["dragging brake"] if task.fault == "dragging brake" else 0.0
    heavier = truth.mass + (FAULTS["mass"] if task.fault == "mass" else 0.0)
    return (
        replace(
            drawn,
            name=f"{truth.name}-{task.trip:04d}",
            survey_error=survey_error(line, 1000 + task.seed),
            mass=known.mass * heavier + drawn.load,
            resistance=RunningResistance(r0 + brake, r1, r2),
            max_power=known.max_traction_power * float(generator.normal(0.96, 0.01)),
            seed=int(generator.integers(2**31)),
            start=start.value,
            characteristic=RAILS[task.rail],
        ),
        truth,
        months,
    )


def _weather(task: Task) -> float:
    """What a day adds to the resistance of all trains, of which few notice another's."""
    days = np.random.default_rng([task.seed, 74]).normal(0.0, 0.012, 800)
    kept = 0.6 ** np.arange(12)
    day = task.trip // TRIPS_A_DAY + 12
    return float(days[day - 11 : day + 1][::-1] @ kept)


@contextmanager
def _wheels(truth: Vehicle, scale: float) -> Iterator[None]:
    """The wheels of this train, and not those that are drawn for a trip."""

    def scales(axles: int, *_: object) -> tuple[float, np.ndarray]:
        return scale, scale + np.array(truth.axles[:axles])

    with patch.object(measuring, "wheel_scales", scales):
        yield


def recorded(task: Task) -> tuple[Trip, Scenario, Vehicle]:
    """The trip as its train recorded it."""
    scenario, truth, months = scenario_of(task)
    worn = FAULTS["wheel diameter"] if task.fault == "wheel diameter" else 0.0
    if task.missing == "reference":
        blind = replace(scenario.sensors, balise_spacing=1e7)
        scenario = replace(scenario, sensors=blind)
    with _wheels(truth, 1.0 + truth.wheels + truth.wear * months + worn):
        trip = simulate(scenario)
    wander = np.random.default_rng([scenario.seed, 5]).normal(0.0, 0.003)
    gain = truth.gain * (1.0 + wander)
    gain *= 1.0 + (FAULTS["effort gain"] if task.fault == "effort gain" else 0.0)
    trip = _with_efforts(trip, gain, delay_of(task))
    # The load is weighed as a load, whatever the train itself weighs.
    empty = truth.mass + (FAULTS["mass"] if task.fault == "mass" else 0.0)
    load = max(scenario.mass - train_of(task.kind).mass * empty, 0.0)
    largest = train_of(task.kind).max_load or 20e3
    weighed, std = measuring.weighed_load(load, largest, scenario.sensors, scenario.seed)
    known = dict(trip.metadata) | {"load": f"{weighed:.0f}", "load_std": f"{std:.0f}"}
    known |= {"train": truth.name, "kind": task.kind}
    named = train_to_bytes(replace(train_of(task.kind), name=truth.name))
    trip = replace(trip, metadata=known, attachments={**trip.attachments, TRAIN_ATTACHMENT: named})
    return _without(trip, task.missing), scenario, truth


def delay_of(task: Task) -> float:
    """By how much the recorded efforts of a trip are late [s]."""
    own = vehicle(task.seed, task.kind, task.train).delay
    return own + (FAULTS["sensor delay"] if task.fault == "sensor delay" else 0.0)


def _with_efforts(trip: Trip, gain: float, late: float) -> Trip:
    """Recorded efforts times a gain, later by a time."""
    for topic in ("/train/controls", "/train/axles"):
        frame = trip[topic]
        names = [name for name in frame.columns if "effort" in name and "demand" not in name]
        time = frame.index.astype("int64").to_numpy() * 1e-9
        time = time - time[0]
        changed = {
            name: gain * np.interp(time - late, time, frame[name].to_numpy(np.float64))
            for name in names
        }
        found = frame.assign(**changed)
        found.attrs = frame.attrs
        trip = trip.with_topic(found)
    return trip


def _without(trip: Trip, missing: str) -> Trip:
    if missing in ("gnss", "reference"):
        kept = {n: f for n, f in trip.topics.items() if not n.startswith("/gnss")}
        return replace(trip, topics=kept)
    if missing == "load":
        known = {k: v for k, v in trip.metadata.items() if not k.startswith("load")}
        return replace(trip, metadata=known)
    if missing == "axles":
        return replace(trip, topics={n: f for n, f in trip.topics.items() if n != "/train/axles"})
    return trip


def row_of(task: Task) -> dict[str, object]:
    """What a fleet keeps of the trip, and (``true_...``) what no analysis reads."""
    trip, scenario, truth = recorded(task)
    found = estimated_passport(trip)
    try:
        row = summarised([fit_trip(with_passport(trip, found))]).iloc[0].to_dict()
    except TripRefusedError as error:
        trains = {trip.name: truth.name}
        row = summarised([], {trip.name: error}, trains=trains).iloc[0].to_dict()
    for name in QUANTITIES:
        each = getattr(found, name)
        row |= {name: each.value, f"{name}_std": each.std, f"{name}_source": each.source}
    for number, each in enumerate(found.wheel_factor, start=1):
        row |= {f"wheel_factor_{number}": each.value, f"wheel_factor_{number}_std": each.std}
    r, own = scenario.resistance, truth.resistance
    nominal = train_of(task.kind).resistance
    row |= {
        "key": f"{task.seed}-{truth.name}-{task.trip:05d}",
        "kind": task.kind,
        "line": scenario.line.name,
        "direction": scenario.direction,
        "start": pd.Timestamp(scenario.start, tz="UTC"),
        "empty_mass": train_of(task.kind).mass,
        "fault": task.fault,
        "missing": task.missing,
        "rail": task.rail,
        "true_effort_delay": delay_of(task),
        "fleet": task.seed,
        "number": task.trip,
        **{f"true_{n}": v for n, v in zip(("r0", "r1", "r2"), (r.r0, r.r1, r.r2), strict=True)},
        "own_r0": nominal.r0 * own[0],
        "own_r1": nominal.r1 * own[1],
        "own_r2": nominal.r2 * own[2],
    }
    return row


def rows_of(tasks: list[Task], jobs: int) -> pd.DataFrame:
    """Rows of trips, in processes of low priority."""
    with ProcessPoolExecutor(
        jobs, mp_context=get_context("spawn"), initializer=os.nice, initargs=(10,)
    ) as pool:
        return pd.DataFrame(list(pool.map(row_of, tasks, chunksize=8)))


def healthy(seed: int, trains: int, trips: int) -> list[Task]:
    """Every trip of a healthy fleet."""
    return [
        Task(seed, kind, train, trip)
        for kind in KINDS
        for train in range(trains)
        for trip in range(trips)
    ]
