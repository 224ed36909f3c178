"""Gradients from the altitudes of rides: how well they are known, and what refuses them."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
from refusals import refused
from satellite_trips import Receiver, drive, winding

from analysis import TripRefusedError, coast_down, fit_trip, geometry_of, line_of
from estimators.altitude import OVER, Ride, height_profile
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.formats.railway import line_to_bytes, read_line, write_line
from trainlog.formats.samples import DEFAULT_LINE, sample
from trainlog.mcap import read_log
from trainlog.railway import StepProfile
from trainlog.railway.line import Survey
from trainlog.trip import LINE_ATTACHMENT, Trip

FLAT = StepProfile(np.array([0.0]), np.array([0.0]))


def hills(length: float, seed: int) -> StepProfile:
    """Gradients of up to 20 per mille over 200 to 1,500 m."""
    rng = np.random.default_rng(seed)
    edges = np.concatenate(([0.0], np.cumsum(rng.uniform(200.0, 1500.0, int(length / 800.0)))))
    edges = edges[edges < length]
    return StepProfile(edges, rng.uniform(-0.02, 0.02, edges.size))


def rides_over(
    slopes: StepProfile, length: float, count: int, seed: int, size: float = 5.0, hold: float = 60.0
) -> list[Ride]:
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
    with pytest.raises(InputError, match="2 rides with altitudes"):
        height_profile(rides_over(FLAT, 8_000.0, 2, 1), 8_000.0)
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
