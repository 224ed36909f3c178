"""Commands that run the systems of the papers as they were published."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainlog.cli.options import Seed
from trainlog.cli.terminal import console, progress_bar, working, wrote
from trainlog.formats.files import made_folder

app = typer.Typer()
study_app = typer.Typer(
    no_args_is_help=True,
    help="Run a published system beside its paper, or the dynamics inside a train.",
)
app.add_typer(study_app, name="study", rich_help_panel="Reproduce")


DEFAULT_CONSIST = "freight_24_wagons.consist.json"
"""The sample that is run where none is named."""


@study_app.command("rls-sliding-mode")
def rls_sliding_mode(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for logs and pictures.")],
    seed: Seed = 1,
) -> None:
    """Learn resistance by recursive least squares under sliding-mode control (paper 004).

    Runs the paper's three estimators and one that resets in part, with exact and with measured
    speed, with the slopes shifted within a sample, and with eight coupled wagons. Writes the runs
    as logs, draws the paper's figures and prints them beside the published ones.

    Example: trainlog study rls-sliding-mode -o results/rls-sliding-mode
    """
    from analysis.studies.amirhosseini_2024 import run as study
    from analysis.studies.amirhosseini_2024.plot import draw_study
    from analysis.studies.amirhosseini_2024.table import eight_wagons_table, rls_sliding_mode_table
    from analysis.studies.amirhosseini_2024.trips import name_of, trip_of
    from trainlog.mcap import write_log

    shifts = study.edge_shifts(5)[1:]
    spatial = next(each for each in study.VARIANTS if each.reset == "space")
    plans = [
        *((variant, 0.0, 0.0) for variant in study.VARIANTS),
        *((variant, study.SPEED_NOISE, 0.0) for variant in study.VARIANTS),
        *((spatial, 0.0, float(shift)) for shift in shifts),
    ]
    made_folder(output)
    with progress_bar() as progress:
        runs = [
            study.run(variant, noise=noise, shift=shift, seed=seed)
            for variant, noise, shift in progress.track(plans, description="driving")
        ]
    count = len(study.VARIANTS)
    exact = {run.variant.name: run for run in runs[:count]}
    measured = {run.variant.name: run for run in runs[count : 2 * count]}
    coupled = [
        study.run(variant, train=study.eight_wagons(first_pulls=alone), seed=seed)
        for variant in (study.VARIANTS[0], spatial)
        for alone in (False, True)
    ]
    kept = [*runs[: 2 * count], *coupled]
    logs = [output / f"{name_of(run)}.mcap" for run in kept]
    for run, log in zip(kept, logs, strict=True):
        write_log(trip_of(run, seed), log)
    pictures = draw_study(exact, measured, coupled, output)
    shifted = [exact[spatial.name], *runs[2 * count :]]
    console.print(rls_sliding_mode_table(exact, measured, {spatial.name: shifted}))
    console.print(eight_wagons_table(exact, coupled))
    wrote(*logs, *pictures)


@study_app.command("consist")
def consist(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for log and picture.")],
    file: Annotated[
        Path | None, typer.Argument(help="Consist file; default: the freight train of the samples.")
    ] = None,
    line: Annotated[
        Path | None, typer.Option(help="Line file; default: 12 km with a crest and a sag.")
    ] = None,
    speed: Annotated[float, typer.Option(min=1.0, help="Speed to keep, in km/h.")] = 80.0,
) -> None:
    """Forces between the vehicles of a train: start, gradients, full and emergency braking.

    Prints the largest force of each coupler, the balance of energy and what a single particle
    would have done under the same demands; writes the run as a log and draws it.

    Example: trainlog study consist freight_24_wagons.consist.json -o results/consist
    """
    from analysis.studies.amirhosseini_2024.trips import consist_trip
    from analysis.studies.in_train_forces import run as study
    from analysis.studies.in_train_forces.plot import draw_in_train_forces
    from analysis.studies.in_train_forces.table import forces_table
    from trainlog.formats.line import read_line
    from trainlog.formats.samples import sample
    from trainlog.formats.train import read_consist
    from trainlog.mcap import write_log
    from trainlog.units import KMH

    source = sample(DEFAULT_CONSIST) if file is None else file
    train = read_consist(source)
    track = study.crest_and_sag() if line is None else read_line(line)
    made_folder(output)
    with working(f"driving {train.name}"):
        run = study.run(train, track, speed=speed / KMH)
    name = source.name.removesuffix(".json").removesuffix(".consist")
    log, picture = output / f"{name}.mcap", output / f"{name}.png"
    write_log(consist_trip(run), log)
    draw_in_train_forces(run, picture)
    console.print(forces_table(run))
    wrote(log, picture)


@study_app.command("map-mpc")
def map_mpc(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for logs and pictures.")],
    sections: Annotated[
        int | None, typer.Option(min=1, help="Only the first sections of the line; default: all.")
    ] = None,
    days: Annotated[int, typer.Option(min=2, help="How many days the loop is driven.")] = 2,
    seed: Seed = 1,
) -> None:
    """Follow a timetable with a map of the rail, and without one (paper 000).

    Runs the paper's three scenarios on a reconstruction of the line Chemnitz-Cranzahl, with a mass
    drawn from its range and with both ends of it, by a controller that knows the map and by one
    that knows none. Then builds the map from the logs of a day without it and drives again. Writes
    the trips as logs, draws the paper's figures and prints the tables: for each mass as soon as its
    scenarios are driven, and after each day the days so far.

    Example: trainlog study map-mpc -o results/map-mpc
    """
    from analysis.studies.hauck_2023 import scenarios as study
    from analysis.studies.hauck_2023.days import day_by_day
    from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN
    from analysis.studies.hauck_2023.plot import draw_study
    from analysis.studies.hauck_2023.plot_days import draw_days
    from analysis.studies.hauck_2023.table import (
        counted_on,
        days_table,
        gain_table,
        lateness_table,
        published_table,
        references_table,
        tracking_table,
    )
    from analysis.studies.hauck_2023.trips import trip_of
    from trainlog.mcap import write_log

    made_folder(output)
    with progress_bar() as progress:
        known = study.prepared(
            seed, sections, lambda each: progress.track(each, description="references")
        )
        console.print(published_table(), references_table(known.plan))
        drawn = study.drawn_masses(seed, 3)
        plans = [
            (scenario, float(mass))
            for mass in (drawn[0], PUBLISHED_TRAIN.mass, PUBLISHED_TRAIN.max_mass)
            for scenario in study.SCENARIOS
        ]
        outcomes = []
        for plan in progress.track(plans, description="driving"):
            outcomes.append(study.outcome(known, *plan))
            if len(outcomes) % len(study.SCENARIOS) == 0:
                of_mass = outcomes[-len(study.SCENARIOS) :]
                for made in (tracking_table, lateness_table, gain_table):
                    console.print(made(of_mass))
    logs = []
    for each in outcomes[: len(study.SCENARIOS)]:
        weather = "dry" if each.scenario.weather == "good" else "wet"
        for found in (each.informed, each.blind):
            trip = trip_of(found, weather, seed)
            logs.append(output / f"{trip.metadata['trip']}.mcap")
            write_log(trip, logs[-1])
    with working(f"driving {days} days"):
        rails = [known.rails["bad"]] * days
        for driven in day_by_day(known.plan, rails, drawn.tolist(), output, seed):
            console.print(days_table(driven))
    console.print(counted_on(driven))
    pictures = draw_study(known, outcomes[: len(study.SCENARIOS)], output)
    pictures.append(output / "two-days.png")
    draw_days(driven, pictures[-1])
    wrote(*logs, *driven.logs, *pictures)


@study_app.command("robust-minimax")
def robust_minimax(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for trajectories and pictures.")
    ],
    cells: Annotated[int, typer.Option(min=60, max=5_000, help="Cells of the grid.")] = 500,
) -> None:
    """Optimise for several configurations at once (paper 002).

    States the paper's minimax problem as printed (common traction, common braking, speeds above 0)
    and with a brake for each configuration, on level track and on a downhill; integrates its
    equations, tells its five phases by the switching function, and what robustness costs and
    saves. Writes every answer as a trajectory and draws it.

    Example: trainlog study robust-minimax -o results/robust-minimax
    """
    from analysis.studies.cunillera_2022 import run as study
    from analysis.studies.cunillera_2022 import table as report
    from analysis.studies.cunillera_2022.plot import draw_others
    from analysis.trajectory.plot import draw_trajectory
    from trainlog.formats.trajectory import write_trajectory

    made_folder(output)
    level, slope, chosen = study.level(), study.downhill(), study.configurations()
    with progress_bar() as progress:
        answers = {
            name: study.solved(instance, some, braking, cells=cells)
            for name, (instance, some, braking) in progress.track(
                list(study.questions(level, slope, chosen).items()), description="optimising"
            )
        }
        ends = [
            study.end_of(level, share, cells=cells)
            for share in progress.track(study.SHARES, description="lowest common end speeds")
        ]
    files = []
    for name, found in answers.items():
        files += [output / f"{name}.json", output / f"{name}.png"]
        write_trajectory(found, files[-2])
        line = slope.line if found.line == slope.line.name else level.line
        draw_trajectory(found, line, files[-1])
    alone = {each.name: answers[f"level-{each.name}"] for each in chosen}
    common, recourse = answers["level-common"], answers["level-recourse"]
    files.append(output / "nominal-driven-by-others.png")
    draw_others(level, alone[study.NOMINAL], common, chosen, files[-1])
    on_level = [pair for pair in answers.items() if pair[1].line == level.line.name]
    for table in (
        report.configurations_table(level),
        report.price_table(alone, common, recourse),
        report.printed_table(level, common),
        report.phases_table(list(answers.items())),
        report.cruise_table(on_level),
        report.others_table(level, alone[study.NOMINAL], common, chosen),
        report.ends_table(ends),
    ):
        console.print(table)
    wrote(*files)


@study_app.command("cooperative-adhesion")
def cooperative_adhesion(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for logs and pictures.")],
    seed: Seed = 1,
) -> None:
    """Share torque among four motors while the rail under them changes (paper 003).

    Runs the paper's four cases with its parameters, stepped as in the paper and integrated
    properly, and with those of a locomotive of 85 t; then the same without cooperation, and
    without knowing the rail. Writes the runs as logs, draws the paper's figures and prints them
    beside the published ones.

    Example: trainlog study cooperative-adhesion -o results/cooperative-adhesion
    """
    from analysis.studies.zhao_2025 import run as study
    from analysis.studies.zhao_2025.knowledge import by_knowledge
    from analysis.studies.zhao_2025.plot import draw_rail, draw_study
    from analysis.studies.zhao_2025.table import (
        gain_table,
        knowledge_table,
        published_table,
        torque_table,
    )
    from analysis.studies.zhao_2025.trips import name_of, trip_of
    from trainlog.mcap import write_log

    made_folder(output)
    with progress_bar() as progress:
        runs = [
            study.run(case, preset, integration=integration)
            for case, preset, integration in progress.track(study.PLANS, description="driving")
        ]
        compared = {
            strategy: [study.run(*plan, strategy=strategy) for plan in study.COMPARED]
            for strategy in progress.track(list(study.STRATEGIES), description="comparing")
        }
    with working("driving on rails that are not known"):
        known = by_knowledge(seed)
    logs = [output / f"{name_of(run)}.mcap" for run in runs]
    for run, log in zip(runs, logs, strict=True):
        write_log(trip_of(run), log)
    pictures = [*draw_study(runs, compared, output), output / "rail-learnt.png"]
    draw_rail([run for run in known["learnt"] if run is not None][:4], pictures[-1])
    for table in (published_table(), torque_table(runs), gain_table(compared)):
        console.print(table)
    console.print(knowledge_table(known))
    wrote(*logs, *pictures)
