"""Commands that look at a track-condition map: show, diff, history, export."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trainlog.cli.map import map_app
from trainlog.cli.terminal import wrote
from trainlog.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from trainlog.railway import Line, TrackConditionMap

app = typer.Typer()
"""Empty: these commands stand among those of the map."""

MapArgument = Annotated[Path, typer.Argument(help="Map file.")]
CourseOption = Annotated[
    Path | None,
    typer.Option(
        "--line",
        help="Line file, or a log that carries it: stations, the operator's kilometres,"
        " coordinates. Default: the sample line of the map's name, if there is one.",
    ),
]
LayersOption = Annotated[
    list[str] | None, typer.Option("--layer", help="Only this layer; may be given several times.")
]
AtOption = Annotated[
    str | None,
    typer.Option(
        "--at",
        help="Time of the expected condition: 2026-11-22T06:00+01:00. Default: right after the"
        " last evidence.",
    ),
]
ZoneOption = Annotated[
    str, typer.Option("--zone", help="Time zone of --at where it states none: Europe/Zurich.")
]


@map_app.command("export")
def map_export(
    condition: MapArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help=".geojson, .gpkg, .parquet, .csv, or .json in TTOBench's layout."
        ),
    ],
    line: CourseOption = None,
    layer: LayersOption = None,
    at: AtOption = None,
    zone: ZoneOption = "UTC",
) -> None:
    """Write a track-condition map for other programs, by the suffix of the file.

    GeoJSON and GeoPackage (extra gis) have the bins as lines on the earth, with spots, changes and
    stations; Parquet and CSV have the bins by chainage; JSON has the sections of one layer as
    TTOBench lays out a track. What was not observed is empty.

    Example: trainlog map export results/map.json -o results/map.geojson
    """
    from analysis.adhesion.export import export_map
    from trainlog.formats.condition import read_map

    track = read_map(condition)
    export_map(track, output, line=course(track, line), at=moment(at, zone), layers=layer)
    wrote(output)


def course(track: TrackConditionMap, given: Path | None) -> Line | None:
    """The line of a map: the one given, or the sample of that name and length; else None.

    Raises
    ------
    InputError
        If what is given is no line, or another than the map's.
    """
    from analysis.adhesion.condition_table import check_course
    from trainlog.formats.attached import line_of
    from trainlog.formats.line import read_line
    from trainlog.formats.samples import names, sample
    from trainlog.mcap import read_log

    if given is None:
        for name in names():
            if name.endswith(".line.json"):
                known = read_line(sample(name))
                if known.name == track.line and known.length == track.length:
                    return known
        return None
    if given.suffix == ".mcap":
        trip = read_log(given, topics=[])
        line = line_of(trip)
        line = line.reversed() if trip.metadata.get("direction") == "reverse" else line
    else:
        line = read_line(given)
    check_course(track, line)
    return line


def moment(at: str | None, zone: str) -> pd.Timestamp | None:
    """A time as given by ``--at`` and ``--zone``, in UTC.

    Raises
    ------
    InputError
        If it is no time, the zone is unknown, or the time is skipped or comes twice there.
    """
    if at is None:
        return None
    import pandas as pd

    from trainlog.spans import utc

    try:
        local = pd.Timestamp(at).tzinfo is None and zone != "UTC"
    except ValueError:
        local = False
    if not local:
        return utc(at)
    try:
        return utc(pd.Timestamp(at).tz_localize(zone))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"'{at}' is not one time in the zone '{zone}'",
            remedy="write it with its offset, as 2026-11-22T06:00+01:00",
        ) from error
