"""The harness of kills: processes forked from one that has imported everything, and what they did.

`Forked` is a process that works; what a `Piped` one prints is read from a pipe, and a `Watched` one
notes the points that it passes in a file that outlasts it, and may be ordered to end at one.
They are forked by functions that tests call `in_own_process`.
"""

import json
import mmap
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

PATIENCE = 600.0
"""How long anything may take on the busiest machine [s]; longer takes only what hangs."""

TESTS = Path(__file__).parent


def in_own_process(function: str, *given: object) -> tuple[Any, str]:
    """What a function of a module of the tests gives in a process of its own; its complaints."""
    module, _, name = function.partition(".")
    code = f"import json, sys, {module} as m; print(json.dumps(m.{name}(*json.loads(sys.argv[1]))))"
    path = os.pathsep.join(map(str, (TESTS, TESTS.parent)))
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(given, default=str)],
        capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": path, "COLUMNS": "200"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


class Forked:
    """A process forked from this one; asked, signalled and awaited like a `subprocess.Popen`."""

    def __init__(self, work: Callable[[], object]) -> None:
        self.returncode: int | None = None
        self.pid = os.fork()
        if self.pid:
            return
        status = 1
        try:
            status = int(work() or 0)  # type: ignore[call-overload]
        except BaseException:  # noqa: BLE001 - the child must not go on as the parent
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)

    def poll(self) -> int | None:
        """Its exit status if it has ended, negative if it was killed."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send it a signal, if it has not ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def wait(self, patience: float = PATIENCE) -> int:
        """Its exit status when it has ended; it is killed if it does not end."""
        until = time.monotonic() + patience
        while (status := self.poll()) is None:
            if time.monotonic() > until:
                os.kill(self.pid, signal.SIGKILL)
                raise TimeoutError(f"process {self.pid} does not end")
            time.sleep(0.002)
        return status


class Piped(Forked):
    """A process that does some work; what it prints is read from a pipe."""

    def __init__(self, work: Callable[[], object], complaints: Path | None = None) -> None:
        self.shown = b""
        self.pipe, write = os.pipe()
        errors = -1 if complaints is None else os.open(complaints, os.O_WRONLY | os.O_CREAT)

        def printing() -> object:
            os.dup2(write, 1)
            if errors >= 0:
                os.dup2(errors, 2)
            return work()

        super().__init__(printing)
        os.close(write)
        if errors >= 0:
            os.close(errors)

    def read(self) -> bool:
        """Read what it has printed; False when it has ended."""
        data = os.read(self.pipe, 65_536)
        self.shown += data
        return bool(data)

    def end(self) -> int:
        """Read the rest; its exit status, negative if it was killed."""
        while self.read():
            pass
        os.close(self.pipe)
        return self.wait()

    @property
    def lines(self) -> list[str]:
        """The lines that it printed whole."""
        return self.shown.decode().split("\n")[:-1]


class Passed:
    """How often a process passed each point, and the last of them, in a file that outlasts it."""

    def __init__(self, path: Path, points: Sequence[str]) -> None:
        self._points = tuple(points)
        path.write_bytes(bytes(4 * (len(points) + 1)))
        self._stream = path.open("r+b")
        self._map = mmap.mmap(self._stream.fileno(), 0)
        self._view = memoryview(self._map).cast("I")
        self.order: tuple[str, int] | None = None

    def at(self, point: str) -> None:
        """Note a point, and end there if that was ordered."""
        number = self._points.index(point)
        self._view[number] += 1
        self._view[len(self._points)] = number
        if self.order == (point, self._view[number]):
            os.kill(os.getpid(), signal.SIGKILL)

    def note(self, owner: Any, name: str, point: str, *, after: bool = True) -> None:
        """Note the point after each call of a function of `owner`, or before it."""
        inner = getattr(owner, name)

        def outer(*given: Any, **named: Any) -> Any:
            if not after:
                self.at(point)
            found = inner(*given, **named)
            if after:
                self.at(point)
            return found

        setattr(owner, name, outer)

    @property
    def total(self) -> int:
        return sum(self._view[: len(self._points)])

    @property
    def last(self) -> str:
        """The last point; empty if it passed none."""
        return self._points[self._view[len(self._points)]] if self.total else ""


class Watched(Forked):
    """A process that notes what it passes, and ends at a point if that is ordered."""

    def __init__(self, folder, points, watch, work, order=None):
        self.passed = Passed(folder / f"passed-{time.monotonic_ns()}", points)
        self.passed.order = order

        def watched() -> None:
            watch(self.passed)
            work()

        super().__init__(watched)

    def kill_after(self, points: int, within: float) -> None:
        """Kill it a moment after it passed so many points, or let it end."""
        while self.passed.total < points and self.poll() is None:
            time.sleep(0.001)
        time.sleep(within)
        self.send_signal(signal.SIGKILL)
