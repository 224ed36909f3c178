"""The track-condition map that a run counts on, as it was known before the run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from trainlog.cli.terminal import console

if TYPE_CHECKING:
    from pandas import Timestamp

    from trainlog.railway import TrackConditionMap


def map_of_run(condition: Path, at: str | None) -> tuple[TrackConditionMap, Timestamp | None]:
    """The map, made of the evidence of the days before the time of the run alone, and that time.

    What is left out is printed. Without a time all evidence counts.

    Raises
    ------
    InputError
        If the file is no map, the time is none, or no evidence is of a day before.
    """
    from trainlog.condition import known_before, later_evidence
    from trainlog.formats.condition import read_map
    from trainlog.spans import utc

    time = None if at is None else utc(at)
    track = read_map(condition)
    if time is None:
        return track, None
    later = later_evidence(track, time)
    if later:
        console.print(
            f"  {condition.name}: read without the {later}, which is not from before the day of"
            " --at (UTC)",
            highlight=False,
        )
    return known_before(track, time), time
