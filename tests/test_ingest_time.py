"""Time as recorders write it comes out as UTC or not at all; layouts of text; own formats."""

from __future__ import annotations

import datetime
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
import pytest
from contents import put
from hypothesis import given, settings, strategies as st
from ingest_logs import HEAD, PLAIN, clean_run, plain_profile, write
from recorder_files import (
    MTK_HEADER,
    START,
    Drive,
    gpx_text,
    mtk_rows,
    nmea_lines,
    stamps,
    ublox_text,
)
from refusals import refused
from simulated_line import hilly_line

from trainlog import DEFAULT_LINE, DEFAULT_TRAIN, draw_scenarios, read_line, read_train, sample
from trainlog.declaration import from_content
from trainlog.errors import InputError, in_file
from trainlog.ingest import RULES, Profile, formats, ingest, profile_of, report_of
from trainlog.ingest.clock import rows_per_second
from trainlog.ingest.mapping import read_time
from trainlog.ingest.profile import Column, Detection, FileOptions, TimeOptions, parse_profile
from trainlog.ingest.recording import NO_TIME, Table
from trainlog.ingest.registry import format_by_profile
from trainlog.railway import Line
from trainlog.simulation import simulate
from trainlog.trip import Trip
from trainlog.units import NANOSECONDS

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "ingest.md").read_text("utf-8")


@pytest.fixture
def fresh_registry() -> Iterator[None]:
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
TEXTS = [
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
    (head, tail, options), (ending, encoding) = TEXTS[layout], ENDINGS[place % 4]
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
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fresh_registry: None) -> Path:
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


@pytest.mark.usefixtures("fresh_registry")
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


SECOND = 1_000_000_000
BEGIN = 120.0
"""Time of the trip [s] at which the recordings begin."""

LINES: dict[str, Callable[[], Line]] = {
    "StGallen-Wil": lambda: read_line(sample(DEFAULT_LINE)),
    "Chemnitz-Cranzahl": lambda: read_line(sample("DE_Chemnitz_Cranzahl.line.json")),
    "hilly": hilly_line,
}


