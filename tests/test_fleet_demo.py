"""The demo of a fleet: commands that there are, and that run one after the other."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.console import Console
from test_cli_help import commands as every_command, context_of

from trainlog.cli import demo, main as cli
from trainlog.cli.commands import DEFAULT


def test_its_commands_are_public_and_two_trains_have_faults() -> None:
    known = dict(every_command())
    for words in demo.fleet_commands(Path("out")):
        two = " ".join(words[:2])
        name = two if two in known else f"{words[0]} {DEFAULT.get(words[0], '')}".strip()
        command = known[name]
        options = {
            each for one in command.get_params(context_of(name, command)) for each in one.opts
        }
        assert {word for word in words if word.startswith("--")} <= options, words
    words = demo.fleet_commands(Path("out"))[0]
    faults = {word.partition(",")[0] for word in words if word.startswith("train=")}
    assert len(faults) == 2


@pytest.mark.long
def test_the_commands_run_one_after_the_other(tmp_path: Path) -> None:
    results = tmp_path / "results"
    steps = demo.fleet_commands(results, trips=24)
    demo.run_demo(results, Console(quiet=True), cli.run, steps, demo.FLEET_THEN)
    for name in ("trajectory.json", "fleet.html", "trains/trains.json"):
        assert (results / name).is_file()
