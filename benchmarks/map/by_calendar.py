"""How well the map knows what lasts and what the next trip meets, on a rail over calendar days.

    python benchmarks/map/by_calendar.py [--days 25] [--trips-per-day 4] [--counts 1 5 20 60]

The rail is that of `trips.py`: spots with births, lives and decay that the map's model does not
assume, weather that turns, lasting changes where ``--change`` names them. Of the condition with
the most trips the first ones are counted, as many as ``--counts`` names, at most all but the last;
printed are, for bins with onsets, those with onsets of one trip alone and those of ten or more:
root mean square error of the lasting maximum adhesion and share of bins in the 95 % band; the same
of the condition expected at the time of the next trip, against what that trip met; and the lasting
changes that the map reports.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence

import numpy as np
import pandas as pd
from trips import Month, add_options, months

from analysis.adhesion.condition_map import empty_map, update
from trainlog.railway.condition import AdhesionEstimate


def scored(estimate: AdhesionEstimate, true: np.ndarray, chosen: np.ndarray) -> str:
    """Bins, error and coverage."""
    if not chosen.any():
        return f"{0:5d}      -    -"
    error = (np.exp(estimate.log_mean) - true)[chosen]
    score = ((estimate.log_mean - np.log(true)) / estimate.log_std)[chosen]
    inside = np.mean(np.abs(score) < 1.96)
    return f"{chosen.sum():5d}  {np.sqrt(np.mean(error**2)):.4f} {inside:.2f}"


def report(known: Month, counts: Sequence[int]) -> None:
    """Print the rows of a line."""
    name = Counter(each.layer for each in known.drives).most_common(1)[0][0]
    own = [each for each in known.drives if each.layer == name]
    empty = empty_map(known.line)
    evidence = [each.evidence(empty) for each in own[:-1]]
    for count in sorted({min(each, len(evidence)) for each in counts}):
        track, _ = update(empty, evidence[:count])
        layer, following = track.layer(name), own[count]
        trips = layer.evidence.by_bin("trips")
        expected = layer.expected(pd.Timestamp(following.time, tz="UTC"))
        lasting, met = following.lasting(empty.centres), following.met(empty.centres)
        print(
            f"{known.line.name:26s} {name:6s} {count:4d}"
            f" | {scored(layer, lasting, trips > 0)} | {scored(layer, lasting, trips == 1)}"
            f" | {scored(layer, lasting, trips >= 10)} | {scored(expected, met, trips > 0)}"
            f" | {len(layer.changes)}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add_options(parser)
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 5, 20, 60], help="of trips")
    options = parser.parse_args()
    print("line, layer, trips | bins with onsets | of one trip | of ten | next trip | changes")
    for each in months(options):
        report(each, options.counts)


if __name__ == "__main__":
    main()
