"""Commands of a fleet: its catalogue, and what is computed of the trips in it.

Parameters
----------
analysis : ANALYSIS
    Only this analysis; may be given several times. Default: all of them.
workers : N
    Processes; default: one per processor. 0: this process.
from_ : TIME
    Only trips that start at this time or later: 2026-10-01.
to : TIME
    Only trips that start up to this time; a date includes the whole day.
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
    add_completion=False, help="The catalogue of a fleet, and the results of its trips."
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
    """Register logs by their content; the catalogue is created if missing.

    Reads the summary of each log and the samples that identify the drive; known, unchanged files
    are not read again. Moved files are found by their content. Of several files of one drive the
    fullest counts. Several processes may add at once; an interruption leaves no partial entry.

    Exit status 1 if some files could not be used; 2 if none could.

    Example: trainlog fleet add results/trips

    Example: trainlog fleet add /data/2026 --catalogue postgresql://fleet@server/trains

    Parameters
    ----------
    paths : PATHS
        Logs (.mcap), or folders, including subfolders.
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
    """Show the number of trips, their results, and pending analyses.

    Counts trips, trains and lines; sums distance and time. For an edge, the distance on it, and the
    runs forward and reverse. --trips and --analysis limit the results that are counted.

    Example: trainlog fleet show --by edge

    Example: trainlog fleet show --problems

    Parameters
    ----------
    by : NAME
        One row per train and line (route), train, kind of train, line, edge (each line that trips
        used, whatever their route), day, or weather. 'fleet query' accepts these names.
    problems
        List files that do not count, with the reason (copies, other recordings of a drive, older
        versions, missing and refused files), damaged logs that count, and trips without a result.
    """
    from analysis.fleet.update import fleet_status
    from trainlog.catalogue import open_catalogue
    from trainlog.catalogue.querying import overview_table, problems_table

    with open_catalogue(catalogue, create=False) as opened:
        counts = opened.counts()
        shown = problems_table(opened) if problems else overview_table(opened, by)
        about = {"version": opened.version, "migrated": opened.migrated_from is not None}
        found = fleet_status(opened, analysis, where=trips)
        state({"catalogue": opened.place, **about, "counts": counts})
    whole = problems and not shown.rows and not current().as_json
    console.print("every file counts, and no log is damaged" if whole else shown)
    words = ", ".join(f"{count:,} {name}" for name, count in counts.items() if count)
    if not problems and (counts.get("refused") or counts.get("vanished")):
        words += "; 'trainlog fleet show --problems' lists these files"
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
    """List trips that satisfy a condition, in order of their start; or run SQL.

    An expression compares columns with values: [bold]train, kind, line, start, duration, km_from,
    weather, load ...[/bold] by = <> < <= > >= in, like, between, is null, joined by and, or, not.
    Values with a unit need it: '20 min', '15 t'. docs/catalogue.md lists all.

    Tables of SQL: [bold]trips, files, edges[/bold], and one per analysis ([bold]resistance, driving
    ...[/bold]) with the latest results of each counted trip; [bold]key[/bold] joins them. Times are
    UTC, numbers in SI units, except kilometres. SQL is read-only, in the dialect of DuckDB.

    Example: trainlog fleet query --train flirt-03 --from 2026-10-01 --to 2026-10-31

    Example: trainlog fleet query "weather = 'wet' and duration > '20 min'" -o wet.csv

    Example: trainlog fleet query "select weather, avg(r0) from resistance join trips using (key)
    group by weather"

    Parameters
    ----------
    asked : EXPRESSION
        Condition: "weather = 'wet' and duration > '20 min'"; or SQL: "select ..."; 'tables' lists
        tables and columns. Default: all trips.
    train : NAME
        Only of this train.
    line : NAME
        Only on this line; each line of a route counts.
    most : N
        Maximum number of rows; default: 50 on a terminal.
    paths
        Print only the paths of the logs, one per line.
    output : FILE
        Table to write, with all rows in SI units (.csv, .parquet; SQL: .csv).
    """
    from trainlog.catalogue import open_catalogue, write_trips
    from trainlog.catalogue.querying import found_table, trips_table
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
    """Compute results of the catalogue that are new, or were made by other code.

    Per trip: summary of its fit, passport, evidence for the track-condition map, times and energy
    by edge, doubts about the recording. Results are stored as they come: after any interruption the
    next update continues.

    Trips without a result are listed with the reason; if one reason is common, its trips are
    counted ('trainlog fleet show --problems' lists each). Exit status 1 if an analysis failed, or a
    log could not be read.

    Example: trainlog fleet update --workers 2

    Parameters
    ----------
    scheduler : ADDRESS
        Dask scheduler of the workers, such as tcp://host:8786; the workers need access to the logs.
    mpi
        The workers of an MPI job: mpiexec -n 3 python -m mpi4py.futures -m trainlog fleet update
        --mpi.
    batch : N
        Maximum number of trips per batch.
    retry
        Compute refused and failed trips again, and damaged files of results.
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
    """Show running resistance, drift and faults of each train, compared with its kind.

    Uses the results of 'trainlog fleet update'. Each finding states fault, date and size with its
    band; each train has its detection limits.

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
        Share of healthy trains with an alarm per month; default: 1%.
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
    """List estimates that differ between two versions of the code or two sets of parameters.

    The results of another version are those that its fleet update left in the catalogue; missing
    results of this version are computed. A difference is beyond its band if it exceeds 1.96
    standard deviations; the mean of many trips is judged by its own scatter. Trips that only one
    side accepts are listed. Exit status 1 if a difference is beyond its band.

    Example: trainlog fleet diff 8dfc3ada now --trips "line = 'Wil - Gossau'" -o changes

    Example: trainlog fleet diff now resistance.largest_std=0.2

    Parameters
    ----------
    first : FIRST
        now, the beginning of a version with results in the catalogue, or parameters:
        adhesion.bin_length=50.
    second : SECOND
        The same for the other side.
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
    """Compare the catalogue with the disk: missing, moved, changed and restored files.

    Nothing is removed: give the new folder, and moved files are found by their content. Exit status
    1 if files are missing.

    Example: trainlog fleet refresh

    Example: trainlog fleet refresh /archive

    Parameters
    ----------
    folders : FOLDERS
        Folders to search for moved files.
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
    """Remove trips and their results from the catalogue; the logs stay unchanged.

    A log that is still in a registered folder returns with the next 'fleet add'.

    Example: trainlog fleet remove --vanished

    Example: trainlog fleet remove "train = 'test'"

    Parameters
    ----------
    where : EXPRESSION
        Condition of the trips to remove.
    vanished
        Only trips without any remaining log.
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
