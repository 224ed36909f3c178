"""One look for all pictures: colours, sizes, how a figure is begun and written."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from trainlog.formats.files import atomic_write

BLUE, ORANGE, GREEN, RED, PURPLE, SKY = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#d55e00",
    "#8e5ea2",
    "#56b4e9",
)
"""Colours that colour-blind readers can distinguish (Okabe and Ito)."""

INK, GREY, PALE = "#222222", "#7f7f7f", "#d0d0d0"
"""Text and lines; data in the background; grids."""

DOTS_PER_INCH = 150


def new_figure(width: float = 9.0, height: float = 5.0) -> Figure:
    """An empty figure of `width` by `height` [inch] on an Agg canvas; needs no display."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def headline(figure: Figure, text: str, *, colour: str = INK, size: float = 11.0) -> None:
    """Write what a figure shows above it, on the left."""
    figure.suptitle(text, x=0.01, ha="left", fontsize=size, color=colour)


Corner = Literal["upper left", "upper right", "lower left", "lower right"]


def legend(axes: Axes, place: Corner = "upper left", **options: Any) -> None:
    """Draw the legend in the common look; further `options` as of matplotlib."""
    axes.legend(fontsize=8, frameon=False, loc=place, **options)


def dress(axes: Axes, *, x: str, y: str, title: str = "") -> Axes:
    """Label an axes and give it the common look."""
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    if title:
        axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.grid(visible=True, color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GREY)
    axes.tick_params(colors=INK, labelsize=9)
    return axes


def write_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, or as SVG if the path ends so: whole or not at all.

    The same figure gives the same bytes. An SVG has no background, so that it stands on a page of
    any colour.
    """
    with atomic_write(path) as temporary:
        if Path(path).suffix == ".svg":
            with rc_context({"svg.hashsalt": "trainlog"}):
                about = {"Date": None, "Creator": None}
                figure.savefig(temporary, format="svg", transparent=True, metadata=about)
            return
        figure.savefig(temporary, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None})
