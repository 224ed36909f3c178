"""The command line: one command a verb; the work is done in the rooms below."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer
from typer.exceptions import TyperException

from trainlog import __version__
from trainlog.errors import InputError, TrainlogError
from trainlog.terminal import (
    about,
    complaints,
    console,
    destination,
    folder,
    line_and_train,
    logs_in,
    pairs,
    progress_bar,
    read_trips,
    working,
    wrote,
)

INTERRUPTED = 130
"""Exit status after Ctrl-C; typer returns it, too."""

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
map_app = typer.Typer(no_args_is_help=True, help="The track-condition map: maximum adhesion.")
app.add_typer(map_app, name="map", rich_help_panel="Learn")

Logs = Annotated[list[Path], typer.Argument(help="Logs (.mcap), or folders of logs.")]
LineOption = Annotated[
    Path | None, typer.Option("--line", help="Line file; default: St.Gallen-Wil.")
]
TrainOption = Annotated[
    Path | None, typer.Option("--train", help="Train file; default: Stadler FLIRT.")
]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same bytes.")]


def _version(show: bool) -> None:
    if show:
        console.print(f"trainlog {__version__}", highlight=False)
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Record train trips in a standard log, learn from them, and plan robust trajectories.

    A first look: [bold]trainlog demo[/bold] runs the whole chain. Then, with your own logs:
    [bold]ingest[/bold] them, [bold]fit[/bold] the running resistance, [bold]map update[/bold] the
    track condition, [bold]optimise[/bold] the trajectory, [bold]replay[/bold] everything.
    """


# ------------------------------------------------------------------------------------- record


@app.command(rich_help_panel="Record")
def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the logs.")],
    line: LineOption = None,
    train: TrainOption = None,
    count: Annotated[int, typer.Option(min=1, help="Trips to drive.")] = 12,
    seed: Seed = 1,
    trajectory: Annotated[
        Path | None, typer.Option(help="Follow this trajectory instead of a driver's habits.")
    ] = None,
    configurations: Annotated[
        str,
        typer.Option(help="With --trajectory: 'hardest', 'all', or names separated by commas."),
    ] = "hardest",
    weather: Annotated[
        Literal["dry", "wet"] | None,
        typer.Option(help="With --trajectory: the rail's condition; default dry."),
    ] = None,
) -> None:
    """Drive trips in simulation and log them.

    Loads, weather, running resistance, drivers and slippery spots vary with the seed; sensors
    have noise. With [bold]--trajectory[/bold] the trips follow it, one a configuration.

    Example: trainlog simulate --count 12 --seed 1 -o results/trips
    """
    from trainlog.formats.trajectory import read_trajectory
    from trainlog.mcap import write_log
    from trainlog.simulation.scenario import (
        draw_scenarios,
        trajectory_scenarios,
    )
    from trainlog.simulation.scenario import (
        simulate as drive,
    )

    the_line, the_train = line_and_train(line, train)
    if trajectory is None:
        if weather is not None:
            raise InputError("--weather goes with --trajectory", remedy="leave it out")
        scenarios = draw_scenarios(the_line, the_train, count=count, seed=seed)
    else:
        plan = read_trajectory(trajectory)
        names = plan.chosen(configurations)
        scenarios = trajectory_scenarios(
            plan, the_line, the_train, names, seed=seed, weather=weather or "dry"
        )
    folder(output)
    with progress_bar() as progress:
        for scenario in progress.track(scenarios, description="driving"):
            trip = drive(scenario)
            write_log(trip, output / f"{trip.name}.mcap")
            progress.console.print(about(trip), highlight=False)


