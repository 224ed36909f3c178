"""The command that reads logs to the last byte: check."""

from __future__ import annotations

import typer

from trainlog.cli.commands import end_in_part
from trainlog.cli.options import Logs, logs_in
from trainlog.cli.terminal import print_account, print_error, state
from trainlog.errors import LogError
from trainlog.progress import track

app = typer.Typer()


@app.command(rich_help_panel="Look")
def check(logs: Logs) -> None:
    """Read logs to the last byte, verify every checksum, and account for what is lost.

    MCAP files of other programs are checked alike. Exit status 1 if any log is damaged, which
    [bold]trainlog recover[/bold] rebuilds, or any file is no log; 2 if none is.

    Example: trainlog check results/trips
    """
    from trainlog.mcap import account_of

    found, damaged, accounts = logs_in(logs), 0, list[dict[str, object]]()
    refused = 0
    for log in track(found, "checking", "log"):
        try:
            account = account_of(log)
        except LogError as error:  # one file that is no log says nothing of the others
            print_error(str(error))
            refused += 1
            continue
        accounts.append({"log": log, "whole": account.whole, **account.details()})
        damaged += not account.whole
        if not state({"logs": accounts}):
            print_account(log, account)
    end_in_part(refused, len(found))
    if damaged:
        raise typer.Exit(1)
