"""Commands on networks: import, build, show, route, export."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trainlog.cli.options import CategoryOption, destination
from trainlog.cli.terminal import console, wrote
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.units import KMH

if TYPE_CHECKING:
    from trainlog.railway.network import Network

app = typer.Typer()
network_app = typer.Typer(
    no_args_is_help=True, help="Networks of lines: imported, built of lines, routes in them."
)
app.add_typer(network_app, name="network", rich_help_panel="Record")

NetworkArgument = Annotated[
    Path, typer.Argument(metavar="NET", help="Network file (.network.json).")
]


@network_app.command("import")
def network_import(
    file: Annotated[
        Path, typer.Argument(help="Infrastructure of OSRD (railjson), or of railML 2 or 3 (XML).")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Network file to write.")],
    limit: Annotated[
        float | None,
        typer.Option(
            min=1.0,
            max=600.0,
            help="Speed limit in km/h where the file states none; default: its lowest.",
        ),
    ] = None,
    category: CategoryOption = None,
) -> None:
    """Import the infrastructure of another program as a network.

    Lists what of the file the network holds in part or not at all, and what was assumed. Tracks
    that nothing connects to the others become networks of their own, numbered.

    Example: trainlog network import small_infra.json -o small.network.json
    """
    destination(output, ".json")
    from trainlog.formats.imports import networks_in
    from trainlog.formats.network import write_network

    found = networks_in(file, None, None if limit is None else limit / KMH, category)
    if found is None:
        raise InputError(
            "is neither infrastructure of OSRD nor railML",
            file=file,
            remedy="lines are joined to a network with 'trainlog network build'",
        )
    paths = []
    for number, network in enumerate(found.networks, start=1):
        path = output if len(found.networks) == 1 else _numbered(output, number)
        write_network(network, path)
        paths.append(path)
        console.print(_sentence(network), highlight=False)
    for heading, sentences in (
        ("Not taken over, or in part:", found.left_out),
        ("Assumed:", found.assumed),
    ):
        if sentences:
            console.print(heading, *(f"  {each}" for each in sentences), sep="\n", highlight=False)
    wrote(*paths)


def _numbered(path: Path, number: int) -> Path:
    """The path with a number before all that follows its first dot."""
    stem, dot, rest = path.name.partition(".")
    return path.with_name(f"{stem}-{number}{dot}{rest}")


def _sentence(network: Network) -> str:
    return (
        f"{network.name}: {counted(len(network.edges), 'edge')} of {network.length / 1e3:.3f} km,"
        f" {counted(len(network.nodes), 'node')}"
    )


@network_app.command("build")
def network_build(
    lines: Annotated[list[Path], typer.Argument(help="Line files.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Network file to write.")],
    name: Annotated[str | None, typer.Option(help="Of the network; default: the file's.")] = None,
) -> None:
    """Join lines to a network at the stations that they share.

    A line is cut where another begins, ends or passes; there trains can pass from any edge to any
    other. A track that two lines share is taken once.

    Example: trainlog network build A-B.line.json B-C.line.json -o mine.network.json
    """
    destination(output, ".json")
    from trainlog.formats.line import read_line
    from trainlog.formats.network import write_network
    from trainlog.railway.line_network import network_of_lines

    given = name or output.name.partition(".")[0]
    found = network_of_lines(given, [read_line(each) for each in lines])
    write_network(found.network, output)
    console.print(_sentence(found.network), *found.notes, sep="\n", highlight=False)
    wrote(output)


@network_app.command("show")
def network_show(
    network: NetworkArgument,
    picture: Annotated[Path | None, typer.Option(help="Draw the network here as well.")] = None,
) -> None:
    """Show a network: its edges with climbs and limits, its nodes, and what is not known.

    Example: trainlog network show small.network.json --picture small.png
    """
    if picture is not None:
        destination(picture, ".png")
    from analysis.network.table import network_tables
    from trainlog.formats.network import read_network

    found = read_network(network)
    console.print(network_tables(found))
    if picture is not None:
        from analysis.network.plot import draw_network

        draw_network(found, picture)
        wrote(picture)


@network_app.command("route")
def network_route(
    network: NetworkArgument,
    places: Annotated[
        list[str], typer.Argument(help="Stations, nodes, or edge@km, in the order of travel.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Line file of the route.")
    ] = None,
) -> None:
    """Find the shortest route through places, and write its line.

    Other commands take the route without a file, too: --line "NET#A,B,C".

    Example: trainlog network route small.network.json West_station South_station -o route.line.json
    """
    if output is not None:
        destination(output, ".json")
    from analysis.network.table import route_tables
    from trainlog.formats.line import write_line
    from trainlog.formats.network import read_network

    route = read_network(network).route(*places)
    console.print(route_tables(route))
    if output is not None:
        write_line(route.line, output)
        wrote(output)


@network_app.command("export")
def network_export(
    network: NetworkArgument,
    output: Annotated[Path, typer.Option("--output", "-o", help="GeoJSON file (.geojson).")],
) -> None:
    """Write a network for geographic programs: edges as lines, nodes and stations as points.

    Example: trainlog network export small.network.json -o small.geojson
    """
    from analysis.network.export import export_network
    from trainlog.formats.network import read_network

    found = export_network(read_network(network), output)
    console.print(
        f"{counted(found.edges, 'edge')}, {counted(found.nodes, 'node')},"
        f" {counted(found.stations, 'station')}",
        highlight=False,
    )
    if found.left_out:
        console.print(f"left out without coordinates: {', '.join(found.left_out)}", highlight=False)
    wrote(output)
