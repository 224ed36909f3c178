"""The registry of formats, of which a user's own is one function; layouts of delimited text."""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
import pytest
from contents import put
from hypothesis import given, settings, strategies as st
from ingest_logs import PLAIN, clean_run, plain_profile, write
from refusals import refused

from trainlog.errors import InputError
from trainlog.ingest import RULES, formats, ingest, profile_of, report_of
from trainlog.ingest.profile import Column, Detection, FileOptions, TimeOptions, parse_profile
from trainlog.ingest.registry import format_by_profile

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "ingest.md").read_text("utf-8")


@pytest.fixture(autouse=True)
def _fresh_registry() -> Iterator[None]:
    formats.cache_clear()
    yield
    formats.cache_clear()


def test_parquet_that_does_not_fit_is_refused(tmp_path):
    path = tmp_path / "run.parquet"
    pa.parquet.write_table(pa.table({"t": [1.0, 2.0], "v": [1.0, 2.0], "s": [1.0, 2.0]}), path)
    given = {"profile": plain_profile()}
    for data in (path.read_bytes()[:-9], b"PAR1"):
        path.write_bytes(data)
        refused(InputError, "is not a readable Parquet table", ingest, path, **given)
    run = clean_run(5, 1.0)
    stamps = pd.DatetimeIndex(run.time, tz="UTC")
    pa.parquet.write_table(pa.table({"t": stamps, "v": run.speed, "s": stamps}), path)
    refused(InputError, r"column s: .* not numbers", ingest, path, profile=plain_profile())
    refused(InputError, "give a profile", ingest, path)
    pa.parquet.write_table(pa.table({"t": stamps, "w": run.speed, "way": run.position}), path)
    said = r"2 problems: .*no column 'v'; columns: t, w, way; \(2\) .*no column 's'"
    refused(InputError, said, ingest, path, profile=plain_profile())
    pa.parquet.write_table(pa.table({"t": stamps[:0], "v": [], "s": []}), path)
    refused(InputError, "has no row of data", ingest, path, profile=plain_profile())


ENDINGS = [("\n", "utf-8"), ("\r\n", "utf-8-sig"), ("\r", "cp1252"), ("\r\n", "utf-16")]
LAYOUTS = [
    ("t,v,s\n", "\n", {}),
    ("t,v,s\n", "", {}),
    ('"t", v ,"s"\n', "\n", {}),
    ("# recorder 7\n\nt,v,s\n\n# started\n", "\n\n\n", {}),
    ("t,v,s,\n", "\n", {}),
    ("Recorder 7\nsome, words\nt,v,s\nunix,m/s,m\n", "\n", {"header": 3, "skip_after_header": 1}),
]


@pytest.mark.parametrize(("layout", "place"), [(n, n % 4 + k) for n in range(6) for k in (0, 2)])
def test_layouts_of_text(tmp_path, layout, place):
    """Each layout with two of the endings of lines, each with its encoding."""
    (head, tail, options), (ending, encoding) = LAYOUTS[layout], ENDINGS[place % 4]
    run = clean_run(10, 1.0)
    text = head + "\n".join(run.rows()) + tail
    path = put(tmp_path / "run.csv", text.replace("\n", ending).encode(encoding))
    profile = plain_profile(file={"encoding": encoding, **options})
    trip = ingest(path, profile=profile)
    np.testing.assert_array_equal(trip["/train/state"]["speed"], run.speed)
    assert report_of(trip).rows_read == 10


@pytest.mark.parametrize("encoding", ["cp1252", "latin-1", "ascii"])
def test_the_mark_of_utf_8_decides_over_the_encoding_of_the_profile(tmp_path, encoding):
    run = clean_run(10, 1.0)
    path = tmp_path / "run.csv"
    path.write_text("t,v,s,Länge\n" + "".join(f"{row},ä\n" for row in run.rows()), "utf-8-sig")
    trip = ingest(path, profile=plain_profile(file={"encoding": encoding}))
    np.testing.assert_array_equal(trip["/train/state"]["speed"], run.speed)


def test_rows_are_counted_as_an_editor_counts_them(tmp_path):
    rows = clean_run(20, 1.0).rows()
    rows[4] = rows[4].replace(",", ",x", 1)
    lines = ["# a", "", "t,v,s", *rows[:3], "# pause", "", *rows[3:8], rows[8].split(",")[0]]
    path = put(tmp_path / "run.csv", [*lines, *rows[9:]])
    found = {f.rule: f.rows for f in report_of(ingest(path, profile=plain_profile())).findings}
    lines_of_file = path.read_text("utf-8").splitlines()
    assert lines_of_file[found["not_a_number"][0] - 1] == rows[4]
    assert lines_of_file[found["truncated_rows"][0] - 1] == rows[8].split(",")[0]


