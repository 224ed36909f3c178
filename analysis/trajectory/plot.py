"""Charts: a trajectory over km, and the least energy over the running time."""

from __future__ import annotations

import numpy as np

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    Chart,
    Curve,
    Panel,
    Rule,
    gradient_panel,
    limit_curve,
    rows_to_draw,
    worded,
)
from analysis.trajectory.instructions import Phase, phases_of
from analysis.trajectory.optimiser import Front
from trainlog.arrays import FloatArray, IntArray
from trainlog.formats.railway import line_of_plan
from trainlog.railway import Line, Trajectory
from trainlog.railway.line import in_km
from trainlog.units import JOULES_PER_KWH, KMH, clock

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
"""Other configurations up to which the costates of each are drawn."""


def trajectory_charts(
    trajectory: Trajectory, *, line: Line | None = None, row: int | None = None
) -> list[Chart]:
    """A trajectory as optimal train control draws it.

    Speed over km of every configuration under the limits, one of them in the colours of its
    driving phases; its efforts; the switching function; the gradient.

    Parameters
    ----------
    trajectory : Trajectory
    line : Line, optional
        In the direction of travel: gives limits, stations and gradients; default: the one that it
        was planned on.
    row : int, optional
        The configuration shown in colours; the one that arrives last without it.
    """
    line = line_of_plan(trajectory) if line is None else line
    chosen = trajectory.latest if row is None else row
    phases = phases_of(trajectory, chosen)
    panels = [_speeds(trajectory, line, chosen, phases), _efforts(trajectory, chosen, phases)]
    switching = trajectory.certificate.get("switching")
    if switching:
        panels.append(_switching(trajectory, np.asarray(switching)))
    start, end = trajectory.positions[[0, -1]].tolist()
    if line is not None:
        panels.append(gradient_panel(line, start, end))
    return [
        Chart(
            "km in the direction of travel",
            panels,
            span=(start / 1e3, end / 1e3),
            line=line,
            title=_title(trajectory),
        )
    ]


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


def _fine(trajectory: Trajectory, row: int) -> tuple[FloatArray, FloatArray]:
    """Km and km/h of a configuration, fine enough to look smooth, (n, points) cell by cell."""
    shares = np.linspace(0.0, 1.0, _POINTS)
    begin = trajectory.positions[:-1, None]
    position = begin + np.diff(trajectory.positions)[:, None] * shares
    square = trajectory.speeds[row] ** 2
    squares = square[:-1, None] + np.diff(square)[:, None] * shares
    return position / 1e3, KMH * np.sqrt(squares)


def _speeds(trajectory: Trajectory, line: Line | None, chosen: int, phases: IntArray) -> Panel:
    speeds, km = KMH * trajectory.speeds, trajectory.positions / 1e3
    low, high = speeds.min(axis=0), speeds.max(axis=0)
    rows = rows_to_draw(speeds[chosen], most=1_500)
    hover = {
        "km": worded("{:.3f}", in_km(line, trajectory.positions[rows])),
        "time": [clock(each) for each in trajectory.times[chosen][rows].tolist()],
        "speed": worded("{:.1f} km/h", speeds[chosen][rows]),
        "of all configurations": worded("{:.1f} to {:.1f} km/h", low[rows], high[rows]),
    }
    name = trajectory.configurations[chosen].name
    many = len(trajectory.configurations) > 1
    ends = trajectory.positions[[0, -1]].tolist()
    curves = list[Curve]()
    if line is not None:
        curves.append(limit_curve(line, *ends))
    curves.append(
        Curve("all configurations" * many, km[rows], speeds[chosen][rows], GREY, "line", low[rows],
              high[rows], hover, 0.8)
    )  # fmt: skip
    place, speed = _fine(trajectory, chosen)
    for phase in Phase:
        if phase in phases:
            shown = np.where((phases == phase)[:, None], speed, np.nan)
            curves.append(
                Curve(phase.label, place.ravel(), shown.ravel(), COLOURS[phase], width=2.2)
            )
    words = f"Speed; in colours: {name}" if many else "Speed"
    return Panel("km/h", curves, 1.6, words, from_zero=True)


