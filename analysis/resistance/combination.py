"""Many trips together: the common curve, how trips differ from it, the observed parameter set.

Trips differ: wind, weather, the train itself. Each trip's ``beta = (r0, r1, r2)`` is a draw from
a normal distribution around the common one, seen with that trip's own covariance:

    beta_i ~ N(common, between),    fitted_i ~ N(beta_i, V_i).

`between` is found by restricted maximum likelihood (expectation maximisation); the best estimate
of one trip's curve is the fitted one drawn towards the common one by as much as its own
covariance warrants. Only sums over trips are needed, in no particular order.

References
----------
Laird, N. M., Ware, J. H. (1982), Random-effects models for longitudinal data, Biometrics 38(4),
eqs. (3.2)-(3.6).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls

from analysis.resistance.curve import band_factor, curve_std, powers
from analysis.resistance.fit import TripFit
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.railway.configuration import Configuration, ParameterSet
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import Train

FloatArray = NDArray[np.float64]

BETWEEN_TRIPS = 0.05
"""How much trips are expected to differ from each other, over the curve."""

PRIOR_TRIPS = 2.0
"""This expectation counts as much as so many trips beside the observed ones."""

ITERATIONS = 500
"""Most rounds of the expectation maximisation."""


@dataclass(frozen=True, eq=False)
class CommonFit:
    """All trips together.

    Attributes
    ----------
    train : str
    resistance : RunningResistance
        Mean of the trips.
    covariance : (3, 3) array
        Of the mean's r0, r1, r2.
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

    def std(self, speed: ArrayLike) -> FloatArray:
        """Standard deviation of the mean curve [N] at each speed [m/s]."""
        return curve_std(self.covariance, speed)

    def spread(self, speed: ArrayLike) -> FloatArray:
        """Standard deviation of one trip's curve around the mean [N] at each speed [m/s]."""
        return curve_std(self.between, speed)

    def band(self, speed: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Lower and upper end [N] of the 95 % band of the whole mean curve, from standstill up."""
        factor = band_factor(self.covariance, (0.0, self.asked[1]), self.freedom)
        value, reach = self.resistance(speed), factor * self.std(speed)
        return value - reach, value + reach


def combine(fits: Sequence[TripFit]) -> CommonFit:
    """Combine the fits of several trips of one train.

    Parameters
    ----------
    fits : sequence of TripFit
        In any order; the result is the same.

    Raises
    ------
    NotIdentifiableError
        If there is no fit.
    InputError
        If the fits belong to different trains, or a trip appears twice.
    """
    if not fits:
        raise NotIdentifiableError(
            "no trip determines the running resistance", remedy="give more, or more varied, trips"
        )
    ordered = sorted(fits, key=lambda fit: fit.trip)
    names = [fit.trip for fit in ordered]
    trains = sorted({fit.train for fit in ordered})
    if len(trains) > 1:
        raise InputError(
            f"trips of different trains: {', '.join(trains)}", remedy="fit each train apart"
        )
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"trip '{twice}' is given twice", remedy="give each trip once")
    asked = (max(f.asked[0] for f in ordered), min(f.asked[1] for f in ordered))
    # Curve values at three speeds are far better conditioned than the coefficients.
    nodes = powers(np.linspace(0.0, asked[1], 3))
    back = np.linalg.inv(nodes)
    found = _random_effects(
        np.array([nodes @ fit.beta for fit in ordered]),
        np.array([nodes @ fit.covariance[:3, :3] @ nodes.T for fit in ordered]),
    )
    covariance = back @ found.variance @ back.T
    return CommonFit(
        train=trains[0],
        resistance=nearest_physical(back @ found.mean, covariance),
        covariance=covariance,
        between=back @ found.between @ back.T,
        freedom=len(ordered) - 1 + int(PRIOR_TRIPS),
        asked=asked,
        speed_range=(
            min(fit.speed_range[0] for fit in ordered),
            max(fit.speed_range[1] for fit in ordered),
        ),
        trips=tuple(names),
        betas=found.single @ back.T,
        covariances=back @ found.single_variance @ back.T,
    )


def parameter_set(
    fits: Sequence[TripFit], train: Train, refused: Mapping[str, str] | None = None
) -> ParameterSet:
    """The observed set of configurations: one a trip, each the best estimate of that trip.

    Parameters
    ----------
    fits : sequence of TripFit
        Of the trips that were accepted.
    train : Train
        Gives the power where no trip was at its power limit; a trip that was not, while others
        were, gets their mean.
    refused : mapping of str to str, optional
        Trips that do not determine the curve, and why; they are listed in the details.

    Raises
    ------
    NotIdentifiableError
        If there is no fit.
    InputError
        If the fits belong to different trains, or a trip appears twice.
    """
    common = combine(fits)
    by_name = {fit.trip: fit for fit in fits}
    powers_seen = [fit.max_power for fit in fits if fit.max_power is not None]
    usual = float(np.mean(sorted(powers_seen))) if powers_seen else train.max_traction_power
    configurations, details = [], []
    for row, name in enumerate(common.trips):
        fit = by_name[name]
        resistance = nearest_physical(common.betas[row], common.covariances[row])
        configurations.append(
            Configuration(
                name=name,
                mass=_mass_given(fit, resistance),
                rotating_mass=fit.rotating_mass,
                resistance=resistance,
                max_power=fit.max_power or usual,
            )
        )
        details.append(
            _detail(fit, common.covariances[row], "other trips" if powers_seen else "train file")
        )
    details += [
        {"trip": name, "accepted": False, "reason": reason}
        for name, reason in sorted((refused or {}).items())
    ]
    return ParameterSet(
        train=train.name,
        configurations=tuple(configurations),
        common=common.resistance,
        common_covariance=common.covariance,
        speed_range=common.speed_range,
        details=details,
    )


@dataclass(frozen=True, eq=False)
class _Effects:
    """Mean (p,), its variance, the variance between trips (p, p); each trip (k, p), (k, p, p)."""

    mean: FloatArray
    variance: FloatArray
    between: FloatArray
    single: FloatArray
    single_variance: FloatArray


def _random_effects(values: FloatArray, variances: FloatArray) -> _Effects:
    """Mean of trips that differ, and the best estimate of each; values (k, p), variances (k, p, p).

    Laird and Ware's expectation maximisation of the restricted likelihood, with a weak prior on
    the variance between trips.
    """
    count = len(values)
    expected = np.diag((BETWEEN_TRIPS * np.median(values, axis=0)) ** 2)
    between = expected
    for _ in range(ITERATIONS):
        weight = np.linalg.inv(between + variances)
        variance = np.linalg.inv(weight.sum(axis=0))
        mean = variance @ np.einsum("kij,kj->i", weight, values)
        gain = between @ weight
        effect = np.einsum("kij,kj->ki", gain, values - mean)
        remaining = between - gain @ between + gain @ variance @ gain.transpose(0, 2, 1)
        total = np.einsum("ki,kj->ij", effect, effect) + remaining.sum(axis=0)
        previous = between
        between = (total + PRIOR_TRIPS * expected) / (count + PRIOR_TRIPS)
        if np.allclose(between, previous, rtol=1e-6, atol=0.0):
            break
    rest = np.eye(mean.size) - gain
    return _Effects(
        mean=mean,
        variance=variance,
        between=between,
        single=mean + effect,
        single_variance=between - gain @ between + rest @ variance @ rest.transpose(0, 2, 1),
    )


def nearest_physical(beta: FloatArray, covariance: FloatArray) -> RunningResistance:
    """The likeliest running resistance of which no coefficient is negative.

    Where r0, r1 and r2 can hardly be told apart one of them may come out negative; the nearest
    physical ones, measured by the covariance, give nearly the same curve.
    """
    scale = np.sqrt(np.diag(covariance))
    half = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(scale, scale)))
    nearest, _ = nnls(half, half @ (beta / scale))
    return RunningResistance(*(nearest * scale).tolist())


def _mass_given(fit: TripFit, resistance: RunningResistance) -> float:
    """Mass [kg] of a trip once its running resistance is known better than from itself."""
    shift = np.array([resistance.r0, resistance.r1, resistance.r2]) - fit.beta
    slope = np.linalg.solve(fit.covariance[:3, :3], fit.covariance[:3, 3])
    return float(fit.mass + slope @ shift)


def _detail(fit: TripFit, covariance: FloatArray, otherwise: str) -> dict[str, Any]:
    """What is noted beside a trip's configuration; plain values."""
    own, drawn = (np.sqrt(np.diag(c)[:3]).tolist() for c in (fit.covariance, covariance))
    return {
        "trip": fit.trip,
        "accepted": True,
        "fitted": {
            "r0": fit.resistance.r0,
            "r1": fit.resistance.r1,
            "r2": fit.resistance.r2,
            "mass": fit.mass,
        },
        "fitted_std": dict(zip(("r0", "r1", "r2"), own, strict=True)) | {"mass": fit.mass_std},
        "std": dict(zip(("r0", "r1", "r2"), drawn, strict=True)),
        "max_power": "power-limited stretches" if fit.max_power else otherwise,
        "condition": fit.condition,
        "speed_range": list(fit.speed_range),
        "windows": fit.windows,
        "masked": fit.masked,
        "speed_scale": {"factor": fit.scale.factor, "source": fit.scale.source},
        "noise": fit.noise,
        "residual_std": fit.residual_std,
    }
