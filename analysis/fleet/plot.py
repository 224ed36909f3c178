"""Pictures of what a fleet shows of its trains."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from numpy.typing import NDArray

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    PURPLE,
    RED,
    SKY,
    dress,
    headline,
    legend,
    new_figure,
    write_figure,
)
from analysis.fleet.resistance import KindResistance
from analysis.fleet.trains import FleetTrains
from analysis.fleet.trains_table import AT
from analysis.fleet.unlike import Finding
from trainlog.arrays import FloatArray
from trainlog.display import counted
from trainlog.units import KMH

MOST_NAMED = 60
"""More trains than this are not named one by one."""

MOST_DRAWN = 1_500
"""Trips of a channel that are drawn one by one; of more every second, third ... is."""

MOST_LEVELS = 100
"""Points of a train's level over time."""

CHANNEL_UNITS = {"1": (100.0, "%"), "N": (1e-3, "kN"), "s": (1.0, "s")}


def draw_resistance(kind: KindResistance, found: FleetTrains, path: str | Path) -> None:
    """Each train's curve with the kind's spread, and at 80 km/h by train with its band."""
    named = min(len(kind.trains), MOST_NAMED)
    figure = new_figure(11.0, max(4.6, 1.8 + 0.2 * named))
    left, right = figure.subplots(1, 2)
    speed = np.linspace(0.0, kind.mean.asked[1], 120)
    unlike = {each.train for each in found.unlike.findings if each.kind == kind.kind}
    low, high = kind.another.band_at(speed)
    mean = kind.mean.resistance(speed)
    left.fill_between(
        KMH * speed,
        low / 1e3,
        high / 1e3,
        color=PALE,
        alpha=0.7,
        lw=0.0,
        label="95 % of trains of this kind, at each speed",
    )
    for each in kind.trains:
        other = each.train in unlike
        left.plot(
            KMH * speed,
            each.resistance(speed) / 1e3,
            color=RED if other else BLUE,
            lw=1.2 if other else 0.7,
            alpha=1.0 if other else 0.6,
        )
    left.plot(KMH * speed, mean / 1e3, color=INK, lw=1.6, label="mean of the kind")
    left.plot([], [], color=BLUE, lw=0.9, label="a train")
    if unlike:
        left.plot([], [], color=RED, lw=1.2, label="a train with a finding")
    dress(left, x="speed [km/h]", y="running resistance [kN]", title="curves")
    left.set_xlim(0.0, KMH * float(speed[-1]))
    left.set_ylim(bottom=0.0)
    legend(left)
    _by_train(right, kind, unlike)
    trips = counted(kind.mean.trips, "trip")
    words = f"{counted(len(kind.trains), 'train')} of kind {kind.kind}, {trips}"
    if not kind.compared:
        words += "; too few trains of the kind to call one unlike the others"
    headline(figure, words)
    write_figure(figure, path)


def _by_train(axes: Axes, kind: KindResistance, unlike: set[str]) -> None:
    """Resistance at 80 km/h of each train, the least first."""
    trains = sorted(kind.trains, key=lambda each: float(each.resistance(AT)))
    value = np.array([float(each.resistance(AT)) for each in trains]) / 1e3
    ends = np.array([each.band_at(AT) for each in trains], dtype=np.float64).reshape(-1, 2) / 1e3
    place = np.arange(len(trains))
    middle = float(kind.mean.resistance(AT)) / 1e3
    low, high = kind.another.band_at(AT)
    axes.axvspan(float(low) / 1e3, float(high) / 1e3, color=PALE, alpha=0.7, lw=0.0)
    axes.axvline(middle, color=INK, lw=1.0)
    colours = [RED if each.train in unlike else BLUE for each in trains]
    axes.hlines(place, ends[:, 0], ends[:, 1], colors=colours, lw=1.4)
    axes.scatter(value, place, c=colours, s=16, zorder=3)
    dress(
        axes,
        x="running resistance at 80 km/h [kN]",
        y="",
        title="by train, with 95 % band; grey: 95 % of trains of this kind",
    )
    few = len(trains) <= MOST_NAMED
    axes.set_yticks(place if few else [])
    if few:
        axes.set_yticklabels([f"{each.train} ({each.trips})" for each in trains], fontsize=7)


def channels_over_time(kind: str, found: FleetTrains) -> list[str]:
    """The channels of a kind that `draw_drift` draws; none where its trips are too few."""
    shown = ("size of the curve", "speed scale", "effort gain", "effort delay")
    return [name for name in shown if name in found.unlike.series.get(kind, {})]


