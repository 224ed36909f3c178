"""What is given beside a recording, or counted in it, and contradicts its satellite fixes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from contents import put
from ingest_logs import plain_profile
from refusals import refused
from satellite_trips import winding
from scipy.integrate import cumulative_trapezoid
from simulated_line import flirt, hilly_line

import trainlog
from trainlog import (
    InputError,
    Trip,
    draw_scenarios,
    read_line,
    repairs_of,
    report_of,
    sample,
    simulate,
)
from trainlog.cli.options import pairs
from trainlog.ingest import Profile, ingest, ingest_all, propose_profile

LINE, TRAIN = replace(hilly_line(), geometry=winding(11_000.0)), flirt()
POSITION = "/train/state.position"
COLUMNS = {
    POSITION: {"column": "s", "unit": "m"},
    "/train/state.speed": {"column": "v", "unit": "m/s"},
    "/gnss/fix.latitude": {"column": "lat", "unit": "deg"},
    "/gnss/fix.longitude": {"column": "lon", "unit": "deg"},
    "/gnss/fix.horizontal_accuracy": {"column": "acc", "unit": "m"},
}


def profile(**sections: object) -> Profile:
    return plain_profile(columns=COLUMNS, **sections)


@pytest.fixture(scope="module", params=["forward", "reverse"])
def driven(request: pytest.FixtureRequest) -> Trip:
    return simulate(replace(draw_scenarios(LINE, TRAIN, 1, 4)[0], direction=request.param))


def recorded(
    trip: Trip, folder: Path, counted: Callable[[np.ndarray], np.ndarray] = np.asarray
) -> Path:
    """What a recorder with odometer and receiver writes, two rows a second."""
    state = trip["/train/state"].iloc[::5]
    near = {"method": "nearest", "tolerance": pd.Timedelta("60ms")}
    fix = trip["/gnss/fix"].reindex(state.index, **near)
    table = {
        "t": state.index.strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
        "v": state["speed"],
        "s": counted(state["position"].to_numpy()),
        "lat": fix["latitude"],
        "lon": fix["longitude"],
        "acc": fix["horizontal_accuracy"],
    }
    path = folder / "run.csv"
    pd.DataFrame(table).to_csv(path, index=False)
    return path


def error_of(trip: Trip, truth: Trip) -> pd.Series:
    position = trip["/train/state"]["position"]
    return position - truth["/truth"]["position"].reindex(position.index)


@pytest.mark.parametrize(
    ("driven", "offset"),
    [("forward", 7_000.0), ("reverse", -7_000.0), ("forward", 150.0)],
    indirect=["driven"],
)
def test_a_constant_offset_of_the_odometer_is_put_back(driven, tmp_path, offset):
    """At +7 km the positions would run beyond the line's end; at -7 km they would be negative."""
    path = recorded(driven, tmp_path, lambda position: position + offset)
    trip = ingest(path, profile(), line=LINE, train=TRAIN)
    assert error_of(trip, driven).abs().max() < 20.0
    (found,) = (each for each in report_of(trip).findings if each.rule == "position_offset")
    assert found.count == len(trip["/train/state"])
    assert found.column == POSITION
    kilometres = float(found.note.split("was ")[1].split(" km")[0])
    assert kilometres == pytest.approx(abs(offset) / 1e3, abs=0.02)
    raw = repairs_of(trip).query("rule == 'position_offset'")
    assert len(raw) == found.count
    assert np.allclose(raw["raw_value"] - raw["new_value"], offset, atol=20.0)


def test_drift_of_an_odometer_is_left(driven, tmp_path):
    path = recorded(driven, tmp_path, lambda position: 1.004 * position)
    assert report_of(ingest(path, profile(), line=LINE)).count("position_offset") == 0


