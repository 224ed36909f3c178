"""Trips and the table of topics."""

import numpy as np
import pandas as pd
import pytest
from refusals import refused

from trainlog.errors import LogError
from trainlog.topics import TOPICS, TRAIN_AXLES, TRAIN_STATE, column_field
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


def test_frames_refuse_columns_that_the_topic_does_not_have():
    refused(KeyError, "", frame_of, TRAIN_STATE, [0], {"velocity": [1.0]})


def test_a_missing_topic_is_named_with_those_present():
    trip = Trip({"/train/state": state([0], [1.0])}, {"trip": "t7"})
    with pytest.raises(LogError, match=r"t7.*no topic /gnss/fix; topics loaded: /train/state"):
        trip["/gnss/fix"]
    with pytest.raises(LogError, match="has no samples"):
        _ = Trip({}).start


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
