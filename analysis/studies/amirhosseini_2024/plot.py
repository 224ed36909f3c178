"""The figures of Amirhosseini et al. (2024), drawn from runs of `simulation`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    dress,
    new_figure,
    write_figure,
)
from analysis.studies.amirhosseini_2024.simulation import VARIANTS, Run
from trainlog.units import KMH

COLOURS = dict(zip((v.name for v in VARIANTS), (GREEN, BLUE, RED, ORANGE), strict=True))
"""Of the variants."""

PICTURES = (
    "figures-01-03-profile.png",
    "figures-04-05-time-reset.png",
    "figures-06-09-spatial-reset.png",
    "figures-10-14-scalar.png",
    "measured-speed.png",
    "eight-wagons.png",
)

SECONDS = "time [s]"


def draw_study(
    runs: Mapping[str, Run],
    measured: Mapping[str, Run],
    coupled: Sequence[Run],
    folder: Path,
) -> list[Path]:
    """Draw the paper's figures, and what it could not show; returns the pictures' paths.

    Parameters
    ----------
    runs : mapping of str to Run
        With exact speed, by name of the variant.
    measured : mapping of str to Run
        The same with measured speed.
    coupled : sequence of Run
        With eight wagons.
    folder : path
    """
    paths = [folder / name for name in PICTURES]
    profile, timed, spatial, scalar, compared, wagons = paths
    _draw_profile(runs["spatial reset"], profile)
    _draw_learning(runs["time reset"], timed, ("Fig. 4", "Fig. 5", "", ""))
    _draw_learning(runs["spatial reset"], spatial, ("Fig. 6", "Fig. 7", "Fig. 8", "Fig. 9"))
    _draw_scalar(runs["scalar"], scalar)
    _draw_measured(runs, measured, compared)
    _draw_wagons(runs, coupled, wagons)
    return paths


def _draw_profile(run: Run, path: Path) -> None:
    """Figs. 1-3: speed over position and over time, force of the slopes."""
    figure = new_figure(9.0, 8.0)
    first, second, third = figure.subplots(3, 1)
    first.plot(run.target_position / 1e3, run.target_speed * KMH, color=BLUE)
    dress(first, x="km", y="km/h", title="Fig. 1  Desired speed over position")
    second.plot(run.time, run.target_speed * KMH, color=BLUE)
    dress(second, x=SECONDS, y="km/h", title="Fig. 2  Desired speed over time")
    third.plot(run.time, run.slope_force / 1e3, color=RED, drawstyle="steps-post")
    dress(third, x=SECONDS, y="kN", title="Fig. 3  Force of the slopes, f2")
    write_figure(figure, path)


def _draw_learning(run: Run, path: Path, numbers: Sequence[str]) -> None:
    """Estimates of a0 + f2, a1, a2; errors of position and speed; the control signal."""
    figure = new_figure(9.0, 12.0)
    places = figure.subplots(6, 1, sharex=True)
    true = [run.coefficients[:, 0] + run.slope_force, *run.coefficients.T[1:]]
    scales, units = (1e3, 1.0, 1.0), ("kN", "N/(m/s)", "N/(m/s)²")
    names = ("a0 + f2", "a1", "a2")
    # An estimate that has not settled would hide the rest.
    for axes, truth, found, scale, unit, name in zip(
        places, true, run.theta.T, scales, units, names, strict=False
    ):
        axes.plot(run.time, truth / scale, color=GREY, linewidth=2.5, label="true")
        axes.plot(run.time, found / scale, color=BLUE, linewidth=1.0, label="estimated")
        _around(axes, truth / scale, found[found.size // 6 :] / scale)
        dress(axes, x="", y=unit, title=_titled(numbers[0], f"Estimate of {name}"))
    places[0].legend(frameon=False, fontsize=8, ncols=2)
    _draw_errors(places[3:6], run, numbers[1:])
    write_figure(figure, path)


def _draw_scalar(run: Run, path: Path) -> None:
    """Figs. 10-14: the sum of all resistances, errors, control, error of the estimate."""
    figure = new_figure(9.0, 10.0)
    places = figure.subplots(5, 1, sharex=True)
    places[0].plot(run.time, run.resistance / 1e3, color=GREY, linewidth=2.5, label="true")
    places[0].plot(run.time, run.estimate / 1e3, color=BLUE, linewidth=1.0, label="estimated")
    places[0].legend(frameon=False, fontsize=8, ncols=2)
    dress(places[0], x="", y="kN", title="Fig. 10  All resistances together")
    _draw_errors(places[1:4], run, ("Fig. 11", "Fig. 12", "Fig. 13"))
    places[3].set_xlabel("")
    places[4].plot(run.time, (run.estimate - run.resistance) / 1e3, color=PURPLE, linewidth=0.8)
    dress(places[4], x=SECONDS, y="kN", title="Fig. 14  Error of the estimate")
    write_figure(figure, path)


def _draw_measured(runs: Mapping[str, Run], measured: Mapping[str, Run], path: Path) -> None:
    """Position error with exact and with measured speed, of every variant."""
    figure = new_figure(9.0, 7.0)
    first, second = figure.subplots(2, 1, sharex=True)
    noise = next(iter(measured.values())).noise
    for axes, group, title in (
        (first, runs, "Exact speed"),
        (second, measured, f"Measured speed, σ = {noise:g} m/s"),
    ):
        for name, run in group.items():
            largest = run.figures[0]
            axes.plot(
                run.time, run.position_error, color=COLOURS[name], linewidth=1.0,
                label=f"{name}: {largest:.2f} m",
            )  # fmt: skip
        dress(axes, x="", y="position error [m]", title=title)
        # Beside the title: below the axes' edge it would hide the errors.
        axes.legend(
            frameon=False,
            fontsize=8,
            ncols=4,
            handlelength=1.2,
            columnspacing=1.2,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
        )
    second.set_xlabel(SECONDS)
    write_figure(figure, path)


def _draw_wagons(runs: Mapping[str, Run], coupled: Sequence[Run], path: Path) -> None:
    """Position error beside that of the single particle, and the range of the couplers' forces."""
    figure = new_figure(9.0, 3.2 * len(coupled))
    places = figure.subplots(2 * len(coupled), 1, sharex=True)
    for run, above, below in zip(coupled, places[::2], places[1::2], strict=True):
        name = run.variant.name
        alone = any(vehicle.max_tractive_effort == 0.0 for vehicle in run.train.vehicles)
        what = f"{name}, {'the first wagon pulls' if alone else 'every wagon pulls'}"
        single = runs[name]
        above.plot(single.time, single.position_error, color=GREY, label="one particle")
        above.plot(run.time, run.position_error, color=COLOURS[name], label="eight wagons")
        above.legend(
            frameon=False, fontsize=8, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0)
        )
        dress(above, x="", y="m", title=f"Position error: {what}")
        forces = run.coupler_forces / 1e3
        below.fill_between(
            run.time, forces.min(axis=1), forces.max(axis=1), color=COLOURS[name], alpha=0.6,
            linewidth=0.0,
        )  # fmt: skip
        dress(below, x="", y="kN", title="From the least to the largest of the couplers' forces")
    places[-1].set_xlabel(SECONDS)
    write_figure(figure, path)


def _draw_errors(places: Sequence[Axes], run: Run, numbers: Sequence[str]) -> None:
    curves = (
        (run.position_error, "m", "Position error"),
        (run.speed_error, "m/s", "Speed error"),
        (run.effort / 1e3, "kN", "Control signal"),
    )
    for axes, number, (values, unit, title) in zip(places, numbers, curves, strict=True):
        axes.plot(run.time, values, color=COLOURS[run.variant.name], linewidth=0.9)
        dress(axes, x="", y=unit, title=_titled(number, title))
    places[-1].set_xlabel(SECONDS)


def _titled(number: str, title: str) -> str:
    return f"{number}  {title}" if number else title


def _around(axes: Axes, *curves: np.ndarray) -> None:
    """Limit the vertical axis to what the curves span, with a margin."""
    low = min(float(curve.min()) for curve in curves)
    high = max(float(curve.max()) for curve in curves)
    margin = 0.1 * max(high - low, 1e-9)
    axes.set_ylim(low - margin, high + margin)
