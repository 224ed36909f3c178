"""The figures of Zhao et al. (2025), drawn from runs of `simulation`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypedDict

import numpy as np
from matplotlib.axes import Axes

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    RED,
    SKY,
    dress,
    new_figure,
    write_figure,
)
from analysis.studies.zhao_2025.simulation import SCARCE, WET_SPAN, Run
from trainlog.arrays import FloatArray
from trainlog.railway.adhesion import DRY, WET
from trainlog.units import KMH

AXLES = ((BLUE, 4.0), (SKY, 2.8), (ORANGE, 1.6), (RED, 0.7))
"""Colours and widths of the axles: those that run alike lie on one another."""

STRATEGIES = (BLUE, ORANGE, GREEN, RED)
"""Colours of the strategies."""

SECONDS = "time [s]"


class LineStyle(TypedDict):
    """Of a line."""

    color: str
    linewidth: float


def draw_study(
    runs: Sequence[Run], compared: Mapping[str, Sequence[Run]], folder: Path
) -> list[Path]:
    """Draw the paper's figures of every run, and what there is without cooperation.

    Parameters
    ----------
    runs : sequence of Run
    compared : mapping of str to sequence of Run
        By strategy; the same runs in the same order.
    folder : path

    Returns
    -------
    list of Path
        Of the pictures.
    """
    paths = [folder / "figure-02-adhesion.png"]
    _draw_curves(paths[0])
    stepped = {(run.preset.key, run.case.number): run for run in runs if run.integration == "euler"}
    for run in (each for each in runs if each.integration != "euler"):
        key, number = run.preset.key, run.case.number
        paths.append(folder / f"figure-{number + 2:02d}-case-{number}-{key}.png")
        _draw_case(run, stepped.get((key, number)), paths[-1])
    paths.append(folder / "without-cooperation.png")
    shown = {
        strategy: [run for run in each if run.total == SCARCE]
        for strategy, each in compared.items()
    }
    _draw_compared(shown, paths[-1])
    return paths


def _draw_curves(path: Path) -> None:
    """Fig. 2: adhesion coefficient over slip speed."""
    figure = new_figure(7.0, 4.0)
    axes = figure.subplots()
    slip = np.linspace(0.0, 10.0, 401)
    for curve, colour, name in ((DRY, RED, "dry"), (WET, BLUE, "wet")):
        axes.plot(slip, curve(slip), color=colour, label=name)
        axes.plot(curve.peak_slip, curve.peak, "o", color=colour)
        axes.annotate(
            f"{curve.peak_slip:.2f} m/s, {curve.peak:.3f}", (curve.peak_slip, curve.peak),
            textcoords="offset points", xytext=(6, 5), fontsize=8, color=INK,
        )  # fmt: skip
    axes.set_ylim(0.0, 0.32)
    axes.legend(frameon=False, fontsize=8)
    dress(axes, x="slip speed [m/s]", y="adhesion coefficient", title="Fig. 2  Creep curves")
    write_figure(figure, path)


def _draw_case(run: Run, stepped: Run | None, path: Path) -> None:
    """Figs. 3-6: slip speeds and references, their errors, torques, adhesion coefficients.

    Where there is a run in the paper's steps, it is laid over as dots.
    """
    figure = new_figure(11.0, 7.5)
    (slips, errors), (torques, used) = figure.subplots(2, 2, sharex=True)
    for axle, (colour, width) in enumerate(AXLES):
        look = LineStyle(color=colour, linewidth=width)
        slips.plot(run.time, run.reference[:, axle], color=PALE, linewidth=7.0, zorder=1)
        slips.plot(run.time, run.slip[:, axle], label=f"axle {axle + 1}", **look)
        errors.plot(run.time, run.slip_error[:, axle], **look)
        torques.plot(run.time, run.torque[:, axle], drawstyle="steps-post", **look)
        used.plot(run.time, run.maximum_adhesion[:, axle], color=PALE, linewidth=7.0, zorder=1)
        used.plot(run.time, run.adhesion[:, axle], **look)
    if stepped is not None:
        _dot(
            (slips, errors, torques, used), stepped.time,
            (stepped.slip, stepped.slip_error, stepped.torque, stepped.adhesion),
        )  # fmt: skip
    for axes in (slips, errors, torques, used):
        _shade(axes)
    slips.legend(frameon=False, fontsize=8, ncols=4)
    limit = run.preset.locomotive.torque_limit
    torques.axhline(limit, color=GREY, linewidth=0.8, linestyle=":")
    torques.annotate(
        "limit of a motor", (0.0, limit), textcoords="offset points", xytext=(2, 3),
        fontsize=8, color=GREY,
    )  # fmt: skip
    torques.set_ylim(-0.03 * limit, 1.12 * limit)
    dress(slips, x="", y="m/s", title="(a)  Slip speed; wide: its reference")
    dress(errors, x="", y="m/s", title="(b)  Reference less slip speed")
    dress(torques, x=SECONDS, y="N m", title="(c)  Torque of the motors")
    dress(used, x=SECONDS, y="", title="(d)  Adhesion coefficient; wide: the most the rail gives")
    plant = "Runge-Kutta" if stepped is None else "Runge-Kutta; dots: Euler in steps of 0.1 s"
    figure.suptitle(
        f"Fig. {run.case.number + 2}  Case {run.case.number}: {run.case.name}"
        f" ({run.preset.locomotive.name}; {plant})",
        fontsize=11, color=INK,
    )  # fmt: skip
    write_figure(figure, path)


def draw_start(solved: Run, assumed: Run, path: Path) -> None:
    """Draw how case 1 begins, as solved from the first sample and with an assumed first torque.

    Parameters
    ----------
    solved, assumed : Run
        See `analysis.studies.zhao_2025.table.start_table`.
    path : path
    """
    figure = new_figure(9.0, 3.4)
    torques, slips = figure.subplots(1, 2)
    for run, colour, name in (
        (assumed, ORANGE, "first torque assumed, eq. (19)"), (solved, BLUE, "solved from 0 s on"),
    ):  # fmt: skip
        torques.plot(run.time, run.torque[:, 0], color=colour, drawstyle="steps-post", label=name)
        slips.plot(run.time, run.slip[:, 0], ".-", color=colour)
    for axes in (torques, slips):
        axes.set_xlim(-0.05, 2.0)
    torques.set_ylim(bottom=0.0)
    slips.set_ylim(0.0, 1.0)
    torques.legend(frameon=False, fontsize=8, loc="lower right")
    dress(torques, x=SECONDS, y="N m", title="Start of case 1: torque of a motor")
    dress(slips, x=SECONDS, y="m/s", title="Slip speed")
    write_figure(figure, path)


def draw_rail(runs: Sequence[Run], path: Path) -> None:
    """Draw what the controller took the rail under an axle to be, beside the rail as it was.

    Parameters
    ----------
    runs : sequence of Run
        In which the rail was learnt.
    path : path
    """
    figure = new_figure(11.0, 2.8 * len(runs))
    rows = figure.subplots(len(runs), 2, sharex=True, squeeze=False)
    for run, (maxima, slips) in zip(runs, rows, strict=True):
        maxima.plot(run.time, run.maximum_adhesion[:, 3], color=GREY, linewidth=3.0, label="true")
        maxima.plot(run.time, run.assumed[:, 3], color=BLUE, linewidth=1.2, label="learnt")
        maxima.plot(run.time, run.adhesion[:, 3], color=ORANGE, linewidth=1.0, label="in use")
        slips.plot(run.time, run.reference[:, 3], color=GREY, linewidth=3.0, label="sought")
        slips.plot(run.time, run.slip[:, 3], color=BLUE, linewidth=1.2, label="reached")
        maxima.set_ylim(0.0, 0.36)
        title = f"Case {run.case.number}, {run.total:.0f} N m asked, axle 4"
        dress(maxima, x="", y="", title=f"{title}: maximum adhesion")
        dress(slips, x="", y="m/s", title="slip speed")
    for axes in rows[0]:
        axes.legend(frameon=False, fontsize=8, ncols=3)
    for axes in rows[-1]:
        axes.set_xlabel(SECONDS)
    write_figure(figure, path)


def _dot(places: Sequence[Axes], time: FloatArray, values: Sequence[FloatArray]) -> None:
    for axes, each in zip(places, values, strict=True):
        axes.plot(time, each, ".", color=INK, markersize=1.2, zorder=3)


def _draw_compared(compared: Mapping[str, Sequence[Run]], path: Path) -> None:
    """Force between wheels and rail, and speed, of each strategy."""
    count = len(next(iter(compared.values())))
    figure = new_figure(11.0, 2.8 * count)
    rows = figure.subplots(count, 2, sharex=True, squeeze=False)
    for number, (forces, speeds) in enumerate(rows):
        for colour, (strategy, runs) in zip(STRATEGIES, compared.items(), strict=False):
            run = runs[number]
            forces.plot(run.time, run.force / 1e3, color=colour, linewidth=1.3, label=strategy)
            speeds.plot(run.time, run.speed * KMH, color=colour, linewidth=1.3)
        run = next(iter(compared.values()))[number]
        title = f"Case {run.case.number}, {run.preset.key}, {run.total:.0f} N m asked"
        for axes in (forces, speeds):
            _shade(axes)
            axes.set_ylim(bottom=0.0)
        dress(forces, x="", y="kN", title=f"{title}: force on the rail")
        dress(speeds, x="", y="km/h", title="speed of the train")
    rows[0][0].legend(frameon=False, fontsize=8, ncols=2, loc="lower left")
    for axes in rows[-1]:
        axes.set_xlabel(SECONDS)
    write_figure(figure, path)


def _shade(axes: Axes) -> None:
    """Mark when the rail is wet."""
    axes.axvspan(*WET_SPAN, color=SKY, alpha=0.12, linewidth=0.0)
