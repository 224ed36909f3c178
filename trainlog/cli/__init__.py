"""The commands, one function a verb, by the panel of `trainlog --help` they stand in."""
