"""The command that states what a file holds."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import date, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trainlog.cli.commands import end_in_part
from trainlog.cli.options import ChosenTrips
from trainlog.cli.terminal import console, current, plain, print_problems, state, wrote
from trainlog.display import counted
from trainlog.errors import InputError, TrainlogError
from trainlog.presentation import WordTable, new_table

if TYPE_CHECKING:
    from trainlog.mcap.description import LogDescription

app = typer.Typer()

Files = Annotated[
    list[Path],
    typer.Argument(
        help="Anything that trainlog makes or reads: logs, lines, trains, maps, parameter sets,"
        " trajectories, profiles, recorders' files; folders of them."
    ),
    ChosenTrips,
]


@app.command(rich_help_panel="Look")
def show(
    files: Files,
    trips: Annotated[
        bool, typer.Option("--trips", help="List the trips of track-condition maps by name.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(help="Draw a trip or a line into this file (.png, .svg).")
    ] = None,
    browse: Annotated[
        bool, typer.Option("--open", help="Open a report on it in the browser.")
    ] = False,
) -> None:
    """State what a file holds, whatever it is; it is recognised by its content.

    Of a log topics, units, rates, time and position span, gaps, passport; of a consist its
    vehicles, couplers and brake; of a track-condition map its line, layers, trips and days, with
    [bold]--trips[/bold] each recording by its name; of a recorder's file what can be read of it;
    of a folder what each of its files is. Exit status 1 if a log is damaged, or a file of several
    cannot be shown; 2 if none can.

    Example: trainlog show results/trips/trip-01.mcap

    trainlog show my.line.toml --picture line.png
    """
    if len(files) > 1 and (picture is not None or browse):
        raise InputError("one file is shown as a picture", remedy="name a single file")
    damaged = refused = 0
    for file in files:
        try:
            if file.is_dir() and not (file / "trip.json").exists():
                damaged += _show_folder(file)
            else:
                damaged += _show(file, trips)
        except TrainlogError as error:  # one file that cannot be shown says nothing of the others
            if len(files) == 1:
                raise
            print_problems(error)
            refused += 1
    if picture is not None:
        from analysis.contents import contents_of, draw_contents

        draw_contents(contents_of(files[0]), picture)
        wrote(picture)
    if browse:
        _open(files[0])
    end_in_part(refused, len(files))
    if damaged:
        raise typer.Exit(1)


def _show(file: Path, trips: bool) -> bool:
    """State what a file holds; whether it is a log that is damaged."""
    from analysis.consist_table import consist_tables
    from analysis.contents import contents_of
    from trainlog.formats.attached import passport_of
    from trainlog.mcap import read_log
    from trainlog.mcap.description import recorded_fields, render
    from trainlog.trip import PASSPORT_ATTACHMENT

    found = contents_of(file)
    if found.kind == "log":
        recorded = recorded_fields(found.value)
        if state({}):
            current().content.setdefault("logs", []).append(_log_as_data(found.value, recorded))
            return found.damaged
        console.print(*render(found.value, recorded))
        if PASSPORT_ATTACHMENT in (each.name for each in found.value.attachments):
            console.print(repr(passport_of(read_log(file, []))), highlight=False, markup=False)
    elif found.kind == "consist":
        console.print(consist_tables(found.value))
    elif found.kind == "track-condition map":
        console.print(_map_contents(file))
        if trips:
            console.print(_map_trips(file))
    else:
        console.print(f"{file}: {found.kind}", highlight=False, soft_wrap=True)
        console.print(found.text, highlight=False, markup=False, soft_wrap=True)
    return found.damaged


def _log_as_data(found: LogDescription, recorded: Mapping[str, frozenset[str]]) -> dict[str, Any]:
    """What is in a log, in SI units; of each field whether it holds a value."""
    start, end = found.position_span or (None, None)
    topics = [
        {
            "name": each.name,
            "message": each.message,
            "encoding": each.encoding,
            "messages": each.count,
            "rate_Hz": each.rate,
            "first": each.first,
            "last": each.last,
            "median_interval_s": each.median_interval,
            "largest_gap_s": each.largest_gap,
            "gaps": each.gaps,
            "fields": [
                {
                    "name": name,
                    "unit": unit,
                    "axles": each.axles.get(name),
                    "recorded": name in recorded.get(each.name, ()),
                }
                for name, unit in each.units.items()
            ],
        }
        for each in found.topics
    ]
    return {
        "file": found.path,
        "kind": "log",
        "first": found.first,
        "last": found.last,
        "position_start_m": start,
        "position_end_m": end,
        "messages": found.count,
        "chunks": found.chunks,
        "size_bytes": found.size,
        "schema_version": found.schema_version,
        "whole": found.complete,
        "state": found.account.sentence,
        "problem": found.problem,
        "topics": topics,
        "metadata": found.metadata,
        "provenance": [json.dumps(plain(step), ensure_ascii=False) for step in found.provenance],
        "attachments": [
            {
                "name": each.name,
                "media_type": each.media_type,
                "size_bytes": each.size,
                "sha256": each.sha256,
            }
            for each in found.attachments
        ],
    }


def _show_folder(folder: Path) -> bool:
    """List what the files of a folder are; whether a log among them is damaged."""
    from analysis.contents import folder_contents

    table = new_table(str(folder), "file", "kind", "contents", name="file")
    rows = folder_contents(folder)
    for row in rows:
        table.add_row(row.name, row.kind, row.summary)
    console.print(table)
    return any(row.damaged for row in rows)


def _open(file: Path) -> None:
    """Open a report on a file in the browser."""
    import tempfile
    import webbrowser

    from analysis.reports.build import ReportOptions, write_report

    page = Path(tempfile.mkdtemp(prefix="trainlog-")) / f"{file.stem}.html"
    write_report(file, page, ReportOptions())
    wrote(page)
    if not webbrowser.open(page.resolve().as_uri()):
        console.print("no browser here: open the page where there is one", highlight=False)


# The command's former name.
app.command("info", hidden=True)(show)


def _map_contents(path: Path) -> WordTable:
    """What the file of a track-condition map holds; `trainlog map show` makes estimates of it."""
    from trainlog.formats.mapfile import MapFile

    with MapFile(path) as file, file.unchanging():
        track, layers, recordings = file.empty, file.contents(), len(file.trips())
    table = new_table(path.name, "quantity", "value", name="map", show_header=False)
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


def _map_trips(path: Path) -> WordTable:
    """The recordings that the file of a map holds, by the names that `map remove` takes."""
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
