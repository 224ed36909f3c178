"""Charts of what a fleet shows of its trains."""

from __future__ import annotations

import numpy as np
import pandas as pd

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
    Chart,
    Curve,
    Label,
    Panel,
    Rule,
    Span,
    days_of,
)
from analysis.fleet.channels import CHANNEL_UNITS
from analysis.fleet.resistance import KindResistance
from analysis.fleet.trains import AT, FleetTrains
from analysis.fleet.unlike import Finding
from trainlog.display import counted
from trainlog.units import KMH

MOST_NAMED = 60
"""More trains than this are not named one by one."""

MOST_DRAWN = 1_500
"""Trips of a channel that are drawn one by one; of more every second, third ... is."""

MOST_LEVELS = 100
"""Points of a train's level over time."""

MOST_FINDINGS = 24
"""Findings that are drawn."""


def resistance_charts(kind: KindResistance, found: FleetTrains) -> list[Chart]:
    """Each train's curve with the kind's spread, and at 80 km/h by train with its band."""
    speed = np.linspace(0.0, kind.mean.asked[1], 120)
    unlike = {each.train for each in found.unlike.findings if each.kind == kind.kind}
    low, high = (each / 1e3 for each in kind.another.band_at(speed))
    mean = kind.mean.resistance(speed) / 1e3
    spread = "95 % of trains of this kind, at each speed"
    curves = [Curve(spread, KMH * speed, high, PALE, "area", low)]
    for each in sorted(kind.trains, key=lambda each: each.train in unlike):
        other = each.train in unlike
        label = "a train with a finding" if other else "a train"
        curves.append(
            Curve(label, KMH * speed, each.resistance(speed) / 1e3,
                  RED if other else BLUE, width=1.2 if other else 0.7,
                  opacity=1.0 if other else 0.6)
        )  # fmt: skip
    curves.append(Curve("mean of the kind", KMH * speed, mean, INK, width=1.6))
    trips = counted(kind.mean.trips, "trip")
    words = f"{counted(len(kind.trains), 'train')} of kind {kind.kind}, {trips}"
    if not kind.compared:
        words += "; too few trains of the kind to call one unlike the others"
    panel = Panel("running resistance [kN]", curves, 1.8, from_zero=True)
    return [
        Chart("speed [km/h]", [panel], title=words, width=0.55),
        _by_train(kind, unlike),
    ]


def _by_train(kind: KindResistance, unlike: set[str]) -> Chart:
    """Resistance at 80 km/h of each train, the least first."""
    trains = sorted(kind.trains, key=lambda each: float(each.resistance(AT)))
    value = np.array([float(each.resistance(AT)) for each in trains]) / 1e3
    ends = np.array([each.band_at(AT) for each in trains], dtype=np.float64).reshape(-1, 2) / 1e3
    low, high = (float(each) / 1e3 for each in kind.another.band_at(AT))
    other = np.array([each.train in unlike for each in trains], dtype=np.bool_)
    points = [
        Curve("", value[rows], np.flatnonzero(rows), colour, "points", ends[rows, 0],
              ends[rows, 1], width=2.0, across=True)
        for rows, colour in ((~other, BLUE), (other, RED))
        if rows.any()
    ]  # fmt: skip
    few = len(trains) <= MOST_NAMED
    least, most = min(low, *ends[:, 0].tolist()), max(high, *ends[:, 1].tolist())
    margin = 0.05 * (most - least)
    panel = Panel(
        "", points, max(1.8, 0.075 * len(trains) * few),
        rows=[f"{each.train} ({each.trips})" if few else " " for each in trains],
        rules=[Rule(float(kind.mean.resistance(AT)) / 1e3, upright=True)],
        spans=[Span(low, high, PALE, "", 0.7)],
    )  # fmt: skip
    return Chart(
        "running resistance at 80 km/h [kN]", [panel],
        title="by train, with 95 % band; grey: 95 % of trains of this kind",
        span=(least - margin, most + margin), beside=True, width=0.45,
    )  # fmt: skip


def channels_over_time(kind: str, found: FleetTrains) -> list[str]:
    """The channels of a kind that `drift_charts` draws; none where its trips are too few."""
    shown = ("size of the curve", "speed scale", "effort gain", "effort delay")
    return [name for name in shown if name in found.unlike.series.get(kind, {})]


