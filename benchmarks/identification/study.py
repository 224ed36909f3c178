"""Trips of the identification study run through the product's own path, two at a time.

A drawn trip becomes a `Trip`, `fit_trip` fits it, its summary is kept, `combine` combines
summaries: nothing of the estimate is made here. Beside it stand the peers' estimates, the bound,
and whether the truth was in the band.
"""

from __future__ import annotations

import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context

import numpy as np
import pandas as pd
from bound import information
from monte_carlo import Drawn, Study, draw, trip_of

from analysis.resistance import combine, fit_trip
from analysis.resistance.combination import CommonFit, summarised
from analysis.resistance.curve import band_factor, curve_std
from analysis.resistance.fit import TripFit
from analysis.resistance.noise import build_windows
from analysis.resistance.recording import TripRefusedError, prepare
from analysis.view import view_of
from estimators.regression import RecursiveLeastSquares
from trainlog.arrays import FloatArray
from trainlog.formats.summaries import covariances_of
from trainlog.railway.resistance import basis
from trainlog.trip import Trip

SPEEDS = np.linspace(5.0, 55.0, 101)
"""Where the error of the curve is judged [m/s]."""

ASKED = (25.0, 40.0)
"""Speeds for which the curve must be known to 10 %, or the trip is refused [m/s]: of a trip whose
few speeds are all slow, or all fast, the rest is not known, as the bound says too."""

PROCESSES = 2


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one trip.

    Attributes
    ----------
    refused : str
        Why the trip does not determine the curve; empty if it does.
    summary : DataFrame
        One row, or none.
    beta : (3,) array
        Of the trip alone; no coefficient is held from being negative.
    differenced, ordinary : (3,) array
        The peers'.
    bound : (3, 3) array or None
        Information that the trip holds, where it was asked for.
    single, whole : float, bool
        Share of speeds within 1.96 standard deviations; whether all of the curve is in the band.
    seconds : float
        Processor time of the fit.
    """

    refused: str
    summary: pd.DataFrame
    beta: FloatArray
    differenced: FloatArray
    ordinary: FloatArray
    bound: FloatArray | None
    single: float
    whole: bool
    seconds: float


def processes() -> ProcessPoolExecutor:
    """Processes of low priority that `run` shares its trips among."""
    return ProcessPoolExecutor(
        PROCESSES, mp_context=get_context("spawn"), initializer=os.nice, initargs=(10,)
    )


def run(
    pool: ProcessPoolExecutor, study: Study, trips: int, *, bounds: int = 0, peers: bool = False
) -> list[Outcome]:
    """Draw and fit trips; the bound of the first `bounds`, the peers' estimates if asked for."""
    tasks = [(study, seed, seed < bounds, peers) for seed in range(trips)]
    return list(pool.map(_one, tasks, chunksize=5))


def error(beta: FloatArray, study: Study) -> float:
    """Relative error of the curve, root mean square over `SPEEDS` [%]."""
    truth = study.resistance(SPEEDS)
    return float(100.0 * np.sqrt(np.mean((basis(SPEEDS) @ beta / truth - 1.0) ** 2)))


def grouped(outcomes: list[Outcome], size: int) -> list[list[Outcome]]:
    """Trips in groups, as many as there are whole ones."""
    return [outcomes[k : k + size] for k in range(0, len(outcomes) - size + 1, size)]


def common(group: list[Outcome]) -> CommonFit:
    """A group as the product combines it."""
    return _combined(tuple(group))


@cache
def _combined(group: tuple[Outcome, ...]) -> CommonFit:
    return combine(pd.concat([one.summary for one in group], ignore_index=True))


def beta_of(fit: CommonFit | TripFit) -> FloatArray:
    """r0, r1, r2."""
    return np.array([fit.resistance.r0, fit.resistance.r1, fit.resistance.r2])


