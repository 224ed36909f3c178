"""What a worker does: analyses of a batch of trips, one reading of each log.

Nothing here knows which engine runs it, nor of the catalogue: what goes in and comes out is plain
data, so that it can be sent to another process or computer.
"""

from __future__ import annotations

import socket
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

import pandas as pd
import pyarrow as pa

from analysis.fleet.analyses import FleetAnalysis
from trainlog.errors import TrainlogError
from trainlog.formats.files import sha256_of
from trainlog.processes import LINEAR_ALGEBRA, begin_worker
from trainlog.version import code_version

THREADS = (*LINEAR_ALGEBRA, "NUMBA_NUM_THREADS")
"""Environment of a worker: one thread each. Workers share out the processors among trips."""

State = Literal["done", "refused", "failed"]

RAN_ALONE = 3
"""Times that a worker must die of a trip, alone in its process, until the trip is given up."""


class Job(NamedTuple):
    """A trip to be computed.

    Attributes
    ----------
    key, sha256, path : str
        Of the trip in the catalogue, and of its log.
    analyses : tuple of int
        Numbers of the analyses that are asked for, among those of the batch.
    name : str
        Of the trip; empty where it states none.
    """

    key: str
    sha256: str
    path: str
    analyses: tuple[int, ...]
    name: str = ""


Result = TypeVar("Result", covariant=True)


class Work(Protocol[Result]):
    """What one worker is given at once.

    Attributes
    ----------
    jobs : tuple
        What of it can be done alone.
    """

    @property
    def jobs(self) -> tuple[Any, ...]:
        """The jobs."""

    def computed(self) -> Result:
        """Do it."""

    def alone(self, job: Any) -> Work[Result]:
        """One of its jobs."""

    def died(self, job: Any, reason: str) -> Result:
        """The result of a job of which workers die."""


@dataclass(frozen=True)
class Batch:
    """Trips that one worker computes one after the other.

    Attributes
    ----------
    jobs : tuple of Job
    analyses : tuple of FleetAnalysis
    """

    jobs: tuple[Job, ...]
    analyses: tuple[FleetAnalysis, ...]

    def computed(self) -> BatchResult:
        """Every analysis that is asked for of each trip, by one reading of its log.

        What a trip cannot give is stated with the reason, and keeps no other from being computed.
        """
        began, started = time.process_time(), time.time()
        kept: list[list[tuple[str, pd.DataFrame]]] = [[] for _ in self.analyses]
        result = BatchResult([], [[] for _ in self.analyses], [], code_version())
        result.host = socket.gethostname()
        for job in self.jobs:
            reason = _unreadable(job)
            if reason:
                result.unread.append(Unread(job.key, job.path, reason))
                continue
            for number, (outcome, frame) in _of_trip(job, self.analyses).items():
                result.outcomes[number].append(outcome)
                if frame is not None:
                    kept[number].append((job.key, frame))
        result.tables = [
            analysis.arrow(frames) for analysis, frames in zip(self.analyses, kept, strict=True)
        ]
        result.seconds = time.process_time() - began
        result.began, result.ended = started, time.time()
        return result

    def alone(self, job: Job) -> Batch:
        """One of its trips."""
        return replace(self, jobs=(job,))

    def died(self, job: Job, reason: str) -> BatchResult:
        """The result of a trip of which workers die."""
        outcomes = [
            [Outcome(job.key, job.sha256, "failed", reason, 0, 0.0)]
            if number in job.analyses
            else []
            for number in range(len(self.analyses))
        ]
        return BatchResult([each.arrow([]) for each in self.analyses], outcomes)


class Outcome(NamedTuple):
    """What became of an analysis of a trip."""

    key: str
    sha256: str
    state: State
    reason: str
    rows: int
    seconds: float


class Unread(NamedTuple):
    """A trip whose log the worker could not read: nothing is recorded of it."""

    key: str
    path: str
    reason: str