def blocks(language: str, name: str) -> str:
    """The block of the page in `language` whose first line names a file."""
    found = re.findall(rf"^```{language}\n# {re.escape(name)}\n(.*?)^```", PAGE, re.M | re.S)
    assert len(found) == 1, f"docs/ingest.md has {len(found)} blocks {name}"
    return found[0]


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package that docs/ingest.md shows, installed as pip would."""
    (tmp_path / "wayside_log.py").write_text(blocks("python", "wayside_log.py"), "utf-8")
    project = tomllib.loads(blocks("toml", "pyproject.toml"))["project"]
    entries = project["entry-points"]["trainlog.ingest"]
    folder = tmp_path / "wayside_log-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: wayside-log\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(
        "[trainlog.ingest]\n" + "".join(f"{key} = {value}\n" for key, value in entries.items())
    )
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_the_pages_own_format_is_found_and_repaired(installed):
    seconds = np.arange(1_714_543_200, 1_714_543_300, dtype="<i8")
    speed = (3.6 * (20.0 + np.sin(seconds / 20.0))).astype("<f4")
    speed[50] = 400.0
    data = np.rec.fromarrays([seconds, speed], names="second,speed").tobytes()
    path = put(installed / "run.way", b"WAY1" + data)
    assert next(iter(formats())) == "wayside"
    trip = ingest(path)
    assert trip.provenance[0]["format"] == "wayside"
    assert report_of(trip).counts == {"spikes": 1}
    assert len(trip["/train/state"]) == 99
    np.testing.assert_allclose(trip["/train/state"]["speed"].iloc[:50], speed[:50] / 3.6, rtol=1e-6)


def test_a_format_that_cannot_be_loaded_is_named(installed):
    (installed / "wayside_log.py").write_text("import nothing_of_that_name\n", "utf-8")
    sys.modules.pop("wayside_log", None)
    refused(InputError, "format 'wayside' cannot be loaded from wayside_log:WAY", formats)
    other = profile_of({**PLAIN, "file": {"format": "ublox"}})
    said = "'plain': no general format 'ublox'; formats: gpx"
    refused(InputError, said, format_by_profile, "mine", other)


MINE = """
format = "trainlog/recorder-profile"
version = 1
name = "mine"

[detect]
columns = ["t", "speed"]

[file.aliases]
speed = ["v", "velocity"]

[time]
column = "t"

[columns]
"/train/state.speed" = { column = "speed", unit = "m/s", integer_scale = 0.01 }
"""


@pytest.mark.parametrize("name", ["v", "Velocity"])
def test_a_profile_of_the_users_folder_is_used_as_if_given(tmp_path, monkeypatch, name):
    folder = tmp_path / "recorders"
    folder.mkdir()
    (folder / "mine.toml").write_text(MINE, "utf-8")
    run = clean_run(50, 0.1)
    path = write(tmp_path / "run.csv", run.rows(), f"t,{name},s")
    refused(InputError, "give a profile", ingest, path)
    monkeypatch.setenv("TRAINLOG_PROFILES", str(folder))
    trip = ingest(path)
    given = ingest(path, profile=folder / "mine.toml")
    np.testing.assert_array_equal(trip["/train/state"]["speed"], run.speed)
    assert trip.provenance == given.provenance
    assert trip.attachments == given.attachments
    assert trip.provenance[0]["profile"] == "mine"
    parts = (row.split(",") for row in run.rows())
    cm = [f"{stamp},{round(100 * float(speed))}" for stamp, speed, _ in parts]
    whole = ingest(write(tmp_path / "whole.csv", cm, f"t,{name}"))
    np.testing.assert_allclose(whole["/train/state"]["speed"], run.speed, atol=0.0051)
    with pytest.raises(InputError, match="no column of the speed; expected one called v or velo"):
        ingest(write(tmp_path / "x.csv", run.rows(), "t,w,s"), profile=folder / "mine.toml")
    (folder / "mine.toml").write_text(MINE + "[fiel]\n", "utf-8")
    formats.cache_clear()
    refused(InputError, r"mine\.toml, fiel: unknown key 'fiel'; did you mean", ingest, path)
    monkeypatch.setenv("TRAINLOG_PROFILES", str(tmp_path / "absent"))
    formats.cache_clear()
    refused(InputError, r"absent: is not a folder; set TRAINLOG_PROFILES to", ingest, path)


def test_an_entry_point_may_name_a_profile(installed):
    mine = MINE + "[trip]\nweather = 'wet'\n[repair]\nspikes = false\n"
    (installed / "wayside_log.py").write_text(
        "from trainlog.ingest.profile import parse_profile\n"
        f"WAYSIDE = parse_profile({mine.encode()!r}, file='mine.toml')\n",
        "utf-8",
    )
    sys.modules.pop("wayside_log", None)
    run = clean_run(50, 0.1)
    trip = ingest(write(installed / "run.csv", run.rows(), "t,v,s"))
    sys.modules.pop("wayside_log", None)
    assert trip.provenance[0]["format"] == "wayside"
    np.testing.assert_array_equal(trip["/train/state"]["speed"], run.speed)
    assert trip.metadata["weather"] == "wet"
    assert report_of(trip).switched_off == ("spikes",)


TAGGED = """
format = "trainlog/recorder-profile"
version = 1
name = "three words"

