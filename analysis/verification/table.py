"""Tables of how good forecasts were."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from analysis.verification.scoring import Score
from analysis.verification.verify import USUAL_ALARM, Figure, Verification
from trainlog.presentation import WordTable, new_table


def score_tables(score: Score) -> list[WordTable]:
    """Scores by rail condition with their 95 % bands, reliability, alarms, and edges."""
    names = [name for name in score.layers if name != "all"]
    shown = names if len(names) == 1 else [*names, "all"]
    table = new_table(f"Score of {score.name} on {score.line} (95 % band by day)", "", *shown)
    for title, figure in ROWS:
        table.add_row(title, *(figure(score.layers[name]) for name in shown))
    whole = score.layers["all"]
    edges = [_edges(score.edges)] if score.edges else []
    return [table, _reliability(whole), _alarms(whole), *edges]


def _said(figure: Figure, digits: int = 2, sign: bool = False) -> str:
    if not np.isfinite(figure.value):
        return "-"
    form = f"{'+' if sign else ''}.{digits}f"
    low, high = (f"{each:.{digits}f}" for each in (figure.low, figure.high))
    band = f"\n({low}, {high})" if np.isfinite(figure.low) else ""
    return f"{figure.value:{form}}{band}"


def _share(figure: Figure) -> str:
    if not np.isfinite(figure.value):
        return "-"
    band = f"\n({figure.low:.0%}, {figure.high:.0%})" if np.isfinite(figure.low) else ""
    return f"{figure.value:.1%}{band}"


ROWS: tuple[tuple[str, Callable[[Verification], str]], ...] = (
    (
        "days\n  on which the forecast is known",
        lambda v: f"{v.days.size}\n{v.known_days}",
    ),
    (
        "train-km\n  where the forecast is known",
        lambda v: f"{v.train_km:.0f}\n{v.known_train_km:.3g}",
    ),
    (
        "onsets of slip scored\nwhere the forecast is unknown",
        lambda v: f"{v.onsets}\n{v.unknown_onsets}",
    ),
    ("passages without slip scored\nwhere it is unknown", lambda v: f"{v.used}\n{v.unknown_used}"),
    ("log score of onsets [nat]", lambda v: _said(v.log_score("onsets"))),
    ("  gain over the prior", lambda v: _said(v.log_score("onsets", over="prior"), 2, True)),
    (
        "  gain over persistence",
        lambda v: _said(v.log_score("onsets", over="persistence"), 2, True),
    ),
    ("  gain over the place alone", lambda v: _said(v.log_score("onsets", over="place"), 2, True)),
    ("log score of used adhesion [nat]", lambda v: _said(v.log_score("used"), 3)),
    ("  gain over the prior", lambda v: _said(v.log_score("used", over="prior"), 3, True)),
    (
        "  gain over persistence",
        lambda v: _said(v.log_score("used", over="persistence"), 3, True),
    ),
    (
        "  gain over the place alone",
        lambda v: _said(v.log_score("used", over="place"), 3, True),
    ),
    ("CRPS of onsets, log adhesion", lambda v: _said(v.crps(), 3)),
    (
        "  of the prior\n  of persistence\n  of the place alone",
        lambda v: "\n".join(
            _said(Figure(v.crps(name).value), 3) for name in ("prior", "persistence", "place")
        ),
    ),
    ("maxima in the 95 % band", lambda v: _share(v.coverage)),
    ("measured onsets in it", lambda v: _share(v.onsets_in_band)),
    ("Brier score of slip", lambda v: _said(v.brier_figure("score"), 4)),
    (
        "  reliability\n  less resolution\n  plus uncertainty",
        lambda v: "\n".join(
            _said(Figure(v.brier_figure(part).value), 4)
            for part in ("reliability", "resolution", "uncertainty")
        ),
    ),
    ("  skill over the prior", lambda v: _said(v.brier_gain("prior"), 2, True)),
    ("  skill over persistence", lambda v: _said(v.brier_gain("persistence"), 2, True)),
    (f"slips foreseen, alarm at {USUAL_ALARM:.0%}", lambda v: _share(v.alarm().foreseen)),
    ("  of those where the forecast is known", lambda v: _share(v.alarm().foreseen_known)),
    ("false alarms per known train-km", lambda v: _said(v.alarm().false_alarms)),
)


def _edges(edges: Mapping[str, Verification]) -> WordTable:
    """How good the forecasts of each edge were, all rail conditions together."""
    table = new_table(
        "By edge, all rail conditions (95 % band by day)",
        "edge", "onsets", "gain over\nthe prior [nat]", "over persistence\n[nat]",
        "over the\nplace alone [nat]", "CRPS", "maxima in\n95 % band", "onsets in it",
    )  # fmt: skip
    for edge, whole in edges.items():
        gains = [_said(whole.log_score("onsets", over=name), 2, sign=True)
                 for name in ("prior", "persistence", "place")]  # fmt: skip
        crps = f"{whole.crps().value:.3f}" if whole.onsets else "-"
        shares = _share(whole.coverage), _share(whole.onsets_in_band)
        table.add_row(edge, str(whole.onsets), *gains, crps, *shares)
    return table


def _reliability(found: Verification) -> WordTable:
    table = new_table(
        "Reliability: share of maxima below a quantile of their forecast",
        "quantile",
        *(f"{quantile:.1%}" for quantile, _, _ in found.reliability()),
    )
    rows = found.reliability()
    table.add_row("observed", *(_share(Figure(share.value)) for _, share, _ in rows))
    table.add_row("95 % band", *(_band(share) for _, share, _ in rows))
    table.add_row("trips", *(f"{trips}" for _, _, trips in rows))
    return table


def _band(figure: Figure) -> str:
    return f"{figure.low:.0%} to {figure.high:.0%}" if np.isfinite(figure.low) else "-"


def _alarms(found: Verification) -> WordTable:
    curve = found.alarm_curve()
    table = new_table(
        "Alarm where the probability of slip is at least",
        "",
        *(f"{each.probability:g}" for each in curve),
    )
    for title, figure in (
        ("slips foreseen", lambda each: _share(Figure(each.foreseen.value))),
        ("  of those where known", lambda each: _share(Figure(each.foreseen_known.value))),
        ("false alarms per known train-km", lambda each: _said(Figure(each.false_alarms.value))),
    ):
        table.add_row(title, *map(figure, curve))
    return table
