"""Drift: what changes slowly, in a train and in all trains of a kind.

Wheels wear, so that the recorded speed rises over the true one; dirt and cold add to the running
resistance. Of a train the trend is that of its channels less what its kind shows; of a kind that
of its trips, with a season of the year once the trips span enough of it. A step that was found
(`analysis.fleet.unlike`) is a step, and not a part of a trend.

A trend is the slope of a robust regression on time. Neighbouring trips err together: its variance
is that of the sums over weeks, each week counted as one.

References
----------
Huber, P. J. (1964), Robust estimation of a location parameter, Annals of Mathematical Statistics
35(1).
Liang, K.-Y., Zeger, S. L. (1986), Longitudinal data analysis using generalized linear models,
Biometrika 73(1), eq. (6).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from analysis.fleet.channels import Channel, Series
from analysis.fleet.resistance import KindResistance
from analysis.fleet.unlike import Finding, UnlikeTrains
from trainlog.arrays import FloatArray, IntArray, robust_std
from trainlog.display import counted

MONTH = 30.4375
"""Days of a month."""

YEAR = 12.0
"""Months of a year."""

SHORTEST_TREND = 1.0
"""Months that trips must span for a trend."""

SHORTEST_SEASON = 10.0
"""Months that trips must span for a season of the year beside a trend."""

FEWEST_WEEKS = 5
"""Fewer weeks with trips than this show no trend."""

HUBER = 1.345
"""Deviations beyond so many standard deviations count less."""

DRIFTING = ("size of the curve", "constant resistance", "speed scale", "effort gain", "speed noise")
"""Channels that are looked at."""


@dataclass(frozen=True, kw_only=True)
class Drift:
    """What a channel does over months.

    Attributes
    ----------
    train, kind : str
        The train is empty for the whole kind.
    channel, unit : str
    trend_a_month, trend_std : float
        NaN where the trips do not show it.
    band_factor : float
        Standard deviations that make the 95 % band.
    season, season_std : float
        Half of the difference between the extremes of the year; NaN where it is not shown.
    highest_month : int or None
        Of the year, 1 to 12; None where it is not known.
    months : float
        That the trips span.
    steps : tuple of Timestamp
        At which the channel jumps; the trend is that between them.
    reason : str
        What is not shown, and why.
    """

    train: str
    kind: str
    channel: str
    unit: str
    trend_a_month: float = np.nan
    trend_std: float = np.nan
    band_factor: float = np.nan
    season: float = np.nan
    season_std: float = np.nan
    highest_month: int | None = None
    months: float
    steps: tuple[pd.Timestamp, ...]
    reason: str

    @property
    def band(self) -> tuple[float, float]:
        """Lower and upper end of the trend's 95 % band, a month."""
        reach = self.band_factor * self.trend_std
        return self.trend_a_month - reach, self.trend_a_month + reach

    @property
    def drifts(self) -> bool:
        """Whether the band of the trend leaves out zero."""
        low, high = self.band
        return low > 0.0 or high < 0.0

    def __str__(self) -> str:
        whose = self.train or f"kind {self.kind}"
        if not np.isfinite(self.trend_a_month):
            return f"{whose}: {self.channel}: {self.reason}"
        factor, unit = {"1": (100.0, "%"), "N": (1.0, "N"), "s": (1e3, "ms")}[self.unit]
        reach = self.band_factor * self.trend_std
        words = f"{factor * self.trend_a_month:+.3g} ± {factor * reach:.2g} {unit} a month"
        if np.isfinite(self.season):
            words += f", ± {factor * self.season:.2g} {unit} over the year"
        return f"{whose}: {self.channel} {words}" + (f" ({self.reason})" if self.reason else "")


def drift_of(kind: KindResistance, trips: pd.DataFrame, unlike: UnlikeTrains) -> list[Drift]:
    """Trends of each train against its kind, and of the kind with its season.

    Parameters
    ----------
    kind : KindResistance
    trips : DataFrame
        Of the kind, in order of start.
    unlike : UnlikeTrains
        Whose series are looked at, and whose findings are steps.
    """
    every = unlike.series.get(kind.kind, {})
    days = (trips["start"] - trips["start"].min()) / pd.Timedelta(days=1)
    found = []
    for name in DRIFTING:
        series = every.get(name)
        if series is None:
            continue
        when = days.to_numpy(np.float64)[series.rows]
        if series.common:
            jumps = [each for each in unlike.findings if each.kind == kind.kind]
            found.append(_of_kind(kind.kind, series, trips, when, jumps))
        names = trips["train"].to_numpy(str)[series.rows]
        for train in np.unique(names).tolist():
            mine = names == train
            steps = [each for each in unlike.findings if each.train == train]
            value = series.own if series.common else series.value
            found.append(
                _trend(
                    train,
                    kind.kind,
                    series.channel,
                    when[mine],
                    value[mine],
                    series.std[mine],
                    steps,
                    trips["start"].min(),
                    season=not series.common,
                )
            )
    return found


