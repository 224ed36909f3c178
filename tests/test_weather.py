"""Weather files, and what they make of trips; a rail whose spots and changes depend on weather."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from contents import put
from refusals import refused
from scipy.stats import kstest
from trip_parts import without

import trainlog
from analysis.adhesion.condition_map import empty_map
from analysis.adhesion.evidence import Evidence, evidence
from analysis.truth import truth_of
from trainlog import InputError, LogError, StepProfile, Trip, read_map, read_weather, write_weather
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.mcap import write_log
from trainlog.railway.weather import Weather, sun_elevation
from trainlog.simulation import Change, Rail, draw_days, draw_scenarios, simulate
from trainlog.simulation.rail import HOUR, KINDS
from trainlog.units import DAY

pytestmark = pytest.mark.usefixtures("remembered")

LINE, TRAIN = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
TRACK = empty_map(LINE)
HEADER = "time [UTC],condition,temperature [degC],humidity [%],precipitation [mm/h]\n"


def when(text: str) -> int:
    return int(pd.Timestamp(text).as_unit("ns").value)


class TestFile:
    def test_rows_hold_until_the_next_one(self, tmp_path):
        rows = "2026-10-24T06:00,wet,8.5,93,1.2\n2026-10-24T07:00,dry,9,,0\n"
        weather = read_weather(put(tmp_path / "weather.csv", HEADER + rows))
        early = weather.at(when("2026-10-24T06:59:59Z"))
        assert early.condition == "wet"
        assert early.temperature == pytest.approx(281.65)
        assert early.humidity == pytest.approx(0.93)
        assert early.precipitation == pytest.approx(1.2e-3 / 3600.0)
        late = weather.at(when("2026-10-24T07:30Z"))
        assert (late.condition, late.since_rain) == ("dry", 1800.0)
        assert np.isnan(late.humidity)

    def test_what_is_written_is_read_again(self, tmp_path):
        generator = np.random.default_rng(3)
        starts = when("2026-10-24T06:00Z") + HOUR * np.cumsum(generator.integers(1, 5, 200))
        ends = np.minimum(starts + 3 * HOUR, np.append(starts[1:], starts[-1] + HOUR))
        weather = Weather(
            starts,
            ends,
            tuple(generator.choice(["", "dry", "wet", "leaves"], 200).tolist()),
            generator.choice([np.nan, 273.15, 281.65, 290.0], 200),
            generator.choice([np.nan, 0.5, 0.93, 1.0], 200),
            generator.choice([np.nan, 0.0, 1.2, 0.1], 200) / 3.6e6,
        )
        write_weather(weather, tmp_path / "weather.csv")
        again = read_weather(tmp_path / "weather.csv")
        for name in ("starts", "ends", "conditions"):
            assert np.array_equal(getattr(again, name), getattr(weather, name))
        for name in ("temperature", "humidity", "precipitation"):
            np.testing.assert_array_equal(getattr(again, name), getattr(weather, name))
        write_weather(again, tmp_path / "again.csv")
        assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "weather.csv").read_bytes()

    def test_a_zone_is_a_name_or_an_offset(self, tmp_path):
        path = put(tmp_path / "weather.csv", "time [+02:00],condition\n2026-10-24T06:00,wet\n")
        assert read_weather(path).starts[0] == when("2026-10-24T04:00Z")

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            (HEADER + "yesterday,wet,,,\n", r"line 2, column 'time': 'yesterday' is not a time"),
            (HEADER + "9999-12-31,wet,,,\n", r"'9999-12-31' lies too far away; give a time betw"),
            (HEADER + "2026-10-24T06,wett,,,\n", r"line 2, column 'condition': .*mean 'wet'\?"),
            (HEADER + "2026-10-24T06,Wet Rail,,,\n", r"'Wet Rail' cannot name a rail condition"),
            (HEADER + "2026-10-24T06,wet,285,,\n", r"column 'temperature': 285 degC is not plaus"),
            (HEADER + "2026-10-24T06,wet,warm,,\n", r"column 'temperature': 'warm' is not a"),
            (HEADER + "2026-10-24T07,wet,,,\n2026-10-24T06,dry,,,\n", r"line 3: '2026-10-24T06'"),
            (HEADER + ",wet,,,\n", r"line 2: has no time"),
            (HEADER, r"has no row"),
            ("time,condition\n2026-10-24T06:00,wet\n", r"has no time zone; add 'Z'"),
            ("time [Europe/Zurich],condition\n2026-10-25T02:30,wet\n", r"line 2, .* comes twice"),
            ("time [Europe/Zurich],condition\n2026-03-29T02:30,wet\n", r"does not exist or comes"),
            ("time [Narnia],condition\n2026-10-25T02:30,wet\n", r"line 1: 'Narnia' is not a time"),
            ("time [UTC],weather\n2026-10-25T02:30,wet\n", r"line 1: column 'weather' is not"),
            ("time [UTC],humidity\n2026-10-25T02:30,93\n", r"line 1.*humidity.* has no unit"),
            ("time [UTC],humidity [m]\n2026-10-25T02:30,93\n", r"line 1: .*'humidity'.*unit 'm'"),
            ("time [UTC]\n2026-10-25T02:30\n", r"line 1: needs the column 'time' and one besides"),
            (
                "time,until,condition\n2026-10-25T02Z,2026-10-25T01Z,wet\n",
                r"line 2: ends before it begins",
            ),
            (
                "time,until,condition\n2026-10-25T02Z,2026-10-25T05Z,wet\n2026-10-25T04Z,,dry\n",
                r"line 3: '2026-10-25T04Z' is before the end of the row before",
            ),
        ],
    )
    def test_a_wrong_row_is_named_by_file_and_line(self, tmp_path, text, words):
        path = put(tmp_path / "weather.csv", text)
        raised = refused(InputError, words, read_weather, path)
        assert str(path) in str(raised)


@pytest.mark.parametrize(
    ("time", "place", "elevation", "within"),
    [
        # Almanac: at noon of the solstices and the equinox, 90° less latitude plus declination.
        ("2026-06-21T12:01:50Z", (51.4779, 0.0), 61.96, 0.05),
        ("2026-12-21T11:58:00Z", (51.4779, 0.0), 15.08, 0.05),
        ("2026-03-20T18:54:00Z", (0.0, -101.6), 90.0, 0.6),
        # Declination -20.1°, equation of time 13.8 min: it is at -0.83° 4 h 32 min before and after
        # noon, which is at 11:12.
        ("2026-11-22T06:40Z", (47.37, 8.54), -0.83, 0.15),
        ("2026-11-22T15:44Z", (47.37, 8.54), -0.83, 0.15),
    ],
)
def test_the_sun_stands_where_the_almanac_says(time, place, elevation, within):
    assert sun_elevation(when(time), *place) == pytest.approx(elevation, abs=within)


@pytest.fixture(scope="module")
def trip() -> Trip:
    """A wet trip with many slips, of which the log states no weather."""
    driven = simulate(draw_scenarios(LINE, TRAIN, 3, seed=1)[2])
    stated = {name: value for name, value in driven.metadata.items() if name != "weather"}
    return replace(driven, metadata=stated)


def changing(trip: Trip, *parts: tuple[float, float, str]) -> Weather:
    """Weather by share of the trip's duration."""
    start, duration = trip.start.value, trip.duration * 1e9
    edges = [(int(start + a * duration), int(start + b * duration)) for a, b, _ in parts]
    return Weather(
        np.array([each[0] for each in edges]),
        np.array([each[1] for each in edges]),
        tuple(each[2] for each in parts),
        np.full(len(parts), 280.0),
        np.full(len(parts), 0.9),
        np.full(len(parts), 0.0),
    )


