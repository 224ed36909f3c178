"""The command that shows trips in the Rerun viewer."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from trainlog.cli.options import (
    FromOption,
    KilometreOption,
    Logs,
    ToOption,
    destination,
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
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Save the recording (.rrd) instead of opening it."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Save a picture (.png) of a view; needs no display.")
    ] = None,
    trajectory: Annotated[Path | None, typer.Option(help="Trajectory file to show.")] = None,
    condition: Annotated[
        Path | None, typer.Option("--map", help="Track-condition map to show.")
    ] = None,
    start: FromOption = None,
    end: ToOption = None,
    km: KilometreOption = None,
    web: Annotated[bool, typer.Option("--web", help="Open it in the browser.")] = False,
    viewer: Annotated[
        bool | None,
        typer.Option(
            "--viewer/--no-viewer",
            help="Open the viewer. Default: unless it is saved or a picture is taken.",
        ),
    ] = None,
) -> None:
    """Show trips in the Rerun viewer, by time and by position; or a part of them.

    The viewer runs until it is closed, or Ctrl-C ends it; it listens on this machine alone and
    asks for nothing on the network.

    Example: trainlog replay results/trips/trip-01.mcap
    """
    from trainlog.formats.condition import read_map
    from trainlog.formats.trajectory import read_trajectory
    from trainlog.replay import run_viewer, take_picture, write_replay
    from trainlog.replay.viewer import check_display, interruptible

    opened = web or (viewer if viewer is not None else output is None and picture is None)
    if picture is not None:
        destination(picture, ".png")
    if opened and not web:
        check_display()
    sources = [partial(part_of, log, start, end, km, PIECE) for log in logs_in(logs)]
    with interruptible(), TemporaryDirectory(prefix="trainlog-") as folder:
        recording = Path(folder) / "replay.rrd" if output is None else output
        with working(f"drawing {recording.name}"):
            write_replay(
                sources,
                recording,
                trajectory=None if trajectory is None else read_trajectory(trajectory),
                condition_map=None if condition is None else read_map(condition),
            )
        if output is not None:
            wrote(output)
        if picture is not None:
            with working(f"taking {picture.name}"):
                take_picture(recording, picture)
            wrote(picture)
        if opened:
            run_viewer(
                recording,
                web=web,
                state=partial(console.print, highlight=False, soft_wrap=True),
            )
