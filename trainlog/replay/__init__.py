"""Trips in the Rerun viewer: what is logged, how it is laid out, and how it is opened."""

# The extra is checked before the modules that import it.
# ruff: noqa: E402

from trainlog.extras import require

require("rerun")

from trainlog.replay.layout import scalars as scalars, write_layout as write_layout
from trainlog.replay.recording import (
    LiveReplay as LiveReplay,
    Replay as Replay,
    ReplayOptions as ReplayOptions,
    live_replay as live_replay,
    write_replay as write_replay,
)
from trainlog.replay.viewer import (
    HeadlessViewer as HeadlessViewer,
    has_display as has_display,
    headless_viewer as headless_viewer,
    open_viewer as open_viewer,
    run_viewer as run_viewer,
    take_picture as take_picture,
)
