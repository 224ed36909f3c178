"""Record train trips in a standard log, learn from them, and plan robust trajectories.

    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/nonstop.mcap")      # doctest: +SKIP
    >>> trip["/train/state"].speed                            # doctest: +SKIP

Frames are pandas DataFrames by topic, indexed by UTC time, in SI units (``frame.attrs["units"]``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from trainlog.version import __version__

if TYPE_CHECKING:
    from trainlog.mcap import describe, record, recover
    from trainlog.mcap import read_log as read
    from trainlog.mcap import write_log as write

__all__ = ["__version__", "describe", "read", "record", "recover", "write"]

_LAZY = {
    "read": "read_log",
    "write": "write_log",
    "describe": "describe",
    "record": "record",
    "recover": "recover",
}


def __getattr__(name: str) -> Any:
    # Loaded on first use: the readers need pandas, which `trainlog --help` should not wait for.
    if name in _LAZY:
        from trainlog import mcap

        return getattr(mcap, _LAZY[name])
    raise AttributeError(f"module 'trainlog' has no attribute '{name}'")
