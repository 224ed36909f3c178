"""Whether the band of a train's resistance holds where trips on different routes share edges.

Trips run over three routes of a network with a junction; the gradients of each edge were surveyed
once, with errors that all trips over the edge meet. Efforts are those of the true gradients; speeds
and efforts have noise. Of each replication the band of all trips together is compared with the true
curve, with the errors of an edge shared by the trips that ran over it, and, for comparison, with
the trips of different routes taken for independent.

    python benchmarks/identification/routes.py --replications 40
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from analysis.resistance.combination import combine, summarised
from analysis.resistance.fit import fit_trip
from analysis.resistance.recording import TripRefusedError
from trainlog import (
    DEFAULT_TRAIN,
    Edge,
    Line,
    Network,
    Node,
    StepProfile,
    Trip,
    frame_of,
    read_train,
    sample,
)
from trainlog.formats.railway import line_to_bytes, train_to_bytes
from trainlog.topics import TRAIN_CONTROLS, TRAIN_STATE

TRAIN = read_train(sample(DEFAULT_TRAIN))
ROUTES = (("A", "B"), ("A", "C"), ("D", "B"), ("D", "C"))
"""All run over the trunk from J to K."""

LENGTHS = {"A-J": 4e3, "D-J": 6e3, "J-K": 14e3, "K-B": 5e3, "K-C": 4e3}
PIECE, ERROR = 400.0, 6e-4
"""Length of the pieces of gradient [m], and standard deviation of their errors."""


def network(draw: np.random.Generator) -> tuple[Network, Network]:
    """A network as surveyed, and the errors of its gradients as one of the same shape."""

    def of(gradients: dict[str, StepProfile]) -> Network:
        return Network(
            "H",
            tuple(Node(name, "junction" if name in "JK" else "station") for name in "ABCDJK"),
            tuple(
                Edge(
                    name,
                    Line(name, length, (), StepProfile([0.0], [50.0]), gradients[name]),
                    *name.split("-"),
                )
                for name, length in LENGTHS.items()
            ),
        )

    edges = {name: np.arange(0.0, length, PIECE) for name, length in LENGTHS.items()}
    slopes = {name: StepProfile(at, draw.normal(0.0, 6e-3, at.size)) for name, at in edges.items()}
    errors = {name: StepProfile(at, draw.normal(0.0, ERROR, at.size)) for name, at in edges.items()}
    return of(slopes), of(errors)


def driven(
    name: str, line: Line, true: StepProfile, mass: float, draw: np.random.Generator
) -> Trip:
    """A trip over a route whose gradients are `true` and were surveyed as those of `line`."""
    step = 0.2
    time = np.arange(0.0, 3_000.0, step)
    waves = sum(np.sin(time / draw.uniform(20.0, 120.0) + draw.uniform(0.0, 6.0)) for _ in range(3))
    speed = (24.0 + 4.0 * waves) * np.sin(0.5 * np.pi * np.clip(time / 70.0, 0.0, 1.0))
    position = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * step)))
    within = position < line.length
    time, speed, position = time[within], speed[within], position[within]
    ground = replace(line, gradients=true)
    effort = (mass + TRAIN.rotating_mass) * np.gradient(speed, time) + TRAIN.resistance(speed)
    effort += mass * ground.track_acceleration(position)
    stamps = np.int64(1_700_000_000_000_000_000) + np.round(time * 1e9).astype(np.int64)
    noise = 1.0 + 0.01 * draw.standard_normal(time.size)
    return Trip(
        {
            "/train/state": frame_of(
                TRAIN_STATE,
                stamps,
                {"position": position, "speed": speed + 0.02 * draw.standard_normal(time.size)},
            ),
            "/train/controls": frame_of(
                TRAIN_CONTROLS,
                stamps,
                {
                    "tractive_effort_demand": np.maximum(effort, 0.0),
                    "tractive_effort": np.maximum(effort, 0.0) * noise,
                    "dynamic_braking_effort": np.maximum(-effort, 0.0) * noise,
                    "pneumatic_braking_effort": np.zeros(time.size),
                },
            ),
        },
        {"trip": name, "train": TRAIN.name, "direction": "forward", "load": f"{mass - TRAIN.mass}"},
        attachments={"line.json": line_to_bytes(line), "train.json": train_to_bytes(TRAIN)},
    )


def replication(seed: int, trips: int) -> dict[str, tuple[float, float]]:
    """Error and standard deviation of the curve at 25 m/s [N], shared by edge and independent."""
    draw = np.random.default_rng(seed)
    surveyed, errors = network(draw)
    fits = []
    for number in range(trips):
        places = ROUTES[number % len(ROUTES)]
        line = surveyed.route(*places).line
        error = errors.route(*places).line.gradients
        true = StepProfile(line.gradients.positions, line.gradients.values + error.values)
        mass = TRAIN.mass + draw.uniform(0.0, 20e3)
        try:
            fits.append(fit_trip(driven(f"trip {number}", line, true, mass, draw)))
        except TripRefusedError as refused:
            print(f"  seed {seed}: {refused}")
    rows = summarised(fits)
    # By route, as lines of their own: what trips of other routes share is not known then.
    apart = rows.assign(gradients=[f"route {n % len(ROUTES)}" for n in range(len(rows))])
    found = {}
    for name, given in (("edges", rows), ("routes", apart)):
        common = combine(given)
        error_at = float(common.resistance(25.0) - TRAIN.resistance(25.0))
        found[name] = (error_at, float(common.std(25.0)))
    return found


def main() -> None:
    """State how often the 95 % band holds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replications", type=int, default=40)
    parser.add_argument("--trips", type=int, default=8)
    given = parser.parse_args()
    found = [replication(seed, given.trips) for seed in range(given.replications)]
    for name in ("edges", "routes"):
        errors, stds = np.array([each[name] for each in found]).T
        inside = np.mean(np.abs(errors) < 1.96 * stds)
        print(
            f"{name}: {inside:.0%} of {len(found)} within the 95 % band at 25 m/s;"
            f" rms error {np.sqrt(np.mean(errors**2)):.0f} N, mean deviation {np.mean(stds):.0f} N"
        )


if __name__ == "__main__":
    main()
