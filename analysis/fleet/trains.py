"""What a fleet shows of its trains: resistance, drift, and trains that are not like the others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import pandas as pd

from analysis.fleet.drift import Drift, drift_of
from analysis.fleet.resistance import (
    FEWEST_COMPARED,
    FleetResistance,
    KindResistance,
    drives_of,
    fleet_resistance,
)
from analysis.fleet.unlike import (
    FALSE_ALARMS,
    Finding,
    UnlikeTrains,
    months_of,
    unlike_trains,
)
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.presentation import Presented, WordTable

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue


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
        from analysis.fleet.trains_table import findings_table, limits_table, trains_table

        return [trains_table(self), findings_table(self), limits_table(self)]

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
    resistance = fleet_resistance(rows)
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
