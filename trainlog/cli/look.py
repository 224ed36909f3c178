"""Commands that look at trips: compare, replay, report."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

import analysis
import trainlog
from trainlog.cli.commands import end_in_part
from trainlog.cli.options import (
    Logs,
    Picture,
    chosen_logs,
    destination,
    distinct,
    logs_in,
    moment,
    named_apart,
    part_of,
    refuse_rivals,
    sections_in,
)
from trainlog.cli.terminal import console, print_error, say, show, state, wrote
from trainlog.display import counted
from trainlog.errors import InputError, TrainlogError, in_file
from trainlog.progress import task, track
from trainlog.units import SPEED

if TYPE_CHECKING:
    from trainlog.railway import ParameterSet, Train


compare_app = typer.Typer(
    add_completion=False, help="Compare trips: by position, in groups, or with calculated values."
)

WIND = replace(SPEED.between(0.0), usual="m/s", examples="5, 5m/s or 18km/h")


@compare_app.command("trips")
def compare_trips(
    logs: Logs,
    /,
    *,
    reference: Path | None = None,
    line: Path | None = None,
    model: Path | None = None,
    time_of_day: bool = False,
    picture: Picture = None,
) -> None:
    """Compare trips over a line by position; short form: 'trainlog compare LOGS'.

    Running times, lost time by cause, energy, driving; for stopping or non-stop, recorded or
    simulated trips, over any part of the line. Each direction is compared separately.

    Example: trainlog compare trips sample_logs --picture compared.png

    Parameters
    ----------
    reference : FILE
        Log, trajectory or folder of a journey's sections to compare with. Default: the fastest trip
        of each direction that covers nearly all of the common section.
    line : FILE
        Line file. Default: the line in the logs.
    model : FILE
        Parameters file with the running resistance for normalised energies. Default: the train file
        in the logs.
    time_of_day
        Count a later departure as time lost.
    picture : FILE
        Save a picture (.png), one per direction.
    """
    from analysis.charts import draw_charts
    from analysis.comparison.plot import comparison_charts

    for path in logs:
        if not path.exists():
            raise InputError("does not exist", file=path, remedy="check the path")
    against: Any = reference
    if reference is not None and reference.suffix != ".mcap":
        plans = [trainlog.read_trajectory(each) for each in sections_in([reference])]
        against = plans if len(plans) > 1 else plans[0]
    found = analysis.compare(
        logs_in(logs),
        against,
        line=None if line is None else trainlog.read_line(line),
        model=None if model is None else trainlog.read_parameters(model),
        by_time_of_day=time_of_day,
    )
    show(found)
    pictures = named_apart(picture, [each.direction for each in found.directions])
    for each, path in zip(found.directions, pictures, strict=False):
        with task(f"drawing {path.name}"):
            draw_charts(comparison_charts(each), path)
        wrote(path)


@compare_app.command("groups")
def compare_groups(logs: Logs, /, *, with_: list[Path]) -> None:
    """Compare drivers' trips with trips that followed a trajectory, configuration by configuration.

    Example: trainlog compare groups results/trips --with results/driven --with results/blind

    Parameters
    ----------
    with_ : FILE
        Logs or folder of another group of trips, such as those driven by advice; may be given
        several times.
    """
    for group in with_:
        if len(with_) > 1:
            console.print(f"with {group}")
        show(analysis.compare_groups(logs_in(logs), logs_in([group])))


@compare_app.command("calculated")
def compare_calculated(
    logs: Logs,
    /,
    *,
    model: Path,
    wind: Annotated[float | None, WIND] = None,
    picture: Picture = None,
) -> None:
    """Compare each trip with the prediction of a fit or a train file, with bands.

    Speed, time and energy, and errors of the model, per trip and for all together.

    Example: trainlog compare calculated sample_logs --model results/parameters.json

    Parameters
    ----------
    model : FILE
        Parameters or train file.
    wind : SPEED
        Standard deviation of the head wind, for the bands. Default: 1 m/s if the head wind is
        recorded, else 5 m/s.
    picture : FILE
        Save a picture (.png), one per trip.
    """
    from analysis.charts import draw
    from analysis.comparison.calculated import judged_together, together_words

    predicted, trips = _model(model), logs_in(logs)
    names = [log.stem for log in trips]
    if picture is not None:
        distinct(names, trips)
    pictures = named_apart(picture, names)
    every, calculations, failed = [], [], 0
    for number, log in enumerate(track(trips, "calculating", "trip")):
        try:
            with in_file(log):
                found = analysis.calculate(log, predicted, wind_std=wind)
        except TrainlogError as error:  # one trip that is refused says nothing of the others
            if len(trips) == 1:
                raise
            print_error(str(error))
            failed += 1
            continue
        calculations.append(found)
        every.append(found.data())
        together = judged_together(calculations)
        if not state({"trips": every, "together": together}):
            show(found)
        for path in pictures[number : number + 1]:
            draw(found, path)
            wrote(path)
    if len(calculations) > 1:
        console.print(together_words(calculations, together))
    end_in_part(failed, len(trips))


def _model(path: Path) -> ParameterSet | Train:
    """A parameters file, or a train's file."""
    from trainlog.formats.files import read_json, refuse_map

    refuse_map(path, "the parameters that 'trainlog fit' wrote, or a train's file, are expected")
    content = read_json(path) if path.suffix == ".json" else None
    of_fit = isinstance(content, dict) and content.get("format") == "trainlog/parameters"
    return trainlog.read_parameters(path) if of_fit else trainlog.read_train(path)


PIECE = 200_000
"""Rows that a replay holds at a time, over all topics."""


