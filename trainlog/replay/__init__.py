"""Trips in the Rerun viewer: what is logged, how it is laid out, and how it is opened."""

from trainlog.replay.recording import record_replay
from trainlog.replay.viewer import has_display, open_viewer, take_picture

__all__ = ["has_display", "open_viewer", "record_replay", "take_picture"]
