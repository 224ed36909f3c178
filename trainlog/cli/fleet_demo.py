"""The demo of a fleet: the public commands, one after the other, as a user would type them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainlog.cli.fleet import fleet_app
from trainlog.cli.terminal import console

app = typer.Typer()

TRIPS = 100

TRAIN = "flirt-01"
"""Whose observed set is planned for."""

FAULTS = (
    "train=flirt-02,dragging-brake=6kN,from=2026-10-05",
    "train=kiss-01,wheel-diameter=1%,from=2026-10-06",
)
"""So large that five trips show them; smaller ones need more trips than the demo has."""


def commands(output: Path, trips: int = TRIPS, places: str | None = None) -> list[list[str]]:
    """The commands of the demo, without the leading ``trainlog``; results go to `output`."""
    fleet, catalogue = output / "fleet", ["--catalogue", output / "catalogue"]
    network = fleet / "network.network.json"
    parameters, trajectory = output / f"{TRAIN}.json", output / "trajectory.json"
    faults = [word for fault in FAULTS for word in ("--fault", fault)]
    size = ["--trains", 9, "--days", 10, "--count", trips]
    train = fleet / "trains" / f"{TRAIN}.train.json"
    route = f"{network}#{places or ROUTE}"
    where = ["--trips", f"train = '{TRAIN}'"]
    steps: list[list[object]] = [
        ["simulate", "--network", "drawn:4", *size, "--seed", 1, *faults, "-o", fleet],
        ["catalogue", "add", fleet, *catalogue],
        ["network", "show", network],
        ["fleet", "update", *catalogue],
        ["catalogue", "query", *catalogue, "--where", f"train = '{TRAIN}' and weather = 'wet'"],
        ["fleet", "trains", *catalogue, "-o", output / "trains"],
        ["fit", *where, *catalogue, "-o", parameters],
        ["optimise", parameters, "--line", route, "--train", train, "-o", trajectory],
        ["fleet", "report", *catalogue, "--network", network, "-o", output / "fleet.html"],
    ]
    return [[str(word) for word in step] for step in steps]


ROUTE = "Holzegg,Lindburg"
"""Places of the drawn network between which the trajectory is planned."""


def following(output: Path) -> list[str]:
    """Commands to go on with."""
    catalogue = f"--catalogue {output / 'catalogue'}"
    return [
        f"trainlog fleet diff now resistance.largest_std=0.2 {catalogue}",
        f"trainlog fleet status {catalogue} --problems",
        f"trainlog catalogue add YOUR_LOGS {catalogue}",
    ]


@fleet_app.command("demo")
def fleet_demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")] = Path(
        "results-fleet"
    ),
    count: Annotated[
        int | None, typer.Option(min=12, help="Trips that are simulated; default 100.")
    ] = None,
) -> None:
    """Simulate a fleet with two faulty trains, and find out what it shows; takes minutes.

    A hundred trips over a drawn network, registered, computed, the trains compared, one train's
    observed set planned for on a route, and the report on all of it.

    Example: trainlog fleet demo -o results-fleet
    """
    from trainlog.cli.demo import run_demo
    from trainlog.cli.main import run

    steps = commands(output, count or TRIPS)
    run_demo(output, console, lambda words: run(words), steps, following(output))
