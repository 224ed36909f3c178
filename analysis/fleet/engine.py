"""Engines that run batches: processes of this computer, Dask, MPI, or any executor.

An engine has an executor of `concurrent.futures` and states how many batches are in flight, what
it means that a worker died, and how it goes on then. `run` keeps so many batches in flight, hands
results on as they come, and tries again what a worker that died had: a batch once more, then each
of its trips alone, so that the trip of which workers die is known and stops no other.
"""

from __future__ import annotations

import concurrent.futures as futures
import multiprocessing
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing import connection
from typing import Any, Self

from analysis.fleet.work import (
    RAN_ALONE,
    THREADS,
    Result,
    Work,
    begin_analyses,
    computed,
    computed_elsewhere,
)
from trainlog.errors import InputError
from trainlog.extras import load, require

IN_FLIGHT = 2
"""Batches in flight for each worker: one that it computes, one that waits for it."""

PATIENCE = 5.0
"""How long a scheduler is waited for [s]."""

WITHOUT_WORKERS = 60.0
"""How long a scheduler may have no workers [s]: those that died are replaced meanwhile."""

PROFILED = 60
"""Seconds of its profile that a worker of Dask keeps."""


class Engine:
    """An executor of `concurrent.futures`, given; the caller shuts it down.

    Parameters
    ----------
    executor : Executor
    workers : int, optional
        How many it has.
    """

    name = "executor"
    is_here = False
    """Whether its workers are processes of this computer, which see its files."""

    def __init__(self, executor: futures.Executor | None = None, workers: int | None = None):
        self._executor = executor
        self.workers = workers or int(getattr(executor, "_max_workers", 0) or os.cpu_count() or 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the engine: in order, or at once where an exception ends the run."""

    @property
    def in_flight(self) -> int:
        """How many batches are in flight at most."""
        return IN_FLIGHT * self.workers

    def submit(self, batch: Work[Result]) -> futures.Future[Result]:
        """Have a batch computed."""
        assert self._executor is not None
        return self._executor.submit(computed_elsewhere, batch)

    def lost_worker(self, error: BaseException) -> bool:
        """Whether an error states that a worker died."""
        return isinstance(error, futures.BrokenExecutor)

    def renew(self) -> None:
        """Go on after a worker died.

        Raises
        ------
        InputError
            If the executor cannot.
        """
        raise InputError(
            "a worker of the executor died, and it cannot be started anew from here",
            remedy="what was finished is kept: start the executor and update again",
        )

    def note_result(self) -> None:
        """A batch came back: there are workers."""

    def check(self) -> None:
        """Refuse to wait for workers that do not come back.

        Raises
        ------
        InputError
        """

    def alone(self, batch: Work[Result]) -> Result:
        """Compute a batch in a worker that does nothing else."""
        return self.submit(batch).result()


class InProcess(Engine):
    """No workers: batches are computed in this process, one after the other."""

    name = "this process"
    is_here = True

    def __init__(self) -> None:
        super().__init__(None, 1)

    @property
    def in_flight(self) -> int:
        """One batch."""
        return 1

    def submit(self, batch: Work[Result]) -> futures.Future[Result]:
        """Compute a batch, now."""
        future: futures.Future[Result] = futures.Future()
        future.set_result(computed(batch))
        return future


_LOST = (BrokenProcessPool, EOFError, ConnectionError)
"""Raised where a worker died, or the fork server before it could start one."""


class Processes(Engine):
    """Processes of this computer; one that dies is replaced.

    Where there is a fork server, it imports the analyses once and workers are forked from it, which
    has no threads; elsewhere each worker is started anew. Each uses one thread, ignores Ctrl-C,
    which is the parent's, and ends when the parent does, however that ended.

    Parameters
    ----------
    workers : int, optional
        Default: one a processor.
    """

    name = "processes"
    is_here = True

    def __init__(self, workers: int | None = None) -> None:
        super().__init__(None, workers or processors())
        methods = multiprocessing.get_all_start_methods()
        # On macOS a forked process may not use what the system's frameworks have begun.
        forks = "forkserver" in methods and sys.platform != "darwin"
        self._context = multiprocessing.get_context("forkserver" if forks else "spawn")
        if forks:
            # It loads the analyses while the parent asks the catalogue what there is to do.
            from multiprocessing import forkserver

            self._context.set_forkserver_preload(["analysis.fleet.worker"])
            with _single_threaded():
                forkserver.ensure_running()
        self._pool = self._started(self.workers)
        self._single: ProcessPoolExecutor | None = None

    def _started(self, workers: int) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(workers, self._context, initializer=begin_analyses)

    def submit(self, batch: Work[Result]) -> futures.Future[Result]:
        """Have a batch computed."""
        with _single_threaded():
            try:
                return self._pool.submit(computed, batch)
            except _LOST as error:
                broken: futures.Future[Result] = futures.Future()
                broken.set_exception(BrokenProcessPool(str(error)))
                return broken

    def renew(self) -> None:
        """Start a pool anew in place of the one that is broken."""
        _end(self._pool)
        self._pool = self._started(self.workers)

    def check(self) -> None:
        """Let the pool notice that a worker died while it handed on a result."""
        _break_if_dead(self._pool)

    def alone(self, batch: Work[Result]) -> Result:
        """Compute a batch in a process of its own."""
        if self._single is None:
            self._single = self._started(1)
        try:
            with _single_threaded():
                future = self._single.submit(computed, batch)
            while not futures.wait([future], PATIENCE).done:
                _break_if_dead(self._single)
            return future.result()
        except _LOST as error:
            _end(self._single)
            self._single = None
            raise BrokenProcessPool(str(error)) from error

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for pool in (self._pool, self._single):
            if pool is None:
                continue
            if kind is None:
                pool.shutdown()
            else:
                _end(pool)


def _break_if_dead(pool: ProcessPoolExecutor) -> None:
    """Kill the workers of a pool of which one is dead, so that all that it had is lost.

    The pool mostly notices by itself. Not if the worker was killed while it wrote a result: the
    pool's thread then reads the rest for ever, for this process, too, could write to that pipe.
    """
    processes = list((getattr(pool, "_processes", None) or {}).values())
    if connection.wait([process.sentinel for process in processes], 0):
        _kill(processes, getattr(pool, "_result_queue", None))


def _kill(processes: list[Any], results: Any) -> None:
    """Kill workers, and close the pipe for their results on this side."""
    for process in processes:
        with suppress(ProcessLookupError, AttributeError, ValueError):
            process.kill()
    with suppress(AttributeError, OSError):
        results._writer.close()


def _end(pool: ProcessPoolExecutor) -> None:
    """End a pool and its processes at once."""
    processes = list((getattr(pool, "_processes", None) or {}).values())
    results = getattr(pool, "_result_queue", None)
    pool.shutdown(wait=False, cancel_futures=True)
    _kill(processes, results)
    for process in processes:
        with suppress(AssertionError, ValueError):
            process.join(PATIENCE)


@contextmanager
def _single_threaded() -> Iterator[None]:
    """An environment in which processes are started whose libraries use one thread."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Dask(Engine):
    """The workers of a Dask scheduler, which may be on many computers; all must see the logs.

    Parameters
    ----------
    address : str
        Of the scheduler: ``tcp://host:8786``.

    Raises
    ------
    InputError
        If no scheduler answers there, it has no workers, or these run other versions of Python or
        Dask.
    MissingExtraError
        If the extra ``dask`` is not installed.
    """

    name = "Dask"

    def __init__(self, address: str) -> None:
        require("distributed")
        distributed = load("distributed")
        self._client = _client(distributed, address)
        try:
            known = self._client.scheduler_info(n_workers=-1)["workers"]
            if not known:
                raise InputError(
                    f"the scheduler at {address} has no workers",
                    remedy=f"start some: dask worker {address} --nworkers 2 --nthreads 1",
                )
            workers = sum(int(each["nthreads"]) for each in known.values())
            self._check_versions(address)
        except BaseException:
            self._client.close()
            raise
        super().__init__(self._client.get_executor(pure=False, retries=0), workers)
        self._killed = distributed.KilledWorker
        self._since = 0.0

    def _check_versions(self, address: str) -> None:
        """Refuse workers that cannot understand what is sent to them."""
        found = self._client.get_versions()
        own = found["client"]
        for where, other in {"scheduler": found["scheduler"], **found["workers"]}.items():
            for package in ("python", "distributed", "cloudpickle"):
                mine, theirs = (
                    (each["host"] if package == "python" else each["packages"]).get(package)
                    for each in (own, other)
                )
                if package == "python":
                    mine, theirs = (str(each).split(".")[:2] for each in (mine, theirs))
                if mine != theirs:
                    raise InputError(
                        f"the Dask at {address} does not fit: {where} has {package}"
                        f" {_text(theirs)}, this process {_text(mine)}",
                        remedy="install the same versions on all computers",
                    )

    def submit(self, batch: Work[Result]) -> futures.Future[Result]:
        """Have a batch computed."""
        assert self._executor is not None
        return self._executor.submit(computed_by_dask, batch)

    def lost_worker(self, error: BaseException) -> bool:
        """Whether a worker died, or several did of one batch."""
        return isinstance(error, self._killed | futures.CancelledError)

    def renew(self) -> None:
        """Nothing: the scheduler goes on with the other workers."""

    def note_result(self) -> None:
        """A batch came back: there are workers, and those that were missing were replaced."""
        self._since = 0.0

    def check(self) -> None:
        """Refuse to go on without the scheduler, or when it has had no workers for long.

        Raises
        ------
        InputError
        """
        remedy = "what was finished is kept: start it with its workers and update again"
        try:
            known = self._client.scheduler_info(n_workers=-1).get("workers")
        except (OSError, TimeoutError):
            known = None
        if known is None or self._client.status != "running":
            raise InputError("the Dask scheduler does not answer any more", remedy=remedy)
        self._since = 0.0 if known else self._since or time.monotonic()
        if not known and time.monotonic() - self._since > WITHOUT_WORKERS:
            raise InputError("the Dask scheduler has no workers any more", remedy=remedy)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        assert self._executor is not None
        with suppress(Exception):  # the scheduler may be gone
            self._executor.shutdown(wait=kind is None)
        self._client.close()


def _text(version: object) -> str:
    return ".".join(map(str, version)) if isinstance(version, list) else str(version)


def _client(distributed: Any, address: str) -> Any:
    """A client of a scheduler that answers."""
    try:
        return distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"no Dask scheduler answers at {address}",
            remedy="start one (dask scheduler), or give its address: --scheduler tcp://host:8786",
        ) from error


