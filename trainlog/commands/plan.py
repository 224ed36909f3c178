"""Commands that plan: optimise."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

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
        Literal["wheel", "line"],
        typer.Option(
            help="Traction at the wheel rims as in the paper, or energy from the line: efficiencies"
            " and what the dynamic brake feeds back."
        ),
    ] = "wheel",
    condition: Annotated[
        Path | None, typer.Option("--map", help="Track-condition map that limits the efforts.")
    ] = None,
    layer: Annotated[
        Literal["dry", "wet"], typer.Option(help="Rail condition of the map.")
    ] = "wet",
    cells: Annotated[
        int,
        typer.Option(
            min=20, max=20_000, help="Cells of the grid; at least one for each step of the line."
        ),
    ] = 500,
    referee: Annotated[
        bool, typer.Option("--referee", help="Solve it again with CasADi and IPOPT, and compare.")
    ] = False,
) -> None:
    """Find the trajectory of least energy that every observed configuration can follow.

    The answer carries its certificate: an independent fine rollout of every configuration and a
    lower bound on the energy.

    Example: trainlog optimise results/parameters.json -o results/trajectory.json
    """
    from analysis.compare import fastest_nonstop
    from analysis.pictures.trajectory import draw_trajectory
    from analysis.report import trajectory_table
    from analysis.trajectory import optimise as solve
    from trainlog.formats.condition import read_map
    from trainlog.formats.parameters import read_parameters
    from trainlog.formats.trajectory import write_trajectory

    destination(output, ".json")
    the_line, the_train = line_and_train(line, train)
    observed = read_parameters(parameters)
    observed.check_train(the_train.name)
    if as_fast_as is not None:
        if running_time is not None:
            raise InputError("--running-time and --as-fast-as contradict", remedy="give one")
        running_time = fastest_nonstop(logs_in([as_fast_as]), the_line)
    with working(f"optimising over {len(observed.configurations)} configurations"):
        trajectory = solve(
            the_line,
            the_train,
            observed.configurations,
            running_time=running_time,
            reserve=reserve / 100.0,
            braking=braking,
            objective=objective,
            condition_map=None if condition is None else read_map(condition),
            layer=layer,
            cells=cells,
            referee=referee,
        )
    write_trajectory(trajectory, output)
    draw_trajectory(trajectory, the_line, output.with_suffix(".png"))
    console.print(trajectory_table(trajectory))
    wrote(output, output.with_suffix(".png"))
