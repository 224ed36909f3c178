"""Commands that plan: plan, advice."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import analysis
import trainlog
from trainlog.cli.options import (
    Choices,
    destination,
    line_and_train,
    logs_in,
    map_of_run,
    refuse_rivals,
    sections_in,
    set_option,
    settings_of,
    stretch,
)
from trainlog.cli.terminal import console, say, show, state, wrote
from trainlog.errors import InputError, meant, similar
from trainlog.progress import task
from trainlog.units import COUNT, DISTANCE, MASS, NUMBER, PERCENT, SHARE, SPEED, TIME

if TYPE_CHECKING:
    from analysis.trajectory.journey import JourneyPlan
    from trainlog.railway import Line, Train, Trajectory


SETTINGS: Choices = {
    "load": (MASS.between(0.0), "payload, without a parameter set; 0"),
    "objective": (
        ("wheel", "line", "expected"),
        "energy at the wheel rims; or from the line, with efficiencies and regeneration, in the"
        " worst case or the mean over the observed trips; wheel",
    ),
    "braking": (
        ("recourse", "common"),
        "separate per configuration, or common; recourse",
    ),
    "protect": (
        ("front", "train"),
        "speed limits apply to the front of the train, or its whole length; front",
    ),
    "initial-speed": (SPEED, "speed at the start; 0"),
    "final-speed": (SPEED, "highest speed at the end; 0"),
    "dwell": (TIME.between(0.0), "with --stops: shortest dwell time; 0"),
    "risk": (
        SHARE,
        "with --map: probability, per place and trip, of less adhesion than assumed at the time of"
        " the run, such as 0.05",
    ),
    "sigmas": (
        NUMBER,
        "with --map, in place of risk: standard deviations below its estimate; 2",
    ),
    "assumed-adhesion": (
        NUMBER,
        "with --map: adhesion in bins without an estimate; no limit there",
    ),
    "cells": (
        COUNT.between(20.0, 20_000.0),
        "cells of the grid, at least one per step of the line; 500",
    ),
    "time-limit": (
        TIME.between(0.1),
        "longest search, per section; then the best plan so far is used, with its gap",
    ),
    "referee": (("no", "yes"), "also solve the same cells by IPOPT; no"),
}
"""What ``--set KEY=VALUE`` sets of a plan: how its value is read, and what it is."""


Settings = Annotated[list[str] | None, set_option(SETTINGS)]


def plan(
    parameters: Path | None = None,
    /,
    *,
    output: Path,
    line: Path | None = None,
    train: Path | None = None,
    running_time: str | None = None,
    reserve: str | None = None,
    stops: str | None = None,
    km: str | None = None,
    reverse: bool = False,
    map_: Path | None = None,
    layer: str | None = None,
    at: str | None = None,
    set_: Settings = None,
) -> None:
    """Find the trajectory of least energy that every observed configuration can follow.

    Without a parameter set the plan is for one configuration, that of the train file, and has no
    band: other trains may be late.

    The plan has a certificate: an independent fine rollout of every configuration and a lower bound
    on the energy. The driver's advice is printed; 'trainlog advice' writes it.

    Example: trainlog plan fitted.json --line sample --train sample -o trajectory.json

    Example: trainlog plan --train my.train.toml --line A-B.line.json --set load=12t -o plan.csv

    Example: trainlog plan fitted.json --line A-B.line.json --stops Aach,Berg,Chur -o sections

    Parameters
    ----------
    output : FILE
        Trajectory with its picture (.json); a folder if there are several sections; or speed, time,
        efforts and energy by kilometre, of all sections (.csv).
    parameters : PARAMETERS
        Observed parameter set (JSON); default: the train file only.
    running_time : TIME|LOG
        Running time, 17:30; or that of the fastest non-stop trip of a log or a folder.
    reserve : PERCENT,...
        Reserve over the least time, without --running-time; default: 7%. If several are given,
        7,3,12, the first is planned, and the energies of all are shown.
    stops : A,B,C|FILE
        Stations with stops, the first and last station included, or a journey file with stops and
        passing points; one trajectory per section.
    km : KM:KM
        Only between these kilometres, the operator's if the line has them, else in the direction of
        travel: 3.2:7.5, 3.2:, :7.5.
    reverse
        Travel against the line's chainage.
    map_ : FILE
        Track-condition map that limits the efforts, or folder of maps of a network. Default: no
        limit by adhesion.
    layer : CONDITION
        With --map: rail condition, such as dry, wet or leaves; default: wet.
    at : TIME
        With --map: time of the run, 2026-11-22T06:00Z; only evidence of earlier days counts (UTC).
        Default: after the last evidence with a risk, else the permanent condition.
    """
    if output.suffix or stops is None:
        destination(output, ".csv" if output.suffix == ".csv" else ".json")
    chosen = settings_of(set_ or [], SETTINGS)
    reserves = _reserves(reserve)
    ends = {"--km": km} | {
        f"--set {name}": chosen.get(name) for name in ("initial-speed", "final-speed")
    }
    if stops is not None:
        refuse_rivals("--stops gives places and speeds itself", ends)
        refuse_rivals("IPOPT solves one section", {"--set referee": chosen.get("referee")})
    else:
        refuse_rivals("there are no --stops", {"--set dwell": chosen.get("dwell")}, "or give them")
    if running_time is not None:
        refuse_rivals("--running-time gives the time", {"--reserve": reserve})
        of_logs = running_time.endswith(".mcap") or Path(running_time).exists()
        if of_logs:
            refuse_rivals("the time of a trip is from end to end of the line", ends)
    if map_ is None:
        of_map = {"--layer": layer, "--at": at} | {
            f"--set {name}": chosen.get(name) for name in ("risk", "sigmas", "assumed-adhesion")
        }
        refuse_rivals("there is no --map to be read", of_map, "or give a map")
    if "risk" in chosen:
        cautious = {"--set sigmas": chosen.get("sigmas")}
        refuse_rivals("risk says how cautiously the map is read", cautious)

    from analysis.charts import draw
    from analysis.trajectory.journey import sections_of
    from analysis.trajectory.table import PlannedRun, write_profile
    from trainlog.formats.files import output_folder

    own_line, the_train = line_and_train(line, train)
    observed = _configurations(parameters, the_train, chosen.pop("load", None))
    whole_train = chosen.pop("protect", "front") == "train"
    if whole_train and not the_train.length:
        raise InputError(
            f"--set protect=train: the length of {the_train.name} is not known",
            remedy="state its length in the train's file",
        )
    refereed = chosen.pop("referee", "no") == "yes"
    time_given = None
    if running_time is not None and of_logs:
        from analysis.comparison.groups import fastest_nonstop

        time_given = fastest_nonstop(logs_in([Path(running_time)]), own_line)
    elif running_time is not None:
        time_given = TIME.above(0.0).read(running_time, "--running-time")
    the_line = own_line.reversed() if reverse else own_line
    start, end = stretch(km, the_line) or (None, None)
    track, time = None, None
    if map_ is not None:
        track, time = map_of_run(map_, at, own_line, "reverse" if reverse else "forward")
    if track is not None and layer is None:
        console.print("  no --layer is given: wet")
    options = analysis.OptimiserOptions(
        round(chosen.pop("cells", 500)),
        time_limit=chosen.pop("time-limit", None),
    )
    solve: Callable[..., Trajectory | JourneyPlan] = analysis.optimise
    if stops is not None:
        journey = _journey_of(stops, the_line, time_given)
        if journey.points[-1].latest is not None:
            refuse_rivals("the journey states when it ends", {"--reserve": reserve})
        count = len(sections_of(journey))
        if count > 1 and output.suffix == ".json":
            raise InputError(
                f"is one file, but {count} sections are planned",
                file=output,
                remedy="name a folder, or a table of all of them (.csv)",
            )
        solve = partial(analysis.optimise_journey, journey=journey, dwell=chosen.pop("dwell", 0.0))
    given = {
        "running_time": None if stops else time_given,
        "reserve": reserves[0] if reserves else None,
        "start": start,
        "end": end,
        "weights": observed.weights if chosen.get("objective") == "expected" else None,
        "condition_map": track,
        "time": time,
        "protected_length": the_train.length if whole_train else None,
        "direction": "reverse" if reverse else None,
        **{name.replace("-", "_"): value for name, value in chosen.items()},
    }
    problem = analysis.TrajectoryProblem(
        the_line,
        the_train,
        observed.configurations,
        layer=layer or "wet",
        **{name: value for name, value in given.items() if value is not None},
    )
    with nullcontext() if output.suffix else output_folder(output):
        found = solve(problem, options=options)
        if refereed:
            from analysis.trajectory.referee import with_referee

            with task("solving by IPOPT"):
                found = with_referee(problem, cast("Trajectory", found))
        planned = PlannedRun(problem, found)
        show(planned)
        if output.suffix == ".csv":
            write_profile(planned.advice, output)
            wrote(output)
        else:
            for number, section in enumerate(planned.sections, 1):
                file = output if output.suffix else output / f"section-{number}.json"
                trainlog.write_trajectory(section, file)
                draw(section, file.with_suffix(".png"), line=the_line)
                wrote(file, file.with_suffix(".png"))
        if len(reserves) > 1:
            front = analysis.energy_against_time(
                problem, reserves[1:], options, solve=solve, known=[planned.run]
            )
            name = "energy-over-time.png"
            beside = output.with_name(f"{output.stem}-{name}") if output.suffix else output / name
            show(front, picture=beside)


def _reserves(given: str | None) -> list[float]:
    """The shares asked for, each once.

    Raises
    ------
    InputError
        If one is none, or another is meant: ``7,5%`` with a decimal comma, ``0.07`` for 7 %.
    """
    asked = [] if given is None else given.split(",")
    if len(asked) == 2 and "%" in asked[1] and "%" not in asked[0]:
        remedy = f"write one as {asked[0]}.{asked[1]}, two as {asked[0]}%,{asked[1]}"
        raise InputError(f"--reserve '{given}' is one number or two", remedy=remedy)
    found = {each: PERCENT.between(0.0).read(each, "--reserve") for each in asked}
    for each, share in found.items():
        if "%" not in each and 0.0 < share < 0.005:
            remedy = f"write {each}% if that is meant, or {100.0 * float(each):g}%"
            raise InputError(f"--reserve '{each}' is less than 0.5 %", remedy=remedy)
    return list(dict.fromkeys(found.values()))


def _journey_of(stops: str, line: Line, running_time: float | None) -> trainlog.Journey:
    """The journey of a file, or of the stations named, with the running time that is given."""
    if Path(stops).exists() or stops.endswith((".json", ".toml")):
        journey = trainlog.read_journey(stops)
    else:
        places, points = {each.name: each.position for each in line.stations}, []
        for name in (meant(each.strip(), places) for each in stops.split(",")):
            if name not in places:
                near = similar(name, places, 1)
                known = f"there are {', '.join(places) or 'none'}"
                raise InputError(
                    f"--stops: there is no station '{name}' on {line.name}",
                    remedy=f"did you mean '{near[0]}'?" if near else known,
                )
            points.append(trainlog.TimingPoint(places[name], None, None, 0.0, 0.0))
        if len(points) < 2:
            raise InputError(
                f"--stops '{stops}' names one station",
                remedy="name at least two with commas between them, from departure to arrival",
            )
        if any(after.position < before.position for before, after in pairwise(points)):
            raise InputError(
                f"--stops '{stops}': the stations are not in the direction of travel",
                remedy="order them so, or add --reverse (leave it out if it is given)",
            )
        journey = trainlog.Journey(stops, line.name, tuple(points))
    if running_time is None:
        return journey
    *before, last = journey.points
    return replace(journey, points=(*before, replace(last, latest=running_time)))


def _configurations(
    parameters: Path | None, train: Train, load: float | None
) -> trainlog.ParameterSet:
    """The observed set; without one the train as its file describes it."""
    from trainlog.railway.train import check_load

    if parameters is None:
        carried = load or 0.0
        check_load(carried, train)
        if 0.0 < train.max_load < carried:
            largest = f"{train.max_load / 1e3:g} t"
            console.print(f"  the load is above the largest of the train's file, {largest}")
        return trainlog.ParameterSet(train.name, (trainlog.Configuration.of(train, carried),))
    refuse_rivals("the parameter set holds the masses", {"--set load": load})
    observed = trainlog.read_parameters(parameters)
    observed.check_train(train.name)
    if not observed.configurations:
        raise InputError(
            "has no configuration",
            file=parameters,
            remedy="'trainlog fit' makes a set from trips; without a set the train's file is taken",
        )
    if observed.assumed_power:
        console.print(f"  {parameters.name}: {observed.assumed_power}")
    return observed


def advice(
    trajectories: list[Path],
    /,
    *,
    output: Path,
    departure: str | None = None,
    line: Path | None = None,
    dwell: Annotated[float | None, TIME.between(0.0)] = None,
    onto: Path | None = None,
) -> None:
    """Write the driver's advice for a whole journey, or add it to a recorded trip.

    One page to print, and one CSV: stations with arrival and departure times, and instructions to
    drive, hold a speed, coast and brake, by kilometre and nearest station.

    Example: trainlog advice results/trajectory.json --departure 07:12 -o advice.html

    Example: trainlog advice results/trajectory.json --onto trip.mcap -o advised.mcap

    Parameters
    ----------
    trajectories : TRAJECTORIES
        Trajectory file, or those of the sections of a journey: files, or their folder.
    output : FILE
        The page (.html), with the CSV beside it; with --onto the log (.mcap).
    departure : DEPARTURE
        Time of day of the first departure, 07:12; default: times since departure.
    line : FILE
        Line file; default: the line in the trajectory.
    dwell : TIME
        Dwell between sections planned separately; default: 0.
    onto : FILE
        Log (.mcap) of a trip over the same section: a copy gets the advice, so that a replay shows
        both.
    """
    files = sections_in(trajectories)
    if onto is not None:
        refuse_rivals(
            "--onto adds the advice to a log",
            {"--departure": departure, "--line": line, "--dwell": dwell},
        )
        from analysis.trajectory.advice import with_advice

        if len(files) > 1:
            raise InputError("several trajectories are given", remedy="with --onto name one")
        destination(output, ".mcap")
        if output.resolve() == onto.resolve():
            raise InputError(
                "is the log itself", file=output, remedy="give the result another name"
            )
        trainlog.write(with_advice(trainlog.read(onto), trainlog.read_trajectory(files[0])), output)
        wrote(output)
        return
    destination(output, ".html")

    from analysis.reports.results import write_driver_advice
    from analysis.trajectory.advice import time_of_day

    start = None if departure is None else time_of_day(departure)
    table = output.with_suffix(".csv")
    with task("writing the advice"):
        found = write_driver_advice(
            files, output, table, line=line, start=start, dwell=dwell or 0.0
        )
    show(found)
    wrote(output, table)


def sfera(
    sources: list[Path],
    /,
    *,
    journey: Path,
    output: Path,
    line: Path | None = None,
    layer: str | None = None,
    probability: Annotated[float, SHARE] = 0.05,
    changes_apart: Annotated[float, TIME.between(0.0, 600.0)] = 10.0,
    passed: Annotated[float | None, DISTANCE.between(0.0)] = None,
    every: Annotated[float, TIME.between(1.0, 600.0)] = 5.0,
    publish: str | None = None,
) -> None:
    """Write advice, rail condition, resistance or reports for a journey of SFERA 4.00.

    Trajectories, planned on the line that 'trainlog import' makes of the journey, become its next
    version with advised speeds, never above a limit; with --passed a message for the remaining
    journey. A forecast (.csv) becomes the next version with low adhesion by section and time; a
    parameter set the next version of the train characteristics; a trip (.mcap) an archive of its
    journey and status reports, which 'trainlog ingest' reads.

    Example: trainlog sfera trajectory.json --journey in -o advised.xml

    Example: trainlog sfera forecast.csv --journey in --line A-B.line.json --layer wet -o low.xml

    Example: trainlog sfera trip.mcap --journey in -o reports.zip

    Parameters
    ----------
    sources : SOURCES
        Trajectory file, those of the sections of a journey or their folder; or a forecast (.csv), a
        parameter set (.json), a trip (.mcap).
    journey : JOURNEY
        Journey with its segments and train: a file with its documents in the same folder, a folder,
        or a zip archive.
    output : FILE
        File (.xml; for a trip .zip).
    line : FILE
        Line file of the forecast or the trip, if it is not the journey's; positions agree by the
        operator's kilometre, or by the names of stations. Default: the line in the log.
    layer : CONDITION
        Expected rail condition, for forecasts by condition.
    probability : SHARE
        Probability of an adhesion below the stated category: a quantile of the forecast.
    changes_apart : TIME
        Least time between changes of the advised speed.
    passed : DISTANCE
        Distance that the train has covered on its journey.
    every : TIME
        Time between two reports.
    publish : ADDRESS
        For a trip: HOST[:PORT]/TOPIC of an MQTT broker, which also gets each report at the rate of
        the trip; with the extra mqtt.
    """
    from analysis.sfera import SferaOptions, write_sfera

    files = [
        file for each in sources for file in (sections_in([each]) if each.is_dir() else [each])
    ]
    options = SferaOptions(
        None if line is None else trainlog.read_line(line), layer or "", probability, changes_apart,
        passed, every, publish,
    )  # fmt: skip
    with task("writing for SFERA"):
        found = write_sfera(files, journey, output, options)
    if not state(found):
        for key, value in found.items():
            say(f"{key.replace('_', ' ')}: {value}")
    wrote(output)
