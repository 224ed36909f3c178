"""Chainage and odometry against known truth: outages, reflections, wheels, close lines."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ingest_logs import HEAD, profile as table_of
from refusals import refused
from satellite_trips import (
    PACES,
    Field,
    Receiver,
    curve_of,
    drive,
    errors,
    paced,
    receive,
    streets,
    valley,
    winding,
)
from simulated_line import level_line

from estimators.motion import OdometryFilter, OdometryResult
from trainlog import Geometry, InputError, Trip, repairs_of, report_of
from trainlog.arrays import FloatArray
from trainlog.ingest import Profile, ingest, profile_of
from trainlog.ingest.chainage import Estimate, estimated_state
from trainlog.ingest.frozen import without_frozen
from trainlog.railway.geometry import nearest_on, track_of


def estimated(trip: Trip, geometry: Geometry, profile: Profile | None = None) -> Estimate:
    """As ingest does: values that freeze are no measurements."""
    level = level_line(float(geometry.positions[-1]), limit=40.0)
    line = replace(level, geometry=geometry)
    return estimated_state(without_frozen(trip)[0], line, profile or profile_of(HEAD))


def framed(trip: Trip, geometry: Geometry) -> pd.DataFrame:
    return estimated(trip, geometry).frame


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


OUTAGES = ((120.0, 180.0), (400.0, 460.0))
BURSTS = ((280.0, 305.0, 30.0 + 10.0j), (330.0, 350.0, -15.0 + 30.0j))


@pytest.mark.parametrize(
    ("receiver", "bound", "reverse"),
    [
        (Receiver(outages=OUTAGES, bursts=BURSTS), 5.0, True),
        (Receiver(rate=5.0, outages=OUTAGES, bursts=BURSTS), 5.0, False),
        (Receiver(outages=OUTAGES, bursts=BURSTS, lasting=True), 5.5, True),
        (Receiver(outages=OUTAGES, bursts=BURSTS, wheels=True), 2.0, False),
    ],
)
def test_chainage_holds_through_outages_and_reflections(receiver, bound, reverse):
    found, stds, speeds = [], [], []
    for seed in (1, 2, 3):
        trip, truth = drive(winding(), receiver, seed, reverse=reverse)
        geometry = winding()
        way = geometry.reversed(12_000.0) if reverse else geometry
        frame = framed(trip, way)
        assert np.all(np.diff(frame["position"]) >= 0.0)
        error, std = errors(frame, truth, "position")
        found.append(error)
        stds.append(std)
        speeds.append(errors(frame, truth, "speed"))
    error, std = np.concatenate(found), np.concatenate(stds)
    assert rms(error) < bound
    assert np.mean(np.abs(error) <= 1.96 * std) >= 0.90
    fast, fast_std = (np.concatenate(part) for part in zip(*speeds, strict=True))
    assert np.mean(np.abs(fast) <= 1.96 * fast_std) >= 0.90


@pytest.mark.parametrize("known", [slice(-300, None), slice(-100, None), slice(300)])
def test_fixes_count_before_the_first_speed_and_after_the_last(known):
    """They are not refused, and no place is taken from a speed of minutes away."""
    trip, truth = drive(winding(), Receiver())
    speed = trip["/gnss/motion"]["speed"]
    given = pd.Series(np.nan, speed.index)
    given.iloc[known] = speed.iloc[known]
    frame = framed(trip.with_topic(trip["/gnss/motion"].assign(speed=given)), winding())
    error, std = errors(frame, truth, "position")
    assert rms(error) < 5.0
    assert np.mean(np.abs(error) <= 1.96 * std) >= 0.90


@pytest.mark.parametrize("reverse", [False, True])
def test_a_line_that_comes_near_itself_is_followed_in_its_order(reverse):
    """At a hairpin and a loop; the nearest place would jump by kilometres."""
    track = valley()
    length = float(track.positions[-1])
    way = track.reversed(length) if reverse else track
    receiver = Receiver(noise=6.0, outages=((70.0, 110.0), (200.0, 230.0)))
    trip, truth = drive(track, receiver, 2, reverse=reverse)
    plane = track_of(way)
    fix = trip["/gnss/fix"]
    points = plane.plane(fix["latitude"].to_numpy(), fix["longitude"].to_numpy())
    nearest = nearest_on(plane, points)[0]
    at = np.interp(fix.index.as_unit("ns").asi8, truth.index.as_unit("ns").asi8, truth["position"])
    assert np.abs(nearest - at).max() > 500.0
    for given in (trip, Trip({"/gnss/fix": fix}, trip.metadata)):
        frame = framed(given, way)
        error, std = errors(frame, truth, "position")
        assert np.abs(error).max() < 60.0
        assert np.mean(np.abs(error) <= 1.96 * std) >= 0.90


def test_reflections_are_counted_and_may_be_kept():
    receiver = Receiver(bursts=((280.0, 305.0, 40.0 + 30.0j),))
    trip, truth = drive(winding(), receiver)
    careful = estimated(trip, winding())
    (finding,) = careful.findings
    assert (finding.rule, finding.column) == ("off_line", "/gnss/fix")
    assert 23 <= finding.count <= 30
    trusting = estimated(trip, winding(), profile_of({**HEAD, "repair": {"off_line": False}}))
    assert trusting.findings == ()
    assert rms(errors(careful.frame, truth, "position")[0]) < 2.0
    assert rms(errors(trusting.frame, truth, "position")[0]) > 2.0


def test_slipping_wheels_do_not_carry_the_train_away():
    receiver = Receiver(outages=((120.0, 180.0),), wheels=True)
    trip, truth = drive(winding(), receiver)
    state = trip["/train/state"].copy()
    speed = state["speed"].to_numpy(copy=True)
    for begin in (900, 1_450):  # the second within the outage
        speed[begin : begin + 30] += np.interp(np.arange(30), [0, 5, 24, 29], [0, 6.0, 6.0, 0])
    state["speed"] = speed
    slipped = Trip({**trip.topics, "/train/state": state}, trip.metadata)
    careful = estimated(slipped, winding())
    assert "slip" in {finding.rule for finding in careful.findings}
    assert rms(errors(careful.frame, truth, "position")[0]) < 2.0
    trusting = estimated(slipped, winding(), profile_of({**HEAD, "repair": {"slip": False}}))
    assert rms(errors(trusting.frame, truth, "position")[0]) > 2.0


def test_a_trip_elsewhere_or_the_other_way_is_refused():
    trip, _ = drive(winding(), Receiver(), 1)
    away = replace(winding(), latitudes=winding().latitudes + 0.1)
    refused(InputError, r"half of the \d+ fixes lie .* km or more .*; give", estimated, trip, away)
    back, _ = drive(winding(), Receiver(), 2, reverse=True)
    refused(InputError, r"from km \d.*'reverse'", estimated, back, winding())
    silent = back.with_topic(back["/gnss/motion"].assign(speed=np.nan))
    refused(InputError, "against the direction of travel", estimated, silent, winding())


def test_a_branch_is_not_the_line():
    """Four of twelve kilometres together, then apart: the trip followed the other branch."""
    s = np.arange(0.0, 12_000.0, 5.0)
    main = curve_of(np.zeros(s.size))
    bend = np.where((s > 4_000.0) & (s < 5_000.0), 1.0 / 800.0, 0.0)
    trip, _ = drive(curve_of(bend), Receiver())
    refused(InputError, "give the line that was driven", estimated, trip, main)


def test_a_line_that_lies_right_is_rarely_called_misplaced():
    """Errors of 3 m that last make few independent samples: their mean is no misfit."""
    misfits = []
    for seed in range(12):
        trip, _ = drive(winding(), Receiver(lasting=True), seed)
        misfits.append(float(estimated(trip, winding()).metadata["line.misfit"]))
    assert np.median(misfits) < 0.5
    assert np.mean(np.array(misfits) > 2.0) < 0.2
    moved = winding()
    moved = replace(moved, latitudes=moved.latitudes + np.degrees(40.0 / 6_371_000.0))
    trip, _ = drive(winding(), Receiver(lasting=True), 1)
    assert 15.0 < float(estimated(trip, moved).metadata["line.misfit"]) < 45.0


PHONE = {"noise": 8.0, "speed": "replayed", "speed_stated": 0.0}
FIELD = {
    "errors that last": Field(memory=60.0),
    "accuracies too small": Field(stated=0.2),
    "accuracies too large": Field(stated=5.0),
    "no speed": Field(noise=8.0, stated=0.0, speed="none"),
    "speed errors that last": Field(speed="lasting", speed_stated=0.5),
    "late speeds": Field(speed="late"),
    "replayed speeds": Field(noise=6.0, stated=0.5, speed="replayed", speed_stated=0.0),
    "frozen speeds": Field(speed="frozen"),
    "speeds in knots": Field(speed="wrong unit"),
    "extrapolated fixes": Field(extrapolated=8.0),
    "held fixes": Field(places="held"),
    "replayed fixes": Field(places="replayed"),
    "replayed fixes, no speed": Field(places="replayed", speed="none"),
    "held fixes, no speed": Field(places="held", speed="none"),
    "jumping fixes": Field(places="jumping"),
    "a phone that replays": Field(**PHONE, stated=0.5, places="replayed"),
    "a cold start": Field(places="cold start"),
    "a phone": Field(**PHONE, memory=60.0, stated=0.3, extrapolated=4.0),
}  # receivers with heavy-tailed errors in series of two lags, reflections and outages of minutes


@pytest.fixture(scope="module")
def field_rides() -> list[tuple[Geometry, tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    return [
        (track, paced(float(track.positions[-1]), PACES[pace], 3))
        for track, pace in ((winding(), "regional"), (valley(), "freight"), (streets(), "tram"))
    ]


def _field_cases() -> Iterator[Any]:
    """Every receiver at both intervals; by default at one of them."""
    for number, name in enumerate(FIELD):
        for interval in (1.0, 11.0):
            marks = () if (interval > 1.0) == (number % 2 > 0) else pytest.mark.long
            yield pytest.param(name, interval, marks=marks)


@pytest.mark.parametrize(("name", "interval"), list(_field_cases()))
def test_bands_hold_whatever_the_receiver_does(name, interval, field_rides):
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {"position": [], "speed": []}
    for seed, (track, run) in enumerate(field_rides):
        trip, truth = receive(track, run, replace(FIELD[name], interval=interval), 21 + seed)
        frame = framed(trip, track)
        for quantity, sums in found.items():
            sums.append(errors(frame, truth, quantity))
    for quantity, sums in found.items():
        error, std = (np.concatenate(part) for part in zip(*sums, strict=True))
        held = np.mean(np.abs(error) <= 1.96 * std)
        # Of one fix in 11 s, without a speed, not every replay is seen.
        least = 0.8 if name == "replayed fixes, no speed" and interval > 1.0 else 0.88
        assert held >= least, f"{quantity}: the band holds {held:.1%}"
        if quantity == "position":
            assert np.median(np.abs(error)) < 10.0


@pytest.mark.parametrize("interval", [0.2, 1.0, 11.0])
def test_fixes_that_are_late_are_brought_forward(interval, field_rides):
    held: list[np.ndarray] = []
    for seed, (track, run) in enumerate(field_rides):
        late = Field(interval=interval, places="late")
        trip, truth = receive(track, run, late, 21 + seed)
        found = estimated(trip, track)
        error, std = errors(found.frame, truth, "position")
        # Late by 4.5 s in the mean: by 60 to 170 m at the speeds of these trains.
        assert np.median(np.abs(error)) < 12.0
        assert abs(float(found.metadata["receiver.lateness"]) - 4.5) < 1.5
        assert any("brought forward" in finding.note for finding in found.findings)
        held.append(np.abs(error) <= 1.96 * std)
    assert np.mean(np.concatenate(held)) > 0.8


@pytest.mark.parametrize("speed", ["good", "none"])
def test_replayed_fixes_count_where_they_were_measured(speed, field_rides):
    """After 40 s without sky a receiver shows the way of these 40 s, as late, for two minutes."""
    track, run = field_rides[0]
    quiet = Field(outages=0.0, reflections=0.0, speed=speed)
    trip, truth = receive(track, run, quiet, 5)
    fix = trip["/gnss/fix"].copy()
    time = (fix.index - fix.index[0]).total_seconds().to_numpy()
    begin, lost = 150.0, 40.0
    late = (time >= begin + lost) & (time < begin + lost + 120.0)
    for name in ("latitude", "longitude"):
        values = fix[name].to_numpy(copy=True)
        values[late] = np.interp(time[late] - lost, time, values)
        fix[name] = values
    seen = (time < begin) | (time >= begin + lost)
    topics = {name: frame[seen] for name, frame in {**trip.topics, "/gnss/fix": fix}.items()}
    found = estimated(Trip(topics, trip.metadata), track)
    error, std = errors(found.frame, truth, "position")
    unseen = slice(int(begin), int(begin + lost + 120.0))
    assert np.median(np.abs(error[unseen])) < 10.0, "what was replayed shows the way"
    assert np.mean(np.abs(error) <= 1.96 * std) >= 0.9
    count = sum(f.count for f in found.findings if f.rule == "off_line")
    assert count >= 0.9 * np.count_nonzero(late)


@pytest.mark.parametrize("seed", range(6))
def test_fixes_on_time_stay(seed, field_rides):
    track, run = field_rides[seed % 3]
    speed = ("good", "lasting")[seed % 2]
    found = estimated(receive(track, run, Field(memory=60.0, speed=speed), 31 + seed)[0], track)
    assert "receiver.lateness" not in found.metadata


def test_late_speeds_and_those_in_another_unit_are_reported(field_rides):
    track, run = field_rides[0]
    quiet = Field(outages=0.0, reflections=0.0)
    late = estimated(receive(track, run, replace(quiet, speed="late"), 1)[0], track)
    assert abs(float(late.metadata["receiver.speed_delay"]) - 3.0) <= 0.5
    good = estimated(receive(track, run, quiet, 1)[0], track)
    assert "receiver.speed_delay" not in good.metadata
    assert sum(f.count for f in good.findings if f.rule == "contradicted") < 10
    knots = estimated(receive(track, run, replace(quiet, speed="wrong unit"), 1)[0], track)
    (finding,) = (f for f in knots.findings if f.rule == "contradicted")
    assert re.search(r"\b(1\.9|2\.0)\d times what positions show", finding.note)
    trusting = profile_of({**HEAD, "repair": {"contradicted": False}})
    kept = estimated(receive(track, run, replace(quiet, speed="late"), 1)[0], track, trusting)
    assert "receiver.speed_delay" not in kept.metadata


def late(trip: Trip, delay: float, *topics: str) -> Trip:
    """The trip with topics whose values arrive late on its clock."""
    shifted = {name: trip[name].copy() for name in topics}
    for frame in shifted.values():
        frame.index = pd.DatetimeIndex(frame.index) + pd.Timedelta(delay, "s")
    return Trip({**trip.topics, **shifted}, trip.metadata)


@pytest.mark.parametrize(("delay", "rate"), [(0.2, 5.0), (0.5, 1.0), (1.0, 1.0)])
def test_fixes_and_speeds_that_are_late_together_are_put_back(delay, rate):
    trip, truth = drive(winding(), Receiver(rate=rate, wheels=True), seed=3)
    estimate = estimated(late(trip, delay, "/gnss/fix", "/gnss/motion"), winding())
    found, std = (float(estimate.metadata[f"receiver.{n}"]) for n in ("delay", "delay_std"))
    assert abs(found - delay) < max(3.0 * std, 0.02)
    error, std_of_position = errors(estimate.frame, truth, "position")
    assert np.median(np.abs(error)) < 2.0
    assert np.mean(np.abs(error) < 1.96 * std_of_position) >= 0.9
    (finding,) = (f for f in estimate.findings if f.rule == "contradicted")
    assert "with the fixes" in finding.note
    uncertain = estimate.frame["position_std"] >= 0.99 * (std - 0.005) * estimate.frame["speed"]
    assert uncertain.all()


@pytest.mark.parametrize(("seed", "rate"), [(1, 5.0), (2, 1.0)])
def test_satellites_on_time_are_not_shifted(rate, seed):
    trip, _ = drive(winding(), Receiver(rate=rate, wheels=True), seed=seed)
    assert "receiver.delay" not in estimated(trip, winding()).metadata
    # Speeds that are late alone do not make the fixes late, nor do late wheels.
    alone = estimated(late(trip, 1.0, "/gnss/motion"), winding())
    assert "receiver.delay" not in alone.metadata
    wheels = estimated(late(trip, 0.5, "/train/state"), winding())
    assert "receiver.delay" not in wheels.metadata


@pytest.mark.parametrize(("rate", "wheels"), [(1.0, True), (2.0, False)])
def test_fixes_that_a_faster_table_repeats_are_used_once(rate, wheels):
    trip, truth = drive(winding(), Receiver(rate=rate, wheels=True), seed=2)
    rows = trip["/train/state"].index
    topics = {n: trip[n].reindex(rows, method="ffill") for n in ("/gnss/fix", "/gnss/motion")}
    if wheels:
        topics["/train/state"] = trip["/train/state"]
    estimate = estimated(Trip(topics, trip.metadata), winding())
    assert estimate.metadata["receiver.held_rows"] == "0.1"
    assert "receiver.held_rows" not in estimated(trip, winding()).metadata
    error, std = errors(estimate.frame, truth, "position")
    assert np.median(np.abs(error)) < 2.5
    assert np.mean(np.abs(error) < 1.96 * std) >= 0.9


def test_a_delay_that_the_trip_does_not_show_is_not_known():
    trip, _ = drive(winding(), Receiver(rate=5.0, wheels=True), seed=3)
    begin = trip.start + pd.Timedelta(80, "s")
    cruise = {n: f.loc[begin : begin + pd.Timedelta(90, "s")] for n, f in trip.topics.items()}
    metadata = estimated(Trip(cruise, trip.metadata), winding()).metadata
    assert metadata["receiver.delay"] == "not known"


def test_the_noise_of_a_receiver_is_estimated_and_not_believed(field_rides):
    track, run = field_rides[1]
    sizes = []
    for stated in (0.2, 1.0, 5.0):
        field = Field(noise=6.0, stated=stated, outages=0.0, reflections=0.0)
        metadata = estimated(receive(track, run, field, 4)[0], track).metadata
        sizes.append(float(metadata["receiver.position_std"]))
    assert np.ptp(sizes) < 1.0
    assert 4.0 < np.mean(sizes) < 8.0


@pytest.mark.parametrize("interval", [0.2, 1.0])
def test_wild_speeds_go_without_a_line_and_good_ones_stay(interval, tmp_path):
    """The truth is the drive; the receiver's speeds wander by themselves for up to a minute."""
    for number, (track, pace) in enumerate(((winding(), "regional"), (streets(), "tram"))):
        run = paced(float(track.positions[-1]), PACES[pace], 3)
        for kind in ("wild", "good"):
            trip, truth = receive(track, run, Field(speed=kind, interval=interval), 31 + number)
            frame = trip["/gnss/fix"].join(trip["/gnss/motion"]).reset_index()
            columns = ["time", "latitude", "longitude", "horizontal_accuracy", "speed"]
            path = tmp_path / "run.csv"
            frame.rename(columns={frame.columns[0]: "time"})[columns].to_csv(path, index=False)
            read = ingest(path, profile=GNSS_TABLE)
            seen, given = read["/gnss/motion"]["speed"], trip["/gnss/motion"]["speed"]
            off = [np.count_nonzero(departure(each, truth) > 3.0) for each in (seen, given)]
            raw = repairs_of(read)
            taken = 0 if raw is None else np.count_nonzero(raw["rule"] == "contradicted")
            assert taken == report_of(read).count("contradicted")
            if kind == "good":
                assert seen.count() > 0.98 * len(frame)
            else:
                assert off[0] < 0.5 * off[1]
                assert seen.count() > len(frame) - 1.5 * off[1]


