"""Profiles proposed for files that none fits: shown, written, and used if the user agrees."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from trainlog.cli.progress_bar import paused
from trainlog.cli.terminal import console, wrote
from trainlog.errors import InputError

if TYPE_CHECKING:
    from trainlog.ingest import Proposal
    from trainlog.railway.line import Line
    from trainlog.railway.train import Train


class Proposals:
    """The profiles that are proposed while files are ingested, one for each layout.

    Parameters
    ----------
    output : Path
        Folder that they are written to.
    train : Train, optional
        Whose mass the efforts must accelerate.
    format : str, optional
        Name of the format that the user gives.
    accept : bool
        Whether they are used without asking.
    quiet : bool
        Nothing is shown, nobody is asked.
    line : Line, optional
        On whose stations the trips are put where their counter starts elsewhere.
    """

    def __init__(
        self,
        output: Path,
        train: Train | None,
        format: str | None,
        *,
        accept: bool,
        quiet: bool,
        line: Line | None = None,
    ) -> None:
        self._line = line
        self._output, self._train, self._format = output, train, format
        self._accept, self._quiet = accept, quiet
        self._made: list[tuple[Proposal, Path, bool]] = []

    @property
    def waiting(self) -> bool:
        """Whether a proposal waits for the user's agreement."""
        return any(not agreed for _, _, agreed in self._made)

    def profile_for(self, file: Path) -> Path | None:
        """The profile to read a file with; None where it needs none.

        Raises
        ------
        InputError
            If the file is no recording of a trip, or the user has not agreed to the proposal.
        """
        from trainlog.ingest import needs_profile, propose_profile

        if not needs_profile(file, self._format):
            return None
        for proposal, path, agreed in self._made:
            if proposal.fits(file):
                return self._used(file, path, agreed)
        proposal = propose_profile(file, self._train, self._line)
        path = self._written(proposal)
        agreed = self._accept or self._asked(proposal, path)
        self._made.append((proposal, path, agreed))
        return self._used(file, path, agreed)

    def _written(self, proposal: Proposal) -> Path:
        """Write a proposal; a profile that the user may have corrected stays as it is."""
        from trainlog.formats.files import write_bytes

        stem, data = proposal.path.stem, proposal.text.encode()
        path = self._output / f"{stem}.profile.toml"
        number = 2
        while path.exists() and path.read_bytes() != data:
            path = self._output / f"{stem}-{number}.profile.toml"
            number += 1
        write_bytes(path, data)
        if not self._quiet:
            console.print(f"{proposal.path}: no profile fits, this one is proposed:")
            for line in proposal.lines():
                console.print(f"  {line}", highlight=False, soft_wrap=True)
            wrote(path)
        return path

    def _asked(self, proposal: Proposal, path: Path) -> bool:
        """Whether the user, at a terminal, agrees."""
        if self._quiet or not _at_terminal():
            return False
        with paused():
            return typer.confirm(f"Ingest {proposal.path.name} with {path}?", default=False)

    def _used(self, file: Path, path: Path, agreed: bool) -> Path:
        if agreed:
            return path
        raise InputError(
            f"no profile fits; one is proposed in {path}",
            file=file,
            remedy=f"check it, then: trainlog ingest {file} --profile {path} -o {self._output}",
        )


def _at_terminal() -> bool:
    """Whether a user can be asked."""
    return console.is_terminal and sys.stdin.isatty()
