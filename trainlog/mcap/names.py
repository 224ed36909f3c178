"""Names of the metadata records that make an MCAP file a log of trainlog."""

FORMAT_RECORD = "trainlog.format"
"""Metadata record that says which version of the table of topics the file follows."""

TRIP_RECORD = "trainlog"
"""Metadata record that holds the trip's metadata."""

PROVENANCE_RECORD = "trainlog.provenance"
"""Metadata record that holds one JSON object a processing step, under ``0001``, ``0002`` ..."""
