"""The files of recorders met in the field, with all their defects, come back as they were."""

from __future__ import annotations

import datetime
import gc
import hashlib
import io
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import pyubx2
from contents import put
from hypothesis import HealthCheck, given, settings, strategies as st
from ingest_logs import HEAD, plain_profile
from recorder_files import (
    Recorded,
    checked,
    drive,
    gpx,
    gpx_text,
    hexlines,
    mtk,
    nav_pvt,
    nmea_lines,
    since_start,
    ubx,
)
from refusals import refused
from simulated_line import flirt, hilly_line, level_line

from trainlog import __version__, draw_scenarios, sample, simulate
from trainlog.errors import InputError, MissingExtraError
from trainlog.formats.railway import line_of, train_of
from trainlog.ingest import (
    PROFILE_ATTACHMENT,
    Profile,
    ingest,
    ingest_each,
    profile_of,
    repairs_of,
    report_of,
)
from trainlog.mcap import read_log, write_log
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip

sys.path.insert(0, str(Path(__file__).parents[1] / "sample_logs"))
from foreign_recorders import write_recorder_csv, write_ublox_csv


def read(tmp_path: Path, name: str, text: str | list[str], **options: object) -> Trip:
    return ingest(put(tmp_path / name, text), **options)


def assert_fixes(trip: Trip, recorded: Recorded) -> None:
    """The fixes are those of the drive, to the file's last digit, at the right instants."""
    fix, truth = trip["/gnss/fix"], recorded.truth
    np.testing.assert_array_equal(fix.index.as_unit("ns").asi8, truth.time)
    for column in ("latitude", "longitude", "altitude"):
        np.testing.assert_allclose(fix[column], getattr(truth, column), rtol=0, atol=1e-12)
    np.testing.assert_allclose(fix["horizontal_accuracy"], 3.0 * truth.hdop, rtol=1e-12)
    np.testing.assert_array_equal(trip["/gnss/motion"]["satellites"], truth.satellites)


@pytest.mark.parametrize(
    ("speed", "offset", "seed"),
    [
        ("1.0", "Z", 0),
        ("garmin", "+02:00", 1),
        ("osmand", "-05:00", 0),
        ("plain", "Z", 1),
        ("none", "+01:00", 0),
    ],
)
def test_gpx_comes_back(tmp_path, seed, speed, offset):
    recorded = gpx(seed, speed=speed, offset=offset)
    trip = read(tmp_path, "run.gpx", recorded.text)
    report = report_of(trip)
    assert report.counts == recorded.defects
    assert report.not_used == {"points <wpt>": 1}
    assert trip.provenance[0]["format"] == "gpx"
    assert_fixes(trip, recorded)
    np.testing.assert_allclose(trip["/gnss/fix"]["vertical_accuracy"], 1.5 * 4.2)
    motion = trip["/gnss/motion"]["speed"]
    if speed == "none":
        assert motion.isna().all()
    else:
        np.testing.assert_allclose(motion, recorded.truth.speed, rtol=0, atol=1e-12)
    assert trip.metadata["recorder"] == "logger 7"
    assert trip.metadata["horizontal_accuracy"] == "3 m times HDOP"


def test_a_count_of_unix_time_decides_the_zone_of_a_gpx(tmp_path):
    """Times that name no zone are UTC by the standard, and local where a phone does not keep it."""
    run = drive(60, 1.0)
    text = gpx_text(run, offset="+02:00").replace("+02:00", "")
    trip = read(tmp_path, "plain.gpx", text)
    assert trip.metadata["clock"] == "GNSS, no zone stated, taken as UTC"
    assert trip.start.value == run.time[0] + 7200 * 1_000_000_000
    points = text.split("</trkpt>")
    for per_second in (1, 1000):
        counts = run.time // (1_000_000_000 // per_second)
        added = [f"<unix>{count}</unix><pace>4.2</pace></trkpt>" for count in counts]
        beside = zip(points, [*added, ""], strict=True)
        trip = read(tmp_path, "unix.gpx", "".join(a + b for a, b in beside))
        assert trip.metadata["clock"] == "Unix time, beside times that state no zone"
        np.testing.assert_array_equal(trip["/gnss/fix"].index.as_unit("ns").asi8, run.time)
        assert report_of(trip).not_used["<pace> of track points"] == 60