def test_positions_that_contradict_by_no_constant_offset_are_absent(driven, tmp_path):
    def leaping(share: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda s: s + np.where(np.arange(s.size) >= share * s.size, 3_000.0, 0.0)

    trip = ingest(recorded(driven, tmp_path, leaping(0.7)), profile(), line=LINE)
    left = error_of(trip, driven)
    assert 0.25 < left.isna().mean() < 0.35
    assert left.abs().max() < 20.0
    (found,) = (each for each in report_of(trip).findings if each.rule == "position_offset")
    assert "by no constant offset; it is absent where it contradicts them" in found.note
    most = ingest(recorded(driven, tmp_path, leaping(0.2)), profile(), line=LINE)
    assert most["/train/state"]["position"].isna().all()
    assert most["/train/state"]["speed"].notna().all()
    assert "none of it is used" in " ".join(report_of(most).lines())


def test_fixes_give_the_direction_that_nothing_states(driven, tmp_path):
    path, truth = recorded(driven, tmp_path), driven.metadata["direction"]
    trip = ingest(path, profile(), line=LINE)
    assert trip.metadata["direction"] == truth
    assert report_of(trip).count("direction") == (truth == "reverse")
    assert report_of(trip).count("position_offset") == 0
    if truth == "reverse":
        assert trip.metadata["repair.direction.note"].startswith("'reverse': the fixes run so")


def test_a_stated_direction_that_the_fixes_contradict_is_refused(driven, tmp_path):
    path = recorded(driven, tmp_path)
    other = "forward" if driven.metadata["direction"] == "reverse" else "reverse"
    for options, given in (({}, other), ({"trip": {"direction": other}}, None)):
        with pytest.raises(InputError, match=r"--reverse.*direction under \[trip\]"):
            ingest(path, profile(**options), line=LINE, direction=given)
    if other == "forward":
        with pytest.raises(InputError, match="against the direction of travel"):
            ingest(path, profile(repair={"direction": False}), line=LINE)


def test_trips_in_both_directions_in_one_file_need_no_direction(tmp_path):
    ways = [
        simulate(replace(draw_scenarios(LINE, TRAIN, 1, 4)[0], direction=way))
        for way in ("forward", "reverse")
    ]
    tables = [pd.read_csv(recorded(each, tmp_path), parse_dates=["t"]) for each in ways]
    tables[1]["t"] += tables[0]["t"].iloc[-1] - tables[1]["t"].iloc[0] + pd.Timedelta("2min")
    path = tmp_path / "both.csv"
    table = pd.concat(tables).drop(columns="s")
    table.assign(t=table["t"].dt.strftime("%Y-%m-%dT%H:%M:%S.%fZ")).to_csv(path, index=False)
    columns = {name: column for name, column in COLUMNS.items() if name != POSITION}
    parted = plain_profile(columns=columns, limits={"pause": 60.0})
    ingest_all(path, tmp_path / "cut", profile=parted, line=LINE)
    directions = [
        trainlog.read(log).metadata["direction"] for log in sorted((tmp_path / "cut").iterdir())
    ]
    assert directions == ["forward", "reverse"]
    stated = ingest_all(path, tmp_path / "stated", profile=parted, line=LINE, direction="reverse")
    assert len(list((tmp_path / "stated").iterdir())) == 1
    assert "the fixes of each trip give it" in str(stated)
    said = "a log that runs in both directions is two trips: cut it by pause under"
    refused(InputError, said, ingest, path, plain_profile(columns=columns), line=LINE)


def test_a_load_may_be_given_in_tonnes():
    stated = pairs(["load=11.7t"])
    assert stated == pairs(["load=11700kg"]) == {"load": "11700"}
    assert pairs(["load=0"]) == {"load": "0"}
    assert ingest("sample_logs/gnss.csv", metadata=stated).metadata["load"] == "11700"
    refused(InputError, r"0\.0117 t is not plausible.*were t meant", pairs, ["load=11.7"])
    refused(InputError, "load '3km' is not a valid mass", pairs, ["load=3km"])


@pytest.mark.parametrize("driven", ["forward"], indirect=True)
def test_an_assumed_time_zone_stays_with_the_trip(driven, tmp_path):
    proposal = propose_profile("sample_logs/recorder.csv")
    trip = ingest("sample_logs/recorder.csv", proposal.profile)
    assert trip.metadata["clock"] == "UTC assumed: the file does not state a zone"
    zoned = propose_profile(recorded(driven, tmp_path))
    assert zoned.profile.clock is None


def test_a_table_without_time_is_passed_over_in_a_folder_alone(tmp_path):
    folder = tmp_path / "recorded"
    folder.mkdir()
    table = folder / "devices.csv"
    table.write_text("device_id,model\n1,Nexus 5X\n2,Nexus 5X\n3,Pixel\n4,Pixel\n", "utf-8")

    def choose(path: Path) -> Profile:
        return propose_profile(path).profile

    result = ingest_all(folder, tmp_path / "logs", choose=choose)
    assert [each.state for each in result.outcomes] == ["passed_over"]
    assert "no column is a time" in result.outcomes[0].reason
    assert not result.failed
    assert ingest_all([folder, table], tmp_path / "logs", choose=choose).failed
    broken = folder / "broken.csv"
    broken.write_text("time,speed\nx,1\ny,2\nz,3\nq,4\n", "utf-8")
    states = {
        each.file.name: each.state
        for each in ingest_all(folder, tmp_path / "logs", choose=choose).outcomes
    }
    assert states == {"devices.csv": "passed_over", "broken.csv": "refused"}


def walked(tmp_path: Path, way: np.ndarray, speed: np.ndarray, rows: slice | np.ndarray) -> Trip:
    """A trip of fixes along a way [m, north + i east] and of speeds at 1 Hz, in some rows."""
    noise = np.random.default_rng(0).normal(0.0, 1.0, (2, way.size))
    metre = np.degrees(1.0 / 6_371_000.0)
    frame = pd.DataFrame(
        {
            "t": pd.Timestamp("2024-05-01T06:00:00Z") + pd.to_timedelta(np.arange(way.size), "s"),
            "lat": 47.0 + metre * (way.real + noise[0]),
            "lon": 9.0 + metre * (way.imag + noise[1]) / np.cos(np.radians(47.0)),
            "v": np.abs(speed + 0.1 * noise[0]),
        }
    )
    frame[rows].to_csv(tmp_path / "run.csv", index=False)
    names = {"/gnss/motion.speed": ("v", "m/s")}
    names |= {f"/gnss/fix.{each}": (each[:3], "deg") for each in ("latitude", "longitude")}
    columns = {field: {"column": name, "unit": unit} for field, (name, unit) in names.items()}
    profile = plain_profile(columns=columns)
    return ingest(tmp_path / "run.csv", profile)


def test_fixes_of_one_coordinate_have_no_place(driven, tmp_path):
    path = recorded(driven, tmp_path)
    pd.read_csv(path).assign(lon=np.nan).to_csv(path, index=False)
    given = profile(repair={"no_fix": False, "before_first_fix": False})
    trip = ingest(path, given, line=LINE)
    assert trip["/gnss/fix"]["latitude"].notna().any()
    assert "/estimates/state" not in trip


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (("v,lat,lon,acc", "12,47.42,9.37,1", "12,47.4197,9.3697,1422"), "none of 2 fixes lies as"),
        (
            ("v,lat,lon", "12,47.416176,9.366504", "12.1,47.413755,9.360936"),
            "1 of 2 fixes were set aside",
        ),
    ],
)
def test_two_fixes_that_lie_apart_from_the_line_or_each_other_are_refused(tmp_path, rows, said):
    """Further than they say from the line; or so that no train lies between them."""
    line = read_line(sample("CH_StGallen_Wil.line.json"))
    times = ("t", "2024-05-01T06:00:00Z", "2024-05-01T06:00:01Z")
    path = put(tmp_path / "two.csv", [",".join(each) for each in zip(times, rows, strict=True)])
    columns = {name: each for name, each in COLUMNS.items() if each["column"] in rows[0].split(",")}
    given = plain_profile(columns=columns, repair={"spikes": False, "contradicted": False})
    refused(InputError, said, ingest, path, given, line=line)


