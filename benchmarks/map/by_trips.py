"""How the track-condition map's error and band hold as trips are added, on three lines.

    python benchmarks/map/by_trips.py [--seeds 1 2] [--trips 100] [--cache FOLDER]
                                       [--changed | --pooled | --oracle]

Wet rail, each trip with passing spots of its own (`trainlog.simulation.draw_scenarios`), which the
map does not know. Root mean square error of maximum adhesion and share of the bins in the 95 %
band, of the lasting condition: in all bins with onsets, in those with onsets of one trip alone, and
in those of ten trips or more; and of the expected condition against what the next trip meets. With
``--pooled`` the same of the estimate before the map had two time scales (`pooled.py`). With
``--changed`` the line changes after these trips, 20 more follow, and the change is dated. With
``--oracle`` the error in bins with onsets of one trip of someone who knows which of these onsets
were a passing spot's and how the simulator draws normal rail: of a spot's bin he knows no
more than that, and that the rail bears what other trips used there; what no method can do much
better.
"""

from __future__ import annotations

import argparse
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
from pooled import pooled_estimate
from scipy.stats import norm

from analysis.adhesion.condition_map import empty_map
from analysis.adhesion.evidence import evidence_of
from analysis.adhesion.slip import slip
from trainlog.condition import estimated
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.formats.ttobench import read_track
from trainlog.railway.condition import ConditionLayer
from trainlog.railway.evidence import DailyEvidence
from trainlog.simulation import draw_scenarios, simulate
from trainlog.simulation.rail import BASE
from trainlog.simulation.scenario import base_map

STAGES = (1, 5, 20, 100)
TRACKS = ("CH_Stadelhofen_Altstetten", "00_reference")
LIBRARY = Path(__file__).resolve().parent / "../../../shared/data/ttobench"


def lines(library: Path):
    """The sample line, and two of TTOBench where it is."""
    yield read_line(sample(DEFAULT_LINE))
    for name in TRACKS:
        if (library / "tracks" / f"{name}.json").exists():
            yield read_track(library / "tracks" / f"{name}.json")


def evidence_by_trip(line, seed: int, trips: int, cache: Path | None):
    """Daily evidence of each wet trip, and the adhesion that it met by bin."""
    kept = None if cache is None else cache / f"{line.name}-{seed}-{trips}.pickle"
    if kept is not None and kept.exists():
        return pickle.loads(kept.read_bytes())
    train, empty = read_train(sample(DEFAULT_TRAIN)), empty_map(line)
    found = []
    for scenario in draw_scenarios(line, train, 2 * trips, seed=seed):
        if scenario.weather == "wet":
            known = evidence_of(slip(simulate(scenario)), empty, "wet", sha256=scenario.name)
            found.append((known.daily, scenario.maximum_adhesion(empty.centres)))
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(pickle.dumps(found))
    return found


def layer_of(line, pieces) -> ConditionLayer:
    known = ConditionLayer.unestimated(DailyEvidence.total(pieces))
    return estimated(replace(empty_map(line), layers={"wet": known})).layer("wet")


def scored(estimate, true, seen) -> str:
    if not seen.any():
        return " " * 17
    error = (np.exp(estimate.log_mean) - true)[seen]
    inside = np.abs((estimate.log_mean - np.log(true)) / estimate.log_std)[seen] < 1.96
    return f"{seen.sum():4d} {np.sqrt(np.mean(error**2)):.4f} / {np.mean(inside):.2f}"


def changed(line, seed: int, trips: int, cache: Path | None) -> None:
    """The line becomes another one after these trips; 20 more run on it."""
    before = [each for each, _ in evidence_by_trip(line, seed, trips, cache)]
    after = [each for each, _ in evidence_by_trip(line, seed + 1, trips, cache)][:20]
    day = max(int(each.days[-1]) for each in before) + 1
    shift = day - min(int(each.days[0]) for each in after)
    after = [replace(e, day=e.day + shift, used_day=e.used_day + shift) for e in after]
    layer = layer_of(line, before + after)
    seen = DailyEvidence.total(after).by_bin("trips") > 0
    dates = [change.day - day for change in layer.changes]
    print(
        f"{line.name}: changed on day 0, dated {dates};"
        f" bins seen since {scored(layer, base_map(line, 'wet', seed + 1), seen)}",
        flush=True,
    )


def oracle(line, seed: int, trips: int, cache: Path | None) -> None:
    """Error in bins of one trip's onsets where it is known which were passing spots."""
    known, base = evidence_by_trip(line, seed, trips, cache), base_map(line, "wet", seed)
    total = DailyEvidence.total([each for each, _ in known])
    alone, levels = total.by_bin("trips") == 1, np.log(empty_map(line).levels)
    used = np.where(total.censored > 0.0, levels, -np.inf).max(axis=1)
    median, spread = np.log(BASE["wet"][0]), BASE["wet"][1]
    errors, passing = [], []
    for evidence, met in known:
        own = alone[evidence.bin]
        place = evidence.bin[own]
        measured = evidence.weighted_log[own] / evidence.weight[own]
        bound = (np.maximum(used[place], levels[0]) - median) / spread
        normal = median + spread * norm.pdf(bound) / norm.sf(bound)
        passes = np.log(met[place] / base[place]) < -0.2
        errors.append(np.exp(np.where(passes, normal, measured)) - base[place])
        passing.append(passes)
    error, share = np.concatenate(errors), np.concatenate(passing).mean()
    print(
        f"{line.name:26s} {seed} {len(known):4d}  {error.size} bins of one trip, {share:.0%} of"
        f" passing spots: {np.sqrt(np.mean(error**2)):.4f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--trips", type=int, default=100, help="with wet rail")
    parser.add_argument("--cache", type=Path, help="folder for the evidence of simulated trips")
    parser.add_argument("--library", type=Path, default=LIBRARY)
    parser.add_argument("--changed", action="store_true")
    parser.add_argument("--pooled", action="store_true")
    parser.add_argument("--oracle", action="store_true")
    options = parser.parse_args()
    print("line, seed, trips: all bins with onsets | of one trip | of ten or more | expected")
    for line in lines(options.library):
        for seed in options.seeds:
            if options.changed:
                changed(line, seed, options.trips, options.cache)
                continue
            if options.oracle:
                oracle(line, seed, options.trips, options.cache)
                continue
            known = evidence_by_trip(line, seed, options.trips, options.cache)
            base = base_map(line, "wet", seed)
            for stage in (each for each in STAGES if each <= len(known)):
                pieces = [each for each, _ in known[:stage]]
                trips = DailyEvidence.total(pieces).by_bin("trips")
                if options.pooled:
                    total = DailyEvidence.total(pieces)
                    estimate = expected = pooled_estimate(empty_map(line), "wet", total)
                else:
                    estimate = layer_of(line, pieces)
                    expected = estimate.expected()
                # Against a trip that follows; after the last there is none.
                following = known[stage][1] if stage < len(known) else None
                columns = (
                    scored(estimate, base, trips > 0),
                    scored(estimate, base, trips == 1),
                    scored(estimate, base, trips >= 10),
                    "" if following is None else scored(expected, following, trips > 0),
                )
                print(f"{line.name:26s} {seed} {stage:4d}  {' | '.join(columns)}", flush=True)


if __name__ == "__main__":
    main()
