"""Commands that learn from logs: fit, estimate, coast-down."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Literal

import typer

from trainlog.cli.commands import end_in_part
from trainlog.cli.options import (
    ChosenTrips,
    Logs,
    TakesSummaries,
    destination,
    distinct,
    logs_in,
)
from trainlog.cli.terminal import console, print_error, show, state, wrote
from trainlog.display import counted
from trainlog.errors import InputError, LogError
from trainlog.formats.files import output_folder
from trainlog.progress import track
from trainlog.units import KMH

app = typer.Typer()
adhesion_app = typer.Typer(
    no_args_is_help=True, help="Adhesion between wheel and rail over slip: characteristics."
)
app.add_typer(adhesion_app, name="adhesion", rich_help_panel="Learn")


@app.command(rich_help_panel="Learn")
def fit(
    logs: Annotated[
        list[Path],
        typer.Argument(
            help="Logs (.mcap), folders of logs, and summaries of earlier fits (.parquet)."
        ),
        ChosenTrips,
        TakesSummaries,
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Observed parameter set (JSON).")],
    cover: Annotated[
        float,
        typer.Option(help="Share of trips (%) whose times and energies the set is to bound."),
    ] = 95.0,
    configurations: Annotated[
        int | None, typer.Option(min=1, help="At most so many configurations.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture; default: beside the output, .png.")
    ] = None,
    per_trip: Annotated[
        Path | None,
        typer.Option(
            help="Folder for a picture of each trip fitted: residuals, what was masked, and why one"
            " was refused."
        ),
    ] = None,
) -> None:
    """Fit running resistance by recursive least squares, per trip and together.

    Writes the observed set of parameter configurations, with uncertainty, a picture, and the
    summaries of all trips, which stand for their logs in a later fit. Trips that do not determine
    the resistance are refused with the reason.

    Example: trainlog fit results/trips -o results/parameters.json
    """
    from analysis.resistance.logs import AllRefusedError, fit as fit_trips
    from analysis.resistance.plot import draw_each, draw_each_refused, draw_fits
    from trainlog.formats.parameters import write_parameters
    from trainlog.formats.summaries import SUFFIX, write_summaries

    destination(output, ".json")
    shown = destination(picture or output.with_suffix(".png"), ".png")
    kept = destination(output.with_suffix(SUFFIX), SUFFIX)
    if not 1.0 <= cover < 100.0:
        raise InputError(
            f"--cover {cover:g} must be at least 1 and below 100",
            remedy="give a share in %, such as 95",
        )
    with nullcontext() if per_trip is None else output_folder(per_trip) as drawn:
        # Summaries first: the logs that they hold need not be read.
        paths = sorted(logs_in(logs), key=lambda path: path.suffix != SUFFIX)
        given = track(paths, "fitting", "log")
        try:
            fits = fit_trips(given, cover=cover / 100.0, most=configurations)
        except AllRefusedError as error:
            if drawn is not None:
                wrote(*draw_each_refused(error.refused, drawn))
            raise
        write_parameters(fits.parameters, output)
        write_summaries(fits.summaries, kept)
        draw_fits(fits, shown)
        show(fits)
        wrote(output, kept, shown)
        if drawn is not None:
            wrote(*draw_each(fits, drawn))


@app.command(rich_help_panel="Learn")
def estimate(
    logs: Logs,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the logs.")],
    slips: Annotated[
        Path | None,
        typer.Option(help="Table of the slip events of all logs (CSV): axle, creepage, energy ..."),
    ] = None,
) -> None:
    """Add estimates to logs: smoothed motion, running resistance as it is learnt, adhesion, slip.

    Example: trainlog estimate results/trips/trip-01.mcap -o results/estimated
    """
    from analysis.estimates import estimate_log, write_slip_table

    found, refused, analysed = logs_in(logs), 0, list[Path]()
    estimated: list[dict[str, object]] = []
    table = None if slips is None else destination(slips, ".csv")
    distinct([log.name for log in found], found)
    with output_folder(output):
        for log in track(found, "estimating", "log"):
            if (output / log.name).resolve() == log.resolve():
                raise InputError("would be overwritten", file=log, remedy="name another folder")
            try:
                refusals = estimate_log(log, output / log.name)
            except LogError as error:
                # One log of which nothing can be estimated does not keep the others from it.
                if len(found) == 1:
                    raise
                refused += 1
                print_error(str(error))
                continue
            estimated.append({"log": output / log.name, "not_estimated": list(refusals)})
            state({"logs": estimated})
            for refusal in refusals:
                words = f"  not estimated: {refusal}"
                console.print(words, highlight=False, markup=False, soft_wrap=True)
            wrote(output / log.name)
            if not any(refusal.partition(": ")[0] == "adhesion" for refusal in refusals):
                analysed.append(log)
    if table is not None:
        if not analysed:
            raise LogError("no log shows slip", remedy="give logs with /train/axles")
        console.print(f"{counted(write_slip_table(analysed, table), 'slip event')}")
        wrote(table)
    end_in_part(refused, len(found))


@app.command("coast-down", rich_help_panel="Learn")
def coast_down(
    logs: Logs,
    output: Annotated[Path, typer.Option("--output", "-o", help="Result (JSON).")],
    line: Annotated[
        Path | None, typer.Option(help="Line file for logs that carry no line.")
    ] = None,
    gradient: Annotated[
        Literal["line", "unknown"],
        typer.Option(help="'unknown': trust no gradients; coasting is found from the lever alone."),
    ] = "line",
    picture: Annotated[
        Path | None, typer.Option(help="Picture; default: beside the output, .png.")
    ] = None,
) -> None:
    """Learn running resistance from where the train coasts; no efforts are needed.

    Finds the coasting by itself from speed, chainage and the line's gradient, and gives the
    resistance over the train's inertia, with its band. With the gradient unknown it gives what is
    left: mostly how resistance grows with speed. Recordings that do not show it are refused with
    the reason.

    Example: trainlog coast-down results/recorded -o results/coast-down.json
    """
    from analysis.resistance import coast_down as coasting, plot, unknown_gradient
    from trainlog.formats.parameters import write_coast_down

    destination(output, ".json")
    shown = destination(picture or output.with_suffix(".png"), ".png")
    every = track(logs_in(logs), "finding coasting", "log")
    if gradient == "unknown":
        result = unknown_gradient.coast_down_without_gradient(every, line)
    else:
        found = coasting.coast_down(every, line)
        result = found.result
    write_coast_down(result, output)
    if gradient == "unknown":
        plot.draw_without_gradient(result, shown)
        show(result)
    else:
        plot.draw_coast_down(found, shown)
        show(found)
    wrote(output, shown)


@adhesion_app.command("fit")
def adhesion_fit(
    curve: Annotated[
        Path,
        typer.Argument(
            help="CSV of creepage or slip speed, adhesion and, if known, train speed; units in the"
            " header."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Characteristic (JSON).")],
    family: Annotated[
        Literal["polach", "exponentials"] | None,
        typer.Option(help="Form of the curve; default: the one that explains the points better."),
    ] = None,
    speed: Annotated[
        float | None, typer.Option(help="Train speed in km/h, of points that do not state theirs.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture; default: beside the output, .png.")
    ] = None,
) -> None:
    """Fit an adhesion characteristic to measured points: maximum, optimal slip, slopes.

    Points that do not show the maximum are refused with the reason. The result can be driven on:
    trainlog simulate --characteristic.

    Example: trainlog adhesion fit curve.csv -o wet.json
    """
    from analysis.adhesion.characteristic import (
        MOST_SPEED,
        characteristic_table,
        fit_adhesion_characteristic,
    )
    from analysis.adhesion.plot import draw_characteristic
    from trainlog.formats.characteristic import write_characteristic

    destination(output, ".json")
    shown = destination(picture or output.with_suffix(".png"), ".png")
    if speed is not None and not 0.0 < speed < KMH * MOST_SPEED:
        raise InputError(
            f"--speed: {speed:g} km/h is not between 0 and {KMH * MOST_SPEED:g} km/h",
            remedy="give the train's speed in km/h",
        )
    found = fit_adhesion_characteristic(curve, family, speed=None if speed is None else speed / KMH)
    write_characteristic(found.characteristic, output, found.provenance())
    draw_characteristic(found, shown)
    if not state({"family": found.family, "fit": found.provenance()}):
        console.print(characteristic_table(found))
    wrote(output, shown)
