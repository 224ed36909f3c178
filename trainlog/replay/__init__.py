"""Trips in the Rerun viewer: what is logged, how it is laid out, and how it is opened."""

# The extra is checked before the modules that import it.
# ruff: noqa: E402

from trainlog.extras import require

require("rerun")

from trainlog.replay.recording import record_replay
from trainlog.replay.viewer import has_display, open_viewer, take_picture

__all__ = ["has_display", "open_viewer", "record_replay", "take_picture"]
