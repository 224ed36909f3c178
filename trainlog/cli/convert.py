"""Commands that write logs anew: convert."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainlog.cli.options import (
    FromOption,
    KilometreOption,
    ToOption,
    TopicOption,
    source_span,
    stretch,
    times,
)
from trainlog.cli.terminal import console, wrote
from trainlog.progress import task

app = typer.Typer()


@app.command(rich_help_panel="Record")
def convert(
    source: Annotated[Path, typer.Argument(help="Log (.mcap), or folder of Parquet files.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Ends in .parquet (a folder) or .mcap (a log).")
    ],
    topic: TopicOption = None,
    start: FromOption = None,
    end: ToOption = None,
    km: KilometreOption = None,
) -> None:
    """Turn a log into Parquet for repeated analysis, and back; or cut a part out of it.

    Nothing is lost either way. Logs may be larger than the memory. Logs of other programs become
    Parquet, too; they are held in memory as a whole.

    One Parquet file a topic, and the log again:

    trainlog convert trip.mcap -o trip.parquet

    trainlog convert trip.parquet -o again.mcap

    The part between km 3.2 and 7.5, and two topics of the last five minutes, as logs:

    trainlog convert trip.mcap -o part.mcap --km 3.2:7.5

    trainlog convert trip.mcap -o last.mcap --from end-5min --topic /train/state --topic /events
    """
    from trainlog.mcap.convert import convert as write

    time = times(start, end, source_span(source))
    with task("converting", unit="row") as step:
        done = write(
            source,
            output,
            topics=topic or None,
            time=time,
            position=stretch(km),
            progress=step,
        )
    console.print(f"  {done.rows.total():,} rows in {len(done.rows)} topics", highlight=False)
    for reason in done.left_out:
        console.print(f"  not converted: {reason}", highlight=False, markup=False)
    wrote(output)