def computed_by_dask(batch: Work[Result]) -> Result:
    """`computed_elsewhere`, in a worker of Dask."""
    from distributed.worker import get_worker

    result = computed_elsewhere(batch)
    # Its profile is kept of the last minute in place of two hours. It notes what its threads call
    # 100 times a second, for the dashboard: the deeper the calls and the more of them there are,
    # the more memory that takes, about 2,400 objects a trip of a fleet.
    with suppress(ValueError):  # called by hand
        worker = get_worker()
        for name in ("profile_history", "profile_keys_history"):
            history: Any = getattr(worker, name, ())
            while len(history) > PROFILED:
                history.popleft()
    return result


class MPI(Engine):
    """Processes of an MPI job that was started by ``mpiexec -n N python -m mpi4py.futures ...``.

    A worker that dies ends the whole job, as MPI does; what was finished is kept, and the next
    update goes on with the rest.

    Raises
    ------
    InputError
        If the program was not started so.
    MissingExtraError
        If the extra ``mpi`` is not installed.
    """

    name = "MPI"

    def __init__(self) -> None:
        require("mpi4py")
        mpi = load("mpi4py.MPI")
        workers = mpi.COMM_WORLD.Get_size() - 1
        if workers < 1:
            raise InputError(
                "MPI has no workers: this is its only process",
                remedy="start it as: mpiexec -n 3 python -m mpi4py.futures -m trainlog fleet update"
                " --mpi",
            )
        executor = load("mpi4py.futures").MPIPoolExecutor()
        super().__init__(executor, workers)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        assert self._executor is not None
        self._executor.shutdown(wait=kind is None, cancel_futures=kind is not None)


