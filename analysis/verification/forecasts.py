"""Forecasts as distributions: those of others, and what a map expects."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.special import ndtr

from analysis.adhesion.condition_table import last_evidence
from analysis.verification.scores import GRID, climatology
from analysis.verification.verify import Forecaster
from trainlog.arrays import FloatArray
from trainlog.condition import known_before, layer_before
from trainlog.errors import InputError
from trainlog.railway.condition import (
    AdhesionEstimate,
    AdhesionForecast,
    ConditionLayer,
    TrackConditionMap,
)
from trainlog.railway.evidence import day_of
from trainlog.units import NANOSECONDS

SHARES = np.array([
    0.005, 0.01, 0.025, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.975,
    0.99, 0.995,
])  # fmt: skip
"""Quantiles in which a map's forecast is written."""

UNIFORM = 0.05
"""Share of a uniform distribution in the climatology by which a forecast is completed."""


def stated_forecast(forecast: AdhesionForecast, track: TrackConditionMap) -> Forecaster:
    """A forecast in a file as distributions by bin.

    Between the points that a row states, and beyond the outermost, the probability is spread as
    that of the climatology: of all distributions with these points it is the one that differs least
    from it (least relative entropy). So a forecast that states one probability of low adhesion can
    be scored, too, and gains nothing by what it does not say.

    Parameters
    ----------
    forecast : AdhesionForecast
    track : TrackConditionMap
        Whose bins and settings are used; it may be empty.

    Raises
    ------
    InputError
        If the forecast is for another line, or reaches beyond its end.
    """
    if forecast.line != track.line:
        raise InputError(
            f"the forecast is for line '{forecast.line}', the trips ran on '{track.line}'",
            remedy="give the forecast for the line of the trips",
        )
    beyond = np.flatnonzero(forecast.end > reach(track))
    if beyond.size:
        raise InputError(
            f"the forecast reaches km {forecast.end[beyond[0]] / 1e3:.3f}, the line ends at"
            f" km {track.length / 1e3:.3f}",
            remedy="count kilometres from the line's beginning",
        )
    rows: dict[tuple[str, int], FloatArray] = {}

    def distribution(layer: str, row: int) -> FloatArray:
        if (layer, row) not in rows:
            rows[layer, row] = _completed(*forecast.points(row), climatology(track, layer))
        return rows[layer, row]

    def expected(layer: str, time: pd.Timestamp) -> AdhesionEstimate | None:
        chosen = forecast.rows_at(layer, time, track.centres)
        if not np.any(chosen >= 0):
            return None
        known, place = np.unique(chosen, return_inverse=True)
        tables = [distribution(layer, row) if row >= 0 else _flat() for row in known.tolist()]
        stated = [row >= 0 and forecast.points(row)[0].size > 0 for row in known.tolist()]
        probability = np.array(tables)[place]
        mean = probability @ GRID
        std = np.sqrt(np.maximum(probability @ GRID**2 - mean**2, 1e-12))
        return AdhesionEstimate(mean, std, np.array(stated)[place], GRID, probability)

    return expected


def reach(track: TrackConditionMap) -> float:
    """Chainage to which a section may reach: a bin beyond the line's end [m]."""
    return track.length + track.bin_length


def _flat() -> FloatArray:
    return np.full(GRID.size, 1.0 / GRID.size)


def _completed(
    adhesion: FloatArray, probability: FloatArray, prior: AdhesionEstimate
) -> FloatArray:
    """Probability of the levels of the grid, given points of the distribution function; (g,)."""
    half = 0.5 * (GRID[1] - GRID[0])
    edges = np.append(GRID - half, GRID[-1] + half)

    def usual(log: FloatArray) -> FloatArray:
        normal = ndtr((log - prior.log_mean[0]) / prior.log_std[0])
        uniform = (log - edges[0]) / (edges[-1] - edges[0])
        return np.asarray((1.0 - UNIFORM) * normal + UNIFORM * uniform)

    at = usual(np.log(np.clip(adhesion, np.exp(edges[0]), np.exp(edges[-1]))))
    inner = (at > usual(edges)[0]) & (at < usual(edges)[-1])
    points = np.concatenate((usual(edges)[:1], at[inner], usual(edges)[-1:]))
    values = np.concatenate(([0.0], probability[inner], [1.0]))
    return np.diff(np.interp(usual(edges), points, values))


