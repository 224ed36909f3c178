"""What `trainlog show` states of any file, and the settings of a user."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from contents import put
from refusals import refused

import trainlog
from analysis.contents import contents_of
from analysis.resistance.logs import fit
from trainlog import InputError, TrainlogError, sample
from trainlog.cli.main import run
from trainlog.formats.settings import MEANINGS, Settings, read_settings, set_setting
from trainlog.formats.summaries import write_summaries
from trainlog.mcap.convert import convert

pytestmark = pytest.mark.usefixtures("remembered")

KINDS = {
    "nonstop.mcap": "log",
    "CH_StGallen_Wil.line.json": "line",
    "CH_Stadler_FLIRT_TPF.train.json": "train",
    "freight_24_wagons.consist.json": "consist",
    "CH_StGallen_Wil.map": "track-condition map",
    "recorder.profile.toml": "profile",
    "gnss.csv": "recording (ublox)",
    "recorder.csv": "table of a recorder",
}


def test_a_file_is_known_by_its_content(tmp_path):
    renamed = tmp_path / "file"
    for name, kind in KINDS.items():
        renamed.write_bytes(sample(name).read_bytes())
        found = contents_of(renamed)
        assert found.kind == kind
        assert found.summary
        assert len(found.text.splitlines()) < 25
    for suffix in ("parquet", "csv"):
        folder = tmp_path / f"trip.{suffix}"
        convert("sample_logs/nonstop.mcap", folder, topics=["/gnss/fix"])
        found = contents_of(folder)
        assert found.kind.lower() == f"trip as {suffix}"
        assert isinstance(found.value, trainlog.Trip)


@pytest.mark.parametrize("above", ["", "Fahrtenschreiber;Tfz 511 006\r\n"])
@pytest.mark.parametrize("encoding", ["cp1252", "utf-8", "utf-8-sig", "utf-16"])
def test_a_table_of_a_recorder_is_shown_as_ingest_reads_it(above, encoding, tmp_path):
    rows = [f"08:00:{second:02d};{second},5;7,{second}" for second in range(50)]
    path = tmp_path / "fahrt.csv"
    text = above + "\r\n".join(["Uhrzeit;Länge [°];v [km/h]", *rows])
    path.write_bytes(text.encode(encoding))
    found = contents_of(path)
    assert found.kind == "table of a recorder"
    assert found.lines[0] == "50 rows of 3 columns: Uhrzeit, Länge [°], v [km/h]"
    assert f"make a trip of it with: trainlog ingest {path}" in found.lines[1]


WRONG = {
    "empty": (b"", "is empty"),
    "prose": (b"Dear all,\nit was late.\n", "is text of no format that trainlog knows; give"),
    "cut": (b'{"format": "trainlog/line", "version": 1, "na', "ends in the middle: truncated?"),
    "unknown": (b"\x00\x01\x02\x03" * 50, "is of no format that trainlog knows; it begins with"),
    "replay": (b"RRF2" + bytes(100), "is a recording of the Rerun viewer; show what"),
    "report": (b"<!DOCTYPE html>\n<html>", "is a web page, such as a report; open it in a browser"),
    "newer": (b'{"format": "trainlog/line", "version": 99}', "newer than this trainlog"),
}


SHARED = Path(__file__).parents[2] / "shared" / "data"

OTHERS = {
    "osrd/rolling_stocks/**/*.json": "rolling stock of OSRD (JSON)",
    "osrd/infras/**/*.json": "infrastructure of OSRD (JSON)",
    "ttobench/tracks/*.json": "track of TTOBench (JSON)",
    "ttobench/trains/*.json": "train of TTOBench (JSON)",
    "ttobench/journeys/*.json": "journey of TTOBench (JSON)",
    "railtoolkit_schema/test/**/*.yaml": "file of railtoolkit (YAML)",
}


@pytest.mark.parametrize("pattern", OTHERS)
def test_a_file_of_another_project_is_named_with_the_command_that_takes_it(pattern):
    if not SHARED.is_dir():
        pytest.skip("public data are not here")
    for path in sorted(SHARED.glob(pattern))[:3]:
        found = contents_of(path)
        assert found.kind == OTHERS[pattern]
        assert f"trainlog import {path} -o" in found.text


def test_summaries_of_a_fit_are_named_with_the_command_that_takes_them(tmp_path):
    path = tmp_path / "fit.parquet"
    write_summaries(fit(sample("nonstop.mcap")).summaries, path)
    found = contents_of(path)
    assert found.kind == "summaries of a fit"
    assert found.summary == "1 trip of CH_Stadler_FLIRT_TPF, 0 refused"
    assert f"trainlog fit efforts {path} LOGS" in found.text


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_shown_is_stated_with_a_remedy(case, tmp_path):
    content, problem = WRONG[case]
    path = put(tmp_path / "file", content)
    caught = refused(TrainlogError, problem, contents_of, path)
    assert caught.file == path
    assert caught.remedy


def test_the_samples_are_shown_and_what_opens_a_recording_of_the_viewer_is_named(
    tmp_path, shell, works
):
    assert "nonstop.mcap" in works("show", "sample")
    (tmp_path / "x.rrd").write_bytes(b"RRF2" + bytes(100))
    for name in ("show", "replay"):
        status, _, complaint = shell(name, tmp_path / "x.rrd")
        assert (status, "'rerun FILE' opens" in complaint) == (2, True)


@pytest.mark.parametrize("share", [0.0, 0.95])
def test_a_damaged_log_is_shown_and_ends_with_1(share, tmp_path, shell):
    """By itself, as data, in a folder, and beside what is whole: as `check` ends."""
    whole = sample("nonstop.mcap")
    content = whole.read_bytes()
    (tmp_path / "logs").mkdir()
    cut = put(tmp_path / "logs" / "cut.mcap", content[: int(share * len(content))])
    readable = share > 0.0
    alone, shown, complaint = shell("show", cut)
    assert alone == shell("show", "--check", cut)[0] == (1 if readable else 2)
    assert ("/train/state" in shown) == readable
    assert readable or "is empty" in complaint
    assert shell("show", tmp_path / "logs")[0] == 1
    for words in ([cut, whole], [whole, cut]):
        status, shown, complaint = shell("show", *words, "--json")
        document = json.loads(shown)
        assert status == document["status"] == 1
        states = {each["file"]: each["whole"] for each in document["logs"]}
        assert states == {str(whole): True} | ({str(cut): False} if readable else {})
        assert complaint.count(str(cut)) == (0 if readable else 1)
    assert shell("show", whole, whole)[0] == 0
    for words in (cut, tmp_path / "logs"):
        status, shown, complaint = shell("show", words, "-q")
        expected = 2 if words == cut and not readable else 1
        assert (status, shown, complaint.count("\n")) == (expected, "", 1)
        assert str(cut) in complaint


@pytest.mark.parametrize("name", ["nonstop.mcap", "CH_StGallen_Wil.line.json"])
def test_trips_and_lines_have_a_picture(name, tmp_path):
    picture = tmp_path / "out.png"
    assert run(["show", str(sample(name)), "--picture", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    words = ["show", str(sample("CH_Stadler_FLIRT_TPF.train.json")), "--picture", str(picture)]
    refused(TrainlogError, "no picture of a train", run, words)


def test_what_ingest_repaired_is_listed_with_its_raw_values(tmp_path, shell):
    recorded = tmp_path / "run.csv"
    cells = ["10.0", "error", "10.1", "500", "10.3", "10.4", "10.5"]
    rows = [f"2024-05-01T06:00:{second:02d}Z,{cell}" for second, cell in enumerate(cells)]
    recorded.write_text("\n".join(["t,v", *rows, rows[-1], ""]), "utf-8")
    profile = tmp_path / "run.profile.toml"
    profile.write_text(
        """format = "trainlog/recorder-profile"