@dataclass(frozen=True)
class _Attempt:
    batch: Work[Any]
    deaths: int = 0


def run(
    engine: Engine, batches: Iterator[Work[Result]], finished: Callable[[Any, Result], None]
) -> None:
    """Have batches computed, a bounded number at a time.

    Parameters
    ----------
    engine : Engine
    batches : iterator of Batch
        Asked for one by one, as there is something to do.
    finished : callable
        Is given each batch with its result, as they come. Of a trip of which workers die the result
        states so.
    """
    again: deque[_Attempt] = deque()
    running: dict[futures.Future[Result], _Attempt] = {}
    try:
        while True:
            while len(running) < engine.in_flight:
                attempt = again.popleft() if again else None
                if attempt is None:
                    batch = next(batches, None)
                    if batch is None:
                        break
                    attempt = _Attempt(batch)
                running[engine.submit(attempt.batch)] = attempt
            if not running:
                return
            done, _ = futures.wait(running, PATIENCE, futures.FIRST_COMPLETED)
            if not done:
                engine.check()
                continue
            lost = _finish(engine, done, running, finished)
            if lost:
                # All that was in flight is lost with a pool; which had the worker is not known.
                if any(isinstance(error, futures.BrokenExecutor) for _, error in lost):
                    lost += _finish(engine, set(running), running, finished)
                engine.check()
                engine.renew()
                for attempt, error in lost:
                    if attempt.deaths:
                        _one_by_one(engine, attempt.batch, finished, error)
                    else:
                        again.append(replace(attempt, deaths=1))
    finally:
        for future in running:
            # A client of a scheduler that is gone cannot: nothing is to be cancelled then.
            with suppress(Exception):
                future.cancel()


