"""The command that turns recordings into trips, and the profiles that it proposes."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import trainlog
from trainlog.cli.options import line_or_network, pairs
from trainlog.cli.terminal import (
    about,
    console,
    current,
    paused,
    print_error,
    say,
    show,
    state,
    wrote,
)
from trainlog.errors import InputError

if TYPE_CHECKING:
    from trainlog.ingest import Ingested, Proposal
    from trainlog.railway.line import Line
    from trainlog.railway.train import Train


def ingest(
    recordings: list[Path],
    /,
    *,
    output: Path,
    profile: Path | None = None,
    format: str | None = None,
    line: Path | None = None,
    network: Path | None = None,
    stations: str | None = None,
    train: Path | None = None,
    reverse: bool = False,
    set_: list[str] | None = None,
    accept: Annotated[bool, typer.Option("--accept", "--yes")] = False,
) -> None:
    """Turn recorded logs into trips; what was repaired is counted and kept in the log.

    A log is named after its file or, where the file holds several recordings, after its trip. Of
    several files, or a folder, every one is tried; the end is a table of what became of each. What
    was made before of the same content in the same way is not made again.

    For a table that no profile fits one is proposed: a commented TOML file in the output folder,
    to be read, corrected and given with [bold]--profile[/bold], or used at once with
    [bold]--accept[/bold].

    On a [bold]--network[/bold] each recording is matched to its route, and cut where the train
    turned back or left the network; a route that the fixes do not determine is refused.

    Exit status 0: every recording became a trip; 1: some did not, or a profile is proposed; 2: the
    only file given did not, or something else that was given cannot be used.

    Example: trainlog ingest recorder.csv --profile recorder.profile.toml -o results/recorded

    Parameters
    ----------
    recordings : RECORDINGS
        Recorded files, and folders of them: docs/ingest.md lists formats.
    output : FOLDER
        Folder for the logs.
    profile : FILE
        TOML profile: columns, units, signs, time format.
    format : FORMAT
        Name of the format, such as csv; default: detected.
    line : FILE
        Line it was driven on, if known; or a network, as --network.
    network : FILE
        Network it was driven on: the route is found in it by the fixes.
    stations : STATIONS
        With --network: stations of the route with commas between them, or edge@km.
    train : FILE
        Train that drove, if known.
    reverse
        The trip ran against the line's chainage.
    set_ : KEY=VALUE
        What the file does not state, of all its trips: weather=wet, load=12000 (kg) or 12t,
        start_position=0.2km, or =stations: where the stops match them.
    accept
        Use the profile that is proposed, where none fits.
    """
    from analysis.resistance.passport import with_estimated_passport
    from trainlog.ingest import Ingested, Outcome, ingest_all

    alone = len(recordings) == 1 and not recordings[0].is_dir()
    found: list[Outcome] = []
    the_train = None if train is None else trainlog.read_train(train)
    as_json = current().as_json
    the_line, routes = line_or_network(line, network, stations)
    options = {
        "--format": format,
        "--line": line,
        "--network": network,
        "--stations": stations,
        "--train": train,
    }
    pairs_given = [(option, str(each)) for option, each in options.items() if each is not None]
    pairs_given += [("--set", fact) for fact in set_ or []]
    given = [*(word for pair in pairs_given for word in pair), *["--reverse"] * reverse]
    proposals = Proposals(output, the_train, format, the_line, accept, as_json, given)
    try:
        result = ingest_all(
            recordings,
            output,
            profile,
            format=format,
            line=the_line,
            train=the_train,
            direction="reverse" if reverse else None,
            metadata=pairs(set_ or []),
            network=routes,
            each=lambda outcome, done, total: found.append(outcome),  # noqa: ARG005
            choose=proposals.profile_for,
            finish=with_estimated_passport if (line or network) and train else None,
        )
    except KeyboardInterrupt:
        _print_ingested(Ingested(output, tuple(found)), alone=False)
        raise
    if alone and not as_json and [each.state for each in found] == ["refused"]:
        if proposals.waiting:
            print_error(found[0].reason)
            raise typer.Exit(1)
        raise InputError(found[0].reason)
    _print_ingested(result, alone=alone)
    if result.failed:
        raise typer.Exit(1)


def _print_ingested(result: Ingested, *, alone: bool) -> None:
    """Print what became of the recordings: of a single file with its report, else as a table."""
    if state(result.details()):
        return
    if not alone:
        show(result)
        return
    shown: set[str] = set()
    for each in result.of("made", "repaired", "unchanged"):
        assert each.log is not None
        assert each.report is not None
        if each.state == "unchanged":
            console.print(f"  {each.metadata['trip']}: {each.reason}")
            say(f"kept {each.log}")
            continue
        console.print(about(each.metadata, each.duration))
        route = f"route {each.metadata.get('line')}: "
        for what, words in {"direction": "direction ", "route": route, "motion": ""}.items():
            if f"{what}_evidence" in each.metadata:
                say(f"    {words}{each.metadata[f'{what}_evidence']}")
        lines = [line for line in each.report.lines() if line not in shown]
        console.print(*(f"    {line}" for line in lines), sep="\n")
        # What the file holds besides its trips is shown with the first of them.
        shown.update(line for line in lines if line.startswith("not used: "))
        wrote(each.log)
    for each in result.of("refused"):
        print_error(each.reason)
    if len(result.outcomes) > 1:
        console.print(result.sentence)


@dataclass
class Proposals:
    """The profiles that are proposed while files are ingested, one for each layout.

    Attributes
    ----------
    output : Path
        Folder that they are written to.
    train : Train, optional
        Whose mass the efforts must accelerate.
    format : str, optional
        Name of the format that the user gives.
    line : Line, optional
        On whose stations the trips are put where their counter starts elsewhere.
    accept : bool
        Whether they are used without asking.
    quiet : bool
        Nothing is shown, nobody is asked.
    given : list of str
        What the user gave besides files, profile and folder.
    made : list of (Proposal, Path, bool)
        Each with its file, and whether the user agreed.
    """

    output: Path
    train: Train | None
    format: str | None
    line: Line | None
    accept: bool
    quiet: bool
    given: list[str] = field(default_factory=list)
    made: list[tuple[Proposal, Path, bool]] = field(default_factory=list)

    @property
    def waiting(self) -> bool:
        """Whether a proposal waits for the user's agreement."""
        return any(not agreed for _, _, agreed in self.made)

    def profile_for(self, file: Path) -> Path | None:
        """The profile to read a file with; None where it needs none.

        Raises
        ------
        InputError
            If the file is no recording of a trip, or the user has not agreed to the proposal.
        """
        from trainlog.ingest import needs_profile, propose_profile

        if not needs_profile(file, self.format):
            return None
        for proposal, path, agreed in self.made:
            if proposal.fits(file):
                return self._used(file, path, agreed)
        proposal = propose_profile(file, self.train, self.line)
        path = self._written(proposal)
        agreed = self.accept or self._asked(proposal, path)
        self.made.append((proposal, path, agreed))
        return self._used(file, path, agreed)

    def _written(self, proposal: Proposal) -> Path:
        """Write a proposal; a profile that the user may have corrected stays as it is."""
        from trainlog.formats.files import write_bytes

        stem, data = proposal.path.stem, proposal.text.encode()
        path = self.output / f"{stem}.profile.toml"
        number = 2
        while path.exists() and path.read_bytes() != data:
            path = self.output / f"{stem}-{number}.profile.toml"
            number += 1
        write_bytes(path, data)
        if not self.quiet:
            console.print(f"{proposal.path}: no profile fits, this one is proposed:")
            for line in proposal.lines():
                say(f"  {line}")
            wrote(path)
        return path

    def _asked(self, proposal: Proposal, path: Path) -> bool:
        """Whether the user, at a terminal, agrees."""
        if self.quiet or not _at_terminal():
            return False
        with paused():
            return typer.confirm(f"Ingest {proposal.path.name} with {path}?", default=False)

    def _used(self, file: Path, path: Path, agreed: bool) -> Path:
        if agreed:
            return path
        words = ["ingest", str(file), "--profile", str(path), "-o", str(self.output), *self.given]
        raise InputError(
            f"no profile fits; one is proposed in {path}",
            file=file,
            remedy=f"check it, then: trainlog {shlex.join(words)}",
        )


def _at_terminal() -> bool:
    """Whether a user can be asked."""
    return console.is_terminal and sys.stdin.isatty()
