"""Accuracy of a fix from the dilution of precision alone, where the receiver tells no more.

A standard deviation is the dilution of precision times that of a range, for which 4.2 m are
assumed: a single-frequency receiver under a mostly open sky. HDOP is of both horizontal axes
together: each has 1/sqrt(2) of it.
"""

HORIZONTAL_PER_HDOP = 3.0
"""Standard deviation of each horizontal axis [m] at an HDOP of 1."""

VERTICAL_PER_VDOP = 4.2
"""Standard deviation of the altitude [m] at a VDOP of 1."""