def _efforts(trajectory: Trajectory, chosen: int, phases: IntArray) -> Panel:
    edges = trajectory.positions / 1e3
    net = (trajectory.tractive_effort - trajectory.braking_effort[chosen]) / 1e3
    ends = np.repeat(edges, 2)[1:-1]
    curves = []
    for phase in Phase:
        shown = np.where(phases == phase, net, 0.0)
        if np.any(shown):
            curves.append(Curve("", ends, np.repeat(shown, 2), COLOURS[phase], "area"))
    return Panel(
        "kN", curves, 0.65, "Tractive effort, braking effort below", rules=[Rule(0.0, width=0.6)]
    )


def _switching(trajectory: Trajectory, switching: FloatArray) -> Panel:
    middle = 0.5 * (trajectory.positions[1:] + trajectory.positions[:-1]) / 1e3
    costates = trajectory.certificate.get("costates", {})
    each = costates if 1 < len(costates) <= _FEW else {}
    styles = ("--", ":", "-.", "--")
    curves = [
        Curve(name, middle, costate, GREY, width=1.0, dash=style)
        for (name, costate), style in zip(each.items(), styles, strict=False)
    ]
    curves.append(Curve("sum" if each else "", middle, switching, PURPLE, width=1.4))
    levels = trajectory.certificate.get("switching_levels", {"traction": 1.0, "braking": 0.0})
    shown = np.array([*each.values()]) if each else switching
    # At either end they rise or fall without bound as the speed goes to nothing.
    low, high = np.quantile(shown, (0.03, 0.97), axis=-1)
    title = (
        f"Switching function: above {levels['traction']:.3g} full traction, below"
        f" {levels['braking']:.3g} braking, coasting between"
    )
    if "agreement" in trajectory.certificate:
        share = trajectory.certificate["agreement"]["traction"]
        title += f"; traction agrees in {100.0 * share:.1f} % of the cells"
    limits = (
        max(min(float(np.min(low)), -0.1), -3.0) - 0.4,
        min(max(float(np.max(high)), 1.2), 4.0) + 0.4,
    )
    rules = [Rule(level, GREY, dash="--") for level in levels.values()]
    return Panel("", curves, 0.6, title, limits=limits, rules=rules)


def front_charts(front: Front) -> list[Chart]:
    """The least energies over the running time, with their slopes, and the price below.

    Above the running time stands the reserve over the least time of the slowest configuration.
    """
    times = front.times
    energies, prices = (each / JOULES_PER_KWH for each in (front.energies, front.prices))
    reach = 0.35 * float(max(times[-1] - times[0], 1.0)) / max(times.size - 1, 1)
    gap = np.full(times.size, np.nan)
    ends = np.column_stack((times - reach, times + reach, gap)).ravel()
    slopes = np.column_stack((energies + prices * reach, energies - prices * reach, gap)).ravel()
    hover = {
        "running time": [clock(each) for each in times.tolist()],
        "reserve": worded("{:.1f} %", [100.0 * each.certificate["reserve"] for each in front.runs]),
        "least energy": worded("{:.1f} kWh", energies),
    }
    first = front.runs[0]
    shortest = front.least_time + first.certificate.get("standing", 0.0)
    least = Rule(shortest, GREY, "least time of the slowest configuration", upright=True,
                 dash="--")  # fmt: skip
    above = [
        Curve("its slope, from the multipliers", ends, slopes, ORANGE, width=1.4),
        Curve("least energy", times, energies, BLUE, "points", hover=hover, width=2.5),
    ]
    below = [
        Curve("", times, 1e3 * prices, BLUE, width=1.2),
        Curve("", times, 1e3 * prices, BLUE, "points", width=2.0),
    ]
    return [
        Chart(
            "running time [s]",
            [
                Panel("kWh", above, 1.5, rules=[least]),
                Panel("Wh/s", below, 0.8, "What a second more saves", from_zero=True),
            ],
            span=(min(shortest, times[0]) - reach, times[-1] + 1.2 * reach),
            title=f"{first.train} on {first.line}: {first.energy_label}",
            second=(
                "reserve [%]",
                100.0 / front.least_time,
                -100.0 * shortest / front.least_time,
            ),
        )
    ]
