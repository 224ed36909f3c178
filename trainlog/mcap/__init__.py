"""The log: trips as MCAP files."""

from trainlog.mcap.reader import read_log
from trainlog.mcap.writer import write_log

__all__ = ["read_log", "write_log"]
