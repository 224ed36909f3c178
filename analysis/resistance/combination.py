"""Many trips together: what they have in common, how they differ, and the best estimate of each.

Trips differ: wind, weather, the train itself. Of a trip its summary is needed (`summarised`), not
its log: a million trips are a million rows, in any order. Each trip's parameters are a draw from a
normal distribution around the mean, seen with that trip's own covariance:

    single_i ~ N(mean, between),    value_i ~ N(single_i, variance_i),

a mixed model without groups (`estimators.mixed`); `between` is found by restricted maximum
likelihood with a weak prior.

A line is surveyed once (`shared_variance`). Trips over the same line in the same direction meet the
same errors of its gradients, and their mean keeps them, however many trips there are. How alike
they are from trip to trip depends on how each was driven; they are taken for wholly alike in one
direction, and for independent between directions, though there they cancel in part: the band of
the mean is rather too wide than too narrow. Of trips on routes in a network the errors of each edge
are shared by all that ran over it, with the edge's share of the route's length. The gain of a
recorder's efforts, where no recorded load shows it, is taken for the same on all trips.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from analysis.resistance.curve import (
    CURVE_COLUMNS,
    RESISTANCE_COLUMN,
    DragCurve,
    curve_std,
    nearest_physical,
)
from analysis.resistance.fit import TripFit
from analysis.resistance.recording import TripRefusedError
from estimators.mixed import MixedEffects, mixed_effects, of_eigenvalues
from trainlog import __version__
from trainlog.arrays import FloatArray, IntArray
from trainlog.display import counted, span
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.formats.summaries import (
    COLUMNS,
    age,
    check_fitted,
    covariances_of,
    frame_of,
    ordered,
    parameters_of,
    surveys_of,
)
from trainlog.identity import Known, identity_from_text, overlapping, same_drives
from trainlog.presentation import Presented, WordTable, new_table
from trainlog.railway.resistance import TERMS, RunningResistance, basis
from trainlog.units import KMH

SOFTWARE = f"trainlog {__version__}"


def summarised(
    fits: Sequence[TripFit],
    refused: Mapping[str, TripRefusedError] | None = None,
    *,
    trains: Mapping[str, str] | None = None,
    digests: Mapping[str, str] | None = None,
) -> pd.DataFrame:
    """Summaries of trips that were fitted, and of those that were refused.

    Parameters
    ----------
    fits : sequence of TripFit
    refused : mapping of trip to TripRefusedError, optional
    trains : mapping of trip to name of the train, optional
        Of the refused trips.
    digests : mapping of trip to SHA-256, optional
        Of their logs; empty where there is none.

    Returns
    -------
    DataFrame
        With the columns of `trainlog.formats.summaries.COLUMNS`, in the order of trip.
    """
    known = digests or {}
    rows: list[dict[str, object]] = [
        {column.name: value for column in COLUMNS if (value := column.value(fit)) is not None}
        for fit in fits
    ]
    rows += [
        {
            "trip": trip,
            "train": (trains or {}).get(trip, ""),
            "refused": error.reason,
            "message": str(error),
        }
        for trip, error in (refused or {}).items()
    ]
    for row in rows:
        row |= {"sha256": known.get(str(row["trip"]), ""), "software": SOFTWARE}
    return ordered(frame_of(COLUMNS, rows))


def shared_variance(weights: FloatArray, survey: FloatArray, line: IntArray) -> FloatArray:
    """What shared errors add to the variance of a weighted mean, (p, p).

    With e_i = D_i u_l, where D_i D_i' is the part of trip i's variance that its line l brings in,
    and u_l is common to the trips over l: the sum over pairs of different trips of
    ``W_i D_i D_j' W_j'``.

    Parameters
    ----------
    weights : (k, p, p) array
        Of each trip in the mean; they sum up to one.
    survey : (k, p, p) array
        Of each trip's variance the part that errors of its line bring in.
    line : (k,) int array
        Number of the line and direction that the trip ran over.
    """
    # The symmetric root: of two trips that differ, the errors are as alike as they can be.
    effect = weights @ symmetric_root(survey)
    order = np.argsort(line, kind="stable")
    first = np.flatnonzero(np.diff(line[order], prepend=-1))
    together = np.add.reduceat(effect[order], first, axis=0)
    return np.asarray(
        np.einsum("kij,klj->il", together, together) - np.einsum("kij,klj->il", effect, effect)
    )


def symmetric_root(covariances: FloatArray) -> FloatArray:
    """Symmetric roots (k, p, p) of covariances (k, p, p)."""
    return of_eigenvalues(covariances, lambda values: np.sqrt(np.maximum(values, 0.0)))


BETWEEN_TRIPS = 0.05
"""How much trips are expected to differ from each other, over the curve."""

PRIOR_TRIPS = 2.0
"""This expectation counts as much as so many trips beside the observed ones."""

TOLERANCE = 1e-9
"""Relative change of the variance between trips in a step that ends the search for it."""


@dataclass(frozen=True, eq=False, repr=False)
class CommonFit(DragCurve, Presented):
    """All trips together.

    Attributes
    ----------
    train : str
    resistance : RunningResistance
        Mean of the trips.
    covariance : (p, p) array
        Of the mean's r0, r1, r2, with what errors of lines bring in that trips share.
    between : (p, p) array
        Covariance of one trip's r0, r1, r2 around the mean.
    freedom : int
    asked, speed_range : (float, float) [m/s]
        Speeds that every trip was asked for, and that the trips cover together.
    trips : tuple of str
        In the order of `betas`.
    betas, covariances : (k, p), (k, p, p) array
        Each trip's curve, drawn towards the mean as its own covariance warrants.
    """

    train: str
    resistance: RunningResistance
    covariance: FloatArray
    between: FloatArray
    freedom: int
    asked: tuple[float, float]
    speed_range: tuple[float, float]
    trips: tuple[str, ...]
    betas: FloatArray
    covariances: FloatArray

    @property
    def title(self) -> str:
        """Train, and number of trips."""
        return f"Running resistance of {self.train} on {counted(len(self.trips), 'trip')}"

    def summary(self) -> dict[str, str]:
        """Curve, and how trips differ."""
        top = self.asked[1]
        return {
            "curve": self.words,
            "between trips": f"{float(self.spread(top)) / 1e3:.2f} kN at {KMH * top:.0f} km/h",
            "speeds": f"{span(self.speed_range, KMH)} km/h",
        }

    def tables(self) -> list[WordTable]:
        """The row of the curve."""
        table = new_table(self.title, *CURVE_COLUMNS, RESISTANCE_COLUMN, name="together")
        return [table.add_rows([self])]

    def spread(self, speed: ArrayLike) -> FloatArray:
        """Standard deviation of one trip's curve around the mean [N] at each speed [m/s]."""
        return curve_std(self.between, speed)


