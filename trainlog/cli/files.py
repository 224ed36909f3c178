"""Commands on files: import, new, show, convert.

Parameters
----------
output : FILE
    New file: .toml, or .json with --from; it must not exist.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import analysis
import trainlog
from trainlog.cli.commands import end_in_part
from trainlog.cli.options import (
    Choices,
    ChosenTrips,
    Logs,
    Picture,
    Written,
    destination,
    distinct,
    line_of_log,
    logs_in,
    refuse_rivals,
    sections_in,
    set_option,
    settings_of,
    stretch,
    times,
)
from trainlog.cli.terminal import (
    console,
    current,
    print_account,
    print_error,
    print_problems,
    say,
    say_wrapped,
    state,
    wrote,
)
from trainlog.display import counted
from trainlog.errors import InputError, LogError, TrainlogError
from trainlog.progress import task, track
from trainlog.units import KMH, PERCENT, SPEED

if TYPE_CHECKING:
    from trainlog.mcap import Account


PHYSICS: Choices = {
    "mass-model": (
        ("mass_point", "homogeneous_strip"),
        "of a train: gradients at its front, or averaged over its length",
    ),
    "acceleration-limits": (
        ("gross", "net"),
        "of a train: limits of effort over inertia, or of its own acceleration",
    ),
    "curve-resistance": (
        ("proportional", "roeckl", "roeckl_small_radius"),
        "of a line: 0.6/R; Roeckl's 0.65/(R - 55); 0.5/(R - 30)",
    ),
}
"""What ``--set KEY=VALUE`` sets of what is imported."""


def import_(
    files: list[Path],
    /,
    *,
    output: Path,
    electrification: str | None = None,
    traction_curve: Path | None = None,
    braking_curve: Path | None = None,
    formation: str | None = None,
    loaded: Annotated[float | None, PERCENT.between(0.0, 1.0)] = None,
    category: str | None = None,
    limit: Annotated[float | None, SPEED.between(1.0 / KMH, 600.0 / KMH)] = None,
    gradients_known: bool = False,
    line: Path | None = None,
    set_: Annotated[list[str] | None, set_option(PHYSICS)] = None,
) -> None:
    """Convert lines, trains, journeys and networks of other programs to files of trainlog.

    Formats: tracks, trains and journeys of TTOBench; rolling stock and infrastructure of OSRD;
    rolling stock and running paths of railtoolkit; infrastructure of railML 2 and 3; journeys of
    SFERA with segments and train, as a folder or a zip archive.

    For infrastructure the command lists unsupported elements and assumptions; unconnected tracks
    become separate networks. Line and train files of trainlog need an option that changes them.

    Example: trainlog import CH_StGallen_Wil.json CH_Stadler_FLIRT_TPF.json -o railway

    trainlog import DB_V90.yaml Facs124.yaml --formation "DB_V90, 10 Facs124" -o railway

    Parameters
    ----------
    files : FILES
        TTOBench or OSRD (JSON), railtoolkit (YAML), railML or SFERA (XML, folder or zip); or a
        train file, with a curve.
    output : FOLDER
        Folder for the files.
    electrification : NAME
        Electrification of an OSRD train; default: that of the file.
    traction_curve : FILE
        CSV with the tractive effort of the train over speed, units in the header.
    braking_curve : FILE
        CSV with the effort of its dynamic brake.
    formation : VEHICLES
        Vehicles of a railtoolkit train by id, from front to rear: 'DB_V90, 10 Facs124'; with a name
        of the train: 'ore: DB_V90, 10 Facs124'.
    loaded : SHARE
        Share of the load of a railtoolkit train.
    category : NAME
        Category of trains for the speed limits of a network; 'none': limits for all trains.
        Default: the lowest of all categories.
    limit : SPEED
        Speed limit of a network if the file states none; default: its lowest.
    gradients_known
        Track without a stated gradient is level. Default: level by assumption; running resistance
        is not fitted there.
    line : FILE
        Line file for gradients, curves and tunnels that a journey of SFERA does not state: the same
        line by the operator's kilometre, or by the names of stations.
    """
    from trainlog.formats.csv_tables import read_effort_curve
    from trainlog.formats.files import output_folder
    from trainlog.formats.imports import ImportOptions, import_file, import_formation
    from trainlog.formats.railway import read_line

    traction, braking = (
        None if path is None else read_effort_curve(path)
        for path in (traction_curve, braking_curve)
    )
    physics = {
        key.replace("-", "_"): value for key, value in settings_of(set_ or [], PHYSICS).items()
    }
    options = ImportOptions(
        electrification, traction, braking, loaded=loaded, category=category, limit=limit,
        gradients_known=gradients_known, line=None if line is None else read_line(line), **physics,
    )  # fmt: skip
    name, _, vehicles = (formation or "").rpartition(":")
    with output_folder(output):
        if formation is not None:
            wrote(import_formation(files, vehicles, output, options, name.strip() or None).path)
        taken, failed = set[Path](), 0
        for file in files if formation is None else ():
            try:
                found = import_file(file, output, options, taken)
            except TrainlogError as error:
                if len(files) == 1:
                    raise
                print_error(str(error))
                failed += 1
                continue
            for each in found:
                taken.add(each.path)
                wrote(each.path)
                if each.dropped:
                    console.print(f"  not taken over: {'; '.join(each.dropped)}")
                if each.assumed:
                    console.print(f"  assumed: {'; '.join(each.assumed)}")
    end_in_part(failed, len(files))


new_app = typer.Typer(
    add_completion=False,
    help="Create a line, network, train, journey or profile, or copy the samples.",
)


@new_app.command("line")
def new_line(
    *,
    output: Path,
    from_: Annotated[list[Path] | None, ChosenTrips] = None,
    name: str | None = None,
    picture: Picture = None,
) -> None:
    """Create a line: a commented template, or from a table, logs or a route.

    From logs: centre line with curvature, and gradients if altitudes of three trips or more
    determine them, with their accuracy; fixes do not determine limits and stations. From a route:
    the shortest one through the places.

    Example: trainlog new line -o my.line.toml

    Example: trainlog new line --from A-B.csv -o A-B.line.toml

    Example: trainlog new line --from results/recorded -o results/line.json

    Parameters
    ----------
    from_ : FILE
        CSV of chainage, gradient, limit and, if known, station, radius, latitude, longitude, units
        in its header; logs along the line with satellite fixes, may be given several times; or a
        route in a network, "NET#A,B,C".
    name : NAME
        Name, with --from; default: that of the file.
    picture : FILE
        Picture of a line from logs; default: beside the output, .png.
    """
    from trainlog.formats.railway import route_of_path, write_template

    made_from = from_ or []
    if made_from and route_of_path(made_from[0]) is not None:
        _write_route(made_from, output, name)
    elif any(each.is_dir() or each.suffix == ".mcap" for each in made_from):
        _line_of_fixes(made_from, output, name, picture)
    elif len(made_from) > 1:
        raise InputError("a line is made from one file", remedy="give --from once")
    elif name and not made_from:
        raise InputError(
            f"--name {name}: a template states its own name",
            remedy="leave --name out, and edit name in the file",
        )
    else:
        wrote(write_template("line", output, table=next(iter(made_from), None), name=name))


@new_app.command("network")
def new_network(
    *, output: Annotated[Path, Written(".json")], from_: list[Path], name: str | None = None
) -> None:
    """Join lines to a network, at common stations.

    A line is divided where another one begins, ends or crosses; there trains can pass from each
    edge to each other. Common track appears once.

    Example: trainlog new network --from A-B.line.json --from B-C.line.json -o my.network.json

    Parameters
    ----------
    output : FILE
        Network file to write (.json).
    from_ : FILE
        Line file; may be given several times.
    name : NAME
        Name of the network; default: that of the file.
    """
    from trainlog.railway.network import network_of_lines

    network, notes = network_of_lines(
        name or output.name.partition(".")[0], [trainlog.read_line(each) for each in from_]
    )
    trainlog.write_network(network, output)
    console.print(
        f"{network.name}: {counted(len(network.edges), 'edge')} of {network.length / 1e3:.3f} km,"
        f" {counted(len(network.nodes), 'node')}",
        *notes,
        sep="\n",
    )
    wrote(output)


def _new(kind: Literal["train", "journey", "profile"], what: str) -> None:
    """Add a command that writes a commented file."""

    def begin(*, output: Path) -> None:
        from trainlog.formats.railway import write_template

        wrote(write_template(kind, output))

    begin.__doc__ = f"Create a {what}: a commented, valid template to edit."
    begin.__doc__ += f"\n\nExample: trainlog new {kind} -o my.{kind}.toml"
    new_app.command(kind)(begin)


_new("train", "train")
_new("journey", "journey, with its stops and times")
_new("profile", "profile of a recorder's table")


@new_app.command("samples")
def new_samples(*, output: Path) -> None:
    """Copy the samples to a folder: lines, trains, logs, recordings.

    Example: trainlog new samples -o sample_logs

    Parameters
    ----------
    output : FOLDER
        Folder for the samples.
    """
    from trainlog.formats.samples import copy_samples

    wrote(*copy_samples(output))


def _write_route(given: list[Path], output: Path, name: str | None) -> None:
    """Write the line of the shortest route through places of a network."""
    from analysis.contents import contents_of

    destination(output, ".json")
    if len(given) > 1:
        raise InputError("several routes are given", remedy="give --from once")
    found = contents_of(given[0])
    console.print(*found.parts(), sep="\n")
    line = found.value.line
    trainlog.write_line(replace(line, name=name) if name else line, output)
    wrote(output)


def _line_of_fixes(logs: list[Path], output: Path, name: str | None, picture: Path | None) -> None:
    """Build a line from the satellite fixes of trips along it."""
    from analysis.charts import draw

    destination(output, ".json")
    shown = destination(picture or output.with_suffix(".png"), ".png")
    topics = ("/gnss/fix", "/gnss/motion", "/train/state")
    trips = [trainlog.read(log, topics) for log in track(logs_in(logs), "reading", "log")]
    with task("fitting"):
        centre_line = analysis.geometry_of(trips)
    trainlog.write_line(
        analysis.line_of(centre_line, name or output.stem.removesuffix(".line")), output
    )
    draw(centre_line, shown, trips=trips)
    console.print(*centre_line.shown(), sep="\n")
    wrote(output, shown)


def show(
    files: Logs,
    /,
    *,
    check: bool = False,
    all_: bool = False,
    picture: Annotated[Path | None, Written(".png", ".svg")] = None,
    open_: bool = False,
) -> None:
    """Show the content of a file; the kind of file is recognised by its content.

    Log: topics, units, rates, time and position span, gaps, passport. Consist: vehicles, couplers,
    brake. Network: edges and nodes, unknown quantities. Route (NET#A,B,C): its sections and
    stations. Map: line, layers, trips, days. Recording: its readable content. Folder: its files.
    Exit status 1 if a log is damaged ([bold]trainlog convert[/bold] rebuilds it), or some files
    cannot be shown; 2 if none can.

    Example: trainlog show results/trips/trip-01.mcap

    Example: trainlog show results/trips --check

    Example: trainlog show my.line.toml --picture line.png

    Parameters
    ----------
    files : FILES
        Files of trainlog or recordings: logs, lines, trains, maps, parameter sets, trajectories,
        profiles; folders of them; or 'sample', all samples.
    check
        Read logs of any program to the last byte, verify every checksum and list losses.
    all_
        Also list the trips of maps by name, and the repairs of logs with their raw values.
    picture : FILE
        Draw a trip, a line or a network into this file (.png, .svg).
    open_
        Open a report in the browser.
    """
    if check:
        _check(logs_in(files))
        return
    if len(files) > 1 and (picture is not None or open_):
        raise InputError("one file is shown as a picture", remedy="name a single file")
    from trainlog.formats import samples

    files = [
        samples.folder() if str(file) == samples.SAMPLE and not file.exists() else file
        for file in files
    ]
    if picture is not None:
        from analysis.contents import contents_of, draw_contents

        draw_contents(contents_of(files[0]), picture)
    damaged = refused = 0
    for file in files:
        try:
            damaged += _show(file, all_) if _is_trip(file) else _show_folder(file)
        except TrainlogError as error:  # one file that cannot be shown says nothing of the others
            if len(files) == 1:
                raise
            print_problems(error)
            refused += 1
    if picture is not None:
        wrote(picture)
    if open_:
        _open(files[0])
    end_in_part(refused, len(files))
    if damaged:
        raise typer.Exit(1)


def _check(logs: list[Path]) -> None:
    """Read logs to the last byte, and state what is lost of them."""

    def checked(log: Path) -> tuple[Account, dict[str, Any]]:
        account = trainlog.check(log)
        return account, {"log": log, "whole": account.whole}

    damaged = _accounts(logs, "checking", checked)
    if damaged:
        raise typer.Exit(1)


def _accounts(
    logs: list[Path], what: str, made: Callable[[Path], tuple[Account, dict[str, Any]]]
) -> int:
    """State what is lost of each log; how many are damaged."""
    damaged, refused, accounts = 0, 0, list[dict[str, Any]]()
    for log in track(logs, what, "log"):
        try:
            account, about = made(log)
        except LogError as error:  # one file that is no log says nothing of the others
            print_error(str(error))
            refused += 1
            continue
        accounts.append({**about, **account.details()})
        damaged += not account.whole
        if not state({"logs": accounts}):
            print_account(log, account)
        if rebuilt := about.get("rebuilt"):
            wrote(rebuilt)
    end_in_part(refused, len(logs))
    return damaged


def _show(file: Path, every: bool) -> bool:
    """State what a file holds; whether it is a log that is damaged."""
    from analysis.contents import contents_of

    found = contents_of(file)
    if found.damaged and current().quiet:
        _state_damage(file, found.described().account.sentence)
    if found.kind == "log" and state({}):
        current().content.setdefault("logs", []).append(found.described().data())
        for part in found.repairs(every=every):
            console.print(part)
    else:
        for part in found.parts(every=every):
            say_wrapped(part) if isinstance(part, str) else console.print(part)
    return found.damaged


def _show_folder(folder: Path) -> bool:
    """List what the files of a folder are; whether a log among them is damaged."""
    from analysis.contents import folder_contents
    from trainlog.presentation import Column, new_table

    columns = Column("file", of="name"), Column("kind"), Column("contents", of="summary")
    rows = folder_contents(folder)
    for row in rows:
        if row.damaged and current().quiet:
            _state_damage(folder / row.name, row.summary)
    console.print(new_table(str(folder), *columns, name="file").add_rows(rows))
    return any(row.damaged for row in rows)


def _state_damage(log: Path, words: str) -> None:
    print_problems(LogError(words, file=log, remedy="'trainlog convert' rebuilds it"))


def _open(file: Path) -> None:
    """Open a report on a file in the browser."""
    import tempfile
    import webbrowser

    page = Path(tempfile.mkdtemp(prefix="trainlog-")) / f"{file.stem}.html"
    analysis.write_report(file, page, analysis.ReportOptions())
    wrote(page)
    if not webbrowser.open(page.resolve().as_uri()):
        console.print("no browser here: open the page where there is one")


def convert(
    sources: Logs,
    /,
    *,
    output: Path,
    topic: list[str] | None = None,
    from_: str | None = None,
    to: str | None = None,
    km: str | None = None,
    prefer: Path | None = None,
) -> None:
    """Convert logs to Parquet, CSV or MDF and back; cut, join and rebuild them.

    Conversion of a log to Parquet, CSV (a file per topic with units in its header) or MDF (extra
    [bold]recorders[/bold]) and back is lossless; logs may be larger than the memory. Logs of other
    programs can be converted to Parquet or CSV; they are loaded as a whole.

    --from, --to, --km and --topic select a part. Metadata and attachments are those of the whole
    log; the provenance states the cut.

    Several logs of one trip are joined: consecutive parts, or logs of several recorders. Logs of
    other trains, lines or directions are refused, and so are different samples of a topic at the
    same time; --prefer decides between them.

    A whole log as .mcap, or logs into a folder, are rebuilt with every readable message and an
    account of losses; the damaged logs stay unchanged. A network becomes GeoJSON: edges as lines,
    nodes and stations as points. A trajectory becomes the table of plan (.csv).

    Example: trainlog convert trip.mcap -o trip.parquet

    Example: trainlog convert trip.mcap -o part.mcap --km 3.2:7.5

    Example: trainlog convert morning.mcap noon.mcap -o day.mcap

    Example: trainlog convert damaged.mcap -o rebuilt/

    Parameters
    ----------
    sources : SOURCES
        Logs (.mcap) or folders of them, MDF (.mf4), a folder of Parquet or CSV files; or a network;
        or a trajectory, or the folder of a journey's sections.
    output : FILE
        .mcap (a log), .mf4 (MDF 4), .parquet or .csv (folders with a file per topic), for a network
        .geojson; else a folder for rebuilt logs.
    prefer : FILE
        For joined logs: the log whose samples count if others have the same topic and time.
    """
    part = {"--from": from_, "--to": to, "--km": km, "--topic": topic or None}
    kind = output.suffix.lower()
    if len(sources) < 2 or kind != ".mcap":
        refuse_rivals("it is one of several logs that are joined", {"--prefer": prefer})
    if kind == ".csv" and all(map(_is_planned, sources)):
        refuse_rivals("trajectories are written as a whole", part)
        _export_profile(sources, output)
        return
    if kind != ".geojson":
        sources = [
            log for each in sources for log in ([each] if _is_trip(each) else logs_in([each]))
        ]
    several = len(sources) > 1
    as_a_whole = {
        ".geojson": "a network is written",
        "": "logs are rebuilt",
        ".mcap": "several logs are joined" if several else "",
    }.get(kind)
    if as_a_whole:
        refuse_rivals(f"{as_a_whole} as a whole", part)
    if kind == ".geojson":
        _export_network(sources[0], output)
    elif not kind or (
        not several and (sources[0].suffix, kind) == (".mcap", ".mcap") and not any(part.values())
    ):
        _rebuild(sources, output)
    elif several and kind == ".mcap":
        _merge(sources, output, prefer)
    elif several:
        raise InputError(
            f"there are {len(sources)} logs for one {kind}",
            file=output,
            remedy="give one, or name a log (.mcap) in which they are joined",
        )
    else:
        from trainlog.formats.files import output_folder
        from trainlog.mcap.convert import convert as write, span_of

        time = times(from_, to, lambda: span_of(sources[0]))
        position = None if km is None else stretch(km, line_of_log(sources[0]))
        with output_folder(output.parent), task("converting", unit="row") as step:
            done = write(
                sources[0], output, progress=step, topics=topic or None, time=time,
                position=position,
            )  # fmt: skip
        _summary(output, done.rows, [f"not converted: {reason}" for reason in done.left_out])


def _is_trip(source: Path) -> bool:
    """Whether it is one trip: a file, or a folder with a table for each topic."""
    return not source.is_dir() or (source / "trip.json").exists()


def _is_planned(source: Path) -> bool:
    """Whether it is a trajectory's file, or the folder of a journey's sections."""
    return source.suffix == ".json" or next(source.glob("section-*.json"), None) is not None


def _export_profile(sources: list[Path], output: Path) -> None:
    """Write trajectories of a journey as one table over the kilometres."""
    from analysis.trajectory.table import write_profile

    found = analysis.journey_advice(
        [trainlog.read_trajectory(each) for each in sections_in(sources)]
    )
    write_profile(found, destination(output, ".csv"))
    wrote(output)


def _export_network(file: Path, output: Path) -> None:
    """Write a network for geographic programs."""
    from analysis.network.edges import export_network

    found = export_network(trainlog.read_network(file), output)
    console.print(
        f"{counted(found.edges, 'edge')}, {counted(found.nodes, 'node')},"
        f" {counted(found.stations, 'station')}",
    )
    if found.left_out:
        console.print(f"left out without coordinates: {', '.join(found.left_out)}")
    wrote(output)


def _merge(logs: list[Path], output: Path, prefer: Path | None) -> None:
    """Join logs of one trip."""
    from trainlog.mcap.convert import merge as write

    destination(output, ".mcap")
    done = write(logs, output, prefer=prefer)
    notes = [f"{counted(count, 'row')} of {name} in two logs alike: kept once"
             for name, count in done.repeated.items() if count]  # fmt: skip
    notes += [f"{count:,} rows of {name} left out for those of {prefer}"
              for name, count in done.left_out.items() if count]  # fmt: skip
    _summary(output, done.rows, [*notes, *done.notes])


def _rebuild(logs: list[Path], output: Path) -> None:
    """Rebuild logs with every message that is readable, and account for what is lost."""
    from trainlog.formats.files import output_folder

    several = len(logs) > 1 or output.suffix != ".mcap"
    if several:
        distinct([log.name for log in logs], logs)

    def rebuilt(log: Path) -> tuple[Account, dict[str, Any]]:
        target = output / log.name if several else destination(output, ".mcap")
        return trainlog.recover(log, target), {"log": log, "rebuilt": target}

    with output_folder(output) if several else nullcontext():
        _accounts(logs, "recovering", rebuilt)


def _summary(output: Path, rows: Any, notes: Sequence[str]) -> None:
    if not state({"rows": dict(rows)}):
        console.print(f"  {rows.total():,} rows in {counted(len(rows), 'topic')}")
    for note in notes:
        say(f"  {note}")
    wrote(output)
