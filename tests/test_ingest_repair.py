"""Damage of a known kind comes back within bounds and is counted; values that freeze."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from contents import put
from hypothesis import assume, given, settings, strategies as st
from ingest_logs import (
    SECOND,
    START,
    clean_run,
    plain_profile,
    plain_rows,
    read_plain,
    ublox,
    write,
)
from recorder_files import MTK_HEADER, Drive, drive, mtk_at_rest, mtk_rows
from refusals import refused

from trainlog import InputError, Trip, read, repairs_of, report_of
from trainlog.arrays import FloatArray
from trainlog.ingest import RULES, Finding, Table, ingest
from trainlog.ingest.clock import (
    drop_before_first_fix,
    drop_clock_jumps,
    has_fix,
    longest_nondecreasing,
)
from trainlog.ingest.profile import Limits, Repair
from trainlog.ingest.recording import NO_TIME
from trainlog.ingest.rules import repaired, spikes

FILES = settings(max_examples=20)


@FILES
@given(st.data())
def test_the_longest_ordered_part_is_found(data):
    time = np.array(data.draw(st.lists(st.integers(0, 12), min_size=1, max_size=40)))
    marked = longest_nondecreasing(time)
    assert np.all(np.diff(time[marked]) >= 0)
    best = np.ones(time.size, dtype=int)
    for i in range(time.size):
        best[i] += max((best[j] for j in range(i) if time[j] <= time[i]), default=0)
    assert marked.sum() == best.max()


@pytest.mark.parametrize(("step", "within"), [(1.0, 10.0), (4.0, 20.0)])
@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_a_time_is_far_off_beyond_the_limit_or_five_steps_of_both_rows_around(step, within, way):
    for beyond in (0.1, -0.1):
        time = step * np.arange(100)
        time[50] += way * (step + within + beyond)  # beside the row that is next to it in time
        table = timed(time)
        kept, _ = drop_clock_jumps(table, Limits(sort_within=10.0))
        assert (50 in kept.rows) == (beyond < 0.0)
        assert len(kept) == (99 if beyond > 0.0 else 100)


@pytest.mark.parametrize("sizes", [(90, 3, 7), (3, 90, 7), (3, 7, 90)])
def test_the_largest_of_groups_that_pauses_part_is_the_trip(sizes):
    for apart, whole in ((3_600.1, False), (3_599.9, True)):
        parts = [np.arange(size) + 0.0 for size in sizes]
        for one, other in pairwise(parts):
            other += one[-1] + apart
        kept, _ = drop_clock_jumps(timed(np.concatenate(parts)), Limits(pause=3_600.0))
        assert len(kept) == (100 if whole else 90)


def test_a_clock_that_jumps_in_more_than_a_quarter_of_the_rows_is_refused():
    time = np.arange(100.0)
    time[-25:] += 1e6
    assert len(drop_clock_jumps(timed(time), Limits())[0]) == 75
    time[-26] += 1e6
    refused(InputError, "26 of 100 rows do not fit", drop_clock_jumps, timed(time), Limits())


def test_a_fix_has_a_position_satellites_and_an_accuracy():
    """On the equator and on the meridian of Greenwich, too, but where both meet receivers say 0."""
    rows = [  # latitude, longitude, satellites, accuracy, whether it is a fix
        (47.0, 9.0, 7.0, 2.0, True),
        (0.0, 9.0, np.nan, np.nan, True),
        (47.0, 0.0, 7.0, 3_999_999.0, True),
        (0.0, 0.0, 7.0, 2.0, False),
        (np.nan, 9.0, 7.0, 2.0, False),
        (47.0, np.nan, 7.0, 2.0, False),
        (47.0, 9.0, 0.0, 2.0, False),
        (47.0, 9.0, 7.0, 4_000_000.0, False),
    ]
    *columns, expected = np.array(rows).T
    names = ("fix.latitude", "fix.longitude", "motion.satellites", "fix.horizontal_accuracy")
    signals = {f"/gnss/{name}": each for name, each in zip(names, columns, strict=True)}
    table = replace(timed(np.arange(8.0)), signals=signals)
    np.testing.assert_array_equal(has_fix(table), expected.astype(bool))
    position = {name: signals[f"/gnss/{name}"] for name in names[:2]}
    alone = replace(table, signals={f"/gnss/{name}": each for name, each in position.items()})
    assert has_fix(alone).sum() == 5
    for name in names[:2]:
        assert has_fix(replace(table, signals={f"/gnss/{name}": columns[0]})) is None


def test_rows_before_the_first_fix_leave_logs_of_a_receiver_alone():
    fixes = {
        "/gnss/fix.latitude": np.array([0.0, 47.0, 47.0, 0.0, 47.0]),
        "/gnss/fix.longitude": np.array([0.0, 9.0, 9.0, 0.0, 9.0]),
    }
    table = replace(timed(np.arange(5.0)), signals=fixes)
    table.time[1] = NO_TIME
    kept, found = drop_before_first_fix(table, Limits())
    assert kept.rows.tolist() == [2, 3, 4]
    assert [each.count for each in found] == [2]
    speed = {"/train/state.speed": np.ones(5)}
    for signals in (speed | fixes, speed, {"/gnss/motion.speed": np.ones(5)}):
        other = replace(table, signals=signals)
        assert drop_before_first_fix(other, Limits()) == (other, [])
    never = replace(table, signals={name: 0.0 * each for name, each in fixes.items()})
    assert len(drop_before_first_fix(never, Limits())[0]) == 0


def timed(time: FloatArray) -> Table:
    """A table of speeds at times [s]; rows are numbered from 0."""
    known = START + np.round(SECOND * time).astype(np.int64)
    return Table(known, np.arange(time.size), {"/train/state.speed": np.arange(time.size) + 0.0})


@given(
    st.lists(st.floats(0.01, 2.0), min_size=7, max_size=60),
    st.lists(st.floats(-1.0, 1.0), min_size=60, max_size=60),
    st.floats(0.1, 50.0),
)
def test_what_changes_no_faster_than_the_rate_is_no_spike(steps, changes, rate):
    time = np.cumsum(steps)
    values = np.cumsum(rate * np.array(changes)[: time.size] * np.array(steps))
    assert not spikes(time, values, rate, 1e-6 * rate).any()


def test_gaps_are_counted_and_never_filled(tmp_path):
    rows = plain_rows(200)
    kept = rows[:50] + rows[80:120] + rows[130:]
    trip = read_plain(tmp_path, kept)
    report = report_of(trip)
    assert report.counts == {"gaps": 2}
    assert report.findings[0].note == "longest 31.0 s, beyond 5 s"
    assert report.findings[0].rows == (52, 92)
    assert trip.metadata["repair.gaps"] == "2"
    assert len(trip["/train/state"]) == len(kept)
    wide = read_plain(tmp_path, kept, limits={"gap": 20.0})
    assert report_of(wide).count("gaps") == 1


def test_rows_of_one_instant_are_merged(tmp_path):
    """A logger that writes one row a signal."""
    run = clean_run(30, 1.0)
    rows = [
        part
        for row in run.rows()
        for stamp, speed, position in [row.split(",")]
        for part in (f"{stamp},{speed},", f"{stamp},,{position}")
    ]
    trip = read_plain(tmp_path, rows)
    assert report_of(trip).count("same_time") == 30
    np.testing.assert_array_equal(trip["/train/state"]["speed"], run.speed)
    np.testing.assert_array_equal(trip["/train/state"]["position"], run.position)


def test_contradictory_rows_of_one_instant_keep_the_first_value(tmp_path):
    rows = plain_rows(20)
    stamp, _, position = rows[7].split(",")
    trip = read_plain(tmp_path, [*rows[:8], f"{stamp},3.0,{position}", *rows[8:]])
    assert report_of(trip).counts == {"same_time": 1}
    assert trip["/train/state"]["speed"].iloc[7] == float(rows[7].split(",")[1])


def test_wheels_that_spin_are_no_spikes(tmp_path):
    """A slip of 5 m/s that builds up and dies within a second is what the log is for."""
    run = clean_run(100, 0.1)
    slip = np.zeros(100)
    slip[50:60] = [0.5, 1.5, 2.5, 4.0, 5.0, 5.0, 4.0, 2.0, 1.0, 0.5]
    rows = [f"{row},{v + x:.3f}" for row, v, x in zip(run.rows(), run.speed, slip, strict=True)]
    columns = {"/train/axles.wheel_speed": {"columns": ["w"], "unit": "m/s"}}
    path = write(tmp_path / "run.csv", rows, "t,v,s,w")
    assert report_of(ingest(path, plain_profile(columns=columns))).findings == ()


OF_READERS = ("damaged_messages", "newest_first", "direction")
OF_TABLES = [rule for rule in RULES if rule.off == "refuse" and rule.name not in OF_READERS]


@pytest.mark.parametrize("rule", OF_TABLES)
def test_rules_that_are_off_refuse_what_they_would_repair(tmp_path, rule, request):
    rows = plain_rows(60)
    stamp, _, position = rows[30].split(",")
    damage = {
        "truncated_rows": [*rows[:30], stamp, *rows[31:]],
        "not_a_number": [*rows[:30], f"{stamp},x,{position}", *rows[31:]],
        "empty": [*rows[:30], f"{stamp},,{position}", *rows[31:]],
        "time_unreadable": [*rows[:30], f",1.0,{position}", *rows[31:]],
        "clock_jump": [*rows[:30], rows[30].replace("2024", "2023"), *rows[31:]],
        "time_backwards": [*rows[:30], rows[31], rows[30], *rows[32:]],
        "duplicates": [*rows[:30], rows[30], *rows[30:]],
        "same_time": [*rows[:30], f"{stamp},1.0,{position}", *rows[30:]],
    }[rule.name]
    assert report_of(read_plain(tmp_path, damage)).count(rule.name) == 1
    with pytest.raises(InputError, match=rf"run\.csv, row 3[234].*1 times '{rule.name}'"):
        read_plain(tmp_path, damage, repair={rule.name: False})


def test_values_stay_when_their_rules_are_off(tmp_path):
    rows = plain_rows(60)
    stamp, _, position = rows[30].split(",")
    rows[30] = f"{stamp},400.0,{position}"
    off = {"out_of_limits": False, "spikes": False}
    trip = read_plain(tmp_path, rows, repair=off)
    assert trip["/train/state"]["speed"].iloc[30] == 400.0
    assert report_of(trip).switched_off == ("out_of_limits", "spikes")
    assert trip.metadata["repair.switched_off"] == "out_of_limits, spikes"


def read_ublox(tmp_path: Path, text: str, **options: object) -> Trip:
    return ingest(put(tmp_path / "gnss.csv", text), **options)


def elapsed(trip: Trip) -> np.ndarray:
    return (trip["/gnss/motion"].index.as_unit("ns").asi8 - START) / SECOND


@FILES
@given(st.data())
def test_seconds_with_four_and_six_rows_come_out_exactly(tmp_path, data):
    """A row at the edge of a second that was labelled with the neighbour's."""
    ticks = np.arange(data.draw(st.integers(0, 4)), 5 * 40 + data.draw(st.integers(0, 4)))
    second = ticks // 5
    for place in data.draw(st.sets(st.integers(1, 9), max_size=8)):
        edge = int(np.argmax(ticks == 20 * place))
        if data.draw(st.booleans()):
            second[edge] -= 1
        else:
            second[edge - 1] += 1
    trip = read_ublox(tmp_path, ublox(second, ticks / 5))
    np.testing.assert_allclose(elapsed(trip), ticks / 5, atol=1e-9)
    assert report_of(trip).rows_dropped == 0


