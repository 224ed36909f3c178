"""Many trips together: what they have in common, how they differ, and the best estimate of each.

Trips differ: wind, weather, the train itself. Of a trip its summary is needed (`summarised`), not
its log: a million trips are a million rows, in any order. Each trip's parameters are a draw from a
normal distribution around the mean, seen with that trip's own covariance (`random_effects`):

    single_i ~ N(mean, between),    value_i ~ N(single_i, variance_i).

`between` is found by restricted maximum likelihood with a weak prior, by expectation maximisation
in sums over the trips; its steps, which shrink geometrically, are extrapolated.

A line is surveyed once (`shared_variance`). Trips over the same line in the same direction meet the
same errors of its gradients, and their mean keeps them, however many trips there are. How alike
they are from trip to trip depends on how each was driven; they are taken for wholly alike in one
direction, and for independent between directions, though there they cancel in part: the band of
the mean is rather too wide than too narrow. Of trips on routes in a network the errors of each edge
are shared by all that ran over it, with the edge's share of the route's length. The gain of a
recorder's efforts, where no recorded load shows it, is taken for the same on all trips.

References
----------
Laird, N. M., Ware, J. H. (1982), Random-effects models for longitudinal data, Biometrics 38(4),
eqs. (3.2)-(3.6).
Varadhan, R., Roland, C. (2008), Simple and globally convergent methods for accelerating the
convergence of any EM algorithm, Scandinavian Journal of Statistics 35(2), scheme S3.
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
    powers,
)
from analysis.resistance.fit import TripFit
from analysis.resistance.recording import TripRefusedError
from trainlog import __version__
from trainlog.arrays import FloatArray, IntArray
from trainlog.display import counted, span
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.formats.summaries import (
    COLUMNS,
    COVARIANCE,
    PARAMETERS,
    SURVEY,
    age,
    covariances_of,
    frame_of,
    ordered,
    parameters_of,
    surveys_of,
)
from trainlog.identity import Known, identity_from_text, overlapping, same_drives
from trainlog.presentation import Presented, WordTable, new_table
from trainlog.railway.resistance import RunningResistance
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
    rows = [_row(fit) for fit in fits]
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


def _row(fit: TripFit) -> dict[str, object]:
    upper = fit.covariance[np.triu_indices(4)].tolist()
    survey = fit.survey[:3, :3][np.triu_indices(3)].tolist()
    number: dict[str, float | None] = {
        "freedom": fit.freedom,
        "rotating_mass": fit.rotating_mass,
        "train_power": fit.train_power,
        "asked_lowest": fit.asked[0],
        "asked_highest": fit.asked[1],
        "speed_lowest": fit.speed_range[0],
        "speed_highest": fit.speed_range[1],
        "condition": fit.condition,
        "windows": fit.windows["used"],
        "outliers": fit.windows["outlier"],
        "delay": fit.nuisance["delay"],
        "brake_scale": fit.nuisance["brake_scale"],
        "cluster_factor": fit.cluster_factor,
        "residual_std": fit.residual_std,
        "residual_correlation": fit.residual_correlation,
        "speed_scale": fit.scale.factor,
        "speed_scale_std": fit.scale.std,
    }
    if fit.passport is not None:
        number["effort_gain"] = fit.passport.effort_gain.value
        if fit.passport.effort_gain.source == "assumed":
            number["assumed_gain_std"] = fit.gain_std
    if fit.max_power is not None:
        number |= {"max_power": fit.max_power, "max_power_std": fit.max_power_std}
    return {
        "trip": fit.trip,
        "train": fit.train,
        "refused": "",
        "message": "",
        "speed_scale_source": fit.scale.source,
        "gradients": fit.gradients,
        "identity": fit.identity,
        **dict(zip(PARAMETERS, [*fit.beta.tolist(), fit.mass], strict=True)),
        **dict(zip(COVARIANCE, upper, strict=True)),
        **dict(zip(SURVEY, survey, strict=True)),
        **number,
        **{f"noise_{cause}": size for cause, size in fit.noise.items()},
        **{f"masked_{reason}": time for reason, time in fit.masked.items()},
    }


ROUNDS = 200
"""Most rounds of the expectation maximisation, each three steps."""

TOLERANCE = 1e-9
"""Relative change of the variance between trips in a step that ends the search."""

_BLOCK = 8192
"""Trips whose sums are made at once."""


@dataclass(frozen=True, eq=False)
class Effects:
    """What trips have in common, and each of them.

    Attributes
    ----------
    mean : (3,) array
    variance : (3, 3) array
        Of the mean.
    between : (3, 3) array
        Of one trip around the mean.
    single, single_variance : (k, 3), (k, 3, 3) array
        Each trip drawn towards the mean by as much as its own variance warrants.
    """

    mean: FloatArray
    variance: FloatArray
    between: FloatArray
    single: FloatArray
    single_variance: FloatArray


def random_effects(
    values: FloatArray, variances: FloatArray, expected: FloatArray, prior_trips: float
) -> Effects:
    """Mean of trips that differ, and the best estimate of each.

    Parameters
    ----------
    values : (k, 3) array
        Of about the same size in every column; sums go over the trips as they stand.
    variances : (k, 3, 3) array
    expected : (3, 3) array
        Variance between trips that is expected beforehand.
    prior_trips : float
        This expectation counts as much as so many trips.
    """
    # Sums about the middle of the values: what trips have in common would cancel digits.
    middle = values.mean(axis=0)
    trips = _Trips((values - middle).T, variances[:, *_TRIANGLE].T, expected, prior_trips)
    between = expected.copy()
    for _ in range(ROUNDS):
        first = trips.step(between)
        second = trips.step(first)
        if np.max(np.abs(second - first)) <= TOLERANCE * np.max(np.abs(first)):
            between = second
            break
        change, bend = first - between, second - 2.0 * first + between
        length = -float(np.linalg.norm(change) / max(float(np.linalg.norm(bend)), 1e-300))
        leap = between - 2.0 * length * change + length**2 * bend
        # A leap that leaves the covariances is not made.
        sound = np.all(np.linalg.eigvalsh(leap) > 1e-6 * np.linalg.eigvalsh(second)[0])
        between = trips.step(leap) if sound else second
    mean, variance, _, _ = trips.mean(between)
    single, single_variance = trips.single(between, mean, variance)
    return Effects(mean + middle, variance, between, single + middle, single_variance)


_TRIANGLE = np.triu_indices(3)
_FULL = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Where the entries of a symmetric matrix stand in its upper triangle, row by row."""


