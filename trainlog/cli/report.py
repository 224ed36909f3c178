"""Reports on results: report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainlog.cli.options import destination
from trainlog.cli.terminal import console, working, wrote
from trainlog.errors import InputError

app = typer.Typer()


@app.command(rich_help_panel="Look")
def report(
    results: Annotated[
        Path,
        typer.Argument(
            help="A log (.mcap), parameter set, map (.map), trajectory or coast-down, the folder of"
            " a study, or a folder of results, as the demo leaves it."
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The page (.html); without it a folder is summed up."),
    ] = None,
    line: Annotated[
        Path | None,
        typer.Option(
            "--line", help="Line file of a map or trajectory whose line is not among the samples."
        ),
    ] = None,
    logs: Annotated[
        list[Path] | None,
        typer.Option(
            "--logs", help="Logs that a fit was made of, or their folder: shows the residuals."
        ),
    ] = None,
    zone: Annotated[
        str, typer.Option(help="Zone of the timetable, in which times are stated: Europe/Zurich.")
    ] = "UTC",
) -> None:
    """Write a report as one HTML page that needs no network: to send, to read, to print.

    Tables, pictures and charts of a result with what it was made of; light or dark as the reader's
    screen, printed on A4. Of a folder everything that is in it; a file that cannot be read is
    listed there. Without -o the summary of a folder is printed: fit, map, trajectory, energy;
    simulated trips against the truth.

    Example: trainlog report results/trips/trip-01.mcap -o trip-01.html

    Example: trainlog report results
    """
    if output is None:
        from analysis.reports.summary import report as summed_up, report_table

        if results.is_file():
            raise InputError(
                "is a file; without -o a folder is summed up",
                file=results,
                remedy="name the page: -o report.html",
            )
        console.print(report_table(summed_up(results)))
        return
    destination(output, ".html")

    from analysis.reports.build import ReportOptions, write_report
    from analysis.reports.trip import known_zone

    known = known_zone(zone)
    with working(f"report on {results.name}"):
        write_report(results, output, ReportOptions(line, tuple(logs or ()), known))
    wrote(output)