@app.command(rich_help_panel="Record")
def ingest(
    recordings: Annotated[list[Path], typer.Argument(help="Recorded files (CSV, Parquet).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the logs.")],
    profile: Annotated[
        Path | None, typer.Option(help="TOML profile: columns, units, signs, time format.")
    ] = None,
    line: Annotated[Path | None, typer.Option(help="Line it was driven on, if known.")] = None,
    train: Annotated[Path | None, typer.Option(help="Train that drove, if known.")] = None,
    reverse: Annotated[
        bool, typer.Option("--reverse", help="The trip ran against the line's chainage.")
    ] = False,
    facts: Annotated[
        list[str] | None,
        typer.Option("--set", help="What the file does not tell: weather=wet, load=12000 (kg)."),
    ] = None,
) -> None:
    """Turn recorded logs into trips; what was repaired is counted and kept in the log.

    Example: trainlog ingest recorder.csv --profile recorder.profile.toml -o results/recorded
    """
    from trainlog.formats.line import read_line
    from trainlog.formats.train import read_train
    from trainlog.ingest import ingest as read_recording
    from trainlog.ingest import report_of
    from trainlog.mcap import write_log

    the_line = None if line is None else read_line(line)
    the_train = None if train is None else read_train(train)
    targets = {output / f"{recording.stem}.mcap": recording for recording in recordings}
    if len(targets) < len(recordings):
        raise InputError(
            "two recordings have the same name", remedy="ingest them into different folders"
        )
    metadata = pairs(facts or [])
    for target, recording in targets.items():
        with working(f"reading {recording.name}"):
            trip = read_recording(
                recording,
                profile=profile,
                line=the_line,
                train=the_train,
                direction="reverse" if reverse else None,
                metadata=metadata,
            )
            folder(output)
            write_log(trip, target)
        console.print(about(trip), highlight=False)
        for finding in report_of(trip).lines():
            console.print(f"    {finding}", highlight=False)
        wrote(target)


@app.command(name="import", rich_help_panel="Record")
def import_(
    files: Annotated[list[Path], typer.Argument(help="TTOBench tracks, trains or journeys.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the files.")],
) -> None:
    """Turn TTOBench tracks and trains into trainlog's line and train files.

    Example: trainlog import CH_StGallen_Wil.json CH_Stadler_FLIRT_TPF.json -o railway
    """
    from trainlog.formats.ttobench import convert

    folder(output)
    for file in files:
        wrote(convert(file, output))


# --------------------------------------------------------------------------------------- look


@app.command(rich_help_panel="Look")
def info(logs: Logs) -> None:
    """Tell what is in a log: topics, units, rates, time and position span, gaps, provenance.

    Example: trainlog info results/trips/trip-01.mcap
    """
    from trainlog.mcap import describe
    from trainlog.mcap.show import render

    for log in logs_in(logs):
        console.print(render(describe(log)))


@app.command(rich_help_panel="Look")
def replay(
    logs: Logs,
    output: Annotated[Path, typer.Option("--output", "-o", help="The .rrd recording.")],
    trajectory: Annotated[Path | None, typer.Option(help="Trajectory file to show.")] = None,
    condition: Annotated[
        Path | None, typer.Option("--map", help="Track-condition map to show.")
    ] = None,
    viewer: Annotated[
        bool, typer.Option(help="Open the Rerun viewer where there is a display.")
    ] = True,
) -> None:
    """Show trips in the Rerun viewer, by time and by position.

    Example: trainlog replay results/trips/trip-01.mcap -o results/replay.rrd
    """
    from trainlog.formats.condition import read_map
    from trainlog.formats.trajectory import read_trajectory
    from trainlog.replay import open_viewer, record_replay

    trips = read_trips(logs)
    with working(f"writing {output.name}"):
        record_replay(
            trips,
            output,
            trajectory=None if trajectory is None else read_trajectory(trajectory),
            condition_map=None if condition is None else read_map(condition),
        )
    wrote(output)
    if viewer:
        console.print(open_viewer(output))


@app.command(rich_help_panel="Look")
def compare(
    logs: Logs,
    followed: Annotated[
        Path, typer.Option("--with", help="Log or folder of trips that followed a trajectory.")
    ],
) -> None:
    """Compare drivers' trips with trips that followed a trajectory: time and energy.

    Example: trainlog compare results/trips --with results/driven
    """
    from analysis.compare import savings
    from analysis.report import savings_table

    console.print(savings_table(savings(read_trips(logs), read_trips([followed]))))


@app.command(rich_help_panel="Look")
def report(
    results: Annotated[Path, typer.Argument(help="Folder of results, as the demo leaves it.")],
) -> None:
    """Sum up a folder of results: fit, map, trajectory, energy; simulated trips against the truth.

    Example: trainlog report results
    """
    from analysis.report import results_table

    console.print(results_table(results))


# -------------------------------------------------------------------------------------- learn


