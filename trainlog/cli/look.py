"""Commands that look at trips: compare, replay, report."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

import analysis
import trainlog
from trainlog.cli.options import (
    Logs,
    Picture,
    chosen_logs,
    destination,
    logs_in,
    moment,
    named_apart,
    part_of,
    refuse_rivals,
)
from trainlog.cli.terminal import console, print_error, say, show, state, wrote
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.progress import task, track
from trainlog.units import SPEED

if TYPE_CHECKING:
    from trainlog.railway import ParameterSet, Train


compare_app = typer.Typer(
    add_completion=False, help="Compare trips: by position, in groups, or with what is calculated."
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
    """Compare trips over a line by position; 'trainlog compare LOGS' does so, too.

    Times, where time was lost and why, energy, driving; stopping or not, recorded or simulated,
    over any part of the line; directions are kept apart.

    Example: trainlog compare trips sample_logs --picture compared.png

    Parameters
    ----------
    reference : FILE
        Log or trajectory to compare with. Default: the fastest trip of each direction that covers
        nearly all of the others' part of the line.
    line : FILE
        Line file. Default: the line in the logs.
    model : FILE
        Parameters file by whose running resistance energies are normalised. Default: the train's
        file in the logs.
    time_of_day
        Count a later departure as time lost.
    picture : FILE
        Save a picture (.png), one a direction.
    """
    from analysis.charts import draw_charts
    from analysis.comparison.plot import comparison_charts

    for path in logs:
        if not path.exists():
            raise InputError("does not exist", file=path, remedy="check the path")
    planned = reference is not None and not (reference.suffix == ".mcap" or reference.is_dir())
    found = analysis.compare(
        logs_in(logs),
        trainlog.read_trajectory(reference) if planned and reference else reference,
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
        Logs or folder of another group of trips, as of those driven by advice; several.
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
    """Compare each trip with what a fit or a train's file predicts for it, with bands.

    Speed, time and energy, and what of the model is wrong, by each trip and by all together.

    Example: trainlog compare calculated sample_logs --model results/parameters.json

    Parameters
    ----------
    model : FILE
        Parameters or train file.
    wind : SPEED
        Standard deviation of the head wind that calculated bands assume, as for a known calm day.
        Default: 1 m/s where the head wind is recorded, else 5 m/s.
    picture : FILE
        Save a picture (.png), one a trip.
    """
    from analysis.charts import draw
    from analysis.comparison.calculated import judged_together, together_words

    predicted, trips = _model(model), logs_in(logs)
    pictures = named_apart(picture, [log.stem for log in trips])
    every, calculations = [], []
    for number, log in enumerate(track(trips, "calculating", "trip")):
        found = analysis.calculate(log, predicted, wind_std=wind)
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
    """Show trips in the Rerun viewer, by time and by position; or a part of them.

    The viewer runs until it is closed, or Ctrl-C ends it; it listens on this machine alone and
    asks for nothing on the network.

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
        Trip (.mcap) or trajectory (.json) with which the trips are compared along the line.
        Default: the trajectory, else the first trip.
    line : FILE
        Line file, for trips that carry no line.
    thin
        Only the overview, its samples thinned, or all. Default: thinned if there are more than 16
        trips and no part of them is asked for.
    tiles
        Map tiles, which the viewer asks the network for.
    web
        Open it in the browser, saved or not.
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

    Parameters
    ----------
    results : RESULTS
        A log (.mcap), parameter set, map (.map), trajectory or coast-down, the folder of a study, a
        folder of results, as the demo leaves it, or the catalogue of a fleet (its folder or URL).
    output : FILE
        The page (.html); without it a folder is summed up.
    line : FILE
        Line file of a map or trajectory whose line is not among the samples.
    logs : FILE
        Logs that a fit was made of, or their folder: shows the residuals. Or --trips.
    zone : ZONE
        Zone of the timetable, in which times are stated: Europe/Zurich.
    network : FILE
        Of a fleet: network file (.network.json) on which the rail's condition is drawn.
    maps : FILE
        Of a fleet: folder of the maps of edges; default: the catalogue's.
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
