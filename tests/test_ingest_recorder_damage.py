"""Whatever happens to a recorder's file, it gives trips or one of our errors, never another."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import test_ingest_aalto as phones
import test_ingest_mdf as measured
from ingest_logs import clean_run, plain_profile, plain_text, ublox
from recorder_files import drive, gpx_text, hexlines, mtk, nmea_lines

from trainlog.errors import TrainlogError
from trainlog.ingest import ingest_each, repairs_of, report_of

FILLS = (b"\0", b",", b"\n", b'"', b"9", b"-", b"e", b"<", b"#")
TIME = {"column": "t", "format": "elapsed", "start": "2024-05-01T00:00:00Z"}
PROFILES = {
    "mdf": measured.profile({"/train/state.speed": {"column": "v"}}),
    "csv": plain_profile(),
    "parquet": plain_profile(time=TIME),
}


def whole(kind: str, folder: Path) -> tuple[Path, bytes]:
    """A good file of a format."""
    run = drive(30, 1.0)
    if kind == "aalto":
        rides = [phones.ride(1, "SUBWAY", "V", "09:02:00", "09:09:00")]
        path = phones.both(folder, phones.fixes(1, "09:00:00", "09:10:00"), rides)
        return path, path.read_bytes()
    if kind == "mdf":
        samples = [measured.signal(measured.speed(measured.SLOW), measured.SLOW, "v", "km/h")]
        path = measured.measured(folder / "run.mf4", groups=[samples])
        return path, path.read_bytes()
    ticks = np.arange(60)
    if kind == "parquet":
        sink = pa.BufferOutputStream()
        pa.parquet.write_table(pa.table({"t": ticks, "v": ticks / 7, "s": ticks * 1.0}), sink)
        return folder / "run.dat", sink.getvalue().to_pybytes()
    text = {
        "csv": plain_text(clean_run(60, 0.5).rows()),
        "ublox": ublox(ticks // 5, ticks / 5).text(),
        "gpx": gpx_text(run),
        "nmea": "\n".join(nmea_lines(run)),
        "hexlines": hexlines(0, 8, 20).text,
        "mtk": mtk(0, before=5).text[:6000],
    }[kind]
    return folder / "run.dat", text.encode()


def damaged(draw: random.Random, data: bytes) -> bytes:
    """The file with one to eight stretches flipped, cut, doubled or filled."""
    found = bytearray(data)
    for _ in range(draw.randint(1, 8)):
        start, length = draw.randrange(len(found)), draw.randint(1, 40)
        kind = draw.choice(["flip", "cut", "double", "fill"])
        if kind == "flip":
            found[start] ^= draw.randint(1, 255)
        elif kind == "cut":
            del found[start : start + length]
        elif kind == "double":
            found[start:start] = found[start : start + length]
        else:
            found[start : start + length] = draw.choice(FILLS) * length
    return bytes(found)


@pytest.mark.parametrize("kind", ["gpx", "nmea", "hexlines", "mtk", "aalto", *PROFILES, "ublox"])
def test_damage_gives_trips_or_our_error(tmp_path: Path, kind: str) -> None:
    path, data = whole(kind, tmp_path)
    draw = random.Random(kind)
    for _ in range(6 if kind == "mdf" else 14):
        path.write_bytes(damaged(draw, data))
        message, trips = "", []
        try:
            trips.extend(ingest_each(path, format=kind, profile=PROFILES.get(kind)))
        except TrainlogError as error:
            message = str(error)
        assert message.startswith(str(path.parent)) if message else trips
        assert "\n" not in message
        for trip in trips:
            report = report_of(trip)
            assert 2 <= report.rows_kept <= report.rows_read
            assert len(repairs_of(trip)) == report.raw_kept
