"""The commands of the catalogue: add, list, query, sql, export, refresh, remove."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from trainlog.cli.options import CatalogueOption, ZoneOption
from trainlog.cli.terminal import console, current, print_error, print_warning, state, wrote
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.progress import task

if TYPE_CHECKING:
    import pandas as pd

    from trainlog.catalogue import Catalogue, FileOutcome

app = typer.Typer()
catalogue_app = typer.Typer(
    no_args_is_help=True, help="The catalogue of a fleet: which trips there are, and where."
)
app.add_typer(catalogue_app, name="catalogue", rich_help_panel="Record")

TrainName = Annotated[
    str | None, typer.Option("--train", metavar="NAME", help="Only of this train.")
]
LineName = Annotated[
    str | None,
    typer.Option(
        "--line",
        metavar="NAME",
        help="Only on this line; of a route each line it runs over counts.",
    ),
]
Since = Annotated[
    str | None,
    typer.Option("--from", help="Only trips that start then or later: 2026-10-01.", metavar="TIME"),
]
Until = Annotated[
    str | None,
    typer.Option(
        "--to", help="Only trips that start until then; a day counts whole.", metavar="TIME"
    ),
]
Where = Annotated[
    str | None,
    typer.Option(
        metavar="EXPRESSION",
        help="Only trips of which it holds: \"weather = 'wet' and duration > '20 min'\".",
    ),
]


@catalogue_app.command("add")
def catalogue_add(
    paths: Annotated[
        list[Path],
        typer.Argument(help="Logs (.mcap), or folders: those in them are searched, too."),
    ],
    catalogue: CatalogueOption = None,
    results: Annotated[
        Path | None,
        typer.Option(help="Folder for the results of a new catalogue in PostgreSQL."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes that read; default: one a processor.")
    ] = None,
) -> None:
    """Register logs by their content; the catalogue is made if there is none.

    Of a log its summary and what identifies the drive are read; a file that is known and has not
    changed is not read again. A file that moved is found by its content. Of several files of one
    drive the fullest counts. Several processes may add at once; one that is interrupted or killed
    leaves nothing half.

    Exit status 1 if some files could not be used; 2 if none could.

    Example: trainlog catalogue add results/trips

    Example: trainlog catalogue add /data/2026 --catalogue postgresql://fleet@server/trains
    """
    from trainlog.catalogue import open_catalogue
    from trainlog.catalogue.adding import logs_below

    logs_below(paths)  # a path that does not exist is named before a catalogue is made
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
    refused = added.of("refused")
    content = {
        "catalogue": opened.place,
        "counts": added.counts,
        "damaged": [
            {"path": each.path, "damage": each.damage} for each in added.outcomes if each.damage
        ],
        "refused": [{"path": each.path, "reason": each.reason} for each in refused],
    }
    if not state(content):
        for each in added.outcomes:
            if each.damage:
                console.print(
                    f"damaged: {each.path}: {each.damage}", highlight=False, soft_wrap=True
                )
        console.print(added.sentence, highlight=False, soft_wrap=True)
    if refused:
        raise typer.Exit(2 if len(refused) == len(added.outcomes) else 1)


@catalogue_app.command("list")
def catalogue_list(
    catalogue: CatalogueOption = None,
    by: Annotated[
        Literal["route", "train", "kind", "line", "edge", "day", "weather"],
        typer.Option(
            help="What has a row: a train and line (route), a train, a kind of trains, a line, an"
            " edge (each line that trips ran over, whatever their route), a day, or a weather."
            " Their names are what --train, --line and --where take."
        ),
    ] = "route",
    problems: Annotated[
        bool,
        typer.Option(
            "--problems",
            help="List the files that do not count, with the reason: copies, other recordings of a"
            " drive, older versions, vanished and refused files; and damaged logs that count.",
        ),
    ] = False,
) -> None:
    """List how many trips there are by train and line, and how many files do not count.

    Trips, trains and lines are counted, distance and time driven are summed. Of an edge the
    distance is that on it; forward and reverse count how often it was run over.

    Example: trainlog catalogue list

    Example: trainlog catalogue list --by edge
    """
    from analysis.catalogue_table import overview_table, problems_table
    from trainlog.catalogue import open_catalogue

    with open_catalogue(catalogue, create=False) as opened:
        counts = opened.counts()
        shown = problems_table(opened) if problems else overview_table(opened, by)
        about = {"version": opened.version, "migrated": opened.migrated_from is not None}
        as_json = state({"catalogue": opened.place, **about, "counts": counts})
    if shown.rows or as_json or not problems:
        console.print(shown)
    else:
        console.print("every file counts, and no log is damaged")
    words = ", ".join(f"{count:,} {name}" for name, count in counts.items() if count)
    console.print(words or "no trips", highlight=False)


@catalogue_app.command("query")
def catalogue_query(
    catalogue: CatalogueOption = None,
    train: TrainName = None,
    line: LineName = None,
    since: Since = None,
    until: Until = None,
    where: Where = None,
    zone: ZoneOption = None,
    most: Annotated[
        int | None, typer.Option(min=1, help="List at most so many; default: 50 on a terminal.")
    ] = None,
    paths: Annotated[
        bool, typer.Option("--paths", help="Print the paths of the logs alone, one a line.")
    ] = False,
) -> None:
    """List the trips that are asked for, in the order of their start.

    The expression compares columns with values: [bold]train, kind, line, start, duration, km_from,
    weather, load ...[/bold] by = <> < <= > >= in, like, between, is null, joined by and, or, not.
    Values with a unit are written with it: '20 min', '15 t'. docs/catalogue.md lists all.

    Example: trainlog catalogue query --train flirt-03 --from 2026-10-01 --to 2026-10-31

    Example: trainlog catalogue query --where "weather = 'wet' and duration > '20 min'"
    """
    from analysis.catalogue_table import trips_as_data, trips_table
    from trainlog.catalogue import open_catalogue

    limits: dict[str, Any] = {"train": train, "line": line, "start": since, "end": until}
    with open_catalogue(catalogue, create=False) as opened:
        if paths:
            found = opened.paths(where, zone=zone, **limits)
            if not state({"paths": found}):
                for path in found:
                    console.print(str(path), highlight=False, soft_wrap=True)
            return
        frame = _chosen(opened, where, zone, limits)
    most = most or (SHOWN if console.is_terminal and not current().as_json else None)
    shown = frame if most is None else frame.iloc[:most]
    if state({"trips": trips_as_data(shown), "count": len(frame)}):
        return
    console.print(trips_table(shown, len(frame)))
    if most is not None and len(frame) > most:
        console.print(f"and {len(frame) - most:,} more (--most lists more of them)")


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
            remedy="'trainlog catalogue list' shows which trains and lines there are",
        )
    for each in catalogue.unmatched(where):
        print_warning(each)
    return found


SHOWN = 50
"""Trips that are listed on a terminal."""


@catalogue_app.command("sql")
def catalogue_sql(
    statement: Annotated[
        str | None,
        typer.Argument(help="Statement of SQL; without one the tables and columns are listed."),
    ] = None,
    catalogue: CatalogueOption = None,
    csv: Annotated[
        bool, typer.Option("--csv", help="Print all rows as CSV, in place of a table.")
    ] = False,
    most: Annotated[
        int | None,
        typer.Option(min=1, help="List at most so many rows; default: 50 on a terminal."),
    ] = None,
) -> None:
    """Ask the trips, and what was computed of them, by a statement of SQL.

    Tables: [bold]trips, files, edges[/bold], and one of each analysis ([bold]resistance, driving
    ...[/bold]) with its latest results of each trip that counts; [bold]key[/bold] joins them. Times
    are UTC, numbers in SI units but kilometres. Nothing can be changed. DuckDB runs it: its dialect
    is understood.

    Example: trainlog catalogue sql

    Example: trainlog catalogue sql "select train, avg(r0) from resistance join trips using (key)"
    """
    from analysis.catalogue_table import found_as_data, found_table
    from trainlog.catalogue import open_catalogue

    with open_catalogue(catalogue, create=False) as opened:
        frame = opened.tables() if statement is None else opened.sql(statement)
    if csv and not current().as_json:
        console.print(frame.to_csv(index=False).rstrip("\n"), markup=False, highlight=False,
                      soft_wrap=True)  # fmt: skip
        return
    terminal = console.is_terminal and not current().as_json and statement is not None
    most = most or (SHOWN if terminal else None)
    shown = frame if most is None else frame.iloc[:most]
    if state({**found_as_data(shown), "count": len(frame)}):
        return
    console.print(found_table(shown, len(frame)))
    if len(shown) < len(frame):
        console.print(f"and {len(frame) - len(shown):,} more (--most lists more of them)")


@catalogue_app.command("export")
def catalogue_export(
    output: Annotated[Path, typer.Argument(help="Table to write (.csv, .parquet).")],
    catalogue: CatalogueOption = None,
    train: TrainName = None,
    line: LineName = None,
    since: Since = None,
    until: Until = None,
    where: Where = None,
    zone: ZoneOption = None,
) -> None:
    """Write the trips that are asked for as a table: CSV or Parquet, in SI units.

    Example: trainlog catalogue export trips.parquet --where "month(start) in (12, 1, 2)"
    """
    from trainlog.catalogue import open_catalogue, write_trips

    limits: dict[str, Any] = {"train": train, "line": line, "start": since, "end": until}
    with open_catalogue(catalogue, create=False) as opened:
        frame = _chosen(opened, where, zone, limits)
    write_trips(frame, output)
    state({"trips": len(frame)})
    console.print(counted(len(frame), "trip"), highlight=False)
    wrote(output)


@catalogue_app.command("refresh")
def catalogue_refresh(
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Folders that are searched for files that moved.")
    ] = None,
    catalogue: CatalogueOption = None,
) -> None:
    """Compare the catalogue with the disk: which files vanished, moved, changed or came back.

    Nothing is forgotten: a vanished file is found again by its content once the folder that it
    moved to is given. Exit status 1 if files have vanished.

    Example: trainlog catalogue refresh

    Example: trainlog catalogue refresh /archive
    """
    from trainlog.catalogue import open_catalogue

    with open_catalogue(catalogue, create=False) as opened:
        found = opened.refresh(folders or ())
    refused = [each for each in found.outcomes if each.state == "refused"]
    content = {
        "same": found.same,
        "vanished": found.vanished,
        "moved": found.moved,
        "changed": found.changed,
        "back": found.back,
        "refused": [{"path": each.path, "reason": each.reason} for each in refused],
    }
    if not state(content):
        listed = {"vanished": found.vanished, "moved": found.moved, "changed": found.changed}
        for what, paths in listed.items():
            for path in paths:
                console.print(f"  {what}: {path}", highlight=False, soft_wrap=True)
        for each in refused:
            print_error(f"{each.path}: {each.reason}")
        console.print(found.sentence, highlight=False, soft_wrap=True)
    if found.vanished or refused:
        raise typer.Exit(1)


@catalogue_app.command("remove")
def catalogue_remove(
    catalogue: CatalogueOption = None,
    where: Where = None,
    vanished: Annotated[
        bool, typer.Option("--vanished", help="Only trips whose logs have all vanished.")
    ] = False,
) -> None:
    """Forget trips and what was computed of them; the logs stay as they are.

    A log that still stands in a folder that is added comes back.

    Example: trainlog catalogue remove --vanished

    Example: trainlog catalogue remove --where "train = 'test'"
    """
    from trainlog.catalogue import open_catalogue

    if where is None and not vanished:
        raise InputError(
            "nothing says which trips are to be removed", remedy="give --where or --vanished"
        )
    with open_catalogue(catalogue, create=False) as opened:
        removed = opened.remove(where, vanished=vanished)
    if not state({"removed": removed}):
        console.print(f"{counted(removed, 'trip')} removed", highlight=False)