def covered(fit: CommonFit | TripFit, study: Study) -> tuple[float, bool]:
    """Share of `SPEEDS` within 1.96 standard deviations; whether all are in the whole band."""
    off = np.abs(fit.resistance(SPEEDS) - study.resistance(SPEEDS))
    covariance = fit.covariance[:3, :3]
    z = off / curve_std(covariance, SPEEDS)
    reach = band_factor(covariance, (float(SPEEDS[0]), float(SPEEDS[-1])), fit.freedom)
    return float(np.mean(z < 1.96)), bool(np.all(z < reach))


def at_the_bound(bounds: list[FloatArray], study: Study, size: int) -> FloatArray:
    """Errors [%] of groups of trips, were they known as well as the bound allows."""
    generator = np.random.default_rng(size)
    # One trip is as well known as it is itself; many are as well known as their mean.
    kinds = bounds if size == 1 else [size * np.mean(bounds, axis=0)]
    found = []
    for kind in kinds:
        root = np.linalg.cholesky(np.linalg.inv(kind))
        off = basis(SPEEDS) @ root @ generator.standard_normal((3, 20_000 // len(kinds)))
        off /= study.resistance(SPEEDS)[:, None]
        found.append(100.0 * np.sqrt(np.mean(off**2, axis=0)))
    return np.concatenate(found)


def excess(outcomes: list[Outcome], study: Study) -> float:
    """Variance of single trips over the bound's: 1 if nothing is lost."""
    r = study.resistance
    truth = np.array([r.r0, r.r1, r.r2])
    return float(
        np.mean(
            [
                (one.beta - truth) @ one.bound @ (one.beta - truth) / 3.0
                for one in outcomes
                if one.bound is not None
            ]
        )
    )


def known_to(outcomes: list[Outcome], speed: float, study: Study) -> FloatArray:
    """Standard deviation of each trip's curve at a speed, over the curve."""
    rows = pd.concat([one.summary for one in outcomes], ignore_index=True)
    truth = float(study.resistance(np.array(speed)))
    return np.array([curve_std(c[:3, :3], speed) for c in covariances_of(rows)]) / truth


def _one(task: tuple[Study, int, bool, bool]) -> Outcome:
    study, seed, with_bound, peers = task
    drawn = draw(study, seed)
    trip = trip_of(drawn, study, seed)
    began = time.process_time()
    try:
        fit = fit_trip(trip, ASKED)
    except TripRefusedError as refusal:
        nothing = np.full(3, np.nan)
        return Outcome(
            refused=refusal.reason,
            summary=summarised([]),
            beta=nothing,
            differenced=nothing,
            ordinary=nothing,
            bound=None,
            single=np.nan,
            whole=False,
            seconds=np.nan,
        )
    seconds = time.process_time() - began
    nothing = np.full(3, np.nan)
    single, whole = covered(fit, study)
    return Outcome(
        refused="",
        summary=summarised([fit]),
        beta=beta_of(fit),
        differenced=_differenced(drawn, study) if peers else nothing,
        ordinary=_ordinary(trip) if peers else nothing,
        bound=information(drawn, study) if with_bound else None,
        single=single,
        whole=whole,
        seconds=seconds,
    )


def _differenced(trip: Drawn, study: Study) -> FloatArray:
    """Amirhosseini et al. (2024), eqs. (21)-(24), with the given mass, less the map's gradient."""
    speed = trip.speed
    known = trip.braking[:-1] == 0.0
    track = trip.line.track_acceleration(trip.position[:-1])
    left = study.mass * (np.diff(speed) / np.diff(trip.time) + track) - trip.effort[:-1]
    right = -np.column_stack([np.ones(speed.size - 1), speed[:-1], speed[:-1] ** 2])
    recursion = RecursiveLeastSquares([1e6, 1e5, 1e4])
    recursion.update(right[known], left[known], 1e8)
    return np.asarray(recursion.result().estimate, dtype=np.float64)


def _ordinary(trip: Trip) -> FloatArray:
    """Ordinary least squares on windows of ten seconds."""
    windows = build_windows(prepare(view_of(trip))).merged()
    size = np.linalg.norm(windows.x, axis=0)
    theta = np.linalg.lstsq(windows.x / size, windows.y, rcond=None)[0] / size
    return np.asarray(theta[1:] / theta[0])
