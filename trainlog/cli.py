"""The command line: one command per verb, no logic."""

from __future__ import annotations

import typer

app = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")


@app.callback()
def _main() -> None:
    """Record train trips in a standard log, learn from them, and plan robust trajectories."""


def main() -> None:
    """Entry point of the ``trainlog`` command."""
    app()