def onsets(found: Evidence) -> dict[str, float]:
    return {name: float(each.events.sum()) for name, each in found.layers.items()}


class TestTrips:
    def test_a_condition_that_changes_on_the_way_splits_the_evidence(self, trip):
        whole = evidence(trip, TRACK, layer="wet").daily
        weather = changing(trip, (-1.0, 0.4, "wet"), (0.4, 2.0, "dry"))
        found = evidence(trip, TRACK, weather=weather)
        assert found.layer == "dry"
        assert set(found.layers) == {"dry", "wet"}
        assert sum(onsets(found).values()) == whole.events.sum()
        assert min(onsets(found).values()) > 0.0
        # The train ran forward: what was seen in the wet lies before what was seen in the dry.
        wet, dry = found.layers["wet"], found.layers["dry"]
        assert wet.used_bin.max() <= dry.used_bin.min() + 1
        total = wet.censored.sum() + dry.censored.sum()
        assert abs(total - whole.censored.sum()) <= 2.0

    def test_what_was_seen_while_nothing_is_known_is_left_out_with_a_note(self, trip):
        weather = changing(trip, (-1.0, 0.5, "wet"), (0.6, 2.0, "wet"))
        found = evidence(trip, TRACK, weather=weather)
        assert any("rail condition not known for" in note for note in found.details["notes"])
        used = evidence(trip, TRACK, layer="wet").daily.censored.sum()
        assert 0.6 * used < found.daily.censored.sum() < used - 10.0

    def test_a_trip_of_which_nothing_is_known_is_refused(self, trip):
        with pytest.raises(LogError, match=r"states no rail condition from 2024-10-07 08:\d\d to"):
            evidence(trip, TRACK, weather=changing(trip, (-3.0, -1.0, "wet")))
        refused(LogError, r"does not state .* a weather file \(--weather\)", evidence, trip, TRACK)

    def test_the_layer_given_comes_first_then_the_log_then_the_weather(self, trip):
        weather = changing(trip, (-1.0, 2.0, "leaves"))
        stated = replace(trip, metadata={**trip.metadata, "weather": "wet"})
        assert evidence(stated, TRACK, layer="frost", weather=weather).layer == "frost"
        found = evidence(stated, TRACK, weather=weather)
        assert found.layer == "wet"
        assert found.details["weather"]["condition"] == "leaves"

    def test_covariates_are_kept_with_the_evidence(self, trip):
        weather = changing(trip, (-1.0, 2.0, "wet"))
        measured = trip["/environment"]["air_temperature"].mean()
        kept = evidence(trip, TRACK, weather=weather).details["weather"]
        assert kept["temperature"] == pytest.approx(measured, abs=0.01)
        assert (kept["temperature_source"], kept["humidity"]) == ("log", 0.9)
        assert (kept["condition"], kept["precipitation"]) == ("wet", 0.0)
        unmeasured = without(trip, "/environment")
        kept = evidence(unmeasured, TRACK, weather=weather).details["weather"]
        assert (kept["temperature"], kept["temperature_source"]) == (280.0, "weather")
        # Between 8 and 9 in October in eastern Switzerland the sun is low, but up.
        assert 10.0 < kept["sun_elevation"] < 35.0