def pooled(values: FloatArray, variances: FloatArray) -> MixedEffects:
    """Mean of trips that differ, and the best estimate of each.

    Parameters
    ----------
    values : (k, d) array
        Over their usual size.
    variances : (k, d, d) array
    """
    expected = BETWEEN_TRIPS**2 * np.eye(values.shape[1])
    return mixed_effects(
        values, variances, (), expected, PRIOR_TRIPS, tail=np.inf, tolerance=TOLERANCE
    )


def nodes_over(speeds: FloatArray, betas: FloatArray) -> FloatArray:
    """From coefficients to values at speeds [m/s], (p, p), over the median of curves (k, p) there.

    They are far better conditioned than the coefficients.
    """
    nodes = basis(speeds)
    return np.asarray(nodes / np.abs(np.median(betas @ nodes.T, axis=0))[:, None])


def combine(trips: pd.DataFrame | Sequence[TripFit]) -> CommonFit:
    """Combine several trips of one train.

    Parameters
    ----------
    trips : DataFrame of summaries, or sequence of TripFit
        In any order; the result is the same to the last bit. Refused trips are left aside, and
        of several trips of one drive the fullest is used (`each_drive_once`).

    Raises
    ------
    NotIdentifiableError
        If there is no trip that determines the curve.
    InputError
        If the trips belong to different trains, one of which the drive is not known appears
        twice, or one has numbers that no fit gives.

    Examples
    --------
    >>> import trainlog
    >>> from analysis.resistance.fit import fit_trip
    >>> common = combine([fit_trip(trainlog.read("sample_logs/nonstop.mcap"))])
    >>> common.trips, bool(abs(common.resistance(25.0) / 12e3 - 1.0) < 0.2)
    (('trip-01',), True)
    """
    rows = accepted(trips)
    curves = node_curves(rows)
    values, variances, gain_std = curves.values, curves.variances, curves.gain_std
    found = pooled(values, variances)
    variance = found.block(0, 0)
    weights = variance @ np.linalg.inv(variances + found.within)
    trip, line, share = surveyed_shares(rows)
    survey = share[:, None, None] * curves.survey[trip]
    shared = shared_variance(weights[trip], survey, line)
    back = np.linalg.inv(curves.nodes)
    gain = float(np.mean(gain_std)) * found.mean
    covariance = back @ (variance + shared + np.outer(gain, gain)) @ back.T
    single, single_variance = found.single()
    return CommonFit(
        train=str(rows["train"].iloc[0]),
        resistance=nearest_physical(back @ found.mean, covariance),
        covariance=covariance,
        between=back @ found.within @ back.T,
        freedom=len(rows) - 1 + int(PRIOR_TRIPS),
        asked=(float(rows["asked_lowest"].max()), curves.top),
        speed_range=(float(rows["speed_lowest"].min()), float(rows["speed_highest"].max())),
        trips=tuple(rows["trip"]),
        betas=single @ back.T,
        covariances=back @ single_variance @ back.T,
    )


