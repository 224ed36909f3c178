"""What caution costs and what it buys, on the bad rail of `trainlog study map-mpc`.

    python benchmarks/map/by_days.py caution [--sigmas 0 1 2]
    python benchmarks/map/by_days.py cautious [--days 4]

``caution``: a second day with the map of the first, read more or less cautiously, on a rail that
holds as much as on the first day, and 5, 10 and 20 per cent less; a train of the least mass, which
asks for the most adhesion. ``cautious``: four days as `trainlog study map-mpc` drives them. Takes
minutes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from analysis.adhesion.condition_map import adhesion_map
from analysis.studies.hauck_2023 import run as study
from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN
from analysis.studies.hauck_2023.reference import NO_LIMIT
from analysis.studies.hauck_2023.run import (
    LAYER,
    cautious_adhesion,
    day_by_day,
    days_table,
    first_day,
    replanned,
    timetable_of,
)
from analysis.studies.hauck_2023.simulation import Run, run, with_map
from trainlog.cli.terminal import console
from trainlog.railway import StepProfile

LEVELS = (1.0, 0.95, 0.9, 0.8)
"""Of the second day's rail over the first's."""


def reported(name: str, level: float, found: Run) -> None:
    """One line a trip."""
    print(
        f"{name:12} rail x {level:.2f}: {found.slip_events:4d} slips,"
        f" {found.skid_energy / 1e6:5.2f} MJ beyond the peak,"
        f" {found.slip_energy / 1e6:5.1f} MJ of creep,"
        f" late {found.late.max():5.1f} s, mean {found.late.mean():5.2f} s",
        flush=True,
    )


def caution(known: study.Setup, sigmas: Sequence[float], folder: Path) -> None:
    """A second day, by how cautiously its map is read."""
    rail = known.rails["bad"]
    day = first_day(known.plan, rail, study.drawn_masses(1, 3).tolist(), folder, 1)
    track = adhesion_map(day.logs, layer=LAYER).track
    rails = {level: StepProfile(rail.positions, level * rail.values) for level in LEVELS}
    blind = with_map(known.plan, NO_LIMIT)
    for level, met in rails.items():
        reported("no map", level, run("day 2", blind, met, PUBLISHED_TRAIN.light))
    for each in sigmas:
        counted = cautious_adhesion(track, each)
        above = np.count_nonzero(counted.values > rail(track.centres))
        print(
            f"{each:g} sigmas: {counted.values[counted.assumed].max():.3f} assumed;"
            f" {above} of {track.bins} bins hold less than is counted on"
        )
        plan = replanned(known.plan, counted.profile)
        for level, met in rails.items():
            stops = timetable_of(known.plan)
            reported(
                f"{each:g} sigmas",
                level,
                run("day 2", plan, met, PUBLISHED_TRAIN.light, timetable=stops),
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("caution", "cautious"))
    parser.add_argument("--sigmas", type=float, nargs="+", default=[0.0, 1.0, 2.0])
    parser.add_argument("--days", type=int, default=4)
    options = parser.parse_args()
    known = study.prepared(seed=1)
    with TemporaryDirectory() as folder:
        if options.what == "caution":
            caution(known, options.sigmas, Path(folder))
            return
        rails = [known.rails["bad"]] * options.days
        masses = study.drawn_masses(1, 3).tolist()
        *_, days = day_by_day(known.plan, rails, masses, Path(folder), 1)
        console.print(days_table(days))


if __name__ == "__main__":
    main()
