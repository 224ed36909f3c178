"""The first page of a report: trip, recording, slippery places, cost, and what to do.

Of the recording there is one verdict, with its reasons: `verdict`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from analysis.adhesion.map_plot import lowest_bins
from analysis.adhesion.slip import SlipAnalysis
from analysis.fleet.checks import checked
from analysis.reports.page import Section
from analysis.view import TripView, view_of
from trainlog.display import counted
from trainlog.errors import NotRecordedError
from trainlog.ingest.recording import CLOCK_RULES
from trainlog.presentation import facts_table
from trainlog.railway.line import Line, km_words
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

SPEED_OFF = f"recorded speed off by more than its band and {100.0 * LEAST_SPEED_OFF:g} %"

CLOCK_SET = "doubtful clock: speed not compared with distance"

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


def verdict(trip: Trip | TripView) -> Verdict:
    """Whether a recording is good, and what is doubtful about it.

    Parameters
    ----------
    trip : Trip or TripView

    Examples
    --------
    >>> import trainlog
    >>> verdict(trainlog.read("sample_logs/stopping.mcap")).level
    0
    """
    view = view_of(trip)
    trip, row = view.trip, checked(view)
    samples = max(sum(map(len, trip.topics.values())), 1)
    found = [each for each in doubts(row, samples) if each.words]
    if "assumed" in trip.metadata.get("clock", ""):
        found.append(Doubt(1, (), f"clock: {trip.metadata['clock']}"))
    if "motion_evidence" in trip.metadata:
        found.append(Doubt(2, (), trip.metadata["motion_evidence"]))
    found.sort(key=lambda each: -each.level)
    level = max((each.level for each in found), default=0)
    return Verdict(level, tuple(each.words for each in found))


class Doubt(NamedTuple):
    """Something doubtful of a recording.

    Attributes
    ----------
    level : int
        Of `VERDICTS`, at best.
    kinds : tuple of str
        By which recordings are counted.
    words : str
        Empty where it is not stated of a single recording.
    """

    level: int
    kinds: tuple[str, ...]
    words: str = ""


def doubts(row: Mapping[Any, Any], samples: float = np.inf) -> Iterator[Doubt]:
    """The doubts of a recording, by its checks (`analysis.fleet.checks`) and number of samples."""
    known = {name: value for name, value in row.items() if value == value}
    if known["damage"]:
        yield Doubt(1, ("damaged log",), str(known["damage"]).rstrip("."))
    if known.get("gaps"):
        gap, longest = known["gap_time"], known["longest_gap"]
        words = f"{counted(int(known['gaps']), 'gap')}, {gap:.0f} s in all, {longest:.0f} s at most"
        level = 2 if gap > LONG_GAP * known["duration"] else 1
        yield Doubt(level, ("gaps in the train's state",), words)
    if known["frozen"]:
        kinds = [f"repeats a value: {each}" for each in str(known["frozen"]).split(", ")]
        yield Doubt(1, tuple(kinds), f"repeats a value: {known['frozen']}")
    missing = [each for each in str(known["missing"]).split(", ") if each]
    for level, needed in ((2, True), (0, False)):
        names = [each for each in missing if (each in NEEDED) == needed]
        if names:
            kinds = [f"not recorded: {each}" for each in names]
            yield Doubt(level, tuple(kinds), f"not recorded: {', '.join(names)}")
    if known.get("repairs"):
        many = known["repairs"] > MANY_REPAIRS * samples
        words = f"{counted(int(known['repairs']), 'repair')} by ingest ({known['repaired']})"
        yield Doubt(int(many), ("repaired by ingest",), words)
    off = float(known.get("speed_scale", 1.0)) - 1.0
    if abs(off) > max(1.96 * float(known.get("speed_scale_std", 0.0)), LEAST_SPEED_OFF):
        words = f"recorded speed is {off:+.1%} off, compared with {known['speed_scale_source']}"
        yield Doubt(1, (SPEED_OFF,), words)
    met = [each for name in ("repaired", "stated") for each in str(known.get(name, "")).split(", ")]
    clock = [each for each in met if each.partition("=")[0] in CLOCK_RULES]
    if clock and known.get("speed_scale_source") == "nothing":
        # A step of the distance may be one of the clock, or of the counter.
        steps = " or the counter of the distance" * all("position_steps" in each for each in clock)
        words = "the recorded distance does not show whether the recorded speed is right:"
        yield Doubt(1, (CLOCK_SET,), f"{words} the clock{steps} is doubtful ({', '.join(clock)})")
    if known["doubts"]:
        yield Doubt(0, ("not all could be checked",))


def summary_section(
    driven: str | Sequence[str],
    recording: str | Sequence[str],
    slippery: str | Sequence[str],
    cost: str | Sequence[str],
    steps: Sequence[str],
) -> Section:
    """The first page of a report; questions without an answer are left out."""
    answers = {
        "trips": driven,
        "recording": recording,
        "slippery places": slippery,
        "energy": cost,
        "next steps": steps,
    }
    rows = {
        question: "\n".join(filter(None, [said] if isinstance(said, str) else said))
        for question, said in answers.items()
    }
    known = {question: words for question, words in rows.items() if words}
    return Section("Summary", [facts_table("", known)])


def verdict_counts(levels: Iterable[int]) -> str:
    """How many recordings have each verdict, in words."""
    counts = Counter(levels)
    words = [f"{counts[level]:,} {name}" for level, name in enumerate(VERDICTS) if counts[level]]
    return ", ".join(words)


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


def map_words(bins: pd.DataFrame) -> list[str]:
    """The lowest places of rows of `bins_table` with their bands, in words."""
    several = len(set(bins["line"])) > 1
    words = [
        f"{row['line']}, " * several + f"km {row['start_km']:.3f}{near}:"
        f" {row['expected_low']:.3f} to {row['expected_high']:.3f} on {row['layer']} rail"
        for row in lowest_bins(bins, SLIPPERY).to_dict("records")
        for near in [f", {row['near']}" if row.get("near") else ""]
    ]
    if not words:
        return ["not known: nothing was observed"]
    seen = ", ".join(
        f"{share:.0%} of the {'lines' if several else 'line'} on {layer} rail"
        for layer, share in bins.groupby("layer", sort=False)["observed"].mean().items()
    )
    return [*words, f"observed: {seen}; elsewhere it is not known"]
