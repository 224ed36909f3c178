"""What a fleet shows of its trains: resistance, drift, and trains that are not like the others.

Drift is what changes slowly, in a train and in all trains of a kind. Wheels wear, so that the
recorded speed rises over the true one; dirt and cold add to the running resistance. Of a train the
trend is that of its channels less what its kind shows; of a kind that of its trips, with a season
of the year once the trips span enough of it. A step that was found (`analysis.fleet.unlike`) is a
step, and not a part of a trend. A trend is the slope of a robust regression on time. Neighbouring
trips err together: its variance is that of the sums over weeks, each week counted as one.

References
----------
Huber, P. J. (1964), Robust estimation of a location parameter, Annals of Mathematical Statistics
35(1).
Liang, K.-Y., Zeger, S. L. (1986), Longitudinal data analysis using generalized linear models,
Biometrika 73(1), eq. (6).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from analysis.fleet.channels import CHANNEL_UNITS
from analysis.fleet.resistance import (
    FEWEST_COMPARED,
    FleetResistance,
    KindResistance,
    TrainResistance,
    drives_of,
    resistance_of_drives,
)
from analysis.fleet.unlike import (
    FALSE_ALARMS,
    Finding,
    Limit,
    UnlikeTrains,
    months_of,
    unlike_trains,
)
from trainlog.arrays import FloatArray, IntArray, robust_std
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.presentation import (
    FORCE,
    NUMBER,
    SHARE,
    Band,
    Column,
    Presented,
    Said,
    WordTable,
    new_table,
)
from trainlog.units import KMH

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue

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
        names = trips["train"].to_numpy(str)[series.rows]
        value = series.own if series.common else series.value
        parts = [(train, names == train, value) for train in np.unique(names).tolist()]
        if series.common:
            jumps = [each for each in unlike.findings if each.kind == kind.kind]
            start = trips["start"].iloc[series.rows]
            # A train that jumped says nothing of its kind from then on; what is shown is each trip
            # less its train's own level.
            sound = np.ones(names.size, dtype=np.bool_)
            for jump in jumps:
                sound &= ~((names == jump.train) & (start >= jump.since).to_numpy())
            level = pd.Series(np.where(sound, series.value, np.nan))
            level -= level.groupby(names).transform("median")
            parts.insert(0, ("", sound, np.asarray(level, np.float64)))
        for train, rows, of in parts:
            steps = [each for each in unlike.findings if each.train == train]
            about = {"train": train, "kind": kind.kind, "channel": series.channel.name}
            seasonal = not (series.common and train)
            found.append(
                _trend(
                    about | {"unit": series.channel.unit}, when[rows], of[rows], series.std[rows],
                    steps, trips["start"].min(), season=seasonal,
                )
            )  # fmt: skip
    return found


def _trend(
    about: dict[str, Any],
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
    about |= {"months": span, "steps": tuple(at)}
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


# ------------------------------------------------------------------------------------------ drift


AT = 80.0 / KMH
"""Speed [m/s] at which trains are compared."""

NAMES = {
    "constant resistance": "dragging brake",
    "size of the curve": "running resistance",
    "effort gain": "effort gain, mass",
    "speed scale": "wheel diameter",
    "effort delay": "sensor delay",
    "speed noise": "speed noise",
}
"""Faults by the channel that shows them."""


@dataclass(frozen=True, eq=False, repr=False)
class FleetTrains(Presented):
    """What a fleet shows of its trains.

    Attributes
    ----------
    resistance : FleetResistance
    unlike : UnlikeTrains
    drift : tuple of Drift
        Of each train and kind, by channel.
    trips : dict of str to DataFrame
        Of each kind, summaries joined with passports.
    """

    resistance: FleetResistance
    unlike: UnlikeTrains
    drift: tuple[Drift, ...]
    trips: dict[str, pd.DataFrame]

    @property
    def title(self) -> str:
        """How many trains of how many kinds."""
        trains = sum(len(kind.trains) for kind in self.resistance)
        return f"Fleet of {counted(trains, 'train')}, {counted(len(self.resistance.kinds), 'kind')}"

    def summary(self) -> dict[str, str]:
        """The mean of each kind."""
        return self.resistance.summary()

    def tables(self) -> list[WordTable]:
        """Resistance of each train and its drift; what is unlike; what would not be seen."""
        return [self.trains_table(), self.findings_table(), self.limits_table()]

    def trains_table(self) -> WordTable:
        """Resistance of each train, and its drift."""
        rows = ((kind, one) for kind in self.resistance for one in (*kind.trains, kind.another))
        return new_table(
            "Trains of the fleet",
            Column("train", of=lambda row: row[1].train or f"another {row[1].kind}"),
            Column("kind", of=lambda row: row[1].kind),
            Column("trips", NUMBER, of=lambda row: row[1].trips),
            Column(
                "at 80 km/h",
                FORCE,
                key="resistance_at_80_km_h",
                band=True,
                of=lambda row: Band(float(row[1].resistance(AT)), _std(row[1])),
            ),
            Column("against its kind", SHARE, key="against_kind", band=True, of=_against_kind),
            Column(
                "drift a month",
                SHARE,
                band=True,
                of=lambda row: self._drift(row[1], "size of the curve"),
            ),
            Column(
                "wheels a month",
                SHARE,
                band=True,
                of=lambda row: self._drift(row[1], "speed scale"),
            ),
            Column(
                "findings",
                of=lambda row: ", ".join(
                    each.what for each in (self.of(row[1].train) if row[1].train else ())
                ),
            ),
            name="trains",
            caption="± half the 95 % band",
        ).add_rows(rows)

    def _drift(self, one: TrainResistance, channel: str) -> Band | None:
        for each in self.drift:
            if (each.train, each.kind, each.channel) == (one.train, one.kind, channel):
                known = np.isfinite(each.trend_a_month)
                std = each.band_factor / 1.96 * each.trend_std
                return Band(each.trend_a_month, std) if known else None
        return None

    def findings_table(self) -> WordTable:
        """Trains that are not like the others, or like themselves before."""
        unlike = self.unlike
        found = counted(len(unlike.findings), "finding")
        caption = f"A healthy train raises an alarm in at most {100.0 * unlike.rate:g} % of months."
        if not unlike.findings:
            caption += " None raised one; what would not be seen is listed by kind."
        for step in unlike.steps:
            caption += f"\n{step.train}: {step}, since {step.since:%Y-%m-%d %H:%M}"
        return new_table(
            f"{found} in {unlike.train_months:.1f} months of trains",
            Column("train"),
            Column("what", of=lambda each: str(each.explanation)),
            Column("since", of=lambda each: f"{each.since:%Y-%m-%d %H:%M}"),
            Column("until", of=lambda each: f"{each.until:%Y-%m-%d %H:%M}" if each.until else ""),
            Column("of its trips", SHARE, key="share", of="share"),
            Column("first trip", of="trip"),
            Column("seen within trips", NUMBER, of="trips"),
            Column("compared with", key="against"),
            Column("p", NUMBER, of=lambda each: Said(each.p, f"{each.p:.0e}")),
            name="findings",
            caption=caption,
        ).add_rows(unlike.findings)

    def limits_table(self) -> WordTable:
        """What would not be seen: of each kind, on the train on which least is seen."""
        table = new_table(
            "Smallest faults that are seen",
            Column("kind"),
            Column("fault"),
            Column("a change within five trips", key="change"),
            Column("from its first trip on", key="constant"),
            Column("not at all on", key="blind"),
            name="limits",
            caption="A fault of this size is seen in 9 of 10 cases, on the train of the kind that"
            " shows it least.",
        )
        for kind in self.resistance:
            names = {each.train for each in kind.trains}
            for channel, name in NAMES.items():
                limits = [
                    each
                    for each in self.unlike.limits
                    if each.train in names and each.channel == channel
                ]
                blind = [each for each in limits if not np.isfinite(each.change)]
                reason = f"{counted(len(blind), 'train')}: {blind[0].reason}" if blind else ""
                largest = (_limit(limits, which) for which in ("change", "constant"))
                table.add_cells(kind.kind, name, *largest, reason)
        return table

    def details(self) -> dict[str, Any]:
        """What was found, as a file holds it: numbers in SI units."""
        unlike = self.unlike
        return {
            "format": "trainlog/fleet-trains",
            "version": 1,
            "kinds": [
                {
                    "kind": kind.kind,
                    "mean": _curve(kind.mean),
                    "another": _curve(kind.another),
                    "compared": kind.compared,
                    "between_trains": kind.between,
                    "between_trips": kind.within,
                    "trains": [_curve(each) for each in kind.trains],
                }
                for kind in self.resistance
            ],
            "findings": [_finding(each) for each in unlike.findings],
            "false_alarms_per_train_and_month": unlike.rate,
            "train_months": unlike.train_months,
            "limits": unlike.limits,
            "steps": unlike.steps,
            "drift": self.drift,
        }

    @property
    def notes(self) -> list[str]:
        """Which kinds have too few trains."""
        return [self.too_few] if self.too_few else []

    @property
    def too_few(self) -> str:
        """That kinds have too few trains to compare them; empty where all have enough."""
        few = [
            f"{kind.kind} ({kind.rows['train'].nunique()})"
            for kind in self.resistance
            if not kind.compared
        ]
        if not few:
            return ""
        return (
            f"Too few trains of kind {', '.join(few)}: comparison with the kind is not possible, it"
            f" needs {FEWEST_COMPARED} trains. Each is compared with its own past alone; a fault"
            " that it had from its first trip on is not seen."
        )

    def of(self, train: str) -> tuple[Finding, ...]:
        """The findings of a train."""
        return tuple(each for each in self.unlike.findings if each.train == train)

    def only(self, train: str) -> FleetTrains:
        """What is shown of one train, compared with all others.

        Raises
        ------
        InputError
            If it has no trips.
        """
        every = [one.train for kind in self.resistance for one in kind.trains]
        if train not in every:
            raise InputError(
                f"no trips of train '{train}' determine its resistance",
                remedy=f"known are: {', '.join(every[:12])}",
            )
        kinds = tuple(
            replace(kind, trains=tuple(one for one in kind.trains if one.train == train))
            for kind in self.resistance
            if any(one.train == train for one in kind.trains)
        )
        names = {kind.kind for kind in kinds}
        unlike = replace(
            self.unlike,
            findings=self.of(train),
            limits=tuple(each for each in self.unlike.limits if each.train == train),
            steps=tuple(each for each in self.unlike.steps if each.train == train),
            train_months=sum(
                months_of(rows["start"][rows["train"] == train])
                for rows in self.trips.values()
                if (rows["train"] == train).any()
            ),
        )
        drift = tuple(
            each for each in self.drift if each.kind in names and each.train in ("", train)
        )
        return replace(
            self, resistance=replace(self.resistance, kinds=kinds), unlike=unlike, drift=drift
        )


def _std(one: TrainResistance) -> float:
    """The band of a Student distribution, as the standard deviation of which a table shows 1.96."""
    return float(one.reach(AT)) / 1.96


def _against_kind(row: tuple[KindResistance, TrainResistance]) -> Band | None:
    kind, one = row
    mean = float(kind.mean.resistance(AT))
    apart = float(one.resistance(AT)) / mean - 1.0 if one.train else 0.0
    return Band(apart, _std(one) / mean) if kind.compared else None


def _limit(limits: Sequence[Limit], which: str) -> str:
    known = [size for each in limits if np.isfinite(size := getattr(each, which))]
    if not known:
        return "-"
    factor, unit = CHANNEL_UNITS[limits[0].unit]
    return f"{factor * max(known):.{2 if unit == 's' else 1}f} {unit}"


def _curve(curve: TrainResistance) -> dict[str, Any]:
    rest = {name: getattr(curve, name) for name in ("covariance", "freedom", "asked")}
    return {"train": curve.train, "trips": curve.trips, **asdict(curve.resistance), **rest}


def _finding(each: Finding) -> dict[str, Any]:
    found, said = asdict(each), each.explanation
    del found["explanation"]
    about = {"train": each.train, "kind": each.kind, "what": each.what, "explained": said.explained}
    return about | {"causes": [said.cause, *said.others]} | found


def fleet_trains(
    summaries: pd.DataFrame,
    passports: pd.DataFrame | None = None,
    rate: float = FALSE_ALARMS,
) -> FleetTrains:
    """What a fleet shows of its trains.

    Parameters
    ----------
    summaries : DataFrame
        `Catalogue.results("resistance")`: of `trainlog.formats.summaries.COLUMNS`, with ``kind``,
        ``line``, ``direction`` and ``start``.
    passports : DataFrame, optional
        `Catalogue.results("passport")`; without it gain, delay and load are those of the summaries,
        and what they do not hold is not looked at.
    rate : float
        Probability of an alarm on a healthy train within a month, at most.

    Raises
    ------
    NotIdentifiableError
        If no trip determines a curve.
    """
    rows = joined(summaries, passports)
    resistance = resistance_of_drives(rows)
    kinds = [(kind, trips_of(kind, rows)) for kind in resistance]
    unlike = unlike_trains(kinds, rate)
    drift = tuple(one for kind, trips in kinds for one in drift_of(kind, trips, unlike))
    return FleetTrains(resistance, unlike, drift, {kind.kind: trips for kind, trips in kinds})


def trains_in(
    catalogue: Catalogue,
    *,
    kind: str | None = None,
    where: str | None = None,
    rate: float = FALSE_ALARMS,
) -> FleetTrains:
    """What the stored results of a catalogue show of its trains.

    Parameters
    ----------
    catalogue : Catalogue
        Of which `trainlog fleet update` has computed resistance and passport.
    kind : str, optional
        Only trains of this kind.
    where : str, optional
        Only trips of which this holds; see `Catalogue.query`.
    rate : float
        See `fleet_trains`.

    Raises
    ------
    InputError
        If nothing was computed yet.
    NotIdentifiableError
        If no trip determines a curve.
    """
    summaries = catalogue.results("resistance", where=where)
    if summaries.empty:
        raise InputError(
            "no running resistance of these trips is stored",
            remedy="run 'trainlog fleet update', or ask for other trips",
        )
    trips = catalogue.query(where)[["key", "train", "kind"]].drop_duplicates("key")
    # The train is the vehicle that the log names, not the file that describes its kind.
    own = [name for name in ("train", "kind") if name in summaries]
    rows = summaries.drop(columns=own).merge(trips, on="key", how="inner")
    if kind is not None:
        rows = rows[rows["kind"] == kind]
        if rows.empty:
            known = ", ".join(sorted(set(trips["kind"].dropna())))
            raise InputError(f"no trips of kind '{kind}'", remedy=f"known are: {known}")
    return fleet_trains(rows, catalogue.results("passport", where=where), rate)


def joined(summaries: pd.DataFrame, passports: pd.DataFrame | None) -> pd.DataFrame:
    """Summaries with the columns of passports that they lack, each drive once, by start."""
    rows = summaries
    if passports is not None and not passports.empty:
        by = "key" if "key" in rows and "key" in passports else "sha256"
        new = [name for name in passports if name not in rows or name == by]
        wanted = passports[new].drop_duplicates(by)
        rows = rows.merge(wanted, on=by, how="left", validate="many_to_one")
    return drives_of(rows)


def trips_of(kind: KindResistance, rows: pd.DataFrame) -> pd.DataFrame:
    """All trips of a kind, also those that determine no curve, in order of start."""
    return rows[rows["kind"] == kind.kind].reset_index(drop=True)