def drift_charts(kind: str, found: FleetTrains) -> list[Chart]:
    """Channels of a kind over time: each trip, and the running level of each train."""
    trips = found.trips[kind]
    findings = [each for each in found.unlike.findings if each.kind == kind]
    unlike = {each.train for each in findings}
    every = sorted(set(trips["train"].astype(str)), key=lambda each: (each not in unlike, each))
    # Of the trains that are named: those with a finding first, then the others.
    colours = dict(zip(every, (RED, SKY, GREEN, PURPLE, ORANGE, INK), strict=False))
    parts = [
        _channel(kind, name, found, findings, colours, named=number == 0)
        for number, name in enumerate(channels_over_time(kind, found))
    ]
    thinned = max((step for _, step in parts), default=1)
    what = "against the other trains" if len(set(trips["train"])) > 1 else "over time"
    drawn = "each trip" if thinned == 1 else f"one trip of {thinned}"
    return [
        Chart(
            "", [panel for panel, _ in parts],
            dates=True,
            title=f"Kind {kind}, {what}: {drawn} (grey), median of nine trips of a train (line)",
        )
    ]  # fmt: skip


def _channel(
    kind: str,
    name: str,
    found: FleetTrains,
    findings: list[Finding],
    colours: dict[str, str],
    *,
    named: bool,
) -> tuple[Panel, int]:
    """A channel over time, and how many trips stand for one that is drawn."""
    series = found.unlike.series[kind][name]
    trips = found.trips[kind]
    factor, unit = CHANNEL_UNITS[series.channel.unit]
    day = days_of(trips["start"].iloc[series.rows])
    names = trips["train"].to_numpy(str)[series.rows]
    own = factor * (series.own if series.common else series.value - np.median(series.value))
    step = -(-own.size // MOST_DRAWN)
    curves = [Curve("", day[::step], own[::step], GREY, "points", width=1.0, opacity=0.5)]
    for train in np.unique(names).tolist():
        mine = names == train
        since = np.sort(days_of(pd.Series([e.since for e in findings if e.train == train])))
        label = train if train in colours else "another train"
        # A median over trips on both sides of a step would make a slope of it.
        part = np.searchsorted(since, day[mine], "right")
        for each in np.unique(part).tolist():
            rows = np.flatnonzero(mine)[part == each]
            at = np.arange(0, rows.size, -(-rows.size // MOST_LEVELS))
            level = [np.median(own[rows[max(k - 4, 0) : k + 5]]) for k in at]
            words, colour = label if named and each == 0 else "", colours.get(train, BLUE)
            wide = 1.4 if since.size else 0.9
            curves.append(Curve(words, day[rows[at]], level, colour, width=wide))
    low, high = np.quantile(own, (0.005, 0.995))
    margin = 0.15 * (high - low)
    shown = [each for each in findings if each.channel == name]
    marks = days_of(pd.Series([each.since for each in shown]))
    labels = [
        Label(float(at), f"{each.train}: {each.explanation.cause.what} ",
              float(high - 0.11 * (high - low) * (number % 8)), RED, side="right")
        for number, (at, each) in enumerate(zip(marks, shown, strict=True))
    ]  # fmt: skip
    panel = Panel(
        unit, curves, 0.95, f"{name}: {series.channel.about}", labels=labels,
        limits=(float(low - margin), float(high + margin)),
        rules=[Rule(float(at), RED, upright=True, dash="--") for at in marks],
    )  # fmt: skip
    return panel, step


def findings_charts(found: FleetTrains) -> list[Chart]:
    """Each finding: the channel that showed it, trip by trip, and since when."""
    findings = list(found.unlike.findings)[:MOST_FINDINGS]
    if not findings:
        words = (
            f"{found.too_few} At most {100.0 * found.unlike.rate:g} % of healthy trains raise an"
            " alarm in a month. A fault smaller than the limits of the table would not be seen."
        )
        title = f"No finding in {found.unlike.train_months:.1f} months of trains"
        nothing = Label(0.5, "nothing to draw", 0.5, size=9.0)
        panel = Panel("", [], 0.4, labels=[nothing], bare=True)
        return [Chart("", [panel], title=f"{title}\n{words.strip()}")]
    return [_finding(found, each, number) for number, each in enumerate(findings)]


def _finding(found: FleetTrains, finding: Finding, number: int) -> Chart:
    series = found.unlike.series[finding.kind][finding.channel]
    trips = found.trips[finding.kind].iloc[series.rows]
    mine = (trips["train"] == finding.train).to_numpy()
    factor, unit = CHANNEL_UNITS[series.channel.unit]
    own, reach = factor * series.own[mine], 1.96 * factor * series.std[mine]
    after = finding.lasts(trips["start"][mine])
    order = np.arange(own.size)
    points = [
        Curve("", order[rows], own[rows], colour, "points", (own - reach)[rows],
              (own + reach)[rows], width=1.5)
        for rows, colour in ((~after, BLUE), (after, RED))
        if rows.any()
    ]  # fmt: skip
    panel = Panel(f"{finding.channel} [{unit}]", points, 0.9, rules=[Rule(0.0, GREEN)])
    return Chart(
        "trip of this train", [panel],
        title=f"{finding.train}\n{finding.explanation.cause}", beside=number % 3 > 0, width=0.33,
    )  # fmt: skip
