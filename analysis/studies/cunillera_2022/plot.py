"""Charts of one configuration's optimum, driven by the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.charts import BLUE, GREEN, GREY, RED, Chart, Curve, Panel, Rule
from analysis.studies.cunillera_2022.model import Instance, driven
from trainlog.railway import Configuration, Trajectory
from trainlog.units import KMH


def others_charts(
    instance: Instance, nominal: Trajectory, robust: Trajectory, chosen: Sequence[Configuration]
) -> list[Chart]:
    """How far each configuration falls behind under either trajectory's efforts.

    Parameters
    ----------
    instance : Instance
    nominal, robust : Trajectory
        For the nominal configuration alone, and for all.
    chosen : sequence of Configuration
    """
    charts = list[Chart]()
    colours = dict(zip((each.name for each in chosen), (GREEN, BLUE, RED), strict=False))
    for plan, what in ((nominal, "the nominal configuration alone"), (robust, "all")):
        found = driven(instance, plan, chosen)
        km = plan.positions / 1e3
        # Behind the nominal configuration on its own optimum.
        timetable = np.interp(plan.positions, nominal.positions, nominal.times[0])
        late = [
            Curve(name, km, times - timetable, colour)
            for times, (name, colour) in zip(found.times, colours.items(), strict=False)
        ]
        speeds = [
            Curve("", km, KMH * speed, colour)
            for speed, colour in zip(found.speeds, colours.values(), strict=False)
        ]
        limit = [KMH * instance.final_speed]
        speeds.append(Curve("at most", km[-1:], limit, GREY, "points", width=3.0, mark="v"))
        title = f"Optimal for {what}: behind the timetable"
        rules = [Rule(0.0, GREY, dash="--")]
        charts += [
            Chart("km", [Panel("s", late, 1.2, title, rules=rules)], width=0.7),
            Chart("km", [Panel("km/h", speeds, 1.2, "the last kilometre", limits=(0.0, 100.0))],
                  span=(km[-1] - 1.0, km[-1] + 0.05), beside=True, width=0.3),
        ]  # fmt: skip
    return charts