def test_gpx_segments_are_one_trip_tracks_are_several(tmp_path):
    run = drive(300, 1.0)
    parts = np.split(np.arange(300), [100, 150, 220])
    path = put(tmp_path / "day.gpx", gpx_text(run, parts=[parts]))
    trip = ingest(path)
    assert len(trip["/gnss/fix"]) == 300
    assert trip.metadata["segments"] == "4"
    path.write_text(gpx_text(run, parts=[parts[:2], [], parts[2:]]), "utf-8")
    refused(InputError, r"day\.gpx: holds 2 recordings: day-1, day-2; .*_each", ingest, path)
    trips = list(ingest_each(path))
    assert [t.name for t in trips] == ["day-1", "day-2"]
    assert [t.metadata["track"] for t in trips] == ["track 1", "track 3"]
    assert [len(t["/gnss/fix"]) for t in trips] == [150, 150]
    assert report_of(trips[0]).not_used["tracks without points"] == 1


def test_a_track_that_is_no_trip_does_not_cost_the_others(tmp_path):
    run = drive(60, 1.0)
    parts = [[np.arange(30)], [np.arange(30, 31)], [np.arange(31, 60)]]
    path = put(tmp_path / "day.gpx", gpx_text(run, parts=parts))
    trips: list[str] = []
    with pytest.raises(InputError, match=r"day\.gpx.*1 of 3 recordings became no trip.*1 row is"):
        trips.extend(trip.name for trip in ingest_each(path))
    assert trips == ["day-1", "day-3"]


def test_a_gpx_cut_off_anywhere_gives_its_whole_points(tmp_path):
    text = gpx_text(drive(40, 1.0))
    for end in range(len(text) - 1200, len(text) - 8, 41):
        whole = text[:end].count("</trkpt>")
        trip = read(tmp_path, "run.gpx", text[:end])
        assert len(trip["/gnss/fix"]) == whole
        assert report_of(trip).counts == {"truncated_rows": 1}


BOMB = (
    '<?xml version="1.0"?>\n<!DOCTYPE gpx [<!ENTITY a "aaaaaaaaaa">'
    '<!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>\n<gpx><trk><name>&b;</name></trk></gpx>'
)
EXTERNAL = '<?xml version="1.0"?>\n<!DOCTYPE gpx [<!ENTITY a SYSTEM "file:///etc/passwd">]><gpx/>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, r"line 2, column 27: declares the entity 'a'; "),
        (EXTERNAL, r"line 2, column \d+: declares the entity 'a'; "),
        (gpx_text(drive(9, 1.0)).replace("</ele>", "</el>", 1), "line 5, column .*mismatched tag"),
        (gpx_text(drive(9, 1.0)).replace("<sat>", "<<", 1), "line 5, column .*not well-formed"),
        (gpx_text(drive(9, 1.0))[:300], r"line \d+, column \d+: is not XML"),
        ("<gpx>\n<a></b>", "line 2, column 6: is not XML: mismatched tag"),
        ("<gpx></gpx>", "has no track point; give the track"),
        ('<gpx><rte><rtept lat="1" lon="2"/></rte></gpx>', "no track point, but 1 rtept; give"),
        ("<kml><gpx/></kml>", "its first element is <kml>"),
        (
            gpx_text(drive(9, 1.0)).replace("<time>", "<when>").replace("</time>", "</when>"),
            "no row has both a time and a satellite fix",
        ),
    ],
)
def test_bad_gpx_is_refused(tmp_path, text, message):
    refused(InputError, message, read, tmp_path, "run.gpx", text, format="gpx")


@pytest.mark.parametrize(("seed", "scaled"), [(0, False), (1, True)])
def test_mtk_comes_back(tmp_path, seed, scaled):
    recorded = mtk(seed, scaled=scaled)
    trip = read(tmp_path, "run.csv", recorded.text)
    report = report_of(trip)
    assert trip.provenance[0]["format"] == "mtk"
    assert report.count("subsecond") == 1800 - 180
    for rule, count in recorded.defects.items():
        assert report.count(rule) == count
    assert set(report.counts) == {"subsecond", *recorded.defects}
    assert_fixes(trip, recorded)
    speed = trip["/gnss/motion"]["speed"]
    known = speed.notna()
    assert (~known).sum() == recorded.defects["spikes"]
    np.testing.assert_allclose(speed[known], recorded.truth.speed[known], rtol=0, atol=1e-12)


