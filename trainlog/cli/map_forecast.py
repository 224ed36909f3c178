"""Commands that forecast by a track-condition map, and score forecasts: forecast, score."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trainlog.cli.map import map_app
from trainlog.cli.options import (
    AtOption,
    ChosenTrips,
    MapOrFolder,
    ZoneOption,
    destination,
    logs_in,
    moment,
)
from trainlog.cli.terminal import console, print_error, state, wrote
from trainlog.errors import InputError
from trainlog.progress import task, track

if TYPE_CHECKING:
    import pandas as pd

    from analysis.verification.scoring import Score

app = typer.Typer()
"""Empty: these commands stand among those of the map."""


@map_app.command("forecast")
def map_forecast(
    condition: MapOrFolder,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Forecast (CSV); of a network a folder of them.")
    ],
    at: AtOption = None,
    zone: ZoneOption = None,
    hours: Annotated[float, typer.Option(help="For how long it is said to hold.")] = 24.0,
    layer: Annotated[
        str | None, typer.Option(help="Rail condition; default: every one of the map.")
    ] = None,
) -> None:
    """Write what a map expects at a time as a forecast, in the form in which forecasts are scored.

    Only evidence of days before --at (UTC) is used. Where the map was not observed the forecast
    states nothing. Without --at it holds from the day after the last evidence.

    Example: trainlog map forecast results/wil.map --at 2026-11-22T06:00Z -o results/forecast.csv
    """
    from analysis.verification.forecasts import first_free, forecast_of
    from trainlog.condition import left_out
    from trainlog.formats.condition import read_map
    from trainlog.formats.forecast import write_forecast

    if condition.is_dir():
        _forecast_network(condition, output, moment(at, zone), hours, layer)
        return
    track = read_map(condition)
    destination(output, ".csv")
    time = moment(at, zone) or first_free(track)
    forecast = forecast_of(track, time, layer=layer, hours=hours)
    write_forecast(forecast, output)
    later = left_out(track, time)
    content = {
        "forecast": str(output),
        "line": forecast.line,
        "from": time.isoformat(),
        "hours": hours,
        "layers": sorted(set(forecast.layer)),
    }
    state(content)
    if later:
        console.print(f"  forecast {later}", highlight=False, soft_wrap=True)
    wrote(output)


def _forecast_network(
    folder: Path, output: Path, time: pd.Timestamp | None, hours: float, layer: str | None
) -> None:
    """Write a forecast for each edge of a network's folder of maps."""
    from analysis.network.maps import forecasts_of_network, network_map
    from trainlog.formats.files import output_folder
    from trainlog.formats.forecast import write_forecast

    when, found = forecasts_of_network(network_map(folder), time, layer, hours)
    with output_folder(output) as place:
        for path, forecast in found.items():
            write_forecast(forecast, place / path)
    state({"forecasts": str(output), "edges": len(found), "from": when.isoformat()})
    wrote(output)


@map_app.command("score")
def map_score(
    forecast: Annotated[
        Path,
        typer.Argument(help="Map file, a network's folder of maps, or a forecast (.csv)."),
    ],
    logs: Annotated[
        list[Path] | None,
        typer.Argument(help="Logs (.mcap) of later trips, or folders of logs."),
        ChosenTrips,
    ] = None,
    rolling: Annotated[
        bool,
        typer.Option("--rolling", help="Forecast each of the map's days from the days before."),
    ] = False,
    layer: Annotated[
        str | None,
        typer.Option(help="Rail condition to score; default: what each log states, or all."),
    ] = None,
    weather: Annotated[
        Path | None,
        typer.Option(help="Weather (CSV): the rail condition of logs that state none."),
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw the scores here.")] = None,
) -> None:
    """Score a map's forecast, or anyone's, on trips that it does not know.

    Log score of measured and of used adhesion with the gain over the prior, over persistence and
    over the place alone, reliability, Brier score of slip, slips foreseen against false alarms,
    coverage; bands by a bootstrap over days. Of a network, all edges together, and each. Where the
    forecast is unknown it is counted as unknown. What each figure means:
    docs/adhesion-forecast-verification.md. Exit status 1 if a log could not be used.

    Example: trainlog map score results/wil.map results/later-trips --picture results/score.png
    """
    from analysis.network.map_scores import edges_table
    from analysis.verification.plot import draw_score
    from analysis.verification.scoring import by_reason
    from analysis.verification.table import score_table

    if picture is not None:
        destination(picture, ".png")
    scored = _scored_network if forecast.is_dir() else _scored
    found = scored(forecast, logs or [], rolling, layer, weather)
    for words in found.refused:
        print_error(words)
    if picture is not None:
        draw_score(found, picture)
    if not state(found.details()):
        for words in by_reason(found.left_out):
            console.print(f"  {words}", highlight=False, soft_wrap=True)
        console.print(score_table(found))
        if found.edges:
            console.print(edges_table(found.edges))
    if picture is not None:
        wrote(picture)
    if found.refused:
        raise typer.Exit(1)


def _scored_network(
    folder: Path, logs: list[Path], rolling: bool, layer: str | None, weather: Path | None
) -> Score:
    from analysis.network.map_scores import score_network, score_network_on
    from analysis.network.maps import network_map
    from trainlog.formats.weather import read_weather

    _check_scored(logs, rolling, weather)
    maps = network_map(folder)
    if logs:
        sky = None if weather is None else read_weather(weather)
        return score_network_on(maps, track(logs_in(logs), "scoring", "log"), layer, sky)[0]
    with task("forecasting edge by edge", unit="edge") as step:
        chosen = None if layer is None else [layer]
        return score_network(maps, chosen, lambda done, edges: step(done, edges))[0]


def _check_scored(
    logs: list[Path], rolling: bool, weather: Path | None, *, foreign: bool = False
) -> None:
    """Refuse what contradicts itself: a map is scored on its own days, or on logs."""
    if rolling and weather is not None:
        raise InputError(
            "--weather gives the rail condition of logs, of which --rolling takes none",
            remedy="leave out --weather",
        )
    if rolling and (logs or foreign):
        raise InputError(
            "--rolling scores a map on its own days",
            remedy="leave out " + ("the logs" if logs else "--rolling, and give logs"),
        )
    if not rolling and not logs:
        raise InputError(
            "there is nothing to compare the forecast with",
            remedy="give logs of trips" + ("" if foreign else ", or --rolling"),
        )


def _scored(
    forecast: Path, logs: list[Path], rolling: bool, layer: str | None, weather: Path | None
) -> Score:
    from analysis.verification.scoring import line_of_logs, score_forecast, score_map, score_rolling
    from trainlog.formats.condition import read_map
    from trainlog.formats.forecast import read_forecast
    from trainlog.formats.weather import read_weather

    foreign = forecast.suffix.lower() == ".csv"
    _check_scored(logs, rolling, weather, foreign=foreign)
    if rolling:
        own = read_map(forecast)
        with task("forecasting day by day", unit="day") as step:
            return score_rolling(
                own,
                None if layer is None else [layer],
                lambda day, days: step(day - 1, days),
            )
    sky = None if weather is None else read_weather(weather)
    paths = logs_in(logs)
    stated = read_forecast(forecast, *line_of_logs(paths)) if foreign else None
    own_map = None if foreign else read_map(forecast)
    every = track(paths, "scoring", "log")
    if stated is not None:
        return score_forecast(stated, every, layer, sky)
    assert own_map is not None
    return score_map(own_map, every, layer, sky)
