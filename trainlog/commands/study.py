"""Commands that run the systems of the papers as they were published."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainlog.commands.options import Seed
from trainlog.formats.files import made_folder
from trainlog.terminal import console, progress_bar, wrote

app = typer.Typer()
study_app = typer.Typer(
    no_args_is_help=True, help="Run a published system and compare it with its paper."
)
app.add_typer(study_app, name="study", rich_help_panel="Reproduce")


@study_app.command("rls-sliding-mode")
def rls_sliding_mode(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for logs and pictures.")],
    seed: Seed = 1,
) -> None:
    """Learn resistance by recursive least squares under sliding-mode control (paper 004).

    Runs the paper's three estimators and one that resets in part, with exact and with measured
    speed, and one with the slopes shifted within a sample. Writes every run as a log, draws the
    paper's figures and prints them beside the published ones.

    Example: trainlog study rls-sliding-mode -o results/rls-sliding-mode
    """
    from analysis.pictures.rls_sliding_mode import draw_study
    from analysis.report_studies import rls_sliding_mode_table
    from analysis.studies import rls_sliding_mode as study
    from analysis.studies.logs import name_of, trip_of
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
    logs = [output / f"{name_of(run)}.mcap" for run in runs[: 2 * count]]
    for run, log in zip(runs, logs, strict=False):
        write_log(trip_of(run, seed), log)
    pictures = draw_study(exact, measured, output)
    shifted = [exact[spatial.name], *runs[2 * count :]]
    console.print(rls_sliding_mode_table(exact, measured, {spatial.name: shifted}))
    wrote(*logs, *pictures)
