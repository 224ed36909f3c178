"""A track-condition map as tables: bins, merged sections, passing spots, lasting changes; its line.

Names of columns end with their unit. What was not observed is empty, never the prior.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.presentation import ADHESION, KILOMETRE, Column, Ends
from trainlog.railway.condition import (
    AdhesionEstimate,
    ConditionChange,
    ConditionLayer,
    PassingSpot,
    TrackConditionMap,
)
from trainlog.railway.line import Line, StepProfile, in_km, near
from trainlog.units import KMH, PER_MILLE

BAND = (0.025, 0.975)
"""Shares below the ends of the 95 % band."""

RESOLUTION = 0.01
"""Adhesion by which the bins of one section may differ."""


LAYER = Column("rail\ncondition", key="layer")
KM = Column("km", KILOMETRE, key="start_km")
NEAR = Column("near", rank=1)
"""Of a row of a table of this module."""


def ends_of(row: Mapping[Hashable, Any]) -> str:
    """The operator's kilometres of the ends of a row."""
    return f"{row['start_km']:.3f} to {row['end_km']:.3f}"


SPAN = Column("km", key="span", of=ends_of)


def with_ends(heading: str, name: str) -> Column:
    """A column of adhesion with its 95 % band, of a row of a table of this module."""
    low, high = ("low", "high") if name == "adhesion" else (f"{name}_low", f"{name}_high")
    return Column(
        f"{heading} (95 % band)",
        ADHESION,
        key=name,
        of=lambda row: Ends(row[name], row[low], row[high]),
    )


def last_evidence(track: TrackConditionMap) -> pd.Timestamp | None:
    """The end of the last day with evidence, in UTC; None of a map without.

    Examples
    --------
    >>> import trainlog
    >>> last_evidence(trainlog.read_map("sample_logs/CH_StGallen_Wil.map")).isoformat()
    '2024-10-08T00:00:00+00:00'
    """
    days = track.days
    return pd.Timestamp(int(days[-1]) + 1, unit="D", tz="UTC") if days.size else None


def day_name(day: int) -> str:
    """A day counted from 1970-01-01 as people write it.

    Examples
    --------
    >>> day_name(20_000)
    '2024-10-04'
    """
    return str(np.datetime64(int(day), "D"))


def chosen_layers(
    track: TrackConditionMap, names: Sequence[str] | None
) -> dict[str, ConditionLayer]:
    """The layers of a map by these names, or all of them.

    Raises
    ------
    InputError
        If the map lacks one, or has none at all.
    """
    if not track.layers:
        raise InputError(
            f"map of line '{track.line}' has no layer yet", remedy="count a trip in first"
        )
    return {name: track.layer(name) for name in (track.layers if names is None else names)}


def lowest_apart(
    place: ArrayLike, value: ArrayLike, among: ArrayLike, apart: float, most: int
) -> list[int]:
    """Rows with the lowest values of those chosen, whose places [m] lie apart from each other."""
    positions, rows = np.asarray(place), np.flatnonzero(among)
    taken: list[int] = []
    for row in rows[np.argsort(np.asarray(value)[rows], kind="stable")].tolist():
        if len(taken) == most:
            break
        if all(abs(positions[row] - positions[other]) >= apart for other in taken):
            taken.append(row)
    return taken


def bins_table(
    track: TrackConditionMap,
    line: Line | None = None,
    time: pd.Timestamp | None = None,
    layers: Sequence[str] | None = None,
) -> pd.DataFrame:
    """One row a layer and bin: the lasting condition, the expected one, evidence, line attributes.

    Parameters
    ----------
    track : TrackConditionMap
    line : Line, optional
        Gives the operator's kilometres and what the line has in each bin.
    time : Timestamp, optional
        Of the expected condition; default: right after the last evidence. All evidence of the map
        counts: `trainlog.condition.known_before` leaves out what is later.
    layers : sequence of str, optional
        Default: all.

    Raises
    ------
    InputError
        If the map has no such layer, or the line is another.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> table = bins_table(track, layers=["wet"])
    >>> len(table), int(table["adhesion"].notna().sum())
    (1183, 37)
    """
    if line is not None:
        track.check_line(line.name, line.length)
    edges = track.edges
    where = kilometres(line, edges[:-1], edges[1:])
    beside = {} if line is None else dict(line_table(line, track).iloc[:, 2:])
    parts = []
    for name, layer in chosen_layers(track, layers).items():
        columns: dict[str, object] = {
            "line": track.line,
            "layer": name,
            "bin": np.arange(track.bins),
        }
        estimates = (*shown(layer), *shown(layer.expected(time)))
        columns |= where | {"observed": layer.observed}
        columns |= zip(ADHESIONS, estimates, strict=True)
        spot = spot_probability(track, layer, time)
        # Where nothing was observed, nothing says that there is no spot.
        columns["spot_probability"] = np.where(layer.observed | (spot > 0.0), spot, np.nan)
        columns |= _evidence(track, layer) | beside
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def sections_table(
    track: TrackConditionMap,
    line: Line | None = None,
    time: pd.Timestamp | None = None,
    layers: Sequence[str] | None = None,
    resolution: float = RESOLUTION,
) -> pd.DataFrame:
    """Neighbouring bins merged: observed ones while their estimates differ by `resolution` at most.

    The adhesion of a section is the mean of its bins, its band reaches from their lowest to their
    highest; the expected one alike. Parameters and errors as of `bins_table`.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> sections = sections_table(track, layers=["wet"])
    >>> bool(sections["end_m"].iloc[-1] == track.length), bool(len(sections) < track.bins)
    (True, True)
    """
    bins = bins_table(track, line, time, layers)
    section = bins.groupby("layer", sort=False)["adhesion"].transform(
        lambda values: _merged(values.to_numpy(), resolution)
    )
    table = bins.groupby(["line", "layer", section.rename("section")], sort=False).agg(_SECTION)
    return table.reset_index().rename(columns={"bin": "bins"})


