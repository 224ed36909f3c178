"""Commands of a fleet: its catalogue, and what is computed of the trips in it.

Parameters
----------
analysis : ANALYSIS
    Only this analysis; may be given several times. Default: all of them.
workers : N
    Processes; default: one a processor. 0: this process itself.
from_ : TIME
    Only trips that start then or later: 2026-10-01.
to : TIME
    Only trips that start until then; a day counts whole.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from trainlog.cli.options import POSITIVE, Count, destination
from trainlog.cli.terminal import (
    as_json_text,
    console,
    current,
    print_error,
    print_warning,
    say,
    show,
    state,
    wrote,
)
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.progress import task
from trainlog.units import COUNT, PERCENT

if TYPE_CHECKING:
    import pandas as pd

    from analysis.fleet.update import Problem
    from trainlog.catalogue import Catalogue, FileOutcome

fleet_app = typer.Typer(
    add_completion=False, help="The catalogue of a fleet, and what is computed of its trips."
)


@fleet_app.command("add")
def fleet_add(
    paths: list[Path],
    /,
    *,
    catalogue: str | None = None,
    results: Path | None = None,
    jobs: Count = None,
) -> None:
    """Register logs by their content; the catalogue is made if there is none.

    Of a log its summary and what identifies the drive are read; a file that is known and has not
    changed is not read again. A file that moved is found by its content. Of several files of one
    drive the fullest counts. Several processes may add at once; one that is interrupted or killed
    leaves nothing half.

    Exit status 1 if some files could not be used; 2 if none could.

    Example: trainlog fleet add results/trips

    Example: trainlog fleet add /data/2026 --catalogue postgresql://fleet@server/trains

    Parameters
    ----------
    paths : PATHS
        Logs (.mcap), or folders: those in them are searched, too.
    results : FOLDER
        Folder for the results of a new catalogue in PostgreSQL.
    """
    from trainlog.catalogue import open_catalogue
    from trainlog.catalogue.registration import logs_named

    logs_named(paths)  # a path that does not exist is named before a catalogue is made
    done = Counter[str]()

    def report(outcome: FileOutcome, number: int, total: int) -> None:
        done[outcome.state] += 1
        step(number, total)
        if outcome.state == "refused":
            print_error(f"{outcome.path}: {outcome.reason}")

    output = current()
    output.finished = lambda: f"{counted(done.total() - done['refused'], 'log')} registered"
    with (
        open_catalogue(catalogue, results=results) as opened,
        task("registering", unit="log") as step,
    ):
        added = opened.add(paths, report, jobs=jobs or os.cpu_count() or 1)
    state({"catalogue": opened.place})
    show(added)
    if refused := added.of("refused"):
        raise typer.Exit(2 if len(refused) == len(added.outcomes) else 1)


@fleet_app.command("show")
def fleet_show(
    *,
    catalogue: str | None = None,
    by: Literal["route", "train", "kind", "line", "edge", "day", "weather"] = "route",
    problems: bool = False,
    trips: str | None = None,
    analysis: list[str] | None = None,
) -> None:
    """Show how many trips there are, what is computed of them, and what is pending.

    Trips, trains and lines are counted, distance and time driven are summed. Of an edge the
    distance is that on it; forward and reverse count how often it was run over. --trips and
    --analysis choose of what the results are counted.

    Example: trainlog fleet show --by edge

    Example: trainlog fleet show --problems

    Parameters
    ----------
    by : NAME
        One row per train and line (route), train, kind of trains, line, edge (each line that trips
        ran over, whatever their route), day, or weather. Their names are what fleet query takes.
    problems
        List the files that do not count, with the reason (copies, other recordings of a drive,
        older versions, vanished and refused files), damaged logs that count, and the trips that
        gave no result.
    """
    from analysis.catalogue_table import overview_table, problems_table
    from analysis.fleet.update import fleet_status
    from trainlog.catalogue import open_catalogue

    with open_catalogue(catalogue, create=False) as opened:
        counts = opened.counts()
        shown = problems_table(opened) if problems else overview_table(opened, by)
        about = {"version": opened.version, "migrated": opened.migrated_from is not None}
        found = fleet_status(opened, analysis, where=trips)
        state({"catalogue": opened.place, **about, "counts": counts})
    whole = problems and not shown.rows and not current().as_json
    console.print("every file counts, and no log is damaged" if whole else shown)
    words = ", ".join(f"{count:,} {name}" for name, count in counts.items() if count)
    console.print(words or "no trips")
    show(found, also=["problems"] if problems else [])


@fleet_app.command("query")
def fleet_query(
    asked: str | None = None,
    /,
    *,
    catalogue: str | None = None,
    train: str | None = None,
    line: str | None = None,
    from_: str | None = None,
    to: str | None = None,
    zone: str | None = None,
    most: Count = None,
    paths: bool = False,
    output: Path | None = None,
) -> None:
    """List the trips that are asked for, in the order of their start; or ask by SQL.

    An expression compares columns with values: [bold]train, kind, line, start, duration, km_from,
    weather, load ...[/bold] by = <> < <= > >= in, like, between, is null, joined by and, or, not.
    Values with a unit are written with it: '20 min', '15 t'. docs/catalogue.md lists all.

    Tables of SQL: [bold]trips, files, edges[/bold], and one of each analysis ([bold]resistance,
    driving ...[/bold]) with its latest results of each trip that counts; [bold]key[/bold] joins
    them. Times are UTC, numbers in SI units but kilometres. Nothing can be changed. DuckDB runs it:
    its dialect is understood.

    Example: trainlog fleet query --train flirt-03 --from 2026-10-01 --to 2026-10-31

    Example: trainlog fleet query "weather = 'wet' and duration > '20 min'" -o wet.csv

    Example: trainlog fleet query "select train, avg(r0) from resistance join trips using (key)
    group by train"

    Parameters
    ----------
    asked : EXPRESSION
        Trips of which it holds: "weather = 'wet' and duration > '20 min'"; or a whole statement of
        SQL: "select ..."; 'tables' lists its tables and columns. Default: all trips.
    train : NAME
        Only of this train.
    line : NAME
        Only on this line; of a route each line it runs over counts.
    most : N
        List at most so many rows; default: 50 on a terminal.
    paths
        Print the paths of the logs alone, one per line.
    output : FILE
        Table to write, with all rows in SI units (.csv, .parquet); of SQL .csv.
    """
    from analysis.catalogue_table import found_table, trips_table
    from trainlog.catalogue import open_catalogue, write_trips
    from trainlog.formats.files import csv_bytes, write_bytes

    limits: dict[str, Any] = {"train": train, "line": line, "start": from_, "end": to}
    by_sql = asked is not None and re.match(r"(?i)\s*(select|with)\b|tables$", asked) is not None
    for name, value in {**limits, "zone": zone, "paths": paths or None}.items():
        if by_sql and value is not None:
            raise InputError(
                f"--{name} is for an expression, not for a whole statement of SQL",
                remedy="say it in the statement",
            )
    with open_catalogue(catalogue, create=False) as opened:
        if paths:
            logs = opened.paths(asked, zone=zone, **limits)
            if not state({"paths": logs}):
                console.print(*logs, sep="\n", soft_wrap=True)
            return
        if asked is not None and by_sql:
            found = opened.tables() if asked == "tables" else opened.sql(asked)
        else:
            found = _chosen(opened, asked, zone, limits)
    state({"count": len(found)})
    if output is not None:
        if by_sql:
            write_bytes(destination(output, ".csv"), csv_bytes(found))
        else:
            write_trips(found, output)
        console.print(counted(len(found), "row" if by_sql else "trip"))
        wrote(output)
        return
    if most is None and console.is_terminal and not current().as_json and asked != "tables":
        most = SHOWN
    shown = found.iloc[:most]
    console.print((found_table if by_sql else trips_table)(shown, len(found)))
    if len(shown) < len(found):
        console.print(f"and {len(found) - len(shown):,} more (--most lists more of them)")


def _chosen(
    catalogue: Catalogue, where: str | None, zone: str | None, limits: dict[str, Any]
) -> pd.DataFrame:
    """The trips that are asked for; where there is none, a train or line unknown is refused."""
    found = catalogue.query(where, zone=zone, **limits)
    if len(found):
        return found
    if why := catalogue.unmatched(None, limits["train"], limits["line"]):
        raise InputError(
            "; ".join(why),
            file=catalogue.place,
            remedy="'trainlog fleet show' shows which trains and lines there are",
        )
    for each in catalogue.unmatched(where):
        print_warning(each)
    return found


SHOWN = 50
"""Trips that are listed on a terminal."""


@fleet_app.command("update")
def fleet_update(
    *,
    catalogue: str | None = None,
    trips: str | None = None,
    analysis: list[str] | None = None,
    workers: Annotated[int | None, COUNT.between(0.0)] = None,
    scheduler: str | None = None,
    mpi: bool = False,
    batch: Annotated[int, POSITIVE] = 16,
    retry: bool = False,
) -> None:
    """Compute what is new in the catalogue, or was made by other code; nothing else.

    Of each trip: the summary of its fit, its passport, the evidence for the track-condition map,
    times and energy by edge, and what of its recording is doubtful. Results are kept as they come:
    after an interruption, however it came, the next update goes on with the rest.

    Trips of which an analysis gives no result are listed with the reason; of more than a few those
    of one reason are counted ('trainlog fleet show --problems' lists each). Exit status 1 if one
    failed, or a log could not be read.

    Example: trainlog fleet update --workers 2

    Parameters
    ----------
    scheduler : ADDRESS
        Dask scheduler whose workers compute, such as tcp://host:8786; they must see the logs.
    mpi
        The workers of an MPI job: mpiexec -n 3 python -m mpi4py.futures -m trainlog fleet update
        --mpi.
    batch : N
        Most trips that a worker is given at once.
    retry
        Compute trips again that were refused, or failed, or whose file of results is damaged.
    """
    from analysis.fleet.update import FIRST, UpdateOptions, fleet_status, gone_words, update_fleet
    from trainlog.catalogue import open_catalogue

    options = UpdateOptions(workers, scheduler, mpi, batch=batch, where=trips, retry=retry)
    seen = set[str]()

    def report(problem: Problem) -> None:
        if problem.state != "refused":
            print_error(f"{problem.path}: {problem.analysis} {problem.state}: {problem.reason}")
        seen.add(problem.key)

    with open_catalogue(catalogue, create=False) as opened:
        before = fleet_status(opened, analysis, where=trips, most=0)
        if before.pending and not current().as_json:
            gone = f"; {gone_words(before.gone)}" if before.gone else ""
            words = f"{counted(before.pending, 'trip')} to compute{gone}; {FIRST}"
            say(words)
        current().finished = lambda: "each batch that was finished is kept; update again"
        found = update_fleet(opened, analysis, options, report)
        current().finished = None
    show(found)
    if not current().as_json:
        more = len(seen) - len({each.key for each in found.problems})
        if more > 0:
            console.print(f"and {counted(more, 'trip')} more: trainlog fleet show --problems")
    if found.unread or any(each.failed for each in found.counts.values()):
        raise typer.Exit(1)


@fleet_app.command("trains")
def fleet_trains(
    *,
    output: Path,
    catalogue: str | None = None,
    kind: str | None = None,
    train: str | None = None,
    trips: str | None = None,
    false_alarms: Annotated[float | None, PERCENT.above(0.0, 0.2)] = None,
) -> None:
    """Show resistance, drift and findings of every train: which ones are not like the others.

    From the results of 'trainlog fleet update'. Each finding names the fault, since when and how
    large, with its band; what would not be seen is stated by train.

    Example: trainlog fleet trains -o results/fleet-trains

    Parameters
    ----------
    output : FOLDER
        Folder for JSON and pictures.
    kind : NAME
        Only trains of this kind.
    train : NAME
        Show only this train, compared with the others.
    false_alarms : SHARE
        Share of healthy trains that raise an alarm in a month; default: 1%.
    """
    from analysis.charts import draw_charts
    from analysis.fleet.plot import (
        channels_over_time,
        drift_charts,
        findings_charts,
        resistance_charts,
    )
    from analysis.fleet.trains import trains_in
    from trainlog.catalogue import open_catalogue
    from trainlog.formats.files import atomic_write, output_folder

    with open_catalogue(catalogue) as known:
        found = trains_in(
            known, kind=kind, where=trips, rate=0.01 if false_alarms is None else false_alarms
        )
    shown = found if train is None else found.only(train)
    written = []
    with output_folder(output):
        path = output / "trains.json"
        with atomic_write(path) as temporary:
            temporary.write_text(as_json_text(shown.details()) + "\n", "utf-8")
        written.append(path)
        for each in shown.resistance:
            written.append(output / f"{each.kind}.resistance.png")
            draw_charts(resistance_charts(each, shown), written[-1])
            if channels_over_time(each.kind, shown):
                written.append(output / f"{each.kind}.drift.png")
                draw_charts(drift_charts(each.kind, shown), written[-1])
        written.append(output / "findings.png")
        draw_charts(findings_charts(shown), written[-1])
    show(shown)
    wrote(*written)


@fleet_app.command("diff")
def fleet_diff(
    first: str,
    second: str,
    /,
    *,
    catalogue: str | None = None,
    trips: str | None = None,
    analysis: list[str] | None = None,
    output: Path | None = None,
    workers: Annotated[int | None, COUNT.between(0.0)] = None,
) -> None:
    """List every estimate that moved between two versions of the code or two sets of parameters.

    The results of another version are those that its own fleet update left in the catalogue; what
    this version has not computed yet is computed. An estimate moved beyond its band where the
    difference exceeds 1.96 standard deviations; of many trips the mean shift is judged by its own
    scatter. Trips that one side alone accepts are listed. Exit status 1 if anything moved beyond
    its band.

    Example: trainlog fleet diff 8dfc3ada now --trips "line = 'Wil - Gossau'" -o changes

    Example: trainlog fleet diff now resistance.largest_std=0.2

    Parameters
    ----------
    first : FIRST
        now, the beginning of a version of which the catalogue has results, or parameters:
        adhesion.bin_length=50.
    second : SECOND
        The same, of the other side.
    output : FOLDER
        Folder for the report and all tables as CSV.
    """
    from analysis.fleet.diff import fleet_diff as compare
    from trainlog.catalogue import open_catalogue

    with open_catalogue(catalogue, create=False) as opened:
        found = compare(opened, first, second, analyses=analysis, where=trips, workers=workers)
    if output is not None:
        from analysis.reports.fleet import write_diff

        wrote(*write_diff(found, output))
    show(found)
    if found.beyond:
        raise typer.Exit(1)


@fleet_app.command("refresh")
def fleet_refresh(folders: list[Path] | None = None, /, *, catalogue: str | None = None) -> None:
    """Compare the catalogue with the disk: which files vanished, moved, changed or came back.

    Nothing is forgotten: a vanished file is found again by its content once the folder that it
    moved to is given. Exit status 1 if files have vanished.

    Example: trainlog fleet refresh

    Example: trainlog fleet refresh /archive

    Parameters
    ----------
    folders : FOLDERS
        Folders that are searched for files that moved.
    """
    from trainlog.catalogue import open_catalogue

    with open_catalogue(catalogue, create=False) as opened:
        found = opened.refresh(folders or ())
    refused = [each for each in found.outcomes if each.state == "refused"]
    for each in refused:
        print_error(f"{each.path}: {each.reason}")
    show(found)
    if found.vanished or refused:
        raise typer.Exit(1)


@fleet_app.command("remove")
def fleet_remove(
    where: str | None = None, /, *, catalogue: str | None = None, vanished: bool = False
) -> None:
    """Forget trips and what was computed of them; the logs stay as they are.

    A log that still stands in a folder that is added comes back.

    Example: trainlog fleet remove --vanished

    Example: trainlog fleet remove "train = 'test'"

    Parameters
    ----------
    where : EXPRESSION
        Trips of which it holds.
    vanished
        Only trips whose logs have all vanished.
    """
    from trainlog.catalogue import open_catalogue

    if where is None and not vanished:
        raise InputError(
            "nothing says which trips are to be removed", remedy="give an expression or --vanished"
        )
    with open_catalogue(catalogue, create=False) as opened:
        removed = opened.remove(where, vanished=vanished)
    state({"removed": removed})
    console.print(f"{counted(removed, 'trip')} removed")
