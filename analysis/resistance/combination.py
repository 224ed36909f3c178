"""Many trips together: the common curve, and how trips differ from it.

Trips differ: wind, weather, the train itself. `analysis.resistance.random_effects` finds what they
have in common, and draws each towards it by as much as its own uncertainty warrants. Of a trip its
summary is needed, not its log: a million trips are a million rows, in any order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls

from analysis.resistance.curve import band_factor, curve_std, powers
from analysis.resistance.fit import TripFit
from analysis.resistance.random_effects import random_effects
from analysis.resistance.shared import shared_variance
from analysis.resistance.summary import summarised
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.formats.summaries import covariances_of, ordered, parameters_of, surveys_of
from trainlog.railway.resistance import RunningResistance

FloatArray = NDArray[np.float64]

BETWEEN_TRIPS = 0.05
"""How much trips are expected to differ from each other, over the curve."""

PRIOR_TRIPS = 2.0
"""This expectation counts as much as so many trips beside the observed ones."""


@dataclass(frozen=True, eq=False)
class CommonFit:
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


def combine(trips: pd.DataFrame | Sequence[TripFit]) -> CommonFit:
    """Combine several trips of one train.

    Parameters
    ----------
    trips : DataFrame of summaries, or sequence of TripFit
        In any order; the result is the same to the last bit. Refused trips are left aside.

    Raises
    ------
    NotIdentifiableError
        If there is no trip that determines the curve.
    InputError
        If the trips belong to different trains, or one appears twice.
    """
    rows = accepted(trips)
    top = float(rows["asked_highest"].min())
    # Curve values at three speeds are far better conditioned than the coefficients.
    nodes = powers(np.linspace(0.0, top, 3))
    values = parameters_of(rows)[:, :3] @ nodes.T
    size = np.median(values, axis=0)
    nodes, values = nodes / size[:, None], values / size
    variances = nodes @ covariances_of(rows)[:, :3, :3] @ nodes.T
    expected = BETWEEN_TRIPS**2 * np.eye(3)
    found = random_effects(values, variances, expected, PRIOR_TRIPS)
    weights = found.variance @ np.linalg.inv(variances + found.between)
    shared = shared_variance(weights, nodes @ surveys_of(rows) @ nodes.T, _lines(rows))
    back = np.linalg.inv(nodes)
    covariance = back @ (found.variance + shared) @ back.T
    return CommonFit(
        train=str(rows["train"].iloc[0]),
        resistance=nearest_physical(back @ found.mean, covariance),
        covariance=covariance,
        between=back @ found.between @ back.T,
        freedom=len(rows) - 1 + int(PRIOR_TRIPS),
        asked=(float(rows["asked_lowest"].max()), top),
        speed_range=(float(rows["speed_lowest"].min()), float(rows["speed_highest"].max())),
        trips=tuple(rows["trip"]),
        betas=found.single @ back.T,
        covariances=back @ found.single_variance @ back.T,
    )


def _lines(rows: pd.DataFrame) -> NDArray[np.int64]:
    """Number of the line and direction of each trip; trips of which it is not known share none."""
    known = rows["gradients"].to_numpy() != ""
    numbers = np.arange(len(rows), dtype=np.int64)
    numbers[known] = len(rows) + pd.factorize(rows["gradients"][known])[0]
    return numbers


def accepted(trips: pd.DataFrame | Sequence[TripFit]) -> pd.DataFrame:
    """Summaries of the trips that determine the curve, in order; errors as `combine`."""
    every = trips if isinstance(trips, pd.DataFrame) else summarised(trips)
    rows = ordered(every[every["refused"] == ""])
    if rows.empty:
        raise NotIdentifiableError(
            "no trip determines the running resistance", remedy="give more, or more varied, trips"
        )
    trains = sorted(rows["train"].unique())
    if len(trains) > 1:
        raise InputError(
            f"trips of different trains: {', '.join(trains)}", remedy="fit each train apart"
        )
    again = rows.duplicated(["trip", "sha256"])
    if again.any():
        twice = rows["trip"][again].iloc[0]
        raise InputError(f"trip '{twice}' is given twice", remedy="give each trip once")
    return rows


def nearest_physical(beta: FloatArray, covariance: FloatArray) -> RunningResistance:
    """The likeliest running resistance of which no coefficient is negative.

    Where r0, r1 and r2 can hardly be told apart one of them may come out negative; the nearest
    physical ones, measured by the covariance, give nearly the same curve.
    """
    scale = np.sqrt(np.diag(covariance))
    half = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(scale, scale)))
    nearest, _ = nnls(half, half @ (beta / scale))
    return RunningResistance(*(nearest * scale).tolist())