def map_forecast(track: TrackConditionMap) -> Forecaster:
    """What a map expects at a time."""

    def expected(layer: str, time: pd.Timestamp) -> AdhesionEstimate | None:
        known = track.layers.get(layer)
        return None if known is None else known.expected(time)

    return expected


def rolling_forecast(track: TrackConditionMap) -> Forecaster:
    """What the map would have expected of each day from the evidence of the days before alone.

    Each day's estimate is that of `before`, in whatever order days are asked for.
    """
    made: dict[tuple[str, int], ConditionLayer | None] = {}

    def expected(layer: str, time: pd.Timestamp) -> AdhesionEstimate | None:
        day = day_of(time)
        if (layer, day) not in made:
            made[layer, day] = layer_before(track, day, layer)
        known = made[layer, day]
        return None if known is None else known.expected(time)

    return expected


def forecast_of(
    track: TrackConditionMap,
    time: pd.Timestamp,
    *,
    layer: str | None = None,
    hours: float = 24.0,
    shares: FloatArray = SHARES,
) -> AdhesionForecast:
    """What a map expects at a time, as a forecast for others; bins not observed state nothing.

    It is issued at that time, and made of the evidence of the days before (UTC) alone
    (`trainlog.condition.known_before`).

    Parameters
    ----------
    track : TrackConditionMap
    time : Timestamp
        At which it begins to hold.
    layer : str, optional
        Rail condition; default: every one of the map.
    hours : float
        For which it is said to hold.
    shares : (k,) array
        Quantiles to state.

    Raises
    ------
    InputError
        If the map has no such layer, or no evidence of a day before, or the forecast is to hold
        for no time.

    Examples
    --------
    >>> from trainlog.formats.mapfile import read_map
    >>> track = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> found = forecast_of(track, pd.Timestamp("2026-11-22T06:00Z"), layer="wet")
    >>> found.start.size == track.bins, bool(found.end[-1] == track.length)
    (True, True)
    """
    if not 0.0 < hours < np.inf:
        raise InputError(
            f"a forecast must hold for a time, not for {hours:g} h", remedy="give hours above 0"
        )
    track = known_before(track, time)
    names = list(track.layers) if layer is None else [layer]
    tables = [track.layer(name).expected(time) for name in names]
    count, first = len(names) * track.bins, time.as_unit("ns").value
    known = np.concatenate([each.observed for each in tables])
    quantiles = [
        np.column_stack([each.quantile(float(share)) for share in shares]) for each in tables
    ]
    return AdhesionForecast(
        track.line,
        start=np.tile(track.edges[:-1], len(names)),
        end=np.tile(track.edges[1:], len(names)),
        valid_from=np.full(count, first, dtype=np.int64),
        valid_to=np.full(count, first + round(hours * 3600 * NANOSECONDS), dtype=np.int64),
        issued=np.full(count, first, dtype=np.int64),
        layer=tuple(name for name in names for _ in range(track.bins)),
        shares=np.asarray(shares, dtype=np.float64),
        quantiles=np.where(known[:, None], np.minimum(np.concatenate(quantiles), 1.0), np.nan),
        thresholds=np.zeros(0),
        below=np.zeros((count, 0)),
    )


def first_free(track: TrackConditionMap) -> pd.Timestamp:
    """The beginning of the day after the last evidence of a map.

    Raises
    ------
    InputError
        If the map holds no evidence.
    """
    free = last_evidence(track)
    if free is None:
        raise InputError(
            f"map of line '{track.line}' has no evidence to forecast from",
            remedy="count a trip in first",
        )
    return free
