"""Bringing a fleet up to date: what is new, or was made by other code, is computed; nothing else.

A result belongs to the content of a log, an analysis, the version of its code and its parameters.
Each batch is recorded when it comes, in one transaction an analysis: whatever interrupts an update,
the next goes on with what is missing, and each trip counts once.
"""

from __future__ import annotations

import heapq
import math
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import groupby, islice
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.fleet.analyses import computation_of
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.presentation import NUMBER, Column, Presented, WordTable, new_table
from trainlog.progress import task

if TYPE_CHECKING:
    from analysis.fleet.analyses import FleetAnalysis
    from analysis.fleet.engine import Engine
    from analysis.fleet.maps import MapsUpdate
    from analysis.fleet.work import Batch, BatchResult, Job
    from trainlog.catalogue import Catalogue

BATCH = 16
"""Most trips of a batch."""

SHARES = 3
"""A batch is one of so many shares of a worker in the trips that are left: batches become smaller
towards the end, so that all workers end at about the same time."""

MERGED = 100_000
"""Trips up to which the files of results are put together: that takes all of them into memory."""

WAIT = 0.5
"""Time after which trips that another update computes are asked for again [s]."""

PAGE = 2000
"""Trips that are asked of the catalogue at once: what is in memory does not grow with the fleet."""

EVIDENCE = "adhesion"
"""The analysis that the maps are made of, with its own parameters."""

FIRST = "the first trips take longest: code is compiled, once"
"""Stated until a batch is finished."""

LISTED = 200
"""Problems that an update lists; the catalogue knows all of them."""


@dataclass(frozen=True, slots=True)
class Problem:
    """A trip that an analysis could not be made of.

    Attributes
    ----------
    key, name, path : str
        Of the trip in the catalogue; the name is empty where it is not known.
    analysis : str
    state : {"refused", "failed", "unread"}
        Refused: the trip does not give it. Failed: the analysis did, or its worker died. Unread:
        the worker cannot read the log, of which nothing is recorded.
    reason : str
    """

    key: str
    path: str
    analysis: str
    state: str
    reason: str
    name: str = ""


FEW = 5
"""Trips without a result up to which each has a row."""

_NUMBERS = re.compile(r"[-+]?\d+(?:[.,]\d+)*(?:e[-+]?\d+)?")
_QUOTED = re.compile(r"'[^']*'")
_PRESENT = re.compile(r"; topics present: .*")


def problems_table(problems: Sequence[Problem], most: int = FEW) -> WordTable:
    """Trips that gave no result, with the reasons; what several analyses state alike once.

    Of more than `most` trips those of one state and reason are one row, with their number; figures
    and names do not part reasons.
    """
    together: dict[tuple[str, str, str], list[Problem]] = {}
    for each in problems:
        together.setdefault((each.key, each.state, each.reason), []).append(each)
    if len({each.key for each in problems}) > most:
        return _by_reason(list(together.values()))
    table = new_table("Without a result", "trip", "analysis", "state", "reason", name="problems")
    for (_, state, reason), group in together.items():
        table.add_row(_trip_of(group[0]), _analyses_of(group), state, reason)
    return table


def _by_reason(groups: Sequence[Sequence[Problem]]) -> WordTable:
    """How many trips gave no result for each reason, the most first."""
    alike: dict[tuple[str, str, str], list[Problem]] = {}
    for group in groups:
        form = form_of_reason(group[0].reason)
        alike.setdefault((_analyses_of(group), group[0].state, form), []).append(group[0])
    table = new_table(
        "Without a result", "analysis", "state", Column("trips", NUMBER), "reason, of one of them",
        "this trip", name="problems",
    )  # fmt: skip
    for (names, state, _), rows in sorted(alike.items(), key=lambda each: -len(each[1])):
        table.add_cells(names, state, len(rows), rows[0].reason, _trip_of(rows[0]))
    return table


def form_of_reason(reason: str) -> str:
    """A reason without its figures, names and what else the log has, which part it from no other.

    Examples
    --------
    >>> form_of_reason("trip 'a' has 3 axles") == form_of_reason("trip 'b' has 12 axles")
    True
    """
    return _NUMBERS.sub("#", _QUOTED.sub("''", _PRESENT.sub("", reason)))


