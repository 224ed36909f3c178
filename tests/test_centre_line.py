"""A line from the fixes of trips: where it lies, how it bends, what it rests on."""

import sys
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from ingest_logs import HEAD
from refusals import refused
from satellite_trips import Receiver, curve_of, drive, errors, winding
from scipy.integrate import solve_ivp
from simulated_line import level_line

from analysis import TripRefusedError, coast_down, fit_trip, geometry_of, line_of
from analysis.charts import draw
from analysis.geometry.centre_line import CentreLine
from estimators.centre_line import CURVATURE_CHANGE, OVER, Ride, fitted_curve, height_profile
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.formats.railway import line_to_bytes, read_line, write_line
from trainlog.formats.samples import DEFAULT_LINE, sample
from trainlog.formats.ttobench import read_track
from trainlog.ingest import ingest_each, profile_of
from trainlog.ingest.chainage import estimated_state
from trainlog.mcap import read_log
from trainlog.railway import geometry as planes
from trainlog.railway.geometry import beside
from trainlog.railway.line import CurvatureProfile, Geometry, Line, StepProfile, Survey
from trainlog.trip import LINE_ATTACHMENT, Trip

sys.path.insert(0, str(Path(__file__).parents[1] / "sample_logs"))
from make_line import Anchor, place

PLAIN = profile_of(HEAD)


def trips(count: int, track: Geometry | None = None, **options: object) -> list[Trip]:
    """Trips both ways, once and five times a second, with outages at different places."""
    found = []
    for seed in range(count):
        begin = 100.0 + 47.0 * seed
        lost, off = ((begin, begin + 40.0),), ((320.0, 335.0, 30.0 - 20.0j),)
        receiver = Receiver((1.0, 5.0)[seed % 2], outages=lost, bursts=off, **options)
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


def test_a_picture_of_equal_scales_is_drawn_without_a_warning(centre_line, tmp_path, caplog):
    draw(centre_line, tmp_path / "line.png", trips=trips(3))
    assert not caplog.records


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
    true = planes.track_of(winding())
    points = true.plane(centre_line.latitude, centre_line.longitude)
    error = beside(true, points, planes.nearest_on(true, points)[0])[1]
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
        times = (each.index.as_unit("ns").asi8 for each in (trip["/gnss/fix"], truth))
        at = np.interp(*times, truth["position"])
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


def test_a_trip_with_too_few_fixes_is_reported_and_not_used():
    first, second = trips(2)
    blind = Trip({"/gnss/motion": first["/gnss/motion"]}, first.metadata)
    refused(InputError, "none of the trips has satellite fixes", geometry_of, [blind])
    short = of_rows(second, slice(10))
    found = geometry_of([first, short])
    reason = "it has 10 satellite fixes, at least 11 are needed"
    assert (found.used, found.refused) == ((first.name,), ((second.name, reason),))
    refused(InputError, "fixes enough: 10 at most, 11 are needed", geometry_of, [short])


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
    track = planes.track_of(centre_line.geometry)
    points = track.plane(fix["latitude"].to_numpy(), fix["longitude"].to_numpy())
    assert np.median(planes.nearest_on(track, points)[1]) < 12.0
    line = line_of(centre_line, "metro")
    backwards = centre_line.longitude[0] > centre_line.longitude[-1]
    frame = estimated_state(rides["098"], line.reversed() if backwards else line, PLAIN).frame
    assert frame["position"].iloc[-1] - frame["position"].iloc[0] > 10_000.0
    assert frame["speed"].max() < 30.0


FLAT = StepProfile(np.array([0.0]), np.array([0.0]))


def hills(length: float, seed: int) -> StepProfile:
    """Gradients of up to 20 per mille over 200 to 1,500 m."""
    rng = np.random.default_rng(seed)
    edges = np.concatenate(([0.0], np.cumsum(rng.uniform(200.0, 1500.0, int(length / 800.0)))))
    edges = edges[edges < length]
    return StepProfile(edges, rng.uniform(-0.02, 0.02, edges.size))


