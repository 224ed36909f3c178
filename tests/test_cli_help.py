"""Help of all commands: readable at 80 columns, in words of the field, the same everywhere."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from command import run
from typer.core import TyperGroup

from trainlog.cli import main as cli

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
}
"""Options whose values are not of one kind in all commands."""


def commands(of: Any = None, name: str = "") -> Iterator[tuple[str, Any]]:
    """All commands by their words."""
    for word, command in (of or typer.main.get_command(cli.app)).commands.items():
        words = f"{name} {word}".strip()
        if isinstance(command, TyperGroup):
            yield from commands(command, words)
        else:
            yield words, command


@pytest.mark.parametrize("columns", ["80", pytest.param("120", marks=pytest.mark.long)])
def test_help_of_every_command_fits_the_terminal_and_loses_nothing(
    columns: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    found = dict(commands())
    assert len(found) > 35
    for words, command in found.items():
        status, shown, _ = run(monkeypatch, capsys, *words.split(), "--help")
        assert status == 0
        assert max(map(len, shown.splitlines())) <= int(columns), words
        assert "…" not in shown, words
        assert not any(each in shown for each in ("<bool>", "<path>", "<int", "<float>", "Path]"))
        every = " ".join(shown.replace("│", " ").split())
        for parameter in command.get_params(typer.Context(command, info_name=words)):
            assert all(option in every for option in parameter.opts if "-" in option), words
            lost = set((parameter.help or "").split()) - set(every.split())
            assert not lost, (words, lost)


def test_help_of_every_command_has_an_example(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, command in commands():
        assert f"trainlog {words}" in (command.help or ""), words


def test_the_same_option_is_the_same_everywhere() -> None:
    seen = defaultdict(set)
    for words, command in commands():
        context = typer.Context(command, info_name=words)
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
def test_a_word_alone_shows_the_help_of_its_commands(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status, shown, complaint = run(monkeypatch, capsys, *words)
    assert (status, complaint) == (0, "")
    assert " ".join(["Usage: trainlog", *words]) in " ".join(shown.split())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["fit", "x"], "Missing option '--output' / '-o'; for example: trainlog fit results/trips"),
        (["map", "update", "x"], "for example: trainlog map update results/trips --map"),
        (["advice"], "Missing argument 'TRAJECTORIES'; for example: trainlog advice results/"),
        (["pln", "x"], "No such command 'pln'. Did you mean 'plan'?"),
        (["optimise", "x"], "'optimise' is now 'trainlog plan'"),
        (["catalogue", "list"], "'catalogue list' is now 'trainlog fleet show'"),
        (["fleet", "status"], "'fleet status' is now 'trainlog fleet show'"),
        (["simulate", "--count", "2"], "'simulate' is now 'trainlog simulate drive"),
        (["map", "udate"], "Did you mean 'update'?; see 'trainlog map --help'"),
        (["fit", "x", "--cvr", "3"], "No such option: --cvr (Possible options: --cover)"),
    ],
)
def test_wrong_words_are_answered_with_what_was_meant(
    words: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    status, shown, complaint = run(monkeypatch, capsys, *words)
    assert (status, shown, complaint.count("\n")) == (2, "", 1)
    assert message in complaint
    assert "--help'" in complaint
