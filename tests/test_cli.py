"""The command line: its help, what a person meets with good and bad input and in a terminal."""

import json
import os
import re
import select
import shlex
import shutil
import struct
import subprocess
import sys
import time
from collections import defaultdict
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import typer
from contents import put
from killed import PATIENCE

import analysis
import trainlog
from trainlog import DEFAULT_TRAIN, InfeasibleError, Scenario, sample, write_parameters
from trainlog.cli import main as cli, terminal
from trainlog.cli.commands import FORMER, WORDS
from trainlog.cli.options import FOLDERS, destination
from trainlog.mcap import account_of
from trainlog.progress import task
from trainlog.simulation import Run, drive as driven

DOCS = Path(__file__).parents[1] / "docs"
sys.path.insert(0, str(DOCS / "tools"))

from options import commands, context_of, own_options, with_options  # noqa: E402

pytestmark = pytest.mark.usefixtures("remembered", "unpainted")

LINE = ["--line", "sample"]
BOTH = [*LINE, "--train", "sample"]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of a user, of which none may change and beside which nothing may be written."""
    folder = tmp_path_factory.mktemp("given")
    for name in ("nonstop.mcap", "stopping.mcap", "gnss.csv", "CH_StGallen_Wil.map"):
        shutil.copy(sample(name), folder)
    shutil.copy(folder / "gnss.csv", folder / "recorded.mcap")
    for name in ("copy", "none"):
        (folder / name).mkdir()
    shutil.copy(folder / "stopping.mcap", folder / "copy")
    workbook = b"PK\x03\x04....[Content_Types].xml" + bytes(200)
    (folder / "new.xlsx").write_bytes(workbook)
    (folder / "old.xlsx").write_bytes(b"\xd0\xcf\x11\xe0" + bytes(200))
    train = sample(DEFAULT_TRAIN).read_text("utf-8").replace("CH_Stadler_FLIRT_TPF", "OTHER")
    (folder / "other.train.json").write_text(train, "utf-8")
    (folder / "file").write_text("x")
    (folder / "empty.mcap").touch()
    # Before the end of its first chunk.
    (folder / "truncated.mcap").write_bytes(sample("nonstop.mcap").read_bytes()[:10_000])
    (folder / "foreign.mcap").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 8)
    (folder / "nonsensical.mcap").write_text('{"format": "trainlog/line", "length": -1}')
    (folder / "folder.mcap").mkdir()
    write_parameters(analysis.fit([sample("stopping.mcap")]).parameters, folder / "set.json")
    return folder


def state_of(folder: Path) -> dict[Path, tuple[int, int]]:
    """Size and time of each file, and the folders."""
    states = ((path, path.stat()) for path in folder.rglob("*"))
    return {path: (each.st_size, each.st_mtime_ns) * path.is_file() for path, each in states}


SHORT = {
    "DAYS": "simulate days --line sample --train sample --days 2 -o x",
    "PLAN": "plan set.json BOTH -q -o x.json",
    "BOTH": "--line sample --train sample",
    "MAP": "--map TRACK",
    "TRACK": "CH_StGallen_Wil.map",
}
REFUSED = {
    "fit x": "Missing option '--output' / '-o'; for example: trainlog fit efforts",
    "map update x": "for example: trainlog map update results/trips --map",
    "advice": "Missing argument 'TRAJECTORIES'; for example: trainlog advice results/",
    "pln x": "No such command 'pln'. Did you mean 'plan'?",
    "map udate": "Did you mean 'update'?; see 'trainlog map --help'",
    "fit x --cvr 3": "No such option: --cvr (Possible options: --cover)",
    "simulate drive -o x --traction none": "--traction: 'none' is not one of own, cooperative",
    "convert nonstop.mcap --km 900:901 -o x.mcap": "'CH_StGallen_Wil' has no km 900; its",
    "report none --maps maps -o a.html --at 2026-01-01": "leave out --maps and --at",
    "simulate follow nonstop.mcap --train sample -o x --risk 0.1": "leave out --risk or give",
    "simulate fleet drawn -o x --count 3 --trips-per-day 2": "leave out --trips-per-day",
    "simulate drive BOTH --weather wet -o x": "--weather",
    "simulate drive BOTH --map m.map -o x": "--map",
    "convert stopping.mcap -o sub/x.mcap --topic /nope": "stopping.mcap: has no topic /nope; it",
    "convert stopping.mcap -o .mcap": ".mcap: is the name of a .mcap file, and a folder is needed",
    "simulate fleet drawn -o x.json --days 1": "x.json: is the name of a .json file, and a folder",
    "compare nonstop.mcap --reference none": "has no sections of a journey; name a folder that",
    "new samples -o .csv": ".csv: is the name of a .csv file, and a folder is needed",
    "convert copy nonstop.mcap -o x.mcap --km 1:2": "--km cannot be taken: several logs are joined",
    "map show file --km 8:9": "what a picture shows",
    # values that cannot be
    "map show file --km 8:8 --picture no.png": "not a part of a line",
    "map show TRACK --layer frost --picture no.png": "has no layer 'frost'",
    "show nonstop.mcap --picture .csv": ".csv: is not the name of a .png or .svg file; end it in",
    "show other.train.json --picture no.png": "there is no picture of a train; see it",
    "simulate drive BOTH -o x --characteristic icy": "'icy' is unknown; give a file, or one of",
    "replay nonstop.mcap --view drivnig -o no.rrd": "no view 'drivnig'",
    "DAYS --start soon": "'soon' is not a date",
    "DAYS --change km=1:2,factor=2": "has no date",
    "DAYS --change km=1:2,date=2026-10-01": "has no factor or spots",
    "DAYS --change km=1,date=2026-10-01,factor=2": "section of the line",
    "DAYS --change km=1:2,date=2026-10-01,depth=2": "not understood",
    "DAYS --change km=1:2,date=2027-10-01,factor=2": "not one of the days",
    "plan BOTH -o x.json --reserve 7,5%": "is one number or two",
    "plan BOTH -o x.json --reserve 0.07": "is less than 0.5 %",
    "plan BOTH -o x.json --set load=800t": "is not plausible for a train of 122 t",
    "PLAN --set load=8t": "the parameter set holds the masses",
    "simulate drive -o x --count 0": "--count '0' must be at least 1; write it as",
    "plan BOTH -o x.json --running-time 0": "--running-time '0' must be above 0 s; write it as 90",
    "fit nonstop.mcap -o x.json --cover 0.95": "'0.95' must be between 50 % and 99.99 %",
    "plan BOTH -o x.json --set cells=100000000": "must be between 20 and 20000; write",
    "plan set.json BOTH --running-time 600 -o x.json -q": "allow at least 999 s",
    "ingest gnss.csv --set weather -o x": "weather",
    "ingest gnss.csv --set load=heavy -o x": "heavy",
    "ingest gnss.csv -o x --format gnns": "no format 'gnns'",
    "ingest gnss.csv -o x --format gpx": "gnss.csv",
    # of one run
    "PLAN --stops j.json --km 1:2": "--km cannot be taken: --stops gives",
    "PLAN --stops j.json --set initial-speed=0": "leave out --set initial-speed",
    "PLAN --stops 'St.Gallen,Gossau SG,Wil'": "is one file, but 2 sections are planned",
    "PLAN --stops 'Gossau SG,Wil' --running-time 9 --reserve 3": "gives the time",
    "PLAN --running-time 9 --reserve 3": "leave out --reserve",
    "PLAN --stops 'Wil,Gosau SG'": "did you mean 'Gossau SG'?",
    "PLAN --stops Wil": "name at least two with commas between them",
    "PLAN --stops Wil,St.Gallen": "order them so, or add --reverse",
    "PLAN --set dwel=3": "did you mean dwell?",
    "PLAN --set braking=hard": "is not one of recourse, common",
    "PLAN --km 1:2 --running-time x.mcap": "from end to end of the line; leave out --km",
    "PLAN --set dwell=30": "leave out --set dwell or give them",
    "PLAN --stops St.Gallen,Wil --set referee=yes": "leave out --set referee",
    "PLAN --km 5:3": "from km 5.000 to km 3.000 is not a section",
    "PLAN --km Gossau": "write kilometres as 3.2:7.5",
    "PLAN --km 1:9 --set initial-speed=400": "400.0 km/h is above the",
    "PLAN --set final-speed=inf": "--set final-speed 'inf' is not a valid speed; write it as 80",
    "PLAN --running-time 20:75": "--running-time '20:75' is not a valid time; write it as",
    "PLAN MAP --set sigmas=-1": "give 0 or more",
    "PLAN MAP --set sigmas=1 --set risk=0.1": "leave out --set sigmas",
    "PLAN --set risk=0.05": "leave out --set risk or give a map",
    "PLAN --at 2026-11-22": "leave out --at or give a map",
    # what is missing; the samples are taken by name alone, for a plan on another line looks as good
    "simulate drive -o x": "no line and no train are given; give --line FILE --train FILE; for a t",
    "fit none -o x.json": "the folder has no logs (*.mcap); name another folder, or make logs",
    "report gone": "does not exist; name the folder",
    "report none": "has no results; they are looked for as",
    "advice none -o a.html": "has no sections of a journey",
    # files of another kind
    "replay TRACK": "not an MCAP file but a track-condition map",
    "compare calculated nonstop.mcap --model TRACK": "is a track-condition map; the parameters",
    "ingest new.xlsx -o x": "save its sheet as CSV",
    "fit old.xlsx -o x.json": "save its sheet as CSV",
    "plan set.json --line sample --train other.train.json -o x.json": "not on 'OTHER'",
    # outputs, before any work
    "ingest gnss.csv -o x.mcap": "the name of a .mcap file, and a folder is needed; name a",
    "convert stopping.mcap copy/stopping.mcap -o x": "copy/stopping.mcap: has the same name as",
    "demo -o file": "is a file; name a folder with --output",
    "fit stopping.mcap -o x.json --per-trip file": "cannot be made",
    "ingest recorded.mcap -o .": "recorded.mcap: would be overwritten",
    "fit nonstop.mcap -o nonstop.mcap": "",
    "fit nonstop.mcap -o nonstop.mcap/fit.json": "a folder is needed",
    "map update nonstop.mcap --map map": "",
    "estimate nonstop.mcap -o x --slips slips.txt": "not the name of a .csv file",
    "new line --name Aach-Berg -o x.line.toml": "a template states its own name; leave",
}  # words of commands, and what the one line of the refusal states
KINDS = ("missing", "empty", "truncated", "foreign", "nonsensical", "folder")
COMMANDS = """
fit BAD -o x.json
fit BAD -o x.json --per-trip x
estimate BAD -o x
map update BAD --map x.map
map diff BAD --from 2026-01-01 --picture x.png
map show BAD --km 1 --picture x.png
map export BAD -o x.csv
map show BAD --picture x.png
replay BAD -o x.rrd
compare groups BAD --with BAD
compare trips BAD
ingest BAD -o x
import BAD -o x
plan BAD BOTH -o x.json
simulate drive --train sample --line BAD -o x
simulate drive --line sample --train BAD -o x
simulate drive BOTH --characteristic BAD -o x
fit adhesion BAD -o x.json
simulate follow BAD BOTH -o x
report BAD
report BAD -o x.html
"""  # each is refused with files of two kinds
REFUSED |= {
    words.replace("BAD", f"{kind}.mcap"): f"{kind}.mcap"
    for number, words in enumerate(COMMANDS.strip().splitlines())
    for kind in (KINDS[number % 6], KINDS[(number + 3) % 6])
}


@pytest.mark.parametrize(("words", "said"), REFUSED.items(), ids=REFUSED)
def test_what_cannot_be_done_is_refused_in_one_line(words, said, given, monkeypatch, shell):
    """Nothing is printed or written before."""
    monkeypatch.chdir(given)
    before = state_of(given)
    for short, whole in SHORT.items():
        words = words.replace(short, whole)
    status, shown, complaint = shell(*shlex.split(words))
    assert (status, complaint.count("\n")) == (2, 1), complaint
    assert shown == "" or "map update foreign" in words  # states that no map was made
    assert said in complaint
    assert complaint.startswith("trainlog: ")
    assert not re.search("Traceback|Input should|Value error|valid integer", complaint)
    assert state_of(given) == before


def test_the_folder_of_a_file_is_made_and_goes_if_nothing_is_written(tmp_path, shell, works):
    words = "show", "sample_logs/CH_StGallen_Wil.line.json", "--picture", tmp_path / "a" / "b.png"
    assert shell(*words, "--nothing")[0] == 2
    assert not (tmp_path / "a").exists()
    works(*words)
    assert [each.name for each in (tmp_path / "a").iterdir()] == ["b.png"]


def test_a_damaged_log_is_reported_once_a_command(tmp_path, shell):
    log = sample("nonstop.mcap").read_bytes()
    half = put(tmp_path / "half.mcap", log[: len(log) // 2])
    for words in (
        ("fit", half, "-o", tmp_path / "fit.json"),
        ("map", "update", half, "--layer", "dry", "--map", tmp_path / "wil.map"),
        ("replay", half, "-o", tmp_path / "half.rrd"),
    ):
        status, _, complaint = shell(*words)
        assert status == 0
        assert complaint.count("trainlog: warning: ") == 1, words
        assert complaint.startswith(f"trainlog: warning: {half}: is damaged: ")


def test_brackets_in_names_and_findings_are_shown(tmp_path, works):
    recording = put(tmp_path / "run [1].csv", sample("gnss.csv").read_bytes())
    profile = ("--profile", sample("recorder.profile.toml"))
    shown = works("ingest", recording, *profile, "-o", tmp_path)
    assert "run [1]: " in shown
    assert "not used: [time] of the profile" in shown
    assert "run [1].mcap" in shown


def test_an_interrupted_command_says_so(tmp_path, monkeypatch, shell):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("trainlog.simulation.drive", interrupted)
    status, _, complaint = shell("simulate", "drive", *BOTH, "-o", tmp_path)
    assert status == 130
    assert "interrupted" in complaint


def test_a_train_that_does_not_arrive_does_not_end_the_others(tmp_path, monkeypatch, shell):
    def stalled(scenario: Scenario) -> Run:
        if scenario.name == "trip-01":
            raise InfeasibleError("trip-01 does not arrive", remedy="check adhesion")
        return driven(scenario)

    monkeypatch.setattr("trainlog.simulation.drive", stalled)
    given = ["simulate", "drive", *BOTH, "-o", tmp_path, "--count"]
    status, _, complaint = shell(*given, 2)
    assert (status, [each.name for each in tmp_path.iterdir()]) == (1, ["trip-02.mcap"])
    assert complaint == "trainlog: trip-01 does not arrive; check adhesion\n"
    assert shell(*given, 1)[0] == 2


def test_ctrl_c_while_python_still_loads_is_one_line():
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


def test_all_problems_of_a_train_file_are_listed_line_by_line(tmp_path, shell):
    content = json.loads(sample(DEFAULT_TRAIN).read_text("utf-8"))
    content["mass"]["unit"], content["max_speed"], content["colour"] = "kg", 160, "red"
    light = put(tmp_path / "light.train.json", json.dumps(content))
    status, out, err = shell("simulate", "drive", *LINE, "--train", light, "-o", tmp_path / "trips")
    assert (status, out) == (2, "")
    lines = err.splitlines()
    assert lines[0] == f"trainlog: {light}: 3 problems"
    assert [line.split(":")[0] for line in lines[1:]] == ["  colour", "  max_speed", "  mass"]


def test_a_log_without_axles_is_estimated_but_has_no_table_of_slips(tmp_path, shell):
    trip = trainlog.read(sample("nonstop.mcap"), ["/train/state", "/train/controls"])
    trainlog.write(trip.between(trip.start, trip.start + pd.Timedelta("3min")), tmp_path / "a.mcap")
    table, output = tmp_path / "slips.csv", tmp_path / "out"
    status, _, said = shell("estimate", tmp_path / "a.mcap", "-o", output, "--slips", table)
    assert status == 1
    words = "is not written: no log shows slip; give logs with /train/axles"
    assert said == f"trainlog: {table}: {words}\n"
    assert (output / "a.mcap").exists()
    assert not table.exists()


def test_slip_events_of_all_logs_are_tabled(tmp_path, shell):
    """One row an event, with units in the names; a log that cannot be analysed is left out."""
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.mcap").write_bytes(b"no log")
    (tmp_path / "logs" / "b.mcap").write_bytes(sample("nonstop.mcap").read_bytes())
    table = tmp_path / "slips.csv"
    status, out, _ = shell("estimate", tmp_path / "logs", "-o", tmp_path / "out", "--slips", table)
    assert status == 1
    assert "25 slip events" in out
    found = pd.read_csv(table, parse_dates=["onset", "peak", "release"])
    events = analysis.slip(sample("nonstop.mcap")).events.sort_values(["start", "axle"])
    assert found["axle"].tolist() == events["axle"].tolist()
    assert (found["peak"] < found["release"]).all()
    np.testing.assert_allclose(found["energy_J"], events["energy"], rtol=1e-6)
    np.testing.assert_allclose(found["creepage"], events["creepage"], rtol=1e-6)


def test_folders_of_a_command_outlast_one_that_it_runs(tmp_path, shell):
    with ExitStack() as outer:
        outer.callback(FOLDERS.reset, FOLDERS.set(outer))
        destination(tmp_path / "outer" / "fit.png", ".png")
        shell("settings")
        assert shell("report", sample("nonstop.mcap"), "-o", tmp_path / "inner" / "a.pdf")[0] == 2
        assert [each.name for each in tmp_path.iterdir()] == ["outer"]
    assert not list(tmp_path.iterdir())


DIFFERENT = {
    "--configurations": "how many a fit gives; which a simulation drives",
    "--count": "trips of drivers; of a fleet, where --trips-per-day may stand in their place",
    "--days": "of a simulation, a study, a history",
    "--dwell": "0 s in both; plan takes it with a journey alone",
    "--from": "a time; a file to begin with; where a recorder sends",
    "--km": "a part of a line; one place",
    "--line": "a file; of the catalogue, a name",
    "--model": "a file; the numbers of a map's model",
    "--network": "a file; to simulate also one that is drawn",
    "--output": "a file or a folder",
    "--speed": "of a study's train; of measured points",
    "--train": "a file; of the catalogue, a name",
    "--trips-per-day": "on one line; of a fleet, where --count may stand in their place",
    "--weather": "of a simulated trip; a table of times",
}  # options whose values are not of one kind in all commands


@pytest.mark.parametrize("columns", ["80", pytest.param("120", marks=pytest.mark.long)])
def test_help_of_every_command_fits_the_terminal_and_loses_nothing(columns, monkeypatch, works):
    monkeypatch.setenv("COLUMNS", columns)
    found = dict(commands())
    assert len(found) > 35
    for words, command in found.items():
        shown = works(*words.split(), "--help")
        assert max(map(len, shown.splitlines())) <= int(columns), words
        assert "…" not in shown, words
        assert not any(each in shown for each in ("<bool>", "<path>", "<int", "<float>", "Path]"))
        every = " ".join(shown.replace("│", " ").split())
        for parameter in command.get_params(context_of(words, command)):
            assert all(option in every for option in parameter.opts if "-" in option), words
            lost = set((parameter.help or "").split()) - set(every.split())
            assert not lost, (words, lost)
            assert parameter.help, (words, parameter.name)


@pytest.mark.parametrize("words", [words for words, _ in commands()])
def test_each_command_has_an_example_that_parses_and_twelve_options(words, tmp_path, monkeypatch):
    (tmp_path / "results").mkdir()
    monkeypatch.chdir(tmp_path)
    command = dict(commands())[words]
    examples = re.findall(r"^Example: trainlog (.*?)(?:\n\n|\Z)", command.help or "", re.M | re.S)
    assert examples
    for example in map(shlex.split, examples):
        given = example[len(words.split()) :]
        assert example[: len(words.split())] == words.split()
        command.make_context(words, given, help_option_names=["-h", "--help"])
    assert len(own_options(words, command)) <= 12


def test_former_names_are_answered_with_the_new_one(shell):
    for former, new in FORMER.items():
        status, shown, complaint = shell(*former.split(), "-x")
        assert (status, shown, complaint.count("\n")) == (2, "", 1), former
        assert f"'{former}' is now 'trainlog {new}'" in complaint
        assert new.split()[0] in WORDS


def test_the_help_of_the_program_says_of_each_word_what_its_own_help_does(shell):
    _, shown, _ = shell("--help")
    every = " ".join(shown.replace("│", " ").split())
    program = typer.main.get_command(cli.app)
    for word in WORDS:
        command = program.get_command(typer.Context(program), word)
        assert f"{word} {(command.help or '').partition(chr(10))[0]}" in every


def test_the_page_lists_the_options_of_all_commands():
    page = (DOCS / "command-line.md").read_text("utf-8")
    assert page == with_options(page), "run docs/tools/options.py docs/command-line.md"


def test_the_same_option_is_the_same_everywhere():
    seen = defaultdict(set)
    for words, command in commands():
        context = context_of(words, command)
        for each in command.get_params(context):
            for name in (opt for opt in each.opts if opt.startswith("--")):
                short = tuple(opt for opt in each.opts if not opt.startswith("--"))
                kind = each.display_type_rich(ctx=context)
                seen[name].add((short, "" if name in DIFFERENT else kind))
                if name not in {*DIFFERENT, "--zone"}:
                    seen[f"default of {name}"].add(str(each.default))
    assert {name: kinds for name, kinds in seen.items() if len(kinds) > 1} == {}
    assert seen["--output"] == {(("-o",), "")}
    assert seen["--quiet"] == {(("-q",), "")}


@pytest.mark.parametrize("words", [[], ["map"], ["study"], ["simulate"]])
def test_a_word_alone_shows_the_help_of_its_commands(words, shell):
    status, shown, complaint = shell(*words)
    assert (status, complaint) == (0, "")
    assert " ".join(["Usage: trainlog", *words]) in " ".join(shown.split())


def test_a_missing_file_is_refused_before_packages_are_loaded():
    commands = ["show none.mcap", "fit none.mcap -o x.json", "map update none.mcap --map x.map"]
    code = f"""
