"""Commands that make logs: simulate, ingest, recover; and import of lines and trains."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from trainlog.cli.commands import end_in_part
from trainlog.cli.options import (
    CategoryOption,
    LineOption,
    Logs,
    RiskOption,
    RunTimeOption,
    Seed,
    TrainOption,
    destination,
    distinct,
    lasting_change,
    line_and_train,
    line_or_network,
    logs_in,
    map_of_run,
    pairs,
)
from trainlog.cli.proposing import Proposals
from trainlog.cli.terminal import (
    about,
    console,
    current,
    print_account,
    print_error,
    state,
    working,
    wrote,
)
from trainlog.errors import InfeasibleError, InputError, LogError
from trainlog.formats.files import output_folder
from trainlog.progress import track

if TYPE_CHECKING:
    from trainlog.ingest import Ingested
    from trainlog.simulation import TractionLoop

app = typer.Typer()
line_app = typer.Typer(no_args_is_help=True, help="Lines: built from the satellite fixes of trips.")
app.add_typer(line_app, name="line", rich_help_panel="Record")


@app.command(rich_help_panel="Record")
def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the logs.")],
    line: LineOption = None,
    train: TrainOption = None,
    count: Annotated[int | None, typer.Option(min=1, help="Trips of drivers; default: 12.")] = None,
    seed: Seed = 1,
    trajectory: Annotated[
        Path | None, typer.Option(help="Follow this trajectory instead of a driver's habits.")
    ] = None,
    configurations: Annotated[
        str | None,
        typer.Option(
            help="With --trajectory: 'hardest' (default: most and least resistance, least power),"
            " 'all', or names separated by commas."
        ),
    ] = None,
    weather: Annotated[
        Literal["dry", "wet"] | None,
        typer.Option(help="With --trajectory: the rail's condition; default dry."),
    ] = None,
    characteristic: Annotated[
        str | None,
        typer.Option(
            help="Adhesion over slip: a file of 'trainlog adhesion fit', measured points (CSV),"
            " polach-dry or polach-wet; default: the curves of Zhao et al. (2025)."
        ),
    ] = None,
    traction: Annotated[
        Literal["own", "cooperative", "readhesion"],
        typer.Option(
            help="Who gives the axles their efforts: the plant's own slip protection, cooperative"
            " control, best with --map, or re-adhesion control that knows no map. Both take some"
            " times as long to simulate."
        ),
    ] = "own",
    condition: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="With --trajectory or --traction cooperative: track-condition map that the train"
            " knows.",
        ),
    ] = None,
    risk: RiskOption = None,
    at: RunTimeOption = None,
    late: Annotated[
        float, typer.Option(min=0.0, help="With --trajectory: departs so many seconds late.")
    ] = 0.0,
    days: Annotated[
        int | None,
        typer.Option(
            min=1, help="Trips of so many days, on a rail with passing spots and weather."
        ),
    ] = None,
    trips_per_day: Annotated[
        int | None, typer.Option(min=1, help="With --days: from 5:00 to 23:00; default 4.")
    ] = None,
    start: Annotated[
        str | None, typer.Option(help="With --days: the first; default 2026-10-01.")
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(
            help="A fleet on a network: its file (.network.json), or 'drawn' for ten lines drawn"
            " with the seed, 'drawn:4' for four. With --trains, --days, --count or --trips-per-day,"
            " --fault, --jobs."
        ),
    ] = None,
    trains: Annotated[
        int | None, typer.Option(min=1, help="With --network: of three kinds; default 20.")
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="With --network: of a train from a day on, as"
            " train=flirt-03,mass=3t,from=2026-10-12; or dragging-brake=2kN, wheel-diameter=1%,"
            " effort-gain=5%, sensor-delay=0.3s. May be given several times."
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, help="With --network: processes; default: one a processor."),
    ] = None,
    change: Annotated[
        list[str] | None,
        typer.Option(
            help="With --days: a lasting change of the rail, as"
            " km=10:14,date=2026-10-15,factor=1.3 (adhesion there, from then on); spots=0.2: of how"
            " often passing spots come."
        ),
    ] = None,
) -> None:
    """Drive trips in simulation and log them.

    Loads, weather, running resistance, drivers and slippery spots vary with the seed; sensors
    have noise. With [bold]--trajectory[/bold] the trips follow it by model predictive control, one
    a configuration; the train does not know in which it is, and where it is and how fast it knows
    from its own instruments. With [bold]--traction cooperative[/bold] the efforts of all powered
    axles come from one program that knows the rail ahead from the map (Zhao et al., 2025).

    With [bold]--days[/bold] the rail lives through the days: its weather changes, slippery spots
    come and go, and what changes for good is given with [bold]--change[/bold]. The weather is
    written beside the logs. A train that a slippery climb stops for good is listed; the exit status
    is then 1.

    With [bold]--network[/bold] a fleet runs over a network: trains of three kinds, each with a
    running resistance, wheels, brakes and a recorder of its own, on rosters of routes, through the
    same days of weather. Trips are made in parallel; an interrupted run goes on where it ended.

    Example: trainlog simulate --line sample --train sample --count 12 -o results/trips

    Example: trainlog simulate --network drawn --trains 20 --days 30 --count 1000 -o results/fleet

    Example: trainlog simulate --line my.line.json --train sample --days 30 -o results/october
    """
    from trainlog.formats.characteristic import read_characteristic
    from trainlog.formats.weather import write_weather
    from trainlog.mcap import write_log
    from trainlog.simulation import (
        Rail,
        draw_days,
        draw_scenarios,
        drive,
        recorded,
    )

    if network is not None:
        alone: dict[str, object] = {
            "line": line,
            "train": train,
            "trajectory": trajectory,
            "change": change,
        }
        alone |= {"characteristic": characteristic, "map": condition, "weather": weather}
        alone |= {"configurations": configurations, "risk": risk, "at": at, "late": late or None}
        alone |= {"change": change, "traction": None if traction == "own" else traction}
        for option, given in alone.items():
            if given is not None:
                raise InputError(
                    f"--{option} does not go with --network", remedy="leave one of them out"
                )
        fleet_of(
            network,
            output,
            seed,
            trains or 20,
            days or 30,
            count,
            trips_per_day,
            start,
            fault,
            jobs,
        )
        return
    _check_alone({"trains": trains, "fault": fault, "jobs": jobs}, "network")
    the_line, the_train = line_and_train(line, train)
    the_map = time = None
    if condition is not None and (trajectory is not None or traction == "cooperative"):
        the_map, time = map_of_run(condition, None if trajectory is None else at, the_line)
    over_days = None
    if trajectory is None:
        following = {
            "configurations": configurations,
            "weather": weather,
            "map": None if the_map else condition,
        }
        _check_alone(following | {"late": late or None, "risk": risk, "at": at}, "trajectory")
    if days is None:
        _check_alone({"trips-per-day": trips_per_day, "start": start, "change": change}, "days")
    if days is not None:
        if trajectory is not None or count is not None:
            other = "count" if trajectory is None else "trajectory"
            raise InputError(
                f"--days and --{other} are different kinds of trips", remedy="give one of them"
            )
        changes = [lasting_change(word, the_line) for word in change or []]
        over_days = Rail.draw(the_line, days, start or "2026-10-01", seed, changes)
        scenarios = draw_days(over_days, [the_train], trips_per_day or 4)
    elif trajectory is None:
        scenarios = draw_scenarios(the_line, the_train, count=count or 12, seed=seed)
    elif count is not None:
        raise InputError(
            "--count is the number of drivers' trips; along a trajectory there is one for each"
            " configuration",
            remedy="leave out --count, or choose with --configurations",
        )
    else:
        from analysis.control.follow import following_line, following_scenarios
        from analysis.control.route import counted_on
        from trainlog.formats.trajectory import read_trajectory

        if condition is None and (risk is not None or at is not None):
            raise InputError(
                "--risk and --at say how a map is read", remedy="give --map, or leave them out"
            )
        words = counted_on(the_map, weather or "dry", risk, time)
        console.print(f"  {words}", highlight=False, soft_wrap=True)
        scenarios = following_scenarios(
            read_trajectory(trajectory), the_line, the_train,
            configurations=configurations or "hardest", weather=weather or "dry", late=late,
            condition_map=the_map, seed=seed,
            risk=risk, time=time,
        )  # fmt: skip
    if characteristic is not None:
        rail = read_characteristic(characteristic)
        scenarios = [replace(each, characteristic=rail) for each in scenarios]
    if traction != "own":
        from analysis.control.plot import draw_traction
        from analysis.control.traction import with_traction

        scenarios = with_traction(scenarios, traction, the_map)
        if traction == "cooperative" and the_map is None:
            console.print("no --map: the cooperative control knows the rail only by its own slips")
    followed, stuck, trips = [], 0, list[dict[str, object]]()
    with output_folder(output):
        for scenario in track(scenarios, "driving", "trip"):
            try:
                run = drive(scenario)
            except InfeasibleError as error:
                # Of a month one train may be stopped for good by a slippery climb.
                if over_days is None:
                    raise
                stuck += 1
                print_error(str(error))
                continue
            trip = recorded(scenario, run)
            log = output / f"{trip.name}.mcap"
            write_log(trip, log)
            trips.append({"log": log, "duration_s": trip.duration, "metadata": trip.metadata})
            if not state({"trips": trips}):
                console.print(about(trip.metadata, trip.duration), highlight=False, markup=False)
            if run.traction is not None:
                words = f"    traction control {traction_line(run.traction)}"
                console.print(words, highlight=False)
                draw_traction(trip, output / f"{trip.name}.traction.png", the_map)
                wrote(output / f"{trip.name}.traction.png")
            if trajectory is not None:
                console.print(f"    {following_line(trip)}", highlight=False)
                followed.append(trip)
    if over_days is not None:
        write_weather(over_days.table, output / "weather.csv")
        wrote(output / "weather.csv")
    if followed:
        from analysis.control.plot import draw_following

        draw_following(followed, output / "following.png")
        wrote(output / "following.png")
    if stuck:
        raise typer.Exit(1)


def fleet_of(
    network: str,
    output: Path,
    seed: int,
    trains: int,
    days: int,
    count: int | None,
    trips_per_day: int | None,
    start: str | None,
    faults: list[str] | None,
    jobs: int | None,
) -> None:
    """Simulate a fleet on a network and print what was made."""
    from trainlog.formats.network import read_network
    from trainlog.simulation import Fault, draw_fleet, draw_network, write_fleet

    if count is not None and trips_per_day is not None:
        raise InputError(
            "--count and --trips-per-day both say how many trips there are",
            remedy="give one of them",
        )
    drawn, _, lines = network.partition(":")
    if drawn == "drawn":
        if lines and not lines.isdigit():
            raise InputError(f"'{network}' is no network", remedy="write it as drawn or drawn:4")
        the_network = draw_network(seed, int(lines or 10))
    else:
        the_network = read_network(network)
    trips = count if trips_per_day is None else trips_per_day * trains * days
    fleet = draw_fleet(
        the_network,
        trains=trains,
        days=days,
        trips=trips,
        seed=seed,
        faults=[Fault.of(words) for words in faults or []],
        start=start or "2026-10-01",
    )
    console.print(f"{fleet}", highlight=False, markup=False)
    logs = write_fleet(fleet, output, jobs)
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
            f" {speed:,.0f} times as fast as the trains",
            highlight=False,
        )
        if len(logs.codes) > 1:
            console.print(
                f"The logs were made by {len(logs.codes)} versions of the code, as fleet.json"
                f" states: {', '.join(logs.codes)}.",
                highlight=False,
            )
    if logs.stuck:
        raise typer.Exit(1)


def traction_line(loop: TractionLoop) -> str:
    """What became of the decisions of a traction control, in words."""
    return (
        f"{loop.control.name}: {len(loop.unsolved)} of {loop.steps} decisions unsolved, {loop.late}"
        f" late (over {1e3 * loop.control.period:g} ms; longest {1e3 * loop.longest:.1f} ms)"
    )


def _check_alone(options: dict[str, object], needed: str) -> None:
    """Refuse options that go with the option `needed`, which is not given."""
    for option, given in options.items():
        if given is not None:
            what = "a trajectory" if needed == "trajectory" else f"--{needed}"
            also = ", or drive with --traction cooperative" if option == "map" else ""
            raise InputError(
                f"--{option} goes with --{needed}",
                remedy=f"give {what}, or leave out --{option}{also}",
            )


@app.command(rich_help_panel="Record")
def ingest(
    recordings: Annotated[
        list[Path],
        typer.Argument(help="Recorded files, and folders of them: docs/ingest.md lists formats."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the logs.")],
    profile: Annotated[
        Path | None, typer.Option(help="TOML profile: columns, units, signs, time format.")
    ] = None,
    format: Annotated[
        str | None, typer.Option(help="Name of the format, such as csv; default: detected.")
    ] = None,
    line: Annotated[
        Path | None,
        typer.Option(help="Line it was driven on, if known; or a network, as --network."),
    ] = None,
    network: Annotated[
        Path | None,
        typer.Option(help="Network it was driven on: the route is found in it by the fixes."),
    ] = None,
    stations: Annotated[
        str | None,
        typer.Option(
            help="With --network: stations of the route with commas between them, or edge@km."
        ),
    ] = None,
    train: Annotated[Path | None, typer.Option(help="Train that drove, if known.")] = None,
    reverse: Annotated[
        bool, typer.Option("--reverse", help="The trip ran against the line's chainage.")
    ] = False,
    facts: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="What the file does not state, of all its trips: weather=wet, load=12000 (kg) or"
            " 12t, start_position=0.2km, or =stations: where the stops match them.",
        ),
    ] = None,
    accept: Annotated[
        bool,
        typer.Option(
            "--accept", "--yes", help="Use the profile that is proposed, where none fits."
        ),
    ] = False,
) -> None:
    """Turn recorded logs into trips; what was repaired is counted and kept in the log.

    A log is named after its file or, where the file holds several recordings, after its trip. Of
    several files, or a folder, every one is tried; the end is a table of what became of each. What
    was made before of the same content in the same way is not made again.

    For a table that no profile fits one is proposed: a commented TOML file in the output folder,
    to be read, corrected and given with [bold]--profile[/bold], or used at once with
    [bold]--accept[/bold].

    On a [bold]--network[/bold] each recording is matched to its route, and cut where the train
    turned back or left the network; a route that the fixes do not determine is refused.

    Exit status 0: every recording became a trip; 1: some did not, or a profile is proposed; 2: the
    only file given did not, or something else that was given cannot be used.

    Example: trainlog ingest recorder.csv --profile recorder.profile.toml -o results/recorded
    """
    from analysis.passports import with_estimated_passport
    from trainlog.formats.train import read_train
    from trainlog.ingest import Ingested, Outcome, ingest_all

    alone = len(recordings) == 1 and not recordings[0].is_dir()
    found: list[Outcome] = []
    the_train = None if train is None else read_train(train)
    as_json = current().as_json
    the_line, routes = line_or_network(line, network, stations)
    proposals = Proposals(output, the_train, format, accept=accept, quiet=as_json, line=the_line)
    try:
        result = ingest_all(
            recordings,
            output,
            profile,
            format=format,
            line=the_line,
            train=the_train,
            direction="reverse" if reverse else None,
            metadata=pairs(facts or []),
            network=routes,
            each=lambda outcome, done, total: found.append(outcome),  # noqa: ARG005
            choose=proposals.profile_for,
            finish=with_estimated_passport if (line or network) and train else None,
        )
    except KeyboardInterrupt:
        _print_ingested(Ingested(output, tuple(found)), alone=False)
        raise
    if alone and not as_json and [each.state for each in found] == ["refused"]:
        if proposals.waiting:
            print_error(found[0].reason)
            raise typer.Exit(1)
        raise InputError(found[0].reason)
    _print_ingested(result, alone=alone)
    if result.failed:
        raise typer.Exit(1)


def _print_ingested(result: Ingested, *, alone: bool) -> None:
    """Print what became of the recordings: of a single file with its report, else as a table."""
    from analysis.ingest_table import ingest_table

    if state(result.details()):
        return
    if not alone:
        console.print(ingest_table(result))
        return
    shown: set[str] = set()
    for each in result.of("made", "repaired", "unchanged"):
        assert each.log is not None
        assert each.report is not None
        if each.state == "unchanged":
            console.print(f"  {each.metadata['trip']}: {each.reason}", highlight=False)
            console.print(f"kept {each.log}", highlight=False, soft_wrap=True)
            continue
        console.print(about(each.metadata, each.duration), highlight=False, markup=False)
        shown_as = {"direction": "direction", "route": f"route {each.metadata.get('line')}:"}
        for what, words in shown_as.items():
            if f"{what}_evidence" in each.metadata:
                words = f"    {words} {each.metadata[f'{what}_evidence']}"
                console.print(words, highlight=False, markup=False, soft_wrap=True)
        lines = [line for line in each.report.lines() if line not in shown]
        console.print(*(f"    {line}" for line in lines), sep="\n", highlight=False, markup=False)
        # What the file holds besides its trips is shown with the first of them.
        shown.update(line for line in lines if line.startswith("not used: "))
        wrote(each.log)
    for each in result.of("refused"):
        print_error(each.reason)
    if len(result.outcomes) > 1:
        console.print(result.sentence, highlight=False)


@app.command(rich_help_panel="Record")
def recover(
    logs: Logs,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Log to write, or folder for several.")
    ],
) -> None:
    """Rebuild damaged logs with every message that is readable, and account for what is lost.

    A log that was cut, that a recorder left when it was killed, or that a disk has damaged becomes
    a whole one with an index. Works for MCAP files of any program. The damaged log stays as it is;
    the account is kept in the new one.

    Example: trainlog recover trip.mcap -o recovered/
    """
    from trainlog.mcap import recover as rebuild

    found = logs_in(logs)
    several = len(found) > 1 or output.suffix != ".mcap"
    if several:
        if output.suffix == ".mcap":
            raise InputError(
                f"is the name of one log, and there are {len(found)}",
                file=output,
                remedy="name a folder",
            )
        distinct([log.name for log in found], found)
    refused, accounts = 0, list[dict[str, object]]()
    with output_folder(output) if several else nullcontext():
        for log in track(found, "recovering", "log"):
            target = output / log.name if several else destination(output, ".mcap")
            try:
                account = rebuild(log, target)
            except LogError as error:
                # One file that is no log does not keep the others from being rebuilt.
                if not several:
                    raise
                refused += 1
                print_error(str(error))
                continue
            accounts.append({"log": log, "rebuilt": target, **account.details()})
            if not state({"logs": accounts}):
                print_account(log, account)
            wrote(target)
    end_in_part(refused, len(found))


@app.command(name="import", rich_help_panel="Record")
def import_(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Of TTOBench or OSRD (JSON), railtoolkit (YAML), railML (XML); or a train file,"
            " with a curve."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the files.")],
    electrification: Annotated[
        str | None,
        typer.Option(help="Whose efforts an OSRD train gets; default: the file's default."),
    ] = None,
    traction_curve: Annotated[
        Path | None,
        typer.Option(help="CSV with the train's tractive effort over speed, units in the header."),
    ] = None,
    braking_curve: Annotated[
        Path | None, typer.Option(help="The same of its dynamic brake.")
    ] = None,
    formation: Annotated[
        str | None,
        typer.Option(
            help="A train of vehicles of these railtoolkit files, by id, from front to rear:"
            " 'DB_V90, 10 Facs124'."
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="With --formation: name of the train.")] = None,
    loaded: Annotated[
        float | None,
        typer.Option(
            min=0.0, max=100.0, help="Of a railtoolkit train: per cent of its load on board."
        ),
    ] = None,
    mass_model: Annotated[
        Literal["mass_point", "homogeneous_strip"] | None,
        typer.Option(help="Of a train: gradients at its front, or averaged over its length."),
    ] = None,
    acceleration_limits: Annotated[
        Literal["gross", "net"] | None,
        typer.Option(help="Of a train: limits of effort over inertia, or of its own acceleration."),
    ] = None,
    curve_resistance: Annotated[
        Literal["proportional", "roeckl", "roeckl_small_radius"] | None,
        typer.Option(help="Of a line: 0.6/R; Roeckl's 0.65/(R - 55); 0.5/(R - 30)."),
    ] = None,
    category: CategoryOption = None,
) -> None:
    """Turn lines, trains, journeys and networks of other programs into trainlog's files.

    Tracks, trains and journeys of TTOBench; rolling stock and infrastructure of OSRD; rolling stock
    and running paths of railtoolkit; infrastructure of railML 2 and 3.

    Line and train files of trainlog are taken with an option that changes them.

    Example: trainlog import CH_StGallen_Wil.json CH_Stadler_FLIRT_TPF.json -o railway

    trainlog import DB_V90.yaml Facs124.yaml --formation "DB_V90, 10 Facs124" -o railway
    """
    from trainlog.formats.effort import read_effort_curve
    from trainlog.formats.imports import ImportOptions, import_file, import_formation

    traction, braking = (
        None if path is None else read_effort_curve(path)
        for path in (traction_curve, braking_curve)
    )
    options = ImportOptions(
        electrification, traction, braking, mass_model, acceleration_limits, curve_resistance,
        None if loaded is None else loaded / 100.0, category,
    )  # fmt: skip
    if formation is None and name is not None:
        raise InputError("--name is that of a formation", remedy="give --formation, too")
    with output_folder(output):
        if formation is not None:
            wrote(import_formation(files, formation, output, options, name).path)
        for file in files if formation is None else ():
            for each in import_file(file, output, options):
                wrote(each.path)
                if each.dropped:
                    console.print(f"  not taken over: {'; '.join(each.dropped)}", highlight=False)
                if each.assumed:
                    console.print(f"  assumed: {'; '.join(each.assumed)}", highlight=False)


@app.command(rich_help_panel="Record")
def new(
    kind: Annotated[
        Literal["line", "train", "journey", "profile"],
        typer.Argument(help="What to begin: line, train, journey or profile."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="File to write, .toml; it must not exist.")
    ],
    table: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="For a line: CSV of chainage, gradient, limit and, if known, station, radius,"
            " latitude, longitude; units in its header. The output may then be .json.",
        ),
    ] = None,
) -> None:
    """Begin a line, train, journey or profile: a commented file that is valid and ready to edit.

    Example: trainlog new train -o my.train.toml

    trainlog new line --from A-B.csv -o A-B.line.toml
    """
    from trainlog.formats.templates import write_template

    wrote(write_template(kind, output, table=table))


@line_app.command("build")
def line_build(
    logs: Logs,
    output: Annotated[Path, typer.Option("--output", "-o", help="Line file (JSON).")],
    name: Annotated[str | None, typer.Option(help="Name of the line; default: the file's.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture; default: beside the output, .png.")
    ] = None,
) -> None:
    """Build a line from the satellite fixes of trips along it, in either direction.

    Writes the centre line with its curvature, how well it is known and what it rests on. Speed
    limits, gradients and stations are not known from fixes; the line's source says so.

    Example: trainlog line build results/recorded -o results/line.json
    """
    from analysis.geometry.centre_line import geometry_of, line_of
    from analysis.geometry.plot import draw_centre_line
    from trainlog.formats.line import write_line
    from trainlog.mcap import read_log

    destination(output, ".json")
    shown = destination(picture or output.with_suffix(".png"), ".png")
    topics = ("/gnss/fix", "/gnss/motion", "/train/state")
    trips = [read_log(log, topics) for log in track(logs_in(logs), "reading", "log")]
    with working("fitting"):
        centre_line = geometry_of(trips)
    write_line(line_of(centre_line, name or output.stem), output)
    draw_centre_line(centre_line, trips, shown)
    for sentence in centre_line.lines():
        console.print(sentence, highlight=False)
    wrote(output, shown)
