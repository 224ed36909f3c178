"""Trips in the Rerun viewer: what is logged, how it is laid out, and how it is opened."""

# The extra is checked before the modules that import it.
# ruff: noqa: E402

from trainlog.extras import require

require("rerun")

from trainlog.replay.live import LiveReplay, live_replay
from trainlog.replay.log_layout import scalars, write_layout
from trainlog.replay.picture import HeadlessViewer, headless_viewer, take_picture
from trainlog.replay.recording import Replay, ReplayOptions, write_replay
from trainlog.replay.viewer import has_display, open_viewer, run_viewer

__all__ = [
    "HeadlessViewer",
    "LiveReplay",
    "Replay",
    "ReplayOptions",
    "has_display",
    "headless_viewer",
    "live_replay",
    "open_viewer",
    "run_viewer",
    "scalars",
    "take_picture",
    "write_layout",
    "write_replay",
]
