"""Commands of the track-condition map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trainlog.cli.options import Logs, MapArgument, destination, logs_in
from trainlog.cli.terminal import console, current, print_error, state, wrote
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.progress import task

if TYPE_CHECKING:
    from collections.abc import Callable

    from analysis.adhesion.updating import LogOutcome, MapUpdate

app = typer.Typer()
map_app = typer.Typer(no_args_is_help=True, help="The track-condition map: maximum adhesion.")
app.add_typer(map_app, name="map", rich_help_panel="Learn")


@map_app.command("update")
def map_update(
    logs: Logs,
    condition: Annotated[
        Path,
        typer.Option(
            "--map", help="Map file (.map), or a network's folder of maps; made if not there."
        ),
    ],
    network: Annotated[
        Path | None,
        typer.Option(help="Network file: one map an edge, in the folder that --map names."),
    ] = None,
    layer: Annotated[
        str | None,
        typer.Option(help="Rail condition, such as wet or leaves; default: what each log states."),
    ] = None,
    weather: Annotated[
        Path | None,
        typer.Option(
            help="CSV of times, rail conditions, temperature, humidity and rain: the condition of"
            " logs that state none, and what is kept with each trip."
        ),
    ] = None,
    retry: Annotated[
        bool, typer.Option("--retry", help="Try logs that were refused before again.")
    ] = False,
) -> None:
    """Add the evidence of trips to the track-condition map: slip events and adhesion in use.

    A drive that the map already holds is not counted again, whatever file it comes in; a fuller
    recording of it counts in place of a poorer one. Each trip is on the disk when its line appears,
    and several processes may add to one map.

    Exit status 1 if some logs could not be used, or are held under another rail condition than the
    one given; 2 if none could be used. A log that cannot be used is reported once: the map
    remembers it by its content, and later updates only count it. One that never recorded the
    speed of an axle is listed, and no failure.

    With --network trips count on each edge that their route runs over, by the edge's own chainage;
    trips on an ordinary line on the edge of its name. The folder keeps the network.

    Example: trainlog map update results/trips --map results/wil.map
    """
    from collections import Counter
    from functools import partial

    from analysis.adhesion.updating import update_map
    from trainlog.formats.mapfile import MapFile
    from trainlog.formats.weather import read_weather

    if condition.is_file():
        MapFile(condition).close()  # what is no map is named before logs are read
    of_network = network is not None or condition.is_dir()
    if of_network:
        from analysis.network.maps import update_network_map
        from trainlog.formats.network import read_network

        edges = None if network is None else read_network(network)
        adding: Callable[..., MapUpdate] = partial(update_network_map, network=edges)
    else:
        destination(condition, ".map")
        adding = update_map
    stated = None if weather is None else read_weather(weather)
    found, done = logs_in(logs), Counter[str]()

    def report(outcome: LogOutcome) -> None:
        done[outcome.outcome] += 1
        step(done.total())
        if outcome.outcome == "refused":
            print_error(outcome.reason)
        elif outcome.outcome == "refused before" or output.as_json:
            return
        elif outcome.outcome == "not recorded":
            console.print(f"  not used: {outcome.reason}", highlight=False, soft_wrap=True)
        elif outcome.outcome != "held" or outcome.reason:
            console.print(f"  {outcome.sentence}", highlight=False, soft_wrap=True)

    def finished() -> str:
        added = f"{counted(done['added'], 'trip')} added"
        return added if condition.exists() else f"{added}, no map was made"

    output = current()
    output.finished = finished
    with task("mapping", len(found), "log") as step:
        result = adding(found, condition, layer=layer, weather=stated, retry=retry, report=report)
    if not state(result.details()):
        console.print(result.sentence, highlight=False, soft_wrap=True)
    unusable = result.refused + result.not_recorded + result.refused_before
    if len(unusable) == len(result.logs) and (result.refused or not result.made):
        raise typer.Exit(2)
    if result.refused or result.elsewhere:
        raise typer.Exit(1)


@map_app.command("remove")
def map_remove(
    condition: MapArgument,
    trips: Annotated[list[str], typer.Argument(help="Names of the trips to take out.")],
) -> None:
    """Take trips out of a map, such as those given with a wrong rail condition.

    Given again, their logs count again. What was compacted cannot be taken out.

    Example: trainlog map remove results/wil.map trip-07
    """
    from trainlog.formats.mapfile import MapFile

    with MapFile(condition) as file:
        number = file.remove(trips)
        held, days = file.amount()
    console.print(
        f"{counted(number, 'recording')} taken out; the map holds {counted(held, 'trip')} of"
        f" {counted(days, 'day')}"
    )


@map_app.command("merge")
def map_merge(
    maps: Annotated[list[Path], typer.Argument(help="Map files of one line.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="New map file.")],
) -> None:
    """Make one map of several; a trip that more than one of them holds is counted once.

    Example: trainlog map merge monday.map tuesday.map -o both.map
    """
    from trainlog.formats.mapmerge import merge_files

    destination(output, ".map")
    trips, days = merge_files(maps, output)
    console.print(f"the map holds {counted(trips, 'trip')} of {counted(days, 'day')}")
    wrote(output)


@map_app.command("compact")
def map_compact(
    condition: MapArgument,
    before: Annotated[
        str, typer.Option(help="Day (2026-01-31); of trips before it sums are kept.")
    ],
) -> None:
    """Replace what each older trip has shown by sums of days: the map stays the same.

    Which recordings of these drives count is then decided: a fuller one that comes later does not
    replace any.

    Example: trainlog map compact results/wil.map --before 2026-01-01
    """
    from datetime import date

    from trainlog.formats.mapfile import MapFile

    try:
        day = (date.fromisoformat(before) - date(1970, 1, 1)).days
    except ValueError as error:
        raise InputError(f"'{before}' is no day", remedy="write it as 2026-01-31") from error
    with MapFile(condition) as file:
        number = file.compact(day)
    console.print(f"{counted(number, 'recording')} compacted")
    wrote(condition)