def departure(speed: pd.Series, truth: pd.DataFrame) -> np.ndarray:
    """How far a speed is off [m/s]."""
    begin = truth.index.as_unit("ns").asi8[0]
    at, seconds = ((each.as_unit("ns").asi8 - begin) / 1e9 for each in (speed.index, truth.index))
    return np.abs(speed.to_numpy() - np.interp(at, seconds, truth["speed"]))


GNSS_TABLE = table_of(
    {
        "/gnss/fix.latitude": {"column": "latitude", "unit": "deg"},
        "/gnss/fix.longitude": {"column": "longitude", "unit": "deg"},
        "/gnss/fix.horizontal_accuracy": {"column": "horizontal_accuracy", "unit": "m"},
        "/gnss/motion.speed": {"column": "speed", "unit": "m/s"},
    },
    time={"column": "time"},
)


@dataclass
class Run:
    """A run between two stations and what was measured of it, 10 Hz."""

    time: FloatArray
    position: FloatArray
    speed: FloatArray
    measured: dict[str, FloatArray]

    def located(self, estimator: OdometryFilter, **changes: FloatArray) -> list[OdometryResult]:
        """What the filter gives after each sample, with some of the measurements changed."""
        columns = [{**self.measured, **changes}[name] for name in self.measured]
        return [estimator.update(*row) for row in zip(self.time, *columns, strict=True)]


