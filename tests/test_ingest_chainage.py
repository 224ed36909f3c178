"""Satellite fixes become chainage on the line's geometry, with honest standard deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from foreign_recorders import write_ublox_csv
from hypothesis import given, settings, strategies as st
from refusals import refused
from simulated_line import flirt, hilly_line

from trainlog.errors import InputError
from trainlog.ingest import ingest
from trainlog.ingest.chainage import chainage_of
from trainlog.ingest.receiver import Fixes
from trainlog.railway import Geometry, Line
from trainlog.railway.geometry import nearest_on, track_of
from trainlog.simulation import draw_scenarios, simulate

METRES_PER_DEGREE = 111_177.0
"""Length of a degree of latitude at 47° north [m]."""


def winding(length: float = 11_000.0) -> Geometry:
    """A track of bends, drawn true to scale around 47° north."""
    position = np.arange(0.0, length + 1.0, 20.0)
    heading = 1.2 * np.sin(position / 900.0)
    east = np.concatenate([[0.0], np.cumsum(20.0 * np.cos(heading[:-1]))])
    north = np.concatenate([[0.0], np.cumsum(20.0 * np.sin(heading[:-1]))])
    scale = METRES_PER_DEGREE * np.cos(np.radians(47.0))
    return Geometry(position, 47.0 + north / METRES_PER_DEGREE, 9.0 + east / scale, "made up")


LINE = replace(hilly_line(), geometry=winding())
TRAIN = flirt()


def fixes(seconds: np.ndarray, position: np.ndarray, speed: np.ndarray) -> Fixes:
    latitude, longitude = winding().at(position)
    ones = np.ones(seconds.size)
    index = pd.DatetimeIndex((seconds * 1e9).astype("int64"), tz="UTC")
    return Fixes(index, seconds, latitude, longitude, 2.0 * ones, speed, 0.1 * ones)


@settings(max_examples=40)
@given(st.lists(st.floats(0.0, 11_000.0), min_size=1, max_size=50), st.floats(-30.0, 30.0))
def test_points_beside_the_track_find_their_chainage(at: list[float], beside: float) -> None:
    """Radii are 750 m and more: a point 30 m beside lies nearest to where it was put."""
    geometry = winding()
    position = np.array(at)
    latitude, longitude = geometry.at(position)
    behind, ahead = geometry.at(position - 0.5), geometry.at(position + 0.5)
    north, east = (
        (ahead[0] - behind[0]) * METRES_PER_DEGREE,
        (ahead[1] - behind[1]) * METRES_PER_DEGREE * np.cos(np.radians(47.0)),
    )
    size = np.hypot(north, east)
    inside = (position > 1.0) & (position < 10_999.0)
    latitude = latitude + beside * east / size / METRES_PER_DEGREE
    longitude = longitude - beside * north / size / METRES_PER_DEGREE / np.cos(np.radians(47.0))
    track = track_of(geometry)
    chainage, distance = nearest_on(track, track.plane(latitude, longitude))
    # The polygon's corners, 20 m apart, and the plain projection cost a little.
    assert np.all(np.abs(chainage - position)[inside] < 0.1 + 0.03 * abs(beside))
    assert np.all(np.abs(distance - abs(beside))[inside] < 0.2 + 0.03 * abs(beside))


def test_a_trip_elsewhere_is_refused() -> None:
    seconds = np.arange(0.0, 100.0)
    away = fixes(seconds, 20.0 * seconds, np.full(100, 20.0))
    away = replace(away, latitude=away.latitude + 0.1)
    with pytest.raises(InputError, match=r"half of the 100 fixes lie 9\.9 km or more .*; give"):
        chainage_of(winding(), away)


def test_a_trip_the_other_way_is_refused() -> None:
    seconds = np.arange(0.0, 100.0)
    back = fixes(seconds, 5_000.0 - 20.0 * seconds, np.full(100, 20.0))
    refused(InputError, r"from km 5\.000 to km 3\.020.*'reverse'", chainage_of, winding(), back)
    silent = replace(back, speed=np.full(100, np.nan))
    refused(InputError, "against the direction of travel", chainage_of, winding(), silent)


@pytest.fixture(scope="module", params=["forward", "reverse"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple:
    """A simulated trip, and the same trip from the receiver's CSV."""
    line: Line = LINE
    scenario = replace(draw_scenarios(line, TRAIN, 1, 3)[0], direction=request.param)
    driven = simulate(scenario)
    path = tmp_path_factory.mktemp("gnss") / "gnss.csv"
    write_ublox_csv(driven, path)
    return driven, ingest(path, line=line, train=TRAIN, direction=request.param)
