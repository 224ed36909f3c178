"""Weather files, and what they make of trips: layers, covariates, reasons."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from contents import put
from refusals import refused
from trip_parts import without

from analysis.adhesion.condition_map import empty_map
from analysis.adhesion.evidence import Evidence, evidence
from trainlog.errors import InputError, LogError
from trainlog.formats.csv_tables import read_weather, write_weather
from trainlog.formats.mapfile import read_map
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.mcap import write_log
from trainlog.railway.weather import Weather, sun_elevation
from trainlog.simulation import draw_scenarios, simulate
from trainlog.trip import Trip

pytestmark = pytest.mark.usefixtures("remembered")

HOUR = 3600 * 10**9

TRACK = empty_map(read_line(sample(DEFAULT_LINE)))
HEADER = "time [UTC],condition,temperature [degC],humidity [%],precipitation [mm/h]\n"


def when(text: str) -> int:
    return int(pd.Timestamp(text).as_unit("ns").value)


def written(folder: Path, text: str) -> Path:
    return put(folder / "weather.csv", text)


class TestFile:
    def test_rows_hold_until_the_next_one(self, tmp_path):
        rows = "2026-10-24T06:00,wet,8.5,93,1.2\n2026-10-24T07:00,dry,9,,0\n"
        weather = read_weather(written(tmp_path, HEADER + rows))
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
        path = written(tmp_path, "time [+02:00],condition\n2026-10-24T06:00,wet\n")
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
        path = written(tmp_path, text)
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
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    driven = simulate(draw_scenarios(line, train, 3, seed=1)[2])
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
