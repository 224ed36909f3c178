"""How the track-condition map improves with the number of trips.

    python benchmarks/map/by_trips.py [--seeds 3] [--trips 100] [--steady]

Error of maximum adhesion in the bins with onsets of slip after 1, 3, 6 ... trips of one layer,
against two truths: what the line is without the passing spots and variations of single trips, and
the logarithmic mean over the trips that were counted. With ``--steady`` no trip meets a passing
spot of its own, only the line's lasting ones and 4 % of variation.

Passing spots set the floor: where one trip slipped and no other asked for more, nothing in the
logs says that the spot was gone the next day.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from analysis.adhesion.condition_map import empty_map, update
from analysis.adhesion.evidence import evidence_of
from analysis.adhesion.slip import slip
from trainlog.formats.line import read_line
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.formats.train import read_train
from trainlog.railway import StepProfile
from trainlog.simulation import Scenario, draw_scenarios, simulate
from trainlog.simulation.rail import base_map, smooth_variation

STAGES = (1, 3, 6, 12, 20, 50, 100)


def steady(scenario: Scenario, seed: int, number: int) -> Scenario:
    """The same trip without passing spots."""
    base = base_map(scenario.line, scenario.weather, seed)
    generator = np.random.default_rng([seed, number])
    values = base * np.exp(0.04 * smooth_variation(base.size, generator))
    profile = StepProfile(scenario.maximum_adhesion.positions, values)
    return replace(scenario, maximum_adhesion=profile)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--trips", type=int, default=100, help="half of them dry, half wet")
    parser.add_argument("--steady", action="store_true", help="without passing spots")
    options = parser.parse_args()
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    lasting = {stage: [] for stage in STAGES}
    counted = {stage: [] for stage in STAGES}
    covered = {stage: [] for stage in STAGES}
    for seed in range(1, options.seeds + 1):
        empty = empty_map(line)
        pieces = {"dry": [], "wet": []}
        for number, drawn in enumerate(draw_scenarios(line, train, options.trips, seed=seed)):
            scenario = steady(drawn, seed, number) if options.steady else drawn
            piece = evidence_of(
                slip(simulate(scenario)), empty, scenario.weather, sha256=scenario.name
            )
            pieces[scenario.weather].append((piece, scenario.maximum_adhesion(empty.centres)))
        for weather, known in pieces.items():
            base = base_map(line, weather, seed)
            for stage in STAGES:
                if stage > len(known):
                    break
                track, _ = update(empty, [piece for piece, _ in known[:stage]])
                layer = track.layer(weather)
                seen = layer.events > 0
                mean = np.mean(np.log([profile for _, profile in known[:stage]]), axis=0)
                lasting[stage].append((layer.maximum_adhesion - base)[seen])
                counted[stage].append((layer.maximum_adhesion - np.exp(mean))[seen])
                covered[stage].append(np.abs((layer.log_mean - mean) / layer.log_std)[seen] < 1.96)
    print("trips   bins  RMSE to the lasting line  RMSE to the mean of the trips  in 95 % band")
    for stage in STAGES:
        if lasting[stage]:
            a, b, c = (np.concatenate(each[stage]) for each in (lasting, counted, covered))
            print(
                f"{stage:5d}  {a.size:5d}  {np.sqrt(np.mean(a**2)):24.3f}"
                f"  {np.sqrt(np.mean(b**2)):29.3f}  {np.mean(c):12.3f}"
            )


if __name__ == "__main__":
    main()
