"""Commands that write logs anew: cut, merge, convert."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trainlog.cli.options import (
    FromOption,
    KilometreOption,
    ToOption,
    TopicOption,
    destination,
    line_of_log,
    source_span,
    stretch,
    times,
)
from trainlog.cli.terminal import console, state, wrote
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.progress import task

if TYPE_CHECKING:
    from trainlog.mcap.convert import Converted

app = typer.Typer()

KINDS = (
    "Ends in .mcap (a log), .mf4 (MDF 4), .parquet or .csv (folders with a file for each topic)."
)

Source = Annotated[
    Path, typer.Argument(help="Log (.mcap), MDF (.mf4), or folder of Parquet or CSV files.")
]


@app.command(rich_help_panel="Record")
def convert(
    source: Source, output: Annotated[Path, typer.Option("--output", "-o", help=KINDS)]
) -> None:
    """Turn a log into Parquet, CSV or MDF 4, and back.

    Nothing is lost either way, and logs may be larger than the memory. CSV has one file for each
    topic with units in its header; MDF needs the extra [bold]recorders[/bold]. Logs of other
    programs become Parquet or CSV, too; they are held in memory as a whole. A part of a log is
    written by [bold]cut[/bold].

    Example: trainlog convert trip.mcap -o trip.parquet

    trainlog convert trip.mcap -o trip.csv

    trainlog convert trip.csv -o again.mcap
    """
    _write(source, output)


@app.command(rich_help_panel="Record")
def cut(
    source: Source,
    output: Annotated[Path, typer.Option("--output", "-o", help=KINDS)],
    topic: TopicOption = None,
    start: FromOption = None,
    end: ToOption = None,
    km: KilometreOption = None,
) -> None:
    """Write a part of a log: of some time, between two kilometres, of some topics.

    Times are absolute or count from the log's begin or end. Metadata and attachments are those of
    the whole; the provenance states what was cut.

    Example: trainlog cut trip.mcap -o part.mcap --km 3.2:7.5

    trainlog cut trip.mcap -o last.mcap --from end-5min --topic /train/state --topic /events
    """
    if (topic or None, start, end, km) == (None, None, None, None):
        raise InputError(
            "nothing states which part is wanted", remedy="give --from, --to, --km or --topic"
        )
    _write(
        source,
        output,
        topics=topic or None,
        time=times(start, end, source_span(source)),
        position=None if km is None else stretch(km, line_of_log(source)),
    )


@app.command(rich_help_panel="Record")
def merge(
    logs: Annotated[list[Path], typer.Argument(help="Logs of one trip, two at least.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Log to write (.mcap).")],
    prefer: Annotated[
        Path | None,
        typer.Option(help="One of the logs: it counts where another has the same topic and time."),
    ] = None,
) -> None:
    """Join logs of one trip: parts that follow each other, or what several recorders wrote.

    Logs of other trains, lines or directions are refused, and so are different samples of a topic
    at the same time; [bold]--prefer[/bold] decides between them. Events of all logs are kept, and
    the provenance of all.

    Example: trainlog merge morning.mcap noon.mcap -o day.mcap

    trainlog merge recorder.mcap gnss.mcap -o trip.mcap --prefer recorder.mcap
    """
    from trainlog.mcap.merge import merge as write

    destination(output, ".mcap")
    with task("merging", unit="row") as step:
        done = write(logs, output, prefer=prefer, progress=step)
    notes = [f"{counted(count, 'row')} of {name} in two logs alike: kept once"
             for name, count in done.repeated.items() if count]  # fmt: skip
    notes += [f"{count:,} rows of {name} left out for those of {prefer}"
              for name, count in done.left_out.items() if count]  # fmt: skip
    _summary(output, done.rows, [*notes, *done.notes])


def _write(source: Path, output: Path, **part: Any) -> None:
    from trainlog.mcap.convert import convert as write

    output.parent.mkdir(parents=True, exist_ok=True)
    with task("converting", unit="row") as step:
        done: Converted = write(source, output, progress=step, **part)
    _summary(output, done.rows, [f"not converted: {reason}" for reason in done.left_out])


def _summary(output: Path, rows: Any, notes: Sequence[str]) -> None:
    if not state({"rows": dict(rows), "notes": list(notes)}):
        console.print(f"  {rows.total():,} rows in {counted(len(rows), 'topic')}", highlight=False)
        for note in notes:
            console.print(f"  {note}", highlight=False, markup=False, soft_wrap=True)
    wrote(output)
