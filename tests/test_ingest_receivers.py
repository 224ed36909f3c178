"""Logs of receivers' messages: NMEA sentences, and hex lines with UBX, NMEA and an IMU."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import pyubx2
from contents import put
from hypothesis import HealthCheck, given, settings, strategies as st
from ingest_logs import plain_profile
from recorder_files import checked, drive, hexlines, nav_pvt, nmea_lines, since_start, ubx
from refusals import refused

from trainlog.errors import InputError
from trainlog.ingest import ingest, repairs_of, report_of
from trainlog.trip import Trip

ETH = Path(__file__).parents[2] / "shared" / "data" / "eth_localization"


def read(tmp_path: Path, lines: list[str], **options: object) -> Trip:
    return ingest(put(tmp_path / "run.log", lines), **options)


def assert_fixes(trip: Trip, run: object) -> None:
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
    trip = read(tmp_path, nmea_lines(run, kinds))
    assert trip.provenance[0]["format"] == "nmea"
    assert_fixes(trip, run)
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
    trip = read(tmp_path, lines)
    assert_fixes(trip, run)
    assert trip.end.isoformat() == "2024-05-02T00:00:19.800000+00:00"


def test_damaged_sentences_are_counted_and_kept(tmp_path):
    run = drive(60, 1.0)
    lines = nmea_lines(run, ("RMC", "GGA"))
    bad = {10: lines[10].replace(",N,", ",S,"), 21: lines[21][:-3], 40: lines[40][:17]}
    for place, line in bad.items():
        lines[place] = line
    lines.insert(30, "logger: flushed")
    trip = read(tmp_path, lines)
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
    trip = read(tmp_path, [prefix + line for line in lines])
    assert_fixes(trip, run)


def test_no_fix_and_void_sentences_say_nothing(tmp_path):
    run = drive(60, 1.0)
    void = [checked(f"GNRMC,0559{i:02d}.00,V,,,,,,,010524,,,N") for i in range(30)] + [
        checked(f"GNGGA,0559{i:02d}.00,,,,,0,00,99.99,,,,,,") for i in range(30, 40)
    ]
    trip = read(tmp_path, void + nmea_lines(run, ("RMC", "GGA")))
    assert report_of(trip).counts == {"before_first_fix": 40}
    assert_fixes(trip, run)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (nmea_lines(drive(20, 1.0), ("GGA", "VTG")), "row 1: gives the time of day, but no date"),
        ([checked("GPGSV,1,1,01,07,79,048,42")] * 9, "has no RMC, GGA or GNS sentence"),
        ([line[:-1] + "G" for line in nmea_lines(drive(9, 1.0))], "45 of 45 messages are damaged"),
    ],
)
def test_logs_that_cannot_be_used(tmp_path, lines, message):
    refused(InputError, message, read, tmp_path, lines)


def test_hex_lines_come_back(tmp_path):
    """The IMU's times count since the start, by a clock that drifts: 0.4 ms are left of it."""
    made = hexlines(0)
    trip = read(tmp_path, made.text.splitlines())
    report = report_of(trip)
    assert trip.provenance[0]["format"] == "hexlines"
    assert set(report.counts) == {"time_backwards", "before_first_fix"}
    assert report.count("before_first_fix") == 5
    assert report.not_used == {"UBX ACK-ACK": 30}
    assert_fixes(trip, made.fixes)
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
    trip = read(tmp_path, lines)
    assert_fixes(trip, run)
    late = trip["/imu"].index.as_unit("ns").asi8 - made.utc
    assert np.abs(late).max() < 1_000_000


def test_hex_lines_without_a_time_or_of_a_restarted_logger_are_refused(tmp_path):
    lines = [line for line in hexlines(1).text.splitlines() if ",I," in line]
    refused(InputError, r"no message gives the time.*NAV-PVT", read, tmp_path, lines)
    run = drive(9, 1.0)
    void = [f"{since_start(10**9 * i)},U,{nav_pvt(run, i, valid=False).hex()}" for i in range(9)]
    refused(InputError, "no message gives the time", read, tmp_path, lines + void)
    run = drive(300, 1.0)
    lines = [f"{since_start(10**9 * (i % 150 + 5))},U,{nav_pvt(run, i).hex()}" for i in range(300)]
    refused(InputError, r"clock was restarted: .* split the file", read, tmp_path, lines)


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
    trip = read(tmp_path, lines, profile=plain_profile(repair=dict.fromkeys(rules, False)))
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
