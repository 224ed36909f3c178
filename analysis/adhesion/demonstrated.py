"""Adhesion that a controller may count on, bin by bin, and how the map came by it.

Slip shows the maximum where it is met. Everywhere else a trip only demonstrates the adhesion that
it used without slip; and where little was used the map holds no evidence, so that what is counted
on there is an assumption, and is called one.

This is right for what is planned ahead and must hold: trajectories, references, the guarantees of
studies. A driver on the way, who sees slip and eases off, expects the likely where the map was not
observed: `TrackConditionMap.likely`. Where it was observed both are the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trainlog.condition import setting
from trainlog.errors import InputError
from trainlog.railway.condition import TrackConditionMap
from trainlog.railway.line import StepProfile

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class UsableAdhesion:
    """What may be counted on along a line; (n,) arrays by bin of the map.

    Attributes
    ----------
    bin_length : float [m]
    values : (n,) array
        Infinite where nothing is known and nothing is assumed.
    seen : (n,) bool array
        From the maximum itself, which slip in or near the bin has shown.
    demonstrated : (n,) bool array
        From what trips used without slip, more than would have been assumed.
    """

    bin_length: float
    values: FloatArray
    seen: BoolArray
    demonstrated: BoolArray

    @property
    def assumed(self) -> BoolArray:
        """Bins in which only an assumption is counted on; (n,)."""
        return np.asarray(~self.seen & ~self.demonstrated)

    @property
    def profile(self) -> StepProfile:
        """By position on the line."""
        starts = self.bin_length * np.arange(self.values.size, dtype=np.float64)
        return StepProfile(starts, self.values)


def usable_adhesion(
    track: TrackConditionMap, layer: str, *, sigmas: float = 1.0, assumed: float = np.inf
) -> UsableAdhesion:
    """What a map lets a controller count on.

    Where the map observed the maximum, its estimate less `sigmas` standard deviations; what was
    used without slip is part of that estimate. Elsewhere the more of what was demonstrated
    (`demonstrated_adhesion`) and of what is assumed.

    Parameters
    ----------
    track : TrackConditionMap
    layer : str
    sigmas : float
        How cautious.
    assumed : float
        Where the map holds no evidence; by default there is no limit.

    Raises
    ------
    InputError
        If the map has no such layer, or the assumption is not positive.
    """
    if not (0.0 < assumed <= 1.0 or assumed == np.inf):
        raise InputError(
            f"an assumed adhesion must be above 0 and at most 1, not {assumed:g}",
            remedy="assume what the worst of rails would bear, 0.05 for instance",
        )
    known = track.lower_bound(layer, track.centres, sigmas)
    seen = np.isfinite(known)
    # Where nothing limits anything, nothing demonstrated can be more.
    demonstrated = (
        demonstrated_adhesion(track, layer, sigmas)
        if np.isfinite(assumed)
        else np.zeros(track.bins)
    )
    return UsableAdhesion(
        track.bin_length,
        np.where(seen, known, np.maximum(demonstrated, assumed)),
        seen,
        ~seen & (demonstrated > assumed),
    )


def demonstrated_adhesion(track: TrackConditionMap, layer: str, sigmas: float = 1.0) -> FloatArray:
    """Cautious bound of the maximum adhesion that trips demonstrated in each bin; 0 if none.

    The maximum of one trip scatters about that of the place by ``trip_std``, and what the model
    leaves out adds ``model_std``. Where n trips used a level without slip, it is therefore
    lowered by `sigmas` times ``sqrt(trip_std²/n + model_std²)`` of its logarithm; the best of all
    levels counts.

    Parameters
    ----------
    track : TrackConditionMap
    layer : str
    sigmas : float

    Returns
    -------
    (n,) array

    Raises
    ------
    InputError
        If the map has no such layer.
    """
    trips = np.cumsum(track.layer(layer).evidence.censored[:, ::-1], axis=1)[:, ::-1]
    spread = np.hypot(
        setting(track, "trip_std") / np.sqrt(np.maximum(trips, 1.0)), setting(track, "model_std")
    )
    bound = np.where(trips > 0.0, track.levels * np.exp(-sigmas * spread), 0.0)
    return np.asarray(bound.max(axis=1))


def typical_adhesion(track: TrackConditionMap, layer: str, sigmas: float = 1.0) -> float:
    """Cautious adhesion of the middle one of all places where slip has shown the maximum.

    An assumption for the rest of the line. Neighbouring bins are one place, represented by the
    lowest of their cautious estimates: a long slippery spot counts no more than a short one.
    Slip is met where the rail is worst, so that most of the line holds more; not all of it does.

    Parameters
    ----------
    track : TrackConditionMap
    layer : str
    sigmas : float
        How cautious.

    Raises
    ------
    InputError
        If the map has no such layer, or has seen no maximum.
    """
    known = track.lower_bound(layer, track.centres, sigmas)
    seen = np.flatnonzero(np.isfinite(known))
    if seen.size == 0:
        raise InputError(
            f"map of line '{track.line}': no trip has shown the maximum adhesion of layer"
            f" '{layer}' anywhere",
            remedy="count in trips that met the limit, or assume an adhesion",
        )
    apart = np.diff(seen) * track.bin_length > setting(track, "correlation_length")
    places = np.split(known[seen], np.flatnonzero(apart) + 1)
    return float(np.median([place.min() for place in places]))
