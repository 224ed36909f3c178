"""The geometry of a line, learnt from the satellite fixes of trips along it."""
