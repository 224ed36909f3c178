"""Random problems, each solved in a process of its own and judged by an independent integrator.

    python benchmarks/trajectory/benchmark_random.py [--problems 60] [--first 0] [--limit 60]
        [--jobs 1] [--kinds] [--library LIBRARY [--sample 40] [--curves] [--states 3]]
        [-o runs.csv]

Lines of 0.3 to 200 km, limits down to 5 km/h, gradients to 60 per mille, heavy weak trains,
reserves of 0 to 200 per cent, 1 to 50 configurations, energy at the wheel, at the line and
expected, both kinds of braking.

With --kinds each is one of twelve (`KINDS`) in turn: effort curves over speed, curve resistance,
passing times, sections of 5 km/h, slack runs, a common brake near the least time and others.

With LIBRARY, the folder of TTOBench that holds ``tracks`` and ``trains``, its runs instead, with
reserves of 0, 2, 10, 50 and 200 per cent and energy at the wheel and at the line; `--sample` of
them, drawn with a fixed seed, or all (0), or those of some numbers (`--only`). With --curves the
trains are those of TrainRuns and OSRD beside it, whose effort over speed is a published curve; with
--states each is loaded in a head wind, too, and empty with the wind.

Every answer is driven by scipy's DOP853 (`independent`): late by 1e-3 s, over a limit by 1e-6 m/s
or wrong in energy by 1e-3 counts as wrong. A refusal is right where the independent fastest run
fails too, and wrong where one configuration alone is refused that could run; of several it is
proven by the relaxation, or stays open. Certified is an answer whose gap is at most 0.2 per cent.
The limit is processor time, which other programs on the machine disturb less. For the state of
another checkout: the same command with PYTHONPATH there.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import resource
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from independent import CannotRunError, driven, least_time

from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.feasibility import UnprovenError
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from trainlog.errors import InfeasibleError, TrainlogError
from trainlog.formats import osrd
from trainlog.formats.files import atomic_write
from trainlog.formats.imports import with_curves
from trainlog.formats.railtoolkit import read_any
from trainlog.formats.ttobench import read_track, read_train
from trainlog.railway import (
    Configuration,
    CurvatureProfile,
    EffortCurve,
    Line,
    RunningResistance,
    Station,
    StepProfile,
    TimingPoint,
    Train,
)
from trainlog.units import KMH

SEED = 14_0_2
RESERVES = (0.0, 0.01, 0.03, 0.07, 0.15, 0.3, 0.6, 1.0, 2.0)
OUTCOMES = (
    "certified", "uncertified", "refused rightly", "refused, proven", "refused, open",
    "refused wrongly", "wrong", "crashed", "over time",
)  # fmt: skip
LEAST_TIME_TOLERANCE = 2e-4
"""Of the least time, relative, against the independent one."""

LEVELS = (5e-4, 2e-3, 5e-3)
"""Gaps that answers are counted by; the second is that of a certified one."""


def random_problem(number: int) -> TrajectoryProblem:
    """The problem of a number; the same on every machine."""
    random = np.random.default_rng([SEED, number])
    steepest = float(np.exp(random.uniform(np.log(1e-3), np.log(0.06))))
    train = _train(random, steepest)
    climbed = 0.85 * train.max_tractive_effort / (1.2 * train.mass * 9.81)
    # One in twenty may be too steep for its train.
    steepest = steepest if random.random() < 0.05 else min(steepest, climbed)
    braking = "common" if random.random() < 0.2 else "recourse"
    slow = braking == "common" and random.random() < 0.7
    return TrajectoryProblem(
        _line(random, steepest),
        train,
        _configurations(random, train),
        reserve=float(random.choice(RESERVES)),
        braking=braking,  # type: ignore[arg-type]
        objective=str(random.choice(("wheel", "line", "expected"), p=(0.45, 0.4, 0.15))),  # type: ignore[arg-type]
        final_speed=float(random.uniform(3.0, 15.0)) if slow else 0.0,
    )


def problem_of_kind(number: int) -> TrajectoryProblem:
    """The random problem of a number, as one of the twelve kinds; the same on every machine."""
    random = np.random.default_rng([SEED, 12, number])
    return KINDS[list(KINDS)[number % len(KINDS)]](random, random_problem(number))


Drawn = Callable[[np.random.Generator, TrajectoryProblem], TrajectoryProblem]


def _given(**changes: Any) -> Drawn:
    """The problem with these parts in place of its own."""
    return lambda _, problem: replace(problem, **changes)


def _near_least(random: np.random.Generator, problem: TrajectoryProblem) -> TrajectoryProblem:
    ends = float(random.uniform(3.0, 15.0))
    reserve = float(random.uniform(0.001, 0.01))
    return replace(problem, braking="common", reserve=reserve, final_speed=ends)


def _curve(random: np.random.Generator, effort: float, power: float, top: float) -> EffortCurve:
    """Points on or below what effort and power give, falling."""
    speeds = top * np.array([0.0, *np.sort(random.uniform(0.05, 0.95, 5)), 1.0])
    most = np.minimum(effort, power / np.maximum(speeds, 0.1))
    return EffortCurve(speeds, np.minimum.accumulate(most * random.uniform(0.8, 1.0, speeds.size)))


def _with_curves(random: np.random.Generator, problem: TrajectoryProblem) -> TrajectoryProblem:
    train = problem.train
    top = train.max_speed
    traction = _curve(random, train.max_tractive_effort, train.max_traction_power, top)
    braking = None
    if train.max_dynamic_braking_effort and random.random() < 0.5:
        most = train.max_dynamic_braking_effort, train.max_dynamic_braking_power
        braking = _curve(random, *most, top)
    changed = with_curves(train, traction, braking)
    share = changed.max_traction_power / train.max_traction_power
    which = [replace(each, max_power=share * each.max_power) for each in problem.configurations]
    return replace(problem, train=changed, configurations=which)


def _with_bends(random: np.random.Generator, problem: TrajectoryProblem) -> TrajectoryProblem:
    line = problem.line
    places = np.array([0.0, *_places(random, line.length, 400.0, 300)])
    bends = np.where(random.random(places.size) < 0.5, 0.0, 1.0 / random.uniform(250.0, 2e3))
    bends *= random.choice((-1.0, 1.0), places.size)
    curves = CurvatureProfile(places, bends, np.append(bends[1:], bends[-1]))
    return replace(problem, line=replace(line, curvatures=curves))


def _with_windows(random: np.random.Generator, problem: TrajectoryProblem) -> TrajectoryProblem:
    """One to three passing times that the fastest runs keep, with some of the reserve."""
    reserve = max(problem.reserve, 0.02)
    length = problem.line.length
    at = np.sort(random.uniform(0.1, 0.9, int(random.integers(1, 4)))) * length
    at = np.unique(np.round(at, 1))
    fastest = fastest_run(problem)
    points = []
    for place in at.tolist():
        least = max(np.interp(place, fastest.positions, row) for row in fastest.elapsed)
        latest = least * (1.0 + reserve * random.uniform(0.3, 1.5)) + 1.0
        earliest = max(latest - random.uniform(30.0, 300.0), 0.0) if random.random() < 0.5 else None
        points.append(TimingPoint(place, earliest, latest))
    return replace(problem, reserve=reserve, windows=points)


def _crawling(random: np.random.Generator, problem: TrajectoryProblem) -> TrajectoryProblem:
    limits = problem.line.speed_limits
    slow = random.random(limits.values.size) < 0.3
    slow[random.integers(slow.size)] = True
    speeds = np.where(slow, 5.0 / KMH, limits.values)
    return replace(
        problem, line=replace(problem.line, speed_limits=StepProfile(limits.positions, speeds))
    )


def _many(random: np.random.Generator, problem: TrajectoryProblem) -> TrajectoryProblem:
    return replace(problem, configurations=_configurations(random, problem.train, 0.9))


KINDS: dict[str, Drawn] = {
    "wheel": _given(objective="wheel", braking="recourse"),
    "line": _given(objective="line", braking="recourse"),
    "expected": _given(objective="expected", braking="recourse"),
    "common brake": lambda random, problem: replace(
        problem, braking="common", final_speed=float(random.uniform(3.0, 15.0))
    ),
    "common brake, least time": _near_least,
    "effort curves": _with_curves,
    "effort curves, line": lambda random, problem: replace(
        _with_curves(random, problem), objective="line"
    ),
    "bends": _with_bends,
    "passing times": _with_windows,
    "5 km/h": _crawling,
    "slack": lambda random, problem: replace(problem, reserve=float(random.uniform(1.5, 3.5))),
    "many configurations": _many,
}
"""What is drawn besides, by the name of the kind."""


def _line(random: np.random.Generator, steepest: float) -> Line:
    length = float(np.exp(random.uniform(np.log(300.0), np.log(200e3))))
    top = random.uniform(60.0, 200.0)
    limits = np.array([0.0, *_places(random, length, random.uniform(1e3, 20e3), 60)])
    speeds = np.maximum(5.0 * np.round(random.uniform(0.3, 1.0, limits.size) * top / 5.0), 20.0)
    slow = random.random(limits.size) < 0.05
    speeds[slow] = random.choice((5.0, 10.0, 20.0), size=int(slow.sum()))
    slopes = np.array([0.0, *_places(random, length, np.exp(random.uniform(4.6, 8.5)), 1000)])
    return Line(
        name="random",
        length=length,
        stations=(Station("A", 0.0), Station("B", length)),
        speed_limits=StepProfile(limits, speeds / KMH),
        gradients=StepProfile(slopes, steepest * random.uniform(-1.0, 1.0, slopes.size)),
    )


def _places(random: np.random.Generator, length: float, apart: float, most: int) -> list[float]:
    count = min(int(random.poisson(length / apart)), most)
    places = np.unique(np.round(random.uniform(0.0, length, count), 1))
    return [place for place in places.tolist() if 5.0 < place < length - 5.0]


def _train(random: np.random.Generator, steepest: float) -> Train:
    def between(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    mass = between(30e3, 4_000e3)
    pull, power = between(0.08, 1.2) * mass, between(0.8, 20.0) * mass
    stop = max(between(0.25, 1.2), 1.4 * 9.81 * steepest)
    dynamic = random.random() < 0.7
    return Train(
        name="random",
        mass=mass,
        rotating_mass_factor=float(random.uniform(0.02, 0.15)),
        resistance=RunningResistance(
            mass * 9.81e-3 * random.uniform(0.6, 3.0),
            0.0 if random.random() < 0.4 else mass * random.uniform(0.0, 3e-4),
            random.uniform(3.0, 10.0) + mass * random.uniform(0.0, 1e-5),
        ),
        max_tractive_effort=pull,
        max_traction_power=power,
        max_dynamic_braking_effort=pull if dynamic else 0.0,
        max_dynamic_braking_power=power if dynamic else 0.0,
        max_pneumatic_braking_effort=1.3 * stop * mass,
        max_speed=float(random.uniform(80.0, 250.0)) / KMH,
        max_acceleration=float(random.uniform(0.6, 1.3)),
        max_deceleration=stop,
        efficiency_traction=float(random.uniform(0.7, 0.95)),
        efficiency_regeneration=float(random.uniform(0.5, 0.9)) if dynamic else 0.0,
    )


def _configurations(
    random: np.random.Generator, train: Train, kind: float | None = None
) -> tuple[Configuration, ...]:
    kind = random.random() if kind is None else kind
    count = (
        1 if kind < 0.4 else int(random.integers(2, 13) if kind < 0.8 else random.integers(13, 51))
    )
    if count == 1:
        return (Configuration.of(train),)
    spread, load = random.uniform(0.01, 0.15), random.uniform(0.0, 0.2)
    return tuple(
        Configuration(
            f"c{number}",
            train.mass * (1.0 + random.uniform(0.0, load)),
            train.rotating_mass,
            train.resistance.scaled(1.0 + random.uniform(-spread, spread)),
            train.max_traction_power * (1.0 - random.uniform(0.0, spread)),
        )
        for number in range(count)
    )


def library_problems(
    folder: Path, sample: int, *, curves: bool = False, states: int = 1
) -> list[TrajectoryProblem]:
    """Every track with every train, or some; in so many states of load and resistance."""
    tracks = [read_track(path) for path in sorted((folder / "tracks").glob("*.json"))]
    trains = [read_train(path) for path in sorted((folder / "trains").glob("*.json"))]
    if curves:
        trains = curved_trains(folder.parent)
    questions = list(product(tracks, trains, (0.0, 0.02, 0.1, 0.5, 2.0), ("wheel", "line")))
    if 0 < sample < len(questions):
        drawn = np.random.default_rng(SEED).choice(len(questions), sample, replace=False)
        questions = [questions[each] for each in sorted(drawn.tolist())]
    return [
        TrajectoryProblem(
            track,
            train,
            states_of(train)[:states],
            reserve=reserve,
            objective=objective,  # type: ignore[arg-type]
        )
        for track, train, reserve, objective in questions
    ]


def curved_trains(folder: Path) -> list[Train]:
    """Trains whose effort is a published curve over speed: of TrainRuns and of OSRD."""
    runs = sorted((folder / "trainruns" / "trains").glob("*.yaml"))
    stocks = sorted((folder / "osrd" / "rolling_stocks").glob("*.json"))
    found = [train for path in runs for _, train, _ in read_any(path, 1.0)]
    return [each for each in found if isinstance(each, Train)] + [
        osrd.read_train(path)[0] for path in stocks
    ]


def states_of(train: Train) -> list[Configuration]:
    """A train as it is, loaded in a head wind, and empty with the wind."""
    own = Configuration.of(train)
    return [own] + [
        replace(own, name=name, mass=mass * own.mass, resistance=own.resistance.scaled(factor))
        for name, mass, factor in (("loaded", 1.08, 1.15), ("empty", 0.95, 0.9))
    ]


def judged(problem: TrajectoryProblem, limit: float) -> Iterator[dict[str, Any]]:
    """What the optimiser answers, and what the independent integrator makes of it; in two parts."""
    begin = time.process_time()
    resource.setrlimit(resource.RLIMIT_CPU, (int(begin + limit) + 1, resource.RLIM_INFINITY))
    refusal, found, proven = "", None, False
    try:
        found = optimise(problem, OptimiserOptions())
    except TrainlogError as refused:
        refusal = str(refused)
        proven = isinstance(refused, InfeasibleError) and not isinstance(refused, UnprovenError)
    resource.setrlimit(resource.RLIMIT_CPU, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    yield {"outcome": "answered", "seconds": time.process_time() - begin}
    try:
        least = max(least_time(problem, each) for each in problem.configurations)
    except CannotRunError as cannot:
        yield {"outcome": "wrong" if found else "refused rightly", "words": f"{cannot}; {refusal}"}
        return
    if found is None:
        outcome = "refused, proven" if proven else "refused, open"
        if len(problem.configurations) == 1:
            outcome = "refused wrongly"
        yield {"outcome": outcome, "words": refusal}
        return
    certificate = found.certificate
    faults = driven(problem, found).faults(problem, found)
    off = max(certificate["least_time"]) / least - 1.0
    if abs(off) > LEAST_TIME_TOLERANCE:
        faults.append(f"least time wrong by {off:+.2%}")
    outcome = "certified" if certificate["certified"] else "uncertified"
    yield {
        "outcome": "wrong" if faults else outcome,
        "words": "; ".join(faults),
        "gap": certificate["gap"],
        "cells": certificate["grid"]["cells"],
        "least_time": off,
    }


def _work(pipe: Any, problem: TrajectoryProblem, limit: float) -> None:
    try:
        for part in judged(problem, limit):
            pipe.send(part)
    except Exception as crash:
        where = traceback.extract_tb(crash.__traceback__)[-1]
        words = f"{type(crash).__name__}: {crash} ({Path(where.filename).name}:{where.lineno})"
        pipe.send({"outcome": "crashed", "words": words, "seconds": 0.0})
        raise


def measured(problem: TrajectoryProblem, limit: float) -> dict[str, Any]:
    """One row of the table, from a process of its own."""
    context = multiprocessing.get_context("fork")
    mine, other = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(other, problem, limit))
    process.start()
    other.close()
    row: dict[str, Any] = {"outcome": "over time", "seconds": limit}
    try:
        while True:
            row |= mine.recv()
    except EOFError:
        process.join()
    if row["outcome"] == "over time" and process.exitcode != -24:  # SIGXCPU
        row["outcome"], row["words"] = "crashed", f"the process ended with {process.exitcode}"
    return row


def described(problem: TrajectoryProblem) -> dict[str, Any]:
    """The problem in a few columns."""
    line, train = problem.line, problem.train
    return {
        "line": line.name[:16],
        "train": train.name[:16],
        "km": line.length / 1e3,
        "steepest": 1e3 * float(np.abs(line.gradients.values).max()),
        "slowest": KMH * float(line.speed_limits.values.min()),
        "tonnes": train.mass / 1e3,
        "q": len(problem.configurations),
        "reserve": problem.reserve,
        "objective": problem.objective,
        "braking": problem.braking,
    }


def printed(number: int, row: dict[str, Any]) -> str:
    """One row of the table as text."""
    return (
        f"{number:4d} {row['line']:16s} {row['train']:16s} {row['km']:7.2f} {row['steepest']:5.1f}"
        f" {row['slowest']:5.0f} {row['tonnes']:6.0f} {row['q']:3d} {row['reserve']:5.0%}"
        f" {row['objective']:8s} {row['braking']:8s} {row['seconds']:6.1f}"
        f" {100.0 * row.get('gap', np.nan):8.3f}"
        f" {1e6 * row.get('least_time', np.nan):+7.0f}"
        f"  {row['outcome']}{': ' * bool(row.get('words'))}{row.get('words', '')}"
    )


def counted(rows: list[dict[str, Any]]) -> str:
    """How many came how close to their bounds."""
    found = np.array([row.get("gap", np.nan) for row in rows])
    return "gap at most: " + ", ".join(f"{(found <= most).sum()} {most:.2%}" for most in LEVELS)


def warmed() -> None:
    """Compile and load what all processes need, before they are forked."""
    for number, change in ((1, {}), (2, {"objective": "line"})):
        random = np.random.default_rng(number)
        train = _train(random, 0.005)
        problem = TrajectoryProblem(
            _line(random, 0.002), train, [Configuration.of(train)], reserve=0.1, **change
        )
        optimise(problem, OptimiserOptions(60))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="*", default=[], help="of these numbers")
    parser.add_argument("--limit", type=float, default=60.0, help="processor time of one [s]")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--kinds", action="store_true", help="twelve kinds in turn")
    parser.add_argument("--library", type=Path)
    parser.add_argument("--sample", type=int, default=40, help="runs of the library; 0: all")
    parser.add_argument("--curves", action="store_true", help="trains of TrainRuns and OSRD")
    parser.add_argument("--states", type=int, default=1, help="of each train, at most 3")
    parser.add_argument("-o", "--output", type=Path, help="every run, as CSV")
    arguments = parser.parse_args()
    numbers = arguments.only or range(arguments.first, arguments.first + arguments.problems)
    make: Callable[[int], TrajectoryProblem] = (
        problem_of_kind if arguments.kinds else random_problem
    )
    if arguments.library:
        runs = library_problems(
            arguments.library,
            0 if arguments.only else arguments.sample,
            curves=arguments.curves,
            states=arguments.states,
        )
        numbers, make = arguments.only or range(len(runs)), runs.__getitem__
    warmed()
    rows = []

    def one(number: int) -> None:
        problem = make(number)
        rows.append({"number": number} | described(problem) | measured(problem, arguments.limit))
        print(printed(number, rows[-1]), flush=True)

    print(
        " no. line             train                 km  o/oo  km/h tonnes   q  res. energy  "
        " braking   CPU s    gap %    ppm"
    )
    with ThreadPoolExecutor(arguments.jobs) as pool:
        list(pool.map(one, numbers))
    counts = Counter(row["outcome"] for row in rows)
    print(f"{len(rows)} problems: " + ", ".join(f"{counts[each]} {each}" for each in OUTCOMES))
    print(counted(rows))
    seconds = np.array([row["seconds"] for row in rows])
    print(f"processor time: median {np.median(seconds):.2f} s, most {seconds.max():.1f} s")
    if arguments.kinds:
        for place, kind in enumerate(KINDS):
            own = [row for row in rows if row["number"] % len(KINDS) == place]
            if own:
                listed = Counter(row["outcome"] for row in own)
                words = ", ".join(f"{listed[each]} {each}" for each in OUTCOMES if listed[each])
                slowest = max(row["seconds"] for row in own)
                print(f"  {kind:26s} {words}; {slowest:.1f} s at most")
    if arguments.output:
        names = list(dict.fromkeys(name for row in rows for name in row))
        with atomic_write(arguments.output) as path, path.open("w", newline="") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(sorted(rows, key=lambda row: row["number"]))


if __name__ == "__main__":
    main()
