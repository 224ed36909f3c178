"""Commands of the track-condition map: update, show, diff, forecast, score, export, merge ...

Parameters
----------
line : FILE
    Line file, or a log with a line: stations, operator's kilometres, coordinates. Default: a sample
    line of the map's name, or that of its logs.
condition : MAP
    Map file (.map).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import analysis
import trainlog
from trainlog.cli.options import (
    ChosenTrips,
    Count,
    Logs,
    Picture,
    Written,
    destination,
    logs_in,
    moment,
    named_apart,
    refuse_rivals,
    stretch,
    zone_assumed,
)
from trainlog.cli.terminal import console, current, print_error, say, show, state, wrote
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.progress import task, track as tracked
from trainlog.units import HOURS, KILOMETRE, NUMBER, SHARE

if TYPE_CHECKING:
    from collections.abc import Callable

    import pandas as pd

    from analysis.adhesion.condition_map import LogOutcome, MapUpdate
    from analysis.verification.scoring import Score

map_app = typer.Typer(add_completion=False, help="The track-condition map: maximum adhesion.")


@map_app.command("update")
def map_update(
    logs: Logs,
    /,
    *,
    map_: Path,
    network: Path | None = None,
    layer: str | None = None,
    weather: Path | None = None,
    retry: bool = False,
) -> None:
    """Add the evidence of trips to the track-condition map: slip events and adhesion in use.

    A drive counts once, also if it comes in another file; a fuller recording replaces a poorer one.
    A copy with rounded values or other times counts as another drive: leave such copies out. Each
    trip is stored when its line appears. Several processes may add to one map.

    Exit status 1 if some logs could not be used, or are held under another rail condition; 2 if
    none could be used. A refused log is reported once; later updates only count it. A log without
    axle speeds is listed and is not a failure.

    With --network trips count on each edge of their route, at the chainage of the edge; trips on an
    ordinary line count on the edge of its name. The folder keeps the network.

    Example: trainlog map update results/trips --map results/wil.map

    Parameters
    ----------
    map_ : FILE
        Map file (.map), or folder of maps of a network; created if missing.
    network : FILE
        Network file: one map per edge, in the folder of --map.
    layer : CONDITION
        Rail condition, such as wet or leaves; default: that of each log.
    weather : FILE
        CSV of times, rail conditions, temperature, humidity and rain: rail condition of logs
        without one, and data kept for each trip.
    retry
        Try refused logs again.
    """
    from collections import Counter
    from functools import partial

    from trainlog.formats.mapfile import MapFile

    if map_.is_file():
        MapFile(map_).close()  # what is no map is named before logs are read
    of_network = network is not None or map_.is_dir()
    if of_network:
        from analysis.network.maps import update_network_map

        edges = None if network is None else trainlog.read_network(network)
        adding: Callable[..., MapUpdate] = partial(update_network_map, network=edges)
    else:
        destination(map_, ".map")
        adding = analysis.update_map
    stated = None if weather is None else trainlog.read_weather(weather)
    found, done = logs_in(logs), Counter[str]()

    def report(outcome: LogOutcome) -> None:
        done[outcome.outcome] += 1
        step(done.total())
        if outcome.outcome == "refused":
            print_error(outcome.reason)
        elif outcome.outcome == "refused before" or output.as_json:
            return
        elif outcome.outcome == "not recorded":
            say(f"  not used: {outcome.reason}")
        elif outcome.outcome != "held" or outcome.reason:
            say(f"  {outcome.sentence}")

    def finished() -> str:
        added = f"{counted(done['added'], 'trip')} added"
        return added if map_.exists() else f"{added}, no map was made"

    output = current()
    output.finished = finished
    with task("mapping", len(found), "log") as step:
        result = adding(found, map_, layer=layer, weather=stated, retry=retry, report=report)
    show(result)
    unusable = result.of("refused", "not recorded", "refused before")
    if len(unusable) == len(result.logs) and (result.refused or not result.made):
        if output.quiet and not result.refused:
            print_error(f"{map_}: is not made: {'; '.join(result.notes)}")
        raise typer.Exit(2)
    if result.refused or result.elsewhere:
        raise typer.Exit(1)


@map_app.command("show")
def map_show(
    condition: Path,
    /,
    *,
    at: str | None = None,
    zone: str | None = None,
    layer: list[str] | None = None,
    picture: Picture = None,
    km: str | None = None,
    line: Path | None = None,
    model: bool = False,
    days: Count = None,
) -> None:
    """Show the estimates of a track-condition map, and the length without data.

    The lowest places with their permanent and expected maximum adhesion, temporary spots with their
    probability, and changes with their dates; --model adds the parameters of the model. A past --at
    uses only the evidence of the days before. For the folder of a network: one row per edge and
    rail condition, and the network coloured by expected adhesion. For one place: the evidence over
    time. Pictures of several layers get the layer in their names.

    Example: trainlog map show results/wil.map --at 2026-11-22T06:00+01:00 --picture map.png

    Example: trainlog map show results/wil.map --km 12.3 --layer wet --picture place.png

    Parameters
    ----------
    condition : MAP
        Map file (.map), or folder of maps of a network.
    km : KM:KM
        Operator's kilometres of the picture, 8:12; or one place, 12.3: its evidence over time, with
        the estimate of each day.
    model
        Also list the parameters of the model.
    days : N
        With one place: number of days with an estimate, evenly chosen; each takes as long as an
        update. Default: 12.
    """
    if km is not None and ":" not in km:
        of_all = {"--at": at, "--zone": zone, "--model": model or None}
        refuse_rivals("--km is one place", of_all, "or give a part of the line: --km 8:12")
        _show_place(condition, km, layer, line, days, picture)
        return
    if days is not None:
        raise InputError("--days is for one place", remedy="give it, as --km 12.3")
    stretch(km)
    if km is not None and picture is None:
        raise InputError("--km chooses what a picture shows", remedy="name it with --picture")
    when = moment(at, zone)
    if condition.is_dir():
        of_line = {"--km": km, "--line": line, "--model": model or None}
        refuse_rivals("the map is of a network", of_line, "or name the map of an edge")
        _show_network(condition, when, layer, picture)
        return

    from analysis.adhesion.map_state import line_of_map
    from analysis.charts import draw

    track = trainlog.read_map(condition)
    known = line_of_map(track, line, condition)
    shown = analysis.map_state(track, when, line=known, layers=layer)
    assumed = zone_assumed(at, zone)
    shown = replace(shown, notes=(*shown.notes, assumed)) if assumed else shown
    if picture is not None:
        start, end = stretch(km, known) or (None, None)
        part = (start or 0.0, track.length if end is None else end)
        draw(shown.track, picture, line=known, at=when, part=part if km else None)
    show(shown, also=["model"] if model else [])
    if picture is not None:
        wrote(picture)


def _show_place(
    condition: Path,
    km: str,
    layers: list[str] | None,
    line: Path | None,
    days: int | None,
    picture: Path | None,
) -> None:
    """Show what a map knows of one place over time: its evidence, and the estimate of each day."""
    from analysis.adhesion.map_difference import MOST_DAYS
    from analysis.adhesion.map_state import line_of_map
    from analysis.charts import draw
    from trainlog.railway.line import position_of

    track = trainlog.read_map(condition)
    known = line_of_map(track, line, condition)
    position = position_of(known, KILOMETRE.read(km, "--km"))
    names = list(track.layers) if layers is None else layers
    found = [
        analysis.map_history(track, position, name, line=known, days=days or MOST_DAYS)
        for name in names
    ]
    pictures = named_apart(picture, [each.layer for each in found])
    for each, path in zip(found, pictures, strict=False):
        draw(each, path)
    if not state({"layers": [each.data() for each in found]}):
        show(*found)
    wrote(*pictures)


def _show_network(
    folder: Path, when: pd.Timestamp | None, layers: list[str] | None, picture: Path | None
) -> None:
    """Show the maps of a network's folder."""
    from analysis.charts import draw
    from analysis.network.maps import network_map, network_table

    maps = network_map(folder)
    shown = maps if when is None else maps.known_before(when)
    table = network_table(shown, when, layers)
    if picture is not None:
        draw(shown, picture, at=when, layers=layers or ())
    console.print(table)
    if picture is not None:
        wrote(picture)


