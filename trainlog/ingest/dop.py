"""Accuracy of a fix from the dilution of precision alone, where the receiver tells no more.

A standard deviation is the dilution of precision times that of a range, about 4.2 m for a
single-frequency receiver under an open sky (Kaplan and Hegarty, Understanding GPS/GNSS, table of
the user equivalent range error: 4 to 7 m). HDOP is of both horizontal axes together: each has
1/sqrt(2) of it.
"""

HORIZONTAL_PER_HDOP = 3.0
"""Standard deviation of each horizontal axis [m] at an HDOP of 1."""

VERTICAL_PER_VDOP = 4.2
"""Standard deviation of the altitude [m] at a VDOP of 1."""
