"""How near a line built from trips' satellite fixes comes to the true one.

    python benchmarks/chainage/benchmark_geometry.py [--line FILE ...]

For 1, 3 and 10 trips in both directions, with fixes of 3 m once and five times a second, four
outages of 60 s a trip and reflections at the stations: distance between the line built and the
true one, error of its length, of its curvature, and of the chainage of a further trip on it, the
constant between the two zeros taken off.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmark_chainage import PROFILE, Receiver, driven, received, rms

from analysis.geometry.centre_line import geometry_of, line_of
from trainlog.formats.railway import read_line
from trainlog.formats.samples import DEFAULT_LINE, sample
from trainlog.ingest.chainage import estimated_state
from trainlog.railway.geometry import beside, nearest_on, track_of


def compared(path: Path, receiver: Receiver, count: int, first: int):
    trips = [
        received(driven(path, seed), replace(receiver, rate=(1.0, 5.0)[seed % 3 == 0]), seed)
        for seed in range(first, first + count)
    ]
    start = time.process_time()
    centre_line = geometry_of(trips)
    spent = time.process_time() - start
    line = read_line(path)
    true = track_of(line.geometry)
    points = true.plane(centre_line.latitude, centre_line.longitude)
    near, _ = nearest_on(true, points)
    at, aside = beside(true, points, near)
    known = centre_line.support > 0
    backwards = at[-1] < at[0]
    sign = -1.0 if backwards else 1.0
    # The true line's chainage is not quite its length on the earth.
    length = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(true.points)))))
    stretch = abs(np.diff(np.interp(at[[0, -1]], true.positions, length))[0])
    bend = centre_line.curvature[known] - sign * line.curvature(at[known])
    # A further trip, in the direction of the centre_line, against the truth on the line built.
    truth = driven(path, 101)
    trip = received(truth, receiver, 101)
    built = line_of(centre_line, "built")
    forward = not backwards
    same = forward == (101 % 2 == 0)
    frame = estimated_state(trip, built if same else built.reversed(), PROFILE).frame
    position, _ = truth.at(frame.index.as_unit("ns").asi8)
    travelled = length[-1] - length[::-1] if 101 % 2 else length
    marks = line.length - true.positions[::-1] if 101 % 2 else true.positions
    error = frame["position"].to_numpy() - np.interp(position, marks, travelled)
    frame = estimated_state(trip, truth.line, PROFILE).frame
    position, _ = truth.at(frame.index.as_unit("ns").asi8)
    given = frame["position"].to_numpy() - position
    return {
        "aside": rms(aside[known]),
        "band": np.mean(np.abs(aside[known]) < 1.96 * centre_line.std[known]),
        "unsupported": sum(e - s for s, e in centre_line.unsupported),
        "length": (centre_line.length - stretch) / stretch * 1e3,
        "curvature": rms(bend),
        "curvature_band": np.mean(np.abs(bend) < 1.96 * centre_line.curvature_std[known]),
        "chainage": np.std(error),
        "given": np.std(given),
        "spent": spent,
        "rejected": centre_line.rejected,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--line", type=Path, nargs="*", default=[sample(DEFAULT_LINE)])
    parser.add_argument("--sets", type=int, default=2, help="sets of trips a row")
    options = parser.parse_args()
    for path in options.line:
        print(f"\n{read_line(path).name}")
        print(
            "noise        trips  across [m]  band  without fixes [m]  length [m/km]"
            "  curvature [1/km]  band  further trip [m]  on the true line  CPU [s]"
        )
        for name, receiver in (
            ("white", Receiver("white")),
            ("lasting 30 s", Receiver("lasting", lasting=30.0)),
        ):
            for count in (1, 3, 10):
                sets = [compared(path, receiver, count, 1 + 10 * k) for k in range(options.sets)]
                mean = {key: np.mean([one[key] for one in sets]) for key in sets[0]}
                length = rms(np.array([one["length"] for one in sets]))
                print(
                    f"{name:12s} {count:5d} {mean['aside']:11.2f} {mean['band']:5.0%}"
                    f" {mean['unsupported']:18.0f} {length:14.3f}"
                    f" {1e3 * mean['curvature']:17.3f} {mean['curvature_band']:5.0%}"
                    f" {mean['chainage']:17.2f} {mean['given']:17.2f} {mean['spent']:8.1f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
