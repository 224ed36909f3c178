"""The command line: one command a verb; the work is done by the packages below.

The commands stand in `trainlog.cli`; here are the program around them and its exit status.
"""

from __future__ import annotations

import re
import sys
import warnings
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from typer.exceptions import TyperException

from trainlog import __version__
from trainlog.cli.commands import INTERRUPTED, Words
from trainlog.cli.options import FOLDERS
from trainlog.cli.terminal import console, print_error, print_problems, print_warning
from trainlog.errors import TrainlogError
from trainlog.extras import naming_missing

app = typer.Typer(
    cls=Words,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(show: bool) -> None:
    if show:
        console.print(f"trainlog {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Record train trips in a standard log, learn from them, and plan robust trajectories.

    [bold]trainlog demo[/bold] runs the whole chain. With your own logs: [bold]ingest[/bold] them,
    [bold]fit[/bold] the running resistance, [bold]map update[/bold] the track condition,
    [bold]plan[/bold] the trajectory, [bold]replay[/bold] the trips.
    """


# --------------------------------------------------------------------------------- entry point


def run(arguments: list[str]) -> int:
    """Run one command in this process and return its exit status; errors are raised."""
    command = typer.main.get_command(app)
    with ExitStack() as folders:
        # Of this command: one that runs another, as the demo does, keeps its own.
        own = FOLDERS.set(folders)
        folders.callback(FOLDERS.reset, own)
        status: int = command.main(arguments, prog_name="trainlog", standalone_mode=False) or 0
    return status


def main() -> None:
    """Entry point of the ``trainlog`` command.

    Exit status 0: done; 1: done in part, or something was found; 2: nothing was done, the input or
    the command cannot be used; 130: interrupted. The table stands in ``docs/command-line.md``.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = _Once()
            with naming_missing():
                status = run(sys.argv[1:])
    except TrainlogError as error:
        status = _complain(error)
    except TyperException as error:
        problem, _, remedy = _explained(error).partition("; ")
        status = _complain(TrainlogError(problem, remedy=remedy or None))
    except OSError as error:
        # The packages below turn the errors they expect into TrainlogError; this is a full disk, a
        # lost drive, a forbidden folder met elsewhere.
        place = error.filename or "file"
        status = _complain(TrainlogError(str(error.strerror or error), file=place))
    except (KeyboardInterrupt, typer.Abort):
        print_error("interrupted: nothing was written")
        status = INTERRUPTED
    sys.exit(status)


def _explained(error: TyperException) -> str:
    """What is wrong with a command, an example of it, and where its help is."""
    message = error.format_message() if hasattr(error, "format_message") else str(error)
    message = message.rstrip(".")
    context = getattr(error, "ctx", None)
    if context is None:
        return f"{message}; see 'trainlog --help'"
    example = ""
    if message.startswith("Missing"):
        found = re.search(r"^Example: (trainlog .+)$", context.command.help or "", re.MULTILINE)
        example = f"; for example: {found[1]}" if found else ""
    return f"{message}{example}; see '{context.command_path} --help'"


def _complain(error: TrainlogError) -> int:
    """State an error, as an object where the command was asked for one; the exit status."""
    print_problems(error, as_json="--json" in sys.argv[1:])
    return 2


class _Once:
    """Shows each warning of a command in one yellow line, once; a damaged log once a file.

    The filter "once" of `warnings` forgets what it has shown whenever a library changes filters,
    and the account of a damaged log depends on which of its topics are read.
    """

    def __init__(self) -> None:
        self._shown: set[str] = set()

    def __call__(self, message: Warning | str, *_: object, **__: object) -> None:
        file = getattr(message, "file", None)
        known = str(message) if file is None else str(Path(file).resolve())
        if known not in self._shown:
            self._shown.add(known)
            print_warning(str(message))
