"""Packages of extras: what works without them, and what is said where one is missing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from trainlog.extras import EXTRAS
from trainlog.formats.samples import DEFAULT_TRAIN, sample
from trainlog.mcap import read_log

WITHOUT = """
import sys
class Absent:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in {modules}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, *_: None if name in {modules} else found(name)
{program}
"""

COMMANDS = """
import io, json
from contextlib import redirect_stderr
from trainlog.cli.main import main
ended = []
for words in {commands}:
    sys.argv = ["trainlog", *words]
    with redirect_stderr(io.StringIO()) as said:
        try:
            main()
        except SystemExit as error:
            ended.append((error.code, said.getvalue()))
print(json.dumps(ended))
"""

SAMPLES = ["--line", "sample", "--train", "sample"]


def without_extras(program: str, folder: Path, kept: str = "") -> subprocess.CompletedProcess[str]:
    """Run a program in a Python that has none of the extras' packages but one's."""
    absent = sorted(module for module, extra in EXTRAS.items() if extra != kept)
    code = WITHOUT.format(modules=absent, program=program)
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)


def test_logs_are_read_recorded_converted_and_shown_without_any_extra(tmp_path):
    log = str(sample("nonstop.mcap"))
    shown = [log, str(sample("CH_StGallen_Wil.line.json")), str(sample(DEFAULT_TRAIN))]
    commands = [["show", each] for each in shown]
    commands += [["convert", "copy.mcap", "-o", "table.parquet"]]
    commands += [["convert", "table.parquet", "-o", "again.mcap", "--from", "60s"]]
    program = f"""
import numpy as np, trainlog
trip = trainlog.read({log!r})
trainlog.write(trip, "copy.mcap")
assert trainlog.read("copy.mcap") == trip
with trainlog.record("recorded.mcap") as recording:
    recording.write("/train/state", 1_700_000_000_000_000_000, speed=3.0)
assert len(trainlog.read("recorded.mcap")["/train/state"]) == 1
import analysis, estimators
from trainlog.errors import MissingExtraError
for get in (lambda: analysis.fit, lambda: estimators.SlipDetector, lambda: trainlog.simulate):
    try:
        get()
    except MissingExtraError as error:
        assert str(error).endswith("pip install 'trainlog[learn]'"), error
    else:
        raise AssertionError
{COMMANDS.format(commands=commands)}
"""
    ended = without_extras(program, tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout.splitlines()[-1]) == [[0, ""]] * len(commands)
    assert len(read_log(tmp_path / "again.mcap")["/train/state"]) > 0


LEARN = (
    ["fit", str(sample("nonstop.mcap")), "-o", "fitted.json"],
    ["ingest", str(sample("recorder.csv")), "-o", "logs"],
    ["demo", "-o", "demo"],
)

MISSING = (
    (["replay", str(sample("nonstop.mcap")), "-o", "out.rrd"], "replay"),
    (["plan", "fit.json", "-o", "out.json"], "plan"),
    (["simulate", "follow", "out.json", *SAMPLES, "-o", "driven"], "plan"),
    (["study", "robust-minimax", "-o", "study"], "plan"),
)
"""Commands that need a package, and its extra."""


@pytest.mark.parametrize("kept", [pytest.param("", marks=pytest.mark.long), "learn"])
def test_a_missing_extra_is_one_line_with_the_command_that_installs_it(kept, tmp_path):
    missing = MISSING if kept else [(words, "learn") for words in LEARN]
    (tmp_path / "fit.json").write_text("{}")
    (tmp_path / "out.json").write_text("{}")
    program = COMMANDS.format(commands=[words for words, _ in missing])
    done = without_extras(program, tmp_path, kept)
    assert done.returncode == 0, done.stderr
    ended = json.loads(done.stdout.splitlines()[-1])
    for (status, said), (words, extra) in zip(ended, missing, strict=True):
        assert status == 2, words
        (line,) = said.strip().splitlines()
        assert line.endswith(f"which is not installed; pip install 'trainlog[{extra}]'"), words
    assert not list(tmp_path.glob("*.rrd"))


def test_each_extra_lists_its_packages():
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8")
    for module, extra in EXTRAS.items():
        section = text.partition(f"\n{extra} = [")[2].partition("]\n")[0]
        assert module in section, f"{module} is not in the extra {extra}"
