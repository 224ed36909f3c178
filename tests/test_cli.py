"""The command line: what a person meets, with good and with bad input."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command import Shell

import analysis
from trainlog.cli import demo, terminal
from trainlog.errors import InputError
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.ingest.batch import no_recording
from trainlog.presentation import new_table

pytestmark = pytest.mark.usefixtures("remembered", "unpainted")


@pytest.fixture
def broken(tmp_path: Path) -> dict[str, Path]:
    """Files that no command can use."""
    log = sample("nonstop.mcap").read_bytes()
    files = {
        "missing": tmp_path / "missing.mcap",
        "empty": tmp_path / "empty.mcap",
        "truncated": tmp_path / "truncated.mcap",
        "foreign": tmp_path / "foreign.mcap",
        "nonsensical": tmp_path / "nonsensical.mcap",
        "folder": tmp_path / "folder",
    }
    files["empty"].write_bytes(b"")
    # Before the end of its first chunk.
    files["truncated"].write_bytes(log[:10_000])
    files["foreign"].write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 8)
    files["nonsensical"].write_text('{"format": "trainlog/line", "length": -1}')
    files["folder"].mkdir()
    return files


LINE, TRAIN = ["--line", "sample"], ["--train", "sample"]
BOTH = [*LINE, *TRAIN]

COMMANDS: dict[str, list[str]] = {
    "fit": ["fit", "BAD", "-o", "OUT.json"],
    "fit --per-trip": ["fit", "BAD", "-o", "OUT.json", "--per-trip", "OUT"],
    "estimate": ["estimate", "BAD", "-o", "OUT"],
    "map update": ["map", "update", "BAD", "--map", "OUT.map"],
    "map diff": ["map", "diff", "BAD", "--from", "2026-01-01", "--picture", "OUT.png"],
    "map history": ["map", "show", "BAD", "--km", "1", "--picture", "OUT.png"],
    "map export": ["map", "export", "BAD", "-o", "OUT.csv"],
    "map show": ["map", "show", "BAD", "--picture", "OUT.png"],
    "replay": ["replay", "BAD", "-o", "OUT.rrd"],
    "compare groups": ["compare", "groups", "BAD", "--with", "BAD"],
    "ingest": ["ingest", "BAD", "-o", "OUT"],
    "import": ["import", "BAD", "-o", "OUT"],
    "optimise": ["plan", "BAD", *BOTH, "-o", "OUT.json"],
    "simulate --line": ["simulate", "drive", *TRAIN, "--line", "BAD", "-o", "OUT"],
    "simulate --train": ["simulate", "drive", *LINE, "--train", "BAD", "-o", "OUT"],
    "simulate --characteristic": [
        "simulate",
        "drive",
        *BOTH,
        "--characteristic",
        "BAD",
        "-o",
        "OUT",
    ],
    "adhesion fit": ["fit", "adhesion", "BAD", "-o", "OUT.json"],
    "simulate --trajectory": ["simulate", "follow", "BAD", *BOTH, "-o", "OUT"],
    "report": ["report", "BAD"],
    "report -o": ["report", "BAD", "-o", "OUT.html"],
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    "kind", ["missing", "empty", "truncated", "foreign", "nonsensical", "folder"]
)
def test_bad_files_are_refused_in_one_line(
    command: str, kind: str, broken: dict[str, Path], tmp_path: Path, shell: Shell
) -> None:
    bad = broken[kind]
    output = tmp_path / "output"
    words = [
        word.replace("BAD", str(bad)).replace("OUT", str(output)) for word in COMMANDS[command]
    ]
    status, _, complaint = shell(*words)
    assert status == 2
    assert complaint.count("\n") == 1
    assert complaint.startswith("trainlog: ")
    assert bad.name in complaint
    assert "Traceback" not in complaint
    assert [path for path in tmp_path.rglob("*") if path not in broken.values()] == []


@pytest.mark.parametrize("kind", ["missing", "empty", "foreign", "nonsensical"])
def test_info_refuses_what_is_no_log(kind: str, broken: dict[str, Path], shell: Shell) -> None:
    status, _, complaint = shell("show", broken[kind])
    assert (status, complaint.count("\n")) == (2, 1)
    assert broken[kind].name in complaint


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """A log of which a third is left."""
    log = sample("nonstop.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(log[: len(log) // 3])
    return tmp_path / "cut.mcap"


def test_info_tells_what_is_left_of_a_cut_log(cut: Path, shell: Shell) -> None:
    status, shown, _ = shell("show", cut)
    assert status == 1  # as `check`: something was found
    assert "/train/state" in shown
    assert "does not end properly" in shown or "byte" in shown


def test_what_is_left_of_a_cut_log_is_used_with_a_warning(
    cut: Path, tmp_path: Path, shell: Shell
) -> None:
    status, _, complaint = shell("replay", cut, "-o", tmp_path / "cut.rrd")
    assert status == 0
    for line in complaint.splitlines():
        assert line.startswith(f"trainlog: warning: {cut}: is damaged: ")
        assert "messages are readable" in line
        assert "bytes are lost" in line
        assert "trainlog convert" in line
    assert complaint


@pytest.mark.parametrize(
    "words",
    [
        ["fit", "x"],
        ["nonsense"],
        ["simulate", "drive", "-o", "x", "--traction", "none"],
    ],
)
def test_wrong_words_are_explained_in_one_line(words: list[str], shell: Shell) -> None:
    status, _, complaint = shell(*words)
    assert (status, complaint.count("\n")) == (2, 1)
    assert "--help" in complaint


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("simulate drive -o x --count zero", "--count 'zero' is not a valid whole number"),
        ("simulate drive -o x --count 0", "--count '0' must be at least 1; write it as"),
        ("simulate drive -o x --seed -1", "--seed '-1' must be at least 0; write it as"),
        ("simulate follow LOG -o x --late -5", "--late '-5' must be at least 0 s; write it as 90"),
        (
            "plan --line sample --train sample -o x.json --running-time 0",
            "--running-time '0' must be above 0 s; write it as 90",
        ),
        ("plan -o x.json --reserve -5", "--reserve '-5' must be at least 0 %; write it as 7"),
        *(
            (
                f"fit LOG -o x.json --cover {given}",
                f"--cover '{given}' must be between 50 % and 99.99 %",
            )
            for given in ("0.95", "7", "700")
        ),
    ],
)
def test_a_value_that_cannot_be_is_refused_with_what_can(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    monkeypatch.chdir(tmp_path)
    given = words.replace("LOG", str(sample("nonstop.mcap"))).split()
    status, shown, complaint = shell(*given)
    assert (status, shown, complaint.count("\n")) == (2, "", 1)
    assert message in complaint
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([], "no line and no train are given; give --line FILE --train FILE; for a trial"),
        (LINE, "no train is given; give --train FILE; for a trial --train sample; 'trainlog"),
        (TRAIN, "no line is given; give --line FILE; for a trial --line sample; 'trainlog"),
    ],
    ids=["none", "line", "train"],
)
@pytest.mark.parametrize("command", ["simulate drive", "plan"])
def test_a_line_and_a_train_are_asked_for(
    command: str, given: list[str], words: str, tmp_path: Path, shell: Shell
) -> None:
    """The samples are taken by name alone: a plan for the wrong line looks like one for yours."""
    output = tmp_path / ("plan.json" if command == "plan" else "trips")
    status, shown, complaint = shell(*command.split(), *given, "-o", output)
    assert (status, shown, complaint.count("\n")) == (2, "", 1)
    assert words in complaint
    assert not list(tmp_path.iterdir())


def test_a_file_called_sample_is_that_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert read_line("sample").name == "CH_StGallen_Wil"
    assert read_train("sample").name == "CH_Stadler_FLIRT_TPF"
    monkeypatch.chdir(tmp_path)
    Path("sample").write_text("{}", "utf-8")
    with pytest.raises(InputError):
        read_line("sample")


def test_a_timetable_that_cannot_be_kept_is_explained(tmp_path: Path, shell: Shell) -> None:
    parameters = tmp_path / "parameters.json"
    shell("fit", sample("stopping.mcap"), "-o", parameters)
    status, _, complaint = shell(
        *("plan", parameters, *BOTH), *("--running-time", "600", "-o", tmp_path / "trajectory.json")
    )
    assert (status, complaint.count("\n")) == (2, 1)
    assert "600" in complaint
    assert "at least" in complaint
    assert not (tmp_path / "trajectory.json").exists()


def test_a_log_is_counted_into_a_map_once(tmp_path: Path, shell: Shell) -> None:
    track = tmp_path / "wil.map"
    shell("map", "update", sample("stopping.mcap"), "--map", track)
    first = track.read_bytes()
    status, shown, _ = shell("map", "update", sample("stopping.mcap"), "--map", track)
    assert status == 0
    assert shown == "0 trips added, 1 held already; the map holds 1 trip of 1 day\n"
    assert track.read_bytes() == first


def test_ingest_tells_what_it_repaired(tmp_path: Path, shell: Shell) -> None:
    known = ("--line", sample(DEFAULT_LINE), "--train", sample(DEFAULT_TRAIN))
    profile = ("--profile", sample("recorder.profile.toml"))
    status, shown, _ = shell("ingest", sample("recorder.csv"), *profile, *known, "-o", tmp_path)
    assert status == 0
    assert "rows read" in shown
    assert "time_backwards" in shown
    status, shown, _ = shell("show", tmp_path / "recorder.mcap")
    assert "/train/axles" in shown


def test_ingest_of_two_recordings_of_one_name_loses_neither(tmp_path: Path, shell: Shell) -> None:
    data = sample("gnss.csv").read_bytes()
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
    (tmp_path / "monday" / "gnss.csv").write_bytes(data)
    (tmp_path / "tuesday" / "gnss.csv").write_bytes(data[: len(data) // 2])
    files = [tmp_path / day / "gnss.csv" for day in ("monday", "tuesday")]
    status, _, complaint = shell("ingest", *files, "-o", tmp_path / "out")
    assert (status, complaint) == (0, "")
    names = sorted(log.name for log in (tmp_path / "out").iterdir())
    assert names == ["monday_gnss.mcap", "tuesday_gnss.mcap"]


def test_a_recording_is_not_overwritten_by_the_log_that_is_made_of_it(
    tmp_path: Path, shell: Shell
) -> None:
    recording = tmp_path / "gnss.mcap"
    recording.write_bytes(sample("gnss.csv").read_bytes())
    status, _, complaint = shell("ingest", recording, "-o", tmp_path)
    assert status == 2
    assert f"{recording}: would be overwritten" in complaint
    assert recording.read_bytes() == sample("gnss.csv").read_bytes()


@pytest.mark.parametrize("command", ["ingest", "estimate", "import", "simulate drive"])
def test_a_folder_for_results_named_as_a_file_is_refused(
    command: str, tmp_path: Path, shell: Shell
) -> None:
    given = {"simulate drive": BOTH, "ingest": [sample("gnss.csv")]}.get(
        command, [sample("stopping.mcap")]
    )
    output = tmp_path / "trip.mcap"
    status, _, complaint = shell(*command.split(), *given, "-o", output)
    assert (status, complaint.count("\n")) == (2, 1)
    assert f"{output}: is the name of a .mcap file, and a folder is needed; name a" in complaint
    assert not output.exists()


def test_a_format_can_be_named(tmp_path: Path, shell: Shell) -> None:
    words = ("ingest", sample("gnss.csv"), "-o", tmp_path / "out", "--format")
    status, _, complaint = shell(*words, "gnns")
    assert status == 2
    assert "no format 'gnns'" in complaint
    status, _, complaint = shell(*words, "gpx")
    assert status == 2
    assert "gnss.csv" in complaint
    status, _, _ = shell(*words, "ublox")
    assert status == 0


def test_a_damaged_log_is_reported_once_a_command(tmp_path: Path, shell: Shell) -> None:
    log = sample("nonstop.mcap").read_bytes()
    half = tmp_path / "half.mcap"
    half.write_bytes(log[: len(log) // 2])
    for words in (
        ("fit", half, "-o", tmp_path / "fit.json"),
        ("map", "update", half, "--layer", "dry", "--map", tmp_path / "wil.map"),
        ("replay", half, "-o", tmp_path / "half.rrd"),
    ):
        status, _, complaint = shell(*words)
        assert status == 0
        assert complaint.count("trainlog: warning: ") == 1, words
        assert complaint.startswith(f"trainlog: warning: {half}: is damaged: ")


def test_a_folder_without_logs_is_refused_with_a_remedy(tmp_path: Path, shell: Shell) -> None:
    status, _, complaint = shell("fit", tmp_path, "-o", tmp_path / "fit.json")
    assert status == 2
    assert "the folder holds no logs (*.mcap); name another folder, or make logs" in complaint


def test_check_goes_on_behind_a_file_that_is_no_log(tmp_path: Path, shell: Shell) -> None:
    (tmp_path / "a.mcap").touch()
    (tmp_path / "b.mcap").write_bytes(sample("stopping.mcap").read_bytes())
    status, shown, complaint = shell("show", "--check", tmp_path)
    assert status == 1
    assert complaint.count("\n") == 1
    assert "a.mcap, byte 0: is empty" in complaint
    assert "b.mcap: is whole" in shown


def test_recover_refuses_two_logs_of_one_name(tmp_path: Path, shell: Shell) -> None:
    (tmp_path / "copy").mkdir()
    copy = tmp_path / "copy" / "stopping.mcap"
    copy.write_bytes(sample("stopping.mcap").read_bytes())
    out = tmp_path / "out"
    status, _, complaint = shell("convert", sample("stopping.mcap"), copy, "-o", out)
    assert status == 2
    assert f"{copy}: has the same name as" in complaint
    assert not out.exists()


def test_brackets_in_names_and_findings_are_shown(tmp_path: Path, shell: Shell) -> None:
    recording = tmp_path / "run [1].csv"
    recording.write_bytes(sample("gnss.csv").read_bytes())
    profile = ("--profile", sample("recorder.profile.toml"))
    status, shown, _ = shell("ingest", recording, *profile, "-o", tmp_path)
    assert status == 0
    assert "run [1]: " in shown
    assert "not used: [time] of the profile" in shown
    assert "run [1].mcap" in shown


def test_a_recorded_trip_can_be_fitted_and_mapped(tmp_path: Path, shell: Shell) -> None:
    known = ("--line", sample(DEFAULT_LINE), "--train", sample(DEFAULT_TRAIN))
    profile = ("--profile", sample("recorder.profile.toml"), "--set", "load=24000")
    log = tmp_path / "recorder.mcap"
    shell("ingest", sample("recorder.csv"), *profile, *known, "-o", tmp_path)
    status, _, complaint = shell("fit", log, "-o", tmp_path / "fit.json")
    assert (status, complaint) == (0, "")
    update = ("map", "update", log, "--map", tmp_path / "wil.map")
    status, _, complaint = shell(*update)
    assert status == 2
    assert "dry or wet" in complaint
    status, shown, _ = shell(*update, "--layer", "dry")
    assert status == 0
    assert "dry" in shown


@pytest.mark.parametrize("fact", ["weather", "=wet", "weather=", "load=heavy", "load=nan"])
def test_facts_that_make_no_sense_are_refused(fact: str, tmp_path: Path, shell: Shell) -> None:
    status, _, complaint = shell(
        "ingest", sample("gnss.csv"), "--set", fact, "-o", tmp_path / "out"
    )
    assert (status, complaint.count("\n")) == (2, 1)
    assert not (tmp_path / "out").exists()


def test_help_teaches_every_command(shell: Shell) -> None:
    status, shown, _ = shell("--help")
    assert status == 0
    for command in ("simulate", "ingest", "show", "fit", "map", "plan", "replay", "demo"):
        assert command in shown
    for words in demo.commands(Path("results")):
        verb = words[:2] if words[0] in ("map", "simulate") else words[:1]
        status, shown, _ = shell(*verb, "--help")
        assert status == 0
        assert "Usage" in shown


def test_help_breaks_where_the_terminal_ends_and_gives_an_example(
    monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 200)
    for verb in ("fit efforts", "simulate drive", "map update", "map show", "demo", "new line"):
        _, shown, _ = shell(*verb.split(), "--help")
        prose = [line.strip() for line in shown.splitlines()[3:] if not line.startswith(("╭", "│"))]
        example = f"Example: trainlog {verb} "
        assert any(line.startswith(example) for line in prose), verb
        # A paragraph shorter than the terminal stands in one line.
        assert all(
            not line or line[-1] in ".╯" or len(line) > 150
            for line in prose
            if not line.startswith("Example")
        ), verb


def test_a_report_of_what_is_no_folder_of_results_says_what_it_looks_for(
    tmp_path: Path, shell: Shell
) -> None:
    _, _, complaint = shell("report", str(tmp_path / "none"))
    assert "does not exist; name the folder" in " ".join(complaint.split())
    _, _, complaint = shell("report", str(tmp_path))
    assert "holds no results; they are looked for as" in " ".join(complaint.split())


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("braking=weird", "--set braking: 'weird' is not one of recourse, common; give one"),
        ("cells=100000000", "--set cells '100000000' must be between 20 and 20000; write"),
        ("cells=many", "--set cells 'many' is not a valid whole number; write it as 500"),
        ("cells=20.5", "--set cells '20.5' is not a valid whole number; write it as 500"),
    ],
)
def test_what_a_value_may_be_is_told_in_our_own_words(
    setting: str, words: str, shell: Shell
) -> None:
    status, _, complaint = shell("plan", *BOTH, "-o", "t.json", "--set", setting)
    assert (status, complaint.count("\n")) == (2, 1)
    assert words in complaint
    assert not re.search("Input should|Value error|valid integer", complaint)


def test_a_demo_does_not_run_into_a_file(tmp_path: Path, shell: Shell) -> None:
    (tmp_path / "file").write_text("x")
    status, _, complaint = shell("demo", "-o", str(tmp_path / "file"))
    assert status == 2
    assert "is a file; name a folder with --output" in " ".join(complaint.split())


def test_a_folder_for_pictures_of_trips_is_checked_before_the_work(
    tmp_path: Path, shell: Shell
) -> None:
    (tmp_path / "file").write_text("x")
    status, _, complaint = shell(
        "fit",
        str(sample("stopping.mcap")),
        "-o",
        str(tmp_path / "p.json"),
        "--per-trip",
        str(tmp_path / "file"),
    )
    assert status == 2
    assert "cannot be made" in complaint
    assert not (tmp_path / "p.json").exists()


def test_an_interrupted_command_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("trainlog.simulation.drive", interrupted)
    status, _, complaint = shell("simulate", "drive", *BOTH, "-o", tmp_path)
    assert status == 130
    assert "interrupted" in complaint


def test_ctrl_c_while_python_still_loads_is_one_line() -> None:
    loading = """
