"""The estimate of a track-condition map, from its evidence and settings alone.

The same evidence gives the same estimate, byte for byte, in whatever order trips were counted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimators.condition import Prior, solve_field
from trainlog.errors import InputError
from trainlog.railway.condition import ConditionLayer, TrackConditionMap


def estimated(track: TrackConditionMap) -> TrackConditionMap:
    """The map with the estimate of each layer made anew of its evidence and the map's settings.

    Parameters
    ----------
    track : TrackConditionMap

    Raises
    ------
    InputError
        If the map lacks a setting.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> sorted(estimated(track).layers)
    ['dry', 'wet']
    """
    layers = {name: _estimated(track, name) for name in sorted(track.layers)}
    return replace(track, layers=layers)


def _estimated(track: TrackConditionMap, name: str) -> ConditionLayer:
    known = track.layers[name].evidence
    prior = prior_of(track, name)
    field = solve_field(
        prior,
        track.bin_length,
        known.by_bin("weight"),
        known.by_bin("weighted_log"),
        known.censored,
        np.log(track.levels),
        setting(track, "trip_std"),
        known.by_bin("common"),
    )
    return ConditionLayer(
        log_mean=field.mean,
        log_std=np.hypot(field.std, setting(track, "model_std")),
        observed=(known.by_bin("events") > 0)
        | (field.events_std <= setting(track, "observed_share") * prior.std),
        evidence=known,
    )


def prior_of(track: TrackConditionMap, layer: str) -> Prior:
    """What the map's settings say of a layer before any evidence."""
    known = layer if layer in ("dry", "wet") else "other"
    return Prior(
        float(np.log(setting(track, f"prior_{known}"))),
        setting(track, "prior_std"),
        setting(track, "correlation_length"),
    )


def setting(track: TrackConditionMap, name: str) -> float:
    """One of the numbers that say how a map is made.

    Raises
    ------
    InputError
        If the map does not have it.
    """
    try:
        return track.settings[name]
    except KeyError:
        raise InputError(
            f"track-condition map of line '{track.line}' lacks the setting '{name}'",
            remedy="begin a new map from the logs",
        ) from None
