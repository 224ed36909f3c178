"""Work in other processes: prepared alike wherever they are started, ended with their parent."""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

_Shared = TypeVar("_Shared")
_Given = TypeVar("_Given")
_Made = TypeVar("_Made")

AHEAD = 3
"""Pieces of work for each process that are given out at most."""


def begin_worker() -> None:
    """Prepare a process that works for another: it lives no longer than that one.

    Ctrl-C is the parent's, which ends its workers; one that is killed leaves none behind.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)


def in_processes(
    work: Callable[[_Shared, _Given], _Made], shared: _Shared, pieces: Sequence[_Given], jobs: int
) -> Iterator[_Made]:
    """What a function makes of each piece, in their order, a bounded number at a time.

    Parameters
    ----------
    work : callable
        ``work(shared, piece)``, a function of a module.
    shared : object
        That each process is given once.
    pieces : sequence
    jobs : int
        Processes; with one, or one piece, the work is done in this process. What processes leave
        that were killed, for want of memory perhaps, is done in this one, too.

    Examples
    --------
    >>> list(in_processes(pow, 2, [1, 2, 3], jobs=1))
    [2, 4, 8]
    """
    done = 0
    if min(jobs, len(pieces)) > 1:
        with suppress(BrokenProcessPool):
            for found in _spread(work, shared, pieces, jobs):
                yield found
                done += 1
    yield from (work(shared, piece) for piece in pieces[done:])


_held: Any = None
"""What a process of `in_processes` was given once."""


def _begin(shared: object) -> None:
    global _held
    begin_worker()
    _held = shared


def _work(work: Callable[[Any, Any], Any], piece: object) -> Any:
    return work(_held, piece)


def _spread(work: Any, shared: object, pieces: Sequence[Any], jobs: int) -> Iterator[Any]:
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _begin, (shared,))
    waiting: deque[Future[Any]] = deque()
    try:
        for piece in pieces:
            waiting.append(pool.submit(_work, work, piece))
            if len(waiting) >= AHEAD * jobs:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def handled(handler: Callable[[int, Any], None], *signals: signal.Signals) -> Iterator[None]:
    """Have signals handled by a function while the block runs, in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        signals = ()
    before = [signal.signal(each, handler) for each in signals]
    try:
        yield
    finally:
        for each, former in zip(signals, before, strict=True):
            signal.signal(each, former)


# ------------------------------------------------------------------ threads of the linear algebra


LINEAR_ALGEBRA = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
"""Environment in which the libraries look for their number of threads, when they are loaded."""


def limit_threads() -> None:
    """Let the linear algebra take one thread, unless the environment states another number.

    To be called before numpy is imported.

    Examples
    --------
    >>> from trainlog.processes import limit_threads
    >>> limit_threads()
    """
    for name in LINEAR_ALGEBRA:
        os.environ.setdefault(name, "1")