def _of_kind(
    kind: str, series: Series, trips: pd.DataFrame, when: FloatArray, jumps: list[Finding]
) -> Drift:
    """The kind's trend and season: of its trips less each train's own level."""
    names = trips["train"].to_numpy(str)[series.rows]
    # A train that jumped says nothing of its kind from then on.
    start = trips["start"].iloc[series.rows]
    sound = np.ones(names.size, dtype=bool)
    for each in jumps:
        sound &= ~((names == each.train) & (start >= each.since).to_numpy())
    value = pd.Series(series.value[sound])
    centred = value - value.groupby(names[sound]).transform("median")
    return _trend(
        "",
        kind,
        series.channel,
        when[sound],
        centred.to_numpy(),
        series.std[sound],
        [],
        trips["start"].min(),
        season=True,
    )


def _trend(
    train: str,
    kind: str,
    channel: Channel,
    when: FloatArray,
    value: FloatArray,
    std: FloatArray,
    steps: Iterable[Finding],
    first: pd.Timestamp,
    *,
    season: bool,
) -> Drift:
    """Slope, steps and season of a channel by Huber's regression; see the module."""
    months = when / MONTH
    span = float(np.ptp(months)) if when.size else 0.0
    weeks = np.unique(np.floor(when / 7.0), return_inverse=True)[1]
    count = int(weeks.max()) + 1 if when.size else 0
    own = [each for each in steps if each.against == "own past"]
    at = [when for each in own for when in (each.since, each.until) if when is not None]
    jumps = np.array([(each - first) / pd.Timedelta(days=1) for each in at])
    columns = [np.ones(when.size), months]
    columns += [(when >= jump).astype(np.float64) for jump in jumps if (when >= jump).any()]
    seasonal = season and span >= SHORTEST_SEASON
    if seasonal:
        angle = 2.0 * np.pi * months / YEAR
        columns += [np.sin(angle), np.cos(angle)]
    about: dict[str, Any] = {"train": train, "kind": kind, "months": span, "steps": tuple(at)}
    about |= {"channel": channel.name, "unit": channel.unit}
    reason = ""
    if span < SHORTEST_TREND or count < max(FEWEST_WEEKS, len(columns) + 2):
        reason = f"{counted(round(span * MONTH), 'day')} in {counted(count, 'week')} show no trend"
        return Drift(**about, reason=reason)
    if season and not seasonal:
        reason = f"{span:.1f} months do not separate a season from a trend"
    beta, covariance = _regressed(np.column_stack(columns), value, std, weeks)
    if seasonal:
        sine, cosine = float(beta[-2]), float(beta[-1])
        amplitude = float(np.hypot(sine, cosine))
        along = np.array([sine, cosine]) / max(amplitude, 1e-300)
        peak = first + pd.Timedelta(days=float(np.arctan2(sine, cosine) / (2 * np.pi) * 365.25))
        about |= {"season": amplitude, "highest_month": int(peak.month)}
        about["season_std"] = float(np.sqrt(along @ covariance[-2:, -2:] @ along))
    return Drift(
        **about,
        trend_a_month=float(beta[1]),
        trend_std=float(np.sqrt(covariance[1, 1])),
        band_factor=float(stdtrit(max(count - len(columns), 1), 0.975)),
        reason=reason,
    )


def _regressed(
    design: FloatArray, value: FloatArray, std: FloatArray, cluster: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Coefficients and their cluster-robust covariance; Liang and Zeger (1986), eq. (6)."""
    weight = std**-2.0
    for _ in range(20):
        turned = design.T * weight
        bread = np.linalg.pinv(turned @ design)
        beta = bread @ (turned @ value)
        rest = (value - design @ beta) / std
        size = max(robust_std(rest), 1e-12)
        weight = std**-2.0 * np.minimum(1.0, HUBER * size / np.maximum(np.abs(rest), 1e-12))
    scores = design * (weight * (value - design @ beta))[:, None]
    count = int(cluster.max()) + 1
    sums = np.zeros((count, design.shape[1]))
    np.add.at(sums, cluster, scores)
    small = count / max(count - design.shape[1], 1)
    return beta, small * bread @ (sums.T @ sums) @ bread