_SECTION: dict[str, str] = {
    "bin": "size",
    "start_m": "first",
    "end_m": "last",
    "start_km": "first",
    "end_km": "last",
    "observed": "first",
    "adhesion": "mean",
    "low": "min",
    "high": "max",
    "expected": "mean",
    "expected_low": "min",
    "expected_high": "max",
    "spot_probability": "max",
    "events": "sum",
    "used_without_slip": "max",
}
"""Columns of a section, and how they follow from those of its bins."""


def _merged(values: FloatArray, resolution: float) -> IntArray:
    """Number of the section of each value; greedy, from the start of the line."""
    number = np.zeros(values.size, dtype=np.int64)
    low = high = values[0] if values.size else np.nan
    for i, value in enumerate(values[1:].tolist(), start=1):
        low, high = np.minimum(low, value), np.maximum(high, value)
        same = high - low <= resolution or (np.isnan(value) and np.isnan(values[i - 1]))
        number[i] = number[i - 1] + (not same)
        if not same:
            low = high = value
    return number


def spots_table(
    track: TrackConditionMap,
    line: Line | None = None,
    time: pd.Timestamp | None = None,
    layers: Sequence[str] | None = None,
) -> pd.DataFrame:
    """One row a passing spot: where, how low, when it was met, and how likely it still lies there.

    Layer by layer, the likeliest first. Parameters and errors as of `bins_table`.
    """
    chosen = chosen_layers(track, layers)
    found = [(name, spot) for name, each in chosen.items() for spot in each.spots]
    day = {f"{name}_day": name for name in ("first", "last", "checked")}
    values = {name: name for name in ("adhesion", "low", "high")}
    table = _parts_table(
        track, line, found, values | day | {"present_when_checked": "present", "life_days": "life"}
    )
    now = time or last_evidence(track)
    likely = np.array([np.nan if now is None else spot.alive(now) for _, spot in found])
    table.insert(list(table).index("life_days"), "probability", likely)
    table["may_be_change"] = np.array(
        [may_be_change(track, track.layer(name), spot) for name, spot in found], dtype=np.bool_
    )
    order = np.lexsort((-likely, pd.factorize(table["layer"])[0]))
    return table.iloc[order].reset_index(drop=True)


_DAYS = ("first", "last", "checked", "day", "earliest", "latest")
"""Attributes of spots and changes that are days."""


def _parts_table(
    track: TrackConditionMap,
    line: Line | None,
    found: Sequence[tuple[str, PassingSpot | ConditionChange]],
    columns: Mapping[str, str],
) -> pd.DataFrame:
    """One row a part of the line, with its layer; of each column the attribute that it has."""

    def each(name: str) -> FloatArray:
        return np.array([getattr(part, name) for _, part in found], dtype=np.float64)

    rows = {
        "line": [track.line] * len(found),
        "layer": np.array([name for name, _ in found], dtype=object),
        **kilometres(line, each("start"), each("end")),
    }
    for column, name in columns.items():
        rows[column] = dates(each(name)) if name in _DAYS else each(name)
    return pd.DataFrame(rows)


def may_be_change(track: TrackConditionMap, layer: ConditionLayer, spot: PassingSpot) -> bool:
    """Whether a spot cannot be distinguished from a lasting change to a higher adhesion.

    So it is where nothing is known of the place before the spot, something since, and no change
    was found there: what was low may have been what lasted until then.
    """
    first, end = _bins_of(track, spot)
    known = layer.evidence
    earlier = any(
        bool(((place >= first) & (place < end) & (day < spot.first)).any())
        for place, day in ((known.bin, known.day), (known.used_bin, known.used_day))
    )
    changed = any(each.start < spot.end and each.end > spot.start for each in layer.changes)
    return spot.checked > spot.last and not earlier and not changed


