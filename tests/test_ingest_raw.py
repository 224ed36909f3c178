"""Raw values stay available: what the rules changed and what they left make the file again."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import pytest
from contents import put
from hypothesis import given, settings, strategies as st
from ingest_logs import clean_run, damaged_runs, plain_text, read_plain, ublox
from recorder_files import gpx, mtk
from refusals import refused

from trainlog.errors import LogError
from trainlog.ingest import REPAIRS_ATTACHMENT, ingest, pipeline, repairs_of, report_of
from trainlog.ingest.report import Repairs
from trainlog.mcap import read_log, write_log
from trainlog.trip import Trip

FILES = settings(max_examples=10)


def assert_restored(trip: Trip, raw: pd.DataFrame) -> None:
    """Every row of the file is found again, in time and in every cell.

    Parameters
    ----------
    raw : DataFrame
        By row of the file; ``time`` (NaT: none that can be read) and one column a field.
    """
    entries = repairs_of(trip)
    by_row: dict[int, list[Any]] = {}
    for entry in entries.itertuples():
        by_row.setdefault(entry.row, []).append(entry)
    first_raw: dict[tuple[int, str], float] = {}
    for row, column, value in zip(
        entries["row"], entries["column"], entries["raw_value"], strict=True
    ):
        first_raw.setdefault((row, column), value)
    for row, stated in raw.to_dict("index").items():
        now, dropped = stated.pop("time"), False
        for entry in by_row.get(row, ()):
            if entry.column == "" and entry.rule != "truncated_rows":
                assert entry.raw_time == now or (pd.isna(entry.raw_time) and pd.isna(now))
                now, dropped = entry.new_time, pd.isna(entry.new_time)
        for column, value in stated.items():
            if (row, column) in first_raw:
                found = first_raw[row, column]
            elif dropped:
                found = np.nan
            else:
                topic, _, name = str(column).rpartition(".")
                frame = trip[topic]
                found = frame.at[now, name] if now in frame.index else np.nan
            assert found == pytest.approx(value, rel=1e-12, nan_ok=True), (row, column)


def plain_raw(rows: list[str]) -> pd.DataFrame:
    """What a file of `plain_text` says, cell by cell; rows that are cut short are left out."""
    stated = {}
    for number, row in enumerate(rows, start=2):
        words = row.split(",")
        if len(words) == 3:
            stated[number] = {
                "time": pd.to_datetime(words[0], utc=True, errors="coerce"),
                "/train/state.speed": pd.to_numeric(words[1].strip(), errors="coerce"),
                "/train/state.position": pd.to_numeric(words[2].strip(), errors="coerce"),
            }
    return pd.DataFrame.from_dict(stated, orient="index").replace([np.inf, -np.inf], np.nan)


@FILES
@given(damaged_runs())
def test_a_damaged_file_is_found_again(tmp_path, damaged):
    trip = read_plain(tmp_path, damaged.rows)
    assert_restored(trip, plain_raw(damaged.rows))
    entries = repairs_of(trip)
    cut = entries[entries["rule"] == "truncated_rows"]
    lines = plain_text(damaged.rows).splitlines()
    assert list(cut["raw_text"]) == [lines[row - 1] for row in cut["row"]]
    words = entries[entries["rule"] == "not_a_number"]
    assert list(words["raw_text"]) == [lines[row - 1].split(",")[1] for row in words["row"]]
    assert len(words) == damaged.text
    assert report_of(trip).raw_kept == len(entries)


@FILES
@given(st.data())
def test_rows_without_sub_seconds_fix_or_sense_are_found_again(tmp_path, data):
    count = data.draw(st.integers(40, 120))
    ticks = np.arange(count)
    before = data.draw(st.integers(0, 20))
    void = ["2015,10,18,0,0,4,0,0,0,0,-17000,9000,9000,0,20000,99,"] * before
    rows = ublox(ticks // 5, ticks / 5, void).splitlines()
    for place in data.draw(st.sets(st.integers(10, count - 10), max_size=5)):
        at = before + 1 + place
        kind = data.draw(st.sampled_from(["wild", "no fix", "twice"]))
        words = rows[at].split(",")
        if kind == "wild":
            words[13] = "80000"
        elif kind == "no fix":
            words[6] = "0"
        rows[at] = ",".join(words)
        if kind == "twice":
            rows.insert(at, rows[at])
    path = put(tmp_path / "gnss.csv", rows)
    table = pd.read_csv(path, index_col=False)
    parts = table[["Year", "Month", "Day", "Hour", "Minute", "Second"]]
    stated = {
        "time": pd.to_datetime(parts, utc=True).astype("datetime64[ns, UTC]"),
        "/gnss/fix.latitude": table["Lat"] / 1e7,
        "/gnss/fix.longitude": table["Lon"] / 1e7,
        "/gnss/motion.speed": table["speed"] / 1e3,
        "/gnss/motion.satellites": table["nSAT"].astype(float),
    }
    raw = pd.DataFrame(stated)
    raw.index = pd.Index(np.arange(2, 2 + len(raw)))
    assert_restored(ingest(path), raw)


def test_times_that_cannot_be_read_are_kept_as_text(tmp_path):
    recorded = mtk(3, before=4)
    entries = repairs_of(ingest(put(tmp_path / "run.csv", recorded.text)))
    times = entries[entries["column"] == "time"]
    assert list(times["raw_text"]) == ["2000 0 0 0 0 0"] * 4
    assert list(times["row"]) == [2, 3, 4, 5]


def test_raw_values_survive_the_log(tmp_path):
    path = put(tmp_path / "run.gpx", gpx(1).text)
    trip = ingest(path)
    write_log(trip, tmp_path / "run.mcap")
    kept = read_log(tmp_path / "run.mcap")
    pd.testing.assert_frame_equal(repairs_of(kept), repairs_of(trip))
    assert kept.metadata["repairs.kept"] == str(len(repairs_of(trip)))
    assert ingest(path).attachments == trip.attachments


def test_a_clean_file_keeps_no_raw_values(tmp_path):
    trip = read_plain(tmp_path, clean_run(50, 0.1).rows())
    assert REPAIRS_ATTACHMENT not in trip.attachments
    assert len(repairs_of(trip)) == 0
    assert list(repairs_of(trip).columns)[:3] == ["row", "table", "column"]
    refused(LogError, "was not made by ingest", repairs_of, Trip({}))


def test_what_is_kept_is_bounded_and_the_rest_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "Repairs", partial(Repairs, most=100))
    rows = clean_run(400, 1.0).rows()
    doubled = [row for row in rows for _ in range(2)]
    trip = read_plain(tmp_path, doubled)
    report = report_of(trip)
    assert report.raw_kept == len(repairs_of(trip)) == 100
    assert report.raw_beyond == 3 * 400 - 100
    assert trip.metadata["repairs.beyond"] == "1100"
    assert f"{report.raw_beyond} more are in the file alone" in " ".join(report.lines())