def rides_over(slopes, length, count, seed, size=5.0, hold=60.0):
    """Rides in both directions whose altitudes wander between random levels, heavy tails too."""
    rng = np.random.default_rng(seed)
    places = np.arange(0.0, length + 5.0, 5.0)
    heights = np.concatenate(([0.0], np.cumsum(5.0 * slopes(places)[:-1])))
    rides = []
    for number in range(count):
        time = np.arange(0.0, length / rng.uniform(15.0, 30.0), 1.0)
        # A stop of a minute on the way.
        position = length * np.interp(time, [0.0, 0.4 * time[-1], 0.4 * time[-1] + 60.0, time[-1]],
                                      [0.0, 0.42, 0.42, 1.0])  # fmt: skip
        levels = size / np.sqrt(5.0 / 3.0) * rng.standard_t(5, time.size)
        turns = np.concatenate(([0.0], np.cumsum(rng.exponential(hold, time.size))))[: time.size]
        altitude = np.interp(position, places, heights) + np.interp(time, turns, levels)
        if number % 2:
            position, altitude = position[::-1], altitude[::-1]
        rides.append(Ride(time, position, altitude + rng.normal(0.0, 12.0)))
    return rides


def true_means(slopes: StepProfile, position: np.ndarray) -> np.ndarray:
    shares = (np.arange(200) + 0.5) / 200.0 - 0.5
    return slopes(position[:, None] + OVER * shares).mean(axis=1)


@pytest.mark.parametrize(
    "line",
    ["hills", *(pytest.param(line, marks=pytest.mark.long) for line in ("long hills", "level"))],
)
def test_ten_rides_give_gradients_whose_band_holds(line):
    length = 20_000.0 if line == "long hills" else 12_000.0
    errors, inside, stated = [], [], []
    for seed in range(2):
        slopes = FLAT if line == "level" else hills(length, seed)
        profile = height_profile(rides_over(slopes, length, 10, seed), length)
        error = profile.gradient - true_means(slopes, profile.position)
        errors.append(error)
        inside.append(np.abs(error) < 1.96 * profile.gradient_std)
        stated.append(profile.gradient_std)
    assert np.mean(np.concatenate(inside)) > 0.9
    rms = np.sqrt(np.mean(np.concatenate(errors) ** 2))
    assert rms < (1.6e-3 if line == "level" else 3.5e-3)
    assert rms < 1.25 * np.sqrt(np.mean(np.concatenate(stated) ** 2))


def test_altitudes_of_a_cold_start_count_as_little_as_they_are_stated_to():
    """For five minutes a receiver is hundreds of metres off and says so; the others are sound."""
    slopes, length = hills(12_000.0, 3), 12_000.0
    rng = np.random.default_rng(8)
    clean, cold = rides_over(slopes, length, 8, 3, 1.0), []
    for ride in clean:
        left = np.clip(1.0 - ride.time / 300.0, 0.0, 1.0)
        # What it states is no true size: at random two thirds to twice of it.
        stated = 4.0 + 600.0 * left * rng.uniform(0.7, 2.0, ride.time.size)
        off = rng.choice([-1.0, 1.0]) * rng.uniform(100.0, 600.0) * left
        cold.append(Ride(ride.time, ride.position, ride.altitude + off, stated))
    sound, weighed = height_profile(clean, length), height_profile(cold, length)
    blind = height_profile([Ride(r.time, r.position, r.altitude) for r in cold], length)
    error = weighed.gradient - true_means(slopes, weighed.position)
    assert weighed.sigma < 3.0 * sound.sigma < 0.2 * blind.sigma
    assert np.mean(np.abs(error) < 1.96 * weighed.gradient_std) > 0.9
    assert weighed.known.mean() > 0.9
    assert weighed.gradient_std.mean() < 0.8 * blind.gradient_std.mean()


def test_two_rides_do_not_show_how_they_err():
    two = rides_over(FLAT, 8_000.0, 2, 1)
    refused(InputError, "2 rides with altitudes", height_profile, two, 8_000.0)
    refused(InputError, "too short", height_profile, rides_over(FLAT, 800.0, 4, 1), 800.0)