@dataclass(frozen=True, eq=False, slots=True)
class _Trips:
    """Values (3, k) of the trips, upper triangles (6, k) of their variances, and the prior.

    The weight of a trip is the inverse of its variance and that between trips. All that a step of
    the expectation maximisation needs are the sums over the trips of the weights and of the
    weighted values, and of the products of these nine.
    """

    values: FloatArray
    variances: FloatArray
    expected: FloatArray
    prior_trips: float

    def weights(self, between: FloatArray, part: slice = slice(None)) -> FloatArray:
        """Upper triangles (6, n) of the weights, by cofactors."""
        a, b, c, d, e, f = self.variances[:, part] + between[_TRIANGLE][:, None]
        found = np.stack(
            [
                d * f - e * e,
                c * e - b * f,
                b * e - c * d,
                a * f - c * c,
                b * c - a * e,
                a * d - b * b,
            ]
        )
        found /= a * found[0] + b * found[1] + c * found[2]
        return found

    def mean(self, between: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Mean (3,) of the trips, its variance (3, 3), sums (9,) and products (9, 9)."""
        sums, products = np.zeros(9), np.zeros((9, 9))
        # In blocks that stay in the processor's cache.
        for first in range(0, self.values.shape[1], _BLOCK):
            part = slice(first, first + _BLOCK)
            weights = self.weights(between, part)
            weighted = np.einsum("ijk,jk->ik", weights[_FULL], self.values[:, part])
            rows = np.concatenate([weights, weighted])
            sums += rows.sum(axis=1)
            products += rows @ rows.T
        variance = np.linalg.inv(sums[:6][_FULL])
        variance = 0.5 * (variance + variance.T)
        return variance @ sums[6:], variance, sums, products

    def step(self, between: FloatArray) -> FloatArray:
        """One step of the expectation maximisation; Laird and Ware (1982), eq. (3.4).

        With w the weight of a trip and d its value less the mean, the expected square of its
        distance from the mean is ``between + between s between`` where
        ``s = w d d' w - w + w variance w``.
        """
        mean, variance, sums, products = self.mean(between)
        weights = products[:6, :6][_FULL[:, :, None, None], _FULL]
        crossed = products[6:, :6][:, _FULL] @ mean
        s = products[6:, 6:] - crossed - crossed.T - sums[:6][_FULL]
        s += np.einsum("ijlm,jl->im", weights, variance + np.outer(mean, mean))
        count = self.values.shape[1]
        total = count * between + between @ s @ between
        total = 0.5 * (total + total.T) + self.prior_trips * self.expected
        return np.asarray(total / (count + self.prior_trips))

    def single(
        self, between: FloatArray, mean: FloatArray, variance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Each trip drawn towards the mean, and its variance; Laird and Ware (1982), eq. (3.2)."""
        gain = between @ self.weights(between)[_FULL].transpose(2, 0, 1)
        rest = np.eye(3) - gain
        single = mean + (gain @ (self.values.T - mean)[:, :, None])[:, :, 0]
        found = between - gain @ between + rest @ variance @ rest.transpose(0, 2, 1)
        return single, 0.5 * (found + found.transpose(0, 2, 1))


def shared_variance(weights: FloatArray, survey: FloatArray, line: IntArray) -> FloatArray:
    """What shared errors add to the variance of a weighted mean, (3, 3).

    With e_i = D_i u_l, where D_i D_i' is the part of trip i's variance that its line l brings in,
    and u_l is common to the trips over l: the sum over pairs of different trips of
    ``W_i D_i D_j' W_j'``.

    Parameters
    ----------
    weights : (k, 3, 3) array
        Of each trip in the mean; they sum up to one.
    survey : (k, 3, 3) array
        Of each trip's variance the part that errors of its line bring in.
    line : (k,) int array
        Number of the line and direction that the trip ran over.
    """
    values, vectors = np.linalg.eigh(survey)
    lengths = np.sqrt(np.maximum(values, 0.0))
    # The symmetric root: of two trips that differ, the errors are as alike as they can be.
    effect = weights @ ((vectors * lengths[:, None, :]) @ vectors.transpose(0, 2, 1))
    order = np.argsort(line, kind="stable")
    first = np.flatnonzero(np.diff(line[order], prepend=-1))
    together = np.add.reduceat(effect[order], first, axis=0)
    return np.asarray(
        np.einsum("kij,klj->il", together, together) - np.einsum("kij,klj->il", effect, effect)
    )


BETWEEN_TRIPS = 0.05
"""How much trips are expected to differ from each other, over the curve."""

PRIOR_TRIPS = 2.0
"""This expectation counts as much as so many trips beside the observed ones."""


@dataclass(frozen=True, eq=False, repr=False)
class CommonFit(DragCurve, Presented):
    """All trips together.

    Attributes
    ----------
    train : str
    resistance : RunningResistance
        Mean of the trips.
    covariance : (3, 3) array
        Of the mean's r0, r1, r2, with what errors of lines bring in that trips share.
    between : (3, 3) array
        Covariance of one trip's r0, r1, r2 around the mean.
    freedom : int
    asked, speed_range : (float, float) [m/s]
        Speeds that every trip was asked for, and that the trips cover together.
    trips : tuple of str
        In the order of `betas`.
    betas, covariances : (k, 3), (k, 3, 3) array
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
        return [
            new_table(self.title, *CURVE_COLUMNS, RESISTANCE_COLUMN, name="together").add_rows(
                [self]
            )
        ]

    def spread(self, speed: ArrayLike) -> FloatArray:
        """Standard deviation of one trip's curve around the mean [N] at each speed [m/s]."""
        return curve_std(self.between, speed)


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
        If the trips belong to different trains, or one of which the drive is not known appears
        twice.

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
    expected = BETWEEN_TRIPS**2 * np.eye(3)
    found = random_effects(values, variances, expected, PRIOR_TRIPS)
    weights = found.variance @ np.linalg.inv(variances + found.between)
    trip, line, share = surveyed_shares(rows)
    survey = share[:, None, None] * curves.survey[trip]
    shared = shared_variance(weights[trip], survey, line)
    back = np.linalg.inv(curves.nodes)
    gain = float(np.mean(gain_std)) * found.mean
    covariance = back @ (found.variance + shared + np.outer(gain, gain)) @ back.T
    return CommonFit(
        train=str(rows["train"].iloc[0]),
        resistance=nearest_physical(back @ found.mean, covariance),
        covariance=covariance,
        between=back @ found.between @ back.T,
        freedom=len(rows) - 1 + int(PRIOR_TRIPS),
        asked=(float(rows["asked_lowest"].max()), curves.top),
        speed_range=(float(rows["speed_lowest"].min()), float(rows["speed_highest"].max())),
        trips=tuple(rows["trip"]),
        betas=found.single @ back.T,
        covariances=back @ found.single_variance @ back.T,
    )


@dataclass(frozen=True, eq=False)
class NodeCurves:
    """Curves of trips by their values at three speeds, over the median of all trips there.

    They are far better conditioned than the coefficients.

    Attributes
    ----------
    top : float [m/s]
        Highest speed that every trip was asked for: that of the last node.
    nodes : (3, 3) array
        Of coefficients to values.
    values : (k, 3) array
    variances : (k, 3, 3) array
        Without that of an assumed gain: all trips of a recorder err alike, and do not differ by it.
    survey : (k, 3, 3) array
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
    nodes = powers(np.linspace(0.0, top, 3))
    values = parameters_of(rows)[:, :3] @ nodes.T
    size = np.median(values, axis=0)
    nodes, values = nodes / size[:, None], values / size
    variances = nodes @ covariances_of(rows)[:, :3, :3] @ nodes.T
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
