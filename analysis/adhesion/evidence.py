"""What one trip shows of a line's maximum adhesion, bin by bin.

Onsets of slip measure the maximum adhesion; adhesion used without slip bounds it from below.
Weights and weighted logarithms are fixed-point numbers, so that sums over trips are exact whatever
their order.

`trainlog.condition` makes the estimate of these sums.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.adhesion.slip import SlipAnalysis, joined_details, slip
from trainlog.condition import setting
from trainlog.errors import InputError, LogError
from trainlog.formats.attached import line_of
from trainlog.identity import TripIdentity, identity_of
from trainlog.railway.condition import TrackConditionMap
from trainlog.railway.evidence import DailyEvidence
from trainlog.trip import Trip
from trainlog.units import NANOSECONDS

FloatArray = NDArray[np.float64]

FIXED_POINT = 2.0**-20
"""Weights and weighted logarithms are whole multiples of this, so that their sums are exact."""

DAY = 24 * 3600 * NANOSECONDS
"""Nanoseconds of a day."""

POSITION_MARGIN = 5.0
"""Samples this close to the edge of a bin [m] bound no maximum: they may belong to the next."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What one trip says of a line's maximum adhesion, by bin.

    Attributes
    ----------
    line : str
    length, bin_length : float [m]
    layer : str
        Rail condition.
    trip : str
    sha256 : str
        Of the log; empty where there is no file.
    daily : DailyEvidence
        By the day on which each bin was passed.
    details : dict
        What the map keeps of the trip beside its name: see `SlipAnalysis.details`.
    recorded : TripIdentity, optional
        Which drive the trip is; None: not known.
    steps : int
        Of processing since it was recorded: of equally full recordings of a drive that of the
        fewest is counted.
    """

    line: str
    length: float
    bin_length: float
    layer: str
    trip: str
    sha256: str
    daily: DailyEvidence
    details: dict[str, Any] = field(default_factory=dict)
    recorded: TripIdentity | None = None
    steps: int = 0


def evidence(
    trip: Trip, track: TrackConditionMap, *, sha256: str = "", layer: str | None = None
) -> Evidence:
    """What a trip that carries its line and its train says of the maximum adhesion.

    Parameters
    ----------
    trip : Trip
    track : TrackConditionMap
        Whose bins and settings are used; it may be empty (`empty_map`).
    sha256 : str
        Of the log file, so that it is never counted twice.
    layer : str, optional
        Rail condition; default: the trip's own metadata ``weather``.

    Raises
    ------
    LogError
        If the rail condition is not known, or slip cannot be analysed
        (`analysis.adhesion.slip.slip`).
    """
    condition = condition_of(trip, track, layer)
    found = evidence_of(slip(trip), track, condition, sha256=sha256)
    return replace(found, recorded=identity_of(trip), steps=len(trip.provenance))


def condition_of(trip: Trip, track: TrackConditionMap, layer: str | None = None) -> str:
    """The rail condition of a trip on the map's line; arguments and errors as for `evidence`."""
    condition = layer or trip.metadata.get("weather", "")
    if not condition:
        raise LogError(
            f"trip '{trip.name}' does not say whether the rail was dry or wet",
            remedy="give the layer (--layer wet), or ingest the recording with --set weather=wet",
        )
    line = line_of(trip)
    check_line(track, trip.name, line.name, line.length)
    return condition


def evidence_of(
    analysis: SlipAnalysis, track: TrackConditionMap, layer: str, *, sha256: str = ""
) -> Evidence:
    """Evidence of an analysed trip on the map's line; see `evidence_of_parts`."""
    return evidence_of_parts([analysis], track, layer, sha256=sha256)


