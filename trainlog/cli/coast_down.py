"""The command that learns running resistance from coasting."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from trainlog.cli.options import Logs
from trainlog.cli.terminal import console, destination, logs_in, progress_bar, wrote

app = typer.Typer()


@app.command("coast-down", rich_help_panel="Learn")
def coast_down(
    logs: Logs,
    output: Annotated[Path, typer.Option("--output", "-o", help="Result (JSON).")],
    line: Annotated[
        Path | None, typer.Option(help="Line file for logs that carry no line.")
    ] = None,
    gradient: Annotated[
        Literal["line", "unknown"],
        typer.Option(help="'unknown': trust no gradients; the lever shows where the train coasts."),
    ] = "line",
    picture: Annotated[
        Path | None, typer.Option(help="Picture; default: beside the output, .png.")
    ] = None,
) -> None:
    """Learn running resistance from where the train coasts; no efforts are needed.

    Finds the coasting by itself from speed, chainage and the line's gradient, and reports the
    resistance over the train's inertia, with its band. With the gradient unknown it reports what is
    left: mostly how resistance grows with speed. Recordings that do not show it are refused with
    the reason.

    Example: trainlog coast-down results/recorded -o results/coast-down.json
    """
    from analysis.resistance import coast_down as coasting
    from analysis.resistance import plot, table, unknown_gradient
    from trainlog.formats.parameters import write_coast_down

    destination(output, ".json")
    shown = destination(picture or output.with_suffix(".png"), ".png")
    with progress_bar() as progress:
        every = progress.track(logs_in(logs), description="coasting")
        if gradient == "unknown":
            result = unknown_gradient.coast_down_without_gradient(every, line)
        else:
            found = coasting.coast_down(every, line)
            result = found.result
    write_coast_down(result, output)
    if gradient == "unknown":
        plot.draw_without_gradient(result, shown)
        console.print(table.without_gradient_table(result))
    else:
        plot.draw_coast_down(found, shown)
        console.print(table.coast_down_table(found))
    wrote(output, shown)
