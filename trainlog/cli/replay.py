"""The command that shows trips in the Rerun viewer."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

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
from trainlog.cli.terminal import console, state, working, wrote
from trainlog.display import counted
from trainlog.errors import InputError

if TYPE_CHECKING:
    from trainlog.replay import Replay

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
    view: Annotated[
        str | None,
        typer.Option(
            help="View shown first: overview, driving, traction, identification, map, recorder."
        ),
    ] = None,
    trajectory: Annotated[Path | None, typer.Option(help="Trajectory file to show.")] = None,
    condition: Annotated[
        Path | None, typer.Option("--map", help="Track-condition map to show.")
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Trip (.mcap) or trajectory (.json) with which the trips are compared along the"
            " line. Default: the trajectory, else the first trip."
        ),
    ] = None,
    line: Annotated[
        Path | None, typer.Option(help="Line file, for trips that carry no line.")
    ] = None,
    start: FromOption = None,
    end: ToOption = None,
    km: KilometreOption = None,
    thin: Annotated[
        bool | None,
        typer.Option(
            "--thin/--full",
            help="Only the overview, its samples thinned, or all. Default: thinned if there are"
            " more than 16 trips and no part of them is asked for.",
        ),
    ] = None,
    tiles: Annotated[
        bool, typer.Option("--tiles", help="Map tiles, which the viewer asks the network for.")
    ] = False,
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
    from trainlog.formats.line import read_line
    from trainlog.formats.trajectory import read_trajectory
    from trainlog.mcap import read_log
    from trainlog.replay import ReplayOptions, run_viewer, take_picture, write_replay
    from trainlog.replay.layout import check_view
    from trainlog.replay.viewer import check_display, interruptible

    opened = web or (viewer if viewer is not None else output is None and picture is None)
    if view is not None:
        check_view(view)
    if picture is not None:
        destination(picture, ".png")
        if tiles:
            raise InputError(
                "a picture is taken without the network, hence without map tiles",
                remedy="leave out --tiles, or --picture",
            )
    found = logs_in(logs)
    if opened and not web:
        for log in found:
            read_log(log, topics=[])  # what is no log is refused before the lack of a display
        check_display()
    if reference is not None and reference.suffix == ".json":
        if trajectory is not None and trajectory != reference:
            raise InputError(
                "two trajectories are given", remedy="leave out --reference or --trajectory"
            )
        trajectory, reference = reference, None
    whole = (start, end, km) == (None, None, None)
    options = ReplayOptions(
        view=view,
        reference=None if reference is None else _number_of(reference, found),
        thinned=thin if whole or thin is not None else False,
        tiles=tiles,
        line=None if line is None else read_line(line),
    )
    part = partial(part_of, start=start, end=end, km=km, rows=PIECE, line=options.line)
    sources = [partial(part, log) for log in found]
    with interruptible(), TemporaryDirectory(prefix="trainlog-") as folder:
        recording = Path(folder) / "replay.rrd" if output is None else output
        made = write_replay(
            sources,
            recording,
            trajectory=None if trajectory is None else read_trajectory(trajectory),
            condition_map=None if condition is None else read_map(condition),
            options=options,
        )
        _state(made)
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
                tiles=tiles,
                state=partial(console.print, highlight=False, soft_wrap=True),
            )


def _number_of(reference: Path, logs: list[Path]) -> int:
    """Which of the logs the reference is; it is added to them if it is none yet."""
    for number, log in enumerate(logs):
        if log.resolve() == reference.resolve():
            return number
    (log,) = logs_in([reference])
    logs.append(log)
    return len(logs) - 1


def _state(made: Replay) -> None:
    """State with what trips are compared, and whether samples were left out."""
    if state(asdict(made)):
        return
    say = partial(console.print, highlight=False, soft_wrap=True)
    if made.references:
        say(f"compared along the line with {', '.join(made.references)}")
    if made.thinned:
        say(
            f"{counted(len(made.trips), 'trip')}, thinned: of each 10 m or 0.4 s the lowest and the"
            " highest speed; every sample with --km, --from, --to, --full, or fewer trips"
        )
