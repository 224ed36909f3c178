"""Commands that simulate trips: of drivers, along a trajectory, through days, of a fleet.

Parameters
----------
output : FOLDER
    Folder for the logs.
characteristic : FILE
    Adhesion over slip: a file of 'trainlog fit adhesion', measured points (CSV), polach-dry or
    polach-wet; default: the curves of Zhao et al. (2025).
traction : NAME
    Controller of the axle efforts: the plant's own slip protection, cooperative control (best with
    --map), or re-adhesion control without a map. The last two take several times as long.
map_ : FILE
    With --traction cooperative: track-condition map that the train knows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

import analysis
import trainlog
from trainlog.cli.options import (
    POSITIVE,
    Count,
    Risk,
    Seed,
    lasting_change,
    line_and_train,
    map_of_run,
    refuse_rivals,
    sections_in,
)
from trainlog.cli.terminal import about, console, print_error, say, state, wrote
from trainlog.errors import InfeasibleError, InputError
from trainlog.progress import track
from trainlog.units import TIME

if TYPE_CHECKING:
    from trainlog.railway import Line, TrackConditionMap
    from trainlog.simulation import Scenario
    from trainlog.trip import Trip

Traction = Literal["own", "cooperative", "readhesion"]
simulate_app = typer.Typer(
    add_completion=False, help="Simulate drivers, trips that follow a trajectory, days, a fleet."
)


@simulate_app.command()
def drive(
    *,
    output: Path,
    line: Path | None = None,
    train: Path | None = None,
    count: Annotated[int, POSITIVE] = 12,
    seed: Seed = 1,
    characteristic: str | None = None,
    traction: Traction = "own",
    map_: Path | None = None,
) -> None:
    """Simulate trips of drivers and log them.

    Loads, weather, running resistance, drivers and slippery places vary with the seed; sensors have
    noise. With [bold]--traction cooperative[/bold] one program computes the efforts of all powered
    axles, with the map of the rail ahead (Zhao et al., 2025). Trains stalled on a slippery gradient
    are listed; the exit status is then 1.

    Example: trainlog simulate drive --line sample --train sample --count 12 -o results/trips

    Parameters
    ----------
    count : N
        Number of trips.
    """
    the_line, the_train = line_and_train(line, train)
    scenarios = trainlog.draw_scenarios(the_line, the_train, count=count, seed=seed)
    known = _known_map(map_, traction, the_line)
    _, stuck = _drive(scenarios, output, characteristic, traction, known)
    _end(stuck, count)


@simulate_app.command()
def follow(
    trajectory: Path,
    /,
    *,
    output: Path,
    line: Path | None = None,
    train: Path | None = None,
    configurations: str = "hardest",
    weather: Literal["dry", "wet"] = "dry",
    late: Annotated[float, TIME.between(0.0)] = 0.0,
    map_: Path | None = None,
    risk: Risk = None,
    at: str | None = None,
    seed: Seed = 1,
    characteristic: str | None = None,
    traction: Traction = "own",
) -> None:
    """Simulate trips that follow a trajectory by model predictive control, one per configuration.

    The train does not know its configuration; it measures its own position and speed.

    Example: trainlog simulate follow plan.json --train sample -o results/driven

    Parameters
    ----------
    trajectory : TRAJECTORY
        Trajectory file, or the folder of a journey: one trip per section.
    line : FILE
        Line file; default: the line in the trajectory.
    configurations : NAMES
        'hardest' (most and least resistance, least power), 'all', or names separated by commas.
    weather : NAME
        Rail condition.
    late : TIME
        Departure delay.
    map_ : FILE
        Track-condition map that the train knows.
    at : TIME
        With --map: time of the run, 2026-11-22T06:00Z; only evidence of earlier days counts (UTC).
        Default: after the last evidence with a risk, else the permanent condition.
    """
    from functools import partial

    from analysis.charts import draw_charts
    from analysis.control.follow import following_line, following_scenarios
    from analysis.control.plot import following_charts
    from analysis.control.route import counted_on
    from trainlog.formats.railway import line_of_plan

    if map_ is None:
        refuse_rivals("there is no --map to be read", {"--risk": risk, "--at": at}, "or give a map")
    sections = {each.stem: trainlog.read_trajectory(each) for each in sections_in([trajectory])}
    planned = next(iter(sections.values()))
    kept = line_of_plan(planned)
    if kept is not None and planned.direction == "reverse":
        kept = kept.reversed()
    the_line, the_train = line_and_train(line, train, kept)
    the_map, time = None, None
    if map_ is not None:
        the_map, time = map_of_run(map_, at, the_line, planned.direction)
    words = counted_on(the_map, weather, risk, time)
    say(f"  {words}")
    scenarios = {
        name: following_scenarios(
            section, the_line, the_train,
            configurations=configurations, weather=weather, late=late,
            condition_map=the_map, seed=seed, risk=risk, time=time,
        )
        for name, section in sections.items()
    }  # fmt: skip
    stuck = 0
    for name, section in sections.items():
        if len(sections) > 1:
            scenarios[name] = [replace(s, name=f"{s.name}-{name}") for s in scenarios[name]]
        stated = partial(following_line, trajectory=section)
        trips, failed = _drive(scenarios[name], output, characteristic, traction, the_map, stated)
        stuck += failed
        if not trips:
            continue
        picture = output / (f"following-{name}.png" if len(sections) > 1 else "following.png")
        draw_charts(following_charts(trips), picture)
        wrote(picture)
    _end(stuck, sum(map(len, scenarios.values())))


@simulate_app.command()
def days(
    *,
    output: Path,
    days: Annotated[int, POSITIVE] = 30,
    trips_per_day: Annotated[int, POSITIVE] = 4,
    start: str = "2026-10-01",
    change: list[str] | None = None,
    line: Path | None = None,
    train: Path | None = None,
    seed: Seed = 1,
    characteristic: str | None = None,
    traction: Traction = "own",
    map_: Path | None = None,
) -> None:
    """Simulate days on one line, with temporary slippery spots and weather.

    Weather and slippery spots change from day to day; [bold]--change[/bold] adds permanent changes.
    The weather is written beside the logs. Trains stalled on a slippery gradient are listed; the
    exit status is then 1.

    Example: trainlog simulate days --line my.line.json --train sample --days 30 -o october

    Parameters
    ----------
    days : N
        Number of days.
    trips_per_day : N
        Trips per day, from 5:00 to 23:00.
    start : TIME
        The first day.
    change : CHANGE
        Permanent change of the rail: km=10:14,date=2026-10-15,factor=1.3 (factor of the adhesion);
        spots=0.2: factor of the rate of temporary spots.
    """
    the_line, the_train = line_and_train(line, train)
    changes = [lasting_change(word, the_line) for word in change or []]
    rail = trainlog.Rail.draw(the_line, days, start, seed, changes)
    scenarios = trainlog.draw_days(rail, [the_train], trips_per_day)
    known = _known_map(map_, traction, the_line)
    _, stuck = _drive(scenarios, output, characteristic, traction, known)
    trainlog.write_weather(rail.table, output / "weather.csv")
    wrote(output / "weather.csv")
    _end(stuck, len(scenarios))


def _end(stuck: int, count: int) -> None:
    """Exit with status 1 if trains of `count` did not arrive, 2 if none did."""
    if stuck:
        raise typer.Exit(1 if stuck < count else 2)


def _known_map(condition: Path | None, traction: str, line: Line) -> TrackConditionMap | None:
    """The map that cooperative control knows."""
    if traction != "cooperative":
        refuse_rivals(
            "only --traction cooperative knows a map",
            {"--map": condition},
            "or follow a trajectory that knows it: trainlog simulate follow",
        )
    return None if condition is None else map_of_run(condition, None, line)[0]


def _drive(
    scenarios: Sequence[Scenario],
    output: Path,
    characteristic: str | None,
    traction: Literal["own", "cooperative", "readhesion"],
    known: TrackConditionMap | None,
    line_of: Callable[[Trip], str] | None = None,
) -> tuple[list[Trip], int]:
    """Drive the scenarios, write their logs and state each trip and each train that is stuck.

    Returns the trips, if `line_of` states more of them, and the number of trains that are stuck.
    """
    from trainlog.formats.files import output_folder
    from trainlog.simulation import drive, recorded

    if characteristic is not None:
        rail = trainlog.read_characteristic(characteristic)
        scenarios = [replace(each, characteristic=rail) for each in scenarios]
    if traction != "own":
        from analysis.charts import draw_charts
        from analysis.control.plot import traction_charts

        scenarios = analysis.with_traction(scenarios, traction, known)
        if traction == "cooperative" and known is None:
            console.print("no --map: the cooperative control knows the rail only by its own slips")
    driven: list[Trip] = []
    trips: list[dict[str, object]] = []
    with output_folder(output):
        for scenario in track(scenarios, "driving", "trip"):
            try:
                run = drive(scenario)
            except InfeasibleError as error:
                print_error(str(error))
                continue
            trip = recorded(scenario, run)
            log = output / f"{trip.name}.mcap"
            trainlog.write(trip, log)
            trips.append({"log": log, "duration_s": trip.duration, "metadata": trip.metadata})
            if not state({"trips": trips}):
                console.print(about(trip.metadata, trip.duration))
            if run.traction is not None:
                loop = run.traction
                console.print(
                    f"    traction control {loop.control.name}: {len(loop.unsolved)} of"
                    f" {loop.steps} decisions unsolved, {loop.late} late (over"
                    f" {1e3 * loop.control.period:g} ms; longest {1e3 * loop.longest:.1f} ms)"
                )
                picture = output / f"{trip.name}.traction.png"
                draw_charts(traction_charts(trip, known), picture)
                wrote(picture)
            if line_of is not None:
                console.print(f"    {line_of(trip)}")
                driven.append(trip)
    return driven, len(scenarios) - len(trips)


@simulate_app.command()
def fleet(
    network: str,
    /,
    *,
    output: Path,
    trains: Annotated[int, POSITIVE] = 20,
    days: Annotated[int, POSITIVE] = 30,
    count: Count = None,
    trips_per_day: Count = None,
    start: str = "2026-10-01",
    fault: list[str] | None = None,
    jobs: Count = None,
    seed: Seed = 1,
) -> None:
    """Simulate a fleet on a network: trains of three kinds on rosters of routes.

    Each train has its own running resistance, wheels, brakes and recorder; all have the same
    weather. Trips are computed in parallel; an interrupted run continues. Trains stalled on a
    slippery gradient are listed; the exit status is then 1.

    Example: trainlog simulate fleet drawn --trains 20 --days 30 --count 1000 -o results/fleet

    Parameters
    ----------
    network : NETWORK
        Network file (.network.json), or 'drawn' for ten lines drawn with the seed, 'drawn:4' for
        four.
    trains : N
        Number of trains, of three kinds.
    days : N
        Number of days.
    count : N
        Number of trips.
    trips_per_day : N
        Trips per train and day, in place of --count.
    start : TIME
        The first day.
    fault : FAULT
        Fault of a train: train=kiss-01,mass=3t,from=2026-10-12; or dragging-brake=2kN,
        wheel-diameter=1%, effort-gain=5%, sensor-delay=0.3s; optional: to=2026-10-20, share=30% of
        the trips. May be given several times.
    """
    from trainlog.formats.files import output_folder

    if count is not None:
        refuse_rivals("--count gives the trips in all", {"--trips-per-day": trips_per_day})
    drawn, _, lines = network.partition(":")
    if drawn == "drawn":
        if lines and not lines.isdigit():
            raise InputError(f"'{network}' is not a network", remedy="write it as drawn or drawn:4")
        the_network = trainlog.draw_network(seed, int(lines or 10))
    else:
        the_network = trainlog.read_network(network)
    trips = count if trips_per_day is None else trips_per_day * trains * days
    fleet = trainlog.draw_fleet(
        the_network,
        trains=trains,
        days=days,
        trips=trips,
        seed=seed,
        faults=[trainlog.TrainFault.of(words) for words in fault or []],
        start=start,
    )
    with output_folder(output):
        console.print(f"{fleet}")
        logs = trainlog.write_fleet(fleet, output, jobs)
    for each in logs.stuck:
        print_error(each.reason)
    wrote(output)
    stated = {
        "trips": logs.made,
        "kept": logs.kept,
        "stuck": [each.name for each in logs.stuck],
        "duration_s": logs.duration,
        "distance_m": logs.distance,
        "size_bytes": logs.size,
        "elapsed_s": logs.elapsed,
    }
    if not state({"fleet": stated}):
        speed = logs.duration / max(logs.elapsed, 1e-9)
        console.print(
            f"{logs.made} trips made, {logs.kept} kept, {len(logs.stuck)} did not arrive:"
            f" {logs.duration / 3600.0:.1f} h, {logs.distance / 1e3:.0f} km,"
            f" {logs.size / 1e9:.2f} GB in {logs.elapsed:.0f} s,"
            f" {speed:,.0f} times as fast as the trains"
        )
        if len(logs.codes) > 1:
            console.print(
                f"The logs were made by {len(logs.codes)} versions of the code, as fleet.json"
                f" states: {', '.join(logs.codes)}."
            )
    if logs.stuck:
        raise typer.Exit(1)
