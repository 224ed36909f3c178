"""Commands that look at trips: compare, replay, report."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from trainlog.cli.options import (
    AtOption,
    CatalogueOption,
    FromOption,
    KilometreOption,
    Logs,
    ToOption,
    TripsOption,
    chosen_logs,
    destination,
    logs_in,
    measured,
    moment,
    part_of,
    refuse_rivals,
)
from trainlog.cli.terminal import console, print_error, show, state, wrote
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.progress import task, track
from trainlog.units import SPEED

if TYPE_CHECKING:
    from trainlog.railway import ParameterSet, Train


def compare(
    logs: Logs,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Log or trajectory to compare with. Default: the fastest trip of each direction"
            " that covers nearly all of the others' part of the line."
        ),
    ] = None,
    followed: Annotated[
        list[Path] | None,
        typer.Option(
            "--with",
            help="Logs or folder of another group of trips, as of those driven by advice; several.",
        ),
    ] = None,
    line: Annotated[
        Path | None, typer.Option("--line", help="Line file. Default: the line in the logs.")
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Parameters file by whose running resistance energies are normalised. Default: the"
            " train's file in the logs."
        ),
    ] = None,
    time_of_day: Annotated[
        bool, typer.Option("--time-of-day", help="Count a later departure as time lost.")
    ] = False,
    calculated: Annotated[
        Path | None,
        typer.Option(
            help="Parameters or train file: compare each trip with what that predicts for it"
            " instead."
        ),
    ] = None,
    wind: Annotated[
        float | None,
        measured(
            "--wind",
            of=replace(SPEED.between(0.0), usual="m/s", examples="5, 5m/s or 18km/h"),
            help="Standard deviation of the head wind that calculated bands assume, as for a"
            " known calm day. Default: 1 m/s where the head wind is recorded, else 5 m/s.",
        ),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Save a picture (.png), one a direction or a trip.")
    ] = None,
) -> None:
    """Compare trips over a line by position: times, where time was lost and why, energy, driving.

    Stopping or not, recorded or simulated, over any part of the line; directions are kept apart.
    With --with, groups of trips instead: drivers' trips and trips that followed a trajectory,
    configuration by configuration. With --calculated, each trip beside what a fit or a train's
    file predicts for it: speed, time and energy with bands, and what of the model is wrong, by each
    trip and by all together.

    Example: trainlog compare sample_logs --picture compared.png
    """
    from analysis.charts import draw_charts
    from analysis.comparison.compare import compare as compare_trips
    from analysis.comparison.groups import compare_groups
    from analysis.comparison.plot import comparison_charts
    from trainlog.formats.railway import read_line, read_parameters, read_trajectory

    if picture is not None:
        destination(picture, ".png")
    for path in [*logs, *(followed or ())]:
        if not path.exists():
            raise InputError("does not exist", file=path, remedy="check the path")
    by_position: dict[str, object] = {
        "--reference": reference,
        "--line": line,
        "--model": model,
        "--time-of-day": time_of_day or None,
    }
    if followed:
        others = {**by_position, "--calculated": calculated, "--picture": picture}
        refuse_rivals("--with compares groups of trips", {**others, "--wind": wind})
        for group in followed:
            if len(followed) > 1:
                console.print(f"with {group}")
            show(compare_groups(logs_in(logs), logs_in([group])))
        return
    if calculated is not None:
        refuse_rivals("--calculated predicts each trip by itself", by_position)
        _calculated(logs, calculated, wind, picture)
        return
    refuse_rivals("it is of predictions", {"--wind": wind}, "or give --calculated")
    planned = reference is not None and not (reference.suffix == ".mcap" or reference.is_dir())
    found = compare_trips(
        logs_in(logs),
        read_trajectory(reference) if planned and reference else reference,
        line=None if line is None else read_line(line),
        model=None if model is None else read_parameters(model),
        by_time_of_day=time_of_day,
    )
    show(found)
    if picture is not None:
        for each in found.directions:
            several = len(found.directions) > 1
            path = picture.with_stem(f"{picture.stem}-{each.direction}") if several else picture
            with task(f"drawing {path.name}"):
                draw_charts(comparison_charts(each), path)
            wrote(path)


def _calculated(logs: list[Path], file: Path, wind: float | None, picture: Path | None) -> None:
    from analysis.charts import draw_charts
    from analysis.comparison.calculated import calculate, judged_together, together_words

    model, trips = _model(file), list(logs_in(logs))
    every, calculations = [], []
    for log in track(trips, "calculating", "trip"):
        found = calculate(log, model, wind_std=wind)
        calculations.append(found)
        every.append(found.data())
        together = judged_together(calculations)
        if not state({"trips": every, "together": together}):
            show(found)
        if picture is not None:
            several = len(trips) > 1
            path = picture.with_stem(f"{picture.stem}-{log.stem}") if several else picture
            draw_charts(found.charts(), path)
            wrote(path)
    if len(calculations) > 1:
        console.print(together_words(calculations, together), highlight=False)


def _model(path: Path) -> ParameterSet | Train:
    """A parameters file, or a train's file."""
    from trainlog.formats.files import read_json, refuse_map
    from trainlog.formats.railway import read_parameters, read_train

    refuse_map(path, "the parameters that 'trainlog fit' wrote, or a train's file, are expected")
    content = read_json(path) if path.suffix == ".json" else None
    of_fit = isinstance(content, dict) and content.get("format") == "trainlog/parameters"
    return read_parameters(path) if of_fit else read_train(path)


