"""Time as recorders write it comes out as UTC nanoseconds, or not at all."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given, strategies as st

from trainlog.errors import InputError
from trainlog.ingest.mapping import read_time
from trainlog.ingest.profile import TimeOptions
from trainlog.ingest.recording import NO_TIME

FILE = Path("run.csv")

INSTANT = pd.Timestamp("2024-05-01T06:07:08.25Z").value


def read(*columns: list[object], decimal: str = ".", **options: object) -> list[int]:
    names = [str(number) for number in range(len(columns))]
    table = pa.table(dict(zip(names, columns, strict=True)))
    where = {"column": "0"} if len(columns) == 1 else {"columns": tuple(names)}
    return read_time(table, TimeOptions(**where, **options), decimal, FILE).tolist()


@pytest.mark.parametrize(
    ("columns", "options"),
    [
        ([["2024-05-01T06:07:08.250Z"]], {}),
        ([["2024-05-01T08:07:08.25+02:00"]], {}),
        ([["2024-05-01 08:07:08.25+0200"]], {}),
        ([["2024-05-01 06:07:08.25"]], {}),
        ([["2024-05-01T08:07:08,25"]], {"timezone": "Europe/Zurich", "decimal": ","}),
        ([["2024-05-01T06:07:08.25Z"]], {"timezone": "Europe/Zurich"}),
        ([["01.05.2024 08:07:08.25"]], {"format": "%d.%m.%Y %H:%M:%S.%f", "timezone": "+02:00"}),
        ([["05/01/24 06:07:08.250 +0000"]], {"format": "%m/%d/%y %H:%M:%S.%f %z"}),
        ([["01.05.2024"], [" 06:07:08.25 "]], {"format": "%d.%m.%Y %H:%M:%S.%f"}),
        ([["06:07:08.25"]], {"format": "%H:%M:%S.%f", "date": datetime.date(2024, 5, 1)}),
        ([["1714543628.25"]], {"format": "epoch"}),
        ([["1714543628250"]], {"format": "epoch", "unit": "ms"}),
        ([[1714543628250]], {"format": "epoch", "unit": "ms"}),
        ([[1714543628.25]], {"format": "epoch"}),
        ([["1714543628250000000"]], {"format": "epoch", "unit": "ns"}),
        ([["8,25"]], {"format": "elapsed", "start": "2024-05-01T06:07:00Z", "decimal": ","}),
        (
            [["8.25"]],
            {"format": "elapsed", "start": "2024-05-01T08:07:00", "timezone": "Europe/Zurich"},
        ),
        ([["2024"], ["5"], ["1"], ["6"], ["7"], ["8.25"]], {"format": "parts"}),
        ([[2024], [5], [1], [6], [7], [8.25]], {"format": "parts"}),
        ([[datetime.datetime(2024, 5, 1, 6, 7, 8, 250_000, datetime.UTC)]], {}),
        (
            [[datetime.datetime(2024, 5, 1, 8, 7, 8, 250_000)]],
            {"timezone": "Europe/Zurich"},
        ),
    ],
)
def test_every_way_of_writing_an_instant(
    columns: list[list[object]], options: dict[str, object]
) -> None:
    assert read(*columns, **options) == [INSTANT]


@given(st.integers(pd.Timestamp("1981-01-01").value, pd.Timestamp("2099-01-01").value))
def test_nanoseconds_survive_text_and_counts(instant: int) -> None:
    text = pd.Timestamp(instant).isoformat(timespec="nanoseconds")
    assert read([text + "Z"]) == [instant]
    assert read([text], format="%Y-%m-%dT%H:%M:%S.%f") == [instant]
    assert read([str(instant)], format="epoch", unit="ns") == [instant]
    assert read([instant], format="epoch", unit="ns") == [instant]


@given(st.integers(0, 2_000_000_000_000))
def test_seconds_as_decimals_are_exact_to_the_millisecond(milliseconds: int) -> None:
    milliseconds += 500_000_000_000
    written = f"{milliseconds // 1000}.{milliseconds % 1000:03d}"
    assert read([written], format="epoch") == [milliseconds * 1_000_000]


@pytest.mark.parametrize(
    ("columns", "options"),
    [
        ([["2024-13-01T00:00:00Z", "2024-05-01T06:07:08.25Z"]], {}),
        ([["", "2024-05-01T06:07:08.25Z"]], {}),
        ([[None, "2024-05-01T06:07:08.25Z"]], {}),
        ([["12", "2024-05-01T06:07:08.25Z"]], {}),
        ([["1970-01-01T00:00:00Z", "2024-05-01T06:07:08.25Z"]], {}),
        ([["9999-01-01T00:00:00Z", "2024-05-01T06:07:08.25Z"]], {}),
        ([["x", "1714543628.25"]], {"format": "epoch"}),
        ([["0", "1714543628.25"]], {"format": "epoch"}),
        ([[2000, 2024], [0, 5], [0, 1], [0, 6], [0, 7], [0, 8.25]], {"format": "parts"}),
        ([[2023, 2024], [2, 5], [29, 1], [0, 6], [0, 7], [0, 8.25]], {"format": "parts"}),
    ],
)
def test_what_is_no_time_is_absent(columns: list[list[object]], options: dict[str, object]) -> None:
    assert read(*columns, **options) == [NO_TIME, INSTANT]


def test_midnight_is_noticed() -> None:
    times = ["23:59:58", "23:59:59", "00:00:00", "00:00:01", "23:59:59", "00:00:00"]
    found = read([*times], format="%H:%M:%S", date=datetime.date(2024, 5, 1))
    start = pd.Timestamp("2024-05-01T23:59:58Z").value
    assert [(t - start) // 10**9 for t in found] == [0, 1, 2, 3, 86_401, 86_402]


@pytest.mark.parametrize("local", ["2024-10-27 02:30:00", "2024-03-31 02:30:00"])
def test_hours_that_come_twice_or_never_are_refused(local: str) -> None:
    with pytest.raises(InputError, match=r"run\.csv: local time 2024.*Europe/Zurich.*\+01:00"):
        read([local], timezone="Europe/Zurich")
    assert read([local], timezone="+01:00")


@pytest.mark.parametrize(
    ("column", "options"),
    [
        ("1714543628250", {"format": "epoch"}),
        ("1714543628250", {"format": "epoch", "unit": "us"}),
        ("1714543628", {"format": "epoch", "unit": "ms"}),
        ("1899-05-01 06:00:00", {}),
    ],
)
def test_a_wrong_unit_of_time_leaves_no_time(column: str, options: dict[str, object]) -> None:
    """Refused here with the instant it reads as, or later because no row has a time."""
    try:
        found = read([column, column], **options)
    except InputError as error:
        found = [str(error)]
    message = str(found[0])
    assert set(found) == {NO_TIME} or ("time reads as 1" in message and "unit" in message)


def test_large_columns_keep_their_gaps() -> None:
    count = 10_000
    text = pd.date_range("2024-05-01", periods=count, freq="100ms").strftime("%H:%M:%S.%f")
    words = np.array(text, dtype=object)
    words[::7] = None
    found = np.array(read(list(words), format="%H:%M:%S.%f", date=datetime.date(2024, 5, 1)))
    assert np.count_nonzero(found == NO_TIME) == len(range(0, count, 7))
    assert np.all(np.diff(found[found != NO_TIME]) > 0)