def draw_drift(kind: str, found: FleetTrains, path: str | Path) -> None:
    """Channels of a kind over time: each trip, and the running level of each train."""
    channels = channels_over_time(kind, found)
    trips = found.trips[kind]
    figure = new_figure(10.0, 2.3 * len(channels) + 0.6)
    panels = np.atleast_1d(figure.subplots(len(channels), 1, sharex=True))
    findings = [each for each in found.unlike.findings if each.kind == kind]
    colours = _colours(trips["train"], {each.train for each in findings})
    thinned = 1
    for axes, name in zip(panels, channels, strict=True):
        series = found.unlike.series[kind][name]
        factor, unit = CHANNEL_UNITS[series.channel.unit]
        start = trips["start"].iloc[series.rows]
        names = trips["train"].to_numpy(str)[series.rows]
        own = factor * (series.own if series.common else series.value - np.median(series.value))
        step = -(-own.size // MOST_DRAWN)
        thinned = max(thinned, step)
        axes.plot(start[::step], own[::step], ".", color=GREY, ms=2.0, alpha=0.5)
        for train in np.unique(names).tolist():
            mine = names == train
            since = _instants(
                pd.Series([e.since for e in findings if e.train == train], dtype=start.dtype)
            )
            colour, width = colours.get(train, BLUE), 1.4 if since.size else 0.9
            # A median over trips on both sides of a step would make a slope of it.
            part = np.searchsorted(np.sort(since), _instants(start[mine]), "right")
            for each in np.unique(part).tolist():
                when, line = _levels(start[mine][part == each], own[mine][part == each])
                axes.plot(when, line, color=colour, lw=width)
        low, high = np.quantile(own, (0.005, 0.995))
        margin = 0.15 * (high - low)
        axes.set_ylim(low - margin, high + margin)
        dress(axes, x="", y=f"{unit}", title=f"{name}: {series.channel.about}")
        shown = [each for each in findings if each.channel == name]
        for number, each in enumerate(shown):
            axes.axvline(each.since, color=RED, lw=0.8, ls="--")
            axes.annotate(
                f"{each.train}: {each.explanation.cause.what} ",
                (each.since, 0.93 - 0.11 * (number % 8)),
                xycoords=("data", "axes fraction"),
                fontsize=7,
                color=RED,
                va="top",
                ha="right",
            )
    for train, colour in colours.items():
        panels[0].plot([], [], color=colour, lw=1.4, label=train)
    if len(colours) < trips["train"].nunique():
        panels[0].plot([], [], color=BLUE, lw=0.9, label="another train")
    panels[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7, frameon=False)
    locator = AutoDateLocator(minticks=4, maxticks=9)  # type: ignore[no-untyped-call]
    panels[-1].xaxis.set_major_locator(locator)
    panels[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    what = "against the other trains" if len(np.unique(trips["train"])) > 1 else "over time"
    drawn = "each trip" if thinned == 1 else f"one trip of {thinned}"
    headline(figure, f"Kind {kind}, {what}: {drawn} (grey), median of nine trips of a train (line)")
    write_figure(figure, path)


def _colours(train: pd.Series, unlike: set[str]) -> dict[str, str]:
    """Colours of the trains that are named: those with a finding first, then the others."""
    every = sorted(set(train.astype(str)), key=lambda each: (each not in unlike, each))
    return dict(zip(every, (RED, SKY, GREEN, PURPLE, ORANGE, INK), strict=False))


def _instants(start: pd.Series) -> NDArray[np.datetime64]:
    return np.asarray(start.dt.tz_convert("UTC").dt.tz_localize(None), dtype="M8[ns]")


def _levels(start: pd.Series, own: FloatArray) -> tuple[pd.Series, FloatArray]:
    """Running median of nine trips at some of them."""
    at = np.arange(0, own.size, -(-own.size // MOST_LEVELS))
    return start.iloc[at], np.array([np.median(own[max(k - 4, 0) : k + 5]) for k in at])


def draw_findings(found: FleetTrains, path: str | Path) -> None:
    """Each finding: the channel that showed it, trip by trip, and since when."""
    findings: list[Finding] = list(found.unlike.findings)[:24]
    if not findings:
        _draw_none(found, path)
        return
    columns = min(3, len(findings))
    rows = -(-len(findings) // columns)
    figure = new_figure(max(4.0 * columns, 7.0), 2.7 * rows + 0.5)
    panels = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for axes, each in zip(panels, findings, strict=False):
        series = found.unlike.series[each.kind][each.channel]
        trips = found.trips[each.kind].iloc[series.rows]
        mine = (trips["train"] == each.train).to_numpy()
        factor, unit = CHANNEL_UNITS[series.channel.unit]
        start = trips["start"][mine]
        own, std = factor * series.own[mine], factor * series.std[mine]
        after = (start >= each.since).to_numpy()
        axes.errorbar(np.arange(own.size), own, 1.96 * std, fmt="none", ecolor=PALE, elinewidth=1.0)
        order = np.arange(own.size)
        axes.plot(order[~after], own[~after], "o", color=BLUE, ms=3.0)
        axes.plot(order[after], own[after], "o", color=RED, ms=3.0)
        axes.axhline(0.0, color=GREEN, lw=0.8)
        cause = each.explanation.cause
        dress(axes, x="trip of this train", y=f"{each.channel} [{unit}]")
        axes.set_title(f"{each.train}\n{cause}", loc="left", fontsize=9, color=INK)
    for axes in panels[len(findings) :]:
        axes.set_axis_off()
    headline(
        figure,
        f"{counted(len(found.unlike.findings), 'finding')}; at most"
        f" {100.0 * found.unlike.rate:g} % of healthy trains raise an alarm in a month",
    )
    write_figure(figure, path)


def _draw_none(found: FleetTrains, path: str | Path) -> None:
    """That there is no finding, and what this does not mean."""
    figure = new_figure(8.0, 1.3)
    headline(figure, f"No finding in {found.unlike.train_months:.1f} months of trains")
    words = (
        f"{found.too_few} At most {100.0 * found.unlike.rate:g} % of healthy trains raise an alarm"
        " in a month. A fault smaller than the limits of the table would not be seen."
    )
    figure.text(0.01, 0.66, fill(words.strip(), 105), color=INK, fontsize=9, va="top")
    write_figure(figure, path)
