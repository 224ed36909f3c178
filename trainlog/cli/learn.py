"""Commands that learn from logs: fit, estimate.

Parameters
----------
picture : FILE
    Picture (.png); default: beside the output.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

import analysis
import trainlog
from trainlog.cli.commands import end_in_part
from trainlog.cli.options import Count, Logs, Picture, Written, destination, distinct, logs_in
from trainlog.cli.terminal import console, print_error, say, show, state, wrote
from trainlog.display import counted
from trainlog.errors import LogError
from trainlog.progress import track
from trainlog.units import PERCENT, SPEED

if TYPE_CHECKING:
    from trainlog.presentation import Presented


fit_app = typer.Typer(
    add_completion=False, help="Fit running resistance to trips, or adhesion to measured points."
)

COVER = replace(PERCENT.between(0.5, 0.9999), examples="95 or 95%")


@fit_app.command("efforts")
def fit_efforts(
    logs: Logs,
    /,
    *,
    output: Annotated[Path, Written(".json")],
    picture: Picture = None,
    cover: Annotated[float, COVER] = 0.95,
    configurations: Count = None,
    per_trip: Path | None = None,
) -> None:
    """Fit running resistance to recorded efforts; short form: 'trainlog fit LOGS'.

    Recursive least squares, per trip and together. Writes the observed parameter set with
    uncertainty, a picture, and summaries of all trips, which can replace their logs in a later fit.
    Trips that do not determine the result are refused with the reason.

    Example: trainlog fit efforts results/trips -o results/parameters.json

    Parameters
    ----------
    logs : LOGS
        Logs (.mcap), folders of logs, and summaries of earlier fits (.parquet).
    output : FILE
        Parameter set (JSON).
    cover : SHARE
        Share of trips whose times and energies the set bounds.
    configurations : N
        Maximum number of configurations.
    per_trip : FOLDER
        Folder for a picture per trip: residuals, masks, reason of a refusal.
    """
    from analysis.charts import draw_all
    from analysis.resistance.logs import AllRefusedError
    from analysis.resistance.plot import trips_charts
    from trainlog.formats.files import output_folder
    from trainlog.formats.summaries import SUFFIX, write_summaries

    kept = destination(output.with_suffix(SUFFIX), SUFFIX)
    with nullcontext() if per_trip is None else output_folder(per_trip) as drawn:
        # Summaries first: the logs that they hold need not be read.
        paths = sorted(logs_in(logs), key=lambda path: path.suffix != SUFFIX)
        try:
            fits = analysis.fit(track(paths, "fitting", "log"), cover=cover, most=configurations)
        except AllRefusedError as error:
            if drawn is not None:
                wrote(*draw_all(trips_charts((), error.refused), drawn))
            raise
        trainlog.write_parameters(fits.parameters, output)
        write_summaries(fits.summaries, kept)
        wrote(output, kept)
        show(fits, picture=_beside(output, picture))
        if drawn is not None:
            wrote(*draw_all(trips_charts(fits.trips, fits.refused), drawn))


@fit_app.command("coasting")
def fit_coasting(
    logs: Logs,
    /,
    *,
    output: Annotated[Path, Written(".json")],
    picture: Picture = None,
    line: Path | None = None,
    gradient: Literal["line", "unknown"] = "line",
) -> None:
    """Fit running resistance to coasting; needs no efforts.

    Finds coasting from speed, chainage and gradient; the result is the resistance over the train's
    inertia, with its band. If the gradient is unknown, the result is mainly how resistance
    increases with speed. Trips that do not determine the result are refused with the reason.

    Example: trainlog fit coasting results/recorded -o results/coast-down.json

    Parameters
    ----------
    output : FILE
        Result (JSON).
    line : FILE
        Line file for logs without a line.
    gradient : NAME
        'unknown' does not use gradients; coasting is found from the lever only.
    """
    from trainlog.formats.railway import write_coast_down

    every = track(logs_in(logs), "finding coasting", "log")
    found: Presented
    if gradient == "unknown":
        found = result = analysis.coast_down_without_gradient(every, line)
    else:
        found = coasted = analysis.coast_down(every, line)
        result = coasted.result
    write_coast_down(result, output)
    wrote(output)
    show(found, picture=_beside(output, picture))


@fit_app.command("adhesion")
def fit_adhesion(
    points: Path,
    /,
    *,
    output: Annotated[Path, Written(".json")],
    picture: Picture = None,
    family: Literal["polach", "exponentials"] | None = None,
    speed: Annotated[float | None, SPEED.above(0.0, 200.0)] = None,
) -> None:
    """Fit an adhesion characteristic to measured points: maximum, optimal slip and slopes.

    'trainlog simulate drive --characteristic' uses the result. Points that do not determine it are
    refused with the reason.

    Example: trainlog fit adhesion curve.csv -o wet.json

    Parameters
    ----------
    points : POINTS
        CSV of creepage or slip speed, adhesion and, if known, train speed; units in the header.
    output : FILE
        Characteristic (JSON).
    family : NAME
        Form of the curve; default: the one that fits better.
    speed : SPEED
        Train speed of points that do not state it.
    """
    fitted = analysis.fit_adhesion_characteristic(points, family, speed=speed)
    trainlog.write_characteristic(fitted.characteristic, output, fitted.provenance())
    wrote(output)
    show(fitted, picture=_beside(output, picture))


def _beside(output: Path, picture: Path | None) -> Path:
    """The picture that is named, or the one beside the output."""
    return picture or output.with_suffix(".png")


def estimate(logs: Logs, /, *, output: Path, slips: Path | None = None) -> None:
    """Add estimates to logs: smoothed motion, running resistance, adhesion, slip.

    Example: trainlog estimate results/trips/trip-01.mcap -o results/estimated

    Parameters
    ----------
    output : FOLDER
        Folder for the logs.
    slips : FILE
        Table of the slip events of all logs (CSV): axle, creepage, energy ...
    """
    from analysis.estimates import estimate_log, write_slip_table
    from trainlog.formats.files import check_kept, output_folder

    found, refused, analysed = logs_in(logs), 0, list[Path]()
    estimated: list[dict[str, object]] = []
    table = None if slips is None else destination(slips, ".csv")
    distinct([log.name for log in found], found)
    with output_folder(output):
        for log in track(found, "estimating", "log"):
            check_kept([log], output / log.name)
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
                say(words)
            wrote(output / log.name)
            if not any(refusal.partition(": ")[0] == "adhesion" for refusal in refusals):
                analysed.append(log)
    if table is not None and analysed:
        console.print(f"{counted(write_slip_table(analysed, table), 'slip event')}")
        wrote(table)
    elif table is not None:
        refused += 1
        print_error(f"{table}: is not written: no log shows slip; give logs with /train/axles")
    end_in_part(refused, len(found) + (table is not None))
