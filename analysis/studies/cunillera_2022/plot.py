"""Picture of one configuration's optimum, driven by the others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from analysis.charts import BLUE, GREEN, GREY, RED, dress, new_figure, write_figure
from analysis.studies.cunillera_2022.model import Driven, Instance, driven
from trainlog.railway import Configuration, Trajectory
from trainlog.units import KMH

_COLOURS = (GREEN, BLUE, RED)


def draw_others(
    instance: Instance,
    nominal: Trajectory,
    robust: Trajectory,
    chosen: Sequence[Configuration],
    path: str | Path,
) -> None:
    """Draw how far each configuration falls behind under either trajectory's efforts.

    Parameters
    ----------
    instance : Instance
    nominal, robust : Trajectory
        For the nominal configuration alone, and for all.
    chosen : sequence of Configuration
    path : path
        PNG file.
    """
    figure = new_figure(11.0, 7.0)
    places = figure.subplots(2, 2, sharex="col", sharey="col", width_ratios=[3.0, 1.0])
    for row, plan in enumerate((nominal, robust)):
        found = driven(instance, plan, chosen)
        what = "the nominal configuration alone" if row == 0 else "all"
        _draw_lateness(places[row, 0], plan, nominal, found, chosen)
        _draw_end(places[row, 1], plan, found, instance)
        dress(places[row, 0], x="", y="s", title=f"Optimal for {what}: behind the timetable")
        dress(places[row, 1], x="", y="km/h", title="the last kilometre")
    for axes in places[1]:
        axes.set_xlabel("km")
    places[0, 0].legend(fontsize=8, frameon=False, loc="upper left")
    places[0, 1].legend(fontsize=8, frameon=False, loc="upper right")
    write_figure(figure, path)


def _draw_lateness(
    axes: Axes,
    plan: Trajectory,
    nominal: Trajectory,
    found: Driven,
    chosen: Sequence[Configuration],
) -> None:
    """Time behind the nominal configuration on its own optimum."""
    km = plan.positions / 1e3
    timetable = np.interp(plan.positions, nominal.positions, nominal.times[0])
    for times, each, colour in zip(found.times, chosen, _COLOURS, strict=False):
        axes.plot(km, times - timetable, color=colour, linewidth=1.6, label=each.name)
    axes.axhline(0.0, color=GREY, linewidth=0.8, linestyle="--")


def _draw_end(axes: Axes, plan: Trajectory, found: Driven, instance: Instance) -> None:
    km = plan.positions / 1e3
    for speeds, colour in zip(found.speeds, _COLOURS, strict=False):
        axes.plot(km, KMH * speeds, color=colour, linewidth=1.6)
    axes.plot(km[-1], KMH * instance.final_speed, "v", color=GREY, markersize=7, label="at most")
    axes.set_xlim(km[-1] - 1.0, km[-1] + 0.05)
    axes.set_ylim(0.0, 100.0)
