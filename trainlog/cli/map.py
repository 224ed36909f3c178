"""Commands of the track-condition map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainlog.cli.options import Logs, destination, logs_in
from trainlog.cli.terminal import console, progress_bar, wrote

app = typer.Typer()
map_app = typer.Typer(no_args_is_help=True, help="The track-condition map: maximum adhesion.")
app.add_typer(map_app, name="map", rich_help_panel="Learn")


@map_app.command("update")
def map_update(
    logs: Logs,
    condition: Annotated[Path, typer.Option("--map", help="Map file; made if it is not there.")],
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
) -> None:
    """Add the evidence of trips to the track-condition map: slip events and adhesion in use.

    A drive that the map already holds is not counted again, whatever file it comes in.

    Example: trainlog map update results/trips --map results/map.json
    """
    from analysis.adhesion.condition_map import adhesion_map, map_table
    from analysis.adhesion.map_plot import draw_map
    from trainlog.formats.condition import read_map, write_map
    from trainlog.formats.weather import read_weather

    destination(condition, ".json")
    known = read_map(condition) if condition.exists() else None
    stated = None if weather is None else read_weather(weather)
    with progress_bar() as progress:
        every = progress.track(logs_in(logs), description="mapping")
        found = adhesion_map(every, known, layer, stated)
    for words in (*found.reasons, *found.doubts):
        console.print(f"  {words}", highlight=False, markup=False)
    write_map(found.track, condition)
    draw_map(found.track, condition.with_suffix(".png"))
    console.print(map_table(found.track))
    wrote(condition, condition.with_suffix(".png"))