def test_mtk_columns_are_found_by_name(tmp_path):
    recorded = mtk(4, before=5)
    lines = recorded.text.splitlines()
    lines[0] = "year,month,day,hour,min,sec,sats,longitude,latitude,height,speed,hdop"
    assert_fixes(read(tmp_path, "run.csv", "\n".join(lines)), recorded)
    with pytest.raises(InputError, match=r"row 1, the header: no column of the hdop; expected"):
        read(tmp_path, "x.csv", recorded.text.replace("HDOP", "PDOP"), format="mtk")


ETH = Path(__file__).parents[2] / "shared" / "data" / "eth_localization"


def assert_positions(trip: Trip, run: object) -> None:
    fix, motion = trip["/gnss/fix"], trip["/gnss/motion"]
    np.testing.assert_array_equal(fix.index.as_unit("ns").asi8, run.time)
    np.testing.assert_allclose(fix["latitude"], run.latitude, rtol=0, atol=2e-8)
    np.testing.assert_allclose(fix["longitude"], run.longitude, rtol=0, atol=2e-8)
    np.testing.assert_allclose(motion["speed"], run.speed, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "kinds",
    [
        ("RMC", "GGA", "GST", "VTG", "GSV"),
        ("GGA", "RMC"),
        ("GNS", "VTG", "ZDA"),
        ("ZDA", "GGA", "VTG"),
    ],
)
def test_sentences_become_fixes(tmp_path, kinds):
    run = drive(100, 5.0)
    trip = read(tmp_path, "run.log", nmea_lines(run, kinds))
    assert trip.provenance[0]["format"] == "nmea"
    assert_positions(trip, run)
    fix, report = trip["/gnss/fix"], report_of(trip)
    np.testing.assert_allclose(fix["altitude"], run.altitude)
    np.testing.assert_array_equal(trip["/gnss/motion"]["satellites"], run.satellites)
    if "GST" in kinds:
        np.testing.assert_allclose(fix["horizontal_accuracy"], np.sqrt(12.5))
        np.testing.assert_allclose(fix["vertical_accuracy"], 6.0)
    else:
        np.testing.assert_allclose(fix["horizontal_accuracy"], 3.0 * run.hdop)
        assert trip.metadata["horizontal_accuracy"] == "3 m times HDOP"
    assert report.counts == {}
    assert report.not_used == ({"NMEA GPGSV": 100} if "GSV" in kinds else {})


@pytest.mark.parametrize("kinds", [("RMC", "GGA"), ("GGA", "RMC"), ("GGA", "VTG")])
def test_midnight_is_noticed(tmp_path, kinds):
    run = drive(200, 5.0)
    late = pd.Timestamp("2024-05-01T23:59:40Z").value - run.time[0]
    run = type(run)(run.time + late, *(getattr(run, n) for n in list(vars(run))[1:]))
    lines = nmea_lines(run, kinds)
    if "RMC" not in kinds:
        lines.insert(0, checked("GNZDA,235939.80,01,05,2024,00,00"))
    trip = read(tmp_path, "run.log", lines)
    assert_positions(trip, run)
    assert trip.end.isoformat() == "2024-05-02T00:00:19.800000+00:00"


def test_damaged_sentences_are_counted_and_kept(tmp_path):
    run = drive(60, 1.0)
    lines = nmea_lines(run, ("RMC", "GGA"))
    bad = {10: lines[10].replace(",N,", ",S,"), 21: lines[21][:-3], 40: lines[40][:17]}
    for place, line in bad.items():
        lines[place] = line
    lines.insert(30, "logger: flushed")
    trip = read(tmp_path, "run.log", lines)
    report = report_of(trip)
    assert report.counts == {"damaged_messages": 3}
    assert report.not_used == {"lines without a sentence": 1}
    entries = repairs_of(trip)
    assert list(entries["row"]) == [11, 22, 42]
    assert list(entries["raw_text"]) == list(bad.values())
    assert len(trip["/gnss/fix"]) == 60, "the other sentence of the second gives the position"
    assert trip["/gnss/motion"]["speed"].isna().sum() == 2


@pytest.mark.parametrize("prefix", ["12.345 ", "2024-05-01T06:00:00.1Z,", "[06:00:00.10] "])
def test_a_loggers_own_time_may_stand_before(tmp_path, prefix):
    run = drive(60, 1.0)
    dated = "-" in prefix
    lines = nmea_lines(run, ("GGA", "VTG") if dated else ("RMC", "GGA"))
    trip = read(tmp_path, "run.log", [prefix + line for line in lines])
    assert_positions(trip, run)