def _trip_of(problem: Problem) -> str:
    """The trip by its name, with that of its file where it is another."""
    path = Path(problem.path)
    if problem.name and problem.path and path.stem != problem.name:
        return f"{problem.name} ({path.name})"
    return problem.name or path.stem or problem.key[:12]


def _analyses_of(group: Sequence[Problem]) -> str:
    return ", ".join(each.analysis for each in group if each.analysis)


@dataclass
class Counts:
    """What became of the trips of one analysis in an update.

    Attributes
    ----------
    analysis, code : str
    done, refused, failed : int
        Trips that were computed now.
    known : int
        That were known before, by this code.
    pending : int
        That are still to be computed.
    """

    analysis: str
    code: str
    done: int = 0
    refused: int = 0
    failed: int = 0
    known: int = 0
    pending: int = 0


STATES = ("done", "refused", "failed", "known", "pending")
"""Of a trip for an analysis, as an update counts them."""


@dataclass(eq=False, repr=False)
class FleetUpdate(Presented):
    """What an update did.

    Attributes
    ----------
    counts : dict of str to Counts
        By analysis.
    trips : int
        Of which anything was computed.
    problems : list of Problem
        The first of them.
    unread : int
        Trips whose logs no worker could read.
    gone : int
        Trips whose logs have all vanished: nothing more can be computed of them.
    engine : str
    workers : int
    seconds, worker_seconds : float [s]
        Time that it took, and processor time of the workers.
    computing_seconds, idle_seconds : float [s]
        From the beginning of the first batch to the end of the last, by the clocks of the workers,
        and the time within, over all workers, in which they had none.
    maps : MapsUpdate or None
        What became of the maps; None where the evidence for them was not asked for.
    """

    counts: dict[str, Counts]
    trips: int = 0
    problems: list[Problem] = field(default_factory=list)
    unread: int = 0
    gone: int = 0
    engine: str = ""
    workers: int = 0
    seconds: float = 0.0
    worker_seconds: float = 0.0
    computing_seconds: float = 0.0
    idle_seconds: float = 0.0
    maps: MapsUpdate | None = None

    @property
    def title(self) -> str:
        """The update in one sentence."""
        return f"Update of a fleet: {self.sentence}"

    def summary(self) -> dict[str, str]:
        """What became of the trips, by analysis."""
        return {
            each.analysis: ", ".join(
                f"{number:,} {state}" for state in STATES if (number := getattr(each, state))
            )
            for each in self.counts.values()
        }

    def tables(self) -> list[WordTable]:
        """What was computed by analysis, and trips that gave no result."""
        columns = (Column("analysis"), *(Column(each, NUMBER) for each in STATES), Column("code"))
        computed = new_table("Computed", *columns, name="analyses").add_rows(self.counts.values())
        return [computed, problems_table(self.problems)]

    @property
    def sentence(self) -> str:
        """The update in one sentence."""
        if not self.trips and not self.unread:
            return f"nothing new; {gone_words(self.gone)}" if self.gone else "nothing new"
        words = f"{counted(self.trips, 'trip')} computed in {self.seconds:.1f} s"
        if self.workers:
            words += f" by {self.engine}, {counted(self.workers, 'worker')}"
        if self.unread:
            words += f"; the logs of {counted(self.unread, 'trip')} could not be read"
        if self.gone:
            words += f"; {gone_words(self.gone)}"
        if self.maps is not None and self.maps.trips:
            words += f"; {counted(len(self.maps.edges), 'map')} brought up to date"
        return words

    @property
    def refused(self) -> int:
        """Trips that some analysis refused or failed at now."""
        return sum(each.refused + each.failed for each in self.counts.values())

    def facts(self) -> dict[str, Any]:
        """Time, workers, and what became of each trip."""
        return {
            "trips": self.trips,
            "unread": self.unread,
            "gone": self.gone,
            "engine": self.engine,
            "workers": self.workers,
            "seconds_s": self.seconds,
            "worker_seconds_s": self.worker_seconds,
            "computing_s": self.computing_seconds,
            "idle_s": self.idle_seconds,
            "maps": None if self.maps is None else asdict(self.maps),
            "analyses": [asdict(each) for each in self.counts.values()],
            "problems": [asdict(each) for each in self.problems],
        }


