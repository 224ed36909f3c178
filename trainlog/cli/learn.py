"""Commands that learn from logs: fit, estimate."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from trainlog.cli.commands import end_in_part
from trainlog.cli.options import (
    ChosenTrips,
    Logs,
    destination,
    distinct,
    logs_in,
    measured,
    refuse_rivals,
)
from trainlog.cli.terminal import console, print_error, show, state, wrote
from trainlog.display import counted
from trainlog.errors import InputError, LogError
from trainlog.progress import track
from trainlog.units import PERCENT, SPEED

if TYPE_CHECKING:
    from trainlog.presentation import Presented


def fit(
    logs: Annotated[
        list[Path],
        typer.Argument(
            help="Logs (.mcap), folders of logs, and summaries of earlier fits (.parquet). For"
            " adhesion: a CSV of creepage or slip speed, adhesion and, if known, train speed; units"
            " in the header."
        ),
        ChosenTrips,
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Parameter set, or other result (JSON).")
    ],
    method: Annotated[
        Literal["efforts", "coasting", "adhesion"],
        typer.Option(
            help="Running resistance from recorded efforts, or from where the train coasts; or the"
            " adhesion characteristic."
        ),
    ] = "efforts",
    picture: Annotated[
        Path | None, typer.Option(help="Picture; default: beside the output, .png.")
    ] = None,
    cover: Annotated[
        float | None,
        measured(
            "--cover",
            of=PERCENT.between(0.01, 0.9999),
            help="Of efforts: share of trips whose times and energies the set is to bound;"
            " default: 95%.",
        ),
    ] = None,
    configurations: Annotated[
        int | None, typer.Option(min=1, help="Of efforts: at most so many configurations.")
    ] = None,
    per_trip: Annotated[
        Path | None,
        typer.Option(
            help="Folder for a picture of each trip fitted, of efforts: residuals, what was masked,"
            " and why one was refused."
        ),
    ] = None,
    line: Annotated[
        Path | None, typer.Option(help="Of coasting: line file for logs that carry no line.")
    ] = None,
    gradient: Annotated[
        Literal["line", "unknown"] | None,
        typer.Option(
            help="Of coasting: 'unknown' trusts no gradients; coasting is found from the lever"
            " alone. Default: line."
        ),
    ] = None,
    family: Annotated[
        Literal["polach", "exponentials"] | None,
        typer.Option(
            help="Of adhesion: form of the curve; default: the one that explains the points better."
        ),
    ] = None,
    speed: Annotated[
        float | None,
        measured(
            "--speed",
            of=SPEED.above(0.0, 200.0),
            help="Of adhesion: train speed of points that do not state theirs.",
        ),
    ] = None,
) -> None:
    """Fit running resistance to trips, or adhesion to measured points.

    [bold]efforts[/bold]: recursive least squares, per trip and together. Writes the observed set of
    parameter configurations, with uncertainty, a picture, and the summaries of all trips, which
    stand for their logs in a later fit.

    [bold]coasting[/bold]: needs no efforts. Finds the coasting by itself from speed, chainage and
    the line's gradient, and gives the resistance over the train's inertia, with its band. With the
    gradient unknown it gives what is left: mostly how resistance grows with speed.

    [bold]adhesion[/bold]: maximum, optimal slip and slopes of an adhesion characteristic; trainlog
    simulate drive --characteristic drives on it.

    Trips and points that do not determine the result are refused with the reason.

    Example: trainlog fit results/trips -o results/parameters.json

    Example: trainlog fit results/recorded --method coasting -o results/coast-down.json

    Example: trainlog fit curve.csv --method adhesion -o wet.json
    """
    destination(output, ".json")
    shown = destination(picture or output.with_suffix(".png"), ".png")
    own: dict[str, dict[str, object]] = {
        "efforts": {"--cover": cover, "--configurations": configurations, "--per-trip": per_trip},
        "coasting": {"--line": line, "--gradient": gradient},
        "adhesion": {"--family": family, "--speed": speed},
    }
    for of, options in own.items():
        if of != method:
            refuse_rivals(f"the method is {method}", options, f"or choose --method {of}")
    if method == "efforts":
        from analysis.charts import draw_all
        from analysis.resistance.logs import AllRefusedError, fit as fit_trips
        from analysis.resistance.plot import trips_charts
        from trainlog.formats.files import output_folder
        from trainlog.formats.railway import write_parameters
        from trainlog.formats.summaries import SUFFIX, write_summaries

        kept = destination(output.with_suffix(SUFFIX), SUFFIX)
        with nullcontext() if per_trip is None else output_folder(per_trip) as drawn:
            # Summaries first: the logs that they hold need not be read.
            paths = sorted(logs_in(logs), key=lambda path: path.suffix != SUFFIX)
            given = track(paths, "fitting", "log")
            try:
                fits = fit_trips(given, cover=0.95 if cover is None else cover, most=configurations)
            except AllRefusedError as error:
                if drawn is not None:
                    wrote(*draw_all(trips_charts((), error.refused), drawn))
                raise
            write_parameters(fits.parameters, output)
            write_summaries(fits.summaries, kept)
            wrote(output, kept)
            show(fits, picture=shown)
            if drawn is not None:
                wrote(*draw_all(trips_charts(fits.trips, fits.refused), drawn))
        return
    found: Presented
    if method == "coasting":
        from analysis.resistance.coast_down import coast_down
        from analysis.resistance.unknown_gradient import coast_down_without_gradient
        from trainlog.formats.railway import write_coast_down

        every = track(logs_in(logs), "finding coasting", "log")
        if gradient == "unknown":
            found = result = coast_down_without_gradient(every, line)
        else:
            found = coasted = coast_down(every, line)
            result = coasted.result
        write_coast_down(result, output)
    else:
        from analysis.adhesion.characteristic import fit_adhesion_characteristic
        from trainlog.formats.characteristic import write_characteristic

        if len(logs) > 1:
            raise InputError("several tables are given", remedy="fit them one by one")
        found = fitted = fit_adhesion_characteristic(logs[0], family, speed=speed)
        write_characteristic(fitted.characteristic, output, fitted.provenance())
    wrote(output)
    show(found, picture=shown)


def estimate(
    logs: Logs,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the logs.")],
    slips: Annotated[
        Path | None,
        typer.Option(help="Table of the slip events of all logs (CSV): axle, creepage, energy ..."),
    ] = None,
) -> None:
    """Add estimates to logs: smoothed motion, running resistance, adhesion, slip.

    Example: trainlog estimate results/trips/trip-01.mcap -o results/estimated
    """
    from analysis.estimates import estimate_log, write_slip_table
    from trainlog.formats.files import output_folder

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
