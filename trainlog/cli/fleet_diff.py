"""What changed between two versions over a fleet: fleet diff."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainlog.cli.fleet import AnalysesOption, TripsOption, fleet_app
from trainlog.cli.options import CatalogueOption
from trainlog.cli.terminal import console, state, wrote

app = typer.Typer()


@fleet_app.command("diff")
def fleet_diff(
    first: Annotated[
        str,
        typer.Argument(
            help="now, a revision, a folder with another checkout, the Python of another"
            " environment, a version of results, or parameters: adhesion.bin_length=50."
        ),
    ],
    second: Annotated[str, typer.Argument(help="The same, of the other side.")],
    catalogue: CatalogueOption = None,
    trips: TripsOption = None,
    analyses: AnalysesOption = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder for the report and all tables as CSV."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=0, help="Processes; default: one a processor. 0: this process itself."),
    ] = None,
) -> None:
    """List every estimate that moved between two versions of the code or two sets of parameters.

    Both sides compute the same trips; what of either is in the catalogue is not computed again, and
    what is computed is kept there. An estimate moved beyond its band where the difference exceeds
    1.96 standard deviations; of many trips the mean shift is judged by its own scatter. Trips that
    one side alone accepts are listed. Exit status 1 if anything moved beyond its band.

    Example: trainlog fleet diff v0.1.0 now --trips "line = 'Wil - Gossau'" -o changes

    Example: trainlog fleet diff now resistance.largest_std=0.2
    """
    from analysis.fleet.diff import fleet_diff as compare
    from analysis.fleet.diff_table import details, sentence, tables
    from trainlog.catalogue import open_catalogue

    with open_catalogue(catalogue, create=False) as opened:
        found = compare(
            opened, first, second, analyses=analyses, where=trips, place=catalogue, workers=workers
        )
    if output is not None:
        from analysis.reports.fleet_diff import write_diff

        wrote(*write_diff(found, output))
    if not state(details(found)):
        console.print(*tables(found), sep="\n")
        console.print(f"{sentence(found)}.", highlight=False, soft_wrap=True)
    if found.beyond:
        raise typer.Exit(1)
