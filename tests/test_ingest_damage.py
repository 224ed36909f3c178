"""A clean trip, damaged by a generator, comes back within the bound stated for the damage."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import pytest
from contents import put
from hypothesis import given, settings, strategies as st
from ingest_logs import (
    SECOND,
    Run,
    clean_run,
    damaged_runs,
    plain_profile,
    plain_text,
    read_plain,
    ublox,
    write,
)
from recorder_files import gpx, mtk
from refusals import refused

from trainlog import DEFAULT_TRAIN, InputError, read_train, sample
from trainlog.errors import LogError
from trainlog.ingest import REPAIRS_ATTACHMENT, ingest, pipeline, repairs_of, report_of
from trainlog.ingest.recording import Repairs
from trainlog.mcap import read_log, write_log
from trainlog.trip import Trip

FILES = settings(max_examples=10)

WEEKS = 1024 * 7 * 86_400


def shifted(run: Run, rows: slice, seconds: float) -> list[str]:
    """The rows of a run, some of them written by a clock that is off."""
    time = run.time.copy()
    time[rows] += int(seconds * SECOND)
    return Run(time, run.speed, run.position).rows()


@FILES
@given(st.data())
def test_a_clock_that_was_set_costs_nothing(tmp_path, data):
    """Every row comes back at its instant, and is reported as moved, whatever part was off.

    Zones and weeks are those of most rows; a clock that was set by seconds is right from then on.
    """
    step = data.draw(st.sampled_from([0.1, 0.5, 1.0]))
    run = clean_run(data.draw(st.integers(200, 300)), step, data.draw(st.floats(0.0, 3.0)))
    where = data.draw(st.sampled_from(["begin", "end", "middle"]))
    # Enough rows on the wrong side that leap seconds repeat themselves, but fewer than half.
    count = data.draw(st.integers(60, 90))
    rows = {
        "begin": slice(0, count),
        "end": slice(run.time.size - count, None),
        "middle": slice(60, 60 + count),
    }[where]
    sizes = {
        # Set back after the beginning; before the end; within, in either direction.
        "begin": [3600, 900 * 23, -WEEKS],
        "end": [-3600, -900 * 23, -WEEKS],
        "middle": [3600, -3600, 900 * 23, -WEEKS],
    }[where]
    if where != "middle":
        most = min(18, int(50 * step))
        sizes += [leap * (1 if where == "begin" else -1) for leap in (2, 3, most) if leap <= most]
    size = data.draw(st.sampled_from(sizes))
    shown = shifted(run, rows, size)
    truth = run.time
    if where == "end" and -60 < size < 0:
        # Set at the end to what is right, before it was late.
        truth, count, size = truth + size * 1_000_000_000, run.time.size - count, -size
    trip = read_plain(tmp_path, shown)
    report = report_of(trip)
    assert report.counts == {"clock_step": count}
    stated = (
        "-1024 weeks" if size == WEEKS else "+1024 weeks" if size == -WEEKS else f"{-size:+d} s"
    )
    assert report.findings[0].note.split(";")[0] == f"moved by {stated}"
    state = trip["/train/state"]
    np.testing.assert_array_equal(state.index.as_unit("ns").asi8, truth)
    np.testing.assert_array_equal(state["speed"], run.speed)
    entries = repairs_of(trip)
    assert len(entries) == count
    late = (entries["raw_time"] - entries["new_time"]) / pd.Timedelta(seconds=1)
    np.testing.assert_allclose(late, size, rtol=1e-12)


@FILES
@given(st.data())
def test_blocks_written_late_or_twice_are_no_steps(tmp_path, data):
    """What looks like a leap second, but gives its times once, or twice with the same values."""
    run = clean_run(200, 1.0, data.draw(st.floats(0.0, 3.0)))
    rows = run.rows()
    length = data.draw(st.integers(2, 5))
    place = data.draw(st.integers(20, 150))
    block, following = rows[place : place + length], rows[place + length : place + 2 * length]
    if data.draw(st.booleans()):
        damaged = [*rows[:place], *following, *block, *rows[place + 2 * length :]]
        expected = {"time_backwards": length}
    else:
        damaged = [*rows[: place + length], *block, *rows[place + length :]]
        expected = {"duplicates": length, "time_backwards": length}
    trip = read_plain(tmp_path, damaged)
    counts = report_of(trip).counts
    assert counts.keys() == expected.keys()
    assert all(counts[rule] <= count for rule, count in expected.items())
    np.testing.assert_array_equal(trip["/train/state"].index.as_unit("ns").asi8, run.time)
    np.testing.assert_array_equal(trip["/train/state"]["speed"], run.speed)


def test_an_hours_pause_is_a_gap_and_stays_one(tmp_path):
    run = clean_run(200, 1.0)
    trip = read_plain(tmp_path, shifted(run, slice(100, None), 3600))
    # The train goes on where it was, as fast: whether the clock was set is asked, not answered.
    assert report_of(trip).counts == {"gaps": 1, "clock_step_suspected": 1}
    assert trip.duration == pytest.approx(199 + 3600)


UNITS = {"m/s": 1.0, "km/h": 3.6, "mph": 2.236936, "knot": 1.943844}


@FILES
@given(st.data())
def test_wrong_units_are_refused_or_reported(tmp_path, data):
    """Beyond a factor of 2 refused, beyond 1.15 reported with the factor, within it nothing."""
    written = data.draw(st.sampled_from(list(UNITS)))
    taken = data.draw(st.sampled_from(list(UNITS)))
    run = clean_run(120, 1.0, data.draw(st.floats(0.0, 3.0)))
    rows = Run(run.time, np.round(run.speed * UNITS[written], 3), run.position).rows()
    columns = {
        "/train/state.speed": {"column": "v", "unit": taken},
        "/train/state.position": {"column": "s", "unit": "m"},
    }
    path, profile = write(tmp_path / "run.csv", rows), plain_profile(columns=columns)
    factor = UNITS[taken] / UNITS[written]
    if not 0.5 <= factor <= 2.0:
        with pytest.raises(InputError, match=r"check the units? of|values are impossible"):
            ingest(path, profile=profile)
        return
    report = report_of(ingest(path, profile=profile))
    if 1 / 1.15 < factor < 1.15:
        assert report.findings == ()
    else:
        assert report.counts == {"unit_suspected": 1}
        assert report.findings[0].column == "/train/state.position"


def driven(count: int, seed: int) -> pd.DataFrame:
    """A train that is driven and braked: effort, lever, and the speed that follows from them."""
    rng = np.random.default_rng(seed)
    lever = np.repeat(rng.choice([-0.6, 0.0, 0.5, 1.0], count // 30 + 1), 30)[:count]
    effort = np.where(lever > 0.0, 150e3 * lever, 100e3 * lever)
    speed = 20.0 + np.cumsum(effort / 200e3 - 0.02 - (effort / 200e3 - 0.02).mean())
    return pd.DataFrame({"lever": lever, "F": effort / 1e3, "v": speed - speed.min() + 2.0})


@FILES
@given(st.integers(0, 10_000), st.sampled_from([1, -1]), st.sampled_from(["F", "lever"]))
def test_wrong_signs_of_effort_and_lever_are_refused(tmp_path, seed, sign, column):
    table = driven(600, seed)
    run = clean_run(600, 1.0)
    stamps = pd.DatetimeIndex(run.time, tz="UTC").strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    rows = [
        f"{t},{v:.3f},{f:.2f},{n}"
        for t, v, f, n in zip(stamps, table["v"], table["F"], table["lever"], strict=True)
    ]
    columns: dict[str, Any] = {"/train/state.speed": {"column": "v", "unit": "m/s"}}
    if column == "F":
        parts = ["positive", "negative"][::sign]
        for name, part in zip(("tractive", "dynamic_braking"), parts, strict=True):
            columns[f"/train/controls.{name}_effort"] = {"column": "F", "unit": "kN", "part": part}
    else:
        columns["/train/controls.lever"] = {"column": "lever", "unit": "1", "sign": sign}
    path = write(tmp_path / "run.csv", rows, "t,v,F,lever")
    profile = plain_profile(columns=columns)
    if sign > 0:
        # Few levels of the lever may let the speed move in equal steps.
        assert report_of(ingest(path, profile=profile)).counts.keys() <= {"quantised"}
    else:
        with pytest.raises(InputError, match=r"slows down whenever /train/controls\..* check sign"):
            ingest(path, profile=profile)


@FILES
@given(
    st.integers(0, 10_000), st.sampled_from(["N", "kN", "MN"]), st.sampled_from([0.0, 60e3, 600e3])
)
def test_efforts_that_are_not_in_the_declared_unit_are_stated(tmp_path, seed, unit, mass):
    """They are written in kN; 1000 times less or more moves no such train, whether it is known."""
    table = driven(600, seed)
    stamps = pd.DatetimeIndex(clean_run(600, 1.0).time, tz="UTC").strftime("%Y-%m-%dT%H:%M:%SZ")
    rows = [f"{t},{v:.3f},{f:.2f}" for t, v, f in zip(stamps, table["v"], table["F"], strict=True)]
    columns: dict[str, Any] = {"/train/state.speed": {"column": "v", "unit": "m/s"}} | {
        f"/train/controls.{name}_effort": {"column": "F", "unit": unit, "part": part}
        for name, part in (("tractive", "positive"), ("dynamic_braking", "negative"))
    }
    path = write(tmp_path / "run.csv", rows, "t,v,F")
    train = replace(read_train(sample(DEFAULT_TRAIN)), mass=mass) if mass else None
    if unit == "MN":
        with pytest.raises(InputError, match=r"values are impossible.*check the unit"):
            ingest(path, profile=plain_profile(columns=columns), train=train)
        return
    report = report_of(ingest(path, profile=plain_profile(columns=columns), train=train))
    wrong = {each.column: each.note for each in report.findings if each.rule == "unit_suspected"}
    if unit == "N" and not (table["F"] < 0.0).any():
        return
    kinds = ("tractive", "dynamic_braking") if mass else ("tractive",)
    assert list(wrong) == [f"/train/controls.{k}_effort" for k in kinds if unit == "N"]
    assert all(
        note.endswith("declare unit kN for its column in the profile") for note in wrong.values()
    )


@FILES
@given(st.floats(0.0, 3.0), st.sampled_from([3.6, 2.237, 1.944, 1.0]))
def test_a_satellite_speed_that_the_fixes_contradict(tmp_path, phase, factor):
    ticks = np.arange(600)
    lines = ublox(ticks // 5, ticks / 5 + phase).splitlines()
    for row in range(1, len(lines)):
        words = lines[row].split(",")
        words[13] = str(round(factor * int(words[13])))
        lines[row] = ",".join(words)
    path = tmp_path / "gnss.csv"
    path.write_text("\n".join(lines) + "\n", "ascii")
    if factor > 2.0:
        refused(InputError, r"motion\.speed is .* times the speed at which the", ingest, path)
    else:
        assert report_of(ingest(path)).count("unit_suspected") == (factor > 1.15)


@pytest.mark.parametrize("share", [0.0, -0.005, 0.1])
def test_a_position_that_stays_is_suspected_where_it_is_not_refused(tmp_path, share):
    second = np.arange(1_800)
    stamps = pd.to_datetime(1_700_000_000 + second, unit="s", utc=True)
    columns = {"t": stamps, "v": 15.0 + 5.0 * np.sin(second / 50.0), "s": share * 15.0 * second}
    pd.DataFrame(columns).to_csv(tmp_path / "run.csv", index=False)
    off = plain_profile(repair={"inconsistent": False, "frozen": False})
    report = report_of(ingest(tmp_path / "run.csv", profile=off))
    assert report.count("unit_suspected") == 1


@FILES
@given(st.floats(0.0, 3.0), st.sampled_from([0.5, 1.0, 1.0 / 3.6]))
def test_quantised_columns_are_reported_with_their_step(tmp_path, phase, step):
    """The values stay as they are, and lie within half of the step that is reported."""
    run = clean_run(1200, 0.1, phase)
    coarse = np.round(run.speed / step) * step
    rows = Run(run.time, coarse, run.position).rows()
    trip = read_plain(tmp_path, rows)
    (finding,) = report_of(trip).findings
    known = finding.rule, finding.column, finding.count
    assert known == ("quantised", "/train/state.speed", 1200)
    stated = float(finding.note.split()[2])
    assert stated == pytest.approx(step, rel=0.01)
    assert np.abs(trip["/train/state"]["speed"] - run.speed).max() <= 0.5 * stated + 0.002
    assert len(repairs_of(trip)) == 0, "nothing was changed"


def assert_restored(trip: Trip, raw: pd.DataFrame) -> None:
    """Every row of the file is found again, in time (NaT: none is readable) and in every cell."""
    entries = repairs_of(trip)
    by_row: dict[int, list[Any]] = {}
    for entry in entries.itertuples():
        by_row.setdefault(entry.row, []).append(entry)
    first_raw: dict[tuple[int, str], float] = {}
    for row, column, value in zip(
        entries["row"], entries["column"], entries["raw_value"], strict=True
    ):
        first_raw.setdefault((row, column), value)
    for row, stated in raw.to_dict("index").items():
        now, dropped = stated.pop("time"), False
        for entry in by_row.get(row, ()):
            if entry.column == "" and entry.rule != "truncated_rows":
                assert entry.raw_time == now or (pd.isna(entry.raw_time) and pd.isna(now))
                now, dropped = entry.new_time, pd.isna(entry.new_time)
        for column, value in stated.items():
            if (row, column) in first_raw:
                found = first_raw[row, column]
            elif dropped:
                found = np.nan
            else:
                topic, _, name = str(column).rpartition(".")
                frame = trip[topic]
                found = frame.at[now, name] if now in frame.index else np.nan
            assert found == pytest.approx(value, rel=1e-12, nan_ok=True), (row, column)


def plain_raw(rows: list[str]) -> pd.DataFrame:
    """What a file of `plain_text` says, cell by cell; rows that are cut short are left out."""
    stated = {}
    for number, row in enumerate(rows, start=2):
        words = row.split(",")
        if len(words) == 3:
            stated[number] = {
                "time": pd.to_datetime(words[0], utc=True, errors="coerce"),
                "/train/state.speed": pd.to_numeric(words[1].strip(), errors="coerce"),
                "/train/state.position": pd.to_numeric(words[2].strip(), errors="coerce"),
            }
    return pd.DataFrame.from_dict(stated, orient="index").replace([np.inf, -np.inf], np.nan)


@settings(max_examples=20)
@given(damaged_runs())
def test_damage_is_undone_counted_and_found_again(tmp_path, damaged):
    trip = read_plain(tmp_path, damaged.rows)
    report = report_of(trip)
    assert report.count("duplicates") == damaged.doubled
    assert report.count("time_backwards") == damaged.swapped
    assert report.count("empty", "/train/state.speed") == damaged.empty
    assert report.count("not_a_number", "/train/state.speed") == damaged.text
    assert report.count("truncated_rows") == damaged.truncated
    wild = report.count("spikes", "/train/state.speed")
    assert wild + report.count("out_of_limits", "/train/state.speed") == len(damaged.wild)
    assert report.rows_read == len(damaged.rows)
    assert report.rows_dropped == damaged.doubled + damaged.truncated

    state, run = trip["/train/state"], damaged.run
    stays = np.array([i not in damaged.lost for i in range(run.time.size)])
    np.testing.assert_array_equal(state.index.as_unit("ns").asi8, run.time[stays])
    np.testing.assert_array_equal(state["position"], run.position[stays])
    absent = np.array([i in damaged.wild | damaged.blank for i in range(run.time.size)])[stays]
    np.testing.assert_array_equal(state["speed"].isna(), absent)
    np.testing.assert_array_equal(state["speed"][~absent], run.speed[stays][~absent])

    assert_restored(trip, plain_raw(damaged.rows))
    entries = repairs_of(trip)
    cut = entries[entries["rule"] == "truncated_rows"]
    lines = plain_text(damaged.rows).splitlines()
    assert list(cut["raw_text"]) == [lines[row - 1] for row in cut["row"]]
    words = entries[entries["rule"] == "not_a_number"]
    assert list(words["raw_text"]) == [lines[row - 1].split(",")[1] for row in words["row"]]
    assert len(words) == damaged.text
    assert report.raw_kept == len(entries)


@FILES
@given(st.data())
def test_rows_without_sub_seconds_fix_or_sense_are_found_again(tmp_path, data):
    count = data.draw(st.integers(40, 120))
    ticks = np.arange(count)
    before = data.draw(st.integers(0, 20))
    void = ["2015,10,18,0,0,4,0,0,0,0,-17000,9000,9000,0,20000,99,"] * before
    rows = ublox(ticks // 5, ticks / 5, void).splitlines()
    for place in data.draw(st.sets(st.integers(10, count - 10), max_size=5)):
        at = before + 1 + place
        kind = data.draw(st.sampled_from(["wild", "no fix", "twice"]))
        words = rows[at].split(",")
        if kind == "wild":
            words[13] = "80000"
        elif kind == "no fix":
            words[6] = "0"
        rows[at] = ",".join(words)
        if kind == "twice":
            rows.insert(at, rows[at])
    path = put(tmp_path / "gnss.csv", rows)
    table = pd.read_csv(path, index_col=False)
    parts = table[["Year", "Month", "Day", "Hour", "Minute", "Second"]]
    stated = {
        "time": pd.to_datetime(parts, utc=True).astype("datetime64[ns, UTC]"),
        "/gnss/fix.latitude": table["Lat"] / 1e7,
        "/gnss/fix.longitude": table["Lon"] / 1e7,
        "/gnss/motion.speed": table["speed"] / 1e3,
        "/gnss/motion.satellites": table["nSAT"].astype(float),
    }
    raw = pd.DataFrame(stated)
    raw.index = pd.Index(np.arange(2, 2 + len(raw)))
    assert_restored(ingest(path), raw)


def test_times_that_cannot_be_read_are_kept_as_text(tmp_path):
    recorded = mtk(3, before=4)
    entries = repairs_of(ingest(put(tmp_path / "run.csv", recorded.text)))
    times = entries[entries["column"] == "time"]
    assert list(times["raw_text"]) == ["2000 0 0 0 0 0"] * 4
    assert list(times["row"]) == [2, 3, 4, 5]


def test_raw_values_survive_the_log(tmp_path):
    path = put(tmp_path / "run.gpx", gpx(1).text)
    trip = ingest(path)
    write_log(trip, tmp_path / "run.mcap")
    kept = read_log(tmp_path / "run.mcap")
    pd.testing.assert_frame_equal(repairs_of(kept), repairs_of(trip))
    assert kept.metadata["repairs.kept"] == str(len(repairs_of(trip)))
    assert ingest(path).attachments == trip.attachments


def test_a_clean_file_keeps_no_raw_values(tmp_path):
    trip = read_plain(tmp_path, clean_run(50, 0.1).rows())
    assert REPAIRS_ATTACHMENT not in trip.attachments
    assert len(repairs_of(trip)) == 0
    assert list(repairs_of(trip).columns)[:3] == ["row", "table", "column"]
    refused(LogError, "was not made by ingest", repairs_of, Trip({}))


def test_what_is_kept_is_bounded_and_the_rest_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "Repairs", partial(Repairs, most=100))
    rows = clean_run(400, 1.0).rows()
    doubled = [row for row in rows for _ in range(2)]
    trip = read_plain(tmp_path, doubled)
    report = report_of(trip)
    assert report.raw_kept == len(repairs_of(trip)) == 100
    assert report.raw_beyond == 3 * 400 - 100
    assert trip.metadata["repairs.beyond"] == "1100"
    assert f"{report.raw_beyond} more are in the file alone" in " ".join(report.lines())
