"""A rail over days: spots live and fade as drawn, seasons and weather matter, changes last."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from refusals import refused
from scipy.stats import kstest

import trainlog
from analysis.truth import truth_of
from trainlog.errors import InputError
from trainlog.formats.csv_tables import read_weather
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.railway import Line, StepProfile
from trainlog.simulation import Change, Rail, draw_days, simulate
from trainlog.simulation.rail import HOUR, KINDS
from trainlog.units import DAY


@pytest.fixture(scope="module")
def line() -> Line:
    return read_line(sample(DEFAULT_LINE))


@pytest.fixture(scope="module")
def rail(line: Line) -> Rail:
    return Rail.draw(line, days=40, start="2026-10-10", seed=2)


@pytest.fixture(scope="module")
def few(line: Line) -> Rail:
    """Six days, as many as trips are drawn of."""
    return Rail.draw(line, days=6, start="2026-10-20", seed=2)


def at(text: str) -> int:
    return int(pd.Timestamp(text, tz="UTC").as_unit("ns").value)


def without_rain(rail: Rail) -> Rail:
    table = replace(rail.drawn.table, precipitation=np.zeros(rail.drawn.table.starts.size))
    return replace(rail, drawn=replace(rail.drawn, table=table))


class TestSpots:
    def test_half_of_a_spot_is_left_after_its_life_and_little_long_after(self, rail):
        dry = without_rain(rail)
        for number, spot in dry.spots.iloc[::25].iterrows():
            life = int(spot["life"] * 1e9)
            shares = [
                dry.left(int(spot["birth"]) + age)[number]
                for age in (-1, 0, life // 4, life, 4 * life)
            ]
            assert shares[0] == 0.0
            assert shares[1] == 1.0
            assert shares[3] == pytest.approx(0.5, abs=1e-6)
            # It holds at first, then falls: not as an exponential, of which 0.84 and 0.06 are left.
            assert shares[2] == pytest.approx(1.0 / (1.0 + 4.0 ** -spot["sharpness"]), abs=1e-6)
            assert shares[2] > 0.92
            assert shares[4] < 0.08

    def test_rain_shortens_the_life_of_what_it_washes_off(self, rail):
        rainy = np.flatnonzero(rail.drawn.table.precipitation > 0.0)
        after = int(rail.drawn.table.ends[rainy[rainy.size // 2]]) + 3 * HOUR
        wet, dry = rail.left(after), without_rain(rail).left(after)
        washed = (rail.spots["wash"] > 0.0).to_numpy() & (dry > 0.0)
        assert np.all(wet <= dry)
        assert np.any(wet[washed] < dry[washed] - 0.05)
        lasts = (rail.spots["kind"] == "frost").to_numpy()
        assert np.array_equal(wet[lasts], dry[lasts])

    @pytest.mark.parametrize("kind", ["leaves", "contamination"])
    def test_lives_are_lognormal_with_the_median_that_is_stated(self, line, kind):
        spots = [Rail.draw(line, 40, "2026-10-10", seed).spots for seed in range(6)]
        lives = pd.concat([each[each["kind"] == kind] for each in spots])["life"] / 3600.0
        median, spread, shortest, longest = KINDS[kind].life
        assert lives.min() >= shortest
        assert lives.max() <= longest
        inside = lives[(lives > shortest) & (lives < longest)]
        assert inside.size > 100
        assert np.median(lives) == pytest.approx(median, rel=0.35)
        scores = np.log(inside / median) / spread
        assert kstest(scores, "norm").pvalue > 1e-3

    def test_leaves_fall_in_autumn_and_frost_comes_in_cold_nights(self, line):
        summer = Rail.draw(line, 30, "2026-06-15", 3)
        assert set(summer.spots["kind"]) == {"contamination"}
        winter = Rail.draw(line, 60, "2026-11-20", 3)
        frost = winter.spots[winter.spots["kind"] == "frost"]
        assert len(frost) > 20
        rows = winter.drawn.table.row_at(frost["birth"].to_numpy())
        assert (winter.drawn.table.temperature[rows] < 274.15).all()


class TestRail:
    def test_the_same_seed_draws_the_same_rail(self, line, rail):
        again = Rail.draw(line, days=40, start="2026-10-10", seed=2)
        pd.testing.assert_frame_equal(rail.spots, again.spots)
        time = rail.start + 5 * DAY + 7 * HOUR
        assert rail.profile(time, 3) == again.profile(time, 3)
        assert rail.profile(time, 3) != rail.profile(time, 4)
        other = Rail.draw(line, days=40, start="2026-10-10", seed=3)
        assert rail.profile(time, 3) != other.profile(time, 3)


class TestChanges:
    def test_adhesion_in_the_section_is_changed_from_the_date_on(self, line):
        change = Change(10e3, 14e3, at("2026-10-20T02:00"), factor=0.7)
        rail = Rail.draw(line, 30, "2026-10-10", 2, [change])
        for name in rail.base:
            before = rail.lasting(name, change.time - 1).values
            after = rail.lasting(name, change.time).values
            centres = 10.0 * np.arange(before.size) + 5.0
            inside = (centres > 10e3) & (centres < 14e3)
            np.testing.assert_allclose(after[inside] / before[inside], 0.7)
            assert np.array_equal(after[~inside], before[~inside])

    def test_passing_spots_come_more_or_less_often_afterwards(self, line):
        def share(births: float) -> float:
            change = Change(0.0, 15e3, at("2026-10-25"), births=births)
            before = after = 0
            for seed in range(4):
                spots = Rail.draw(line, 30, "2026-10-10", seed, [change]).spots
                inside = spots[spots["start"] < 15e3]["birth"]
                after += int((inside >= change.time).sum())
                before += int((inside < change.time).sum())
            return after / before

        assert share(0.0) == 0.0
        assert 0.0 < share(0.3) < 0.7 * share(1.0)
        assert share(4.0) > 2.0 * share(1.0)


class TestTrips:
    def test_trains_run_from_five_to_eleven_on_every_day(self, few):
        trips = draw_days(few, [read_train(sample(DEFAULT_TRAIN))], 7)
        assert len(trips) == len({trip.name for trip in trips}) == 42
        starts = pd.DatetimeIndex([trip.start for trip in trips])
        assert starts.is_monotonic_increasing
        hours = (starts - starts.normalize()) / pd.Timedelta(hours=1)
        assert hours.min() >= 5.0
        assert hours.max() <= 23.0
        assert (pd.Series(starts.normalize()).value_counts() == 7).all()
        assert {trip.direction for trip in trips} == {"forward", "reverse"}
        for trip in trips:
            assert trip.weather == few.weather(trip.start).condition

    def test_the_log_carries_what_the_trip_met_and_what_lasts(self, few):
        scenario = draw_days(few, [read_train(sample(DEFAULT_TRAIN))], 2)[11]
        truth = truth_of(simulate(scenario))
        assert truth.lasting_adhesion == few.lasting(scenario.weather, scenario.start)
        assert truth.maximum_adhesion == few.profile(scenario.start, 11)
        assert truth.weather == few.weather(scenario.start).condition


def test_what_cannot_be_drawn_is_refused(line, few):
    days = (line, 30, "2026-10-10", 1)
    for words, call, given in (
        ("is not one of the days drawn", few.weather, (few.start + 50 * DAY,)),
        ("rail condition 'snow' is unknown", few.lasting, ("snow", few.start)),
        ("ends at km 29.556", Rail.draw, (*days, [Change(10e3, 40e3, at("2026-10-15"), 1.3)])),
        ("not one of the days sim", Rail.draw, (*days, [Change(1e3, 4e3, at("2026-11-15"), 1.3)])),
        ("ends after it starts", Change, (5e3, 4e3, 0)),
        ("factor 130 is not between", Change, (4e3, 5e3, 0, 130.0)),
        ("births -1 is not", Change, (4e3, 5e3, 0, 1.0, -1.0)),
        ("cannot draw 0 trips a day of 1 train", draw_days, (few, [0], 0)),
        ("of 0 trains", draw_days, (few, [], 4)),
    ):
        refused(InputError, words, call, *given)


SAMPLES = ("--line", "sample", "--train", "sample")


class TestCommand:
    def test_days_are_simulated_with_their_weather(self, tmp_path, shell):
        given = ["simulate", "days", *SAMPLES, "--days", "1", "--trips-per-day", "1"]
        change = ["--start", "2026-10-20", "--change", "km=10:14,date=2026-10-20,factor=0.5"]
        for folder in ("first", "second"):
            assert shell(*given, *change, "-o", tmp_path / folder)[0] == 0
        files = sorted(path.name for path in (tmp_path / "first").iterdir())
        assert len(files) == 2
        assert files[-1] == "weather.csv"
        for name in files:
            same = (tmp_path / "first" / name).read_bytes()
            assert same == (tmp_path / "second" / name).read_bytes()
        weather = read_weather(tmp_path / "first" / "weather.csv")
        for name in files[:-1]:
            trip = trainlog.read(tmp_path / "first" / name, topics=[])
            there = weather.at(pd.Timestamp(trip.metadata["start"]).value)
            assert there.condition == trip.metadata["weather"]

    def test_a_train_that_is_stopped_for_good_does_not_end_the_month(
        self, tmp_path, monkeypatch, shell
    ):
        slippery = Rail.lasting

        def met(rail: Rail, condition: str, time: int) -> StepProfile:
            found = slippery(rail, condition, time)
            evening = time % DAY > 12 * HOUR
            return StepProfile(found.positions, found.values * (0.02 if evening else 1.0))

        monkeypatch.setattr(Rail, "lasting", met)
        given = ["simulate", "days", *SAMPLES, "--days", "1", "--trips-per-day", "2"]
        status, _, complaint = shell(*given, "-o", tmp_path)
        assert status == 1
        assert "the train does not arrive" in complaint
        assert len(list(tmp_path.glob("*.mcap"))) == 1
        assert (tmp_path / "weather.csv").exists()


def test_a_rail_without_stations_or_spots_is_drawn(line):
    """An edge of a network may be a hundred metres of track between two switches."""
    short = replace(line.section(12_000.0, 12_100.0), stations=())
    drawn = [Rail.draw(short, days=2, start="2026-06-15", seed=seed) for seed in range(5)]
    assert min(len(each.spots) for each in drawn) == 0
    assert all((each.spots["start"] <= 100.0).all() for each in drawn)
    assert {tuple(each.spots.columns) for each in drawn} == {tuple(drawn[0].spots.columns)}
