"""What a fleet shows of its trains: resistance, drift, and trains that are not like the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from analysis.fleet.drift import Drift, drift_of
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
                largest = (
                    _limit(limits, [getattr(each, which) for each in limits])
                    for which in ("change", "constant")
                )
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


def _limit(limits: Sequence[Limit], sizes: Sequence[float]) -> str:
    known = [size for size in sizes if np.isfinite(size)]
    if not known:
        return "-"
    size, unit = max(known), limits[0].unit
    if unit == "N":
        return f"{size / 1e3:.1f} kN"
    return f"{size:.2f} s" if unit == "s" else f"{100.0 * size:.1f} %"


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
