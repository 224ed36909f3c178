"""How well the track-condition map forecasts: a rolling month, three lines, changing weather.

    python benchmarks/map/score.py [--days 30] [--every 3] [--cache FOLDER] [--picture DIR]

Each day (``--every 3``: each third) is forecast from the days before alone, in the rail condition
that came, by

- ``the map``: `ConditionLayer.expected` at noon of the day;
- ``lasting estimate``: the same maps' lasting condition, as if no spot passed;
- ``pooled``: one Gaussian field for all days, as maps were estimated before they had two time
  scales; its deviations are those it published.

All are scored on the same passages: where every one of them is known. ``of the map`` rows count
what the map alone leaves unknown. The trips, the rail with its spots and the weather are those of
`benchmarks/map/trips.py`; the definitions are in docs/track-condition-map.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pooled import pooled_estimate
from trips import Month, add_options, months

from analysis.adhesion.condition_map import empty_map, update
from analysis.charts import draw
from analysis.verification.scoring import Score
from analysis.verification.verify import (
    FIGURES,
    Demand,
    Forecaster,
    Verification,
    passages_of,
    verify,
)
from trainlog.cli.terminal import console
from trainlog.condition import layer_before
from trainlog.presentation import new_table
from trainlog.railway.condition import AdhesionEstimate, ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence
from trainlog.units import NANOSECONDS

DAY = 86_400 * NANOSECONDS


def by_map(track: TrackConditionMap) -> tuple[Forecaster, Forecaster]:
    """What lasts by the map of the days before, and what that map expects of the day."""
    made: dict[tuple[str, int], ConditionLayer | None] = {}

    def known(layer, time):
        day = int(time.value // DAY)
        if (layer, day) not in made:
            made[layer, day] = layer_before(track, day, layer)
        return made[layer, day]

    def expected(layer, time):
        layer_then = known(layer, time)
        return None if layer_then is None else layer_then.expected(time)

    return known, expected


def pooled(track: TrackConditionMap) -> Forecaster:
    """One field for all days before."""

    def expected(layer, time):
        known = track.layer(layer).evidence.between(-1, int(time.value // DAY) - 1)
        return pooled_estimate(track, layer, known) if known.days.size else None

    return expected


def in_common(forecasters: Mapping[str, Forecaster]) -> dict[str, Forecaster]:
    """The same forecasts, unknown where one of them is."""
    made: dict[tuple[str, int], dict[str, AdhesionEstimate | None]] = {}

    def limited(name: str) -> Forecaster:
        def expected(layer, time):
            if (layer, time.value) not in made:
                made[layer, time.value] = {
                    each: forecaster(layer, time) for each, forecaster in forecasters.items()
                }
            every = made[layer, time.value]
            if any(each is None for each in every.values()):
                return None
            known = np.all([each.observed for each in every.values()], axis=0)
            own = every[name]
            return AdhesionEstimate(
                own.log_mean, own.log_std, known, own.log_levels, own.probability
            )

        return expected

    return {name: limited(name) for name in forecasters}


def scored(track: TrackConditionMap, every: int) -> dict[str, Verification]:
    """All rail conditions together, by forecaster."""
    known = {name: layer.evidence for name, layer in track.layers.items()}
    first = min(int(each.days[0]) for each in known.values())
    met = [
        each
        for name, evidence in known.items()
        for each in passages_of(name, evidence)
        if each.day > first and (each.day - first) % every == 0
    ]
    demand = Demand(known.values(), track.levels)
    held = known | {"": DailyEvidence.total(known.values())}
    lasting, expected = by_map(track)
    several = in_common({"pooled": pooled(track), "lasting estimate": lasting, "the map": expected})
    several["the map, all it knows"] = expected
    return {
        name: Verification.together(
            verify(
                name,
                track,
                met,
                forecaster,
                lambda layer, day: held[layer].between(first, day - 1),
                demand,
            )
        )
        for name, forecaster in several.items()
    }


def report(month: Month, every: int, picture: Path | None) -> None:
    empty = empty_map(month.line)
    track, _ = update(empty, [drive.evidence(empty) for drive in month.drives])
    found = scored(track, every)
    title = f"{month.line.name}: {len(month.drives)} trips in {month.rail.days} days"
    table = new_table(title, "", *found)
    for row in FIGURES:
        table.add_row(row.heading, *(row.words(row.cell(each)) for each in found.values()))
    console.print(table)
    whole = found["the map, all it knows"]
    share = whole.unknown_onsets / max(whole.onsets + whole.unknown_onsets, 1)
    console.print(
        f"  of {whole.onsets + whole.unknown_onsets} onsets {share:.1%} where the map is unknown"
    )
    if picture is not None:
        score = Score(month.line.name, "the map, day by day", {"all": whole})
        draw(score, picture / f"score-{month.line.name}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_options(parser)
    parser.add_argument("--every", type=int, default=1, help="forecast only every so many days")
    parser.add_argument("--picture", type=Path, help="folder for a picture of each line")
    options = parser.parse_args()
    if options.picture is not None:
        options.picture.mkdir(parents=True, exist_ok=True)
    for month in months(options):
        report(month, options.every, options.picture)


if __name__ == "__main__":
    main()
