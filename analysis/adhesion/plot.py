"""Pictures of a track-condition map, layer by layer, and of an adhesion characteristic."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray

from analysis.plotting import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    PALE,
    RED,
    dress,
    headline,
    legend,
    new_figure,
    write_figure,
)
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.railway.condition import ConditionLayer, TrackConditionMap
from trainlog.units import KMH

if TYPE_CHECKING:
    from analysis.adhesion.characteristic import CharacteristicFit

FloatArray = NDArray[np.float64]

COLOURS = {"dry": ORANGE, "wet": BLUE}
"""Of the layers; others are drawn in ink."""


def draw_map(
    track: TrackConditionMap, path: str | Path, truth: Mapping[str, ArrayLike] | None = None
) -> None:
    """Draw maximum adhesion with its 95 % band where it was observed; grey where it was not.

    Parameters
    ----------
    track : TrackConditionMap
    path : path
        PNG file.
    truth : mapping of str to (bins,) array, optional
        True maximum adhesion a bin, by layer, to compare with.

    Raises
    ------
    InputError
        If the map has no layer yet.
    """
    if not track.layers:
        raise InputError(
            f"map of line '{track.line}' has no layer to draw", remedy="count a trip in first"
        )
    figure = new_figure(11.0, 0.6 + 2.7 * len(track.layers))
    axes = np.atleast_1d(figure.subplots(len(track.layers), 1, sharex=True, sharey=True))
    for place, (name, layer) in zip(axes, track.layers.items(), strict=True):
        known = None if truth is None or name not in truth else np.asarray(truth[name])
        _draw_layer(place, track, name, layer, known)
        dress(place, x="", y="maximum adhesion", title=_title(track, name, layer))
        legend(place, "lower right", bbox_to_anchor=(1.0, 1.0), ncols=6)
    axes[-1].set_xlabel("km", color=INK)
    axes[-1].set_xlim(0.0, track.length / 1e3)
    axes[-1].set_ylim(0.0, _top(track))
    headline(figure, f"{track.line}: maximum adhesion, {track.bin_length:.0f} m bins")
    write_figure(figure, path)


def draw_characteristic(fit: CharacteristicFit, path: str | Path) -> None:
    """Draw measured points of adhesion over slip, the curve fitted to them, and its maximum.

    Parameters
    ----------
    fit : CharacteristicFit
    path : path
        PNG file.
    """
    from analysis.adhesion.characteristic import NAMES

    points = fit.points
    over_creepage = points.variable == "creepage"
    scale, unit = (100.0, "%") if over_creepage else (KMH, "km/h")
    speed = None if np.isnan(fit.speed) else fit.speed
    last = 1.02 * float(points.slips.max())
    near = min(4.0 * fit.optimal_slip, last)
    slips = np.unique(np.concatenate([np.linspace(0.0, end, 400) for end in (near, last)]))
    curve = fit.characteristic
    adhesion = curve.over_creepage(slips, speed or 1.0) if over_creepage else curve(slips, speed)
    figure = new_figure(11.0, 4.2)
    places = figure.subplots(1, 2, sharey=True)
    low, high = fit.optimal_band
    for axes, end in zip(places, (near, last), strict=True):
        axes.axvspan(
            scale * low, scale * min(high, end), color=PALE, alpha=0.45, linewidth=0,
            label="optimum, 95 % band",
        )  # fmt: skip
        axes.plot(scale * points.slips, points.adhesions, ".", color=GREY, label="measured")
        axes.plot(scale * slips, adhesion, color=BLUE, linewidth=1.4, label=NAMES[fit.family])
        axes.errorbar(
            scale * fit.optimal_slip, fit.maximum, 1.96 * fit.maximum_std, fmt="o", color=RED,
            markersize=4, capsize=3, label="maximum, 95 % band",
        )  # fmt: skip
        axes.set_xlim(0.0, scale * end)
    places[0].set_ylim(0.0, 1.15 * max(fit.maximum, float(points.adhesions.max())))
    dress(places[0], x=f"{points.variable} [{unit}]", y="adhesion", title="up to the maximum")
    dress(places[1], x=f"{points.variable} [{unit}]", y="", title="all points")
    legend(places[1], "lower right")
    at = f" at {KMH * speed:.0f} km/h" if speed is not None else ""
    headline(
        figure,
        f"Adhesion characteristic: maximum {fit.maximum:.3f} ± {1.96 * fit.maximum_std:.3f},"
        f" optimal {points.variable} {fit.optimum_in_words()}{at}",
    )
    write_figure(figure, path)


def _draw_layer(
    axes: Axes,
    track: TrackConditionMap,
    name: str,
    layer: ConditionLayer,
    truth: FloatArray | None,
) -> None:
    colour = COLOURS.get(name, INK)
    edges = np.minimum(np.arange(track.bins + 1) * track.bin_length, track.length) / 1e3
    axes.fill_between(
        edges,
        0.0,
        1.0,
        where=np.append(~layer.observed, False),
        step="post",
        transform=axes.get_xaxis_transform(),
        color=PALE,
        alpha=0.45,
        linewidth=0,
        label="not observed",
    )
    if truth is not None:
        axes.stairs(truth, edges, baseline=None, color=INK, linewidth=0.8, label="truth")
    used = np.fmax.reduce(np.where(layer.evidence.censored > 0.0, track.levels, np.nan), axis=1)
    axes.stairs(
        used,
        edges,
        baseline=None,
        color=GREY,
        linewidth=0.8,
        label="used without slip",
    )
    # Bins are narrow on a long line: the estimate is drawn as points with bars.
    seen = layer.observed
    centres = 0.5 * (edges[:-1] + edges[1:])[seen]
    mean, std = layer.log_mean[seen], layer.log_std[seen]
    axes.vlines(
        centres,
        np.exp(mean - 1.96 * std),
        np.exp(mean + 1.96 * std),
        color=colour,
        alpha=0.45,
        linewidth=1.4,
        label="95 % band",
    )
    axes.plot(centres, np.exp(mean), ".", color=colour, markersize=4, label="estimate")
    slips = layer.events > 0
    axes.plot(
        (0.5 * (edges[:-1] + edges[1:]))[slips],
        np.full(np.count_nonzero(slips), 0.025),
        "|",
        transform=axes.get_xaxis_transform(),
        color=RED,
        markersize=7,
        label="slip",
    )


def _title(track: TrackConditionMap, name: str, layer: ConditionLayer) -> str:
    trips = sum(trip["layer"] == name for trip in track.trips)
    share = float(np.mean(layer.observed))
    onsets = int(layer.events.sum())
    lacking = sum(trip["layer"] == name and bool(trip.get("notes")) for trip in track.trips)
    words = f", {lacking} with recorders that lack something" if lacking else ""
    of = f"{counted(trips, 'trip')}, {counted(onsets, 'onset')} of slip"
    return f"{name}: {of}, {share:.1%} observed{words}"


def _top(track: TrackConditionMap) -> float:
    """Upper end of the adhesion axis: the highest band drawn, in tenths."""
    tops = [
        float(np.exp(np.max(layer.log_mean[layer.observed] + 1.96 * layer.log_std[layer.observed])))
        for layer in track.layers.values()
        if layer.observed.any()
    ]
    return max(0.4, 0.1 * float(np.ceil(10.0 * max(tops, default=0.0))))
