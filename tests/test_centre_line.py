"""A line from the fixes of trips: where it lies, how it bends, what it rests on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ingest_logs import HEAD
from satellite_trips import Receiver, curve_of, drive, errors, winding

from analysis.geometry.centre_line import CentreLine, geometry_of, line_of
from estimators.centre_line import CURVATURE_CHANGE, fitted_curve
from trainlog import Geometry, InputError, Trip
from trainlog.ingest import ingest_each, profile_of
from trainlog.ingest.chainage import estimated_state
from trainlog.railway.geometry import beside, nearest_on, track_of

PLAIN = profile_of(HEAD)


def trips(count: int, track: Geometry | None = None, **options: object) -> list[Trip]:
    """Trips both ways, once and five times a second, with outages at different places."""
    found = []
    for seed in range(count):
        begin = 100.0 + 47.0 * seed
        receiver = Receiver(
            rate=(1.0, 5.0)[seed % 2],
            outages=((begin, begin + 40.0),),
            bursts=((320.0, 335.0, 30.0 - 20.0j),),
            **options,
        )
        found.append(drive(track or winding(), receiver, seed, reverse=seed % 3 == 1)[0])
    return found


def of_rows(trip: Trip, rows: slice | np.ndarray) -> Trip:
    frames = {name: frame.iloc[rows] for name, frame in trip.topics.items()}
    for name, frame in frames.items():
        frame.attrs = trip[name].attrs
    return Trip(frames, trip.metadata)


@pytest.fixture(scope="module")
def centre_line() -> CentreLine:
    return geometry_of(trips(3))


def test_the_deviations_of_a_curve_are_its_errors():
    """Curves whose curvature wanders as the fit expects, seen with noise of 3 m."""
    generator = np.random.default_rng(1)
    fine = np.arange(0.0, 3_000.0, 1.0)
    seen = slice(None, None, 20)
    at = np.arange(500, 2_500, 100)
    place, bend = [], []
    for _ in range(40):
        curvature = np.cumsum(np.sqrt(CURVATURE_CHANGE) * generator.standard_normal(fine.size))
        curvature -= curvature.mean()
        beside = np.cumsum(np.cumsum(curvature))
        noise = generator.standard_normal((2, fine.size)) * 3.0
        points = (fine + noise[0] + 1j * (beside + noise[1]))[seen]
        curve, _ = fitted_curve(fine[seen], points, np.full(points.size, 3.0))
        place.append((curve.at(at).imag - beside[at]) / curve.std(at))
        second = curve.spline(at, 2).imag
        bend.append((second - curvature[at]) / curve.curvature_std(at))
    assert 0.85 < np.std(place) < 1.15
    assert 0.85 < np.std(bend) < 1.15


def test_a_line_lies_where_its_trips_ran(centre_line):
    true = track_of(winding())
    points = true.plane(centre_line.latitude, centre_line.longitude)
    error = beside(true, points, nearest_on(true, points)[0])[1]
    assert np.sqrt(np.mean(error**2)) < 1.2
    assert np.mean(np.abs(error) < 1.96 * centre_line.std) > 0.9
    assert abs(centre_line.length - 12_000.0) < 10.0
    assert centre_line.unsupported == ()
    assert centre_line.support.max() == 3
    assert centre_line.rejected > 11
    middle = (centre_line.position > 100.0) & (centre_line.position < centre_line.length - 100.0)
    true = -np.clip(3.0 * np.sin(centre_line.position / 450.0), -1.0, 1.0) / 400.0
    backwards = centre_line.latitude[0] > centre_line.latitude[-1]
    if backwards:
        true = -true[::-1]
    assert np.sqrt(np.mean((centre_line.curvature - true)[middle] ** 2)) < 0.3e-3


def test_a_further_trip_finds_its_chainage_on_the_line_built(centre_line):
    line = line_of(centre_line, "built")
    backwards = centre_line.latitude[0] > centre_line.latitude[-1]
    trip, truth = drive(winding(), Receiver(), 9, reverse=backwards)
    frame = estimated_state(trip, line, PLAIN).frame
    error, _ = errors(frame, truth, "position")
    assert np.std(error) < 5.0
    assert "gradients, stations, tunnels: not known" in line.source


def test_stretches_without_fixes_are_reported():
    """All trips are blind at the same place: a tunnel."""
    found = []
    for seed in range(3):
        trip, truth = drive(winding(), Receiver(), seed)
        at = np.interp(
            trip["/gnss/fix"].index.as_unit("ns").asi8,
            truth.index.as_unit("ns").asi8,
            truth["position"],
        )
        seen = (at < 4_000.0) | (at > 5_000.0)
        found.append(of_rows(trip, seen))
    centre_line = geometry_of(found)
    ((begin, end),) = centre_line.unsupported
    assert abs(begin - 4_200.0) < 60.0
    assert abs(end - 4_800.0) < 60.0
    inside = (centre_line.geometry.positions > begin) & (centre_line.geometry.positions < end)
    assert not inside.any()
    assert any("no fixes from km 4." in stated for stated in centre_line.notes)


def test_trips_over_parts_of_a_line_are_put_together():
    whole = [drive(winding(), Receiver(), seed)[0] for seed in range(2)]
    parts = []
    for trip, share in zip(whole, (slice(0, 0.7), slice(0.3, 1.0)), strict=True):
        count = len(trip["/gnss/fix"])
        parts.append(of_rows(trip, slice(int(share.start * count), int(share.stop * count))))
    centre_line = geometry_of(parts)
    assert abs(centre_line.length - 12_000.0) < 30.0
    assert len(centre_line.used) == 2


def test_a_trip_elsewhere_is_reported_and_not_used():
    away, _ = drive(curve_of(np.zeros(1_000), heading=2.0), Receiver(), 7)
    centre_line = geometry_of([*trips(2), away])
    assert [name for name, _ in centre_line.refused] == ["trip-07"]
    assert "m from the line that the others make" in centre_line.refused[0][1]
    assert len(centre_line.used) == 2


def test_trips_without_fixes_make_no_line():
    trip = trips(1)[0]
    with pytest.raises(InputError, match="none of the trips has satellite fixes"):
        geometry_of([Trip({"/gnss/motion": trip["/gnss/motion"]}, trip.metadata)])


AALTO = Path(__file__).parents[2] / "shared" / "data" / "aalto" / "device_data.csv"

METRO = ("007", "015", "016", "017", "024", "026", "034", "035", "036", "038", "045", "057", "077")
"""Rides on the branch of the metro that ends at Vuosaari, in both directions."""


@pytest.mark.skipif(not AALTO.is_file(), reason="the Aalto data are not here")
def test_phones_on_a_metro_make_its_line():
    """Real movement: a fix every 11 s, good to 20 m, none in the tunnels and no speed."""
    rides = {ride.name.split("-")[1]: ride for ride in ingest_each(AALTO)}
    centre_line = geometry_of([rides[number] for number in METRO])
    assert len(centre_line.used) == len(METRO)
    # Where it ends under the city is one phone's word.
    assert 14_800.0 < centre_line.length < 16_800.0
    known = centre_line.support > 0
    # No metro bends sharper than this, and none stands on its head.
    assert np.abs(centre_line.curvature[known]).max() < 1.0 / 150.0
    assert 1_000.0 < sum(end - begin for begin, end in centre_line.unsupported) < 5_000.0
    # A ride that took no part, by the phone with the best fixes.
    fix = rides["098"]["/gnss/fix"].dropna(subset=["latitude"])
    track = track_of(centre_line.geometry)
    points = track.plane(fix["latitude"].to_numpy(), fix["longitude"].to_numpy())
    assert np.median(nearest_on(track, points)[1]) < 12.0
    line = line_of(centre_line, "metro")
    backwards = centre_line.longitude[0] > centre_line.longitude[-1]
    frame = estimated_state(rides["098"], line.reversed() if backwards else line, PLAIN).frame
    assert frame["position"].iloc[-1] - frame["position"].iloc[0] > 10_000.0
    assert frame["speed"].max() < 30.0
