"""The forces in a train along it and over time, beside its speed and the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.charts import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    RED,
    dress,
    new_figure,
    write_figure,
)
from analysis.studies.in_train_forces.simulation import ConsistRun
from trainlog.units import KMH, PER_MILLE

COLUMNS = 1_200
"""Instants of the heat map; of those in between the largest force is shown."""


def draw_in_train_forces(run: ConsistRun, path: Path) -> None:
    """Draw one run: speed and gradient, forces along the train, envelope, single particle."""
    figure = new_figure(11.0, 11.0)
    grid = figure.add_gridspec(4, 1, height_ratios=[2.0, 2.6, 1.3, 1.8])
    motion = figure.add_subplot(grid[0])
    forces = figure.add_subplot(grid[1], sharex=motion)
    apart = figure.add_subplot(grid[2], sharex=motion)
    envelope = figure.add_subplot(grid[3])
    figure.suptitle(f"{run.consist.name} on {run.line.name}", x=0.01, ha="left", color=INK)
    _draw_motion(motion, run)
    _draw_forces(figure, forces, run)
    _draw_single(apart, run)
    _draw_envelope(envelope, run)
    motion.set_xlim(0.0, run.time[-1])
    write_figure(figure, path)


def _draw_motion(axes: Axes, run: ConsistRun) -> None:
    axes.plot(run.time, run.speeds[:, 0] * KMH, color=BLUE, label="first vehicle")
    axes.plot(run.time, run.speeds[:, -1] * KMH, color=ORANGE, linewidth=0.8, label="last vehicle")
    dress(axes, x="", y="km/h", title="Speed, and gradient under the front")
    top = 1.7 * run.speeds.max() * KMH
    axes.set_ylim(0.0, top)
    slope = axes.twinx()
    gradient = run.line.gradient(np.minimum(run.front, run.line.length)) * PER_MILLE
    slope.fill_between(run.time, gradient, step="post", color=GREY, alpha=0.25, linewidth=0.0)
    most = max(float(np.abs(gradient).max()), 1.0)
    slope.set_ylim(-1.2 * most, 6.0 * most)
    slope.set_ylabel("‰", color=GREY)
    slope.spines["top"].set_visible(False)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper left", bbox_to_anchor=(0.06, 1.0))
    for first, name in run.phases:
        axes.axvline(run.time[first], color=GREY, linewidth=0.6)
        axes.annotate(
            name, (run.time[first], top), xytext=(3, -3), textcoords="offset points",
            fontsize=7, va="top", rotation=90,
        )  # fmt: skip


def _draw_forces(figure: Figure, axes: Axes, run: ConsistRun) -> None:
    """Heat map: couplers from the front (top) to the rear, over time."""
    edges = np.linspace(0, run.time.size, min(COLUMNS, run.time.size) + 1).astype(int)
    high = np.maximum.reduceat(run.forces, edges[:-1], axis=0)
    low = np.minimum.reduceat(run.forces, edges[:-1], axis=0)
    shown = np.where(high >= -low, high, low) / 1e3
    most = max(float(np.abs(shown).max()), 1e-3)
    times = np.append(run.time, 2.0 * run.time[-1] - run.time[-2])[edges]
    numbers = np.arange(run.forces.shape[1] + 1) + 0.5
    mesh = axes.pcolormesh(
        times, numbers, shown.T, cmap="RdBu_r", vmin=-most, vmax=most, rasterized=True
    )
    axes.invert_yaxis()
    dress(axes, x="", y="coupler, from the front", title="In-train force: draft red, buff blue")
    axes.grid(visible=False)
    bar = figure.colorbar(mesh, ax=axes, pad=0.01, aspect=18)
    bar.set_label("kN", color=INK)


def _draw_single(axes: Axes, run: ConsistRun) -> None:
    axes.plot(run.time, run.ahead, color=PURPLE)
    dress(
        axes, x="time [s]", y="m",
        title="Way of the consist less that of a single particle under the same demands",
    )  # fmt: skip


def _draw_envelope(axes: Axes, run: ConsistRun) -> None:
    """Largest draft and buff of each coupler, and where they come from."""
    numbers = np.arange(1, run.forces.shape[1] + 1)
    draft, buff = run.forces.max(axis=0) / 1e3, run.forces.min(axis=0) / 1e3
    axes.bar(numbers, np.maximum(draft, 0.0), color=RED, width=0.8, label="draft, whole run")
    axes.bar(numbers, np.minimum(buff, 0.0), color=BLUE, width=0.8, label="buff, whole run")
    for name, marker in (("full service braking", "o"), ("emergency braking", "s")):
        during = run.forces[run.phase(name)].min(axis=0) / 1e3
        axes.plot(
            numbers, during, color=INK, marker=marker, markersize=3.5, linewidth=0.8,
            markerfacecolor="white", label=f"least in {name}",
        )  # fmt: skip
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    axes.legend(frameon=False, fontsize=8, ncols=4)
    axes.margins(x=0.01, y=0.2)
    dress(axes, x="coupler, from the front", y="kN", title="Largest forces of each coupler")