def test_the_command_takes_a_weather_file(trip, tmp_path, shell, works):
    write_log(trip, tmp_path / "trip.mcap")
    weather, condition = tmp_path / "weather.csv", tmp_path / "wil.map"
    write_weather(changing(trip, (-1.0, 0.4, "leaves"), (0.4, 2.0, "dry")), weather)
    given = ["map", "update", tmp_path / "trip.mcap", "--map", condition]
    status, _, complaint = shell(*given)
    assert status == 2
    assert "does not state the rail's condition" in complaint
    assert not condition.exists()
    works(*given, "--weather", weather)
    track = read_map(condition)
    assert sorted(track.layers) == ["dry", "leaves"]
    assert track.trips[0]["weather"]["humidity"] == 0.9


@pytest.fixture(scope="module")
def rail() -> Rail:
    return Rail.draw(LINE, days=40, start="2026-10-10", seed=2)


@pytest.fixture(scope="module")
def few() -> Rail:
    """Six days, as many as trips are drawn of."""
    return Rail.draw(LINE, days=6, start="2026-10-20", seed=2)


def without_rain(rail: Rail) -> Rail:
    table = replace(rail.drawn.table, precipitation=np.zeros(rail.drawn.table.starts.size))
    return replace(rail, drawn=replace(rail.drawn, table=table))