def run(seed: int = 0) -> Run:
    time = np.arange(0.0, 400.0, 0.1)
    acceleration = np.interp(
        time, [0, 20, 22, 60, 64, 250, 252, 290, 292, 400], [0, 0, 0.8, 0.3, 0, 0, -0.7, -0.7, 0, 0]
    )
    gained = 0.5 * (acceleration[1:] + acceleration[:-1]) * np.diff(time)
    speed = np.maximum(np.concatenate(([0.0], np.cumsum(gained))), 0.0)
    position = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))))
    mean = np.concatenate(([0.0], np.diff(speed) / np.diff(time)))
    rng = np.random.default_rng(seed)
    wheel = (1.0 + 0.01 * rng.standard_normal()) * speed + 0.03 * rng.standard_normal(time.size)
    satellites = np.abs(speed + 0.1 * rng.standard_normal(time.size))
    passed = np.diff(position // 1_200.0, prepend=0.0) > 0.0
    return Run(
        time, position, speed,
        {
            "acceleration": mean + 0.03 * rng.standard_normal()
            + 0.02 * rng.standard_normal(time.size),
            "wheel_speed": np.where(speed > 0.0, np.maximum(wheel, 0.0), 0.0),
            "satellite_speed": np.where(np.arange(time.size) % 2, np.nan, satellites),
            "balise": np.where(passed, position + 0.5 * rng.standard_normal(time.size), np.nan),
        },
    )  # fmt: skip


def test_a_minute_without_satellites_is_bridged_and_the_deviation_grows():
    for seed in range(2):
        trip = run(seed)
        lost = (trip.time > 130.0) & (trip.time < 190.0)
        names = ("satellite_speed", "balise")
        fewer = {name: np.where(lost, np.nan, trip.measured[name]) for name in names}
        found = trip.located(OdometryFilter(), **fewer)
        first, last = np.flatnonzero(lost)[[0, -1]]
        assert found[last].position_std > found[first - 1].position_std
        assert abs(found[last].position - trip.position[last]) < 4.0 * found[last].position_std
        assert abs(found[last].speed - trip.speed[last]) < 4.0 * found[last].speed_std
        assert abs(found[last].position - trip.position[last]) < 5.0
        assert found[last].valid


@pytest.mark.parametrize("missing", ["acceleration", "wheel_speed", "satellite_speed", "balise"])
def test_deviations_are_honest_whatever_is_missing(missing):
    inside = []
    for seed in range(2):
        trip = run(seed)
        nothing = {missing: np.full(trip.time.size, np.nan)}
        found = trip.located(OdometryFilter(position_std=1.0), **nothing)
        off = np.array([[each.position, each.speed] for each in found])
        off -= np.column_stack([trip.position, trip.speed])
        std = np.array([[each.position_std, each.speed_std] for each in found])
        moving = trip.speed > 0.5
        inside.append(np.mean(np.abs(off[moving]) < 1.96 * std[moving], axis=0))
    assert np.all(np.mean(inside, axis=0) > 0.8), inside


def test_an_axle_that_locks_does_not_make_the_train_stand():
    """For 20 s all of the wheel's samples are 0 while the train runs at speed."""
    for missing in (None, "satellite_speed"):
        trip = run(1)
        locked = (trip.time > 100.0) & (trip.time < 120.0)
        changes = {"wheel_speed": np.where(locked, 0.0, trip.measured["wheel_speed"])}
        if missing:
            changes[missing] = np.full(trip.time.size, np.nan)
        found = trip.located(OdometryFilter(position_std=1.0), **changes)
        off = np.array([each.speed for each in found]) - trip.speed
        std = np.array([each.speed_std for each in found])
        assert not any(each.standing for each, slid in zip(found, locked, strict=True) if slid)
        assert np.abs(off[locked]).max() < 1.5
        assert np.mean(np.abs(off) < 3.0 * std + 0.05) > 0.9


@pytest.mark.parametrize(
    ("wrong", "missing", "within"),
    [(5.0, (), 10.0), (-8.0, (), 10.0), (5.0, ("satellite_speed",), 35.0)],
)
def test_a_filter_that_lost_the_train_follows_it_again(wrong, missing, within):
    """It begins with a wrong speed of which it is sure; all that is measured contradicts it."""
    trip = run(2)
    late = trip.time > 150.0
    begin = int(np.argmax(late))
    position, speed = float(trip.position[begin]), float(trip.speed[begin])
    estimator = OdometryFilter(position, 1.0, speed + wrong, 0.01)
    columns = [
        np.where(late, values, np.nan) if name not in missing else np.full(trip.time.size, np.nan)
        for name, values in trip.measured.items()
    ]
    rows = list(zip(trip.time, *columns, strict=True))[begin:]
    found = [estimator.update(*row) for row in rows]
    off = np.array([each.speed for each in found]) - trip.speed[begin:]
    again = trip.time[begin:] - trip.time[begin] > within
    assert np.abs(off[again]).max() < 1.0
    moving = again & (trip.speed[begin:] > 1.0)
    astray = np.array([each.position for each in found]) - trip.position[begin:]
    std = np.array([each.position_std for each in found])
    assert np.mean(np.abs(astray[moving]) <= 1.96 * std[moving]) > 0.9


def test_bad_input_is_refused():
    refused(InputError, "wheel_noise must be positive", OdometryFilter, wheel_noise=0.0)
    estimator = OdometryFilter()
    estimator.update(1.0, wheel_speed=0.0)
    refused(InputError, "time must increase, got 1", estimator.update, 1.0, wheel_speed=0.0)
