"""Stretches of the track-condition map that moved between two versions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from analysis.adhesion.condition_map import empty_map_of
from analysis.fleet.diff_judgement import REACH
from analysis.fleet.maps import evidence_of_row
from trainlog.arrays import FloatArray
from trainlog.condition import estimated
from trainlog.railway.condition import ConditionLayer
from trainlog.railway.evidence import DailyEvidence
from trainlog.spans import runs_of

PLACES = ("place", "layer", "from_km", "to_km", "first", "second", "std_log", "bands")


def moved_places(left: pd.DataFrame, right: pd.DataFrame) -> list[dict[str, Any]]:
    """Stretches where the map of all trips together moved beyond its band."""
    found = []
    for (edge, layer), rows in left.groupby(["edge", "layer"], sort=True):
        other = right.loc[rows.index]
        if (rows["evidence"] == other["evidence"]).all():
            continue
        one, its = _layer(rows), _layer(other)
        if one is None or its is None:
            continue
        (length, mine), (other_length, theirs) = one, its
        middle = (np.arange(mine.log_mean.size) + 0.5) * length
        nearest = np.clip((middle / other_length).astype(int), 0, theirs.log_mean.size - 1)
        mean, std = theirs.log_mean[nearest], theirs.log_std[nearest]
        both = mine.observed & theirs.observed[nearest]
        with np.errstate(invalid="ignore"):
            bands = np.abs(mean - mine.log_mean) / (REACH * np.fmin(mine.log_std, std))
        # Bins of another length begin and end elsewhere.
        alone = (mine.observed ^ theirs.observed[nearest]) & (length == other_length)
        for begin, end in runs_of((both & (bands > 1.0)) | alone):
            part = slice(begin, end)
            sides = (
                np.where(mine.observed, np.exp(mine.log_mean), np.nan)[part],
                np.where(theirs.observed[nearest], np.exp(mean), np.nan)[part],
            )
            largest = bands[part][both[part]]
            found.append(
                {
                    "place": edge, "layer": layer,
                    "from_km": (middle[begin] - 0.5 * length) / 1e3,
                    "to_km": (middle[end - 1] + 0.5 * length) / 1e3,
                    "first": _mean(sides[0]), "second": _mean(sides[1]),
                    "std_log": _mean(mine.log_std[part]),
                    "bands": float(largest.max()) if largest.size else np.inf,
                }
            )  # fmt: skip
    return found


def _mean(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else np.nan


def _layer(rows: pd.DataFrame) -> tuple[float, ConditionLayer] | None:
    """The map's layer that the evidence of all rows gives, with the length of its bins [m]."""
    given = rows[rows["evidence"].notna()]
    if not len(given):
        return None
    edge, layer, length, bin_length = given.iloc[0][["edge", "layer", "edge_length", "bin_length"]]
    total = DailyEvidence.total(evidence_of_row(each) for each in given["evidence"])
    empty = empty_map_of(edge, float(length), float(bin_length))
    made = estimated(replace(empty, layers={layer: ConditionLayer.unestimated(total)}))
    return float(bin_length), made.layers[layer]