@dataclass(frozen=True)
class UpdateOptions:
    """How an update is made.

    Attributes
    ----------
    workers : int, optional
        Processes; default one a processor, 0: this process itself.
    scheduler : str, optional
        Address of a Dask scheduler, in place of processes.
    mpi : bool
        The workers of an MPI job, in place of processes.
    executor : Executor, optional
        Any other executor of `concurrent.futures`.
    batch : int
        Most trips of a batch.
    where : str, optional
        Only trips that this expression chooses; see `Catalogue.query`.
    retry : bool
        Compute trips again that were refused, or failed, or whose file of results is missing or
        damaged.
    merge : bool
        Put the files of results together at the end, and bring the maps up to date.

    Examples
    --------
    >>> UpdateOptions(workers=2, where="weather = 'wet'").batch
    16
    """

    workers: int | None = None
    scheduler: str | None = None
    mpi: bool = False
    executor: Executor | None = None
    batch: int = BATCH
    where: str | None = None
    retry: bool = False
    merge: bool = True

    def __post_init__(self) -> None:
        given = [self.workers is not None, self.scheduler is not None, self.mpi]
        if sum([*given, self.executor is not None]) > 1:
            raise InputError(
                "several engines were named", remedy="give workers, a scheduler, MPI or an executor"
            )
        if self.batch < 1 or (self.workers is not None and self.workers < 0):
            raise InputError(
                f"a batch of {self.batch} trips for {self.workers} workers is not valid",
                remedy="give 1 or more",
            )

    def engine(self) -> Engine:
        """The engine that is asked for."""
        from analysis.fleet import engine

        if self.executor is not None:
            return engine.Engine(self.executor)
        if self.scheduler is not None:
            return engine.Dask(self.scheduler)
        if self.mpi:
            return engine.MPI()
        return engine.InProcess() if self.workers == 0 else engine.Processes(self.workers)


def update_fleet(
    catalogue: Catalogue,
    analyses: Iterable[str | FleetAnalysis] | None = None,
    options: UpdateOptions | None = None,
    report: Callable[[Problem], object] | None = None,
) -> FleetUpdate:
    """Compute what is new in a catalogue, or was made by other code.

    Parameters
    ----------
    catalogue : Catalogue
    analyses : iterable of str or FleetAnalysis, optional
        Default: all that are registered (`analysis.fleet.analyses.ANALYSES`).
    options : UpdateOptions, optional
    report : callable, optional
        Is given each problem as it comes.

    Returns
    -------
    FleetUpdate

    Raises
    ------
    InputError
        If there is no such analysis, the engine cannot be reached, or its workers run other code.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.catalogue import open_catalogue
    >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
    ...     _ = catalogue.add("sample_logs")
    ...     first = update_fleet(catalogue, ["checks"], UpdateOptions(workers=0))
    ...     again = update_fleet(catalogue, ["checks"], UpdateOptions(workers=0))
    ...     found = catalogue.results("checks")
    >>> first.trips, again.sentence, found["trip"].tolist()
    (2, 'nothing new', ['trip-03', 'trip-01'])
    """
    began = time.perf_counter()
    with ExitStack() as stack:
        work = _Update(catalogue, _chosen(analyses), options or UpdateOptions(), report, stack)
        work.prepare()
        if work.total:
            work.compute()
        if work.options.merge:
            work.merge()
            work.bring_maps()
    work.found.seconds = time.perf_counter() - began
    return work.found


def _chosen(analyses: Iterable[str | FleetAnalysis] | None) -> tuple[FleetAnalysis, ...]:
    from analysis.fleet.analyses import FleetAnalysis, analyses_named

    if analyses is None:
        return analyses_named()
    given = list(analyses)
    named = {each.name: each for each in analyses_named([n for n in given if isinstance(n, str)])}
    own = {each.name: each for each in given if isinstance(each, FleetAnalysis)}
    return tuple((named | own).values())


