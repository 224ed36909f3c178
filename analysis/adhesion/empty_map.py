"""Track-condition maps before any evidence: what every map is made with.

Apart from `analysis.adhesion.condition_map`, so that whatever only keeps evidence loads nothing
that computes it.
"""

from __future__ import annotations

import numpy as np

from trainlog.errors import InputError
from trainlog.railway.adhesion import DRY, WET
from trainlog.railway.condition import BIN_LENGTH, TrackConditionMap
from trainlog.railway.line import Line

LEVELS = np.round(np.arange(0.02, 0.601, 0.01), 2)
"""Adhesion levels of the censoring histograms."""

SETTINGS: dict[str, float] = {
    "prior_dry": DRY.peak,
    "prior_wet": WET.peak,
    "prior_other": float(np.sqrt(DRY.peak * WET.peak)),
    "prior_std": 0.4,
    "correlation_length": 120.0,
    "trip_std": 0.12,
    "model_std": 0.04,
    "observed_share": 0.5,
}
"""How a map is made; every map records its own.

prior_dry, prior_wet, prior_other
    Maximum adhesion expected of a layer before any evidence (Zhao et al., 2025, table 1; between
    the two for layers of any other name).
prior_std, correlation_length [m]
    Of the logarithm of the maximum adhesion along a line.
trip_std
    Of the same from trip to trip at one place, leaves and other passing spots included.
model_std
    Least standard deviation that is published, for what the model leaves out.
observed_share
    A bin is observed where an onset was measured in it, or where onsets nearby bring the standard
    deviation, by themselves, to this share of prior_std.
"""


def empty_map(
    line: Line, bin_length: float = BIN_LENGTH, settings: dict[str, float] | None = None
) -> TrackConditionMap:
    """A map without layers.

    Parameters
    ----------
    line : Line
        In its own direction.
    bin_length : float [m]
    settings : dict, optional
        Replaces entries of `SETTINGS`.

    Raises
    ------
    InputError
        If the bin length or a setting is not positive, or a setting unknown.
    """
    return empty_map_of(line.name, line.length, bin_length, settings)


def empty_map_of(
    line: str,
    length: float,
    bin_length: float = BIN_LENGTH,
    settings: dict[str, float] | None = None,
) -> TrackConditionMap:
    """A map without layers of a line, or an edge of a network, of which only this is known.

    Parameters are those of `empty_map`, with the name and the length [m] in place of the line.
    """
    chosen = {**SETTINGS, **(settings or {})}
    for name, value in {"bin_length": bin_length, **chosen}.items():
        if name not in SETTINGS and name != "bin_length":
            raise InputError(
                f"track-condition map: unknown setting '{name}'",
                remedy=f"settings: {', '.join(SETTINGS)}",
            )
        if not (value > 0.0 and np.isfinite(value)):
            raise InputError(f"track-condition map: {name} must be positive, got {value}")
    return TrackConditionMap(
        line=line,
        length=length,
        bin_length=bin_length,
        levels=LEVELS,
        layers={},
        settings=chosen,
    )
