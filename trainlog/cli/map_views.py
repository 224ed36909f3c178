"""Commands that look at a track-condition map: show, diff, history, export."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trainlog.cli.map import map_app
from trainlog.cli.options import (
    AtOption,
    LayersOption,
    MapArgument,
    MapOrFolder,
    ZoneOption,
    destination,
    moment,
    zone_assumed,
)
from trainlog.cli.terminal import console, state, wrote
from trainlog.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from trainlog.railway import Line, TrackConditionMap

app = typer.Typer()
"""Empty: these commands stand among those of the map."""

CourseOption = Annotated[
    Path | None,
    typer.Option(
        "--line",
        help="Line file, or a log that carries it: stations, the operator's kilometres,"
        " coordinates. Default: a sample line of the map's name, or that of its logs.",
    ),
]


@map_app.command("show")
def map_show(
    condition: MapOrFolder,
    at: AtOption = None,
    zone: ZoneOption = None,
    layer: LayersOption = None,
    picture: Annotated[Path | None, typer.Option(help="Draw the map here as well.")] = None,
    km: Annotated[
        str | None,
        typer.Option("--km", help="The operator's kilometres that the picture shows: 8:12."),
    ] = None,
    line: CourseOption = None,
    model: Annotated[
        bool, typer.Option("--model", help="List the numbers of the model as well.")
    ] = False,
) -> None:
    """Show what a track-condition map knows, and where it knows nothing.

    Lasting beside expected maximum adhesion at the lowest places, passing spots with the
    probability that they still lie there, and changes of the lasting condition with their dates;
    with --model the numbers of the model with their uncertainty. Of a past --at the map is shown
    as it was known then: made of the evidence of the days before alone. Of a network's folder
    of maps a row an edge and rail condition, and the network drawn by expected adhesion.

    Example: trainlog map show results/wil.map --at 2026-11-22T06:00+01:00 --picture map.png
    """
    if picture is not None:
        destination(picture, ".png")
    when, ends = moment(at, zone), _kilometres(km)
    if ends is not None and picture is None:
        raise InputError("--km chooses what a picture shows", remedy="name it with --picture")

    if condition.is_dir():
        if ends is not None or line is not None or model:
            raise InputError(
                "--km, --line and --model are for the map of one line",
                remedy="leave them out, or name the map of an edge",
            )
        _show_network(condition, when, layer, picture)
        return

    from analysis.adhesion.map_state import map_state, state_table
    from trainlog.formats.condition import read_map
    from trainlog.railway.kilometres import position_of

    track = read_map(condition)
    known = course(track, line, condition)
    shown = map_state(track, when, line=known, layers=layer)
    assumed = zone_assumed(at, zone)
    shown = replace(shown, notes=(*shown.notes, assumed)) if assumed else shown
    if picture is not None:
        from analysis.adhesion.map_plot import draw_map

        positions = [position_of(known, each) for each in ends or ()]
        part = (positions[0], positions[1]) if positions else None
        draw_map(shown.track, picture, line=known, at=when, part=part)
    if not state(shown.as_json()):
        console.print(state_table(shown, model=model))
    if picture is not None:
        wrote(picture)


def _show_network(
    folder: Path, when: pd.Timestamp | None, layers: list[str] | None, picture: Path | None
) -> None:
    """Show the maps of a network's folder."""
    from analysis.network.map_table import draw_network_map, network_rows, network_table
    from analysis.network.maps import network_map

    maps = network_map(folder)
    shown = maps if when is None else maps.known_before(when)
    rows = network_rows(shown, when, layers)
    if picture is not None:
        draw_network_map(shown, picture, time=when, layer=None if not layers else layers[0])
    if not state({"folder": str(folder), "edges": rows}):
        console.print(network_table(shown, rows))
    if picture is not None:
        wrote(picture)


def _kilometres(given: str | None) -> tuple[float, float] | None:
    """Two kilometres as given by ``--km 8:12``."""
    if given is None:
        return None
    try:
        start, end = (float(each) for each in given.split(":"))
    except ValueError:
        start = end = 0.0
    if not abs(end - start) > 0.0:
        raise InputError(f"'{given}' is not a part of a line", remedy="write it as --km 8:12")
    return start, end


