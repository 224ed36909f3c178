"""Attributes of a line, bin by bin: what may explain where its maximum adhesion is low."""

from __future__ import annotations

import numpy as np
import pandas as pd

from analysis.adhesion.evidence import check_line
from trainlog.arrays import BoolArray, FloatArray
from trainlog.railway import Line, StepProfile, TrackConditionMap
from trainlog.units import KMH, PER_MILLE

UNITS = {
    "start": "m",
    "end": "m",
    "gradient": "per mille",
    "curve_radius": "m",
    "tunnel": "",
    "station": "",
    "speed_limit": "km/h",
    "speed_limit_reverse": "km/h",
}
"""Unit of each column of `line_table`; the last one where limits differ by direction."""


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
        One row a bin: ``start``, ``end`` [m]; ``gradient`` [per mille], its mean, uphill positive;
        ``curve_radius`` [m], the least, infinite where the line is straight; ``tunnel``, whether
        any of the bin lies in one that the line states; ``station``, the names of those in the
        bin, joined by a comma, else empty; ``speed_limit`` [km/h], the least along the line, and
        where limits differ by direction ``speed_limit_reverse``, the least against it. NaN is what
        the line does not state. Units are in ``attrs["units"]``.

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
    >>> table.loc[400, ["gradient", "curve_radius", "speed_limit"]].astype(float).round(1).tolist()
    [-3.3, 1694.8, 125.0]
    >>> table.station[table.station != ""].tolist()
    ['St.Gallen', 'Gossau SG', 'Flawil', 'Uzwil', 'Wil']
    """
    check_line(track, "line file", line.name, line.length)
    edges = np.minimum(track.bin_length * np.arange(track.bins + 1), line.length)
    start, end = edges[:-1], edges[1:]
    sharpest = _sharpest(line, start, end)
    with np.errstate(divide="ignore"):
        radius = 1.0 / sharpest
    columns: dict[str, object] = {
        "start": start,
        "end": end,
        "gradient": PER_MILLE * line.gradients.mean(start, end),
        "curve_radius": radius,
        "tunnel": _in_tunnel(line, start, end),
        "station": _stations(line, track),
        "speed_limit": KMH * _least(line.speed_limits, start, end),
    }
    if line.speed_limits_reverse is not None:
        columns["speed_limit_reverse"] = KMH * _least(line.speed_limits_reverse, start, end)
    sources = {"gradient": "gradients", "speed_limit": "speed_limits"}
    for column in columns:
        if sources.get(column.removesuffix("_reverse")) in line.assumed:
            columns[column] = np.full(start.size, np.nan)
    table = pd.DataFrame(columns)
    table.attrs["units"] = {name: UNITS[name] for name in table.columns}
    return table


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


def _in_tunnel(line: Line, start: FloatArray, end: FloatArray) -> BoolArray:
    """Whether any of each bin lies in a tunnel, (n,)."""
    inside = np.zeros(start.size, dtype=np.bool_)
    for tunnel in line.tunnels:
        inside |= (start < tunnel.position + tunnel.length) & (end > tunnel.position)
    return inside


def _stations(line: Line, track: TrackConditionMap) -> list[str]:
    """Names of the stations in each bin; ends that only close a line are none."""
    names: list[list[str]] = [[] for _ in range(track.bins)]
    for station in () if "stations" in line.assumed else line.stations:
        names[int(track.bin_of(station.position))].append(station.name)
    return [", ".join(each) for each in names]
