"""Picture of how good a forecast was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

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
from analysis.verification.scoring import Score
from analysis.verification.verify import Verification


def draw_score(score: Score, path: str | Path) -> None:
    """Draw reliability of quantiles and of slip, the curve of alarms, and the gain of each day.

    Parameters
    ----------
    score : Score
    path : path
        PNG file.
    """
    whole = score.layers["all"]
    figure = new_figure(11.0, 8.0)
    places = figure.subplots(2, 2)
    _draw_quantiles(places[0, 0], whole)
    _draw_slips(places[0, 1], whole)
    _draw_alarms(places[1, 0], whole)
    _draw_days(places[1, 1], whole)
    headline(
        figure,
        f"{score.line}: {score.name}, {whole.days.size} days, {whole.onsets} onsets of slip scored,"
        f" {whole.unknown_onsets} where it was unknown",
    )
    write_figure(figure, path)


def _draw_quantiles(axes: Axes, found: Verification) -> None:
    grid = [0.01, 0.025, *np.arange(0.05, 0.96, 0.05).tolist(), 0.975, 0.99]
    rows = [(quantile, share) for quantile, share, trips in found.reliability(grid) if trips >= 5]
    x, y = [each for each, _ in rows], [share.value for _, share in rows]
    axes.plot([0.0, 1.0], [0.0, 1.0], color=GREY, linewidth=0.8, label="reliable")
    axes.fill_between(
        x,
        [share.low for _, share in rows],
        [share.high for _, share in rows],
        color=BLUE,
        alpha=0.2,
        linewidth=0,
        label="95 % band",
    )
    axes.plot(x, y, ".-", color=BLUE, label="observed")
    dress(
        axes,
        x="quantile forecast",
        y="share of maxima below",
        title="Reliability of the maximum adhesion",
    )
    legend(axes, "upper left")


def _draw_slips(axes: Axes, found: Verification) -> None:
    rows = found.classes()
    axes.plot([0.0, 1.0], [0.0, 1.0], color=GREY, linewidth=0.8)
    for forecast, share, trips, slips in rows:
        # Wilson's interval: what the number of trips alone leaves open.
        centre = (slips + 1.92) / (trips + 3.84)
        reach = 1.96 * np.sqrt(share * (1.0 - share) * trips + 0.96) / (trips + 3.84)
        axes.vlines(forecast, centre - reach, centre + reach, color=ORANGE, alpha=0.6)
        axes.annotate(
            f"{trips:.0f}",
            (forecast, share),
            textcoords="offset points",
            xytext=(5, -9),
            fontsize=7,
            color=GREY,
        )
    axes.plot([row[0] for row in rows], [row[1] for row in rows], "o", color=ORANGE, markersize=4)
    dress(
        axes,
        x="probability of slip forecast",
        y="share of passages with slip",
        title="Reliability of slip in a bin; number of passages",
    )


def _draw_alarms(axes: Axes, found: Verification) -> None:
    curve = found.alarm_curve()
    x = np.array([false.value for *_, false in curve])
    y = np.array([foreseen.value for _, foreseen, _ in curve])
    axes.plot(x, y, "-", color=RED, linewidth=1.2)
    near, at = 0.02 * float(np.nanmax(x, initial=1e-9)), np.inf
    for level, foreseen, false in curve:
        if at - false.value < near:
            continue
        at = false.value
        if np.isfinite(foreseen.low):
            axes.vlines(false.value, foreseen.low, foreseen.high, color=RED, alpha=0.3)
        axes.annotate(
            f"{level:g}",
            (false.value, foreseen.value),
            textcoords="offset points",
            xytext=(4, -8),
            fontsize=7,
            color=INK,
        )
    axes.plot(x, y, ".", color=RED)
    axes.set_ylim(0.0, 1.03)
    axes.set_xlim(left=0.0)
    dress(
        axes,
        x="false alarms per train-km",
        y="share of slips foreseen",
        title="Alarm from this probability of slip on",
    )


def _draw_days(axes: Axes, found: Verification) -> None:
    days = pd.to_datetime(found.days, unit="D").to_numpy()
    known = found.counts[:, 0, 0]
    own = found.scores["forecast"][:, 0]
    for other, colour, mark in (("prior", BLUE, "o"), ("persistence", ORANGE, "x")):
        gain = (own - found.scores[other][:, 0]) / np.where(known > 0.0, known, np.nan)
        axes.plot(days, gain, mark, color=colour, markersize=4, label=f"over {other}")
    axes.axhline(0.0, color=PALE, linewidth=1.0)
    axes.tick_params(axis="x", rotation=30)
    dress(axes, x="", y="nat an onset", title="Gain of the log score, day by day")
    legend(axes, "lower right")
