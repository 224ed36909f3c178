"""The errors a user can meet: one sentence that names the file, the place and the remedy.

Everything raised on bad input is a `TrainlogError`; the command line prints it as one line and
exits with status 2. Any other exception is a defect of trainlog itself.
"""

from __future__ import annotations

from pathlib import Path


class TrainlogError(Exception):
    """Bad input, stated in one line.

    Parameters
    ----------
    problem : str
        What is wrong, naming the offending value.
    file : path, optional
        The file it was found in.
    place : str, optional
        Where in that file: ``"row 17, column speed"``, ``"byte 40960"``, ``"km 12.350"``.
    remedy : str, optional
        What the user can do about it.
    """

    def __init__(
        self,
        problem: str,
        *,
        file: str | Path | None = None,
        place: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.problem = problem
        self.file = None if file is None else Path(file)
        self.place = place
        self.remedy = remedy
        where = ", ".join(str(part) for part in (file, place) if part is not None)
        message = f"{where}: {problem}" if where else problem
        super().__init__(f"{message}; {remedy}" if remedy else message)


class InputError(TrainlogError):
    """A file or an argument that cannot be used: missing, malformed, wrong unit, nonsensical."""


class LogError(TrainlogError):
    """An MCAP log that is damaged, foreign or lacks what is asked for."""


class NotIdentifiableError(TrainlogError):
    """The data do not determine what is asked: too little excitation, too short, too many gaps."""


class InfeasibleError(TrainlogError):
    """No trajectory satisfies the constraints; the message says which one and by how much."""


class MissingExtraError(TrainlogError):
    """A package that an extra of trainlog installs is missing; the message names the extra."""
