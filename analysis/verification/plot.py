"""Charts of how good a forecast was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    RED,
    Chart,
    Curve,
    Label,
    Panel,
    Rule,
)
from analysis.verification.scoring import Score
from analysis.verification.verify import FORECASTS, USUAL_ALARM, Verification
from trainlog.arrays import FloatArray

LABELLED = 12
"""Points of a curve that are labelled."""


def score_charts(score: Score) -> list[Chart]:
    """Reliability of quantiles and of slip, the curve of alarms, and the gain of each day."""
    whole = score.layers["all"]
    title = (
        f"{score.line}: {score.name}, known on {whole.known_days} of {whole.days.size} days,"
        f" {whole.onsets} onsets of slip scored, {whole.unknown_onsets} where it was unknown"
    )
    charts = (_quantiles(whole, title), _slips(whole), _alarms(whole), _days(whole))
    return [replace(each, width=0.5, beside=row % 2 > 0) for row, each in enumerate(charts)]


def _quantiles(found: Verification, title: str) -> Chart:
    grid = [0.01, 0.025, *np.arange(0.05, 0.96, 0.05).tolist(), 0.975, 0.99]
    rows = [(quantile, share) for quantile, share, trips in found.reliability(grid) if trips >= 5]
    x = np.array([each for each, _ in rows])
    y, low, high = (
        np.array([getattr(share, name) for _, share in rows]) for name in ("value", "low", "high")
    )
    curves = [_diagonal("reliable")]
    if rows:
        curves += [
            Curve("observed, 95 % band", x, y, BLUE, "line", low, high),
            Curve("", x, y, BLUE, "points", width=1.6),
        ]
    words = "Reliability of the maximum adhesion"
    return Chart("quantile forecast", [Panel("share of maxima below", curves, 1.3, words)],
                 title=title)  # fmt: skip


def _diagonal(label: str) -> Curve:
    return Curve(label, [0.0, 1.0], [0.0, 1.0], GREY, width=0.8)


def _slips(found: Verification) -> Chart:
    rows = np.array(found.classes(), dtype=np.float64).reshape(-1, 4)
    forecast, share, trips, slips = rows.T
    # Wilson's interval: what the number of trips alone leaves open.
    centre = (slips + 1.92) / (trips + 3.84)
    reach = 1.96 * np.sqrt(share * (1.0 - share) * trips + 0.96) / (trips + 3.84)
    passages = [f"{each:.0f}" for each in trips]
    points = Curve("", forecast, share, ORANGE, "points", centre - reach, centre + reach,
                   {"passages": passages}, 2.0)  # fmt: skip
    words = "Reliability of slip in a bin; number of passages"
    return Chart(
        "probability of slip forecast",
        [Panel("share of passages with slip", [_diagonal(""), points], 1.3, words,
               limits=(-0.05, 1.05), labels=_labels(forecast, share, passages, GREY))],
        span=(-0.03, 1.06),
    )  # fmt: skip


def _labels(x: FloatArray, y: FloatArray, words: list[str], colour: str) -> list[Label]:
    """Words beside points, where no other stands; the first come first."""
    taken = list[Label]()
    reach_x, reach_y = 0.05 * max(float(np.ptp(x)), 1e-9) if x.size else 1.0, 0.07
    for a, b, each in zip(x.tolist(), y.tolist(), words, strict=True):
        label = Label(a, f"  {each}", b, colour, side="left")
        free = all(
            abs(a - other.x) > reach_x or abs(b - (other.y or 0.0)) > reach_y for other in taken
        )
        if free and len(taken) < LABELLED:
            taken.append(label)
    return taken


def _alarms(found: Verification) -> Chart:
    curve = [each for each in found.alarm_curve() if np.isfinite(each.false_alarms.value)]
    words = "Alarm from this probability of slip on"
    curves, labels, top = list[Curve](), list[Label](), 1.0
    x = np.array([each.false_alarms.value for each in curve])
    if curve:
        top = 1.08 * float(x.max()) or 1.0
        for name, colour, dash, shares in (
            ("of slips where the forecast is known", RED, "", [e.foreseen_known for e in curve]),
            ("of all slips", GREY, "--", [e.foreseen for e in curve]),
        ):
            value, low, high = (
                np.array([getattr(each, part) for each in shares])
                for part in ("value", "low", "high")
            )
            curves += [
                Curve(name, x, value, colour, dash=dash),
                Curve("", x, value, colour, "points", low, high, width=1.6),
            ]
        # The usual threshold is labelled in any case, the others as long as there is place.
        usual_first = sorted(curve, key=lambda e: e.probability * (e.probability != USUAL_ALARM))
        first = [each for each in usual_first if np.isfinite(each.foreseen_known.value)]
        labels = _labels(
            np.array([each.false_alarms.value for each in first]),
            np.array([each.foreseen_known.value for each in first]),
            [f"{each.probability:g}" for each in first], INK,
        )  # fmt: skip
    else:
        labels = [Label(0.5, "no probability of slip scored", 0.5)]
    panel = Panel("share of slips foreseen", curves, 1.3, words, limits=(0.0, 1.05), labels=labels)
    about = "false alarms per train-km on which the forecast is known"
    return Chart(about, [panel], span=(0.0, top))


def _days(found: Verification) -> Chart:
    known = found.counts[:, 0, 0]
    some = known > 0.0
    words = "Gain of the log score, day by day"
    if not some.any():
        nothing = Label(0.5, "no onset scored", 0.5)
        return Chart("", [Panel("nat per onset", [], 1.0, words, labels=[nothing])])
    days = found.days[some].astype(np.float64)
    own = found.scores[some, 0, 0]
    others = dict(zip(FORECASTS, found.scores.swapaxes(0, 1), strict=True))
    points = [
        Curve(f"over {name}", days, (own - others[other][some, 0]) / known[some], colour,
              "points", width=2.0, mark=mark)
        for other, name, colour, mark in (
            ("prior", "prior", BLUE, "o"),
            ("persistence", "persistence", ORANGE, "x"),
            ("place", "the place alone", GREEN, "+"),
        )
    ]  # fmt: skip
    return Chart(
        "", [Panel("nat per onset", points, 1.0, words, rules=[Rule(0.0, PALE, width=1.0)])],
        span=(days.min() - 0.75, days.max() + 0.75), dates=True,
    )  # fmt: skip
