"""Commands that plan: plan, advice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trainlog.cli.options import (
    LineOption,
    RunTimeOption,
    TrainOption,
    destination,
    line_and_train,
    logs_in,
    map_of_run,
    measured,
    stretch,
)
from trainlog.cli.terminal import console, current, show, state, wrote
from trainlog.errors import InputError, similar
from trainlog.progress import task
from trainlog.units import COUNT, MASS, NUMBER, PERCENT, SHARE, SPEED, TIME, Measure

if TYPE_CHECKING:
    from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
    from trainlog.railway import Journey, Line, ParameterSet, Train, Trajectory


def setting(of: Measure | tuple[str, ...], help: str) -> Any:
    """A field of `PlanSettings`: how its value is read, and what it is."""
    return field(default=None, metadata={"of": of, "help": help})


@dataclass(frozen=True)
class PlanSettings:
    """What ``--set KEY=VALUE`` sets of a plan; None: the usual value."""

    load: float | None = setting(
        MASS.between(0.0), "without a parameter set: what the train carries; 0"
    )
    objective: str | None = setting(
        ("wheel", "line", "expected"),
        "traction at the wheel rims; or energy from the line, with efficiencies and what the"
        " dynamic brake feeds back, at worst or as expected of the observed trips; wheel",
    )
    braking: str | None = setting(
        ("recourse", "common"), "each configuration brakes for itself, or all alike; recourse"
    )
    protect: str | None = setting(
        ("front", "train"),
        "speed limits hold for the train's front, or all of its length; front",
    )
    initial_speed: float | None = setting(SPEED, "speed where it begins; 0")
    final_speed: float | None = setting(SPEED, "speed where it ends, at most; 0")
    dwell: float | None = setting(
        TIME.between(0.0), "with --stops: least standing time at a stop; 0"
    )
    risk: float | None = setting(
        SHARE,
        "with --map: probability, for each place and trip, that there is less adhesion than is"
        " counted on, as the map expects it at the time of the run, such as 0.05",
    )
    sigmas: float | None = setting(
        NUMBER, "with --map, in place of risk: standard deviations taken off its estimate; 2"
    )
    assumed_adhesion: float | None = setting(
        NUMBER, "with --map: adhesion counted on where it has none; no limit there"
    )
    cells: float | None = setting(
        COUNT.between(20.0, 20_000.0),
        "cells of the grid, at least one for each step of the line; 500",
    )
    time_limit: float | None = setting(
        TIME.between(0.1),
        "time after which the best that was found is taken, with its gap; what has begun is"
        " finished; of each section, with --stops",
    )
    referee: str | None = setting(
        ("no", "yes"), "solve it again with CasADi and IPOPT, and compare; no"
    )

    @classmethod
    def of(cls, words: Sequence[str]) -> PlanSettings:
        """The settings of words ``KEY=VALUE``.

        Raises
        ------
        InputError
            If a key is unknown or given twice, or its value cannot be read.

        Examples
        --------
        >>> PlanSettings.of(["load=12t", "final-speed=60"]).load
        12000.0
        """
        known = {each.name.replace("_", "-"): each for each in fields(cls)}
        found: dict[str, Any] = {}
        for word in words:
            key, equals, value = (each.strip() for each in word.partition("="))
            if key not in known or not equals:
                near = similar(key, known, 1)
                meant = f"did you mean {near[0]}? " if near and near[0] != key else ""
                raise InputError(
                    f"--set '{word}' is not a setting of a plan",
                    remedy=f"{meant}write KEY=VALUE with one of {', '.join(known)}",
                )
            if known[key].name in found:
                raise InputError(f"--set {key} is given twice", remedy="give it once")
            found[known[key].name] = _value(known[key].metadata["of"], key, value)
        return cls(**found)


def _value(of: Measure | tuple[str, ...], key: str, value: str) -> Any:
    """The value of a setting."""
    if not isinstance(of, tuple):
        return of.read(value, f"--set {key}")
    if value not in of:
        raise InputError(
            f"--set {key}: '{value}' is not one of {', '.join(of)}", remedy="give one of these"
        )
    return value


SETTINGS = "; ".join(
    each.name.replace("_", "-")
    + (f"={'|'.join(of)}" if isinstance(of := each.metadata["of"], tuple) else "")
    + f" ({each.metadata['help']})"
    for each in fields(PlanSettings)
)
"""The settings, each with what it is and its usual value, for the help."""


def plan(
    output: Annotated[Path, typer.Option("--output", "-o", help="Trajectory file (JSON).")],
    parameters: Annotated[
        Path | None,
        typer.Argument(help="Observed parameter set (JSON); default: the train's file alone."),
    ] = None,
    line: LineOption = None,
    train: TrainOption = None,
    running_time: Annotated[
        str | None,
        typer.Option(
            metavar="TIME|LOG",
            help="Timetable's running time, 17:30; or that of the fastest non-stop trip of a log or"
            " a folder.",
        ),
    ] = None,
    reserve: Annotated[
        str | None,
        typer.Option(
            metavar="PERCENT,...",
            help="Without --running-time: reserve over the least time, 7%; default: 7%. Of several,"
            " 7,3,12, the first is planned, and the energy of all is shown over their times.",
        ),
    ] = None,
    stops: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,C|FILE",
            help="Stations between which it runs and stops, or a journey file with stops and"
            " passing points; one trajectory per section.",
        ),
    ] = None,
    km: Annotated[
        str | None,
        typer.Option(
            "--km",
            help="Only between these kilometres, the operator's where the line has them, else in"
            " the direction of travel: 3.2:7.5, 3.2:, :7.5.",
        ),
    ] = None,
    reverse: Annotated[
        bool, typer.Option("--reverse", help="Travel against the line's chainage.")
    ] = False,
    condition: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="Track-condition map that limits the efforts, or a network's folder of maps.",
        ),
    ] = None,
    layer: Annotated[
        str | None,
        typer.Option(
            help="With --map: its rail condition, such as dry, wet or leaves; default: wet."
        ),
    ] = None,
    at: RunTimeOption = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help=f"May be given several times: {SETTINGS}."),
    ] = None,
) -> None:
    """Find the trajectory of least energy that every observed configuration can follow.

    Without a parameter set it is planned for one configuration, the train as its file describes
    it; such a plan has no band: trips that differ from the file may be late.

    The answer carries its certificate: an independent fine rollout of every configuration and a
    lower bound on the energy. Beside it stand a picture, and the driver's advice as CSV.

    Example: trainlog plan fitted.json --line sample --train sample -o trajectory.json

    Example: trainlog plan --train my.train.toml --line A-B.line.json --set load=12t -o plan.json

    Example: trainlog plan fitted.json --line A-B.line.json --stops Aach,Berg,Chur -o plan.json
    """
    destination(output, ".json")
    chosen = PlanSettings.of(settings or [])
    reserves = [PERCENT.read(each, "--reserve") for each in reserve.split(",")] if reserve else []
    _refuse_rivals(chosen, running_time, reserves, stops, km, condition, layer, at)

    from analysis.trajectory.optimiser import optimise as solve
    from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem

    the_line, the_train = line_and_train(line, train)
    observed = _configurations(parameters, the_train, chosen.load)
    if chosen.protect == "train" and not the_train.length:
        raise InputError(
            f"--set protect=train: the length of {the_train.name} is not known",
            remedy="state its length in the train's file",
        )
    own_line = the_line
    time_given = None if running_time is None else _running_time(running_time, own_line)
    if reverse:
        the_line = the_line.reversed()
    start, end = stretch(km, the_line) or (None, None)
    track, time = (None, None) if condition is None else map_of_run(condition, at, own_line)
    if track is not None and layer is None:
        console.print("  no --layer is given: wet", highlight=False)
    given: dict[str, Any] = {
        "running_time": None if stops else time_given,
        "reserve": reserves[0] if reserves else None,
        "start": start,
        "end": end,
        "initial_speed": chosen.initial_speed,
        "final_speed": chosen.final_speed,
        "weights": observed.weights if chosen.objective == "expected" else None,
        "condition_map": track,
        "sigmas": chosen.sigmas,
        "risk": chosen.risk,
        "time": time,
        "assumed_adhesion": chosen.assumed_adhesion,
        "protected_length": the_train.length if chosen.protect == "train" else None,
        "direction": "reverse" if reverse else None,
        "braking": chosen.braking,
        "objective": chosen.objective,
    }
    problem = TrajectoryProblem(
        the_line,
        the_train,
        observed.configurations,
        layer=layer or "wet",
        **{name: value for name, value in given.items() if value is not None},
    )
    options = OptimiserOptions(
        round(chosen.cells or 500), chosen.referee == "yes", time_limit=chosen.time_limit
    )
    if stops is not None:
        journey = _journey_of(stops, the_line, time_given)
        _journey(problem, options, journey, chosen.dwell or 0.0, output)
        return
    trajectory = solve(problem, options)
    _write(trajectory, problem, output)
    if len(reserves) > 1:
        _front(problem, options, reserves, output)


def _refuse_rivals(
    chosen: PlanSettings,
    running_time: str | None,
    reserves: list[float],
    stops: str | None,
    km: str | None,
    condition: Path | None,
    layer: str | None,
    at: str | None,
) -> None:
    """Refuse options that contradict each other, before anything is read."""
    ends = {
        "--km": km,
        "--set initial-speed": chosen.initial_speed,
        "--set final-speed": chosen.final_speed,
    }
    if stops is not None:
        _refuse("--stops gives places and speeds itself", ends)
        if len(reserves) > 1:
            raise InputError(
                "--reserve: several reserves are compared of one run without stops",
                remedy="give one, or leave out --stops",
            )
    else:
        _refuse("there are no --stops", {"--set dwell": chosen.dwell}, "or give them")
    if running_time is not None:
        _refuse("--running-time gives the time", {"--reserve": reserves or None})
        if _is_log(running_time):
            _refuse("the time of a trip is from end to end of the line", ends)
    if condition is None:
        of_map = {
            "--layer": layer,
            "--at": at,
            "--set risk": chosen.risk,
            "--set sigmas": chosen.sigmas,
            "--set assumed-adhesion": chosen.assumed_adhesion,
        }
        _refuse("there is no --map to be read", of_map, "or give a map")
    if chosen.risk is not None:
        _refuse("risk says how cautiously the map is read", {"--set sigmas": chosen.sigmas})


def _is_log(given: str) -> bool:
    return given.endswith(".mcap") or Path(given).exists()


def _running_time(given: str, line: Line) -> float:
    """A running time [s] that is stated, or that of the fastest non-stop trip of logs."""
    if not _is_log(given):
        return TIME.read(given, "--running-time")
    from analysis.comparison.groups import fastest_nonstop

    return fastest_nonstop(logs_in([Path(given)]), line)


def _journey_of(stops: str, line: Line, running_time: float | None) -> Journey:
    """The journey of a file, or of the stations named, with the running time that is given."""
    from trainlog.formats.line import read_journey
    from trainlog.railway.journey import Journey, TimingPoint

    if Path(stops).exists() or stops.endswith((".json", ".toml")):
        journey = read_journey(stops)
    else:
        points = [
            TimingPoint(_station(each.strip(), line), None, None, 0.0, 0.0)
            for each in stops.split(",")
        ]
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
        journey = Journey(stops, line.name, tuple(points))
    if running_time is None:
        return journey
    *before, last = journey.points
    return replace(journey, points=(*before, replace(last, latest=running_time)))


def _station(name: str, line: Line) -> float:
    """The position of a station [m]; one whose name is alike is suggested."""
    places = {each.name: each.position for each in line.stations}
    if name in places:
        return places[name]
    near = similar(name, places, 1)
    raise InputError(
        f"--stops: there is no station '{name}' on {line.name}",
        remedy=f"did you mean '{near[0]}'?" if near else f"there are {', '.join(places) or 'none'}",
    )


def _configurations(parameters: Path | None, train: Train, load: float | None) -> ParameterSet:
    """The observed set; without one the train as its file describes it."""
    from trainlog.formats.parameters import read_parameters
    from trainlog.railway import Configuration, ParameterSet
    from trainlog.railway.train import check_load

    if parameters is None:
        carried = load or 0.0
        check_load(carried, train)
        return ParameterSet(train.name, (Configuration.of(train, carried),))
    _refuse("the parameter set holds the masses", {"--set load": load})
    observed = read_parameters(parameters)
    observed.check_train(train.name)
    if not observed.configurations:
        raise InputError(
            "holds no configuration",
            file=parameters,
            remedy="'trainlog fit' makes a set from trips; without a set the train's file is taken",
        )
    if observed.assumed_power:
        console.print(f"  {parameters.name}: {observed.assumed_power}", highlight=False)
    return observed


def _refuse(why: str, given: Mapping[str, object], remedy: str = "") -> None:
    """Refuse options that contradict another one; None are those that were not given."""
    named = [name for name, value in given.items() if value is not None]
    if named:
        raise InputError(
            f"{' and '.join(named)} cannot be taken: {why}",
            remedy=" ".join(filter(None, (f"leave out {' and '.join(named)}", remedy))),
        )


def _write(trajectory: Trajectory, problem: TrajectoryProblem, output: Path) -> None:
    """Write a trajectory, its picture and its advice, and print what it is."""
    from analysis.charts import draw
    from analysis.trajectory.adhesion import adhesion_words
    from analysis.trajectory.advice import driver_table, journey_advice, write_journey_advice
    from analysis.trajectory.table import certified, trajectory_table
    from trainlog.formats.trajectory import write_trajectory

    advice = journey_advice([trajectory], problem.line)
    write_trajectory(trajectory, output)
    draw(trajectory, output.with_suffix(".png"), line=problem.line)
    write_journey_advice(advice, output.with_suffix(".csv"))
    content = current().content
    content.setdefault("trajectories", []).append({"trajectory": output, **certified(trajectory)})
    console.print(*trajectory_table(trajectory))
    if current().as_json:
        content.setdefault("advice", []).extend(advice.details()["advice"])
    else:
        console.print(driver_table(advice))
    for words in adhesion_words(problem, trajectory):
        console.print(f"  {words}", highlight=False, soft_wrap=True)
    wrote(output, output.with_suffix(".png"), output.with_suffix(".csv"))


def _journey(
    problem: TrajectoryProblem,
    options: OptimiserOptions,
    journey: Journey,
    dwell: float,
    output: Path,
) -> None:
    """Optimise a journey; one file per section, numbered."""
    from analysis.trajectory.advice import with_times
    from analysis.trajectory.journey import optimise_journey
    from analysis.trajectory.table import journey_table

    with task("optimising the sections"):
        plan = optimise_journey(problem, journey, options, dwell=dwell)
    sections = with_times(plan.sections, plan.departures, plan.journey.name)
    files = [output.with_name(f"{output.stem}-{n + 1}.json") for n in range(len(sections))]
    for section, file in zip(sections, files, strict=True):
        _write(section, problem, file)
    console.print(journey_table(plan, problem.line))
    names = " ".join(map(str, files))
    words = f"Advice for all of it: trainlog advice {names} --departure 07:12 -o advice.html"
    console.print(words, highlight=False, soft_wrap=True)


def _front(
    problem: TrajectoryProblem, options: OptimiserOptions, reserves: list[float], output: Path
) -> None:
    """Energy against running time, printed and drawn."""
    from analysis.charts import draw
    from analysis.trajectory.optimiser import energy_against_time

    front = energy_against_time(problem, reserves, options)
    picture = output.with_name(f"{output.stem}-pareto.png")
    draw(front, picture)
    show(front)
    wrote(picture)


def advice(
    trajectories: Annotated[
        list[Path],
        typer.Argument(help="Trajectory file, or those of a journey's sections."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="The page (.html), beside which the CSV is written; with --onto the log (.mcap).",
        ),
    ],
    departure: Annotated[
        str | None,
        typer.Option(
            help="Time of day of the first departure, 07:12; default: times since departure."
        ),
    ] = None,
    line: Annotated[
        Path | None,
        typer.Option("--line", help="Line file; default: the line that the trajectory holds."),
    ] = None,
    dwell: Annotated[
        float | None,
        measured(
            "--dwell",
            of=TIME.between(0.0),
            help="Standing time at stops, of sections planned one by one; default: 0.",
        ),
    ] = None,
    onto: Annotated[
        Path | None,
        typer.Option(
            help="Log (.mcap) of a trip over the same section: it is written anew with the advice"
            " beside what was driven, so that a replay shows both."
        ),
    ] = None,
) -> None:
    """Write the driver's advice for a whole journey, or add it to a recorded trip.

    One page to print, and one CSV: stations with arrival and departure in the clock of the
    timetable; where to drive, to hold which speed, to coast and to brake, by kilometre and by the
    nearest station.

    Example: trainlog advice results/trajectory.json --departure 07:12 -o advice.html

    Example: trainlog advice results/trajectory.json --onto trip.mcap -o advised.mcap
    """
    if onto is not None:
        _refuse(
            "--onto adds the advice to a log",
            {"--departure": departure, "--line": line, "--dwell": dwell},
        )
        if len(trajectories) > 1:
            raise InputError("several trajectories are given", remedy="with --onto name one")
        _advise(onto, trajectories[0], output)
        return
    destination(output, ".html")

    from analysis.reports.advice import write_driver_advice
    from analysis.trajectory.advice import driver_table, time_of_day

    start = None if departure is None else time_of_day(departure)
    table = output.with_suffix(".csv")
    with task("writing the advice"):
        found = write_driver_advice(
            trajectories, output, table, line=line, start=start, dwell=dwell or 0.0
        )
    if not state(found.details()):
        console.print(driver_table(found))
    wrote(output, table)


def _advise(log: Path, trajectory: Path, output: Path) -> None:
    """Write a log with a trajectory's advice beside what was driven."""
    from analysis.trajectory.advice import with_advice
    from trainlog.formats.trajectory import read_trajectory
    from trainlog.mcap import read_log, write_log

    destination(output, ".mcap")
    if output.resolve() == log.resolve():
        raise InputError("is the log itself", file=output, remedy="give the result another name")
    write_log(with_advice(read_log(log), read_trajectory(trajectory)), output)
    wrote(output)
