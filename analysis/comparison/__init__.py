"""Trips beside each other: running time, energy and slip; the causes of lost time.

The causes stand here, so that tables of a fleet are declared without a comparison.
"""

CAUSES = {
    "start": ("later start", "earlier start"),
    "dwell": ("longer dwell", "shorter dwell"),
    "stop": ("stop that the reference does not make", "the reference stops here"),
    "held": ("held: braked to a stand or a crawl off a station", "the reference was held"),
    "limit": ("lower speed limit", "the reference had a lower limit"),
    "slip": ("slip: limited by adhesion", "the reference slipped"),
    "full effort": (
        "slower at full effort: load, power or wind",
        "the reference was slower at full effort",
    ),
    "slower": ("slower than needed", "slower than needed"),
    "faster": ("faster", "faster"),
    "recording": ("position missing or corrected", "position missing or corrected"),
}
"""Each cause in words: where time was lost, and where it was gained."""

LOST = {
    cause: f"lost_{cause.replace(' ', '_')}"
    for cause in CAUSES
    if cause not in ("start", "dwell", "stop")
}
"""Columns of the time lost against the shortest run that makes the same stops, by cause."""
