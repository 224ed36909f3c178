"""Distances whose counter starts anew, wraps or counts down, and steps that nothing explains."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import assume, given, settings, strategies as st
from ingest_logs import SECOND, START, read_plain

from trainlog.errors import InputError
from trainlog.ingest import repairs_of, report_of
from trainlog.trip import Trip

FILES = settings(max_examples=10)

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


@FILES
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


@FILES
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


def test_a_wrong_unit_is_not_taken_for_a_counter(tmp_path):
    """A counter that wraps beside a speed in km/h that is called m/s."""
    seconds, speed, distance = motion(700.0)
    wrapped = (distance + 9_000.0) % 10_000.0
    sound = report_of(read_rows(tmp_path, rows_of(seconds, speed, wrapped)))
    assert "1 times started anew or wrapped" in "".join(sound.lines())
    with pytest.raises(InputError, match=r"moves 1\d{4} m, .* gives \d+ m; check the units"):
        read_rows(tmp_path, rows_of(seconds, 3.6 * speed, wrapped))
    with pytest.raises(InputError, match=r"/train/state.position falls by .* set sign = -1"):
        read_rows(tmp_path, rows_of(seconds, speed, 50_000.0 - distance))


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


@pytest.mark.parametrize("length", [1, 2, 5, 30])
def test_a_counter_that_shows_0_for_a_moment_is_a_spike(tmp_path, length):
    seconds, speed, distance = motion(700.0)
    position = 30_000.0 + distance
    position[3_000 : 3_000 + length] = 0.0
    trip = read_rows(tmp_path, rows_of(seconds, speed, position))
    assert report_of(trip).counts == {"spikes": length}
    assert trip["/train/state"]["position"].isna().to_numpy().nonzero()[0].tolist() == list(
        range(3_000, 3_000 + length)
    )
