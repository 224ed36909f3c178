"""From recorded trips, and summaries of earlier ones, to the observed parameter set."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pandas as pd

from analysis.resistance.combination import (
    SAME_DRIVE,
    SOFTWARE,
    CommonFit,
    combine,
    each_drive_once,
    summarised,
)
from analysis.resistance.curve import CURVE_COLUMNS, HEAD_WIND, RESISTANCE_COLUMN, STATED_AT
from analysis.resistance.fit import COLUMNS, TOPICS, TripFit, check_speeds, fit_trip
from analysis.resistance.observed import COVER, LISTED, check_choice, parameter_set
from analysis.resistance.recording import TripRefusedError
from analysis.resistance.regression import diagnosed
from analysis.view import Given, TripView, each_given, views_of
from trainlog.display import counted, few, span
from trainlog.errors import LogError, NotIdentifiableError, TrainlogError
from trainlog.formats.files import sha256, sha256_of
from trainlog.formats.railway import train_of
from trainlog.formats.summaries import SUFFIX, merged, read_summaries
from trainlog.presentation import Presented, Said, WordTable, new_table
from trainlog.railway.network import unused
from trainlog.railway.resistance import LARGEST_STD
from trainlog.railway.train import ParameterSet
from trainlog.trip import Trip
from trainlog.units import KMH

UNVARIED = frozenset({"not recorded", "contradiction", "gap"})
"""Reasons for which trips are refused however long and varied they are."""

LITTLE = frozenset({"condition", "excitation"})
"""Reasons of trips that show a part of the curve, such as those at one speed."""

NOT_ALONE = "alone too little is known of the curve; it is that of all trips together"
"""Of a trip that is accepted with others."""


class AllRefusedError(NotIdentifiableError):
    """No trip determines the curve.

    Attributes
    ----------
    refused : dict of str to TripRefusedError
        Why, by trip, of the logs that were read now.
    """

    def __init__(
        self,
        problem: str,
        *,
        remedy: str | None = None,
        refused: dict[str, TripRefusedError],
    ) -> None:
        super().__init__(problem, remedy=remedy)
        self.refused = refused


@dataclass(frozen=True, eq=False, repr=False)
class Fits(Presented):
    """What a set of trips shows of a train's running resistance.

    Attributes
    ----------
    trips : tuple of TripFit
        Fitted now and accepted, by name; not those whose summaries were known.
    refused : dict of str to TripRefusedError
        Trips fitted now that do not determine the curve, and why.
    known : int
        Logs that were not read because a summary of theirs was given.
    summaries : DataFrame
        All trips, fitted now or known; see `trainlog.formats.summaries`.
    drives : DataFrame
        The same with each drive once; see `analysis.resistance.combination.each_drive_once`.
    common : CommonFit
    parameters : ParameterSet
        The observed configurations, ready to be written.
    """

    charts_by: ClassVar[str] = "analysis.resistance.plot:fits_charts"

    trips: tuple[TripFit, ...]
    refused: dict[str, TripRefusedError]
    known: int
    summaries: pd.DataFrame
    drives: pd.DataFrame
    common: CommonFit
    parameters: ParameterSet

    @property
    def title(self) -> str:
        """Train, and how many trips determine its resistance."""
        accepted, again = len(self.common.trips), len(self.same)
        return (
            f"Running resistance of {self.common.train}: {counted(accepted, 'trip')} accepted,"
            f" {len(self.drives) - accepted - again} refused"
            + (f", {again} of drives that are counted" if again else "")
        )

    @property
    def same(self) -> tuple[str, ...]:
        """The trips that are not used because another of the same drive is, in words."""
        return tuple(self.drives["message"][self.drives["refused"] == SAME_DRIVE])

    def summary(self) -> dict[str, str]:
        """What all trips show together."""
        common, found = self.common, self.parameters
        mass = self.summaries["mass"].dropna().to_numpy(np.float64)
        rows = {
            "together": common.words,
            "mass": f"{span(mass, 1e-3, 1)} t",
            "supported": f"{span(common.speed_range, KMH)} km/h",
            "observed set": f"{counted(len(found.configurations), 'configuration')},"
            f" coverage {found.cover['level']:.1%} of trips like these",
        }
        reasons = [f"{trip} ({error.reason})" for trip, error in self.refused.items()]
        if reasons:
            rows["refused"] = few(reasons, 4)
        return rows

    def tables(self) -> list[WordTable]:
        """Running resistance of each trip and of all together."""
        title = f"Running resistance of {self.common.train}: N, N/(m/s), N/(m/s)²"
        table = new_table(title, *COLUMNS, name="trips").add_rows(self.trips)
        table.add_section()
        empty = Said(None, "")
        # A fit of summaries alone does not know how many windows each trip had.
        windows = sum(fit.windows["used"] for fit in self.trips) if self.trips else empty
        curve = [each.cell(self.common) for each in (*CURVE_COLUMNS, RESISTANCE_COLUMN)]
        table.add_cells("together", *curve[:-1], empty, empty, curve[-1], windows)
        return [table]

    @property
    def notes(self) -> list[str]:
        """What the table rests on, in sentences."""
        low, high = self.common.speed_range
        ends = " to ".join(f"{each / 1e3:.4g}" for each in self.common.band(STATED_AT))
        words = [
            "± is 1.96 standard deviations of the value beside it. The 95 % band of the whole curve"
            f" (all trips together) is wider: {ends} kN at {STATED_AT * KMH:.0f} km/h. Supported"
            f" from {low * KMH:.0f} to {high * KMH:.0f} km/h. The single coefficients are strongly"
            " correlated: trust the curve. A power is given where a trip reached it.",
        ]
        windless = sum(not fit.wind_recorded for fit in self.trips)
        if windless:
            wind, r2 = round(1.96 * HEAD_WIND), self.common.resistance.r2
            more = r2 * wind * (2.0 * STATED_AT + wind) / float(self.common.resistance(STATED_AT))
            words.append(
                f"No wind is recorded on {counted(windless, 'trip')}: the curve is that of the air"
                f" of these days. A head wind of {wind} m/s would be {more:.0%} of it at"
                f" {STATED_AT * KMH:.0f} km/h; record it, or fit trips of several days."
            )
        words += [
            f"{fit.trip}: tunnels add {fit.tunnels.words}; the curve is that of open track."
            for fit in self.trips
            if fit.tunnels is not None
        ]
        of: dict[str, list[str]] = {}
        for fit in self.trips:
            for doubt in (*diagnosed(fit.residuals).doubts, *fit.notes):
                of.setdefault(doubt, []).append(fit.trip)
        words += [f"{', '.join(trips)}: {doubt}" for doubt, trips in of.items()]
        words += [f"refused, {error.reason}: {error}" for error in self.refused.values()]
        words += [f"counted once: {sentence}" for sentence in self.same]
        used = self.drives[self.drives["refused"] == ""]
        unknown = used["trip"][(used["identity"] == "") & used.duplicated("trip", keep=False)]
        words += [
            f"trip '{name}': of one log of that name the drive is not known (summary of an older"
            " version); if it is that of the other, fit from the logs"
            for name in sorted(set(unknown))
        ]
        words += _observed_set(self)
        words += [f"{self.parameters.assumed_power}."] * bool(self.parameters.assumed_power)
        return words


@dataclass(eq=False)
class _Read:
    """What was read of the trips and summaries given."""

    earlier: list[pd.DataFrame] = field(default_factory=list)
    held: set[str] = field(default_factory=set)
    known: int = 0
    rows: list[pd.DataFrame] = field(default_factory=list)
    little: dict[int, tuple[str, TripFit]] = field(default_factory=dict)
    trips: list[TripFit] = field(default_factory=list)
    refused: dict[str, TripRefusedError] = field(default_factory=dict)

    def add(self, given: Trip | TripView | Path, speeds: tuple[float, float] | None) -> None:
        """Fit a trip or a log, or keep a file of summaries."""
        path = given if isinstance(given, Path) else None
        if path is not None and path.suffix == SUFFIX:
            self.earlier.append(read_summaries(path))
            self.held |= set(self.earlier[-1]["sha256"]) - {""}
            return
        digest = "" if path is None else sha256_of(path)
        if digest in self.held:
            self.known += 1
            return
        for view in views_of(given, TOPICS):
            digests = {view.name: digest}
            try:
                one = fit_trip(view, speeds)
            except TripRefusedError as error:
                name = unused(view.name, set(self.refused))
                self.refused[name] = error
                refused, trains = {view.name: error}, {view.name: _train_name(view.trip)}
                if error.fit is not None and error.reason in LITTLE:
                    self.little[len(self.rows)] = name, error.fit
                self.rows.append(summarised([], refused, trains=trains, digests=digests))
            else:
                self.trips.append(one)
                self.rows.append(summarised([one], digests=digests))
        if digest:
            self.held.add(digest)

    @property
    def summaries(self) -> pd.DataFrame:
        """Of all trips."""
        return merged([*self.earlier, summarised([]), *self.rows])

    def join(self) -> None:
        """Accept trips none of which determines the curve, where all of them together do."""
        alone, joined = self.rows, list(self.rows)
        for number, (_, one) in self.little.items():
            joined[number] = summarised([one]).assign(sha256=alone[number]["sha256"])
        self.rows = joined
        try:
            common = combine(each_drive_once(self.summaries))
        except TrainlogError:
            self.rows = alone
            return
        speed = np.linspace(*common.asked, 61)
        if np.any(common.std(speed) > LARGEST_STD * common.resistance(speed)):
            self.rows = alone
            return
        for name, one in self.little.values():
            self.trips.append(replace(one, notes=(*one.notes, NOT_ALONE)))
            del self.refused[name]


def fit(
    trips: Given | Iterable[Given],
    speeds: tuple[float, float] | None = None,
    *,
    cover: float = COVER,
    most: int | None = None,
) -> Fits:
    """Fit running resistance and mass to each trip, then to all of them together.

    Parameters
    ----------
    trips : Trip, path, or iterable of them
        Of one train: trips at hand, logs, folders of logs, and files of summaries of earlier fits
        (``.parquet``). Logs are read one after the other, one too long for the memory as several
        trips (`analysis.view`); one that summaries given before it hold is not read, but for its
        SHA-256. Trips of one drive are used once (`trainlog.identity`).
    speeds : (float, float) [m/s], optional
        Speeds between which the curve is asked for; see `fit_trip`.
    cover : float
        Share of trips whose running times and energies the observed set is to bound, as a
        fraction above 0 and below 1.
    most : int, optional
        At most so many configurations in the set, 1 or more.

    Returns
    -------
    Fits

    Raises
    ------
    AllRefusedError
        If no trip determines the curve; it holds why each does not.
    NotIdentifiableError
        If no log was given.
    LogError
        If a file is not a log, or a trip lacks its line or its train.
    InputError
        If the trips are of different trains, a file of summaries is none, or `speeds`, `cover` or
        `most` is out of its range.

    Examples
    --------
    >>> fits = fit("sample_logs/nonstop.mcap")
    >>> [one.trip for one in fits.trips]
    ['trip-01']
    >>> bool(abs(fits.common.resistance(25.0) / 12e3 - 1.0) < 0.2)
    True
    """
    check_speeds(speeds)
    check_choice(cover, most)
    read = _Read()
    for given in each_given(trips):
        read.add(given, speeds)
    summaries = read.summaries
    if summaries.empty:
        raise NotIdentifiableError(
            "the summaries that were given have no trip" if read.earlier else "no log was given",
            remedy="give logs, folders of logs, or summaries of earlier fits",
        )
    if len(read.little) > 1 and not (summaries["refused"] == "").any():
        read.join()
        summaries = read.summaries
    if not (summaries["refused"] == "").any():
        first = summaries["message"].iloc[0]
        others = len(summaries) - 1
        varied = not set(summaries["refused"]) <= UNVARIED
        raise AllRefusedError(
            f"no trip determines the running resistance; {first}"
            + (f"; nor do{'es' * (others == 1)} {counted(others, 'other')}" if others else ""),
            remedy="give longer or more varied trips; 'trainlog fit --per-trip FOLDER' draws why"
            " each was refused"
            if varied
            else None,
            refused=read.refused,
        )
    drives = each_drive_once(summaries)
    common = combine(drives)
    parameters = parameter_set(drives, cover=cover, most=most, common=common)
    return Fits(
        trips=tuple(sorted(read.trips, key=lambda one: (one.trip, one.identity))),
        refused=read.refused,
        known=read.known,
        summaries=summaries,
        drives=drives,
        common=common,
        parameters=replace(parameters, provenance=_provenance(summaries)),
    )


def _provenance(summaries: pd.DataFrame) -> dict[str, object]:
    """What was fitted; of very many trips one digest over those of all logs."""
    digests = summaries["sha256"].tolist()
    names = [str(name) for name in summaries["trip"]]
    step: dict[str, object] = {"step": "fit", "software": SOFTWARE}
    if len(names) <= LISTED and len(set(names)) == len(names):
        return step | {"inputs": dict(zip(names, digests, strict=True))}
    together = sha256("\n".join(sorted(digests)).encode())
    return step | {"inputs": {"trips": len(names), "sha256 of sorted sha256": together}}


def _train_name(trip: Trip) -> str:
    try:
        return train_of(trip).name
    except LogError:
        return trip.metadata.get("train", "")


def _observed_set(fits: Fits) -> list[str]:
    """What the observed set stands for."""
    found = fits.parameters
    count = len(found.configurations)
    words = (
        f"{counted(count, 'configuration')} stand{'s' * (count == 1)} for"
        f" {counted(found.cover['trips'], 'trip')}: coverage {found.cover['level']:.1%} of trips"
        " like these"
    )
    if found.cover["level"] < found.cover["asked"]:
        words += f"; {found.cover['asked']:.1%} needs more trips"
    if not fits.known:
        return [f"{words}."]
    were = (
        "was not read: its summary is" if fits.known == 1 else "were not read: their summaries are"
    )
    return [f"{words}.", f"{counted(fits.known, 'log')} {were} known."]
