"""Delimited text whose header and rows differ by empty cells, and rows that really do not fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from ingest_logs import clean_run, plain_profile, plain_rows, plain_text
from refusals import refused

from trainlog.errors import InputError
from trainlog.ingest import Profile, ingest, repairs_of, report_of
from trainlog.trip import Trip

FILES = settings(max_examples=25)


def read(tmp_path: Path, rows: list[str], header: str, profile: Profile | None = None) -> Trip:
    path = tmp_path / "run.csv"
    path.write_text(plain_text(rows, header), "utf-8")
    return ingest(path, profile=profile or plain_profile())


@FILES
@given(st.data())
def test_empty_cells_at_the_end_make_no_difference(tmp_path: Path, data: st.DataObject) -> None:
    """The header's and every row's number of empty cells is drawn; blanks may stand in them."""
    mark = data.draw(st.sampled_from([",", ";", "\t"]))
    empty = st.lists(st.sampled_from(["", "", " "]), max_size=6)
    run = clean_run(60, 1.0)
    drawn = [data.draw(empty) for _ in range(data.draw(st.integers(1, 4)))]
    header = mark.join(["t", "v", "s", *data.draw(empty)])
    rows = [
        mark.join([*row.split(","), *drawn[i % len(drawn)]]) for i, row in enumerate(run.rows())
    ]
    trip = read(tmp_path, rows, header, plain_profile(file={"delimiter": mark}))
    report = report_of(trip)
    assert report.findings == ()
    assert (report.rows_read, report.rows_kept) == (60, 60)
    np.testing.assert_array_equal(trip["/train/state"]["speed"], run.speed)
    np.testing.assert_array_equal(trip["/train/state"]["position"], run.position)


def test_a_row_that_was_cut_within_its_last_value_is_not_used(tmp_path: Path) -> None:
    """All rows end in empty cells: one that does not was cut off, and its last value with it."""
    rows = [f"{row},,," for row in plain_rows(100)]
    whole = rows[40]
    rows[40] = whole.rstrip(",")[:-2]
    trip = read(tmp_path, rows, "t,v,s,,,")
    assert report_of(trip).lines()[:2] == [
        "100 rows read, 99 kept, 1 dropped",
        "truncated_rows: 1 (rows 42)",
    ]
    assert repairs_of(trip)["raw_text"].iloc[0] == rows[40]


def test_columns_without_a_name_are_not_used(tmp_path: Path) -> None:
    """Where the header has empty cells for them, they may hold values."""
    run = clean_run(60, 1.0)
    rows = [f"{row},7,8" + "," * (i % 4) for i, row in enumerate(run.rows())]
    trip = read(tmp_path, rows, "t,v,s,,")
    assert report_of(trip).findings == ()
    np.testing.assert_array_equal(trip["/train/state"]["position"], run.position)


def test_rows_that_end_at_their_last_value_are_whole(tmp_path: Path) -> None:
    """A writer that leaves out the empty cells at the end of a row, as every other row has some."""
    rows = [
        f"{row},{60 + 0.1 * (row.second % 7)},{300 + row.second}" if n % 2 else f"{row},{60.5}"
        for n, row in enumerate(pd.date_range("2024-05-01T06:00:00Z", periods=200, freq="s"))
    ]
    path = tmp_path / "run.csv"
    path.write_text("t,v,s\n" + "\n".join(rows) + "\n", "utf-8")
    profile = plain_profile(
        columns={
            "/train/state.speed": {"column": "v", "unit": "km/h"},
            "/imu.specific_force_x": {"column": "s", "unit": "m/s^2", "scale": 1e-3},
        }
    )
    trip = ingest(path, profile)
    report = report_of(trip)
    assert (report.rows_read, report.rows_kept) == (200, 200)
    assert report.count("truncated_rows") == 0
    assert report.count("empty") == 100
    assert trip["/imu"]["specific_force_x"].count() == 100


@pytest.mark.parametrize(
    ("header", "row", "problem", "remedy"),
    [
        (
            "t,v,s,a,b,,,",
            "{row}",
            r"row 2: 60 of 60 rows do not fit the header of row 1: it has 5 columns, they have"
            r" 3 cells",
            r"the last name is 'b', .* remove the 2 names without a cell",
        ),
        (
            "t,v,s,,",
            "{row},7,8,9,6",
            r"row 2: 60 of 60 rows do not fit the header of row 1: it has 5 columns, they have"
            r" 7 cells",
            r"name the 2 columns that the header does not name",
        ),
        (
            "t,v,s",
            "{row};1",
            r"row 2: 60 of 60 rows do not fit the header of row 1: it has 3 columns, they have"
            r" 5 cells",
            r"decimal comma",
        ),
    ],
)
def test_the_message_names_the_cause(
    tmp_path: Path, header: str, row: str, problem: str, remedy: str
) -> None:
    rows = [row.format(row=text) for text in plain_rows(60)]
    if "comma" in remedy:
        rows = [text.partition(",")[0] + ",12,5,1000,25" for text in plain_rows(60)]
    refused(InputError, f"{problem}.*{remedy}", read, tmp_path, rows, header)
