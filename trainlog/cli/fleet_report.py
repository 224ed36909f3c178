"""The report on a fleet: fleet report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainlog.cli.fleet import TripsOption, fleet_app
from trainlog.cli.options import AtOption, CatalogueOption, ZoneOption, destination, moment
from trainlog.cli.terminal import working, wrote

app = typer.Typer()


@fleet_app.command("report")
def fleet_report(
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="The page (.html), or a folder for fleet.html in it."),
    ],
    catalogue: CatalogueOption = None,
    trips: TripsOption = None,
    network: Annotated[
        Path | None,
        typer.Option(
            "--network", help="Network file (.network.json) on which the rail's condition is drawn."
        ),
    ] = None,
    maps: Annotated[
        Path | None,
        typer.Option("--maps", help="Folder of the maps of edges; default: the catalogue's."),
    ] = None,
    at: AtOption = None,
    zone: ZoneOption = None,
) -> None:
    """Write the report on a fleet as one HTML page that needs no network.

    What the catalogue holds by line, train and month; running resistance of every train against its
    kind; trains that are not like the others, with the rate of false alarms; drift; the condition
    of the rail on the network with its forecast; energy by train and edge; what was refused or
    failed and why; and the quality of the recordings. From the results of 'trainlog fleet update'.

    Example: trainlog fleet report --network results/fleet/network.network.json -o fleet.html
    """
    when = moment(at, zone)

    from analysis.reports.fleet import FleetReportOptions, write_fleet_report
    from trainlog.catalogue import open_catalogue
    from trainlog.formats.files import made_folder
    from trainlog.formats.network import read_network

    known = None if network is None else read_network(network)
    options = FleetReportOptions(trips, known, maps, when)
    page = output if output.suffix == ".html" else made_folder(output) / "fleet.html"
    destination(page, ".html")
    with open_catalogue(catalogue, create=False) as opened, working("report on the fleet"):
        write_fleet_report(opened, page, options)
    wrote(page)