@app.command(rich_help_panel="Learn")
def fit(
    logs: Logs,
    output: Annotated[Path, typer.Option("--output", "-o", help="Observed parameter set (JSON).")],
    picture: Annotated[
        Path | None, typer.Option(help="Picture; default: beside the output, .png.")
    ] = None,
) -> None:
    """Fit running resistance by recursive least squares, per trip and together.

    Writes the observed set of parameter configurations, with uncertainty, and a picture. Trips
    that do not determine the resistance are refused with the reason.

    Example: trainlog fit results/trips -o results/parameters.json
    """
    from analysis.pictures.resistance import draw_fits
    from analysis.report import fit_table
    from analysis.resistance import fit_logs
    from trainlog.formats.parameters import write_parameters

    destination(output, ".json")
    shown = destination(picture or output.with_suffix(".png"), ".png")
    with progress_bar() as progress:
        fits = fit_logs(progress.track(logs_in(logs), description="fitting"))
    write_parameters(fits.parameters, output)
    draw_fits(fits, shown)
    console.print(fit_table(fits))
    wrote(output, shown)


@app.command(rich_help_panel="Learn")
def estimate(
    logs: Logs,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the logs.")],
) -> None:
    """Add estimates to logs: smoothed motion, running resistance as it is learnt, adhesion, slip.

    Example: trainlog estimate results/trips/trip-01.mcap -o results/estimated
    """
    from analysis.estimates import with_estimates
    from trainlog.mcap import read_log, write_log

    with progress_bar() as progress:
        for log in progress.track(logs_in(logs), description="estimating"):
            if (output / log.name).resolve() == log.resolve():
                raise InputError("would be overwritten", file=log, remedy="name another folder")
            trip, refusals = with_estimates(read_log(log))
            folder(output)
            write_log(trip, output / log.name)
            for refusal in refusals:
                progress.console.print(f"  not estimated: {refusal}", highlight=False)
            wrote(output / log.name)


@map_app.command("update")
def map_update(
    logs: Logs,
    condition: Annotated[Path, typer.Option("--map", help="Map file; made if it is not there.")],
    layer: Annotated[
        Literal["dry", "wet"] | None,
        typer.Option(help="Rail condition; default: the weather that each log tells."),
    ] = None,
) -> None:
    """Add the evidence of trips to the track-condition map: slip events and adhesion in use.

    A log that the map already holds is not counted again.

    Example: trainlog map update results/trips --map results/map.json
    """
    from analysis.pictures.condition import draw_map
    from analysis.report import map_table
    from analysis.traction_map import update_logs
    from trainlog.formats.condition import read_map, write_map

    destination(condition, ".json")
    known = read_map(condition) if condition.exists() else None
    with progress_bar() as progress:
        every = progress.track(logs_in(logs), description="mapping")
        updated, told = update_logs(known, every, layer)
    for trip in told:
        console.print(f"  {trip}: in the map already, not counted again", highlight=False)
    write_map(updated, condition)
    draw_map(updated, condition.with_suffix(".png"))
    console.print(map_table(updated))
    wrote(condition, condition.with_suffix(".png"))


@map_app.command("show")
def map_show(
    condition: Annotated[Path, typer.Argument(help="Map file.")],
    picture: Annotated[Path | None, typer.Option(help="Draw the map here as well.")] = None,
) -> None:
    """Show what a track-condition map knows, and where it knows nothing."""
    from analysis.pictures.condition import draw_map
    from analysis.report import map_table
    from trainlog.formats.condition import read_map

    if picture is not None:
        destination(picture, ".png")
    known = read_map(condition)
    console.print(map_table(known))
    if picture is not None:
        draw_map(known, picture)
        wrote(picture)


# --------------------------------------------------------------------------------------- plan


