"""Entry point of the ``trainlog`` command: light, so that Ctrl-C ends it while the rest loads."""

from __future__ import annotations

import os
import signal


def main() -> None:
    """Load the command line and run it; Ctrl-C in between ends in one line, status 130."""
    # Not by an exception: inside an import that one may come out as another.
    signal.signal(signal.SIGINT, _leave)
    from trainlog.processes import limit_threads

    limit_threads()
    from trainlog.cli.main import main as run

    signal.signal(signal.SIGINT, signal.default_int_handler)
    run()


def _leave(*_: object) -> None:
    os.write(2, b"trainlog: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    main()
