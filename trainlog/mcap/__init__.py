"""The log: trips as MCAP files."""

from trainlog.mcap.account import Account, DamageWarning, Loss
from trainlog.mcap.description import (
    AttachmentDescription,
    LogDescription,
    TopicDescription,
    describe,
)
from trainlog.mcap.foreign import ForeignFrames, Skipped, frames_of
from trainlog.mcap.reader import read_log, stream_log
from trainlog.mcap.recorder import OverloadWarning, Recording, RecordingAccount, record
from trainlog.mcap.recovery import account_of, recover
from trainlog.mcap.writer import LogWriter, write_log

__all__ = [
    "Account",
    "AttachmentDescription",
    "DamageWarning",
    "ForeignFrames",
    "LogDescription",
    "LogWriter",
    "Loss",
    "OverloadWarning",
    "Recording",
    "RecordingAccount",
    "Skipped",
    "TopicDescription",
    "account_of",
    "describe",
    "frames_of",
    "read_log",
    "record",
    "recover",
    "stream_log",
    "write_log",
]
