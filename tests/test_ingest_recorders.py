"""The files of recorders met in the field, with all their defects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from contents import put
from recorder_files import Recorded, drive, gpx, gpx_text, mtk
from refusals import refused

from trainlog.errors import InputError
from trainlog.ingest import ingest, ingest_each, report_of
from trainlog.trip import Trip


def read(tmp_path: Path, name: str, text: str, **options: object) -> Trip:
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