@FILES
@given(st.data())
def test_lost_rows_cost_their_neighbours_less_than_a_period(tmp_path, data):
    ticks = np.arange(data.draw(st.integers(0, 4)), 5 * 60 + data.draw(st.integers(0, 4)))
    lost = {10 * i + data.draw(st.integers(0, 4)) for i in data.draw(st.sets(st.integers(1, 28)))}
    outage = data.draw(st.sampled_from([range(0), range(100, 123), range(121, 139)]))
    ticks = np.array([tick for tick in ticks if tick not in lost and tick not in outage])
    trip = read_ublox(tmp_path, ublox(ticks // 5, ticks / 5))
    found = elapsed(trip)
    assert np.all(np.diff(found) > 0.0)
    np.testing.assert_allclose(found, ticks / 5, atol=0.2 - 1e-9)
    untouched = [all(5 * (t // 5) + i in ticks for i in range(5)) for t in ticks]
    np.testing.assert_allclose(found[untouched], ticks[untouched] / 5, atol=1e-9)


def test_a_log_that_says_nothing_is_refused(tmp_path):
    ticks = np.arange(100)
    text = ublox(ticks // 5, ticks / 5).replace(",9,93", ",0,93")
    off = plain_profile(repair={"before_first_fix": False})
    with pytest.raises(InputError, match=r"gnss\.csv: nothing is left of 100 rows after repair; "):
        read_ublox(tmp_path, text, profile=off)


@pytest.mark.parametrize(("seed", "again"), [(0, 0.2), (1, 0.6), (2, 0.95), (3, 0.95)])
def test_a_receiver_at_rest_keeps_its_rate(tmp_path, seed, again):
    """Most of ten rows a second repeat the one before: all of them are samples."""
    made = mtk_at_rest(seed, again=again)
    trip = read_ublox(tmp_path, made.text)
    report = report_of(trip)
    assert report.count("duplicates") == 0
    assert report.rows_dropped == 0
    np.testing.assert_allclose(trip["/gnss/fix"].index.as_unit("ns").asi8, made.truth.time)


METRE = 1.0 / 111_195.0


def moved(run: Drive, places: np.ndarray, metres: np.ndarray, hdop: float | None = None) -> Drive:
    """The drive with fixes that lie beside it to the north."""
    latitude, stated = run.latitude.copy(), run.hdop.copy()
    latitude[places] += metres * METRE
    if hdop is not None:
        stated[places] = hdop
    return replace(run, latitude=latitude, hdop=stated)


def read_drive(tmp_path: Path, run: Drive, *, speed: bool = True) -> tuple[np.ndarray, object]:
    """Which fixes are absent, and the report."""
    rows = mtk_rows(run)
    if not speed:
        rows = [",".join([*row.split(",")[:10], "", row.split(",")[11]]) for row in rows]
    trip = ingest(put(tmp_path / "run.csv", [MTK_HEADER, *rows]))
    return trip["/gnss/fix"]["latitude"].isna().to_numpy(), report_of(trip)


@pytest.mark.parametrize("speed", [True, False])
@pytest.mark.parametrize(("rate", "metres"), [(1.0, 234.0), (5.0, -400.0), (10.0, 3_000.0)])
def test_fixes_beside_the_way_go(tmp_path, rate, speed, metres):
    """234 m beside it with a stated accuracy of 713 m; single ones and runs of several."""
    run = drive(round(600 * rate), rate, 2)
    places = np.array([40, 90, 91, 150, 151, 152, 153, 200, 202, len(run) - 30])
    absent, report = read_drive(tmp_path, moved(run, places, metres, 713 / 3), speed=speed)
    assert np.flatnonzero(absent).tolist() == places.tolist()
    assert report.count("spikes", "/gnss/fix.latitude") == places.size
    assert report.rows_dropped == 0


@pytest.mark.parametrize("rate", [1.0, 5.0])
def test_fixes_that_come_back_from_an_outage_elsewhere_and_poor_ones_stay(tmp_path, rate):
    """What was 150 m off before the tunnel, for a minute, is not judged by a jump."""
    run = drive(round(600 * rate), rate, 4)
    off = np.arange(round(200 * rate), round(260 * rate))
    poor = moved(run, np.array([100, 300]), 15.0, 713 / 3)
    for changed in (moved(run, off, 150.0), poor):
        absent, report = read_drive(tmp_path, changed)
        assert not absent.any()
        assert report.count("spikes") == 0


def test_a_frozen_speed_makes_no_fix_a_jump(tmp_path):
    """Between two outages there are a few sound fixes; the speed says that the train creeps."""
    run = drive(600, 1.0, 5)
    speed = run.speed.copy()
    speed[100:500] = 0.8
    frozen = replace(run, speed=speed)
    fast = 250 + int(np.argmax(run.speed[250:450]))
    seen = np.r_[0 : fast - 25, fast : fast + 3, fast + 28 : 600]
    absent, report = read_drive(tmp_path, frozen.take(seen))
    assert not absent.any()
    assert report.count("frozen", "/gnss/motion.speed") > 250


@pytest.mark.parametrize(
    ("length", "size"), [(1, 30.0), (2, -15.0), (3, 60.0), (4, 30.0), (5, -15.0), (7, 60.0)]
)
def test_runs_of_wild_speeds_go_and_the_sample_after_stays(tmp_path, length, size):
    rows = plain_rows(200)
    wild = [50, 120]
    for first in wild:
        for place in range(first, first + length):
            stamp, speed, position = rows[place].split(",")
            rows[place] = f"{stamp},{max(0.0, float(speed) + size):.3f},{position}"
    trip = read_plain(tmp_path, rows)
    absent = np.flatnonzero(trip["/train/state"]["speed"].isna())
    assert absent.tolist() == [place for first in wild for place in range(first, first + length)]
    assert len(repairs_of(trip)) == 2 * length == report_of(trip).count("spikes")


def test_a_value_that_stays_where_it_jumped_is_no_spike():
    time = np.arange(0.0, 60.0, 0.1)
    values = np.where(time < 30.0, 5.0, 300.0)
    assert not spikes(time, values, 1.0, 2.0).any()
    values[:20] = 900.0
    assert np.flatnonzero(spikes(time, values, 1.0, 2.0)).tolist() == list(range(20))


COUNTERS = settings(max_examples=10)

COLUMN = "/train/state.position"


def motion(
    length: float, rate: float = 10.0, seed: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Seconds, speed and distance of a train that stops every few minutes; noise in the speed."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(0.0, length, 0.1)
    speed = np.maximum(
        0.0, 22.0 * np.sin(seconds / rng.uniform(50.0, 90.0)) + rng.uniform(3.0, 9.0)
    )
    distance = np.concatenate(([0.0], np.cumsum(0.05 * (speed[1:] + speed[:-1]))))
    every = round(10.0 / rate)
    noisy = np.where(speed > 0.0, np.abs(speed + 0.1 * rng.standard_normal(speed.size)), 0.0)
    return seconds[::every], noisy[::every], distance[::every]


def stops(speed: np.ndarray) -> np.ndarray:
    """A row in the middle of each stop."""
    edges = np.flatnonzero(np.diff((speed == 0.0).astype(int), prepend=0, append=0))
    return (edges[::2] + edges[1::2]) // 2


def rows_of(seconds: np.ndarray, speed: np.ndarray, position: np.ndarray) -> list[str]:
    time = START + np.round(seconds * SECOND).astype(np.int64)
    stamps = pd.DatetimeIndex(time, tz="UTC").strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    return [f"{t},{v:.2f},{s:.1f}" for t, v, s in zip(stamps, speed, position, strict=True)]


def read_rows(tmp_path: Path, rows: list[str], *, with_speed: bool = True, **more: object) -> Trip:
    if not with_speed:
        more["columns"] = {COLUMN: {"column": "s", "unit": "m"}}
    return read_plain(tmp_path, rows, **more)


def assert_grows(trip: Trip, distance: np.ndarray, within: float) -> None:
    found = trip["/train/state"]["position"].to_numpy()
    error = (found - found[0]) - (distance - distance[0])
    assert np.abs(error).max() <= within


@COUNTERS
@given(
    modulus=st.one_of(
        st.sampled_from([6553.6, 10_000.0, 65_536.0, 100_000.0]),
        st.integers(25_000, 400_000).map(lambda tenths: tenths / 10.0),
    ),
    begin=st.floats(0.0, 1.0),
    rate=st.sampled_from([1.0, 2.0, 10.0]),
    with_speed=st.booleans(),
    seed=st.integers(0, 99),
)
def test_counters_that_wrap_go_on(tmp_path, modulus, begin, rate, with_speed, seed):
    """At known and at random moduli: how far it went meanwhile is exact, or as the speed says."""
    seconds, speed, distance = motion(700.0, rate, seed)
    start = modulus - begin * min(modulus, 0.9 * distance[-1])
    wrapped = np.round((distance + start) % modulus, 1) % modulus
    wraps = np.count_nonzero(np.diff(wrapped) < -0.5 * modulus)
    trip = read_rows(tmp_path, rows_of(seconds, speed, wrapped), with_speed=with_speed)
    report = report_of(trip)
    assert_grows(trip, distance, 0.2 + wraps * (4.0 if with_speed else 12.0) / rate)
    assert bool(report.count("counter")) == bool(wraps)
    assert report.counts.keys() <= {"counter"}
    before = int(np.argmax(np.diff(wrapped) < 0.0)) + 1 if wraps else seconds.size
    np.testing.assert_array_equal(
        trip["/train/state"]["position"].iloc[:before], np.round(wrapped, 1)[:before]
    )


@COUNTERS
@given(
    share=st.floats(0.1, 0.9),
    at_rest=st.booleans(),
    rate=st.sampled_from([1.0, 10.0]),
    with_speed=st.booleans(),
    seed=st.integers(0, 99),
)
def test_counters_that_start_anew_go_on(tmp_path, share, at_rest, rate, with_speed, seed):
    seconds, speed, distance = motion(700.0, rate, seed)
    resting = stops(speed)
    place = int(share * seconds.size)
    if at_rest and resting.size:
        place = int(resting[np.argmin(np.abs(resting - place))])
    # The last samples of a file may be spikes.
    assume(place + 5 < seconds.size)
    anew = distance + 700.0
    # Near where counters wrap, to start anew is to wrap.
    assume(np.abs(anew[place - 1] - np.array([6_553.6, 10_000.0])).min() > 100.0)
    anew[place:] -= anew[place]
    trip = read_rows(tmp_path, rows_of(seconds, speed, anew), with_speed=with_speed)
    report = report_of(trip)
    assert report.count("counter", COLUMN) == seconds.size - place
    assert "started anew" in "".join(report.lines())
    assert_grows(trip, distance, 0.2 + (1.0 if with_speed else 12.0) / rate)
    raw = repairs_of(trip)
    assert len(raw) == seconds.size - place
    np.testing.assert_allclose(raw["raw_value"], np.round(anew[place:], 1), atol=1e-9)


@pytest.mark.parametrize("with_speed", [True, False])
@pytest.mark.parametrize(
    ("rate", "first", "seed"), [(1.0, True, 0), (10.0, False, 1), (10.0, True, 2), (1.0, False, 2)]
)
def test_counters_that_count_down_after_the_train_turned(tmp_path, rate, with_speed, first, seed):
    seconds, speed, distance = motion(900.0, rate, seed)
    resting = stops(speed)
    turn = int(resting[np.argmin(np.abs(distance[resting] - 0.5 * distance[-1]))])
    position = 40_000.0 + distance
    if first:
        position[:turn] = 2.0 * position[turn] - position[:turn]
    else:
        position[turn:] = 2.0 * position[turn] - position[turn:]
    trip = read_rows(tmp_path, rows_of(seconds, speed, position), with_speed=with_speed)
    assert_grows(trip, distance, 3.0)
    assert report_of(trip).counts.keys() == {"counter"}
    assert "counted down" in "".join(report_of(trip).lines())


@pytest.mark.parametrize("size", [+2_500.0, -2_500.0, +300.0])
def test_steps_of_unknown_cause_stay_and_are_reported(tmp_path, size):
    seconds, speed, distance = motion(700.0)
    position = 30_000.0 + distance
    position[3_000:] += size
    trip = read_rows(tmp_path, rows_of(seconds, speed, position))
    report = report_of(trip)
    assert report.counts == {"position_steps": 1}
    assert report.findings[0].rows == (3_002,)
    assert report.findings[0].note.startswith(f"largest {size:+.0f} m"[:12])
    np.testing.assert_allclose(trip["/train/state"]["position"], np.round(position, 1))


FROZEN_RULES = ("spikes", "frozen", "counter", "position_steps")

TOPICS = (
    "/train/state", "/train/controls", "/train/axles", "/gnss/fix", "/gnss/motion", "/environment",
)  # fmt: skip

SIZES = {"speed": 1.0, "effort": 5e3, "position": 20.0, "latitude": 3e-4}
"""How far a frozen value must be off for it to matter."""


@cache
def sampled(name: str) -> pd.DataFrame:
    """All that a train records, in one table."""
    trip = read(f"sample_logs/{name}.mcap")
    frames = [trip[topic].add_prefix(f"{topic}.") for topic in TOPICS if topic in trip]
    return pd.concat(frames, axis=1)


def coarse(frame: pd.DataFrame) -> pd.DataFrame:
    """Speeds in whole km/h, efforts in whole kN, positions in whole metres."""
    found = frame.copy()
    for name in found.columns:
        if name.endswith("speed") or "wheel_speed" in name:
            found[name] = np.round(3.6 * found[name]) / 3.6
        elif "effort" in name:
            found[name] = np.round(found[name], -3)
        elif name.endswith("position"):
            found[name] = np.round(found[name])
    return found


def judged(frame: pd.DataFrame) -> tuple[Table, list[Finding]]:
    """The frame after all rules, and what those of this page found."""
    columns = {name: frame[name].to_numpy(np.float64) for name in frame.columns}
    rows = np.arange(2, len(frame) + 2)
    table = Table(frame.index.as_unit("ns").asi8, rows, columns)
    kept, found, _ = repaired(table, Limits(), Repair(inconsistent=False, unit_suspected=False))
    return kept, [finding for finding in found if finding.rule in FROZEN_RULES]


def variants(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    rough = coarse(frame)
    satellites = [name for name in frame.columns if name.startswith("/gnss/")]
    return {
        "as it is": frame,
        "coarse": rough,
        "coarse, 1 Hz": rough.iloc[::10],
        "1 Hz": frame.iloc[::10],
        "coarse, no satellites": rough.drop(columns=satellites),
        "coarse, no position": rough.drop(columns=["/train/state.position"]),
        "coarse, the speed alone": rough[["/train/state.speed"]],
        "the speed alone": frame[["/train/state.speed"]],
        "satellites alone": frame[satellites].dropna(how="all"),
    }


@pytest.mark.parametrize("log", ["nonstop", "stopping"])
def test_sound_trips_hold_nothing_frozen(log):
    for name, frame in variants(sampled(log)).items():
        assert judged(frame)[1] == [], name


def exact_trip(cruising: float, *, position: bool = True, step: float = 0.0) -> pd.DataFrame:
    """A train without any noise: it stands, gathers speed, cruises exactly, brakes and stands."""
    rising, cruise = np.arange(0.0, 25.0, 0.05), np.full(round(10 * cruising), 25.0)
    falling = np.arange(25.0, 0.0, -0.07)
    speed = np.concatenate((np.zeros(600), rising, cruise, falling, np.zeros(900)))
    driven = np.concatenate(([0.0], np.cumsum(0.05 * (speed[1:] + speed[:-1]))))
    if step:
        speed = np.round(speed / step) * step
    index = pd.DatetimeIndex(START + np.arange(speed.size) * (SECOND // 10), tz="UTC")
    columns = {"/train/state.speed": speed}
    if position:
        columns["/train/state.position"] = 1e4 + driven
    effort = 60e3 * (np.gradient(driven, 0.1, edge_order=1) > 0.0)
    columns["/train/controls.tractive_effort"] = effort
    columns["/environment.air_temperature"] = np.full(speed.size, 285.0)
    columns["/train/controls.lever"] = np.where(effort > 0.0, 0.7, 0.0)
    return pd.DataFrame(columns, index=index)


@pytest.mark.parametrize("position", [True, False])
@pytest.mark.parametrize(
    ("cruising", "step"), [(20.0, 0.0), (600.0, 0.1), (600.0, 1 / 3.6), (20.0, 5 / 3.6)]
)
def test_a_constant_speed_is_not_frozen(cruising, step, position):
    """Nor are a train at rest, the weather, the lever and a constant effort."""
    assert judged(exact_trip(cruising, position=position, step=step))[1] == []


def freeze(
    frame: pd.DataFrame, column: str, length: float, rng: np.random.Generator
) -> tuple[pd.DataFrame, np.ndarray]:
    """A column, from a place where the train moves on, repeats its value for `length` [s]."""
    seconds = (frame.index - frame.index[0]).total_seconds().to_numpy()
    values = frame[column].to_numpy()
    known = np.isfinite(values)
    speed = next(name for name in ("/train/state.speed", "/gnss/motion.speed") if name in frame)
    free = known & (frame[speed].interpolate().to_numpy() > 5.0)
    free &= (seconds > 10.0) & (seconds < seconds[-1] - length - 5.0)
    if "effort" in column:
        free &= np.abs(values) > 10e3
    begin = rng.choice(np.flatnonzero(free))
    inside = known & (seconds > seconds[begin]) & (seconds <= seconds[begin] + length)
    spoilt = frame.copy()
    for name in {column, column.replace("latitude", "longitude")}:
        spoilt.loc[inside, name] = frame[name].iloc[begin]
    return spoilt, inside


def found_frozen(frame: pd.DataFrame, column: str, length: float, rng: np.random.Generator) -> bool:
    """Whether a frozen stretch is found, and no other column or stretch is touched."""
    spoilt, inside = freeze(frame, column, length, rng)
    kept, found = judged(spoilt)
    absent = np.isnan(kept.signals[column]) & np.isfinite(spoilt[column].to_numpy())
    size = next(SIZES[kind] for kind in SIZES if kind in column.partition(".")[2])
    off = inside & (np.abs(spoilt[column] - frame[column]).to_numpy() > size)
    # What equals the frozen value by chance just beside the stretch belongs to it.
    beside = np.flatnonzero(absent & ~inside)
    assert np.all(spoilt[column].iloc[beside] == spoilt[column][inside].iloc[0])
    touched = {finding.column for finding in found}
    assert touched <= {column, column.replace("latitude", "longitude"), column.rpartition("_")[0]}
    return not off.any() or np.count_nonzero(absent & off) > 0.9 * np.count_nonzero(off)


@pytest.mark.parametrize(
    ("log", "column", "least"),
    [
        ("nonstop", "/train/state.speed", 4),
        ("stopping", "/train/state.speed", 4),
        ("stopping", "/train/axles.wheel_speed_2", 4),
        ("nonstop", "/train/state.position", 4),
        ("stopping", "/gnss/motion.speed", 4),
        # An outage may leave less than 10 s of it.
        ("nonstop", "/gnss/fix.latitude", 3),
        # An effort of few kN is coarser than its noise and may rest.
        ("stopping", "/train/controls.tractive_effort", 3),
    ],
)
def test_frozen_values_are_found(log, column, least):
    rng = np.random.default_rng(4)
    frame = sampled(log)
    lengths = (20.0, 45.0, 120.0, 300.0)
    assert sum(found_frozen(frame, column, each, rng) for each in lengths) >= least