def probability_words(share: float) -> str:
    """The probability that a spot lies there, in words where it is nil.

    Examples
    --------
    >>> probability_words(0.42), probability_words(0.001)
    ('42%', 'gone (0 %)')
    """
    return "gone (0 %)" if share < 0.005 else f"{share:.0%}"


def met_words(first: pd.Timestamp, last: pd.Timestamp) -> str:
    """When a spot was met.

    Examples
    --------
    >>> met_words(pd.Timestamp("2026-10-10"), pd.Timestamp("2026-10-10"))
    'on 2026-10-10'
    """
    if first == last:
        return f"on {first:%Y-%m-%d}"
    return f"{first:%Y-%m-%d} to {last:%Y-%m-%d}"


MAY_BE_CHANGE = (
    "there is no evidence before it: a lasting change to higher adhesion would look the same, and"
    " the two cannot be distinguished yet."
)
"""What is stated of a spot that `may_be_change`."""


def changes_table(
    track: TrackConditionMap, line: Line | None = None, layers: Sequence[str] | None = None
) -> pd.DataFrame:
    """One row a lasting change: where, on which day, from which maximum adhesion to which.

    Parameters and errors as of `bins_table`.
    """
    found = [
        (name, each)
        for name, layer in chosen_layers(track, layers).items()
        for each in layer.changes
    ]
    names = ("day", "earliest", "latest", "before", "before_std", "after", "after_std")
    table = _parts_table(
        track, line, found, {name: name for name in names} | {"log_odds": "significance"}
    )
    for name in ("before", "after"):
        at, reach = list(table).index(f"{name}_std"), 1.96 * table.pop(f"{name}_std")
        table.insert(at, f"{name}_low", table[name] * np.exp(-reach))
        table.insert(at + 1, f"{name}_high", table[name] * np.exp(reach))
    return table


ADHESIONS = ("adhesion", "low", "high", "expected", "expected_low", "expected_high")
"""Columns of `bins_table` with maximum adhesions."""


def shown(estimate: AdhesionEstimate) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Maximum adhesion and the ends of its 95 % band, by bin; NaN where not observed."""
    low, high = (np.where(estimate.observed, estimate.quantile(share), np.nan) for share in BAND)
    return estimate.maximum_adhesion, low, high


def spot_probability(
    track: TrackConditionMap, layer: ConditionLayer, time: pd.Timestamp | None
) -> FloatArray:
    """Probability that a passing spot lies in each bin at a time; (bins,) array."""
    now = time or last_evidence(track)
    none = np.ones(track.bins)
    for spot in layer.spots:
        inside = slice(*_bins_of(track, spot))
        none[inside] *= 1.0 - (spot.present if now is None else spot.alive(now))
    return np.asarray(1.0 - none)


def _bins_of(track: TrackConditionMap, part: PassingSpot | ConditionChange) -> tuple[int, int]:
    """First and one-past-last bin of a part of the line."""
    first = int(track.bin_of(part.start))
    return first, max(int(np.ceil(part.end / track.bin_length)), first + 1)


def _evidence(track: TrackConditionMap, layer: ConditionLayer) -> dict[str, object]:
    known = layer.evidence
    used = np.fmax.reduce(np.where(known.censored > 0.0, track.levels, np.nan), axis=1)
    place = np.concatenate((known.bin, known.used_bin))
    day = np.concatenate((known.day, known.used_day))
    none = np.iinfo(np.int64).min
    first, last = np.full(track.bins, np.iinfo(np.int64).max), np.full(track.bins, none)
    np.minimum.at(first, place, day)
    np.maximum.at(last, place, day)
    seen = last > none
    changed = np.full(track.bins, none)
    for each in layer.changes:
        inside = slice(*_bins_of(track, each))
        changed[inside] = np.maximum(changed[inside], each.day)
    return {
        "events": known.by_bin("events").astype(np.int64),
        "trips_with_onsets": known.by_bin("trips").astype(np.int64),
        "used_without_slip": used,
        "first_day": dates(first, seen),
        "last_day": dates(last, seen),
        "changed_day": dates(changed, (changed > none) & layer.observed),
    }


def dates(days: ArrayLike, known: ArrayLike = True) -> NDArray[np.datetime64]:
    """Days counted from 1970-01-01; none where they are not known."""
    found = np.where(known, days, 0).astype(np.int64).astype("datetime64[D]")
    return np.where(known, found, np.datetime64("NaT")).astype("datetime64[s]")


def kilometres(line: Line | None, start: FloatArray, end: FloatArray) -> dict[str, object]:
    """Chainage, the operator's kilometres and nearest station of pieces of the line."""
    # The end of a piece belongs to it: where kilometres jump there, they do so behind it.
    inside = np.maximum(end - 1e-6, start)
    ends = [in_km(line, at) for at in (start, inside)]
    return {
        "start_m": start,
        "end_m": end,
        "start_km": ends[0].round(6),
        "end_km": ends[1].round(6),
        "near": near(line, 0.5 * (start + end)),
    }