@map_app.command("diff")
def map_diff(
    maps: Annotated[list[Path], typer.Argument(help="Two map files, or one with --from.")],
    start: Annotated[
        str | None, typer.Option("--from", help="Day up to which the first evidence counts.")
    ] = None,
    end: Annotated[
        str | None, typer.Option("--to", help="Day up to which the second counts; default: all.")
    ] = None,
    layer: LayersOption = None,
    line: CourseOption = None,
    rate: Annotated[
        float, typer.Option(help="Share of the bins called changed that may be so by chance.")
    ] = 0.05,
    least: Annotated[
        float, typer.Option(help="Difference of adhesion whose probability is stated.")
    ] = 0.01,
    picture: Annotated[Path | None, typer.Option(help="Draw the difference here as well.")] = None,
) -> None:
    """Show what changed between two dates of a map, or between two maps, with significance.

    What only the second one counts is compared with the first, bin by bin. Exit status 0: nothing
    changed significantly; 1: something did; 2: the comparison could not be made.

    Example: trainlog map diff results/wil.map --from 2026-10-31 --picture diff.png
    """
    if picture is not None:
        destination(picture, ".png")
    if len(maps) > 2:
        raise InputError(f"{len(maps)} maps are given", remedy="give two, or one with --from")
    since, until = _day(start), _day(end)

    from analysis.adhesion.map_difference import difference_table, map_difference
    from analysis.adhesion.map_plot import draw_difference
    from trainlog.formats.condition import read_map

    first, *second = [read_map(each) for each in maps]
    known = course(first, line, maps[0])
    found = map_difference(
        first,
        second[0] if second else None,
        since=since,
        until=until,
        line=known,
        layers=layer,
        rate=rate,
        least=least,
    )
    if picture is not None:
        draw_difference(found, picture, line=known)
    if not state(found.as_json()):
        console.print(difference_table(found))
    if picture is not None:
        wrote(picture)
    if found.changed:
        raise typer.Exit(1)


@map_app.command("history")
def map_history(
    condition: MapArgument,
    km: Annotated[float, typer.Option("--km", help="The operator's kilometre of the place.")],
    layer: LayersOption = None,
    line: CourseOption = None,
    days: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Make the estimate as it was known then for so many days at most, chosen evenly;"
            " each takes as long as that of an update. Default: 12.",
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(help="Draw it here; of several layers, their names are added to the file's."),
    ] = None,
) -> None:
    """Show what a map knows of one place over time: its evidence, and the estimate of each day.

    Where more than --days days have evidence nearby, it states for how many of them the estimate
    was made.

    Example: trainlog map history results/wil.map --km 12.3 --layer wet --picture place.png
    """
    if picture is not None:
        destination(picture, ".png")

    from analysis.adhesion.map_history import MOST_DAYS, history_table, map_history
    from analysis.adhesion.map_plot import draw_history
    from trainlog.formats.condition import read_map
    from trainlog.railway.kilometres import position_of

    track = read_map(condition)
    known = course(track, line, condition)
    position = position_of(known, km)
    names = list(track.layers) if layer is None else layer
    most = MOST_DAYS if days is None else days
    found = [map_history(track, position, name, line=known, days=most) for name in names]
    written = []
    if picture is not None:
        for each in found:
            several = picture.with_stem(f"{picture.stem}-{each.layer}")
            written.append(several if len(found) > 1 else picture)
            draw_history(each, written[-1])
    if not state({"layers": [each.as_json() for each in found]}):
        for each in found:
            console.print(history_table(each))
    wrote(*written)


def _day(given: str | None) -> int | None:
    """A day as given, counted from 1970-01-01 in UTC."""
    from trainlog.railway.evidence import day_of
    from trainlog.spans import utc

    return None if given is None else day_of(utc(given))


@map_app.command("export")
def map_export(
    condition: MapArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help=".geojson, .gpkg, .parquet, .csv, or .json in TTOBench's layout."
        ),
    ],
    line: CourseOption = None,
    layer: LayersOption = None,
    at: AtOption = None,
    zone: ZoneOption = None,
) -> None:
    """Write a track-condition map for other programs, by the suffix of the file.

    GeoJSON and GeoPackage (extra gis) have the bins as lines on the earth, with spots, changes and
    stations; Parquet and CSV have the bins by chainage; JSON has the sections of one layer as
    TTOBench lays out a track. What was not observed is empty. Of a past --at the map is written as
    it was known then: made of the evidence of the days before alone.

    Example: trainlog map export results/wil.map -o results/map.geojson
    """
    when = moment(at, zone)

    from analysis.adhesion.export import export_map, exported_suffix
    from trainlog.condition import left_out
    from trainlog.formats.condition import read_map

    exported_suffix(output)
    track = read_map(condition)
    export_map(track, output, line=course(track, line, condition), at=when, layers=layer)
    chosen = replace(track, layers={name: track.layer(name) for name in layer or track.layers})
    for words in filter(None, [left_out(chosen, when), zone_assumed(at, zone)]):
        console.print(f"  {words}", highlight=False, soft_wrap=True)
    wrote(output)


def course(track: TrackConditionMap, given: Path | None, condition: Path) -> Line | None:
    """The line of a map, see `analysis.adhesion.map_state.line_of_map`."""
    from analysis.adhesion.map_state import line_of_map

    return line_of_map(track, given, condition)