def evidence_of_parts(
    parts: Iterable[SlipAnalysis], track: TrackConditionMap, layer: str, *, sha256: str = ""
) -> Evidence:
    """Evidence of a trip that was analysed part by part; arguments as for `evidence`.

    All onsets of one bin are one measurement of that trip: their mean, with what they differ by
    and the trip's own deviation. A bin without one counts once, at the highest level that was used
    in it (less one standard deviation, since the highest of noisy values is too high).
    """
    highest, found, trip = np.zeros(track.bins), [], ""
    common_std, details = 0.0, dict[str, Any]()
    day = np.full(track.bins, -1, dtype=np.int64)
    for part in parts:
        known = part.events["measured"] & part.events["position"].between(0.0, track.length)
        found.append(part.events[known])
        highest = np.maximum(highest, _highest(part, track))
        day = np.maximum(day, _last_day(part, track))
        trip, common_std = part.trip, max(common_std, part.common_std)
        details = joined_details(details, part.details)
    onsets = pd.concat(found)
    place = track.bin_of(onsets["position"])
    log_adhesion = np.log(onsets["adhesion"].to_numpy())
    precision = (onsets["adhesion"] / onsets["adhesion_std"]).to_numpy() ** 2

    def summed(values: FloatArray | None) -> FloatArray:
        return np.bincount(place, values, minlength=track.bins).astype(np.float64)

    events, total = summed(None), summed(precision)
    seen = events > 0
    safe = np.where(seen, total, 1.0)
    spread = np.hypot(setting(track, "trip_std"), np.sqrt(1.0 / safe))
    weight = np.where(seen, _fixed(spread**-2), 0.0)
    # What all onsets of the trip err by alike does not become less with their number.
    late = summed(precision * (onsets["delay_std"] / onsets["adhesion"]).to_numpy()) / safe
    common = weight**2 * (common_std**2 + late**2)
    mean = summed(precision * log_adhesion) / safe
    return Evidence(
        line=track.line,
        length=track.length,
        bin_length=track.bin_length,
        layer=layer,
        trip=trip,
        sha256=sha256,
        daily=DailyEvidence.of_bins(
            day,
            events,
            weight,
            _fixed(weight * mean),
            _censored(highest, track, seen),
            weighted_square=_fixed(weight * mean**2),
            common=_fixed(common),
        ),
        details=details,
    )


def _last_day(analysis: SlipAnalysis, track: TrackConditionMap) -> NDArray[np.int64]:
    """Day on which each bin was passed, counted from 1970-01-01 in UTC; -1: not passed; (bins,)."""
    day = np.full(track.bins, -1, dtype=np.int64)
    known = (analysis.position >= 0.0) & (analysis.position <= track.length)
    passed = analysis.time[known].as_unit("ns").asi8 // DAY
    np.maximum.at(day, track.bin_of(analysis.position[known]), passed)
    onsets = analysis.events[analysis.events["position"].between(0.0, track.length)]
    start = pd.DatetimeIndex(onsets["start"]).as_unit("ns").asi8 // DAY
    np.maximum.at(day, track.bin_of(onsets["position"]), start)
    return day


def _highest(analysis: SlipAnalysis, track: TrackConditionMap) -> FloatArray:
    """Highest adhesion that each bin was seen to bear, (bins,)."""
    size = np.abs(analysis.adhesion)
    spread = np.hypot(analysis.adhesion_std, analysis.common_std * size)
    # An axle that was not recorded says nothing.
    used = np.fmax.reduce(size - spread, axis=1)
    margin = min(POSITION_MARGIN, 0.25 * track.bin_length)
    within = np.mod(analysis.position, track.bin_length)
    known = np.isfinite(used) & (within >= margin) & (within <= track.bin_length - margin)
    known &= (analysis.position >= 0.0) & (analysis.position <= track.length)
    highest = np.zeros(track.bins)
    np.maximum.at(highest, track.bin_of(analysis.position[known]), used[known])
    return highest


def _censored(
    highest: FloatArray, track: TrackConditionMap, measured: NDArray[np.bool_]
) -> FloatArray:
    """Level that each bin without a measured onset was seen to bear, as a histogram."""
    level = np.searchsorted(track.levels, highest, side="right") - 1
    rows = np.flatnonzero((level >= 0) & ~measured)
    histogram = np.zeros((track.bins, track.levels.size))
    histogram[rows, level[rows]] = 1.0
    return histogram


def check_line(track: TrackConditionMap, trip: str, line: str, length: float) -> None:
    """Refuse a trip on another line than the map's.

    Raises
    ------
    InputError
    """
    if line != track.line or length != track.length:
        raise InputError(
            f"trip '{trip}' ran on line '{line}' ({length:g} m),"
            f" the map is of '{track.line}' ({track.length:g} m)",
            remedy="keep one map a line",
        )


def _fixed(values: FloatArray) -> FloatArray:
    return np.asarray(np.round(values / FIXED_POINT) * FIXED_POINT)
