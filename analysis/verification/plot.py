"""Picture of how good a forecast was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from analysis.charts import (
    BLUE,
    GREEN,
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
from analysis.verification.verify import USUAL_ALARM, Alarm, Verification


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
        f"{score.line}: {score.name}, known on {whole.known_days} of {whole.days.size} days,"
        f" {whole.onsets} onsets of slip scored, {whole.unknown_onsets} where it was unknown",
    )
    write_figure(figure, path)


def _draw_quantiles(axes: Axes, found: Verification) -> None:
    grid = [0.01, 0.025, *np.arange(0.05, 0.96, 0.05).tolist(), 0.975, 0.99]
    rows = [(quantile, share) for quantile, share, trips in found.reliability(grid) if trips >= 5]
    x, y = [each for each, _ in rows], [share.value for _, share in rows]
    axes.plot([0.0, 1.0], [0.0, 1.0], color=GREY, linewidth=0.8, label="reliable")
    if any(np.isfinite(share.low) for _, share in rows):
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
    axes.set_xlim(-0.03, 1.06)
    axes.set_ylim(-0.05, 1.05)
    _label_apart(axes, [(row[0], row[1], f"{row[2]:.0f}") for row in rows], GREY)
    axes.plot([row[0] for row in rows], [row[1] for row in rows], "o", color=ORANGE, markersize=4)
    dress(
        axes,
        x="probability of slip forecast",
        y="share of passages with slip",
        title="Reliability of slip in a bin; number of passages",
    )


def _label_apart(axes: Axes, points: list[tuple[float, float, str]], colour: str) -> None:
    """Write beside points where no other label is; one for which there is no place is left out."""
    canvas = np.asarray(axes.transData.transform([(x, y) for x, y, _ in points] or [(0.0, 0.0)]))
    points_per_pixel = 72.0 / axes.figure.dpi
    taken: list[tuple[float, float, float]] = []
    for (x, y, words), (column, row) in zip(points, canvas * points_per_pixel, strict=False):
        width = 4.5 * len(words) + 2.0
        for right, up in ((4, -9), (4, 4), (-width - 2, 4), (-width - 2, -9), (4, 13), (4, -18)):
            left, base = column + right, row + up
            if all(
                left + width < other or other + wide < left or abs(base - line) > 8.5
                for other, wide, line in taken
            ):
                taken.append((left, width, base))
                axes.annotate(
                    words,
                    (x, y),
                    textcoords="offset points",
                    xytext=(right, up),
                    fontsize=7,
                    color=colour,
                )
                break


def _draw_alarms(axes: Axes, found: Verification) -> None:
    curve = [each for each in found.alarm_curve() if np.isfinite(each.false_alarms.value)]
    dress(
        axes,
        x="false alarms per train-km on which the forecast is known",
        y="share of slips foreseen",
        title="Alarm from this probability of slip on",
    )
    axes.set_ylim(0.0, 1.28)  # the legend stands above the curve
    if not curve:
        axes.text(0.5, 0.5, "no probability of slip scored", ha="center", transform=axes.transAxes)
        return
    x = [each.false_alarms.value for each in curve]
    axes.set_xlim(0.0, 1.08 * max(x) or 1.0)
    for words, colour, style, share in (
        ("of slips where the forecast is known", RED, ".-", [e.foreseen_known for e in curve]),
        ("of all slips", GREY, ".--", [e.foreseen for e in curve]),
    ):
        axes.plot(x, [each.value for each in share], style, color=colour, label=words)
        for at, each in zip(x, share, strict=True):
            if np.isfinite(each.low):
                axes.vlines(at, each.low, each.high, color=colour, alpha=0.3)
    first = sorted(curve, key=_usual_first)
    known = [
        (each.false_alarms.value, each.foreseen_known.value, f"{each.probability:g}")
        for each in first
        if np.isfinite(each.foreseen_known.value)
    ]
    _label_apart(axes, known, INK)
    legend(axes, "upper left")


def _usual_first(alarm: Alarm) -> float:
    """The usual threshold is labelled in any case, the others as long as there is place."""
    return 0.0 if alarm.probability == USUAL_ALARM else alarm.probability


def _draw_days(axes: Axes, found: Verification) -> None:
    known = found.counts[:, 0, 0]
    some = known > 0.0
    dress(axes, x="", y="nat an onset", title="Gain of the log score, day by day")
    if not some.any():
        axes.text(0.5, 0.5, "no onset scored", ha="center", transform=axes.transAxes)
        return
    days = pd.to_datetime(found.days[some], unit="D").to_numpy()
    own = found.scores["forecast"][some, 0]
    peers = (
        ("prior", "prior", BLUE, "o"),
        ("persistence", "persistence", ORANGE, "x"),
        ("place", "the place alone", GREEN, "+"),
    )
    for other, words, colour, mark in peers:
        gain = (own - found.scores[other][some, 0]) / known[some]
        axes.plot(
            days,
            gain,
            mark,
            color=colour,
            markersize=4,
            label=f"over {words}",
        )
    axes.axhline(0.0, color=PALE, linewidth=1.0)
    # Whole days, at most eight of them named.
    reached = np.arange(found.days[some].min(), found.days[some].max() + 1)
    step = -(-reached.size // 8)
    named = pd.to_datetime(reached[::step], unit="D")
    axes.set_xticks(named.to_numpy(), [f"{day:%Y-%m-%d}" for day in named])
    axes.set_xlim(days.min() - np.timedelta64(18, "h"), days.max() + np.timedelta64(18, "h"))
    axes.tick_params(axis="x", rotation=30)
    legend(axes, "lower right")
