"""How far the chain's answers are from the truth, over several series of twelve trips.

    python benchmarks/chain/benchmark_chain.py [--series 8]

Each series draws its own trips of the sample train on the sample line, and is fitted and mapped as
the demo does. The peer of the fit, in the same run, is what is usually done: running resistance
from differenced speed with the train's stated mass.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from analysis.adhesion.condition_map import empty_map, update
from analysis.adhesion.evidence import Evidence, evidence
from analysis.resistance import TripFit, combine, fit_trip
from analysis.truth import Truth, curve_error, map_error, truth_of
from trainlog.errors import NotIdentifiableError
from trainlog.formats.railway import line_of, read_line, read_train, train_of
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.railway import Line, RunningResistance, Train
from trainlog.simulation import draw_scenarios, simulate
from trainlog.trip import Trip, seconds


@dataclass(frozen=True)
class Series:
    """What twelve trips gave."""

    single: list[float]
    covered: list[bool]
    masses: list[float]
    refused: int
    together: float
    map_error: float
    map_bins: int
    differenced: list[float]


def differenced(trip: Trip) -> RunningResistance:
    """The peer: least squares on differenced speed, mass as the train's file says."""
    line, train = line_of(trip), train_of(trip)
    state, controls = trip["/train/state"], trip["/train/controls"]
    speed = state["speed"].to_numpy()
    acceleration = np.gradient(speed, seconds(state))
    effort = (
        controls["tractive_effort"]
        - controls["dynamic_braking_effort"]
        - controls["pneumatic_braking_effort"]
    ).to_numpy()
    track = line.track_acceleration(state["position"].to_numpy())
    mass = train.mass
    drag = effort - (mass + train.rotating_mass) * acceleration - mass * track
    used = (speed > 2.0) & (controls["pneumatic_braking_effort"].to_numpy() < 100.0)
    basis = np.column_stack([np.ones(speed.size), speed, speed**2])[used]
    return RunningResistance(*np.linalg.lstsq(basis, drag[used], rcond=None)[0].tolist())


def run(line: Line, train: Train, seed: int) -> Series:
    """Simulate, fit and map one series."""
    fits: list[TripFit] = []
    pieces: list[Evidence] = []
    truths: list[Truth] = []
    single: list[float] = []
    covered: list[bool] = []
    masses: list[float] = []
    peers: list[float] = []
    refused = 0
    track = empty_map(line)
    for scenario in draw_scenarios(line, train, count=12, seed=seed):
        trip = simulate(scenario)
        truth = truth_of(trip)
        assert truth is not None
        truths.append(truth)
        pieces.append(evidence(trip, track))
        peers.append(curve_error(differenced(trip), [truth]))
        try:
            fit = fit_trip(trip)
        except NotIdentifiableError:
            refused += 1
            continue
        fits.append(fit)
        low, high = fit.band(truth.speeds)
        true = truth.resistance(truth.speeds)
        single.append(curve_error(fit.resistance, [truth]))
        covered.append(bool(np.all((low <= true) & (true <= high))))
        masses.append(fit.mass / truth.mass - 1.0)
    track, _ = update(track, pieces)
    error, bins = map_error(track, truths)
    together = curve_error(combine(fits).resistance, truths)
    return Series(single, covered, masses, refused, together, error, bins, peers)


def main() -> None:
    """Print a row a series, then all of them together."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--series", type=int, default=8)
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    print("seed  one trip: median, worst  in band  refused  together  differenced  map RMSE (bins)")
    found = []
    for seed in range(1, parser.parse_args().series + 1):
        series = run(line, train, seed)
        found.append(series)
        print(
            f"{seed:4d}  {np.median(series.single):16.1%} {max(series.single):6.1%}"
            f"  {sum(series.covered):4d}/{len(series.covered):2d}  {series.refused:7d}"
            f"  {series.together:8.2%}  {np.median(series.differenced):11.0%}"
            f"  {series.map_error:8.4f} ({series.map_bins})",
            flush=True,
        )
    single = np.concatenate([series.single for series in found])
    covered = np.concatenate([series.covered for series in found])
    peers = np.concatenate([series.differenced for series in found])
    masses = np.concatenate([series.masses for series in found])
    print(
        f"all   one trip: median {np.median(single):.1%},"
        f" 90 % below {np.quantile(single, 0.9):.1%}, worst {single.max():.1%}\n"
        f"      whole curve in its 95 % band: {covered.mean():.1%} of {covered.size}\n"
        f"      twelve together: worst {max(series.together for series in found):.2%}\n"
        f"      mass: {np.sqrt(np.mean(masses**2)):.2%} RMS\n"
        f"      differenced speed: median {np.median(peers):.0%},"
        f" {np.median(peers) / np.median(single):.0f} times the error\n"
        f"      map: worst RMSE {max(series.map_error for series in found):.4f}"
    )


if __name__ == "__main__":
    main()
