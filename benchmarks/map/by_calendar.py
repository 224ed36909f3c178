"""How well the map knows what lasts and what the next trip meets, on a rail over calendar days.

    python benchmarks/map/by_calendar.py [--days 25] [--trips-per-day 4] [--seed 1] [--cache FOLDER]

The rail is that of `trips.py`: spots with births, lives and decay that the map's model does not
assume, weather that turns, lasting changes where ``--change`` names them. Of the condition with
the most trips all but the last are counted; printed are, for bins with onsets, those with onsets of
one trip alone and those of ten or more: root mean square error of the lasting maximum adhesion and
share of bins in the 95 % band; the same of the condition expected at the time of the last trip,
against what that trip met; and the lasting changes that the map reports.
"""

from __future__ import annotations

import argparse
from collections import Counter

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


def report(known: Month) -> None:
    """Print the rows of a line."""
    name = Counter(each.layer for each in known.drives).most_common(1)[0][0]
    own = [each for each in known.drives if each.layer == name]
    empty = empty_map(known.line)
    track, _ = update(empty, [each.evidence(empty) for each in own[:-1]])
    layer, last = track.layer(name), own[-1]
    trips = layer.evidence.by_bin("trips")
    expected = layer.expected(pd.Timestamp(last.time, tz="UTC"))
    lasting, met = last.lasting(empty.centres), last.met(empty.centres)
    print(
        f"{known.line.name:26s} {name:6s} {len(own) - 1:4d}"
        f" | {scored(layer, lasting, trips > 0)} | {scored(layer, lasting, trips == 1)}"
        f" | {scored(layer, lasting, trips >= 10)} | {scored(expected, met, trips > 0)}"
        f" | {len(layer.changes)}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add_options(parser)
    options = parser.parse_args()
    print("line, layer, trips | bins with onsets | of one trip | of ten | next trip | changes")
    for each in months(options):
        report(each)


if __name__ == "__main__":
    main()