[file]
format = "tagged"
header = 0

[time]
column = "1"
format = "elapsed"
unit = "ms"
start = 2024-05-01T06:00:00Z

[lines]
kind = "2"
payload = "3"
kinds = { S = { type = ">u2", count = 2 }, X = { type = "nmea" } }

[columns]
"/train/state.speed" = { column = "S.2", unit = "km/h", scale = 0.1 }
"""


def test_lines_of_a_recorder_of_ones_own(tmp_path):
    profile = parse_profile(TAGGED.encode(), file="mine.toml")
    lines = [f"{100 * i},S,{7:04x}{360 + i:04x}" for i in range(50)]
    lines[9] = "900,S,0007"
    lines[20] = "2000,Q,00070168"
    trip = ingest(put(tmp_path / "run.txt", "\n".join(lines)), profile=profile)
    speed = trip["/train/state"]["speed"]
    assert speed.index[1] == pd.Timestamp("2024-05-01T06:00:00.1Z")
    kept = [i for i in range(50) if i not in (9, 20)]
    np.testing.assert_allclose(speed, [(360 + i) / 36.0 for i in kept])
    assert report_of(trip).counts == {"damaged_messages": 2}
    assert report_of(trip).rows_read == 50
    with pytest.raises(InputError, match=r"state.speed\": no 'S.3'; did you mean 'S.2'"):
        parse_profile(TAGGED.replace("S.2", "S.3").encode(), file="mine.toml")
    with pytest.raises(InputError, match=r"kinds\.S: type '>x2' must be 'ubx', 'nmea' or numbers"):
        parse_profile(TAGGED.replace(">u2", ">x2").encode(), file="mine.toml")


def test_every_rule_has_its_row_in_the_page():
    page = (DOCS / "ingest-rules.md").read_text("utf-8")
    stated = re.findall(r"^\| `(\w+)` \| .* \| (keeps|refuses) \|$", page, re.M)
    expected = [(rule.name, "keeps" if rule.off == "keep" else "refuses") for rule in RULES]
    assert stated == expected


@pytest.mark.parametrize("options", [FileOptions, TimeOptions, Column, Detection])
def test_every_key_is_in_the_page(options):
    for each in fields(options):
        assert f"`{each.name}`" in PAGE


@settings(max_examples=25)
@given(st.data())
def test_empty_cells_at_the_end_make_no_difference(tmp_path, data):
    """The header's and every row's number of empty cells is drawn; blanks may stand in them."""
    mark = data.draw(st.sampled_from([",", ";", "\t"]))
    empty = st.lists(st.sampled_from(["", "", " "]), max_size=6)
    run = clean_run(60, 1.0)
    drawn = [data.draw(empty) for _ in range(data.draw(st.integers(1, 4)))]
    header = mark.join(["t", "v", "s", *data.draw(empty)])
    rows = [
        mark.join([*row.split(","), *drawn[i % len(drawn)]]) for i, row in enumerate(run.rows())
    ]
    path = write(tmp_path / "run.csv", rows, header)
    trip = ingest(path, profile=plain_profile(file={"delimiter": mark}))
    report = report_of(trip)
    assert report.findings == ()
    assert (report.rows_read, report.rows_kept) == (60, 60)
    np.testing.assert_array_equal(trip["/train/state"]["speed"], run.speed)
    np.testing.assert_array_equal(trip["/train/state"]["position"], run.position)
