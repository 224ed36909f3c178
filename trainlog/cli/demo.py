"""The demos: the public commands, one after the other, as a user would type them."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from trainlog.cli.terminal import console as terminal, current
from trainlog.errors import InputError
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN


def demo(
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Folder for the results; default: as set, else results."
        ),
    ] = None,
    fleet: Annotated[
        bool,
        typer.Option(
            "--fleet",
            help="The demo of a fleet instead: a hundred trips over a drawn network with two faulty"
            " trains, registered, computed, the trains compared, one train's observed set planned"
            " for on a route, and the report on all of it; takes minutes.",
        ),
    ] = False,
    count: Annotated[
        int | None, typer.Option(min=12, help="With --fleet: trips simulated; default 100.")
    ] = None,
) -> None:
    """Run the whole chain on St.Gallen-Wil: record, fit, map, plan, replay.

    Example: trainlog demo -o results

    Example: trainlog demo --fleet -o results-fleet
    """
    from trainlog.cli.main import run
    from trainlog.formats.settings import read_settings

    if count is not None and not fleet:
        raise InputError("--count is that of the fleet's trips", remedy="give --fleet, too")
    folder = output or Path(read_settings().results).expanduser()
    if not fleet:
        run_demo(folder, terminal, lambda words: run(words))
        return
    steps = fleet_commands(folder, count or TRIPS)
    run_demo(folder, terminal, lambda words: run(words), steps, fleet_following(folder))


MARKER = ".trainlog-demo"
"""File by which the demo recognises a folder of its own results."""


def commands(output: Path) -> list[list[str]]:
    """The commands of the demo, without the leading ``trainlog``; results go to `output`."""
    samples, trips, recorded = output / "sample_logs", output / "trips", output / "recorded"
    driven, blind = output / "driven", output / "driven-blind"
    parameters, condition = output / "parameters.json", output / "wil.map"
    trajectory = output / "trajectory.json"
    known: list[str | Path] = ["--line", samples / DEFAULT_LINE, "--train", samples / DEFAULT_TRAIN]
    facts = ["--set", "weather=dry", "--set", "load=24000"]
    profile: list[str | Path] = ["--profile", samples / "recorder.profile.toml"]
    rail: list[str | Path] = ["--map", condition, "--layer", "wet"]
    every = ["--configurations", "all"]
    known_rail: list[str | Path] = ["--map", condition]
    plan: list[str | Path] = ["--trajectory", trajectory]
    wet = ["--weather", "wet"]
    steps: list[list[str | Path]] = [
        ["new", "samples", "-o", samples],
        ["simulate", "drive", *known, "--count", "12", "--seed", "1", "-o", trips],
        ["ingest", samples / "recorder.csv", *profile, *known, *facts, "-o", recorded],
        ["ingest", samples / "gnss.csv", *known, "-o", recorded],
        ["show", recorded / "recorder.mcap"],
        ["fit", recorded / "recorder.mcap", "-o", recorded / "parameters.json"],
        ["map", "update", recorded / "recorder.mcap", "--map", recorded / "wil.map"],
        ["replay", recorded, "-o", recorded / "replay.rrd"],
        ["fit", trips, "-o", parameters],
        ["map", "update", trips, "--map", condition],
        ["map", "show", condition, "--picture", output / "wil.png"],
        ["plan", parameters, *known, *rail, "--running-time", trips, "-o", trajectory],
        ["simulate", "follow", trajectory, *known, *known_rail, *every, *wet, "-o", driven],
        ["simulate", "follow", trajectory, *known, *every, *wet, "-o", blind],
        ["compare", trips, "--with", driven, "--with", blind],
        ["estimate", trips / "trip-03.mcap", "-o", output / "estimated"],
        ["replay", output / "estimated", driven, *plan, *known_rail, "-o", output / "replay.rrd"],
        ["report", output],
    ]
    return [[str(word) for word in step] for step in steps]


def _clear(output: Path) -> None:
    """Empty the folder of results: earlier ones of the demo go, a folder of other files stays."""
    marker = output / MARKER
    if output.exists() and not output.is_dir():
        raise InputError("is a file", file=output, remedy="name a folder with --output")
    if output.exists() and not marker.exists() and any(output.iterdir()):
        raise InputError(
            "holds files that are not the demo's",
            file=output,
            remedy="name a new folder with --output",
        )
    if output.exists():
        shutil.rmtree(output)
    output.mkdir(parents=True)
    marker.write_text("Results of 'trainlog demo'; the next demo replaces this folder.\n", "utf-8")


def following(output: Path) -> list[str]:
    """Commands to go on with."""
    return [
        f"trainlog replay {output / 'trips'} -o {output / 'all.rrd'}",
        f"trainlog plan {output / 'parameters.json'} --line sample --train sample --reserve 5"
        f" -o {output / 'faster.json'}",
        f"trainlog ingest YOUR.csv --profile {output / 'sample_logs' / 'recorder.profile.toml'}"
        f" -o {output / 'recorded'}",
    ]


TRIPS = 100

TRAIN = "flirt-01"
"""Whose observed set is planned for."""

FAULTS = (
    "train=flirt-02,dragging-brake=6kN,from=2026-10-05",
    "train=kiss-01,wheel-diameter=1%,from=2026-10-06",
)
"""So large that five trips show them; smaller ones need more trips than the demo has."""


def fleet_commands(output: Path, trips: int = TRIPS, places: str | None = None) -> list[list[str]]:
    """The commands of the demo of a fleet, likewise."""
    fleet, catalogue = output / "fleet", ["--catalogue", output / "catalogue"]
    network = fleet / "network.network.json"
    parameters, trajectory = output / f"{TRAIN}.json", output / "trajectory.json"
    faults = [word for fault in FAULTS for word in ("--fault", fault)]
    size = ["--trains", 9, "--days", 10, "--count", trips]
    train = fleet / "trains" / f"{TRAIN}.train.json"
    route = f"{network}#{places or ROUTE}"
    where = ["--trips", f"train = '{TRAIN}'"]
    steps: list[list[object]] = [
        ["simulate", "fleet", "drawn:4", *size, "--seed", 1, *faults, "-o", fleet],
        ["fleet", "add", fleet, *catalogue],
        ["show", network],
        ["fleet", "update", *catalogue],
        ["fleet", "query", f"train = '{TRAIN}' and weather = 'wet'", *catalogue],
        ["fleet", "trains", *catalogue, "-o", output / "trains"],
        ["fit", *where, *catalogue, "-o", parameters],
        ["plan", parameters, "--line", route, "--train", train, "-o", trajectory],
        ["report", output / "catalogue", "--network", network, "-o", output / "fleet.html"],
    ]
    return [[str(word) for word in step] for step in steps]


ROUTE = "Holzegg,Lindburg"
"""Places of the drawn network between which the trajectory is planned."""


def fleet_following(output: Path) -> list[str]:
    """Commands to go on with."""
    catalogue = f"--catalogue {output / 'catalogue'}"
    return [
        f"trainlog fleet diff now resistance.largest_std=0.2 {catalogue}",
        f"trainlog fleet show {catalogue} --problems",
        f"trainlog fleet add YOUR_LOGS {catalogue}",
    ]


def run_demo(
    output: Path,
    console: Console,
    run: Callable[[list[str]], int],
    steps: Sequence[list[str]] | None = None,
    then: Sequence[str] | None = None,
) -> None:
    """Run the whole chain and say where the results are.

    Parameters
    ----------
    output : path
        Folder of the results; earlier results of the demo in it are replaced.
    console : rich Console
    run : callable
        Runs one command, given as a list of arguments, and returns its exit status.
    steps, then : sequences, optional
        Of another demo: its commands, and those to go on with.

    Raises
    ------
    InputError
        If the folder holds files that are not the demo's.
    typer.Exit
        If a command ended with another status than 0, such as that of Ctrl-C.
    """
    begin = perf_counter()
    _clear(output)
    steps = commands(output) if steps is None else steps
    for number, step in enumerate(steps, start=1):
        passed = f"{number} of {len(steps)}, {perf_counter() - begin:.0f} s"
        console.rule(Text(passed, style="dim"), align="left")
        shown = Text(f"$ trainlog {shlex.join(step)}", style="bold")
        console.print(shown, soft_wrap=True)
        current().place = f"step {number} of {len(steps)} of the demo"
        if status := run(step):
            raise typer.Exit(status)
    console.rule(Text(f"done in {perf_counter() - begin:.0f} s", style="dim"), align="left")
    console.print(f"Everything is in {output}. Next, try:")
    for command in following(output) if then is None else then:
        console.print(f"  {command}", soft_wrap=True)
