"""The command that opens the documentation: docs."""

from __future__ import annotations

from typing import Annotated

import typer

from trainlog.cli.terminal import console, state

app = typer.Typer()


@app.command(rich_help_panel="Start here")
def docs(
    page: Annotated[
        str | None,
        typer.Argument(
            help="Page, such as replay or tutorials/planner, or a public name, such as"
            " analysis.fit; default: the first page."
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--list", help="List all pages.")] = False,
    path: Annotated[bool, typer.Option("--path", help="Print where it is; open nothing.")] = False,
) -> None:
    """Open the documentation in the browser; it needs no network.

    Where there is no display, its place is printed.

    Example: trainlog docs tutorials/engineer
    """
    import webbrowser

    from trainlog.documentation import REMEDY, documentation
    from trainlog.replay.viewer import has_display

    found = documentation()
    if every:
        from trainlog.presentation import new_table

        table = new_table("Pages", "page", "title")
        for row in found.titles():
            table.add_row(*row)
        console.print(table)
        return
    file, anchor = found.place(page)
    uri = file.as_uri() + (f"#{anchor}" if anchor else "")
    if state({"page": file, "uri": uri, "built": found.built}):
        return
    if path or not (found.built and has_display() and webbrowser.open(uri)):
        console.print(uri if anchor else file, highlight=False, soft_wrap=True)
    if not found.built:
        console.print(f"  {REMEDY}", highlight=False, soft_wrap=True)