@app.command(rich_help_panel="Plan")
def optimise(
    parameters: Annotated[Path, typer.Argument(help="Observed parameter set (JSON).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Trajectory file (JSON).")],
    line: LineOption = None,
    train: TrainOption = None,
    running_time: Annotated[
        float | None, typer.Option(help="Timetable's running time in seconds.")
    ] = None,
    reserve: Annotated[
        float, typer.Option(help="Without --running-time: reserve over the least time (%).")
    ] = 10.0,
    as_fast_as: Annotated[
        Path | None,
        typer.Option(help="Running time of the fastest non-stop trip of this log or folder."),
    ] = None,
    braking: Annotated[
        Literal["recourse", "common"],
        typer.Option(help="Each configuration brakes for itself, or all alike as in the paper."),
    ] = "recourse",
    objective: Annotated[
        Literal["wheel", "line"],
        typer.Option(
            help="Traction at the wheel rims as in the paper, or energy from the line: efficiencies"
            " and what the dynamic brake feeds back."
        ),
    ] = "wheel",
    condition: Annotated[
        Path | None, typer.Option("--map", help="Track-condition map that limits the efforts.")
    ] = None,
    layer: Annotated[
        Literal["dry", "wet"], typer.Option(help="Rail condition of the map.")
    ] = "wet",
    cells: Annotated[
        int,
        typer.Option(
            min=20, max=20_000, help="Cells of the grid; at least one for each step of the line."
        ),
    ] = 500,
    referee: Annotated[
        bool, typer.Option("--referee", help="Solve it again with CasADi and IPOPT, and compare.")
    ] = False,
) -> None:
    """Find the trajectory of least energy that every observed configuration can follow.

    The answer carries its certificate: an independent fine rollout of every configuration and a
    lower bound on the energy.

    Example: trainlog optimise results/parameters.json -o results/trajectory.json
    """
    from analysis.compare import fastest_nonstop
    from analysis.pictures.trajectory import draw_trajectory
    from analysis.report import trajectory_table
    from analysis.trajectory import optimise as solve
    from trainlog.formats.condition import read_map
    from trainlog.formats.parameters import read_parameters
    from trainlog.formats.trajectory import write_trajectory

    destination(output, ".json")
    the_line, the_train = line_and_train(line, train)
    observed = read_parameters(parameters)
    observed.check_train(the_train.name)
    if as_fast_as is not None:
        if running_time is not None:
            raise InputError("--running-time and --as-fast-as contradict", remedy="give one")
        running_time = fastest_nonstop(read_trips([as_fast_as]), the_line)
    with working(f"optimising over {len(observed.configurations)} configurations"):
        trajectory = solve(
            the_line,
            the_train,
            observed.configurations,
            running_time=running_time,
            reserve=reserve / 100.0,
            braking=braking,
            objective=objective,
            condition_map=None if condition is None else read_map(condition),
            layer=layer,
            cells=cells,
            referee=referee,
        )
    write_trajectory(trajectory, output)
    draw_trajectory(trajectory, the_line, output.with_suffix(".png"))
    console.print(trajectory_table(trajectory))
    wrote(output, output.with_suffix(".png"))


# ------------------------------------------------------------------------------------- others


@app.command(rich_help_panel="Start here")
def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")] = Path(
        "results"
    ),
) -> None:
    """Run the whole chain on St.Gallen-Wil: record, fit, map, optimise, replay."""
    from trainlog.demo import run_demo

    run_demo(output, console, run=lambda arguments: run(arguments))


@app.command(rich_help_panel="Start here")
def samples(
    output: Annotated[Path, typer.Argument(help="Folder to copy them to.")] = Path("sample_logs"),
) -> None:
    """Copy the sample logs, line, train and map that come with trainlog."""
    from trainlog.formats.samples import copy_samples

    wrote(*copy_samples(output))


# --------------------------------------------------------------------------------- entry point


def run(arguments: list[str]) -> int:
    """Run one command in this process and return its exit status; errors are raised."""
    command = typer.main.get_command(app)
    return command.main(arguments, prog_name="trainlog", standalone_mode=False) or 0


def main() -> None:
    """Entry point of the ``trainlog`` command.

    Exit status 0: done; 2: bad input, told in one line; 130: interrupted.
    """
    try:
        status = run(sys.argv[1:])
    except TrainlogError as error:
        status = _complain(str(error))
    except TyperException as error:
        told = error.format_message() if hasattr(error, "format_message") else str(error)
        status = _complain(f"{told} See 'trainlog --help'.")
    except OSError as error:
        # The rooms below turn the errors they expect into TrainlogError; this is a full disk, a
        # lost drive, a forbidden folder met elsewhere.
        status = _complain(f"{error.filename or 'file'}: {error.strerror or error}")
    except (KeyboardInterrupt, typer.Abort):
        status = INTERRUPTED
    if status == INTERRUPTED:
        complaints.print("trainlog: interrupted; what was finished is kept")
    sys.exit(status)


def _complain(message: str) -> int:
    told = " ".join(message.split())
    complaints.print(f"trainlog: {told}", markup=False, highlight=False, soft_wrap=True)
    return 2