WIDE = 0.2
"""Relative standard deviation at the highest speed from which on a trip shows a part of the curve
alone."""


@dataclass(frozen=True, eq=False)
class NodeCurves:
    """Curves of trips by their values at a few speeds, over the median of all trips there.

    Attributes
    ----------
    top : float [m/s]
        Highest speed that every trip was asked for: that of the last node.
    nodes : (p, p) array
        Of coefficients to values.
    values : (k, p) array
    variances : (k, p, p) array
        Without that of an assumed gain: all trips of a recorder err alike, and do not differ by it.
    survey : (k, p, p) array
        The part of it that errors of the line bring in.
    gain_std : (k,) array
        Of an assumed gain; 0 where it was found.
    """

    top: float
    nodes: FloatArray
    values: FloatArray
    variances: FloatArray
    survey: FloatArray
    gain_std: FloatArray


def node_curves(rows: pd.DataFrame) -> NodeCurves:
    """Curves of trips that were accepted, by their values at three speeds."""
    top = float(rows["asked_highest"].min())
    betas, covariances = parameters_of(rows)[:, :-1], covariances_of(rows)[:, :-1, :-1]
    usual, at = betas, basis(top)
    if np.any(np.sqrt(at @ covariances @ at) > WIDE * np.abs(betas @ at)):
        # Of trips that show a part of the curve each the weighted mean is all that is known.
        weights = np.linalg.inv(covariances)
        usual = np.linalg.solve(weights.sum(0), np.einsum("kij,kj->i", weights, betas))[None]
    nodes = nodes_over(np.linspace(0.0, top, len(TERMS)), usual)
    values = betas @ nodes.T
    variances = nodes @ covariances @ nodes.T
    gain_std = np.nan_to_num(rows["assumed_gain_std"].to_numpy(np.float64))
    variances -= gain_std[:, None, None] ** 2 * values[:, :, None] * values[:, None, :]
    survey = nodes @ surveys_of(rows) @ nodes.T
    return NodeCurves(top, nodes, values, variances, survey, gain_std)


