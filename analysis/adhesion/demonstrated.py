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
from numpy.typing import ArrayLike
from pandas import Timestamp
from scipy.special import ndtri

from trainlog.arrays import BoolArray, FloatArray
from trainlog.condition import setting
from trainlog.errors import InputError
from trainlog.railway.condition import AdhesionEstimate, TrackConditionMap
from trainlog.railway.line import StepProfile


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
    track: TrackConditionMap,
    layer: str,
    *,
    sigmas: float = 1.0,
    risk: float | None = None,
    time: Timestamp | None = None,
    assumed: float = np.inf,
) -> UsableAdhesion:
    """What a map lets a controller count on.

    Where the map observed the maximum, its estimate less `sigmas` standard deviations; what was
    used without slip is part of that estimate. With a `risk`, what a trip at `time` finds there
    with probability ``1 - risk``. Elsewhere the more of what was demonstrated
    (`demonstrated_adhesion`) and of what is assumed.

    Parameters
    ----------
    track : TrackConditionMap
    layer : str
    sigmas : float
        How cautious; with a risk it is not used.
    risk : float, optional
        Probability, for each place and trip, that there is less; what that means for a run of many
        places: `risk_of_run`.
    time : Timestamp, optional
        Of the run; see `TrackConditionMap.lower_bound`.
    assumed : float
        Where the map holds no evidence; by default there is no limit.

    Raises
    ------
    InputError
        If the map has no such layer, the assumption is not positive, or the risk is not between 0
        and 1.

    Examples
    --------
    >>> from trainlog.formats.mapfile import read_map
    >>> track = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> bold, careful = (usable_adhesion(track, "wet", risk=risk) for risk in (0.2, 0.01))
    >>> bool(np.all(bold.values[bold.seen] > careful.values[careful.seen]))
    True
    """
    if not (0.0 < assumed <= 1.0 or assumed == np.inf):
        raise InputError(
            f"an assumed adhesion must be above 0 and at most 1, not {assumed:g}",
            remedy="assume what the worst of rails would bear, 0.05 for instance",
        )
    known = track.lower_bound(layer, track.centres, sigmas, risk=risk, time=time)
    seen = np.isfinite(known)
    below = sigmas if risk is None else float(-ndtri(risk))
    # Where nothing limits anything, nothing demonstrated can be more.
    demonstrated = (
        demonstrated_adhesion(track, layer, below) if np.isfinite(assumed) else np.zeros(track.bins)
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


def typical_adhesion(
    track: TrackConditionMap,
    layer: str,
    sigmas: float = 1.0,
    *,
    risk: float | None = None,
    time: Timestamp | None = None,
) -> float:
    """Cautious adhesion of the middle one of all places where slip has shown the maximum.

    An assumption for the rest of the line. Neighbouring bins are one place, represented by the
    lowest of their cautious estimates: a long slippery spot counts no more than a short one.
    Slip is met where the rail is worst, so that most of the line holds more; not all of it does.

    Parameters
    ----------
    track : TrackConditionMap
    layer : str
    sigmas, risk, time
        How cautious; as for `usable_adhesion`.

    Raises
    ------
    InputError
        If the map has no such layer, or has seen no maximum.
    """
    known = track.lower_bound(layer, track.centres, sigmas, risk=risk, time=time)
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


def risk_of_run(
    expected: AdhesionEstimate, demand: ArrayLike, bin_length: float, apart: float
) -> tuple[float, float]:
    """Bounds on the probability that a run asks for more than the rail holds somewhere.

    A risk of a place is not that of a run, which meets many. Bins that are nearer to each other
    than `apart` are one place, whose risk is taken as the largest of its bins'. The run's risk is
    at least the largest of all places, as if all shared one fate, and at most that of independent
    places, ``1 - prod(1 - p)``, as long as one bad place makes no other better (association of
    random variables: Esary, Proschan and Walkup, Ann. Math. Stat. 38, 1967).

    Parameters
    ----------
    expected : AdhesionEstimate
        Of each bin at the time of the run.
    demand : (n,) array
        Adhesion that the run asks for in each bin; 0 where it asks for none.
    bin_length, apart : float [m]

    Returns
    -------
    least, most : float

    Examples
    --------
    Two places at which the run asks for the quantile of 5 %:

    >>> rail = AdhesionEstimate(np.full(80, np.log(0.1)), np.full(80, 0.1), np.ones(80, bool))
    >>> demand = np.zeros(80)
    >>> demand[[10, 11, 60]] = rail.quantile(0.05)[0]
    >>> [round(each, 4) for each in risk_of_run(rail, demand, 25.0, 200.0)]
    [0.05, 0.0975]
    """
    asked = np.asarray(demand, dtype=np.float64)
    some = np.flatnonzero(asked > 0.0)
    if some.size == 0:
        return 0.0, 0.0
    risk = expected.at_bins(some).below(asked[some])
    starts = np.flatnonzero(np.diff(some, prepend=-np.inf) * bin_length > apart)
    places = np.maximum.reduceat(risk, starts)
    return float(places.max()), float(1.0 - np.prod(1.0 - places))