class TestRail:
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
    def test_lives_are_lognormal_with_the_median_that_is_stated(self, kind):
        spots = [Rail.draw(LINE, 40, "2026-10-10", seed).spots for seed in range(6)]
        lives = pd.concat([each[each["kind"] == kind] for each in spots])["life"] / 3600.0
        median, spread, shortest, longest = KINDS[kind].life
        assert lives.min() >= shortest
        assert lives.max() <= longest
        inside = lives[(lives > shortest) & (lives < longest)]
        assert inside.size > 100
        assert np.median(lives) == pytest.approx(median, rel=0.35)
        scores = np.log(inside / median) / spread
        assert kstest(scores, "norm").pvalue > 1e-3

    def test_leaves_fall_in_autumn_and_frost_comes_in_cold_nights(self):
        summer = Rail.draw(LINE, 30, "2026-06-15", 3)
        assert set(summer.spots["kind"]) == {"contamination"}
        winter = Rail.draw(LINE, 60, "2026-11-20", 3)
        frost = winter.spots[winter.spots["kind"] == "frost"]
        assert len(frost) > 20
        rows = winter.drawn.table.row_at(frost["birth"].to_numpy())
        assert (winter.drawn.table.temperature[rows] < 274.15).all()

    def test_the_same_seed_draws_the_same_rail(self, rail):
        again = Rail.draw(LINE, days=40, start="2026-10-10", seed=2)
        pd.testing.assert_frame_equal(rail.spots, again.spots)
        time = rail.start + 5 * DAY + 7 * HOUR
        assert rail.profile(time, 3) == again.profile(time, 3)
        assert rail.profile(time, 3) != rail.profile(time, 4)
        other = Rail.draw(LINE, days=40, start="2026-10-10", seed=3)
        assert rail.profile(time, 3) != other.profile(time, 3)

    def test_adhesion_in_the_section_is_changed_from_the_date_on(self):
        change = Change(10e3, 14e3, when("2026-10-20T02:00Z"), factor=0.7)
        rail = Rail.draw(LINE, 30, "2026-10-10", 2, [change])
        for name in rail.base:
            before = rail.lasting(name, change.time - 1).values
            after = rail.lasting(name, change.time).values
            centres = 10.0 * np.arange(before.size) + 5.0
            inside = (centres > 10e3) & (centres < 14e3)
            np.testing.assert_allclose(after[inside] / before[inside], 0.7)
            assert np.array_equal(after[~inside], before[~inside])

    def test_passing_spots_come_more_or_less_often_afterwards(self):
        def share(births: float) -> float:
            change = Change(0.0, 15e3, when("2026-10-25T00Z"), births=births)
            before = after = 0
            for seed in range(4):
                spots = Rail.draw(LINE, 30, "2026-10-10", seed, [change]).spots
                inside = spots[spots["start"] < 15e3]["birth"]
                after += int((inside >= change.time).sum())
                before += int((inside < change.time).sum())
            return after / before

        assert share(0.0) == 0.0
        assert 0.0 < share(0.3) < 0.7 * share(1.0)
        assert share(4.0) > 2.0 * share(1.0)

    def test_trains_run_from_five_to_eleven_on_every_day(self, few):
        trips = draw_days(few, [TRAIN], 7)
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
        scenario = draw_days(few, [TRAIN], 2)[11]
        truth = truth_of(simulate(scenario))
        assert truth.lasting_adhesion == few.lasting(scenario.weather, scenario.start)
        assert truth.maximum_adhesion == few.profile(scenario.start, 11)
        assert truth.weather == few.weather(scenario.start).condition


def test_what_cannot_be_drawn_is_refused(few):
    days = (LINE, 30, "2026-10-10", 1)
    for words, call, given in (
        ("is not one of the days drawn", few.weather, (few.start + 50 * DAY,)),
        ("rail condition 'snow' is unknown", few.lasting, ("snow", few.start)),
        (
            "ends at km 29.556",
            Rail.draw,
            (*days, [Change(10e3, 40e3, when("2026-10-15T00Z"), 1.3)]),
        ),
        (
            "not one of the days sim",
            Rail.draw,
            (*days, [Change(1e3, 4e3, when("2026-11-15T00Z"), 1.3)]),
        ),
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


def test_a_rail_without_stations_or_spots_is_drawn():
    """An edge of a network may be a hundred metres of track between two switches."""
    short = replace(LINE.section(12_000.0, 12_100.0), stations=())
    drawn = [Rail.draw(short, days=2, start="2026-06-15", seed=seed) for seed in range(5)]
    assert min(len(each.spots) for each in drawn) == 0
    assert all((each.spots["start"] <= 100.0).all() for each in drawn)
    assert {tuple(each.spots.columns) for each in drawn} == {tuple(drawn[0].spots.columns)}
