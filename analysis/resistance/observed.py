"""The observed parameter set: few configurations that bound what all trips can cost.

A robust trajectory is computed for the configurations of a set; what it promises holds for every
trip whose running time and energy the set bounds. In the equation of motion, divided by the
inertia M = mass + rotating mass,

    dv/dt = u / M - R(v) / M - g i mass / M,        u v <= p_max,

a configuration is its features ``(1/M, R(v1)/M, R(v2)/M, R(v3)/M, p_max)``: to first order every
running time and every energy is a linear function of them. The set is chosen so that, whichever
linear function it is, the largest over the set is at least as large as that of a stated share of
the trips. If trips come in no particular order, the next trip exceeds the k-th largest of n with
probability ``1 - k/(n+1)``: the share is stated as k/(n+1), the same for trips not yet seen. A
dozen trips cannot promise 95 % of the next ones; then all are kept, and the level states what they
can.

A trip's best estimate is drawn towards the common curve, so that estimates differ less than the
trips do. Before the extremes are looked for they are spread out to the variance that the trips
were found to have.

References
----------
Agarwal, P. K., Har-Peled, S., Varadarajan, K. R. (2004), Approximating extent measures of points,
Journal of the ACM 51(4): few points that have nearly the extent of all, in every direction.
Louis, T. A. (1984), Estimating a population of parameter values using Bayes and empirical Bayes
methods, Journal of the American Statistical Association 79(386): estimates with the right spread.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pandas as pd

from analysis.resistance.combination import CommonFit, checked, combine, each_drive_once, summarised
from analysis.resistance.curve import nearest_physical
from analysis.resistance.fit import TripFit
from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.formats.files import sha256
from trainlog.formats.summaries import COVARIANCE, PARAMETERS, SURVEY, covariances_of, parameters_of
from trainlog.railway.resistance import basis
from trainlog.railway.train import POWER_OF_FILE, Configuration, ParameterSet

COVER = 0.95
"""Share of trips that the set bounds unless the caller says otherwise."""

DIRECTIONS = 1024
"""Linear functions of the features that the set is chosen for; as many others judge it."""

CANDIDATES = 20_000
"""Most trips among which configurations are looked for; of more, evenly spaced ones."""

BLOCK = 32
"""Directions that are looked along at a time."""

AIMS = 6
"""Shares aimed at, from the one asked for up to all: directions not seen are reached a bit less."""

NEGLIGIBLE = 0.002
"""Features that differ by less than this share of themselves are taken to be equal."""

LARGEST_STRETCH = 2.0
"""Most by which estimates are spread out."""

LEFT_OUT = {*PARAMETERS, *COVARIANCE, *SURVEY, "refused", "message"}
"""Of the summary of a trip, what the details of a configuration state otherwise."""

LISTED = 1000
"""More refused trips than this are counted, not listed; the summaries have all of them."""


@dataclass(frozen=True, eq=False)
class Chosen:
    """Trips that stand for all.

    Attributes
    ----------
    rows : (q,) int array
        Increasing.
    weights : (q,) int array
        How many trips are nearest to each.
    level : float
        Share of trips that the worst of the chosen bounds, in the worst of the linear functions
        that judged them.
    """

    rows: IntArray
    weights: IntArray
    level: float


@runtime_checkable
class FitOfTrips(Protocol):
    """What `analysis.fit` makes of trips."""

    @property
    def summaries(self) -> pd.DataFrame:
        """All trips; see `trainlog.formats.summaries`."""

    @property
    def parameters(self) -> ParameterSet:
        """The observed configurations."""


def parameter_set(
    trips: pd.DataFrame | Sequence[TripFit] | TripFit | FitOfTrips,
    *,
    cover: float = COVER,
    most: int | None = None,
    common: CommonFit | None = None,
) -> ParameterSet:
    """The observed set of configurations.

    Parameters
    ----------
    trips : Fits, DataFrame of summaries, TripFit or sequence of them
        Refused trips are listed in the details. A trip that never was at its power limit, while
        others were, has the lower power of the two next in mass: so the set has the powers that
        were seen, and a few low ones more. Where none was, the train's file gives the power.
    cover : float
        Share of trips whose running times and energies the set is to bound, as a fraction above
        0 and at most 1 (all trips); as many configurations as that takes.
    most : int, optional
        At most so many configurations, 1 or more; the level that they reach is stated.
    common : CommonFit, optional
        Of these trips, where it is at hand; default: `combine` makes it.

    Raises
    ------
    NotIdentifiableError
        If there is no trip that determines the curve.
    InputError
        If the trips belong to different trains, one appears twice, or `cover` or `most` is out
        of its range.

    Examples
    --------
    >>> from analysis.resistance.fit import fit_trip
    >>> found = parameter_set([fit_trip("sample_logs/nonstop.mcap")])
    >>> [each.name for each in found.configurations]
    ['trip-01']
    """
    check_choice(cover, most, all_trips=True)
    every = each_drive_once(_summaries_of(trips))
    rows = checked(every)
    common = common or combine(rows)
    betas = _spread_out(common)
    masses = _masses_given(rows, betas)
    limits = rows["max_power"].to_numpy(np.float64)
    seen = np.isfinite(limits)
    power = np.where(seen, limits, rows["train_power"].to_numpy(np.float64))
    if seen.any():
        # The lower limit of the two trips next in mass of those where it was seen.
        order = np.argsort(masses[seen], kind="stable")
        known, values = masses[seen][order], limits[seen][order]
        after = np.clip(np.searchsorted(known, masses), 1, max(known.size - 1, 1))
        lower = np.minimum(values[after - 1], values[np.minimum(after, known.size - 1)])
        power = np.where(seen, limits, lower)
    inertia = masses + rows["rotating_mass"].to_numpy(np.float64)
    speeds = np.linspace(0.0, common.asked[1], 3)
    drag = betas @ basis(speeds).T / inertia[:, None]
    chosen = choose(np.column_stack([1.0 / inertia, drag, power]), cover, most)
    names, spread = _names(rows), float(np.std(limits[seen])) if seen.any() else None
    configurations, details = [], []
    for row, weight in zip(chosen.rows.tolist(), chosen.weights.tolist(), strict=True):
        summary = rows.iloc[row]
        resistance = nearest_physical(betas[row], common.covariances[row])
        nearest = resistance.coefficients[None]
        configurations.append(
            Configuration(
                name=names[row],
                mass=float(_masses_given(rows.iloc[[row]], nearest)[0]),
                rotating_mass=float(summary["rotating_mass"]),
                resistance=resistance,
                max_power=float(power[row]),
            )
        )
        source = "power-limited stretches" if seen[row] else "trips next in mass"
        source = source if seen.any() else POWER_OF_FILE
        about = {"configuration": names[row], "stands_for": weight}
        details.append(about | _detail(summary, common.covariances[row], source, spread))
    refused = every[every["refused"] != ""]
    return ParameterSet(
        train=common.train,
        configurations=tuple(configurations),
        common=common.resistance,
        common_covariance=common.covariance,
        speed_range=common.speed_range,
        details=details + _refusals(refused),
        cover={
            "asked": cover,
            "level": chosen.level,
            "trips": len(rows),
            "powers_seen": int(np.count_nonzero(seen)),
            "refused": {str(k): int(n) for k, n in refused["refused"].value_counts().items()},
            "between": common.between.tolist(),
        },
    )


def _summaries_of(trips: pd.DataFrame | Sequence[TripFit] | TripFit | FitOfTrips) -> pd.DataFrame:
    """The summaries of trips in whatever form a fit gives them."""
    if isinstance(trips, pd.DataFrame):
        return trips
    if isinstance(trips, FitOfTrips):
        return trips.summaries
    return summarised([trips] if isinstance(trips, TripFit) else trips)


def check_choice(cover: float, most: int | None, *, all_trips: bool = False) -> None:
    """Refuse a share, or a number of configurations, that no set can be asked for.

    Parameters
    ----------
    cover : float
    most : int or None
    all_trips : bool
        Whether a `cover` of 1, all the trips given, may be asked for.

    Raises
    ------
    InputError
        Unless 0 < `cover` < 1, and `most` is None or an integer of 1 or more.
    """
    share = _number(cover)
    if not (0.0 < share < 1.0 or (all_trips and share == 1.0)):
        end = "at most 1" if all_trips else "below 1"
        raise InputError(
            f"cover {cover!r} must be a fraction above 0 and {end}",
            remedy="give for instance cover=0.95 for 95 % of trips",
        )
    if most is not None and not (_number(most) >= 1 and _number(most) % 1 == 0):
        raise InputError(
            f"most {most!r} must be a whole number of configurations, 1 or more",
            remedy="give most=None for as many as the cover takes",
        )


def _number(value: object) -> float:
    """A number, or NaN for what is none."""
    given = np.asarray(value)
    return float(given) if given.ndim == 0 and given.dtype.kind in "iuf" else np.nan


def choose(features: FloatArray, cover: float, most: int | None = None) -> Chosen:
    """The rows of which the worst bounds a share of all rows, in every linear function.

    Parameters
    ----------
    features : (n, d) array
        Of about the same sign in each column.
    cover : float
        Share asked for. If n rows cannot promise it, all are chosen.
    most : int, optional
        Choose no more; then the largest share that so many reach.
    """
    points = _whitened(features)
    count, size = points.shape
    if size == 0:
        return Chosen(np.zeros(1, dtype=np.int64), np.array([count]), count / (count + 1))
    seen, judges = np.random.default_rng(0).standard_normal((2, DIRECTIONS, size))
    limit = count if most is None else most
    spread = np.linspace(0, count - 1, min(count, CANDIDATES))
    candidates = np.unique(np.round(spread).astype(np.int64))
    for share in 1.0 - (1.0 - cover) * np.linspace(1.0, 0.0, AIMS):
        found = _few(points[candidates], seen, float(share), limit)
        rows = candidates[found]
        if rows.size == limit or _level(points[candidates], found, judges) >= cover:
            break
    else:
        # So few trips cannot promise that much; then each of them counts.
        rows = np.arange(count) if count <= limit else rows
    distances = [np.sum((points - points[row]) ** 2, axis=1) for row in rows]
    return Chosen(
        rows,
        np.bincount(np.argmin(distances, axis=0), minlength=rows.size),
        _level(points, rows, judges),
    )


def _few(points: FloatArray, directions: FloatArray, share: float, most: int) -> IntArray:
    """Few rows, at most `most`, of which one reaches a share of the points in each direction.

    Where so few cannot, those of the largest share that they can reach.
    """
    along = points @ directions.T
    order = np.sort(along, axis=0)

    def reaching(rank: int) -> IntArray:
        """Rows one by one, each for most of the directions still open."""
        reach, rows = along >= order[rank - 1], list[int]()
        open_ones = np.ones(reach.shape[1], dtype=np.bool_)
        while open_ones.any():
            rows.append(int(np.argmax(np.count_nonzero(reach[:, open_ones], axis=1))))
            open_ones &= ~reach[rows[-1]]
        return np.array(rows, dtype=np.int64)

    rank = min(int(np.ceil(share * (len(points) + 1))), len(points))
    found = reaching(rank)
    if found.size > most:
        fewer = bisect_right(range(1, rank), most, key=lambda each: reaching(each).size)
        found = reaching(max(fewer, 1))[:most]
    return np.sort(found)


def _level(points: FloatArray, rows: IntArray, directions: FloatArray) -> float:
    """Least share of the points, over the directions, that the rows reach."""
    fewest = len(points)
    for block in np.array_split(directions, max(len(directions) // BLOCK, 1)):
        along = points @ block.T
        reached = np.count_nonzero(along <= along[rows].max(axis=0), axis=0)
        fewest = min(fewest, int(reached.min()))
    return fewest / (len(points) + 1)


def _whitened(features: FloatArray) -> FloatArray:
    """Features made uncorrelated and of unit variance; those that do not differ are left out."""
    relative = features / np.mean(features, axis=0) - 1.0
    if len(features) < 2:
        return np.zeros((len(features), 0))
    variance, vectors = np.linalg.eigh(np.cov(relative, rowvar=False))
    kept = variance > NEGLIGIBLE**2
    return np.asarray(relative @ vectors[:, kept] / np.sqrt(variance[kept]))


def _spread_out(common: CommonFit) -> FloatArray:
    """Each trip's coefficients (k, p), their variance raised to what trips have; Louis (1984)."""
    betas = common.betas
    if len(betas) < 2:
        return betas
    scale = np.sqrt(np.diag(common.between))
    root = np.linalg.cholesky(common.between / np.outer(scale, scale))
    middle = betas.mean(axis=0)
    away = np.linalg.solve(root, ((betas - middle) / scale).T)
    variance, vectors = np.linalg.eigh(np.cov(away))
    stretch = np.clip(1.0 / np.sqrt(np.maximum(variance, 1e-12)), 1.0, LARGEST_STRETCH)
    moved = root @ (vectors * stretch) @ vectors.T @ away
    return np.asarray(middle + scale * moved.T)


