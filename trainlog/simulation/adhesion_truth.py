"""The true maximum adhesion of simulated lines: where rails are good, wet, and slippery.

A base map belongs to the line and the weather and stays from trip to trip; every trip adds a
little variation and a few slippery spots of its own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trainlog.railway import Line, StepProfile
from trainlog.railway.condition import BIN_LENGTH

FloatArray = NDArray[np.float64]

CORRELATION_LENGTH = 120.0
"""Distance over which adhesion varies [m] (Ornstein-Uhlenbeck)."""

BASE = {"dry": (0.325, 0.04), "wet": (0.175, 0.08)}
"""Median of the base map and standard deviation of its logarithm, by weather."""

SPOTS = {"dry": (0.1, 0.16), "wet": (0.06, 0.12)}
"""Range of the maximum adhesion in slippery spots, by weather."""


def bin_centres(count: int) -> FloatArray:
    """Centres [m] of the first `count` bins of a line."""
    return np.asarray((np.arange(count) + 0.5) * BIN_LENGTH, dtype=np.float64)


def smooth_variation(count: int, generator: np.random.Generator) -> FloatArray:
    """Ornstein-Uhlenbeck process of unit variance over `count` bins."""
    from scipy.signal import lfilter

    keep = np.exp(-BIN_LENGTH / CORRELATION_LENGTH)
    white = generator.standard_normal(count)
    white[1:] *= np.sqrt(1.0 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white))


def spot(centres: FloatArray, start: float, length: float, depth: float) -> FloatArray:
    """Upper bound of the logarithm of adhesion that a spot imposes; its ends fade over 50 m."""
    outside = np.maximum(np.maximum(start - centres, centres - (start + length)), 0.0)
    return np.asarray(np.where(outside < 75.0, np.log(depth) + outside / 50.0, np.inf))


def likely_places(line: Line, generator: np.random.Generator) -> FloatArray:
    """Where persistent spots begin [m]: around the stations and on the climbs.

    Each station has one or more on either side, where trains brake and leave; some climbs have one.
    """
    around = [
        station.position + side * generator.uniform(100.0, 550.0)
        for station in line.stations
        for side in (-1.0, -1.0, 1.0, 1.0)
        if generator.uniform() < 0.4
    ]
    edges, slopes = line.gradients.positions, line.gradients.values
    climbs = edges[(np.abs(slopes) > 0.008) & (generator.uniform(size=edges.size) < 0.08)]
    places = np.concatenate((np.array(around), climbs + generator.uniform(0.0, 200.0, climbs.size)))
    return places[(places > 50.0) & (places < line.length - 350.0)]


def base_map(line: Line, weather: str, seed: int) -> FloatArray:
    """Maximum adhesion a bin of the line that every trip in that weather meets.

    Parameters
    ----------
    line : Line
        In its own direction.
    weather : {"dry", "wet"}
    seed : int

    Returns
    -------
    (bins,) array
    """
    # The same places are slippery in the dry and in the wet, more so in the wet.
    where = np.random.default_rng([seed, 1])
    generator = np.random.default_rng([seed, 2, sorted(BASE).index(weather)])
    centres = bin_centres(int(np.ceil(line.length / BIN_LENGTH)))
    median, spread = BASE[weather]
    logarithm = np.log(median) + spread * smooth_variation(centres.size, generator)
    for start in likely_places(line, where):
        length = where.uniform(100.0, 300.0)
        depth = generator.uniform(*SPOTS[weather])
        logarithm = np.minimum(logarithm, spot(centres, start, length, depth))
    return np.asarray(np.exp(logarithm))


def trip_profile(
    line: Line, base: FloatArray, weather: str, generator: np.random.Generator
) -> StepProfile:
    """The base map as one trip meets it: 4 % of variation and now and then a new spot.

    Returns
    -------
    StepProfile
        In the line's own direction.
    """
    centres = bin_centres(base.size)
    logarithm = np.log(base) + 0.04 * smooth_variation(base.size, generator)
    for _ in range(int(generator.poisson(2.0 if weather == "wet" else 0.5))):
        start = generator.uniform(0.0, line.length)
        length = generator.uniform(50.0, 150.0)
        depth = generator.uniform(*SPOTS[weather])
        logarithm = np.minimum(logarithm, spot(centres, start, length, depth))
    edges = centres - 0.5 * BIN_LENGTH
    return StepProfile(edges, np.asarray(np.minimum(np.exp(logarithm), 0.5)))