# ----------------------------------------------------------------------- the line, bin by bin


def line_table(line: Line, track: TrackConditionMap) -> pd.DataFrame:
    """Attributes of the line in each bin of a map, along the line in its own direction.

    Parameters
    ----------
    line : Line
    track : TrackConditionMap
        Of that line; only its bins are used.

    Returns
    -------
    DataFrame
        One row a bin: ``start_m``, ``end_m``; ``gradient_permil``, its mean, uphill positive;
        ``curvature_per_km``, the largest, 0 where the line is straight; ``speed_limit_km_h``, the
        least along the line, and where limits differ by direction ``speed_limit_reverse_km_h``, the
        least against it; ``tunnel``, whether any of the bin lies in one that the line states;
        ``station``, the names of those in the bin, joined by a comma. What the line does not state
        is empty.

    Raises
    ------
    InputError
        If the map is of another line.

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> table = line_table(line, track)
    >>> names = ["gradient_permil", "curvature_per_km", "speed_limit_km_h"]
    >>> table.loc[400, names].astype(float).round(2).tolist()
    [-3.3, 0.59, 125.0]
    >>> table.station.dropna().tolist()
    ['St.Gallen', 'Gossau SG', 'Flawil', 'Uzwil', 'Wil']
    """
    track.check_line(line.name, line.length)
    start, end = track.edges[:-1], track.edges[1:]
    limits = {"speed_limit_km_h": line.speed_limits}
    if line.speed_limits_reverse is not None:
        limits["speed_limit_reverse_km_h"] = line.speed_limits_reverse
    unknown = np.full(start.size, np.nan)
    gradient = PER_MILLE * line.gradients.mean(start, end)
    inside = np.zeros(start.size, dtype=np.bool_)
    for tunnel in line.tunnels:
        inside |= (start < tunnel.position + tunnel.length) & (end > tunnel.position)
    return pd.DataFrame(
        {
            "start_m": start,
            "end_m": end,
            "gradient_permil": unknown if "gradients" in line.assumed else gradient.round(3),
            # Straight track has a curvature that every format can hold.
            "curvature_per_km": (1e3 * _sharpest(line, start, end)).round(6),
            **{
                name: unknown
                if "speed_limits" in line.assumed
                else (KMH * _least(each, start, end)).round(3)
                for name, each in limits.items()
            },
            "tunnel": inside,
            "station": _stations(line, track),
        }
    )


def _least(profile: StepProfile, start: FloatArray, end: FloatArray) -> FloatArray:
    """Least value over each bin, (n,)."""
    return _extreme(np.minimum, profile(start), profile.positions, profile.values, (start, end))


def _sharpest(line: Line, start: FloatArray, end: FloatArray) -> FloatArray:
    """Largest size of the curvature in each bin [1/m], (n,); NaN where curves are not known."""
    curves = line.curvatures
    if curves is None or "curvatures" in line.assumed:
        return np.full(start.size, np.nan)
    # Elements are linear: the largest is at an end of the bin or of an element.
    ends = np.append(curves.positions[1:], line.length)
    nearly = np.maximum(end - 1e-6, start)
    at_ends = np.maximum(np.abs(line.curvature(start)), np.abs(line.curvature(nearly)))
    bins = (start, end)
    found = _extreme(np.maximum, at_ends, curves.positions, np.abs(curves.start), bins)
    return _extreme(np.maximum, found, ends - 1e-6, np.abs(curves.end), bins)


def _extreme(
    extreme: np.ufunc,
    first: FloatArray,
    positions: FloatArray,
    values: FloatArray,
    bins: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Extreme of `first` and of the values whose positions lie in each bin, (n,)."""
    start, end = bins
    found = np.array(first, dtype=np.float64)
    index = np.searchsorted(start, positions, side="right") - 1
    within = (index >= 0) & (positions < end[np.maximum(index, 0)])
    extreme.at(found, index[within], values[within])
    return found


def _stations(line: Line, track: TrackConditionMap) -> list[str | None]:
    """Names of the stations in each bin; ends that only close a line are none."""
    names: list[list[str]] = [[] for _ in range(track.bins)]
    for station in () if "stations" in line.assumed else line.stations:
        names[int(track.bin_of(station.position))].append(station.name)
    return [", ".join(each) or None for each in names]