import os, signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == "trainlog.cli.main":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
from trainlog.__main__ import main
main()
"""
    ended = subprocess.run([sys.executable, "-c", loading], capture_output=True, text=True)
    assert ended.returncode == 130
    assert ended.stderr.strip() == "trainlog: interrupted"
    assert not ended.stdout


def test_simulated_logs_are_the_same_for_the_same_seed(tmp_path: Path, shell: Shell) -> None:
    for folder in ("a", "b"):
        words = ("simulate", "drive", *BOTH, "--count", "1", "--seed", "3", "-o", tmp_path / folder)
        shell(*words)
    logs = [(tmp_path / folder / "trip-01.mcap").read_bytes() for folder in ("a", "b")]
    assert logs[0] == logs[1]


def test_fit_writes_what_it_was_made_from(tmp_path: Path, shell: Shell) -> None:
    target = tmp_path / "parameters.json"
    status, _, _ = shell("fit", sample("stopping.mcap"), "-o", target)
    assert status == 0
    provenance = json.loads(target.read_text("utf-8"))["provenance"]
    assert provenance["inputs"]
    assert target.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_outputs_are_checked_before_any_work(tmp_path: Path, shell: Shell) -> None:
    log = tmp_path / "trip.mcap"
    log.write_bytes(sample("nonstop.mcap").read_bytes())
    before = log.read_bytes()
    for words in (
        ["fit", log, "-o", log],
        ["fit", log, "-o", tmp_path / "fit.png"],
        ["fit", log, "-o", tmp_path / "missing" / "fit.json"],
        ["map", "update", log, "--map", tmp_path / "map"],
        ["map", "show", sample("CH_StGallen_Wil.map"), "--picture", tmp_path],
        ["plan", tmp_path / "p.json", "-o", tmp_path],
        ["estimate", log, "-o", tmp_path],
        ["simulate", "drive", *BOTH, "-o", log],
    ):
        status, shown, complaint = shell(*words)
        assert (status, complaint.count("\n"), shown) == (2, 1, "")
    assert log.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["trip.mcap"]


def test_parameters_of_another_train_are_refused(tmp_path: Path, shell: Shell) -> None:
    other = tmp_path / "other.train.json"
    train = sample(DEFAULT_TRAIN).read_text("utf-8")
    other.write_text(train.replace("CH_Stadler_FLIRT_TPF", "OTHER"), "utf-8")
    parameters = tmp_path / "parameters.json"
    shell("fit", sample("stopping.mcap"), "-o", parameters)
    status, _, complaint = shell(
        *("plan", parameters, *LINE, "--train", other, "-o", tmp_path / "t.json")
    )
    assert status == 2
    assert "observed on train 'CH_Stadler_FLIRT_TPF', not on 'OTHER'" in complaint


@pytest.mark.parametrize(
    "words",
    [("--weather", "wet"), ("--configurations", "all"), ("--map", "m.map"), ("--late", "9")],
)
def test_options_that_contradict_are_refused(
    words: tuple[str, str], tmp_path: Path, shell: Shell
) -> None:
    status, _, complaint = shell("simulate", "drive", *BOTH, *words, "-o", tmp_path / "out")
    assert status == 2
    assert words[0] in " ".join(complaint.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [["replay"], ["convert"]])
def test_a_part_that_holds_nothing_is_told_with_its_file(
    words: list[str], tmp_path: Path, shell: Shell
) -> None:
    log = sample("nonstop.mcap")
    output = tmp_path / f"part{'.rrd' if words[0] == 'replay' else '.mcap'}"
    status, _, complaint = shell(words[0], log, *words[1:], "--km", "900:901", "-o", output)
    assert status == 2
    reach = "line 'CH_StGallen_Wil' has no km 900; its kilometres are 0.000 to 29.556"
    assert reach in complaint
    assert not output.exists()


def test_units_in_brackets_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    """Brackets are no markup, neither in headings nor in names."""
    table = new_table("made [N]", "speed [m/s]")
    table.add_row("trip [a]")
    terminal.console.print(table, "refused: trip '[/b]'")
    shown = capsys.readouterr().out
    assert all(each in shown for each in ("made [N]", "speed [m/s]", "trip [a]", "'[/b]'"))


def test_help_names_units(shell: Shell) -> None:
    _, shown, _ = shell("study", "consist", "--help")
    assert "km/h" in shown


def test_all_problems_of_a_train_file_are_listed_line_by_line(tmp_path: Path, shell: Shell) -> None:
    content = json.loads(sample(DEFAULT_TRAIN).read_text("utf-8"))
    content["mass"]["unit"], content["max_speed"], content["colour"] = "kg", 160, "red"
    light = tmp_path / "light.train.json"
    light.write_text(json.dumps(content))
    status, out, err = shell("simulate", "drive", *LINE, "--train", light, "-o", tmp_path / "trips")
    assert (status, out) == (2, "")
    lines = err.splitlines()
    assert lines[0] == f"trainlog: {light}: 3 problems"
    assert [line.split(":")[0] for line in lines[1:]] == ["  colour", "  max_speed", "  mass"]


def test_a_line_begins_with_a_template_or_a_table(tmp_path: Path, shell: Shell) -> None:
    target = tmp_path / "my.line.toml"
    assert shell("new", "line", "-o", target) == (0, f"wrote {target}\n", "")
    status, _, err = shell("new", "line", "-o", target)
    assert status == 2
    assert "my.line.toml: exists; choose another name" in err
    table = tmp_path / "A-B.csv"
    table.write_text("km;gradient [permil];limit [km/h];station\n0;2;80;A\n9;;;B\n", "utf-8")
    made = tmp_path / "A-B.line.json"
    status, out, _ = shell("new", "line", "--from", table, "-o", made)
    assert (status, out) == (0, f"wrote {made}\n")
    assert json.loads(made.read_text("utf-8"))["length"] == {"value": 9000, "unit": "m"}
    named = tmp_path / "named.line.json"
    words = ("new", "line", "--from", table, "--name", "Aach-Berg", "-o", named)
    assert shell(*words)[0] == 0
    assert json.loads(named.read_text("utf-8"))["name"] == "Aach-Berg"
    words = ("new", "line", "--name", "Aach-Berg", "-o", tmp_path / "other.line.toml")
    status, _, err = shell(*words)
    assert status == 2
    assert "--name Aach-Berg: a template states its own name; leave --name out" in err


def test_a_log_that_cannot_be_estimated_does_not_stop_the_others(
    tmp_path: Path, shell: Shell
) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.mcap").write_bytes(b"no log")
    (tmp_path / "logs" / "b.mcap").write_bytes(sample("nonstop.mcap").read_bytes())
    words = ("estimate", tmp_path / "logs", "-o", tmp_path / "out")
    status, _, complaint = shell(*words)
    assert status == 1
    assert "a.mcap" in complaint
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["b.mcap"]


def test_slip_events_of_all_logs_are_tabled(tmp_path: Path, shell: Shell) -> None:
    """One row an event, with units in the names; a log that cannot be analysed is left out."""
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.mcap").write_bytes(b"no log")
    (tmp_path / "logs" / "b.mcap").write_bytes(sample("nonstop.mcap").read_bytes())
    table = tmp_path / "slips.csv"
    words = ("estimate", tmp_path / "logs", "-o", tmp_path / "out", "--slips", table)
    status, out, _ = shell(*words)
    assert status == 1
    assert "25 slip events" in out
    found = pd.read_csv(table, parse_dates=["onset", "peak", "release"])
    events = analysis.slip(sample("nonstop.mcap")).events.sort_values(["start", "axle"])
    assert found["axle"].tolist() == events["axle"].tolist()
    assert (found["peak"] < found["release"]).all()
    np.testing.assert_allclose(found["energy_J"], events["energy"], rtol=1e-6)
    np.testing.assert_allclose(found["creepage"], events["creepage"], rtol=1e-6)
    status, _, complaint = shell(*words[:-1], tmp_path / "slips.txt")
    assert status == 2
    assert "not the name of a .csv file" in complaint


@pytest.mark.parametrize("start", [b"PK\x03\x04....[Content_Types].xml", b"\xd0\xcf\x11\xe0"])
@pytest.mark.parametrize(
    "words",
    [
        ["ingest", "BOOK", "-o", "OUT"],
        ["show", "BOOK"],
        ["fit", "BOOK", "-o", "OUT.json"],
        ["fit", "adhesion", "BOOK", "-o", "OUT.json"],
        ["plan", "--line", "BOOK", *TRAIN, "-o", "OUT.json"],
        ["import", "BOOK", "-o", "OUT"],
    ],
    ids=lambda words: " ".join(words[:1]),
)
def test_a_workbook_is_answered_with_save_as_csv(
    start: bytes, words: list[str], tmp_path: Path, shell: Shell
) -> None:
    book = tmp_path / "book.xlsx"
    book.write_bytes(start + bytes(200))
    given = [
        str(book) if word == "BOOK" else word.replace("OUT", str(tmp_path / "out"))
        for word in words
    ]
    status, _, complaint = shell(*given)
    assert (status, complaint.count("\n")) == (2, 1)
    assert "workbook" in complaint
    assert "save its sheet as CSV" in complaint
    assert "save its sheet as CSV" in no_recording(book)  # of a folder it is passed over with this


def test_a_file_without_a_version_is_answered_with_it(tmp_path: Path) -> None:
    path = tmp_path / "a.line.json"
    path.write_text('{"format": "trainlog/line"}', "utf-8")
    with pytest.raises(InputError, match="states no version of the format trainlog/line; add the"):
        read_line(path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("report LOG -o a.html --maps maps --at 2026-01-01", "leave out --maps and --at"),
        (
            "simulate follow LOG --train sample -o trips --risk 0.1",
            "leave out --risk or give",
        ),
        ("simulate fleet drawn -o trips --count 3 --trips-per-day 2", "leave out --trips-per-day"),
    ],
)
def test_options_that_a_mode_ignores_are_refused(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    monkeypatch.chdir(tmp_path)
    given = words.replace("LOG", str(sample("nonstop.mcap"))).split()
    status, _, complaint = shell(*given)
    assert status == 2
    assert message in complaint
    assert not list(tmp_path.iterdir())
