"""Commands that run the systems of the papers as they were published."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trainlog.cli.options import Count, Seed
from trainlog.cli.terminal import console, wrote
from trainlog.units import COUNT, SPEED

if TYPE_CHECKING:
    from analysis.studies.report import StudyReport

study_app = typer.Typer(
    add_completion=False,
    help="Reproduce a published system, or compute in-train forces.",
)


@contextmanager
def _reported(output: Path) -> Iterator[StudyReport]:
    """A report of a study; at the end the files that it wrote are listed."""
    from analysis.studies.report import StudyReport

    report = StudyReport(output, console)
    yield report
    wrote(*report.files)


@study_app.command("rls-sliding-mode")
def rls_sliding_mode(*, output: Path, seed: Seed = 1) -> None:
    """Estimate resistance by recursive least squares under sliding-mode control.

    Amirhosseini et al. (2024): the paper's three estimators and one with a partial reset, with
    exact and measured speed, with slopes shifted within a sample, and with eight coupled wagons.
    Writes logs and the paper's figures, and prints results and published values.

    Example: trainlog study rls-sliding-mode -o results/rls-sliding-mode

    Parameters
    ----------
    output : FOLDER
        Folder for logs and pictures.
    """
    from analysis.studies.amirhosseini_2024 import main

    with _reported(output) as report:
        main(report, seed)


@study_app.command("consist")
def consist(
    file: Path | None = None,
    /,
    *,
    output: Path,
    line: Path | None = None,
    speed: Annotated[float | None, SPEED.above(0.0)] = None,
) -> None:
    """Compute forces between vehicles: start, gradients, full and emergency braking.

    Prints the largest force of each coupler, the energy balance and the motion of a single particle
    under the same demands; writes a log and a picture.

    Example: trainlog study consist freight_24_wagons.consist.json -o results/consist

    Parameters
    ----------
    output : FOLDER
        Folder for log and picture.
    file : FILE
        Consist file; default: the freight train of the samples.
    line : FILE
        Line file; default: 12 km with a crest and a sag.
    speed : SPEED
        Speed to keep; default: 80 km/h.
    """
    from analysis.studies.in_train_forces import ConsistOptions, main
    from trainlog.units import KMH

    with _reported(output) as report:
        main(report, ConsistOptions(file, line, 80.0 / KMH if speed is None else speed))


@study_app.command("map-mpc")
def map_mpc(
    *,
    output: Path,
    sections: Count = None,
    days: Annotated[int, COUNT.between(2.0)] = 2,
    as_published: bool = False,
    seed: Seed = 1,
) -> None:
    """Follow a timetable with a map of the rail, and without one (Hauck et al., 2023).

    Runs the paper's scenarios on a reconstruction of the line Chemnitz-Cranzahl, with a drawn mass
    and both ends of its range, by the controller of 'trainlog simulate follow' with and without the
    map. Then builds the map from the logs of a day without it and drives again. Writes logs and the
    paper's figures, and prints tables after each mass and day. The whole line takes minutes;
    results before an interruption are kept.

    Example: trainlog study map-mpc -o results/map-mpc

    Parameters
    ----------
    output : FOLDER
        Folder for logs and pictures.
    sections : N
        Number of sections from the start of the line; default: all.
    days : N
        Number of days.
    as_published
        Use the published controller: linearised about the reference, R = 0.01, without a guard; no
        days.
    """
    from analysis.studies.hauck_2023.run import MapOptions, main

    with _reported(output) as report:
        main(report, MapOptions(sections, days, seed, as_published))


@study_app.command("robust-minimax")
def robust_minimax(
    *, output: Path, cells: Annotated[int, COUNT.between(60.0, 5000.0)] = 500
) -> None:
    """Optimise for several configurations at once (Cunillera et al., 2022).

    Solves the paper's minimax problem as printed (common traction, common braking, speeds above 0)
    and with separate braking per configuration, on level track and on a downhill; integrates its
    equations, finds its five phases by the switching function, and states the cost of robustness.
    Writes trajectories and pictures.

    Example: trainlog study robust-minimax -o results/robust-minimax

    Parameters
    ----------
    output : FOLDER
        Folder for trajectories and pictures.
    cells : N
        Cells of the grid.
    """
    from analysis.studies.cunillera_2022 import main

    with _reported(output) as report:
        main(report, cells)


@study_app.command("cooperative-adhesion")
def cooperative_adhesion(*, output: Path) -> None:
    """Share torque among four motors while the rail under them changes (Zhao et al., 2025).

    Runs the paper's four cases with its parameters, with the paper's integration and an accurate
    one, and with those of a locomotive of 85 t; then without cooperation.
    Writes logs and the paper's figures, and prints results and published values.

    Example: trainlog study cooperative-adhesion -o results/cooperative-adhesion

    Parameters
    ----------
    output : FOLDER
        Folder for logs and pictures.
    """
    from analysis.studies.zhao_2025 import main

    with _reported(output) as report:
        main(report)