def with_altitudes(trip: Trip, truth: object, slopes: StepProfile, seed: int) -> Trip:
    """The trip's fixes with altitudes that err by half a metre, for a minute or so."""
    rng = np.random.default_rng(seed)
    fix = trip["/gnss/fix"].copy()
    known = truth.index.as_unit("ns").asi8
    at = fix.index.as_unit("ns").asi8
    position = np.interp(at, known, truth["position"])
    places = np.arange(0.0, 13_000.0, 5.0)
    heights = np.concatenate(([0.0], np.cumsum(5.0 * slopes(places)[:-1])))
    time = (at - at[0]) / 1e9
    turns = np.cumsum(rng.exponential(60.0, 200))
    levels = 0.4 * rng.standard_normal(200)
    fix["altitude"] = np.interp(position, places, heights) + np.interp(time, turns, levels) + 400.0
    return trip.with_topic(fix)


@pytest.fixture(scope="module")
def rides() -> tuple[list[Trip], StepProfile]:
    slopes = hills(12_000.0, 2)
    found = []
    for seed in range(5):
        trip, truth = drive(winding(), Receiver(), seed)
        found.append(with_altitudes(trip, truth, slopes, seed))
    return found, slopes


def test_a_line_built_from_rides_has_their_gradients(rides, tmp_path):
    trips, slopes = rides
    centre_line = geometry_of(trips)
    line = line_of(centre_line, "built")
    assert "gradients" not in line.assumed
    assert line.survey.gradient_std < 1e-3
    middle = np.arange(500.0, line.length - 500.0, 250.0)
    shares = (np.arange(100) + 0.5) / 100.0 - 0.5
    found = line.gradients(middle[:, None] + OVER * shares).mean(axis=1)
    # The line begins where the first train did, in the direction of the longest trip.
    backwards = centre_line.latitude[0] > centre_line.latitude[-1]
    true = true_means(slopes, line.length - middle if backwards else middle)
    error = found - (-true if backwards else true)
    assert np.sqrt(np.mean(error**2)) < 2.5e-3
    write_line(line, tmp_path / "line.json")
    read = read_line(tmp_path / "line.json")
    # A file holds fifteen digits.
    assert astuple(read.survey) == pytest.approx(astuple(line.survey), rel=1e-14)
    assert read.assumed == line.assumed
    assert read.gradients.values == pytest.approx(line.gradients.values, abs=1e-9)
    assert centre_line.summary()["gradients"].startswith("over 500 m")


def test_without_altitudes_the_gradients_are_not_known():
    trips = [drive(winding(), Receiver(), seed)[0] for seed in range(3)]
    centre_line = geometry_of(trips)
    line = line_of(centre_line, "built")
    assert line.assumed == ("speed_limits", "stations", "gradients")
    assert centre_line.summary()["gradients"].startswith("not known")
    assert line.reversed().assumed == line.assumed


def test_what_needs_gradients_refuses_a_line_that_only_assumes_them():
    trip = read_log("sample_logs/nonstop.mcap")
    known = read_line(sample(DEFAULT_LINE))
    bare = replace(trip, attachments={**trip.attachments})
    bare.attachments[LINE_ATTACHMENT] = line_to_bytes(replace(known, assumed=("gradients",)))
    refused(NotIdentifiableError, r"the gradients of line '.*' are not known", coast_down, [bare])
    refused(TripRefusedError, r"the gradients of line '.*' are not known", fit_trip, bare)
    rough = replace(known, survey=Survey(2e-3, 500.0))
    bare.attachments[LINE_ATTACHMENT] = line_to_bytes(rough)
    refused(NotIdentifiableError, r"known to 2\.0 per mille only", coast_down, [bare])


LIBRARY = Path(__file__).parents[2] / "shared" / "data" / "ttobench"
TRACK = LIBRARY / "tracks" / "CH_StGallen_Wil.json"
needs_track = pytest.mark.skipif(not TRACK.is_file(), reason="the TTOBench library is not here")


def profile(*elements: tuple[float, float, float]) -> CurvatureProfile:
    positions, start, end = (np.array(column) for column in zip(*elements, strict=True))
    return CurvatureProfile(positions, start, end)


BEND = st.floats(-0.006, 0.006)


def line(curvatures: CurvatureProfile | None, length: float) -> Line:
    return replace(level_line(length, limit=20.0), curvatures=curvatures)