def replay(
    logs: Logs,
    /,
    *,
    output: Path | None = None,
    view: str | None = None,
    trajectory: Path | None = None,
    map_: Path | None = None,
    reference: Path | None = None,
    line: Path | None = None,
    from_: str | None = None,
    to: str | None = None,
    km: str | None = None,
    thin: Annotated[bool | None, typer.Option("--thin/--full")] = None,
    tiles: bool = False,
    web: bool = False,
) -> None:
    """Show trips in the Rerun viewer, by time and by position.

    The viewer runs until it is closed or Ctrl-C; it listens on this machine only and does not use
    the network.

    Example: trainlog replay results/trips/trip-01.mcap

    Example: trainlog replay results/trips -o replay.png --view map

    Parameters
    ----------
    output : FILE
        Save the recording (.rrd), or a picture of a view (.png, needs no display), instead of
        opening it.
    view : VIEW
        View shown first: overview, driving, traction, identification, map, recorder.
    trajectory : FILE
        Trajectory file to show.
    map_ : FILE
        Track-condition map to show.
    reference : FILE
        Trip (.mcap) or trajectory (.json) for the comparison by position. Default: the trajectory,
        else the first trip.
    line : FILE
        Line file, for trips without a line.
    thin
        Overview with thinned samples, or all samples. Default: thinned for more than 16 whole
        trips.
    tiles
        Map tiles; the viewer loads them from the network.
    web
        Open it in the browser, also if it is saved.
    """
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
            trainlog.read(log, topics=[])  # what is no log is refused before the lack of a display
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
    whole = (from_, to, km) == (None, None, None)
    options = trainlog.ReplayOptions(
        view=view,
        reference=number,
        thinned=thin if whole or thin is not None else False,
        tiles=tiles,
        line=None if line is None else trainlog.read_line(line),
    )
    part = partial(part_of, start=from_, end=to, km=km, rows=PIECE, line=options.line)
    sources = [partial(part, log) for log in found]
    with interruptible(), TemporaryDirectory(prefix="trainlog-") as folder:
        recording = Path(folder) / "replay.rrd" if saved is None else saved
        made = trainlog.write_replay(
            sources,
            recording,
            trajectory=None if trajectory is None else trainlog.read_trajectory(trajectory),
            condition_map=None if map_ is None else trainlog.read_map(map_),
            options=options,
        )
        in_words = not state(asdict(made))
        if in_words and made.references:
            say(f"compared along the line with {', '.join(made.references)}")
        if in_words and made.thinned:
            say(
                f"{counted(len(made.trips), 'trip')}, thinned: of each 0.4 s the lowest and the"
                " highest speed; every sample with --km, --from, --to, --full, or fewer trips"
            )
        if saved is not None:
            wrote(saved)
        if picture is not None:
            with task(f"taking {picture.name}"):
                trainlog.take_picture(recording, picture)
            wrote(picture)
        if opened:
            trainlog.run_viewer(
                recording,
                web=web,
                tiles=tiles,
                state=say,
            )


def report(
    results: str,
    /,
    *,
    output: Path | None = None,
    line: Path | None = None,
    logs: list[Path] | None = None,
    zone: str = "UTC",
    trips: str | None = None,
    catalogue: str | None = None,
    network: Path | None = None,
    maps: Path | None = None,
    at: str | None = None,
) -> None:
    """Write a report as one HTML page that needs no network.

    Tables, pictures and charts of a result with its inputs; light or dark like the screen, printed
    on A4. For a folder: all its results; unreadable files are listed, and the exit status is 1.
    Without -o the summary of a folder is printed: fit, map, trajectory, energy; simulated trips
    against the truth.

    For a fleet, from the results of 'trainlog fleet update': trips by line, train and month;
    running resistance of each train against its kind; unlike trains, with the rate of false alarms;
    drift; rail condition on the network with its forecast; energy by train and edge; refusals and
    failures with reasons; quality of the recordings.

    Example: trainlog report results/trips/trip-01.mcap -o trip-01.html

    Example: trainlog report results

    Example: trainlog report catalogue --network results/fleet/network.network.json -o fleet.html

    Parameters
    ----------
    results : RESULTS
        Log (.mcap), parameter set, map (.map), trajectory, coast-down, folder of a study, folder of
        results, or catalogue of a fleet (its folder or URL).
    output : FILE
        The page (.html); without it the command prints the summary of a folder.
    line : FILE
        Line file of a map or trajectory whose line is not among the samples.
    logs : FILE
        Logs of a fit, or their folder: adds the residuals. Or --trips.
    zone : ZONE
        Time zone of the report: Europe/Zurich.
    network : FILE
        For a fleet: network file (.network.json) for the drawing of the rail condition.
    maps : FILE
        For a fleet: folder of the maps of edges; default: the catalogue's.
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

        known = None if network is None else trainlog.read_network(network)
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
        if folder.is_file():
            raise InputError(
                "is a file; without -o a folder is summed up",
                file=results,
                remedy="name the page: -o report.html",
            )
        show(analysis.report(folder))
        return
    destination(output, ".html")

    from analysis.reports.trip import known_zone

    in_zone = known_zone(zone)
    given = [*(logs or ()), *([] if trips is None else chosen_logs(trips, catalogue))]
    with task(f"report on {folder.name}"):
        page = analysis.write_report(
            folder, output, analysis.ReportOptions(line, tuple(given), in_zone)
        )
    titles = [each.title for each in page.sections]
    state({"title": page.title, "sections": titles, "problems": page.problems})
    wrote(output)
    for words in page.problems:
        print_error(f"not shown: {words}")
    if page.problems:
        raise typer.Exit(1)