PIECE = 200_000
"""Rows that a replay holds at a time, over all topics."""


def replay(
    logs: Logs,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Save the recording (.rrd), or a picture of a view (.png, needs no display),"
            " instead of opening it.",
        ),
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(
            help="View shown first: overview, driving, traction, identification, map, recorder."
        ),
    ] = None,
    trajectory: Annotated[Path | None, typer.Option(help="Trajectory file to show.")] = None,
    condition: Annotated[
        Path | None, typer.Option("--map", help="Track-condition map to show.")
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Trip (.mcap) or trajectory (.json) with which the trips are compared along the"
            " line. Default: the trajectory, else the first trip."
        ),
    ] = None,
    line: Annotated[
        Path | None, typer.Option(help="Line file, for trips that carry no line.")
    ] = None,
    start: FromOption = None,
    end: ToOption = None,
    km: KilometreOption = None,
    thin: Annotated[
        bool | None,
        typer.Option(
            "--thin/--full",
            help="Only the overview, its samples thinned, or all. Default: thinned if there are"
            " more than 16 trips and no part of them is asked for.",
        ),
    ] = None,
    tiles: Annotated[
        bool, typer.Option("--tiles", help="Map tiles, which the viewer asks the network for.")
    ] = False,
    web: Annotated[
        bool, typer.Option("--web", help="Open it in the browser, saved or not.")
    ] = False,
) -> None:
    """Show trips in the Rerun viewer, by time and by position; or a part of them.

    The viewer runs until it is closed, or Ctrl-C ends it; it listens on this machine alone and
    asks for nothing on the network.

    Example: trainlog replay results/trips/trip-01.mcap

    Example: trainlog replay results/trips -o replay.png --view map
    """
    from trainlog.formats.condition import read_map
    from trainlog.formats.railway import read_line, read_trajectory
    from trainlog.mcap import read_log
    from trainlog.replay import ReplayOptions, run_viewer, take_picture, write_replay
    from trainlog.replay.layout import check_view
    from trainlog.replay.viewer import check_display, interruptible

    picture = output if output is not None and output.suffix == ".png" else None
    saved = output if picture is None else None
    opened = web or output is None
    if view is not None:
        check_view(view)
    if picture is not None:
        destination(picture, ".png")
        without = {"--tiles": tiles or None}
        refuse_rivals("a picture is taken without the network", without, "or save it: -o a.rrd")
    found = logs_in(logs)
    if opened and not web:
        for log in found:
            read_log(log, topics=[])  # what is no log is refused before the lack of a display
        check_display()
    if reference is not None and reference.suffix == ".json":
        if trajectory is not None and trajectory != reference:
            raise InputError(
                "two trajectories are given", remedy="leave out --reference or --trajectory"
            )
        trajectory, reference = reference, None
    number = None
    if reference is not None:
        same = [each for each, log in enumerate(found) if log.resolve() == reference.resolve()]
        found += [] if same else logs_in([reference])
        number = same[0] if same else len(found) - 1
    whole = (start, end, km) == (None, None, None)
    options = ReplayOptions(
        view=view,
        reference=number,
        thinned=thin if whole or thin is not None else False,
        tiles=tiles,
        line=None if line is None else read_line(line),
    )
    part = partial(part_of, start=start, end=end, km=km, rows=PIECE, line=options.line)
    sources = [partial(part, log) for log in found]
    say = partial(console.print, soft_wrap=True)
    with interruptible(), TemporaryDirectory(prefix="trainlog-") as folder:
        recording = Path(folder) / "replay.rrd" if saved is None else saved
        made = write_replay(
            sources,
            recording,
            trajectory=None if trajectory is None else read_trajectory(trajectory),
            condition_map=None if condition is None else read_map(condition),
            options=options,
        )
        in_words = not state(asdict(made))
        if in_words and made.references:
            say(f"compared along the line with {', '.join(made.references)}")
        if in_words and made.thinned:
            say(
                f"{counted(len(made.trips), 'trip')}, thinned: of each 10 m or 0.4 s the lowest and"
                " the highest speed; every sample with --km, --from, --to, --full, or fewer trips"
            )
        if saved is not None:
            wrote(saved)
        if picture is not None:
            with task(f"taking {picture.name}"):
                take_picture(recording, picture)
            wrote(picture)
        if opened:
            run_viewer(
                recording,
                web=web,
                tiles=tiles,
                state=say,
            )


