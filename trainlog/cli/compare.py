"""The command that compares trips by position: compare."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trainlog.cli.options import Logs, destination, logs_in
from trainlog.cli.terminal import console, state, working, wrote

if TYPE_CHECKING:
    from analysis.comparison.compare import Comparison
    from trainlog.railway import Trajectory

app = typer.Typer()


@app.command(rich_help_panel="Look")
def compare(
    logs: Logs,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Log or trajectory to compare with. Default: the fastest trip of each direction"
            " that covers nearly all of the others' part of the line."
        ),
    ] = None,
    followed: Annotated[
        list[Path] | None,
        typer.Option(
            "--with",
            help="Logs or folder of another group of trips, as of those driven by advice; several.",
        ),
    ] = None,
    line: Annotated[
        Path | None, typer.Option("--line", help="Line file. Default: the line in the logs.")
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Parameters file by whose running resistance energies are normalised. Default: the"
            " train's file in the logs."
        ),
    ] = None,
    time_of_day: Annotated[
        bool, typer.Option("--time-of-day", help="Count a later departure as time lost.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(help="Save a picture (.png), one a direction.")
    ] = None,
) -> None:
    """Compare trips over a line by position: times, where time was lost and why, energy, driving.

    Stopping or not, recorded or simulated, over any part of the line; directions are kept apart.
    With --with, groups of trips instead: drivers' trips and trips that followed a trajectory,
    configuration by configuration.

    Example: trainlog compare sample_logs --picture compared.png
    """
    from analysis.comparison.compare import compare as compare_trips
    from trainlog.formats.line import read_line
    from trainlog.formats.parameters import read_parameters

    if picture is not None:
        destination(picture, ".png")
    if followed:
        _groups(logs, followed)
        return
    found = compare_trips(
        logs_in(logs),
        None if reference is None else _reference(reference),
        line=None if line is None else read_line(line),
        model=None if model is None else read_parameters(model),
        by_time_of_day=time_of_day,
    )
    _show(found)
    if picture is not None:
        _draw(found, picture)


def _reference(path: Path) -> Path | Trajectory:
    """A log stays a path; anything else is read as a trajectory."""
    from trainlog.formats.trajectory import read_trajectory

    return path if path.suffix == ".mcap" or path.is_dir() else read_trajectory(path)


def _show(found: Comparison) -> None:
    from analysis.comparison.table import comparison_data, comparison_tables

    if not state(comparison_data(found)):
        for part in comparison_tables(found):
            console.print(part, highlight=False)


def _draw(found: Comparison, picture: Path) -> None:
    from analysis.comparison.plot import comparison_figure
    from analysis.plotting import write_figure

    several = len(found.directions) > 1
    for each in found.directions:
        path = picture.with_stem(f"{picture.stem}-{each.direction}") if several else picture
        with working(f"drawing {path.name}"):
            write_figure(comparison_figure(each), path)
        wrote(path)


def _groups(logs: list[Path], followed: list[Path]) -> None:
    from analysis.comparison.groups import compare_groups, savings_table

    for each in followed:
        if len(followed) > 1:
            console.print(f"with {each}", highlight=False)
        console.print(savings_table(compare_groups(logs_in(logs), logs_in([each]))))