@map_app.command("diff")
def map_diff(
    maps: list[Path],
    /,
    *,
    from_: str | None = None,
    to: str | None = None,
    layer: list[str] | None = None,
    line: Path | None = None,
    rate: Annotated[float, SHARE] = 0.05,
    least: Annotated[float, NUMBER] = 0.01,
    picture: Picture = None,
) -> None:
    """Show significant changes between two dates of a map, or between two maps.

    The evidence of the second is compared with that of the first, bin by bin. Exit status 0: no
    significant change; 1: changes; 2: no comparison was possible.

    Example: trainlog map diff results/wil.map --from 2026-10-31 --picture diff.png

    Parameters
    ----------
    maps : MAPS
        Two map files, or one with --from.
    from_ : TIME
        Last day of the first evidence.
    to : TIME
        Last day of the second evidence; default: all.
    rate : SHARE
        False discovery rate: share of the changed bins that may be so by chance.
    least : NUMBER
        Difference of adhesion for which the probability is stated.
    """
    if len(maps) > 2:
        raise InputError(f"{len(maps)} maps are given", remedy="give two, or one with --from")

    from analysis.adhesion.map_state import line_of_map
    from trainlog.railway.evidence import day_of
    from trainlog.spans import utc

    since, until = (None if given is None else day_of(utc(given)) for given in (from_, to))
    first, *second = [trainlog.read_map(each) for each in maps]
    known = line_of_map(first, line, maps[0])
    found = analysis.map_difference(
        first,
        second[0] if second else None,
        since=since,
        until=until,
        line=known,
        layers=layer,
        rate=rate,
        least=least,
    )
    show(found, picture=picture, line=known)
    if found.changed:
        raise typer.Exit(1)


