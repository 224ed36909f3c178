"""What of a recording is doubtful: damage, gaps, repairs, channels, residuals to the line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from analysis.comparison.driven import silent_rows
from analysis.resistance.recording import scale_of
from analysis.view import TripView
from trainlog.errors import TrainlogError
from trainlog.ingest.recording import STATED, report_of
from trainlog.railway.geometry import beside, track_of
from trainlog.resampling import interpolated
from trainlog.topics import GNSS_FIX, TRAIN_STATE
from trainlog.trip import Trip, seconds

CHANNELS = {
    "speed": ("/train/state", "speed"),
    "position": ("/train/state", "position"),
    "tractive effort": ("/train/controls", "tractive_effort"),
    "dynamic braking effort": ("/train/controls", "dynamic_braking_effort"),
    "pneumatic braking effort": ("/train/controls", "pneumatic_braking_effort"),
    "lever": ("/train/controls", "lever"),
    "wheel speeds": ("/train/axles", "wheel_speed_1"),
    "wheel efforts": ("/train/axles", "wheel_effort_1"),
    "fixes": ("/gnss/fix", "latitude"),
    "satellite speed": ("/gnss/motion", "speed"),
}
"""What is listed as missing where it is not recorded."""


def checked(trip: TripView) -> Mapping[str, Any]:
    """What is doubtful of a trip; a row with the names of `CHECKS`.

    Examples
    --------
    >>> from analysis.view import view_of
    >>> row = checked(view_of("sample_logs/stopping.mcap"))
    >>> row["gaps"], row["missing"], row["frozen"]
    (0, '', '')
    """
    doubts: list[str] = []
    recorded = trip.located
    row: dict[str, Any] = {"trip": trip.name, "damage": trip.damage, "duration": recorded.duration}
    row |= _gaps(recorded) | _repairs(recorded)
    _, frozen = trip.unfrozen
    row["frozen"] = "; ".join(f"{each.column} {each.note}" for each in frozen)
    row["frozen_samples"] = sum(each.count for each in frozen)
    row["missing"] = ", ".join(
        name
        for name, (topic, column) in CHANNELS.items()
        if not _is_recorded(recorded, topic, column)
    )
    row |= _scale(trip, doubts) | _beside(trip, doubts)
    return row | {"doubts": "; ".join(doubts)}


AT_ONCE = 60.0
"""Seconds that two trips of a vehicle must share for their dates to contradict each other."""


def contradicted_dates(trips: pd.DataFrame) -> pd.DataFrame:
    """Trips whose dates cannot all be right: of each the train, its start, and what speaks for it.

    A vehicle is at two places at once where two of its trips were recorded at one time, but not two
    recorders on one trip: along one line, one way, for half of the shorter one. A trip that
    ended after its log was registered ran in the future. Dates that contradict nothing may be
    wrong all the same.

    Parameters
    ----------
    trips : DataFrame
        `Catalogue.query()`.

    Examples
    --------
    >>> import pandas as pd
    >>> start = pd.to_datetime(["2026-10-01T08:00Z", "2026-10-01T08:20Z"])
    >>> trips = pd.DataFrame({"train": "flirt-01", "line": ["A - B", "B - A"], "start": start,
    ...                       "direction": "forward", "end": start + pd.Timedelta("30min"),
    ...                       "added": pd.Timestamp("2026-10-02T00:00Z"), "labels": None})
    >>> contradicted_dates(trips)["what"].tolist()
    ['dated while the train was on another trip']
    """
    found: list[tuple[str, pd.Timestamp, str]] = []
    known = trips[trips["start"].notna() & trips["end"].notna()].sort_values(["start", "end"])
    named = known[known["train"].fillna("") != ""]
    for _, rows in named.groupby("train"):
        last: Any = None
        row: Any
        for row in rows.itertuples(index=False):
            if last is not None and _are_contrary(last, row):
                found.append((row.train, row.start, "dated while the train was on another trip"))
            last = row if last is None or row.end > last.end else last
    later = known[known["end"] > known["added"]]
    found += [
        (train, start, "dated after its log was registered")
        for train, start, labels in later[["train", "start", "labels"]].to_numpy(object).tolist()
        if "simulated" not in (labels or {}).get("clock", "")
    ]
    return pd.DataFrame(found, columns=["train", "start", "what"])


def _are_contrary(first: Any, second: Any) -> bool:
    """Whether two trips of a vehicle, the second of which begins later, cannot both be so dated."""
    both = (min(first.end, second.end) - second.start).total_seconds()
    shorter = min((each.end - each.start).total_seconds() for each in (first, second))
    alike = (first.line, first.direction) == (second.line, second.direction)
    return both > AT_ONCE and not (alike and both >= 0.5 * shorter)


def _is_recorded(trip: Trip, topic: str, column: str) -> bool:
    frame = trip.topics.get(topic)
    return frame is not None and column in frame and bool(frame[column].notna().any())


def _gaps(trip: Trip) -> dict[str, Any]:
    """Pauses of the train's state, and how far it went."""
    frame = trip.topics.get(TRAIN_STATE.name)
    if frame is None or len(frame) < 2:
        return {}
    time = seconds(frame)
    silent = np.diff(time)[silent_rows(time)]
    position = frame["position"].to_numpy(np.float64)
    known = position[np.isfinite(position)]
    return {
        "gaps": int(silent.size),
        "gap_time": float(silent.sum()),
        "longest_gap": float(silent.max(initial=0.0)),
        "distance": float(np.ptp(known)) if known.size else float("nan"),
    }


