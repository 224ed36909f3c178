"""Measurement files: channels by name, in the file's own units, tables by clock."""

from __future__ import annotations

import datetime
import gc
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ingest_logs import HEAD
from refusals import refused

from trainlog.errors import InputError, MissingExtraError
from trainlog.ingest import Profile, ingest, profile_of, report_of

START = pd.Timestamp("2024-05-01T06:00:00Z")
FAST, SLOW = np.arange(0.0, 60.0, 0.1), np.arange(0.05, 60.0, 0.5)

COLUMNS: dict[str, Any] = {
    "/train/state.speed": {"column": "v"},
    "/train/controls.tractive_effort": {"column": "F", "part": "positive"},
    "/train/controls.dynamic_braking_effort": {"column": "F", "part": "negative"},
    "/train/axles.wheel_speed": {"columns": ["n1", "n2"], "unit": "m/s", "scale": 0.045},
    "/environment.air_temperature": {"value": 12, "unit": "degC"},
}


def profile(columns: dict[str, Any] = COLUMNS, **sections: Any) -> Profile:
    return profile_of({**HEAD, "file": {"format": "mdf"}, "columns": columns, **sections})


def speed(seconds: np.ndarray) -> np.ndarray:
    return 60.0 + 30.0 * np.sin(0.1 * seconds)


def measured(
    path: Path, *, version: str = "4.10", groups: Any = None, set_start: bool = True
) -> Path:
    from asammdf import MDF

    mdf = MDF(version=version)
    if set_start:
        mdf.header.start_time = datetime.datetime(2024, 5, 1, 6, tzinfo=datetime.UTC)
    for group in groups if groups is not None else standard():
        mdf.append(group)
    saved = mdf.save(path, overwrite=True)
    mdf.close()
    return Path(saved)


def signal(samples: np.ndarray, seconds: np.ndarray, name: str, unit: str = "") -> Any:
    from asammdf import Signal

    return Signal(samples=samples, timestamps=seconds, name=name, unit=unit)


def standard() -> list[list[Any]]:
    return [
        [
            signal(speed(FAST), FAST, "v", "km/h"),
            signal(np.round(speed(FAST) / 3.6 / 0.045).astype("<u2"), FAST, "n1", "1/min"),
            signal(np.round(speed(FAST) / 3.6 / 0.045).astype("<u2"), FAST, "n2", "1/min"),
        ],
        [signal(100.0 * np.cos(0.1 * SLOW), SLOW, "F", "kN"), signal(SLOW, SLOW, "p", "bar")],
    ]


@pytest.mark.parametrize("version", ["4.20", "3.30"])
def test_channels_come_back_in_the_files_units(tmp_path, version):
    trip = ingest(measured(tmp_path / "run.dat", version=version), profile=profile())
    report = report_of(trip)
    assert trip.provenance[0]["format"] == "mdf"
    assert report.counts == {}
    assert report.not_used == {"channels that the profile does not map: p": 1}
    assert report.rows_kept == FAST.size + SLOW.size
    state, controls = trip["/train/state"], trip["/train/controls"]
    fast = (state.index - START) / pd.Timedelta(seconds=1)
    slow = (controls.index - START) / pd.Timedelta(seconds=1)
    np.testing.assert_allclose(fast, FAST, atol=1e-9)
    np.testing.assert_allclose(slow, SLOW, atol=1e-9)
    np.testing.assert_allclose(state["speed"], speed(FAST) / 3.6, rtol=1e-12)
    force = 1e5 * np.cos(0.1 * SLOW)
    np.testing.assert_allclose(controls["tractive_effort"], np.maximum(force, 0.0), atol=1e-6)
    np.testing.assert_allclose(
        controls["dynamic_braking_effort"], np.maximum(-force, 0.0), atol=1e-6
    )
    np.testing.assert_allclose(trip["/train/axles"]["wheel_speed_2"], state["speed"], atol=0.03)
    assert trip["/environment"]["air_temperature"].iloc[0] == pytest.approx(285.15)


def test_fields_of_a_topic_may_have_clocks_of_their_own(tmp_path):
    """They share a frame with the instants of both; nothing is made up in between."""
    groups = [[signal(speed(FAST), FAST, "v", "km/h")], [signal(SLOW * 20.0, SLOW, "s", "m")]]
    columns = {
        "/train/state.speed": {"column": "v"},
        "/train/state.position": {"column": "s", "unit": "m"},
    }
    trip = ingest(measured(tmp_path / "run.mf4", groups=groups), profile=profile(columns))
    state = trip["/train/state"]
    assert len(state) == FAST.size + SLOW.size
    assert report_of(trip).counts == {}
    np.testing.assert_allclose(state["speed"].dropna(), speed(FAST) / 3.6)
    np.testing.assert_allclose(state["position"].dropna(), SLOW * 20.0)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"/train/state.speed": {"column": "V"}}, "no channel 'V'; did you mean 'v'"),
        ({"/train/state.speed": {"column": "F"}}, "channel 'F' has the unit 'kN', which does not"),
        ({"/train/state.acceleration": {"column": "x"}}, "channel 'x' is in 2 groups; write '2:x'"),
        ({"/train/state.acceleration": {"column": "2:x"}}, "has the unit '', which does not"),
        ({}, "channels may mean anything; give a profile"),
    ],
)
def test_channels_that_cannot_be_used(tmp_path, columns, message):
    more = [[signal(SLOW, SLOW, "x")], [signal(-SLOW, SLOW, "x")]]
    path = measured(tmp_path / "run.mf4", groups=standard() + more)
    refused(InputError, message, ingest, path, profile=profile(columns))


def test_a_group_can_be_named(tmp_path):
    more = [[signal(SLOW, SLOW, "x")], [signal(0.01 * SLOW, SLOW, "x", "m/s2")]]
    path = measured(tmp_path / "run.mf4", groups=standard() + more)
    trip = ingest(path, profile=profile({"/train/state.acceleration": {"column": "3:x"}}))
    np.testing.assert_allclose(trip["/train/state"]["acceleration"], 0.01 * SLOW)


def test_files_that_cannot_be_used(tmp_path, monkeypatch):
    path = measured(tmp_path / "run.mf4")
    refused(InputError, "give a profile", ingest, path)
    whole = path.read_bytes()
    for length in (20, 200, 3000, len(whole) // 2):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"run\.mf4: is not a readable measurement file"):
            ingest(path, profile=profile())
    gc.collect()  # nothing is left that complains later
    path.write_bytes(whole)
    monkeypatch.setitem(__import__("sys").modules, "asammdf", None)
    with pytest.raises(
        MissingExtraError, match=r"package asammdf.*pip install .trainlog.recorders."
    ):
        ingest(path, profile=profile())


def test_a_start_that_was_never_set_can_be_given(tmp_path):
    path = measured(tmp_path / "run.mdf", version="3.30", set_start=False)
    refused(InputError, "states that it was started at 1980-01-01", ingest, path, profile=profile())
    time = {"column": "time", "format": "elapsed", "start": "2024-05-01T08:00:00+02:00"}
    trip = ingest(path, profile=profile(time=time))
    assert trip["/train/state"].index[0] == START
