"""How far long work is: stated by what does the work, shown by whoever listens.

Computing states its progress with `task` or `track` and neither knows nor needs who shows it. The
command line listens and draws a bar; without a listener nothing happens and nothing is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, TypeVar

Item = TypeVar("Item")


class Step(Protocol):
    """States how far a task is."""

    def __call__(
        self, done: float | None = None, total: float | None = None, note: str | None = None
    ) -> None:
        """State what is done, how much there is in all where that is known by now, and a note."""


Listener = Callable[[str, float | None, str], AbstractContextManager[Step]]
"""Shows a task: its name, how much there is to do (None: not known), and the unit of both."""

_listener: Listener | None = None
_steps: list[Step] = []
"""Of the tasks that run, the innermost last."""


@contextmanager
def task(name: str, total: float | None = None, unit: str = "") -> Iterator[Step]:
    """A piece of long work; what is yielded is called with how much of it is done.

    Parameters
    ----------
    name : str
        What is being done: ``"reading run.csv"``.
    total : float, optional
        How much there is to do, if it is known.
    unit : str
        Of `total` and of what is done: ``"B"`` are bytes, ``"s"`` seconds, ``"trip"`` trips.

    Examples
    --------
    >>> with task("driving", total=2, unit="trip") as step:
    ...     for trip in range(2):
    ...         step(trip + 1, note=f"trip {trip + 1}")
    """
    if _listener is None:
        yield lambda *_, **__: None
        return
    with _listener(name, total, unit) as step:
        _steps.append(step)
        try:
            yield step
        finally:
            _steps.remove(step)


def note(words: str) -> None:
    """State where the innermost task is, from code that does not know which one it is.

    Examples
    --------
    >>> with task("optimising"):
    ...     note("round 2")
    """
    if _steps:
        _steps[-1](note=words)


def track(
    items: Iterable[Item], name: str, unit: str = "", *, total: float | None = None
) -> Iterator[Item]:
    """The items one by one, stating how many are done.

    Examples
    --------
    >>> list(track(["a", "b"], "reading", "log"))
    ['a', 'b']
    """
    if total is None and isinstance(items, Collection):
        total = len(items)
    with task(name, total, unit) as step:
        for done, item in enumerate(items, start=1):
            yield item
            step(done)


@contextmanager
def shown_by(listener: Listener | None) -> Iterator[None]:
    """Have progress shown by `listener` while the block runs.

    Examples
    --------
    >>> @contextmanager
    ... def listen(name, total, unit):
    ...     yield lambda done=None, total=None, note=None: print(name, done, unit)
    >>> with shown_by(listen):
    ...     _ = list(track("ab", "reading", "log"))
    reading 1 log
    reading 2 log
    """
    global _listener
    before, _listener = _listener, listener
    try:
        yield
    finally:
        _listener = before
