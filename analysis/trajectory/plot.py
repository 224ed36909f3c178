"""Pictures: a trajectory over km, and a Pareto front of energy against running time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    PURPLE,
    RED,
    SKY,
    dress,
    km_axis,
    new_figure,
    write_figure,
)
from analysis.trajectory.optimiser import Front
from analysis.trajectory.phases import Phase, phases_of
from trainlog.arrays import FloatArray, IntArray
from trainlog.railway import Line, Trajectory
from trainlog.units import JOULES_PER_KWH, KMH, PER_MILLE, clock

COLOURS = {
    Phase.MAXIMUM_TRACTION: RED,
    Phase.CRUISING: ORANGE,
    Phase.COASTING: GREEN,
    Phase.PARTIAL_BRAKING: SKY,
    Phase.MAXIMUM_BRAKING: BLUE,
}
"""Of the driving phases."""

_POINTS = 8
"""Points drawn in a cell: between nodes the square of the speed is linear, not the speed."""

_FEW = 4
"""Other configurations up to which all are drawn in colours, and the costates of each."""


def draw_trajectory(
    trajectory: Trajectory, line: Line, path: str | Path, *, row: int | None = None
) -> None:
    """Draw a trajectory as optimal train control does.

    Speed over km of every configuration under the limits, one of them in the colours of its
    driving phases; its efforts; the switching function; the gradient.

    Parameters
    ----------
    trajectory : Trajectory
    line : Line
        In the direction of travel.
    path : path
        PNG file.
    row : int, optional
        The configuration shown in colours; the one that arrives last without it.
    """
    chosen = trajectory.latest if row is None else row
    switching = trajectory.certificate.get("switching")
    heights = [3.2, 1.3, 1.1, 1.0] if switching else [3.2, 1.3, 1.0]
    figure = new_figure(11.0, 1.55 * sum(heights))
    places = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    phases = phases_of(trajectory, chosen)
    _draw_speeds(places[0], trajectory, line, chosen, phases)
    _draw_efforts(places[1], trajectory, chosen, phases)
    if switching:
        _draw_switching(places[2], trajectory, np.asarray(switching))
    _draw_gradient(places[-1], trajectory, line)
    km_axis(places[-1], line)
    km = trajectory.positions / 1e3
    places[-1].set_xlim(km[0], km[-1])
    figure.align_ylabels(places)
    figure.suptitle(_title(trajectory), x=0.01, ha="left", fontsize=11, color=INK)
    write_figure(figure, path)


def _title(trajectory: Trajectory) -> str:
    certificate = trajectory.certificate
    count = len(trajectory.configurations)
    words = (
        f"{trajectory.train} on {trajectory.line}: {clock(trajectory.running_time)},"
        f" {count} configuration{'s' * (count > 1)}"
    )
    if "energy" not in certificate:
        return words
    return (
        f"{words}\n{trajectory.energy_label} {certificate['energy'] / JOULES_PER_KWH:.1f} kWh,"
        f" {trajectory.optimality}"
    )


def _curve(trajectory: Trajectory, row: int) -> tuple[FloatArray, FloatArray]:
    """Km and km/h of a configuration, fine enough to look smooth, (n, points) cell by cell."""
    shares = np.linspace(0.0, 1.0, _POINTS)
    begin = trajectory.positions[:-1, None]
    position = begin + np.diff(trajectory.positions)[:, None] * shares
    square = trajectory.speeds[row] ** 2
    squares = square[:-1, None] + np.diff(square)[:, None] * shares
    return position / 1e3, KMH * np.sqrt(squares)


def _draw_speeds(
    axes: Axes, trajectory: Trajectory, line: Line, chosen: int, phases: IntArray
) -> None:
    start, end = trajectory.positions[[0, -1]]
    edges = line.speed_limits.positions
    edges = np.concatenate(([start], edges[(edges > start) & (edges < end)], [end]))
    axes.stairs(
        KMH * line.speed_limit(edges[:-1]), edges / 1e3, baseline=None, color=INK, linewidth=1.2
    )
    others = [row for row in range(len(trajectory.configurations)) if row != chosen]
    few = len(others) < _FEW
    for row in others:
        if few:
            axes.add_collection(_in_phases(trajectory, row, phases_of(trajectory, row), 1.1))
        else:
            km, speed = _curve(trajectory, row)
            axes.plot(km.ravel(), speed.ravel(), color=GREY, linewidth=0.6, alpha=0.6)
    axes.add_collection(_in_phases(trajectory, chosen, phases, 2.2))
    for station in line.stations:
        if start <= station.position <= end:
            axes.axvline(station.position / 1e3, color=PALE, linewidth=0.8, zorder=0)
            share = (station.position - start) / (end - start)
            axes.text(
                station.position / 1e3, 0.995, station.name, fontsize=8, color=GREY, va="top",
                ha="left" if share < 0.1 else "right" if share > 0.9 else "center",
                transform=axes.get_xaxis_transform(),
            )  # fmt: skip
    name = trajectory.configurations[chosen].name
    handles = [Line2D([], [], color=INK, linewidth=1.2, label="permitted speed")]
    handles += [
        Line2D([], [], color=COLOURS[phase], linewidth=2.2, label=phase.label)
        for phase in Phase
        if phase in phases
    ]
    if others:
        colour, width = (INK, 1.1) if few else (GREY, 0.6)
        handles.append(Line2D([], [], color=colour, linewidth=width, label="other configurations"))
    dress(axes, x="", y="km/h", title="Speed")
    axes.legend(
        handles=handles, fontsize=8, frameon=False, ncols=2, loc="lower center",
        title=f"in colours: {name}", title_fontsize=8,
    )  # fmt: skip
    axes.set_ylim(0.0, 1.1 * KMH * float(line.speed_limit(edges[:-1]).max()))


def _in_phases(trajectory: Trajectory, row: int, phases: IntArray, width: float) -> LineCollection:
    """Speed over km of a configuration, in the colours of its phases."""
    km, speed = _curve(trajectory, row)
    return LineCollection(
        list(np.stack((km, speed), axis=2)),
        colors=[COLOURS[Phase(code)] for code in phases],
        linewidths=width,
        capstyle="round",
    )


def _draw_efforts(axes: Axes, trajectory: Trajectory, chosen: int, phases: IntArray) -> None:
    km = trajectory.positions / 1e3
    net = (trajectory.tractive_effort - trajectory.braking_effort[chosen]) / 1e3
    for phase in Phase:
        shown = np.where(phases == phase, net, 0.0)
        if np.any(shown):
            axes.stairs(shown, km, fill=True, color=COLOURS[phase])
    axes.axhline(0.0, color=INK, linewidth=0.6)
    dress(axes, x="", y="kN", title="Tractive effort, braking effort below")


def _draw_switching(axes: Axes, trajectory: Trajectory, switching: FloatArray) -> None:
    middle = 0.5 * (trajectory.positions[1:] + trajectory.positions[:-1]) / 1e3
    costates = trajectory.certificate.get("costates", {})
    if 1 < len(costates) <= _FEW:
        styles = ("--", ":", "-.", (0, (6, 1)))
        for (name, costate), style in zip(costates.items(), styles, strict=False):
            axes.plot(middle, costate, color=GREY, linewidth=1.0, linestyle=style, label=name)
    axes.plot(middle, switching, color=PURPLE, linewidth=1.4, label="sum")
    if 1 < len(costates) <= _FEW:
        axes.legend(fontsize=8, frameon=False, ncols=5, loc="upper right")
    levels = trajectory.certificate.get("switching_levels", {"traction": 1.0, "braking": 0.0})
    for level in levels.values():
        axes.axhline(level, color=GREY, linewidth=0.8, linestyle="--")
    shown = np.array([*costates.values()]) if 1 < len(costates) <= _FEW else switching
    # At either end they rise or fall without bound as the speed goes to nothing.
    low, high = np.quantile(shown, (0.03, 0.97), axis=-1)
    axes.set_ylim(
        max(min(float(np.min(low)), -0.1), -3.0) - 0.4,
        min(max(float(np.max(high)), 1.2), 4.0) + 0.4,
    )
    above, below = levels["traction"], levels["braking"]
    title = (
        f"Switching function: above {above:.3g} full traction, below {below:.3g} braking,"
        " coasting between"
    )
    if "agreement" in trajectory.certificate:
        share = trajectory.certificate["agreement"]["traction"]
        title += f"; traction agrees in {100.0 * share:.1f} % of the cells"
    dress(axes, x="", y="", title=title)


def _draw_gradient(axes: Axes, trajectory: Trajectory, line: Line) -> None:
    start, end = trajectory.positions[[0, -1]]
    edges = line.gradients.positions
    edges = np.concatenate(([start], edges[(edges > start) & (edges < end)], [end]))
    gradient = PER_MILLE * line.gradient(edges[:-1])
    axes.stairs(gradient, edges / 1e3, fill=True, color=PALE)
    axes.stairs(gradient, edges / 1e3, baseline=None, color=GREY, linewidth=0.8)
    steepest = max(1.0, 1.1 * float(np.abs(gradient).max()))
    axes.set_ylim(-steepest, steepest)
    dress(axes, x="", y="‰", title="Gradient")


def draw_front(front: Front, path: str | Path) -> None:
    """Draw the least energies over the running time, with their slopes, and the price below.

    Above the running time stands the reserve over the least time of the slowest configuration.

    Parameters
    ----------
    front : Front
    path : path
        PNG file.
    """
    times, energies, prices = (
        front.times,
        front.energies / JOULES_PER_KWH,
        front.prices / JOULES_PER_KWH,
    )
    figure = new_figure(8.0, 6.5)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.0, 1.0])
    reach = 0.35 * float(max(times[-1] - times[0], 1.0)) / max(times.size - 1, 1)
    for time, energy, price in zip(times, energies, prices, strict=True):
        ends = (time - reach, time + reach)
        line = (energy + price * reach, energy - price * reach)
        above.plot(ends, line, color=ORANGE, linewidth=1.4)
    above.plot(times, energies, "o", color=BLUE, markersize=5)
    handles = [
        above.plot([], [], "o", color=BLUE, markersize=5, label="least energy")[0],
        above.plot([], [], color=ORANGE, linewidth=1.4, label="its slope, from the multipliers")[0],
        above.axvline(front.least_time, color=GREY, linewidth=0.9, linestyle="--",
                      label="least time of the slowest configuration"),
    ]  # fmt: skip
    above.legend(handles=handles, fontsize=8, frameon=False)
    first = front.trajectories[0]
    title = f"{first.train} on {first.line}: {first.energy_label}"
    dress(above, x="", y="kWh")
    least = front.least_time

    def to_reserve(time: FloatArray) -> FloatArray:
        return 1e2 * (time / least - 1.0)

    def to_time(reserve: FloatArray) -> FloatArray:
        return least * (1.0 + 1e-2 * reserve)

    reserves = above.secondary_xaxis("top", functions=(to_reserve, to_time))
    reserves.set_xlabel("reserve [%]", fontsize=9, color=GREY)
    reserves.tick_params(labelsize=8, colors=GREY)
    reserves.spines["top"].set_color(GREY)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, color=INK)
    below.plot(times, 1e3 * prices, "o-", color=BLUE, markersize=4, linewidth=1.2)
    below.set_ylim(bottom=0.0)
    dress(below, x="running time [s]", y="Wh/s", title="What a second more saves")
    below.xaxis.label.set_color(INK)
    write_figure(figure, path)