@cache
def motion(line: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], speed [m/s] and position [m] of a simulated trip, ten a second."""
    scenario = draw_scenarios(LINES[line](), read_train(sample(DEFAULT_TRAIN)), count=1, seed=11)[0]
    truth = simulate(scenario)["/truth"]
    seconds = (truth.index.as_unit("ns").asi8 - truth.index.as_unit("ns").asi8[0]) / SECOND
    at = np.arange(0.0, seconds[-1], 0.1)
    speed = np.interp(at, seconds, truth["speed"].to_numpy())
    position = np.interp(at, seconds, truth["position"].to_numpy())
    return at, speed, position - position[0]


def lasting(rng: np.random.Generator, size: int, rate: float, std: float) -> np.ndarray:
    """Errors that last for half a minute."""
    keep = np.exp(-1.0 / (30.0 * rate))
    white = rng.normal(0.0, std * np.sqrt(1.0 - keep**2), size)
    out = np.empty(size)
    out[0] = rng.normal(0.0, std)
    for i in range(1, size):
        out[i] = keep * out[i - 1] + white[i]
    return out


def drive(line: str, rate: float, count: int, begin: float = BEGIN) -> Drive:
    """What a receiver gives of the trip, `rate` fixes a second, and when that was."""
    rng, (at, speed, position) = np.random.default_rng(5), motion(line)
    seconds = begin + np.arange(count) / rate
    along = np.interp(seconds, at, position) + lasting(rng, count, rate, 2.0)
    along += rng.normal(0.0, 0.2, count)
    beside = lasting(rng, count, rate, 2.0)
    heading = 0.6 + along / 9e3
    north = np.cumsum(np.diff(along, prepend=along[0]) * np.cos(heading)) + beside
    east = np.cumsum(np.diff(along, prepend=along[0]) * np.sin(heading))
    start = pd.Timestamp("2024-05-01T06:00:00Z").value
    return Drive(
        start + np.round(seconds * SECOND).astype(np.int64),
        np.round(47.4 + north / 111_195.0, 7),
        np.round(9.3 + east / 75_300.0, 7),
        np.round(600.0 + lasting(rng, count, rate, 4.0), 3),
        np.round(np.abs(np.interp(seconds, at, speed) + rng.normal(0.0, 0.1, count)), 3),
        np.round(rng.uniform(0.7, 2.5, count), 1),
        rng.integers(5, 14, count),
    )


@dataclass(frozen=True)
class Layout:
    """How a recorder writes a drive, and the distance that wheels count [m]."""

    name: str
    rate: float
    text: Callable[[Drive, np.ndarray], str | bytes]
    profile: dict[str, Any] | None = None

    def write(self, path: Path, run: Drive, distance: np.ndarray) -> None:
        text = self.text(run, distance)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())


def distance(line: str, run: Drive) -> np.ndarray:
    """Distance [m] that wheels count whose diameter is known to four per mille."""
    at, _, position = motion(line)
    return 1.004 * np.interp((run.time - START) / SECOND, at, position)


def _state(stamps: Callable[[np.ndarray], Any], size: float = 1.0) -> Any:
    def text(run: Drive, distance: np.ndarray) -> str:
        cells = zip(stamps(run.time), size * run.speed, distance, strict=True)
        return "\n".join(["t,v,s", *(f"{t},{v:.2f},{s:.1f}" for t, v, s in cells)]) + "\n"

    return text


def _milliseconds(clock: np.ndarray) -> list[str]:
    return [t[:-3] for t in pd.DatetimeIndex(clock).strftime("%Y-%m-%dT%H:%M:%S.%f")]


def table_profile(time: dict[str, Any], speed: str = "m/s", **file: Any) -> dict[str, Any]:
    columns = PLAIN["columns"] | {"/train/state.speed": {"column": "v", "unit": speed}}
    return {**PLAIN, "file": file, "time": {"column": "t"} | time, "columns": columns}


ELAPSED = {"format": "elapsed", "unit": "ms", "start": "2024-05-01T06:00:00Z"}
LAYOUTS = (
    Layout("mtk.csv", 10.0, lambda run, _: "\n".join([MTK_HEADER, *mtk_rows(run), ""])),
    Layout("ublox.csv", 5.0, lambda run, _: ublox_text(run)),
    Layout("log.nmea", 5.0, lambda run, _: "\r\n".join([*nmea_lines(run, ("RMC", "GGA")), ""])),
    Layout("log.gpx", 1.0, lambda run, _: gpx_text(run)),
    Layout("whole.csv", 5.0, _state(stamps), table_profile({})),
    Layout("fine.csv", 10.0, _state(_milliseconds), table_profile({})),
    Layout(
        "elapsed.csv", 2.0, _state(lambda t: np.round((t - START) / 1e6).astype(int), 3.6),
        table_profile(ELAPSED, "km/h"),
    ),
    Layout(
        "table.parquet", 10.0,
        lambda run, way: pd.DataFrame(
            {"t": pd.DatetimeIndex(run.time, tz="UTC"), "v": run.speed, "s": way}
        ).to_parquet(),
        table_profile({}, format="parquet"),
    ),
)  # fmt: skip

STEPS = {"back": -2, "forward": 3, "mixed": -2, "back 7.4": -7.4, "forward 2.6": 2.6,
         "forward 30": 30}  # fmt: skip
"""By how many seconds the clock is set; where it is mixed, both are written for 20 s."""


@dataclass(frozen=True)
class Case:
    """A recording whose clock was set."""

    path: Path
    profile: Profile | None
    truth: np.ndarray
    """When each row was recorded [ns], by the clock of most rows, in that order."""
    period: float


def recorded(
    folder: Path, line: str, layout: Layout, step: str | None, *, count: float, lost: int = 0
) -> Case:
    """Of `count` seconds, halfway `lost` not recorded; the clock was set after a third of it."""
    rows = int(count * layout.rate)
    run = drive(line, layout.rate, rows)
    middle = np.arange(rows) - rows // 2
    run = run.take(np.flatnonzero((middle < 0) | (middle >= lost * layout.rate)))
    clock = run.time.copy()
    if step is not None:
        # Neither at a whole second, nor at the end of a block.
        at = int(0.37 * rows) + (2 if layout.rate > 2.0 else 0)
        new = np.arange(rows) >= at
        if step.startswith("mixed"):
            late = np.arange(rows) < at + 20 * layout.rate
            new &= ~late | (np.arange(rows) % 2 == 0)
        # The clock after the step is right.
        clock[~new] -= round(STEPS[step] * SECOND)
    path = folder / layout.name
    layout.write(path, replace(run, time=clock), distance(line, run))
    profile = None if layout.profile is None else profile_of(layout.profile)
    return Case(path, profile, run.time, 1.0 / layout.rate)


def error_of(trip: Trip, case: Case) -> float:
    """Largest error of the times [s] of 99 % of the rows; infinite if rows are missing."""
    frame = trip["/gnss/motion" if "/gnss/motion" in trip else "/train/state"]
    time = frame.index.as_unit("ns").asi8
    if abs(time.size - case.truth.size) > 0.005 * case.truth.size:
        return np.inf
    shortest = min(time.size, case.truth.size)
    return float(np.quantile(np.abs(time[:shortest] - case.truth[:shortest]) / SECOND, 0.99))


FILE = Path("run.csv")

INSTANT = pd.Timestamp("2024-05-01T06:07:08.25Z").value


def read(*columns: list[object], decimal: str = ".", **options: object) -> list[int]:
    names = [str(number) for number in range(len(columns))]
    table = pa.table(dict(zip(names, columns, strict=True)))
    where = {"column": "0"} if len(columns) == 1 else {"columns": tuple(names)}
    with in_file(FILE):
        return read_time(table, from_content(TimeOptions, where | options), decimal).tolist()


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
        ([[datetime.datetime(2024, 5, 1, 8, 7, 8, 250_000)]], {"timezone": "Europe/Zurich"}),
    ],
)
def test_every_way_of_writing_an_instant(columns, options):
    assert read(*columns, **options) == [INSTANT]


@settings(max_examples=40)
@given(st.integers(pd.Timestamp("1981-01-01").value, pd.Timestamp("2099-01-01").value))
def test_nanoseconds_survive_text_and_counts(instant):
    text = pd.Timestamp(instant).isoformat(timespec="nanoseconds")
    assert read([text + "Z"]) == [instant]
    assert read([text], format="%Y-%m-%dT%H:%M:%S.%f") == [instant]
    assert read([str(instant)], format="epoch", unit="ns") == [instant]
    assert read([instant], format="epoch", unit="ns") == [instant]


@settings(max_examples=40)
@given(st.integers(0, 2_000_000_000_000))
def test_seconds_as_decimals_are_exact_to_the_millisecond(milliseconds):
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
def test_what_is_no_time_is_absent(columns, options):
    assert read(*columns, **options) == [NO_TIME, INSTANT]


def test_midnight_is_noticed():
    times = ["23:59:58", "23:59:59", "00:00:00", "00:00:01", "23:59:59", "00:00:00"]
    found = read([*times], format="%H:%M:%S", date=datetime.date(2024, 5, 1))
    start = pd.Timestamp("2024-05-01T23:59:58Z").value
    assert [(t - start) // 10**9 for t in found] == [0, 1, 2, 3, 86_401, 86_402]


@pytest.mark.parametrize("local", ["2024-10-27 02:30:00", "2024-03-31 02:30:00"])
def test_hours_that_come_twice_or_never_are_refused(local):
    with pytest.raises(InputError, match=r"run\.csv: local time 2024.*Europe/Zurich.*\+01:00"):
        read([local], timezone="Europe/Zurich")
    assert read([local], timezone="+01:00")


def test_one_step_back_shows_when_the_clocks_change_in_autumn():
    local = ["01:59:00", "02:10:00", "02:59:59", "02:00:00", "02:05:00", "02:40:00", "03:01:00"]
    found = read([f"2024-10-27 {each}" for each in local], timezone="Europe/Zurich")
    start = pd.Timestamp("2024-10-26T23:59:00Z").value
    assert [(t - start) // 10**9 for t in found] == [0, 660, 3659, 3660, 3960, 6060, 7320]


@pytest.mark.parametrize(
    ("column", "options"),
    [
        ("1714543628250", {"format": "epoch"}),
        ("1714543628250", {"format": "epoch", "unit": "us"}),
        ("1714543628", {"format": "epoch", "unit": "ms"}),
        ("1899-05-01 06:00:00", {}),
    ],
)
def test_a_wrong_unit_of_time_leaves_no_time(column, options):
    """Refused here with the instant it reads as, or later because no row has a time."""
    try:
        found = read([column, column], **options)
    except InputError as error:
        found = [str(error)]
    message = str(found[0])
    assert set(found) == {NO_TIME} or ("time reads as 1" in message and "unit" in message)


LINE_NAMES = list(LINES)
CASES = [
    pytest.param(LINE_NAMES[(number + place) % 3], layout, step, id=f"{layout.name}-{step}")
    for number, layout in enumerate(LAYOUTS)
    for place, step in enumerate(("back", "forward", "mixed"))
    if (number + place) % 3 == 0
]
"""Every layout with one of a step back, a step forward and mixed clocks, the lines in turn."""


def assert_step_found(folder: Path, line: str, layout: Layout, step: str) -> None:
    """Every time is that of the clock once set, to less than two rows; the report says so."""
    case = recorded(folder, line, layout, step, count=240.0)
    trip = ingest(case.path, profile=case.profile)
    report = report_of(trip)
    assert report.count("clock_step") > 0
    assert report.count("clock_step_suspected") == report.count("gaps") == 0
    assert error_of(trip, case) <= max(0.15, 0.5 * case.period)
    assert report.rows_dropped == 0


@pytest.mark.parametrize(("line", "layout", "step"), CASES)
def test_a_clock_that_was_set_is_found(tmp_path, line, layout, step):
    assert_step_found(tmp_path, line, layout, step)


@pytest.mark.parametrize("step", ["back 7.4", "forward 2.6", "forward 30"])
def test_any_seconds_may_be_set_and_a_cut_agrees(tmp_path, step):
    """Sizes that no receiver learns; three cuts of the rows give the times of the whole."""
    layout = LAYOUTS[5]
    assert_step_found(tmp_path, "StGallen-Wil", layout, step)
    case = recorded(tmp_path, "StGallen-Wil", layout, step, count=240.0)
    head, *rows = case.path.read_text().splitlines()
    for low, high in ((0, 1500), (500, 2400), (300, 1300)):
        case.path.write_text("\n".join([head, *rows[low:high]]) + "\n")
        part = ingest(case.path, profile=case.profile)["/train/state"].index.as_unit("ns").asi8
        assert np.abs(part - case.truth[low:high]).max() < 0.15 * 1e9


def without_step(tmp_path: Path, run: Drive, shown: np.ndarray) -> np.ndarray:
    """Times of the fixes of a GPX file in which no step of the clock is found."""
    trip = ingest(put(tmp_path / "log.gpx", gpx_text(replace(run, time=shown))))
    assert not {"clock_step", "clock_step_suspected"} & set(report_of(trip).counts)
    return trip["/gnss/fix"].index.as_unit("ns").asi8


@pytest.mark.parametrize("behind", [1.0, 2.0, 3.0])
def test_a_receiver_that_begins_late_after_a_gap_sets_no_clock(tmp_path, behind):
    """Its first fixes lag by as much as the gap is long, and catch up in 12 s."""
    run, second = drive("StGallen-Wil", 1.0, 600), np.arange(600)
    since = second - 300 - int(behind)
    lag = np.where(since >= 0, behind * np.clip(1.0 - since / 12.0, 0.0, 1.0), 0.0)
    late = {
        name: np.interp(second - lag, second, getattr(run, name))
        for name in ("latitude", "longitude")
    }
    kept = replace(run, **late).take(np.flatnonzero((second < 300) | (since >= 0)))
    assert np.array_equal(without_step(tmp_path, kept, kept.time), kept.time)


@pytest.mark.parametrize("interval", [0.97, 0.99, 1.02])
def test_fixes_that_are_rounded_to_whole_seconds_set_no_clock(tmp_path, interval):
    """A phone that measures not quite once a second gives a second twice, or leaves one out."""
    run = drive("StGallen-Wil", 1.0 / interval, 500)
    shown = run.time - run.time % SECOND
    assert np.isin(without_step(tmp_path, run, shown), shown).all()


@pytest.mark.parametrize(("pace", "held"), [(0.0, 15.0), (0.2, 6.0), (0.4, 6.0), (0.4, 15.0)])
def test_a_receiver_that_holds_its_place_before_a_gap_sets_no_clock(tmp_path, pace, held):
    """Under a roof it goes on too slowly, as phones do on real rides before many gaps."""
    run, second = drive("StGallen-Wil", 1.0, 600), np.arange(600.0)
    assert np.all(run.speed[280:310] > 10.0)
    behind = np.where((second > 300.0 - held) & (second <= 300.0), second - 300.0 + held, 0.0)
    at = second - (1.0 - pace) * behind
    old = {
        name: np.round(np.interp(at, second, getattr(run, name)), 7)
        for name in ("latitude", "longitude", "speed")
    }
    old["speed"] = np.where(behind > 0.0, pace * old["speed"], old["speed"])
    kept = replace(run, **old).take(np.flatnonzero((second <= 300.0) | (second > 308.0)))
    assert np.array_equal(without_step(tmp_path, kept, kept.time), kept.time)


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_clocks_that_were_not_set_are_left_alone(tmp_path, layout):
    """With and without gaps of 1 to 18 whole seconds, in which the train moves on."""
    for lost in ((0, 3), (1, 17))[LAYOUTS.index(layout) % 2]:
        case = recorded(tmp_path, "hilly", layout, None, count=240.0, lost=lost)
        trip = ingest(case.path, profile=case.profile)
        report = report_of(trip)
        assert report.count("clock_step") == report.count("clock_step_suspected") == 0
        assert error_of(trip, case) <= max(0.15, 0.5 * case.period)


def test_a_gap_at_a_standstill_is_a_gap(tmp_path):
    """Clocks are set far more rarely than rows are lost: where no motion shows it, it is a gap."""
    rows = [f"2024-05-01T06:00:{0.1 * i:06.3f}Z,0.00,3.0" for i in range(500)]
    path = put(tmp_path / "run.csv", ["t,v,s", *(rows[:200] + rows[250:])])
    trip = ingest(path, profile=profile_of(table_profile({})))
    report = report_of(trip)
    assert report.counts == {"gaps": 1}
    assert len(trip["/train/state"]) == 450


@pytest.mark.parametrize(
    ("date", "rows"), [("2000,0,0", 7), ("1980,1,6", 300), ("2000,1,1", 900), ("2080,1,6", 300)]
)
def test_rows_without_a_date_get_that_of_the_rows_they_lead_to(tmp_path, date, rows):
    """In an MTK log of whole seconds whose first rows have another date, but fixes."""
    case = recorded(tmp_path, "hilly", LAYOUTS[0], None, count=120.0)
    head, *lines = case.path.read_text().splitlines()
    lines[:rows] = [each.replace("2024,5,1,", f"{date},", 1) for each in lines[:rows]]
    case.path.write_text("\n".join([head, *lines]) + "\n")
    trip = ingest(case.path)
    assert report_of(trip).counts["clock_step"] == rows
    assert report_of(trip).rows_dropped == 0
    assert error_of(trip, case) < 0.15


def test_a_date_that_changes_while_the_time_of_day_goes_on(tmp_path):
    """Two thirds of the rows decide; where the dates are as many, the file is refused."""
    times = pd.date_range("2024-05-01T06:00:00Z", periods=600, freq="s")
    for changed, right in ((150, True), (300, False)):
        rows = [
            f"{t + pd.Timedelta(days=3 if i < changed else 0):%Y-%m-%dT%H:%M:%SZ},15.0,{15 * i}"
            for i, t in enumerate(times)
        ]
        path = put(tmp_path / f"{changed}.csv", ["t,v,s", *rows])
        if right:
            trip = ingest(path, profile=profile_of(table_profile({})))
            assert report_of(trip).counts["clock_step"] == changed
            assert trip["/train/state"].index.equals(times.as_unit("ns"))
        else:
            with pytest.raises(InputError, match="the clock jumps: 300 of 600 rows"):
                ingest(path, profile=profile_of(table_profile({})))


@pytest.mark.parametrize("layout", [LAYOUTS[0], LAYOUTS[1]], ids=["mtk", "ublox"])
def test_a_week_count_that_rolled_over_in_the_whole_file(tmp_path, layout):
    """2024-05-01 reads as 2004-09-15; no u-blox or MTK logger is that old."""
    case = recorded(tmp_path, "hilly", layout, None, count=60.0)
    case.path.write_text(case.path.read_text().replace("2024,5,1,", "2004,9,15,"))
    trip = ingest(case.path)
    report = report_of(trip)
    assert report.count("clock_step") == len(case.truth)
    note = "moved by +1024 weeks; clock_step = false under [repair] of the profile keeps the times"
    assert any(line.endswith(note) for line in report.lines())
    assert error_of(trip, case) < 0.15


def test_old_dates_of_a_receiver_are_suspected(tmp_path):
    case = recorded(tmp_path, "hilly", LAYOUTS[3], None, count=60.0)
    case.path.write_text(case.path.read_text().replace("2024-05-01", "2004-09-15"))
    report = report_of(ingest(case.path))
    assert report.counts == {"clock_step_suspected": 1}
    assert any("all dates are of 2004: 1024 weeks too early?" in line for line in report.lines())
    stated = profile_of({**HEAD, "limits": {"not_before": datetime.date(2012, 1, 1)}})
    trip = ingest(case.path, profile=stated)
    assert trip.start == pd.Timestamp(case.truth[0], tz="UTC")


DEFECTS = ("lost rows", "gaps", "swaps", "late block", "repeated block", "frozen fix")


def disturbed(run: Drive, rate: float, seed: int) -> Drive:
    """A drive as a bad logger keeps it: each defect with a chance of one half."""
    rng = np.random.default_rng(seed)
    rows = len(run)
    on = dict(zip(DEFECTS, rng.random(len(DEFECTS)) < 0.5, strict=True))
    keep = np.ones(rows, dtype=bool)
    keep[rng.integers(10, rows - 10, 20 * on["lost rows"])] = False
    for begin in rng.integers(10, rows - 10, 2 * on["gaps"]):
        keep[begin : begin + int(rng.integers(1, 19) * rate)] = False
    order = np.flatnonzero(keep)
    for place in rng.integers(1, order.size - 2, 8 * on["swaps"]):
        order[[place, place + 1]] = order[[place + 1, place]]
    half, block = order.size // 2, int(rng.integers(2, 15) * rate) + 1
    if on["late block"]:
        a, b, c = (half + n * block for n in range(3))
        order = np.concatenate((order[:a], order[b:c], order[a:b], order[c:]))
    if on["repeated block"]:
        order = np.concatenate((order[: half // 2 + block], order[half // 2 :]))
    if on["frozen fix"]:
        held = np.arange(rows)
        held[rows // 3 : rows // 3 + int(15 * rate)] = rows // 3
        run = replace(run, latitude=run.latitude[held], longitude=run.longitude[held])
    return run.take(order)


@pytest.mark.parametrize("layout", LAYOUTS[3:7], ids=lambda layout: layout.name)
@pytest.mark.parametrize("seed", range(5))
def test_other_defects_are_no_steps_of_the_clock(tmp_path, layout, seed):
    run = disturbed(drive("hilly", layout.rate, int(200 * layout.rate)), layout.rate, seed)
    path = tmp_path / layout.name
    layout.write(path, run, distance("hilly", run))
    profile = None if layout.profile is None else profile_of(layout.profile)
    assert "clock_step" not in report_of(ingest(path, profile=profile)).counts


def test_rows_of_another_column_are_no_samples_of_their_own():
    """Each second holds a value written twice, and a row of another column."""
    second, place = np.repeat(np.arange(20), 3), np.arange(60) % 3
    one, other = np.where(place < 2, second, np.nan), np.where(place == 2, -second, np.nan)
    table = Table(second * NANOSECONDS, np.arange(60), {"one": one, "other": other})
    assert rows_per_second(table) == 1


def test_two_seconds_in_which_something_moves_show_no_rate():
    second, values = np.repeat(np.arange(8), 2), np.zeros(16)
    values[5], values[6], values[7:] = 1.0, 0.5, 2.0
    table = Table(second * NANOSECONDS, np.arange(16), {"one": values})
    assert rows_per_second(table) == 1