import sys
from trainlog.cli.main import run
for words in {commands!r}:
    try:
        run(words.split())
    except Exception as error:
        print(type(error).__name__)
print(sorted({{'pandas', 'scipy', 'cvxpy', 'pyarrow'}} & set(sys.modules)))
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines() == ["InputError"] * 3 + ["[]"]


def typed(words: list[str], folder: Path, until: str = "") -> SimpleNamespace:
    """What a person sees of a command in a terminal; presses Ctrl-C as soon as `until` is seen."""
    why = "pseudo-terminals are those of POSIX"
    fcntl, pty, termios = (pytest.importorskip(x, reason=why) for x in ("fcntl", "pty", "termios"))
    process, terminal = pty.fork()
    if process == 0:  # the child
        os.chdir(folder)
        os.environ.pop("NO_COLOR", None)
        os.environ["TERM"] = "xterm-256color"
        os.execv(sys.executable, [sys.executable, "-m", "trainlog", *map(str, words)])
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 100, 0, 0))
    seen, pressed, end = b"", not until, time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if select.select([terminal], [], [], 0.1)[0]:
            try:
                part = os.read(terminal, 65536)
            except OSError:  # the terminal is closed: the command has ended
                break
            if not part:
                break
            seen += part
        if not pressed and until in seen.decode("utf-8", "ignore"):
            os.write(terminal, b"\x03")
            pressed = True
    status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    os.close(terminal)
    text = seen.decode("utf-8", "ignore")
    assert pressed, text
    # Without colours and what moves the cursor.
    shown = " ".join(re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text).split())
    return SimpleNamespace(status=status, text=text, words=shown, group=process)


