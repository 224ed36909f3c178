"""The command that shows what a fleet knows of its trains."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainlog.cli.fleet import TripsOption, fleet_app
from trainlog.cli.options import CatalogueOption
from trainlog.cli.terminal import console, wrote
from trainlog.errors import InputError
from trainlog.formats.files import atomic_write, output_folder

app = typer.Typer()


@fleet_app.command("trains")
def trains(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for JSON and pictures.")],
    catalogue: CatalogueOption = None,
    kind: Annotated[
        str | None, typer.Option(metavar="NAME", help="Only trains of this kind.")
    ] = None,
    train: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Show only this train, compared with the others."),
    ] = None,
    trips: TripsOption = None,
    false_alarms: Annotated[
        float,
        typer.Option(
            metavar="PERCENT", help="Share (%) of healthy trains that raise an alarm in a month."
        ),
    ] = 1.0,
) -> None:
    """Show resistance, drift and findings of every train: which ones are not like the others.

    From the results of 'trainlog fleet update'. Each finding names the fault, since when and how
    large, with its band; what would not be seen is stated by train.

    Example: trainlog fleet trains -o results/fleet-trains
    """
    import json

    from analysis.fleet.plot import (
        channels_over_time,
        draw_drift,
        draw_findings,
        draw_resistance,
    )
    from analysis.fleet.trains import trains_in
    from analysis.fleet.trains_table import trains_data, trains_table
    from trainlog.catalogue import open_catalogue

    if not 0.0 < false_alarms <= 20.0:
        raise InputError(
            f"--false-alarms {false_alarms:g} must be above 0 and at most 20",
            remedy="give a share in %, such as 1",
        )
    with open_catalogue(catalogue) as known:
        found = trains_in(known, kind=kind, where=trips, rate=false_alarms / 100.0)
    shown = found if train is None else found.only(train)
    written = []
    with output_folder(output):
        path = output / "trains.json"
        with atomic_write(path) as temporary:
            content = json.dumps(trains_data(shown), indent=1, ensure_ascii=False)
            temporary.write_text(content + "\n", "utf-8")
        written.append(path)
        for each in shown.resistance:
            written.append(output / f"{each.kind}.resistance.png")
            draw_resistance(each, shown, written[-1])
            if channels_over_time(each.kind, shown):
                written.append(output / f"{each.kind}.drift.png")
                draw_drift(each.kind, shown, written[-1])
        written.append(output / "findings.png")
        draw_findings(shown, written[-1])
    console.print(trains_table(shown))
    wrote(*written)
