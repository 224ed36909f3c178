"""Trips and the table of topics."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from refusals import refused

from tests.mcap_trips import START, trips
from trainlog.errors import InputError, LogError
from trainlog.spans import in_spans, spans_within
from trainlog.topics import ESTIMATED_STATE, EVENTS, TOPICS, TRAIN_AXLES, TRAIN_STATE, column_field
from trainlog.trip import Trip, frame_of

SECOND = 1_000_000_000


def state(times: list[float], speeds: list[float]) -> pd.DataFrame:
    return frame_of(TRAIN_STATE, np.array(times) * SECOND, {"speed": speeds})


def test_every_number_has_a_unit_and_every_field_a_meaning():
    for topic in TOPICS.values():
        names = [field.name for field in topic.fields]
        assert len(names) == len(set(names))
        for field in topic.fields:
            assert field.meaning
            assert field.unit or field.interpolation == "none"


def test_columns_of_axles_are_numbered_from_one():
    both = {"wheel_effort": np.ones((1, 2)), "wheel_speed": np.ones((1, 2))}
    names = [f"{name}_{axle}" for name in ("wheel_speed", "wheel_effort") for axle in (1, 2)]
    assert list(frame_of(TRAIN_AXLES, [0], both)) == names
    assert column_field(TRAIN_AXLES, "wheel_speed_12").unit == "m/s"
    for wrong in ("wheel_speed", "wheel_speed_0", "wheel_speed_x", "speed"):
        refused(KeyError, "", column_field, TRAIN_AXLES, wrong)
    refused(KeyError, "", frame_of, TRAIN_STATE, [0], {"velocity": [1.0]})


def test_a_missing_topic_is_named_with_those_present():
    trip = Trip({"/train/state": state([0], [1.0])}, {"trip": "t7"})
    with pytest.raises(LogError, match=r"t7.*no topic /gnss/fix; topics loaded: /train/state"):
        trip["/gnss/fix"]
    with pytest.raises(LogError, match="has no samples"):
        _ = Trip({}).start
    trip = Trip({EVENTS.name: frame_of(EVENTS, [START], {})}, {"trip": "t7"})
    refused(LogError, r"t7.*does not know where.*slice it by time", trip.within, 0, 1)


def test_trips_are_equal_by_metadata_and_samples():
    one = Trip({"/train/state": state([0, 1], [3.0, np.nan])}, {"train": "T"})
    same = Trip({"/train/state": state([0, 1], [3.0, np.nan])}, {"train": "T"}).with_step("read")
    assert one == same
    assert one != Trip(one.topics, {"train": "U"})
    assert one != Trip({"/train/state": state([0, 1], [3.0, 4.0])}, {"train": "T"})
    assert one != Trip({"/train/state": state([0, 2], [3.0, np.nan])}, {"train": "T"})
    assert one != Trip({}, {"train": "T"})
    scaled = one["/train/state"].copy()
    scaled.attrs = {"topic": "/train/state", "units": {**scaled.attrs["units"], "speed": "km/h"}}
    assert one != Trip({"/train/state": scaled}, {"train": "T"})
    assert one != "one"


instants = st.integers(0, 5 * 10**18)


def driven(times: list[float], positions: list[float]) -> Trip:
    """A trip with its position, and an event every half second."""
    halves = np.arange(times[0], times[-1] + 0.25, 0.5)
    state = frame_of(TRAIN_STATE, START + np.array(times) * SECOND, {"position": positions})
    shown = {"message": [f"{at:g} s" for at in halves]}
    events = frame_of(EVENTS, START + halves * SECOND, shown)
    return Trip({TRAIN_STATE.name: state, EVENTS.name: events}, {"trip": "test"})


def stamp(nanoseconds: int) -> pd.Timestamp:
    return pd.Timestamp(nanoseconds, tz="UTC")


def messages(trip: Trip) -> list[str]:
    return trip[EVENTS.name]["message"].tolist()


@settings(max_examples=25)
@given(trips(), instants)
def test_slices_by_time_partition_a_trip(trip, at):
    before = trip.between(None, stamp(at))
    after = trip.between(stamp(at + 1), None)
    for name, frame in trip.topics.items():
        together = pd.concat([before[name], after[name]])
        pd.testing.assert_frame_equal(together, frame, check_exact=True)
        assert before[name].attrs == after[name].attrs == frame.attrs


def test_both_ends_belong_to_a_slice_and_a_time_without_zone_is_utc():
    trip = driven([0, 1, 2, 3], [0, 10, 20, 30])
    start = stamp(START + SECOND)
    cut = trip.between(
        start.tz_localize(None), stamp(START + 2 * SECOND).tz_convert("Europe/Zurich")
    )
    assert cut[TRAIN_STATE.name]["position"].tolist() == [10, 20]
    assert messages(cut) == ["1 s", "1.5 s", "2 s"]


def test_a_slice_is_a_step_of_provenance_and_leaves_the_trip_as_it_was():
    trip = driven([0, 1], [0, 10])
    cut = trip.between(start=stamp(START)).within(2, None)
    assert [step["step"] for step in cut.provenance] == ["slice", "slice"]
    assert cut.provenance[0]["time"] == [stamp(START).isoformat(), None]
    assert cut.provenance[1]["position"] == [2.0, None]
    # As JSON, which has no infinity.
    assert trip.within(0, np.inf).provenance[-1]["position"] == [0.0, None]
    assert cut.metadata == trip.metadata
    assert trip.provenance == ()
    assert len(trip[TRAIN_STATE.name]) == 2


@pytest.mark.parametrize(
    ("start", "end", "said"),
    [
        ("2024-05-02", "2024-05-01", r"2024-05-02.* is after 2024-05-01"),
        ("soon", None, "'soon' is not a time"),
        (None, pd.NaT, "'NaT' is not a time"),
        (None, "0001-01-01", "not a time"),
    ],
)
def test_times_that_make_no_slice_are_refused(start, end, said):
    caught = refused(InputError, said, driven([0, 1], [0, 10]).between, start, end)
    assert caught.remedy


def test_the_smoothed_position_counts_where_there_is_one():
    trip = driven([0, 1], [0, 10])
    smoothed = frame_of(ESTIMATED_STATE, START + np.array([0, SECOND]), {"position": [100, 110]})
    assert messages(trip.with_topic(smoothed).within(100, 104)) == ["0 s"]
    unknown = frame_of(ESTIMATED_STATE, START + np.array([0, SECOND]), {"speed": [1.0, 1.0]})
    assert messages(trip.with_topic(unknown).within(0, 4)) == ["0 s"]


@pytest.mark.parametrize("limits", [(2, 1), (np.nan, 1), (0, np.nan), ("km 1", 2)])
def test_stretches_that_are_none_are_refused(limits):
    refused(InputError, "there is no stretch", driven([0, 1], [0, 10]).within, *limits)


@st.composite
def rides(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    rows = draw(st.integers(1, 15))
    steps = draw(hnp.arrays(np.int64, rows, elements=st.integers(0, 50)))
    positions = st.one_of(
        st.integers(-20, 20).map(float), st.floats(-1e9, 1e9), st.just(np.nan), st.just(np.inf)
    )
    return np.cumsum(steps), draw(hnp.arrays(np.float64, rows, elements=positions))


limits = st.one_of(st.integers(-20, 20).map(float), st.floats(-1e9, 1e9))


@settings(max_examples=40)
@given(rides(), limits, limits)
def test_spans_hold_the_samples_within_the_limits_and_what_lies_between_them_on_the_line(
    ride, one, other
):
    time, position = ride
    start, end = sorted((one, other))
    spans = spans_within(time, position, start, end)
    inside, known = (position >= start) & (position <= end), np.isfinite(position)
    held = in_spans(time, spans)
    assert held[inside].all()
    # A time at which several positions were recorded is within if one of them is.
    assert not held[known & ~np.isin(time, time[inside])].any()
    time, position = time[known], position[known]
    if len(spans):
        assert (spans[:, 0] <= spans[:, 1]).all()
        assert (spans[1:, 0] > spans[:-1, 1] + 1).all()
        assert spans[0, 0] >= time[0]
        assert spans[-1, 1] <= time[-1]
    if len(time):
        between = np.setdiff1d(np.arange(time[0], time[-1] + 1), time)
        place = np.interp(between, time, position)
        slack = 1e-6 * (1.0 + np.abs(place))
        held = in_spans(between, spans)
        assert held[(place > start + slack) & (place < end - slack)].all()
        assert not held[(place < start - slack) | (place > end + slack)].any()
