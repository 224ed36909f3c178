"""Packages of extras: what works without them, and what is said where one is missing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from refusals import refused

from trainlog.errors import MissingExtraError
from trainlog.extras import EXTRAS, load, require
from trainlog.formats.samples import sample

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


def without_extras(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a program in a Python that has none of the extras' packages."""
    code = WITHOUT.format(modules=sorted(EXTRAS), program=program)
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)


def test_logs_are_read_written_and_fitted_without_any_extra(tmp_path: Path) -> None:
    log = str(sample("nonstop.mcap"))
    program = f"""
import trainlog
trip = trainlog.read({log!r})
trainlog.write(trip, "copy.mcap")
print(len(trainlog.read("copy.mcap")["/train/state"]) == len(trip["/train/state"]))
sys.argv = ["trainlog", "fit", "copy.mcap", "-o", "fit.json"]
from trainlog.cli.main import main
main()
"""
    ended = without_extras(program, tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("True")
    assert (tmp_path / "fit.json").exists()


MISSING = (
    (["replay", str(sample("nonstop.mcap")), "-o", "out.rrd"], "replay"),
    (["plan", "fit.json", "-o", "out.json"], "plan"),
    (["simulate", "follow", "out.json", *SAMPLES, "-o", "driven"], "plan"),
    (["study", "robust-minimax", "-o", "study"], "plan"),
)
"""Commands that need a package, and its extra."""


def test_a_missing_extra_is_one_line_with_the_command_that_installs_it(tmp_path: Path) -> None:
    (tmp_path / "fit.json").write_text("{}")
    (tmp_path / "out.json").write_text("{}")
    program = COMMANDS.format(commands=[words for words, _ in MISSING])
    done = without_extras(program, tmp_path)
    assert done.returncode == 0, done.stderr
    ended = json.loads(done.stdout.splitlines()[-1])
    for (status, said), (words, extra) in zip(ended, MISSING, strict=True):
        assert status == 2, words
        (line,) = said.strip().splitlines()
        assert line.endswith(f"which is not installed; pip install 'trainlog[{extra}]'"), words
    assert not list(tmp_path.glob("*.rrd"))


def test_modules_are_checked_and_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    require("rerun", "casadi")
    assert load("casadi").__name__ == "casadi"
    monkeypatch.setitem(sys.modules, "daqp", None)
    refused(MissingExtraError, r"package daqp.*trainlog\[plan\]", load, "daqp")


def test_each_extra_lists_its_packages() -> None:
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8")
    for module, extra in EXTRAS.items():
        section = text.partition(f"\n{extra} = [")[2].partition("]\n")[0]
        assert module in section, f"{module} is not in the extra {extra}"
