"""The log: trips as MCAP files."""

from trainlog.mcap.convert import account_of as account_of, recover as recover
from trainlog.mcap.description import (
    AttachmentDescription as AttachmentDescription,
    LogDescription as LogDescription,
    TopicDescription as TopicDescription,
    describe as describe,
)
from trainlog.mcap.foreign import (
    ForeignFrames as ForeignFrames,
    Skipped as Skipped,
    frames_of as frames_of,
)
from trainlog.mcap.reader import read_log as read_log, stream_log as stream_log
from trainlog.mcap.recorder import (
    OverloadWarning as OverloadWarning,
    Recording as Recording,
    RecordingAccount as RecordingAccount,
    record as record,
)
from trainlog.mcap.records import Account as Account, DamageWarning as DamageWarning, Loss as Loss
from trainlog.mcap.writer import LogWriter as LogWriter, write_log as write_log
