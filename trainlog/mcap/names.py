"""Names of the metadata records that make an MCAP file a log of trainlog."""

FORMAT_RECORD = "trainlog.format"
"""Metadata record that says which version of the table of topics the file follows."""

TRIP_RECORD = "trainlog"
"""Metadata record that holds the trip's metadata."""

RECORDING_RECORD = "trainlog.recording"
"""Metadata record of a live recording: ``flush`` is the period [s] after which what it was given is
in the file, so the most that a crash costs. A second one, at the end, says how it ended."""

PROVENANCE_RECORD = "trainlog.provenance"
"""Metadata record that holds one JSON object a processing step, under ``0001``, ``0002`` ..."""

RECOVERY_RECORD = "trainlog.recovery"
"""Metadata record of a recovered file: one JSON object a recovery, under ``0001``, ``0002`` ...,
with the account of what was lost."""

POSITIONS_RECORD = "trainlog.positions"
"""Metadata record that holds the positions in each chunk, see `trainlog.mcap.positions`."""
