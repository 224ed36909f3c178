"""Phones' fixes with a hand-kept log: each ride by rail is a trip, or the reason is listed."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import refused

from trainlog.errors import InputError
from trainlog.ingest import ingest, ingest_each, report_of
from trainlog.trip import Trip

PUBLISHED = Path(__file__).parents[2] / "shared" / "data" / "aalto"

FIXES = '"time","device_id","lat","lng","accuracy","activity_1","activity_1_conf"'
RIDES = (
    "device_id,st_entrance,st_entry_time,line_type,line_name,vehicle_dep_time,vehicle_dep_stop,"
    "vehicle_arr_time, vehicle_arr_stop,st_exit_location,st_exit_time ,comments"
)


def fixes(device: int, begin: str, end: str, *, moves: bool = True) -> list[str]:
    """A fix every 11 s."""
    stamps = pd.date_range(f"2016-08-26 {begin}", f"2016-08-26 {end}", freq="11s")
    return [
        f'"{t:%Y-%m-%d %H:%M:%S}.206",{device},60.18,{24.9 + 1e-3 * i * moves:.6f},15.1,"ST",75'
        for i, t in enumerate(stamps)
    ]


def ride(device: int, kind: str, line: str, begin: str, end: str) -> str:
    day = "2016-08-26 "
    shown = [f'"{day + time}"' if time else "" for time in (begin, end)]
    return f'{device},,,{kind},{line},{shown[0]},"Kamppi, (M)",{shown[1]},Pasila,,,"two\nlines"'


def both(folder: Path, rows: list[str], rides: list[str]) -> Path:
    (folder / "device_data.csv").write_text("\n".join([FIXES, *rows]) + "\n", "utf-8")
    (folder / "manual_log.csv").write_text("\n".join([RIDES, *rides]) + "\n", "utf-8")
    return folder / "device_data.csv"


def account(trip: Trip) -> pd.DataFrame:
    return pd.read_csv(io.BytesIO(trip.attachments["rides.csv"]), keep_default_na=False)


def test_rides_by_rail_become_trips(tmp_path):
    rows = [
        *fixes(1, "09:00:00", "10:00:00"),
        *fixes(2, "09:00:00", "10:00:00", moves=False),
        *fixes(3, "09:30:00", "09:31:00"),
    ]
    rides = [
        ride(1, "SUBWAY", "V", "09:02:00", "09:10:00"),
        ride(1, "BUS", "154", "09:12:00", "09:18:00"),
        ride(1, "TRAM", "7A", "09:20:00", "09:30:00"),
        ride(1, "train", "K", "09:25:00", "09:40:00"),
        ride(2, "TRAM", "9", "09:10:00", "09:20:00"),
        ride(3, "SUBWAY", "", "09:00:00", "09:20:00"),
        ride(4, "SUBWAY", "", "09:00:00", "09:20:00"),
        ride(1, "TRAIN", "", "09:50:00", ""),
        ride(1, "TRAIN", "", "09:49:00", "09:45:00"),
    ]
    path = both(tmp_path, rows, rides)
    trips = list(ingest_each(path))
    assert [t.name for t in trips] == ["ride-001-subway-v", "ride-003-tram-7a", "ride-004-train-k"]
    table = account(trips[0])
    assert list(table["why_not"])[3:] == [
        "the fixes do not move",
        "fewer than two fixes",
        "the phone has no fixes",
        "departure or arrival is missing",
        "ends before it begins",
    ]
    assert list(table["ride"]) == [1, 3, 4, 5, 6, 7, 8, 9]
    assert list(table["trip"])[:3] == [t.name for t in trips]
    assert list(table["overlaps_next"]) == [0, 1, 0, 0, 0, 0, 0, 0]
    report = report_of(trips[0])
    assert report.not_used["rides not by rail"] == 1
    assert sum(report.not_used.values()) == 1 + 5
    first = trips[0]["/gnss/fix"]
    assert first.index[0] == pd.Timestamp("2016-08-26T06:02:01.206Z")
    assert first.index[-1] <= pd.Timestamp("2016-08-26T06:10:00Z")
    np.testing.assert_allclose(first["horizontal_accuracy"], 10.0)
    assert "/gnss/motion" not in trips[0], "no speed is made up"
    # Nobody sits in two vehicles: the tram ends where the train begins.
    assert trips[1]["/gnss/fix"].index[-1] < trips[2]["/gnss/fix"].index[0]
    assert trips[1].metadata["cut_at"] == "2016-08-26T06:25:00+00:00"
    assert trips[2].metadata["vehicle"] == "train"
    assert trips[2].metadata["from"] == "Kamppi, (M)"
    assert set(trips[0].provenance[0]["inputs"]) == {"device_data.csv", "manual_log.csv"}
    again = list(ingest_each(tmp_path / "manual_log.csv"))
    assert [t.name for t in again] == [t.name for t in trips]


def test_a_fix_without_a_place_does_not_make_a_device_move(tmp_path):
    still = fixes(2, "09:00:00", "10:00:00", moves=False)
    still[100] = still[100].replace("60.18,24.900000", ",")
    rides = [ride(n, "TRAM", "9", "09:10:00", "09:40:00") for n in (1, 2)]
    path = both(tmp_path, [*fixes(1, "09:00:00", "10:00:00"), *still], rides)
    trips = list(ingest_each(path))
    assert list(account(trips[0])["why_not"]) == ["", "the fixes do not move"]


def test_files_that_cannot_be_used(tmp_path):
    path = both(tmp_path, fixes(1, "09:00:00", "09:01:00"), [ride(1, "BUS", "1", "09:00:00", "")])
    refused(InputError, "none of 0 rides by rail", list, ingest_each(path))
    (tmp_path / "manual_log.csv").write_text("device_id,line_type\n1,TRAM\n", "utf-8")
    refused(InputError, r"manual_log\.csv, row 1: no column 'line_name'", list, ingest_each(path))
    (tmp_path / "manual_log.csv").unlink()
    with pytest.raises(InputError, match=r"device_data\.csv: needs manual_log\.csv beside it"):
        list(ingest_each(path))


@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="the Aalto data are not beside the checkout")
def test_the_published_rides():
    path = PUBLISHED / "device_data.csv"
    refused(InputError, r"holds 73 recordings: ride-002-subway-v, .*; take them", ingest, path)
    trips = list(ingest_each(path))
    table = account(trips[0])
    assert len(table) == 82
    assert len(trips) == (table["trip"] != "").sum() == 73
    assert table["why_not"].value_counts().to_dict() == {
        "": 73,
        "fewer than two fixes": 6,
        "the fixes do not move": 3,
    }
    assert {t.metadata["vehicle"] for t in trips} == {"subway", "tram", "train"}
    for trip in trips:
        fix = trip["/gnss/fix"]
        assert fix.index[0] >= pd.Timestamp(trip.metadata["departure"])
        assert fix.index[-1] <= pd.Timestamp(trip.metadata["arrival"])
        assert fix["latitude"].dropna().between(60.1, 60.4).all()
