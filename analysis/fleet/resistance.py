"""Running resistance of every train of a fleet, and of each kind of train.

Trains of a kind are alike, but not the same; a train's trips differ, too, by wind and weather, of
which those of one period share a part; trips over one line share the errors of its survey, and
those of a recorder of which no load shows the gain share that. All of it is one linear mixed model
of the trips' summaries (`estimators.mixed`): a train with many trips has its own curve, one
with few is drawn towards its kind, and one without any has the kind's, as wide as trains differ.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from analysis.resistance.combination import (
    BETWEEN_TRIPS,
    PRIOR_TRIPS,
    SAME_DRIVE,
    NodeCurves,
    each_drive_once,
    node_curves,
    symmetric_root,
)
from analysis.resistance.curve import (
    CONFIDENCE,
    CURVE_COLUMNS,
    RESISTANCE_COLUMN,
    DragCurve,
    curve_std,
    nearest_physical,
)
from estimators.mixed import TAIL, Group, MixedEffects, mixed_effects, of_eigenvalues
from trainlog.arrays import FloatArray, IntArray
from trainlog.display import counted
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.formats.summaries import check_fitted
from trainlog.presentation import NUMBER, Column, Presented, WordTable, new_table
from trainlog.railway.resistance import RunningResistance
from trainlog.units import KMH

BETWEEN_TRAINS = 0.04
"""How much trains of a kind are expected to differ from each other, over the curve."""

PRIOR_TRAINS = 3.0
"""This expectation counts as much as so many trains beside the observed ones."""

BETWEEN_PERIODS = 0.02
"""How much one day is expected to differ from another, over the curve."""

PRIOR_PERIODS = 3.0
"""This expectation counts as so many days."""

MOST_PERIODS = 90
"""Where the trips are spread over more days than this, periods are of several days each."""

EMPTY_MASS_STD = 0.005
"""Standard deviation of a train's true empty mass over that of its file: all efforts, and so the
whole curve, are in its measure, and a train's trips share it."""

FEWEST_ON_LINE = 3
"""Fewer trips than this over a line do not show what they have in common."""

MOST_LINES = 60
"""What trips have in common is looked for on the lines that are run over most, at most so many."""

FEWEST_TRAINS = 4
"""Of fewer trains than this, what a day does to all cannot be distinguished from what one does."""

FEWEST_COMPARED = 3
"""Of fewer trains of a kind none can be called unlike the others: two lie equally far from their
mean, whichever of them is at fault."""


def curve_table(curves: Iterable[TrainResistance], title: str) -> WordTable:
    """A row per curve."""
    return new_table(
        title,
        Column("train", of=lambda one: one.train or "all"),
        Column("kind"),
        Column("trips", NUMBER),
        *CURVE_COLUMNS,
        RESISTANCE_COLUMN,
        name="trains",
    ).add_rows(curves)


