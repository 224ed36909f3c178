"""Tables of fleets drawn from the errors of trips that were simulated, recorded and fitted.

For studies of thousands of months of trains. How well a trip is known, on which line and with which
load, is that of a fitted trip drawn at random; what is true is drawn anew: trains by Laplace's
distribution, trips by another with one in fifteen far off, days in common, wear and winter.
Errors of fits have tails of four degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray
from trainlog.formats.summaries import COVARIANCE, SURVEY, covariances_of, surveys_of

START = pd.Timestamp("2025-01-06T05:00:00Z")


@dataclass(frozen=True)
class Fault:
    """A fault of a train (its number) from a trip on, perhaps up to another, on a share of them."""

    what: str
    size: float
    train: int
    trip: int
    end: int | None = None
    share: float = 1.0

    def shown(self, trips: int, seed: list[int]) -> FloatArray:
        """Its size on each trip, (n,): 0 where it does not show."""
        number = np.arange(trips)
        there = (number >= self.trip) & (number < (trips if self.end is None else self.end))
        there &= np.random.default_rng(seed).random(trips) < self.share
        return self.size * there


def drawn_fleet(
    pool: pd.DataFrame,
    seed: int,
    *,
    trains: int = 8,
    trips: int = 60,
    trips_a_day: float = 2.0,
    wear: float = 0.0006,
    season: float = 0.03,
    faults: tuple[Fault, ...] = (),
) -> pd.DataFrame:
    """Summaries with passports of a fleet, and what is true of each trip (``true_``, ``own_``)."""
    generator = np.random.default_rng([seed, 311])
    pieces = []
    for kind, rows in pool[pool["refused"] == ""].groupby("kind", sort=True):
        common = _days(int(trips / trips_a_day) + 2, generator)
        lines = {name: generator.standard_normal(3) for name in rows["gradients"].unique()}
        for number in range(trains):
            mine = tuple(each for each in faults if each.train == number)
            pieces.append(
                _train(
                    str(kind),
                    rows,
                    number,
                    trips,
                    trips_a_day,
                    common,
                    lines,
                    wear,
                    season,
                    mine,
                    generator,
                )
            )
    return pd.concat(pieces, ignore_index=True)


def _days(count: int, generator: np.random.Generator) -> FloatArray:
    """What days add to all trains, neighbouring days alike."""
    noise = generator.normal(0.0, 0.012, count + 12)
    return np.convolve(noise, 0.6 ** np.arange(12), mode="valid")[:count]


def _train(
    kind: str,
    rows: pd.DataFrame,
    number: int,
    trips: int,
    trips_a_day: float,
    common: FloatArray,
    lines: dict[str, FloatArray],
    wear: float,
    season: float,
    faults: tuple[Fault, ...],
    generator: np.random.Generator,
) -> pd.DataFrame:
    drawn = rows.iloc[generator.integers(len(rows), size=trips)].reset_index(drop=True).copy()
    day = np.arange(trips) / trips_a_day
    months = day / 30.44
    nominal = np.median(rows[["own_r0", "own_r1", "own_r2"]].to_numpy(float), axis=0)
    own = nominal * (1.0 + np.clip(generator.laplace(0.0, 0.03, 3), -0.2, 0.2))
    spread = generator.laplace(0.0, 0.02, (trips, 3)) + common[day.astype(int)][:, None]
    bad = generator.uniform(size=trips) < 1.0 / 15.0
    spread[bad] += generator.uniform(-0.15, 0.25, (int(bad.sum()), 1))
    spread += season * np.sin(2.0 * np.pi * (months - 1.0) / 12.0)[:, None]
    true = own * (1.0 + spread)
    by = [number, int(abs(1e9 * common[0]))]
    size = {each.what: each.shown(trips, [*by, each.trip]) for each in faults}
    true[:, 0] += size.get("dragging brake", 0.0)
    heavy = np.sqrt(4.0 / generator.chisquare(4.0, trips)) / np.sqrt(2.0)
    covariance, survey = covariances_of(drawn)[:, :3, :3], surveys_of(drawn)
    noise = np.linalg.cholesky(_sound(covariance - survey)) @ generator.standard_normal(
        (trips, 3, 1)
    )
    values, vectors = np.linalg.eigh(survey)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :] @ vectors.transpose(0, 2, 1)
    shared = np.array([lines[name] for name in drawn["gradients"]])[:, :, None]
    wrong = 1.0 + size.get("mass", 0.0) * np.ones(trips)
    heavier = generator.normal(1.0, 0.004) * wrong
    found = (true + heavy[:, None] * noise[:, :, 0] + (roots @ shared)[:, :, 0]) / heavier[:, None]
    drawn[["r0", "r1", "r2"]] = found
    gain = generator.normal(1.0, 0.012) * (1.0 + size.get("effort gain", 0.0))
    gain = (
        gain
        * heavier
        * (1.0 + heavy * drawn["effort_gain_std"].to_numpy() * generator.standard_normal(trips))
    )
    drawn["effort_gain"] = gain
    wheels = generator.uniform(-0.004, 0.004) + wear * generator.uniform() * months
    drawn["speed_scale"] = (
        1.0
        + wheels
        - size.get("wheel diameter", 0.0)
        + heavy * drawn["speed_scale_std"].to_numpy() * generator.standard_normal(trips)
    )
    late = generator.uniform(0.0, 0.15) + size.get("sensor delay", 0.0)
    drawn["effort_delay"] = late + heavy * drawn["effort_delay_std"] * generator.standard_normal(
        trips
    )
    drawn["noise_speed"] = 0.0096 * np.exp(0.03 * heavy * generator.standard_normal(trips))
    drawn["max_power"] = drawn["max_power"] / drawn["max_power"].median() * 2.4e6 / heavier
    hours = generator.uniform(0.0, 24.0 / max(trips_a_day, 1.0), trips)
    drawn["start"] = (
        START
        + pd.to_timedelta(day.astype(int), "D")
        + pd.to_timedelta(
            np.sort(hours) if trips_a_day < 1 else 24.0 * (day % 1.0) + 0.5 * hours / trips_a_day,
            "h",
        )
    )
    drawn["train"] = f"{kind}-{number + 1:02d}"
    drawn["trip"] = [f"{kind}-{number + 1:02d}-{trip:05d}" for trip in range(trips)]
    drawn["key"], drawn["sha256"], drawn["identity"] = drawn["trip"], "", ""
    drawn[["own_r0", "own_r1", "own_r2"]] = own
    drawn[["true_r0", "true_r1", "true_r2"]] = true
    return drawn


def _sound(variances: FloatArray) -> FloatArray:
    """Covariances without what is not positive, scaled so that units do not matter."""
    scale = np.sqrt(np.einsum("kii->ki", variances))
    values, vectors = np.linalg.eigh(variances / (scale[:, :, None] * scale[:, None, :]))
    root = vectors * np.maximum(values, 1e-9)[:, None, :] @ vectors.transpose(0, 2, 1)
    return root * (scale[:, :, None] * scale[:, None, :])


KEPT = (*COVARIANCE, *SURVEY)