def test_no_fix_and_void_sentences_say_nothing(tmp_path):
    run = drive(60, 1.0)
    void = [checked(f"GNRMC,0559{i:02d}.00,V,,,,,,,010524,,,N") for i in range(30)] + [
        checked(f"GNGGA,0559{i:02d}.00,,,,,0,00,99.99,,,,,,") for i in range(30, 40)
    ]
    trip = read(tmp_path, "run.log", void + nmea_lines(run, ("RMC", "GGA")))
    assert report_of(trip).counts == {"before_first_fix": 40}
    assert_positions(trip, run)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (nmea_lines(drive(20, 1.0), ("GGA", "VTG")), "row 1: gives the time of day, but no date"),
        ([checked("GPGSV,1,1,01,07,79,048,42")] * 9, "has no RMC, GGA or GNS sentence"),
        ([line[:-1] + "G" for line in nmea_lines(drive(9, 1.0))], "45 of 45 messages are damaged"),
    ],
)
def test_logs_that_cannot_be_used(tmp_path, lines, message):
    refused(InputError, message, read, tmp_path, "run.log", lines)


def test_hex_lines_come_back(tmp_path):
    """The IMU's times count since the start, by a clock that drifts: 0.4 ms are left of it."""
    made = hexlines(0)
    trip = read(tmp_path, "run.log", made.text.splitlines())
    report = report_of(trip)
    assert trip.provenance[0]["format"] == "hexlines"
    assert set(report.counts) == {"time_backwards", "before_first_fix"}
    assert report.count("before_first_fix") == 5
    assert report.not_used == {"UBX ACK-ACK": 30}
    assert_positions(trip, made.fixes)
    imu = trip["/imu"]
    assert len(imu) == len(made.words)
    late = imu.index.as_unit("ns").asi8 - made.utc
    # 20 ppm over half a minute are 0.6 ms, of half of which the offset of a minute takes up.
    assert np.abs(late).max() < 400_000
    for i, column in enumerate(("angular_rate_x", "angular_rate_y", "angular_rate_z")):
        np.testing.assert_allclose(imu[column], made.words[:, i] * np.radians(0.00437), rtol=1e-12)
    for i, column in enumerate(("specific_force_x", "specific_force_y", "specific_force_z")):
        expected = made.words[:, 3 + i] * 0.061e-3 * 9.80665
        np.testing.assert_allclose(imu[column], expected, rtol=1e-12)


def test_hex_lines_with_nmea_alone(tmp_path):
    made = hexlines(3)
    run = drive(30, 1.0, 3)
    lines = [line for line in made.text.splitlines() if ",I," in line]
    for i in range(30):
        stamp = since_start(43_000_000_000 + i * 1_000_000_000 + 100_000)
        lines += [
            f"{stamp},N,{(s + chr(13) + chr(10)).encode().hex()}"
            for s in nmea_lines(run.take(np.array([i])), ("RMC", "GGA"))
        ]
    trip = read(tmp_path, "run.log", lines)
    assert_positions(trip, run)
    late = trip["/imu"].index.as_unit("ns").asi8 - made.utc
    assert np.abs(late).max() < 1_000_000


def test_hex_lines_without_a_time_or_of_a_restarted_logger_are_refused(tmp_path):
    lines = [line for line in hexlines(1).text.splitlines() if ",I," in line]
    refused(InputError, r"no message gives the time.*NAV-PVT", read, tmp_path, "run.log", lines)
    run = drive(9, 1.0)
    void = [f"{since_start(10**9 * i)},U,{nav_pvt(run, i, valid=False).hex()}" for i in range(9)]
    refused(InputError, "no message gives the time", read, tmp_path, "run.log", lines + void)
    run = drive(300, 1.0)
    lines = [f"{since_start(10**9 * (i % 150 + 5))},U,{nav_pvt(run, i).hex()}" for i in range(300)]
    refused(InputError, r"clock was restarted: .* split the file", read, tmp_path, "run.log", lines)


