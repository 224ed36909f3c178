"""Commands that plan: optimise."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from trainlog.commands.options import LineOption, TrainOption
from trainlog.errors import InputError
from trainlog.terminal import (
    console,
    destination,
    line_and_train,
    logs_in,
    working,
    wrote,
)

if TYPE_CHECKING:
    from trainlog.railway import Configuration, Line, Train, Trajectory

app = typer.Typer()


@app.command(rich_help_panel="Plan")
def optimise(
    parameters: Annotated[Path, typer.Argument(help="Observed parameter set (JSON).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Trajectory file (JSON).")],
    line: LineOption = None,
    train: TrainOption = None,
    running_time: Annotated[
        float | None, typer.Option(help="Timetable's running time in seconds.")
    ] = None,
    reserve: Annotated[
        float, typer.Option(help="Without --running-time: reserve over the least time (%).")
    ] = 10.0,
    as_fast_as: Annotated[
        Path | None,
        typer.Option(help="Running time of the fastest non-stop trip of this log or folder."),
    ] = None,
    braking: Annotated[
        Literal["recourse", "common"],
        typer.Option(help="Each configuration brakes for itself, or all alike as in the paper."),
    ] = "recourse",
    objective: Annotated[
        Literal["wheel", "line", "expected"],
        typer.Option(
            help="Traction at the wheel rims as in the paper; or energy from the line, with"
            " efficiencies and what the dynamic brake feeds back, at worst or as expected of the"
            " trips that the configurations stand for."
        ),
    ] = "wheel",
    condition: Annotated[
        Path | None, typer.Option("--map", help="Track-condition map that limits the efforts.")
    ] = None,
    layer: Annotated[
        Literal["dry", "wet"], typer.Option(help="Rail condition of the map.")
    ] = "wet",
    assumed_adhesion: Annotated[
        float | None,
        typer.Option(
            help="With --map: adhesion counted on where it tells nothing; default: no limit there."
        ),
    ] = None,
    cells: Annotated[
        int,
        typer.Option(
            min=20, max=20_000, help="Cells of the grid; at least one for each step of the line."
        ),
    ] = 500,
    reverse: Annotated[
        bool, typer.Option("--reverse", help="Travel against the line's chainage.")
    ] = False,
    journey: Annotated[
        Path | None,
        typer.Option(help="Journey file: stops and passing points; one trajectory a section."),
    ] = None,
    dwell: Annotated[
        float, typer.Option(min=0.0, help="With --journey: least standing time at a stop (s).")
    ] = 0.0,
    pareto: Annotated[
        bool, typer.Option("--pareto", help="Energy against running time too, and its picture.")
    ] = False,
    referee: Annotated[
        bool, typer.Option("--referee", help="Solve it again with CasADi and IPOPT, and compare.")
    ] = False,
) -> None:
    """Find the trajectory of least energy that every observed configuration can follow.

    The answer carries its certificate: an independent fine rollout of every configuration and a
    lower bound on the energy. Beside it stand a picture, and the driver's advice as CSV.

    Example: trainlog optimise results/parameters.json -o results/trajectory.json
    """
    from analysis.compare import fastest_nonstop
    from analysis.trajectory import optimise as solve
    from trainlog.formats.condition import read_map
    from trainlog.formats.parameters import read_parameters

    destination(output, ".json")
    the_line, the_train = line_and_train(line, train)
    observed = read_parameters(parameters)
    observed.check_train(the_train.name)
    if not observed.configurations:
        raise InputError(
            "holds no configuration",
            file=parameters,
            remedy="'trainlog fit' makes a set from trips",
        )
    if as_fast_as is not None:
        if running_time is not None:
            raise InputError("--running-time and --as-fast-as contradict", remedy="give one")
        running_time = fastest_nonstop(logs_in([as_fast_as]), the_line)
    if journey is not None and (pareto or running_time is not None):
        raise InputError(
            "--journey tells the times itself", remedy="leave out --running-time and --pareto"
        )
    if assumed_adhesion is not None and condition is None:
        raise InputError(
            "--assumed-adhesion is for places where a map tells nothing", remedy="give --map"
        )
    if reverse:
        the_line = the_line.reversed()
    options: dict[str, Any] = {
        "reserve": reserve / 100.0,
        "braking": braking,
        "objective": objective,
        "weights": observed.weights if objective == "expected" else (),
        "condition_map": None if condition is None else read_map(condition),
        "layer": layer,
        "assumed_adhesion": inf if assumed_adhesion is None else assumed_adhesion,
        "cells": cells,
        "direction": "reverse" if reverse else "forward",
        "referee": referee,
    }
    asked = (the_line, the_train, observed.configurations)
    if journey is not None:
        _journey(asked, journey, dwell, options, output)
        return
    with working(f"optimising over {len(observed.configurations)} configurations"):
        trajectory = solve(*asked, running_time=running_time, **options)
    _told(trajectory, the_line, output)
    if pareto:
        _front(asked, options, output)


def _told(trajectory: Trajectory, line: Line, output: Path) -> None:
    """Write a trajectory, its picture and its advice, and print what it is."""
    from analysis.pictures.trajectory import draw_trajectory
    from analysis.report import advice_table, trajectory_table
    from analysis.trajectory.advice import advice, write_advice
    from trainlog.formats.trajectory import write_trajectory

    points = advice(trajectory)
    write_trajectory(trajectory, output)
    draw_trajectory(trajectory, line, output.with_suffix(".png"))
    write_advice(points, output.with_suffix(".csv"))
    console.print(trajectory_table(trajectory), advice_table(points))
    wrote(output, output.with_suffix(".png"), output.with_suffix(".csv"))


def _journey(
    asked: tuple[Line, Train, Sequence[Configuration]],
    journey: Path,
    dwell: float,
    options: dict[str, Any],
    output: Path,
) -> None:
    """Optimise a journey; a file a section, numbered."""
    from analysis.report import journey_table
    from analysis.trajectory import optimise_journey
    from trainlog.formats.journey import read_journey

    with working("optimising the sections"):
        plan = optimise_journey(*asked, read_journey(journey), dwell=dwell, **options)
    for number, section in enumerate(plan.sections, start=1):
        _told(section, asked[0], output.with_name(f"{output.stem}-{number}.json"))
    console.print(journey_table(plan))


def _front(
    asked: tuple[Line, Train, Sequence[Configuration]], options: dict[str, Any], output: Path
) -> None:
    """Energy against running time, printed and drawn."""
    from analysis.pictures.front import draw_front
    from analysis.report import front_table
    from analysis.trajectory.front import energy_against_time

    known = {key: value for key, value in options.items() if key != "reserve"}
    with working("optimising for other running times"):
        front = energy_against_time(*asked, **known)
    picture = output.with_name(f"{output.stem}-pareto.png")
    draw_front(front, picture)
    console.print(front_table(front))
    wrote(picture)


@app.command(rich_help_panel="Plan")
def advise(
    log: Annotated[Path, typer.Argument(help="Log (.mcap) of a trip over the same section.")],
    trajectory: Annotated[Path, typer.Option(help="Trajectory file.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The log with the advice (.mcap).")
    ],
) -> None:
    """Lay a trajectory's advice beside a recorded trip, so that a replay shows both.

    Example: trainlog advise trip.mcap --trajectory results/trajectory.json -o advised.mcap
    """
    from analysis.trajectory.advice import with_advice
    from trainlog.formats.trajectory import read_trajectory
    from trainlog.mcap import read_log, write_log

    destination(output, ".mcap")
    if output.resolve() == log.resolve():
        raise InputError("is the log itself", file=output, remedy="give the result another name")
    write_log(with_advice(read_log(log), read_trajectory(trajectory)), output)
    wrote(output)
