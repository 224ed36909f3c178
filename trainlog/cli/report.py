"""Reports on results: report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainlog.cli.terminal import console

app = typer.Typer()


@app.command(rich_help_panel="Look")
def report(
    results: Annotated[Path, typer.Argument(help="Folder of results, as the demo leaves it.")],
) -> None:
    """Sum up a folder of results: fit, map, trajectory, energy; simulated trips against the truth.

    Example: trainlog report results
    """
    from analysis.reports.summary import report as summed_up, report_table

    console.print(report_table(summed_up(results)))