@given(st.lists(st.tuples(st.floats(5.0, 300.0), BEND, BEND), min_size=1, max_size=8))
def test_any_curve_is_exact_to_a_millimetre(elements):
    widths = np.array([element[0] for element in elements])
    starts = np.concatenate(([0.0], np.cumsum(widths)[:-1]))
    length = float(widths.sum())
    curves = CurvatureProfile(starts, *np.array(elements)[:, 1:].T)
    positions, points = planes.plane_curve(curves, length)
    assert np.all(np.diff(positions) <= 25.0 + 1e-9)
    assert set(starts) <= set(positions)
    state = np.zeros(3)
    for start, width, (_, first, last) in zip(starts, widths, elements, strict=True):

        def slope(s, y, a=first, b=last, w=width):
            return [np.sin(y[2]), np.cos(y[2]), a + (b - a) * s / w]

        reference = solve_ivp(slope, (0.0, width), state, rtol=1e-11, atol=1e-9)
        state = reference.y[:, -1]
        end = np.interp(start + width, positions, points)
        assert abs(end - complex(state[0], state[1])) < 1e-3


def test_the_plane_and_the_earth_are_inverse():
    origin = (47.4, 9.2)
    east, north = np.meshgrid(np.linspace(-3e4, 3e4, 7), np.linspace(-3e4, 3e4, 7))
    points = (east + 1j * north).ravel()
    latitudes, longitudes = planes.from_plane(points, origin)
    assert planes.to_plane(latitudes, longitudes, origin) == pytest.approx(points, abs=1e-4)


def test_a_minute_of_arc_has_its_published_length():
    """At 45 degrees on WGS 84 a degree is 111.132 km of latitude and 78.847 km of longitude."""
    half, origin = 1.0 / 120.0, (45.0, 9.0)
    north = planes.to_plane(45.0 + half, 9.0, origin) - planes.to_plane(45.0 - half, 9.0, origin)
    east = planes.to_plane(45.0, 9.0 + half, origin) - planes.to_plane(45.0, 9.0 - half, origin)
    assert complex(north) == pytest.approx(1j * 111_132.0 / 60.0, abs=0.02)
    assert complex(east) == pytest.approx(78_847.0 / 60.0, abs=0.02)


def test_a_placed_line_meets_anchors_that_agree_with_it():
    bends = profile((0.0, 0.0, 0.0), (3000.0, 0.0, 0.001), (3200.0, 0.001, 0.001))
    length, origin = 6000.0, (47.4, 9.2)
    positions, points = planes.plane_curve(bends, length)
    turned = points * np.exp(-1j * np.radians(230.0)) + (200.0 - 300.0j)
    marks = [0, positions.size // 2, positions.size - 1]
    latitudes, longitudes = planes.from_plane(turned[marks], origin)
    anchors = tuple(
        Anchor(float(positions[mark]), float(latitude), float(longitude))
        for mark, latitude, longitude in zip(marks, latitudes, longitudes, strict=True)
    )
    placed = place(line(bends, length), anchors, tolerance=0.01)
    assert placed.residuals.max() < 0.05
    assert placed.scale == pytest.approx(1.0, abs=1e-5)
    assert placed.heading == pytest.approx(230.0, abs=0.05)
    at = placed.geometry.at(positions)
    assert np.abs(planes.to_plane(*at, origin) - turned).max() < 0.02


def test_a_line_without_curvature_or_anchors_cannot_be_placed():
    anchors = (Anchor(0.0, 47.4, 9.2), Anchor(100.0, 47.4, 9.3))
    said, straight = "placing it needs curvatures and two anchors", profile((0.0, 0.0, 0.0))
    refused(InputError, said, place, line(None, 100.0), anchors)
    refused(InputError, said, place, line(straight, 100.0), anchors[:1])


ANCHORS = (
    Anchor(9_286.1, 47.41190, 9.25366),
    Anchor(14_476.1, 47.4146, 9.1872),
    Anchor(20_086.1, 47.4370, 9.1330),
    Anchor(29_556.1, 47.46250, 9.04090),
)


@needs_track
def test_positive_radii_bend_to_the_right():
    """The library's convention, confirmed: with the other sign the stations lie far off."""
    track = read_track(TRACK)
    known = track.curvatures
    bends = CurvatureProfile(known.positions, -known.start, -known.end)
    mirrored = replace(track, curvatures=bends)
    right, left = place(track, ANCHORS), place(mirrored, ANCHORS)
    assert right.residuals.max() < 300.0
    assert abs(right.scale - 1.0) < 1e-3
    assert left.residuals.max() > 1000.0
    assert abs(left.scale - 1.0) > 5e-3