def _finish(
    engine: Engine,
    done: set[futures.Future[Result]],
    running: dict[futures.Future[Result], _Attempt],
    finished: Callable[[Any, Result], None],
) -> list[tuple[_Attempt, BaseException]]:
    """Hand on what is done; what was lost with a worker."""
    lost = []
    futures.wait(done)
    for future in done:
        attempt = running.pop(future)
        error = futures.CancelledError() if future.cancelled() else future.exception()
        if error is None:
            engine.note_result()
            finished(attempt.batch, future.result())
        elif engine.lost_worker(error):
            lost.append((attempt, error))
        else:
            raise error
    return lost


def _one_by_one(
    engine: Engine,
    batch: Work[Result],
    finished: Callable[[Any, Result], None],
    error: BaseException,
) -> None:
    """Compute the trips of a batch of which workers died, each alone."""
    for job in batch.jobs:
        single = batch.alone(job)
        for attempt in range(RAN_ALONE):
            try:
                result = engine.alone(single)
                engine.note_result()
                break
            except BaseException as found:
                if not engine.lost_worker(found):
                    raise
                engine.check()
                error = found
                if attempt + 1 == RAN_ALONE:
                    words = "the worker that computed it died each time, out of memory perhaps"
                    result = batch.died(job, f"{words} ({type(error).__name__})")
        finished(single, result)
