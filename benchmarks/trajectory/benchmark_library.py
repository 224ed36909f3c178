"""Total gap and time of every track and train of TTOBench, from standstill to standstill.

    python benchmarks/trajectory/benchmark_library.py LIBRARY [--cells 500] [--reserves 0.02 0.05]
                                                      [-o runs.csv]

LIBRARY is the folder of TTOBench that holds ``tracks`` and ``trains``. Every run is made with its
energy at the wheel and at the line; a reserve of 0 is the least-time run. The gap is that on
the cells and what the cells cost. Times are of the processor.
"""

from __future__ import annotations

import argparse
import csv
import time
from itertools import product
from pathlib import Path
from typing import Any

from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from trainlog.errors import TrainlogError
from trainlog.formats.files import atomic_write
from trainlog.formats.ttobench import read_track, read_train
from trainlog.railway import Configuration, Line, Train

GAP_ASKED = 5e-4
"""Largest gap asked for."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("library", type=Path)
    parser.add_argument("--cells", type=int, default=500)
    parser.add_argument("--reserves", type=float, nargs="+", default=[0.02, 0.05, 0.1, 0.3])
    parser.add_argument("-o", "--output", type=Path, help="every run, as CSV")
    arguments = parser.parse_args()
    tracks = [read_track(path) for path in sorted((arguments.library / "tracks").glob("*.json"))]
    trains = [read_train(path) for path in sorted((arguments.library / "trains").glob("*.json"))]
    questions = product(tracks, trains, arguments.reserves, ("wheel", "line"))
    runs = [measured(*question, arguments.cells) for question in questions]
    if arguments.output:
        with atomic_write(arguments.output) as path, path.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(runs[0]))
            writer.writeheader()
            writer.writerows(runs)
    for reserve in arguments.reserves:
        print(summary([run for run in runs if run["reserve"] == reserve], arguments.cells))


def measured(
    line: Line, train: Train, reserve: float, objective: str, cells: int
) -> dict[str, Any]:
    """One run: its gap and what it took, or why there is none."""
    begin = time.process_time()
    run: dict[str, Any] = {
        "line": line.name, "train": train.name, "reserve": reserve, "objective": objective,
        "gap": float("nan"), "energy": float("nan"), "programs": 0, "cells": 0, "bound": "",
    }  # fmt: skip
    try:
        problem = TrajectoryProblem(
            line,
            train,
            [Configuration.of(train)],
            reserve=reserve,
            objective=objective,  # type: ignore[arg-type]
        )
        found = optimise(problem, OptimiserOptions(cells)).certificate
        run |= {
            **{name: found[name] for name in ("gap", "energy")},
            "programs": found["solver"]["iterations"],
            "cells": found["grid"]["cells"],
            "bound": found["solver"]["bound"],
        }
    except TrainlogError as refused:
        run["bound"] = str(refused)
    return run | {"seconds": time.process_time() - begin}


def summary(runs: list[dict[str, Any]], cells: int) -> str:
    """The runs of one reserve in one line."""
    gaps = [run["gap"] for run in runs if run["gap"] == run["gap"]]
    seconds = [run["seconds"] for run in runs]
    return (
        f"{cells} cells, reserve {runs[0]['reserve']:.0%}: {len(gaps)} of {len(runs)} audited,"
        f" gap {max(gaps, default=float('nan')):.4%} at worst,"
        f" above {GAP_ASKED:.2%} in {sum(gap > GAP_ASKED for gap in gaps)};"
        f" {sum(seconds):.1f} s, at most {max(seconds):.2f} s,"
        f" {max(run['programs'] for run in runs)} programs"
    )


if __name__ == "__main__":
    main()