@pytest.mark.parametrize("count", [2, 30])
def test_some_seconds_of_fixes_without_a_speed_give_a_chainage(driven, tmp_path, count):
    frame = driven["/gnss/fix"][["latitude", "longitude"]].dropna().iloc[100 : 100 + count]
    frame = frame.set_axis(["lat", "lon"], axis=1).reset_index(names="t")
    frame["t"] = frame["t"].iloc[0] + pd.to_timedelta(0.1 * np.arange(count), "s")
    frame.to_csv(tmp_path / "run.csv", index=False)
    columns = {name: each for name, each in COLUMNS.items() if name.endswith("itude")}
    line = LINE if driven.metadata["direction"] == "forward" else LINE.reversed()
    trip = ingest(tmp_path / "run.csv", plain_profile(columns=columns), line=line)
    assert trip["/estimates/state"]["position"].notna().all()


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("known", ["v", "s"])
def test_rows_of_two_trains_in_one_file_are_refused(tmp_path, every, known):
    """Also where one of the trains is recorded twice as often."""
    second = np.arange(1_200.0)
    tables = []
    for delay, step, offset in ((0.0, 1, 0.0), (300.0, every, 0.5)):
        speed = 20.0 + 15.0 * np.sin((second - delay) / 60.0)
        table = pd.DataFrame({"t": second + offset, "v": speed, "s": np.cumsum(speed) + 9 * delay})
        tables.append(table.iloc[::step])
    both = pd.concat(tables).sort_values("t")
    both["t"] = pd.to_datetime(1_700_000_000.0 + both["t"], unit="s", utc=True)
    both[["t", known]].to_csv(tmp_path / "run.csv", index=False)
    name = POSITION if known == "s" else "/train/state.speed"
    said = f"run.csv, row .*: {name} leaps to and fro in .* of the rows, as of two trains; give a"
    columns = {name: COLUMNS[name]}
    refused(InputError, said, ingest, tmp_path / "run.csv", profile=plain_profile(columns=columns))


