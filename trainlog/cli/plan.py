"""Commands that plan: plan, advice."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from trainlog.cli.options import (
    LineOption,
    RiskOption,
    RunTimeOption,
    TrainOption,
    destination,
    line_and_train,
    load_of,
    logs_in,
    map_of_run,
    measured,
    stretch,
)
from trainlog.cli.terminal import console, current, state, working, wrote
from trainlog.errors import InputError
from trainlog.units import NUMBER, PERCENT, SPEED, TIME

if TYPE_CHECKING:
    from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
    from trainlog.railway import ParameterSet, Train, Trajectory


def plan(
    output: Annotated[Path, typer.Option("--output", "-o", help="Trajectory file (JSON).")],
    parameters: Annotated[
        Path | None,
        typer.Argument(help="Observed parameter set (JSON); default: the train's file alone."),
    ] = None,
    line: LineOption = None,
    train: TrainOption = None,
    load: Annotated[
        str | None,
        typer.Option(
            help="Without a parameter set: what the train carries, kg or 12t; default: 0."
        ),
    ] = None,
    running_time: Annotated[
        float | None, measured("--running-time", of=TIME, help="Timetable's running time: 17:30.")
    ] = None,
    reserve: Annotated[
        float | None,
        measured(
            "--reserve",
            of=PERCENT,
            help="Without --running-time: reserve over the least time; default: 7%.",
        ),
    ] = None,
    as_fast_as: Annotated[
        Path | None,
        typer.Option(help="Running time of the fastest non-stop trip of this log or folder."),
    ] = None,
    braking: Annotated[
        Literal["recourse", "common"],
        typer.Option(help="Each configuration brakes for itself, or all alike."),
    ] = "recourse",
    objective: Annotated[
        Literal["wheel", "line", "expected"],
        typer.Option(
            help="Traction at the wheel rims; or energy from the line, with efficiencies and what"
            " the dynamic brake feeds back, at worst or as expected of the observed trips."
        ),
    ] = "wheel",
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
    assumed_adhesion: Annotated[
        float | None,
        measured(
            "--assumed-adhesion",
            of=NUMBER,
            help="With --map: adhesion counted on where it has none; default: no limit there.",
        ),
    ] = None,
    cells: Annotated[
        int,
        typer.Option(
            min=20, max=20_000, help="Cells of the grid; at least one for each step of the line."
        ),
    ] = 500,
    reverse: Annotated[
        bool, typer.Option("--reverse", help="Travel against the line's chainage.")
    ] = False,
    journey: Annotated[
        Path | None,
        typer.Option(help="Journey file: stops and passing points; one trajectory a section."),
    ] = None,
    dwell: Annotated[
        float | None,
        measured(
            "--dwell", of=TIME.between(0.0), help="With --journey: least standing time at a stop."
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
    initial_speed: Annotated[
        float | None,
        measured("--initial-speed", of=SPEED, help="Speed where it begins; default: standstill."),
    ] = None,
    final_speed: Annotated[
        float | None,
        measured(
            "--final-speed", of=SPEED, help="Speed where it ends, at most; default: standstill."
        ),
    ] = None,
    sigmas: Annotated[
        float | None,
        measured(
            "--sigmas",
            of=NUMBER,
            help="With --map: standard deviations taken off its estimate; default: 2.",
        ),
    ] = None,
    risk: RiskOption = None,
    at: RunTimeOption = None,
    protect: Annotated[
        Literal["front", "train"],
        typer.Option(help="Speed limits hold for the train's front, or for all of its length."),
    ] = "front",
    pareto: Annotated[
        bool, typer.Option("--pareto", help="Energy against running time too, and its picture.")
    ] = False,
    time_limit: Annotated[
        float | None,
        measured(
            "--time-limit",
            of=TIME.between(0.1),
            help="Time after which the best that was found is taken, with its gap; what has"
            " begun is finished. Of each section, with --journey.",
        ),
    ] = None,
    referee: Annotated[
        bool, typer.Option("--referee", help="Solve it again with CasADi and IPOPT, and compare.")
    ] = False,
) -> None:
    """Find the trajectory of least energy that every observed configuration can follow.

    Without a parameter set it is planned for one configuration, the train as its file describes
    it; such a plan has no band: trips that differ from the file may be late.

    The answer carries its certificate: an independent fine rollout of every configuration and a
    lower bound on the energy. Beside it stand a picture, and the driver's advice as CSV.

    Example: trainlog plan fitted.json --line sample --train sample -o trajectory.json

    Example: trainlog plan --train my.train.toml --line A-B.line.json -o trajectory.json
    """
    from analysis.trajectory.optimiser import optimise as solve
    from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem

    destination(output, ".json")
    ends = {"--km": km, "--initial-speed": initial_speed, "--final-speed": final_speed}
    times = {"--running-time": running_time, "--as-fast-as": as_fast_as}
    if journey is not None:
        rivals = {**times, "--pareto": pareto or None, **ends}
        _refuse("--journey gives times, places and speeds itself", rivals)
    else:
        _refuse("there is no --journey with stops", {"--dwell": dwell}, "or give a journey")
    if running_time is not None:
        _refuse("--running-time gives the time", {"--as-fast-as": as_fast_as, "--reserve": reserve})
    if as_fast_as is not None:
        _refuse("--as-fast-as gives the time", {"--reserve": reserve})
        _refuse("--as-fast-as is the time from end to end of the line", ends)
    if condition is None:
        of_map: dict[str, object] = {"--assumed-adhesion": assumed_adhesion, "--sigmas": sigmas}
        of_map |= {"--risk": risk, "--at": at, "--layer": layer}
        _refuse("there is no --map to be read", of_map, "or give a map")
    if risk is not None:
        _refuse("--risk says how cautiously the map is read", {"--sigmas": sigmas})
    the_line, the_train = line_and_train(line, train)
    observed = _configurations(parameters, the_train, load)
    if protect == "train" and not the_train.length:
        raise InputError(
            f"--protect train: the length of {the_train.name} is not known",
            remedy="state its length in the train's file",
        )
    if as_fast_as is not None:
        from analysis.comparison.groups import fastest_nonstop

        running_time = fastest_nonstop(logs_in([as_fast_as]), the_line)
    own_line = the_line
    if reverse:
        the_line = the_line.reversed()
    start, end = stretch(km, the_line) or (None, None)
    track, time = (None, None) if condition is None else map_of_run(condition, at, own_line)
    if track is not None and layer is None:
        console.print("  no --layer is given: wet", highlight=False)
    given: dict[str, Any] = {
        "running_time": running_time,
        "reserve": reserve,
        "start": start,
        "end": end,
        "initial_speed": initial_speed,
        "final_speed": final_speed,
        "weights": observed.weights if objective == "expected" else None,
        "condition_map": track,
        "sigmas": sigmas,
        "risk": risk,
        "time": time,
        "assumed_adhesion": assumed_adhesion,
        "protected_length": the_train.length if protect == "train" else None,
        "direction": "reverse" if reverse else None,
    }
    problem = TrajectoryProblem(
        the_line,
        the_train,
        observed.configurations,
        braking=braking,
        objective=objective,
        layer=layer or "wet",
        **{name: value for name, value in given.items() if value is not None},
    )
    options = OptimiserOptions(cells, referee, time_limit=time_limit)
    if journey is not None:
        _journey(problem, options, journey, dwell or 0.0, output)
        return
    trajectory = solve(problem, options)
    _write(trajectory, problem, output)
    if pareto:
        _front(problem, options, output)


def _configurations(parameters: Path | None, train: Train, load: str | None) -> ParameterSet:
    """The observed set; without one the train as its file describes it."""
    from trainlog.formats.parameters import read_parameters
    from trainlog.railway import Configuration, ParameterSet
    from trainlog.railway.train import check_load

    if parameters is None:
        carried = 0.0 if load is None else load_of(load)
        check_load(carried, train)
        return ParameterSet(train.name, (Configuration.of(train, carried),))
    _refuse("the parameter set holds the masses", {"--load": load})
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
    from analysis.trajectory.adhesion import adhesion_words
    from analysis.trajectory.advice import driver_table, journey_advice, write_journey_advice
    from analysis.trajectory.plot import draw_trajectory
    from analysis.trajectory.table import certified, trajectory_table
    from trainlog.formats.trajectory import write_trajectory

    advice = journey_advice([trajectory], problem.line)
    write_trajectory(trajectory, output)
    draw_trajectory(trajectory, problem.line, output.with_suffix(".png"))
    write_journey_advice(advice, output.with_suffix(".csv"))
    content = current().content
    content.setdefault("trajectories", []).append({"trajectory": output, **certified(trajectory)})
    console.print(trajectory_table(trajectory))
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
    journey: Path,
    dwell: float,
    output: Path,
) -> None:
    """Optimise a journey; a file a section, numbered."""
    from analysis.trajectory.advice import with_times
    from analysis.trajectory.journey import optimise_journey
    from analysis.trajectory.table import journey_table
    from trainlog.formats.line import read_journey

    with working("optimising the sections"):
        plan = optimise_journey(problem, read_journey(journey), options, dwell=dwell)
    sections = with_times(plan.sections, plan.departures, plan.journey.name)
    files = [output.with_name(f"{output.stem}-{n + 1}.json") for n in range(len(sections))]
    for section, file in zip(sections, files, strict=True):
        _write(section, problem, file)
    console.print(journey_table(plan, problem.line))
    names = " ".join(map(str, files))
    words = f"Advice for all of it: trainlog advice {names} --departure 07:12 -o advice.html"
    console.print(words, highlight=False, soft_wrap=True)


def _front(problem: TrajectoryProblem, options: OptimiserOptions, output: Path) -> None:
    """Energy against running time, printed and drawn."""
    from analysis.trajectory.optimiser import energy_against_time
    from analysis.trajectory.plot import draw_front
    from analysis.trajectory.table import front_table

    front = energy_against_time(problem, options=options)
    picture = output.with_name(f"{output.stem}-pareto.png")
    draw_front(front, picture)
    console.print(front_table(front))
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
    with working("writing the advice"):
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