version = 1
name = "recorder"
[time]
column = "t"
[columns]
"/train/state.speed" = { column = "v", unit = "m/s" }
""",
        "utf-8",
    )
    shell("ingest", recorded, "--profile", profile, "-o", tmp_path)
    _, shown, _ = shell("show", tmp_path / "run.mcap", "--all")
    lines = [line.split() for line in shown.splitlines()]
    assert "8 rows read, 7 kept, 1 dropped" in shown
    speed = "/train/state.speed"
    assert ["3", "06:00:01.000", "not_a_number", speed, "error", "absent"] in lines
    assert ["5", "06:00:03.000", "out_of_limits", speed, "500", "absent"] in lines
    assert ["9", "06:00:06.000", "duplicates", "dropped"] in lines
    assert "out_of_limits   /train" not in shell("show", tmp_path / "run.mcap")[1]
    _, shown, _ = shell("show", tmp_path / "run.mcap", "--all", "--json")
    (wild,) = [r for r in json.loads(shown)["repairs"] if r["rule"] == "out_of_limits"]
    assert (wild["raw_value"], wild["new_value"]) == (500.0, None)
    assert wild["raw_time"] == "2024-05-01T06:00:03.000000Z"


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TRAINLOG_SETTINGS", str(tmp_path / "settings.toml"))
    return tmp_path / "settings.toml"


def test_settings_are_set_shown_and_taken_back(settings, shell, works):
    settings.write_text("# mine\nresults = 'out'\n")
    assert shell("settings", "speed", "mph") == (0, f"wrote {settings}\n", "")
    assert read_settings() == Settings(speed="mph", results="out")
    assert settings.read_text().startswith("# mine\n")
    shown = works("settings")
    assert all(key in shown for key in MEANINGS)
    assert "mph" in shown
    shell("settings", "--unset", "speed")
    assert read_settings() == Settings(results="out")
    page = (Path(__file__).parents[1] / "docs" / "command-line.md").read_text("utf-8")
    assert all(f"| `{key}` |" in page and meaning in page for key, meaning in MEANINGS.items())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('zone = "UTC"\nsped = "mph"', "line 2: 'sped' is not a setting; did you mean 'speed'?"),
        ('speed = "knots"', "line 1: speed 'knots' is not a unit of speed; choose one of km/h"),
        ('\n\nzone = "Mars"', "line 3: zone 'Mars' is not known; name one as Europe/Zurich"),
        ("speed = 3", "line 1: speed must be text, not 3; write it as speed ="),
        ("[speed]\nunit = 'mph'", "line 1: speed must be text"),
        ('line = "no.line.json"', "line 1: 'no.line.json' does not exist; name a file"),
        ("speed = ", "is not TOML: "),
    ],
)
def test_what_is_wrong_is_one_error_with_file_line_and_remedy(text, message, settings, shell):
    settings.write_text(text)
    status, _, complaint = shell("show", "--check", sample("nonstop.mcap"))
    assert (status, complaint.count("\n")) == (2, 1)
    assert complaint.startswith(f"trainlog: {settings}")
    assert message in complaint


def test_a_bad_value_is_refused_and_the_file_stays(settings):
    set_setting("zone", "Europe/Zurich")
    before = settings.read_bytes()
    for key, value in (("zone", "Mars"), ("colour", "red"), ("train", "no.json")):
        refused(InputError, "", set_setting, key, value)
    assert settings.read_bytes() == before


def test_units_and_zone_change_what_is_shown_and_no_file(settings, tmp_path, shell):
    log, made = sample("nonstop.mcap"), tmp_path / "made.json"
    shown, files, printed = [], [], []
    for unit, zone in (("km/h", "UTC"), ("mph", "Europe/Zurich")):
        set_setting("speed", unit)
        set_setting("zone", zone)
        _, out, _ = shell("fit", "coasting", log, "-o", made)
        shown.append(out)
        files.append([made.read_bytes(), made.with_suffix(".png").read_bytes()])
        _, out, _ = shell("show", "--check", log, "--json")
        printed.append(out)
    assert files[0] == files[1]
    assert printed[0] == printed[1]
    assert "speed, km/h" in shown[0]
    assert "speed, mph" in shown[1]
    assert "km/h" not in shown[1]
    for zone, shown_as in (("Europe/Zurich", "CEST"), ("+02:00", "UTC+02:00")):
        set_setting("zone", zone)
        _, out, _ = shell("show", log)
        assert f"2024-10-07 08:00:00.000 to 2024-10-07 08:19:43.100 {shown_as}" in out
