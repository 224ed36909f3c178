"""Causes of lost time, apart, so that tables of a fleet are declared without a comparison."""

from __future__ import annotations

CAUSES = {
    "start": "later start",
    "dwell": "longer dwell",
    "stop": "stop that the reference does not make",
    "held": "held: braked to a stand or a crawl off a station",
    "limit": "lower speed limit",
    "slip": "slip: limited by adhesion",
    "full effort": "slower at full effort: load, power or wind",
    "slower": "slower than needed",
    "faster": "faster",
    "recording": "position missing or corrected",
}
"""Each cause in words."""

GAINED = CAUSES | {
    "start": "earlier start",
    "dwell": "shorter dwell",
    "stop": "the reference stops here",
    "held": "the reference was held",
    "limit": "the reference had a lower limit",
    "slip": "the reference slipped",
    "full effort": "the reference was slower at full effort",
}
"""The same where time was gained."""

LOST = {
    cause: f"lost_{cause.replace(' ', '_')}"
    for cause in CAUSES
    if cause not in ("start", "dwell", "stop")
}
"""Columns of the time lost against the shortest run that makes the same stops, by cause."""
