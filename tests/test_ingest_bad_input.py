"""Files that cannot be used: one line that names the file, the place and the remedy."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
import pytest
import test_ingest_recorders as recorders
from contents import put
from ingest_logs import clean_run, plain_profile, plain_rows, plain_text, ublox, write
from recorder_files import drive, gpx_text, hexlines, mtk, nmea_lines

from trainlog.errors import InputError, TrainlogError
from trainlog.formats.samples import sample
from trainlog.ingest import ingest, ingest_each, propose_profile, repairs_of, report_of


def refused(path: Path, message: str, **options: object) -> str:
    """What `ingest` says when it refuses the file; it must begin with the file's name."""
    options = {"profile": plain_profile(), **options}
    with pytest.raises(InputError, match=message) as caught:
        ingest(path, **options)
    complaint = str(caught.value)
    assert complaint.startswith(str(path))
    assert "\n" not in complaint
    assert "; " in complaint, "no remedy"
    return complaint


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is empty"),
        (b"\n\n \n", "(is empty|has no row)"),
        (b"\0" * 3000, "is empty"),
        (b"t,v,s\n", "row 1: has no row of data, only its header"),
        (b"t,v,s", "row 1: has no row of data, only its header"),
        (b"# nothing\n# but comments\n", "has no header"),
        (bytes(range(256)) * 8, "is of no format that trainlog knows; it begins with 00 01"),
        (plain_text(plain_rows()).encode("utf-16"), 'UTF-16; set encoding = "utf-16"'),
        (b"t,v,s\n" + b"x" * 70_000 + b"\n\0\n", "row|is not text: it holds zero bytes"),
        (plain_text(plain_rows()).encode().replace(b"\n", b"\xe9\n", 5), r"row 1, byte 5: is not"),
        (plain_text(plain_rows()).replace(",", ";").encode(), r"no column 't'; set delimiter"),
        (plain_text(plain_rows()).replace(",", "\t").encode(), r'set delimiter = "\\t"'),
        (plain_text(plain_rows()).replace(",v,", ",speed,").encode(), "no column 'v'.*t, speed, s"),
        (plain_text(plain_rows()).replace("t,v", "t,V").encode(), "did you mean 'V'"),
        (
            plain_text(plain_rows(), "t,speed,way").encode(),
            r"2 problems: \(1\) .*no column 'v'; .*t, speed, way; \(2\) .*no column 's'; ",
        ),
        (plain_text(plain_rows()).replace("t,v,s", "t,v,v").encode(), "column 'v' comes 2 times"),
        (
            plain_text([row.rpartition(",")[0] for row in plain_rows()]).encode(),
            "row 2: 20 of 20 rows do not fit the header of row 1: it has 3 columns, they have 2"
            " cells; the last name is 's'",
        ),
        *(
            (plain_text(rows, header).encode(), f"row 2: 60 of 60 rows do not fit .* {said}")
            for rows, header, said in (
                (
                    plain_rows(60),
                    "t,v,s,a,b,,,",
                    "5 columns, .* 3 cells; the last name is 'b', .* "
                    "remove the 2 names without a cell",
                ),
                (
                    [row + ",7,8,9,6" for row in plain_rows(60)],
                    "t,v,s,,",
                    "5 columns, they have 7 "
                    "cells; .*name the 2 columns that the header does not name",
                ),
                (
                    [row.partition(",")[0] + ",12,5,1000,25" for row in plain_rows(60)],
                    "t,v,s",
                    "3 columns, they have 5 cells.*decimal comma",
                ),
            )
        ),
        (
            plain_text([row.replace("Z,", "Z,x") for row in plain_rows()]).encode(),
            r"row 2, column v: 20 cells are not numbers, the first is 'x22.955'; check which",
        ),
        *(
            (
                plain_text([row.split(",")[0] + cells for row in plain_rows()]).encode(),
                "none of the mapped columns holds a number; check the columns",
            )
            for cells in (",,", ",nan,NaN")
        ),
        (plain_text(plain_rows()[:1]).encode(), "row 2: 1 row is left .* a trip needs 2"),
        (plain_text(plain_rows()[:1] * 50).encode(), "1 row is left after rule 'duplicates'"),
        (plain_text([",1.0,2.0"] * 5).encode(), "rows 2 to 6: no row has a time that can be"),
        (plain_text(["yesterday,1.0,2.0"] * 5).encode(), "no row has a time that can be read"),
        (b'"t","v","s"\n"a,b,c\nd,e,f\n', "cells|time|number"),
    ],
)
def test_each_unusable_file_gives_one_line(tmp_path, data, message):
    refused(put(tmp_path / "run.csv", data), message)


def units(speed: str, position: str, sign: int = 1) -> dict[str, object]:
    """Options of a call that takes the columns in these units."""
    columns = {
        "/train/state.speed": {"column": "v", "unit": speed},
        "/train/state.position": {"column": "s", "unit": position, "sign": sign},
    }
    return {"profile": plain_profile(columns=columns)}


