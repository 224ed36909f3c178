"""The command that compares trips by position: compare."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trainlog.cli.options import Logs, destination, logs_in
from trainlog.cli.terminal import console, state, working, wrote
from trainlog.progress import track

if TYPE_CHECKING:
    from analysis.comparison.compare import Comparison
    from trainlog.railway import ParameterSet, Train, Trajectory

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
    calculated: Annotated[
        Path | None,
        typer.Option(
            help="Parameters or train file: compare each trip with what that predicts for it"
            " instead."
        ),
    ] = None,
    wind: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation in m/s of the head wind that calculated bands assume, as for a"
            " known calm day. Default: 1 where the head wind is recorded, else 5."
        ),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Save a picture (.png), one a direction or a trip.")
    ] = None,
) -> None:
    """Compare trips over a line by position: times, where time was lost and why, energy, driving.

    Stopping or not, recorded or simulated, over any part of the line; directions are kept apart.
    With --with, groups of trips instead: drivers' trips and trips that followed a trajectory,
    configuration by configuration. With --calculated, each trip beside what a fit or a train's
    file predicts for it: speed, time and energy with bands, and what of the model is wrong, by each
    trip and by all together.

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
    if calculated is not None:
        _calculated(logs, calculated, wind, picture)
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


def _calculated(logs: list[Path], file: Path, wind: float | None, picture: Path | None) -> None:
    from analysis.comparison.calculated import calculate, judged_together
    from analysis.comparison.calculated_table import (
        calculation_data,
        calculation_figure,
        calculation_tables,
        diagnosis_data,
        together_words,
    )
    from analysis.plotting import write_figure

    model, trips = _model(file), list(logs_in(logs))
    every, calculations = [], []
    for log in track(trips, "calculating", "trip"):
        found = calculate(log, model, wind_std=wind)
        calculations.append(found)
        every.append(calculation_data(found))
        together = judged_together(calculations)
        if not state({"trips": every, "together": diagnosis_data(together)}):
            for part in calculation_tables(found):
                console.print(part, highlight=False)
        if picture is not None:
            several = len(trips) > 1
            path = picture.with_stem(f"{picture.stem}-{log.stem}") if several else picture
            write_figure(calculation_figure(found), path)
            wrote(path)
    if len(calculations) > 1:
        console.print(together_words(calculations, together), highlight=False)


def _model(path: Path) -> ParameterSet | Train:
    """A parameters file, or a train's file."""
    from trainlog.formats.files import read_json, refuse_map
    from trainlog.formats.parameters import read_parameters
    from trainlog.formats.train import read_train

    refuse_map(path, "the parameters that 'trainlog fit' wrote, or a train's file, are expected")
    content = read_json(path) if path.suffix == ".json" else None
    of_fit = isinstance(content, dict) and content.get("format") == "trainlog/parameters"
    return read_parameters(path) if of_fit else read_train(path)
