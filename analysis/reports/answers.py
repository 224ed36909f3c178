"""The first page of a report: trip, recording, slippery places, cost, and what to do.

Of the recording there is one verdict, with its reasons: `verdict`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from analysis.adhesion.slip import SlipAnalysis
from analysis.fleet.checks import checked
from analysis.fleet.trips import FleetTrip
from analysis.reports.page import Section
from trainlog.display import counted
from trainlog.errors import NotRecordedError
from trainlog.presentation import WordTable, new_table
from trainlog.railway.condition import TrackConditionMap
from trainlog.railway.kilometres import km_words
from trainlog.railway.line import Line
from trainlog.trip import Trip
from trainlog.units import KMH

VERDICTS = ("good", "usable with reservations", "not reliable")
"""Of a recording, from the best."""

LONG_GAP = 0.1
"""Share of the time in gaps above which a recording is not reliable."""

MANY_REPAIRS = 0.01
"""Share of the rows that ingest repaired or dropped, from which this is a reservation."""

LEAST_SPEED_OFF = 0.002
"""A recorded speed that is off by a smaller share is no doubt: wheels wear by as much."""

NEEDED = ("speed", "position")
"""Channels without which a recording is not reliable."""

SLIPPERY = 3
"""Places that are named."""


@dataclass(frozen=True)
class Verdict:
    """What to think of a recording.

    Attributes
    ----------
    level : int
        Of `VERDICTS`.
    reasons : tuple of str
        The weightiest first.
    """

    level: int
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        """The verdict with its reasons.

        Examples
        --------
        >>> str(Verdict(0, ()))
        'good: whole, without gaps, nothing doubtful'
        >>> str(Verdict(1, ("2 gaps, 31 s in all",)))
        'usable with reservations: 2 gaps, 31 s in all'
        """
        if self.level == 0:
            return "; ".join(("good: whole, without gaps, nothing doubtful", *self.reasons))
        return f"{VERDICTS[self.level]}: {'; '.join(self.reasons)}"


def verdict(trip: Trip, damage: str = "") -> Verdict:
    """Whether a recording is good, and what is doubtful about it.

    Parameters
    ----------
    trip : Trip
    damage : str
        What of its log is lost; empty if it is whole.

    Examples
    --------
    >>> import trainlog
    >>> verdict(trainlog.read("sample_logs/stopping.mcap")).level
    0
    """
    row = checked(FleetTrip(trip, damage=damage))
    found = sorted(_reasons(trip, row), key=lambda each: -each[0])
    return Verdict(max((level for level, _ in found), default=0), tuple(said for _, said in found))


def _reasons(trip: Trip, row: Mapping[str, Any]) -> Iterator[tuple[int, str]]:
    """How much each doubt weighs, and its words."""
    if row["damage"]:
        yield 1, str(row["damage"]).rstrip(".")
    gap = float(row.get("gap_time", 0.0))
    if row.get("gaps"):
        longest = float(row["longest_gap"])
        words = f"{counted(int(row['gaps']), 'gap')}, {gap:.0f} s in all, {longest:.0f} s at most"
        yield 2 if gap > LONG_GAP * float(row["duration"]) else 1, words
    if row["frozen"]:
        yield 1, f"repeats a value: {row['frozen']}"
    missing = [each for each in str(row["missing"]).split(", ") if each]
    if any(each in NEEDED for each in missing):
        yield 2, f"not recorded: {', '.join(each for each in missing if each in NEEDED)}"
    others = [each for each in missing if each not in NEEDED]
    if others:
        yield 0, f"not recorded: {', '.join(others)}"
    if row.get("repairs"):
        rows = max(sum(map(len, trip.topics.values())), 1)
        many = int(row["repairs"]) > MANY_REPAIRS * rows
        yield int(many), f"{counted(int(row['repairs']), 'repair')} by ingest ({row['repaired']})"
    off = float(row.get("speed_scale", 1.0)) - 1.0
    if abs(off) > max(1.96 * float(row.get("speed_scale_std", 0.0)), LEAST_SPEED_OFF):
        yield 1, f"recorded speed is {off:+.1%} off, by {row['speed_scale_source']}"
    if "assumed" in trip.metadata.get("clock", ""):
        yield 1, f"clock: {trip.metadata['clock']}"


def answers(rows: Iterable[tuple[str, str | Sequence[str]]]) -> WordTable:
    """The questions of a first page with their answers; those without one are left out."""
    table = new_table("", "", "", show_header=False)
    for question, said in rows:
        words = [said] if isinstance(said, str) else list(said)
        if any(words):
            table.add_row(question, "\n".join(filter(None, words)))
    return table


def summary_section(
    driven: str | Sequence[str],
    recording: str | Sequence[str],
    slippery: str | Sequence[str],
    cost: str | Sequence[str],
    steps: Sequence[str],
) -> Section:
    """The first page of a report."""
    return Section(
        "Summary",
        [
            answers(
                [
                    ("what was driven", driven),
                    ("is the recording good", recording),
                    ("where is it slippery", slippery),
                    ("what did it cost", cost),
                    ("what to do", steps),
                ]
            )
        ],
    )


def slip_words(found: SlipAnalysis | Exception, line: Line | None) -> list[str]:
    """Where axles slipped most, in words: places with the largest slip, apart from each other."""
    if isinstance(found, NotRecordedError) and found.topic == "/train/axles":
        return ["not known: no wheel speeds recorded"]
    if isinstance(found, Exception):
        return [f"not known: {found}"]
    events = found.events
    if not len(events):
        return ["no axle slipped"]
    words = [f"{counted(len(events), 'slip event')}; the largest:"]
    taken = list[float]()
    worst = events.assign(_size=events["peak_slip"].abs()).sort_values("_size", ascending=False)
    for row in worst.to_dict("records"):
        place = float(row["position"])
        if not np.isfinite(place) or any(abs(place - other) < 250.0 for other in taken):
            continue
        taken.append(place)
        adhesion = f", adhesion {abs(row['adhesion']):.2f}" if row["measured"] else ""
        words.append(f"{km_words(line, place)}: {KMH * row['_size']:.0f} km/h{adhesion}")
        if len(taken) == SLIPPERY:
            break
    return words


def map_words(track: TrackConditionMap, bins: pd.DataFrame, places: Sequence[float]) -> list[str]:
    """The lowest places of a map with their bands, in words."""
    if not places:
        return ["not known: nothing was observed"]
    words = []
    for place in places[:SLIPPERY]:
        here = bins[(bins["start_m"] <= place) & (bins["end_m"] > place) & bins["observed"]]
        row = here.sort_values("expected_low").to_dict("records")[0]
        near = f", {row['near']}" if row["near"] else ""
        band = f"{row['expected_low']:.3f} to {row['expected_high']:.3f}"
        words.append(f"km {row['start_km']:.3f}{near}: {band} on {row['layer']} rail")
    seen = ", ".join(
        f"{np.mean(layer.observed):.0%} of the line on {name} rail"
        for name, layer in track.layers.items()
    )
    return [*words, f"observed: {seen}; elsewhere it is not known"]