def test_what_no_train_does_is_stated(tmp_path):
    second = np.arange(900.0)
    for way, speed, said in (
        (0.0 * second, 0.1 + 0.0 * second, "the train never moves"),
        (5.0 * np.exp(0.28j * second), 1.4 + 0.0 * second, "bends of a few metres"),
        (20.0 * second, 20.0 + 12.0 * (-1.0) ** second, "accelerates by more than 4 m/s²"),
    ):
        assert said in walked(tmp_path, way, speed, slice(None)).metadata["motion_evidence"]


@pytest.mark.parametrize(("speed", "legs"), [(1.4, (15.0, 60.0)), (9.0, (8.0, 25.0))])
def test_a_walk_and_a_car_in_a_town_are_no_trains_motion(tmp_path, speed, legs):
    """Straight streets of some seconds each, and corners of 90° between them; no wrong unit."""
    generator = np.random.default_rng(5)
    corners = np.cumsum(generator.uniform(*legs, 300))
    turned = np.cumsum(generator.choice([-0.5, 0.5], 300)) * np.pi
    second = np.arange(1_200.0)
    heading = turned[np.searchsorted(corners, second)]
    way = np.cumsum(speed * np.exp(1j * heading))
    trip = walked(tmp_path, way, speed * np.ones(1_200), slice(None))
    assert trip.metadata["motion_evidence"].endswith("bends of a few metres")
    assert report_of(trip).count("unit_suspected") == 0


@pytest.mark.parametrize("radius", [20.0, 80.0, 300.0])
def test_tight_curves_and_turning_loops_are_a_trains_motion(tmp_path, radius):
    """Trams turn on 20 m; a train runs through a loop and back, and stands between."""
    second = np.arange(1_200.0)
    speed = np.clip(np.minimum(0.5 * second, 0.5 * (1_199.0 - second)), 0.0, 0.3 * radius**0.5 * 4)
    driven = np.cumsum(speed)
    turned = np.clip((driven - 0.4 * driven[-1]) / radius, 0.0, np.pi)
    way = np.cumsum(speed * np.exp(1j * turned))
    assert "motion_evidence" not in walked(tmp_path, way, speed, slice(None)).metadata


def shown(tmp_path: Path, age: np.ndarray, rows: np.ndarray | None = None) -> Trip:
    """A winding trip with a good speed, whose fixes show where the train was so long ago [s]."""
    second = np.arange(1_200.0)
    speed = 14.0 + 10.0 * np.sin(second / 45.0)
    driven = cumulative_trapezoid(speed, initial=0.0)
    way = cumulative_trapezoid(speed * np.exp(0.6j * np.sin(driven / 900.0)), initial=0.0)
    late = np.interp(second - age, second, way.real) + 1j * np.interp(
        second - age, second, way.imag
    )
    return walked(tmp_path, late, speed, np.ones(1_200, dtype=bool) if rows is None else rows)


def of_the_fixes(trip: Trip) -> list[tuple[str, int, str]]:
    found = [each for each in report_of(trip).findings if each.column == "/gnss/fix"]
    return [(each.rule, each.count, each.note) for each in found]


@pytest.mark.parametrize("age", [0.0, 5.0])
def test_fixes_that_are_late_throughout_are_stated_without_a_line(tmp_path, age):
    trip = shown(tmp_path, np.full(1_200, age))
    found = of_the_fixes(trip)
    assert trip["/gnss/fix"]["latitude"].count() == 1_200
    if not age:
        assert found == []
        return
    ((rule, count, note),) = found
    assert (rule, count) == ("contradicted", 1_200)
    assert trip["/gnss/motion"]["speed"].count() == 1_200
    assert float(note.split()[2]) == pytest.approx(age, abs=0.8)


@pytest.mark.parametrize("fast", [0.0, 0.5])
def test_replayed_fixes_are_stated_without_a_line(tmp_path, fast):
    """After a tunnel of 40 s the fixes of its begin, for two minutes or until caught up."""
    second = np.arange(1_200.0)
    age = np.where(second < 720.0, np.maximum(40.0 - fast * (second - 600.0), 0.0), 0.0)
    age[:600] = 0.0
    trip = shown(tmp_path, age, (second < 560.0) | (second >= 600.0))
    ((rule, count, note),) = of_the_fixes(trip)
    assert rule == "off_line"
    assert count == pytest.approx(np.count_nonzero(age > 2.5), abs=3)
    assert int(note.split()[6]) == pytest.approx(40, abs=1)
    assert trip["/gnss/fix"]["latitude"].count() == 1_160
    # The speeds are right.
    assert trip["/gnss/motion"]["speed"].count() == 1_160
    # Nor was the clock set in the tunnel, although the fixes after it go on where it begins.
    assert report_of(trip).count("clock_step") == 0
    assert trip["/gnss/fix"].index[-1] == pd.Timestamp("2024-05-01T06:19:59Z")