@dataclass
class BatchResult:
    """What a worker computed of a batch.

    Attributes
    ----------
    tables : list of pyarrow.Table
        One an analysis.
    outcomes : list of list of Outcome
        The same; of the trips for which it was asked.
    unread : list of Unread
    code : str
        Version of the code that the worker runs.
    host, process : str, int
        Of the worker.
    seconds : float
        Processor time [s].
    began, ended : float
        By the worker's clock [s since 1970].
    """

    tables: list[pa.Table]
    outcomes: list[list[Outcome]]
    unread: list[Unread] = field(default_factory=list)
    code: str = ""
    host: str = ""
    seconds: float = 0.0
    began: float = 0.0
    ended: float = 0.0


def begin_analyses() -> None:
    """Prepare a process that computes batches for another."""
    begin_worker()
    one_thread()
    load_analyses()


def one_thread() -> None:
    """Let Arrow use one thread; the environment of a worker limits the others."""
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)


def load_analyses() -> None:
    """Load all that the registered analyses run through, before a first trip asks for it."""
    import analysis.fleet.worker  # noqa: F401


def computed(work: Work[Result]) -> Result:
    """Do what a worker is given."""
    return work.computed()


def computed_elsewhere(work: Work[Result]) -> Result:
    """`computed`, in a process that was not started by us."""
    one_thread()
    return work.computed()


def _unreadable(job: Job) -> str:
    """Why a log is not what the catalogue states; empty if it is."""
    try:
        found = sha256_of(job.path)
    except TrainlogError as error:
        return f"a worker on {socket.gethostname()} cannot read it: {error.problem}"
    if found != job.sha256:
        return "changed since it was registered: add it to the catalogue again"
    return ""


@dataclass
class _Gathered:
    """What the parts of a trip gave for one analysis."""

    frames: list[pd.DataFrame] = field(default_factory=list)
    reasons: list[tuple[State, str]] = field(default_factory=list)
    seconds: float = 0.0


def _of_trip(
    job: Job, analyses: Sequence[FleetAnalysis]
) -> dict[int, tuple[Outcome, pd.DataFrame | None]]:
    """The outcomes and tables of a trip, by the number of the analysis."""
    from analysis.view import TOPICS, views_of

    gathered = {number: _Gathered() for number in job.analyses}
    try:
        for trip in views_of(Path(job.path), TOPICS, sha256=job.sha256, checked=True):
            for number, each in gathered.items():
                began = time.perf_counter()
                try:
                    frame = analyses[number].table(trip)
                except Exception as error:  # noqa: BLE001
                    each.reasons.append(_stated(error))
                else:
                    each.frames.append(frame)
                    if _is_refused(frame):
                        each.reasons.append(("refused", str(frame["message"].iloc[0])))
                each.seconds += time.perf_counter() - began
    except Exception as error:  # noqa: BLE001  # what is wrong with one trip stops no other
        state, reason = _stated(error)
        for each in gathered.values():
            each.frames, each.reasons = [], [(state, reason)]
    return {number: _outcome(job, each) for number, each in gathered.items()}


def _is_refused(frame: pd.DataFrame) -> bool:
    """Whether a table states of each row why there is no result."""
    return "refused" in frame and len(frame) > 0 and bool((frame["refused"] != "").all())


def _outcome(job: Job, gathered: _Gathered) -> tuple[Outcome, pd.DataFrame | None]:
    """One outcome of the parts of a trip: a failure counts, then that any part gave a result."""
    failed = [reason for state, reason in gathered.reasons if state == "failed"]
    refused = [reason for state, reason in gathered.reasons if state == "refused"]
    frames = gathered.frames
    state: State = "done"
    reason = ""
    if failed:
        frames, state, reason = [], "failed", failed[0]
    elif refused and all(_is_refused(each) for each in frames):
        state, reason = "refused", refused[0]
    elif refused:
        reason = f"{len(refused)} parts refused, first: {refused[0]}"
    frame = pd.concat(frames, ignore_index=True) if frames else None
    rows = 0 if frame is None else len(frame)
    seconds = round(gathered.seconds, 3)
    return Outcome(job.key, job.sha256, state, reason, rows, seconds), frame


def _stated(error: Exception) -> tuple[State, str]:
    """The state and the reason of an error: refused if the trip is to blame, else failed."""
    if isinstance(error, TrainlogError):
        return "refused", str(error)
    place = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{Path(place.filename).name}, line {place.lineno}"
    return "failed", f"{type(error).__name__}: {error} ({where})".replace("\n", " ")