class _Update:
    """One update."""

    def __init__(
        self,
        catalogue: Catalogue,
        analyses: Sequence[FleetAnalysis],
        options: UpdateOptions,
        report: Callable[[Problem], object] | None,
        stack: ExitStack,
    ) -> None:
        self._stack = stack
        self.catalogue, self.analyses, self.options = catalogue, tuple(analyses), options
        self.computations = [computation_of(each) for each in analyses]
        self.found = FleetUpdate(
            {each.analysis: Counts(each.analysis, each.code) for each in self.computations}
        )
        self.total = 0
        self._elsewhere: list[Job] = []
        self._report = report
        self._done = 0
        self._first, self._last, self._busy = math.inf, 0.0, 0.0

    @cached_property
    def _engine(self) -> Engine:
        """The engine, from when it is first asked for until the update ends."""
        return self._stack.enter_context(self.options.engine())

    def prepare(self) -> None:
        """Find out how much there is to do."""
        waiting = []
        for each in self.computations:
            if self.options.retry:
                self.catalogue.forget(each, where=self.options.where)
            known = self.catalogue.standing(each, where=self.options.where)
            counts = self.found.counts[each.analysis]
            counts.pending = known.pop("pending")
            counts.known = sum(known.values())
            waiting.append(counts.pending)
        self.found.gone = self.catalogue.gone(self.options.where)
        # Mostly the same trips wait for all: of more than one analysis this is a lower bound.
        self.total = max(waiting, default=0)

    def compute(self) -> None:
        """Compute all that is pending."""
        from analysis.fleet.engine import run

        engine, jobs = self._engine, self._jobs()
        with task("computing", self.total, "trip") as step, self.catalogue.claims() as claim:
            self.found.engine, self.found.workers = engine.name, engine.workers
            self._step, self._claim = step, claim
            step(0, note=FIRST)
            while True:
                run(engine, self._batches(jobs, engine.workers), self._finished)
                if not self._elsewhere:
                    break
                # What this update has taken is recorded: two never wait for each other.
                others = counted(len(self._elsewhere), "trip")
                step(self._done, note=f"waiting for {others} of another update")
                time.sleep(WAIT)
                jobs, self._elsewhere = iter(self._elsewhere), []
        for each in self.computations:
            # Others may have recorded some from when they were counted on.
            counts = self.found.counts[each.analysis]
            left = self.catalogue.standing(each, where=self.options.where)["pending"]
            counts.known += max(0, counts.pending - left)
            counts.pending = left
        if self._busy:
            self.found.computing_seconds = self._last - self._first
            whole = self.found.workers * self.found.computing_seconds
            self.found.idle_seconds = max(0.0, whole - self._busy)

    def _batches(self, jobs: Iterator[Job], workers: int) -> Iterator[Batch]:
        from analysis.fleet.work import Batch

        given = count = 0
        free = self._free(jobs)
        while True:
            left = max(self.total - count, 1)
            most = max(1, min(self.options.batch, -(-left // (SHARES * workers))))
            # One trip each at first: these take longest, and are kept soon.
            part = tuple(islice(free, 1 if given < workers else most))
            if not part:
                return
            count += len(part)
            if wanted := self._left(part):
                given += 1
                yield Batch(wanted, self.analyses)

    def _free(self, jobs: Iterator[Job]) -> Iterator[Job]:
        """Those that no other update computes at present; they are this one's until recorded."""
        for job in jobs:
            if self._claim(job.key):
                yield job
            else:
                self._elsewhere.append(job)

    def _left(self, jobs: Sequence[Job]) -> tuple[Job, ...]:
        """What another update has not recorded of jobs since they were listed."""
        keys = [job.key for job in jobs]
        pending = [
            set(self.catalogue.pending(each, where=self.options.where, keys=keys)["key"])
            for each in self.computations
        ]
        left = []
        for job in jobs:
            wanted = tuple(number for number in job.analyses if job.key in pending[number])
            if wanted:
                left.append(job._replace(analyses=wanted))
            else:
                self._claim(job.key, False)
                self._done += 1
        return tuple(left)

    def _jobs(self) -> Iterator[Job]:
        """Trips with the numbers of the analyses that wait for them, of a page long ones first."""
        jobs = self._by_key()
        while page := list(islice(jobs, PAGE)):
            yield from sorted(page, key=lambda job: -_size(job.path))

    def _by_key(self) -> Iterator[Job]:
        """The same in the order of key."""
        from analysis.fleet.work import Job

        waiting = (self._pending(number) for number in range(len(self.analyses)))
        together = heapq.merge(*waiting, key=itemgetter(0))
        for _, rows in groupby(together, key=itemgetter(0)):
            (key, sha256, path, name, first), *others = rows
            yield Job(key, sha256, path, (first, *(each[-1] for each in others)), name or "")

    def _pending(self, number: int) -> Iterator[tuple[str, str, str, str | None, int]]:
        """Key, checksum, path and name of the trips that an analysis waits for, and its number."""
        computation, last = self.computations[number], ""
        while True:
            page = self.catalogue.pending(computation, where=self.options.where, page=(last, PAGE))
            yield from ((*row, number) for row in page.itertuples(index=False))
            if len(page) < PAGE:
                return
            last = str(page["key"].iloc[-1])

    def _finished(self, batch: Batch, result: BatchResult) -> None:
        """Record a batch."""
        from analysis.fleet.work import Outcome
        from trainlog.catalogue import ResultOutcome
        from trainlog.version import code_version

        if result.code and result.code != code_version():
            raise InputError(
                f"the worker on {result.host} runs other code of trainlog ({result.code}, here"
                f" {code_version()})",
                remedy="install the same trainlog on all computers, then start the workers anew",
            )
        jobs = {job.key: job for job in batch.jobs}
        for number, analysis in enumerate(self.analyses):
            given: list[Outcome] = result.outcomes[number]
            if not given:
                continue
            outcomes = [ResultOutcome(*each) for each in given]
            table = result.tables[number]
            self.catalogue.record(self.computations[number], outcomes, table)
            counts = self.found.counts[analysis.name]
            for each in given:
                setattr(counts, each.state, getattr(counts, each.state) + 1)
                counts.pending -= 1
                if each.state != "done":
                    job, why = jobs[each.key], (each.state, each.reason)
                    self._add(Problem(each.key, job.path, analysis.name, *why, job.name))
        for missing in result.unread:
            self.found.unread += 1
            name = jobs[missing.key].name
            self._add(Problem(missing.key, missing.path, "", "unread", missing.reason, name))
        self.found.trips += len(batch.jobs) - len(result.unread)
        self.found.worker_seconds += result.seconds
        if result.ended:
            self._first, self._last = min(self._first, result.began), max(self._last, result.ended)
            self._busy += result.ended - result.began
        for key in jobs:
            self._claim(key, False)
        self._done += len(batch.jobs)
        self._step(self._done, note="")

    def _add(self, problem: Problem) -> None:
        if len(self.found.problems) < LISTED:
            self.found.problems.append(problem)
        if self._report is not None:
            self._report(problem)

    def merge(self) -> None:
        """Put the files of results together, of each analysis that has new ones."""
        for each in self.computations:
            counts = self.found.counts[each.analysis]
            trips = counts.known + counts.done + counts.refused
            if not counts.pending and trips <= MERGED:
                self.catalogue.compact(each)

    def bring_maps(self) -> None:
        """Add the new evidence to the maps of the edges."""
        for analysis, computation in zip(self.analyses, self.computations, strict=True):
            counts = self.found.counts[analysis.name]
            if analysis.name == EVIDENCE and analysis.is_default and counts.known + counts.done:
                from analysis.fleet.maps import update_maps

                self.found.maps = update_maps(self.catalogue, computation, lambda: self._engine)


def _size(path: str) -> int:
    """Of a log [bytes]; 0 where it cannot be seen from here."""
    try:
        return Path(path).stat().st_size
    except OSError:
        return 0


def gone_words(number: int) -> str:
    """That the logs of so many trips have vanished, and what to do.

    Examples
    --------
    >>> gone_words(2)
    "2 trips: their logs are gone ('trainlog fleet refresh FOLDER' finds those that moved)"
    """
    whose = "its log is" if number == 1 else "their logs are"
    moved = "'trainlog fleet refresh FOLDER' finds those that moved"
    return f"{counted(number, 'trip')}: {whose} gone ({moved})"


@dataclass(frozen=True, eq=False, repr=False)
class FleetStatus(Presented):
    """What of a catalogue is computed by this code.

    Attributes
    ----------
    analyses : dict of str to dict of str to int
        By analysis: trips ``done``, ``refused``, ``failed`` and ``pending``.
    problems : tuple of Problem
        The first of those that were refused, or failed.
    results : Path
        Folder of the tables.
    gone : int
        Trips whose logs have all vanished; they are not among those pending.
    """

    analyses: dict[str, dict[str, int]]
    problems: tuple[Problem, ...]
    results: Path
    gone: int = 0

    @property
    def title(self) -> str:
        """What it is, and how many logs are gone."""
        return f"State of a fleet{f': {gone_words(self.gone)}' if self.gone else ''}"

    def summary(self) -> dict[str, str]:
        """How many trips are in each state, by analysis."""
        return {
            name: ", ".join(f"{number:,} {state}" for state, number in each.items() if number)
            for name, each in self.analyses.items()
        }

    def tables(self) -> list[WordTable]:
        """How many trips of each analysis are in each state; those without a result on request."""
        states = ("done", "refused", "failed", "pending")
        columns = (Column("analysis"), *(Column(each, NUMBER) for each in states))
        table = new_table("Computed by this code", *columns, name="analyses")
        table.add_rows({"analysis": name} | each for name, each in self.analyses.items())
        problems = problems_table(self.problems, most=len(self.problems))
        problems.usual = False
        return [table, problems]

    @property
    def notes(self) -> list[str]:
        """How many logs are gone."""
        return [gone_words(self.gone)] if self.gone else []

    @property
    def pending(self) -> int:
        """Most trips that an analysis waits for."""
        return max((each["pending"] for each in self.analyses.values()), default=0)

    def facts(self) -> dict[str, Any]:
        """The state of each analysis, and trips without a result."""
        return {
            "analyses": [{"analysis": name, **each} for name, each in self.analyses.items()],
            "problems": [asdict(each) for each in self.problems],
            "gone": self.gone,
            "results": str(self.results),
        }


def fleet_status(
    catalogue: Catalogue,
    analyses: Iterable[str | FleetAnalysis] | None = None,
    *,
    where: str | None = None,
    most: int = LISTED,
) -> FleetStatus:
    """What of a catalogue is computed by this code, and which trips gave no result.

    Parameters
    ----------
    catalogue : Catalogue
    analyses : iterable of str or FleetAnalysis, optional
        Default: all that are registered.
    where : str, optional
        Only trips that this expression chooses.
    most : int
        Problems that are listed at most, of each analysis.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.catalogue import open_catalogue
    >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
    ...     _ = catalogue.add("sample_logs")
    ...     fleet_status(catalogue, ["checks"])
    State of a fleet
      checks  2 pending
    """
    found: dict[str, dict[str, int]] = {}
    problems: list[Problem] = []
    columns = ["key", "path", "state", "reason", "name"]
    for analysis in _chosen(analyses):
        computation = computation_of(analysis)
        found[analysis.name] = catalogue.standing(computation, where=where)
        listed = catalogue.outcomes(
            computation, where=where, states=("refused", "failed"), most=most
        )
        problems += [
            Problem(key, path or "", analysis.name, state, reason, name or "")
            for key, path, state, reason, name in listed[columns].to_numpy().tolist()
        ]
    gone = catalogue.gone(where)
    return FleetStatus(found, tuple(problems), catalogue.results_folder, gone)
