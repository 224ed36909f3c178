"""The errors a user can meet: one sentence that names the file, the place and the remedy.

Everything raised on bad input is a `TrainlogError`; the command line prints it as one line and
exits with status 2. Any other exception is a defect of trainlog itself.
"""

from __future__ import annotations

import copyreg
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any

MOST_LISTED = 20
"""Problems of one file that a message lists."""


def similar(name: str, known: Iterable[str], most: int = 3) -> list[str]:
    """Known names that were perhaps meant: spelled alike, or beginning alike; capitals are equal.

    Examples
    --------
    >>> similar("West", ["West_station", "East_station"]), similar("wsest", ["west", "east"])
    (['West_station'], ['west', 'east'])
    """
    folded = {str(each).casefold(): str(each) for each in known}
    word = name.casefold().strip()
    close = get_close_matches(word, list(folded), n=most, cutoff=0.6)
    parts = [each for each in folded if word and len(word) > 2 and word in each]
    return [folded[each] for each in dict.fromkeys([*parts, *close])][:most]


def suggestion(name: str, known: Iterable[str], what: str = "known") -> str:
    """Remedy for a name that is not among the `known` ones: close matches, then all of them.

    Examples
    --------
    >>> suggestion("colunm", ["column", "unit"]), suggestion("x", ["column", "unit"])
    ("did you mean 'column'?", 'known: column, unit')
    """
    names = [str(candidate) for candidate in known]
    shown = ", ".join(names[:30]) + (", ..." if len(names) > 30 else "")
    return did_you_mean(name, names, f"{what}: {shown or 'none'}")


def did_you_mean(name: str, known: Iterable[str], otherwise: str) -> str:
    """Close matches of a name among the `known` ones as a question; `otherwise` without any.

    Examples
    --------
    >>> did_you_mean("wett", ["wet", "dry"], "write it as wet")
    "did you mean 'wet'?"
    """
    matches = " or ".join(f"'{match}'" for match in similar(name, known))
    return f"did you mean {matches}?" if matches else otherwise


def meant(name: str, known: Iterable[str]) -> str:
    """The known name that a name is but for capitals and spaces; the name itself if none is.

    Examples
    --------
    >>> meant(" st.  gallen", ["St. Gallen", "Wil"]), meant("Will", ["Wil"])
    ('St. Gallen', 'Will')
    """
    every = [str(each) for each in known]
    alike = [each for each in every if _plain(each) == _plain(name)]
    return alike[0] if name not in every and len(alike) == 1 else name


def _plain(name: str) -> str:
    return " ".join(name.split()).casefold()


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

    Examples
    --------
    >>> error = LogError("has no speed", file="run.mcap", place="row 17", remedy="record it")
    >>> str(error)
    'run.mcap, row 17: has no speed; record it'
    >>> isinstance(error, TrainlogError)
    True
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
        whole = f"{message}; {remedy}" if remedy else message
        super().__init__(" ".join(whole.splitlines()))

    def __reduce__(self) -> tuple[Any, ...]:
        """Children take other arguments than the message: pickle what they became."""
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


@contextmanager
def in_file(path: str | Path) -> Iterator[None]:
    """Have an error that names no file name this one.

    Examples
    --------
    >>> with in_file("run.csv"):
    ...     raise InputError("has no row of data")
    Traceback (most recent call last):
    trainlog.errors.InputError: run.csv: has no row of data
    """
    try:
        yield
    except TrainlogError as error:
        if error.file is None:
            known = {"place": error.place, "remedy": error.remedy}
            TrainlogError.__init__(error, error.problem, file=path, **known)
        raise


class InputError(TrainlogError):
    """A file or an argument that cannot be used: missing, malformed, wrong unit, nonsensical.

    Examples
    --------
    >>> import trainlog
    >>> trainlog.read_line("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """

    problems: tuple[InputError, ...] = ()
    """Where a file has several problems: each of them."""

    @property
    def each(self) -> tuple[InputError, ...]:
        """The problems that the error states, one by one."""
        return self.problems or (self,)

    @classmethod
    def listing(
        cls, problems: Sequence[InputError], *, file: str | Path | None = None
    ) -> InputError:
        """One error that lists all `problems` of a file; of one problem, the error itself.

        Examples
        --------
        >>> mass = InputError("is missing", place="mass", remedy="add it")
        >>> speed = InputError("has no unit", place="max_speed")
        >>> print(InputError.listing([mass, speed], file="train.json"))
        train.json: 2 problems: (1) mass: is missing; add it; (2) max_speed: has no unit
        """
        each = [one for problem in problems for one in problem.each]
        if len(each) == 1:
            one = each[0]
            return cls(one.problem, file=file or one.file, place=one.place, remedy=one.remedy)
        bare = tuple(InputError(e.problem, place=e.place, remedy=e.remedy) for e in each)
        listed = [f"({number}) {one}" for number, one in enumerate(bare[:MOST_LISTED], start=1)]
        if len(bare) > MOST_LISTED:
            listed.append(f"and {len(bare) - MOST_LISTED} more")
        error = cls(f"{len(bare)} problems: {'; '.join(listed)}", file=file)
        error.problems = bare
        return error


class LogError(TrainlogError):
    """An MCAP log that is damaged, foreign or lacks what is asked for.

    Examples
    --------
    >>> import trainlog
    >>> trainlog.read("sample_logs/README.md")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.LogError: sample_logs/README.md, byte 0: is not an MCAP file but...
    """


class NotRecordedError(LogError):
    """What is asked for is not in the trip: it has no such topic, or the topic holds nothing of it.

    Of a trip at hand that does not say why: the topic may not have been loaded. Where a log is
    known, as in ``trainlog map update``, its channels decide whether it was never recorded.

    Attributes
    ----------
    topic : str
        That the trip does not have; empty where it has the topic, but nothing of it in there.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/nonstop.mcap", ["/train/state"])
    >>> trip["/train/axles"]  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.NotRecordedError: trip 'trip-01' has no topic /train/axles; ...
    """

    topic: str = ""


class NotIdentifiableError(TrainlogError):
    """The data do not determine what is asked: too little excitation, too short, too many gaps.

    Examples
    --------
    >>> str(NotIdentifiableError("no trip coasted", remedy="give trips with coasting"))
    'no trip coasted; give trips with coasting'
    """


class InfeasibleError(TrainlogError):
    """No trajectory satisfies the constraints; the message says which one and by how much.

    Examples
    --------
    >>> str(InfeasibleError("500 s are too short", remedy="at least 520 s are needed"))
    '500 s are too short; at least 520 s are needed'
    """


class MissingExtraError(TrainlogError):
    """A package that an extra of trainlog installs is missing; the message names the extra.

    Examples
    --------
    >>> str(MissingExtraError("this needs the package rerun, which is not installed"))
    'this needs the package rerun, which is not installed'
    """
