"""Files of every version of the table of topics stay readable, with the values they were given.

Each file in `FILES` is `kept_trip` as written when its version, or its form, was current. None is
ever written again; a later version, and another form of the same, gets a file of its own.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import SeekingReader
from mcap_trips import assert_same

from trainlog.mcap import read_log, write_log
from trainlog.topics import TOPICS
from trainlog.trip import Trip, frame_of

DATA = Path(__file__).parent / "data"

FILES = {
    # Chunks of ten seconds, the row as sequence number.
    "log_version_1.mcap": "1",
    # Chunks of a minute, sequence numbers that count by chunk.
    "log_version_1_minutes.mcap": "1",
}
"""Kept files and their versions of the table of topics."""


@pytest.fixture(params=FILES)
def kept(request: pytest.FixtureRequest) -> Path:
    return DATA / str(request.param)


# What version 1 held, in full: the table of topics may grow, these columns may not go.
COLUMNS = {
    "/train/state": "position speed acceleration",
    "/train/controls": "lever tractive_effort_demand braking_effort_demand tractive_effort "
    "dynamic_braking_effort pneumatic_braking_effort",
    "/train/axles": "wheel_speed_1 wheel_speed_2 wheel_speed_3 wheel_effort_1 wheel_effort_2 "
    "wheel_effort_3",
    "/gnss/fix": "latitude longitude altitude horizontal_accuracy vertical_accuracy",
    "/gnss/motion": "speed speed_accuracy satellites pdop",
    "/environment": "speed_limit gradient curvature air_temperature head_wind",
    "/events": "level message name",
    "/estimates/state": "position position_std speed speed_std acceleration acceleration_std",
    "/estimates/running_resistance": "r0 r1 r2 mass resistance resistance_std",
    "/estimates/adhesion": "adhesion_1 adhesion_2 adhesion_3 slip_speed_1 slip_speed_2 "
    "slip_speed_3",
    "/reference": "speed tractive_effort braking_effort lateness",
    "/truth": "position speed acceleration running_resistance maximum_adhesion energy",
}
START = 1_735_689_600 * 10**9
"""2025-01-01T00:00:00Z"""

METADATA = {"trip": "kept 1", "train": "FLIRT", "line": "St.Gallen–Wil", "direction": "reverse"}
PROVENANCE = ({"step": "written by hand", "inputs": {"a": "00"}}, {"step": "second", "count": 2})
ATTACHMENTS = {"line.json": b'{"kept": true}', "train.json": b"{}"}


EVENTS = {
    "level": [1, 2, 3, 4, 5, 0],
    "message": ["departure", "slip", "", "Überlast", "a\nb", "arrival"],
    "name": ["driver", "axle 1", "", "motor", "line", "driver"],
}


def kept_trip() -> Trip:
    """Half a second between rows, the last two at the same time, each topic a bit later.

    Values are eighths that differ by topic, column and row; the third row is absent.
    """
    frames = {}
    for topic, (name, columns) in enumerate(COLUMNS.items()):
        data: dict[str, object] = dict(EVENTS)
        if name != "/events":
            for number, column in enumerate(columns.split()):
                data[column] = np.array([0, 1, np.nan, 3, 4, 5]) / 8 + topic * 100 + number * 10
        times = START + np.array([0, 1, 2, 3, 4, 4]) * 500_000_000 + topic
        kept = {column: np.array(data[column]) for column in columns.split()}
        frames[name] = frame_of(TOPICS[name], times, kept)
    return Trip(frames, METADATA, PROVENANCE, ATTACHMENTS)


def test_fields_keep_their_numbers(kept):
    """A field that moves in the table would be misread by programs with an older descriptor."""
    summary = SeekingReader(BytesIO(kept.read_bytes())).get_summary()
    for channel in summary.channels.values():
        topic = TOPICS[channel.topic]
        if topic.foxglove:
            continue
        files = FileDescriptorSet.FromString(summary.schemas[channel.schema_id].data)
        for field in files.file[0].message_type[0].field:
            assert topic.fields[field.number - 1].name == field.name
            assert channel.metadata[f"unit.{field.name}"] == topic.field(field.name).unit


def test_a_kept_file_opens_with_the_values_that_todays_writer_writes(kept, tmp_path):
    write_log(kept_trip(), tmp_path / "today.mcap")
    found = read_log(kept)
    assert_same(found, read_log(tmp_path / "today.mcap"))
    assert list(found.topics) == [name for name in TOPICS if name in COLUMNS]
    for name, columns in COLUMNS.items():
        assert set(columns.split()) <= set(found[name].columns)