@map_app.command("export")
def map_export(
    condition: Path,
    /,
    *,
    output: Path,
    line: Path | None = None,
    layer: list[str] | None = None,
    at: str | None = None,
    zone: str | None = None,
) -> None:
    """Write a track-condition map for other programs; the suffix chooses the format.

    GeoJSON and GeoPackage (extra gis): bins as lines with coordinates, spots, changes and stations;
    Parquet and CSV: bins by chainage; JSON: sections of one layer as a TTOBench track. Unobserved
    values are empty. A past --at uses only the evidence of the days before.

    Example: trainlog map export results/wil.map -o results/map.geojson

    Parameters
    ----------
    output : FILE
        .geojson, .gpkg, .parquet, .csv, or .json in TTOBench's layout.
    """
    when = moment(at, zone)

    from analysis.adhesion.export import exported_suffix
    from analysis.adhesion.map_state import line_of_map
    from trainlog.condition import left_out

    exported_suffix(output)
    track = trainlog.read_map(condition)
    analysis.export_map(
        track, output, line=line_of_map(track, line, condition), at=when, layers=layer
    )
    chosen = replace(track, layers={name: track.layer(name) for name in layer or track.layers})
    for words in filter(None, [left_out(chosen, when), zone_assumed(at, zone)]):
        say(f"  {words}")
    wrote(output)


@map_app.command("forecast")
def map_forecast(
    condition: Path,
    /,
    *,
    output: Path,
    at: str | None = None,
    zone: str | None = None,
    hours: Annotated[float, HOURS] = 24.0,
    layer: str | None = None,
) -> None:
    """Write the expected adhesion of a map at a time as a forecast (CSV).

    Only evidence of days before --at (UTC) is used. Unobserved places have no forecast. Default
    time: the day after the last evidence.

    Example: trainlog map forecast results/wil.map --at 2026-11-22T06:00Z -o results/forecast.csv

    Parameters
    ----------
    condition : MAP
        Map file (.map), or folder of maps of a network.
    output : FILE
        Forecast (CSV); for a network a folder of forecasts.
    hours : TIME
        Validity of the forecast.
    layer : CONDITION
        Rail condition; default: all of the map.
    """
    from analysis.network.maps import forecasts_of_network, network_map
    from analysis.verification.forecasts import first_free, forecast_of
    from trainlog.condition import left_out
    from trainlog.formats.files import output_folder

    time = moment(at, zone)
    if condition.is_dir():
        time, found = forecasts_of_network(network_map(condition), time, layer, hours)
        with output_folder(output) as place:
            for path, each in found.items():
                trainlog.write_forecast(each, place / path)
        state({"forecasts": output, "edges": len(found), "from": time})
    else:
        track = trainlog.read_map(condition)
        time = time or first_free(track)
        forecast = forecast_of(track, time, layer=layer, hours=hours)
        trainlog.write_forecast(forecast, destination(output, ".csv"))
        layers = sorted(set(forecast.layer))
        content = {"line": forecast.line, "from": time, "hours": hours, "layers": layers}
        state({"forecast": output, **content})
        if later := left_out(track, time):
            say(f"  forecast {later}")
    wrote(output)