def _repairs(trip: Trip) -> dict[str, Any]:
    """What ingest repaired, and what it only stated, as the provenance has it."""
    if not any(step.get("step") == "ingest" for step in trip.provenance):
        return {}
    counts = Counter[str]()
    for finding in report_of(trip).findings:
        # A fix without a position, as in a tunnel, is one that the receiver did not have.
        if finding.rule != "empty" or not finding.column.startswith("/gnss/"):
            counts[finding.rule] += finding.count
    by_rule = sorted(counts.items())
    changed = {rule: count for rule, count in by_rule if rule not in STATED}
    return {
        "repairs": sum(changed.values()),
        "repaired": ", ".join(f"{rule}={count}" for rule, count in changed.items()),
        "stated": ", ".join(f"{rule}={count}" for rule, count in by_rule if rule in STATED),
    }


def _scale(trip: TripView, doubts: list[str]) -> dict[str, Any]:
    """Measured over true speed."""
    frame = trip.trip.topics.get(TRAIN_STATE.name)
    if frame is None or len(frame) < 2:
        return {}
    try:
        scale = scale_of(trip)
    except TrainlogError as error:
        doubts.append(error.problem)
        return {}
    return {
        "speed_scale": scale.factor,
        "speed_scale_std": scale.std,
        "speed_scale_source": scale.source,
    }


def _beside(trip: TripView, doubts: list[str]) -> dict[str, Any]:
    """Where fixes lie beside the line, and along it against the recorded position."""
    frame = trip.trip.topics.get(GNSS_FIX.name)
    if frame is None or not len(frame) or TRAIN_STATE.name not in trip.trip:
        return {}
    try:
        geometry = trip.line.geometry
    except TrainlogError as error:
        doubts.append(error.problem)
        return {}
    if geometry is None:
        doubts.append("the line has no geometry to compare fixes with")
        return {}
    known = frame[frame["latitude"].notna() & frame["longitude"].notna()]
    position = interpolated(
        trip.trip[TRAIN_STATE.name], "position", pd.DatetimeIndex(known.index), 2.0
    )
    there = np.isfinite(position)
    if not there.any():
        return {}
    track = track_of(geometry)
    points = track.plane(known["latitude"].to_numpy(), known["longitude"].to_numpy())[there]
    chainage, aside = beside(track, points, position[there])
    along = chainage - position[there]
    middle = float(np.median(along))
    return {
        "fix_beside": float(np.median(np.abs(aside))),
        "fix_along": middle,
        "fix_spread": float(np.median(np.abs(along - middle))),
    }
