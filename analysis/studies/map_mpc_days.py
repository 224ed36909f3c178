"""Two days on a bad rail: the first without a map, the second with what the first one taught."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from analysis.studies.map_mpc import NO_MAP, Plan, Run, run, with_map
from analysis.studies.map_mpc_logs import trip_of
from analysis.traction_map import update_logs
from analysis.trajectory.reference_section import adhesion_profile
from trainlog.mcap import write_log
from trainlog.railway import StepProfile, TrackConditionMap

LAYER = "wet"
"""Of the map, and weather of the logs."""

SIGMAS = 1.0
"""Below the map's estimate."""


@dataclass(frozen=True, eq=False)
class Days:
    """What two days gave; the runs of both in the order of their masses.

    Attributes
    ----------
    first, second : tuple of Run
    track : TrackConditionMap
        Built from the logs of the first day.
    known : StepProfile
        What the controllers of the second day counted on.
    logs : tuple of path
    """

    first: tuple[Run, ...]
    second: tuple[Run, ...]
    track: TrackConditionMap
    known: StepProfile
    logs: tuple[Path, ...]


def two_days(
    plan: Plan, rail: StepProfile, masses: Sequence[float], folder: Path, seed: int
) -> Days:
    """Drive without a map, build it from the logs, and drive again.

    Parameters
    ----------
    plan : tuple of Reference
    rail : StepProfile
        As it truly is, on both days.
    masses : sequence of float [kg]
    folder : path
        Where the logs go.
    seed : int
        Of the sensors' noise.
    """
    first = tuple(
        run(f"day 1, {mass / 1e3:.1f} t", with_map(plan, NO_MAP), rail, mass) for mass in masses
    )
    logs = [_written(each, folder, seed + number) for number, each in enumerate(first)]
    track, _ = update_logs(None, logs, LAYER)
    known = learnt(track)
    second = tuple(
        run(f"day 2, {mass / 1e3:.1f} t", with_map(plan, known), rail, mass) for mass in masses
    )
    logs += [_written(each, folder, seed + 100 + number) for number, each in enumerate(second)]
    return Days(first, second, track, known, tuple(logs))


def learnt(track: TrackConditionMap) -> StepProfile:
    """What a controller counts on: the map's cautious estimate, and its median where it is blank.

    Raises
    ------
    InputError
        If nothing was observed anywhere.
    """
    cautious = track.lower_bound(LAYER, track.centres, SIGMAS)
    seen = cautious[np.isfinite(cautious)]
    fallback = float(np.median(seen)) if seen.size else None
    return adhesion_profile(track, LAYER, sigmas=SIGMAS, unobserved=fallback)


def _written(found: Run, folder: Path, seed: int) -> Path:
    trip = trip_of(found, LAYER, seed)
    path = folder / f"{trip.metadata['trip']}.mcap"
    write_log(trip, path)
    return path
