"""A part of a log is what slicing the whole gives, and no more of the file is read than that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from mcap_trips import START, assert_same, trip_of
from refusals import refused

from trainlog.errors import InputError, LogError
from trainlog.mcap import DamageWarning, read_log, stream_log, write_log, writer
from trainlog.mcap.contents import contents_of
from trainlog.mcap.records import Source
from trainlog.topics import ENVIRONMENT, EVENTS, GNSS_FIX, TRAIN_AXLES, TRAIN_STATE
from trainlog.trip import Trip, frame_of

SECOND = 10**9


@pytest.fixture(autouse=True)
def _short_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many small chunks, as in a long log."""
    monkeypatch.setattr(writer.parts_of, "__defaults__", (2 * SECOND, 2**20))


def shuttle(seed: int = 0, rows: int = 200) -> Trip:
    """A trip that goes back and forth, with topics of other rates, gaps and unknown positions."""
    random = np.random.default_rng(seed)
    time = START + np.cumsum(random.integers(1, 2 * 10**8, rows))
    position = 300.0 + np.cumsum(np.repeat(random.normal(0, 6, rows // 20 + 1), 20)[:rows])
    position[random.integers(0, rows, rows // 10)] = np.nan
    state = frame_of(TRAIN_STATE, time, {"position": position, "speed": random.normal(size=rows)})
    other = np.sort(random.integers(time[0] - SECOND, time[-1] + SECOND, rows // 2))
    axles = frame_of(TRAIN_AXLES, other, {"wheel_speed": random.normal(size=(rows // 2, 3))})
    moments = np.sort(random.integers(time[0], time[-1], 9))
    events = frame_of(EVENTS, moments, {"message": [f"event {n}" for n in range(9)]})
    return Trip(
        {TRAIN_STATE.name: state, TRAIN_AXLES.name: axles, EVENTS.name: events},
        {"trip": "shuttle"},
        ({"step": "made"},),
        {"note.txt": b"kept"},
    )


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Path]:
    """Logs of `shuttle`, written once."""
    folder = tmp_path_factory.mktemp("logs")

    def log(seed: int) -> Path:
        path = folder / f"{seed}.mcap"
        if not path.exists():
            write_log(shuttle(seed), path)
        return path

    return log


limits = st.one_of(st.none(), st.floats(-0.2, 1.2))


def ordered(pair: tuple[float | None, float | None]) -> tuple[float | None, float | None]:
    first, last = pair
    return (last, first) if first is not None and last is not None and first > last else pair


def in_time(trip: Trip, pair: tuple[float | None, float | None]) -> tuple[Any, Any]:
    start, span = trip.start, trip.end - trip.start
    first, last = (None if each is None else start + each * span for each in ordered(pair))
    return first, last


@cache
def whole_of(path: Path) -> Trip:
    """A log's trip, which no test changes."""
    return read_log(path)


@settings(max_examples=16)
@given(
    seed=st.integers(0, 5),
    pair=st.tuples(limits, limits),
    chosen=st.sets(st.sampled_from([TRAIN_STATE.name, TRAIN_AXLES.name, EVENTS.name]), min_size=1),
)
def test_a_span_of_time_is_the_slice_of_the_whole(seed, pair, chosen, logs):
    whole = whole_of(logs(seed))
    span = in_time(whole, pair)
    part = read_log(logs(seed), chosen, time=span)
    expected = whole.between(*span)
    kept = {name: frame for name, frame in expected.topics.items() if name in chosen}
    assert_same(replace(expected, topics=kept), part)


@settings(max_examples=16)
@given(seed=st.integers(0, 5), pair=st.tuples(limits, limits), indexed=st.booleans())
def test_a_stretch_of_the_line_is_the_slice_of_the_whole(seed, pair, indexed, logs):
    whole = whole_of(logs(seed))
    known = whole[TRAIN_STATE.name]["position"].dropna()
    least, greatest = known.min(), known.max()
    stretch = tuple(
        None if each is None else least + each * (greatest - least) for each in ordered(pair)
    )
    with pytest.MonkeyPatch.context() as patch:
        if not indexed:
            patch.setattr("trainlog.mcap.reader.decoded", lambda _: {})
        part = read_log(logs(seed), position=(stretch[0], stretch[1]))
    assert_same(whole.within(*stretch), part)


def test_little_of_the_file_is_read(tmp_path, monkeypatch):
    rows = 60_000
    time = START + np.arange(rows) * 10**7
    random = np.random.default_rng(2)
    state = frame_of(TRAIN_STATE, time, {"position": np.arange(rows) * 0.3})
    axles = frame_of(TRAIN_AXLES, time, {"wheel_speed": random.normal(size=(rows, 4))})
    path = tmp_path / "long.mcap"
    write_log(Trip({TRAIN_STATE.name: state, TRAIN_AXLES.name: axles}), path)
    size, read, counts = path.stat().st_size, Source.read, list[int]()

    def counted(source: Source, offset: int, length: int) -> bytes:
        data = read(source, offset, length)
        counts.append(len(data))
        return data

    monkeypatch.setattr(Source, "read", counted)
    start = pd.Timestamp(int(time[30_000]), tz="UTC")
    part = read_log(path, time=(start, start + pd.Timedelta("6 s")))
    assert len(part[TRAIN_AXLES.name]) == 601
    assert sum(counts) < 0.06 * size
    counts.clear()
    part = read_log(path, position=(9000.0, 9180.0))
    assert len(part[TRAIN_AXLES.name]) == 601
    assert sum(counts) < 0.1 * size


def test_only_the_columns_asked_for(tmp_path):
    trip, path = trip_of(rows=50, axles=3), tmp_path / "trip.mcap"
    write_log(trip, path)
    axles = ["wheel_effort_2", "wheel_speed_3", "wheel_speed_9"]
    asked = {TRAIN_AXLES.name: axles, EVENTS.name: ["message"], ENVIRONMENT.name: None}
    part = read_log(path, asked)
    assert part.topics.keys() == asked.keys()
    assert list(part[TRAIN_AXLES.name]) == ["wheel_speed_3", "wheel_effort_2"]
    assert list(part[EVENTS.name]) == ["message"]
    for name, frame in part.topics.items():
        pd.testing.assert_frame_equal(frame, trip[name][list(frame)], check_freq=False)
        units = trip[name].attrs["units"]
        assert frame.attrs["units"] == {column: units[column] for column in frame}


@pytest.mark.parametrize(
    ("asked", "error", "said"),
    [
        ({"topics": {TRAIN_AXLES.name: ["wheel_speed"]}}, LogError, "no column wheel_speed"),
        ({"topics": {TRAIN_STATE.name: ["mood"]}}, LogError, "no column mood"),
        ({"topics": {"/train/mood": None}}, LogError, "no topic /train/mood"),
        ({"time": ("noon", None)}, InputError, "'noon' is not a time"),
        ({"time": ("2025-01-02", "2025-01-01")}, InputError, "is after"),
        ({"time": "2025-01-02"}, InputError, "not two limits"),
        ({"position": (5.0, 1.0)}, InputError, "no stretch"),
        ({"position": 5.0}, InputError, "not two limits"),
        ({"rows": 0}, InputError, "rows is 0"),
    ],
)
def test_what_cannot_be_asked_for(asked, error, said, logs):
    if "rows" not in asked:
        refused(error, said, read_log, logs(0), **asked)
    refused(error, said, lambda: next(stream_log(logs(0), **asked)))


def test_a_log_without_positions_says_so(tmp_path):
    path = tmp_path / "trip.mcap"
    write_log(trip_of(rows=30, topics=[GNSS_FIX.name]), path)
    said = "does not know where the train was"
    assert refused(LogError, said, read_log, path, position=(0, 1)).file == path


def together(pieces: list[Trip]) -> Trip:
    """The pieces one after the other."""
    topics = {name: pd.concat([piece[name] for piece in pieces]) for name in pieces[0].topics}
    return replace(pieces[0], topics=topics)


@settings(max_examples=10)
@given(
    seed=st.integers(0, 5),
    rows=st.one_of(st.integers(1, 40), st.just(10**6)),
    by_time=st.one_of(st.none(), st.tuples(limits, limits)),
    by_position=st.booleans(),
)
def test_the_pieces_are_the_whole(seed, rows, by_time, by_position, logs):
    path = logs(seed)
    span = None if by_time is None else in_time(read_log(path), by_time)
    stretch = (250.0, 340.0) if by_position else None
    pieces = list(stream_log(path, time=span, position=stretch, rows=rows))
    whole = read_log(path, time=span, position=stretch)
    assert_same(whole, together(pieces))
    end = 0
    for piece in pieces:
        assert (piece.metadata, piece.attachments) == (whole.metadata, whole.attachments)
        times = [frame.index.as_unit("ns").asi8 for frame in piece.topics.values() if len(frame)]
        assert all(each[0] >= end for each in times)
        end = max((int(each[-1]) for each in times), default=end)


def test_pieces_end_where_chunks_do(tmp_path):
    path = tmp_path / "trip.mcap"
    write_log(trip_of(rows=3000, topics=[TRAIN_STATE.name]), path)
    with Source(path) as source:
        held = [chunk.messages for chunk in contents_of(source).chunks]
    rows = 2 * max(held)
    pieces = list(stream_log(path, rows=rows))
    assert len(pieces) > 1
    assert all(max(held) <= len(piece[TRAIN_STATE.name]) <= rows for piece in pieces[:-1])
    assert len(list(stream_log(path, rows=1))) == len(held)


def flipped(path: Path, number: int, folder: Path) -> tuple[Path, int]:
    """The log with one chunk damaged, and how many messages that chunk holds."""
    with Source(path) as source:
        place = contents_of(source).chunks[number]
    data = bytearray(path.read_bytes())
    data[place.offset + place.length // 2] ^= 0x10
    (folder / "flipped.mcap").write_bytes(data)
    return folder / "flipped.mcap", place.messages


def test_damage_is_reported_behind_the_last_piece_and_not_met_outside_of_a_part(logs, tmp_path):
    path, lost = flipped(logs(2), 5, tmp_path)
    pieces = []
    with pytest.warns(DamageWarning) as caught:
        pieces += stream_log(path, rows=50)
    account = caught[0].message.account
    assert account.messages_lost == lost
    assert account.messages == sum(len(f) for piece in pieces for f in piece.topics.values())
    with pytest.warns(DamageWarning):
        assert_same(read_log(path), together(pieces))
    whole = whole_of(logs(2))
    span = (whole.start, whole.start + pd.Timedelta("1 s"))
    assert_same(whole.between(*span), read_log(path, time=span))
