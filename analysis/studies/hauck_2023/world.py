"""The world of paper 000, section 4, as a labelled reconstruction.

The paper's map is lost. Line and stations are those of the sample line Chemnitz-Cranzahl; the
timetable and both rails are made here, from the shortest running times and from a seed.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from analysis.control.route import GRID
from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN, LeverTrain
from analysis.studies.hauck_2023.section import SMOOTHING, fastest, section_of
from trainlog.formats.line import read_line
from trainlog.formats.samples import sample
from trainlog.railway import Line, StepProfile
from trainlog.railway.condition import BIN_LENGTH
from trainlog.simulation.drivers import Stop
from trainlog.simulation.scenario import (
    base_map,
    bin_centres,
    likely_places,
    smooth_variation,
    spot,
)

FloatArray = NDArray[np.float64]

LINE = "DE_Chemnitz_Cranzahl.line.json"

RESERVE = 0.07
"""Of the timetable over the shortest running times of a reference."""

DWELL = 36.0
"""Planned at each station [s]."""

FIRST_DEPARTURE = 10.0
"""After the beginning of the trip [s]."""

BAD_MEDIAN, BAD_SPREAD, BAD_SPOTS = 0.095, 0.08, (0.055, 0.075)
"""Maximum adhesion of leaves or frost: its median, the standard deviation of its logarithm, and
what is found where it is worst. At a_max of 1 m/s² adhesion above 0.102 never binds."""


@cache
def line() -> Line:
    """The sample line Chemnitz-Cranzahl."""
    return read_line(sample(LINE))


def good_rail(track: Line, seed: int = 1) -> StepProfile:
    """The dry rail of the simulation, slippery places included."""
    return _profile(base_map(track, "dry", seed))


def bad_rail(track: Line, seed: int = 1) -> StepProfile:
    """A rail with leaves or frost, worst where the dry rail is worst, too."""
    where = np.random.default_rng([seed, 1])
    generator = np.random.default_rng([seed, 6])
    centres = bin_centres(math.ceil(track.length / BIN_LENGTH))
    logarithm = np.log(BAD_MEDIAN) + BAD_SPREAD * smooth_variation(centres.size, generator)
    for start in likely_places(track, where):
        length = where.uniform(100.0, 300.0)
        depth = generator.uniform(*BAD_SPOTS)
        logarithm = np.minimum(logarithm, spot(centres, start, length, depth))
    return _profile(np.exp(logarithm))


def timetable(
    track: Line, train: LeverTrain = PUBLISHED_TRAIN, rail: StepProfile | None = None
) -> tuple[Stop, ...]:
    """Calls at every station, in whole seconds.

    Parameters
    ----------
    track : Line
    train : LeverTrain
    rail : StepProfile, optional
        For which the times are made; default: `good_rail`.
    """
    rail = rail or good_rail(track)
    first, *others = track.stations
    stops = [Stop(first.name, first.position, 0.0, FIRST_DEPARTURE)]
    for station in others:
        before = stops[-1]
        ample = before.departure + 1e5
        to = Stop(station.name, station.position, ample, ample)
        least = fastest(section_of(track, train, rail, before, to)).duration
        arrival = before.departure + 6.0 * math.ceil(least * (1.0 + RESERVE) / 6.0)
        stops.append(Stop(station.name, station.position, arrival, arrival + DWELL))
    return tuple(stops)


def ground(track: Line) -> Line:
    """The line as a train of 40 m feels it: gradients averaged over its length, in short steps."""
    starts: FloatArray = GRID * np.arange(math.ceil(track.length / GRID), dtype=np.float64)
    middles = starts + 0.5 * GRID
    mean = track.gradients.mean(middles - SMOOTHING, middles + SMOOTHING)
    return replace(track, gradients=StepProfile(starts, mean))


def _profile(values: FloatArray) -> StepProfile:
    starts = BIN_LENGTH * np.arange(values.size, dtype=np.float64)
    return StepProfile(starts, np.minimum(values, 0.5))