@settings(max_examples=25, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_fixes_are_what_pyubx2_reads(tmp_path, data):
    """Every field, whatever the message holds; and a bit that is flipped is noticed."""
    kept, lines = [], []
    for i in range(12):
        payload = bytearray(data.draw(st.binary(min_size=92, max_size=92)))
        payload[4:12] = nav_pvt(drive(12, 1.0), i)[10:18]
        payload[16:20] = bytes(4)
        payload[20:22] = b"\x03\x01"
        message = bytearray(ubx(b"\x01\x07", bytes(payload)))
        if i in (4, 9):
            message[data.draw(st.integers(6, 97))] ^= 1 << data.draw(st.integers(0, 7))
        else:
            kept.append(pyubx2.UBXReader.parse(bytes(message)))
        lines.append(f"{since_start(10**9 * i)},U,{message.hex()}")
    rules = ("before_first_fix", "no_fix", "out_of_limits", "spikes", "inconsistent")
    kept_all = plain_profile(repair=dict.fromkeys(rules, False))
    trip = read(tmp_path, "run.log", lines, profile=kept_all)
    assert report_of(trip).count("damaged_messages") == 2
    columns = {
        "latitude": ("lat", 1.0),
        "longitude": ("lon", 1.0),
        "altitude": ("hMSL", 1e-3),
        "horizontal_accuracy": ("hAcc", 1e-3),
        "vertical_accuracy": ("vAcc", 1e-3),
        "speed": ("gSpeed", 1e-3),
        "speed_accuracy": ("sAcc", 1e-3),
        "satellites": ("numSV", 1.0),
        "pdop": ("pDOP", 1.0),
    }
    frame = trip["/gnss/fix"].join(trip["/gnss/motion"])
    for column, (name, scale) in columns.items():
        expected = [getattr(message, name) * scale for message in kept]
        np.testing.assert_allclose(frame[column], expected, rtol=1e-9, err_msg=column)


@pytest.mark.skipif(not ETH.is_dir(), reason="the samples of ETH are not beside the checkout")
@pytest.mark.parametrize(
    ("name", "fixes", "start", "not_used"),
    [
        ("20221019_1217_R90121_Modena_SN1", 2, "2022-10-19T09:53:30.999931089", 0),
        ("20221020_1252_R90120_Formigine_SN1", 1, "2022-10-20T10:50:27.000338302", 5),
        ("20221020_1252_R90120_Formigine_SN2", 1, "2022-10-20T10:50:25.999560255", 5),
    ],
)
def test_the_published_samples(name, fixes, start, not_used):
    """A train at a standstill: one g upwards, no rotation but the sensor's bias."""
    trip = ingest(ETH / f"{name}_sample.csv")
    report, imu = report_of(trip), trip["/imu"]
    assert report.rows_kept + sum(report.not_used.values()) == 2000
    assert sum(report.not_used.values()) == not_used
    assert report.counts == {}
    assert len(trip["/gnss/fix"]) == fixes
    assert trip["/gnss/fix"].index[0] == pd.Timestamp(start, tz="UTC")
    force = imu[[f"specific_force_{axis}" for axis in "xyz"]].mean()
    assert np.linalg.norm(force) == pytest.approx(9.81, rel=0.03)
    assert np.abs(imu[[f"angular_rate_{axis}" for axis in "xyz"]].mean()).max() < 0.05
    assert trip["/gnss/motion"]["speed"].max() < 0.05
    step = np.diff(imu.index.as_unit("ns").asi8) / 1e9
    assert 1.0 / np.median(step) == pytest.approx(1700.0, rel=0.1)


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


def test_rides_that_cannot_be_used(tmp_path):
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


def test_measurement_files_that_cannot_be_used(tmp_path, monkeypatch):
    path = measured(tmp_path / "run.mf4")
    refused(InputError, "give a profile", ingest, path)
    whole = path.read_bytes()
    for length in (20, 200, 3000, len(whole) // 2):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"run\.mf4: is not a readable measurement file"):
            ingest(path, profile=profile())
    gc.collect()  # nothing is left that complains later
    path.write_bytes(whole)
    monkeypatch.setitem(sys.modules, "asammdf", None)
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


PROFILE = sample("recorder.profile.toml")

LINE, TRAIN = hilly_line(), flirt()


@pytest.fixture(scope="module")
def driven() -> Trip:
    return simulate(draw_scenarios(LINE, TRAIN, 1, 7)[0])


def test_the_vehicle_recorders_file_comes_back(tmp_path, driven):
    """Within the file's own quantisation, and every defect counted."""
    path = tmp_path / "recorder.csv"
    defects = write_recorder_csv(driven, path)
    read = ingest(path, profile=PROFILE, line=LINE, train=TRAIN)
    report = report_of(read)
    assert report.rows_read == defects.rows
    assert report.counts == {
        "duplicates": defects.duplicates,
        "time_backwards": defects.backwards,
        "empty": defects.missing,
        "out_of_limits": defects.outliers,
        "gaps": defects.gaps,
    }
    assert report.rows_dropped == defects.duplicates
    steps = {"position": 0.05, "speed": 0.005 / 3.6, "lever": 0.0005, "wheel_speed": 0.005 / 3.6}
    for topic in ("/train/state", "/train/controls", "/train/axles"):
        old, new = driven[topic], read[topic]
        assert new.index.isin(old.index).all()
        old = old.loc[new.index]
        for column in new.columns:
            bound = steps.get(column.rstrip("_1234"), 50.0)
            if column in ("acceleration", "tractive_effort_demand", "braking_effort_demand"):
                assert new[column].isna().all(), "the recorder does not keep it"
                continue
            lost = new[column].isna()
            assert lost.sum() == (defects.missing + defects.outliers) * (column == "speed")
            error = np.abs(new[column] - old[column])[~lost]
            assert error.max() <= bound * (1.0 + 1e-9), f"{topic}.{column}"


def test_the_ublox_file_comes_back(tmp_path, driven):
    """Times to the nanosecond although the file has whole seconds; values to the last digit."""
    path = tmp_path / "gnss.csv"
    defects = write_ublox_csv(driven, path)
    read = ingest(path)
    report = report_of(read)
    assert report.rows_read == report.rows_kept == defects.rows
    assert report.count("gaps") == defects.gaps
    wild = report.count("spikes") + report.count("out_of_limits")
    assert wild == defects.outliers > 0
    for topic in ("/gnss/fix", "/gnss/motion"):
        old, new = driven[topic], read[topic]
        pd.testing.assert_index_equal(new.index, old.index, exact=False)
        for column in new.columns:
            known = new[column].notna()
            assert known.sum() == len(new) - (defects.outliers if column == "speed" else 0)
            np.testing.assert_allclose(new[column][known], old[column][known], rtol=0, atol=5e-9)


def test_what_was_done_is_reported_in_metadata_and_provenance(tmp_path, driven):
    path = tmp_path / "recorder.csv"
    write_recorder_csv(driven, path)
    stated = {"operator": "SOB", "weather": "wet"}
    trip = ingest(path, PROFILE, line=LINE, train=TRAIN, direction="reverse", metadata=stated)
    write_log(trip, tmp_path / "trip.mcap")
    kept, report = read_log(tmp_path / "trip.mcap"), report_of(trip)
    assert kept.metadata == trip.metadata
    known = {
        **stated, "trip": "recorder", "line": LINE.name, "train": TRAIN.name,
        "direction": "reverse", "start": trip.start.isoformat(),
        "repair.duplicates": str(report.count("duplicates")),
        "repair.empty./train/state.speed": str(report.count("empty")),
        "rows.dropped": str(report.rows_dropped),
    }  # fmt: skip
    assert {name: kept.metadata.get(name) for name in known} == known
    assert report_of(kept) == report
    assert line_of(kept).stations[0].name == "Dorf"
    assert train_of(kept).mass == TRAIN.mass
    (step,) = kept.provenance
    known = {"step": "ingest", "format": "csv", "software": f"trainlog {__version__}"}
    assert {name: step[name] for name in known} == known
    files = {"recorder.csv": path.read_bytes(), PROFILE_ATTACHMENT: PROFILE.read_bytes()}
    files |= {name: kept.attachments[name] for name in (LINE_ATTACHMENT, TRAIN_ATTACHMENT)}
    assert kept.attachments[PROFILE_ATTACHMENT] == files[PROFILE_ATTACHMENT]
    found = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    assert {name: step["inputs"][name] for name in files} == found


def test_a_line_that_the_train_runs_out_of_is_refused():
    short = replace(level_line(5_000.0, limit=30.0), name="short")
    with pytest.raises(InputError, match=r"recorder\.csv: positions reach km 29\..*line 'short'"):
        ingest(sample("recorder.csv"), profile=PROFILE, line=short)
    long, before = replace(short, name="long", length=40_000.0), {"start_position": "-20000"}
    with pytest.raises(InputError, match=r"positions reach km -20\.0.*line 'long' begins at km 0"):
        ingest(sample("recorder.csv"), profile=PROFILE, line=long, metadata=before)
