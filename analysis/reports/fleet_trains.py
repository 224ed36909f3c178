"""What a fleet shows of its trains, as sections of its report."""

from __future__ import annotations

from analysis.fleet.plot import (
    channels_over_time,
    drift_charts,
    findings_charts,
    resistance_charts,
)
from analysis.fleet.trains import FleetTrains
from analysis.reports.page import Part, Still, Warned
from trainlog.presentation import new_table

MOST_ROWS = 60
"""Channels that drift, of which a table lists at most so many."""


def resistance_parts(found: FleetTrains) -> list[Part]:
    """Running resistance of each train against its kind."""
    pictures = [Still(resistance_charts(kind, found)) for kind in found.resistance]
    # Findings and limits have a section of their own.
    return [*_few(found), *pictures, found.trains_table()]


def unlike_parts(found: FleetTrains) -> list[Part]:
    """Trains that are not like the others, with the rate of false alarms and what is not seen."""
    unlike = found.unlike
    parts: list[Part] = [*_few(found)]
    if not unlike.findings:
        parts.append(
            f"No finding in {unlike.train_months:.1f} months of trains; what would not be seen is"
            f" below. A healthy train raises an alarm in at most {100.0 * unlike.rate:g} % of"
            " months."
        )
    else:
        parts.append(found.findings_table())
        parts.append(Still(findings_charts(found)))
    return [*parts, found.limits_table()]


def _few(found: FleetTrains) -> list[Part]:
    return [Warned(found.too_few)] if found.too_few else []


def drift_parts(found: FleetTrains) -> list[Part]:
    """What changes over months."""
    pictures: list[Part] = [
        Still(drift_charts(kind.kind, found))
        for kind in found.resistance
        if channels_over_time(kind.kind, found)
    ]
    drifting = [str(each) for each in found.drift if each.drifts]
    if not drifting:
        words = "No channel of a train or kind has a trend whose 95 % band leaves out zero."
        return [*pictures, words]
    more = len(drifting) - MOST_ROWS
    table = new_table(
        "Channels that drift", "train or kind", "channel and trend", name="drift",
        caption=f"{more:,} more" if more > 0 else None,
    )  # fmt: skip
    for words in drifting[:MOST_ROWS]:
        whose, _, rest = words.partition(": ")
        table.add_row(whose, rest)
    return [*pictures, table]