@map_app.command("score")
def map_score(
    forecast: Path,
    logs: Annotated[list[Path] | None, ChosenTrips] = None,
    /,
    *,
    rolling: bool = False,
    layer: str | None = None,
    weather: Path | None = None,
    picture: Picture = None,
) -> None:
    """Score a forecast of adhesion, a map's or another's, on trips that it does not contain.

    Log score with the gain over prior, persistence and place alone, reliability, Brier score of
    slip, slips foreseen and false alarms, coverage; bands by a bootstrap over days. For a network
    all edges together, and each. Passages without a forecast are counted.
    docs/track-condition-map.md defines the scores. Exit status 1 if a log could not be used.

    Example: trainlog map score results/wil.map results/later-trips --picture results/score.png

    Parameters
    ----------
    forecast : FORECAST
        Map file, folder of maps of a network, or forecast (.csv).
    logs : LOGS
        Logs (.mcap) of later trips, or folders of logs.
    rolling
        Forecast each day of the map from the days before.
    layer : CONDITION
        Rail condition; default: that of each log, or all.
    weather : FILE
        Weather (CSV): rail condition of logs without one.
    """
    from analysis.verification.scoring import by_reason

    found = _scored(forecast, logs or [], rolling, layer, weather)
    for words in found.refused:
        print_error(words)
    if not current().as_json:
        for words in by_reason(found.left_out):
            say(f"  {words}")
    show(found, picture=picture)
    if found.refused:
        raise typer.Exit(1)


def _scored(
    forecast: Path, logs: list[Path], rolling: bool, layer: str | None, weather: Path | None
) -> Score:
    """Score a map on its own days, or a forecast on logs."""
    from analysis.network.maps import network_map
    from analysis.verification.scoring import line_of_logs, score_network, score_network_on

    foreign = forecast.suffix.lower() == ".csv"
    if rolling:
        refuse_rivals("--rolling takes no logs", {"--weather": weather})
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
    if rolling:
        layers = None if layer is None else [layer]
        unit = "edge" if forecast.is_dir() else "day"
        with task(f"forecasting {unit} by {unit}", unit=unit) as step:
            if forecast.is_dir():
                return score_network(network_map(forecast), layers, step)[0]
            own = trainlog.read_map(forecast)
            return analysis.score_rolling(own, layers, lambda day, days: step(day - 1, days))
    paths = logs_in(logs)
    sky = None if weather is None else trainlog.read_weather(weather)
    every = tracked(paths, "scoring", "log")
    if forecast.is_dir():
        return score_network_on(network_map(forecast), every, layer, sky)[0]
    if foreign:
        stated = trainlog.read_forecast(forecast, *line_of_logs(paths))
        return analysis.score_forecast(stated, every, layer, sky)
    return analysis.score_map(trainlog.read_map(forecast), every, layer, sky)


@map_app.command("remove")
def map_remove(condition: Path, trips: list[str], /) -> None:
    """Remove trips from a map, such as those with a wrong rail condition.

    If their logs are added again, they count again. Compacted trips cannot be removed.

    Example: trainlog map remove results/wil.map trip-07

    Parameters
    ----------
    trips : TRIPS
        Names of the trips.
    """
    from trainlog.formats.mapfile import MapFile

    with MapFile(condition) as file:
        number = file.remove(trips)
        held, days = file.amount()
    console.print(
        f"{counted(number, 'recording')} taken out; the map holds {counted(held, 'trip')} of"
        f" {counted(days, 'day')}"
    )


@map_app.command("merge")
def map_merge(maps: list[Path], /, *, output: Annotated[Path, Written(".map")]) -> None:
    """Merge maps into one; a trip in several maps counts once.

    Example: trainlog map merge monday.map tuesday.map -o both.map

    Parameters
    ----------
    maps : MAPS
        Map files of one line.
    output : FILE
        New map file (.map).
    """
    from trainlog.formats.mapfile import merge_files

    trips, days = merge_files(maps, output)
    console.print(f"the map holds {counted(trips, 'trip')} of {counted(days, 'day')}")
    wrote(output)


@map_app.command("compact")
def map_compact(condition: Path, /, *, before: str) -> None:
    """Sum the evidence of older trips by day; the estimates of the map stay the same.

    A fuller recording that comes later cannot replace a compacted trip.

    Example: trainlog map compact results/wil.map --before 2026-01-01

    Parameters
    ----------
    before : DAY
        Day (2026-01-31); earlier trips are summed.
    """
    from datetime import date

    from trainlog.formats.mapfile import MapFile

    try:
        day = (date.fromisoformat(before) - date(1970, 1, 1)).days
    except ValueError as error:
        raise InputError(f"'{before}' is not a day", remedy="write it as 2026-01-31") from error
    with MapFile(condition) as file:
        number = file.compact(day)
    console.print(f"{counted(number, 'recording')} compacted")
    wrote(condition)
