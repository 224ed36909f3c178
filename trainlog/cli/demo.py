"""The demos: the public commands, one after the other, as a user would type them."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from trainlog.cli.terminal import console as terminal, current
from trainlog.errors import InputError
from trainlog.units import COUNT


def demo(
    *,
    output: Path | None = None,
    fleet: bool = False,
    count: Annotated[int | None, COUNT.between(12.0)] = None,
) -> None:
    """Run the whole chain on St.Gallen-Wil: record, fit, map, plan, replay.

    Example: trainlog demo -o results

    Example: trainlog demo --fleet -o results-fleet

    Parameters
    ----------
    output : FOLDER
        Folder for the results; default: as set, else results.
    fleet
        Demo of a fleet instead: a hundred trips over a drawn network, two trains with faults,
        comparison of the trains, a plan for one train, a report; takes minutes.
    count : N
        With --fleet: number of trips; default 100.
    """
    from trainlog.cli.main import run
    from trainlog.formats.settings import read_settings

    if count is not None and not fleet:
        raise InputError("--count is that of the fleet's trips", remedy="give --fleet, too")
    folder = output or Path(read_settings().results).expanduser()
    steps = fleet_commands(folder, count or 100) if fleet else commands(folder)
    run_demo(folder, terminal, lambda words: run(words), steps, FLEET_THEN if fleet else THEN)


MARKER = ".trainlog-demo"
"""File by which the demo recognises a folder of its own results."""


CHAIN = """
new samples -o OUT/sample_logs
simulate drive KNOWN --count 12 --seed 1 -o OUT/trips
ingest OUT/sample_logs/recorder.csv --profile OUT/sample_logs/recorder.profile.toml KNOWN
    --set weather=dry --set load=24000 -o OUT/recorded
ingest OUT/sample_logs/gnss.csv KNOWN -o OUT/recorded
show OUT/recorded/recorder.mcap
fit OUT/recorded/recorder.mcap -o OUT/recorded/parameters.json
map update OUT/recorded/recorder.mcap --map OUT/recorded/wil.map
replay OUT/recorded -o OUT/recorded/replay.rrd
fit OUT/trips -o OUT/parameters.json
map update OUT/trips --map OUT/wil.map
map show OUT/wil.map --picture OUT/wil.png
plan OUT/parameters.json KNOWN --map OUT/wil.map --layer wet --running-time OUT/trips
    -o OUT/trajectory.json
simulate follow OUT/trajectory.json KNOWN --map OUT/wil.map --configurations all --weather wet
    -o OUT/driven
simulate follow OUT/trajectory.json KNOWN --configurations all --weather wet -o OUT/driven-blind
compare groups OUT/trips --with OUT/driven --with OUT/driven-blind
estimate OUT/trips/trip-03.mcap -o OUT/estimated
replay OUT/estimated OUT/driven --trajectory OUT/trajectory.json --map OUT/wil.map
    -o OUT/replay.rrd
report OUT
"""
"""The commands of the demo; results go to OUT, and KNOWN are the line and the train."""

THEN = """
replay OUT/trips -o OUT/all.rrd
plan OUT/parameters.json --line sample --train sample --reserve 5 -o OUT/faster.json
ingest YOUR.csv --profile OUT/sample_logs/recorder.profile.toml -o OUT/recorded
"""
"""Commands to go on with."""

FLEET = """
simulate fleet drawn:4 --trains 9 --days 10 --count COUNT --seed 1
    --fault train=flirt-02,dragging-brake=6kN,from=2026-10-05
    --fault train=kiss-01,wheel-diameter=1%,from=2026-10-06 -o OUT/fleet
fleet add OUT/fleet --catalogue OUT/catalogue
show OUT/fleet/network.network.json
fleet update --catalogue OUT/catalogue
fleet query "train = 'flirt-01' and weather = 'wet'" --catalogue OUT/catalogue
fleet trains --catalogue OUT/catalogue -o OUT/trains
fit --trips "train = 'flirt-01'" --catalogue OUT/catalogue -o OUT/flirt-01.json
plan OUT/flirt-01.json --line OUT/fleet/network.network.json#Holzegg,Lindburg
    --train OUT/fleet/trains/flirt-01.train.json -o OUT/trajectory.json
report OUT/catalogue --network OUT/fleet/network.network.json -o OUT/fleet.html
"""
"""The same of a fleet; the faults are so large that five trips show them."""

FLEET_THEN = """
fleet diff now resistance.largest_std=0.2 --catalogue OUT/catalogue
fleet show --catalogue OUT/catalogue --problems
fleet add YOUR_LOGS --catalogue OUT/catalogue
"""


def commands(output: Path) -> list[list[str]]:
    """The commands of the demo, without the leading ``trainlog``; results go to `output`."""
    from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN

    known = f"--line OUT/sample_logs/{DEFAULT_LINE} --train OUT/sample_logs/{DEFAULT_TRAIN}"
    return _steps(CHAIN.replace("KNOWN", known), output)


def fleet_commands(output: Path, trips: int = 100) -> list[list[str]]:
    """The commands of the demo of a fleet, likewise."""
    return _steps(FLEET.replace("COUNT", str(trips)), output)


def _steps(text: str, output: Path) -> list[list[str]]:
    """Commands as lists of words; a line that begins with spaces goes on with the one before."""
    lines = re.sub(r"\n +", " ", text).strip().splitlines()
    return [[word.replace("OUT", str(output)) for word in shlex.split(line)] for line in lines]


def _clear(output: Path) -> None:
    """Empty the folder of results: earlier ones of the demo go, a folder of other files stays."""
    marker = output / MARKER
    if output.exists() and not output.is_dir():
        raise InputError("is a file", file=output, remedy="name a folder with --output")
    if output.exists() and not marker.exists() and any(output.iterdir()):
        raise InputError(
            "holds files that are not the demo's",
            file=output,
            remedy="name a new folder with --output",
        )
    if output.exists():
        shutil.rmtree(output)
    output.mkdir(parents=True)
    marker.write_text("Results of 'trainlog demo'; the next demo replaces this folder.\n", "utf-8")


def run_demo(
    output: Path,
    console: Console,
    run: Callable[[list[str]], int],
    steps: Sequence[list[str]] | None = None,
    then: str = THEN,
) -> None:
    """Run the whole chain and say where the results are.

    Parameters
    ----------
    output : path
        Folder of the results; earlier results of the demo in it are replaced.
    console : rich Console
    run : callable
        Runs one command, given as a list of arguments, and returns its exit status.
    steps, then : sequences, optional
        Of another demo: its commands, and those to go on with.

    Raises
    ------
    InputError
        If the folder holds files that are not the demo's.
    typer.Exit
        If a command ended with another status than 0, such as that of Ctrl-C.
    """
    begin = perf_counter()
    _clear(output)
    steps = commands(output) if steps is None else steps
    for number, step in enumerate(steps, start=1):
        passed = f"{number} of {len(steps)}, {perf_counter() - begin:.0f} s"
        console.rule(Text(passed, style="dim"), align="left")
        shown = Text(f"$ trainlog {shlex.join(step)}", style="bold")
        console.print(shown, soft_wrap=True)
        current().place = f"step {number} of {len(steps)} of the demo"
        if status := run(step):
            raise typer.Exit(status)
    console.rule(Text(f"done in {perf_counter() - begin:.0f} s", style="dim"), align="left")
    console.print(f"Everything is in {output}. Next, try:")
    for command in then.strip().splitlines():
        console.print(f"  trainlog {command.replace('OUT', str(output))}", soft_wrap=True)
