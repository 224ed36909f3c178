"""Topics on one clock without inventing data; one motion against laws that have closed forms."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused

from analysis.trajectory.rollout import brake_below
from tests.mcap_trips import START, frames, trip_of
from trainlog.arrays import FloatArray
from trainlog.errors import InputError, LogError
from trainlog.formats.railway import read_train
from trainlog.formats.samples import DEFAULT_TRAIN, sample
from trainlog.railway import Configuration, EffortCurve, Trajectory
from trainlog.railway.motion import (
    SUBSTEPS,
    Brakes,
    Motion,
    Traction,
    advance,
    brake_backwards,
    braking_curve,
    landing,
    pull_forwards,
    traverse,
)
from trainlog.resampling import (
    TimeDistance,
    difference,
    grid_over,
    interpolated,
    joined,
    on_grid,
    planned_time_distance,
    regular_clock,
    resampled,
    resampled_frame,
)
from trainlog.topics import EVENTS, TOPICS, TRAIN_AXLES, TRAIN_CONTROLS, TRAIN_STATE, column_field
from trainlog.trip import Trip, frame_of
from trainlog.units import NANOSECONDS

SECOND = 10**9


def clock(*times: float) -> pd.DatetimeIndex:
    nanoseconds = START + np.round(np.array(times) * SECOND).astype(np.int64)
    return pd.DatetimeIndex(nanoseconds.view("M8[ns]"), tz="UTC")


def state(times: list[float], speeds: list[float]) -> pd.DataFrame:
    return frame_of(TRAIN_STATE, clock(*times), {"speed": speeds})


def controls(times: list[float], levers: list[float]) -> pd.DataFrame:
    return frame_of(TRAIN_CONTROLS, clock(*times), {"lever": levers})


sampled = st.sampled_from([topic for topic in TOPICS.values() if topic is not EVENTS])
drawn = sampled.flatmap(frames)
some_times = st.lists(st.integers(0, 4 * 10**18 + 12 * 10**13), max_size=12).map(
    lambda each: pd.DatetimeIndex(np.array(sorted(each), dtype="M8[ns]"), tz="UTC")
)


@settings(max_examples=40)
@given(drawn)
def test_at_its_own_times_a_topic_is_what_it_was(frame):
    again = resampled_frame(frame, pd.DatetimeIndex(frame.index), max_gap=0.001)
    pd.testing.assert_frame_equal(again, frame, check_exact=True)
    assert again.attrs == frame.attrs


@st.composite
def frames_and_times(draw: st.DrawFn) -> tuple[pd.DataFrame, pd.DatetimeIndex]:
    """A frame, and times at, between and around its rows."""
    frame = draw(drawn)
    known = frame.index.asi8
    steps = st.one_of(st.integers(-5, 5), st.integers(-(10**12), 10**12))
    times = sorted(max(0, int(at) + draw(steps)) for at in np.repeat(known, 2))
    every = pd.DatetimeIndex(np.array(times, dtype="M8[ns]"), tz="UTC")
    return frame, every.append(draw(some_times)).sort_values()


@settings(max_examples=40)
@given(frames_and_times(), st.one_of(st.none(), st.floats(1e-9, 1e4)))
def test_no_value_lies_beyond_its_neighbours_nor_outside_the_record(given_, max_gap):
    frame, times = given_
    found = resampled_frame(frame, times, max_gap=max_gap)
    known, wanted = frame.index.asi8, times.asi8
    for name in frame.columns:
        values = frame[name].to_numpy()
        for at, value in zip(wanted, found[name], strict=True):
            if np.isnan(value):
                continue
            before = values[known <= at][-1]
            after = before if at in known else values[known > at][0]
            assert min(before, after) <= value <= max(before, after)
            if column_field(TOPICS[frame.attrs["topic"]], name).interpolation == "previous":
                assert value == before
            if max_gap is not None and at not in known:
                gap = known[known > at][0] - known[known <= at][-1]
                assert gap <= max_gap * SECOND


def test_lines_are_followed_and_held_values_held():
    times = clock(-1.0, 0.0, 0.5, 1.5, 2.0, 3.0)
    speed = interpolated(state([0, 1, 2], [0.0, 10.0, 20.0]), "speed", times)
    np.testing.assert_array_equal(speed, [np.nan, 0.0, 5.0, 15.0, 20.0, np.nan])
    lever = interpolated(controls([0, 1, 2], [0.0, 0.5, 1.0]), "lever", times)
    np.testing.assert_array_equal(lever, [np.nan, 0.0, 0.0, 0.5, 1.0, np.nan])


def test_gaps_and_unknown_samples_are_not_bridged():
    frame = state([0, 1, 11, 12, 13], [0.0, 1.0, 11.0, np.nan, 13.0])
    times = clock(0.5, 1.0, 6.0, 11.0, 11.5, 12.5, 13.0)
    np.testing.assert_array_equal(
        interpolated(frame, "speed", times, max_gap=5.0),
        [0.5, 1.0, np.nan, 11.0, np.nan, np.nan, 13.0],
    )
    assert interpolated(frame, "speed", times)[2] == 6.0
    held = interpolated(controls([0, 10], [0.5, 1.0]), "lever", clock(0, 5, 10), max_gap=5.0)
    np.testing.assert_array_equal(held, [0.5, np.nan, 1.0])


def test_a_trip_on_one_clock_keeps_its_events_where_they_were():
    trip = trip_of(rows=21)
    again = resampled(trip, 0.05, max_gap=1.0)
    for name, frame in again.topics.items():
        if name == EVENTS.name:
            pd.testing.assert_frame_equal(frame, trip[name])
        else:
            assert len(frame) == 41
            assert frame.index[0] == trip.start
            assert frame.attrs == trip[name].attrs
    last = again.provenance[-1]
    assert (last["step"], last["seconds"], last["max_gap"]) == ("resample", 0.05, 1.0)
    assert again.metadata == trip.metadata


def test_columns_of_several_topics_stand_side_by_side_with_their_units():
    trip = Trip({}).with_topic(state([0, 1], [0.0, 10.0]))
    trip = trip.with_topic(controls([0, 0.4, 2], [0.0, 0.5, 1.0]))
    trip = trip.with_topic(
        frame_of(TRAIN_AXLES, clock(0.0, 1.0), {"wheel_speed": np.array([[0, 1], [10, 11]])})
    )
    names = ["/train/state.speed", "/train/controls.lever", "/train/axles.wheel_speed"]
    table = joined(trip, names, 0.5, max_gap=1.0)
    assert list(table.columns) == [
        *names[:2],
        "/train/axles.wheel_speed_1",
        "/train/axles.wheel_speed_2",
    ]
    assert table.attrs["units"]["/train/axles.wheel_speed_2"] == "m/s"
    np.testing.assert_array_equal(
        table.to_numpy(),
        [
            [0.0, 0.0, 0.0, 1.0],
            [5.0, np.nan, 5.0, 6.0],  # the lever was not recorded for more than a second
            [10.0, np.nan, 10.0, 11.0],
            [np.nan, np.nan, np.nan, np.nan],
            [np.nan, 1.0, np.nan, np.nan],
        ],
    )


@pytest.mark.parametrize(
    ("columns", "on", "error", "said"),
    [
        (["speed"], 1.0, InputError, "'speed' is not a column of a topic"),
        (["/train/state.velocity"], 1.0, LogError, "no column velocity; its columns are"),
        (["/gnss/fix.latitude"], 1.0, LogError, "no topic /gnss/fix"),
        (["/train/state.speed"] * 2, 1.0, InputError, "joined twice"),
        (["/events.message"], 1.0, InputError, "no values between its samples"),
        (["/train/state.speed"], 0.0, InputError, "steps of 0 s"),
        (["/train/state.speed"], clock(1.0, 0.0), InputError, "do not increase"),
    ],
)
def test_what_cannot_be_joined_is_named(columns, on, error, said):
    trip = Trip({}).with_topic(state([0, 1], [0.0, 10.0]))
    trip = trip.with_topic(frame_of(EVENTS, clock(0.0), {"message": ["departure"]}))
    refused(error, said, joined, trip, columns, on, max_gap=None)


def two_topics() -> Trip:
    both = state([0.0, 1.0, 2.0], [0.0, 1.0, 2.0]), controls([0.0, 2.0], [0.0, 1.0])
    return Trip({frame.attrs["topic"]: frame for frame in both})


@pytest.mark.parametrize(
    "step", [pd.Timedelta("500ms"), np.timedelta64(500, "ms"), 0.5, np.float32(0.5)]
)
def test_a_step_is_a_duration_or_seconds(step):
    steady = resampled(two_topics(), step, max_gap=None)
    assert len(steady["/train/state"]) == 5
    assert len(joined(two_topics(), ["/train/state.speed"], on=step, max_gap=None)) == 5
    assert steady.provenance[-1]["seconds"] == 0.5


@pytest.mark.parametrize(
    ("on", "gap", "said"),
    [
        *((on, 1.0, "clock") for on in ("500ms", [0, 1], np.arange(3), None, True, pd.NaT)),
        (pd.Timedelta("-1s"), 1.0, "clock"),
        *((0.5, gap, "max_gap is") for gap in (-1, 0, float("nan"), "1", pd.Timedelta("1s"))),
    ],
)
def test_what_is_no_clock_or_no_longest_gap_is_refused(on, gap, said):
    refused(InputError, said, resampled, two_topics(), on, max_gap=gap)
    if not isinstance(on, str):
        refused(InputError, said, joined, two_topics(), ["/train/state.speed"], on, max_gap=gap)


def curve(seconds: np.ndarray, position: np.ndarray) -> TimeDistance:
    return TimeDistance(0, np.rint(seconds * NANOSECONDS).astype(np.int64), position)


def test_a_stop_lies_between_arrival_and_departure():
    stopping = curve(np.array([0.0, 10.0, 40.0, 50.0]), np.array([0.0, 200.0, 200.0, 400.0]))
    at = np.array([0.0, 100.0, 200.0, 300.0, 400.0])
    assert stopping.arrival_at(at) == pytest.approx([0.0, 5.0, 10.0, 45.0, 50.0])
    assert stopping.departure_at(at) == pytest.approx([0.0, 5.0, 40.0, 45.0, 50.0])


def test_places_passed_in_a_gap_of_the_recording_are_unknown():
    seconds = np.array([0.0, 1.0, 31.0, 32.0, 132.0, 133.0])
    position = np.array([0.0, 20.0, 620.0, 640.0, 640.0, 660.0])
    passed = on_grid(curve(seconds, position), np.arange(0.0, 661.0, 20.0))
    unknown = (passed.position > 20.0) & (passed.position < 620.0)
    assert (np.isnan(passed.time) == unknown).all()
    # It stood through the second gap, so that nothing is missing there.
    assert passed.time[-1] == 133.0


def test_stops_a_few_metres_apart_make_no_spike_of_lateness():
    seconds = np.arange(241.0)
    one, other = (
        curve(seconds, np.interp(seconds, [0.0, 100.0, 140.0, 240.0], [0.0, stop, stop, 2_000.0]))
        for stop in (1_003.0, 988.0)
    )
    grid = grid_over([one, other])
    for trip, reference in ((one, other), (other, one)):
        behind = difference(on_grid(trip, grid), on_grid(reference, grid))
        assert np.abs(behind.time).max() < 3.0


def test_a_plan_is_passed_as_constant_effort_moves_a_train():
    train = read_train(sample(DEFAULT_TRAIN))
    plan = Trajectory(
        "line",
        train.name,
        np.array([0.0, 500.0, 1000.0]),
        (Configuration.of(train),),
        np.array([[0.0, 20.0, 0.0]]),
        np.array([[0.0, 50.0, 100.0]]),
        np.array([53e3, 0.0]),
        np.array([[0.0, 53e3]]),
        100.0,
    )
    # Constant acceleration: s = a t^2 / 2 with a = 0.4 m/s^2.
    found = planned_time_distance(plan, 0)
    assert found.arrival_at([20.0, 125.0, 500.0]) == pytest.approx([10.0, 25.0, 50.0], abs=0.05)
    assert found.covered == (0.0, 1000.0)


def test_grids_and_clocks_that_cannot_be_are_refused():
    refused(InputError, "no trip has a position", grid_over, [curve(np.empty(0), np.empty(0))])
    refused(InputError, "steps of 0 m", grid_over, [curve(np.array([0.0]), np.array([0.0]))], 0.0)
    one = on_grid(curve(np.array([0.0, 1.0]), np.array([0.0, 10.0])), np.array([0.0, 10.0]))
    other = on_grid(curve(np.array([0.0]), np.array([0.0])), np.array([0.0]))
    refused(InputError, "different grids", difference, one, other)
    hour = pd.Timestamp("2025-01-01T00Z"), pd.Timestamp("2025-01-01T01Z")
    said = r"steps of 1e-09 s has 3,600,000,000,000 instants"
    refused(InputError, said, regular_clock, *hour, 1e-9)


LENGTH, CELLS = 4_000.0, 800


def motion(drag0: float = 0.0, drag1: float = 0.0, drag2: float = 0.0) -> Motion:
    return Motion(
        np.ones(1),
        np.full((1, CELLS, SUBSTEPS + 1), drag0),
        np.array([drag1]),
        np.full((1, CELLS), drag2),
        np.full(CELLS, LENGTH / CELLS),
    )


POSITIONS = np.linspace(0.0, LENGTH, CELLS + 1)
FREE = np.full((1, CELLS + 1), np.inf)


def pulled(pull: float, power: float, drag: float, least: float = 0.0, **given: Any) -> FloatArray:
    """``z`` of full traction from standstill, without a ceiling."""
    cells = given.get("cells", CELLS)
    traction = Traction.of(np.full(cells, pull), np.array([power]), given.get("curve"))
    drag0, none = np.full(cells, drag), np.zeros(cells)
    step = np.full(cells, LENGTH / cells)
    return pull_forwards(np.full(cells + 1, np.inf), traction, drag0, 0.0, none, step, least)


def off_by(law: Callable[[FloatArray], FloatArray], **given: Any) -> list[float]:
    """Largest error of the speed with steps, and with half of them [m/s]."""
    found = []
    for cells in (CELLS, 2 * CELLS):
        exact = law(np.linspace(0.0, LENGTH, cells + 1))
        z = pulled(**given, cells=cells)
        found.append(float(np.abs(np.sqrt(2.0 * z) - exact)[cells // 8 :].max()))
    return found


@settings(max_examples=40)
@given(st.floats(0.1, 2.0), st.floats(0.0, 0.09))
def test_constant_effort_gives_constant_acceleration(a, drag):
    z = pulled(a, np.inf, drag)
    np.testing.assert_allclose(z, (a - drag) * POSITIONS, rtol=1e-9, atol=1e-9)


def test_constant_power_lets_the_cube_of_the_speed_grow_with_the_distance():
    pull, power = 1.0, 10.0
    reached = power / pull
    begin = 0.5 * reached**2 / pull

    def law(s: FloatArray) -> FloatArray:
        by_power = np.cbrt(reached**3 + 3.0 * power * np.maximum(s - begin, 0.0))
        return np.where(s < begin, np.sqrt(2.0 * pull * s), by_power)

    whole, half = off_by(law, pull=pull, power=power, drag=0.0)
    assert whole < 0.05
    assert half == pytest.approx(0.5 * whole, rel=0.05)


def test_an_effort_that_falls_with_the_speed_follows_its_curve():
    """``dv/dt = a (1 - v/w)``: the distance to a speed is ``-w/a (v + w ln(1 - v/w))``."""
    a, w = 0.8, 40.0
    curve = EffortCurve(np.array([0.0, w]), np.array([a, 0.0]))
    speeds = np.linspace(0.0, 0.999 * w, 20_000)
    needed = -w / a * (speeds + w * np.log(1.0 - speeds / w))
    whole, half = off_by(
        lambda s: np.interp(s, needed, speeds), pull=np.inf, power=np.inf, drag=0.0, curve=curve
    )
    assert whole < 0.05
    assert half == pytest.approx(0.5 * whole, rel=0.05)


def test_a_train_that_drag_overcomes_stands_or_crawls():
    assert pulled(0.1, np.inf, 0.2).max() == 0.0
    np.testing.assert_array_equal(pulled(0.1, np.inf, 0.2, 0.125)[1:], 0.125)


@settings(max_examples=40)
@given(st.floats(0.2, 1.5), st.floats(0.0, 0.1), st.floats(0.0, 0.1))
def test_full_braking_backwards_adds_brake_and_drag(b, drag, pull):
    most = np.full((1, CELLS), b)
    brakes = Brakes(most, most, np.zeros_like(most), 0.0)
    z = brake_backwards(FREE, 0.0, np.full(CELLS, pull), brakes, motion(drag))
    np.testing.assert_allclose(z[0], (b + drag - pull) * (LENGTH - POSITIONS), rtol=1e-9, atol=1e-9)


def test_a_dynamic_brake_is_limited_by_its_power():
    """Power is force times speed, here that of the beginning of each cell."""
    none, power = np.zeros((1, CELLS)), 10.0
    brakes = Brakes(none + 9.0, none, none + 1.0, power)
    z = brake_backwards(FREE, 0.0, np.zeros(CELLS), brakes, motion())
    v = np.sqrt(2.0 * z[0])
    braked = -np.diff(z[0]) / np.diff(POSITIONS)
    np.testing.assert_allclose(braked, np.minimum(1.0, power / v[:-1]), rtol=1e-3)


def test_the_braking_curve_of_one_deceleration_meets_the_limits():
    limits = np.where(POSITIONS < 2_000.0, 30.0, 10.0)
    curve = braking_curve(POSITIONS, limits, 0.5)
    before = POSITIONS < 2_000.0
    expected = np.minimum(30.0, np.sqrt(10.0**2 + 2.0 * 0.5 * (2_000.0 - POSITIONS[before])))
    np.testing.assert_allclose(curve[before], expected)
    np.testing.assert_allclose(curve[~before], 10.0)


@settings(max_examples=20)
@given(st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_trains_side_by_side_move_as_each_alone(q, seed):
    """Those too that come to a stand in a cell, or begin with none."""
    same = partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12)
    random, n = np.random.default_rng(seed), 12
    many = Motion(
        random.uniform(0.5, 1.5, q),
        random.uniform(-0.3, 0.6, (q, n, SUBSTEPS + 1)),
        random.uniform(0.0, 0.01, q),
        random.uniform(0.0, 1e-4, (q, n)),
        random.uniform(0.5, 300.0, n),
    )
    z = random.uniform(0.0, 300.0, (q, n + 1)) * random.integers(0, 2, (q, n + 1))
    effort, highest = random.uniform(-0.2, 1.0, (q, n)), random.uniform(20.0, 90.0, (q, n + 1))
    reached, seconds = traverse(z, effort, many)
    limit = random.uniform(0.2, 1.0, (3, q, n))
    curves = brake_backwards(highest, 0.0, effort[0], Brakes(*limit, 20.0), many)
    driven, braking = brake_below(curves, effort, 50.0, many)
    for a in range(q):
        one = Motion(many.gain[[a]], many.drag0[[a]], many.drag1[[a]], many.drag2[[a]], many.step)
        for k in range(n):
            cell = one.drag0[0, k], one.drag1[0], one.drag2[0, k], one.step[k]
            same((reached[a, k], seconds[a, k]), advance(z[a, k], effort[a, k], *cell))
            if braking[a, k] > 0.0:
                met = landing(driven[a, k], driven[a, k + 1], *cell) / one.gain[0]
                same(braking[a, k], effort[a, k] - met)
        brakes = Brakes(*limit[:, [a]], 20.0)
        same(curves[[a]], brake_backwards(highest[[a]], 0.0, effort[0], brakes, one))
        alone = brake_below(curves[[a]], effort[[a]], 50.0, one)
        same(driven[[a]], alone[0])
        same(braking[[a]], alone[1])