def report(
    results: Annotated[
        str,
        typer.Argument(
            help="A log (.mcap), parameter set, map (.map), trajectory or coast-down, the folder of"
            " a study, a folder of results, as the demo leaves it, or the catalogue of a fleet (its"
            " folder or URL)."
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The page (.html); without it a folder is summed up."),
    ] = None,
    line: Annotated[
        Path | None,
        typer.Option(
            "--line", help="Line file of a map or trajectory whose line is not among the samples."
        ),
    ] = None,
    logs: Annotated[
        list[Path] | None,
        typer.Option(
            "--logs",
            help="Logs that a fit was made of, or their folder: shows the residuals. Or --trips.",
        ),
    ] = None,
    zone: Annotated[
        str, typer.Option(help="Zone of the timetable, in which times are stated: Europe/Zurich.")
    ] = "UTC",
    trips: TripsOption = None,
    catalogue: CatalogueOption = None,
    network: Annotated[
        Path | None,
        typer.Option(
            "--network",
            help="Of a fleet: network file (.network.json) on which the rail's condition is drawn.",
        ),
    ] = None,
    maps: Annotated[
        Path | None,
        typer.Option(
            "--maps", help="Of a fleet: folder of the maps of edges; default: the catalogue's."
        ),
    ] = None,
    at: AtOption = None,
) -> None:
    """Write a report as one HTML page that needs no network: to send, to read, to print.

    Tables, pictures and charts of a result with what it was made of; light or dark as the reader's
    screen, printed on A4. Of a folder everything that is in it; a file that cannot be read is
    listed there, and the exit status is 1. Without -o the summary of a folder is printed: fit, map,
    trajectory, energy; simulated trips against the truth.

    Of a fleet, from the results of 'trainlog fleet update': what the catalogue holds by line, train
    and month; running resistance of every train against its kind; trains that are not like the
    others, with the rate of false alarms; drift; the condition of the rail on the network with its
    forecast; energy by train and edge; what was refused or failed and why; and the quality of the
    recordings.

    Example: trainlog report results/trips/trip-01.mcap -o trip-01.html

    Example: trainlog report results

    Example: trainlog report catalogue --network results/fleet/network.network.json -o fleet.html
    """
    is_fleet = "://" in results or (Path(results) / "catalogue.sqlite").is_file()
    if catalogue is not None and (is_fleet or trips is None):
        raise InputError(
            f"--catalogue {catalogue} is where --trips chooses logs",
            remedy="leave it out, or choose logs with --trips \"weather = 'wet'\"",
        )
    if is_fleet:
        refuse_rivals("the report is of a fleet", {"--line": line, "--logs": logs})
        if output is None:
            raise InputError(
                "is the catalogue of a fleet, whose report is a page",
                file=results,
                remedy="name it: -o fleet.html; 'trainlog fleet show' states what it holds",
            )
        from analysis.reports.fleet import FleetReportOptions, write_fleet_report
        from trainlog.catalogue import open_catalogue
        from trainlog.formats.railway import read_network

        known = None if network is None else read_network(network)
        options = FleetReportOptions(trips, known, maps, moment(at, zone))
        destination(output, ".html")
        with open_catalogue(results, create=False) as opened, task("report on the fleet"):
            write_fleet_report(opened, output, options)
        wrote(output)
        return
    of_fleet = {"--network": network, "--maps": maps, "--at": at}
    refuse_rivals("the report is not of a fleet", of_fleet)
    folder = Path(results)
    if not folder.exists():
        remedy = "name the folder that holds the results, or a log"
        raise InputError("does not exist", file=results, remedy=remedy)
    if output is None:
        from analysis.reports.summary import report as summed_up

        if folder.is_file():
            raise InputError(
                "is a file; without -o a folder is summed up",
                file=results,
                remedy="name the page: -o report.html",
            )
        show(summed_up(folder))
        return
    destination(output, ".html")

    from analysis.reports.build import ReportOptions, write_report
    from analysis.reports.trip import known_zone

    in_zone = known_zone(zone)
    given = [*(logs or ()), *([] if trips is None else chosen_logs(trips, catalogue))]
    with task(f"report on {folder.name}"):
        page = write_report(folder, output, ReportOptions(line, tuple(given), in_zone))
    titles = [each.title for each in page.sections]
    state({"title": page.title, "sections": titles, "problems": page.problems})
    wrote(output)
    for words in page.problems:
        print_error(f"not shown: {words}")
    if page.problems:
        raise typer.Exit(1)
