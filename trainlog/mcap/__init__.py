"""The log: trips as MCAP files."""
