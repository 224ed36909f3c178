"""Trips to write, made by hand or drawn by Hypothesis."""

import numpy as np
import pandas as pd
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trainlog.topics import EVENTS, TOPICS, Topic
from trainlog.trip import Trip, frame_of

START = 1_700_000_000 * 10**9
METADATA = {"trip": "test 1", "train": "FLIRT", "direction": "forward", "load": "12000"}
PROVENANCE = ({"step": "simulate", "seed": 7, "inputs": {"line.json": "ab" * 32}}, {"step": "fit"})
ATTACHMENTS = {"line.json": b'{"format": "trainlog/line"}', "notes": bytes(range(256))}


def trip_of(rows=60, axles=4, topics=None, step=10**8):
    """A trip with every topic (or those named), `step` ns a row, all values different or absent."""
    frames = {}
    for number, topic in enumerate(TOPICS.values()):
        if topics is not None and topic.name not in topics:
            continue
        time = START + np.arange(rows) * step + number
        frames[topic.name] = frame_of(topic, time, values_of(topic, rows, axles, seed=number))
    return Trip(frames, dict(METADATA), PROVENANCE, dict(ATTACHMENTS))


def values_of(topic: Topic, rows: int, axles: int, seed: int) -> dict[str, object]:
    if topic is EVENTS:
        slips = [f"slip of axle {row} at km 3.1 – größer" * (row % 3) for row in range(rows)]
        drivers = ["driver" if row % 2 else "" for row in range(rows)]
        words = {"message": pd.array(slips, dtype="str"), "name": pd.array(drivers, dtype="str")}
        return {"level": np.arange(rows) % 6, **words}
    random = np.random.default_rng(seed)
    data = {}
    for field in topic.fields:
        values = random.normal(50.0, 20.0, (rows, axles) if field.per_axle else rows)
        if field.name.endswith("accuracy"):
            values = np.abs(values)
        values[rows // 3 : rows // 2] = np.nan
        data[field.name] = values
    return data


def assert_same(trip: Trip, other: Trip) -> None:
    """Equal to the last bit, units included."""
    assert list(trip.topics) == list(other.topics)
    for name, frame in trip.topics.items():
        pd.testing.assert_frame_equal(frame, other[name], check_exact=True, check_freq=False)
        assert frame.attrs == other[name].attrs
        assert other[name].index.name == "time"
    assert trip.metadata == other.metadata
    # What a damaged log lost stands in a step of its own.
    steps, others = (
        [step for step in each.provenance if step.get("step") != "read damaged log"]
        for each in (trip, other)
    )
    assert steps == others
    assert trip.attachments == other.attachments


# Surrogates are not text that any file can hold.
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=40)
doubles = st.floats(allow_nan=True, allow_infinity=True, width=64)
# Squared in the covariance, so that the square must be a double.
accuracies = st.one_of(st.just(np.nan), st.floats(1e-100, 1e100), st.just(0.0))


@st.composite
def frames(draw: st.DrawFn, topic: Topic) -> pd.DataFrame:
    rows = draw(st.integers(0, 12))
    step = st.just(0) | st.integers(0, 10**9) | st.integers(0, 10**13)
    steps = draw(st.lists(step, min_size=rows, max_size=rows))
    first = draw(st.one_of(st.just(0), st.integers(0, 4 * 10**18)))
    time = first + np.cumsum(np.array(steps, dtype=np.int64))
    if topic is EVENTS:
        levels = draw(st.lists(st.integers(0, 5), min_size=rows, max_size=rows))
        listed = st.lists(texts, min_size=rows, max_size=rows)
        words = {name: pd.array(draw(listed), dtype="str") for name in ("message", "name")}
        return frame_of(topic, time, {"level": np.array(levels, dtype=np.int64), **words})
    axles = draw(st.integers(1, 8))
    data = {}
    for field in topic.fields:
        elements = accuracies if field.name.endswith("_accuracy") else doubles
        shape = (rows, axles) if field.per_axle else (rows,)
        data[field.name] = draw(hnp.arrays(np.float64, shape, elements=elements))
    return frame_of(topic, time, data)


@st.composite
def trips(draw: st.DrawFn) -> Trip:
    chosen = draw(st.sets(st.sampled_from(list(TOPICS)), max_size=4))
    values = texts | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    return Trip(
        {name: draw(frames(TOPICS[name])) for name in TOPICS if name in chosen},
        draw(st.dictionaries(texts, texts, max_size=4)),
        tuple(draw(st.lists(st.dictionaries(texts, values, max_size=3), max_size=3))),
        draw(st.dictionaries(texts, st.binary(max_size=50), max_size=2)),
    )
