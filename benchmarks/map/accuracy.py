"""How near the track-condition map comes to the truth of simulated trips.

    python benchmarks/map/accuracy.py [--seeds 8] [--trips 12] [--noise 0.03] [--rate 10]

For each seed (another line condition, other trips): error of maximum adhesion in the bins with
onsets of slip, by layer and together; share of those bins in the 95 % band; slip events found and
false, of those that are 0.15 m/s (or 4 standard deviations of the noise) clear of the threshold;
error of the single onsets. The truth of a layer is the logarithmic mean over its trips.
"""

from __future__ import annotations

import argparse

import numpy as np

from analysis.adhesion.condition_map import empty_map, update
from analysis.adhesion.evidence import evidence_of
from analysis.adhesion.slip import SlipAnalysis, slip
from analysis.truth import Truth, true_adhesion, truth_of
from estimators.adhesion import SlipDetector
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.simulation import Scenario, draw_scenarios, drive, recorded
from trainlog.simulation.sensors import Sensors
from trainlog.spans import runs_of


def counted(found: SlipAnalysis, slip_speed, margin: float):
    """Slips that truly were and were missed; that were reported and were not."""
    truly = SlipDetector(slip_speed.shape[1], 0.0).update(slip_speed)
    counts = np.zeros(4, dtype=int)
    for axle in range(slip_speed.shape[1]):
        size, reported = np.abs(slip_speed[:, axle]), found.slipping[:, axle]
        for a, b in runs_of(truly[:, axle]):
            if size[a:b].max() > 1.5 + margin:
                counts[:2] += (1, not reported[a:b].any())
        for a, b in runs_of(reported):
            counts[2:] += (1, size[max(a - 1, 0) : b + 1].max() < 1.5 - margin)
    return counts


def one_trip(scenario: Scenario, margin: float):
    run = drive(scenario)
    trip = recorded(scenario, run)
    found = slip(trip)
    names = scenario.plant().columns
    speed = run.samples[:, names.index("speed")]
    wheels = run.samples[:, [i for i, n in enumerate(names) if n.startswith("wheel_speed_")]]
    onsets = found.events[found.events["measured"]]
    true = scenario.maximum_adhesion(onsets["position"].to_numpy())
    truth = truth_of(trip)
    assert isinstance(truth, Truth)
    return (
        found,
        truth,
        counted(found, wheels - speed[:, None], margin),
        onsets["adhesion"].to_numpy() - true,
        found.speed - speed,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--trips", type=int, default=12)
    parser.add_argument("--noise", type=float, default=0.03, help="of the wheel speeds [m/s]")
    parser.add_argument("--rate", type=int, default=10, help="of the on-board topics [Hz]")
    options = parser.parse_args()
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    sensors = Sensors(rate=options.rate, speed_noise=options.noise)
    margin = max(0.15, 4.0 * options.noise)
    slips, onsets, speeds, errors, inside = np.zeros(4, dtype=int), [], [], {}, {}
    print("seed  layer  bins with onsets   RMSE  largest  in band")
    for seed in range(1, options.seeds + 1):
        scenarios = draw_scenarios(line, train, options.trips, seed=seed, sensors=sensors)
        trips = [one_trip(scenario, margin) for scenario in scenarios]
        empty = empty_map(line)
        pieces = [
            evidence_of(found, empty, truth.weather, sha256=truth.trip)
            for found, truth, *_ in trips
        ]
        track, _ = update(empty, pieces)
        truths = [truth for _, truth, *_ in trips]
        together = []
        for name, layer in track.layers.items():
            seen = layer.events > 0
            true = true_adhesion(track, name, truths)
            error = (layer.maximum_adhesion - true)[seen]
            score = ((layer.log_mean - np.log(true)) / layer.log_std)[seen]
            errors.setdefault(name, []).append(error)
            inside.setdefault(name, []).append(np.abs(score) < 1.96)
            together.append(error)
            reported(f"{seed:4d}  {name:5s}", error, inside[name][-1])
        reported(f"{seed:4d}  both ", np.concatenate(together), None)
        slips += sum(each[2] for each in trips)
        onsets += [each[3] for each in trips]
        speeds += [each[4] for each in trips]
    for name in errors:
        reported(f" all  {name:5s}", np.concatenate(errors[name]), np.concatenate(inside[name]))
    reported(
        " all  both ",
        np.concatenate([e for each in errors.values() for e in each]),
        np.concatenate([e for each in inside.values() for e in each]),
    )
    off, wrong = np.concatenate(onsets), np.concatenate(speeds)
    print(
        f"slips: {slips[0]} true, recall {1 - slips[1] / slips[0]:.4f};"
        f" {slips[2]} reported, precision {1 - slips[3] / slips[2]:.4f}\n"
        f"onsets: {off.size}, error median {np.median(np.abs(off)):.4f},"
        f" RMS {np.sqrt(np.mean(off**2)):.4f}, mean {off.mean():+.4f}\n"
        f"train speed: error RMS {np.sqrt(np.mean(wrong**2)):.3f} m/s,"
        f" largest {np.abs(wrong).max():.2f} m/s"
    )


def reported(what: str, error, inside) -> None:
    band = "" if inside is None else f"{np.mean(inside):9.3f}"
    print(
        f"{what}  {error.size:16d}  {np.sqrt(np.mean(error**2)):5.3f}"
        f"  {np.abs(error).max():7.3f}{band}",
        flush=True,
    )


if __name__ == "__main__":
    main()
