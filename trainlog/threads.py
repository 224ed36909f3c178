"""Threads of the linear algebra: one a process, as matrices here are small.

On several threads they take longer, up to ten times where the processors are busy, and their last
bits would depend on the number of processors.
"""

from __future__ import annotations

import os

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
    >>> from trainlog.threads import limit_threads
    >>> limit_threads()
    """
    for name in LINEAR_ALGEBRA:
        os.environ.setdefault(name, "1")