@dataclass(frozen=True, eq=False, repr=False)
class TrainResistance(DragCurve, Presented):
    """A curve with its uncertainty: of a train, or of a kind of train.

    Attributes
    ----------
    train, kind : str
        The train is empty for the curve of a kind.
    trips : int
        That determine it.
    resistance : RunningResistance
    covariance : (3, 3) array
        Of its coefficients.
    freedom : float
        Degrees of freedom of the covariance.
    asked : (float, float) [m/s]
        Speeds between which all trips of the kind were asked for it.
    """

    train: str
    kind: str
    trips: int
    resistance: RunningResistance
    covariance: FloatArray
    freedom: float
    asked: tuple[float, float]

    @property
    def title(self) -> str:
        """Train or kind, and number of trips."""
        whose = f"train {self.train}" if self.train else f"a {self.kind}"
        return f"Running resistance of {whose} on {counted(self.trips, 'trip')}"

    def summary(self) -> dict[str, str]:
        """The curve."""
        return {"curve": self.words}

    def tables(self) -> list[WordTable]:
        """The row of the curve."""
        return [curve_table([self], self.title)]

    def reach(self, speed: ArrayLike) -> FloatArray:
        """Half width [N] of the 95 % band at each single speed [m/s]: of a Student distribution."""
        return float(stdtrit(self.freedom, 0.5 + 0.5 * CONFIDENCE)) * self.std(speed)

    def band_at(self, speed: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Lower and upper end [N] of the 95 % band at each single speed; never below zero."""
        value, reach = self.resistance(speed), self.reach(speed)
        return np.maximum(value - reach, 0.0), value + reach


@dataclass(frozen=True, eq=False, repr=False)
class KindResistance(Presented):
    """The trains of one kind.

    Attributes
    ----------
    kind : str
    mean : TrainResistance
        What they have in common; its covariance is that of the mean.
    another : TrainResistance
        What is expected of a train of this kind without trips.
    trains : tuple of TrainResistance
        In the order of their names.
    between, within : (3, 3) array
        Scale of trains around the mean, and of a train's trips around it, of the coefficients; of
        Student distributions of `TAIL` degrees of freedom.
    rows : DataFrame
        The summaries that were used.
    curves : NodeCurves
        Of these rows.
    effects : MixedEffects
        Of trains, periods, lines and gains.
    """

    kind: str
    mean: TrainResistance
    another: TrainResistance
    trains: tuple[TrainResistance, ...]
    between: FloatArray
    within: FloatArray
    rows: pd.DataFrame
    curves: NodeCurves
    effects: MixedEffects

    @property
    def title(self) -> str:
        """Number of trains, and their kind."""
        return f"{counted(len(self.trains), 'train')} of kind {self.kind}"

    def summary(self) -> dict[str, str]:
        """The mean, and how trains differ."""
        top = self.mean.asked[1]
        spread = float(curve_std(self.between, top)) / 1e3
        return {
            "mean": self.mean.words,
            "between trains": f"{spread:.2f} kN at {KMH * top:.0f} km/h",
        }

    def tables(self) -> list[WordTable]:
        """A row for the mean and each train."""
        return [curve_table([self.mean, *self.trains], self.title)]

    @property
    def compared(self) -> bool:
        """Whether its trains suffice to call one unlike the others."""
        return int(self.rows["train"].nunique()) >= FEWEST_COMPARED

    def __getitem__(self, train: str) -> TrainResistance:
        """The curve of a train; of one without trips what is expected of it."""
        return next((one for one in self.trains if one.train == train), self.another)


@dataclass(frozen=True, eq=False, repr=False)
class FleetResistance(Presented):
    """Running resistance of a fleet.

    Attributes
    ----------
    kinds : tuple of KindResistance
        In the order of their names.
    refused : DataFrame
        Trips that show nothing, with ``refused`` and ``message``.
    """

    kinds: tuple[KindResistance, ...]
    refused: pd.DataFrame

    @property
    def title(self) -> str:
        """What it is."""
        return "Running resistance of a fleet"

    def summary(self) -> dict[str, str]:
        """The mean of each kind."""
        return {
            each.kind: f"{counted(len(each.trains), 'train')},"
            f" {counted(each.mean.trips, 'trip')}; {each.mean.words}"
            for each in self.kinds
        }

    def tables(self) -> list[WordTable]:
        """A row for the mean of each kind."""
        return [curve_table([each.mean for each in self.kinds], self.title)]

    def __iter__(self) -> Iterator[KindResistance]:
        return iter(self.kinds)

    def __getitem__(self, kind: str) -> KindResistance:
        for each in self.kinds:
            if each.kind == kind:
                return each
        known = ", ".join(each.kind for each in self.kinds)
        raise InputError(f"no trips of kind '{kind}'", remedy=f"known are: {known}")


def fleet_resistance(table: pd.DataFrame) -> FleetResistance:
    """Running resistance of each train and of each kind.

    Parameters
    ----------
    table : DataFrame
        Summaries of trips (`trainlog.formats.summaries.COLUMNS`) with the columns ``kind`` and
        ``start``, as `Catalogue.results` gives them. Without ``kind`` a train is its own kind,
        without ``start`` no period is distinguished.

    Returns
    -------
    FleetResistance

    Raises
    ------
    NotIdentifiableError
        If no trip determines a curve.

    Examples
    --------
    >>> from analysis.resistance.combination import summarised
    >>> from analysis.resistance.fit import fit_trip
    >>> fits = [fit_trip(f"sample_logs/{name}.mcap") for name in ("nonstop", "stopping")]
    >>> found = fleet_resistance(summarised(fits).assign(kind="FLIRT"))
    >>> one = found["FLIRT"].trains[0]
    >>> one.trips, bool(one.std(25.0) < found["FLIRT"]["another train"].std(25.0))
    (2, True)
    """
    return resistance_of_drives(drives_of(table))


def resistance_of_drives(rows: pd.DataFrame) -> FleetResistance:
    """The same of rows that `drives_of` made."""
    used = rows[rows["refused"] == ""]
    if used.empty:
        raise NotIdentifiableError(
            "no trip determines the running resistance", remedy="give more, or more varied, trips"
        )
    check_fitted(used)
    kinds = tuple(
        _kind_resistance(str(kind), group.reset_index(drop=True))
        for kind, group in used.groupby("kind", sort=True)
    )
    return FleetResistance(kinds, rows[rows["refused"] != ""].reset_index(drop=True))


def drives_of(table: pd.DataFrame) -> pd.DataFrame:
    """Summaries with kind and start, each drive once, in order of start."""
    given = table.copy()
    if "kind" not in given:
        given["kind"] = given["train"]
    given["kind"] = given["kind"].where(given["kind"].fillna("") != "", given["train"])
    if "start" not in given:
        given["start"] = pd.NaT
    given["start"] = pd.to_datetime(given["start"], utc=True)
    pieces = [each_drive_once(group) for _, group in given.groupby("train", sort=True)]
    rows = pd.concat(pieces, ignore_index=True) if pieces else given
    rows = rows[rows["refused"] != SAME_DRIVE]
    return rows.sort_values(["start", "train", "trip"], kind="stable", ignore_index=True)


def periods_of(start: pd.Series) -> tuple[IntArray, int]:
    """Number of the period of each trip (-1: not known), and how many there are."""
    number, known = np.full(len(start), -1, dtype=np.int64), start.notna().to_numpy()
    if not known.any():
        return number, 0
    days = (start[known] - start.min().floor("D")) // pd.Timedelta(days=1)
    number[known] = (days // np.ceil((days.max() + 1) / MOST_PERIODS)).to_numpy(np.int64)
    return number, int(number.max()) + 1


def ways_of(rows: pd.DataFrame) -> IntArray:
    """Number of the line as travelled of each trip; -1 where too few others ran over it."""
    way = rows["gradients"].fillna("").astype(str)
    counts = way[way != ""].value_counts()
    counts = counts[counts >= FEWEST_ON_LINE].sort_index().nlargest(MOST_LINES)
    return np.asarray(pd.Index(counts.index).get_indexer(pd.Index(way)), dtype=np.int64)


def _kind_resistance(kind: str, rows: pd.DataFrame) -> KindResistance:
    """Trains of one kind; Henderson (1975)."""
    curves = node_curves(rows)
    names, train = np.unique(rows["train"].to_numpy(str), return_inverse=True)
    number, periods = periods_of(rows["start"])
    if names.size < FEWEST_TRAINS:
        number, periods = np.full(len(rows), -1), 0
    found = _effects(curves, rows, train, names.size, number, periods)
    back = np.linalg.inv(curves.nodes)
    asked = (float(rows["asked_lowest"].max()), curves.top)

    def curve(
        name: str, trips: int, value: FloatArray, covariance: FloatArray, freedom: float
    ) -> TrainResistance:
        beta, turned = back @ value, back @ covariance @ back.T
        turned = 0.5 * (turned + turned.T)
        resistance = nearest_physical(beta, turned)
        return TrainResistance(name, kind, trips, resistance, turned, freedom, asked)

    own = np.bincount(train, minlength=names.size)
    freedom = names.size - 1 + PRIOR_TRAINS
    spread_freedom = min(freedom, TAIL)
    trains = []
    for place, name in enumerate(names.tolist()):
        value, covariance = found.of(0, place)
        trips = int(own[place])
        # What rests on how trains differ is known no better than a train without trips.
        shared = found.rests_on(0, place)
        inverse = shared**2 / spread_freedom + (1.0 - shared) ** 2 / (trips - 1 + freedom)
        trains.append(curve(name, trips, value, covariance, 1.0 / inverse))
    every = len(rows)
    mean = curve("", every, found.mean, found.block(0, 0), freedom)
    spread = found.block(0, 0) + found.spreads[0]
    another = curve("", 0, found.mean, spread, spread_freedom)
    return KindResistance(
        kind=kind,
        mean=mean,
        another=another,
        trains=tuple(trains),
        between=back @ found.spreads[0] @ back.T,
        within=back @ found.within @ back.T,
        rows=rows,
        curves=curves,
        effects=found,
    )


def _effects(
    curves: NodeCurves,
    rows: pd.DataFrame,
    train: IntArray,
    trains: int,
    period: IntArray,
    periods: int,
) -> MixedEffects:
    """The mixed model of the curves: trains, periods, lines, gains."""
    one = np.eye(3)
    roots = symmetric_root(curves.survey)
    line = ways_of(rows)
    # Errors of a line that no other trip shows stay with the trip.
    shared = np.where((line >= 0)[:, None, None], curves.survey, 0.0)
    # By the train's curve: by each trip's own, the gain would explain the trips' noise.
    typical = pd.DataFrame(curves.values).groupby(train).transform("median").to_numpy()
    gains = np.zeros((len(rows), 3, 3))
    gains[:, :, 0] = np.hypot(curves.gain_std, EMPTY_MASS_STD)[:, None] * typical
    groups = (
        Group(train, trains, None, BETWEEN_TRAINS**2 * one, PRIOR_TRAINS, heavy=True),
        Group(period, periods, None, BETWEEN_PERIODS**2 * one, PRIOR_PERIODS),
        Group(line, int(line.max(initial=-1)) + 1, roots, one),
        Group(train, trains, gains, one),
    )
    variances = positive(curves.variances - shared)
    within = BETWEEN_TRIPS**2 * one
    return mixed_effects(curves.values, variances, groups, within, PRIOR_TRIPS)


def positive(variances: FloatArray) -> FloatArray:
    """The covariances with no eigenvalue below a hundredth of the largest on the diagonal."""
    return of_eigenvalues(
        variances, lambda values: np.maximum(values, 1e-4 * np.maximum(values[:, -1:], 1e-12))
    )
