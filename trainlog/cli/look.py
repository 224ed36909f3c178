"""The command that reads logs to the last byte: check."""

from __future__ import annotations

import typer

from trainlog.cli.options import Logs, logs_in
from trainlog.cli.terminal import print_account, print_error, state
from trainlog.errors import LogError
from trainlog.progress import track

app = typer.Typer()


@app.command(rich_help_panel="Look")
def check(logs: Logs) -> None:
    """Read logs to the last byte, verify every checksum, and account for what is lost.

    MCAP files of other programs are checked alike. Exit status 1 if any log is damaged;
    [bold]trainlog recover[/bold] rebuilds it. 2 if any file is no log at all.

    Example: trainlog check results/trips
    """
    from trainlog.mcap import account_of

    status, accounts = 0, []
    for log in track(logs_in(logs), "checking", "log"):
        try:
            account = account_of(log)
        except LogError as error:  # one file that is no log says nothing of the others
            print_error(str(error))
            status = 2
            continue
        accounts.append({"log": log, "whole": account.whole, **account.details()})
        status = max(status, 0 if account.whole else 1)
        if not state({"logs": accounts}):
            print_account(log, account)
    if status:
        raise typer.Exit(status)
