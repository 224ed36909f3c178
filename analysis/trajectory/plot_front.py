"""Picture of a Pareto front: energy against running time, and what a second is worth."""

from __future__ import annotations

from pathlib import Path

from analysis.plotting import BLUE, GREY, INK, ORANGE, dress, new_figure, write_figure
from analysis.trajectory.front import Front

_KWH = 3.6e6


def draw_front(front: Front, path: str | Path) -> None:
    """Draw the least energies over the running time, with their slopes, and the price below.

    Parameters
    ----------
    front : Front
    path : path
        PNG file.
    """
    times, energies, prices = front.times, front.energies / _KWH, front.prices / _KWH
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
    title = f"{first.train} on {first.line}: {first.energy_told}"
    dress(above, x="", y="kWh", title=title)
    below.plot(times, 1e3 * prices, "o-", color=BLUE, markersize=4, linewidth=1.2)
    below.set_ylim(bottom=0.0)
    dress(below, x="running time [s]", y="Wh/s", title="What a second more saves")
    below.xaxis.label.set_color(INK)
    write_figure(figure, path)
