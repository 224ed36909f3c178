"""Help of all commands: readable at 80 columns, in words of the field, the same everywhere."""

import shlex
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
import typer

from trainlog.cli import main as cli
from trainlog.cli.commands import FORMER, WORDS

DOCS = Path(__file__).parents[1] / "docs"
sys.path.insert(0, str(DOCS / "tools"))

from options import commands, context_of, own_options, with_options  # noqa: E402

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


def examples(command: Any) -> list[list[str]]:
    return [
        shlex.split(each.removeprefix("Example: trainlog "))
        for each in (command.help or "").split("\n\n")
        if each.startswith("Example: trainlog ")
    ]


@pytest.mark.parametrize("words", [words for words, _ in commands()])
def test_each_command_has_an_example_that_parses_and_twelve_options(words, tmp_path, monkeypatch):
    (tmp_path / "results").mkdir()
    monkeypatch.chdir(tmp_path)
    command = dict(commands())[words]
    found = examples(command)
    assert found
    for example in found:
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
