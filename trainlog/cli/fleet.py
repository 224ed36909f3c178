"""Commands of a fleet: what is computed of the trips of a catalogue.

Other modules add their commands to `fleet_app`, as those of the map do to theirs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from trainlog.cli.options import CatalogueOption
from trainlog.cli.terminal import console, current, print_error, state
from trainlog.display import counted

if TYPE_CHECKING:
    from analysis.fleet.update import Problem

app = typer.Typer()
fleet_app = typer.Typer(
    no_args_is_help=True, help="A fleet: what is computed of the trips of a catalogue."
)
app.add_typer(fleet_app, name="fleet", rich_help_panel="Fleet")

TripsOption = Annotated[
    str | None,
    typer.Option(
        "--trips",
        metavar="WHERE",
        help="Only trips that this chooses: \"line = 'X' and weather = 'wet'\".",
    ),
]
AnalysesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--analysis",
        help="Only this analysis; may be given several times. Default: all of them.",
    ),
]


@fleet_app.command("update")
def fleet_update(
    catalogue: CatalogueOption = None,
    trips: TripsOption = None,
    analyses: AnalysesOption = None,
    workers: Annotated[
        int | None,
        typer.Option(min=0, help="Processes; default: one a processor. 0: this process itself."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Dask scheduler whose workers compute, such as tcp://host:8786; they must see the"
            " logs.",
        ),
    ] = None,
    mpi: Annotated[
        bool,
        typer.Option(
            "--mpi",
            help="The workers of an MPI job: mpiexec -n 3 python -m mpi4py.futures -m trainlog"
            " fleet update --mpi.",
        ),
    ] = False,
    batch: Annotated[
        int, typer.Option(min=1, help="Most trips that a worker is given at once.")
    ] = 16,
    retry: Annotated[
        bool,
        typer.Option(
            "--retry",
            help="Compute trips again that were refused, or failed, or whose file of results is"
            " damaged.",
        ),
    ] = False,
) -> None:
    """Compute what is new in the catalogue, or was made by other code; nothing else.

    Of each trip: the summary of its fit, its passport, the evidence for the track-condition map,
    times and energy by edge, and what of its recording is doubtful. Results are kept as they come:
    after an interruption, however it came, the next update goes on with the rest.

    Trips of which an analysis gives no result are listed with the reason; of more than a few those
    of one reason are counted ('trainlog fleet status --problems' lists each). Exit status 1 if one
    failed, or a log could not be read.

    Example: trainlog fleet update --workers 2
    """
    from analysis.fleet.table import problems_table, update_table
    from analysis.fleet.update import FIRST, UpdateOptions, fleet_status, gone_words, update_fleet
    from trainlog.catalogue import open_catalogue

    options = UpdateOptions(workers, scheduler, mpi, batch=batch, where=trips, retry=retry)
    seen = set[str]()

    def report(problem: Problem) -> None:
        if problem.state != "refused":
            print_error(f"{problem.path}: {problem.analysis} {problem.state}: {problem.reason}")
        seen.add(problem.key)

    with open_catalogue(catalogue, create=False) as opened:
        before = fleet_status(opened, analyses, where=trips, most=0)
        if before.pending and not current().as_json:
            gone = f"; {gone_words(before.gone)}" if before.gone else ""
            words = f"{counted(before.pending, 'trip')} to compute{gone}; {FIRST}"
            console.print(words, highlight=False, soft_wrap=True)
        current().finished = lambda: "each batch that was finished is kept; update again"
        found = update_fleet(opened, analyses, options, report)
        current().finished = None
    if not state(found.details()):
        console.print(update_table(found.counts))
        if found.problems:
            console.print(problems_table(found.problems))
        more = len(seen) - len({each.key for each in found.problems})
        if more > 0:
            console.print(f"and {counted(more, 'trip')} more: trainlog fleet status --problems")
        console.print(found.sentence, highlight=False)
    if found.unread or any(each.failed for each in found.counts.values()):
        raise typer.Exit(1)


@fleet_app.command("status")
def fleet_status(
    catalogue: CatalogueOption = None,
    trips: TripsOption = None,
    analyses: AnalysesOption = None,
    problems: Annotated[
        bool,
        typer.Option("--problems", help="List the trips that gave no result, with the reasons."),
    ] = False,
) -> None:
    """State what is computed of the trips of the catalogue, and what is pending.

    Example: trainlog fleet status --problems
    """
    from analysis.fleet.table import problems_table, status_table
    from analysis.fleet.update import fleet_status, gone_words
    from trainlog.catalogue import open_catalogue

    with open_catalogue(catalogue, create=False) as opened:
        found = fleet_status(opened, analyses, where=trips)
    if state(found.details()):
        return
    console.print(status_table(found))
    if found.gone:
        console.print(gone_words(found.gone), highlight=False, soft_wrap=True)
    if problems and found.problems:
        console.print(problems_table(found.problems, most=len(found.problems)))
