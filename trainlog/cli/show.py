"""The command that states what a file holds."""

from __future__ import annotations

import json
from datetime import date, timedelta
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from trainlog.cli.options import logs_in
from trainlog.cli.terminal import console
from trainlog.display import counted

app = typer.Typer()

LogsOrConsists = Annotated[
    list[Path],
    typer.Argument(
        help="Logs (.mcap), folders of logs, consists (.consist.json), track-condition maps (.map)."
    ),
]


@app.command(rich_help_panel="Look")
def show(
    logs: LogsOrConsists,
    trips: Annotated[
        bool, typer.Option("--trips", help="List the trips of track-condition maps by name.")
    ] = False,
) -> None:
    """List what a log holds: topics, units, rates, time and position span, gaps, passport.

    Of a consist (.consist.json) its vehicles, couplers and brake; of a track-condition map
    (.map) its line, layers, trips and days; with --trips each recording by its name.

    Example: trainlog show results/trips/trip-01.mcap
    """
    from analysis.consist_table import consist_tables
    from trainlog.formats.attached import passport_of
    from trainlog.formats.train import read_consist
    from trainlog.mcap import describe, read_log
    from trainlog.mcap.description import render
    from trainlog.trip import PASSPORT_ATTACHMENT

    for log in logs_in(logs):
        if log.name.endswith(".consist.json"):
            console.print(consist_tables(read_consist(log)))
        elif log.suffix == ".map":
            console.print(_map_contents(log))
            if trips:
                console.print(_map_trips(log))
        else:
            description = describe(log)
            console.print(render(description))
            if PASSPORT_ATTACHMENT in (each.name for each in description.attachments):
                console.print(repr(passport_of(read_log(log, []))), highlight=False, markup=False)


# The command's former name.
app.command("info", hidden=True)(show)


def _map_contents(path: Path) -> Table:
    """What the file of a track-condition map holds; `trainlog map show` makes estimates of it."""
    from trainlog.formats.mapfile import MapFile

    with MapFile(path) as file, file.unchanging():
        track, layers, recordings = file.empty, file.contents(), len(file.trips())
    table = Table.grid(padding=(0, 2))
    table.title, table.title_justify = path.name, "left"
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    length = f"{track.length / 1e3:.1f} km, {track.bins} bins of {track.bin_length:g} m"
    table.add_row("line", f"{track.line}, {length}")
    every = sorted({day for _, days in layers.values() for day in days})
    counts = sum(trips for trips, _ in layers.values())
    more = recordings - counts
    beside = f"; {counted(more, 'recording')} more of drives that count" if more else ""
    table.add_row("trips", f"{counted(counts, 'trip')}, {_period(every)}{beside}")
    for layer, (trips, days) in layers.items():
        table.add_row(f"layer {layer}", f"{counted(trips, 'trip')}, {_period(days)}")
    return table


def _map_trips(path: Path) -> Table:
    """The recordings that the file of a map holds, by the names that `map remove` takes."""
    from analysis.tables import new_table
    from trainlog.condition import day_of_trip
    from trainlog.formats.mapfile import MapFile

    with MapFile(path) as file:
        rows = file.trips()
    table = new_table("", "trip", "rail\ncondition", "days", "counts")
    for row in rows:
        first, last = (date(1970, 1, 1) + timedelta(days=each) for each in row.days)
        days = " to ".join(dict.fromkeys((str(first), str(last))))
        if row.first_day is None:  # compacted, or without evidence: the day on which it ran
            ran = day_of_trip(json.loads(row.entry))
            days = "not known" if ran is None else str(date(1970, 1, 1) + timedelta(days=ran))
        table.add_row(row.known.name, row.layer, days, "yes" if row.counted else "no")
    return table


def _period(days: list[int]) -> str:
    """Days since 1970-01-01: how many, the first and the last."""
    if not days:
        return "no evidence"
    first, last = (date(1970, 1, 1) + timedelta(days=days[end]) for end in (0, -1))
    return f"{counted(len(days), 'day')}, {first}" + (f" to {last}" if last > first else "")
