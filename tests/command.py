"""A command of trainlog in the process of the tests, as a user meets it."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest

from trainlog.cli import main as cli

Shell = Callable[..., tuple[int, str, str]]
"""Runs the words of a command: its exit status, standard output and standard error."""


def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object
) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of one command."""
    monkeypatch.setattr(sys, "argv", ["trainlog", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    captured = capsys.readouterr()
    return int(ended.value.code or 0), captured.out, captured.err