def surveyed_shares(rows: pd.DataFrame) -> tuple[IntArray, IntArray, FloatArray]:
    """Over which lines trips ran: number of the trip, of line and direction, and its share.

    A trip on a route has a row for each edge, by how much of the route it is; other trips have
    one. Trips of which the line is not known share none.
    """
    codes, texts = pd.factorize(rows["gradients"])
    known: dict[str, int] = {}
    parts: list[tuple[list[int], list[float]]] = []
    for text in texts:
        shares = json.loads(text) if text.startswith("{") else {text: 1.0}
        lines = [known.setdefault(key, len(known)) for key in shares]
        parts.append((lines, [float(share) for share in shares.values()]))
    count = np.array([len(lines) for lines, _ in parts], dtype=np.int64)[codes]
    trip = np.repeat(np.arange(len(rows), dtype=np.int64), count)
    line = np.concatenate([np.array(parts[code][0], dtype=np.int64) for code in codes])
    share = np.concatenate([np.array(parts[code][1]) for code in codes])
    unknown = (rows["gradients"].to_numpy() == "")[trip]
    return trip, np.where(unknown, len(known) + trip, line), share


def accepted(trips: pd.DataFrame | Sequence[TripFit]) -> pd.DataFrame:
    """Summaries of the drives that determine the curve, in order; errors as `combine`."""
    every = trips if isinstance(trips, pd.DataFrame) else summarised(trips)
    return checked(each_drive_once(every))


def checked(every: pd.DataFrame) -> pd.DataFrame:
    """Of summaries in order those that are not refused; errors as `combine`."""
    rows = every[every["refused"] == ""].reset_index(drop=True)
    check_fitted(rows)
    if rows.empty:
        raise NotIdentifiableError(
            "no trip determines the running resistance", remedy="give more, or more varied, trips"
        )
    trains = sorted(rows["train"].unique())
    if len(trains) > 1:
        raise InputError(
            f"trips of different trains: {', '.join(trains)}", remedy="fit each train apart"
        )
    again = rows.duplicated(["trip", "sha256", "identity"])
    if again.any():
        twice = rows["trip"][again].iloc[0]
        raise InputError(f"trip '{twice}' is given twice", remedy="give each trip once")
    return rows


SAME_DRIVE = "same drive"
"""Why a trip is refused of whose drive a fuller recording is there."""


DIFFERENT_MASS = 0.01
"""Two recordings of one drive whose masses differ by more than this were given different loads."""


def each_drive_once(summaries: pd.DataFrame) -> pd.DataFrame:
    """Summaries in which all trips of one drive but the fullest are refused.

    Of recordings that are equally full that of the later software is used, then the first by
    SHA-256. Trips whose identity is not known are left as they are.

    Parameters
    ----------
    summaries : DataFrame
        In any order.

    Returns
    -------
    DataFrame
        In order, the trips of drives that others stand for refused as `SAME_DRIVE`.

    Examples
    --------
    >>> from analysis.resistance.fit import fit_trip
    >>> fit = fit_trip("sample_logs/nonstop.mcap")
    >>> each_drive_once(summarised([fit, fit]))["refused"].tolist()
    ['', 'same drive']
    """
    rows = ordered(summaries)
    usable = np.flatnonzero((rows["refused"] == "") & (rows["identity"] != ""))
    usable = usable[overlapping(rows["identity"].iloc[usable].tolist())]
    some = rows.iloc[usable]
    known = [
        Known(trip, identity_from_text(text), (-int(version), digest, trip, text), digest=digest)
        for trip, text, version, digest in zip(
            some["trip"], some["identity"], age(rows).iloc[usable], some["sha256"], strict=True
        )
    ]
    for same in same_drives(known):
        mass, other = (some["mass"].iloc[number] for number in (same.number, same.other))
        words = same.sentence
        if same.share >= 1.0 and abs(mass - other) > DIFFERENT_MASS * other:
            words += (
                f"; its mass was fitted as {mass / 1e3:.1f} t, that of the other as"
                f" {other / 1e3:.1f} t: the loads that were given differ, and one is wrong"
            )
        rows.loc[usable[same.number], ["refused", "message"]] = (SAME_DRIVE, words)
    return rows