def _masses_given(rows: pd.DataFrame, betas: FloatArray) -> FloatArray:
    """Mass [kg] of each trip once its running resistance is known better than from itself."""
    fitted, covariance = parameters_of(rows), covariances_of(rows)
    shift = betas - fitted[:, :-1]
    scale = np.sqrt(np.einsum("kii->ki", covariance[:, :-1, :-1]))
    scaled = covariance[:, :-1, :-1] / (scale[:, :, None] * scale[:, None, :])
    slope = np.linalg.solve(scaled, (covariance[:, :-1, -1] / scale)[..., None])[..., 0]
    return np.asarray(fitted[:, -1] + np.sum(slope * shift / scale, axis=1))


def _names(rows: pd.DataFrame) -> list[str]:
    """Names of the trips; those of one name are distinguished by the digest of logs or samples."""
    twice = rows.duplicated("trip", keep=False).to_numpy()
    if not twice.any():
        return [str(name) for name in rows["trip"]]
    digests = [
        digest or sha256(identity.encode())
        for digest, identity in zip(rows["sha256"], rows["identity"], strict=True)
    ]
    pairs = zip(rows["trip"], digests, twice, strict=True)
    return [f"{trip} {digest[:8]}" if same else str(trip) for trip, digest, same in pairs]


def _detail(
    summary: pd.Series, covariance: FloatArray, power_source: str, power_spread: float | None
) -> dict[str, Any]:
    """What is noted beside a trip's configuration; plain values."""
    one = summary.to_frame().T
    own = covariances_of(one)[0]
    fitted_std = np.sqrt(np.diag(own))
    std = [*np.sqrt(np.diag(covariance)).tolist(), float(fitted_std[-1])]
    seen = power_source == "power-limited stretches"
    plain = summary.astype(object).where(summary.notna(), None).to_dict()
    return {
        **{str(name): value for name, value in plain.items() if name not in LEFT_OUT},
        "accepted": True,
        "fitted": {name: plain[name] for name in PARAMETERS},
        "fitted_std": dict(zip(PARAMETERS, fitted_std.tolist(), strict=True)),
        "fitted_correlation": (own / np.outer(fitted_std, fitted_std)).tolist(),
        "std": dict(zip(PARAMETERS, std, strict=True)),
        "max_power": power_source,
        "max_power_std": plain["max_power_std"] if seen else power_spread,
    }


def _refusals(refused: pd.DataFrame) -> list[dict[str, Any]]:
    """Trips that do not determine the curve, and why."""
    if len(refused) > LISTED:
        return []
    return [
        {
            "trip": str(row.trip),
            "sha256": str(row.sha256),
            "accepted": False,
            "refused": str(row.refused),
            "reason": str(row.message),
        }
        for row in refused.itertuples()
    ]