@pytest.mark.long
def test_ctrl_c_ends_the_demo_as_a_whole_and_states_what_was_finished_once(tmp_path):
    seen = typed(["demo", "-o", "results"], tmp_path, until="trip-02:")
    assert seen.status == 130
    assert seen.words.count("interrupted") == 1
    found = re.search(
        r"interrupted at step 2 of \d+ of the demo: driving: (\d+) of 12 trips finished;"
        r" (\d+) files written",
        seen.words,
    )
    assert found is not None, seen.words
    logs = sorted((tmp_path / "results" / "trips").iterdir())
    assert len(logs) == int(found[2]) >= 2
    assert 0 <= int(found[2]) - int(found[1]) <= 1
    assert all(log.suffix == ".mcap" and account_of(log).whole for log in logs)
    assert "trainlog ingest" not in seen.words
    assert "Traceback" not in seen.text
    with pytest.raises(ProcessLookupError):  # no process of the command is left
        os.killpg(seen.group, 0)


def test_progress_shows_rate_and_remaining_time_and_leaves_nothing(tmp_path):
    words = "simulate drive --line=sample --train=sample --count=2 -o trips"
    seen = typed(words.split(), tmp_path)
    assert seen.status == 0
    assert re.search(r"1 of 2 trips", seen.words)
    assert re.search(r"trips a (minute|second)", seen.words)
    assert re.search(r"\d:\d\d left", seen.words)
    # What stays on the screen is behind the last erased line.
    assert seen.text.rstrip().rsplit("\x1b[2K", 1)[-1].count("driving") == 0


def test_progress_is_stated_in_lines_where_no_bar_can_be_drawn(monkeypatch, capsys):
    monkeypatch.setattr(terminal, "SILENCE", 0.02)
    with terminal.progress_shown(), task("driving", total=2, unit="trip") as step:
        step(1, note="trip-01")
        time.sleep(0.2)
    said = capsys.readouterr().err.splitlines()
    # After 0.02, 0.06 and 0.14 s.
    assert 1 <= len(said) <= 3
    assert re.fullmatch(r"driving: 1 of 2 trips .* left trip-01", said[0])
