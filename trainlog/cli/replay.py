"""The command that shows trips in the Rerun viewer."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from trainlog.cli.options import (
    FromOption,
    KilometreOption,
    Logs,
    ToOption,
    logs_in,
    part_of,
)
from trainlog.cli.terminal import console, working, wrote

app = typer.Typer()

PIECE = 200_000
"""Rows that a replay holds at a time, over all topics."""


@app.command(rich_help_panel="Look")
def replay(
    logs: Logs,
    output: Annotated[Path, typer.Option("--output", "-o", help="The .rrd recording.")],
    trajectory: Annotated[Path | None, typer.Option(help="Trajectory file to show.")] = None,
    condition: Annotated[
        Path | None, typer.Option("--map", help="Track-condition map to show.")
    ] = None,
    start: FromOption = None,
    end: ToOption = None,
    km: KilometreOption = None,
    viewer: Annotated[
        bool, typer.Option(help="Open the Rerun viewer where there is a display.")
    ] = True,
) -> None:
    """Show trips in the Rerun viewer, by time and by position; or a part of them.

    Example: trainlog replay results/trips/trip-01.mcap -o results/replay.rrd
    """
    from trainlog.formats.condition import read_map
    from trainlog.formats.trajectory import read_trajectory
    from trainlog.replay import open_viewer, write_replay

    sources = [partial(part_of, log, start, end, km, PIECE) for log in logs_in(logs)]
    with working(f"writing {output.name}"):
        write_replay(
            sources,
            output,
            trajectory=None if trajectory is None else read_trajectory(trajectory),
            condition_map=None if condition is None else read_map(condition),
        )
    wrote(output)
    if viewer:
        console.print(open_viewer(output))