LOG = sample("stopping.mcap").read_bytes()


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        (None, {}, "does not exist; check the path"),
        *((None, {"format": each}, "does not exist") for each in ("csv", "parquet", "ublox")),
        (LOG.replace(b"\r\n", b"\n"), {}, "byte 0: is an MCAP file whose line ends .*binary mode"),
        (LOG.replace(b"\n", b"\r\n"), {"profile": None}, "byte 0: is an MCAP file whose line ends"),
        ("", {"profile": None}, "layout that trainlog does not know; give a profile"),
        ("", {"profile": sample("recorder.profile.toml")}, "; correct the profile .*profile.toml$"),
        ("", units("km/h", "m"), "position moves .* m, /train/state.speed gives .* m; check the"),
        ("", units("m/s", "km"), "position: .* values are impossible|position moves"),
        ("", units("m/s", "mm"), "position moves"),
        ("", units("m/s", "m", -1), "falls by .* turn the sign of its column"),
        ("3", {}, r"row \d+: /train/state.speed: \d+ of 200 values are impossible.*check the unit"),
    ],
)
def test_calls_that_do_not_fit_a_file_give_one_line(tmp_path, data, options, message):
    """A file of these bytes, or a good one whose speeds begin with a digit more; None: no file."""
    path = tmp_path / "run.csv"
    if isinstance(data, str):
        write(path, [row.replace("Z,", f"Z,{data}") for row in plain_rows(200)])
    elif data is not None:
        path.write_bytes(data)
    refused(path, message, **options)


def test_folders_and_formats_that_are_not_there(tmp_path):
    for options in ({}, *({"format": each} for each in ("csv", "parquet", "ublox"))):
        refused(tmp_path, "is a folder; name a file in it", **options)
    with pytest.raises(InputError, match="no format 'parket'; did you mean 'parquet'"):
        ingest(write(tmp_path / "run.csv", plain_rows()), format="parket")


def test_rows_that_run_backwards_in_time(tmp_path):
    """They are turned round and counted; the trip is that of the rows in order."""
    rows = plain_rows(3000)
    sound = ingest(write(tmp_path / "sound.csv", rows), profile=plain_profile())
    path = write(tmp_path / "run.csv", rows[::-1])
    trip = ingest(path, profile=plain_profile())
    assert report_of(trip).counts == {"newest_first": 3000}
    pd.testing.assert_frame_equal(trip["/train/state"], sound["/train/state"])
    strict = plain_profile(repair={"newest_first": False})
    refused(path, "3000 times 'newest_first', which the profile does not let be", profile=strict)
    proposed = propose_profile(path)
    assert any("newest row first" in line for line in proposed.lines())


def test_a_log_cut_off_anywhere_gives_its_whole_rows(tmp_path):
    """At most the row in which the recorder lost power is lost or shortened."""
    whole = plain_text(plain_rows(30)).encode()
    path = tmp_path / "run.csv"
    for end in range(len(whole) - 300, len(whole), 4):
        path.write_bytes(whole[:end] + b"\0" * 50)
        trip = ingest(path, profile=plain_profile())
        complete = whole[:end].count(b"\n") - 1
        assert complete <= report_of(trip).rows_read <= complete + 1
        assert complete <= len(trip["/train/state"]) <= complete + 1


FILLS = (b"\0", b",", b"\n", b'"', b"9", b"-", b"e", b"<", b"#")
TIME = {"column": "t", "format": "elapsed", "start": "2024-05-01T00:00:00Z"}
PROFILES = {
    "mdf": recorders.profile({"/train/state.speed": {"column": "v"}}),
    "csv": plain_profile(),
    "parquet": plain_profile(time=TIME),
}


def whole(kind: str, folder: Path) -> tuple[Path, bytes]:
    """A good file of a format."""
    run = drive(30, 1.0)
    if kind == "aalto":
        rides = [recorders.ride(1, "SUBWAY", "V", "09:02:00", "09:09:00")]
        path = recorders.both(folder, recorders.fixes(1, "09:00:00", "09:10:00"), rides)
        return path, path.read_bytes()
    if kind == "mdf":
        samples = [recorders.signal(recorders.speed(recorders.SLOW), recorders.SLOW, "v", "km/h")]
        path = recorders.measured(folder / "run.mf4", groups=[samples])
        return path, path.read_bytes()
    ticks = np.arange(60)
    if kind == "parquet":
        sink = pa.BufferOutputStream()
        pa.parquet.write_table(pa.table({"t": ticks, "v": ticks / 7, "s": ticks * 1.0}), sink)
        return folder / "run.dat", sink.getvalue().to_pybytes()
    text = {
        "csv": plain_text(clean_run(60, 0.5).rows()),
        "ublox": ublox(ticks // 5, ticks / 5),
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
def test_damage_gives_trips_or_our_error(tmp_path, kind):
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
