"""Reports to send and to print: report, driver-advice."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainlog.cli.options import ChosenTrips, destination
from trainlog.cli.terminal import console, print_error, state, working, wrote
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
        ChosenTrips,
    ] = None,
    zone: Annotated[
        str, typer.Option(help="Zone of the timetable, in which times are stated: Europe/Zurich.")
    ] = "UTC",
) -> None:
    """Write a report as one HTML page that needs no network: to send, to read, to print.

    Tables, pictures and charts of a result with what it was made of; light or dark as the reader's
    screen, printed on A4. Of a folder everything that is in it; a file that cannot be read is
    listed there, and the exit status is 1. Without -o the summary of a folder is printed: fit, map,
    trajectory, energy; simulated trips against the truth.

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
        found = summed_up(results)
        if not state(found.details()):
            console.print(report_table(found))
        return
    destination(output, ".html")

    from analysis.reports.build import ReportOptions, write_report
    from analysis.reports.trip import known_zone

    known = known_zone(zone)
    with working(f"report on {results.name}"):
        page = write_report(results, output, ReportOptions(line, tuple(logs or ()), known))
    titles = [each.title for each in page.sections]
    state({"title": page.title, "sections": titles, "problems": page.problems})
    wrote(output)
    for words in page.problems:
        print_error(f"not shown: {words}")
    if page.problems:
        raise typer.Exit(1)


@app.command("driver-advice", rich_help_panel="Plan")
def driver_advice(
    trajectories: Annotated[
        list[Path],
        typer.Argument(
            help="Trajectory file, or those of a journey's sections (optimise --journey)."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="The page (.html); the CSV is written beside it."),
    ],
    departure: Annotated[
        str | None,
        typer.Option(
            help="Time of day of the first departure, 07:12; default: times since departure."
        ),
    ] = None,
    line: Annotated[
        Path | None,
        typer.Option("--line", help="Line file, where the line is not among the samples."),
    ] = None,
    dwell: Annotated[
        float,
        typer.Option(
            min=0.0, help="Standing time at stops (s), of sections planned one by one; default: 0."
        ),
    ] = 0.0,
) -> None:
    """Write the driver's advice for a whole journey: one page to print, and one CSV.

    Stations with arrival and departure in the clock of the timetable; where to drive, to hold which
    speed, to coast and to brake, by kilometre and by the nearest station.

    Example: trainlog driver-advice results/trajectory.json --departure 07:12 -o advice.html
    """
    destination(output, ".html")

    from analysis.reports.advice import write_driver_advice
    from analysis.trajectory.advice import driver_table, time_of_day

    start = None if departure is None else time_of_day(departure)
    table = output.with_suffix(".csv")
    with working("writing the advice"):
        found = write_driver_advice(
            trajectories, output, table, line=line, start=start, dwell=dwell
        )
    if not state(found.details()):
        console.print(driver_table(found))
    wrote(output, table)
